"""Probe paths: camera paths that sample emitters, and light paths; all are connected to points that the camera sees."""

import math
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import MAX_REGISTERS, Launcher, copy_record
from warp_ir.device.scratch import Scratch
from warp_ir.device_scene import CameraData, DeviceScene, SceneData
from warp_ir.gbuffer import GBuffer, camera_vertex, new_gbuffer, trace_primary
from warp_ir.lights import light_visibility, sample_direct, select_emitter
from warp_ir.sampling import sobol
from warp_ir.sampling.square_to import square_to_cosine_hemisphere
from warp_ir.scene import LightKind
from warp_ir.settings import ResolvedSettings
from warp_ir.surface import albedo, closest, geometry_term_of_hit, shading_point, shadow_ray_origin, visible
from warp_ir.vpl.emission import trace_light_vertices
from warp_ir.vpl.guide import CELLS, Guide, cell_of

Floats = npt.NDArray[np.float64]

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_MAX_VERTICES = 4
"""Largest number of vertices of a camera path."""
_VERTEX_COUNT = wp.constant(_MAX_VERTICES)
_EMITTER_SAMPLES = 4
"""Number of emitters that are sampled at a vertex."""
_EMITTER_SAMPLE_COUNT = wp.constant(_EMITTER_SAMPLES)
_ROWS = wp.constant(_MAX_VERTICES * _EMITTER_SAMPLES)
_FIRST_DIMENSION = wp.constant(4)  # the dimensions before it are the camera's
_DIMENSIONS = wp.constant(6)  # sample dimensions per vertex
_CONNECTIONS = 4
"""Number of points that the camera sees, to which each vertex is connected."""
_CONNECTION_COUNT = wp.constant(_CONNECTIONS)
_CELLS = wp.constant(CELLS)
_MAX_LIGHT_VERTICES = 12
"""Largest number of vertices of a light path that is learned from."""
_CAMERA_PATHS, _LIGHT_PATHS = 1 << 32, (1 << 32) + 1
"""Iteration numbers for the scrambles, larger than those of any render."""
_TILES = 8
"""Tiles along each edge of the image: contributions are relative to the brightness of their tile."""
_OUTLIER_LIMIT = 16.0
"""Largest contribution of a sample, as a multiple of the mean, so that no single sample decides."""


@wp.struct
class ProbeRows:
    """What camera paths measure: one row per emitter sample, in the order of paths, vertices and samples."""

    emitter: wp.array[wp.int32]  # the sampled emitter; -1: there is no vertex
    score: wp.array[wp.float32]  # its contribution to the pixel's radiance, mean of the channels
    position: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]
    target: wp.array[wp.vec4]  # the point on the emitter, homogeneous
    weight: wp.array[wp.float32]  # the pixel's radiance per irradiance over π here, mean of the channels


@wp.kernel(module="warp_ir.vpl.emission", cuda_max_registers=MAX_REGISTERS)  # reuses functions compiled there
def _trace_camera_probes(
    first: int, scene: SceneData, gbuffer: GBuffer, scramble: wp.uint32, emitter_samples: int, rows: ProbeRows
) -> None:
    """Traces camera path `i` from what the camera sees, and samples emitters at its vertices."""
    i = first + wp.tid()
    for row in range(i * _ROWS, (i + 1) * _ROWS):
        rows.emitter[row] = -1
        rows.score[row] = 0.0
        rows.weight[row] = 0.0
    x = camera_vertex(gbuffer, i)
    throughput = gbuffer.albedo[i]
    k = int(0)
    while k < _VERTEX_COUNT and x.mesh >= 0 and wp.max(throughput) > 0.0:
        dimension = _FIRST_DIMENSION + _DIMENSIONS * k
        for j in range(emitter_samples):
            row = (i * _VERTEX_COUNT + k) * _EMITTER_SAMPLE_COUNT + j
            sample = i * _EMITTER_SAMPLE_COUNT + j
            u_emitter = sobol.sample_1d(scene.sobol, sample, dimension, scramble)
            u = sobol.sample_2d(scene.sobol, sample, dimension + 1, scramble)
            light = sample_direct(scene, x.position, u_emitter, u)
            rows.emitter[row] = select_emitter(scene, u_emitter).emitter
            rows.position[row] = x.position
            rows.normal[row] = x.shading_normal
            rows.target[row] = light.target
            rows.weight[row] = (throughput[0] + throughput[1] + throughput[2]) * (1.0 / 3.0)
            cosine = wp.dot(x.shading_normal, light.direction)
            if cosine > 0.0 and wp.dot(x.normal, light.direction) > 0.0 and wp.max(light.radiance) > 0.0:
                visibility = light_visibility(scene, light.modifier_row, x, light.target)
                contribution = wp.cw_mul(throughput, wp.cw_mul(light.radiance, visibility)) * (cosine / wp.pi)
                rows.score[row] = (contribution[0] + contribution[1] + contribution[2]) * (1.0 / 3.0)

        direction = square_to_cosine_hemisphere(
            sobol.sample_2d(scene.sobol, i, dimension + 3, scramble), x.shading_normal
        )
        origin = shadow_ray_origin(x, wp.vec4(direction[0], direction[1], direction[2], 0.0))
        hit = closest(scene, origin, direction, 3.0e38)
        if hit.triangle < 0 or wp.dot(direction, x.normal) <= 0.0:
            break
        rho = albedo(scene, hit, scene.footprint)
        if sobol.sample_1d(scene.sobol, i, dimension + 5, scramble) >= wp.max(rho):
            break
        throughput = wp.cw_mul(throughput, rho) / wp.max(rho) * geometry_term_of_hit(x, direction, hit)[1]
        x = shading_point(scene, hit)
        k += 1


@dataclass(frozen=True)
class CameraProbes:
    """The emitter samples at the vertices of camera paths."""

    training: npt.NDArray[np.bool_]
    """[n], whether the path has an even number: this half is learned from, the other half measures the gain."""
    bounce: npt.NDArray[np.int64]
    """[n], reflections between the emitter's light at the vertex and the camera, less one."""
    emitter: npt.NDArray[np.int64]
    """[n], index of the sampled emitter."""
    score: npt.NDArray[np.float64]
    """[n], contribution to the picture, relative to the brightness of that tile of the image."""
    position: npt.NDArray[np.float64]
    """[n, 3], the vertex, in the device frame."""
    target: npt.NDArray[np.float64]
    """[n, 4], the point on the emitter, homogeneous."""
    rows: ProbeRows
    """The rows on the device; their weights are relative to the brightness as well."""


def trace_camera_probes(
    scene: DeviceScene, camera: CameraData, launcher: Launcher, paths: int, settings: ResolvedSettings
) -> CameraProbes:
    """Traces about `paths` camera paths, spread over the whole image."""
    whole = copy_record(camera)
    # An image of as many pixels as there are paths, which shows surfaces only.
    whole.rows = min(max(round(math.sqrt(paths * camera.image_rows / camera.image_columns)), 1), paths)
    whole.columns = paths // whole.rows
    whole.image_columns, whole.image_rows, whole.first_column, whole.first_row = whole.columns, whole.rows, 0, 0
    whole.visible_lights = 0
    paths = whole.columns * whole.rows
    scramble = sobol.iteration_scramble(settings.seed, _CAMERA_PATHS)
    gbuffer, _ = new_gbuffer(
        launcher,
        whole.columns,
        whole.rows,
        has_normals=scene.source.has_normals,
        has_normal_maps=scene.data.normal_map_count > 0,
        has_emission=False,
    )
    trace_primary(scene, whole, launcher, gbuffer, iteration=0, seed=scramble, counted_as="probe_paths")
    n = paths * _MAX_VERTICES * _EMITTER_SAMPLES
    rows = ProbeRows()
    for name, dtype in (("emitter", wp.int32), ("score", wp.float32), ("position", wp.vec3), ("normal", wp.vec3)):
        setattr(rows, name, launcher.empty(n, dtype))
    rows.target, rows.weight = launcher.empty(n, wp.vec4), launcher.empty(n, wp.float32)
    # Where there is one light in the scene nothing is learned from its samples but how bright the picture is.
    is_far = any(light.kind in (LightKind.DISTANT, LightKind.DOME) for light in scene.stored.lights)
    samples = _EMITTER_SAMPLES if is_far or scene.emitter_source.max(initial=0) > 0 else 1
    launcher.launch(_trace_camera_probes, paths, [scene.data, gbuffer, wp.uint32(scramble), samples, rows])

    emitter, score = rows.emitter.numpy(), _finite(rows.score.numpy())
    bounce = np.arange(n) // _EMITTER_SAMPLES % _MAX_VERTICES
    valid = (emitter >= 0) & (bounce <= settings.max_bounces)
    score[~valid] = 0.0
    row, column = np.divmod(np.arange(paths), whole.columns)
    tile = row * _TILES // whole.rows * _TILES + column * _TILES // whole.columns
    sums = np.bincount(tile, score.reshape(paths, -1).sum(axis=1) / _EMITTER_SAMPLES, _TILES**2)
    brightness = sums / np.maximum(np.bincount(tile, minlength=_TILES**2), 1)
    scale = np.repeat(np.sqrt(brightness**2 + 0.01 * brightness.mean() ** 2)[tile], _MAX_VERTICES * _EMITTER_SAMPLES)
    if scale.any():
        score /= scale
        rows.weight = launcher.array(rows.weight.numpy() / scale, wp.float32)
    return CameraProbes(
        training=(np.arange(n) // (_MAX_VERTICES * _EMITTER_SAMPLES) % 2 == 0)[valid],
        bounce=bounce[valid],
        emitter=emitter[valid].astype(np.int64),
        score=clamp_outliers(score[valid]),
        position=rows.position.numpy()[valid].astype(np.float64),
        target=rows.target.numpy()[valid].astype(np.float64),
        rows=rows,
    )


def clamp_outliers(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The values, none of them larger than `_OUTLIER_LIMIT` times their mean."""
    return np.minimum(values, _OUTLIER_LIMIT * values.mean()) if len(values) else values


def _finite(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    return np.where(np.isfinite(values), values, np.float32(0.0)).astype(np.float64)


@wp.kernel(module="warp_ir.vpl.emission", cuda_max_registers=MAX_REGISTERS)  # reuses functions compiled there
def _connect_vertices(
    first: int,
    scene: SceneData,
    position: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    probes: ProbeRows,
    extent: float,
    cells: wp.array[wp.int32],
    contribution: wp.array[wp.float32],
) -> None:
    """Connects vertex `i` with some of the points that the camera sees, by shadow rays."""
    i = first + wp.tid()
    cells[i] = cell_of(position[i], normal[i], extent)
    # G is bounded at the width of a cell: what is learned of a VPL must hold for others in its cell.
    edge = 0.5 * extent / float(_CELLS)
    paths = wp.uint32(probes.emitter.shape[0] // _ROWS)
    total = float(0.0)
    for k in range(_CONNECTION_COUNT):
        point = int(sobol.hash_combine(wp.uint32(i * _CONNECTION_COUNT + k), wp.uint32(0)) % paths) * _ROWS
        if probes.weight[point] > 0.0:
            to_vertex = position[i] - probes.position[point]
            squared = wp.dot(to_vertex, to_vertex) + 1.0e-30
            direction = to_vertex / wp.sqrt(squared)
            cosines = wp.max(wp.dot(probes.normal[point], direction), 0.0)
            cosines *= wp.max(-wp.dot(normal[i], direction), 0.0)
            target = wp.vec4(position[i][0], position[i][1], position[i][2], 1.0)
            if cosines > 0.0 and visible(scene, probes.position[point], target):
                total += probes.weight[point] * cosines / wp.max(squared, edge * edge)
    contribution[i] = total / float(_CONNECTION_COUNT)


@dataclass(frozen=True)
class Vertices:
    """Vertices of probe paths on surfaces."""

    cell: npt.NDArray[np.int64]
    """[n], the cell of each vertex (`vpl.guide.cell_of`)."""
    contribution: Floats
    """[n], contribution to the picture per intensity of a VPL there."""
    next: npt.NDArray[np.int64]
    """[n], index of the path's next vertex; -1: it ends."""
    ratio: Floats
    """[n], intensity of a VPL at the next vertex per intensity of one here."""
    continues: npt.NDArray[np.bool_]
    """[n], whether it is known how the path goes on."""
    intensity: Floats
    """[n], intensity of light paths' VPLs, sum of the channels; 0 on camera paths."""
    path: npt.NDArray[np.int64]
    """[n], the light path; -1 on camera paths."""
    is_first: npt.NDArray[np.bool_]
    """[n], whether it is the first vertex of a light path."""

    def __add__(self, other: "Vertices") -> "Vertices":
        """The vertices of both records; light paths with the same number are no longer told apart."""
        joined = {f.name: np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)}
        joined["next"][len(self.next) :] += np.where(other.next >= 0, len(self.next), 0)
        return Vertices(**joined)


def cells_extent(scene: DeviceScene) -> float:
    """Edge length of the cube that the cells of a view divide, in the device frame."""
    return 2.0 * float(scene.data.focus_radius)


def _connect(
    scene: DeviceScene, launcher: Launcher, probes: CameraProbes, position: Floats, normal: Floats
) -> tuple[npt.NDArray[np.int64], Floats]:
    """The cells of vertices, and their contributions per intensity."""
    n = len(position)
    cells, contribution = launcher.empty(max(n, 1), wp.int32), launcher.empty(max(n, 1), wp.float32)
    on_device = [launcher.array(x.reshape(-1, 3), wp.vec3) for x in (position, normal)]
    inputs = [scene.data, *on_device, probes.rows, cells_extent(scene), cells, contribution]
    launcher.launch(_connect_vertices, n, inputs)
    return cells.numpy()[:n].astype(np.int64), _finite(contribution.numpy()[:n])


def camera_vertices(scene: DeviceScene, launcher: Launcher, probes: CameraProbes) -> Vertices:
    """The vertices of camera paths: light that arrives there would go on as they do."""
    rows = probes.rows
    position, normal = rows.position.numpy()[::_EMITTER_SAMPLES], rows.normal.numpy()[::_EMITTER_SAMPLES]
    weight, emitter = rows.weight.numpy()[::_EMITTER_SAMPLES], rows.emitter.numpy()[::_EMITTER_SAMPLES]
    valid = (emitter >= 0).reshape(-1, _MAX_VERTICES)
    of_path = np.cumsum(valid.reshape(-1)).reshape(valid.shape) - 1
    following = np.where(valid[:, 1:], of_path[:, 1:], -1)
    following = np.pad(following, ((0, 0), (0, 1)), constant_values=-1)[valid]
    # The last vertex that a path can have says nothing about what follows it.
    continues = np.broadcast_to(np.arange(_MAX_VERTICES) < _MAX_VERTICES - 1, valid.shape)[valid]
    kept = valid.reshape(-1)
    weight = _finite(weight)[kept]
    ratio = np.divide(weight[following], weight, out=np.zeros_like(weight), where=(following >= 0) & (weight > 0.0))
    cell, contribution = _connect(scene, launcher, probes, position[kept], normal[kept])
    n = len(cell)
    nowhere = np.full(n, -1)
    return Vertices(cell, contribution, following, ratio, continues, np.zeros(n), nowhere, nowhere > 0)


def light_vertices(
    guide: Guide, launcher: Launcher, probes: CameraProbes, paths: int, settings: ResolvedSettings, number: int
) -> Vertices:
    """The vertices of light paths on surfaces, as they are with a guide; `number` tells samples of them apart."""
    longest = min(settings.max_bounces, _MAX_LIGHT_VERTICES)
    scramble = sobol.iteration_scramble(settings.seed, _LIGHT_PATHS + number)
    buffer, lengths = trace_light_vertices(
        guide, Scratch(launcher), paths=paths, max_vertices=longest, scramble=scramble
    )
    length = lengths.numpy()[:paths]
    number_in_path, path = np.nonzero(np.arange(longest)[:, None] < length)
    of_row = np.full((longest + 1, paths), -1)
    of_row[number_in_path, path] = np.arange(len(path))
    rows = paths * (1 + number_in_path) + path
    position, normal = (x.numpy()[rows, :3] for x in (buffer.position, buffer.normal))
    intensity = _finite(buffer.intensity.numpy()[rows]).sum(axis=1)
    following = of_row[number_in_path + 1, path]
    ratio = np.divide(
        intensity[following], intensity, out=np.zeros_like(intensity), where=(following >= 0) & (intensity > 0.0)
    )
    cell, contribution = _connect(guide.scene, launcher, probes, position, normal)
    return Vertices(
        cell, contribution, following, ratio, np.ones(len(path), bool), intensity, path, number_in_path == 0
    )
