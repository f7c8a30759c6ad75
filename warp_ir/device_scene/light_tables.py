"""The tables of analytic lights."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.device_scene.frame import DeviceFrame
from warp_ir.device_scene.scene_data import LightTables, SceneData
from warp_ir.light_modifiers import upload_light_modifiers
from warp_ir.sampling.distribution2d import Distribution2DList, row_areas
from warp_ir.scene import Floats, InputError, Light, LightKind, Scene

_LARGE_AREA = 4.0
"""Area of a light above which it `_is_large`, relative to the disk of the ball of details."""


class UploadedLights(NamedTuple):
    """What else is known of lights whose tables are on the device."""

    owners: tuple[object, ...]
    """The owners of what the tables refer to by id."""
    distributions: Distribution2DList
    power: npt.NDArray[np.float64]
    """Estimated power of each light, mean of the channels [lights]."""
    area: npt.NDArray[np.float64]
    """Area of each light in the device's frame [lights]; infinity: it has none."""


def upload_lights(
    scene: Scene, frame: DeviceFrame, data: SceneData, launcher: Launcher, former: Sequence[Distribution2DList] = ()
) -> UploadedLights:
    """Fills the light tables of a `SceneData`.

    Args:
        scene: The scene, with meshes in the user's order: links refer to them by index.
        frame: The device's frame.
        data: The `SceneData`; its `centre` and `radius` must be set.
        launcher: Launcher of the device.
        former: Distributions on the device, to be reused if they are the same.

    Raises:
        InputError: A light has no area, or its shaping or links are not usable.
    """
    lights = scene.lights
    axes = np.array([_light_axes(light, frame) for light in lights]).reshape(-1, 3, 3)
    origin = frame.to_device(np.array([light.world_from_light[:3, 3] for light in lights]).reshape(-1, 3))
    radiance = np.array([light.radiance for light in lights], np.float64).reshape(-1, 3)
    is_point = np.array([light.kind == LightKind.POINT for light in lights], bool)
    radiance[is_point] *= frame.scale**2  # intensity is radiance times area
    angle = [1.0 - math.cos(math.radians(0.5 * min(max(light.angle, 0.0), 360.0))) for light in lights]
    distributions = Distribution2DList(former)
    texture, texture_factor = _add_textures(lights, distributions)
    tables = LightTables()
    tables.modifiers, peak, shaping_factor = upload_light_modifiers(lights, axes, scene.meshes, distributions, launcher)
    radiance *= peak[:, None]
    axis_rows, radiance_rows = _rows(axes, (3, 3)), _rows(radiance)

    data.light_count = len(lights)
    data.light_kind = launcher.array([int(light.kind) for light in lights] or [0], wp.int32)
    data.light_origin = launcher.array(_rows(origin), wp.vec3)
    data.light_axes = launcher.array(axis_rows, wp.mat33)
    data.light_inverse = launcher.array(_rows(np.array([_inverse(a) for a in axes]), (3, 3)), wp.mat33)
    data.light_radiance = launcher.array(radiance_rows, wp.vec3)
    large = [_is_large(light, axes[k], data.focus_radius) for k, light in enumerate(lights)]
    data.large_light_count = sum(large)
    data.light_large = launcher.array([int(x) for x in large] or [0], wp.int32)
    data.light_angle = launcher.array(angle or [0.0], wp.float32)
    tables.texture = launcher.array(texture or [-1], wp.int32)
    tables.distributions = distributions.upload(launcher)
    data.textured_light_count = sum(k >= 0 for k in texture)
    data.modifier_count, data.shaped_count = tables.modifiers.count, tables.modifiers.shaped_count
    data.only_sampled_count = tables.modifiers.only_sampled_count
    data.light_tables = launcher.array([tables], LightTables)

    shapes = [k for k, light in enumerate(lights) if light.kind <= LightKind.CYLINDER]
    centre = origin[shapes] if shapes else np.full((1, 3), 1.0e6)
    # Larger than the shape by more than rounding: rays must reach the box of a lamp that lies in a surface before it.
    spans = axes[shapes].copy()
    spans[[lights[k].kind <= LightKind.DISK for k in shapes], :, 2] = 0.0  # flat: nothing of it lies off its plane
    # The error of a ray's distance is relative to the scene, from all of which rays come.
    reach = np.abs(spans).sum(axis=2) * 1.001 if shapes else np.zeros((1, 3))
    reach += 2.0**-18 * (np.abs(centre) + data.radius)
    data.shape_count = len(shapes)
    data.shape_light = launcher.array(shapes or [0], wp.int32)
    bvh = wp.Bvh(launcher.array(centre - reach, wp.vec3), launcher.array(centre + reach, wp.vec3))
    data.shape_bvh = bvh.id
    flux = np.array([_power_per_radiance(light, axis_rows[k], data.radius) for k, light in enumerate(lights)])
    # However large a light, what reaches the ball of details is no more than that of a dome.
    reaching = np.where(large, np.minimum(flux, 4.0 * math.pi**2 * data.focus_radius**2), flux)
    mean_radiance = radiance_rows[: len(lights)].mean(axis=1, dtype=np.float64)
    has_area = np.array([light.kind <= LightKind.CYLINDER for light in lights], bool)
    power = mean_radiance * reaching * (texture_factor * shaping_factor)
    return UploadedLights((bvh, tables), distributions, power, np.where(has_area, flux / math.pi, np.inf))


def _add_textures(
    lights: tuple[Light, ...], distributions: Distribution2DList
) -> tuple[list[int], npt.NDArray[np.float64]]:
    """Adds the lights' textures; returns each light's distribution (-1: none), and the factor of its power."""
    index, means = [], np.ones(len(lights))
    known: dict[tuple[int, bool], int] = {}  # by image and projection: lights may share an image
    for k, light in enumerate(lights):
        if light.texture is None:
            index.append(-1)
            continue
        key = id(light.texture), light.kind == LightKind.DOME
        theta = math.pi if light.kind == LightKind.DOME else 0.0
        tint = np.array(light.radiance) / max(float(np.mean(light.radiance)), 1.0e-30)
        measure = row_areas(len(light.texture), theta)
        rows = light.texture.mean(axis=1, dtype=np.float64) @ tint / 3.0
        means[k] = float(rows @ measure / measure.sum())
        if key not in known:
            known[key] = distributions.add(light.texture, max_theta=theta)
        index.append(known[key])
    return index, means


def _rows(table: Floats, shape: tuple[int, ...] = (3,)) -> npt.NDArray[np.float32]:
    """The table, or one row of zeros where it is empty: kernels never get a null pointer."""
    return np.asarray(table, np.float32) if len(table) else np.zeros((1, *shape), np.float32)


def _light_axes(light: Light, frame: DeviceFrame) -> Floats:
    """Columns: the images of the unit shape's axes in the device frame, or a rotation where there is no area.

    For flat shapes, z is the unit normal of the emitting side.
    """
    linear = light.world_from_light[:3, :3].astype(np.float64)
    if light.kind <= LightKind.CYLINDER:
        linear = linear * frame.scale
    if light.kind in (LightKind.RECT, LightKind.DISK):
        size = (light.width, light.height) if light.kind == LightKind.RECT else (light.radius, light.radius)
        x, y = linear[:, 0] * size[0], linear[:, 1] * size[1]
        normal = -np.cross(x, y) * (-1.0 if np.linalg.det(linear) < 0.0 else 1.0)
        length = np.linalg.norm(normal)
        if not length > 0.0:
            raise InputError(f"{light.name}: the light has no area")
        return np.stack([x, y, normal / length], axis=1)
    if light.kind == LightKind.SPHERE:
        return np.asarray(linear * light.radius)
    if light.kind == LightKind.CYLINDER:
        return np.asarray(linear * np.array([light.length, light.radius, light.radius]))
    if np.linalg.det(linear) == 0.0:
        return np.eye(3)
    # Orthonormalizes the axes. The first in the order keeps its direction under any scale and shear: for a distant
    # light, the axis along which it shines.
    order = [2, 0, 1] if light.kind == LightKind.DISTANT else [0, 1, 2]
    rotation = np.empty((3, 3))
    rotation[:, order] = np.linalg.qr(linear[:, order])[0]
    return np.asarray(rotation * np.where(np.sum(rotation * linear, axis=0) < 0.0, -1.0, 1.0))


def _is_large(light: Light, axes: Floats, radius: float) -> bool:
    """Whether a light's area is so much larger than the disk of a radius that few samples by area light it."""
    if light.kind > LightKind.CYLINDER or np.linalg.det(axes) == 0.0:
        return False
    return _power_per_radiance(light, axes, radius) / math.pi > _LARGE_AREA * math.pi * radius**2


def _inverse(axes: Floats) -> Floats:
    try:
        return np.linalg.inv(axes)
    except np.linalg.LinAlgError:
        return np.zeros((3, 3))  # flattened to a plane: it emits, but no ray intersects it


def _power_per_radiance(light: Light, axes: Floats, radius: float) -> float:
    """Flux into the scene per mean radiance [sr × device area]: exact for flat lights, an estimate for the others.

    Infinite lights illuminate the disk of the scene's bounding sphere of that radius.
    """
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
