"""The estimators agree with each other, converge as they should, and know how wrong they are."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import warp_ir as ir
from tests.physics.closed_form import assert_agree, placed, render, rotation_x
from tests.physics.scenes import box_with_lights, everything, glowing_room
from warp_ir.estimators import ESTIMATORS
from warp_ir.metrics import relative_mse
from warp_ir.procedural import cornell_box, floor, furnace, mesh, sphere
from warp_ir.scene import LightKind

SCENES = Path(__file__).parents[2] / "scenes_usd"


def extended(*values):
    """Parameters for which a test is in the extended tier."""
    return pytest.param(*values, marks=pytest.mark.extended)


def smooth_ball():
    """A smooth-shaded ball in the Cornell box: interpolated normals, and colours by corner."""
    points, triangles = sphere(100.0, level=2)
    normals = (points / 100.0)[triangles].astype(np.float32)
    ball = mesh("ball", points + np.array([278, 250, 150]), triangles)
    ball = dataclasses.replace(ball, normals=normals, colors=np.abs(normals))
    scene = cornell_box()
    return dataclasses.replace(scene, meshes=(*scene.meshes, ball))


@pytest.mark.parametrize("make", [cornell_box, extended(box_with_lights), extended(smooth_ball)])
@pytest.mark.parametrize(
    "estimator, absorption", [("keller", "fractional"), extended("keller", "roulette"), ("vpl", "roulette")]
)
def test_vpls_agree_with_path(make, estimator, absorption):
    """Per pixel the difference of two estimates over its standard error is a standard normal; so is the mean's.

    Of 432 values at most 0.5 % may exceed 4.5 (24 iterations or more, of long-tailed distributions), and the shift of
    the mean, whose standard error is at most the mean of the VPLs' (they are correlated), stays within 4 of those.
    """
    common = dict(width=12, height=12)
    one = render(make(), estimator, iterations=24 if estimator == "keller" else 256, absorption=absorption, **common)
    two = render(make(), "path", iterations=1024, **common)
    assert_agree(one, two, outliers=0.005)


@pytest.mark.extended
@pytest.mark.parametrize("make", [everything, glowing_room])
@pytest.mark.parametrize("estimator, absorption", [("keller", "fractional"), ("vpl", "roulette")])
def test_vpls_agree_with_path_under_modified_lights(make, estimator, absorption):
    """Shaping, textures, links and missing shadows, of lights and of surfaces that emit: all of it at once.

    Of 432 values at most 1 % may exceed 4.5: 4 of them, where rare bright paths make the tails of `path` long.
    """
    common = dict(width=12, height=12)
    iterations = 32 if estimator == "keller" else 256
    one = render(make(), estimator, iterations=iterations, light_paths=512, absorption=absorption, **common)
    two = render(make(), "path", iterations=4096, **common)
    assert_agree(one, two, outliers=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("make", [cornell_box, smooth_ball])
def test_means_agree_at_convergence(make):
    """Mean radiance of keller, of vpl with and without its filter, and of path within 0.5 %."""
    path = render(make(), "path", iterations=8192, width=24, height=24).radiance().mean()
    keller = render(make(), "keller", iterations=128, light_paths=1024, width=24, height=24).radiance().mean()
    assert keller == pytest.approx(path, rel=0.005)
    for filtered in (False, True):
        vpl = render(make(), "vpl", iterations=1024, light_paths=1024, width=24, height=24, filter=filtered)
        assert vpl.radiance().mean() == pytest.approx(path, rel=0.005)


def repeated(estimator, iterations, *, light_paths=64, seeds=16):
    """Images and standard errors [seeds, h, w, 3] of a room without edges, rendered again and again.

    Without edges because there the stratified jitter makes the true error smaller; and with G bounded, since next to
    another wall its square has no finite mean and no statement about errors can hold.
    """
    common = dict(width=8, height=8, light_paths=light_paths, absorption="roulette", bound_radius=0.3)
    scene = furnace(0.6, shape="cube")
    films = [render(scene, estimator, iterations=iterations, seed=seed, **common) for seed in range(seeds)]
    return np.array([f.radiance() for f in films], np.float64), np.array([f.standard_error() for f in films])


@pytest.mark.extended
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_standard_error_is_honest(estimator):
    """Repeated renders scatter as their standard errors say: the Z scores against their common mean have variance 1.

    32 renders of 64 pixels, whose errors within a render may be as good as the same, leave that uncertain by
    √(2/32) = 1/4 at worst; two of those.
    """
    images, errors = repeated(estimator, 48 if estimator == "keller" else 128, seeds=32)
    z = (images - images.mean(axis=0)) / (errors * np.sqrt(31 / 32))
    assert 0.5 < (z**2).mean() < 1.5


@pytest.mark.extended
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_error_falls_as_one_over_root_n(estimator):
    """The log-log slope of the spread over the number of (independent) iterations is -1/2.

    Each spread is of 16 renders, known to 1/√32 or ±18 % at worst; over a factor of 16 the slope is known to ±0.09.
    """
    counts = [4, 16, 64]
    spreads = [repeated(estimator, n)[0].std(axis=0, ddof=1).mean() for n in counts]
    slope = stats.linregress(np.log(counts), np.log(spreads)).slope
    assert -0.68 < slope < -0.32


@pytest.mark.extended
def test_light_paths_are_of_low_discrepancy():
    """Eight times the points on a rectangular light leave not 1/8 of the variance, as random ones, but 1/64 or less.

    For a smooth integrand scrambled nets promise N⁻³ (Owen 1997), that is 1/512.
    """
    lamp = ir.Light("lamp", LightKind.RECT, (1.0,) * 3, placed(rotation_x(-90.0), (0.3, 1.0, 0.1)))
    few, many = (
        np.var(
            [
                render(floor(lamp), "keller", width=1, height=1, iterations=1, light_paths=n, seed=seed).radiance()
                for seed in range(16)
            ]
        )
        for n in (64, 512)
    )
    assert many < few / 64


@pytest.mark.slow
@pytest.mark.parametrize("name", ["two_rooms", "thousand_lights", "light_types", "corridor", "emissive mesh"])
@pytest.mark.parametrize("estimator", ["vpl", "path"])
def test_standard_errors_of_scenes(estimator, name):
    """The variance of repeated renders is what they say: with textures, many lights, hidden lights, emissive meshes.

    Of 16 renders, whose errors within each may be as good as the same, it is known to √(2/16) = 0.35 at worst; two of
    those above. Below, edges with their stratified jitter leave as little as half.
    """
    scene = cornell_box() if name == "emissive mesh" else ir.load_usd(SCENES / f"{name}.usda")
    films = [render(scene, estimator, width=16, height=16, iterations=32, seed=k, light_paths=None) for k in range(16)]
    pictures = np.array([film.radiance() for film in films], np.float64)
    mean = pictures.mean(axis=0)
    weight = 1.0 / (mean**2 + 0.01 * mean.mean() ** 2)
    said = np.mean([weight * film.standard_error().astype(np.float64) ** 2 for film in films])
    assert 0.3 < np.mean(weight * pictures.var(axis=0, ddof=1)) / said < 1.7


@pytest.fixture(scope="module")
def small_box():
    """The Cornell box of the test scenes, settings for small pictures of it, and the mean of 1024 iterations."""
    scene = ir.load_usd(SCENES / "cornell_box.usda")
    common = dict(width=12, height=12, light_paths=256)
    return scene, common, render(scene, "vpl", iterations=1024, **common).radiance()


@pytest.mark.extended
@pytest.mark.parametrize("filtered", [False, True])
def test_target_error_is_the_true_error(filtered, small_box):
    """A render to a target error of 5 % stops there, and its relative RMS error against the truth is 5 %, or less.

    Errors within a render may be as good as the same (VPLs are shared): of 8 renders the mean square is known to
    √(2/8) = 0.5 at worst, two of which bound it from above; the truth's own error is within that. On the many edges of
    so small a picture jitter is stratified and the error smaller; filtered, it is smaller still.
    """
    scene, common, truth = small_box
    target = 0.05
    settings = [ir.RenderSettings(target_error=target, filter=filtered, seed=k, **common) for k in range(1, 9)]
    films = [ir.render(scene, s) for s in settings]
    assert all(0.8 * target < film.error() <= target for film in films)
    error = np.mean([relative_mse(film.radiance(), truth) for film in films])
    assert error < 2.0 * target**2
    assert filtered or error > 0.2 * target**2


@pytest.mark.slow
def test_a_target_of_one_percent(tmp_path):
    """Eight renders to an estimated error of 1 % are 1 % off the truth, or less: their plain means and the pictures.

    The truth is the mean of the plain means, which have no bias; each of eight is off it by √(7/8) of its error. How
    well eight tell their mean square is said above. Most pixels of so small a picture hold an edge, and of what is said
    the jitter of the camera's rays is the larger part by now: stratified, it errs less than half as much.
    """
    scene, target = ir.load_usd(SCENES / "cornell_box.usda"), 0.01
    settings = dict(width=12, height=12, light_paths=256, target_error=target)
    films = [ir.render(scene, ir.RenderSettings(**settings, seed=k)) for k in range(1, 9)]
    assert all(0.8 * target < film.error() <= target for film in films)
    means = []
    for film in films:
        film.save(tmp_path / "film.npz")
        means.append(ir.Film.load(tmp_path / "film.npz").radiance())
    truth = np.mean(means, axis=0, dtype=np.float64)
    plain = 8 / 7 * np.mean([relative_mse(mean, truth) for mean in means])
    filtered = np.mean([relative_mse(film.radiance(), truth) for film in films])
    assert 0.1 * target**2 < plain < 2.0 * target**2
    assert filtered < 2.0 * target**2
