"""A gprim as triangles in its own space, before it is coloured and placed in the world."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from warp_ir.scene import Floats, Ints, instances

Mask = npt.NDArray[np.bool_]


class Refined(Protocol):
    """How primvars follow a surface that was subdivided: values of the prim's elements to those of the finer mesh."""

    def vertex(self, values: Floats) -> Floats:
        """Values of points [n, c] at the refined points."""

    def varying(self, values: Floats) -> Floats:
        """Values of points [n, c] at the refined points, linear on every face."""

    def face_varying(self, values: Floats, indices: Ints | None = None) -> Floats:
        """Values of face-vertices [v, c], or [n, c] with indices [v], at the refined face-vertices."""


@dataclass(frozen=True, eq=False)
class Shape:
    """Triangles that still know which face and which face-vertex of the prim they came from.

    Of a subdivided surface, points, triangles and corners are those of the finer mesh, faces those of the prim. A
    native prototype is read into one `Shape`, however often it is placed.
    """

    points: Floats
    """float64 [n, 3]."""
    triangles: Ints
    """int32 [m, 3], counter-clockwise seen from the front."""
    face: Ints
    """int32 [m]: the prim's face each triangle is part of."""
    corner: Ints
    """int32 [m, 3]: the prim's face-vertex each corner is."""
    normals: Floats | None = None
    """float32 [m, 3, 3], unit shading normals; None: faceted."""
    elements: Mapping[str, int] = field(default_factory=dict)
    """How many values a primvar has per interpolation; an interpolation that is missing cannot be honoured."""
    degenerate: int = 0
    """Number of faces without area that were left out."""
    refined: Refined | None = None
    """How primvars get from the prim's elements to those of a subdivided surface; None: they are the same."""

    def keep(self, mask: Mask) -> "Shape":
        """This shape with only the triangles that the mask [m] selects."""
        normals = None if self.normals is None else self.normals[mask]
        return replace(
            self,
            triangles=self.triangles[mask],
            face=self.face[mask],
            corner=self.corner[mask],
            normals=normals,
        )


def cross_products(points: Floats, triangles: Ints) -> Floats:
    """Twice the area of each triangle, as a vector along its geometric normal, float64 [m, 3]."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def without_slivers(shape: Shape) -> Shape:
    """The shape without triangles that have no area (to float64, relative to their longest edge)."""
    a, b, c = (shape.points[shape.triangles[:, k]] for k in range(3))
    ab, ac, bc = b - a, c - a, c - b
    longest = np.maximum(np.maximum(_squared(ab), _squared(ac)), _squared(bc))
    fine = _squared(np.cross(ab, ac)) > (1e-10 * longest) ** 2
    return shape if fine.all() else shape.keep(fine)


def elements_of(points: Floats, counts: Ints, indices: Ints) -> dict[str, int]:
    """`Shape.elements` of a polygon mesh."""
    return {"uniform": len(counts), "vertex": len(points), "varying": len(points), "faceVarying": len(indices)}


def shaded(shape: Shape, normals: Floats) -> Shape:
    """The shape with these normals [m, 3, 3], its own where they are unusable; faceted if they say no more."""
    geometric = cross_products(shape.points, shape.triangles)
    geometric /= np.linalg.norm(geometric, axis=1, keepdims=True)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    usable = np.isfinite(length) & (length > 1e-12)
    normals = np.where(usable, normals / np.where(usable, length, 1.0), geometric[:, None])
    if (np.einsum("mci,mi->mc", normals, geometric) > 1.0 - 1e-6).all():
        return shape
    return replace(shape, normals=normals.astype(np.float32))


def place(shape: Shape, matrices: Floats) -> tuple[Floats, Ints, Floats | None]:
    """Copies of a shape's points, triangles and normals: see `scene.instances.transform_copies`."""
    return instances.transform_copies(shape.points, shape.triangles, shape.normals, matrices)


def _squared(vectors: Floats) -> Floats:
    squares: Floats = np.einsum("ij,ij->i", vectors, vectors)
    return squares
