"""Gprims that are lights (LightAPI, MeshLightAPI): their surface emits, so they become emissive materials."""

from dataclasses import replace

import numpy as np
from pxr import Usd, UsdLux

from warp_ir.scene import Floats, Material
from warp_ir.usd import value
from warp_ir.usd.inputs import Inputs
from warp_ir.usd.light import as_color, emission, warn_of_unread
from warp_ir.usd.linking import is_linked
from warp_ir.usd.report import Report, Unreadable


def glow(prim: Usd.Prim, materials: list[Material], area: float, time: Usd.TimeCode, report: Report) -> list[Material]:
    """The materials of a gprim with LightAPI, with what the light adds to them.

    light:materialSyncMode decides: `materialGlowTintsLight` multiplies the light with the material's own emission
    (if it has any: else the light emits alone), `noMaterialResponse` leaves a black emitter, `independent` has a
    glow for the eye and another for the light, which surfaces here cannot tell apart: the light's is used.

    Args:
        prim: The gprim.
        materials: Its materials.
        area: Of one copy in the world, for `normalize`.
        time: Of the values.
        report: Where troubles go.
    """
    inputs = Inputs(prim, time, report)
    try:
        radiance = emission(inputs)
        if inputs.flag("normalize") and area > 0.0:
            radiance = radiance / area
        as_color(radiance)
        _warn_of_unread(inputs)
    except Unreadable as trouble:
        report.warn(prim.GetPath(), f"{trouble}; it does not emit as a light")
        return materials
    if radiance.max() == 0.0:
        report.stats["lights_without_emission"] += 1
    mode = value.text(prim.GetAttribute("light:materialSyncMode"), time, "noMaterialResponse")
    if mode == "independent":
        inputs.warn("materialSyncMode 'independent': the material's own glow is not shown, only the light's")
    lit = []
    for material in materials:
        material = replace(material, name=str(prim.GetPath()))
        if mode == "noMaterialResponse":
            material = replace(material, albedo=(0.0, 0.0, 0.0), albedo_texture=None)
        if mode != "materialGlowTintsLight" or max(material.emission) == 0.0:
            material = replace(material, emission=(1.0, 1.0, 1.0), emission_texture=None)
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


def _warn_of_unread(inputs: Inputs) -> None:
    """What analytic lights have and surfaces do not."""
    warn_of_unread(inputs)
    prim = inputs.prim
    if prim.HasAPI(UsdLux.ShapingAPI):
        inputs.warn("a surface that emits is not shaped: it emits in all directions")
    if prim.HasAPI(UsdLux.ShadowAPI) and not inputs.flag("shadow:enable", True):
        inputs.warn("inputs:shadow:enable = false is not read for a surface that emits: it casts shadows")
    if is_linked(prim):
        inputs.warn("links of a surface that emits are not read: it lights everything")
    if inputs.asset("texture:file") is not None:
        inputs.warn("only rectangles and domes have textures; this one is ignored")
