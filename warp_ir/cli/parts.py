"""Parts of a render that are made apart, `--part K/N`, and what their films say of themselves, for `warp-ir merge`.

Part K of N holds its share of the iterations, in a row. An iteration depends on the scene, the settings and its number
alone, so the parts depend on nothing that another part does, and together they are the whole.
"""

import argparse
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from warp_ir.cli.arguments import preset_of, words_of_preset
from warp_ir.cli.frames import TimeCode
from warp_ir.cli.import_guard import importing
from warp_ir.scene import InputError
from warp_ir.settings import RenderSettings


@dataclass(frozen=True)
class Part:
    """A part of a render."""

    number: int
    """From 1."""
    parts: int
    total: int
    """Iterations of the whole."""

    @property
    def iterations(self) -> range:
        """Numbers of the part's iterations."""
        return range(self.total * (self.number - 1) // self.parts, self.total * self.number // self.parts)

    def __str__(self) -> str:
        return f"part {self.number}/{self.parts}"


@dataclass(frozen=True)
class PartFilm:
    """A film file that holds a part, as far as is needed to know what it belongs to."""

    path: Path
    part: Part
    iterations: int
    """Iterations that are done."""
    key: str
    stage: str
    product: str | None
    """RenderProduct that the picture is of."""
    preset: Mapping[str, Any]
    """Flags of `warp-ir render`, without dashes, and their values."""


def part_of(args: argparse.Namespace, settings: RenderSettings) -> Part | None:
    """The part that `--part` asks for; None: the whole.

    Raises:
        InputError: The number of iterations is not fixed, or too small.
    """
    if args.part is None:
        return None
    if settings.time_limit is not None or settings.target_error is not None:
        raise InputError("--part: is a share of --iterations; it cannot be had with --time-limit or --target-error")
    number, parts = args.part
    total = int(settings.iteration_limit)
    if parts > total:
        raise InputError(f"--part: {parts} parts of {total} iterations: one is the least")
    return Part(number, parts, total)


def note_of(part: Part, args: argparse.Namespace, time: TimeCode, product: str | None) -> str:
    """What a film says of itself: its part, and the flags by which `warp-ir merge` makes the picture."""
    preset = preset_of(args)
    for key in ("frames", "time", "default-time"):
        preset.pop(key, None)
    if time == "default":
        preset["default-time"] = True
    elif time is not None:
        preset["time"] = time
    known = {"part": part.number, "parts": part.parts, "total": part.total}
    return json.dumps({**known, "stage": args.stage, "product": product, "preset": preset})


def read_part(path: str | Path) -> PartFilm:
    """Reads what a film says of itself.

    Raises:
        InputError: The file is missing, is no film, or is not one of a part.
    """
    film = read_film(path)
    if film is None:
        raise InputError(f"{path}: is no part of a picture, such as warp-ir render --part 1/4 writes")
    return film


def read_film(path: str | Path) -> PartFilm | None:
    """`read_part` of any film; None: it is of a whole picture.

    Raises:
        InputError: The file is missing, or is no film.
    """
    with importing():
        from warp_ir.film import read_state

    state = read_state(path)
    if not state.note:
        return None
    try:
        note = json.loads(state.note)
        numbers = [note[name] for name in ("part", "parts", "total")]
        if not all(isinstance(n, int) and 0 < n < 2**31 for n in numbers) or not numbers[0] <= numbers[1] <= numbers[2]:
            raise ValueError("its numbers cannot be")
        if not isinstance(note["stage"], str) or not isinstance(note["product"], str | None):
            raise ValueError("its stage is no text")
        if not isinstance(note["preset"], dict):
            raise ValueError("its flags are none")
        part = Part(*numbers)
        if state.iterations > len(part.iterations):
            raise ValueError(f"it has {state.iterations} iterations, and {part} has {len(part.iterations)}")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: not a film: what it says of itself is damaged: {error}") from None
    return PartFilm(Path(path), part, state.iterations, state.key, note["stage"], note["product"], note["preset"])


def render_words(film: PartFilm) -> list[str]:
    """The flags of `warp-ir render` that a film was made with, as words of a command line.

    Raises:
        InputError: They are none, or are not among those that a picture depends on.
    """
    return words_of_preset(film.preset)


def sorted_parts(films: Sequence[PartFilm]) -> list[PartFilm]:
    """The films in the order of their parts.

    Raises:
        InputError: They do not make up one picture; the message names a film and what is wrong with it.
    """
    films = sorted(films, key=lambda film: (film.part.number, str(film.path)))
    first = films[0]
    for film in films[1:]:
        if (film.part.parts, film.part.total) != (first.part.parts, first.part.total):
            whole, other = (f"{f.part} of {f.part.total} iterations" for f in (first, film))
            raise InputError(f"{film.path}: is {other}, and {first.path} is {whole}")
        if film.key != first.key:
            raise InputError(f"{film.path}: is of another scene, other settings or another version than {first.path}")
    for before, after in itertools.pairwise(films):
        if before.part == after.part:
            raise InputError(f"{before.path} and {after.path}: are both {before.part}")
    missing = sorted(set(range(1, first.part.parts + 1)) - {film.part.number for film in films})
    if missing:
        numbers = ", ".join(str(number) for number in missing[:10]) + (", ..." if len(missing) > 10 else "")
        raise InputError(f"{first.path}: is {first.part}; missing: {numbers}")
    for film in films:
        if film.iterations < len(film.part.iterations):
            done = f"{film.iterations} of {len(film.part.iterations)} iterations"
            raise InputError(f"{film.path}: has {done}; warp-ir render --resume --part continues it")
    return films
