"""A hash of what a scene holds, by which processes and files know it."""

import dataclasses
import hashlib
from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from warp_ir.scene.scene import Scene

_UNHASHED_SCENE_FIELDS = ("warnings", "stats", "name", "settings")
"""Fields of a `Scene` that do not affect the samples."""


@lru_cache(maxsize=1)  # it is asked for several times, and a scene may have gigabytes
def scene_hash(scene: Scene) -> str:
    """A hash (128 bits, hexadecimal) of all that samples depend on; equal scenes have the same in every process."""
    digest = hashlib.blake2b(digest_size=16)
    _add(digest, scene, {})
    return digest.hexdigest()


def _add(digest: "hashlib.blake2b", value: object, numbers: dict[int, int]) -> None:
    """Adds a value to the hash.

    A record that occurs again, as a static mesh does in every shutter sample, is hashed as its number.

    Args:
        digest: The hash.
        value: A record, an array, a collection or a plain value.
        numbers: The id of each record hashed so far -> its number.
    """
    if dataclasses.is_dataclass(value) and numbers.setdefault(id(value), len(numbers)) < len(numbers) - 1:
        digest.update(f"#{numbers[id(value)]}".encode())
    elif isinstance(value, np.ndarray):
        digest.update(f"{value.dtype} {value.shape}".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            if not (isinstance(value, Scene) and field.name in _UNHASHED_SCENE_FIELDS):
                digest.update(field.name.encode())
                _add(digest, getattr(value, field.name), numbers)
    elif isinstance(value, tuple | list):
        digest.update(f"{len(value)}".encode())
        for item in value:
            _add(digest, item, numbers)
    elif isinstance(value, frozenset | set):
        _add(digest, tuple(sorted(value)), numbers)
    elif isinstance(value, Mapping):
        _add(digest, tuple(value.items()), numbers)
    else:
        digest.update(repr(value).encode())
