"""Refits a BVH after its points have moved: the topology stays, the boxes follow the triangles.

Rays find the same hits as in a new tree, but test more boxes the more the triangles have changed places. The expected
number is the surface area of all boxes over that of the root's (MacDonald and Booth 1990).
"""

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.bvh.node_layout import INFINITY, Bvh
from warp_ir.bvh.warp_bvh import box_corner
from warp_ir.device.launcher import Launcher

wp.set_module_options({"enable_backward": False, "max_unroll": 0})


@wp.func
def refit_block(bvh: Bvh, block: int, row_offset: int, points: wp.array[wp.vec3], indices: wp.array[wp.int32]) -> None:
    """Reads the corners of a block's triangles again; a triangle's number plus `row_offset` is its row in `indices`."""
    for lane in range(8):
        triangle = bvh.triangles[block][lane]
        if triangle >= 0:
            for corner in range(3):
                p = points[indices[3 * (triangle + row_offset) + corner]]
                for axis in range(3):
                    bvh.blocks[9 * block + 3 * corner + axis][lane] = p[axis]


@wp.func
def is_used(bvh: Bvh, node: int, k: int) -> bool:
    """Whether a node has a k-th child: the box of an unused lane is inverted, its lower corner above the upper one."""
    return bvh.nodes[6 * node][k] <= bvh.nodes[6 * node + 3][k]


@wp.func
def refit_leaf_box(bvh: Bvh, node: int, k: int) -> None:
    """Recomputes the box of a node's k-th child, which is a leaf."""
    lower = wp.vec3(INFINITY)
    upper = wp.vec3(-INFINITY)
    block = ~bvh.children[node][k]
    continues = int(1)
    while continues == 1:
        for lane in range(8):
            if bvh.triangles[block][lane] >= 0:
                for corner in range(3):
                    base = 9 * block + 3 * corner
                    p = wp.vec3(bvh.blocks[base][lane], bvh.blocks[base + 1][lane], bvh.blocks[base + 2][lane])
                    lower = wp.min(lower, p)
                    upper = wp.max(upper, p)
        continues = bvh.continues[block]
        block += 1
    for axis in range(3):
        bvh.nodes[6 * node + axis][k] = lower[axis]
        bvh.nodes[6 * node + 3 + axis][k] = upper[axis]


@wp.func
def refit_inner_box(bvh: Bvh, node: int, k: int) -> None:
    """Recomputes the box of a node's k-th child, an inner node whose boxes are up to date."""
    child = bvh.children[node][k]
    for axis in range(3):
        bvh.nodes[6 * node + axis][k] = wp.min(bvh.nodes[6 * child + axis])
        bvh.nodes[6 * node + 3 + axis][k] = wp.max(bvh.nodes[6 * child + 3 + axis])


@wp.kernel
def _refit_blocks(
    first: int,
    first_block: int,
    row_offset: int,
    points: wp.array[wp.vec3],
    indices: wp.array[wp.int32],
    bvh: Bvh,
) -> None:
    """Reads the corners of a block's triangles again."""
    refit_block(bvh, first_block + first + wp.tid(), row_offset, points, indices)


@wp.kernel
def _refit_leaf_boxes(first: int, first_node: int, bvh: Bvh) -> None:
    """Recomputes the boxes of those children of a node that are leaves."""
    node = first_node + first + wp.tid()
    for k in range(8):
        if bvh.children[node][k] < 0 and is_used(bvh, node, k):
            refit_leaf_box(bvh, node, k)


@wp.kernel
def _refit_inner_boxes(first: int, first_node: int, count: int, bvh: Bvh) -> None:
    """Recomputes the boxes of inner children from the last node to the first: a node is stored before its children."""
    for i in range(count):
        node = first_node + count - 1 - i
        for k in range(8):
            if bvh.children[node][k] >= 0 and is_used(bvh, node, k):
                refit_inner_box(bvh, node, k)


@wp.kernel
def _measure_wide_nodes(first: int, first_node: int, bvh: Bvh, areas: wp.array[wp.float32]) -> None:
    """Half the surface area of the boxes of each node's children, summed."""
    i = first + wp.tid()
    area = float(0.0)
    for k in range(8):
        if bvh.nodes[6 * (first_node + i)][k] <= bvh.nodes[6 * (first_node + i) + 3][k]:
            d = wp.vec3()
            for axis in range(3):
                row = 6 * (first_node + i) + axis
                d[axis] = bvh.nodes[row + 3][k] - bvh.nodes[row][k]
            area += d[0] * d[1] + d[1] * d[2] + d[2] * d[0]
    areas[i] = area


@wp.kernel
def _measure_warp_nodes(first: int, tree: wp.uint64, areas: wp.array[wp.float32]) -> None:
    """Half the surface area of each box of Warp's tree."""
    i = first + wp.tid()
    d = box_corner(tree, i, 1) - box_corner(tree, i, 0)
    areas[i] = d[0] * d[1] + d[1] * d[2] + d[2] * d[0]


def refit_tree(
    bvh: Bvh,
    nodes: range,
    blocks: range,
    points: wp.array[wp.vec3],
    indices: wp.array[wp.int32],
    row_offset: int,
    launcher: Launcher,
) -> None:
    """Updates a wide tree's triangles and boxes to the current points.

    Args:
        bvh: The `Bvh` whose tables hold the tree.
        nodes: The tree's nodes, the root first.
        blocks: The tree's blocks.
        points: vec3, the scene's.
        indices: int32, the scene's.
        row_offset: From the numbers of the tree's triangles to their rows in `indices`.
        launcher: Runs the kernels.
    """
    launcher.launch(_refit_blocks, len(blocks), [blocks.start, row_offset, points, indices, bvh])
    launcher.launch(_refit_leaf_boxes, len(nodes), [nodes.start, bvh])
    launcher.launch(_refit_inner_boxes, 1, [nodes.start, len(nodes), bvh])


def wide_tree_cost(bvh: Bvh, nodes: range, launcher: Launcher) -> float:
    """Expected number of boxes of a wide tree that a ray through the root's box hits, up to a constant factor."""
    areas = launcher.empty(len(nodes), wp.float32)
    launcher.launch(_measure_wide_nodes, len(nodes), [nodes.start, bvh, areas])
    lower, upper = node_box(bvh, nodes.start)
    return _relative_area(areas.numpy(), upper - lower)


def warp_tree_cost(tree: int, root: int, count: int, launcher: Launcher) -> float:
    """Expected number of boxes of Warp's tree of `count` nodes that a ray through the root's box hits."""
    areas = launcher.empty(count, wp.float32)
    launcher.launch(_measure_warp_nodes, count, [tree, areas])
    measured = areas.numpy()
    return float(measured.sum(dtype=np.float64) / max(float(measured[root]), 1.0e-30))


def node_box(bvh: Bvh, node: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Lower and upper corner [3] of the box around a node of a wide tree."""
    rows = bvh.nodes[6 * node : 6 * node + 6].numpy()
    return rows[:3].min(axis=1), rows[3:].max(axis=1)


def _relative_area(areas: npt.NDArray[np.float32], size: npt.NDArray[np.float32]) -> float:
    """The sum of half areas over that of a box of a size [3]."""
    whole = size[0] * size[1] + size[1] * size[2] + size[2] * size[0]
    return float(areas.sum(dtype=np.float64) / max(float(whole), 1.0e-30))
