"""Displacement of refined meshes by UsdPreviewSurface."""

import numpy as np
import pytest

from tests.stages import area, load, textured, volume, warned, write_image


def box(scheme="bilinear"):
    """A closed cube of side 2 around the origin, with the material A."""
    return f"""
    def Mesh "M" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
        point3f[] points = [(-1,-1,-1), (1,-1,-1), (1,1,-1), (-1,1,-1), (-1,-1,1), (1,-1,1), (1,1,1), (-1,1,1)]
        int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
        int[] faceVertexIndices = [0,3,2,1, 4,5,6,7, 0,1,5,4, 2,3,7,6, 1,2,6,5, 0,4,7,3]
        uniform token subdivisionScheme = "{scheme}"
        rel material:binding = </A>
    }}
    """


def material(amount):
    """A UsdPreviewSurface with a displacement."""
    return f"""
    def Material "A" {{
        token outputs:surface.connect = </A/S.outputs:surface>
        def Shader "S" {{
            uniform token info:id = "UsdPreviewSurface"
            float inputs:displacement = {amount}
            token outputs:surface
        }}
    }}
    """


def test_a_constant_moves_the_surface_outwards(tmp_path):
    """A Catmull-Clark cube grows by the amount on all sides, stays closed, and has unit normals that point outward."""
    before = load(tmp_path, material(0.0) + box("catmullClark"), complexity="veryhigh").meshes[0]
    after = load(tmp_path, material(0.1) + box("catmullClark"), complexity="veryhigh").meshes[0]
    assert np.ptp(after.points, axis=0) == pytest.approx(np.ptp(before.points, axis=0) + 0.2, abs=1e-3)
    # Steiner: the volume grows by A d and the mean curvature times d², which is less than 4 π r d² of a ball around it.
    growth = volume(after) - volume(before) - 0.1 * area(before)
    assert 0.0 < growth < 4.0 * np.pi * 1.0 * 0.01 + 0.01
    assert np.linalg.norm(after.normals, axis=-1) == pytest.approx(1.0, abs=1e-6)


def test_a_cage_is_not_displaced(tmp_path):
    """Without refinement the warning names the material, and the points stay."""
    scene = load(tmp_path, material(0.1) + box())
    assert warned(scene, "/A", "displacement is not rendered")
    assert np.abs(scene.meshes[0].points).max() == 1.0


def test_a_texture_displaces_by_its_values(tmp_path):
    """A step of an image, 0 on the left and 1 on the right, lifts the right half of a quad by 1."""
    image = np.zeros((2, 2, 3), np.uint8)
    image[:, 1] = 255
    write_image(tmp_path / "a.png", image)
    text = textured(
        'token inputs:sourceColorSpace = "raw"\n token inputs:wrapS = "clamp"', "r", "float inputs:displacement"
    )
    quad = """
    def Mesh "M" (prepend apiSchemas = ["MaterialBindingAPI"]) {
        point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        uniform token subdivisionScheme = "bilinear"
        texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = "vertex")
        rel material:binding = </A>
    }
    """
    mesh = load(tmp_path, text + quad, complexity="veryhigh").meshes[0]
    x, _, z = mesh.points.T
    # Bilinear interpolation between texels at 1/4 and 3/4.
    assert z == pytest.approx(((x - 0.25) / 0.5).clip(0.0, 1.0), abs=1e-3)


def test_materialx_displaces_by_a_shader_of_its_own(tmp_path):
    """ND_displacement_float: its amount times its scale."""
    shader = """
        token outputs:mtlx:displacement.connect = </A/D.outputs:out>
        def Shader "D" {
            uniform token info:id = "ND_displacement_float"
            float inputs:displacement = 0.2
            float inputs:scale = 0.5
            token outputs:out
        }
        def Shader"""
    text = material(0.0).replace("\n        def Shader", shader, 1)
    scene = load(tmp_path, text + box("catmullClark"), complexity="veryhigh")
    same = load(tmp_path, material(0.1) + box("catmullClark"), complexity="veryhigh")
    assert scene.meshes[0].points == pytest.approx(same.meshes[0].points, abs=1e-9)
    assert not warned(scene, "displacement")
    assert warned(load(tmp_path, text + box("catmullClark")), "displacement is not rendered")
