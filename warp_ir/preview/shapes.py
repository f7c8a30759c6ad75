"""Discs of VPLs, lines of light paths, outlines of lights and cameras: PyVista's records of what is drawn."""

import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from warp_ir.scene import Camera, Light, LightKind, Projection, Scene

if TYPE_CHECKING:
    import pyvista

Floats = npt.NDArray[np.floating]

_SIDES = 10
"""Corners of a disc."""
_OFFSET = 0.15
"""Distance of a disc from its surface, in its radius: a surface that is nearly parallel does not hide it."""

_OCTAHEDRON = np.array(
    [
        [[x, 0.0, 0.0], [0.0, y, 0.0], [0.0, 0.0, z]][:: int(x * y * z)]
        for x in (1.0, -1.0)
        for y in (1.0, -1.0)
        for z in (1.0, -1.0)
    ]
).reshape(24, 3)
"""Corners of the eight triangles, counter-clockwise seen from outside."""


def vpl_shapes(positions: Floats, normals: Floats, radius: Floats) -> "pyvista.PolyData":
    """A disc for each VPL, whose front is the side that shines; an octahedron where it shines in all directions.

    The cell data "vpl" are the indices of the VPLs, 0 to n - 1.

    Args:
        positions: [n, 3], world space.
        normals: [n, 3], unit, or zero.
        radius: [n].
    """
    import pyvista

    normals, radius = np.asarray(normals, np.float64), np.asarray(radius)[:, None, None]
    everywhere = ~normals.any(axis=1)
    flat, round_ = np.flatnonzero(~everywhere), np.flatnonzero(everywhere)
    normal = normals[flat]
    helper = np.where(np.abs(normal[:, :1]) > 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    tangent = np.cross(helper, normal)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1), 1e-300)[:, None]
    bitangent = np.cross(normal, tangent)
    angle = 2.0 * math.pi * np.arange(_SIDES) / _SIDES
    ring = np.cos(angle)[None, :, None] * tangent[:, None] + np.sin(angle)[None, :, None] * bitangent[:, None]
    discs = positions[flat][:, None] + radius[flat] * (ring + _OFFSET * normal[:, None])
    balls = positions[round_][:, None] + radius[round_] * _OCTAHEDRON
    faces = np.concatenate([_faces(len(flat), _SIDES, 0), _faces(8 * len(round_), 3, discs.size // 3)])
    shapes = pyvista.PolyData(np.concatenate([discs.reshape(-1, 3), balls.reshape(-1, 3)]), faces)
    shapes.cell_data["vpl"] = np.concatenate([flat, np.repeat(round_, 8)])
    return shapes


def _faces(count: int, corners: int, first: int) -> npt.NDArray[np.int64]:
    """VTK's list of `count` polygons of as many corners, which follow each other in the points from `first` on."""
    indices = first + np.arange(count * corners).reshape(count, corners)
    return np.column_stack([np.full(count, corners), indices]).ravel()


def path_lines(
    positions: Floats,
    parent: npt.NDArray[np.integer],
    directional: npt.NDArray[np.bool_],
    shown: npt.NDArray[np.intp],
    size: float,
) -> "pyvista.PolyData":
    """A line to each VPL shown from the vertex before; from a directional VPL, a line of the length `size`."""
    parent = np.asarray(parent)
    ends = shown[parent[shown] >= 0]
    begins = parent[ends]
    start = np.asarray(positions)[begins]
    end = np.asarray(positions)[ends]
    start = np.where(np.asarray(directional)[begins][:, None], end + size * start, start)
    return _lines(start, end)


def lines_to(origin: Floats, positions: Floats, directional: npt.NDArray[np.bool_], size: float) -> "pyvista.PolyData":
    """A line from one point to each VPL; of the length `size` towards a directional one."""
    origin = np.asarray(origin, np.float64)
    ends = np.where(np.asarray(directional)[:, None], origin + size * positions, positions)
    return _lines(np.broadcast_to(origin, ends.shape), ends)


def camera_lines(camera: Camera, size: float) -> "pyvista.PolyData":
    """The edges of the pyramid (or box) that a camera sees, down to a depth of `size`."""
    left, right, bottom, top = camera.window
    corners = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
    if camera.projection == Projection.PERSPECTIVE:
        near, far = np.zeros((4, 2)), corners * size
    else:
        near, far = corners, corners
    near = np.concatenate([near, np.zeros((4, 1))], axis=1)
    far = np.concatenate([far, np.full((4, 1), -size)], axis=1)
    matrix = camera.world_from_camera
    near, far = (x @ matrix[:3, :3].T + matrix[:3, 3] for x in (near, far))
    return _lines(np.concatenate([near, far]), np.concatenate([far, np.roll(far, -1, axis=0)]))


def light_outlines(scene: Scene, size: float) -> "list[pyvista.PolyData]":
    """The shapes of the lights, as wireframes; suns and skies have none."""
    outlines = []
    for light in scene.lights:
        loops = _loops(light, size)
        if loops:
            start = np.concatenate(loops)
            end = np.concatenate([np.roll(loop, -1, axis=0) for loop in loops])
            matrix = light.world_from_light
            outlines.append(_lines(*(x @ matrix[:3, :3].T + matrix[:3, 3] for x in (start, end))))
    return outlines


def _loops(light: Light, size: float) -> list[Floats]:
    """Closed lines that outline a light, each [n, 3], in its local space."""
    angle = 2.0 * math.pi * np.arange(24) / 24
    zero, cosine, sine = np.zeros(24), np.cos(angle), np.sin(angle)
    if light.kind == LightKind.RECT:
        w, h = 0.5 * light.width, 0.5 * light.height
        return [np.array([[-w, -h, 0.0], [w, -h, 0.0], [w, h, 0.0], [-w, h, 0.0]])]
    if light.kind == LightKind.DISK:
        return [light.radius * np.stack([cosine, sine, zero], axis=1)]
    if light.kind == LightKind.CYLINDER:
        circle = np.stack([zero, light.radius * cosine, light.radius * sine], axis=1)
        return [np.add(circle, [x, 0.0, 0.0]) for x in (-0.5 * light.length, 0.0, 0.5 * light.length)]
    if light.kind in (LightKind.SPHERE, LightKind.POINT):
        scale = max(float(np.abs(np.linalg.det(light.world_from_light[:3, :3])) ** (1 / 3)), 1e-30)
        radius = light.radius if light.kind == LightKind.SPHERE else 0.005 * size / scale
        circles = (cosine, sine, zero), (cosine, zero, sine), (zero, cosine, sine)
        return [radius * np.stack(circle, axis=1) for circle in circles]
    return []


def _lines(start: Floats, end: Floats) -> "pyvista.PolyData":
    """Line segments from start [n, 3] to end [n, 3]."""
    import pyvista

    n = len(start)
    if n == 0:
        return pyvista.PolyData()
    points = np.stack([start, end], axis=1).reshape(-1, 3)
    cells = np.column_stack([np.full(n, 2), np.arange(0, 2 * n, 2), np.arange(1, 2 * n, 2)])
    return pyvista.PolyData(points, lines=cells.ravel())
