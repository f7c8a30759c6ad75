"""How kernels run: on all CPU cores with the same bits whatever their number, or on a CUDA device.

A Warp launch on the CPU is single-threaded but releases the GIL, so a launch is cut into bands of
indices that Python threads take in turn. The convention that makes this possible: the first argument
of every kernel of this package is ``first: int``, and its index is ``first + wp.tid()``. Kernels write
only what their index owns, so the cut cannot be seen in the result.

What is short, or done on the host, keeps one thread busy: `Launcher.overlap` gives the others something to do.
"""

import math
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import warp as wp

from warp_ir.device.profiling import Profile
from warp_ir.scene import InputError

_MOST_OF_A_LAUNCH = 16
"""No band is a larger part of a launch than this, so that Ctrl-C need not wait for long."""
_MOST_BANDS = 64
"""Per thread."""
_LEAST_SECONDS = 1.0e-4
"""What a band should take at least: taking one costs 5 microseconds."""
_BLOCK_DIM = 64
MAX_REGISTERS = 168
"""Of a CUDA thread, in kernels that trace rays. Left alone they take 255, and a multiprocessor has room for 256 threads
to hide each other's waiting; so it has for 384. What does not fit is kept in memory, mostly by callers while rays are
followed. The number is what Blender's Cycles uses (kernel/device/cuda/config.h); here it has not been measured yet."""


class Cancelled(Exception):
    """The work in flight was abandoned because `Launcher.cancel` was called."""


class _Work:
    """A launch under way on the CPU. What changes does so under the launcher's lock."""

    def __init__(self, kernel: Any, count: int, inputs: Sequence[Any], phase: str | None, whole: bool) -> None:
        self.kernel, self.count, self.inputs = kernel, count, inputs
        self.phase = phase  # which its seconds go to; None: that of the thread that waits for it
        self.whole = whole  # cancelling does not touch it
        self.least = 1  # indices of a band
        self.taken = 0
        self.run = 0
        self.commands: list[Any] = []  # recorded launches that no thread is using
        self.done = threading.Event()
        self.error: BaseException | None = None


class Launcher:
    """Runs kernels on one device, and measures them by phase. One thread may use it; it uses others itself."""

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
        self.waits = self.device.is_cpu
        """Whether launches are done when they return, so that the host may read what they have written."""
        self.threads = (threads or _usable_cores()) if self.device.is_cpu else 1
        self._pool = ThreadPoolExecutor(self.threads - 1) if self.threads > 1 else None
        self._lock = threading.Lock()
        self._loader: ThreadPoolExecutor | None = None
        self._loading: dict[Any, Future[Any]] = {}  # by Warp's module
        self._open: list[_Work] = []  # the latest is the most urgent
        self._helpers = 0  # threads of the pool that look for bands
        self._pace: dict[Any, float] = {}  # seconds per index of a kernel, as last seen
        self._phase: str | None = None  # the one being timed
        self._beside: str | None = None  # phase of the launches that nobody waits for
        self._whole = False
        self._cancelled = threading.Event()

    def load(self, modules: Sequence[Any]) -> None:
        """Compiles (or fetches from the kernel cache) every kernel of the given Python modules, several at a time.

        Their order is that in which they are begun: those that take longest should come first. Inside `loading` it
        returns before they are there, unless the device is a GPU.
        """
        if self._loader is None:
            with self.loading():
                self.load(modules)
            return
        for m in modules:
            load = self._loader.submit(wp.load_module, m, device=self.device, block_dim=_BLOCK_DIM)
            self._loading[wp.get_module(m.__name__)] = load
        if self.device.is_cuda:  # nothing is uploaded meanwhile
            self._wait_for(*self._loading)

    @contextmanager
    def loading(self) -> Iterator[None]:
        """Modules are compiled while the block runs, and are there when it ends; a launch waits for its own."""
        with ThreadPoolExecutor(self.threads if self.device.is_cpu else _usable_cores()) as self._loader:
            try:
                yield
                self._wait_for(*self._loading)
            finally:
                self._loader.shutdown(cancel_futures=True)
                self._loader = None
                self._loading.clear()

    def _wait_for(self, *modules: Any) -> None:
        """Waits until Warp's modules are there, as far as they are being loaded."""
        for module in modules:
            if module in self._loading:
                start = time.perf_counter()
                self._loading.pop(module).result()
                seconds = time.perf_counter() - start
                self.profile.add("compile", seconds)
                if self._phase is not None:
                    self.profile.add(self._phase, -seconds)

    def launch(self, kernel: Any, count: int, inputs: Sequence[Any]) -> None:
        """Runs ``kernel(first, *inputs)`` for indices 0 to `count` - 1.

        Raises:
            Cancelled: `cancel` was called before all of it had run.
        """
        if self._cancelled.is_set() and not self._whole:
            raise Cancelled
        if count <= 0:
            return
        self._wait_for(kernel.module)
        if self.device.is_cuda:
            wp.launch(kernel, dim=count, inputs=[0, *inputs], device=self.device, block_dim=_BLOCK_DIM)
            return
        work = _Work(kernel, count, inputs, self._beside, self._whole)
        work.commands.append(self._record(work))  # here, where the module is loaded if it has not been
        pace = self._pace.get(kernel)
        even = count // (_MOST_OF_A_LAUNCH * self.threads)
        work.least = max(count // (_MOST_BANDS * self.threads), even if pace is None else int(_LEAST_SECONDS / pace), 1)
        with self._lock:
            self._open.append(work)
            wanted = min(self.threads - 1 - self._helpers, -(-count // work.least) - (self._beside is None))
            self._helpers += max(wanted, 0)
        for _ in range(wanted):
            self._pool.submit(self._help)  # type: ignore[union-attr]
        if self._beside is None:
            self._finish([work])

    @contextmanager
    def overlap(self, phase: str, start: Callable[[], None]) -> Iterator[None]:
        """What `start` launches is run by whoever is free while the block runs, and done when the block ends.

        Its launches must not depend on each other nor on what the block does, nor the other way round. On CUDA they
        just come first. Their time goes to `phase`, and not to the phases in the block.
        """
        if self.device.is_cuda:
            with self.phase(phase):
                start()
            yield
            return
        mark = len(self._open)
        try:
            self._beside = phase
            try:
                start()
            finally:
                self._beside = None
            yield
        finally:
            self._finish(self._open[mark:])

    @contextmanager
    def uninterruptible(self) -> Iterator[None]:
        """`cancel` does not touch the launches inside: for what must be done entirely or not at all."""
        self._whole = True
        try:
            yield
        finally:
            self._whole = False

    def _record(self, work: _Work) -> Any:
        return wp.launch(work.kernel, dim=1, inputs=[0, *work.inputs], device=self.device, record_cmd=True)

    def _finish(self, works: Sequence[_Work]) -> None:
        """Helps until some launches are done."""
        try:
            for work in works:
                while band := self._take(work):
                    self._run(*band)
                while not work.done.is_set():  # another thread is at it: there may be something else to do
                    if band := self._take():
                        self._run(*band)
                    else:
                        work.done.wait()
        finally:
            with self._lock:
                self._open = [work for work in self._open if work not in works]
        for work in works:
            if work.error is not None:
                raise work.error
        if self._cancelled.is_set() and not all(work.whole for work in works):
            raise Cancelled

    def _help(self) -> None:
        """Runs bands of whatever is open, in a thread of the pool."""
        while band := self._take(helper=True):
            self._run(*band)

    def _take(self, work: _Work | None = None, helper: bool = False) -> tuple[_Work, int, int, Any] | None:
        """The next band of a launch, of the latest that has one left by default, and a command if one is recorded.

        Bands become smaller towards the end, so that all threads come to it at once.
        """
        with self._lock:
            for each in reversed(self._open) if work is None else [work]:
                left = each.count - each.taken
                if left > 0:
                    size = each.count // _MOST_OF_A_LAUNCH
                    if self.threads > 1:
                        size = min(size, left // (2 * self.threads))
                    begin = each.taken
                    each.taken += min(max(size, each.least), left)
                    return each, begin, each.taken, each.commands.pop() if each.commands else None
            self._helpers -= helper
        return None

    def _run(self, work: _Work, begin: int, end: int, command: Any) -> None:
        """Runs a band, unless all is cancelled."""
        start = time.perf_counter()
        wanted = work.whole or not self._cancelled.is_set()
        try:
            if wanted:
                command = command or self._record(work)
                command.set_param_at_index(0, begin)
                command.set_dim(end - begin)
                command.launch()
        except BaseException as error:  # raised again by the thread that waits
            work.error = error
        seconds = time.perf_counter() - start
        with self._lock:
            if wanted:
                self._pace[work.kernel] = seconds / (end - begin)
            if command is not None:
                work.commands.append(command)
            if work.phase is not None:
                self.profile.add(work.phase, seconds / self.threads)
                if self._phase is not None:
                    self.profile.add(self._phase, -seconds / self.threads)
            work.run += end - begin
            if work.run == work.count:
                work.done.set()

    def resume(self) -> None:
        """Takes `cancel` back."""
        self._cancelled.clear()

    def cancel(self) -> None:
        """Abandons the launches in flight as soon as may be; safe from a signal handler or another thread."""
        self._cancelled.set()

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Times what is launched inside under `name`."""
        outer, self._phase = self._phase, name
        try:
            with self.profile.phase(name):
                yield
        finally:
            self._phase = outer

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

    def at_most(self, number: Any, limit: int) -> int:
        """For how many rows to make room and to launch: a number on the device [1], or `limit` if that is less.

        That number itself if it can be had without waiting, else the limit: kernels have to look at the number, too.
        """
        return min(int(number.numpy()[0]), limit) if self.waits else limit

    def zeros(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        """An array of zeros on the device."""
        return wp.zeros(shape, dtype=dtype, device=self.device)

    def array(self, data: Any, dtype: Any) -> Any:
        """A copy of host data on the device."""
        return wp.array(data, dtype=dtype, device=self.device)


def partition(block: Any, rows: int, dtypes: Sequence[Any]) -> list[Any]:
    """Arrays of so many rows of each type, one after the other in a block of float32: memory that is used twice."""
    arrays, begin = [], 0
    for dtype in dtypes:
        end = begin + rows * float_count(dtype)
        arrays.append(block[begin:end].reshape((rows, -1) if float_count(dtype) > 1 else rows).view(dtype))
        begin = end
    return arrays


def copy_record(record: Any) -> Any:
    """Another `wp.struct` of the same kind and the same arrays."""
    kind = record._cls
    copy = kind()
    for name in kind.vars:
        setattr(copy, name, getattr(record, name))
    return copy


def float_count(*dtypes: Any) -> int:
    """How many float32 a row of these types takes."""
    return sum(wp.types.type_size_in_bytes(dtype) for dtype in dtypes) // 4


def _usable_cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
