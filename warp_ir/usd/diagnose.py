"""Diagnoses of pictures that are certain to be empty or black, before they are rendered."""

import math
from collections.abc import Sequence
from contextlib import suppress

import numpy as np
from pxr import Usd, UsdLux

from warp_ir.scene import Camera, Floats, Mesh, Projection, Scene
from warp_ir.usd.lights.inputs import LightInputs
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable

_TOUCHING = 2.0**-22
"""Distance to a surface, relative to the extent, that float32 in the device frame may round to 0."""


def diagnose_black_picture(scene: Scene, report: Report) -> None:
    """Warns if no geometry is between the camera's clipping planes, or if all emitters face away from the camera.

    It also warns of a camera in a surface, which then hides the scene from it.
    """
    if not any(len(mesh.triangles) for mesh in scene.meshes):
        return
    camera = scene.camera
    nearest, farthest = _depths(scene, camera)
    near, far = camera.clipping
    if farthest <= 0.0:
        report.warn(camera.name, "all geometry is behind the camera: the picture is empty")
    elif farthest < near:
        report.warn(camera.name, f"clippingRange: near, {near:g}, lies behind all geometry, which ends at {farthest:g}")
    elif nearest > far:
        report.warn(camera.name, f"clippingRange: far, {far:g}, lies before all geometry, which begins at {nearest:g}")
    surface = _surface_around_eye(scene)
    if surface is not None:
        what = f"it lies in the surface of {surface.name}: the picture is black; clippingRange can clip it away"
        report.warn(camera.name, what)
    for mesh in _emitters_facing_away(scene):
        why = "the camera is inside it, and it emits outwards only (doubleSided, orientation)"
        report.warn(mesh.name, f"{why}: the picture is black")


def _depths(scene: Scene, camera: Camera) -> tuple[float, float]:
    """Minimum and maximum depth, along the camera's -Z, of the corners of the scene's bounding box."""
    lower, upper = scene.bounds()
    corners = np.array(
        [[x, y, z] for x in (lower[0], upper[0]) for y in (lower[1], upper[1]) for z in (lower[2], upper[2])]
    )
    depth = (camera.world_from_camera[:3, 3] - corners) @ camera.world_from_camera[:3, 2]
    # Points are float32: the box has their relative error.
    slack = 1e-6 * (np.abs(corners).max() + np.abs(camera.world_from_camera[:3, 3]).max())
    return float(depth.min() - slack), float(depth.max() + slack)


def _surface_around_eye(scene: Scene) -> Mesh | None:
    """A mesh that the eye of a perspective camera touches and its clipping does not remove; None: there is none."""
    lower, upper = scene.bounds()
    slack = _TOUCHING * float(np.linalg.norm(upper - lower))
    eye = scene.camera.world_from_camera[:3, 3]
    in_box = ((lower - slack <= eye) & (eye <= upper + slack)).all()
    if scene.camera.projection != Projection.PERSPECTIVE or scene.camera.clipping[0] > slack or not in_box:
        return None
    instanced = scene.instanced()
    for k, mesh in enumerate(scene.meshes):
        if k not in instanced and _touches(mesh, eye, slack):
            return mesh
    for group in scene.instances:
        linear, to_eye = group.matrices[:, :3, :3], eye - group.matrices[:, :3, 3]
        scale, distance = np.linalg.norm(linear, axis=(1, 2)), np.linalg.norm(to_eye, axis=1)
        for mesh in (scene.meshes[k] for k in group.meshes):
            radius = float(np.linalg.norm(mesh.points, axis=1).max(initial=0.0))
            for i in np.nonzero(distance <= scale * radius + slack)[0]:
                with suppress(np.linalg.LinAlgError):  # an instance that is flat
                    if _touches(mesh, np.linalg.solve(linear[i], to_eye[i]), slack / float(scale[i])):
                        return mesh
    return None


def _touches(mesh: Mesh, point: Floats, slack: float) -> bool:
    """Whether a point lies in a triangle of a mesh, up to a distance."""
    # The sides on which a vertex lies, one bit each: triangles with a common side are elsewhere (Cohen, Sutherland).
    codes = np.zeros(len(mesh.points), np.uint8)
    for axis in range(3):
        codes |= (mesh.points[:, axis] > point[axis] + slack).astype(np.uint8) << (2 * axis)
        codes |= (mesh.points[:, axis] < point[axis] - slack).astype(np.uint8) << (2 * axis + 1)
    first, second, third = (mesh.triangles[:, k] for k in range(3))
    near = mesh.triangles[(codes[first] & codes[second] & codes[third]) == 0]
    corners = mesh.points[near] - point
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    touches = (length > 0.0) & (np.abs(np.sum(normal * a, axis=1)) <= slack * length)
    for p, q in ((a, b), (b, c), (c, a)):
        touches &= np.sum(normal * np.cross(p, q), axis=1) >= -slack * length * np.linalg.norm(q - p, axis=1)
    return bool(touches.any())


def _emitters_facing_away(scene: Scene) -> list[Mesh]:
    """All emissive meshes, if each is closed around the camera and emits away from it; else none."""
    if scene.lights:
        return []
    emits = np.array([max(m.emission) > 0.0 for m in scene.materials], bool)
    opaque = np.array([m.opacity >= 1.0 and m.opacity_texture is None for m in scene.materials], bool)
    instanced = scene.instanced()
    eye = scene.camera.world_from_camera[:3, 3]
    enclosing = []
    for k, mesh in enumerate(scene.meshes):
        if not len(mesh.triangles) or not emits[mesh.material].any():
            continue
        if k in instanced or mesh.double_sided or not opaque[mesh.material].all():
            return []
        a, b, c = (mesh.points[mesh.triangles[:, i]] - eye for i in range(3))
        # All emissive triangles are back-facing, so that no smaller emitter in the same mesh faces the camera.
        facing = np.sum(np.cross(b - a, c - a) * a, axis=1)
        if (facing[emits[mesh.material]] <= 0.0).any() or abs(_winding_number(a, b, c) - 1.0) > 1.0e-3:
            return []
        enclosing.append(mesh)
    return enclosing


def _winding_number(a: Floats, b: Floats, c: Floats) -> float:
    """Winding number around the origin of triangles with these corners [m, 3] (van Oosterom and Strackee 1983)."""
    length_a, length_b, length_c = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    triple = np.sum(a * np.cross(b, c), axis=1)
    denominator = (
        length_a * length_b * length_c
        + np.sum(a * b, axis=1) * length_c
        + np.sum(b * c, axis=1) * length_a
        + np.sum(c * a, axis=1) * length_b
    )
    return float(2.0 * np.arctan2(triple, denominator).sum() / (4.0 * math.pi))


def diagnose_dark_lights(prims: Sequence[Usd.Prim], time: Usd.TimeCode, report: Report) -> None:
    """Warns of the inputs by which lights emit nothing; unreadable inputs have been reported before."""
    for prim in prims:
        inputs = LightInputs(prim, time, report.section())
        with suppress(Unreadable):
            for name, default in (("intensity", 50000.0 if prim.IsA(UsdLux.DistantLight) else 1.0), ("diffuse", 1.0)):
                number = inputs.number(name, default)
                if number <= 0.0:
                    report.warn(prim.GetPath(), f"inputs:{name} is {number:g}: it emits nothing")
            if max(read.color(inputs.attribute("color"), time, (1.0, 1.0, 1.0))) <= 0.0:
                report.warn(prim.GetPath(), "inputs:color is black: it emits nothing")
