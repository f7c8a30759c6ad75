"""The BVHs of a scene's geometry, one tree per batch of meshes: built, refit when points move, joined to worlds."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_ir.bvh.build import build_wide_tree, concatenate, root_and_node_count, warp_tree_address
from warp_ir.bvh.node_layout import Bvh, MeshTree, empty_rows, vec8, vec8i
from warp_ir.bvh.refit import node_box, refit_tree, warp_tree_cost, wide_tree_cost
from warp_ir.bvh.top_level import build_top_level
from warp_ir.device.launcher import Launcher, copy_record

wp.set_module_options({"enable_backward": False})

MAX_COST_RATIO = 1.5
"""A refit tree is rebuilt when its cost, the expected number of boxes that a ray tests, exceeds that of the freshly
built tree by more than this factor."""
_TABLES = {
    "nodes": (vec8, 6),
    "children": (vec8i, 1),
    "blocks": (vec8, 9),
    "triangles": (vec8i, 1),
    "continues": (wp.int32, 1),
}
"""The tables of a wide tree: element type, and rows per node or block."""


@dataclass
class _Tree:
    triangle_offset: int
    nodes: range
    blocks: range
    mesh: wp.Mesh | None
    """The tree on CUDA; None on the CPU."""
    built_cost: float | None = None
    """Cost when it was built; None: not measured yet, since it has never been refit."""


class BvhForest:
    """BVHs over batches of triangles, numbered from 0, in tables that they share."""

    def __init__(self, launcher: Launcher) -> None:
        """Starts without trees."""
        self._launcher = launcher
        self._trees: list[_Tree] = []
        self._bvh = Bvh()
        self._bvh.meshes = launcher.zeros(1, MeshTree)
        for name, (dtype, _) in _TABLES.items():
            setattr(self._bvh, name, launcher.zeros(1, dtype))

    def build(self, batches: Sequence[tuple[wp.array[wp.vec3], wp.array[wp.int32], int]], keep_count: int = 0) -> None:
        """Builds one tree per batch, numbered from `keep_count` on, in place of all trees from that number on.

        Args:
            batches: points, vec3 [n], and indices, int32 [3 m], on the launcher's device, m at least 1, within 0 and
                n - 1; and the offset from the batch's triangles to their numbers in the scene, 0 for a prototype.
            keep_count: Number of trees that stay.
        """
        del self._trees[keep_count:]
        if self._launcher.device.is_cuda:
            for points, indices, triangle_offset in batches:
                mesh = wp.Mesh(points, indices, bvh_constructor="sah", bvh_leaf_size=2)
                self._trees.append(_Tree(triangle_offset, range(0), range(0), mesh))
            return
        node, block = self._table_ends()
        tables = []
        if keep_count:
            tables.append(self._table_views(range(node), range(block)))
        for points, indices, triangle_offset in batches:
            table = build_wide_tree(points, indices, triangle_offset, node, block, self._launcher)
            nodes = range(node, node + table.children.shape[0])
            blocks = range(block, block + table.continues.shape[0])
            self._trees.append(_Tree(triangle_offset, nodes, blocks, None))
            tables.append(table)
            node, block = nodes.stop, blocks.stop
        for name, (dtype, _) in _TABLES.items():
            setattr(self._bvh, name, concatenate([getattr(table, name) for table in tables], dtype, self._launcher))

    def refit(
        self,
        number: int,
        points: wp.array[wp.vec3],
        indices: wp.array[wp.int32],
        point_rows: range,
        first_triangle: int,
    ) -> bool:
        """Updates a tree's triangles and boxes to the current points; its topology stays.

        Args:
            number: The tree.
            points: vec3, the scene's.
            indices: int32 [3 m], the scene's.
            point_rows: The rows of the tree's points.
            first_triangle: The row of the tree's first triangle in `indices`.

        Returns:
            Whether the tree's cost is still acceptable; if not, it should be rebuilt.
        """
        tree = self._trees[number]
        if tree.built_cost is None:
            tree.built_cost = self._current_cost(tree)
        if tree.mesh is not None:
            tree.mesh.points = wp.clone(points[point_rows.start : point_rows.stop])  # assignment refits Warp's tree
        else:
            row_offset = first_triangle - tree.triangle_offset
            refit_tree(self._bvh, tree.nodes, tree.blocks, points, indices, row_offset, self._launcher)
        return self._current_cost(tree) <= MAX_COST_RATIO * tree.built_cost

    def refit_boxes(
        self,
        number: int,
        points: wp.array[wp.vec3],
        indices: wp.array[wp.int32],
        point_rows: range,
        first_triangle: int,
    ) -> None:
        """As `refit`, by launches alone: nothing is allocated, measured or read back."""
        tree = self._trees[number]
        if tree.mesh is not None:
            wp.copy(tree.mesh.points, points[point_rows.start : point_rows.stop])
            tree.mesh.refit()
        else:
            row_offset = first_triangle - tree.triangle_offset
            refit_tree(self._bvh, tree.nodes, tree.blocks, points, indices, row_offset, self._launcher)

    def ranges(self, number: int) -> tuple[range, range]:
        """Nodes, the root first, and blocks of a wide tree; empty on CUDA."""
        return self._trees[number].nodes, self._trees[number].blocks

    def root(self, number: int) -> int:
        """The value of `Instance.root` for a prototype with this tree."""
        return number if self._trees[number].mesh is not None else self._trees[number].nodes.start

    def join(self, worlds: Sequence[Sequence[int]]) -> list[Bvh]:
        """One `Bvh` per world; a world is a list of trees, joined by a top level if there are several."""
        launcher = self._launcher
        if launcher.device.is_cuda:
            return [self._bvh_of(world, 0) for world in worlds]
        node, block = self._table_ends()
        tables, roots = [self._table_views(range(node), range(block))], []
        for world in worlds:
            if len(world) == 1:
                roots.append(self._trees[world[0]].nodes.start)
                continue
            starts = [self._trees[k].nodes.start for k in world]
            boxes = [node_box(self._bvh, start) for start in starts]
            lower, upper = np.array([b[0] for b in boxes]), np.array([b[1] for b in boxes])
            nodes, children = build_top_level(lower, upper, starts, node)
            top = Bvh()
            top.nodes, top.children = launcher.array(nodes, vec8), launcher.array(children, vec8i)
            tables.append(top)
            roots.append(node)
            node += len(children)
        if len(tables) > 1:
            self._write_top_levels(tables, node)
        return [self._bvh_of(world, root) for world, root in zip(worlds, roots, strict=True)]

    def _write_top_levels(self, tables: Sequence[Bvh], count: int) -> None:
        """Writes the nodes of the top levels, `tables[1:]`, after those of the trees, `tables[0]`: `count` in all."""
        for name in ("nodes", "children"):
            dtype, rows = _TABLES[name]
            current = getattr(self._bvh, name)
            if current.shape[0] != rows * count:
                setattr(self._bvh, name, concatenate([getattr(t, name) for t in tables], dtype, self._launcher))
                continue
            row = getattr(tables[0], name).shape[0]
            for top in tables[1:]:
                wp.copy(current, getattr(top, name), dest_offset=row)
                row += getattr(top, name).shape[0]

    def _bvh_of(self, world: Sequence[int], root: int) -> Bvh:
        out: Bvh = copy_record(self._bvh)
        out.root, out.world_tree_count = root, len(world)
        if self._launcher.device.is_cuda:
            out.root = len(self._trees)
            listed = [*self._trees, *(self._trees[k] for k in world)]
            rows = empty_rows(MeshTree, len(listed))
            rows["mesh"] = [tree.mesh.id for tree in listed if tree.mesh is not None]
            rows["triangle_offset"] = [tree.triangle_offset for tree in listed]
            out.meshes = self._launcher.array(rows, MeshTree)
        return out

    def _table_views(self, nodes: range, blocks: range) -> Bvh:
        """Views of the tables' rows for ranges of nodes and blocks."""
        out = Bvh()
        for name, (_, rows) in _TABLES.items():
            span = nodes if name in ("nodes", "children") else blocks
            setattr(out, name, getattr(self._bvh, name)[rows * span.start : rows * span.stop])
        return out

    def _table_ends(self) -> tuple[int, int]:
        """The numbers of nodes and of blocks of all trees."""
        last = self._trees[-1] if self._trees else _Tree(0, range(0), range(0), None)
        return last.nodes.stop, last.blocks.stop

    def _current_cost(self, tree: _Tree) -> float:
        if tree.mesh is None:
            return wide_tree_cost(self._bvh, tree.nodes, self._launcher)
        address = warp_tree_address(tree.mesh, self._launcher)
        return warp_tree_cost(address, *root_and_node_count(address, self._launcher), self._launcher)
