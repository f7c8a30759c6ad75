"""A table on the device whose first rows stay while those after them change."""

from typing import Any

import numpy as np
import warp as wp

from warp_ir.device.launcher import Launcher


class Table:
    """An array; never empty, so that kernels never get a null pointer."""

    def __init__(self, head: Any, tail: Any, dtype: Any, launcher: Launcher) -> None:
        """Uploads host arrays, `head` before `tail`."""
        self._launcher, self._dtype, self.head = launcher, dtype, len(head)
        both = np.concatenate([head, tail]) if len(tail) else head
        self.array = launcher.array(both, dtype) if len(both) else launcher.zeros(1, dtype)

    def change(self, tail: Any) -> None:
        """Uploads other rows in place of those after the head; in the same array if there are as many."""
        if not len(tail):
            return
        rows = self._launcher.array(tail, self._dtype)
        if self.array.shape[0] != self.head + len(tail):
            array = self._launcher.empty(self.head + len(tail), self._dtype)
            if self.head:
                wp.copy(array, self.array, count=self.head)
            self.array = array
        wp.copy(self.array, rows, dest_offset=self.head)
