"""The time in which the shutter is open: where surfaces are at each moment, and which pixel a sample is for.

A pixel stands for what its centre shows at the moment in the middle, through the middle of the lens. A sample falls
anywhere, at any moment; it is for the pixel in which the same point of the same triangle is seen then and there. So
none is lost, and none is blurred.
"""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.device.scratch import Scratch
from warp_ir.device_scene import CameraData, DeviceScene, SceneData
from warp_ir.gbuffer import GBuffer, SurfacePoint, project
from warp_ir.reconstruction.pixel_surfaces import MATCH, pixel_around, same_surface
from warp_ir.reconstruction.sample_buffer import SampleBuffer, add_other, add_sample
from warp_ir.surface import Hit, scene_at, shading_normal
from warp_ir.tiles import indices, pixel_at

wp.set_module_options({"enable_backward": False, "max_unroll": 0})


class ShutterSample(Protocol):
    """The scene and the camera at one moment, and what the camera multiplies light by."""

    @property
    def scene(self) -> DeviceScene: ...  # noqa: D102

    @property
    def camera(self) -> Any: ...  # noqa: D102

    @property
    def exposure(self) -> float: ...  # noqa: D102


@wp.struct
class Blur:
    """The time in which the shutter is open, as moments in their order; one row if it is not."""

    scenes: wp.array[SceneData]
    cameras: wp.array[CameraData]
    exposures: wp.array[wp.float32]
    shifts: wp.array[wp.int32]  # rows from a triangle that moves in the middle moment to the same one in another
    bits: int  # there are 2^bits
    middle: int
    first_moving: int  # row of the first triangle that moves
    sobol: wp.array[wp.uint32]
    moves: int  # 1: surfaces do, and are the same triangles at every moment


@wp.struct
class Point:
    """A point of a surface."""

    position: wp.vec3
    normal: wp.vec3  # without normal maps


@wp.func(inline=False)
def _placed(address: wp.uint64, surface_point: SurfacePoint, triangle: int, facing: wp.vec3) -> Point:
    """Where a point of a triangle is; its normal is on the side of `facing`."""
    scene = scene_at(address)[0]
    hit = Hit()
    hit.triangle = triangle
    hit.instance = surface_point.instance
    hit.u = float(surface_point.weights >> wp.uint32(16)) / 65535.0
    hit.v = float(surface_point.weights & wp.uint32(65535)) / 65535.0
    a = scene.points[scene.indices[3 * triangle]]
    b = scene.points[scene.indices[3 * triangle + 1]]
    c = scene.points[scene.indices[3 * triangle + 2]]
    n = wp.cross(b - a, c - a)
    out = Point()
    out.position = a * hit.u + b * hit.v + c * (1.0 - hit.u - hit.v)
    if hit.instance >= 0:
        n = wp.transpose(scene.instances[hit.instance].inverse) * n
        out.position = scene.instance_axes[hit.instance] * out.position + scene.instances[hit.instance].centre
    hit.normal = wp.normalize(wp.where(wp.dot(n, facing) < 0.0, -n, n))
    out.normal = shading_normal(scene, hit)
    return out


@wp.func
def at_reference_time(
    blur: Blur, moment: int, surface_point: SurfacePoint, position: wp.vec3, normal: wp.vec3
) -> Point:
    """Where a point of a moment is at the moment in the middle. Normals turn little while a shutter is open."""
    out = Point()
    out.position = position
    out.normal = normal
    moving = surface_point.triangle >= blur.first_moving
    if blur.moves == 1 and moment != blur.middle and (moving or surface_point.instance >= 0):
        row = surface_point.triangle
        if moving:
            row -= blur.shifts[moment]
        there = _placed(blur.scenes[moment].address, surface_point, surface_point.triangle, normal)
        here = _placed(blur.scenes[blur.middle].address, surface_point, row, normal)
        # What the point is off its triangle, as on smooth surfaces, it stays.
        out.position += here.position - there.position
        out.normal += here.normal - there.normal
    return out


@wp.kernel(module="warp_ir.reconstruction.blur")  # so that what they share is compiled once
def _aim(
    first: int,
    blur: Blur,
    moment: int,
    gbuffer: GBuffer,
    seen: SampleBuffer,
    pixels: wp.array2d[wp.int32],
) -> None:
    """Says for which pixel each sample is (first row); those that no pixel's centre shows stay where they are."""
    i = first + wp.tid()
    p = pixel_at(gbuffer.tiles, i)
    surfaces = seen.surfaces
    none = surfaces.columns * surfaces.rows
    pixels[0, i] = none
    pixels[1, i] = p
    if p >= 0 and gbuffer.mesh[p] >= 0 and wp.max(gbuffer.albedo[p]) > 0.0:
        surface_point = SurfacePoint()
        if blur.moves == 1:
            surface_point = gbuffer.surface_point[p]
        point = at_reference_time(blur, moment, surface_point, gbuffer.position[p], gbuffer.smooth_normal[p])
        place = project(blur.cameras[blur.middle], point.position)
        x = int(wp.floor(place[0]))
        y = int(wp.floor(place[1]))
        if x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows:
            q = y * surfaces.columns + x
            if same_surface(surfaces, q, point.position, point.normal) > MATCH:
                pixels[0, i] = q
            else:
                for k in range(9):
                    near = pixel_around(surfaces, q, k)
                    if same_surface(surfaces, near, point.position, point.normal) > MATCH:
                        pixels[0, i] = near
        if pixels[0, i] == none:
            add_other(seen, p, gbuffer.normal_or_direct[p], gbuffer.indirect[p])


@wp.kernel(module="warp_ir.reconstruction.blur")
def _take(
    first: int,
    samples: int,
    pixels: wp.array2d[wp.int32],
    gbuffer: GBuffer,
    seen: SampleBuffer,
) -> None:
    """Adds to each pixel the samples that are for it: a run of the sorted ones."""
    p = first + wp.tid()
    k = int(wp.lower_bound(pixels[0], 0, samples, p))
    while k < samples and pixels[0, k] == p:
        q = pixels[1, k]
        add_sample(seen, p, gbuffer.normal_or_direct[q], gbuffer.indirect[q])
        k += 1


@wp.kernel(module="warp_ir.reconstruction.blur")
def _estimate_missing_noise(first: int, seen: SampleBuffer) -> None:
    """Of pixels without samples: the noise of their neighbours' on the same surface."""
    p = first + wp.tid()
    surfaces = seen.surfaces
    if seen.count[p] == 0:
        sum = wp.vec2(0.0)
        weights = float(0.0)
        for dy in range(-2, 3):
            for dx in range(-2, 3):
                x = p % surfaces.columns + 2 * dx
                y = p // surfaces.columns + 2 * dy
                if x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows:
                    q = y * surfaces.columns + x
                    if seen.count[q] > 0:
                        w = same_surface(surfaces, p, surfaces.position[q], surfaces.normal[q])
                        sum += w * seen.noise[q]
                        weights += w
        seen.noise[p] = sum / wp.max(weights, 1.0e-6)


def surfaces_move(scenes: Sequence[DeviceScene]) -> bool:
    """Whether surfaces are elsewhere at some moments."""
    first = scenes[0]
    places = [[id(group.matrices) for group in s.stored.instances] for s in scenes]
    return any(s.first_triangles != first.first_triangles for s in scenes) or any(p != places[0] for p in places)


def new_blur(moments: Sequence[ShutterSample], launcher: Launcher) -> Any:
    """The `Blur` of the moments of a scene; their number is a power of two."""
    blur = Blur()
    blur.bits, blur.middle = len(moments).bit_length() - 1, len(moments) // 2
    scenes = [m.scene for m in moments]
    blur.scenes = launcher.array([scene.data for scene in scenes], SceneData)
    blur.cameras = launcher.array([m.camera for m in moments], CameraData)
    blur.exposures = launcher.array([m.exposure for m in moments], wp.float32)
    middle = scenes[blur.middle]
    shifts = [_shift(scene, middle) for scene in scenes]
    blur.sobol = middle.data.sobol
    blur.moves = int(surfaces_move(scenes) and None not in shifts)
    moving = [
        row
        for s in scenes
        for a, b in zip(s.first_triangles, middle.first_triangles, strict=False)
        if a != b
        for row in (a, b)
    ]
    blur.first_moving = min(moving, default=2**31 - 1)
    blur.shifts = launcher.array([shift or 0 for shift in shifts], wp.int32)
    return blur


def _shift(one: DeviceScene, other: DeviceScene) -> int | None:
    """Rows from the triangles that move in one moment to the same in another; None: they are not the same."""
    a, b = one.stored, other.stored
    counts = [[len(group.matrices) for group in scene.instances] for scene in (a, b)]
    if len(a.meshes) != len(b.meshes) or counts[0] != counts[1]:
        return None
    for mine, its in zip(a.meshes, b.meshes, strict=True):
        if mine.triangles is not its.triangles and not np.array_equal(mine.triangles, its.triangles):
            return None
    shifts = {mine - its for mine, its in zip(one.first_triangles, other.first_triangles, strict=True) if mine != its}
    return None if len(shifts) > 1 else next(iter(shifts), 0)


def accumulate_blurred(blur: Any, seen: Any, shutter_sample: int, gbuffer: GBuffer, scratch: Scratch) -> None:
    """Adds one iteration's samples of irradiance over π, made at a moment, to `SampleBuffer`."""
    launcher, count = scratch.launcher, indices(gbuffer.tiles)
    order = scratch.array("sample_pixels", 4 * count, wp.int32)[: 4 * count].reshape((2, 2 * count))
    launcher.launch(_aim, count, [blur, shutter_sample, gbuffer, seen, order])
    wp.utils.radix_sort_pairs(order[0], order[1], count)
    launcher.launch(_take, seen.count.shape[0], [count, order, gbuffer, seen])


def estimate_missing_noise(seen: Any, launcher: Launcher) -> None:
    """Completes the noise of `SampleBuffer` where they have no samples."""
    launcher.launch(_estimate_missing_noise, seen.count.shape[0], [seen])
