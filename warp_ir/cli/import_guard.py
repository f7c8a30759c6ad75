"""While foreign code imports itself."""

import gc
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def importing() -> Iterator[None]:
    """SIGINT and SIGTERM arrive when what is imported inside is there, and nobody looks for garbage in it.

    USD's modules import each other from C++, which prints an exception that comes up meanwhile and goes on: the Ctrl-C
    would be lost, and the command run to its end. What modules define is no garbage: looking for some takes a sixth of
    the time.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    collects = gc.isenabled()
    gc.disable()
    arrived: list[int] = []

    def note(number: int, _: Any) -> None:
        arrived.append(number)

    previous = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
        if collects:
            gc.enable()
    if arrived:
        signal.raise_signal(arrived[0])
