"""Camera prims: choosing one, reading it, and a camera that frames a scene without one."""

import math
from collections.abc import Sequence

import numpy as np
from pxr import Gf, Tf, Usd, UsdGeom, UsdUtils

from warp_ir.scene import MAX_CLIPPING_PLANES, Camera, Floats, InputError, Projection, Scene
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable

_APERTURE_UNIT = 0.1
"""Apertures and focal lengths are in tenths of a scene unit."""
_LENS = Gf.Camera()
"""USD's default lens."""
_HALF_WINDOW = tuple(
    0.5 * aperture / _LENS.focalLength for aperture in (_LENS.horizontalAperture, _LENS.verticalAperture)
)
"""Half the width and height of the picture at the unit distance, with the default lens."""
_MIN_COVERAGE = 0.01
"""Fraction of the picture; geometry that covers less from the usual direction is framed from another if that helps."""
_COVERAGE_SAMPLES = 100_000
"""Maximum number of triangles of a mesh, summed over its copies, from which its coverage is estimated."""


def find_camera(stage: Usd.Stage, name: str | None, settings_camera: str, report: Report) -> Usd.Prim | None:
    """The camera to render: the named one, else that of the render settings, else the primary one, else the first.

    Args:
        stage: The stage.
        name: Absolute path, or name of a camera prim; None to choose.
        settings_camera: Path of the camera that the render settings name; "" if there is none.
        report: Receives a warning of an arbitrary choice.

    Returns:
        The prim, or None if there is no camera.

    Raises:
        InputError: There is no camera of that name, or there are several.
    """
    cameras = all_cameras(stage)
    if name is not None:
        named = [prim for prim in cameras if str(prim.GetPath()) == name]
        named = named or [prim for prim in cameras if prim.GetName() == name]
        if len(named) > 1:
            paths = ", ".join(str(prim.GetPath()) for prim in named)
            raise InputError(f"{report.source}: {len(named)} cameras are named '{name}': {paths}; give a path")
        if named:
            return named[0]
        available = ", ".join(str(prim.GetPath()) for prim in cameras) or "none"
        raise InputError(f"{report.source}: no camera '{name}'; available: {available}")
    if settings_camera:
        return stage.GetPrimAtPath(settings_camera)
    primary = UsdUtils.GetPrimaryCameraName()
    primaries = [prim for prim in cameras if prim.GetName() == primary]
    candidates = primaries or cameras
    if len(candidates) > 1:
        which = f"cameras named {primary}" if primaries else "cameras"
        report.warn(candidates[0].GetPath(), f"rendered because it is the first of {len(candidates)} {which}")
    return candidates[0] if candidates else None


def all_cameras(stage: Usd.Stage) -> list[Usd.Prim]:
    """All cameras, those in instances included."""
    predicate = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)
    return [prim for prim in Usd.PrimRange(stage.GetPseudoRoot(), predicate) if prim.IsA(UsdGeom.Camera)]


def read_shutter(prim: Usd.Prim, time: Usd.TimeCode, report: Report) -> tuple[float, float]:
    """Times at which the shutter opens and closes [time codes after the frame]; equal if it does not open."""
    camera = UsdGeom.Camera(prim)
    try:
        opens = read.number(camera.GetShutterOpenAttr(), time, 0.0)
        closes = read.number(camera.GetShutterCloseAttr(), time, 0.0)
    except Unreadable as trouble:
        report.warn(prim.GetPath(), f"{trouble}; no motion blur")
        return 0.0, 0.0
    if closes < opens:
        report.warn(prim.GetPath(), f"shutter:close, {closes:g}, is before shutter:open, {opens:g}: no motion blur")
        return 0.0, 0.0
    return opens, closes


def read_camera(prim: Usd.Prim, time: Usd.TimeCode, report: Report) -> Camera:
    """The record of a Camera prim.

    Raises:
        InputError: Its focal length or an aperture is not a positive number.
    """
    camera = UsdGeom.Camera(prim)

    def positive(attribute: Usd.Attribute, default: float) -> float:
        try:
            length = read.number(attribute, time, default)
        except Unreadable as trouble:
            raise InputError(f"{report.source}: camera {prim.GetPath()}: {trouble}") from None
        if length <= 0.0:
            raise InputError(f"{report.source}: camera {prim.GetPath()}: {attribute.GetName()} is {length:g}")
        return length

    def optional(attribute: Usd.Attribute, default: float) -> float:
        try:
            return read.number(attribute, time, default)
        except Unreadable as trouble:
            report.warn(prim.GetPath(), f"{trouble}; {default:g} is used")
            return default

    if read.text(camera.GetProjectionAttr(), time) == UsdGeom.Tokens.orthographic:
        projection, unit = Projection.ORTHOGRAPHIC, _APERTURE_UNIT
    else:
        projection, unit = Projection.PERSPECTIVE, 1.0 / positive(camera.GetFocalLengthAttr(), 50.0)
    half_x = 0.5 * positive(camera.GetHorizontalApertureAttr(), 20.955)
    half_y = 0.5 * positive(camera.GetVerticalApertureAttr(), 15.2908)
    x = optional(camera.GetHorizontalApertureOffsetAttr(), 0.0)
    y = optional(camera.GetVerticalApertureOffsetAttr(), 0.0)
    lens_radius, focus = 0.0, math.inf
    if read.raw(camera.GetFocusDistanceAttr(), time) != math.inf:  # a lens may be focused at infinity
        focus = optional(camera.GetFocusDistanceAttr(), 0.0)
    f_stop = optional(camera.GetFStopAttr(), 0.0)
    if f_stop > 0.0 and projection == Projection.ORTHOGRAPHIC:
        report.warn(prim.GetPath(), "fStop: an orthographic camera has no depth of field")
    elif f_stop > 0.0 and focus <= 0.0:
        report.warn(prim.GetPath(), f"focusDistance is {focus:g}: no depth of field")
    elif f_stop > 0.0:
        lens_radius = 0.5 * _APERTURE_UNIT / (unit * f_stop)
    exposure = _exposure_scale(camera, time)
    if not (math.isfinite(exposure) and exposure >= 0.0):
        report.warn(prim.GetPath(), f"its exposure scale is {exposure:g}; 1 is used")
        exposure = 1.0
    return Camera(
        name=str(prim.GetPath()),
        world_from_camera=_rigid_transform(prim, time, report),
        window=((x - half_x) * unit, (x + half_x) * unit, (y - half_y) * unit, (y + half_y) * unit),
        projection=projection,
        clipping=_clipping(camera, time, report),
        clipping_planes=_clipping_planes(camera, time, report),
        exposure=exposure,
        lens_radius=lens_radius,
        focus_distance=focus if lens_radius > 0.0 else 1.0,
    )


def framing_camera(scene: Scene, up_axis: str) -> tuple[Camera, str]:
    """A camera that shows the whole scene from outside, and the direction in which it looks.

    It is the one with which `usdrecord` frames a stage without a camera (its `_ComputeCameraToFrameStage`), along -Z or
    +Y, but for three differences: it moves back until tall scenes are in the picture, it has no near plane to keep away
    from, and it looks from above or from the side, at 45 degrees, at what would be seen edge-on: at geometry that
    covers less than `_MIN_COVERAGE` of the picture, and much more of it from there.

    Args:
        scene: The scene.
        up_axis: "Y": the camera looks along -Z; "Z": along +Y.
    """
    lower, upper = scene.bounds()
    axis, s = "-Z" if up_axis == "Y" else "+Y", math.sqrt(0.5)
    views = ((axis, (0.0, 0.0, 1.0)), (f"{axis} and down", (0.0, s, s)), (f"{axis} and to the left", (s, 0.0, s)))
    camera = _framing(lower, upper, views[0][1], up_axis)
    covered = _coverage(scene, camera, _MIN_COVERAGE)
    if covered >= _MIN_COVERAGE or not scene.triangle_count:
        return camera, axis
    turned = [(_framing(lower, upper, back, up_axis), direction) for direction, back in views[1:]]
    coverages = [_coverage(scene, camera, math.inf) for camera, _ in turned]
    best = int(np.argmax(coverages))
    return turned[best] if coverages[best] > 4.0 * covered else (camera, axis)


def _framing(lower: Floats, upper: Floats, back: tuple[float, float, float], up_axis: str) -> Camera:
    """The camera with USD's default lens that frames a box.

    Args:
        lower: Minimum corner of the box, [3].
        upper: Maximum corner, [3].
        back: Unit vector from the box to the camera; x is to the right, y up.
        up_axis: "Y" or "Z".
    """
    half_x, half_y = _HALF_WINDOW
    matrix = np.eye(4)
    right = np.cross((0.0, 1.0, 0.0), back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), back])
    if up_axis == "Z":
        axes = axes @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    # The box that is aligned with the camera around the box that is aligned with the axes.
    width, height, depth = np.abs(axes) @ (upper - lower)
    distance = 0.5 * max(math.hypot(width, height) / half_x, height / half_y) + 0.5 * depth
    matrix[:3, :3] = axes.T
    matrix[:3, 3] = 0.5 * (lower + upper) + distance * matrix[:3, 2]
    return Camera("framing camera", matrix, (-half_x, half_x, -half_y, half_y))


def eye_camera(eye: Sequence[float], target: Sequence[float], up_axis: str) -> Camera:
    """A camera with USD's default lens at one point that looks at another, with the up axis upright.

    Raises:
        InputError: The points coincide, or the direction between them is the up axis.
    """
    half_x, half_y = _HALF_WINDOW
    up = (0.0, 1.0, 0.0) if up_axis == "Y" else (0.0, 0.0, 1.0)
    matrix = Camera.look_at(eye, target, up).world_from_camera
    return Camera("eye", matrix, (-half_x, half_x, -half_y, half_y))


def _coverage(scene: Scene, camera: Camera, enough: float) -> float:
    """Sum of the projected areas of a scene's triangles, as a fraction of the picture; the sum ends where it is enough.

    Large meshes and many copies are estimated from every n-th triangle and copy.

    Args:
        scene: The scene, all of it before the camera.
        camera: A perspective camera.
        enough: A sum that need not be exceeded.
    """
    camera_from_world = np.linalg.inv(camera.world_from_camera)
    left, right, bottom, top = camera.window
    groups = {k: group.matrices for group in scene.instances for k in group.meshes}
    total = 0.0
    for k, mesh in enumerate(scene.meshes):
        matrices = groups.get(k, np.eye(4)[None])
        step = 1 + len(mesh.triangles) // _COVERAGE_SAMPLES
        copies = 1 + len(matrices) * min(len(mesh.triangles), _COVERAGE_SAMPLES) // _COVERAGE_SAMPLES
        corners = mesh.points[mesh.triangles[::step]]
        for matrix in matrices[::copies]:
            placed = camera_from_world @ matrix
            x, y, z = np.moveaxis(corners @ placed[:3, :3].T + placed[:3, 3], 2, 0)
            x, y = x / -z, y / -z
            u, v = x[:, 1:] - x[:, :1], y[:, 1:] - y[:, :1]
            doubled = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
            total += 0.5 * float(doubled[np.isfinite(doubled)].sum()) * step * copies
            if total >= enough * (right - left) * (top - bottom):
                return enough
    return total / ((right - left) * (top - bottom))


def _rigid_transform(prim: Usd.Prim, time: Usd.TimeCode, report: Report) -> Floats:
    """world_from_camera without scale and shear; a mirrored camera keeps its view and up directions."""
    try:
        matrix = np.array(UsdGeom.XformCache(time).GetLocalToWorldTransform(prim)).T
    except Tf.ErrorException as trouble:
        report.warn(prim.GetPath(), f"its transform cannot be read: {trouble}")
        return np.eye(4)
    back, up = matrix[:3, 2], matrix[:3, 1]
    right = np.cross(up, back)
    if not (np.isfinite(matrix).all() and np.linalg.norm(right) > 0.0):
        report.warn(prim.GetPath(), "its transform is degenerate; the identity is used")
        return np.eye(4)
    rigid = np.eye(4)
    rigid[:3, 2] = back / np.linalg.norm(back)
    rigid[:3, 0] = right / np.linalg.norm(right)
    rigid[:3, 1] = np.cross(rigid[:3, 2], rigid[:3, 0])
    rigid[:3, 3] = matrix[:3, 3]
    return rigid


def _clipping(camera: UsdGeom.Camera, time: Usd.TimeCode, report: Report) -> tuple[float, float]:
    """Near and far clipping distance [scene units]."""
    near_far = read.raw(camera.GetClippingRangeAttr(), time)
    try:
        near, far = (float(distance) for distance in np.asarray(near_far).reshape(-1))
    except (TypeError, ValueError):
        near, far = math.nan, math.nan
    if not (near < far and far > 0.0):
        report.warn(camera.GetPath(), f"clippingRange {near_far} is empty; nothing is clipped")
        return 0.0, math.inf
    return max(near, 0.0), far


def _clipping_planes(
    camera: UsdGeom.Camera, time: Usd.TimeCode, report: Report
) -> tuple[tuple[float, float, float, float], ...]:
    """Clipping planes (a, b, c, d); invalid ones and those beyond the limit are skipped."""
    try:
        planes = read.floats(camera.GetClippingPlanesAttr(), time, 4)
    except Unreadable as trouble:
        report.warn(camera.GetPath(), f"{trouble}; no plane clips")
        return ()
    if planes is None:
        return ()
    # A plane without a normal clips all or nothing: it is invalid.
    usable = np.isfinite(planes).all(axis=1) & (np.abs(planes[:, :3]).max(axis=1) > 0.0)
    if not usable.all():
        report.warn(camera.GetPath(), "clippingPlanes: {n} invalid planes are ignored", int((~usable).sum()))
    planes = planes[usable]
    if len(planes) > MAX_CLIPPING_PLANES:
        report.warn(camera.GetPath(), f"clippingPlanes: only the first {MAX_CLIPPING_PLANES} of {len(planes)} clip")
    return tuple((a, b, c, d) for a, b, c, d in planes[:MAX_CLIPPING_PLANES].tolist())


def _exposure_scale(camera: UsdGeom.Camera, time: Usd.TimeCode) -> float:
    """Scale of the film's radiance, from the schema's exposure attributes."""
    try:
        return float(camera.ComputeLinearExposureScale(time))
    except (AttributeError, Tf.ErrorException):  # the schema has exposure attributes since USD 25.05
        return 1.0
