"""The tables of lights."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.device_scene.frame import DeviceFrame
from warp_ir.device_scene.scene_data import LightTables
from warp_ir.light_modifiers import upload_light_modifiers
from warp_ir.sampling.distribution2d import Distribution2DList, row_areas
from warp_ir.scene import InputError, Light, LightKind, Scene


def upload_lights(
    scene: Scene, frame: DeviceFrame, data: Any, launcher: Launcher, former: Sequence[Distribution2DList] = ()
) -> tuple[Any, Distribution2DList, npt.NDArray[np.float64]]:
    """Fills the light tables.

    Args:
        scene: Whose lights.
        frame: Of the device.
        data: The `SceneData` to fill.
        launcher: Whose device it is for.
        former: Grids that are on the device already.

    Returns:
        The owners of what is referred to by address, the grids, and what textures and shaping make of each light's
        power.
    """
    lights = scene.lights
    axes = np.array([_light_axes(light) * _unit(light, frame) for light in lights]).reshape(-1, 3, 3)
    origin = frame.to_device(np.array([light.world_from_light[:3, 3] for light in lights]).reshape(-1, 3))
    radiance = np.array([light.radiance for light in lights], np.float64).reshape(-1, 3)
    points = np.array([light.kind == LightKind.POINT for light in lights], bool)
    radiance[points] *= frame.scale**2  # intensity is radiance times area
    angle = [1.0 - math.cos(math.radians(0.5 * min(max(light.angle, 0.0), 360.0))) for light in lights]
    distributions = Distribution2DList(former)
    texture, gain = _add_textures(lights, distributions)
    tables = LightTables()
    tables.modifiers, peak, share = upload_light_modifiers(lights, axes, scene.meshes, distributions, launcher)
    radiance *= peak[:, None]

    data.light_count = len(lights)
    data.light_kind = launcher.array([int(light.kind) for light in lights] or [0], wp.int32)
    data.light_origin = launcher.array(_rows(origin), wp.vec3)
    data.light_axes = launcher.array(_rows(axes, (3, 3)), wp.mat33)
    data.light_inverse = launcher.array(_rows(np.array([_inverse(a) for a in axes]), (3, 3)), wp.mat33)
    data.light_radiance = launcher.array(_rows(radiance), wp.vec3)
    data.light_angle = launcher.array(angle or [0.0], wp.float32)
    tables.texture = launcher.array(texture or [-1], wp.int32)
    tables.distributions = distributions.upload(launcher)
    data.textured_count = sum(k >= 0 for k in texture)
    data.modifier_count, data.shaped_count = tables.modifiers.count, tables.modifiers.shaped_count
    data.only_sampled_count = tables.modifiers.only_sampled_count
    data.light_tables = launcher.array([tables], LightTables)

    shapes = [k for k, light in enumerate(lights) if light.kind <= LightKind.CYLINDER]
    reach = np.abs(axes[shapes]).sum(axis=2) * 1.001 if shapes else np.zeros((1, 3))
    centre = origin[shapes] if shapes else np.full((1, 3), 1.0e6)
    data.shape_count = len(shapes)
    data.shape_light = launcher.array(shapes or [0], wp.int32)
    bvh = wp.Bvh(launcher.array(centre - reach, wp.vec3), launcher.array(centre + reach, wp.vec3))
    data.shape_bvh = bvh.id
    return (bvh, tables), distributions, gain * share


def _add_textures(
    lights: tuple[Light, ...], distributions: Distribution2DList
) -> tuple[list[int], npt.NDArray[np.float64]]:
    """Adds the lights' textures to the grids; returns each light's grid (-1: none) and what it makes of the power."""
    index, means = [], np.ones(len(lights))
    known: dict[tuple[int, bool], int] = {}  # lights may share an image
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


def _rows(table: Any, shape: tuple[int, ...] = (3,)) -> Any:
    """The table, or one row of zeros where it is empty: kernels never get a null pointer."""
    return np.asarray(table, np.float32) if len(table) else np.zeros((1, *shape), np.float32)


def _unit(light: Light, frame: DeviceFrame) -> float:
    return frame.scale if light.kind <= LightKind.CYLINDER else 1.0


def _light_axes(light: Light) -> npt.NDArray[np.float64]:
    """Columns: the images of the unit shape's axes; for the flat shapes z is the unit emitting normal."""
    linear = light.world_from_light[:3, :3].astype(np.float64)
    if light.kind in (LightKind.RECT, LightKind.DISK):
        size = (light.width, light.height) if light.kind == LightKind.RECT else (light.radius, light.radius)
        x, y = linear[:, 0] * size[0], linear[:, 1] * size[1]
        normal = -np.cross(x, y) * (-1.0 if np.linalg.det(linear) < 0.0 else 1.0)
        length = np.linalg.norm(normal)
        if not length > 0.0:
            raise InputError(f"{light.name}: the light has no area")
        return np.stack([x, y, normal / length], axis=1)
    if light.kind == LightKind.SPHERE:
        return linear * light.radius
    if light.kind == LightKind.CYLINDER:
        return linear * np.array([light.length, light.radius, light.radius])
    if np.linalg.det(linear) == 0.0:
        return np.eye(3)
    # The first of the axes keeps its direction, whatever scale and shear do to the others: for a sun where it shines.
    order = [2, 0, 1] if light.kind == LightKind.DISTANT else [0, 1, 2]
    rotation = np.empty((3, 3))
    rotation[:, order] = np.linalg.qr(linear[:, order])[0]
    return rotation * np.where(np.sum(rotation * linear, axis=0) < 0.0, -1.0, 1.0)


def _inverse(axes: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    try:
        return np.linalg.inv(axes)
    except np.linalg.LinAlgError:
        return np.zeros((3, 3))  # collapsed to a plane: it still emits, but no ray can find it
