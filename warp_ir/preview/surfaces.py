"""The surfaces of a scene in their albedo, for a plotter."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ir.scene import Mesh, Scene, Texture, Wrap

Floats = npt.NDArray[np.floating]

_MAX_TRIANGLES = 5_000_000
"""Approximate limit on the triangles drawn; of a scene with more, an even selection of the instances is drawn."""
_LOOK: dict[str, Any] = dict(ambient=0.3, diffuse=0.7, specular=0.0, show_edges=False)
_FLUSH = 0.02
"""A triangle is part of an outer wall if no point lies farther behind it than this, per extent of the scene."""


def add_surfaces(plot: Any, scene: Scene) -> None:
    """Adds the surfaces in their albedo, with textures.

    The outer walls of a room, with either winding, are drawn only where one sees their inner side: so one looks into
    the room from everywhere. A wall is outer if the whole scene lies on one side of it, and a room's if its front is
    towards the scene or the scene's camera is within the scene.
    """
    import pyvista

    lower, upper = scene.bounds()
    eye = scene.camera.world_from_camera[:3, 3]
    inside = bool(((eye > lower) & (eye < upper)).all())
    plain: dict[bool, list[tuple[Floats, Floats]]] = {False: [], True: []}
    for mesh in _flattened(scene).meshes:
        corners = mesh.points[mesh.triangles]
        outer, turned = _outer_walls(corners, lower, upper, inside)
        albedo = np.array([m.albedo for m in scene.materials], dtype=np.float64)[mesh.material]
        colors = np.repeat(albedo[:, None], 3, axis=1) if mesh.colors is None else np.asarray(mesh.colors, np.float64)
        textured = np.zeros(len(corners), bool)
        for k in np.unique(mesh.material) if mesh.colors is None else ():
            texture = scene.materials[k].albedo_texture
            if texture is not None and texture.uv in mesh.uvs:
                chosen = mesh.material == k
                textured |= chosen
                _add_textured(plot, mesh, texture, chosen, outer, turned)
        for wall in (False, True):
            chosen = (outer == wall) & ~textured
            if chosen.any():
                plain[wall].append((turned[chosen] if wall else corners[chosen], colors[chosen]))
    for wall, parts in plain.items():
        if parts:
            points, colors = (np.concatenate([part[k] for part in parts]).reshape(-1, 3) for k in range(2))
            faces: Any = np.arange(len(points)).reshape(-1, 3)
            surface = pyvista.PolyData.from_regular_faces(points, faces)
            surface.point_data["albedo"] = np.round(255.0 * np.clip(colors, 0.0, 1.0) ** (1 / 2.2)).astype(np.uint8)
            plot.add_mesh(surface, scalars="albedo", rgb=True, culling="back" if wall else False, **_LOOK)


def _outer_walls(corners: Floats, lower: Floats, upper: Floats, inside: bool) -> tuple[npt.NDArray[np.bool_], Floats]:
    """Which triangles are outer walls of a room, and all triangles with the winding whose front is towards the scene.

    Args:
        corners: [n, 3, 3], corners of the triangles.
        lower: [3], lower corner of the scene.
        upper: [3], upper corner.
        inside: Whether the camera is within the scene, so that walls of either winding are a room's.
    """
    center, extent = 0.5 * (lower + upper), float(np.linalg.norm(upper - lower))
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    distance = np.einsum("nk,nk->n", normals, corners.mean(axis=1) - center)
    flush = np.abs(distance) >= np.abs(normals) @ (0.5 * (upper - lower)) - _FLUSH * extent
    inward = distance < 0.0
    outer = flush & (inward | inside)
    turned = np.where((outer & ~inward)[:, None, None], corners[:, ::-1], corners)
    return outer, turned


def _add_textured(
    plot: Any, mesh: Mesh, texture: Texture, chosen: npt.NDArray[np.bool_], outer: npt.NDArray[np.bool_], turned: Floats
) -> None:
    """Adds the triangles `chosen` of a mesh with their texture."""
    import pyvista

    image = np.clip(np.broadcast_to(texture.pixels, (*texture.pixels.shape[:2], 3)), 0.0, 1.0) ** (1 / 2.2)
    make_texture: Any = pyvista.Texture
    picture = make_texture(np.ascontiguousarray(np.round(255.0 * image).astype(np.uint8)))
    picture.repeat = texture.wrap[0] == Wrap.REPEAT
    uv = np.asarray(mesh.uvs[texture.uv], np.float64) @ texture.transform[:, :2].T + texture.transform[:, 2]
    corners = mesh.points[mesh.triangles]
    uv = np.where((turned != corners).any(axis=(1, 2), keepdims=True), uv[:, ::-1], uv)
    for wall in (False, True):
        part = chosen & (outer == wall)
        if part.any():
            points = (turned if wall else corners)[part].reshape(-1, 3)
            faces: Any = np.arange(len(points)).reshape(-1, 3)
            surface = pyvista.PolyData.from_regular_faces(points, faces)
            surface.active_texture_coordinates = uv[part].reshape(-1, 2)
            plot.add_mesh(surface, texture=picture, culling="back" if wall else False, **_LOOK)


def _flattened(scene: Scene) -> Scene:
    """The scene with copies of its instances, or of an even selection if they have too many triangles."""
    step = max(1, math.ceil(scene.triangles_seen / _MAX_TRIANGLES))
    selected = (
        replace(g, matrices=g.matrices[::step], colors=None if g.colors is None else g.colors[::step])
        for g in scene.instances
    )
    return replace(scene, instances=tuple(selected)).flat()
