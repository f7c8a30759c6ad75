"""The stage that a command is about: the scene in it, and what only the stage itself knows."""

import argparse
from typing import Any

import warp_ir as ir
from warp_ir.scene import Scene


def load_scene(args: argparse.Namespace, time: float | None) -> Scene:
    """The scene at a time code, as the flags of the group "stage" want it.

    Raises:
        InputError: It cannot be loaded.
    """
    scene: Scene = ir.load_usd(
        args.stage,
        camera=args.camera,
        time=time,
        purposes=tuple(dict.fromkeys(("default", *args.purposes))),
        complexity=args.complexity,
        default_light=args.default_light,
        metals=args.metals,
        texture_wrap=args.texture_wrap,
        strict=args.strict,
    )
    return scene


def stage_facts(path: str) -> dict[str, Any]:
    """Axis, unit, frames and cameras: what a renderer does not need to know, and a user might."""
    from pxr import UsdGeom

    from warp_ir.usd.report import Report
    from warp_ir.usd.stage import open_stage, quiet, up_axis

    report = Report(path)  # what it says, `load_scene` has said
    with quiet():
        stage = open_stage(path, report)
        frames = [stage.GetStartTimeCode(), stage.GetEndTimeCode()] if stage.HasAuthoredTimeCodeRange() else None
        return {
            "up_axis": up_axis(stage, report),
            "meters_per_unit": float(UsdGeom.GetStageMetersPerUnit(stage)),
            "frames": frames,
            "cameras": [str(prim.GetPath()) for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera)],
        }
