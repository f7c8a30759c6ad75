"""Probabilities of selecting each emitter, learned from its contribution to the picture."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher, copy_record
from warp_ir.device_scene import DeviceScene, SceneData, emitter_lifts, floored_probabilities, selection_cdf
from warp_ir.guiding.probes import CameraProbes

Floats = npt.NDArray[np.float64]

POWER_FRACTION = 0.25
"""Share of the light paths that start in proportion to power: no weight grows by more than a factor of four."""
PROBE_FLOOR_SHARE = 0.5
"""Share of the probes' samples that sources of little power have together."""
PRIOR = 4.0
"""Number of samples that the prior, selection by power, counts for beside the probes."""
MIN_GAIN = 1.15
"""Least ratio of the variance without guiding to that with it, below which nothing is changed."""


def probe_scene(scene: DeviceScene, launcher: Launcher) -> DeviceScene:
    """The scene with the selection probabilities of probe paths: half of them for all sources alike, at least."""
    if scene.data.emitter_count < 2:
        return scene
    wanted = floored_probabilities(scene.emitter_power, scene.emitter_source, PROBE_FLOOR_SHARE)
    return _with_probabilities(scene, wanted, launcher)


def learn_emitter_probabilities(
    scene: DeviceScene, probed: DeviceScene, probes: CameraProbes, launcher: Launcher
) -> DeviceScene | None:
    """The scene with learned selection probabilities of its emitters; None if the gain is below `MIN_GAIN`.

    Args:
        scene: The scene.
        probed: The scene with the probabilities by which the probe paths selected emitters (`probe_scene`).
        probes: What they measured.
        launcher: Launcher of the device.
    """
    if scene.data.emitter_count < 2:
        return None
    power, sampled = (np.diff(s.data.emitter_cdf.numpy().astype(np.float64)) for s in (scene, probed))
    learned = probabilities(power, probes.emitter[probes.training], probes.score[probes.training])
    emitter, squares = probes.emitter[~probes.training], probes.score[~probes.training] ** 2
    before, after = ((squares * (sampled / p)[emitter]).sum() for p in (power, learned))
    if before <= MIN_GAIN * after:
        return None
    return _with_probabilities(scene, probabilities(power, probes.emitter, probes.score), launcher)


def probabilities(power: Floats, emitter: npt.NDArray[np.int64], score: Floats) -> Floats:
    """Probabilities of selecting each emitter, float64 [emitters].

    They are split down a binary tree over the list of emitters, in which neighbours are close to each other. At a node
    with many samples, the children get the shares of their samples; with few samples, the shares of their power.

    Args:
        power: Selection probabilities without samples, float64 [emitters], positive.
        emitter: Emitter of each sample.
        score: Contribution of each sample over its selection probability.
    """
    size = 1 << (len(power) - 1).bit_length()
    samples = [np.bincount(emitter, score**k, size).astype(np.float64) for k in (1, 2)]
    tree: list[list[Floats]] = [[np.pad(power, (0, size - len(power))), *samples]]
    while len(tree[-1][0]) > 1:
        tree.append([x[0::2] + x[1::2] for x in tree[-1]])
    out = np.ones(1)
    for children, (parent_power, parent_sum, squares) in zip(tree[-2::-1], tree[:0:-1], strict=True):
        effective_samples = _ratio(parent_sum**2, squares)
        trust = effective_samples / (effective_samples + PRIOR)
        left = trust * _ratio(children[1][0::2], parent_sum) + (1.0 - trust) * _ratio(children[0][0::2], parent_power)
        out = np.stack([out * left, out * (1.0 - left)], axis=1).reshape(-1)
    return np.asarray(POWER_FRACTION * power + (1.0 - POWER_FRACTION) * out[: len(power)])


def _ratio(a: Floats, b: Floats) -> Floats:
    return np.divide(a, b, out=np.zeros_like(a), where=b > 0.0)


def _with_probabilities(scene: DeviceScene, probability: Floats, launcher: Launcher) -> DeviceScene:
    """The scene with other selection probabilities of its emitters."""
    data = copy_record(scene.data)
    before, cdf = scene.data.emitter_cdf.numpy().astype(np.float64), selection_cdf(probability)
    data.emitter_cdf = launcher.array(cdf, wp.float32)
    if data.uneven:
        data.emitter_lift = launcher.array(emitter_lifts(cdf, scene.emitter_power), wp.float32)
    ratio = np.diff(cdf) / np.diff(before)
    data.emitter_pdf_area = launcher.array(scene.data.emitter_pdf_area.numpy() * ratio, wp.float32)
    device_copy = launcher.empty(1, SceneData)
    data.address = wp.uint64(device_copy.ptr)
    device_copy.assign(launcher.array([data], SceneData))
    return replace(scene, data=data, owners=(*scene.owners, device_copy))
