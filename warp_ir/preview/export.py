"""Files of a scene and its VPLs: pictures, pages for a browser, models, and animations."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_ir.files import check_output, whole_file
from warp_ir.preview.plot import add_vpls, plotter, select
from warp_ir.scene import InputError, Scene

if TYPE_CHECKING:
    import pyvista

    from warp_ir.vpl.trace import Vpls

ORDERS = ("path", "bounce")
"""In which order an animation adds VPLs."""
_FRAMES_PER_SECOND = 12
_PATH_FRAMES, _BOUNCE_FRAMES, _LAST_FRAMES = 48, 12, 12
"""Frames in which all paths are added, of each bounce, and of the complete cloud at the end."""


def picture_vpls(scene: Scene, vpls: "Vpls", path: str | os.PathLike[str], **options: Any) -> Path:
    """Writes a picture of VPLs in their scene; no display is needed.

    Args:
        scene: The scene in which the VPLs were traced.
        vpls: The VPLs, from `trace_vpls`.
        path: The `.png` file to write.
        options: As for `plotter`: `view`, `color_by`, `paths`, `width`, ...

    Returns:
        The path of the written file.

    Raises:
        InputError: The file cannot be written, or an option is wrong.
    """
    path = check_output(path, (".png",))
    plot: Any = plotter(scene, vpls, **options, off_screen=True, notebook=False)
    try:
        with whole_file(path) as temporary:
            plot.screenshot(str(temporary))
    finally:
        plot.close()
    return path


def write_html(plot: "pyvista.Plotter", path: str | os.PathLike[str]) -> Path:
    """Writes what a plotter shows as one page that turns with the mouse in any browser, without a network.

    Raises:
        InputError: The file cannot be written, or the extra `view` is not installed.
    """
    path = check_output(path, (".html",))
    try:
        import trame_pyvista  # noqa: F401  # what PyVista exports pages with
    except ImportError as error:
        raise InputError(f"{path}: a page needs the extra 'view': pip install 'warp-ir[view]'") from error
    exporter: Any = plot
    with whole_file(path) as temporary:
        exporter.trame.export_html(str(temporary))
    return path


def write_model(plot: "pyvista.Plotter", path: str | os.PathLike[str]) -> Path:
    """Writes the surfaces and discs that a plotter shows as a `.gltf` model with their colours.

    Raises:
        InputError: The file cannot be written.
    """
    path = check_output(path, (".gltf",))
    exporter: Any = plot
    with whole_file(path) as temporary:
        exporter.export_gltf(str(temporary), inline_data=True, rotate_scene=False)
    return path


def animate_vpls(
    scene: Scene,
    vpls: "Vpls",
    path: str | os.PathLike[str],
    *,
    order: str = "path",
    color_by: str = "hue",
    **options: Any,
) -> Path:
    """Writes an animation in which the VPLs appear, path by path or bounce by bounce.

    Args:
        scene: The scene in which the VPLs were traced.
        vpls: The VPLs, from `trace_vpls`.
        path: The `.gif` or `.mp4` file to write.
        order: "path" or "bounce".
        color_by: As for `plotter`.
        options: As for `plotter`: `view`, `width`, ...

    Returns:
        The path of the written file.

    Raises:
        InputError: The file cannot be written, an option is wrong, or the extra `view` is not installed.
    """
    path = check_output(path, (".gif", ".mp4"))
    if order not in ORDERS:
        raise InputError(f"order: must be path or bounce, is {order!r}")
    try:
        import imageio.v2 as imageio
    except ImportError as error:
        raise InputError(f"{path}: an animation needs the extra 'view': pip install 'warp-ir[view]'") from error
    # All VPLs are added once, so that the scale of the colours is the same in all frames.
    plot: Any = plotter(scene, vpls, color_by=color_by, **options, off_screen=True, notebook=False)
    size = scene.extent or 1.0
    chosen = select(vpls, options.get("bounces"), options.get("min_contribution", 0.0))
    key = np.asarray(vpls.path if order == "path" else vpls.bounce)[chosen]
    steps = np.unique(key)
    if order == "path" and len(steps) > _PATH_FRAMES:
        steps = steps[np.unique(np.linspace(0, len(steps) - 1, _PATH_FRAMES).round().astype(int))]
    repeat = 1 if order == "path" else _BOUNCE_FRAMES
    try:
        with whole_file(path) as temporary:
            film: dict[str, Any] = {"fps": _FRAMES_PER_SECOND, "macro_block_size": 2}
            if path.suffix.lower() == ".gif":
                film = {"duration": 1000.0 / _FRAMES_PER_SECOND, "loop": 0}
            open_writer: Any = imageio.get_writer
            with open_writer(temporary, **film) as writer:
                for step in steps:
                    add_vpls(plot, vpls, chosen[key <= step], color_by, size)
                    frame = plot.screenshot(return_img=True)
                    for _ in range(repeat + (_LAST_FRAMES if step == steps[-1] else 0)):
                        writer.append_data(frame)
    finally:
        plot.close()
    return path
