"""Path tracing by Mitsuba 3, on the same cores or the same GPU, warmed up and at its best.

`path` is quicker per sample, and `volpath` can need fewer of them, because its shadow rays pass through the shapes
that our lights become there. Pilot renders tell the cost and the error of both, with the reference at hand; for every
budget the one that promises less error is taken, with as many samples as fit.
"""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from make_references import to_mitsuba, use_mitsuba
from methods import Run, Task

from warp_ir.metrics import relative_mse

PILOT = (4, 32)
"""Samples per pixel from which the cost of more is extrapolated."""
MOST_PATHS = 1 << 24
"""Paths in flight at once; more are traced in several passes, to bound the memory."""


def start(device: str) -> str:
    """Loads Mitsuba for a device; the variant in use."""
    variant = use_mitsuba("llvm_ad_rgb" if device == "cpu" else "cuda_ad_rgb").variant()
    return str(variant)


@dataclass(frozen=True)
class Pilot:
    """What an integrator is expected to do."""

    integrator: Any
    overhead: float
    """Seconds of a render without samples."""
    cost: float
    """Seconds of a sample per pixel."""
    error: float
    """relMSE of a sample per pixel."""

    def samples(self, seconds: float) -> int:
        """As many as fit, at least one."""
        return max(1, int((seconds - self.overhead) / self.cost))

    def promise(self, seconds: float) -> float:
        """Expected error, worse in proportion if it takes too long."""
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
        """Translates the scene, compiles, and times the integrators; seconds by step."""
        if task is self._task:
            return self._setup
        begin = time.perf_counter()
        self._task = task
        self._scene = to_mitsuba(task.scene, task.width, task.height, task.max_bounces)
        uploaded = time.perf_counter()
        self._pilots = [self._pilot(kind, task) for kind in ("path", "volpath")]
        self._setup = {"upload": uploaded - begin, "compile": time.perf_counter() - uploaded}
        return self._setup

    def render(self, seconds: float, seed: int) -> Run:
        """As many samples as the time allows, at least one."""
        pilot = min(self._pilots, key=lambda pilot: pilot.promise(seconds))
        samples = pilot.samples(seconds)
        begin = time.perf_counter()
        picture = self._picture(pilot.integrator, samples, seed)
        return Run(picture, time.perf_counter() - begin, samples)

    def _pilot(self, kind: str, task: Task) -> Pilot:
        """Cost and error of an integrator, compiled and undisturbed."""
        emissive = any(max(material.emission) > 0.0 for material in task.scene.materials)
        depth = -1 if task.max_bounces is None else task.max_bounces + 2
        integrator = self._mi.load_dict({"type": kind, "max_depth": depth, "hide_emitters": not emissive})
        least, errors = [], []
        for samples in PILOT:
            seconds = []
            for seed in range(4):
                begin = time.perf_counter()
                picture = self._picture(integrator, samples, seed)
                seconds.append(time.perf_counter() - begin)
                errors.append(samples * relative_mse(picture, task.reference, reference_error=task.reference_error))
            least.append(min(seconds[1:]))
        cost = max((least[1] - least[0]) / (PILOT[1] - PILOT[0]), 1e-9)
        return Pilot(integrator, max(least[0] - PILOT[0] * cost, 0.0), cost, float(np.median(errors)))

    def _picture(self, integrator: Any, samples: int, seed: int) -> np.ndarray:
        """The mean of `samples` paths per pixel, in host memory."""
        assert self._task is not None
        passes = -(-samples * self._task.width * self._task.height // MOST_PATHS)
        counts = [samples * (k + 1) // passes - samples * k // passes for k in range(passes)]
        total: Any = 0.0
        for k, count in enumerate(counts):
            # The seeds of passes and of runs must not meet.
            rendered = self._mi.render(self._scene, integrator=integrator, spp=count, seed=seed * 1000 + k + 1)
            total = total + np.array(rendered) * (count / samples)
        return np.asarray(total[..., :3] * self._task.scene.camera.exposure)
