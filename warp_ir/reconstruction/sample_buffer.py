"""Samples of irradiance, by the surface that they fall on: their sums, their means, and how noisy those are."""

from typing import Any

import warp as wp

from warp_ir.device.launcher import Launcher, copy_record
from warp_ir.device_scene import CameraData, DeviceScene
from warp_ir.gbuffer import GBuffer, trace_primary
from warp_ir.reconstruction.filter import IrradianceLayer, mean_channel, mean_channels
from warp_ir.reconstruction.pixel_surfaces import MATCH, PixelSurfaces, differ, pixel_around, same_surface, shown_nearby
from warp_ir.tiles import indices, pixel_at

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_PRIOR = wp.constant(8.0)  # samples of its own that outweigh what the neighbours say about a pixel's noise
_AROUND = wp.constant(4.0)  # samples of its own that outweigh what the neighbours say about a pixel's brightness


@wp.struct
class SampleBuffer:
    """Sums over the samples of irradiance over π that fell on each pixel's surface, and of those on no pixel's."""

    surfaces: PixelSurfaces
    direct: wp.array[wp.vec3]
    indirect: wp.array[wp.vec3]
    squares: wp.array[wp.vec2]  # of the two mean channels
    count: wp.array[wp.int32]
    noise: wp.array[wp.vec2]  # variance of one sample of the two mean channels; there while the picture is made
    other_direct: wp.array[wp.vec3]  # on surfaces that neither the pixel's centre shows nor a neighbour's
    other_indirect: wp.array[wp.vec3]
    other_count: wp.array[wp.int32]
    seed: wp.uint32  # of the film


@wp.kernel
def _store_pixel_surfaces(first: int, camera: CameraData, gbuffer: GBuffer, surfaces: PixelSurfaces) -> None:
    """Notes what is seen through the centre of each pixel."""
    p = first + wp.tid()
    surfaces.footprint[p] = 0.0
    if gbuffer.mesh[p] >= 0:
        surfaces.position[p] = gbuffer.position[p]
        surfaces.normal[p] = gbuffer.smooth_normal[p]
        size = camera.height / float(camera.image_rows)
        surfaces.footprint[p] = size * wp.where(camera.orthographic == 1, 1.0, gbuffer.depth[p])


@wp.kernel
def _find_edges(first: int, surfaces: PixelSurfaces) -> None:
    """Notes where any of the eight neighbours shows something else."""
    p = first + wp.tid()
    surfaces.bordering[p] = wp.uint8(0)
    for k in range(9):
        if differ(surfaces, p, pixel_around(surfaces, p, k)):
            surfaces.bordering[p] = wp.uint8(1)


@wp.func
def add_sample(seen: SampleBuffer, p: int, direct: wp.vec3, indirect: wp.vec3) -> None:
    """Adds a sample to those on a pixel's surface, if it is finite."""
    d = mean_channel(direct)
    i = mean_channel(indirect)
    if wp.isfinite(d) and wp.isfinite(i):
        seen.direct[p] += direct
        seen.indirect[p] += indirect
        seen.squares[p] += wp.vec2(d * d, i * i)
        seen.count[p] += 1


@wp.func
def add_other(seen: SampleBuffer, p: int, direct: wp.vec3, indirect: wp.vec3) -> None:
    """Adds a sample to those on surfaces that no pixel shows, if it is finite."""
    if wp.isfinite(mean_channel(direct)) and wp.isfinite(mean_channel(indirect)):
        seen.other_direct[p] += direct
        seen.other_indirect[p] += indirect
        seen.other_count[p] += 1


@wp.kernel
def _accumulate_samples(
    first: int,
    gbuffer: GBuffer,
    seen: SampleBuffer,
) -> None:
    """Adds one iteration's sample of a pixel to those on its surface, or on none."""
    p = pixel_at(gbuffer.tiles, first + wp.tid())
    if p < 0:
        return
    surfaces = seen.surfaces
    if gbuffer.mesh[p] >= 0 and wp.max(gbuffer.albedo[p]) > 0.0:
        if same_surface(surfaces, p, gbuffer.position[p], gbuffer.smooth_normal[p]) > MATCH:
            add_sample(seen, p, gbuffer.normal_or_direct[p], gbuffer.indirect[p])
        elif not shown_nearby(surfaces, p, gbuffer.position[p], gbuffer.smooth_normal[p]):
            add_other(seen, p, gbuffer.normal_or_direct[p], gbuffer.indirect[p])


@wp.kernel
def _estimate_means(first: int, surfaces: PixelSurfaces, seen: SampleBuffer, out: IrradianceLayer) -> None:
    """Means and their variance, from the spread of the pixel and, more so the fewer its samples, of its neighbours.

    While every pixel has one sample, the spread from pixel to pixel serves.
    Of a few rays to many VPLs some arrive: the variance goes with the brightness, so that of the neighbours is scaled.
    """
    p = first + wp.tid()
    row = p // surfaces.columns
    column = p - row * surfaces.columns
    spread = wp.vec2(0.0)
    around = wp.vec2(0.0)
    weights = float(0.0)
    firsts = wp.vec2(0.0)
    squares = wp.vec2(0.0)
    samples = float(0.0)
    for dy in range(-2, 3):
        for dx in range(-2, 3):
            x = column + 2 * dx
            y = row + 2 * dy
            if x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows:
                q = y * surfaces.columns + x
                if seen.count[q] > 0:
                    w = same_surface(surfaces, p, surfaces.position[q], surfaces.normal[q])
                    if w > 0.0:
                        sample_sums = w * mean_channels(seen.direct[q], seen.indirect[q])
                        firsts += sample_sums
                        squares += w * seen.squares[q]
                        samples += w * float(seen.count[q])
                        if seen.count[q] > 1:
                            spread += w * _spread(seen, q)
                            around += sample_sums * (float(seen.count[q] - 1) / float(seen.count[q]))
                            weights += w * float(seen.count[q] - 1)
    n = float(seen.count[p])
    out.direct[p] = wp.vec4(0.0, 0.0, 0.0, -1.0)
    out.indirect[p] = wp.vec4(0.0, 0.0, 0.0, -1.0)
    seen.noise[p] = wp.vec2(0.0)
    if n > 0.0:
        direct = seen.direct[p] / n
        indirect = seen.indirect[p] / n
        # Alone on its surface: as uncertain as it is bright.
        own = mean_channels(direct, indirect)
        variance = wp.cw_mul(own, own)
        if weights <= 1.0e-6 and samples > 2.0:
            weights = samples
            around = firsts
            spread = squares - wp.cw_mul(firsts, firsts) / samples
            spread = wp.max(spread, wp.vec2(0.0))
        if weights > 1.0e-6:
            around = around / weights + wp.vec2(1.0e-30)
            scale = wp.cw_div(n * own + _AROUND * around, (n + _AROUND) * around)
            variance = (_PRIOR * wp.cw_mul(scale, spread / weights) + _spread(seen, p)) / (_PRIOR + n - 1.0)
        seen.noise[p] = variance
        out.direct[p] = wp.vec4(direct[0], direct[1], direct[2], variance[0] / n)
        out.indirect[p] = wp.vec4(indirect[0], indirect[1], indirect[2], variance[1] / n)


@wp.func
def _spread(seen: SampleBuffer, q: int) -> wp.vec2:
    """Sums of the squared deviations from the means."""
    sample_sums = mean_channels(seen.direct[q], seen.indirect[q])
    return wp.max(seen.squares[q] - wp.cw_mul(sample_sums, sample_sums) / float(seen.count[q]), wp.vec2(0.0))


_NO_SUMS = ("surfaces", "noise", "seed")


def new_sample_buffer(
    scene: DeviceScene, camera: Any, launcher: Launcher, gbuffer: Any, seed: int
) -> tuple[Any, float]:
    """`SampleBuffer` without samples yet, and the share of the pixels that lie beside another surface.

    `gbuffer` is used as scratch, `seed` is that of the film.
    """
    pixels = camera.columns * camera.rows
    surfaces = PixelSurfaces()
    surfaces.columns, surfaces.rows = camera.columns, camera.rows
    surfaces.position, surfaces.normal = launcher.zeros(pixels, wp.vec3), launcher.zeros(pixels, wp.vec3)
    surfaces.footprint = launcher.empty(pixels, wp.float32)
    surfaces.bordering = launcher.empty(pixels, wp.uint8)
    trace_primary(scene, camera, launcher, gbuffer, iteration=-1, seed=0)
    launcher.launch(_store_pixel_surfaces, pixels, [camera, gbuffer, surfaces])
    launcher.launch(_find_edges, pixels, [surfaces])
    seen = SampleBuffer()
    seen.surfaces = surfaces
    for name in ("direct", "indirect", "other_direct", "other_indirect"):
        setattr(seen, name, launcher.zeros(pixels, wp.vec3))
    seen.squares = launcher.zeros(pixels, wp.vec2)
    seen.count, seen.other_count = launcher.zeros(pixels, wp.int32), launcher.zeros(pixels, wp.int32)
    seen.seed = wp.uint32(seed)
    return seen, float(surfaces.bordering.numpy().mean())


def sample_sums(seen: Any) -> dict[str, Any]:
    """The samples of `SampleBuffer`, by name."""
    return {name: getattr(seen, name) for name in SampleBuffer.vars if name not in _NO_SUMS}


def accumulate(seen: Any, gbuffer: GBuffer, launcher: Launcher) -> None:
    """Adds one iteration's samples of irradiance over π to `SampleBuffer`."""
    launcher.launch(_accumulate_samples, indices(gbuffer.tiles), [gbuffer, seen])


def estimate_means(seen: Any, noise: Any, layer: Any, launcher: Launcher) -> Any:
    """Fills an `IrradianceLayer` with means; returns the `SampleBuffer` with `noise`, which it fills too."""
    seen = copy_record(seen)
    seen.noise = noise
    launcher.launch(_estimate_means, seen.count.shape[0], [seen.surfaces, seen, layer])
    return seen
