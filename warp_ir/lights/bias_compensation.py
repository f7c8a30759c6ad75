"""A bound on the geometry term, higher where VPLs lie close, and the light along a ray that the bound cuts."""

import warp as wp

from warp_ir.device_scene import SceneData
from warp_ir.lights.intersect import emission_towards
from warp_ir.lights.shape import control_of, control_of_surface, face_radiance, hit_shape
from warp_ir.lights.visibility import CROSSINGS, arriving, behind, may_find, only_sampled, shaping_along
from warp_ir.surface import Hit, closest, emission, scene_at

wp.set_module_options({"enable_backward": False})


@wp.struct
class Bound:
    """A bound on G, higher for VPLs on lights where they lie closer together than they do on average."""

    least: float
    per_density: float  # times the density of the samples on a light, per area


@wp.func
def bound_on(bound: Bound, density: float) -> float:
    """The bound for VPLs on a light whose points are sampled with some density per area."""
    return wp.max(bound.least, bound.per_density * density)


@wp.func
def cut_share(bound: float, g: float) -> float:
    """What the bound takes of a geometry term: (1 - bound/G)⁺."""
    if g <= bound:
        return 0.0
    return 1.0 - bound / g


@wp.func
def lights_beyond(
    scene: SceneData,
    origin: wp.vec3,
    direction: wp.vec3,
    near: float,
    cosine: float,
    bound: Bound,
    reach: float,
    mesh: int,
    seen: bool,
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
        seen: Whether the camera sees the origin.
    """
    if scene.shape_count > 0 or scene.control_count > 0:
        return _lights_beyond(scene.address, origin, direction, near, cosine, bound, reach, mesh, seen)
    return wp.vec3(0.0)


@wp.func(inline=False)
def _lights_beyond(
    address: wp.uint64,
    origin: wp.vec3,
    direction: wp.vec3,
    near: float,
    cosine: float,
    bound: Bound,
    reach: float,
    mesh: int,
    seen: bool,
) -> wp.vec3:
    scene = scene_at(address)[0]
    total = wp.vec3(0.0)
    if scene.shape_count > 0:
        query = wp.bvh_query_ray(scene.shape_bvh, origin, direction)
        shape = int(0)
        while wp.bvh_query_next(query, shape, near):
            light = scene.shape_light[shape]
            hit = hit_shape(scene, light, origin, direction)
            if hit[3] > 0.0 and hit[3] < near and may_find(scene, control_of(scene, light), mesh, 0.0):
                share = _cut(scene, light, hit, direction, cosine, bound)
                if share > 0.0:
                    radiance = face_radiance(scene, light, origin, direction, hit[3])
                    total += wp.cw_mul(radiance, shaping_along(scene, control_of(scene, light), -direction)) * share
    # One after the other and not in the query above: on CUDA two traversals at a time would share a stack.
    for k in range(scene.only_sampled_count):
        light = scene.light_tables[0].controls.sampled[k]
        hit = hit_shape(scene, light, origin, direction)
        if hit[3] > 0.0 and hit[3] < reach:
            share = _cut(scene, light, hit, direction, cosine, bound)
            if share > 0.0:
                p = origin + direction * (hit[3] * 0.99999)
                arrives = arriving(scene, control_of(scene, light), origin, mesh, seen, wp.vec4(p[0], p[1], p[2], 1.0))
                total += wp.cw_mul(face_radiance(scene, light, origin, direction, hit[3]), arrives) * share
    if scene.control_count > 0:
        if scene.light_tables[0].controls.sampled_surfaces > 0:
            total += _sampled_surfaces_beyond(scene.address, origin, direction, cosine, bound, reach, mesh, seen)
    return total


@wp.func(inline=False)
def _sampled_surfaces_beyond(
    address: wp.uint64,
    origin: wp.vec3,
    direction: wp.vec3,
    cosine: float,
    bound: Bound,
    reach: float,
    mesh: int,
    seen: bool,
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
        control = control_of_surface(scene, hit.triangle)
        if only_sampled(scene, control):
            radiance = emission(scene, hit, scene.footprint)
            distance = passed + hit.t
            share = _cut_of_surface(scene, hit, -wp.dot(hit.normal, direction) * cosine / (distance * distance), bound)
            if share > 0.0 and wp.max(radiance) > 0.0:
                target = wp.vec4(hit.position[0], hit.position[1], hit.position[2], 1.0)
                total += wp.cw_mul(radiance, arriving(scene, control, origin, mesh, seen, target)) * share
        start = behind(scene, hit, direction)
        passed = wp.dot(start - origin, direction)
    return total


@wp.func
def _cut_of_surface(scene: SceneData, hit: Hit, g: float, bound: Bound) -> float:
    """The share (1 - bound/G)⁺ for the place where a ray meets an emissive surface."""
    emitter = scene.triangle_emitter[hit.triangle]
    if emitter < 0:
        return 0.0
    return cut_share(bound_on(bound, scene.emitter_density[emitter]), g)


@wp.func
def surface_beyond(scene: SceneData, hit: Hit, direction: wp.vec3, g: float, bound: Bound, mesh: int) -> wp.vec3:
    """What `lights_beyond` is for lights, for the surface that a unit direction from a mesh has hit; `g` is its G."""
    radiance = emission(scene, hit, scene.footprint)
    if wp.max(radiance) <= 0.0:
        return radiance
    return emission_towards(scene, hit, direction, radiance, mesh, 0.0) * _cut_of_surface(scene, hit, g, bound)


@wp.func
def _cut(scene: SceneData, light: int, hit: wp.vec4, direction: wp.vec3, cosine: float, bound: Bound) -> float:
    """The share (1 - bound/G)⁺ for the place where a ray meets a light."""
    world_n = wp.normalize(wp.transpose(scene.light_inverse[light]) * wp.vec3(hit[0], hit[1], hit[2]))
    g = -wp.dot(world_n, direction) * cosine / (hit[3] * hit[3])
    return cut_share(bound_on(bound, scene.emitter_density[scene.light_emitter[light]]), g)
