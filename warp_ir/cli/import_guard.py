"""A context for importing native packages."""

import gc
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def importing() -> Iterator[None]:
    """Delays SIGINT and SIGTERM, and exempts what is imported from garbage collection, until the imports are done.

    USD's modules import each other from C++ code, which prints a Python exception and continues: a Ctrl-C would be lost
    and the command would run to its end. Modules define no garbage; looking for it among their objects, now and in
    every later collection, would take a sixth of the start.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    collection_enabled, loaded = gc.isenabled(), len(sys.modules)
    gc.disable()
    arrived: list[int] = []

    def note(number: int, _: FrameType | None) -> None:
        arrived.append(number)

    previous = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
        if len(sys.modules) > loaded:
            gc.freeze()
        if collection_enabled:
            gc.enable()
    if arrived:
        signal.raise_signal(arrived[0])
