"""Triangulation of polygons: convex faces as fans (vectorized), concave faces by ear clipping, one by one."""

import mapbox_earcut
import numpy as np

from warp_ir.scene import Bools, Floats, Ints
from warp_ir.usd.values.triangles import cross_products


def triangulate(points: Floats, counts: Ints, indices: Ints, keep: Bools) -> tuple[Ints, Ints]:
    """Splits faces into triangles of the same winding.

    Args:
        points: float64 [n, 3].
        counts: Vertices per face, int [f].
        indices: Point of each face-vertex, int [sum(counts)], all in range.
        keep: Faces to triangulate, bool [f]; faces with fewer than three vertices are skipped.

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
        if owner is None:  # all faces of the group are split as fans
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
    """Triangles of polygons of c vertices.

    Args:
        points: float64 [n, 3].
        polygons: Points of the polygons, int [f, c].

    Returns:
        Vertex indices within a polygon, [t, 3], and the polygon of each triangle, [t]; or the t triangles of every
        polygon and None, if all are split in the same way.
    """
    p = points[polygons]
    # Coordinates relative to a corner keep their precision far from the origin.
    p = p - p[:, :1]
    count = polygons.shape[1]
    fan = np.stack([np.zeros(count - 2, np.int64), np.arange(1, count - 1), np.arange(2, count)], axis=1)
    # Newell's method: a vector of twice the area, along the normal of the best-fitting plane.
    normal = np.cross(p, np.roll(p, -1, axis=1)).sum(axis=1)
    edge = np.roll(p, -1, axis=1) - p
    convexity = np.einsum("fci,fi->fc", np.cross(np.roll(edge, 1, axis=1), edge), normal)
    area2 = np.einsum("fi,fi->f", normal, normal)
    concave = (convexity < -1e-7 * area2[:, None]).any(axis=1)
    if not concave.any():
        return fan, None
    local = np.repeat(fan[None], len(polygons), axis=0)
    if count == 4:
        # A concave quadrilateral is split at its reflex corner.
        start = np.where(concave, np.argmin(convexity, axis=1), 0)
        local = (local + start[:, None, None]) % 4
        return local.reshape(-1, 3), np.repeat(np.arange(len(polygons)), 2)
    concave_faces = np.flatnonzero(concave)
    ears = [_clip_ears(p[i], normal[i]) for i in concave_faces]
    convex_faces = np.flatnonzero(~concave)
    owner = np.concatenate(
        [np.repeat(convex_faces, count - 2), *(np.full(len(e), i) for i, e in zip(concave_faces, ears, strict=True))]
    )
    return np.concatenate([local[convex_faces].reshape(-1, 3), *ears]), owner


def _clip_ears(polygon: Floats, normal: Floats) -> Ints:
    """Triangles of one simple polygon [c, 3] as indices of its vertices, with its winding."""
    axis = int(np.argmax(np.abs(normal)))  # projecting along this axis is injective on the plane
    flat = polygon[:, [(axis + 1) % 3, (axis + 2) % 3]]
    ears = mapbox_earcut.triangulate_float64(np.ascontiguousarray(flat), np.array([len(flat)], dtype=np.uint32))
    triangles: Ints = ears.reshape(-1, 3).astype(np.int64)
    if cross_products(polygon, triangles).sum(axis=0) @ normal < 0.0:
        triangles = triangles[:, ::-1]
    return triangles
