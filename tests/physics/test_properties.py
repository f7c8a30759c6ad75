"""Facts that hold for every scene, tried on scenes that hypothesis draws: few in the default tier, many in the slow."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given

import warp_ir as ir
from tests.physics.closed_form import render, rotation
from tests.physics.strategies import examples, scenes
from tests.physics.test_invariance import transformed, with_light
from warp_ir.estimators import ESTIMATORS
from warp_ir.renderer import Renderer


def extended(*values):
    """Parameters for which a test is in the extended tier."""
    return pytest.param(*values, marks=pytest.mark.extended)


def slow(*values):
    """Parameters for which a test is in the slow tier."""
    return pytest.param(*values, marks=pytest.mark.slow)


SMALL = dict(width=12, height=12, iterations=2, light_paths=64, filter=True)


@pytest.mark.parametrize("count", [3, extended(20), slow(400)])
def test_nothing_but_numbers(count, device):
    """No sample of any scene is infinite or no number, by any estimator, filtered or not, and none is negative."""

    @examples(count)
    @given(scene=scenes(wild=True))
    def check(scene):
        for estimator in ESTIMATORS:
            film = render(scene, estimator, device, **SMALL)
            picture = film.radiance()
            assert film.rejected == 0 and np.isfinite(picture).all() and picture.min() >= 0.0
            assert np.isfinite(film.standard_error()).all() and np.isfinite(film.error())

    check()


@pytest.mark.parametrize("count", [2, extended(10), slow(200)])
def test_powers_of_two_change_no_bit(count, device):
    """A scene 8 times or 1/1024 as large is the same picture, and one with 4 times the light is 4 times the picture."""

    @examples(count)
    @given(scene=scenes())
    def check(scene):
        larger, smaller = (transformed(scene, np.eye(3) * 2.0**k, np.zeros(3)) for k in (3, -10))
        for estimator in ESTIMATORS:
            film = render(scene, estimator, device, **SMALL).radiance()
            for other, factor in ((larger, 1.0), (smaller, 1.0), (with_light(scene, 4.0), 4.0)):
                assert np.array_equal(factor * film, render(other, estimator, device, **SMALL).radiance())

    check()


def turned(scene):
    """The scene turned by 90 degrees about two axes, so that each axis becomes another."""
    return transformed(scene, np.rint(rotation(0, 90.0) @ rotation(1, 90.0)), np.zeros(3))


def reordered(scene):
    """The scene with its meshes, its materials and its lights in reverse order."""
    last = len(scene.materials) - 1
    meshes = tuple(dataclasses.replace(m, material=last - m.material) for m in scene.meshes)
    return dataclasses.replace(scene, meshes=meshes[::-1], materials=scene.materials[::-1], lights=scene.lights[::-1])


def assert_same_surfaces(one, two, share):
    """Films show the same surfaces in the same places, but for a share of the pixels: rounding decides at edges."""
    for name in ("alpha", "depth", "albedo"):
        first, second = (film.aov(name).astype(np.float64) for film in (one, two))
        differs = np.abs(first - second) > 1e-3 * (np.abs(first) + np.abs(second).mean())
        assert differs.reshape(first.shape[0], first.shape[1], -1).any(axis=2).mean() <= share, name


@pytest.mark.parametrize("count", [1, extended(6), slow(100)])
def test_order_and_orientation_change_only_the_noise(count, device):
    """A scene in another order, or turned with its camera, shows the same surfaces and the same light.

    Rays, and so surfaces, differ by rounding alone. Light paths are others: the means agree within 5 standard errors,
    each at most the mean of the pixels' errors.
    """

    @examples(count)
    @given(scene=scenes())
    def check(scene):
        for estimator in ("vpl", "path"):
            settings = dict(width=12, height=12, iterations=32, light_paths=256)
            film = render(scene, estimator, device, **settings)
            for other in (turned(scene), reordered(scene)):
                again = render(other, estimator, device, **settings)
                assert_same_surfaces(film, again, 0.05)
                means = [float(f.radiance().astype(np.float64).mean()) for f in (film, again)]
                errors = [float(f.standard_error().astype(np.float64).mean()) for f in (film, again)]
                assert abs(means[0] - means[1]) <= 5.0 * np.hypot(*errors) + 1e-5 * means[0]

    check()


def picture_means(scene, estimator, iterations, seed, device):
    """The means of the pictures of single iterations, which are independent, [iterations]."""
    width = 24 if estimator == "path" else 12
    settings = ir.RenderSettings(
        width=width, height=width, estimator=estimator, filter=False, light_paths=256, absorption="roulette", seed=seed
    )
    renderer = Renderer(scene, settings, device=device)
    means = []
    for iteration in range(iterations):
        film = renderer.new_film()
        renderer.add_iteration(film, iteration)
        means.append(film.radiance().astype(np.float64).mean())
    return np.array(means)


@pytest.mark.parametrize("count, names", [(2, ["vpl"]), extended(8, ["vpl", "keller"]), slow(100, ["vpl", "keller"])])
def test_estimators_agree(count, names, device):
    """The mean picture is that of `path`, within errors that are honest: the scores have variance 1.

    Iterations are independent, so the errors of the means are known to 1/√128. Of n scenes that are lit, the mean of
    the squares of n normal scores is known to √(2/n), three of which are allowed for, and each score is within 5.
    """
    scores = []

    @examples(count)
    @given(scene=scenes())
    def check(scene):
        path = picture_means(scene, "path", 256, 2 * len(scores), device)
        for name in names:
            vpl = picture_means(scene, name, 64, 2 * len(scores) + 1, device)
            error = np.sqrt(vpl.var(ddof=1) / len(vpl) + path.var(ddof=1) / len(path))
            shift = vpl.mean() - path.mean()
            score = shift / max(error, 1e-6 * path.mean(), 1e-30)
            assert abs(score) < 5.0, f"{name}: {vpl.mean():.6g}, path: {path.mean():.6g} ± {error:.2g}"
            if path.mean() > 0.0:
                scores.append(score)

    check()
    assert not scores or np.mean(np.square(scores)) < 1.0 + 3.0 * np.sqrt(2.0 / len(scores))


@pytest.mark.parametrize("count", [extended(10), slow(200)])
def test_standard_errors_of_pixels_are_honest(count, device):
    """Two films of different seeds differ as their standard errors say: the scores of pixels have mean square 1.

    Within a film they may be as good as the same, so that n scenes tell it to √(2/n) at worst; three of those above.
    Below, edges with their stratified jitter, and all of a picture of emission alone, leave as little as a quarter.
    """
    squares = {name: [] for name in ESTIMATORS}

    @examples(count)
    @given(scene=scenes())
    def check(scene):
        for name, iterations in (("vpl", 32), ("keller", 32), ("path", 128)):
            seed = 2 * len(squares[name])
            settings = dict(width=12, height=12, iterations=iterations, light_paths=256, absorption="roulette")
            one, two = (render(scene, name, device, seed=seed + k, **settings) for k in (0, 1))
            error = np.hypot(one.standard_error().astype(np.float64), two.standard_error())
            noisy = error > 0.0
            difference = one.radiance().astype(np.float64) - two.radiance()
            assert not difference[~noisy].any()
            if noisy.any():
                squares[name].append(np.mean((difference[noisy] / error[noisy]) ** 2))

    check()
    for name, found in squares.items():
        assert 0.25 < np.mean(found) < 1.0 + 3.0 * np.sqrt(2.0 / len(found)), name
