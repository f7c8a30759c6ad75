"""Typed attribute values: USD hands out whatever a file holds, whatever the schema says."""

from typing import Any

import numpy as np
from pxr import Sdf, Tf, Usd, UsdShade

from warp_ir.scene import Color, Floats, Ints
from warp_ir.usd.values.report import Unreadable
from warp_ir.usd.values.source_color_space import color_space, to_rec709


def raw(attribute: Usd.Attribute, time: Usd.TimeCode) -> Any:
    """The value as USD gives it, None where there is none or where USD itself fails to read it."""
    if not attribute:
        return None
    try:
        return attribute.Get(time)
    except Tf.ErrorException:
        return None


def floats(attribute: Usd.Attribute, time: Usd.TimeCode, columns: int) -> Floats | None:
    """An array of vectors, float64 [n, columns]; None where nothing is authored.

    Raises:
        Unreadable: The value is of another type.
    """
    return _numbers(attribute, time, (columns,), f"{columns} floats each")


def scalars(attribute: Usd.Attribute, time: Usd.TimeCode) -> Floats | None:
    """An array of numbers, float64 [n]; None where nothing is authored.

    Raises:
        Unreadable: The value is of another type.
    """
    return _numbers(attribute, time, (), "numbers")


def _numbers(attribute: Usd.Attribute, time: Usd.TimeCode, row: tuple[int, ...], what: str) -> Floats | None:
    value = raw(attribute, time)
    if value is None:
        return None
    array = np.asarray(value)
    if array.ndim == 0 or array.shape[1:] != row or array.dtype.kind not in "fiu":
        raise Unreadable(f"{attribute.GetName()} is a {type(value).__name__}, not an array of {what}")
    return array.astype(np.float64)


def ints(attribute: Usd.Attribute, time: Usd.TimeCode, columns: int = 1) -> Ints | None:
    """An array of integers, int64 [n] or [n, columns]; None where nothing is authored.

    Raises:
        Unreadable: The value is of another type.
    """
    value = raw(attribute, time)
    if value is None:
        return None
    array = np.asarray(value)
    if columns > 1 and array.ndim == 1 and array.size % columns == 0:
        array = array.reshape(-1, columns)  # int[] where the schema says int3[] or int4[] means the same
    if array.shape[1:] != ((columns,) if columns > 1 else ()) or array.ndim == 0 or array.dtype.kind not in "iu":
        raise Unreadable(f"{attribute.GetName()} is a {type(value).__name__}, not an array of integers")
    return array.astype(np.int64)


def check_range(indices: Ints, count: int, name: str) -> None:
    """See that indices, of points of which there are `count`, exist.

    Raises:
        Unreadable: They do not; `name` is what holds them.
    """
    if indices.size and (indices.min() < 0 or indices.max() >= count):
        worst = indices.min() if indices.min() < 0 else indices.max()
        raise Unreadable(f"{name} refers to point {worst} of {count}")


def number(attribute: Usd.Attribute, time: Usd.TimeCode, default: float) -> float:
    """A finite number; the default where nothing is authored.

    Raises:
        Unreadable: The value is not a number, or not finite.
    """
    value = raw(attribute, time)
    if value is None:
        return default
    if isinstance(value, bool | str) or not np.isscalar(value) or not np.isfinite(value):
        raise Unreadable(f"{attribute.GetName()} is {short(value)}, not a finite number")
    return float(value)  # type: ignore[arg-type]


def flag(attribute: Usd.Attribute, time: Usd.TimeCode, default: bool = False) -> bool:
    """A truth value; the default where it is absent or something else."""
    value = raw(attribute, time)
    return bool(value) if isinstance(value, bool | int) else default


def text(attribute: Usd.Attribute, time: Usd.TimeCode, default: str = "") -> str:
    """A token or string; the default where it is absent or something else."""
    value = raw(attribute, time)
    return value if isinstance(value, str) else default


def color(attribute: Usd.Attribute, time: Usd.TimeCode, default: Color) -> Color:
    """A linear Rec.709 colour; the default where nothing is authored.

    Raises:
        Unreadable: The value is not three finite numbers.
    """
    value = raw(attribute, time)
    if value is None:
        return default
    array = np.asarray(value)
    if array.shape != (3,) or array.dtype.kind not in "fiu" or not np.isfinite(array).all():
        raise Unreadable(f"{attribute.GetName()} is {short(value)}, not a finite colour")
    red, green, blue = to_linear_rec709(attribute, array.astype(np.float64).reshape(1, 3))[0].tolist()
    return red, green, blue


def to_linear_rec709(attribute: Usd.Attribute, colors: Floats) -> Floats:
    """Colours [n, 3] of an attribute, taken from its colour space (its own, its prim's or an ancestor's)."""
    try:
        return to_rec709(colors, color_space(color_space_name(attribute)))
    except Unreadable as trouble:
        defined = Usd.ColorSpaceAPI.ComputeColorSpace(attribute, None)  # by a prim above
        if not defined.GetName():
            raise Unreadable(f"{attribute.GetName()} has the {trouble}") from None
        return to_rec709(colors, defined)


def color_space_name(attribute: Usd.Attribute) -> str:
    """The colour space of an attribute, else of its prim or the nearest above that has one, known or not; else ""."""
    name, prim = str(attribute.GetColorSpace() or ""), attribute.GetPrim()
    while not name and not prim.IsPseudoRoot():
        if prim.HasAPI(Usd.ColorSpaceAPI):
            name = text(Usd.ColorSpaceAPI(prim).GetColorSpaceNameAttr(), Usd.TimeCode.Default())
        prim = prim.GetParent()
    return name


def is_color(attribute: Usd.Attribute) -> bool:
    """Whether an attribute of three numbers holds a colour, and not a vector, which no colour space is for."""
    return bool(attribute.GetRoleName() == Sdf.ValueRoleNames.Color or attribute.HasColorSpace())


def targets(relationship: Usd.Relationship) -> list[Sdf.Path]:
    """What a relationship points to; nothing where it is absent, or is no relationship in the file."""
    try:
        return list(relationship.GetForwardedTargets()) if relationship else []
    except Tf.ErrorException:
        return []


def tokens(attribute: Usd.Attribute, time: Usd.TimeCode) -> list[str]:
    """An array of tokens or strings; empty where it is absent or something else."""
    value = raw(attribute, time)
    try:
        return [str(token) for token in value or ()]
    except TypeError:
        return []


def producer(shader_input: UsdShade.Input) -> Usd.Attribute | None:
    """The attribute an input's value comes from, through the interfaces of node graphs and materials."""
    if not shader_input:
        return None
    attributes = UsdShade.Utils.GetValueProducingAttributes(shader_input)
    return attributes[0] if attributes else None


def short(value: object) -> str:
    """A value for a message of one line."""
    words = " ".join(str(value).split())
    return words if len(words) <= 40 else words[:37] + "…"
