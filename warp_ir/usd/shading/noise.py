"""Noises of MaterialX's standard library, which are those of OSL (`mx_noise.glsl`): hashes of lattice points.

Points are float64 [..., d] with d 2 or 3; results are float64 [..., channels].
"""

from itertools import product

import numpy as np
import numpy.typing as npt

from warp_ir.scene import Floats

_Words = npt.NDArray[np.uint32]
_SCALE = {2: 0.6616, 3: 0.9820}
"""Factors by which gradient noise is scaled to [-1, 1], by dimension."""
_SECOND = {2: (19.0, 193.0), 3: (19.0, 193.0, 17.0)}
"""Offset of the points at which the second, or fourth, channel of a fractal is evaluated."""
_MAX_OCTAVES = 24
_ORDER = (("c", "b"), ("a", "c"), ("b", "a"), ("c", "b"), ("a", "c"), ("b", "a"), ("c", "b"))
"""The words of a hash that change, and those by which they do, in the steps of `_final`."""


def _rotated(x: _Words, k: int) -> _Words:
    return (x << np.uint32(k)) | (x >> np.uint32(32 - k))


def _final(a: _Words, b: _Words, c: _Words) -> _Words:
    """The last step of Bob Jenkins' lookup3 hash."""
    for k, (x, y) in zip((14, 11, 25, 16, 4, 14, 24), _ORDER, strict=True):
        words = {"a": a, "b": b, "c": c}
        mixed = (words[x] ^ words[y]) - _rotated(words[y], k)
        a, b, c = (mixed if name == x else words[name] for name in "abc")
    return c


def _mixed(a: _Words, b: _Words, c: _Words) -> tuple[_Words, _Words, _Words]:
    """The mixing step of Bob Jenkins' lookup3 hash."""
    for k in ((4, 6, 8), (16, 19, 4)):
        a = (a - c) ^ _rotated(c, k[0])
        c = c + b
        b = (b - a) ^ _rotated(a, k[1])
        a = a + c
        c = (c - b) ^ _rotated(b, k[2])
        b = b + a
    return a, b, c


def _hash(*integers: npt.NDArray[np.int64]) -> _Words:
    """The hash of one to four integers, uint32."""
    seed = np.uint32((0xDEADBEEF + (len(integers) << 2) + 13) & 0xFFFFFFFF)
    words = [i.astype(np.uint64).astype(np.uint32) for i in np.broadcast_arrays(*integers)]
    a, b, c = (np.full(words[0].shape, seed) for _ in range(3))
    a = a + words[0]
    b = b + words[1] if len(words) > 1 else b
    c = c + words[2] if len(words) > 2 else c
    if len(words) > 3:
        a, b, c = _mixed(a, b, c)
        a = a + words[3]
    return _final(a, b, c)


def _cells(points: Floats) -> tuple[npt.NDArray[np.int64], Floats]:
    """The lattice cells of points, int64 [..., d], and the places in them, [..., d] in [0, 1)."""
    below = np.floor(np.nan_to_num(points).clip(-(2.0**52), 2.0**52))
    return below.astype(np.int64), points - below


def _gradient(bits: _Words, offsets: Floats) -> Floats:
    """The dot product of an offset [..., d] with one of the lattice's gradients."""
    x, y = offsets[..., 0], offsets[..., 1]
    if offsets.shape[-1] == 2:
        h = bits & np.uint32(7)
        u, v = np.where(h < 4, x, y), 2.0 * np.where(h < 4, y, x)
    else:
        h, z = bits & np.uint32(15), offsets[..., 2]
        u, v = np.where(h < 8, x, y), np.where(h < 4, y, np.where((h == 12) | (h == 14), x, z))
    return np.asarray(np.where(h & np.uint32(1), -u, u) + np.where(h & np.uint32(2), -v, v))


def perlin(points: Floats, channels: int) -> Floats:
    """Gradient noise in about [-1, 1], 0 at the lattice points."""
    if channels in (2, 4):
        three = perlin(points, 3)
        if channels == 2:
            return three[..., :2]
        offset = {2: (19.0, 73.0), 3: (19.0, 73.0, 29.0)}[points.shape[-1]]
        return np.concatenate([three, perlin(points + np.array(offset), 1)], axis=-1)
    size = points.shape[-1]
    cells, inside = _cells(points)
    fade = inside**3 * (inside * (inside * 6.0 - 15.0) + 10.0)
    total = np.zeros((*points.shape[:-1], channels))
    for corner in product((0, 1), repeat=size):
        weight = np.prod(np.where(corner, fade, 1.0 - fade), axis=-1)
        bits = _hash(*(cells[..., k] + corner[k] for k in range(size)))
        offsets = inside - np.array(corner)
        for k in range(channels):
            part = bits if channels == 1 else (bits >> np.uint32(8 * k)) & np.uint32(255)
            total[..., k] += weight * _gradient(part, offsets)
    return total * _SCALE[size]


def fractal(points: Floats, channels: int, octaves: int, lacunarity: float, diminish: float) -> Floats:
    """Octaves of gradient noise, each `lacunarity` times finer and `diminish` times weaker."""
    if channels in (2, 4):
        first = fractal(points, channels - 1, octaves, lacunarity, diminish)
        other = fractal(points + np.array(_SECOND[points.shape[-1]]), 1, octaves, lacunarity, diminish)
        return np.concatenate([first, other], axis=-1)
    total = np.zeros((*points.shape[:-1], channels))
    for k in range(min(octaves, _MAX_OCTAVES)):
        total += diminish**k * perlin(points * lacunarity**k, channels)
    return total


def cell(points: Floats, channels: int = 1) -> Floats:
    """One random number in [0, 1] per channel and lattice cell."""
    cells = np.moveaxis(_cells(points)[0], -1, 0)
    if channels == 1:
        return np.asarray(_hash(*cells) / 4294967295.0)[..., None]
    return np.stack([_hash(*cells, np.full(cells.shape[1:], k)) / 4294967295.0 for k in range(channels)], axis=-1)


def worley(points: Floats, channels: int, jitter: float, style: int, metric: int = 0) -> Floats:
    """Distances to the nearest feature points, one per channel; or random numbers of the nearest point's cell.

    Args:
        points: The points.
        channels: 1 to 3: the number of nearest feature points.
        jitter: How far feature points are from the centres of their cells, 0 to 1.
        style: 0 for distances, 1 for random numbers.
        metric: 0 is the Euclidean distance, 1 its square, 2 the Manhattan and 3 the Chebyshev distance.
    """
    size = points.shape[-1]
    cells, inside = _cells(points)
    nearest = np.full((*points.shape[:-1], channels), 1e6)
    feature = np.zeros_like(points)
    for step in product((-1, 0, 1), repeat=size):
        random = cell((cells + np.array(step)).astype(np.float64), 3)[..., :size]
        offsets = np.array(step) + (random - 0.5) * jitter + 0.5 - inside
        size_of = {2: lambda d: np.abs(d).sum(-1), 3: lambda d: np.abs(d).max(-1)}
        distance = size_of.get(metric, lambda d: (d * d).sum(-1))(offsets)
        feature = np.where((distance < nearest[..., 0])[..., None], offsets, feature)
        nearest = np.sort(np.concatenate([nearest, distance[..., None]], axis=-1), axis=-1)[..., :channels]
    if style == 1:
        return cell(feature + points, max(channels, 1) if channels == 1 else 3)[..., :channels]
    return np.sqrt(nearest) if metric == 0 else nearest
