"""Coarse triangles with smooth normals are lit like the smooth surface they stand for."""

import dataclasses

import numpy as np
import pytest

import warp_ir as ir
from tests.physics import closed_form
from tests.physics.scenes import ball, towards
from warp_ir.estimators import ESTIMATORS
from warp_ir.procedural import cube, mesh, quad
from warp_ir.scene import LightKind
from warp_ir.settings import GuidingSettings

pytestmark = pytest.mark.extended

ALBEDO = 0.8


def smooth_cube(size=2.0):
    """A cube whose eight vertices have the mean normals of their three faces."""
    points, triangles = cube(size)
    unit = points / np.linalg.norm(points, axis=1, keepdims=True)
    return dataclasses.replace(mesh("cube", points, triangles), normals=unit[triangles].astype(np.float32))


def lit_ball(*lights, meshes=(), shape=None):
    camera = ir.Camera.look_at((0, 0, 4), (0, 0, 0), fov=32.0)
    return ir.Scene((shape or ball(), *meshes), (ir.Material("grey", (ALBEDO,) * 3),), lights, camera)


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


def facing(shape, points, lamp):
    """Whether the triangle of a convex mesh that a point lies on faces a lamp; all points must lie on the mesh."""
    corners = shape.points[shape.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    heights = np.einsum("tc,ptc->pt", normals, points[:, None] - corners[:, 0])
    assert heights.max(axis=1) == pytest.approx(0.0, abs=1e-5)
    return ((lamp - points) * normals[heights.argmax(axis=1)]).sum(axis=1) > 0.0


def by_the_law(film, lamp):
    """The points that a picture shows, their radiance, and what it is under a point light of intensity π alone."""
    seen = film.aov("alpha") > 0.0
    points = film.aov("position")[seen].astype(np.float64)
    to_lamp = np.array(lamp) - points
    cosine = (to_lamp * film.aov("normal")[seen]).sum(axis=1) / np.linalg.norm(to_lamp, axis=1)
    return points, film.radiance()[seen][:, 0], ALBEDO * cosine.clip(min=0.0) / (to_lamp**2).sum(axis=1)


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize(
    "shape, lamp, where",
    [
        *((smooth_cube(), (0.0, 0.0, 1.0 + height), "centre") for height in (0.6, 1.0, 2.0, 5.0)),
        (smooth_cube(), (1.6, 0.0, 0.9), "everywhere"),
        *((ball(16, 8), (0.0, 0.1, 1.0 + height), "everywhere") for height in (0.1, 0.3, 1.0)),
    ],
)
def test_light_is_evaluated_on_the_triangles(shape, lamp, where, estimator, device):
    """Every point of a convex mesh has ρ/π I cosθ/d², θ from its shading normal, d from the triangle itself.

    Where the triangle's plane does not face the lamp, the smooth surface does not always clear its neighbours: there
    that is the upper limit. 64 terms of float32 are exact to 1e-5.
    """
    light = ir.Light("lamp", LightKind.POINT, (np.pi,) * 3, closed_form.placed(np.eye(3), lamp))
    view = (0.1, 0.1, 6.0) if where == "centre" else (2.0, 1.0, 5.0)
    camera = ir.Camera.look_at(view, (0, 0, 0), fov=8.0 if where == "centre" else 40.0)
    scene = ir.Scene((shape,), (ir.Material("grey", (ALBEDO,) * 3),), (light,), camera)
    film = closed_form.render(
        scene,
        estimator,
        device,
        GuidingSettings(visibility=False),  # which is learned by chance, and makes some noise where all is visible
        width=32,
        height=32,
        iterations=1,
        light_paths=64,
        max_bounces=0,
    )
    points, found, expected = by_the_law(film, lamp)
    exact = facing(shape, points, np.array(lamp))
    assert (expected > 0.0).mean() > 0.1 and exact.mean() > 0.05
    assert found[exact] == pytest.approx(expected[exact], abs=1e-5 * expected.max())
    assert (found < expected + 1e-5 * expected.max()).all()


def tilted_card(tilt):
    """A flat card in the plane z = 0 whose normals are all tilted alike, towards +y."""
    normal = np.array([0.0, np.sin(np.radians(tilt)), np.cos(np.radians(tilt))])
    card = quad("card", [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    return normal, dataclasses.replace(card, normals=np.broadcast_to(normal, (2, 3, 3)).astype(np.float32))


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("tilt", [5.0, 36.87])
def test_a_flat_card_whose_normals_are_all_tilted(tilt, estimator, device):
    """Normals that do not bend imply no surface above the card: every point of it has ρ/π I cosθ/d²."""
    _, card = tilted_card(tilt)
    lamp = (0.2, 0.1, 1.0)
    light = ir.Light("lamp", LightKind.POINT, (np.pi,) * 3, closed_form.placed(np.eye(3), lamp))
    camera = ir.Camera.look_at((0, 0, 5), (0, 0, 0), fov=20.0)
    scene = ir.Scene((card,), (ir.Material("grey", (ALBEDO,) * 3),), (light,), camera)
    film = closed_form.render(scene, estimator, device, iterations=1, light_paths=64)
    points, found, expected = by_the_law(film, lamp)
    assert points[:, 2] == pytest.approx(0.0, abs=1e-5)
    assert found == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_flat_card_does_not_light_itself(estimator, device):
    """However tilted its normals are, a card under a sun has ρ E cosθ/π at every pixel, and nothing more."""
    normal, card = tilted_card(30.0)
    sun = ir.Light("sun", LightKind.DISTANT, (np.pi,) * 3, towards((0.0, -0.2, 1.0)), angle=0.0)
    camera = ir.Camera.look_at((0, 0, 5), (0, 0, 0), fov=20.0)
    scene = ir.Scene((card,), (ir.Material("white", (1.0,) * 3),), (sun,), camera)
    film = closed_form.render(scene, estimator, device, iterations=4, light_paths=256)
    expected = float(normal @ [0.0, -0.2, 1.0]) / np.hypot(0.2, 1.0)
    assert film.radiance() == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("shape", [ball(), smooth_cube(1.4)], ids=["ball", "cube"])
@pytest.mark.parametrize("estimator", [name for name in ESTIMATORS if name != "path"])
def test_estimators_agree_on_smooth_shapes(shape, estimator, device):
    """On a floor, under a lamp, a smooth ball or cube has the same mean radiance by every estimator."""
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
        closed_form.render(lit_ball(lamp, meshes=(floor,), shape=shape), name, device, width=16, height=16)
        for name in (estimator, "path")
    ]
    means = [float(film.radiance().mean()) for film in films]
    assert abs(means[0] - means[1]) < 5.0 * np.hypot(*(float(film.standard_error().mean()) for film in films))
    assert means[1] > 0.05
