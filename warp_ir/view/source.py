"""Where a view's scene comes from: a USD stage that may change on disk, or a scene made by hand."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from warp_ir.files import check_output
from warp_ir.scene import Camera, InputError, Scene
from warp_ir.usd import StageReader
from warp_ir.usd.edit_layer import write_edits
from warp_ir.usd.stage.open import reload_layers
from warp_ir.view.edits import Edits

_WATCH_SECONDS = 0.5
"""Seconds between two looks at the files of a stage."""


class Source(Protocol):
    """What a view shows."""

    up_axis: str
    frames: tuple[float, float] | None

    def read(self, code: float | str | None) -> Scene:
        """The scene at a time code."""

    def cameras(self, code: float | str | None) -> tuple[Camera, ...]:
        """The cameras to choose from."""

    def changed(self) -> bool:
        """Whether what was read has changed since it was read."""

    def reload(self) -> None:
        """Takes over what has changed; raises `InputError`, and stays as it was, if it cannot be used."""

    def save_edits(self, path: Path, code: float | str | None, camera: Camera | None, edits: Edits) -> list[str]:
        """Writes edits as a USD layer; returns what could not be written."""


class SceneSource:
    """A scene that was made by hand: it has one camera, and does not change."""

    frames = None

    def __init__(self, scene: Scene, up_axis: str = "Y") -> None:
        self._scene, self.up_axis = scene, up_axis

    def read(self, code: float | str | None) -> Scene:
        """The scene."""
        return self._scene

    def cameras(self, code: float | str | None) -> tuple[Camera, ...]:
        """The scene's camera."""
        return (self._scene.camera,)

    def changed(self) -> bool:
        """False."""
        return False

    def reload(self) -> None:
        """Nothing to do."""

    def save_edits(self, path: Path, code: float | str | None, camera: Camera | None, edits: Edits) -> list[str]:
        """Refused: there is no stage to which a layer could apply."""
        raise InputError("edits: only those of a USD stage can be saved")


class StageSource:
    """A USD stage; the files of all its layers are watched."""

    def __init__(self, open_reader: Callable[[], StageReader]) -> None:
        """Opens the stage by `open_reader`, which is called again when a file has changed."""
        self._open = open_reader
        self._reader = open_reader()
        self.up_axis, self.frames = self._reader.up_axis, self._reader.frames
        self._stamps = _stamps(self._reader.files)
        self._looked = time.monotonic()

    def read(self, code: float | str | None) -> Scene:
        """The scene at a time code, as `StageReader.read` does."""
        return self._reader.read(code)

    def cameras(self, code: float | str | None) -> tuple[Camera, ...]:
        """The cameras of the stage."""
        return self._reader.cameras(code)

    def changed(self) -> bool:
        """Whether a file has changed; it looks at them twice a second at most."""
        if time.monotonic() - self._looked < _WATCH_SECONDS:
            return False
        self._looked = time.monotonic()
        return _stamps(tuple(self._stamps)) != self._stamps

    def reload(self) -> None:
        """Reads the changed files, and the stage with them.

        Raises:
            InputError: A file or the stage cannot be read; the next change is another chance.
        """
        stamps = _stamps(tuple(self._stamps))
        changed = [path for path, stamp in stamps.items() if stamp != self._stamps.get(path)]
        self._stamps = stamps
        reload_layers(changed)
        reader = self._open()
        self._reader, self.up_axis, self.frames = reader, reader.up_axis, reader.frames
        self._stamps = _stamps(reader.files)

    def save_edits(self, path: Path, code: float | str | None, camera: Camera | None, edits: Edits) -> list[str]:
        """Writes a layer for `--session-layer`; returns a line for each edit that it cannot hold."""
        check_output(path, (".usda", ".usdc", ".usd"))
        lights = {name: (edit.factor, edit.offset) for name, edit in edits.lights.items()}
        return write_edits(path, self._reader.stage, code, camera=camera, lights=lights, colors=edits.colors)


def _stamps(paths: tuple[str, ...]) -> dict[str, tuple[int, int] | None]:
    """Time of modification and size of files; None where there is none."""
    stamps: dict[str, tuple[int, int] | None] = {}
    for path in paths:
        try:
            status = os.stat(path)
            stamps[path] = status.st_mtime_ns, status.st_size
        except OSError:
            stamps[path] = None
    return stamps
