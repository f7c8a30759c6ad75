"""The trees over the boxes of instances, one for each world and one for what all worlds share: sorted on the device.

A wide node has eight children whatever its boxes are. So for a fixed number of instances the shape of a balanced tree
is fixed as well, and all that changes from step to step is which instance is in which leaf, and the boxes. Instances
are sorted along a Z-order curve through their world, the large ones apart, and boxes are united level by level: a few
launches, whose number grows with the logarithm of the number of instances.

A world's tree and the shared one meet in the world's root: a ray starts there and sees both.
"""

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.bvh import InstanceTree, vec8, vec8i
from warp_ir.device.launch_list import LaunchList
from warp_ir.device.launcher import Launcher
from warp_ir.scene import Ints

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_INFINITY = wp.constant(3.0e38)
_WIDTH = 8
NO_CHILD = wp.constant(-(2**31))
"""Child of a lane that is not used. Others are nodes, or ~row of the sorted instances."""
_LARGEST_RANKED = 256
"""Instances of a world up to which each counts those before it, in place of a radix sort."""
KEY_BITS = 31


@dataclass(frozen=True)
class TopTree:
    """The trees of all worlds."""

    tree: InstanceTree
    """Its tables; `root` is set for each world by its owner."""
    roots: npt.NDArray[np.int32]
    """The root of each world [worlds], which the shared tree hangs on as well."""
    levels: tuple[range, ...]
    """Nodes by height, leaves first."""
    members: wp.array[wp.int32]
    """Instances, group by group."""
    first_rows: wp.array[wp.int32]
    """[groups + 1], the row of `members` at which each group begins; the last group is shared by all worlds."""
    largest: int
    """Largest number of instances of a group."""
    own_lanes: wp.array[wp.int32]
    """[worlds], a bit for each lane of the root that is the world's own."""


@wp.kernel
def _rank_instances(
    first: int,
    keys: wp.array[wp.int32],
    group: wp.array[wp.int32],
    first_rows: wp.array[wp.int32],
    members: wp.array[wp.int32],
    leaf_instances: wp.array[wp.int32],
) -> None:
    """Writes an instance to the row after those of its group that come before it."""
    i = first + wp.tid()
    begin = first_rows[group[i]]
    key = keys[i]
    rank = int(0)
    for row in range(begin, first_rows[group[i] + 1]):
        j = members[row]
        if keys[j] < key or (keys[j] == key and j < i):
            rank += 1
    leaf_instances[begin + rank] = i


@wp.kernel
def _write_sort_keys(
    first: int,
    keys: wp.array[wp.int32],
    group: wp.array[wp.int32],
    sort_keys: wp.array[wp.int64],
    leaf_instances: wp.array[wp.int32],
) -> None:
    """Puts the group in front of the key of an instance."""
    i = first + wp.tid()
    sort_keys[i] = (wp.int64(group[i]) << wp.int64(KEY_BITS)) | wp.int64(keys[i])
    leaf_instances[i] = i


@wp.kernel
def _refit_nodes(
    first: int, first_node: int, tree: InstanceTree, lower: wp.array[wp.vec3], upper: wp.array[wp.vec3]
) -> None:
    """Recomputes the boxes of a node's children, which are instances, or nodes of lower levels."""
    node = first_node + first + wp.tid()
    for k in range(8):
        child = tree.children[node][k]
        for axis in range(3):
            low = float(_INFINITY)
            high = float(-_INFINITY)
            if child >= 0:
                low = wp.min(tree.nodes[6 * child + axis])
                high = wp.max(tree.nodes[6 * child + 3 + axis])
            elif child != NO_CHILD:
                low = lower[tree.leaf_instances[~child]][axis]
                high = upper[tree.leaf_instances[~child]][axis]
            tree.nodes[6 * node + axis][k] = low
            tree.nodes[6 * node + 3 + axis][k] = high


def new_top_tree(group: Ints, world_count: int, launcher: Launcher) -> TopTree:
    """The trees over instances of given groups [n]: worlds 0 ... `world_count` - 1, and that for what all share."""
    counts = np.bincount(group, minlength=world_count + 1)
    first_rows = np.concatenate([[0], np.cumsum(counts)])
    levels: list[list[npt.NDArray[np.int64]]] = []  # by height, the children of each node, as (height, number) or leaf

    def add(height: int, lanes: npt.NDArray[np.int64]) -> int:
        while len(levels) <= height:
            levels.append([])
        levels[height].append(lanes)
        return _named(height, len(levels[height]) - 1)

    def reduce(entries: npt.NDArray[np.int64], most: int) -> tuple[npt.NDArray[np.int64], int]:
        """Unites neighbours until there are at most `most` of them; their height."""
        height = 0
        while len(entries) > most:
            nodes = np.array_split(entries, -(-len(entries) // _WIDTH))
            entries = np.array([add(height, lanes) for lanes in nodes], np.int64)
            height += 1
        return entries, height

    def leaves(g: int) -> npt.NDArray[np.int64]:
        return ~np.arange(first_rows[g], first_rows[g + 1], dtype=np.int64)

    shared, top = reduce(leaves(world_count), _WIDTH - 1)
    joined = shared
    if len(shared) > 1:
        joined = np.array([add(top, shared)], np.int64)
        top += 1
    roots: list[tuple[npt.NDArray[np.int64], int]] = []
    for world in range(world_count):
        all_fit = counts[world] + len(shared) <= _WIDTH  # a decision of each world by itself
        others = shared if all_fit else joined
        own, height = reduce(leaves(world), _WIDTH - len(others))
        top = max(top, height)
        roots.append((np.concatenate([own, others]), len(own)))
    names = [add(top, lanes) for lanes, _ in roots]
    first_nodes = np.concatenate([[0], np.cumsum([len(level) for level in levels])]).astype(np.int64)
    children = np.full((int(first_nodes[-1]), _WIDTH), NO_CHILD, np.int64)
    for height, level in enumerate(levels):
        for k, lanes in enumerate(level):
            children[first_nodes[height] + k, : len(lanes)] = _numbers(lanes, first_nodes)
    tree = InstanceTree()
    tree.nodes, tree.children = launcher.zeros(6 * len(children), vec8), launcher.array(children, vec8i)
    tree.leaf_instances = launcher.empty(2 * max(len(group), 1), wp.int32)  # the radix sort needs twice the memory
    tree.continues = launcher.zeros(max(len(group), 1), wp.int32)
    ranges = [range(int(a), int(b)) for a, b in itertools.pairwise(first_nodes)]
    return TopTree(
        tree=tree,
        roots=_numbers(np.array(names, np.int64), first_nodes).astype(np.int32),
        levels=tuple(level for level in ranges if len(level)),
        members=launcher.array(np.argsort(group, kind="stable"), wp.int32),
        first_rows=launcher.array(first_rows, wp.int32),
        largest=int(counts.max()),
        own_lanes=launcher.array([(1 << own) - 1 for _, own in roots], wp.int32),
    )


def _named(height: int, number: int) -> int:
    """A node before it is numbered."""
    return (height << 40) | number


def _numbers(names: npt.NDArray[np.int64], first_nodes: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """The numbers of nodes; leaves keep theirs."""
    height = np.maximum(names, 0) >> 40
    return np.where(names < 0, names, first_nodes[height] + (names & ((1 << 40) - 1)))


def refit_top_tree(
    top: TopTree,
    group: wp.array[wp.int32],
    keys: wp.array[wp.int32],
    sort_keys: wp.array[wp.int64],
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
    launches: LaunchList,
) -> None:
    """Sorts the instances of every group by their keys, and recomputes all boxes.

    Args:
        top: The trees.
        group: The group of each instance [n].
        keys: Where it lies on a curve through its world [n], of `KEY_BITS` bits.
        sort_keys: Scratch memory [2 n].
        lower: Lower corners of the instances' boxes [n]; above the upper ones where an instance is absent.
        upper: Upper corners [n].
        launches: What the launches are added to.
    """
    count = group.shape[0]
    if top.largest <= _LARGEST_RANKED:
        inputs = [keys, group, top.first_rows, top.members, top.tree.leaf_instances]
        launches.launch(_rank_instances, count, inputs)
    else:
        launches.launch(_write_sort_keys, count, [keys, group, sort_keys, top.tree.leaf_instances])
        bits = KEY_BITS + (top.first_rows.shape[0] - 1).bit_length()
        launches.sort(sort_keys, top.tree.leaf_instances, count, bits)
    for level in top.levels:
        launches.launch(_refit_nodes, len(level), [level.start, top.tree, lower, upper])
