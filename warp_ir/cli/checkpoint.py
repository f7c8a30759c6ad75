"""A film beside the picture, now and then: what is lost when the process dies is one interval, not the render."""

import dataclasses
import hashlib
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from warp_ir import __version__
from warp_ir.cli.console import say
from warp_ir.image.io import whole_file
from warp_ir.scene import InputError, Scene
from warp_ir.settings import RenderSettings

_SHARE = 0.05
"""Most of the time that writing checkpoints may take."""
_FREE = ("iterations", "time_limit", "target_error", "color_space")
"""Settings that no sample depends on: a render may go on under others."""
_TALK = ("warnings", "stats", "name", "settings")
"""What of a scene no pixel depends on."""


class Checkpoint:
    """The checkpoint of one picture: `picture.exr.film.npz`, until the picture is done."""

    def __init__(self, output: Path, film: Any, key: Callable[[], str], interval: float) -> None:
        """Writes nothing yet.

        Args:
            output: The picture.
            film: Its film.
            key: Gives the `fingerprint` of the scene and the settings; asked when first needed.
            interval: Seconds between checkpoints; 0: there are none.
        """
        self.path = path_of(output)
        self._film, self._key, self._interval = film, cache(key), interval
        self._next = time.monotonic() + interval
        self._failed = False

    def resume(self) -> bool:
        """Goes on with the film that is there; whether there is one.

        Raises:
            InputError: It is of another scene or of other settings.
        """
        if not self.path.exists():
            return False
        try:
            self._film.resume(self.path, self._key())
        except InputError as error:
            raise InputError(f"--resume: {error}; remove it, or render without --resume") from None
        return True

    def maybe(self) -> None:
        """Writes the film if it is time."""
        if self._interval > 0.0 and time.monotonic() >= self._next and not self._failed:
            self.write()

    def write(self) -> bool:
        """Writes the film, and says whether it could: if not, that is no reason to stop."""
        if self._film.iterations == 0:
            return False
        begin = time.monotonic()
        try:
            with whole_file(self.path) as temporary:
                self._film.save(temporary, self._key())
        except InputError as error:
            say(f"warning: no checkpoint: {error}")
            self._failed = True
        now = time.monotonic()
        self._next = now + max(self._interval, (now - begin) / _SHARE)
        return not self._failed

    def remove(self) -> None:
        """The picture is done."""
        with suppress(OSError):
            self.path.unlink(missing_ok=True)


def path_of(output: Path) -> Path:
    """Where the checkpoint of a picture is."""
    return output.with_name(output.name + ".film.npz")


def fingerprint(scene: Scene, settings: RenderSettings) -> str:
    """Of everything that the samples depend on."""
    digest = hashlib.blake2b(digest_size=16)
    how = {name: value for name, value in settings.to_dict().items() if name not in _FREE}
    digest.update(f"{__version__} {how}".encode())
    _add(digest, scene, {})
    return digest.hexdigest()


def _add(digest: Any, value: object, seen: dict[int, int]) -> None:
    """Adds a value; of a record that is there several times, as in the moments of a shutter, only that it is."""
    if dataclasses.is_dataclass(value) and seen.setdefault(id(value), len(seen)) < len(seen) - 1:
        digest.update(f"#{seen[id(value)]}".encode())
    elif isinstance(value, np.ndarray):
        digest.update(f"{value.dtype} {value.shape}".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            if not (isinstance(value, Scene) and field.name in _TALK):
                digest.update(field.name.encode())
                _add(digest, getattr(value, field.name), seen)
    elif isinstance(value, tuple | list):
        digest.update(f"{len(value)}".encode())
        for item in value:
            _add(digest, item, seen)
    elif isinstance(value, frozenset | set):
        _add(digest, tuple(sorted(value)), seen)
    elif isinstance(value, Mapping):
        _add(digest, tuple(value.items()), seen)
    else:
        digest.update(repr(value).encode())
