"""The ways to compute the light. Each is one file with one verb: add one iteration to a film.

An estimator is built as ``Estimator(scene, camera, settings, launcher)`` from an uploaded scene and a
`CameraData`, and then ``estimate(iteration, gbuffer)`` fills, for
every pixel of the tiles of `gbuffer`, what the camera sees and its irradiance over π by way of the lights and by
way of surfaces. What it computes depends on these arguments alone.
"""

from typing import Any, Protocol

from warp_ir.device.launcher import Launcher
from warp_ir.device_scene import DeviceScene
from warp_ir.estimators.keller import Keller
from warp_ir.estimators.path import PathTracer
from warp_ir.estimators.vpl import VplEstimator
from warp_ir.gbuffer import GBuffer
from warp_ir.settings import RenderSettings


class Estimator(Protocol):
    """One way to compute the light."""

    def __init__(self, scene: DeviceScene, camera: Any, settings: RenderSettings, launcher: Launcher) -> None:
        """Prepares for a scene, a `CameraData` and settings with a definite width and height."""

    def estimate(self, iteration: int, gbuffer: GBuffer) -> None:
        """Fills the G-buffer, direct and indirect irradiance included, for one iteration."""


ESTIMATORS: dict[str, type[Estimator]] = {"vpl": VplEstimator, "keller": Keller, "path": PathTracer}
"""By the names that `RenderSettings.estimator` takes."""
