"""Builds wide BVHs by collapsing Warp's binary ones: nodes of eight children, blocks of eight triangles."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.bvh.node_layout import BVH_WIDTH, INFINITY, NO_TREE, Bvh, Instance, InstanceTree, vec8, vec8i
from warp_ir.bvh.warp_bvh import box_corner, child_or_range, is_leaf, node_count, primitive_at, root_node, tree_of_mesh
from warp_ir.device.launcher import Launcher

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_LEAF_SIZE = 8
"""Triangles that Warp's builder puts in a leaf: one block."""


@wp.kernel
def _find_tree(first: int, mesh: wp.uint64, out: wp.array[wp.uint64]) -> None:
    """Writes the address of Warp's tree over a mesh."""
    out[0] = tree_of_mesh(mesh)


@wp.kernel
def _read_root_and_node_count(first: int, tree: wp.uint64, out: wp.array[wp.int32]) -> None:
    """Writes the root and the number of nodes of Warp's tree."""
    out[0] = root_node(tree)
    out[1] = node_count(tree)


@wp.kernel
def _count_blocks(first: int, tree: wp.uint64, lanes: int, counts: wp.array[wp.int32]) -> None:
    """Counts the blocks of `lanes` primitives that a node of Warp's tree needs: none if it is an inner node."""
    node = first + wp.tid()
    counts[node] = 0
    if is_leaf(tree, node) == 1:
        counts[node] = (child_or_range(tree, node, 1) - child_or_range(tree, node, 0) + lanes - 1) // lanes


@wp.kernel
def _fill_leaf_instances(first: int, tree: wp.uint64, first_rows: wp.array[wp.int32], instances: InstanceTree) -> None:
    """Writes a leaf's instances to consecutive rows."""
    node = first + wp.tid()
    if is_leaf(tree, node) == 0:
        return
    begin = child_or_range(tree, node, 0)
    end = child_or_range(tree, node, 1)
    for i in range(begin, end):
        instances.leaf_instances[first_rows[node] + i - begin] = primitive_at(tree, i)
        instances.continues[first_rows[node] + i - begin] = wp.where(i + 1 < end, 1, 0)


@wp.kernel
def _fill_blocks(
    first: int,
    tree: wp.uint64,
    points: wp.array[wp.vec3],
    indices: wp.array[wp.int32],
    first_blocks: wp.array[wp.int32],
    triangle_offset: int,
    bvh: Bvh,
) -> None:
    """Writes a leaf's triangles to blocks; unused lanes hold a degenerate triangle, which no ray hits."""
    node = first + wp.tid()
    if is_leaf(tree, node) == 0:
        return
    begin = child_or_range(tree, node, 0)
    end = child_or_range(tree, node, 1)
    block = first_blocks[node]
    while begin < end:
        for lane in range(8):
            triangle = int(-1)
            if begin + lane < end:
                triangle = primitive_at(tree, begin + lane)
            for corner in range(3):
                p = wp.vec3(0.0)
                if triangle >= 0:
                    p = points[indices[3 * triangle + corner]]
                for axis in range(3):
                    bvh.blocks[9 * block + 3 * corner + axis][lane] = p[axis]
            bvh.triangles[block][lane] = wp.where(triangle >= 0, triangle + triangle_offset, -1)
        begin += BVH_WIDTH
        bvh.continues[block] = wp.where(begin < end, 1, 0)
        block += 1


@wp.func
def _half_area(tree: wp.uint64, node: int) -> float:
    """Half the surface area of a node's box."""
    d = box_corner(tree, node, 1) - box_corner(tree, node, 0)
    return d[0] * d[1] + d[1] * d[2] + d[2] * d[0]


@wp.kernel
def _collapse(
    first: int,
    tree: wp.uint64,
    binary_nodes: wp.array[wp.int32],
    first_blocks: wp.array[wp.int32],
    base: int,
    level: Bvh,
    counts: wp.array[wp.int32],
) -> None:
    """Collapses a binary node to a wide one: replaces the child of largest area by its two until there are eight.

    Inner children are left as binary nodes for `_number_children`; `counts` is their number.
    """
    i = first + wp.tid()
    chosen = vec8i(-1)
    chosen[0] = binary_nodes[i]
    size = int(1)
    to_open = int(0)
    while to_open >= 0:
        node = chosen[to_open]
        if is_leaf(tree, node) == 0:
            chosen[to_open] = child_or_range(tree, node, 0)
            chosen[size] = child_or_range(tree, node, 1)
            size += 1
        to_open = int(-1)
        largest = float(-1.0)
        if size < BVH_WIDTH:
            for k in range(size):
                if is_leaf(tree, chosen[k]) == 0 and _half_area(tree, chosen[k]) > largest:
                    largest = _half_area(tree, chosen[k])
                    to_open = k
    inner = int(0)
    for k in range(8):
        lower = wp.vec3(INFINITY)
        upper = wp.vec3(-INFINITY)
        if k < size:
            lower = box_corner(tree, chosen[k], 0)
            upper = box_corner(tree, chosen[k], 1)
            if is_leaf(tree, chosen[k]) == 1:
                chosen[k] = ~(base + first_blocks[chosen[k]])
            else:
                inner += 1
        for axis in range(3):
            level.nodes[6 * i + axis][k] = lower[axis]
            level.nodes[6 * i + 3 + axis][k] = upper[axis]
    level.children[i] = chosen
    counts[i] = inner


@wp.kernel
def _number_children(
    first: int,
    level: Bvh,
    ends: wp.array[wp.int32],
    counts: wp.array[wp.int32],
    base: int,
    binary_nodes: wp.array[wp.int32],
) -> None:
    """Numbers the inner children of a level from `base` on, and lists them as the binary nodes of the next level."""
    i = first + wp.tid()
    slot = ends[i] - counts[i]
    children = level.children[i]
    for k in range(8):
        if children[k] >= 0:
            binary_nodes[slot] = children[k]
            children[k] = base + slot
            slot += 1
    level.children[i] = children


def build_instance_tree(
    lower: npt.NDArray[np.float32], upper: npt.NDArray[np.float32], instances: npt.NDArray[np.void], launcher: Launcher
) -> "tuple[InstanceTree, wp.Bvh | None]":
    """An `InstanceTree`, and Warp's BVH that must outlive it on CUDA.

    Args:
        lower: Lower corners [k, 3] of the boxes around the instances, k at least 1.
        upper: Upper corners [k, 3].
        instances: Structured array [k] of `Instance`.
        launcher: Launcher of the device on which rays are traced.
    """
    out = InstanceTree()
    corners = launcher.array(lower, wp.vec3), launcher.array(upper, wp.vec3)
    boxes = wp.Bvh(*corners, constructor="sah", leaf_size=1)
    out.instances = launcher.array(instances, Instance)
    if launcher.device.is_cuda:
        out.bvh, out.root, out.shared_root = boxes.id, -1, NO_TREE
        out.nodes, out.children = launcher.zeros(1, vec8), launcher.zeros(1, vec8i)
        out.leaf_instances, out.continues = launcher.zeros(1, wp.int32), launcher.zeros(1, wp.int32)
        return out, boxes
    first_rows, count = _first_blocks(boxes.id, 1, launcher)
    out.leaf_instances, out.continues = launcher.empty(count, wp.int32), launcher.empty(count, wp.int32)
    launcher.launch(_fill_leaf_instances, first_rows.shape[0] - 1, [boxes.id, first_rows, out])
    out.nodes, out.children = _collapse_levels(boxes.id, first_rows, 0, 0, launcher)
    return out, None


def build_wide_tree(
    points: wp.array[wp.vec3],
    indices: wp.array[wp.int32],
    triangle_offset: int,
    first_node: int,
    first_block: int,
    launcher: Launcher,
) -> Bvh:
    """The tables of one wide tree, in a `Bvh` whose other fields are unset; the first node is the root.

    Args:
        points: vec3 [n], on the launcher's device.
        indices: int32 [3 m], m at least 1, within 0 and n - 1.
        triangle_offset: Added to the numbers of the triangles.
        first_node: Number of the first node.
        first_block: Number of the first block.
        launcher: Runs the kernels.
    """
    mesh = wp.Mesh(points, indices, bvh_constructor="sah", bvh_leaf_size=_LEAF_SIZE)
    tree = warp_tree_address(mesh, launcher)
    first_blocks, blocks = _first_blocks(tree, BVH_WIDTH, launcher)
    bvh = Bvh()
    bvh.blocks = launcher.empty(9 * blocks, vec8)
    bvh.triangles = launcher.empty(blocks, vec8i)
    bvh.continues = launcher.empty(blocks, wp.int32)
    nodes = first_blocks.shape[0] - 1
    launcher.launch(_fill_blocks, nodes, [tree, mesh.points, mesh.indices, first_blocks, triangle_offset, bvh])
    bvh.nodes, bvh.children = _collapse_levels(tree, first_blocks, first_node, first_block, launcher)
    return bvh


def warp_tree_address(mesh: wp.Mesh, launcher: Launcher) -> int:
    """The address of Warp's tree over a mesh."""
    address = launcher.zeros(1, wp.uint64)
    launcher.launch(_find_tree, 1, [mesh.id, address])
    return int(address.numpy()[0])


def root_and_node_count(tree: int, launcher: Launcher) -> tuple[int, int]:
    """The root of Warp's tree, and the number of its nodes."""
    pair = launcher.zeros(2, wp.int32)
    launcher.launch(_read_root_and_node_count, 1, [tree, pair])
    root, nodes = pair.numpy().tolist()
    return root, nodes


def _first_blocks(tree: int, lanes: int, launcher: Launcher) -> tuple[wp.array[wp.int32], int]:
    """The first block of each leaf, by node of Warp's tree [nodes + 1], in blocks of `lanes` primitives; their number.

    Entries of inner nodes are unused.
    """
    _, nodes = root_and_node_count(tree, launcher)
    counts, ends = launcher.zeros(nodes, wp.int32), launcher.zeros(nodes + 1, wp.int32)
    launcher.launch(_count_blocks, nodes, [tree, lanes, counts])
    wp.utils.array_scan(counts, ends[1:], inclusive=True)
    return ends, int(ends[nodes:].numpy()[0])


def _collapse_levels(
    tree: int, first_blocks: wp.array[wp.int32], node_base: int, block_base: int, launcher: Launcher
) -> tuple[wp.array[vec8], wp.array[vec8i]]:
    """Nodes and children of the wide tree, level by level from the root, numbered from the bases on."""
    levels, base = [], node_base
    binary_nodes = launcher.array([root_and_node_count(tree, launcher)[0]], wp.int32)
    while binary_nodes.shape[0] > 0:
        size = binary_nodes.shape[0]
        base += size
        level = Bvh()
        level.nodes, level.children = launcher.empty(6 * size, vec8), launcher.empty(size, vec8i)
        inner, inner_ends = launcher.empty(size, wp.int32), launcher.empty(size, wp.int32)
        launcher.launch(_collapse, size, [tree, binary_nodes, first_blocks, block_base, level, inner])
        wp.utils.array_scan(inner, inner_ends, inclusive=True)
        binary_nodes = launcher.empty(int(inner_ends.numpy()[-1]), wp.int32)
        launcher.launch(_number_children, size, [level, inner_ends, inner, base, binary_nodes])
        levels.append(level)
    nodes = concatenate([level.nodes for level in levels], vec8, launcher)
    return nodes, concatenate([level.children for level in levels], vec8i, launcher)


def concatenate(arrays: Sequence[wp.array[Any]], dtype: Any, launcher: Launcher) -> wp.array[Any]:
    """Device arrays of one Warp type joined to one; a single array is returned itself."""
    if len(arrays) == 1:
        return arrays[0]
    out = launcher.empty(sum(array.shape[0] for array in arrays), dtype)
    row = 0
    for array in arrays:
        wp.copy(out, array, dest_offset=row)
        row += array.shape[0]
    return out
