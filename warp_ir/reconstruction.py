"""The picture from few samples: irradiance is filtered on surfaces, edges are sampled apart from it.

A pixel stands for the surface seen through its centre. Samples of irradiance that fall on it are averaged there and
filtered (`filter`): no pixel mixes surfaces, so edges do not stop the filter. What a pixel on an edge shows is then
found by many cheap camera rays, each taking the irradiance of the neighbouring pixel whose surface it meets.

Where the result differs from the plain mean by more than the noise explains, the mean is believed: the bias vanishes
with the noise.
"""

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir import sampling
from warp_ir.device_scene import CameraData, DeviceScene, SceneData
from warp_ir.film import FilmData
from warp_ir.filter import Layer, Surfaces, filter_layer, mean_channel, new_layer, same_surface
from warp_ir.gbuffer import GBuffer, Sight, camera_ray, see, trace_primary
from warp_ir.launch import Launcher

wp.set_module_options({"enable_backward": False})

_EDGE_RAYS = (16, 64)
"""Camera rays for a pixel on an edge: at least, and at most; in between as many as there were iterations."""
_MATCH = wp.constant(0.2)  # of `same_surface`: below, a sample is not of that surface
_TRUST = wp.constant(3.0)  # standard errors by which the result may differ from the mean
_EDGE_JITTER = wp.constant(wp.uint32(0xBB67AE85))


@wp.struct
class Observations:
    """Sums over the samples of irradiance over π that fell on each pixel's surface."""

    direct: wp.array[wp.vec3]
    indirect: wp.array[wp.vec3]
    squares: wp.array[wp.float32]  # of the mean channel
    count: wp.array[wp.int32]


@wp.kernel
def _look(first: int, camera: CameraData, gbuffer: GBuffer, surfaces: Surfaces) -> None:
    """Notes what is seen through the centre of each pixel."""
    p = first + wp.tid()
    surfaces.footprint[p] = 0.0
    if gbuffer.mesh[p] >= 0:
        surfaces.position[p] = gbuffer.position[p]
        surfaces.normal[p] = gbuffer.shading_normal[p]
        size = camera.height / float(camera.rows)
        surfaces.footprint[p] = size * wp.where(camera.orthographic == 1, 1.0, gbuffer.depth[p])


@wp.kernel
def _observe(
    first: int,
    surfaces: Surfaces,
    gbuffer: GBuffer,
    direct: wp.array[wp.vec3],
    indirect: wp.array[wp.vec3],
    seen: Observations,
) -> None:
    """Adds one iteration's sample of a pixel, if it fell on the pixel's surface."""
    p = first + wp.tid()
    if gbuffer.mesh[p] >= 0 and wp.max(gbuffer.albedo[p]) > 0.0:
        if same_surface(surfaces, p, gbuffer.position[p], gbuffer.shading_normal[p]) > _MATCH:
            value = mean_channel(direct[p] + indirect[p])
            if wp.isfinite(value):
                seen.direct[p] += direct[p]
                seen.indirect[p] += indirect[p]
                seen.squares[p] += value * value
                seen.count[p] += 1


@wp.kernel
def _average(first: int, surfaces: Surfaces, seen: Observations, out: Layer) -> None:
    """Means, and the variance of them: that of single samples, averaged over the surface nearby, over their number."""
    p = first + wp.tid()
    variance = float(0.0)
    weights = float(0.0)
    for dy in range(-3, 4):
        for dx in range(-3, 4):
            x = p % surfaces.columns + dx
            y = p // surfaces.columns + dy
            if x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows:
                q = y * surfaces.columns + x
                n = float(seen.count[q])
                if n > 1.0:
                    w = same_surface(surfaces, p, surfaces.position[q], surfaces.normal[q])
                    mean = mean_channel(seen.direct[q] + seen.indirect[q]) / n
                    variance += w * wp.max(seen.squares[q] / n - mean * mean, 0.0) * n
                    weights += w * (n - 1.0)
    n = float(seen.count[p])
    out.direct[p] = wp.vec3(0.0)
    out.indirect[p] = wp.vec3(0.0)
    out.variance[p] = -1.0
    if n > 0.0:
        out.direct[p] = seen.direct[p] / n
        out.indirect[p] = seen.indirect[p] / n
        # Alone on its surface: as uncertain as it is bright.
        single = mean_channel(out.direct[p] + out.indirect[p])
        out.variance[p] = wp.where(weights > 1.0e-6, variance / wp.max(weights, 1.0e-6), single * single) / n


@wp.struct
class _Lit:
    """Irradiance over π, in two parts, and how much is known of it."""

    direct: wp.vec3
    indirect: wp.vec3
    weight: float


@wp.func
def _interpolate(surfaces: Surfaces, layer: Layer, p: int, u: wp.vec2, point: Sight) -> _Lit:
    """Irradiance at a point seen through (u, v) of pixel `p`, from the pixels around that show its surface."""
    lit = _Lit()
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            x = p % surfaces.columns + dx
            y = p // surfaces.columns + dy
            if x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows:
                q = y * surfaces.columns + x
                fit = same_surface(surfaces, q, point.position, point.shading_normal)
                if fit > _MATCH and layer.variance[q] >= 0.0:
                    away = wp.vec2(u[0] - 0.5 - float(dx), u[1] - 0.5 - float(dy))
                    w = fit * wp.exp(-2.0 * wp.dot(away, away))
                    lit.direct += w * layer.direct[q]
                    lit.indirect += w * layer.indirect[q]
                    lit.weight += w
    return lit


@wp.func
def _uncertainty(surfaces: Surfaces, film: FilmData, p: int, share: float) -> float:
    """Variance of the film's mean at a pixel, averaged over its neighbours: that of few iterations is itself noise."""
    if share == 1.0:
        return 1.0e30  # one iteration says nothing about its error
    total = float(0.0)
    weights = float(0.0)
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            x = p % surfaces.columns + dx
            y = p // surfaces.columns + dy
            if x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows:
                q = y * surfaces.columns + x
                w = wp.where(dx == 0 and dy == 0, 4.0, 1.0)
                for c in range(3):
                    mean = (film.emission[q][c] + film.direct[q][c] + film.indirect[q][c]) * wp.float64(share)
                    spread = film.squares[q][c] * wp.float64(share) - mean * mean
                    total += w * wp.max(float(spread), 0.0) * (1.0 / 3.0)
                weights += w
    return total / weights * share / (1.0 - share)


@wp.func
def _on_edge(surfaces: Surfaces, film: FilmData, p: int) -> bool:
    """Whether any of the eight neighbours shows another surface, or none, or one that emits differently."""
    glow = film.emission[p][0] + film.emission[p][1] + film.emission[p][2]
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            x = p % surfaces.columns + dx
            y = p // surfaces.columns + dy
            if x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows:
                q = y * surfaces.columns + x
                other = film.emission[q][0] + film.emission[q][1] + film.emission[q][2]
                if wp.abs(other - glow) > wp.float64(0.01) * wp.max(other, glow):
                    return True
                if surfaces.footprint[q] > 0.0 or surfaces.footprint[p] > 0.0:
                    if same_surface(surfaces, p, surfaces.position[q], surfaces.normal[q]) < _MATCH:
                        return True
                    if surfaces.footprint[q] <= 0.0:
                        return True
    return False


@wp.kernel
def _compose(
    first: int,
    scene: SceneData,
    camera: CameraData,
    surfaces: Surfaces,
    layer: Layer,
    film: FilmData,
    weight: wp.vec3,
    out: wp.array2d[wp.vec3],
) -> None:
    """Radiance of a pixel from irradiance on surfaces; `weight` is (1 / iterations, exposure, edge rays)."""
    p = first + wp.tid()
    share = weight[0]
    emitted = wp.vec3(float(film.emission[p][0]), float(film.emission[p][1]), float(film.emission[p][2])) * share
    raw_direct = wp.vec3(float(film.direct[p][0]), float(film.direct[p][1]), float(film.direct[p][2])) * share
    raw_indirect = wp.vec3(float(film.indirect[p][0]), float(film.indirect[p][1]), float(film.indirect[p][2])) * share
    albedo = film.albedo[p] * share
    direct = wp.vec3(0.0)
    indirect = wp.vec3(0.0)
    if not _on_edge(surfaces, film, p):
        if surfaces.footprint[p] > 0.0 and layer.variance[p] >= 0.0:
            direct = wp.cw_mul(albedo, layer.direct[p]) * weight[1]
            indirect = wp.cw_mul(albedo, layer.indirect[p]) * weight[1]
        else:
            direct = raw_direct
            indirect = raw_indirect
    else:
        # The mean irradiance of the pixel itself, for what none of the neighbours shows.
        own_direct = wp.cw_div(raw_direct, wp.max(albedo, wp.vec3(1.0e-6)))
        own_indirect = wp.cw_div(raw_indirect, wp.max(albedo, wp.vec3(1.0e-6)))
        rays = int(weight[2])
        scramble = sampling.hash_combine(wp.uint32(p), _EDGE_JITTER)
        glow = wp.vec3(0.0)
        for k in range(rays):
            u = sampling.sample_2d(scene.sobol, k, 0, scramble)
            x = (float(p % camera.columns) + u[0]) / float(camera.columns)
            y = (float(p // camera.columns) + u[1]) / float(camera.rows)
            point = see(scene, camera, camera_ray(camera, x, y))
            glow += point.emission
            if point.mesh >= 0 and wp.max(point.albedo) > 0.0:
                lit = _interpolate(surfaces, layer, p, u, point)
                if lit.weight > 0.0:
                    direct += wp.cw_mul(point.albedo, lit.direct) * (weight[1] / lit.weight)
                    indirect += wp.cw_mul(point.albedo, lit.indirect) * (weight[1] / lit.weight)
                else:
                    direct += wp.cw_mul(point.albedo, own_direct)
                    indirect += wp.cw_mul(point.albedo, own_indirect)
        direct /= float(rays)
        indirect /= float(rays)
        glow *= weight[1] / float(rays)
        # The iterations have sampled the emission of this pixel too.
        n = 1.0 / share
        emitted = (emitted * n + glow * float(rays)) / (n + float(rays))
    if surfaces.footprint[p] > 0.0:
        # Nothing is believed that the plain mean contradicts.
        difference = mean_channel(direct + indirect - raw_direct - raw_indirect)
        squared = difference * difference / (_TRUST * _TRUST * _uncertainty(surfaces, film, p, share) + 1.0e-30)
        trust = 1.0 / (1.0 + squared * squared)
        direct = raw_direct + (direct - raw_direct) * trust
        indirect = raw_indirect + (indirect - raw_indirect) * trust
    out[0, p] = direct + emitted
    out[1, p] = indirect


class Reconstruction:
    """Gathers what the filter needs beside the film, and makes the picture of both."""

    def __init__(self, scene: DeviceScene, camera: Any, launcher: Launcher, gbuffer: Any, exposure: float) -> None:
        """Looks through the centre of every pixel; `gbuffer` is used as scratch."""
        self._scene, self._camera, self._launcher, self._exposure = scene, camera, launcher, exposure
        pixels = camera.columns * camera.rows
        self._pixels = pixels
        with launcher.phase("filter"):
            surfaces = Surfaces()
            surfaces.columns, surfaces.rows = camera.columns, camera.rows
            surfaces.position, surfaces.normal = launcher.zeros(pixels, wp.vec3), launcher.zeros(pixels, wp.vec3)
            surfaces.footprint = launcher.empty(pixels, wp.float32)
            trace_primary(scene, camera, launcher, gbuffer, iteration=-1, seed=0)
            launcher.launch(_look, pixels, [camera, gbuffer, surfaces])
            self._surfaces = surfaces
            self._seen = Observations()
            self._seen.direct, self._seen.indirect = launcher.zeros(pixels, wp.vec3), launcher.zeros(pixels, wp.vec3)
            self._seen.squares = launcher.zeros(pixels, wp.float32)
            self._seen.count = launcher.zeros(pixels, wp.int32)

    def observe(self, gbuffer: Any, direct: Any, indirect: Any) -> None:
        """Adds one iteration's samples of irradiance over π."""
        self._launcher.launch(_observe, self._pixels, [self._surfaces, gbuffer, direct, indirect, self._seen])

    def merge(self, other: "Reconstruction") -> None:
        """Adds another's samples."""
        for name in Observations.vars:
            mine, theirs = getattr(self._seen, name), getattr(other._seen, name)
            mine.assign(mine.numpy() + theirs.numpy())

    def resolve(self, film: Any, iterations: int) -> npt.NDArray[np.float32]:
        """Radiance by way of lights and of surfaces, float32 [2, rows, columns, 3], from a `FilmData`."""
        launcher, pixels = self._launcher, self._pixels
        with launcher.phase("filter"):
            layer = new_layer(pixels, launcher)
            launcher.launch(_average, pixels, [self._surfaces, self._seen, layer])
            layer = filter_layer(self._surfaces, layer, launcher)
            out = launcher.empty((2, pixels), wp.vec3)
            rays = min(max(iterations, _EDGE_RAYS[0]), _EDGE_RAYS[1])
            weight = wp.vec3(1.0 / iterations, self._exposure, float(rays))
            launcher.launch(
                _compose, pixels, [self._scene.data, self._camera, self._surfaces, layer, film, weight, out]
            )
            return np.asarray(out.numpy()).reshape(2, self._camera.rows, self._camera.columns, 3)
