"""From linear radiance to what a screen shows: exposure, a tone curve, the sRGB transfer function.

Everything here is pure NumPy on arrays of any shape, and works channel by channel.
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from warp_ir.scene import InputError

Array = npt.NDArray[np.floating]

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Weights of linear Rec. 709 red, green and blue in the luminance Y."""
_MIDDLE_GREY = 0.18


def srgb_from_linear(linear: Array) -> Array:
    """The sRGB transfer function, exactly as IEC 61966-2-1 has it; clips to [0, 1]."""
    x = np.clip(linear, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1.0 / 2.4) - 0.055)


def filmic(linear: Array) -> Array:
    """The curve that Narkowicz (2015, "ACES Filmic Tone Mapping Curve") fitted to the ACES reference.

    A toe, a nearly straight middle and a shoulder that reaches 1 near a radiance of 8: highlights roll
    off where `srgb_from_linear` alone would clip them at 1. The result is linear, in [0, 1].
    """
    # Beyond the shoulder the curve is flat; the bound keeps the squares of huge radiances finite.
    x = np.clip(linear, 0.0, 1e3)
    return np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0.0, 1.0)


_CURVES: dict[str, Callable[[Array], Array]] = {"srgb": lambda linear: linear, "filmic": filmic}
TONEMAPS = tuple(_CURVES)
"""Names of the tone curves; the first is the default."""


def tone_map(radiance: Array, exposure: float = 0.0, tonemap: str = "srgb") -> Array:
    """Display values in [0, 1] of linear radiance.

    Args:
        radiance: Linear, any shape.
        exposure: Stops: every whole one doubles the radiance first.
        tonemap: "srgb" (no curve, clips at 1) or "filmic".

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
    """Luminance of linear Rec. 709 colours, shape [..., 3] to [...]."""
    return radiance @ _LUMINANCE.astype(radiance.dtype)


def suggest_exposure(radiance: Array, exposure: float = 0.0) -> float | None:
    """The exposure [stops] that would show a picture properly, if `exposure` shows it almost white or black.

    The suggestion takes the log-average luminance to middle grey (Reinhard et al. 2002). A picture that
    is shown well enough gives None, and so does one that is black throughout.

    Args:
        radiance: Linear, shape [..., 3].
        exposure: Stops that the picture is shown with.
    """
    # In float64, and in log2: neither the exposure nor the picture can overflow.
    lit = luminance(np.asarray(radiance, dtype=np.float64))
    lit = lit[lit > 0.0]
    if lit.size == 0:
        return None
    shown = float(np.mean(srgb_from_linear(np.exp2(np.clip(np.log2(lit) + exposure, -64.0, 64.0)))))
    if 0.04 < shown < 0.96:
        return None
    # To half a stop, and never a negative zero.
    return round(2.0 * float(np.log2(_MIDDLE_GREY) - np.mean(np.log2(lit)))) / 2.0 + 0.0
