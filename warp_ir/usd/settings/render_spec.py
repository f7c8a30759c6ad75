"""RenderSettings, RenderProduct and RenderVar prims (UsdRender) as records."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import PurePosixPath, PureWindowsPath
from typing import Any

from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdRender

from warp_ir.image.color_space import COLOR_SPACES
from warp_ir.scene import InputError
from warp_ir.settings import RenderSettings
from warp_ir.usd.shading.binding import PURPOSES
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable
from warp_ir.usd.values.source_color_space import ConfiguredSpace, color_space, decoder, space_name

_NAMESPACE = "warp_ir:"
"""Namespace of attributes that are fields of `RenderSettings`."""
_FIELDS = {f.name: f for f in fields(RenderSettings)}
_COLOR_NAMES = {"color", "ci", "c", "beauty", "rgba", "rgb"}
"""Names of RenderVars that mean the colour, in lower case."""
_AOVS = {
    **dict.fromkeys(("alpha", "a", "opacity"), "alpha"),
    **dict.fromkeys(("depth", "z", "cameradepth", "lineardepth"), "depth"),
    **dict.fromkeys(("normal", "n", "nn", "neye", "normals"), "normal"),
    **dict.fromkeys(("position", "p", "peye"), "position"),
    **dict.fromkeys(("albedo", "diffuse_albedo", "diffusealbedo"), "albedo"),
    **{name: name for name in ("direct", "indirect")},
    **dict.fromkeys(("primid", "prim_id", "id"), "prim_id"),
}
"""The AOVs of a film by names that renderers use for them, in lower case."""


@dataclass(frozen=True)
class Product:
    """A picture that a RenderProduct describes."""

    path: str = ""
    """Path of the RenderProduct; "" if the settings have none."""
    name: str = ""
    """Name of the file without its directory: a stage does not decide where files are written."""
    camera: str = ""
    """Path of its camera; "" if none is named."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Values for fields of `RenderSettings`."""
    aovs: tuple[str, ...] = ()
    """AOVs in addition to the colour."""


@dataclass(frozen=True)
class RenderSpec:
    """The content of a RenderSettings prim."""

    path: str = ""
    """Path of the prim; "" if the stage has none."""
    purposes: tuple[str, ...] | None = None
    """Purposes to draw; None: not authored."""
    material_purposes: tuple[str, ...] = PURPOSES[:2]
    """Purposes of material bindings, in order of preference."""
    products: tuple[Product, ...] = (Product(),)
    """The products, at least one."""


def read_render_spec(stage: Usd.Stage, name: str | None, time: Usd.TimeCode, report: Report) -> RenderSpec:
    """The named settings, else those that the stage's metadata name, else the first.

    Args:
        stage: The stage.
        name: Path or name of a RenderSettings prim; None to choose.
        time: Time code of all values.
        report: Receives warnings.

    Raises:
        InputError: There are no settings of that name.
    """
    chosen = _choose(stage, name, report)
    if chosen is None:
        return RenderSpec()
    base = {**_fields(chosen, time, report, fallbacks=True), **_color_space(chosen, time, report)}
    camera = _camera(chosen, report)
    products = []
    for path in read.targets(UsdRender.Settings(chosen).GetProductsRel()):
        prim = stage.GetPrimAtPath(path)
        if not prim or not prim.IsA(UsdRender.Product):
            report.warn(chosen.GetPath(), f"its product {path} is not a RenderProduct of the stage")
            continue
        kind = read.text(UsdRender.Product(prim).GetProductTypeAttr(), time, "raster")
        if kind != "raster":
            report.warn(path, f"productType '{kind}' is written as 'raster'")
        products.append(
            Product(
                str(path),
                _file_name(prim, time, report),
                _camera(prim, report) or camera,
                {**base, **_fields(prim, time, report, fallbacks=False)},
                _aovs(stage, prim, time, report),
            )
        )
    purposes = UsdRender.Settings(chosen).GetIncludedPurposesAttr()
    names = read.tokens(purposes, time) if purposes.HasAuthoredValue() else []
    known = tuple(name for name in names if name in UsdGeom.Imageable.GetOrderedPurposeTokens())
    bindings = UsdRender.Settings(chosen).GetMaterialBindingPurposesAttr()
    material_purposes = read.tokens(bindings, time) if bindings.HasAuthoredValue() else PURPOSES[:2]
    # The schema's documentation calls "" by this name, and files use it as a value.
    material_purposes = ["" if name == "allPurpose" else name for name in material_purposes]
    if invalid := [name for name in material_purposes if name and not Sdf.Path.IsValidIdentifier(name)]:
        report.warn(chosen.GetPath(), f"materialBindingPurposes: {invalid} are no purposes and are ignored")
    return RenderSpec(
        str(chosen.GetPath()),
        known or None,
        tuple(name for name in material_purposes if name not in invalid),
        tuple(products) or (Product(camera=camera, settings=base),),
    )


def render_settings_prims(stage: Usd.Stage) -> list[Usd.Prim]:
    """All RenderSettings prims of a stage."""
    return [prim for prim in stage.Traverse() if prim.IsA(UsdRender.Settings)]


def _choose(stage: Usd.Stage, name: str | None, report: Report) -> Usd.Prim | None:
    """The RenderSettings prim to use; None: the stage has none."""
    prims = render_settings_prims(stage)
    if name is not None:
        chosen = next((prim for prim in prims if name in (str(prim.GetPath()), prim.GetName())), None)
        if chosen is None:
            paths = ", ".join(str(prim.GetPath()) for prim in prims) or "none"
            raise InputError(f"{report.source}: no render settings '{name}'; available: {paths}")
        return chosen
    has_default = stage.HasAuthoredMetadata("renderSettingsPrimPath")
    if has_default and (default := str(stage.GetMetadata("renderSettingsPrimPath"))):
        chosen = next((prim for prim in prims if str(prim.GetPath()) == default), None)
        if chosen is not None:
            return chosen
        report.warn("/", f"renderSettingsPrimPath {default} is not a RenderSettings prim of the stage")
    if len(prims) > 1:
        report.warn(prims[0].GetPath(), f"used because they are the first of {len(prims)} render settings")
    return prims[0] if prims else None


def _camera(prim: Usd.Prim, report: Report) -> str:
    """Path of the camera that RenderSettings or a RenderProduct name; "" if there is none."""
    for path in read.targets(UsdRender.SettingsBase(prim).GetCameraRel()):
        target = prim.GetStage().GetPrimAtPath(path)
        if target and target.IsA(UsdGeom.Camera):
            return str(path)
        report.warn(prim.GetPath(), f"its camera {path} is not a camera of the stage")
    return ""


def _fields(prim: Usd.Prim, time: Usd.TimeCode, report: Report, *, fallbacks: bool) -> dict[str, Any]:
    """Fields of `RenderSettings` that a prim sets.

    Args:
        prim: A RenderSettings or RenderProduct prim.
        time: Time code of all values.
        report: Receives warnings.
        fallbacks: Whether the schema's fallbacks count; of a product only authored values override the settings.
    """
    base = UsdRender.SettingsBase(prim)
    settings: dict[str, Any] = {}

    def set_fields(attribute: Usd.Attribute, *names: str) -> None:
        if fallbacks or attribute.HasAuthoredValue():
            value = read.raw(attribute, time)
            parts = tuple(value) if isinstance(value, Gf.Vec2i | Gf.Vec4f) else (value,)
            for name, part in zip(names, parts if len(names) > 1 else (value,), strict=False):
                _set_field(settings, name, part, attribute, report)

    set_fields(base.GetResolutionAttr(), "width", "height")
    set_fields(base.GetPixelAspectRatioAttr(), "pixel_aspect")
    set_fields(base.GetAspectRatioConformPolicyAttr(), "conform")
    set_fields(base.GetDataWindowNDCAttr(), "data_window")
    for attribute, name in (
        (base.GetInstantaneousShutterAttr(), "motion_blur"),
        (base.GetDisableMotionBlurAttr(), "motion_blur"),
        (base.GetDisableDepthOfFieldAttr(), "depth_of_field"),
    ):
        if attribute.HasAuthoredValue():
            settings[name] = not read.flag(attribute, time) and settings.get(name, True)
    for attribute in prim.GetAuthoredPropertiesInNamespace(_NAMESPACE):
        if isinstance(attribute, Usd.Attribute):
            name = _snake_case(attribute.GetName().removeprefix(_NAMESPACE))
            if name not in _FIELDS:
                report.warn(prim.GetPath(), f"{attribute.GetName()} is not a setting of warp_ir")
            else:
                _set_field(settings, name, read.raw(attribute, time), attribute, report)
    return settings


def _set_field(settings: dict[str, Any], name: str, value: Any, attribute: Usd.Attribute, report: Report) -> None:
    """Sets a field if the value is valid; warns otherwise."""
    if isinstance(value, Gf.Vec4f | Gf.Vec4d):
        value = tuple(round(float(x), 7) for x in value)  # restores the authored decimals, which are stored as float32
    if isinstance(value, float) and not isinstance(_FIELDS[name].default, bool) and name == "pixel_aspect":
        value = round(value, 7)
    try:
        RenderSettings(**{name: value})
    except (InputError, TypeError) as trouble:
        reason = str(trouble).partition(": ")[2] or f"is a {type(value).__name__}"
        report.warn(attribute.GetPrim().GetPath(), f"{attribute.GetName()} {reason}; the default is used")
        return
    if isinstance(_FIELDS[name].default, bool):
        value = bool(value)
    settings[name] = value


def _snake_case(name: str) -> str:
    """`lightPaths` or `light_paths` -> `light_paths`."""
    return re.sub(r"(?<=[a-z])([A-Z])", lambda match: "_" + match[1].lower(), name)


def _aovs(stage: Usd.Stage, product: Usd.Prim, time: Usd.TimeCode, report: Report) -> tuple[str, ...]:
    """The AOVs that a product's orderedVars name, without the colour."""
    aovs: dict[str, None] = {}
    unknown: dict[Sdf.Path, str] = {}
    for path in read.targets(UsdRender.Product(product).GetOrderedVarsRel()):
        prim = stage.GetPrimAtPath(path)
        if not prim or not prim.IsA(UsdRender.Var):
            report.warn(product.GetPath(), f"its variable {path} is not a RenderVar of the stage")
            continue
        var = UsdRender.Var(prim)
        source = read.text(var.GetSourceNameAttr(), time) or prim.GetName()
        if read.text(var.GetSourceTypeAttr(), time, "raw") == "lpe":
            source = re.sub(r"^C\.\*$", "color", source.replace(" ", "").removeprefix("lpe:"))
        name = source.lower()
        if name in _COLOR_NAMES:
            continue
        if name in _AOVS:
            aovs[_AOVS[name]] = None
        else:
            unknown[path] = f"'{source}'"
    for path in unknown:
        report.warn(path, f"no AOV for the variable {', '.join(dict.fromkeys(unknown.values()))}; it is skipped")
    return tuple(aovs)


def _file_name(product: Usd.Prim, time: Usd.TimeCode, report: Report) -> str:
    """The file name of a product without its directory; the prim's name if there is none."""
    try:
        authored = str(read.raw(UsdRender.Product(product).GetProductNameAttr(), time) or "")
    except Tf.ErrorException:
        authored = ""
    base = PureWindowsPath(PurePosixPath(authored).name).name
    if base != authored and base:
        report.warn(product.GetPath(), f"only '{base}' of productName '{authored}' is used: directories are ignored")
    base = "".join(letter for letter in base if letter.isprintable()).strip()
    if base in ("", ".", ".."):
        base = product.GetName()
    return base if PurePosixPath(base).suffix else f"{base}.exr"


def _color_space(settings: Usd.Prim, time: Usd.TimeCode, report: Report) -> dict[str, Any]:
    """The field `color_space` that renderingColorSpace sets: the colour space of written pictures."""
    name = read.text(UsdRender.Settings(settings).GetRenderingColorSpaceAttr(), time)
    try:
        space = color_space(name)
    except Unreadable as trouble:
        report.warn(settings.GetPath(), f"renderingColorSpace: {trouble}; linear Rec. 709 is used")
        return {}
    if space is None:
        return {}
    known = space_name(space)
    if decoder(space) is not None or (known not in COLOR_SPACES and not isinstance(space, ConfiguredSpace)):
        report.warn(settings.GetPath(), f"renderingColorSpace '{name}' is unknown or not linear; Rec. 709 is used")
        return {}
    report.warn(
        settings.GetPath(),
        f"renderingColorSpace '{name}': light is computed in Rec. 709, linear pictures are converted",
    )
    return {"color_space": known}
