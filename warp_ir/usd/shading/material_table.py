"""Which material each face has: bindings, subsets and displayColor, gathered into one table without doubles."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade

from warp_ir.scene import Bools, Floats, Ints, Material
from warp_ir.usd.images.cache import ImageCache
from warp_ir.usd.images.shading_value import ShadingValue
from warp_ir.usd.lights.light import BRIGHTEST
from warp_ir.usd.shading.binding import PURPOSES, bound_materials, order_of
from warp_ir.usd.shading.surface_shader import Surface, read_material
from warp_ir.usd.values import primvar, read
from warp_ir.usd.values.report import Report, Unreadable
from warp_ir.usd.values.triangles import TriangleMesh

ABSENT = -1
"""In place of a material's index: the surface is not there (opacity)."""
UNBOUND = -2
"""In place of a material's index: no material that can be read; displayColor decides."""
_MOST_VARIED = 2**16
"""Materials that primvars of one prim may ask for; beyond, their mean is enough."""


@dataclass(frozen=True, eq=False)
class Look:
    """How the triangles of one prim look."""

    material: Ints
    """int32 [m], indices into the table, or ABSENT."""
    colors: Floats | None = None
    """float32 [m, 3, 3], albedo of the corners where one per triangle is not enough; None elsewhere."""
    bare: Bools | None = None
    """bool [m], triangles with neither material nor colour, that an instancer may still colour; None: none."""
    uvs: Mapping[str, Floats] = field(default_factory=dict)
    """float32 [m, 3, 2], the texture coordinates that the materials need, by name."""
    asked: tuple[tuple[Bools, ShadingValue], ...] = ()
    """bool [m], triangles whose albedo depends on primvars that the prim lacks, and an instancer may have; and how."""
    unread: frozenset[str] = frozenset()
    """Such primvars that emission or opacity depend on: of instancers they are not read."""

    def keep(self, mask: Bools) -> "Look":
        """The look of the triangles that a mask [m] selects."""
        colors = None if self.colors is None else self.colors[mask]
        uvs = {name: corners[mask] for name, corners in self.uvs.items()}
        asked = tuple((which[mask], albedo) for which, albedo in self.asked)
        return Look(
            self.material[mask], colors, None if self.bare is None else self.bare[mask], uvs, asked, self.unread
        )


class MaterialTable:
    """The scene's materials, each read once.

    Args:
        time: Of the values.
        report: Where troubles go.
        images: Those that are known already; None: none are.
        metals: "diffuse" or "black".
        purposes: Of bindings, in the order in which they are wanted.
    """

    def __init__(
        self,
        time: Usd.TimeCode,
        report: Report,
        images: ImageCache | None = None,
        metals: str = "diffuse",
        purposes: Sequence[str] = PURPOSES[:2],
    ) -> None:
        self.materials: list[Material] = []
        self._purposes = purposes
        self._time, self._report = time, report
        self._images, self._black_metals = images or ImageCache(report), metals == "black"
        self._images.report = report
        self._asked: dict[int, Surface] = {}
        self._known: dict[Material, int] = {}
        self._read: dict[Sdf.Path, int] = {}
        self._bound: dict[Sdf.Path, int] = {}

    def add(self, material: Material) -> int:
        """Index of a material, new or not."""
        if material not in self._known:
            self._known[material] = len(self.materials)
            self.materials.append(material)
        return self._known[material]

    def resolve(self, prims: Sequence[Usd.Prim]) -> None:
        """Find the materials bound to prims and to their subsets; at once, for USD shares the work."""
        prims = [p for prim in prims for p in (prim, *material_subsets(prim))]
        for prim, found in zip(prims, bound_materials(prims, order_of(self._purposes)), strict=True):
            if found is not None:
                material, purpose = found
                if purpose and purpose not in self._purposes:
                    self._report.warn(
                        prim.GetPath(), f"only a material for the purpose '{purpose}' is bound; it is used"
                    )
                self._bound[prim.GetPath()] = self._index_of(material)
            elif (target := _dangling_target(prim)) is not None:
                self._report.warn(prim.GetPath(), f"the material it is bound to, {target}, does not exist")

    def look(self, prim: Usd.Prim, shape: TriangleMesh) -> Look:
        """The materials and colours of a prim's triangles; `resolve` has seen the prim."""
        index = np.full(len(shape.triangles), self._bound.get(prim.GetPath(), UNBOUND), dtype=np.int32)
        for faces, bound in self._subsets(prim, shape):
            index[faces[shape.face]] = bound
        return replace(self._colored(prim, shape, index), uvs=self._uvs(prim, shape, index))

    def _colored(self, prim: Usd.Prim, shape: TriangleMesh, index: Ints) -> Look:
        """The look of triangles with a material each: displayColor where there is none, primvars where it asks."""
        bare = index == UNBOUND
        asked = {int(k): self._asked[k] for k in np.unique(index) if k in self._asked}
        if not bare.any() and not asked:
            return Look(index)
        colors: Floats | None = None
        lacking: list[tuple[Bools, ShadingValue]] = []
        unread = frozenset(
            wanted.name
            for surface in asked.values()
            for signal in (surface.emission, surface.opacity)
            if signal is not None
            for wanted in signal.primvars
            if not UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(wanted.name)
        )
        for k, surface in asked.items():
            chosen = index == k
            material = self.materials[k]
            color = self._from_primvars(prim, shape, surface.albedo, "albedo", 1.0)
            if color is None and surface.albedo is not None and material.albedo_texture is None:
                lacking.append((chosen, surface.albedo))
            if color is not None:
                material = self._without_image(material, albedo_texture=None)
                if color.ndim == 1:
                    red, green, blue = color.tolist()
                    material = replace(material, albedo=(red, green, blue))
            index[chosen] = self._varied(prim, shape, surface, material)[chosen]
            if color is not None and color.ndim > 1:
                colors = self.albedo(index)[:, None].repeat(3, axis=1) if colors is None else colors
                colors[chosen] = color[chosen]
        if not bare.any():
            return Look(index, colors, asked=tuple(lacking), unread=unread)
        look = replace(self._bare(prim, shape, index, bare), asked=tuple(lacking), unread=unread)
        if colors is None:
            return look
        chosen = bare if look.colors is not None else np.zeros_like(bare)
        colors[bare] = self.albedo(look.material)[bare, None]
        return replace(
            look, colors=colors if look.colors is None else np.where(chosen[:, None, None], look.colors, colors)
        )

    def _without_image(self, material: Material, **none: Any) -> Material:
        """The material without one of its images, whose mean is used."""
        plain = replace(material, **none)
        if plain != material:
            self._report.warn(material.name, "its image counts as its mean where primvars are read")
        return plain

    def _varied(self, prim: Usd.Prim, shape: TriangleMesh, surface: Surface, material: Material) -> Ints:
        """The material of each triangle, int32 [m], where emission or opacity may depend on primvars."""
        count = len(shape.triangles)
        emission = self._from_primvars(prim, shape, surface.emission, "emission", BRIGHTEST)
        opacity = self._from_primvars(prim, shape, surface.opacity, "opacity", 1.0)
        if opacity is None and surface.opacity is not None:
            opacity = surface.opacity.mean.clip(0.0, 1.0)
        if emission is None and opacity is None:
            return np.full(count, self.add(material), dtype=np.int32)
        rows = np.empty((count, 4), np.float32)
        rows[:, :3], rows[:, 3] = material.emission, material.opacity
        if emission is not None:
            material = self._without_image(material, emission_texture=None)
            rows[:, :3] = self._of_triangles(prim, emission, "emission")
        if opacity is not None:
            material = self._without_image(replace(material, cutoff=0.0), opacity_texture=None)
            rows[:, 3] = self._of_triangles(prim, opacity, "opacity")[..., 0]
            if surface.threshold > 0.0:
                rows[:, 3] = rows[:, 3] >= surface.threshold
            if ((rows[:, 3] > 0.0) & (rows[:, 3] < 1.0)).any():
                what = "partial opacity lets a share of the light through, straight on ({n} in all)"
                self._report.warn(prim.GetPath(), what)
        distinct, inverse = np.unique(rows, axis=0, return_inverse=True)
        if len(distinct) > _MOST_VARIED:
            what = f"emission and opacity of its primvars have {len(distinct)} values: their mean is used"
            self._report.warn(prim.GetPath(), what)
            distinct, inverse = rows.mean(axis=0, keepdims=True), np.zeros(count, np.int64)
        return np.array([self._variant(material, row) for row in distinct.tolist()], np.int32)[inverse.reshape(-1)]

    def _of_triangles(self, prim: Usd.Prim, corners: Floats, what: str) -> Floats:
        """Values [c] or [m, 3, c] as those of triangles, [c] or [m, c]: where they differ within one, their mean."""
        if corners.ndim == 1:
            return corners
        if not np.allclose(corners, corners[:, :1], rtol=1e-6):
            self._report.warn(prim.GetPath(), f"{what} of primvars is rendered as its mean over each triangle")
        means: Floats = corners.mean(axis=1)
        return means

    def _variant(self, material: Material, row: Sequence[float]) -> int:
        """Index of the material with an emission and opacity (rgb, o), or ABSENT."""
        red, green, blue, opacity = row
        if opacity <= 0.0:
            return ABSENT
        return self.add(replace(material, emission=(red, green, blue), opacity=opacity))

    def _from_primvars(
        self, prim: Usd.Prim, shape: TriangleMesh, signal: ShadingValue | None, what: str, largest: float
    ) -> Floats | None:
        """What depends on primvars, [c] or [m, 3, c]; None if nothing does, or if the prim has none of them."""
        values = {}
        for asked in () if signal is None else signal.primvars:
            found = primvar.corner_values(prim, shape, asked.name, asked.channels, self._time, self._report)
            if found is not None:
                values[asked] = found
        if signal is None or not values:
            return None
        found = signal.evaluate(values)
        if found.min() < 0.0 or found.max() > largest:
            names = ", ".join(asked.name for asked in values)
            self._report.warn(prim.GetPath(), f"{what} of the primvar {names} outside [0, {largest:g}] clamped")
        return found.clip(0.0, largest)

    def _bare(self, prim: Usd.Prim, shape: TriangleMesh, index: Ints, bare: Bools) -> Look:
        """The look of a prim of whose triangles some have no material."""
        color = primvar.display_color(prim, shape, self._time, self._report)
        if color is None:
            self._index_bare(index, bare, prim, shape, Material("no material"))
            return Look(index, bare=bare)
        if color.ndim == 1:
            red, green, blue = color.tolist()
            self._index_bare(index, bare, prim, shape, Material("displayColor", (red, green, blue)))
            return Look(index)
        self._index_bare(index, bare, prim, shape, Material("displayColor"))
        if not self.materials:
            return Look(index)
        colors = np.where(bare[:, None, None], color.astype(np.float32), self.albedo(index)[:, None])
        return Look(index, colors)

    def _index_bare(self, index: Ints, bare: Bools, prim: Usd.Prim, shape: TriangleMesh, material: Material) -> None:
        """Gives a material to the triangles that have none, of the prim's own displayOpacity."""
        opacity = primvar.display_opacity(prim, shape, self._time, self._report)
        distinct, inverse = np.unique(opacity, return_inverse=True)
        variants = [self._variant(material, (*material.emission, value)) for value in distinct.tolist()]
        index[bare] = np.array(variants, np.int32)[np.broadcast_to(inverse.reshape(-1), index.shape)][bare]

    def _uvs(self, prim: Usd.Prim, shape: TriangleMesh, index: Ints) -> dict[str, Floats]:
        """The texture coordinates that a prim's materials need, and that it has."""
        used = (self.materials[k] for k in np.unique(index[index >= 0]))
        names = dict.fromkeys(texture.uv for material in used for texture in material.textures)
        uvs = {}
        for name in names:
            corners = primvar.texture_coordinates(prim, shape, name, self._time, self._report)
            if corners is not None:
                uvs[name] = corners
        return uvs

    def albedo(self, index: Ints) -> Floats:
        """The albedo of each material in a list of indices [m], float32 [m, 3]; ABSENT gets any."""
        table: Floats = np.array([m.albedo for m in self.materials], dtype=np.float32)
        return table[index]

    def _subsets(self, prim: Usd.Prim, shape: TriangleMesh) -> list[tuple[Bools, int]]:
        """Face masks, bool [faces], with the material bound to them; the first subset of a face wins."""
        count = shape.element_counts.get("uniform")
        pairs: list[tuple[Bools, int]] = []
        if count is None:
            return pairs
        taken = np.zeros(count, dtype=bool)
        for subset in material_subsets(prim):
            try:
                faces = read.ints(UsdGeom.Subset(subset).GetIndicesAttr(), self._time)
            except Unreadable as trouble:
                self._report.warn(subset.GetPath(), f"{trouble}; subset ignored")
                continue
            if faces is None:
                continue
            valid = (faces >= 0) & (faces < count)
            if not valid.all():
                self._report.warn(subset.GetPath(), "{n} face indices out of range ignored", int((~valid).sum()))
            mask = np.zeros(count, dtype=bool)
            mask[faces[valid]] = True
            if (mask & taken).any():
                self._report.warn(
                    subset.GetPath(), "{n} faces are already in another subset", int((mask & taken).sum())
                )
            mask &= ~taken
            taken |= mask
            bound = self._bound.get(subset.GetPath(), UNBOUND)
            if bound != UNBOUND:
                pairs.append((mask, bound))
        return pairs

    def _index_of(self, material: UsdShade.Material) -> int:
        prim = material.GetPrim()
        path = (prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim).GetPath()
        if path not in self._read:
            try:
                found = read_material(material, self._time, self._images, black_metals=self._black_metals)
                self._read[path] = ABSENT if found is None else self.add(found.material)
                if found is not None and (found.albedo or found.emission or found.opacity):
                    self._asked[self._read[path]] = found
            except Unreadable as trouble:
                self._report.warn(material.GetPath(), str(trouble))
                self._read[path] = UNBOUND
        return self._read[path]


def material_subsets(prim: Usd.Prim) -> list[Usd.Prim]:
    """The face subsets of a gprim that exist to bind materials, in order."""
    children = prim.GetFilteredChildren(Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate))
    return [
        child
        for child in children
        if child.IsA(UsdGeom.Subset)
        and UsdGeom.Subset(child).GetFamilyNameAttr().Get() == UsdShade.Tokens.materialBind
        and UsdGeom.Subset(child).GetElementTypeAttr().Get() == UsdGeom.Tokens.face
    ]


def _dangling_target(prim: Usd.Prim) -> Sdf.Path | None:
    """The target of the nearest direct binding, if there is one although nothing could be resolved."""
    while prim and not prim.IsPseudoRoot():
        targets = UsdShade.MaterialBindingAPI(prim).GetDirectBindingRel().GetTargets()
        if targets:
            return targets[0]
        prim = prim.GetParent()
    return None
