"""Scenes of very different sizes and powers: strays far away, lamps beside suns, lights larger than the scene."""

from dataclasses import replace

import numpy as np
import pytest

import warp_ir as ir
from tests.physics.closed_form import assert_mean, placed, render, rotation_x
from warp_ir.device_scene import floored_probabilities, selection_cdf
from warp_ir.device_scene.frame import frame_of_view
from warp_ir.procedural import floor
from warp_ir.renderer import Renderer
from warp_ir.scene import LightKind, Projection

pytestmark = pytest.mark.extended

GREY = (ir.Material(albedo=(0.5, 0.5, 0.5)),)


def mesh(name, points, triangles):
    triangles = np.array(triangles, np.int32)
    return ir.Mesh(name, np.array(points, float), triangles, np.zeros(len(triangles), np.int32))


def quad(name, size, centre=(0.0, 0.0, 0.0)):
    """A square that faces +z."""
    corners = 0.5 * size * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    return mesh(name, corners + centre, [(0, 1, 2), (0, 2, 3)])


def box(name, lower, upper):
    points = [[(lower, upper)[i >> k & 1][k] for k in range(3)] for i in range(8)]
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return mesh(name, points, [t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))])


def light_at(place, *args, **more):
    return ir.Light(*args, world_from_light=placed(np.eye(3), place), **more)


# ---- strays ------------------------------------------------------------------------------------------------------


def on_a_table(distance, sky, camera=None):
    """A cube on a square of width 4, seen from above; with a distance, and a small square that far away."""
    at = np.array([distance, 0.0, 0.0])
    meshes = [quad("table", 4.0, at), box("cube", np.add(at, (-0.5, -0.5, 0.0)), np.add(at, (0.5, 0.5, 1.0)))]
    if distance:
        meshes.append(quad("stray", 0.002))
    if camera is None:
        camera = ir.Camera(
            world_from_camera=placed(np.eye(3), np.add(at, (0.0, 0.0, 5.0))),
            window=(-2.0, 2.0, -2.0, 2.0),
            projection=Projection.ORTHOGRAPHIC,
        )
    else:
        camera = ir.Camera.look_at(np.add(at, camera), at, up=(0, 0, 1), fov=40)
    return ir.Scene(tuple(meshes), GREY, (sky,), camera)


SKY = ir.Light("sky", LightKind.DOME, (1.0, 1.0, 1.0))
SUN = ir.Light("sun", LightKind.DISTANT, (1.0, 1.0, 1.0), angle=10.0, world_from_light=placed(rotation_x(30.0)))


@pytest.mark.parametrize("distance", [1.0e6, 2.56e7, 1.0e9])
@pytest.mark.parametrize("sky", [SKY, SUN], ids=["sky", "sun"])
@pytest.mark.parametrize("camera", [None, (5.0, 4.0, 3.0)], ids=["orthographic", "perspective"])
def test_a_stray_far_away_changes_nothing(distance, sky, camera):
    """The picture without it, within the errors of both: contact shadows, and light that the cube reflects.

    The error of the mean is at most the mean of the pixels' errors; five of them are a false alarm in 10⁴.
    """
    settings = ir.RenderSettings(width=32, height=32, filter=False, iterations=32)
    film = ir.render(on_a_table(distance, sky, camera), settings)
    alone = ir.render(on_a_table(0.0, sky, camera), settings)
    assert np.array_equal(film.aov("alpha") > 0.5, alone.aov("alpha") > 0.5)
    error = np.hypot(film.standard_error(), alone.standard_error())
    for what in ("direct", "indirect"):
        shift = film.aov(what).astype(float).mean() - alone.aov(what).astype(float).mean()
        assert abs(shift) < 5.0 * error.mean(), what
    z = np.abs(film.radiance() - alone.radiance()) / np.maximum(error, 1e-12)
    assert (z > 4.5).mean() <= 0.01


def test_the_frame_is_where_the_camera_looks():
    """Details in view get an origin next to them; a scene that the bounding box's frame suits keeps that frame."""
    far = on_a_table(6.4e6 * 4.0, SKY)
    frame = frame_of_view(far, far.extent)
    table = frame.to_device(far.meshes[0].points)
    assert np.abs(table).max() < 1.0 and np.ptp(table[:, 0]) > 1.0 / 16.0
    assert np.allclose(frame.to_world(table), far.meshes[0].points, rtol=0.0, atol=4.0 * 2.0**-22)
    near = on_a_table(0.0, SKY)
    assert frame_of_view(near, near.extent) is None


def test_a_triangle_that_reaches_too_far_is_named():
    """A ground of 10⁷ times the view has corners that float32 rounds to more than a pixel: the renderer says so."""
    scene = on_a_table(0.0, SKY)
    ground = quad("/Ground", 4.0e7)
    settings = ir.RenderSettings(width=8, height=8, filter=False)
    fine = Renderer(replace(scene, meshes=(*scene.meshes, quad("/Stray", 0.01, (1e6, 0, 0)))), settings)
    coarse = Renderer(replace(scene, meshes=(*scene.meshes, ground)), settings)
    assert fine.warnings == ()
    assert len(coarse.warnings) == 1 and coarse.warnings[0].startswith("/Ground: ")


# ---- powers ------------------------------------------------------------------------------------------------------


def test_every_source_keeps_a_floor():
    """A lamp of 10⁻¹² of the power gets its share of the samples; even powers are not touched."""
    p = floored_probabilities(np.array([1.0, 1.0e12]), np.array([0, 1]), 0.125)
    assert np.allclose(p, np.array([0.0625, 1.0]) / 1.0625, rtol=1e-9)
    even = np.array([0.3, 0.2, 0.5])
    assert np.allclose(floored_probabilities(2.0 * even, np.arange(3), 0.125), even, rtol=1e-12)
    lamp_of_many = floored_probabilities(np.array([1e-300] * 99 + [1.0]), np.array([0] * 99 + [1]), 0.5)
    assert np.isclose(lamp_of_many[:99].sum(), 0.25 / 1.25) and np.isclose(lamp_of_many.sum(), 1.0)


def test_no_probability_is_zero_in_float32():
    """The table holds multiples of 2⁻²⁴, so that float32 and the sample numbers represent them exactly."""
    random = np.random.default_rng(0)
    for p in (random.random(10**6), np.array([1.0, 1e-30, 1.0]), np.array([1.0])):
        cdf = selection_cdf(p / p.sum())
        assert np.array_equal(cdf, cdf.astype(np.float32).astype(np.float64))
        assert cdf[0] == 0.0 and cdf[-1] == 1.0 and (np.diff(cdf) >= 2.0**-24).all()
        assert np.allclose(np.diff(cdf), p / p.sum(), rtol=0.0, atol=(2.0 + len(p) * (p / p.sum()).max()) * 2.0**-24)


def rooms(power):
    """A lamp of radiance 1 in the room of the camera, and one of `power` in a sealed room."""
    lamps = tuple(
        light_at((x, 0, 0.5), name, LightKind.SPHERE, (radiance,) * 3, radius=0.05)
        for name, radiance, x in (("dim", 1.0, 0.0), ("sealed", power, 2.5))
    )
    meshes = (box("seen", (-1, -1, -1), (1, 1, 1)), box("other", (1.5, -1, -1), (3.5, 1, 1)))
    return ir.Scene(meshes, GREY, lamps, ir.Camera.look_at((0, -0.9, 0), (0, 1, -0.3), up=(0, 0, 1)))


@pytest.mark.parametrize("estimator", ["vpl", "path"])
def test_a_lamp_in_a_sealed_room_takes_nothing_away(estimator):
    """The picture of the dim lamp is that without the other, whatever the other's power; and its error is known."""
    settings = dict(width=16, height=16, visible_lights=False)
    both = render(rooms(1.0e12), estimator, **settings)
    alone = render(replace(rooms(0.0), lights=rooms(0.0).lights[:1]), "path", **settings)
    assert both.radiance().mean() > 5.0 * both.standard_error().mean()
    shift = float(both.radiance().mean() - alone.radiance().mean())
    assert abs(shift) < 5.0 * float(np.hypot(both.standard_error(), alone.standard_error()).mean())


def test_a_lamp_indoors_is_not_drowned_by_the_sun():
    """A sun over 1 km of ground, of 10⁴ times the lamp's power, and a lamp in a closed room: that of the lamp alone."""
    lamp = light_at((0, 0, 0.5), "lamp", LightKind.SPHERE, (30.0,) * 3, radius=0.1)
    sun = ir.Light("sun", LightKind.DISTANT, (3000.0,) * 3, angle=0.53)
    meshes = (quad("ground", 1000.0, (0, 0, -2)), box("room", (-1, -1, -1), (1, 1, 1)))
    camera = ir.Camera.look_at((0, -0.9, 0), (0, 1, -0.3), up=(0, 0, 1))
    settings = dict(width=16, height=16, visible_lights=False)
    both = render(ir.Scene(meshes, GREY, (sun, lamp), camera), "vpl", **settings)
    alone = render(ir.Scene(meshes[1:], GREY, (lamp,), camera), "path", **settings)
    assert both.standard_error().mean() < 0.1 * both.radiance().mean()
    shift = float(both.radiance().mean() - alone.radiance().mean())
    assert abs(shift) < 5.0 * float(np.hypot(both.standard_error(), alone.standard_error()).mean())


def test_a_picture_of_nothing_is_not_certain():
    """Surfaces that no light has reached have an error of 100 %, and no target error is reached; without light 0 is."""
    sealed = replace(rooms(1.0), lights=rooms(1.0).lights[1:])
    settings = ir.RenderSettings(width=8, height=8, filter=False, target_error=0.1, light_paths=16)
    film = ir.render(sealed, settings)
    assert film.error() == 1.0 and film.iterations == 64
    dark = ir.render(replace(sealed, lights=()), settings)
    assert dark.error() == 0.0 and dark.iterations == 2


# ---- lights that are larger than the scene -----------------------------------------------------------------------


def overhead(kind, above, **size):
    """A light over the origin of the plane y = 0, facing down."""
    return ir.Light("l", kind, (1.0, 1.0, 1.0), world_from_light=placed(rotation_x(-90.0), (0, above, 0)), **size)


def rect_form_factor(size, height):
    """Form factor of a square over a parallel element below its centre (Howell, A Catalog of Configuration Factors)."""
    a = 0.5 * size / height
    return 4.0 / np.pi * a / np.hypot(1.0, a) * np.arctan(a / np.hypot(1.0, a))


LARGE = {
    f"{shape} of {size:g} at {height:g}": (overhead(kind, height, **measures), expected)
    for size in (1.0e3, 1.0e6)
    for height in (1.0, 1.0e3, 1.0e6)
    for shape, kind, measures, expected in (
        ("rect", LightKind.RECT, {"width": size, "height": size}, rect_form_factor(size, height)),
        ("disk", LightKind.DISK, {"radius": size}, size**2 / (size**2 + height**2)),
    )
} | {
    f"sphere of {radius:g} at {gap:g}": (
        overhead(LightKind.SPHERE, radius + gap, radius=radius),
        (radius / (radius + gap)) ** 2,
    )
    for radius in (1.0e3, 1.0e6)
    for gap in (2.0, 0.5 * radius, 100.0 * radius)
}
"""Lights, and E/(π L) below them: the view factors of a square, a disk and a sphere."""


@pytest.mark.parametrize("name", LARGE)
def test_lights_of_any_size(name):
    """E = π L F, F the view factor; with an error of a percent at most."""
    light, expected = LARGE[name]
    film = render(floor(light, size=1.0), "vpl", iterations=32, visible_lights=False)
    assert_mean(film, expected, bias=1.0e-4)  # the light's own rounding: 10⁻⁷ of its size over its distance
    assert film.error() < 0.01


@pytest.mark.parametrize("estimator", ["vpl", "path"])
def test_large_lights_with_textures(estimator):
    """A square of 10⁶, one half of which is black: half of the light of the whole."""
    half = np.repeat(np.array([0.0, 1.0], np.float32), 64)[None, :, None] * np.ones((64, 1, 3), np.float32)
    light = replace(overhead(LightKind.RECT, 1.0e3, width=1.0e6, height=1.0e6), texture=half)
    film = render(floor(light, size=1.0), estimator, visible_lights=False)
    # Interpolation spreads the edge over a texel of 1/128 of the width; it is odd about the middle.
    assert_mean(film, 0.5 * rect_form_factor(1.0e6, 1.0e3), bias=1.0e-3)
    assert film.error() < 0.2


@pytest.mark.parametrize(
    "light",
    [
        ir.Light(
            "rect", LightKind.RECT, (1.0,) * 3, width=1e6, height=1e6, world_from_light=placed(np.eye(3), (0, 0, 1e3))
        ),
        ir.Light("sun", LightKind.SPHERE, (1e4,) * 3, radius=5e3, world_from_light=placed(np.eye(3), (3e5, 3e5, 1e6))),
        ir.Light("bulb", LightKind.POINT, (1e6,) * 3, world_from_light=placed(np.eye(3), (300.0, 300.0, 1000.0))),
    ],
    ids=lambda light: light.name,
)
def test_large_and_distant_lights_are_reflected(light):
    """Their light between two surfaces is that of `path`: photons are aimed at the scene."""
    wall = mesh("wall", [(0, 0, 0), (0, 1, 0), (0, 1, 1), (0, 0, 1)], [(0, 1, 2), (0, 2, 3)])
    camera = ir.Camera.look_at((1.2, 1.2, 1.2), (0.2, 0.2, 0.2), up=(0, 0, 1))
    white = (ir.Material(albedo=(0.8, 0.8, 0.8)),)
    scene = ir.Scene((quad("floor", 1.0, (0.5, 0.5, 0)), wall), white, (light,), camera)
    vpl, path = (render(scene, e, width=16, height=16, visible_lights=False) for e in ("vpl", "path"))
    for what in ("direct", "indirect"):
        one, other = (float(film.aov(what).astype(np.float64).mean()) for film in (vpl, path))
        allowed = 5.0 * float(np.hypot(vpl.standard_error(), path.standard_error()).mean())
        assert other > 0.0 and abs(one - other) < allowed
    assert vpl.aov("indirect").mean() > 0.1 * path.aov("indirect").mean()
