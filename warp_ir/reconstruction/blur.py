"""Defocus and motion blur of filtered irradiance: camera rays through lens and shutter take it from a sharp image.

Diffuse surfaces have the same radiance in all directions. So the irradiance at a point that is visible through the edge
of the lens is that of the pixel that shows the point through the centre of the lens, and a point that moves has the
irradiance of the pixel that shows it at the reference time (`reprojection.py`). There irradiance is filtered without
any blur. The blur costs camera rays alone, and can afford many of them: only irradiance is noisy, not lens and time
(Lehtinen et al. 2011 share samples of a lens in this way).
"""

import warp as wp

from warp_ir.device.launcher import MAX_REGISTERS, Launcher
from warp_ir.film.accumulate import FilmData
from warp_ir.gbuffer import CameraHit, camera_ray, jitter, lens_point, project, surface_point_of, trace_camera_ray
from warp_ir.reconstruction.compose import (
    ResolvedPicture,
    UnassignedIrradiance,
    edge_rays,
    filtered_estimate,
    store_pixel,
    supersampled_estimate,
    unassigned_irradiance,
    unfiltered_estimate,
)
from warp_ir.reconstruction.edges import (
    SupersampledPixel,
    WeightedIrradiance,
    add_neighbor,
    interpolate,
    mean_over_rays,
    on_edge,
)
from warp_ir.reconstruction.filter import IrradianceLayer, mean_channel
from warp_ir.reconstruction.pixel_surfaces import MIN_MATCH, match_weight
from warp_ir.reconstruction.reprojection import ShutterData, reproject_to_reference
from warp_ir.reconstruction.sample_buffer import SampleBuffer
from warp_ir.sampling.sobol import stratum_at

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_MIN_RAYS = wp.constant(16)  # camera rays that find out whether a pixel is blurred or mixed
_SHARP_DISTANCE = wp.constant(0.75)  # from its centre, within which a pixel's points count as its own [pixels]
_MIXED_TOLERANCE = wp.constant(0.2)  # relative difference of irradiance above which a pixel is mixed
_SHORT_REACH = wp.constant(4)  # of the search for a hidden surface, if there are unassigned samples nearby [pixels] ...
_LONG_REACH = wp.constant(32)  # ... and if there are none
_MIN_BLUR_RAYS = 64
_MAX_BLUR_RAYS = 1024


@wp.struct
class _BlurredPixel:
    """A supersampled pixel, and what its camera rays have in common."""

    pixel: SupersampledPixel
    blurred: int  # 1: some rays hit points that the pixel's centre does not stand for
    mixed: int  # 1: the rays differ in albedo, emission or irradiance


@wp.func
def _irradiance_at(
    shutter: ShutterData, samples: SampleBuffer, layer: IrradianceLayer, point: CameraHit, place: wp.vec2, reach: int
) -> WeightedIrradiance:
    """Irradiance of a point at the reference time, which the centre of the lens sees at `place` [pixels].

    Where another surface occludes it there, the surface is searched for at up to `reach` pixels around.
    """
    camera = shutter.cameras[shutter.reference]
    column = int(wp.clamp(wp.floor(place[0]), 0.0, float(camera.columns - 1)))
    row = int(wp.clamp(wp.floor(place[1]), 0.0, float(camera.rows - 1)))
    u = place - wp.vec2(float(column), float(row))
    irradiance = interpolate(samples, layer, row, column, u, point)
    distance = int(2)
    while irradiance.weight == 0.0 and distance <= reach:
        for k in range(9):
            x = column + (k % 3 - 1) * distance
            y = row + (k // 3 - 1) * distance
            if x >= 0 and y >= 0 and x < camera.columns and y < camera.rows:
                offset = wp.vec2(float(x - column), float(y - row))
                irradiance = add_neighbor(samples, layer, y * camera.columns + x, offset, point, irradiance)
        distance *= 2
    return irradiance


@wp.func
def _supersample_blur(
    shutter: ShutterData,
    samples: SampleBuffer,
    layer: IrradianceLayer,
    p: int,
    unassigned: UnassignedIrradiance,
    ray_counts: wp.vec2i,
    mixed: bool,
) -> _BlurredPixel:
    """Radiance of a pixel over lens and shutter times `samples.scale`, with exposure.

    `ray_counts` are the rays of the film, which come first in the sequence, and the maximum. A few are enough if they
    agree and the pixel is not known to be `mixed`.
    """
    camera_at_reference = shutter.cameras[shutter.reference]
    first_albedo = wp.vec3(0.0)
    first_emission = wp.vec3(0.0)
    first_irradiance = float(0.0)
    pixel = SupersampledPixel()
    reach = wp.where(unassigned.is_measured == 1, _SHORT_REACH, _LONG_REACH)
    out = _BlurredPixel()
    out.mixed = wp.where(mixed, 1, 0)
    while pixel.rays < ray_counts[1] and (out.mixed == 1 or pixel.rays < _MIN_RAYS):
        shutter_sample = stratum_at(shutter.sobol, pixel.rays, shutter.log2_count)
        camera = shutter.cameras[shutter_sample]
        scene = shutter.scenes[shutter_sample]
        u = jitter(scene, camera, p, pixel.rays, samples.seed)
        lens = lens_point(scene, camera, p, pixel.rays, samples.seed)
        point = trace_camera_ray(scene, camera, camera_ray(camera, p, u, lens))
        emission = point.emission * samples.scale
        if pixel.rays == 0:
            first_albedo = point.albedo
            first_emission = emission
        contrast = wp.length_sq(point.albedo - first_albedo) + wp.length_sq(emission - first_emission)
        is_own = point.mesh < 0 and samples.surfaces.footprint[p] <= 0.0
        exposure = shutter.exposures[shutter_sample]
        pixel.rays += 1
        pixel.emission += emission * exposure
        pixel.albedo += point.albedo
        pixel.normal += point.shading_normal
        if point.mesh >= 0:
            surface_point = surface_point_of(point.hit)
            reference = reproject_to_reference(
                shutter, shutter_sample, surface_point, point.position, point.smooth_normal
            )
            point.position = reference.position
            point.smooth_normal = reference.normal
            place = project(camera_at_reference, reference.position)
            is_own = match_weight(samples.surfaces, p, reference.position, reference.normal) > MIN_MATCH
            corner = wp.vec2(float(p % camera_at_reference.columns), float(p // camera_at_reference.columns))
            offset = place - corner - wp.vec2(0.5, 0.5)
            if wp.max(wp.abs(offset)) > _SHARP_DISTANCE:
                out.blurred = 1
            if wp.max(point.albedo) > 0.0:
                irradiance = _irradiance_at(shutter, samples, layer, point, place, reach)
                if irradiance.weight == 0.0:
                    irradiance = unassigned.irradiance
                mean = mean_channel(irradiance.direct + irradiance.indirect) / irradiance.weight
                if first_irradiance == 0.0:
                    first_irradiance = mean
                if wp.abs(mean - first_irradiance) > _MIXED_TOLERANCE * first_irradiance:
                    out.mixed = 1
                pixel.direct += wp.cw_mul(point.albedo, irradiance.direct) * (exposure / irradiance.weight)
                pixel.indirect += wp.cw_mul(point.albedo, irradiance.indirect) * (exposure / irradiance.weight)
                reflectance = mean_channel(point.albedo) * exposure
                pixel.variance += reflectance * reflectance * irradiance.variance / irradiance.weight
        if contrast > 0.0 or not is_own:
            out.blurred = 1
            out.mixed = 1
        if pixel.rays <= ray_counts[0]:
            pixel.film_direct = pixel.direct / float(pixel.rays)
            pixel.film_indirect = pixel.indirect / float(pixel.rays)
    out.pixel = mean_over_rays(pixel)
    return out


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _compose_blurred(
    first: int,
    shutter: ShutterData,
    samples: SampleBuffer,
    layer: IrradianceLayer,
    film: FilmData,
    exposure: float,
    out: ResolvedPicture,
) -> None:
    """Radiance of a pixel: filtered if it is sharp and shows one surface, otherwise supersampled."""
    p = first + wp.tid()
    x = unfiltered_estimate(film, p, out.scale)
    out.edge_residual.direct[p] = wp.vec4(0.0, 0.0, 0.0, -1.0)
    unassigned = unassigned_irradiance(samples, p, x, exposure)
    edge = on_edge(samples.surfaces, film, p)
    ray_counts = wp.vec2i(film.count[p], out.max_rays)
    supersampled = _supersample_blur(shutter, samples, layer, p, unassigned, ray_counts, edge)
    if supersampled.blurred == 1 or edge or layer.direct[p][3] < 0.0:
        x = supersampled_estimate(x, film, supersampled.pixel, p, 1.0, out)
    else:
        x = filtered_estimate(x, samples, layer, p, exposure, float(film.count[p]))
    store_pixel(out, p, x)


def blur_rays(iterations: int) -> int:
    """Maximum number of camera rays through a blurred pixel: those of the film, and as many as a smooth blur needs."""
    return max(_MIN_BLUR_RAYS, edge_rays(iterations), min(iterations, _MAX_BLUR_RAYS))


def compose_blurred(
    shutter: ShutterData,
    samples: SampleBuffer,
    layer: IrradianceLayer,
    film: FilmData,
    exposure: float,
    out: ResolvedPicture,
    launcher: Launcher,
) -> None:
    """Fills a `ResolvedPicture` with blur; `exposure` is the mean over the shutter samples."""
    launcher.launch(_compose_blurred, samples.count.shape[0], [shutter, samples, layer, film, exposure, out])
