"""Whether a prototype is stored once or flattened into world space; memory decides.

Rays through a single BVH are fastest, so small prototypes are flattened: those with one instance, and the others in
ascending order of their triangles in the world, up to `MAX_FLATTENED_TRIANGLES` in total. What moves while the shutter
is open is flattened for each shutter sample, and counts as often. Within a prototype that has several instances itself,
nested instances are flattened if their triangles, of `_TRIANGLE_BYTES` each, take less memory than instances of
`_INSTANCE_BYTES` each. All other prototypes are stored once.
"""

import hashlib
import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, fields

import numpy as np
import numpy.typing as npt

from warp_ir.memory import require_memory
from warp_ir.scene import Bools, Floats, InputError, Instances, Mesh
from warp_ir.scene.instances import cofactors
from warp_ir.usd.geometry.instancing import InstanceLevel, nested_colors, nested_transforms

_TRIANGLE_BYTES = 200
_INSTANCE_BYTES = 600
MAX_FLATTENED_TRIANGLES = 2**20
"""Maximum number of triangles that flattened instances have in total; beyond, prototypes are stored once."""
_MAX_TRIANGLES = 200_000_000
"""Maximum number of stored triangles: they take tens of gigabytes, so a scene with more is refused beforehand."""
_MAX_CONDITION = 1.0e6
"""Condition number above which rays cannot be transformed by a matrix in single precision."""


@dataclass(frozen=True, eq=False)
class InstancedGprim:
    """A gprim and the instance level that contains it."""

    level: InstanceLevel
    triangles: int
    """Number of triangles."""
    signature: Hashable
    """Equal for gprims of the same geometry and materials, in levels of the same key."""
    emissive: bool
    """Whether it emits; then it is always flattened, since each of its instances is an emitter of its own."""


@dataclass(eq=False)
class LevelGroup:
    """Levels with equal contents and the same parent, merged: a prototype with all its instances in the parent."""

    parent: "LevelGroup | None"
    levels: list[InstanceLevel]
    gprims: list[int]
    """Indices of the gprims in the first of the levels, which represents all."""
    children: "list[LevelGroup]" = field(default_factory=list)
    flattened: bool = False
    """Whether its instances are flattened into the parent."""
    stored: bool = False
    """Whether it is stored as a prototype."""

    @property
    def instance_count(self) -> int:
        """Number of instances in the parent."""
        return sum(len(level.matrices) for level in self.levels)

    @property
    def world_count(self) -> int:
        """Number of instances in the world."""
        return self.instance_count * (1 if self.parent is None else self.parent.world_count)

    def chain(self) -> "list[LevelGroup]":
        """The groups from the world down to this one."""
        groups = [self]
        while groups[-1].parent is not None:
            groups.append(groups[-1].parent)
        return groups[::-1]

    def world_matrices(self) -> Floats:
        """world_from_prototype of every instance, float64 [world_count, 4, 4]."""
        return nested_transforms(np.concatenate([level.matrices for level in group.levels]) for group in self.chain())

    def world_colors(self) -> Floats | None:
        """DisplayColor of every instance in the world, float64 [world_count, 3], or None."""
        return nested_colors((group.instance_count, _level_colors(group.levels)) for group in self.chain())


def _level_colors(levels: Sequence[InstanceLevel]) -> Floats | None:
    """Colours of the instances of levels, one after the other; all levels of a group have colours, or none has."""
    colors = [level.colors for level in levels if level.colors is not None]
    return np.concatenate(colors) if colors else None


@dataclass(frozen=True, eq=False)
class StoredMesh:
    """A mesh to store for a gprim: in world space or in the space of a prototype."""

    gprim: int
    """Index of the gprim."""
    prototype: LevelGroup | None
    """The prototype that the mesh is part of; None: the mesh is in world space."""
    levels: tuple[InstanceLevel, ...]
    """Levels whose instances are flattened into the mesh, outermost first."""


def choose_storage(gprims: Sequence[InstancedGprim], source: str, times: int = 1) -> list[StoredMesh]:
    """Decides for every gprim whether its instances are flattened or its prototype is stored once.

    Args:
        gprims: In the order of the stage.
        source: Path of the file, named in errors.
        times: Number of shutter samples for which the gprims are read.

    Returns:
        The meshes to store: one for each gprim, except for those in levels that another level represents.

    Raises:
        InputError: The scene has too many triangles or instances, even with prototypes stored once.
    """
    tree = _LevelTree(gprims)
    tree.decide(times)
    meshes, triangles, instances = [], 0, {}
    for k, gprim in enumerate(gprims):
        prototype, level = (None, None) if gprim.emissive else tree.storage_of(gprim.level)
        if prototype is None or level is None:
            levels = tuple(gprim.level.chain()[1:])
        elif level is prototype.levels[0]:
            instances[id(prototype)] = prototype.world_count
            levels = tuple(gprim.level.chain()[len(level.chain()) :])
        else:
            continue
        triangles += gprim.triangles * math.prod(len(level.matrices) for level in levels)
        meshes.append(StoredMesh(k, prototype, levels))
    if triangles > _MAX_TRIANGLES:
        raise InputError(f"{source}: {triangles} triangles after instancing: too many to load")
    count = sum(instances.values())
    require_memory(_INSTANCE_BYTES * count, f"{source}: {count} instances are too many: they")
    return meshes


class _LevelTree:
    """The tree of instance levels; levels with equal contents are one `LevelGroup`."""

    def __init__(self, gprims: Sequence[InstancedGprim]) -> None:
        self._gprims = gprims
        self._gprims_in: dict[int, list[int]] = {}
        self._children_of: dict[int, list[InstanceLevel]] = {}
        self._levels: dict[int, InstanceLevel] = {}
        for k, gprim in enumerate(gprims):
            self._gprims_in.setdefault(id(gprim.level), []).append(k)
            for level in reversed(gprim.level.chain()):
                if id(level) in self._levels:
                    break
                self._levels[id(level)] = level
                if level.parent is not None:
                    self._children_of.setdefault(id(level.parent), []).append(level)
        self._signatures: dict[int, Hashable] = {}
        self._group_of: dict[int, LevelGroup] = {}
        self._groups: list[LevelGroup] = []
        for level in self._levels.values():
            if level.parent is None:
                self._add(self._grouped(None, [level]))

    def storage_of(self, level: InstanceLevel) -> tuple[LevelGroup, InstanceLevel] | tuple[None, None]:
        """The prototype that stores the contents of a level, and the level of that prototype; None: the world."""
        group = self._group_of[id(level)]
        while group.flattened:
            assert group.parent is not None and level.parent is not None
            group, level = group.parent, level.parent
        return (group, level) if group.stored else (None, None)

    def decide(self, times: int) -> None:
        """Chooses which groups are flattened and which are stored once; `times` as in `choose_storage`."""
        sizes: dict[int, int] = {}
        for group in reversed(self._groups):  # children before their parents
            size = sum(self._gprims[k].triangles for k in group.gprims if not self._gprims[k].emissive)
            size += sum(child.instance_count * sizes[id(child)] for child in group.children if child.flattened)
            sizes[id(group)] = size
            if group.parent is not None and group.parent.world_count > 1:
                stored = _TRIANGLE_BYTES * size + _INSTANCE_BYTES * group.world_count
                group.flattened = _TRIANGLE_BYTES * size * group.instance_count <= stored
        below_world = [g for g in self._groups if g.parent is not None]
        candidates = [g for g in below_world if not g.flattened and times * g.world_count > 1 and sizes[id(g)]]
        flattened_triangles = 0
        for group in sorted(candidates, key=lambda g: g.world_count * sizes[id(g)]):
            flattened_triangles += times * group.world_count * sizes[id(group)]
            group.stored = flattened_triangles > MAX_FLATTENED_TRIANGLES

    def _grouped(self, parent: LevelGroup | None, siblings: Sequence[InstanceLevel]) -> list[LevelGroup]:
        """Sibling levels, grouped by equal contents."""
        by_key: dict[Hashable, list[InstanceLevel]] = {}
        for level in siblings:
            by_key.setdefault((level.key, level.colors is None), []).append(level)
        groups = []
        for levels in by_key.values():
            by_signature: dict[Hashable, list[InstanceLevel]] = {}
            for level in levels:
                by_signature.setdefault(self._signature(level) if len(levels) > 1 else None, []).append(level)
            groups += [LevelGroup(parent, same, self._gprims_in.get(id(same[0]), [])) for same in by_signature.values()]
        return groups

    def _add(self, groups: list[LevelGroup]) -> None:
        """Adds groups and all groups below them to the tree."""
        for group in groups:
            self._groups.append(group)
            self._group_of.update((id(level), group) for level in group.levels)
            group.children = self._grouped(group, self._children_of.get(id(group.levels[0]), []))
            self._add(group.children)
            # The other levels of the group have equal descendants in the same order.
            for other in group.levels[1:]:
                self._assign_descendants(group.levels[0], other)

    def _assign_descendants(self, first: InstanceLevel, other: InstanceLevel) -> None:
        """Assigns the descendants of a level to the groups of the equal descendants of the first level."""
        pairs = zip(self._children_of.get(id(first), []), self._children_of.get(id(other), []), strict=True)
        for child_of_first, child_of_other in pairs:
            self._group_of[id(child_of_other)] = self._group_of[id(child_of_first)]
            self._assign_descendants(child_of_first, child_of_other)

    def _signature(self, level: InstanceLevel) -> Hashable:
        """A key that is equal for levels of equal contents, whatever the transforms of their own instances."""
        if id(level) not in self._signatures:
            gprims = (self._gprims[k] for k in self._gprims_in.get(id(level), []))
            children = (
                (child.key, self._signature(child), digest(child.matrices), digest(child.colors))
                for child in self._children_of.get(id(level), [])
            )
            self._signatures[id(level)] = (
                tuple((gprim.signature, gprim.emissive) for gprim in gprims),
                tuple(children),
            )
        return self._signatures[id(level)]


def reuse_prototypes(
    meshes: Sequence[Mesh], instances: Sequence[Instances], previous: Sequence[Mesh]
) -> tuple[tuple[Mesh, ...], tuple[Mesh, ...]]:
    """Replaces prototypes by equal meshes of another time, so that they are stored once for both.

    Args:
        meshes: The meshes of a scene.
        instances: Which of them are prototypes.
        previous: Prototypes of another time.

    Returns:
        The meshes, and the prototypes among them.
    """
    known: dict[str, list[Mesh]] = {}
    for mesh in previous:
        known.setdefault(mesh.name, []).append(mesh)
    reused = list(meshes)
    prototypes = sorted({k for group in instances for k in group.meshes})
    for k in prototypes:
        reused[k] = next((mesh for mesh in known.get(reused[k].name, ()) if _same_mesh(mesh, reused[k])), reused[k])
    return tuple(reused), tuple(reused[k] for k in prototypes)


def _same_mesh(one: Mesh, other: Mesh) -> bool:
    """Whether two meshes are equal in all fields."""
    return one is other or all(_equal(getattr(one, f.name), getattr(other, f.name)) for f in fields(Mesh))


def _equal(one: object, other: object) -> bool:
    """Whether two fields of meshes are equal: arrays, arrays by name, or other values."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(_equal(one[name], other[name]) for name in one)
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return one is other or (one.dtype == other.dtype and np.array_equal(one, other))
    return one is other or (not isinstance(one, np.ndarray) and not isinstance(other, np.ndarray) and one == other)


def digest(array: npt.NDArray[np.generic] | None) -> bytes | None:
    """Hash of an array's bytes; None of None."""
    return None if array is None else hashlib.blake2b(np.ascontiguousarray(array).tobytes(), digest_size=16).digest()


def well_conditioned(matrices: Floats) -> Bools:
    """Mask [k] of the matrices [k, 4, 4] whose inverse is precise enough to transform rays (`_MAX_CONDITION`)."""
    with np.errstate(all="ignore"):
        linear = matrices[:, :3, :3]
        cofactor = cofactors(linear)
        determinant = np.sum(linear[:, 0] * cofactor[:, 0], axis=1)
        condition = np.abs(linear).max(axis=(1, 2)) * np.abs(cofactor).max(axis=(1, 2)) / np.abs(determinant)
        return np.asarray(condition < _MAX_CONDITION)
