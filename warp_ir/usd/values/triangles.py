"""A gprim as triangles in its own space, before materials and transforms are applied."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from warp_ir.scene import Bools, Floats, Ints, instances


class PrimvarRefiner(Protocol):
    """Interpolation of primvars over a subdivided surface: from the prim's elements to those of the refined mesh."""

    def vertex(self, values: Floats) -> Floats:
        """Values of points [n, c] at the refined points, by the smooth rules of the subdivision scheme."""

    def varying(self, values: Floats) -> Floats:
        """Values of points [n, c] at the refined points, interpolated linearly over every face."""

    def face_varying(self, values: Floats, indices: Ints | None = None) -> Floats:
        """Values of face-vertices [v, c], or [n, c] with indices [v], at the refined face-vertices."""


@dataclass(frozen=True, eq=False)
class Cells:
    """The tetrahedra of a TetMesh."""

    count: int
    of_face: Ints
    """int [f], the tetrahedron that each surface face belongs to; -1: none."""


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Triangles of a gprim that know the face and the face-vertices of the prim that they were made of.

    For a subdivided surface, points, triangles and corners are those of the refined mesh, faces those of the prim. The
    prims of a native prototype are read once, whatever the number of instances.
    """

    points: Floats
    """float64 [n, 3]."""
    triangles: Ints
    """int32 [m, 3], counter-clockwise seen from the front."""
    face: Ints
    """int32 [m], index of the prim's face of which each triangle is part."""
    corner: Ints
    """int32 [m, 3], index of the prim's (or the refined mesh's) face-vertex at each corner."""
    normals: Floats | None = None
    """float32 [m, 3, 3], unit shading normals; None: the geometric normals."""
    element_counts: Mapping[str, int] = field(default_factory=dict)
    """Number of values of a primvar per interpolation; interpolations that are missing cannot be honoured."""
    degenerate_faces: int = 0
    """Number of faces without area that were dropped."""
    refiner: PrimvarRefiner | None = None
    """Interpolates primvars over a subdivided surface; None: the surface is not subdivided."""
    sampled: bool = False
    """Whether velocities move its points after a time sample: values per element are then those of a sample as well."""
    cells: Cells | None = None
    """What uniform values of a TetMesh belong to; None: they belong to faces."""

    def keep(self, mask: Bools) -> "TriangleMesh":
        """This mesh with only the triangles that the mask [m] selects."""
        normals = None if self.normals is None else self.normals[mask]
        return replace(
            self,
            triangles=self.triangles[mask],
            face=self.face[mask],
            corner=self.corner[mask],
            normals=normals,
        )


def cross_products(points: Floats, triangles: Ints) -> Floats:
    """Cross products of the triangles' edges, float64 [m, 3]: geometric normals of twice the area as length."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def drop_degenerate(mesh: TriangleMesh) -> TriangleMesh:
    """The mesh without triangles whose doubled area is at most 1e-10 times the square of their longest edge."""
    a, b, c = (mesh.points[mesh.triangles[:, k]] for k in range(3))
    ab, ac, bc = b - a, c - a, c - b
    longest = np.maximum(np.maximum(_squared_lengths(ab), _squared_lengths(ac)), _squared_lengths(bc))
    valid = _squared_lengths(np.cross(ab, ac)) > (1e-10 * longest) ** 2
    return mesh if valid.all() else mesh.keep(valid)


def count_elements(points: Floats, counts: Ints, indices: Ints) -> dict[str, int]:
    """`TriangleMesh.element_counts` of a polygon mesh."""
    return {"uniform": len(counts), "vertex": len(points), "varying": len(points), "faceVarying": len(indices)}


def with_normals(mesh: TriangleMesh, normals: Floats) -> TriangleMesh:
    """The mesh with shading normals [m, 3, 3], normalized here; unusable ones are replaced by the geometric normal.

    A mesh stays faceted if all given normals equal the geometric ones.
    """
    geometric = cross_products(mesh.points, mesh.triangles)
    geometric /= np.linalg.norm(geometric, axis=1, keepdims=True)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    usable = np.isfinite(length) & (length > 1e-12)
    normals = np.where(usable, normals / np.where(usable, length, 1.0), geometric[:, None])
    if (np.einsum("mci,mi->mc", normals, geometric) > 1.0 - 1e-6).all():
        return mesh
    return replace(mesh, normals=normals.astype(np.float32))


def instantiate(mesh: TriangleMesh, matrices: Floats) -> tuple[Floats, Ints, Floats | None]:
    """Points, triangles and normals of a mesh's copies under matrices; see `scene.instances.transform_copies`."""
    return instances.transform_copies(mesh.points, mesh.triangles, mesh.normals, matrices)


def _squared_lengths(vectors: Floats) -> Floats:
    squares: Floats = np.einsum("ij,ij->i", vectors, vectors)
    return squares
