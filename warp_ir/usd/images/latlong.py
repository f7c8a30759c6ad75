"""Images of skies in layouts other than latitude and longitude, resampled to that one.

UsdLux names the layouts and not their directions. Here the middle of an image shows the dome's +Z, as it does in the
lat-long layout; its right shows +X and its top +Y, as a mirrored ball does that is photographed along -Z, as Debevec
defines the angular map, and as the faces of OpenGL's cube maps lie in a cross.
"""

import math

import numpy as np
import numpy.typing as npt

from warp_ir.scene import Floats
from warp_ir.usd.values.report import Unreadable

_HEIGHT = 1024
"""Most rows of the result: 0.18 degrees each."""
_FINE = 3
"""Lookups per texel along both sides."""


def to_latlong(image: Floats, layout: str) -> Floats:
    """A sky in the layout that `Light.texture` has.

    Args:
        image: [h, w, 3], row 0 at the top.
        layout: One of `LAYOUTS`.

    Returns:
        float32 [n, 2 n, 3].

    Raises:
        Unreadable: A cross is not three faces wide and four high.
    """
    height, width = image.shape[:2]
    if layout == "cubeMapVerticalCross" and height * 3 != width * 4:
        raise Unreadable(f"{width} x {height} pixels are no vertical cross of 3 x 4 faces")
    place = LAYOUTS[layout]
    rows = min(max(height // 2 if layout == "cubeMapVerticalCross" else height, 2), _HEIGHT)
    out = np.zeros((rows, 2 * rows, 3), np.float32)
    band = max(2**20 // (2 * rows * _FINE**2), 1)
    for first in range(0, rows, band):
        count = min(band, rows - first)
        theta = (first + (np.arange(count * _FINE) + 0.5) / _FINE) / rows * math.pi
        turn = (np.arange(2 * rows * _FINE) + 0.5) / (2 * rows * _FINE)
        # u = 1/2 - atan2(x, z) / 2π, and the polar angle is that to +Y.
        around = (0.5 - turn) * 2.0 * math.pi
        x, z = np.sin(theta)[:, None] * np.sin(around), np.sin(theta)[:, None] * np.cos(around)
        y = np.broadcast_to(np.cos(theta)[:, None], x.shape)
        values = _bilinear(image, *place(x, y, z, width, height))
        out[first : first + count] = values.reshape(count, _FINE, 2 * rows, _FINE, 3).mean(axis=(1, 3))
    return out


_Place = tuple[Floats, Floats, Floats, Floats, Floats, Floats]
"""Column and row with fractions, centres of pixels at halves; and the lowest and highest of each that may be used."""


def _on_disk(radius: Floats, x: Floats, y: Floats, width: int, height: int) -> _Place:
    """Places at a radius, 1 being the image's edge, in the direction of (x, y)."""
    length = np.maximum(np.hypot(x, y), 1.0e-12)
    column = (0.5 + 0.5 * radius * x / length) * width
    row = (0.5 - 0.5 * radius * y / length) * height
    zero = np.zeros(1)
    return column, row, zero, zero + width - 1, zero, zero + height - 1


def _angular(x: Floats, y: Floats, z: Floats, width: int, height: int) -> _Place:
    return _on_disk(np.arctan2(np.hypot(x, y), z) / math.pi, x, y, width, height)


def _mirrored_ball(x: Floats, y: Floats, z: Floats, width: int, height: int) -> _Place:
    """A ball's normal lies halfway between the direction it mirrors and the camera."""
    return _on_disk(np.sin(0.5 * np.arctan2(np.hypot(x, y), z)), x, y, width, height)


def _vertical_cross(x: Floats, y: Floats, z: Floats, width: int, height: int) -> _Place:
    """-X, +Z, +X side by side in the second row; +Y above the middle one, -Y and, upside down, -Z below it."""
    side = width // 3
    largest = np.maximum(np.maximum(np.abs(x), np.abs(y)), np.abs(z))
    faces = [  # column and row of the face; where it applies; right and up on it
        (1, 1, z == largest, x, y),
        (2, 1, x == largest, -z, y),
        (0, 1, x == -largest, z, y),
        (1, 0, y == largest, x, -z),
        (1, 2, y == -largest, x, z),
        (1, 3, z == -largest, x, -y),
    ]
    where = [face[2] for face in faces]
    left = np.select(where, [np.full(1, face[0] * side) for face in faces]).astype(np.float64)
    top = np.select(where, [np.full(1, face[1] * side) for face in faces]).astype(np.float64)
    right, up = np.select(where, [f[3] for f in faces]), np.select(where, [f[4] for f in faces])
    column, row = left + (0.5 + 0.5 * right / largest) * side, top + (0.5 - 0.5 * up / largest) * side
    return column, row, left, left + side - 1, top, top + side - 1


LAYOUTS = {"angular": _angular, "mirroredBall": _mirrored_ball, "cubeMapVerticalCross": _vertical_cross}
"""UsdLux's names of them."""


def _bilinear(
    image: Floats, column: Floats, row: Floats, left: Floats, right: Floats, top: Floats, bottom: Floats
) -> npt.NDArray[np.float32]:
    """Values [..., 3] between the centres of pixels; none from outside the bounds."""
    x, y = column - 0.5, row - 0.5
    i, j = np.floor(x), np.floor(y)
    fx, fy = (x - i)[..., None].astype(np.float32), (y - j)[..., None].astype(np.float32)
    low, high = np.clip(i, left, right).astype(np.int64), np.clip(i + 1, left, right).astype(np.int64)
    above, below = np.clip(j, top, bottom).astype(np.int64), np.clip(j + 1, top, bottom).astype(np.int64)
    upper = image[above, low] * (1.0 - fx) + image[above, high] * fx
    lower = image[below, low] * (1.0 - fx) + image[below, high] * fx
    values: npt.NDArray[np.float32] = (upper * (1.0 - fy) + lower * fy).astype(np.float32)
    return values
