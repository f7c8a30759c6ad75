"""Every light over a white floor, against its irradiance in closed form or by quadrature."""

import math

import numpy as np
import pytest

import warp_ir as ir
from tests.physics.closed_form import assert_mean, irradiance_at_origin, placed, render, rotation_x
from tests.physics.scenes import DOWN, over_floor
from warp_ir.estimators import ESTIMATORS
from warp_ir.procedural import floor
from warp_ir.scene import LightKind

pytestmark = pytest.mark.extended

STRETCH = np.diag([2.0, 1.0, 0.5])
SHEAR = np.array([[1.0, 0.3, 0.0], [0.0, 1.0, 0.2], [0.1, 0.0, 1.0]])


def light(kind, linear, **dimensions):
    return ir.Light("light", kind, (3.0,) * 3, placed(linear, (0.3, 2.0, 0.1)), **dimensions)


SHAPES = [
    light(LightKind.RECT, DOWN, width=1.5, height=0.8),
    light(LightKind.RECT, DOWN @ SHEAR, width=1.5, height=0.8),
    light(LightKind.RECT, DOWN @ np.diag([-1.0, 1.0, 1.0]), width=1.5, height=0.8),
    light(LightKind.DISK, DOWN, radius=0.7),
    light(LightKind.DISK, DOWN @ STRETCH, radius=0.7),
    light(LightKind.SPHERE, np.eye(3), radius=0.6),
    light(LightKind.SPHERE, rotation_x(30.0) @ STRETCH, radius=0.6),
    light(LightKind.SPHERE, SHEAR @ np.diag([1.0, -1.0, 1.0]), radius=0.6),
    light(LightKind.CYLINDER, np.eye(3), length=2.0, radius=0.3),
    light(LightKind.CYLINDER, SHEAR @ STRETCH, length=1.0, radius=0.4),
]


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: s.kind.name)
def test_shapes_with_an_area(shape, estimator, device):
    """L = E/π under rectangles, ellipses, ellipsoids and elliptic cylinders, scaled, sheared and mirrored."""
    assert_mean(over_floor(shape, estimator, device), irradiance_at_origin(shape) / math.pi, bias=1.0e-4)


def test_quadrature_knows_the_textbook():
    """The quadrature itself gives π L r²/(r²+h²) under a disk and π L r²/d² under a sphere."""
    disk = ir.Light("d", LightKind.DISK, (1.0,) * 3, placed(DOWN, (0.0, 2.0, 0.0)), radius=0.7)
    assert irradiance_at_origin(disk) == pytest.approx(math.pi * 0.49 / (0.49 + 4.0), rel=1e-4)
    sphere = ir.Light("s", LightKind.SPHERE, (1.0,) * 3, placed(np.eye(3), (0.0, 2.0, 0.0)), radius=0.7)
    assert irradiance_at_origin(sphere) == pytest.approx(math.pi * 0.49 / 4.0, rel=1e-4)


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("angle", [0.0, 0.53, 60.0, 180.0])
@pytest.mark.parametrize("tilt", [0.0, 50.0])
def test_distant(estimator, angle, tilt, device):
    """E = π sin²θ cos(tilt) L for a cone of half-angle θ above the horizon; E = cos(tilt) L for parallel light."""
    sun = ir.Light("sun", LightKind.DISTANT, (2.0,) * 3, placed(rotation_x(-90.0 + tilt), (0, 0, 0)), angle=angle)
    if angle + 2 * tilt > 180.0 and angle > 0.0:
        pytest.skip("part of the cone is below the horizon")
    solid = math.pi * math.sin(math.radians(angle / 2.0)) ** 2 if angle > 0.0 else 1.0
    expected = 2.0 * solid * math.cos(math.radians(tilt)) / math.pi
    assert_mean(over_floor(sun, estimator, device), expected, bias=1.0e-4)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_dome(estimator, device):
    """Under an open uniform sky of radiance L a white floor has radiance L."""
    assert_mean(over_floor(ir.Light("sky", LightKind.DOME, (0.7,) * 3), estimator, device), 0.7)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_point(estimator, device):
    """E = I cosθ / d² under a point light."""
    lamp = ir.Light("lamp", LightKind.POINT, (5.0,) * 3, placed(np.eye(3), (1.0, 2.0, 0.0)))
    expected = 5.0 * (2.0 / math.sqrt(5.0)) / 5.0 / math.pi
    assert_mean(over_floor(lamp, estimator, device), expected, bias=1.0e-4)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_lights_emit_from_one_side(estimator, device):
    """A rectangle or disk that faces away from the floor leaves it black."""
    for kind in (LightKind.RECT, LightKind.DISK):
        up = ir.Light("up", kind, (3.0,) * 3, placed(rotation_x(90.0), (0.0, 2.0, 0.0)))
        np.testing.assert_array_equal(over_floor(up, estimator, device).radiance(), 0.0)


@pytest.mark.parametrize("radius, gap", [(1e-6, 1.0), (1e-3, 1e-3), (0.5, 0.1), (100.0, 1.0), (1e5, 1.0)])
def test_path_sees_spheres_of_any_size(radius, gap, device):
    """E = π L r²/d² at a gap d - r below a sphere, for lights of 10⁻⁷ to 10⁴ of the scene's size, near and far.

    The floor's points are raised by up to 8 ulp of its size, 10: a part 2 · 10⁻⁵ / d of E, of d ≥ 2 · 10⁻³. Sampling
    by solid angle leaves a relative variance per sample of at most 1/3, that of a full hemisphere; by area it is 1.7.
    """
    ball = ir.Light("ball", LightKind.SPHERE, (3.0,) * 3, placed(np.eye(3), (0.0, radius + gap, 0.0)), radius=radius)
    film = render(floor(ball, size=20.0), "path", device, max_bounces=0)
    expected = 3.0 * (radius / (radius + gap)) ** 2
    assert_mean(film, expected, bias=4.0e-5 / (radius + gap))
    variance = film.iterations * (film.standard_error().astype(np.float64) ** 2).mean() / expected**2
    assert variance < 1.0 / 3.0


def test_path_inside_a_light(device):
    """A sphere or a cylinder emits outwards: what lies within is black, exactly."""
    for kind, size in ((LightKind.SPHERE, dict(radius=2.0)), (LightKind.CYLINDER, dict(radius=2.0, length=8.0))):
        around = ir.Light("around", kind, (3.0,) * 3, placed(np.eye(3), (0.3, 0.5, 0.0)), **size)
        film = render(floor(around), "path", device, max_bounces=0, iterations=16)
        np.testing.assert_array_equal(film.radiance(), 0.0)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_many_lights_add_up(estimator, device):
    """All the lights together give the sum of what each gives."""
    scene = floor(SHAPES[0])
    scene = type(scene)(scene.meshes, scene.materials, tuple(SHAPES), scene.camera)
    expected = sum(irradiance_at_origin(s) for s in SHAPES) / math.pi
    film = render(scene, estimator, device, max_bounces=0, light_paths=1024)
    assert_mean(film, expected, bias=1.0e-4)


def test_visible_lights_show_their_radiance(device):
    """With visible_lights the camera sees a light's radiance from its emitting side, and nothing of it otherwise."""
    towards = ir.Camera.look_at((0.0, 0.0, 0.0), (0.3, 2.0, 0.1), up=(1.0, 0.0, 0.0), fov=0.5)
    for shape in SHAPES:
        scene = ir.Scene(lights=(shape,), camera=towards)
        seen = ir.render(scene, ir.RenderSettings(width=4, height=4, iterations=1, visible_lights=True), device=device)
        np.testing.assert_allclose(seen.radiance(), 3.0, rtol=1e-6)
        hidden = ir.render(scene, ir.RenderSettings(width=4, height=4, iterations=1), device=device)
        np.testing.assert_array_equal(hidden.radiance(), 0.0)
        np.testing.assert_array_equal(hidden.aov("alpha"), 0.0)
