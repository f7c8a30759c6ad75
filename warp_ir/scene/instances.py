"""Copies of geometry: written out, bounded and measured, from matrices that place it.

Matrices are float64 [k, 4, 4], target_from_source, one per copy.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.floating]
_Ints = npt.NDArray[np.integer]

_EXACT = 2**25
"""Most points or triangles that are transformed one by one only to measure them."""
_SAMPLED = 512
"""Triangles that stand for a prototype whose area under many uneven scales is wanted."""


def place(
    points: _Floats, triangles: _Ints, normals: _Floats | None, matrices: _Floats
) -> tuple[_Floats, _Ints, _Floats | None]:
    """Copies of triangles; mirrored, sheared or flat matrices are fine.

    Args:
        points: [n, 3].
        triangles: int32 [m, 3].
        normals: float32 [m, 3, 3], of the triangles' corners, or None.
        matrices: [k, 4, 4].

    Returns:
        Points float64 [k n, 3], triangles int32 [k m, 3] and normals float32 [k m, 3, 3] or None, copy after copy.
    """
    copies, count = len(matrices), len(points)
    linear = matrices[:, :3, :3]
    placed = np.matmul(points, linear.transpose(0, 2, 1)) + matrices[:, None, :3, 3]
    offsets = (np.arange(copies) * count).astype(np.int32)
    wound = triangles[None] + offsets[:, None, None]
    mirrored = np.linalg.det(linear) < 0.0
    wound[mirrored] = wound[mirrored][:, :, ::-1]
    turned: _Floats | None = None
    if normals is not None:
        cofactor = cofactors(linear)
        cofactor[mirrored] *= -1.0
        cofactor /= np.maximum(np.abs(cofactor).max(axis=(1, 2), keepdims=True), 1e-300)
        turned = normals.reshape(-1, 3) @ cofactor.transpose(0, 2, 1).astype(np.float32)
        turned /= np.maximum(np.linalg.norm(turned, axis=-1, keepdims=True), 1e-30)
        turned = turned.reshape(copies, -1, 3, 3)
        turned[mirrored] = turned[mirrored][:, :, ::-1]
        turned = turned.reshape(-1, 3, 3)
    return placed.reshape(-1, 3), wound.reshape(-1, 3), turned


def cofactors(linear: _Floats) -> _Floats:
    """det(M) M⁻ᵀ of matrices [k, 3, 3]: its rows are cross products of rows, so flat matrices have one too."""
    r0, r1, r2 = linear[:, 0], linear[:, 1], linear[:, 2]
    return np.stack([np.cross(r1, r2), np.cross(r2, r0), np.cross(r0, r1)], axis=1)


def boxes(lower: _Floats, upper: _Floats, matrices: _Floats) -> tuple[_Floats, _Floats]:
    """Lower and upper corners [k, 3] of boxes around the copies of a box."""
    centre, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    middle = matrices[:, :3, :3] @ centre + matrices[:, :3, 3]
    reach = np.abs(matrices[:, :3, :3]) @ half
    return middle - reach, middle + reach


def bounds_of_copies(points: _Floats, matrices: _Floats) -> tuple[_Floats, _Floats]:
    """Lower and upper corner [3] of the box around all copies of some points.

    Exact, by looking into copies only as long as their own boxes reach beyond what has been found; where that would
    take too long, the box around those boxes.
    """
    loose = boxes(points.min(axis=0), points.max(axis=0), matrices)
    found = []
    for side, far in zip((-1.0, 1.0), loose, strict=True):
        corner = np.empty(3)
        for axis in range(3):
            reach = side * far[:, axis]
            best, work = -np.inf, 0
            for k in _descending(reach):
                if reach[k] <= best:
                    break
                if work > _EXACT:
                    best = float(reach[k])
                    break
                values = points @ matrices[k, axis, :3] + matrices[k, axis, 3]
                best = max(best, float((side * values).max()))
                work += len(points) + 1000
            corner[axis] = side * best
        found.append(corner)
    return found[0], found[1]


def _descending(values: _Floats) -> Any:
    """Indices from the largest value down, in chunks: most callers stop early."""
    size, done = 256, 0
    order = np.argpartition(-values, size)[:size] if len(values) > size else np.arange(len(values))
    for k in order[np.argsort(-values[order], kind="stable")]:
        done += 1
        yield k
    if done < len(values):
        yield from np.argsort(-values, kind="stable")[done:]


def areas_of_copies(points: _Floats, triangles: _Ints, matrices: _Floats) -> _Floats:
    """Area of each copy of some triangles [k]: exact under rotations and even scales, and while there are few.

    Under many uneven scales a sample of the triangles stands for them all.
    """
    a, b, c = (points[triangles[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    area = 0.5 * np.linalg.norm(cross, axis=1)
    linear = matrices[:, :3, :3]
    gram = linear.transpose(0, 2, 1) @ linear
    square = np.trace(gram, axis1=1, axis2=2) / 3.0
    out = area.sum() * square
    uneven = np.abs(gram - square[:, None, None] * np.eye(3)).max(axis=(1, 2)) > 1e-9 * square
    if uneven.any() and area.sum() > 0.0:
        count = int(uneven.sum())
        if count * len(triangles) > _EXACT and len(triangles) > _SAMPLED:
            cdf = np.cumsum(area) / area.sum()
            chosen = np.searchsorted(cdf, (np.arange(_SAMPLED) + 0.5) / _SAMPLED)
            cross = cross[chosen] * (area.sum() / (_SAMPLED * area[chosen]))[:, None]
        turn = cofactors(linear[uneven])
        step = max(1, _EXACT // (8 * len(cross)))
        pieces = [
            0.5 * np.linalg.norm(cross @ turn[k : k + step].transpose(0, 2, 1), axis=2).sum(axis=1)
            for k in range(0, count, step)
        ]
        out[uneven] = np.concatenate(pieces)
    return np.asarray(out)
