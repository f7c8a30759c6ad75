"""Motion by authored velocities: points, positions and orientations between time samples.

What is in an array may change places from sample to sample, so values cannot be interpolated; velocities then give the
motion after a sample (UsdGeomPointBased and UsdGeomPointInstancer), and the other arrays are those of a sample as well.
"""

from dataclasses import dataclass

import numpy as np
from pxr import Usd, UsdGeom

from warp_ir.scene import Floats
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable


@dataclass(frozen=True, eq=False)
class Motion:
    """Values of a time sample, and their change since then by velocities."""

    start: Floats
    """Values of the sample, float64 [n, c]."""
    change: Floats
    """v t + a t² / 2, float64 [n, 3], t seconds after the sample."""


def motion_after_sample(
    attribute: Usd.Attribute,
    columns: int,
    velocities: Usd.Attribute,
    accelerations: Usd.Attribute | None,
    time: Usd.TimeCode,
    report: Report,
) -> Motion | None:
    """The motion of an array's elements since the time sample before a time; None if velocities do not apply.

    As in USD, they apply only if the time is between the same samples of both, and if they have a value per element.

    Args:
        attribute: Points, positions or orientations.
        columns: Numbers of each element.
        velocities: Rates of change per second; angularVelocities are in degrees per second.
        accelerations: Rates of change of the velocities, or None.
        time: Time of the values.
        report: Receives a warning if the velocities do not fit the array.

    Raises:
        Unreadable: The array is of another type.
    """
    if time.IsDefault() or not velocities or not velocities.HasAuthoredValue():
        return None
    samples = read.bracketing_samples(attribute, time)
    if samples is None or read.bracketing_samples(velocities, time) != samples:
        return None
    start = read.floats(attribute, Usd.TimeCode(samples[0]), columns)
    if start is None:
        return None
    seconds = (time.GetValue() - samples[0]) / attribute.GetPrim().GetStage().GetTimeCodesPerSecond()
    try:
        velocity = _rates(velocities, samples[0], len(start))
        if accelerations is not None and read.bracketing_samples(accelerations, time) == samples:
            velocity = velocity + 0.5 * seconds * _rates(accelerations, samples[0], len(start))
    except Unreadable as error:
        report.warn(attribute.GetPrim().GetPath(), f"{error}; the {attribute.GetName()} are interpolated instead")
        return None
    return Motion(start, seconds * velocity)


def read_points(prim: Usd.Prim, time: Usd.TimeCode, report: Report) -> tuple[Floats | None, bool]:
    """The points [n, 3] of a PointBased prim, and whether velocities move them (`TriangleMesh.sampled`).

    Raises:
        Unreadable: They are of another type.
    """
    based = UsdGeom.PointBased(prim)
    attribute = based.GetPointsAttr()
    motion = motion_after_sample(attribute, 3, based.GetVelocitiesAttr(), based.GetAccelerationsAttr(), time, report)
    if motion is None:
        return read.floats(attribute, time, 3), False
    return motion.start + motion.change, True


def _rates(attribute: Usd.Attribute, sample: float, count: int) -> Floats:
    """Velocities or accelerations [count, 3] of a time sample.

    Raises:
        Unreadable: There is not one finite vector per point.
    """
    rates = read.floats(attribute, Usd.TimeCode(sample), 3)
    if rates is None or len(rates) != count:
        raise Unreadable(f"{attribute.GetName()} has {0 if rates is None else len(rates)} values for {count} points")
    if not np.isfinite(rates).all():
        raise Unreadable(f"{attribute.GetName()} has values that are NaN or infinite")
    return rates
