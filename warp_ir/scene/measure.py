"""Areas and bounding boxes of meshes and of their copies, cached per mesh.

A mesh that does not move is part of many scenes (frames, shutter samples). The caches are keyed weakly, so that an
entry lives as long as its mesh.
"""

from weakref import WeakKeyDictionary

import numpy as np

from warp_ir.scene.instances import areas_of_copies, bounds_of_copies
from warp_ir.scene.types import Floats, Instances, Mesh

_AREAS: WeakKeyDictionary[Mesh, Floats] = WeakKeyDictionary()
_AREAS_BY_MATERIAL: WeakKeyDictionary[Mesh, Floats] = WeakKeyDictionary()
_ALBEDO_INTEGRALS: WeakKeyDictionary[Mesh, float] = WeakKeyDictionary()
_MATERIALS: WeakKeyDictionary[Mesh, tuple[int, ...]] = WeakKeyDictionary()
_AREAS_OF_COPIES: WeakKeyDictionary[Instances, WeakKeyDictionary[Mesh, Floats]] = WeakKeyDictionary()
_MESH_BOXES: WeakKeyDictionary[Mesh, tuple[Floats, Floats]] = WeakKeyDictionary()
_BOXES: WeakKeyDictionary[Instances, WeakKeyDictionary[Mesh, tuple[Floats, Floats]]] = WeakKeyDictionary()


def materials_of(mesh: Mesh) -> tuple[int, ...]:
    """Indices of the materials that a mesh's triangles have, ascending."""
    if mesh not in _MATERIALS:
        _MATERIALS[mesh] = tuple(np.unique(mesh.material).tolist())
    return _MATERIALS[mesh]


def triangle_areas(mesh: Mesh) -> Floats:
    """Areas of a mesh's triangles in the mesh's own space, float64 [m]."""
    if mesh not in _AREAS:
        a, b, c = (mesh.points[mesh.triangles[:, k]] for k in range(3))
        _AREAS[mesh] = np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))
    return _AREAS[mesh]


def areas_by_material(mesh: Mesh) -> Floats:
    """Total area of the triangles of each material index, float64 [1 + the mesh's largest material index]."""
    if mesh not in _AREAS_BY_MATERIAL:
        _AREAS_BY_MATERIAL[mesh] = np.bincount(mesh.material, weights=triangle_areas(mesh)).astype(np.float64)
    return _AREAS_BY_MATERIAL[mesh]


def albedo_integral(mesh: Mesh) -> float:
    """Integral of the albedo, averaged over channels, over the area of a mesh with `Mesh.colors`."""
    assert mesh.colors is not None
    if mesh not in _ALBEDO_INTEGRALS:
        _ALBEDO_INTEGRALS[mesh] = float((triangle_areas(mesh) * mesh.colors.mean(axis=(1, 2))).sum())
    return _ALBEDO_INTEGRALS[mesh]


def world_areas(mesh: Mesh, group: Instances | None) -> Floats:
    """Areas in world space, float64: [m] of a mesh's triangles without instances, else [k] of its copies."""
    if group is None:
        return triangle_areas(mesh)
    cache = _AREAS_OF_COPIES.setdefault(group, WeakKeyDictionary())
    if mesh not in cache:
        cache[mesh] = areas_of_copies(mesh.points, mesh.triangles, group.matrices)
    return cache[mesh]


def world_bounds(mesh: Mesh, group: Instances | None) -> tuple[Floats, Floats]:
    """Lower and upper corner [3] of the world-space box around the triangles of a mesh, or around all of its copies."""
    if group is None:
        box = _MESH_BOXES.get(mesh)
        if box is None:
            used = _used_points(mesh)
            box = _MESH_BOXES[mesh] = used.min(axis=0), used.max(axis=0)
        return box
    cache = _BOXES.setdefault(group, WeakKeyDictionary())
    if mesh not in cache:
        cache[mesh] = bounds_of_copies(_used_points(mesh), group.matrices)
    return cache[mesh]


def _used_points(mesh: Mesh) -> Floats:
    """The points that are part of a triangle."""
    is_used = np.zeros(len(mesh.points), dtype=bool)
    is_used[mesh.triangles] = True
    return mesh.points if is_used.all() else mesh.points[is_used]
