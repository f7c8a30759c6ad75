"""Gprims that are lights (LightAPI, MeshLightAPI, GeometryLight): their surface emits as their materials then say."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pxr import Tf, Usd, UsdGeom

from warp_ir.scene import Floats, LightKind, Material, MeshLight, Shaping, Texture
from warp_ir.usd.lights.inputs import Inputs
from warp_ir.usd.lights.light import as_color, casts_shadows, emission, light_texture, warn_of_unread
from warp_ir.usd.lights.shaping import read_shaping
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable

LAMP_UV = "st"
"""The primvar that places a light's texture on a gprim."""
_BLACK = (0.0, 0.0, 0.0)


class Lamp:
    """A light whose shape is a gprim, read once, to be put in many places.

    light:materialSyncMode decides what the gprim's materials have to do with it: with `materialGlowTintsLight` and
    `independent` the camera sees the material's emission while the light lights the scene, with the former multiplied
    with the material's emission (if it has any: else the light is all there is); `noMaterialResponse` leaves a black
    emitter.

    Args:
        prim: The light: the gprim itself, or a GeometryLight that refers to it.
        gprim: Whose surface it is.
        time: Of the values.
        report: Where troubles go.
    """

    def __init__(self, prim: Usd.Prim, gprim: Usd.Prim, time: Usd.TimeCode, report: Report) -> None:
        self._prim, self._on_its_own = prim, prim == gprim
        self._time, self._report = time, report
        self._radiance: Floats | None = None
        """None: it does not emit as a light."""
        self._shaping: Shaping | None = None
        self._shadows, self._normalize = True, False
        self._mode = read.text(prim.GetAttribute("light:materialSyncMode"), time, "noMaterialResponse")
        inputs = Inputs(prim, time, report)
        try:
            self._normalize = inputs.flag("normalize")
            self._shaping = read_shaping(inputs, LightKind.SPHERE)
            self._shadows = casts_shadows(inputs)
            warn_of_unread(inputs)
            self._radiance = emission(inputs)
        except Unreadable as trouble:
            report.warn(prim.GetPath(), f"{trouble}; it does not emit as a light")
        pixels = light_texture(inputs, LightKind.RECT)
        self._texture = None if pixels is None else Texture("texture:file", pixels, uv=LAMP_UV)
        if self._radiance is not None and self._radiance.max() == 0.0:
            report.stats["lights_without_emission"] += 1

    @property
    def textured(self) -> bool:
        """Whether it wants the gprim's texture coordinates `LAMP_UV`."""
        return self._texture is not None

    def differs(self, areas: Floats) -> bool:
        """Whether places in which the gprim has these areas [k] have to be told apart."""
        alike = np.allclose(areas, areas[:1], rtol=1e-5)
        return self._radiance is not None and (self._shaping is not None or (self._normalize and not alike))

    def light(self, world_from_gprim: Floats) -> MeshLight | None:
        """What it is beyond its emission, in one of its places; None if it does not emit as a light."""
        if self._radiance is None:
            return None
        matrix = world_from_gprim
        if not self._on_its_own:
            try:
                matrix = np.array(UsdGeom.XformCache(self._time).GetLocalToWorldTransform(self._prim)).T
            except Tf.ErrorException:
                self._report.warn(self._prim.GetPath(), "its transform cannot be read; the identity is used")
                matrix = np.eye(4)
        if not np.isfinite(matrix).all():
            matrix = np.eye(4)
        return MeshLight(str(self._prim.GetPath()), matrix, self._shaping, self._shadows)

    def materials(self, materials: Sequence[Material], area: float) -> list[Material]:
        """The gprim's materials with what the light adds to them.

        Args:
            materials: What it has without.
            area: Of one copy in the world, for `normalize`.
        """
        radiance = self._radiance
        if radiance is not None and self._normalize and area > 0.0:
            radiance = radiance / area
        try:
            tint = None if radiance is None else as_color(radiance)
        except Unreadable as trouble:
            self._report.warn(self._prim.GetPath(), f"{trouble}; it does not emit as a light")
            tint = None
        if tint is None or radiance is None:
            return list(materials)
        lit = []
        for material in materials:
            material = replace(material, name=str(self._prim.GetPath()))
            tinted = self._mode == "materialGlowTintsLight" and max(material.emission) > 0.0
            if self._mode == "noMaterialResponse":
                material = replace(material, albedo=_BLACK, albedo_texture=None)
            elif self._mode == "independent" or (tinted and (radiance != 1.0).any()):
                material = replace(material, glow=material.emission, glow_texture=material.emission_texture)
            if not tinted:
                material = replace(material, emission=(1.0, 1.0, 1.0), emission_texture=None)
            if self._texture is not None and material.emission_texture is None:
                material = _times(replace(material, emission_texture=self._texture), np.array(material.emission))
            elif self._texture is not None:
                what = "texture:file: not read, for the material's own emission has a texture"
                self._report.warn(self._prim.GetPath(), what)
            lit.append(_times(material, radiance))
        return lit


def _times(material: Material, factor: Floats) -> Material:
    """The material with its emission multiplied, float64 [3]."""
    texture = material.emission_texture
    if texture is None:
        red, green, blue = (factor * material.emission).tolist()
        return replace(material, emission=(red, green, blue))
    red, green, blue = (factor * texture.outside).tolist()
    pixels = np.asarray(texture.pixels, np.float32) * factor.astype(np.float32)
    return replace(material, emission_texture=replace(texture, pixels=pixels, outside=(red, green, blue)))
