"""Intel Open Image Denoise, which makes a smoother picture than the variance-guided filter.

Optional: ``pip install 'warp-ir[denoise]'``. It denoises the unfiltered mean, guided by the film's albedo and normals.
The film shows the mean of its picture and of the filtered one, since their errors are hardly correlated. It is off by
default, because its bias has no known bound.
"""

import time
from functools import cache
from types import ModuleType

import numpy as np
import numpy.typing as npt

from warp_ir.scene import InputError

_PROBE_SIZE = 128  # width and height of the picture on which the denoiser's speed is measured [pixels]
_SMALL_NETWORK_TIME = 0.44
"""Time of the smaller network ("balanced") relative to the larger one, whose picture has 3 to 10 % less error."""
_MAX_TIME_SHARE = 1 / 6
"""Share of a time limit that the larger network may take; beyond it, the smaller one leaves time for iterations."""


def require_denoiser() -> ModuleType:
    """The module of Open Image Denoise.

    Raises:
        InputError: It is not installed.
    """
    try:
        import pyoidn
    except ImportError as error:
        raise InputError("denoise: Open Image Denoise is not installed: pip install 'warp-ir[denoise]'") from error
    module: ModuleType = pyoidn
    return module


def denoise(
    radiance: npt.NDArray[np.floating],
    albedo: npt.NDArray[np.floating],
    normal: npt.NDArray[np.floating],
    clean_features: bool,
    time_limit: float | None = None,
) -> npt.NDArray[np.float32]:
    """Denoises a picture.

    Args:
        radiance: The noisy picture, linear, [height, width, 3].
        albedo: [height, width, 3].
        normal: [height, width, 3].
        clean_features: Whether albedo and normals are free of noise: the denoiser then keeps all their edges.
        time_limit: Limit of the whole render [s]; where the larger network would take too much of it, the smaller one
            is used. None: the larger one.

    Returns:
        The denoised picture, float32 [height, width, 3].

    Raises:
        InputError: The denoiser is not installed.
    """
    color, base, facing = (np.ascontiguousarray(x, np.float32) for x in (radiance, albedo, normal))
    quality = "balanced" if _uses_small_network(radiance.shape[0] * radiance.shape[1], time_limit) else "high"
    oidn = require_denoiser()
    result = oidn.denoise(color, np.clip(base, 0.0, 1.0), facing, hdr=True, clean_aux=clean_features, quality=quality)
    return np.asarray(result, np.float32)


def denoise_seconds(pixels: int, time_limit: float | None = None) -> float:
    """Estimated time of `denoise` [s].

    Raises:
        InputError: The denoiser is not installed.
    """
    require_denoiser()
    factor = _SMALL_NETWORK_TIME if _uses_small_network(pixels, time_limit) else 1.0
    return pixels * _seconds_per_pixel() * factor


def _uses_small_network(pixels: int, time_limit: float | None) -> bool:
    return time_limit is not None and pixels * _seconds_per_pixel() > _MAX_TIME_SHARE * time_limit


@cache
def _seconds_per_pixel() -> float:
    """Time of the larger network [s/pixel], measured once; the measurement also initialises the denoiser."""
    oidn = require_denoiser()
    blank = np.zeros((_PROBE_SIZE, _PROBE_SIZE, 3), np.float32)
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        oidn.denoise(blank, blank, blank, hdr=True, clean_aux=True, quality="balanced")
        seconds.append(time.perf_counter() - start)
    return min(seconds) / (_SMALL_NETWORK_TIME * blank[..., 0].size)
