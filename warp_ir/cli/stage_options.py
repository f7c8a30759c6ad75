"""The stage that a command is about: the scene in it, and what only the stage itself knows."""

import argparse
from typing import Any

from warp_ir.cli.import_guard import importing


def open_reader(args: argparse.Namespace) -> Any:
    """The `StageReader` that the flags of the group "stage" want.

    Raises:
        InputError: The stage cannot be opened.
    """
    with importing():
        from warp_ir.usd.load import StageReader

    return StageReader(
        args.stage,
        camera=args.camera,
        eye=args.eye,
        look_at=args.look_at,
        purposes=None if args.purposes is None else tuple(dict.fromkeys(("default", *args.purposes))),
        complexity=args.complexity,
        default_light=args.default_light,
        metals=args.metals,
        texture_wrap=args.texture_wrap,
        strict=args.strict,
        render_settings=args.render_settings,
        render_pass=args.render_pass,
        mask=args.mask,
        variants=args.variants,
        session_layer=args.session_layer,
        motion_blur=getattr(args, "motion_blur", args.command != "vpls"),
    )


def moment_of(args: argparse.Namespace) -> float | str | None:
    """The moment that the flags want, of a single picture."""
    return "default" if args.default_time else args.time


def stage_facts(reader: Any, moment: float | str | None = None) -> dict[str, Any]:
    """Axis, unit, frames, cameras and settings: what a renderer does not need to know, and a user might.

    Args:
        reader: A `StageReader`.
        moment: What is shown, as for its `read`.
    """
    from pxr import UsdRender

    from warp_ir.usd.camera_prim import all_cameras
    from warp_ir.usd.settings.render_spec import render_settings_prims
    from warp_ir.usd.stage.open import quiet_diagnostics, time_code, up_axis
    from warp_ir.usd.values.report import Report

    stage = reader.stage
    with quiet_diagnostics():
        spec = reader.spec(moment)
        code = time_code(stage, moment)
        frames = [stage.GetStartTimeCode(), stage.GetEndTimeCode()] if stage.HasAuthoredTimeCodeRange() else None
        return {
            "up_axis": up_axis(stage, Report(reader.source)),  # what it says, the reader has said
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


def _meters_per_unit(stage: Any) -> float:
    """Of the stage's metadata, which files also hold as another type: USD refuses those."""
    from pxr import Tf, UsdGeom

    try:
        return float(UsdGeom.GetStageMetersPerUnit(stage))
    except Tf.ErrorException:
        stored = stage.GetMetadata("metersPerUnit")
        return float(stored) if isinstance(stored, int | float) else 0.01
