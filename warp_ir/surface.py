"""Rays against surfaces, and the only epsilon of the whole renderer.

Intersection points come from barycentric coordinates, which keeps their error within a few ulp of the
triangle's own coordinates however far the ray has come (Wächter and Binder 2019). A ray therefore starts
8 ulp off the surface, on the side it leaves from, and as far from the triangle's edges, behind which the next wall
may stand: farther than the error, nearer than any detail a float can hold, at any scale. For an instance, the way
of a ray into the prototype's space and that of the hit back add to the error.
"""

import warp as wp

from warp_ir.bvh import intersect, intersect_instances
from warp_ir.device_scene import INSTANCE_COLOR, SceneData

wp.set_module_options({"enable_backward": False})

_EIGHT_ULP = wp.constant(8.0 * 2.0**-23)
_MOST_PULL = wp.constant(1.0e-3)  # a needle thinner than its rounding error has no inside
_INFINITY = wp.constant(3.0e38)
_INSTANCE = wp.constant(INSTANCE_COLOR)


@wp.struct
class Hit:
    """Where a ray meets a surface; `triangle` is -1 if it does not."""

    triangle: int
    instance: int  # of which it is part; -1: it is in the world as it stands
    t: float  # in units of the ray's direction
    u: float  # weights of the triangle's first and second corner
    v: float
    position: wp.vec3  # off the surface, on the side of `normal`: where rays may start
    normal: wp.vec3  # unit geometric normal, on the side the ray came from
    front: int  # 1 if that is the side from which the triangle is wound counter-clockwise


@wp.func
def offset(a: wp.vec3, b: wp.vec3, c: wp.vec3, u: float, v: float, direction: wp.vec3) -> wp.vec3:
    """Where rays may start near the point u a + v b + (1 - u - v) c of a triangle.

    It is moved by more than its rounding error away from the triangle's edges, and along `direction`, a sum of unit
    vectors on the side the rays leave from.
    """
    return _start(a, b, c, u, v, direction, _largest(a, b, c) * _EIGHT_ULP)


@wp.func
def _largest(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> float:
    return wp.max(wp.max(wp.max(wp.abs(a)), wp.max(wp.abs(b))), wp.max(wp.abs(c)))


@wp.func
def _start(a: wp.vec3, b: wp.vec3, c: wp.vec3, u: float, v: float, direction: wp.vec3, error: float) -> wp.vec3:
    """A point of a triangle, moved away from its edges and along `direction` by a given error."""
    longest = wp.sqrt(wp.max(wp.max(wp.length_sq(b - a), wp.length_sq(c - b)), wp.length_sq(a - c)))
    # Towards the centroid by `error` at an edge, as the lowest of the triangle's heights measures it.
    pull = wp.min(error * longest / wp.length(wp.cross(b - a, c - a)), _MOST_PULL)
    inner = a * (u + pull * (1.0 - 3.0 * u)) + b * (v + pull * (1.0 - 3.0 * v))
    return inner + c * (1.0 - u - v + pull * (3.0 * (u + v) - 2.0)) + direction * error


@wp.func
def leave(scene: SceneData, hit: Hit, direction: wp.vec3) -> wp.vec3:
    """Where rays may start near a hit; `direction` as for `offset`."""
    a = scene.points[scene.indices[3 * hit.triangle]]
    b = scene.points[scene.indices[3 * hit.triangle + 1]]
    c = scene.points[scene.indices[3 * hit.triangle + 2]]
    if hit.instance < 0:
        return offset(a, b, c, hit.u, hit.v, direction)
    axes = scene.instance_axes[hit.instance]
    a = axes * a
    b = axes * b
    c = axes * c
    error = (_largest(a, b, c) + scene.instances[hit.instance].size) * _EIGHT_ULP
    return _start(a, b, c, hit.u, hit.v, direction, error) + scene.instances[hit.instance].centre


@wp.func
def closest(scene: SceneData, origin: wp.vec3, direction: wp.vec3, t_max: float) -> Hit:
    """The nearest surface along a ray."""
    hit = Hit()
    hit.triangle = -1
    hit.instance = -1
    found = intersect(scene.bvh, origin, direction, t_max, False)
    if scene.instance_count > 0:
        inside = intersect_instances(scene.two_level, origin, direction, found.t, False)
        if inside.triangle >= 0:
            found = inside
    if found.triangle >= 0:
        hit.triangle = found.triangle
        hit.instance = found.instance
        hit.t = found.t
        hit.u = found.u
        hit.v = found.v
        hit.front = found.front
        a = scene.points[scene.indices[3 * hit.triangle]]
        b = scene.points[scene.indices[3 * hit.triangle + 1]]
        c = scene.points[scene.indices[3 * hit.triangle + 2]]
        n = wp.cross(b - a, c - a)
        if hit.instance >= 0:
            n = wp.transpose(scene.instances[hit.instance].inverse) * n
        n = wp.normalize(n)
        hit.normal = wp.where(hit.front == 1, n, -n)
        # Back the way the ray came as well: it has crossed nothing, not even a wall that stands on this triangle.
        hit.position = leave(scene, hit, hit.normal - wp.normalize(direction))
    return hit


@wp.func
def visible(scene: SceneData, origin: wp.vec3, target: wp.vec4) -> bool:
    """Whether nothing lies between a point and a homogeneous one (w = 0: a direction); both off their surfaces."""
    way = wp.vec3(target[0], target[1], target[2]) - origin * target[3]
    reach = wp.where(target[3] == 0.0, _INFINITY, 0.999999)
    if intersect(scene.bvh, origin, way, reach, True).triangle >= 0:
        return False
    if scene.instance_count > 0:
        return intersect_instances(scene.two_level, origin, way, reach, True).triangle < 0
    return True


@wp.func
def shading_normal(scene: SceneData, hit: Hit) -> wp.vec3:
    """The interpolated normal on the side of the geometric one; the geometric one where there is none."""
    row = scene.triangle_normals[hit.triangle]
    if row < 0:
        return hit.normal
    a = scene.corner_normals[row]
    b = scene.corner_normals[row + 1]
    c = scene.corner_normals[row + 2]
    if hit.instance >= 0:
        to_device = wp.transpose(scene.instances[hit.instance].inverse)
        a = wp.normalize(to_device * a)
        b = wp.normalize(to_device * b)
        c = wp.normalize(to_device * c)
    n = hit.u * a + hit.v * b + (1.0 - hit.u - hit.v) * c
    length = wp.length(n)
    if length < 1.0e-6:
        return hit.normal
    return wp.where(wp.dot(n, hit.normal) < 0.0, -n, n) / length


@wp.func
def smooth_rise(scene: SceneData, hit: Hit) -> wp.vec3:
    """From a hit to the smooth surface that its triangle's normals stand for; zero where that is not above it.

    The point is projected onto the planes of the corners and their normals, and the results are interpolated (Hanika
    2021, Hacking the Shadow Terminator). Light that falls on the smooth surface at grazing angles passes behind the
    triangle's plane: from the triangle itself it could not be seen.
    """
    rise = wp.vec3(0.0)
    row = scene.triangle_normals[hit.triangle]
    if row < 0:
        return rise
    for k in range(3):
        weight = wp.where(k == 0, hit.u, wp.where(k == 1, hit.v, 1.0 - hit.u - hit.v))
        n = scene.corner_normals[row + k]
        corner = scene.points[scene.indices[3 * hit.triangle + k]]
        if hit.instance >= 0:
            n = wp.normalize(wp.transpose(scene.instances[hit.instance].inverse) * n)
            corner = scene.instance_axes[hit.instance] * corner + scene.instances[hit.instance].centre
        n = wp.where(wp.dot(n, hit.normal) < 0.0, -n, n)
        below = wp.dot(corner - hit.position, n)
        rise += weight * wp.max(below, 0.0) * n
    # What stands on the surface, or close above it, must stay above the point.
    if wp.length_sq(rise) > 0.0:
        if intersect(scene.bvh, hit.position, rise, 2.0, True).triangle >= 0:
            return wp.vec3(0.0)
        if scene.instance_count > 0:
            if intersect_instances(scene.two_level, hit.position, rise, 2.0, True).triangle >= 0:
                return wp.vec3(0.0)
    return rise


@wp.func
def albedo(scene: SceneData, hit: Hit) -> wp.vec3:
    """Hemispherical reflectance ρ at a hit."""
    row = scene.triangle_colors[hit.triangle]
    if row == _INSTANCE:
        return scene.instance_colors[hit.instance]
    if row < 0:
        return scene.albedo[scene.triangle_material[hit.triangle]]
    return (
        hit.u * scene.corner_colors[row]
        + hit.v * scene.corner_colors[row + 1]
        + (1.0 - hit.u - hit.v) * scene.corner_colors[row + 2]
    )


@wp.func
def emission(scene: SceneData, hit: Hit) -> wp.vec3:
    """Radiance [W sr⁻¹ m⁻²] that a surface emits towards the ray that hit it."""
    if hit.front == 1 or scene.emits_back[hit.triangle] == 1:
        return scene.emission[scene.triangle_material[hit.triangle]]
    return wp.vec3(0.0)
