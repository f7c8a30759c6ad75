"""Primvars: values per prim, face, point or face-vertex are expanded to the corners of the triangles."""

from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from warp_ir.scene import Floats, Ints
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable
from warp_ir.usd.values.triangles import TriangleMesh

_TEX_COORD_ROLE = Sdf.ValueRoleNames.TextureCoordinate


@dataclass(frozen=True, eq=False)
class SchemaPrimvar:
    """An attribute of a schema that is interpolated as a primvar is: normals or widths."""

    attribute: Usd.Attribute
    interpolation: str
    _primvar: UsdGeom.Primvar | None = None

    def indices(self, time: Usd.TimeCode) -> Ints | None:
        """Indices into its values, or None.

        Raises:
            Unreadable: They are no integers.
        """
        indexed = self._primvar is not None and self._primvar.IsIndexed()
        return read.ints(self._primvar.GetIndicesAttr(), time) if self._primvar is not None and indexed else None


def schema_primvar(prim: Usd.Prim, name: str) -> SchemaPrimvar:
    """The primvar of a name or, without a value of it, the schema's attribute of that name."""
    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar(name)
    if primvar and primvar.HasValue():
        return SchemaPrimvar(primvar.GetAttr(), primvar.GetInterpolation(), primvar)
    attribute = prim.GetAttribute(name)
    interpolation = attribute.GetMetadata("interpolation") if attribute else None
    return SchemaPrimvar(attribute, str(interpolation or UsdGeom.Tokens.vertex))


def expand(mesh: TriangleMesh, values: Floats, interpolation: str, indices: Ints | None = None) -> Floats:
    """Values of a primvar at the corners of the triangles, [m, 3, c].

    Args:
        mesh: The triangles.
        values: Authored values, [v, c].
        interpolation: The primvar's interpolation, a UsdGeom token.
        indices: Indices into `values`, or None if the primvar is not indexed.

    Raises:
        Unreadable: The number of values does not fit the interpolation, or an index is out of range.
    """
    if indices is not None:
        if len(indices) and (indices.min() < 0 or indices.max() >= len(values)):
            raise Unreadable(f"an index of the primvar is out of range of its {len(values)} values")
    count = len(values) if indices is None else len(indices)
    element = mesh.face
    if mesh.cells is not None and interpolation == UsdGeom.Tokens.uniform and count == mesh.cells.count:
        element = mesh.cells.of_face[mesh.face]
        count = len(mesh.cells.of_face)
        if element.min(initial=0) < 0:
            raise Unreadable("a surface face is not that of a tetrahedron")
    expected = 1 if interpolation == UsdGeom.Tokens.constant else mesh.element_counts.get(interpolation)
    if expected is None:
        raise Unreadable(f"its interpolation {interpolation} is not defined for this prim")
    if count != expected:
        raise Unreadable(f"it has {count} {interpolation} values where {expected} are needed")
    if mesh.refiner is not None and interpolation == UsdGeom.Tokens.faceVarying:
        return mesh.refiner.face_varying(values, indices)[mesh.corner]
    if indices is not None:
        values = values[indices]
    if interpolation == UsdGeom.Tokens.constant:
        return np.broadcast_to(values[0], (*mesh.triangles.shape, values.shape[1]))
    if interpolation == UsdGeom.Tokens.uniform:
        return np.broadcast_to(values[element][:, None], (*mesh.triangles.shape, values.shape[1]))
    if interpolation == UsdGeom.Tokens.faceVarying:
        return values[mesh.corner]
    if mesh.refiner is not None:
        smooth = interpolation == UsdGeom.Tokens.vertex
        values = mesh.refiner.vertex(values) if smooth else mesh.refiner.varying(values)
    return values[mesh.triangles]


def corner_values(
    prim: Usd.Prim, mesh: TriangleMesh, name: str, channels: int, time: Usd.TimeCode, report: Report
) -> Floats | None:
    """The prim's own or inherited primvar: float64 [c] if it is constant, else [m, 3, c]; None if it has no value.

    Colours are converted to linear Rec. 709. Of a primvar with a wrong number of values the first is used, with a
    warning.
    """
    primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
    if not primvar or not primvar.HasValue():
        return None
    try:
        values = _value_rows(primvar.GetAttr(), _time_of(primvar, mesh, time), channels)
        if values is None or len(values) == 0:
            return None
        if channels >= 3 and read.is_color(primvar.GetAttr()):
            rgb = read.to_linear_rec709(primvar.GetAttr(), values[:, :3])
            values = np.concatenate([rgb, values[:, 3:]], axis=1)
        indices = read.ints(primvar.GetIndicesAttr(), time) if primvar.IsIndexed() else None
    except Unreadable as error:
        report.warn(prim.GetPath(), f"{error}; {name} ignored")
        return None
    if not np.isfinite(values).all():
        report.warn(prim.GetPath(), f"{name} has values that are not finite, taken as 0")
        values = np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)
    try:
        corners = expand(mesh, values, primvar.GetInterpolation(), indices)
    except Unreadable as error:
        report.warn(prim.GetPath(), f"{name}: {error}; its first value is used everywhere")
        corners = values[:1, None]
    if len(corners) == 0 or (corners == corners[0, 0]).all():
        first: Floats = corners[0, 0] if len(corners) else values[0]
        return first
    return corners


def _time_of(primvar: UsdGeom.Primvar, mesh: TriangleMesh, time: Usd.TimeCode) -> Usd.TimeCode:
    """The time at which the values of a primvar are read: that of a sample if they belong to elements that are."""
    if not (mesh.sampled and primvar) or primvar.GetInterpolation() == UsdGeom.Tokens.constant:
        return time
    return read.sample_before(primvar.GetAttr(), time)


def _value_rows(attribute: Usd.Attribute, time: Usd.TimeCode, channels: int) -> Floats | None:
    """The values of a primvar as rows [v, c]; a single value that is no array is one row."""
    single = np.asarray(read.raw(attribute, time))
    if single.shape == ((channels,) if channels > 1 else ()) and single.dtype.kind in "fiu":
        return single.reshape(1, channels).astype(np.float64)
    if channels > 1:
        return read.floats(attribute, time, channels)
    values = read.scalars(attribute, time)
    return None if values is None else values[:, None]


def display_color(prim: Usd.Prim, mesh: TriangleMesh, time: Usd.TimeCode, report: Report) -> Floats | None:
    """The prim's own or inherited displayColor as an albedo, in the form of `corner_values`."""
    colors = corner_values(prim, mesh, "displayColor", 3, time, report)
    if colors is None:
        return None
    if colors.min() < 0.0 or colors.max() > 1.0:
        report.warn(prim.GetPath(), "displayColor outside [0, 1] clamped")
    return colors.clip(0.0, 1.0)


def display_opacity(prim: Usd.Prim, mesh: TriangleMesh, time: Usd.TimeCode, report: Report) -> Floats:
    """The prim's own or inherited displayOpacity, [1] or per triangle [m]; 1 if it has no value.

    Varying opacity is averaged over each triangle and rounded to multiples of 1/255, to limit the number of materials.
    """
    primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance("displayOpacity")
    authored = read.raw(primvar.GetAttr(), _time_of(primvar, mesh, time))
    if np.all(np.asarray(1.0 if authored is None else authored) == 1.0):
        return np.ones(1)
    corners = corner_values(prim, mesh, "displayOpacity", 1, time, report)
    if corners is None:
        return np.ones(1)
    opacity: Floats = corners.clip(0.0, 1.0).reshape(len(corners), -1).mean(axis=1)
    if corners.ndim > 1:
        opacity = np.round(opacity * 255.0) / 255.0
    if ((opacity > 0.0) & (opacity < 1.0)).any():
        report.warn(prim.GetPath(), "partial opacity lets a share of the light through, straight on ({n} in all)")
    return opacity


def texture_coordinates(
    prim: Usd.Prim, mesh: TriangleMesh, name: str, time: Usd.TimeCode, report: Report
) -> Floats | None:
    """The prim's own or inherited texture coordinates, float32 [m, 3, 2]; None, with a warning, if none can be used.

    Without a primvar of that name, the first one with the role of texture coordinates is used, with a warning.
    """
    primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
    if not primvar or not primvar.HasValue():
        others = UsdGeom.PrimvarsAPI(prim).FindPrimvarsWithInheritance()
        primvar = next((p for p in others if p.GetTypeName().role == _TEX_COORD_ROLE and p.HasValue()), None)
        if primvar is None:
            report.warn(prim.GetPath(), f"no primvar '{name}' for texture coordinates: (0, 0) is used everywhere")
            return None
        used = primvar.GetPrimvarName()
        report.warn(prim.GetPath(), f"no primvar '{name}' for texture coordinates: '{used}' is used instead")
    try:
        values_time = _time_of(primvar, mesh, time)
        size = np.shape(np.asarray(read.raw(primvar.GetAttr(), values_time)))[-1:]
        values = read.floats(primvar.GetAttr(), values_time, 3 if size == (3,) else 2)
        indices = read.ints(primvar.GetIndicesAttr(), time) if primvar.IsIndexed() else None
        if values is None or len(values) == 0:
            raise Unreadable(f"{name} is empty")
        corners = expand(mesh, values[:, :2], primvar.GetInterpolation(), indices)
    except Unreadable as error:
        report.warn(prim.GetPath(), f"{name}: {error}; (0, 0) is used everywhere")
        return None
    if not np.isfinite(corners).all():
        report.warn(prim.GetPath(), f"{name} has values that are not finite, taken as 0")
    largest = float(np.finfo(np.float32).max)
    return np.nan_to_num(corners, nan=0.0, posinf=0.0, neginf=0.0).clip(-largest, largest).astype(np.float32)
