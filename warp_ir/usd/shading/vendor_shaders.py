"""Surface shaders of other renderers, as far as a diffuse surface shows them: base colour, glow and opacity.

OmniPBR and OmniSurface are MDL by NVIDIA; their inputs and defaults are those of the Omniverse materials reference, and
their emission is a radiant exitance, radiance times pi, as it is in MDL unless a material says otherwise. `mdl.py`
finds them in files that call them with arguments. Of any other shader those inputs count that renderers commonly
call so.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from pxr import Sdf, UsdLux, UsdShade

from warp_ir.scene import Color, Floats
from warp_ir.usd.images.shading_value import ShadingValue, as_color, combine, constant
from warp_ir.usd.shading.mdl import Call, read_call

_BLACK: Color = (0.0, 0.0, 0.0)
_GREY: Color = (0.18, 0.18, 0.18)
_WHITE: Color = (1.0, 1.0, 1.0)


class Inputs(Protocol):
    """The inputs of a shader, evaluated."""

    def has(self, name: str) -> bool:
        """Whether an input has a value or a connection."""

    def color(self, name: str, default: Color) -> ShadingValue:
        """A colour."""

    def grey(self, name: str, default: float) -> ShadingValue:
        """One channel."""

    def number(self, name: str, default: float) -> float:
        """A number."""

    def pair(self, name: str, default: float) -> tuple[float, float]:
        """Two numbers."""

    def word(self, name: str) -> str:
        """A token; a number in digits."""

    def picture(
        self, name: str, channels: list[int], uv: str, transform: Floats, *, color: bool
    ) -> ShadingValue | None:
        """The image that an input names; None where it names none."""

    def file(
        self, asset: Sdf.AssetPath, channels: list[int], space: str, uv: str, transform: Floats
    ) -> ShadingValue | None:
        """An image; None where it cannot be read."""

    def warn(self, what: str) -> None:
        """Say something about the material."""


class _Called:
    """The inputs of a shader whose defaults are the arguments of a `Call`.

    Args:
        inputs: Of the shader; what they have comes first.
        call: In the file that the shader is in.
    """

    def __init__(self, inputs: Inputs, call: Call) -> None:
        self._inputs, self._call = inputs, call
        self.warn, self.file = inputs.warn, inputs.file

    def _numbers(self, name: str) -> tuple[float, ...] | None:
        return None if self._inputs.has(name) else self._call.numbers.get(name)

    def has(self, name: str) -> bool:
        return self._inputs.has(name) or name in {**self._call.numbers, **self._call.files, **self._call.words}

    def color(self, name: str, default: Color) -> ShadingValue:
        found = self._numbers(name)
        return self._inputs.color(name, default) if found is None else as_color(constant(*found))

    def grey(self, name: str, default: float) -> ShadingValue:
        found = self._numbers(name)
        return self._inputs.grey(name, default) if found is None else constant(found[0])

    def number(self, name: str, default: float) -> float:
        found = self._numbers(name)
        return self._inputs.number(name, default) if found is None else found[0]

    def pair(self, name: str, default: float) -> tuple[float, float]:
        found = self._numbers(name)
        return self._inputs.pair(name, default) if found is None else (found[0], found[-1])

    def word(self, name: str) -> str:
        return self._inputs.word(name) or self._call.words.get(name, "")

    def picture(
        self, name: str, channels: list[int], uv: str, transform: Floats, *, color: bool
    ) -> ShadingValue | None:
        if self._inputs.has(name) or name not in self._call.files:
            return self._inputs.picture(name, channels, uv, transform, color=color)
        asset, space = self._call.files[name]
        return self.file(asset, channels, space if color else "raw", uv, transform)


@dataclass(frozen=True)
class Terms:
    """What a shader says of a surface."""

    albedo: ShadingValue
    """Of its base, metals included."""
    metallic: ShadingValue
    emission: ShadingValue
    """Radiance."""
    opacity: ShadingValue
    threshold: float = 0.0
    normal: ShadingValue | None = None
    """In tangent space, before it is normalised."""


def shader_name(shader: UsdShade.Shader) -> str:
    """The id of a shader; of one that is code in a file its name there, else the file's; "" if it has none."""
    identifier = str(shader.GetShaderId() or "")
    for kind in () if identifier else shader.GetSourceTypes():
        asset = shader.GetSourceAsset(kind)
        identifier = str(shader.GetSourceAssetSubIdentifier(kind) or "").partition("(")[0]
        identifier = identifier or (asset.path.rsplit("/", 1)[-1] if asset else "")
    return identifier


def reader_of(shader: UsdShade.Shader) -> Callable[[Inputs], Terms | None] | None:
    """What reads a shader, by its name or by inputs that only it has; None for one that nothing here is known of."""
    name = shader_name(shader)
    asset = shader.GetSourceAsset("mdl")
    call = read_call(asset, name) if asset and not shader.GetShaderId() else None
    called = None if call is None else _named(call.name)
    if call is not None and called is not None:
        return _with_arguments(called, call)
    given = {str(given.GetBaseName()) for given in shader.GetInputs()}
    if (read := _named(name)) is not None:
        return read
    if given & _OMNI_PBR:
        return _omni_pbr
    if given & _OMNI_SURFACE:
        return _omni_surface
    if name in _FLAT:
        return _flat
    return _by_names if given & {row[0] for row in _BASES} else None


def _with_arguments(read: Callable[[Inputs], Terms | None], call: Call) -> Callable[[Inputs], Terms | None]:
    return lambda inputs: read(_Called(inputs, call))


def _named(name: str) -> Callable[[Inputs], Terms | None] | None:
    """What reads the MDL materials of a name, if that is known."""
    known = {"OmniPBR": _omni_pbr, "OmniSurface": _omni_surface}
    return next((read for start, read in known.items() if name.startswith(start)), None)


_OMNI_PBR = {"diffuse_color_constant", "diffuse_texture", "diffuse_tint", "reflection_roughness_constant"}
_OMNI_SURFACE = {"diffuse_reflection_color", "diffuse_reflection_weight"}


def _omni_pbr(inputs: Inputs) -> Terms:
    """OmniPBR: an albedo map takes the place of the constant; brightness and the like are of the map."""
    uv, turn, projected = _omni_coordinates(inputs)

    def picture(name: str, channels: list[int], *, color: bool) -> ShadingValue | None:
        found = inputs.picture(name, channels, uv, turn, color=color)
        if found is None or not projected:
            return found
        inputs.warn("textures that are projected (project_uvw) count as their means ({n} materials)")
        return constant(*found.mean.tolist())

    rgb = [0, 1, 2]
    albedo = picture("diffuse_texture", rgb, color=True)
    if albedo is None:
        albedo = inputs.color("diffuse_color_constant", (0.2, 0.2, 0.2))
    else:
        scale, add = inputs.number("albedo_brightness", 1.0), inputs.number("albedo_add", 0.0)
        grey = inputs.number("albedo_desaturation", 0.0)

        def adjusted(texels: Floats) -> Floats:
            bright = np.asarray(texels * scale + add)
            return np.asarray(bright + grey * (bright.mean(axis=-1, keepdims=True) - bright))

        if (scale, add, grey) != (1.0, 0.0, 0.0):
            albedo = combine(("albedo", scale, add, grey), adjusted, albedo)
    if inputs.has("diffuse_tint"):
        albedo = combine("tint", np.multiply, albedo, inputs.color("diffuse_tint", _WHITE))
    metallic = inputs.grey("metallic_constant", 0.0)
    packed = inputs.number("enable_ORM_texture", 0.0) > 0.5
    image = picture("ORM_texture", [2], color=False) if packed else picture("metallic_texture", [0], color=False)
    share = 1.0 if packed else inputs.number("metallic_texture_influence", 0.0)
    if image is not None and share > 0.0:
        metallic = combine(("metallic", share), lambda a, b: a + (b - a) * share, metallic, image)
    emission = constant(*_BLACK)
    if inputs.number("enable_emission", 0.0) > 0.5:
        emission = picture("emissive_color_texture", rgb, color=True) or inputs.color("emissive_color", (1.0, 0.1, 0.1))
        mask = picture("emissive_mask_texture", rgb, color=True)
        emission = emission if mask is None else combine("mask", np.multiply, emission, mask)
        emission = _times(emission, inputs.number("emissive_intensity", 40.0) / math.pi)
    opacity, threshold = constant(1.0), 0.0
    if inputs.number("enable_opacity", 0.0) > 0.5:
        opacity, threshold = inputs.grey("opacity_constant", 1.0), inputs.number("opacity_threshold", 0.0)
        if inputs.number("enable_opacity_texture", 0.0) > 0.5:
            alpha = inputs.word("opacity_mode") in ("mono_alpha", "0")
            image = picture("opacity_texture", [3] if alpha else rgb, color=False)
            opacity = opacity if image is None else combine("mono", lambda a: a.mean(axis=-1, keepdims=True), image)
    normal = picture("normalmap_texture", rgb, color=False)
    if normal is not None:
        # Maps are DirectX's unless flip_tangent_v is false.
        factor = inputs.number("bump_factor", 1.0)
        x = -factor if inputs.number("flip_tangent_u", 0.0) > 0.5 else factor
        y = -factor if inputs.number("flip_tangent_v", 1.0) > 0.5 else factor
        normal = combine(("normal", x, y), lambda n: (2.0 * n - 1.0) * np.array([x, y, 1.0]), normal)
    return Terms(albedo, metallic, emission, opacity, threshold, normal)


def _omni_coordinates(inputs: Inputs) -> tuple[str, Floats, bool]:
    """The uv set, what is done to it, [3, 3], and whether there is none because textures are projected."""
    index = round(inputs.number("uv_space_index", 0.0))
    angle = math.radians(inputs.number("texture_rotate", 0.0))
    cosine, sine = math.cos(angle), math.sin(angle)
    (sx, sy), (x, y) = inputs.pair("texture_scale", 1.0), inputs.pair("texture_translate", 0.0)
    turn = np.array([[sx * cosine, -sx * sine, x], [sy * sine, sy * cosine, y], [0.0, 0.0, 1.0]])
    return f"st_{index}" if index > 0 else "st", turn, inputs.number("project_uvw", 0.0) > 0.5


def _omni_surface(inputs: Inputs) -> Terms:
    """OmniSurface, OmniSurfaceBase and OmniSurfaceLite."""
    texture = inputs.picture("diffuse_reflection_color_image", [0, 1, 2], "st", np.eye(3), color=True)
    albedo = texture or inputs.color("diffuse_reflection_color", _WHITE)
    albedo = combine("weight", np.multiply, albedo, inputs.grey("diffuse_reflection_weight", 0.8))
    emission = constant(*_BLACK)
    weight = inputs.number("emission_weight", 0.0)
    if weight > 0.0:
        emission = inputs.color("emission_color", _WHITE)
        if inputs.number("emission_use_temperature", 0.0) > 0.5:
            kelvin = min(max(inputs.number("emission_temperature", 6500.0), 1000.0), 10000.0)
            emission = constant(*UsdLux.BlackbodyTemperatureAsRgb(kelvin))
        luminance = inputs.word("emission_mode") in ("emission_nt", "0")
        scale = weight * inputs.number("emission_intensity", 1.0)
        emission = _times(emission, scale if luminance else scale / math.pi)
    enabled = inputs.number("enable_opacity", 0.0) > 0.5
    opacity = inputs.grey("geometry_opacity", 1.0) if enabled else constant(1.0)
    threshold = inputs.number("geometry_opacity_threshold", 0.0) if enabled else 0.0
    return Terms(albedo, inputs.grey("metalness", 0.0), emission, opacity, threshold)


_FLAT = {"arnold:flat": "color", "PxrConstant": "emitColor"}
"""Shaders that show a colour and reflect nothing."""


def _flat(inputs: Inputs) -> Terms:
    name = next((name for name in _FLAT.values() if inputs.has(name)), "color")
    return Terms(constant(*_BLACK), constant(0.0), inputs.color(name, _WHITE), constant(1.0))


_BASES = (
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
"""Inputs that hold a base colour, with that of its weight and what this is unless said; the first there is counts."""
_GLOWS = (
    ("emission_color", "emission", 0.0),
    ("glowColor", "glowGain", 0.0),
    ("emitColor", "", 1.0),
    ("emissive_factor", "emissive_strength", 1.0),
    ("emissiveColor", "", 1.0),
    ("emissive", "", 1.0),
)
"""The same for an emission."""


def _by_names(inputs: Inputs) -> Terms | None:
    """Whatever shader: the inputs that are commonly called so; None if it has no base colour."""
    albedo = _first(inputs, _BASES, _GREY)
    if albedo is None:
        return None
    if inputs.has("base_color_factor") and inputs.has("base_color_texture"):
        albedo = combine("factor", np.multiply, albedo, inputs.color("base_color_texture", _WHITE))
    metallic = next((name for name in ("metalness", "metallic", "metallic_factor") if inputs.has(name)), "metallic")
    opacity = next((name for name in ("opacity", "presence", "alpha", "base_alpha") if inputs.has(name)), "opacity")
    return Terms(
        albedo,
        inputs.grey(metallic, 0.0),
        _first(inputs, _GLOWS, _BLACK) or constant(*_BLACK),
        inputs.grey(opacity, 1.0),
    )


def _first(inputs: Inputs, rows: tuple[tuple[str, str, float], ...], unknown: Color) -> ShadingValue | None:
    """The first that there is, times its weight; `unknown` where what feeds it is not understood."""
    for color, weight, default in rows:
        if inputs.has(color):
            found = inputs.color(color, unknown)
            return combine("weight", np.multiply, found, inputs.grey(weight, default)) if weight else found
    return None


def _times(signal: ShadingValue, factor: float) -> ShadingValue:
    return combine(("times", factor), lambda a: a * factor, signal)
