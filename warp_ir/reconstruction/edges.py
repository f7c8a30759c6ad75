"""Supersampling of pixels on edges: cheap camera rays that take the filtered irradiance of the pixels around."""

import warp as wp

from warp_ir.device_scene import CameraData, SceneData
from warp_ir.film.accumulate import FilmData, emission_of
from warp_ir.gbuffer import CameraHit, camera_ray, jitter, trace_camera_ray
from warp_ir.reconstruction.filter import IrradianceLayer, mean_channel, rgb
from warp_ir.reconstruction.pixel_surfaces import MIN_MATCH, PixelSurfaces, match_weight, neighbor_pixel
from warp_ir.reconstruction.sample_buffer import SampleBuffer

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_MIN_RAYS = wp.constant(8)  # camera rays that find out whether the edge crosses the pixel


@wp.func
def on_edge(surfaces: PixelSurfaces, film: FilmData, p: int) -> bool:
    """Whether any of the eight neighbours shows another surface, or emission that differs by more than 1 %."""
    if surfaces.edge[p] == wp.uint8(1):
        return True
    if film.emission.shape[0] == 0:
        return False
    emission = emission_of(film, p)
    own = emission[0] + emission[1] + emission[2]
    for k in range(9):
        emission = emission_of(film, neighbor_pixel(surfaces, p, k))
        other = emission[0] + emission[1] + emission[2]
        if wp.abs(other - own) > 0.01 * wp.max(other, own):
            return True
    return False


@wp.struct
class WeightedIrradiance:
    """Weighted sums of irradiance over π and of the variance of one sample, and the sum of the weights."""

    direct: wp.vec3
    indirect: wp.vec3
    variance: wp.vec2  # of the two mean channels
    weight: float


@wp.func
def add_neighbor(
    samples: SampleBuffer,
    layer: IrradianceLayer,
    q: int,
    offset: wp.vec2,
    point: CameraHit,
    irradiance: WeightedIrradiance,
) -> WeightedIrradiance:
    """Adds the irradiance of pixel `q` if it shows the surface of a point, `offset` [pixels] away from its centre."""
    out = irradiance
    direct = layer.direct[q]
    if direct[3] >= 0.0:
        match = match_weight(samples.surfaces, q, point.position, point.smooth_normal)
        if match > MIN_MATCH:
            w = match / (0.25 + wp.dot(offset, offset))
            out.direct += w * rgb(direct)
            out.indirect += w * rgb(layer.indirect[q])
            out.variance += w * samples.variance[q]
            out.weight += w
    return out


@wp.func
def interpolate(
    samples: SampleBuffer, layer: IrradianceLayer, row: int, column: int, u: wp.vec2, point: CameraHit
) -> WeightedIrradiance:
    """Irradiance at a point that is visible through `u` in [0, 1]² of a pixel.

    Interpolates between the nearest four pixels that show its surface or, if none does, the other five of the 3 x 3
    neighbourhood. Without weight if none of them does.
    """
    irradiance = WeightedIrradiance()
    surfaces = samples.surfaces
    nearest_x = wp.where(u[0] < 0.5, -1, 1)
    nearest_y = wp.where(u[1] < 0.5, -1, 1)
    for attempt in range(2):
        if irradiance.weight == 0.0:
            for dy in range(-1, 2):
                for dx in range(-1, 2):
                    x = column + dx
                    y = row + dy
                    nearest = dx != -nearest_x and dy != -nearest_y
                    inside = x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows
                    if inside and nearest == (attempt == 0):
                        offset = wp.vec2(u[0] - 0.5 - float(dx), u[1] - 0.5 - float(dy))
                        irradiance = add_neighbor(samples, layer, y * surfaces.columns + x, offset, point, irradiance)
    return irradiance


@wp.struct
class SupersampledPixel:
    """Radiance over the camera rays through a pixel: sums, and means after `mean_over_rays`."""

    emission: wp.vec3
    direct: wp.vec3
    indirect: wp.vec3
    rays: int
    film_direct: wp.vec3  # means over those rays that the film's iterations traced as well
    film_indirect: wp.vec3
    variance: wp.vec2  # of direct and indirect, as far as it comes from the irradiance of one iteration
    albedo: wp.vec3
    normal: wp.vec3


@wp.func
def mean_over_rays(sums: SupersampledPixel) -> SupersampledPixel:
    """Means of radiance and variance per ray; albedo and normal stay sums."""
    out = sums
    out.emission = sums.emission / float(sums.rays)
    out.direct = sums.direct / float(sums.rays)
    out.indirect = sums.indirect / float(sums.rays)
    out.variance = sums.variance / float(sums.rays)
    return out


@wp.func
def supersample_edge(
    scene: SceneData,
    camera: CameraData,
    samples: SampleBuffer,
    layer: IrradianceLayer,
    p: int,
    unassigned: WeightedIrradiance,
    ray_counts: wp.vec2i,
) -> SupersampledPixel:
    """Radiance of a pixel on an edge times `samples.scale`, without exposure.

    `ray_counts` are the rays of the film, which come first in the sequence, and the maximum. `unassigned` is the
    irradiance of surfaces that no pixel centre shows.
    """
    surfaces = samples.surfaces
    row = p // camera.columns
    column = p - row * camera.columns
    first_albedo = wp.vec3(0.0)
    first_emission = wp.vec3(0.0)
    mixed = bool(False)
    out = SupersampledPixel()
    while out.rays < ray_counts[1] and (mixed or out.rays < _MIN_RAYS):
        u = jitter(scene, camera, p, out.rays, samples.seed)
        point = trace_camera_ray(scene, camera, camera_ray(camera, p, u, wp.vec2(0.0, 0.0)))
        emission = point.emission * samples.scale
        if out.rays == 0:
            first_albedo = point.albedo
            first_emission = emission
        # A pixel that shows one surface needs no more rays: the edge crosses its neighbour.
        contrast = wp.length_sq(point.albedo - first_albedo) + wp.length_sq(emission - first_emission)
        mixed = mixed or contrast > 0.0 or point.mesh < 0
        mixed = mixed or match_weight(surfaces, p, point.position, point.smooth_normal) < MIN_MATCH
        out.rays += 1
        out.emission += emission
        out.albedo += point.albedo
        out.normal += point.shading_normal
        if point.mesh >= 0 and wp.max(point.albedo) > 0.0:
            irradiance = interpolate(samples, layer, row, column, u, point)
            if irradiance.weight == 0.0:
                irradiance = unassigned
            out.direct += wp.cw_mul(point.albedo, irradiance.direct) / irradiance.weight
            out.indirect += wp.cw_mul(point.albedo, irradiance.indirect) / irradiance.weight
            reflectance = mean_channel(point.albedo)
            out.variance += reflectance * reflectance * irradiance.variance / irradiance.weight
        if out.rays <= ray_counts[0]:
            out.film_direct = out.direct / float(out.rays)
            out.film_indirect = out.indirect / float(out.rays)
    return mean_over_rays(out)
