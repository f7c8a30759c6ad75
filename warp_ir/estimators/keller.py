"""Instant radiosity as published (Keller 1997, "Instant Radiosity", SIGGRAPH).

The radiance that leaves a surface point x towards the camera is the Neumann series L = Le + R Le + R² Le + ... of the
rendering equation. Instant radiosity samples the series once: N light paths start on the lights, and every vertex y_k
becomes a virtual point light (VPL) of intensity I_k. Then, for every visible point,

    L(x) = Le(x) + ρ(x)/π · Σ_k I_k G(x, y_k) V(x, y_k),      G = cos⁺θ_x cos⁺θ_y / |x - y|²

In the paper the sum is over N pictures, each rendered by graphics hardware with one point light and its shadows, and
added in the accumulation buffer. Here it is a loop over the VPLs at every pixel, with a shadow ray for V.

Paths end by fractional absorption: of N paths the first ⌊ρ̄ʲN⌋ are reflected j times, where ρ̄ is the mean reflectivity
of the scene, so the low-discrepancy points stay in order. Every iteration jitters the camera rays and traces new VPLs;
the picture is the mean of the iterations.

Nothing here is optimised: it is the page to read first, and the baseline of every benchmark.
"""

import sys
from collections.abc import Sequence
from types import ModuleType
from typing import ClassVar

import warp as wp

import warp_ir.gbuffer
import warp_ir.vpl.emission
from warp_ir.device.launcher import MAX_REGISTERS
from warp_ir.device.scratch import Scratch
from warp_ir.device_scene import CameraData, DeviceScene, SceneData
from warp_ir.gbuffer import GBuffer, camera_vertex, reflecting_pixel, trace_primary
from warp_ir.sampling.sobol import iteration_scramble
from warp_ir.settings import ResolvedSettings
from warp_ir.tiles import indices
from warp_ir.vpl.contribution import UNBOUNDED, vpl_irradiance
from warp_ir.vpl.emission import VplBuffer, emit_vpls
from warp_ir.vpl.guide import unguided

wp.set_module_options({"enable_backward": False, "max_unroll": 0})


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _accumulate(
    first: int,
    scene: SceneData,
    gbuffer: GBuffer,
    vpls: VplBuffer,
    bound: float,
) -> None:
    """Computes E/π = 1/π Σ I min(G, bound) V; VPLs on lights (bounce 0) and on surfaces are summed separately."""
    pixel = reflecting_pixel(gbuffer, first + wp.tid())
    if pixel < 0:
        return
    direct = wp.vec3(0.0)
    indirect = wp.vec3(0.0)
    x = camera_vertex(gbuffer, pixel)
    for k in range(vpls.count[0]):
        irradiance = vpl_irradiance(scene, vpls, k, x, bound)
        if vpls.bounce[k] == 0:
            direct += irradiance
        else:
            indirect += irradiance
    gbuffer.normal_or_direct[pixel] = direct / wp.pi
    gbuffer.indirect[pixel] = indirect / wp.pi


class Keller:
    """Every VPL, every shadow ray."""

    MODULES: ClassVar[Sequence[ModuleType]] = (warp_ir.gbuffer, warp_ir.vpl.emission, sys.modules[__name__])
    WAVEFRONT_MODULES: ClassVar[Sequence[ModuleType]] = ()

    def __init__(self, scene: DeviceScene, camera: CameraData, settings: ResolvedSettings, scratch: Scratch) -> None:
        """Prepares for a scene, a `CameraData` and settings; what an iteration overwrites lies in `scratch`."""
        self._scene, self._camera, self._settings = scene, camera, settings
        self._scratch, self._launcher = scratch, scratch.launcher
        self._unguided = unguided(scene, scratch.launcher)
        radius = settings.bound_radius * scene.extent
        self._bound = 1.0 / radius**2 if radius > 0.0 else UNBOUNDED

    def prepare(self, iteration: int) -> object:
        """Uploads the numbers of an iteration."""
        self._scratch.number("scramble", iteration_scramble(self._settings.seed, iteration), wp.uint32)
        self._iteration = self._scratch.number("iteration", iteration, wp.int32)
        return self._unguided

    def estimate(self, iteration: int, gbuffer: GBuffer) -> None:
        """Fills the G-buffer, direct and indirect irradiance included, for one iteration."""
        settings, launcher = self._settings, self._launcher
        self.prepare(iteration)
        with launcher.phase("primary"):
            trace_primary(self._scene, self._camera, launcher, gbuffer, iteration=self._iteration, seed=settings.seed)
        with launcher.phase("emission"):
            vpls = emit_vpls(
                self._unguided,
                self._scratch,
                light_paths=settings.light_paths,
                absorption=settings.absorption,
                max_bounces=settings.max_bounces,
                scramble=iteration_scramble(settings.seed, iteration),
            )
        with launcher.phase("gather"):
            launcher.launch(
                _accumulate,
                indices(gbuffer.tiles),
                [self._scene.data, gbuffer, vpls, self._bound],
            )
