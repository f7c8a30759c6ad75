"""Film files: the state of a film in NumPy's .npz format, bit for bit.

A file may come from anyone, or from a disk that was full. So what the archive claims of itself is checked before any
memory is taken for it, that is names, sizes, types and shapes of its arrays, and then their values: a film of a render
is finite, and its counts fit together. What is not so is refused in one line.
"""

import dataclasses
import math
import os
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device_scene import DeviceFrame
from warp_ir.files import check_input, first_line
from warp_ir.film.picture_noise import PictureNoise
from warp_ir.scene import InputError
from warp_ir.settings import MAX_PIXELS
from warp_ir.tiles import TILE, tile_count

Layout = tuple[str, tuple[int, ...]]
"""Type and shape of an array, such as ("<f4", (100, 3))."""

RECONSTRUCTION = "reconstruction_"
"""Prefix of the reconstruction's arrays in a file."""
_NOISE = "noise_"
"""Prefix of the fields of a `PictureNoise`."""
_STATE: dict[str, Layout] = {
    "size": ("<i8", (3,)),
    "seconds": ("<f8", ()),
    "origin": ("<f8", (3,)),
    "scale": ("<f8", ()),
}
_TYPES = {
    wp.vec3: ("<f4", (3,)),
    wp.vec2: ("<f4", (2,)),
    wp.float32: ("<f4", ()),
    wp.int32: ("<i4", ()),
    wp.uint8: ("|u1", ()),
}
_SIGNED = frozenset({"normal", "position", "depth", "mesh"})
"""Arrays that may hold negative numbers."""
_MAX_TEXT = 1 << 20
"""Largest size of a text in a file [bytes]."""


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
    note: str = ""
    """What the program that wrote it says of it."""


def write_film(
    path: str | os.PathLike[str],
    state: FilmState,
    arrays: Mapping[str, "wp.array[Any]"],
    noise: PictureNoise | None = None,
) -> None:
    """Writes the state of a film, its arrays by name, and what is known of its picture's noise."""
    values: dict[str, Any] = {name: array.numpy() for name, array in arrays.items()}
    values["key"] = state.key
    if state.note:
        values["note"] = state.note
    values["size"] = np.array([state.width, state.height, state.iterations], np.int64)
    values["seconds"], values["chosen"] = float(state.seconds), state.chosen
    values["origin"], values["scale"] = np.asarray(state.frame.origin, np.float64), float(state.frame.scale)
    if noise is not None:
        values |= {_NOISE + field.name: getattr(noise, field.name) for field in dataclasses.fields(noise)}
    with open(path, "wb") as file:
        np.savez(file, **values)


class FilmFile:
    """A film file that is open for reading, and whose state has been checked."""

    def __init__(self, path: str | os.PathLike[str], archive: zipfile.ZipFile) -> None:
        self._path, self._archive = os.fspath(path), archive
        self._members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        size = os.stat(path).st_size
        stored = all(
            info.compress_type == zipfile.ZIP_STORED and info.compress_size == info.file_size and not info.flag_bits & 1
            for info in archive.infolist()
        )
        # What is not compressed takes no more memory than it has on disk.
        if not stored or sum(info.file_size for info in archive.infolist()) > size:
            raise self.error("its arrays are compressed")
        if len(self._members) != len(archive.infolist()):
            raise self.error("an array is there twice")
        self.state = self._read_state()

    def error(self, what: str) -> InputError:
        """The error of a file that is no film."""
        return InputError(f"{self._path}: not a film: {what}")

    def __contains__(self, name: str) -> bool:
        """Whether there is an array of a name."""
        return name in self._members

    def rows(self, name: str) -> int:
        """Number of rows that an array claims to have."""
        shape = self._layout(name)[1]
        return shape[0] if shape else 0

    def check_layout(self, name: str, wanted: Layout) -> None:
        """Raises `InputError` unless an array is there, of a type and a shape."""
        kind, shape = self._layout(name)
        if (kind, shape) != wanted:
            raise self.error(f"{name} is {kind} {list(shape)}, not {wanted[0]} {list(wanted[1])}")

    def read(self, layouts: Mapping[str, Layout]) -> dict[str, npt.NDArray[Any]]:
        """Reads arrays by name, after all of them have been found to be of the right types and shapes.

        Raises:
            InputError: One is missing or other than it should be, or its values cannot be those of a film.
        """
        for name, layout in layouts.items():
            self.check_layout(name, layout)
        values = {name: self._read(name) for name in layouts}
        for name, array in values.items():
            signed = name.removeprefix(RECONSTRUCTION) in _SIGNED
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise self.error(f"{name} is not finite")
            if array.size and array.min() < (-1 if name == "mesh" else 0) and not (signed and array.dtype.kind == "f"):
                raise self.error(f"{name} is negative")
        return values

    def read_noise(self) -> PictureNoise | None:
        """What is known of the noise of the film's picture; None: nothing.

        Raises:
            InputError: It cannot be that of the film.
        """
        if _NOISE + "picture" not in self:
            return None
        state, tiles = self.state, len(self.state.chosen)
        layouts: dict[str, Layout] = {
            _NOISE + "picture": ("<f4", (state.height, state.width, 3)),
            _NOISE + "iterations": ("<i4", (tiles,)),
        }
        stored = self.read(layouts)
        self.check_layout(_NOISE + "variance", ("<f8", (2, tiles)))
        stored[_NOISE + "variance"] = self._read(_NOISE + "variance")  # where nothing is known, it is NaN
        iterations = stored[_NOISE + "iterations"]
        if (stored[_NOISE + "variance"] < 0.0).any() or not ((iterations > 0) & (iterations <= state.iterations)).all():
            raise self.error("what it knows of its noise cannot be")
        return PictureNoise(**{name.removeprefix(_NOISE): array for name, array in stored.items()})

    def _read_state(self) -> FilmState:
        values = self.read(_STATE)
        width, height, iterations = (int(x) for x in values["size"])
        if not (0 < width and 0 < height and width * height <= MAX_PIXELS and iterations < 2**31):
            raise self.error(f"it has {width} x {height} pixels and {iterations} iterations")
        if not 0.0 < values["scale"] < math.inf or values["seconds"] > 1.0e10:
            raise self.error("its frame or its time cannot be")
        chosen = self.read({"chosen": ("|b1", (tile_count(width, height),))})["chosen"]
        if not chosen.any():
            raise self.error("it has no tile to go on with")
        return FilmState(
            key=self.text("key"),
            width=width,
            height=height,
            iterations=iterations,
            seconds=float(values["seconds"]),
            chosen=chosen,
            frame=DeviceFrame(values["origin"], float(values["scale"])),
            note=self.text("note") if "note" in self else "",
        )

    def text(self, name: str) -> str:
        """Reads a text.

        Raises:
            InputError: It is missing, or is none.
        """
        kind, shape = self._layout(name)
        if shape != () or not kind.startswith("<U") or self._members[name].file_size > _MAX_TEXT:
            raise self.error(f"{name} is no text")
        try:
            return str(self._read(name).item())
        except ValueError as error:  # no characters
            raise self.error(f"{name} is no text") from error

    def _layout(self, name: str) -> Layout:
        """Type and shape that the header of an array claims."""
        with self._open(name) as file:
            return self._read_header(name, file)

    def _read_header(self, name: str, file: Any) -> Layout:
        if np.lib.format.read_magic(file) != (1, 0):
            raise self.error(f"{name} is of another version")
        shape, in_columns, dtype = np.lib.format.read_array_header_1_0(file)
        size = math.prod(shape) * dtype.itemsize
        if (in_columns and len(shape) > 1) or dtype.hasobject or self._members[name].file_size != file.tell() + size:
            raise self.error(f"{name} is of another size than it says")
        return dtype.str, tuple(shape)

    def _read(self, name: str) -> npt.NDArray[Any]:
        with self._open(name) as file:
            kind, shape = self._read_header(name, file)
            return np.frombuffer(file.read(), kind).reshape(shape)

    @contextmanager
    def _open(self, name: str) -> Iterator[Any]:
        if name not in self._members:
            raise self.error(f"it has no {name}")
        with self._archive.open(self._members[name]) as file:
            yield file


@contextmanager
def open_film(path: str | os.PathLike[str]) -> Iterator[FilmFile]:
    """Opens a film file, and reads its state.

    Raises:
        InputError: The file is missing, or is no film; also from what is read of it later.
    """
    check_input(path, "a film")
    try:
        with zipfile.ZipFile(path) as archive:
            yield FilmFile(path, archive)
    except InputError:
        raise
    except MemoryError:
        raise InputError(f"{os.fspath(path)}: not a film: it is larger than the memory") from None
    except OSError as error:
        raise InputError(f"{os.fspath(path)}: cannot be read: {(error.strerror or str(error)).lower()}") from error
    except Exception as error:  # zipfile and NumPy raise a dozen kinds for what a file may hold
        what = first_line(str(error)) or type(error).__name__
        raise InputError(f"{os.fspath(path)}: not a film: {what}") from error


def read_state(path: str | os.PathLike[str]) -> FilmState:
    """The state of a film in a file.

    Raises:
        InputError: The file is missing, or is no film.
    """
    with open_film(path) as file:
        return file.state


def layout_of(dtype: Any, rows: int) -> Layout:
    """How an array of one of Warp's types is stored."""
    kind, shape = _TYPES[dtype]
    return kind, (rows, *shape)


def check_counts(file: FilmFile, values: Mapping[str, npt.NDArray[Any]], meshes: int | None) -> None:
    """Checks that the counts of a film fit together; `meshes` is the number of meshes of the scene, if it is known.

    Raises:
        InputError: They do not.
    """
    state = file.state
    count = values["count"].reshape(state.height, state.width)
    corners = np.repeat(np.repeat(count[::TILE, ::TILE], TILE, axis=0), TILE, axis=1)[: state.height, : state.width]
    if (count != corners).any() or count.max() > state.iterations:
        raise file.error("its pixels have other numbers of iterations than their tiles, or than the film")
    seen = values["hits"].astype(np.int64) + (values["lights"] if len(values["lights"]) else 0)
    if (seen > values["count"]).any() or (values["rejected"] > values["count"]).any():
        raise file.error("its pixels have more samples than iterations")
    if meshes is not None and values["mesh"].max() >= meshes:
        raise file.error("it shows a mesh that is not there")
    samples = [
        values[RECONSTRUCTION + name] for name in ("count", "unassigned_count") if RECONSTRUCTION + name in values
    ]
    if sum(int(array.sum(dtype=np.int64)) for array in samples) > int(count.sum(dtype=np.int64)):
        raise file.error("its filter has more samples than there are")


def reconstruction_names(arrays: Mapping[str, "wp.array[Any]"]) -> dict[str, "wp.array[Any]"]:
    """A reconstruction's arrays under the names that they have in a file."""
    return {RECONSTRUCTION + name: array for name, array in arrays.items()}
