"""UsdLux lights as `Light` records with their final radiance.

    L = intensity · 2^exposure · color · blackbody(colorTemperature) · diffuse · texture · shaping / sizeFactor

sizeFactor is 1 unless `normalize` is on. Then it is the world-space area (for a distant light the projected solid
angle), so that the power does not depend on the size. metersPerUnit does not enter.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from pxr import Usd, UsdGeom, UsdLux

from warp_ir.scene import MAX_RADIANCE, Color, Floats, Light, LightKind
from warp_ir.usd.images.asset import read_texture
from warp_ir.usd.images.cache import inherited_color_space
from warp_ir.usd.images.latlong import LAYOUTS, to_latlong
from warp_ir.usd.lights.inputs import LightInputs
from warp_ir.usd.lights.shaping import read_shaping
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable
from warp_ir.usd.values.source_color_space import color_space, rgb_conversion_matrix

LIGHTS = {
    "RectLight": LightKind.RECT,
    "DiskLight": LightKind.DISK,
    "SphereLight": LightKind.SPHERE,
    "CylinderLight": LightKind.CYLINDER,
    "DistantLight": LightKind.DISTANT,
    "DomeLight": LightKind.DOME,
    "DomeLight_1": LightKind.DOME,
}
"""The light schemas that are read, by their kind."""

_DELTA_ANGLE = 1e-5
"""Full angle [degrees] of a distant light below which it is a delta light."""
_LINE_RADIUS = 1e-4
"""Radius, relative to the length, of the cylinder that approximates a line light."""
_MAX_TEXELS = {LightKind.RECT: 2**20, LightKind.DOME: 2**23}
"""Maximum number of texels: what diffuse surfaces resolve, and for domes a sun of half a degree."""
_MAX_TEXEL_VALUE = 1e12


def unnormalized_radiance(inputs: LightInputs) -> Floats:
    """The product intensity · 2^exposure · color · blackbody · diffuse, before normalisation; float64 [3].

    Raises:
        Unreadable: An input has the wrong type or is not finite.
    """
    intensity = inputs.number("intensity", 50000.0 if inputs.prim.IsA(UsdLux.DistantLight) else 1.0)
    tint = np.array(read.color(inputs.attribute("color"), inputs.time, (1.0, 1.0, 1.0)))
    if inputs.flag("enableColorTemperature"):
        kelvin = min(max(inputs.number("colorTemperature", 6500.0), 1000.0), 10000.0)
        tint = tint * np.array(UsdLux.BlackbodyTemperatureAsRgb(kelvin))
    exposure = min(inputs.number("exposure", 0.0), 1000.0)  # 2.0**1024 raises OverflowError
    radiance: Floats = intensity * 2.0**exposure * inputs.number("diffuse", 1.0) * tint
    checked_radiance(radiance)
    if radiance.min() < 0.0:
        inputs.warn("negative emission clamped to 0")
        radiance = np.maximum(radiance, 0.0)
    return radiance


def read_light(
    prim: Usd.Prim, kind: LightKind, matrices: Floats, time: Usd.TimeCode, report: Report
) -> tuple[Light, ...]:
    """The records of a light in all its instances; those that emit nothing are skipped.

    Args:
        prim: A prim of a schema in `LIGHTS`.
        kind: Its kind.
        matrices: world_from_light, [k, 4, 4].
        time: Time code of all values.
        report: Receives warnings.

    Raises:
        Unreadable: An input has the wrong type or is not finite.
    """
    inputs = LightInputs(prim, time, report)
    radiance = unnormalized_radiance(inputs)
    warn_unsupported(inputs)
    if radiance.max() == 0.0:
        return ()
    first = Light(
        str(prim.GetPath()),
        kind,
        checked_radiance(radiance),
        texture=light_texture(inputs, kind),
        shaping=read_shaping(inputs, kind),
        shadows=shadows_enabled(inputs),
    )
    builder = _LightBuilder(inputs, first, radiance)
    lights = (builder.at(matrix) for matrix in matrices)
    return tuple(light for light in lights if light is not None)


class _LightBuilder:
    """Builds the records of a light's instances from inputs that are read once.

    Args:
        inputs: The inputs of the light.
        light: The record of all instances, without transform and size.
        radiance: The radiance before normalisation, float64 [3].
    """

    def __init__(self, inputs: LightInputs, light: Light, radiance: Floats) -> None:
        self._inputs, self._light, self._radiance = inputs, light, radiance
        prim, time, kind = inputs.prim, inputs.time, light.kind
        self._brightest = 1.0 if light.texture is None else max(float(light.texture.max()), 1.0)
        self._size = {
            name: abs(inputs.number(name, default)) for name, default in _DEFAULT_DIMENSIONS.get(kind, {}).items()
        }
        self._normalize = inputs.flag("normalize")
        self._as_point = kind == LightKind.SPHERE and read.flag(prim.GetAttribute("treatAsPoint"), time)
        self._as_line = kind == LightKind.CYLINDER and read.flag(prim.GetAttribute("treatAsLine"), time)
        self._angle = min(max(inputs.number("angle", 0.53), 0.0), 360.0) if kind == LightKind.DISTANT else 0.0

    def at(self, matrix: Floats) -> Light | None:
        """The light with a transform world_from_light, [4, 4]; None: it emits nothing."""
        light = replace(self._light, world_from_light=matrix)
        placed: Light | None = light
        if light.kind == LightKind.DOME:
            pole = _dome_from_pole(self._inputs)
            placed = light if light.texture is None else replace(light, world_from_light=matrix @ pole)
        elif light.kind == LightKind.DISTANT:
            placed = self._distant(light)
        else:
            placed = self._area_light(light)
        if placed is not None:
            checked_radiance(np.array(placed.radiance) * self._brightest)
        return placed

    def _distant(self, light: Light) -> Light:
        """A distant light, normalised by its projected solid angle."""
        angle, radiance = self._angle, self._radiance
        solid_angle = projected_solid_angle(angle)
        if angle < _DELTA_ANGLE:
            angle = 0.0
            radiance = radiance if self._normalize else radiance * solid_angle  # of a delta light: its irradiance
        elif self._normalize:
            radiance = radiance / solid_angle
        return replace(light, radiance=checked_radiance(radiance), angle=angle)

    def _area_light(self, light: Light) -> Light | None:
        """A light with an area, or the limit of one: a point light, or a thin cylinder for a line light."""
        inputs, kind, size = self._inputs, light.kind, dict(self._size)
        radiance, normalize = self._radiance, self._normalize
        matrix = light.world_from_light
        area = _AREA[kind](matrix, size)
        if self._as_point or (kind == LightKind.SPHERE and size["radius"] == 0.0):
            if area == 0.0 and not normalize:
                inputs.warn("a sphere light of radius 0 emits nothing; rendered as if 'normalize' were on")
            # A sphere of area A has the intensity L A / 4 in every direction, whatever its radius.
            intensity = radiance * (1.0 if normalize or area == 0.0 else area) / 4.0
            return replace(light, kind=LightKind.POINT, radiance=checked_radiance(intensity))
        if self._as_line or (kind == LightKind.CYLINDER and normalize and size["radius"] == 0.0):
            # A thin cylinder of the same power; the error is below what any receiver off the light resolves.
            power = 1.0 if normalize or area == 0.0 else area
            size["radius"] = _LINE_RADIUS * size["length"]
            area = _AREA[kind](matrix, size)
            radiance, normalize = radiance * power, True
        if not (math.isfinite(area) and area > 0.0):
            inputs.warn("its shape has no area, so it emits nothing")
            return None
        if normalize:
            radiance = radiance / area
        return replace(
            light,
            radiance=checked_radiance(radiance),
            width=size.get("width", 1.0),
            height=size.get("height", 1.0),
            radius=size.get("radius", 0.5),
            length=size.get("length", 1.0),
        )


def light_texture(inputs: LightInputs, kind: LightKind) -> Floats | None:
    """The texture that multiplies a light's radiance, float32 [h, w, 3], as `Light` takes it; None: it has none."""
    asset = inputs.asset("texture:file")
    if asset is None:
        return None
    if kind not in (LightKind.RECT, LightKind.DOME):
        inputs.warn("only RectLight and DomeLight have textures; this one is ignored")
        return None
    layout = inputs.text("texture:format", "automatic") if kind == LightKind.DOME else "latlong"
    if layout not in ("automatic", "latlong", *LAYOUTS):
        inputs.warn(f"texture:format: '{layout}' is unknown; it is read as latlong")
    attribute = inputs.attribute("texture:file")
    space = str(attribute.GetColorSpace() or "auto")
    try:
        image = read_texture(asset, space, _MAX_TEXELS[kind])
        inherited = inherited_color_space(attribute, image) if space == "auto" else ""
        image = read_texture(asset, inherited, _MAX_TEXELS[kind]) if inherited else image
        primaries = color_space(inherited or space)
        pixels = to_latlong(image.rgb, layout) if layout in LAYOUTS else image.rgb
    except Unreadable as trouble:
        inputs.warn(f"texture:file: {trouble}; its constant colour is used")
        return None
    if primaries is not None:
        pixels = pixels @ rgb_conversion_matrix(primaries, None).T.astype(np.float32)
    return np.clip(pixels, 0.0, _MAX_TEXEL_VALUE)


def _dome_from_pole(inputs: LightInputs) -> Floats:
    """dome_from_texture, [4, 4]; the pole of a texture is +Y, and that of DomeLight_1 may be +Z (poleAxis)."""
    axis = read.text(inputs.prim.GetAttribute("poleAxis"), inputs.time, "Y")
    if axis == "scene":
        axis = str(UsdGeom.GetStageUpAxis(inputs.prim.GetStage()))
    if axis != "Z":
        return np.eye(4)
    return np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def projected_solid_angle(angle: float) -> float:
    """Irradiance of a surface facing a distant light of radiance 1 and this full angle [degrees]; 1 for angle 0."""
    theta = math.radians(min(max(0.5 * angle, 0.0), 180.0))
    if theta == 0.0:
        return 1.0
    sine2 = math.sin(theta) ** 2
    return math.pi * (sine2 if theta <= 0.5 * math.pi else 2.0 - sine2)


def shadows_enabled(inputs: LightInputs) -> bool:
    """Whether the light casts shadows, by ShadowAPI's shadow:enable.

    Raises:
        Unreadable: shadow:enable has the wrong type.
    """
    return not inputs.applied(UsdLux.ShadowAPI, "shadow:enable") or inputs.flag("shadow:enable", True)


def warn_unsupported(inputs: LightInputs) -> None:
    """Warns of inputs and filters of a light that are not supported.

    Raises:
        Unreadable: An input has the wrong type or is not finite.
    """
    prim = inputs.prim
    if prim.HasAPI(UsdLux.ShadowAPI):
        color = read.color(inputs.attribute("shadow:color"), inputs.time, (0.0, 0.0, 0.0))
        if any(color) or inputs.number("shadow:distance", -1.0) >= 0.0:
            inputs.warn("colour, distance and falloff of shadows are not supported: shadows are black and unlimited")
    legacy = prim.GetRelationship("filters")
    if read.targets(UsdLux.LightAPI(prim).GetFiltersRel()) or (legacy and read.targets(legacy)):
        inputs.warn("light filters are not supported")


def checked_radiance(radiance: Floats) -> Color:
    """A radiance [3] as a tuple.

    Raises:
        Unreadable: It is not finite, or too large, for example after division by a tiny area.
    """
    if not np.abs(radiance).max() < MAX_RADIANCE:
        raise Unreadable(f"its emission exceeds {MAX_RADIANCE:g}")
    red, green, blue = radiance.tolist()
    return red, green, blue


_DEFAULT_DIMENSIONS: dict[LightKind, dict[str, float]] = {
    LightKind.RECT: {"width": 1.0, "height": 1.0},
    LightKind.DISK: {"radius": 0.5},
    LightKind.SPHERE: {"radius": 0.5},
    LightKind.CYLINDER: {"length": 1.0, "radius": 0.5},
}


def _axes(matrix: Floats) -> tuple[float, float, float]:
    x, y, z = np.linalg.norm(matrix[:3, :3], axis=0).tolist()
    return x, y, z


def _rect_area(matrix: Floats, size: dict[str, float]) -> float:
    return float(np.linalg.norm(np.cross(size["width"] * matrix[:3, 0], size["height"] * matrix[:3, 1])))


def _disk_area(matrix: Floats, size: dict[str, float]) -> float:
    x, y, _ = _axes(matrix)
    area: float = math.pi * size["radius"] ** 2 * x * y
    return area


def _sphere_area(matrix: Floats, size: dict[str, float]) -> float:
    """Thomsen's formula for the area of an ellipsoid, exact for a sphere."""
    a, b, c = (size["radius"] * axis for axis in _axes(matrix))
    mean: float = (((a * b) ** 1.6 + (a * c) ** 1.6 + (b * c) ** 1.6) / 3.0) ** (1.0 / 1.6)
    return 4.0 * math.pi * mean


def _cylinder_area(matrix: Floats, size: dict[str, float]) -> float:
    """Area of the side without caps, with Ramanujan's perimeter of an ellipse, exact for a circle."""
    x, y, z = _axes(matrix)
    a, b = size["radius"] * y, size["radius"] * z
    perimeter = math.pi * (3.0 * (a + b) - math.sqrt((3.0 * a + b) * (a + 3.0 * b)))
    area: float = size["length"] * x * perimeter
    return area


_AREA: dict[LightKind, Callable[[Floats, dict[str, float]], float]] = {
    LightKind.RECT: _rect_area,
    LightKind.DISK: _disk_area,
    LightKind.SPHERE: _sphere_area,
    LightKind.CYLINDER: _cylinder_area,
}
