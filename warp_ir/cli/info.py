"""`warp-ir info`: what is in a stage, what will be skipped, and why."""

import argparse
import json
import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from warp_ir.cli.console import say_warnings
from warp_ir.cli.stage import load_scene, stage_facts
from warp_ir.scene import LightKind, Scene

_LINES = 20
"""Lights, materials, ... listed by name before only their number is told; --verbose lists all."""


def run(args: argparse.Namespace) -> int:
    """Prints the table, or JSON; the exit code."""
    scene = load_scene(args, args.time)
    facts = describe(scene, args.stage)
    if args.json:
        print(json.dumps({**facts, "warnings": list(scene.warnings)}, indent=2))
        return 0
    _print_table(facts, math.inf if args.verbose else _LINES)
    if not args.quiet:
        say_warnings(scene.warnings, everything=args.verbose)
    return 0


def describe(scene: Scene, path: str) -> dict[str, Any]:
    """The scene in plain values, with what only the stage itself knows."""
    lower, upper = scene.bounds()
    return {
        "stage": str(path),
        **stage_facts(path),
        "camera": {
            "name": scene.camera.name,
            "projection": scene.camera.projection.name.lower(),
            "aspect": scene.camera.aspect,
            "position": _floats(scene.camera.world_from_camera[:3, 3]),
            "window": _floats(scene.camera.window),
        },
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
        "lights": [
            {"name": light.name, "kind": light.kind.name.lower(), "radiance": _floats(light.radiance)}
            for light in scene.lights
        ],
        "materials": [
            {"name": m.name, "albedo": _floats(m.albedo), "emission": _floats(m.emission)} for m in scene.materials
        ],
        "emissive_triangles": _emissive_triangles(scene),
        "counts": {key: int(value) for key, value in scene.stats.items()},
    }


def _floats(values: Iterable[float]) -> list[float]:
    return [float(value) for value in values]


def _emissive_triangles(scene: Scene) -> int:
    emits = np.array([any(x > 0.0 for x in material.emission) for material in scene.materials], dtype=bool)
    return sum(int(emits[mesh.material].sum()) for mesh in scene.meshes)


def _print_table(facts: dict[str, Any], most: float) -> None:
    """One fact a line, the names aligned."""
    camera, (lower, upper) = facts["camera"], facts["bounds"]
    lights = [
        f"{light['kind']:9} {_EMITS[light['kind']]} ({_numbers(light['radiance'])})  {light['name']}"
        for light in facts["lights"]
    ]
    materials = [
        f"albedo ({_numbers(m['albedo'])}){_emission(m['emission'])}  {m['name'] or '(default)'}"
        for m in facts["materials"]
    ]
    _row("stage", facts["stage"])
    _row("up axis", f"{facts['up_axis']}, {facts['meters_per_unit']:g} m per unit")
    if facts["frames"]:
        _row("frames", "{:g} to {:g}".format(*facts["frames"]))
    _row(
        "camera",
        f"{camera['name'] or '(around it all)'}, {camera['projection']}, aspect {camera['aspect']:.4g}",
    )
    _list("other cameras", [name for name in facts["cameras"] if name != camera["name"]], most)
    _row("meshes", facts["meshes"])
    seen = f"; {facts['triangles_seen']} are seen" if facts["prototypes"] else ""
    _row("triangles", f"{facts['triangles']}, {facts['emissive_triangles']} of them emit{seen}")
    _list(
        "prototypes",
        [f"{p['instances']} instances of {p['triangles']} triangles  {p['name']}" for p in facts["prototypes"]],
        most,
    )
    _row("bounds", f"({_numbers(lower)}) to ({_numbers(upper)})")
    _list("lights", lights, most)
    _list("materials", materials, most)
    _list("counts", [f"{value:9} {key.replace('_', ' ')}" for key, value in facts["counts"].items()], math.inf)


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
