"""A guide: the probabilities by which light paths go where they matter to the picture; `guiding` learns them.

A `Guide` holds four kinds of probabilities. Samples are weighted by their inverses, so guiding adds no bias.

* Selection probabilities of emitters: tables of the scene, in `Guide.scene`.
* The places where photons of lights at infinity enter the scene: `lights.PhotonTarget`.
* The `ViewImportance`, what the picture gains from a VPL and from the path that goes on from it. Of several directions
  a path takes one in proportion to it, and VPLs survive in proportion to it (Georgiev and Slusallek 2010).
* The `TileVisibility`, by which shadow rays are drawn.
"""

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.device_scene import DeviceScene
from warp_ir.lights import PhotonTarget
from warp_ir.vpl.visibility import TileVisibility, nothing_learned

wp.set_module_options({"enable_backward": False})

CELLS = 16
"""Number of cells along each edge of the cube around the scene."""
_CELLS = wp.constant(CELLS)
SIDES = 6
"""Number of directions of the normal that are told apart: the sides of a cube."""
_MAX_ANNULI = 30
MIN_SURVIVAL = 0.2
"""Least survival probability of a VPL: no weight grows by more than a factor of five."""
_MIN_SURVIVAL = wp.constant(MIN_SURVIVAL)
_MAX_PATH_SURVIVAL = wp.constant(0.95)
FLOOR = 0.1
"""Least weight of a direction that meets a surface, relative to the mean over the directions from where it starts."""
_FLOOR = wp.constant(FLOOR)


@wp.struct
class ViewImportance:
    """Contribution to the picture by cell of space and direction, per intensity of a VPL on a surface there.

    It is the solution of the adjoint transport equation: of a VPL itself, and of the VPLs that its path leaves later.
    """

    known: int  # 0: not learned; all VPLs survive
    candidates: int  # directions from which a light path takes one; 1: light paths are not guided
    extent: float  # edge length of the cube, which is centred at the origin
    per_intensity: wp.array[wp.vec2]  # [sides, cells, cells, cells]; of the VPL itself, and of what follows it
    at_emission: float  # mean of the sum of both where photons meet their first surface
    path_contribution: float  # expected contribution of a light path
    survival_threshold: float  # contribution of a VPL from which on it always survives


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
def importance_at(importance: ViewImportance, position: wp.vec3, normal: wp.vec3) -> wp.vec2:
    """Contribution per intensity of a VPL itself, and of what follows it."""
    return importance.per_intensity[cell_of(position, normal, importance.extent)]


@wp.func
def survival_probability(importance: ViewImportance, position: wp.vec3, normal: wp.vec3, intensity: wp.vec3) -> float:
    """Survival probability of a VPL."""
    contribution = importance_at(importance, position, normal)[0] * (intensity[0] + intensity[1] + intensity[2])
    return wp.clamp(contribution / wp.max(importance.survival_threshold, 1.0e-30), _MIN_SURVIVAL, 1.0)


@wp.func
def path_survival(
    importance: ViewImportance, position: wp.vec3, normal: wp.vec3, intensity: wp.vec3, reflectivity: float
) -> float:
    """Survival probability of a guided path that would leave a VPL (adjoint-driven roulette, Vorba and Křivánek 2016).

    It is what the VPL and all that follows contribute, relative to a path's expectation; but within limits.
    """
    value = importance_at(importance, position, normal)
    contribution = (value[0] + value[1]) * (intensity[0] + intensity[1] + intensity[2])
    relative = contribution / wp.max(importance.path_contribution, 1.0e-30)
    return wp.clamp(relative, _MIN_SURVIVAL * reflectivity, wp.max(reflectivity, _MAX_PATH_SURVIVAL))


@wp.func
def floor_from(importance: ViewImportance, position: wp.vec3, normal: wp.vec3) -> float:
    """Weight that every direction from a VPL has in addition to its importance: light goes everywhere."""
    return _FLOOR * importance_at(importance, position, normal)[1]


@wp.func
def floor_at_emission(importance: ViewImportance) -> float:
    """`floor_from` where light leaves an emitter."""
    return _FLOOR * importance.at_emission


@dataclass(frozen=True)
class Guide:
    """Where light paths start and go, and which of their VPLs survive."""

    scene: DeviceScene
    """The scene, with the selection probabilities of its emitters."""
    photon_target: PhotonTarget
    """Where photons of lights at infinity enter the scene."""
    importance: ViewImportance
    """Contribution of VPLs and of what follows them, by which paths are guided and VPLs survive."""
    visibility: TileVisibility
    """Which VPLs the tiles of the picture see, by which shadow rays are drawn."""
    path_multiplier: int = 1
    """Number of light paths to trace for each that is asked for, where few of them contribute to the picture."""
    density_ratio: float = 1.0
    """Density of surviving VPLs where they matter, relative to the mean over all surfaces."""


def unguided(scene: DeviceScene, launcher: Launcher) -> Guide:
    """A guide by which light paths start in proportion to power, and all VPLs survive."""
    importance = ViewImportance()
    importance.candidates = 1
    importance.per_intensity = launcher.empty(1, wp.vec2)
    return Guide(scene, _target_of_details(scene, launcher), importance, nothing_learned(launcher))


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
