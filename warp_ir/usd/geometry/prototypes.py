"""Which prototypes are stored once, and which are written out wherever they are: memory decides.

What is small is written out, for rays through one tree are the fastest: prototypes that are in one place, and the
others, those that make fewest triangles first, as long as they make no more than `MOST_WRITTEN` together. Within a
prototype that is itself in many places, instances are written out if triangles of `_TRIANGLE` bytes then take less
memory than places of `_PLACE` bytes. All others are stored once.
"""

import hashlib
import math
import os
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ir.scene import Floats, InputError
from warp_ir.scene.instances import cofactors
from warp_ir.usd.geometry.instancing import Level, combined, combined_colors
from warp_ir.usd.values.triangles import Mask

_TRIANGLE = 200
_PLACE = 600
MOST_WRITTEN = 2**20
"""Most triangles that copies make together before prototypes are stored once."""
_MOST_TRIANGLES = 200_000_000
"""A scene of this size takes tens of gigabytes: refused before it is allocated."""
_WORST = 1.0e6
"""Condition number above which a matrix is no use for rays in single precision."""


@dataclass(frozen=True, eq=False)
class Part:
    """A gprim below a level."""

    level: Level
    triangles: int
    signature: Hashable
    """Equal for parts that look the same in levels of the same key."""
    alone: bool
    """Whether it has to be written out, since every place of it emits."""


@dataclass(eq=False)
class Group:
    """Levels that hold the same, in the same parent, as one: a prototype in all its places there."""

    parent: "Group | None"
    levels: list[Level]
    parts: list[int]
    """Of the first of the levels, which stands for all."""
    children: "list[Group]" = field(default_factory=list)
    written: bool = False
    """Whether its places are written out in the parent."""
    shared: bool = False
    """Whether it is stored once."""

    @property
    def places(self) -> int:
        """In the parent."""
        return sum(len(level.matrices) for level in self.levels)

    @property
    def total(self) -> int:
        """Places in the world."""
        return self.places * (1 if self.parent is None else self.parent.total)

    def chain(self) -> "list[Group]":
        """From the world to this group."""
        groups = [self]
        while groups[-1].parent is not None:
            groups.append(groups[-1].parent)
        return groups[::-1]

    def matrices(self) -> Floats:
        """world_from_prototype, float64 [total, 4, 4]."""
        return combined(np.concatenate([level.matrices for level in group.levels]) for group in self.chain())

    def colors(self) -> Floats | None:
        """Colour (displayColor) of every place in the world, float64 [total, 3]; None: it has none."""
        return combined_colors((group.places, _together(group.levels)) for group in self.chain())


def _together(levels: Sequence[Level]) -> Floats | None:
    given = [level.colors for level in levels if level.colors is not None]
    return np.concatenate(given) if given else None


@dataclass(frozen=True, eq=False)
class Drawn:
    """A part as a mesh that is stored: in the world, or in a prototype."""

    part: int
    group: Group | None
    """The prototype; None: the world."""
    levels: tuple[Level, ...]
    """Whose places are written out, outermost first."""


def share(parts: Sequence[Part], source: str) -> list[Drawn]:
    """Decides for every part where it is stored.

    Args:
        parts: In the order of the stage; each is drawn once at least, except in levels that another stands for.
        source: The file, named in errors.

    Raises:
        InputError: However it is stored, it is too much.
    """
    tree = _Tree(parts)
    tree.decide()
    drawn, triangles, places = [], 0, {}
    for k, part in enumerate(parts):
        home, level = (None, None) if part.alone else tree.home(part.level)
        if home is None or level is None:
            levels = tuple(part.level.chain()[1:])
        elif level is home.levels[0]:
            places[id(home)] = home.total
            levels = tuple(part.level.chain()[len(level.chain()) :])
        else:
            continue
        triangles += part.triangles * math.prod(len(level.matrices) for level in levels)
        drawn.append(Drawn(k, home, levels))
    if triangles > _MOST_TRIANGLES:
        raise InputError(f"{source}: {triangles} triangles after instancing: too many to load")
    needed, there = _PLACE * sum(places.values()), _memory()
    if needed > there:
        raise InputError(
            f"{source}: {sum(places.values())} instances, too many: they need about {needed / 2**30:.0f} GiB,"
            f" there are {there / 2**30:.0f}"
        )
    return drawn


class _Tree:
    """The levels that parts are in, those that hold the same as one `Group`."""

    def __init__(self, parts: Sequence[Part]) -> None:
        self._parts = parts
        self._own: dict[int, list[int]] = {}
        self._below: dict[int, list[Level]] = {}
        self._levels: dict[int, Level] = {}
        for k, part in enumerate(parts):
            self._own.setdefault(id(part.level), []).append(k)
            for level in reversed(part.level.chain()):
                if id(level) in self._levels:
                    break
                self._levels[id(level)] = level
                if level.parent is not None:
                    self._below.setdefault(id(level.parent), []).append(level)
        self._signatures: dict[int, Hashable] = {}
        self._group: dict[int, Group] = {}
        self._groups: list[Group] = []
        for level in self._levels.values():
            if level.parent is None:
                self._gather(self._collect(None, [level]))

    def home(self, level: Level) -> tuple[Group, Level] | tuple[None, None]:
        """The prototype in which what is in a level is stored, and the level that it is there; None: the world."""
        group = self._group[id(level)]
        while group.written:
            assert group.parent is not None and level.parent is not None
            group, level = group.parent, level.parent
        return (group, level) if group.shared else (None, None)

    def decide(self) -> None:
        """Chooses what is written out and what is shared."""
        sizes: dict[int, int] = {}
        for group in reversed(self._groups):  # children before their parents
            size = sum(self._parts[k].triangles for k in group.parts if not self._parts[k].alone)
            size += sum(child.places * sizes[id(child)] for child in group.children if child.written)
            sizes[id(group)] = size
            if group.parent is not None and group.parent.total > 1:
                apart = _TRIANGLE * size + _PLACE * group.total
                group.written = _TRIANGLE * size * group.places <= apart
        left = [g for g in self._groups if not g.written and g.total > 1 and sizes[id(g)]]
        sum_written = 0
        for group in sorted(left, key=lambda g: g.total * sizes[id(g)]):
            sum_written += group.total * sizes[id(group)]
            group.shared = sum_written > MOST_WRITTEN

    def _collect(self, parent: Group | None, siblings: Sequence[Level]) -> list[Group]:
        """Siblings as groups of those that hold the same."""
        by_key: dict[Hashable, list[Level]] = {}
        for level in siblings:
            by_key.setdefault((level.key, level.colors is None), []).append(level)
        groups = []
        for levels in by_key.values():
            alike: dict[Hashable, list[Level]] = {}
            for level in levels:
                alike.setdefault(self._signature(level) if len(levels) > 1 else None, []).append(level)
            groups += [Group(parent, same, self._own.get(id(same[0]), [])) for same in alike.values()]
        return groups

    def _gather(self, groups: list[Group]) -> None:
        """Enters groups and all that is below them."""
        for group in groups:
            self._groups.append(group)
            self._group.update((id(level), group) for level in group.levels)
            group.children = self._collect(group, self._below.get(id(group.levels[0]), []))
            self._gather(group.children)
            # What is below the other levels is the same in the same order.
            for other in group.levels[1:]:
                self._follow(group.levels[0], other)

    def _follow(self, first: Level, other: Level) -> None:
        pairs = zip(self._below.get(id(first), []), self._below.get(id(other), []), strict=True)
        for below_first, below_other in pairs:
            self._group[id(below_other)] = self._group[id(below_first)]
            self._follow(below_first, below_other)

    def _signature(self, level: Level) -> Hashable:
        """What a level holds, apart from its own places."""
        if id(level) not in self._signatures:
            own = (self._parts[k] for k in self._own.get(id(level), []))
            below = (
                (child.key, self._signature(child), digest(child.matrices), digest(child.colors))
                for child in self._below.get(id(level), [])
            )
            self._signatures[id(level)] = (
                tuple((part.signature, part.alone) for part in own),
                tuple(below),
            )
        return self._signatures[id(level)]


def digest(array: npt.NDArray[Any] | None) -> bytes | None:
    """Equal for equal arrays."""
    return None if array is None else hashlib.blake2b(np.ascontiguousarray(array).tobytes(), digest_size=16).digest()


def fit_for_rays(matrices: Floats) -> Mask:
    """Which matrices [k, 4, 4] can be inverted without losing the precision that rays need."""
    with np.errstate(all="ignore"):
        linear = matrices[:, :3, :3]
        cofactor = cofactors(linear)
        determinant = np.sum(linear[:, 0] * cofactor[:, 0], axis=1)
        condition = np.abs(linear).max(axis=(1, 2)) * np.abs(cofactor).max(axis=(1, 2)) / np.abs(determinant)
        return np.asarray(condition < _WORST)


def _memory() -> float:
    """Bytes that this machine has; infinity if unknown."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, OSError, ValueError):
        return float("inf")
