"""Textures of the test scenes: sRGB pixels, uint8 [256, 256, 3], row 0 at the top."""

import numpy as np


def _planks():
    """Eight floor boards with grain along u."""
    stream = np.random.default_rng(1)
    grain = np.repeat(stream.random((128, 8)), 32, axis=1) * 0.14
    tone = np.repeat(stream.random(8), 16) * 0.25
    value = np.repeat(0.66 + tone[:, None] + grain, 2, axis=0)
    value[np.arange(256) % 32 < 1] *= 0.45
    for board, cut in enumerate((stream.random(8) * 256).astype(int)):
        value[board * 32 : board * 32 + 32, cut] *= 0.45
    return np.clip(value[..., None] * (176, 142, 108), 0, 255).astype(np.uint8)


def _bricks():
    """Eight courses of bricks, every second one shifted by half a brick."""
    stream = np.random.default_rng(2)
    y, x = np.mgrid[:256, :256]
    course = y // 32
    shifted = (x + 32 * (course % 2)) % 256
    tone = (0.8 + 0.35 * stream.random((8, 4)))[course, shifted // 64]
    mortar = (y % 32 < 3) | (shifted % 64 < 3)
    return np.where(mortar[..., None], (150, 140, 130), tone[..., None] * (205, 170, 148)).astype(np.uint8)


def _rug():
    """A rug: concentric diamonds in four colours, a border, plain threads."""
    y, x = np.mgrid[:256, :256]
    colours = np.array([(150, 44, 48), (222, 190, 130), (36, 62, 104), (206, 120, 62)])
    pattern = colours[((np.abs(x % 128 - 63) + np.abs(y % 128 - 63)) // 16) % 4]
    edge = np.minimum(np.minimum(x, 255 - x), np.minimum(y, 255 - y))
    pattern = np.where(edge[..., None] < 20, np.where(edge[..., None] < 8, colours[1], colours[2]), pattern)
    return (pattern * (1.0 - 0.08 * ((x + y) % 2))[..., None]).astype(np.uint8)


TEXTURES = {"planks": _planks, "bricks": _bricks, "rug": _rug}


def linear_mean(pixels):
    """The mean of sRGB pixels after conversion to linear values, float64 [3]."""
    value = pixels / 255.0
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return linear.mean(axis=(0, 1))
