"""The estimators: ways to compute the light of one iteration, one file each.

An estimator is built as ``Estimator(scene, camera, settings, scratch)``. Then ``estimate(iteration, gbuffer)`` fills
the G-buffer of one iteration: what the camera sees, and the direct and indirect irradiance over π there. The result
depends on these arguments alone.
"""

from collections.abc import Sequence
from types import ModuleType
from typing import ClassVar, Protocol

from warp_ir.device.scratch import Scratch
from warp_ir.device_scene import CameraData, DeviceScene
from warp_ir.estimators.keller import Keller
from warp_ir.estimators.path import PathTracer
from warp_ir.estimators.vpl import VplEstimator
from warp_ir.gbuffer import GBuffer
from warp_ir.scene import InputError, Scene
from warp_ir.settings import ResolvedSettings


class Estimator(Protocol):
    """One way to compute the light."""

    MODULES: ClassVar[Sequence[ModuleType]]
    """Modules with the kernels that it launches, those that take longest to compile first."""
    WAVEFRONT_MODULES: ClassVar[Sequence[ModuleType]]
    """Further modules where `Launcher.wavefront` is true; others are loaded when a scene needs them."""

    def __init__(self, scene: DeviceScene, camera: CameraData, settings: ResolvedSettings, scratch: Scratch) -> None:
        """Prepares for a scene, a camera and settings; what an iteration overwrites lies in `scratch`."""

    def prepare(self, iteration: int) -> object:
        """Does what of an iteration no graph can repeat: it uploads numbers, and learns a guide where that is due.

        `estimate` calls it as well. While the result is the same object, `estimate` makes the same launches.
        """

    def estimate(self, iteration: int, gbuffer: GBuffer) -> None:
        """Fills the G-buffer, direct and indirect irradiance included, for one iteration."""


ESTIMATORS: dict[str, type[Estimator]] = {"vpl": VplEstimator, "keller": Keller, "path": PathTracer}
"""By the names that `RenderSettings.estimator` takes."""


def estimator_of(name: str, scene: Scene) -> type[Estimator]:
    """The estimator of that name for a scene.

    Raises:
        InputError: The scene has gloss, which the estimator does not render.
    """
    if all(material.gloss is None for material in scene.materials):
        return ESTIMATORS[name]
    if name != "path":
        raise InputError(f"estimator: {name} reflects diffusely, and the scene has gloss, which path renders")
    from warp_ir.estimators.glossy_path import GlossyPathTracer  # not read for scenes without gloss

    return GlossyPathTracer
