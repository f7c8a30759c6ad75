"""One list of everything that emits, lights and surfaces, and how often each is chosen."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.device_scene.frame import DeviceFrame
from warp_ir.device_scene.material_tables import LARGEST_UV
from warp_ir.device_scene.scene_data import TRIANGLE_EMITTER
from warp_ir.light_modifiers import shaped_power
from warp_ir.scene import Light, LightKind, Mesh, Scene
from warp_ir.texture import mean_on_triangles


def upload_emitters(
    scene: Scene,
    rows: Sequence[int],
    gain: npt.NDArray[np.float64],
    frame: DeviceFrame,
    data: Any,
    launcher: Launcher,
) -> None:
    """One list of everything that emits, with the probabilities of choosing each: in proportion to its power.

    Any positive probabilities are right; a power is estimated from mean radiance times area, no more. `rows` are those
    of each mesh's first triangle, `gain` is what textures and shaping make of each light's power.
    """
    kinds: list[npt.NDArray[np.int32]] = []
    items: list[npt.NDArray[np.int32]] = []
    powers: list[npt.NDArray[np.float64]] = []
    areas: list[npt.NDArray[np.float64]] = []
    radiance = data.light_radiance.numpy()
    axes = data.light_axes.numpy()
    for k, light in enumerate(scene.lights):
        extent = _power_per_radiance(light, axes[k], data.radius)
        power = float(np.mean(radiance[k], dtype=np.float64)) * extent * gain[k]
        kinds.append(np.array([light.kind], np.int32))
        items.append(np.array([k], np.int32))
        powers.append(np.array([power]))
        areas.append(np.array([extent / math.pi if light.kind <= LightKind.CYLINDER else np.inf]))

    emission = np.array([m.emission for m in scene.materials], np.float64).reshape(-1, 3).mean(axis=1)
    for mesh, first in zip(scene.meshes, rows, strict=True):
        glowing = np.nonzero(emission[mesh.material] > 0.0)[0] if emission.any() else np.zeros(0, np.int64)
        if len(glowing):
            a, b, c = (mesh.points[mesh.triangles[glowing, k]] * frame.scale for k in range(3))
            cross = np.cross(b - a, c - a)
            length = np.linalg.norm(cross, axis=1)
            area = 0.5 * length
            sides = 2.0 if mesh.double_sided else 1.0
            power = math.pi * sides * area * _mean_emission(scene, mesh, glowing, area, data.footprint)
            if mesh.light is not None:
                normals = cross / np.maximum(length, 1.0e-30)[:, None]
                power *= shaped_power(mesh.light, normals, double_sided=mesh.double_sided)
            kinds.append(np.full(len(glowing), TRIANGLE_EMITTER, np.int32))
            items.append((first + glowing).astype(np.int32))
            areas.append(sides * area)
            powers.append(power)

    tables = (np.concatenate(x) if x else np.zeros(0) for x in (kinds, items, powers, areas))
    kind, item, power, spread = tables
    on = power > 0.0
    kind, item, power, spread = kind[on], item[on], power[on], spread[on]
    data.emitter_count = len(power)
    cdf = np.concatenate([[0.0], np.cumsum(power / power.sum())]) if len(power) else np.array([0.0, 1.0])
    cdf[-1] = 1.0
    data.emitter_cdf = launcher.array(cdf, wp.float32)
    data.emitter_pdf_area = launcher.array(np.diff(cdf) / spread if len(power) else [0.0], wp.float32)
    data.emitter_kind = launcher.array(kind.astype(np.int32) if len(kind) else [0], wp.int32)
    data.emitter_item = launcher.array(item.astype(np.int32) if len(item) else [0], wp.int32)

    emitter = np.arange(len(power), dtype=np.int32)
    light_emitter = np.full(max(len(scene.lights), 1), -1, np.int32)
    analytic = kind != TRIANGLE_EMITTER
    light_emitter[item[analytic].astype(np.int64)] = emitter[analytic]
    data.light_emitter = launcher.array(light_emitter, wp.int32)
    # Whoever hits a material that emits looks here, even where shaping leaves no surface of it any power.
    triangle_emitter = np.full(data.triangle_count if emission.any() else 1, -1, np.int32)
    triangle_emitter[item[~analytic].astype(np.int64)] = emitter[~analytic]
    data.triangle_emitter = launcher.array(triangle_emitter, wp.int32)


def _mean_emission(scene: Scene, mesh: Mesh, triangles: Any, areas: Any, footprint: float) -> Any:
    """Emitted radiance of triangles, mean of the channels: roughly where it is textured, but nowhere 0 in error."""
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


def _power_per_radiance(light: Light, axes: Any, radius: float) -> float:
    """Flux into the scene [device units] per mean radiance: exact for flat lights, good enough for the others."""
    x, y, z = (float(np.linalg.norm(axes[:, k])) for k in range(3))
    disk = math.pi * radius**2
    if light.kind == LightKind.RECT:
        return math.pi * float(np.linalg.norm(np.cross(axes[:, 0], axes[:, 1])))
    if light.kind == LightKind.DISK:
        return math.pi * math.pi * float(np.linalg.norm(np.cross(axes[:, 0], axes[:, 1])))
    if light.kind == LightKind.SPHERE:
        return math.pi * 4.0 * math.pi * (x * y + y * z + z * x) / 3.0
    if light.kind == LightKind.CYLINDER:
        return math.pi * x * math.pi * (y + z)
    if light.kind == LightKind.POINT:
        return 4.0 * math.pi
    if light.kind == LightKind.DOME:
        return 4.0 * math.pi * disk
    cone = 2.0 * math.pi * (1.0 - math.cos(math.radians(0.5 * light.angle)))
    return disk * (cone if light.angle > 0.0 else 1.0)
