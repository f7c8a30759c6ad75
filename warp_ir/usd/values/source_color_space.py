"""Colour spaces by name (USD's, MaterialX's and those of other renderers), and conversion to linear Rec. 709."""

from collections.abc import Callable

import numpy as np
from pxr import Gf

from warp_ir.scene import Floats
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


def color_space(name: str) -> Gf.ColorSpace | None:
    """The colour space of a given name; None: linear Rec. 709 or no colour, so that no conversion is needed.

    Raises:
        Unreadable: There is no colour space of that name.
    """
    name = _ALIASES.get(name.lower(), name)
    if name.lower() in _NOT_CONVERTED or name == _NAMES.LinearRec709:
        return None
    if not Gf.ColorSpace.IsValid(name):
        raise Unreadable(f"unknown colour space '{name}'")
    return Gf.ColorSpace(name)


def decoder(space: Gf.ColorSpace) -> Callable[[Floats], Floats] | None:
    """The decoding transfer function of a colour space, encoded values to linear ones; None if it is linear."""
    gamma, bias = float(space.GetGamma()), float(space.GetLinearBias())
    if gamma == 1.0:
        return None
    if bias == 0.0:
        return lambda values: np.maximum(values, 0.0) ** gamma
    return srgb_to_linear


def srgb_to_linear(values: Floats) -> Floats:
    """The inverse of sRGB's transfer function (IEC 61966-2-1), continued above 1."""
    low = values <= 0.04045
    return np.where(low, values / 12.92, ((np.maximum(values, 0.04045) + 0.055) / 1.055) ** 2.4)


def rgb_conversion_matrix(source: Gf.ColorSpace | None, target: Gf.ColorSpace | None) -> Floats:
    """The matrix from linear colours of one space to those of another, float64 [3, 3], for column vectors.

    None stands for linear Rec. 709.
    """
    from_source, from_target = (
        np.array((space or _REC709).GetRGBToXYZ(), np.float64).reshape(3, 3) for space in (source, target)
    )
    matrix: Floats = np.linalg.solve(from_target, from_source)
    return matrix


def to_rec709(colors: Floats, space: Gf.ColorSpace | None) -> Floats:
    """Colours [..., 3] of a colour space, converted to linear Rec. 709."""
    if space is None:
        return colors
    decode = decoder(space)
    return (colors if decode is None else decode(colors)) @ rgb_conversion_matrix(space, None).T
