"""The pilot's rays: paths from the camera that ask for light, and VPLs that are connected with what the camera sees."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import MAX_REGISTERS, Launcher, copy_record
from warp_ir.device_scene import DeviceScene, SceneData
from warp_ir.gbuffer import GBuffer, new_gbuffer, trace_primary
from warp_ir.lights import light_visibility, sample_direct, select_emitter
from warp_ir.sampling import sobol
from warp_ir.sampling.square_to import square_to_cosine_hemisphere
from warp_ir.settings import RenderSettings
from warp_ir.surface import albedo, closest, visible
from warp_ir.vpl.emission import VplBuffer, emit_vpls
from warp_ir.vpl.guide import CELLS, Guide, cell_of

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_VERTICES = 4
"""Of a camera path, at most: surfaces where it asks for light."""
_VERTEX_COUNT = wp.constant(_VERTICES)
_ASKED = 4
"""Emitters, at each of them."""
_ASKED_COUNT = wp.constant(_ASKED)
_ROWS = wp.constant(_VERTICES * _ASKED)
_FIRST_DIMENSION = wp.constant(4)  # those before are the camera's
_DIMENSIONS = wp.constant(6)  # of the sequence, per vertex
_CONNECTIONS = 4
"""Of each VPL with points that the camera sees."""
_CONNECTION_COUNT = wp.constant(_CONNECTIONS)
_CELLS = wp.constant(CELLS)
_VPLS_PER_PATH = 8
"""Connected at most, on the mean."""
_CAMERA_PATHS, _LIGHT_PATHS = 1 << 32, (1 << 32) + 1
"""Numbers of iterations that no render has, for the scrambles."""
_TILES = 8
"""Of the image along each edge: noise counts relative to the brightness of its tile."""
_MOST = 16.0
"""No sample counts for more than as many times the mean, so that none decides alone."""


@wp.struct
class _Rows:
    """What camera paths find: rows of a vertex, and those of a path, one after the other."""

    emitter: wp.array[wp.int32]  # that it was asked for; -1: no vertex
    score: wp.array[wp.float32]  # what that gives to the pixel, mean of the channels
    position: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]
    target: wp.array[wp.vec4]  # the emitter's point, homogeneous
    weight: wp.array[wp.float32]  # what irradiance here gives to the pixel


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _trace_camera_probes(first: int, scene: SceneData, gbuffer: GBuffer, scramble: wp.uint32, found: _Rows) -> None:
    """Follows camera path `i` from what the camera sees on."""
    i = first + wp.tid()
    for row in range(i * _ROWS, (i + 1) * _ROWS):
        found.emitter[row] = -1
        found.score[row] = 0.0
        found.weight[row] = 0.0
    position = gbuffer.position[i]
    normal = gbuffer.normal[i]
    shading_normal = gbuffer.shading_normal[i]
    throughput = gbuffer.albedo[i]
    mesh = gbuffer.mesh[i]
    k = int(0)
    while k < _VERTEX_COUNT and mesh >= 0 and wp.max(throughput) > 0.0:
        dimension = _FIRST_DIMENSION + _DIMENSIONS * k
        for j in range(_ASKED_COUNT):
            row = (i * _VERTEX_COUNT + k) * _ASKED_COUNT + j
            number = i * _ASKED_COUNT + j
            pick = sobol.sample_1d(scene.sobol, number, dimension, scramble)
            u = sobol.sample_2d(scene.sobol, number, dimension + 1, scramble)
            light = sample_direct(scene, position, pick, u)
            found.emitter[row] = select_emitter(scene, pick).emitter
            found.position[row] = position
            found.normal[row] = shading_normal
            found.target[row] = light.target
            found.weight[row] = (throughput[0] + throughput[1] + throughput[2]) * (1.0 / 3.0)
            cosine = wp.dot(shading_normal, light.direction)
            if cosine > 0.0 and wp.dot(normal, light.direction) > 0.0 and wp.max(light.radiance) > 0.0:
                arrives = light_visibility(scene, light.modifier_row, position, mesh, k == 0, light.target)
                gives = wp.cw_mul(throughput, wp.cw_mul(light.radiance, arrives)) * (cosine / wp.pi)
                found.score[row] = (gives[0] + gives[1] + gives[2]) * (1.0 / 3.0)

        direction = square_to_cosine_hemisphere(
            sobol.sample_2d(scene.sobol, i, dimension + 3, scramble), shading_normal
        )
        hit = closest(scene, position, direction, 3.0e38)
        if hit.triangle < 0 or wp.dot(direction, normal) <= 0.0:
            break
        rho = albedo(scene, hit, scene.footprint)
        if sobol.sample_1d(scene.sobol, i, dimension + 5, scramble) >= wp.max(rho):
            break
        throughput = wp.cw_mul(throughput, rho) / wp.max(rho)
        position = hit.position
        normal = hit.normal
        shading_normal = hit.normal
        mesh = scene.triangle_mesh[hit.triangle]
        k += 1


@dataclass(frozen=True)
class CameraProbes:
    """The vertices of the camera paths, without those that were not there."""

    even: npt.NDArray[np.bool_]
    """[n], whether the path has an even number: half of them, from all over the image."""
    bounce: npt.NDArray[np.int64]
    """[n], reflections of the light before it comes to the vertex."""
    emitter: npt.NDArray[np.int64]
    """[n], which was asked for light."""
    score: npt.NDArray[np.float64]
    """[n], what came, in units of the brightness of that part of the image."""
    position: npt.NDArray[np.float64]
    """[n, 3], of the vertex, in the device frame."""
    target: npt.NDArray[np.float64]
    """[n, 4], the emitter's point, homogeneous."""
    rows: Any
    """All of it on the device, and the weights in units of brightness."""


def trace_camera_probes(
    scene: DeviceScene, camera: Any, launcher: Launcher, paths: int, settings: RenderSettings
) -> CameraProbes:
    """Sends about so many paths from all over the image."""
    whole = copy_record(camera)
    # As many pixels as there are paths, and nothing but surfaces.
    whole.rows = min(max(round(math.sqrt(paths * camera.image_rows / camera.image_columns)), 1), paths)
    whole.columns = paths // whole.rows
    whole.image_columns, whole.image_rows, whole.first_column, whole.first_row = whole.columns, whole.rows, 0, 0
    whole.visible_lights = 0
    paths = whole.columns * whole.rows
    scramble = sobol.iteration_scramble(settings.seed, _CAMERA_PATHS)
    gbuffer, *_ = new_gbuffer(launcher, whole.columns, whole.rows, mapped=scene.data.normal_map_count > 0, glows=False)
    trace_primary(scene, whole, launcher, gbuffer, iteration=0, seed=scramble)
    n = paths * _VERTICES * _ASKED
    rows = _Rows()
    for name, dtype in (("emitter", wp.int32), ("score", wp.float32), ("position", wp.vec3), ("normal", wp.vec3)):
        setattr(rows, name, launcher.empty(n, dtype))
    rows.target, rows.weight = launcher.empty(n, wp.vec4), launcher.empty(n, wp.float32)
    launcher.launch(_trace_camera_probes, paths, [scene.data, gbuffer, wp.uint32(scramble), rows])

    emitter, score = rows.emitter.numpy(), _finite(rows.score.numpy())
    bounce = np.arange(n) // _ASKED % _VERTICES
    there = (emitter >= 0) & (bounce <= settings.bounce_limit)
    score[~there] = 0.0
    row, column = np.divmod(np.arange(paths), whole.columns)
    tile = row * _TILES // whole.rows * _TILES + column * _TILES // whole.columns
    sums = np.bincount(tile, score.reshape(paths, -1).sum(axis=1) / _ASKED, _TILES**2)
    brightness = sums / np.maximum(np.bincount(tile, minlength=_TILES**2), 1)
    scale = np.repeat(np.sqrt(brightness**2 + 0.01 * brightness.mean() ** 2)[tile], _VERTICES * _ASKED)
    if scale.any():
        score /= scale
        rows.weight = launcher.array(rows.weight.numpy() / scale, wp.float32)
    return CameraProbes(
        even=(np.arange(n) // (_VERTICES * _ASKED) % 2 == 0)[there],
        bounce=bounce[there],
        emitter=emitter[there].astype(np.int64),
        score=clamp_outliers(score[there]),
        position=rows.position.numpy()[there].astype(np.float64),
        target=rows.target.numpy()[there].astype(np.float64),
        rows=rows,
    )


def clamp_outliers(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Values of which none decides alone."""
    return np.minimum(values, _MOST * values.mean()) if len(values) else values


def _finite(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    return np.where(np.isfinite(values), values, np.float32(0.0)).astype(np.float64)


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _connect_vpls(
    first: int,
    scene: SceneData,
    seen: _Rows,
    vpls: VplBuffer,
    chosen: wp.array[wp.int32],
    extent: float,
    cells: wp.array[wp.int32],
    gives: wp.array[wp.float32],
) -> None:
    """Connects a VPL on a surface with some of the points that the camera sees."""
    i = first + wp.tid()
    vpl = chosen[i]
    target = vpls.position[vpl]
    position = wp.vec3(target[0], target[1], target[2])
    normal = wp.vec3(vpls.normal[vpl][0], vpls.normal[vpl][1], vpls.normal[vpl][2])
    cells[i] = cell_of(position, normal, extent)
    # Closer by than the cells are wide, nothing can be learned of this VPL that would hold for another.
    edge = extent / float(_CELLS)
    paths = wp.uint32(seen.emitter.shape[0] // _ROWS)
    for k in range(_CONNECTION_COUNT):
        row = i * _CONNECTION_COUNT + k
        gives[row] = 0.0
        point = int(sobol.hash_combine(wp.uint32(row), wp.uint32(0)) % paths) * _ROWS
        if seen.weight[point] > 0.0:
            way = position - seen.position[point]
            squared = wp.dot(way, way) + 1.0e-30
            direction = way / wp.sqrt(squared)
            cosines = wp.max(wp.dot(seen.normal[point], direction), 0.0) * wp.max(-wp.dot(normal, direction), 0.0)
            if cosines > 0.0 and visible(scene, seen.position[point], target):
                gives[row] = seen.weight[point] * cosines / wp.max(squared, edge * edge)


@dataclass(frozen=True)
class VplConnections:
    """VPLs on surfaces, and what they give to the picture."""

    cell: npt.NDArray[np.int64]
    """[n], that they are in."""
    intensity: npt.NDArray[np.float64]
    """[n], sum of the channels."""
    gives: npt.NDArray[np.float64]
    """[n], per intensity."""
    per_path: float
    """VPLs on surfaces that a light path leaves."""
    extent: float
    """Edge of the cube that the cells divide, in the device frame."""


def connect_vpls(
    guide: Guide, launcher: Launcher, seen: CameraProbes, paths: int, settings: RenderSettings
) -> VplConnections:
    """Traces light paths and connects their VPLs with what the camera sees, if the light gets there."""
    scene = guide.scene
    vpls = emit_vpls(
        guide,
        launcher,
        paths=paths,
        absorption="roulette",
        max_bounces=settings.bounce_limit,
        scramble=sobol.iteration_scramble(settings.seed, _LIGHT_PATHS),
    )
    on_surfaces = int(vpls.count.numpy()[0]) - vpls.on_lights
    n = min(on_surfaces, _VPLS_PER_PATH * paths)
    extent = 2.0 * float(scene.data.radius)
    cells, gives = launcher.empty(max(n, 1), wp.int32), launcher.empty(max(n, 1) * _CONNECTIONS, wp.float32)
    chosen = vpls.on_lights + np.arange(n) * on_surfaces // max(n, 1)
    rows = launcher.array(chosen, wp.int32)
    launcher.launch(_connect_vpls, n, [scene.data, seen.rows, vpls, rows, extent, cells, gives])
    return VplConnections(
        cell=cells.numpy()[:n].astype(np.int64),
        intensity=_finite(vpls.intensity.numpy()[chosen]).sum(axis=1),
        gives=_finite(gives.numpy()[: n * _CONNECTIONS]).reshape(n, _CONNECTIONS).mean(axis=1),
        per_path=on_surfaces / (paths * guide.paths),
        extent=extent,
    )
