"""Emissive surfaces as lights: shaping, links and missing shadows, beside their analytic twins and closed forms."""

import dataclasses
import math

import numpy as np
import pytest

import warp_ir as ir
from tests.physics.closed_form import (
    assert_mean,
    factor,
    irradiance_at_origin,
    placed,
    render,
    rotation_x,
)
from tests.physics.scenes import (
    BLACK_GLOW,
    DOWN,
    LAMP,
    SHAPINGS,
    TILTED,
    ball_over_floor,
    lamp_profile,
    panel,
    pixels,
    shadow_of_ball,
    with_panel,
)
from warp_ir.device.launcher import Launcher
from warp_ir.device_scene import upload_scene
from warp_ir.estimators import ESTIMATORS
from warp_ir.procedural import cube, floor, mesh, sphere
from warp_ir.scene import LightKind, Shaping

pytestmark = pytest.mark.extended


def over_floor(light, estimator, device, **settings):
    return render(
        with_panel(floor(LAMP), light), estimator, device, **(dict(max_bounces=0, light_paths=1024) | settings)
    )


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("shaping", SHAPINGS[:3])
@pytest.mark.parametrize("linear", [DOWN, TILTED @ np.diag([1.5, 1.0, 0.5])], ids=["facing", "tilted"])
def test_shaped_panels(linear, shaping, estimator, device):
    """E = ∫ L f cosθ cosθ' / d² dA under two triangles, as under the RECT light in their place."""
    lamp = ir.Light(
        "lamp", LightKind.RECT, (3.0,) * 3, placed(linear, (0.3, 2.0, 0.4)), width=1.5, height=0.8, shaping=shaping
    )
    axis = -linear[:, 2] / np.linalg.norm(linear[:, 2])
    expected = irradiance_at_origin(lamp, factor=lambda u, v, direction: factor(shaping, direction @ axis))
    assert expected > 0.0
    assert_mean(over_floor(lamp, estimator, device), expected / math.pi, bias=2.0e-4)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_the_axis_need_not_be_the_normal(estimator, device):
    """A panel that faces down, its light aimed 30° aside: E = ∫ L f cosθ cosθ' / d² dA with f about that axis."""
    shaping = Shaping(cone_angle=50.0, cone_softness=0.6, focus=2.0)
    lamp = ir.Light("lamp", LightKind.RECT, (3.0,) * 3, placed(DOWN, (0.3, 2.0, 0.4)), width=1.5, height=0.8)
    aside = rotation_x(-60.0)
    expected = irradiance_at_origin(lamp, factor=lambda u, v, d: factor(shaping, d @ -aside[:, 2]))
    scene = with_panel(floor(LAMP), lamp)
    control = ir.MeshLight("lamp", placed(aside, (0, 0, 0)), shaping)
    scene = dataclasses.replace(
        scene, meshes=(*scene.meshes[:-1], dataclasses.replace(scene.meshes[-1], light=control))
    )
    film = render(scene, estimator, device, max_bounces=0, light_paths=1024)
    assert_mean(film, expected / math.pi, bias=2.0e-4)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_profiles_of_panels(estimator, device):
    """A small panel is a point of intensity L A cosθ f(θ, φ): E/π as for a point light, to the (0.05/2)² of its size.

    A profile is taken as it is, in candela: 100 and more, not relative to its maximum.
    """
    side = 0.05
    lamp = ir.Light(
        "lamp",
        LightKind.RECT,
        (3.0,) * 3,
        placed(DOWN, (0.0, 2.0, 1.0)),
        width=side,
        height=side,
        shaping=Shaping(profile=lamp_profile()),
    )
    cosine = 2.0 / math.sqrt(5.0)
    intensity = 3.0 * side**2 * cosine * 100.0 * (1.0 + (2.0 * cosine**2 - 1.0))
    assert_mean(over_floor(lamp, estimator, device), intensity * cosine / 5.0 / math.pi, bias=1.0e-3)


def test_what_lies_outside_a_cone_is_black():
    """Beyond the cone's angle nothing arrives, exactly; nor does the eye see the panel from there."""
    lamp = ir.Light(
        "l", LightKind.RECT, (5.0,) * 3, placed(DOWN, (2, 2, 0)), width=0.1, height=0.1, shaping=Shaping(cone_angle=30)
    )
    for estimator in ESTIMATORS:
        np.testing.assert_array_equal(over_floor(lamp, estimator, "cpu").radiance(), 0.0)


def test_the_eye_sees_the_shaping():
    """Seen at an angle of 30° to the axis, a panel of radiance 3 has 3 cos³30°."""
    lamp = ir.Light("l", LightKind.RECT, (3.0,) * 3, np.eye(4), width=9.0, height=9.0, shaping=Shaping(focus=3.0))
    eye = 4.0 * np.array([0.0, math.sin(math.radians(30.0)), -math.cos(math.radians(30.0))])
    scene = with_panel(ir.Scene(camera=ir.Camera.look_at(eye, (0, 0, 0), fov=0.01)), lamp)
    film = ir.render(scene, ir.RenderSettings(width=2, height=2, iterations=1))
    np.testing.assert_allclose(film.radiance(), 3.0 * math.cos(math.radians(30.0)) ** 3, rtol=1e-3)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_panel_may_be_dark_all_around(estimator):
    """In a cone of 0° there is nothing: the picture is that of the other light, although rays hit the panel."""
    bulb = ir.Light("bulb", LightKind.POINT, (2.0,) * 3, placed(DOWN, (0.5, 1.0, 0.0)))
    dark = ir.Light(
        "dark", LightKind.RECT, (3.0,) * 3, placed(DOWN, (0, 2, 0)), width=2, height=2, shaping=Shaping(cone_angle=0.0)
    )
    scene = dataclasses.replace(with_panel(floor(bulb), dark), lights=(bulb,))
    uploaded = upload_scene(scene, Launcher("cpu"))
    assert uploaded.data.emitter_count == 1 and uploaded.data.triangle_emitter.shape[0] == scene.triangle_count
    film = render(scene, estimator, max_bounces=0, light_paths=64)
    assert_mean(film, 2.0 / 1.25**1.5 / math.pi, bias=1.0e-3)


@pytest.mark.parametrize("angle", [5.0, 40.0])
@pytest.mark.parametrize("ball", [False, True])
def test_photons_carry_the_power_of_the_cone(angle, ball):
    """Φ = π L A sin²θ of a panel and L π A (1 - cosθ)/2 of a ball, to 0.3 %; and hardly a photon is wasted."""
    c = math.radians(angle)
    at = placed(TILTED, (0.0, 0.5, 0.0))
    points, triangles = cube(4.0, inward=True)
    walls = mesh("walls", points, triangles)
    if ball:
        points, triangles = sphere(0.3, level=3)
        lamp = mesh("lamp", points + at[:3, 3], triangles, material=1)
        lamp = dataclasses.replace(lamp, light=ir.MeshLight("lamp", at, Shaping(cone_angle=angle)))
        a, b, d = (lamp.points[lamp.triangles[:, k]] for k in range(3))
        area = 0.5 * np.linalg.norm(np.cross(b - a, d - a), axis=1).sum()
        power = math.pi * 3.0 * area * (1.0 - math.cos(c)) / 2.0
    else:
        twin = ir.Light("lamp", LightKind.RECT, (3.0,) * 3, at, width=0.5, height=0.4)
        lamp = panel(twin, 1, shaping=Shaping(cone_angle=angle))
        power = math.pi * 3.0 * 0.2 * math.sin(c) ** 2
    scene = ir.Scene((walls, lamp), (ir.Material("wall", (0.999,) * 3), BLACK_GLOW))
    paths = 65536
    vpls = ir.trace_vpls(scene, ir.RenderSettings(light_paths=paths, max_bounces=1, absorption="roulette"))
    reflected = vpls.bounce == 1
    flux = vpls.intensity[reflected, 0].astype(np.float64).sum() * math.pi / 0.999
    # The ball's triangles are chosen by their power, so of the half that faces back hardly any.
    assert flux == pytest.approx(power, rel=3e-3) and reflected.sum() / paths > (0.8 if ball else 0.99)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_links_say_what_a_panel_lights(estimator):
    """An unlinked mesh has no direct light, exactly; and the linked one no light by way of it."""
    for unlit in (0, 1):
        scene = with_panel(ball_over_floor(LAMP), dataclasses.replace(LAMP, unlit=frozenset({unlit})))
        film = render(scene, estimator, width=32, height=32, iterations=1, max_bounces=1)
        mesh_seen = film.aov("prim_id")
        direct = film.aov("direct")
        assert (direct[mesh_seen == unlit] == 0.0).all() and direct[mesh_seen == 1 - unlit].mean() > 0.01
        assert (film.aov("indirect")[mesh_seen == 1 - unlit] == 0.0).all()


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_light_of_panels_passes_through_shadowless_meshes(estimator):
    """The floor has the direct light it would have without the ball; with shadows off at all, so it has."""
    common = dict(width=32, height=32, max_bounces=0, light_paths=1024)
    free = ball_over_floor(LAMP)
    free = render(with_panel(dataclasses.replace(free, meshes=free.meshes[:1]), LAMP), estimator, **common)
    shadowed = render(with_panel(ball_over_floor(LAMP), LAMP), estimator, **common)
    under = shadow_of_ball(shadowed, free)
    for change in (dict(shadowless=frozenset({1})), dict(shadows=False)):
        scene = with_panel(ball_over_floor(LAMP), dataclasses.replace(LAMP, **change))
        film = render(scene, estimator, **common)
        mean, error = pixels(film, under)
        expected, expected_error = pixels(free, under)
        assert abs(mean - expected) <= 5.0 * math.hypot(error, expected_error)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_glow_is_for_the_eye_alone(estimator):
    """A panel that the camera sees as (0.5, 0, 0) lights the floor by its emission of 3 all the same."""
    lamp = ir.Light("lamp", LightKind.RECT, (3.0,) * 3, placed(DOWN, (0.3, 2.0, 0.4)), width=1.5, height=0.8)
    material = dataclasses.replace(BLACK_GLOW, glow=(0.5, 0.0, 0.0))
    scene = with_panel(floor(LAMP), lamp, material=material)
    film = render(scene, estimator, max_bounces=0, light_paths=1024)
    assert_mean(film, irradiance_at_origin(lamp) / math.pi, bias=1e-4)
    up = dataclasses.replace(scene, camera=ir.Camera.look_at((0.3, 0.5, 0.4), (0.3, 2.0, 0.4), (0, 0, 1), fov=1.0))
    np.testing.assert_allclose(render(up, estimator, max_bounces=0, iterations=1).radiance()[..., 0], 0.5, rtol=1e-6)
    np.testing.assert_array_equal(render(up, estimator, max_bounces=0, iterations=1).radiance()[..., 1:], 0.0)


@pytest.mark.parametrize("estimator", ["vpl", "path"])
@pytest.mark.parametrize("shadows", [True, False])
def test_panels_close_by(shadows, estimator):
    """L F under the middle of a square 25 times as wide as it is high above: what the bound on G takes is given back.

    It takes most of the light here. The camera looks from between the floor and the panel.
    """
    height = 0.02
    lamp = ir.Light(
        "l", LightKind.RECT, (3.0,) * 3, placed(DOWN, (0, height, 0)), width=1.0, height=1.0, shadows=shadows
    )
    scene = with_panel(floor(lamp), lamp)
    scene = dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, clipping=(1.0 - 0.5 * height, 2.0)))
    x = (0.5 / height) / math.hypot(1.0, 0.5 / height)
    film = render(scene, estimator, max_bounces=0, light_paths=1024)
    assert_mean(film, 3.0 * 4.0 / math.pi * x * math.atan(x), bias=1.0e-3)


@pytest.mark.parametrize("change", [dict(shaping=Shaping(cone_angle=30.0)), dict(unlit=frozenset({9})), {}])
def test_unusable_mesh_lights_are_refused(change):
    """A shaped prototype has as many axes as places; links name meshes that exist."""
    scene = with_panel(floor(LAMP), LAMP)
    if "unlit" in change:
        scene = with_panel(floor(LAMP), dataclasses.replace(LAMP, **change))
    elif change:
        scene = with_panel(floor(LAMP), dataclasses.replace(LAMP, **change))
        scene = dataclasses.replace(scene, instances=(ir.Instances("i", (1,), np.eye(4)[None]),))
    else:
        bad = dataclasses.replace(scene.meshes[-1].light, world_from_light=np.full((4, 4), np.nan))
        scene = dataclasses.replace(
            scene, meshes=(*scene.meshes[:-1], dataclasses.replace(scene.meshes[-1], light=bad))
        )
    with pytest.raises(ir.InputError):
        ir.render(scene, ir.RenderSettings(width=2, height=2, iterations=1))
