"""The scene on a device: `upload_scene` puts it there, kernels see it as `SceneData`.

`upload.py` is the whole on one page; `records.py` says what is there.
"""

from warp_ir.device_scene.camera_data import CameraData, camera_data
from warp_ir.device_scene.frame import DeviceFrame
from warp_ir.device_scene.scene_data import INSTANCE_COLOR, TRIANGLE_EMITTER, SceneData, SurfaceTextures
from warp_ir.device_scene.upload import DeviceScene, upload_moments, upload_scene

__all__ = [
    "INSTANCE_COLOR",
    "TRIANGLE_EMITTER",
    "CameraData",
    "DeviceFrame",
    "DeviceScene",
    "SceneData",
    "SurfaceTextures",
    "camera_data",
    "upload_moments",
    "upload_scene",
]
