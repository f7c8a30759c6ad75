"""A table on the device whose first rows are static while the rows after them are replaced."""

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher


class GrowingTable:
    """A device array of static rows followed by moving ones; never empty, so that kernels never get a null pointer."""

    def __init__(
        self, static: npt.NDArray[np.generic], moving: npt.NDArray[np.generic], dtype: Any, launcher: Launcher
    ) -> None:
        """Uploads both parts as an array of a Warp type."""
        self._launcher, self._dtype = launcher, dtype
        self.static_count = len(static)
        """Number of static rows."""
        rows = np.concatenate([static, moving]) if len(moving) else static
        self.array: wp.array[Any] = launcher.array(rows, dtype) if len(rows) else launcher.zeros(1, dtype)

    def replace_moving(self, moving: npt.NDArray[np.generic]) -> None:
        """Replaces the moving rows; in the same array if their number stays."""
        if not len(moving):
            return
        rows = self._launcher.array(moving, self._dtype)
        if self.array.shape[0] != self.static_count + len(moving):
            array = self._launcher.empty(self.static_count + len(moving), self._dtype)
            if self.static_count:
                wp.copy(array, self.array, count=self.static_count)
            self.array = array
        wp.copy(self.array, rows, dest_offset=self.static_count)
