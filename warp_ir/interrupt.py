"""What happens on Ctrl-C: the work in flight is cancelled, and the film keeps the iterations that are complete."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from warp_ir.device.launcher import Launcher
from warp_ir.film import Film


@contextmanager
def cancel_on_signal(launcher: Launcher, film: Film) -> Iterator[None]:
    """Lets SIGINT and SIGTERM cancel the launches inside, and writes the signal's number to `film.interrupted`.

    The launches raise `Cancelled` as soon as their current band of indices is done. Python delivers signals to its
    main thread alone; in any other thread this does nothing.
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
