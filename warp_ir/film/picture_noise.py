"""The noise that the filter leaves, from how much the picture changes while the number of iterations doubles.

The picture P of n iterations is about the mean of those of its first m and of the others, which are independent. So if
σ²/n is the variance of P, the squared change from the picture of m iterations is on average σ²/n · (1 - f)/f with
f = m/n. Unlike the spread of single pixels, this contains what the filter gains and what neighbours share.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from warp_ir.tiles import TILE

if TYPE_CHECKING:
    from typing import Self  # Python 3.11

Floats = npt.NDArray[np.float64]

_REGULARIZATION = 0.01
"""ε in units of the squared mean of the picture, as in `metrics`."""
_BIAS_ALLOWANCE = 2.0
"""Squared error of a picture over that of its noise. A filter that is as wide as pays has a bias as large as its noise,
most of which changes no more than the picture does."""


@dataclass(frozen=True)
class PictureNoise:
    """The last picture whose number of iterations is a power of two, and what the last two doublings have shown."""

    picture: npt.NDArray[np.float32]
    """[height, width, 3]."""
    iterations: npt.NDArray[np.int32]
    """[tiles], of that picture."""
    variance: Floats
    """[2, tiles], sums of relative squared noise over a tile times its iterations; the latest first, NaN: unknown."""

    @classmethod
    def first(cls, picture: npt.NDArray[np.float32], iterations: npt.NDArray[np.int32]) -> "Self":
        """What the first picture tells: nothing yet."""
        return cls(picture, iterations, np.full((2, len(iterations)), np.nan))

    def updated(self, picture: npt.NDArray[np.float32], iterations: npt.NDArray[np.int32]) -> "Self":
        """Adds a later picture; tiles without new iterations keep the estimate that they have."""
        fraction = self.iterations / iterations
        change = tile_sums((picture - self.picture).astype(np.float64) ** 2 / _scale(picture))
        new = fraction < 1.0
        weight = np.divide(fraction, 1.0 - fraction, out=np.zeros_like(fraction), where=new)
        latest = np.where(new, iterations * change * weight, self.variance[0])
        return type(self)(picture, iterations, np.stack([latest, np.where(new, *self.variance)]))

    def squared_errors(self, iterations: npt.NDArray[np.int32]) -> Floats:
        """Sums of relative squared errors over every tile after `iterations` [tiles]; NaN where unknown.

        The doubling that shows more noise is believed: a change by what all pixels share is a single draw.
        """
        errors = _BIAS_ALLOWANCE * self.variance / iterations
        return np.asarray(errors[int(np.argmax(errors.sum(axis=1)))])


def tile_sums(values: Floats) -> Floats:
    """Sums [tiles] of an image [height, width, 3] over tiles, row by row."""
    rows, columns = (range(0, size, TILE) for size in values.shape[:2])
    return np.asarray(np.add.reduceat(np.add.reduceat(values.sum(axis=-1), rows, axis=0), columns, axis=1).reshape(-1))


def _scale(picture: npt.NDArray[np.float32]) -> Floats:
    """L² + ε of the relative error, [height, width, 3]; 1 in a black picture, where nothing changes."""
    radiance = picture.astype(np.float64)
    return np.asarray(radiance**2 + (_REGULARIZATION * radiance.mean() ** 2 or 1.0))
