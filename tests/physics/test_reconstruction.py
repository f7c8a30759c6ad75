"""The filter takes noise away, leaves what is sharp, and in the end leaves the mean alone."""

import dataclasses

import numpy as np
import pytest

import warp_ir as ir
from tests.physics.closed_form import render
from warp_ir.metrics import relative_mse
from warp_ir.procedural import cornell_box, furnace

pytestmark = pytest.mark.extended


def rms(a, b):
    return float(np.sqrt(np.mean((np.asarray(a, np.float64) - b) ** 2)))


@pytest.fixture(scope="module")
def truth():
    """The Cornell box, path traced; its own error is a tenth of what is asked below."""
    return render(cornell_box(), "path", width=48, height=48, iterations=4096).radiance()


def test_it_takes_noise_away(truth, device):
    """Filtered, two iterations have less than half the error below the lamp, whose edge is no matter of noise."""
    few = render(cornell_box(), "vpl", device, width=48, height=48, iterations=2, filter=True)
    raw = render(cornell_box(), "vpl", device, width=48, height=48, iterations=2)
    few, raw = few.radiance()[12:], raw.radiance()[12:]
    assert relative_mse(few, truth[12:]) < 0.5 * relative_mse(raw, truth[12:])


def test_its_bias_vanishes_with_the_noise(device):
    """The distance between picture and plain mean is bound by the standard error, and falls with it."""
    distances = []
    for iterations in (16, 256):
        pictures = [
            render(cornell_box(), "vpl", device, width=32, height=32, iterations=iterations, filter=f).radiance()
            for f in (False, True)
        ]
        distances.append(rms(*pictures))
    assert distances[1] < 0.5 * distances[0]


def test_a_uniform_room_stays_uniform(device):
    """Where irradiance does not vary the filter changes nothing but the noise."""
    film = render(furnace(0.5, shape="cube"), "vpl", device, width=32, height=32, iterations=16, filter=True)
    raw = render(furnace(0.5, shape="cube"), "vpl", device, width=32, height=32, iterations=16)
    assert film.radiance().std() < 0.5 * raw.radiance().std()
    assert film.radiance().mean() == pytest.approx(2.0, rel=0.01)


def test_albedo_and_emission_stay_sharp(device):
    """Neighbouring pixels of one wall keep their own albedo and emission: only irradiance is shared."""
    scene = furnace(0.5, 1.0, shape="cube")
    colors = np.zeros((12, 3, 3), np.float32)
    colors[::2] = (0.8, 0.2, 0.2)
    colors[1::2] = (0.2, 0.2, 0.8)
    scene = dataclasses.replace(scene, meshes=(dataclasses.replace(scene.meshes[0], colors=colors),))
    film = render(scene, "vpl", device, width=32, height=32, iterations=8, filter=True)
    albedo, radiance = film.aov("albedo"), film.radiance()
    inside = (np.abs(albedo[..., 0] - 0.8) < 1e-3) | (np.abs(albedo[..., 0] - 0.2) < 1e-3)
    irradiance = (radiance[inside] - 1.0) / albedo[inside]
    assert irradiance.std() / irradiance.mean() < 0.25  # the corners are darker or brighter; mixed albedos gave 0.6


def test_thin_rims_lose_their_bias_too(device):
    """A pixel whose centre shows nothing takes its light from neighbours; where they are lit otherwise, it learns."""
    pictures = {}
    for filtered in (False, True):
        film = render(cornell_box(), "vpl", device, width=64, height=64, iterations=256, filter=filtered)
        pictures[filtered] = film.radiance().mean(axis=-1)
    rim = (film.aov("alpha") > 0.0) & (film.aov("alpha") < 0.5)
    rim &= pictures[False] < 0.5  # not the lamp's
    assert rim.sum() > 50
    # Both pictures look along the same rays. Lit like their neighbours alone, these pixels would be 9 % too dark.
    assert pictures[True][rim].sum() == pytest.approx(pictures[False][rim].sum(), rel=0.02)


def test_direct_and_indirect_add_up(device):
    """The two parts of a filtered picture are the picture."""
    film = render(cornell_box(), "vpl", device, iterations=4, filter=True)
    np.testing.assert_allclose(film.aov("direct") + film.aov("indirect"), film.radiance(), rtol=1e-6)


def test_two_films_filter_as_one(device):
    """Merging adds what the filter has observed, too."""
    from warp_ir.renderer import Renderer

    settings = ir.RenderSettings(width=16, height=16, light_paths=64)
    renderer = Renderer(cornell_box(), settings, device=device)
    whole, one, two = (renderer.new_film() for _ in range(3))
    for i in range(4):
        renderer.add_iteration(whole, i)
        renderer.add_iteration(one if i < 2 else two, i)
    one.merge(two)
    np.testing.assert_allclose(one.radiance(), whole.radiance(), rtol=1e-4, atol=1e-7)


def test_a_picture_needs_no_renderer(device):
    """The filter works in the renderer's memory while that is there, and else in its own: the same bits."""
    settings = ir.RenderSettings(width=24, light_paths=64)
    films = []
    for _ in range(2):
        renderer = ir.Renderer(cornell_box(), settings, device=device)
        films.append(renderer.new_film())
        for iteration in range(2):
            renderer.add_iteration(films[-1], iteration)
    first = films[0].radiance()  # whose renderer is gone
    np.testing.assert_array_equal(first, films[1].radiance())
    renderer.add_iteration(films[1], 2)  # a picture spoils nothing that the next iteration needs
    renderer.add_iteration(films[0], 2)
    np.testing.assert_array_equal(films[0].radiance(), films[1].radiance())


def test_denoise_needs_its_extra(monkeypatch):
    """Without the denoiser, asking for it is an error before any work, which says what to install."""
    import sys

    monkeypatch.setitem(sys.modules, "pyoidn", None)
    with pytest.raises(ir.InputError, match=r"warp-ir\[denoise\]"):
        ir.render(cornell_box(), ir.RenderSettings(width=8, height=8, iterations=2, denoise=True))


def test_time_for_the_denoiser_is_kept(monkeypatch):
    """Of a time limit the rays get what the denoiser will not need: a slow one leaves them little."""
    pytest.importorskip("pyoidn")
    monkeypatch.setattr("warp_ir.renderer.denoise_seconds", lambda pixels, time_limit=None: 9.5)
    film = ir.render(cornell_box(), ir.RenderSettings(width=16, height=16, time_limit=10.0, denoise=True))
    assert 1 <= film.iterations and film.seconds < 5.0


def test_the_denoiser_hurries_where_time_is_short():
    """The smaller network is for pictures whose time the larger one would use up."""
    pytest.importorskip("pyoidn")
    from warp_ir.film.denoise import denoise_seconds

    full = denoise_seconds(10**5)
    assert denoise_seconds(10**5, 100.0 * full) == full
    assert 0.0 < denoise_seconds(10**5, full) < 0.5 * full


def test_denoised_and_filtered(truth):
    """The errors of two unlike filters are hardly related: their mean has less than either."""
    pytest.importorskip("pyoidn")
    how = [{"filter": True}, {"denoise": True, "filter": False}, {"denoise": True, "filter": True}]
    errors = []
    for flags in how:
        film = render(cornell_box(), "vpl", width=48, height=48, iterations=4, **flags)
        errors.append(relative_mse(film.radiance()[12:], truth[12:]))
    assert errors[2] < 0.9 * min(errors[:2])


def test_denoised_picture(truth):
    """Denoised, four iterations are better than their plain mean, below the lamp."""
    pytest.importorskip("pyoidn")
    raw = render(cornell_box(), "vpl", width=48, height=48, iterations=4)
    smooth = render(cornell_box(), "vpl", width=48, height=48, iterations=4, denoise=True)
    smooth, raw = smooth.radiance()[12:], raw.radiance()[12:]
    assert relative_mse(smooth, truth[12:]) < relative_mse(raw, truth[12:])
