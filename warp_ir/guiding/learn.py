"""Path guiding for light paths: what a few probe paths tell about where light paths matter to the picture.

Light paths start on emitters in proportion to power. If the camera sees one of a hundred lit rooms, only one in a
hundred VPLs lights the picture. So one or two thousand camera paths sample random emitters at each of their vertices,
with shadows, and half as many light paths leave VPLs that are connected with points that the camera sees. From these
samples are learned

* the probability of selecting each emitter                            emitter_selection.py
* the point close to which the light of suns and skies passes          photon_target.py
* the survival probability of VPLs, by their contribution              importance.py

Half of the samples are learned from; the other half measures the gain, and where that is small, nothing changes. The
result is a pure function of the scene, the camera, the size of the image and the seed: whoever renders some iterations
of a picture, or a part of it, learns the same.
"""

from dataclasses import replace

import numpy as np

from warp_ir.device.launcher import Launcher
from warp_ir.device_scene import CameraData, DeviceScene
from warp_ir.guiding.emitter_selection import learn_emitter_probabilities, probe_scene
from warp_ir.guiding.importance import learn_survival
from warp_ir.guiding.photon_target import learn_photon_target
from warp_ir.guiding.probes import connect_vpls, trace_camera_probes
from warp_ir.scene import LightKind
from warp_ir.settings import ResolvedSettings
from warp_ir.vpl.guide import Guide, unguided

_MIN_CAMERA_PATHS, _MAX_CAMERA_PATHS = 1024, 2048
"""Limits of the number of camera paths, one for every sixteen pixels: they take a small part of an iteration."""
_VPLS_PER_PATH = 1.5
"""Surviving VPLs on surfaces per light path, as in a closed room. Where there are fewer, more paths are started."""
_MAX_PATHS = 16
"""Largest factor by which the number of light paths grows."""
_PIXELS_PER_PATH = 2
"""Least number of pixels per light path: so tracing the paths remains cheap beside gathering."""


def guiding_applies(scene: DeviceScene, min_separation: float) -> bool:
    """Whether there is anything to learn: lights at infinity, emitters far apart, or of very different power.

    Args:
        scene: The scene.
        min_separation: `GuidingSettings.min_separation`.
    """
    lights, materials = scene.stored.lights, scene.stored.materials
    if any(light.kind in (LightKind.DISTANT, LightKind.DOME) for light in lights):
        return True
    if scene.data.uneven:
        return True
    positions = [light.world_from_light[:3, 3] for light in lights]
    emits = np.array([max(material.emission) > 0.0 for material in materials], bool)
    for mesh in scene.stored.meshes if emits.any() else ():
        emissive = mesh.triangles[emits[mesh.material]]
        if len(emissive):
            points = mesh.points[emissive.reshape(-1)]
            positions += [points.min(axis=0), points.max(axis=0)]
    extent = scene.detail_extent / scene.frame.scale
    return len(positions) > 1 and bool(np.linalg.norm(np.ptp(positions, axis=0)) > min_separation * extent)


def learn(scene: DeviceScene, camera: CameraData, launcher: Launcher, settings: ResolvedSettings) -> Guide:
    """Traces probe paths, and returns the guide of a view.

    The launcher's counts `guided_emitters`, `guided_far_lights` and `guided_vpls` say what was changed: 1 or 0.

    Args:
        scene: The scene.
        camera: The camera; its whole image counts, whatever part of it is rendered.
        launcher: Runs the kernels.
        settings: The settings of the render.
    """
    guide = unguided(scene, launcher)
    pixels = camera.image_columns * camera.image_rows
    paths = min(max(pixels // 16, _MIN_CAMERA_PATHS), _MAX_CAMERA_PATHS)
    # VPLs are dropped only where more paths make up for them; else the noise would be lower, but of lower frequency.
    max_paths = min(pixels // (_PIXELS_PER_PATH * settings.light_paths), _MAX_PATHS)
    guided_scene = photon_target = survival = None
    vpls_per_path = _VPLS_PER_PATH
    if scene.emits:
        probed = probe_scene(scene, launcher)
        probes = trace_camera_probes(probed, camera, launcher, paths, settings)
        if probes.score.any():
            guided_scene = learn_emitter_probabilities(scene, probed, probes, launcher)
            photon_target = learn_photon_target(scene, probes, launcher)
            guide = replace(guide, scene=guided_scene or scene, photon_target=photon_target or guide.photon_target)
            if max_paths > 1:
                connections = connect_vpls(guide, launcher, probes, paths // 2, settings)
                survival, vpls_per_path = learn_survival(connections, guide, launcher), connections.per_path
    if survival is not None:
        vpls_per_path *= survival.survival_rate
        guide = replace(guide, importance=survival.importance, density_ratio=survival.density_ratio)
    if vpls_per_path > 0.0:
        guide = replace(guide, path_multiplier=max(min(round(_VPLS_PER_PATH / vpls_per_path), max_paths), 1))
    decisions = {"guided_emitters": guided_scene, "guided_far_lights": photon_target, "guided_vpls": survival}
    for name, result in decisions.items():
        launcher.profile.counts[name] = int(result is not None)
    return guide
