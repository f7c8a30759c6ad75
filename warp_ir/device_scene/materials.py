"""The tables of materials and textures."""

from typing import Any

import numpy as np
import warp as wp

from warp_ir.device_scene.corners import upload_corners
from warp_ir.device_scene.records import Patterns
from warp_ir.launch import Launcher
from warp_ir.scene import Material, Mesh, Texture
from warp_ir.texture import upload_textures

LARGEST_UV = 1.0e6
"""Texture coordinates beyond are clamped: floats have no digits left for them."""


def upload_materials(
    materials: tuple[Material, ...], meshes: list[Mesh], counts: list[int], data: Any, launcher: Launcher
) -> Any:
    """Fills the tables of materials and textures, and the uv sets that the textures use; returns their owner."""
    textures = list(dict.fromkeys(texture for material in materials for texture in material.textures))
    row: dict[Texture | None, int] = {texture: k for k, texture in enumerate(textures)} | {None: -1}
    uv_sets = list(dict.fromkeys(texture.uv for texture in textures))
    data.albedo = launcher.array([m.albedo for m in materials], wp.vec3)
    data.emission = launcher.array([m.emission for m in materials], wp.vec3)
    data.opacity = launcher.array([m.opacity for m in materials], wp.float32)
    data.cutoff = launcher.array([m.cutoff for m in materials], wp.float32)
    data.albedo_texture = launcher.array([row[m.albedo_texture] for m in materials], wp.int32)
    data.emission_texture = launcher.array([row[m.emission_texture] for m in materials], wp.int32)
    data.opacity_texture = launcher.array([row[m.opacity_texture] for m in materials], wp.int32)
    data.open_count = sum(m.opacity < 1.0 for m in materials)
    data.texture_count = len(textures)
    data.normal_map_count = sum(m.normal_texture is not None for m in materials)
    patterns = Patterns()
    patterns.normal_texture = launcher.array([row[m.normal_texture] for m in materials], wp.int32)
    patterns.textures = upload_textures(textures, uv_sets, launcher)
    corners: list[Any] = []
    for mesh in meshes:
        sets = [mesh.uvs.get(name) for name in uv_sets]
        if all(s is None for s in sets):
            corners.append(None)
        else:
            zero = np.zeros((len(mesh.triangles), 3, 2), np.float32)
            chosen = np.stack([zero if s is None else s for s in sets], axis=1)
            corners.append(np.asarray(chosen, np.float32).clip(-LARGEST_UV, LARGEST_UV))
    rows = 3 * max(len(uv_sets), 1)
    patterns.triangle_uvs, patterns.corner_uvs = upload_corners(corners, counts, launcher, wp.vec2, rows)
    data.patterns = launcher.array([patterns], Patterns)
    return patterns
