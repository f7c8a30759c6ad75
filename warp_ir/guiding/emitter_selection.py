"""How often each emitter is chosen, by what it gives to the picture."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher, copy_record
from warp_ir.device_scene import DeviceScene, SceneData
from warp_ir.guiding.probes import CameraProbes

Floats = npt.NDArray[np.float64]

BY_POWER = 0.25
"""Share of the paths that begin as if nothing was known: no weight is more than four times as large."""
PRIOR = 4.0
"""Samples that what was known before stands for, beside those of the pilot."""
WORTH = 1.15
"""Times the variance without, at which learning is worth while."""


def learn_emitter_probabilities(scene: DeviceScene, seen: CameraProbes, launcher: Launcher) -> DeviceScene | None:
    """The scene, whose emitters are chosen by what they give; None if that gains little."""
    if scene.data.emitter_count < 2:
        return None
    power = np.diff(scene.data.emitter_cdf.numpy().astype(np.float64))
    power = np.maximum(power, np.finfo(np.float32).tiny)  # too weak for a float, and never chosen
    learned = probabilities(power, seen.emitter[seen.even], seen.score[seen.even])
    emitter, squares = seen.emitter[~seen.even], seen.score[~seen.even] ** 2
    if squares.sum() <= WORTH * (squares * (power / learned)[emitter]).sum():
        return None
    return _rechosen(scene, power, probabilities(power, seen.emitter, seen.score), launcher)


def probabilities(power: Floats, emitter: npt.NDArray[np.int64], score: Floats) -> Floats:
    """Probabilities of choosing each emitter, float64 [emitters].

    Down a binary tree over the list, in which neighbours are close to each other: either half gets what its samples
    say where they are many, and what its power says where they are few.

    Args:
        power: By which they were chosen, float64 [emitters], positive.
        emitter: Of each sample.
        score: What came from it, over the probability of the choice.
    """
    size = 1 << (len(power) - 1).bit_length()
    samples = [np.bincount(emitter, score**k, size).astype(np.float64) for k in (1, 2)]
    tree: list[list[Floats]] = [[np.pad(power, (0, size - len(power))), *samples]]
    while len(tree[-1][0]) > 1:
        tree.append([x[0::2] + x[1::2] for x in tree[-1]])
    out = np.ones(1)
    for halves, (power_of_both, sum_of_both, squares) in zip(tree[-2::-1], tree[:0:-1], strict=True):
        samples_that_count = _ratio(sum_of_both**2, squares)
        trust = samples_that_count / (samples_that_count + PRIOR)
        left = trust * _ratio(halves[1][0::2], sum_of_both) + (1.0 - trust) * _ratio(halves[0][0::2], power_of_both)
        out = np.stack([out * left, out * (1.0 - left)], axis=1).reshape(-1)
    return np.asarray(BY_POWER * power + (1.0 - BY_POWER) * out[: len(power)])


def _ratio(a: Floats, b: Floats) -> Floats:
    return np.divide(a, b, out=np.zeros_like(a), where=b > 0.0)


def _rechosen(scene: DeviceScene, power: Floats, chosen: Floats, launcher: Launcher) -> DeviceScene:
    """The same scene, its emitters chosen with other probabilities."""
    data = copy_record(scene.data)
    cdf = np.concatenate([[0.0], np.cumsum(chosen)])
    cdf /= cdf[-1]
    data.emitter_cdf = launcher.array(cdf, wp.float32)
    data.emitter_pdf_area = launcher.array(scene.data.emitter_pdf_area.numpy() * (np.diff(cdf) / power), wp.float32)
    itself = launcher.empty(1, SceneData)
    data.address = wp.uint64(itself.ptr)
    itself.assign(launcher.array([data], SceneData))
    return replace(scene, data=data, owners=(*scene.owners, itself))
