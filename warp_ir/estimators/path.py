"""Path tracing, the independent second opinion: one path per pixel and iteration, from the camera.

At every vertex one light is sampled (next-event estimation), and the direction in which the path continues may hit an
emitter as well; multiple importance sampling weighs the two by the power heuristic (Veach 1997). Paths end by Russian
roulette on the local albedo. The estimator shares ray queries and scene tables with the VPLs, but no light transport.

Shading normals count where the camera sees a surface, geometric normals where light is reflected between surfaces, as
for the VPLs: so energy is conserved, and both compute the same integral.
"""

import sys
from collections.abc import Sequence
from types import ModuleType
from typing import ClassVar

import warp as wp

import warp_ir.gbuffer
from warp_ir.device.launcher import MAX_REGISTERS
from warp_ir.device.scratch import Scratch
from warp_ir.device_scene import CameraData, DeviceScene, SceneData
from warp_ir.gbuffer import GBuffer, image_pixel, reflecting_pixel, trace_primary
from warp_ir.lights import (
    DirectSample,
    intersect_lights,
    light_visibility,
    power_heuristic,
    sample_direct,
    surface_emission_mis,
)
from warp_ir.sampling import sobol
from warp_ir.sampling.square_to import square_to_cosine_hemisphere
from warp_ir.settings import ResolvedSettings
from warp_ir.surface import albedo, closest
from warp_ir.tiles import indices

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_MAX_SURVIVAL = wp.constant(0.999)


@wp.func
def _reflected(
    scene: SceneData,
    position: wp.vec3,
    normal: wp.vec3,
    shading_normal: wp.vec3,
    mesh: int,
    from_camera: bool,
    light: DirectSample,
) -> wp.vec3:
    """The MIS-weighted irradiance over π at a point from one sample of the lights."""
    at_point = wp.dot(shading_normal, light.direction)
    if at_point <= 0.0 or wp.max(light.radiance) <= 0.0 or wp.dot(normal, light.direction) <= 0.0:
        return wp.vec3(0.0)
    visibility = light_visibility(scene, light.modifier_row, position, mesh, from_camera, light.target)
    if wp.max(visibility) <= 0.0:
        return wp.vec3(0.0)
    # A light without a pdf, such as a point light, is found by no ray: its sample has weight 1.
    bsdf_pdf = at_point / wp.pi
    weight = float(1.0)
    if light.pdf > 0.0:
        weight = power_heuristic(light.pdf, bsdf_pdf)
    return wp.cw_mul(light.radiance, visibility) * (weight * bsdf_pdf)


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _trace_paths(
    first: int,
    scene: SceneData,
    camera: CameraData,
    gbuffer: GBuffer,
    scramble: wp.uint32,
    max_bounces: int,
) -> None:
    """Traces one path that begins at what the camera sees at a pixel."""
    pixel = reflecting_pixel(gbuffer, first + wp.tid())
    if pixel < 0:
        return
    direct = wp.vec3(0.0)
    indirect = wp.vec3(0.0)
    stream = sobol.hash_combine(scramble, wp.uint32(image_pixel(camera, pixel)))
    position = gbuffer.position[pixel]
    normal = gbuffer.normal_or_direct[pixel]
    shading_normal = gbuffer.shading_normal[pixel]
    mesh = gbuffer.mesh[pixel]
    # Without the reflection at the pixel itself, which the film multiplies by.
    throughput = wp.vec3(wp.where(scene.emitter_count > 0, 1.0, 0.0))
    bounce = int(0)  # reflections after the first
    dimension = int(0)
    while wp.max(throughput) > 0.0:
        u = sobol.sample_1d(scene.sobol, 0, dimension, stream)
        u2 = sobol.sample_2d(scene.sobol, 0, dimension + 1, stream)
        light = sample_direct(scene, position, u, u2)
        reflected = _reflected(scene, position, normal, shading_normal, mesh, bounce == 0, light)
        radiance = wp.cw_mul(throughput, reflected)

        # The next direction: emission that it meets counts here; the surface that it hits is the next vertex.
        u2 = sobol.sample_2d(scene.sobol, 0, dimension + 3, stream)
        direction = square_to_cosine_hemisphere(u2, shading_normal)
        above = wp.dot(direction, normal) > 0.0
        pdf = wp.max(wp.dot(direction, shading_normal), 1.0e-20) / wp.pi
        hit = closest(scene, position, direction, 3.0e38)
        if above:
            t_max = wp.where(hit.triangle < 0, 3.0e38, hit.t)
            emitted = intersect_lights(scene, position, direction, t_max, hit.triangle < 0, pdf, mesh)
            if hit.triangle >= 0:
                emitted += surface_emission_mis(scene, hit, direction, pdf, mesh)
            radiance += wp.cw_mul(throughput, emitted)
        if bounce == 0:
            direct += radiance
        else:
            indirect += radiance

        bounce += 1
        if bounce > max_bounces or hit.triangle < 0 or not above:
            break
        rho = albedo(scene, hit, scene.footprint)
        survival = wp.min(wp.max(rho), _MAX_SURVIVAL)
        if sobol.sample_1d(scene.sobol, 0, dimension + 5, stream) >= survival:
            break
        throughput = wp.cw_mul(throughput, rho) / survival
        position = hit.position
        normal = hit.normal
        shading_normal = hit.normal
        mesh = scene.triangle_mesh[hit.triangle]
        dimension += 6
    gbuffer.normal_or_direct[pixel] = direct
    gbuffer.indirect[pixel] = indirect


class PathTracer:
    """Unidirectional path tracing with next-event estimation."""

    MODULES: ClassVar[Sequence[ModuleType]] = (warp_ir.gbuffer, sys.modules[__name__])

    def __init__(self, scene: DeviceScene, camera: CameraData, settings: ResolvedSettings, scratch: Scratch) -> None:
        """Prepares for a scene, a `CameraData` and settings; what an iteration overwrites lies in `scratch`."""
        self._scene, self._camera, self._settings = scene, camera, settings
        self._scratch, self._launcher = scratch, scratch.launcher

    def estimate(self, iteration: int, gbuffer: GBuffer) -> None:
        """Fills the G-buffer, direct and indirect irradiance included, for one iteration."""
        settings, launcher = self._settings, self._launcher
        with launcher.phase("primary"):
            trace_primary(self._scene, self._camera, launcher, gbuffer, iteration=iteration, seed=settings.seed)
        with launcher.phase("gather"):
            launcher.launch(
                _trace_paths,
                indices(gbuffer.tiles),
                [
                    self._scene.data,
                    self._camera,
                    gbuffer,
                    wp.uint32(sobol.iteration_scramble(settings.seed, iteration)),
                    settings.max_bounces,
                ],
            )
