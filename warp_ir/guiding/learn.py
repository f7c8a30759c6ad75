"""The pilot: a small look at the scene that learns where light paths should go, once for every camera.

Light paths begin on emitters in proportion to power. Of a hundred lit rooms the camera may see one: then so do a
hundredth of the VPLs. Some hundred camera paths ask at each of their vertices for the light of random emitters, shadows
and all, and some hundred light paths leave VPLs that are connected with what the camera sees. That tells

* how much of the picture is due to each emitter              emitters.py
* close by which point the light from far away passes          rings.py
* what VPLs give to the picture, by where they are             worth.py

Half of the samples learn, the other half measures what would be gained; where that is little, nothing changes. All
of it is a pure function of the scene, the camera, the size of the image and the seed: whoever renders
some iterations of a picture, or a part of it, learns the same.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from warp_ir.device.launcher import Launcher
from warp_ir.device_scene import DeviceScene
from warp_ir.guiding.emitter_selection import learn_emitter_probabilities
from warp_ir.guiding.importance import learn_survival
from warp_ir.guiding.photon_target import learn_photon_target
from warp_ir.guiding.probes import connect_vpls, trace_camera_probes
from warp_ir.scene import LightKind
from warp_ir.settings import ResolvedSettings
from warp_ir.vpl.guide import Guide, unguided

_APART = 0.25
"""Of the scene's diagonal: lights that are closer together than that are seen together, or not at all."""
_FEWEST, _MOST = 1024, 2048
"""Camera paths; one for every sixteen pixels within these limits, so that they take a small part of an iteration."""
_VPLS_PER_PATH = 1.5
"""On surfaces, and kept, as in a room. Where light escapes, or VPLs are dropped, more paths make up for it."""
_MOST_PATHS = 16
_PIXELS_PER_PATH = 2
"""Of the image at least, for every light path that is started: so the paths remain cheap next to the gathering."""


def guiding_applies(scene: DeviceScene) -> bool:
    """Whether there is anything to learn: light from far away, or from places far apart."""
    lights, materials = scene.stored.lights, scene.stored.materials
    if any(light.kind in (LightKind.DISTANT, LightKind.DOME) for light in lights):
        return True
    places = [light.world_from_light[:3, 3] for light in lights]
    emits = np.array([max(material.emission) > 0.0 for material in materials], bool)
    for mesh in scene.stored.meshes if emits.any() else ():
        glowing = mesh.triangles[emits[mesh.material]]
        if len(glowing):
            points = mesh.points[glowing.reshape(-1)]
            places += [points.min(axis=0), points.max(axis=0)]
    lower, upper = np.reshape(scene.bounds, (2, 3))
    return len(places) > 1 and bool(np.linalg.norm(np.ptp(places, axis=0)) > _APART * np.linalg.norm(upper - lower))


def learn(scene: DeviceScene, camera: Any, launcher: Launcher, settings: ResolvedSettings) -> Guide:
    """Sends the pilot, and returns where light paths should go.

    What it has decided is in the launcher's counts: `guided_emitters`, `guided_far_lights`, `guided_vpls` are 1 or 0.

    Args:
        scene: Where.
        camera: The `CameraData` of what is to be rendered; of it the whole image counts, whatever part is rendered.
        launcher: Where to run.
        settings: With a definite width and height.
    """
    guide = unguided(scene, launcher)
    pixels = camera.image_columns * camera.image_rows
    paths = min(max(pixels // 16, _FEWEST), _MOST)
    # VPLs are dropped only where more paths can make up for them: else there would be less noise, but in larger spots.
    most = min(pixels // (_PIXELS_PER_PATH * settings.light_paths), _MOST_PATHS)
    chosen = photon_target = importance = None
    left = _VPLS_PER_PATH
    if scene.emits:
        sightings = trace_camera_probes(scene, camera, launcher, paths, settings)
        if sightings.score.any():
            chosen, photon_target = (
                learn_emitter_probabilities(scene, sightings, launcher),
                learn_photon_target(scene, sightings, launcher),
            )
            guide = replace(guide, scene=chosen or scene, photon_target=photon_target or guide.photon_target)
            if most > 1:
                found = connect_vpls(guide, launcher, sightings, paths // 2, settings)
                importance, left = learn_survival(found, guide, launcher), found.per_path
    if importance is not None:
        left *= importance.kept
        guide = replace(guide, importance=importance.table, density=importance.density)
    if left > 0.0:
        guide = replace(guide, paths=max(min(round(_VPLS_PER_PATH / left), most), 1))
    decided = {"guided_emitters": chosen, "guided_far_lights": photon_target, "guided_vpls": importance}
    for name, learned in decided.items():
        launcher.profile.counts[name] = int(learned is not None)
    return guide
