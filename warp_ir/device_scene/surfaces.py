"""The tables of triangles, and what rays find them by."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.bvh import build_bvhs
from warp_ir.device_scene.corners import upload_corners
from warp_ir.device_scene.frame import DeviceFrame
from warp_ir.device_scene.instances import upload_instances
from warp_ir.device_scene.materials import upload_materials
from warp_ir.device_scene.storage import Storage
from warp_ir.launch import Launcher
from warp_ir.scene import Material, Scene


def upload_surfaces(scene: Scene, numbers: Sequence[int], frame: DeviceFrame, data: Any, launcher: Launcher) -> Any:
    """Fills the geometry and material tables; returns the owners of what they refer to by id."""
    meshes = [m for m in scene.meshes if len(m.triangles)]
    data.triangle_count = sum(len(m.triangles) for m in meshes)
    storage = Storage(scene, frame)
    material = np.concatenate([m.material for m in meshes]) if meshes else np.zeros(1)
    data.points = launcher.array(storage.points, wp.vec3)
    data.indices = launcher.array(storage.indices, wp.int32)
    data.triangle_material = launcher.array(material.astype(np.int32), wp.int32)
    source = [numbers[k] for k, m in enumerate(scene.meshes) if len(m.triangles)]
    counts = [len(m.triangles) for m in meshes]
    data.triangle_mesh = launcher.array(np.repeat(source, counts).astype(np.int32) if meshes else [-1], wp.int32)
    data.emits_back = launcher.array(
        np.repeat([m.double_sided for m in meshes], counts).astype(np.int32) if meshes else [0], wp.int32
    )
    bare = _colored_by_instance(scene, counts)
    data.triangle_normals, data.corner_normals = upload_corners([m.normals for m in meshes], counts, launcher)
    data.triangle_colors, data.corner_colors = upload_corners(
        [m.colors for m in meshes], counts, launcher, from_instance=bare
    )
    patterns = upload_materials(scene.materials or (Material(),), meshes, counts, data, launcher)
    parts = [(data.points, data.indices)]
    if scene.instances:
        parts = [
            (launcher.array(storage.points[p], wp.vec3), launcher.array(storage.indices[t] - p.start, wp.int32))
            for p, t in storage.parts
        ]
        if not storage.parts[0][0].stop:
            parts[0] = (launcher.zeros(3, wp.vec3), launcher.array([0, 1, 2], wp.int32))
    data.bvh, roots, owner = build_bvhs(parts, launcher)
    return owner, patterns, upload_instances(scene, frame, storage, roots, data, launcher)


def _colored_by_instance(scene: Scene, counts: Sequence[int]) -> npt.NDArray[np.bool_] | None:
    """Which triangles [m] have the colour of their instance; None: none has."""
    colored = {k for group in scene.instances if group.colors is not None for k in group.meshes}
    meshes = [(m, k in colored and m.bare is not None) for k, m in enumerate(scene.meshes) if len(m.triangles)]
    if not any(takes for _, takes in meshes):
        return None
    rows = [m.bare if takes else np.zeros(c, bool) for (m, takes), c in zip(meshes, counts, strict=True)]
    return np.concatenate(rows)
