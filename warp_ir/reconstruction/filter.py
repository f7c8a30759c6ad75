"""Variance-guided filter of irradiance.

An edge-avoiding à-trous wavelet filter (Dammertz et al. 2010) guided by measured variance (Schied et al. 2017). Direct
and indirect irradiance are filtered separately: direct light has sharp shadows, indirect light hardly any. A
neighbour's weight is high if it lies on the same surface and differs by no more than the noise explains: the bias of
the filter vanishes with the noise. Weights are symmetric and a pixel keeps the rest, so no light is lost.
"""

import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.reconstruction.pixel_surfaces import PixelSurfaces, pixel_match_weights

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

LEVELS = 4
"""Levels of the wavelet transform; taps are 1, 2, 4, ... pixels apart. At a fifth hardly any taps would be similar."""
SIGMAS = (5.5, 12.0)
"""Standard errors by which similar values may differ at the first level, for direct and indirect irradiance. It is
smaller for direct light, because its shadows are sharp."""
SIGMA_DECAY = 0.45
"""Factor of the sigmas from level to level: filtered values are smooth, and differences over a distance are real."""


@wp.struct
class IrradianceLayer:
    """An image of direct and indirect irradiance over π; w is the variance of the mean channel, -1: no value."""

    direct: wp.array[wp.vec4]
    indirect: wp.array[wp.vec4]


@wp.func
def mean_channel(v: wp.vec3) -> float:
    """The mean of three channels."""
    return (v[0] + v[1] + v[2]) * (1.0 / 3.0)


@wp.func
def mean_channels(direct: wp.vec3, indirect: wp.vec3) -> wp.vec2:
    """The mean channel of direct and of indirect light."""
    return wp.vec2(mean_channel(direct), mean_channel(indirect))


@wp.func
def rgb(row: wp.vec4) -> wp.vec3:
    """Irradiance over π of a row of an `IrradianceLayer`, without its variance."""
    return wp.vec3(row[0], row[1], row[2])


@wp.func
def tap_weight(k: int) -> float:
    """The three middle taps, -1 to 1, of the B3 spline, over their sum; the outer two cost more than they remove."""
    return wp.where(k == 0, 3.0 / 7.0, 2.0 / 7.0)


@wp.func
def similarity(a: wp.vec4, b: wp.vec4, sigma: float) -> float:
    """Weight in [0, 1] of two values, by their difference in units of their noise; the same for (b, a).

    Noise is the mean of both variances. By that of `a` alone the picture would darken: what is dim by chance has little
    noise, and would take nothing from what is bright. By the smaller one an outlier would keep all its light.
    """
    d = (a[0] + a[1] + a[2] - b[0] - b[1] - b[2]) * (1.0 / 3.0)
    t = 1.0 + d * d / (sigma * sigma * (a[3] + b[3]) + 1.0e-30)
    return 1.0 / (t * t)


@wp.func
def weighted(row: wp.vec4, weight: float) -> wp.vec4:
    """A row times a weight, and its variance times the square."""
    return wp.vec4(row[0] * weight, row[1] * weight, row[2] * weight, row[3] * weight * weight)


@wp.kernel
def _filter_level(
    first: int, surfaces: PixelSurfaces, source: IrradianceLayer, out: IrradianceLayer, step: int, sigmas: wp.vec2
) -> None:
    """One level of 3 x 3 taps, `step` pixels apart.

    Two pixels exchange light by one weight, and a pixel keeps what it does not exchange: the sum over a surface stays.
    """
    p = first + wp.tid()
    own_direct = source.direct[p]
    own_indirect = source.indirect[p]
    has_value = own_direct[3] >= 0.0
    row = p // surfaces.columns
    column = p - row * surfaces.columns
    direct = wp.vec4(0.0)
    indirect = wp.vec4(0.0)
    weights = wp.vec2(0.0)
    for dy in range(-1, 2):
        y = row + dy * step
        if y >= 0 and y < surfaces.rows:
            for dx in range(-1, 2):
                x = column + dx * step
                if x >= 0 and x < surfaces.columns:
                    q = y * surfaces.columns + x
                    d = source.direct[q]
                    if d[3] >= 0.0:
                        i = source.indirect[q]
                        w = tap_weight(dx) * tap_weight(dy)
                        if q != p:
                            match = w * pixel_match_weights(surfaces, p, q)
                            if has_value:
                                match[0] *= similarity(own_direct, d, sigmas[0])
                                match[1] *= similarity(own_indirect, i, sigmas[1])
                            direct += weighted(d, match[0])
                            indirect += weighted(i, match[1])
                            weights += match
    if has_value:
        direct += weighted(own_direct, 1.0 - weights[0])
        indirect += weighted(own_indirect, 1.0 - weights[1])
        weights = wp.vec2(1.0)
    out.direct[p] = normalized(direct, weights[0])
    out.indirect[p] = normalized(indirect, weights[1])


@wp.func
def normalized(sum: wp.vec4, weight: float) -> wp.vec4:
    """Weighted mean and its variance, from a sum whose variance has squared weights; -1 without weight."""
    if weight < 1.0e-6:
        return wp.vec4(0.0, 0.0, 0.0, -1.0)
    k = 1.0 / weight
    return wp.vec4(sum[0] * k, sum[1] * k, sum[2] * k, sum[3] * k * k)


def new_layer(direct: "wp.array[wp.vec4]", indirect: "wp.array[wp.vec4]") -> IrradianceLayer:
    """An `IrradianceLayer` of two arrays."""
    layer = IrradianceLayer()
    layer.direct, layer.indirect = direct, indirect
    return layer


def filter_layer(
    surfaces: PixelSurfaces, layer: IrradianceLayer, scratch: IrradianceLayer, launcher: Launcher
) -> tuple[IrradianceLayer, IrradianceLayer]:
    """Filters a layer, and returns the result and a free layer; both arguments are overwritten."""
    pixels = surfaces.columns * surfaces.rows
    for level in range(LEVELS):
        sigmas = wp.vec2(*(sigma * SIGMA_DECAY**level for sigma in SIGMAS))
        launcher.launch(_filter_level, pixels, [surfaces, layer, scratch, 1 << level, sigmas])
        layer, scratch = scratch, layer
    return layer, scratch
