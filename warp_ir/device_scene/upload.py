"""The one function that puts a scene on a device, and takes what is there already."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from warp_ir.device.launcher import Launcher, copy_record
from warp_ir.device_scene.emitter_table import upload_emitters
from warp_ir.device_scene.frame import DeviceFrame, steady_frame_of_box
from warp_ir.device_scene.geometry_storage import storage_order
from warp_ir.device_scene.geometry_update import DeviceGeometry, same_objects
from warp_ir.device_scene.light_tables import upload_lights
from warp_ir.device_scene.scene_data import SceneData
from warp_ir.device_scene.validate import check_scene
from warp_ir.sampling import sobol
from warp_ir.sampling.distribution2d import Distribution2DList
from warp_ir.scene import InputError, Scene, materials_of

_PATCHES = 2**14
"""Where light is reflected, textures are means over as many patches of the scene's surface: VPLs are no denser."""


@dataclass(frozen=True)
class DeviceScene:
    """An uploaded scene; owns what `data` refers to by id."""

    data: Any
    """The `SceneData` for kernels."""
    frame: DeviceFrame
    extent: float
    """Diagonal of the bounding box in the device's frame."""
    area: float
    """Area of all surfaces in the device's frame."""
    mean_albedo: float
    """Mean reflectivity ρ̄ of the surfaces."""
    max_albedo: float
    """Largest albedo of any surface and channel."""
    emits: bool
    """Whether anything in the scene emits."""
    keep: tuple[Any, ...]
    """The owners of the surfaces and of the lights: a struct holds only their ids, and a freed id crashes."""
    source: Scene
    """What was uploaded."""
    surfaces: DeviceGeometry
    """Shared with other moments; and handed on to what is uploaded next."""
    changes: int
    """Of the surfaces, when this was uploaded."""
    stored: Scene
    """`source` as it is arranged in the tables ..."""
    rows: list[int]
    """... and the row of the first triangle of each of its meshes; -1: it has none."""
    distributions: Distribution2DList
    """The images and the shaping of its lights."""
    bounds: tuple[float, ...]
    """Lower and upper corner of all moments together, in the world."""

    @property
    def is_valid(self) -> bool:
        """Whether its surfaces are still there."""
        return self.changes == self.surfaces.changes


def upload_scene(scene: Scene, launcher: Launcher) -> DeviceScene:
    """Checks a scene and copies it to the launcher's device.

    Raises:
        InputError: An array has the wrong shape or a bad value; the message names the mesh or light.
    """
    return upload_moments((scene,), launcher)[0]


def upload_moments(
    scenes: Sequence[Scene], launcher: Launcher, previous: Sequence[DeviceScene] = ()
) -> list[DeviceScene]:
    """Checks scenes and copies them to the launcher's device, into one frame.

    Meshes, textures and trees that are the same objects in several of them are there once, and lights as well. The
    surfaces of `previous` ones are taken over and changed where they differ, so those must not be used afterwards.

    Raises:
        InputError: As for `upload_scene`.
    """
    with launcher.phase("upload"):
        checked = {id(x) for other in previous for x in (*other.source.meshes, *other.source.materials)}
        for scene in scenes:
            check_scene(scene, launcher, checked)
            checked |= {id(x) for x in (*scene.meshes, *scene.materials)}
        bounds = [scene.bounds() for scene in scenes]
        lower, upper = np.min([b[0] for b in bounds], axis=0), np.max([b[1] for b in bounds], axis=0)
        extent = float(np.linalg.norm(upper - lower))
        if not np.isfinite(extent):
            raise InputError("scene: its extent is too large for a float")
        frame = steady_frame_of_box(lower, upper)
        valid = [o for o in previous if o.is_valid and o.frame.equals(frame) and o.bounds == (*lower, *upper)]
        there = [_find(scene, valid) for scene in scenes]
        if all(there):
            return [replace(found, source=scene) for found, scene in zip(there, scenes, strict=True) if found]
        return _upload(scenes, (lower, upper), frame, launcher, previous)


def _upload(
    scenes: Sequence[Scene],
    bounds: tuple[Any, Any],
    frame: DeviceFrame,
    launcher: Launcher,
    previous: Sequence[DeviceScene],
) -> list[DeviceScene]:
    """Scenes that are not all there; `previous` ones may have parts of them."""
    lower, upper = bounds
    extent = float(np.linalg.norm(upper - lower))
    stored = [storage_order(scene) for scene in scenes]
    lit: list[tuple[Any, Any, Distribution2DList, Any]] = []
    distributions = [other.distributions for other in previous]
    for k, scene in enumerate(scenes):
        like = next((i for i, other in enumerate(scenes[:k]) if _same_lights(other, scene)), None)
        if like is not None:
            lit.append((copy_record(lit[like][0]), *lit[like][1:]))
            continue
        data = SceneData()
        data.centre = wp.vec3(*frame.to_device(0.5 * (lower + upper)).tolist())
        data.radius = 0.5 * extent * frame.scale * 1.0001 if extent > 0.0 else 1.0
        # Links name meshes by their numbers in the scene, not by where they are stored.
        lit.append((data, *upload_lights(scene, frame, data, launcher, distributions)))
        distributions.append(lit[-1][2])
    surfaces = previous[0].surfaces if previous else DeviceGeometry(launcher)
    surfaces.take(stored, frame)
    done: list[DeviceScene] = []
    for k, (scene, (data, shapes, own, gain)) in enumerate(zip(scenes, lit, strict=True)):
        same = _find(scene, done)
        if same is not None:
            done.append(replace(same, source=scene))
            continue
        area = scene.area() * frame.scale**2
        data.footprint = math.sqrt(area / _PATCHES)
        owners = surfaces.fill(k, data)
        rows = surfaces.rows(k)
        upload_emitters(stored[k][0], rows, gain, frame, data, launcher)
        data.sobol = launcher.array(sobol.sobol_matrices(), wp.uint32)
        itself = launcher.empty(1, SceneData)
        data.address = wp.uint64(itself.ptr)  # in the copy as well: what is called by address hands it on
        itself.assign(launcher.array([data], SceneData))
        done.append(
            DeviceScene(
                data=data,
                frame=frame,
                extent=extent * frame.scale if extent > 0.0 else 1.0,
                area=area,
                mean_albedo=scene.mean_albedo(),
                max_albedo=_max_albedo(scene),
                emits=data.emitter_count > 0,
                keep=(owners, shapes, itself),
                source=scene,
                surfaces=surfaces,
                changes=surfaces.changes,
                stored=stored[k][0],
                rows=rows,
                distributions=own,
                bounds=(*lower, *upper),
            )
        )
    return done


def _max_albedo(scene: Scene) -> float:
    colors = [x.colors.max() for x in (*scene.meshes, *scene.instances) if x.colors is not None and len(x.colors)]
    used = {k for m in scene.meshes if m.colors is None for k in materials_of(m)}
    colors += [t.pixels.max() for k in used if (t := scene.materials[k].albedo_texture) is not None]
    return float(max([*colors, *(max(scene.materials[k].albedo) for k in used)], default=0.0))


def _find(scene: Scene, others: Sequence[DeviceScene]) -> DeviceScene | None:
    """One of others that differs from a scene in its camera at most."""
    lit = (o for o in others if same_objects(o.source.lights, scene.lights))
    return next((o for o in lit if _same_surfaces(o.source, scene)), None)


def _same_surfaces(one: Scene, other: Scene) -> bool:
    """Whether two scenes have the same meshes and instances, and equal materials."""
    same = same_objects(one.meshes, other.meshes) and same_objects(one.instances, other.instances)
    return same and (one.materials is other.materials or one.materials == other.materials)


def _same_lights(one: Scene, other: Scene) -> bool:
    """Whether the tables of lights, and of meshes that are lights, are the same."""
    lamps = [[(k, id(mesh)) for k, mesh in enumerate(s.meshes) if mesh.light is not None] for s in (one, other)]
    return same_objects(one.lights, other.lights) and len(one.meshes) == len(other.meshes) and lamps[0] == lamps[1]
