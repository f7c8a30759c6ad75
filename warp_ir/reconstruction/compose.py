"""The picture from filtered irradiance, with supersampled edges.

Away from edges, a pixel whose filtered value differs from the unfiltered mean by more standard errors than noise
explains takes the mean.
"""

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import MAX_REGISTERS, Launcher
from warp_ir.device_scene import CameraData, DeviceScene, SceneData
from warp_ir.film.accumulate import FilmData, emission_of
from warp_ir.reconstruction.edges import SupersampledPixel, WeightedIrradiance, on_edge, supersample_edge
from warp_ir.reconstruction.filter import IrradianceLayer, mean_channel, mean_channels, rgb
from warp_ir.reconstruction.sample_buffer import SampleBuffer

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_MAX_EDGE_RAYS = 256
_MAX_STANDARD_ERRORS = wp.constant(8.0)  # by which the filtered value may differ from the mean, away from edges


@wp.struct
class ResolvedPicture:
    """The picture times `scale`, one column per pixel, and what its correction on edges needs."""

    rows: wp.array2d[wp.vec3]  # direct with emission, indirect; if there are five: albedo, normal, unfiltered mean
    edge_residual: IrradianceLayer  # unfiltered mean minus picture, w: its expected square by noise; -1: no edge
    max_rays: int  # of a supersampled pixel
    scale: float  # factor from the film's radiance to this picture's


@wp.struct
class ResolvedPixel:
    """Radiance of a pixel, its features, and the unfiltered mean of its radiance."""

    emission: wp.vec3
    direct: wp.vec3
    indirect: wp.vec3
    albedo: wp.vec3
    normal: wp.vec3
    unfiltered: wp.vec3


@wp.func
def _variance_of_t(n: float) -> float:
    """Variance (n - 1) / (n - 3) of Student's t: a difference over its standard error, estimated from n samples."""
    return wp.where(n > 3.5, (n - 1.0) / wp.max(n - 3.0, 1.0), 1.0e30)


@wp.func
def shrink_to_mean(difference: wp.vec3, variance: float, n: float) -> wp.vec3:
    """The bias of a pixel: the difference between unfiltered and filtered value, shrunk by its noise."""
    d = mean_channel(difference)
    ratio = _MAX_STANDARD_ERRORS * _MAX_STANDARD_ERRORS * _variance_of_t(n) * variance / (d * d + 1.0e-30)
    return difference / (1.0 + ratio * ratio)


@wp.func
def unfiltered_estimate(film: FilmData, p: int, scale: float) -> ResolvedPixel:
    """A pixel of the film's own means times `scale`."""
    x = ResolvedPixel()
    x.emission = emission_of(film, p) * scale
    x.direct = film.direct[p] * scale
    x.indirect = film.indirect[p] * scale
    x.albedo = film.albedo[p] / float(film.count[p])
    x.normal = film.normal[p] / float(film.count[p])
    x.unfiltered = x.emission + x.direct + x.indirect
    return x


@wp.func
def filtered_estimate(
    unfiltered: ResolvedPixel, samples: SampleBuffer, layer: IrradianceLayer, p: int, exposure: float, n: float
) -> ResolvedPixel:
    """A pixel that shows one surface: its filtered irradiance, corrected by the mean of its `n` iterations."""
    x = unfiltered
    reflectance = mean_channel(x.albedo) * exposure
    variance = samples.variance[p] * (reflectance * reflectance / n)
    x.direct = wp.cw_mul(x.albedo, rgb(layer.direct[p])) * exposure
    x.indirect = wp.cw_mul(x.albedo, rgb(layer.indirect[p])) * exposure
    x.direct += shrink_to_mean(unfiltered.direct - x.direct, variance[0], n)
    x.indirect += shrink_to_mean(unfiltered.indirect - x.indirect, variance[1], n)
    return x


@wp.func
def supersampled_estimate(
    unfiltered: ResolvedPixel, film: FilmData, pixel: SupersampledPixel, p: int, exposure: float, out: ResolvedPicture
) -> ResolvedPixel:
    """A supersampled pixel times `exposure`; stores the residual of the film's own camera rays."""
    x = unfiltered
    if pixel.rays > film.count[p]:
        x.albedo = pixel.albedo / float(pixel.rays)
        x.normal = pixel.normal / float(pixel.rays)
        # The unfiltered mean as if it had been made of all the rays: the film's rays are replaced by all of them.
        x.unfiltered += (pixel.direct - pixel.film_direct + pixel.indirect - pixel.film_indirect) * exposure
        x.unfiltered += pixel.emission * exposure - x.emission
        x.emission = pixel.emission * exposure
    x.direct = pixel.direct * exposure
    x.indirect = pixel.indirect * exposure
    if film.hits[p] > 0:
        n = float(film.count[p])
        noise = (pixel.variance * (exposure * exposure / n) + wp.vec2(1.0e-30)) * _variance_of_t(n)
        residual = unfiltered.direct - pixel.film_direct * exposure
        out.edge_residual.direct[p] = wp.vec4(residual[0], residual[1], residual[2], noise[0])
        residual = unfiltered.indirect - pixel.film_indirect * exposure
        out.edge_residual.indirect[p] = wp.vec4(residual[0], residual[1], residual[2], noise[1])
    return x


@wp.func
def store_pixel(out: ResolvedPicture, p: int, x: ResolvedPixel) -> None:
    """Fills the rows of a pixel."""
    if out.rows.shape[0] > 2:
        out.rows[2, p] = x.albedo
        out.rows[3, p] = x.normal
        out.rows[4, p] = x.unfiltered
    out.rows[0, p] = x.direct + x.emission
    out.rows[1, p] = x.indirect


@wp.struct
class UnassignedIrradiance:
    """Irradiance of surfaces that no pixel centre shows."""

    irradiance: WeightedIrradiance
    is_measured: int  # 1: from unassigned samples nearby; 0: from the pixel's mean


@wp.func
def unassigned_irradiance(
    samples: SampleBuffer, p: int, unfiltered: ResolvedPixel, exposure: float
) -> UnassignedIrradiance:
    """Mean of the unassigned samples in the 5 x 5 neighbourhood or, without any, of all samples of the pixel.

    Such surfaces are narrow or lie in crevices: few samples of a pixel hit them, and the others are brighter. The more
    the pixel has of its own, the less its neighbours count.
    """
    surfaces = samples.surfaces
    irradiance = WeightedIrradiance()
    own_count = float(1 + samples.unassigned_count[p])
    for dy in range(-2, 3):
        for dx in range(-2, 3):
            x = p % surfaces.columns + dx
            y = p // surfaces.columns + dy
            if x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows:
                q = y * surfaces.columns + x
                distance_squared = float(dx * dx + dy * dy)
                w = 1.0 / (1.0 + own_count * distance_squared * distance_squared)
                irradiance.direct += w * samples.unassigned_direct[q]
                irradiance.indirect += w * samples.unassigned_indirect[q]
                irradiance.weight += w * float(samples.unassigned_count[q])
    out = UnassignedIrradiance()
    out.is_measured = wp.where(irradiance.weight > 0.0, 1, 0)
    if out.is_measured == 0:
        irradiance.weight = 1.0
        albedo = wp.max(unfiltered.albedo, wp.vec3(1.0e-6))
        irradiance.direct = wp.cw_div(unfiltered.direct / exposure, albedo)
        irradiance.indirect = wp.cw_div(unfiltered.indirect / exposure, albedo)
    means = mean_channels(irradiance.direct, irradiance.indirect)
    irradiance.variance = wp.cw_mul(means, means) / irradiance.weight
    out.irradiance = irradiance
    return out


@wp.kernel(module="warp_ir.gbuffer", cuda_max_registers=MAX_REGISTERS)  # so that camera rays are compiled once
def _compose(
    first: int,
    scene: SceneData,
    camera: CameraData,
    samples: SampleBuffer,
    layer: IrradianceLayer,
    film: FilmData,
    exposure: float,
    out: ResolvedPicture,
) -> None:
    """Radiance of a pixel from filtered irradiance; on edges, from supersampling."""
    p = first + wp.tid()
    surfaces = samples.surfaces
    unfiltered = unfiltered_estimate(film, p, out.scale)
    x = unfiltered
    out.edge_residual.direct[p] = wp.vec4(0.0, 0.0, 0.0, -1.0)
    if samples.count[p] != film.count[p] or on_edge(surfaces, film, p):
        unassigned = unassigned_irradiance(samples, p, unfiltered, exposure).irradiance
        ray_counts = wp.vec2i(film.count[p], out.max_rays)
        pixel = supersample_edge(scene, camera, samples, layer, p, unassigned, ray_counts)
        x = supersampled_estimate(unfiltered, film, pixel, p, exposure, out)
    elif surfaces.footprint[p] > 0.0 and layer.direct[p][3] >= 0.0:
        x = filtered_estimate(unfiltered, samples, layer, p, exposure, float(film.count[p]))
    store_pixel(out, p, x)


def edge_rays(iterations: int) -> int:
    """Maximum number of camera rays through a pixel on an edge: the error of the edge is then below the noise."""
    return min(16 + 2 * iterations, _MAX_EDGE_RAYS)


def new_resolved_picture(
    pixels: int, edge_residual: IrradianceLayer, max_rays: int, scale: float, features: bool, launcher: Launcher
) -> ResolvedPicture:
    """An uninitialised `ResolvedPicture`, with or without features; `edge_residual` is overwritten."""
    out = ResolvedPicture()
    out.edge_residual = edge_residual
    out.rows = launcher.empty((5 if features else 2, pixels), wp.vec3)
    out.max_rays, out.scale = max_rays, scale
    return out


def compose(
    scene: DeviceScene,
    camera: CameraData,
    samples: SampleBuffer,
    layer: IrradianceLayer,
    film: FilmData,
    exposure: float,
    out: ResolvedPicture,
    launcher: Launcher,
) -> None:
    """Fills a `ResolvedPicture` from a filtered `IrradianceLayer`."""
    launcher.launch(_compose, camera.columns * camera.rows, [scene.data, camera, samples, layer, film, exposure, out])


def rows_to_host(out: ResolvedPicture) -> npt.NDArray[np.float32]:
    """The rows of a `ResolvedPicture` on the host, without its scale, float32 [2 or 5, pixels, 3]."""
    rows: npt.NDArray[np.float32] = out.rows.numpy()
    if out.scale != 1.0:
        for radiance in (rows[0], rows[1], *rows[4:]):
            radiance *= np.float32(1.0 / out.scale)
    return rows
