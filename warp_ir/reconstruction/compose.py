"""The picture of filtered irradiance: what it is away from edges and on them, and where the plain mean is believed."""

from typing import Any

import warp as wp

from warp_ir.device.launcher import MAX_REGISTERS, Launcher
from warp_ir.device_scene import CameraData, DeviceScene, SceneData
from warp_ir.film.accumulate import FilmData, emission_of
from warp_ir.reconstruction.edges import Irradiance, Pixel, on_edge, supersample_edge
from warp_ir.reconstruction.filter import IrradianceLayer, mean_channel, mean_channels, value
from warp_ir.reconstruction.pixel_surfaces import PixelSurfaces
from warp_ir.reconstruction.sample_buffer import SampleBuffer

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_MOST_EDGE_RAYS = 256
_TRUST = wp.constant(8.0)  # standard errors by which the result may differ from the mean, away from edges
_WINDOW = wp.constant(2)  # pixels to each side that tell how much of a difference is noise


@wp.struct
class ResolvedPicture:
    """What becomes of it all, and what it lacks on edges."""

    rows: wp.array2d[wp.vec3]  # radiance by way of lights, of surfaces; if there are five, albedo, normal, plain mean
    rest: (
        IrradianceLayer  # plain mean less picture, and how large noise makes its square on average; -1: not on an edge
    )
    edge_rays: int


@wp.func
def _student(n: float) -> float:
    """What noise makes of (difference / standard error)² on average, the error being estimated from n samples."""
    return wp.where(n > 3.5, (n - 1.0) / wp.max(n - 3.0, 1.0), 1.0e30)


@wp.func
def shrink_to_mean(difference: wp.vec3, variance: float, n: float) -> wp.vec3:
    """What is to be believed of a difference between the plain mean and the result, by itself."""
    d = mean_channel(difference)
    ratio = _TRUST * _TRUST * _student(n) * variance / (d * d + 1.0e-30)
    return difference / (1.0 + ratio * ratio)


@wp.struct
class ResolvedPixel:
    """A pixel: radiance by what emits, by way of lights and of surfaces, features, and the plain mean."""

    emitted: wp.vec3
    direct: wp.vec3
    indirect: wp.vec3
    albedo: wp.vec3
    normal: wp.vec3
    plain: wp.vec3


@wp.func
def plain_estimate(film: FilmData, p: int) -> ResolvedPixel:
    """The film's own means."""
    x = ResolvedPixel()
    x.emitted = emission_of(film, p)
    x.direct = film.direct[p]
    x.indirect = film.indirect[p]
    x.albedo = film.albedo[p] / float(film.count[p])
    x.normal = film.normal[p] / float(film.count[p])
    x.plain = x.emitted + x.direct + x.indirect
    return x


@wp.func
def filtered_estimate(
    sampled: ResolvedPixel, seen: SampleBuffer, layer: IrradianceLayer, p: int, exposure: float, n: float
) -> ResolvedPixel:
    """The filtered light of a pixel that shows one surface, unless the film's mean contradicts it."""
    x = sampled
    reflected = mean_channel(x.albedo) * exposure
    noise = seen.noise[p] * (reflected * reflected / n)
    x.direct = wp.cw_mul(x.albedo, value(layer.direct[p])) * exposure
    x.indirect = wp.cw_mul(x.albedo, value(layer.indirect[p])) * exposure
    x.direct += shrink_to_mean(sampled.direct - x.direct, noise[0], n)
    x.indirect += shrink_to_mean(sampled.indirect - x.indirect, noise[1], n)
    return x


@wp.func
def supersampled_estimate(
    sampled: ResolvedPixel, film: FilmData, pixel: Pixel, p: int, exposure: float, out: ResolvedPicture
) -> ResolvedPixel:
    """What many rays found, times `exposure`; notes how far the plain mean of the film's own is off."""
    x = sampled
    if pixel.rays > film.count[p]:
        x.albedo = pixel.albedo / float(pixel.rays)
        x.normal = pixel.normal / float(pixel.rays)
        # The mean as it were of as many rays: less what the film's own saw, and more what all see.
        x.plain += (pixel.direct - pixel.own_direct + pixel.indirect - pixel.own_indirect) * exposure
        x.plain += pixel.emission * exposure - x.emitted
        x.emitted = pixel.emission * exposure
    x.direct = pixel.direct * exposure
    x.indirect = pixel.indirect * exposure
    if film.hits[p] > 0:
        n = float(film.count[p])
        noise = (pixel.own_noise * (exposure * exposure / n) + wp.vec2(1.0e-30)) * _student(n)
        more = sampled.direct - pixel.own_direct * exposure
        out.rest.direct[p] = wp.vec4(more[0], more[1], more[2], noise[0])
        more = sampled.indirect - pixel.own_indirect * exposure
        out.rest.indirect[p] = wp.vec4(more[0], more[1], more[2], noise[1])
    return x


@wp.func
def show(out: ResolvedPicture, p: int, x: ResolvedPixel) -> None:
    """Fills a pixel's rows."""
    if out.rows.shape[0] > 2:
        out.rows[2, p] = x.albedo
        out.rows[3, p] = x.normal
        out.rows[4, p] = x.plain
    out.rows[0, p] = x.direct + x.emitted
    out.rows[1, p] = x.indirect


@wp.kernel(module="warp_ir.gbuffer", cuda_max_registers=MAX_REGISTERS)  # so that camera rays are compiled once
def _compose(
    first: int,
    scene: SceneData,
    camera: CameraData,
    seen: SampleBuffer,
    layer: IrradianceLayer,
    film: FilmData,
    exposure: float,
    out: ResolvedPicture,
) -> None:
    """Radiance of a pixel from irradiance on surfaces; on edges, how far the plain mean of the same rays is off."""
    p = first + wp.tid()
    surfaces = seen.surfaces
    sampled = plain_estimate(film, p)
    shown = sampled
    out.rest.direct[p] = wp.vec4(0.0, 0.0, 0.0, -1.0)
    if seen.count[p] != film.count[p] or on_edge(surfaces, film, p):
        # What neither the pixel nor a neighbour shows is lit like such samples, if there were any, or like all.
        other = Irradiance()
        other.weight = float(seen.other_count[p])
        other.direct = seen.other_direct[p]
        other.indirect = seen.other_indirect[p]
        if seen.other_count[p] == 0:
            other.weight = exposure
            other.direct = wp.cw_div(sampled.direct, wp.max(sampled.albedo, wp.vec3(1.0e-6)))
            other.indirect = wp.cw_div(sampled.indirect, wp.max(sampled.albedo, wp.vec3(1.0e-6)))
        means = mean_channels(other.direct, other.indirect)
        other.noise = wp.cw_mul(means, means) / other.weight
        pixel = supersample_edge(scene, camera, seen, layer, p, other, wp.vec2i(film.count[p], out.edge_rays))
        shown = supersampled_estimate(sampled, film, pixel, p, exposure, out)
    elif surfaces.footprint[p] > 0.0 and layer.direct[p][3] >= 0.0:
        shown = filtered_estimate(sampled, seen, layer, p, exposure, float(film.count[p]))
    show(out, p, shown)


@wp.kernel
def _correct_edges(first: int, surfaces: PixelSurfaces, out: ResolvedPicture) -> None:
    """Gives back to pixels on edges what is not noise in their difference to the plain mean.

    That of a few pixels together is known best: if noise alone made the differences, their squares would be as large
    as expected on average; of squares that are r times as large, the share 1 - 1/r is real.
    """
    p = first + wp.tid()
    if out.rest.direct[p][3] >= 0.0:
        ratio = wp.vec2(0.0)
        weights = float(0.0)
        for dy in range(-_WINDOW, _WINDOW + 1):
            for dx in range(-_WINDOW, _WINDOW + 1):
                x = p % surfaces.columns + dx
                y = p // surfaces.columns + dy
                if x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows:
                    d = out.rest.direct[y * surfaces.columns + x]
                    if d[3] >= 0.0:
                        i = out.rest.indirect[y * surfaces.columns + x]
                        means = mean_channels(value(d), value(i))
                        w = 1.0 / (1.0 + 0.5 * float(dx * dx + dy * dy))
                        ratio += w * wp.cw_div(wp.cw_mul(means, means), wp.vec2(d[3], i[3]) + wp.vec2(1.0e-30))
                        weights += w
        d = out.rest.direct[p]
        i = out.rest.indirect[p]
        out.rows[0, p] = out.rows[0, p] + value(d) * wp.max(1.0 - weights / (ratio[0] + 1.0e-30), 0.0)
        out.rows[1, p] = out.rows[1, p] + value(i) * wp.max(1.0 - weights / (ratio[1] + 1.0e-30), 0.0)


def edge_rays(iterations: int) -> int:
    """Camera rays for a pixel on an edge: what edges lack then is little beside noise."""
    return min(16 + 2 * iterations, _MOST_EDGE_RAYS)


def new_resolved_picture(pixels: int, rest: Any, rays: int, features: bool, launcher: Launcher) -> Any:
    """An uninitialised `ResolvedPicture`; `rest` is overwritten, `rays` are those of a pixel on an edge."""
    out = ResolvedPicture()
    out.rest = rest
    out.rows = launcher.empty((5 if features else 2, pixels), wp.vec3)
    out.edge_rays = rays
    return out


def compose(
    scene: DeviceScene, camera: Any, seen: Any, layer: Any, film: Any, exposure: float, out: Any, launcher: Launcher
) -> None:
    """Fills a `ResolvedPicture` from a filtered `IrradianceLayer`."""
    launcher.launch(_compose, camera.columns * camera.rows, [scene.data, camera, seen, layer, film, exposure, out])


def correct_edges(surfaces: Any, out: Any, launcher: Launcher) -> None:
    """Gives back to a `ResolvedPicture` what it lacks on edges."""
    launcher.launch(_correct_edges, surfaces.columns * surfaces.rows, [surfaces, out])
