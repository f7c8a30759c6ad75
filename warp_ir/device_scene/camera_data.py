"""The record in which kernels read the camera."""

import numpy as np
import warp as wp

from warp_ir.device_scene.frame import DeviceFrame
from warp_ir.scene import MAX_CLIPPING_PLANES, Camera, InputError, Projection
from warp_ir.settings import RenderSettings

wp.set_module_options({"enable_backward": False})


Planes = wp.types.matrix(shape=(MAX_CLIPPING_PLANES, 4), dtype=wp.float32)
"""One clipping plane per row, n and d: a point p is visible if n·(p - origin) + d >= 0."""


@wp.struct
class CameraData:
    """A camera in the scene's device frame, and the pixels of its film."""

    columns: int  # of the film: the whole image, or the data window within it
    rows: int
    first_column: int  # of the film within the image
    first_row: int
    image_columns: int
    image_rows: int
    visible_lights: int  # 1: analytic lights are visible
    origin: wp.vec3
    right: wp.vec3  # the camera's +X, +Y and +Z axis; its viewing direction is -Z
    up: wp.vec3
    back: wp.vec3
    left: float  # the window in the plane z = -1 (perspective), or in device units (orthographic)
    bottom: float
    width: float
    height: float
    near: float  # clipping range of the depth along -Z
    far: float
    plane_count: int  # clipping planes
    planes: Planes
    orthographic: int
    lens_radius: float  # 0: a pinhole
    focus_distance: float  # depth of the plane in focus
    blurs: int  # 1: the picture has defocus or motion blur


def camera_data(camera: Camera, frame: DeviceFrame, settings: RenderSettings) -> CameraData:
    """The `CameraData` of a camera fitted to the image that the settings describe; `settings.height` must be set.

    Raises:
        InputError: The window is empty, or a value is not finite or out of range.
    """
    assert settings.height is not None
    if not (np.isfinite(camera.world_from_camera).all() and np.isfinite(camera.window).all()):
        raise InputError(f"camera {camera.name!r}: transform and window must be finite")
    left, right, bottom, top = camera.window
    if not (right > left and top > bottom):
        raise InputError(f"camera {camera.name!r}: the window is empty")
    perspective = camera.projection == Projection.PERSPECTIVE
    lens = camera.lens_radius if perspective and settings.depth_of_field else 0.0
    if not (0.0 <= lens < np.inf and (lens == 0.0 or camera.focus_distance > 0.0)):
        raise InputError(f"camera {camera.name!r}: lens_radius must be finite, and focus_distance positive")
    fitted = camera.fit(settings.width, settings.height, settings.conform, settings.pixel_aspect)
    left, right, bottom, top = fitted.window
    unit = 1.0 if perspective else frame.scale
    out = CameraData()
    out.first_column, out.first_row, out.columns, out.rows = settings.pixels()
    out.image_columns, out.image_rows = settings.width, settings.height
    out.visible_lights = int(settings.visible_lights)
    with np.errstate(over="ignore"):
        origin = frame.to_device(camera.world_from_camera[:3, 3])
    if not np.isfinite(origin).all():
        raise InputError(f"camera {camera.name!r}: it is too far from the scene")
    out.origin = wp.vec3(*origin)
    out.right, out.up, out.back = (wp.vec3(*camera.world_from_camera[:3, k]) for k in range(3))
    out.left, out.bottom = left * unit, bottom * unit
    out.width, out.height = (right - left) * unit, (top - bottom) * unit
    out.near = camera.clipping[0] * frame.scale
    out.far = min(camera.clipping[1] * frame.scale, 3.0e38)
    out.plane_count, out.planes = len(camera.clipping_planes), _planes(camera, frame)
    out.orthographic = int(not perspective)
    out.lens_radius, out.focus_distance = lens * frame.scale, min(camera.focus_distance * frame.scale, 3.0e38)
    out.blurs = int(lens > 0.0)
    return out


def _planes(camera: Camera, frame: DeviceFrame) -> Planes:
    """The clipping planes in the device frame, with unit normals."""
    table = np.zeros((MAX_CLIPPING_PLANES, 4))
    if len(camera.clipping_planes) > len(table):
        raise InputError(f"camera {camera.name!r}: has more than {len(table)} clipping planes")
    for k, plane in enumerate(camera.clipping_planes):
        scale = max(float(np.linalg.norm(plane[:3])), 1.0e-30)
        table[k, :3] = camera.world_from_camera[:3, :3] @ np.array(plane[:3]) / scale
        table[k, 3] = np.clip(plane[3] / scale * frame.scale, -1.0e30, 1.0e30)
    if not np.isfinite(table).all():
        raise InputError(f"camera {camera.name!r}: clipping planes must be finite")
    return Planes(*table.ravel().tolist())
