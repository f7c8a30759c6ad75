"""Instancing: nested levels of instances, and point instancers, whose arrays are validated here."""

import math
from collections.abc import Hashable, Iterable
from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from warp_ir.memory import require_memory
from warp_ir.scene import Bools, Floats, Ints
from warp_ir.usd.geometry.velocities import Motion, motion_after_sample
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable

_BYTES_PER_INSTANCE = 450
"""Memory in which an instance is read, at the peak: measured for ten million."""


@dataclass(frozen=True, eq=False)
class InstanceLevel:
    """The instances of a prototype that one native instance or point instancer makes; the outermost is the world."""

    key: Hashable
    """Key of the prototype: levels with equal keys may have equal contents."""
    parent: "InstanceLevel | None"
    """The level that contains the instances; None for the world."""
    matrices: Floats
    """parent_from_level, float64 [k, 4, 4]."""
    colors: Floats | None = None
    """displayColor of each instance, float64 [k, 3], or None; that of prims in the prototype is stronger."""
    primvars: "InstancePrimvars | None" = None
    """Other primvars of the instancer with a value per instance."""

    @property
    def instance_count(self) -> int:
        """Number of instances in the world: the product over all levels."""
        return math.prod(len(level.matrices) for level in self.chain())

    def chain(self) -> "list[InstanceLevel]":
        """The levels from the world down to this one."""
        levels = [self]
        while levels[-1].parent is not None:
            levels.append(levels[-1].parent)
        return levels[::-1]

    def world_matrices(self) -> Floats:
        """world_from_level of every instance, float64 [instance_count, 4, 4]."""
        require_memory(_BYTES_PER_INSTANCE * self.instance_count, f"{self.instance_count} nested instances")
        return nested_transforms(level.matrices for level in self.chain())


def nested_transforms(matrices: Iterable[Floats]) -> Floats:
    """Transforms of nested instances, given those of each level [k, 4, 4], outermost first: all products of them.

    Index order: the innermost level varies fastest.
    """
    out = np.eye(4)[None]
    for inner in matrices:
        out = (out[:, None] @ inner[None]).reshape(-1, 4, 4)
    return out


def nested_colors(levels: Iterable[tuple[int, Floats | None]]) -> Floats | None:
    """Colours of nested instances in the order of `nested_transforms`: those of the innermost level that has colours.

    Args:
        levels: Number of instances and colours of each level, outermost first.
    """
    out: Floats | None = None
    instances = 1
    for count, colors in levels:
        if colors is not None:
            out = np.tile(colors, (instances, 1))
        elif out is not None:
            out = np.repeat(out, count, axis=0)
        instances *= count
    return out


@dataclass(frozen=True, eq=False)
class InstancePrimvars:
    """The primvars of a point instancer, read only if a material needs them."""

    prim: Usd.Prim
    prototype: Sdf.Path
    count: int
    """Number of instances of the instancer."""
    selected: Ints
    """Indices of the instances of this prototype, int [k]."""
    time: Usd.TimeCode
    sampled: bool
    """Whether values are those of the time sample before `time`, because instances move by velocities."""

    def has(self, name: str) -> bool:
        """Whether the instancer has a value for a primvar."""
        return bool(UsdGeom.PrimvarsAPI(self.prim).GetPrimvar(name).HasValue())

    def read(self, name: str, channels: int, report: Report) -> Floats | None:
        """Values of a primvar for the k selected instances, float64 [k, c]; None if it has none that can be used.

        Primvars of interpolation vertex, varying or faceVarying have a value per instance, others one for all
        instances, which prims below the instancer inherit anyway.
        """
        primvar = UsdGeom.PrimvarsAPI(self.prim).GetPrimvar(name)
        if not primvar or not primvar.HasValue():
            return None
        single = primvar.GetInterpolation() in (UsdGeom.Tokens.constant, UsdGeom.Tokens.uniform)
        if single and self.prototype.HasPrefix(self.prim.GetPath()):
            return None
        count = 1 if single else self.count
        time = _at(primvar.GetAttr(), self.time, self.sampled and not single)
        try:
            if channels == 1:
                scalars = read.scalars(primvar.GetAttr(), time)
                values = None if scalars is None else scalars[:, None]
            else:
                values = read.floats(primvar.GetAttr(), time, channels)
            indices = read.ints(primvar.GetIndicesAttr(), self.time) if primvar.IsIndexed() else None
        except Unreadable as error:
            report.warn(self.prim.GetPath(), f"{error}; {name} ignored")
            return None
        if values is None or len(values) == 0:
            return None
        if indices is not None:
            if len(indices) and (indices.min() < 0 or indices.max() >= len(values)):
                report.warn(self.prim.GetPath(), f"{name}: an index is out of range; ignored")
                return None
            values = values[indices]
        if len(values) != count or not np.isfinite(values).all():
            what = "colour" if read.is_color(primvar.GetAttr()) else "value"
            instances = "all instances" if single else f"each of {count} instances"
            report.warn(self.prim.GetPath(), f"{name}: not one finite {what} for {instances}; ignored")
            return None
        if channels == 3 and read.is_color(primvar.GetAttr()):
            values = read.to_linear_rec709(primvar.GetAttr(), values)
        return values.repeat(len(self.selected), axis=0) if single else values[self.selected]


@dataclass(frozen=True, eq=False)
class PrototypeInstances:
    """The visible instances of one prototype of a point instancer."""

    prototype: Sdf.Path
    matrices: Floats
    """instancer_from_instance, float64 [k, 4, 4]; the prototype's own transform is applied before it."""
    colors: Floats | None
    """displayColor of each instance, float64 [k, 3], or None."""
    primvars: InstancePrimvars
    """The instancer's primvars for these instances."""


def read_instancer(prim: Usd.Prim, time: Usd.TimeCode, report: Report) -> list[PrototypeInstances]:
    """The visible instances of a PointInstancer, for each prototype that has any.

    USD's own ComputeInstanceTransformsAtTime returns uninitialised memory for arrays of wrong length. So arrays are
    validated here, and matrices composed: scale, then rotation, then translation.

    Raises:
        Unreadable: positions or protoIndices are missing, of the wrong type or of different lengths.
    """
    instancer = UsdGeom.PointInstancer(prim)
    indices = read.ints(instancer.GetProtoIndicesAttr(), time)
    prototypes = instancer.GetPrototypesRel().GetForwardedTargets()
    if indices is None or len(indices) == 0:
        return []
    count = len(indices)
    require_memory(_BYTES_PER_INSTANCE * count, f"{prim.GetPath()}: {count} instances")
    matrices, sampled = _instance_matrices(instancer, count, time, report)
    visible = _visible_mask(instancer, count, time, report)
    finite = np.isfinite(matrices).all(axis=(1, 2))
    if not finite.all():
        report.warn(prim.GetPath(), "{n} instances with NaN or infinite transforms left out", int((~finite).sum()))
    valid = (indices >= 0) & (indices < len(prototypes))
    if not valid.all():
        report.warn(prim.GetPath(), "{n} instances of prototypes that do not exist left out", int((~valid).sum()))
    visible &= finite & valid
    opacity = UsdGeom.PrimvarsAPI(prim).GetPrimvar("displayOpacity")
    if opacity and opacity.GetInterpolation() not in (UsdGeom.Tokens.constant, UsdGeom.Tokens.uniform):
        if np.any(np.asarray(read.raw(opacity.GetAttr(), _at(opacity.GetAttr(), time, sampled))) != 1.0):
            report.warn(prim.GetPath(), "displayOpacity per instance is not supported: instances are opaque")
    groups = []
    for number, path in enumerate(prototypes):
        selected = np.flatnonzero(visible & (indices == number)).astype(np.int32)
        if len(selected):
            primvars = InstancePrimvars(prim, path, count, selected, time, sampled)
            colors = primvars.read("displayColor", 3, report)
            colors = None if colors is None else colors.clip(0.0, 1.0)
            groups.append(PrototypeInstances(path, matrices[selected], colors, primvars))
    return groups


def _at(attribute: Usd.Attribute, time: Usd.TimeCode, sampled: bool) -> Usd.TimeCode:
    """The time at which a value per instance is read: that of the sample before if instances move by velocities."""
    return read.sample_before(attribute, time) if sampled else time


def _instance_matrices(
    instancer: UsdGeom.PointInstancer, count: int, time: Usd.TimeCode, report: Report
) -> tuple[Floats, bool]:
    """Transforms of the instances, float64 [count, 4, 4], and whether values per instance are those of a sample.

    As in USD, nothing is interpolated if velocities or angular velocities apply: an index may be that of another
    instance in the next sample.

    Raises:
        Unreadable: There is not one position per instance.
    """
    prim, attribute = instancer.GetPrim(), instancer.GetPositionsAttr()
    rates = instancer.GetVelocitiesAttr(), instancer.GetAccelerationsAttr()
    motion = motion_after_sample(attribute, 3, *rates, time, report)
    turning, orientations = _orientations(instancer, count, time, report)
    sampled = motion is not None or turning is not None
    if motion is None:
        positions = read.floats(attribute, _at(attribute, time, sampled), 3)
    else:
        positions = motion.start + motion.change
    if positions is None or len(positions) != count:
        raise Unreadable(f"it has {count} protoIndices but {0 if positions is None else len(positions)} positions")
    matrices = np.tile(np.eye(4), (count, 1, 1))
    if orientations is not None:
        start = _per_instance(orientations, _at(orientations, time, sampled), 4, count, prim, report)
        if start is not None:
            matrices[:, :3, :3] = _quaternion_matrices(start)
    if turning is not None:
        matrices[:, :3, :3] = _axis_angle_matrices(np.radians(turning.change)) @ matrices[:, :3, :3]
    attribute = instancer.GetScalesAttr()
    scales = _per_instance(attribute, _at(attribute, time, sampled), 3, count, prim, report)
    if scales is not None:
        matrices[:, :3, :3] *= scales[:, None, :]
    matrices[:, :3, 3] = positions
    return matrices, sampled


def _orientations(
    instancer: UsdGeom.PointInstancer, count: int, time: Usd.TimeCode, report: Report
) -> tuple[Motion | None, Usd.Attribute | None]:
    """What turns the instances since a sample of their orientations, and the attribute that holds these."""
    for attribute in (instancer.GetOrientationsfAttr(), instancer.GetOrientationsAttr()):
        if _per_instance(attribute, time, 4, count, instancer.GetPrim(), report) is not None:
            rates = instancer.GetAngularVelocitiesAttr(), None
            turning = motion_after_sample(attribute, 4, *rates, time, report)
            return turning if turning is not None and len(turning.start) == count else None, attribute
    return None, None


def _per_instance(
    attribute: Usd.Attribute, time: Usd.TimeCode, columns: int, count: int, prim: Usd.Prim, report: Report
) -> Floats | None:
    """An array with a row per instance, float64 [count, columns]; None if absent or, with a warning, invalid."""
    try:
        rows = read.floats(attribute, time, columns)
    except Unreadable as error:
        report.warn(prim.GetPath(), f"{error}; ignored")
        return None
    if rows is None or len(rows) == 0:
        return None
    if len(rows) != count:
        report.warn(prim.GetPath(), f"{attribute.GetName()} has {len(rows)} values for {count} instances; ignored")
        return None
    return rows


def _quaternion_matrices(quaternions: Floats) -> Floats:
    """Rotation matrices [k, 3, 3] of quaternions [k, 4] in USD's memory order i, j, k, real; 0 means no rotation."""
    length = np.linalg.norm(quaternions, axis=1, keepdims=True)
    unit = np.where(length > 0.0, quaternions / np.where(length > 0.0, length, 1.0), [0.0, 0.0, 0.0, 1.0])
    x, y, z, w = unit.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def _axis_angle_matrices(vectors: Floats) -> Floats:
    """Rotation matrices [k, 3, 3] of rotation vectors [k, 3], which have the angle [rad] as length."""
    angle = np.linalg.norm(vectors, axis=1, keepdims=True)
    axis = vectors / np.where(angle > 0.0, angle, 1.0)
    return _quaternion_matrices(np.concatenate([axis * np.sin(0.5 * angle), np.cos(0.5 * angle)], axis=1))


def _visible_mask(instancer: UsdGeom.PointInstancer, count: int, time: Usd.TimeCode, report: Report) -> Bools:
    """Mask [k] of the instances that are neither invisible nor inactive; without ids, an instance's id is its index."""
    path = instancer.GetPath()
    ids: Ints = np.arange(count)
    try:
        authored = read.ints(instancer.GetIdsAttr(), time)
        invisible = read.ints(instancer.GetInvisibleIdsAttr(), time)
    except Unreadable as error:
        report.warn(path, f"{error}; ignored")
        authored, invisible = None, None
    if authored is not None and len(authored) == count:
        ids = authored
    elif authored is not None and len(authored):
        report.warn(path, f"ids has {len(authored)} values for {count} instances; ignored")
    inactive = instancer.GetPrim().GetMetadata("inactiveIds")
    excluded = np.array(inactive.GetAppliedItems() if inactive else [], dtype=np.int64)
    if invisible is not None:
        excluded = np.concatenate([excluded, invisible])
    return ~np.isin(ids, excluded)
