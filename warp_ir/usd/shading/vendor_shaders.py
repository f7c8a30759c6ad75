"""Vendors' surface shaders, approximated by base colour, emission and opacity of a diffuse surface.

OmniPBR and OmniSurface are MDL materials by NVIDIA. Their inputs and defaults follow the Omniverse materials reference.
Their emission is a radiant exitance (radiance times pi), MDL's default. `mdl.py` finds them in .mdl files that call
them with arguments. All other shaders are read by input names that are common among renderers.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from pxr import Sdf, UsdLux, UsdShade

from warp_ir.scene import Color, Floats
from warp_ir.usd.images.shading_value import ShadingValue, as_color, combine, constant
from warp_ir.usd.shading.mdl import MdlCall, read_mdl_call

_BLACK: Color = (0.0, 0.0, 0.0)
_GREY: Color = (0.18, 0.18, 0.18)
_WHITE: Color = (1.0, 1.0, 1.0)


class ShaderInputs(Protocol):
    """Evaluates the inputs of a shader."""

    def has(self, name: str) -> bool:
        """Whether an input has a value or a connection."""

    def color(self, name: str, default: Color) -> ShadingValue:
        """An input as a colour, [..., 3]."""

    def scalar(self, name: str, default: float) -> ShadingValue:
        """An input as one channel."""

    def number(self, name: str, default: float) -> float:
        """An input as a number; the mean if an image is connected."""

    def pair(self, name: str, default: float) -> tuple[float, float]:
        """An input as two numbers."""

    def token(self, name: str) -> str:
        """An input as a token; numbers are converted to text."""

    def image(self, name: str, channels: list[int], uv: str, transform: Floats, *, color: bool) -> ShadingValue | None:
        """The image that an input names or is connected to; None: it has none that can be read."""

    def image_file(
        self, asset: Sdf.AssetPath, channels: list[int], space: str, uv: str, transform: Floats
    ) -> ShadingValue | None:
        """The image of a file; None: it cannot be read."""

    def warn(self, what: str) -> None:
        """Warns, naming the material."""


class _InputsWithArguments:
    """The inputs of a shader, with the arguments of an MDL call as defaults.

    Args:
        inputs: The authored inputs, which override the arguments.
        call: The call in the shader's .mdl file.
    """

    def __init__(self, inputs: ShaderInputs, call: MdlCall) -> None:
        self._inputs, self._call = inputs, call
        self.warn, self.image_file = inputs.warn, inputs.image_file

    def _numbers(self, name: str) -> tuple[float, ...] | None:
        return None if self._inputs.has(name) else self._call.numbers.get(name)

    def has(self, name: str) -> bool:
        return self._inputs.has(name) or name in {**self._call.numbers, **self._call.files, **self._call.constants}

    def color(self, name: str, default: Color) -> ShadingValue:
        numbers = self._numbers(name)
        return self._inputs.color(name, default) if numbers is None else as_color(constant(*numbers))

    def scalar(self, name: str, default: float) -> ShadingValue:
        numbers = self._numbers(name)
        return self._inputs.scalar(name, default) if numbers is None else constant(numbers[0])

    def number(self, name: str, default: float) -> float:
        numbers = self._numbers(name)
        return self._inputs.number(name, default) if numbers is None else numbers[0]

    def pair(self, name: str, default: float) -> tuple[float, float]:
        numbers = self._numbers(name)
        return self._inputs.pair(name, default) if numbers is None else (numbers[0], numbers[-1])

    def token(self, name: str) -> str:
        return self._inputs.token(name) or self._call.constants.get(name, "")

    def image(self, name: str, channels: list[int], uv: str, transform: Floats, *, color: bool) -> ShadingValue | None:
        if self._inputs.has(name) or name not in self._call.files:
            return self._inputs.image(name, channels, uv, transform, color=color)
        asset, space = self._call.files[name]
        return self.image_file(asset, channels, space if color else "raw", uv, transform)


@dataclass(frozen=True)
class SurfaceParameters:
    """The parameters of a surface that a vendor's shader provides."""

    albedo: ShadingValue
    """Base colour, of metals as well."""
    metallic: ShadingValue
    emission: ShadingValue
    """Emitted radiance."""
    opacity: ShadingValue
    threshold: float = 0.0
    """Opacity below which the surface is cut out, if positive."""
    normal: ShadingValue | None = None
    """In tangent space, not normalised; None: there is no normal map."""


def shader_name(shader: UsdShade.Shader) -> str:
    """The id of a shader; of one with a source asset its sub-identifier or file name; "" if it has neither."""
    identifier = str(shader.GetShaderId() or "")
    for kind in () if identifier else shader.GetSourceTypes():
        asset = shader.GetSourceAsset(kind)
        identifier = str(shader.GetSourceAssetSubIdentifier(kind) or "").partition("(")[0]
        identifier = identifier or (asset.path.rsplit("/", 1)[-1] if asset else "")
    return identifier


_Reader = Callable[[ShaderInputs], SurfaceParameters | None]
"""Reads the parameters of a surface from a shader's inputs; None: it finds no base colour."""


def vendor_reader(shader: UsdShade.Shader) -> _Reader | None:
    """The function that reads a shader, chosen by its name or by inputs that only it has; None: it is unknown."""
    name = shader_name(shader)
    asset = shader.GetSourceAsset("mdl")
    call = read_mdl_call(asset, name) if asset and not shader.GetShaderId() else None
    read = None if call is None else _mdl_reader(call.name)
    if call is not None and read is not None:
        return _with_arguments(read, call)
    input_names = {str(port.GetBaseName()) for port in shader.GetInputs()}
    if (read := _mdl_reader(name)) is not None:
        return read
    if input_names & _OMNI_PBR:
        return _omni_pbr
    if input_names & _OMNI_SURFACE:
        return _omni_surface
    if name in _CONSTANT_SHADERS:
        return _constant_shader
    return _by_common_names if input_names & {row[0] for row in _BASE_COLOR_INPUTS} else None


def _with_arguments(read: _Reader, call: MdlCall) -> _Reader:
    """The reader, with the arguments of a call as defaults."""
    return lambda inputs: read(_InputsWithArguments(inputs, call))


def _mdl_reader(name: str) -> _Reader | None:
    """The function that reads an MDL material of this name; None: it is unknown."""
    known = {"OmniPBR": _omni_pbr, "OmniSurface": _omni_surface}
    return next((read for start, read in known.items() if name.startswith(start)), None)


_OMNI_PBR = {"diffuse_color_constant", "diffuse_texture", "diffuse_tint", "reflection_roughness_constant"}
_OMNI_SURFACE = {"diffuse_reflection_color", "diffuse_reflection_weight"}


def _omni_pbr(inputs: ShaderInputs) -> SurfaceParameters:
    """OmniPBR: an albedo map replaces the constant colour; brightness, offset and desaturation apply to the map."""
    uv, uv_transform, projected = _omni_coordinates(inputs)

    def texture(name: str, channels: list[int], *, color: bool) -> ShadingValue | None:
        value = inputs.image(name, channels, uv, uv_transform, color=color)
        if value is None or not projected:
            return value
        inputs.warn("projected textures (project_uvw) are replaced by their means ({n} materials)")
        return constant(*value.mean.tolist())

    rgb = [0, 1, 2]
    albedo = texture("diffuse_texture", rgb, color=True)
    if albedo is None:
        albedo = inputs.color("diffuse_color_constant", (0.2, 0.2, 0.2))
    else:
        scale, offset = inputs.number("albedo_brightness", 1.0), inputs.number("albedo_add", 0.0)
        desaturation = inputs.number("albedo_desaturation", 0.0)

        def adjusted(pixels: Floats) -> Floats:
            bright = np.asarray(pixels * scale + offset)
            return np.asarray(bright + desaturation * (bright.mean(axis=-1, keepdims=True) - bright))

        if (scale, offset, desaturation) != (1.0, 0.0, 0.0):
            albedo = combine(("albedo", scale, offset, desaturation), adjusted, albedo)
    if inputs.has("diffuse_tint"):
        albedo = combine("tint", np.multiply, albedo, inputs.color("diffuse_tint", _WHITE))
    metallic = inputs.scalar("metallic_constant", 0.0)
    packed = inputs.number("enable_ORM_texture", 0.0) > 0.5
    image = texture("ORM_texture", [2], color=False) if packed else texture("metallic_texture", [0], color=False)
    influence = 1.0 if packed else inputs.number("metallic_texture_influence", 0.0)
    if image is not None and influence > 0.0:
        metallic = combine(("metallic", influence), lambda a, b: a + (b - a) * influence, metallic, image)
    emission = constant(*_BLACK)
    if inputs.number("enable_emission", 0.0) > 0.5:
        emission = texture("emissive_color_texture", rgb, color=True) or inputs.color("emissive_color", (1.0, 0.1, 0.1))
        mask = texture("emissive_mask_texture", rgb, color=True)
        emission = emission if mask is None else combine("mask", np.multiply, emission, mask)
        emission = _scaled_by(emission, inputs.number("emissive_intensity", 40.0) / math.pi)
    opacity, threshold = constant(1.0), 0.0
    if inputs.number("enable_opacity", 0.0) > 0.5:
        opacity, threshold = inputs.scalar("opacity_constant", 1.0), inputs.number("opacity_threshold", 0.0)
        if inputs.number("enable_opacity_texture", 0.0) > 0.5:
            alpha = inputs.token("opacity_mode") in ("mono_alpha", "0")
            image = texture("opacity_texture", [3] if alpha else rgb, color=False)
            opacity = opacity if image is None else combine("mono", lambda a: a.mean(axis=-1, keepdims=True), image)
    normal = texture("normalmap_texture", rgb, color=False)
    if normal is not None:
        # OmniPBR expects normal maps in DirectX convention unless flip_tangent_v is false.
        factor = inputs.number("bump_factor", 1.0)
        x = -factor if inputs.number("flip_tangent_u", 0.0) > 0.5 else factor
        y = -factor if inputs.number("flip_tangent_v", 1.0) > 0.5 else factor
        normal = combine(("normal", x, y), lambda n: (2.0 * n - 1.0) * np.array([x, y, 1.0]), normal)
    return SurfaceParameters(albedo, metallic, emission, opacity, threshold, normal)


def _omni_coordinates(inputs: ShaderInputs) -> tuple[str, Floats, bool]:
    """The set of texture coordinates, their transform [3, 3], and whether textures are projected instead."""
    index = round(inputs.number("uv_space_index", 0.0))
    angle = math.radians(inputs.number("texture_rotate", 0.0))
    cosine, sine = math.cos(angle), math.sin(angle)
    (sx, sy), (x, y) = inputs.pair("texture_scale", 1.0), inputs.pair("texture_translate", 0.0)
    uv_transform = np.array([[sx * cosine, -sx * sine, x], [sy * sine, sy * cosine, y], [0.0, 0.0, 1.0]])
    return f"st_{index}" if index > 0 else "st", uv_transform, inputs.number("project_uvw", 0.0) > 0.5


def _omni_surface(inputs: ShaderInputs) -> SurfaceParameters:
    """OmniSurface, OmniSurfaceBase and OmniSurfaceLite: diffuse reflection, emission and opacity."""
    texture = inputs.image("diffuse_reflection_color_image", [0, 1, 2], "st", np.eye(3), color=True)
    albedo = texture or inputs.color("diffuse_reflection_color", _WHITE)
    albedo = combine("weight", np.multiply, albedo, inputs.scalar("diffuse_reflection_weight", 0.8))
    emission = constant(*_BLACK)
    weight = inputs.number("emission_weight", 0.0)
    if weight > 0.0:
        emission = inputs.color("emission_color", _WHITE)
        if inputs.number("emission_use_temperature", 0.0) > 0.5:
            kelvin = min(max(inputs.number("emission_temperature", 6500.0), 1000.0), 10000.0)
            emission = constant(*UsdLux.BlackbodyTemperatureAsRgb(kelvin))
        luminance = inputs.token("emission_mode") in ("emission_nt", "0")
        scale = weight * inputs.number("emission_intensity", 1.0)
        emission = _scaled_by(emission, scale if luminance else scale / math.pi)
    enabled = inputs.number("enable_opacity", 0.0) > 0.5
    opacity = inputs.scalar("geometry_opacity", 1.0) if enabled else constant(1.0)
    threshold = inputs.number("geometry_opacity_threshold", 0.0) if enabled else 0.0
    return SurfaceParameters(albedo, inputs.scalar("metalness", 0.0), emission, opacity, threshold)


_CONSTANT_SHADERS = {
    "arnold:flat": "color",
    "PxrConstant": "emitColor",
    "ND_realitykit_unlit_surfaceshader": "color",
}
"""Shaders of constant radiance without reflection, with the input for the colour."""


def _constant_shader(inputs: ShaderInputs) -> SurfaceParameters:
    """A surface that emits a colour and reflects nothing."""
    name = next((name for name in _CONSTANT_SHADERS.values() if inputs.has(name)), "color")
    return SurfaceParameters(constant(*_BLACK), constant(0.0), inputs.color(name, _WHITE), constant(1.0))


_BASE_COLOR_INPUTS = (
    ("base_color", "base", 1.0),
    ("baseColor", "", 1.0),
    ("basecolor", "", 1.0),
    ("base_color_factor", "", 1.0),
    ("base_color_texture", "", 1.0),
    ("diffuseColor", "diffuseGain", 1.0),
    ("diffuse_color", "", 1.0),
    ("diffColor", "", 1.0),
    ("Kd_color", "Kd", 1.0),
    ("diffuse", "", 1.0),
    ("albedo", "", 1.0),
    ("color", "", 1.0),
)
"""Inputs for the base colour, each with the input for its weight and the weight's default; the first present wins."""
_EMISSION_INPUTS = (
    ("emission_color", "emission", 0.0),
    ("glowColor", "glowGain", 0.0),
    ("emitColor", "", 1.0),
    ("emissive_factor", "emissive_strength", 1.0),
    ("emissiveColor", "", 1.0),
    ("emissive", "", 1.0),
)
"""Inputs for the emission, in the same form."""


def _by_common_names(inputs: ShaderInputs) -> SurfaceParameters | None:
    """Any shader, by commonly used input names; None: it has no base colour."""
    albedo = _first_input(inputs, _BASE_COLOR_INPUTS, _GREY)
    if albedo is None:
        return None
    if inputs.has("base_color_factor") and inputs.has("base_color_texture"):
        albedo = combine("factor", np.multiply, albedo, inputs.color("base_color_texture", _WHITE))
    metallic = next((name for name in ("metalness", "metallic", "metallic_factor") if inputs.has(name)), "metallic")
    opacity = next((name for name in ("opacity", "presence", "alpha", "base_alpha") if inputs.has(name)), "opacity")
    return SurfaceParameters(
        albedo,
        inputs.scalar(metallic, 0.0),
        _first_input(inputs, _EMISSION_INPUTS, _BLACK) or constant(*_BLACK),
        inputs.scalar(opacity, 1.0),
    )


def _first_input(
    inputs: ShaderInputs, rows: tuple[tuple[str, str, float], ...], fallback: Color
) -> ShadingValue | None:
    """The first present input times its weight; None: none is present. `fallback` replaces what cannot be evaluated."""
    for color, weight, default in rows:
        if inputs.has(color):
            value = inputs.color(color, fallback)
            return combine("weight", np.multiply, value, inputs.scalar(weight, default)) if weight else value
    return None


def _scaled_by(value: ShadingValue, factor: float) -> ShadingValue:
    return combine(("times", factor), lambda a: a * factor, value)
