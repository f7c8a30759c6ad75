"""Error metrics of a picture against a reference: relative mean squared error, mean ratio, and z scores.

The relative mean squared error measures the size of the error. The mean ratio tells whether the whole picture is too
bright or too dark: the error of virtual point lights is correlated over the image, and can be a shift without visible
noise. The z scores tell whether noise explains the difference.
"""

import numpy as np
import numpy.typing as npt

from warp_ir.scene import InputError

Array = npt.NDArray[np.floating]


def relative_mse(
    image: Array, reference: Array, *, reference_error: Array | None = None, scale: Array | None = None
) -> float:
    """Mean of (x − r)² / (r² + 0.01·m²) over pixels and channels, with m the mean of the reference r.

    The second term of the denominator limits the weight of black pixels. The result does not change when picture and
    reference are scaled.

    Args:
        image: Linear radiance x, any shape.
        reference: Linear radiance r, the same shape.
        reference_error: Standard error of the reference, the same shape. Its contribution to the result is subtracted:
            a picture as good as the reference then has a result near 0, positive or negative.
        scale: Replaces r in the denominator, the same shape. A noisy r that is too dark by chance gives its own error
            a large weight, and its standard error underestimates that; a smooth `scale` avoids this bias.

    Raises:
        InputError: The shapes differ, or the reference is black.
    """
    x, r = _pair(image, reference)
    d = r if scale is None else _pair(scale, reference)[0]
    m = d.mean()
    if not m > 0.0:
        raise InputError("relative_mse: the reference is black; no error is relative to it")
    weight = 1.0 / (d * d + 0.01 * m * m)
    error = float(np.mean((x - r) ** 2 * weight))
    if reference_error is not None:
        noise, _ = _pair(reference_error, reference)
        error -= float(np.mean(noise * noise * weight))
    return error


def mean_ratio(image: Array, reference: Array) -> float:
    """mean(x) / mean(r) − 1: 0 if the picture is as bright as the reference, 0.01 if it is 1 % brighter.

    Raises:
        InputError: The shapes differ, or the reference is black.
    """
    x, r = _pair(image, reference)
    if not r.mean() > 0.0:
        raise InputError("mean_ratio: the reference is black; no mean is relative to it")
    return float(x.mean() / r.mean() - 1.0)


def z_scores(
    image: Array, standard_error: Array, reference: Array, reference_error: Array | float = 0.0
) -> npt.NDArray[np.float64]:
    """Differences in units of their standard deviation, (x − r) / √(σ² + σᵣ²), of the shape of the image.

    If both pictures are unbiased and their standard errors correct, the scores have mean 0 and variance 1. Where both
    standard errors are 0, the score is 0 if the values agree and ±∞ if they do not.

    Args:
        image: x, any shape.
        standard_error: σ of x, the same shape.
        reference: r, the same shape.
        reference_error: σᵣ of r, the same shape; 0 for an exact reference.

    Raises:
        InputError: The shapes differ.
    """
    x, r = _pair(image, reference)
    sigma, _ = _pair(standard_error, reference)
    sigma = np.hypot(sigma, np.asarray(reference_error, dtype=np.float64))
    difference = x - r
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(difference == 0.0, 0.0, difference / sigma)


def _pair(a: Array, b: Array) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Both arrays as float64; raises `InputError` if their shapes differ or they are empty."""
    a64, b64 = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if a64.shape != b64.shape:
        raise InputError(f"the pictures differ in shape: {a64.shape} and {b64.shape}")
    if a64.size == 0:
        raise InputError("the pictures are empty")
    return a64, b64
