"""The tables of materials and textures."""

from collections.abc import Callable
from typing import Any

import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.device_scene.scene_data import SurfaceTextures
from warp_ir.scene import Material, Texture

LARGEST_UV = 1.0e6
"""Texture coordinates beyond are clamped: floats have no digits left for them."""


def upload_materials(
    materials: tuple[Material, ...], texture_table: Callable[[list[Texture]], Any], data: Any, launcher: Launcher
) -> Any:
    """Fills the tables of materials; returns the `SurfaceTextures`, in which the texture coordinates are still missing.

    Args:
        materials: Of the scene.
        texture_table: Puts textures on the device.
        data: The `SceneData`.
        launcher: Whose device it is for.
    """
    materials = materials or (Material(),)
    textures = list(dict.fromkeys(texture for material in materials for texture in material.textures))
    row: dict[Texture | None, int] = {texture: k for k, texture in enumerate(textures)} | {None: -1}
    data.albedo = launcher.array([m.albedo for m in materials], wp.vec3)
    data.emission = launcher.array([m.emission for m in materials], wp.vec3)
    data.opacity = launcher.array([m.opacity for m in materials], wp.float32)
    data.cutoff = launcher.array([m.cutoff for m in materials], wp.float32)
    data.albedo_texture = launcher.array([row[m.albedo_texture] for m in materials], wp.int32)
    data.emission_texture = launcher.array([row[m.emission_texture] for m in materials], wp.int32)
    data.opacity_texture = launcher.array([row[m.opacity_texture] for m in materials], wp.int32)
    data.non_opaque_count = sum(m.opacity < 1.0 for m in materials)
    data.texture_count = len(textures)
    data.normal_map_count = sum(m.normal_texture is not None for m in materials)
    surface_textures = SurfaceTextures()
    surface_textures.textures = texture_table(textures)
    unseen = (-1.0, -1.0, -1.0)
    surface_textures.glow = launcher.array([unseen if m.glow is None else m.glow for m in materials], wp.vec3)
    surface_textures.glow_texture = launcher.array([row[m.glow_texture] for m in materials], wp.int32)
    data.glow_count = sum(m.glow is not None for m in materials)
    surface_textures.normal_texture = launcher.array([row[m.normal_texture] for m in materials], wp.int32)
    return surface_textures
