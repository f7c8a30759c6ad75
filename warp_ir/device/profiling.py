"""Profiling: seconds by phase, by the clock of the host or of the GPU, and counts."""

import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import warp as wp


class Profile:
    """Seconds and counts by name. On CUDA, events time a phase, so that nothing waits for it."""

    def __init__(self, device: Any) -> None:
        """A profile of work on a Warp device."""
        self._device = device
        self._seconds: dict[str, float] = defaultdict(float)
        self._pending: list[tuple[Mapping[str, float], Any, Any]] = []
        self.counts: Counter[str] = Counter()
        """Counts of rays, light paths, ...; callers add to them."""
        self._tallies: dict[str, Any] = {}

    def phase(self, name: str) -> AbstractContextManager[None]:
        """Adds the time spent inside to `name`."""
        return self.phases({name: 1.0})

    @contextmanager
    def phases(self, shares: Mapping[str, float]) -> Iterator[None]:
        """Divides the time spent inside among phases, by their shares."""
        if self._device.is_cuda:
            begin, end = wp.Event(self._device, enable_timing=True), wp.Event(self._device, enable_timing=True)
            wp.record_event(begin)
            try:
                yield
            finally:
                wp.record_event(end)
                self._pending.append((shares, begin, end))
        else:
            start = time.perf_counter()
            try:
                yield
            finally:
                self._add(shares, time.perf_counter() - start)

    def _add(self, shares: Mapping[str, float], seconds: float) -> None:
        for name, share in shares.items():
            self._seconds[name] += share * seconds

    def add(self, name: str, seconds: float) -> None:
        """Adds time that was measured elsewhere."""
        self._seconds[name] += seconds

    def tally(self, name: str) -> Any:
        """A count on the device, int64 [1], that kernels add to."""
        if name not in self._tallies:
            self._tallies[name] = wp.zeros(1, dtype=wp.int64, device=self._device)
        return self._tallies[name]

    def counted(self) -> dict[str, int]:
        """`counts` and the counts on the device. Waits for pending work of the GPU."""
        return {**self.counts, **{name: int(tally.numpy()[0]) for name, tally in self._tallies.items()}}

    def clear(self) -> None:
        """Sets all seconds and counts to zero."""
        self.seconds()
        self._seconds.clear()
        self.counts.clear()
        self._tallies.clear()

    def since(self, before: dict[str, float]) -> Counter[str]:
        """Seconds by phase since an earlier result of `seconds`, given as `before`."""
        return Counter({phase: max(s - before.get(phase, 0.0), 0.0) for phase, s in self.seconds().items()})

    def seconds(self) -> dict[str, float]:
        """Seconds so far, by phase. Waits for pending work of the GPU."""
        if self._pending:
            wp.synchronize_device(self._device)
            for shares, begin, end in self._pending:
                self._add(shares, wp.get_event_elapsed_time(begin, end, synchronize=False) / 1000.0)
            self._pending.clear()
        return dict(self._seconds)
