"""How kernels run: on all CPU cores with the same bits whatever their number, or on a CUDA device.

A Warp launch on the CPU is single-threaded but releases the GIL, so a launch is cut into bands of
indices that Python threads take in turn. The convention that makes this possible: the first argument
of every kernel of this package is ``first: int``, and its index is ``first + wp.tid()``. Kernels write
only what their index owns, so the cut cannot be seen in the result.
"""

import math
import os
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import warp as wp

from warp_ir.profiling import Profile
from warp_ir.scene import InputError

_BANDS_PER_THREAD = 16
_BLOCK_DIM = 64


class Cancelled(Exception):
    """The work in flight was abandoned because `Launcher.cancel` was called."""


class Launcher:
    """Runs kernels on one device, and measures them by phase."""

    def __init__(self, device: str = "cpu", threads: int | None = None) -> None:
        """Opens the device.

        Args:
            device: "cpu", "cuda" or "cuda:N".
            threads: CPU threads; by default one for each core this process may use.

        Raises:
            InputError: There is no such device.
        """
        try:
            self.device = wp.get_device(device)
        except (ValueError, RuntimeError) as error:
            known = ", ".join(str(d) for d in wp.get_devices())
            raise InputError(f"device {device!r} is not available; available: {known}") from error
        self.profile = Profile(self.device)
        self.threads = (threads or _usable_cores()) if self.device.is_cpu else 1
        self._pool = ThreadPoolExecutor(self.threads) if self.threads > 1 else None
        self._cancelled = threading.Event()
        self._kept: dict[str, Any] = {}

    def load(self, modules: Sequence[Any]) -> None:
        """Compiles (or fetches from the kernel cache) every kernel of the given Python modules, several at a time.

        Their order is that in which they are begun: those that take longest should come first.
        """
        threads = self.threads if self.device.is_cpu else _usable_cores()
        with self.profile.phase("compile"), ThreadPoolExecutor(min(threads, len(modules))) as pool:
            work = [pool.submit(wp.load_module, m, device=self.device, block_dim=_BLOCK_DIM) for m in modules]
            try:
                for done in work:
                    done.result()
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise

    def launch(self, kernel: Any, count: int, inputs: Sequence[Any]) -> None:
        """Runs ``kernel(first, *inputs)`` for indices 0 to `count` - 1.

        Raises:
            Cancelled: `cancel` was called before all of it had run.
        """
        if self._cancelled.is_set():
            raise Cancelled
        if count <= 0:
            return
        if self.device.is_cuda:
            wp.launch(kernel, dim=count, inputs=[0, *inputs], device=self.device, block_dim=_BLOCK_DIM)
            return
        bands = min(count, self.threads * _BANDS_PER_THREAD)
        edges = [count * k // bands for k in range(bands + 1)]
        spans = iter(list(pairwise(edges)))
        # Packing the arguments costs more than a band may take: once per thread, not once per band.
        workers = self.threads if count >= 256 else 1
        commands = [
            wp.launch(kernel, dim=1, inputs=[0, *inputs], device=self.device, record_cmd=True) for _ in range(workers)
        ]
        if self._pool is None or workers == 1:
            self._work(commands[0], spans)
        else:
            list(self._pool.map(lambda command: self._work(command, spans), commands))
        if self._cancelled.is_set():
            raise Cancelled

    def _work(self, command: Any, spans: Iterator[tuple[int, int]]) -> None:
        """Runs bands from the common list until none is left; taking one is atomic, since it holds the GIL."""
        for begin, end in spans:
            if self._cancelled.is_set():
                return
            command.set_param_at_index(0, begin)
            command.set_dim(end - begin)
            command.launch()

    def resume(self) -> None:
        """Takes `cancel` back."""
        self._cancelled.clear()

    def cancel(self) -> None:
        """Abandons the launches in flight as soon as may be; safe from a signal handler or another thread."""
        self._cancelled.set()

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Times what is launched inside under `name`."""
        with self.profile.phase(name):
            yield

    def memory(self) -> float:
        """Bytes that may be allocated: what is free on a GPU, all there is on a CPU; infinity if unknown."""
        if self.device.is_cuda:
            return float(self.device.free_memory)
        try:
            return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
        except (AttributeError, OSError, ValueError):
            return math.inf

    def empty(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        """An uninitialised array on the device."""
        return wp.empty(shape, dtype=dtype, device=self.device)

    def kept(self, name: str, rows: int, dtype: Any) -> Any:
        """An array of at least `rows`, the same whenever `name` asks again: iterations allocate nothing.

        It is uninitialised at first, and later holds what was written to it last.
        """
        array = self._kept.get(name)
        if array is None or array.shape[0] < rows:
            # Some room, for the number of VPLs differs a little from iteration to iteration.
            array = self._kept[name] = self.empty(rows + rows // 8, dtype)
        return array

    def zeros(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        """An array of zeros on the device."""
        return wp.zeros(shape, dtype=dtype, device=self.device)

    def array(self, data: Any, dtype: Any) -> Any:
        """A copy of host data on the device."""
        return wp.array(data, dtype=dtype, device=self.device)


def _usable_cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
