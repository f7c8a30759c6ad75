"""Smooth tangents for normal maps, as programs that bake such maps compute them (MikkTSpace, Mikkelsen 2008).

Corners with the same point, normal, texture coordinates and handedness of these share a tangent: the mean of their
triangles' tangents, weighted by the angles at the point. Points are compared by index, not by position.
"""

import numpy as np
import numpy.typing as npt

from warp_ir.scene import Floats, Ints

_HASH_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)
"""2⁶⁴ over the golden ratio, odd: a multiplicative hash."""


def smooth_tangents(points: Floats, triangles: Ints, normals: Floats, uvs: Floats) -> Floats:
    """Unit tangents at the corners (directions in which u grows), float32 [m, 3, 3]; 0 where u is constant.

    Args:
        points: [n, 3].
        triangles: [m, 3].
        normals: Unit normals at the corners, [m, 3, 3].
        uvs: Texture coordinates at the corners, [m, 3, 2].
    """
    corners: Floats = points[triangles]
    uv = uvs.astype(np.float64)
    ab, ac = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    ab_uv, ac_uv = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    handedness = np.sign(ab_uv[:, 0] * ac_uv[:, 1] - ab_uv[:, 1] * ac_uv[:, 0])
    per_triangle = handedness[:, None] * (ab * ac_uv[:, 1:] - ac * ab_uv[:, 1:])
    projected = _normalized(per_triangle[:, None] - normals * np.einsum("mck,mk->mc", normals, per_triangle)[..., None])
    to_next = _normalized(np.roll(corners, -1, axis=1) - corners)
    to_last = _normalized(np.roll(corners, 1, axis=1) - corners)
    angle = np.arccos(np.einsum("mck,mck->mc", to_next, to_last).clip(-1.0, 1.0))
    weighted = (projected * angle[..., None]).reshape(-1, 3)
    _, group = np.unique(_corner_keys(triangles, handedness, normals, uvs), return_inverse=True)
    sums: Floats = np.stack([np.bincount(group, weights=weighted[:, k]) for k in range(3)], axis=1)
    tangents: Floats = _normalized(sums)[group].reshape(-1, 3, 3).astype(np.float32)
    return tangents


def _corner_keys(triangles: Ints, handedness: Floats, normals: Floats, uvs: Floats) -> npt.NDArray[np.uint64]:
    """A 64-bit hash per corner [3 m], equal for corners that share a tangent; collisions are improbable."""
    parts = [np.asarray(triangles, np.int64), np.repeat(handedness[:, None], 3, axis=1).astype(np.int64)]
    parts += [
        np.ascontiguousarray(x[..., k], np.float32).view(np.int32) for x in (normals, uvs) for k in range(x.shape[2])
    ]
    keys = np.zeros(3 * len(triangles), np.uint64)
    for part in parts:
        keys = (keys ^ part.reshape(-1).astype(np.uint64)) * _HASH_MULTIPLIER
        keys ^= keys >> np.uint64(29)
    return keys


def _normalized(vectors: Floats) -> Floats:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0.0, length, 1.0))
