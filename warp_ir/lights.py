"""Points on emitters, and emitters along rays. Emissive triangles and the lights of UsdLux are one list.

A point on an emitter is homogeneous, position (x, y, z, w): w = 1 for a place, w = 0 for the direction
towards a distant light. Its normal (x, y, z, a) gives the emitter's cosine as max(0, a + n·ω): a = 0 for a
surface, and n = 0, a = 1 for what shines the same everywhere. So nobody who gathers light needs a second case.
"""

import warp as wp

from warp_ir import sampling
from warp_ir.device_scene import _TRIANGLE_EMITTER, SceneData
from warp_ir.scene import LightKind
from warp_ir.surface import Hit, emitted, offset, presence

wp.set_module_options({"enable_backward": False})

_RECT = wp.constant(int(LightKind.RECT))
_DISK = wp.constant(int(LightKind.DISK))
_SPHERE = wp.constant(int(LightKind.SPHERE))
_CYLINDER = wp.constant(int(LightKind.CYLINDER))
_POINT = wp.constant(int(LightKind.POINT))
_DISTANT = wp.constant(int(LightKind.DISTANT))
_DOME = wp.constant(int(LightKind.DOME))
_TRIANGLE = wp.constant(_TRIANGLE_EMITTER)


@wp.struct
class LightPoint:
    """A random point on a random emitter."""

    position: wp.vec4
    normal: wp.vec4
    intensity: wp.vec3  # radiance / density: W/sr for a place, W/m² for a direction
    density: float  # per area for a place, per solid angle for a direction; 0: cannot be hit by a ray


@wp.struct
class Emission:
    """A photon that leaves a light."""

    origin: wp.vec3
    direction: wp.vec3
    flux: wp.vec3  # [W]


@wp.func
def sample_light(scene: SceneData, u_pick: float, u: wp.vec2) -> LightPoint:
    """A point on the scene's emitters: which one, in proportion to power; where on it, uniformly."""
    low = int(0)
    high = scene.emitter_count
    while high - low > 1:
        middle = (low + high) // 2
        if scene.emitter_cdf[middle] <= u_pick:
            low = middle
        else:
            high = middle
    probability = scene.emitter_cdf[low + 1] - scene.emitter_cdf[low]
    rest = (u_pick - scene.emitter_cdf[low]) / probability  # uniform again, for what is left to choose
    item = scene.emitter_item[low]
    if scene.emitter_kind[low] == _TRIANGLE:
        return _sample_triangle(scene, item, probability, rest, u)
    if scene.emitter_kind[low] <= _CYLINDER:
        return _sample_shape(scene, item, probability, u)
    return _sample_point_or_direction(scene, item, probability, u)


@wp.func
def _sample_triangle(scene: SceneData, triangle: int, probability: float, rest: float, u: wp.vec2) -> LightPoint:
    a = scene.points[scene.indices[3 * triangle]]
    b = scene.points[scene.indices[3 * triangle + 1]]
    c = scene.points[scene.indices[3 * triangle + 2]]
    cross = wp.cross(b - a, c - a)
    n = wp.normalize(cross)
    sides = float(1.0)
    if scene.emits_back[triangle] == 1:
        sides = 2.0
        n = wp.where(rest < 0.5, n, -n)
    root = wp.sqrt(u[0])
    at_a = 1.0 - root
    at_b = root * (1.0 - u[1])
    p = offset(a, b, c, at_a, at_b, n)
    area = 0.5 * wp.length(cross)
    out = LightPoint()
    out.density = probability / (area * sides)
    out.position = wp.vec4(p[0], p[1], p[2], 1.0)
    out.normal = wp.vec4(n[0], n[1], n[2], 0.0)
    radiance = emitted(scene, triangle, at_a, at_b, area, scene.footprint)
    if scene.open_count > 0:
        radiance = radiance * presence(scene, triangle, at_a, at_b)
    out.intensity = radiance / out.density
    return out


@wp.func
def _area_scale(scene: SceneData, light: int, n: wp.vec3) -> float:
    """Area of a shape's surface over that of the unit shape, where the unit shape's normal is `n` (Nanson)."""
    return wp.abs(wp.determinant(scene.light_axes[light])) * wp.length(wp.transpose(scene.light_inverse[light]) * n)


@wp.func
def _unit_area(kind: int) -> float:
    if kind == _RECT:
        return 1.0
    if kind == _DISK:
        return wp.pi
    if kind == _SPHERE:
        return 4.0 * wp.pi
    return 2.0 * wp.pi


@wp.func
def _sample_shape(scene: SceneData, light: int, probability: float, u: wp.vec2) -> LightPoint:
    kind = scene.light_kind[light]
    n = wp.vec3(0.0, 0.0, 1.0)
    q = wp.vec3(u[0] - 0.5, u[1] - 0.5, 0.0)
    if kind == _DISK:
        d = sampling.to_disk(u)
        q = wp.vec3(d[0], d[1], 0.0)
    elif kind == _SPHERE:
        n = sampling.to_cone(u, 2.0, wp.vec3(0.0, 0.0, 1.0))
        q = n
    elif kind == _CYLINDER:
        phi = 2.0 * wp.pi * u[1]
        n = wp.vec3(0.0, wp.cos(phi), wp.sin(phi))
        q = wp.vec3(u[0] - 0.5, n[1], n[2])
    p = scene.light_origin[light] + scene.light_axes[light] * q
    world_n = wp.normalize(wp.transpose(scene.light_inverse[light]) * n)
    out = LightPoint()
    out.density = probability / (_unit_area(kind) * _area_scale(scene, light, n))
    p += world_n * (wp.max(wp.abs(p)) * 9.5367431640625e-07)  # 8 ulp: a light often lies in the ceiling's plane
    out.position = wp.vec4(p[0], p[1], p[2], 1.0)
    out.normal = wp.vec4(world_n[0], world_n[1], world_n[2], 0.0)
    out.intensity = scene.light_radiance[light] / out.density
    return out


@wp.func
def _axis(scene: SceneData, light: int) -> wp.vec3:
    """The unit direction towards a distant light."""
    m = scene.light_axes[light]
    return wp.vec3(m[0, 2], m[1, 2], m[2, 2])


@wp.func
def _sample_point_or_direction(scene: SceneData, light: int, probability: float, u: wp.vec2) -> LightPoint:
    kind = scene.light_kind[light]
    out = LightPoint()
    out.normal = wp.vec4(0.0, 0.0, 0.0, 1.0)
    if kind == _POINT:
        p = scene.light_origin[light]
        out.position = wp.vec4(p[0], p[1], p[2], 1.0)
        out.intensity = scene.light_radiance[light] / probability
        return out
    cone = float(2.0)
    if kind == _DISTANT:
        cone = scene.light_angle[light]
    d = sampling.to_cone(u, cone, _axis(scene, light))
    out.position = wp.vec4(d[0], d[1], d[2], 0.0)
    if cone > 0.0:
        out.density = probability / (2.0 * wp.pi * cone)
        out.intensity = scene.light_radiance[light] / out.density
    else:
        out.intensity = scene.light_radiance[light] / probability
    return out


@wp.func
def emit(scene: SceneData, point: LightPoint, u: wp.vec2, v: wp.vec2) -> Emission:
    """A photon from a point on an emitter: `u` gives its direction, `v` the place of one from far away."""
    out = Emission()
    xyz = wp.vec3(point.position[0], point.position[1], point.position[2])
    if point.position[3] == 0.0:
        # Parallel light enters through a disk that covers the scene, seen from there.
        d = sampling.to_disk(v)
        out.origin = scene.radius * (sampling.to_frame(wp.vec3(d[0], d[1], 0.0), xyz) + xyz)
        out.direction = -xyz
        out.flux = point.intensity * (wp.pi * scene.radius * scene.radius)
    elif point.normal[3] == 1.0:
        out.origin = xyz
        out.direction = sampling.to_cone(u, 2.0, wp.vec3(0.0, 0.0, 1.0))
        out.flux = point.intensity * (4.0 * wp.pi)
    else:
        out.origin = xyz
        out.direction = sampling.to_cosine_hemisphere(u, wp.vec3(point.normal[0], point.normal[1], point.normal[2]))
        out.flux = point.intensity * wp.pi
    return out


@wp.func
def _hit_shape(scene: SceneData, light: int, origin: wp.vec3, direction: wp.vec3) -> wp.vec4:
    """Where a ray meets the emitting side of a light: the unit shape's normal there, and t (-1: it does not)."""
    kind = scene.light_kind[light]
    o = scene.light_inverse[light] * (origin - scene.light_origin[light])
    d = scene.light_inverse[light] * direction
    miss = wp.vec4(0.0, 0.0, 0.0, -1.0)
    if kind == _RECT or kind == _DISK:
        if d[2] >= 0.0 or o[2] <= 0.0:
            return miss
        t = -o[2] / d[2]
        x = o[0] + t * d[0]
        y = o[1] + t * d[1]
        if kind == _RECT and (wp.abs(x) > 0.5 or wp.abs(y) > 0.5):
            return miss
        if kind == _DISK and x * x + y * y > 1.0:
            return miss
        return wp.vec4(0.0, 0.0, 1.0, t)
    flat = wp.where(kind == _CYLINDER, 0.0, 1.0)
    o2 = wp.vec3(o[0] * flat, o[1], o[2])
    d2 = wp.vec3(d[0] * flat, d[1], d[2])
    a = wp.dot(d2, d2)
    b = wp.dot(o2, d2)
    if b >= 0.0 or a == 0.0:
        return miss
    # The squared distance of the line from the axis, computed so that a far origin does not cancel it.
    nearest = o2 - d2 * (b / a)
    h = 1.0 - wp.dot(nearest, nearest)
    if h <= 0.0:
        return miss
    t = -b / a - wp.sqrt(h / a)  # the first of the two: the other is seen from inside
    if t <= 0.0 or (kind == _CYLINDER and wp.abs(o[0] + t * d[0]) > 0.5):
        return miss
    n = wp.normalize(o2 + t * d2)
    return wp.vec4(n[0], n[1], n[2], t)


@wp.func
def _weight(bsdf_density: float, light_density: float) -> float:
    """The balance heuristic (Veach 1997); 1 if the ray was no sample of a BSDF."""
    if bsdf_density < 0.0:
        return 1.0
    return bsdf_density / (bsdf_density + light_density)


@wp.func
def _probability(scene: SceneData, emitter: int) -> float:
    if emitter < 0:
        return 0.0
    return scene.emitter_cdf[emitter + 1] - scene.emitter_cdf[emitter]


@wp.func
def lights_along(
    scene: SceneData, origin: wp.vec3, direction: wp.vec3, t_max: float, escapes: bool, bsdf_density: float
) -> wp.vec3:
    """Radiance of the analytic lights that a ray meets before t_max; of those at infinity too if it escapes.

    Lights block nothing, so all along the ray count. `bsdf_density` is the density per solid angle with which
    the direction was sampled, for weighting against `sample_light`; negative: no weighting.
    """
    total = wp.vec3(0.0)
    if scene.shape_count > 0:
        query = wp.bvh_query_ray(scene.shape_bvh, origin, direction)
        shape = int(0)
        while wp.bvh_query_next(query, shape, t_max):
            light = scene.shape_light[shape]
            hit = _hit_shape(scene, light, origin, direction)
            if hit[3] > 0.0 and hit[3] < t_max:
                n = wp.vec3(hit[0], hit[1], hit[2])
                world_n = wp.normalize(wp.transpose(scene.light_inverse[light]) * n)
                cosine = -wp.dot(world_n, direction)
                area = _unit_area(scene.light_kind[light]) * _area_scale(scene, light, n)
                density = _probability(scene, scene.light_emitter[light]) * hit[3] * hit[3] / (area * cosine)
                if cosine > 0.0:
                    total += scene.light_radiance[light] * _weight(bsdf_density, density)
    if escapes:
        for light in range(scene.light_count):
            kind = scene.light_kind[light]
            cone = wp.where(kind == _DOME, 2.0, scene.light_angle[light])
            apart = direction - _axis(scene, light)
            if kind == _DOME or (kind == _DISTANT and 0.5 * wp.dot(apart, apart) < cone):
                density = _probability(scene, scene.light_emitter[light]) / (2.0 * wp.pi * cone)
                total += scene.light_radiance[light] * _weight(bsdf_density, density)
    return total


@wp.func
def lights_beyond(
    scene: SceneData, origin: wp.vec3, direction: wp.vec3, t_max: float, cosine: float, bound: float
) -> wp.vec3:
    """Radiance of the lights that a unit direction meets before t_max, times the share (1 - bound/G)⁺ that is cut.

    `cosine` is that of the direction at the origin.
    """
    total = wp.vec3(0.0)
    if scene.shape_count > 0:
        query = wp.bvh_query_ray(scene.shape_bvh, origin, direction)
        shape = int(0)
        while wp.bvh_query_next(query, shape, t_max):
            light = scene.shape_light[shape]
            hit = _hit_shape(scene, light, origin, direction)
            if hit[3] > 0.0 and hit[3] < t_max:
                world_n = wp.normalize(wp.transpose(scene.light_inverse[light]) * wp.vec3(hit[0], hit[1], hit[2]))
                g = -wp.dot(world_n, direction) * cosine / (hit[3] * hit[3])
                if g > bound:
                    total += scene.light_radiance[light] * (1.0 - bound / g)
    return total


@wp.func
def surface_weight(scene: SceneData, hit: Hit, direction: wp.vec3, bsdf_density: float) -> float:
    """The weight of the emission of an emissive surface that a unit direction, sampled from a BSDF, has hit."""
    if bsdf_density < 0.0:
        return 1.0
    a = scene.points[scene.indices[3 * hit.triangle]]
    b = scene.points[scene.indices[3 * hit.triangle + 1]]
    c = scene.points[scene.indices[3 * hit.triangle + 2]]
    area = 0.5 * wp.length(wp.cross(b - a, c - a)) * float(1 + scene.emits_back[hit.triangle])
    cosine = wp.max(-wp.dot(hit.normal, direction), 1.0e-20)
    probability = _probability(scene, scene.triangle_emitter[hit.triangle])
    return _weight(bsdf_density, probability * hit.t * hit.t / (area * cosine))
