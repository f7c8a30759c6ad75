"""Subdivision surfaces of UsdGeom: from a mesh's attributes to the cage that is refined, and on to triangles."""

from dataclasses import replace

import numpy as np
from pxr import Usd, UsdGeom

from warp_ir.scene import Floats, InputError, Ints
from warp_ir.usd.geometry.refine import INFINITE, Cage, Refinement, Scheme
from warp_ir.usd.geometry.triangulate import triangulate
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable
from warp_ir.usd.values.triangles import Mask, Shape, elements_of, shaded, without_slivers

_MOST_REFINED = 20_000_000
"""Triangles that subdivision may make in all: they take some ten gigabytes while they are made."""
_LINEAR = ("none", "cornersOnly", "cornersPlus1", "cornersPlus2", "boundaries", "all")


def read_subdivided(
    mesh: UsdGeom.Mesh,
    points: Floats,
    counts: Ints,
    indices: Ints,
    finite: Mask,
    keep: Mask,
    levels: int,
    time: Usd.TimeCode,
    report: Report,
) -> Shape | None:
    """The triangles of a subdivision surface; None if it has no faces. Authored normals do not count: it has its own.

    Args:
        mesh: The prim, whose subdivisionScheme is one of `Scheme`.
        points: Of the cage, float64 [n, 3], finite.
        counts: Vertices per face, int [f].
        indices: Point of each face-vertex, in range.
        finite: Which faces [f] the surface is made of.
        keep: Which of them are drawn: the others are holes.
        levels: How often it is refined, at least once.
        time: Of the values.
        report: Where troubles go.

    Raises:
        InputError: All surfaces together would make more triangles than can be held.
    """
    scheme = Scheme(read.text(mesh.GetSubdivisionSchemeAttr(), time, "catmullClark"))
    cage = _cage(mesh, scheme, points, counts, indices, finite, time, report)
    if len(cage.counts) == 0:
        return None
    made = (len(cage.counts) if scheme is Scheme.LOOP else len(cage.indices) // 2) * 4**levels
    report.stats["triangles_refined"] += made
    if report.stats["triangles_refined"] > _MOST_REFINED:
        raise InputError(
            f"{report.source}: {mesh.GetPath()}: subdivision makes {report.stats['triangles_refined']} triangles, more "
            f"than {_MOST_REFINED}: choose a lower complexity"
        )
    linear = read.text(mesh.GetFaceVaryingLinearInterpolationAttr(), time, "cornersPlus1")
    refinement = Refinement(cage, scheme, levels, linear if linear in _LINEAR else "cornersPlus1")
    vertices = refinement.indices.shape[1]
    halves = np.array([[0, 1, 2], [0, 2, 3]] if vertices == 4 else [[0, 1, 2]])
    drawn = np.flatnonzero(keep[refinement.face] & refinement.drawn)
    corner = (drawn[:, None, None] * vertices + halves).reshape(-1, 3).astype(np.int32)
    front = 1.0
    if read.text(mesh.GetOrientationAttr(), time) == UsdGeom.Tokens.leftHanded:
        corner, front = corner[:, ::-1], -1.0
    refined = refinement.vertex(points)
    shape = Shape(
        points=refined,
        triangles=refinement.indices.reshape(-1).astype(np.int32)[corner],
        face=np.repeat(refinement.face[drawn], len(halves)).astype(np.int32),
        corner=corner,
        elements=elements_of(points, counts, indices),
        refined=refinement,
    )
    shape = without_slivers(shape)
    lost = int(np.count_nonzero(keep)) - int(np.count_nonzero(np.bincount(shape.face)))
    if not refinement.drawn.all():
        lost = 0  # faces at an open boundary are missing on purpose
    shape = replace(shape, degenerate=lost)
    if scheme is Scheme.BILINEAR or len(shape.triangles) == 0:
        return shape
    return shaded(shape, front * refinement.normals(refined)[shape.corner])


def _cage(
    mesh: UsdGeom.Mesh,
    scheme: Scheme,
    points: Floats,
    counts: Ints,
    indices: Ints,
    present: Mask,
    time: Usd.TimeCode,
    report: Report,
) -> Cage:
    """The mesh as its subdivision sees it: the faces present (holes too), its creases, corners and boundaries."""
    present = present & (counts >= 3)
    if scheme is Scheme.LOOP:
        if (counts[present] != 3).any():
            report.warn(mesh.GetPath(), "Loop subdivision takes triangles: its other faces are cut into some first")
        triangles, face = triangulate(points, counts, indices, present)
        corner, size = triangles.reshape(-1).astype(np.int64), np.full(len(face), 3)
    else:
        face, corner, size = np.flatnonzero(present), np.flatnonzero(np.repeat(present, counts)), counts[present]
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
    """The pairs of points [c, 2] along creases, and their sharpness [c]; none if the arrays do not fit together."""
    none = np.zeros((0, 2), np.int64), np.zeros(0)
    try:
        chain = read.ints(mesh.GetCreaseIndicesAttr(), time)
        lengths = read.ints(mesh.GetCreaseLengthsAttr(), time)
        sharpness = read.scalars(mesh.GetCreaseSharpnessesAttr(), time)
        if chain is None or lengths is None or sharpness is None or len(lengths) == 0:
            return none
        if lengths.min() < 2 or lengths.sum() != len(chain):
            raise Unreadable(f"creaseLengths do not divide the {len(chain)} creaseIndices into chains")
        if len(sharpness) not in (len(lengths), len(chain) - len(lengths)):
            raise Unreadable(f"creaseSharpnesses has {len(sharpness)} values for {len(lengths)} creases")
        read.check_range(chain, points, "creaseIndices")
    except Unreadable as trouble:
        report.warn(mesh.GetPath(), f"{trouble}; the creases are ignored")
        return none
    last = np.zeros(len(chain), dtype=bool)
    last[np.cumsum(lengths) - 1] = True
    start = np.flatnonzero(~last)
    if len(sharpness) == len(lengths):
        sharpness = np.repeat(sharpness, lengths - 1)
    return np.stack([chain[start], chain[start + 1]], axis=1), _sharpness(sharpness)


def _sharp_corners(mesh: UsdGeom.Mesh, points: int, time: Usd.TimeCode, report: Report) -> Floats:
    """The sharpness of every point."""
    sharp = np.zeros(points)
    try:
        corners = read.ints(mesh.GetCornerIndicesAttr(), time)
        sharpness = read.scalars(mesh.GetCornerSharpnessesAttr(), time)
        if corners is not None and sharpness is not None:
            if len(corners) != len(sharpness):
                raise Unreadable(f"cornerSharpnesses has {len(sharpness)} values for {len(corners)} cornerIndices")
            read.check_range(corners, points, "cornerIndices")
            sharp[corners] = _sharpness(sharpness)
    except Unreadable as trouble:
        report.warn(mesh.GetPath(), f"{trouble}; the corners are ignored")
    return sharp


def _sharpness(values: Floats) -> Floats:
    return np.nan_to_num(values, nan=0.0).clip(0.0, INFINITE)
