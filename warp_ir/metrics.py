"""How far a picture is from the truth: the three numbers that every claim of this project is made with.

The relative mean squared error says how far, the mean ratio whether the picture as a whole is too
bright or dark (the error of virtual point lights is correlated over the image: it can be a shift that
looks like no noise at all), and the z scores whether the difference is explained by noise.
"""

import numpy as np
import numpy.typing as npt

from warp_ir.scene import InputError

Array = npt.NDArray[np.floating]


def relative_mse(
    image: Array, reference: Array, *, reference_error: Array | None = None, scale: Array | None = None
) -> float:
    """Mean of (x − r)² / (r² + 0.01·m²) over pixels and channels, with m the mean of the reference r.

    The second term of the denominator keeps black pixels from deciding alone; a scene twice as bright
    has the same error.

    Args:
        image: Linear radiance x, any shape.
        reference: Linear radiance r, the same shape.
        reference_error: The reference's own standard error, the same shape. What it adds to the result
            is subtracted; a picture as good as the reference then scores around 0, below as well as above.
        scale: Stands for r in the denominator, the same shape. Where a noisy r is too dark by chance it weighs
            its own error most, and more than its standard error knows; a smooth picture without that noise does not.

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
    """Differences in units of their standard deviation: (x − r) / √(σ² + σᵣ²), shape as the image.

    If both pictures are unbiased and their standard errors honest, the scores have mean 0 and variance
    1. Where both errors are 0 the score is 0 if the values agree and ±∞ if they do not.

    Args:
        image: x, any shape.
        standard_error: σ of x, the same shape.
        reference: r, the same shape.
        reference_error: σᵣ of r, the same shape; 0 for a value that is known.

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
    """Both as float64, checked to have one shape."""
    a64, b64 = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if a64.shape != b64.shape:
        raise InputError(f"the pictures differ in shape: {a64.shape} and {b64.shape}")
    if a64.size == 0:
        raise InputError("the pictures are empty")
    return a64, b64
