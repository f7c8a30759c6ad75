"""Coverage: how much of every pixel each object and each material covers, counted by camera rays."""

from collections.abc import Iterable, Sequence
from itertools import chain

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import MAX_REGISTERS, Launcher
from warp_ir.device_scene import CameraData, DeviceScene, SceneData
from warp_ir.gbuffer import camera_ray, first_hit, jitter, lens_point
from warp_ir.image.cryptomatte import RANKS, Cryptomatte

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

SAMPLES = 64
"""Camera rays per pixel: those of the first iterations of a picture."""
_SLOTS = wp.constant(8)  # names that are told apart in a pixel; what further ones cover is left out


@wp.struct
class CoverageCounts:
    """Numbers of camera rays by name; a slot with the count 0 is free, and the used ones come first."""

    name: wp.array2d[wp.int32]  # [pixels, slots]
    count: wp.array2d[wp.int32]


@wp.struct
class NameTables:
    """Indices of the names of meshes and materials."""

    of_mesh: wp.array[wp.int32]
    of_material: wp.array[wp.int32]


@wp.func
def _count(counts: CoverageCounts, pixel: int, name: int) -> None:
    for slot in range(_SLOTS):
        if counts.count[pixel, slot] == 0 or counts.name[pixel, slot] == name:
            counts.name[pixel, slot] = name
            counts.count[pixel, slot] = counts.count[pixel, slot] + 1
            return


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _count_names(
    first: int,
    scene: SceneData,
    camera: CameraData,
    iteration: int,
    seed: wp.uint32,
    names: NameTables,
    objects: CoverageCounts,
    materials: CoverageCounts,
) -> None:
    """Traces the camera ray of an iteration through a pixel, and counts what it hits."""
    pixel = first + wp.tid()
    u_pixel = jitter(scene, camera, pixel, iteration, seed)
    ray = camera_ray(camera, pixel, u_pixel, lens_point(scene, camera, pixel, iteration, seed))
    hit = first_hit(scene, camera, ray)
    if hit.triangle >= 0:
        _count(objects, pixel, names.of_mesh[scene.triangle_mesh[hit.triangle]])
        _count(materials, pixel, names.of_material[scene.triangle_material[hit.triangle]])


def measure_coverage(
    shutter: Sequence[tuple[DeviceScene, CameraData]], numbers: Sequence[int], seed: int, launcher: Launcher
) -> tuple[Cryptomatte, Cryptomatte]:
    """Traces `SAMPLES` camera rays per pixel; returns the coverage by the names of meshes and of materials.

    Args:
        shutter: The scene and its camera at each shutter sample.
        numbers: The shutter sample of each camera ray.
        seed: That of the settings.
        launcher: Launcher of the device.
    """
    scenes = [scene.source for scene, _ in shutter]
    mesh_names = [[mesh.name for mesh in scene.meshes] for scene in scenes]
    material_names = [[material.name or "default" for material in scene.materials] or ["default"] for scene in scenes]
    objects, materials = (_numbered(names) for names in (mesh_names, material_names))
    tables = []
    for meshes, used in zip(mesh_names, material_names, strict=True):
        table = NameTables()
        table.of_mesh = launcher.array([objects[name] for name in meshes], wp.int32)
        table.of_material = launcher.array([materials[name] for name in used], wp.int32)
        tables.append(table)
    _, camera = shutter[0]
    pixels = camera.columns * camera.rows
    counts = [_new_counts(pixels, launcher) for _ in range(2)]
    for iteration, number in enumerate(numbers):
        scene, camera = shutter[number]
        inputs = [scene.data, camera, iteration, wp.uint32(seed), tables[number], *counts]
        launcher.launch(_count_names, pixels, inputs)
    shape = camera.rows, camera.columns, RANKS
    by_object = Cryptomatte("object", tuple(objects), *_ranked(counts[0], shape))
    return by_object, Cryptomatte("material", tuple(materials), *_ranked(counts[1], shape))


def _numbered(names: Iterable[Iterable[str]]) -> dict[str, int]:
    """Each name once, with its number."""
    return {name: number for number, name in enumerate(dict.fromkeys(chain.from_iterable(names)))}


def _new_counts(pixels: int, launcher: Launcher) -> CoverageCounts:
    counts = CoverageCounts()
    counts.name = launcher.zeros((pixels, int(_SLOTS)), wp.int32)
    counts.count = launcher.zeros((pixels, int(_SLOTS)), wp.int32)
    return counts


def _ranked(
    counts: CoverageCounts, shape: tuple[int, int, int]
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """Names and their coverage in falling order, [rows, columns, RANKS]; the name -1 has the coverage 0."""
    name, count = counts.name.numpy(), counts.count.numpy()
    order = np.argsort(-count, axis=1, kind="stable")[:, :RANKS]
    name, count = (np.take_along_axis(values, order, axis=1) for values in (name, count))
    coverage = (count / np.float32(SAMPLES)).astype(np.float32)
    return np.where(count > 0, name, -1).astype(np.int32).reshape(shape), coverage.reshape(shape)
