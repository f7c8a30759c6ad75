"""The emitter tables: all lights and emissive triangles, with the probability of selecting each."""

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.device_scene.frame import DeviceFrame
from warp_ir.device_scene.light_tables import UploadedLights
from warp_ir.device_scene.material_tables import LARGEST_UV
from warp_ir.device_scene.scene_data import TRIANGLE_EMITTER, SceneData
from warp_ir.light_modifiers import shaped_power
from warp_ir.scene import Floats, Ints, Mesh, Scene
from warp_ir.texture import mean_on_triangles


def upload_emitters(
    scene: Scene,
    first_triangles: Sequence[int],
    lights: UploadedLights,
    frame: DeviceFrame,
    data: SceneData,
    launcher: Launcher,
) -> float:
    """Fills the emitter tables of a `SceneData`; an emitter's selection probability is proportional to its power.

    Any positive probabilities are unbiased, so power is only estimated, from mean radiance times area. Emitters of
    power 0 are left out.

    Args:
        scene: The scene in storage order.
        first_triangles: Row of each mesh's first triangle.
        lights: The scene's lights, uploaded.
        frame: The device's frame.
        data: The `SceneData`; its geometry tables must have been filled.
        launcher: Launcher of the device.

    Returns:
        The power of all emitters.
    """
    kinds: list[npt.NDArray[np.int32]] = []
    items: list[npt.NDArray[np.int32]] = []
    powers: list[npt.NDArray[np.float64]] = []
    areas: list[npt.NDArray[np.float64]] = []
    if scene.lights:
        kinds.append(np.array([light.kind for light in scene.lights], np.int32))
        items.append(np.arange(len(scene.lights), dtype=np.int32))
        powers.append(lights.power)
        areas.append(lights.area)

    emission = np.array([m.emission for m in scene.materials], np.float64).reshape(-1, 3).mean(axis=1)
    for mesh, first in zip(scene.meshes, first_triangles, strict=True):
        emissive = np.nonzero(emission[mesh.material] > 0.0)[0] if emission.any() else np.zeros(0, np.int64)
        if len(emissive):
            a, b, c = (mesh.points[mesh.triangles[emissive, k]] * frame.scale for k in range(3))
            cross = np.cross(b - a, c - a)
            length = np.linalg.norm(cross, axis=1)
            area = 0.5 * length
            sides = 2.0 if mesh.double_sided else 1.0
            power = math.pi * sides * area * _mean_emission(scene, mesh, emissive, area, data.footprint)
            if mesh.light is not None:
                normals = cross / np.maximum(length, 1.0e-30)[:, None]
                power *= shaped_power(mesh.light, normals, double_sided=mesh.double_sided)
            kinds.append(np.full(len(emissive), TRIANGLE_EMITTER, np.int32))
            items.append((first + emissive).astype(np.int32))
            areas.append(sides * area)
            powers.append(power)

    kind, item = (np.concatenate(x) if x else np.zeros(0, np.int32) for x in (kinds, items))
    power, area = (np.concatenate(x) if x else np.zeros(0) for x in (powers, areas))
    emits = power > 0.0
    kind, item, power, area = kind[emits], item[emits], power[emits], area[emits]
    data.emitter_count = len(power)
    cdf = np.concatenate([[0.0], np.cumsum(power / power.sum())]) if len(power) else np.array([0.0, 1.0])
    cdf[-1] = 1.0
    data.emitter_cdf = launcher.array(cdf, wp.float32)
    data.emitter_pdf_area = launcher.array(np.diff(cdf) / area if len(power) else [0.0], wp.float32)
    data.emitter_kind = launcher.array(kind if len(kind) else [0], wp.int32)
    data.emitter_item = launcher.array(item if len(item) else [0], wp.int32)

    emitter = np.arange(len(power), dtype=np.int32)
    light_emitter = np.full(max(len(scene.lights), 1), -1, np.int32)
    analytic = kind != TRIANGLE_EMITTER
    light_emitter[item[analytic]] = emitter[analytic]
    data.light_emitter = launcher.array(light_emitter, wp.int32)
    # Rays that hit an emissive material read this table, even if shaping leaves all of its triangles without power.
    triangle_emitter = np.full(data.triangle_count if emission.any() else 1, -1, np.int32)
    triangle_emitter[item[~analytic]] = emitter[~analytic]
    data.triangle_emitter = launcher.array(triangle_emitter, wp.int32)
    return float(power.sum())


def _mean_emission(scene: Scene, mesh: Mesh, triangles: Ints, areas: Floats, footprint: float) -> Floats:
    """Mean radiance over channels and area of triangles [n]: estimated where textured, but never 0 unless it is 0."""
    out = np.zeros(len(triangles))
    for k in np.unique(mesh.material[triangles]):
        material, chosen = scene.materials[k], mesh.material[triangles] == k
        texture = material.emission_texture
        if texture is None:
            out[chosen] = np.mean(material.emission)
        else:
            uvs = mesh.uvs.get(texture.uv, np.zeros((len(mesh.triangles), 3, 2)))[triangles[chosen]]
            uvs = uvs.clip(-LARGEST_UV, LARGEST_UV)
            out[chosen] = mean_on_triangles(texture, uvs, areas[chosen], footprint)
    return out
