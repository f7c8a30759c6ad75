"""What the camera sees: one jittered ray per pixel, and the surface it meets.

The jitter of a pixel is a (0,2)-sequence over the iterations, scrambled by pixel: the first 2^k iterations
sample the pixel's area in as many strata, so edges converge faster than noise.
"""

from typing import Any

import warp as wp

from warp_ir import sampling
from warp_ir.device_scene import CameraData, DeviceScene, SceneData
from warp_ir.launch import Launcher
from warp_ir.lights import lights_along
from warp_ir.surface import albedo, closest, emission, shading_normal

wp.set_module_options({"enable_backward": False})

_JITTER = wp.constant(wp.uint32(0x6A09E667))


@wp.struct
class GBuffer:
    """One row per pixel, the top left first; in the scene's device frame."""

    mesh: wp.array[wp.int32]  # index into Scene.meshes; -1: background
    position: wp.array[wp.vec3]  # off the surface, where shadow rays start
    normal: wp.array[wp.vec3]  # geometric, towards the camera
    shading_normal: wp.array[wp.vec3]
    albedo: wp.array[wp.vec3]
    emission: wp.array[wp.vec3]  # radiance that reaches the camera without reflection
    depth: wp.array[wp.float32]  # along the camera's -Z


@wp.struct
class Ray:
    """A camera ray; `direction` has length 1 along the camera's -Z, so that t is depth."""

    origin: wp.vec3
    direction: wp.vec3


@wp.func
def camera_ray(camera: CameraData, x: float, y: float) -> Ray:
    """The ray through film position (x, y) in [0, 1]², (0, 0) being the top left."""
    right = camera.left + x * camera.width
    up = camera.bottom + (1.0 - y) * camera.height
    ray = Ray()
    on_film = right * camera.right + up * camera.up
    if camera.orthographic == 1:
        ray.origin = camera.origin + on_film
        ray.direction = -camera.back
    else:
        ray.origin = camera.origin
        ray.direction = on_film - camera.back
    return ray


@wp.struct
class Sight:
    """What a camera ray meets; `mesh` is -1 for the background."""

    mesh: int
    position: wp.vec3
    normal: wp.vec3
    shading_normal: wp.vec3
    albedo: wp.vec3
    emission: wp.vec3
    depth: float


@wp.func
def see(scene: SceneData, camera: CameraData, ray: Ray) -> Sight:
    """Follows a camera ray."""
    origin = ray.origin + ray.direction * camera.near
    reach = camera.far - camera.near
    hit = closest(scene, origin, ray.direction, reach)
    sight = Sight()
    sight.mesh = -1
    if hit.triangle >= 0:
        sight.mesh = scene.triangle_mesh[hit.triangle]
        sight.position = hit.position
        sight.normal = hit.normal
        sight.shading_normal = shading_normal(scene, hit)
        sight.depth = hit.t + camera.near
        pixel = wp.sqrt(camera.width * camera.height / float(camera.columns * camera.rows))
        pixel *= wp.where(camera.orthographic == 1, 1.0, sight.depth)
        sight.albedo = albedo(scene, hit, pixel)
        sight.emission = emission(scene, hit, pixel)
        reach = hit.t
    if camera.shows_lights == 1:
        length = wp.length(ray.direction)
        sight.emission += lights_along(scene, origin, ray.direction / length, reach * length, sight.mesh < 0, -1.0)
    return sight


@wp.kernel
def _trace_primary(
    first: int, scene: SceneData, camera: CameraData, iteration: int, seed: wp.uint32, gbuffer: GBuffer
) -> None:
    """One camera ray and what it meets."""
    pixel = first + wp.tid()
    jitter = wp.vec2(0.5, 0.5)
    if iteration >= 0:
        scramble = sampling.hash_combine(sampling.hash_combine(seed, wp.uint32(pixel)), _JITTER)
        jitter = sampling.sample_2d(scene.sobol, iteration, 0, scramble)
    x = (float(pixel % camera.columns) + jitter[0]) / float(camera.columns)
    y = (float(pixel // camera.columns) + jitter[1]) / float(camera.rows)
    sight = see(scene, camera, camera_ray(camera, x, y))
    gbuffer.mesh[pixel] = sight.mesh
    gbuffer.position[pixel] = sight.position
    gbuffer.normal[pixel] = sight.normal
    gbuffer.shading_normal[pixel] = sight.shading_normal
    gbuffer.albedo[pixel] = sight.albedo
    gbuffer.emission[pixel] = sight.emission
    gbuffer.depth[pixel] = sight.depth


def new_gbuffer(launcher: Launcher, pixels: int) -> Any:
    """An uninitialised `GBuffer`."""
    gbuffer = GBuffer()
    gbuffer.mesh = launcher.empty(pixels, wp.int32)
    for name in ("position", "normal", "shading_normal", "albedo", "emission"):
        setattr(gbuffer, name, launcher.empty(pixels, wp.vec3))
    gbuffer.depth = launcher.empty(pixels, wp.float32)
    return gbuffer


def trace_primary(
    scene: DeviceScene,
    camera: Any,
    launcher: Launcher,
    gbuffer: Any,
    *,
    iteration: int,
    seed: int,
) -> None:
    """Fills the G-buffer with what the camera sees in one iteration; in iteration -1 through the pixels' centres."""
    pixels = camera.columns * camera.rows
    launcher.launch(_trace_primary, pixels, [scene.data, camera, iteration, wp.uint32(seed), gbuffer])
    launcher.profile.counts["primary_rays"] += pixels
