"""Material parameters at a point of a surface: alpha, albedo, and emission, textured or per corner."""

import warp as wp

from warp_ir.bsdf import Bsdf
from warp_ir.device_scene import INSTANCE_COLOR, SceneData, SurfaceTextures
from warp_ir.surface.hit import Hit, scene_at
from warp_ir.texture import lookup, mip_level, uv_to_st

wp.set_module_options({"enable_backward": False})

_INSTANCE_COLOR = wp.constant(INSTANCE_COLOR)


@wp.func
def uv_at(surface_textures: SurfaceTextures, triangle: int, uv_set: int, u: float, v: float) -> wp.vec3:
    """Texture coordinates (u, v) at a point of a triangle; third, the area of the triangle in the uv plane."""
    row = surface_textures.triangle_uvs[triangle]
    if row < 0:
        return wp.vec3(0.0)
    row += 3 * uv_set
    a = surface_textures.corner_uvs[row]
    b = surface_textures.corner_uvs[row + 1]
    c = surface_textures.corner_uvs[row + 2]
    uv = u * a + v * b + (1.0 - u - v) * c
    ab = b - a
    ac = c - a
    return wp.vec3(uv[0], uv[1], 0.5 * wp.abs(ab[0] * ac[1] - ab[1] * ac[0]))


@wp.func(inline=False)  # inlined, its code would be copied into every caller, for scenes without textures too
def _texture_at(
    surface_textures: wp.array[SurfaceTextures],
    texture: int,
    triangle: int,
    u: float,
    v: float,
    area: float,
    footprint: float,
) -> wp.vec3:
    """A texture at a point of a triangle, as the mean over a patch of width `footprint`; 0: unfiltered."""
    p = surface_textures[0]
    row = p.textures.rows[texture]
    uv = uv_at(p, triangle, row.uv_set, u, v)
    level = mip_level(p.textures, row, uv[2] / area, footprint)
    return lookup(p.textures, row, uv_to_st(row, wp.vec2(uv[0], uv[1])), level)


@wp.func
def alpha_at(scene: SceneData, triangle: int, u: float, v: float) -> float:
    """Alpha at a point of a triangle: its opacity, or 0 or 1 if the material has a cutoff."""
    material = scene.triangle_material[triangle]
    opacity = scene.opacity[material]
    if opacity >= 1.0:
        return 1.0
    if scene.opacity_texture[material] >= 0:
        opacity = _texture_at(scene.surface_textures, scene.opacity_texture[material], triangle, u, v, 1.0, 0.0)[0]
    cutoff = scene.cutoff[material]
    if cutoff > 0.0:
        return wp.where(opacity < cutoff, 0.0, 1.0)
    return opacity


@wp.func
def albedo(scene: SceneData, hit: Hit, footprint: float) -> wp.vec3:
    """Hemispherical reflectance ρ at a hit, a texture as the mean over a patch of width `footprint`."""
    material = scene.triangle_material[hit.triangle]
    if scene.texture_count > 0:
        if scene.albedo_texture[material] >= 0:
            value = _texture_at(
                scene.surface_textures, scene.albedo_texture[material], hit.triangle, hit.u, hit.v, hit.area, footprint
            )
            if scene.tinted == 1 and scene.triangle_colors[hit.triangle] == _INSTANCE_COLOR:
                value = wp.cw_mul(value, scene.instance_colors[hit.instance])
            return value
    row = scene.triangle_colors[hit.triangle]
    if row == _INSTANCE_COLOR:
        return scene.instance_colors[hit.instance]
    if row < 0:
        return scene.albedo[material]
    return (
        hit.u * scene.corner_colors[row]
        + hit.v * scene.corner_colors[row + 1]
        + (1.0 - hit.u - hit.v) * scene.corner_colors[row + 2]
    )


@wp.func
def emission_at(scene: SceneData, triangle: int, u: float, v: float, area: float, footprint: float) -> wp.vec3:
    """Radiance [W sr⁻¹ m⁻²] that the emitting side of a triangle emits at a point, not multiplied by alpha."""
    material = scene.triangle_material[triangle]
    if scene.texture_count > 0:
        if scene.emission_texture[material] >= 0:
            return _texture_at(
                scene.surface_textures, scene.emission_texture[material], triangle, u, v, area, footprint
            )
    return scene.emission[material]


@wp.func
def emission(scene: SceneData, hit: Hit, footprint: float) -> wp.vec3:
    """Radiance [W sr⁻¹ m⁻²] that a surface emits towards the origin of the ray that hit it."""
    if hit.front == 1 or scene.emits_back[hit.triangle] == 1:
        return emission_at(scene, hit.triangle, hit.u, hit.v, hit.area, footprint)
    return wp.vec3(0.0)


@wp.func
def has_camera_emission(scene: SceneData, triangle: int) -> bool:
    """Whether the camera sees another radiance of a triangle than the `emission` that illuminates the scene."""
    if scene.camera_emission_count == 0:
        return False
    return scene.surface_textures[0].camera_emission[scene.triangle_material[triangle]][0] >= 0.0


@wp.func
def camera_emission(scene: SceneData, hit: Hit, footprint: float) -> wp.vec3:
    """Emission [W sr⁻¹ m⁻²] seen by the camera where `has_camera_emission`."""
    if hit.front == 0 and scene.emits_back[hit.triangle] == 0:
        return wp.vec3(0.0)
    material = scene.triangle_material[hit.triangle]
    texture = scene.surface_textures[0].camera_emission_texture[material]
    if texture >= 0:
        return _texture_at(scene.surface_textures, texture, hit.triangle, hit.u, hit.v, hit.area, footprint)
    return scene.surface_textures[0].camera_emission[material]


@wp.func
def _gloss_texture(scene: SceneData, hit: Hit, texture: int, constant: wp.vec3, footprint: float) -> wp.vec3:
    """A parameter of the gloss: a texture, if there is one."""
    if texture < 0:
        return constant
    return _texture_at(scene.surface_textures, texture, hit.triangle, hit.u, hit.v, hit.area, footprint)


@wp.func(inline=False)
def bsdf_at(address: wp.uint64, hit: Hit, footprint: float) -> Bsdf:
    """The parameters of what a hit reflects, textures as means over a patch of width `footprint`.

    In scenes whose `gloss_count` is not 0. Of the workflows of UsdPreviewSurface, the metallic one has F0 = c R and
    F90 = c with c from 1 to the base colour, and the specular one F90 = 1.
    """
    scene = scene_at(address)[0]
    row = scene.surface_textures[0].gloss.rows[scene.triangle_material[hit.triangle]]
    out = Bsdf()
    if row.enabled == 0:
        out.diffuse = albedo(scene, hit, footprint)
        return out
    base = _gloss_texture(scene, hit, row.base_color_texture, row.base_color, footprint)
    if row.base_color_texture < 0 and scene.triangle_colors[hit.triangle] != -1:
        base = albedo(scene, hit, footprint)
    roughness = _gloss_texture(scene, hit, row.roughness_texture, wp.vec3(row.roughness), footprint)[0]
    out.diffuse = base
    out.alpha = roughness * roughness
    if row.has_specular_color == 1:
        out.f0 = _gloss_texture(scene, hit, row.specular_color_texture, row.specular_color, footprint)
        out.f90 = wp.vec3(1.0)
    else:
        metallic = _gloss_texture(scene, hit, row.metallic_texture, wp.vec3(row.metallic), footprint)[0]
        dielectric = (1.0 - metallic) * row.specular_weight
        tint = wp.vec3(1.0 - metallic) + base * metallic
        out.f90 = tint * (metallic + dielectric)
        out.f0 = tint * (metallic + row.f0 * dielectric)
        out.diffuse = base * (1.0 - metallic)
    out.coat = _gloss_texture(scene, hit, row.clearcoat_texture, wp.vec3(row.clearcoat), footprint)[0]
    if out.coat > 0.0:
        rough = _gloss_texture(
            scene, hit, row.clearcoat_roughness_texture, wp.vec3(row.clearcoat_roughness), footprint
        )[0]
        out.coat_f0 = row.f0
        out.coat_alpha = rough * rough
    return out
