"""Path tracing by Mitsuba 3, on the same cores or the same GPU, warmed up and with its best integrator.

`path` is faster per sample, but `volpath` can need fewer samples, because its shadow rays pass through the shapes that
represent our lights. Probe renders measure the cost and the error of both against the reference; for every budget the
integrator with the smaller expected error is used, with as many samples as fit.
"""

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from make_references import to_mitsuba, use_mitsuba
from methods import Pixels, Run, Task

from warp_ir.metrics import relative_mse

if TYPE_CHECKING:
    import mitsuba

PROBE_SAMPLES = (4, 32)
"""Samples per pixel of the probe renders, from which the cost of other numbers is extrapolated."""
MAX_PATHS = 1 << 24
"""Paths of one pass; more are traced in several passes, to bound the memory."""


def start(device: str) -> str:
    """Loads Mitsuba for a device and returns its variant."""
    variant = use_mitsuba("llvm_ad_rgb" if device == "cpu" else "cuda_ad_rgb").variant()
    return str(variant)


@dataclass(frozen=True)
class Probe:
    """Measured cost and error of an integrator."""

    integrator: "mitsuba.Integrator"
    overhead: float
    """Time [s] of a render without samples."""
    cost: float
    """Time [s] of one sample per pixel."""
    error: float
    """relMSE of one sample per pixel."""

    def samples(self, seconds: float) -> int:
        """Samples per pixel that fit into a time, at least one."""
        return max(1, int((seconds - self.overhead) / self.cost))

    def expected_error(self, seconds: float) -> float:
        """Expected relMSE after a time; increased in proportion if one sample takes longer."""
        samples = self.samples(seconds)
        return self.error / samples * max(1.0, (self.overhead + samples * self.cost) / max(seconds, 1e-6))


class MitsubaPath:
    """Unidirectional path tracing with next-event estimation and multiple importance sampling."""

    name = "mitsuba"

    def __init__(self) -> None:
        import mitsuba

        self._mi = mitsuba
        self._task: Task | None = None

    def prepare(self, task: Task, budgets: list[float]) -> dict[str, float]:
        """Translates the scene, compiles, and probes the integrators; returns seconds by step."""
        if task is self._task:
            return self._setup
        begin = time.perf_counter()
        self._task = task
        self._scene = to_mitsuba(task.scene, task.width, task.height, task.max_bounces)
        uploaded = time.perf_counter()
        self._probes = [self._probe(kind, task) for kind in ("path", "volpath")]
        self._setup = {"upload": uploaded - begin, "compile": time.perf_counter() - uploaded}
        return self._setup

    def render(self, seconds: float, seed: int) -> Run:
        """Renders as many samples as fit into the time, at least one."""
        probe = min(self._probes, key=lambda probe: probe.expected_error(seconds))
        samples = probe.samples(seconds)
        begin = time.perf_counter()
        picture = self._picture(probe.integrator, samples, seed)
        return Run(picture, time.perf_counter() - begin, samples)

    def render_samples(self, count: int, seed: int) -> Run:
        """Renders a number of samples per pixel and measures the CPU time."""
        probe = min(self._probes, key=lambda probe: probe.error)
        begin = time.process_time()
        picture = self._picture(probe.integrator, count, seed)
        return Run(picture, time.process_time() - begin, count)

    def _probe(self, kind: str, task: Task) -> Probe:
        """Measures cost and error of an integrator after compilation."""
        emissive = any(max(material.emission) > 0.0 for material in task.scene.materials)
        depth = -1 if task.max_bounces is None else task.max_bounces + 2
        integrator = self._mi.load_dict({"type": kind, "max_depth": depth, "hide_emitters": not emissive})
        shortest, errors = [], []
        for samples in PROBE_SAMPLES:
            seconds = []
            for seed in range(4):
                begin = time.perf_counter()
                picture = self._picture(integrator, samples, seed)
                seconds.append(time.perf_counter() - begin)
                errors.append(samples * relative_mse(picture, task.reference, reference_error=task.reference_error))
            shortest.append(min(seconds[1:]))
        cost = max((shortest[1] - shortest[0]) / (PROBE_SAMPLES[1] - PROBE_SAMPLES[0]), 1e-9)
        return Probe(integrator, max(shortest[0] - PROBE_SAMPLES[0] * cost, 0.0), cost, float(np.median(errors)))

    def _picture(self, integrator: "mitsuba.Integrator", samples: int, seed: int) -> Pixels:
        """Renders the mean of `samples` paths per pixel, in host memory."""
        assert self._task is not None
        passes = -(-samples * self._task.width * self._task.height // MAX_PATHS)
        counts = [samples * (k + 1) // passes - samples * k // passes for k in range(passes)]
        passes_done = []
        for k, count in enumerate(counts):
            # Every pass of every run has a seed of its own.
            rendered = self._mi.render(self._scene, integrator=integrator, spp=count, seed=seed * 1000 + k + 1)
            passes_done.append(np.array(rendered) * (count / samples))
        return np.asarray(sum(passes_done)[..., :3] * self._task.scene.camera.exposure)
