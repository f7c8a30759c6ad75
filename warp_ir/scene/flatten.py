"""Instanced meshes written out as meshes in the world, copy by copy."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from warp_ir.scene.instances import place
from warp_ir.scene.types import Instances, Material, Mesh


def written_out(mesh: Mesh, group: Instances, materials: Sequence[Material]) -> Mesh:
    """An instanced mesh as one in the world: all its copies, one after the other."""
    copies = len(group.matrices)
    points, triangles, normals = place(mesh.points, mesh.triangles, mesh.normals, group.matrices)
    mirrored = np.linalg.det(group.matrices[:, :3, :3]) < 0.0
    # What else a mesh has, it has per triangle, or per corner of each.
    tables: dict[str, Any] = {
        f.name: _repeated(getattr(mesh, f.name), mirrored)
        for f in fields(mesh)
        if f.name not in ("points", "triangles", "normals", "bare")
    }
    if mesh.tangents is not None:
        linear = np.repeat(group.matrices[:, :3, :3], 3 * len(mesh.triangles), axis=0)
        tables["tangents"] = np.einsum("nij,nj->ni", linear, tables["tangents"].reshape(-1, 3)).reshape(-1, 3, 3)
    if group.colors is not None and mesh.bare is not None:
        own = mesh.colors
        if own is None:
            albedo = np.array([m.albedo for m in materials], np.float32)[mesh.material]
            own = np.repeat(albedo[:, None], 3, axis=1)
        given = group.colors.astype(np.float32)[:, None, None]
        own = _repeated(own, mirrored).reshape(copies, -1, 3, 3)
        tables["colors"] = np.where(mesh.bare[None, :, None, None], given, own).reshape(-1, 3, 3)
    return replace(mesh, points=points, triangles=triangles, normals=normals, bare=None, **tables)


def _repeated(value: Any, mirrored: Any) -> Any:
    """A table, or each of a mapping of tables, once for every copy; anything else as it is.

    Rows [m, 3, c] are of corners, which `place` turns round in mirrored copies.
    """
    if isinstance(value, np.ndarray):
        turned = value[:, ::-1] if value.ndim == 3 else value
        return np.concatenate([turned if is_mirrored else value for is_mirrored in mirrored])
    return {key: _repeated(v, mirrored) for key, v in value.items()} if isinstance(value, Mapping) else value
