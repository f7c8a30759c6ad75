"""A `pyvista.Plotter` of a scene and its VPLs: in a window, in a notebook, or off-screen without a display."""

import math
from collections.abc import Collection
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from warp_ir.preview.shapes import camera_lines, light_outlines, lines_to, path_lines, vpl_shapes
from warp_ir.preview.surfaces import add_surfaces
from warp_ir.scene import Camera, Floats, InputError, Projection, Scene
from warp_ir.settings import RenderSettings

if TYPE_CHECKING:
    import pyvista

    from warp_ir.vpl.trace import Vpls

COLORINGS = ("hue", "flux", "bounce", "contribution")
"""What the colour of a VPL can show."""
VIEWS = ("outside", "camera")
_DECADES = 4.0
"""VPLs have the colour of the least value if theirs is this many powers of ten below the greatest."""
_BACKGROUND = "#16181d"
_PATH_COLOR, _LIGHT_COLOR, _CAMERA_COLOR = "#7fb2ff", "#ffd75f", "#9be28f"
_RAY_COLOR = "#ff8f6b"
_PICKED = 0.1
"""Distance of what is seen at a pixel from the shape of a VPL, relative to its size, up to which it is that shape."""
_RADIUS = 0.006
"""Radius of the disc of a VPL of median intensity, per extent of the scene."""


def plotter(
    scene: Scene,
    vpls: "Vpls | None" = None,
    *,
    color_by: str = "hue",
    bounces: Collection[int] | None = None,
    min_contribution: float = 0.0,
    paths: bool = False,
    view: str = "outside",
    width: int = 1024,
    height: int | None = None,
    off_screen: bool | None = None,
    notebook: bool | None = None,
) -> "pyvista.Plotter":
    """A plotter that shows a scene in its albedo, and VPLs in it as discs on their surfaces, seen from the lit side.

    The area of a disc is proportional to the VPL's intensity, within limits. Lights are yellow outlines, the camera is
    a green pyramid. Walls between the eye and the scene are left out. More can be added before `show()`; after
    `pick_vpls`, a right click on a disc writes the VPL's numbers into the window.

    Args:
        scene: The scene in which the VPLs were traced.
        vpls: The VPLs, from `trace_vpls`; None: only the scene.
        color_by: "hue": the colour of the VPL's light, darker by the logarithm of its intensity. "flux", "bounce" and
            "contribution" have a scale that is labelled.
        bounces: Only VPLs after these numbers of reflections; None: all.
        min_contribution: Only VPLs that contribute at least this fraction of the greatest `Vpls.contribution`.
        paths: Also draws the light paths, and from the pixel that was asked for, the unoccluded shadow rays.
        view: "outside" shows the whole scene, "camera" is the scene's camera.
        width: Width of the picture [pixels].
        height: Height [pixels]; None: from the camera's aspect, or 3/4 of the width from outside.
        off_screen: Whether to draw without a window; None: PyVista's default.
        notebook: Whether to draw in a notebook; None: PyVista's default.

    Raises:
        InputError: The view or the colouring is unknown, or `vpls` has no contribution to colour or choose by.
    """
    if view not in VIEWS:
        raise InputError(f"view: must be outside or camera, is {view!r}")
    if color_by not in COLORINGS:
        raise InputError(f"color_by: must be one of {', '.join(COLORINGS)}, is {color_by!r}")
    if height is None:
        height = max(1, round(width / scene.camera.aspect)) if view == "camera" else max(1, 3 * width // 4)
    import pyvista
    from vtkmodules.vtkCommonCore import vtkLogger

    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    # A headlight: what faces the eye is bright, so that shapes are seen from everywhere.
    plot: Any = pyvista.Plotter(off_screen=off_screen, notebook=notebook, window_size=[width, height], lighting="none")
    plot.add_light(pyvista.Light(light_type="headlight", intensity=0.55))
    plot.set_background(_BACKGROUND)
    camera = scene.camera.fit(width, height) if view == "camera" else outside_camera(scene, width / height)
    size = scene.extent or 1.0
    add_surfaces(plot, scene)
    for outline in light_outlines(scene, size):
        plot.add_mesh(outline, color=_LIGHT_COLOR, line_width=2, lighting=False)
    if view == "outside":
        plot.add_mesh(camera_lines(scene.camera, 0.08 * size), color=_CAMERA_COLOR, line_width=2, lighting=False)
    if vpls is not None:
        shown = select(vpls, bounces, min_contribution)
        add_vpls(plot, vpls, shown, color_by, size)
        if paths:
            _add_paths(plot, vpls, shown, size)
        directional = int(np.count_nonzero(np.asarray(vpls.directional)[shown]))
        if directional:
            plot.add_text(f"and {directional} directional VPLs", font_size=max(6, height // 80), color="white")
    _set_camera(plot, camera)
    made: pyvista.Plotter = plot
    return made


def select(vpls: "Vpls", bounces: Collection[int] | None, min_contribution: float) -> npt.NDArray[np.intp]:
    """Indices of the VPLs to show, as `plotter` describes."""
    keep = np.ones(len(vpls.positions), bool)
    if bounces is not None:
        keep &= np.isin(vpls.bounce, list(bounces))
    if min_contribution > 0.0:
        contribution = _contribution(vpls)
        keep &= contribution >= min_contribution * contribution.max(initial=0.0)
    return np.flatnonzero(keep)


def add_vpls(plot: Any, vpls: "Vpls", shown: npt.NDArray[np.intp], color_by: str, size: float) -> None:
    """Adds the VPLs as discs, or replaces those that were added before.

    Args:
        plot: The plotter.
        vpls: The VPLs.
        shown: Indices of those to add; the colours and areas are those that they have among all.
        color_by: One of `COLORINGS`.
        size: The scene's extent.
    """
    local = shown[~np.asarray(vpls.directional, dtype=bool)[shown]]
    peak = np.asarray(vpls.intensity, dtype=np.float64).max(axis=1, initial=0.0)
    middle = float(np.median(peak[peak > 0.0])) if (peak > 0.0).any() else 1.0
    radius = _RADIUS * size * np.clip(np.sqrt(peak / middle), 0.5, 2.5)
    if not len(local):
        if "vpls" in plot.actors:
            plot.remove_actor("vpls")
        return
    discs = vpl_shapes(np.asarray(vpls.positions)[local], np.asarray(vpls.normals)[local], radius[local])
    of_cell = discs.cell_data["vpl"] = local[discs.cell_data["vpl"]]
    # Only the side that shines is drawn, and it may be hidden: the disc lies on the surface.
    style: dict[str, Any] = dict(name="vpls", lighting=False, culling="back", reset_camera=False)
    if color_by == "hue":
        discs.cell_data["color"] = dot_colors(vpls.intensity)[of_cell]
        plot.add_mesh(discs, scalars="color", rgb=True, **style)
    elif color_by == "bounce":
        last = int(np.asarray(vpls.bounce).max())
        discs.cell_data["bounce"] = np.asarray(vpls.bounce)[of_cell]
        bar = dict(title="bounce", color="white", n_labels=min(last + 1, 8), fmt="%.0f")
        plot.add_mesh(discs, scalars="bounce", cmap="viridis", clim=(0, max(last, 1)), scalar_bar_args=bar, **style)
    else:
        values = _contribution(vpls) if color_by == "contribution" else _flux(vpls)
        greatest = float(values.max(initial=0.0)) or 1.0
        unit = "W/sr/m²" if color_by == "contribution" else "W"
        name = f"log10 of the {color_by} [{unit}]"
        top = math.log10(greatest)
        discs.cell_data[name] = np.log10(np.maximum(values[of_cell], greatest * 10.0**-_DECADES))
        bar = dict(title=name, color="white", n_labels=5, fmt="%.1f")
        plot.add_mesh(discs, scalars=name, cmap="inferno", clim=(top - _DECADES, top), scalar_bar_args=bar, **style)


def _add_paths(plot: Any, vpls: "Vpls", shown: npt.NDArray[np.intp], size: float) -> None:
    """Adds light paths, the directions of directional VPLs, and the shadow rays from a pixel that found a VPL."""
    lines = path_lines(vpls.positions, vpls.parent, vpls.directional, shown, size)
    if lines.n_cells:
        plot.add_mesh(lines, color=_PATH_COLOR, opacity=0.35, line_width=1, lighting=False, name="paths")
    if vpls.pixel_position is not None and vpls.contribution is not None:
        lit = shown[_contribution(vpls)[shown] > 0.0]
        rays = lines_to(vpls.pixel_position, np.asarray(vpls.positions)[lit], vpls.directional[lit], size)
        plot.remove_actor("shadow rays")
        if rays.n_cells:
            plot.add_mesh(rays, color=_RAY_COLOR, opacity=0.5, line_width=1, lighting=False, name="shadow rays")


def describe(vpls: "Vpls", index: int) -> str:
    """The numbers of a VPL, for the picture of a plotter."""
    position, intensity = np.asarray(vpls.positions)[index], np.asarray(vpls.intensity)[index]
    lines = [
        f"VPL {index}, bounce {int(vpls.bounce[index])}, parent {int(vpls.parent[index])}",
        "position " + " ".join(f"{x:.4g}" for x in position),
        "intensity " + " ".join(f"{x:.4g}" for x in intensity) + " W/sr",
    ]
    if vpls.contribution is not None:
        lines.append("contribution " + " ".join(f"{x:.4g}" for x in np.asarray(vpls.contribution)[index]))
    return "\n".join(lines)


def pick_vpls(
    plot: "pyvista.Plotter", vpls: "Vpls", scene: Scene | None = None, settings: RenderSettings | None = None
) -> None:
    """Lets a right click, or the key P, ask the window of a plotter.

    On a VPL, its numbers are written into the window. On a surface, the pixel in which the scene's camera sees that
    place is asked for, if a scene is given: the VPLs take the colours of what they contribute to it, and lines lead to
    those that are visible from there.

    Args:
        plot: The plotter of these VPLs, from `plotter`.
        vpls: The VPLs.
        scene: The scene in which they were traced.
        settings: The settings with which they were traced, and the image of which a pixel is meant.
    """
    window: Any = plot
    shown = vpls

    def pick() -> None:
        nonlocal shown
        place = _seen_at(window, *window.iren.get_event_position())
        if place is None:
            return
        index = _vpl_at(window, place)
        if index is not None:
            text = describe(shown, index)
        elif scene is not None:
            pixel = _pixel_of(scene, settings or RenderSettings(), place)
            text = f"pixel {pixel[0]} {pixel[1]}" if pixel else "not in the camera's picture"
            if pixel:
                shown = _show_contributions(window, scene, settings, pixel)
        else:
            return
        window.add_text(text, name="vpl text", font_size=9, color="white")

    window.iren.add_observer("RightButtonPressEvent", lambda *_: pick())
    window.add_key_event("p", pick)


def _show_contributions(plot: Any, scene: Scene, settings: RenderSettings | None, pixel: tuple[int, int]) -> "Vpls":
    """Traces the VPLs with what they contribute to a pixel, and draws them by it, with the unoccluded shadow rays."""
    from warp_ir.vpl.trace import trace_vpls  # imports Warp

    vpls = trace_vpls(scene, settings, contribution_to=pixel)
    every, size = np.arange(len(vpls.positions)), scene.extent or 1.0
    add_vpls(plot, vpls, every, "contribution", size)
    _add_paths(plot, vpls, every, size)
    return vpls


def _seen_at(plot: Any, column: int, row: int) -> Floats | None:
    """The place [3] that is drawn at a pixel of a plotter's window (row 0 at the bottom); None: the background.

    The depth that is drawn there decides: VTK's pickers also hit what is culled.
    """
    depth = plot.renderer.GetZ(column, row)
    if depth >= 1.0:
        return None
    plot.renderer.SetDisplayPoint(column, row, depth)
    plot.renderer.DisplayToWorld()
    x, y, z, w = plot.renderer.GetWorldPoint()
    place: Floats = np.array([x, y, z]) / w
    return place


def _vpl_at(plot: Any, place: Floats) -> int | None:
    """Index of the VPL on whose shape a place is; None: none."""
    if "vpls" not in plot.actors:
        return None
    shapes = plot.actors["vpls"].mapper.dataset
    cell, closest = shapes.find_closest_cell(place, return_closest_point=True)
    size = np.linalg.norm(np.ptp(shapes.get_cell(cell).points, axis=0))
    on_it = np.linalg.norm(closest - place) < _PICKED * size
    return int(shapes.cell_data["vpl"][cell]) if on_it else None


def _pixel_of(scene: Scene, settings: RenderSettings, place: Floats) -> tuple[int, int] | None:
    """Column and row of the pixel of an image of these settings that shows a place; None: none does."""
    height = settings.resolve(scene.camera.aspect).height
    camera = scene.camera.fit(settings.width, height, settings.conform, settings.pixel_aspect)
    (column,), (row,), (depth,) = camera.project(place[None])
    if not (depth > 0.0 and 0.0 <= column < 1.0 and 0.0 <= row < 1.0):
        return None
    return int(column * settings.width), int(row * height)


def dot_colors(intensity: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    """Display colours of VPLs, uint8 [n, 3]: the hue of the intensity, and its logarithm as brightness.

    Args:
        intensity: [n, 3], in any unit.
    """
    power = np.asarray(intensity, dtype=np.float64)
    peak = power.max(axis=1, initial=0.0)
    strongest = float(peak.max(initial=0.0))
    hue = power / np.maximum(peak, 1e-300)[:, None]
    with np.errstate(divide="ignore"):
        decades = np.log10(peak / strongest) if strongest > 0.0 else np.full(len(peak), -np.inf)
    brightness = 0.3 + 0.7 * np.clip(1.0 + decades / _DECADES, 0.0, 1.0)
    colors: npt.NDArray[np.uint8] = np.round(255.0 * brightness[:, None] * hue ** (1.0 / 2.2)).astype(np.uint8)
    return colors


def _flux(vpls: "Vpls") -> npt.NDArray[np.float64]:
    """Flux of each VPL, mean of the channels [W]: π I where it shines by the cosine, 4π I where in all directions."""
    intensity = np.asarray(vpls.intensity, dtype=np.float64).mean(axis=1)
    everywhere = ~np.asarray(vpls.normals).any(axis=1)
    flux: npt.NDArray[np.float64] = intensity * np.where(everywhere, 4.0 * math.pi, math.pi)
    return flux


def _contribution(vpls: "Vpls") -> npt.NDArray[np.float64]:
    if vpls.contribution is None:
        raise InputError("vpls: have no contribution; trace_vpls(..., contribution_to=...) computes it")
    contribution: npt.NDArray[np.float64] = np.asarray(vpls.contribution, dtype=np.float64).mean(axis=1)
    return contribution


def outside_camera(scene: Scene, aspect: float) -> Camera:
    """A camera that sees the whole scene except some corners, from a direction beside and above its own camera."""
    lower, upper = scene.bounds()
    center, radius = 0.5 * (lower + upper), 0.5 * (scene.extent or 1.0)
    right, up, back = (scene.camera.world_from_camera[:3, k] for k in range(3))
    direction = back + 0.45 * right + 0.35 * up
    fov = 30.0
    distance = 0.9 * radius / math.sin(math.radians(fov) / 2.0) / min(1.0, aspect)
    eye = center + distance * direction / np.linalg.norm(direction)
    return Camera.look_at(eye.tolist(), center.tolist(), up.tolist(), fov=fov, aspect=aspect)


def _set_camera(plot: Any, camera: Camera) -> None:
    """Sets position, direction and window of VTK's camera."""
    left, right, bottom, top = camera.window
    matrix = camera.world_from_camera
    vtk_camera = plot.camera
    vtk_camera.position = tuple(matrix[:3, 3])
    vtk_camera.focal_point = tuple(matrix[:3, 3] - matrix[:3, 2])
    vtk_camera.up = tuple(matrix[:3, 1])
    # VTK's window is symmetric, and shifted in units of its half size.
    vtk_camera.SetWindowCenter((right + left) / (right - left), (top + bottom) / (top - bottom))
    if camera.projection == Projection.ORTHOGRAPHIC:
        vtk_camera.parallel_projection = True
        vtk_camera.parallel_scale = 0.5 * (top - bottom)
    else:
        vtk_camera.view_angle = math.degrees(2.0 * math.atan(0.5 * (top - bottom)))
    plot.renderer.ResetCameraClippingRange()
