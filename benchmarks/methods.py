"""Tasks (a scene and its reference picture), and our own methods that render them.

Our methods and the peers in `peers/` have the same interface, `Method`:

    name                            name in tables and for --estimators
    prepare(task, budgets) -> dict      compiles and uploads everything; returns seconds by step
    render(seconds, seed) -> Run        renders a picture in about that time and measures the time taken
    render_samples(count, seed) -> Run  renders with that many iterations or samples per pixel; measures CPU time
"""

import dataclasses
import time
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from make_references import PICTURES, REFERENCES, ROOT, cached_reference, digest
from random_scenes import random_scene

import warp_ir as ir
from warp_ir.renderer import Renderer
from warp_ir.settings import ESTIMATOR_NAMES

SETUP = ("compile", "upload")
"""Phases that happen once per scene. The measured time is that of the whole call without them."""
KELLER_PATHS = 64
"""Light paths of `keller`: with the default number one iteration would take longer than the short budgets."""

Pixels = npt.NDArray[np.floating]


@dataclass(frozen=True)
class Task:
    """A picture to render, the same for every method."""

    name: str
    scene: ir.Scene
    reference: Pixels
    """Radiance by an independent renderer, float32 [height, width, 3]."""
    reference_error: Pixels
    """Standard error of the reference, float32 [height, width, 3]."""
    floor: float
    """relMSE of the reference itself, which is subtracted from every measured error."""
    max_bounces: int | None = None

    @property
    def width(self) -> int:
        return self.reference.shape[1]

    @property
    def height(self) -> int:
        return self.reference.shape[0]


@dataclass(frozen=True)
class Run:
    """One picture and its cost."""

    picture: Pixels
    """Linear radiance, [height, width, 3]."""
    seconds: float
    """Wall time of the render (of `render_samples` CPU time), up to the picture in host memory, without setup."""
    samples: int
    """Iterations, or samples per pixel."""
    timings: dict[str, float] = field(default_factory=dict)
    """Seconds by phase."""
    counts: dict[str, int] = field(default_factory=dict)
    """Rays, VPLs, ..."""


class Method(Protocol):
    """A renderer with its settings."""

    name: str

    def prepare(self, task: Task, budgets: list[float]) -> dict[str, float]: ...

    def render(self, seconds: float, seed: int) -> Run: ...

    def render_samples(self, count: int, seed: int) -> Run: ...


class StaleReference(Exception):
    """The scene has changed since its reference was rendered: errors cannot be measured."""


def stored_tasks() -> list[str]:
    """Names of the pictures that have a stored reference."""
    return [name for name in PICTURES if (REFERENCES / f"{name}.npz").exists()]


def load_task(name: str, *, size: int = 96, reference_seconds: float = 240.0) -> Task:
    """The scene and the reference of a stored picture, or of a seed (a number) of `random_scenes`.

    Args:
        name: Name of the picture, or the number.
        size: Width and height of a picture of a random scene.
        reference_seconds: CPU time for a reference that is not in the cache.

    Raises:
        StaleReference: The scene has changed since its reference was rendered.
    """
    if name.isdecimal():
        scene = random_scene(int(name))
        made = cached_reference(scene, size, size, reference_seconds)
        return Task(scene.name, scene, made["mean"], made["standard_error"], made["floor"])
    stem, _, _, max_bounces = PICTURES[name]
    stage: Path = ROOT / "scenes_usd" / f"{stem}.usda"
    with np.load(REFERENCES / f"{name}.npz") as stored:
        if str(stored["scene_sha256"]) != digest(stage):
            raise StaleReference(f"{stage.name} is newer than its reference: run make_references.py {name}")
        mean, error, floor = stored["mean"], stored["standard_error"], float(stored["floor"])
    return Task(name, ir.load_usd(stage), mean, error, floor, max_bounces)


class Ours:
    """One of our estimators, called through the public API."""

    def __init__(self, name: str, device: str, **choices: Any) -> None:
        self.name, self.device, self.choices = name, device, choices

    def prepare(self, task: Task, budgets: list[float]) -> dict[str, float]:
        self._scene = task.scene
        self._settings = ir.RenderSettings(
            width=task.width, height=task.height, max_bounces=task.max_bounces, **self.choices
        )
        first = ir.render(self._scene, dataclasses.replace(self._settings, iterations=1), device=self.device)
        first.radiance()
        return {step: first.timings.get(step, 0.0) for step in SETUP}

    def render(self, seconds: float, seed: int) -> Run:
        settings = dataclasses.replace(self._settings, time_limit=seconds, seed=seed)
        renderer = Renderer(self._scene, settings, device=self.device)  # uploads before, as the peers do
        start = time.perf_counter()
        film = renderer.render()
        picture = film.radiance()
        return self._run(film, picture, time.perf_counter() - start)

    def render_samples(self, count: int, seed: int) -> Run:
        settings = dataclasses.replace(self._settings, iterations=count, seed=seed)
        renderer = Renderer(self._scene, settings, device=self.device)
        start, wall_start = time.process_time(), time.perf_counter()
        film = renderer.render()
        picture = film.radiance()
        seconds = time.process_time() - start
        # Phases are measured as wall time: CPU time is divided between them in proportion.
        return self._run(film, picture, seconds, seconds / (time.perf_counter() - wall_start))

    def _run(self, film: ir.Film, picture: Pixels, seconds: float, scale: float = 1.0) -> Run:
        phases = {name: scale * t for name, t in film.timings.items() if name not in SETUP}
        return Run(picture, seconds, film.iterations, phases, film.counts)


def own_methods(device: str) -> dict[str, Ours]:
    """All of our estimators, and `vpl` also without its filter and, if it is installed, with the denoiser."""
    choices: dict[str, dict[str, Any]] = {name: {"estimator": name} for name in ESTIMATOR_NAMES}
    if "keller" in choices:
        choices["keller"]["light_paths"] = KELLER_PATHS
    switches = {setting.name for setting in dataclasses.fields(ir.RenderSettings)}
    if "vpl" in choices and "filter" in switches:
        choices["vpl-unfiltered"] = {"estimator": "vpl", "filter": False}
    if "vpl" in choices and "denoise" in switches and find_spec("pyoidn"):
        choices["vpl-denoised"] = {"estimator": "vpl", "denoise": True}
    return {name: Ours(name, device, **choice) for name, choice in choices.items()}
