"""A USD stage becomes a `Scene`: find what is drawn, read each prim once, place it, light it, look at it."""

import math
import os
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pxr import Tf, Usd

from warp_ir.scene import InputError, Light, LightKind, Scene
from warp_ir.usd.camera import find_camera, framing_camera, read_camera
from warp_ir.usd.gprim import build_meshes
from warp_ir.usd.light import LIGHTS, read_light
from warp_ir.usd.report import Report, Unreadable
from warp_ir.usd.stage import first_message, open_stage, quiet, time_code, up_axis
from warp_ir.usd.walk import Site, walk

_COUNTED = (
    "meshes",
    "triangles",
    "triangles_seen",
    "materials",
    "lights",
    "instances",
    "native_instances",
    "point_instances",
    "prototypes",
    "prototype_places",
    "prims_invisible",
    "prims_other_purpose",
    "degenerate_faces",
    "triangles_absent",
    "unused_materials",
    "lights_without_emission",
    "composition_errors",
)
"""Counts that `Scene.stats` always has, in this order."""
_LEVELS = {"low": 0, "medium": 1, "high": 2, "veryhigh": 3}
"""How often `complexity` refines a subdivision surface, as usdrecord's complexities 1.0 to 1.3 do."""
_PURPOSES = ("default", "render", "proxy", "guide")


def load_usd(
    path: str | os.PathLike[str],
    *,
    camera: str | None = None,
    time: float | None = None,
    purposes: Sequence[str] = ("default", "render"),
    complexity: str = "low",
    default_light: str = "dome",
    strict: bool = False,
) -> Scene:
    """Load a USD file for rendering.

    A prim that cannot be read is skipped and named in `Scene.warnings`; the rest is loaded.

    Args:
        path: A .usd, .usda, .usdc or .usdz file.
        camera: Absolute path or name of the camera; None: the one the render settings name, else "main_cam",
            else the first, else one that frames the scene.
        time: Time code; None: the stage's start.
        purposes: Which of default, render, proxy and guide to draw.
        complexity: How finely subdivision surfaces are drawn: "low" as their cages, "medium", "high" and "veryhigh"
            after one, two and three levels of refinement.
        default_light: What to do if nothing emits: "dome" adds a uniform white one of radiance 1, "none" nothing.
        strict: Whether the first warning is an error.

    Raises:
        InputError: The file cannot be opened, the camera does not exist or is unusable, an argument is wrong, or
            the scene is too large.
    """
    source = os.fspath(path)
    if isinstance(purposes, str) or not set(purposes) <= set(_PURPOSES):
        raise InputError(f"purposes: {purposes!r} is not a selection of {', '.join(_PURPOSES)}")
    if complexity not in _LEVELS:
        raise InputError(f"complexity: {complexity!r} is none of {', '.join(_LEVELS)}")
    if default_light not in ("dome", "none"):
        raise InputError(f"default_light: '{default_light}' is neither 'dome' nor 'none'")
    if time is not None and not math.isfinite(time):
        raise InputError(f"time: {time} is not a finite number")
    report = Report(source, strict=strict)
    # Any number in a file may be NaN or huge; readers look at what they compute, NumPy need not say it first.
    with quiet(), np.errstate(all="ignore"):
        stage = open_stage(source, report)
        try:
            return _load(stage, time_code(stage, time), camera, purposes, _LEVELS[complexity], default_light, report)
        except Tf.ErrorException as error:  # damage that shows only when the value is unpacked
            raise InputError(f"{source}: cannot be read: {first_message(error)}") from None


def _load(
    stage: Usd.Stage,
    time: Usd.TimeCode,
    camera: str | None,
    purposes: Sequence[str],
    levels: int,
    default_light: str,
    report: Report,
) -> Scene:
    chosen = find_camera(stage, camera, report)
    view = None if chosen is None else read_camera(chosen, time, report)
    axis = up_axis(stage, report)
    found = walk(stage, time, purposes, report)
    geometry = build_meshes(found.shapes, time, report, levels)
    meshes, materials = geometry.meshes, geometry.materials
    lights = _lights(found.lights, time, report)
    if not meshes:
        hint = "; it has proxies (purposes)" if report.stats["prims_proxy"] else ""
        report.warn("/", f"the stage draws no geometry{hint}")
    if not lights and not any(max(m.emission) > 0.0 for m in materials) and default_light == "dome":
        report.warn("/", "nothing emits light; a uniform white dome of radiance 1 is added")
        lights = (Light("default dome", LightKind.DOME, (1.0, 1.0, 1.0)),)
    stats = dict.fromkeys(_COUNTED, 0) | report.stats
    stats["meshes"], stats["materials"], stats["lights"] = len(meshes), len(materials), len(lights)
    stats["instances"] = stats["native_instances"] + stats["point_instances"]
    stats["prototypes"] = len(geometry.instances)
    stats["prototype_places"] = sum(len(group.matrices) for group in geometry.instances)
    scene = Scene(meshes, materials, lights, instances=geometry.instances, name=report.source)
    stats["triangles"], stats["triangles_seen"] = scene.triangle_count, scene.triangles_seen
    if view is None:
        along = "-Z" if axis == "Y" else "+Y"
        report.warn("/", f"no camera; one that looks along {along} frames the scene from outside")
        view = framing_camera(*scene.bounds(), axis)
    return replace(scene, camera=view, warnings=report.lines(), stats=stats)


def _lights(sites: Sequence[Site], time: Usd.TimeCode, report: Report) -> tuple[Light, ...]:
    lights = []
    for site in sites:
        kind = LIGHTS[site.prim.GetPrimTypeInfo().GetSchemaTypeName()]
        try:
            light = read_light(site.prim, kind, site.matrices[0], time, report)
        except Unreadable as trouble:
            report.warn(site.prim.GetPath(), f"{trouble}; the light is skipped")
            continue
        if light is None:
            report.stats["lights_without_emission"] += 1
        else:
            lights.append(light)
    return tuple(lights)
