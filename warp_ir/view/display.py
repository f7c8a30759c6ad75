"""From radiance to the pixels of a window: fast tone mapping, scaling, and points of VPLs over the picture."""

import functools

import numpy as np
import numpy.typing as npt

from warp_ir.image.tonemap import tone_map
from warp_ir.preview.plot import dot_colors
from warp_ir.scene import Camera, Floats
from warp_ir.vpl.trace import Vpls

Pixels = npt.NDArray[np.uint8]
"""[height, width, 3], sRGB, row 0 at the top."""
_HIDDEN = 0.02
"""Depth of a VPL behind the surface in its pixel, relative to it, from which it is hidden."""


def display_pixels(radiance: npt.NDArray[np.float32], exposure: float, tonemap: str) -> Pixels:
    """`tone_map` in 8 bits, by a table of all half-precision floats: some ten times as fast."""
    with np.errstate(over="ignore", invalid="ignore"):
        half = (radiance * np.float32(2.0**exposure)).astype(np.float16)
    return _table(tonemap)[half.view(np.uint16)]


@functools.cache
def _table(tonemap: str) -> npt.NDArray[np.uint8]:
    """The display value of every half-precision float by its bits, [65536]; 0 for those that are no numbers."""
    values = np.arange(1 << 16, dtype=np.uint16).view(np.float16).astype(np.float64)
    mapped = tone_map(np.nan_to_num(values, nan=0.0, posinf=1e30, neginf=0.0), 0.0, tonemap)
    return np.asarray(np.round(255.0 * mapped).astype(np.uint8))


def scaled(pixels: Pixels, width: int, height: int) -> Pixels:
    """A picture in another size, by bilinear interpolation."""
    if pixels.shape[:2] == (height, width):
        return pixels
    out: npt.NDArray[np.float32] = pixels.astype(np.float32)
    for axis, size in ((0, height), (1, width)):
        place = np.clip((np.arange(size) + 0.5) * out.shape[axis] / size - 0.5, 0.0, out.shape[axis] - 1)
        low = place.astype(np.intp)
        weight = (place - low).astype(np.float32).reshape((-1, 1, 1) if axis == 0 else (-1, 1))
        high = np.minimum(low + 1, out.shape[axis] - 1)
        out = np.take(out, low, axis) * (1.0 - weight) + np.take(out, high, axis) * weight
    return np.asarray(np.round(out).astype(np.uint8))


def visible_vpls(
    vpls: Vpls, camera: Camera, depth: npt.NDArray[np.floating]
) -> tuple[Floats, Floats, npt.NDArray[np.intp]]:
    """The VPLs that a camera sees: not behind it, not facing away, not hidden by a nearer surface.

    Args:
        vpls: The VPLs; directional ones have no position and are never seen.
        camera: The camera, fitted to the picture.
        depth: Depth of the surface that each pixel of a picture of this view sees, [height, width]; 0: none.

    Returns:
        Columns and rows as fractions of the picture [n], and indices of the VPLs [n], the farthest first.
    """
    column, row, z = camera.project(vpls.positions)
    inside = (column >= 0.0) & (column < 1.0) & (row >= 0.0) & (row < 1.0) & (z > 0.0) & ~vpls.directional
    index = np.flatnonzero(inside)
    height, width = depth.shape
    # Pixels on an edge hold a mean depth: the deepest surface of the neighbours decides.
    surface = np.where(depth > 0.0, depth, np.inf)
    deepest = np.max([np.roll(surface, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)
    x, y = (column[index] * width).astype(np.intp), (row[index] * height).astype(np.intp)
    seen = z[index] <= deepest[y, x] * (1.0 + _HIDDEN)
    normal = vpls.normals[index].astype(np.float64)
    to_camera = camera.world_from_camera[:3, 3] - vpls.positions[index]
    seen &= (np.einsum("ij,ij->i", normal, to_camera) > 0.0) | ~normal.any(axis=1)
    index = index[seen]
    index = index[np.argsort(-z[index], kind="stable")]
    return column[index], row[index], index


def draw_vpls(pixels: Pixels, vpls: Vpls, camera: Camera, depth: npt.NDArray[np.floating]) -> Pixels:
    """The picture with a dot for each VPL that `visible_vpls` finds, in the colour of its light with a dark edge."""
    height, width = pixels.shape[:2]
    column, row, index = visible_vpls(vpls, camera, depth)
    if not len(index):
        return pixels
    out = pixels.copy()
    colors = dot_colors(vpls.intensity)[index]
    x, y = (column * width).astype(np.intp), (row * height).astype(np.intp)
    radius = 1 + height // 400
    offsets = [(i, j) for i in range(-radius - 1, radius + 2) for j in range(-radius - 1, radius + 2)]
    for edge in (True, False):
        for i, j in offsets:
            distance = i * i + j * j
            if (radius**2 < distance <= (radius + 1) ** 2) if edge else distance <= radius**2:
                rows, columns = np.clip(y + i, 0, height - 1), np.clip(x + j, 0, width - 1)
                out[rows, columns] = 0 if edge else colors
    return out
