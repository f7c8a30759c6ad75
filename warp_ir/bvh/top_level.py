"""A small BVH over the boxes of whole trees: it joins them, and each can be refit or rebuilt by itself.

It has at most two levels of nodes, for up to 64 trees; the size of the traversal stack relies on that.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

_WIDTH = 8


def build_top_level(
    lower: npt.NDArray[np.floating], upper: npt.NDArray[np.floating], roots: Sequence[int], first_node: int
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]:
    """Nodes float32 [6 k, 8] and children int32 [k, 8] of a wide tree, numbered from `first_node` on, the root first.

    Args:
        lower: Lower corners [n, 3] of the boxes, 2 <= n <= 64.
        upper: Upper corners [n, 3].
        roots: The root node of each box's tree, [n].
        first_node: Number of the first new node.
    """
    assert len(lower) <= _WIDTH**2
    nodes: list[npt.NDArray[np.float32]] = []
    children: list[npt.NDArray[np.int32]] = []

    def add_node(members: npt.NDArray[np.int64]) -> int:
        number = len(nodes)
        box = np.full((6, _WIDTH), 3.0e38, np.float32)
        box[3:] = -3.0e38
        child = np.full(_WIDTH, -1, np.int32)
        nodes.append(box)
        children.append(child)
        for lane, group in enumerate(_split(lower, upper, members)):
            box[:3, lane], box[3:, lane] = lower[group].min(axis=0), upper[group].max(axis=0)
            child[lane] = roots[group[0]] if len(group) == 1 else add_node(group)
        return number + first_node

    add_node(np.arange(len(lower)))
    return np.concatenate(nodes), np.stack(children)


def _split(
    lower: npt.NDArray[np.floating], upper: npt.NDArray[np.floating], members: npt.NDArray[np.int64]
) -> list[npt.NDArray[np.int64]]:
    """At most eight groups of boxes: the largest group is halved along its longest axis until there are eight."""
    groups = [members]
    while len(groups) < min(_WIDTH, len(members)):
        k = int(np.argmax([len(group) for group in groups]))
        group = groups.pop(k)
        centre = lower[group] + upper[group]
        axis = int(np.argmax(np.ptp(centre, axis=0)))
        order = group[np.argsort(centre[:, axis], kind="stable")]
        groups += [order[: len(order) // 2], order[len(order) // 2 :]]
    return groups
