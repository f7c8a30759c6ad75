"""Edits of an open stage as they happen: which prims have moved, deformed or changed colour (`Tf.Notice`)."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom

from warp_ir.scene import Floats


class StageEdits:
    """What has been edited on a stage since it was last asked for."""

    def __init__(self, stage: Usd.Stage) -> None:
        """Listens to the stage for as long as this object lives."""
        self._stage = stage
        self._moved: set[str] = set()
        self._deformed: set[str] = set()
        self._colored: set[str] = set()
        self._other: set[str] = set()
        self._listener = Tf.Notice.Register(Usd.Notice.ObjectsChanged, self._note, stage)

    def close(self) -> None:
        """Stops listening."""
        self._listener.Revoke()

    def _note(self, notice: Any, _sender: Any) -> None:
        for path in notice.GetResyncedPaths():
            # An xformOp that is authored for the first time resyncs its attribute alone.
            self._note_property(path) if path.IsPropertyPath() else self._other.add(str(path))
        for path in notice.GetChangedInfoOnlyPaths():
            if path.IsPropertyPath():
                self._note_property(path)

    def _note_property(self, path: Sdf.Path) -> None:
        name, prim = path.name, str(path.GetPrimPath())
        if UsdGeom.Xformable.IsTransformationAffectedByAttrNamed(name):
            self._moved.add(prim)
        elif name == "points":
            self._deformed.add(prim)
        elif name == "primvars:displayColor":
            self._colored.add(prim)
        elif name not in ("extent", "extentsHint"):
            self._other.add(prim)

    def take(self) -> tuple[set[str], set[str], set[str], set[str]]:
        """Paths of prims that have moved, deformed, changed colour, and changed in other ways, since the last call."""
        out = self._moved, self._deformed, self._colored, self._other
        self._moved, self._deformed, self._colored, self._other = set(), set(), set(), set()
        return out


def export_flat(stage: Usd.Stage, path: Path) -> None:
    """Writes a stage, unsaved edits included, as one file."""
    stage.Export(str(path))


def has_prim(stage: Usd.Stage, path: str) -> bool:
    """Whether a stage has a prim at a path."""
    return bool(Sdf.Path.IsValidPathString(path) and stage.GetPrimAtPath(path))


def world_matrices(stage: Usd.Stage, paths: Sequence[str], time: float | None) -> Floats:
    """world_from_local of prims, float64 [n, 4, 4], for column vectors."""
    cache = UsdGeom.XformCache(_code(time))
    matrices = [cache.GetLocalToWorldTransform(stage.GetPrimAtPath(path)) for path in paths]
    return np.array(matrices, np.float64).reshape(-1, 4, 4).swapaxes(1, 2)


def points_of(stage: Usd.Stage, path: str, time: float | None) -> Floats:
    """The points of a prim in its local space, float64 [n, 3]."""
    values = UsdGeom.PointBased(stage.GetPrimAtPath(path)).GetPointsAttr().Get(_code(time))
    return np.array(() if values is None else values, np.float64).reshape(-1, 3)


def colors_of(stage: Usd.Stage, paths: Iterable[str], time: float | None) -> list[Floats | None]:
    """The displayColor of prims, clipped to [0, 1]; None: it is not one colour."""
    out: list[Floats | None] = []
    for path in paths:
        values = UsdGeom.Gprim(stage.GetPrimAtPath(path)).GetDisplayColorAttr().Get(_code(time))
        out.append(None if values is None or len(values) != 1 else np.clip(np.array(values[0], np.float64), 0.0, 1.0))
    return out


def _code(time: float | None) -> Usd.TimeCode:
    return Usd.TimeCode.EarliestTime() if time is None else Usd.TimeCode(time)
