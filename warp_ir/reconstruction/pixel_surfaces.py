"""What each pixel stands for: the surface seen through its centre, and whether a neighbour stands for another."""

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

MATCH = wp.constant(0.2)
"""Of `same_surface`: below, a sample is not of that surface."""
_PLANE = wp.constant(4.0)  # footprints off the plane at which a point belongs to another surface


@wp.struct
class PixelSurfaces:
    """One row for each pixel of an image."""

    columns: int
    rows: int
    position: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]  # unit
    footprint: wp.array[wp.float32]  # size of a pixel there; 0: background
    bordering: wp.array[wp.uint8]  # 1: any of the eight neighbours shows another surface, or none


@wp.func
def _window(x: float) -> float:
    """A bell of width 1 (Tukey's biweight): no exponential in the inner loop."""
    y = wp.max(1.0 - x, 0.0)
    return y * y


@wp.func
def fits(surfaces: PixelSurfaces, p: int, position: wp.vec3, normal: wp.vec3) -> wp.vec2:
    """How well a point belongs to the surface of pixel `p`: 1 on its plane and facing its way, falling to 0.

    Then the same for light from all around, which changes less as a surface turns.
    """
    footprint = surfaces.footprint[p]
    if footprint <= 0.0:
        return wp.vec2(0.0)
    there = surfaces.normal[p]
    facing = wp.max(wp.dot(there, normal), 0.0)
    facing *= facing
    facing *= facing
    apart = position - surfaces.position[p]
    off = wp.max(wp.abs(wp.dot(there, apart)), wp.abs(wp.dot(normal, apart)))
    wide = facing * _window(off / (_PLANE * footprint))
    return wp.vec2(wide * facing * facing * facing, wide)


@wp.func
def same_surface(surfaces: PixelSurfaces, p: int, position: wp.vec3, normal: wp.vec3) -> float:
    """How well a point belongs to the surface of pixel `p`: 1 on its plane and facing its way, falling to 0."""
    return fits(surfaces, p, position, normal)[0]


@wp.func
def pixel_around(surfaces: PixelSurfaces, p: int, k: int) -> int:
    """The k-th of the nine pixels around `p`, itself among them; itself as well where the image ends."""
    x = p % surfaces.columns + k % 3 - 1
    y = p // surfaces.columns + k // 3 - 1
    if x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows:
        return y * surfaces.columns + x
    return p


@wp.func
def shown_nearby(surfaces: PixelSurfaces, p: int, position: wp.vec3, normal: wp.vec3) -> bool:
    """Whether a pixel or one of its eight neighbours shows the surface of a point."""
    for k in range(9):
        if same_surface(surfaces, pixel_around(surfaces, p, k), position, normal) > MATCH:
            return True
    return False


@wp.func
def differ(surfaces: PixelSurfaces, p: int, q: int) -> bool:
    """Whether two pixels show different surfaces, or only one shows any."""
    if surfaces.footprint[p] <= 0.0 and surfaces.footprint[q] <= 0.0:
        return False
    return surfaces.footprint[q] <= 0.0 or same_surface(surfaces, p, surfaces.position[q], surfaces.normal[q]) < MATCH
