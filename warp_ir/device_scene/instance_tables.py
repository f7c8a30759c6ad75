"""The tables of instances, and the BVH over their boxes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.bvh import Instance, InstanceTree, build_instance_tree, empty_rows
from warp_ir.device.launcher import Launcher
from warp_ir.device_scene.frame import DeviceFrame
from warp_ir.device_scene.geometry_storage import StoredSample
from warp_ir.scene import Floats, InputError, Instances
from warp_ir.scene.instances import cofactors, transform_box

_Sources = tuple[tuple[Floats | None, ...], list[tuple[float, ...]]]
"""What instance tables are computed from: arrays, compared as objects, and numbers, compared by value."""


@dataclass(frozen=True, eq=False)
class InstanceTables:
    """Instances on the device, and what they were computed from."""

    sources: _Sources
    count: int
    colors: wp.array[wp.vec3]
    axes: wp.array[wp.mat33]
    tree: InstanceTree
    owner: wp.Bvh | None
    """Warp's BVH, to which `tree` refers by id on CUDA."""


def upload_instances(
    stored: StoredSample,
    frame: DeviceFrame,
    roots: Sequence[int],
    reusable: Sequence[InstanceTables],
    launcher: Launcher,
) -> InstanceTables:
    """Uploads the instances of a shutter sample and builds their BVH.

    Args:
        stored: The shutter sample.
        frame: The device's frame.
        roots: `Instance.root` of each prototype.
        reusable: Tables on the device; if one was computed from the same sources, it is returned.
        launcher: Launcher of the device.

    Raises:
        InputError: A matrix is singular.
    """
    sources = _sources(stored, roots)
    for tables in reusable:
        (arrays, numbers), (other_arrays, other_numbers) = sources, tables.sources
        if len(arrays) == len(other_arrays) and numbers == other_numbers:
            if all(a is b for a, b in zip(arrays, other_arrays, strict=True)):
                return tables
    return _upload(stored, frame, roots, sources, launcher)


def _sources(stored: StoredSample, roots: Sequence[int]) -> _Sources:
    # `InstanceTables.sources` keeps the arrays alive, so that comparing them as objects is safe.
    arrays = tuple(x for group in stored.scene.instances for x in (group.matrices, group.colors))
    numbers = [
        (root, b.triangle_rows.start, b.frame.scale, *b.frame.origin.tolist(), *b.half_extent.tolist())
        for root, b in zip(roots, stored.prototypes, strict=True)
        if b.half_extent is not None
    ]
    return arrays, numbers


def _upload(
    stored: StoredSample, frame: DeviceFrame, roots: Sequence[int], sources: _Sources, launcher: Launcher
) -> InstanceTables:
    groups = stored.scene.instances
    if not groups:
        tree = InstanceTree()
        tree.instances = launcher.zeros(1, Instance)
        return InstanceTables(sources, 0, launcher.zeros(1, wp.vec3), launcher.zeros(1, wp.mat33), tree, None)
    lowers, uppers, tables, all_axes = [], [], [], []
    for group, batch, root in zip(groups, stored.prototypes, roots, strict=True):
        own, half_extent = batch.frame, batch.half_extent
        assert half_extent is not None
        linear = group.matrices[:, :3, :3]
        axes = linear * (frame.scale / own.scale)
        centre = frame.to_device(linear @ own.origin + group.matrices[:, :3, 3])
        inverse = _inverses(axes, group)
        # A ray is transformed by the inverse, its hit by the axes: bounds the coordinates in both, in the device frame.
        reach = np.abs(axes) @ half_extent
        magnitude = (np.abs(axes) @ (np.abs(inverse) @ reach[:, :, None]))[:, :, 0].max(axis=1)
        magnitude += np.abs(centre).max(axis=1)
        lower, upper = transform_box(-half_extent, half_extent, _affine(axes, centre))
        margin = magnitude[:, None] * (16.0 * 2.0**-23)
        table = empty_rows(Instance, len(axes))
        table["inverse"], table["centre"], table["magnitude"] = inverse, centre, magnitude
        table["root"], table["triangle_offset"] = root, batch.triangle_rows.start
        lowers.append((lower - margin).astype(np.float32))
        uppers.append((upper + margin).astype(np.float32))
        tables.append(table)
        all_axes.append(axes.astype(np.float32))
    colors: Floats = np.zeros((1, 3))
    if any(group.colors is not None for group in groups):
        colors = np.concatenate([np.zeros((len(g.matrices), 3)) if g.colors is None else g.colors for g in groups])
    lower, upper = np.concatenate(lowers), np.concatenate(uppers)
    tree, owner = build_instance_tree(lower, upper, np.concatenate(tables), launcher)
    return InstanceTables(
        sources,
        len(lower),
        launcher.array(colors.astype(np.float32), wp.vec3),
        launcher.array(np.concatenate(all_axes), wp.mat33),
        tree,
        owner,
    )


def _inverses(axes: Floats, group: Instances) -> Floats:
    """The inverses of matrices [k, 3, 3].

    Raises:
        InputError: A matrix is singular, or float32 cannot hold its inverse.
    """
    with np.errstate(all="ignore"):
        cofactor = cofactors(axes)
        inverse = cofactor.transpose(0, 2, 1) / np.sum(axes[:, 0] * cofactor[:, 0], axis=1)[:, None, None]
        good = np.isfinite(inverse.astype(np.float32)).all(axis=(1, 2)) & np.isfinite(axes).all(axis=(1, 2))
    if not good.all():
        raise InputError(f"{group.name}: the matrix of instance {int(np.argmin(good))} is singular")
    return np.asarray(inverse)


def _affine(axes: Floats, centre: Floats) -> npt.NDArray[np.float64]:
    """Matrices [k, 4, 4] of linear parts [k, 3, 3] and translations [k, 3]."""
    out = np.zeros((len(axes), 4, 4))
    out[:, :3, :3], out[:, :3, 3] = axes, centre
    return out
