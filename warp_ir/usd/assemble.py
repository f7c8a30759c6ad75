"""Gprims to meshes: each shape read once, given its look, and placed wherever it is drawn, or kept as a prototype."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from pxr import Sdf, Usd, UsdLux

from warp_ir.scene import Bools, Floats, Instances, Ints, Material, Mesh
from warp_ir.scene.instances import areas_of_copies
from warp_ir.usd.geometry.implicit import IMPLICIT, read_implicit
from warp_ir.usd.geometry.instancing import InstanceLevel, nested_colors, nested_transforms
from warp_ir.usd.geometry.mesh import read_mesh, read_tet_mesh
from warp_ir.usd.geometry.prototypes import (
    MAX_FLATTENED_TRIANGLES,
    InstancedGprim,
    LevelGroup,
    choose_storage,
    digest,
    well_conditioned,
)
from warp_ir.usd.geometry.skinning import Skinning, pose_key
from warp_ir.usd.geometry.tangents import smooth_tangents
from warp_ir.usd.images.cache import ImageCache
from warp_ir.usd.images.shading_value import ShadingValue
from warp_ir.usd.lights.mesh_light import LAMP_UV, Lamp
from warp_ir.usd.linking import Linking
from warp_ir.usd.shading.binding import PURPOSES
from warp_ir.usd.shading.material_table import ABSENT, Look, MaterialTable
from warp_ir.usd.traverse import LIGHT_COPIES, Site
from warp_ir.usd.values import read
from warp_ir.usd.values.primvar import texture_coordinates
from warp_ir.usd.values.report import Report, Unreadable
from warp_ir.usd.values.triangles import TriangleMesh, cross_products, drop_degenerate, instantiate

_Shapes = dict[tuple[Sdf.Path, ...], TriangleMesh | None]


@dataclass(frozen=True, eq=False)
class Geometry:
    """What a stage draws."""

    meshes: tuple[Mesh, ...]
    instances: tuple[Instances, ...]
    materials: tuple[Material, ...]


@dataclass(frozen=True, eq=False)
class _Gprim:
    """A gprim as it was read."""

    site: Site
    shape: TriangleMesh
    look: Look
    emits: bool


@dataclass(eq=False)
class _Prototype:
    """A prototype that is stored once, while its meshes are made."""

    matrices: Floats
    colors: Floats | None
    fit: Bools
    """Which of its places can be instances; the others are written out."""
    meshes: list[int] = field(default_factory=list)


def build_meshes(
    sites: Sequence[Site],
    time: Usd.TimeCode,
    report: Report,
    levels: int = 0,
    shapes: _Shapes | None = None,
    images: ImageCache | None = None,
    metals: str = "diffuse",
    purposes: Sequence[str] = PURPOSES[:2],
    linking: Linking | None = None,
) -> Geometry:
    """All meshes, one per gprim with all its copies, those that are instanced, and the materials they use.

    Args:
        sites: The gprims and where they are drawn.
        time: Of the values.
        report: Where troubles go.
        levels: How often subdivision surfaces are refined.
        shapes: Those that are known already; new ones are added.
        images: Those that are known already, likewise.
        metals: "diffuse" or "black".
        purposes: Of the bindings of materials, in the order in which they are wanted.
        linking: The links of lights, by which copies of a gprim may differ.

    Raises:
        InputError: There are more triangles than could be rendered.
    """
    table = MaterialTable(time, report, images, metals, purposes)
    known = {} if shapes is None else shapes
    return _Builder(time, report, levels, table, known, linking or Linking(())).run(sites)


class _Builder:
    """From gprims to meshes and the materials they use."""

    def __init__(
        self,
        time: Usd.TimeCode,
        report: Report,
        levels: int,
        table: MaterialTable,
        shapes: _Shapes,
        linking: Linking,
    ) -> None:
        self._time, self._report, self._levels, self._table = time, report, levels, table
        self._linking = linking
        self._skinning = Skinning(time, report)
        self._shapes = shapes
        self._seen: dict[tuple[object, ...], tuple[TriangleMesh, Look, bool]] = {}
        self._known: dict[tuple[object, ...], tuple[Floats, Ints, Floats | None]] = {}
        self._lamps: dict[Sdf.Path, Lamp] = {}
        self._painted: dict[tuple[int, Hashable], InstanceLevel] = {}
        self._dressed: dict[tuple[int, int], Look] = {}

    def run(self, sites: Sequence[Site]) -> Geometry:
        self._table.resolve([site.prim for site in sites])
        gprims = [gprim for site in sites if (gprim := self._gprim(site)) is not None]
        parts = [InstancedGprim(g.site.level, len(g.shape.triangles), self._signature(g), g.emits) for g in gprims]
        meshes: list[Mesh] = []
        prototypes: dict[int, _Prototype] = {}
        for drawn in choose_storage(parts, self._report.source):
            gprim, home = gprims[drawn.gprim], drawn.prototype
            places = nested_transforms(level.matrices for level in drawn.levels)
            colors = nested_colors((len(level.matrices), level.colors) for level in drawn.levels)
            if home is None:
                for chosen in self._apart(gprim, places):
                    self._add(meshes, self._mesh(gprim, places[chosen], None if colors is None else colors[chosen]))
                continue
            if id(home) not in prototypes:
                prototypes[id(home)] = self._prototype(home, gprim)
            prototype = prototypes[id(home)]
            if prototype.fit.any():
                mesh = self._mesh(gprim, places, colors, shared=True)
                if mesh is not None and (prototype.colors is None or colors is not None):
                    mesh = replace(mesh, bare=None)
                prototype.meshes += self._add(meshes, mesh)
            if not prototype.fit.all():
                self._add(meshes, self._unfit(gprim, prototype, places, colors))
        instances = [
            Instances(
                meshes[prototype.meshes[0]].name,
                tuple(prototype.meshes),
                prototype.matrices[prototype.fit],
                None if prototype.colors is None else prototype.colors[prototype.fit].astype(np.float32),
            )
            for prototype in prototypes.values()
            if prototype.meshes
        ]
        renamed, materials = self._only_used(meshes)
        return Geometry(renamed, tuple(instances), materials)

    @staticmethod
    def _add(meshes: list[Mesh], mesh: Mesh | None) -> list[int]:
        """Appends a mesh if there is one; its index."""
        if mesh is None:
            return []
        meshes.append(mesh)
        return [len(meshes) - 1]

    def _gprim(self, site: Site) -> _Gprim | None:
        """A gprim without the triangles that are not there; equal looks are stored once."""
        whole = self._shape(site.prim)
        if whole is None:
            return None
        look = self._table.look(site.prim, whole)
        lamp = self._lamp(site)
        if lamp is not None and lamp.textured and LAMP_UV not in look.uvs:
            corners = texture_coordinates(site.prim, whole, LAMP_UV, self._time, self._report)
            look = look if corners is None else replace(look, uvs={**look.uvs, LAMP_UV: corners})
        uvs = tuple((name, digest(corners)) for name, corners in sorted(look.uvs.items()))
        key = (id(whole), digest(look.material), digest(look.colors), digest(look.bare), uvs)
        if key not in self._seen:
            present, shape = look.material != ABSENT, whole
            if not present.all():
                shape, look = whole.keep(present), look.keep(present)
            emission = [max(self._table.materials[k].emission) for k in np.unique(look.material)]
            self._seen[key] = (shape, look, max(emission, default=0.0) > 0.0)
        shape, look, emits = self._seen[key]
        absent = len(whole.triangles) - len(shape.triangles)
        self._report.stats["triangles_absent"] += absent * site.level.instance_count
        if len(shape.triangles) == 0:
            return None
        site, look = self._with_instance_primvars(site, look)
        return _Gprim(site, shape, look, emits or lamp is not None)

    def _with_instance_primvars(self, site: Site, look: Look) -> tuple[Site, Look]:
        """The gprim as its material has it, if that reads primvars which instancers give to each instance."""
        given = [level.primvars for level in site.level.chain() if level.primvars is not None]
        for name in sorted(name for name in look.unread if any(each.has(name) for each in given)):
            what = f"emission or opacity by the primvar {name} of each instance is not read: its fallback counts"
            self._report.warn(site.prim.GetPath(), what)
        levels = [self._paint(site.level, albedo) for _, albedo in look.asked]
        found = [k for k, level in enumerate(levels) if any(each.colors is not None for each in level.chain())]
        if not found:
            return site, look
        if len(found) > 1 or look.bare is not None:
            path = site.prim.GetPath()
            self._report.warn(path, "of materials that read primvars of instances, one is coloured by them")
        key = (id(look), found[0])
        if key not in self._dressed:
            self._dressed[key] = replace(look, bare=look.asked[found[0]][0])
        return replace(site, level=levels[found[0]]), self._dressed[key]

    def _paint(self, level: InstanceLevel, albedo: ShadingValue) -> InstanceLevel:
        """A level with the colours that an albedo has in its places, and so all levels that it is in."""
        if level.parent is None:
            return level
        key = (id(level), albedo.key)
        if key not in self._painted:
            colors: Floats | None = None
            if level.primvars is not None:
                by_name = {
                    asked: level.primvars.read(asked.name, asked.channels, self._report) for asked in albedo.primvars
                }
                values = {asked: rows for asked, rows in by_name.items() if rows is not None}
                if values:
                    colors = np.broadcast_to(albedo.evaluate(values), (len(level.matrices), 3)).clip(0.0, 1.0)
            parent = self._paint(level.parent, albedo)
            self._painted[key] = replace(level, key=(level.key, albedo.key), parent=parent, colors=colors)
        return self._painted[key]

    def _lamp(self, site: Site) -> Lamp | None:
        """The light that a gprim is, if it is one."""
        prim = site.prim if site.prim.HasAPI(UsdLux.LightAPI) else site.lamp
        if prim is None:
            return None
        path = site.prim.GetPath()
        if path not in self._lamps:
            self._lamps[path] = Lamp(prim, site.prim, self._time, self._report)
        return self._lamps[path]

    def _apart(self, gprim: _Gprim, places: Floats) -> list[slice]:
        """The places that one mesh can stand for: all, unless they differ as lights."""
        lamp = self._lamp(gprim.site)
        if lamp is None or len(places) == 1:
            return [slice(None)]
        areas = areas_of_copies(gprim.shape.points, gprim.shape.triangles, places @ gprim.site.local)
        if not lamp.differs(areas):
            return [slice(None)]
        if len(places) > LIGHT_COPIES:
            self._report.warn(gprim.site.prim.GetPath(), f"{len(places)} copies of a light: too many, it is left out")
            return []
        return [slice(k, k + 1) for k in range(len(places))]

    def _signature(self, gprim: _Gprim) -> object:
        """Equal for gprims of one prototype that look and are lit alike; shapes and looks are kept: ids will do."""
        links = self._linking.of(gprim.site.prim.GetPath())
        return id(gprim.shape), id(gprim.look), digest(gprim.site.local), links

    def _prototype(self, group: LevelGroup, gprim: _Gprim) -> _Prototype:
        matrices = group.world_matrices()
        finite = np.isfinite(matrices).all(axis=(1, 2))
        if not finite.all():
            self._report.warn(
                gprim.site.prim.GetPath(), "{n} instances with infinite transforms left out", int((~finite).sum())
            )
        colors = group.world_colors()
        matrices, colors = matrices[finite], None if colors is None else colors[finite]
        return _Prototype(matrices, colors, well_conditioned(matrices))

    def _unfit(self, gprim: _Gprim, prototype: _Prototype, places: Floats, colors: Floats | None) -> Mesh | None:
        """The copies whose matrices collapse the prototype, or nearly, in the world."""
        matrices = prototype.matrices[~prototype.fit]
        if len(matrices) * len(places) * len(gprim.shape.triangles) > MAX_FLATTENED_TRIANGLES:
            path = gprim.site.prim.GetPath()
            self._report.warn(path, "{n} instances with singular transforms left out", len(matrices))
            return None
        outer = None if prototype.colors is None else prototype.colors[~prototype.fit]
        given = nested_colors([(len(matrices), outer), (len(places), colors)])
        return self._mesh(gprim, nested_transforms([matrices, places]), given)

    def _shape(self, prim: Usd.Prim) -> TriangleMesh | None:
        """The prim's triangles in its own space; instances of the same prototype share them."""
        shared = (prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim).GetPath()
        key = (shared, *pose_key(prim))
        if key not in self._shapes:
            try:
                shape = self._read(prim)
            except Unreadable as trouble:
                self._report.warn(prim.GetPath(), f"{trouble}; the prim is skipped")
                shape = None
            if shape is not None and shape.degenerate_faces:
                self._report.warn(prim.GetPath(), "{n} degenerate faces left out", shape.degenerate_faces)
                self._report.stats["degenerate_faces"] += shape.degenerate_faces
            self._shapes[key] = shape if shape is not None and len(shape.triangles) else None
        return self._shapes[key]

    def _read(self, prim: Usd.Prim) -> TriangleMesh | None:
        kind = prim.GetPrimTypeInfo().GetSchemaTypeName()
        if kind in IMPLICIT:
            return read_implicit(prim, kind, self._time)
        if kind == "TetMesh":
            return read_tet_mesh(prim, self._time, self._report)
        return read_mesh(prim, self._time, self._report, self._levels, self._skinning)

    def _mesh(self, gprim: _Gprim, places: Floats, given: Floats | None, *, shared: bool = False) -> Mesh | None:
        """A gprim in all its places as one mesh.

        Args:
            gprim: What.
            places: Of its level, [k, 4, 4].
            given: The places' own colours [k, 3], or None.
            shared: Whether it is a prototype's: then it says where its instances may colour it.
        """
        prim, shape, look = gprim.site.prim, gprim.shape, gprim.look
        matrices = places @ gprim.site.local
        finite = np.isfinite(matrices).all(axis=(1, 2))
        if not finite.all():
            self._report.warn(prim.GetPath(), "{n} copies with infinite transforms left out", int((~finite).sum()))
            matrices, given = matrices[finite], None if given is None else given[finite]
            if not finite.any():
                return None
        copies = len(matrices)
        points, triangles, normals = self._placed(shape, matrices, shared=shared)
        material, colors = np.tile(look.material, copies), self._colors(look, given, copies)
        uvs = {name: np.tile(corners, (copies, 1, 1)) for name, corners in look.uvs.items()}
        mirrored = np.repeat(np.linalg.det(matrices[:, :3, :3]) < 0.0, len(shape.triangles))
        if mirrored.any():  # `instantiate` has reversed their winding
            for corners in (*uvs.values(), *([] if colors is None else [colors])):
                corners[mirrored] = corners[mirrored][:, ::-1]
        bare = np.tile(look.bare, copies) if shared and look.bare is not None else None
        if (np.linalg.det(matrices[:, :3, :3]) == 0.0).any():
            # A flattened copy keeps the triangles that still have an area.
            order = np.arange(len(triangles))
            kept = drop_degenerate(TriangleMesh(points, triangles, order, triangles, normals))
            triangles, material = kept.triangles, material[kept.face]
            normals = None if kept.normals is None else _or_geometric(kept.normals, points, triangles)
            colors = None if colors is None else colors[kept.face]
            uvs = {name: corners[kept.face] for name, corners in uvs.items()}
            bare = None if bare is None else bare[kept.face]
        if len(triangles) == 0:
            return None
        lamp, light = self._lamp(gprim.site), None
        if lamp is not None:
            light = lamp.light(matrices[0])
            used, material = np.unique(material, return_inverse=True)
            area = 0.5 * float(np.linalg.norm(cross_products(points, triangles), axis=1).sum()) / copies
            lit = lamp.materials([self._table.materials[i] for i in used], area)
            material = np.array([self._table.add(m) for m in lit], dtype=np.int32)[material]
            if not any(max(m.albedo) > 0.0 for m in lit):
                colors = None  # a light that answers with no material reflects no colour either
        # Of the implicit shapes only the plane is double-sided unless it says otherwise; its schema knows.
        double_sided = read.flag(prim.GetAttribute("doubleSided"), self._time)
        tangents = self._tangents(points, triangles, normals, uvs, material)
        return Mesh(
            *(str(prim.GetPath()), points, triangles, material, normals, colors, double_sided, uvs, bare),
            tangents=tangents,
            light=light,
        )

    def _tangents(
        self, points: Floats, triangles: Ints, normals: Floats | None, uvs: Mapping[str, Floats], material: Ints
    ) -> Floats | None:
        """Those of smooth surfaces with normal maps, float32 [m, 3, 3]; None where triangles' own will do."""
        maps = {int(k): self._table.materials[k].normal_texture for k in np.unique(material)}
        names = {k: texture.uv for k, texture in maps.items() if texture is not None and texture.uv in uvs}
        if normals is None or not names:
            return None
        tangents = np.zeros((len(triangles), 3, 3), np.float32)
        for name in dict.fromkeys(names.values()):
            chosen = np.isin(material, [k for k, uv in names.items() if uv == name])
            of_these = triangles[chosen], normals[chosen], uvs[name][chosen]
            tangents[chosen] = smooth_tangents(points, *of_these)
        return tangents

    def _placed(self, shape: TriangleMesh, matrices: Floats, *, shared: bool) -> tuple[Floats, Ints, Floats | None]:
        """Copies of a shape; the same arrays for prototypes of the same geometry, which then share their tree."""
        if not shared:
            return instantiate(shape, matrices)
        key = (id(shape.points), digest(shape.triangles), digest(matrices))
        if key not in self._known:
            self._known[key] = instantiate(shape, matrices)
        return self._known[key]

    def _colors(self, look: Look, given: Floats | None, copies: int) -> Floats | None:
        """Albedo of the corners, float32 [k m, 3, 3], where a material's alone will not do."""
        if given is None or look.bare is None:
            return None if look.colors is None else np.tile(look.colors, (copies, 1, 1))
        given = given.astype(np.float32)[:, None]
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
