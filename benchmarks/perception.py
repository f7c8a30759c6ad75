"""What people see of an error: FLIP, and regular patterns, neither of which the relMSE tells."""

import numpy as np
import numpy.typing as npt

Pixels = npt.NDArray[np.floating]

HIGH_FREQUENCY = 0.25
"""Lowest frequency [1/pixel] of a pattern."""


def flip(picture: Pixels, reference: Pixels) -> float | None:
    """Mean HDR-FLIP of a picture against its reference, in [0, 1]; None without the package flip-evaluator.

    The picture is compared at several exposures, which the reference decides (Andersson et al. 2021, "Visualizing
    Errors in Rendered High Dynamic Range Images").
    """
    try:
        import flip_evaluator
    except ImportError:
        return None
    pair = (np.maximum(np.asarray(image, np.float32), 0.0) for image in (reference, picture))
    return float(flip_evaluator.evaluate(*pair, "HDR", applyMagma=False)[1])


def pattern_peak(picture: Pixels, reference: Pixels) -> float:
    """How regular the error is: the largest power of a frequency over the mean power, of the whitened residual.

    The residual of the mean of the channels is whitened: less its mean over 7 x 7 pixels, over the deviation that is
    left among 15 x 15. Only frequencies above 1/4 per pixel count. White noise has about 0.6 + log(n), n being the
    number of independent frequencies: 11 for a picture of 256 x 256; a weave or a grid has hundreds.
    """
    residual = (np.asarray(picture, np.float64) - reference).mean(axis=2)
    residual = residual - _box_mean(residual, 7)
    deviation = np.sqrt(_box_mean(residual**2, 15))
    white = residual / np.maximum(deviation, 1e-9 * deviation.max() + 1e-300)
    power = np.abs(np.fft.rfft2(white)) ** 2
    rows, columns = white.shape
    frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns)[None, :])
    high = power[frequency > HIGH_FREQUENCY]
    return float(high.max() / max(high.mean(), 1e-300))


def _box_mean(values: Pixels, width: int) -> Pixels:
    """Means over squares of `width` (odd) pixels; the picture is mirrored at its border."""
    half = width // 2
    for axis in (0, 1):
        margin = [(half + 1, half) if k == axis else (0, 0) for k in (0, 1)]
        total = np.cumsum(np.pad(values, margin, mode="symmetric"), axis=axis)
        upper, lower = np.arange(width, total.shape[axis]), np.arange(total.shape[axis] - width)
        values = (np.take(total, upper, axis) - np.take(total, lower, axis)) / width
    return values
