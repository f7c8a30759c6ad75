"""Camera controls as pure functions, from a camera to a camera. Angles are in radians, lengths in scene units."""

import math
from dataclasses import replace

import numpy as np

from warp_ir.scene import Camera, Floats, Projection

_POLE = math.radians(1.0)
"""Smallest angle between the viewing direction and the up axis: at the pole itself left and right are undefined."""
_MARGIN = 1.1
"""Size of the frame around what `framed` shows, relative to it."""


def orbit(camera: Camera, pivot: Floats, up: Floats, right: float, upwards: float) -> Camera:
    """Turns the camera around a point [3]: about the up axis [3], and towards or away from its pole."""
    turn = _turn(camera, up, -right, -upwards)
    matrix = camera.world_from_camera.copy()
    matrix[:3, :3] = turn @ matrix[:3, :3]
    matrix[:3, 3] = pivot + turn @ (matrix[:3, 3] - pivot)
    return replace(camera, world_from_camera=matrix)


def look_around(camera: Camera, up: Floats, right: float, upwards: float) -> Camera:
    """Turns the viewing direction of a camera that stays where it is."""
    matrix = camera.world_from_camera.copy()
    matrix[:3, :3] = _turn(camera, up, -right, -upwards) @ matrix[:3, :3]
    return replace(camera, world_from_camera=matrix)


def pan(camera: Camera, pivot: Floats, right: float, upwards: float) -> Camera:
    """Moves the camera in the plane of its picture, by fractions of the picture's height where the pivot [3] is."""
    height = camera.window[3] - camera.window[2]
    if camera.projection == Projection.PERSPECTIVE:
        height *= max(_depth(camera, pivot), 1e-9)
    return move(camera, right * height, upwards * height, 0.0)


def dolly(camera: Camera, pivot: Floats, factor: float) -> Camera:
    """Moves the camera along its axis until the depth of the pivot [3] is multiplied by a factor.

    An orthographic camera stays, and its window is scaled.
    """
    if camera.projection == Projection.ORTHOGRAPHIC:
        left, right, bottom, top = camera.window
        x, y = 0.5 * (left + right), 0.5 * (bottom + top)
        half_x, half_y = 0.5 * factor * (right - left), 0.5 * factor * (top - bottom)
        return replace(camera, window=(x - half_x, x + half_x, y - half_y, y + half_y))
    return move(camera, 0.0, 0.0, (1.0 - factor) * _depth(camera, pivot))


def move(camera: Camera, right: float, upwards: float, forward: float) -> Camera:
    """Moves the camera along its own axes."""
    matrix = camera.world_from_camera.copy()
    matrix[:3, 3] += matrix[:3, :3] @ (right, upwards, -forward)
    return replace(camera, world_from_camera=matrix)


def walk(camera: Camera, up: Floats, right: float, upwards: float, forward: float) -> Camera:
    """Moves the camera as a person walks: along the ground, wherever it looks, and along the up axis [3]."""
    matrix = camera.world_from_camera.copy()
    ahead = -matrix[:3, 2] + up * float(up @ matrix[:3, 2])
    if np.linalg.norm(ahead) < math.sin(_POLE):  # it looks straight up or down
        ahead = matrix[:3, 1] - up * float(up @ matrix[:3, 1])
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    matrix[:3, 3] += forward * ahead + right * np.cross(ahead, up) + upwards * up
    return replace(camera, world_from_camera=matrix)


def framed(camera: Camera, lower: Floats, upper: Floats) -> Camera:
    """The camera moved, without turning, so that a box with corners [3] fills its picture."""
    centre, radius = 0.5 * (lower + upper), 0.5 * _MARGIN * max(float(np.linalg.norm(upper - lower)), 1e-9)
    left, right, bottom, top = camera.window
    half = 0.5 * min(right - left, top - bottom)
    matrix = camera.world_from_camera.copy()
    if camera.projection == Projection.ORTHOGRAPHIC:
        k = radius / half
        matrix[:3, 3] = centre + 2.0 * radius * matrix[:3, 2]
        return replace(camera, world_from_camera=matrix, window=(k * left, k * right, k * bottom, k * top))
    distance = radius / math.sin(math.atan(half))
    middle = matrix[:3, :3] @ (0.5 * (left + right), 0.5 * (bottom + top), -1.0)
    matrix[:3, 3] = centre - distance * middle
    return replace(camera, world_from_camera=matrix)


def centre_at(camera: Camera, depth: float) -> Floats:
    """The point [3] in the middle of the picture at a depth."""
    left, right, bottom, top = camera.window
    x, y = 0.5 * (left + right), 0.5 * (bottom + top)
    scale = depth if camera.projection == Projection.PERSPECTIVE else 1.0
    matrix = camera.world_from_camera
    return np.asarray(matrix[:3, 3] + matrix[:3, :3] @ (x * scale, y * scale, -depth))


def _depth(camera: Camera, point: Floats) -> float:
    return float((camera.world_from_camera[:3, 3] - point) @ camera.world_from_camera[:3, 2])


def _turn(camera: Camera, up: Floats, about_up: float, about_right: float) -> Floats:
    """The rotation [3, 3] about the up axis, after one that lifts the camera's back; the latter stops at the poles."""
    back, right, top = camera.world_from_camera[:3, 2], camera.world_from_camera[:3, 0], camera.world_from_camera[:3, 1]
    if abs(float(up @ right)) < math.sin(_POLE) and float(up @ top) >= 0.0:  # a camera that is rolled turns freely
        polar = math.acos(min(max(float(up @ back), -1.0), 1.0))
        about_right = min(max(about_right, polar + _POLE - math.pi), polar - _POLE)
    return _rotation(up, about_up) @ _rotation(right, -about_right)


def _rotation(axis: Floats, angle: float) -> Floats:
    """The rotation matrix [3, 3] about a unit axis [3] (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross))
