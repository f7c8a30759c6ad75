"""Camera prims: choosing one, reading it, and a camera that frames a scene without one."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pxr import Gf, Tf, Usd, UsdGeom, UsdUtils

from warp_ir.scene import MAX_CLIPPING_PLANES, Camera, Floats, InputError, Projection
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable

_APERTURE_UNIT = 0.1
"""Apertures and focal lengths are in tenths of a scene unit."""


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
        InputError: There is no camera of that name.
    """
    cameras = all_cameras(stage)
    if name is not None:
        for prim in cameras:
            if name in (str(prim.GetPath()), prim.GetName()):
                return prim
        available = ", ".join(str(prim.GetPath()) for prim in cameras) or "none"
        raise InputError(f"{report.source}: no camera '{name}'; available: {available}")
    if settings_camera:
        return stage.GetPrimAtPath(settings_camera)
    primary = UsdUtils.GetPrimaryCameraName()
    chosen = next((prim for prim in cameras if prim.GetName() == primary), cameras[0] if cameras else None)
    if chosen is not None and len(cameras) > 1 and chosen.GetName() != primary:
        report.warn(chosen.GetPath(), f"rendered because it is the first of {len(cameras)} cameras")
    return chosen


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


def framing_camera(lower: Floats, upper: Floats, up_axis: str) -> Camera:
    """The camera with which `usdrecord` frames a stage without one (its `_ComputeCameraToFrameStage`).

    usdrecord crops tall scenes above and below; this camera moves back until the whole scene is in the picture.

    Args:
        lower: Minimum corner of the scene's bounds, [3].
        upper: Maximum corner, [3].
        up_axis: "Y": the camera looks along -Z; "Z": along +Y.
    """
    default = Gf.Camera()
    half_x = 0.5 * default.horizontalAperture / default.focalLength
    half_y = 0.5 * default.verticalAperture / default.focalLength
    size, matrix = upper - lower, np.eye(4)
    width, height, depth = (size[0], size[1], size[2]) if up_axis == "Y" else (size[0], size[2], size[1])
    distance = 0.5 * max(math.hypot(width, height) / half_x, height / half_y) + 0.5 * depth
    if distance < default.clippingRange.min:
        distance += 1.0
    if up_axis == "Z":
        matrix[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
    matrix[:3, 3] = 0.5 * (lower + upper) + distance * matrix[:3, 2]
    return Camera("framing camera", matrix, (-half_x, half_x, -half_y, half_y))


def eye_camera(eye: Sequence[float], target: Sequence[float], up_axis: str) -> Camera:
    """A camera with USD's default lens at one point that looks at another, with the up axis upright.

    Raises:
        InputError: The points coincide, or the direction between them is the up axis.
    """
    lens_radius = framing_camera(np.zeros(3), np.ones(3), up_axis)
    up = (0.0, 1.0, 0.0) if up_axis == "Y" else (0.0, 0.0, 1.0)
    return replace(lens_radius, name="eye", world_from_camera=Camera.look_at(eye, target, up).world_from_camera)


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
