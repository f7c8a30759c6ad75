"""The command `warp-ir`: every failure is reported as one line on stderr and an exit code.

Exit codes: 0: done; 1: the system refuses something, or an internal error; 2: the input or the command line is wrong;
130 and 143: stopped by Ctrl-C or by SIGTERM, after the picture so far has been written.

Heavy packages (Warp, USD, image libraries) are imported only when a command needs them.
"""

import atexit
import importlib
import logging
import os
import shlex
import signal
import sys
import threading
import time
import warnings
from collections.abc import Sequence
from contextlib import suppress
from types import FrameType
from typing import NoReturn

from warp_ir.cli.arguments import parse
from warp_ir.cli.console import LOGGER, Messages, discard_stdout, open_closed_streams, say
from warp_ir.files import check_input
from warp_ir.image.ocio import use_config
from warp_ir.scene import InputError

_LOADED = time.perf_counter()
"""When the command began, if it is the process's: Python itself has taken some hundredths of a second before."""


class Terminated(BaseException):
    """SIGTERM arrived. Like KeyboardInterrupt it unwinds the stack, so that no half-written file is left behind."""


def command() -> NoReturn:
    """Runs `main` and ends the process `warp-ir` with its exit code.

    `os._exit` skips the destructors of all objects of Warp, NumPy and USD, which would take half a second.
    """
    code = main(started=_LOADED)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is done
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, OSError, ValueError):  # the stream is missing, closed or broken
            stream.flush()
    os._exit(code)


def main(argv: Sequence[str] | None = None, started: float | None = None) -> int:
    """Runs the command line and returns the exit code.

    Args:
        argv: The arguments; None: those of the process.
        started: `time.perf_counter` from which `--time-limit` counts; None: this call.
    """
    started = time.perf_counter() if started is None else started
    argv = sys.argv[1:] if argv is None else list(argv)
    # Warp says so on import; whoever runs the command cannot help it.
    warnings.filterwarnings("ignore", "Support for Python 3.10 is deprecated", FutureWarning)
    open_closed_streams()
    # A file name that the terminal cannot encode must not raise an error.
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="backslashreplace")
    in_main_thread = threading.current_thread() is threading.main_thread()
    previous_handler = signal.signal(signal.SIGTERM, _terminate) if in_main_thread else None
    try:
        with Messages() as messages:
            return _run(argv, messages, started)
    finally:
        if in_main_thread:
            signal.signal(signal.SIGTERM, previous_handler)


def _run(argv: Sequence[str], messages: Messages, started: float) -> int:
    """Parses and executes the command line; returns the exit code."""
    verbose = "--verbose" in argv or "-v" in argv
    messages.configure(verbose=verbose)  # if the arguments are wrong
    try:
        args = parse(argv)
        messages.configure(quiet=args.quiet, verbose=args.verbose, file=args.log_file)
        verbose = args.verbose
        LOGGER.debug("%s", shlex.join(["warp-ir", *argv]))
        if args.stage is not None:
            check_input(args.stage, "a USD file")  # before anything is imported that takes time
        args.started = started
        with use_config(args.ocio_config):
            code: int = importlib.import_module(f"warp_ir.cli.{args.command}").run(args)
        sys.stdout.flush()
        return code
    except InputError as error:
        return _fail(2, f"error: {error}", trace=verbose)
    except KeyboardInterrupt:
        say("interrupted", logging.ERROR)
        return 128 + signal.SIGINT
    except Terminated:
        say("terminated", logging.ERROR)
        return 128 + signal.SIGTERM
    except BrokenPipeError:
        # The program that reads our output has ended (`warp-ir info … | head`): report nothing.
        discard_stdout()
        return 128 + signal.SIGPIPE
    except MemoryError as error:
        return _fail(1, f"error: out of memory: {error or 'try a smaller --width'}")
    except OSError as error:
        where = "the output cannot be written" if error.filename is None else error.filename
        if error.filename is None:
            discard_stdout()
        return _fail(1, f"error: {where}: {(error.strerror or str(error)).lower()}", trace=verbose)
    except Exception as error:
        if "can't start new thread" in str(error):
            return _fail(1, "error: the system refuses a thread: see ulimit -u and ulimit -v")
        hint = "" if verbose else " (--verbose shows where)"
        return _fail(1, f"internal error: {type(error).__name__}: {error}{hint}")


def _terminate(signum: int, frame: FrameType | None) -> None:
    raise Terminated


def _fail(code: int, message: str, *, trace: bool = True) -> int:
    """Reports the exception that is being handled; `trace` says whether its traceback may be of interest."""
    LOGGER.error("%s", " ".join(message.split()), exc_info=trace)
    return code
