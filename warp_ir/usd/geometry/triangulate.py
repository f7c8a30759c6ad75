"""Polygons to triangles: convex faces as fans, all at once; concave faces by ear clipping, one by one."""

import mapbox_earcut
import numpy as np

from warp_ir.scene import Floats, Ints
from warp_ir.usd.values.triangles import Mask, cross_products


def triangulate(points: Floats, counts: Ints, indices: Ints, keep: Mask) -> tuple[Ints, Ints]:
    """Cut faces into triangles of the same winding.

    Args:
        points: float64 [n, 3].
        counts: Vertices per face, int [f].
        indices: Point of each face-vertex, int [sum(counts)], all in range.
        keep: Which faces are wanted, bool [f]; those with fewer than three vertices are left out.

    Returns:
        The face-vertex of each corner, int32 [m, 3], and the face of each triangle, int32 [m], in face order.
    """
    offsets = np.cumsum(counts) - counts
    corners: list[Ints] = []
    faces: list[Ints] = []
    for count in np.unique(counts[keep & (counts >= 3)]).tolist():
        group = np.flatnonzero(keep & (counts == count))
        polygon = offsets[group, None] + np.arange(count)
        local, owner = _polygons(points, indices[polygon]) if count > 3 else (np.arange(3)[None], None)
        if owner is None:  # every face is cut the same way
            corners.append(polygon[:, local].reshape(-1, 3))
            faces.append(np.repeat(group, len(local)))
        else:
            corners.append(polygon[owner[:, None], local])
            faces.append(group[owner])
    if not corners:
        return np.zeros((0, 3), np.int32), np.zeros(0, np.int32)
    corner, face = np.concatenate(corners), np.concatenate(faces)
    if len(corners) > 1:
        order = np.argsort(face, kind="stable")
        corner, face = corner[order], face[order]
    return corner.astype(np.int32), face.astype(np.int32)


def _polygons(points: Floats, polygons: Ints) -> tuple[Ints, Ints | None]:
    """Triangles of polygons [f, c] as places in the polygon, [t, 3], with the polygon of each (None: t for all)."""
    p = points[polygons]
    # Relative to a corner, lest a polygon far from the origin lose its digits.
    p = p - p[:, :1]
    count = polygons.shape[1]
    fan = np.stack([np.zeros(count - 2, np.int64), np.arange(1, count - 1), np.arange(2, count)], axis=1)
    normal = np.cross(p, np.roll(p, -1, axis=1)).sum(axis=1)  # Newell: twice the area, along the best plane
    edge = np.roll(p, -1, axis=1) - p
    turn = np.einsum("fci,fi->fc", np.cross(np.roll(edge, 1, axis=1), edge), normal)
    area2 = np.einsum("fi,fi->f", normal, normal)
    concave = (turn < -1e-7 * area2[:, None]).any(axis=1)
    if not concave.any():
        return fan, None
    local = np.repeat(fan[None], len(polygons), axis=0)
    if count == 4:
        # A concave quadrilateral is cut at its reflex corner.
        start = np.where(concave, np.argmin(turn, axis=1), 0)
        local = (local + start[:, None, None]) % 4
        return local.reshape(-1, 3), np.repeat(np.arange(len(polygons)), 2)
    bent = np.flatnonzero(concave)
    ears = [_clip_ears(p[i], normal[i]) for i in bent]
    straight = np.flatnonzero(~concave)
    owner = np.concatenate(
        [np.repeat(straight, count - 2), *(np.full(len(e), i) for i, e in zip(bent, ears, strict=True))]
    )
    return np.concatenate([local[straight].reshape(-1, 3), *ears]), owner


def _clip_ears(polygon: Floats, normal: Floats) -> Ints:
    """Triangles of one simple polygon [c, 3], as places in it, wound like it."""
    axis = int(np.argmax(np.abs(normal)))  # dropping this axis maps the plane one to one
    flat = polygon[:, [(axis + 1) % 3, (axis + 2) % 3]]
    ears = mapbox_earcut.triangulate_float64(np.ascontiguousarray(flat), np.array([len(flat)], dtype=np.uint32))
    triangles: Ints = ears.reshape(-1, 3).astype(np.int64)
    if cross_products(polygon, triangles).sum(axis=0) @ normal < 0.0:
        triangles = triangles[:, ::-1]
    return triangles
