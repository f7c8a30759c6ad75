"""What velocities carry from the time sample before a moment to the moment: points, positions, orientations.

They make sense of a cache whose topology changes from sample to sample, where nothing can be interpolated.
"""

import numpy as np
from pxr import Usd

from warp_ir.scene import Floats
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable


def carried_points(
    attribute: Usd.Attribute,
    velocities: Usd.Attribute,
    accelerations: Usd.Attribute,
    time: Usd.TimeCode,
    report: Report,
) -> Floats | None:
    """Points or positions [n, 3]: where velocities carry them from the sample before, else interpolated by USD."""
    points = read.floats(attribute, time, 3)
    seconds = _since_sample(attribute, velocities, time)
    if points is None or seconds == 0.0:
        return points
    sample = _bracket(attribute, time)
    assert sample is not None
    try:
        moved = read.floats(attribute, Usd.TimeCode(sample[0]), 3)
        if moved is None:
            return points
        velocity = _rates(velocities, sample[0], len(moved))
        if _bracket(accelerations, time) == sample:
            velocity = velocity + 0.5 * seconds * _rates(accelerations, sample[0], len(moved))
    except Unreadable as trouble:
        report.warn(attribute.GetPrim().GetPath(), f"{trouble}; the points are interpolated instead")
        return points
    carried: Floats = moved + seconds * velocity
    return carried


def turned(
    attribute: Usd.Attribute, rates: Usd.Attribute, time: Usd.TimeCode, count: int, report: Report
) -> tuple[Usd.TimeCode, Floats | None]:
    """When orientations are to be read, and the rotation vectors [count, 3] in radians that follow them, or None."""
    seconds = _since_sample(attribute, rates, time)
    if seconds == 0.0:
        return time, None
    sample = _bracket(attribute, time)
    assert sample is not None
    try:
        return Usd.TimeCode(sample[0]), np.radians(_rates(rates, sample[0], count)) * seconds
    except Unreadable as trouble:
        report.warn(attribute.GetPrim().GetPath(), f"{trouble}; the orientations are interpolated instead")
        return time, None


def _since_sample(attribute: Usd.Attribute, velocities: Usd.Attribute, time: Usd.TimeCode) -> float:
    """Seconds since the sample before a moment; 0 if velocities do not carry it on."""
    if time.IsDefault() or not velocities or not velocities.HasAuthoredValue():
        return 0.0
    sample = _bracket(attribute, time)
    if sample is None or _bracket(velocities, time) != sample:
        return 0.0
    return float((time.GetValue() - sample[0]) / attribute.GetPrim().GetStage().GetTimeCodesPerSecond())


def _rates(attribute: Usd.Attribute, sample: float, count: int) -> Floats:
    """The velocities or accelerations [count, 3] of a sample."""
    rates = read.floats(attribute, Usd.TimeCode(sample), 3)
    if rates is None or len(rates) != count:
        raise Unreadable(f"{attribute.GetName()} has {0 if rates is None else len(rates)} values for {count} points")
    if not np.isfinite(rates).all():
        raise Unreadable(f"{attribute.GetName()} has values that are NaN or infinite")
    return rates


def _bracket(attribute: Usd.Attribute, time: Usd.TimeCode) -> tuple[float, float] | None:
    """The times of the samples before and after a moment; None without samples.

    Velocities go with points only if both have the same: that is how USD knows that they were made together.
    """
    samples = attribute.GetBracketingTimeSamples(time.GetValue()) if attribute else ()
    return (samples[0], samples[1]) if samples else None
