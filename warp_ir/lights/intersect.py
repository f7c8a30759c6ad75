"""Emitters that rays find, as far as they light what the ray comes from."""

import warp as wp

from warp_ir.device_scene import SceneData
from warp_ir.lights.sample_direct import mis_weight, selection_probability, shape_pdf, surface_mis_weight
from warp_ir.lights.shape import (
    dome_from_world,
    intersect_shape,
    light_axis,
    modifiers_of,
    modifiers_of_surface,
    shape_radiance,
    texture_of,
)
from warp_ir.lights.visibility import may_intersect, shaping_along
from warp_ir.sampling.distribution2d import direction_pdf, value_along
from warp_ir.scene import LightKind
from warp_ir.surface import Hit, emission, glow, has_glow, scene_at

wp.set_module_options({"enable_backward": False})

_DISTANT = wp.constant(int(LightKind.DISTANT))
_DOME = wp.constant(int(LightKind.DOME))


@wp.func
def intersect_lights(
    scene: SceneData, origin: wp.vec3, direction: wp.vec3, t_max: float, escapes: bool, bsdf_pdf: float, mesh: int
) -> wp.vec3:
    """Radiance of the analytic lights that a ray meets before t_max; of those at infinity too if it escapes.

    Lights block nothing, so all along the ray count that are linked to the mesh it leaves (-1: the eye).
    `bsdf_pdf` is the density per solid angle with which the direction was sampled, for weighting against
    `sample_light`; negative: no weighting.
    """
    if scene.shape_count > 0 or escapes:
        return _intersect_lights(scene.address, origin, direction, t_max, escapes, bsdf_pdf, mesh)
    return wp.vec3(0.0)


@wp.func(inline=False)
def _intersect_lights(
    address: wp.uint64, origin: wp.vec3, direction: wp.vec3, t_max: float, escapes: bool, bsdf_pdf: float, mesh: int
) -> wp.vec3:
    scene = scene_at(address)[0]
    total = wp.vec3(0.0)
    if scene.shape_count > 0:
        query = wp.bvh_query_ray(scene.shape_bvh, origin, direction)
        shape = int(0)
        while wp.bvh_query_next(query, shape, t_max):
            light = scene.shape_light[shape]
            hit = intersect_shape(scene, light, origin, direction)
            if hit[3] > 0.0 and hit[3] < t_max and may_intersect(scene, modifiers_of(scene, light), mesh, bsdf_pdf):
                radiance = shape_radiance(scene, light, origin, direction, hit[3])
                radiance = wp.cw_mul(radiance, shaping_along(scene, modifiers_of(scene, light), -direction))
                if bsdf_pdf >= 0.0:
                    radiance = radiance * mis_weight(bsdf_pdf, shape_pdf(scene, light, origin, direction, hit[3]))
                total += radiance
    if escapes:
        for light in range(scene.light_count):
            if scene.light_kind[light] >= _DISTANT and may_intersect(scene, modifiers_of(scene, light), mesh, bsdf_pdf):
                total += _infinite_light_radiance(scene, light, direction, bsdf_pdf)
    return total


@wp.func
def _infinite_light_radiance(scene: SceneData, light: int, direction: wp.vec3, bsdf_pdf: float) -> wp.vec3:
    """Radiance of a distant light or a dome along a unit direction, weighted."""
    cone = wp.where(scene.light_kind[light] == _DOME, 2.0, scene.light_angle[light])
    apart = direction - light_axis(scene, light)
    if scene.light_kind[light] == _DISTANT and 0.5 * wp.dot(apart, apart) >= cone:
        return wp.vec3(0.0)
    radiance = wp.cw_mul(scene.light_radiance[light], shaping_along(scene, modifiers_of(scene, light), -direction))
    pdf = 1.0 / (2.0 * wp.pi * cone)
    texture = texture_of(scene, light)
    if texture >= 0:
        local = dome_from_world(scene, light, direction)
        radiance = wp.cw_mul(radiance, value_along(scene.light_tables[0].distributions, texture, local))
        pdf = direction_pdf(scene.light_tables[0].distributions, texture, local)
    return radiance * mis_weight(bsdf_pdf, selection_probability(scene, scene.light_emitter[light]) * pdf)


@wp.func
def modified_emission(
    scene: SceneData, hit: Hit, direction: wp.vec3, radiance: wp.vec3, mesh: int, bsdf_pdf: float
) -> wp.vec3:
    """What of a surface's emission goes back along a ray from a mesh; arguments as for `intersect_lights`."""
    modifiers = modifiers_of_surface(scene, hit.triangle)
    if modifiers < 0:
        return radiance
    if not may_intersect(scene, modifiers, mesh, bsdf_pdf):
        return wp.vec3(0.0)
    return wp.cw_mul(radiance, shaping_along(scene, modifiers, -direction))


@wp.func
def emission_to_camera(scene: SceneData, hit: Hit, direction: wp.vec3, footprint: float) -> wp.vec3:
    """Radiance that the camera sees of a surface which a unit direction has hit."""
    if has_glow(scene, hit.triangle):
        return glow(scene, hit, footprint)
    radiance = emission(scene, hit, footprint)
    if wp.max(radiance) <= 0.0:
        return radiance
    return modified_emission(scene, hit, direction, radiance, -1, -1.0)


@wp.func
def surface_emission_mis(scene: SceneData, hit: Hit, direction: wp.vec3, bsdf_pdf: float, mesh: int) -> wp.vec3:
    """What `intersect_lights` is for lights, for the surface that a unit direction, sampled from a BSDF, has hit."""
    radiance = emission(scene, hit, scene.footprint)
    if wp.max(radiance) <= 0.0:
        return radiance
    arrives = modified_emission(scene, hit, direction, radiance, mesh, bsdf_pdf)
    return arrives * surface_mis_weight(scene, hit, direction, bsdf_pdf)
