"""Surface shaders as the renderer's diffuse, emissive `Material`: UsdPreviewSurface, MaterialX and Arnold.

A metal, or the specular part of a specular workflow, becomes a diffuse surface of the same hemispherical albedo.
The few percent by which a dielectric coating attenuates the diffuse reflection are ignored. Partial opacity lets
that share of the rays pass undeflected; emission is reduced by it as well.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdShade

from warp_ir.scene import MAX_RADIANCE, Color, Floats, Gloss, Material, Wrap
from warp_ir.usd.images.cache import ImageCache
from warp_ir.usd.images.shading_value import ShadingValue, UVMapping, as_color, combine, constant
from warp_ir.usd.shading.network import ShadingNetwork
from warp_ir.usd.shading.vendor_shaders import shader_name, vendor_reader
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Unreadable

_GREY: Color = (0.18, 0.18, 0.18)
_BLACK: Color = (0.0, 0.0, 0.0)
_WHITE: Color = (1.0, 1.0, 1.0)
_MIN_OPACITY = 0.02
"""Opacity down to which a transparent surface emits in full: few rays hit it, and each is weighted by its inverse."""
_DISPLACEMENT = "ND_displacement_float"
"""MaterialX's shader of displacements along the normal."""


@dataclass(frozen=True)
class EvaluatedMaterial:
    """A material's shading network, evaluated."""

    material: Material
    albedo: ShadingValue | None = None
    """The albedo if it is a field, to be evaluated for each prim; else None."""
    emission: ShadingValue | None = None
    """The emission if it is a field; else None."""
    opacity: ShadingValue | None = None
    """The opacity if it is a field; else None."""
    normal: ShadingValue | None = None
    """The normal in tangent space if it is a field; else None."""
    threshold: float = 0.0
    """If positive, surfaces of lower opacity are cut out, and others are opaque."""
    displacement: ShadingValue | None = None
    """Displacement along the normal, one channel; None: there is none, or it is not asked for."""

    @property
    def fields(self) -> dict[str, ShadingValue]:
        """The fields by the names of their attributes."""
        named = {"albedo": self.albedo, "emission": self.emission, "opacity": self.opacity, "normal": self.normal}
        return {name: value for name, value in named.items() if value is not None}


def read_material(
    material: UsdShade.Material,
    time: Usd.TimeCode,
    images: ImageCache,
    *,
    reflection: str = "diffuse",
    displaces: bool = False,
) -> EvaluatedMaterial | None:
    """Evaluates a bound material; None: its opacity is 0 everywhere.

    Args:
        material: The material.
        time: Time code of all values.
        images: Cache of images.
        reflection: "diffuse"; "black": metals keep only their diffuse lobe; "all": gloss as well.
        displaces: Whether the displacement is wanted; else a warning says that it is not rendered.

    Raises:
        Unreadable: No surface shader of the material is supported.
    """
    path = material.GetPath()
    outputs = [str(o.GetFullName()) for o in material.GetSurfaceOutputs() if o.HasConnectedSource()]
    # MaterialX before the universal render context, as in Storm; others are used only if neither shader is supported.
    contexts = dict.fromkeys(["mtlx", "", *(name.removeprefix("outputs:").rpartition(":")[0] for name in outputs)])
    by_context = {context: source for context in contexts if (source := material.ComputeSurfaceSource(context)[0])}
    shaders = list({source.GetPath(): UsdShade.Shader(source) for source in by_context.values()}.values())
    choice = {
        by_context[context].GetPath(): output
        for context, output in (("", "outputs:surface"), ("mtlx", "outputs:mtlx:surface"))
        if context in by_context
    }
    surface_paths = {shader.GetPath() for shader in shaders}
    displacements = [material.ComputeDisplacementSource(context)[0] for context in contexts]
    unsupported = [source for source in displacements if source and source.GetPath() not in surface_paths]
    if any(not (displaces and source.GetShaderId() == _DISPLACEMENT) for source in unsupported):
        images.report.warn(path, "displacement is not rendered ({n} materials)")
    inputs = [
        _NetworkInputs(shader.ConnectableAPI(), ShadingNetwork(images, path, time), reflection, displaces)
        for shader in shaders
    ]
    for shader, shader_inputs in zip(shaders, inputs, strict=True):
        read_shader = _SHADER_READERS.get(shader.GetShaderId())
        if read_shader is not None:
            if len(choice) > 1 and shader.GetPath() in choice:
                output = choice[shader.GetPath()]
                shader_inputs.warn(f"of its MaterialX and its universal surface, {output} is used ({{n}} materials)")
            return read_shader(shader_inputs)
    for shader, shader_inputs in zip(shaders, inputs, strict=True):
        read_parameters = vendor_reader(shader)
        parameters = None if read_parameters is None else read_parameters(shader_inputs)
        if parameters is not None:
            what = "is approximated by base colour, emission and opacity ({n} materials)"
            shader_inputs.warn(f"its shader {shader_name(shader)} {what}")
            albedo = _metal_as_diffuse(shader_inputs, parameters.metallic, parameters.albedo)
            normal = None if parameters.normal is None else shader_inputs.tangent_normal("normal", parameters.normal)
            return _evaluated(
                shader_inputs, albedo, parameters.emission, parameters.opacity, parameters.threshold, normal
            )
    what = f"it offers only {', '.join(outputs)}" if outputs else "it has no surface shader"
    if shaders:
        what = f"its shader {shader_name(shaders[0]) or 'without an id'} is not supported"
    raise Unreadable(f"{what}; displayColor is used")


def read_displacement(material: UsdShade.Material, time: Usd.TimeCode, images: ImageCache) -> ShadingValue | None:
    """The displacement by MaterialX's shader of displacements, one channel; None: there is none.

    Args:
        material: The material.
        time: Time code of all values.
        images: Cache of images.
    """
    for context in ("mtlx", ""):
        source = material.ComputeDisplacementSource(context)[0]
        if source and source.GetShaderId() == _DISPLACEMENT:
            inputs = _NetworkInputs(
                source.ConnectableAPI(), ShadingNetwork(images, material.GetPath(), time), "diffuse"
            )
            amount, scale = inputs.scalar("displacement", 0.0), inputs.scalar("scale", 1.0)
            value = combine("displacement", lambda d, s: d * s, amount, scale)
            return None if value.highest == value.lowest == 0.0 else value
    return None


class _NetworkInputs:
    """Evaluates the inputs of a surface shader."""

    def __init__(
        self, shader: UsdShade.ConnectableAPI, network: ShadingNetwork, reflection: str, displaces: bool = False
    ) -> None:
        self._shader, self.network, self.reflection, self.displaces = shader, network, reflection, displaces
        self.warn = network.warn

    def color(self, name: str, default: Color) -> ShadingValue:
        """An input as a colour, [..., 3]."""
        return as_color(self.network.evaluate(self._shader.GetInput(name), constant(*default)))

    def scalar(self, name: str, default: float) -> ShadingValue:
        """An input as one channel; the mean of a colour's."""
        value = self.network.evaluate(self._shader.GetInput(name), constant(default))
        return value if value.pixels.shape[2] == 1 else combine("grey", _mean_channel, value)

    def has(self, name: str) -> bool:
        """Whether an input has a value or a connection."""
        producer = read.producer(self._shader.GetInput(name))
        return producer is not None and bool(UsdShade.Output.IsOutput(producer) or producer.HasValue())

    def pair(self, name: str, default: float) -> tuple[float, float]:
        """An input as two numbers."""
        numbers = np.resize(self.network.evaluate(self._shader.GetInput(name), constant(default, default)).mean, 2)
        return float(numbers[0]), float(numbers[1])

    def token(self, name: str) -> str:
        """An input as a token; numbers are converted to text."""
        return self.network.token(self._shader.GetInput(name))

    def image(self, name: str, channels: list[int], uv: str, transform: Floats, *, color: bool) -> ShadingValue | None:
        """The image that an input names, or the value of a connected node; None: it has none that can be read.

        Args:
            name: The input.
            channels: Indices of the channels, of r, g, b and a.
            uv: The primvar with the texture coordinates.
            transform: Transform of the texture coordinates, [3, 3].
            color: Whether the image may be colour-encoded.
        """
        return self.network.image(self._shader.GetInput(name), channels, uv, transform, color=color)

    def image_file(
        self, asset: Sdf.AssetPath, channels: list[int], space: str, uv: str, transform: Floats
    ) -> ShadingValue | None:
        """The image of a file, with wrap mode repeat; None: it cannot be read."""
        return self.network.image_file(asset, channels, space, uv, transform)

    def normal(self, name: str, *, tangent: bool) -> ShadingValue | None:
        """A normal map in tangent space; None: there is none, or it is flat.

        Args:
            name: The input.
            tangent: Whether the input is in tangent space itself; otherwise a `normalmap` node has to be connected.
        """
        producer = read.producer(self._shader.GetInput(name))
        if producer is None:
            return None
        if not tangent:
            if not UsdShade.Output.IsOutput(producer):
                return None
            node = str(UsdShade.Shader(producer.GetPrim()).GetShaderId() or "an unnamed node")
            if not node.startswith(("ND_normalmap", "ND_gltf_normalmap", "ND_normal_map_decode")):
                self.warn(
                    f"{name}: the node {node} is not supported, only normalmap is; the surface's own normals are used"
                )
                return None
        value = as_color(self.network.evaluate(self._shader.GetInput(name), constant(0.0, 0.0, 1.0)))
        return self.tangent_normal(name, value)

    def tangent_normal(self, name: str, value: ShadingValue) -> ShadingValue | None:
        """A normal map from values in tangent space; None: it is flat."""
        self.warn_primvar_fallbacks(name, value)
        if max(-value.lowest, value.highest) > 1.0:
            value = combine("normal", lambda n: np.clip(n, -1.0, 1.0), value)
        x, y, z = value.mean.tolist()
        if value.reads:
            return value
        if value.mapping is None:
            return None if x == y == 0.0 else replace(value, mapping=UVMapping())  # one texel
        if math.hypot(x, y) > 0.5 * abs(z):
            self.warn(f"{name}: its mean is strongly tilted; is it raw, with scale 2 and bias -1 ({{n}} materials)?")
        # Outside an image that does not repeat, the surface is smooth.
        return replace(value, outside=np.array([0.0, 0.0, 1.0]), key=("normal", value.key))

    def warn_primvar_fallbacks(self, what: str, value: ShadingValue) -> None:
        """Warns of primvars that are replaced by their readers' fallbacks."""
        for primvar in value.primvars:
            self.warn(f"{what} reads the primvar '{primvar.name}': the reader's fallback is used")

    def warn_unrendered_input(self, name: str) -> None:
        """Warns of an input that has a connection or is not 0, and is not rendered."""
        producer = read.producer(self._shader.GetInput(name))
        if producer is not None and (UsdShade.Output.IsOutput(producer) or self.number(name, 0.0) != 0.0):
            self.warn(f"{name} is not rendered ({{n}} materials)")

    def warn_unrendered_lobe(self, name: str, what: str) -> None:
        """Warns of a lobe that is not rendered, if its weight is not 0."""
        weight = self.scalar(name, 0.0)
        if weight.highest > 0.0 or weight.reads:
            self.warn(f"{what} is not rendered ({{n}} materials)")

    def number(self, name: str, default: float) -> float:
        """An input as a number; the mean if an image is connected."""
        value = self.scalar(name, default)
        self.warn_primvar_fallbacks(name, value)
        if value.reads and not value.primvars and value.highest > value.lowest:
            self.warn(f"{name} varies over the surface: a mean is used")
        return float(value.mean[0])


def _mean_channel(pixels: Floats) -> Floats:
    """The mean of r, g and b, as one channel."""
    return np.asarray(pixels[..., :3].mean(axis=-1, keepdims=True))


def _gloss(
    inputs: _NetworkInputs,
    base_color: ShadingValue,
    *,
    specular_color: ShadingValue | None = None,
    **named: tuple[str, float],
) -> Gloss | None:
    """What is reflected by direction; None: it is not asked for, and nothing of it is read.

    Primvars other than the colour's take their fallback.

    Args:
        inputs: The shader.
        base_color: The colour of the base.
        specular_color: The reflectance of the specular workflow.
        named: Input and default of the other parameters of `Gloss`.
    """
    if inputs.reflection != "all":
        return None
    colors = {"base_color": base_color, "specular_color": specular_color}
    given: dict[str, Any] = {}
    for name, value in colors.items():
        given |= {} if value is None else _gloss_parameter(inputs, name, value)
    for name, (source, default) in named.items():
        if name in ("ior", "specular_weight"):  # constants
            given[name] = inputs.number(source, default)
        else:
            value = inputs.scalar(source, default)
            inputs.warn_primvar_fallbacks(source, value)
            given |= _gloss_parameter(inputs, name, value)
    if not 0.0 < given["ior"] < math.inf:
        inputs.warn(f"ior {given['ior']:g} is not positive; 1.5 is used ({{n}} materials)")
        given["ior"] = 1.5
    given["specular_weight"] = min(max(given.get("specular_weight", 1.0), 0.0), 1.0)
    return Gloss(**given)


def _gloss_parameter(inputs: _NetworkInputs, name: str, value: ShadingValue) -> dict[str, Any]:
    """A parameter of `Gloss` in [0, 1], and its image if it has one."""
    value = combine("clip", _clamp01, value)
    constant = _rgb(value.mean) if name.endswith("color") else float(value.mean[0])
    if value.mapping is None:
        return {name: constant}
    return {name: constant, f"{name}_texture": inputs.network.texture(_with_bounded_border(value))}


def _preview_surface(inputs: _NetworkInputs) -> EvaluatedMaterial | None:
    """UsdPreviewSurface; MaterialX's node of the same name has the same inputs."""
    albedo = base = inputs.color("diffuseColor", _GREY)
    specular: ShadingValue | None = None
    if inputs.number("useSpecularWorkflow", 0.0) > 0.5:
        specular = combine("clip", _clamp01, inputs.color("specularColor", _BLACK))
        if specular.highest > 0.0:
            albedo = combine("specular", lambda d, s: d * (1.0 - s) + s, albedo, specular)
        if specular.highest > 0.05 and inputs.reflection != "all":
            inputs.warn("specular reflection is rendered as diffuse ({n} materials)")
    else:
        albedo = _metal_as_diffuse(inputs, inputs.scalar("metallic", 0.0), albedo)
    emission = inputs.color("emissiveColor", _BLACK)
    opacity, threshold = inputs.scalar("opacity", 1.0), inputs.number("opacityThreshold", 0.0)
    if threshold <= 0.0 and inputs.token("opacityMode") != "presence" and emission.highest > 0.0:
        # In mode `transparent` opacity does not dim emission, but the renderer reduces the emission by it.
        emission = combine("glow", lambda e, o: e / np.clip(o, _MIN_OPACITY, 1.0), emission, opacity)
    gloss = _gloss(
        inputs,
        base,
        metallic=("metallic", 0.0),
        roughness=("roughness", 0.5),
        ior=("ior", 1.5),
        specular_color=specular,
        clearcoat=("clearcoat", 0.0),
        clearcoat_roughness=("clearcoatRoughness", 0.01),
    )
    return _evaluated(inputs, albedo, emission, opacity, threshold, inputs.normal("normal", tangent=True), gloss)


def _standard_surface(inputs: _NetworkInputs) -> EvaluatedMaterial | None:
    """Autodesk Standard Surface: base, subsurface, coat tint, emission and opacity."""
    if inputs.number("transmission", 0.0) > 0.0:
        inputs.warn("transmission is not rendered: the surface is opaque")
    albedo = _weighted(inputs.color("base_color", (0.8, 0.8, 0.8)), inputs.scalar("base", 1.0))
    emission = _weighted(inputs.color("emission_color", _WHITE), inputs.scalar("emission", 0.0))
    albedo = base = _scattering(inputs, "subsurface", "metalness", _WHITE, albedo)
    albedo = _tinted_by_coat(inputs, "coat", _metal_as_diffuse(inputs, inputs.scalar("metalness", 0.0), albedo))
    inputs.warn_unrendered_lobe("sheen", "sheen")
    gloss = _gloss(
        inputs,
        base,
        metallic=("metalness", 0.0),
        roughness=("specular_roughness", 0.2),
        ior=("specular_IOR", 1.5),
        specular_weight=("specular", 1.0),
        clearcoat=("coat", 0.0),
        clearcoat_roughness=("coat_roughness", 0.1),
    )
    opacity, normal = inputs.scalar("opacity", 1.0), inputs.normal("normal", tangent=False)
    return _evaluated(inputs, albedo, emission, opacity, 0.0, normal, gloss)


def _open_pbr_surface(inputs: _NetworkInputs) -> EvaluatedMaterial | None:
    """OpenPBR: base, subsurface, coat tint, emission and opacity."""
    if inputs.number("transmission_weight", 0.0) > 0.0:
        inputs.warn("transmission is not rendered: the surface is opaque")
    albedo = _weighted(inputs.color("base_color", (0.8, 0.8, 0.8)), inputs.scalar("base_weight", 1.0))
    emission = _weighted(inputs.color("emission_color", _WHITE), inputs.scalar("emission_luminance", 0.0))
    albedo = base = _scattering(inputs, "subsurface_weight", "base_metalness", (0.8, 0.8, 0.8), albedo)
    albedo = _tinted_by_coat(
        inputs, "coat_weight", _metal_as_diffuse(inputs, inputs.scalar("base_metalness", 0.0), albedo)
    )
    inputs.warn_unrendered_lobe("fuzz_weight", "sheen")
    opacity, normal = inputs.scalar("geometry_opacity", 1.0), inputs.normal("geometry_normal", tangent=False)
    gloss = _gloss(
        inputs,
        base,
        metallic=("base_metalness", 0.0),
        roughness=("specular_roughness", 0.3),
        ior=("specular_ior", 1.5),
        specular_weight=("specular_weight", 1.0),
        clearcoat=("coat_weight", 0.0),
        clearcoat_roughness=("coat_roughness", 0.0),
    )
    return _evaluated(inputs, albedo, emission, opacity, 0.0, normal, gloss)


def _gltf_pbr(inputs: _NetworkInputs) -> EvaluatedMaterial | None:
    """MaterialX's glTF PBR material."""
    if inputs.number("transmission", 0.0) > 0.0:
        inputs.warn("transmission is not rendered: the surface is opaque")
    base = inputs.color("base_color", _WHITE)
    albedo = _metal_as_diffuse(inputs, inputs.scalar("metallic", 1.0), base)
    emission = _weighted(inputs.color("emissive", _BLACK), inputs.scalar("emissive_strength", 1.0))
    mode = round(inputs.number("alpha_mode", 0.0))  # 0: OPAQUE, 1: MASK, 2: BLEND
    opacity = inputs.scalar("alpha", 1.0) if mode else constant(1.0)
    threshold = inputs.number("alpha_cutoff", 0.5) if mode == 1 else 0.0
    gloss = _gloss(
        inputs,
        base,
        metallic=("metallic", 1.0),
        roughness=("roughness", 1.0),
        ior=("ior", 1.5),
        specular_weight=("specular", 1.0),
        clearcoat=("clearcoat", 0.0),
        clearcoat_roughness=("clearcoat_roughness", 0.0),
    )
    return _evaluated(inputs, albedo, emission, opacity, threshold, inputs.normal("normal", tangent=False), gloss)


def _surface_unlit(inputs: _NetworkInputs) -> EvaluatedMaterial | None:
    """MaterialX's unlit surface: emission and opacity, no reflection."""
    emission = _weighted(inputs.color("emission_color", _WHITE), inputs.scalar("emission", 1.0))
    return _evaluated(inputs, constant(*_BLACK), emission, inputs.scalar("opacity", 1.0), 0.0, None)


_SHADER_READERS = {
    "UsdPreviewSurface": _preview_surface,
    "ND_UsdPreviewSurface_surfaceshader": _preview_surface,
    "ND_standard_surface_surfaceshader": _standard_surface,
    "ND_standard_surface_surfaceshader_100": _standard_surface,
    "ND_open_pbr_surface_surfaceshader": _open_pbr_surface,
    "ND_gltf_pbr_surfaceshader": _gltf_pbr,
    "ND_surface_unlit": _surface_unlit,
    # Arnold's shaders have inputs of the same names.
    "arnold:standard_surface": _standard_surface,
    "arnold:openpbr_surface": _open_pbr_surface,
}


def _clamp01(pixels: Floats) -> Floats:
    return np.clip(pixels, 0.0, 1.0)


def _weighted(color: ShadingValue, weight: ShadingValue) -> ShadingValue:
    if weight.mapping is None and not weight.reads and weight.mean[0] == 1.0:
        return color
    return combine("scaled", np.multiply, color, weight)


def _metal_as_diffuse(inputs: _NetworkInputs, metallic: ShadingValue, albedo: ShadingValue) -> ShadingValue:
    """The albedo where the surface is a metal: its base colour, or 0 if metals are black; gloss counts on its own."""
    if metallic.highest <= 0.0 and not metallic.reads:
        return albedo
    if inputs.reflection != "black":
        if inputs.reflection == "all":
            return albedo
        inputs.warn("metal is rendered as a diffuse surface of its base colour ({n} materials)")
        return albedo
    inputs.warn("metal is rendered without its reflection ({n} materials)")
    return combine("metal", lambda a, m: a * (1.0 - np.clip(m, 0.0, 1.0)), albedo, metallic)


def _scattering(
    inputs: _NetworkInputs, weight: str, metalness: str, default: Color, albedo: ShadingValue
) -> ShadingValue:
    """The albedo with a share of subsurface scattering, rendered as diffuse reflection of its colour.

    Metals do not scatter.
    """
    weight_value = inputs.scalar(weight, 0.0)
    if weight_value.highest <= 0.0 and not weight_value.reads:
        return albedo
    inputs.warn("subsurface scattering is rendered as diffuse reflection ({n} materials)")

    def mixed(base: Floats, color: Floats, part: Floats, metal: Floats) -> Floats:
        part = _clamp01(part) * (1.0 - _clamp01(metal))
        return np.asarray(base * (1.0 - part) + color * part)

    color = inputs.color("subsurface_color", default)
    return combine("subsurface", mixed, albedo, color, weight_value, inputs.scalar(metalness, 0.0))


def _tinted_by_coat(inputs: _NetworkInputs, weight: str, albedo: ShadingValue) -> ShadingValue:
    """The albedo below a coat, whose colour filters the reflection: coloured lacquer on metal, for example."""
    coat = inputs.scalar(weight, 0.0)
    if coat.highest <= 0.0 and not coat.reads:
        return albedo
    tint = inputs.color("coat_color", _WHITE)
    if tint.lowest >= 1.0 and not tint.reads:
        return albedo
    return combine("coat", lambda a, c, t: a * (1.0 - np.clip(c, 0.0, 1.0) * (1.0 - _clamp01(t))), albedo, coat, tint)


def _evaluated(
    inputs: _NetworkInputs,
    albedo: ShadingValue,
    emission: ShadingValue,
    opacity: ShadingValue,
    threshold: float,
    normal: ShadingValue | None,
    gloss: Gloss | None = None,
) -> EvaluatedMaterial | None:
    """The evaluated material with an albedo in [0, 1] and a non-negative emission; None: opacity is 0."""
    rounding = 1e-6 if albedo.reads else 0.0
    if albedo.lowest < -rounding or albedo.highest > 1.0 + rounding:
        inputs.warn(f"albedo {_value_text(albedo)} clamped to [0, 1]")
        albedo = combine("clip", _clamp01, albedo)
    if emission.highest >= MAX_RADIANCE:
        inputs.warn(f"emission {_value_text(emission)} exceeds {MAX_RADIANCE:g}; it emits nothing")
        emission = constant(*_BLACK)
    if emission.lowest < 0.0:
        inputs.warn(f"negative emission {_value_text(emission)} clamped to 0")
        emission = combine("positive", lambda e: np.clip(e, 0.0, math.inf), emission)
    opacity = combine("clip", _clamp01, opacity)
    values = opacity.pixels.reshape(-1)
    if opacity.mapping is not None and Wrap.BLACK in opacity.mapping.wrap:
        values = np.append(values, opacity.outside)
    if threshold > 0.0:
        values = (values >= threshold).astype(np.float64)
    if values.max() <= 0.0 and not opacity.reads:
        return None
    opaque = values.min() >= 1.0
    if not opaque and threshold <= 0.0 and ((values > 0.0) & (values < 1.0)).any():
        inputs.warn("partial opacity lets a share of the light pass undeflected ({n} materials)")
    displacement: ShadingValue | None = None
    if inputs.displaces:
        displacement = inputs.scalar("displacement", 0.0)
        displacement = None if displacement.highest == displacement.lowest == 0.0 else displacement
    else:
        inputs.warn_unrendered_input("displacement")
    network = inputs.network
    normal_field = normal if normal is not None and normal.reads else None
    normal = None if normal_field is not None else normal
    textured = opacity.mapping is not None and not opaque
    emissive_image = emission.mapping is not None and emission.highest > 0.0
    albedo_texture = None if albedo.mapping is None else network.texture(_with_bounded_border(albedo))
    emission_texture = network.texture(_with_bounded_border(emission)) if emissive_image else None
    opacity_texture = network.texture(_with_bounded_border(opacity)) if textured else None
    material = Material(
        str(network.material),
        _rgb(albedo.mean) if albedo_texture is None else albedo_texture.mean,
        _rgb(emission.mean) if emission_texture is None else emission_texture.mean,
        1.0 if opaque else float(opacity.mean[0]),
        min(threshold, 1.0) if textured else 0.0,
        albedo_texture,
        emission_texture,
        opacity_texture,
        normal_texture=None if normal is None else network.texture(normal),
        gloss=gloss,
    )
    albedo_value, emission_value, opacity_value = (x if x.reads else None for x in (albedo, emission, opacity))
    return EvaluatedMaterial(
        material, albedo_value, emission_value, opacity_value, normal_field, threshold, displacement
    )


def with_baked(evaluated: EvaluatedMaterial, what: str, value: ShadingValue, images: ImageCache) -> EvaluatedMaterial:
    """A material one of whose fields is an image or a constant on a prim.

    Args:
        evaluated: The material.
        what: "albedo", "emission", "opacity" or "normal".
        value: What replaces the field.
        images: Cache of images.
    """
    upper = {"emission": MAX_RADIANCE}.get(what, 1.0)
    lower = -1.0 if what == "normal" else 0.0
    if value.lowest < lower or value.highest > upper:
        value = combine(("clip", lower, upper), lambda a: np.clip(a, lower, upper), value)
    texture = None if value.mapping is None else images.texture(value)
    material = evaluated.material
    if what == "albedo":
        material = replace(material, albedo=_rgb(value.mean), albedo_texture=texture)
        if material.gloss is not None and material.gloss.base_color_texture is None:
            gloss = replace(material.gloss, base_color=material.albedo, base_color_texture=texture)
            material = replace(material, gloss=gloss)
    elif what == "emission":
        emits = value.highest > 0.0
        material = replace(material, emission=_rgb(value.mean), emission_texture=texture if emits else None)
    elif what == "opacity":
        threshold = evaluated.threshold
        if texture is None:
            opacity = float(value.mean[0])
            opacity = float(opacity >= threshold) if threshold > 0.0 else opacity
            material = replace(material, opacity=opacity, cutoff=0.0, opacity_texture=None)
        else:
            material = replace(
                material, opacity=float(value.mean[0]), cutoff=min(threshold, 1.0), opacity_texture=texture
            )
    else:
        material = replace(material, normal_texture=texture)
    fields = {name: None if name == what else value for name, value in evaluated.fields.items()}
    return EvaluatedMaterial(
        material,
        fields.get("albedo"),
        fields.get("emission"),
        fields.get("opacity"),
        fields.get("normal"),
        evaluated.threshold,
        evaluated.displacement,
    )


def _with_bounded_border(value: ShadingValue) -> ShadingValue:
    """The value with its border clamped to the range of its pixels, at least [0, 1]."""
    top = max(value.highest, 0.0)
    return ShadingValue(value.pixels, np.clip(value.outside, 0.0, max(top, 1.0)), value.mapping, value.key, value.name)


def _rgb(channels: Floats) -> Color:
    red, green, blue = np.broadcast_to(channels, 3).tolist()
    return red, green, blue


def _value_text(value: ShadingValue) -> str:
    if value.mapping is not None:
        return f"of {value.name}"
    return "(" + ", ".join(f"{c:g}" for c in value.mean) + ")"
