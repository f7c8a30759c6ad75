"""Tables of what the corners of triangles have: normals, colours, texture coordinates."""

from typing import Any

import numpy as np
import warp as wp

from warp_ir.device_scene.records import INSTANCE_COLOR
from warp_ir.launch import Launcher


def upload_corners(
    corners: list[Any],
    counts: list[int],
    launcher: Launcher,
    dtype: Any = wp.vec3,
    per_triangle: int = 3,
    from_instance: Any = None,
) -> tuple[Any, Any]:
    """Per-triangle offsets (-1: none) into one table of the corner values of the meshes that have them."""
    columns = wp.types.type_size(dtype)
    rows = np.full(max(sum(counts), 1), -1, np.int32)
    values, triangle, row = [], 0, 0
    for corner, count in zip(corners, counts, strict=True):
        if corner is not None:
            rows[triangle : triangle + count] = row + per_triangle * np.arange(count)
            values.append(corner.reshape(-1, columns))
            row += per_triangle * count
        triangle += count
    if from_instance is not None:
        rows[from_instance] = INSTANCE_COLOR
    table = np.concatenate(values) if values else np.zeros((1, columns))
    return launcher.array(rows, wp.int32), launcher.array(table.astype(np.float32), dtype)
