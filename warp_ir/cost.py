"""What a scene costs, before it is uploaded."""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from warp_ir.scene import Instances, Light, Mesh, MeshLight, Scene

# Bytes on the device, measured on the CPU; a GPU takes about as many.
_BASE = 7500  # sequences, and a row of each table that is empty
_TRIANGLE = 24  # its material, mesh, sides, and where its normals, colours and uvs are
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


def scene_bytes(scene: Scene) -> dict[str, int]:
    """About how much memory a scene takes where it is rendered, to a fifth, by what takes it.

    With the moments of an open shutter; what they share counts once. Films and VPLs are not in it.
    """
    out = dict.fromkeys(("geometry", "hierarchy", "instances", "textures", "lights"), 0.0)
    seen: set[object] = set()
    for moment in scene.shutter or (scene,):
        same = tuple(id(x) for x in (*moment.meshes, *moment.instances))
        if same not in seen:
            seen.add(same)
            _add_surfaces(moment, out)
    textures = {texture for material in scene.materials for texture in material.textures}
    out["textures"] = min(sum(_CHAIN * _TEXEL * texture.pixels.size for texture in textures), _MOST_TEXELS)
    out["lights"] = _of_lights(scene)
    out["geometry"] += _BASE
    return {name: round(size) for name, size in out.items()}


def _add_surfaces(scene: Scene, out: dict[str, float]) -> None:
    uv_sets = {texture.uv for material in scene.materials for texture in material.textures}
    emits = np.array([max(m.emission) > 0.0 for m in scene.materials], bool)
    triangles = 0
    stored: set[object] = set()
    for mesh, copies in _stored(scene, emits):
        count = len(mesh.triangles) * copies
        triangles += count
        corners = _CORNER * 3 * ((mesh.normals is not None) + (mesh.colors is not None))
        corners += _UV * 3 * len(uv_sets) * any(name in mesh.uvs for name in uv_sets)
        out["geometry"] += count * (_TRIANGLE + _INDICES + corners)
        out["geometry"] += _EMITTER * copies * float(emits[mesh.material].sum())
        geometry = id(mesh.points), id(mesh.triangles)
        if geometry not in stored:  # prototypes of one geometry share points and hierarchy
            stored.add(geometry)
            out["geometry"] += _POINT * len(mesh.points) * copies
            out["hierarchy"] += _TREE * count
    out["geometry"] += 4 * triangles * bool(emits.any())
    out["instances"] += _INSTANCE * sum(len(group.matrices) for group in scene.instances)


def _stored(scene: Scene, emits: npt.NDArray[np.bool_]) -> Iterator[tuple[Mesh, int]]:
    """Every mesh that has triangles, and how often it is written out: once, unless it is instanced and emits."""
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
