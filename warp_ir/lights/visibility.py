"""How much of a light's emission gets to a point: shaping, links and shadows.

Where a light has a `LightModifiers`, `light_visibility` takes the place of `visible`.
"""

import warp as wp

from warp_ir.device_scene import SceneData
from warp_ir.light_modifiers import in_link_set, shaping_factor
from warp_ir.surface import Hit, closest, scene_at, spawn_ray_origin, visible

wp.set_module_options({"enable_backward": False})

CROSSINGS = wp.constant(64)
"""Most surfaces without a shadow that light is followed through."""


@wp.func
def only_sampled(scene: SceneData, modifiers: int) -> bool:
    """Whether a light sees other surfaces than rays do, so that it may only be sampled."""
    if modifiers < 0:
        return False
    return (
        scene.light_tables[0].modifiers.rows[modifiers].shadows == 0
        or scene.light_tables[0].modifiers.rows[modifiers].shadowless >= 0
    )


@wp.func
def shaping_along(scene: SceneData, modifiers: int, direction: wp.vec3) -> wp.vec3:
    """Factor of the radiance that a light emits along a unit direction."""
    if modifiers < 0:
        return wp.vec3(1.0)
    return shaping_factor(
        scene.light_tables[0].modifiers.rows[modifiers], scene.light_tables[0].distributions, direction
    )


@wp.func
def may_intersect(scene: SceneData, modifiers: int, mesh: int, bsdf_pdf: float) -> bool:
    """Whether a ray from a mesh (-1: the eye) counts the light it finds, `bsdf_pdf` being as for `intersect_lights`."""
    if modifiers < 0:
        return True
    if in_link_set(scene.light_tables[0].modifiers, scene.light_tables[0].modifiers.rows[modifiers].unlit, mesh):
        return False
    return bsdf_pdf < 0.0 or not only_sampled(scene, modifiers)


@wp.func
def light_visibility(
    scene: SceneData, modifiers: int, position: wp.vec3, mesh: int, from_camera: bool, target: wp.vec4
) -> wp.vec3:
    """How much of the light from a point on a light arrives at a point of a mesh.

    Args:
        scene: The scene.
        modifiers: Row of the light's `LightModifiers`; -1: only visibility counts.
        position: The point, off its surface.
        mesh: The mesh it belongs to.
        from_camera: Whether the camera sees the point: only there may a light do without shadows.
        target: Homogeneous; off its surface.
    """
    if modifiers >= 0:
        return _modified_visibility(scene.address, modifiers, position, mesh, from_camera, target)
    if visible(scene, position, target):
        return wp.vec3(1.0)
    return wp.vec3(0.0)


@wp.func(inline=False)
def _modified_visibility(
    address: wp.uint64, row: int, position: wp.vec3, mesh: int, from_camera: bool, target: wp.vec4
) -> wp.vec3:
    scene = scene_at(address)[0]
    modifiers = scene.light_tables[0].modifiers.rows[row]
    to_light = wp.vec3(target[0], target[1], target[2]) - position * target[3]
    factor = shaping_factor(modifiers, scene.light_tables[0].distributions, -wp.normalize(to_light))
    if wp.max(factor) <= 0.0 or in_link_set(scene.light_tables[0].modifiers, modifiers.unlit, mesh):
        return wp.vec3(0.0)
    if from_camera and modifiers.shadows == 0:
        return factor
    if modifiers.shadowless < 0:
        if visible(scene, position, target):
            return factor
        return wp.vec3(0.0)
    if _visible_ignoring(scene, modifiers.shadowless, position, target):
        return factor
    return wp.vec3(0.0)


@wp.func
def _visible_ignoring(scene: SceneData, shadowless: int, position: wp.vec3, target: wp.vec4) -> bool:
    """`visible` as if the meshes of a link set were not there."""
    origin = position
    xyz = wp.vec3(target[0], target[1], target[2])
    for _ in range(CROSSINGS):
        direction = xyz - origin * target[3]
        hit = closest(scene, origin, direction, wp.where(target[3] == 0.0, 3.0e38, 0.999999))
        if hit.triangle < 0:
            return True
        if not in_link_set(scene.light_tables[0].modifiers, shadowless, scene.triangle_mesh[hit.triangle]):
            return False
        origin = continue_behind(scene, hit, direction)
    return False


@wp.func
def continue_behind(scene: SceneData, hit: Hit, direction: wp.vec3) -> wp.vec3:
    """Where a ray goes on that passes through the surface it has hit."""
    return spawn_ray_origin(scene, hit, wp.normalize(direction) - hit.normal)
