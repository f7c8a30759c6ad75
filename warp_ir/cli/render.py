"""`warp-ir render`: renders a stage to one picture or to several."""

import argparse
import json
import logging
import math
import os
import platform
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import warp_ir as ir
from warp_ir.cli.arguments import settings_of
from warp_ir.cli.checkpoint import Checkpoint, checkpoint_path, fingerprint, not_resumed
from warp_ir.cli.console import ProgressDisplay, describe_progress, say, say_warnings, show_result, warn
from warp_ir.cli.device_choice import open_device
from warp_ir.cli.engine_flags import as_cluster, check_engine, device_of, open_executor, stage_source
from warp_ir.cli.frames import TimeCode, outputs_of, time_codes
from warp_ir.cli.import_guard import importing
from warp_ir.cli.parts import Part, PartFilm, note_of, part_of, read_film
from warp_ir.cli.stage_options import frames_per_second, open_reader, time_code_of
from warp_ir.files import check_output, whole_file
from warp_ir.image.exr import COMPRESSIONS, LOSSY, ExrOptions
from warp_ir.image.io import DISPLAYED, SUFFIXES, aov_path, can_hold_key, read_image, read_key, write_image
from warp_ir.image.ocio import check_view
from warp_ir.image.tonemap import TONEMAPS, automatic_exposure, suggest_exposure
from warp_ir.scene import InputError, Scene
from warp_ir.settings import RenderSettings

if TYPE_CHECKING:
    from warp_ir.engine import Executor
    from warp_ir.film import Film
    from warp_ir.renderer import Renderer
    from warp_ir.scheduling import Progress
    from warp_ir.usd import StageReader
    from warp_ir.usd.settings.render_spec import Product
    from warp_ir.view.film_preview import FilmPreview

_EXPLANATIONS = ("all geometry", "draws no geometry", "it emits nothing", "the picture is black")
"""Words of the warnings of a scene that explain a black picture."""
_WRITE_SECONDS = 0.05, 2.5e-7
"""Approximate time to load what writes pictures, and to write a pixel [s]; a later picture: as the last one."""
_IN_SURFACE = 1e-6
"""Depth in units of the scene's size below which a camera lies in the surface that it sees."""


@dataclass(frozen=True)
class Picture:
    """One render and the files that it is written to."""

    time: TimeCode
    product: "Product | None"
    """RenderProduct whose camera and settings are used; None: the first of the stage."""
    files: Mapping[Path, tuple[str, ...] | None]
    """File -> its AOVs; None: those of the first product."""


@dataclass
class Job:
    """What all pictures of a command share."""

    args: argparse.Namespace
    device: str
    versions: Mapping[str, str]
    reader: "StageReader"
    view: tuple[str, str] | None
    """OpenColorIO's display and view; None: pictures are tone-mapped."""
    executor: "Executor | None" = None
    """What renders the parts of a picture; None: its renderer, which has no parts."""
    films: Sequence[PartFilm] = ()
    """The parts that the picture is made of; none: it is rendered."""
    preview: "FilmPreview | None" = None
    renderer: "Renderer | None" = None
    previous_scene: Scene | None = None
    write_seconds: float | None = None
    """Time in which the latest picture was written [s]."""
    warned: set[str] = field(default_factory=set)
    """Warnings that have been printed."""
    exposure: float | None = None
    """Exposure of all pictures [stops]; None: the first one decides, when it is written."""


Rendered = tuple[dict[str, Any], int] | None
"""Statistics of a picture and the exit code; None: it is there already, and an earlier command is continued."""


def run(args: argparse.Namespace, films: Sequence[PartFilm] = ()) -> int:
    """Renders the stage's picture, or one for each frame and product; returns the exit code.

    With `films` the picture is made of these parts.
    """
    # All errors of the command line are reported before anything is loaded.
    part_of(args, settings_of(args))
    if not films:
        check_engine(args)
    pictures = []
    into_folder = args.output.endswith(("/", os.sep)) or os.path.isdir(args.output)
    _check_exr_flags(args, into_folder)
    view = _view(args, into_folder)
    if not into_folder:
        outputs = outputs_of(args.output, args.frames, time_code_of(args))
        pictures = [Picture(code, None, {path: None}) for code, path in outputs.items()]
        for path in outputs.values():
            check_output(path, SUFFIXES, make_folder=args.make_output_path)
    if args.stats:
        check_output(args.stats, (".json",), make_folder=args.make_output_path)
    if films:
        return _render_pictures(args, pictures, view, None, films)
    with open_executor(args) as executor:
        return _render_pictures(args, pictures, view, executor)


def _render_pictures(
    args: argparse.Namespace,
    pictures: Sequence[Picture],
    view: tuple[str, str] | None,
    executor: "Executor | None",
    films: Sequence[PartFilm] = (),
) -> int:
    """Renders pictures, by default those of the stage's products; returns the exit code."""
    name = args.device if films else device_of(args, executor)
    device = open_device(name, verbose=args.verbose)
    with importing():
        _ = ir.load_usd, ir.Renderer  # imported here, so that the first frame's time does not include it
    versions = _versions()
    imported = time.perf_counter() - args.started
    preview = None
    if args.preview:
        from warp_ir.view.film_preview import FilmPreview

        preview = FilmPreview(
            f"{args.stage} - warp-ir", 0.0 if args.exposure == "auto" else args.exposure, args.tonemap or TONEMAPS[0]
        )
    with ProgressDisplay("opening", quiet=args.quiet):
        reader = open_reader(args)
    opened = time.perf_counter() - args.started - imported
    exposure = None if args.exposure == "auto" else args.exposure
    job = Job(args, device, versions, reader, view, executor, films, preview, exposure=exposure)
    if films:
        pictures = [_merged_picture(job)]
    elif not pictures:
        pictures = _products(job)

    cluster = as_cluster(executor) if args.shared_files and len(pictures) > 1 else None
    if cluster is not None:
        from warp_ir.cli.frame_tasks import render_frames

        results = render_frames(job, cluster, pictures)
    else:
        results = _one_by_one(job, pictures)
    frames: list[dict[str, Any]] = []
    code = 0
    for picture, rendered in results:
        if rendered is None:
            say(f"{next(iter(picture.files))}: exists and is skipped")
            continue
        statistics, code = rendered
        if not frames:
            statistics["timings"]["load"] += opened
        frames.append(statistics)
        if code:
            break
    if preview is not None:
        preview.close()
    if args.stats:
        _write_stats(Path(args.stats), job, imported, frames)
    return code


def _one_by_one(job: Job, pictures: Sequence[Picture]) -> Iterator[tuple[Picture, Rendered]]:
    """Renders pictures, one after the other."""
    started: float = job.args.started
    for number, picture in enumerate(pictures, start=1):
        yield picture, render_picture(job, picture, label_of(picture, number, len(pictures)), started)
        started = time.perf_counter()


def label_of(picture: Picture, number: int, count: int) -> str:
    """What progress calls a picture."""
    name = next(iter(picture.files)).name
    return name if count == 1 else f"{name} ({number}/{count})"


def _check_exr_flags(args: argparse.Namespace, into_folder: bool) -> None:
    """Raises `InputError` if flags for .exr are given for another file, or contradict each other."""
    if args.cryptomatte and args.exr_compression in LOSSY and args.exr_parts == "one":
        raise InputError(f"--exr-compression: {args.exr_compression} would change Cryptomattes; add --exr-parts many")
    if into_folder or Path(args.output).suffix.lower() == ".exr":
        return
    given = {
        "--exr-compression": args.exr_compression != COMPRESSIONS[0],
        "--exr-parts": args.exr_parts != "one",
        "--cryptomatte": bool(args.cryptomatte),
        "--owner": args.owner is not None,
    }
    for flag in (flag for flag, is_given in given.items() if is_given):
        raise InputError(f"{flag}: has no effect on {args.output}; name an .exr file")


def _view(args: argparse.Namespace, into_folder: bool) -> tuple[str, str] | None:
    """OpenColorIO's display and view that the flags choose; None: they do not.

    Raises:
        InputError: They do not exist, or have no effect.
    """
    if args.ocio_display is None and args.ocio_view is None:
        return None
    flag = "--ocio-view" if args.ocio_display is None else "--ocio-display"
    if args.tonemap is not None:
        raise InputError(f"{flag}: takes the place of --tonemap; give one of them")
    if not into_folder and Path(args.output).suffix.lower() not in DISPLAYED:
        raise InputError(f"{flag}: has no effect on {args.output}; name a file of type {', '.join(DISPLAYED)}")
    return check_view(args.ocio_display, args.ocio_view)


def _products(job: Job) -> list[Picture]:
    """The pictures that the stage's RenderProducts ask for, in the user's folder.

    Products with the same camera and settings are one render that is written to several files.

    Raises:
        InputError: The stage has no RenderProducts, or two of them have the same file name.
    """
    args, pictures, taken = job.args, [], set()
    folder = Path(args.output)
    codes: list[TimeCode] = list(time_codes(args.frames)) if args.frames else [time_code_of(args)]
    for code in codes:
        groups: list[tuple[Product, dict[Path, tuple[str, ...] | None]]] = []
        for product in job.reader.spec(code).products:
            if not product.path:
                raise InputError(
                    f"{folder}: is a folder, but {args.stage} has no RenderProducts; name the file to write"
                )
            name = Path(product.name)
            if name.suffix.lower() not in SUFFIXES:
                warn(f"{product.path}: files of type {name.suffix!r} cannot be written; .exr is used")
                name = name.with_suffix(".exr")
            if args.frames and "#" not in str(name) and folder / name in taken:
                name = name.with_name(f"{name.stem}.####{name.suffix}")
            if args.frames and "#" in str(name):
                assert isinstance(code, float)
                name = outputs_of(str(name), f"{code:g}", None)[code]
            path = check_output(folder / name, SUFFIXES, make_folder=args.make_output_path)
            if path in taken:
                raise InputError(f"{product.path}: another RenderProduct is also written to {name}")
            taken.add(path)
            same = (g for g in groups if (g[0].camera, g[0].settings) == (product.camera, product.settings))
            group = next(same, None)
            if group is None:
                group = (product, {})
                groups.append(group)
            group[1][path] = product.aovs
        pictures += [Picture(code, product, files) for product, files in groups]
    return pictures


def _merged_picture(job: Job) -> Picture:
    """The picture that films are parts of.

    Raises:
        InputError: The output is a folder, or the stage no longer has their RenderProduct.
    """
    path, first, code = Path(job.args.output), job.films[0], time_code_of(job.args)
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name the file to write")
    products = {product.path: product for product in job.reader.spec(code).products}
    if first.product is not None and first.product not in products:
        raise InputError(f"{first.path}: its RenderProduct {first.product} is no longer there")
    product = None if first.product is None else products[first.product]
    return Picture(code, product, {path: None if product is None else product.aovs})


def render_picture(job: Job, picture: Picture, label: str, started: float) -> Rendered:
    """Loads, renders and writes one picture, in the time since `started`."""
    args = job.args
    path = next(iter(picture.files))
    preview = job.preview
    in_terminal = preview is not None and preview.in_terminal
    with ProgressDisplay(label, quiet=args.quiet or in_terminal) as display:
        begin = time.perf_counter()
        scene = job.reader.read(picture.time, picture.product)
        load_seconds = time.perf_counter() - begin
        reused = {
            name: _count_reused(getattr(job.previous_scene, name, ()), getattr(scene, name))
            for name in ("meshes", "lights")
        }
        job.previous_scene = scene
        say_warnings((w for w in scene.warnings if w not in job.warned), everything=args.verbose)
        job.warned.update(scene.warnings)
        settings = settings_of(args, scene.settings)
        key = _picture_key(job, picture, scene, settings)
        part = part_of(args, settings)
        if (
            args.resume
            and part is None
            and not checkpoint_path(path).exists()
            and _is_finished(job, picture, scene, settings, key)
        ):
            return None
        if job.renderer is not None and job.renderer.wanted == settings:
            job.renderer.update(scene)
        else:
            job.renderer = ir.Renderer(scene, settings, device=job.device, threads=job.args.threads)
        renderer, film = job.renderer, job.renderer.new_film()
        product = None if picture.product is None else picture.product.path
        note = "" if part is None else note_of(part, args, picture.time, product)
        checkpoint = Checkpoint(path, film, lambda: fingerprint(scene, renderer.settings), args.checkpoint, note)
        if not job.films:
            _check_part(part, checkpoint.path, resume=args.resume)
        if args.resume and checkpoint.resume():
            if part is not None and film.iterations >= len(part.iterations):
                return None
            say(f"{path}: continues after {film.iterations} iterations")

        def report(progress: "Progress") -> None:
            display(progress)
            if preview is not None:
                preview(film, f"{label}: {describe_progress(progress)}")
            if progress.fraction < 1.0:
                checkpoint.write_if_due()

        begin = time.perf_counter()
        exr = _exr_options(job, picture)  # before the render, so that its camera rays are within the time limit
        reserve = job.write_seconds or _WRITE_SECONDS[0] + _WRITE_SECONDS[1] * film.width * film.height
        try:
            if job.films:
                _merge(job.films, film, renderer, fingerprint(scene, renderer.settings))
            else:
                iterations = None if part is None else part.iterations
                _render_film(job, picture, film, report, started=started, reserve=reserve, iterations=iterations)
        except InputError:
            if not job.films and (saved := checkpoint.keep()):
                say(f"{saved}: --resume continues from this checkpoint")
            raise
        except MemoryError as error:
            _say_saved(checkpoint.keep(), checkpoint, f"out of memory: {error}")
            raise
        render_seconds = time.perf_counter() - begin
        if preview is not None:
            preview(film, label, last=True)
    timings = {**film.timings, "load": load_seconds, "render": render_seconds}
    # `Film.interrupted` is the number of the signal.
    stop_signal = int(film.interrupted)
    code = 128 + stop_signal if stop_signal else 0
    written: list[Path] = []
    write_warnings: list[str] = []
    failure = ""
    if part is None and (film.iterations or not stop_signal):
        begin = time.perf_counter()
        metadata: dict[str, object] = {
            **job.versions,
            "stage": str(args.stage),
            "camera": scene.camera.name,
            "device": job.device,
            "key": "" if stop_signal else key,
        }
        if picture.time is not None:
            metadata["frame"] = picture.time
        if job.exposure is None:
            job.exposure = round(automatic_exposure(film.radiance()), 2) + 0.0
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            try:
                for file in picture.files:
                    written += write_image(
                        file,
                        film,
                        aovs=_aovs(job, picture, file),
                        exposure=job.exposure,
                        tonemap=args.tonemap or TONEMAPS[0],
                        view=job.view,
                        half=args.half,
                        metadata=metadata,
                        exr=exr,
                    )
            except InputError as error:
                failure, code = str(error), code or 1
        write_warnings = [str(warning.message) for warning in caught]
        timings["write"] = time.perf_counter() - begin
        job.write_seconds = timings["write"]
    if job.films:  # they stay as they are, even if one lies where a checkpoint would
        if failure:
            say(f"error: {failure}", logging.ERROR)
    elif failure:
        _say_saved(checkpoint.keep(), checkpoint, failure)
    elif part is not None and film.iterations:
        saved = checkpoint.keep()
        if saved != checkpoint.path:
            _say_saved(saved, checkpoint, f"{checkpoint.path}: cannot be written")
            code = code or 1
        elif stop_signal:
            say(f"{checkpoint.path}: --resume continues from this checkpoint")
        else:
            written = [saved]
    elif not stop_signal:
        checkpoint.remove()
    elif args.checkpoint > 0.0 and checkpoint.write():
        say(f"{checkpoint.path}: --resume continues from this checkpoint")
    blank = _blank_picture(scene, film)
    explained = any(words in line for line in scene.warnings for words in _EXPLANATIONS)
    picture_warnings = [*([f"{scene.camera.name}: {blank}"] if blank and not explained else []), *write_warnings]
    picture_warnings += renderer.warnings
    if settings.time_limit is not None and film.iterations == 1 and film.seconds > settings.time_limit:
        late = f"the picture took {film.seconds:.2g} s, as one iteration is the least"
        picture_warnings.append(f"--time-limit {settings.time_limit:g}: {late}")
    say_warnings(picture_warnings)
    _summarize(
        job, written[0] if part is not None and written else path, film, written=bool(written), blank=bool(blank)
    )
    statistics = {
        "output": [str(file) for file in written],
        "frame": picture.time,
        "camera": scene.camera.name,
        "width": film.width,
        "height": film.height,
        "iterations": film.iterations,
        "seconds": film.seconds,
        "error": film.error(),
        "rejected": film.rejected,
        "interrupted": bool(stop_signal),
        "timings": timings,
        "settings": renderer.settings.to_dict(),
        "loaded": dict(scene.stats),
        "kept": reused,
        "counts": dict(film.counts),
        "warnings": [*scene.warnings, *picture_warnings],
    }
    return statistics, code


def _render_film(
    job: Job, picture: Picture, film: "Film", progress: "Callable[[Progress], None]", **limits: Any
) -> None:
    """Adds iterations to the film where the flags want them to run; `limits` are those of `Renderer.render`."""
    assert job.renderer is not None
    if job.executor is None:
        job.renderer.render(film, progress, **limits)
        return
    from warp_ir.engine import render_parts

    cluster = as_cluster(job.executor)
    if cluster is not None and job.args.shared_files:
        cluster.source = stage_source(job.args, picture.time, picture.product)
    render_parts(job.renderer, job.executor, film, progress, size=job.args.part_iterations, **limits)


def _exr_options(job: Job, picture: Picture) -> ExrOptions:
    """How the picture's EXR files are stored; traces the Cryptomattes if there is such a file."""
    args = job.args
    wanted = args.cryptomatte if any(file.suffix.lower() == ".exr" for file in picture.files) else []
    assert job.renderer is not None
    return ExrOptions(
        compression=args.exr_compression,
        multipart=args.exr_parts == "many",
        cryptomattes=[matte for matte in job.renderer.cryptomattes() if matte.kind in wanted] if wanted else [],
        owner=args.owner,
        frames_per_second=frames_per_second(job.reader),
    )


def _blank_picture(scene: Scene, film: "Film") -> str:
    """Why a picture shows nothing: one sentence; "" if it shows something, or if there is no picture.

    Camera rays begin in a surface if all depths are within the rounding of float32 coordinates.
    """
    if not film.iterations:
        return ""
    hit = film.aov("alpha") > 0.0
    if not hit.any():
        return "the camera sees no geometry"
    if film.radiance().max() > 0.0:
        return ""
    size = max(scene.extent, float(abs(scene.camera.world_from_camera[:3, 3]).max()))
    if hit.all() and film.aov("depth").max() <= _IN_SURFACE * size:
        return "the camera lies in a surface: the picture is black"
    if not film.aov("albedo").any():
        return "the surfaces that the camera sees reflect nothing: the picture is black"
    return "no light reaches what the camera sees, from outside a closed room for example: the picture is black"


def _count_reused(previous: Sequence[object], current: Sequence[object]) -> int:
    """How many of the current records are the same objects as in the previous picture."""
    ids = {id(item) for item in previous}
    return sum(id(item) in ids for item in current)


def _aovs(job: Job, picture: Picture, path: Path) -> tuple[str, ...]:
    """The AOVs to write to a file: those of the command line, else those of the stage if the format has layers."""
    if job.args.aovs or path.suffix.lower() != ".exr":
        return tuple(dict.fromkeys(job.args.aovs))
    aovs = picture.files[path]
    from_stage = job.reader.spec(picture.time).products[0].aovs if aovs is None else aovs
    return tuple(name for name in from_stage if name != "alpha")  # every .exr has alpha


def _picture_key(job: Job, picture: Picture, scene: Scene, settings: RenderSettings) -> str:
    """A hash of all that the pixels depend on, by which --resume knows the picture; "" if it cannot be stored."""
    args = job.args
    if not any(can_hold_key(file) for file in picture.files):
        return ""
    aovs = [_aovs(job, picture, file) for file in picture.files]
    shown = args.exposure, args.tonemap or TONEMAPS[0], job.view, args.half, args.cryptomatte, aovs
    return fingerprint(scene, settings, *shown)


def _is_finished(job: Job, picture: Picture, scene: Scene, settings: RenderSettings, key: str) -> bool:
    """Whether all files of a picture are there, of its size, and of its key as far as their formats hold one."""
    height = settings.resolve(scene.camera.aspect).height
    _, _, columns, rows = replace(settings, height=height).pixels()
    for file in picture.files:
        aovs = () if file.suffix.lower() == ".exr" else _aovs(job, picture, file)
        for path in (file, *(aov_path(file, name) for name in aovs)):
            if not path.exists():
                return False
            try:
                good = read_image(path).shape[:2] == (rows, columns) and read_key(path) in (None, key)
            except InputError:
                good = False
            if not good:
                say(f"{path}: is not this picture, or not finished: it is rendered anew")
                return False
    return True


def _check_part(part: Part | None, film: Path, *, resume: bool) -> None:
    """Raises `InputError` if the film that is there is of another part: one must not take the other's place."""
    if not film.exists():
        return
    try:
        found = read_film(film)
    except InputError as error:
        if resume:
            raise not_resumed(error) from None
        return  # it is damaged, and replaced
    other = None if found is None else found.part
    if other != part:
        holds = "an unfinished picture" if other is None else f"{other} of {other.total} iterations"
        raise InputError(f"{film}: holds {holds}: name another OUTPUT, or remove it")


def _merge(films: Sequence[PartFilm], film: "Film", renderer: "Renderer", key: str) -> None:
    """Makes an empty film the whole of its parts, which are merged in their order: always to the same bits."""
    film.resume(films[0].path, key)
    for part in films[1:]:
        other = renderer.new_film()
        other.resume(part.path, key)
        film.merge(other)


def _say_saved(saved: Path | None, checkpoint: Checkpoint, failure: str) -> None:
    """Says that the picture could not be written, and where its film lies."""
    if saved is None:
        say(f"error: {failure}; there is no room for its film either", logging.ERROR)
    elif saved == checkpoint.path:
        say(f"error: {failure}; its film is kept in {saved}, from which --resume continues", logging.ERROR)
    else:
        say(
            f"error: {failure}; its film is kept in {saved}: as {checkpoint.path}, --resume continues it", logging.ERROR
        )


def _summarize(job: Job, path: Path, film: "Film", *, written: bool, blank: bool) -> None:
    """Prints the line about a finished picture, and warnings and hints about its values.

    A blank picture says nothing about the light that its samples have missed: it has no estimated error.
    """
    if film.interrupted:
        message = "interrupted" if film.iterations else "interrupted before the first iteration: nothing written"
        say(message, logging.ERROR)
    if not written:
        return
    error = film.error()
    estimate = f", estimated error {100.0 * error:.2g} %" if math.isfinite(error) and not blank else ""
    summary = f"{path}: {film.width} x {film.height}, {film.iterations} iterations in {film.seconds:.2f} s"
    show_result(f"{summary} on {job.device}{estimate}", quiet=job.args.quiet)
    if film.rejected:
        warn(f"{film.rejected} non-finite samples were replaced")
    if path.suffix.lower() in DISPLAYED:
        assert job.exposure is not None  # since a picture is written
        stops = suggest_exposure(film.radiance(), job.exposure)
        if job.args.exposure == "auto":
            say(f"--exposure auto: {job.exposure:g} stops")
        elif stops is not None:
            brightness = "dark" if stops > job.exposure else "bright"
            say(f"hint: the picture is very {brightness}; --exposure {stops:g} would correct this, --exposure auto too")


def _write_stats(path: Path, job: Job, imported: float, frames: list[dict[str, Any]]) -> None:
    """Writes the statistics of all pictures as JSON: as a list `frames`, or at the top level for a single picture."""
    results: dict[str, Any] = {
        "stage": str(job.args.stage),
        "device": job.device,
        "versions": dict(job.versions),
        "peak_memory_bytes": _peak_memory(),
    }
    if job.args.frames is None and len(frames) == 1:
        statistics = dict(frames[0])
        statistics["timings"] = {"import": imported, **statistics["timings"]}
        results |= statistics
    else:
        results |= {"timings": {"import": imported}, "frames": frames}
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(_plain(results), indent=2) + "\n", encoding="utf-8")


def _plain(value: object) -> object:
    """The value as JSON can hold it: NumPy numbers become Python's, and numbers that are not finite become null."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    value = value.item() if hasattr(value, "item") else value
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _versions() -> dict[str, str]:
    """Versions of the packages that the pixels depend on."""
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
    """Peak resident memory of the process [bytes]; None where the system does not report it."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak
