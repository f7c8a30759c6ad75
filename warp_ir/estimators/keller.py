"""Instant radiosity as published (Keller 1997, "Instant Radiosity", SIGGRAPH).

The radiance that a surface point x sends to the eye is what it emits plus the light of the whole Neumann
series, reflected once more: L = Le + R Le + R² Le + ... Sample that series *once*: start N light paths on the
lights, and keep every vertex y_k as a virtual point light of intensity I_k. Then for every visible point

    L(x) = Le(x) + ρ(x)/π · Σ_k I_k G(x, y_k) V(x, y_k),      G = cos⁺θ_x cos⁺θ_y / |x - y|²

In the paper the sum is N pictures, each rendered by graphics hardware with one point light and its shadows,
added in the accumulation buffer. Here it is a loop over the VPLs at every pixel, with a shadow ray for V.

Paths need not be killed one by one: of N, the first ⌊ρ̄ʲN⌋ are reflected j times, ρ̄ being the scene's
mean reflectivity (fractional absorption), which keeps their low-discrepancy points in order. Every iteration
jitters the camera rays and renews the VPLs; the picture is the mean of the iterations.

Nothing here is clever, and that is the point: it is the page to read first, and the baseline to beat.
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
from warp_ir.gbuffer import GBuffer, trace_primary
from warp_ir.lights import light_visibility
from warp_ir.sampling.sobol import iteration_scramble
from warp_ir.settings import ResolvedSettings
from warp_ir.tiles import indices, pixel_at
from warp_ir.vpl.emission import VplBuffer, emit_vpls
from warp_ir.vpl.guide import unguided

wp.set_module_options({"enable_backward": False, "max_unroll": 0})


@wp.func
def geometry_term(
    position: wp.vec3, normal: wp.vec3, shading_normal: wp.vec3, vpl_position: wp.vec4, vpl_normal: wp.vec4
) -> float:
    """G between a surface point and a VPL; for a directional one (w = 0), the cosine at the point alone."""
    xyz = wp.vec3(vpl_position[0], vpl_position[1], vpl_position[2])
    to_vpl = xyz - position * vpl_position[3]
    squared = wp.dot(to_vpl, to_vpl)
    direction = to_vpl / wp.sqrt(squared)
    if wp.dot(normal, direction) <= 0.0:
        return 0.0  # behind the surface, whatever the interpolated normal says
    at_point = wp.max(0.0, wp.dot(shading_normal, direction))
    vpl_facing = wp.vec3(vpl_normal[0], vpl_normal[1], vpl_normal[2])
    at_vpl = wp.max(0.0, vpl_normal[3] - wp.dot(vpl_facing, direction))
    return at_point * at_vpl / squared


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _accumulate(
    first: int,
    scene: SceneData,
    gbuffer: GBuffer,
    vpls: VplBuffer,
    bound: float,
) -> None:
    """E/π = 1/π Σ I min(G, bound) V, the VPLs on the lights (bounce 0) apart from the others; ρ is the film's."""
    pixel = pixel_at(gbuffer.tiles, first + wp.tid())
    if pixel < 0:
        return
    from_lights = wp.vec3(0.0)
    from_surfaces = wp.vec3(0.0)
    if gbuffer.mesh[pixel] >= 0 and wp.max(gbuffer.albedo[pixel]) > 0.0:
        position = gbuffer.position[pixel]
        for k in range(vpls.count[0]):
            g = geometry_term(
                position,
                gbuffer.normal_or_direct[pixel],
                gbuffer.shading_normal[pixel],
                vpls.position[k],
                vpls.normal[k],
            )
            if g > 0.0:
                modifiers = int(-1)
                if scene.modifier_count > 0 and k < vpls.on_lights:
                    modifiers = vpls.modifiers[k]
                # V, unless the light is shaped or linked.
                arrives = light_visibility(scene, modifiers, position, gbuffer.mesh[pixel], True, vpls.position[k])
                irradiance = wp.cw_mul(vpls.intensity[k], arrives) * wp.min(g, bound)
                if vpls.bounce[k] == 0:
                    from_lights += irradiance
                else:
                    from_surfaces += irradiance
    gbuffer.normal_or_direct[pixel] = from_lights / wp.pi
    gbuffer.indirect[pixel] = from_surfaces / wp.pi


class Keller:
    """Every VPL, every shadow ray."""

    MODULES: ClassVar[Sequence[ModuleType]] = (warp_ir.gbuffer, warp_ir.vpl.emission, sys.modules[__name__])

    def __init__(self, scene: DeviceScene, camera: CameraData, settings: ResolvedSettings, scratch: Scratch) -> None:
        """Prepares for a scene, a `CameraData` and settings; what an iteration overwrites lies in `scratch`."""
        self._scene, self._camera, self._settings = scene, camera, settings
        self._scratch, self._launcher = scratch, scratch.launcher
        self._unguided = unguided(scene, scratch.launcher)
        radius = settings.bound_radius * scene.extent
        self._bound = 1.0 / radius**2 if radius > 0.0 else 3.0e38

    def estimate(self, iteration: int, gbuffer: GBuffer) -> None:
        """Fills the G-buffer, direct and indirect irradiance included, for one iteration."""
        settings, launcher = self._settings, self._launcher
        with launcher.phase("primary"):
            trace_primary(self._scene, self._camera, launcher, gbuffer, iteration=iteration, seed=settings.seed)
        with launcher.phase("emission"):
            vpls = emit_vpls(
                self._unguided,
                self._scratch,
                paths=settings.light_paths,
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
