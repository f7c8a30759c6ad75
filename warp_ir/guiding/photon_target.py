"""Close by which point the light of suns and skies passes on its way into the picture."""

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.device_scene import DeviceScene
from warp_ir.guiding.emitter_selection import BY_POWER, PRIOR, WORTH
from warp_ir.guiding.probes import CameraProbes, clamp_outliers
from warp_ir.lights import PhotonTarget
from warp_ir.scene import LightKind

Floats = npt.NDArray[np.float64]

_RINGS = 16
_AREAS = np.diff(0.25 ** np.arange(_RINGS - 1, -1, -1), prepend=0.0)
"""Of the rings, over that of them all."""
_EVERYWHERE = 0.95 * _AREAS + 0.05 / _RINGS
"""Probabilities of the rings where nothing is known: none is so small that a float loses it."""
_STEPS = 10
_NEAR = 1.0e-3
"""Of the spread of the samples: distances are not told apart below."""


def learn_photon_target(scene: DeviceScene, seen: CameraProbes, launcher: Launcher) -> Any | None:
    """The `PhotonTarget` of distant lights and domes, learned from camera probes; None if the gain is small."""
    data = scene.data
    centre, radius = np.array(data.centre, np.float64), float(data.radius)
    rows = max(data.light_count, 1)
    focus = np.tile([*centre, radius], (rows, 1))
    cdf = np.tile(np.cumsum(_AREAS), (rows, 1))
    kinds, item = data.emitter_kind.numpy(), data.emitter_item.numpy()
    far = (kinds == LightKind.DISTANT) | (kinds == LightKind.DOME)
    before = after = 0.0
    for emitter in np.nonzero(far)[0]:
        mine = (seen.emitter == emitter) & (seen.bounce > 0) & (seen.score > 0.0)
        if not mine.any():
            continue
        points, ways, score, even = seen.position[mine], seen.target[mine, :3], seen.score[mine], seen.even[mine]
        place = nearest_point(points, ways, score)
        outer = radius + float(np.linalg.norm(place - centre))  # which covers the scene
        halvings = -np.log2(np.maximum(_apart(points, ways, place) / outer, 2.0**-_RINGS))
        ring = _RINGS - 1 - np.clip(halvings, 0, _RINGS - 1).astype(np.int64)
        learned = _shares(ring[even], score[even])
        before += score[~even].sum() * (radius / outer) ** 2
        after += (score * (_AREAS / learned)[ring])[~even].sum()
        focus[item[emitter]] = *place, outer
        cdf[item[emitter]] = np.cumsum(_shares(ring, score))
    if before <= WORTH * after:
        return None
    photon_target = PhotonTarget()
    photon_target.annulus_count = _RINGS
    photon_target.focus = launcher.array(focus, wp.vec4)
    photon_target.cdf = launcher.array(np.pad(cdf / cdf[:, -1:], ((0, 0), (1, 0))).reshape(-1), wp.float32)
    return photon_target


def _shares(ring: npt.NDArray[np.int64], score: Floats) -> Floats:
    """Probabilities of the rings."""
    sums = np.bincount(ring, clamp_outliers(score), _RINGS)
    total = sums.sum()
    if not total > 0.0:
        return _EVERYWHERE
    trust = (1.0 - BY_POWER) / (1.0 + PRIOR * (score**2).sum() / total**2)
    # A sample stands for its neighbours, too.
    smooth = np.convolve(np.pad(sums, 1, mode="edge"), [0.25, 0.5, 0.25], "valid")
    return np.asarray(trust * smooth / smooth.sum() + (1.0 - trust) * _EVERYWHERE)


def nearest_point(points: Floats, ways: Floats, weight: Floats) -> Floats:
    """The point [3] to which lines have the least weighted sum of distances (Weiszfeld's iteration).

    Along parallel lines it is where the points are that they go through.

    Args:
        points: On each line, float64 [n, 3].
        ways: Unit, float64 [n, 3].
        weight: float64 [n].
    """
    place = middle = np.average(points, axis=0, weights=weight)
    spread = float(np.sqrt(np.average(((points - middle) ** 2).sum(axis=1), weights=weight)))
    across = np.eye(3) - ways[:, :, None] * ways[:, None, :]
    for _ in range(_STEPS):
        w = weight / np.maximum(_apart(points, ways, place), _NEAR * max(spread, _NEAR))
        w /= w.sum()
        system = np.einsum("n,nij->ij", w, across) + _NEAR * np.eye(3)
        place = np.linalg.solve(system, np.einsum("n,nij,nj->i", w, across, points) + _NEAR * middle)
    return np.asarray(place)


def _apart(points: Floats, ways: Floats, place: Floats) -> Floats:
    """Distances of a place from lines."""
    to = points - place
    return np.asarray(np.linalg.norm(to - (to * ways).sum(axis=1, keepdims=True) * ways, axis=1))
