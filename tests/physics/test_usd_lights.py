"""From the file to the picture: every light of UsdLux under an uneven scale, normalized or not, over a white floor."""

import dataclasses
import functools
import math

import numpy as np
import pytest

import warp_ir as ir
from tests import stages
from tests.physics.closed_form import assert_mean, irradiance_at_origin, placed, render, rotation_x
from warp_ir.procedural import floor
from warp_ir.scene import LightKind

pytestmark = pytest.mark.extended

SCALE = (1.6, 0.7, 0.5)
AT = (0.3, 2.0, 0.1)
INTENSITY, EXPOSURE = 3.0, 1.0
MATRIX = placed(rotation_x(-70.0) @ np.diag(SCALE), AT)
PLACE = f"""
    double3 xformOp:translate = {AT}
    float xformOp:rotateX = -70
    float3 xformOp:scale = {SCALE}
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX", "xformOp:scale"]
    float inputs:intensity = {INTENSITY}
    float inputs:exposure = {EXPOSURE}
"""
RADIANCE = INTENSITY * 2.0**EXPOSURE
X, Y, Z = SCALE


def perimeter(a, b):
    """Of an ellipse (Ramanujan)."""
    return math.pi * (3.0 * (a + b) - math.sqrt((3.0 * a + b) * (a + 3.0 * b)))


def ellipsoid(a, b, c):
    """Area of an ellipsoid (Thomsen)."""
    return 4.0 * math.pi * ((((a * b) ** 1.6 + (a * c) ** 1.6 + (b * c) ** 1.6) / 3.0) ** (1.0 / 1.6))


SHAPES = {
    "RectLight": (LightKind.RECT, dict(width=1.5, height=0.8), 1.5 * X * 0.8 * Y),
    "DiskLight": (LightKind.DISK, dict(radius=0.6), math.pi * 0.36 * X * Y),
    "SphereLight": (LightKind.SPHERE, dict(radius=0.6), ellipsoid(0.6 * X, 0.6 * Y, 0.6 * Z)),
    "CylinderLight": (LightKind.CYLINDER, dict(length=1.2, radius=0.4), 1.2 * X * perimeter(0.4 * Y, 0.4 * Z)),
}


load = functools.partial(stages.load, default_light="none")


def picture(scene, estimator, device):
    """The white floor under the lights, and the surfaces, of a loaded scene."""
    plain = floor(ir.Light("none", LightKind.POINT, (0.0,) * 3))
    moved = tuple(dataclasses.replace(mesh, material=mesh.material + 1) for mesh in scene.meshes)
    whole = dataclasses.replace(
        plain, meshes=(*plain.meshes, *moved), materials=(*plain.materials, *scene.materials), lights=scene.lights
    )
    return render(whole, estimator, device, max_bounces=0, light_paths=1024)


@pytest.mark.parametrize("estimator", ["vpl", "path"])
@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("kind", SHAPES)
def test_scaled_lights_with_an_area(tmp_path, kind, normalize, estimator, device):
    """E = ∫ L cosθ cosθ' / d² dA, with L = intensity · 2^exposure, over the area in the world if normalized."""
    code, size, area = SHAPES[kind]
    sizes = "".join(f"    float inputs:{name} = {value}\n" for name, value in size.items())
    switch = f"    bool inputs:normalize = {str(normalize).lower()}\n"
    scene = load(tmp_path, f'def {kind} "L" {{{PLACE}{sizes}{switch}}}\n')
    radiance = RADIANCE / (area if normalize else 1.0)
    expected = irradiance_at_origin(ir.Light("twin", code, (radiance,) * 3, MATRIX, **size)) / math.pi
    assert expected > 0.0
    assert_mean(picture(scene, estimator, device), expected, bias=2.0e-4)


@pytest.mark.parametrize("estimator", ["vpl", "path", "keller"])
@pytest.mark.parametrize("normalize", [False, True])
def test_a_scaled_mesh_light_is_the_rectangle_in_its_place(tmp_path, normalize, estimator, device):
    """MeshLightAPI on two triangles, wound to face along -Z: the irradiance of a RectLight, and its normalization."""
    x, y = 0.75, 0.4
    points = [(-x, -y, 0.0), (-x, y, 0.0), (x, y, 0.0), (x, -y, 0.0)]
    text = f"""def Mesh "L" (prepend apiSchemas = ["MeshLightAPI"]) {{{PLACE}
    point3f[] points = {points}
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    uniform token subdivisionScheme = "none"
    bool inputs:normalize = {str(normalize).lower()}
}}
"""
    radiance = RADIANCE / (2 * x * X * 2 * y * Y if normalize else 1.0)
    twin = ir.Light("twin", LightKind.RECT, (radiance,) * 3, MATRIX, width=2 * x, height=2 * y)
    film = picture(load(tmp_path, text), estimator, device)
    assert_mean(film, irradiance_at_origin(twin) / math.pi, bias=2.0e-4)


@pytest.mark.parametrize("estimator", ["vpl", "path"])
@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("angle", [0.0, 0.53, 40.0])
def test_a_scale_does_nothing_to_a_sun(tmp_path, angle, normalize, estimator, device):
    """E = L π sin²(angle/2) cos 20°; normalized, and for parallel light, intensity · 2^exposure is in lux."""
    more = f"    float inputs:angle = {angle}\n    bool inputs:normalize = {str(normalize).lower()}\n"
    scene = load(tmp_path, f'def DistantLight "L" {{{PLACE}{more}}}\n')
    cone = 1.0 if normalize or angle == 0.0 else math.pi * math.sin(math.radians(0.5 * angle)) ** 2
    expected = RADIANCE * cone * math.cos(math.radians(20.0)) / math.pi
    assert_mean(picture(scene, estimator, device), expected, bias=1.0e-4)


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("kind", ["DomeLight", "DomeLight_1"])
def test_a_scale_and_normalize_do_nothing_to_a_sky(tmp_path, kind, normalize, device):
    """E = π L."""
    scene = load(tmp_path, f'def {kind} "L" {{{PLACE}    bool inputs:normalize = {str(normalize).lower()}\n}}\n')
    assert_mean(picture(scene, "vpl", device), RADIANCE)


@pytest.mark.parametrize("normalize", [False, True])
def test_a_scaled_point(tmp_path, normalize, device):
    """treatAsPoint: I = L A / 4 in every direction, A the area of the ellipsoid; normalized, L / 4."""
    switch = f"bool inputs:normalize = {str(normalize).lower()}"
    more = f"    float inputs:radius = 0.6\n    bool treatAsPoint = true\n    {switch}\n"
    scene = load(tmp_path, f'def SphereLight "L" {{{PLACE}{more}}}\n')
    intensity = RADIANCE / 4.0 * (1.0 if normalize else ellipsoid(0.6 * X, 0.6 * Y, 0.6 * Z))
    d = math.sqrt(sum(c * c for c in AT))
    assert_mean(picture(scene, "vpl", device), intensity * AT[1] / d**3 / math.pi, bias=1.0e-4)
