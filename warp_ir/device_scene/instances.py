"""The tables of instances, and the tree over them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.bvh import Instance, TwoLevel, build_instance_tree
from warp_ir.device_scene.frame import DeviceFrame
from warp_ir.device_scene.storage import Storage
from warp_ir.launch import Launcher
from warp_ir.placing import boxes, cofactors
from warp_ir.scene import InputError, Instances, Scene


def upload_instances(
    scene: Scene, frame: DeviceFrame, storage: Storage, roots: Sequence[int], data: Any, launcher: Launcher
) -> Any:
    """Fills the instance tables; returns the owner of the tree over them."""
    data.instance_colors = launcher.zeros(1, wp.vec3)
    if not scene.instances:
        data.two_level, data.instances = launcher.zeros(1, TwoLevel), launcher.zeros(1, Instance)
        data.instance_axes = launcher.zeros(1, wp.mat33)
        return None
    lowers, uppers, tables, all_axes = [], [], [], []
    for k, group in enumerate(scene.instances):
        own = storage.frames[k]
        linear = group.matrices[:, :3, :3]
        axes = linear * (frame.scale / own.scale)
        centre = frame.to_device(linear @ own.origin + group.matrices[:, :3, 3])
        inverse = _inverses(axes, group)
        # A ray comes in by the inverse and its hit goes out by the axes: the errors of both, in the device frame.
        reach = np.abs(axes) @ storage.halves[k]
        size = (np.abs(axes) @ (np.abs(inverse) @ reach[:, :, None]))[:, :, 0].max(axis=1)
        size += np.abs(centre).max(axis=1)
        lower, upper = boxes(-storage.halves[k], storage.halves[k], _matrices(axes, centre))
        margin = size[:, None] * (16.0 * 2.0**-23)
        table = np.zeros(len(axes), Instance.numpy_dtype())
        table["inverse"], table["centre"], table["size"] = inverse, centre, size
        table["root"], table["shift"] = roots[storage.part[k]], storage.first[k]
        lowers.append((lower - margin).astype(np.float32))
        uppers.append((upper + margin).astype(np.float32))
        tables.append(table)
        all_axes.append(axes.astype(np.float32))
    if any(group.colors is not None for group in scene.instances):
        colors = [np.zeros((len(g.matrices), 3)) if g.colors is None else g.colors for g in scene.instances]
        data.instance_colors = launcher.array(np.concatenate(colors).astype(np.float32), wp.vec3)
    data.instance_axes = launcher.array(np.concatenate(all_axes), wp.mat33)
    lower, upper = np.concatenate(lowers), np.concatenate(uppers)
    both = TwoLevel()
    both.bvh = data.bvh
    both.tree, owner = build_instance_tree(lower, upper, np.concatenate(tables), launcher)
    data.instance_count, data.instances = len(lower), both.tree.instances
    data.two_level = launcher.array([both], TwoLevel)
    return owner, both


def _inverses(axes: npt.NDArray[np.float64], group: Instances) -> npt.NDArray[np.float64]:
    """Inverses [k, 3, 3] that a float32 can hold."""
    with np.errstate(all="ignore"):
        cofactor = cofactors(axes)
        inverse = cofactor.transpose(0, 2, 1) / np.sum(axes[:, 0] * cofactor[:, 0], axis=1)[:, None, None]
        good = np.isfinite(inverse.astype(np.float32)).all(axis=(1, 2)) & np.isfinite(axes).all(axis=(1, 2))
    if not good.all():
        raise InputError(f"{group.name}: the matrix of instance {int(np.argmin(good))} is singular")
    return inverse


def _matrices(axes: Any, centre: Any) -> npt.NDArray[np.float64]:
    out = np.zeros((len(axes), 4, 4))
    out[:, :3, :3], out[:, :3, 3] = axes, centre
    return out
