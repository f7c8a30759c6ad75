"""Origins of rays that leave a surface, with the only epsilon of the whole renderer.

Intersection points are computed from barycentric coordinates, which keeps their error within a few ulp of the
triangle's own coordinates however long the ray is (Wächter and Binder 2019). A ray therefore starts 8 ulp off the
surface, on the side it leaves from, and as far from the triangle's edges, where the next wall may stand: farther than
the error, nearer than any detail a float can represent, at any scale. For an instance, the transforms of the ray into
the prototype's space and of the hit back add to the error.
"""

import warp as wp

from warp_ir.device_scene import SceneData
from warp_ir.surface.hit import Hit

wp.set_module_options({"enable_backward": False})

_EIGHT_ULP = wp.constant(8.0 * 2.0**-23)
_MAX_PULL = wp.constant(1.0e-3)  # a triangle thinner than its rounding error has no interior


@wp.func
def offset_ray_origin(a: wp.vec3, b: wp.vec3, c: wp.vec3, u: float, v: float, direction: wp.vec3) -> wp.vec3:
    """The origin of rays that leave the point u a + v b + (1 - u - v) c of a triangle.

    The point is moved by more than its rounding error away from the triangle's edges, and along `direction`, a sum of
    unit vectors on the side the rays leave from.
    """
    return _offset_point(a, b, c, u, v, direction, _max_coordinate(a, b, c) * _EIGHT_ULP)


@wp.func
def spawn_ray_origin(scene: SceneData, hit: Hit, direction: wp.vec3) -> wp.vec3:
    """The origin of rays that leave a hit; `direction` as for `offset_ray_origin`."""
    a = scene.points[scene.indices[3 * hit.triangle]]
    b = scene.points[scene.indices[3 * hit.triangle + 1]]
    c = scene.points[scene.indices[3 * hit.triangle + 2]]
    if hit.instance < 0:
        return offset_ray_origin(a, b, c, hit.u, hit.v, direction)
    axes = scene.instance_axes[hit.instance]
    a = axes * a
    b = axes * b
    c = axes * c
    error = (_max_coordinate(a, b, c) + scene.instances[hit.instance].magnitude) * _EIGHT_ULP
    return _offset_point(a, b, c, hit.u, hit.v, direction, error) + scene.instances[hit.instance].centre


@wp.func
def _offset_point(a: wp.vec3, b: wp.vec3, c: wp.vec3, u: float, v: float, direction: wp.vec3, error: float) -> wp.vec3:
    """A point of a triangle, moved away from its edges and along `direction` by `error`."""
    longest_edge = wp.sqrt(wp.max(wp.max(wp.length_sq(b - a), wp.length_sq(c - b)), wp.length_sq(a - c)))
    # The pull towards the centroid moves a point on an edge by `error`, measured along the triangle's smallest height.
    pull = wp.min(error * longest_edge / wp.length(wp.cross(b - a, c - a)), _MAX_PULL)
    inner = a * (u + pull * (1.0 - 3.0 * u)) + b * (v + pull * (1.0 - 3.0 * v))
    return inner + c * (1.0 - u - v + pull * (3.0 * (u + v) - 2.0)) + direction * error


@wp.func
def _max_coordinate(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> float:
    """The largest absolute coordinate of a triangle."""
    return wp.max(wp.max(wp.max(wp.abs(a)), wp.max(wp.abs(b))), wp.max(wp.abs(c)))
