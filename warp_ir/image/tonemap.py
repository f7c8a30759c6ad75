"""Tone mapping, from linear radiance to display values: exposure, a tone curve, the sRGB transfer function.

All functions work channel by channel on NumPy arrays of any shape, except those of luminance.
"""

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from warp_ir.scene import InputError

Array = npt.NDArray[np.floating]

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Weights of linear Rec. 709 red, green and blue in the luminance Y."""
_MIDDLE_GREY = 0.18


def srgb_from_linear(linear: Array) -> Array:
    """The sRGB transfer function of IEC 61966-2-1; clips to [0, 1]."""
    x = np.clip(linear, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1.0 / 2.4) - 0.055)


def srgb_to_linear(values: Array) -> Array:
    """The inverse of sRGB's transfer function, continued above 1."""
    low = values <= 0.04045
    return np.where(low, values / 12.92, ((np.maximum(values, 0.04045) + 0.055) / 1.055) ** 2.4)


def filmic(linear: Array) -> Array:
    """Fit of the ACES filmic tone curve by Narkowicz (2015, "ACES Filmic Tone Mapping Curve"); linear, in [0, 1].

    Its shoulder reaches 1 near a radiance of 8, so that highlights are compressed where `srgb_from_linear` alone
    would clip them at 1.
    """
    # The curve is flat above the shoulder; the bound keeps the squares of huge radiances finite.
    x = np.clip(linear, 0.0, 1e3)
    return np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0.0, 1.0)


_CURVES: dict[str, Callable[[Array], Array]] = {"srgb": lambda linear: linear, "filmic": filmic}
TONEMAPS = tuple(_CURVES)
"""Names of the tone curves; the first is the default."""


def tone_map(radiance: Array, exposure: float = 0.0, tonemap: str = "srgb") -> Array:
    """Display values in [0, 1] of linear radiance.

    Args:
        radiance: Linear, any shape.
        exposure: Exposure [stops]; the radiance is multiplied by 2 to this power.
        tonemap: "srgb" (no tone curve, clips at 1) or "filmic".

    Raises:
        InputError: There is no such tone curve, or the exposure is not a number within ±1000 stops.
    """
    if tonemap not in _CURVES:
        raise InputError(f"tonemap: must be one of {', '.join(TONEMAPS)}, is {tonemap!r}")
    if not abs(exposure) <= 1000.0:
        raise InputError(f"exposure: must be within ±1000 stops, is {exposure!r}")
    with np.errstate(over="ignore"):
        exposed = radiance * 2.0**exposure
    return srgb_from_linear(_CURVES[tonemap](exposed))


def luminance(radiance: Array) -> Array:
    """Luminance [...] of linear Rec. 709 colours [..., 3]."""
    return radiance @ _LUMINANCE.astype(radiance.dtype)


def suggest_exposure(radiance: Array, exposure: float = 0.0) -> float | None:
    """Suggests an exposure [stops] for a picture that `exposure` shows almost white or almost black.

    The suggestion maps the log-average luminance to middle grey (Reinhard et al. 2002), in steps of half a stop. None
    if the mean display value is between 4 % and 96 %, or the picture is entirely black.

    Args:
        radiance: Linear, shape [..., 3].
        exposure: Exposure with which the picture is shown [stops].
    """
    log_luminance = _log_luminance(radiance)
    if log_luminance.size == 0:
        return None
    shown = float(np.mean(srgb_from_linear(np.exp2(np.clip(log_luminance + exposure, -64.0, 64.0)))))
    if 0.04 < shown < 0.96:
        return None
    # Adding zero turns a negative zero into a positive one.
    return round(2.0 * (math.log2(_MIDDLE_GREY) - float(np.mean(log_luminance)))) / 2.0 + 0.0


def automatic_exposure(radiance: Array) -> float:
    """The exposure [stops] that maps the log-average luminance [..., 3] to middle grey; 0 if the picture is black."""
    log_luminance = _log_luminance(radiance)
    return math.log2(_MIDDLE_GREY) - float(np.mean(log_luminance)) if log_luminance.size else 0.0


def _log_luminance(radiance: Array) -> Array:
    """Logarithms to the base 2 of the luminances that are positive, [n]; float64 prevents overflow."""
    positive = luminance(np.asarray(radiance, dtype=np.float64))
    return np.asarray(np.log2(positive[positive > 0.0]))
