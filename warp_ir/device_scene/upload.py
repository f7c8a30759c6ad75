"""The one function that puts a scene on a device, and takes what is there already."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from warp_ir import sampling
from warp_ir.device_scene.check import check_scene
from warp_ir.device_scene.emitters import upload_emitters
from warp_ir.device_scene.frame import DeviceFrame, frame_of_box
from warp_ir.device_scene.lights import upload_lights
from warp_ir.device_scene.records import SceneData
from warp_ir.device_scene.storage import arranged
from warp_ir.device_scene.surfaces import upload_surfaces
from warp_ir.launch import Launcher
from warp_ir.scene import InputError, Scene

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

    What a scene shares with another of them, or with a `previous` one, is uploaded once: surfaces if their meshes
    are the same objects and their materials are equal, lights if they are the same objects.

    Raises:
        InputError: As for `upload_scene`.
    """
    with launcher.phase("upload"):
        checked = {id(mesh) for other in previous for mesh in other.source.meshes}
        for scene in scenes:
            check_scene(scene, launcher, checked)
            checked |= {id(mesh) for mesh in scene.meshes}
        bounds = [scene.bounds() for scene in scenes]
        lower, upper = np.min([b[0] for b in bounds], axis=0), np.max([b[1] for b in bounds], axis=0)
        done: list[DeviceScene] = []
        for scene in scenes:
            done.append(_upload(scene, lower, upper, launcher, [*done, *previous]))
        return done


def _upload(scene: Scene, lower: Any, upper: Any, launcher: Launcher, others: list[DeviceScene]) -> DeviceScene:
    """One scene into the frame of a bounding box; `others` may have parts of it."""
    extent = float(np.linalg.norm(upper - lower))
    if not np.isfinite(extent):
        raise InputError("scene: its extent is too large for a float")
    frame = frame_of_box(lower, upper)
    scale = frame.scale
    # All of a scene is in its frame: in another one nothing can be used again.
    others = [o for o in others if o.frame.scale == scale and (o.frame.origin == frame.origin).all()]
    surfaces = next((o for o in others if _same_surfaces(o.source, scene)), None)
    lights = next((o for o in others if _same(o.source.lights, scene.lights)), None)
    if surfaces is not None and surfaces is lights:
        return replace(surfaces, source=scene)

    data = SceneData()
    if surfaces is not None:
        for name in SceneData.vars:
            setattr(data, name, getattr(surfaces.data, name))
    area = scene.area() * scale**2
    data.footprint = math.sqrt(area / _PATCHES)
    data.radius = 0.5 * extent * scale * 1.0001 if extent > 0.0 else 1.0
    stored, numbers = arranged(scene)
    owners = surfaces.keep[0] if surfaces is not None else upload_surfaces(stored, numbers, frame, data, launcher)
    # Links name meshes by their numbers in the scene, not by where they are stored.
    shapes, gain = upload_lights(scene, frame, data, launcher)
    upload_emitters(stored, gain, frame, data, launcher)
    data.sobol = launcher.array(sampling.sobol_matrices(), wp.uint32)
    itself = launcher.empty(1, SceneData)
    data.address = wp.uint64(itself.ptr)  # in the copy as well: what is called by address hands it on
    itself.assign(launcher.array([data], SceneData))
    colors = [x.colors.max() for x in (*scene.meshes, *scene.instances) if x.colors is not None and len(x.colors)]
    used = {int(k) for m in scene.meshes if m.colors is None for k in np.unique(m.material)}
    colors += [t.pixels.max() for k in used if (t := scene.materials[k].albedo_texture) is not None]
    return DeviceScene(
        data=data,
        frame=frame,
        extent=extent * scale if extent > 0.0 else 1.0,
        area=area,
        mean_albedo=scene.mean_albedo(),
        max_albedo=float(max([*colors, *(max(scene.materials[k].albedo) for k in used)], default=0.0)),
        emits=data.emitter_count > 0,
        keep=(owners, shapes, itself),
        source=scene,
    )


def _same(one: Sequence[Any], other: Sequence[Any]) -> bool:
    return len(one) == len(other) and all(a is b for a, b in zip(one, other, strict=True))


def _same_surfaces(one: Scene, other: Scene) -> bool:
    """Whether two scenes have the same meshes and instances, and equal materials."""
    same = _same(one.meshes, other.meshes) and _same(one.instances, other.instances)
    return same and (one.materials is other.materials or one.materials == other.materials)
