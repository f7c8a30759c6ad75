"""Scratch arrays: device memory that one owner overwrites in every iteration, so that iterations allocate nothing."""

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher


class Scratch:
    """Named arrays on a device, each made when it is first asked for.

    They hold what was last written to them. Whoever needs such arrays owns a `Scratch`; owners never share an array.
    """

    def __init__(self, launcher: Launcher) -> None:
        """Starts without arrays, on the launcher's device."""
        self.launcher = launcher
        self._arrays: dict[str, wp.array[Any]] = {}
        self._uploads: dict[str, tuple[npt.NDArray[Any], wp.array[Any]]] = {}
        self.allocations = 0
        """Number of arrays made so far: as long as it is the same, all arrays are where they were."""

    def array(self, name: str, rows: int, dtype: Any) -> wp.array[Any]:
        """An array of at least `rows` rows, uninitialised at first; the same one whenever `name` is asked for again.

        Raises:
            TypeError: The array of that name has another dtype.
        """
        array = self._arrays.get(name)
        if array is not None and array.dtype is not dtype:
            raise TypeError(f"scratch array {name!r} has dtype {array.dtype}, not {dtype}")
        if array is None or array.shape[0] < rows:
            # An eighth to spare, since the number of VPLs differs a little from iteration to iteration.
            array = self._arrays[name] = self.launcher.empty(rows + rows // 8, dtype)
            self.allocations += 1
        return array

    def number(self, name: str, value: int, dtype: Any) -> wp.array[Any]:
        """One number on the device, [1]: launches that read it there are the same ones whatever it is."""
        return self.upload(name, np.array([value], wp.dtype_to_numpy(dtype)), dtype)

    def upload(self, name: str, data: npt.NDArray[Any], dtype: Any) -> wp.array[Any]:
        """A copy of host data, uploaded only if the data differ from the last of that name: to the same place."""
        known = self._uploads.get(name)
        if known is None or known[0].shape != data.shape:
            known = self._uploads[name] = data, self.launcher.array(data, dtype)
            self.allocations += 1
        elif not np.array_equal(known[0], data):
            known[1].assign(data)
            self._uploads[name] = data, known[1]
        return known[1]
