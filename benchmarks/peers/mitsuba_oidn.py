"""Mitsuba's path tracing, denoised by Open Image Denoise: the best peer that needs only two packages.

The denoiser also gets albedo and normals, with up to 16 samples per pixel as long as they take less than a tenth of
the time. The measured time includes these guides, the paths and the denoiser.
"""

import dataclasses
import time
from collections.abc import Callable

import numpy as np
import pyoidn
from make_references import to_mitsuba
from methods import Pixels, Run, Task

from peers.mitsuba_path import MitsubaPath

GUIDE_SAMPLES = (16, 4, 1)
"""Samples per pixel of the guides, in order of preference."""


class MitsubaDenoised:
    """Path tracing for most of the time; guides and denoising for the rest."""

    name = "mitsuba-oidn"

    def __init__(self, paths: MitsubaPath) -> None:
        import mitsuba

        self._mi = mitsuba
        self._paths = paths

    def prepare(self, task: Task, budgets: list[float]) -> dict[str, float]:
        """Prepares the path tracer and times the guides and the denoiser; returns seconds by step."""
        setup = self._paths.prepare(task, budgets)
        begin = time.perf_counter()
        # The guides show surfaces. The lights of a `Scene` are not surfaces, but would hide some in Mitsuba.
        self._surfaces = to_mitsuba(dataclasses.replace(task.scene, lights=()), task.width, task.height)
        self._aovs = self._mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
        guides = self._guides(1, 0)
        self._guide_cost = {n: _seconds(lambda n=n: self._guides(n, 1)) for n in GUIDE_SAMPLES}
        self._filter_cost = _seconds(lambda: _denoise(task.reference, *guides))
        return {**setup, "compile": setup["compile"] + time.perf_counter() - begin}

    def render(self, seconds: float, seed: int) -> Run:
        """Renders a denoised picture that takes `seconds` in total."""
        samples = next((n for n in GUIDE_SAMPLES if self._guide_cost[n] < 0.1 * seconds), 1)
        begin = time.perf_counter()
        guides = self._guides(samples, seed)
        run = self._paths.render(seconds - self._guide_cost[samples] - self._filter_cost, seed)
        picture = _denoise(run.picture, *guides)
        return Run(picture, time.perf_counter() - begin, run.samples)

    def render_samples(self, count: int, seed: int) -> Run:
        """Renders a denoised picture of a number of samples per pixel and measures the CPU time."""
        begin = time.process_time()
        guides = self._guides(1, seed)
        picture = _denoise(self._paths.render_samples(count, seed).picture, *guides)
        return Run(picture, time.process_time() - begin, count)

    def _guides(self, samples: int, seed: int) -> tuple[Pixels, Pixels]:
        """Albedo and shading normals, float32 [height, width, 3]."""
        layers = np.array(self._mi.render(self._surfaces, integrator=self._aovs, spp=samples, seed=seed))
        layers = layers.astype(np.float32, copy=False)[..., -6:]
        return np.clip(layers[..., :3], 0.0, 1.0), layers[..., 3:]


def _denoise(picture: Pixels, albedo: Pixels, normal: Pixels) -> Pixels:
    color = np.ascontiguousarray(picture, np.float32)
    return np.asarray(pyoidn.denoise(color, albedo, normal, hdr=True))


def _seconds(work: Callable[[], object]) -> float:
    """The shortest of three durations [s], after a warm-up."""
    times = []
    for _ in range(4):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return min(times[1:])
