"""Primvars: from values per prim, face, point or face-vertex to one value per corner of each triangle."""

import numpy as np
from pxr import Usd, UsdGeom

from warp_ir.scene import Floats, Ints
from warp_ir.usd import value
from warp_ir.usd.report import Report, Unreadable
from warp_ir.usd.shape import Shape


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


def display_color(
    prim: Usd.Prim, shape: Shape, time: Usd.TimeCode, report: Report, name: str = "displayColor"
) -> Floats | None:
    """The prim's own or inherited displayColor: float64 [3] if it is one colour, [m, 3, 3] if not, None if unset.

    A primvar with a wrong number of values is reduced to its first value, and named; so is a displayOpacity below 1.
    `name` is that of another primvar to be read likewise.
    """
    opacity = np.asarray(
        value.raw(UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance("displayOpacity").GetAttr(), time)
    )
    if opacity.dtype.kind == "f" and (opacity < 1.0).any():
        report.warn(prim.GetPath(), "displayOpacity is not honoured: it is drawn opaque ({n} in all)")
    found = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
    if not found or not found.HasValue():
        return None
    try:
        values = value.floats(found.GetAttr(), time, 3)
        if values is None or len(values) == 0:
            return None
        values = value.to_linear_rec709(found.GetAttr(), values)
        indices = value.ints(found.GetIndicesAttr(), time) if found.IsIndexed() else None
    except Unreadable as trouble:
        report.warn(prim.GetPath(), f"{trouble}; {name} ignored")
        return None
    if not np.isfinite(values).all():
        report.warn(prim.GetPath(), f"{name} has values that are not finite, taken as 0")
        values = np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)
    if values.min() < 0.0 or values.max() > 1.0:
        report.warn(prim.GetPath(), f"{name} outside [0, 1] clamped")
        values = values.clip(0.0, 1.0)
    try:
        colors = expand(shape, values, found.GetInterpolation(), indices)
    except Unreadable as trouble:
        report.warn(prim.GetPath(), f"{name}: {trouble}; its first value is used throughout")
        colors = values[:1, None]
    if len(colors) == 0 or (colors == colors[0, 0]).all():
        first: Floats = colors[0, 0] if len(colors) else values[0]
        return first
    return colors


def texture_coordinates(prim: Usd.Prim, shape: Shape, name: str, time: Usd.TimeCode, report: Report) -> Floats | None:
    """The prim's own or inherited uv set, float32 [m, 3, 2]; None, and named, where there is none that can be used."""
    found = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
    if not found or not found.HasValue():
        report.warn(prim.GetPath(), f"no primvar '{name}' to place textures by: one point of them is shown")
        return None
    try:
        size = np.shape(value.raw(found.GetAttr(), time))[-1:]
        values = value.floats(found.GetAttr(), time, 3 if size == (3,) else 2)
        indices = value.ints(found.GetIndicesAttr(), time) if found.IsIndexed() else None
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
