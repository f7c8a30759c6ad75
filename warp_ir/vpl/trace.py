"""The VPLs of one iteration as arrays, for pictures of them and for other programs."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.device.scratch import Scratch
from warp_ir.device_scene import DeviceScene, upload_scene
from warp_ir.sampling.sobol import iteration_scramble
from warp_ir.scene import Scene
from warp_ir.settings import RenderSettings, ResolvedSettings
from warp_ir.vpl.contribution import SeenSurface, contributions
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
    path: npt.NDArray[np.int32]
    """[n], number of the light path that left the VPL; -1 if there were so many VPLs that not all were stored."""
    parent: npt.NDArray[np.int32]
    """[n], index of the VPL at the vertex before, from which the light came; -1: it is on a light, or `path` is -1."""
    contribution: npt.NDArray[np.float32] | None = None
    """[n, 3], radiance that the VPL adds to what `contribution_to` of `trace_vpls` names [W sr⁻¹ m⁻²]; zero where it is
    hidden or faces away."""
    pixel_position: npt.NDArray[np.float64] | None = None
    """[3], the point that the chosen pixel sees, world space; None: no pixel was chosen, or it sees no surface."""


def to_host(vpls: VplBuffer, scene: DeviceScene, lengths: npt.NDArray[np.int32]) -> Vpls:
    """Copies a `VplBuffer` back to world space.

    Args:
        vpls: The VPLs; those on lights are the starts of the first paths.
        scene: The scene in which they were traced.
        lengths: [paths], number of VPLs that each path left on surfaces.
    """
    n = int(vpls.count.numpy()[0])
    position, normal = vpls.position.numpy()[:n], vpls.normal.numpy()[:n]
    directional = position[:, 3] == 0.0
    area = np.where(directional, 1.0, scene.frame.scale**-2.0)[:, None]
    bounce = vpls.bounce.numpy()[:n].copy()
    path, parent = _ancestry(lengths, vpls.on_lights, n, bounce)
    return Vpls(
        positions=np.where(directional[:, None], position[:, :3], scene.frame.to_world(position[:, :3])),
        normals=normal[:, :3].copy(),
        intensity=(vpls.intensity.numpy()[:n] * area).astype(np.float32),
        bounce=bounce,
        directional=directional,
        path=path,
        parent=parent,
    )


def _ancestry(
    lengths: npt.NDArray[np.int32], on_lights: int, rows: int, bounce: npt.NDArray[np.int32]
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """Path and parent of each VPL. Row i < `on_lights` is the start of path i; the others follow path by path."""
    path = np.concatenate([np.arange(on_lights), np.repeat(np.arange(len(lengths)), lengths)])
    if len(path) != rows:  # there were more VPLs than can be stored: only the device knows which were
        path = np.concatenate([np.arange(on_lights), np.full(rows - on_lights, -1)])
        return path.astype(np.int32), np.full(rows, -1, np.int32)
    parent = np.where(bounce == 1, path, np.arange(rows) - 1)
    parent = np.where(bounce == 0, -1, parent)
    return path.astype(np.int32), parent.astype(np.int32)


def trace_vpls(
    scene: Scene,
    settings: RenderSettings | None = None,
    *,
    device: str = "cpu",
    iteration: int = 0,
    contribution_to: tuple[int, int] | str | None = None,
) -> Vpls:
    """Traces the light paths of one iteration, without guiding, and returns their VPLs in world space.

    Args:
        scene: The scene; empty arrays come back if nothing in it emits.
        settings: `estimator`, `light_paths`, `absorption`, `max_bounces` and `seed` count, and with `contribution_to`
            what describes the image; None: the defaults.
        device: "cpu", "cuda" or "cuda:N".
        iteration: Number of the iteration.
        contribution_to: What `Vpls.contribution` is computed for: a pixel (column, row) of the image, or "picture", the
            mean over some thousand points that the camera sees. None: for nothing.

    Raises:
        InputError: The scene, the settings or the device cannot be used, or there is no such pixel.
    """
    settings = settings or RenderSettings()
    launcher = Launcher(device)
    resolved = settings.resolve(scene.camera.aspect, max_paths=launcher.max_light_paths())
    uploaded = upload_scene(scene, launcher)
    buffer, vpls = trace_uploaded(uploaded, Scratch(launcher), resolved, iteration)
    if contribution_to is None:
        return vpls
    seen = SeenSurface.of(scene, uploaded, launcher, replace(settings, height=resolved.height), contribution_to)
    position = None if contribution_to == "picture" else seen.position
    return replace(vpls, contribution=contributions(uploaded, launcher, buffer, seen), pixel_position=position)


def trace_uploaded(
    scene: DeviceScene, scratch: Scratch, settings: ResolvedSettings, iteration: int = 0
) -> tuple[VplBuffer, Vpls]:
    """The VPLs of one iteration, without guiding, of a scene on the device: there, in `scratch`, and on the host."""
    buffer = emit_vpls(
        unguided(scene, scratch.launcher),
        scratch,
        light_paths=settings.light_paths,
        absorption=settings.absorption,
        max_bounces=settings.max_bounces,
        scramble=iteration_scramble(settings.seed, iteration),
    )
    paths = settings.light_paths if buffer.on_lights else 0
    lengths = scratch.array("lengths", paths, wp.int32).numpy()[:paths]
    return buffer, to_host(buffer, scene, lengths)
