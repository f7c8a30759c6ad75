"""Kernels that Warp reads only where it has to compile them.

Warp parses a function when it is decorated, and hashes all that a module uses before it looks into its cache: a third
of a short render's start. As long as this package, Warp and its options are what they were, the machine code in Warp's
cache can be loaded without either. So this module

* puts off what `wp.func`, `wp.func_native` and `wp.kernel` do until something is asked of a function, or Warp has to
  load a module (`put_off`);
* writes a record for every module that Warp has loaded: the file of its code, its checksum, and the symbols of its
  kernels. It lies in Warp's cache and is named by a hash of the package's text, of Warp's configuration and of the
  CPU's features.

A module that has no such record is loaded by Warp, and so is every module on a GPU. What is called here of Warp is not
public (`_llvm`, `Command`, `record`); with another version than `_WARP` nothing is put off, and Warp does it all.
"""

import ctypes
import functools
import hashlib
import json
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import warp as wp

_WARP = "1.19.0"
_PACKAGE = Path(__file__).parents[1]
_LOCK, _IMPORTING = threading.RLock(), threading.RLock()
_UNRELATED = {"kernel_cache_dir", "log_level", "verbose_warnings", "track_memory", "load_module_max_workers"}
"""Options of Warp on which code does not depend."""

_pending: list[Callable[[], Any]] = []  # what has not been defined yet, in the order of the source
_names: dict[str, set[str]] = {}  # names of the kernels put off, by the module that Warp compiles them in
_code: dict[str, dict[str, Any]] = {}  # entry points by kernel, of modules that were loaded without Warp


class _Function(wp.Function):
    """A function of Warp's that is defined when one of its attributes is asked for."""

    def __init__(self, python: Callable[..., Any], define: Callable[[], Any], **_: Any) -> None:
        self.__dict__["_define"] = define
        functools.update_wrapper(self, python)
        _pending.append(functools.partial(_Function.define, self))

    def __getattr__(self, name: str) -> Any:  # called for what the object does not have yet
        self.define()
        return object.__getattribute__(self, name)

    def define(self) -> None:
        with _LOCK:
            define = self.__dict__.pop("_define", None)
            if define is None:
                return
            function = define()
            self.__dict__ = function.__dict__  # one function by two names: Warp has `function` in its tables
            self.__class__ = wp.Function  # type: ignore[assignment]  # it has all that one has
            overloads = function.user_overloads
            overloads.update({types: self for types, each in overloads.items() if each is function})
            function.module.functions[function.key] = self


class Kernel:
    """A kernel that Warp knows only if it has to load its module, or to launch it itself."""

    def __init__(
        self, python: Callable[..., Any], define: Callable[[], Any], module: str | None = None, **_: Any
    ) -> None:
        """A kernel of a Python function, which `define` defines in the module of that name, by default its own."""
        self.__doc__ = python.__doc__
        module = module or python.__module__
        self.key: str = python.__name__
        self.module = wp.get_module(module)
        scalars = {int: wp.int32, float: wp.float32, bool: wp.bool}
        self.arguments = [
            (name, scalars.get(kind, kind)) for name, kind in python.__annotations__.items() if name != "return"
        ]
        self.structures: dict[tuple[type, ...], type[ctypes.Structure]] = {}
        self.definition: Any = None  # Warp's kernel
        self._define = define
        _names.setdefault(module, set()).add(self.key)
        _pending.append(self.define)

    def define(self) -> None:
        """Lets Warp define the kernel."""
        self.definition = self._define()


def define_all() -> None:
    """Defines whatever has been put off: Warp must not hash a module before it knows all of its kernels."""
    with _LOCK:
        while _pending:
            _pending.pop(0)()


def defined(kernel: Any) -> Any:
    """Warp's kernel of a kernel of either kind."""
    if not isinstance(kernel, Kernel):
        return kernel
    define_all()
    return kernel.definition


class Command:
    """A launch of a kernel whose module `load` has loaded, with the methods of Warp's recorded launches."""

    def __init__(self, kernel: Kernel, inputs: Sequence[Any], device: Any) -> None:
        """Packs the arguments, whose types are checked by Warp."""
        from warp._src.context import pack_arg
        from warp._src.types import launch_bounds_t

        values = [
            pack_arg(kernel, kind, name, value, device)
            for (name, kind), value in zip(kernel.arguments, inputs, strict=True)
        ]
        kinds = tuple(map(type, values))
        if kinds not in kernel.structures:
            fields = [(name, kind) for (name, _), kind in zip(kernel.arguments, kinds, strict=True)]
            kernel.structures[kinds] = type("Arguments", (ctypes.Structure,), {"_fields_": fields})
        self._arguments = kernel.structures[kinds](*values)
        self._first = kernel.arguments[0][0]
        self._bounds_of = launch_bounds_t
        self.set_dim(1)
        self._run = _code[kernel.module.name][kernel.key]

    def set_param_at_index(self, index: int, value: int) -> None:
        """Sets the first argument, the index 0."""
        assert index == 0
        setattr(self._arguments, self._first, value)

    def set_dim(self, count: int) -> None:
        """Sets the number of indices."""
        self._bounds = self._bounds_of((count,))

    def launch(self) -> None:
        """Runs the kernel in this thread, without the interpreter's lock."""
        self._run(ctypes.byref(self._bounds), ctypes.byref(self._arguments))


def is_loaded(kernel: Any) -> bool:
    """Whether `load` has loaded the code of a kernel."""
    return isinstance(kernel, Kernel) and kernel.key in _code.get(kernel.module.name, ())


def load(module: Any) -> bool:
    """Loads the code of one of Warp's modules for the CPU by its record; returns whether there was a fitting one."""
    with _LOCK:
        if module.name in _code:
            return True
        if module.name not in _names or module.kernels:  # nothing or not all of it has been put off
            return False
        try:
            entry = json.loads(_record_path(module).read_text())
            path = os.path.join(str(wp.config.kernel_cache_dir), entry["file"])
            symbols, damaged = entry["symbols"], checksum(path) != entry["checksum"]
        except (OSError, ValueError, LookupError, TypeError):
            return False
        handle = f"warp_ir_{module.name}".encode()
        if damaged or _llvm().wp_load_obj(path.encode(), handle, wp.config.legacy_cpu_linker) != 0:
            return False
        entry_point = ctypes.CFUNCTYPE(None)
        addresses = {name: _llvm().wp_lookup(handle, symbol.encode()) for name, symbol in symbols.items()}
        if not all(addresses.values()):
            return False
        _code[module.name] = {name: entry_point(address) for name, address in addresses.items()}
        return True


def record(module: Any, device: Any) -> None:
    """Writes the record of a module that Warp has loaded for the CPU."""
    if module.name not in _names:
        return
    loaded = module.load(device, 1)
    symbols = {key: loaded.get_kernel_mangled_name(kernel) + "_cpu_forward" for key, kernel in module.kernels.items()}
    file = os.path.relpath(loaded.binary_path, wp.config.kernel_cache_dir)
    path = _record_path(module)
    temporary = path.with_suffix(f".{os.getpid()}-{threading.get_ident()}")
    try:
        entry = {"file": file, "checksum": checksum(loaded.binary_path), "symbols": symbols}
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text(json.dumps(entry))
        temporary.replace(path)
    except OSError:  # the cache is read-only, or gone: the next start is as slow as this one
        return


def checksum(path: str) -> str:
    """A checksum of a file."""
    with open(path, "rb") as file:
        return hashlib.blake2b(file.read(), digest_size=16).hexdigest()


def _record_path(module: Any) -> Path:
    """The file of a module's record, which has another name where the code would be another."""
    options = {name: value for name, value in vars(wp.config).items() if not name.startswith("_")}
    options = {**options, **module.options}
    text = repr([(name, options[name]) for name in sorted(options.keys() - _UNRELATED) if not callable(options[name])])
    text += repr(sorted(_names[module.name]))  # Warp compiles those kernels of a module that have been imported
    name = f"{module.name}_{hashlib.sha256(text.encode()).hexdigest()[:8]}.json"
    # `wp.clear_kernel_cache` removes folders with this prefix.
    return Path(str(wp.config.kernel_cache_dir)) / f"wp_warp_ir_{_hash_of_package()}" / name


@functools.cache
def _hash_of_package() -> str:
    """A hash of the text of this package, and of the CPU for which Warp compiles it."""
    digest = hashlib.sha256(_llvm().wp_get_host_cpu_features() + _llvm().wp_get_cpu_target_triple())
    for path in sorted(_PACKAGE.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _llvm() -> Any:
    """Warp's library that compiles and loads code of the CPU."""
    from warp._src import context

    return context.runtime.llvm  # type: ignore[attr-defined]  # `wp.init` sets it


def _defers(decorator: Callable[..., Any], kind: Callable[..., Any]) -> Callable[..., Any]:
    """A decorator that puts off what one of Warp's does, and makes an object of that kind instead."""

    def decorate(python: Callable[..., Any] | None = None, **options: Any) -> Any:
        if python is None:
            return functools.partial(decorate, **options)
        if not python.__module__.startswith(f"{_PACKAGE.name}."):
            return decorator(python, **options)
        return kind(python, functools.partial(decorator, python, **options), **options)

    return decorate


@contextmanager
def put_off() -> Iterator[None]:
    """Puts off the definitions of this package's kernels and functions that are imported inside."""
    if wp.__version__ != _WARP:
        yield
        return
    with _IMPORTING:
        func, func_native, kernel = decorators = wp.func, wp.func_native, wp.kernel
        wp.func, wp.kernel = _defers(func, _Function), _defers(kernel, Kernel)
        wp.func_native = lambda *snippets: _defers(func_native(*snippets), _Function)
        try:
            yield
        finally:
            wp.func, wp.func_native, wp.kernel = decorators
