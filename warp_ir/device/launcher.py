"""How kernels run: on all CPU cores, with the same bits on any number of them, or on a CUDA device.

A Warp launch on the CPU is single-threaded but releases the GIL, so a launch is divided into bands of indices, and
Python threads take one band after the other. A convention makes this possible: the first argument of every kernel of
this package is ``first: int``, and its index is ``first + wp.tid()``. Kernels write only what their index owns, so the
result does not depend on the bands.

Short launches, and work on the host, keep only one thread busy. `Launcher.overlap` gives the others something to do.
"""

import logging
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

import warp as wp

from warp_ir.device.compiling import ModuleLoader, start_warp
from warp_ir.device.definitions import Command, defined, is_loaded
from warp_ir.device.profiling import Profile
from warp_ir.memory import available_memory
from warp_ir.scene import InputError

_LOGGER = logging.getLogger("warp_ir")
_MIN_BANDS = 16
"""Least number of bands of a launch, so that Ctrl-C need not wait for long."""
_MAX_BANDS_PER_THREAD = 64
"""Largest number of bands of a launch, per thread."""
_MIN_BAND_SECONDS = 1.0e-4
"""Least duration of a band [s]: taking one costs 5 microseconds."""
_BLOCK_DIM = 64
_MAX_LIGHT_PATHS = 4096
"""Largest default number of light paths on a CPU, where more take longer."""
_REGISTERS_PER_SM = 65536
MAX_REGISTERS = 168
"""Registers of a CUDA thread in kernels that trace rays. Without a limit the compiler takes 255, and a multiprocessor
holds 256 threads; with this limit it holds 384, which hide each other's latencies better. What does not fit is spilled
to local memory, mostly by callers during traversal. The number is that of Blender's Cycles
(kernel/device/cuda/config.h); it has not been measured here yet."""
_THREADS_PER_SM = _REGISTERS_PER_SM // MAX_REGISTERS // 32 * 32
"""Threads of kernels that trace rays that a multiprocessor holds."""


Record = TypeVar("Record")


class Cancelled(Exception):
    """The work in flight was abandoned because `Launcher.cancel` was called."""


class _Launch:
    """A launch in progress on the CPU. Its fields change only under the launcher's lock."""

    def __init__(
        self, kernel: Any, count: int, inputs: Sequence[Any], phase: str | None, uninterruptible: bool
    ) -> None:
        self.kernel, self.count, self.inputs = kernel, count, inputs
        self.phase = phase  # that its time is added to; None: the phase of the thread that waits for it
        self.uninterruptible = uninterruptible  # `cancel` does not affect it
        self.min_band = 1  # least number of indices in a band
        self.indices_taken = 0
        self.indices_run = 0
        self.commands: list[Any] = []  # recorded launches that no thread is using
        self.done = threading.Event()
        self.error: BaseException | None = None


class Launcher:
    """Runs kernels on one device, and times them by phase.

    It uses threads internally. Of the threads that call it, one at a time may: the one that holds `exclusive`.
    """

    def __init__(self, device: str = "cpu", threads: int | None = None) -> None:
        """Opens the device.

        Args:
            device: "cpu", "cuda" or "cuda:N".
            threads: CPU threads; by default one for each core this process may use.

        Raises:
            InputError: There is no such device, or no folder for compiled kernels.
        """
        if warning := start_warp():
            _LOGGER.warning("%s", warning)
        try:
            self.device = wp.get_device(device)
        except (ValueError, RuntimeError) as error:
            known = ", ".join(str(d) for d in wp.get_devices())
            raise InputError(f"device {device!r} is not available; available: {known}") from error
        self.profile = Profile(self.device)
        self.synchronous = self.device.is_cpu
        """Whether a launch has finished when the call returns: then the host reads results without waiting."""
        self.lanes = self.device.is_cpu
        """Whether a thread computes in vector registers: then it evaluates sixteen VPLs at once."""
        self.wavefront = not self.lanes
        """Whether gathering is a sequence of kernels, one for each step, in which neighbouring threads do the same."""
        self.graphs = self.device.is_cuda and wp.is_mempool_enabled(self.device)
        """Whether launches that are repeated are recorded as a graph; sorting in a graph takes a memory pool."""
        self._recording = False
        self.threads = (threads or _usable_cores()) if self.device.is_cpu else 1
        self._pool = ThreadPoolExecutor(self.threads - 1) if self.threads > 1 else None
        self.exclusive = threading.RLock()
        """Held by whoever launches kernels, or works on buffers that iterations and pictures share."""
        self._lock = threading.Lock()
        self._modules = ModuleLoader(self.device, _BLOCK_DIM)
        self._loader: ThreadPoolExecutor | None = None
        self._loading: dict[Any, Future[Any]] = {}  # by Warp's module
        self._open: list[_Launch] = []  # launches with bands left; the latest is the most urgent
        self._helper_count = 0  # threads of the pool that are running bands
        self._seconds_per_index: dict[Any, float] = {}  # of each kernel, as last measured
        self._phase: str | None = None  # the one being timed
        self._overlap_phase: str | None = None  # phase of launches that are overlapped; None: launches are waited for
        self._uninterruptible = False
        self._cancelled = threading.Event()

    def load(self, modules: Sequence[Any]) -> None:
        """Compiles every kernel of the given Python modules, or loads it from the kernel cache, several at a time.

        Modules are begun in the given order: those that take longest should come first. Inside `loading`, the call
        returns before they are loaded, unless the device is a GPU.
        """
        if self._loader is None:
            with self.loading():
                self.load(modules)
            return
        self.expect(modules)
        for module in _warp_modules(modules):
            self._loading[module] = self._loader.submit(self._modules.load, module)
        if self.device.is_cuda:  # uploading does not overlap with compiling there
            self._wait_for(*self._loading)

    def expect(self, modules: Sequence[Any]) -> None:
        """Announces Python modules for which `load` will be called, so that progress counts them from the start."""
        self._modules.expect(_warp_modules(modules))

    @contextmanager
    def loading(self) -> Iterator[None]:
        """Modules are compiled while the block runs, and are loaded when it ends; a launch waits for its own module."""
        with ThreadPoolExecutor(self.threads if self.device.is_cpu else _usable_cores()) as self._loader:
            try:
                yield
                self._wait_for(*self._loading)
            finally:
                self._loader.shutdown(cancel_futures=True)
                self._loader = None
                self._loading.clear()

    def _wait_for(self, *modules: Any) -> None:
        """Waits for those of Warp's modules that are being loaded."""
        for module in modules:
            if module in self._loading:
                start = time.perf_counter()
                self._loading.pop(module).result()
                seconds = time.perf_counter() - start
                self.profile.add("compile", seconds)
                if self._phase is not None:
                    self.profile.add(self._phase, -seconds)

    def packed(self, kernel: Any, count: int, inputs: Sequence[Any]) -> Any:
        """Warp's record of the launch of ``kernel(first, *inputs)`` for indices 0 to `count` - 1, to be repeated."""
        self._wait_for(kernel.module)
        self._modules.load(kernel.module)
        values = [0, *inputs]
        return wp.launch(kernel, dim=count, inputs=values, device=self.device, block_dim=_BLOCK_DIM, record_cmd=True)

    def launch(self, kernel: Any, count: int, inputs: Sequence[Any], commands: list[Any] | None = None) -> None:
        """Runs ``kernel(first, *inputs)`` for indices 0 to `count` - 1.

        Args:
            kernel: The kernel.
            count: Number of indices.
            inputs: Arguments after `first`.
            commands: A list that keeps recorded launches of bands between calls with the same arguments.

        Raises:
            Cancelled: `cancel` was called before all of it had run.
        """
        if self._cancelled.is_set() and not self._uninterruptible:
            raise Cancelled
        if count <= 0:
            return
        self._wait_for(kernel.module)
        self._modules.load(kernel.module)
        if self.device.is_cuda or self._recording or self.device.is_capturing:
            inputs = [0, *inputs]
            wp.launch(defined(kernel), dim=count, inputs=inputs, device=self.device, block_dim=_BLOCK_DIM)
            return
        launch = _Launch(kernel, count, inputs, self._overlap_phase, self._uninterruptible)
        if commands is not None:
            launch.commands = commands
        if not launch.commands:
            launch.commands.append(self._record_command(launch))  # in this thread, which loads the module if necessary
        per_index = self._seconds_per_index.get(kernel)
        even = count // (_MIN_BANDS * self.threads)
        launch.min_band = max(
            count // (_MAX_BANDS_PER_THREAD * self.threads),
            even if per_index is None else int(_MIN_BAND_SECONDS / per_index),
            1,
        )
        with self._lock:
            self._open.append(launch)
            helpers = min(
                self.threads - 1 - self._helper_count, -(-count // launch.min_band) - (self._overlap_phase is None)
            )
            self._helper_count += max(helpers, 0)
        for _ in range(helpers):
            self._pool.submit(self._run_open_launches)  # type: ignore[union-attr]
        if self._overlap_phase is None:
            self._wait_for_launches([launch])

    @contextmanager
    def overlap(self, phase: str, start: Callable[[], None]) -> Iterator[None]:
        """Overlaps the launches of `start` with the block: idle threads run them, and they are done when it ends.

        The launches must not depend on each other, nor on the block, nor the block on them. On CUDA they run first.
        Their time is added to `phase`, and not to the phases inside the block.
        """
        if self.device.is_cuda or self._recording:
            with self.phase(phase):
                start()
            yield
            return
        mark = len(self._open)
        try:
            self._overlap_phase = phase
            try:
                start()
            finally:
                self._overlap_phase = None
            yield
        finally:
            self._wait_for_launches(self._open[mark:])

    @contextmanager
    def uninterruptible(self) -> Iterator[None]:
        """`cancel` does not affect the launches inside: for work that must be done completely or not at all."""
        self._uninterruptible = True
        try:
            yield
        finally:
            self._uninterruptible = False

    def _record_command(self, launch: _Launch) -> Any:
        kernel, inputs = launch.kernel, [0, *launch.inputs]
        if is_loaded(kernel):
            return Command(kernel, inputs, self.device)
        return wp.launch(defined(kernel), dim=1, inputs=inputs, device=self.device, record_cmd=True)

    def _wait_for_launches(self, launches: Sequence[_Launch]) -> None:
        """Runs bands until some launches are done."""
        try:
            for launch in launches:
                while band := self._take_band(launch):
                    self._run_band(*band)
                while not launch.done.is_set():  # another thread runs its last band; meanwhile this one runs others
                    if band := self._take_band():
                        self._run_band(*band)
                    else:
                        launch.done.wait()
        finally:
            with self._lock:
                self._open = [launch for launch in self._open if launch not in launches]
        for launch in launches:
            if launch.error is not None:
                raise launch.error
        if self._cancelled.is_set() and not all(launch.uninterruptible for launch in launches):
            raise Cancelled

    def _run_open_launches(self) -> None:
        """Runs bands of any open launch, in a thread of the pool."""
        while band := self._take_band(helper=True):
            self._run_band(*band)

    def _take_band(self, launch: _Launch | None = None, helper: bool = False) -> tuple[_Launch, int, int, Any] | None:
        """The next band of a launch, by default of the latest that has one, and a recorded command if there is one.

        Bands become smaller towards the end of a launch, so that all threads finish at about the same time.
        """
        with self._lock:
            for each in reversed(self._open) if launch is None else [launch]:
                left = each.count - each.indices_taken
                if left > 0:
                    size = each.count // _MIN_BANDS
                    if self.threads > 1:
                        size = min(size, left // (2 * self.threads))
                    begin = each.indices_taken
                    each.indices_taken += min(max(size, each.min_band), left)
                    return each, begin, each.indices_taken, each.commands.pop() if each.commands else None
            self._helper_count -= helper
        return None

    def _run_band(self, launch: _Launch, begin: int, end: int, command: Any) -> None:
        """Runs a band, unless its launch is cancelled."""
        start = time.perf_counter()
        wanted = launch.uninterruptible or not self._cancelled.is_set()
        try:
            if wanted:
                command = command or self._record_command(launch)
                command.set_param_at_index(0, begin)
                command.set_dim(end - begin)
                command.launch()
        except BaseException as error:  # raised again in the thread that waits
            launch.error = error
        seconds = time.perf_counter() - start
        with self._lock:
            if wanted:
                self._seconds_per_index[launch.kernel] = seconds / (end - begin)
            if command is not None:
                launch.commands.append(command)
            if launch.phase is not None:
                self.profile.add(launch.phase, seconds / self.threads)
                if self._phase is not None:
                    self.profile.add(self._phase, -seconds / self.threads)
            launch.indices_run += end - begin
            if launch.indices_run == launch.count:
                launch.done.set()

    def resume(self) -> None:
        """Ends the state that `cancel` began."""
        self._cancelled.clear()

    def cancel(self) -> None:
        """Abandons the launches in progress as soon as possible. Signal handlers and other threads may call it."""
        self._cancelled.set()

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Adds the time of the launches inside to the phase `name`."""
        if self._recording:
            yield
            return
        outer, self._phase = self._phase, name
        try:
            with self.profile.phase(name):
                yield
        finally:
            self._phase = outer

    def record(self, launches: Callable[[], None]) -> Any:
        """Records what `launches` launches, sorts and scans, as a graph; nothing of it runs.

        All that it needs must be there already: it may neither allocate nor upload nor read.
        """
        assert not self.synchronous, "numbers that the host reads would stay what they are"
        self._recording = True
        try:
            with wp.ScopedCapture(device=self.device) as capture:
                launches()
        finally:
            self._recording = False
        return capture.graph

    def replay(self, graph: Any, shares: Mapping[str, float]) -> None:
        """Runs what was recorded. Its time is divided among phases by their `shares`.

        Raises:
            Cancelled: `cancel` was called before it began.
        """
        if self._cancelled.is_set():
            raise Cancelled
        with self.profile.phases(shares):
            wp.capture_launch(graph)
        self.profile.counts["graph_launches"] += 1

    def memory(self) -> float:
        """Bytes that may be allocated: the free memory of a GPU, or what this process may have; infinity if unknown."""
        return float(self.device.free_memory) if self.device.is_cuda else available_memory()

    def max_light_paths(self) -> int:
        """Largest default number of light paths, a power of two.

        On a GPU it is what the device runs at once: fewer would leave a part of it idle, and take as long, because a
        light path is traced one vertex after the other.
        """
        threads = self.device.sm_count * _THREADS_PER_SM
        return max(_MAX_LIGHT_PATHS, 1 << max(threads.bit_length() - 1, 0))

    def empty(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        """An uninitialised array on the device."""
        with _allocating():
            return wp.empty(shape, dtype=dtype, device=self.device)

    def row_count(self, number: Any, limit: int) -> int:
        """Number of rows to allocate and to launch for, given the number on the device [1] and its upper limit.

        The number itself where reading it does not wait, else the limit: then kernels must read the number themselves.
        """
        return min(int(number.numpy()[0]), limit) if self.synchronous else limit

    def zeros(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        """An array of zeros on the device."""
        with _allocating():
            return wp.zeros(shape, dtype=dtype, device=self.device)

    def array(self, data: Any, dtype: Any) -> Any:
        """A copy of host data on the device."""
        with _allocating():
            return wp.array(data, dtype=dtype, device=self.device)


@contextmanager
def _allocating() -> Iterator[None]:
    """Raises `MemoryError` where Warp raises another error because there is not enough memory."""
    try:
        yield
    except RuntimeError as error:
        if "allocate" in str(error):
            raise MemoryError(str(error).lower()) from error
        raise


def partition(block: Any, rows: int, dtypes: Sequence[Any]) -> list[Any]:
    """Divides a block of float32 into arrays of `rows` rows of each type: different arrays share the same memory."""
    arrays, begin = [], 0
    for dtype in dtypes:
        end = begin + rows * float_count(dtype)
        arrays.append(block[begin:end].reshape((rows, -1) if float_count(dtype) > 1 else rows).view(dtype))
        begin = end
    return arrays


def copy_record(record: Record) -> Record:
    """A copy of a `wp.struct` record that refers to the same arrays."""
    kind = record._cls  # type: ignore[attr-defined]  # Warp's StructInstance
    copy: Record = kind()
    for name in kind.vars:
        setattr(copy, name, getattr(record, name))
    return copy


def float_count(*dtypes: Any) -> int:
    """Number of float32 in a row of these types."""
    return sum(wp.types.type_size_in_bytes(dtype) for dtype in dtypes) // 4


def _warp_modules(modules: Sequence[Any]) -> list[Any]:
    """Warp's modules of some Python modules."""
    return [wp.get_module(module.__name__) for module in modules]


def _usable_cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
