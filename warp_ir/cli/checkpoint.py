"""Checkpoints: the film is saved next to the picture at intervals, so that a crash loses one interval of work."""

import hashlib
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from warp_ir import __version__
from warp_ir.cli.console import warn
from warp_ir.files import whole_file
from warp_ir.scene import InputError, Scene, scene_hash
from warp_ir.settings import RenderSettings

if TYPE_CHECKING:
    from warp_ir.film import Film

_MAX_TIME_SHARE = 0.05
"""Largest share of the render time that is spent on writing checkpoints."""
_UNHASHED_SETTINGS = ("iterations", "time_limit", "target_error", "color_space")
"""Settings that do not affect the samples: a resumed render may use other values."""


class Checkpoint:
    """The checkpoint of one picture, `picture.exr.film.npz`; it is removed when the picture is finished."""

    def __init__(self, output: Path, film: "Film", key: Callable[[], str], interval: float, note: str = "") -> None:
        """Prepares a checkpoint; no file is read or written.

        Args:
            output: Path of the picture.
            film: Film of the picture.
            key: Computes the `fingerprint` of the scene and the settings; called on first use, and once only.
            interval: Seconds between checkpoints; 0: none are written.
            note: A text that is stored with the film.
        """
        self.path = checkpoint_path(output)
        self._film, self._key, self._interval, self._note = film, cache(key), interval, note
        self._due = time.monotonic() + interval
        self._failed = False  # the last write

    def resume(self) -> bool:
        """Loads the checkpoint into the film if its file exists, and returns whether it does.

        Raises:
            InputError: The file is damaged, or belongs to another scene or to other settings.
        """
        if not self.path.exists():
            return False
        try:
            self._film.resume(self.path, self._key())
        except InputError as error:
            raise not_resumed(error) from None
        return True

    def write_if_due(self) -> None:
        """Writes the film if the interval has passed."""
        if self._interval > 0.0 and time.monotonic() >= self._due:
            self.write()

    def write(self) -> bool:
        """Writes the film and returns whether that succeeded.

        A failure is a warning, as the render can continue; it is tried again after another interval.
        """
        if self._film.iterations == 0:
            return False
        begin = time.monotonic()
        try:
            self._save(self.path)
            self._failed = False
        except InputError as error:
            if not self._failed:
                warn(f"no checkpoint, to be tried again: {error}")
            self._failed = True
        now = time.monotonic()
        self._due = now + max(self._interval, (now - begin) / _MAX_TIME_SHARE)
        return not self._failed

    def keep(self) -> Path | None:
        """Writes the film next to the picture, or to a temporary folder, and returns the path.

        None: there is no room anywhere, or nothing to keep.
        """
        if self._film.iterations == 0:
            return None
        for beside in (True, False):
            with suppress(InputError, OSError):
                folder = self.path.parent if beside else Path(tempfile.mkdtemp(prefix="warp_ir_film_"))
                self._save(folder / self.path.name)
                return folder / self.path.name
        return None

    def _save(self, path: Path) -> None:
        with whole_file(path) as temporary:
            self._film.save(temporary, self._key(), self._note)

    def remove(self) -> None:
        """Deletes the checkpoint of a finished picture."""
        with suppress(OSError):
            self.path.unlink(missing_ok=True)


def not_resumed(error: InputError) -> InputError:
    """The error of a checkpoint that cannot be continued, and what to do about it."""
    return InputError(f"--resume: {error}; remove it, or render without --resume")


def checkpoint_path(output: Path) -> Path:
    """Path of the checkpoint of a picture."""
    return output.with_name(output.name + ".film.npz")


def fingerprint(scene: Scene, settings: RenderSettings, *picture: object) -> str:
    """A hash (128 bits, hexadecimal) of everything that the samples depend on.

    With `picture`, what else a picture is made with, also of that and of the limits of the render.
    """
    left_out = () if picture else _UNHASHED_SETTINGS
    hashed = {name: value for name, value in settings.to_dict().items() if name not in left_out}
    text = f"{__version__} {hashed} {picture} {scene_hash(scene)}"
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
