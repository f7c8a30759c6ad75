"""Tables of records that differ by constant steps, of which only two are made on the host."""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ir.device.launcher import Launcher


def record_rows(make: Callable[[int], Any], count: int, record: Any, launcher: Launcher) -> npt.NDArray[np.void]:
    """`count` rows of a `wp.struct` as a NumPy table, extrapolated from `make(0)` and `make(1)`.

    Whole numbers and addresses of arrays grow by the same step from row to row; all else is that of row 0.
    """
    base = launcher.array([make(0), make(min(1, count - 1))], record).numpy()
    out = np.repeat(base[:1], count)
    _extrapolate(out, base)
    return out


def _extrapolate(out: npt.NDArray[np.void], base: npt.NDArray[np.void]) -> None:
    for name in out.dtype.names or ():
        column, first = out[name], base[name]
        if column.dtype.names:
            _extrapolate(column, first)
        elif column.dtype.kind in "iu" and (first[0] != first[1]).any():
            steps = np.arange(len(out), dtype=np.int64).reshape(-1, *[1] * (column.ndim - 1))
            step = first[1].astype(np.int64) - first[0].astype(np.int64)
            out[name] = (first[0].astype(np.int64) + steps * step).astype(column.dtype)
