"""A context for importing native packages."""

import gc
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def importing() -> Iterator[None]:
    """Delays SIGINT and SIGTERM, and disables garbage collection, until the imports inside are done.

    USD's modules import each other from C++ code, which prints a Python exception and continues: a Ctrl-C would be lost
    and the command would run to its end. Modules define no garbage, and collecting it would take a sixth of the import
    time.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    collection_enabled = gc.isenabled()
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
        if collection_enabled:
            gc.enable()
    if arrived:
        signal.raise_signal(arrived[0])
