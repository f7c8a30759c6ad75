"""`warp-ir vpls`: writes the virtual point lights as a picture, a page, a model, USD, arrays, or an animation."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import warp_ir as ir
from warp_ir.cli.arguments import VPL_DRAWING, settings_of
from warp_ir.cli.console import muted_stderr, say, say_warnings, show_result
from warp_ir.cli.device_choice import open_device
from warp_ir.cli.stage_options import open_reader, stage_facts, time_code_of
from warp_ir.files import check_output, whole_file
from warp_ir.scene import InputError, Scene

if TYPE_CHECKING:
    from warp_ir.vpl.trace import Vpls

_DRAWN = (".png", ".html", ".gltf", ".gif", ".mp4")
_MOVING = (".gif", ".mp4")
_SUFFIXES = (*_DRAWN, ".usda", ".npz")


def run(args: argparse.Namespace) -> int:
    """Traces the light paths of one iteration and writes their VPLs; returns the exit code."""
    if args.iteration < 0:
        raise InputError(f"--iteration: must be at least 0, is {args.iteration}")
    settings = settings_of(args)
    path = check_output(args.output, _SUFFIXES, make_folder=args.make_output_path)
    suffix = path.suffix.lower()
    _refuse_idle_flags(args, suffix)
    device = open_device(args.device, verbose=args.verbose)
    reader = open_reader(args)
    scene = reader.read(time_code_of(args))
    say_warnings(scene.warnings, everything=args.verbose)
    vpls = ir.trace_vpls(scene, settings, device=device, iteration=args.iteration, contribution_to=args.contribution_to)
    if suffix == ".npz":
        _write_arrays(path, vpls)
    elif suffix == ".usda":
        from warp_ir.usd.vpl_layers import write_lights, write_points

        facts = stage_facts(reader)
        write = write_lights if args.as_lights else write_points
        write(path, scene, vpls, facts["up_axis"], facts["meters_per_unit"])
    else:
        with muted_stderr(not args.verbose):
            _draw(args, path, scene, vpls, settings)
    directional = int(np.count_nonzero(vpls.directional))
    addition = f", {directional} of them directional" if directional else ""
    show_result(f"{path}: {len(vpls.positions)} VPLs{addition}", quiet=args.quiet)
    if directional and suffix == ".usda" and not args.as_lights:
        say(f"{directional} directional VPLs (sun and sky) have no position and are left out")
    return 0


def _refuse_idle_flags(args: argparse.Namespace, suffix: str) -> None:
    """Raises `InputError` if a flag is given that does not change this kind of output."""
    given = {name: getattr(args, name) is not None for name in VPL_DRAWING}
    for name, is_given in given.items():
        works: Callable[[str], bool] = (lambda s: s in _MOVING) if name == "order" else (lambda s: s in _DRAWN)
        if is_given and not works(suffix):
            raise InputError(f"--{name.replace('_', '-')}: has no effect on {suffix}")
    if args.as_lights and suffix != ".usda":
        raise InputError(f"--as-lights: needs a .usda file, not {suffix}")
    if args.contribution_to is not None and suffix == ".usda":
        raise InputError("--contribution-to: has no effect on .usda")


def _draw(args: argparse.Namespace, path: Path, scene: Scene, vpls: "Vpls", settings: "ir.RenderSettings") -> None:
    """Writes what PyVista draws."""
    from warp_ir.preview import animate_vpls, picture_vpls, plotter, write_html, write_model

    options: dict[str, Any] = {
        name: getattr(args, name) for name in VPL_DRAWING if name != "order" and getattr(args, name) is not None
    }
    options |= {"width": settings.width, "height": settings.height}
    suffix = path.suffix.lower()
    if suffix == ".png":
        picture_vpls(scene, vpls, path, **options)
    elif suffix in _MOVING:
        animate_vpls(scene, vpls, path, order=args.order or "path", **options)
    else:
        plot = plotter(scene, vpls, **options, off_screen=True, notebook=False)
        try:
            (write_html if suffix == ".html" else write_model)(plot, path)
        finally:
            plot.close()


def _write_arrays(path: Path, vpls: "Vpls") -> None:
    """Writes all arrays of the VPLs that there are."""
    arrays = {name: value for name, value in vars(vpls).items() if value is not None}
    with whole_file(path) as temporary:
        np.savez_compressed(temporary, **arrays)
