"""Type-checked attribute values: USD returns whatever type a file authors, even if the schema says otherwise."""

from collections.abc import Iterable

import numpy as np
from pxr import Sdf, Tf, Usd, UsdShade

from warp_ir.scene import Color, Floats, Ints
from warp_ir.usd.values.report import Unreadable
from warp_ir.usd.values.source_color_space import color_space, to_rec709


def raw(attribute: Usd.Attribute, time: Usd.TimeCode) -> object:
    """The unchecked value; None if there is none, or if USD fails to read it."""
    if not attribute:
        return None
    try:
        value: object = attribute.Get(time)
        return value
    except Tf.ErrorException:
        return None


def bracketing_samples(attribute: Usd.Attribute, time: Usd.TimeCode) -> tuple[float, float] | None:
    """The times of the last sample until a time and of the next one after it; None without samples.

    Both are that of the first sample before it, and that of the last sample after it.
    """
    if time.IsDefault() or not attribute:
        return None
    samples = attribute.GetBracketingTimeSamples(time.GetValue())
    if samples and samples[0] == samples[1]:
        return samples[0], attribute.GetBracketingTimeSamples(time.GetValue() + Usd.TimeCode.SafeStep())[1]
    return (samples[0], samples[1]) if samples else None


def sample_before(attribute: Usd.Attribute, time: Usd.TimeCode) -> Usd.TimeCode:
    """The time of the last sample until a time, or else of the first one; the time itself without samples."""
    samples = bracketing_samples(attribute, time)
    return time if samples is None else Usd.TimeCode(samples[0])


def floats(attribute: Usd.Attribute, time: Usd.TimeCode, columns: int) -> Floats | None:
    """An array of vectors, float64 [n, columns]; None if it has no value.

    Raises:
        Unreadable: The value is of another type.
    """
    return _numbers(attribute, time, (columns,), f"{columns} floats each")


def scalars(attribute: Usd.Attribute, time: Usd.TimeCode) -> Floats | None:
    """An array of numbers, float64 [n]; None if it has no value.

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
    """An array of integers, int64 [n] or [n, columns]; None if it has no value.

    Raises:
        Unreadable: The value is of another type.
    """
    value = raw(attribute, time)
    if value is None:
        return None
    array = np.asarray(value)
    if columns > 1 and array.ndim == 1 and array.size % columns == 0:
        array = array.reshape(-1, columns)  # files author int[] where the schema says int3[] or int4[]
    if array.shape[1:] != ((columns,) if columns > 1 else ()) or array.ndim == 0 or array.dtype.kind not in "iu":
        raise Unreadable(f"{attribute.GetName()} is a {type(value).__name__}, not an array of integers")
    return array.astype(np.int64)


def check_range(indices: Ints, count: int, name: str) -> None:
    """Check that the indices of an attribute `name` are in [0, count).

    Raises:
        Unreadable: An index is out of range.
    """
    if indices.size and (indices.min() < 0 or indices.max() >= count):
        worst = indices.min() if indices.min() < 0 else indices.max()
        raise Unreadable(f"{name} refers to point {worst} of {count}")


def number(attribute: Usd.Attribute, time: Usd.TimeCode, default: float) -> float:
    """A finite number; the default if it has no value.

    Raises:
        Unreadable: The value is no number, or not finite.
    """
    value = raw(attribute, time)
    if value is None:
        return default
    if isinstance(value, bool | str) or not np.isscalar(value) or not np.isfinite(value):
        raise Unreadable(f"{attribute.GetName()} is {short(value)}, not a finite number")
    return float(value)  # type: ignore[arg-type]


def flag(attribute: Usd.Attribute, time: Usd.TimeCode, default: bool = False) -> bool:
    """A boolean; the default if it has no value or one of another type."""
    value = raw(attribute, time)
    return bool(value) if isinstance(value, bool | int) else default


def text(attribute: Usd.Attribute, time: Usd.TimeCode, default: str = "") -> str:
    """A token or string; the default if it has no value or one of another type."""
    value = raw(attribute, time)
    return value if isinstance(value, str) else default


def color(attribute: Usd.Attribute, time: Usd.TimeCode, default: Color) -> Color:
    """A colour in linear Rec. 709; the default if it has no value.

    Raises:
        Unreadable: The value is not three finite numbers, or its colour space is unknown.
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
    """Colours [n, 3] converted from the colour space of their attribute (`color_space_name`) to linear Rec. 709.

    Raises:
        Unreadable: The colour space is unknown.
    """
    try:
        return to_rec709(colors, color_space(color_space_name(attribute)))
    except Unreadable as error:
        defined = Usd.ColorSpaceAPI.ComputeColorSpace(attribute, None)  # by a ColorSpaceDefinitionAPI of an ancestor
        if not defined.GetName():
            raise Unreadable(f"{attribute.GetName()} has the {error}") from None
        return to_rec709(colors, defined)


def color_space_name(attribute: Usd.Attribute) -> str:
    """Name, known or not, of an attribute's colour space: its own, else its prim's or nearest ancestor's, else ""."""
    name, prim = str(attribute.GetColorSpace() or ""), attribute.GetPrim()
    while not name and not prim.IsPseudoRoot():
        if prim.HasAPI(Usd.ColorSpaceAPI):
            name = text(Usd.ColorSpaceAPI(prim).GetColorSpaceNameAttr(), Usd.TimeCode.Default())
        prim = prim.GetParent()
    return name


def is_color(attribute: Usd.Attribute) -> bool:
    """Whether an attribute of three numbers holds a colour rather than a vector, which has no colour space."""
    return bool(attribute.GetRoleName() == Sdf.ValueRoleNames.Color or attribute.HasColorSpace())


def targets(relationship: Usd.Relationship) -> list[Sdf.Path]:
    """Forwarded targets of a relationship; empty if it is absent or authored as something else."""
    try:
        return list(relationship.GetForwardedTargets()) if relationship else []
    except Tf.ErrorException:
        return []


def tokens(attribute: Usd.Attribute, time: Usd.TimeCode) -> list[str]:
    """An array of tokens or strings; empty if it has no value or one of another type."""
    value = raw(attribute, time)
    return [str(token) for token in value] if isinstance(value, Iterable) else []


def producer(shader_input: UsdShade.Input) -> Usd.Attribute | None:
    """The value-producing attribute of a shader input, followed through interfaces of node graphs and materials."""
    if not shader_input:
        return None
    attributes = UsdShade.Utils.GetValueProducingAttributes(shader_input)
    return attributes[0] if attributes else None


def short(value: object) -> str:
    """A value as text for a one-line message, shortened to 40 characters."""
    line = " ".join(str(value).split())
    return line if len(line) <= 40 else line[:37] + "…"
