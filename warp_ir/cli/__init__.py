"""The command `warp-ir`: whatever goes wrong ends in one line on stderr and an exit code.

0: done; 1: internal error; 2: the input or the command line is wrong; 130, 143: stopped by Ctrl-C or
SIGTERM, the picture so far is written.

Nothing heavy (Warp, USD, a picture library) is imported before a command needs it.
"""

import atexit
import importlib
import os
import signal
import sys
import threading
import traceback
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NoReturn

from warp_ir.cli.arguments import parse
from warp_ir.cli.console import say
from warp_ir.scene import InputError


class Terminated(BaseException):
    """SIGTERM arrived; like KeyboardInterrupt, it unwinds so that nothing half-written stays behind."""


def command() -> NoReturn:
    """The process `warp-ir`: `main`, and the end of it.

    Python would take apart every object of Warp, NumPy and USD, for half a second. The system does it at once.
    """
    code = main()
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, OSError, ValueError):  # no stream, or a broken one
            stream.flush()
    os._exit(code)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line and returns the exit code.

    Args:
        argv: The arguments, by default those of the process.
    """
    argv = sys.argv[1:] if argv is None else list(argv)
    verbose = "--verbose" in argv
    # A file name that the terminal cannot show must not be an error.
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="backslashreplace")
    in_main_thread = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, _terminate) if in_main_thread else None
    try:
        args = parse(argv)
        code: int = importlib.import_module(f"warp_ir.cli.{args.command}").run(args)
        sys.stdout.flush()
        return code
    except InputError as error:
        return _fail(2, "error", error, verbose)
    except KeyboardInterrupt:
        say("interrupted")
        return 128 + signal.SIGINT
    except Terminated:
        say("terminated")
        return 128 + signal.SIGTERM
    except BrokenPipeError:
        # The reader of our output is gone (`warp-ir info … | head`): nobody is left to be told.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except MemoryError as error:
        return _fail(1, "error", f"out of memory: {error or 'try a smaller --width'}", verbose)
    except Exception as error:
        hint = "" if verbose else " (--verbose shows where)"
        return _fail(1, "internal error", f"{type(error).__name__}: {error}{hint}", verbose)
    finally:
        if in_main_thread:
            signal.signal(signal.SIGTERM, before)


def _terminate(signum: int, frame: Any) -> None:
    raise Terminated


def _fail(code: int, kind: str, message: object, verbose: bool) -> int:
    if verbose:
        traceback.print_exc()
    say(f"{kind}: {message}")
    return code
