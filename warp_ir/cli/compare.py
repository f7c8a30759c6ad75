"""`warp-ir compare`: error against time on the user's own scene, with `path` as the referee.

The reference is a long render by `path`, which shares no transport with what it judges. Its own relative
mean squared error, known from its standard error, is the floor: it is subtracted from what is measured, and
what lies far below it cannot be told apart. What errors are relative to is another picture, smooth and without
the noise of the reference: where that is too dark by chance it would weigh its own noise most.
"""

import argparse
import json
import math
import signal
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import warp_ir as ir
from warp_ir.cli.arguments import METHODS, settings_of
from warp_ir.cli.console import ProgressDisplay, say, say_warnings
from warp_ir.cli.device_choice import open_device
from warp_ir.cli.stage_options import moment_of, open_reader
from warp_ir.film.denoise import require_denoiser
from warp_ir.image.io import check_output, whole_file
from warp_ir.metrics import mean_ratio, relative_mse
from warp_ir.scene import InputError, Scene

_RESOLUTION = 0.05
"""Errors below this share of the floor cannot be told apart, and count as this share."""
_LEVEL = 1.1
"""Methods whose errors differ by less than this factor are called level."""
_TARGETS = (0.01, 0.001)
"""Errors of which it is told how long they take: a little noise, and none to the eye."""
_FARTHEST = 50.0
"""Times the longest render, and no farther, is extrapolated: slopes are noisy."""
_WARM_UP_PATHS = 16


@dataclass(frozen=True)
class Reference:
    """What is taken for the truth."""

    picture: Any
    """Linear radiance, [height, width, 3]."""
    standard_error: Any
    """Of `picture`, the same shape."""
    scale: Any
    """What errors are relative to: a smooth picture, without the noise of `picture`, the same shape."""
    floor: float
    """Its own relative mean squared error."""
    seconds: float
    iterations: int
    seed: int

    @property
    def resolution(self) -> float:
        """The smallest error that it can tell from none."""
        return max(_RESOLUTION * self.floor, 1e-12)


@dataclass(frozen=True)
class Run:
    """One picture, or the medians of those that differ in the seed alone."""

    method: str
    time_limit: float
    seed: int | None
    seconds: float
    iterations: float
    error: float
    """relMSE, the floor subtracted: can be negative."""
    mean_ratio: float


@dataclass(frozen=True)
class Verdict:
    """Which method to use, and how long it takes."""

    method: str
    flags: str
    """Of `warp-ir render`."""
    seconds: dict[float, tuple[float, bool] | None]
    """relMSE -> seconds, and whether they were measured or extrapolated; None: too far to tell."""
    level: list[str]
    """Other methods that are as good."""


def run(args: argparse.Namespace) -> int:
    """Renders the reference, then every method for every time; the exit code."""
    from warp_ir.cli import Terminated

    settings_of(args)
    picture = check_output(args.output, (".png",), make_folder=args.make_output_path) if args.output else None
    if picture is not None:
        _require_matplotlib()
    numbers = check_output(args.json, (".json",), make_folder=args.make_output_path) if args.json else None
    methods = _methods(args)
    device = open_device(args.device, verbose=args.verbose)
    reader = open_reader(args)
    scene = reader.read(moment_of(args))
    if not args.quiet:
        say_warnings(scene.warnings, everything=args.verbose)
    job = _Job(args, scene, device)
    runs: list[Run] = []
    code, reference = 0, None
    try:
        reference = job.reference()
        for measured in job.runs(methods, reference):
            runs.append(measured)
    except _Stopped as stop:
        code = stop.code
    except KeyboardInterrupt:  # between the renders
        code = 128 + signal.SIGINT
    except Terminated:
        code = 128 + signal.SIGTERM
    if reference is None or not runs:
        say("interrupted before the first picture could be compared: nothing to tell")
        return code
    rows = _medians(runs)
    verdict = judge(rows, reference.resolution)
    _print_table(rows, reference)
    if code:
        say("interrupted: the table holds what was done by then")
    if not args.quiet:
        _warn_of_floor(rows, reference)
        if args.methods is None and len(methods) < len(METHODS):
            say("vpl denoised is left out: Open Image Denoise is not installed: pip install 'warp-ir[denoise]'")
    print(in_words(verdict, max(row.time_limit for row in rows)), flush=True)
    title = f"{Path(args.stage).name}, {job.size[0]} x {job.size[1]}, on {device}"
    if picture is not None:
        with whole_file(picture) as temporary:
            _plot(rows, reference, title, temporary)
    if numbers is not None:
        _write_json(numbers, job, reference, runs, rows, verdict, code)
    return code


class _Stopped(BaseException):
    """A signal ended a render, and with it the comparison; what has been measured stays."""

    def __init__(self, number: int) -> None:
        # The renderer tells which signal stopped it; a mere True stands for Ctrl-C.
        self.code = 128 + (number if number > 1 else signal.SIGINT)


class _Job:
    """The scene, and how pictures of it are made."""

    def __init__(self, args: argparse.Namespace, scene: Scene, device: str) -> None:
        self.args, self.scene, self.device = args, scene, device
        # The limits and the method are ours to choose, whatever the stage asks for.
        self.settings = replace(settings_of(args, scene.settings), iterations=None, target_error=None)
        self.size = (0, 0)

    def reference(self) -> Reference:
        """The long render by `path`, of a seed that no method has."""
        seconds = self.args.reference_time or 10.0 * max(self.args.times)
        seed = (self.settings.seed + self.args.seeds) % (1 << 32)
        film = self._render("path", seconds, seed, "reference")
        if film.iterations < 2:
            raise InputError(
                f"--reference-time: one iteration of path takes {film.seconds:.3g} s, {seconds:g} s do not hold two"
            )
        self.size = (film.width, film.height)
        picture, error = film.radiance(), film.standard_error()
        if not picture.mean() > 0.0:
            raise InputError(f"{self.args.stage}: the picture is black; no error is relative to it")
        # Noise must not weigh itself. A weight may be a little wrong, so that any smooth picture will do.
        scale = self._render("vpl", max(self.args.times), seed, "smooth picture").radiance()
        floor = -relative_mse(picture, picture, reference_error=error, scale=scale)
        return Reference(picture, error, scale, floor, film.seconds, film.iterations, seed)

    def runs(self, methods: Sequence[str], reference: Reference) -> Iterator[Run]:
        """A picture by each of the methods in turn, for every seed and time."""
        times, seeds = self.args.times, self.args.seeds
        total, number = seeds * len(times) * len(methods), 0
        for method in methods:  # nothing is compiled, loaded or first touched while the clock runs
            self._render(method, None, self.settings.seed, f"{method}, warming up")
        last: dict[tuple[str, int], Run] = {}
        for seed in ((self.settings.seed + k) % (1 << 32) for k in range(seeds)):
            for limit in times:
                for method in methods:
                    number += 1
                    before = last.get((method, seed))
                    if before is not None and before.iterations == 1 and before.seconds >= limit:
                        continue  # one iteration has outlasted this limit already: it would be the same picture
                    film = self._render(method, limit, seed, f"{method}, {limit:g} s ({number}/{total})")
                    x, r = film.radiance(), reference.picture
                    error = relative_mse(x, r, reference_error=reference.standard_error, scale=reference.scale)
                    measured = Run(method, limit, seed, film.seconds, film.iterations, error, mean_ratio(x, r))
                    last[method, seed] = measured
                    yield measured

    def _render(self, method: str, seconds: float | None, seed: int, label: str) -> Any:
        """A film by one method in some seconds; None: one small iteration.

        Raises:
            _Stopped: A signal arrived.
        """
        choices = {"estimator": "vpl", "filter": True, "denoise": False, **METHODS[method], "seed": seed}
        if seconds is None:
            choices |= {"iterations": 1, "light_paths": _WARM_UP_PATHS}
        settings = replace(self.settings, time_limit=seconds, **choices)
        with ProgressDisplay(label, quiet=self.args.quiet) as display:
            film = ir.Renderer(self.scene, settings, device=self.device).render(progress=display)
        if film.interrupted:
            raise _Stopped(film.interrupted)
        return film


def _methods(args: argparse.Namespace) -> list[str]:
    """The names of what is compared: those given, or all that are there."""
    if args.methods is not None:
        if not args.methods:
            raise InputError(f"--methods: names none; there are {', '.join(METHODS)}")
        if any(METHODS[name].get("denoise") for name in args.methods):
            require_denoiser()
        return list(dict.fromkeys(args.methods))
    names = list(METHODS)
    try:
        require_denoiser()
    except InputError:
        names = [name for name in names if not METHODS[name].get("denoise")]
    return names


def _medians(runs: Sequence[Run]) -> list[Run]:
    """One row for each method and time, methods together: the medians over the seeds."""
    groups: dict[tuple[str, float], list[Run]] = {}
    for run in runs:
        groups.setdefault((run.method, run.time_limit), []).append(run)
    rows = []
    for method, limit in sorted(groups, key=lambda key: (list(METHODS).index(key[0]), key[1])):
        alike = groups[method, limit]
        middle = {
            name: statistics.median(getattr(run, name) for run in alike)
            for name in ("seconds", "iterations", "error", "mean_ratio")
        }
        rows.append(Run(method, limit, None, **middle))
    return rows


def judge(rows: Sequence[Run], resolution: float) -> Verdict:
    """The method with the smallest error in the longest time, and how long it takes to the usual targets.

    Args:
        rows: One for each method and time.
        resolution: Errors below this count as this.
    """
    curves: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        curves.setdefault(row.method, []).append((row.seconds, max(row.error, resolution)))
    longest = max(row.time_limit for row in rows)
    ends = {}
    for method, curve in curves.items():
        # A picture that took longer (or, stopped early, shorter) than the rest is judged by what it promises.
        (seconds, error), power = curve[-1], _power(curve)
        ends[method] = error * (seconds / longest) ** power
    least = min(ends.values())
    level = [method for method, error in ends.items() if error <= _LEVEL * least]
    best = level[0]
    return Verdict(
        best,
        flags_of(METHODS[best]),
        {target: seconds_to(target, curves[best], resolution) for target in _TARGETS},
        level[1:],
    )


def seconds_to(
    target: float, curve: Sequence[tuple[float, float]], resolution: float = 0.0
) -> tuple[float, bool] | None:
    """Seconds until the error is `target`, and whether that lies within what was measured; None: too far to tell.

    Args:
        target: relMSE.
        curve: Seconds and relMSE, by increasing time.
        resolution: Errors of this size may be smaller; nothing is extrapolated from them.
    """
    for k, (seconds, error) in enumerate(curve):
        if error <= target:
            if k == 0:
                return seconds, True
            earlier, worse = curve[k - 1]
            share = math.log(worse / target) / math.log(worse / error)
            return earlier * (seconds / earlier) ** share, True
    seconds, error = curve[-1]
    power = _power([point for point in curve if point[1] > resolution])
    if math.log(error / target) > power * math.log(_FARTHEST):
        return None
    return seconds * (error / target) ** (1.0 / power), False


def _power(curve: Sequence[tuple[float, float]]) -> float:
    """The p of error ∝ time⁻ᵖ: the line through the logarithms, between 0 and the 1 of independent iterations."""
    x, y = [math.log(t) for t, _ in curve], [math.log(e) for _, e in curve]
    if len(curve) < 2 or max(x) - min(x) < 0.1:
        return 1.0
    return min(max(-statistics.linear_regression(x, y).slope, 0.0), 1.0)


def flags_of(choices: Mapping[str, Any]) -> str:
    """The flags of `warp-ir render` for a method; empty for the defaults."""
    flags = {"filter": "--no-filter", "denoise": "--denoise"}
    return " ".join(flags[name] if name in flags else f"--{name} {value}" for name, value in choices.items())


def in_words(verdict: Verdict, longest: float) -> str:
    """The recommendation, one line."""
    how = f" ({verdict.flags})" if verdict.flags else " (the default)"
    parts = [f"use {verdict.method}{how}: the smallest error at {longest:g} s"]
    if verdict.level:
        parts.append(f"level with {' and '.join(verdict.level)}")
    for target, found in verdict.seconds.items():
        if found is None:
            parts.append(f"relMSE {target:g} is too far away: longer --times would tell")
        else:
            parts.append(f"relMSE {target:g} {'within' if found[1] else 'in about'} {_duration(found[0])}")
    return "; ".join(parts)


def _duration(seconds: float) -> str:
    if seconds < 99.5:
        return f"{seconds:.2g} s"
    return f"{seconds / 60.0:.2g} min" if seconds < 5970.0 else f"{seconds / 3600.0:.2g} h"


def _print_table(rows: Sequence[Run], reference: Reference) -> None:
    """The reference in a line and a row for each method and time, on stdout."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    table = Table(box=box.SIMPLE_HEAD if console.is_terminal else None, pad_edge=False)
    table.add_column("method", no_wrap=True)
    for name in ("seconds", "iterations", "relMSE", "mean ratio"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        resolved = row.error > reference.resolution
        table.add_row(
            row.method,
            f"{row.seconds:.3g}",
            f"{row.iterations:g}",
            f"{row.error:.2g}" if resolved else f"< {reference.resolution:.2g}",
            f"{100.0 * row.mean_ratio:+.2f} %",
        )
    print(
        f"reference: path, {reference.iterations} iterations in {reference.seconds:.3g} s;"
        f" its own relMSE, {reference.floor:.2g}, is subtracted",
        flush=True,
    )
    console.print(table)


def _warn_of_floor(rows: Sequence[Run], reference: Reference) -> None:
    """Says so if the reference is noisier than what it judges."""
    least = max(min(row.error for row in rows), reference.resolution)
    if reference.floor > least:
        seconds = math.ceil(reference.seconds * reference.floor / least)
        say(
            f"warning: the reference's own error is above the smallest measured, which is uncertain;"
            f" --reference-time {seconds} would tell"
        )


def _require_matplotlib() -> None:
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError as error:
        raise InputError("OUTPUT: Matplotlib is not installed: pip install 'warp-ir[bench]'") from error


def _plot(rows: Sequence[Run], reference: Reference, title: str, path: Path) -> None:
    """Error against seconds on logarithmic axes, a curve for each method; what the reference cannot resolve is grey."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    figure = Figure(figsize=(7.0, 5.0), layout="constrained")
    axes = figure.add_subplot()
    for method in dict.fromkeys(row.method for row in rows):
        curve = [row for row in rows if row.method == method]
        errors = [max(row.error, reference.resolution) for row in curve]
        color = f"C{list(METHODS).index(method)}"
        axes.plot([row.seconds for row in curve], errors, "o-", color=color, label=method, ms=4)
    axes.axhline(reference.floor, color="0.6", ls=":", label="the reference's own error")
    axes.set(xscale="log", yscale="log", title=title, xlabel="seconds", ylabel="relMSE")
    shown = axes.get_ylim()
    axes.axhspan(1e-3 * reference.resolution, reference.resolution, color="0.92", zorder=0)
    axes.set_ylim(shown)
    limits = sorted({row.time_limit for row in rows})
    axes.set_xticks(limits, [f"{limit:g}" for limit in limits])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(color="0.9")
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(path, dpi=120)


def _write_json(
    path: Path, job: _Job, reference: Reference, runs: Sequence[Run], rows: Sequence[Run], verdict: Verdict, code: int
) -> None:
    """All numbers; those that are not finite are null."""
    facts = {
        "stage": str(job.args.stage),
        "camera": job.scene.camera.name,
        "width": job.size[0],
        "height": job.size[1],
        "device": job.device,
        "version": ir.__version__,
        "reference": {
            "seconds": reference.seconds,
            "iterations": reference.iterations,
            "seed": reference.seed,
            "floor": reference.floor,
        },
        "runs": [_finite(asdict(run)) for run in runs],
        "medians": [_finite(asdict(row)) for row in rows],
        "recommended": {
            "method": verdict.method,
            "flags": verdict.flags,
            "level": verdict.level,
            "seconds": [
                {"relative_mse": target, "seconds": found and found[0], "measured": found and found[1]}
                for target, found in verdict.seconds.items()
            ],
        },
        "interrupted": bool(code),
    }
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")


def _finite(row: dict[str, Any]) -> dict[str, Any]:
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value for name, value in row.items()
    }
