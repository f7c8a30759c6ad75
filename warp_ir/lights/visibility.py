"""The fraction of a light's emission that reaches a point: visibility, shaping and light links.

For lights with a `LightModifiers`, `light_visibility` takes the place of `visible`.
"""

import warp as wp

from warp_ir.device_scene import SceneData
from warp_ir.light_modifiers import in_link_set, shaping_factor
from warp_ir.surface import (
    SHADOW_RAY_END,
    Hit,
    ShadingPoint,
    closest,
    scene_at,
    shadow_ray_origin,
    spawn_ray_origin,
    visible,
)

wp.set_module_options({"enable_backward": False})

CROSSINGS = wp.constant(64)
"""Most surfaces that light passes because they do not shadow it."""


@wp.func
def only_sampled(scene: SceneData, row: int) -> bool:
    """Whether only sampling the light may count it, because some surfaces that block rays do not shadow it."""
    if row < 0:
        return False
    return (
        scene.light_tables[0].modifiers.rows[row].shadows == 0
        or scene.light_tables[0].modifiers.rows[row].shadowless >= 0
    )


@wp.func
def shaping_at(scene: SceneData, row: int, direction: wp.vec3) -> wp.vec3:
    """The factor by which shaping changes the radiance that a light emits in a unit direction."""
    if row < 0:
        return wp.vec3(1.0)
    return shaping_factor(scene.light_tables[0].modifiers.rows[row], scene.light_tables[0].distributions, direction)


@wp.func
def may_intersect(scene: SceneData, row: int, mesh: int, bsdf_pdf: float) -> bool:
    """Whether a ray from a mesh (-1: the camera) counts a light that it hits; `bsdf_pdf` as for `intersect_lights`."""
    if row < 0:
        return True
    if in_link_set(scene.light_tables[0].modifiers, scene.light_tables[0].modifiers.rows[row].unlit, mesh):
        return False
    return bsdf_pdf < 0.0 or not only_sampled(scene, row)


@wp.func
def light_visibility(scene: SceneData, modifier_row: int, x: ShadingPoint, target: wp.vec4) -> wp.vec3:
    """The fraction of the radiance of a point on a light that reaches a shading point.

    Args:
        scene: The scene.
        modifier_row: Row of the light's `LightModifiers`; -1: only visibility counts.
        x: The receiving point. Only where the camera sees it may a light cast no shadows.
        target: The point on the light, homogeneous and off its surface.
    """
    if modifier_row >= 0:
        return _modified_visibility(scene.address, modifier_row, x, target)
    if visible(scene, shadow_ray_origin(x, target), target):
        return wp.vec3(1.0)
    return wp.vec3(0.0)


@wp.func(inline=False)
def _modified_visibility(address: wp.uint64, row: int, x: ShadingPoint, target: wp.vec4) -> wp.vec3:
    """`light_visibility` for a light with a row of `LightModifiers`."""
    scene = scene_at(address)[0]
    modifiers = scene.light_tables[0].modifiers.rows[row]
    to_light = wp.vec3(target[0], target[1], target[2]) - x.position * target[3]
    factor = shaping_factor(modifiers, scene.light_tables[0].distributions, -wp.normalize(to_light))
    if wp.max(factor) <= 0.0 or in_link_set(scene.light_tables[0].modifiers, modifiers.unlit, x.mesh):
        return wp.vec3(0.0)
    if x.from_camera and modifiers.shadows == 0:
        return factor
    origin = shadow_ray_origin(x, target)
    if modifiers.shadowless < 0:
        if visible(scene, origin, target):
            return factor
        return wp.vec3(0.0)
    if _visible_ignoring(scene, modifiers.shadowless, origin, target):
        return factor
    return wp.vec3(0.0)


@wp.func
def _visible_ignoring(scene: SceneData, shadowless: int, position: wp.vec3, target: wp.vec4) -> bool:
    """`visible` for light that the meshes of a link set do not block."""
    origin = position
    xyz = wp.vec3(target[0], target[1], target[2])
    for _ in range(CROSSINGS):
        direction = xyz - origin * target[3]
        hit = closest(scene, origin, direction, wp.where(target[3] == 0.0, 3.0e38, SHADOW_RAY_END))
        if hit.triangle < 0:
            return True
        if not in_link_set(scene.light_tables[0].modifiers, shadowless, scene.triangle_mesh[hit.triangle]):
            return False
        origin = continue_behind(scene, hit, direction)
    return False


@wp.func
def continue_behind(scene: SceneData, hit: Hit, direction: wp.vec3) -> wp.vec3:
    """The origin at which a ray continues behind the surface that it has hit."""
    return spawn_ray_origin(scene, hit, wp.normalize(direction) - hit.normal)
