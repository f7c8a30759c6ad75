"""Takes the noise out of an image of irradiance, and only that.

An edge-avoiding à-trous wavelet filter (Dammertz et al. 2010) guided by measured variance (Schied et al. 2017), for
light that came directly and light that came by way of surfaces apart: the one has shadows, the other hardly any.
A neighbour counts if it lies on the same surface and differs by no more than the noise explains: as the
noise goes to zero, so does the filter's bias.
"""

from typing import Any

import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.reconstruction.pixel_surfaces import PixelSurfaces, fits

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

LEVELS = 4
"""Passes; their taps lie 1, 2, 4, ... pixels apart. In a fifth next to nothing would be alike."""
_SIGMAS = (5.5, 7.5)
"""Standard errors by which two estimates of one value may well differ, in the first pass: fewer in direct light, whose
shadows are sharp ..."""
_NARROW = 0.45
"""... and its factor from pass to pass: what is left then is smooth, and differences farther apart are real."""


@wp.struct
class IrradianceLayer:
    """An image of irradiance over π in two parts, each with the variance of its mean channel; -1: no value."""

    direct: wp.array[wp.vec4]
    indirect: wp.array[wp.vec4]


@wp.func
def mean_channel(v: wp.vec3) -> float:
    """The mean of three channels."""
    return (v[0] + v[1] + v[2]) * (1.0 / 3.0)


@wp.func
def mean_channels(direct: wp.vec3, indirect: wp.vec3) -> wp.vec2:
    """The same of both parts."""
    return wp.vec2(mean_channel(direct), mean_channel(indirect))


@wp.func
def value(row: wp.vec4) -> wp.vec3:
    """Irradiance over π of a row of a `IrradianceLayer`, without its variance."""
    return wp.vec3(row[0], row[1], row[2])


@wp.func
def _tap(k: int) -> float:
    """The middle of the B3 spline: its ends cost more than they take away."""
    return wp.where(k == 0, 0.375, 0.25)


@wp.func
def _alike(a: wp.vec4, b: wp.vec4, sigma: float) -> float:
    """Whether `b` can be an estimate of the value of `a`, by the noise of `a`: so a spike is mended and not spread."""
    d = (a[0] + a[1] + a[2] - b[0] - b[1] - b[2]) * (1.0 / 3.0)
    t = 1.0 + d * d / (2.0 * sigma * sigma * a[3] + 1.0e-30)
    return 1.0 / (t * t)


@wp.kernel
def _filter_level(
    first: int, surfaces: PixelSurfaces, source: IrradianceLayer, out: IrradianceLayer, step: int, sigmas: wp.vec2
) -> None:
    """One pass of 3 x 3 taps, `step` pixels apart."""
    p = first + wp.tid()
    here = source.direct[p]
    there = source.indirect[p]
    known = here[3] >= 0.0
    row = p // surfaces.columns
    column = p - row * surfaces.columns
    direct = wp.vec4(0.0)
    indirect = wp.vec4(0.0)
    weights = wp.vec2(0.0)
    position = surfaces.position[p]
    normal = surfaces.normal[p]
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
                        w = _tap(dx) * _tap(dy)
                        a = w
                        b = w
                        if q != p:
                            fit = fits(surfaces, q, position, normal)
                            a = w * fit[0]
                            b = w * fit[1]
                            if known:
                                a *= _alike(here, d, sigmas[0])
                                b *= _alike(there, i, sigmas[1])
                        direct += wp.vec4(d[0] * a, d[1] * a, d[2] * a, d[3] * a * a)
                        indirect += wp.vec4(i[0] * b, i[1] * b, i[2] * b, i[3] * b * b)
                        weights += wp.vec2(a, b)
    out.direct[p] = _normalized(direct, weights[0])
    out.indirect[p] = _normalized(indirect, weights[1])


@wp.func
def _normalized(sum: wp.vec4, weight: float) -> wp.vec4:
    if weight < 1.0e-6:
        return wp.vec4(0.0, 0.0, 0.0, -1.0)
    k = 1.0 / weight
    return wp.vec4(sum[0] * k, sum[1] * k, sum[2] * k, sum[3] * k * k)


def new_layer(direct: Any, indirect: Any) -> Any:
    """A `IrradianceLayer` of two arrays."""
    layer = IrradianceLayer()
    layer.direct, layer.indirect = direct, indirect
    return layer


def filter_layer(surfaces: Any, layer: Any, other: Any, launcher: Launcher) -> tuple[Any, Any]:
    """The filtered `IrradianceLayer`, and one to be overwritten: both given ones are used up."""
    pixels = surfaces.columns * surfaces.rows
    for level in range(LEVELS):
        sigmas = wp.vec2(*(sigma * _NARROW**level for sigma in _SIGMAS))
        launcher.launch(_filter_level, pixels, [surfaces, layer, other, 1 << level, sigmas])
        layer, other = other, layer
    return layer, other
