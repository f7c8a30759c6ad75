"""Surface shaders as the renderer's diffuse, emissive `Material`: UsdPreviewSurface and MaterialX.

A metal, or the mirror part of a specular workflow, becomes a diffuse surface of the same hemispherical albedo.
The few percent that a dielectric coating takes from the diffuse light below it are left out. Partial opacity lets
that share of the rays through, straight on; emission is lost with it.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from pxr import Sdf, Usd, UsdShade

from warp_ir.scene import Color, Floats, Material, Wrap
from warp_ir.usd.images.cache import ImageCache
from warp_ir.usd.images.shading_value import ShadingValue, UVMapping, as_color, combine, constant
from warp_ir.usd.lights.light import BRIGHTEST
from warp_ir.usd.shading.network import Network
from warp_ir.usd.shading.vendor_shaders import reader_of, shader_name
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Unreadable

_GREY: Color = (0.18, 0.18, 0.18)
_BLACK: Color = (0.0, 0.0, 0.0)
_WHITE: Color = (1.0, 1.0, 1.0)
_FAINTEST = 0.02
"""Opacity down to which a transparent surface emits in full: few rays meet it, and what they bring is its inverse."""


@dataclass(frozen=True)
class Surface:
    """What a material looks like."""

    material: Material
    albedo: ShadingValue | None = None
    """If it depends on primvars: what the albedo is where surfaces have them."""
    emission: ShadingValue | None = None
    """Likewise."""
    opacity: ShadingValue | None = None
    """Likewise."""
    threshold: float = 0.0
    """Of the opacity: if it is more than 0, surfaces below it are absent, and others opaque."""


def read_material(
    material: UsdShade.Material, time: Usd.TimeCode, images: ImageCache, *, black_metals: bool = False
) -> Surface | None:
    """What a bound material looks like; None if its opacity makes the surface absent.

    Args:
        material: The material.
        time: Of the values.
        images: Of the scene.
        black_metals: Whether metals keep nothing but their strictly diffuse part.

    Raises:
        Unreadable: The material has no surface shader that is understood.
    """
    path = material.GetPath()
    outputs = [str(o.GetFullName()) for o in material.GetSurfaceOutputs() if o.HasConnectedSource()]
    # The universal context first: others are read only where it offers nothing that is understood.
    contexts = dict.fromkeys(["", "mtlx", *(name.removeprefix("outputs:").rpartition(":")[0] for name in outputs)])
    sources = [source for context in contexts if (source := material.ComputeSurfaceSource(context)[0])]
    shaders = list({source.GetPath(): UsdShade.Shader(source) for source in sources}.values())
    there = {shader.GetPath() for shader in shaders}
    displaced = [material.ComputeDisplacementSource(context)[0] for context in contexts]
    if any(source and source.GetPath() not in there for source in displaced):
        images.report.warn(path, "displacement is not rendered ({n} materials)")
    inputs = [_Inputs(s.ConnectableAPI(), Network(images, path, time), black_metals) for s in shaders]
    for shader, found in zip(shaders, inputs, strict=True):
        read = _READERS.get(shader.GetShaderId())
        if read is not None:
            return read(found)
    for shader, found in zip(shaders, inputs, strict=True):
        approximate = reader_of(shader)
        terms = None if approximate is None else approximate(found)
        if terms is not None:
            what = "is rendered by base colour, emission and opacity alone ({n} materials)"
            found.warn(f"its shader {shader_name(shader)} {what}")
            albedo = _metal(found, terms.metallic, terms.albedo)
            normal = None if terms.normal is None else found.tangent_normal("normal", terms.normal)
            return _surface(found, albedo, terms.emission, terms.opacity, terms.threshold, normal)
    what = f"it offers only {', '.join(outputs)}" if outputs else "it has no surface shader"
    if shaders:
        what = f"its shader {shader_name(shaders[0]) or 'without an id'} is not understood"
    raise Unreadable(f"{what}; displayColor is used")


class _Inputs:
    """The inputs of a surface shader."""

    def __init__(self, shader: UsdShade.ConnectableAPI, network: Network, black_metals: bool) -> None:
        self._shader, self.network, self.black_metals = shader, network, black_metals
        self.warn = network.warn

    def color(self, name: str, default: Color) -> ShadingValue:
        """A colour."""
        return as_color(self.network.evaluate(self._shader.GetInput(name), constant(*default)))

    def grey(self, name: str, default: float) -> ShadingValue:
        """One channel."""
        found = self.network.evaluate(self._shader.GetInput(name), constant(default))
        return found if found.pixels.shape[2] == 1 else combine("grey", _mean_channel, found)

    def has(self, name: str) -> bool:
        """Whether an input has a value or a connection."""
        given = read.producer(self._shader.GetInput(name))
        return given is not None and bool(UsdShade.Output.IsOutput(given) or given.HasValue())

    def pair(self, name: str, default: float) -> tuple[float, float]:
        """Two numbers."""
        found = np.resize(self.network.evaluate(self._shader.GetInput(name), constant(default, default)).mean, 2)
        return float(found[0]), float(found[1])

    def word(self, name: str) -> str:
        """A token; a number in digits."""
        return self.network.word(self._shader.GetInput(name))

    def picture(
        self, name: str, channels: list[int], uv: str, transform: Floats, *, color: bool
    ) -> ShadingValue | None:
        """The image that an input names, or what is connected to it; None where it names none that can be read.

        Args:
            name: Of the input.
            channels: Numbers of those that are wanted, of r, g, b and a.
            uv: The primvar that places the image.
            transform: What is done to it, [3, 3].
            color: Whether it may be decoded.
        """
        return self.network.picture(self._shader.GetInput(name), channels, uv, transform, color=color)

    def file(
        self, asset: Sdf.AssetPath, channels: list[int], space: str, uv: str, transform: Floats
    ) -> ShadingValue | None:
        """An image, repeated; None where it cannot be read."""
        return self.network.file(asset, channels, space, uv, transform)

    def normal(self, name: str, *, tangent: bool) -> ShadingValue | None:
        """A normal map, in tangent space; None where there is none, or a flat one.

        Args:
            name: Of the input.
            tangent: Whether the input itself is in tangent space; otherwise a node `normalmap` has to feed it.
        """
        given = read.producer(self._shader.GetInput(name))
        if given is None:
            return None
        if not tangent:
            if not UsdShade.Output.IsOutput(given):
                return None
            node = str(UsdShade.Shader(given.GetPrim()).GetShaderId() or "an unnamed node")
            if not node.startswith(("ND_normalmap", "ND_gltf_normalmap")):
                self.warn(f"{name}: only a normalmap is read, not {node}; the surface's own normals are used")
                return None
        found = as_color(self.network.evaluate(self._shader.GetInput(name), constant(0.0, 0.0, 1.0)))
        return self.tangent_normal(name, found)

    def tangent_normal(self, name: str, found: ShadingValue) -> ShadingValue | None:
        """A normal map in tangent space as it is stored; None for a flat one."""
        self.without_primvars(name, found)
        if np.abs(found.pixels).max() > 1.0:
            found = combine("normal", lambda n: np.clip(n, -1.0, 1.0), found)
        x, y, z = found.mean.tolist()
        if found.mapping is None:
            return None if x == y == 0.0 else replace(found, mapping=UVMapping())  # one texel
        if math.hypot(x, y) > 0.5 * abs(z):
            self.warn(f"{name}: the map leans to one side; is it raw, with scale 2 and bias -1 ({{n}} materials)?")
        # Beyond an image that ends, the surface is smooth.
        return replace(found, outside=np.array([0.0, 0.0, 1.0]), key=("normal", found.key))

    def without_primvars(self, what: str, signal: ShadingValue) -> None:
        """Name the primvars that count as their readers' fallbacks."""
        for primvar in signal.primvars:
            self.warn(f"{what} reads the primvar '{primvar.name}': it takes the reader's fallback")

    def unread(self, name: str) -> None:
        """Name an input that is fed by a node, or is not 0, in vain."""
        given = read.producer(self._shader.GetInput(name))
        if given is not None and (UsdShade.Output.IsOutput(given) or self.number(name, 0.0) != 0.0):
            self.warn(f"{name} is not rendered ({{n}} materials)")

    def unrendered(self, name: str, what: str) -> None:
        """Say that something is not rendered, if its weight is not 0."""
        weight = self.grey(name, 0.0)
        if weight.pixels.max() > 0.0 or weight.primvars:
            self.warn(f"{what} is not rendered ({{n}} materials)")

    def number(self, name: str, default: float) -> float:
        """A number; the mean where it comes from an image."""
        found = self.grey(name, default)
        self.without_primvars(name, found)
        return float(found.mean[0])


def _mean_channel(pixels: Floats) -> Floats:
    return np.asarray(pixels[..., :3].mean(axis=-1, keepdims=True))


def _preview_surface(inputs: _Inputs) -> Surface | None:
    """UsdPreviewSurface; MaterialX's node of the same name has the same inputs."""
    albedo = inputs.color("diffuseColor", _GREY)
    if inputs.number("useSpecularWorkflow", 0.0) > 0.5:
        specular = combine("clip", _unit, inputs.color("specularColor", _BLACK))
        if specular.pixels.max() > 0.0:
            albedo = combine("specular", lambda d, s: d * (1.0 - s) + s, albedo, specular)
        if specular.pixels.max() > 0.05:
            inputs.warn("specular reflection rendered as diffuse ({n} materials)")
    else:
        albedo = _metal(inputs, inputs.grey("metallic", 0.0), albedo)
    emission = inputs.color("emissiveColor", _BLACK)
    opacity, threshold = inputs.grey("opacity", 1.0), inputs.number("opacityThreshold", 0.0)
    if threshold <= 0.0 and inputs.word("opacityMode") != "presence" and emission.pixels.max() > 0.0:
        # What is transparent emits all the same, and the renderer loses the light of what is not there.
        emission = combine("glow", lambda e, o: e / np.clip(o, _FAINTEST, 1.0), emission, opacity)
    return _surface(inputs, albedo, emission, opacity, threshold, inputs.normal("normal", tangent=True))


def _standard_surface(inputs: _Inputs) -> Surface | None:
    """Autodesk Standard Surface: base and emission."""
    if inputs.number("transmission", 0.0) > 0.0:
        inputs.warn("transmission is not rendered: the surface is opaque")
    albedo = _scaled(inputs.color("base_color", (0.8, 0.8, 0.8)), inputs.grey("base", 1.0))
    emission = _scaled(inputs.color("emission_color", _WHITE), inputs.grey("emission", 0.0))
    albedo = _scattering(inputs, "subsurface", "metalness", _WHITE, albedo)
    albedo = _coated(inputs, "coat", _metal(inputs, inputs.grey("metalness", 0.0), albedo))
    inputs.unrendered("sheen", "sheen")
    return _surface(inputs, albedo, emission, inputs.grey("opacity", 1.0), 0.0, inputs.normal("normal", tangent=False))


def _open_pbr_surface(inputs: _Inputs) -> Surface | None:
    """OpenPBR: base and emission."""
    if inputs.number("transmission_weight", 0.0) > 0.0:
        inputs.warn("transmission is not rendered: the surface is opaque")
    albedo = _scaled(inputs.color("base_color", (0.8, 0.8, 0.8)), inputs.grey("base_weight", 1.0))
    emission = _scaled(inputs.color("emission_color", _WHITE), inputs.grey("emission_luminance", 0.0))
    albedo = _scattering(inputs, "subsurface_weight", "base_metalness", (0.8, 0.8, 0.8), albedo)
    albedo = _coated(inputs, "coat_weight", _metal(inputs, inputs.grey("base_metalness", 0.0), albedo))
    inputs.unrendered("fuzz_weight", "sheen")
    opacity, normal = inputs.grey("geometry_opacity", 1.0), inputs.normal("geometry_normal", tangent=False)
    return _surface(inputs, albedo, emission, opacity, 0.0, normal)


def _gltf_pbr(inputs: _Inputs) -> Surface | None:
    """The material of glTF, as MaterialX has it."""
    if inputs.number("transmission", 0.0) > 0.0:
        inputs.warn("transmission is not rendered: the surface is opaque")
    albedo = _metal(inputs, inputs.grey("metallic", 1.0), inputs.color("base_color", _WHITE))
    emission = _scaled(inputs.color("emissive", _BLACK), inputs.grey("emissive_strength", 1.0))
    mode = round(inputs.number("alpha_mode", 0.0))  # opaque, cut out, blended
    opacity = inputs.grey("alpha", 1.0) if mode else constant(1.0)
    threshold = inputs.number("alpha_cutoff", 0.5) if mode == 1 else 0.0
    return _surface(inputs, albedo, emission, opacity, threshold, inputs.normal("normal", tangent=False))


def _unlit(inputs: _Inputs) -> Surface | None:
    """MaterialX's surface that shows its emission and reflects nothing."""
    emission = _scaled(inputs.color("emission_color", _WHITE), inputs.grey("emission", 1.0))
    return _surface(inputs, constant(*_BLACK), emission, inputs.grey("opacity", 1.0), 0.0, None)


_READERS = {
    "UsdPreviewSurface": _preview_surface,
    "ND_UsdPreviewSurface_surfaceshader": _preview_surface,
    "ND_standard_surface_surfaceshader": _standard_surface,
    "ND_standard_surface_surfaceshader_100": _standard_surface,
    "ND_open_pbr_surface_surfaceshader": _open_pbr_surface,
    "ND_gltf_pbr_surfaceshader": _gltf_pbr,
    "ND_surface_unlit": _unlit,
    # Arnold's have the inputs of the same names.
    "arnold:standard_surface": _standard_surface,
    "arnold:openpbr_surface": _open_pbr_surface,
}


def _unit(pixels: Floats) -> Floats:
    return np.clip(pixels, 0.0, 1.0)


def _scaled(color: ShadingValue, weight: ShadingValue) -> ShadingValue:
    if weight.mapping is None and not weight.primvars and weight.mean[0] == 1.0:
        return color
    return combine("scaled", np.multiply, color, weight)


def _metal(inputs: _Inputs, metallic: ShadingValue, albedo: ShadingValue) -> ShadingValue:
    """The albedo of a surface that may be a metal, of which only its base colour is left, or nothing."""
    if metallic.pixels.max() <= 0.0 and not metallic.primvars:
        return albedo
    if not inputs.black_metals:
        inputs.warn("metal rendered as a diffuse surface of its base colour ({n} materials)")
        return albedo
    inputs.warn("metal rendered without its reflection ({n} materials)")
    return combine("metal", lambda a, m: a * (1.0 - np.clip(m, 0.0, 1.0)), albedo, metallic)


def _scattering(inputs: _Inputs, weight: str, metalness: str, default: Color, albedo: ShadingValue) -> ShadingValue:
    """The albedo of a surface of which a part scatters light below it: as reflected from its colour, where it entered.

    Metals let no light in.
    """
    share = inputs.grey(weight, 0.0)
    if share.pixels.max() <= 0.0 and not share.primvars:
        return albedo
    inputs.warn("subsurface scattering rendered as diffuse reflection ({n} materials)")

    def mixed(base: Floats, color: Floats, part: Floats, metal: Floats) -> Floats:
        part = _unit(part) * (1.0 - _unit(metal))
        return np.asarray(base * (1.0 - part) + color * part)

    color = inputs.color("subsurface_color", default)
    return combine("subsurface", mixed, albedo, color, share, inputs.grey(metalness, 0.0))


def _coated(inputs: _Inputs, weight: str, albedo: ShadingValue) -> ShadingValue:
    """The albedo below a coat, whose colour filters what comes back: lacquered metals get theirs from it."""
    coat = inputs.grey(weight, 0.0)
    if coat.pixels.max() <= 0.0 and not coat.primvars:
        return albedo
    tint = inputs.color("coat_color", _WHITE)
    if tint.pixels.min() >= 1.0 and not tint.primvars:
        return albedo
    return combine("coat", lambda a, c, t: a * (1.0 - np.clip(c, 0.0, 1.0) * (1.0 - _unit(t))), albedo, coat, tint)


def _surface(
    inputs: _Inputs,
    albedo: ShadingValue,
    emission: ShadingValue,
    opacity: ShadingValue,
    threshold: float,
    normal: ShadingValue | None,
) -> Surface | None:
    """A record with an albedo that conserves energy and an emission that exists; None if nothing is there."""
    if albedo.pixels.min() < 0.0 or albedo.pixels.max() > 1.0:
        inputs.warn(f"albedo {_numbers(albedo)} clamped to [0, 1]")
        albedo = combine("clip", _unit, albedo)
    if float(emission.pixels.max()) >= BRIGHTEST:
        inputs.warn(f"emission {_numbers(emission)} is beyond reason; it emits nothing")
        emission = constant(*_BLACK)
    if emission.pixels.min() < 0.0:
        inputs.warn(f"negative emission {_numbers(emission)} clamped to 0")
        emission = combine("positive", lambda e: np.clip(e, 0.0, math.inf), emission)
    opacity = combine("clip", _unit, opacity)
    values = opacity.pixels.reshape(-1)
    if opacity.mapping is not None and Wrap.BLACK in opacity.mapping.wrap:
        values = np.append(values, opacity.outside)
    if threshold > 0.0:
        values = (values >= threshold).astype(np.float64)
    if values.max() <= 0.0 and not opacity.primvars:
        return None
    opaque = values.min() >= 1.0
    if not opaque and threshold <= 0.0 and ((values > 0.0) & (values < 1.0)).any():
        inputs.warn("partial opacity lets a share of the light through, straight on ({n} materials)")
    inputs.unread("displacement")
    network = inputs.network
    textured = opacity.mapping is not None and not opaque
    material = Material(
        str(network.material),
        _rgb(albedo.mean),
        _rgb(emission.mean),
        1.0 if opaque else float(opacity.mean[0]),
        min(threshold, 1.0) if textured else 0.0,
        None if albedo.mapping is None else network.texture(_bounded(albedo)),
        None if emission.mapping is None or emission.pixels.max() == 0.0 else network.texture(_bounded(emission)),
        network.texture(_bounded(opacity)) if textured else None,
        normal_texture=None if normal is None else network.texture(normal),
    )
    albedo_of, emission_of, opacity_of = (x if x.primvars else None for x in (albedo, emission, opacity))
    return Surface(material, albedo_of, emission_of, opacity_of, threshold)


def _bounded(signal: ShadingValue) -> ShadingValue:
    """The signal, its value outside as positive as its pixels."""
    top = max(float(signal.pixels.max()), 0.0)
    return ShadingValue(
        signal.pixels, np.clip(signal.outside, 0.0, max(top, 1.0)), signal.mapping, signal.key, signal.name
    )


def _rgb(channels: Floats) -> Color:
    red, green, blue = np.broadcast_to(channels, 3).tolist()
    return red, green, blue


def _numbers(signal: ShadingValue) -> str:
    if signal.mapping is not None:
        return f"of {signal.name}"
    return "(" + ", ".join(f"{c:g}" for c in signal.mean) + ")"
