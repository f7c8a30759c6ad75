"""Photon targets: the point close to which the light of suns and skies passes on its way into the picture."""

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.device_scene import DeviceScene
from warp_ir.guiding.emitter_selection import MIN_GAIN, POWER_FRACTION, PRIOR
from warp_ir.guiding.probes import CameraProbes, clamp_outliers
from warp_ir.lights import PhotonTarget
from warp_ir.scene import LightKind
from warp_ir.vpl.guide import annulus_count

Floats = npt.NDArray[np.float64]

_ANNULI = 16
"""Number of annuli within the ball of details, which is the whole scene, or next to it."""
_ITERATIONS = 10
_REGULARIZATION = 1.0e-3
"""Smallest distance that is resolved, relative to the spread of the samples."""


def _areas(annuli: int) -> Floats:
    """Areas of the annuli, relative to the area of the whole disk."""
    return np.diff(0.25 ** np.arange(annuli - 1, -1, -1), prepend=0.0)


def _prior_probabilities(annuli: int) -> Floats:
    """Probabilities of the annuli without samples; none is too small for float32."""
    return np.asarray(0.95 * _areas(annuli) + 0.05 / annuli)


def learn_photon_target(scene: DeviceScene, probes: CameraProbes, launcher: Launcher) -> "PhotonTarget | None":
    """The `PhotonTarget` of distant lights and domes, learned from camera probes; None if the gain is small."""
    data = scene.data
    centre, radius = np.array(data.centre, np.float64), float(data.radius)
    rows = max(data.light_count, 1)
    focus = np.tile([*centre, radius], (rows, 1))
    annuli = annulus_count(scene, _ANNULI)
    areas = _areas(annuli)
    cdf = np.tile(np.cumsum(areas), (rows, 1))
    if data.focus_radius < data.radius:
        focus[:] = *data.focus, radius + float(np.linalg.norm(np.subtract(data.focus, data.centre)))
        cdf[:] = np.cumsum(np.full(annuli, 1.0 / annuli))
    kinds, item = data.emitter_kind.numpy(), data.emitter_item.numpy()
    at_infinity = (kinds == LightKind.DISTANT) | (kinds == LightKind.DOME)
    before = after = 0.0
    for emitter in np.nonzero(at_infinity)[0]:
        selected = (probes.emitter == emitter) & (probes.bounce > 0) & (probes.score > 0.0)
        if not selected.any():
            continue
        points, directions, score, training = (
            probes.position[selected],
            probes.target[selected, :3],
            probes.score[selected],
            probes.training[selected],
        )
        point = nearest_point(points, directions, score)
        outer_radius = radius + float(np.linalg.norm(point - centre))  # so that the disk covers the scene
        halvings = -np.log2(np.maximum(_distance_to_lines(points, directions, point) / outer_radius, 2.0**-annuli))
        annulus = annuli - 1 - np.clip(halvings, 0, annuli - 1).astype(np.int64)
        probability = _annulus_probabilities(annulus[training], score[training], annuli)
        before += score[~training].sum() * (radius / outer_radius) ** 2
        after += (score * (areas / probability)[annulus])[~training].sum()
        focus[item[emitter]] = *point, outer_radius
        cdf[item[emitter]] = np.cumsum(_annulus_probabilities(annulus, score, annuli))
    if before <= MIN_GAIN * after:
        return None
    photon_target = PhotonTarget()
    photon_target.annulus_count = annuli
    photon_target.focus = launcher.array(focus, wp.vec4)
    photon_target.cdf = launcher.array(np.pad(cdf / cdf[:, -1:], ((0, 0), (1, 0))).reshape(-1), wp.float32)
    return photon_target


def _annulus_probabilities(annulus: npt.NDArray[np.int64], score: Floats, annuli: int) -> Floats:
    """Probabilities of the annuli, float64 [annuli], learned from the scores of samples in them."""
    sums = np.bincount(annulus, clamp_outliers(score), annuli)
    total = sums.sum()
    if not total > 0.0:
        return _prior_probabilities(annuli)
    trust = (1.0 - POWER_FRACTION) / (1.0 + PRIOR * (score**2).sum() / total**2)
    # A sample counts for the neighbouring annuli as well.
    smooth = np.convolve(np.pad(sums, 1, mode="edge"), [0.25, 0.5, 0.25], "valid")
    return np.asarray(trust * smooth / smooth.sum() + (1.0 - trust) * _prior_probabilities(annuli))


def nearest_point(points: Floats, directions: Floats, weight: Floats) -> Floats:
    """The point [3] to which lines have the least weighted sum of distances (Weiszfeld's iteration).

    For parallel lines it is the point, along them, at the mean of the given points.

    Args:
        points: A point on each line, float64 [n, 3].
        directions: Unit direction of each line, float64 [n, 3].
        weight: Weight of each line, float64 [n].
    """
    point = middle = np.average(points, axis=0, weights=weight)
    spread = float(np.sqrt(np.average(((points - middle) ** 2).sum(axis=1), weights=weight)))
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    for _ in range(_ITERATIONS):
        w = weight / np.maximum(
            _distance_to_lines(points, directions, point), _REGULARIZATION * max(spread, _REGULARIZATION)
        )
        w /= w.sum()
        system = np.einsum("n,nij->ij", w, across) + _REGULARIZATION * np.eye(3)
        point = np.linalg.solve(system, np.einsum("n,nij,nj->i", w, across, points) + _REGULARIZATION * middle)
    return np.asarray(point)


def _distance_to_lines(points: Floats, directions: Floats, point: Floats) -> Floats:
    """Distances of a point from lines, float64 [n]."""
    to = points - point
    return np.asarray(np.linalg.norm(to - (to * directions).sum(axis=1, keepdims=True) * directions, axis=1))
