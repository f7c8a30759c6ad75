"""`warp-ir info`: what is in a stage, what will be skipped, and why."""

import argparse
import json
import math
import time
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from warp_ir.cli.console import say_warnings
from warp_ir.cli.stage_options import moment_of, open_reader, stage_facts
from warp_ir.memory import scene_bytes
from warp_ir.scene import Light, LightKind, Material, Mesh, MeshLight, Scene

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
"""Counts of what a stage has and the picture does not."""
_LINES = 20
"""Lights, materials, ... listed by name before only their number is told; --verbose lists all."""


def run(args: argparse.Namespace) -> int:
    """Prints the table, or JSON; the exit code."""
    begin = time.perf_counter()
    reader = open_reader(args)
    scene = reader.read(moment_of(args))
    facts = describe(scene, reader, time.perf_counter() - begin, moment_of(args))
    if args.list:
        _print_list(facts, args.list)
        return 0
    if args.json:
        print(json.dumps({**facts, "warnings": list(scene.warnings)}, indent=2))
        return 0
    _print_table(facts, math.inf if args.verbose else _LINES)
    if not args.quiet:
        say_warnings(scene.warnings, everything=args.verbose)
    return 0


def describe(scene: Scene, reader: Any, seconds: float, moment: float | str | None) -> dict[str, Any]:
    """The scene in plain values, with what only the stage itself knows, and the seconds it took to load."""
    lower, upper = scene.bounds()
    camera, cost, known = scene.camera, scene_bytes(scene), stage_facts(reader, moment)
    return {
        "stage": str(reader.source),
        **known,
        "camera": {
            "name": scene.camera.name,
            "projection": scene.camera.projection.name.lower(),
            "aspect": scene.camera.aspect,
            "position": _floats(scene.camera.world_from_camera[:3, 3]),
            "window": _floats(scene.camera.window),
            "clipping": [camera.clipping[0], camera.clipping[1] if math.isfinite(camera.clipping[1]) else None],
            "exposure": camera.exposure,
            "lens_radius": camera.lens_radius,
            "focus_distance": camera.focus_distance if camera.lens_radius > 0.0 else None,
            "shutter_moments": len(scene.shutter),
        },
        "moving_meshes": reader.moving_meshes,
        "cost": {"load_seconds": seconds, "scene_bytes": sum(cost.values()), "bytes": cost},
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
        "guessed": _guesses(scene, known["cameras"]),
    }


def _light(light: Light) -> dict[str, Any]:
    return {
        "name": light.name,
        "kind": light.kind.name.lower(),
        "radiance": _floats(light.radiance),
        "texture": None if light.texture is None else list(light.texture.shape[1::-1]),
        **_control(light),
    }


def _mesh_light(mesh: Mesh, scene: Scene) -> dict[str, Any]:
    assert mesh.light is not None
    emission = [scene.materials[k].emission for k in np.unique(mesh.material)]
    return {
        "name": mesh.light.name,
        "mesh": mesh.name,
        "radiance": _floats(np.max(emission, axis=0)),
        **_control(mesh.light),
    }


def _control(light: Light | MeshLight) -> dict[str, Any]:
    """What is said of a light beyond its radiance and shape."""
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
    """What the stage leaves open, and how it was decided."""
    found = {}
    if scene.camera.name not in cameras:
        found["camera"] = "one that frames the scene from outside, for there is none"
    elif any("rendered because it is the first" in line for line in scene.warnings):
        found["camera"] = f"the first of {len(cameras)}"
    if any("used because they are the first of" in line for line in scene.warnings):
        found["settings"] = "the first there are"
    if any(light.name == "default dome" for light in scene.lights):
        found["light"] = "a white dome of radiance 1, for nothing emits"
    return found


def _floats(values: Iterable[float]) -> list[float]:
    return [float(value) for value in values]


def _emissive_triangles(scene: Scene) -> int:
    emits = np.array([any(x > 0.0 for x in material.emission) for material in scene.materials], dtype=bool)
    return sum(int(emits[mesh.material].sum()) for mesh in scene.meshes)


def _print_table(facts: dict[str, Any], most: float) -> None:
    """One fact a line, the names aligned."""
    camera, (lower, upper) = facts["camera"], facts["bounds"]
    cost = facts["cost"]
    _row("stage", facts["stage"])
    _row("up axis", f"{facts['up_axis']}, {facts['meters_per_unit']:g} m per unit")
    if facts["frames"]:
        (first, last), at = facts["frames"], facts["time"]
        _row("frames", f"{first:g} to {last:g}; this is {'the default time' if at is None else f'{at:g}'}")
    _row(
        "camera",
        f"{camera['name'] or '(around it all)'}, {camera['projection']}, aspect {camera['aspect']:.4g}",
    )
    _list("other cameras", [name for name in facts["cameras"] if name != camera["name"]], most)
    if camera["lens_radius"] > 0.0:
        _row("lens", f"radius {camera['lens_radius']:.4g}, in focus at {camera['focus_distance']:.4g}")
    if camera["shutter_moments"]:
        _row("motion blur", f"of {camera['shutter_moments']} moments")
    if camera["exposure"] != 1.0:
        _row("exposure", f"{camera['exposure']:.4g} times the radiance")
    _list("settings", _settings_lines(facts), most)
    _list("render passes", facts["render_passes"], most)
    moving = f", {facts['moving_meshes']} of them move or change" if facts["moving_meshes"] else ""
    _row("meshes", f"{facts['meshes']}{moving}")
    seen = f"; {facts['triangles_seen']} are seen" if facts["prototypes"] else ""
    _row("triangles", f"{facts['triangles']}, {facts['emissive_triangles']} of them emit{seen}")
    _list(
        "prototypes",
        [f"{p['instances']} instances of {p['triangles']} triangles  {p['name']}" for p in facts["prototypes"]],
        most,
    )
    _row("bounds", f"({_numbers(lower)}) to ({_numbers(upper)})")
    _list("lights", _light_lines(facts), most)
    _list("mesh lights", _mesh_light_lines(facts), most)
    _list("materials", _material_lines(facts), most)
    _row(
        "costs", f"{cost['load_seconds']:.2g} s to load, about {_bytes(cost['scene_bytes'])} of memory: {_parts(cost)}"
    )
    _list("skipped", [f"{value} {key.replace('_', ' ')}" for key, value in facts["skipped"].items()], most)
    _list("guessed", [f"{key}: {value}" for key, value in facts["guessed"].items()], most)
    counts = {key.replace("_", " "): value for key, value in facts["counts"].items() if value}
    _list("counts", [f"{value:9} {key}" for key, value in counts.items()], math.inf)


def _print_list(facts: dict[str, Any], what: str) -> None:
    """One thing a line, nothing else."""
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
        f"{light['kind']:9} {_EMITS[light['kind']]} ({_numbers(light['radiance'])}){_said(light)}  {light['name']}"
        for light in facts["lights"]
    ]


def _mesh_light_lines(facts: dict[str, Any]) -> list[str]:
    return [f"radiance ({_numbers(x['radiance'])}){_said(x)}  {x['name']}" for x in facts["mesh_lights"]]


def _said(light: dict[str, Any]) -> str:
    """What there is beyond a radiance, in a few words."""
    width, height = light.get("texture") or (0, 0)
    words = [f"texture {width} x {height}"] if width else []
    words += ["shaped"] if light["shaping"] else []
    words += [] if light["shadows"] else ["no shadows"]
    words += [f"does not light {light['unlit_meshes']} meshes"] if light["unlit_meshes"] else []
    words += [f"passes through {light['shadowless_meshes']} meshes"] if light["shadowless_meshes"] else []
    return "".join(f", {word}" for word in words)


def _parts(cost: dict[str, Any]) -> str:
    return ", ".join(f"{name} {_bytes(size)}" for name, size in cost["bytes"].items() if size)


def _material_lines(facts: dict[str, Any]) -> list[str]:
    return [
        f"albedo ({_numbers(m['albedo'])}){_emission(m['emission'])}{_beyond(m)}  {m['name'] or '(default)'}"
        for m in facts["materials"]
    ]


def _beyond(material: dict[str, Any]) -> str:
    """What there is to a material beyond its colours, in a few words."""
    words = []
    if material["cutoff"] > 0.0:
        words.append(f"cut out below opacity {material['cutoff']:.4g}")
    elif material["opacity"] < 1.0:
        words.append(f"opacity {material['opacity']:.4g}")
    words += dict.fromkeys(name.rsplit("/", 1)[-1] or "a texture" for name in material["textures"])
    return "".join(f", {word}" for word in words)


def _settings_lines(facts: dict[str, Any]) -> list[str]:
    """The render settings that are used, with what their products ask for; then those that are not."""
    found = facts["render_settings"]
    lines = []
    for product in found["products"]:
        wants = ", ".join(f"{name} {_plain(value)}" for name, value in product["settings"].items())
        aovs = f", variables {' '.join(product['aovs'])}" if product["aovs"] else ""
        name = f"{product['name']}  " if product["name"] else ""
        lines.append(f"{name}{product['path'] or found['used']}: {wants}{aovs}")
    return lines + [f"{path}: not used" for path in found["all"] if path != found["used"]]


def _plain(value: Any) -> str:
    return _numbers(list(value)) if isinstance(value, tuple) else str(value)


def _bytes(count: float) -> str:
    for unit in ("bytes", "KiB", "MiB"):
        if count < 1024.0:
            return f"{count:.3g} {unit}"
        count /= 1024.0
    return f"{count:.3g} GiB"


_EMITS = {kind.name.lower(): "radiance" for kind in LightKind} | {"point": "intensity"}
"""What the three numbers of a light are."""


def _emission(emission: list[float]) -> str:
    return f", emits ({_numbers(emission)})" if any(emission) else ""


def _numbers(values: list[float]) -> str:
    return ", ".join(f"{value:.4g}" for value in values)


def _row(name: str, text: object) -> None:
    print(f"{name:14} {text}")


def _list(name: str, lines: list[str], most: float) -> None:
    """The lines under one name; beyond `most` only their number."""
    if not lines:
        return
    shown = lines if len(lines) <= most else lines[: int(most)]
    _row(name, shown[0] if len(lines) == 1 else len(lines))
    for line in shown if len(lines) > 1 else []:
        print(f"{'':14} {line}")
    if len(shown) < len(lines):
        print(f"{'':14} ... and {len(lines) - len(shown)} more; --verbose shows all")
