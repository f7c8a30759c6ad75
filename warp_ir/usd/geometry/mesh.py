"""UsdGeom Mesh and TetMesh: validated, cut into triangles, with the normals to shade with."""

from dataclasses import replace

import numpy as np
from pxr import Usd, UsdGeom

from warp_ir.scene import Floats, Ints
from warp_ir.usd.geometry.refine import Scheme
from warp_ir.usd.geometry.skinning import Pose, Skinning
from warp_ir.usd.geometry.subdivision import read_subdivided
from warp_ir.usd.geometry.triangulate import triangulate
from warp_ir.usd.geometry.velocities import carried_points
from warp_ir.usd.values import primvar, read
from warp_ir.usd.values.report import Report, Unreadable
from warp_ir.usd.values.triangles import Mask, Shape, elements_of, shaded, without_slivers


def read_mesh(
    prim: Usd.Prim, time: Usd.TimeCode, report: Report, levels: int = 0, skinning: Skinning | None = None
) -> Shape | None:
    """The triangles of a Mesh; None if it has no faces.

    Args:
        prim: The mesh.
        time: Of the values.
        report: Where troubles go.
        levels: How often a subdivision surface is refined; 0 draws its cage.
        skinning: Deforms meshes that are bound to a skeleton; None leaves them at rest.

    Raises:
        Unreadable: An array has the wrong type, or counts, indices and points do not belong together.
        InputError: Subdivision would make more triangles than can be held.
    """
    mesh = UsdGeom.Mesh(prim)
    points = carried_points(*_carrying(mesh), time, report)
    counts = read.ints(mesh.GetFaceVertexCountsAttr(), time)
    indices = read.ints(mesh.GetFaceVertexIndicesAttr(), time)
    if points is None or counts is None or indices is None or len(counts) == 0:
        return None
    _check_topology(points, counts, indices)
    pose = None if skinning is None else skinning.pose(prim, points)
    if pose is not None:
        points = pose.points
    keep = np.ones(len(counts), dtype=bool)
    holes = read.ints(mesh.GetHoleIndicesAttr(), time)
    if holes is not None:
        inside = (holes >= 0) & (holes < len(counts))
        if not inside.all():
            report.warn(prim.GetPath(), "{n} hole indices out of range ignored", int((~inside).sum()))
        keep[holes[inside]] = False
    finite = _finite_faces(prim, points, counts, indices, report)
    keep &= finite
    token = read.text(mesh.GetSubdivisionSchemeAttr(), time, "catmullClark")
    if token != UsdGeom.Tokens.none:
        if levels and token in (scheme.value for scheme in Scheme):
            return read_subdivided(mesh, points, counts, indices, finite, keep, levels, time, report)
        report.warn(
            prim.GetPath(), "subdivision surface rendered as its cage; a higher complexity refines it ({n} in all)"
        )
    corner, face = triangulate(points, counts, indices, keep)
    if read.text(mesh.GetOrientationAttr(), time) == UsdGeom.Tokens.leftHanded:
        corner = corner[:, ::-1]
    shape = Shape(
        points=points,
        triangles=indices.astype(np.int32)[corner],
        face=face,
        corner=corner,
        elements=elements_of(points, counts, indices),
    )
    return _finished(prim, shape, int(keep.sum()), time, report, pose)


def read_tet_mesh(prim: Usd.Prim, time: Usd.TimeCode, report: Report) -> Shape | None:
    """The surface of a TetMesh, computed if it is not authored; None if it is empty.

    Raises:
        Unreadable: An array has the wrong type, or indices are out of range.
    """
    tets = UsdGeom.TetMesh(prim)
    points = carried_points(*_carrying(tets), time, report)
    faces = read.ints(tets.GetSurfaceFaceVertexIndicesAttr(), time, 3)
    if points is not None and (faces is None or len(faces) == 0):
        cells = read.ints(tets.GetTetVertexIndicesAttr(), time, 4)
        if cells is not None and len(cells):
            read.check_range(cells, len(points), "tetVertexIndices")
            faces = np.asarray(UsdGeom.TetMesh.ComputeSurfaceFaces(tets, time), dtype=np.int64).reshape(-1, 3)
    if points is None or faces is None or len(faces) == 0:
        return None
    read.check_range(faces, len(points), "surfaceFaceVertexIndices")
    counts = np.full(len(faces), 3)
    keep = _finite_faces(prim, points, counts, faces.reshape(-1), report)
    corner, face = triangulate(points, counts, faces.reshape(-1), keep)
    if read.text(tets.GetOrientationAttr(), time) == UsdGeom.Tokens.leftHanded:
        corner = corner[:, ::-1]
    elements = elements_of(points, counts, faces.reshape(-1))
    shape = Shape(points, faces.reshape(-1).astype(np.int32)[corner], face, corner, elements=elements)
    return _finished(prim, shape, int(keep.sum()), time, report)


def _carrying(shape: UsdGeom.PointBased) -> tuple[Usd.Attribute, Usd.Attribute, Usd.Attribute]:
    return shape.GetPointsAttr(), shape.GetVelocitiesAttr(), shape.GetAccelerationsAttr()


def _check_topology(points: Floats, counts: Ints, indices: Ints) -> None:
    if counts.min() < 0:
        raise Unreadable("faceVertexCounts has negative values")
    if counts.sum() != len(indices):
        raise Unreadable(f"faceVertexCounts add up to {counts.sum()}, but faceVertexIndices has {len(indices)}")
    read.check_range(indices, len(points), "faceVertexIndices")


def _finite_faces(prim: Usd.Prim, points: Floats, counts: Ints, indices: Ints, report: Report) -> Mask:
    """Which faces [f] touch finite points only."""
    keep = np.ones(len(counts), dtype=bool)
    finite = np.asarray(np.isfinite(points).all(axis=1))
    if finite.all():
        return keep
    bad = np.unique(np.repeat(np.arange(len(counts)), counts)[~finite[indices]])
    if len(bad):
        report.warn(prim.GetPath(), "{n} faces with infinite or NaN points left out", len(bad))
    points[~finite] = 0.0  # used by no face now, and harmless to bounds and arithmetic
    keep[bad] = False
    return keep


def _finished(
    prim: Usd.Prim, shape: Shape, wanted: int, time: Usd.TimeCode, report: Report, pose: Pose | None = None
) -> Shape:
    """The shape without slivers and with its normals; of the `wanted` faces, those that vanished are counted."""
    shape = without_slivers(shape)
    lost = wanted - int(np.count_nonzero(np.bincount(shape.face))) if len(shape.face) else wanted
    return _with_normals(prim, replace(shape, degenerate=lost), time, report, pose)


def _with_normals(prim: Usd.Prim, shape: Shape, time: Usd.TimeCode, report: Report, pose: Pose | None) -> Shape:
    """The shape with its authored normals; without any, or if they say no more than the winding, faceted."""
    authored = UsdGeom.PrimvarsAPI(prim).GetPrimvar("normals")
    if authored and authored.HasValue():
        attribute, interpolation = authored.GetAttr(), authored.GetInterpolation()
        indices = read.ints(authored.GetIndicesAttr(), time) if authored.IsIndexed() else None
    else:
        based = UsdGeom.PointBased(prim)
        attribute, interpolation, indices = based.GetNormalsAttr(), based.GetNormalsInterpolation(), None
    try:
        values = read.floats(attribute, time, 3)
        if values is None or len(values) == 0 or len(shape.triangles) == 0:
            return shape
        normals = primvar.expand(shape, values, interpolation, indices)
    except Unreadable as trouble:
        report.warn(prim.GetPath(), f"{trouble}; the mesh is faceted")
        return shape
    return shaded(shape, normals if pose is None else pose.normals(normals, shape.triangles))
