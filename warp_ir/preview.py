"""Pictures of virtual point lights in their scene, drawn off-screen by PyVista: no display is needed."""

import math
import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from warp_ir.image.io import check_output, whole_file
from warp_ir.scene import Camera, InputError, Projection, Scene

if TYPE_CHECKING:
    import pyvista

_DECADES = 4.0
"""VPLs are drawn at the least brightness if their intensity is this many powers of ten below the strongest."""
_POINT_SIZES = (14.0, 10.0, 7.0, 5.0, 4.0)
"""Diameters of VPLs of bounce 0, 1, ..., the last for all further ones, in a picture 1000 pixels high [pixels]."""
_MIN_POINT_SIZE = 3.0
_BACKGROUND = "#16181d"
_MAX_TRIANGLES = 5_000_000
"""Approximate limit on the triangles drawn; of a scene with more, an even selection of the instances is drawn."""


class VplCloud(Protocol):
    """The arrays of a VPL cloud that are drawn, as in `warp_ir.vpl.trace.Vpls`."""

    @property
    def positions(self) -> npt.NDArray[np.floating]:
        """[n, 3], world space."""

    @property
    def intensity(self) -> npt.NDArray[np.floating]:
        """[n, 3], in any unit."""

    @property
    def bounce(self) -> npt.NDArray[np.integer]:
        """[n], number of reflections before."""

    @property
    def directional(self) -> npt.NDArray[np.bool_]:
        """[n], whether the VPL is infinitely far away."""


def picture_vpls(
    scene: Scene,
    vpls: VplCloud,
    path: str | os.PathLike[str],
    *,
    view: str = "outside",
    width: int = 1024,
    height: int | None = None,
) -> Path:
    """Draws virtual point lights as dots in the scene.

    The hue of a dot is that of the VPL, its brightness the logarithm of the intensity; earlier bounces are larger.
    Directional VPLs (sun and sky) have no position; their number is written in the picture.

    Args:
        scene: The scene in which the VPLs were traced.
        vpls: The VPLs, from `trace_vpls`.
        path: The `.png` file to write.
        view: "outside" shows the whole scene from outside, without the walls in front; "camera" is the scene's camera.
        width: Width of the picture [pixels].
        height: Height [pixels]; None: from the camera's aspect, or 3/4 of the width from outside.

    Returns:
        The path of the written file.

    Raises:
        InputError: The file cannot be written, or the view is unknown.
    """
    path = check_output(path, (".png",))
    if view not in ("outside", "camera"):
        raise InputError(f"view: must be outside or camera, is {view!r}")
    if height is None:
        height = max(1, round(width / scene.camera.aspect)) if view == "camera" else max(1, 3 * width // 4)
    import pyvista
    from vtkmodules.vtkCommonCore import vtkLogger

    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    plotter: Any = pyvista.Plotter(off_screen=True, window_size=[width, height], lighting="none")
    try:
        plotter.set_background(_BACKGROUND)
        camera = scene.camera.fit(width, height) if view == "camera" else _outside(scene, width / height)
        _add_meshes(plotter, scene, camera, open_front=view == "outside")
        _add_points(plotter, vpls, camera, 0.01 * (scene.extent or 1.0), height)
        _set_camera(plotter, camera)
        with whole_file(path) as temporary:
            plotter.screenshot(str(temporary))
    finally:
        plotter.close()
    return path


def _outside(scene: Scene, aspect: float) -> Camera:
    """A camera that sees the whole scene except some corners, from a direction beside and above its own camera."""
    lower, upper = scene.bounds()
    center, radius = 0.5 * (lower + upper), 0.5 * (scene.extent or 1.0)
    right, up, back = (scene.camera.world_from_camera[:3, k] for k in range(3))
    direction = back + 0.45 * right + 0.35 * up
    fov = 30.0
    distance = 0.9 * radius / math.sin(math.radians(fov) / 2.0) / min(1.0, aspect)
    eye = center + distance * direction / np.linalg.norm(direction)
    return Camera.look_at(eye.tolist(), center.tolist(), up.tolist(), fov=fov, aspect=aspect)


def _flattened(scene: Scene) -> Scene:
    """The scene with copies of its instances, or of an even selection if they have too many triangles."""
    step = max(1, math.ceil(scene.triangles_seen / _MAX_TRIANGLES))
    selected = (
        replace(g, matrices=g.matrices[::step], colors=None if g.colors is None else g.colors[::step])
        for g in scene.instances
    )
    return replace(scene, instances=tuple(selected)).flat()


def _add_meshes(plotter: "pyvista.Plotter", scene: Scene, camera: Camera, *, open_front: bool) -> None:
    """Adds the surfaces in their albedo, dimmed, and shaded by the cosine to the camera.

    With `open_front`, triangles between the camera and the rest of the scene (near walls of either winding) are left
    out, so that the inside is visible.
    """
    import pyvista

    lower, upper = scene.bounds()
    eye, center = camera.world_from_camera[:3, 3], 0.5 * (lower + upper)
    for mesh in _flattened(scene).meshes:
        corners = mesh.points[mesh.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
        middle = corners.mean(axis=1)
        to_eye = eye - middle
        facing = np.einsum("nk,nk->n", normals, to_eye) / np.maximum(np.linalg.norm(to_eye, axis=1), 1e-300)
        albedo = np.array([m.albedo for m in scene.materials])[mesh.material]
        if mesh.colors is not None:
            albedo = mesh.colors.mean(axis=1)
        shade = np.clip(albedo, 0.0, 1.0) ** (1 / 2.2) * (0.25 + 0.35 * np.abs(facing))[:, None]
        visible = np.ones(len(middle), dtype=bool)
        if open_front:
            # A triangle is part of a near wall if the whole scene is behind its plane.
            span = scene.extent or 1.0
            outward = normals * np.sign(facing)[:, None]
            reach = np.abs(outward) @ (0.5 * (upper - lower))
            visible = np.einsum("nk,nk->n", outward, middle - center) < reach - 0.02 * span
        if not visible.any():
            continue
        triangles: Any = mesh.triangles[visible]
        surface = pyvista.PolyData.from_regular_faces(mesh.points.astype(np.float64), triangles)
        surface.cell_data["shade"] = np.round(255.0 * shade[visible]).astype(np.uint8)
        plotter.add_mesh(surface, scalars="shade", rgb=True, lighting=False)


def _add_points(plotter: "pyvista.Plotter", vpls: VplCloud, camera: Camera, offset: float, height: int) -> None:
    """Adds a dot for each local VPL, moved by `offset` towards the camera so that its surface does not hide it."""
    import pyvista

    local = ~np.asarray(vpls.directional, dtype=bool)
    positions = np.asarray(vpls.positions)[local]
    to_eye = camera.world_from_camera[:3, 3] - positions
    if camera.projection == Projection.ORTHOGRAPHIC:
        to_eye[:] = camera.world_from_camera[:3, 2]
    positions = positions + offset * to_eye / np.maximum(np.linalg.norm(to_eye, axis=1), 1e-300)[:, None]
    bounce = np.minimum(np.asarray(vpls.bounce)[local], len(_POINT_SIZES) - 1)
    colors = dot_colors(np.asarray(vpls.intensity)[local])
    for k, size in enumerate(_POINT_SIZES):
        if (bounce == k).any():
            cloud = pyvista.PolyData(np.ascontiguousarray(positions[bounce == k], dtype=np.float32))
            cloud.point_data["color"] = colors[bounce == k]
            size = max(_MIN_POINT_SIZE, size * height / 1000.0)
            plotter.add_mesh(
                cloud, scalars="color", rgb=True, lighting=False, point_size=size, render_points_as_spheres=True
            )
    if not local.all():
        count = int(np.count_nonzero(~local))
        plotter.add_text(f"and {count} directional VPLs", font_size=max(6, height // 80), color="white")


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


def _set_camera(plotter: "pyvista.Plotter", camera: Camera) -> None:
    """Sets position, direction and window of VTK's camera."""
    left, right, bottom, top = camera.window
    matrix = camera.world_from_camera
    vtk_camera = plotter.camera
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
    plotter.renderer.ResetCameraClippingRange()
