"""Gprims to meshes: each shape is read once, gets its materials, and is instanced or copied to all its transforms."""

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdLux

from warp_ir.scene import Bools, Floats, Instances, Ints, Material, Mesh
from warp_ir.scene.instances import areas_of_copies
from warp_ir.usd.geometry.curves import CURVES, read_curves
from warp_ir.usd.geometry.detail import PixelSize, pixels_per_unit
from warp_ir.usd.geometry.displacement import displaced
from warp_ir.usd.geometry.implicit import IMPLICIT, read_implicit
from warp_ir.usd.geometry.instancing import InstanceLevel, nested_colors, nested_transforms
from warp_ir.usd.geometry.mesh import read_mesh, read_tet_mesh
from warp_ir.usd.geometry.patch import read_patch
from warp_ir.usd.geometry.prototypes import (
    MAX_FLATTENED_TRIANGLES,
    InstancedGprim,
    LevelGroup,
    choose_storage,
    digest,
    well_conditioned,
)
from warp_ir.usd.geometry.skinning import Skinning, pose_key
from warp_ir.usd.geometry.spheres import read_spheres
from warp_ir.usd.geometry.tangents import smooth_tangents
from warp_ir.usd.images.cache import ImageCache
from warp_ir.usd.images.shading_value import ShadingValue, SurfaceRef, UVRef
from warp_ir.usd.lights.mesh_light import LIGHT_UV, MeshLightPrim
from warp_ir.usd.linking import LightLinks
from warp_ir.usd.shading.bake import PrimSurface
from warp_ir.usd.shading.binding import PURPOSES
from warp_ir.usd.shading.material_table import TRANSPARENT, MaterialAssignment, MaterialTable
from warp_ir.usd.traverse import MAX_LIGHT_COPIES, DrawnPrim
from warp_ir.usd.values import read
from warp_ir.usd.values.primvar import texture_coordinates
from warp_ir.usd.values.report import Report, Unreadable
from warp_ir.usd.values.triangles import TriangleMesh, cross_products, drop_degenerate, instantiate

ShapeCache = dict[tuple[Sdf.Path, ...], TriangleMesh | None]
"""Shapes by prim and skinning; None: the prim cannot be read or has no triangles."""

_DETAILED = (*CURVES, "NurbsPatch", "Points")
"""Schemas whose shapes depend on how large they are in the picture."""


@dataclass(frozen=True, eq=False)
class Geometry:
    """The geometry of a stage, as a `Scene` takes it."""

    meshes: tuple[Mesh, ...]
    instances: tuple[Instances, ...]
    materials: tuple[Material, ...]


@dataclass(frozen=True, eq=False)
class _Gprim:
    """A gprim that was read: its shape in its own space and its materials."""

    drawn: DrawnPrim
    shape: TriangleMesh
    assignment: MaterialAssignment
    emits: bool
    light: bool = False
    """Whether it is a light (`_mesh_light`)."""


@dataclass(eq=False)
class _Prototype:
    """A prototype that is stored once, while its meshes are built."""

    matrices: Floats
    colors: Floats | None
    invertible: Bools
    """Whether each transform can be inverted precisely enough for an instance; the others become copies."""
    meshes: list[int] = field(default_factory=list)


def build_meshes(
    gprims: Sequence[DrawnPrim],
    time: Usd.TimeCode,
    report: Report,
    levels: int = 0,
    shapes: ShapeCache | None = None,
    images: ImageCache | None = None,
    reflection: str = "diffuse",
    purposes: Sequence[str] = PURPOSES[:2],
    links: LightLinks | None = None,
    times: int = 1,
    pixel: PixelSize | None = None,
) -> Geometry:
    """Meshes of gprims (one per gprim, with all its copies), instanced prototypes, and the materials that they use.

    Args:
        gprims: The gprims with their transforms.
        time: Time code of all values.
        report: Receives warnings and counts.
        levels: Refinement levels of subdivision surfaces.
        shapes: Cache of shapes; new ones are added.
        images: Cache of images; new ones are added.
        reflection: "diffuse", "black" (diffuse without metals) or "all".
        purposes: Purposes of material bindings, in order of preference.
        links: Light links, by which copies of a gprim may differ.
        times: Number of shutter samples for which the gprims are read.
        pixel: The size of a pixel of the picture; None: not known.

    Raises:
        InputError: There are more triangles than can be rendered.
    """
    table = MaterialTable(time, report, images, reflection, purposes, displaces=levels > 0)
    shape_cache = {} if shapes is None else shapes
    builder = _MeshBuilder(time, report, levels, table, shape_cache, links or LightLinks(()), pixel)
    return builder.run(gprims, times)


class _MeshBuilder:
    """Builds the meshes of one time; see `build_meshes`."""

    def __init__(
        self,
        time: Usd.TimeCode,
        report: Report,
        levels: int,
        table: MaterialTable,
        shapes: ShapeCache,
        links: LightLinks,
        pixel: PixelSize | None,
    ) -> None:
        self._time, self._report, self._levels, self._table = time, report, levels, table
        self._links, self._pixel = links, pixel
        self._places: dict[Sdf.Path, list[Floats]] = {}
        self._skinning = Skinning(time, report)
        self._shapes = shapes
        self._plain_gprims: dict[tuple[int, Hashable], _Gprim] = {}
        self._displaced_shapes: dict[tuple[object, ...], TriangleMesh] = {}
        self._gprim_cache: dict[tuple[object, ...], tuple[TriangleMesh, MaterialAssignment, bool]] = {}
        self._placed_cache: dict[tuple[object, ...], tuple[Floats, Ints, Floats | None]] = {}
        self._mesh_lights: dict[Sdf.Path, MeshLightPrim] = {}
        self._colored_levels: dict[tuple[int, Hashable], InstanceLevel] = {}
        self._instance_colored: dict[tuple[int, int], MaterialAssignment] = {}

    def run(self, drawn_prims: Sequence[DrawnPrim], times: int) -> Geometry:
        """Builds all meshes and prototypes."""
        bare = [drawn for drawn in drawn_prims if drawn.draw_mode is None]
        self._table.resolve(
            [drawn.prim for drawn in bare],
            {drawn.prim.GetPath() for drawn in bare if not drawn.has_children},
            {drawn.prim.GetPath() for drawn in bare if "material:binding" not in drawn.authored},
        )
        for drawn in drawn_prims:
            if drawn.prim.GetPrimTypeInfo().GetSchemaTypeName() in _DETAILED or self._table.has_fields(drawn.prim):
                self._places.setdefault(_shared_path(drawn.prim), []).append(drawn.matrices)
        gprims = [gprim for drawn in drawn_prims if (gprim := self._gprim(drawn)) is not None]
        parts = [InstancedGprim(g.drawn.level, len(g.shape.triangles), self._signature(g), g.emits) for g in gprims]
        singles = self._single_meshes(gprims)
        meshes: list[Mesh] = []
        prototypes: dict[int, _Prototype] = {}
        for stored in choose_storage(parts, self._report.source, times):
            gprim, group = gprims[stored.gprim], stored.prototype
            if stored.gprim in singles:
                meshes.append(singles[stored.gprim])
                continue
            matrices_in_level = nested_transforms(level.matrices for level in stored.levels)
            colors = nested_colors((len(level.matrices), level.colors) for level in stored.levels)
            if group is None:
                for copies in self._split_by_light(gprim, matrices_in_level):
                    self._add(
                        meshes, self._mesh(gprim, matrices_in_level[copies], None if colors is None else colors[copies])
                    )
                continue
            if id(group) not in prototypes:
                prototypes[id(group)] = self._prototype(group, gprim)
            prototype = prototypes[id(group)]
            if prototype.invertible.any():
                mesh = self._mesh(gprim, matrices_in_level, colors, shared=True)
                if mesh is not None and (prototype.colors is None or colors is not None):
                    mesh = replace(mesh, bare=None)
                prototype.meshes += self._add(meshes, mesh)
            if not prototype.invertible.all():
                self._add(meshes, self._singular_copies(gprim, prototype, matrices_in_level, colors))
        instances = [
            Instances(
                meshes[prototype.meshes[0]].name,
                tuple(prototype.meshes),
                prototype.matrices[prototype.invertible],
                None if prototype.colors is None else prototype.colors[prototype.invertible].astype(np.float32),
            )
            for prototype in prototypes.values()
            if prototype.meshes
        ]
        used_meshes, materials = self._without_unused_materials(meshes)
        return Geometry(used_meshes, tuple(instances), materials)

    def _single_meshes(self, gprims: Sequence[_Gprim]) -> dict[int, Mesh]:
        """Meshes of the gprims that are no lights and in no instance, by index; equal shapes are placed at once."""
        by_shape: dict[int, list[int]] = {}
        for k, gprim in enumerate(gprims):
            if gprim.drawn.level.parent is None and not gprim.light:
                by_shape.setdefault(id(gprim.shape), []).append(k)
        meshes: dict[int, Mesh] = {}
        for indices in by_shape.values():
            shape = gprims[indices[0]].shape
            matrices = np.stack([gprims[k].drawn.level_from_prim for k in indices])
            determinants = np.linalg.det(matrices[:, :3, :3])
            regular = np.isfinite(matrices).all(axis=(1, 2)) & (determinants > 0.0)
            chosen = np.flatnonzero(regular)
            if len(chosen) == 0:
                continue
            points, _, normals = instantiate(shape, matrices[chosen])
            rows = points.reshape(len(chosen), -1, 3)
            normal_rows = None if normals is None else normals.reshape(len(chosen), -1, 3, 3)
            for row, k in enumerate(chosen.tolist()):
                drawn, assignment = gprims[indices[k]].drawn, gprims[indices[k]].assignment
                own_normals = None if normal_rows is None else normal_rows[row]
                tangents = None
                if assignment.uvs:
                    placed = rows[row], shape.triangles, own_normals
                    tangents = self._tangents(*placed, assignment.uvs, assignment.material)
                meshes[indices[k]] = Mesh(
                    str(drawn.prim.GetPath()),
                    rows[row],
                    shape.triangles,
                    assignment.material,
                    own_normals,
                    assignment.colors,
                    self._double_sided(drawn),
                    assignment.uvs,
                    tangents=tangents,
                )
        return meshes

    @staticmethod
    def _add(meshes: list[Mesh], mesh: Mesh | None) -> list[int]:
        """Appends a mesh unless it is None; returns the list of its index."""
        if mesh is None:
            return []
        meshes.append(mesh)
        return [len(meshes) - 1]

    def _gprim(self, drawn: DrawnPrim) -> _Gprim | None:
        """A gprim without its fully transparent triangles; equal shapes with equal materials are stored once."""
        full = self._shape(drawn) if drawn.draw_mode is None else drawn.draw_mode.shape
        if full is None:
            return None
        mesh_light = self._mesh_light(drawn)
        is_plain = mesh_light is None and drawn.level.parent is None and drawn.draw_mode is None
        plain = self._table.key(drawn.prim, drawn.authored) if is_plain else None
        if plain is not None and (id(full), plain) in self._plain_gprims:
            alike = self._plain_gprims[id(full), plain]
            return _Gprim(drawn, alike.shape, alike.assignment, alike.emits)
        if plain is not None and (colored := self._table.assign_color(plain, full)) is not None:
            gprim = self._plain_gprims[id(full), plain] = _Gprim(drawn, full, colored, False)
            return gprim
        if drawn.draw_mode is None:
            density = math.inf
            if self._table.has_fields(drawn.prim):
                places = np.concatenate(self._places[_shared_path(drawn.prim)])
                density = float(pixels_per_unit(self._pixel, full.points, places).max())
            assignment = self._table.assign(drawn.prim, full, density)
            full = self._displaced(drawn.prim, full, assignment)
        else:
            assignment = self._table.assign_draw_mode(drawn.prim, drawn.draw_mode)
        if mesh_light is not None and mesh_light.textured and LIGHT_UV not in assignment.uvs:
            corners = texture_coordinates(drawn.prim, full, LIGHT_UV, self._time, self._report)
            assignment = (
                assignment if corners is None else replace(assignment, uvs={**assignment.uvs, LIGHT_UV: corners})
            )
        uvs = tuple((name, digest(corners)) for name, corners in sorted(assignment.uvs.items()))
        key = (id(full), digest(assignment.material), digest(assignment.colors), digest(assignment.bare), uvs)
        if key not in self._gprim_cache:
            opaque, shape = assignment.material != TRANSPARENT, full
            if not opaque.all():
                shape, assignment = full.keep(opaque), assignment.keep(opaque)
            emission = [max(self._table.materials[k].emission) for k in np.unique(assignment.material)]
            self._gprim_cache[key] = (shape, assignment, max(emission, default=0.0) > 0.0)
        shape, assignment, emits = self._gprim_cache[key]
        dropped = len(full.triangles) - len(shape.triangles)
        self._report.stats["triangles_absent"] += dropped * drawn.level.instance_count
        if len(shape.triangles) == 0:
            return None
        drawn, assignment = self._with_instance_primvars(drawn, assignment)
        is_light = mesh_light is not None
        gprim = _Gprim(drawn, shape, assignment, emits or is_light, is_light)
        if plain is not None and shape is full:
            self._plain_gprims[id(full), plain] = gprim
        return gprim

    def _displaced(self, prim: Usd.Prim, shape: TriangleMesh, assignment: MaterialAssignment) -> TriangleMesh:
        """The shape displaced as its materials say, cached; the same shape if they do not."""
        used = [k for k in np.unique(assignment.material).tolist() if k in self._table.displacements]
        if not used:
            return shape
        if shape.refiner is None or not prim.IsA(UsdGeom.Mesh):
            self._report.warn(prim.GetPath(), "only subdivision surfaces are displaced ({n} in all)")
            return shape
        key = id(shape), digest(assignment.material), _shared_path(prim)
        if key not in self._displaced_shapes:
            amounts = np.zeros(shape.triangles.shape)
            for k in used:
                value, chosen = self._table.displacements[k], assignment.material == k
                surface = PrimSurface(prim, shape, self._time, self._report)
                refs = value.reads if value.mapping is None else (UVRef(value.mapping.uv),)
                corners = {ref: values for ref in refs if (values := surface.corners(ref)) is not None}
                at = {ref: values if values.ndim == 1 else values[chosen] for ref, values in corners.items()}
                amounts[chosen] = np.broadcast_to(value.evaluate(at), (*amounts[chosen].shape, 1))[..., 0]
            self._displaced_shapes[key] = displaced(shape, amounts)
        return self._displaced_shapes[key]

    def _with_instance_primvars(
        self, drawn: DrawnPrim, assignment: MaterialAssignment
    ) -> tuple[DrawnPrim, MaterialAssignment]:
        """Evaluates materials that read primvars which point instancers give to each instance.

        The colours become those of the instancing levels; emission and opacity are not evaluated per instance.
        """
        instance_primvars = [level.primvars for level in drawn.level.chain() if level.primvars is not None]
        for name in sorted(
            name for name in assignment.unread_primvars if any(primvars.has(name) for primvars in instance_primvars)
        ):
            what = f"emission and opacity do not vary per instance: the primvar {name} takes its fallback"
            self._report.warn(drawn.prim.GetPath(), what)
        levels = [self._with_primvar_colors(drawn.level, albedo) for _, albedo in assignment.primvar_albedos]
        colored = [k for k, level in enumerate(levels) if any(outer.colors is not None for outer in level.chain())]
        if not colored:
            return drawn, assignment
        if len(colored) > 1 or assignment.bare is not None:
            path = drawn.prim.GetPath()
            self._report.warn(path, "several of its materials read primvars of instances: only one is coloured by them")
        key = (id(assignment), colored[0])
        if key not in self._instance_colored:
            self._instance_colored[key] = replace(assignment, bare=assignment.primvar_albedos[colored[0]][0])
        return replace(drawn, level=levels[colored[0]]), self._instance_colored[key]

    def _with_primvar_colors(self, level: InstanceLevel, albedo: ShadingValue) -> InstanceLevel:
        """The level, and all levels around it, with the colours that an albedo has for each of their instances."""
        if level.parent is None:
            return level
        key = (id(level), albedo.key)
        if key not in self._colored_levels:
            colors: Floats | None = None
            if level.primvars is not None:
                by_primvar: dict[SurfaceRef, Floats | None] = {
                    primvar: level.primvars.read(primvar.name, primvar.channels, self._report)
                    for primvar in albedo.primvars
                }
                values = {primvar: rows for primvar, rows in by_primvar.items() if rows is not None}
                if values:
                    colors = np.broadcast_to(albedo.evaluate(values), (len(level.matrices), 3)).clip(0.0, 1.0)
            parent = self._with_primvar_colors(level.parent, albedo)
            self._colored_levels[key] = replace(level, key=(level.key, albedo.key), parent=parent, colors=colors)
        return self._colored_levels[key]

    def _mesh_light(self, drawn: DrawnPrim) -> MeshLightPrim | None:
        """The light that a gprim emits as: by LightAPI, or by a GeometryLight; None: it is no light."""
        prim = drawn.prim if drawn.prim.HasAPI(UsdLux.LightAPI) else drawn.geometry_light
        if prim is None:
            return None
        path = drawn.prim.GetPath()
        if path not in self._mesh_lights:
            self._mesh_lights[path] = MeshLightPrim(prim, drawn.prim, self._time, self._report)
        return self._mesh_lights[path]

    def _split_by_light(self, gprim: _Gprim, matrices_in_level: Floats) -> list[slice]:
        """Slices of transforms that one mesh can hold: all, unless the instances differ as lights."""
        mesh_light = self._mesh_light(gprim.drawn)
        if mesh_light is None or len(matrices_in_level) == 1:
            return [slice(None)]
        areas = areas_of_copies(
            gprim.shape.points, gprim.shape.triangles, matrices_in_level @ gprim.drawn.level_from_prim
        )
        if not mesh_light.varies_by_instance(areas):
            return [slice(None)]
        if len(matrices_in_level) > MAX_LIGHT_COPIES:
            self._report.warn(
                gprim.drawn.prim.GetPath(),
                f"{len(matrices_in_level)} instances of a light exceed the limit: it is skipped",
            )
            return []
        return [slice(k, k + 1) for k in range(len(matrices_in_level))]

    def _signature(self, gprim: _Gprim) -> object:
        """Equal for gprims of a prototype that look equal and are lit equally; cached objects are compared by id."""
        if gprim.drawn.level.parent is None:
            return None  # the world is no prototype
        links = self._links.memberships(gprim.drawn.prim.GetPath())
        return id(gprim.shape), id(gprim.assignment), digest(gprim.drawn.level_from_prim), links

    def _prototype(self, group: LevelGroup, gprim: _Gprim) -> _Prototype:
        """A prototype with the finite transforms of its instances."""
        matrices = group.world_matrices()
        finite = np.isfinite(matrices).all(axis=(1, 2))
        if not finite.all():
            self._report.warn(
                gprim.drawn.prim.GetPath(), "{n} instances with infinite transforms skipped", int((~finite).sum())
            )
        colors = group.world_colors()
        matrices, colors = matrices[finite], None if colors is None else colors[finite]
        return _Prototype(matrices, colors, well_conditioned(matrices))

    def _singular_copies(
        self, gprim: _Gprim, prototype: _Prototype, matrices_in_level: Floats, colors: Floats | None
    ) -> Mesh | None:
        """Copies of the instances whose transforms are singular, or nearly, in the world."""
        matrices = prototype.matrices[~prototype.invertible]
        if len(matrices) * len(matrices_in_level) * len(gprim.shape.triangles) > MAX_FLATTENED_TRIANGLES:
            path = gprim.drawn.prim.GetPath()
            self._report.warn(path, "{n} instances with singular transforms skipped", len(matrices))
            return None
        outer_colors = None if prototype.colors is None else prototype.colors[~prototype.invertible]
        copy_colors = nested_colors([(len(matrices), outer_colors), (len(matrices_in_level), colors)])
        return self._mesh(gprim, nested_transforms([matrices, matrices_in_level]), copy_colors)

    def _shape(self, drawn: DrawnPrim) -> TriangleMesh | None:
        """The prim's triangles in its own space, cached; instances of a native prototype share them."""
        prim = drawn.prim
        key = (_shared_path(prim), *pose_key(prim))
        if key not in self._shapes:
            try:
                shape = self._read(drawn)
            except Unreadable as trouble:
                self._report.warn(prim.GetPath(), f"{trouble}; the prim is skipped")
                shape = None
            if shape is not None and shape.degenerate_faces:
                self._report.warn(prim.GetPath(), "{n} degenerate faces skipped", shape.degenerate_faces)
                self._report.stats["degenerate_faces"] += shape.degenerate_faces
            self._shapes[key] = shape if shape is not None and len(shape.triangles) else None
        return self._shapes[key]

    def _read(self, drawn: DrawnPrim) -> TriangleMesh | None:
        """The shape of a gprim by its schema."""
        prim = drawn.prim
        schema = prim.GetPrimTypeInfo().GetSchemaTypeName()
        if schema in IMPLICIT:
            return read_implicit(prim, schema, self._time, drawn.authored)
        if schema == "TetMesh":
            return read_tet_mesh(prim, self._time, self._report)
        if schema in _DETAILED:
            places = np.concatenate(self._places[_shared_path(prim)])
            if schema == "NurbsPatch":
                return read_patch(prim, self._time, self._report, places, self._pixel)
            if schema == "Points":
                return read_spheres(prim, self._time, self._report, places, self._pixel)
            return read_curves(prim, schema, self._time, self._report, places, self._pixel, self._skinning)
        return read_mesh(prim, self._time, self._report, self._levels, self._skinning)

    def _mesh(
        self, gprim: _Gprim, matrices_in_level: Floats, instance_colors: Floats | None, *, shared: bool = False
    ) -> Mesh | None:
        """The copies of a gprim as one mesh; None if no triangle is left.

        Args:
            gprim: The gprim.
            matrices_in_level: Transforms of its level, [k, 4, 4].
            instance_colors: Colours of the copies [k, 3], or None.
            shared: Whether the mesh belongs to a prototype and marks the triangles that instances may colour.
        """
        prim, shape, assignment = gprim.drawn.prim, gprim.shape, gprim.assignment
        matrices = matrices_in_level @ gprim.drawn.level_from_prim
        finite = np.isfinite(matrices).all(axis=(1, 2))
        if not finite.all():
            self._report.warn(prim.GetPath(), "{n} copies with infinite transforms skipped", int((~finite).sum()))
            matrices, instance_colors = matrices[finite], None if instance_colors is None else instance_colors[finite]
            if not finite.any():
                return None
        copies = len(matrices)
        points, triangles, normals = self._placed(shape, matrices, shared=shared)
        material, colors = np.tile(assignment.material, copies), self._colors(assignment, instance_colors, copies)
        uvs = {name: np.tile(corners, (copies, 1, 1)) for name, corners in assignment.uvs.items()}
        mirrored = np.repeat(np.linalg.det(matrices[:, :3, :3]) < 0.0, len(shape.triangles))
        if mirrored.any():  # `instantiate` reverses their winding
            for corners in (*uvs.values(), *([] if colors is None else [colors])):
                corners[mirrored] = corners[mirrored][:, ::-1]
        bare = np.tile(assignment.bare, copies) if shared and assignment.bare is not None else None
        if (np.linalg.det(matrices[:, :3, :3]) == 0.0).any():
            # A copy with a singular transform keeps the triangles that still have an area.
            order = np.arange(len(triangles))
            remaining = drop_degenerate(TriangleMesh(points, triangles, order, triangles, normals))
            triangles, material = remaining.triangles, material[remaining.face]
            normals = (
                None
                if remaining.normals is None
                else _fill_with_geometric_normals(remaining.normals, points, triangles)
            )
            colors = None if colors is None else colors[remaining.face]
            uvs = {name: corners[remaining.face] for name, corners in uvs.items()}
            bare = None if bare is None else bare[remaining.face]
        if len(triangles) == 0:
            return None
        mesh_light, light = self._mesh_light(gprim.drawn), None
        if mesh_light is not None:
            light = mesh_light.light(matrices[0])
            used, material = np.unique(material, return_inverse=True)
            area = 0.5 * float(np.linalg.norm(cross_products(points, triangles), axis=1).sum()) / copies
            light_materials = mesh_light.materials([self._table.materials[i] for i in used], area)
            material = np.array([self._table.add(m) for m in light_materials], dtype=np.int32)[material]
            if not any(max(m.albedo) > 0.0 for m in light_materials):
                colors = None  # a light without material response reflects nothing, whatever its primvars
        double_sided = self._double_sided(gprim.drawn)
        tangents = self._tangents(points, triangles, normals, uvs, material)
        return Mesh(
            *(str(prim.GetPath()), points, triangles, material, normals, colors, double_sided, uvs, bare),
            tangents=tangents,
            light=light,
        )

    def _double_sided(self, drawn: DrawnPrim) -> bool:
        """Whether an emissive gprim emits on both sides; the schema's fallback is true for Plane alone."""
        if "doubleSided" in drawn.authored or drawn.prim.GetTypeName() == "Plane":
            return read.flag(drawn.prim.GetAttribute("doubleSided"), self._time)
        return False

    def _tangents(
        self, points: Floats, triangles: Ints, normals: Floats | None, uvs: Mapping[str, Floats], material: Ints
    ) -> Floats | None:
        """Tangents of smooth surfaces with normal maps, float32 [m, 3, 3]; None where the triangles' own suffice."""
        maps = {int(k): self._table.materials[k].normal_texture for k in np.unique(material)}
        names = {k: texture.uv for k, texture in maps.items() if texture is not None and texture.uv in uvs}
        if normals is None or not names:
            return None
        tangents = np.zeros((len(triangles), 3, 3), np.float32)
        for name in dict.fromkeys(names.values()):
            chosen = np.isin(material, [k for k, uv in names.items() if uv == name])
            corners_of_map = triangles[chosen], normals[chosen], uvs[name][chosen]
            tangents[chosen] = smooth_tangents(points, *corners_of_map)
        return tangents

    def _placed(self, shape: TriangleMesh, matrices: Floats, *, shared: bool) -> tuple[Floats, Ints, Floats | None]:
        """Copies of a shape; prototypes of equal geometry share the arrays, and thereby their BVH."""
        if not shared:
            return instantiate(shape, matrices)
        key = (id(shape.points), digest(shape.triangles), digest(matrices))
        if key not in self._placed_cache:
            self._placed_cache[key] = instantiate(shape, matrices)
        return self._placed_cache[key]

    def _colors(self, assignment: MaterialAssignment, instance_colors: Floats | None, copies: int) -> Floats | None:
        """Albedo of the corners, float32 [k m, 3, 3]; None where that of the materials suffices."""
        if instance_colors is None or assignment.bare is None:
            return None if assignment.colors is None else np.tile(assignment.colors, (copies, 1, 1))
        instance_colors = instance_colors.astype(np.float32)[:, None]
        per_triangle = np.where(
            assignment.bare[None, :, None], instance_colors, self._table.albedo(assignment.material)[None]
        )
        return np.repeat(per_triangle.reshape(-1, 1, 3), 3, axis=1)

    def _without_unused_materials(self, meshes: Sequence[Mesh]) -> tuple[tuple[Mesh, ...], tuple[Material, ...]]:
        """The meshes with a material table without unused entries."""
        table = self._table.materials
        used = np.zeros(len(table), dtype=bool)
        for mesh in meshes:
            used[mesh.material] = True
        self._report.stats["unused_materials"] = int((~used).sum())
        if not used.any():
            return tuple(meshes), (Material(),)
        if used.all():
            return tuple(meshes), tuple(table)
        index = (np.cumsum(used) - 1).astype(np.int32)
        remapped = tuple(replace(mesh, material=index[mesh.material]) for mesh in meshes)
        return remapped, tuple(m for m, is_used in zip(table, used, strict=True) if is_used)


def _shared_path(prim: Usd.Prim) -> Sdf.Path:
    """The path by which a prim's shape is cached: that in the prototype for prims of native instances."""
    return (prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim).GetPath()


def _fill_with_geometric_normals(normals: Floats, points: Floats, triangles: Ints) -> Floats:
    """The normals, float32 [m, 3, 3], with the geometric normal where a singular transform left none."""
    geometric = cross_products(points, triangles)
    geometric /= np.linalg.norm(geometric, axis=1, keepdims=True)
    usable = np.linalg.norm(normals, axis=-1, keepdims=True) > 0.5
    return np.where(usable, normals, geometric[:, None].astype(np.float32))
