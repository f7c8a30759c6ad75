"""The layout of geometry in the device's tables, and which meshes share a BVH.

The tables begin with what is static: all static meshes of the world under one tree, then every static prototype under
its own. What moves follows, once per shutter sample: large meshes under trees of their own, the small ones of the world
under one. So what moves can be overwritten, and its trees refit or rebuilt, without touching the rest.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from warp_ir.device_scene.frame import DeviceFrame, frame_of_box
from warp_ir.scene import Mesh, Scene

_OWN_TREE_TRIANGLES = 1024
"""A moving mesh of at least so many triangles has a tree of its own ..."""
_MAX_OWN_TREES = 31
"""... if it is among so many meshes with most triangles."""


def emissive_meshes(scene: Scene) -> set[int]:
    """Indices of the instanced meshes that emit. They are flattened, for each of their instances is an emitter."""
    emits = np.array([max(m.emission) > 0.0 for m in scene.materials], bool)
    if not emits.any():
        return set()
    return {k for group in scene.instances for k in group.meshes if emits[scene.meshes[k].material].any()}


def storage_order(scene: Scene) -> tuple[Scene, list[int]]:
    """The scene with meshes in the order of storage, and the index that each of them has in `scene`.

    Emissive instances are flattened; meshes of the world come before prototypes; prototypes without triangles are left
    out.
    """
    if not scene.instances:
        return scene, list(range(len(scene.meshes)))
    scene = scene.flat(emissive_meshes(scene))
    groups = [g for g in scene.instances if any(len(scene.meshes[k].triangles) for k in g.meshes)]
    prototypes = [k for g in groups for k in g.meshes]
    empty = {k for g in scene.instances for k in g.meshes} - {*prototypes}
    order = [k for k in range(len(scene.meshes)) if k not in empty and k not in set(prototypes)] + prototypes
    position = {k: i for i, k in enumerate(order)}
    instances = tuple(replace(g, meshes=tuple(position[k] for k in g.meshes)) for g in groups)
    return replace(scene, meshes=tuple(scene.meshes[k] for k in order), instances=instances), order


@dataclass(eq=False)
class MeshBatch:
    """Meshes that are stored together: one frame, contiguous rows, one tree."""

    meshes: tuple[Mesh, ...]
    mesh_indices: tuple[int, ...]
    """Their indices in the user's scene."""
    frame: DeviceFrame
    half_extent: npt.NDArray[np.float64] | None
    """Half the size of a prototype's box [3], in its frame; None: the batch is in the world."""
    has_instance_colors: bool
    """Whether the prototype's instances have colours."""
    point_rows: range
    triangle_rows: range
    tree: int
    """Number of the tree."""
    shares_geometry: bool = False
    """Whether points and tree are those of an earlier prototype, which differs in its look alone."""

    def can_refit(self, other: "MeshBatch") -> bool:
        """Whether `other`'s tree can be refit for this batch: the same rows, tree, and triangles; points may differ."""
        rows = (self.point_rows, self.triangle_rows, self.tree, self.shares_geometry) == (
            other.point_rows,
            other.triangle_rows,
            other.tree,
            other.shares_geometry,
        )
        return rows and all(
            len(a.points) == len(b.points) and (a.triangles is b.triangles or np.array_equal(a.triangles, b.triangles))
            for a, b in zip(self.meshes, other.meshes, strict=True)
        )


@dataclass(eq=False)
class StoredSample:
    """The scene of one shutter sample, and where its geometry is stored."""

    scene: Scene
    """In storage order."""
    mesh_indices: list[int]
    """The index in the user's scene of each mesh."""
    world: list[MeshBatch]
    prototypes: list[MeshBatch]
    """One for each of the scene's `Instances`."""

    def first_triangles(self) -> list[int]:
        """The row of the first triangle of each mesh; -1: the mesh has none."""
        row = dict.fromkeys(range(len(self.mesh_indices)), -1)
        position = {index: k for k, index in enumerate(self.mesh_indices)}
        for batch in (*self.world, *self.prototypes):
            first = batch.triangle_rows.start
            for mesh, index in zip(batch.meshes, batch.mesh_indices, strict=True):
                row[position[index]] = first
                first += len(mesh.triangles)
        return list(row.values())


class GeometryLayout:
    """The batches and rows of the shutter samples of a scene."""

    def __init__(self, scenes: Sequence[tuple[Scene, list[int]]], frame: DeviceFrame, moving: Collection[str]) -> None:
        """Assigns batches, rows and tree numbers.

        Args:
            scenes: What `storage_order` returns for each shutter sample.
            frame: The device's frame.
            moving: Names of meshes that are known to move, even if they are the same in all these samples.
        """
        self._frame = frame
        self.point_count = self.triangle_count = self.tree_count = 0
        units = [_movable_units(scene, mesh_indices) for scene, mesh_indices in scenes]
        static = [
            key
            for key, meshes in units[0].items()
            if all(key in others for others in units[1:]) and not any(mesh.name in moving for mesh in meshes)
        ]
        self.static_batches = self._add_static(units[0], static)
        self.static_tree_count = self.tree_count
        self.moving_batches: list[MeshBatch] = []
        self.samples: list[StoredSample] = []
        for (scene, mesh_indices), own in zip(scenes, units, strict=True):
            moved = {key: meshes for key, meshes in own.items() if key not in set(static)}
            batches = self._add_moving(moved)
            self.moving_batches += batches
            present = [*self.static_batches, *batches]
            prototype_of = {batch.mesh_indices: batch for batch in present if batch.half_extent is not None}
            prototypes = [prototype_of[key[2]] for key in own if key[0]]
            world = [batch for batch in present if batch.half_extent is None]
            self.samples.append(StoredSample(scene, mesh_indices, world, prototypes))

    def _add_static(self, units: "_Units", keys: Sequence["_UnitKey"]) -> list[MeshBatch]:
        world = [key for key in keys if not key[0]]
        batches = [self._add_batch([units[key][0] for key in world], [key[2][0] for key in world])] if world else []
        return batches + self._add_prototypes({key: units[key] for key in keys if key[0]})

    def _add_moving(self, units: "_Units") -> list[MeshBatch]:
        world = [key for key in units if not key[0]]
        by_size = sorted(world, key=lambda key: -len(units[key][0].triangles))
        large = {key for key in by_size[:_MAX_OWN_TREES] if len(units[key][0].triangles) >= _OWN_TREE_TRIANGLES}
        batches = [self._add_batch([units[key][0]], [key[2][0]]) for key in world if key in large]
        small = [key for key in world if key not in large]
        if small:
            batches.append(self._add_batch([units[key][0] for key in small], [key[2][0] for key in small]))
        return batches + self._add_prototypes({key: units[key] for key in units if key[0]})

    def _add_prototypes(self, units: "_Units") -> list[MeshBatch]:
        """One batch per prototype; those of the same geometry share points and tree."""
        known: dict[tuple[int, ...], MeshBatch] = {}
        batches = []
        for key, meshes in units.items():
            geometry = tuple(id(x) for mesh in meshes for x in (mesh.points, mesh.triangles))
            if geometry in known:
                original = known[geometry]
                rows = range(self.triangle_count, self.triangle_count + len(original.triangle_rows))
                self.triangle_count = rows.stop
                batch = replace(
                    original,
                    meshes=tuple(meshes),
                    mesh_indices=key[2],
                    has_instance_colors=key[1],
                    triangle_rows=rows,
                    shares_geometry=True,
                )
                batches.append(batch)
                continue
            corners = [mesh.points[np.unique(mesh.triangles)] for mesh in meshes]
            lower = np.min([c.min(axis=0) for c in corners], axis=0)
            upper = np.max([c.max(axis=0) for c in corners], axis=0)
            frame = frame_of_box(lower, upper)
            half_extent = 0.5 * (upper - lower) * frame.scale
            batch = replace(self._add_batch(meshes, key[2], frame, half_extent), has_instance_colors=key[1])
            batches.append(batch)
            known[geometry] = batch
        return batches

    def _add_batch(
        self,
        meshes: Sequence[Mesh],
        mesh_indices: Sequence[int],
        frame: DeviceFrame | None = None,
        half_extent: npt.NDArray[np.float64] | None = None,
    ) -> MeshBatch:
        points = range(self.point_count, self.point_count + sum(len(m.points) for m in meshes))
        triangles = range(self.triangle_count, self.triangle_count + sum(len(m.triangles) for m in meshes))
        self.point_count, self.triangle_count = points.stop, triangles.stop
        self.tree_count += 1
        tree = self.tree_count - 1
        return MeshBatch(
            tuple(meshes), tuple(mesh_indices), frame or self._frame, half_extent, False, points, triangles, tree
        )


_UnitKey = tuple[bool, bool, tuple[int, ...], tuple[int, ...]]
"""Whether a unit is a prototype, and coloured by its instances; the indices of its meshes, and their ids as objects."""
_Units = dict[_UnitKey, tuple[Mesh, ...]]


def _movable_units(scene: Scene, mesh_indices: Sequence[int]) -> _Units:
    """The units that may move independently: each mesh of the world, each prototype; without empty meshes, in order."""
    instanced = scene.instanced()
    members: list[tuple[bool, bool, tuple[int, ...]]] = []
    members += [(False, False, (k,)) for k in range(len(scene.meshes)) if k not in instanced]
    members += [(True, group.colors is not None, group.meshes) for group in scene.instances]
    out: _Units = {}
    for is_prototype, colored, every in members:
        ks = [k for k in every if len(scene.meshes[k].triangles)]
        if ks:
            meshes = tuple(scene.meshes[k] for k in ks)
            out[is_prototype, colored, tuple(mesh_indices[k] for k in ks), tuple(map(id, meshes))] = meshes
    return out
