"""Frames of an animation as tasks of a Ray cluster whose machines share files.

A worker does with a frame what the command alone does: it reads the stage, renders, writes checkpoints and files. So a
frame has the bits that it has alone. One whose worker died goes on in another, from its checkpoint.
"""

import argparse
import logging
import os
import time
from collections.abc import Hashable, Iterable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warp_ir.cli.checkpoint import checkpoint_path
from warp_ir.cli.console import LOGGER, say, show_result
from warp_ir.cli.device_choice import open_device
from warp_ir.cli.render import Job, Picture, Rendered, label_of, render_picture
from warp_ir.cli.stage_options import open_reader
from warp_ir.engine.executor import in_order
from warp_ir.image.ocio import use_config

if TYPE_CHECKING:
    from warp_ir.engine.ray_cluster import RayCluster

_LAST_WORDS = 20.0
"""Time in which frames that are interrupted write what they have [s]."""


@dataclass(frozen=True)
class _Frames:
    """What all frames share."""

    args: argparse.Namespace
    device: str
    versions: Any
    view: tuple[str, str] | None
    begun: float
    """Time of the command [s since the epoch]."""


@dataclass(frozen=True)
class _Result:
    """What comes back of a frame."""

    rendered: Rendered
    exposure: float | None
    messages: Sequence[tuple[int, str, bool]]
    """Level, text, and whether it is the line about the result."""


def render_frames(job: Job, cluster: "RayCluster", pictures: Sequence[Picture]) -> Iterator[tuple[Picture, Rendered]]:
    """Renders pictures in a cluster; they come back in order."""
    args = argparse.Namespace(**vars(job.args))
    args.engine, args.preview, args.stats, args.log_file, args.quiet = None, False, None, None, True
    args.threads = cluster.threads
    for name in ("stage", "session_layer", "ocio_config"):
        path = getattr(args, name)
        if path is not None and "://" not in path:
            setattr(args, name, os.path.abspath(path))
    device = "cuda:0" if cluster.kind == "cuda" else "cpu"
    shared = _Frames(args, device, job.versions, job.view, time.time())
    tasks = _FrameTasks(cluster, shared, len(pictures))
    tasks.exposure = job.exposure
    numbered = list(enumerate(pictures, start=1))
    said: set[str] = set()
    # The exposure of all may be that of the first.
    runs = [numbered] if job.exposure is not None else [numbered[:1], numbered[1:]]
    for run in runs:
        with closing(in_order(tasks, run, lambda: False)) as finished:
            for (_, picture), handle in finished:
                result: _Result = cluster.fetch(handle)
                for level, text, is_result in result.messages:
                    if is_result:
                        show_result(text, quiet=job.args.quiet)
                    elif level < logging.WARNING or text not in said:
                        say(text, level)
                        said.add(text)
                tasks.exposure = result.exposure
                yield picture, result.rendered


class _FrameTasks:
    """Starts frames in a cluster."""

    def __init__(self, cluster: "RayCluster", shared: _Frames, count: int) -> None:
        self._cluster, self._shared, self._count = cluster, cluster.put(shared), count
        self.exposure: float | None = None
        self.slots, self.finished = cluster.slots, cluster.finished

    def start(self, frame: tuple[int, Picture], /) -> Hashable:
        number, picture = frame
        files = {Path(os.path.abspath(path)): aovs for path, aovs in picture.files.items()}
        label = label_of(picture, number, self._count)
        return self._cluster.start_call(
            _render_frame, self._shared, replace(picture, files=files), label, self.exposure
        )

    def cancel(self, handles: Iterable[Hashable]) -> None:
        handles = list(handles)
        self._cluster.cancel(handles)
        end = time.monotonic() + _LAST_WORDS
        while handles and (left := end - time.monotonic()) > 0.0:
            done = set(self._cluster.finished(handles, left))
            handles = [handle for handle in handles if handle not in done]


_held: tuple[Any, Job] | None = None
"""In a worker: the command of its latest frame, and what its frames share."""


def _render_frame(shared: list[Any], picture: Picture, label: str, exposure: float | None) -> _Result:
    """Renders a frame in a worker."""
    global _held
    import ray

    messages: list[tuple[int, str, bool]] = []

    class Collect(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if not hasattr(record, "compiling"):
                messages.append((record.levelno, record.getMessage(), getattr(record, "only", "") == "file"))

    collect, held = Collect(logging.INFO), _held
    _held = None
    LOGGER.setLevel(logging.INFO)
    LOGGER.addHandler(collect)
    try:
        frames: _Frames = ray.get(shared[0])
        with use_config(frames.args.ocio_config):
            if held is None or held[0] != shared[0]:
                frames.args.started = time.perf_counter()
                device = open_device(frames.device)
                held = shared[0], Job(frames.args, device, frames.versions, open_reader(frames.args), frames.view)
            job = held[1]
            job.exposure = exposure
            # A film of this command was left by a worker that died.
            job.args.resume = frames.args.resume or _is_newer(next(iter(picture.files)), frames.begun)
            rendered = render_picture(job, picture, label, time.perf_counter())
    finally:
        LOGGER.removeHandler(collect)
    _held = held
    return _Result(rendered, job.exposure, messages)


def _is_newer(picture: Path, begun: float) -> bool:
    """Whether a checkpoint of the picture has been written since a time."""
    with suppress(OSError):
        return checkpoint_path(picture).stat().st_mtime >= begun
    return False
