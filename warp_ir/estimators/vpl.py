"""The default estimator: Keller's VPLs, gathered with few shadow rays, bounded and compensated.

`gather` estimates the sum over VPLs. Its bound b on G takes away energy where surfaces come close to each other. One
cosine-distributed ray per point compensates for that (Kollig and Keller 2004):

    E(x) = Σ I min(G, b) V + ∫ L(y) (1 - b/G)⁺ cosθ dω,        y what the ray hits

Since G ≤ 1/d², G cannot exceed b beyond the distance 1/√b: the ray is no longer than that, and usually hits nothing.
The point it hits gathers in turn, and so on. Emission that the ray meets counts with the clamped fraction (1 - b/G)⁺,
which is exactly what the bound took from the VPLs on that emitter: nothing counts twice.

The bound follows from the density of the VPLs (`vpl.sets`): no length in scene units is chosen anywhere.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from types import ModuleType
from typing import ClassVar

import warp as wp

import warp_ir.gbuffer
import warp_ir.vpl.emission
import warp_ir.vpl.sets
from warp_ir.device.launcher import MAX_REGISTERS
from warp_ir.device.scratch import Scratch
from warp_ir.device_scene import CameraData, DeviceScene, SceneData
from warp_ir.estimators import wavefront
from warp_ir.estimators.wavefront import (
    GatherSettings,
    Wave,
    compensate,
    continuing_paths,
    gather_in_waves,
    gather_scramble,
    lit_vertex,
    sample_index,
    shadow_rays,
    wave_pixel,
)
from warp_ir.gbuffer import GBuffer, reflecting_pixel, trace_primary
from warp_ir.guiding import learn, learn_visibility
from warp_ir.sampling import sobol
from warp_ir.settings import ResolvedSettings
from warp_ir.surface import ShadingPoint, albedo, shading_point
from warp_ir.tiles import indices
from warp_ir.vpl.emission import emit_vpls
from warp_ir.vpl.gather import gather
from warp_ir.vpl.guide import Guide, unguided
from warp_ir.vpl.sets import ON_LIGHTS, ON_SURFACES, VplSets, build_sets

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

SHADOW_RAYS = (4, 4)
"""Shadow rays per pixel and iteration, to VPLs on lights and to VPLs on surfaces."""
COMPENSATION_SHADOW_RAYS = (2, 2)
"""Shadow rays at the end of a compensation ray, whose light has lost most of its weight."""
_ROULETTE_DEPTH = wp.constant(2)


@wp.struct
class Irradiance:
    """Irradiance [W m⁻²] at a point."""

    direct: wp.vec3
    indirect: wp.vec3


@wp.func
def gather_path(
    scene: SceneData,
    vpl_sets: wp.array[VplSets],
    settings: GatherSettings,
    camera_vertex: ShadingPoint,
    index: int,
    is_gathered: bool,
    gathered: Irradiance,
) -> Irradiance:
    """The irradiance of VPLs at a point that the camera sees, with what the bound takes away.

    Args:
        scene: The scene.
        vpl_sets: The VPLs.
        settings: Numbers of rays, and the scramble.
        camera_vertex: The point.
        index: Index of the pixel's point of the sequence.
        is_gathered: Whether `gathered` is known; else it is gathered here.
        gathered: Irradiance at the point from VPLs, bounded.
    """
    x = camera_vertex
    out = gathered
    scramble = gather_scramble(settings)
    # The choice of the set has a sample dimension of its own, so neighbouring pixels evaluate different sets.
    u_set = sobol.sample_1d(scene.sobol, index, 0, scramble)
    throughput = wp.vec3(1.0)
    bound = vpl_sets[ON_LIGHTS].bound  # equal for VPLs on lights and on surfaces
    depth = int(0)
    rays = shadow_rays(settings, x)
    while depth <= settings.max_bounces:
        if depth > 0 or not is_gathered:
            u = sobol.sample_2d(scene.sobol, index, 4 * depth + 1, scramble)
            bounces = settings.max_bounces - depth
            from_lights = gather(scene.address, vpl_sets, ON_LIGHTS, u_set, x, u[0], rays[0], bounces)
            from_surfaces = gather(scene.address, vpl_sets, ON_SURFACES, u_set, x, u[1], rays[1], bounces)
            if depth == 0:
                out.direct = from_lights
                out.indirect = from_surfaces
            else:
                out.indirect += wp.cw_mul(throughput, from_lights + from_surfaces)

        v = sobol.sample_2d(scene.sobol, index, 4 * depth + 3, scramble)
        compensation = compensate(scene, x, v, bound)
        emitted = wp.cw_mul(throughput, compensation.emitted) * wp.pi
        if depth == 0:
            out.direct += emitted
        else:
            out.indirect += emitted
        if compensation.clamped <= 0.0:
            break
        throughput = wp.cw_mul(throughput, albedo(scene, compensation.hit, scene.footprint)) * compensation.clamped
        if depth > _ROULETTE_DEPTH:
            survival = wp.min(wp.max(throughput), 0.99)
            if wp.frac(v[0] * 1024.0) >= survival:  # low digits of v are independent of the direction
                break
            throughput = throughput / survival
        x = shading_point(scene, compensation.hit)
        rays = settings.compensation_rays
        depth += 1
    return out


@wp.kernel(module="warp_ir.vpl.emission", cuda_max_registers=MAX_REGISTERS)  # reuses functions compiled there
def _gather_pixels(
    first: int,
    scene: SceneData,
    gbuffer: GBuffer,
    vpl_sets: wp.array[VplSets],
    settings: GatherSettings,
    wave: Wave,
) -> None:
    """Computes the irradiance over π, direct and indirect, of one pixel; or of one whose path continues in a wave.

    There the light at the camera vertex has been gathered already.
    """
    i = first + wp.tid()
    pixel = int(-1)
    gathered = Irradiance()
    if wave.size == 0:
        pixel = reflecting_pixel(gbuffer, i)
    elif i < continuing_paths(wave):
        i = wave.paths[i]
        pixel = wave_pixel(gbuffer, wave, i)
        gathered.direct = wave.irradiance[i]
        gathered.indirect = wave.irradiance[wave.size + i]
    if pixel < 0:
        return
    index = sample_index(settings, gbuffer, pixel)
    x = lit_vertex(settings, gbuffer, pixel)
    irradiance = gather_path(scene, vpl_sets, settings, x, index, wave.size > 0, gathered)
    gbuffer.normal_or_direct[pixel] = irradiance.direct / wp.pi
    gbuffer.indirect[pixel] = irradiance.indirect / wp.pi


class VplEstimator:
    """VPLs with resampled visibility, bounded and compensated; light paths are guided."""

    MODULES: ClassVar[Sequence[ModuleType]] = (warp_ir.gbuffer, warp_ir.vpl.emission, warp_ir.vpl.sets)
    WAVEFRONT_MODULES: ClassVar[Sequence[ModuleType]] = (wavefront,)

    def __init__(self, scene: DeviceScene, camera: CameraData, settings: ResolvedSettings, scratch: Scratch) -> None:
        """Prepares for a scene, a `CameraData` and settings; what an iteration overwrites lies in `scratch`."""
        self._scene, self._camera, self._settings = scene, camera, settings
        self._scratch, self._launcher = scratch, scratch.launcher
        self._unguided = unguided(scene, scratch.launcher)
        self._at_hand: tuple[int, wp.array[VplSets] | None] = -1, None
        """The iteration, if any, whose VPLs are where those of the next are to be, and these VPLs."""
        self._guide: Guide | None = None
        """The guide, once it has been learned."""
        guiding = settings.guiding
        self._first_guided = math.inf if guiding is None or not scene.emits else guiding.first_iteration

    def prepare(self, iteration: int) -> Guide:
        """Uploads the numbers of an iteration, and learns the guide when it is first needed: the result."""
        scramble = sobol.iteration_scramble(self._settings.seed, iteration)
        self._scramble = self._scratch.number("scramble", scramble, wp.uint32)
        self._iteration = self._scratch.number("iteration", iteration, wp.int32)
        guide = self._guide_of(iteration)
        # An iteration whose VPLs are at hand launches less than others: another record says that it is not like them.
        return replace(guide) if iteration == self._at_hand[0] else guide

    def _vpls_of(self, iteration: int, guide: Guide) -> "wp.array[VplSets]":
        """The VPLs of an iteration, arranged in sets."""
        settings = self._settings
        with self._launcher.phase("emission"):
            vpls = emit_vpls(
                guide,
                self._scratch,
                light_paths=settings.light_paths,
                absorption=settings.absorption,
                max_bounces=settings.max_bounces,
                scramble=sobol.iteration_scramble(settings.seed, iteration),
            )
            return build_sets(vpls, guide, self._scratch)

    def estimate(self, iteration: int, gbuffer: GBuffer) -> None:
        """Fills the G-buffer, direct and indirect irradiance included, for one iteration."""
        settings, launcher = self._settings, self._launcher
        guide = self.prepare(iteration)

        def trace_camera() -> None:
            trace_primary(self._scene, self._camera, launcher, gbuffer, iteration=self._iteration, seed=settings.seed)

        with launcher.overlap("primary", trace_camera):
            if iteration == self._at_hand[0]:
                vpl_sets = self._at_hand[1]
            else:
                vpl_sets = self._vpls_of(iteration, guide)
            self._at_hand = -1, None
        gathering = GatherSettings()
        gathering.first_column, gathering.first_row = self._camera.first_column, self._camera.first_row
        gathering.scramble = self._scramble
        gathering.rays, gathering.compensation_rays = wp.vec2i(*SHADOW_RAYS), wp.vec2i(*COMPENSATION_SHADOW_RAYS)
        gathering.max_bounces, gathering.visibility = settings.max_bounces, guide.visibility
        with launcher.phase("gather"):
            inputs = [guide.scene.data, gbuffer, vpl_sets, gathering]
            if launcher.wavefront:
                gather_in_waves(_gather_pixels, inputs, self._scratch)
            else:
                launcher.launch(_gather_pixels, indices(gbuffer.tiles), [*inputs, Wave()])

    def _guide_of(self, iteration: int) -> Guide:
        """The guide of an iteration's light paths; it is learned when it is first needed."""
        if iteration < self._first_guided:
            return self._unguided
        if self._guide is None:
            with self._launcher.phase("guiding"):
                guide = learn(self._scene, self._camera, self._launcher, self._settings)
            if guide.visibility.columns > 0:
                # Those of one iteration, which is often the present one, so that others learn the same.
                vpl_sets = self._vpls_of(self._first_guided, guide)
                self._at_hand = self._first_guided, vpl_sets
                with self._launcher.phase("guiding"):
                    learn_visibility(guide, self._camera, self._launcher, vpl_sets, self._settings.seed)
            self._guide = guide
        return self._guide
