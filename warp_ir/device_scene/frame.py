"""The frame of the scene on the device, in which nothing is far from the origin.

On the device the scene lives in its own frame: next to the middle of its bounding box and scaled by
a power of two until its extent is between 1/2 and 1. Radiance does not change when a scene is scaled,
so nothing else has to know; and a scene in millimetres, or far from the origin, is as exact as any.

A prototype lives in a frame of its own, made the same way; its instances are matrices from there to the scene's.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

_GRID = 32.0
"""Places for the origin along the unit of length."""


@dataclass(frozen=True, eq=False)
class DeviceFrame:
    """Where the device's frame lies: device = (world - origin) * scale, scale a power of two."""

    origin: npt.NDArray[np.float64]
    scale: float

    def equals(self, other: "DeviceFrame") -> bool:
        """Whether the two are the same to the bit."""
        return self.scale == other.scale and bool((self.origin == other.origin).all())

    def to_device(self, points: Any) -> npt.NDArray[np.float32]:
        """World positions [..., 3] in the device's frame, float32."""
        return ((np.asarray(points, np.float64) - self.origin) * self.scale).astype(np.float32)

    def to_world(self, points: Any) -> npt.NDArray[np.float64]:
        """Device positions [..., 3] in world space."""
        return np.asarray(points, np.float64) / self.scale + self.origin


def frame_of_box(lower: Any, upper: Any) -> DeviceFrame:
    """The frame in which a box is centred, and its diagonal between 1/2 and 1."""
    extent = float(np.linalg.norm(upper - lower))
    # Rooms of exactly 2^k units must not jump between scales by rounding: frexp is exact.
    return DeviceFrame(0.5 * (lower + upper), 2.0 ** -math.frexp(extent)[1] if extent > 0.0 else 1.0)


def steady_frame_of_box(lower: Any, upper: Any) -> DeviceFrame:
    """Likewise, but with the origin on a grid, within 1/64 of the centre in each axis.

    What moves a little moves the box, and all that stands still should not have to follow.
    """
    exact = frame_of_box(lower, upper)
    unit = exact.scale * _GRID
    return DeviceFrame(np.round(exact.origin * unit) / unit, exact.scale)
