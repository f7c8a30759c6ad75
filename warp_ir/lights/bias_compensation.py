"""A bound on the geometry term, higher where VPLs lie close, and the light along a ray that the bound cuts."""

import warp as wp

from warp_ir.device_scene import SceneData
from warp_ir.lights.intersect import modified_emission
from warp_ir.lights.shape import intersect_shape, modifiers_of, modifiers_of_surface, shape_radiance
from warp_ir.lights.visibility import (
    CROSSINGS,
    continue_behind,
    light_visibility,
    may_intersect,
    only_sampled,
    shaping_along,
)
from warp_ir.surface import Hit, closest, emission, scene_at

wp.set_module_options({"enable_backward": False})


@wp.struct
class Bound:
    """A bound on G, higher for VPLs on lights where they lie closer together than they do on average."""

    least: float
    per_pdf_area: float  # times the density of the samples on a light, per area


@wp.func
def bound_for_pdf(bound: Bound, pdf: float) -> float:
    """The bound for VPLs on a light whose points are sampled with some density per area."""
    return wp.max(bound.least, bound.per_pdf_area * pdf)


@wp.func
def clamped_fraction(bound: float, g: float) -> float:
    """What the bound takes of a geometry term: (1 - bound/G)⁺."""
    if g <= bound:
        return 0.0
    return 1.0 - bound / g


@wp.func
def clamped_light_radiance(
    scene: SceneData,
    origin: wp.vec3,
    direction: wp.vec3,
    near: float,
    cosine: float,
    bound: Bound,
    reach: float,
    mesh: int,
    from_camera: bool,
) -> wp.vec3:
    """Radiance of the lights that a unit direction meets, times the share (1 - bound/G)⁺ that the bound cuts.

    Args:
        scene: The scene.
        origin: A point of a mesh, off its surface.
        direction: Unit.
        near: Distance to the first surface, or `reach`.
        cosine: Of the direction at the origin.
        bound: On G.
        reach: Distance beyond which G cannot exceed the bound: lights that surfaces do not shadow count up to there.
        mesh: The mesh at the origin.
        from_camera: Whether the camera sees the origin.
    """
    if scene.shape_count > 0 or scene.modifier_count > 0:
        return _clamped_light_radiance(scene.address, origin, direction, near, cosine, bound, reach, mesh, from_camera)
    return wp.vec3(0.0)


@wp.func(inline=False)
def _clamped_light_radiance(
    address: wp.uint64,
    origin: wp.vec3,
    direction: wp.vec3,
    near: float,
    cosine: float,
    bound: Bound,
    reach: float,
    mesh: int,
    from_camera: bool,
) -> wp.vec3:
    scene = scene_at(address)[0]
    total = wp.vec3(0.0)
    if scene.shape_count > 0:
        query = wp.bvh_query_ray(scene.shape_bvh, origin, direction)
        shape = int(0)
        while wp.bvh_query_next(query, shape, near):
            light = scene.shape_light[shape]
            hit = intersect_shape(scene, light, origin, direction)
            if hit[3] > 0.0 and hit[3] < near and may_intersect(scene, modifiers_of(scene, light), mesh, 0.0):
                share = _light_clamped_fraction(scene, light, hit, direction, cosine, bound)
                if share > 0.0:
                    radiance = shape_radiance(scene, light, origin, direction, hit[3])
                    total += wp.cw_mul(radiance, shaping_along(scene, modifiers_of(scene, light), -direction)) * share
    # One after the other and not in the query above: on CUDA two traversals at a time would share a stack.
    for k in range(scene.only_sampled_count):
        light = scene.light_tables[0].modifiers.sampled[k]
        hit = intersect_shape(scene, light, origin, direction)
        if hit[3] > 0.0 and hit[3] < reach:
            share = _light_clamped_fraction(scene, light, hit, direction, cosine, bound)
            if share > 0.0:
                p = origin + direction * (hit[3] * 0.99999)
                arrives = light_visibility(
                    scene, modifiers_of(scene, light), origin, mesh, from_camera, wp.vec4(p[0], p[1], p[2], 1.0)
                )
                total += wp.cw_mul(shape_radiance(scene, light, origin, direction, hit[3]), arrives) * share
    if scene.modifier_count > 0:
        if scene.light_tables[0].modifiers.sampled_surfaces > 0:
            total += _clamped_only_sampled_surfaces(
                scene.address, origin, direction, cosine, bound, reach, mesh, from_camera
            )
    return total


@wp.func(inline=False)
def _clamped_only_sampled_surfaces(
    address: wp.uint64,
    origin: wp.vec3,
    direction: wp.vec3,
    cosine: float,
    bound: Bound,
    reach: float,
    mesh: int,
    from_camera: bool,
) -> wp.vec3:
    """The same of emissive surfaces that see other surfaces than rays do: all along the ray, whatever hides them."""
    scene = scene_at(address)[0]
    total = wp.vec3(0.0)
    start = origin
    passed = float(0.0)
    for _ in range(CROSSINGS):
        hit = closest(scene, start, direction, reach - passed)
        if hit.triangle < 0:
            break
        modifiers = modifiers_of_surface(scene, hit.triangle)
        if only_sampled(scene, modifiers):
            radiance = emission(scene, hit, scene.footprint)
            distance = passed + hit.t
            share = _surface_clamped_fraction(
                scene, hit, -wp.dot(hit.normal, direction) * cosine / (distance * distance), bound
            )
            if share > 0.0 and wp.max(radiance) > 0.0:
                target = wp.vec4(hit.position[0], hit.position[1], hit.position[2], 1.0)
                total += (
                    wp.cw_mul(radiance, light_visibility(scene, modifiers, origin, mesh, from_camera, target)) * share
                )
        start = continue_behind(scene, hit, direction)
        passed = wp.dot(start - origin, direction)
    return total


@wp.func
def _surface_clamped_fraction(scene: SceneData, hit: Hit, g: float, bound: Bound) -> float:
    """The share (1 - bound/G)⁺ for the place where a ray meets an emissive surface."""
    emitter = scene.triangle_emitter[hit.triangle]
    if emitter < 0:
        return 0.0
    return clamped_fraction(bound_for_pdf(bound, scene.emitter_pdf_area[emitter]), g)


@wp.func
def clamped_surface_radiance(
    scene: SceneData, hit: Hit, direction: wp.vec3, g: float, bound: Bound, mesh: int
) -> wp.vec3:
    """As `clamped_light_radiance`, for the surface that a unit direction from a mesh has hit; `g` is its G."""
    radiance = emission(scene, hit, scene.footprint)
    if wp.max(radiance) <= 0.0:
        return radiance
    return modified_emission(scene, hit, direction, radiance, mesh, 0.0) * _surface_clamped_fraction(
        scene, hit, g, bound
    )


@wp.func
def _light_clamped_fraction(
    scene: SceneData, light: int, hit: wp.vec4, direction: wp.vec3, cosine: float, bound: Bound
) -> float:
    """The share (1 - bound/G)⁺ for the place where a ray meets a light."""
    world_n = wp.normalize(wp.transpose(scene.light_inverse[light]) * wp.vec3(hit[0], hit[1], hit[2]))
    g = -wp.dot(world_n, direction) * cosine / (hit[3] * hit[3])
    return clamped_fraction(bound_for_pdf(bound, scene.emitter_pdf_area[scene.light_emitter[light]]), g)
