"""How far the mean of a film may be off, tile by tile, relative to what the picture shows there."""

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.film.accumulate import FilmData, emission_of
from warp_ir.tiles import TILE, Tiles, pixel_of_tile, tile_count

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_TRUST = wp.constant(0.25)  # of a mean that is as large as its standard error, over that of its neighbours
_DOUBT = wp.constant(5.0)  # times the standard error, below which a mean is compared with those of its neighbours


@wp.func
def _off_neighbors(film: FilmData, tiles: Tiles, tile: int, k: int) -> wp.vec3:
    """How far a pixel of one sample is off the two beside it on its mesh, were they of its colour."""
    i = pixel_of_tile(tiles, tile, k)
    sum = wp.vec3(0.0)
    count = float(0.0)
    for direction in range(2):
        j = pixel_of_tile(tiles, tile, k ^ wp.where(direction == 0, 1, TILE))
        if j >= 0 and film.mesh[j] == film.mesh[i] and wp.min(film.albedo[j]) > 0.0:
            there = wp.cw_mul(wp.cw_div(film.direct[j] + film.indirect[j], film.albedo[j]), film.albedo[i])
            sum += there - film.direct[i] - film.indirect[i]
            count += 1.0
    return sum / wp.max(count, 1.0)


@wp.func
def _mean(film: FilmData, i: int) -> wp.vec3:
    return emission_of(film, i) + film.direct[i] + film.indirect[i]


@wp.func
def _median(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.vec3:
    return wp.max(wp.min(a, b), wp.min(wp.max(a, b), c))


@wp.func
def _median_of_row(film: FilmData, columns: int, x: int, y: int) -> wp.vec3:
    row = y * columns
    left = _mean(film, row + wp.max(x - 1, 0))
    return _median(left, _mean(film, row + x), _mean(film, row + wp.min(x + 1, columns - 1)))


@wp.func
def _around(film: FilmData, tiles: Tiles, i: int) -> wp.vec3:
    """What a pixel and its eight neighbours have for the most part, but no more than itself: the median of medians."""
    x = i % tiles.columns
    y = i // tiles.columns
    above = _median_of_row(film, tiles.columns, x, wp.max(y - 1, 0))
    below = _median_of_row(film, tiles.columns, x, wp.min(y + 1, tiles.rows - 1))
    return wp.min(_mean(film, i), _median(above, _median_of_row(film, tiles.columns, x, y), below))


@wp.func
def _likely(mean: wp.float64, variance: wp.float64, around: wp.float64) -> wp.float64:
    """Radiance to which the error of a mean is relative: the less certain that is, the more that of its neighbours.

    A mean that is too large by chance has a large error, and would hide it: a pixel that meets one lamp in a hundred
    samples is off by the lamp's light, not by 100 %.
    """
    if variance <= wp.float64(0.0):
        return mean
    ratio = mean * mean / variance
    return mean + (around - mean) / (wp.float64(1.0) + wp.float64(_TRUST) * ratio * ratio)


@wp.kernel(module="warp_ir.film.accumulate")
def _measure(
    first: int,
    film: FilmData,
    tiles: Tiles,
    floor: wp.float64,
    apart: wp.array[wp.vec3],
    out: wp.array[wp.vec4d],
) -> None:
    """Sums over a tile: of the radiance L, and, if there is a floor, of its se² / (L² + floor).

    The latter once more where the filter has changed the mean, and the same of the square of that change.
    """
    tile = first + wp.tid()
    sums = wp.vec4d()
    for k in range(TILE * TILE):
        i = pixel_of_tile(tiles, tile, k)
        if i >= 0:
            mean = _mean(film, i)
            off = film.deviation[i]
            free = float(film.count[i] - 1)
            if film.count[i] == 1:  # its neighbours may say something
                off = _off_neighbors(film, tiles, tile, k)
                free = 1.5
            around = mean
            if floor > wp.float64(0.0) and wp.max(wp.abs(off) * _DOUBT - mean * wp.sqrt(free)) > 0.0:
                around = _around(film, tiles, i)
            change = wp.vec3(0.0)
            if apart.shape[0] > 0:
                change = apart[i]
            for c in range(3):
                s = wp.float64(off[c])
                variance = s * s / wp.float64(free)
                x = _likely(wp.float64(mean[c]), variance, wp.float64(around[c]))
                scale = x * x + floor
                sums[0] += wp.float64(mean[c])
                if floor > wp.float64(0.0):
                    sums[1] += variance / scale
                    d = wp.float64(change[c])
                    if d != wp.float64(0.0):
                        sums[2] += variance / scale
                        sums[3] += d * d / scale
    out[tile] = sums


def measure(
    film: Any, tiles: Any, floor: float, launcher: Launcher, apart: npt.NDArray[Any] | None = None
) -> npt.NDArray[np.float64]:
    """The sums of `_measure` for all tiles of a `FilmData`, [tiles, 4]; `apart` is what the filter changes."""
    out = launcher.empty(tile_count(tiles.columns, tiles.rows), wp.vec4d)
    change = launcher.array(np.zeros((0, 3)) if apart is None else apart.reshape(-1, 3), wp.vec3)
    launcher.launch(_measure, out.shape[0], [film, tiles, floor, change, out])
    return np.asarray(out.numpy())
