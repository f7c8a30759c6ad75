"""Where prototypes go: levels of instancing, and point instancers, whose arrays cannot be trusted."""

import math
from collections.abc import Hashable, Iterable
from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from warp_ir.scene import Floats, Ints
from warp_ir.usd.geometry.velocities import carried_points, turned
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable
from warp_ir.usd.values.triangles import Mask


@dataclass(frozen=True, eq=False)
class Level:
    """A prototype in all places that one native instance or point instancer gives it; the outermost is the world."""

    key: Hashable
    """Of the prototype: levels with equal keys may hold the same."""
    parent: "Level | None"
    """The level in which the places are; None for the world."""
    matrices: Floats
    """parent_from_level, float64 [k, 4, 4]."""
    colors: Floats | None = None
    """Albedo of each place (displayColor), float64 [k, 3], if there are such; the prims' own is stronger."""
    primvars: "InstancePrimvars | None" = None
    """What else the instancer gives to each place."""

    @property
    def total(self) -> int:
        """In how many places of the world it is."""
        return math.prod(len(level.matrices) for level in self.chain())

    def chain(self) -> "list[Level]":
        """From the world to this level."""
        levels = [self]
        while levels[-1].parent is not None:
            levels.append(levels[-1].parent)
        return levels[::-1]

    def in_world(self) -> Floats:
        """world_from_level for every place, float64 [total, 4, 4]."""
        return combined(level.matrices for level in self.chain())


def combined(matrices: Iterable[Floats]) -> Floats:
    """Places [k, 4, 4] within places, outermost first: the product over all of them, the innermost running fastest."""
    out = np.eye(4)[None]
    for inner in matrices:
        out = (out[:, None] @ inner[None]).reshape(-1, 4, 4)
    return out


def combined_colors(levels: Iterable[tuple[int, Floats | None]]) -> Floats | None:
    """Colours of such places, given the number of places and the colours of each level, outermost first."""
    out: Floats | None = None
    total = 1
    for count, colors in levels:
        if colors is not None:
            out = np.tile(colors, (total, 1))
        elif out is not None:
            out = np.repeat(out, count, axis=0)
        total *= count
    return out


@dataclass(frozen=True, eq=False)
class InstancePrimvars:
    """The primvars of a point instancer, read when a material asks for them: most never are."""

    prim: Usd.Prim
    prototype: Sdf.Path
    count: int
    """Instances that there are."""
    chosen: Ints
    """Which of them are meant, int [k]."""
    time: Usd.TimeCode

    def has(self, name: str) -> bool:
        """Whether the instancer has a primvar."""
        return bool(UsdGeom.PrimvarsAPI(self.prim).GetPrimvar(name).HasValue())

    def read(self, name: str, channels: int, report: Report) -> Floats | None:
        """A value for each of the k instances that are meant, float64 [k, c]; None if there are none.

        Primvars that are vertex, varying or faceVarying have one per instance, the others one for all, which prims
        below the instancer inherit anyway.
        """
        found = UsdGeom.PrimvarsAPI(self.prim).GetPrimvar(name)
        if not found or not found.HasValue():
            return None
        single = found.GetInterpolation() in (UsdGeom.Tokens.constant, UsdGeom.Tokens.uniform)
        if single and self.prototype.HasPrefix(self.prim.GetPath()):
            return None
        count = 1 if single else self.count
        try:
            if channels == 1:
                scalars = read.scalars(found.GetAttr(), self.time)
                values = None if scalars is None else scalars[:, None]
            else:
                values = read.floats(found.GetAttr(), self.time, channels)
            indices = read.ints(found.GetIndicesAttr(), self.time) if found.IsIndexed() else None
        except Unreadable as trouble:
            report.warn(self.prim.GetPath(), f"{trouble}; {name} ignored")
            return None
        if values is None or len(values) == 0:
            return None
        if indices is not None:
            if len(indices) and (indices.min() < 0 or indices.max() >= len(values)):
                report.warn(self.prim.GetPath(), f"{name}: an index is out of range; ignored")
                return None
            values = values[indices]
        if len(values) != count or not np.isfinite(values).all():
            what = "colour" if read.is_color(found.GetAttr()) else "value"
            whom = "all instances" if single else f"each of {count} instances"
            report.warn(self.prim.GetPath(), f"{name}: not one finite {what} for {whom}; ignored")
            return None
        if channels == 3 and read.is_color(found.GetAttr()):
            values = read.to_linear_rec709(found.GetAttr(), values)
        return values.repeat(len(self.chosen), axis=0) if single else values[self.chosen]


@dataclass(frozen=True, eq=False)
class Instances:
    """The visible instances of one prototype."""

    prototype: Sdf.Path
    matrices: Floats
    """instancer_from_instance, float64 [k, 4, 4]; the prototype's own transform comes before it."""
    colors: Floats | None
    """displayColor of each instance, float64 [k, 3], if there are such."""
    primvars: InstancePrimvars
    """All that the instancer gives to them."""


def read_instancer(prim: Usd.Prim, time: Usd.TimeCode, report: Report) -> list[Instances]:
    """The instances of a PointInstancer, per prototype that has any.

    USD's own ComputeInstanceTransformsAtTime returns uninitialised memory for arrays of wrong length, so the
    arrays are checked and combined here; scale, then rotation, then translation.

    Raises:
        Unreadable: positions or protoIndices are missing, of the wrong type or of different lengths.
    """
    instancer = UsdGeom.PointInstancer(prim)
    indices = read.ints(instancer.GetProtoIndicesAttr(), time)
    moving = instancer.GetPositionsAttr(), instancer.GetVelocitiesAttr(), instancer.GetAccelerationsAttr()
    positions = carried_points(*moving, time, report)
    prototypes = instancer.GetPrototypesRel().GetForwardedTargets()
    if indices is None or len(indices) == 0:
        return []
    if positions is None or len(positions) != len(indices):
        found = 0 if positions is None else len(positions)
        raise Unreadable(f"it has {len(indices)} protoIndices but {found} positions")
    count = len(indices)
    scales = _optional(instancer.GetScalesAttr(), time, 3, count, prim, report)
    matrices = np.tile(np.eye(4), (count, 1, 1))
    for attribute in (instancer.GetOrientationsfAttr(), instancer.GetOrientationsAttr()):
        moment, spin = turned(attribute, instancer.GetAngularVelocitiesAttr(), time, count, report)
        turns = _optional(attribute, moment, 4, count, prim, report)
        if turns is not None:
            matrices[:, :3, :3] = _rotations(turns) if spin is None else _spins(spin) @ _rotations(turns)
            break
    if scales is not None:
        matrices[:, :3, :3] *= scales[:, None, :]
    matrices[:, :3, 3] = positions
    visible = _mask(instancer, count, time, report)
    finite = np.isfinite(matrices).all(axis=(1, 2))
    if not finite.all():
        report.warn(prim.GetPath(), "{n} instances with NaN or infinite transforms left out", int((~finite).sum()))
    known = (indices >= 0) & (indices < len(prototypes))
    if not known.all():
        report.warn(prim.GetPath(), "{n} instances of prototypes that do not exist left out", int((~known).sum()))
    visible &= finite & known
    opacity = UsdGeom.PrimvarsAPI(prim).GetPrimvar("displayOpacity")
    if opacity and opacity.GetInterpolation() not in (UsdGeom.Tokens.constant, UsdGeom.Tokens.uniform):
        if np.any(np.asarray(read.raw(opacity.GetAttr(), time)) != 1.0):
            report.warn(prim.GetPath(), "displayOpacity per instance is not read: instances are opaque")
    groups = []
    for number, path in enumerate(prototypes):
        chosen = np.flatnonzero(visible & (indices == number)).astype(np.int32)
        if len(chosen):
            primvars = InstancePrimvars(prim, path, count, chosen, time)
            colors = primvars.read("displayColor", 3, report)
            groups.append(
                Instances(path, matrices[chosen], None if colors is None else colors.clip(0.0, 1.0), primvars)
            )
    return groups


def _optional(
    attribute: Usd.Attribute, time: Usd.TimeCode, columns: int, count: int, prim: Usd.Prim, report: Report
) -> Floats | None:
    """An array with one row per instance; None if it is absent or cannot be used."""
    try:
        rows = read.floats(attribute, time, columns)
    except Unreadable as trouble:
        report.warn(prim.GetPath(), f"{trouble}; ignored")
        return None
    if rows is None or len(rows) == 0:
        return None
    if len(rows) != count:
        report.warn(prim.GetPath(), f"{attribute.GetName()} has {len(rows)} values for {count} instances; ignored")
        return None
    return rows


def _rotations(quaternions: Floats) -> Floats:
    """Matrices [k, 3, 3] of quaternions [k, 4] in USD's memory order i, j, k, real; 0 means no rotation."""
    length = np.linalg.norm(quaternions, axis=1, keepdims=True)
    unit = np.where(length > 0.0, quaternions / np.where(length > 0.0, length, 1.0), [0.0, 0.0, 0.0, 1.0])
    x, y, z, w = unit.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def _spins(vectors: Floats) -> Floats:
    """Matrices [k, 3, 3] of rotation vectors [k, 3]: their direction the axis, their length the angle [rad]."""
    angle = np.linalg.norm(vectors, axis=1, keepdims=True)
    axis = vectors / np.where(angle > 0.0, angle, 1.0)
    return _rotations(np.concatenate([axis * np.sin(0.5 * angle), np.cos(0.5 * angle)], axis=1))


def _mask(instancer: UsdGeom.PointInstancer, count: int, time: Usd.TimeCode, report: Report) -> Mask:
    """Which instances [k] are neither invisible nor inactive; without ids they are known by their index."""
    path = instancer.GetPath()
    ids: Ints = np.arange(count)
    try:
        authored = read.ints(instancer.GetIdsAttr(), time)
        hidden = read.ints(instancer.GetInvisibleIdsAttr(), time)
    except Unreadable as trouble:
        report.warn(path, f"{trouble}; ignored")
        authored, hidden = None, None
    if authored is not None and len(authored) == count:
        ids = authored
    elif authored is not None and len(authored):
        report.warn(path, f"ids has {len(authored)} values for {count} instances; ignored")
    inactive = instancer.GetPrim().GetMetadata("inactiveIds")
    off = np.array(inactive.GetAppliedItems() if inactive else [], dtype=np.int64)
    if hidden is not None:
        off = np.concatenate([off, hidden])
    return ~np.isin(ids, off)
