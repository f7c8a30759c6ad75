"""Colour spaces by name (USD's, MaterialX's and those of other renderers), and conversion to linear Rec. 709."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from pxr import Gf

from warp_ir.image.ocio import OcioConfig, active_config
from warp_ir.image.tonemap import srgb_to_linear
from warp_ir.scene import Floats, InputError
from warp_ir.usd.values.report import Unreadable

_NAMES = Gf.ColorSpaceNames
_REC709 = Gf.ColorSpace(_NAMES.LinearRec709)
_ALIASES = {
    **{name.lower(): getattr(_NAMES, name) for name in dir(_NAMES) if not name.startswith("_")},
    **dict.fromkeys(("srgb", "srgb_texture", "srgb_tx", "srgb_rec709"), _NAMES.SRGBRec709),
    **dict.fromkeys(("acescg", "lin_ap1", "aces - acescg"), _NAMES.LinearAP1),
    **dict.fromkeys(("aces2065-1", "aces2065_1", "lin_ap0"), _NAMES.LinearAP0),
    **dict.fromkeys(
        ("lin_srgb", "lin_rec709", "linear", "scene_linear", "scene-linear rec.709-srgb"), _NAMES.LinearRec709
    ),
    **dict.fromkeys(("lin_rec2020", "rec2020"), _NAMES.LinearRec2020),
    **dict.fromkeys(("lin_displayp3", "lin_p3d65"), _NAMES.LinearP3D65),
    "srgb_displayp3": _NAMES.SRGBP3D65,
    "g22_ap1": _NAMES.G22AP1,
    "adobergb": _NAMES.G22AdobeRGB,
    "lin_adobergb": _NAMES.LinearAdobeRGB,
    **dict.fromkeys(("g18_rec709", "gamma18"), _NAMES.G18Rec709),
    **dict.fromkeys(("g22_rec709", "gamma22"), _NAMES.G22Rec709),
    **dict.fromkeys(("g24_rec709", "gamma24"), _NAMES.G24Rec709),
}
"""USD's name of each colour space by its other names, in lower case."""
_NOT_CONVERTED = {"", "auto", "none", _NAMES.Data, _NAMES.Raw, _NAMES.Unknown, _NAMES.Identity, "non-color"}
"""Names of values that are no colours, or of unknown colour space: they are used unconverted."""
_SINGULAR = 1.0e-9
"""Determinant below which a matrix has no use."""
_CURVE_ERROR = 1.0e-3
"""Relative error up to which a transform of OpenColorIO counts as a matrix and a curve."""


@dataclass(frozen=True, eq=False)
class ConfiguredSpace:
    """A colour space of the OpenColorIO configuration: a curve for each channel, and a matrix."""

    name: str
    decode: Callable[[Floats], Floats] | None
    """Values in it to linear ones; None: they are linear."""
    to_rec709: Floats
    """float64 [3, 3], linear values, as columns, to linear Rec. 709."""


Space: TypeAlias = Gf.ColorSpace | ConfiguredSpace


def color_space(name: str) -> Space | None:
    """The colour space of a given name; None: linear Rec. 709 or no colour, so that no conversion is needed.

    Names that USD does not know are looked up in the OpenColorIO configuration, if there is one.

    Raises:
        Unreadable: There is no colour space of that name, or it cannot be used.
    """
    name = _ALIASES.get(name.lower(), name)
    if name.lower() in _NOT_CONVERTED or name == _NAMES.LinearRec709:
        return None
    if Gf.ColorSpace.IsValid(name):
        return Gf.ColorSpace(name)
    try:
        config = active_config()
    except InputError as error:
        raise Unreadable(f"unknown colour space '{name}' ({error})") from None
    if config is None or not config.has_space(name):
        where = "" if config is None else f", neither to USD nor to {config.path}"
        raise Unreadable(f"unknown colour space '{name}'{where}")
    return _configured(config, name)


@functools.lru_cache(maxsize=64)
def _configured(config: OcioConfig, name: str) -> ConfiguredSpace:
    """A colour space of a configuration, taken apart into a curve and a matrix.

    With a curve c and a matrix M, colours x become M c(x). Those of the axes give the columns of M, up to a factor.

    Raises:
        Unreadable: It is no curve for each channel and a matrix.
    """
    black, *axes = config.to_rec709(np.concatenate([np.zeros((1, 3)), np.eye(3)]), name).astype(np.float64)
    matrix = np.stack([axis - black for axis in axes], axis=1)
    if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < _SINGULAR:
        raise Unreadable(f"colour space '{name}' of {config.path} is no matrix and a curve")
    inverse = np.linalg.inv(matrix)

    def decode(values: Floats) -> Floats:
        grey = np.repeat(np.asarray(values, np.float64).reshape(-1, 1), 3, axis=1)
        linear = config.to_rec709(grey, name).astype(np.float64) @ inverse.T
        return np.asarray(linear.mean(axis=1).reshape(values.shape))

    mixed = np.random.default_rng(0).random((64, 3))
    expected = config.to_rec709(mixed, name)
    if not np.allclose(decode(mixed) @ matrix.T, expected, rtol=_CURVE_ERROR, atol=_CURVE_ERROR * abs(matrix).max()):
        raise Unreadable(f"colour space '{name}' of {config.path} is no matrix and a curve")
    greys = np.linspace(0.0, 4.0, 33)
    is_linear = np.allclose(decode(greys), greys, rtol=_CURVE_ERROR, atol=_CURVE_ERROR)
    return ConfiguredSpace(name, None if is_linear else decode, matrix)


def decoder(space: Space) -> Callable[[Floats], Floats] | None:
    """The decoding transfer function of a colour space, encoded values to linear ones; None if it is linear."""
    if isinstance(space, ConfiguredSpace):
        return space.decode
    gamma, bias = float(space.GetGamma()), float(space.GetLinearBias())
    if gamma == 1.0:
        return None
    if bias == 0.0:
        return lambda values: np.maximum(values, 0.0) ** gamma
    return srgb_to_linear


def space_name(space: Space) -> str:
    """Name by which `color_space` finds a colour space."""
    return space.name if isinstance(space, ConfiguredSpace) else str(space.GetName())


def rgb_conversion_matrix(source: Space | None, target: Space | None) -> Floats:
    """The matrix from linear colours of one space to those of another, float64 [3, 3], for column vectors.

    None stands for linear Rec. 709.
    """
    from_source, from_target = (_to_xyz(space) for space in (source, target))
    matrix: Floats = np.linalg.solve(from_target, from_source)
    return matrix


def _to_xyz(space: Space | None) -> Floats:
    """The matrix from a linear space to XYZ, float64 [3, 3]."""
    if isinstance(space, ConfiguredSpace):
        return np.asarray(_to_xyz(None) @ space.to_rec709, np.float64)
    return np.array((space or _REC709).GetRGBToXYZ(), np.float64).reshape(3, 3)


def to_rec709(colors: Floats, space: Space | None) -> Floats:
    """Colours [..., 3] of a colour space, converted to linear Rec. 709."""
    if space is None:
        return colors
    decode = decoder(space)
    return (colors if decode is None else decode(colors)) @ rgb_conversion_matrix(space, None).T
