"""Takes the noise out of an image of irradiance, and only that.

An edge-avoiding à-trous wavelet filter (Dammertz et al. 2010) guided by measured variance (Schied et al. 2017).
A neighbour counts if it lies on the same surface and differs by no more than the noise explains: as the
noise goes to zero, so does the filter's bias.
"""

from typing import Any

import warp as wp

from warp_ir.launch import Launcher

wp.set_module_options({"enable_backward": False})

LEVELS = 4
"""Passes; their taps lie 1, 2, 4, ... pixels apart."""
_SIGMA = wp.constant(2.0)  # standard errors by which two estimates of one value may differ
_NORMAL_POWER = wp.constant(16.0)
_PLANE = wp.constant(1.0)  # footprints by which a point may lie off the plane


@wp.struct
class Surfaces:
    """What each pixel of an image stands for: the surface that is seen through its centre."""

    columns: int
    rows: int
    position: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]  # unit
    footprint: wp.array[wp.float32]  # size of a pixel there; 0: background


@wp.struct
class Layer:
    """An image of irradiance over π in two parts, with the variance of their mean channel; -1: no value."""

    direct: wp.array[wp.vec3]
    indirect: wp.array[wp.vec3]
    variance: wp.array[wp.float32]


@wp.func
def mean_channel(v: wp.vec3) -> float:
    """The mean of three channels."""
    return (v[0] + v[1] + v[2]) * (1.0 / 3.0)


@wp.func
def same_surface(surfaces: Surfaces, p: int, position: wp.vec3, normal: wp.vec3) -> float:
    """How well a point belongs to the surface of pixel `p`: 1 on its plane and facing its way, falling to 0."""
    if surfaces.footprint[p] <= 0.0:
        return 0.0
    facing = wp.max(wp.dot(surfaces.normal[p], normal), 0.0)
    apart = position - surfaces.position[p]
    off = wp.max(wp.abs(wp.dot(surfaces.normal[p], apart)), wp.abs(wp.dot(normal, apart)))
    return wp.pow(facing, _NORMAL_POWER) * wp.exp(-off / (_PLANE * surfaces.footprint[p]))


@wp.func
def _tap(k: int) -> float:
    """The B3 spline at -2 ... 2."""
    return wp.where(k == 0, 0.375, wp.where(wp.abs(k) == 1, 0.25, 0.0625))


@wp.kernel
def _filter_level(first: int, surfaces: Surfaces, source: Layer, out: Layer, step: int) -> None:
    """One pass of 5 x 5 taps, `step` pixels apart."""
    p = first + wp.tid()
    direct = wp.vec3(0.0)
    indirect = wp.vec3(0.0)
    variance = float(0.0)
    weights = float(0.0)
    value = mean_channel(source.direct[p] + source.indirect[p])
    for dy in range(-2, 3):
        for dx in range(-2, 3):
            x = p % surfaces.columns + dx * step
            y = p // surfaces.columns + dy * step
            if x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows:
                q = y * surfaces.columns + x
                if source.variance[q] >= 0.0:
                    w = _tap(dx) * _tap(dy)
                    if q != p:
                        w *= same_surface(surfaces, p, surfaces.position[q], surfaces.normal[q])
                        if source.variance[p] >= 0.0:
                            noise = wp.sqrt(source.variance[p] + source.variance[q])
                            different = wp.abs(mean_channel(source.direct[q] + source.indirect[q]) - value)
                            w *= wp.exp(-different / (_SIGMA * noise + 1.0e-30))
                    direct += w * source.direct[q]
                    indirect += w * source.indirect[q]
                    variance += w * w * source.variance[q]
                    weights += w
    out.variance[p] = -1.0
    if weights > 1.0e-6:
        out.direct[p] = direct / weights
        out.indirect[p] = indirect / weights
        out.variance[p] = variance / (weights * weights)
    else:
        out.direct[p] = source.direct[p]
        out.indirect[p] = source.indirect[p]


def new_layer(pixels: int, launcher: Launcher) -> Any:
    """An uninitialised `Layer`."""
    layer = Layer()
    layer.direct, layer.indirect = launcher.empty(pixels, wp.vec3), launcher.empty(pixels, wp.vec3)
    layer.variance = launcher.empty(pixels, wp.float32)
    return layer


def filter_layer(surfaces: Any, layer: Any, launcher: Launcher) -> Any:
    """The filtered `Layer`; the given one is used up."""
    pixels = surfaces.columns * surfaces.rows
    other = new_layer(pixels, launcher)
    for level in range(LEVELS):
        launcher.launch(_filter_level, pixels, [surfaces, layer, other, 1 << level])
        layer, other = other, layer
    return layer
