"""A guide: the probabilities by which light paths start where they matter to the picture; `guiding` learns them.

A `Guide` holds three kinds of probabilities. Samples are weighted by their inverses, so guiding adds no bias.

* Selection probabilities of emitters: tables of the scene, in `Guide.scene`.
* The places where photons of lights at infinity enter the scene: `lights.PhotonTarget`.
* Survival probabilities of VPLs, by their contribution to the picture (Georgiev and Slusallek 2010). The contribution
  of a VPL is its intensity times the `VplImportance` of the cell of positions and directions that it lies in.
"""

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.device_scene import DeviceScene
from warp_ir.lights import PhotonTarget

wp.set_module_options({"enable_backward": False})

CELLS = 32
"""Number of cells along each edge of the cube around the scene."""
_CELLS = wp.constant(CELLS)
SIDES = 6
"""Number of directions of the normal that are told apart: the sides of a cube."""
_MAX_ANNULI = 30
MIN_SURVIVAL = 0.2
"""Least survival probability of a VPL: no weight grows by more than a factor of five."""
_MIN_SURVIVAL = wp.constant(MIN_SURVIVAL)


@wp.struct
class VplImportance:
    """Contribution of VPLs on surfaces to the picture."""

    known: int  # 0: not learned; all VPLs survive
    extent: float  # edge length of the cube, which is centred at the origin
    per_intensity: wp.array[
        wp.float32
    ]  # [sides, cells, cells, cells]; contribution over the threshold of survival, per intensity


@wp.func
def cell_of(position: wp.vec3, normal: wp.vec3, extent: float) -> int:
    """The cell of a VPL, by its position and the side of the cube that its normal faces."""
    axis = int(0)
    if wp.abs(normal[1]) > wp.abs(normal[axis]):
        axis = 1
    if wp.abs(normal[2]) > wp.abs(normal[axis]):
        axis = 2
    cell = 2 * axis + wp.where(normal[axis] < 0.0, 1, 0)
    for k in range(3):
        cell = cell * _CELLS + wp.clamp(int((position[k] / extent + 0.5) * float(_CELLS)), 0, _CELLS - 1)
    return cell


@wp.func
def survival_probability(importance: VplImportance, position: wp.vec3, normal: wp.vec3, intensity: wp.vec3) -> float:
    """Survival probability of a VPL."""
    contribution = importance.per_intensity[cell_of(position, normal, importance.extent)] * (
        intensity[0] + intensity[1] + intensity[2]
    )
    return wp.clamp(contribution, _MIN_SURVIVAL, 1.0)


@dataclass(frozen=True)
class Guide:
    """Where light paths start, and which of their VPLs survive."""

    scene: DeviceScene
    """The scene, with the selection probabilities of its emitters."""
    photon_target: PhotonTarget
    """Where photons of lights at infinity enter the scene."""
    importance: VplImportance
    """Contribution of VPLs, from which their survival probability follows."""
    path_multiplier: int = 1
    """Number of light paths to trace for each that is asked for, to make up for VPLs that do not survive."""
    density_ratio: float = 1.0
    """Density of surviving VPLs where they matter, relative to the mean over all surfaces."""


def unguided(scene: DeviceScene, launcher: Launcher) -> Guide:
    """A guide by which light paths start in proportion to power, and all VPLs survive."""
    importance = VplImportance()
    importance.per_intensity = launcher.empty(1, wp.float32)
    return Guide(scene, _target_of_details(scene, launcher), importance)


def _target_of_details(scene: DeviceScene, launcher: Launcher) -> PhotonTarget:
    """The photon target of a view of which nothing is known: all of the scene, but half of it the ball of details."""
    data, target = scene.data, PhotonTarget()
    if data.focus_radius >= data.radius:
        target.focus, target.cdf = launcher.empty(1, wp.vec4), launcher.empty(1, wp.float32)
        return target
    outer_radius = float(data.radius) + float(np.linalg.norm(np.subtract(data.focus, data.centre)))
    annuli = annulus_count(scene, 1)
    probabilities = np.full(annuli, 0.5 / annuli)
    probabilities[0] += 0.5
    rows = max(data.light_count, 1)
    target.annulus_count = annuli
    target.focus = launcher.array(np.tile([*data.focus, outer_radius], (rows, 1)), wp.vec4)
    target.cdf = launcher.array(np.tile(np.concatenate([[0.0], np.cumsum(probabilities)]), rows), wp.float32)
    return target


def annulus_count(scene: DeviceScene, within_details: int) -> int:
    """Number of annuli, each half as wide as the next, of which some are within the ball of details."""
    return min(within_details + max(math.floor(math.log2(scene.data.radius / scene.data.focus_radius)), 0), _MAX_ANNULI)
