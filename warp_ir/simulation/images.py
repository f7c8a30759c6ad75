"""From what views see to images: which view shows which world, sums over iterations, the filter, packed colours."""

import warp as wp

from warp_ir.reconstruction.filter import (
    IrradianceLayer,
    mean_channels,
    normalized,
    rgb,
    similarity,
    tap_weight,
    weighted,
)
from warp_ir.reconstruction.pixel_surfaces import PLANE_DISTANCE, PixelSurfaces
from warp_ir.simulation.transport import DISABLE_CLEAR, DISABLE_PRESERVE, Clear, Outputs, ViewRays, ViewSums

wp.set_module_options({"enable_backward": False, "max_unroll": 0})


@wp.kernel
def _select_worlds(
    first: int, wanted: wp.array[wp.int32], world_count: int, views: ViewRays, used: wp.array[wp.int32]
) -> None:
    """Writes the world of a view, and marks it as used: any number of views write the same 1."""
    view = first + wp.tid()
    world = view
    if wanted.shape[0] > 0:
        world = wanted[view]
    if world != DISABLE_PRESERVE and (world < 0 or world >= world_count):
        world = DISABLE_CLEAR
    views.world[view] = world
    if world >= 0:
        used[world] = 1


@wp.struct
class Surface:
    """The surface of a pixel, loaded once for all of its neighbours."""

    position: wp.vec3
    normal: wp.vec3
    footprint: float


@wp.func
def _surface_of(surfaces: PixelSurfaces, p: int) -> Surface:
    out = Surface()
    out.position = surfaces.position[p]
    out.normal = surfaces.normal[p]
    out.footprint = surfaces.footprint[p]
    return out


@wp.func
def _match(surfaces: PixelSurfaces, own: Surface, q: int) -> wp.vec2:
    """`pixel_match_weights` of a pixel and another: for direct and for indirect irradiance."""
    footprint = wp.min(own.footprint, surfaces.footprint[q])
    normal = surfaces.normal[q]
    facing = wp.dot(own.normal, normal)
    if footprint <= 0.0 or facing <= 0.0:
        return wp.vec2(0.0)
    difference = surfaces.position[q] - own.position
    distance = wp.max(wp.abs(wp.dot(own.normal, difference)), wp.abs(wp.dot(normal, difference)))
    facing *= facing
    facing *= facing
    near = wp.max(1.0 - distance / (PLANE_DISTANCE * footprint), 0.0)
    indirect = facing * near * near
    return wp.vec2(indirect * facing * facing * facing, indirect)


@wp.func
def pixel_iterations(views: ViewRays, sums: ViewSums, view: int, pixel: int, iterations: int) -> wp.vec2:
    """Of how many iterations the irradiance of a pixel, direct and indirect, is the sum: those that hit a surface."""
    n = wp.vec2(float(sums.count[view] + iterations) * sums.albedo[pixel][3] / float(views.samples))
    if sums.reused.shape[0] > 0:
        n += sums.reused[pixel]
    return n


@wp.func
def _variance_of_mean(sums: ViewSums, pixel: int, n: wp.vec2) -> wp.vec2:
    """Variances of the means of n iterations of a pixel, from their spread."""
    mean = wp.cw_div(mean_channels(sums.direct[pixel], sums.indirect[pixel]), n)
    spread = wp.max(wp.cw_div(sums.squares[pixel], n) - wp.cw_mul(mean, mean), wp.vec2(0.0))
    return wp.cw_div(spread, n - wp.vec2(1.0))


@wp.func
def _local_variances(views: ViewRays, surfaces: PixelSurfaces, sums: ViewSums, p: int, iterations: int) -> wp.vec2:
    """Variances of the mean channels, direct and indirect, of pixels around that show the same surface.

    The spread of the iterations tells it; of a single iteration the spread of the neighbours, in which differences that
    are real count as noise.
    """
    row = p // surfaces.columns
    column = p - row * surfaces.columns
    view = row // views.rows
    begin = view * views.rows
    surface = _surface_of(surfaces, p)
    n = pixel_iterations(views, sums, view, p, iterations)
    own = wp.cw_div(
        mean_channels(sums.direct[p], sums.indirect[p]), n
    )  # the others are relative to it, so that little cancels
    spread = wp.min(n) > 1.5
    weight = wp.vec2(1.0)
    mean = wp.vec2(0.0)
    square = wp.vec2(0.0)
    if spread:
        square = _variance_of_mean(sums, p, n)
    for dy in range(-2, 3):
        y = row + dy
        if y >= begin and y < begin + views.rows:
            for dx in range(-2, 3):
                x = column + dx
                # Every other one of 5 x 5.
                if x >= 0 and x < surfaces.columns and (dx + dy) % 2 == 0 and not (dx == 0 and dy == 0):
                    q = y * surfaces.columns + x
                    w = _match(surfaces, surface, q)
                    n = pixel_iterations(views, sums, view, q, iterations)
                    if spread and wp.min(n) > 1.5:
                        weight += w
                        square += wp.cw_mul(w, _variance_of_mean(sums, q, n))
                    elif not spread and wp.min(n) > 0.0:
                        weight += w
                        difference = wp.cw_div(mean_channels(sums.direct[q], sums.indirect[q]), n) - own
                        mean += wp.cw_mul(w, difference)
                        square += wp.cw_mul(w, wp.cw_mul(difference, difference))
    mean = wp.cw_div(mean, weight)
    return wp.max(wp.cw_div(square, weight) - wp.cw_mul(mean, mean), wp.vec2(0.0))


@wp.kernel
def _begin_filter(
    first: int, views: ViewRays, surfaces: PixelSurfaces, iterations: int, sums: ViewSums, layer: IrradianceLayer
) -> None:
    """Writes the mean irradiance of a pixel, and its variance as its neighbours on the same surface show it."""
    pixel = first + wp.tid()
    view = pixel // (views.rows * views.columns)
    layer.direct[pixel] = wp.vec4(0.0, 0.0, 0.0, -1.0)
    layer.indirect[pixel] = wp.vec4(0.0, 0.0, 0.0, -1.0)
    if views.world[view] < 0 or sums.albedo[pixel][3] <= 0.0 or surfaces.footprint[pixel] <= 0.0:
        return
    n = pixel_iterations(views, sums, view, pixel, iterations)
    direct = sums.direct[pixel] / n[0]
    indirect = sums.indirect[pixel] / n[1]
    variance = _local_variances(views, surfaces, sums, pixel, iterations)
    layer.direct[pixel] = wp.vec4(direct[0], direct[1], direct[2], variance[0])
    layer.indirect[pixel] = wp.vec4(indirect[0], indirect[1], indirect[2], variance[1])


@wp.kernel
def _filter_views(
    first: int,
    rows: int,
    surfaces: PixelSurfaces,
    source: IrradianceLayer,
    out: IrradianceLayer,
    step: int,
    sigmas: wp.vec2,
) -> None:
    """One level of the filter of `reconstruction.filter`, within views of `rows` rows."""
    p = first + wp.tid()
    own_direct = source.direct[p]
    own_indirect = source.indirect[p]
    out.direct[p] = own_direct
    out.indirect[p] = own_indirect
    if own_direct[3] < 0.0:
        return
    row = p // surfaces.columns
    column = p - row * surfaces.columns
    begin = (row // rows) * rows
    surface = _surface_of(surfaces, p)
    direct = wp.vec4(0.0)
    indirect = wp.vec4(0.0)
    weights = wp.vec2(0.0)
    for dy in range(-1, 2):
        y = row + dy * step
        if y >= begin and y < begin + rows:
            for dx in range(-1, 2):
                x = column + dx * step
                q = y * surfaces.columns + x
                if x >= 0 and x < surfaces.columns and q != p:
                    d = source.direct[q]
                    if d[3] >= 0.0:
                        i = source.indirect[q]
                        match = tap_weight(dx) * tap_weight(dy) * _match(surfaces, surface, q)
                        match[0] *= similarity(own_direct, d, sigmas[0])
                        match[1] *= similarity(own_indirect, i, sigmas[1])
                        direct += weighted(d, match[0])
                        indirect += weighted(i, match[1])
                        weights += match
    out.direct[p] = normalized(direct + weighted(own_direct, 1.0 - weights[0]), 1.0)
    out.indirect[p] = normalized(indirect + weighted(own_indirect, 1.0 - weights[1]), 1.0)


@wp.func
def to_srgb(v: float) -> float:
    """The sRGB transfer function."""
    if v <= 0.0031308:
        return 12.92 * v
    return 1.055 * wp.pow(v, 1.0 / 2.4) - 0.055


@wp.func
def from_srgb(v: float) -> float:
    """The inverse of `to_srgb`."""
    if v <= 0.04045:
        return v / 12.92
    return wp.pow((v + 0.055) / 1.055, 2.4)


@wp.func
def _byte(v: float) -> wp.uint32:
    """A value in [0, 1] as a byte, cut off and not rounded; what is not a number is 0."""
    if not v > 0.0:
        return wp.uint32(0)
    return wp.uint32(wp.min(v, 1.0) * 255.0)


@wp.func
def pack(color: wp.vec3, alpha: float, linear: int) -> wp.uint32:
    """A linear colour as A << 24 | B << 16 | G << 8 | R, in sRGB unless it stays linear."""
    c = color
    if linear == 0:
        for k in range(3):
            c[k] = to_srgb(color[k])
    packed = _byte(c[0]) | (_byte(c[1]) << wp.uint32(8)) | (_byte(c[2]) << wp.uint32(16))
    return packed | (_byte(alpha) << wp.uint32(24))


@wp.func
def unpack(packed: wp.uint32, linear: int) -> wp.vec4:
    """The inverse of `pack`: linear colour, and alpha."""
    out = wp.vec4()
    for k in range(4):
        out[k] = float((packed >> wp.uint32(8 * k)) & wp.uint32(255)) / 255.0
        if linear == 0 and k < 3:
            out[k] = from_srgb(out[k])
    return out


@wp.func
def _mixed(color: wp.vec3, covered: float, clear: wp.uint32, linear: int) -> wp.uint32:
    """A colour that is part of a pixel, already times that part, over the clear colour, packed."""
    if covered <= 0.0:
        return clear
    if covered >= 1.0:
        return pack(color, 1.0, linear)
    behind = unpack(clear, linear)
    mixed = color + wp.vec3(behind[0], behind[1], behind[2]) * (1.0 - covered)
    return pack(mixed, covered + behind[3] * (1.0 - covered), linear)


@wp.kernel
def _write_images(
    first: int,
    views: ViewRays,
    iterations: int,
    sums: ViewSums,
    layer: IrradianceLayer,
    clear: Clear,
    out: Outputs,
) -> None:
    """Writes the colours of a pixel, and the standard error of its mean channel; infinity after one iteration."""
    pixel = first + wp.tid()
    view = pixel // (views.rows * views.columns)
    world = views.world[view]
    if world == DISABLE_PRESERVE:
        return
    covered = float(0.0)
    color = wp.vec3(0.0)
    rho = wp.vec3(0.0)
    error = float(0.0)
    if world >= 0:
        albedo = sums.albedo[pixel]
        n = float(sums.count[view] + iterations)
        if sums.reused.shape[0] > 0:
            n += wp.min(sums.reused[pixel])
        covered = albedo[3] / float(views.samples)
        rho = wp.vec3(albedo[0], albedo[1], albedo[2]) / float(views.samples)
        color = sums.radiance[pixel] / n
        if sums.square.shape[0] > 0:
            error = wp.inf
            if n > 1.5:
                mean = (color[0] + color[1] + color[2]) / 3.0
                error = wp.sqrt(wp.max(sums.square[pixel] / n - mean * mean, 0.0) / (n - 1.0))
        if layer.direct.shape[0] > 0:
            if layer.direct[pixel][3] >= 0.0:
                color = wp.cw_mul(rho, rgb(layer.direct[pixel]) + rgb(layer.indirect[pixel]))
                if sums.emission.shape[0] > 0:
                    color += sums.emission[pixel] / float(views.samples)
    if out.color.shape[0] > 0:
        out.color[pixel] = _mixed(color, covered, clear.color, clear.linear)
    if out.albedo.shape[0] > 0:
        out.albedo[pixel] = _mixed(rho, covered, clear.albedo, clear.linear)
    if out.hdr_color.shape[0] > 0:
        out.hdr_color[pixel] = color
    if out.error.shape[0] > 0:
        out.error[pixel] = wp.where(covered > 0.0, error, 0.0)
