"""The tables of triangles, and what rays find them by: kept, moved or made anew as scenes follow each other."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.bvh import Trees, TwoLevel
from warp_ir.device.launcher import Launcher
from warp_ir.device_scene.corner_attributes import corner_tables
from warp_ir.device_scene.frame import DeviceFrame
from warp_ir.device_scene.geometry_storage import Layout, Part
from warp_ir.device_scene.growing_table import Table
from warp_ir.device_scene.instance_tables import InstanceTables, upload_instances
from warp_ir.device_scene.material_tables import LARGEST_UV, upload_materials
from warp_ir.device_scene.scene_data import INSTANCE_COLOR, SurfaceTextures
from warp_ir.scene import Scene, Texture
from warp_ir.texture import upload_textures

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
_CORNERS = ("corner_normals", "corner_colors", "corner_uvs", "corner_tangents")
_PATTERNS = ("triangle_uvs", "corner_uvs", "triangle_tangents", "corner_tangents")
"""Those that are for textures."""


class DeviceGeometry:
    """The surfaces of a scene's moments on a device; owns what the records refer to by id."""

    def __init__(self, launcher: Launcher) -> None:
        """Empty: `take` comes first."""
        self._launcher = launcher
        self._trees = Trees(launcher)
        self._tables: dict[str, Table] = {}
        self._layout: Layout | None = None
        self._moving: set[str] = set()
        self._frame: DeviceFrame | None = None
        self._uv_sets: list[str] = []
        self._textures: tuple[list[Texture], Any] | None = None
        self._instances: list[InstanceTables] = []
        self._former: list[InstanceTables] = []
        self._bvhs: list[Any] = []
        self.changes = 0
        """How often `take` has changed what was there."""

    def take(self, scenes: Sequence[tuple[Scene, list[int]]], frame: DeviceFrame) -> None:
        """Brings the moments of a scene onto the device, and keeps of what is there all that is the same.

        Args:
            scenes: As `storage.storage_order` gives them.
            frame: Of the device.
        """
        uv_sets = list(dict.fromkeys(t.uv for scene, _ in scenes for m in scene.materials for t in m.textures))
        layout, before = Layout(scenes, frame, self._moving), self._layout
        kept = self._frame is not None and frame.equals(self._frame) and uv_sets == self._uv_sets
        if not (kept and before is not None and _same_parts(before.head, layout.head)):
            if before is not None:
                there = {id(mesh) for scene, _ in scenes for mesh in scene.meshes}
                self._moving |= {m.name for part in before.head for m in part.meshes if id(m) not in there}
                layout = Layout(scenes, frame, self._moving)
            self._frame, self._uv_sets = frame, uv_sets
            self._build(layout)
        elif not _same_parts(before.tail, layout.tail) or len(before.moments) != len(layout.moments):
            self._change(before, layout)
        elif self._numbers(before) != self._numbers(layout):
            self._number(layout)
        self._layout = layout
        self._former, self._instances = self._instances, []

    def fill(self, moment: int, data: Any) -> Any:
        """Sets what a `SceneData` says of surfaces; returns the owner of what it refers to by id."""
        assert self._layout is not None
        launcher, here = self._launcher, self._layout.moments[moment]
        data.triangle_count = self._layout.triangle_count
        for name in _TYPES:
            if name not in _PATTERNS:
                setattr(data, name, self._tables[name].array)
        surface_textures = upload_materials(here.scene.materials, self._texture_table, data, launcher)
        for name in _PATTERNS:
            setattr(surface_textures, name, self._tables[name].array)
        data.surface_textures = launcher.array([surface_textures], SurfaceTextures)
        data.bvh = self._bvhs[moment]
        roots = [self._trees.root(part.tree) for part in here.prototypes]
        assert self._frame is not None
        instances = upload_instances(here, self._frame, roots, [*self._instances, *self._former], launcher)
        if instances not in self._instances:
            self._instances.append(instances)
        data.instance_count, data.instances = instances.count, instances.tree.instances
        data.instance_axes, data.instance_colors = instances.axes, instances.colors
        both = TwoLevel()
        both.bvh, both.tree = data.bvh, instances.tree
        data.two_level = launcher.array([both], TwoLevel)
        return self, surface_textures, instances, both

    def rows(self, moment: int) -> list[int]:
        """Of each mesh of the moment's arranged scene the row of its first triangle; -1: it has none."""
        assert self._layout is not None
        return self._layout.moments[moment].rows()

    def _build(self, layout: Layout) -> None:
        """Everything anew."""
        self.changes += 1
        head = self._host(layout.head, dict.fromkeys(_CORNERS, 0))
        tail = self._host(layout.tail, {name: len(head[name]) for name in _CORNERS})
        self._tables = {name: Table(head[name], tail[name], dtype, self._launcher) for name, dtype in _TYPES.items()}
        self._grow(layout, [*layout.head, *layout.tail], 0)

    def _change(self, before: Layout, layout: Layout) -> None:
        """What moves anew, by moving it if it is still the same triangles."""
        self.changes += 1
        tail = self._host(layout.tail, {name: self._tables[name].head for name in _CORNERS})
        for name, table in self._tables.items():
            table.change(tail[name])
        if self._numbers(before) != self._numbers(layout):
            self._number(layout)
        old, keep = before.tail, layout.head_end[2]
        if len(old) != len(layout.tail) or not all(
            new.is_in_place_of(part) for new, part in zip(layout.tail, old, strict=True)
        ):
            self._grow(layout, layout.tail, keep)
            return
        worn = [
            part.tree
            for part, last in zip(layout.tail, old, strict=True)
            if not (part.is_twin or _same_meshes(part, last) or self._move(part))
        ]
        if worn:
            self._grow(layout, [part for part in layout.tail if part.tree >= min(worn)], min(worn))
        else:
            self._bring_together(layout)

    def _move(self, part: Part) -> bool:
        points, indices = self._tables["points"].array, self._tables["indices"].array
        return self._trees.move(part.tree, points, indices, part.points, part.triangles.start)

    def _grow(self, layout: Layout, parts: Sequence[Part], keep: int) -> None:
        """Builds the trees of parts; the first `keep` trees stay."""
        launcher = self._launcher
        points, indices = self._tables["points"].array, self._tables["indices"].array
        wanted = []
        for part in parts:
            if not part.is_twin:
                own = indices[3 * part.triangles.start : 3 * part.triangles.stop]
                if part.points.start:
                    own = launcher.array(own.numpy() - part.points.start, wp.int32)
                shift = part.triangles.start if part.half is None else 0
                wanted.append((points[part.points.start : part.points.stop], own, shift))
        if not all(moment.world for moment in layout.moments):
            # An empty mesh crashes Warp; three coincident points are never hit.
            wanted.append((launcher.zeros(3, wp.vec3), launcher.array([0, 1, 2], wp.int32), 0))
        self._trees.build(wanted, keep)
        self._bring_together(layout)

    def _bring_together(self, layout: Layout) -> None:
        nothing = [layout.tree_count]
        worlds = [[part.tree for part in moment.world] or nothing for moment in layout.moments]
        self._bvhs = self._trees.bring_together(worlds)

    def _numbers(self, layout: Layout) -> list[tuple[int, ...]]:
        return [part.numbers for part in (*layout.head, *layout.tail)]

    def _number(self, layout: Layout) -> None:
        """The numbers of all meshes anew: others before them have come or gone."""
        numbers = _numbered([*layout.head, *layout.tail])
        if len(numbers):
            wp.copy(self._tables["triangle_mesh"].array, self._launcher.array(numbers, wp.int32))

    def _host(self, parts: Sequence[Part], first: dict[str, int]) -> dict[str, Any]:
        """Rows of all tables for parts; those of corners begin at `first`."""
        meshes = [mesh for part in parts for mesh in part.meshes]
        counts = [len(mesh.triangles) for mesh in meshes]
        points: list[Any] = [np.zeros((0, 3), np.float32)]
        indices: list[Any] = [np.zeros(0, np.int32)]
        for part in parts:
            row = part.points.start
            for mesh in part.meshes:
                indices.append((mesh.triangles + np.int32(row)).reshape(-1).astype(np.int32, copy=False))
                if not part.is_twin:
                    placed = part.frame.to_device(mesh.points)
                    # A stray point that no triangle uses may be anything: keep it from the bounds and the compiler.
                    placed[~np.isfinite(placed).all(axis=1)] = 0.0
                    points.append(placed)
                row += len(mesh.points)
        out: dict[str, Any] = {"points": np.concatenate(points), "indices": np.concatenate(indices)}
        out["triangle_material"] = _per_triangle([mesh.material for mesh in meshes])
        out["triangle_mesh"] = _numbered(parts)
        out["emits_back"] = np.repeat(np.array([mesh.double_sided for mesh in meshes], np.int32), counts)
        for name in ("normals", "colors", "tangents"):
            values = [getattr(mesh, name) for mesh in meshes]
            rows, table = corner_tables(values, counts, first[f"corner_{name}"])
            out[f"triangle_{name}"], out[f"corner_{name}"] = rows, table
        bare = [
            mesh.bare if part.colored and mesh.bare is not None else np.zeros(len(mesh.triangles), bool)
            for part in parts
            for mesh in part.meshes
        ]
        if bare:
            out["triangle_colors"][np.concatenate(bare)] = INSTANCE_COLOR
        sets = max(len(self._uv_sets), 1)
        uvs = [self._uvs(mesh) for mesh in meshes]
        out["triangle_uvs"], out["corner_uvs"] = corner_tables(uvs, counts, first["corner_uvs"], 2, 3 * sets)
        return out

    def _uvs(self, mesh: Any) -> Any:
        """Those of its texture coordinates that textures use, [m, sets, 3, 2], or None."""
        sets = [mesh.uvs.get(name) for name in self._uv_sets]
        if all(s is None for s in sets):
            return None
        zero = np.zeros((len(mesh.triangles), 3, 2), np.float32)
        chosen = np.stack([zero if s is None else s for s in sets], axis=1)
        return np.asarray(chosen, np.float32).clip(-LARGEST_UV, LARGEST_UV)

    def _texture_table(self, textures: list[Texture]) -> Any:
        """The textures on the device."""
        if self._textures is None or not same_objects(self._textures[0], textures):
            self._textures = textures, upload_textures(textures, self._uv_sets, self._launcher)
        return self._textures[1]


def same_objects(one: Sequence[Any], other: Sequence[Any]) -> bool:
    """Whether two sequences hold the same objects."""
    return len(one) == len(other) and all(a is b for a, b in zip(one, other, strict=True))


def _same_meshes(one: Part, other: Part) -> bool:
    return same_objects(one.meshes, other.meshes)


def _same_parts(one: Sequence[Part], other: Sequence[Part]) -> bool:
    """Whether the same meshes are in the same rows, and look the same."""
    return len(one) == len(other) and all(
        _same_meshes(a, b) and (a.triangles, a.tree, a.colored) == (b.triangles, b.tree, b.colored)
        for a, b in zip(one, other, strict=True)
    )


def _per_triangle(values: Sequence[Any]) -> npt.NDArray[np.int32]:
    return np.concatenate([np.zeros(0, np.int32), *values]).astype(np.int32, copy=False)


def _numbered(parts: Sequence[Part]) -> npt.NDArray[np.int32]:
    """Of each triangle its mesh's number in the scene as the user knows it."""
    numbers = [number for part in parts for number in part.numbers]
    counts = [len(mesh.triangles) for part in parts for mesh in part.meshes]
    return np.repeat(np.array(numbers, np.int32), counts)
