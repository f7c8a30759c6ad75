"""Displacement: the vertices of a refined mesh move along its normals."""

from dataclasses import replace

import numpy as np

from warp_ir.scene import Floats, Ints
from warp_ir.usd.values.triangles import TriangleMesh, cross_products


def displaced(mesh: TriangleMesh, amounts: Floats) -> TriangleMesh:
    """The mesh with each vertex moved along its normal by the mean of what its corners ask for, with new normals.

    Vertices that faces share stay shared, so that no cracks open.

    Args:
        mesh: A mesh with shared vertices.
        amounts: Displacement at the corners of its triangles, float64 [m, 3], in its own space.
    """
    corners = mesh.triangles.reshape(-1)
    used = np.bincount(corners, minlength=len(mesh.points))
    mean = np.bincount(corners, weights=amounts.reshape(-1), minlength=len(mesh.points)) / np.maximum(used, 1)
    if mesh.normals is None:
        normals = _vertex_normals(mesh.points, mesh.triangles)
    else:
        normals = _unit(_sums(mesh.normals.reshape(-1, 3), corners, len(mesh.points)))
    points = mesh.points + mean[:, None] * normals
    new_normals = _vertex_normals(points, mesh.triangles)
    usable = np.einsum("ij,ij->i", new_normals, new_normals) > 0.5
    new_normals = np.where(usable[:, None], new_normals, normals)
    return replace(mesh, points=points, normals=new_normals.astype(np.float32)[mesh.triangles])


def _vertex_normals(points: Floats, triangles: Ints) -> Floats:
    """Normals at the points [n, 3]: means of those of the triangles around them, weighted by area."""
    products = np.repeat(cross_products(points, triangles), 3, axis=0)
    return _unit(_sums(products, triangles.reshape(-1), len(points)))


def _sums(vectors: Floats, index: Ints, count: int) -> Floats:
    return np.stack([np.bincount(index, weights=vectors[:, k], minlength=count) for k in range(3)], axis=1)


def _unit(vectors: Floats) -> Floats:
    out: Floats = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)
    return out
