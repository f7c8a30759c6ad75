"""Emitters that rays find, as far as they light what the ray comes from."""

import warp as wp

from warp_ir.device_scene import SceneData
from warp_ir.lights.sample_direct import choice_probability, found_weight, shape_density, surface_weight
from warp_ir.lights.shape import (
    control_of,
    control_of_surface,
    dome_from_world,
    face_radiance,
    hit_shape,
    light_axis,
    texture_of,
)
from warp_ir.lights.visibility import may_find, shaping_along
from warp_ir.sampling.distribution2d import direction_density, value_along
from warp_ir.scene import LightKind
from warp_ir.surface import Hit, emission, glow, has_glow, scene_at

wp.set_module_options({"enable_backward": False})

_DISTANT = wp.constant(int(LightKind.DISTANT))
_DOME = wp.constant(int(LightKind.DOME))


@wp.func
def lights_found(
    scene: SceneData, origin: wp.vec3, direction: wp.vec3, t_max: float, escapes: bool, bsdf_density: float, mesh: int
) -> wp.vec3:
    """Radiance of the analytic lights that a ray meets before t_max; of those at infinity too if it escapes.

    Lights block nothing, so all along the ray count that are linked to the mesh it leaves (-1: the eye).
    `bsdf_density` is the density per solid angle with which the direction was sampled, for weighting against
    `sample_light`; negative: no weighting.
    """
    if scene.shape_count > 0 or escapes:
        return _lights_found(scene.address, origin, direction, t_max, escapes, bsdf_density, mesh)
    return wp.vec3(0.0)


@wp.func(inline=False)
def _lights_found(
    address: wp.uint64, origin: wp.vec3, direction: wp.vec3, t_max: float, escapes: bool, bsdf_density: float, mesh: int
) -> wp.vec3:
    scene = scene_at(address)[0]
    total = wp.vec3(0.0)
    if scene.shape_count > 0:
        query = wp.bvh_query_ray(scene.shape_bvh, origin, direction)
        shape = int(0)
        while wp.bvh_query_next(query, shape, t_max):
            light = scene.shape_light[shape]
            hit = hit_shape(scene, light, origin, direction)
            if hit[3] > 0.0 and hit[3] < t_max and may_find(scene, control_of(scene, light), mesh, bsdf_density):
                radiance = face_radiance(scene, light, origin, direction, hit[3])
                radiance = wp.cw_mul(radiance, shaping_along(scene, control_of(scene, light), -direction))
                if bsdf_density >= 0.0:
                    radiance = radiance * found_weight(
                        bsdf_density, shape_density(scene, light, origin, direction, hit[3])
                    )
                total += radiance
    if escapes:
        for light in range(scene.light_count):
            if scene.light_kind[light] >= _DISTANT and may_find(scene, control_of(scene, light), mesh, bsdf_density):
                total += _from_infinity(scene, light, direction, bsdf_density)
    return total


@wp.func
def _from_infinity(scene: SceneData, light: int, direction: wp.vec3, bsdf_density: float) -> wp.vec3:
    """Radiance of a distant light or a dome along a unit direction, weighted."""
    cone = wp.where(scene.light_kind[light] == _DOME, 2.0, scene.light_angle[light])
    apart = direction - light_axis(scene, light)
    if scene.light_kind[light] == _DISTANT and 0.5 * wp.dot(apart, apart) >= cone:
        return wp.vec3(0.0)
    radiance = wp.cw_mul(scene.light_radiance[light], shaping_along(scene, control_of(scene, light), -direction))
    density = 1.0 / (2.0 * wp.pi * cone)
    texture = texture_of(scene, light)
    if texture >= 0:
        local = dome_from_world(scene, light, direction)
        radiance = wp.cw_mul(radiance, value_along(scene.light_tables[0].grids, texture, local))
        density = direction_density(scene.light_tables[0].grids, texture, local)
    return radiance * found_weight(bsdf_density, choice_probability(scene, scene.light_emitter[light]) * density)


@wp.func
def emission_towards(
    scene: SceneData, hit: Hit, direction: wp.vec3, radiance: wp.vec3, mesh: int, bsdf_density: float
) -> wp.vec3:
    """What of a surface's emission goes back along a ray from a mesh; arguments as for `lights_found`."""
    control = control_of_surface(scene, hit.triangle)
    if control < 0:
        return radiance
    if not may_find(scene, control, mesh, bsdf_density):
        return wp.vec3(0.0)
    return wp.cw_mul(radiance, shaping_along(scene, control, -direction))


@wp.func
def surface_seen(scene: SceneData, hit: Hit, direction: wp.vec3, footprint: float) -> wp.vec3:
    """Radiance that the camera sees of a surface which a unit direction has hit."""
    if has_glow(scene, hit.triangle):
        return glow(scene, hit, footprint)
    radiance = emission(scene, hit, footprint)
    if wp.max(radiance) <= 0.0:
        return radiance
    return emission_towards(scene, hit, direction, radiance, -1, -1.0)


@wp.func
def surface_found(scene: SceneData, hit: Hit, direction: wp.vec3, bsdf_density: float, mesh: int) -> wp.vec3:
    """What `lights_found` is for lights, for the surface that a unit direction, sampled from a BSDF, has hit."""
    radiance = emission(scene, hit, scene.footprint)
    if wp.max(radiance) <= 0.0:
        return radiance
    arrives = emission_towards(scene, hit, direction, radiance, mesh, bsdf_density)
    return arrives * surface_weight(scene, hit, direction, bsdf_density)
