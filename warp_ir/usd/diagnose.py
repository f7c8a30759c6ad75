"""Why a picture will be black, where that is certain before it is rendered."""

import math
from collections.abc import Sequence
from contextlib import suppress

import numpy as np
from pxr import Usd, UsdLux

from warp_ir.scene import Camera, Floats, Mesh, Scene
from warp_ir.usd.lights.inputs import Inputs
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable


def explain_blackness(scene: Scene, report: Report) -> None:
    """Warns of a camera that sees nothing of the scene, or only the dark side of all that emits."""
    if not any(len(mesh.triangles) for mesh in scene.meshes):
        return
    camera = scene.camera
    nearest, farthest = _depths(scene, camera)
    near, far = camera.clipping
    if farthest <= 0.0:
        report.warn(camera.name, "all geometry is behind the camera: the picture shows none")
    elif farthest < near:
        report.warn(camera.name, f"clippingRange: near, {near:g}, lies behind all geometry, which ends at {farthest:g}")
    elif nearest > far:
        report.warn(camera.name, f"clippingRange: far, {far:g}, lies before all geometry, which begins at {nearest:g}")
    for mesh in _dark_inside(scene):
        why = "the camera is inside it, and it emits outwards only (doubleSided, orientation)"
        report.warn(mesh.name, f"{why}: nothing lights what is seen")


def _depths(scene: Scene, camera: Camera) -> tuple[float, float]:
    """Least and greatest depth along the camera's -Z that the corners of the scene's bounding box have."""
    lower, upper = scene.bounds()
    corners = np.array(
        [[x, y, z] for x in (lower[0], upper[0]) for y in (lower[1], upper[1]) for z in (lower[2], upper[2])]
    )
    depth = (camera.world_from_camera[:3, 3] - corners) @ camera.world_from_camera[:3, 2]
    # Points are floats: the box is no more exact than they are.
    slack = 1e-6 * (np.abs(corners).max() + np.abs(camera.world_from_camera[:3, 3]).max())
    return float(depth.min() - slack), float(depth.max() + slack)


def _dark_inside(scene: Scene) -> list[Mesh]:
    """All meshes that emit, if each is closed around the camera and turns its dark side to it; else none."""
    if scene.lights:
        return []
    emits = np.array([max(m.emission) > 0.0 for m in scene.materials], bool)
    opaque = np.array([m.opacity >= 1.0 and m.opacity_texture is None for m in scene.materials], bool)
    instanced = {k for group in scene.instances for k in group.meshes}
    eye = scene.camera.world_from_camera[:3, 3]
    found = []
    for k, mesh in enumerate(scene.meshes):
        if not len(mesh.triangles) or not emits[mesh.material].any():
            continue
        if k in instanced or mesh.double_sided or not opaque[mesh.material].all():
            return []
        a, b, c = (mesh.points[mesh.triangles[:, i]] - eye for i in range(3))
        # Back-facing, all that emits; so no smaller lamp within the same mesh shines at the camera.
        facing = np.sum(np.cross(b - a, c - a) * a, axis=1)
        if (facing[emits[mesh.material]] <= 0.0).any() or abs(_winding(a, b, c) - 1.0) > 1.0e-3:
            return []
        found.append(mesh)
    return found


def _winding(a: Floats, b: Floats, c: Floats) -> float:
    """How often triangles with these corners [m, 3] wind around the origin (van Oosterom and Strackee 1983)."""
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    triple = np.sum(a * np.cross(b, c), axis=1)
    below = la * lb * lc + np.sum(a * b, axis=1) * lc + np.sum(b * c, axis=1) * la + np.sum(c * a, axis=1) * lb
    return float(2.0 * np.arctan2(triple, below).sum() / (4.0 * math.pi))


def explain_dark_lights(prims: Sequence[Usd.Prim], time: Usd.TimeCode, report: Report) -> None:
    """Says of lights that emit nothing which of their inputs has it so; of others more has been said already."""
    for prim in prims:
        inputs = Inputs(prim, time, report.section())
        with suppress(Unreadable):
            for name, default in (("intensity", 50000.0 if prim.IsA(UsdLux.DistantLight) else 1.0), ("diffuse", 1.0)):
                number = inputs.number(name, default)
                if number <= 0.0:
                    report.warn(prim.GetPath(), f"inputs:{name} is {number:g}: it emits nothing")
            if max(read.color(inputs.attribute("color"), time, (1.0, 1.0, 1.0))) <= 0.0:
                report.warn(prim.GetPath(), "inputs:color is black: it emits nothing")
