"""Intel Open Image Denoise, for those who want a smoother picture than the variance-guided filter gives.

Optional: ``pip install 'warp-ir[denoise]'``. The picture is the mean of what it makes and of what our filter makes:
their errors are hardly related. It works on the plain mean, with the albedo and normals that the film has
gathered beside it. It is biased in ways that nobody can state, which is why it is off unless asked for.
"""

import time
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ir.scene import InputError

_PROBE = 128  # pixels to a side of the picture on which its speed is measured
_BALANCED = 0.44
"""Time of the smaller network to that of the larger one, whose picture has 3 to 10 % less error."""
_HURRY = 1 / 6
"""Share of a time limit from which on more iterations make up for the smaller network."""


def require_denoiser() -> Any:
    """The denoiser's module.

    Raises:
        InputError: It is not installed.
    """
    try:
        import pyoidn
    except ImportError as error:
        raise InputError("denoise: Open Image Denoise is not installed: pip install 'warp-ir[denoise]'") from error
    return pyoidn


def denoise(
    radiance: npt.NDArray[Any],
    albedo: npt.NDArray[Any],
    normal: npt.NDArray[Any],
    clean: bool,
    time_limit: float | None = None,
) -> npt.NDArray[np.float32]:
    """A denoised picture, float32 [height, width, 3], of a noisy one and its features, all that shape.

    `clean` says that the features have no noise: it takes their edges for true. With a `time_limit` [s] on the whole
    render, it may be a little worse and take less of that time.

    Raises:
        InputError: The denoiser is not installed.
    """
    color, base, facing = (np.ascontiguousarray(x, np.float32) for x in (radiance, albedo, normal))
    quality = "balanced" if _hurried(radiance.shape[0] * radiance.shape[1], time_limit) else "high"
    oidn = require_denoiser()
    result = oidn.denoise(color, np.clip(base, 0.0, 1.0), facing, hdr=True, clean_aux=clean, quality=quality)
    return np.asarray(result, np.float32)


def denoise_seconds(pixels: int, time_limit: float | None = None) -> float:
    """How long `denoise` will take [s].

    Raises:
        InputError: The denoiser is not installed.
    """
    require_denoiser()
    return pixels * _seconds_per_pixel() * (_BALANCED if _hurried(pixels, time_limit) else 1.0)


def _hurried(pixels: int, time_limit: float | None) -> bool:
    return time_limit is not None and pixels * _seconds_per_pixel() > _HURRY * time_limit


@cache
def _seconds_per_pixel() -> float:
    """Of the larger network; measured once, which also gets the denoiser ready."""
    oidn = require_denoiser()
    blank = np.zeros((_PROBE, _PROBE, 3), np.float32)
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        oidn.denoise(blank, blank, blank, hdr=True, clean_aux=True, quality="balanced")
        seconds.append(time.perf_counter() - start)
    return min(seconds) / (_BALANCED * blank[..., 0].size)
