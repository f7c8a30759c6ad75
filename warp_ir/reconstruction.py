"""The picture from few samples: irradiance is filtered on surfaces, edges are sampled apart from it.

A pixel stands for the surface seen through its centre. Samples of irradiance that fall on it are averaged there and
filtered (`filter`): no pixel mixes surfaces, so edges do not stop the filter. What a pixel on an edge shows is then
found by many cheap camera rays, each taking the irradiance of the neighbouring pixel whose surface it meets.

Through a lens or an open shutter a pixel sees surfaces that its centre does not tell of. Then only the pixels that have
met nothing but the surface in their centre are filtered; the others keep their plain mean.

Where that leaves the plain mean by more than the noise explains, the mean is believed: the bias vanishes with the
noise. On edges a part of the difference is given back, as much of it as is not noise (James and Stein 1961).
"""

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device_scene import CameraData, DeviceScene, SceneData
from warp_ir.film import FilmData
from warp_ir.filter import Layer, Surfaces, filter_layer, mean_channel, new_layer, same_surface
from warp_ir.gbuffer import GBuffer, Sight, camera_ray, jitter, see, trace_primary
from warp_ir.launch import Launcher

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_MOST_EDGE_RAYS = 256
_PROBES = wp.constant(8)  # of them, to see whether the edge is in the pixel
_PRIOR = wp.constant(8.0)  # samples of its own that outweigh what the neighbours say about a pixel's noise
_MATCH = wp.constant(0.2)  # of `same_surface`: below, a sample is not of that surface
_AROUND = wp.constant(4.0)  # samples of its own that outweigh what the neighbours say about a pixel's brightness
_TRUST = wp.constant(8.0)  # standard errors by which the result may differ from the mean, away from edges
_WINDOW = wp.constant(2)  # pixels to each side that tell how much of a difference is noise


@wp.struct
class Observations:
    """Sums over the samples of irradiance over π that fell on each pixel's surface, and of those on no pixel's."""

    surfaces: Surfaces
    direct: wp.array[wp.vec3]
    indirect: wp.array[wp.vec3]
    squares: wp.array[wp.vec2]  # of the two mean channels
    count: wp.array[wp.int32]
    noise: wp.array[wp.vec2]  # variance of one sample of the two mean channels; worked out when the picture is made
    other_direct: wp.array[wp.vec3]  # on surfaces that neither the pixel's centre shows nor a neighbour's
    other_indirect: wp.array[wp.vec3]
    other_count: wp.array[wp.int32]
    seed: wp.uint32  # of the film


@wp.struct
class Picture:
    """What becomes of it all, and what it lacks on edges."""

    rows: wp.array2d[wp.vec3]  # radiance by way of lights, of surfaces; if there are five, albedo, normal, plain mean
    rest: Layer  # plain mean less picture, and the variance of that by noise; -1: not on an edge
    iterations: int
    edge_rays: int


@wp.kernel
def _look(first: int, camera: CameraData, gbuffer: GBuffer, surfaces: Surfaces) -> None:
    """Notes what is seen through the centre of each pixel."""
    p = first + wp.tid()
    surfaces.footprint[p] = 0.0
    if gbuffer.mesh[p] >= 0:
        surfaces.position[p] = gbuffer.position[p]
        surfaces.normal[p] = gbuffer.smooth_normal[p]
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
            if same_surface(surfaces, p, gbuffer.position[p], gbuffer.smooth_normal[p]) > _MATCH:
                seen.direct[p] += direct[p]
                seen.indirect[p] += indirect[p]
                seen.squares[p] += wp.vec2(d * d, i * i)
                seen.count[p] += 1
            elif not _shown_nearby(surfaces, p, gbuffer.position[p], gbuffer.smooth_normal[p]):
                seen.other_direct[p] += direct[p]
                seen.other_indirect[p] += indirect[p]
                seen.other_count[p] += 1


@wp.kernel
def _average(first: int, surfaces: Surfaces, seen: Observations, out: Layer) -> None:
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
                    sums = w * _means(seen.direct[q], seen.indirect[q])
                    w_free = w * float(seen.count[q] - 1)
                    spread += w * _spread(seen, q)
                    around += sums * (float(seen.count[q] - 1) / float(seen.count[q]))
                    weights += w_free
                    firsts += sums
                    squares += w * seen.squares[q]
                    samples += w * float(seen.count[q])
    n = float(seen.count[p])
    out.direct[p] = wp.vec4(0.0, 0.0, 0.0, -1.0)
    out.indirect[p] = wp.vec4(0.0, 0.0, 0.0, -1.0)
    if n > 0.0:
        direct = seen.direct[p] / n
        indirect = seen.indirect[p] / n
        # Alone on its surface: as uncertain as it is bright.
        own = _means(direct, indirect)
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
def _means(direct: wp.vec3, indirect: wp.vec3) -> wp.vec2:
    return wp.vec2(mean_channel(direct), mean_channel(indirect))


@wp.func
def _spread(seen: Observations, q: int) -> wp.vec2:
    """Sums of the squared deviations from the means."""
    sums = _means(seen.direct[q], seen.indirect[q])
    return wp.max(seen.squares[q] - wp.cw_mul(sums, sums) / float(seen.count[q]), wp.vec2(0.0))


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
    """Irradiance over π in two parts, and the variance of a sample of them, all times the weight."""

    direct: wp.vec3
    indirect: wp.vec3
    noise: wp.vec2
    weight: float


@wp.func
def _color(v: wp.vec4) -> wp.vec3:
    return wp.vec3(v[0], v[1], v[2])


@wp.func
def _add_neighbor(seen: Observations, layer: Layer, q: int, away: wp.vec2, point: Sight, lit: _Lit) -> _Lit:
    """Adds the irradiance of pixel `q`, if it shows the surface of a point seen `away` from its centre [pixels]."""
    out = lit
    direct = layer.direct[q]
    if direct[3] >= 0.0:
        fit = same_surface(seen.surfaces, q, point.position, point.smooth_normal)
        if fit > _MATCH:
            w = fit / (0.25 + wp.dot(away, away))
            out.direct += w * _color(direct)
            out.indirect += w * _color(layer.indirect[q])
            out.noise += w * seen.noise[q]
            out.weight += w
    return out


@wp.func
def _interpolate(seen: Observations, layer: Layer, row: int, column: int, u: wp.vec2, point: Sight) -> _Lit:
    """Irradiance at a point seen through (u, v) of a pixel: from the four pixels around that show its surface.

    Or from any of the nine, if none of the four does.
    """
    lit = _Lit()
    surfaces = seen.surfaces
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
                        lit = _add_neighbor(seen, layer, y * surfaces.columns + x, away, point, lit)
    return lit


@wp.func
def _differ(surfaces: Surfaces, p: int, q: int) -> bool:
    """Whether two pixels show different surfaces, or only one shows any."""
    if surfaces.footprint[p] <= 0.0 and surfaces.footprint[q] <= 0.0:
        return False
    return surfaces.footprint[q] <= 0.0 or same_surface(surfaces, p, surfaces.position[q], surfaces.normal[q]) < _MATCH


@wp.kernel
def _find_edges(first: int, surfaces: Surfaces, out: wp.array[wp.int32]) -> None:
    """1 where any of the eight neighbours shows something else."""
    p = first + wp.tid()
    out[p] = 0
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            x = p % surfaces.columns + dx
            y = p // surfaces.columns + dy
            if x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows:
                if _differ(surfaces, p, y * surfaces.columns + x):
                    out[p] = 1


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
                if wp.abs(other - glow) > wp.float64(0.01) * wp.max(other, glow) or _differ(surfaces, p, q):
                    return True
    return False


@wp.struct
class _Pixel:
    """What camera rays through a pixel found: emitted and reflected radiance, without exposure."""

    emission: wp.vec3
    direct: wp.vec3
    indirect: wp.vec3
    rays: int
    own_direct: wp.vec3  # the same by the film's own rays alone
    own_indirect: wp.vec3
    own_noise: wp.vec2  # variance that light gives one of these
    albedo: wp.vec3
    normal: wp.vec3


@wp.func
def _look_closely(
    scene: SceneData, camera: CameraData, seen: Observations, layer: Layer, p: int, other: _Lit, rays: wp.vec2i
) -> _Pixel:
    """Sends rays through a pixel on an edge: as many as `rays` says, the first of which are those of the film.

    `other` is the irradiance of what no pixel shows.
    """
    surfaces = seen.surfaces
    row = p // camera.columns
    column = p - row * camera.columns
    first_albedo = wp.vec3(0.0)
    first_emission = wp.vec3(0.0)
    mixed = bool(False)
    out = _Pixel()
    while out.rays < rays[1] and (mixed or out.rays < _PROBES):
        u = jitter(scene, camera, p, out.rays, seen.seed)
        point = see(scene, camera, camera_ray(camera, p, u, wp.vec2(0.0, 0.0)))
        if out.rays == 0:
            first_albedo = point.albedo
            first_emission = point.emission
        # Of one surface, the pixel needs no more rays: the edge lies in its neighbour.
        contrast = wp.length_sq(point.albedo - first_albedo) + wp.length_sq(point.emission - first_emission)
        mixed = mixed or contrast > 0.0 or point.mesh < 0
        mixed = mixed or same_surface(surfaces, p, point.position, point.smooth_normal) < _MATCH
        out.rays += 1
        out.emission += point.emission
        out.albedo += point.albedo
        out.normal += point.shading_normal
        if point.mesh >= 0 and wp.max(point.albedo) > 0.0:
            lit = _interpolate(seen, layer, row, column, u, point)
            if lit.weight == 0.0:
                lit = other
            out.direct += wp.cw_mul(point.albedo, lit.direct) / lit.weight
            out.indirect += wp.cw_mul(point.albedo, lit.indirect) / lit.weight
            reflected = mean_channel(point.albedo)
            out.own_noise += reflected * reflected * lit.noise / lit.weight
        if out.rays <= rays[0]:
            out.own_direct = out.direct / float(out.rays)
            out.own_indirect = out.indirect / float(out.rays)
    out.emission = out.emission / float(out.rays)
    out.direct = out.direct / float(out.rays)
    out.indirect = out.indirect / float(out.rays)
    out.own_noise = out.own_noise / float(out.rays)
    return out


@wp.func
def _single(v: wp.vec3d) -> wp.vec3:
    return wp.vec3(float(v[0]), float(v[1]), float(v[2]))


@wp.func
def _student(n: float) -> float:
    """What noise makes of (difference / standard error)² on average, the error being estimated from n samples."""
    return wp.where(n > 3.5, (n - 1.0) / wp.max(n - 3.0, 1.0), 1.0e30)


@wp.func
def _give_back(difference: wp.vec3, variance: float, n: float) -> wp.vec3:
    """What is to be believed of a difference between the plain mean and the result, by itself."""
    d = mean_channel(difference)
    ratio = _TRUST * _TRUST * _student(n) * variance / (d * d + 1.0e-30)
    return difference / (1.0 + ratio * ratio)


@wp.kernel
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
    emitted = _single(film.emission[p]) / n
    raw_direct = _single(film.direct[p]) / n
    raw_indirect = _single(film.indirect[p]) / n
    albedo = film.albedo[p] / n
    normal = film.normal[p] / n
    plain = emitted + raw_direct + raw_indirect
    out.rest.direct[p] = wp.vec4(0.0, 0.0, 0.0, -1.0)
    direct = raw_direct
    indirect = raw_indirect
    on_edge = seen.count[p] != out.iterations or _on_edge(surfaces, film, p)
    if camera.blurs == 0 and on_edge:
        # What neither the pixel nor a neighbour shows is lit like such samples, if there were any, or like all.
        other = _Lit()
        other.weight = float(seen.other_count[p])
        other.direct = seen.other_direct[p]
        other.indirect = seen.other_indirect[p]
        if seen.other_count[p] == 0:
            other.weight = exposure
            other.direct = wp.cw_div(raw_direct, wp.max(albedo, wp.vec3(1.0e-6)))
            other.indirect = wp.cw_div(raw_indirect, wp.max(albedo, wp.vec3(1.0e-6)))
        means = _means(other.direct, other.indirect)
        other.noise = wp.cw_mul(means, means) / other.weight
        pixel = _look_closely(scene, camera, seen, layer, p, other, wp.vec2i(out.iterations, out.edge_rays))
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
        direct = wp.cw_mul(albedo, _color(layer.direct[p])) * exposure
        indirect = wp.cw_mul(albedo, _color(layer.indirect[p])) * exposure
        reflected = mean_channel(albedo) * exposure
        noise = seen.noise[p] * (reflected * reflected / n)
        direct += _give_back(raw_direct - direct, noise[0], n)
        indirect += _give_back(raw_indirect - indirect, noise[1], n)
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
                        means = _means(_color(d), _color(i))
                        w = 1.0 / (1.0 + 0.5 * float(dx * dx + dy * dy))
                        ratio += w * wp.cw_div(wp.cw_mul(means, means), wp.vec2(d[3], i[3]) + wp.vec2(1.0e-30))
                        weights += w
        noise = _student(float(out.iterations)) * weights
        d = out.rest.direct[p]
        i = out.rest.indirect[p]
        out.rows[0, p] = out.rows[0, p] + _color(d) * wp.max(1.0 - noise / (ratio[0] + 1.0e-30), 0.0)
        out.rows[1, p] = out.rows[1, p] + _color(i) * wp.max(1.0 - noise / (ratio[1] + 1.0e-30), 0.0)


_FILTER_PASSES = 6.0
"""Filtering takes as long as so many passes of camera rays: fewer where rays are dear."""


def _edge_rays(iterations: int) -> int:
    """Camera rays for a pixel on an edge: what edges lack then is little beside noise."""
    return min(16 + 2 * iterations, _MOST_EDGE_RAYS)


_NO_SUMS = ("surfaces", "noise", "seed")


class Reconstruction:
    """Gathers what the filter needs beside the film, and makes the picture of both."""

    def __init__(
        self, scene: DeviceScene, camera: Any, launcher: Launcher, gbuffer: Any, exposure: float, seed: int
    ) -> None:
        """Looks through the centre of every pixel; `gbuffer` is used as scratch, `seed` is that of the film."""
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
            launcher.launch(_find_edges, pixels, [surfaces, gbuffer.mesh])
            self._on_edges = float(gbuffer.mesh.numpy().mean())
            seen = Observations()
            seen.surfaces = surfaces
            for name in ("direct", "indirect", "other_direct", "other_indirect"):
                setattr(seen, name, launcher.zeros(pixels, wp.vec3))
            seen.squares, seen.noise = launcher.zeros(pixels, wp.vec2), launcher.zeros(pixels, wp.vec2)
            seen.seed = wp.uint32(seed)
            seen.count, seen.other_count = launcher.zeros(pixels, wp.int32), launcher.zeros(pixels, wp.int32)
            self._seen = seen

    def observe(self, gbuffer: Any, direct: Any, indirect: Any) -> None:
        """Adds one iteration's samples of irradiance over π."""
        self._launcher.launch(_observe, self._pixels, [gbuffer, direct, indirect, self._seen])

    def arrays(self) -> dict[str, Any]:
        """The samples so far, by name: sums that add up when films are merged, and go on when one is resumed."""
        return {name: getattr(self._seen, name) for name in Observations.vars if name not in _NO_SUMS}

    def merge(self, other: "Reconstruction") -> None:
        """Adds another's samples."""
        for mine, theirs in zip(self.arrays().values(), other.arrays().values(), strict=True):
            mine.assign(mine.numpy() + theirs.numpy())

    def passes(self, iterations: int) -> float:
        """How many times as long as camera rays through all pixels `resolve` will take, roughly."""
        # Of two pixels next to an edge one is of one surface, and soon done.
        return _FILTER_PASSES + 0.5 * self._on_edges * _edge_rays(iterations)

    def resolve(self, film: Any, iterations: int, features: bool = False) -> npt.NDArray[np.float32]:
        """Radiance by way of lights and of surfaces, from a `FilmData`: float32 [2, rows, columns, 3].

        With `features` [5, ...]: after it come albedo, normals, and the plain mean, all with edges as smooth as the
        picture's.
        """
        launcher, pixels = self._launcher, self._pixels
        with launcher.phase("filter"):
            seen, layer = self._seen, new_layer(pixels, launcher)
            launcher.launch(_average, pixels, [seen.surfaces, seen, layer])
            if self._camera.blurs:
                seen = _copy(Observations, seen)
                seen.surfaces = _copy(Surfaces, seen.surfaces)
                seen.surfaces.footprint = wp.clone(seen.surfaces.footprint)
                launcher.launch(_leave_out, pixels, [seen, iterations, layer])
            layer, scratch = filter_layer(seen.surfaces, layer, launcher)
            out = Picture()
            out.rows, out.rest = launcher.empty((5 if features else 2, pixels), wp.vec3), scratch
            out.iterations = iterations
            out.edge_rays = _edge_rays(iterations)
            inputs = [self._scene.data, self._camera, seen, layer, film, self._exposure, out]
            launcher.launch(_compose, pixels, inputs)
            launcher.launch(_correct_edges, pixels, [seen.surfaces, out])
            return np.asarray(out.rows.numpy()).reshape(-1, self._camera.rows, self._camera.columns, 3)


def _copy(kind: Any, record: Any) -> Any:
    """Another record of some kind, of the same arrays."""
    copy = kind()
    for name in kind.vars:
        setattr(copy, name, getattr(record, name))
    return copy
