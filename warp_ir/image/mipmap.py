"""Mip chains, resampling and the range of images; every level of a chain has the exact mean of the image."""

import numpy as np

from warp_ir.scene import Floats


def mip_chain(pixels: Floats) -> list[Floats]:
    """The levels of a mip chain: the image [h, w, c], then half the size each, down to one pixel."""
    chain = [np.asarray(pixels, np.float32)]
    while max(chain[-1].shape[:2]) > 1:
        height, width = (max(n // 2, 1) for n in chain[-1].shape[:2])
        chain.append(resized(chain[-1], height, width))
    return chain


def resized(pixels: Floats, height: int, width: int) -> Floats:
    """Resamples an image to [height, width, c] with a box filter; pixels on its border count in proportion."""
    h, w = pixels.shape[:2]
    if (h, w) == (2 * height, 2 * width):
        rows = np.add(pixels[0::2], pixels[1::2], dtype=np.float32)
        quarters = rows[:, 0::2] + rows[:, 1::2]
        quarters *= np.float32(0.25)
        return quarters
    out = np.asarray(pixels, np.float64)
    for axis, size in ((0, height), (1, width)):
        count = out.shape[axis]
        if count == size:
            continue
        # Box means are differences of the integral, which is linear between the pixels' edges.
        sums = np.concatenate([np.zeros_like(np.take(out, [0], axis)), np.cumsum(out, axis=axis)], axis=axis)
        edges = np.arange(size + 1) * (count / size)
        below = np.minimum(edges.astype(np.int64), count - 1)
        fraction = (edges - below).reshape([-1 if k == axis else 1 for k in range(out.ndim)])
        integral = np.take(sums, below, axis) + fraction * np.take(out, below, axis)
        out = np.diff(integral, axis=axis) * (size / count)
    return out.astype(np.float32)


def value_range(pixels: Floats) -> tuple[float, float]:
    """Smallest and largest value; NaN or infinite if any value is.

    Half floats that are not negative are ordered as their bits are, which integers compare far faster.
    """
    if pixels.dtype == np.float16 and pixels.size:
        bits = np.ascontiguousarray(pixels).view(np.int16)
        low, high = bits.min(), bits.max()
        if low >= 0:
            return float(low.view(np.float16)), float(high.view(np.float16))
    return float(pixels.min()), float(pixels.max())
