"""What a pixel on an edge shows: many cheap camera rays, each taking the light of a pixel whose surface it meets."""

import warp as wp

from warp_ir.device_scene import CameraData, SceneData
from warp_ir.film.accumulate import FilmData, emission_of
from warp_ir.gbuffer import CameraHit, camera_ray, jitter, trace_camera_ray
from warp_ir.reconstruction.filter import IrradianceLayer, mean_channel, value
from warp_ir.reconstruction.pixel_surfaces import MATCH, PixelSurfaces, pixel_around, same_surface
from warp_ir.reconstruction.sample_buffer import SampleBuffer

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_PROBES = wp.constant(8)  # rays, to see whether the edge is in the pixel


@wp.func
def on_edge(surfaces: PixelSurfaces, film: FilmData, p: int) -> bool:
    """Whether any of the eight neighbours shows another surface, or none, or one that emits differently."""
    if surfaces.bordering[p] == wp.uint8(1):
        return True
    if film.emission.shape[0] == 0:
        return False
    here = emission_of(film, p)
    glow = here[0] + here[1] + here[2]
    for k in range(9):
        there = emission_of(film, pixel_around(surfaces, p, k))
        other = there[0] + there[1] + there[2]
        if wp.abs(other - glow) > 0.01 * wp.max(other, glow):
            return True
    return False


@wp.struct
class Irradiance:
    """Irradiance over π in two parts, and the variance of a sample of them, all times the weight."""

    direct: wp.vec3
    indirect: wp.vec3
    noise: wp.vec2
    weight: float


@wp.func
def add_neighbor(
    seen: SampleBuffer, layer: IrradianceLayer, q: int, away: wp.vec2, point: CameraHit, lit: Irradiance
) -> Irradiance:
    """Adds the irradiance of pixel `q`, if it shows the surface of a point seen `away` from its centre [pixels]."""
    out = lit
    direct = layer.direct[q]
    if direct[3] >= 0.0:
        fit = same_surface(seen.surfaces, q, point.position, point.smooth_normal)
        if fit > MATCH:
            w = fit / (0.25 + wp.dot(away, away))
            out.direct += w * value(direct)
            out.indirect += w * value(layer.indirect[q])
            out.noise += w * seen.noise[q]
            out.weight += w
    return out


@wp.func
def interpolate(
    seen: SampleBuffer, layer: IrradianceLayer, row: int, column: int, u: wp.vec2, point: CameraHit
) -> Irradiance:
    """Irradiance at a point seen through (u, v) of a pixel: from the four pixels around that show its surface.

    Or from any of the nine, if none of the four does.
    """
    lit = Irradiance()
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
                        lit = add_neighbor(seen, layer, y * surfaces.columns + x, away, point, lit)
    return lit


@wp.struct
class Pixel:
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
def mean_of_rays(sums: Pixel) -> Pixel:
    """Light and noise per ray; albedo and normals stay sums."""
    out = sums
    out.emission = sums.emission / float(sums.rays)
    out.direct = sums.direct / float(sums.rays)
    out.indirect = sums.indirect / float(sums.rays)
    out.own_noise = sums.own_noise / float(sums.rays)
    return out


@wp.func
def supersample_edge(
    scene: SceneData,
    camera: CameraData,
    seen: SampleBuffer,
    layer: IrradianceLayer,
    p: int,
    other: Irradiance,
    rays: wp.vec2i,
) -> Pixel:
    """Sends rays through a pixel on an edge: as many as `rays` says, the first of which are those of the film.

    `other` is the irradiance of what no pixel shows.
    """
    surfaces = seen.surfaces
    row = p // camera.columns
    column = p - row * camera.columns
    first_albedo = wp.vec3(0.0)
    first_emission = wp.vec3(0.0)
    mixed = bool(False)
    out = Pixel()
    while out.rays < rays[1] and (mixed or out.rays < _PROBES):
        u = jitter(scene, camera, p, out.rays, seen.seed)
        point = trace_camera_ray(scene, camera, camera_ray(camera, p, u, wp.vec2(0.0, 0.0)))
        if out.rays == 0:
            first_albedo = point.albedo
            first_emission = point.emission
        # Of one surface, the pixel needs no more rays: the edge lies in its neighbour.
        contrast = wp.length_sq(point.albedo - first_albedo) + wp.length_sq(point.emission - first_emission)
        mixed = mixed or contrast > 0.0 or point.mesh < 0
        mixed = mixed or same_surface(surfaces, p, point.position, point.smooth_normal) < MATCH
        out.rays += 1
        out.emission += point.emission
        out.albedo += point.albedo
        out.normal += point.shading_normal
        if point.mesh >= 0 and wp.max(point.albedo) > 0.0:
            lit = interpolate(seen, layer, row, column, u, point)
            if lit.weight == 0.0:
                lit = other
            out.direct += wp.cw_mul(point.albedo, lit.direct) / lit.weight
            out.indirect += wp.cw_mul(point.albedo, lit.indirect) / lit.weight
            reflected = mean_channel(point.albedo)
            out.own_noise += reflected * reflected * lit.noise / lit.weight
        if out.rays <= rays[0]:
            out.own_direct = out.direct / float(out.rays)
            out.own_indirect = out.indirect / float(out.rays)
    return mean_of_rays(out)
