"""Samples of irradiance on the pixels' surfaces: their sums, their means, and the variance of the means."""

from typing import Any

import warp as wp

from warp_ir.device.launcher import Launcher, copy_record
from warp_ir.device_scene import CameraData, DeviceScene
from warp_ir.gbuffer import GBuffer, trace_primary
from warp_ir.reconstruction.filter import IrradianceLayer, mean_channel, mean_channels
from warp_ir.reconstruction.pixel_surfaces import (
    MIN_MATCH,
    PixelSurfaces,
    match_weight,
    neighbor_pixel,
    neighborhood_shows,
    surfaces_differ,
)
from warp_ir.tiles import indices, pixel_at

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_VARIANCE_PRIOR = wp.constant(8.0)  # weight of the neighbours' variance, in samples of the pixel
_BRIGHTNESS_PRIOR = wp.constant(4.0)  # weight of the neighbours' mean in the expected brightness, likewise


@wp.struct
class SampleBuffer:
    """Sums over samples of irradiance over π, one row per pixel.

    Samples on a surface that the centre of no pixel nearby shows are unassigned, and stay at the pixel that traced
    them.
    """

    surfaces: PixelSurfaces
    direct: wp.array[wp.vec3]
    indirect: wp.array[wp.vec3]
    squares: wp.array[wp.vec2]  # of the mean channels of direct and indirect
    count: wp.array[wp.int32]
    variance: wp.array[wp.vec2]  # of one sample of the two mean channels; set only while a picture is made
    unassigned_direct: wp.array[wp.vec3]
    unassigned_indirect: wp.array[wp.vec3]
    unassigned_count: wp.array[wp.int32]
    seed: wp.uint32  # of the film
    scale: float  # factor from radiance to all of the above, so that squares neither overflow nor underflow


_NO_SUMS = ("surfaces", "variance", "seed", "scale")
"""Fields of `SampleBuffer` that are no sums over samples."""


@wp.kernel
def _store_pixel_surfaces(first: int, camera: CameraData, gbuffer: GBuffer, surfaces: PixelSurfaces) -> None:
    """Stores the surfaces of a G-buffer that was traced through the pixels' centres."""
    p = first + wp.tid()
    surfaces.footprint[p] = 0.0
    if gbuffer.mesh[p] >= 0:
        surfaces.position[p] = gbuffer.position[p]
        surfaces.normal[p] = gbuffer.smooth_normal[p]
        size = camera.height / float(camera.image_rows)
        surfaces.footprint[p] = size * wp.where(camera.orthographic == 1, 1.0, gbuffer.depth[p])


@wp.kernel
def _find_edges(first: int, surfaces: PixelSurfaces) -> None:
    """Marks pixels of which any neighbour shows another surface."""
    p = first + wp.tid()
    surfaces.edge[p] = wp.uint8(0)
    for k in range(9):
        if surfaces_differ(surfaces, p, neighbor_pixel(surfaces, p, k)):
            surfaces.edge[p] = wp.uint8(1)


@wp.func
def add_sample(samples: SampleBuffer, p: int, direct: wp.vec3, indirect: wp.vec3) -> None:
    """Adds a sample on the surface of pixel `p`, if it is finite."""
    d = mean_channel(direct) * samples.scale
    i = mean_channel(indirect) * samples.scale
    if wp.isfinite(d) and wp.isfinite(i):
        samples.direct[p] += direct * samples.scale
        samples.indirect[p] += indirect * samples.scale
        samples.squares[p] += wp.vec2(d * d, i * i)
        samples.count[p] += 1


@wp.func
def add_unassigned(samples: SampleBuffer, p: int, direct: wp.vec3, indirect: wp.vec3) -> None:
    """Adds an unassigned sample that was traced through pixel `p`, if it is finite."""
    if wp.isfinite(mean_channel(direct)) and wp.isfinite(mean_channel(indirect)):
        samples.unassigned_direct[p] += direct * samples.scale
        samples.unassigned_indirect[p] += indirect * samples.scale
        samples.unassigned_count[p] += 1


@wp.kernel
def _accumulate_samples(
    first: int,
    gbuffer: GBuffer,
    samples: SampleBuffer,
) -> None:
    """Adds one iteration's sample of a pixel if it is on the pixel's surface, or unassigned."""
    p = pixel_at(gbuffer.tiles, first + wp.tid())
    if p < 0:
        return
    surfaces = samples.surfaces
    if gbuffer.mesh[p] >= 0 and wp.max(gbuffer.albedo[p]) > 0.0:
        if match_weight(surfaces, p, gbuffer.position[p], gbuffer.smooth_normal[p]) > MIN_MATCH:
            add_sample(samples, p, gbuffer.normal_or_direct[p], gbuffer.indirect[p])
        elif not neighborhood_shows(surfaces, p, gbuffer.position[p], gbuffer.smooth_normal[p]):
            add_unassigned(samples, p, gbuffer.normal_or_direct[p], gbuffer.indirect[p])


@wp.kernel
def _estimate_means(first: int, surfaces: PixelSurfaces, samples: SampleBuffer, out: IrradianceLayer) -> None:
    """Means and their variances; the fewer samples a pixel has, the more the variance is that of its neighbours.

    If only a few of many VPLs are tested for visibility, the variance is proportional to the mean; so the neighbours'
    variance is scaled by the ratio of the means. While every pixel has one sample, the variance between pixels is used.
    """
    p = first + wp.tid()
    row = p // surfaces.columns
    column = p - row * surfaces.columns
    deviations = wp.vec2(0.0)  # squared, of pixels with two samples or more
    neighbor_mean = wp.vec2(0.0)  # of the same pixels
    weights = float(0.0)
    sums = wp.vec2(0.0)
    squares = wp.vec2(0.0)
    count = float(0.0)
    for dy in range(-2, 3):
        for dx in range(-2, 3):
            x = column + 2 * dx
            y = row + 2 * dy
            if x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows:
                q = y * surfaces.columns + x
                if samples.count[q] > 0:
                    w = match_weight(surfaces, p, surfaces.position[q], surfaces.normal[q])
                    if w > 0.0:
                        weighted_sums = w * mean_channels(samples.direct[q], samples.indirect[q])
                        sums += weighted_sums
                        squares += w * samples.squares[q]
                        count += w * float(samples.count[q])
                        if samples.count[q] > 1:
                            deviations += w * _squared_deviations(samples, q)
                            neighbor_mean += weighted_sums * (float(samples.count[q] - 1) / float(samples.count[q]))
                            weights += w * float(samples.count[q] - 1)
    n = float(samples.count[p])
    out.direct[p] = wp.vec4(0.0, 0.0, 0.0, -1.0)
    out.indirect[p] = wp.vec4(0.0, 0.0, 0.0, -1.0)
    samples.variance[p] = wp.vec2(0.0)
    if n > 0.0:
        direct = samples.direct[p] / n
        indirect = samples.indirect[p] / n
        own_mean = mean_channels(direct, indirect)
        # Without neighbours on the same surface, the standard deviation is taken to equal the mean.
        variance = wp.cw_mul(own_mean, own_mean)
        if weights <= 1.0e-6 and count > 2.0:
            weights = count
            neighbor_mean = sums
            deviations = squares - wp.cw_mul(sums, sums) / count
            deviations = wp.max(deviations, wp.vec2(0.0))
        if weights > 1.0e-6:
            neighbor_mean = neighbor_mean / weights + wp.vec2(1.0e-30)
            mean = n * own_mean + _BRIGHTNESS_PRIOR * neighbor_mean
            scale = wp.cw_div(mean, (n + _BRIGHTNESS_PRIOR) * neighbor_mean)
            prior = _VARIANCE_PRIOR * wp.cw_mul(scale, deviations / weights)
            variance = (prior + _squared_deviations(samples, p)) / (_VARIANCE_PRIOR + n - 1.0)
        samples.variance[p] = variance
        out.direct[p] = wp.vec4(direct[0], direct[1], direct[2], variance[0] / n)
        out.indirect[p] = wp.vec4(indirect[0], indirect[1], indirect[2], variance[1] / n)


@wp.func
def _squared_deviations(samples: SampleBuffer, q: int) -> wp.vec2:
    """Sums of the squared deviations of a pixel's samples from their mean, of the two mean channels."""
    sums = mean_channels(samples.direct[q], samples.indirect[q])
    return wp.max(samples.squares[q] - wp.cw_mul(sums, sums) / float(samples.count[q]), wp.vec2(0.0))


def new_sample_buffer(
    scene: DeviceScene, camera: CameraData, launcher: Launcher, gbuffer: GBuffer, seed: int, scale: float
) -> tuple[SampleBuffer, float]:
    """An empty `SampleBuffer`, and the fraction of pixels next to another surface.

    `gbuffer` is overwritten, `seed` is that of the film, `scale` the factor from radiance to the sums.
    """
    pixels = camera.columns * camera.rows
    surfaces = PixelSurfaces()
    surfaces.columns, surfaces.rows = camera.columns, camera.rows
    surfaces.position, surfaces.normal = launcher.zeros(pixels, wp.vec3), launcher.zeros(pixels, wp.vec3)
    surfaces.footprint = launcher.empty(pixels, wp.float32)
    surfaces.edge = launcher.empty(pixels, wp.uint8)
    trace_primary(scene, camera, launcher, gbuffer, iteration=-1, seed=0)
    launcher.launch(_store_pixel_surfaces, pixels, [camera, gbuffer, surfaces])
    launcher.launch(_find_edges, pixels, [surfaces])
    samples = SampleBuffer()
    samples.surfaces = surfaces
    for name in ("direct", "indirect", "unassigned_direct", "unassigned_indirect"):
        setattr(samples, name, launcher.zeros(pixels, wp.vec3))
    samples.squares = launcher.zeros(pixels, wp.vec2)
    samples.count, samples.unassigned_count = launcher.zeros(pixels, wp.int32), launcher.zeros(pixels, wp.int32)
    samples.seed = wp.uint32(seed)
    samples.scale = scale
    return samples, float(surfaces.edge.numpy().mean())


def sample_sums(samples: SampleBuffer) -> dict[str, wp.array[Any]]:
    """The arrays of a `SampleBuffer` that are sums over samples, by name."""
    return {name: getattr(samples, name) for name in SampleBuffer.vars if name not in _NO_SUMS}


def accumulate(samples: SampleBuffer, gbuffer: GBuffer, launcher: Launcher) -> None:
    """Adds one iteration's samples of irradiance over π to a `SampleBuffer`."""
    launcher.launch(_accumulate_samples, indices(gbuffer.tiles), [gbuffer, samples])


def estimate_means(
    samples: SampleBuffer, variance: wp.array[wp.vec2], layer: IrradianceLayer, launcher: Launcher
) -> SampleBuffer:
    """Fills an `IrradianceLayer` with means; returns the samples with `variance`, which is filled as well."""
    samples = copy_record(samples)
    samples.variance = variance
    launcher.launch(_estimate_means, samples.count.shape[0], [samples.surfaces, samples, layer])
    return samples
