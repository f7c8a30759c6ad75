"""Tone mapping against the published formulas."""

import numpy as np
import pytest

from warp_ir import InputError
from warp_ir.image.tonemap import filmic, srgb_from_linear, suggest_exposure, tone_map
from warp_ir.usd.values.source_color_space import srgb_to_linear


def test_srgb_matches_the_standard():
    """IEC 61966-2-1: 0 and 1 stay, 0.5 encodes 0.2140411, and the two pieces meet at 0.0031308."""
    assert srgb_from_linear(np.array([0.0, 1.0])).tolist() == [0.0, pytest.approx(1.0, abs=1e-15)]
    assert srgb_to_linear(np.array(0.5)) == pytest.approx(0.21404114, abs=1e-8)
    # The standard's own constants leave a step of 3e-8 where the pieces meet.
    assert srgb_from_linear(np.array(0.0031308)) == pytest.approx(srgb_from_linear(np.array(0.0031309)), abs=2e-6)


def test_srgb_round_trip():
    """Decoding undoes encoding: both are analytic, so only rounding (and the step of 3e-8) is left."""
    x = np.linspace(0.0, 1.0, 1001)
    np.testing.assert_allclose(srgb_to_linear(srgb_from_linear(x)), x, atol=1e-7)


def test_all_256_codes_survive():
    """An 8-bit picture that is read as linear and written again has the same bits."""
    codes = np.arange(256)
    again = np.floor(srgb_from_linear(srgb_to_linear(codes / 255.0)) * 255.0 + 0.5)
    assert (again == codes).all()


def test_exposure_doubles():
    """One stop more is twice the radiance."""
    x = np.array([0.01, 0.2, 0.4])
    np.testing.assert_array_equal(tone_map(x, 1.0), tone_map(2.0 * x))
    np.testing.assert_array_equal(tone_map(x, -3.0), tone_map(x / 8.0))


def test_filmic_is_narkowicz():
    """The fit's own values: 0 at 0, (2.51 + 0.03) / (2.43 + 0.59 + 0.14) at 1, clipped to 1, never falling."""
    assert filmic(np.array([0.0, 1.0, 1e30, np.inf])).tolist() == pytest.approx([0.0, 2.54 / 3.16, 1.0, 1.0])
    assert (np.diff(filmic(np.geomspace(1e-6, 1e6, 1000))) >= 0.0).all()


@pytest.mark.parametrize("tonemap", ["srgb", "filmic"])
def test_nothing_leaves_the_screen(tonemap):
    """Whatever the radiance, display values are within [0, 1]."""
    shown = tone_map(np.array([-1.0, 0.0, 1e-38, 1e38, np.inf], dtype=np.float32), 100.0, tonemap)
    assert (shown >= 0.0).all() and (shown <= 1.0).all()


def test_unknown_curve_and_exposure_are_named():
    """What cannot be shown says so."""
    with pytest.raises(InputError, match="tonemap: must be one of srgb, filmic"):
        tone_map(np.zeros(3), tonemap="agx")
    with pytest.raises(InputError, match="exposure"):
        tone_map(np.zeros(3), exposure=float("nan"))


@pytest.mark.parametrize("stops", [-30.0, -8.0, 8.0, 30.0])
def test_suggested_exposure_takes_grey_to_grey(stops):
    """A picture of middle grey, 2^stops times too bright, is shown properly by -stops."""
    radiance = np.full((4, 4, 3), 0.18 * 2.0**stops)
    assert suggest_exposure(radiance) == -stops
    assert suggest_exposure(radiance, -stops) is None


def test_no_suggestion_for_good_or_black_pictures():
    """A picture that is shown well needs no advice, and no exposure helps a black one."""
    assert suggest_exposure(np.full((2, 2, 3), 0.18)) is None
    assert suggest_exposure(np.zeros((2, 2, 3))) is None
