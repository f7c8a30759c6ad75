"""What some iterations have found of a picture, on the host: it goes from the film of a part to that of the whole."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

RADIANCE = ("emission", "direct", "indirect")
"""The fields of `FilmData` that add up to the radiance."""
_BLOCK = 1 << 14
"""Pixels that are merged together: what is computed in between stays in a core's cache."""


@dataclass(frozen=True, eq=False)
class FilmSamples:
    """The samples of a film: of all its pixels, or of those that have any."""

    iterations: int
    rows: npt.NDArray[np.intp] | None
    """The pixels, row by row; None: all."""
    arrays: Mapping[str, npt.NDArray[Any]]
    """Those of `FilmData` and of the filter, by the names that they have in a file; one row for each of the pixels."""
    timings: Mapping[str, float]
    """Seconds by phase."""
    counts: Mapping[str, int]
    """Numbers of rays, VPLs and others."""

    @property
    def bytes(self) -> int:
        """Size of the arrays."""
        return sum(array.nbytes for array in self.arrays.values()) + (0 if self.rows is None else self.rows.nbytes)


def merge_rows(
    arrays: Mapping[str, npt.NDArray[Any]],
    rows: npt.NDArray[np.intp] | None,
    others: Mapping[str, npt.NDArray[Any]],
    threads: int = 1,
) -> None:
    """Merges arrays of other iterations into those of a film, in place; `rows` are their pixels, None: all.

    Means are weighted by the counts of iterations, standard deviations merge as in Chan, Golub and LeVeque (1979), and
    all else are sums. Each pixel is on its own, so the result depends neither on `rows` nor on `threads`.
    """
    count = len(others["count"])

    def merge_block(first: int) -> None:
        block = slice(first, min(first + _BLOCK, count))
        where = block if rows is None else rows[block]
        # Emission may have no rows.
        mine = {name: array[where] for name, array in arrays.items() if len(array)}
        merged = _merged(mine, {name: others[name][block] for name in mine})
        for name, values in merged.items():
            arrays[name][where] = values

    blocks = range(0, count, _BLOCK)
    if threads > 1 and len(blocks) > 1:
        with ThreadPoolExecutor(min(threads, len(blocks))) as pool:
            list(pool.map(merge_block, blocks))
    else:
        for first in blocks:
            merge_block(first)


def _merged(mine: Mapping[str, npt.NDArray[Any]], theirs: Mapping[str, npt.NDArray[Any]]) -> dict[str, Any]:
    """The arrays of both, pixel by pixel."""
    n, m = (arrays["count"].astype(np.float64) for arrays in (mine, theirs))
    weight = (m / np.maximum(n + m, 1.0))[:, None]  # of the others
    difference = (_radiance(mine) - _radiance(theirs)).astype(np.float64)
    merged: dict[str, Any] = {}
    for name, own in mine.items():
        other = theirs[name]
        if name in RADIANCE:
            merged[name] = own + (other - own) * weight
        elif name == "standard_deviation":
            own, other = (x.astype(np.float64) ** 2 for x in (own, other))
            merged[name] = np.sqrt(own * (1.0 - weight) + other * weight + weight * (1.0 - weight) * difference**2)
        elif name == "mesh":
            merged[name] = np.where(n > 0, own, other)
        else:
            merged[name] = own + other
    return merged


def _radiance(arrays: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[np.float32]:
    """The sum of what is radiance, [rows, 3]."""
    total = np.zeros_like(arrays["direct"])
    for name in RADIANCE:
        if name in arrays:
            total += arrays[name]
    return total
