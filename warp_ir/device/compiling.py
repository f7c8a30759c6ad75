"""Loading Warp's modules, and saying so where the kernel cache lacks them.

Compiling takes seconds a module, once for each version of a kernel. What is said goes to the logger "warp_ir" at level
INFO: when the first module begins to compile, after each, and when all are done. The attribute `compiling` of these
records is the number of modules that are done, and the number of all, as far as is known.

The cache is a folder that other processes fill, empty and damage. A file in it that is not as it was written is
compiled again. Where the folder cannot be written, or is full, another one takes its place until the process ends; this
is found out before a module is compiled, because LLVM ends the process where it cannot write.
"""

import atexit
import logging
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import warp as wp

from warp_ir.device import definitions
from warp_ir.device.definitions import checksum
from warp_ir.files import check_room, reason
from warp_ir.scene import InputError

_LOGGER = logging.getLogger("warp_ir")
_MODULE_BYTES = 8 << 20
"""Room that a module may take: several times that of the largest."""
_CHECKSUM = ".blake2b"
"""Ends the name of the file with the checksum of a compiled module."""


def start_warp() -> str:
    """Starts Warp, which makes the folder of its kernel cache: where it cannot, a temporary one serves.

    Returns:
        A warning that says so; "" if there is no need to.

    Raises:
        InputError: There is no folder that can be written.
    """
    try:
        wp.init()
    except OSError as error:
        cache = wp.config.kernel_cache_dir or os.environ.get("WARP_CACHE_PATH") or "the default folder"
        wp.config.kernel_cache_dir, warning = _temporary_cache(cache, error)
        wp.init()
        return warning
    return ""


def _temporary_cache(cache: str, error: OSError) -> tuple[str, str]:
    """A new folder for compiled kernels, removed at exit, and a warning that names the cache that cannot be written.

    Raises:
        InputError: There is no folder that can be written.
    """
    why = f"the kernel cache {cache} cannot be written: {reason(error)}"
    for parent in (None, "/dev/shm"):
        with suppress(OSError):
            own = tempfile.mkdtemp(prefix="warp_ir_kernels_", dir=parent)
            atexit.register(shutil.rmtree, own, ignore_errors=True)
            check_room(own, _MODULE_BYTES)
            return own, f"{why}; kernels are compiled for this run alone, unless WARP_CACHE_PATH names another folder"
    raise InputError(f"{why}; WARP_CACHE_PATH names another folder") from error


def _noted_checksum(path: str) -> str | None:
    """The checksum that was noted when a file was written; None: another program has written it."""
    with suppress(FileNotFoundError), open(path + _CHECKSUM, encoding="ascii", errors="replace") as file:
        return file.read()
    return None


class ModuleLoader:
    """Loads modules onto one device, from any number of threads."""

    def __init__(self, device: Any, block_dim: int) -> None:
        """A loader for a Warp device; `block_dim` is that of the launches."""
        self._device, self._block_dim = device, block_dim
        self._lock = threading.Lock()
        self._loaded: set[Any] = set()
        self._expected: set[Any] = set()  # not loaded yet; which of them have to be compiled is not known yet
        self._compiled = 0
        self._began: float | None = None  # when the first of them began to compile

    def expect(self, modules: Iterable[Any]) -> None:
        """Announces modules that will be loaded, so that what is said of the first one counts them."""
        with self._lock:
            self._expected.update(set(modules) - self._loaded)

    def load(self, module: Any) -> None:
        """Loads one of Warp's modules, from the kernel cache or by compiling it; a second call does nothing."""
        if module in self._loaded:
            return
        self.expect([module])
        compiled = False
        if not (self._device.is_cpu and definitions.load(module)):
            definitions.define_all()
            compiled = self._load_or_compile(module)
            if self._device.is_cpu:
                definitions.record(module, self._device)
        with self._lock:
            self._loaded.add(module)
            self._expected.discard(module)
            self._compiled += compiled
            if compiled:
                self._say("compiling kernels, once: %d of %d modules done")
            if self._began is not None and not self._expected:
                seconds = time.perf_counter() - self._began
                _LOGGER.info("kernels compiled: %d modules, %.1f s", self._compiled, seconds)
                self._compiled, self._began = 0, None

    def _load_or_compile(self, module: Any) -> bool:
        """Loads a module by way of Warp, and returns whether it had to be compiled.

        Raises:
            InputError: It can be compiled nowhere.
        """
        cache = str(wp.config.kernel_cache_dir)
        try:
            return self._load_or_compile_in_cache(module)
        except OSError as error:
            self._replace_cache(cache, error)
        module.failed_builds.clear()
        try:
            return self._load_or_compile_in_cache(module)
        except OSError as error:
            cache = str(wp.config.kernel_cache_dir)
            raise InputError(f"kernels cannot be compiled in {cache}: {reason(error)}") from error

    def _load_or_compile_in_cache(self, module: Any) -> bool:
        compiled = not self._load_cached(module)
        if compiled:
            self._compile(module)
        return compiled

    def _load_cached(self, module: Any) -> bool:
        """Loads a module from the cache, and returns whether it was there; what is damaged is removed.

        Raises:
            OSError: A damaged file cannot be removed.
        """
        path = self._path(module)
        meta = os.path.join(os.path.dirname(path), module._get_meta_name(block_dim=self._variant))
        if not (os.path.exists(path) and os.path.exists(meta)):
            return False
        try:
            if _noted_checksum(path) in (None, checksum(path)):
                self._load(module)
                return True
            _LOGGER.debug("%s: its checksum is wrong", path)
        except Exception as error:  # Warp raises nothing narrower where LLVM or CUDA refuse a file
            _LOGGER.debug("%s: %s", path, error)
        for damaged in (path, meta, path + _CHECKSUM):
            with suppress(FileNotFoundError):
                os.unlink(damaged)
        return False

    def _compile(self, module: Any) -> None:
        """Compiles a module into the cache, notes its checksum there, and loads it.

        Raises:
            OSError: The cache cannot be written.
        """
        with self._lock:
            if self._began is None:
                self._began = time.perf_counter()
                self._say("compiling kernels, once: %d of %d modules done")
        os.makedirs(str(wp.config.kernel_cache_dir), exist_ok=True)
        check_room(str(wp.config.kernel_cache_dir), _MODULE_BYTES)
        self._load(module)
        path = self._path(module)
        with suppress(OSError):  # without a checksum the module is as good as those of other programs
            noted, temporary = checksum(path), f"{path}.{os.getpid()}"
            with open(temporary, "w", encoding="ascii") as file:
                file.write(noted)
            os.replace(temporary, path + _CHECKSUM)

    def _load(self, module: Any) -> None:
        wp.load_module(module, device=self._device, block_dim=self._block_dim)

    def _replace_cache(self, cache: str, error: OSError) -> None:
        """Makes another folder the cache, with links to the files that this one has."""
        with self._lock:
            if wp.config.kernel_cache_dir != cache:  # another thread has done it
                return
            own, warning = _temporary_cache(cache, error)
            _LOGGER.warning("%s", warning)
            with suppress(OSError):
                for folder in os.scandir(cache):
                    if folder.is_dir() and folder.name.startswith("wp_"):
                        os.mkdir(os.path.join(own, folder.name))
                        for file in os.scandir(folder.path):
                            os.symlink(file.path, os.path.join(own, folder.name, file.name))
            wp.config.kernel_cache_dir = own

    def _path(self, module: Any) -> str:
        """Path of the compiled module in the cache."""
        name = module._get_compile_output_name(self._device, block_dim=self._variant)
        return os.path.join(str(wp.config.kernel_cache_dir), module.get_module_identifier(self._variant), name)

    @property
    def _variant(self) -> int:
        """The block size for which modules are compiled."""
        return 1 if self._device.is_cpu else self._block_dim

    def _say(self, message: str) -> None:
        progress = self._compiled, self._compiled + len(self._expected)
        _LOGGER.info(message, *progress, extra={"compiling": progress})
