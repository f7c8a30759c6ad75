"""The G-buffer: what the camera sees, by one jittered ray per pixel and iteration.

The jitter of a pixel is a (0,2)-sequence over the iterations, scrambled per pixel: the first 2^k iterations lie in as
many strata of the pixel's area, so edges converge faster than noise. The next two sample dimensions choose the point on
the lens, if the camera has one.
"""

import warp as wp

from warp_ir.device.launcher import MAX_REGISTERS, Launcher, float_count, partition
from warp_ir.device_scene import CameraData, DeviceScene, SceneData
from warp_ir.lights import emission_to_camera, intersect_lights
from warp_ir.sampling import sobol
from warp_ir.sampling.square_to import square_to_disk
from warp_ir.surface import (
    Hit,
    ShadingPoint,
    albedo,
    closest,
    mapped_normal,
    shading_normal,
    shading_point,
    smooth_height,
)
from warp_ir.tiles import Tiles, all_tiles, indices, pixel_at, skipped_iterations

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_FARTHEST = wp.constant(1.0e30)  # a ray is parallel to a plane that it meets only beyond this
_JITTER = wp.constant(wp.uint32(0x6A09E667))


@wp.struct
class SurfacePoint:
    """A point of a triangle by its barycentric coordinates, which stays on the triangle while that moves."""

    triangle: int
    instance: int  # -1: the triangle is not instanced
    weights: wp.uint32  # barycentric weights of the first and the second corner, in steps of 1/65535


@wp.struct
class GBuffer:
    """What the camera sees and how it is lit: one row per pixel, row by row from the top left, in the device frame."""

    mesh: wp.array[wp.int32]  # index into Scene.meshes; -1: background
    position: wp.array[wp.vec3]  # off the surface, on the side of its normal
    normal_or_direct: wp.array[wp.vec3]  # the geometric normal; the estimator replaces it by the direct irradiance
    # over π, which needs no memory of its own
    indirect: wp.array[wp.vec3]  # irradiance over π from VPLs on surfaces or by further bounces, from the estimator
    shading_normal: wp.array[wp.vec3]
    smooth_normal: wp.array[wp.vec3]  # the shading normal without normal maps: the filter tells surfaces apart by it
    albedo: wp.array[wp.vec3]
    emission: wp.array[wp.vec3]  # radiance that reaches the camera unreflected; empty: nothing in view can emit
    depth: wp.array[wp.float32]  # distance along the camera's -Z
    smooth_height: wp.array[wp.float32]  # of `ShadingPoint`; empty if no mesh has normals
    surface_point: wp.array[SurfacePoint]  # empty if no surface moves while the shutter is open
    tiles: Tiles  # the pixels of this iteration; the rows of other pixels are undefined


@wp.struct
class Ray:
    """A camera ray. Its `direction` has length 1 along the camera's -Z, so that the ray parameter t is the depth."""

    origin: wp.vec3
    direction: wp.vec3


@wp.func
def camera_ray(camera: CameraData, pixel: int, u: wp.vec2, lens: wp.vec2) -> Ray:
    """The ray through the point `u` in [0, 1]² of a pixel of the film, from the point `lens` of the unit disk.

    (0, 0) is the top left of the pixel. All rays through one point of the film meet at the focus distance.
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
        lens_offset = (lens[0] * camera.right + lens[1] * camera.up) * camera.lens_radius
        ray.origin = camera.origin + lens_offset
        ray.direction = on_film - camera.back - lens_offset / camera.focus_distance
    return ray


@wp.func
def project(camera: CameraData, position: wp.vec3) -> wp.vec2:
    """The place on the film [pixels] at which the centre of the lens sees a point; far outside if it is behind it."""
    to_point = position - camera.origin
    depth = wp.where(camera.orthographic == 1, 1.0, -wp.dot(to_point, camera.back))
    if depth <= 0.0:
        return wp.vec2(-_FARTHEST, -_FARTHEST)
    x = (wp.dot(to_point, camera.right) / depth - camera.left) / camera.width
    y = 1.0 - (wp.dot(to_point, camera.up) / depth - camera.bottom) / camera.height
    on_image = wp.vec2(x * float(camera.image_columns), y * float(camera.image_rows))
    return on_image - wp.vec2(float(camera.first_column), float(camera.first_row))


@wp.func
def image_pixel(camera: CameraData, pixel: int) -> int:
    """Index of a pixel of the film in the whole image. Its samples depend on it, so a crop has the same pixels."""
    column = camera.first_column + pixel % camera.columns
    return (camera.first_row + pixel // camera.columns) * camera.image_columns + column


@wp.struct
class CameraHit:
    """The surface that a camera ray hits; `mesh` is -1 for the background."""

    mesh: int
    position: wp.vec3
    normal: wp.vec3
    shading_normal: wp.vec3
    smooth_normal: wp.vec3
    albedo: wp.vec3
    emission: wp.vec3
    depth: float
    smooth_height: float
    hit: Hit  # from which the other fields were computed


@wp.func
def surface_point_of(hit: Hit) -> SurfacePoint:
    """The hit point by its barycentric coordinates."""
    out = SurfacePoint()
    out.triangle = hit.triangle
    out.instance = hit.instance
    u = wp.uint32(wp.clamp(hit.u, 0.0, 1.0) * 65535.0)
    v = wp.uint32(wp.clamp(hit.v, 0.0, 1.0) * 65535.0)
    out.weights = (u << wp.uint32(16)) | v
    return out


@wp.func
def _clip_interval(camera: CameraData, ray: Ray) -> wp.vec2:
    """The interval of depths between the clipping range and planes; its ends are equal if it is empty."""
    near = camera.near
    far = camera.far
    for k in range(camera.plane_count):
        plane = camera.planes[k]
        n = wp.vec3(plane[0], plane[1], plane[2])
        distance = wp.dot(n, ray.origin - camera.origin) + plane[3]
        slope = wp.dot(n, ray.direction)
        if slope > 0.0:
            near = wp.max(near, -distance / slope)
        elif slope < 0.0:
            far = wp.min(far, -distance / slope)
        elif distance < 0.0:
            far = near
    if near >= far or near > _FARTHEST:
        return wp.vec2(camera.near, camera.near)
    return wp.vec2(near, far)


@wp.func
def first_hit(scene: SceneData, camera: CameraData, ray: Ray) -> Hit:
    """The surface that a camera ray hits between the clipping range and planes."""
    interval = _clip_interval(camera, ray)
    near = interval[0]
    return closest(scene, ray.origin + ray.direction * near, ray.direction, interval[1] - near)


@wp.func
def pixel_width(camera: CameraData, depth: float) -> float:
    """Width of a pixel on a surface that faces the camera at a depth."""
    width = wp.sqrt(camera.width * camera.height / float(camera.image_columns * camera.image_rows))
    return width * wp.where(camera.orthographic == 1, 1.0, depth)


@wp.func
def trace_camera_ray(scene: SceneData, camera: CameraData, ray: Ray) -> CameraHit:
    """Traces a camera ray, and evaluates the surface that it hits."""
    interval = _clip_interval(camera, ray)
    near = interval[0]
    origin = ray.origin + ray.direction * near
    t_max = interval[1] - near
    hit = closest(scene, origin, ray.direction, t_max)
    length = wp.length(ray.direction)
    direction_unit = ray.direction / length
    hit_record = CameraHit()
    hit_record.mesh = -1
    if hit.triangle >= 0:
        hit_record.hit = hit
        hit_record.mesh = scene.triangle_mesh[hit.triangle]
        hit_record.position = hit.position
        hit_record.normal = hit.normal
        hit_record.shading_normal = shading_normal(scene, hit)
        hit_record.smooth_height = smooth_height(scene, hit, hit_record.shading_normal)
        hit_record.depth = hit.t + near
        pixel = pixel_width(camera, hit_record.depth)
        hit_record.smooth_normal = hit_record.shading_normal
        hit_record.shading_normal = mapped_normal(scene, hit, hit_record.smooth_normal, pixel)
        hit_record.albedo = albedo(scene, hit, pixel)
        hit_record.emission = emission_to_camera(scene, hit, direction_unit, pixel)
        t_max = hit.t
    if camera.visible_lights == 1:
        hit_record.emission += intersect_lights(
            scene, origin, direction_unit, t_max * length, hit_record.mesh < 0, -1.0, -1
        )
    return hit_record


@wp.func
def _jitter_scramble(camera: CameraData, pixel: int, seed: wp.uint32) -> wp.uint32:
    stream = sobol.hash_combine(seed, wp.uint32(image_pixel(camera, pixel)))
    return sobol.hash_combine(stream, _JITTER)


@wp.func
def jitter(scene: SceneData, camera: CameraData, pixel: int, iteration: int, seed: wp.uint32) -> wp.vec2:
    """The point of a pixel that an iteration samples, in [0, 1)²."""
    return sobol.sample_2d(scene.sobol, iteration, 0, _jitter_scramble(camera, pixel, seed))


@wp.func
def lens_point(scene: SceneData, camera: CameraData, pixel: int, iteration: int, seed: wp.uint32) -> wp.vec2:
    """The point of the lens, in the unit disk, from which an iteration's ray through a pixel starts."""
    if camera.lens_radius <= 0.0:
        return wp.vec2(0.0, 0.0)
    return square_to_disk(sobol.sample_2d(scene.sobol, iteration, 2, _jitter_scramble(camera, pixel, seed)))


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _trace_primary(
    first: int,
    scene: SceneData,
    camera: CameraData,
    iteration: wp.array[wp.int32],
    seed: wp.uint32,
    gbuffer: GBuffer,
) -> None:
    """Traces one camera ray; iteration -1 goes through the centre of the pixel and of the lens."""
    index = first + wp.tid()
    pixel = pixel_at(gbuffer.tiles, index)
    if pixel < 0:
        return
    u_pixel = wp.vec2(0.5, 0.5)
    lens = wp.vec2(0.0, 0.0)
    if iteration[0] >= 0:
        sample = iteration[0] - skipped_iterations(
            gbuffer.tiles, index
        )  # a pixel uses all points of its sequence in turn
        u_pixel = jitter(scene, camera, pixel, sample, seed)
        lens = lens_point(scene, camera, pixel, sample, seed)
    hit_record = trace_camera_ray(scene, camera, camera_ray(camera, pixel, u_pixel, lens))
    gbuffer.mesh[pixel] = hit_record.mesh
    gbuffer.position[pixel] = hit_record.position
    gbuffer.normal_or_direct[pixel] = hit_record.normal
    gbuffer.smooth_normal[pixel] = hit_record.smooth_normal
    gbuffer.shading_normal[pixel] = hit_record.shading_normal  # the same array if there are no normal maps
    gbuffer.albedo[pixel] = hit_record.albedo
    if gbuffer.emission.shape[0] > 0:
        gbuffer.emission[pixel] = hit_record.emission
    gbuffer.depth[pixel] = hit_record.depth
    if gbuffer.smooth_height.shape[0] > 0:
        gbuffer.smooth_height[pixel] = hit_record.smooth_height
    if gbuffer.surface_point.shape[0] > 0:
        gbuffer.surface_point[pixel] = surface_point_of(hit_record.hit)


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


@wp.func
def camera_vertex(gbuffer: GBuffer, pixel: int) -> ShadingPoint:
    """The point that the camera sees at a pixel, before the estimator replaces its normal."""
    x = ShadingPoint()
    x.position = gbuffer.position[pixel]
    x.geometric_normal = gbuffer.normal_or_direct[pixel]
    x.normal = x.geometric_normal
    if gbuffer.smooth_height.shape[0] > 0:
        x.smooth_height = gbuffer.smooth_height[pixel]
        if x.smooth_height > 0.0:
            x.normal = gbuffer.smooth_normal[pixel]
    x.shading_normal = gbuffer.shading_normal[pixel]
    x.mesh = gbuffer.mesh[pixel]
    x.from_camera = True
    x.tile = -1
    return x


@wp.func
def vertex_of_hit(scene: SceneData, hit: Hit) -> ShadingPoint:
    """The `camera_vertex` of a camera ray's hit, without normal maps."""
    x = shading_point(scene, hit)
    x.shading_normal = shading_normal(scene, hit)
    x.smooth_height = smooth_height(scene, hit, x.shading_normal)
    if x.smooth_height > 0.0:
        x.normal = x.shading_normal
    x.from_camera = True
    return x


def new_gbuffer(
    launcher: Launcher,
    columns: int,
    rows: int,
    *,
    has_normals: bool,
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
        has_normals: Whether any mesh has normals.
        has_normal_maps: Whether the scene has normal maps.
        has_emission: Whether the camera may see anything that emits.
        moving: Whether surfaces move while the shutter is open.
        spare: Least size of the block [float32 per pixel].
    """
    vectors = ["position", "normal_or_direct", "indirect", "shading_normal", "albedo"]
    vectors += ["smooth_normal"] * has_normal_maps + ["emission"] * has_emission
    types = [*[wp.vec3] * len(vectors), wp.int32, *[wp.float32] * (1 + has_normals)]
    pixels = columns * rows
    block = launcher.empty(pixels * max(float_count(*types), spare), wp.float32)
    arrays = partition(block, pixels, types)
    gbuffer = GBuffer()
    gbuffer.smooth_height = arrays.pop() if has_normals else launcher.empty(0, wp.float32)
    gbuffer.depth, gbuffer.mesh = arrays.pop(), arrays.pop()
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
    camera: CameraData,
    launcher: Launcher,
    gbuffer: GBuffer,
    *,
    iteration: "int | wp.array[wp.int32]",
    seed: int,
    counted_as: str = "primary_rays",
) -> None:
    """Fills the tiles of the G-buffer with what the camera sees in one iteration; -1: through the pixels' centres.

    The number of the iteration may be an array on the device [1]. The profile counts the rays under the name
    `counted_as`.
    """
    count = indices(gbuffer.tiles)
    number = launcher.array([iteration], wp.int32) if isinstance(iteration, int) else iteration
    launcher.launch(_trace_primary, count, [scene.data, camera, number, wp.uint32(seed), gbuffer])
    launcher.profile.counts[counted_as] += gbuffer.tiles.pixels
