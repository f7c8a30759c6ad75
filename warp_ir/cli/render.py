"""`warp-ir render`: stage in, picture out."""

import argparse
import json
import math
import os
import platform
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import warp_ir as ir
from warp_ir.cli.arguments import settings_of
from warp_ir.cli.checkpoint import Checkpoint, fingerprint, path_of
from warp_ir.cli.console import ProgressDisplay, say, say_warnings
from warp_ir.cli.device_choice import open_device
from warp_ir.cli.frames import Moment, outputs_of, time_codes
from warp_ir.cli.import_guard import importing
from warp_ir.cli.stage_options import moment_of, open_reader
from warp_ir.image.io import SUFFIXES, check_output, whole_file, write_image
from warp_ir.image.tonemap import suggest_exposure
from warp_ir.scene import InputError


@dataclass(frozen=True)
class _Picture:
    """One render, and the files that are written of it."""

    when: Moment
    product: Any
    """The `Product` of the stage whose camera and settings count; None: the first."""
    files: Mapping[Path, tuple[str, ...] | None]
    """The AOVs of each; None: those of the product."""


@dataclass
class _Job:
    """What all pictures share."""

    args: argparse.Namespace
    device: str
    versions: Mapping[str, str]
    reader: Any
    renderer: Any = None
    before: Any = None
    """The scene of the picture before."""
    warned: set[str] = field(default_factory=set)


def run(args: argparse.Namespace) -> int:
    """Renders the stage's picture, or one for each of the frames; the exit code."""
    begin = time.perf_counter()
    # Everything that can be wrong with the command line is found before anything is loaded.
    settings_of(args)
    pictures = []
    into_folder = args.output.endswith(("/", os.sep)) or os.path.isdir(args.output)
    if not into_folder:
        outputs = outputs_of(args.output, args.frames, moment_of(args))
        pictures = [_Picture(when, None, {path: None}) for when, path in outputs.items()]
        for path in outputs.values():
            check_output(path, make_folder=args.make_output_path)
    if args.stats:
        check_output(args.stats, (".json",), make_folder=args.make_output_path)
    device = open_device(args.device, verbose=args.verbose)
    with importing():
        _ = ir.load_usd, ir.Renderer  # imported here, so that their time is not the first frame's
    versions = _versions()
    imported = time.perf_counter() - begin
    with ProgressDisplay("opening", quiet=args.quiet):
        reader = open_reader(args)
    opened = time.perf_counter() - begin - imported
    job = _Job(args, device, versions, reader)
    if into_folder:
        pictures = _products(job)

    frames: list[dict[str, Any]] = []
    code = 0
    for number, picture in enumerate(pictures, start=1):
        path = next(iter(picture.files))
        if args.resume and all(file.exists() for file in picture.files) and not path_of(path).exists():
            say(f"{path}: is there already")
            continue
        label = path.name if len(pictures) == 1 else f"{path.name} ({number}/{len(pictures)})"
        record, code = _render_picture(job, picture, label)
        if not frames:
            record["timings"]["load"] += opened
        frames.append(record)
        if code:
            break
    if args.stats:
        _write_stats(Path(args.stats), job, imported, frames)
    return code


def _products(job: _Job) -> list[_Picture]:
    """The pictures that the stage's products ask for, in the user's folder; those that differ in name alone are one."""
    args, pictures, taken = job.args, [], set()
    folder = Path(args.output)
    codes: list[Moment] = list(time_codes(args.frames)) if args.frames else [moment_of(args)]
    for when in codes:
        groups: list[tuple[Any, dict[Path, tuple[str, ...] | None]]] = []
        for product in job.reader.spec(when).products:
            if not product.path:
                raise InputError(
                    f"{folder}: is a folder, and {args.stage} has no RenderProducts; name the file to write"
                )
            name = Path(product.name)
            if name.suffix.lower() not in SUFFIXES:
                say(f"warning: {product.path}: pictures of kind {name.suffix!r} are not written; .exr is")
                name = name.with_suffix(".exr")
            if args.frames and "#" not in str(name) and folder / name in taken:
                name = name.with_name(f"{name.stem}.####{name.suffix}")
            if args.frames and "#" in str(name):
                assert isinstance(when, float)
                name = outputs_of(str(name), f"{when:g}", None)[when]
            path = check_output(folder / name, make_folder=args.make_output_path)
            if path in taken:
                raise InputError(f"{product.path}: another picture is called {name} as well")
            taken.add(path)
            alike = (g for g in groups if (g[0].camera, g[0].settings) == (product.camera, product.settings))
            group = next(alike, None)
            if group is None:
                group = (product, {})
                groups.append(group)
            group[1][path] = product.aovs
        pictures += [_Picture(when, product, files) for product, files in groups]
    return pictures


def _render_picture(job: _Job, picture: _Picture, label: str) -> tuple[dict[str, Any], int]:
    """Loads, renders and writes one picture; its statistics and the exit code."""
    args = job.args
    path = next(iter(picture.files))
    with ProgressDisplay(label, quiet=args.quiet) as display:
        begin = time.perf_counter()
        scene = job.reader.read(picture.when, picture.product)
        loaded = time.perf_counter() - begin
        kept = {name: _kept(getattr(job.before, name, ()), getattr(scene, name)) for name in ("meshes", "lights")}
        job.before = scene
        if not args.quiet:
            say_warnings((w for w in scene.warnings if w not in job.warned), everything=args.verbose)
            job.warned.update(scene.warnings)
        settings = settings_of(args, scene.settings)
        if job.renderer is not None and job.renderer.wanted == settings:
            job.renderer.update(scene)
        else:
            job.renderer = ir.Renderer(scene, settings, device=job.device)
        renderer, film = job.renderer, job.renderer.new_film()
        checkpoint = Checkpoint(path, film, lambda: fingerprint(scene, renderer.settings), args.checkpoint)
        if args.resume and checkpoint.resume():
            say(f"{path}: goes on after {film.iterations} iterations")

        def progress(report: Any) -> None:
            display(report)
            if report.fraction < 1.0:
                checkpoint.maybe()

        renderer.render(film, progress)
    timings = {**film.timings, "load": loaded}
    # The renderer tells which signal stopped it; a mere True stands for Ctrl-C.
    stopped = int(film.interrupted)
    code = 128 + (stopped if stopped > 1 else signal.SIGINT) if stopped else 0
    written: list[Path] = []
    if film.iterations or not stopped:
        begin = time.perf_counter()
        facts = {**job.versions, "stage": str(args.stage), "camera": scene.camera.name, "device": job.device}
        for file, aovs in picture.files.items():
            written += write_image(
                file,
                film,
                aovs=_aovs(args, job.reader.spec(picture.when).products[0].aovs if aovs is None else aovs, file),
                exposure=args.exposure,
                tonemap=args.tonemap,
                half=args.half,
                metadata=facts if picture.when is None else {**facts, "frame": picture.when},
            )
        timings["write"] = time.perf_counter() - begin
    if not stopped:
        checkpoint.remove()
    elif args.checkpoint > 0.0 and checkpoint.write():
        say(f"{checkpoint.path}: from here --resume goes on")
    unseen = _unseen(scene, film)
    if unseen and not args.quiet:
        say_warnings(unseen)
    _summarize(job, path, film, bool(written))
    record = {
        "output": [str(file) for file in written],
        "frame": picture.when,
        "camera": scene.camera.name,
        "width": film.width,
        "height": film.height,
        "iterations": film.iterations,
        "seconds": film.seconds,
        "error": film.error(),
        "rejected": film.rejected,
        "interrupted": bool(stopped),
        "timings": timings,
        "settings": renderer.settings.to_dict(),
        "loaded": dict(scene.stats),
        "kept": kept,
        "counts": dict(film.counts),
        "warnings": [*scene.warnings, *unseen],
    }
    return record, code


def _unseen(scene: Any, film: Any) -> list[str]:
    """The warning that a picture shows no geometry, where nothing has said so before."""
    said = any("all geometry" in line or "draws no geometry" in line for line in scene.warnings)
    if said or not film.iterations or film.aov("alpha").max() > 0.0:
        return []
    return [f"{scene.camera.name}: the camera sees no geometry"]


def _kept(before: Sequence[Any], now: Sequence[Any]) -> int:
    """How many of the records are those of the picture before."""
    there = {id(item) for item in before}
    return sum(id(item) in there for item in now)


def _aovs(args: argparse.Namespace, wanted: Sequence[str], path: Path) -> tuple[str, ...]:
    """The AOVs to write: the user's, else the stage's if the format has layers for them."""
    if args.aovs or path.suffix.lower() != ".exr":
        return tuple(dict.fromkeys(args.aovs))
    return tuple(name for name in wanted if name != "alpha")  # which every .exr has


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
        "versions": dict(job.versions),
        "peak_memory_bytes": _peak_memory(),
    }
    if job.args.frames is None and len(frames) == 1:
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
