"""The bound on the geometry term G, and the emission along a ray that the bound removes (Kollig and Keller 2004)."""

import warp as wp

from warp_ir.device_scene import SceneData
from warp_ir.lights.intersect import meet_light, modified_emission, shaped_radiance
from warp_ir.lights.shape import (
    intersect_shape,
    is_large,
    large_light_pdf,
    modifier_row_of_light,
    modifier_row_of_surface,
    shape_radiance,
)
from warp_ir.lights.visibility import (
    CROSSINGS,
    continue_behind,
    light_visibility,
    only_sampled,
)
from warp_ir.surface import Hit, ShadingPoint, closest, emission, scene_at, shadow_ray_origin

wp.set_module_options({"enable_backward": False})


@wp.struct
class Bound:
    """The bound on G, proportional to the density of the VPLs: higher on lights where they are denser than the mean."""

    minimum: float
    per_pdf_area: float  # bound over the area pdf of the samples on a light


@wp.func
def bound_for_pdf(bound: Bound, pdf: float) -> float:
    """The bound for VPLs on a light whose points are sampled with a given area pdf."""
    return wp.max(bound.minimum, bound.per_pdf_area * pdf)


@wp.func
def clamped_fraction(bound: float, g: float) -> float:
    """The fraction of a geometry term G that the bound removes: (1 - bound/G)⁺."""
    if g <= bound:
        return 0.0
    return 1.0 - bound / g


@wp.func
def clamped_light_radiance(
    scene: SceneData,
    x: ShadingPoint,
    direction: wp.vec3,
    t_max: float,
    cosine: float,
    bound: Bound,
    max_distance: float,
) -> wp.vec3:
    """Radiance of the lights that a unit direction hits, times the fraction that the bound removes.

    Args:
        scene: The scene.
        x: The point that the direction leaves.
        direction: A unit direction.
        t_max: Distance to the first surface, or `max_distance`.
        cosine: Cosine of the direction to the shading normal.
        bound: The bound on G.
        max_distance: Distance beyond which G cannot exceed the bound; `only_sampled` lights count up to there.
    """
    if scene.shape_count > 0 or scene.modifier_count > 0:
        return _clamped_light_radiance(scene.address, x, direction, t_max, cosine, bound, max_distance)
    return wp.vec3(0.0)


@wp.func(inline=False)
def _clamped_light_radiance(
    address: wp.uint64,
    x: ShadingPoint,
    direction: wp.vec3,
    t_max: float,
    cosine: float,
    bound: Bound,
    max_distance: float,
) -> wp.vec3:
    """`clamped_light_radiance` as a called function."""
    scene = scene_at(address)[0]
    origin = x.position
    total = wp.vec3(0.0)
    if scene.shape_count > 0:
        query = wp.bvh_query_ray(scene.shape_bvh, origin, direction)
        shape = int(0)
        while wp.bvh_query_next(query, shape, t_max):
            light = scene.shape_light[shape]
            hit = meet_light(scene, light, origin, direction, t_max, 0.0, x.mesh)
            if hit[3] > 0.0:
                fraction = _light_clamped_fraction(scene, light, hit, origin, direction, cosine, bound)
                if fraction > 0.0:
                    total += shaped_radiance(scene, light, origin, direction, hit[3]) * fraction
    # This loop is apart from the query above, since two simultaneous traversals would share a stack on CUDA.
    for k in range(scene.only_sampled_count):
        light = scene.light_tables[0].modifiers.only_sampled_lights[k]
        hit = intersect_shape(scene, light, origin, direction)
        if hit[3] > 0.0 and hit[3] < max_distance:
            fraction = _light_clamped_fraction(scene, light, hit, origin, direction, cosine, bound)
            if fraction > 0.0:
                p = origin + direction * (hit[3] * 0.99999)
                target = wp.vec4(p[0], p[1], p[2], 1.0)
                visibility = light_visibility(scene, modifier_row_of_light(scene, light), x, target)
                total += wp.cw_mul(shape_radiance(scene, light, origin, direction, hit[3]), visibility) * fraction
    if scene.modifier_count > 0:
        if scene.light_tables[0].modifiers.only_sampled_mesh_count > 0:
            total += _clamped_only_sampled_surfaces(scene.address, x, direction, cosine, bound, max_distance)
    return total


@wp.func(inline=False)
def _clamped_only_sampled_surfaces(
    address: wp.uint64,
    x: ShadingPoint,
    direction: wp.vec3,
    cosine: float,
    bound: Bound,
    max_distance: float,
) -> wp.vec3:
    """As `clamped_light_radiance`, for all `only_sampled` emissive surfaces along the ray, whatever hides them."""
    scene = scene_at(address)[0]
    total = wp.vec3(0.0)
    start = shadow_ray_origin(x, wp.vec4(direction[0], direction[1], direction[2], 0.0))
    distance_to_start = wp.dot(start - x.position, direction)
    for _ in range(CROSSINGS):
        hit = closest(scene, start, direction, max_distance - distance_to_start)
        if hit.triangle < 0:
            break
        row = modifier_row_of_surface(scene, hit.triangle)
        if only_sampled(scene, row):
            radiance = emission(scene, hit, scene.footprint)
            distance = distance_to_start + hit.t
            fraction = _surface_clamped_fraction(
                scene, hit, -wp.dot(hit.normal, direction) * cosine / (distance * distance), bound
            )
            if fraction > 0.0 and wp.max(radiance) > 0.0:
                target = wp.vec4(hit.position[0], hit.position[1], hit.position[2], 1.0)
                total += wp.cw_mul(radiance, light_visibility(scene, row, x, target)) * fraction
        start = continue_behind(scene, hit, direction)
        distance_to_start = wp.dot(start - x.position, direction)
    return total


@wp.func
def _surface_clamped_fraction(scene: SceneData, hit: Hit, g: float, bound: Bound) -> float:
    """`clamped_fraction` where a ray hits an emissive surface; `g` is its G."""
    emitter = scene.triangle_emitter[hit.triangle]
    if emitter < 0:
        return 0.0
    return clamped_fraction(bound_for_pdf(bound, scene.emitter_pdf_area[emitter]), g)


@wp.func
def clamped_surface_radiance(
    scene: SceneData, hit: Hit, direction: wp.vec3, g: float, bound: Bound, mesh: int
) -> wp.vec3:
    """As `clamped_light_radiance`, for the surface hit by a unit direction from a mesh; `g` is its G."""
    radiance = emission(scene, hit, scene.footprint)
    if wp.max(radiance) <= 0.0:
        return radiance
    return modified_emission(scene, hit, direction, radiance, mesh, 0.0) * _surface_clamped_fraction(
        scene, hit, g, bound
    )


@wp.func
def _light_clamped_fraction(
    scene: SceneData, light: int, hit: wp.vec4, origin: wp.vec3, direction: wp.vec3, cosine: float, bound: Bound
) -> float:
    """`clamped_fraction` where a ray hits a light; `hit` is the result of `intersect_shape`."""
    world_n = wp.normalize(wp.transpose(scene.light_inverse[light]) * wp.vec3(hit[0], hit[1], hit[2]))
    g = -wp.dot(world_n, direction) * cosine / (hit[3] * hit[3])
    emitter = scene.light_emitter[light]
    pdf = scene.emitter_pdf_area[emitter]
    if is_large(scene, light):
        probability = scene.emitter_cdf[emitter + 1] - scene.emitter_cdf[emitter]
        pdf = probability * large_light_pdf(scene, light, origin + direction * hit[3])
    return clamped_fraction(bound_for_pdf(bound, pdf), g)
