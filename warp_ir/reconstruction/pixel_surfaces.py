"""The surface that each pixel stands for: the one visible through the pixel's centre."""

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

MIN_MATCH = wp.constant(0.2)
"""Least `match_weight` of a point that counts as lying on the surface of a pixel."""
PLANE_DISTANCE = wp.constant(4.0)  # footprints off the tangent plane at which a point lies on another surface


@wp.struct
class PixelSurfaces:
    """The surfaces through the pixels' centres, one row per pixel of an image."""

    columns: int
    rows: int
    position: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]  # smooth shading normal, unit
    footprint: wp.array[wp.float32]  # width of a pixel at the surface; 0: background
    edge: wp.array[wp.uint8]  # 1: any of the eight neighbours shows another surface, or only one of the two shows any


@wp.func
def _biweight(x: float) -> float:
    """Tukey's biweight on [0, 1], which needs no exponential."""
    y = wp.max(1.0 - x, 0.0)
    return y * y


@wp.func
def match_weights(surfaces: PixelSurfaces, p: int, position: wp.vec3, normal: wp.vec3) -> wp.vec2:
    """Weights in [0, 1] of a point on the surface of pixel `p`, for direct and for indirect irradiance.

    They are 1 for a point in the pixel's tangent plane with the same normal. Indirect irradiance varies less with the
    normal, so its weight falls more slowly.
    """
    return _match_weights(surfaces, p, surfaces.footprint[p], position, normal)


@wp.func
def pixel_match_weights(surfaces: PixelSurfaces, p: int, q: int) -> wp.vec2:
    """As `match_weights`, of two pixels: the same for (p, q) as for (q, p)."""
    footprint = wp.min(surfaces.footprint[p], surfaces.footprint[q])
    return _match_weights(surfaces, p, footprint, surfaces.position[q], surfaces.normal[q])


@wp.func
def _match_weights(surfaces: PixelSurfaces, p: int, footprint: float, position: wp.vec3, normal: wp.vec3) -> wp.vec2:
    """As `match_weights`, with a footprint of its own; without weight where that is 0."""
    if footprint <= 0.0:
        return wp.vec2(0.0)
    pixel_normal = surfaces.normal[p]
    facing = wp.max(wp.dot(pixel_normal, normal), 0.0)
    facing *= facing
    facing *= facing
    difference = position - surfaces.position[p]
    distance = wp.max(wp.abs(wp.dot(pixel_normal, difference)), wp.abs(wp.dot(normal, difference)))
    indirect = facing * _biweight(distance / (PLANE_DISTANCE * footprint))
    return wp.vec2(indirect * facing * facing * facing, indirect)


@wp.func
def match_weight(surfaces: PixelSurfaces, p: int, position: wp.vec3, normal: wp.vec3) -> float:
    """Weight in [0, 1] of a point on the surface of pixel `p`: the first of `match_weights`."""
    return match_weights(surfaces, p, position, normal)[0]


@wp.func
def neighbor_pixel(surfaces: PixelSurfaces, p: int, k: int) -> int:
    """The k-th pixel, 0 to 8, of the 3 x 3 neighbourhood of `p`; `p` itself for k = 4 and beyond the image."""
    x = p % surfaces.columns + k % 3 - 1
    y = p // surfaces.columns + k // 3 - 1
    if x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows:
        return y * surfaces.columns + x
    return p


@wp.func
def neighborhood_shows(surfaces: PixelSurfaces, p: int, position: wp.vec3, normal: wp.vec3) -> bool:
    """Whether a point lies on the surface of any pixel in the 3 x 3 neighbourhood of `p`."""
    for k in range(9):
        if match_weight(surfaces, neighbor_pixel(surfaces, p, k), position, normal) > MIN_MATCH:
            return True
    return False


@wp.func
def surfaces_differ(surfaces: PixelSurfaces, p: int, q: int) -> bool:
    """Whether two pixels show different surfaces, or one a surface and the other the background."""
    if surfaces.footprint[p] <= 0.0 and surfaces.footprint[q] <= 0.0:
        return False
    if surfaces.footprint[q] <= 0.0:
        return True
    return match_weight(surfaces, p, surfaces.position[q], surfaces.normal[q]) < MIN_MATCH
