"""Shaping, textures, links and missing shadows of lights, against closed forms, quadrature and each other."""

import dataclasses
import math

import numpy as np
import pytest

import warp_ir as ir
from tests.physics.closed_form import (
    assert_mean,
    bilinear,
    factor,
    irradiance_at_origin,
    placed,
    render,
    rotation_x,
)
from tests.physics.scenes import (
    DOWN,
    LAMP,
    SHAPINGS,
    SQUEEZED,
    TILTED,
    ball_over_floor,
    lamp_profile,
    over_floor,
    pixels,
    shadow_of_ball,
    sky_texture,
)
from warp_ir.estimators import ESTIMATORS
from warp_ir.procedural import cube, mesh
from warp_ir.scene import LightKind, Shaping

pytestmark = pytest.mark.extended


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("shaping", SHAPINGS)
def test_shaped_points(shaping, estimator, device):
    """E = I f(θ) cosθ' / d² under a point light that is aimed down and stands aside."""
    lamp = ir.Light("lamp", LightKind.POINT, (5.0,) * 3, placed(DOWN, (1.0, 2.0, 0.0)), shaping=shaping)
    cosine = 2.0 / math.sqrt(5.0)
    expected = 5.0 * float(factor(shaping, cosine)) * cosine / 5.0 / math.pi
    assert_mean(over_floor(lamp, estimator, device), expected, bias=1.0e-4)


SHAPES = [
    (LightKind.RECT, TILTED, dict(width=1.5, height=0.8)),
    (LightKind.DISK, DOWN @ SQUEEZED, dict(radius=0.7)),
    (LightKind.SPHERE, TILTED @ SQUEEZED, dict(radius=0.6)),
    (LightKind.CYLINDER, TILTED @ SQUEEZED, dict(length=2.0, radius=0.3)),
]


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("shaping", SHAPINGS[:3])
@pytest.mark.parametrize("kind, linear, size", SHAPES, ids=lambda x: getattr(x, "name", ""))
def test_shaped_areas(kind, linear, size, shaping, estimator, device):
    """E = ∫ L f cosθ cosθ' / d² dA under shaped, scaled and tilted lights."""
    lamp = ir.Light("lamp", kind, (3.0,) * 3, placed(linear, (0.3, 2.0, 0.4)), shaping=shaping, **size)
    axis = -linear[:, 2] / np.linalg.norm(linear[:, 2])
    expected = irradiance_at_origin(lamp, factor=lambda u, v, direction: factor(shaping, direction @ axis))
    assert expected > 0.0
    assert_mean(over_floor(lamp, estimator, device), expected / math.pi, bias=2.0e-4)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_shaped_suns_and_skies(estimator, device):
    """A dome with a cone of 60° from its axis, which points down, lights the floor with E = π L sin²60°."""
    sky = ir.Light("sky", LightKind.DOME, (2.0,) * 3, placed(DOWN, (0, 0, 0)), shaping=Shaping(cone_angle=60.0))
    assert_mean(over_floor(sky, estimator, device, light_paths=4096), 2.0 * 0.75, bias=1.0e-4)
    sun = ir.Light("sun", LightKind.DISTANT, (2.0,) * 3, placed(DOWN, (0, 0, 0)), angle=90.0, shaping=Shaping(focus=2))
    expected = 2.0 * 2.0 * math.pi * (1.0 - math.cos(math.radians(45.0)) ** 4) / 4.0 / math.pi
    assert_mean(over_floor(sun, estimator, device), expected, bias=1.0e-4)


def test_what_lies_outside_a_cone_is_black():
    """Beyond the cone's angle nothing arrives, exactly."""
    lamp = ir.Light(
        "lamp", LightKind.SPHERE, (5.0,) * 3, placed(DOWN, (2.0, 2.0, 0.0)), radius=0.1, shaping=Shaping(cone_angle=30)
    )
    for estimator in ESTIMATORS:
        np.testing.assert_array_equal(over_floor(lamp, estimator, "cpu").radiance(), 0.0)


def room(*lights, albedo=0.5, extra=()):
    """A closed cube of side 4 around the origin."""
    points, triangles = cube(4.0, inward=True)
    return ir.Scene(
        meshes=(mesh("room", points, triangles), *extra),
        materials=(ir.Material("wall", (albedo,) * 3),),
        lights=lights,
        camera=ir.Camera.look_at((0.1, 0.2, 1.9), (0.0, 0.0, 0.0), fov=70.0),
    )


def flux_after_one_bounce(light, paths=65536):
    """Flux that the walls receive from the light's photons; and the part of the paths that carry any."""
    settings = ir.RenderSettings(light_paths=paths, max_bounces=1, absorption="roulette")
    vpls = ir.trace_vpls(room(light, albedo=0.999), settings)
    reflected = vpls.bounce == 1
    return vpls.intensity[reflected, 0].astype(np.float64).sum() * math.pi / 0.999, reflected.sum() / paths


@pytest.mark.parametrize("angle", [5.0, 40.0, 90.0])
def test_photons_carry_the_power_of_the_cone(angle):
    """Φ = π L A sin²θ for flat lights, L π A (1 - cosθ)/2 for a sphere, 2π I (1 - cosθ) for a point; to 0.2 %.

    Directions are drawn in proportion to the shaping: a cone of 5° costs no photon, and on a sphere only the half that
    stands on its back.
    """
    c = math.radians(angle)
    shaping = Shaping(cone_angle=angle)
    at = placed(TILTED, (0.0, 0.5, 0.0))
    area = 4.0 * math.pi * 0.09
    for kind, size, power, used in [
        (LightKind.RECT, dict(width=0.5, height=0.4), math.pi * 0.2 * math.sin(c) ** 2, 0.99),
        (LightKind.DISK, dict(radius=0.3), math.pi**2 * 0.09 * math.sin(c) ** 2, 0.99),
        (LightKind.POINT, {}, 2.0 * math.pi * (1.0 - math.cos(c)), 0.99),
        (LightKind.SPHERE, dict(radius=0.3), math.pi * area * (1.0 - math.cos(c)) / 2.0, 0.49),
    ]:
        flux, part = flux_after_one_bounce(ir.Light("l", kind, (1.0,) * 3, at, shaping=shaping, **size))
        assert flux == pytest.approx(power, rel=2e-3) and part > used, kind


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("position, around", [((0, 2, 1), 1.0), ((0, 2, -1), 0.25), ((1, 2, 0), 0.625)])
def test_profiles_of_lamps(position, around, estimator, device):
    """E = I f(θ, φ) cosθ' / d² with f from the table: φ counts from the light's +X towards its +Y.

    The light's +Y being the world's -Z, the origin is seen from the three places at φ = 90°, 270° and 180°, where two
    sectors meet. Linear interpolation between rows of 1° is good to (π/180)²/8 · 400/160 = 1e-4.
    """
    shaping = Shaping(profile=lamp_profile())
    lamp = ir.Light("lamp", LightKind.POINT, (0.05,) * 3, placed(DOWN, position), shaping=shaping)
    cosine = 2.0 / math.sqrt(5.0)
    expected = 0.05 * 100.0 * (1.0 + (2.0 * cosine**2 - 1.0)) * around * cosine / 5.0 / math.pi
    assert_mean(over_floor(lamp, estimator, device), expected, bias=2.0e-4)


def test_photons_follow_a_profile():
    """Φ = I ∫ f dω = I · 5/8 · 2π · 200 ∫ cos²θ sinθ dθ, from 0 to 120°; a sphere has I = L π r². To 0.3 %."""
    power = 0.625 * 2.0 * math.pi * 200.0 * (1.0 + 0.125) / 3.0
    shaping = Shaping(profile=lamp_profile())
    at = placed(TILTED, (0.0, 0.5, 0.0))
    flux, part = flux_after_one_bounce(ir.Light("l", LightKind.POINT, (1.0,) * 3, at, shaping=shaping))
    assert flux == pytest.approx(power, rel=3e-3) and part > 0.99
    ball = ir.Light("l", LightKind.SPHERE, (1.0,) * 3, at, radius=0.3, shaping=shaping)
    assert flux_after_one_bounce(ball)[0] == pytest.approx(power * math.pi * 0.09, rel=3e-3)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_textured_rectangles(estimator, device):
    """E = ∫ L T cosθ cosθ' / d² dA with row 0 of the texture at +Y, and column 0 at +X."""
    texture = np.array([[4.0, 0.0, 1.0], [0.5, 0.0, 0.0]])
    lamp = ir.Light("lamp", LightKind.RECT, (3.0,) * 3, placed(TILTED, (0.3, 1.0, 0.4)), width=1.5, height=0.8)

    def towards(u, v, direction):
        return bilinear(texture, 1.0 - u, 1.0 - v)

    expected = irradiance_at_origin(lamp, factor=towards) / math.pi
    lamp = dataclasses.replace(lamp, texture=np.repeat(texture[:, :, None], 3, axis=2).astype(np.float32))
    assert_mean(over_floor(lamp, estimator, device), expected, bias=1.0e-4)


def sky_irradiance(texture, matrix, n=1500):
    """∫ L cosθ dω over the upper hemisphere, by the midpoint rule; u = 1/2 - atan2(x, z)/2π, v = acos(y)/π."""
    theta = (np.arange(n) + 0.5) / n * 0.5 * np.pi
    phi = (np.arange(2 * n) + 0.5) / (2 * n) * 2.0 * np.pi
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    up = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], axis=-1)
    d = up @ matrix[:3, :3]  # in the dome's own frame
    u = (0.5 - np.arctan2(d[..., 0], d[..., 2]) / (2.0 * np.pi)) % 1.0
    v = np.arccos(np.clip(d[..., 1], -1.0, 1.0)) / np.pi
    light = bilinear(texture, u, v, around=True)
    return float((light * np.cos(theta) * np.sin(theta)).sum() * (0.5 * np.pi / n) * (2.0 * np.pi / (2 * n)))


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_textured_skies(estimator, device):
    """E = ∫ L(ω) cosθ dω under a lat-long sky that is turned about all axes."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_x(25.0) @ np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [-0.8, 0.0, 0.6]])
    texture = sky_texture()
    sky = ir.Light(
        "sky", LightKind.DOME, (0.5,) * 3, matrix, texture=np.repeat(texture[:, :, None], 3, axis=2).astype(np.float32)
    )
    expected = 0.5 * sky_irradiance(texture, matrix) / math.pi
    film = over_floor(sky, estimator, device, light_paths=4096)
    assert_mean(film, expected, bias=3.0e-4)
    assert film.standard_error().mean() < 0.1 * expected  # the sun is 4/5 of it and 1/500 of the sky: uniformly, 0.8


def test_the_eye_sees_the_sky():
    """Along the dome's -Z, +X, +Z, -X and +Y the picture has the texels at u = 0, 1/4, 1/2, 3/4 and the top row."""
    texture = np.zeros((4, 8, 3), np.float32)
    texture[:, :, 0] = np.arange(8.0)
    texture[:, :, 1] = np.arange(4.0)[:, None]
    sky = ir.Light("sky", LightKind.DOME, (1.0,) * 3, texture=texture)
    for towards, u, v in [
        ((0, 0, -1), 0.0, 0.5),
        ((1, 0, 0), 0.25, 0.5),
        ((0, 0, 1), 0.5, 0.5),
        ((-1, 0, 0), 0.75, 0.5),
        ((0.1, 0.995, 0), 0.25, 0.0),
    ]:
        camera = ir.Camera.look_at((0, 0, 0), towards, up=(0.0, 1.0, 0.1), fov=0.01)
        scene = ir.Scene(lights=(sky,), camera=camera)
        film = ir.render(scene, ir.RenderSettings(width=2, height=2, iterations=1, visible_lights=True))
        x = u * 8 - 0.5
        red = x if x >= 0.0 else 3.5  # between the last and the first column
        green = 1.5 if v == 0.5 else 0.0
        np.testing.assert_allclose(film.radiance()[..., :2].mean(axis=(0, 1)), [red, green], atol=2e-2)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_links_say_what_a_light_lights(estimator):
    """An unlinked mesh has no direct light, exactly; and the linked one no light by way of it."""
    for unlit in (0, 1):
        scene = ball_over_floor(dataclasses.replace(LAMP, unlit=frozenset({unlit})))
        # One sample, so that no pixel sees both; and one bounce, since of two the second may come back.
        film = render(scene, estimator, width=32, height=32, iterations=1, max_bounces=1)
        mesh_seen = film.aov("prim_id")
        direct = film.aov("direct")
        assert (direct[mesh_seen == unlit] == 0.0).all() and direct[mesh_seen == 1 - unlit].mean() > 0.01
        indirect = film.aov("indirect")
        assert (indirect[mesh_seen == 1 - unlit] == 0.0).all()


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_light_passes_through_shadowless_meshes(estimator):
    """The floor has the direct light it would have without the ball; with shadows off at all, so it has."""
    common = dict(width=32, height=32, max_bounces=0, light_paths=1024)
    empty = dataclasses.replace(ball_over_floor(LAMP), meshes=ball_over_floor(LAMP).meshes[:1])
    free = render(empty, estimator, **common)
    shadowed = render(ball_over_floor(LAMP), estimator, **common)
    under = shadow_of_ball(shadowed, free)
    for change in (dict(shadowless=frozenset({1})), dict(shadows=False)):
        film = render(ball_over_floor(dataclasses.replace(LAMP, **change)), estimator, **common)
        mean, error = pixels(film, under)
        expected, expected_error = pixels(free, under)
        assert abs(mean - expected) <= 5.0 * math.hypot(error, expected_error)


@pytest.mark.parametrize("shaping", [Shaping(cone_angle=20.0), Shaping(cone_angle=30.0, cone_softness=1.0)])
def test_spots_leave_the_rest_of_the_room_alone(shaping):
    """VPLs are weighed by the shaping of their light: outside the cone, where it is dark, no shadow ray goes there.

    Weighed as if it shone everywhere, such a lamp takes 30 times the variance of a plain one; so, about twice.
    """
    lamp = ir.Light("lamp", LightKind.DISK, (50.0,) * 3, placed(DOWN, (0.0, 1.9, 0.0)), radius=0.2)
    variances = []
    for how in (shaping, None):
        film = render(room(dataclasses.replace(lamp, shaping=how)), "vpl", width=32, height=32, light_paths=1024)
        picture = film.radiance()
        variances.append((film.standard_error() ** 2 / (picture**2 + 0.01 * picture.mean() ** 2)).mean())
    assert variances[0] < 4.0 * variances[1]


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_lines_are_thin_cylinders(estimator, device):
    """E = 2 r L (a/(h² + a²) + atan(a/h)/h) at the height h below the middle of a line of half length a.

    That is what the loader makes of treatAsLine: a cylinder whose radius is 1e-4 of its length. A bound that knew
    nothing of its size would take the light, and rays that are to give it back hardly ever find a line.
    """
    a, h, radius = 0.75, 2.0, 1.5e-4
    line = ir.Light(
        "line", LightKind.CYLINDER, (4000.0,) * 3, placed(np.eye(3), (0, h, 0)), length=2 * a, radius=radius
    )
    expected = 2.0 * radius * 4000.0 * (a / (h * h + a * a) + math.atan(a / h) / h) / math.pi
    assert_mean(over_floor(line, estimator, device), expected, bias=3.0e-4)
