"""Ray queries against all surfaces: the closest hit, and visibility, with stochastic alpha."""

import warp as wp

from warp_ir.bvh import RayHit, intersect, intersect_instances
from warp_ir.device_scene import SceneData
from warp_ir.sampling.sobol import hash_combine
from warp_ir.surface.hit import Hit, scene_at
from warp_ir.surface.material import alpha_at
from warp_ir.surface.offset import spawn_ray_origin

wp.set_module_options({"enable_backward": False})

_INFINITY = wp.constant(3.0e38)
SHADOW_RAY_END = wp.constant(0.999999)
"""Where a shadow ray ends, on its way from 0 to the target at 1."""
_MAX_LAYERS = wp.constant(1024)  # transparent surfaces that a ray may pass


@wp.func
def _passes_through(scene: SceneData, triangle: int, u: float, v: float) -> bool:
    """Stochastic alpha test at a hit, deterministic per hit: whether the ray continues behind the surface."""
    alpha = alpha_at(scene, triangle, u, v)
    if alpha <= 0.0 or alpha >= 1.0:
        return alpha <= 0.0
    bits = hash_combine(hash_combine(wp.uint32(triangle), wp.cast(u, wp.uint32)), wp.cast(v, wp.uint32))
    return (float(bits >> wp.uint32(8)) + 0.5) * (1.0 / 16777216.0) > alpha


@wp.func(inline=False)  # the only traversal in a kernel: copies of it would compile slowly and run no faster
def intersect_scene(address: wp.uint64, origin: wp.vec3, direction: wp.vec3, t_max: float, any_hit: bool) -> RayHit:
    """The nearest triangle along a ray, whatever its alpha; with `any_hit` any triangle, without its coordinates."""
    scene = scene_at(address)[0]
    nearest = intersect(scene.bvh, origin, direction, t_max, any_hit)
    if scene.instance_count > 0 and not (any_hit and nearest.triangle >= 0):
        instanced = intersect_instances(scene.two_level, origin, direction, nearest.t, any_hit)
        if instanced.triangle >= 0:
            nearest = instanced
    return nearest


@wp.func
def _closest_triangle(address: wp.uint64, origin: wp.vec3, direction: wp.vec3, t_max: float) -> Hit:
    """The nearest triangle along a ray, whatever its alpha."""
    hit = Hit()
    hit.triangle = -1
    hit.instance = -1
    nearest = intersect_scene(address, origin, direction, t_max, False)
    if nearest.triangle >= 0:
        scene = scene_at(address)[0]
        hit.triangle = nearest.triangle
        hit.instance = nearest.instance
        hit.t = nearest.t
        hit.u = nearest.u
        hit.v = nearest.v
        hit.front = nearest.front
        a = scene.points[scene.indices[3 * hit.triangle]]
        b = scene.points[scene.indices[3 * hit.triangle + 1]]
        c = scene.points[scene.indices[3 * hit.triangle + 2]]
        ab = b - a
        ac = c - a
        n = wp.cross(ab, ac)
        if hit.instance >= 0:
            axes = scene.instance_axes[hit.instance]
            hit.area = 0.5 * wp.length(wp.cross(axes * ab, axes * ac))
            n = wp.transpose(scene.instances[hit.instance].inverse) * n
        else:
            hit.area = 0.5 * wp.length(n)
        n = wp.normalize(n)
        hit.normal = wp.where(hit.front == 1, n, -n)
        # Offset against the ray as well, which has crossed nothing, not even a wall that stands on this triangle.
        hit.position = spawn_ray_origin(scene, hit, hit.normal - wp.normalize(direction))
    return hit


@wp.func
def _to_target(origin: wp.vec3, target: wp.vec4) -> wp.vec3:
    """The vector from a point to a homogeneous point; the direction itself where w = 0."""
    return wp.vec3(target[0], target[1], target[2]) - origin * target[3]


@wp.func(inline=False)
def _closest_opaque(address: wp.uint64, origin: wp.vec3, target: wp.vec4, t_max: float) -> Hit:
    """The nearest triangle towards a homogeneous point that does not let the ray pass by its alpha."""
    direction = _to_target(origin, target)
    ray_origin = origin
    t_start = float(0.0)
    for _layer in range(_MAX_LAYERS):
        # Every offset from a surface shifts the ray: unless aimed again, it may hit the target's own surface.
        to_target = _to_target(ray_origin, target)
        hit = _closest_triangle(address, ray_origin, to_target, wp.where(target[3] == 0.0, t_max - t_start, t_max))
        if hit.triangle < 0:
            return hit
        scene = scene_at(address)[0]
        if not _passes_through(scene, hit.triangle, hit.u, hit.v):
            hit.t += t_start
            return hit
        ray_origin = spawn_ray_origin(scene, hit, wp.normalize(to_target) - hit.normal)
        t_start = wp.dot(ray_origin - origin, direction) / wp.length_sq(direction)
        if t_start >= t_max:
            break
    miss = Hit()
    miss.triangle = -1
    miss.instance = -1
    return miss


@wp.func
def closest(scene: SceneData, origin: wp.vec3, direction: wp.vec3, t_max: float) -> Hit:
    """The nearest surface along a ray before `t_max`, in lengths of its direction."""
    return _closest(scene.address, origin, direction, t_max)


@wp.func(inline=False)
def _closest(address: wp.uint64, origin: wp.vec3, direction: wp.vec3, t_max: float) -> Hit:
    """`closest` as a called function."""
    scene = scene_at(address)[0]
    if scene.non_opaque_count > 0:
        target = wp.vec4(direction[0], direction[1], direction[2], 0.0)
        return _closest_opaque(address, origin, target, t_max)
    return _closest_triangle(address, origin, direction, t_max)


@wp.func
def visible(scene: SceneData, origin: wp.vec3, target: wp.vec4) -> bool:
    """Whether a homogeneous point (w = 0: a direction) is unoccluded from a point; both are off their surfaces."""
    t_max = wp.where(target[3] == 0.0, _INFINITY, SHADOW_RAY_END)
    if scene.non_opaque_count > 0:
        return _closest_opaque(scene.address, origin, target, t_max).triangle < 0
    return intersect_scene(scene.address, origin, _to_target(origin, target), t_max, True).triangle < 0
