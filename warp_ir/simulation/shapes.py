"""Triangles of the shapes of simulators, in the space of a shape; curved ones with the normals of the true surface."""

import math
from dataclasses import dataclass

import numpy as np

from warp_ir.scene import Floats, Ints

SEGMENTS = 128
"""Segments around the axis of curved shapes."""
PLANE_REACH = 4096.0
"""Half the size of an infinite plane [m]: further than camera rays go by default."""
_PLANE_SQUARES = 16
_PLANE_SIDE = 8
_SMALL_PLANE = 4.0


@dataclass(frozen=True)
class Triangles:
    """Triangles with or without normals at their corners."""

    points: Floats
    """float64 [n, 3]."""
    triangles: Ints
    """int32 [m, 3], counter-clockwise seen from outside."""
    normals: Floats | None = None
    """float32 [m, 3, 3]."""
    uvs: Floats | None = None
    """float32 [m, 3, 2]."""


def box() -> Triangles:
    """The box of half-extents 1."""
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Triangles(corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.int32))


def plane(width: float, length: float) -> Triangles:
    """A plane at z = 0 that faces +Z; a size of 0 is infinite.

    What is large grows by squares, each twice as wide as the last: so triangles are small where things happen, and
    positions on them are precise.
    """
    if 0.0 < max(width, length) <= _SMALL_PLANE and min(width, length) > 0.0:
        x, y = 0.5 * width, 0.5 * length
        return Triangles(
            np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]]),
            np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        )
    steps = np.linspace(-1.0, 1.0, _PLANE_SIDE, endpoint=False)
    ones = np.ones(_PLANE_SIDE)
    square = np.concatenate(
        [np.stack(side, axis=1) for side in ((steps, -ones), (ones, steps), (-steps, ones), (-ones, -steps))]
    )
    squares = [square * PLANE_REACH * 0.5**k for k in reversed(range(_PLANE_SQUARES))]
    flat = np.concatenate([np.zeros((1, 2)), *squares])
    n = len(square)
    inner = [(0, 1 + k, 1 + (k + 1) % n) for k in range(n)]
    outer = [
        t
        for ring in range(len(squares) - 1)
        for k in range(n)
        for a, b in [(1 + ring * n + k, 1 + ring * n + (k + 1) % n)]
        for t in ((a, a + n, b + n), (a, b + n, b))
    ]
    limits = [0.5 * size if size > 0.0 else PLANE_REACH for size in (width, length)]
    points = np.concatenate([flat.clip(-np.array(limits), limits), np.zeros((len(flat), 1))], axis=1)
    triangles = np.array(inner + outer, np.int32)
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return Triangles(points, triangles[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0.0])


def sphere() -> Triangles:
    """The unit sphere."""
    theta = np.linspace(-0.5 * math.pi, 0.5 * math.pi, SEGMENTS // 2 + 1)
    return _lathe([np.stack([np.cos(theta), np.sin(theta), np.cos(theta), np.sin(theta)], axis=1)])


def capsule(radius: float, half_height: float) -> Triangles:
    """A cylinder along Z with hemispheres at its ends."""
    theta = np.linspace(0.0, 0.5 * math.pi, SEGMENTS // 4 + 1)
    top = np.stack([radius * np.cos(theta), half_height + radius * np.sin(theta), np.cos(theta), np.sin(theta)], axis=1)
    bottom = top[::-1] * np.array([1.0, -1.0, 1.0, -1.0])
    return _lathe([np.concatenate([bottom, top])])


def cylinder(barrel: float = 0.0) -> Triangles:
    """A cylinder of radius 1 and half height 1; `barrel` is the excess of the square of its radius in the middle.

    Barrels are those of Newton, cut-off ellipsoids: r² = 1 + barrel (1 - z²).
    """
    z = np.linspace(-1.0, 1.0, SEGMENTS // 4 + 1 if barrel > 0.0 else 2)
    r = np.sqrt(1.0 + barrel * (1.0 - z * z))
    side = np.stack([r, z, r, barrel * z], axis=1)
    side[:, 2:] /= np.linalg.norm(side[:, 2:], axis=1, keepdims=True)
    ends = [np.array([[0.0, s, 0.0, s], [1.0, s, 0.0, s]])[:: -1 if s > 0.0 else 1] for s in (-1.0, 1.0)]
    return _lathe([ends[0], side, ends[1]])


def cone(radius: float = 1.0, half_height: float = 1.0) -> Triangles:
    """A cone with its tip at +Z."""
    slope = np.array([2.0 * half_height, radius]) / math.hypot(2.0 * half_height, radius)
    base = np.array([[0.0, -half_height, 0.0, -1.0], [radius, -half_height, 0.0, -1.0]])
    return _lathe([base, np.array([[radius, -half_height, *slope], [0.0, half_height, *slope]])])


def _lathe(profiles: list[Floats]) -> Triangles:
    """A surface of revolution about Z, from profiles of rows (r, z, normal r, normal z) from bottom to top.

    The radius is larger by so much that the polygon around the axis has the area of the circle.
    """
    angle = 2.0 * math.pi / SEGMENTS
    grown = math.sqrt(angle / math.sin(angle))
    phi = angle * np.arange(SEGMENTS + 1)
    # A point of the side between two columns has the normal of the middle where both meet at the tip.
    points: list[Floats] = []
    triangles: list[Ints] = []
    normals: list[Floats] = []
    first = 0
    for profile in profiles:
        r, z, nr, nz = (profile[:, k][:, None] for k in range(4))
        ring = np.stack([grown * r * np.cos(phi), grown * r * np.sin(phi), z + 0.0 * phi], axis=2)
        outward = np.stack([nr * np.cos(phi), nr * np.sin(phi), nz + 0.0 * phi], axis=2)
        ring[:, -1], outward[:, -1] = ring[:, 0], outward[:, 0]
        rows, columns = np.meshgrid(np.arange(len(profile) - 1), np.arange(SEGMENTS), indexing="ij")
        a = (rows * (SEGMENTS + 1) + columns).reshape(-1)
        b, c, d = a + 1, a + SEGMENTS + 2, a + SEGMENTS + 1
        own = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
        flat, out = ring.reshape(-1, 3), outward.reshape(-1, 3)
        corners = flat[own]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        own = own[area > 1.0e-14 * np.abs(flat).max() ** 2]
        at_corner = out[own]
        _average_at_tips(own, flat, at_corner)
        points.append(flat)
        triangles.append(own + first)
        normals.append(at_corner)
        first += len(flat)
    return Triangles(
        np.concatenate(points), np.concatenate(triangles).astype(np.int32), np.concatenate(normals).astype(np.float32)
    )


def _average_at_tips(triangles: Ints, points: Floats, normals: Floats) -> None:
    """Gives corners on the axis the mean normal of the triangle's other two: there every direction meets."""
    on_axis = np.hypot(points[:, 0], points[:, 1])[triangles] < 1.0e-12
    for k in range(3):
        chosen = on_axis[:, k]
        mean = normals[chosen, (k + 1) % 3] + normals[chosen, (k + 2) % 3]
        length = np.linalg.norm(mean, axis=1, keepdims=True)
        vertical = np.abs(normals[chosen, k, 2:]) > 0.999999
        normals[chosen, k] = np.where(vertical, normals[chosen, k], mean / np.maximum(length, 1.0e-12))


def projected_uvs(shape: Triangles) -> Floats:
    """Texture coordinates of a shape without any: its local coordinates along the axis that a triangle mostly faces."""
    a, b, c = (shape.points[shape.triangles[:, k]] for k in range(3))
    n = np.abs(np.cross(b - a, c - a))
    corners = np.stack([a, b, c], axis=1)
    x = (n[:, 0] >= n[:, 1]) & (n[:, 0] >= n[:, 2])
    y = ~x & (n[:, 1] >= n[:, 2])
    axes = np.where(x[:, None], [1, 2], np.where(y[:, None], [0, 2], [0, 1]))
    return np.take_along_axis(corners, axes[:, None, :].repeat(3, axis=1), axis=2).astype(np.float32)
