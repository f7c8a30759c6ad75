"""A `LiveScene` that follows the edits of an open `Usd.Stage`.

    live = LiveStage(stage, deforming=["/World/Cloth"])
    views = Views(live.scene)
    repeat
        ...                        anybody edits the stage
        live.sync()                transforms, points and colours of the prims that have changed, and refit
        views.render(...)

This is work on the host, in proportion to the number of prims that have changed; what a simulation has on the device
goes to `LiveScene.set_transforms` instead.
"""

import bisect
import tempfile
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_ir.scene import Instances, Scene
from warp_ir.simulation.bodies import quaternions, rotations_and_stretches
from warp_ir.simulation.live_scene import LiveScene
from warp_ir.usd import load_usd

if TYPE_CHECKING:
    from pxr import Usd

_UNBOUND = "displayColor"
"""Name of the material that `warp_ir.usd` makes of a displayColor that is one colour, where none is bound."""
_RIGID = 1.0e-4
"""Change of scale or shear, relative, that counts as none."""


class LiveStage:
    """A stage on a device. Scale, shear, topology, materials and lights stay as they were at first."""

    def __init__(
        self,
        stage: "Usd.Stage",
        *,
        time: float | None = None,
        deforming: Collection[str] = (),
        device: str = "cpu",
        threads: int | None = None,
    ) -> None:
        """Reads a stage, unsaved edits included, and listens to it.

        Args:
            stage: The stage.
            time: Time code; None: the earliest of each attribute.
            deforming: Paths of meshes whose points will change.
            device: As for `LiveScene`.
            threads: As for `LiveScene`.

        Raises:
            InputError: The stage cannot be used.
        """
        from warp_ir.usd import live_edits

        self._usd, self._stage, self._time = live_edits, stage, time
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "stage.usdc"
            live_edits.export_flat(stage, path)
            scene = load_usd(path, time=time)
        self.scene = LiveScene(_with_colors(scene), deforming=deforming, device=device, threads=threads)
        """The scene, for `Views`."""
        rows: dict[str, list[int]] = {}
        for row, name in enumerate(self.scene.names):
            rows.setdefault(name, []).append(row)
        found = {name: own[0] for name, own in rows.items() if len(own) == 1 and live_edits.has_prim(stage, name)}
        self.paths = sorted(found)
        """Paths of the prims that are followed; not those of instances."""
        self._rows = [found[name] for name in self.paths]
        self._world = live_edits.world_matrices(stage, self.paths, time)
        self._local = np.linalg.inv(self._world)
        self._deforming = frozenset(deforming)
        self._colored = {group.name for group in _colored(scene)}
        self._edits = live_edits.StageEdits(stage)

    def close(self) -> None:
        """Stops listening to the stage."""
        self._edits.close()

    def sync(self, time: float | None = None) -> list[str]:
        """Takes over what has been edited since the last call, and refits.

        Args:
            time: Another time code: then all prims are read again; None: that of the last call.

        Returns:
            Paths of prims that have changed in ways that are not followed.
        """
        moved, deformed, colored, other = self._edits.take()
        if time is not None and time != self._time:
            self._time = time
            moved, deformed, colored = {"/"}, set(self._deforming), set()
        missed = other
        missed |= {path for path in moved if not self._below(path)}
        missed |= self._move(sorted({k for path in moved for k in self._below(path)}))
        missed |= self._deform(sorted(deformed))
        missed |= self._color(sorted(colored))
        self.scene.refit()
        return sorted(missed)

    def _below(self, path: str) -> list[int]:
        """The followed prims at and below a path."""
        if path == "/":
            return list(range(len(self.paths)))
        own = bisect.bisect_left(self.paths, path)
        first, last = (
            bisect.bisect_left(self.paths, path + "/"),
            bisect.bisect_left(self.paths, path + "0"),
        )  # "0" > "/"
        return [k for k in (own,) if k < len(self.paths) and self.paths[k] == path] + list(range(first, last))

    def _move(self, which: Sequence[int]) -> set[str]:
        if not which:
            return set()
        world = self._usd.world_matrices(self._stage, [self.paths[k] for k in which], self._time)
        moved = world @ self._local[list(which)]
        rotation, stretch = rotations_and_stretches(moved[:, :3, :3])
        rigid = np.abs(stretch - np.eye(3)).max(axis=(1, 2)) < _RIGID
        poses = np.concatenate([moved[:, :3, 3], quaternions(rotation)], axis=1)[rigid]
        rows = np.array([self._rows[k] for k in which])[rigid]
        if len(rows):
            self.scene.set_transforms(self._array(poses, wp.transformf), self._array(rows, wp.int32))
        return {self.paths[k] for k, own in zip(which, rigid.tolist(), strict=True) if not own}

    def _deform(self, paths: Sequence[str]) -> set[str]:
        for path in paths:
            if path in self._deforming:
                k = self.paths.index(path)
                points = self._usd.points_of(self._stage, path, self._time)
                points = points @ self._world[k, :3, :3].T + self._world[k, :3, 3]
                self.scene.set_points(path, self._array(points, wp.vec3))
        return set(paths) - self._deforming

    def _color(self, paths: Sequence[str]) -> set[str]:
        known = [path for path in paths if path in self._colored]
        colors = self._usd.colors_of(self._stage, known, self._time)
        pairs = [(path, color) for path, color in zip(known, colors, strict=True) if color is not None]
        if pairs:
            rows = [self._rows[self.paths.index(path)] for path, _ in pairs]
            self.scene.set_colors(self._array([c for _, c in pairs], wp.vec3), self._array(rows, wp.int32))
        return set(paths) - {path for path, _ in pairs}

    def _array(self, values: Any, dtype: Any) -> Any:
        return self.scene.launcher.array(np.asarray(values), dtype)


def _colored(scene: Scene) -> list[Instances]:
    """The meshes of one colour of their own, each as an instance that has the colour."""
    instanced = scene.instanced()
    out = []
    for k, mesh in enumerate(scene.meshes):
        own = np.unique(mesh.material).tolist()
        if k not in instanced and mesh.colors is None and len(own) == 1 and scene.materials[own[0]].name == _UNBOUND:
            color = np.array([scene.materials[own[0]].albedo], np.float32)
            out.append(Instances(mesh.name, (k,), np.eye(4)[None], color))
    return out


def _with_colors(scene: Scene) -> Scene:
    """A scene in which the colours of such meshes can change."""
    groups = _colored(scene)
    meshes = list(scene.meshes)
    for group in groups:
        mesh = meshes[group.meshes[0]]
        meshes[group.meshes[0]] = replace(mesh, bare=np.ones(len(mesh.triangles), bool))
    return replace(scene, meshes=tuple(meshes), instances=(*scene.instances, *groups))
