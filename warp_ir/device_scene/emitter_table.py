"""The emitter tables: all lights and emissive triangles, with the probability of selecting each.

Power says little about what lights the picture: a lamp in the room that the camera sees may have 10⁻¹² of the power of
one in a sealed room. So every source, a light or the part of a mesh that one material covers, keeps a floor.
"""

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

FLOOR_SHARE = 1.0 / 8.0
"""Largest share of the samples that sources of little power get; each source gets as much of it as any other."""
_STEPS = 2**24
"""Number of sample numbers in [0, 1), `sampling.sobol.to_unit`: probabilities are multiples of its inverse."""


def floored_probabilities(power: Floats, source: Ints, floor_share: float) -> npt.NDArray[np.float64]:
    """Selection probabilities of emitters in proportion to power, but for each source at least a floor.

    Args:
        power: Power of each emitter, or any multiple of it, positive.
        source: The source, from 0, that each emitter is a part of.
        floor_share: Share of all samples that the floors of all sources have together.
    """
    of_source = np.bincount(source, power)
    share = of_source / of_source.sum()
    floor = floor_share / len(share)
    if share.min() >= floor:
        return np.asarray(power / power.sum(), np.float64)
    lifted = np.maximum(share, floor)
    return np.asarray(power / of_source[source] * (lifted / lifted.sum())[source], np.float64)


def is_uneven(power: Floats, source: Ints) -> bool:
    """Whether a source has so little power that it needs its floor."""
    of_source = np.bincount(source, power)
    return bool(of_source.min() * len(of_source) < FLOOR_SHARE * of_source.sum())


def emitter_lifts(cdf: Floats, power: Floats) -> npt.NDArray[np.float64]:
    """Factors of the weights with which VPLs are drawn for shadow rays, float64 [emitters].

    VPLs of an emitter of power Φ and selection probability p have an intensity in proportion to Φ/p; their weights
    follow Φ/p plus a share of the mean over all emitters. So an emitter that light paths start from gets shadow rays
    as well, whatever the power of one that no surface in view receives light from.
    """
    return np.asarray(np.minimum(1.0 + FLOOR_SHARE * np.diff(cdf) * (power.sum() / power), 1.0e30), np.float64)


def selection_cdf(probability: Floats) -> npt.NDArray[np.float64]:
    """The CDF [n + 1] of probabilities [n], in multiples of 2⁻²⁴, which float32 and the samples represent exactly.

    Every probability is at least 2⁻²⁴, unless there are more than 2²³ emitters.
    """
    n = len(probability)
    least = np.arange(n + 1) if 2 * n <= _STEPS else np.zeros(n + 1)
    cumulative = np.concatenate([[0.0], np.cumsum(probability)])
    cdf = least + np.floor(cumulative / cumulative[-1] * (_STEPS - least[-1]))
    cdf[-1] = _STEPS
    return np.asarray(cdf / _STEPS, np.float64)


def upload_emitters(
    scene: Scene,
    first_triangles: Sequence[int],
    lights: UploadedLights,
    frame: DeviceFrame,
    data: SceneData,
    launcher: Launcher,
) -> tuple[Floats, Ints]:
    """Fills the emitter tables of a `SceneData`; selection probabilities are proportional to power, above a floor.

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
        Power and source of each emitter (`floored_probabilities`).
    """
    kinds: list[npt.NDArray[np.int32]] = []
    items: list[npt.NDArray[np.int32]] = []
    powers: list[npt.NDArray[np.float64]] = []
    areas: list[npt.NDArray[np.float64]] = []
    sources: list[npt.NDArray[np.int64]] = []
    if scene.lights:
        kinds.append(np.array([light.kind for light in scene.lights], np.int32))
        items.append(np.arange(len(scene.lights), dtype=np.int32))
        powers.append(lights.power)
        areas.append(lights.area)
        sources.append(np.arange(len(scene.lights)))

    emission = np.array([m.emission for m in scene.materials], np.float64).reshape(-1, 3).mean(axis=1)
    for k, (mesh, first) in enumerate(zip(scene.meshes, first_triangles, strict=True)):
        emissive = np.nonzero(emission[mesh.material] > 0.0)[0] if emission.any() else np.zeros(0, np.int64)
        if len(emissive):
            a, b, c = (mesh.points[mesh.triangles[emissive, j]] * frame.scale for j in range(3))
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
            sources.append(len(scene.lights) + k * len(scene.materials) + mesh.material[emissive].astype(np.int64))

    kind, item, source = (np.concatenate(x) if x else np.zeros(0, np.int32) for x in (kinds, items, sources))
    power, area = (np.concatenate(x) if x else np.zeros(0) for x in (powers, areas))
    emits = power > 0.0
    kind, item, power, area = kind[emits], item[emits], power[emits], area[emits]
    source = np.unique(source[emits], return_inverse=True)[1]
    data.emitter_count = len(power)
    cdf = np.array([0.0, 1.0])
    if len(power):
        cdf = selection_cdf(floored_probabilities(power, source, FLOOR_SHARE))
    data.emitter_cdf = launcher.array(cdf, wp.float32)
    data.uneven = int(len(power) > 0 and is_uneven(power, source))
    data.emitter_lift = launcher.array(emitter_lifts(cdf, power) if data.uneven else [1.0], wp.float32)
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
    return power, source


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
