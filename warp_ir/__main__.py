"""The command `warp-ir`, also as ``python -m warp_ir``: what it does before anything is imported."""

import _signal as signal  # type: ignore[import-not-found]  # what lies under the module signal, whose import takes a while
import os
from types import FrameType
from typing import NoReturn

_LEAST_ADDRESS_SPACE = 1850 << 20
"""What Warp, LLVM and USD map before anything is rendered [bytes]; with less some of them crash on import."""


def command() -> NoReturn:
    """Runs the command line. Ctrl-C ends it in one line from here on: there is nothing to be saved during imports."""
    signal.signal(signal.SIGINT, _end)
    _check_address_space()
    from warp_ir.cli import command

    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        command()
    except KeyboardInterrupt:  # in the moments outside `main`
        _end(signal.SIGINT, None)


def _check_address_space() -> None:
    """Ends the process in one line if `ulimit -v` leaves too little to start."""
    try:
        import resource
    except ImportError:  # Windows
        return
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < _LEAST_ADDRESS_SPACE:
        least = f"{_LEAST_ADDRESS_SPACE / 2**30:.1f} GiB"
        message = f"warp-ir: error: ulimit -v: {limit / 2**30:.1f} GiB of address space are too few; {least} are needed"
        os.write(2, f"{message} to start\n".encode())
        os._exit(2)


def _end(number: int, _: FrameType | None) -> NoReturn:
    try:
        os.write(2, b"warp-ir: interrupted\n")
    finally:
        os._exit(128 + number)


if __name__ == "__main__":
    command()
