"""The parts of a render: which iterations of which tiles are rendered together.

They are a function of the size of the picture, of the settings, and of the film where a round begins: not of how many
devices there are, nor of how fast they are. So the sums are added up in the same order wherever the parts were made,
and the picture has the same bits.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from warp_ir.film import Film
from warp_ir.tiles import TILE

_TILE_PIXELS = 1 << 20
"""Largest number of pixels of a part: larger pictures are divided into strips of tiles."""
_SAMPLES = {"cpu": 1 << 21, "cuda": 1 << 27}
"""Samples (pixels times iterations) of a part by kind of device: some ten seconds of a core, or one of a GPU."""
_ROUND_SAMPLES = {"cpu": 1 << 19, "cuda": 1 << 25}
"""Samples of a part where decisions are taken between rounds, which are short at first."""
_LEAST_ITERATIONS = 16
"""Of a part where there are as many: its film is sent and added once, however many iterations it holds."""
_MOST_PARTS = 1024
"""Parts of a strip where the number of iterations is known."""
_MOST_PARTS_OF_ROUND = 256


@dataclass(frozen=True, eq=False)
class Round:
    """What all parts between two decisions share."""

    chosen: npt.NDArray[np.bool_]
    """[tiles], the tiles that are sampled."""
    skipped: npt.NDArray[np.int32]
    """[tiles], iterations before the round that left out each tile."""
    deadline: float
    """Seconds since the epoch (`time.time`) at which its parts end; infinity: they are whole."""


@dataclass(frozen=True, eq=False)
class Part:
    """Iterations of some tiles, which one device renders."""

    iterations: range
    strip: tuple[int, int]
    """First and end of its tiles among those that the round samples."""
    strips: int
    """Number of parts with the same iterations."""
    least: int
    """Iterations that are rendered however late it is."""
    round: Round

    @property
    def tiles(self) -> npt.NDArray[np.bool_]:
        """[tiles], those of the part."""
        if self.strips == 1:
            return self.round.chosen
        tiles = np.zeros_like(self.round.chosen)
        tiles[np.flatnonzero(self.round.chosen)[slice(*self.strip)]] = True
        return tiles


def part_iterations(pixels: int, iterations: float, kind: str, *, rounds: bool) -> int:
    """Iterations of a part.

    Args:
        pixels: Pixels of the picture.
        iterations: Those of the render, or of the round; infinity: not known.
        kind: "cpu" or "cuda".
        rounds: Whether decisions are taken between rounds.
    """
    samples = (_ROUND_SAMPLES if rounds else _SAMPLES)[kind]
    most = _MOST_PARTS_OF_ROUND if rounds else _MOST_PARTS
    few = math.ceil(iterations / most) if iterations < math.inf else 1
    return max(samples // min(pixels, _TILE_PIXELS), few, 1 if rounds else _LEAST_ITERATIONS)


def parts_of_round(film: Film, round: Round, end: float, size: int, first: int) -> Iterator[Part]:
    """The parts of a round, in order; they begin at multiples of `size`, so that a resumed film has the same ones.

    Args:
        film: The film of the whole, where the round begins or goes on.
        round: The round.
        end: Iterations of the film at the end of the round.
        size: Iterations of a part.
        first: Number of the film's first iteration.
    """
    sampled = int(round.chosen.sum())
    strips = max(1, math.ceil(sampled * TILE * TILE / _TILE_PIXELS))
    bounds = [sampled * k // strips for k in range(strips + 1)]
    begin = film.iterations
    least = 0 if begin else 1
    while begin < end:
        if round.deadline < math.inf and not least and time.time() >= round.deadline:
            return
        stop = int(min((begin // size + 1) * size, end))
        for k in range(strips):
            strip = bounds[k], bounds[k + 1]
            yield Part(range(first + begin, first + stop), strip, strips, least, round)
        begin, least = stop, 0
