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
from warp_ir.gbuffer import GBuffer, Sight, camera_ray, image_pixel, see, trace_primary
from warp_ir.launch import Launcher

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_EDGE_RAYS = (16, 256)
"""Camera rays for a pixel on an edge: at least, and at most; in between four for each iteration."""
_PROBES = wp.constant(8)  # of them, to see whether the edge is in the pixel
_PRIOR = wp.constant(8.0)  # samples of its own that outweigh what the neighbours say about a pixel's noise
_MATCH = wp.constant(0.2)  # of `same_surface`: below, a sample is not of that surface
_TRUST = wp.constant(3.0)  # standard errors by which the result may differ from the mean
_EDGE_JITTER = wp.constant(wp.uint32(0xBB67AE85))


@wp.struct
class Observations:
    """Sums over the samples of irradiance over π that fell on each pixel's surface, and of those on no pixel's."""

    surfaces: Surfaces
    direct: wp.array[wp.vec3]
    indirect: wp.array[wp.vec3]
    squares: wp.array[wp.vec2]  # of the two mean channels
    count: wp.array[wp.int32]
    other_direct: wp.array[wp.vec3]  # on surfaces that neither the pixel's centre shows nor a neighbour's
    other_indirect: wp.array[wp.vec3]
    other_count: wp.array[wp.int32]


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


@wp.func
def _shown_nearby(surfaces: Surfaces, p: int, position: wp.vec3, normal: wp.vec3) -> bool:
    """Whether a pixel or one of its eight neighbours shows the surface of a point."""
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            x = p % surfaces.columns + dx
            y = p // surfaces.columns + dy
            if x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows:
                if same_surface(surfaces, y * surfaces.columns + x, position, normal) > _MATCH:
                    return True
    return False


@wp.kernel
def _observe(
    first: int,
    gbuffer: GBuffer,
    direct: wp.array[wp.vec3],
    indirect: wp.array[wp.vec3],
    seen: Observations,
) -> None:
    """Adds one iteration's sample of a pixel to those on its surface, or on none."""
    p = first + wp.tid()
    surfaces = seen.surfaces
    if gbuffer.mesh[p] >= 0 and wp.max(gbuffer.albedo[p]) > 0.0:
        d = mean_channel(direct[p])
        i = mean_channel(indirect[p])
        if wp.isfinite(d) and wp.isfinite(i):
            if same_surface(surfaces, p, gbuffer.position[p], gbuffer.shading_normal[p]) > _MATCH:
                seen.direct[p] += direct[p]
                seen.indirect[p] += indirect[p]
                seen.squares[p] += wp.vec2(d * d, i * i)
                seen.count[p] += 1
            elif not _shown_nearby(surfaces, p, gbuffer.position[p], gbuffer.shading_normal[p]):
                seen.other_direct[p] += direct[p]
                seen.other_indirect[p] += indirect[p]
                seen.other_count[p] += 1


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
def _leave_out(first: int, seen: Observations, iterations: int, layer: Layer) -> None:
    """Makes a background of the pixels in which an iteration has seen more than the surface in their centre."""
    p = first + wp.tid()
    if seen.count[p] != iterations:
        seen.surfaces.footprint[p] = 0.0
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


@wp.struct
class _Pixel:
    """What camera rays through a pixel found: emitted and reflected radiance, without exposure."""

    emission: wp.vec3
    direct: wp.vec3
    indirect: wp.vec3
    rays: int


@wp.func
def _look_closely(
    scene: SceneData, camera: CameraData, seen: Observations, layer: Layer, p: int, own: _Lit, most: int
) -> _Pixel:
    """Sends rays through a pixel on an edge; `own` is the irradiance of what no pixel shows."""
    surfaces = seen.surfaces
    row = p // camera.columns
    column = p - row * camera.columns
    scramble = sampling.hash_combine(wp.uint32(image_pixel(camera, p)), _EDGE_JITTER)
    first_albedo = wp.vec3(0.0)
    first_emission = wp.vec3(0.0)
    mixed = bool(False)
    out = _Pixel()
    while out.rays < most and (mixed or out.rays < _PROBES):
        u = sampling.sample_2d(scene.sobol, out.rays, 0, scramble)
        point = see(scene, camera, camera_ray(camera, p, u, wp.vec2(0.0, 0.0)))
        if out.rays == 0:
            first_albedo = point.albedo
            first_emission = point.emission
        # Of one surface, the pixel needs no more rays: the edge lies in its neighbour.
        contrast = wp.length_sq(point.albedo - first_albedo) + wp.length_sq(point.emission - first_emission)
        mixed = mixed or contrast > 0.0 or point.mesh < 0
        mixed = mixed or same_surface(surfaces, p, point.position, point.shading_normal) < _MATCH
        out.rays += 1
        out.emission += point.emission
        if point.mesh >= 0 and wp.max(point.albedo) > 0.0:
            lit = _interpolate(surfaces, layer, row, column, u, point)
            if lit.weight == 0.0:
                lit = own
            out.direct += wp.cw_mul(point.albedo, lit.direct) / lit.weight
            out.indirect += wp.cw_mul(point.albedo, lit.indirect) / lit.weight
    out.emission = out.emission / float(out.rays)
    out.direct = out.direct / float(out.rays)
    out.indirect = out.indirect / float(out.rays)
    return out


@wp.func
def _single(v: wp.vec3d) -> wp.vec3:
    return wp.vec3(float(v[0]), float(v[1]), float(v[2]))


@wp.kernel
def _compose(
    first: int,
    scene: SceneData,
    camera: CameraData,
    seen: Observations,
    layer: Layer,
    film: FilmData,
    weight: wp.vec3,
    out: wp.array2d[wp.vec3],
) -> None:
    """Radiance of a pixel from irradiance on surfaces; `weight` is (1 / iterations, exposure, edge rays)."""
    p = first + wp.tid()
    surfaces = seen.surfaces
    share = weight[0]
    exposure = weight[1]
    emitted = _single(film.emission[p]) * share
    raw_direct = _single(film.direct[p]) * share
    raw_indirect = _single(film.indirect[p]) * share
    albedo = film.albedo[p] * share
    direct = raw_direct
    indirect = raw_indirect
    if camera.blurs == 0 and _on_edge(surfaces, film, p):
        # What neither the pixel nor a neighbour shows is lit like such samples, if there were any, or like all.
        own = _Lit()
        own.weight = float(seen.other_count[p])
        own.direct = seen.other_direct[p]
        own.indirect = seen.other_indirect[p]
        if seen.other_count[p] == 0:
            own.weight = exposure
            own.direct = wp.cw_div(raw_direct, wp.max(albedo, wp.vec3(1.0e-6)))
            own.indirect = wp.cw_div(raw_indirect, wp.max(albedo, wp.vec3(1.0e-6)))
        pixel = _look_closely(scene, camera, seen, layer, p, own, int(weight[2]))
        direct = pixel.direct * exposure
        indirect = pixel.indirect * exposure
        # The iterations have sampled the emission of this pixel too.
        n = 1.0 / share
        rays = float(pixel.rays)
        emitted = (emitted * n + pixel.emission * (exposure * rays)) / (n + rays)
    elif surfaces.footprint[p] > 0.0 and layer.direct[p][3] >= 0.0:
        direct = wp.cw_mul(albedo, _color(layer.direct[p])) * exposure
        indirect = wp.cw_mul(albedo, _color(layer.indirect[p])) * exposure
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
            seen = Observations()
            seen.surfaces = surfaces
            for name in ("direct", "indirect", "other_direct", "other_indirect"):
                setattr(seen, name, launcher.zeros(pixels, wp.vec3))
            seen.squares = launcher.zeros(pixels, wp.vec2)
            seen.count, seen.other_count = launcher.zeros(pixels, wp.int32), launcher.zeros(pixels, wp.int32)
            self._seen = seen

    def observe(self, gbuffer: Any, direct: Any, indirect: Any) -> None:
        """Adds one iteration's samples of irradiance over π."""
        self._launcher.launch(_observe, self._pixels, [gbuffer, direct, indirect, self._seen])

    def arrays(self) -> dict[str, Any]:
        """The samples so far, by name: sums that add up when films are merged, and go on when one is resumed."""
        return {name: getattr(self._seen, name) for name in Observations.vars if name != "surfaces"}

    def merge(self, other: "Reconstruction") -> None:
        """Adds another's samples."""
        for mine, theirs in zip(self.arrays().values(), other.arrays().values(), strict=True):
            mine.assign(mine.numpy() + theirs.numpy())

    def resolve(self, film: Any, iterations: int) -> npt.NDArray[np.float32]:
        """Radiance by way of lights and of surfaces, float32 [2, rows, columns, 3], from a `FilmData`."""
        launcher, pixels = self._launcher, self._pixels
        with launcher.phase("filter"):
            seen, layer = self._seen, new_layer(pixels, launcher)
            launcher.launch(_average, pixels, [seen.surfaces, seen, layer])
            if self._camera.blurs:
                seen = _copy(Observations, seen)
                seen.surfaces = _copy(Surfaces, seen.surfaces)
                seen.surfaces.footprint = wp.clone(seen.surfaces.footprint)
                launcher.launch(_leave_out, pixels, [seen, iterations, layer])
            layer = filter_layer(seen.surfaces, layer, launcher)
            out = launcher.empty((2, pixels), wp.vec3)
            rays = min(max(4 * iterations, _EDGE_RAYS[0]), _EDGE_RAYS[1])
            weight = wp.vec3(1.0 / iterations, self._exposure, float(rays))
            launcher.launch(_compose, pixels, [self._scene.data, self._camera, seen, layer, film, weight, out])
            return np.asarray(out.numpy()).reshape(2, self._camera.rows, self._camera.columns, 3)


def _copy(kind: Any, record: Any) -> Any:
    """Another record of some kind, of the same arrays."""
    copy = kind()
    for name in kind.vars:
        setattr(copy, name, getattr(record, name))
    return copy
