"""Surface shaders as the renderer's diffuse, emissive `Material`: UsdPreviewSurface and inline MaterialX.

A metal, or the mirror part of a specular workflow, becomes a diffuse surface of the same hemispherical albedo.
The few percent that a dielectric coating takes from the diffuse light below it are left out.
"""

import math

import numpy as np
from pxr import Usd, UsdShade

from warp_ir.scene import Color, Material
from warp_ir.usd import value
from warp_ir.usd.light import BRIGHTEST
from warp_ir.usd.report import Report, Unreadable

_GREY: Color = (0.18, 0.18, 0.18)
_BLACK: Color = (0.0, 0.0, 0.0)
_WHITE: Color = (1.0, 1.0, 1.0)


def read_material(material: UsdShade.Material, time: Usd.TimeCode, report: Report) -> Material | None:
    """What a bound material looks like; None if its opacity makes the surface absent.

    Raises:
        Unreadable: The material has no surface shader that is understood.
    """
    path = material.GetPath()
    known: list[str] = []
    # The universal context first: MaterialX is read only where nothing else is offered.
    for context in ("", "mtlx"):
        source = material.ComputeSurfaceSource(context)[0]
        if not source:
            continue
        shader = UsdShade.ConnectableAPI(source)
        identifier = UsdShade.Shader(source).GetShaderId() or "an unnamed shader"
        read = _READERS.get(identifier)
        if read is not None:
            return read(_Inputs(shader, path, time, report))
        known.append(identifier)
    outputs = [str(o.GetFullName()) for o in material.GetSurfaceOutputs() if o.HasConnectedSource()]
    what = f"its shader {known[0]} is not understood" if known else f"it offers only {', '.join(outputs)}"
    if not known and not outputs:
        what = "it has no surface shader"
    raise Unreadable(f"{what}; displayColor is used")


class _Inputs:
    """A shader's inputs as constants: connections followed, textures replaced and named."""

    def __init__(self, shader: UsdShade.ConnectableAPI, material: object, time: Usd.TimeCode, report: Report) -> None:
        self._shader, self._time, self._report = shader, time, report
        self.material = material

    def warn(self, what: str) -> None:
        """Say something about the material."""
        self._report.warn(self.material, what)

    def color(self, name: str, default: Color, unread: Color = _GREY) -> Color:
        """A colour; `unread` where it comes from a texture that has no fallback of its own."""
        found = self._source(name)
        if isinstance(found, Usd.Attribute):
            try:
                return value.color(found, self._time, default)
            except Unreadable as trouble:
                self.warn(f"{trouble}; the default is used")
        elif found is not None:
            return _color_of(found, unread)
        return default

    def number(self, name: str, default: float) -> float:
        """A number; the default where it comes from a texture."""
        found = self._source(name)
        if isinstance(found, Usd.Attribute):
            try:
                return value.number(found, self._time, default)
            except Unreadable as trouble:
                self.warn(f"{trouble}; the default is used")
        return default

    def text(self, name: str, default: str) -> str:
        """A token."""
        found = self._source(name)
        return value.text(found, self._time, default) if isinstance(found, Usd.Attribute) else default

    def _source(self, name: str) -> Usd.Attribute | list[float] | None:
        """The attribute that holds an input's value, or the fallback of the texture it is read from."""
        attribute = value.producer(self._shader.GetInput(name))
        if attribute is None or not UsdShade.Output.IsOutput(attribute):
            return attribute
        node = UsdShade.Shader(attribute.GetPrim())
        identifier = node.GetShaderId() or ""
        if identifier.startswith("ND_constant_"):
            return value.producer(node.GetInput("value"))
        self.warn(f"textures and primvar readers are not read yet: {name} takes a constant")
        fallback = value.raw(value.producer(node.GetInput("fallback")), self._time)
        if fallback is None or np.ndim(fallback) != 1 or not np.isfinite(fallback).all():
            return []
        channels = {"r": [0], "g": [1], "b": [2], "a": [3]}.get(attribute.GetBaseName(), [0, 1, 2])
        return [float(fallback[c]) for c in channels if c < len(fallback)]


def _color_of(channels: list[float], unread: Color) -> Color:
    if len(channels) == 3:
        return channels[0], channels[1], channels[2]
    return (channels[0],) * 3 if len(channels) == 1 else unread


def _preview_surface(inputs: _Inputs) -> Material | None:
    """UsdPreviewSurface; MaterialX's node of the same name has the same inputs."""
    if not _is_present(inputs, inputs.number("opacity", 1.0), inputs.number("opacityThreshold", 0.0)):
        return None
    albedo = np.array(inputs.color("diffuseColor", _GREY))
    if inputs.number("useSpecularWorkflow", 0.0) > 0.5:
        specular = np.clip(inputs.color("specularColor", _BLACK, _BLACK), 0.0, 1.0)
        albedo = albedo * (1.0 - specular) + specular
        if specular.max() > 0.05:
            inputs.warn("specular reflection rendered as diffuse ({n} materials)")
    elif inputs.number("metallic", 0.0) > 0.0:
        inputs.warn("metal rendered as a diffuse surface of its base colour ({n} materials)")
    return _material(inputs, albedo, np.array(inputs.color("emissiveColor", _BLACK, _BLACK)))


def _standard_surface(inputs: _Inputs) -> Material | None:
    """Autodesk Standard Surface: base and emission."""
    opacity = float(np.mean(inputs.color("opacity", _WHITE, _WHITE)))
    if not _is_present(inputs, opacity, 0.0):
        return None
    if inputs.number("metalness", 0.0) > 0.0:
        inputs.warn("metal rendered as a diffuse surface of its base colour ({n} materials)")
    if inputs.number("transmission", 0.0) > 0.0:
        inputs.warn("transmission is not rendered: the surface is opaque")
    albedo = inputs.number("base", 1.0) * np.array(inputs.color("base_color", (0.8, 0.8, 0.8)))
    emission = inputs.number("emission", 0.0) * np.array(inputs.color("emission_color", _WHITE, _WHITE))
    return _material(inputs, albedo, emission)


def _open_pbr_surface(inputs: _Inputs) -> Material | None:
    """OpenPBR: base and emission."""
    if not _is_present(inputs, inputs.number("geometry_opacity", 1.0), 0.0):
        return None
    if inputs.number("base_metalness", 0.0) > 0.0:
        inputs.warn("metal rendered as a diffuse surface of its base colour ({n} materials)")
    if inputs.number("transmission_weight", 0.0) > 0.0:
        inputs.warn("transmission is not rendered: the surface is opaque")
    albedo = inputs.number("base_weight", 1.0) * np.array(inputs.color("base_color", (0.8, 0.8, 0.8)))
    luminance = inputs.number("emission_luminance", 0.0)
    return _material(inputs, albedo, luminance * np.array(inputs.color("emission_color", _WHITE, _WHITE)))


_READERS = {
    "UsdPreviewSurface": _preview_surface,
    "ND_UsdPreviewSurface_surfaceshader": _preview_surface,
    "ND_standard_surface_surfaceshader": _standard_surface,
    "ND_open_pbr_surface_surfaceshader": _open_pbr_surface,
}


def _is_present(inputs: _Inputs, opacity: float, threshold: float) -> bool:
    """Whether a ray meets the surface; partial opacity is cut at the threshold, or at one half without one."""
    if threshold > 0.0:
        return opacity >= threshold
    if 0.0 < opacity < 1.0:
        inputs.warn("partial opacity is cut at one half: the surface is either there or not ({n} materials)")
    return opacity >= 0.5


def _material(inputs: _Inputs, albedo: np.ndarray, emission: np.ndarray) -> Material:
    """A record with an albedo that conserves energy and an emission that exists."""
    if albedo.min() < 0.0 or albedo.max() > 1.0:
        inputs.warn(f"albedo {_numbers(albedo)} clamped to [0, 1]")
    if emission.max() >= BRIGHTEST:
        inputs.warn(f"emission {_numbers(emission)} is beyond reason; it emits nothing")
        emission = np.zeros(3)
    if emission.min() < 0.0:
        inputs.warn(f"negative emission {_numbers(emission)} clamped to 0")
    return Material(str(inputs.material), _rgb(albedo.clip(0.0, 1.0)), _rgb(emission.clip(0.0, math.inf)))


def _rgb(channels: np.ndarray) -> Color:
    red, green, blue = channels.tolist()
    return red, green, blue


def _numbers(channels: np.ndarray) -> str:
    return "(" + ", ".join(f"{c:g}" for c in channels) + ")"
