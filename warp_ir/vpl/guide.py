"""Where light paths begin and which VPLs are kept, so that the camera feels them; `pilot` learns it.

A `Guide` is three probabilities, whose inverses are weights: whatever they are, the light is the same on the mean.

* Emitters are chosen by what they give to the picture: tables of the scene, in `Guide.scene`.
* Photons from far away pass close by what they light: `lights.PhotonTarget`.
* VPLs that give little to the picture are dropped at random, and those that are kept shine for them (Georgiev and
  Slusallek 2010). What a VPL gives is its intensity times the
  `VplImportance` of the cell of space and direction that it is in.
"""

from dataclasses import dataclass
from typing import Any

import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.device_scene import DeviceScene
from warp_ir.lights import PhotonTarget

wp.set_module_options({"enable_backward": False})

CELLS = 32
"""Along each edge of the cube around the scene."""
_CELLS = wp.constant(CELLS)
SIDES = 6
"""Directions of the normal."""
MIN_SURVIVAL = 0.2
"""Probability with which the most useless VPL is kept: no weight is more than five times as large."""
_MIN_SURVIVAL = wp.constant(MIN_SURVIVAL)


@wp.struct
class VplImportance:
    """What VPLs on surfaces give to the picture."""

    known: int  # 0: it is not; all VPLs are kept
    extent: float  # edge of the cube, around the origin
    per_intensity: wp.array[wp.float32]  # [sides, cells, cells, cells]; times the intensity of all channels: 1 is much


@wp.func
def cell_of(position: wp.vec3, normal: wp.vec3, extent: float) -> int:
    """The cell of a VPL: where it is, and to which side of the cube it faces."""
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
    """With which a VPL is kept."""
    gives = importance.per_intensity[cell_of(position, normal, importance.extent)] * (
        intensity[0] + intensity[1] + intensity[2]
    )
    return wp.clamp(gives, _MIN_SURVIVAL, 1.0)


@dataclass(frozen=True)
class Guide:
    """Where light paths begin, and which of their VPLs are kept."""

    scene: DeviceScene
    """The scene; its emitters are chosen with the probabilities that pay."""
    photon_target: Any
    """The `PhotonTarget` of photons from far away."""
    importance: Any
    """The `VplImportance` of VPLs."""
    paths: int = 1
    """Light paths to start for each that is asked for, to make up for what is dropped."""
    density: float = 1.0
    """Of VPLs, where they count, over that on all surfaces."""


def unguided(scene: DeviceScene, launcher: Launcher) -> Guide:
    """Light paths begin in proportion to power, and all VPLs are kept."""
    photon_target, importance = PhotonTarget(), VplImportance()
    photon_target.focus, photon_target.cdf = (
        launcher.empty(1, wp.vec4),
        launcher.empty(1, wp.float32),
    )
    importance.per_intensity = launcher.empty(1, wp.float32)
    return Guide(scene, photon_target, importance)
