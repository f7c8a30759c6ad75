"""Where geometry lies in the tables: the world's first, then each prototype's once."""

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ir.device_scene.frame import DeviceFrame, frame_of_box
from warp_ir.scene import Mesh, Scene


def glowing_meshes(scene: Scene) -> set[int]:
    """The instanced meshes that emit. They are written out: every place of theirs is an emitter of its own."""
    emits = np.array([max(m.emission) > 0.0 for m in scene.materials], bool)
    if not emits.any():
        return set()
    return {k for group in scene.instances for k in group.meshes if emits[scene.meshes[k].material].any()}


def arranged(scene: Scene) -> tuple[Scene, list[int]]:
    """The scene as it is stored, meshes of the world before those of prototypes; and the meshes' former numbers."""
    if not scene.instances:
        return scene, list(range(len(scene.meshes)))
    scene = scene.flat(glowing_meshes(scene))
    groups = [g for g in scene.instances if any(len(scene.meshes[k].triangles) for k in g.meshes)]
    below = [k for g in groups for k in g.meshes]
    unseen = {k for g in scene.instances for k in g.meshes} - {*below}
    numbers = [k for k in range(len(scene.meshes)) if k not in unseen and k not in set(below)] + below
    place = {k: i for i, k in enumerate(numbers)}
    instances = tuple(replace(g, meshes=tuple(place[k] for k in g.meshes)) for g in groups)
    return replace(scene, meshes=tuple(scene.meshes[k] for k in numbers), instances=instances), numbers


class Storage:
    """Where points and triangles lie in the tables; prototypes of the same geometry share their points and tree."""

    def __init__(self, scene: Scene, frame: DeviceFrame) -> None:
        """Lays out an arranged scene.

        `points` [n, 3] and `indices` [3 m] are the tables, `parts` the ranges of both that are a hierarchy each, the
        world's first. For each of the scene's instances, `part` is the number of its prototype, from 0, `first` its
        first triangle, and `frames` its prototype's frame.
        """
        instanced = {k for group in scene.instances for k in group.meshes}
        self._points: list[Any] = []
        self._indices: list[Any] = []
        self._point_count = self._index_count = 0
        for k, mesh in enumerate(scene.meshes):
            if k not in instanced and len(mesh.triangles):
                self._add(mesh, frame, self._point_count)
        self.parts = [(slice(0, self._point_count), slice(0, self._index_count))]
        self.part: list[int] = []
        self.first: list[int] = []
        self.frames: list[DeviceFrame] = []
        self.halves: list[npt.NDArray[np.float64]] = []
        known: dict[tuple[int, ...], int] = {}
        for group in scene.instances:
            meshes = [scene.meshes[k] for k in group.meshes if len(scene.meshes[k].triangles)]
            self.first.append(self._index_count // 3)
            geometry = tuple(id(x) for mesh in meshes for x in (mesh.points, mesh.triangles))
            if geometry in known:
                twin = known[geometry]
                self.part.append(self.part[twin])
                self.frames.append(self.frames[twin])
                self.halves.append(self.halves[twin])
                begin, count = self.parts[self.part[twin] + 1][1].start, 3 * sum(len(m.triangles) for m in meshes)
                self._indices.append(np.concatenate(self._indices)[begin : begin + count])
                self._index_count += count
                continue
            known[geometry] = len(self.part)
            corners = [mesh.points[np.unique(mesh.triangles)] for mesh in meshes]
            lower = np.min([c.min(axis=0) for c in corners], axis=0)
            upper = np.max([c.max(axis=0) for c in corners], axis=0)
            own = frame_of_box(lower, upper)
            point, index = self._point_count, self._index_count
            for mesh in meshes:
                self._add(mesh, own, self._point_count)
            self.part.append(len(self.parts) - 1)
            self.parts.append((slice(point, self._point_count), slice(index, self._index_count)))
            self.frames.append(own)
            self.halves.append(0.5 * (upper - lower) * own.scale)
        # An empty mesh crashes Warp; three coincident points are never hit.
        self.points = np.concatenate(self._points or [np.zeros((3, 3), np.float32)])
        self.indices = np.concatenate(self._indices or [np.arange(3)]).astype(np.int32)

    def _add(self, mesh: Mesh, frame: DeviceFrame, first: int) -> None:
        points = frame.to_device(mesh.points)
        # A stray point that no triangle uses may be anything: keep it from the bounds and the compiler.
        points[~np.isfinite(points).all(axis=1)] = 0.0
        self._points.append(points)
        self._indices.append((mesh.triangles + first).reshape(-1))
        self._point_count += len(points)
        self._index_count += mesh.triangles.size
