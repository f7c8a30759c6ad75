"""Intel Open Image Denoise, for those who want a smoother picture than the variance-guided filter gives.

Optional: ``pip install 'warp-ir[denoise]'``. The picture is the mean of what it makes and of what our filter makes:
their errors are hardly related. It works on the plain mean, with the albedo and normals that the film has
gathered beside it. It is biased in ways that nobody can state, which is why it is off unless asked for.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ir.scene import InputError


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
    radiance: npt.NDArray[Any], albedo: npt.NDArray[Any], normal: npt.NDArray[Any], clean: bool
) -> npt.NDArray[np.float32]:
    """A denoised picture, float32 [height, width, 3], of a noisy one and its features, all that shape.

    `clean` says that the features have no noise: it takes their edges for true.

    Raises:
        InputError: The denoiser is not installed.
    """
    color, base, facing = (np.ascontiguousarray(x, np.float32) for x in (radiance, albedo, normal))
    result = require_denoiser().denoise(color, np.clip(base, 0.0, 1.0), facing, hdr=True, clean_aux=clean)
    return np.asarray(result, np.float32)
