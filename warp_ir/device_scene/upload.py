"""Uploads a scene to a device, and reuses what an earlier upload left there."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from warp_ir.device.launcher import Launcher, copy_record
from warp_ir.device_scene.emitter_table import upload_emitters
from warp_ir.device_scene.frame import FOCUS_RADIUS, DeviceFrame, coarse_meshes, frame_of_view, snapped_frame_of_box
from warp_ir.device_scene.geometry_storage import storage_order
from warp_ir.device_scene.geometry_update import DeviceGeometry, same_objects
from warp_ir.device_scene.light_tables import UploadedLights, upload_lights
from warp_ir.device_scene.scene_data import SceneData
from warp_ir.device_scene.validate import check_scene
from warp_ir.sampling import sobol
from warp_ir.sampling.distribution2d import Distribution2DList
from warp_ir.scene import Floats, InputError, Ints, Scene, materials_of

_TEXTURE_PATCHES = 2**14
"""Indirect light averages textures over this fraction of the scene's surface area: VPLs are not denser than that."""


@dataclass(frozen=True)
class DeviceScene:
    """An uploaded scene; owns what `data` refers to by id."""

    data: SceneData
    """The record for kernels."""
    frame: DeviceFrame
    extent: float
    """Diagonal of the bounding box in the device's frame."""
    detail_extent: float
    """Edge length of the cube around the device's origin in which positions are told apart by cells."""
    coarse: tuple[str, ...]
    """Names of meshes in view for which float32 is too coarse, although the frame is that of the view."""
    area: float
    """Area of all surfaces in the device's frame."""
    mean_albedo: float
    """Mean albedo ρ̄ of the surfaces."""
    max_albedo: float
    """Largest albedo of any surface and channel."""
    emits: bool
    """Whether anything in the scene emits."""
    emitter_power: Floats
    """Estimated power of each emitter [emitters]."""
    emitter_source: Ints
    """The light, or part of a mesh, that each emitter belongs to [emitters]."""
    owners: tuple[object, ...]
    """The owners of geometry and lights: records hold only ids, and a freed id crashes."""
    source: Scene
    """The scene that was uploaded."""
    geometry: DeviceGeometry
    """Shared by all shutter samples, and passed on to the next upload."""
    geometry_version: int
    """`geometry.version` at the time of the upload."""
    stored: Scene
    """`source` in storage order."""
    first_triangles: list[int]
    """Row of the first triangle of each mesh of `stored`; -1: it has none."""
    distributions: Distribution2DList
    """The textures and the shaping of its lights."""
    bounds: tuple[float, ...]
    """Lower and upper corner of all shutter samples together, in world space."""

    @property
    def power(self) -> float:
        """Power of all emitters, the mean over channels, with lengths in device units."""
        return float(self.emitter_power.sum())

    @property
    def is_valid(self) -> bool:
        """Whether its geometry is still on the device: no later upload has replaced it."""
        return self.geometry_version == self.geometry.version


def upload_scene(scene: Scene, launcher: Launcher) -> DeviceScene:
    """Checks a scene and copies it to the launcher's device.

    Raises:
        InputError: An array has the wrong shape or a bad value; the message names the mesh or light.
    """
    return upload_scenes((scene,), launcher)[0]


def upload_scenes(
    scenes: Sequence[Scene], launcher: Launcher, previous: Sequence[DeviceScene] = ()
) -> list[DeviceScene]:
    """Checks the shutter samples of a scene and copies them to the launcher's device, into one frame.

    Meshes, textures, lights and trees that are the same objects in several samples are stored once. The geometry of
    `previous` is reused and modified where it differs, so those scenes must not be used afterwards.

    Args:
        scenes: The shutter samples, at least one.
        launcher: Launcher of the device.
        previous: The result of an earlier call with this launcher.

    Raises:
        InputError: An array has the wrong shape or a bad value; the message names the mesh or light.
    """
    with launcher.phase("upload"):
        checked = {id(x) for other in previous for x in (*other.source.meshes, *other.source.materials)}
        for scene in scenes:
            check_scene(scene, launcher, checked, [other.source for other in previous])
            checked |= {id(x) for x in (*scene.meshes, *scene.materials)}
        bounds = [scene.bounds() for scene in scenes]
        lower, upper = np.min([b[0] for b in bounds], axis=0), np.max([b[1] for b in bounds], axis=0)
        if not np.isfinite(np.linalg.norm(upper - lower)):
            raise InputError("scene: its extent is too large for a float")
        extent = float(np.linalg.norm(upper - lower))
        frame = frame_of_view(scenes[0], extent) or snapped_frame_of_box(lower, upper)
        valid = [o for o in previous if o.is_valid and o.frame.equals(frame) and o.bounds == (*lower, *upper)]
        matches = [_find_same(scene, valid) for scene in scenes]
        reused = [replace(same, source=scene) for same, scene in zip(matches, scenes, strict=True) if same is not None]
        if len(reused) == len(scenes):
            return reused
        return _upload(scenes, (lower, upper), frame, launcher, previous)


def _upload(
    scenes: Sequence[Scene],
    bounds: tuple[Floats, Floats],
    frame: DeviceFrame,
    launcher: Launcher,
    previous: Sequence[DeviceScene],
) -> list[DeviceScene]:
    """Uploads shutter samples that differ from `previous` ones, of which it reuses what is the same."""
    lower, upper = bounds
    extent = float(np.linalg.norm(upper - lower))
    stored = [storage_order(scene) for scene in scenes]
    lights = _upload_lights(scenes, bounds, frame, launcher, [other.distributions for other in previous])
    geometry = previous[0].geometry if previous else DeviceGeometry(launcher)
    geometry.update(stored, frame)
    device_extent = extent * frame.scale if extent > 0.0 else 1.0
    done: list[DeviceScene] = []
    for k, (scene, (data, uploaded)) in enumerate(zip(scenes, lights, strict=True)):
        same = _find_same(scene, done)
        if same is not None:
            done.append(replace(same, source=scene))
            continue
        area = scene.area() * frame.scale**2
        data.footprint = math.sqrt(area / _TEXTURE_PATCHES)
        geometry_owners = geometry.fill(k, data)
        first_triangles = geometry.first_triangles(k)
        power, source = upload_emitters(stored[k][0], first_triangles, uploaded, frame, data, launcher)
        data.sobol = launcher.array(sobol.sobol_matrices(), wp.uint32)
        on_device = launcher.empty(1, SceneData)
        data.address = wp.uint64(on_device.ptr)  # set in the copy as well: functions that read it pass it on
        on_device.assign(launcher.array([data], SceneData))
        done.append(
            DeviceScene(
                data=data,
                frame=frame,
                extent=device_extent,
                detail_extent=2.0 * data.focus_radius if data.focus_radius < data.radius else device_extent,
                coarse=coarse_meshes(scene, frame) if data.focus_radius < data.radius else (),
                area=area,
                mean_albedo=scene.mean_albedo(),
                max_albedo=_max_albedo(scene),
                emits=data.emitter_count > 0,
                emitter_power=power,
                emitter_source=source,
                owners=(geometry_owners, uploaded.owners, on_device),
                source=scene,
                geometry=geometry,
                geometry_version=geometry.version,
                stored=stored[k][0],
                first_triangles=first_triangles,
                distributions=uploaded.distributions,
                bounds=(*lower, *upper),
            )
        )
    return done


def _upload_lights(
    scenes: Sequence[Scene],
    bounds: tuple[Floats, Floats],
    frame: DeviceFrame,
    launcher: Launcher,
    former: list[Distribution2DList],
) -> list[tuple[SceneData, UploadedLights]]:
    """A new record with the lights of each shutter sample; those that are the same in several are uploaded once."""
    lower, upper = bounds
    extent = float(np.linalg.norm(upper - lower))
    out: list[tuple[SceneData, UploadedLights]] = []
    for k, scene in enumerate(scenes):
        same = next((i for i, other in enumerate(scenes[:k]) if _same_lights(other, scene)), None)
        if same is not None:
            out.append((copy_record(out[same][0]), out[same][1]))
            continue
        data = SceneData()
        data.centre = wp.vec3(*frame.to_device(0.5 * (lower + upper)).tolist())
        data.radius = 0.5 * extent * frame.scale * 1.0001 if extent > 0.0 else 1.0
        data.focus, data.focus_radius = data.centre, data.radius
        if not frame.equals(snapped_frame_of_box(lower, upper)):
            data.focus, data.focus_radius = wp.vec3(0.0), FOCUS_RADIUS
        # Links name meshes by their index in the user's scene, not in storage order.
        lights = upload_lights(scene, frame, data, launcher, former)
        out.append((data, lights))
        former = [*former, lights.distributions]
    return out


def _max_albedo(scene: Scene) -> float:
    values = [mesh.colors.max() for mesh in scene.meshes if mesh.colors is not None and len(mesh.colors)]
    values += [group.colors.max() for group in scene.instances if group.colors is not None and len(group.colors)]
    used = {k for m in scene.meshes if m.colors is None for k in materials_of(m)}
    values += [t.pixels.max() for k in used if (t := scene.materials[k].albedo_texture) is not None]
    return float(max([*values, *(max(scene.materials[k].albedo) for k in used)], default=0.0))


def _find_same(scene: Scene, others: Sequence[DeviceScene]) -> DeviceScene | None:
    """One of `others` that differs from a scene in its camera at most; None: there is none."""
    candidates = (o for o in others if same_objects(o.source.lights, scene.lights))
    return next((o for o in candidates if _same_surfaces(o.source, scene)), None)


def _same_surfaces(one: Scene, other: Scene) -> bool:
    """Whether two scenes have the same meshes and instances, and equal materials."""
    same = same_objects(one.meshes, other.meshes) and same_objects(one.instances, other.instances)
    return same and (one.materials is other.materials or one.materials == other.materials)


def _same_lights(one: Scene, other: Scene) -> bool:
    """Whether two scenes have the same lights and mesh lights."""
    mesh_lights = [[(k, id(mesh)) for k, mesh in enumerate(s.meshes) if mesh.light is not None] for s in (one, other)]
    same_meshes = len(one.meshes) == len(other.meshes) and mesh_lights[0] == mesh_lights[1]
    return same_objects(one.lights, other.lights) and same_meshes
