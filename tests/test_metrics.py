"""The error measures on pictures whose error is known in closed form."""

import numpy as np
import pytest

from warp_ir import InputError
from warp_ir.metrics import mean_ratio, relative_mse, z_scores


def test_relative_mse_of_a_constant():
    """For x = a·r with constant r: the error is (a − 1)² / 1.01."""
    reference = np.full((3, 5, 3), 7.0)
    assert relative_mse(1.1 * reference, reference) == pytest.approx(0.01 / 1.01)


def test_relative_mse_of_black_pixels():
    """For r = (0, 2), x = r + d: with m = 1 the error is the mean of d²/0.01 and d²/4.01."""
    error = relative_mse(np.array([0.1, 2.1]), np.array([0.0, 2.0]))
    assert error == pytest.approx(0.5 * (0.01 / 0.01 + 0.01 / 4.01))


def test_relative_mse_has_no_unit():
    """A scene twice as bright has the same error."""
    rng = np.random.default_rng(1)
    x, r = rng.random((8, 8, 3)), rng.random((8, 8, 3))
    assert relative_mse(2.0 * x, 2.0 * r) == pytest.approx(relative_mse(x, r), rel=1e-12)


def test_floor_of_the_reference_is_subtracted():
    """A perfect picture against a reference with noise σ has the error σ²·weight, which is subtracted."""
    reference = np.array([4.0, 6.0])
    noise = np.array([0.3, -0.3])
    error = relative_mse(reference - noise, reference, reference_error=np.abs(noise))
    assert error == pytest.approx(0.0, abs=1e-15)


def test_mean_ratio():
    """2 % brighter in the mean is +0.02, whatever the noise."""
    reference = np.array([1.0, 3.0])
    assert mean_ratio(np.array([0.04, 4.04]), reference) == pytest.approx(0.02)


def test_z_scores():
    """(x − r) / √(σ² + σᵣ²): 5 over the hypotenuse of 3 and 4 is 1."""
    one = np.ones((2, 2))
    np.testing.assert_allclose(z_scores(6.0 * one, 3.0 * one, one, 4.0 * one), one)


def test_z_scores_of_noise_have_variance_one():
    """For honest standard errors: mean 0 and variance 1 within five of their own standard errors."""
    rng = np.random.default_rng(7)
    n = 100_000
    sigma = rng.uniform(0.5, 2.0, n)
    z = z_scores(rng.normal(3.0, sigma), sigma, np.full(n, 3.0))
    assert abs(z.mean()) < 5.0 / np.sqrt(n)
    assert abs(z.var() - 1.0) < 5.0 * np.sqrt(2.0 / n)


def test_z_scores_without_noise():
    """Where nothing is uncertain, equal values score 0 and different ones infinity."""
    assert z_scores(np.array([1.0, 2.0]), np.zeros(2), np.array([1.0, 1.0])).tolist() == [0.0, np.inf]


def test_wrong_input_is_named():
    """Pictures of different size, and a reference that is black, cannot be compared."""
    with pytest.raises(InputError, match="differ in shape"):
        relative_mse(np.ones((2, 2)), np.ones((2, 3)))
    with pytest.raises(InputError, match="black"):
        relative_mse(np.ones(3), np.zeros(3))
    with pytest.raises(InputError, match="black"):
        mean_ratio(np.ones(3), np.zeros(3))


def test_scale_keeps_noise_from_weighing_itself():
    """Skewed noise in the reference: with a clean scale the error is the true one, without it far above.

    The reference is the mean of 4 exponential samples of 1, the image 1.1 everywhere: its error is 0.01 / 1.01.
    The estimate is the mean of (x − r)² − se² over 1.01; its own standard error follows from the sample.
    """
    samples = np.random.default_rng(3).exponential(size=(4, 100_000))
    r, se = samples.mean(axis=0), samples.std(axis=0, ddof=1) / 2.0
    x, one = np.full_like(r, 1.1), np.ones_like(r)
    sigma = np.std(((x - r) ** 2 - se**2) / 1.01) / np.sqrt(r.size)
    truth = 0.01 / 1.01
    assert abs(relative_mse(x, r, reference_error=se, scale=one) - truth) < 4.0 * sigma
    assert relative_mse(x, r, reference_error=se) > truth + 40.0 * sigma
