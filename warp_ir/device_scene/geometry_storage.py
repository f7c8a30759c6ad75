"""Where geometry lies in the tables, and which of it shares a tree.

First comes what stands still: the world's under one tree, then every prototype under its own. After it comes what
moves, once for every moment: large meshes under trees of their own, the small ones of the world under one. So what
moves can be written over, and its trees can change, while nothing else is touched.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ir.device_scene.frame import DeviceFrame, frame_of_box
from warp_ir.scene import Mesh, Scene

_LARGE = 1024
"""Triangles from which on a mesh that moves has a tree of its own."""
_MOST = 31
"""Meshes that have one, at most: those with most triangles."""


def emissive_meshes(scene: Scene) -> set[int]:
    """The instanced meshes that emit. They are written out: every place of theirs is an emitter of its own."""
    emits = np.array([max(m.emission) > 0.0 for m in scene.materials], bool)
    if not emits.any():
        return set()
    return {k for group in scene.instances for k in group.meshes if emits[scene.meshes[k].material].any()}


def storage_order(scene: Scene) -> tuple[Scene, list[int]]:
    """The scene as it is stored, meshes of the world before those of prototypes; and the meshes' former numbers."""
    if not scene.instances:
        return scene, list(range(len(scene.meshes)))
    scene = scene.flat(emissive_meshes(scene))
    groups = [g for g in scene.instances if any(len(scene.meshes[k].triangles) for k in g.meshes)]
    below = [k for g in groups for k in g.meshes]
    unseen = {k for g in scene.instances for k in g.meshes} - {*below}
    numbers = [k for k in range(len(scene.meshes)) if k not in unseen and k not in set(below)] + below
    place = {k: i for i, k in enumerate(numbers)}
    instances = tuple(replace(g, meshes=tuple(place[k] for k in g.meshes)) for g in groups)
    return replace(scene, meshes=tuple(scene.meshes[k] for k in numbers), instances=instances), numbers


@dataclass(eq=False)
class Part:
    """Meshes in one frame, under one tree."""

    meshes: tuple[Mesh, ...]
    numbers: tuple[int, ...]
    """Theirs in the scene as the user knows it."""
    frame: DeviceFrame
    half: npt.NDArray[np.float64] | None
    """Of a prototype: half the size of its box, in its frame; None: it is of the world."""
    colored: bool
    """Whether its instances have colours."""
    points: range
    """Rows."""
    triangles: range
    """Rows."""
    tree: int
    """Number of the tree."""
    is_twin: bool = False
    """Whether it has the points and the tree of a prototype before it, which differs in its looks alone."""

    def is_in_place_of(self, other: "Part") -> bool:
        """Whether only points have to move to make this of another: the same rows, tree, and triangles."""
        rows = (self.points, self.triangles, self.tree, self.is_twin) == (
            other.points,
            other.triangles,
            other.tree,
            other.is_twin,
        )
        return rows and all(
            len(a.points) == len(b.points) and (a.triangles is b.triangles or np.array_equal(a.triangles, b.triangles))
            for a, b in zip(self.meshes, other.meshes, strict=True)
        )


@dataclass(eq=False)
class StoredSample:
    """A scene, and where its parts are."""

    scene: Scene
    """As it is arranged."""
    numbers: list[int]
    world: list[Part]
    prototypes: list[Part]
    """One for each of the scene's instances."""

    def rows(self) -> list[int]:
        """The row of the first triangle of each mesh; -1: it has none."""
        row = dict.fromkeys(range(len(self.numbers)), -1)
        place = {number: k for k, number in enumerate(self.numbers)}
        for part in (*self.world, *self.prototypes):
            first = part.triangles.start
            for mesh, number in zip(part.meshes, part.numbers, strict=True):
                row[place[number]] = first
                first += len(mesh.triangles)
        return list(row.values())


class Layout:
    """The parts of scenes that differ in what moves, and their rows."""

    def __init__(self, scenes: Sequence[tuple[Scene, list[int]]], frame: DeviceFrame, moving: Collection[str]) -> None:
        """Lays out arranged scenes.

        Args:
            scenes: Moments of one scene, and the former numbers of their meshes.
            frame: Of the world.
            moving: Names of meshes that are known to move, even if all these moments have the same.
        """
        self._frame = frame
        self.point_count = self.triangle_count = self.tree_count = 0
        groups = [_groups(scene, numbers) for scene, numbers in scenes]
        still = [
            key
            for key, meshes in groups[0].items()
            if all(key in others for others in groups[1:]) and not any(mesh.name in moving for mesh in meshes)
        ]
        self.head = self._still(groups[0], still)
        """The parts that stand still."""
        self.head_end = self.point_count, self.triangle_count, self.tree_count
        self.tail: list[Part] = []
        """Those that move."""
        self.moments: list[StoredSample] = []
        for (scene, numbers), own in zip(scenes, groups, strict=True):
            rest = {key: meshes for key, meshes in own.items() if key not in set(still)}
            parts = self._moving(rest)
            self.tail += parts
            seen = [*self.head, *parts]
            place = {part.numbers: part for part in seen if part.half is not None}
            prototypes = [place[key[2]] for key in own if key[0]]
            self.moments.append(StoredSample(scene, numbers, [p for p in seen if p.half is None], prototypes))

    def _still(self, groups: "_Groups", keys: Sequence["_Key"]) -> list[Part]:
        world = [key for key in keys if not key[0]]
        parts = [self._part([groups[key][0] for key in world], [key[2][0] for key in world])] if world else []
        return parts + self._prototypes({key: groups[key] for key in keys if key[0]})

    def _moving(self, groups: "_Groups") -> list[Part]:
        world = [key for key in groups if not key[0]]
        by_size = sorted(world, key=lambda key: -len(groups[key][0].triangles))
        large = {key for key in by_size[:_MOST] if len(groups[key][0].triangles) >= _LARGE}
        parts = [self._part([groups[key][0]], [key[2][0]]) for key in world if key in large]
        small = [key for key in world if key not in large]
        if small:
            parts.append(self._part([groups[key][0] for key in small], [key[2][0] for key in small]))
        return parts + self._prototypes({key: groups[key] for key in groups if key[0]})

    def _prototypes(self, groups: "_Groups") -> list[Part]:
        """Prototypes of the same geometry share their points and their tree."""
        known: dict[tuple[int, ...], Part] = {}
        parts = []
        for key, meshes in groups.items():
            geometry = tuple(id(x) for mesh in meshes for x in (mesh.points, mesh.triangles))
            if geometry in known:
                twin = known[geometry]
                rows = range(self.triangle_count, self.triangle_count + len(twin.triangles))
                self.triangle_count = rows.stop
                looks = {"meshes": tuple(meshes), "numbers": key[2], "colored": key[1]}
                parts.append(replace(twin, **looks, triangles=rows, is_twin=True))
                continue
            corners = [mesh.points[np.unique(mesh.triangles)] for mesh in meshes]
            lower = np.min([c.min(axis=0) for c in corners], axis=0)
            upper = np.max([c.max(axis=0) for c in corners], axis=0)
            frame = frame_of_box(lower, upper)
            half = 0.5 * (upper - lower) * frame.scale
            parts.append(replace(self._part(meshes, key[2], frame, half), colored=key[1]))
            known[geometry] = parts[-1]
        return parts

    def _part(
        self, meshes: Sequence[Mesh], numbers: Sequence[int], frame: DeviceFrame | None = None, half: Any = None
    ) -> Part:
        points = range(self.point_count, self.point_count + sum(len(m.points) for m in meshes))
        triangles = range(self.triangle_count, self.triangle_count + sum(len(m.triangles) for m in meshes))
        self.point_count, self.triangle_count = points.stop, triangles.stop
        self.tree_count += 1
        number = self.tree_count - 1
        return Part(tuple(meshes), tuple(numbers), frame or self._frame, half, False, points, triangles, number)


_Key = tuple[bool, bool, tuple[int, ...], tuple[int, ...]]
"""Whether it is a prototype, and coloured by its instances; the numbers of its meshes, and which objects they are."""
_Groups = dict[_Key, tuple[Mesh, ...]]


def _groups(scene: Scene, numbers: Sequence[int]) -> _Groups:
    """What may move by itself: each mesh of the world, each prototype; in order, without what has no triangles."""
    instanced = {k for group in scene.instances for k in group.meshes}
    members: list[tuple[bool, bool, tuple[int, ...]]] = []
    members += [(False, False, (k,)) for k in range(len(scene.meshes)) if k not in instanced]
    members += [(True, group.colors is not None, group.meshes) for group in scene.instances]
    out: _Groups = {}
    for is_prototype, colored, every in members:
        ks = [k for k in every if len(scene.meshes[k].triangles)]
        if ks:
            meshes = tuple(scene.meshes[k] for k in ks)
            out[is_prototype, colored, tuple(numbers[k] for k in ks), tuple(map(id, meshes))] = meshes
    return out
