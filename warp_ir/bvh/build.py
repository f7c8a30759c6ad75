"""Wide trees from Warp's binary ones: nodes of eight children, blocks of eight triangles."""

from collections.abc import Sequence
from typing import Any

import warp as wp

from warp_ir.bvh.node_layout import INFINITY, LANES, Bvh, Instance, InstanceTree, vec8, vec8i
from warp_ir.bvh.warp_bvh import box_corner, is_leaf, link, node_count, primitive, tree_of, tree_root
from warp_ir.device.launcher import Launcher

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_LEAF_SIZE = 8


@wp.kernel
def _locate(first: int, mesh: wp.uint64, out: wp.array[wp.uint64]) -> None:
    """Warp's tree over a mesh."""
    out[0] = tree_of(mesh)


@wp.kernel
def _describe(first: int, tree: wp.uint64, out: wp.array[wp.int32]) -> None:
    """The root and the number of nodes of Warp's tree."""
    out[0] = tree_root(tree)
    out[1] = node_count(tree)


@wp.kernel
def _count_blocks(first: int, tree: wp.uint64, lanes: int, counts: wp.array[wp.int32]) -> None:
    """How many blocks of so many primitives a node of Warp's tree needs: none if it is no leaf."""
    node = first + wp.tid()
    counts[node] = 0
    if is_leaf(tree, node) == 1:
        counts[node] = (link(tree, node, 1) - link(tree, node, 0) + lanes - 1) // lanes


@wp.kernel
def _fill_slots(first: int, tree: wp.uint64, first_slot: wp.array[wp.int32], instances: InstanceTree) -> None:
    """Writes a leaf's instances one after the other."""
    node = first + wp.tid()
    if is_leaf(tree, node) == 0:
        return
    begin = link(tree, node, 0)
    end = link(tree, node, 1)
    for i in range(begin, end):
        instances.slots[first_slot[node] + i - begin] = primitive(tree, i)
        instances.chained[first_slot[node] + i - begin] = wp.where(i + 1 < end, 1, 0)


@wp.kernel
def _fill_blocks(
    first: int,
    tree: wp.uint64,
    points: wp.array[wp.vec3],
    indices: wp.array[wp.int32],
    first_block: wp.array[wp.int32],
    shift: int,
    bvh: Bvh,
) -> None:
    """Writes a leaf's triangles side by side; lanes left over hold a triangle that no ray meets."""
    node = first + wp.tid()
    if is_leaf(tree, node) == 0:
        return
    begin = link(tree, node, 0)
    end = link(tree, node, 1)
    block = first_block[node]
    while begin < end:
        for lane in range(8):
            triangle = int(-1)
            if begin + lane < end:
                triangle = primitive(tree, begin + lane)
            for corner in range(3):
                p = wp.vec3(0.0)
                if triangle >= 0:
                    p = points[indices[3 * triangle + corner]]
                for axis in range(3):
                    bvh.blocks[9 * block + 3 * corner + axis][lane] = p[axis]
            bvh.triangles[block][lane] = wp.where(triangle >= 0, triangle + shift, -1)
        begin += LANES
        bvh.chained[block] = wp.where(begin < end, 1, 0)
        block += 1


@wp.func
def _area(tree: wp.uint64, node: int) -> float:
    d = box_corner(tree, node, 1) - box_corner(tree, node, 0)
    return d[0] * d[1] + d[1] * d[2] + d[2] * d[0]


@wp.kernel
def _collapse(
    first: int,
    tree: wp.uint64,
    sources: wp.array[wp.int32],
    first_block: wp.array[wp.int32],
    base: int,
    level: Bvh,
    counts: wp.array[wp.int32],
) -> None:
    """Makes a wide node of a binary one: opens the largest inner node below it until there are eight children."""
    i = first + wp.tid()
    chosen = vec8i(-1)
    chosen[0] = sources[i]
    size = int(1)
    opening = int(0)
    while opening >= 0:
        node = chosen[opening]
        if is_leaf(tree, node) == 0:
            chosen[opening] = link(tree, node, 0)
            chosen[size] = link(tree, node, 1)
            size += 1
        opening = int(-1)
        largest = float(-1.0)
        if size < LANES:
            for k in range(size):
                if is_leaf(tree, chosen[k]) == 0 and _area(tree, chosen[k]) > largest:
                    largest = _area(tree, chosen[k])
                    opening = k
    inner = int(0)
    for k in range(8):
        lower = wp.vec3(INFINITY)
        upper = wp.vec3(-INFINITY)
        if k < size:
            lower = box_corner(tree, chosen[k], 0)
            upper = box_corner(tree, chosen[k], 1)
            if is_leaf(tree, chosen[k]) == 1:
                chosen[k] = ~(base + first_block[chosen[k]])
            else:
                inner += 1
        for axis in range(3):
            level.nodes[6 * i + axis][k] = lower[axis]
            level.nodes[6 * i + 3 + axis][k] = upper[axis]
    level.children[i] = chosen
    counts[i] = inner


@wp.kernel
def _number(
    first: int,
    level: Bvh,
    ends: wp.array[wp.int32],
    counts: wp.array[wp.int32],
    base: int,
    sources: wp.array[wp.int32],
) -> None:
    """Gives the inner children of a level their numbers, and lists them as the next level's sources."""
    i = first + wp.tid()
    slot = ends[i] - counts[i]
    children = level.children[i]
    for k in range(8):
        if children[k] >= 0:
            sources[slot] = children[k]
            children[k] = base + slot
            slot += 1
    level.children[i] = children


def build_instance_tree(lower: Any, upper: Any, instances: Any, launcher: Launcher) -> tuple[Any, Any]:
    """An `InstanceTree`, and the object that owns it.

    Args:
        lower: float32 [k, 3], corners of the boxes around the instances, k at least 1.
        upper: Likewise.
        instances: Structured array [k] of `Instance`.
        launcher: Where the rays will run.
    """
    out = InstanceTree()
    corners = launcher.array(lower, wp.vec3), launcher.array(upper, wp.vec3)
    boxes = wp.Bvh(*corners, constructor="sah", leaf_size=1)
    out.instances = launcher.array(instances, Instance)
    if launcher.device.is_cuda:
        out.bvh = boxes.id
        out.nodes, out.children = launcher.zeros(1, vec8), launcher.zeros(1, vec8i)
        out.slots, out.chained = launcher.zeros(1, wp.int32), launcher.zeros(1, wp.int32)
        return out, boxes
    ends, count = _count(boxes.id, 1, launcher)
    out.slots, out.chained = launcher.empty(count, wp.int32), launcher.empty(count, wp.int32)
    launcher.launch(_fill_slots, ends.shape[0] - 1, [boxes.id, ends, out])
    out.nodes, out.children = _wide_nodes(boxes.id, ends, 0, 0, launcher)
    return out, None


def build_tree(points: Any, indices: Any, shift: int, first_node: int, first_block: int, launcher: Launcher) -> Any:
    """The tables of one tree as a `Bvh`, in which nothing else is set; its first node is its root.

    Args:
        points: vec3 [n], on the launcher's device.
        indices: int32 [3 m], m at least 1, within 0 and n - 1.
        shift: Is added to the numbers of the triangles.
        first_node: The number of the first node.
        first_block: That of the first block.
        launcher: Runs it.
    """
    mesh = wp.Mesh(points, indices, bvh_constructor="sah", bvh_leaf_size=_LEAF_SIZE)
    tree = tree_address(mesh, launcher)
    ends, blocks = _count(tree, LANES, launcher)
    bvh = Bvh()
    bvh.blocks = launcher.empty(9 * blocks, vec8)
    bvh.triangles = launcher.empty(blocks, vec8i)
    bvh.chained = launcher.empty(blocks, wp.int32)
    launcher.launch(_fill_blocks, ends.shape[0] - 1, [tree, mesh.points, mesh.indices, ends, shift, bvh])
    bvh.nodes, bvh.children = _wide_nodes(tree, ends, first_node, first_block, launcher)
    return bvh


def tree_address(mesh: Any, launcher: Launcher) -> int:
    """Where Warp's tree over a mesh lies."""
    located = launcher.zeros(1, wp.uint64)
    launcher.launch(_locate, 1, [mesh.id, located])
    return int(located.numpy()[0])


def tree_size(tree: int, launcher: Launcher) -> tuple[int, int]:
    """The root of Warp's tree, and the number of its nodes."""
    about = launcher.zeros(2, wp.int32)
    launcher.launch(_describe, 1, [tree, about])
    root, nodes = about.numpy().tolist()
    return root, nodes


def _count(tree: int, lanes: int, launcher: Launcher) -> tuple[Any, int]:
    """The first block of each node of Warp's tree, if it is a leaf, in blocks of so many lanes; and their number."""
    _, nodes = tree_size(tree, launcher)
    counts, ends = launcher.zeros(nodes, wp.int32), launcher.zeros(nodes + 1, wp.int32)
    launcher.launch(_count_blocks, nodes, [tree, lanes, counts])
    wp.utils.array_scan(counts, ends[1:], inclusive=True)
    return ends, int(ends[nodes:].numpy()[0])


def _wide_nodes(tree: int, first_block: Any, node_base: int, block_base: int, launcher: Launcher) -> tuple[Any, Any]:
    """Nodes and children of the wide tree, level by level."""
    levels, base = [], node_base
    sources = launcher.array([tree_size(tree, launcher)[0]], wp.int32)
    while sources.shape[0] > 0:
        size = sources.shape[0]
        base += size
        level = Bvh()
        level.nodes, level.children = launcher.empty(6 * size, vec8), launcher.empty(size, vec8i)
        inner, inner_ends = launcher.empty(size, wp.int32), launcher.empty(size, wp.int32)
        launcher.launch(_collapse, size, [tree, sources, first_block, block_base, level, inner])
        wp.utils.array_scan(inner, inner_ends, inclusive=True)
        sources = launcher.empty(int(inner_ends.numpy()[-1]), wp.int32)
        launcher.launch(_number, size, [level, inner_ends, inner, base, sources])
        levels.append(level)
    nodes = concatenated([level.nodes for level in levels], vec8, launcher)
    return nodes, concatenated([level.children for level in levels], vec8i, launcher)


def concatenated(arrays: Sequence[Any], dtype: Any, launcher: Launcher) -> Any:
    """One array of several."""
    if len(arrays) == 1:
        return arrays[0]
    out = launcher.empty(sum(array.shape[0] for array in arrays), dtype)
    row = 0
    for array in arrays:
        wp.copy(out, array, dest_offset=row)
        row += array.shape[0]
    return out
