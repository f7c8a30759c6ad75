"""Primvars: from values per prim, face, point or face-vertex to one value per corner of each triangle."""

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from warp_ir.scene import Floats, Ints
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable
from warp_ir.usd.values.triangles import Shape

_COORDINATES = Sdf.ValueRoleNames.TextureCoordinate


def expand(shape: Shape, values: Floats, interpolation: str, indices: Ints | None = None) -> Floats:
    """Values of a primvar at the corners, [m, 3, c].

    Args:
        shape: The triangles.
        values: [v, c].
        interpolation: A UsdGeom token.
        indices: Into `values`, or None if the primvar is not indexed.

    Raises:
        Unreadable: There are too few or too many values, or an index is out of range.
    """
    if indices is not None:
        if len(indices) and (indices.min() < 0 or indices.max() >= len(values)):
            raise Unreadable(f"an index of the primvar is out of range, there are {len(values)} values")
    count = len(values) if indices is None else len(indices)
    expected = 1 if interpolation == UsdGeom.Tokens.constant else shape.elements.get(interpolation)
    if expected is None:
        raise Unreadable(f"{interpolation} values on a shape that has no such elements")
    if count != expected:
        raise Unreadable(f"{count} {interpolation} values where {expected} are needed")
    if shape.refined is not None and interpolation == UsdGeom.Tokens.faceVarying:
        return shape.refined.face_varying(values, indices)[shape.corner]
    if indices is not None:
        values = values[indices]
    if interpolation == UsdGeom.Tokens.constant:
        return np.broadcast_to(values[0], (*shape.triangles.shape, values.shape[1]))
    if interpolation == UsdGeom.Tokens.uniform:
        return np.broadcast_to(values[shape.face][:, None], (*shape.triangles.shape, values.shape[1]))
    if interpolation == UsdGeom.Tokens.faceVarying:
        return values[shape.corner]
    if shape.refined is not None:
        smooth = interpolation == UsdGeom.Tokens.vertex
        values = shape.refined.vertex(values) if smooth else shape.refined.varying(values)
    return values[shape.triangles]


def corner_values(
    prim: Usd.Prim, shape: Shape, name: str, channels: int, time: Usd.TimeCode, report: Report
) -> Floats | None:
    """The prim's own or inherited primvar: float64 [c] if it is one value, [m, 3, c] if not, None if unset.

    Colours are taken to linear Rec. 709. A primvar with a wrong number of values is reduced to its first, and named.
    """
    found = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
    if not found or not found.HasValue():
        return None
    try:
        values = _rows(found.GetAttr(), time, channels)
        if values is None or len(values) == 0:
            return None
        if channels >= 3 and read.is_color(found.GetAttr()):
            rgb = read.to_linear_rec709(found.GetAttr(), values[:, :3])
            values = np.concatenate([rgb, values[:, 3:]], axis=1)
        indices = read.ints(found.GetIndicesAttr(), time) if found.IsIndexed() else None
    except Unreadable as trouble:
        report.warn(prim.GetPath(), f"{trouble}; {name} ignored")
        return None
    if not np.isfinite(values).all():
        report.warn(prim.GetPath(), f"{name} has values that are not finite, taken as 0")
        values = np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)
    try:
        corners = expand(shape, values, found.GetInterpolation(), indices)
    except Unreadable as trouble:
        report.warn(prim.GetPath(), f"{name}: {trouble}; its first value is used throughout")
        corners = values[:1, None]
    if len(corners) == 0 or (corners == corners[0, 0]).all():
        first: Floats = corners[0, 0] if len(corners) else values[0]
        return first
    return corners


def _rows(attribute: Usd.Attribute, time: Usd.TimeCode, channels: int) -> Floats | None:
    """The values of a primvar, [v, c]; it may be a single one that is no array."""
    single = np.asarray(read.raw(attribute, time))
    if single.shape == ((channels,) if channels > 1 else ()) and single.dtype.kind in "fiu":
        return single.reshape(1, channels).astype(np.float64)
    if channels > 1:
        return read.floats(attribute, time, channels)
    values = read.scalars(attribute, time)
    return None if values is None else values[:, None]


def display_color(prim: Usd.Prim, shape: Shape, time: Usd.TimeCode, report: Report) -> Floats | None:
    """The prim's own or inherited displayColor as an albedo, as `corner_values` has it."""
    colors = corner_values(prim, shape, "displayColor", 3, time, report)
    if colors is None:
        return None
    if colors.min() < 0.0 or colors.max() > 1.0:
        report.warn(prim.GetPath(), "displayColor outside [0, 1] clamped")
    return colors.clip(0.0, 1.0)


def display_opacity(prim: Usd.Prim, shape: Shape, time: Usd.TimeCode, report: Report) -> Floats:
    """The prim's own or inherited displayOpacity, 1 if unset; [1], or [m] where triangles differ, in 255ths."""
    authored = read.raw(UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance("displayOpacity").GetAttr(), time)
    if np.all(np.asarray(1.0 if authored is None else authored) == 1.0):
        return np.ones(1)
    found = corner_values(prim, shape, "displayOpacity", 1, time, report)
    if found is None:
        return np.ones(1)
    opacity: Floats = found.clip(0.0, 1.0).reshape(len(found), -1).mean(axis=1)
    if found.ndim > 1:
        opacity = np.round(opacity * 255.0) / 255.0
    if ((opacity > 0.0) & (opacity < 1.0)).any():
        report.warn(prim.GetPath(), "partial opacity lets a share of the light through, straight on ({n} in all)")
    return opacity


def texture_coordinates(prim: Usd.Prim, shape: Shape, name: str, time: Usd.TimeCode, report: Report) -> Floats | None:
    """The prim's own or inherited uv set, float32 [m, 3, 2]; None, and named, where there is none that can be used."""
    found = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
    if not found or not found.HasValue():
        others = UsdGeom.PrimvarsAPI(prim).FindPrimvarsWithInheritance()
        found = next((other for other in others if other.GetTypeName().role == _COORDINATES and other.HasValue()), None)
        if found is None:
            report.warn(prim.GetPath(), f"no primvar '{name}' to place textures by: one point of them is shown")
            return None
        report.warn(prim.GetPath(), f"no primvar '{name}' to place textures by: '{found.GetPrimvarName()}' does")
    try:
        size = np.shape(read.raw(found.GetAttr(), time))[-1:]
        values = read.floats(found.GetAttr(), time, 3 if size == (3,) else 2)
        indices = read.ints(found.GetIndicesAttr(), time) if found.IsIndexed() else None
        if values is None or len(values) == 0:
            raise Unreadable(f"{name} is empty")
        corners = expand(shape, values[:, :2], found.GetInterpolation(), indices)
    except Unreadable as trouble:
        report.warn(prim.GetPath(), f"{name}: {trouble}; one point of the textures is shown")
        return None
    if not np.isfinite(corners).all():
        report.warn(prim.GetPath(), f"{name} has values that are not finite, taken as 0")
    largest = float(np.finfo(np.float32).max)
    return np.nan_to_num(corners, nan=0.0, posinf=0.0, neginf=0.0).clip(-largest, largest).astype(np.float32)
