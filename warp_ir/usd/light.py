"""UsdLux lights to `Light` records with their final radiance.

    L = intensity · 2^exposure · color · blackbody(colorTemperature) · diffuse / sizeFactor

with sizeFactor = 1 unless `normalize`, where it is the world-space area (for a distant light the projected
solid angle), so that the power no longer depends on the size. Nothing is multiplied by metersPerUnit.
"""

import math
from collections.abc import Callable

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdLux

from warp_ir.scene import Color, Floats, Light, LightKind
from warp_ir.usd import value
from warp_ir.usd.report import Report, Unreadable

LIGHTS = {
    "RectLight": LightKind.RECT,
    "DiskLight": LightKind.DISK,
    "SphereLight": LightKind.SPHERE,
    "CylinderLight": LightKind.CYLINDER,
    "DistantLight": LightKind.DISTANT,
    "DomeLight": LightKind.DOME,
    "DomeLight_1": LightKind.DOME,
}
"""The schemas this module reads."""

BRIGHTEST = 1e30
"""Radiance beyond this is a mistake in the file, and overflows float32 when it is squared or summed."""
_PARALLEL = 1e-5
"""Full angle [degrees] of a distant light below which it is taken as parallel."""
_THIN = 1e-3
"""Radius, as a part of the length, of the cylinder that stands for a line."""


class Inputs:
    """A light's inputs; files from before USD 21.02 have them without the prefix ``inputs:``.

    Args:
        prim: With LightAPI.
        time: Of the values.
        report: Where troubles go.
    """

    def __init__(self, prim: Usd.Prim, time: Usd.TimeCode, report: Report) -> None:
        self.prim, self.time, self._report = prim, time, report
        # On a gprim `radius` and the like are geometry.
        self._may_be_old = not prim.IsA(UsdGeom.Gprim)

    def attribute(self, name: str) -> Usd.Attribute:
        """The attribute that holds an input."""
        current = self.prim.GetAttribute(f"inputs:{name}")
        old = self.prim.GetAttribute(name)
        if self._may_be_old and old and old.HasAuthoredValue() and not (current and current.HasAuthoredValue()):
            self.warn("inputs authored in the old style, without 'inputs:', are used")
            return old
        return current

    def number(self, name: str, default: float) -> float:
        """A number input."""
        return value.number(self.attribute(name), self.time, default)

    def flag(self, name: str) -> bool:
        """A truth value; False by default, as everywhere in UsdLux."""
        return value.flag(self.attribute(name), self.time)

    def warn(self, what: str) -> None:
        """Say something about the light."""
        self._report.warn(self.prim.GetPath(), what)


def emission(inputs: Inputs) -> Floats:
    """Product intensity · 2^exposure · color · blackbody · diffuse, before any normalisation; float64 [3].

    Raises:
        Unreadable: An input has the wrong type or is not finite.
    """
    intensity = inputs.number("intensity", 50000.0 if inputs.prim.IsA(UsdLux.DistantLight) else 1.0)
    tint = np.array(value.color(inputs.attribute("color"), inputs.time, (1.0, 1.0, 1.0)))
    if inputs.flag("enableColorTemperature"):
        kelvin = min(max(inputs.number("colorTemperature", 6500.0), 1000.0), 10000.0)
        tint = tint * np.array(UsdLux.BlackbodyTemperatureAsRgb(kelvin))
    exposure = min(inputs.number("exposure", 0.0), 1000.0)  # beyond, 2.0**x raises
    radiance: Floats = intensity * 2.0**exposure * inputs.number("diffuse", 1.0) * tint
    as_color(radiance)
    if radiance.min() < 0.0:
        inputs.warn("negative emission clamped to 0")
        radiance = np.maximum(radiance, 0.0)
    return radiance


def read_light(prim: Usd.Prim, kind: LightKind, matrix: Floats, time: Usd.TimeCode, report: Report) -> Light | None:
    """The record of a light; None if it emits nothing.

    Args:
        prim: A light of one of `LIGHTS`.
        kind: Its kind.
        matrix: world_from_light, [4, 4].
        time: Of the values.
        report: Where troubles go.

    Raises:
        Unreadable: An input has the wrong type or is not finite.
    """
    inputs = Inputs(prim, time, report)
    radiance = emission(inputs)
    warn_of_unread(inputs, kind)
    if radiance.max() == 0.0:
        return None
    if kind == LightKind.DOME:
        return Light(str(prim.GetPath()), kind, as_color(radiance), matrix)
    if kind == LightKind.DISTANT:
        return _distant_light(inputs, radiance, matrix)
    return _area_light(inputs, kind, radiance, matrix)


def _distant_light(inputs: Inputs, radiance: Floats, matrix: Floats) -> Light:
    name, normalize = str(inputs.prim.GetPath()), inputs.flag("normalize")
    angle = min(max(inputs.number("angle", 0.53), 0.0), 360.0)
    solid_angle = projected_solid_angle(angle)
    if angle < _PARALLEL:
        angle, radiance = 0.0, radiance if normalize else radiance * solid_angle  # now an irradiance
    elif normalize:
        radiance = radiance / solid_angle
    return Light(name, LightKind.DISTANT, as_color(radiance), matrix, angle=angle)


def _area_light(inputs: Inputs, kind: LightKind, radiance: Floats, matrix: Floats) -> Light | None:
    prim, time, name = inputs.prim, inputs.time, str(inputs.prim.GetPath())
    size = {name: abs(inputs.number(name, default)) for name, default in _DIMENSIONS[kind].items()}
    area = _AREA[kind](matrix, size)
    as_point = kind == LightKind.SPHERE and value.flag(prim.GetAttribute("treatAsPoint"), time)
    as_line = kind == LightKind.CYLINDER and value.flag(prim.GetAttribute("treatAsLine"), time)
    normalize = inputs.flag("normalize")
    if as_point or (kind == LightKind.SPHERE and size["radius"] == 0.0):
        if area == 0.0 and not normalize:
            inputs.warn("a sphere light of radius 0 emits nothing; rendered as if 'normalize' were on")
        # A sphere of area A has the intensity L A / 4 in every direction, whatever its radius.
        intensity = radiance * (1.0 if normalize or area == 0.0 else area) / 4.0
        return Light(name, LightKind.POINT, as_color(intensity), matrix)
    if as_line or (kind == LightKind.CYLINDER and normalize and size["radius"] == 0.0):
        inputs.warn("a line light is rendered as a thin cylinder of the same power")
        power = 1.0 if normalize or area == 0.0 else area
        size["radius"] = _THIN * size["length"]
        area = _AREA[kind](matrix, size)
        radiance, normalize = radiance * power, True
    if not (math.isfinite(area) and area > 0.0):
        inputs.warn("its shape has no area, so it emits nothing")
        return None
    if normalize:
        radiance = radiance / area
    return Light(name, kind, as_color(radiance), matrix, **size)


def projected_solid_angle(angle: float) -> float:
    """Irradiance of a surface that faces a distant light of radiance 1 and this full angle [degrees]; 1 for 0."""
    theta = math.radians(min(max(0.5 * angle, 0.0), 180.0))
    if theta == 0.0:
        return 1.0
    sine2 = math.sin(theta) ** 2
    return math.pi * (sine2 if theta <= 0.5 * math.pi else 2.0 - sine2)


def warn_of_unread(inputs: Inputs, kind: LightKind | None) -> None:
    """Name what a light asks for and this loader does not read yet.

    Args:
        inputs: Of the light.
        kind: None for a gprim that emits.
    """
    prim, time = inputs.prim, inputs.time
    if _names_file(inputs.attribute("texture:file"), time):
        inputs.warn("light textures are not read yet: it emits its constant colour")
    if prim.HasAPI(UsdLux.ShapingAPI) and _is_shaped(inputs, kind):
        inputs.warn("shaping (cone, focus, IES) is not read yet: it emits in all directions")
    if prim.HasAPI(UsdLux.ShadowAPI) and not value.flag(prim.GetAttribute("inputs:shadow:enable"), time, True):
        inputs.warn("inputs:shadow:enable = false is not read yet: it casts shadows")
    light = UsdLux.LightAPI(prim)
    for name, collection in (
        ("lightLink", light.GetLightLinkCollectionAPI()),
        ("shadowLink", light.GetShadowLinkCollectionAPI()),
    ):
        everything = value.flag(collection.GetIncludeRootAttr(), time, True)
        if not everything or collection.GetExcludesRel().HasAuthoredTargets():
            inputs.warn(f"{name} is not read yet: it concerns everything")
    if light.GetFiltersRel().HasAuthoredTargets():
        inputs.warn("light filters are not read yet")
    if prim.GetRelationship("portals").HasAuthoredTargets():
        inputs.warn("portals are not read yet; they would only guide the sampling")


def _is_shaped(inputs: Inputs, kind: LightKind | None) -> bool:
    """Whether ShapingAPI changes anything: flat lights emit into a hemisphere anyway."""
    whole = 90.0 if kind in (LightKind.RECT, LightKind.DISK) else 180.0
    return (
        inputs.number("shaping:cone:angle", 90.0) < whole
        or inputs.number("shaping:cone:softness", 0.0) > 0.0
        or inputs.number("shaping:focus", 0.0) > 0.0
        or _names_file(inputs.attribute("shaping:ies:file"), inputs.time)
    )


def _names_file(attribute: Usd.Attribute, time: Usd.TimeCode) -> bool:
    asset = value.raw(attribute, time)
    return isinstance(asset, Sdf.AssetPath) and asset.path != ""


def as_color(radiance: Floats) -> Color:
    """A radiance [3] as a tuple.

    Raises:
        Unreadable: It is not finite, or so large that a tiny area must have divided it.
    """
    if not np.abs(radiance).max() < BRIGHTEST:
        raise Unreadable(f"its emission exceeds {BRIGHTEST:g}")
    red, green, blue = radiance.tolist()
    return red, green, blue


_DIMENSIONS: dict[LightKind, dict[str, float]] = {
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
    """Thomsen's formula for an ellipsoid, exact for a sphere."""
    a, b, c = (size["radius"] * axis for axis in _axes(matrix))
    mean: float = (((a * b) ** 1.6 + (a * c) ** 1.6 + (b * c) ** 1.6) / 3.0) ** (1.0 / 1.6)
    return 4.0 * math.pi * mean


def _cylinder_area(matrix: Floats, size: dict[str, float]) -> float:
    """Of the side alone; Ramanujan's perimeter of an ellipse, exact for a circle."""
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
