"""What pixels show through a lens or an open shutter: each camera ray takes the light that its surface has elsewhere.

Diffuse light leaves a surface alike in all directions. So what a ray through the edge of the lens meets is lit as the
pixel says in whose centre the same point is seen through the lens' middle; and what is met at one moment, as the pixel
that shows the same point of the same triangle at the moment in the middle (`moments.py`). There light is filtered
without any blur. Blur itself costs camera rays alone, and many of them: only light is noisy, lens and time are not
(Lehtinen et al. 2011 share samples of a lens in this way).
"""

from typing import Any

import warp as wp

from warp_ir.device.launcher import MAX_REGISTERS, Launcher
from warp_ir.film.accumulate import FilmData
from warp_ir.gbuffer import CameraHit, camera_ray, jitter, lens_point, project, surface_point_of, trace_camera_ray
from warp_ir.reconstruction.compose import (
    ResolvedPicture,
    edge_rays,
    filtered_estimate,
    plain_estimate,
    show,
    supersampled_estimate,
)
from warp_ir.reconstruction.edges import Irradiance, Pixel, add_neighbor, interpolate, mean_of_rays, on_edge
from warp_ir.reconstruction.filter import IrradianceLayer, mean_channel, mean_channels
from warp_ir.reconstruction.pixel_surfaces import MATCH, same_surface
from warp_ir.reconstruction.reprojection import Blur, at_reference_time
from warp_ir.reconstruction.sample_buffer import SampleBuffer
from warp_ir.sampling.sobol import stratum_at

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_PROBES = wp.constant(16)  # rays, to see whether a pixel shows more than what its centre does
_SHARP = wp.constant(0.75)  # pixels from its centre that a pixel may show beside it
_STEADY = wp.constant(0.2)  # share by which light may differ in a pixel that few rays are enough for
_NEAR = wp.constant(
    4
)  # pixels away at which a hidden surface is looked for, if some samples are on none that shows ...
_FAR = wp.constant(32)  # ... and if none are
_FEWEST_RAYS = 64
_MOST_RAYS = 1024


@wp.struct
class _Mean:
    """What camera rays through a pixel found, and whether that is all there is to it."""

    pixel: Pixel
    blurred: int  # 1: some have seen what the centres of other pixels show
    mixed: int  # 1: they differ in what they have seen


@wp.struct
class _Other:
    """The light on what no pixel shows."""

    lit: Irradiance
    known: int  # 1: by samples of such surfaces nearby


@wp.func
def _others(seen: SampleBuffer, p: int, raw_direct: wp.vec3, raw_indirect: wp.vec3, albedo: wp.vec3) -> _Other:
    """It is that of such samples around a pixel, if there were any, or that of all the pixel's."""
    surfaces = seen.surfaces
    lit = Irradiance()
    for dy in range(-2, 3):
        for dx in range(-2, 3):
            x = p % surfaces.columns + dx
            y = p // surfaces.columns + dy
            if x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows:
                q = y * surfaces.columns + x
                w = 1.0 / (1.0 + float(dx * dx + dy * dy))
                lit.direct += w * seen.other_direct[q]
                lit.indirect += w * seen.other_indirect[q]
                lit.weight += w * float(seen.other_count[q])
    other = _Other()
    other.known = wp.where(lit.weight > 0.0, 1, 0)
    if other.known == 0:
        lit.weight = 1.0
        lit.direct = wp.cw_div(raw_direct, wp.max(albedo, wp.vec3(1.0e-6)))
        lit.indirect = wp.cw_div(raw_indirect, wp.max(albedo, wp.vec3(1.0e-6)))
    means = mean_channels(lit.direct, lit.indirect)
    lit.noise = wp.cw_mul(means, means) / lit.weight
    other.lit = lit
    return other


@wp.func
def _lit(
    blur: Blur, seen: SampleBuffer, layer: IrradianceLayer, point: CameraHit, place: wp.vec2, farthest: int
) -> Irradiance:
    """Irradiance at a point of the middle moment: where it is seen through the lens' middle, or as near as may be."""
    camera = blur.cameras[blur.middle]
    column = int(wp.clamp(wp.floor(place[0]), 0.0, float(camera.columns - 1)))
    row = int(wp.clamp(wp.floor(place[1]), 0.0, float(camera.rows - 1)))
    u = place - wp.vec2(float(column), float(row))
    lit = interpolate(seen, layer, row, column, u, point)
    # What stands before it hides it there; its surface may come out beside that.
    reach = int(2)
    while lit.weight == 0.0 and reach <= farthest:
        for k in range(9):
            x = column + (k % 3 - 1) * reach
            y = row + (k // 3 - 1) * reach
            if x >= 0 and y >= 0 and x < camera.columns and y < camera.rows:
                away = wp.vec2(float(x - column), float(y - row))
                lit = add_neighbor(seen, layer, y * camera.columns + x, away, point, lit)
        reach *= 2
    return lit


@wp.func
def _look_through(
    blur: Blur, seen: SampleBuffer, layer: IrradianceLayer, p: int, other: _Other, rays: wp.vec2i, mixed: bool
) -> _Mean:
    """Sends rays through a pixel, the lens and the time: as many as `rays` says, the first of which are the film's.

    Few if these see the same, and it is not known to be `mixed`. `other` is the irradiance of what no pixel shows.
    """
    middle = blur.cameras[blur.middle]
    first_albedo = wp.vec3(0.0)
    first_emission = wp.vec3(0.0)
    first_light = float(0.0)
    out = Pixel()
    farthest = wp.where(other.known == 1, _NEAR, _FAR)
    mean = _Mean()
    mean.mixed = wp.where(mixed, 1, 0)
    while out.rays < rays[1] and (mean.mixed == 1 or out.rays < _PROBES):
        moment = stratum_at(blur.sobol, out.rays, blur.bits)
        camera = blur.cameras[moment]
        scene = blur.scenes[moment]
        u = jitter(scene, camera, p, out.rays, seen.seed)
        point = trace_camera_ray(
            scene, camera, camera_ray(camera, p, u, lens_point(scene, camera, p, out.rays, seen.seed))
        )
        if out.rays == 0:
            first_albedo = point.albedo
            first_emission = point.emission
        contrast = wp.length_sq(point.albedo - first_albedo) + wp.length_sq(point.emission - first_emission)
        fits = point.mesh < 0 and seen.surfaces.footprint[p] <= 0.0
        exposure = blur.exposures[moment]
        out.rays += 1
        out.emission += point.emission * exposure
        out.albedo += point.albedo
        out.normal += point.shading_normal
        if point.mesh >= 0:
            there = at_reference_time(blur, moment, surface_point_of(point.hit), point.position, point.smooth_normal)
            point.position = there.position
            point.smooth_normal = there.normal
            place = project(middle, there.position)
            fits = same_surface(seen.surfaces, p, there.position, there.normal) > MATCH
            away = place - wp.vec2(float(p % middle.columns), float(p // middle.columns)) - wp.vec2(0.5, 0.5)
            if wp.max(wp.abs(away)) > _SHARP:
                mean.blurred = 1
            if wp.max(point.albedo) > 0.0:
                lit = _lit(blur, seen, layer, point, place, farthest)
                if lit.weight == 0.0:
                    lit = other.lit
                light = mean_channel(lit.direct + lit.indirect) / lit.weight
                if first_light == 0.0:
                    first_light = light
                if wp.abs(light - first_light) > _STEADY * first_light:
                    mean.mixed = 1
                out.direct += wp.cw_mul(point.albedo, lit.direct) * (exposure / lit.weight)
                out.indirect += wp.cw_mul(point.albedo, lit.indirect) * (exposure / lit.weight)
                reflected = mean_channel(point.albedo) * exposure
                out.own_noise += reflected * reflected * lit.noise / lit.weight
        if contrast > 0.0 or not fits:
            mean.blurred = 1
            mean.mixed = 1
        if out.rays <= rays[0]:
            out.own_direct = out.direct / float(out.rays)
            out.own_indirect = out.indirect / float(out.rays)
    mean.pixel = mean_of_rays(out)
    return mean


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _compose(
    first: int,
    blur: Blur,
    seen: SampleBuffer,
    layer: IrradianceLayer,
    film: FilmData,
    exposure: float,
    out: ResolvedPicture,
) -> None:
    """Radiance of a pixel: that of its surface, or that of all it shows, and how far the film's mean is off that."""
    p = first + wp.tid()
    shown = plain_estimate(film, p)
    out.rest.direct[p] = wp.vec4(0.0, 0.0, 0.0, -1.0)
    other = _others(seen, p, shown.direct / exposure, shown.indirect / exposure, shown.albedo)
    edge = on_edge(seen.surfaces, film, p)
    mean = _look_through(blur, seen, layer, p, other, wp.vec2i(film.count[p], out.edge_rays), edge)
    if mean.blurred == 1 or edge or layer.direct[p][3] < 0.0:
        shown = supersampled_estimate(shown, film, mean.pixel, p, 1.0, out)
    else:
        shown = filtered_estimate(shown, seen, layer, p, exposure, float(film.count[p]))
    show(out, p, shown)


def blur_rays(iterations: int) -> int:
    """Camera rays for a pixel that is blurred: those of the film, and as many as suffice."""
    return max(_FEWEST_RAYS, edge_rays(iterations), min(iterations, _MOST_RAYS))


def compose_blurred(blur: Any, seen: Any, layer: Any, film: Any, exposure: float, out: Any, launcher: Launcher) -> None:
    """Fills a `ResolvedPicture` of a blurred view from a filtered layer; `exposure` is the mean over the shutter."""
    launcher.launch(_compose, seen.count.shape[0], [blur, seen, layer, film, exposure, out])
