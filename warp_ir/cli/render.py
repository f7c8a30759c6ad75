"""`warp-ir render`: stage in, picture out."""

import argparse
import json
import math
import platform
import signal
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import warp_ir as ir
from warp_ir.cli.arguments import settings_of
from warp_ir.cli.console import ProgressDisplay, say, say_warnings
from warp_ir.cli.device import open_device
from warp_ir.cli.frames import outputs_of
from warp_ir.cli.stage import load_scene
from warp_ir.image import check_output, whole_file, write_image
from warp_ir.settings import RenderSettings
from warp_ir.tonemap import suggest_exposure


@dataclass(frozen=True)
class _Job:
    """What all frames share."""

    args: argparse.Namespace
    settings: RenderSettings
    device: str
    versions: Mapping[str, str]


def run(args: argparse.Namespace) -> int:
    """Renders the stage's picture, or one for each of the frames; the exit code."""
    begin = time.perf_counter()
    settings = settings_of(args)
    outputs = outputs_of(args.output, args.frames, args.time)
    # Everything that can be wrong with the command line is found before anything is loaded.
    for path in outputs.values():
        check_output(path, make_folder=args.make_output_path)
    if args.stats:
        check_output(args.stats, (".json",), make_folder=args.make_output_path)
    device = open_device(args.device, verbose=args.verbose)
    _ = ir.load_usd, ir.render  # imported here, so that their time is not the first frame's
    job = _Job(args, settings, device, _versions())
    imported = time.perf_counter() - begin

    frames: list[dict[str, Any]] = []
    warned: set[str] = set()
    code = 0
    for number, (when, path) in enumerate(outputs.items(), start=1):
        label = path.name if len(outputs) == 1 else f"{path.name} ({number}/{len(outputs)})"
        record, code = _render_frame(job, when, path, label, warned)
        frames.append(record)
        if code:
            break
    if args.stats:
        _write_stats(Path(args.stats), job, imported, frames)
    return code


def _render_frame(
    job: _Job, when: float | None, path: Path, label: str, warned: set[str]
) -> tuple[dict[str, Any], int]:
    """Loads, renders and writes one picture; its statistics and the exit code."""
    args = job.args
    with ProgressDisplay(label, quiet=args.quiet) as display:
        begin = time.perf_counter()
        scene = load_scene(args, when)
        loaded = time.perf_counter() - begin
        if not args.quiet:
            say_warnings((w for w in scene.warnings if w not in warned), everything=args.verbose)
            warned.update(scene.warnings)
        film = ir.render(scene, job.settings, device=job.device, progress=display)
    timings = {**film.timings, "load": loaded}
    # The renderer tells which signal stopped it; a mere True stands for Ctrl-C.
    stopped = int(film.interrupted)
    code = 128 + (stopped if stopped > 1 else signal.SIGINT) if stopped else 0
    written: list[Path] = []
    if film.iterations or not stopped:
        begin = time.perf_counter()
        facts = {**job.versions, "stage": str(args.stage), "camera": scene.camera.name, "device": job.device}
        written = write_image(
            path,
            film,
            aovs=tuple(dict.fromkeys(args.aovs)),
            exposure=args.exposure,
            tonemap=args.tonemap,
            half=args.half,
            metadata=facts if when is None else {**facts, "frame": when},
        )
        timings["write"] = time.perf_counter() - begin
    _summarize(job, path, film, bool(written))
    record = {
        "output": [str(file) for file in written],
        "frame": when,
        "camera": scene.camera.name,
        "width": film.width,
        "height": film.height,
        "iterations": film.iterations,
        "seconds": film.seconds,
        "error": film.error(),
        "rejected": film.rejected,
        "interrupted": bool(stopped),
        "timings": timings,
        "loaded": dict(scene.stats),
        "counts": dict(film.counts),
        "warnings": list(scene.warnings),
    }
    return record, code


def _summarize(job: _Job, path: Path, film: Any, written: bool) -> None:
    """The line at the end, and what the user should know of the picture."""
    if film.interrupted:
        say("interrupted" if written else "interrupted before the first iteration: nothing written")
    if not written or job.args.quiet:
        return
    error = film.error()
    estimate = f", estimated error {100.0 * error:.2g} %" if math.isfinite(error) else ""
    print(
        f"{path}: {film.width} x {film.height}, {film.iterations} iterations in {film.seconds:.2f} s"
        f" on {job.device}{estimate}",
        flush=True,
    )
    if film.rejected:
        say(f"warning: {film.rejected} non-finite samples were replaced")
    if path.suffix.lower() in (".png", ".jpg", ".jpeg"):
        stops = suggest_exposure(film.radiance(), job.args.exposure)
        if stops is not None:
            what = "dark" if stops > job.args.exposure else "bright"
            say(f"hint: the picture is very {what}; --exposure {stops:g} would show it properly")


def _write_stats(path: Path, job: _Job, imported: float, frames: list[dict[str, Any]]) -> None:
    """All numbers of the run as JSON; those of a single picture are not in a list."""
    shared: dict[str, Any] = {
        "stage": str(job.args.stage),
        "device": job.device,
        "settings": job.settings.to_dict(),
        "versions": dict(job.versions),
        "peak_memory_bytes": _peak_memory(),
    }
    if job.args.frames is None:
        frame = dict(frames[0])
        frame["timings"] = {"import": imported, **frame["timings"]}
        shared |= frame
    else:
        shared |= {"timings": {"import": imported}, "frames": frames}
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(_plain(shared), indent=2) + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    """The value in JSON's terms: NumPy numbers as Python's, and null for what is not finite."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    value = value.item() if hasattr(value, "item") else value
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _versions() -> dict[str, str]:
    """Versions of what decides the pixels."""
    import numpy as np
    import warp as wp
    from pxr import Usd

    return {
        "warp_ir": ir.__version__,
        "warp": wp.__version__,
        "usd": ".".join(str(part) for part in Usd.GetVersion()),
        "numpy": np.__version__,
        "python": platform.python_version(),
    }


def _peak_memory() -> int | None:
    """Most memory the process has held [bytes], where the system tells."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak
