"""What the camera sees: one jittered ray per pixel, and the surface it meets.

The jitter of a pixel is a (0,2)-sequence over the iterations, scrambled by pixel: the first 2^k iterations
sample the pixel's area in as many strata, so edges converge faster than noise. The next two dimensions choose
the point on the lens, if the camera has one.
"""

from typing import Any

import warp as wp

from warp_ir.device.launcher import MAX_REGISTERS, Launcher, float_count, partition
from warp_ir.device_scene import CameraData, DeviceScene, SceneData
from warp_ir.lights import emission_to_camera, intersect_lights
from warp_ir.sampling import sobol
from warp_ir.sampling.square_to import square_to_disk
from warp_ir.surface import Hit, albedo, closest, mapped_normal, shading_normal, terminator_offset
from warp_ir.tiles import Tiles, all_tiles, indices, pixel_at, skipped_iterations

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_FARTHEST = wp.constant(1.0e30)  # a plane that a ray meets only there is parallel to it
_JITTER = wp.constant(wp.uint32(0x6A09E667))


@wp.struct
class SurfacePoint:
    """A point of a triangle, wherever that goes while the shutter is open."""

    triangle: int
    instance: int  # -1: in the world as it stands
    weights: wp.uint32  # of the first and the second corner, in steps of 1/65535


@wp.struct
class GBuffer:
    """One row per pixel, the top left first; in the scene's device frame."""

    mesh: wp.array[wp.int32]  # index into Scene.meshes; -1: background
    position: wp.array[wp.vec3]  # off the (smooth) surface, where shadow rays start
    normal_or_direct: wp.array[wp.vec3]  # geometric normal (or the smooth surface's): light comes from its side alone;
    # the estimator replaces it by the direct irradiance over π, which needs no memory of its own
    indirect: wp.array[wp.vec3]  # irradiance over π by way of surfaces, from the estimator
    shading_normal: wp.array[wp.vec3]
    smooth_normal: wp.array[wp.vec3]  # the same without normal maps: by it surfaces are told apart
    albedo: wp.array[wp.vec3]
    emission: wp.array[wp.vec3]  # radiance that reaches the camera without reflection; empty: there can be none
    depth: wp.array[wp.float32]  # along the camera's -Z
    surface_point: wp.array[SurfacePoint]  # no rows if no surface moves while the shutter is open
    tiles: Tiles  # the pixels that are looked through; rows of others are of no meaning


@wp.struct
class Ray:
    """A camera ray; `direction` has length 1 along the camera's -Z, so that t is depth."""

    origin: wp.vec3
    direction: wp.vec3


@wp.func
def camera_ray(camera: CameraData, pixel: int, u: wp.vec2, lens: wp.vec2) -> Ray:
    """The ray through the point `u` in [0, 1]² of a pixel of the film, from the point `lens` of the unit disk.

    (0, 0) is the top left of the pixel; rays through one point of the film meet where the camera is in focus.
    """
    x = (float(camera.first_column + pixel % camera.columns) + u[0]) / float(camera.image_columns)
    y = (float(camera.first_row + pixel // camera.columns) + u[1]) / float(camera.image_rows)
    right = camera.left + x * camera.width
    up = camera.bottom + (1.0 - y) * camera.height
    ray = Ray()
    on_film = right * camera.right + up * camera.up
    if camera.orthographic == 1:
        ray.origin = camera.origin + on_film
        ray.direction = -camera.back
    else:
        aside = (lens[0] * camera.right + lens[1] * camera.up) * camera.lens_radius
        ray.origin = camera.origin + aside
        ray.direction = on_film - camera.back - aside / camera.focus_distance
    return ray


@wp.func
def project(camera: CameraData, position: wp.vec3) -> wp.vec2:
    """Where on the film, in pixels, the middle of the lens sees a point; far outside if it is not before the camera."""
    apart = position - camera.origin
    depth = wp.where(camera.orthographic == 1, 1.0, -wp.dot(apart, camera.back))
    if depth <= 0.0:
        return wp.vec2(-_FARTHEST, -_FARTHEST)
    x = (wp.dot(apart, camera.right) / depth - camera.left) / camera.width
    y = 1.0 - (wp.dot(apart, camera.up) / depth - camera.bottom) / camera.height
    on_image = wp.vec2(x * float(camera.image_columns), y * float(camera.image_rows))
    return on_image - wp.vec2(float(camera.first_column), float(camera.first_row))


@wp.func
def image_pixel(camera: CameraData, pixel: int) -> int:
    """Number of a pixel of the film in the whole image: what its random numbers depend on, wherever it is cut."""
    column = camera.first_column + pixel % camera.columns
    return (camera.first_row + pixel // camera.columns) * camera.image_columns + column


@wp.struct
class CameraHit:
    """What a camera ray meets; `mesh` is -1 for the background."""

    mesh: int
    position: wp.vec3
    normal: wp.vec3
    shading_normal: wp.vec3
    smooth_normal: wp.vec3
    albedo: wp.vec3
    emission: wp.vec3
    depth: float
    hit: Hit  # what the rest was made of


@wp.func
def surface_point_of(hit: Hit) -> SurfacePoint:
    """Where a hit is on its triangle."""
    out = SurfacePoint()
    out.triangle = hit.triangle
    out.instance = hit.instance
    u = wp.uint32(wp.clamp(hit.u, 0.0, 1.0) * 65535.0)
    v = wp.uint32(wp.clamp(hit.v, 0.0, 1.0) * 65535.0)
    out.weights = (u << wp.uint32(16)) | v
    return out


@wp.func
def _clip_interval(camera: CameraData, ray: Ray) -> wp.vec2:
    """Nearest and farthest depth at which a camera ray sees anything; the same if it does not at all."""
    near = camera.near
    far = camera.far
    for k in range(camera.plane_count):
        plane = camera.planes[k]
        n = wp.vec3(plane[0], plane[1], plane[2])
        above = wp.dot(n, ray.origin - camera.origin) + plane[3]
        rise = wp.dot(n, ray.direction)
        if rise > 0.0:
            near = wp.max(near, -above / rise)
        elif rise < 0.0:
            far = wp.min(far, -above / rise)
        elif above < 0.0:
            far = near
    if near >= far or near > _FARTHEST:
        return wp.vec2(camera.near, camera.near)
    return wp.vec2(near, far)


@wp.func
def trace_camera_ray(scene: SceneData, camera: CameraData, ray: Ray) -> CameraHit:
    """Follows a camera ray."""
    span = _clip_interval(camera, ray)
    near = span[0]
    origin = ray.origin + ray.direction * near
    reach = span[1] - near
    hit = closest(scene, origin, ray.direction, reach)
    length = wp.length(ray.direction)
    towards = ray.direction / length
    sight = CameraHit()
    sight.mesh = -1
    if hit.triangle >= 0:
        sight.hit = hit
        sight.mesh = scene.triangle_mesh[hit.triangle]
        sight.position = hit.position
        sight.normal = hit.normal
        sight.shading_normal = shading_normal(scene, hit)
        rise = terminator_offset(scene, hit)
        if wp.length_sq(rise) > 0.0:
            sight.position += rise
            sight.normal = sight.shading_normal
        sight.depth = hit.t + near
        pixel = wp.sqrt(camera.width * camera.height / float(camera.image_columns * camera.image_rows))
        pixel *= wp.where(camera.orthographic == 1, 1.0, sight.depth)
        sight.smooth_normal = sight.shading_normal
        sight.shading_normal = mapped_normal(scene, hit, sight.smooth_normal, pixel)
        sight.albedo = albedo(scene, hit, pixel)
        sight.emission = emission_to_camera(scene, hit, towards, pixel)
        reach = hit.t
    if camera.visible_lights == 1:
        sight.emission += intersect_lights(scene, origin, towards, reach * length, sight.mesh < 0, -1.0, -1)
    return sight


@wp.func
def _jitter_scramble(camera: CameraData, pixel: int, seed: wp.uint32) -> wp.uint32:
    stream = sobol.hash_combine(seed, wp.uint32(image_pixel(camera, pixel)))
    return sobol.hash_combine(stream, _JITTER)


@wp.func
def jitter(scene: SceneData, camera: CameraData, pixel: int, iteration: int, seed: wp.uint32) -> wp.vec2:
    """Where in a pixel an iteration looks, in [0, 1)²."""
    return sobol.sample_2d(scene.sobol, iteration, 0, _jitter_scramble(camera, pixel, seed))


@wp.func
def lens_point(scene: SceneData, camera: CameraData, pixel: int, iteration: int, seed: wp.uint32) -> wp.vec2:
    """Where on the lens, in the unit disk, an iteration's ray through a pixel starts."""
    if camera.lens_radius <= 0.0:
        return wp.vec2(0.0, 0.0)
    return square_to_disk(sobol.sample_2d(scene.sobol, iteration, 2, _jitter_scramble(camera, pixel, seed)))


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _trace_primary(
    first: int, scene: SceneData, camera: CameraData, iteration: int, seed: wp.uint32, gbuffer: GBuffer
) -> None:
    """One camera ray and what it meets."""
    index = first + wp.tid()
    pixel = pixel_at(gbuffer.tiles, index)
    if pixel < 0:
        return
    place = wp.vec2(0.5, 0.5)
    lens = wp.vec2(0.0, 0.0)
    if iteration >= 0:
        sample = iteration - skipped_iterations(gbuffer.tiles, index)  # a pixel leaves out no point of its sequence
        place = jitter(scene, camera, pixel, sample, seed)
        lens = lens_point(scene, camera, pixel, sample, seed)
    sight = trace_camera_ray(scene, camera, camera_ray(camera, pixel, place, lens))
    gbuffer.mesh[pixel] = sight.mesh
    gbuffer.position[pixel] = sight.position
    gbuffer.normal_or_direct[pixel] = sight.normal
    gbuffer.smooth_normal[pixel] = sight.smooth_normal
    gbuffer.shading_normal[pixel] = sight.shading_normal  # the same array, if there are no maps
    gbuffer.albedo[pixel] = sight.albedo
    if gbuffer.emission.shape[0] > 0:
        gbuffer.emission[pixel] = sight.emission
    gbuffer.depth[pixel] = sight.depth
    if gbuffer.surface_point.shape[0] > 0:
        gbuffer.surface_point[pixel] = surface_point_of(sight.hit)


@wp.func
def reflecting_pixel(gbuffer: GBuffer, index: int) -> int:
    """The pixel that index `index` of a launch stands for, if what it shows reflects light; else -1.

    Estimators begin with this. Where a pixel of the film reflects nothing, its irradiance is set to 0 here.
    """
    pixel = pixel_at(gbuffer.tiles, index)
    if pixel < 0:
        return -1
    if gbuffer.mesh[pixel] < 0 or wp.max(gbuffer.albedo[pixel]) <= 0.0:
        gbuffer.normal_or_direct[pixel] = wp.vec3(0.0)
        gbuffer.indirect[pixel] = wp.vec3(0.0)
        return -1
    return pixel


def new_gbuffer(
    launcher: Launcher,
    columns: int,
    rows: int,
    *,
    has_normal_maps: bool,
    has_emission: bool,
    moving: bool = False,
    spare: int = 0,
) -> tuple[GBuffer, wp.array[wp.float32]]:
    """An uninitialised `GBuffer` of all pixels, and the block of float32 that most of its arrays lie in.

    The block has at least `spare` float32 a pixel: it is scratch memory while no iteration is in work.

    Args:
        launcher: Where to allocate.
        columns: Pixels across.
        rows: Pixels down.
        has_normal_maps: Whether the scene has normal maps.
        has_emission: Whether the camera may see anything that emits.
        moving: Whether surfaces move while the shutter is open.
        spare: Least size of the block [float32 per pixel].
    """
    vectors = ["position", "normal_or_direct", "indirect", "shading_normal", "albedo"]
    vectors += ["smooth_normal"] * has_normal_maps + ["emission"] * has_emission
    types = [*[wp.vec3] * len(vectors), wp.int32, wp.float32]
    pixels = columns * rows
    block = launcher.empty(pixels * max(float_count(*types), spare), wp.float32)
    *arrays, mesh, depth = partition(block, pixels, types)
    gbuffer = GBuffer()
    gbuffer.mesh, gbuffer.depth = mesh, depth
    gbuffer.tiles = all_tiles(columns, rows, launcher)
    for name, array in zip(vectors, arrays, strict=True):
        setattr(gbuffer, name, array)
    gbuffer.surface_point = launcher.empty(pixels if moving else 0, SurfacePoint)
    if not has_emission:
        gbuffer.emission = launcher.empty(0, wp.vec3)
    if not has_normal_maps:
        gbuffer.smooth_normal = gbuffer.shading_normal
    return gbuffer, block


def trace_primary(
    scene: DeviceScene,
    camera: Any,
    launcher: Launcher,
    gbuffer: Any,
    *,
    iteration: int,
    seed: int,
) -> None:
    """Fills the tiles of the G-buffer with what the camera sees in one iteration; in -1 through the pixels' centres."""
    count = indices(gbuffer.tiles)
    launcher.launch(_trace_primary, count, [scene.data, camera, iteration, wp.uint32(seed), gbuffer])
    launcher.profile.counts["primary_rays"] += gbuffer.tiles.pixels
