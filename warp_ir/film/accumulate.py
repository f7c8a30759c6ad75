"""The film's arrays on the device, and the kernel that adds an iteration to them.

Mean and standard deviation are updated by the difference of each iteration from the running mean (Welford 1962).
Rounding errors decay with the running mean, so float32 does not drift over a hundred thousand iterations.
"""

from typing import Any

import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.gbuffer import GBuffer
from warp_ir.tiles import indices, pixel_at

wp.set_module_options({"enable_backward": False, "max_unroll": 0})


@wp.struct
class FilmData:
    """Means of the radiance and sums of the other quantities over the iterations; one row per pixel."""

    count: wp.array[wp.int32]  # iterations
    emission: wp.array[wp.vec3]  # no rows if the camera cannot see emission
    direct: wp.array[wp.vec3]  # radiance of light that was reflected once
    indirect: wp.array[wp.vec3]
    standard_deviation: wp.array[wp.vec3]  # of emission + direct + indirect
    albedo: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]
    position: wp.array[wp.vec3]
    depth: wp.array[wp.float32]
    hits: wp.array[wp.int32]  # iterations in which the camera ray met a surface
    lights: wp.array[wp.int32]  # those in which it met lights alone; no rows if the camera sees no lights
    rejected: wp.array[wp.int32]  # iterations whose radiance was not finite
    mesh: wp.array[wp.int32]  # index into Scene.meshes, from the first iteration; -1: background


FIELDS: dict[str, Any] = {name: field.type.dtype for name, field in FilmData.vars.items()}
"""The arrays of a `FilmData`: name -> Warp's type of a row."""


@wp.func
def _is_finite(v: wp.vec3) -> bool:
    return wp.isfinite(v[0]) and wp.isfinite(v[1]) and wp.isfinite(v[2])


@wp.func
def _update_standard_deviation(old: wp.vec3, difference: wp.vec3, weight: float) -> wp.vec3:
    """Standard deviation after adding a sample of a given weight, 1 / count, and difference from the old mean."""
    # The squares are scaled so that they neither overflow nor underflow.
    scale = wp.max(wp.max(wp.max(old), wp.max(wp.abs(difference))), 1.0e-37)
    a = old * (1.0 / scale)
    b = difference * (1.0 / scale)
    variance = (wp.cw_mul(a, a) + wp.cw_mul(b, b) * weight) * (1.0 - weight)
    return wp.vec3(wp.sqrt(variance[0]), wp.sqrt(variance[1]), wp.sqrt(variance[2])) * scale


@wp.func
def emission_of(film: FilmData, i: int) -> wp.vec3:
    """Mean radiance that reaches pixel `i` without reflection."""
    if film.emission.shape[0] > 0:
        return film.emission[i]
    return wp.vec3(0.0)


@wp.kernel
def _add_iteration(
    first: int,
    gbuffer: GBuffer,
    exposure: float,
    dome: int,
    film: FilmData,
) -> None:
    """Adds the estimates of one iteration to the pixel's means and sums; `dome` is 1 if the camera sees a dome."""
    i = pixel_at(gbuffer.tiles, first + wp.tid())
    if i < 0:
        return
    before = film.count[i]
    emission = wp.vec3(0.0)
    if film.emission.shape[0] > 0:
        emission = gbuffer.emission[i] * exposure
    direct = wp.cw_mul(gbuffer.albedo[i], gbuffer.normal_or_direct[i]) * exposure
    indirect = wp.cw_mul(gbuffer.albedo[i], gbuffer.indirect[i]) * exposure
    if not _is_finite(emission + direct + indirect):
        film.rejected[i] += 1
        emission = wp.vec3(0.0)
        direct = wp.vec3(0.0)
        indirect = wp.vec3(0.0)
    weight = 1.0 / float(before + 1)
    difference = emission + direct + indirect - (emission_of(film, i) + film.direct[i] + film.indirect[i])
    film.standard_deviation[i] = _update_standard_deviation(film.standard_deviation[i], difference, weight)
    if film.emission.shape[0] > 0:
        film.emission[i] += (emission - film.emission[i]) * weight
    film.direct[i] += (direct - film.direct[i]) * weight
    film.indirect[i] += (indirect - film.indirect[i]) * weight
    film.count[i] = before + 1
    if before == 0:
        film.mesh[i] = gbuffer.mesh[i]
    if film.lights.shape[0] > 0 and gbuffer.mesh[i] < 0 and (dome == 1 or wp.max(gbuffer.emission[i]) > 0.0):
        film.lights[i] += 1
    if gbuffer.mesh[i] >= 0:
        film.hits[i] += 1
        film.albedo[i] += gbuffer.albedo[i]
        film.normal[i] += gbuffer.shading_normal[i]
        film.position[i] += gbuffer.position[i]
        film.depth[i] += gbuffer.depth[i]


@wp.kernel
def _write_radiance(first: int, film: FilmData, out: wp.array[wp.vec3]) -> None:
    """Writes the mean radiance of every pixel."""
    i = first + wp.tid()
    out[i] = emission_of(film, i) + film.direct[i] + film.indirect[i]


def write_radiance(film: FilmData, out: "wp.array[wp.vec3]", launcher: Launcher) -> None:
    """Writes the mean radiance to an array on the device with a row per pixel."""
    launcher.launch(_write_radiance, out.shape[0], [film, out])


def new_film_data(pixels: int, has_emission: bool, sees_lights: bool, launcher: Launcher) -> FilmData:
    """An empty `FilmData`; the flags say whether the camera may see emission, and lights that are no surfaces."""
    data = FilmData()
    for name in ("emission", "direct", "indirect", "standard_deviation", "albedo", "normal", "position"):
        setattr(data, name, launcher.zeros(pixels if has_emission or name != "emission" else 0, wp.vec3))
    data.depth = launcher.zeros(pixels, wp.float32)
    for name in ("count", "hits", "lights", "rejected", "mesh"):
        setattr(data, name, launcher.zeros(pixels if sees_lights or name != "lights" else 0, wp.int32))
    return data


def film_arrays(data: FilmData) -> dict[str, wp.array[Any]]:
    """The arrays of a `FilmData` by field name."""
    return {name: getattr(data, name) for name in FIELDS}


def add_samples(gbuffer: GBuffer, exposure: float, dome: bool, film: FilmData, launcher: Launcher) -> None:
    """Adds one iteration, the tiles of a `GBuffer` that an estimator has filled, to a `FilmData`.

    `dome` says whether camera rays that leave the scene meet a dome that is visible.
    """
    launcher.launch(_add_iteration, indices(gbuffer.tiles), [gbuffer, exposure, int(dome), film])
