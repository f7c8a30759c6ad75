"""Launches that are repeated with the same arguments: their arguments are packed once.

To pack the arguments of a launch takes longer than many a kernel runs. A list of launches is made in the first of many
equal calls, and run in all of them. Under a capture of Warp it is recorded like any other launches.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import warp as wp

from warp_ir.device.launcher import Launcher, copy_record

_SHORT_SECONDS = 1.5e-4
"""Duration of a launch on a CPU below which it is not worth dividing among threads."""
_LONG_SECONDS = 3.0e-3
"""Duration above which the first run decides; otherwise the shortest of `_TRIALS` does, since first runs are slow."""
_TRIALS = 3


@dataclass
class _Launch:
    kernel: Any
    count: int
    inputs: list[Any]
    phase: str | None
    whole: Any = None
    """The recorded launch of all indices; None: it is not known yet, or the launch is divided among threads."""
    is_long: bool = False
    seconds: float = math.inf
    trials: int = 0
    commands: list[Any] = field(default_factory=list)
    """Recorded launches of parts."""


class LaunchList:
    """Launches, and other work on the device, in order."""

    def __init__(self, launcher: Launcher) -> None:
        """An empty list."""
        self._launcher = launcher
        self._steps: list[_Launch | Callable[[], None]] = []
        self.phase: str | None = None
        """Phase to which the time of what is added counts."""

    def launch(self, kernel: Any, count: int, inputs: Sequence[Any]) -> None:
        """Adds a launch like `Launcher.launch`. Records are copied: they may be changed afterwards."""
        if count > 0:
            copies = [copy_record(x) if hasattr(x, "_cls") else x for x in inputs]
            self._steps.append(_Launch(kernel, count, copies, self.phase))

    def scan(self, values: Any, sums: Any) -> None:
        """Adds an inclusive scan."""
        self._steps.append(lambda: wp.utils.array_scan(values, sums, inclusive=True))

    def sort(self, keys: Any, values: Any, count: int, bits: int) -> None:
        """Adds a sort of pairs by keys of so many bits; both arrays have twice the length."""
        self._steps.append(lambda: wp.utils.radix_sort_pairs(keys, values, count, end_bit=bits))

    def call(self, work: Callable[[], None]) -> None:
        """Adds other work, that is done anew in every run."""
        self._steps.append(work)

    def run(self) -> None:
        """Does all of it."""
        for step in self._steps:
            if isinstance(step, _Launch):
                self._run(step)
            else:
                step()

    def _run(self, step: _Launch) -> None:
        launcher = self._launcher
        device = launcher.device
        if device.is_cpu and (step.is_long or device.is_capturing):
            if step.phase is None:
                launcher.launch(step.kernel, step.count, step.inputs, step.commands)
            else:
                with launcher.phase(step.phase):
                    launcher.launch(step.kernel, step.count, step.inputs, step.commands)
            return
        if step.whole is None:
            step.whole = launcher.packed(step.kernel, step.count, step.inputs)
        if device.is_cuda or step.trials == _TRIALS:
            step.whole.launch()
            return
        start = time.perf_counter()
        step.whole.launch()
        step.trials += 1
        step.seconds = min(step.seconds, time.perf_counter() - start)
        limit = _SHORT_SECONDS if step.trials == _TRIALS else _LONG_SECONDS
        if step.count > 1 and step.seconds > limit:
            step.whole, step.is_long = None, True
