"""Coarse triangles with smooth normals are lit like the smooth surface they stand for."""

import numpy as np
import pytest

import warp_ir as ir
from tests.physics import closed_form
from tests.physics.scenes import ball, towards
from warp_ir.estimators import ESTIMATORS
from warp_ir.scene import LightKind

pytestmark = pytest.mark.extended

ALBEDO = 0.8


def lit_ball(*lights, meshes=()):
    camera = ir.Camera.look_at((0, 0, 4), (0, 0, 0), fov=32.0)
    return ir.Scene((ball(), *meshes), (ir.Material("grey", (ALBEDO,) * 3),), lights, camera)


SUN = np.array([1.0, 0.3, 0.1]) / np.linalg.norm([1.0, 0.3, 0.1])


def test_the_terminator_is_where_the_normals_put_it(device):
    """Under a sun every pixel is ρ/π E max(0, n·ω), on triangles that face away from it as well."""
    sun = ir.Light("sun", LightKind.DISTANT, (np.pi,) * 3, towards(SUN), angle=0.0)
    film = closed_form.render(lit_ball(sun), "path", device, width=48, height=48, iterations=1, max_bounces=0)
    seen = film.aov("alpha") > 0.0
    cosine = (film.aov("normal")[seen] @ SUN).clip(min=0.0)
    found = film.radiance()[seen][:, 0] / ALBEDO
    assert found == pytest.approx(cosine, abs=1e-5)
    assert 0.5 < (cosine > 0.0).mean() < 0.7


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_smooth_ball_in_a_white_dome_reflects_its_albedo(estimator, device):
    """A convex surface under a uniform sky of radiance 1 has radiance ρ; its facets take nothing away."""
    dome = ir.Light("dome", LightKind.DOME, (1.0,) * 3)
    scene = lit_ball(dome)
    inside = ir.Camera.look_at((0, 0, 4), (0, 0, 0), fov=18.0)
    film = closed_form.render(ir.Scene(scene.meshes, scene.materials, scene.lights, inside), estimator, device)
    assert (film.aov("alpha") == 1.0).all()
    closed_form.assert_mean(film, ALBEDO)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_no_light_comes_through_a_wall_that_touches_the_ball(estimator, device):
    """A wall without thickness, tangent to the smooth ball and clear of its triangles, keeps its far side dark."""
    front = 0.98  # the triangles in front reach to cos 15° = 0.966, the smooth ball to 1
    wall = ir.Mesh(
        "wall",
        np.array([(-3, -3, front), (3, -3, front), (3, 3, front), (-3, 3, front)], dtype=float),
        np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32),
        np.zeros(2, dtype=np.int32),
    )
    sun = ir.Light("sun", LightKind.DISTANT, (np.pi,) * 3, towards((0.2, 0.2, 1.0)), angle=0.0)
    scene = lit_ball(sun, meshes=(wall,))
    close = ir.Camera.look_at((0, 0, 4), (0, 0, 0), fov=7.0)
    close = ir.Camera(close.name, close.world_from_camera, close.window, clipping=(4.0 - front + 1e-3, 10.0))
    scene = ir.Scene(scene.meshes, scene.materials, scene.lights, close)
    film = closed_form.render(scene, estimator, device, width=32, height=32, iterations=4)
    assert (film.aov("prim_id") == film.aov("prim_id")[16, 16]).all()
    assert film.radiance().max() == 0.0


@pytest.mark.parametrize("estimator", [name for name in ESTIMATORS if name != "path"])
def test_estimators_agree_on_smooth_balls(estimator, device):
    """On a floor, under a lamp, a smooth ball has the same mean radiance by every estimator."""
    floor = ir.Mesh(
        "floor",
        np.array([(-3, -1, -3), (-3, -1, 3), (3, -1, 3), (3, -1, -3)], dtype=float),
        np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32),
        np.zeros(2, dtype=np.int32),
    )
    matrix = towards((1.0, 1.0, 0.5))
    matrix[:3, 3] = 3.0 * matrix[:3, 2]
    lamp = ir.Light("lamp", LightKind.RECT, (8.0,) * 3, matrix, 1.0, 1.0)
    films = [
        closed_form.render(lit_ball(lamp, meshes=(floor,)), name, device, width=16, height=16)
        for name in (estimator, "path")
    ]
    means = [float(film.radiance().mean()) for film in films]
    assert abs(means[0] - means[1]) < 5.0 * np.hypot(*(float(film.standard_error().mean()) for film in films))
    assert means[1] > 0.05
