"""Path tracing, the independent second opinion: one path per pixel and iteration, from the camera.

At every vertex one light is sampled (next-event estimation), and the direction in which the path continues may hit an
emitter as well; multiple importance sampling weighs the two by the power heuristic (Veach 1997). Paths that carry less
than a quarter of what they began with end by Russian roulette.

Camera paths hardly ever hit the spot that a small light makes on a wall next to it, and their noise does not tell.
Where a path's last segments, next to the light, are all less than a quarter of the segment before them, light paths
from the emitter take the place of camera paths. Apart from that, the estimator shares ray queries and scene tables with
the VPLs, but no light transport.

Shading normals count where the camera sees a surface, geometric normals where light is reflected between surfaces, as
for the VPLs: so energy is conserved, and both compute the same integral.
"""

import math
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import ClassVar

import numpy as np
import warp as wp

import warp_ir.gbuffer
from warp_ir.device.launcher import MAX_REGISTERS
from warp_ir.device.scratch import Scratch
from warp_ir.device_scene import CameraData, DeviceScene, SceneData
from warp_ir.gbuffer import GBuffer, camera_vertex, image_pixel, reflecting_pixel, trace_primary
from warp_ir.lights import (
    DirectSample,
    PhotonTarget,
    emit_photon,
    first_reflection,
    intersect_lights,
    light_visibility,
    power_heuristic,
    sample_direct,
    sample_light,
    surface_emission_mis,
)
from warp_ir.sampling import sobol
from warp_ir.sampling.square_to import square_to_cosine_hemisphere
from warp_ir.scene import LightKind, Scene
from warp_ir.settings import ResolvedSettings
from warp_ir.surface import (
    Hit,
    ShadingPoint,
    albedo,
    closest,
    geometry_term_of_hit,
    is_below,
    scene_at,
    shading_point,
    shadow_ray_origin,
    visible,
)
from warp_ir.tiles import indices

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_MAX_SURVIVAL = wp.constant(0.999)
_ROULETTE_THROUGHPUT = wp.constant(0.25)  # paths that carry more go on: ending them would cost more noise than time
_SPOT_DISTANCE = wp.constant(4.0)  # least distance to a spot, in lengths of the longest segment from the light to it
_SPOT_STREAM = wp.constant(wp.uint32(0x3C6EF372))  # decorrelates the light paths of spots from the camera paths
_SMALL = 1.0 / 32.0
"""Size of the largest emitter, as a fraction of the scene's extent, whose spots are sampled by light paths."""


@wp.func
def _reflected(scene: SceneData, x: ShadingPoint, light: DirectSample) -> wp.vec3:
    """The MIS-weighted irradiance over π at a point from one sample of the lights."""
    at_point = wp.dot(x.shading_normal, light.direction)
    if at_point <= 0.0 or wp.max(light.radiance) <= 0.0 or wp.dot(x.normal, light.direction) <= 0.0:
        return wp.vec3(0.0)
    visibility = light_visibility(scene, light.modifier_row, x, light.target)
    if wp.max(visibility) <= 0.0:
        return wp.vec3(0.0)
    # A light without a pdf, such as a point light, is hit by no ray: its sample has weight 1. So has any light below
    # the triangle's plane, where rays start at the smooth surface and meet lights in other places.
    bsdf_pdf = at_point / wp.pi
    weight = float(1.0)
    if light.pdf > 0.0 and not is_below(x, light.direction):
        weight = power_heuristic(light.pdf, bsdf_pdf)
    return wp.cw_mul(light.radiance, visibility) * (weight * bsdf_pdf)


@wp.func(inline=False)
def _light_of_spot(address: wp.uint64, x: ShadingPoint, stream: wp.uint32, max_reflections: int) -> wp.vec3:
    """Irradiance over π at a point from one light path, by the first of its spots that is small at that distance.

    A spot is where the path is reflected the k-th time; its size is the longest of the k segments from the light.
    """
    scene = scene_at(address)[0]
    u = sobol.sample_2d(scene.sobol, 0, 0, stream)
    light = sample_light(scene, sobol.sample_1d(scene.sobol, 0, 2, stream), u)
    irradiance = wp.vec3(0.0)
    if light.position[3] == 0.0:
        return irradiance
    photon = emit_photon(scene, light, PhotonTarget(), sobol.sample_2d(scene.sobol, 0, 3, stream), wp.vec2(0.0, 0.0))
    flux = photon.flux
    origin = photon.origin
    direction = photon.direction
    size = float(0.0)
    reflections = int(0)
    while reflections < max_reflections and wp.max(flux) > 0.0:
        dimension = 6 + 3 * reflections
        hit = closest(scene, origin, direction, 3.0e38)
        if reflections == 0 and light.modifier_row >= 0:
            u_mesh = sobol.sample_1d(scene.sobol, 0, 5, stream)
            landing = first_reflection(scene, light.modifier_row, hit, direction, u_mesh)
            hit = landing.hit
            flux = flux * landing.weight
        length = wp.length(hit.position - origin)
        if hit.triangle < 0 or (reflections > 0 and length > _SPOT_DISTANCE * size):
            break
        size = wp.max(size, length)
        if _SPOT_DISTANCE * size > 2.0 * scene.radius:
            break  # no point of the scene is far enough from this spot, nor from a later one
        rho = albedo(scene, hit, scene.footprint)
        to_spot = hit.position - x.position
        squared = wp.dot(to_spot, to_spot)
        cosines = wp.max(wp.dot(x.shading_normal, to_spot), 0.0) * wp.max(-wp.dot(hit.normal, to_spot), 0.0) / squared
        if squared > _SPOT_DISTANCE * size * _SPOT_DISTANCE * size and cosines > 0.0:
            target = wp.vec4(hit.position[0], hit.position[1], hit.position[2], 1.0)
            if wp.dot(x.normal, to_spot) > 0.0 and visible(scene, shadow_ray_origin(x, target), target):
                irradiance += wp.cw_mul(flux, rho) * (cosines / (squared * wp.pi * wp.pi))
        survival = wp.min(wp.max(rho), _MAX_SURVIVAL)
        if sobol.sample_1d(scene.sobol, 0, dimension + 2, stream) >= survival:
            break
        flux = wp.cw_mul(flux, rho) / survival
        origin = hit.position
        direction = square_to_cosine_hemisphere(sobol.sample_2d(scene.sobol, 0, dimension, stream), hit.normal)
        reflections += 1
    return irradiance


@wp.func
def survival(throughput: wp.vec3) -> float:
    """The probability with which Russian roulette lets a path go on."""
    return wp.min(wp.max(throughput) / _ROULETTE_THROUGHPUT, _MAX_SURVIVAL)


@wp.func
def emission_along(
    scene: SceneData, x: ShadingPoint, origin: wp.vec3, direction: wp.vec3, hit: Hit, pdf: float, nearest: float
) -> wp.vec3:
    """MIS-weighted emission that a ray meets, not nearer than `nearest`."""
    t_max = wp.where(hit.triangle < 0, 3.0e38, hit.t)
    emitted = intersect_lights(scene, origin, direction, t_max, hit.triangle < 0, pdf, x.mesh)
    if nearest > 0.0:
        emitted -= intersect_lights(scene, origin, direction, wp.min(t_max, nearest), False, pdf, x.mesh)
    if hit.triangle >= 0 and hit.t >= nearest:
        emitted += surface_emission_mis(scene, hit, direction, pdf, x.mesh)
    return emitted


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _trace_paths(
    first: int,
    scene: SceneData,
    camera: CameraData,
    gbuffer: GBuffer,
    scramble: wp.array[wp.uint32],
    max_bounces: int,
    has_spots: int,
) -> None:
    """Traces one path that begins at what the camera sees at a pixel; `has_spots` is 1 if emitters are small."""
    pixel = reflecting_pixel(gbuffer, first + wp.tid())
    if pixel < 0:
        return
    direct = wp.vec3(0.0)
    indirect = wp.vec3(0.0)
    stream = sobol.hash_combine(scramble[0], wp.uint32(image_pixel(camera, pixel)))
    x = camera_vertex(gbuffer, pixel)
    # Without the reflection at the pixel itself, which the film multiplies by.
    throughput = wp.vec3(wp.where(scene.emitter_count > 0, 1.0, 0.0))
    bounce = int(0)  # reflections after the first
    dimension = int(0)
    spot_distance = float(0.0)  # emitters that are nearer than this over _SPOT_DISTANCE light a spot
    while wp.max(throughput) > 0.0:
        u = sobol.sample_1d(scene.sobol, 0, dimension, stream)
        u2 = sobol.sample_2d(scene.sobol, 0, dimension + 1, stream)
        light = sample_direct(scene, x.position, u, u2)
        nearest = spot_distance / _SPOT_DISTANCE
        to_light = wp.vec3(light.target[0], light.target[1], light.target[2]) - x.position
        radiance = wp.vec3(0.0)
        if light.target[3] == 0.0 or wp.length(to_light) >= nearest:
            radiance = wp.cw_mul(throughput, _reflected(scene, x, light))
        if has_spots == 1 and bounce < max_bounces:
            spot_stream = sobol.hash_combine(stream ^ _SPOT_STREAM, wp.uint32(bounce))
            spot = _light_of_spot(scene.address, x, spot_stream, max_bounces - bounce)
            indirect += wp.cw_mul(throughput, spot)

        # The next direction: emission that it meets counts here; the surface that it hits is the next vertex.
        u2 = sobol.sample_2d(scene.sobol, 0, dimension + 3, stream)
        direction = square_to_cosine_hemisphere(u2, x.shading_normal)
        above = wp.dot(direction, x.normal) > 0.0
        pdf = wp.max(wp.dot(direction, x.shading_normal), 1.0e-20) / wp.pi
        origin = shadow_ray_origin(x, wp.vec4(direction[0], direction[1], direction[2], 0.0))
        hit = closest(scene, origin, direction, 3.0e38)
        if above and not is_below(x, direction):
            emitted = emission_along(scene, x, origin, direction, hit, pdf, nearest)
            radiance += wp.cw_mul(throughput, emitted)
        if bounce == 0:
            direct += radiance
        else:
            indirect += radiance

        bounce += 1
        if bounce > max_bounces or hit.triangle < 0 or not above:
            break
        rho = albedo(scene, hit, scene.footprint)
        throughput = wp.cw_mul(throughput, rho) * geometry_term_of_hit(x, direction, hit)[1]
        goes_on = survival(throughput)
        if sobol.sample_1d(scene.sobol, 0, dimension + 5, stream) >= goes_on:
            break
        throughput = throughput / goes_on
        if has_spots == 1:
            length = wp.length(hit.position - x.position)
            spot_distance = wp.max(length, wp.where(spot_distance > _SPOT_DISTANCE * length, spot_distance, 0.0))
        x = shading_point(scene, hit)
        dimension += 6
    gbuffer.normal_or_direct[pixel] = direct
    gbuffer.indirect[pixel] = indirect


def _has_small_emitters(scene: Scene) -> bool:
    """Whether any light or mesh that emits is a point, or smaller than `_SMALL` of the scene."""
    lower, upper = scene.bounds()
    largest = _SMALL * float(np.linalg.norm(upper - lower))
    for light in scene.lights:
        sizes = {
            LightKind.POINT: 0.0,
            LightKind.RECT: math.hypot(light.width, light.height),
            LightKind.DISK: 2.0 * light.radius,
            LightKind.SPHERE: 2.0 * light.radius,
            LightKind.CYLINDER: math.hypot(light.length, 2.0 * light.radius),
        }
        scale = float(np.linalg.norm(light.world_from_light[:3, :3], 2))
        if sizes.get(light.kind, math.inf) * scale < largest:
            return True
    emits = np.array([max(material.emission) > 0.0 for material in scene.materials], bool)
    return any(
        len(mesh.triangles) > 0 and emits[mesh.material].any() and np.linalg.norm(np.ptp(mesh.points, axis=0)) < largest
        for mesh in scene.meshes
    )


class PathTracer:
    """Path tracing with next-event estimation, unidirectional but for the spots of small lights."""

    MODULES: ClassVar[Sequence[ModuleType]] = (warp_ir.gbuffer, sys.modules[__name__])
    WAVEFRONT_MODULES: ClassVar[Sequence[ModuleType]] = ()

    def __init__(self, scene: DeviceScene, camera: CameraData, settings: ResolvedSettings, scratch: Scratch) -> None:
        """Prepares for a scene, a `CameraData` and settings; what an iteration overwrites lies in `scratch`."""
        self._scene, self._camera, self._settings = scene, camera, settings
        self._scratch, self._launcher = scratch, scratch.launcher
        self._has_spots = _has_small_emitters(scene.source)

    def prepare(self, iteration: int) -> object:
        """Uploads the numbers of an iteration."""
        scramble = sobol.iteration_scramble(self._settings.seed, iteration)
        self._scramble = self._scratch.number("scramble", scramble, wp.uint32)
        self._iteration = self._scratch.number("iteration", iteration, wp.int32)
        return self._scene

    def estimate(self, iteration: int, gbuffer: GBuffer) -> None:
        """Fills the G-buffer, direct and indirect irradiance included, for one iteration."""
        settings, launcher = self._settings, self._launcher
        self.prepare(iteration)
        with launcher.phase("primary"):
            trace_primary(self._scene, self._camera, launcher, gbuffer, iteration=self._iteration, seed=settings.seed)
        with launcher.phase("gather"):
            self._trace_paths(gbuffer)

    def _trace_paths(self, gbuffer: GBuffer) -> None:
        """Traces a path from every pixel of the G-buffer, for its irradiance."""
        spots = int(self._has_spots)
        arguments = [self._scene.data, self._camera, gbuffer, self._scramble, self._settings.max_bounces, spots]
        self._launcher.launch(_trace_paths, indices(gbuffer.tiles), arguments)
