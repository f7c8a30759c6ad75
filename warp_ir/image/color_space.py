"""Linear colour spaces in which pictures are written; rendering is in linear Rec. 709.

A space is defined by its primaries and its white point. The Bradford transform adapts colours between white points, so
that white stays white. The names are those of the Color Interop Forum, as in USD's GfColorSpace.
"""

import functools

import numpy as np
import numpy.typing as npt

Chromaticities = tuple[float, float, float, float, float, float, float, float]
"""CIE xy of red, green, blue and white."""

_D65 = (0.3127, 0.3290)
_ACES_WHITE = (0.32168, 0.33767)
REC709 = "lin_rec709_scene"
COLOR_SPACES: dict[str, Chromaticities] = {
    REC709: (0.640, 0.330, 0.300, 0.600, 0.150, 0.060, *_D65),
    "lin_ap1_scene": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, *_ACES_WHITE),
    "lin_ap0_scene": (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.0770, *_ACES_WHITE),
    "lin_rec2020_scene": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *_D65),
    "lin_p3d65_scene": (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *_D65),
    "lin_adobergb_scene": (0.640, 0.330, 0.210, 0.710, 0.150, 0.060, *_D65),
}
"""The known colour spaces by name; the first is that of the renderer."""
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
"""From XYZ to cone responses (Lam 1985)."""


def from_rec709(colors: npt.NDArray[np.floating], name: str) -> npt.NDArray[np.float32]:
    """Converts linear Rec. 709 colours [..., 3] to the linear space `name`."""
    if name == REC709:
        return np.asarray(colors, np.float32)
    converted: npt.NDArray[np.float32] = (colors @ matrix(name).T).astype(np.float32)
    return converted


@functools.cache
def matrix(name: str) -> npt.NDArray[np.float64]:
    """Matrix [3, 3] that takes linear Rec. 709 colours, as columns, to the linear space `name`."""
    return np.asarray(np.linalg.solve(_xyz_d65_from(name), _xyz_d65_from(REC709)), np.float64)


def _xyz_d65_from(name: str) -> npt.NDArray[np.float64]:
    """Matrix [3, 3] from a linear space to XYZ, adapted to D65."""
    *primaries, white_x, white_y = COLOR_SPACES[name]
    columns = np.stack([_xyz(x, y) for x, y in zip(primaries[::2], primaries[1::2], strict=True)], axis=1)
    white = _xyz(white_x, white_y)
    from_rgb = columns * np.linalg.solve(columns, white)
    gain = (_BRADFORD @ _xyz(*_D65)) / (_BRADFORD @ white)
    out: npt.NDArray[np.float64] = np.linalg.inv(_BRADFORD) @ (gain[:, None] * (_BRADFORD @ from_rgb))
    return out


def _xyz(x: float, y: float) -> npt.NDArray[np.float64]:
    """XYZ of a chromaticity with Y = 1, or with Y = 0 if y is 0."""
    return np.array([x, y, 1.0 - x - y]) / (y if y else 1.0)
