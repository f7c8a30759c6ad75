"""`warp-ir compare`: error against time of each method on the user's own scene, with a reference by `path`.

The reference is a long render by `path`, which shares no light transport code with the other methods. Its own relative
mean squared error, known from its standard error, is the floor: it is subtracted from the measured errors, and errors
far below it cannot be distinguished. Errors are relative to another, smooth picture that does not share the noise of
the reference: a pixel of the reference that is too dark by chance would otherwise give its own noise a large weight.
"""

import argparse
import json
import logging
import math
import signal
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import warp_ir as ir
from warp_ir.cli.arguments import METHODS, settings_of
from warp_ir.cli.console import ProgressDisplay, say, say_warnings, show_result, warn
from warp_ir.cli.device_choice import open_device
from warp_ir.cli.stage_options import open_reader, time_code_of
from warp_ir.files import check_output, whole_file
from warp_ir.metrics import mean_ratio, relative_mse
from warp_ir.scene import Floats, InputError, Scene

if TYPE_CHECKING:
    from warp_ir.film import Film

_RESOLUTION = 0.05
"""Errors below this share of the floor cannot be distinguished, and count as this share."""
_TIE = 1.1
"""Methods whose errors differ by less than this factor are tied."""
_TARGETS = (0.01, 0.001)
"""relMSE for which the recommendation gives the render time: a little noise, and no visible noise."""
_MAX_EXTRAPOLATION = 50.0
"""Times are extrapolated to at most this multiple of the longest render: the measured slopes are noisy."""
_WARM_UP_PATHS = 16
"""Light paths of the iteration that compiles the kernels of a method before its time is measured."""


@dataclass(frozen=True)
class Reference:
    """The picture that all others are compared with."""

    picture: Floats
    """Linear radiance, [height, width, 3]."""
    standard_error: Floats
    """Standard error of `picture`, same shape."""
    scale: Floats
    """A smooth picture without the noise of `picture`, same shape: errors are relative to it."""
    floor: float
    """Relative mean squared error of `picture` itself."""
    seconds: float
    iterations: int
    seed: int

    @property
    def resolution(self) -> float:
        """The smallest relMSE that can be distinguished from 0."""
        return max(_RESOLUTION * self.floor, 1e-12)


@dataclass(frozen=True)
class Run:
    """Measurements of one picture, or their medians over pictures that differ only in the seed."""

    method: str
    time_limit: float
    seed: int | None
    seconds: float
    iterations: float
    error: float
    """relMSE minus the floor; it can be negative."""
    mean_ratio: float


@dataclass(frozen=True)
class Recommendation:
    """The best method, and how long it takes."""

    method: str
    flags: str
    """Flags of `warp-ir render` that select the method."""
    seconds: dict[float, tuple[float, bool] | None]
    """relMSE -> seconds, and whether they were measured (else extrapolated); None: too far to extrapolate."""
    ties: list[str]
    """Other methods with about the same error."""


def run(args: argparse.Namespace) -> int:
    """Renders the reference, then every method for every time limit; returns the exit code."""
    from warp_ir.cli import Terminated

    settings_of(args)
    picture = check_output(args.output, (".png",), make_folder=args.make_output_path) if args.output else None
    if picture is not None:
        _require_matplotlib()
    numbers = check_output(args.json, (".json",), make_folder=args.make_output_path) if args.json else None
    methods = _methods(args)
    device = open_device(args.device, verbose=args.verbose)
    reader = open_reader(args)
    scene = reader.read(time_code_of(args))
    say_warnings(scene.warnings, everything=args.verbose)
    job = _Comparison(args, scene, device)
    runs: list[Run] = []
    code, reference = 0, None
    try:
        reference = job.reference()
        for measured in job.runs(methods, reference):
            runs.append(measured)
    except _Stopped as stop:
        code = stop.code
    except KeyboardInterrupt:  # between two renders
        code = 128 + signal.SIGINT
    except Terminated:
        code = 128 + signal.SIGTERM
    if reference is None or not runs:
        say("interrupted before the first picture could be compared: there is no result", logging.ERROR)
        return code
    rows = _medians(runs)
    recommendation = recommend(rows, reference.resolution)
    _print_table(rows, reference)
    if code:
        say("interrupted: the table holds what has been measured", logging.ERROR)
    _warn_of_floor(rows, reference)
    if args.methods is None and len(methods) < len(METHODS):
        say("vpl denoised is left out: Open Image Denoise is not installed: pip install 'warp-ir[denoise]'")
    show_result(recommendation_text(recommendation, max(row.time_limit for row in rows)), quiet=False)
    title = f"{Path(args.stage).name}, {job.size[0]} x {job.size[1]}, on {device}"
    if picture is not None:
        with whole_file(picture) as temporary:
            _plot(rows, reference, title, temporary)
    if numbers is not None:
        _write_json(numbers, job, reference, runs, rows, recommendation, code)
    return code


class _Stopped(BaseException):
    """A signal ended a render and with it the comparison; the measurements so far are reported."""

    def __init__(self, number: int) -> None:
        # `Film.interrupted` is the number of the signal.
        self.code = 128 + number


class _Comparison:
    """The scene and the settings with which its pictures are rendered."""

    def __init__(self, args: argparse.Namespace, scene: Scene, device: str) -> None:
        self.args, self.scene, self.device = args, scene, device
        # The comparison sets the limits and the method itself, whatever the stage asks for.
        self.settings = replace(settings_of(args, scene.settings), iterations=None, target_error=None)
        self.size = (0, 0)

    def reference(self) -> Reference:
        """Renders the reference by `path`, with a seed that no other render uses.

        Raises:
            InputError: The time is too short for two iterations, or the picture is black.
        """
        seconds = self.args.reference_time or 10.0 * max(self.args.times)
        seed = (self.settings.seed + self.args.seeds) % (1 << 32)
        film = self._render("path", seconds, seed, "reference")
        if film.iterations < 2:
            raise InputError(
                f"--reference-time: one iteration of path takes {film.seconds:.3g} s,"
                f" so two do not fit in {seconds:g} s"
            )
        self.size = (film.width, film.height)
        picture, error = film.radiance(), film.standard_error()
        if not picture.mean() > 0.0:
            raise InputError(f"{self.args.stage}: the picture is black; no error is relative to it")
        # The weights must not depend on the noise of the reference. They need not be exact: any smooth picture serves.
        scale = self._render("vpl", max(self.args.times), seed, "smooth picture").radiance()
        floor = -relative_mse(picture, picture, reference_error=error, scale=scale)
        return Reference(picture, error, scale, floor, film.seconds, film.iterations, seed)

    def runs(self, methods: Sequence[str], reference: Reference) -> Iterator[Run]:
        """Renders and measures every seed, time limit and method, with the methods in the innermost loop."""
        times, seeds = self.args.times, self.args.seeds
        total, number = seeds * len(times) * len(methods), 0
        for method in methods:  # compiles and loads before time is measured
            self._render(method, None, self.settings.seed, f"{method}, warming up")
        last: dict[tuple[str, int], Run] = {}
        for seed in ((self.settings.seed + k) % (1 << 32) for k in range(seeds)):
            for limit in times:
                for method in methods:
                    number += 1
                    previous = last.get((method, seed))
                    if previous is not None and previous.iterations == 1 and previous.seconds >= limit:
                        continue  # one iteration already took longer than this limit: the picture would be the same
                    film = self._render(method, limit, seed, f"{method}, {limit:g} s ({number}/{total})")
                    x, r = film.radiance(), reference.picture
                    error = relative_mse(x, r, reference_error=reference.standard_error, scale=reference.scale)
                    measured = Run(method, limit, seed, film.seconds, film.iterations, error, mean_ratio(x, r))
                    last[method, seed] = measured
                    yield measured

    def _render(self, method: str, seconds: float | None, seed: int, label: str) -> "Film":
        """Renders a film by one method within a time limit [s]; None: one iteration of few light paths.

        Raises:
            _Stopped: A signal arrived.
        """
        choices: dict[str, Any] = {
            "estimator": "vpl",
            "filter": True,
            "denoise": False,
            **METHODS[method],
            "seed": seed,
        }
        if seconds is None:
            choices |= {"iterations": 1, "light_paths": _WARM_UP_PATHS}
        settings = replace(self.settings, time_limit=seconds, **choices)
        with ProgressDisplay(label, quiet=self.args.quiet) as display:
            film: Film = ir.Renderer(self.scene, settings, device=self.device).render(progress=display)
        if film.interrupted:
            raise _Stopped(film.interrupted)
        return film


def _methods(args: argparse.Namespace) -> list[str]:
    """The names of the methods to compare: those given, or all that are installed.

    Raises:
        InputError: No method is given, or the denoiser of a given one is not installed.
    """
    from warp_ir.film.denoise import require_denoiser  # imports Warp

    if args.methods is not None:
        if not args.methods:
            raise InputError(f"--methods: names no method; known are {', '.join(METHODS)}")
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
    """The medians over the seeds, one row for each method and time limit, sorted by method."""
    groups: dict[tuple[str, float], list[Run]] = {}
    for run in runs:
        groups.setdefault((run.method, run.time_limit), []).append(run)
    rows = []
    for method, limit in sorted(groups, key=lambda key: (list(METHODS).index(key[0]), key[1])):
        group = groups[method, limit]
        medians = {
            name: statistics.median(getattr(run, name) for run in group)
            for name in ("seconds", "iterations", "error", "mean_ratio")
        }
        rows.append(Run(method, limit, None, **medians))
    return rows


def recommend(rows: Sequence[Run], resolution: float) -> Recommendation:
    """Finds the method with the smallest error at the longest time limit, and its times to the usual targets.

    Args:
        rows: One row for each method and time limit.
        resolution: Smallest relMSE that can be distinguished from 0; smaller errors count as this.
    """
    curves: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        curves.setdefault(row.method, []).append((row.seconds, max(row.error, resolution)))
    longest = max(row.time_limit for row in rows)
    errors = {}
    for method, curve in curves.items():
        # A render may take longer than its limit, or less if it is stopped: its error is extrapolated to the limit.
        (seconds, error), power = curve[-1], _power(curve)
        errors[method] = error * (seconds / longest) ** power
    smallest = min(errors.values())
    ties = [method for method, error in errors.items() if error <= _TIE * smallest]
    best = ties[0]
    return Recommendation(
        best,
        flags_of(METHODS[best]),
        {target: seconds_to(target, curves[best], resolution) for target in _TARGETS},
        ties[1:],
    )


def seconds_to(
    target: float, curve: Sequence[tuple[float, float]], resolution: float = 0.0
) -> tuple[float, bool] | None:
    """Seconds until the error is `target`, and whether they are measured or extrapolated; None: too far away.

    Args:
        target: Target relMSE.
        curve: Pairs of seconds and relMSE, by increasing time.
        resolution: Points of this relMSE or less are not used for extrapolation: their true error may be smaller.
    """
    for k, (seconds, error) in enumerate(curve):
        if error <= target:
            if k == 0:
                return seconds, True
            previous_seconds, previous_error = curve[k - 1]
            share = math.log(previous_error / target) / math.log(previous_error / error)
            return previous_seconds * (seconds / previous_seconds) ** share, True
    seconds, error = curve[-1]
    power = _power([point for point in curve if point[1] > resolution])
    if math.log(error / target) > power * math.log(_MAX_EXTRAPOLATION):
        return None
    return seconds * (error / target) ** (1.0 / power), False


def _power(curve: Sequence[tuple[float, float]]) -> float:
    """The exponent p of error ∝ time⁻ᵖ by linear regression of the logarithms.

    It is clamped to [0, 1]; 1 is the rate of independent iterations.
    """
    x, y = [math.log(t) for t, _ in curve], [math.log(e) for _, e in curve]
    if len(curve) < 2 or max(x) - min(x) < 0.1:
        return 1.0
    return min(max(-statistics.linear_regression(x, y).slope, 0.0), 1.0)


def flags_of(choices: Mapping[str, str | bool]) -> str:
    """The flags of `warp-ir render` for the settings of a method; empty for the defaults."""
    flags = {"filter": "--no-filter", "denoise": "--denoise"}
    return " ".join(flags[name] if name in flags else f"--{name} {value}" for name, value in choices.items())


def recommendation_text(recommendation: Recommendation, longest: float) -> str:
    """The recommendation as one line; `longest` is the longest time limit [s]."""
    flags = f" ({recommendation.flags})" if recommendation.flags else " (the default)"
    parts = [f"use {recommendation.method}{flags}: the smallest error at {longest:g} s"]
    if recommendation.ties:
        parts.append(f"tied with {' and '.join(recommendation.ties)}")
    for target, time in recommendation.seconds.items():
        if time is None:
            parts.append(f"relMSE {target:g} is too far to extrapolate: use longer --times")
        else:
            seconds, measured = time
            parts.append(f"relMSE {target:g} {'within' if measured else 'in about'} {_duration(seconds)}")
    return "; ".join(parts)


def _duration(seconds: float) -> str:
    if seconds < 99.5:
        return f"{seconds:.2g} s"
    return f"{seconds / 60.0:.2g} min" if seconds < 5970.0 else f"{seconds / 3600.0:.2g} h"


def _print_table(rows: Sequence[Run], reference: Reference) -> None:
    """Prints a line about the reference and a table row for each method and time limit, on stdout."""
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
    """Warns if the error of the reference exceeds the smallest measured error."""
    smallest = max(min(row.error for row in rows), reference.resolution)
    if reference.floor > smallest:
        seconds = math.ceil(reference.seconds * reference.floor / smallest)
        warn(
            f"the reference's own error exceeds the smallest measured error, which is therefore uncertain;"
            f" use --reference-time {seconds}"
        )


def _require_matplotlib() -> None:
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError as error:
        raise InputError("OUTPUT: Matplotlib is not installed: pip install 'warp-ir[bench]'") from error


def _plot(rows: Sequence[Run], reference: Reference, title: str, path: Path) -> None:
    """Plots error against seconds on logarithmic axes, one curve for each method, the unresolved range grey."""
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
    error_limits = axes.get_ylim()
    axes.axhspan(1e-3 * reference.resolution, reference.resolution, color="0.92", zorder=0)
    axes.set_ylim(error_limits)
    limits = sorted({row.time_limit for row in rows})
    axes.set_xticks(limits, [f"{limit:g}" for limit in limits])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(color="0.9")
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(path, dpi=120)


def _write_json(
    path: Path,
    job: _Comparison,
    reference: Reference,
    runs: Sequence[Run],
    rows: Sequence[Run],
    recommendation: Recommendation,
    code: int,
) -> None:
    """Writes all numbers as JSON; numbers that are not finite are null."""
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
            "method": recommendation.method,
            "flags": recommendation.flags,
            "level": recommendation.ties,
            "seconds": [
                {"relative_mse": target, "seconds": time and time[0], "measured": time and time[1]}
                for target, time in recommendation.seconds.items()
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
