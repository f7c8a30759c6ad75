"""Tangents for normal maps, smooth over the edges of triangles as the programs that bake the maps have them.

The rule is MikkTSpace's (Mikkelsen 2008): what shares a point, a normal, texture coordinates and their handedness
shares a tangent, the mean of its triangles' by their angles there. It tells points apart by their index, not by their
place.
"""

import numpy as np
import numpy.typing as npt

from warp_ir.scene import Floats, Ints

_ODD = np.uint64(0x9E3779B97F4A7C15)


def smooth_tangents(points: Floats, triangles: Ints, normals: Floats, uvs: Floats) -> Floats:
    """The directions in which u grows at the corners, float32 [m, 3, 3]; 0 where it grows nowhere.

    Args:
        points: [n, 3].
        triangles: [m, 3].
        normals: Of the corners, unit, [m, 3, 3].
        uvs: Of the corners, [m, 3, 2].
    """
    corners: Floats = points[triangles]
    places = uvs.astype(np.float64)
    ab, ac = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    ab_uv, ac_uv = places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]
    turn = np.sign(ab_uv[:, 0] * ac_uv[:, 1] - ab_uv[:, 1] * ac_uv[:, 0])
    along = turn[:, None] * (ab * ac_uv[:, 1:] - ac * ab_uv[:, 1:])
    flat = _unit(along[:, None] - normals * np.einsum("mck,mk->mc", normals, along)[..., None])
    to_next, to_last = _unit(np.roll(corners, -1, axis=1) - corners), _unit(np.roll(corners, 1, axis=1) - corners)
    angle = np.arccos(np.einsum("mck,mck->mc", to_next, to_last).clip(-1.0, 1.0))
    weighted = (flat * angle[..., None]).reshape(-1, 3)
    _, group = np.unique(_keys(triangles, turn, normals, uvs), return_inverse=True)
    sums: Floats = np.stack([np.bincount(group, weights=weighted[:, k]) for k in range(3)], axis=1)
    tangents: Floats = _unit(sums)[group].reshape(-1, 3, 3).astype(np.float32)
    return tangents


def _keys(triangles: Ints, turn: Floats, normals: Floats, uvs: Floats) -> npt.NDArray[np.uint64]:
    """A number for each corner [3 m], equal where tangents are shared: mixed bits, which practically never collide."""
    parts = [np.asarray(triangles, np.int64), np.repeat(turn[:, None], 3, axis=1).astype(np.int64)]
    parts += [
        np.ascontiguousarray(x[..., k], np.float32).view(np.int32) for x in (normals, uvs) for k in range(x.shape[2])
    ]
    keys = np.zeros(3 * len(triangles), np.uint64)
    for part in parts:
        keys = (keys ^ part.reshape(-1).astype(np.uint64)) * _ODD
        keys ^= keys >> np.uint64(29)
    return keys


def _unit(vectors: Floats) -> Floats:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0.0, length, 1.0))
