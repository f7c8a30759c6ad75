"""Reports: tables on the screen and in Markdown, and a description of the machine and the software."""

import json
import os
import platform
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import warp as wp
from rich.console import Console
from rich.table import Table as RichTable

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("warp-ir", "warp-lang", "numpy", "mitsuba", "drjit", "pyoidn", "embreex", "flip-evaluator")


@dataclass(frozen=True)
class Table:
    """A table of text; the first column is the label of the row."""

    title: str
    columns: tuple[str, ...]
    rows: list[tuple[str, ...]]
    note: str = ""

    def markdown(self) -> str:
        """The table in GitHub's Markdown."""
        lines = [f"### {self.title}", "", *([self.note, ""] if self.note else [])]
        lines += [_line(self.columns), _line(["---", *("---:" for _ in self.columns[1:])])]
        return "\n".join([*lines, *(_line(row) for row in self.rows), ""])

    def show(self, console: Console) -> None:
        """Prints the table."""
        table = RichTable(title=self.title, caption=self.note or None, title_justify="left", caption_justify="left")
        for k, column in enumerate(self.columns):
            table.add_column(column, justify="right" if k else "left", no_wrap=True)
        for row in self.rows:
            table.add_row(*row)
        console.print(table)


def _line(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def environment(device: str) -> dict[str, Any]:
    """Machine, versions, commit and date of a measurement."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "commit": _commit(),
        "device": device,
        "device_name": _processor() if device == "cpu" else wp.get_device(device).name,
        "cpu_count": cores,
        "python": platform.python_version(),
        "versions": versions,
    }


def describe(environment: dict[str, Any]) -> str:
    """The environment in one line."""
    versions = ", ".join(f"{package} {number}" for package, number in environment["versions"].items())
    return (
        f"{environment['device']} ({environment['device_name']}), {environment['cpu_count']} cores; "
        f"{environment['commit']} of {environment['date'][:10]}; Python {environment['python']}, {versions}"
    )


def _commit() -> str:
    """The commit of the working tree, with "+changes" if files differ from it."""
    try:
        git = ("git", "-C", str(ROOT))
        commit = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True)
        changes = subprocess.run([*git, "status", "--porcelain"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "no commit"
    return commit.stdout.strip() + ("+changes" if changes.stdout.strip() else "")


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def publish(
    tables: list[Table], results: dict[str, Any], *, json_path: Path | None, markdown_path: Path | None
) -> None:
    """Prints the tables and writes the files that are not None."""
    console = Console(width=None if Console().is_terminal else 160)
    for table in tables:
        table.show(console)
    console.print(describe(results["environment"]), style="dim", highlight=False)
    if json_path is not None:
        json_path.write_text(json.dumps(results, indent=1) + "\n")
    if markdown_path is not None:
        text = "\n".join(table.markdown() for table in tables)
        markdown_path.write_text(f"{text}\nMeasured on {describe(results['environment'])}.\n")


def number(value: float | None, digits: int = 3) -> str:
    """A number with few digits; a dash for None."""
    return "–" if value is None else f"{value:.{digits}g}"
