"""The command `warp-ir`, also as ``python -m warp_ir``: what it does before anything is imported."""

import _signal as signal  # type: ignore[import-not-found]  # what lies under the module signal, whose import takes a while
import os
from types import FrameType
from typing import NoReturn


def command() -> NoReturn:
    """Runs the command line. Ctrl-C ends it in one line from here on: there is nothing to be saved during imports."""
    signal.signal(signal.SIGINT, _end)
    from warp_ir.cli import command

    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        command()
    except KeyboardInterrupt:  # in the moments outside `main`
        _end(signal.SIGINT, None)


def _end(number: int, _: FrameType | None) -> NoReturn:
    try:
        os.write(2, b"warp-ir: interrupted\n")
    finally:
        os._exit(128 + number)


if __name__ == "__main__":
    command()
