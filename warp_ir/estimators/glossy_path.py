"""Path tracing where surfaces reflect by direction (`bsdf/reflection.py`).

As in `path.py`, every vertex samples one light, and the sampled direction may hit an emitter as well. A mirror samples
no light: what its direction hits counts in full. Shading normals count where the camera sees a surface, directly or by
reflections in gloss and mirrors, geometric normals at all vertices after a diffuse reflection.
"""

import sys
from collections.abc import Sequence
from types import ModuleType
from typing import ClassVar

import warp as wp

import warp_ir.gbuffer
from warp_ir.bsdf import Bsdf, BsdfSample, bsdf_pdf, directional_albedo, evaluate, sample_bsdf
from warp_ir.device.launcher import MAX_REGISTERS
from warp_ir.device_scene import CameraData, SceneData
from warp_ir.estimators.path import PathTracer, emission_along, survival
from warp_ir.gbuffer import GBuffer, camera_ray, first_hit, image_pixel, jitter, lens_point, pixel_width, vertex_of_hit
from warp_ir.lights import light_visibility, power_heuristic, sample_direct
from warp_ir.sampling import sobol
from warp_ir.sampling.square_to import from_local, to_local
from warp_ir.surface import (
    Hit,
    ShadingPoint,
    bsdf_at,
    closest,
    geometry_term_of_hit,
    is_below,
    mapped_normal,
    scene_at,
    shading_point,
    shadow_ray_origin,
)
from warp_ir.tiles import indices, pixel_at, skipped_iterations

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_LEAST_COSINE = wp.constant(1.0e-3)  # of the view to a shading normal, which is turned until then
_DIMENSIONS = wp.constant(8)  # of the sequence, for a vertex


@wp.struct
class _Vertex:
    """A point of a path, and how it reflects."""

    x: ShadingPoint
    bsdf: Bsdf
    to_eye: wp.vec3  # in the frame of the shading normal


@wp.func
def _vertex(scene: SceneData, hit: Hit, direction: wp.vec3, smooth: bool, footprint: float) -> _Vertex:
    """What a ray in a unit direction hits; `smooth`: by its shading normal, as the camera sees it."""
    out = _Vertex()
    out.x = shading_point(scene, hit)
    if smooth:
        out.x = vertex_of_hit(scene, hit)
        out.x.shading_normal = mapped_normal(scene, hit, out.x.shading_normal, footprint)
    # A normal that is turned away from the eye would reflect nothing to it.
    cosine = -wp.dot(out.x.shading_normal, direction)
    if cosine < _LEAST_COSINE:
        out.x.shading_normal = wp.normalize(out.x.shading_normal + direction * (cosine - _LEAST_COSINE))
    out.to_eye = to_local(-direction, out.x.shading_normal)
    out.bsdf = bsdf_at(scene.address, hit, footprint)
    return out


@wp.func(inline=False)
def _reflected_light(address: wp.uint64, v: _Vertex, u: float, u2: wp.vec2) -> wp.vec3:
    """MIS-weighted radiance reflected to the eye, from one sample of the lights."""
    scene = scene_at(address)[0]
    table = scene.surface_textures[0].gloss.albedo
    light = sample_direct(scene, v.x.position, u, u2)
    if wp.max(light.radiance) <= 0.0 or wp.dot(v.x.normal, light.direction) <= 0.0:
        return wp.vec3(0.0)
    to_light = to_local(light.direction, v.x.shading_normal)
    reflected = evaluate(v.bsdf, table, to_light, v.to_eye) * to_light[2]
    if wp.max(reflected) <= 0.0:
        return wp.vec3(0.0)
    visibility = light_visibility(scene, light.modifier_row, v.x, light.target)
    if wp.max(visibility) <= 0.0:
        return wp.vec3(0.0)
    weight = float(1.0)
    if light.pdf > 0.0 and not is_below(v.x, light.direction):
        weight = power_heuristic(light.pdf, bsdf_pdf(v.bsdf, table, to_light, v.to_eye))
    return wp.cw_mul(wp.cw_mul(light.radiance, visibility), reflected) * weight


@wp.func(inline=False)
def _next_direction(address: wp.uint64, v: _Vertex, u_lobe: float, u2: wp.vec2) -> BsdfSample:
    """A sampled direction in world space; (0, 0, 0): the path ends."""
    table = scene_at(address)[0].surface_textures[0].gloss.albedo
    sample = sample_bsdf(v.bsdf, table, v.to_eye, u_lobe, u2)
    if wp.length_sq(sample.direction) == 0.0:
        return sample
    direction = wp.normalize(from_local(sample.direction, v.x.shading_normal))
    sample.direction = direction
    if sample.pdf < 0.0:
        # A mirror's normal is bent until what it reflects is above the triangle.
        below = wp.dot(direction, v.x.geometric_normal) - _LEAST_COSINE
        if below < 0.0:
            sample.direction = wp.normalize(direction - v.x.geometric_normal * below)
    elif wp.dot(direction, v.x.normal) <= 0.0:
        sample.direction = wp.vec3(0.0)
    return sample


@wp.func(inline=False)
def _emission_of_ray(
    address: wp.uint64, x: ShadingPoint, origin: wp.vec3, direction: wp.vec3, hit: Hit, pdf: float
) -> wp.vec3:
    """MIS-weighted emission that a ray meets; `pdf` is -1 for a ray that only a mirror can send."""
    return emission_along(scene_at(address)[0], x, origin, direction, hit, pdf, 0.0)


@wp.func
def _over(a: wp.vec3, b: wp.vec3) -> wp.vec3:
    """A / b for each channel; 0 where b is 0."""
    tiny = 1.0e-30
    return wp.vec3(a[0] / wp.max(b[0], tiny), a[1] / wp.max(b[1], tiny), a[2] / wp.max(b[2], tiny))


@wp.func
def _part_of(sample: BsdfSample, smooth: bool, probability: float) -> wp.vec3:
    """The factor of the throughput that selects what the base reflects, or what is reflected above it."""
    part = wp.where(smooth, sample.weight - sample.diffuse, sample.diffuse)
    return _over(part, sample.weight * probability)


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _trace_glossy_paths(
    first: int,
    scene: SceneData,
    camera: CameraData,
    gbuffer: GBuffer,
    iteration: wp.array[wp.int32],
    seed: wp.uint32,
    scramble: wp.array[wp.uint32],
    max_bounces: int,
) -> None:
    """Traces one path from a pixel; its first ray is that of the G-buffer, whose albedo is replaced by the view's."""
    index = first + wp.tid()
    pixel = pixel_at(gbuffer.tiles, index)
    if pixel < 0:
        return
    direct = wp.vec3(0.0)
    indirect = wp.vec3(0.0)
    albedo = wp.vec3(1.0)
    if gbuffer.mesh[pixel] >= 0:
        sample = iteration[0] - skipped_iterations(gbuffer.tiles, index)
        lens = lens_point(scene, camera, pixel, sample, seed)
        ray = camera_ray(camera, pixel, jitter(scene, camera, pixel, sample, seed), lens)
        hit = first_hit(scene, camera, ray)
        direction = wp.normalize(ray.direction)
        stream = sobol.hash_combine(scramble[0], wp.uint32(image_pixel(camera, pixel)))
        throughput = wp.vec3(wp.where(scene.emitter_count > 0 and hit.triangle >= 0, 1.0, 0.0))
        bounce = int(0)
        dimension = int(0)
        smooth = bool(True)
        footprint = pixel_width(camera, gbuffer.depth[pixel])
        while wp.max(throughput) > 0.0:
            v = _vertex(scene, hit, direction, smooth, footprint)
            if bounce == 0:
                albedo = wp.max(
                    directional_albedo(v.bsdf, scene.surface_textures[0].gloss.albedo, v.to_eye[2]), wp.vec3(1.0e-6)
                )
            u = sobol.sample_1d(scene.sobol, 0, dimension, stream)
            u2 = sobol.sample_2d(scene.sobol, 0, dimension + 1, stream)
            radiance = wp.cw_mul(throughput, _reflected_light(scene.address, v, u, u2))

            u = sobol.sample_1d(scene.sobol, 0, dimension + 5, stream)
            u2 = sobol.sample_2d(scene.sobol, 0, dimension + 3, stream)
            next = _next_direction(scene.address, v, u, u2)
            direction = next.direction
            goes_on = wp.length_sq(direction) > 0.0
            if goes_on:
                throughput = wp.cw_mul(throughput, next.weight)
                origin = shadow_ray_origin(v.x, wp.vec4(direction[0], direction[1], direction[2], 0.0))
                hit = closest(scene, origin, direction, 3.0e38)
                if not is_below(v.x, direction):
                    emitted = _emission_of_ray(scene.address, v.x, origin, direction, hit, next.pdf)
                    radiance += wp.cw_mul(throughput, emitted)
            if bounce == 0:
                direct += radiance
            else:
                indirect += radiance
            bounce += 1
            if not goes_on or bounce > max_bounces or hit.triangle < 0:
                break
            throughput = throughput * geometry_term_of_hit(v.x, direction, hit)[1]
            if smooth and next.pdf >= 0.0:
                # Light that gloss reflects is followed by shading normals, light that the base reflects is not.
                share = wp.clamp(wp.dot(next.diffuse, wp.vec3(1.0)) / wp.dot(next.weight, wp.vec3(1.0)), 0.0, 1.0)
                smooth = sobol.sample_1d(scene.sobol, 0, dimension + 7, stream) >= share
                part = _part_of(next, smooth, wp.where(smooth, 1.0 - share, share))
                throughput = wp.cw_mul(throughput, part)
            lives = survival(throughput)
            if sobol.sample_1d(scene.sobol, 0, dimension + 6, stream) >= lives:
                break
            throughput = throughput / lives
            footprint = scene.footprint
            dimension += _DIMENSIONS
    gbuffer.albedo[pixel] = albedo
    gbuffer.normal_or_direct[pixel] = _over(direct, albedo)
    gbuffer.indirect[pixel] = _over(indirect, albedo)


class GlossyPathTracer(PathTracer):
    """Path tracing of scenes with gloss."""

    MODULES: ClassVar[Sequence[ModuleType]] = (warp_ir.gbuffer, sys.modules[__name__])

    def _trace_paths(self, gbuffer: GBuffer) -> None:
        """Traces a path from every pixel; irradiance is over the albedo of the view, which replaces the albedo."""
        scene, settings = self._scene.data, self._settings
        numbers = self._iteration, wp.uint32(settings.seed), self._scramble, settings.max_bounces
        self._launcher.launch(_trace_glossy_paths, indices(gbuffer.tiles), [scene, self._camera, gbuffer, *numbers])
