"""The triangle tables and BVHs on the device: reused, refit or rebuilt when another scene follows."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.bvh import Bvh, BvhForest, TwoLevel
from warp_ir.device.launcher import Launcher
from warp_ir.device_scene.corner_attributes import corner_tables
from warp_ir.device_scene.frame import DeviceFrame
from warp_ir.device_scene.geometry_storage import GeometryLayout, MeshBatch
from warp_ir.device_scene.growing_table import GrowingTable
from warp_ir.device_scene.instance_tables import InstanceTables, upload_instances
from warp_ir.device_scene.material_tables import LARGEST_UV, upload_materials
from warp_ir.device_scene.scene_data import INSTANCE_COLOR, SceneData, SurfaceTextures
from warp_ir.scene import Floats, Mesh, Scene, Texture
from warp_ir.texture import TextureTable, upload_textures

_TYPES = {
    "points": wp.vec3,
    "indices": wp.int32,
    "triangle_material": wp.int32,
    "triangle_mesh": wp.int32,
    "emits_back": wp.int32,
    "triangle_normals": wp.int32,
    "corner_normals": wp.vec3,
    "triangle_colors": wp.int32,
    "corner_colors": wp.vec3,
    "triangle_uvs": wp.int32,
    "corner_uvs": wp.vec2,
    "triangle_tangents": wp.int32,
    "corner_tangents": wp.vec3,
}
_CORNER_TABLES = ("corner_normals", "corner_colors", "corner_uvs", "corner_tangents")
_TEXTURE_TABLES = ("triangle_uvs", "corner_uvs", "triangle_tangents", "corner_tangents")
"""The tables that belong to `SurfaceTextures`; the others belong to `SceneData`."""


class DeviceGeometry:
    """The surfaces of a scene's shutter samples on a device; owns what the records refer to by id."""

    def __init__(self, launcher: Launcher) -> None:
        """Starts empty; `update` has to be called before `fill`."""
        self._launcher = launcher
        self._forest = BvhForest(launcher)
        self._tables: dict[str, GrowingTable] = {}
        self._layout: GeometryLayout | None = None
        self._moving: set[str] = set()  # names of meshes that have moved
        self._frame: DeviceFrame | None = None
        self._uv_sets: list[str] = []
        self._textures: tuple[list[Texture], TextureTable] | None = None
        self._instances: list[InstanceTables] = []  # of the samples filled since the last update
        self._previous_instances: list[InstanceTables] = []
        self._bvhs: list[Bvh] = []  # one per shutter sample
        self.version = 0
        """Number of updates that have changed what was stored."""

    def update(self, scenes: Sequence[tuple[Scene, list[int]]], frame: DeviceFrame) -> None:
        """Uploads the geometry of a scene's shutter samples, as far as it differs from what is stored.

        Args:
            scenes: What `storage_order` returns for each shutter sample.
            frame: The device's frame.
        """
        uv_sets = list(dict.fromkeys(t.uv for scene, _ in scenes for m in scene.materials for t in m.textures))
        layout, previous = GeometryLayout(scenes, frame, self._moving), self._layout
        comparable = self._frame is not None and frame.equals(self._frame) and uv_sets == self._uv_sets
        if not (comparable and previous is not None and _same_batches(previous.static_batches, layout.static_batches)):
            if previous is not None:
                present = {id(mesh) for scene, _ in scenes for mesh in scene.meshes}
                self._moving |= {m.name for b in previous.static_batches for m in b.meshes if id(m) not in present}
                layout = GeometryLayout(scenes, frame, self._moving)
            self._frame, self._uv_sets = frame, uv_sets
            self._upload_all(layout)
        elif not _same_batches(previous.moving_batches, layout.moving_batches) or (
            len(previous.samples) != len(layout.samples)
        ):
            self._upload_moving(previous, layout)
        elif _mesh_indices(previous) != _mesh_indices(layout):
            self._upload_mesh_indices(layout)
        self._layout = layout
        self._previous_instances, self._instances = self._instances, []

    def fill(self, sample: int, data: SceneData) -> tuple[object, ...]:
        """Sets the geometry and materials of a shutter sample in a `SceneData`; returns the owners of its ids."""
        assert self._layout is not None and self._frame is not None
        launcher, stored = self._launcher, self._layout.samples[sample]
        data.triangle_count = self._layout.triangle_count
        for name in _TYPES:
            if name not in _TEXTURE_TABLES:
                setattr(data, name, self._tables[name].array)
        surface_textures = upload_materials(stored.scene.materials, self._texture_table, data, launcher)
        for name in _TEXTURE_TABLES:
            setattr(surface_textures, name, self._tables[name].array)
        data.surface_textures = launcher.array([surface_textures], SurfaceTextures)
        data.bvh = self._bvhs[sample]
        roots = [self._forest.root(batch.tree) for batch in stored.prototypes]
        reusable = [*self._instances, *self._previous_instances]
        instances = upload_instances(stored, self._frame, roots, reusable, launcher)
        if instances not in self._instances:
            self._instances.append(instances)
        data.instance_count, data.instances = instances.count, instances.tree.instances
        data.instance_axes, data.instance_colors = instances.axes, instances.colors
        two_level = TwoLevel()
        two_level.bvh, two_level.tree = data.bvh, instances.tree
        data.two_level = launcher.array([two_level], TwoLevel)
        return self, surface_textures, instances, two_level

    def prototypes(self, sample: int) -> list[MeshBatch]:
        """The batch of each `Instances` of a shutter sample."""
        assert self._layout is not None
        return self._layout.samples[sample].prototypes

    def prototype_roots(self, sample: int) -> list[int]:
        """`Instance.root` of each `Instances` of a shutter sample."""
        return [self._forest.root(batch.tree) for batch in self.prototypes(sample)]

    def tree_ranges(self, batch: MeshBatch) -> tuple[range, range]:
        """Nodes, the root first, and blocks of a batch's wide tree."""
        return self._forest.ranges(batch.tree)

    def refit_boxes(self, batch: MeshBatch) -> None:
        """Refits the tree of a batch whose points have changed on the device."""
        points, indices = self._tables["points"].array, self._tables["indices"].array
        self._forest.refit_boxes(batch.tree, points, indices, batch.point_rows, batch.triangle_rows.start)

    def first_triangles(self, sample: int) -> list[int]:
        """The row of the first triangle of each mesh of a shutter sample, in storage order; -1: the mesh has none."""
        assert self._layout is not None
        return self._layout.samples[sample].first_triangles()

    def _upload_all(self, layout: GeometryLayout) -> None:
        """Uploads all tables and builds all trees."""
        self.version += 1
        static = self._host_tables(layout.static_batches, dict.fromkeys(_CORNER_TABLES, 0))
        moving = self._host_tables(layout.moving_batches, {name: len(static[name]) for name in _CORNER_TABLES})
        self._tables = {
            name: GrowingTable(static[name], moving[name], dtype, self._launcher) for name, dtype in _TYPES.items()
        }
        self._build_trees(layout, [*layout.static_batches, *layout.moving_batches], 0)

    def _upload_moving(self, previous: GeometryLayout, layout: GeometryLayout) -> None:
        """Replaces the moving rows; refits their trees if the triangles are the same, and rebuilds them otherwise."""
        self.version += 1
        first = {name: self._tables[name].static_count for name in _CORNER_TABLES}
        moving = self._host_tables(layout.moving_batches, first)
        for name, table in self._tables.items():
            table.replace_moving(moving[name])
        if _mesh_indices(previous) != _mesh_indices(layout):
            self._upload_mesh_indices(layout)
        old, new = previous.moving_batches, layout.moving_batches
        if len(old) != len(new) or not all(b.can_refit(a) for b, a in zip(new, old, strict=True)):
            self._build_trees(layout, new, layout.static_tree_count)
            return
        degraded = [
            b.tree
            for b, a in zip(new, old, strict=True)
            if not (b.shares_geometry or same_objects(b.meshes, a.meshes) or self._refit(b))
        ]
        if degraded:
            self._build_trees(layout, [b for b in new if b.tree >= min(degraded)], min(degraded))
        else:
            self._join_trees(layout)

    def _refit(self, batch: MeshBatch) -> bool:
        """Refits a batch's tree; returns whether its cost is still acceptable."""
        points, indices = self._tables["points"].array, self._tables["indices"].array
        return self._forest.refit(batch.tree, points, indices, batch.point_rows, batch.triangle_rows.start)

    def _build_trees(self, layout: GeometryLayout, batches: Sequence[MeshBatch], keep_count: int) -> None:
        """Builds the trees of batches; the first `keep_count` trees stay."""
        launcher = self._launcher
        points, indices = self._tables["points"].array, self._tables["indices"].array
        inputs = []
        for batch in batches:
            if not batch.shares_geometry:
                own = indices[3 * batch.triangle_rows.start : 3 * batch.triangle_rows.stop]
                if batch.point_rows.start:
                    own = launcher.array(own.numpy() - batch.point_rows.start, wp.int32)
                triangle_offset = batch.triangle_rows.start if batch.half_extent is None else 0
                inputs.append((points[batch.point_rows.start : batch.point_rows.stop], own, triangle_offset))
        if not all(sample.world for sample in layout.samples):
            # An empty mesh crashes Warp; a degenerate triangle, three equal points, is never hit.
            inputs.append((launcher.zeros(3, wp.vec3), launcher.array([0, 1, 2], wp.int32), 0))
        self._forest.build(inputs, keep_count)
        self._join_trees(layout)

    def _join_trees(self, layout: GeometryLayout) -> None:
        degenerate = [layout.tree_count]
        worlds = [[batch.tree for batch in sample.world] or degenerate for sample in layout.samples]
        self._bvhs = self._forest.join(worlds)

    def _upload_mesh_indices(self, layout: GeometryLayout) -> None:
        """Uploads the index of every triangle's mesh: meshes before it in the user's scene were added or removed."""
        triangle_mesh = _triangle_mesh([*layout.static_batches, *layout.moving_batches])
        if len(triangle_mesh):
            wp.copy(self._tables["triangle_mesh"].array, self._launcher.array(triangle_mesh, wp.int32))

    def _host_tables(self, batches: Sequence[MeshBatch], first: dict[str, int]) -> dict[str, npt.NDArray[np.generic]]:
        """The rows of all tables for batches; `first` are the rows at which their corner tables begin."""
        meshes = [mesh for batch in batches for mesh in batch.meshes]
        counts = [len(mesh.triangles) for mesh in meshes]
        points: list[npt.NDArray[np.float32]] = [np.zeros((0, 3), np.float32)]
        indices: list[npt.NDArray[np.int32]] = [np.zeros(0, np.int32)]
        for batch in batches:
            row = batch.point_rows.start
            for mesh in batch.meshes:
                indices.append((mesh.triangles + np.int32(row)).reshape(-1).astype(np.int32, copy=False))
                if not batch.shares_geometry:
                    on_device = batch.frame.to_device(mesh.points)
                    # Points that no triangle uses are not checked and may be infinite; the bounds need finite ones.
                    on_device[~np.isfinite(on_device).all(axis=1)] = 0.0
                    points.append(on_device)
                row += len(mesh.points)
        out: dict[str, npt.NDArray[np.generic]] = {"points": np.concatenate(points), "indices": np.concatenate(indices)}
        materials = [np.zeros(0, np.int32), *(mesh.material for mesh in meshes)]
        out["triangle_material"] = np.concatenate(materials).astype(np.int32, copy=False)
        out["triangle_mesh"] = _triangle_mesh(batches)
        out["emits_back"] = np.repeat(np.array([mesh.double_sided for mesh in meshes], np.int32), counts)
        for name in ("normals", "colors", "tangents"):
            values = [getattr(mesh, name) for mesh in meshes]
            rows, table = corner_tables(values, counts, first[f"corner_{name}"])
            out[f"triangle_{name}"], out[f"corner_{name}"] = rows, table
        by_instance = [
            mesh.bare if batch.has_instance_colors and mesh.bare is not None else np.zeros(len(mesh.triangles), bool)
            for batch in batches
            for mesh in batch.meshes
        ]
        if by_instance:
            out["triangle_colors"][np.concatenate(by_instance)] = INSTANCE_COLOR
        sets = max(len(self._uv_sets), 1)
        uvs = [self._stacked_uvs(mesh) for mesh in meshes]
        out["triangle_uvs"], out["corner_uvs"] = corner_tables(uvs, counts, first["corner_uvs"], 2, 3 * sets)
        return out

    def _stacked_uvs(self, mesh: Mesh) -> Floats | None:
        """The texture coordinates of a mesh for all uv sets that textures use, [m, sets, 3, 2]; None: it has none."""
        sets = [mesh.uvs.get(name) for name in self._uv_sets]
        if all(s is None for s in sets):
            return None
        zero = np.zeros((len(mesh.triangles), 3, 2), np.float32)
        stacked = np.stack([zero if s is None else s for s in sets], axis=1)
        return np.asarray(stacked, np.float32).clip(-LARGEST_UV, LARGEST_UV)

    def _texture_table(self, textures: list[Texture]) -> TextureTable:
        """The textures on the device; uploaded again only if they are other objects."""
        if self._textures is None or not same_objects(self._textures[0], textures):
            self._textures = textures, upload_textures(textures, self._uv_sets, self._launcher)
        return self._textures[1]


def same_objects(one: Sequence[object], other: Sequence[object]) -> bool:
    """Whether two sequences hold the same objects, by identity."""
    return len(one) == len(other) and all(a is b for a, b in zip(one, other, strict=True))


def _same_batches(one: Sequence[MeshBatch], other: Sequence[MeshBatch]) -> bool:
    """Whether the same meshes are in the same rows, with instance colours alike."""
    return len(one) == len(other) and all(
        same_objects(a.meshes, b.meshes)
        and (a.triangle_rows, a.tree, a.has_instance_colors) == (b.triangle_rows, b.tree, b.has_instance_colors)
        for a, b in zip(one, other, strict=True)
    )


def _mesh_indices(layout: GeometryLayout) -> list[tuple[int, ...]]:
    return [batch.mesh_indices for batch in (*layout.static_batches, *layout.moving_batches)]


def _triangle_mesh(batches: Sequence[MeshBatch]) -> npt.NDArray[np.int32]:
    """The index in the user's scene of each triangle's mesh."""
    indices = [index for batch in batches for index in batch.mesh_indices]
    counts = [len(mesh.triangles) for batch in batches for mesh in batch.meshes]
    return np.repeat(np.array(indices, np.int32), counts)
