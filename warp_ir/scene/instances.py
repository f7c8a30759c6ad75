"""Copies of geometry under many matrices: their triangles, bounding boxes and areas.

Matrices are float64 [k, 4, 4], target_from_source, one per copy, and act on column vectors.
"""

from collections.abc import Iterator

import numpy as np

from warp_ir.scene.types import Floats, Ints

_MAX_EXACT = 2**25
"""Maximum number of points or triangles that are transformed one by one to measure them exactly."""
_AREA_SAMPLES = 512
"""Triangles sampled in proportion to area to estimate a prototype's area under many non-uniform scales."""


def transform_copies(
    points: Floats, triangles: Ints, normals: Floats | None, matrices: Floats
) -> tuple[Floats, Ints, Floats | None]:
    """Copies of triangles under matrices that may mirror, shear or flatten them.

    The winding of mirrored copies is reversed, so that their fronts stay outside. Normals are transformed by the
    cofactor matrix, which is the inverse transpose up to scale and exists for singular matrices too.

    Args:
        points: [n, 3].
        triangles: int32 [m, 3].
        normals: float32 [m, 3, 3], of the triangles' corners, or None.
        matrices: [k, 4, 4].

    Returns:
        Points float64 [k n, 3], triangles int32 [k m, 3] and normals float32 [k m, 3, 3] or None, copy after copy.
    """
    copies, count = len(matrices), len(points)
    if copies == 1 and (matrices[0] == np.eye(4)).all():
        return points.astype(np.float64, copy=False), triangles, normals
    linear = matrices[:, :3, :3]
    transformed = np.matmul(points, linear.transpose(0, 2, 1)) + matrices[:, None, :3, 3]
    offsets = (np.arange(copies) * count).astype(np.int32)
    indices = triangles[None] + offsets[:, None, None]
    mirrored = np.linalg.det(linear) < 0.0
    indices[mirrored] = indices[mirrored][:, :, ::-1]
    new_normals: Floats | None = None
    if normals is not None:
        cofactor = cofactors(linear)
        cofactor[mirrored] *= -1.0
        cofactor /= np.maximum(np.abs(cofactor).max(axis=(1, 2), keepdims=True), 1e-300)
        new_normals = normals.reshape(-1, 3) @ cofactor.transpose(0, 2, 1).astype(np.float32)
        new_normals /= np.maximum(np.linalg.norm(new_normals, axis=-1, keepdims=True), 1e-30)
        new_normals = new_normals.reshape(copies, -1, 3, 3)
        new_normals[mirrored] = new_normals[mirrored][:, :, ::-1]
        new_normals = new_normals.reshape(-1, 3, 3)
    return transformed.reshape(-1, 3), indices.reshape(-1, 3), new_normals


def cofactors(linear: Floats) -> Floats:
    """Cofactor matrices det(M) M⁻ᵀ of [k, 3, 3]: their rows are cross products of rows, so singular M have one too."""
    r0, r1, r2 = linear[:, 0], linear[:, 1], linear[:, 2]
    return np.stack([np.cross(r1, r2), np.cross(r2, r0), np.cross(r0, r1)], axis=1)


def transform_box(lower: Floats, upper: Floats, matrices: Floats) -> tuple[Floats, Floats]:
    """Lower and upper corners [k, 3] of the axis-aligned boxes around the transformed copies of one box."""
    centre, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    centres = matrices[:, :3, :3] @ centre + matrices[:, :3, 3]
    halves = np.abs(matrices[:, :3, :3]) @ half
    return centres - halves, centres + halves


def bounds_of_copies(points: Floats, matrices: Floats) -> tuple[Floats, Floats]:
    """Lower and upper corner [3] of the box around all copies of some points.

    The box is exact: copies are transformed in descending order of their own boxes, until no further box exceeds the
    maximum so far. Beyond `_MAX_EXACT` points, the box around the remaining boxes is used, which is an upper bound.
    """
    outer = transform_box(points.min(axis=0), points.max(axis=0), matrices)
    corners = []
    for sign, bounds in zip((-1.0, 1.0), outer, strict=True):
        corner = np.empty(3)
        for axis in range(3):
            bound = sign * bounds[:, axis]
            best, work = -np.inf, 0
            for k in _descending(bound):
                if bound[k] <= best:
                    break
                if work > _MAX_EXACT:
                    best = float(bound[k])
                    break
                values = points @ matrices[k, axis, :3] + matrices[k, axis, 3]
                best = max(best, float((sign * values).max()))
                work += len(points) + 1000
            corner[axis] = sign * best
        corners.append(corner)
    return corners[0], corners[1]


def _descending(values: Floats) -> Iterator[int]:
    """Indices in descending order of value; only the first 256 are sorted at once, as most callers stop early."""
    size, done = 256, 0
    order = np.argpartition(-values, size)[:size] if len(values) > size else np.arange(len(values))
    for k in order[np.argsort(-values[order], kind="stable")].tolist():
        done += 1
        yield k
    if done < len(values):
        yield from np.argsort(-values, kind="stable")[done:].tolist()


def areas_of_copies(points: Floats, triangles: Ints, matrices: Floats) -> Floats:
    """Area of each copy of some triangles, float64 [k].

    The areas are exact under rotations and uniform scales, and under others as long as copies and triangles are few
    (`_MAX_EXACT`); beyond that a stratified sample of the triangles estimates them.
    """
    a, b, c = (points[triangles[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    area = 0.5 * np.linalg.norm(cross, axis=1)
    linear = matrices[:, :3, :3]
    gram = linear.transpose(0, 2, 1) @ linear
    square = np.trace(gram, axis1=1, axis2=2) / 3.0  # the squared scale, if the scale is uniform
    out = area.sum() * square
    non_uniform = np.abs(gram - square[:, None, None] * np.eye(3)).max(axis=(1, 2)) > 1e-9 * square
    if non_uniform.any() and area.sum() > 0.0:
        count = int(non_uniform.sum())
        if count * len(triangles) > _MAX_EXACT and len(triangles) > _AREA_SAMPLES:
            cdf = np.cumsum(area) / area.sum()
            sampled = np.searchsorted(cdf, (np.arange(_AREA_SAMPLES) + 0.5) / _AREA_SAMPLES)
            cross = cross[sampled] * (area.sum() / (_AREA_SAMPLES * area[sampled]))[:, None]
        cofactor = cofactors(linear[non_uniform])
        step = max(1, _MAX_EXACT // (8 * len(cross)))
        pieces = [
            0.5 * np.linalg.norm(cross @ cofactor[k : k + step].transpose(0, 2, 1), axis=2).sum(axis=1)
            for k in range(0, count, step)
        ]
        out[non_uniform] = np.concatenate(pieces)
    return np.asarray(out)
