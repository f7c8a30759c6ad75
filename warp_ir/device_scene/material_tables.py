"""The tables of materials and textures."""

from collections.abc import Callable

import warp as wp

from warp_ir.bsdf import upload_albedo_table
from warp_ir.device.launcher import Launcher
from warp_ir.device_scene.scene_data import GlossRow, GlossTables, SceneData, SurfaceTextures
from warp_ir.scene import TEXTURED_GLOSS, Material, Texture
from warp_ir.texture import TextureTable

LARGEST_UV = 1.0e6
"""Texture coordinates are clamped to this magnitude: at a larger one float32 has no fractional digits to speak of."""


def upload_materials(
    materials: tuple[Material, ...],
    texture_table: Callable[[list[Texture]], TextureTable],
    data: SceneData,
    launcher: Launcher,
) -> SurfaceTextures:
    """Fills the tables of materials; returns the `SurfaceTextures`, whose texture coordinates the caller has to set.

    Args:
        materials: The scene's materials.
        texture_table: Uploads textures.
        data: The `SceneData` to fill.
        launcher: Launcher of the device.
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
    data.gloss_count = sum(m.gloss is not None for m in materials)
    surface_textures = SurfaceTextures()
    if data.gloss_count > 0:
        surface_textures.gloss = _gloss_tables(materials, row, launcher)
    surface_textures.textures = texture_table(textures)
    unset = (-1.0, -1.0, -1.0)
    surface_textures.camera_emission = launcher.array([unset if m.glow is None else m.glow for m in materials], wp.vec3)
    surface_textures.camera_emission_texture = launcher.array([row[m.glow_texture] for m in materials], wp.int32)
    data.camera_emission_count = sum(m.glow is not None for m in materials)
    surface_textures.normal_texture = launcher.array([row[m.normal_texture] for m in materials], wp.int32)
    return surface_textures


def _gloss_tables(materials: tuple[Material, ...], row: dict[Texture | None, int], launcher: Launcher) -> GlossTables:
    """The rows of all materials, and the albedo of microfacets."""
    rows = []
    for material in materials:
        out, gloss = GlossRow(), material.gloss
        if gloss is not None:
            out.enabled = 1
            out.f0 = ((1.0 - gloss.ior) / (1.0 + gloss.ior)) ** 2
            out.has_specular_color = int(gloss.specular_color is not None)
            for name in ("metallic", "specular_weight", "roughness", "clearcoat", "clearcoat_roughness"):
                setattr(out, name, getattr(gloss, name))
            out.base_color, out.specular_color = (
                wp.vec3(*gloss.base_color),
                wp.vec3(*(gloss.specular_color or (0,) * 3)),
            )
            for name in TEXTURED_GLOSS:
                setattr(out, f"{name}_texture", row[getattr(gloss, f"{name}_texture")])
        rows.append(out)
    tables = GlossTables()
    tables.rows = launcher.array(rows, GlossRow)
    tables.albedo = upload_albedo_table(launcher)
    return tables
