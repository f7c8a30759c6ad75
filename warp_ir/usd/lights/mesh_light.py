"""Gprims that are lights (LightAPI, MeshLightAPI, GeometryLight): their surfaces emit, as light and material decide."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pxr import Tf, Usd, UsdGeom

from warp_ir.scene import MAX_RADIANCE, Floats, LightKind, Material, MeshLight, Shaping, Texture
from warp_ir.usd.lights.inputs import LightInputs
from warp_ir.usd.lights.light import (
    checked_radiance,
    light_texture,
    shadows_enabled,
    unnormalized_radiance,
    warn_unsupported,
)
from warp_ir.usd.lights.shaping import read_shaping
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable

LIGHT_UV = "st"
"""The primvar with the texture coordinates of a light's texture on a gprim."""
_BLACK = (0.0, 0.0, 0.0)


class MeshLightPrim:
    """A light in the shape of a gprim, read once for all its instances.

    light:materialSyncMode combines the light with the gprim's materials. With `materialGlowTintsLight` and
    `independent` the camera sees the material's emission. The scene is lit by the light prim, in the former mode
    multiplied by the material's emission if it has any. With `noMaterialResponse` the gprim is a black emitter.

    Args:
        prim: The light: the gprim itself, or a GeometryLight that targets it.
        gprim: The gprim.
        time: Time code of all values.
        report: Receives warnings.
    """

    def __init__(self, prim: Usd.Prim, gprim: Usd.Prim, time: Usd.TimeCode, report: Report) -> None:
        self._prim, self._is_gprim = prim, prim == gprim
        self._time, self._report = time, report
        self._radiance: Floats | None = None
        """None: it does not emit as a light."""
        self._shaping: Shaping | None = None
        self._shadows, self._normalize = True, False
        self._sync_mode = read.text(prim.GetAttribute("light:materialSyncMode"), time, "noMaterialResponse")
        inputs = LightInputs(prim, time, report)
        try:
            self._normalize = inputs.flag("normalize")
            self._shaping = read_shaping(inputs, LightKind.SPHERE)
            self._shadows = shadows_enabled(inputs)
            warn_unsupported(inputs)
            self._radiance = unnormalized_radiance(inputs)
        except Unreadable as trouble:
            report.warn(prim.GetPath(), f"{trouble}; it does not emit as a light")
        pixels = light_texture(inputs, LightKind.RECT)
        self._texture = None if pixels is None else Texture("texture:file", pixels, uv=LIGHT_UV)
        if self._radiance is not None and self._radiance.max() == 0.0:
            report.stats["lights_without_emission"] += 1

    @property
    def textured(self) -> bool:
        """Whether it needs the gprim's texture coordinates `LIGHT_UV`."""
        return self._texture is not None

    def varies_by_instance(self, areas: Floats) -> bool:
        """Whether instances of the gprim with these areas [k] differ in emission."""
        alike = np.allclose(areas, areas[:1], rtol=1e-5)
        return self._radiance is not None and (self._shaping is not None or (self._normalize and not alike))

    def light(self, world_from_gprim: Floats) -> MeshLight | None:
        """The light's record for an instance, without the emission; None: it does not emit as a light."""
        if self._radiance is None:
            return None
        matrix = world_from_gprim
        if not self._is_gprim:
            try:
                matrix = np.array(UsdGeom.XformCache(self._time).GetLocalToWorldTransform(self._prim)).T
            except Tf.ErrorException:
                self._report.warn(self._prim.GetPath(), "its transform cannot be read; the identity is used")
                matrix = np.eye(4)
        if not np.isfinite(matrix).all():
            matrix = np.eye(4)
        return MeshLight(str(self._prim.GetPath()), matrix, self._shaping, self._shadows)

    def materials(self, materials: Sequence[Material], area: float) -> list[Material]:
        """The gprim's materials with the emission of the light.

        Args:
            materials: The gprim's own materials.
            area: World-space area of one instance, for `normalize`.
        """
        radiance = self._radiance
        if radiance is not None and self._normalize and area > 0.0:
            radiance = radiance / area
        try:
            scale = None if radiance is None else checked_radiance(radiance)
        except Unreadable as trouble:
            self._report.warn(self._prim.GetPath(), f"{trouble}; it does not emit as a light")
            scale = None
        if scale is None or radiance is None:
            return list(materials)
        adjusted = []
        for material in materials:
            material = replace(material, name=str(self._prim.GetPath()))
            tinted = self._sync_mode == "materialGlowTintsLight" and max(material.emission) > 0.0
            if self._sync_mode == "noMaterialResponse":
                material = replace(material, albedo=_BLACK, albedo_texture=None)
            elif self._sync_mode == "independent" or (tinted and (radiance != 1.0).any()):
                material = replace(material, glow=material.emission, glow_texture=material.emission_texture)
            if not tinted:
                material = replace(material, emission=(1.0, 1.0, 1.0), emission_texture=None)
            if self._texture is not None and material.emission_texture is None:
                material = _with_scaled_emission(
                    replace(material, emission_texture=self._texture), np.array(material.emission)
                )
            elif self._texture is not None:
                what = "texture:file is ignored, since the material's emission has a texture"
                self._report.warn(self._prim.GetPath(), what)
            adjusted.append(_with_scaled_emission(material, radiance))
        if not all(_brightest(material) < MAX_RADIANCE for material in adjusted):
            what = f"its emission exceeds {MAX_RADIANCE:g}; it does not emit as a light"
            self._report.warn(self._prim.GetPath(), what)
            return list(materials)
        return adjusted


def _brightest(material: Material) -> float:
    """The largest emission of a material."""
    texture = material.emission_texture
    return max(material.emission) if texture is None else max(float(texture.pixels.max()), *texture.outside)


@np.errstate(over="ignore")
def _with_scaled_emission(material: Material, factor: Floats) -> Material:
    """The material with its emission scaled by a factor, float64 [3]."""
    texture = material.emission_texture
    if texture is None:
        red, green, blue = (factor * material.emission).tolist()
        return replace(material, emission=(red, green, blue))
    red, green, blue = (factor * texture.outside).tolist()
    pixels = np.asarray(texture.pixels, np.float32) * factor.astype(np.float32)
    return replace(material, emission_texture=replace(texture, pixels=pixels, outside=(red, green, blue)))
