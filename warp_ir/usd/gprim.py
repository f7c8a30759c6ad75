"""Gprims to meshes: each shape read once, given its look, and placed wherever it is drawn."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pxr import Sdf, Usd, UsdLux

from warp_ir.scene import Floats, InputError, Ints, Material, Mesh
from warp_ir.usd import value
from warp_ir.usd.glow import glow
from warp_ir.usd.implicit import IMPLICIT, read_implicit
from warp_ir.usd.material import ABSENT, Look, MaterialTable
from warp_ir.usd.mesh import read_mesh, read_tet_mesh
from warp_ir.usd.network import Images
from warp_ir.usd.report import Report, Unreadable
from warp_ir.usd.shape import Shape, cross_products, place, without_slivers
from warp_ir.usd.skel import Skinning, sharing_key
from warp_ir.usd.walk import Site

_MOST_TRIANGLES = 200_000_000
"""A flattened scene of this size takes tens of gigabytes: refused before it is allocated."""

_Shapes = dict[tuple[Sdf.Path, ...], Shape | None]


def build_meshes(
    sites: Sequence[Site],
    time: Usd.TimeCode,
    report: Report,
    levels: int = 0,
    shapes: _Shapes | None = None,
    images: Images | None = None,
    metals: str = "diffuse",
) -> tuple[tuple[Mesh, ...], tuple[Material, ...]]:
    """All meshes in the world, one per gprim with all its copies, and the materials they use.

    Args:
        sites: The gprims and where they are drawn.
        time: Of the values.
        report: Where troubles go.
        levels: How often subdivision surfaces are refined.
        shapes: Those that are known already; new ones are added.
        images: Those that are known already, likewise.
        metals: "diffuse" or "black".

    Raises:
        InputError: There are more triangles than could be rendered.
    """
    table = MaterialTable(time, report, images, metals)
    return _Builder(time, report, levels, table, {} if shapes is None else shapes).run(sites)


class _Builder:
    """From gprims to meshes and the materials they use."""

    def __init__(self, time: Usd.TimeCode, report: Report, levels: int, table: MaterialTable, shapes: _Shapes) -> None:
        self._time, self._report, self._levels, self._table = time, report, levels, table
        self._skinning = Skinning(time, report)
        self._shapes = shapes

    def run(self, sites: Sequence[Site]) -> tuple[tuple[Mesh, ...], tuple[Material, ...]]:
        self._table.resolve([site.prim for site in sites])
        total = 0
        meshes = []
        shapes = [self._shape(site.prim) for site in sites]
        for site, shape in zip(sites, shapes, strict=True):
            total += 0 if shape is None else len(shape.triangles) * len(site.matrices)
        if total > _MOST_TRIANGLES:
            raise InputError(f"{self._report.source}: {total} triangles after instancing: too many to load")
        for site, shape in zip(sites, shapes, strict=True):
            mesh = None if shape is None else self._mesh(site, shape)
            if mesh is not None:
                meshes.append(mesh)
        return self._only_used(meshes)

    def _shape(self, prim: Usd.Prim) -> Shape | None:
        """The prim's triangles in its own space; instances of the same prototype share them."""
        shared = (prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim).GetPath()
        key = (shared, *sharing_key(prim))
        if key not in self._shapes:
            try:
                shape = self._read(prim)
            except Unreadable as trouble:
                self._report.warn(prim.GetPath(), f"{trouble}; the prim is skipped")
                shape = None
            if shape is not None and shape.degenerate:
                self._report.warn(prim.GetPath(), "{n} degenerate faces left out", shape.degenerate)
                self._report.stats["degenerate_faces"] += shape.degenerate
            self._shapes[key] = shape if shape is not None and len(shape.triangles) else None
        return self._shapes[key]

    def _read(self, prim: Usd.Prim) -> Shape | None:
        kind = prim.GetPrimTypeInfo().GetSchemaTypeName()
        if kind in IMPLICIT:
            return read_implicit(prim, kind, self._time)
        if kind == "TetMesh":
            return read_tet_mesh(prim, self._time, self._report)
        return read_mesh(prim, self._time, self._report, self._levels, self._skinning)

    def _mesh(self, site: Site, shape: Shape) -> Mesh | None:
        """A gprim in all its places as one mesh."""
        prim, copies = site.prim, len(site.matrices)
        look = self._table.look(prim, shape)
        present = look.material != ABSENT
        if not present.all():
            self._report.stats["triangles_absent"] += int((~present).sum()) * copies
            shape, look = shape.keep(present), look.keep(present)
        points, triangles, normals = place(shape, site.matrices)
        material, colors = np.tile(look.material, copies), self._colors(look, site)
        uvs = {name: np.tile(corners, (copies, 1, 1)) for name, corners in look.uvs.items()}
        mirrored = np.repeat(np.linalg.det(site.matrices[:, :3, :3]) < 0.0, len(shape.triangles))
        if mirrored.any():  # `place` has turned their corners round
            for corners in (*uvs.values(), *([] if colors is None else [colors])):
                corners[mirrored] = corners[mirrored][:, ::-1]
        if (np.linalg.det(site.matrices[:, :3, :3]) == 0.0).any():
            # A flattened copy keeps the triangles that still have an area.
            order = np.arange(len(triangles))
            kept = without_slivers(Shape(points, triangles, order, triangles, normals))
            triangles, material = kept.triangles, material[kept.face]
            normals = None if kept.normals is None else _or_geometric(kept.normals, points, triangles)
            colors = None if colors is None else colors[kept.face]
            uvs = {name: corners[kept.face] for name, corners in uvs.items()}
        if len(triangles) == 0:
            return None
        lamp = prim if prim.HasAPI(UsdLux.LightAPI) else site.lamp
        if lamp is not None:
            used, material = np.unique(material, return_inverse=True)
            area = 0.5 * float(np.linalg.norm(cross_products(points, triangles), axis=1).sum()) / copies
            lit = glow(lamp, [self._table.materials[i] for i in used], area, self._time, self._report)
            material = np.array([self._table.add(m) for m in lit], dtype=np.int32)[material]
            if not any(max(m.albedo) > 0.0 for m in lit):
                colors = None  # a light that answers with no material reflects no colour either
        # Of the implicit shapes only the plane is double-sided unless it says otherwise; its schema knows.
        double_sided = value.flag(prim.GetAttribute("doubleSided"), self._time)
        return Mesh(str(prim.GetPath()), points, triangles, material, normals, colors, double_sided, uvs)

    def _colors(self, look: Look, site: Site) -> Floats | None:
        """Albedo of the corners, float32 [k m, 3, 3], where a material's alone will not do."""
        copies = len(site.matrices)
        if site.colors is None or look.bare is None:
            return None if look.colors is None else np.tile(look.colors, (copies, 1, 1))
        given = site.colors.astype(np.float32)[:, None]
        per_triangle = np.where(look.bare[None, :, None], given, self._table.albedo(look.material)[None])
        return np.repeat(per_triangle.reshape(-1, 1, 3), 3, axis=1)

    def _only_used(self, meshes: Sequence[Mesh]) -> tuple[tuple[Mesh, ...], tuple[Material, ...]]:
        """The meshes with a table that holds no material in vain."""
        table = self._table.materials
        used = np.zeros(len(table), dtype=bool)
        for mesh in meshes:
            used[mesh.material] = True
        self._report.stats["unused_materials"] = int((~used).sum())
        if not used.any():
            return tuple(meshes), (Material(),)
        index = (np.cumsum(used) - 1).astype(np.int32)
        renamed = tuple(replace(mesh, material=index[mesh.material]) for mesh in meshes)
        return renamed, tuple(m for m, is_used in zip(table, used, strict=True) if is_used)


def _or_geometric(normals: Floats, points: Floats, triangles: Ints) -> Floats:
    """The normals, float32 [m, 3, 3], with the geometric one wherever flattening left none."""
    geometric = cross_products(points, triangles)
    geometric /= np.linalg.norm(geometric, axis=1, keepdims=True)
    usable = np.linalg.norm(normals, axis=-1, keepdims=True) > 0.5
    return np.where(usable, normals, geometric[:, None].astype(np.float32))
