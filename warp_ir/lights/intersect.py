"""Emission of the emitters that a ray hits, with links, shaping and MIS weights."""

import warp as wp

from warp_ir.device_scene import SceneData
from warp_ir.lights.sample_direct import mis_weight, selection_probability, shape_pdf, surface_mis_weight
from warp_ir.lights.shape import (
    dome_from_world,
    intersect_shape,
    light_axis,
    light_texture,
    meets_before,
    modifier_row_of_light,
    modifier_row_of_surface,
    shape_radiance,
)
from warp_ir.lights.visibility import may_intersect, shaping_at
from warp_ir.sampling.distribution2d import direction_pdf, value_at_direction
from warp_ir.scene import LightKind
from warp_ir.surface import Hit, camera_emission, emission, has_camera_emission, scene_at

wp.set_module_options({"enable_backward": False})

_DISTANT = wp.constant(int(LightKind.DISTANT))
_DOME = wp.constant(int(LightKind.DOME))


@wp.func
def intersect_lights(
    scene: SceneData, origin: wp.vec3, direction: wp.vec3, t_max: float, escapes: bool, bsdf_pdf: float, mesh: int
) -> wp.vec3:
    """Radiance of the analytic lights that a ray hits before t_max, including infinite lights if it `escapes`.

    Lights block nothing: all lights along the ray count that are linked to the mesh it leaves (-1: the camera).
    `bsdf_pdf` is the pdf per solid angle with which the direction was sampled, for MIS against `sample_direct`;
    negative: all MIS weights are 1.
    """
    if scene.shape_count > 0 or escapes:
        return _intersect_lights(scene.address, origin, direction, t_max, escapes, bsdf_pdf, mesh)
    return wp.vec3(0.0)


@wp.func
def meet_light(
    scene: SceneData, light: int, origin: wp.vec3, direction: wp.vec3, t_max: float, bsdf_pdf: float, mesh: int
) -> wp.vec4:
    """`intersect_shape` of a light that is linked to a mesh, before a surface at t_max; arguments as above."""
    hit = intersect_shape(scene, light, origin, direction)
    if meets_before(scene, light, origin, direction, hit, t_max) and may_intersect(
        scene, modifier_row_of_light(scene, light), mesh, bsdf_pdf
    ):
        return hit
    return wp.vec4(0.0, 0.0, 0.0, -1.0)


@wp.func
def shaped_radiance(scene: SceneData, light: int, origin: wp.vec3, direction: wp.vec3, t: float) -> wp.vec3:
    """Radiance of a light with an area where a ray meets it at t."""
    radiance = shape_radiance(scene, light, origin, direction, t)
    return wp.cw_mul(radiance, shaping_at(scene, modifier_row_of_light(scene, light), -direction))


@wp.func(inline=False)
def _intersect_lights(
    address: wp.uint64, origin: wp.vec3, direction: wp.vec3, t_max: float, escapes: bool, bsdf_pdf: float, mesh: int
) -> wp.vec3:
    """`intersect_lights` as a called function."""
    scene = scene_at(address)[0]
    total = wp.vec3(0.0)
    if scene.shape_count > 0:
        query = wp.bvh_query_ray(scene.shape_bvh, origin, direction)
        shape = int(0)
        while wp.bvh_query_next(query, shape, t_max):
            light = scene.shape_light[shape]
            hit = meet_light(scene, light, origin, direction, t_max, bsdf_pdf, mesh)
            if hit[3] > 0.0:
                radiance = shaped_radiance(scene, light, origin, direction, hit[3])
                if bsdf_pdf >= 0.0:
                    radiance = radiance * mis_weight(bsdf_pdf, shape_pdf(scene, light, origin, direction, hit[3]))
                total += radiance
    if escapes:
        for light in range(scene.light_count):
            if scene.light_kind[light] >= _DISTANT and may_intersect(
                scene, modifier_row_of_light(scene, light), mesh, bsdf_pdf
            ):
                total += _infinite_light_radiance(scene, light, direction, bsdf_pdf)
    return total


@wp.func
def _infinite_light_radiance(scene: SceneData, light: int, direction: wp.vec3, bsdf_pdf: float) -> wp.vec3:
    """Radiance of a distant light or a dome from a unit direction, times its MIS weight."""
    cone = wp.where(scene.light_kind[light] == _DOME, 2.0, scene.light_angle[light])
    difference = direction - light_axis(scene, light)
    if scene.light_kind[light] == _DISTANT and 0.5 * wp.dot(difference, difference) >= cone:
        return wp.vec3(0.0)
    radiance = wp.cw_mul(
        scene.light_radiance[light], shaping_at(scene, modifier_row_of_light(scene, light), -direction)
    )
    pdf = 1.0 / (2.0 * wp.pi * cone)
    texture = light_texture(scene, light)
    if texture >= 0:
        local = dome_from_world(scene, light, direction)
        radiance = wp.cw_mul(radiance, value_at_direction(scene.light_tables[0].distributions, texture, local))
        pdf = direction_pdf(scene.light_tables[0].distributions, texture, local)
    return radiance * mis_weight(bsdf_pdf, selection_probability(scene, scene.light_emitter[light]) * pdf)


@wp.func
def modified_emission(
    scene: SceneData, hit: Hit, direction: wp.vec3, radiance: wp.vec3, mesh: int, bsdf_pdf: float
) -> wp.vec3:
    """Emission of a surface towards a ray from a mesh, with links and shaping; arguments as for `intersect_lights`."""
    row = modifier_row_of_surface(scene, hit.triangle)
    if row < 0:
        return radiance
    if not may_intersect(scene, row, mesh, bsdf_pdf):
        return wp.vec3(0.0)
    return wp.cw_mul(radiance, shaping_at(scene, row, -direction))


@wp.func
def emission_to_camera(scene: SceneData, hit: Hit, direction: wp.vec3, footprint: float) -> wp.vec3:
    """Emission seen by the camera of the surface hit by a unit direction."""
    if has_camera_emission(scene, hit.triangle):
        return camera_emission(scene, hit, footprint)
    radiance = emission(scene, hit, footprint)
    if wp.max(radiance) <= 0.0:
        return radiance
    return modified_emission(scene, hit, direction, radiance, -1, -1.0)


@wp.func
def surface_emission_mis(scene: SceneData, hit: Hit, direction: wp.vec3, bsdf_pdf: float, mesh: int) -> wp.vec3:
    """Emission, times its MIS weight, of the surface hit by a unit direction that was sampled from a BSDF."""
    radiance = emission(scene, hit, scene.footprint)
    if wp.max(radiance) <= 0.0:
        return radiance
    radiance = modified_emission(scene, hit, direction, radiance, mesh, bsdf_pdf)
    return radiance * surface_mis_weight(scene, hit, direction, bsdf_pdf)
