"""Areas and bounding boxes of meshes and of their copies, each computed once for a mesh.

A mesh that does not move is part of many scenes: what is computed of it is kept as long as the mesh lives.
"""

from weakref import WeakKeyDictionary

import numpy as np

from warp_ir.scene.instances import areas_of_copies, bounds_of_copies
from warp_ir.scene.types import Floats, Instances, Mesh

_AREAS: WeakKeyDictionary[Mesh, Floats] = WeakKeyDictionary()
_AREAS_BY_MATERIAL: WeakKeyDictionary[Mesh, Floats] = WeakKeyDictionary()
_COLORED_AREAS: WeakKeyDictionary[Mesh, float] = WeakKeyDictionary()
_MATERIALS: WeakKeyDictionary[Mesh, tuple[int, ...]] = WeakKeyDictionary()
_AREAS_OF_COPIES: WeakKeyDictionary[Instances, WeakKeyDictionary[Mesh, Floats]] = WeakKeyDictionary()
_BOXES: WeakKeyDictionary[Mesh | Instances, WeakKeyDictionary[Mesh, tuple[Floats, Floats]]] = WeakKeyDictionary()


def materials_of(mesh: Mesh) -> tuple[int, ...]:
    """Indices of the materials that a mesh's triangles have, ascending."""
    if mesh not in _MATERIALS:
        _MATERIALS[mesh] = tuple(np.unique(mesh.material).tolist())
    return _MATERIALS[mesh]


def triangle_areas(mesh: Mesh) -> Floats:
    """Areas of a mesh's triangles, float64 [m]."""
    if mesh not in _AREAS:
        a, b, c = (mesh.points[mesh.triangles[:, k]] for k in range(3))
        _AREAS[mesh] = np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))
    return _AREAS[mesh]


def areas_by_material(mesh: Mesh) -> Floats:
    """Area of a mesh's triangles of each material, up to the last that it has."""
    if mesh not in _AREAS_BY_MATERIAL:
        _AREAS_BY_MATERIAL[mesh] = np.bincount(mesh.material, weights=triangle_areas(mesh)).astype(np.float64)
    return _AREAS_BY_MATERIAL[mesh]


def colored_area(mesh: Mesh) -> float:
    """Area times albedo of a mesh with colours."""
    assert mesh.colors is not None
    if mesh not in _COLORED_AREAS:
        _COLORED_AREAS[mesh] = float((triangle_areas(mesh) * mesh.colors.mean(axis=(1, 2))).sum())
    return _COLORED_AREAS[mesh]


def area_in_world(mesh: Mesh, group: Instances | None) -> Floats:
    """Areas of a mesh's triangles, or of its copies, float64."""
    if group is None:
        return triangle_areas(mesh)
    known = _AREAS_OF_COPIES.setdefault(group, WeakKeyDictionary())
    if mesh not in known:
        known[mesh] = areas_of_copies(mesh.points, mesh.triangles, group.matrices)
    return known[mesh]


def bounding_box(mesh: Mesh, group: Instances | None) -> tuple[Floats, Floats]:
    """Lower and upper corner [3] of the points that the triangles use, or of their copies."""
    known = _BOXES.setdefault(group or mesh, WeakKeyDictionary())
    if mesh not in known:
        used = mesh.points[np.unique(mesh.triangles)]
        if group is None:
            known[mesh] = (used.min(axis=0), used.max(axis=0))
        else:
            known[mesh] = bounds_of_copies(used, group.matrices)
    return known[mesh]
