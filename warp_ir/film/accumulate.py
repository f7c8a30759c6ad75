"""What a film holds on the device, and how an iteration is added to it.

The mean and the deviation are brought up to date by how far each iteration is off the mean (Welford 1962): what is lost
to rounding is forgotten as the samples are that it came with, and float32 does not drift over a hundred thousand
iterations.
"""

import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.gbuffer import GBuffer
from warp_ir.tiles import indices, pixel_at

wp.set_module_options({"enable_backward": False, "max_unroll": 0})


@wp.struct
class FilmData:
    """Radiance, a mean over iterations, and what else there is, sums; one row per pixel."""

    count: wp.array[wp.int32]  # iterations
    emission: wp.array[wp.vec3]  # empty if there can be none
    direct: wp.array[wp.vec3]  # light reflected once
    indirect: wp.array[wp.vec3]
    deviation: wp.array[wp.vec3]  # standard deviation of the sum of the three
    albedo: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]
    position: wp.array[wp.vec3]
    depth: wp.array[wp.float32]
    hits: wp.array[wp.int32]  # iterations in which the pixel's ray met a surface
    rejected: wp.array[wp.int32]  # iterations whose value was not finite
    mesh: wp.array[wp.int32]  # what the first iteration saw


@wp.func
def _finite(v: wp.vec3) -> bool:
    return wp.isfinite(v[0]) and wp.isfinite(v[1]) and wp.isfinite(v[2])


@wp.func
def _deviation(old: wp.vec3, off: wp.vec3, share: float) -> wp.vec3:
    """The standard deviations when a sample is added which is so much of them all, and so far off their mean."""
    # Squares are taken in a scale in which they neither overflow nor vanish.
    scale = wp.max(wp.max(wp.max(old), wp.max(wp.abs(off))), 1.0e-37)
    a = old * (1.0 / scale)
    b = off * (1.0 / scale)
    variance = (wp.cw_mul(a, a) + wp.cw_mul(b, b) * share) * (1.0 - share)
    return wp.vec3(wp.sqrt(variance[0]), wp.sqrt(variance[1]), wp.sqrt(variance[2])) * scale


@wp.func
def emission_of(film: FilmData, i: int) -> wp.vec3:
    """Radiance that reaches the camera without reflection."""
    if film.emission.shape[0] > 0:
        return film.emission[i]
    return wp.vec3(0.0)


@wp.kernel
def _add(
    first: int,
    gbuffer: GBuffer,
    exposure: float,
    film: FilmData,
) -> None:
    """Adds one iteration's estimates."""
    i = pixel_at(gbuffer.tiles, first + wp.tid())
    if i < 0:
        return
    before = film.count[i]
    le = wp.vec3(0.0)
    if film.emission.shape[0] > 0:
        le = gbuffer.emission[i] * exposure
    once = wp.cw_mul(gbuffer.albedo[i], gbuffer.normal_or_direct[i]) * exposure
    more = wp.cw_mul(gbuffer.albedo[i], gbuffer.indirect[i]) * exposure
    if not _finite(le + once + more):
        film.rejected[i] += 1
        le = wp.vec3(0.0)
        once = wp.vec3(0.0)
        more = wp.vec3(0.0)
    share = 1.0 / float(before + 1)
    off = le + once + more - (emission_of(film, i) + film.direct[i] + film.indirect[i])
    film.deviation[i] = _deviation(film.deviation[i], off, share)
    if film.emission.shape[0] > 0:
        film.emission[i] += (le - film.emission[i]) * share
    film.direct[i] += (once - film.direct[i]) * share
    film.indirect[i] += (more - film.indirect[i]) * share
    film.count[i] = before + 1
    if before == 0:
        film.mesh[i] = gbuffer.mesh[i]
    if gbuffer.mesh[i] >= 0:
        film.hits[i] += 1
        film.albedo[i] += gbuffer.albedo[i]
        film.normal[i] += gbuffer.shading_normal[i]
        film.position[i] += gbuffer.position[i]
        film.depth[i] += gbuffer.depth[i]


def add_samples(gbuffer: GBuffer, exposure: float, film: FilmData, launcher: Launcher) -> None:
    """Adds one iteration, the tiles of a `GBuffer` that an estimator has filled, to a `FilmData`."""
    launcher.launch(_add, indices(gbuffer.tiles), [gbuffer, exposure, film])
