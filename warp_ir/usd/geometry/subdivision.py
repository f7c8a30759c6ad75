"""UsdGeom subdivision surfaces: a mesh's attributes to a control cage, its refinement, and triangles."""

from dataclasses import replace

import numpy as np
from pxr import Usd, UsdGeom

from warp_ir.scene import Bools, Floats, InputError, Ints
from warp_ir.usd.geometry.refine import INFINITE, Cage, Refinement, Scheme, corner_products, unit_sums
from warp_ir.usd.geometry.triangulate import triangulate
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable
from warp_ir.usd.values.triangles import TriangleMesh, count_elements, drop_degenerate, with_normals

_MAX_REFINED_TRIANGLES = 20_000_000
"""Maximum number of triangles that subdivision creates for all surfaces; they take some ten gigabytes meanwhile."""
_FACE_VARYING_RULES = ("none", "cornersOnly", "cornersPlus1", "cornersPlus2", "boundaries", "all")


def read_subdivided(
    mesh: UsdGeom.Mesh,
    points: Floats,
    counts: Ints,
    indices: Ints,
    finite: Bools,
    keep: Bools,
    levels: int,
    time: Usd.TimeCode,
    report: Report,
) -> TriangleMesh | None:
    """The triangles of a subdivision surface; None if it has no faces. Authored normals are ignored, as in USD.

    Args:
        mesh: The prim, whose subdivisionScheme is one of `Scheme`.
        points: Points of the cage, float64 [n, 3], finite.
        counts: Vertices per face, int [f].
        indices: Point of each face-vertex, in range.
        finite: Mask [f] of the faces that define the surface.
        keep: Mask [f] of the faces that are rendered; the others are holes.
        levels: Number of refinements, at least 1.
        time: Time at which attributes are read.
        report: Receives warnings and counts.

    Raises:
        InputError: All surfaces together would have more than `_MAX_REFINED_TRIANGLES` triangles.
    """
    scheme = Scheme(read.text(mesh.GetSubdivisionSchemeAttr(), time, "catmullClark"))
    cage = _cage(mesh, scheme, points, counts, indices, finite, time, report)
    if len(cage.counts) == 0:
        return None
    refined_triangles = (len(cage.counts) if scheme is Scheme.LOOP else len(cage.indices) // 2) * 4**levels
    report.stats["triangles_refined"] += refined_triangles
    if report.stats["triangles_refined"] > _MAX_REFINED_TRIANGLES:
        raise InputError(
            f"{report.source}: {mesh.GetPath()}: subdivision makes {report.stats['triangles_refined']} triangles, more "
            f"than {_MAX_REFINED_TRIANGLES}: choose a lower complexity"
        )
    rule = read.text(mesh.GetFaceVaryingLinearInterpolationAttr(), time, "cornersPlus1")
    refinement = Refinement(cage, scheme, levels, rule if rule in _FACE_VARYING_RULES else "cornersPlus1")
    face_size = refinement.indices.shape[1]
    fan = np.array([[0, 1, 2], [0, 2, 3]] if face_size == 4 else [[0, 1, 2]])
    rendered = np.flatnonzero(keep[refinement.face] & refinement.has_surface)
    corner = (rendered[:, None, None] * face_size + fan).reshape(-1, 3).astype(np.int32)
    orientation = 1.0
    if read.text(mesh.GetOrientationAttr(), time) == UsdGeom.Tokens.leftHanded:
        corner, orientation = corner[:, ::-1], -1.0
    refined_points = refinement.vertex(points)
    shape = TriangleMesh(
        points=refined_points,
        triangles=refinement.indices.reshape(-1).astype(np.int32)[corner],
        face=np.repeat(refinement.face[rendered], len(fan)).astype(np.int32),
        corner=corner,
        element_counts=count_elements(points, counts, indices),
        refiner=refinement,
    )
    shape = drop_degenerate(shape)
    lost = int(np.count_nonzero(keep)) - int(np.count_nonzero(np.bincount(shape.face)))
    if not refinement.has_surface.all():
        lost = 0  # with interpolateBoundary "none", faces at the boundary have no surface
    shape = replace(shape, degenerate_faces=lost)
    if scheme is Scheme.BILINEAR or len(shape.triangles) == 0:
        return shape
    return with_normals(shape, orientation * refinement.normals(refined_points)[shape.corner])


def cage_normals(points: Floats, counts: Ints, indices: Ints, mask: Bools) -> Floats:
    """Smooth normals of an unrefined surface at its points, unit or 0, float64 [n, 3], outward for right-handed faces.

    Storm draws Catmull-Clark and Loop cages with them: sums over corners of the cross products of their two edges,
    whatever the creases (`Hd_SmoothNormals`). At reflex corners, whose product points inwards, it is turned over.

    Args:
        points: float64 [n, 3].
        counts: Vertices per face, int [f].
        indices: Point of each face-vertex, in range.
        mask: Mask [f] of the faces that count.
    """
    face = np.repeat(np.arange(len(counts)), counts)
    following: Ints = np.arange(1, len(indices) + 1)
    used = counts > 0
    last = (np.cumsum(counts) - 1)[used]
    following[last] = last + 1 - counts[used]
    previous = np.empty_like(following)
    previous[following] = np.arange(len(following))
    corner = points[indices]
    products = corner_products(corner, following, previous)
    if not mask.all():
        products[:, ~mask[face]] = 0.0
    if (counts > 3).any():
        first = following[last][np.cumsum(used)[face] - 1]
        # Newell's method: twice the area of a face along its normal, relative to its first vertex for precision.
        relative = corner - corner[first]
        (x, y, z), (u, v, w) = relative.T, relative[following].T
        doubled = (y * w - z * v, z * u - x * w, x * v - y * u)
        area = np.stack([np.bincount(face, weights=part, minlength=len(counts)) for part in doubled])
        products[:, np.einsum("kv,kv->v", products, area[:, face]) < 0.0] *= -1.0
    return unit_sums(products, indices, len(points))


def _cage(
    mesh: UsdGeom.Mesh,
    scheme: Scheme,
    points: Floats,
    counts: Ints,
    indices: Ints,
    mask: Bools,
    time: Usd.TimeCode,
    report: Report,
) -> Cage:
    """The control cage of a mesh: its faces in the mask (holes included), creases, corners and boundary rule."""
    mask = mask & (counts >= 3)
    if scheme is Scheme.LOOP:
        if (counts[mask] != 3).any():
            report.warn(mesh.GetPath(), "Loop subdivision needs triangles: other faces are cut into triangles first")
        triangles, face = triangulate(points, counts, indices, mask)
        corner, size = triangles.reshape(-1).astype(np.int64), np.full(len(face), 3)
    else:
        face, corner, size = np.flatnonzero(mask), np.flatnonzero(np.repeat(mask, counts)), counts[mask]
    edges, edge_sharpness = _creases(mesh, len(points), time, report)
    boundary = read.text(mesh.GetInterpolateBoundaryAttr(), time, "edgeAndCorner")
    cage = Cage(
        size,
        indices[corner],
        len(points),
        edges,
        edge_sharpness,
        _sharp_corners(mesh, len(points), time, report),
        sharp_boundary=boundary != UsdGeom.Tokens.none,
        smooth_triangles=read.text(mesh.GetTriangleSubdivisionRuleAttr(), time) == UsdGeom.Tokens.smooth,
        face=face,
        corner=corner,
    )
    return cage.with_sharp_corners() if boundary == UsdGeom.Tokens.edgeAndCorner else cage


def _creases(mesh: UsdGeom.Mesh, points: int, time: Usd.TimeCode, report: Report) -> tuple[Ints, Floats]:
    """Pairs of points [c, 2] along creases, and their sharpness [c]; empty, with a warning, if inconsistent."""
    no_creases = np.zeros((0, 2), np.int64), np.zeros(0)
    try:
        chains = read.ints(mesh.GetCreaseIndicesAttr(), time)
        lengths = read.ints(mesh.GetCreaseLengthsAttr(), time)
        sharpness = read.scalars(mesh.GetCreaseSharpnessesAttr(), time)
        if chains is None or lengths is None or sharpness is None or len(lengths) == 0:
            return no_creases
        if lengths.min() < 2 or lengths.sum() != len(chains):
            raise Unreadable(f"creaseLengths do not divide the {len(chains)} creaseIndices into chains")
        if len(sharpness) not in (len(lengths), len(chains) - len(lengths)):
            raise Unreadable(f"creaseSharpnesses has {len(sharpness)} values for {len(lengths)} creases")
        read.check_range(chains, points, "creaseIndices")
    except Unreadable as error:
        report.warn(mesh.GetPath(), f"{error}; the creases are ignored")
        return no_creases
    last = np.zeros(len(chains), dtype=bool)
    last[np.cumsum(lengths) - 1] = True
    start = np.flatnonzero(~last)
    if len(sharpness) == len(lengths):
        sharpness = np.repeat(sharpness, lengths - 1)
    return np.stack([chains[start], chains[start + 1]], axis=1), _sharpness(sharpness)


def _sharp_corners(mesh: UsdGeom.Mesh, points: int, time: Usd.TimeCode, report: Report) -> Floats:
    """Sharpness of every point, float64 [points]; 0, with a warning, if the arrays are inconsistent."""
    sharp = np.zeros(points)
    try:
        corners = read.ints(mesh.GetCornerIndicesAttr(), time)
        sharpness = read.scalars(mesh.GetCornerSharpnessesAttr(), time)
        if corners is not None and sharpness is not None:
            if len(corners) != len(sharpness):
                raise Unreadable(f"cornerSharpnesses has {len(sharpness)} values for {len(corners)} cornerIndices")
            read.check_range(corners, points, "cornerIndices")
            sharp[corners] = _sharpness(sharpness)
    except Unreadable as error:
        report.warn(mesh.GetPath(), f"{error}; the corners are ignored")
    return sharp


def _sharpness(values: Floats) -> Floats:
    """Sharpness values clipped to [0, INFINITE]; NaN counts as 0."""
    return np.nan_to_num(values, nan=0.0).clip(0.0, INFINITE)
