"""Path tracing, the independent truth: from the eye, one path per pixel and iteration.

At every vertex the lights are sampled once (next-event estimation), and the direction in which the path goes
on may hit one as well; the two are weighted by the power heuristic (Veach 1997). Paths end by Russian
roulette on the local albedo. It shares ray queries and scene tables with the VPLs, and no transport.

Surfaces are shaded with interpolated normals where the camera sees them, and with the triangles' own
where light bounces between them, as the VPLs do: so energy is conserved and both compute the same integral.
"""

from typing import Any

import warp as wp

from warp_ir.device.launcher import MAX_REGISTERS, Launcher
from warp_ir.device_scene import CameraData, DeviceScene, SceneData
from warp_ir.gbuffer import GBuffer, image_pixel, trace_primary
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
from warp_ir.settings import RenderSettings
from warp_ir.surface import albedo, closest
from warp_ir.tiles import indices, pixel_at

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_MAX_SURVIVAL = wp.constant(0.999)


@wp.func
def _reflected(
    scene: SceneData,
    position: wp.vec3,
    normal: wp.vec3,
    shading_normal: wp.vec3,
    mesh: int,
    seen: bool,
    light: DirectSample,
) -> wp.vec3:
    """Weighted irradiance over π at a point from one sample of the lights."""
    at_point = wp.dot(shading_normal, light.direction)
    if at_point <= 0.0 or wp.max(light.radiance) <= 0.0 or wp.dot(normal, light.direction) <= 0.0:
        return wp.vec3(0.0)
    arrives = light_visibility(scene, light.modifier_row, position, mesh, seen, light.target)
    if wp.max(arrives) <= 0.0:
        return wp.vec3(0.0)
    # The two ways to find this light are weighted by their densities; a delta light has only one (density 0).
    by_bsdf = at_point / wp.pi
    weight = float(1.0)
    if light.pdf > 0.0:
        weight = power_heuristic(light.pdf, by_bsdf)
    return wp.cw_mul(light.radiance, arrives) * (weight * by_bsdf)


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _trace_paths(
    first: int,
    scene: SceneData,
    camera: CameraData,
    gbuffer: GBuffer,
    scramble: wp.uint32,
    max_bounces: int,
    direct: wp.array[wp.vec3],
    indirect: wp.array[wp.vec3],
) -> None:
    """Follows one path from what the camera sees at a pixel."""
    pixel = pixel_at(gbuffer.tiles, first + wp.tid())
    if pixel < 0:
        return
    once = wp.vec3(0.0)
    more = wp.vec3(0.0)
    if gbuffer.mesh[pixel] >= 0 and wp.max(gbuffer.albedo[pixel]) > 0.0 and scene.emitter_count > 0:
        stream = sobol.hash_combine(scramble, wp.uint32(image_pixel(camera, pixel)))
        position = gbuffer.position[pixel]
        normal = gbuffer.normal[pixel]
        shading_normal = gbuffer.shading_normal[pixel]
        mesh = gbuffer.mesh[pixel]
        throughput = wp.vec3(1.0)  # after the reflection at the pixel, which is the film's
        bounce = int(0)  # reflections between this vertex's light and the camera, less one
        dimension = int(0)
        while wp.max(throughput) > 0.0:
            u = sobol.sample_1d(scene.sobol, 0, dimension, stream)
            u2 = sobol.sample_2d(scene.sobol, 0, dimension + 1, stream)
            light = sample_direct(scene, position, u, u2)
            lit = _reflected(scene, position, normal, shading_normal, mesh, bounce == 0, light)
            found = wp.cw_mul(throughput, lit)

            # The way on: lights it meets count here, the surface it meets is the next vertex.
            u2 = sobol.sample_2d(scene.sobol, 0, dimension + 3, stream)
            direction = square_to_cosine_hemisphere(u2, shading_normal)
            above = wp.dot(direction, normal) > 0.0
            pdf = wp.max(wp.dot(direction, shading_normal), 1.0e-20) / wp.pi
            hit = closest(scene, position, direction, 3.0e38)
            if above:
                reach = wp.where(hit.triangle < 0, 3.0e38, hit.t)
                seen = intersect_lights(scene, position, direction, reach, hit.triangle < 0, pdf, mesh)
                if hit.triangle >= 0:
                    seen += surface_emission_mis(scene, hit, direction, pdf, mesh)
                found += wp.cw_mul(throughput, seen)
            if bounce == 0:
                once += found
            else:
                more += found

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
    direct[pixel] = once
    indirect[pixel] = more


class PathTracer:
    """Unidirectional path tracing with next-event estimation."""

    def __init__(self, scene: DeviceScene, camera: Any, settings: RenderSettings, launcher: Launcher) -> None:
        """Prepares for a scene, a `CameraData` and settings with a definite width and height."""
        self._scene, self._camera, self._settings, self._launcher = scene, camera, settings, launcher

    def estimate(self, iteration: int, gbuffer: Any, direct: Any, indirect: Any) -> None:
        """Fills the G-buffer and the two irradiances over π, one row per pixel, for one iteration."""
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
                    settings.bounce_limit,
                    direct,
                    indirect,
                ],
            )
