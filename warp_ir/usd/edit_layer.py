"""Edits of a camera, of lights and of colours as a layer: opinions that are stronger than those of the stage."""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdRender, UsdShade, Vt

from warp_ir.files import whole_file
from warp_ir.scene import Camera, Color, Floats, Projection
from warp_ir.usd.camera_prim import find_camera
from warp_ir.usd.stage.open import quiet_diagnostics, time_code
from warp_ir.usd.values.report import Report

_CAMERA = "/main_cam"
"""Path of a camera that is none of the stage: of all cameras, that of this name is the one that is rendered."""
_APERTURE = 20.955
"""Width of the film [tenths of a scene unit], USD's default."""
_APERTURE_UNIT = 0.1
"""Apertures and focal lengths are in tenths of a scene unit."""
_SHADER = "EditedSurface"


def write_edits(
    path: Path,
    stage: Usd.Stage,
    time: float | str | None,
    *,
    camera: Camera | None = None,
    lights: Mapping[str, tuple[float, tuple[float, float, float]]],
    colors: Mapping[str, Color],
) -> list[str]:
    """Writes a layer for `--session-layer`; returns a line for each edit that it cannot hold, or needs help with.

    Args:
        path: The file, .usda, .usdc or .usd.
        stage: The stage that was edited.
        time: Time code at which its values are read, as for `load_usd`; the layer's hold at all times.
        camera: The camera to render, which overrides the prim of its name, if there is one; None: as in the stage.
        lights: By the path of a light, or of a material that emits: a factor on what it emits, and an offset [3] in
            world space.
        colors: By the path of a material, or of a gprim without one: its albedo, linear.
    """
    layer = Sdf.Layer.CreateAnonymous("edits.usda")
    left_out: list[str] = []
    with quiet_diagnostics():
        # The edits are made on a stage of its own, so that the values they start from stay as they are.
        edited = Usd.Stage.Open(stage.GetRootLayer(), Sdf.Layer.CreateAnonymous("session.usda"))
        edited.GetSessionLayer().subLayerPaths = [layer.identifier, stage.GetSessionLayer().identifier]
        code = time_code(stage, time)
        with Usd.EditContext(edited, layer):
            if camera is not None:
                left_out += _write_camera(edited, camera)
            for name, (gain, offset) in lights.items():
                prim = _editable(edited, name)
                if prim is None or not _write_light(prim, gain, offset, code):
                    left_out.append(f"{name}: its light cannot be edited in a layer")
            for name, color in colors.items():
                prim = _editable(edited, name)
                if prim is None or not _write_color(prim, color, code):
                    left_out.append(f"{name}: its colour cannot be edited in a layer")
        with whole_file(path) as temporary:
            layer.Export(str(temporary))
    return left_out


def _editable(stage: Usd.Stage, name: str) -> Usd.Prim | None:
    """The prim of a path; None: there is none, or it is part of an instance."""
    prim = stage.GetPrimAtPath(name) if Sdf.Path.IsValidPathString(name) and name.startswith("/") else None
    if not prim or prim.IsInstanceProxy() or prim.IsInPrototype():
        return None
    return prim


def _write_camera(stage: Usd.Stage, camera: Camera) -> list[str]:
    """Writes a camera; returns a line if it is not the one that is rendered by default."""
    prim = _editable(stage, camera.name)
    if prim is None or not prim.IsA(UsdGeom.Camera):
        prim = UsdGeom.Camera.Define(stage, _CAMERA).GetPrim()
    named = False
    for settings in [p for p in stage.Traverse() if p.IsA(UsdRender.Settings) or p.IsA(UsdRender.Product)]:
        relationship = settings.GetRelationship("camera")
        if relationship and relationship.GetTargets():
            named = relationship.SetTargets([prim.GetPath()])
    usd = UsdGeom.Camera(prim)
    _set_world_transform(prim, camera.world_from_camera)
    left, right, bottom, top = camera.window
    perspective = camera.projection == Projection.PERSPECTIVE
    unit = _APERTURE / (right - left) if perspective else 1.0 / _APERTURE_UNIT  # of the window, in aperture units
    usd.CreateProjectionAttr(UsdGeom.Tokens.perspective if perspective else UsdGeom.Tokens.orthographic)
    usd.CreateFocalLengthAttr(unit)
    usd.CreateHorizontalApertureAttr((right - left) * unit)
    usd.CreateVerticalApertureAttr((top - bottom) * unit)
    usd.CreateHorizontalApertureOffsetAttr(0.5 * (left + right) * unit)
    usd.CreateVerticalApertureOffsetAttr(0.5 * (bottom + top) * unit)
    far = camera.clipping[1] if math.isfinite(camera.clipping[1]) else 1.0e30
    usd.CreateClippingRangeAttr(Gf.Vec2f(camera.clipping[0], far))
    usd.CreateClippingPlanesAttr(Vt.Vec4fArray([Gf.Vec4f(*plane) for plane in camera.clipping_planes]))
    if camera.lens_radius > 0.0:
        usd.CreateFStopAttr(0.5 * _APERTURE_UNIT * unit / camera.lens_radius)
        usd.CreateFocusDistanceAttr(camera.focus_distance)
    elif usd.GetFStopAttr().HasAuthoredValue():
        usd.CreateFStopAttr(0.0)
    if named or find_camera(stage, None, "", Report("")) == prim:
        return []
    return [f"render it with --camera {prim.GetPath()}"]


def _set_world_transform(prim: Usd.Prim, world: Floats) -> None:
    """Makes world_from_local of a prim a constant matrix [4, 4] of column vectors, whatever its ancestors do."""
    xformable = UsdGeom.Xformable(prim)
    operation = xformable.GetPrim().GetAttribute("xformOp:transform:edited")
    transform = UsdGeom.XformOp(operation) if operation else xformable.AddTransformOp(opSuffix="edited")
    transform.Set(Gf.Matrix4d(*np.asarray(world, dtype=np.float64).T.ravel().tolist()))
    xformable.SetXformOpOrder([transform], resetXformStack=True)


def _write_light(prim: Usd.Prim, gain: float, offset: tuple[float, float, float], time: Usd.TimeCode) -> bool:
    """Whether a light, or a material that emits, could be scaled and moved."""
    if np.any(offset):
        if not prim.IsA(UsdGeom.Xformable):
            return False
        world = np.array(UsdGeom.XformCache(time).GetLocalToWorldTransform(prim)).T
        world[:3, 3] += offset
        _set_world_transform(prim, world)
    if gain == 1.0:
        return True
    if prim.IsA(UsdShade.Material):
        shader = _preview_surface(UsdShade.Material(prim))
        emission = None if shader is None else shader.GetInput("emissiveColor")
        value = emission.Get(time) if emission and not emission.HasConnectedSource() else None
        if emission is None or value is None:
            return False
        emission.GetAttr().Set(Gf.Vec3f(value) * gain)
        return True
    if not prim.HasAPI(UsdLux.LightAPI):
        return False
    attribute = UsdLux.LightAPI(prim).GetIntensityAttr()
    attribute.Set(float(attribute.Get(time)) * gain)
    return True


def _write_color(prim: Usd.Prim, color: Color, time: Usd.TimeCode) -> bool:
    """Whether a material, or a gprim without one, could be given a constant albedo."""
    if prim.IsA(UsdShade.Material):
        material = UsdShade.Material(prim)
        shader = _preview_surface(material)
        if shader is None:
            shader = UsdShade.Shader.Define(prim.GetStage(), prim.GetPath().AppendChild(_SHADER))
            shader.CreateIdAttr("UsdPreviewSurface")
            surface = shader.CreateOutput("surface", Sdf.ValueTypeNames.Token)
            for output in [material.CreateSurfaceOutput(), *material.GetSurfaceOutputs()]:
                output.GetAttr().SetConnections([surface.GetAttr().GetPath()])
        diffuse = shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
        diffuse.GetAttr().SetConnections([])
        diffuse.Set(Gf.Vec3f(*color))
        return True
    if not prim.IsA(UsdGeom.Gprim):
        return False
    primvar = UsdGeom.Gprim(prim).CreateDisplayColorPrimvar(UsdGeom.Tokens.constant)
    primvar.Set(Vt.Vec3fArray([Gf.Vec3f(*color)]))
    primvar.BlockIndices()
    return True


def _preview_surface(material: UsdShade.Material) -> UsdShade.Shader | None:
    """The shader of a material's universal surface, if that is a UsdPreviewSurface and no MaterialX hides it."""
    if material.ComputeSurfaceSource("mtlx")[1] == "surface" and material.GetSurfaceOutput("mtlx"):
        return None
    source = material.ComputeSurfaceSource()[0]
    shader = UsdShade.Shader(source) if source else None
    if shader is None or shader.GetShaderId() != "UsdPreviewSurface" or shader.GetPrim().IsInstanceProxy():
        return None
    return shader
