"""The tables of instances, and the tree over them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.bvh import Instance, InstanceTree, build_instance_tree
from warp_ir.device.launcher import Launcher
from warp_ir.device_scene.frame import DeviceFrame
from warp_ir.device_scene.geometry_storage import StoredSample
from warp_ir.scene import InputError, Instances
from warp_ir.scene.instances import cofactors, transform_box


@dataclass(frozen=True, eq=False)
class InstanceTables:
    """Instances on the device, and what they were made from."""

    made_from: tuple[Any, ...]
    count: int
    colors: Any
    axes: Any
    tree: Any
    owner: Any


def upload_instances(
    moment: StoredSample, frame: DeviceFrame, roots: Sequence[int], known: Sequence[InstanceTables], launcher: Launcher
) -> InstanceTables:
    """Instances and the tree over them.

    Args:
        moment: Whose.
        frame: Of the device.
        roots: `Instance.root` of each prototype.
        known: What there is already: one that was made from the same is taken.
        launcher: Whose device it is for.
    """
    groups = moment.scene.instances
    # Arrays are compared as objects: they live as long as what is made from them.
    made_from = (
        *(x for group in groups for x in (group.matrices, group.colors)),
        [
            (root, part.triangles.start, part.frame.scale, *part.frame.origin.tolist(), *part.half.tolist())
            for root, part in zip(roots, moment.prototypes, strict=True)
            if part.half is not None
        ],
    )
    for tables in known:
        if (
            len(tables.made_from) == len(made_from)
            and tables.made_from[-1] == made_from[-1]
            and all(a is b for a, b in zip(tables.made_from[:-1], made_from[:-1], strict=True))
        ):
            return tables
    return _upload(moment, frame, roots, made_from, launcher)


def _upload(
    moment: StoredSample, frame: DeviceFrame, roots: Sequence[int], made_from: Any, launcher: Launcher
) -> InstanceTables:
    groups = moment.scene.instances
    if not groups:
        tree = InstanceTree()
        tree.instances = launcher.zeros(1, Instance)
        return InstanceTables(made_from, 0, launcher.zeros(1, wp.vec3), launcher.zeros(1, wp.mat33), tree, None)
    lowers, uppers, tables, all_axes = [], [], [], []
    for group, part, root in zip(groups, moment.prototypes, roots, strict=True):
        own, half = part.frame, part.half
        linear = group.matrices[:, :3, :3]
        axes = linear * (frame.scale / own.scale)
        centre = frame.to_device(linear @ own.origin + group.matrices[:, :3, 3])
        inverse = _inverses(axes, group)
        # A ray comes in by the inverse and its hit goes out by the axes: the errors of both, in the device frame.
        reach = np.abs(axes) @ half
        size = (np.abs(axes) @ (np.abs(inverse) @ reach[:, :, None]))[:, :, 0].max(axis=1)
        size += np.abs(centre).max(axis=1)
        lower, upper = transform_box(-half, half, _matrices(axes, centre))
        margin = size[:, None] * (16.0 * 2.0**-23)
        table = np.zeros(len(axes), Instance.numpy_dtype())
        table["inverse"], table["centre"], table["size"] = inverse, centre, size
        table["root"], table["shift"] = root, part.triangles.start
        lowers.append((lower - margin).astype(np.float32))
        uppers.append((upper + margin).astype(np.float32))
        tables.append(table)
        all_axes.append(axes.astype(np.float32))
    colors: Any = np.zeros((1, 3))
    if any(group.colors is not None for group in groups):
        colors = np.concatenate([np.zeros((len(g.matrices), 3)) if g.colors is None else g.colors for g in groups])
    lower, upper = np.concatenate(lowers), np.concatenate(uppers)
    tree, owner = build_instance_tree(lower, upper, np.concatenate(tables), launcher)
    return InstanceTables(
        made_from,
        len(lower),
        launcher.array(colors.astype(np.float32), wp.vec3),
        launcher.array(np.concatenate(all_axes), wp.mat33),
        tree,
        owner,
    )


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
