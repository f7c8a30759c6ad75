"""A small tree over the boxes of whole trees, so that each of them can change by itself.

Two levels of nodes are room for 64 trees; the walk's stack counts on it.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

_WIDTH = 8


def build_top(
    lower: npt.NDArray[np.floating], upper: npt.NDArray[np.floating], roots: Sequence[int], first_node: int
) -> tuple[Any, Any]:
    """Nodes float32 [6 k, 8] and children int32 [k, 8] of a wide tree, numbered from `first_node` on, the root first.

    Args:
        lower: Lower corners [n, 3] of the boxes, 2 to 64.
        upper: Upper corners.
        roots: What becomes the child where a box is: n nodes.
        first_node: Number of the first node.
    """
    assert len(lower) <= _WIDTH**2
    nodes: list[npt.NDArray[np.float32]] = []
    children: list[npt.NDArray[np.int32]] = []

    def gather(members: npt.NDArray[np.int64]) -> int:
        number = len(nodes)
        box = np.full((6, _WIDTH), 3.0e38, np.float32)
        box[3:] = -3.0e38
        child = np.full(_WIDTH, -1, np.int32)
        nodes.append(box)
        children.append(child)
        for lane, group in enumerate(_parted(lower, upper, members)):
            box[:3, lane], box[3:, lane] = lower[group].min(axis=0), upper[group].max(axis=0)
            child[lane] = roots[group[0]] if len(group) == 1 else gather(group)
        return number + first_node

    gather(np.arange(len(lower)))
    return np.concatenate(nodes), np.stack(children)


def _parted(lower: Any, upper: Any, members: npt.NDArray[np.int64]) -> list[npt.NDArray[np.int64]]:
    """At most eight groups: the largest is halved along its longest side until there are so many."""
    groups = [members]
    while len(groups) < min(_WIDTH, len(members)):
        k = int(np.argmax([len(group) for group in groups]))
        group = groups.pop(k)
        centre = lower[group] + upper[group]
        axis = int(np.argmax(np.ptp(centre, axis=0)))
        order = group[np.argsort(centre[:, axis], kind="stable")]
        groups += [order[: len(order) // 2], order[len(order) // 2 :]]
    return groups
