"""Extrapolation by authored velocities: points, positions and orientations between time samples.

Where topology changes from sample to sample, values cannot be interpolated; velocities then give the motion after a
sample (UsdGeomPointBased and UsdGeomPointInstancer).
"""

import numpy as np
from pxr import Usd

from warp_ir.scene import Floats
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable


def extrapolated_points(
    attribute: Usd.Attribute,
    velocities: Usd.Attribute,
    accelerations: Usd.Attribute,
    time: Usd.TimeCode,
    report: Report,
) -> Floats | None:
    """Points or positions [n, 3] at a time: p + v t + a t² / 2 from the sample before, else interpolated by USD."""
    points = read.floats(attribute, time, 3)
    seconds = _seconds_since_sample(attribute, velocities, time)
    if points is None or seconds == 0.0:
        return points
    sample = _bracketing_samples(attribute, time)
    assert sample is not None
    try:
        start = read.floats(attribute, Usd.TimeCode(sample[0]), 3)
        if start is None:
            return points
        velocity = _rates(velocities, sample[0], len(start))
        if _bracketing_samples(accelerations, time) == sample:
            velocity = velocity + 0.5 * seconds * _rates(accelerations, sample[0], len(start))
    except Unreadable as error:
        report.warn(attribute.GetPrim().GetPath(), f"{error}; the points are interpolated instead")
        return points
    extrapolated: Floats = start + seconds * velocity
    return extrapolated


def extrapolated_rotation(
    attribute: Usd.Attribute, rates: Usd.Attribute, time: Usd.TimeCode, count: int, report: Report
) -> tuple[Usd.TimeCode, Floats | None]:
    """The time at which orientations are to be read, and the rotations that follow them.

    Returns:
        The time of the sample before and rotation vectors [count, 3] in radians; `time` itself and None if angular
        velocities do not apply.
    """
    seconds = _seconds_since_sample(attribute, rates, time)
    if seconds == 0.0:
        return time, None
    sample = _bracketing_samples(attribute, time)
    assert sample is not None
    try:
        return Usd.TimeCode(sample[0]), np.radians(_rates(rates, sample[0], count)) * seconds
    except Unreadable as error:
        report.warn(attribute.GetPrim().GetPath(), f"{error}; the orientations are interpolated instead")
        return time, None


def _seconds_since_sample(attribute: Usd.Attribute, velocities: Usd.Attribute, time: Usd.TimeCode) -> float:
    """Seconds since the time sample before a time; 0 if velocities do not apply."""
    if time.IsDefault() or not velocities or not velocities.HasAuthoredValue():
        return 0.0
    sample = _bracketing_samples(attribute, time)
    if sample is None or _bracketing_samples(velocities, time) != sample:
        return 0.0
    return float((time.GetValue() - sample[0]) / attribute.GetPrim().GetStage().GetTimeCodesPerSecond())


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


def _bracketing_samples(attribute: Usd.Attribute, time: Usd.TimeCode) -> tuple[float, float] | None:
    """The times of the samples before and after a time; None without samples.

    As in USD, velocities apply to points only if the bracketing samples of both are the same.
    """
    samples = attribute.GetBracketingTimeSamples(time.GetValue()) if attribute else ()
    return (samples[0], samples[1]) if samples else None
