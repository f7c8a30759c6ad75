"""Path guiding for light paths: what a few probe paths tell about where light paths matter to the picture.

Light paths start on emitters in proportion to power and are reflected at random. If the camera sees one of a hundred
lit rooms, or looks away from the door through which all light comes, few of them leave VPLs that light the picture. So
one or two thousand camera paths sample random emitters at each of their vertices, with shadows, and as many light paths
are connected with points that the camera sees. From these samples are learned

* the probability of selecting each emitter                            emitter_selection.py
* the point close to which the light of suns and skies passes          photon_target.py
* what the picture gains from a light path, wherever it is             importance.py
* which VPLs each tile of the picture sees                             visibility.py

By the third of them paths choose their directions, and VPLs survive; and its variance tells how many paths there should
be. What is learned from some samples is measured by others, and where the gain is small, nothing changes. The result is
a pure function of the scene, the camera, the size of the image and the seed: whoever renders some iterations of a
picture, or a part of it, learns the same.
"""

import math
from dataclasses import replace

from warp_ir.device.launcher import Launcher
from warp_ir.device_scene import CameraData, DeviceScene
from warp_ir.guiding.emitter_selection import learn_emitter_probabilities, probe_scene
from warp_ir.guiding.importance import VplSurvival, learn_importance, learn_survival, path_variance
from warp_ir.guiding.photon_target import learn_photon_target
from warp_ir.guiding.probes import (
    CameraProbes,
    camera_vertices,
    cells_extent,
    light_vertices,
    trace_camera_probes,
)
from warp_ir.guiding.visibility import new_visibility
from warp_ir.settings import ResolvedSettings
from warp_ir.vpl.guide import Guide, unguided

_MIN_CAMERA_PATHS, _MAX_CAMERA_PATHS = 1024, 2048
"""Limits of the number of camera paths, one for every sixteen pixels: they take a small part of an iteration."""
_MIN_LIGHT_PATHS, _MAX_LIGHT_PATHS = 512, 1024
"""Limits of the number of light paths of a probe, one for every eight pixels."""
_CANDIDATES = 8
"""Directions that are traced, of which a guided light path takes one."""
_MIN_VARIANCE = 4.0
"""Relative variance of a light path's contribution below which nothing is to be gained by guiding."""
_MIN_PATH_GAIN = 1.2
"""Least ratio of that variance without guiding to that with it: guided paths take longer to trace."""
_GATHERING_ERROR = 1.0 / 150.0
"""Typical squared relative error that gathering leaves in a filtered picture of one iteration."""
_CANDIDATE_PIXELS = 0.25
"""Time of a candidate at all vertices of a light path, in pixels gathered; the rest of a path takes as long."""
_VPLS_PER_PATH = 1.5
"""Surviving VPLs on surfaces per light path, as in a closed room. Where there are fewer, more paths are started."""
_MAX_PATHS = 16
"""Largest factor by which the number of light paths grows."""
_PIXELS_PER_PATH = 2
"""Least number of pixels per light path: so tracing the paths remains cheap beside gathering."""


def learn(scene: DeviceScene, camera: CameraData, launcher: Launcher, settings: ResolvedSettings) -> Guide:
    """Traces probe paths, and returns the guide of a view.

    The launcher's counts `guided_emitters`, `guided_far_lights`, `guided_paths`, `guided_vpls` and `guided_rays` say
    what was changed: 1 or 0. The tables of visibility are allocated only: `learn_visibility` fills them in.

    Args:
        scene: The scene.
        camera: The camera; its whole image counts, whatever part of it is rendered.
        launcher: Runs the kernels.
        settings: The settings of the render.
    """
    guide = unguided(scene, launcher)
    pixels = camera.image_columns * camera.image_rows
    paths = min(max(pixels // 16, _MIN_CAMERA_PATHS), _MAX_CAMERA_PATHS)
    guided_scene = photon_target = survival = None
    if scene.emits:
        probed = probe_scene(scene, launcher)
        probes = trace_camera_probes(probed, camera, launcher, paths, settings)
        if probes.score.any():
            guided_scene = learn_emitter_probabilities(scene, probed, probes, launcher)
            photon_target = learn_photon_target(scene, probes, launcher)
            guide = replace(guide, scene=guided_scene or scene, photon_target=photon_target or guide.photon_target)
        if settings.max_bounces > 0:
            guide, survival = _guide_paths(guide, launcher, probes, pixels, settings)
        if settings.guiding and settings.guiding.visibility and not camera.blurs:
            guide = replace(guide, visibility=new_visibility(camera, launcher))
    decisions = {
        "guided_emitters": guided_scene is not None,
        "guided_far_lights": photon_target is not None,
        "guided_paths": guide.importance.candidates > 1,
        "guided_vpls": survival is not None,
        "guided_rays": guide.visibility.columns > 0,
    }
    for name, result in decisions.items():
        launcher.profile.counts[name] = int(result)
    return guide


def _guide_paths(
    guide: Guide, launcher: Launcher, probes: CameraProbes, pixels: int, settings: ResolvedSettings
) -> tuple[Guide, VplSurvival | None]:
    """The guide with what light paths tell: how they go on, how many there are, and which VPLs survive."""
    probed = min(max(pixels // 8, _MIN_LIGHT_PATHS), _MAX_LIGHT_PATHS)
    probe = light_vertices(guide, launcher, probes, probed, settings, 0)
    if not probe.contribution.any():
        return guide, None
    variance = path_variance(probe, learn_importance(probe).own_at(len(probe.cell)), probed)
    if variance <= _MIN_VARIANCE:
        return guide, None
    vertices = camera_vertices(guide.scene, launcher, probes) + probe
    learned = learn_importance(vertices)
    variance = path_variance(probe, learned.own_at(len(probe.cell)), probed)
    # A first guide finds its way to where light paths without one seldom come; the second is learned from both.
    extent, total = cells_extent(guide.scene), float((learned.own_at(len(probe.cell)) * probe.intensity).sum())
    first = learned.record(launcher, _CANDIDATES, extent, vertices, total / probed)
    guided = light_vertices(replace(guide, importance=first), launcher, probes, probed, settings, 1)
    vertices = vertices + guided
    learned = learn_importance(vertices)
    guided_variance = path_variance(guided, learned.own_at(len(guided.cell)), probed)
    candidates = 1
    if variance > _MIN_PATH_GAIN * guided_variance:
        candidates, probe, variance = _CANDIDATES, guided, guided_variance
    most = max(min(pixels // (_PIXELS_PER_PATH * settings.light_paths), _MAX_PATHS), 1)
    path_pixels = _CANDIDATE_PIXELS * (candidates + 1)
    multiplier = _path_multiplier(variance, pixels / path_pixels, settings.light_paths, most)
    own = learned.own_at(len(probe.cell))
    density_ratio, survival = 1.0, None
    if most > 1:
        # VPLs are dropped only where more paths make up for them: else noise would be less, but of lower frequency.
        survival = learn_survival(probe, own, guide.scene)
    if survival is not None:
        multiplier = max(multiplier, min(round(_VPLS_PER_PATH * probed / survival.survivors), most))
        density_ratio = survival.density_ratio
    paths = multiplier * settings.light_paths
    contribution = float((own * probe.intensity).sum()) / paths
    importance = learned.record(launcher, candidates, extent, vertices, contribution)
    if survival is not None:
        importance.survival_threshold = survival.threshold * probed / paths
    guide = replace(guide, importance=importance, path_multiplier=multiplier, density_ratio=density_ratio)
    return guide, survival


def _path_multiplier(variance: float, pixels: float, light_paths: int, most: int) -> int:
    """Number of light paths to trace for each that is asked for, a power of two.

    The squared error of N light paths is v/N, that of gathering e. So the error at equal time, (v/N + e) (N + pixels),
    is least for N² = v/e times the number of pixels; `pixels` is how many light paths take the time of gathering.
    """
    best = math.sqrt(max(variance, 0.0) / _GATHERING_ERROR * pixels)
    return min(1 << round(math.log2(max(best / light_paths, 1.0))), most)
