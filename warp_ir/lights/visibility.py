"""How much of a light's emission gets to a point: shaping, links and shadows.

Where a light has a `LightControl`, `arriving` takes the place of `visible`.
"""

import warp as wp

from warp_ir.device_scene import SceneData
from warp_ir.light_modifiers import linked, shaping_factor
from warp_ir.surface import Hit, closest, leave, scene_at, visible

wp.set_module_options({"enable_backward": False})

CROSSINGS = wp.constant(64)
"""Most surfaces without a shadow that light is followed through."""


@wp.func
def only_sampled(scene: SceneData, control: int) -> bool:
    """Whether a light sees other surfaces than rays do, so that it may only be sampled."""
    if control < 0:
        return False
    return (
        scene.light_tables[0].controls.rows[control].shadows == 0
        or scene.light_tables[0].controls.rows[control].shadowless >= 0
    )


@wp.func
def shaping_along(scene: SceneData, control: int, direction: wp.vec3) -> wp.vec3:
    """Factor of the radiance that a light emits along a unit direction."""
    if control < 0:
        return wp.vec3(1.0)
    return shaping_factor(scene.light_tables[0].controls.rows[control], scene.light_tables[0].grids, direction)


@wp.func
def may_find(scene: SceneData, control: int, mesh: int, bsdf_density: float) -> bool:
    """Whether a ray from a mesh (-1: the eye) counts the light it finds, `bsdf_density` being as for `lights_found`."""
    if control < 0:
        return True
    if linked(scene.light_tables[0].controls, scene.light_tables[0].controls.rows[control].unlit, mesh):
        return False
    return bsdf_density < 0.0 or not only_sampled(scene, control)


@wp.func
def arriving(scene: SceneData, control: int, position: wp.vec3, mesh: int, seen: bool, target: wp.vec4) -> wp.vec3:
    """How much of the light from a point on a light arrives at a point of a mesh.

    Args:
        scene: The scene.
        control: Row of the light's `LightControl`; -1: only visibility counts.
        position: The point, off its surface.
        mesh: The mesh it belongs to.
        seen: Whether the camera sees the point: only there may a light do without shadows.
        target: Homogeneous; off its surface.
    """
    if control >= 0:
        return _arriving_controlled(scene.address, control, position, mesh, seen, target)
    if visible(scene, position, target):
        return wp.vec3(1.0)
    return wp.vec3(0.0)


@wp.func(inline=False)
def _arriving_controlled(
    address: wp.uint64, row: int, position: wp.vec3, mesh: int, seen: bool, target: wp.vec4
) -> wp.vec3:
    scene = scene_at(address)[0]
    control = scene.light_tables[0].controls.rows[row]
    to_light = wp.vec3(target[0], target[1], target[2]) - position * target[3]
    factor = shaping_factor(control, scene.light_tables[0].grids, -wp.normalize(to_light))
    if wp.max(factor) <= 0.0 or linked(scene.light_tables[0].controls, control.unlit, mesh):
        return wp.vec3(0.0)
    if seen and control.shadows == 0:
        return factor
    if control.shadowless < 0:
        if visible(scene, position, target):
            return factor
        return wp.vec3(0.0)
    if _visible_past(scene, control.shadowless, position, target):
        return factor
    return wp.vec3(0.0)


@wp.func
def _visible_past(scene: SceneData, shadowless: int, position: wp.vec3, target: wp.vec4) -> bool:
    """`visible` as if the meshes of a link set were not there."""
    origin = position
    xyz = wp.vec3(target[0], target[1], target[2])
    for _ in range(CROSSINGS):
        direction = xyz - origin * target[3]
        hit = closest(scene, origin, direction, wp.where(target[3] == 0.0, 3.0e38, 0.999999))
        if hit.triangle < 0:
            return True
        if not linked(scene.light_tables[0].controls, shadowless, scene.triangle_mesh[hit.triangle]):
            return False
        origin = behind(scene, hit, direction)
    return False


@wp.func
def behind(scene: SceneData, hit: Hit, direction: wp.vec3) -> wp.vec3:
    """Where a ray goes on that passes through the surface it has hit."""
    return leave(scene, hit, wp.normalize(direction) - hit.normal)
