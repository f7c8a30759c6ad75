"""Instanced meshes flattened: the copies become triangles in world space."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from warp_ir.scene.instances import transform_copies
from warp_ir.scene.types import Bools, Floats, Instances, Material, Mesh


def flattened(mesh: Mesh, group: Instances, materials: Sequence[Material]) -> Mesh:
    """An instanced mesh as one mesh in world space that holds all copies, one after the other."""
    copies = len(group.matrices)
    points, triangles, normals = transform_copies(mesh.points, mesh.triangles, mesh.normals, group.matrices)
    mirrored = np.linalg.det(group.matrices[:, :3, :3]) < 0.0
    tangents = None
    if mesh.tangents is not None:
        linear = np.repeat(group.matrices[:, :3, :3], 3 * len(mesh.triangles), axis=0)
        repeated = _repeat_corners(mesh.tangents, mirrored)
        tangents = np.einsum("nij,nj->ni", linear, repeated.reshape(-1, 3)).reshape(-1, 3, 3)
    colors = None if mesh.colors is None else _repeat_corners(mesh.colors, mirrored)
    if group.colors is not None and mesh.bare is not None:
        prototype = mesh.colors
        if prototype is None:
            albedo = np.array([m.albedo for m in materials], np.float32)[mesh.material]
            prototype = np.repeat(albedo[:, None], 3, axis=1)
        own = _repeat_corners(prototype, mirrored).reshape(copies, -1, 3, 3)
        instance = group.colors.astype(np.float32)[:, None, None]
        colors = np.where(mesh.bare[None, :, None, None], instance, own).reshape(-1, 3, 3)
    return replace(
        mesh,
        points=points,
        triangles=triangles,
        material=np.tile(mesh.material, copies),
        normals=normals,
        colors=colors,
        uvs={name: _repeat_corners(uv, mirrored) for name, uv in mesh.uvs.items()},
        bare=None,
        tangents=tangents,
    )


def _repeat_corners(values: Floats, mirrored: Bools) -> Floats:
    """Values of corners [m, 3, c] for k copies, [k m, 3, c]; the corners of mirrored copies [k] in reverse order.

    `transform_copies` reverses the winding of mirrored copies in the same way.
    """
    return np.concatenate([values[:, ::-1] if is_mirrored else values for is_mirrored in mirrored])
