"""Adaptive sampling per tile of 8 x 8 pixels, and the limits that end a render.

After n iterations a tile has the squared error e/n; one more iteration reduces it by e/n - e/(n+1). Each iteration
samples the tiles where the reduction per unit of time is largest. In the end n is proportional to √e, the allocation
that reaches a given sum of errors with the fewest samples (Neyman 1934): a tile with a small error is not sampled until
the others have one as small. If the time left is too short for all the tiles of an iteration, the worst ones get it.
"""

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from warp_ir.film.film import Film
from warp_ir.settings import RenderSettings

_MIN_ITERATIONS = 2
"""Iterations that all tiles get if there is time: fewer give no reliable error of a tile."""
_FIXED_COST = 0.2
"""Approximate cost of an iteration without tiles, relative to one with all tiles. A constant, not a measurement, so
that the choice of tiles is independent of timing."""
_MIN_TILE_SHARE = 1 / 8
"""Least fraction of the tiles in an iteration: fewer do not occupy many cores."""
_TIME_MARGIN = 0.8
"""Fraction of the time left that the last iteration is planned to take: the worst tiles take longer than the mean."""
_UNLIT_ITERATIONS = 64
"""Iterations of a picture without light, after which a target error gives up: no error of it is known."""
_FIRST_CHOICE = 16
"""Iterations of all tiles before rounds leave out any: a round may leave out a tile throughout, and the noise of a
picture is known only if the first doublings of the iterations have sampled every tile."""
Floats = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Progress:
    """Progress of a render, as passed to the `progress` callback after every iteration."""

    iterations: int
    """Number of iterations done."""
    seconds: float
    """Seconds of rendering so far."""
    error: float
    """`Film.error` when last measured, without the filter's bias far from the target; NaN before two iterations."""
    fraction: float
    """Fraction of the nearest limit that is used up, 0 to 1."""
    seconds_left: float
    """Estimated remaining time [s]; NaN if unknown."""
    film: Film = field(repr=False)
    """The film, whose `radiance()` is the picture so far; filtering it takes a part of an iteration's time."""


class AdaptiveScheduler:
    """Chooses the tiles of the next iteration of a film, and reports its progress."""

    def __init__(self, film: Film, settings: RenderSettings, adaptive: bool) -> None:
        """Starts from a film that may hold iterations; `adaptive` says whether iterations may skip tiles."""
        self._film, self._settings, self._adaptive = film, settings, adaptive
        self._start = film.seconds, film.iterations, int(film.tile_iterations.sum())
        self._error = math.nan

    def update(self, reserve: float, fixed_share: float) -> Progress:
        """Reports an iteration that has been added to the film, and chooses the tiles of the next.

        Args:
            reserve: Time to reserve for making the picture [s].
            fixed_share: Fraction of the time so far that does not depend on the number of tiles.
        """
        film, limit = self._film, self._settings.time_limit
        start_seconds, start_iterations, start_tiles = self._start
        seconds = film.seconds - start_seconds
        per_iteration = fixed_share * seconds / (film.iterations - start_iterations)
        per_tile = (1.0 - fixed_share) * seconds / (int(film.tile_iterations.sum()) - start_tiles)
        left = math.inf if limit is None else limit - reserve - film.seconds
        max_tiles = (_TIME_MARGIN * left - per_iteration) / per_tile
        does_not_fit = self._adaptive and per_iteration + per_tile * film.chosen.sum() > left
        measure_error = _is_error_due(film.iterations)
        if self._settings.target_error is not None and film.iterations.bit_count() == 1:
            film.measure_noise()  # makes the picture after 1, 2, 4, ... iterations
        if does_not_fit or measure_error:
            squares = film.squared_errors()
            if measure_error:
                squares = self._measure_error(squares)
            if self._adaptive:
                film.choose(select_tiles(squares, film.tile_iterations, max_tiles))
        return self._progress(reserve + per_iteration + per_tile * film.chosen.sum())

    def _measure_error(self, squares: Floats) -> Floats:
        """Measures the error of the picture; returns the contributions of the tiles, given those of the mean."""
        errors = self._film.filtered_errors(squares)
        if math.sqrt(errors.sum()) <= (self._settings.target_error or 0.0):
            squares = errors = self._film.squared_errors(filtered=True)  # expensive: it makes the picture
        self._error = 1.0 if self._film.is_unlit() else math.sqrt(errors.sum())
        return squares

    def _progress(self, needed: float) -> Progress:
        """Progress towards the nearest limit, if the next iteration and the picture need `needed` seconds."""
        film, settings, error = self._film, self._settings, self._error
        shares = [film.iterations / settings.iteration_limit]
        if settings.time_limit is not None:
            # An iteration that would exceed the limit is not started.
            shares.append((film.seconds + needed) / settings.time_limit)
        if settings.target_error is not None and error == 1.0 and film.is_unlit():
            shares.append(film.iterations / _UNLIT_ITERATIONS)
        elif settings.target_error is not None and error > 0.0:
            shares.append((settings.target_error / error) ** 2)
        elif settings.target_error is not None and error == 0.0:
            shares.append(1.0)
        fraction = min(max(shares), 1.0)
        left = film.seconds * (1.0 / fraction - 1.0) if fraction > 0.0 else math.nan
        return Progress(film.iterations, film.seconds, error, fraction, left, film)


class RoundScheduler(AdaptiveScheduler):
    """The same for a film whose iterations are rendered in rounds, by several devices: it decides between rounds.

    What it decides depends on the film alone, and so not on which device has rendered what, nor on time.
    """

    def round_end(self) -> float:
        """Iterations of the film at the end of the round: powers of two, from 16 on also three between them."""
        settings, count = self._settings, self._film.iterations
        if not self._adaptive and settings.target_error is None:
            return settings.iteration_limit
        end = 2
        while end <= count:
            power = 1 << (end.bit_length() - 1)
            end += power if end < _FIRST_CHOICE else power // 4
        return min(end, settings.iteration_limit)

    def finish_round(self) -> None:
        """Measures the error, and chooses the tiles of the next round."""
        if not self._adaptive and self._settings.target_error is None:
            return
        if self._settings.target_error is not None and self._film.iterations.bit_count() == 1:
            self._film.measure_noise()
        squares = self._measure_error(self._film.squared_errors())
        if self._adaptive and self._film.iterations >= _FIRST_CHOICE:
            self._film.choose(select_tiles(squares, self._film.tile_iterations))

    def report(self, reserve: float) -> Progress:
        """Reports what has been added to the film; `reserve` is the time that making the picture takes [s]."""
        return self._progress(reserve)


def select_tiles(squares: Floats, iterations: npt.NDArray[np.int32], max_tiles: float = math.inf) -> Mask:
    """Selects the tiles of the next iteration, bool [tiles].

    Args:
        squares: Contribution of each tile to the squared error of the picture, [tiles].
        iterations: Number of iterations of each tile, [tiles].
        max_tiles: Number of tiles for which there is time; if it is below the minimum, all tiles are selected.
    """
    count = len(squares)
    min_tiles = math.ceil(_MIN_TILE_SHARE * count)
    gains = squares / (iterations + 1)
    order = np.argsort(-gains, kind="stable")
    cost = _FIXED_COST + (1.0 - _FIXED_COST) * np.arange(1, count + 1) / count
    best = count
    if iterations.max() >= _MIN_ITERATIONS:
        best = min_tiles + int(np.argmax((np.cumsum(gains[order]) / cost)[min_tiles - 1 :]))
    if max_tiles < min_tiles:
        return np.ones(count, bool)
    out = np.zeros(count, bool)
    out[order[: int(min(best, max_tiles))]] = True
    return out


def _is_error_due(iterations: int) -> bool:
    """Whether to measure the error, which may cost as much as a cheap iteration: after every 12 % more iterations."""
    due = 2
    while due < iterations:
        due += due // 8 + 1
    return due == iterations
