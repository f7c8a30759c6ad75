"""The trees of a scene's parts: built, moved with their triangles, and brought together."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_ir.bvh.build import build_tree, concatenated, tree_address, tree_size
from warp_ir.bvh.node_layout import Bvh, MeshTree, vec8, vec8i
from warp_ir.bvh.refit import box_of, refit_tree, warp_cost, wide_cost
from warp_ir.bvh.top_level import build_top
from warp_ir.device.launcher import Launcher, copy_record

wp.set_module_options({"enable_backward": False})

WORST_COST = 1.5
"""A tree that has been refit is built anew when a ray meets so many times the boxes that it met when it was built."""
_TABLES = {
    "nodes": (vec8, 6),
    "children": (vec8i, 1),
    "blocks": (vec8, 9),
    "triangles": (vec8i, 1),
    "chained": (wp.int32, 1),
}
"""Of a wide tree: type, and rows per node or block."""


@dataclass
class _Tree:
    shift: int
    nodes: range
    blocks: range
    mesh: Any
    """On CUDA."""
    cost: float | None = None
    """When it was built; None: not measured, since it has not moved."""


class Trees:
    """Trees over parts of a scene, numbered from 0, in tables that they share."""

    def __init__(self, launcher: Launcher) -> None:
        self._launcher = launcher
        self._trees: list[_Tree] = []
        self._bvh = Bvh()
        self._bvh.meshes = launcher.zeros(1, MeshTree)
        for name, (dtype, _) in _TABLES.items():
            setattr(self._bvh, name, launcher.zeros(1, dtype))

    def build(self, parts: Sequence[tuple[Any, Any, int]], keep: int = 0) -> None:
        """Builds trees, which take the numbers from `keep` on; those before stay, those that were after are gone.

        Args:
            parts: points, vec3 [n], and indices, int32 [3 m], on the launcher's device, m at least 1, within 0 and
                n - 1; and what is added to the triangles' numbers, so that in the world they are those of the scene.
            keep: How many trees stay.
        """
        del self._trees[keep:]
        if self._launcher.device.is_cuda:
            for points, indices, shift in parts:
                mesh = wp.Mesh(points, indices, bvh_constructor="sah", bvh_leaf_size=2)
                self._trees.append(_Tree(shift, range(0), range(0), mesh))
            return
        node, block = self._ends()
        tables = []
        if keep:
            tables.append(self._rows(range(node), range(block)))
        for points, indices, shift in parts:
            table = build_tree(points, indices, shift, node, block, self._launcher)
            nodes = range(node, node + table.children.shape[0])
            blocks = range(block, block + table.chained.shape[0])
            self._trees.append(_Tree(shift, nodes, blocks, None))
            tables.append(table)
            node, block = nodes.stop, blocks.stop
        for name, (dtype, _) in _TABLES.items():
            setattr(self._bvh, name, concatenated([getattr(table, name) for table in tables], dtype, self._launcher))

    def move(self, number: int, points: Any, indices: Any, part: range, first: int) -> bool:
        """Takes a tree's triangles to where its points are now, without changing the tree.

        Args:
            number: Of the tree.
            points: vec3, the scene's.
            indices: int32 [3 m], the scene's.
            part: Which of the points are the tree's.
            first: The row of its first triangle in `indices`.

        Returns:
            Whether it is still a good tree; if not, it is to be built anew.
        """
        tree = self._trees[number]
        if tree.cost is None:
            tree.cost = self._cost(tree)
        if tree.mesh is not None:
            tree.mesh.points = wp.clone(points[part.start : part.stop])  # refits it
        else:
            refit_tree(self._bvh, tree.nodes, tree.blocks, points, indices, first - tree.shift, self._launcher)
        return self._cost(tree) <= WORST_COST * tree.cost

    def root(self, number: int) -> int:
        """What `Instance.root` has to be for a prototype that is this tree."""
        return number if self._trees[number].mesh is not None else self._trees[number].nodes.start

    def bring_together(self, worlds: Sequence[Sequence[int]]) -> list[Any]:
        """A `Bvh` for each of several worlds of some of the trees."""
        launcher = self._launcher
        if launcher.device.is_cuda:
            return [self._world(world, 0) for world in worlds]
        node, block = self._ends()
        tables, roots = [self._rows(range(node), range(block))], []
        for world in worlds:
            if len(world) == 1:
                roots.append(self._trees[world[0]].nodes.start)
                continue
            starts = [self._trees[k].nodes.start for k in world]
            boxes = [box_of(self._bvh, start) for start in starts]
            nodes, children = build_top(np.array([b[0] for b in boxes]), np.array([b[1] for b in boxes]), starts, node)
            top = Bvh()
            top.nodes, top.children = launcher.array(nodes, vec8), launcher.array(children, vec8i)
            tables.append(top)
            roots.append(node)
            node += len(children)
        if len(tables) > 1:
            self._append(tables, node)
        return [self._world(world, root) for world, root in zip(worlds, roots, strict=True)]

    def _append(self, tables: Sequence[Any], count: int) -> None:
        """Puts nodes of tops after those of the trees."""
        for name in ("nodes", "children"):
            dtype, rows = _TABLES[name]
            there = getattr(self._bvh, name)
            if there.shape[0] != rows * count:
                setattr(self._bvh, name, concatenated([getattr(t, name) for t in tables], dtype, self._launcher))
                continue
            row = getattr(tables[0], name).shape[0]
            for top in tables[1:]:
                wp.copy(there, getattr(top, name), dest_offset=row)
                row += getattr(top, name).shape[0]

    def _world(self, world: Sequence[int], root: int) -> Any:
        out = copy_record(self._bvh)
        out.root, out.world_count = root, len(world)
        if self._launcher.device.is_cuda:
            out.root = len(self._trees)
            listed = [*self._trees, *(self._trees[k] for k in world)]
            rows = np.zeros(len(listed), MeshTree.numpy_dtype())
            rows["mesh"], rows["shift"] = [tree.mesh.id for tree in listed], [tree.shift for tree in listed]
            out.meshes = self._launcher.array(rows, MeshTree)
        return out

    def _rows(self, nodes: range, blocks: range) -> Any:
        """Views of the tables."""
        out = Bvh()
        for name, (_, rows) in _TABLES.items():
            span = nodes if name in ("nodes", "children") else blocks
            setattr(out, name, getattr(self._bvh, name)[rows * span.start : rows * span.stop])
        return out

    def _ends(self) -> tuple[int, int]:
        last = self._trees[-1] if self._trees else _Tree(0, range(0), range(0), None)
        return last.nodes.stop, last.blocks.stop

    def _cost(self, tree: _Tree) -> float:
        if tree.mesh is None:
            return wide_cost(self._bvh, tree.nodes, self._launcher)
        address = tree_address(tree.mesh, self._launcher)
        return warp_cost(address, *tree_size(address, self._launcher), self._launcher)
