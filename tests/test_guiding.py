"""Light paths go where the camera feels them, and the light is the same."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import warp_ir as ir
from tests.physics.closed_form import assert_mean
from warp_ir import procedural
from warp_ir.guiding.emitter_selection import POWER_FRACTION, probabilities
from warp_ir.guiding.importance import CellTree, learn_importance
from warp_ir.guiding.photon_target import nearest_point
from warp_ir.guiding.probes import Vertices, camera_vertices, light_vertices, trace_camera_probes
from warp_ir.metrics import z_scores
from warp_ir.procedural import cornell_box, quad
from warp_ir.renderer import Renderer
from warp_ir.scene import LightKind
from warp_ir.settings import GuidingSettings
from warp_ir.vpl.guide import CELLS, SIDES, unguided

pytestmark = pytest.mark.extended

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
GUIDED = ("guided_emitters", "guided_far_lights", "guided_paths", "guided_vpls")


@pytest.fixture
def wide(monkeypatch):
    """The module with the scenes of which the camera sees a small part."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import wide_scenes

    return wide_scenes


ALWAYS = GuidingSettings(first_iteration=0)
"""Guides all iterations."""


def film_of(scene, *, threads=None, device="cpu", guiding=ALWAYS, **settings):
    settings = ir.RenderSettings(**{"width": 24, "height": 24, "filter": False, "light_paths": 64, **settings})
    return Renderer(scene, settings, device=device, threads=threads, guiding=guiding).render()


def iterations_of(scene, width, iterations, device, light_paths=64, guiding=ALWAYS):
    """A renderer, its film, and the mean radiance of every iteration."""
    settings = ir.RenderSettings(width=width, height=width, filter=False, light_paths=light_paths)
    renderer = Renderer(scene, settings, device=device, guiding=guiding)
    film, averages = renderer.new_film(), []
    for k in range(iterations):
        one = renderer.new_film()
        renderer.add_iteration(one, k)
        averages.append(one.radiance().mean(dtype=np.float64))
        film.merge(one)
    return renderer, film, np.array(averages)


def variances(scene, device, guiding):
    """The relative variance of an iteration's pixels, and of their mean."""
    _, film, averages = iterations_of(scene, 64, 32, device, 512, guiding)
    return film.error() ** 2, averages.var(ddof=1) / averages.mean() ** 2


@pytest.mark.parametrize(
    "name, guided",
    [
        ("rooms", {"guided_emitters", "guided_paths"}),
        ("terrain", {"guided_far_lights", "guided_vpls"}),
        ("house", {"guided_far_lights", "guided_paths", "guided_vpls"}),
    ],
)
def test_light_is_the_same(wide, name, guided, device):
    """Guided VPLs and path tracing, which knows of no guide, agree: the mean of z² is 1, as far as errors are known.

    Pixels share their VPLs: the mean of all of them has the standard error of its spread over the iterations. Camera
    rays are stratified, so that at edges, of which a terrain has many, errors are up to a sixth smaller than is said.
    """
    scene = getattr(wide, name)()
    truth = film_of(scene, estimator="path", iterations=1500, device=device)
    renderer, film, averages = iterations_of(scene, 24, 200, device)
    assert {key for key in GUIDED if renderer.launcher.profile.counts[key]} >= guided
    z = z_scores(film.radiance(), film.standard_error(), truth.radiance(), truth.standard_error())
    assert 0.7 < np.mean(z**2) < 1.25
    reference = truth.radiance().mean(dtype=np.float64)
    error = np.hypot(np.std(averages, ddof=1) / len(averages) ** 0.5, truth.standard_error().mean() / 24)
    assert abs(np.mean(averages) - reference) < 4.0 * error
    assert error < 0.05 * reference


@pytest.mark.parametrize("name, gains", [("rooms", (1.3, 1.5)), ("house", (1.3, 1.5))])
def test_noise_is_less(wide, name, gains, device):
    """In one of a hundred rooms, and where the sun comes in by a window: variance of pixels, and of their mean.

    The latter is 2.3 and 3 times less over eight seeds; of 32 iterations it is known to a third.
    """
    scene = getattr(wide, name)()
    guided, plain = (variances(scene, device, guiding) for guiding in (ALWAYS, None))
    assert all(g * gain < u for g, u, gain in zip(guided, plain, gains, strict=True))


def test_nothing_changes_where_little_is_gained(device):
    """In the Cornell box most light paths matter: learning about them changes no bit."""
    how = {"iterations": 2, "width": 64, "height": 64}
    only_paths = GuidingSettings(visibility=False)
    guided, alone = (film_of(cornell_box(), device=device, guiding=guiding, **how) for guiding in (only_paths, None))
    assert [guided.counts[name] for name in GUIDED] == [0, 0, 0, 0]
    assert not any(name in alone.counts for name in GUIDED)
    assert np.array_equal(guided.radiance(), alone.radiance())


def corner(bend=5.0):
    """A corridor with a corner: the lamp is in one leg, and the camera in the other looks away from it.

    It goes 6 m along x to the corner, and `bend` m along y to the lamp; it is 1.5 m wide and 2.4 m high.
    """
    inside = [
        quad("floor", [[0, 0, 0], [6, 0, 0], [6, 1.5, 0], [0, 1.5, 0]]),
        quad("ceiling", [[0, 0, 2.4], [0, 1.5, 2.4], [6, 1.5, 2.4], [6, 0, 2.4]]),
        quad("floor of the bend", [[4.5, 1.5, 0], [6, 1.5, 0], [6, 1.5 + bend, 0], [4.5, 1.5 + bend, 0]]),
        quad("its ceiling", [[4.5, 1.5, 2.4], [4.5, 1.5 + bend, 2.4], [6, 1.5 + bend, 2.4], [6, 1.5, 2.4]]),
    ]
    walls = [[0, 0], [6, 0], [6, 1.5 + bend], [4.5, 1.5 + bend], [4.5, 1.5], [0, 1.5]]
    for k, (a, b) in enumerate(zip(walls, walls[1:] + walls[:1], strict=True)):
        inside.append(quad(f"wall{k}", [[*a, 0], [*a, 2.4], [*b, 2.4], [*b, 0]]))
    x, y = 5.25, 1.0 + bend
    lamp = [[x - 0.2, y - 0.2, 2.39], [x - 0.2, y + 0.2, 2.39], [x + 0.2, y + 0.2, 2.39], [x + 0.2, y - 0.2, 2.39]]
    materials = (ir.Material("wall", (0.7,) * 3), ir.Material("lamp", (0.5,) * 3, (20.0,) * 3))
    camera = ir.Camera.look_at((3.0, 0.7, 1.4), (0.0, 0.8, 1.0), up=(0, 0, 1), fov=65.0)
    return ir.Scene((*inside, quad("lamp", lamp, 1)), materials, camera=camera)


def test_one_lamp_round_the_corner(device):
    """Paths take the corner more often, and the light is the same; from the first iteration on, for a single lamp.

    Over four pairs of seeds the deviation of the mean of the picture was 5.4 to 6.4 times less, of 64 iterations each.
    """
    plain, guided = (iterations_of(corner(), 32, 64, device, 512, guiding) for guiding in (None, ALWAYS))
    assert guided[0].launcher.profile.counts["guided_paths"] == 1
    means, errors = zip(*((a.mean(), a.std(ddof=1) / 8.0) for *_, a in (plain, guided)), strict=True)
    assert abs(means[0] - means[1]) < 4.0 * float(np.hypot(*errors))
    assert errors[0] > 3.0 * errors[1]


def test_a_guided_furnace(device, monkeypatch):
    """Light paths that are guided where nothing is gained leave the mean as it is: 1/(1 - ρ), whatever is learned."""
    learning = sys.modules["warp_ir.guiding.learn"]
    monkeypatch.setattr(learning, "_MIN_VARIANCE", -1.0)
    monkeypatch.setattr(learning, "_MIN_PATH_GAIN", 0.0)
    film = film_of(procedural.furnace(0.5), iterations=32, device=device)
    assert film.counts["guided_paths"] == 1
    assert_mean(film, 2.0, bias=0.02)


def test_first_iterations_can_be_left_out(wide):
    """The first iterations are those without a guide; the ones after them are guided."""
    short, long = (film_of(wide.rooms(), iterations=n, guiding=GuidingSettings(first_iteration=2)) for n in (2, 3))
    assert "guided_paths" not in short.counts and long.counts["guided_paths"] == 1
    plain = [film_of(wide.rooms(), iterations=n, guiding=None).radiance() for n in (2, 3)]
    assert np.array_equal(short.radiance(), plain[0]) and not np.array_equal(long.radiance(), plain[1])


def test_the_same_bits(wide, tmp_path):
    """On any number of threads, resumed, cut from the whole picture, and of a picture rendered again."""
    scene = wide.rooms()
    whole = film_of(scene, iterations=4, threads=1)
    assert whole.counts["guided_paths"] == 1
    assert np.array_equal(whole.radiance(), film_of(scene, iterations=4, threads=3).radiance())
    film_of(scene, iterations=2).save(tmp_path / "film.npz")
    settings = ir.RenderSettings(width=24, height=24, filter=False, light_paths=64, iterations=4)
    renderer = Renderer(scene, settings, guiding=ALWAYS)
    film = renderer.new_film()
    film.resume(tmp_path / "film.npz")
    assert np.array_equal(renderer.render(film).radiance(), whole.radiance())
    renderer.update(replace(scene, camera=wide.house().camera))
    assert not np.array_equal(renderer.render().radiance(), whole.radiance())
    renderer.update(scene)
    assert np.array_equal(renderer.render().radiance(), whole.radiance())
    part = film_of(scene, iterations=4, data_window=(0.25, 0.25, 0.75, 0.75))
    assert np.array_equal(part.radiance(), whole.radiance()[6:18, 6:18])


def test_twice_the_light(wide):
    """Twice the light is twice the film, bit for bit: nothing that is learned has a unit."""
    scene = wide.rooms()
    brighter = tuple(
        replace(m, emission=(2 * m.emission[0], 2 * m.emission[1], 2 * m.emission[2])) for m in scene.materials
    )
    film, twice = film_of(scene, iterations=2), film_of(replace(scene, materials=brighter), iterations=2)
    assert film.counts["guided_paths"] == twice.counts["guided_paths"] == 1
    assert np.array_equal(2.0 * film.radiance(), twice.radiance())


def test_black_pictures_are_black(wide):
    """A camera that sees nothing, or no light, teaches nothing."""
    away = ir.Camera.look_at((0, 0, 500), (0, 0, 1000), up=(0, 1, 0))
    assert film_of(replace(wide.rooms(2), camera=away), iterations=1).radiance().max() == 0.0
    dark = replace(wide.rooms(2), materials=tuple(replace(m, emission=(0, 0, 0)) for m in wide.rooms(2).materials))
    assert film_of(dark, iterations=1).radiance().max() == 0.0


def test_probabilities_of_emitters():
    """What is unknown goes by power, what is known by what came; and a share by power everywhere."""
    power = np.array([0.1, 0.2, 0.3, 0.15, 0.25])
    unknown = probabilities(power, np.zeros(0, np.int64), np.zeros(0))
    assert np.allclose(unknown, power, rtol=1e-12)
    emitter = np.repeat([1, 4], 10**6)
    known = probabilities(power, emitter, np.repeat([3.0, 1.0], 10**6))
    expected = POWER_FRACTION * power + (1.0 - POWER_FRACTION) * np.array([0.0, 0.75, 0.0, 0.0, 0.25])
    assert np.allclose(known, expected, atol=1e-4)
    assert np.isclose(known.sum(), 1.0, rtol=1e-12) and (known >= POWER_FRACTION * power).all()


def test_where_lines_meet():
    """Lines through a point come closest there; parallel ones in the middle."""
    random = np.random.default_rng(0)
    ways = random.normal(size=(50, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    window = np.array([0.1, -0.2, 0.05])
    points = window + ways * random.uniform(0.1, 0.3, (50, 1))
    assert np.allclose(nearest_point(points, ways, np.ones(50)), window, atol=2e-3)
    down = np.tile([0.0, 0.0, 1.0], (4, 1))
    square = np.array([[1, 1, 0], [-1, 1, 0], [1, -1, 0], [-1, -1, 0]], float)
    assert np.allclose(nearest_point(square, down, np.ones(4)), 0.0, atol=1e-6)


def test_means_of_cells():
    """Many vertices tell the mean of their cell; where there are none, it is that of the cells around."""
    cell = np.repeat([0, 1], 10**5)
    tree = CellTree(cell)
    means = tree.means(np.repeat([2.0, 4.0], 10**5), tree.levels(np.ones(2 * 10**5)))
    table = tree.dense(means)
    assert table.shape == (SIDES * CELLS**3,)
    assert np.allclose(table[:2], [2.0, 4.0], rtol=1e-3)
    assert np.isclose(table[CELLS], 3.0, rtol=1e-3) and np.isclose(table[-1], 3.0, rtol=1e-3)


def test_importance_solves_the_adjoint_equation():
    """Paths go through three cells, the last of which alone is seen: V = r²J, rJ and J, r the ratio of intensities."""
    own, r, n = np.array([0.0, 0.0, 8.0]), 0.5, 10**4
    step = np.array([1, 2, -1])
    vertices = Vertices(
        cell=np.tile([0, 5, 10], n),
        contribution=np.tile(own, n),
        next=(np.where(step >= 0, step, -1) + np.where(step >= 0, 3 * np.arange(n)[:, None], 0)).reshape(-1),
        ratio=np.full(3 * n, r),
        continues=np.ones(3 * n, bool),
        intensity=np.zeros(3 * n),
        path=np.full(3 * n, -1),
        is_first=np.zeros(3 * n, bool),
    )
    learned = learn_importance(vertices)
    assert np.allclose(learned.own[0], own, atol=8.0 / n * 3)
    assert np.allclose((learned.own[0] + learned.following[0]), [r * r * 8.0, r * 8.0, 8.0], rtol=1e-2)


@pytest.mark.parametrize("number", [0, 1])
def test_importance_in_a_furnace(number, device):
    """In a closed sphere J is the same everywhere, and C = ρ/(1 - ρ) J: a VPL of intensity 1 leaves ρ, ρ², ... more.

    Paths are followed for 12 vertices, and importance for 12 segments: ρ¹² = 1/4096 is left out.
    """
    renderer = Renderer(procedural.furnace(0.5), ir.RenderSettings(width=32, height=32, filter=False), device=device)
    launcher, settings, scene = renderer.launcher, renderer._resolved, renderer.scene
    probes = trace_camera_probes(scene, renderer._shutter[0].camera, launcher, 1024, settings)
    guide = unguided(scene, launcher)
    vertices = camera_vertices(scene, launcher, probes) + light_vertices(
        guide, launcher, probes, 4096, settings, number
    )
    learned = learn_importance(vertices)
    light = vertices.path >= 0
    own, following = (x[0][learned.tree.leaf[light]] for x in (learned.own, learned.following))
    n = light.sum()
    # A vertex has four connections: J of one is known to its deviation over the root of their number.
    spread = vertices.contribution[light].std() / n**0.5
    assert abs(own.mean() - vertices.contribution[light].mean()) < 5.0 * spread
    # A path goes on with probability 1/2, a standard deviation of 1/2; and what follows is 1/(1 - ρ) of that.
    assert abs(following.mean() / own.mean() - 1.0) < 5.0 * 2.0 * 0.5 / n**0.5 + 2 * 0.5**11


def test_both_halves_of_the_probes_see_the_picture():
    """What is learned from one half of the camera paths is measured by the other: both are spread over the image."""
    renderer = Renderer(cornell_box(), ir.RenderSettings(width=64, height=64, filter=False))
    camera = renderer._shutter[0].camera
    seen = trace_camera_probes(renderer.scene, camera, renderer.launcher, 1024, renderer.settings.resolve())
    middle = np.median(seen.position[seen.bounce == 0, :2], axis=0)
    for half in (seen.training, ~seen.training):
        beyond = (seen.position[half & (seen.bounce == 0), :2] > middle).mean(axis=0)
        assert np.all(np.abs(beyond - 0.5) < 0.05)


def test_no_paths_for_light_that_none_brings(device):
    """On a plane no VPL lights another point: under an open sky there are no more paths than are asked for."""
    sky = ir.Light("sky", LightKind.DOME, (1.0, 1.0, 1.0))
    film = film_of(procedural.floor(sky, albedo=0.5), width=32, height=32, iterations=16)
    assert film.counts["light_paths"] == 16 * 64 and film.counts["guided_paths"] == 0
    assert_mean(film, 0.5)
