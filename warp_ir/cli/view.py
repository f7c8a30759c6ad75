"""`warp-ir view`: a stage in a window, or in a browser, in which one moves around."""

import argparse
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

import warp_ir as ir
from warp_ir.cli.arguments import given_settings, settings_of
from warp_ir.cli.console import ProgressDisplay, say, say_warnings, show_result
from warp_ir.cli.device_choice import open_device
from warp_ir.cli.import_guard import importing
from warp_ir.cli.stage_options import open_reader, time_code_of
from warp_ir.files import check_output
from warp_ir.image.io import SUFFIXES
from warp_ir.view.access import check_address, check_display

if TYPE_CHECKING:
    from warp_ir.scene import Scene
    from warp_ir.settings import RenderSettings
    from warp_ir.view.controls import Controls

_LARGEST = 1280, 720
"""Largest window that is opened unless a size is given [pixels]."""


def run(args: argparse.Namespace) -> int:
    """Shows the stage until its window is closed, or the server is stopped; returns the exit code."""
    settings_of(args)
    check_output(args.picture, SUFFIXES)
    check_output(args.edits, (".usda", ".usdc", ".usd"))
    if args.web is None:
        check_display()
    else:
        check_address(*args.web)
    device = open_device(args.device, verbose=args.verbose)
    with importing():
        _ = ir.Renderer  # by this name, its kernels are loaded without being read
        from warp_ir.view.controls import Controls
        from warp_ir.view.session import LiveView
        from warp_ir.view.source import StageSource

        if args.web is None:
            from warp_ir.view.window import show_view
        else:
            from warp_ir.view.web import serve_view

    with ProgressDisplay("opening", quiet=args.quiet):
        source = StageSource(lambda: open_reader(args))
        scene = source.read(time_code_of(args))
        settings = settings_of(args, scene.settings)
        if not given_settings(args).keys() & {"width", "height"}:  # a stage may ask for more than a screen holds
            shrink = min(1.0, *(most / side for most, side in zip(_LARGEST, _size(settings, scene), strict=True)))
            width, height = (max(round(shrink * side), 1) for side in _size(settings, scene))
            settings = replace(settings, width=width, height=height)
        view = LiveView(
            source,
            settings,
            time_code=time_code_of(args),
            exposure=args.exposure,
            tonemap=args.tonemap,
            device=device,
            threads=args.threads,
        )
    say_warnings(scene.warnings, everything=args.verbose)
    controls = Controls(view, picture=Path(args.picture), layer=Path(args.edits))
    with _closing_on_signal(controls) as arrived:
        if args.web is not None:
            host, port = args.web
            serve_view(view, controls, args.stage, host, port, lambda line: show_result(line, quiet=False))
        else:
            show_view(view, controls, f"{args.stage} - warp-ir")
    if arrived:
        say("interrupted" if arrived[0] == signal.SIGINT else "terminated")
        return 128 + arrived[0]
    return 0


def _size(settings: "RenderSettings", scene: "Scene") -> tuple[int, int]:
    """Width and height of the picture that the settings ask for."""
    resolved = settings.resolve(scene.camera.aspect)
    return resolved.width, resolved.height


@contextmanager
def _closing_on_signal(controls: "Controls") -> Iterator[list[int]]:
    """Closes the view on SIGINT and SIGTERM; their numbers are appended to the list.

    An exception of Python's own handler would be lost where VTK calls Python.
    """
    arrived: list[int] = []

    def close(number: int, _: FrameType | None) -> None:
        arrived.append(number)
        controls.closed = True

    previous = {number: signal.signal(number, close) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield arrived
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
