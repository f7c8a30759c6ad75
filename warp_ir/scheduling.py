"""When a render stops, and which tiles each iteration is for.

After n iterations a tile has the squared error e/n; one more takes away e/n - e/(n+1). Iterations are for those tiles
from which they take away most error for their time, so that in the end n is in proportion to √e, as it is where a sum
of errors is reached with fewest samples (Neyman 1934). A tile that is good enough costs nothing more until the others
are as good. When there is no more time for all tiles that an iteration should be for, the worst of them get it.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from warp_ir.film.film import Film
from warp_ir.settings import RenderSettings

_FEWEST = 2
"""Iterations that all tiles get, if there is time: fewer say little about the error of a tile."""
_FIXED = 0.2
"""Time of an iteration without tiles to that of one with all of them, about: choices must not hang on clocks."""
_LEAST = 1 / 8
"""Share of the tiles that an iteration is for at least: else it is no work for many cores."""
_HASTE = 0.8
"""Share of the time left that the last iteration is planned to take: the worst tiles take longer than others."""
Floats = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Progress:
    """How far a render has come, as `render` tells its `progress` callback after every iteration."""

    iterations: int
    """Iterations done."""
    seconds: float
    """Seconds of rendering so far."""
    error: float
    """As `Film.error`, last measured; without the filter's part while the target is far. NaN before two iterations."""
    fraction: float
    """Share of the nearest limit that is used up, 0 to 1."""
    seconds_left: float
    """Estimate of what remains [s]; NaN if unknown."""


class AdaptiveScheduler:
    """Watches a film while iterations are added to it, and chooses the tiles of the next."""

    def __init__(self, film: Film, settings: RenderSettings, chooses: bool) -> None:
        """Begins with a film that may hold iterations; `chooses` says whether tiles may be left out."""
        self._film, self._settings, self._chooses = film, settings, chooses
        self._before = film.seconds, film.iterations, int(film.tile_iterations.sum())
        self._error = math.nan

    def update(self, reserve: float, fixed: float) -> Progress:
        """Takes note of an iteration, and chooses the tiles of the next.

        Args:
            reserve: Time [s] to keep for the end.
            fixed: Share of the time since the beginning that would have passed without any tiles.
        """
        film, limit = self._film, self._settings.time_limit
        begin, iterations, tiles = self._before
        seconds = film.seconds - begin
        per_iteration = fixed * seconds / (film.iterations - iterations)
        per_tile = (1.0 - fixed) * seconds / (int(film.tile_iterations.sum()) - tiles)
        left = math.inf if limit is None else limit - reserve - film.seconds
        most = (_HASTE * left - per_iteration) / per_tile
        short = self._chooses and per_iteration + per_tile * film.chosen.sum() > left
        due = _is_due(film.iterations)
        if short or due:
            squares = film.squared_errors()
            if due and math.sqrt(squares.sum()) <= (self._settings.target_error or 0.0):
                squares = film.squared_errors(filtered=True)  # dear: the picture has to be made
            if due:
                self._error = math.sqrt(squares.sum())
            if self._chooses:
                film.choose(select_tiles(squares, film.tile_iterations, most))
        return self._progress(reserve + per_iteration + per_tile * film.chosen.sum())

    def _progress(self, needed: float) -> Progress:
        """What is used up of each limit, if one more iteration needs so much time; the largest share counts."""
        film, settings, error = self._film, self._settings, self._error
        shares = [film.iterations / settings.iteration_limit]
        if settings.time_limit is not None:
            # An iteration that would end beyond the limit is not begun.
            shares.append((film.seconds + needed) / settings.time_limit)
        if settings.target_error is not None and error > 0.0:
            shares.append((settings.target_error / error) ** 2)
        elif settings.target_error is not None and error == 0.0:
            shares.append(1.0)
        fraction = min(max(shares), 1.0)
        left = film.seconds * (1.0 / fraction - 1.0) if fraction > 0.0 else math.nan
        return Progress(film.iterations, film.seconds, error, fraction, left)


def select_tiles(squares: Floats, iterations: npt.NDArray[np.int32], most: float = math.inf) -> Mask:
    """Which tiles the next iteration should be for, bool [tiles].

    Args:
        squares: What each tile has in the squared error of the picture.
        iterations: How many each has had.
        most: How many tiles there is time for; if that is too few, all are chosen.
    """
    count = len(squares)
    least = math.ceil(_LEAST * count)
    gains = squares / (iterations + 1)
    order = np.argsort(-gains, kind="stable")
    cost = _FIXED + (1.0 - _FIXED) * np.arange(1, count + 1) / count
    best = count
    if iterations.max() >= _FEWEST:
        best = least + int(np.argmax((np.cumsum(gains[order]) / cost)[least - 1 :]))
    if most < least:
        return np.ones(count, bool)
    out = np.zeros(count, bool)
    out[order[: int(min(best, most))]] = True
    return out


def _is_due(iterations: int) -> bool:
    """Measuring the error may cost as much as a cheap iteration: it is done every eighth part of the way."""
    due = 2
    while due < iterations:
        due += due // 8 + 1
    return due == iterations
