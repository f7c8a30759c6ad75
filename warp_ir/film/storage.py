"""Film files: the state of a film in NumPy's .npz format, bit for bit."""

import dataclasses
import os
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device_scene import DeviceFrame
from warp_ir.film.picture_noise import PictureNoise
from warp_ir.scene import InputError

_RECONSTRUCTION = "reconstruction_"
"""Prefix of the reconstruction's arrays in a file."""
_NOISE = "noise_"
"""Prefix of the fields of a `PictureNoise`."""


@dataclass(frozen=True)
class FilmState:
    """The state of a film without its arrays."""

    key: str
    """Identifies the picture; `Film.resume` compares it."""
    width: int
    height: int
    iterations: int
    seconds: float
    chosen: npt.NDArray[np.bool_]
    """[tiles], the tiles of the next iteration."""
    frame: DeviceFrame
    """The device frame in which positions and depths are stored."""


def write_film(
    path: str | os.PathLike[str],
    state: FilmState,
    arrays: Mapping[str, "wp.array[Any]"],
    noise: PictureNoise | None = None,
) -> None:
    """Writes the state of a film, its arrays by name, and what is known of its picture's noise."""
    values: dict[str, Any] = {name: array.numpy() for name, array in arrays.items()}
    values["key"] = state.key
    values["size"] = np.array([state.width, state.height, state.iterations])
    values["seconds"], values["chosen"] = state.seconds, state.chosen
    values["origin"], values["scale"] = state.frame.origin, state.frame.scale
    if noise is not None:
        values |= {_NOISE + field.name: getattr(noise, field.name) for field in dataclasses.fields(noise)}
    with open(path, "wb") as file:
        np.savez(file, **values)


def read_state(path: str | os.PathLike[str]) -> FilmState:
    """Reads the state of a film, without its arrays.

    Raises:
        InputError: The file is missing or is no film.
    """
    values = read_arrays(path, ("key", "size", "seconds", "chosen", "origin", "scale"))
    width, height, iterations = (int(x) for x in values["size"])
    return FilmState(
        key=str(values["key"]),
        width=width,
        height=height,
        iterations=iterations,
        seconds=float(values["seconds"]),
        chosen=values["chosen"],
        frame=DeviceFrame(values["origin"], float(values["scale"])),
    )


def read_arrays(path: str | os.PathLike[str], names: Iterable[str]) -> dict[str, npt.NDArray[Any]]:
    """Reads arrays that `write_film` has written, by name.

    Raises:
        InputError: The file is missing, is no film, or lacks an array.
    """
    try:
        with open(path, "rb") as stream, np.load(stream) as file:
            return {name: file[name] for name in names}
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{os.fspath(path)}: not a film: {error}") from error


def read_noise(path: str | os.PathLike[str]) -> PictureNoise | None:
    """Reads what is known of the noise of a film's picture; None: nothing.

    Raises:
        InputError: The file is missing or is no film.
    """
    names = [field.name for field in dataclasses.fields(PictureNoise)]
    with np.load(path) as file:
        is_known = _NOISE + names[0] in file
    if not is_known:
        return None
    stored = read_arrays(path, [_NOISE + name for name in names])
    return PictureNoise(**{name: stored[_NOISE + name] for name in names})


def reconstruction_names(arrays: Mapping[str, "wp.array[Any]"]) -> dict[str, "wp.array[Any]"]:
    """A reconstruction's arrays under the names that they have in a file."""
    return {_RECONSTRUCTION + name: array for name, array in arrays.items()}
