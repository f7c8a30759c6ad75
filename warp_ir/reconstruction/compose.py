"""The picture of filtered irradiance: what it is away from edges and on them, and where the plain mean is believed."""

from typing import Any

import warp as wp

from warp_ir.device_scene import CameraData, DeviceScene, SceneData
from warp_ir.film import FilmData, emission_of
from warp_ir.launch import Launcher
from warp_ir.reconstruction.edges import Lit, look_closely, on_edge
from warp_ir.reconstruction.filter import Layer, mean_channel, mean_channels, value
from warp_ir.reconstruction.observations import Observations
from warp_ir.reconstruction.surfaces import Surfaces

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_MOST_EDGE_RAYS = 256
_TRUST = wp.constant(8.0)  # standard errors by which the result may differ from the mean, away from edges
_WINDOW = wp.constant(2)  # pixels to each side that tell how much of a difference is noise


@wp.struct
class Picture:
    """What becomes of it all, and what it lacks on edges."""

    rows: wp.array2d[wp.vec3]  # radiance by way of lights, of surfaces; if there are five, albedo, normal, plain mean
    rest: Layer  # plain mean less picture, and the variance of that by noise; -1: not on an edge
    iterations: int
    edge_rays: int


@wp.func
def _student(n: float) -> float:
    """What noise makes of (difference / standard error)² on average, the error being estimated from n samples."""
    return wp.where(n > 3.5, (n - 1.0) / wp.max(n - 3.0, 1.0), 1.0e30)


@wp.func
def give_back(difference: wp.vec3, variance: float, n: float) -> wp.vec3:
    """What is to be believed of a difference between the plain mean and the result, by itself."""
    d = mean_channel(difference)
    ratio = _TRUST * _TRUST * _student(n) * variance / (d * d + 1.0e-30)
    return difference / (1.0 + ratio * ratio)


@wp.kernel(module="warp_ir.gbuffer")  # so that camera rays are compiled once
def _compose(
    first: int,
    scene: SceneData,
    camera: CameraData,
    seen: Observations,
    layer: Layer,
    film: FilmData,
    exposure: float,
    out: Picture,
) -> None:
    """Radiance of a pixel from irradiance on surfaces; on edges, how far the plain mean of the same rays is off."""
    p = first + wp.tid()
    surfaces = seen.surfaces
    n = float(out.iterations)
    emitted = emission_of(film, p)
    raw_direct = film.direct[p]
    raw_indirect = film.indirect[p]
    albedo = film.albedo[p] / n
    normal = film.normal[p] / n
    plain = emitted + raw_direct + raw_indirect
    out.rest.direct[p] = wp.vec4(0.0, 0.0, 0.0, -1.0)
    direct = raw_direct
    indirect = raw_indirect
    if seen.count[p] != out.iterations or on_edge(surfaces, film, p):
        # What neither the pixel nor a neighbour shows is lit like such samples, if there were any, or like all.
        other = Lit()
        other.weight = float(seen.other_count[p])
        other.direct = seen.other_direct[p]
        other.indirect = seen.other_indirect[p]
        if seen.other_count[p] == 0:
            other.weight = exposure
            other.direct = wp.cw_div(raw_direct, wp.max(albedo, wp.vec3(1.0e-6)))
            other.indirect = wp.cw_div(raw_indirect, wp.max(albedo, wp.vec3(1.0e-6)))
        means = mean_channels(other.direct, other.indirect)
        other.noise = wp.cw_mul(means, means) / other.weight
        pixel = look_closely(scene, camera, seen, layer, p, other, wp.vec2i(out.iterations, out.edge_rays))
        if pixel.rays > out.iterations:
            albedo = pixel.albedo / float(pixel.rays)
            normal = pixel.normal / float(pixel.rays)
            # The mean as it were of as many rays: less what the film's own saw, and more what all see.
            plain += (pixel.direct - pixel.own_direct + pixel.indirect - pixel.own_indirect) * exposure
            plain += pixel.emission * exposure - emitted
            emitted = pixel.emission * exposure
        direct = pixel.direct * exposure
        indirect = pixel.indirect * exposure
        if film.hits[p] > 0:
            more = raw_direct - pixel.own_direct * exposure
            noise = pixel.own_noise * (exposure * exposure / n)
            out.rest.direct[p] = wp.vec4(more[0], more[1], more[2], noise[0])
            more = raw_indirect - pixel.own_indirect * exposure
            out.rest.indirect[p] = wp.vec4(more[0], more[1], more[2], noise[1])
    elif surfaces.footprint[p] > 0.0 and layer.direct[p][3] >= 0.0:
        direct = wp.cw_mul(albedo, value(layer.direct[p])) * exposure
        indirect = wp.cw_mul(albedo, value(layer.indirect[p])) * exposure
        reflected = mean_channel(albedo) * exposure
        noise = seen.noise[p] * (reflected * reflected / n)
        direct += give_back(raw_direct - direct, noise[0], n)
        indirect += give_back(raw_indirect - indirect, noise[1], n)
    if out.rows.shape[0] > 2:
        out.rows[2, p] = albedo
        out.rows[3, p] = normal
        out.rows[4, p] = plain
    out.rows[0, p] = direct + emitted
    out.rows[1, p] = indirect


@wp.kernel
def _correct_edges(first: int, surfaces: Surfaces, out: Picture) -> None:
    """Gives back to pixels on edges what is not noise in their difference to the plain mean.

    That of a few pixels together is known best: if noise alone made the differences, their squares would be as large
    as their variances on average; of squares that are r times as large, the share 1 - 1/r is real.
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
        noise = _student(float(out.iterations)) * weights
        d = out.rest.direct[p]
        i = out.rest.indirect[p]
        out.rows[0, p] = out.rows[0, p] + value(d) * wp.max(1.0 - noise / (ratio[0] + 1.0e-30), 0.0)
        out.rows[1, p] = out.rows[1, p] + value(i) * wp.max(1.0 - noise / (ratio[1] + 1.0e-30), 0.0)


def edge_rays(iterations: int) -> int:
    """Camera rays for a pixel on an edge: what edges lack then is little beside noise."""
    return min(16 + 2 * iterations, _MOST_EDGE_RAYS)


def new_picture(pixels: int, rest: Any, iterations: int, rays: int, features: bool, launcher: Launcher) -> Any:
    """An uninitialised `Picture`; `rest` is a `Layer` to be overwritten, `rays` are those of a pixel on an edge."""
    out = Picture()
    out.rest = rest
    out.rows = launcher.empty((5 if features else 2, pixels), wp.vec3)
    out.iterations, out.edge_rays = iterations, rays
    return out


def compose(
    scene: DeviceScene, camera: Any, seen: Any, layer: Any, film: Any, exposure: float, out: Any, launcher: Launcher
) -> None:
    """Fills a `Picture` from a filtered `Layer`."""
    launcher.launch(_compose, camera.columns * camera.rows, [scene.data, camera, seen, layer, film, exposure, out])


def correct_edges(surfaces: Any, out: Any, launcher: Launcher) -> None:
    """Gives back to a `Picture` what it lacks on edges."""
    launcher.launch(_correct_edges, surfaces.columns * surfaces.rows, [surfaces, out])
