"""Newton's camera sensor with global illumination (extra `newton`)."""

from warp_ir.newton.sensor_camera import GiSettings, SensorCamera

__all__ = ["GiSettings", "SensorCamera"]
