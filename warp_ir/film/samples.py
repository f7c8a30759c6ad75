"""What some iterations have found of a picture, on the host: it goes from the film of a part to that of the whole."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt


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
