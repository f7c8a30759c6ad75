"""UsdGeom's implicit shapes, tessellated, with the exact normals of the smooth surface.

Round shapes are surfaces of revolution: a profile of arcs (r, z) with normals, revolved about an axis.
"""

import math
from collections.abc import Callable, Container, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from pxr import Usd, UsdGeom

from warp_ir.scene import Floats, Ints
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Unreadable
from warp_ir.usd.values.triangles import TriangleMesh

_SEGMENTS = 72
"""Segments around the axis, and half as many from pole to pole: the area of a sphere is 0.16 % too small."""

_SIZES: dict[str, dict[str, float]] = {
    "Sphere": {"radius": 1.0},
    "Cylinder": {"radius": 1.0, "height": 2.0},
    "Cylinder_1": {"radiusBottom": 1.0, "radiusTop": 1.0, "height": 2.0},
    "Cone": {"radius": 1.0, "height": 2.0},
    "Capsule": {"radius": 0.5, "height": 1.0},
    "Capsule_1": {"radiusBottom": 0.5, "radiusTop": 0.5, "height": 1.0},
    "Cube": {"size": 2.0},
    "Plane": {"width": 2.0, "length": 2.0},
}
"""The dimensions of each schema, with the schema's fallbacks."""
_WITH_AXIS = ("Cylinder", "Cylinder_1", "Cone", "Capsule", "Capsule_1", "Plane")
"""Schemas whose shape lies along an axis."""

Profile = Sequence[Floats]
"""Arcs from bottom to top, outside at larger r: each float64 [p, 4] with columns r, z and the normal's r, z."""


def read_implicit(prim: Usd.Prim, kind: str, time: Usd.TimeCode, authored: Container[str]) -> TriangleMesh:
    """The triangles of a Sphere, Cube, Cylinder, Cylinder_1, Cone, Capsule, Capsule_1 or Plane.

    Args:
        prim: The shape.
        kind: Its schema.
        time: Time at which attributes are read.
        authored: Names of the properties that it has opinions on.

    Raises:
        Unreadable: A dimension is not finite, or gives a shape without area.
    """
    sizes = []
    for name, default in _SIZES[kind].items():
        size = read.number(prim.GetAttribute(name), time, default) if name in authored else default
        if size < 0.0:
            raise Unreadable(f"{name} is negative ({size:g})")
        sizes.append(size)
    axis = read.text(prim.GetAttribute("axis"), time, "Z") if "axis" in authored and kind in _WITH_AXIS else "Z"
    if axis not in ("X", "Y", "Z"):
        raise Unreadable(f"axis is '{axis}', not X, Y or Z")
    left_handed = False
    if "orientation" in authored:
        left_handed = read.text(prim.GetAttribute("orientation"), time) == UsdGeom.Tokens.leftHanded
    shape = _tessellated(kind, tuple(sizes), axis, left_handed)
    if len(shape.triangles) == 0:
        raise Unreadable("the shape has no area")
    return shape


@lru_cache(maxsize=256)
def _tessellated(kind: str, sizes: tuple[float, ...], axis: str, left_handed: bool) -> TriangleMesh:
    """A shape by its dimensions; equal ones are the same object."""
    dimensions = dict(zip(_SIZES[kind], sizes, strict=True))
    shape = IMPLICIT[kind](dimensions.__getitem__)
    # Cyclic permutations of the axes map +Z to the axis and keep the handedness.
    permutation = {"X": [2, 0, 1], "Y": [1, 2, 0], "Z": [0, 1, 2]}[axis]
    if kind == "Plane" and axis != "Z":
        # By the schema, the plane across X has its width along Z, the plane across Y its width along X.
        permutation = {"X": [2, 1, 0], "Y": [0, 2, 1]}[axis]
    normals = None if shape.normals is None else shape.normals[:, :, permutation]
    triangles = shape.triangles[:, ::-1] if kind == "Plane" and axis != "Z" else shape.triangles
    shape = TriangleMesh(shape.points[:, permutation], triangles, shape.face, shape.corner, normals)
    return _reversed(shape) if left_handed else shape


Size = Callable[[str], float]


def _sphere(size: Size) -> TriangleMesh:
    return _lathe([_arc(size("radius"), 0.0, -90.0, 90.0)])


def _cylinder(size: Size) -> TriangleMesh:
    radius = size("radius")
    return _frustum(radius, radius, size("height"))


def _cylinder_1(size: Size) -> TriangleMesh:
    return _frustum(size("radiusBottom"), size("radiusTop"), size("height"))


def _cone(size: Size) -> TriangleMesh:
    return _frustum(size("radius"), 0.0, size("height"))


def _capsule(size: Size) -> TriangleMesh:
    radius = size("radius")
    return _capped(radius, radius, size("height"))


def _capsule_1(size: Size) -> TriangleMesh:
    return _capped(size("radiusBottom"), size("radiusTop"), size("height"))


def _cube(size: Size) -> TriangleMesh:
    half = 0.5 * size("size")
    if half == 0.0:
        return _faceted(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    points = half * np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], dtype=np.float64)
    quads = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])
    return _faceted(points, quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3))


def _plane(size: Size) -> TriangleMesh:
    x, y = 0.5 * size("width"), 0.5 * size("length")
    corners = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
    if x == 0.0 or y == 0.0:
        return _faceted(corners, np.zeros((0, 3), np.int32))
    return _faceted(corners, np.array([[0, 1, 2], [0, 2, 3]]))


IMPLICIT: dict[str, Callable[[Size], TriangleMesh]] = {
    "Sphere": _sphere,
    "Cube": _cube,
    "Cylinder": _cylinder,
    "Cylinder_1": _cylinder_1,
    "Cone": _cone,
    "Capsule": _capsule,
    "Capsule_1": _capsule_1,
    "Plane": _plane,
}
"""The implicit schemas that are read, and how each is tessellated."""


def _frustum(bottom: float, top: float, height: float) -> TriangleMesh:
    """A closed cylinder, cone or cone frustum, centred on the origin."""
    low, high = -0.5 * height, 0.5 * height
    slant = math.hypot(height, bottom - top) or 1.0
    side = [height / slant, (bottom - top) / slant]
    return _lathe(
        [
            np.array([[0.0, low, 0.0, -1.0], [bottom, low, 0.0, -1.0]]),
            np.array([[bottom, low, *side], [top, high, *side]]),
            np.array([[top, high, 0.0, 1.0], [0.0, high, 0.0, 1.0]]),
        ]
    )


def _capped(bottom: float, top: float, height: float) -> TriangleMesh:
    """A cone frustum with spherical caps, tangent-continuous (a capsule)."""
    slope = math.degrees(math.atan2(bottom - top, height)) if height > 0.0 else 0.0
    tangent, cosine = math.tan(math.radians(slope)), math.cos(math.radians(slope))
    low = _arc(bottom / cosine, -0.5 * height - bottom * tangent, -90.0, slope)
    high = _arc(top / cosine, 0.5 * height - top * tangent, slope, 90.0)
    return _lathe([np.concatenate([low, high])])


def _arc(radius: float, center: float, start: float, stop: float) -> Floats:
    """Profile of a spherical zone from latitude `start` to `stop` [degrees], in steps of 360° / `_SEGMENTS`."""
    steps = max(2, math.ceil((stop - start) / 360.0 * _SEGMENTS))
    latitude = np.radians(np.linspace(start, stop, steps + 1))
    normal = np.stack([np.cos(latitude), np.sin(latitude)], axis=1)
    normal[np.abs(normal) < 1e-15] = 0.0
    return np.concatenate([radius * normal + [0.0, center], normal], axis=1)


def _lathe(profile: Profile) -> TriangleMesh:
    """A surface of revolution about Z, without degenerate triangles (on the axis, or between equal profile points)."""
    angle = 2.0 * math.pi * np.arange(_SEGMENTS) / _SEGMENTS
    rows = np.concatenate(list(profile))
    ends = np.cumsum([len(arc) for arc in profile])
    below = np.setdiff1d(np.arange(len(rows) - 1), ends[:-1] - 1)
    i, j = np.arange(_SEGMENTS), (np.arange(_SEGMENTS) + 1) % _SEGMENTS
    ring = below[:, None] * _SEGMENTS
    lower = np.stack([ring + i, ring + j, ring + _SEGMENTS + j], axis=-1)  # two vertices on the lower ring
    upper = np.stack([ring + i, ring + _SEGMENTS + j, ring + _SEGMENTS + i], axis=-1)
    r, z = rows[:, 0], rows[:, 1]
    distinct = (np.diff(r)[below] != 0.0) | (np.diff(z)[below] != 0.0)
    keep = np.stack([(r[below] > 0.0) & distinct, (r[below + 1] > 0.0) & distinct], axis=1)
    triangles = np.stack([lower, upper], axis=1)[keep].reshape(-1, 3)

    def revolve(radial: Floats, axial: Floats, at: Floats) -> Floats:
        return np.stack([radial * np.cos(at), radial * np.sin(at), np.broadcast_to(axial, at.shape)], axis=-1)

    points = revolve(r[:, None], z[:, None], np.broadcast_to(angle, (len(rows), _SEGMENTS))).reshape(-1, 3)
    row, column = np.divmod(triangles, _SEGMENTS)
    at = angle[column]
    # On the axis the azimuth is undefined: the normal takes that of the triangle's middle.
    middle = angle[column[:, :1]] + math.pi / _SEGMENTS
    at = np.where(r[row] > 0.0, at, middle)
    normals = revolve(rows[row, 2], rows[row, 3], at).astype(np.float32)
    shape = _faceted(points, triangles)
    return TriangleMesh(shape.points, shape.triangles, shape.face, shape.corner, normals)


def _reversed(shape: TriangleMesh) -> TriangleMesh:
    """The shape with reversed winding and normals, so that its front is inside."""
    normals = None if shape.normals is None else -shape.normals[:, ::-1]
    return replace(shape, triangles=shape.triangles[:, ::-1], corner=shape.corner[:, ::-1], normals=normals)


def _faceted(points: Floats, triangles: Ints) -> TriangleMesh:
    count = len(triangles)
    return TriangleMesh(
        points=points,
        triangles=triangles.astype(np.int32).reshape(-1, 3),
        face=np.arange(count, dtype=np.int32),
        corner=np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
    )
