"""Closed rooms that emit and reflect alike: the answer is a geometric series."""

import numpy as np
import pytest

from tests.physics.closed_form import assert_mean, render
from warp_ir.estimators import ESTIMATORS
from warp_ir.procedural import furnace
from warp_ir.vpl.emission import survivors

PATHS = 256


def truncation(albedo, paths=PATHS):
    """What fractional absorption leaves out, relative: the terms for which not one path is left."""
    return albedo ** (len(survivors(paths, albedo)) + 1)


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("shape", ["sphere", "cube"])
@pytest.mark.parametrize(
    "albedo", [pytest.param(0.2, marks=pytest.mark.extended), 0.5, pytest.param(0.8, marks=pytest.mark.extended)]
)
def test_radiance_is_emission_over_absorption(estimator, shape, albedo, device):
    """A closed room of emission Le and albedo ρ has radiance Le / (1 - ρ) everywhere."""
    film = render(furnace(albedo, 1.0, shape=shape, level=3), estimator, device)
    assert_mean(film, 1.0 / (1.0 - albedo), bias=truncation(albedo) if estimator == "keller" else 0.0)


@pytest.mark.extended
def test_paths_that_carry_much_do_not_end(device):
    """At ρ = 1/2 roulette begins with the third reflection after the first, and then takes every other path.

    Its variance is that of β(1 + N), β = 1/4, N geometric of ratio 1/2: 2 β² = 1/8 of (ρ Le)², and as much again is
    allowed for the choice of emitter and direction. Roulette by ρ from the first reflection on has 2 (ρ Le)².
    """
    film = render(furnace(0.5, level=3), "path", device, iterations=256)
    variance = np.mean(film.standard_error().astype(np.float64) ** 2) * film.iterations
    assert variance < 2.0 * 0.125 * 0.5**2
    assert_mean(film, 2.0)


@pytest.mark.extended
@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("absorption", ["fractional", "roulette"])
@pytest.mark.parametrize("bounces", [0, 1, 3])
def test_max_bounces_cuts_the_series(estimator, absorption, bounces, device):
    """With at most b bounces the radiance is Le Σ ρᵏ for k ≤ b + 1: light reflected once is bounce 0."""
    if estimator == "path" and absorption == "fractional":
        pytest.skip("the path tracer knows roulette only")
    film = render(furnace(0.5, level=3), estimator, device, max_bounces=bounces, absorption=absorption)
    assert_mean(film, sum(0.5**k for k in range(bounces + 2)))


@pytest.mark.extended
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_terms_of_the_series_are_split_into_direct_and_indirect(estimator, device):
    """In the furnace Le = 1, ρ = 1/2: emission and one reflection are 3/2, all the rest 1/2."""
    film = render(furnace(0.5, level=3), estimator, device)
    slack = 5.0 * float(film.standard_error().mean()) + 2.0 * truncation(0.5)
    assert abs(film.aov("direct").mean() - 1.5) < slack
    assert abs(film.aov("indirect").mean() - 0.5) < slack
    np.testing.assert_allclose(film.aov("direct") + film.aov("indirect"), film.radiance(), rtol=1e-6)


@pytest.mark.extended
@pytest.mark.parametrize("share", [0.1, 0.25])
def test_bound_loses_a_known_part(share, device):
    """In a sphere of radius R, where G = 1/(4R²) for any two points, G ≤ c/(4R²) leaves Le + c (Le/(1-ρ) - Le).

    Tessellation changes that near x only: facets turn by δ = 0.03 rad, so cosθ = d/(2R) is halved, and G below the
    bound, closer than d = 4δ; that is a share d²/4 = 0.0036 of the sphere's area.
    """
    scene = furnace(0.5, level=5)
    # The bound is 1/(r extent)² = c/(4 R²), with R = 1.
    radius = 2.0 / (np.sqrt(share) * scene.extent)
    film = render(scene, "keller", device, bound_radius=radius)
    assert_mean(film, 1.0 + share * 1.0, bias=share * 0.0036 + truncation(0.5))


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_black_and_dark_rooms(estimator, device):
    """Without reflection there is only emission, exactly; without emission there is nothing, exactly."""
    np.testing.assert_array_equal(render(furnace(0.0, 0.75, level=2), estimator, device, iterations=2).radiance(), 0.75)
    np.testing.assert_array_equal(render(furnace(0.7, 0.0, level=2), estimator, device, iterations=2).radiance(), 0.0)
