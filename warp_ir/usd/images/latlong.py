"""Environment maps in other layouts, resampled to latitude-longitude.

UsdLux names the layouts but does not define their orientation. Here the centre of an image shows the dome's +Z, as in
the lat-long layout, its right +X and its top +Y. This agrees with a mirrored ball that is photographed along -Z, with
Debevec's angular map, and with OpenGL's cube map faces in a vertical cross.
"""

import math

import numpy as np
import numpy.typing as npt

from warp_ir.scene import Floats
from warp_ir.usd.values.report import Unreadable

_MAX_HEIGHT = 1024
"""Maximum number of rows of the result: 0.18 degrees each."""
_SUPERSAMPLES = 3
"""Lookups per texel along each axis."""


def to_latlong(image: Floats, layout: str) -> Floats:
    """An environment map resampled to the layout of a dome's `Light.texture`.

    Args:
        image: [h, w, 3], row 0 at the top.
        layout: One of `LAYOUTS`, a token of UsdLux's texture:format.

    Returns:
        float32 [n, 2 n, 3].

    Raises:
        Unreadable: The image of a cross is not three faces wide and four high.
    """
    height, width = image.shape[:2]
    if layout == "cubeMapVerticalCross" and height * 3 != width * 4:
        raise Unreadable(f"{width} x {height} pixels are no vertical cross of 3 x 4 square faces")
    pixel_of = LAYOUTS[layout]
    rows = min(max(height // 2 if layout == "cubeMapVerticalCross" else height, 2), _MAX_HEIGHT)
    out = np.zeros((rows, 2 * rows, 3), np.float32)
    band = max(2**20 // (2 * rows * _SUPERSAMPLES**2), 1)
    for first in range(0, rows, band):
        count = min(band, rows - first)
        theta = (first + (np.arange(count * _SUPERSAMPLES) + 0.5) / _SUPERSAMPLES) / rows * math.pi
        u = (np.arange(2 * rows * _SUPERSAMPLES) + 0.5) / (2 * rows * _SUPERSAMPLES)
        # u = 1/2 - atan2(x, z) / 2π; the polar angle θ is measured from +Y.
        azimuth = (0.5 - u) * 2.0 * math.pi
        x, z = np.sin(theta)[:, None] * np.sin(azimuth), np.sin(theta)[:, None] * np.cos(azimuth)
        y = np.broadcast_to(np.cos(theta)[:, None], x.shape)
        values = _bilinear(image, *pixel_of(x, y, z, width, height))
        out[first : first + count] = values.reshape(count, _SUPERSAMPLES, 2 * rows, _SUPERSAMPLES, 3).mean(axis=(1, 3))
    return out


_PixelPosition = tuple[Floats, Floats, Floats, Floats, Floats, Floats]
"""Continuous column and row, pixel centres at halves; then the first and last column, first and last row to use."""


def _on_disk(radius: Floats, x: Floats, y: Floats, width: int, height: int) -> _PixelPosition:
    """Positions at a radius from the image's centre, 1 being its edge, in the direction of (x, y)."""
    length = np.maximum(np.hypot(x, y), 1.0e-12)
    column = (0.5 + 0.5 * radius * x / length) * width
    row = (0.5 - 0.5 * radius * y / length) * height
    zero = np.zeros(1)
    return column, row, zero, zero + width - 1, zero, zero + height - 1


def _angular(x: Floats, y: Floats, z: Floats, width: int, height: int) -> _PixelPosition:
    """An angular map: the radius is proportional to the angle to +Z."""
    return _on_disk(np.arctan2(np.hypot(x, y), z) / math.pi, x, y, width, height)


def _mirrored_ball(x: Floats, y: Floats, z: Floats, width: int, height: int) -> _PixelPosition:
    """A mirrored ball: its normal is halfway between the reflected direction and the one to the camera."""
    return _on_disk(np.sin(0.5 * np.arctan2(np.hypot(x, y), z)), x, y, width, height)


def _vertical_cross(x: Floats, y: Floats, z: Floats, width: int, height: int) -> _PixelPosition:
    """Cube faces -X, +Z, +X in the second row; +Y above +Z, below it -Y and then -Z, upside down."""
    side = width // 3
    largest = np.maximum(np.maximum(np.abs(x), np.abs(y)), np.abs(z))
    faces = [  # column and row of the face; directions on it; its right and up axes
        (1, 1, z == largest, x, y),
        (2, 1, x == largest, -z, y),
        (0, 1, x == -largest, z, y),
        (1, 0, y == largest, x, -z),
        (1, 2, y == -largest, x, z),
        (1, 3, z == -largest, x, -y),
    ]
    on_face = [face[2] for face in faces]
    left = np.select(on_face, [np.full(1, face[0] * side) for face in faces]).astype(np.float64)
    top = np.select(on_face, [np.full(1, face[1] * side) for face in faces]).astype(np.float64)
    right, up = np.select(on_face, [f[3] for f in faces]), np.select(on_face, [f[4] for f in faces])
    column, row = left + (0.5 + 0.5 * right / largest) * side, top + (0.5 - 0.5 * up / largest) * side
    return column, row, left, left + side - 1, top, top + side - 1


LAYOUTS = {"angular": _angular, "mirroredBall": _mirrored_ball, "cubeMapVerticalCross": _vertical_cross}
"""Pixel positions by direction (x, y, z), per token of UsdLux's texture:format."""


def _bilinear(
    image: Floats, column: Floats, row: Floats, left: Floats, right: Floats, top: Floats, bottom: Floats
) -> npt.NDArray[np.float32]:
    """Bilinearly interpolated values [..., 3] at continuous positions, clamped to the given columns and rows."""
    x, y = column - 0.5, row - 0.5
    i, j = np.floor(x), np.floor(y)
    fx, fy = (x - i)[..., None].astype(np.float32), (y - j)[..., None].astype(np.float32)
    low, high = np.clip(i, left, right).astype(np.int64), np.clip(i + 1, left, right).astype(np.int64)
    above, below = np.clip(j, top, bottom).astype(np.int64), np.clip(j + 1, top, bottom).astype(np.int64)
    upper = image[above, low] * (1.0 - fx) + image[above, high] * fx
    lower = image[below, low] * (1.0 - fx) + image[below, high] * fx
    values: npt.NDArray[np.float32] = (upper * (1.0 - fy) + lower * fy).astype(np.float32)
    return values
