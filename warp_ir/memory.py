"""What a scene costs, before it is uploaded, and a picture."""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from warp_ir.scene import Instances, Light, Mesh, MeshLight, Scene
from warp_ir.settings import RenderSettings

# Bytes on the device, measured on the CPU; a GPU takes about as many.
_BASE = 7500  # sequences, and a row of each table that is empty
_TRIANGLE = 28  # its material, mesh, sides, and where its normals, colours, uvs and tangents are
_TREE = 67  # of its share of the hierarchy
_POINT = _INDICES = 12
_CORNER = 12  # of a normal or a colour
_UV = 8
_EMITTER = 16
_INSTANCE = 170
_LIGHT = 160
_TEXEL = 2  # of one channel: half precision
_CHAIN = 4.0 / 3.0  # of an image with all that is made smaller of it
_MOST_TEXELS = 2**30  # bytes to which textures are averaged down: `texture.MAX_BYTES`
_SKY = 16  # of a texel of a light: three floats, and its probability
_SHAPED = 8200  # directions of photons

# Bytes of a pixel: twelve are a colour, a place or a direction.
_COLOR = 12
_FILM = 92
_ITERATION = 68  # what the camera sees, and the light there
_OBSERVED = 93  # by the filter, beside the film
_LAYERS = 72  # where an iteration lay: two images and their noise
_FILTERED = 24
_SORTED = 18  # samples by pixels
_DENOISER = 100  # about; what it takes for itself is not in it


def pixel_bytes(scene: Scene, settings: RenderSettings) -> int:
    """How much memory a pixel takes where the scene is rendered, with its picture on the host."""
    mapped = any(material.normal_texture is not None for material in scene.materials)
    glows = scene.glows or settings.visible_lights
    iteration = _ITERATION + _COLOR * (glows + mapped)
    total = _FILM + _COLOR * glows + _COLOR
    if settings.filter and settings.estimator == "vpl":
        iteration = max(iteration, _LAYERS)
        total += _OBSERVED + _FILTERED
        moments = scene.shutter if settings.motion_blur else ()
        lens = settings.depth_of_field and scene.camera.lens_radius > 0.0
        surfaces = {tuple(id(x) for x in (*m.meshes, *m.instances)) for m in moments}
        total += _SORTED * (lens or len(moments) > 1) + _COLOR * (len(surfaces) > 1)
    return total + iteration + _DENOISER * settings.denoise


def scene_bytes(scene: Scene) -> dict[str, int]:
    """About how much memory a scene takes where it is rendered, to a fifth, by what takes it.

    With the moments of an open shutter; what they share counts once. Films and VPLs are not in it.
    """
    out = dict.fromkeys(("geometry", "hierarchy", "instances", "textures", "lights"), 0.0)
    moments = {tuple(id(x) for x in (*m.meshes, *m.instances)): m for m in scene.shutter or (scene,)}
    seen: set[object] = set()
    triangles = sum(_add_surfaces(moment, out, seen) for moment in moments.values())
    for moment in moments.values():
        _add_emitters(moment, triangles, out)
    textures = {texture for material in scene.materials for texture in material.textures}
    out["textures"] = min(sum(_CHAIN * _TEXEL * texture.pixels.size for texture in textures), _MOST_TEXELS)
    out["lights"] = _of_lights(scene)
    out["geometry"] += _BASE
    return {name: round(size) for name, size in out.items()}


def _add_surfaces(scene: Scene, out: dict[str, float], seen: set[object]) -> int:
    """Counts what is not in `seen`, and puts it there; returns the triangles that this adds."""
    uv_sets = {texture.uv for material in scene.materials for texture in material.textures}
    triangles = 0
    for mesh, copies in _stored(scene):
        if id(mesh) in seen:
            continue
        count = len(mesh.triangles) * copies
        triangles += count
        corners = _CORNER * 3 * sum(x is not None for x in (mesh.normals, mesh.colors, mesh.tangents))
        corners += _UV * 3 * len(uv_sets) * any(name in mesh.uvs for name in uv_sets)
        out["geometry"] += count * (_TRIANGLE + _INDICES + corners)
        geometry = id(mesh.points), id(mesh.triangles)
        if geometry not in seen:  # prototypes of one geometry share points and hierarchy
            out["geometry"] += _POINT * len(mesh.points) * copies
            out["hierarchy"] += _TREE * count
        seen |= {id(mesh), geometry}
    groups = tuple(id(group) for group in scene.instances)
    if groups not in seen:
        out["instances"] += _INSTANCE * sum(len(group.matrices) for group in scene.instances)
        seen.add(groups)
    return triangles


def _add_emitters(scene: Scene, triangles: int, out: dict[str, float]) -> None:
    """Every moment has its own list of emitters, and the place in it of every triangle."""
    emits = _emits(scene)
    if emits.any():
        out["geometry"] += 4 * triangles
        out["geometry"] += _EMITTER * sum(copies * float(emits[m.material].sum()) for m, copies in _stored(scene))


def _emits(scene: Scene) -> npt.NDArray[np.bool_]:
    return np.array([max(m.emission) > 0.0 for m in scene.materials], bool)


def _stored(scene: Scene) -> Iterator[tuple[Mesh, int]]:
    """Every mesh that has triangles, and how often it is written out: once, unless it is instanced and emits."""
    emits = _emits(scene)
    group_of: dict[int, Instances] = {k: group for group in scene.instances for k in group.meshes}
    for k, mesh in enumerate(scene.meshes):
        if len(mesh.triangles):
            yield mesh, len(group_of[k].matrices) if k in group_of and emits[mesh.material].any() else 1


def _of_lights(scene: Scene) -> float:
    images = {id(x.texture): x.texture.size // 3 for x in scene.lights if x.texture is not None}
    total = float(_LIGHT * len(scene.lights) + _SKY * sum(images.values()))
    links: set[frozenset[int]] = set()
    controls: list[Light | MeshLight] = [*scene.lights, *(mesh.light for mesh in scene.meshes if mesh.light)]
    for light in controls:
        links |= {light.unlit, light.shadowless} - {frozenset()}
        if light.shaping is not None:
            table = 0 if light.shaping.profile is None else light.shaping.profile.size
            columns = 1 if light.shaping.profile is None else light.shaping.profile.shape[1]
            total += _SHAPED * (1 + columns) / 2 + _SKY * table
    return total + 4 * len(links) * len(scene.meshes)
