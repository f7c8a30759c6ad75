"""UsdGeom Mesh and TetMesh: validated, triangulated, with shading normals."""

from dataclasses import replace

import numpy as np
from pxr import Usd, UsdGeom

from warp_ir.memory import require_memory
from warp_ir.scene import Bools, Floats, Ints
from warp_ir.usd.geometry.refine import Scheme
from warp_ir.usd.geometry.skinning import DeformedMesh, Skinning
from warp_ir.usd.geometry.subdivision import cage_normals, read_subdivided
from warp_ir.usd.geometry.triangulate import triangulate
from warp_ir.usd.geometry.velocities import read_points
from warp_ir.usd.values import primvar, read
from warp_ir.usd.values.report import Report, Unreadable
from warp_ir.usd.values.triangles import Cells, TriangleMesh, count_elements, drop_degenerate, with_normals

_BYTES_PER_CORNER = 100
"""Memory in which a corner of a face is read, at the peak: measured for ten million triangles."""


def read_mesh(
    prim: Usd.Prim, time: Usd.TimeCode, report: Report, levels: int = 0, skinning: Skinning | None = None
) -> TriangleMesh | None:
    """The triangles of a Mesh; None if it has no faces.

    Args:
        prim: The mesh.
        time: Time at which attributes are read.
        report: Receives warnings.
        levels: Number of refinements of a subdivision surface; 0 renders its cage.
        skinning: Deforms meshes that are bound to a skeleton; None leaves them in their rest pose.

    Raises:
        Unreadable: An array has the wrong type, or counts, indices and points are inconsistent.
        InputError: Subdivision would create too many triangles.
    """
    mesh = UsdGeom.Mesh(prim)
    points, sampled = read_points(prim, time, report)
    counts = read.ints(mesh.GetFaceVertexCountsAttr(), time)
    indices = read.ints(mesh.GetFaceVertexIndicesAttr(), time)
    if points is None or counts is None or indices is None or len(counts) == 0:
        return None
    require_memory(_BYTES_PER_CORNER * len(indices), f"{prim.GetPath()}: {len(counts)} faces")
    _check_topology(points, counts, indices)
    deformed = None if skinning is None else skinning.deform(prim, points)
    if deformed is not None:
        points = deformed.points
    keep = np.ones(len(counts), dtype=bool)
    holes = read.ints(mesh.GetHoleIndicesAttr(), time)
    if holes is not None:
        valid = (holes >= 0) & (holes < len(counts))
        if not valid.all():
            report.warn(prim.GetPath(), "{n} hole indices out of range ignored", int((~valid).sum()))
        keep[holes[valid]] = False
    finite = _finite_faces(prim, points, counts, indices, report)
    keep &= finite
    scheme = read.text(mesh.GetSubdivisionSchemeAttr(), time, "catmullClark")
    if scheme != UsdGeom.Tokens.none:
        if levels and scheme in (supported.value for supported in Scheme):
            refined = read_subdivided(mesh, points, counts, indices, finite, keep, levels, time, report)
            return replace(refined, sampled=True) if refined is not None and sampled else refined
        report.warn(
            prim.GetPath(), "subdivision surface rendered as its cage; a higher complexity refines it ({n} in all)"
        )
    corner, face = triangulate(points, counts, indices, keep)
    left_handed = read.text(mesh.GetOrientationAttr(), time) == UsdGeom.Tokens.leftHanded
    if left_handed:
        corner = corner[:, ::-1]
    shape = TriangleMesh(
        points=points,
        triangles=indices.astype(np.int32)[corner],
        face=face,
        corner=corner,
        element_counts=count_elements(points, counts, indices),
        sampled=sampled,
    )
    shape = _drop_degenerate(shape, int(keep.sum()))
    if scheme == UsdGeom.Tokens.none:
        return _with_authored_normals(prim, shape, time, report, deformed)
    if scheme == UsdGeom.Tokens.bilinear or len(shape.triangles) == 0:
        return shape
    normals = cage_normals(points, counts, indices, finite)[shape.triangles]
    return with_normals(shape, -normals if left_handed else normals)


def read_tet_mesh(prim: Usd.Prim, time: Usd.TimeCode, report: Report) -> TriangleMesh | None:
    """The surface triangles of a TetMesh, computed from its tetrahedra if not authored; None if it is empty.

    Raises:
        Unreadable: An array has the wrong type, or indices are out of range.
    """
    tets = UsdGeom.TetMesh(prim)
    points, sampled = read_points(prim, time, report)
    faces = read.ints(tets.GetSurfaceFaceVertexIndicesAttr(), time, 3)
    cells = read.ints(tets.GetTetVertexIndicesAttr(), time, 4)
    if points is not None and cells is not None:
        read.check_range(cells, len(points), "tetVertexIndices")
        if (faces is None or len(faces) == 0) and len(cells):
            faces = np.asarray(UsdGeom.TetMesh.ComputeSurfaceFaces(tets, time), dtype=np.int64).reshape(-1, 3)
    if points is None or faces is None or len(faces) == 0:
        return None
    read.check_range(faces, len(points), "surfaceFaceVertexIndices")
    counts = np.full(len(faces), 3)
    keep = _finite_faces(prim, points, counts, faces.reshape(-1), report)
    corner, face = triangulate(points, counts, faces.reshape(-1), keep)
    if read.text(tets.GetOrientationAttr(), time) == UsdGeom.Tokens.leftHanded:
        corner = corner[:, ::-1]
    shape = TriangleMesh(
        *(points, faces.reshape(-1).astype(np.int32)[corner], face, corner),
        element_counts=count_elements(points, counts, faces.reshape(-1)),
        sampled=sampled,
        cells=None if cells is None or not _has_values_per_cell(prim) else Cells(len(cells), _cells_of(faces, cells)),
    )
    return _with_authored_normals(prim, _drop_degenerate(shape, int(keep.sum())), time, report)


def _has_values_per_cell(prim: Usd.Prim) -> bool:
    """Whether a TetMesh has anything that refers to its tetrahedra: a uniform primvar, or a GeomSubset of them."""
    normals = UsdGeom.PointBased(prim).GetNormalsInterpolation()
    interpolations = [primvar.GetInterpolation() for primvar in UsdGeom.PrimvarsAPI(prim).GetPrimvars()]
    predicate = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)
    return UsdGeom.Tokens.uniform in (normals, *interpolations) or any(
        child.IsA(UsdGeom.Subset) for child in prim.GetFilteredChildren(predicate)
    )


def _cells_of(faces: Ints, cells: Ints) -> Ints:
    """For each triangle [f, 3] the first tetrahedron [t, 4] that it is a face of, int [f]; -1: of none."""
    on_surface = np.zeros(int(max(faces.max(), cells.max(initial=0))) + 1, dtype=bool)
    on_surface[faces] = True
    sides = np.sort(cells, axis=1)[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3)
    candidates = np.flatnonzero(on_surface[sides].all(axis=1))
    rows = np.concatenate([sides[candidates], np.sort(faces, axis=1)])
    first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)[1:]
    found = first[inverse.reshape(-1)[len(candidates) :]]
    padded = np.concatenate([candidates // 4, np.full(len(faces), -1)])
    return padded[found]


def _check_topology(points: Floats, counts: Ints, indices: Ints) -> None:
    """Check that counts and indices describe a mesh over the points; raises `Unreadable`."""
    if counts.min() < 0:
        raise Unreadable("faceVertexCounts has negative values")
    if counts.sum() != len(indices):
        raise Unreadable(f"faceVertexCounts add up to {counts.sum()}, but faceVertexIndices has {len(indices)}")
    read.check_range(indices, len(points), "faceVertexIndices")


def _finite_faces(prim: Usd.Prim, points: Floats, counts: Ints, indices: Ints, report: Report) -> Bools:
    """Mask [f] of the faces whose points are all finite; sets the others' points to 0 in place."""
    keep = np.ones(len(counts), dtype=bool)
    finite = np.asarray(np.isfinite(points).all(axis=1))
    if finite.all():
        return keep
    non_finite = np.unique(np.repeat(np.arange(len(counts)), counts)[~finite[indices]])
    if len(non_finite):
        report.warn(prim.GetPath(), "{n} faces with infinite or NaN points left out", len(non_finite))
    points[~finite] = 0.0  # no face that is kept uses them; arithmetic on all points stays finite
    keep[non_finite] = False
    return keep


def _drop_degenerate(shape: TriangleMesh, wanted: int) -> TriangleMesh:
    """The shape without degenerate triangles; counts those of the `wanted` faces that vanished."""
    shape = drop_degenerate(shape)
    lost = wanted - int(np.count_nonzero(np.bincount(shape.face))) if len(shape.face) else wanted
    return replace(shape, degenerate_faces=lost)


def _with_authored_normals(
    prim: Usd.Prim,
    shape: TriangleMesh,
    time: Usd.TimeCode,
    report: Report,
    deformed: DeformedMesh | None = None,
) -> TriangleMesh:
    """The shape with its authored normals, deformed like its points; without normals it stays faceted."""
    authored = primvar.schema_primvar(prim, "normals")
    try:
        at = read.sample_before(authored.attribute, time) if shape.sampled else time
        values, indices = read.floats(authored.attribute, at, 3), authored.indices(time)
        if values is None or len(values) == 0 or len(shape.triangles) == 0:
            return shape
        normals = primvar.expand(shape, values, authored.interpolation, indices)
    except Unreadable as error:
        report.warn(prim.GetPath(), f"normals: {error}; the mesh is faceted")
        return shape
    return with_normals(shape, normals if deformed is None else deformed.normals(normals, shape.triangles))
