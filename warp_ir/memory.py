"""Memory: what a pixel and a scene take where they are rendered, before anything is uploaded, and what there is."""

import math
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import numpy.typing as npt

from warp_ir.scene import InputError, Instances, Light, Mesh, MeshLight, Scene
from warp_ir.settings import RenderSettings

_CGROUPS, _OWN_CGROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
_CGROUP_FILES = ("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes")
"""Limit and usage in versions 2 and 1."""
_SMALL = 1 << 26
"""What is asked for without a look at what there is [bytes]."""
_FLOAT = _INT = 4
_VEC2, _VEC3, _VEC4 = 8, 12, 16

# Bytes of a pixel. `FilmData`: mean radiance, its standard deviation, and sums of the G-buffer.
_FILM = {
    "direct, indirect": 2 * _VEC3,
    "standard_deviation": _VEC3,
    "albedo, normal, position": 3 * _VEC3,
    "depth": _FLOAT,
    "count, hits, rejected, mesh": 4 * _INT,
}  # 92
# `new_gbuffer`: what an iteration fills in. Direct light is stored in place of the geometric normal.
_ITERATION = {
    "position, normal or direct, shading_normal, albedo": 4 * _VEC3,
    "indirect": _VEC3,
    "mesh": _INT,
    "depth": _FLOAT,
}  # 68
# `SampleBuffer`: the samples on the surface of each pixel, and that surface.
_SAMPLE_BUFFER = {
    "surface: position, normal": 2 * _VEC3,
    "surface: footprint": _FLOAT,
    "surface: edge": 1,
    "direct, indirect, unassigned_direct, unassigned_indirect": 4 * _VEC3,
    "squares": _VEC2,
    "count, unassigned_count": 2 * _INT,
}  # 93
# Scratch of the filter, in the memory of the iteration: two layers of direct and indirect light with their variance.
_FILTER_SCRATCH = {"layers": 4 * _VEC4, "variance": _VEC2}  # 72
_RESOLVED_PICTURE = {"direct, indirect": 2 * _VEC3}  # 24
_TILE_VISIBILITY = {"to_lights, to_surfaces": 2 * _FLOAT, "rays": 2 * _INT / 64}  # 64 factors of each for 64 pixels
_REPROJECTION = {"samples sorted by pixels": 4 * _INT * 9 // 8}  # 18: scratch buffers have an eighth in reserve
_SURFACE_POINT = {"triangle, instance, weights": 3 * _INT}  # 12
_DENOISER = 100  # approximately, for its inputs and output; what the denoiser itself allocates is not counted


def pixel_bytes(scene: Scene, settings: RenderSettings, *, guided: bool = True) -> int:
    """Bytes per pixel on the device while a scene is rendered, plus those of its picture on the host.

    The sum of: the film; the buffers of one iteration, or the filter's scratch if that is larger, since they share
    memory; the sample buffer and the resolved picture of the filter; what defocus, motion blur and the denoiser add;
    and what is learned of visibility, where light paths are `guided`.
    """
    emission = _VEC3 * (scene.glows or settings.visible_lights)
    smooth_normal = _VEC3 * any(material.normal_texture is not None for material in scene.materials)
    smooth_height = _FLOAT * scene.has_normals
    iteration = sum(_ITERATION.values()) + emission + smooth_normal + smooth_height
    film = sum(_FILM.values()) + emission + _INT * settings.visible_lights
    host_picture = _VEC3
    shutter = scene.shutter if settings.motion_blur else ()
    defocus = settings.depth_of_field and scene.camera.lens_radius > 0.0
    if guided and settings.estimator == "vpl" and not defocus and len(shutter) < 2:
        film += math.ceil(sum(_TILE_VISIBILITY.values()))
    if not settings.filter or settings.estimator != "vpl":
        return film + iteration + host_picture + _DENOISER * settings.denoise
    moves = len({_surface_ids(sample) for sample in shutter}) > 1
    return (
        film
        + max(iteration, sum(_FILTER_SCRATCH.values()))
        + sum(_SAMPLE_BUFFER.values())
        + sum(_RESOLVED_PICTURE.values())
        + sum(_REPROJECTION.values()) * (defocus or len(shutter) > 1)
        + sum(_SURFACE_POINT.values()) * moves
        + host_picture
        + _DENOISER * settings.denoise
    )


def available_memory() -> float:
    """Bytes that this process may still allocate: the least that its limits, its control groups and the machine leave.

    Memory that holds copies of files counts as free. Infinity if nothing is known.
    """
    found = [_left_by_limits(), _left_by_cgroups(), math.inf]
    with suppress(OSError, ValueError, IndexError, AttributeError):
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return max(0.0, min(*found, 1024.0 * int(line.split()[1])))
    with suppress(OSError, ValueError, AttributeError):  # not Linux
        found.append(float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")))
    return max(0.0, min(found))


def require_memory(needed: float, what: str) -> None:
    """Refuses what needs more memory than is available.

    Args:
        needed: Bytes, at its peak.
        what: What needs it, in the plural.

    Raises:
        InputError: It is too much; the message has the numbers.
    """
    if needed > _SMALL and needed > (available := available_memory()):
        raise InputError(f"{what} need about {gibibytes(needed)} of memory, {gibibytes(available)} are available")


def gibibytes(size: float) -> str:
    """A size [bytes] in words."""
    return f"{size / 2**30:.{0 if size >= 10 * 2**30 else 1}f} GiB"


def _left_by_limits() -> float:
    """What `ulimit -v` and `ulimit -d` leave [bytes]."""
    left = math.inf
    with suppress(ImportError, OSError, ValueError, IndexError):  # not on every system
        import resource

        pages = [int(x) for x in Path("/proc/self/statm").read_text(encoding="ascii").split()]
        for kind, used in ((resource.RLIMIT_AS, pages[0]), (resource.RLIMIT_DATA, pages[5])):
            limit = resource.getrlimit(kind)[0]
            if limit != resource.RLIM_INFINITY:
                left = min(left, limit - used * float(os.sysconf("SC_PAGE_SIZE")))
    return left


def _left_by_cgroups() -> float:
    """What the limits of this process's control groups and of those around them leave [bytes], of version 1 or 2."""
    left = math.inf
    with suppress(OSError):
        for line in _OWN_CGROUPS.read_text(encoding="utf-8").splitlines():
            _, controllers, path = line.split(":", 2)
            if controllers and "memory" not in controllers.split(","):
                continue
            root = _CGROUPS / "memory" if controllers else _CGROUPS
            names = (
                ("memory.limit_in_bytes", "memory.usage_in_bytes") if controllers else ("memory.max", "memory.current")
            )
            group = root / path.lstrip("/")
            # In a container the path may be one of the machine's: then its own group is at the root.
            for folder in (group, *group.parents):
                if folder == root or root in folder.parents:
                    left = min(left, _left_in(folder, *names))
    return left


def _left_in(group: Path, limit_name: str, usage_name: str) -> float:
    """What the limit of one control group leaves [bytes]: infinity if it has none."""
    with suppress(OSError, ValueError):
        limit = (group / limit_name).read_text(encoding="ascii").strip()
        if limit == "max" or int(limit) >= 2**60:
            return math.inf
        used = int((group / usage_name).read_text(encoding="ascii"))
        with suppress(OSError, ValueError):
            for line in (group / "memory.stat").read_text(encoding="ascii").splitlines():
                name, value = line.split()
                if name in ("total_inactive_file", "inactive_file"):
                    used -= int(value)
                    break
        return float(int(limit) - used)
    return math.inf


# Bytes of a scene on the device, measured on the CPU; a GPU takes about as many.
_BASE = 7500  # the Sobol' matrices, and one row of each table that is empty
_TRIANGLE = 28  # its material, mesh, sides, and the first rows of its normals, colours, uvs and tangents
_TRIANGLE_INDICES = 12
_TRIANGLE_TREE = 67  # its part of the BVH
_TRIANGLE_EMITTER = 4  # its row in the list of emitters, if anything in the scene emits
_POINT = _VEC3
_CORNER = _VEC3  # a normal, a colour or a tangent
_CORNER_UV = _VEC2
_EMITTER = 16
_INSTANCE = 170
_LIGHT = 160
_TEXEL_CHANNEL = 2  # half precision
_MIP_CHAIN = 4.0 / 3.0  # all levels over the finest one
_MAX_TEXTURE_BYTES = 2**30  # textures are downsampled to fit: `texture.MAX_BYTES`
_LIGHT_TEXEL = 16  # a colour and its cumulative probability
_SHAPING_DIRECTIONS = 8200  # the table from which photons of a shaped light take their directions


def scene_bytes(scene: Scene) -> dict[str, int]:
    """Approximate bytes of a scene on the device by use, to within a fifth in all.

    All shutter samples are counted, and what they share once; films and VPLs are not counted.

    Returns:
        Bytes of "geometry", "hierarchy" (the BVHs), "instances", "textures" and "lights".
    """
    out = dict.fromkeys(("geometry", "hierarchy", "instances", "textures", "lights"), 0.0)
    samples = {_surface_ids(sample): sample for sample in scene.shutter or (scene,)}
    counted: set[object] = set()
    triangles = sum(_add_surfaces(sample, out, counted) for sample in samples.values())
    for sample in samples.values():
        _add_emitters(sample, triangles, out)
    textures = {texture for material in scene.materials for texture in material.textures}
    texels = sum(_MIP_CHAIN * _TEXEL_CHANNEL * texture.pixels.size for texture in textures)
    out["textures"] = min(texels, _MAX_TEXTURE_BYTES)
    out["lights"] = _light_bytes(scene)
    out["geometry"] += _BASE
    return {name: round(size) for name, size in out.items()}


def _surface_ids(scene: Scene) -> tuple[int, ...]:
    """Identifies a scene's surfaces: equal for two scenes that share all meshes and instances."""
    return tuple(id(x) for x in (*scene.meshes, *scene.instances))


def _add_surfaces(scene: Scene, out: dict[str, float], counted: set[object]) -> int:
    """Adds the surfaces that are not in `counted`, and puts them there; returns the number of triangles added."""
    uv_sets = {texture.uv for material in scene.materials for texture in material.textures}
    triangles = 0
    for mesh, copies in _stored_meshes(scene):
        if id(mesh) in counted:
            continue
        count = len(mesh.triangles) * copies
        triangles += count
        corners = _CORNER * 3 * sum(x is not None for x in (mesh.normals, mesh.colors, mesh.tangents))
        corners += _CORNER_UV * 3 * len(uv_sets) * any(name in mesh.uvs for name in uv_sets)
        out["geometry"] += count * (_TRIANGLE + _TRIANGLE_INDICES + corners)
        geometry = id(mesh.points), id(mesh.triangles)
        if geometry not in counted:  # prototypes of the same geometry share points and BVH
            out["geometry"] += _POINT * len(mesh.points) * copies
            out["hierarchy"] += _TRIANGLE_TREE * count
        counted |= {id(mesh), geometry}
    groups = tuple(id(group) for group in scene.instances)
    if groups not in counted:
        out["instances"] += _INSTANCE * sum(len(group.matrices) for group in scene.instances)
        counted.add(groups)
    return triangles


def _add_emitters(scene: Scene, triangles: int, out: dict[str, float]) -> None:
    """Adds the emitter tables of a shutter sample: each has its own list, and a row in it for every triangle."""
    emits = _emissive_materials(scene)
    if emits.any():
        emitters = sum(copies * float(emits[mesh.material].sum()) for mesh, copies in _stored_meshes(scene))
        out["geometry"] += _TRIANGLE_EMITTER * triangles + _EMITTER * emitters


def _emissive_materials(scene: Scene) -> npt.NDArray[np.bool_]:
    return np.array([max(m.emission) > 0.0 for m in scene.materials], bool)


def _stored_meshes(scene: Scene) -> Iterator[tuple[Mesh, int]]:
    """Each mesh with triangles and the number of its stored copies: one, unless it is instanced and emits."""
    emits = _emissive_materials(scene)
    group_of: dict[int, Instances] = {k: group for group in scene.instances for k in group.meshes}
    for k, mesh in enumerate(scene.meshes):
        if len(mesh.triangles):
            yield mesh, len(group_of[k].matrices) if k in group_of and emits[mesh.material].any() else 1


def _light_bytes(scene: Scene) -> float:
    images = {id(x.texture): x.texture.size // 3 for x in scene.lights if x.texture is not None}
    total = float(_LIGHT * len(scene.lights) + _LIGHT_TEXEL * sum(images.values()))
    links: set[frozenset[int]] = set()
    lights: list[Light | MeshLight] = [*scene.lights, *(mesh.light for mesh in scene.meshes if mesh.light)]
    for light in lights:
        links |= {light.unlit, light.shadowless} - {frozenset()}
        if light.shaping is not None:
            profile = light.shaping.profile
            texels, columns = (0, 1) if profile is None else (profile.size, profile.shape[1])
            total += _SHAPING_DIRECTIONS * (1 + columns) / 2 + _LIGHT_TEXEL * texels
    return total + _INT * len(links) * len(scene.meshes)
