"""The scene on a device: `upload_scene` copies it there, kernels read it as `SceneData`.

`upload.py` is the upload on one page; `scene_data.py` defines the records.
"""

from warp_ir.device_scene.camera_data import CameraData, camera_data
from warp_ir.device_scene.emitter_table import FLOOR_SHARE, emitter_lifts, floored_probabilities, selection_cdf
from warp_ir.device_scene.frame import DeviceFrame, snapped_frame_of_box
from warp_ir.device_scene.geometry_storage import MeshBatch
from warp_ir.device_scene.geometry_update import DeviceGeometry
from warp_ir.device_scene.light_tables import upload_lights
from warp_ir.device_scene.scene_data import INSTANCE_COLOR, TRIANGLE_EMITTER, SceneData, SurfaceTextures
from warp_ir.device_scene.upload import DeviceScene, upload_scene, upload_scenes
from warp_ir.device_scene.validate import check_scene

__all__ = [
    "FLOOR_SHARE",
    "INSTANCE_COLOR",
    "TRIANGLE_EMITTER",
    "CameraData",
    "DeviceFrame",
    "DeviceGeometry",
    "DeviceScene",
    "MeshBatch",
    "SceneData",
    "SurfaceTextures",
    "camera_data",
    "check_scene",
    "emitter_lifts",
    "floored_probabilities",
    "selection_cdf",
    "snapped_frame_of_box",
    "upload_lights",
    "upload_scene",
    "upload_scenes",
]
