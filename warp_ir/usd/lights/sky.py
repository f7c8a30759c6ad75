"""A sky for stages without light."""

import numpy as np

from warp_ir.scene import Light, LightKind

_ROWS = 256
_GROUND = 0.25
"""Radiance of the ground, which reflects a quarter of what falls on it."""


def overcast_sky(up_axis: str) -> Light:
    """The CIE's standard overcast sky (ISO 15469), of irradiance π on the ground, over grey ground.

    Its radiance is 9 / 7 at the zenith and a third of it at the horizon: Lz (1 + 2 sin γ) / 3 at the elevation γ.

    Args:
        up_axis: "Y" or "Z".
    """
    elevation = np.pi * (0.5 - (np.arange(_ROWS) + 0.5) / _ROWS)
    radiance = np.where(elevation > 0.0, 9.0 / 7.0 * (1.0 + 2.0 * np.sin(elevation)) / 3.0, _GROUND)
    texture = np.broadcast_to(radiance[:, None, None], (_ROWS, 2, 3)).astype(np.float32)
    world_from_light = np.eye(4)
    if up_axis == "Z":  # the pole of a dome is +Y
        world_from_light[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
    return Light("default sky", LightKind.DOME, (1.0, 1.0, 1.0), world_from_light=world_from_light, texture=texture)
