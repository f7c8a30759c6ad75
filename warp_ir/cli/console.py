"""What the command says while it works: messages, warnings and progress, all of it on stderr."""

import math
import os
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

_WARNINGS_SHOWN = 10
_FIRST_LINE_AFTER = 10.0
"""Seconds until the first line of progress where there is no bar; each further one takes twice as long."""


def say(message: str) -> None:
    """One line on stderr, whatever the message contains."""
    print("warp-ir:", " ".join(message.split()), file=sys.stderr, flush=True)


def say_warnings(warnings: Iterable[str], *, everything: bool = False) -> None:
    """The scene's warnings: the first few and a count of the rest, or all of them."""
    warnings = list(dict.fromkeys(warnings))
    shown = warnings if everything or len(warnings) == _WARNINGS_SHOWN + 1 else warnings[:_WARNINGS_SHOWN]
    for warning in shown:
        say(f"warning: {warning}")
    if len(warnings) > len(shown):
        say(f"warning: ... and {len(warnings) - len(shown)} more; --verbose shows all")


@contextmanager
def muted_stderr(active: bool = True) -> Iterator[None]:
    """Hides what native libraries print on file descriptor 2, which Python's sys.stderr cannot catch."""
    try:
        saved = os.dup(2) if active else -1
    except OSError:  # there is no stderr
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
    """Shows the renderer's progress: a bar on a terminal, otherwise a line now and then."""

    def __init__(self, label: str, *, quiet: bool = False) -> None:
        """Nothing is shown before `__enter__`.

        Args:
            label: What is being rendered.
            quiet: Show nothing at all.
        """
        self._label, self._quiet = label, quiet
        self._bar: Any = None
        self._task: Any = None
        self._wait, self._last_line = _FIRST_LINE_AFTER, time.monotonic()

    def __enter__(self) -> "ProgressDisplay":
        """Shows the empty bar, if there is one."""
        if not self._quiet and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn

            columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[status]}")
            self._bar = Progress(*columns, console=Console(stderr=True), transient=True)
            self._bar.start()
            self._task = self._bar.add_task(self._label, total=None, status="preparing")
        return self

    def __exit__(self, *_: object) -> None:
        """Removes the bar."""
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, progress: Any) -> None:
        """Shows a `warp_ir.renderer.Progress`."""
        if self._quiet:
            return
        status = describe_progress(progress)
        if self._bar is not None:
            self._bar.update(self._task, total=1.0, completed=progress.fraction, status=status)
        elif time.monotonic() - self._last_line >= self._wait:
            self._wait, self._last_line = 2.0 * self._wait, time.monotonic()
            say(f"{self._label}: {100.0 * progress.fraction:.0f} %, {status}")


def describe_progress(progress: Any) -> str:
    """Iterations, error and time left in a few words."""
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
