"""The material of each triangle, from bindings, GeomSubsets and displayColor, in one table without duplicates."""

import math
from collections.abc import Container, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade, Vt

from warp_ir.scene import MAX_RADIANCE, Bools, Color, Floats, Ints, Material, Wrap
from warp_ir.usd.geometry.draw_mode import DrawMode
from warp_ir.usd.images.cache import ImageCache
from warp_ir.usd.images.shading_value import PointRef, PrimvarRef, ShadingValue, SurfaceRef, UVMapping
from warp_ir.usd.shading.bake import FACE_TEXELS, FieldOnPrim, PrimSurface, patch_size, texels
from warp_ir.usd.shading.binding import PURPOSES, bound_materials, purposes_to_try
from warp_ir.usd.shading.surface_shader import EvaluatedMaterial, read_displacement, read_material, with_baked
from warp_ir.usd.values import primvar, read
from warp_ir.usd.values.report import Report, Unreadable
from warp_ir.usd.values.triangles import TriangleMesh

TRANSPARENT = -1
"""Instead of a material index: opacity is 0, so the triangle is dropped."""
UNBOUND = -2
"""Instead of a material index: no readable material is bound, so displayColor applies."""
CARD_UV = "warp_ir:card"
"""Name of the texture coordinates of models that are drawn as cards."""
_CARD_CUTOFF = 0.1
"""Opacity below which a card is absent, as in usdview."""
_TETRAHEDRON = "tetrahedron"
"""Element type of GeomSubsets of a TetMesh's tetrahedra."""
_MAX_FACE_TEXELS = 2**26
"""Texels of all images with a patch for each triangle; a prim may have an eighth of those that are left."""
_MAX_VARIANTS = 2**16
"""Maximum number of materials that the primvars of one prim create; beyond it, the mean is used."""


@dataclass(frozen=True, eq=False)
class MaterialAssignment:
    """Materials, colours and texture coordinates of a prim's triangles."""

    material: Ints
    """int32 [m], indices into the material table, or TRANSPARENT."""
    colors: Floats | None = None
    """float32 [m, 3, 3], albedo of the corners; None: that of the materials suffices."""
    bare: Bools | None = None
    """bool [m], triangles with neither material nor colour, which an instancer may colour; None: there are none."""
    uvs: Mapping[str, Floats] = field(default_factory=dict)
    """float32 [m, 3, 2] for each set of texture coordinates that the materials use."""
    primvar_albedos: tuple[tuple[Bools, ShadingValue], ...] = ()
    """Albedos that read primvars which the prim lacks and an instancer may provide, with their triangles, bool [m]."""
    unread_primvars: frozenset[str] = frozenset()
    """Names of such primvars that emission or opacity read; they are not evaluated per instance."""

    def keep(self, mask: Bools) -> "MaterialAssignment":
        """The assignment of the triangles that a mask [m] selects."""
        colors = None if self.colors is None else self.colors[mask]
        uvs = {name: corners[mask] for name, corners in self.uvs.items()}
        primvar_albedos = tuple((chosen[mask], albedo) for chosen, albedo in self.primvar_albedos)
        return MaterialAssignment(
            self.material[mask],
            colors,
            None if self.bare is None else self.bare[mask],
            uvs,
            primvar_albedos,
            self.unread_primvars,
        )


class MaterialTable:
    """The scene's materials, each read once.

    Args:
        time: Time code of all values.
        report: Receives warnings.
        images: Cache of images; None: a new one.
        reflection: "diffuse", "black" (diffuse without metals) or "all".
        purposes: Purposes of material bindings, in order of preference.
        displaces: Whether displacements are read.
    """

    def __init__(
        self,
        time: Usd.TimeCode,
        report: Report,
        images: ImageCache | None = None,
        reflection: str = "diffuse",
        purposes: Sequence[str] = PURPOSES[:2],
        *,
        displaces: bool = False,
    ) -> None:
        self._displaces = displaces
        self.displacements: dict[int, ShadingValue] = {}
        """Displacements of materials by their index."""
        self.materials: list[Material] = []
        self._purposes = purposes
        self._time, self._report = time, report
        self._images, self._reflection = images or ImageCache(report), reflection
        self._images.report = report
        self._fields: dict[int, EvaluatedMaterial] = {}
        self._baked_images: dict[Hashable, ShadingValue] = {}
        self._baked_prims: dict[Hashable, tuple[dict[int, EvaluatedMaterial], Floats | None]] = {}
        self._face_texels_left = _MAX_FACE_TEXELS
        self._indices: dict[Material, int] = {}
        self._index_by_path: dict[Sdf.Path, int] = {}
        self._bound_index: dict[Sdf.Path, int] = {}
        self._with_subsets: set[Sdf.Path] = set()
        self._color_spaces: dict[Sdf.Path, str] = {}
        self._plain_colors: dict[tuple[bytes, str], Color | None] = {}
        self._inherited: dict[tuple[Sdf.Path, str], Usd.Attribute | None] = {}
        self._dangling: dict[Sdf.Path, Sdf.Path | None] = {}

    def add(self, material: Material) -> int:
        """Index of a material; equal materials share it."""
        if material not in self._indices:
            self._indices[material] = len(self.materials)
            self.materials.append(material)
        return self._indices[material]

    def _add_with_fields(self, evaluated: EvaluatedMaterial) -> int:
        """Index of a material that each prim evaluates for itself; no other material shares it."""
        self.materials.append(evaluated.material)
        self._fields[len(self.materials) - 1] = evaluated
        return len(self.materials) - 1

    def resolve(
        self, prims: Sequence[Usd.Prim], childless: Container[Sdf.Path] = (), unbound: Container[Sdf.Path] = ()
    ) -> None:
        """Resolve the materials bound to prims and to their GeomSubsets in one call, since USD shares the work.

        Args:
            prims: The prims.
            childless: Paths of those without children.
            unbound: Paths of those without an opinion on `material:binding`.
        """
        gprims = []
        for prim in prims:
            gprims.append(prim)
            if prim.GetPath() not in childless and (subsets := material_subsets(prim)):
                gprims += subsets
                self._with_subsets.add(prim.GetPath())
        for prim, bound in zip(gprims, bound_materials(gprims, purposes_to_try(self._purposes)), strict=True):
            if bound is not None:
                material, purpose = bound
                if purpose and purpose not in self._purposes:
                    self._report.warn(prim.GetPath(), f"only a material of purpose '{purpose}' is bound; it is used")
                self._bound_index[prim.GetPath()] = self._index_of(material)
            elif (target := self._dangling_target(prim.GetParent() if prim.GetPath() in unbound else prim)) is not None:
                self._report.warn(prim.GetPath(), f"the bound material {target} does not exist")

    def key(self, prim: Usd.Prim, authored: Container[str]) -> Hashable:
        """Equal for prims to whose triangles `assign` gives the same without a warning; None: only `assign` tells.

        It is quick to read: most prims of a large stage have one material, or one displayColor.
        """
        path = prim.GetPath()
        if path in self._with_subsets:
            return None
        index = self._bound_index.get(path, UNBOUND)
        if index != UNBOUND:
            plain = index >= 0 and index not in self._fields and not self.materials[index].textures
            return index if plain else None
        if self._authored(prim, "primvars:displayOpacity", authored) is not None:
            return None
        color = self._authored(prim, "primvars:displayColor", authored)
        if color is None:
            return UNBOUND
        values = read.raw(color, self._time)
        if not isinstance(values, Vt.Vec3fArray) or len(values) != 1:
            return None
        key = bytes(memoryview(values)), self._color_space(color)
        if key not in self._plain_colors:
            self._plain_colors[key] = self._constant_color(color, values)
        indexed = "primvars:displayColor:indices" in authored or color.GetPrim() != prim
        return None if indexed or self._plain_colors[key] is None else key

    @staticmethod
    def _constant_color(attribute: Usd.Attribute, values: Vt.Vec3fArray) -> Color | None:
        """One displayColor in linear Rec. 709; None: it is not constant, in [0, 1], and of a known colour space."""
        if UsdGeom.Primvar(attribute).GetInterpolation() != UsdGeom.Tokens.constant:
            return None
        try:
            rgb: Floats = np.asarray(values).astype(np.float64)
            if read.is_color(attribute):
                rgb = read.to_linear_rec709(attribute, rgb)
        except Unreadable:
            return None
        red, green, blue = rgb[0].tolist()
        return (red, green, blue) if all(0.0 <= x <= 1.0 for x in (red, green, blue)) else None

    def assign_color(self, key: Hashable, shape: TriangleMesh) -> MaterialAssignment | None:
        """What `assign` gives prims whose `key` is that of one displayColor; None: it is no such key."""
        color = self._plain_colors.get(key) if isinstance(key, tuple) else None
        if color is None:
            return None
        index = self.add(Material("displayColor", color))
        return MaterialAssignment(np.full(len(shape.triangles), index, dtype=np.int32))

    def _authored(self, prim: Usd.Prim, name: str, authored: Container[str] | None = None) -> Usd.Attribute | None:
        """The attribute of a prim or, cached, of its nearest ancestor that has a value for it; None: there is none."""
        if authored is None or name in authored:
            attribute = prim.GetAttribute(name)
            if attribute and attribute.HasAuthoredValue():
                return attribute
        parent = prim.GetParent()
        if parent.IsPseudoRoot():
            return None
        key = parent.GetPath(), name
        if key not in self._inherited:
            self._inherited[key] = self._authored(parent, name)
        return self._inherited[key]

    def _color_space(self, attribute: Usd.Attribute) -> str:
        """`read.color_space_name`, cached by the attribute's parent."""
        prim = attribute.GetPrim()
        if attribute.HasColorSpace() or prim.HasAPI(Usd.ColorSpaceAPI):
            return read.color_space_name(attribute)
        parent = prim.GetParent().GetPath()
        if parent not in self._color_spaces:
            self._color_spaces[parent] = read.color_space_name(attribute)
        return self._color_spaces[parent]

    def _dangling_target(self, prim: Usd.Prim) -> Sdf.Path | None:
        """The target of the nearest direct binding of a prim for which no material was resolved; None: there is none.

        Cached by prim, since prims share their ancestors.
        """
        chain: list[Sdf.Path] = []
        target: Sdf.Path | None = None
        while prim and not prim.IsPseudoRoot():
            path = prim.GetPath()
            if path in self._dangling:
                target = self._dangling[path]
                break
            chain.append(path)
            binding = prim.GetRelationship("material:binding")
            if binding and (targets := binding.GetTargets()):
                target = targets[0]
                break
            prim = prim.GetParent()
        self._dangling.update(dict.fromkeys(chain, target))
        return target

    def has_fields(self, prim: Usd.Prim) -> bool:
        """Whether materials of a prim may have to be evaluated for it, as finely as the picture shows it."""
        path = prim.GetPath()
        return bool(self._fields) and (path in self._with_subsets or self._bound_index.get(path) in self._fields)

    def assign(self, prim: Usd.Prim, shape: TriangleMesh, density: float = math.inf) -> MaterialAssignment:
        """The materials and colours of a prim's triangles.

        Args:
            prim: The prim, which must have been passed to `resolve`.
            shape: Its triangles.
            density: Pixels of the picture per unit of its space.
        """
        index = np.full(len(shape.triangles), self._bound_index.get(prim.GetPath(), UNBOUND), dtype=np.int32)
        for faces, bound in self._subsets(prim, shape):
            index[faces[shape.face]] = bound
        fields = {int(k): self._fields[k] for k in np.unique(index) if k in self._fields}
        baked, face_texels = self._baked_for(prim, shape, fields, density) if fields else ({}, None)
        assignment = self._with_primvar_values(prim, shape, index, baked)
        uvs = self._uvs(prim, shape, index)
        return replace(assignment, uvs=uvs if face_texels is None else {**uvs, FACE_TEXELS: face_texels})

    def assign_draw_mode(self, prim: Usd.Prim, mode: DrawMode) -> MaterialAssignment:
        """The colours, or the textures of cards with their opacity, of a model that is drawn as its draw mode."""
        indices = []
        for color, attribute in zip(mode.colors, mode.textures, strict=True):
            material = Material(str(prim.GetPath()), color)
            try:
                material = material if attribute is None else self._card(material, attribute)
            except Unreadable as trouble:
                self._report.warn(prim.GetPath(), f"{trouble}; the card is of one colour")
            indices.append(self.add(material))
        return MaterialAssignment(np.array(indices, np.int32)[mode.shape.face], uvs={CARD_UV: mode.uvs})

    def _card(self, material: Material, attribute: Usd.Attribute) -> Material:
        """A card's material with the image that an attribute names, absent where it is transparent."""
        mapping = UVMapping(CARD_UV, wrap=(Wrap.CLAMP, Wrap.CLAMP))
        textures = []
        for channels in ([0, 1, 2], [3]):
            _, pixels, key, _ = self._images.look_up(
                attribute,
                self._time,
                "auto",
                np.zeros(4),
                channels,
                lambda what: self._report.warn(material.name, what),
            )
            value = ShadingValue(pixels, np.zeros(len(channels)), mapping, (key, tuple(channels)), attribute.GetName())
            textures.append(self._images.texture(value))
        image, alpha = textures
        material = replace(material, albedo=image.mean, albedo_texture=image)
        if alpha.pixels.min() >= 1.0:
            return material
        return replace(material, opacity=alpha.mean[0], cutoff=_CARD_CUTOFF, opacity_texture=alpha)

    def _baked_for(
        self, prim: Usd.Prim, shape: TriangleMesh, fields: Mapping[int, EvaluatedMaterial], density: float
    ) -> tuple[dict[int, EvaluatedMaterial], Floats | None]:
        """`_baked`, cached for the instances of a prim unless it reads what they may inherit."""
        reads = {ref for evaluated in fields.values() for value in evaluated.fields.values() for ref in value.reads}
        if any(isinstance(ref, PrimvarRef) or ref == PointRef("transform") for ref in reads):
            return self._baked(prim, shape, fields, density)
        path = (prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim).GetPath()
        key = (path, id(shape), tuple(fields))
        if key not in self._baked_prims:
            self._baked_prims[key] = self._baked(prim, shape, fields, density)
        return self._baked_prims[key]

    def _baked(
        self, prim: Usd.Prim, shape: TriangleMesh, fields: Mapping[int, EvaluatedMaterial], density: float
    ) -> tuple[dict[int, EvaluatedMaterial], Floats | None]:
        """Materials whose fields that read more than primvars are textures of this prim, by index.

        Returns:
            The materials, and the texture coordinates `FACE_TEXELS` if any uses them, float32 [m, 3, 2].
        """
        surface = PrimSurface(prim, shape, self._time, self._report)
        found = {
            (k, what): FieldOnPrim(value, surface)
            for k, evaluated in fields.items()
            for what, value in _fields_to_bake(evaluated).items()
        }
        for k, what in [key for key, value in found.items() if key[1] == "normal" and not value.over_uv]:
            self._report.warn(self.materials[k].name, "a normal map that depends on more than one uv set is left out")
            del found[k, what]
        on_faces = [value.field for value in found.values() if not value.over_uv]
        size = patch_size(on_faces, surface, density, self._face_texels_left // 8) if on_faces else 0
        self._face_texels_left -= texels(len(shape.triangles), size) * len(on_faces)
        face_texels: Floats | None = None
        baked = {k: replace(evaluated, normal=None) for k, evaluated in fields.items()}
        for (k, what), value in found.items():
            result = value.bake(size, self._baked_images)
            face_texels = face_texels if result.uvs is None else result.uvs
            baked[k] = with_baked(baked[k], what, result.value, self._images)
        return baked, face_texels

    def _with_primvar_values(
        self, prim: Usd.Prim, shape: TriangleMesh, index: Ints, evaluated: Mapping[int, EvaluatedMaterial]
    ) -> MaterialAssignment:
        """Applies displayColor to unbound triangles, and their own values to materials that have fields."""
        bare = index == UNBOUND
        if not bare.any() and not evaluated:
            return MaterialAssignment(index)
        colors: Floats | None = None
        lacking: list[tuple[Bools, ShadingValue]] = []
        unread_primvars = frozenset(
            primvar_read.name
            for surface in evaluated.values()
            for value in (surface.emission, surface.opacity)
            if value is not None
            for primvar_read in value.primvars
            if not UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(primvar_read.name)
        )
        for k, surface in evaluated.items():
            chosen = index == k
            material = surface.material
            color = self._from_primvars(prim, shape, surface.albedo, "albedo", 1.0)
            if color is None and surface.albedo is not None and material.albedo_texture is None:
                lacking.append((chosen, surface.albedo))
            if color is not None and color.ndim == 1:
                red, green, blue = color.tolist()
                material = replace(material, albedo=(red, green, blue))
            index[chosen] = self._primvar_variants(prim, shape, surface, material)[chosen]
            if k in self.displacements:
                self.displacements.update(dict.fromkeys(np.unique(index[chosen]).tolist(), self.displacements[k]))
            if color is not None and color.ndim > 1:
                colors = self.albedo(index)[:, None].repeat(3, axis=1) if colors is None else colors
                colors[chosen] = color[chosen]
        if not bare.any():
            return MaterialAssignment(index, colors, primvar_albedos=tuple(lacking), unread_primvars=unread_primvars)
        assigned = replace(
            self._without_material(prim, shape, index, bare),
            primvar_albedos=tuple(lacking),
            unread_primvars=unread_primvars,
        )
        if colors is None:
            return assigned
        chosen = bare if assigned.colors is not None else np.zeros_like(bare)
        colors[bare] = self.albedo(assigned.material)[bare, None]
        if assigned.colors is not None:
            colors = np.where(chosen[:, None, None], assigned.colors, colors)
        return replace(assigned, colors=colors)

    def _primvar_variants(
        self, prim: Usd.Prim, shape: TriangleMesh, surface: EvaluatedMaterial, material: Material
    ) -> Ints:
        """Variants of a material, one per distinct emission and opacity of the triangles; int32 [m]."""
        count = len(shape.triangles)
        emission = self._from_primvars(prim, shape, surface.emission, "emission", MAX_RADIANCE)
        opacity = self._from_primvars(prim, shape, surface.opacity, "opacity", 1.0)
        if opacity is None and surface.opacity is not None:
            opacity = surface.opacity.mean.clip(0.0, 1.0)
        if emission is None and opacity is None:
            return np.full(count, self.add(material), dtype=np.int32)
        rows = np.empty((count, 4), np.float32)
        rows[:, :3], rows[:, 3] = material.emission, material.opacity
        if emission is not None:
            rows[:, :3] = self._triangle_means(prim, emission, "emission")
        if opacity is not None:
            material = replace(material, cutoff=0.0)
            rows[:, 3] = self._triangle_means(prim, opacity, "opacity")[..., 0]
            if surface.threshold > 0.0:
                rows[:, 3] = rows[:, 3] >= surface.threshold
            if ((rows[:, 3] > 0.0) & (rows[:, 3] < 1.0)).any():
                what = "partial opacity lets a share of the light pass undeflected ({n} in all)"
                self._report.warn(prim.GetPath(), what)
        distinct, inverse = np.unique(rows, axis=0, return_inverse=True)
        if len(distinct) > _MAX_VARIANTS:
            what = f"primvars give {len(distinct)} values of emission and opacity: their mean is used"
            self._report.warn(prim.GetPath(), what)
            distinct, inverse = rows.mean(axis=0, keepdims=True), np.zeros(count, np.int64)
        return np.array([self._variant(material, row) for row in distinct.tolist()], np.int32)[inverse.reshape(-1)]

    def _triangle_means(self, prim: Usd.Prim, corners: Floats, what: str) -> Floats:
        """Means over the corners of each triangle, [c] or [m, c], of values [c] or [m, 3, c]."""
        if corners.ndim == 1:
            return corners
        if not np.allclose(corners, corners[:, :1], rtol=1e-6):
            self._report.warn(prim.GetPath(), f"{what} from primvars is averaged over each triangle")
        means: Floats = corners.mean(axis=1)
        return means

    def _variant(self, material: Material, row: Sequence[float]) -> int:
        """Index of the material with this emission and opacity (r, g, b, o), or TRANSPARENT."""
        red, green, blue, opacity = row
        if opacity <= 0.0:
            return TRANSPARENT
        return self.add(replace(material, emission=(red, green, blue), opacity=opacity))

    def _from_primvars(
        self, prim: Usd.Prim, shape: TriangleMesh, value: ShadingValue | None, what: str, upper: float
    ) -> Floats | None:
        """A shading value evaluated with the prim's primvars, [c] or [m, 3, c]; None if the prim has none of them."""
        values: dict[SurfaceRef, Floats] = {}
        for key in () if value is None else value.primvars:
            corners = primvar.corner_values(prim, shape, key.name, key.channels, self._time, self._report)
            if corners is not None:
                values[key] = corners
        if value is None or not values:
            return None
        result = value.evaluate(values)
        if result.min() < 0.0 or result.max() > upper:
            names = ", ".join(key.name for key in value.primvars if key in values)
            self._report.warn(prim.GetPath(), f"{what} of the primvar {names} outside [0, {upper:g}] clamped")
        return result.clip(0.0, upper)

    def _without_material(self, prim: Usd.Prim, shape: TriangleMesh, index: Ints, bare: Bools) -> MaterialAssignment:
        """Assigns displayColor and displayOpacity to the triangles without a material."""
        color = primvar.display_color(prim, shape, self._time, self._report)
        if color is None:
            self._assign_display_material(index, bare, prim, shape, Material("no material"))
            return MaterialAssignment(index, bare=bare)
        if color.ndim == 1:
            red, green, blue = color.tolist()
            self._assign_display_material(index, bare, prim, shape, Material("displayColor", (red, green, blue)))
            return MaterialAssignment(index)
        self._assign_display_material(index, bare, prim, shape, Material("displayColor"))
        if not self.materials:
            return MaterialAssignment(index)
        colors = np.where(bare[:, None, None], color.astype(np.float32), self.albedo(index)[:, None])
        return MaterialAssignment(index, colors)

    def _assign_display_material(
        self, index: Ints, bare: Bools, prim: Usd.Prim, shape: TriangleMesh, material: Material
    ) -> None:
        """Assigns a material to the triangles that have none, one variant per value of displayOpacity."""
        opacity = primvar.display_opacity(prim, shape, self._time, self._report)
        distinct, inverse = np.unique(opacity, return_inverse=True)
        variants = [self._variant(material, (*material.emission, value)) for value in distinct.tolist()]
        index[bare] = np.array(variants, np.int32)[np.broadcast_to(inverse.reshape(-1), index.shape)][bare]

    def _uvs(self, prim: Usd.Prim, shape: TriangleMesh, index: Ints) -> dict[str, Floats]:
        """The sets of texture coordinates that the prim's materials use, if the prim has them."""
        used = (self.materials[k] for k in np.unique(index[index >= 0]))
        names = dict.fromkeys(texture.uv for material in used for texture in material.textures)
        uvs = {}
        for name in names:
            if name == FACE_TEXELS:
                continue
            corners = primvar.texture_coordinates(prim, shape, name, self._time, self._report)
            if corners is not None:
                uvs[name] = corners
        return uvs

    def albedo(self, index: Ints) -> Floats:
        """Albedos of materials by index [m], float32 [m, 3]; negative indices get an arbitrary one."""
        table: Floats = np.array([m.albedo for m in self.materials], dtype=np.float32)
        return table[np.maximum(index, 0)]

    def _subsets(self, prim: Usd.Prim, shape: TriangleMesh) -> list[tuple[Bools, int]]:
        """Face masks, bool [faces], with the material bound to them; the first subset of a face wins."""
        count = shape.element_counts.get("uniform")
        pairs: list[tuple[Bools, int]] = []
        if count is None:
            return pairs
        assigned = np.zeros(count, dtype=bool)
        for subset in material_subsets(prim):
            try:
                faces = read.ints(UsdGeom.Subset(subset).GetIndicesAttr(), self._time)
            except Unreadable as trouble:
                self._report.warn(subset.GetPath(), f"{trouble}; subset ignored")
                continue
            if faces is None:
                continue
            of_cells = shape.cells if UsdGeom.Subset(subset).GetElementTypeAttr().Get() == _TETRAHEDRON else None
            valid = (faces >= 0) & (faces < (count if of_cells is None else of_cells.count))
            if not valid.all():
                self._report.warn(subset.GetPath(), "{n} face indices out of range ignored", int((~valid).sum()))
            if of_cells is None:
                mask = np.zeros(count, dtype=bool)
                mask[faces[valid]] = True
            else:
                mask = np.isin(of_cells.of_face, faces[valid])
            if (mask & assigned).any():
                self._report.warn(
                    subset.GetPath(), "{n} faces are already in another subset", int((mask & assigned).sum())
                )
            mask &= ~assigned
            assigned |= mask
            bound = self._bound_index.get(subset.GetPath(), UNBOUND)
            if bound != UNBOUND:
                pairs.append((mask, bound))
        return pairs

    def _index_of(self, material: UsdShade.Material) -> int:
        """Index of a bound material, evaluated once; TRANSPARENT, or UNBOUND if it cannot be read."""
        prim = material.GetPrim()
        path = (prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim).GetPath()
        if path not in self._index_by_path:
            try:
                evaluated = read_material(
                    material, self._time, self._images, reflection=self._reflection, displaces=self._displaces
                )
                self._index_by_path[path] = TRANSPARENT if evaluated is None else self.add(evaluated.material)
                if evaluated is not None and self._displaces:
                    displacement = evaluated.displacement or read_displacement(material, self._time, self._images)
                    if displacement is not None:
                        self.displacements[self._index_by_path[path]] = displacement
                if evaluated is not None and evaluated.fields:
                    self._index_by_path[path] = self._add_with_fields(evaluated)
            except Unreadable as trouble:
                self._report.warn(material.GetPath(), str(trouble))
                self._index_by_path[path] = UNBOUND
        return self._index_by_path[path]


def _fields_to_bake(evaluated: EvaluatedMaterial) -> dict[str, ShadingValue]:
    """The fields of a material that read more than primvars, by what they are."""
    return {what: value for what, value in evaluated.fields.items() if what == "normal" or not value.only_primvars}


def material_subsets(prim: Usd.Prim) -> list[Usd.Prim]:
    """The GeomSubsets of a gprim in the family `materialBind`, in order."""
    children = prim.GetFilteredChildren(Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate))
    return [
        child
        for child in children
        if child.IsA(UsdGeom.Subset)
        and UsdGeom.Subset(child).GetFamilyNameAttr().Get() == UsdShade.Tokens.materialBind
        and UsdGeom.Subset(child).GetElementTypeAttr().Get() in _element_types(prim)
    ]


def _element_types(prim: Usd.Prim) -> tuple[str, ...]:
    """The elements of a prim to which materials are bound."""
    if prim.IsA(UsdGeom.TetMesh):
        return UsdGeom.Tokens.face, _TETRAHEDRON
    return (UsdGeom.Tokens.point,) if prim.IsA(UsdGeom.Points) else (UsdGeom.Tokens.face,)
