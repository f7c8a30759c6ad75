"""Hex tiling: an image without visible repetition, from three overlapping, randomly placed copies of it.

M. S. Mikkelsen: Practical Real-Time Hex-Tiling, JCGT 11 (2), 77-94, 2022; as in MaterialX's `mx_hextile.glsl`.
"""

from dataclasses import dataclass

import numpy as np

from warp_ir.scene import Floats

_SIDE = 2.0 * np.sqrt(3.0)
_TO_SKEWED = np.array([[1.0, 0.0], [-0.57735027, 1.15470054]])
_FROM_SKEWED = np.array([[1.0, 0.0], [0.5, 1.0 / 1.15470054]])


@dataclass(frozen=True)
class HexTiling:
    """How the copies are placed: amounts in [0, 1] of random rotation [degrees], scale and offset in their ranges."""

    rotation: float = 1.0
    rotation_range: tuple[float, float] = (0.0, 360.0)
    scale: float = 1.0
    scale_range: tuple[float, float] = (0.5, 2.0)
    offset: float = 1.0
    offset_range: tuple[float, float] = (0.0, 1.0)


def hex_tiles(uv: Floats, tiling: HexTiling) -> tuple[list[Floats], Floats]:
    """The texture coordinates of the three copies at points [..., 2], and their barycentric weights [..., 3]."""
    skewed = (uv * _SIDE) @ _TO_SKEWED
    cell, inside = np.floor(skewed), skewed - np.floor(skewed)
    third = 1.0 - inside.sum(axis=-1)
    upper = (third <= 0.0).astype(np.float64)
    sign = 2.0 * upper - 1.0
    weights = np.stack([-third * sign, upper - inside[..., 1] * sign, upper - inside[..., 0] * sign], axis=-1)
    corners = [(upper, upper), (upper, 1.0 - upper), (1.0 - upper, upper)]
    coordinates = []
    for corner in corners:
        index = cell + np.stack(corner, axis=-1)
        centre = (index / _SIDE) @ _FROM_SKEWED
        random = _hash(index + 0.12345)
        low, high = np.radians(tiling.rotation_range)
        angle = low + (high - low) * random[..., 0] * tiling.rotation
        s, c = np.sin(angle), np.cos(angle)
        x, y = np.moveaxis(uv - centre, -1, 0)
        turned = np.stack([c * x - s * y, s * x + c * y], axis=-1)
        spread = tiling.scale_range[0] + (tiling.scale_range[1] - tiling.scale_range[0]) * random[..., 1:]
        scale = 1.0 + (spread - 1.0) * tiling.scale
        moved = tiling.offset_range[0] + (tiling.offset_range[1] - tiling.offset_range[0]) * random * tiling.offset
        coordinates.append(turned / np.where(scale == 0.0, 1.0, scale) + centre + moved)
    return coordinates, weights


def blended(colors: list[Floats], weights: Floats, falloff: float, contrast: float, luminance: Floats) -> Floats:
    """The colours [..., c] of three copies, blended by their weights [..., 3]; bright ones count more by `contrast`."""
    bright = np.stack([color[..., :3] @ luminance for color in colors], axis=-1)
    by_color = _blend_weights(1.0 + (bright - 1.0) * contrast, weights, falloff)
    alpha = _blend_weights(np.ones(3), weights, falloff)
    rgb = sum(by_color[..., k : k + 1] * colors[k][..., :3] for k in range(3))
    rest = sum(alpha[..., k : k + 1] * colors[k][..., 3:] for k in range(3))
    return np.concatenate([np.asarray(rgb), np.asarray(rest)], axis=-1)


def _blend_weights(factors: Floats, weights: Floats, falloff: float) -> Floats:
    w = factors * weights**7
    w = w / np.maximum(w.sum(axis=-1, keepdims=True), 1e-30)
    if falloff != 0.5:  # Schlick's gain
        gain = min(max(falloff, 0.001), 0.999)
        a = (1.0 / gain - 2.0) * (1.0 - 2.0 * w)
        w = np.where(w < 0.5, w / (a + 1.0), (a - w) / (a - 1.0))
        w = w / np.maximum(w.sum(axis=-1, keepdims=True), 1e-30)
    return np.asarray(w)


def _hash(points: Floats) -> Floats:
    """Random numbers [..., 2] in [0, 1) from points [..., 2]."""
    x, y = points[..., 0], points[..., 1]
    p = np.stack([x * 0.1031, y * 0.1030, x * 0.0973], axis=-1)
    p = p - np.floor(p)
    p = p + (p * (p[..., [1, 2, 0]] + 33.33)).sum(axis=-1, keepdims=True)
    q = (p[..., :1] + p[..., 1:]) * p[..., [2, 1]]
    return np.asarray(q - np.floor(q))
