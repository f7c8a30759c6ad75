"""Launches that iterations repeat: on a GPU they become a graph, one call in place of some twenty.

An iteration's launches are the same as the last one's, but for numbers that lie on the device (`Scratch.number`). So
the first iteration launches kernel by kernel, the second records the launches as a graph, and from then on the graph is
launched, as long as nothing that it refers to has changed.
"""

import warnings
from collections import Counter
from collections.abc import Callable
from typing import Any

from warp_ir.device.scratch import Scratch


class RepeatedLaunches:
    """The launches of one kind of iteration."""

    def __init__(self, scratch: Scratch) -> None:
        """Nothing is recorded at first; the launches may use arrays of `scratch`."""
        self._scratch = scratch
        self._key: tuple[Any, ...] = ()
        self._allocations = -1
        self._counts: Counter[str] = Counter()
        self._shares: dict[str, float] = {}
        self._graph: Any = None

    def run(self, key: tuple[Any, ...], launches: Callable[[], None]) -> None:
        """Runs `launches`, by a graph if the launcher's device repeats them from one (`Launcher.graphs`).

        Args:
            key: Objects whose identity decides whether the launches are those of the last call. They are kept alive.
            launches: Launches kernels through the launcher, and sorts and scans; it adds to the profile's counts, and
                nothing else that it does on the host has to be done again.
        """
        launcher = self._scratch.launcher
        same = len(key) == len(self._key) and all(a is b for a, b in zip(key, self._key, strict=True))
        if not launcher.graphs:
            launches()
        elif not same or self._scratch.allocations != self._allocations:
            self._measure(launches)
            self._key, self._graph, self._allocations = key, None, self._scratch.allocations
        else:
            if self._graph is None:
                counts = Counter(launcher.profile.counts)
                try:
                    self._graph = launcher.record(launches)
                except RuntimeError as error:
                    warnings.warn(f"iterations are launched kernel by kernel: {error}", RuntimeWarning, stacklevel=2)
                    launcher.graphs = False
                launcher.profile.counts = counts  # nothing has run yet
                if self._graph is None:
                    launches()
                    return
            launcher.replay(self._graph, self._shares)
            launcher.profile.counts.update(self._counts)

    def _measure(self, launches: Callable[[], None]) -> None:
        """Launches kernel by kernel, and notes what is counted and how the time is shared by the phases."""
        profile = self._scratch.launcher.profile
        seconds, counts = profile.seconds(), Counter(profile.counts)
        launches()
        self._counts = Counter({name: n - counts[name] for name, n in profile.counts.items() if n != counts[name]})
        spent = profile.since(seconds)
        del spent["compile"]
        self._shares = {phase: s / max(spent.total(), 1.0e-30) for phase, s in spent.items() if s > 0.0}
