"""The emitters of each world: the lights, what emits in all worlds, and what emits in this one."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.device_scene import FLOOR_SHARE, TRIANGLE_EMITTER, SceneData, floored_probabilities, selection_cdf
from warp_ir.scene import Floats, Ints, LightKind, Scene, triangle_areas
from warp_ir.simulation.bodies import Bodies


@dataclass(frozen=True)
class WorldEmitters:
    """The emitter tables of all worlds, of equal width; what they share has the same rows in all of them."""

    width: int
    """Rows for each world, at least 1."""
    count: npt.NDArray[np.int32]
    """[worlds], number of emitters."""
    cdf: Any  # mypy does not know that `wp.array2d` is a type
    """float32 [worlds, width + 1]."""
    kind: Any
    """int32 [worlds, width], as `SceneData.emitter_kind`."""
    item: Any
    """int32 [worlds, width], as `SceneData.emitter_item`."""
    static_pdf: "wp.array[wp.float32]"
    """[worlds width], area pdf of emitters whose area is constant."""
    pdf_area: Any
    """float32 [worlds, width], as it is now."""
    light_emitter: Any
    """int32 [worlds, lights]."""
    triangle_emitter: "wp.array[wp.int32]"
    """One table for all worlds."""
    has_triangles: bool

    def slice(self, world: int, data: SceneData) -> None:
        """Sets the tables of a world in its record; not the number of emitters."""
        data.emitter_cdf, data.emitter_kind, data.emitter_item = self.cdf[world], self.kind[world], self.item[world]
        data.emitter_pdf_area, data.light_emitter = self.pdf_area[world], self.light_emitter[world]
        data.triangle_emitter = self.triangle_emitter


def new_world_emitters(
    bodies: Bodies,
    group: Ints,
    first_triangles: list[int],
    light_power: Floats,
    light_area: Floats,
    radii: Floats,
    reference: float,
    frame_scale: float,
    triangle_count: int,
    launcher: Launcher,
) -> WorldEmitters:
    """The tables; an emitter is selected in proportion to its power, above a floor, as in `device_scene`.

    Args:
        bodies: Prototypes and instances.
        group: The world of each instance; the number of worlds: all.
        first_triangles: Row of the first triangle of each mesh.
        light_power: Power of each light, where the scene's radius is `reference`.
        light_area: Area of each light in the device frame; infinity: it has none.
        radii: Radius of the ball of details of each world, in the device frame.
        reference: See `light_power`.
        frame_scale: Device units per scene unit.
        triangle_count: Number of triangles.
        launcher: Launcher of the device.
    """
    scene, world_count = bodies.scene, len(radii)
    item, power, area, source = _triangles(bodies, first_triangles, frame_scale)
    instance = np.full(len(bodies.emits), -1)
    instance[bodies.prototype] = np.arange(bodies.count)
    of_group = group[instance[source]] if len(source) else np.zeros(0, np.int64)
    shared = np.flatnonzero(of_group == world_count)
    own = [np.flatnonzero(of_group == w) for w in range(world_count)] if len(of_group) else [shared] * world_count
    lights = np.flatnonzero(light_power > 0.0)
    infinite = np.array([light.kind >= LightKind.DISTANT for light in scene.lights], bool)[lights]
    width = max(len(lights) + len(shared) + max(len(x) for x in own), 1)
    kinds = np.zeros((world_count, width), np.int32)
    items, cdf = np.zeros((world_count, width), np.int32), np.ones((world_count, width + 1), np.float32)
    pdf, count = np.zeros((world_count, width), np.float32), np.zeros(world_count, np.int32)
    cdf[:, 0] = 0.0
    light_kinds = np.array([light.kind for light in scene.lights], np.int32)[lights]
    emitter_of = np.full(triangle_count if len(item) else 1, -1, np.int32)
    for w in range(world_count):
        rows = np.concatenate([shared, own[w]]).astype(np.int64) if len(of_group) else shared
        count[w] = n = len(lights) + len(rows)
        if not n:
            continue
        kinds[w, :n] = np.concatenate([light_kinds, np.full(len(rows), TRIANGLE_EMITTER)])
        items[w, :n] = np.concatenate([lights, item[rows]])
        reaching = np.where(infinite, (radii[w] / reference) ** 2, 1.0)
        powers = np.concatenate([light_power[lights] * reaching, power[rows]])
        sources = np.concatenate([np.arange(len(lights)), len(lights) + source[rows]])
        sources = np.unique(sources, return_inverse=True)[1]
        cdf[w, : n + 1] = selection_cdf(floored_probabilities(powers, sources, FLOOR_SHARE))
        areas = np.concatenate([light_area[lights], area[rows]])
        pdf[w, :n] = np.diff(cdf[w, : n + 1].astype(np.float64)) / areas
        emitter_of[item[rows]] = len(lights) + np.arange(len(rows))
    light_emitter = np.full((world_count, max(len(scene.lights), 1)), -1, np.int32)
    light_emitter[:, lights] = np.arange(len(lights))
    return WorldEmitters(
        width=width,
        count=count,
        cdf=launcher.array(cdf, wp.float32),
        kind=launcher.array(kinds, wp.int32),
        item=launcher.array(items, wp.int32),
        static_pdf=launcher.array(pdf.reshape(-1), wp.float32),
        pdf_area=launcher.array(pdf, wp.float32),
        light_emitter=launcher.array(light_emitter, wp.int32),
        triangle_emitter=launcher.array(emitter_of, wp.int32),
        has_triangles=bool(len(item)),
    )


def _triangles(bodies: Bodies, first_triangles: list[int], frame_scale: float) -> tuple[Ints, Floats, Floats, Ints]:
    """Row, power, area and prototype of every emissive triangle."""
    scene: Scene = bodies.scene
    emission = np.array([m.emission for m in scene.materials], np.float64).reshape(-1, 3).mean(axis=1)
    instance = np.zeros(len(bodies.emits), np.int64)
    instance[bodies.prototype] = np.arange(bodies.count)
    rows, powers, areas, sources = [], [], [], []
    for prototype, emits in enumerate(bodies.emits):
        if not emits:
            continue
        matrix = bodies.matrices[instance[prototype]]
        scale = abs(np.linalg.det(matrix[:3, :3])) ** (2.0 / 3.0) * frame_scale**2
        for k in scene.instances[prototype].meshes:
            mesh = scene.meshes[k]
            emissive = np.flatnonzero(emission[mesh.material] > 0.0)
            area = triangle_areas(mesh)[emissive] * scale * (2.0 if mesh.double_sided else 1.0)
            rows.append(first_triangles[k] + emissive)
            areas.append(area)
            powers.append(math.pi * area * emission[mesh.material[emissive]])
            sources.append(np.full(len(emissive), prototype))
    if not rows:
        return np.zeros(0, np.int64), np.zeros(0), np.zeros(0), np.zeros(0, np.int64)
    row, power, area, source = (np.concatenate(x) for x in (rows, powers, areas, sources))
    good = power > 0.0
    return row[good], power[good], area[good], source[good]
