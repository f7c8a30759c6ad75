"""Points that receive light, and where their shadow rays start about the terminator of a smooth surface.

Light is evaluated at the point on the triangle. Where the normals bend outwards, light may come from below the
triangle's plane and above the smooth surface: only such rays start at the smooth surface, which the triangle would
hide from them (Hanika 2021, Hacking the Shadow Terminator).
"""

import warp as wp

from warp_ir.device_scene import SceneData
from warp_ir.surface.hit import Hit

wp.set_module_options({"enable_backward": False})


@wp.struct
class ShadingPoint:
    """A surface point that receives light."""

    position: wp.vec3  # off the triangle, to the side of its geometric normal
    normal: wp.vec3  # no light comes from behind it: the geometric normal, or the smooth one if smooth_height > 0
    shading_normal: wp.vec3
    geometric_normal: wp.vec3
    smooth_height: float  # of the smooth surface above the triangle, along `normal` [du]
    mesh: int
    from_camera: bool  # whether the camera sees the point
    tile: int  # the tile of `TileVisibility` that shows it; -1: visibility is not known


@wp.func
def shading_point(scene: SceneData, hit: Hit) -> ShadingPoint:
    """A hit as a point that reflects light to another surface, by its geometric normal."""
    x = ShadingPoint()
    x.position = hit.position
    x.normal = hit.normal
    x.shading_normal = hit.normal
    x.geometric_normal = hit.normal
    x.mesh = scene.triangle_mesh[hit.triangle]
    x.tile = -1
    return x


@wp.func
def is_below(x: ShadingPoint, direction: wp.vec3) -> bool:
    """Whether a direction points below the triangle's plane, where the smooth surface may still be lit."""
    return x.smooth_height > 0.0 and wp.dot(x.geometric_normal, direction) <= 0.0


@wp.func
def shadow_ray_origin(x: ShadingPoint, target: wp.vec4) -> wp.vec3:
    """The origin of a ray from a point to a homogeneous point; it stays below that point, however near that is."""
    to_target = wp.vec3(target[0], target[1], target[2]) - x.position * target[3]
    if not is_below(x, to_target):
        return x.position
    height = x.smooth_height
    if target[3] > 0.0:
        height = wp.min(height, 0.99 * wp.max(wp.dot(x.normal, to_target), 0.0))
    return x.position + height * x.normal


@wp.func
def geometry_term_of_hit(x: ShadingPoint, direction: wp.vec3, hit: Hit) -> wp.vec2:
    """G between a point and what its ray in a unit direction hits, and the weight of the hit.

    A ray that starts at the smooth surface hits y in another direction than y has from the point: the weight is G of
    the point over G of the ray's origin. It is 0 for the triangle itself, and for what is above its plane, where rays
    from the point itself count it.
    """
    cosine = wp.dot(direction, x.shading_normal)
    g = -wp.dot(hit.normal, direction) * cosine / (hit.t * hit.t)
    if not is_below(x, direction):
        return wp.vec2(g, 1.0)
    to_hit = hit.position - x.position
    if wp.dot(x.geometric_normal, to_hit) >= 0.0:
        return wp.vec2(0.0, 0.0)
    squared = wp.dot(to_hit, to_hit)
    cosines = wp.max(-wp.dot(hit.normal, to_hit), 0.0) * wp.max(wp.dot(x.shading_normal, to_hit), 0.0)
    g_at_x = cosines / (squared * squared)
    return wp.vec2(g_at_x, g_at_x / wp.max(g, 1.0e-20))
