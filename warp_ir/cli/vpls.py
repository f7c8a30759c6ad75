"""`warp-ir vpls`: writes the virtual point lights as a picture, as points of a USD stage, or as arrays."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

import warp_ir as ir
from warp_ir.cli.arguments import settings_of
from warp_ir.cli.console import muted_stderr, say, say_warnings
from warp_ir.cli.device_choice import open_device
from warp_ir.cli.stage_options import open_reader, stage_facts, time_code_of
from warp_ir.image.io import check_output, whole_file
from warp_ir.scene import InputError, Scene

if TYPE_CHECKING:
    from pxr import Vt

    from warp_ir.vpl.trace import Vpls


def run(args: argparse.Namespace) -> int:
    """Traces the light paths of one iteration and writes their VPLs; returns the exit code."""
    if args.iteration < 0:
        raise InputError(f"--iteration: must be at least 0, is {args.iteration}")
    settings = settings_of(args)
    path = check_output(args.output, (".png", ".usda", ".npz"), make_folder=args.make_output_path)
    device = open_device(args.device, verbose=args.verbose)
    reader = open_reader(args)
    scene = reader.read(time_code_of(args))
    if not args.quiet:
        say_warnings(scene.warnings, everything=args.verbose)
    vpls = ir.trace_vpls(scene, settings, device=device, iteration=args.iteration)
    suffix = path.suffix.lower()
    if suffix == ".npz":
        _write_arrays(path, vpls)
    elif suffix == ".usda":
        write_points(path, scene, vpls, stage_facts(reader))
    else:
        from warp_ir.preview import picture_vpls

        with muted_stderr(not args.verbose):
            picture_vpls(scene, vpls, path, view=args.view, width=settings.width, height=settings.height)
    if not args.quiet:
        directional = int(np.count_nonzero(vpls.directional))
        addition = f", {directional} of them directional" if directional else ""
        print(f"{path}: {len(vpls.positions)} VPLs{addition}")
        if directional and suffix == ".usda":
            say(f"{directional} directional VPLs (sun and sky) have no position and are left out")
    return 0


def _write_arrays(path: Path, vpls: "Vpls") -> None:
    names = ("positions", "normals", "intensity", "bounce", "directional")
    with whole_file(path) as temporary:
        np.savez_compressed(temporary, **{name: getattr(vpls, name) for name in names})


def write_points(path: Path, scene: Scene, vpls: "Vpls", facts: Mapping[str, Any]) -> None:
    """Writes the VPLs that have a position as UsdGeom.Points.

    displayColor is the colour of the intensity, and widths grow with its square root. Primvars hold the exact
    `intensity` [W sr⁻¹] and `bounce`. Positions are in world space, with the unit and the up axis of the stage, so that
    the file can be layered over it.

    Args:
        path: The .usda file.
        scene: The scene of the VPLs.
        vpls: The VPLs.
        facts: `stage_facts` of the stage; `up_axis` and `meters_per_unit` are used.
    """
    from pxr import Sdf, Usd, UsdGeom, Vt

    local = ~np.asarray(vpls.directional, dtype=bool)
    intensity = np.asarray(vpls.intensity, dtype=np.float64)[local]
    peak = intensity.max(axis=1, initial=0.0)
    relative = peak / max(float(peak.max(initial=0.0)), 1e-300)
    widths = 0.02 * (scene.extent or 1.0) * np.clip(np.sqrt(relative), 0.1, 1.0)

    def vectors(values: npt.NDArray[Any]) -> "Vt.Vec3fArray":
        return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32))

    out = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(out, facts["up_axis"])
    UsdGeom.SetStageMetersPerUnit(out, facts["meters_per_unit"])
    points = UsdGeom.Points.Define(out, "/VPLs")
    out.SetDefaultPrim(points.GetPrim())
    out.SetMetadata("comment", f"virtual point lights of {scene.name}")
    points.CreatePointsAttr(vectors(np.asarray(vpls.positions)[local]))
    points.CreateNormalsAttr(vectors(np.asarray(vpls.normals)[local]))
    points.CreateWidthsAttr(Vt.FloatArray.FromNumpy(widths.astype(np.float32)))
    points.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
    colors = points.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
    colors.Set(vectors(intensity / np.maximum(peak, 1e-300)[:, None]))
    primvars = UsdGeom.PrimvarsAPI(points)
    exact = primvars.CreatePrimvar("intensity", Sdf.ValueTypeNames.Float3Array, UsdGeom.Tokens.vertex)
    exact.Set(vectors(intensity))
    bounce = np.asarray(vpls.bounce)[local].astype(np.int32)
    primvars.CreatePrimvar("bounce", Sdf.ValueTypeNames.IntArray, UsdGeom.Tokens.vertex).Set(
        Vt.IntArray.FromNumpy(bounce)
    )
    points.CreateExtentAttr(UsdGeom.Boundable.ComputeExtentFromPlugins(points, Usd.TimeCode.Default()))
    with whole_file(path) as temporary:
        temporary.write_text(out.GetRootLayer().ExportToString(), encoding="utf-8")
