"""VPLs as layers of USD: as points to look at, and as lights with which any renderer can light the scene."""

from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, Vt

from warp_ir.files import whole_file
from warp_ir.scene import Scene

_LIGHT_RADIUS = 1e-3
"""Radius of a disk light that stands for a VPL, per extent of the scene: far smaller than what it lights."""
_LIGHT_OFFSET = 0.1
"""Distance of such a light from its surface, in its radius: it does not lie in the surface's plane."""


class VplArrays(Protocol):
    """The arrays that are written, as in `warp_ir.vpl.trace.Vpls`."""

    @property
    def positions(self) -> npt.NDArray[np.float64]:
        """[n, 3], world space; where `directional`, the direction towards the light."""

    @property
    def normals(self) -> npt.NDArray[np.float32]:
        """[n, 3], unit; zero where the VPL shines the same in all directions."""

    @property
    def intensity(self) -> npt.NDArray[np.float32]:
        """[n, 3] [W/sr]; where `directional`, irradiance [W/m²]."""

    @property
    def bounce(self) -> npt.NDArray[np.int32]:
        """[n], number of reflections before."""

    @property
    def directional(self) -> npt.NDArray[np.bool_]:
        """[n], whether the VPL is infinitely far away."""


def write_points(path: Path, scene: Scene, vpls: VplArrays, up_axis: str, meters_per_unit: float) -> None:
    """Writes the VPLs that have a position as UsdGeom.Points.

    displayColor is the colour of the intensity, and widths grow with its square root. Primvars hold the exact
    `intensity` [W sr⁻¹] and `bounce`. Positions are in world space, with the unit and the up axis of the stage, so that
    the file can be layered over it.

    Args:
        path: The .usda file.
        scene: The scene of the VPLs.
        vpls: The VPLs.
        up_axis: "Y" or "Z".
        meters_per_unit: Metres in a unit of the stage.
    """
    local = ~np.asarray(vpls.directional, dtype=bool)
    intensity = np.asarray(vpls.intensity, dtype=np.float64)[local]
    peak = intensity.max(axis=1, initial=0.0)
    relative = peak / max(float(peak.max(initial=0.0)), 1e-300)
    widths = 0.02 * (scene.extent or 1.0) * np.clip(np.sqrt(relative), 0.1, 1.0)
    out = _stage(scene, up_axis, meters_per_unit)
    points = UsdGeom.Points.Define(out, "/VPLs")
    out.SetDefaultPrim(points.GetPrim())
    points.CreatePointsAttr(_vectors(np.asarray(vpls.positions)[local]))
    points.CreateNormalsAttr(_vectors(np.asarray(vpls.normals)[local]))
    points.CreateWidthsAttr(Vt.FloatArray.FromNumpy(widths.astype(np.float32)))
    points.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
    colors = points.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
    colors.Set(_vectors(intensity / np.maximum(peak, 1e-300)[:, None]))
    primvars = UsdGeom.PrimvarsAPI(points)
    exact = primvars.CreatePrimvar("intensity", Sdf.ValueTypeNames.Float3Array, UsdGeom.Tokens.vertex)
    exact.Set(_vectors(intensity))
    bounce = np.asarray(vpls.bounce)[local].astype(np.int32)
    primvars.CreatePrimvar("bounce", Sdf.ValueTypeNames.IntArray, UsdGeom.Tokens.vertex).Set(
        Vt.IntArray.FromNumpy(bounce)
    )
    points.CreateExtentAttr(UsdGeom.Boundable.ComputeExtentFromPlugins(points, Usd.TimeCode.Default()))
    _save(out, path)


def write_lights(path: Path, scene: Scene, vpls: VplArrays, up_axis: str, meters_per_unit: float) -> None:
    """Writes the VPLs as UsdLux lights: direct light by them is the global illumination of the VPLs.

    A VPL on a surface is a small DiskLight, which shines by the cosine as the VPL does; one that shines in all
    directions is a SphereLight that is treated as a point; a directional one is a DistantLight of angle 0. All are
    normalized, so that their size does not count. The stage whose scene this is has to be lit by them alone: layer the
    file over it, and deactivate its own lights.

    Args:
        path: The .usda file.
        scene: The scene of the VPLs.
        vpls: The VPLs.
        up_axis: "Y" or "Z".
        meters_per_unit: Metres in a unit of the stage.
    """
    out = _stage(scene, up_axis, meters_per_unit)
    out.SetDefaultPrim(UsdGeom.Scope.Define(out, "/VPLs").GetPrim())
    radius = _LIGHT_RADIUS * (scene.extent or 1.0)
    directional = np.asarray(vpls.directional, dtype=bool)
    for k, (position, normal, intensity) in enumerate(
        zip(np.asarray(vpls.positions), np.asarray(vpls.normals, np.float64), vpls.intensity.tolist(), strict=True)
    ):
        peak = max(intensity)
        if not peak > 0.0:
            continue
        prim_path, strength = f"/VPLs/vpl_{k}", peak
        light: Any
        if directional[k]:
            light, axis, place = UsdLux.DistantLight.Define(out, prim_path), position, np.zeros(3)
            light.CreateAngleAttr(0.0)
        elif not normal.any():
            light, axis, place = UsdLux.SphereLight.Define(out, prim_path), np.array([0.0, 0.0, 1.0]), position
            light.CreateRadiusAttr(radius)
            light.CreateTreatAsPointAttr(True)
            strength = 4.0 * peak  # a sphere of area A and radiance L has the intensity L A / 4
        else:
            light, axis = UsdLux.DiskLight.Define(out, prim_path), -normal
            place = position + _LIGHT_OFFSET * radius * normal
            light.CreateRadiusAttr(radius)
        light.CreateIntensityAttr(strength)
        light.CreateNormalizeAttr(True)
        light.CreateColorAttr(Gf.Vec3f(*(c / peak for c in intensity)))
        # UsdLux lights shine along their -Z.
        rotation = Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(0.0, 0.0, 1.0), Gf.Vec3d(*axis.tolist())))
        light.AddTransformOp().Set(rotation.SetTranslateOnly(Gf.Vec3d(*place.tolist())))
    _save(out, path)


def _stage(scene: Scene, up_axis: str, meters_per_unit: float) -> Usd.Stage:
    out = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(out, up_axis)
    UsdGeom.SetStageMetersPerUnit(out, meters_per_unit)
    out.SetMetadata("comment", f"virtual point lights of {scene.name}")
    return out


def _vectors(values: npt.NDArray[Any]) -> Vt.Vec3fArray:
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32))


def _save(stage: Usd.Stage, path: Path) -> None:
    with whole_file(path) as temporary:
        temporary.write_text(stage.GetRootLayer().ExportToString(), encoding="utf-8")
