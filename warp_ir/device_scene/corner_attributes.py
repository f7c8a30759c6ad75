"""Tables of what the corners of triangles have: normals, colours, texture coordinates."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt


def corner_tables(
    corners: Sequence[Any], counts: Sequence[int], first: int, columns: int = 3, per_triangle: int = 3
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """Per-triangle offsets (-1: none) into one table of the corner values of the meshes that have them.

    Args:
        corners: Of each mesh, values [m, per_triangle, columns], or None.
        counts: Triangles of each mesh.
        first: Row at which the table begins.
        columns: Of a value.
        per_triangle: Rows of a triangle.

    Returns:
        Offsets [sum of counts], and the table [r, columns].
    """
    rows = np.full(sum(counts), -1, np.int32)
    values, triangle, row = [np.zeros((0, columns), np.float32)], 0, first
    for corner, count in zip(corners, counts, strict=True):
        if corner is not None:
            rows[triangle : triangle + count] = row + per_triangle * np.arange(count)
            values.append(np.asarray(corner, np.float32).reshape(-1, columns))
            row += per_triangle * count
        triangle += count
    return rows, np.concatenate(values)
