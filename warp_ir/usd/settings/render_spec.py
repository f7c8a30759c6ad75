"""What a stage wants of a render: its RenderSettings prim, products and variables (UsdRender)."""

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
from warp_ir.usd.values.source_color_space import color_space

_OURS = "warp_ir:"
"""Namespace of attributes that are fields of `RenderSettings`."""
_FIELDS = {f.name: f for f in fields(RenderSettings)}
_COLOR = {"color", "ci", "c", "beauty", "rgba", "rgb"}
"""Names of the picture itself."""
_AOVS = {
    **dict.fromkeys(("alpha", "a", "opacity"), "alpha"),
    **dict.fromkeys(("depth", "z", "cameradepth", "lineardepth"), "depth"),
    **dict.fromkeys(("normal", "n", "nn", "neye", "normals"), "normal"),
    **dict.fromkeys(("position", "p", "peye"), "position"),
    **dict.fromkeys(("albedo", "diffuse_albedo", "diffusealbedo"), "albedo"),
    **{name: name for name in ("direct", "indirect")},
    **dict.fromkeys(("primid", "prim_id", "id"), "prim_id"),
}
"""What other renderers call the AOVs that a film has, in lower case."""


@dataclass(frozen=True)
class Product:
    """A picture that the stage wants."""

    path: str = ""
    """Of the RenderProduct; "" if the settings have none."""
    name: str = ""
    """Of the file, without a folder: a stage does not say where to write."""
    camera: str = ""
    """Path of its camera; "" if none is named."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Fields of `RenderSettings`."""
    aovs: tuple[str, ...] = ()
    """What it wants beside the colour."""


@dataclass(frozen=True)
class RenderSpec:
    """What the stage's RenderSettings ask for."""

    path: str = ""
    """Of the prim; "" if the stage has none."""
    purposes: tuple[str, ...] | None = None
    """What to draw, if that is authored."""
    material_purposes: tuple[str, ...] = PURPOSES[:2]
    """Of the bindings of materials, in the order in which they are wanted."""
    products: tuple[Product, ...] = (Product(),)
    """At least one."""


def read_render_spec(stage: Usd.Stage, name: str | None, time: Usd.TimeCode, report: Report) -> RenderSpec:
    """The settings that are named, else those of the stage's metadata, else the first there are.

    Args:
        stage: The stage.
        name: Path of a RenderSettings prim; None to choose.
        time: Of the values.
        report: Where troubles and guesses go.

    Raises:
        InputError: There are no settings of that name.
    """
    chosen = _choose(stage, name, report)
    if chosen is None:
        return RenderSpec()
    base = {**_fields(chosen, time, report, everything=True), **_color_space(chosen, time, report)}
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
                {**base, **_fields(prim, time, report, everything=False)},
                _aovs(stage, prim, time, report),
            )
        )
    purposes = UsdRender.Settings(chosen).GetIncludedPurposesAttr()
    names = read.tokens(purposes, time) if purposes.HasAuthoredValue() else []
    known = tuple(name for name in names if name in UsdGeom.Imageable.GetOrderedPurposeTokens())
    bindings = UsdRender.Settings(chosen).GetMaterialBindingPurposesAttr()
    looks = read.tokens(bindings, time) if bindings.HasAuthoredValue() else PURPOSES[:2]
    # The schema calls "" so in a sentence, and many files quote it.
    looks = ["" if name == "allPurpose" else name for name in looks]
    if strange := [name for name in looks if name and not Sdf.Path.IsValidIdentifier(name)]:
        report.warn(chosen.GetPath(), f"materialBindingPurposes: {strange} cannot be purposes and are ignored")
    return RenderSpec(
        str(chosen.GetPath()),
        known or None,
        tuple(name for name in looks if name not in strange),
        tuple(products) or (Product(camera=camera, settings=base),),
    )


def render_settings_prims(stage: Usd.Stage) -> list[Usd.Prim]:
    """All RenderSettings of a stage."""
    return [prim for prim in stage.Traverse() if prim.IsA(UsdRender.Settings)]


def _choose(stage: Usd.Stage, name: str | None, report: Report) -> Usd.Prim | None:
    there = render_settings_prims(stage)
    if name is not None:
        found = next((prim for prim in there if name in (str(prim.GetPath()), prim.GetName())), None)
        if found is None:
            paths = ", ".join(str(prim.GetPath()) for prim in there) or "none"
            raise InputError(f"{report.source}: no render settings '{name}'; available: {paths}")
        return found
    wanted = stage.GetMetadata("renderSettingsPrimPath") if stage.HasAuthoredMetadata("renderSettingsPrimPath") else ""
    if wanted:
        found = next((prim for prim in there if str(prim.GetPath()) == str(wanted)), None)
        if found is not None:
            return found
        report.warn("/", f"renderSettingsPrimPath {wanted} is not a RenderSettings prim of the stage")
    if len(there) > 1:
        report.warn(there[0].GetPath(), f"used because they are the first of {len(there)} render settings")
    return there[0] if there else None


def _camera(prim: Usd.Prim, report: Report) -> str:
    """The camera that settings or a product name."""
    for path in read.targets(UsdRender.SettingsBase(prim).GetCameraRel()):
        target = prim.GetStage().GetPrimAtPath(path)
        if target and target.IsA(UsdGeom.Camera):
            return str(path)
        report.warn(prim.GetPath(), f"its camera {path} is not a camera of the stage")
    return ""


def _fields(prim: Usd.Prim, time: Usd.TimeCode, report: Report, *, everything: bool) -> dict[str, Any]:
    """Fields of `RenderSettings` that a prim sets: of a product only what is authored, of settings fallbacks too."""
    base = UsdRender.SettingsBase(prim)
    wanted: dict[str, Any] = {}

    def take(attribute: Usd.Attribute, *names: str) -> None:
        if everything or attribute.HasAuthoredValue():
            found = read.raw(attribute, time)
            parts = tuple(found) if isinstance(found, Gf.Vec2i | Gf.Vec4f) else (found,)
            for name, part in zip(names, parts if len(names) > 1 else (found,), strict=False):
                _accept(wanted, name, part, attribute, report)

    take(base.GetResolutionAttr(), "width", "height")
    take(base.GetPixelAspectRatioAttr(), "pixel_aspect")
    take(base.GetAspectRatioConformPolicyAttr(), "conform")
    take(base.GetDataWindowNDCAttr(), "data_window")
    for attribute, name in (
        (base.GetInstantaneousShutterAttr(), "motion_blur"),
        (base.GetDisableMotionBlurAttr(), "motion_blur"),
        (base.GetDisableDepthOfFieldAttr(), "depth_of_field"),
    ):
        if attribute.HasAuthoredValue():
            wanted[name] = not read.flag(attribute, time) and wanted.get(name, True)
    for attribute in prim.GetAuthoredPropertiesInNamespace(_OURS):
        if isinstance(attribute, Usd.Attribute):
            name = _snake(attribute.GetName().removeprefix(_OURS))
            if name not in _FIELDS:
                report.warn(prim.GetPath(), f"{attribute.GetName()} is no setting of warp_ir")
            else:
                _accept(wanted, name, read.raw(attribute, time), attribute, report)
    return wanted


def _accept(wanted: dict[str, Any], name: str, found: Any, attribute: Usd.Attribute, report: Report) -> None:
    """Notes a value if it is a possible one."""
    if isinstance(found, Gf.Vec4f | Gf.Vec4d):
        found = tuple(round(float(x), 7) for x in found)  # authored in decimals, stored in binary
    if isinstance(found, float) and not isinstance(_FIELDS[name].default, bool) and name == "pixel_aspect":
        found = round(found, 7)
    try:
        RenderSettings(**{name: found})
    except (InputError, TypeError) as trouble:
        reason = str(trouble).partition(": ")[2] or f"is a {type(found).__name__}"
        report.warn(attribute.GetPrim().GetPath(), f"{attribute.GetName()} {reason}; the default is used")
        return
    if isinstance(_FIELDS[name].default, bool):
        found = bool(found)
    wanted[name] = found


def _snake(name: str) -> str:
    """`lightPaths` or `light_paths` -> `light_paths`."""
    return re.sub(r"(?<=[a-z])([A-Z])", lambda match: "_" + match[1].lower(), name)


def _aovs(stage: Usd.Stage, product: Usd.Prim, time: Usd.TimeCode, report: Report) -> tuple[str, ...]:
    """The AOVs that a product's orderedVars name, the colour apart."""
    found: dict[str, None] = {}
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
        if name in _COLOR:
            continue
        if name in _AOVS:
            found[_AOVS[name]] = None
        else:
            unknown[path] = f"'{source}'"
    for path in unknown:
        report.warn(path, f"there is no variable {', '.join(dict.fromkeys(unknown.values()))} to write; left out")
    return tuple(found)


def _file_name(product: Usd.Prim, time: Usd.TimeCode, report: Report) -> str:
    """The product's name without its folder; the prim's name if it has none."""
    try:
        authored = str(read.raw(UsdRender.Product(product).GetProductNameAttr(), time) or "")
    except Tf.ErrorException:
        authored = ""
    base = PureWindowsPath(PurePosixPath(authored).name).name
    if base != authored and base:
        report.warn(product.GetPath(), f"of productName '{authored}' only '{base}' counts: a stage names no folders")
    base = "".join(letter for letter in base if letter.isprintable()).strip()
    if base in ("", ".", ".."):
        base = product.GetName()
    return base if PurePosixPath(base).suffix else f"{base}.exr"


def _color_space(settings: Usd.Prim, time: Usd.TimeCode, report: Report) -> dict[str, Any]:
    """The field of `RenderSettings` that renderingColorSpace sets: the colour space of what is written."""
    name = read.text(UsdRender.Settings(settings).GetRenderingColorSpaceAttr(), time)
    try:
        space = color_space(name)
    except Unreadable as trouble:
        report.warn(settings.GetPath(), f"renderingColorSpace: {trouble}; linear Rec. 709 is used")
        return {}
    if space is None:
        return {}
    if space.GetName() not in COLOR_SPACES:
        report.warn(settings.GetPath(), f"renderingColorSpace '{name}' is not linear, or not known; Rec. 709 is used")
        return {}
    report.warn(
        settings.GetPath(),
        f"renderingColorSpace '{name}': light is computed in Rec. 709, linear pictures are converted",
    )
    return {"color_space": str(space.GetName())}
