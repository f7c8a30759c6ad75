"""`warp-ir info`: prints what a stage contains, what will be skipped, and why."""

import argparse
import json
import math
import time
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_ir.cli.console import say_warnings
from warp_ir.cli.frames import TimeCode
from warp_ir.cli.stage_options import open_reader, stage_facts, time_code_of
from warp_ir.memory import scene_bytes
from warp_ir.scene import Light, LightKind, Material, Mesh, MeshLight, Scene

if TYPE_CHECKING:
    from warp_ir.usd import StageReader

_SKIPPED = (
    "prims_invisible",
    "prims_other_purpose",
    "prims_outside_pass",
    "degenerate_faces",
    "triangles_absent",
    "unused_materials",
    "lights_without_emission",
    "composition_errors",
)
"""Counts in `Scene.stats` of what is in the stage but not in the picture."""
_MAX_LINES = 20
"""Lights, materials, ... that are listed by name; of further ones only the number is printed, unless --verbose."""


def run(args: argparse.Namespace) -> int:
    """Prints the table, a list or JSON; returns the exit code."""
    begin = time.perf_counter()
    reader = open_reader(args)
    scene = reader.read(time_code_of(args))
    facts = describe(scene, reader, time.perf_counter() - begin, time_code_of(args))
    if args.list:
        _print_list(facts, args.list)
        return 0
    if args.json:
        print(json.dumps({**facts, "warnings": list(scene.warnings)}, indent=2))
        return 0
    _print_table(facts, math.inf if args.verbose else _MAX_LINES)
    say_warnings(scene.warnings, everything=args.verbose)
    return 0


def describe(scene: Scene, reader: "StageReader", seconds: float, time_code: TimeCode) -> dict[str, Any]:
    """The scene and its stage as plain values for JSON.

    Args:
        scene: The scene.
        reader: Reader of its stage.
        seconds: Time [s] it took to load.
        time_code: Time code at which it was read.
    """
    lower, upper = scene.bounds()
    camera, size, facts = scene.camera, scene_bytes(scene), stage_facts(reader, time_code)
    return {
        "stage": str(reader.source),
        **facts,
        "camera": {
            "name": scene.camera.name,
            "projection": scene.camera.projection.name.lower(),
            "aspect": scene.camera.aspect,
            "position": _floats(scene.camera.world_from_camera[:3, 3]),
            "window": _floats(scene.camera.window),
            "clipping": [camera.clipping[0], _finite(camera.clipping[1])],
            "exposure": camera.exposure,
            "lens_radius": camera.lens_radius,
            "focus_distance": _finite(camera.focus_distance) if camera.lens_radius > 0.0 else None,
            "shutter_moments": len(scene.shutter),
        },
        "moving_meshes": reader.moving_meshes,
        "cost": {"load_seconds": seconds, "scene_bytes": sum(size.values()), "bytes": size},
        "meshes": len(scene.meshes),
        "triangles": scene.triangle_count,
        "triangles_seen": scene.triangles_seen,
        "prototypes": [
            {
                "name": group.name,
                "meshes": len(group.meshes),
                "triangles": sum(len(scene.meshes[k].triangles) for k in group.meshes),
                "instances": len(group.matrices),
            }
            for group in scene.instances
        ],
        "bounds": [_floats(lower), _floats(upper)],
        "lights": [_light(light) for light in scene.lights],
        "mesh_lights": [_mesh_light(mesh, scene) for mesh in scene.meshes if mesh.light is not None],
        "materials": [_material(material) for material in scene.materials],
        "emissive_triangles": _emissive_triangles(scene),
        "counts": {key: int(value) for key, value in scene.stats.items()},
        "skipped": {key: int(scene.stats[key]) for key in _SKIPPED if scene.stats.get(key)},
        "guessed": _guesses(scene, facts["cameras"]),
    }


def _light(light: Light) -> dict[str, Any]:
    return {
        "name": light.name,
        "kind": light.kind.name.lower(),
        "radiance": _floats(light.radiance),
        "texture": None if light.texture is None else list(light.texture.shape[1::-1]),
        **_modifiers(light),
    }


def _mesh_light(mesh: Mesh, scene: Scene) -> dict[str, Any]:
    assert mesh.light is not None
    emission = [scene.materials[k].emission for k in np.unique(mesh.material)]
    return {
        "name": mesh.light.name,
        "mesh": mesh.name,
        "radiance": _floats(np.max(emission, axis=0)),
        **_modifiers(mesh.light),
    }


def _modifiers(light: Light | MeshLight) -> dict[str, Any]:
    """Shaping, shadows and links of a light."""
    shaping = light.shaping
    return {
        "shaping": None
        if shaping is None
        else {
            "cone_angle": shaping.cone_angle,
            "cone_softness": shaping.cone_softness,
            "focus": shaping.focus,
            "profile": shaping.profile is not None,
        },
        "shadows": light.shadows,
        "unlit_meshes": len(light.unlit),
        "shadowless_meshes": len(light.shadowless),
    }


def _material(material: Material) -> dict[str, Any]:
    return {
        "name": material.name,
        "albedo": _floats(material.albedo),
        "emission": _floats(material.emission),
        "glow": None if material.glow is None else _floats(material.glow),
        "opacity": material.opacity,
        "cutoff": material.cutoff,
        "textures": [texture.name for texture in material.textures],
    }


def _guesses(scene: Scene, cameras: Sequence[str]) -> dict[str, str]:
    """What the stage does not specify, and what was chosen for it."""
    guesses = {}
    if scene.camera.name not in cameras:
        guesses["camera"] = "one that frames the scene from outside (the stage has none)"
    elif any("rendered because it is the first" in line for line in scene.warnings):
        guesses["camera"] = f"the first of {len(cameras)}"
    if any("used because they are the first of" in line for line in scene.warnings):
        guesses["settings"] = "the first RenderSettings of the stage"
    if any(light.name == "default dome" for light in scene.lights):
        guesses["light"] = "a white dome of radiance 1 (nothing emits)"
    if any(light.name == "default sky" for light in scene.lights):
        guesses["light"] = "an overcast sky (nothing emits)"
    return guesses


def _finite(number: float) -> float | None:
    """The number; None, as JSON has no infinity, if it is not finite."""
    return number if math.isfinite(number) else None


def _floats(values: Iterable[float]) -> list[float]:
    return [float(value) for value in values]


def _emissive_triangles(scene: Scene) -> int:
    emits = np.array([any(x > 0.0 for x in material.emission) for material in scene.materials], dtype=bool)
    return sum(int(emits[mesh.material].sum()) for mesh in scene.meshes)


def _print_table(facts: dict[str, Any], max_lines: float) -> None:
    """Prints one fact per line with aligned names; at most `max_lines` of each list."""
    camera, (lower, upper) = facts["camera"], facts["bounds"]
    cost = facts["cost"]
    _row("stage", facts["stage"])
    _row("up axis", f"{facts['up_axis']}, {facts['meters_per_unit']:g} m per unit")
    if facts["frames"]:
        (first, last), time_code = facts["frames"], facts["time"]
        _row(
            "frames", f"{first:g} to {last:g}; read at {'the default time' if time_code is None else f'{time_code:g}'}"
        )
    _row(
        "camera",
        f"{camera['name'] or '(frames the scene)'}, {camera['projection']}, aspect {camera['aspect']:.4g}",
    )
    _list("other cameras", [name for name in facts["cameras"] if name != camera["name"]], max_lines)
    if camera["lens_radius"] > 0.0:
        focus = camera["focus_distance"]
        in_focus = "infinity" if focus is None else f"{focus:.4g}"
        _row("lens", f"radius {camera['lens_radius']:.4g}, in focus at {in_focus}")
    if camera["shutter_moments"]:
        _row("motion blur", f"{camera['shutter_moments']} shutter samples")
    if camera["exposure"] != 1.0:
        _row("exposure", f"{camera['exposure']:.4g} times the radiance")
    _list("settings", _settings_lines(facts), max_lines)
    _list("render passes", facts["render_passes"], max_lines)
    moving = f", {facts['moving_meshes']} of them animated" if facts["moving_meshes"] else ""
    _row("meshes", f"{facts['meshes']}{moving}")
    instanced = f"; {facts['triangles_seen']} with instances" if facts["prototypes"] else ""
    _row("triangles", f"{facts['triangles']}, {facts['emissive_triangles']} of them emit{instanced}")
    _list(
        "prototypes",
        [f"{p['instances']} instances of {p['triangles']} triangles  {p['name']}" for p in facts["prototypes"]],
        max_lines,
    )
    _row("bounds", f"({_numbers(lower)}) to ({_numbers(upper)})")
    _list("lights", _light_lines(facts), max_lines)
    _list("mesh lights", _mesh_light_lines(facts), max_lines)
    _list("materials", _material_lines(facts), max_lines)
    _row(
        "costs", f"{cost['load_seconds']:.2g} s to load, about {_bytes(cost['scene_bytes'])} of memory: {_parts(cost)}"
    )
    _list("skipped", [f"{value} {key.replace('_', ' ')}" for key, value in facts["skipped"].items()], max_lines)
    _list("guessed", [f"{key}: {value}" for key, value in facts["guessed"].items()], max_lines)
    counts = {key.replace("_", " "): value for key, value in facts["counts"].items() if value}
    _list("counts", [f"{value:9} {key}" for key, value in counts.items()], math.inf)


def _print_list(facts: dict[str, Any], what: str) -> None:
    """Prints one camera, light, material or settings prim per line, and nothing else."""
    lines = {
        "cameras": facts["cameras"],
        "lights": _light_lines(facts),
        "materials": _material_lines(facts),
        "settings": _settings_lines(facts),
    }
    for line in lines[what]:
        print(line)


def _light_lines(facts: dict[str, Any]) -> list[str]:
    return [
        f"{x['kind']:9} {_QUANTITY[x['kind']]} ({_numbers(x['radiance'])}){_light_details(x)}  {x['name']}"
        for x in facts["lights"]
    ]


def _mesh_light_lines(facts: dict[str, Any]) -> list[str]:
    return [f"radiance ({_numbers(x['radiance'])}){_light_details(x)}  {x['name']}" for x in facts["mesh_lights"]]


def _light_details(light: dict[str, Any]) -> str:
    """Texture, shaping, shadows and links of a light as a short text."""
    width, height = light.get("texture") or (0, 0)
    words = [f"texture {width} x {height}"] if width else []
    words += ["shaped"] if light["shaping"] else []
    words += [] if light["shadows"] else ["no shadows"]
    words += [f"does not light {light['unlit_meshes']} meshes"] if light["unlit_meshes"] else []
    words += [f"passes through {light['shadowless_meshes']} meshes"] if light["shadowless_meshes"] else []
    return "".join(f", {word}" for word in words)


def _parts(cost: dict[str, Any]) -> str:
    """The memory of each part of the scene as a short text."""
    return ", ".join(f"{name} {_bytes(size)}" for name, size in cost["bytes"].items() if size)


def _material_lines(facts: dict[str, Any]) -> list[str]:
    return [
        f"albedo ({_numbers(m['albedo'])}){_emission(m['emission'])}{_material_details(m)}  {m['name'] or '(default)'}"
        for m in facts["materials"]
    ]


def _material_details(material: dict[str, Any]) -> str:
    """Opacity and textures of a material as a short text."""
    words = []
    if material["cutoff"] > 0.0:
        words.append(f"cut out below opacity {material['cutoff']:.4g}")
    elif material["opacity"] < 1.0:
        words.append(f"opacity {material['opacity']:.4g}")
    words += dict.fromkeys(name.rsplit("/", 1)[-1] or "a texture" for name in material["textures"])
    return "".join(f", {word}" for word in words)


def _settings_lines(facts: dict[str, Any]) -> list[str]:
    """The render settings that are used, with the requests of their products; then those that are not used."""
    settings = facts["render_settings"]
    lines = []
    for product in settings["products"]:
        requests = ", ".join(f"{name} {_plain(value)}" for name, value in product["settings"].items())
        aovs = f", variables {' '.join(product['aovs'])}" if product["aovs"] else ""
        name = f"{product['name']}  " if product["name"] else ""
        lines.append(f"{name}{product['path'] or settings['used']}: {requests}{aovs}")
    return lines + [f"{path}: not used" for path in settings["all"] if path != settings["used"]]


def _plain(value: object) -> str:
    return _numbers(list(value)) if isinstance(value, tuple) else str(value)


def _bytes(count: float) -> str:
    for unit in ("bytes", "KiB", "MiB"):
        if count < 1024.0:
            return f"{count:.3g} {unit}"
        count /= 1024.0
    return f"{count:.3g} GiB"


_QUANTITY = {kind.name.lower(): "radiance" for kind in LightKind} | {"point": "intensity"}
"""The quantity that the three numbers of a light are, by its kind."""


def _emission(emission: list[float]) -> str:
    return f", emits ({_numbers(emission)})" if any(emission) else ""


def _numbers(values: list[float]) -> str:
    return ", ".join(f"{value:.4g}" for value in values)


def _row(name: str, text: object) -> None:
    print(f"{name:14} {text}")


def _list(name: str, lines: list[str], max_lines: float) -> None:
    """Prints the lines under one name: at most `max_lines`, then the number of the others."""
    if not lines:
        return
    shown = lines if len(lines) <= max_lines else lines[: int(max_lines)]
    _row(name, shown[0] if len(lines) == 1 else len(lines))
    for line in shown if len(lines) > 1 else []:
        print(f"{'':14} {line}")
    if len(shown) < len(lines):
        print(f"{'':14} ... and {len(lines) - len(shown)} more; --verbose shows all")
