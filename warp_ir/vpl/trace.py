"""The VPLs of one iteration as arrays, for pictures of them and for other programs."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from warp_ir.device.launcher import Launcher
from warp_ir.device.scratch import Scratch
from warp_ir.device_scene import DeviceScene, upload_scene
from warp_ir.sampling.sobol import iteration_scramble
from warp_ir.scene import Scene
from warp_ir.settings import RenderSettings
from warp_ir.vpl.emission import VplBuffer, emit_vpls
from warp_ir.vpl.guide import unguided


@dataclass(frozen=True)
class Vpls:
    """A VPL cloud in world space, as NumPy arrays."""

    positions: npt.NDArray[np.float64]
    """[n, 3], world space; where `directional`, the unit direction towards the light."""
    normals: npt.NDArray[np.float32]
    """[n, 3], unit; zero where the VPL shines the same in all directions."""
    intensity: npt.NDArray[np.float32]
    """[n, 3], along the normal, before shaping [W/sr]; where `directional`, the irradiance [W/m²] on a surface that
    faces it."""
    bounce: npt.NDArray[np.int32]
    """[n], reflections before: 0 is a point on a light."""
    directional: npt.NDArray[np.bool_]
    """[n], whether the VPL is infinitely far away."""


def to_host(vpls: VplBuffer, scene: DeviceScene) -> Vpls:
    """Copies a `VplBuffer` back to world space."""
    n = int(vpls.count.numpy()[0])
    position, normal = vpls.position.numpy()[:n], vpls.normal.numpy()[:n]
    directional = position[:, 3] == 0.0
    area = np.where(directional, 1.0, scene.frame.scale**-2.0)[:, None]
    return Vpls(
        positions=np.where(directional[:, None], position[:, :3], scene.frame.to_world(position[:, :3])),
        normals=normal[:, :3].copy(),
        intensity=(vpls.intensity.numpy()[:n] * area).astype(np.float32),
        bounce=vpls.bounce.numpy()[:n].copy(),
        directional=directional,
    )


def trace_vpls(
    scene: Scene, settings: RenderSettings | None = None, *, device: str = "cpu", iteration: int = 0
) -> Vpls:
    """Traces the light paths of one iteration, without guiding, and returns their VPLs in world space.

    Args:
        scene: The scene; empty arrays come back if nothing in it emits.
        settings: `estimator`, `light_paths`, `absorption`, `max_bounces` and `seed` count; None: the defaults.
        device: "cpu", "cuda" or "cuda:N".
        iteration: Number of the iteration.

    Raises:
        InputError: The scene, the settings or the device cannot be used.
    """
    resolved = (settings or RenderSettings()).resolve()
    launcher = Launcher(device)
    uploaded = upload_scene(scene, launcher)
    vpls = emit_vpls(
        unguided(uploaded, launcher),
        Scratch(launcher),
        light_paths=resolved.light_paths,
        absorption=resolved.absorption,
        max_bounces=resolved.max_bounces,
        scramble=iteration_scramble(resolved.seed, iteration),
    )
    return to_host(vpls, uploaded)
