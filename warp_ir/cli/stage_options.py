"""Opens the stage that a command works on, and reads what the `Scene` does not hold of it."""

import argparse
from typing import TYPE_CHECKING, Any

from warp_ir.cli.frames import TimeCode
from warp_ir.cli.import_guard import importing

if TYPE_CHECKING:
    from pxr import Usd

    from warp_ir.usd import StageReader


def open_reader(args: argparse.Namespace) -> "StageReader":
    """Opens the stage as the flags of the group "stage" say.

    Raises:
        InputError: The stage cannot be opened, or a flag does not fit it.
    """
    with importing():
        from warp_ir.usd.load import StageReader

    return StageReader(args.stage, **reader_options(args))


def reader_options(args: argparse.Namespace) -> dict[str, Any]:
    """The keyword arguments of `StageReader` that the flags stand for: plain values."""
    return dict(
        camera=args.camera,
        eye=args.eye,
        look_at=args.look_at,
        purposes=None if args.purposes is None else tuple(dict.fromkeys(("default", *args.purposes))),
        complexity=args.complexity,
        default_light=args.default_light,
        metals=args.metals,
        materials=args.materials,
        texture_wrap=args.texture_wrap,
        strict=args.strict,
        render_settings=args.render_settings,
        render_pass=args.render_pass,
        mask=args.mask,
        variants=args.variants,
        session_layer=args.session_layer,
        motion_blur=getattr(args, "motion_blur", args.command not in ("vpls", "view")),
    )


def time_code_of(args: argparse.Namespace) -> TimeCode:
    """The time code of a single picture that the flags ask for."""
    return "default" if args.default_time else args.time


def frames_per_second(reader: "StageReader") -> float | None:
    """The rate at which the stage's frames are played: its framesPerSecond, or else its timeCodesPerSecond.

    None: it authors neither, or what no rate can be.
    """
    for name in ("framesPerSecond", "timeCodesPerSecond"):
        if reader.stage.HasAuthoredMetadata(name):
            rate = reader.stage.GetMetadata(name)
            return float(rate) if isinstance(rate, int | float) and 0.0 < rate < 1.0e6 else None
    return None


def stage_facts(reader: "StageReader", time: TimeCode = None) -> dict[str, Any]:
    """Up axis, unit, frames, cameras and render settings of a stage, as plain values for JSON.

    Args:
        reader: Reader of the stage.
        time: Time code at which the render settings are read.
    """
    from pxr import UsdRender

    from warp_ir.usd.camera_prim import all_cameras
    from warp_ir.usd.settings.render_spec import render_settings_prims
    from warp_ir.usd.stage.open import quiet_diagnostics, time_code, up_axis
    from warp_ir.usd.values.report import Report

    stage = reader.stage
    with quiet_diagnostics():
        spec = reader.spec(time)
        code = time_code(stage, time)
        frames = [stage.GetStartTimeCode(), stage.GetEndTimeCode()] if stage.HasAuthoredTimeCodeRange() else None
        return {
            "up_axis": up_axis(stage, Report(reader.source)),  # the reader has already reported its warnings
            "meters_per_unit": _meters_per_unit(stage),
            "frames": frames,
            "time": None if code.IsDefault() else code.GetValue(),
            "cameras": [str(prim.GetPath()) for prim in all_cameras(stage)],
            "render_passes": [str(prim.GetPath()) for prim in stage.Traverse() if prim.IsA(UsdRender.Pass)],
            "render_settings": {
                "used": spec.path,
                "all": [str(prim.GetPath()) for prim in render_settings_prims(stage)],
                "purposes": None if spec.purposes is None else list(spec.purposes),
                "material_purposes": list(spec.material_purposes),
                "products": [
                    {
                        "path": product.path,
                        "name": product.name,
                        "camera": product.camera,
                        "settings": dict(product.settings),
                        "aovs": list(product.aovs),
                    }
                    for product in spec.products
                    if spec.path
                ],
            },
        }


def _meters_per_unit(stage: "Usd.Stage") -> float:
    """The stage's metersPerUnit. USD raises an error where a file stores it with an unexpected type."""
    from pxr import Tf, UsdGeom

    try:
        return float(UsdGeom.GetStageMetersPerUnit(stage))
    except Tf.ErrorException:
        stored = stage.GetMetadata("metersPerUnit")
        return float(stored) if isinstance(stored, int | float) else 0.01
