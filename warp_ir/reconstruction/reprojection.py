"""Reprojection of defocused and moving samples: into the pixel that shows the same surface point at a reference time.

A pixel stands for the surface that is visible through its centre and the centre of the lens at the reference time, the
middle shutter sample. A sample is made through any point of the lens at any shutter sample; it is accumulated in the
pixel that shows the same point of the same triangle at the reference time. So no sample is lost, and none is blurred.
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.device.scratch import Scratch
from warp_ir.device_scene import CameraData, DeviceScene, SceneData
from warp_ir.gbuffer import GBuffer, SurfacePoint, project
from warp_ir.reconstruction.pixel_surfaces import MIN_MATCH, match_weight, neighbor_pixel
from warp_ir.reconstruction.sample_buffer import SampleBuffer, add_sample, add_unassigned
from warp_ir.surface import Hit, scene_at, shading_normal
from warp_ir.tiles import indices, pixel_at

wp.set_module_options({"enable_backward": False, "max_unroll": 0})


class ShutterSample(Protocol):
    """The scene, the camera and its exposure at one time while the shutter is open."""

    @property
    def scene(self) -> DeviceScene:
        """The scene at that time."""

    @property
    def camera(self) -> CameraData:
        """The camera at that time."""

    @property
    def exposure(self) -> float:
        """Factor from radiance to the film."""


@wp.struct
class ShutterData:
    """The shutter samples in their order; one if only the lens blurs."""

    scenes: wp.array[SceneData]
    cameras: wp.array[CameraData]
    exposures: wp.array[wp.float32]  # in units of the reconstruction
    row_offsets: wp.array[wp.int32]  # row of a moving triangle at a shutter sample minus its row at the reference time
    log2_count: int
    reference: int  # number of the middle shutter sample
    first_moving: int  # row of the first triangle that moves
    sobol: wp.array[wp.uint32]
    surfaces_move: int  # 1: surfaces move, and are made of the same triangles at all shutter samples


@wp.struct
class ReprojectedPoint:
    """A surface point at the reference time."""

    position: wp.vec3
    normal: wp.vec3  # smooth shading normal, without normal maps


@wp.func(inline=False)
def _evaluate_surface_point(
    address: wp.uint64, surface_point: SurfacePoint, triangle: int, facing: wp.vec3
) -> ReprojectedPoint:
    """Position and normal of a surface point in the scene at `address`; the normal is on the side of `facing`."""
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
    out = ReprojectedPoint()
    out.position = a * hit.u + b * hit.v + c * (1.0 - hit.u - hit.v)
    if hit.instance >= 0:
        n = wp.transpose(scene.instances[hit.instance].inverse) * n
        out.position = scene.instance_axes[hit.instance] * out.position + scene.instances[hit.instance].centre
    hit.normal = wp.normalize(wp.where(wp.dot(n, facing) < 0.0, -n, n))
    out.normal = shading_normal(scene, hit)
    return out


@wp.func
def reproject_to_reference(
    shutter: ShutterData, shutter_sample: int, surface_point: SurfacePoint, position: wp.vec3, normal: wp.vec3
) -> ReprojectedPoint:
    """Position and normal at the reference time of a surface point that a ray has hit at a shutter sample.

    The normal is approximate: the change of the normal is added to it.
    """
    out = ReprojectedPoint()
    out.position = position
    out.normal = normal
    moving = surface_point.triangle >= shutter.first_moving
    away = shutter_sample != shutter.reference
    if shutter.surfaces_move == 1 and away and (moving or surface_point.instance >= 0):
        row = surface_point.triangle
        if moving:
            row -= shutter.row_offsets[shutter_sample]
        scene = shutter.scenes[shutter_sample].address
        reference_scene = shutter.scenes[shutter.reference].address
        hit = _evaluate_surface_point(scene, surface_point, surface_point.triangle, normal)
        reference = _evaluate_surface_point(reference_scene, surface_point, row, normal)
        # Only the motion is added, which keeps the offset from the surface.
        out.position += reference.position - hit.position
        out.normal += reference.normal - hit.normal
    return out


@wp.kernel(module="warp_ir.reconstruction.blur")  # so that shared functions are compiled once
def _assign_pixels(
    first: int,
    shutter: ShutterData,
    shutter_sample: int,
    gbuffer: GBuffer,
    samples: SampleBuffer,
    pixels: wp.array2d[wp.int32],
) -> None:
    """Writes the pixel that each sample is accumulated in (row 0) and the one that traced it (row 1).

    Samples on surfaces that no pixel centre shows are added to the unassigned ones.
    """
    i = first + wp.tid()
    p = pixel_at(gbuffer.tiles, i)
    surfaces = samples.surfaces
    unassigned = surfaces.columns * surfaces.rows
    pixels[0, i] = unassigned
    pixels[1, i] = p
    if p >= 0 and gbuffer.mesh[p] >= 0 and wp.max(gbuffer.albedo[p]) > 0.0:
        surface_point = SurfacePoint()
        if shutter.surfaces_move == 1:
            surface_point = gbuffer.surface_point[p]
        point = reproject_to_reference(
            shutter, shutter_sample, surface_point, gbuffer.position[p], gbuffer.smooth_normal[p]
        )
        place = project(shutter.cameras[shutter.reference], point.position)
        x = int(wp.floor(place[0]))
        y = int(wp.floor(place[1]))
        if x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows:
            q = y * surfaces.columns + x
            if match_weight(surfaces, q, point.position, point.normal) > MIN_MATCH:
                pixels[0, i] = q
            else:
                for k in range(9):
                    neighbor = neighbor_pixel(surfaces, q, k)
                    if match_weight(surfaces, neighbor, point.position, point.normal) > MIN_MATCH:
                        pixels[0, i] = neighbor
        if pixels[0, i] == unassigned:
            add_unassigned(samples, p, gbuffer.normal_or_direct[p], gbuffer.indirect[p])


@wp.kernel(module="warp_ir.reconstruction.blur")
def _add_reprojected(
    first: int,
    count: int,
    pixels: wp.array2d[wp.int32],
    gbuffer: GBuffer,
    samples: SampleBuffer,
) -> None:
    """Adds to a pixel the samples that are assigned to it: a run of the `count` sorted ones."""
    p = first + wp.tid()
    k = int(wp.lower_bound(pixels[0], 0, count, p))
    while k < count and pixels[0, k] == p:
        q = pixels[1, k]
        add_sample(samples, p, gbuffer.normal_or_direct[q], gbuffer.indirect[q])
        k += 1


@wp.kernel(module="warp_ir.reconstruction.blur")
def _estimate_missing_variance(first: int, samples: SampleBuffer) -> None:
    """Sets the variance of a pixel without samples to that of its neighbours on the same surface."""
    p = first + wp.tid()
    surfaces = samples.surfaces
    if samples.count[p] == 0:
        sum = wp.vec2(0.0)
        weights = float(0.0)
        for dy in range(-2, 3):
            for dx in range(-2, 3):
                x = p % surfaces.columns + 2 * dx
                y = p // surfaces.columns + 2 * dy
                if x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows:
                    q = y * surfaces.columns + x
                    if samples.count[q] > 0:
                        w = match_weight(surfaces, p, surfaces.position[q], surfaces.normal[q])
                        sum += w * samples.variance[q]
                        weights += w
        samples.variance[p] = sum / wp.max(weights, 1.0e-6)


def surfaces_move(scenes: Sequence[DeviceScene]) -> bool:
    """Whether any surface moves between the shutter samples."""
    first = scenes[0]
    # What does not move is the same memory, of which every record has a view of its own.
    places = [[group.matrices.ctypes.data for group in s.stored.instances] for s in scenes]
    return any(s.first_triangles != first.first_triangles for s in scenes) or any(p != places[0] for p in places)


def new_shutter_data(shutter: Sequence[ShutterSample], exposure_unit: float, launcher: Launcher) -> ShutterData:
    """The `ShutterData` of some shutter samples, whose number is a power of two; exposures are in a given unit."""
    data = ShutterData()
    data.log2_count, data.reference = len(shutter).bit_length() - 1, len(shutter) // 2
    scenes = [sample.scene for sample in shutter]
    data.scenes = launcher.array([scene.data for scene in scenes], SceneData)
    data.cameras = launcher.array([sample.camera for sample in shutter], CameraData)
    data.exposures = launcher.array([sample.exposure / exposure_unit for sample in shutter], wp.float32)
    reference = scenes[data.reference]
    offsets = [_row_offset(scene, reference) for scene in scenes]
    data.sobol = reference.data.sobol
    data.surfaces_move = int(surfaces_move(scenes) and None not in offsets)
    moving = [
        row
        for s in scenes
        for a, b in zip(s.first_triangles, reference.first_triangles, strict=False)
        if a != b
        for row in (a, b)
    ]
    data.first_moving = min(moving, default=2**31 - 1)
    data.row_offsets = launcher.array([offset or 0 for offset in offsets], wp.int32)
    return data


def _row_offset(scene: DeviceScene, reference: DeviceScene) -> int | None:
    """Rows of the moving triangles minus their rows in the reference scene; None if the triangles are not the same."""
    a, b = scene.stored, reference.stored
    counts = [[len(group.matrices) for group in stored.instances] for stored in (a, b)]
    if len(a.meshes) != len(b.meshes) or counts[0] != counts[1]:
        return None
    for mine, theirs in zip(a.meshes, b.meshes, strict=True):
        if mine.triangles is not theirs.triangles and not np.array_equal(mine.triangles, theirs.triangles):
            return None
    offsets = {
        mine - theirs
        for mine, theirs in zip(scene.first_triangles, reference.first_triangles, strict=True)
        if mine != theirs
    }
    return None if len(offsets) > 1 else next(iter(offsets), 0)


def accumulate_reprojected(
    shutter: ShutterData, samples: SampleBuffer, shutter_sample: int, gbuffer: GBuffer, scratch: Scratch
) -> None:
    """Adds one iteration's samples of irradiance over π, made at a shutter sample, to a `SampleBuffer`."""
    launcher, count = scratch.launcher, indices(gbuffer.tiles)
    pixels = scratch.array("sample_pixels", 4 * count, wp.int32)[: 4 * count].reshape((2, 2 * count))
    launcher.launch(_assign_pixels, count, [shutter, shutter_sample, gbuffer, samples, pixels])
    wp.utils.radix_sort_pairs(pixels[0], pixels[1], count)
    launcher.launch(_add_reprojected, samples.count.shape[0], [count, pixels, gbuffer, samples])


def estimate_missing_variance(samples: SampleBuffer, launcher: Launcher) -> None:
    """Fills in the variance of those pixels of a `SampleBuffer` that have no samples."""
    launcher.launch(_estimate_missing_variance, samples.count.shape[0], [samples])
