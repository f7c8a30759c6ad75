"""Trees whose triangles have moved: the same nodes, with the boxes that there are now.

A tree that is refit finds what a new one finds, but the more its triangles have changed places, the more boxes a ray
meets. How many is measured by the surface area of all boxes over that of the whole (MacDonald and Booth 1990).
"""

from typing import Any

import numpy as np
import warp as wp

from warp_ir.bvh.node_layout import INFINITY, Bvh
from warp_ir.bvh.warp_bvh import box_corner
from warp_ir.device.launcher import Launcher

wp.set_module_options({"enable_backward": False, "max_unroll": 0})


@wp.kernel
def _move_blocks(
    first: int,
    first_block: int,
    shift: int,
    points: wp.array[wp.vec3],
    indices: wp.array[wp.int32],
    bvh: Bvh,
) -> None:
    """Fetches the corners of a block's triangles anew; `shift` leads from their numbers to their rows."""
    block = first_block + first + wp.tid()
    for lane in range(8):
        triangle = bvh.triangles[block][lane]
        if triangle >= 0:
            for corner in range(3):
                p = points[indices[3 * (triangle + shift) + corner]]
                for axis in range(3):
                    bvh.blocks[9 * block + 3 * corner + axis][lane] = p[axis]


@wp.kernel
def _fit_leaves(first: int, first_node: int, bvh: Bvh) -> None:
    """The boxes of a node's children that are leaves."""
    node = first_node + first + wp.tid()
    for k in range(8):
        # An empty lane's box is inside out.
        if bvh.children[node][k] < 0 and bvh.nodes[6 * node][k] <= bvh.nodes[6 * node + 3][k]:
            lower = wp.vec3(INFINITY)
            upper = wp.vec3(-INFINITY)
            block = ~bvh.children[node][k]
            more = int(1)
            while more == 1:
                for lane in range(8):
                    if bvh.triangles[block][lane] >= 0:
                        for corner in range(3):
                            base = 9 * block + 3 * corner
                            p = wp.vec3(bvh.blocks[base][lane], bvh.blocks[base + 1][lane], bvh.blocks[base + 2][lane])
                            lower = wp.min(lower, p)
                            upper = wp.max(upper, p)
                more = bvh.chained[block]
                block += 1
            for axis in range(3):
                bvh.nodes[6 * node + axis][k] = lower[axis]
                bvh.nodes[6 * node + 3 + axis][k] = upper[axis]


@wp.kernel
def _fit_nodes(first: int, first_node: int, count: int, bvh: Bvh) -> None:
    """The boxes of all other children: a tree's nodes come after those above them, so backwards in one go."""
    for i in range(count):
        node = first_node + count - 1 - i
        for k in range(8):
            child = bvh.children[node][k]
            if child >= 0 and bvh.nodes[6 * node][k] <= bvh.nodes[6 * node + 3][k]:
                for axis in range(3):
                    bvh.nodes[6 * node + axis][k] = wp.min(bvh.nodes[6 * child + axis])
                    bvh.nodes[6 * node + 3 + axis][k] = wp.max(bvh.nodes[6 * child + 3 + axis])


@wp.kernel
def _measure_nodes(first: int, first_node: int, bvh: Bvh, areas: wp.array[wp.float32]) -> None:
    """Half the surface of the boxes of each node's children."""
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
def _measure_warp_tree(first: int, tree: wp.uint64, areas: wp.array[wp.float32]) -> None:
    """Half the surface of each box of Warp's tree."""
    i = first + wp.tid()
    d = box_corner(tree, i, 1) - box_corner(tree, i, 0)
    areas[i] = d[0] * d[1] + d[1] * d[2] + d[2] * d[0]


def refit_tree(
    bvh: Any, nodes: range, blocks: range, points: Any, indices: Any, shift: int, launcher: Launcher
) -> None:
    """Moves a wide tree's triangles and boxes to where its points are now.

    Args:
        bvh: The `Bvh` in whose tables it is.
        nodes: Which of them, the root first.
        blocks: Which of its blocks.
        points: vec3, the scene's.
        indices: int32, the scene's.
        shift: From the numbers of the tree's triangles to their rows in `indices`.
        launcher: Runs it.
    """
    launcher.launch(_move_blocks, len(blocks), [blocks.start, shift, points, indices, bvh])
    launcher.launch(_fit_leaves, len(nodes), [nodes.start, bvh])
    launcher.launch(_fit_nodes, 1, [nodes.start, len(nodes), bvh])


def wide_cost(bvh: Any, nodes: range, launcher: Launcher) -> float:
    """How many boxes of a wide tree a ray that meets the whole meets on average, but for a factor."""
    areas = launcher.empty(len(nodes), wp.float32)
    launcher.launch(_measure_nodes, len(nodes), [nodes.start, bvh, areas])
    lower, upper = box_of(bvh, nodes.start)
    return _cost(areas.numpy(), upper - lower)


def warp_cost(tree: int, root: int, count: int, launcher: Launcher) -> float:
    """Likewise of Warp's own tree of so many nodes."""
    areas = launcher.empty(count, wp.float32)
    launcher.launch(_measure_warp_tree, count, [tree, areas])
    measured = areas.numpy()
    return float(measured.sum(dtype=np.float64) / max(float(measured[root]), 1.0e-30))


def box_of(bvh: Any, node: int) -> tuple[Any, Any]:
    """Lower and upper corner [3] of the box around a wide tree's node."""
    rows = bvh.nodes[6 * node : 6 * node + 6].numpy()
    return rows[:3].min(axis=1), rows[3:].max(axis=1)


def _cost(areas: Any, size: Any) -> float:
    whole = size[0] * size[1] + size[1] * size[2] + size[2] * size[0]
    return float(areas.sum(dtype=np.float64) / max(float(whole), 1.0e-30))
