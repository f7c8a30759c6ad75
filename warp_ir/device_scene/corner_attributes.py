"""Tables of the attributes of triangle corners: normals, colours, texture coordinates, tangents."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt


def corner_tables(
    values: "Sequence[npt.NDArray[np.floating] | None]",
    counts: Sequence[int],
    first: int,
    columns: int = 3,
    per_triangle: int = 3,
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """One table of the corner values of several meshes, and the first row of each triangle in it.

    Args:
        values: For each mesh, values [m, per_triangle, columns], or None.
        counts: Number of triangles of each mesh.
        first: Row at which the table begins.
        columns: Components of a value.
        per_triangle: Rows of a triangle.

    Returns:
        First rows, [sum of counts], -1 where a mesh has no values; and the table [r, columns].
    """
    rows = np.full(sum(counts), -1, np.int32)
    tables, triangle, row = [np.zeros((0, columns), np.float32)], 0, first
    for mesh_values, count in zip(values, counts, strict=True):
        if mesh_values is not None:
            rows[triangle : triangle + count] = row + per_triangle * np.arange(count)
            tables.append(np.asarray(mesh_values, np.float32).reshape(-1, columns))
            row += per_triangle * count
        triangle += count
    return rows, np.concatenate(tables)
