"""A live scene that follows the edits of an open stage."""

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, Vt

import warp_ir as ir
from tests.live import look_at, rays, shots

pytestmark = pytest.mark.extended

TEXT = """#usda 1.0
def Xform "World" {
    def Xform "Arm" {
        double3 xformOp:translate = (0, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
        def Cube "Box" {
            double size = 1
            color3f[] primvars:displayColor = [(0.8, 0.2, 0.1)]
        }
    }
    def Mesh "Cloth" {
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        point3f[] points = [(-2, -1, 2), (2, -1, 2), (2, -1, -2), (-2, -1, -2)]
        color3f[] primvars:displayColor = [(0.2, 0.6, 0.3)]
        double3 xformOp:translate = (0, 0.25, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def DistantLight "Sun" {
        float inputs:intensity = 3
        float inputs:angle = 0
    }
}
"""
ALL = ("hdr_color", "albedo", "depth", "normal")
EYE = look_at((0.5, 1.5, 4.0))
SETTINGS = ir.ViewSettings(filter=False, light_paths=64)
CLOTH = "/World/Cloth"


def opened():
    stage = Usd.Stage.CreateInMemory()
    stage.GetRootLayer().ImportFromString(TEXT)
    return stage


def picture(live):
    return shots(ir.Views(live.scene, SETTINGS), [EYE], rays(24), names=ALL, step=0)


def edit(stage):
    """Moves the arm, colours the box, bends the cloth."""
    stage.GetPrimAtPath("/World/Arm").GetAttribute("xformOp:translate").Set(Gf.Vec3d(0.4, 0.2, -0.3))
    UsdGeom.Xformable(stage.GetPrimAtPath("/World/Arm")).AddRotateYOp().Set(30.0)
    UsdGeom.Gprim(stage.GetPrimAtPath("/World/Arm/Box")).GetDisplayColorAttr().Set([(0.1, 0.4, 0.9)])
    points = Vt.Vec3fArray([(-2, -1, 2), (2, -0.7, 2), (2, -1, -2), (-2, -0.5, -2)])
    UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH)).GetPointsAttr().Set(points)


def test_edits_are_what_a_new_scene_shows():
    """After the edits of a stage its picture is that of a scene made of the edited stage, within float32's rounding."""
    stage = opened()
    live = ir.LiveStage(stage, deforming=[CLOTH])
    before = picture(live)
    edit(stage)
    assert live.sync() == []
    after, fresh = picture(live), picture(ir.LiveStage(stage, deforming=[CLOTH]))
    assert (before["depth"] != after["depth"]).mean() > 0.3
    for name in ("depth", "normal"):
        close = np.isclose(after[name], fresh[name], rtol=1.0e-4, atol=1.0e-4)
        assert close.mean() > 0.98, name  # a silhouette may fall on the other side of a ray
    assert (after["albedo"] == fresh["albedo"]).mean() > 0.98
    assert live.sync() == [] and (picture(live)["depth"] == after["depth"]).all()


def test_edits_that_are_not_followed_are_named():
    """Scale, lights, new prims and points of other meshes are listed, and change nothing."""
    stage = opened()
    live = ir.LiveStage(stage)
    before = picture(live)
    stage.GetPrimAtPath("/World/Sun").GetAttribute("inputs:intensity").Set(9.0)
    UsdGeom.Xformable(stage.GetPrimAtPath("/World/Arm")).AddScaleOp().Set(Gf.Vec3f(2.0))
    UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH)).GetPointsAttr().Set(Vt.Vec3fArray(4))
    UsdGeom.Cube.Define(stage, "/World/New")
    assert live.sync() == ["/World/Arm/Box", CLOTH, "/World/New", "/World/Sun"]
    assert (picture(live)["depth"] == before["depth"]).all()


def test_time_samples_are_followed():
    """Another time code moves what is animated."""
    stage = opened()
    op = stage.GetPrimAtPath("/World/Arm").GetAttribute("xformOp:translate")
    op.Set(Gf.Vec3d(0.0), 1.0)
    op.Set(Gf.Vec3d(1.0, 0.0, 0.0), 2.0)
    live = ir.LiveStage(stage, time=1.0)
    live.sync(2.0)
    row = live.scene.rows("/World/Arm/Box")[0]
    np.testing.assert_allclose(live.scene.transforms.numpy()[row, :3], (1.0, 0.0, 0.0), atol=1.0e-6)


def test_a_stage_that_is_closed_is_left_alone():
    """After `close` edits are not noted."""
    stage = opened()
    live = ir.LiveStage(stage)
    live.close()
    edit(stage)
    before = live.scene.transforms.numpy().copy()
    assert live.sync() == [] and (live.scene.transforms.numpy() == before).all()
