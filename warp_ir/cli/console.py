"""Messages, warnings and progress of the command; all go to stderr."""

import math
import os
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress as ProgressBar
    from rich.progress import TaskID

    from warp_ir.scheduling import Progress

_WARNINGS_SHOWN = 10
_FIRST_LINE_AFTER = 10.0
"""Seconds until the first line of progress where there is no bar; the wait doubles after each line."""


def say(message: str) -> None:
    """Prints the message on stderr as one line; line breaks in it become spaces."""
    print("warp-ir:", " ".join(message.split()), file=sys.stderr, flush=True)


def say_warnings(warnings: Iterable[str], *, everything: bool = False) -> None:
    """Prints the scene's warnings: the first ten and the number of the others, or all if `everything` is set."""
    warnings = list(dict.fromkeys(warnings))
    shown = warnings if everything or len(warnings) == _WARNINGS_SHOWN + 1 else warnings[:_WARNINGS_SHOWN]
    for warning in shown:
        say(f"warning: {warning}")
    if len(warnings) > len(shown):
        say(f"warning: ... and {len(warnings) - len(shown)} more; --verbose shows all")


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
        return self

    def __exit__(self, *_: object) -> None:
        """Removes the bar."""
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
