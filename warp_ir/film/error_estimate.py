"""Estimated squared error of a film's mean, tile by tile, relative to the radiance of the picture.

The relative error of a pixel is se² / (L² + ε): se is the standard error of its mean radiance L, and ε, the
`regularization`, is 1 % of the squared mean of the picture.
"""

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.film.accumulate import FilmData, emission_of
from warp_ir.tiles import TILE, Tiles, pixel_of_tile, tile_count

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_OWN_WEIGHT = wp.constant(0.25)  # of a mean that equals its standard error, relative to the neighbours' weight
_UNCERTAIN = wp.constant(5.0)  # standard errors: a mean below that many is compared with its neighbours'


@wp.func
def _difference_from_neighbors(film: FilmData, tiles: Tiles, tile: int, k: int) -> wp.vec3:
    """Mean difference of a pixel from one horizontal and one vertical neighbour on its mesh, with its own albedo.

    It stands for the standard deviation while the pixel has one sample.
    """
    i = pixel_of_tile(tiles, tile, k)
    sum = wp.vec3(0.0)
    count = float(0.0)
    for direction in range(2):
        j = pixel_of_tile(tiles, tile, k ^ wp.where(direction == 0, 1, TILE))
        if j >= 0 and film.mesh[j] == film.mesh[i] and wp.min(film.albedo[j]) > 0.0:
            neighbor = wp.cw_mul(wp.cw_div(film.direct[j] + film.indirect[j], film.albedo[j]), film.albedo[i])
            sum += neighbor - film.direct[i] - film.indirect[i]
            count += 1.0
    return sum / wp.max(count, 1.0)


@wp.func
def _mean_radiance(film: FilmData, i: int) -> wp.vec3:
    return emission_of(film, i) + film.direct[i] + film.indirect[i]


@wp.func
def _median(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.vec3:
    return wp.max(wp.min(a, b), wp.min(wp.max(a, b), c))


@wp.func
def _median_of_row(film: FilmData, columns: int, x: int, y: int) -> wp.vec3:
    row = y * columns
    left = _mean_radiance(film, row + wp.max(x - 1, 0))
    return _median(left, _mean_radiance(film, row + x), _mean_radiance(film, row + wp.min(x + 1, columns - 1)))


@wp.func
def _neighborhood_median(film: FilmData, tiles: Tiles, i: int) -> wp.vec3:
    """Median of the row medians of a pixel's 3 x 3 neighbourhood, at most the pixel's own mean."""
    x = i % tiles.columns
    y = i // tiles.columns
    above = _median_of_row(film, tiles.columns, x, wp.max(y - 1, 0))
    below = _median_of_row(film, tiles.columns, x, wp.min(y + 1, tiles.rows - 1))
    return wp.min(_mean_radiance(film, i), _median(above, _median_of_row(film, tiles.columns, x, y), below))


@wp.func
def _reference_radiance(mean: wp.float64, variance: wp.float64, neighbors: wp.float64) -> wp.float64:
    """Radiance to which the error of a mean is relative: the more uncertain the mean, the closer to its neighbours'.

    A mean that is too large by chance has a large error and would hide it: a pixel whose hundred samples hit a lamp
    once is off by the lamp's light, not by 100 %.
    """
    if variance <= wp.float64(0.0):
        return mean
    ratio = mean * mean / variance
    return mean + (neighbors - mean) / (wp.float64(1.0) + wp.float64(_OWN_WEIGHT) * ratio * ratio)


@wp.kernel(module="warp_ir.film.accumulate")
def _sum_tile_errors(
    first: int,
    film: FilmData,
    tiles: Tiles,
    regularization: wp.float64,
    filter_difference: wp.array[wp.vec3],
    out: wp.array[wp.vec4d],
) -> None:
    """Sums over a tile: L; se² / (L² + ε); both se² and d² over L² + ε of the pixels that the filter has changed by d.

    Without `regularization` ε only the first is computed.
    """
    tile = first + wp.tid()
    sums = wp.vec4d()
    for k in range(TILE * TILE):
        i = pixel_of_tile(tiles, tile, k)
        if i >= 0:
            mean = _mean_radiance(film, i)
            deviation = film.standard_deviation[i]
            degrees_of_freedom = float(film.count[i] - 1)
            if film.count[i] == 1:
                deviation = _difference_from_neighbors(film, tiles, tile, k)
                degrees_of_freedom = 1.5
            neighbors = mean
            uncertain = wp.max(wp.abs(deviation) * _UNCERTAIN - mean * wp.sqrt(degrees_of_freedom)) > 0.0
            if regularization > wp.float64(0.0) and uncertain:
                neighbors = _neighborhood_median(film, tiles, i)
            change = wp.vec3(0.0)
            if filter_difference.shape[0] > 0:
                change = filter_difference[i]
            for c in range(3):
                s = wp.float64(deviation[c])
                variance = s * s / wp.float64(degrees_of_freedom)
                x = _reference_radiance(wp.float64(mean[c]), variance, wp.float64(neighbors[c]))
                scale = x * x + regularization
                sums[0] += wp.float64(mean[c])
                if regularization > wp.float64(0.0):
                    sums[1] += variance / scale
                    d = wp.float64(change[c])
                    if d != wp.float64(0.0):
                        sums[2] += variance / scale
                        sums[3] += d * d / scale
    out[tile] = sums


def tile_errors(
    film: FilmData,
    tiles: Tiles,
    regularization: float,
    launcher: Launcher,
    filter_difference: npt.NDArray[np.float32] | None = None,
) -> npt.NDArray[np.float64]:
    """Sums of radiance and of relative squared errors over every tile.

    Args:
        film: The film.
        tiles: Any tiles of it; all are summed.
        regularization: ε in the denominator of relative errors; 0: only the radiance is summed.
        launcher: Runs the kernel.
        filter_difference: Filtered picture minus unfiltered mean, [height, width, 3].

    Returns:
        [tiles, 4]: radiance L, se² / (L² + ε), the same of those values that the filter has changed, and the squared
        change over L² + ε.
    """
    out = launcher.empty(tile_count(tiles.columns, tiles.rows), wp.vec4d)
    rows = np.zeros((0, 3)) if filter_difference is None else filter_difference.reshape(-1, 3)
    change = launcher.array(rows, wp.vec3)
    launcher.launch(_sum_tile_errors, out.shape[0], [film, tiles, regularization, change, out])
    return np.asarray(out.numpy())
