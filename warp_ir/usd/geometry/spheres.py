"""UsdGeomPoints as spheres, each with as many triangles as the picture shows.

The faceted spheres have the area of the sphere and so, by Cauchy's formula, that of its silhouette on average over all
directions.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from pxr import Usd

from warp_ir.scene import Floats, Ints
from warp_ir.usd.geometry.detail import TOLERANCE, PixelSize, pixels_per_unit
from warp_ir.usd.geometry.velocities import read_points
from warp_ir.usd.values import read
from warp_ir.usd.values.primvar import schema_primvar
from warp_ir.usd.values.report import Report, Unreadable
from warp_ir.usd.values.triangles import TriangleMesh, cross_products

_DEVIATIONS = (0.35, 0.12, 0.031, 0.0078, 0.002)
"""Largest distance of the triangles of each level from a sphere of radius 1."""
_MAX_TRIANGLES = 40_000_000
"""Triangles of a prim above which its spheres are coarser."""


@dataclass(frozen=True, eq=False)
class _PointRefiner:
    """Primvars of points at the vertices of their spheres (`PrimvarRefiner`)."""

    point: Ints
    """int [v], the point of each vertex."""

    def vertex(self, values: Floats) -> Floats:
        """Values of the points."""
        return values[self.point]

    def varying(self, values: Floats) -> Floats:
        """The same."""
        return values[self.point]

    def face_varying(self, values: Floats, indices: Ints | None = None) -> Floats:
        """The same."""
        return values[self.point] if indices is None else values[indices[self.point]]


def read_spheres(
    prim: Usd.Prim, time: Usd.TimeCode, report: Report, matrices: Floats, pixel: PixelSize | None = None
) -> TriangleMesh | None:
    """The spheres of a Points prim; None if it has none.

    Args:
        prim: The points.
        time: Time at which attributes are read.
        report: Receives warnings.
        matrices: world_from_prim of all its instances, [k, 4, 4].
        pixel: The size of a pixel; None: not known.

    Raises:
        Unreadable: An array has the wrong type or the wrong number of values.
    """
    points, sampled = read_points(prim, time, report)
    if points is None or len(points) == 0:
        return None
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        report.warn(prim.GetPath(), "{n} points that are infinite or NaN left out", int((~finite).sum()))
    widths = _widths(prim, points[finite], len(points), time, sampled, report)
    invalid = ~(np.isfinite(widths) & (widths > 0.0)) & finite
    if invalid.any():
        report.warn(prim.GetPath(), "{n} points without a positive width left out", int(invalid.sum()))
    drawn = np.flatnonzero(finite & ~invalid)
    if len(drawn) == 0:
        return None
    centers, radius = points[drawn], 0.5 * widths[drawn]
    level = _levels(radius * pixels_per_unit(pixel, centers, matrices))
    parts: list[tuple[Floats, Ints, Floats]] = []
    owners: list[tuple[Ints, Ints]] = []
    for k in np.unique(level).tolist():
        vertices, triangles, scale = _unit_sphere(k)
        chosen = np.flatnonzero(level == k)
        first = sum(len(p) for p, _, _ in parts) + len(vertices) * np.arange(len(chosen))
        placed = centers[chosen, None] + (scale * radius[chosen])[:, None, None] * vertices
        normals = np.broadcast_to(vertices.astype(np.float32)[triangles], (len(chosen), *triangles.shape, 3))
        indices = (first[:, None, None] + triangles).astype(np.int32).reshape(-1, 3)
        parts.append((placed.reshape(-1, 3), indices, normals.reshape(-1, 3, 3)))
        owners.append((np.repeat(drawn[chosen], len(vertices)), np.repeat(drawn[chosen], len(triangles))))
    vertices, triangles, normals = (np.concatenate([part[k] for part in parts]) for k in range(3))
    of_vertex, of_triangle = (np.concatenate([owner[k] for owner in owners]) for k in range(2))
    count = len(points)
    return TriangleMesh(
        points=vertices,
        triangles=triangles,
        face=of_triangle.astype(np.int32),
        corner=triangles,
        normals=normals,
        element_counts={"uniform": count, "vertex": count, "varying": count, "faceVarying": count},
        refiner=_PointRefiner(of_vertex),
        sampled=sampled,
    )


def _widths(prim: Usd.Prim, points: Floats, count: int, time: Usd.TimeCode, sampled: bool, report: Report) -> Floats:
    """Diameters of all points, float64 [count].

    Raises:
        Unreadable: There is neither one for each point nor one for all.
    """
    primvar = schema_primvar(prim, "widths")
    widths = read.scalars(primvar.attribute, read.sample_before(primvar.attribute, time) if sampled else time)
    if widths is None or len(widths) == 0:
        width = float(np.linalg.norm(np.ptp(points, axis=0))) / 500.0 if len(points) > 1 else 1.0
        report.warn(prim.GetPath(), "it has no widths: 1/500 of its extent is used")
        return np.full(count, width)
    indices = primvar.indices(time)
    if indices is not None:
        read.check_range(indices, len(widths), "widths")
        widths = widths[indices]
    if len(widths) not in (1, count):
        raise Unreadable(f"it has {len(widths)} widths for {count} points")
    return np.broadcast_to(widths, count)


def _levels(pixels: Floats) -> Ints:
    """The level of detail of spheres whose radii are so many pixels."""
    tolerance = TOLERANCE
    triangles = np.array([len(_unit_sphere(k)[1]) for k in range(len(_DEVIATIONS))])
    while True:
        limits = tolerance / np.array(_DEVIATIONS[:-1])
        level = np.searchsorted(limits, pixels)
        if triangles[level].sum() <= _MAX_TRIANGLES or level.max() == 0:
            return level
        tolerance *= 2.0


@cache
def _unit_sphere(level: int) -> tuple[Floats, Ints, float]:
    """Vertices [v, 3] of a sphere of radius 1, triangles, and the scale at which their area is that of the sphere."""
    if level == 0:
        points: Floats = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)
        triangles: Ints = np.array(
            [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]], np.int64
        )
    else:
        points, triangles = _icosahedron()
        for _ in range(level - 1):
            points, triangles = _halved(points, triangles)
    area = 0.5 * float(np.linalg.norm(cross_products(points, triangles), axis=1).sum())
    return points, triangles, float(np.sqrt(4.0 * np.pi / area))


def _icosahedron() -> tuple[Floats, Ints]:
    """Vertices and outward triangles of an icosahedron with circumradius 1."""
    golden = 0.5 * (1.0 + np.sqrt(5.0))
    signs = np.array([[s, t] for s in (-1.0, 1.0) for t in (-1.0, 1.0)])
    flat = np.concatenate([np.zeros((4, 1)), signs * [1.0, golden]], axis=1)
    points = np.concatenate([np.roll(flat, k, axis=1) for k in range(3)])
    distance = np.linalg.norm(points[:, None] - points, axis=2)
    adjacent = np.isclose(distance, 2.0)
    triples = [(i, j, k) for i in range(12) for j in range(i) for k in range(j)]
    triangles = np.array([t for t in triples if adjacent[t[0], t[1]] and adjacent[t[1], t[2]] and adjacent[t[0], t[2]]])
    inward = np.einsum("mi,mi->m", cross_products(points, triangles), points[triangles[:, 0]]) < 0.0
    triangles[inward] = triangles[inward][:, ::-1]
    return points / np.linalg.norm(points[0]), triangles


def _halved(points: Floats, triangles: Ints) -> tuple[Floats, Ints]:
    """Each triangle divided into four at the middles of its edges, which move onto the unit sphere."""
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    middles = points[unique].sum(axis=1)
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    (a, b, c), (ab, bc, ca) = triangles.T, (len(points) + inverse.reshape(-1, 3)).T
    parts = np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]])
    return np.concatenate([points, middles]), parts.transpose(2, 0, 1).reshape(-1, 3)
