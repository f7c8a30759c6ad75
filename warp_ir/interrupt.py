"""Interruption of a render by Ctrl-C: launches in flight are cancelled, and the film keeps its complete iterations."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from warp_ir.device.launcher import Launcher
from warp_ir.film import Film


@contextmanager
def cancel_on_signal(launcher: Launcher, film: Film) -> Iterator[None]:
    """Cancels the launches inside on SIGINT or SIGTERM; `film.interrupted` becomes the number of the signal.

    The launches raise `Cancelled` when the current bands of indices are done. Python delivers signals to its main
    thread only; in any other thread this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def cancel(number: int, _frame: FrameType | None) -> None:
        film.interrupted = number
        launcher.cancel()

    previous = {number: signal.signal(number, cancel) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
        launcher.resume()
