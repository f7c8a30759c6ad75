"""The coordinate frame of the scene on the device: centred and scaled, so that float32 is precise for any scene.

The origin is near the centre of the scene's bounding box, and a power of two scales the extent to between 1/2 and 1.
Radiance is invariant under scaling and a power of two rounds nothing: so a scene in millimetres, or far from the
world's origin, is as precise as any other, and no other module depends on the scale.

If that is too coarse for what the camera sees, because something lies far away, the frame is instead that of the ball
that holds the details in view: floats are fine there, and far geometry has large coordinates.

A prototype has a frame of its own, made the same way; its instances are matrices from there to the scene's frame.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from warp_ir.scene import Camera, Projection, Scene

_COARSE = 1024.0
"""Extent of the scene, relative to the width of the view at a mesh, above which float32 is too coarse for it: rounding
moves a hit point by up to 8 ulp, half a pixel of a thousand."""
_VISIBLE = 1.0 / 512.0
"""Radius of a mesh in the picture, relative to half the picture's width, below which it is not resolved."""
_TELEPHOTO = 1.0 / 128.0
"""Half the width of the film at distance 1, below which rounding in a frame around the lens would be seen."""
_LARGEST_COORDINATE = 4096.0
"""Coordinate in the device frame above which 8 ulp of a triangle are about four pixels of a thousand in view."""
FOCUS_RADIUS = 0.5625
"""Radius in the device frame of the ball of details: 1/2, and what snapping the origin to the grid may shift it by."""
_GRID = 32.0
"""Grid points for the origin per unit of length in the device frame."""


@dataclass(frozen=True, eq=False)
class DeviceFrame:
    """The transform from world to device: device = (world - origin) * scale, where scale is a power of two."""

    origin: npt.NDArray[np.float64]
    scale: float

    def equals(self, other: "DeviceFrame") -> bool:
        """Whether two frames are bitwise equal."""
        return self.scale == other.scale and bool((self.origin == other.origin).all())

    def to_device(self, points: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Transforms world positions [..., 3] to the device's frame, float32."""
        return ((np.asarray(points, np.float64) - self.origin) * self.scale).astype(np.float32)

    def to_world(self, points: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Transforms device positions [..., 3] to world space, float64."""
        return np.asarray(points, np.float64) / self.scale + self.origin


def frame_of_box(lower: npt.NDArray[np.floating], upper: npt.NDArray[np.floating]) -> DeviceFrame:
    """The frame in which a box with corners [3] is centred and has a diagonal between 1/2 and 1."""
    extent = float(np.linalg.norm(upper - lower))
    # frexp is exact: a logarithm could round to either of two scales for an extent of exactly 2^k.
    return DeviceFrame(0.5 * (lower + upper), 2.0 ** -math.frexp(extent)[1] if extent > 0.0 else 1.0)


def snapped_frame_of_box(lower: npt.NDArray[np.floating], upper: npt.NDArray[np.floating]) -> DeviceFrame:
    """`frame_of_box` with its origin snapped to a grid, within 1/64 of the box's centre in each axis.

    So the frame, and with it all static geometry, stays the same while something moves a little and changes the box.
    """
    exact = frame_of_box(lower, upper)
    unit = exact.scale * _GRID
    return DeviceFrame(np.round(exact.origin * unit) / unit, exact.scale)


def frame_of_view(scene: Scene, extent: float) -> DeviceFrame | None:
    """The frame around the details that the camera sees; None: that of the bounding box is precise enough for them.

    Errors of float32 grow with the distance from the origin, and so does what a pixel covers with that from the lens.
    A perspective camera is therefore the best origin, unless its angle is tiny; else it is the median of what it sees.
    """
    camera = scene.camera
    left, right, bottom, top = camera.window
    half = 0.5 * max(right - left, top - bottom)
    balls = scene.balls()
    if not (len(balls) and half > 0.0 and np.isfinite(camera.world_from_camera).all()):
        return None
    local = (balls[:, :3] - camera.world_from_camera[:3, 3]) @ camera.world_from_camera[:3, :3]
    depth, radius = -local[:, 2], balls[:, 3]
    perspective = camera.projection == Projection.PERSPECTIVE
    distance = np.maximum(depth, radius) if perspective else np.ones(len(balls))
    size = radius / np.maximum(distance * half, 1.0e-300)
    visible = _in_view(camera, local, radius, perspective) & (size > _VISIBLE)
    if not visible.any():
        return None
    focus = np.zeros(3)
    if not perspective or half < _TELEPHOTO:
        z = _weighted_median(depth[visible], np.minimum(size[visible], 1.0) ** 2)
        across = z if perspective else 1.0
        focus = np.array([0.5 * (left + right) * across, 0.5 * (bottom + top) * across, -z])
    reach = np.linalg.norm(local - focus, axis=1) + radius
    width = 2.0 * half * (np.maximum(depth, reach if focus[2] == 0.0 else radius) if perspective else 1.0)
    details = visible & (extent > _COARSE * width) & (extent > _COARSE / 16.0 * reach)
    if not details.any():
        return None
    world = camera.world_from_camera[:3, :3] @ focus + camera.world_from_camera[:3, 3]
    ball = float(reach[details].max())
    return snapped_frame_of_box(world - ball / math.sqrt(3.0), world + ball / math.sqrt(3.0))


def coarse_meshes(scene: Scene, frame: DeviceFrame) -> tuple[str, ...]:
    """Names of meshes of the world with triangles so large that their rounding is seen in the ball of details.

    A triangle is as precise as its own coordinates: an end far away makes it coarse everywhere.
    """
    instanced = scene.instanced()
    names: list[str] = []
    for k, mesh in enumerate(scene.meshes):
        if k in instanced or not len(mesh.triangles):
            continue
        corners = frame.to_device(mesh.points)[mesh.triangles]
        reaches = (corners.min(axis=1) < FOCUS_RADIUS).all(axis=1) & (corners.max(axis=1) > -FOCUS_RADIUS).all(axis=1)
        if (reaches & (np.abs(corners).max(axis=(1, 2)) > _LARGEST_COORDINATE)).any():
            names.append(mesh.name)
    return tuple(names)


def _in_view(
    camera: Camera, local: npt.NDArray[np.float64], radius: npt.NDArray[np.floating], perspective: bool
) -> npt.NDArray[np.bool_]:
    """Whether balls with centres [n, 3] in the camera's space may be inside its frustum."""
    left, right, bottom, top = camera.window
    depth = -local[:, 2]
    near, far = camera.clipping
    visible = (depth + radius > max(near, 0.0)) & (depth - radius < far)
    across = np.maximum(depth, 0.0) if perspective else np.ones(len(local))
    slack = radius * (1.0 + max(abs(left), abs(right), abs(bottom), abs(top)) if perspective else 1.0)
    for axis, (low, high) in enumerate(((left, right), (bottom, top))):
        visible &= (local[:, axis] + slack > low * across) & (local[:, axis] - slack < high * across)
    return np.asarray(visible)


def _weighted_median(values: npt.NDArray[np.float64], weights: npt.NDArray[np.float64]) -> float:
    order = np.argsort(values, kind="stable")
    cumulative = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(cumulative, 0.5 * cumulative[-1])])
