"""The picture from few samples: irradiance is filtered on surfaces, edges are sampled apart from it.

A pixel stands for the surface seen through its centre. Samples of irradiance that fall on it are averaged there and
filtered (`filter`): no pixel mixes surfaces, so edges do not stop the filter. What a pixel on an edge shows is then
found by many cheap camera rays, each taking the irradiance of the neighbouring pixel whose surface it meets.

Through a lens or an open shutter a pixel sees surfaces that its centre does not tell of. Then only the pixels that have
met nothing but the surface in their centre are filtered; the others keep their plain mean.

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

_EDGE_RAYS = (16, 256)
"""Camera rays for a pixel on an edge: at least, and at most; in between four for each iteration."""
_PROBES = wp.constant(8)  # of them, to see whether the edge is in the pixel
_PRIOR = wp.constant(8.0)  # samples of its own that outweigh what the neighbours say about a pixel's noise
_MATCH = wp.constant(0.2)  # of `same_surface`: below, a sample is not of that surface
_TRUST = wp.constant(3.0)  # standard errors by which the result may differ from the mean
_EDGE_JITTER = wp.constant(wp.uint32(0xBB67AE85))


@wp.struct
class Observations:
    """Sums over the samples of irradiance over π that fell on each pixel's surface."""

    direct: wp.array[wp.vec3]
    indirect: wp.array[wp.vec3]
    squares: wp.array[wp.vec2]  # of the two mean channels
    count: wp.array[wp.int32]


@wp.kernel
def _look(first: int, camera: CameraData, gbuffer: GBuffer, surfaces: Surfaces) -> None:
    """Notes what is seen through the centre of each pixel."""
    p = first + wp.tid()
    surfaces.footprint[p] = 0.0
    if gbuffer.mesh[p] >= 0:
        surfaces.position[p] = gbuffer.position[p]
        surfaces.normal[p] = gbuffer.shading_normal[p]
        size = camera.height / float(camera.image_rows)
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
            d = mean_channel(direct[p])
            i = mean_channel(indirect[p])
            if wp.isfinite(d) and wp.isfinite(i):
                seen.direct[p] += direct[p]
                seen.indirect[p] += indirect[p]
                seen.squares[p] += wp.vec2(d * d, i * i)
                seen.count[p] += 1


@wp.kernel
def _average(first: int, surfaces: Surfaces, seen: Observations, out: Layer) -> None:
    """Means and their variance, from the spread of the pixel and, more so the fewer its samples, of its neighbours."""
    p = first + wp.tid()
    row = p // surfaces.columns
    column = p - row * surfaces.columns
    spread = wp.vec2(0.0)
    weights = float(0.0)
    for dy in range(-2, 3):
        for dx in range(-2, 3):
            x = column + 2 * dx
            y = row + 2 * dy
            if x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows:
                q = y * surfaces.columns + x
                if seen.count[q] > 1:
                    w = same_surface(surfaces, p, surfaces.position[q], surfaces.normal[q])
                    spread += w * _spread(seen, q)
                    weights += w * float(seen.count[q] - 1)
    n = float(seen.count[p])
    out.direct[p] = wp.vec4(0.0, 0.0, 0.0, -1.0)
    out.indirect[p] = wp.vec4(0.0, 0.0, 0.0, -1.0)
    if n > 0.0:
        direct = seen.direct[p] / n
        indirect = seen.indirect[p] / n
        # Alone on its surface: as uncertain as it is bright.
        single = wp.vec2(mean_channel(direct), mean_channel(indirect))
        variance = wp.cw_mul(single, single)
        if weights > 1.0e-6:
            variance = (_PRIOR * spread / weights + _spread(seen, p)) / (_PRIOR + n - 1.0)
        out.direct[p] = wp.vec4(direct[0], direct[1], direct[2], variance[0] / n)
        out.indirect[p] = wp.vec4(indirect[0], indirect[1], indirect[2], variance[1] / n)


@wp.func
def _spread(seen: Observations, q: int) -> wp.vec2:
    """Sums of the squared deviations from the means."""
    d = mean_channel(seen.direct[q])
    i = mean_channel(seen.indirect[q])
    return wp.max(seen.squares[q] - wp.vec2(d * d, i * i) / float(seen.count[q]), wp.vec2(0.0))


@wp.kernel
def _leave_out(first: int, seen: Observations, iterations: int, surfaces: Surfaces, layer: Layer) -> None:
    """Makes a background of the pixels in which an iteration has seen more than the surface in their centre."""
    p = first + wp.tid()
    if seen.count[p] != iterations:
        surfaces.footprint[p] = 0.0
        layer.direct[p] = wp.vec4(0.0, 0.0, 0.0, -1.0)
        layer.indirect[p] = wp.vec4(0.0, 0.0, 0.0, -1.0)


@wp.struct
class _Lit:
    """Irradiance over π, in two parts, and how much is known of it."""

    direct: wp.vec3
    indirect: wp.vec3
    weight: float


@wp.func
def _color(v: wp.vec4) -> wp.vec3:
    return wp.vec3(v[0], v[1], v[2])


@wp.func
def _add_neighbor(surfaces: Surfaces, layer: Layer, q: int, away: wp.vec2, point: Sight, lit: _Lit) -> _Lit:
    """Adds the irradiance of pixel `q`, if it shows the surface of a point seen `away` from its centre [pixels]."""
    out = lit
    direct = layer.direct[q]
    if direct[3] >= 0.0:
        fit = same_surface(surfaces, q, point.position, point.shading_normal)
        if fit > _MATCH:
            w = fit / (0.25 + wp.dot(away, away))
            out.direct += w * _color(direct)
            out.indirect += w * _color(layer.indirect[q])
            out.weight += w
    return out


@wp.func
def _interpolate(surfaces: Surfaces, layer: Layer, row: int, column: int, u: wp.vec2, point: Sight) -> _Lit:
    """Irradiance at a point seen through (u, v) of a pixel: from the four pixels around that show its surface.

    Or from any of the nine, if none of the four does.
    """
    lit = _Lit()
    nearest_x = wp.where(u[0] < 0.5, -1, 1)
    nearest_y = wp.where(u[1] < 0.5, -1, 1)
    for ring in range(2):
        if lit.weight == 0.0:
            for dy in range(-1, 2):
                for dx in range(-1, 2):
                    x = column + dx
                    y = row + dy
                    near = dx != -nearest_x and dy != -nearest_y
                    inside = x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows
                    if inside and near == (ring == 0):
                        away = wp.vec2(u[0] - 0.5 - float(dx), u[1] - 0.5 - float(dy))
                        lit = _add_neighbor(surfaces, layer, y * surfaces.columns + x, away, point, lit)
    return lit


@wp.func
def _uncertainty(surfaces: Surfaces, film: FilmData, p: int, share: float) -> float:
    """Variance of the film's mean at a pixel, averaged over its neighbours: that of few iterations is itself noise."""
    if share == 1.0:
        return 1.0e30  # one iteration says nothing about its error
    n = 1.0 / share
    total = float(0.0)
    weights = float(0.0)
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            x = p % surfaces.columns + dx
            y = p // surfaces.columns + dy
            if x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows:
                q = y * surfaces.columns + x
                w = wp.where(dx == 0 and dy == 0, n + 2.0, 1.0)
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
    if camera.blurs == 1 or not _on_edge(surfaces, film, p):
        if surfaces.footprint[p] > 0.0 and layer.direct[p][3] >= 0.0:
            direct = wp.cw_mul(albedo, _color(layer.direct[p])) * weight[1]
            indirect = wp.cw_mul(albedo, _color(layer.indirect[p])) * weight[1]
        else:
            direct = raw_direct
            indirect = raw_indirect
    else:
        # The mean irradiance of the pixel itself, for what none of the neighbours shows.
        own_direct = wp.cw_div(raw_direct, wp.max(albedo, wp.vec3(1.0e-6)))
        own_indirect = wp.cw_div(raw_indirect, wp.max(albedo, wp.vec3(1.0e-6)))
        rays = int(0)
        mixed = bool(False)
        scramble = sampling.hash_combine(wp.uint32(p), _EDGE_JITTER)
        row = p // camera.columns
        column = p - row * camera.columns
        glow = wp.vec3(0.0)
        first_albedo = wp.vec3(0.0)
        first_glow = wp.vec3(0.0)
        while rays < int(weight[2]) and (mixed or rays < _PROBES):
            u = sampling.sample_2d(scene.sobol, rays, 0, scramble)
            point = see(scene, camera, camera_ray(camera, p, u, wp.vec2(0.0, 0.0)))
            if rays == 0:
                first_albedo = point.albedo
                first_glow = point.emission
            glow += point.emission
            # Of one surface, the pixel needs no more rays: the edge lies in its neighbour.
            mixed = mixed or wp.length_sq(point.albedo - first_albedo) + wp.length_sq(point.emission - first_glow) > 0.0
            mixed = mixed or point.mesh < 0 or surfaces.footprint[p] <= 0.0
            mixed = mixed or same_surface(surfaces, p, point.position, point.shading_normal) < _MATCH
            rays += 1
            if point.mesh >= 0 and wp.max(point.albedo) > 0.0:
                lit = _interpolate(surfaces, layer, row, column, u, point)
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
            self._seen.squares = launcher.zeros(pixels, wp.vec2)
            self._seen.count = launcher.zeros(pixels, wp.int32)

    def observe(self, gbuffer: Any, direct: Any, indirect: Any) -> None:
        """Adds one iteration's samples of irradiance over π."""
        self._launcher.launch(_observe, self._pixels, [self._surfaces, gbuffer, direct, indirect, self._seen])

    def arrays(self) -> dict[str, Any]:
        """The samples so far, by name: sums that add up when films are merged, and go on when one is resumed."""
        return {name: getattr(self._seen, name) for name in Observations.vars}

    def merge(self, other: "Reconstruction") -> None:
        """Adds another's samples."""
        for mine, theirs in zip(self.arrays().values(), other.arrays().values(), strict=True):
            mine.assign(mine.numpy() + theirs.numpy())

    def resolve(self, film: Any, iterations: int) -> npt.NDArray[np.float32]:
        """Radiance by way of lights and of surfaces, float32 [2, rows, columns, 3], from a `FilmData`."""
        launcher, pixels = self._launcher, self._pixels
        with launcher.phase("filter"):
            surfaces, layer = self._surfaces, new_layer(pixels, launcher)
            launcher.launch(_average, pixels, [surfaces, self._seen, layer])
            if self._camera.blurs:
                surfaces = _copy(surfaces)
                launcher.launch(_leave_out, pixels, [self._seen, iterations, surfaces, layer])
            layer = filter_layer(surfaces, layer, launcher)
            out = launcher.empty((2, pixels), wp.vec3)
            rays = min(max(4 * iterations, _EDGE_RAYS[0]), _EDGE_RAYS[1])
            weight = wp.vec3(1.0 / iterations, self._exposure, float(rays))
            launcher.launch(_compose, pixels, [self._scene.data, self._camera, surfaces, layer, film, weight, out])
            return np.asarray(out.numpy()).reshape(2, self._camera.rows, self._camera.columns, 3)


def _copy(surfaces: Any) -> Any:
    """The `Surfaces` with a footprint of their own."""
    copy = Surfaces()
    for name in Surfaces.vars:
        setattr(copy, name, getattr(surfaces, name))
    copy.footprint = wp.clone(surfaces.footprint)
    return copy
