"""The coordinate frame of the scene on the device: centred and scaled, so that float32 is precise for any scene.

The origin is near the centre of the scene's bounding box, and a power of two scales the extent to between 1/2 and 1.
Radiance is invariant under scaling and a power of two rounds nothing: so a scene in millimetres, or far from the
world's origin, is as precise as any other, and no other module depends on the scale.

A prototype has a frame of its own, made the same way; its instances are matrices from there to the scene's frame.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

_GRID = 32.0
"""Grid points for the origin per unit of length in the device frame."""


@dataclass(frozen=True, eq=False)
class DeviceFrame:
    """The transform from world to device: device = (world - origin) * scale, where scale is a power of two."""

    origin: npt.NDArray[np.float64]
    scale: float

    def equals(self, other: "DeviceFrame") -> bool:
        """Whether two frames are bitwise equal."""
        return self.scale == other.scale and bool((self.origin == other.origin).all())

    def to_device(self, points: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Transforms world positions [..., 3] to the device's frame, float32."""
        return ((np.asarray(points, np.float64) - self.origin) * self.scale).astype(np.float32)

    def to_world(self, points: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Transforms device positions [..., 3] to world space, float64."""
        return np.asarray(points, np.float64) / self.scale + self.origin


def frame_of_box(lower: npt.NDArray[np.floating], upper: npt.NDArray[np.floating]) -> DeviceFrame:
    """The frame in which a box with corners [3] is centred and has a diagonal between 1/2 and 1."""
    extent = float(np.linalg.norm(upper - lower))
    # frexp is exact: a logarithm could round to either of two scales for an extent of exactly 2^k.
    return DeviceFrame(0.5 * (lower + upper), 2.0 ** -math.frexp(extent)[1] if extent > 0.0 else 1.0)


def snapped_frame_of_box(lower: npt.NDArray[np.floating], upper: npt.NDArray[np.floating]) -> DeviceFrame:
    """`frame_of_box` with its origin snapped to a grid, within 1/64 of the box's centre in each axis.

    So the frame, and with it all static geometry, stays the same while something moves a little and changes the box.
    """
    exact = frame_of_box(lower, upper)
    unit = exact.scale * _GRID
    return DeviceFrame(np.round(exact.origin * unit) / unit, exact.scale)
