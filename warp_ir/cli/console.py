"""Messages, warnings and progress of the command. They go through the logger "warp_ir", to stderr and to a log file."""

import logging
import math
import os
import sys
import time
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from warp_ir.files import special_kind
from warp_ir.scene import InputError

if TYPE_CHECKING:
    from types import TracebackType

    from rich.progress import Progress as ProgressBar
    from rich.progress import TaskID

    from warp_ir.scheduling import Progress

LOGGER = logging.getLogger("warp_ir")
_WARNINGS_SHOWN = 10
_FIRST_LINE_AFTER = 10.0
"""Seconds until the first line of progress where there is no bar; the wait doubles after each line."""
_COMPILING_LINE_AFTER = 5.0
"""Least seconds between two lines about the kernels that are being compiled."""


class Messages:
    """Sends what the logger "warp_ir" says to stderr, and on request to a file, while the context lasts."""

    def __init__(self) -> None:
        self._level = LOGGER.level
        self._console = _Stderr()
        self._handlers: list[logging.Handler] = []

    def __enter__(self) -> "Messages":
        """Begins to write to stderr."""
        LOGGER.setLevel(logging.DEBUG)
        self._add(self._console)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: "TracebackType | None"
    ) -> None:
        """Leaves the logger as it was."""
        LOGGER.setLevel(self._level)
        for handler in self._handlers:
            LOGGER.removeHandler(handler)
            handler.close()

    def configure(self, *, quiet: bool = False, verbose: bool = False, file: str | None = None) -> None:
        """Takes the flags of the command line.

        Args:
            quiet: Whether stderr shows errors alone.
            verbose: Whether it shows tracebacks.
            file: A file to which everything is appended, with time and level; None: none.

        Raises:
            InputError: The file cannot be written.
        """
        self._console.setLevel(logging.ERROR if quiet else logging.INFO)
        self._console.verbose = verbose
        if file is None:
            return
        try:
            if special_kind(file) == "a pipe":  # to open it would wait for a reader
                os.close(os.open(file, os.O_WRONLY | os.O_NONBLOCK))
            log = _LogFile(file, encoding="utf-8", errors="backslashreplace")
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise InputError(f"--log-file: {file!r} cannot be written: {reason}") from error
        log.set_name("file")
        log.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
        self._add(log)

    def _add(self, handler: logging.Handler) -> None:
        # A record may be for one of the handlers only.
        handler.addFilter(lambda record: getattr(record, "only", handler.name) == handler.name)
        LOGGER.addHandler(handler)
        self._handlers.append(handler)


class _Stderr(logging.Handler):
    """Writes records to stderr, whatever that is at the time: one line each."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.set_name("console")
        self.verbose = False
        self._compiling_line = -math.inf  # when the last line about compiling was written

    def emit(self, record: logging.LogRecord) -> None:
        compiling: tuple[int, int] | None = getattr(record, "compiling", None)
        if compiling is not None:
            now = time.monotonic()
            if compiling[0] > 0 and now - self._compiling_line < _COMPILING_LINE_AFTER:
                return
            self._compiling_line = now
        kind = "warning: " if record.levelno == logging.WARNING else ""
        with suppress(OSError, ValueError):  # nobody reads it, or it is full: no reason to lose a picture
            if record.exc_info and self.verbose:
                traceback.print_exception(*record.exc_info)
            print(f"warp-ir: {kind}{record.getMessage()}", file=sys.stderr, flush=True)


class _LogFile(logging.FileHandler):
    """Appends records to a file; once it cannot be written, that is said on stderr, and the file is left."""

    _failed = False

    def handleError(self, record: logging.LogRecord) -> None:
        error = sys.exc_info()[1]
        if not self._failed:
            self._failed = True
            reason = getattr(error, "strerror", None) or error
            text = f"--log-file: {self.baseFilename} cannot be written: {str(reason).lower()}"
            LOGGER.warning("%s", text, extra={"only": "console"})

    def emit(self, record: logging.LogRecord) -> None:
        if not self._failed:
            super().emit(record)

    def close(self) -> None:
        with suppress(OSError):
            super().close()


def open_closed_streams() -> None:
    """Opens /dev/null in place of standard streams that are closed.

    Otherwise a file that is opened later takes their place, and what native libraries print goes into it.
    """
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))


def discard_stdout() -> None:
    """Sends what is still to be printed on stdout nowhere, after it could not be written."""
    with suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)


def say(message: str, level: int = logging.INFO) -> None:
    """Says something in one line; line breaks in it become spaces. --quiet hides what is below `logging.ERROR`."""
    LOGGER.log(level, "%s", " ".join(message.split()))


def warn(message: str) -> None:
    """Says a warning in one line."""
    say(message, logging.WARNING)


def show_result(message: str, *, quiet: bool) -> None:
    """Prints a line about a result on stdout, unless `quiet` is set, and logs it: the result itself is a file."""
    if not quiet:
        try:
            print(message, flush=True)
        except OSError as error:
            discard_stdout()
            warn(f"the standard output cannot be written: {(error.strerror or str(error)).lower()}")
    LOGGER.info("%s", message, extra={"only": "file"})


def say_warnings(warnings: Iterable[str], *, everything: bool = False) -> None:
    """Says the scene's warnings: on stderr the first ten and the number of the others, or all with `everything`."""
    warnings = list(dict.fromkeys(warnings))
    shown = len(warnings) if everything or len(warnings) == _WARNINGS_SHOWN + 1 else _WARNINGS_SHOWN
    for number, warning in enumerate(warnings):
        LOGGER.warning("%s", " ".join(warning.split()), extra={} if number < shown else {"only": "file"})
    if len(warnings) > shown:
        more = f"... and {len(warnings) - shown} more; --verbose shows all"
        LOGGER.warning("%s", more, extra={"only": "console"})


@contextmanager
def muted_stderr(active: bool = True) -> Iterator[None]:
    """Hides what native libraries print on file descriptor 2: redirecting Python's sys.stderr does not affect them."""
    try:
        saved = os.dup(2) if active else -1
    except OSError:  # the process has no stderr
        saved = -1
    if saved < 0:
        yield
        return
    sys.stderr.flush()
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    os.close(null)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)


class ProgressDisplay:
    """Shows the renderer's progress: a bar on a terminal, otherwise lines at growing intervals."""

    def __init__(self, label: str, *, quiet: bool = False) -> None:
        """Nothing is shown before `__enter__`.

        Args:
            label: Name of what is being rendered.
            quiet: Whether to show nothing at all.
        """
        self._label, self._quiet = label, quiet
        self._bar: ProgressBar | None = None
        self._task: TaskID | None = None
        self._wait, self._last_line = _FIRST_LINE_AFTER, time.monotonic()

    def __enter__(self) -> "ProgressDisplay":
        """Shows the empty bar if stderr is a terminal."""
        if not self._quiet and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, TextColumn
            from rich.progress import Progress as ProgressBar

            columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[status]}")
            self._bar = ProgressBar(*columns, console=Console(stderr=True), transient=True)
            self._bar.start()
            self._task = self._bar.add_task(self._label, total=None, status="preparing")
            LOGGER.addFilter(self._show_compiling)
        return self

    def __exit__(self, *_: object) -> None:
        """Removes the bar."""
        LOGGER.removeFilter(self._show_compiling)
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, progress: "Progress") -> None:
        """Shows how far the render is."""
        if self._quiet:
            return
        status = describe_progress(progress)
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, total=1.0, completed=progress.fraction, status=status)
        elif time.monotonic() - self._last_line >= self._wait:
            self._wait, self._last_line = 2.0 * self._wait, time.monotonic()
            say(f"{self._label}: {100.0 * progress.fraction:.0f} %, {status}")

    def _show_compiling(self, record: logging.LogRecord) -> bool:
        """A filter of the logger: what is said of compiling after the first line is shown by the bar."""
        compiling: tuple[int, int] | None = getattr(record, "compiling", None)
        if compiling is not None and self._bar is not None and self._task is not None:
            self._bar.update(self._task, status=f"compiling kernels, {compiling[0]} of {compiling[1]}")
            if compiling[0] > 0:
                record.only = "file"
        return True


def describe_progress(progress: "Progress") -> str:
    """Iterations, error and remaining time as a short text; unknown values are left out."""
    parts = [f"{progress.iterations} iterations"]
    if math.isfinite(progress.error):
        parts.append(f"error {100.0 * progress.error:.2g} %")
    if math.isfinite(progress.seconds_left):
        parts.append(f"{_duration(progress.seconds_left)} left")
    return ", ".join(parts)


def _duration(seconds: float) -> str:
    minutes, rest = divmod(math.ceil(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
