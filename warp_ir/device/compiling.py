"""Loading Warp's modules, and saying so where the kernel cache lacks them.

Compiling takes seconds a module, once for each version of a kernel. What is said goes to the logger "warp_ir" at level
INFO: when the first module begins to compile, after each, and when all are done. The attribute `compiling` of these
records is the number of modules that are done, and the number of all, as far as is known.
"""

import logging
import os
import threading
import time
from collections.abc import Iterable
from typing import Any

import warp as wp

from warp_ir.device import definitions

_LOGGER = logging.getLogger("warp_ir")


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
        by_record = self._device.is_cpu and definitions.load(module)
        if not by_record:
            definitions.define_all()
        compiles = not by_record and not self._is_cached(module)
        if compiles:
            with self._lock:
                if self._began is None:
                    self._began = time.perf_counter()
                    self._say("compiling kernels, once: %d of %d modules done")
        if not by_record:
            wp.load_module(module, device=self._device, block_dim=self._block_dim)
            if self._device.is_cpu:
                definitions.record(module, self._device)
        with self._lock:
            self._loaded.add(module)
            self._expected.discard(module)
            self._compiled += compiles
            if compiles:
                self._say("compiling kernels, once: %d of %d modules done")
            if self._began is not None and not self._expected:
                seconds = time.perf_counter() - self._began
                _LOGGER.info("kernels compiled: %d modules, %.1f s", self._compiled, seconds)
                self._compiled, self._began = 0, None

    def _is_cached(self, module: Any) -> bool:
        block_dim = 1 if self._device.is_cpu else self._block_dim
        name = module._get_compile_output_name(self._device, block_dim=block_dim)
        folder = module.get_module_identifier(block_dim)
        return os.path.exists(os.path.join(str(wp.config.kernel_cache_dir), folder, name))

    def _say(self, message: str) -> None:
        progress = self._compiled, self._compiled + len(self._expected)
        _LOGGER.info(message, *progress, extra={"compiling": progress})
