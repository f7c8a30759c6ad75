"""Makes the reference pictures in `benchmarks/references/` with Mitsuba 3, which shares no code with our renderer.

    python benchmarks/make_references.py [NAME ...] [--seconds S] [--variant llvm_ad_rgb] [--png FOLDER]

Each `Scene` is translated to Mitsuba and rendered in independent passes until its error target or its limit of CPU time
is reached. The .npz file of a picture holds `mean` and `standard_error` (float32 [height, width, 3], linear radiance),
`floor` (relMSE of the mean, from the standard error) and its provenance as strings.

The variant `llvm_ad_rgb` needs LLVM 16 or newer (Debian: libllvm19), which is found automatically or at
DRJIT_LIBLLVM_PATH; without it the script uses `scalar_rgb`, which gives the same pictures more slowly.

The two renderers differ, and the translation compensates for it:

* Our lights emit light, block no ray and are hidden from the camera. In Mitsuba they are shapes with a `null` surface,
  through which `volpath` lets both paths and shadow rays pass (`path` would be blocked), and `hide_emitters` is set.
* Mitsuba has no DISTANT light with an angle: it becomes a disk so far away (1000 times the scene's extent) that it
  fills the same cone; its direction then varies by at most 0.001 rad over the scene.
* Mitsuba uses shading normals at every bounce, we use them only for camera rays: reference scenes are faceted, where
  the two agree.
* An emissive mesh emits from its front only, as in our renderer; a `double_sided` one is refused.
* Textures are those that `load_usd` returns; `loader_warnings` in the .npz says if one was replaced by its mean.
* `thin_walls` has no reference: Mitsuba's shadow rays end a thousandth before the light, so they miss a wall that
  is closer to it, and the dark box has radiance 0.001 instead of 0.
"""

import argparse
import ctypes.util
import dataclasses
import hashlib
import os
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import mitsuba_gloss
import numpy as np

import warp_ir as ir
from warp_ir.scene import Bools, Camera, Floats, Light, LightKind, Mesh, Projection, Scene, Texture, Wrap

if TYPE_CHECKING:
    import mitsuba

ROOT = Path(__file__).resolve().parents[1]
REFERENCES = Path(__file__).resolve().parent / "references"

Description = dict[str, Any]
"""A plugin with its parameters, as `mitsuba.load_dict` takes it."""
PICTURES = {
    # name: (scene, width, height, max_bounces)
    "cornell_box": ("cornell_box", 128, 128, None),
    "cornell_box_direct": ("cornell_box", 128, 128, 0),
    "corridor": ("corridor", 64, 64, None),
    "crowded_room": ("crowded_room", 96, 96, None),
    "furnace_cube": ("furnace_cube", 32, 32, None),
    "light_types": ("light_types", 120, 80, None),
    "thousand_lights": ("thousand_lights", 64, 64, None),
    "two_rooms": ("two_rooms", 96, 72, None),
}
"""The stored pictures, each of a scene in `scenes_usd/`."""

TARGET_FLOOR = 1e-4
"""relMSE of the reference itself at which rendering stops."""


class ReferencesDisagree(Exception):
    """Two renderers do not agree on a picture: one of them is wrong, or its standard error is."""


def use_mitsuba(variant: str = "llvm_ad_rgb") -> ModuleType:
    """Imports Mitsuba with `variant`, or with `scalar_rgb` if LLVM is missing."""
    if variant.startswith("llvm") and "DRJIT_LIBLLVM_PATH" not in os.environ:
        libraries = [ctypes.util.find_library(f"LLVM-{version}") for version in range(22, 15, -1)]
        if any(libraries):
            os.environ["DRJIT_LIBLLVM_PATH"] = next(filter(None, libraries))
        else:
            print("LLVM 16 or newer not found: using scalar_rgb", file=sys.stderr)
            variant = "scalar_rgb"
    import mitsuba as mi

    mi.set_variant(variant)
    return mi


def relative_mse_floor(mean: Floats, standard_error: Floats) -> float:
    """Expected relMSE of a perfect picture against this reference."""
    return float(np.mean(standard_error**2 / (mean**2 + 0.01 * mean.mean() ** 2)))


def _rgb(color: Iterable[float]) -> Description:
    """The Mitsuba description of a reflectance or radiance."""
    return {"type": "rgb", "value": [float(c) for c in color]}


def _bitmap(mi: ModuleType, texture: Texture) -> Description:
    """The Mitsuba description of an image."""
    wrap = {Wrap.CLAMP: "clamp", Wrap.REPEAT: "repeat", Wrap.MIRROR: "mirror"}[texture.wrap[0]]
    pixels = np.broadcast_to(texture.pixels, (*texture.pixels.shape[:2], 3)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True, "wrap_mode": wrap}


def _mesh(mi: ModuleType, mesh: Mesh, scene: Scene, index: int) -> "mitsuba.Mesh":
    """A mesh of material `index`, as a Mitsuba mesh with three vertices per triangle."""
    material = scene.materials[index]
    emissive = any(value > 0.0 for value in material.emission)
    if emissive and mesh.double_sided:
        raise NotImplementedError(f"{mesh.name}: emission from both sides of a mesh")
    smooth = mesh.normals is not None and not emissive
    coloured = mesh.colors is not None

    properties = mi.Properties()
    texture = material.albedo_texture
    if texture is not None:
        reflectance = _bitmap(mi, texture)
    else:
        reflectance = {"type": "mesh_attribute", "name": "vertex_color"} if coloured else _rgb(material.albedo)
    bsdf = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": reflectance}}
    if material.gloss is not None:
        mitsuba_gloss.register(mi)
        bsdf = mitsuba_gloss.description(material.gloss)
    properties["bsdf"] = mi.load_dict(bsdf)
    if emissive:
        properties["emitter"] = mi.load_dict({"type": "area", "radiance": _rgb(material.emission)})
    properties["face_normals"] = not smooth

    triangles = mesh.triangles
    result = mi.Mesh(
        mesh.name,
        triangles.size,
        len(triangles),
        has_vertex_normals=smooth,
        has_vertex_texcoords=texture is not None,
        props=properties,
    )
    if coloured:
        result.add_attribute("vertex_color", 3, mesh.colors.ravel().astype(np.float32))
    parameters = mi.traverse(result)
    parameters["vertex_positions"] = mesh.points[triangles].ravel().astype(np.float32)
    parameters["faces"] = np.arange(triangles.size, dtype=np.uint32)
    if smooth:
        parameters["vertex_normals"] = mesh.normals.ravel().astype(np.float32)
    if texture is not None:
        uvs = mesh.uvs[texture.uv] @ texture.transform[:, :2].T + texture.transform[:, 2]
        # Mitsuba's v runs down the image.
        parameters["vertex_texcoords"] = (uvs * [1, -1] + [0, 1]).ravel().astype(np.float32)
    parameters.update()
    return result


def _light(mi: ModuleType, light: Light, centre: Floats, extent: float) -> Description:
    """The Mitsuba description of an emitter, or of an emitting shape that blocks no ray."""
    transform = mi.ScalarTransform4f
    world = transform(light.world_from_light)
    shape = {"emitter": {"type": "area", "radiance": _rgb(light.radiance)}, "surface": {"type": "null"}}
    flip = transform().rotate([1, 0, 0], 180)  # Mitsuba's plane shapes emit along +Z
    match light.kind:
        case LightKind.RECT:
            size = transform().scale([light.width / 2, light.height / 2, 1])
            return {"type": "rectangle", "to_world": world @ flip @ size, **shape}
        case LightKind.DISK:
            size = transform().scale([light.radius, light.radius, 1])
            return {"type": "disk", "to_world": world @ flip @ size, **shape}
        case LightKind.SPHERE:
            return {"type": "sphere", "to_world": world, "radius": light.radius, **shape}
        case LightKind.CYLINDER:
            ends = {"p0": [-light.length / 2, 0, 0], "p1": [light.length / 2, 0, 0]}
            return {"type": "cylinder", "to_world": world, "radius": light.radius, **ends, **shape}
        case LightKind.POINT:
            position = light.world_from_light[:3, 3].tolist()
            return {"type": "point", "position": position, "intensity": _rgb(light.radiance)}
        case LightKind.DOME:
            return {"type": "constant", "radiance": _rgb(light.radiance)}
        case LightKind.DISTANT:
            direction = -light.world_from_light[:3, 2] / np.linalg.norm(light.world_from_light[:3, 2])
            if light.angle == 0.0:
                return {"type": "directional", "direction": direction, "irradiance": _rgb(light.radiance)}
            distance = 1000.0 * extent
            radius = distance * np.tan(np.radians(light.angle / 2))
            origin, side = centre - distance * direction, np.roll(direction, 1)
            orientation = transform().look_at(origin=origin.tolist(), target=centre.tolist(), up=side.tolist())
            return {"type": "disk", "to_world": orientation @ transform().scale([radius, radius, 1]), **shape}
    raise NotImplementedError(light.kind)


def _sensor(mi: ModuleType, camera: Camera, extent: float, width: int, height: int) -> Description:
    """The Mitsuba description of the camera, with a box filter like ours."""
    left, right, bottom, top = camera.fit(width, height).window
    mirror = np.diag([-1.0, 1.0, -1.0, 1.0])  # Mitsuba looks along +Z with X to the left
    to_world = mi.ScalarTransform4f(camera.world_from_camera @ mirror)
    near, far = max(camera.clipping[0], 1e-5 * extent), min(camera.clipping[1], 1e3 * extent)
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
    common = {"near_clip": near, "far_clip": far, "film": {**film, "pixel_format": "rgb"}}
    if camera.projection is Projection.ORTHOGRAPHIC:
        middle = mi.ScalarTransform4f().translate([-(left + right) / 2, (bottom + top) / 2, 0])
        size = mi.ScalarTransform4f().scale([(right - left) / 2, (right - left) / 2, 1])
        return {"type": "orthographic", "to_world": to_world @ middle @ size, **common}
    return {
        "type": "perspective",
        "to_world": to_world,
        "fov": float(np.degrees(2.0 * np.arctan((right - left) / 2))),
        "fov_axis": "x",
        "principal_point_offset_x": (left + right) / (2 * (right - left)),
        "principal_point_offset_y": -(bottom + top) / (2 * (top - bottom)),
        **common,
    }


def merged(meshes: Iterable[Mesh]) -> list[Mesh]:
    """One mesh for each material and set of attributes: every shape costs Mitsuba a fixed time per render."""
    groups: dict[tuple[object, ...], list[tuple[Mesh, Bools]]] = {}
    for mesh in meshes:
        for index in np.unique(mesh.material):
            smooth, coloured = mesh.normals is not None, mesh.colors is not None
            key = (int(index), smooth, coloured, mesh.double_sided, tuple(sorted(mesh.uvs)))
            groups.setdefault(key, []).append((mesh, mesh.material == index))
    result = []
    for (_, smooth, coloured, double_sided, names), parts in groups.items():
        starts = np.cumsum([0, *(len(mesh.points) for mesh, _ in parts[:-1])])
        result.append(
            Mesh(
                parts[0][0].name,
                np.concatenate([mesh.points for mesh, _ in parts]),
                np.concatenate([mesh.triangles[chosen] + k for (mesh, chosen), k in zip(parts, starts, strict=True)]),
                np.concatenate([mesh.material[chosen] for mesh, chosen in parts]),
                np.concatenate([mesh.normals[chosen] for mesh, chosen in parts]) if smooth else None,
                np.concatenate([mesh.colors[chosen] for mesh, chosen in parts]) if coloured else None,
                bool(double_sided),
                {name: np.concatenate([mesh.uvs[name][chosen] for mesh, chosen in parts]) for name in names},
            )
        )
    return result


def to_mitsuba(scene: Scene, width: int, height: int, max_bounces: int | None = None) -> "mitsuba.Scene":
    """Translates a scene to Mitsuba, ready for `mitsuba.render`.

    Args:
        scene: Scene to translate.
        width: Width of the picture in pixels.
        height: Height of the picture in pixels.
        max_bounces: As in `RenderSettings`: 0 is emission and direct light; None: no limit.

    Raises:
        NotImplementedError: The scene has a feature that Mitsuba lacks.
    """
    import mitsuba as mi

    lower, upper = scene.bounds()
    emissive = any(max(material.emission) > 0.0 for material in scene.materials)
    if emissive and scene.lights:
        raise NotImplementedError("hidden lights together with visible emissive surfaces")
    depth = -1 if max_bounces is None else max_bounces + 2
    result = {
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": depth, "rr_depth": 6, "hide_emitters": not emissive},
        "sensor": _sensor(mi, scene.camera, scene.extent, width, height),
    }
    for k, mesh in enumerate(merged(scene.flat().meshes)):
        result[f"mesh_{k}"] = _mesh(mi, mesh, scene, int(mesh.material[0]))
    for k, light in enumerate(scene.lights):
        result[f"light_{k}"] = _light(mi, light, (lower + upper) / 2, scene.extent)
    return mi.load_dict(result)


def render_reference(
    mi: ModuleType, scene: Scene, width: int, height: int, max_bounces: int | None, seconds: float
) -> dict[str, Any]:
    """Renders passes of independent seeds until `TARGET_FLOOR` or `seconds` is reached; returns what is stored."""
    translated = to_mitsuba(scene, width, height, max_bounces)
    spp = max(4, 2**18 // (width * height))  # about 260 000 paths a pass

    def render_pass(seed: int) -> Floats:
        return np.array(mi.render(translated, spp=spp, seed=seed), dtype=np.float64) * scene.camera.exposure

    result = mean_of_passes(render_pass, seconds)
    return {**result, "spp": spp * result["passes"]}


def mean_of_passes(render_pass: Callable[[int], Floats], seconds: float) -> dict[str, Any]:
    """The mean of pictures of the seeds 0, 1, ..., until `TARGET_FLOOR` or `seconds` of CPU time: what is stored.

    `level_error` is the standard error of the mean of all pixels, whose errors may be correlated.
    """
    passes, mean, squares = 0, 0.0, 0.0
    levels: list[float] = []
    start = time.process_time()
    while True:
        picture = render_pass(passes)
        passes += 1
        levels.append(float(picture.mean()))
        delta = picture - mean
        mean = mean + delta / passes
        squares = squares + delta * (picture - mean)
        if passes >= 8:
            standard_error = np.sqrt(squares / (passes - 1) / passes)
            floor = relative_mse_floor(mean, standard_error)
            if floor <= TARGET_FLOOR or time.process_time() - start > seconds:
                break
    return {
        "mean": mean.astype(np.float32),
        "standard_error": standard_error.astype(np.float32),
        "floor": floor,
        "passes": passes,
        "level_error": float(np.std(levels, ddof=1) / np.sqrt(passes)),
    }


def cached_reference(scene: Scene, width: int, height: int, seconds: float) -> dict[str, Any]:
    """The reference of a scene that has none stored: from `cache/`, or rendered now in `seconds` and put there.

    Mitsuba renders in one half of the time, our estimator `vpl` without its filter in the other, and the reference is
    their mean, weighted by the inverse of their floors: light that comes through several doors costs a path tracer
    hours. The two have to agree in the mean of all pixels. Without Mitsuba ours is the reference.

    Raises:
        ReferencesDisagree: The means differ by more than five standard errors.
    """
    path = REFERENCES.parent / "cache" / f"{scene.name}_{width}x{height}_{content_digest(scene)[:12]}.npz"
    if not path.exists():
        settings = ir.RenderSettings(width=width, height=height, filter=False, iterations=64)

        def render_pass(seed: int) -> Floats:
            independent = 2**20 + seed  # of the seeds of the benchmarks
            return ir.render(scene, dataclasses.replace(settings, seed=independent)).radiance().astype(np.float64)

        results = {"vpl": mean_of_passes(render_pass, seconds / 2)}
        try:
            mi = use_mitsuba()
        except ImportError:
            pass
        else:
            results[f"Mitsuba {mi.__version__}"] = render_reference(mi, scene, width, height, None, seconds / 2)
        result = pooled_reference(scene.name, results)
        path.parent.mkdir(exist_ok=True)
        np.savez_compressed(path, **result)
        print(f"{scene.name}: reference, {result['program']}", file=sys.stderr, flush=True)
    with np.load(path) as stored:
        return {"mean": stored["mean"], "standard_error": stored["standard_error"], "floor": float(stored["floor"])}


def pooled_reference(name: str, results: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The mean of results of `mean_of_passes`, by program, weighted by the inverse of their floors.

    Raises:
        ReferencesDisagree: The means of all pixels of two programs differ by more than five standard errors.
    """
    ours, *others = results.values()
    for other in others:
        difference = float(other["mean"].mean()) - float(ours["mean"].mean())
        if abs(difference) > 5.0 * np.hypot(ours["level_error"], other["level_error"]):
            raise ReferencesDisagree(f"{name}: the references of {' and '.join(results)} differ by {difference:.2g}")
    weights = np.array([1.0 / result["floor"] for result in results.values()])
    weights /= weights.sum()
    weighted = list(zip(weights, results.values(), strict=True))
    mean = sum(weight * result["mean"] for weight, result in weighted)
    error = np.sqrt(sum((weight * result["standard_error"]) ** 2 for weight, result in weighted))
    program = ", ".join(f"{program} with floor {result['floor']:.1e}" for program, result in results.items())
    return {
        "mean": mean.astype(np.float32),
        "standard_error": error.astype(np.float32),
        "floor": relative_mse_floor(mean, error),
        "program": program,
    }


def content_digest(value: object) -> str:
    """SHA-256 of a scene's content: its records, their numbers and arrays."""
    hasher = hashlib.sha256()

    def add(item: object) -> None:
        if isinstance(item, np.ndarray):
            hasher.update(f"{item.dtype}{item.shape}".encode() + item.tobytes())
        elif dataclasses.is_dataclass(item):
            for part in dataclasses.fields(item):
                hasher.update(part.name.encode())
                add(getattr(item, part.name))
        elif isinstance(item, tuple | list):
            for part in item:
                add(part)
        elif isinstance(item, Mapping):
            for key in sorted(item):
                add((key, item[key]))
        else:
            hasher.update(repr(item).encode())

    add(value)
    return hasher.hexdigest()


def digest(stage: Path) -> str:
    """SHA-256 of a scene file, by which a reference of another version is detected."""
    return hashlib.sha256(stage.read_bytes()).hexdigest()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"pictures to render: {', '.join(PICTURES)} (default: all)"
    )
    parser.add_argument("--seconds", type=float, default=600.0, help="CPU time for each picture (default: 600)")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="variant of Mitsuba (default: llvm_ad_rgb)")
    parser.add_argument("--png", type=Path, metavar="FOLDER", help="also write tone-mapped pictures to this folder")
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(PICTURES):
        parser.error(f"no such picture: {', '.join(sorted(unknown))}")
    mi = use_mitsuba(arguments.variant)
    REFERENCES.mkdir(exist_ok=True)
    for name in arguments.names or PICTURES:
        stem, width, height, max_bounces = PICTURES[name]
        stage = ROOT / "scenes_usd" / f"{stem}.usda"
        scene = ir.load_usd(stage)
        result = render_reference(mi, scene, width, height, max_bounces, arguments.seconds)
        provenance = {
            "scene": stage.name,
            "scene_sha256": digest(stage),
            "max_bounces": "unlimited" if max_bounces is None else str(max_bounces),
            "program": f"Mitsuba {mi.__version__} volpath, {mi.variant()}",
            "command": f"python benchmarks/make_references.py {name} --seconds {arguments.seconds:g}",
            "loader_warnings": "\n".join(scene.warnings),
        }
        np.savez_compressed(REFERENCES / f"{name}.npz", **result, **provenance)
        print(f"{name}: {width}x{height}, {result['spp']} spp, floor {result['floor']:.2e}", flush=True)
        if arguments.png is not None:
            bitmap = mi.Bitmap(result["mean"]).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True)
            bitmap.write(str(arguments.png / f"{name}.png"))


if __name__ == "__main__":
    main()
