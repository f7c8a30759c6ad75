"""Films add, and say how sure they are."""

import base64
import math
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import warp_ir as ir
from warp_ir.device.launcher import Launcher
from warp_ir.procedural import cornell_box, furnace
from warp_ir.renderer import Renderer

SETTINGS = ir.RenderSettings(width=12, height=8, light_paths=32, iterations=6, filter=False)


def test_half_and_half_is_the_whole(device):
    """Iterations 0-2 and 3-5 in two films, merged, are iterations 0-5 in one."""
    renderer = Renderer(cornell_box(), SETTINGS, device=device)
    whole, one, two = (renderer.new_film() for _ in range(3))
    for i in range(6):
        renderer.add_iteration(whole, i)
        renderer.add_iteration(one if i < 3 else two, i)
    one.merge(two)
    assert one.iterations == 6
    np.testing.assert_allclose(one.radiance(), whole.radiance(), rtol=1e-6)
    np.testing.assert_allclose(one.standard_error(), whole.standard_error(), rtol=1e-4, atol=1e-9)
    for name in ir.Film.AOV_NAMES:
        np.testing.assert_allclose(one.aov(name), whole.aov(name), rtol=1e-4, atol=1e-4)


def test_save_and_load(tmp_path, device):
    """A film read back is the same, bit for bit, and goes on from there."""
    film = ir.render(cornell_box(), SETTINGS, device=device)
    film.save(tmp_path / "film.npz")
    back = ir.Film.load(tmp_path / "film.npz", device)
    assert (back.width, back.height, back.iterations) == (12, 8, 6)
    np.testing.assert_array_equal(back.radiance(), film.radiance())
    np.testing.assert_array_equal(back.aov("position"), film.aov("position"))
    back.merge(film)
    assert back.iterations == 12
    with pytest.raises(ir.InputError, match="no such file"):
        ir.Film.load(tmp_path / "missing.npz")


def test_aovs_of_a_known_view(device):
    """In the Cornell box: alpha is 1 in the middle, depth of the back wall 800 + 559.2, normals face the camera."""
    film = ir.render(cornell_box(), ir.RenderSettings(width=64, height=64, light_paths=1, iterations=4), device=device)
    top = film.aov("position")[6, 32]
    assert film.aov("alpha")[32, 32] == 1.0
    back = film.aov("position")[22, 40]
    np.testing.assert_allclose(back[2], 559.2, rtol=1e-4)
    np.testing.assert_allclose(film.aov("depth")[22, 40], 800.0 + 559.2, rtol=1e-4)
    np.testing.assert_allclose(film.aov("normal")[22, 40], [0, 0, -1], atol=1e-6)
    np.testing.assert_allclose(film.aov("albedo")[22, 40], [0.725, 0.71, 0.68], rtol=1e-5)
    assert cornell_box().meshes[film.aov("prim_id")[22, 40]].name == "back"
    assert top[1] == pytest.approx(548.8, rel=1e-3)
    with pytest.raises(ir.InputError, match="no 'colour'"):
        film.aov("colour")


def test_an_empty_film(device):
    """Before the first iteration a film is black, uncertain and covers nothing."""
    film = Renderer(furnace(level=1), SETTINGS, device=device).new_film()
    assert film.radiance().max() == 0.0 and math.isnan(film.error())
    assert np.isinf(film.standard_error()).all()
    assert film.aov("alpha").max() == 0.0 and film.aov("prim_id").max() == -1


def test_films_of_different_size_do_not_merge(device):
    """Merging needs the same number of pixels."""
    renderer = Renderer(furnace(level=1), SETTINGS, device=device)
    other = Renderer(furnace(level=1), ir.RenderSettings(width=5, height=5), device=device)
    with pytest.raises(ir.InputError, match="cannot merge 5x5 into 12x8"):
        renderer.new_film().merge(other.new_film())
    dark = Renderer(furnace(0.5, 0.0, level=1), SETTINGS, device=device)
    with pytest.raises(ir.InputError, match="a film with emission and one without"):
        renderer.new_film().merge(dark.new_film())


def test_iterations_of_another_scene_are_refused(device):
    """A film takes iterations of the scene that it was made for, and none after that was replaced."""
    renderer = Renderer(furnace(level=1), SETTINGS, device=device)
    film = renderer.new_film()
    renderer.add_iteration(film, 0)
    with pytest.raises(ir.InputError, match="film: is not of this renderer's present scene"):
        Renderer(furnace(level=1), SETTINGS, device=device).add_iteration(film, 1)
    renderer.update(furnace(0.3, level=1))
    with pytest.raises(ir.InputError, match="film: is not of this renderer's present scene"):
        renderer.add_iteration(film, 1)


def test_other_settings_of_a_renderer_give_the_picture_of_a_new_one(device):
    """`update` with settings: the same bits as a renderer that had them from the start; refused ones change nothing."""
    scene = furnace(0.5, level=1)
    small, large = (ir.RenderSettings(width=n, height=n, iterations=2, light_paths=64, filter=n > 8) for n in (8, 12))
    renderer = Renderer(scene, small, device=device)
    renderer.render()
    renderer.update(scene, large)
    expected = Renderer(scene, large, device=device).render().radiance()
    assert (renderer.render().radiance() == expected).all()
    renderer.launcher.memory = lambda: 1e6
    with pytest.raises(ir.InputError, match="12345 x 12 pixels need"):
        renderer.update(scene, replace(large, width=12345))
    assert renderer.settings == renderer.wanted == large


def test_threads_take_turns(device):
    """Films of one renderer that three threads fill at the same time have the bits of films filled alone."""
    renderer = Renderer(cornell_box(), ir.RenderSettings(width=24, light_paths=64, iterations=4), device=device)
    expected = renderer.render().radiance()
    with ThreadPoolExecutor(3) as threads:
        films = [threads.submit(renderer.render) for _ in range(3)]
    for film in films:
        np.testing.assert_array_equal(film.result().radiance(), expected)


def test_a_notebook_shows_picture_time_and_error(device):
    """The page of a film holds its picture as PNG, and says how many iterations it has and what error."""
    film = Renderer(furnace(level=1), SETTINGS, device=device).render()
    page = film._repr_html_()
    data = base64.b64decode(re.search(r"base64,([^\"]+)", page).group(1))
    assert data.startswith(b"\x89PNG") and f"{film.iterations} iterations" in page and "estimated error" in page


def test_values_that_are_not_finite_stay_out(device):
    """A sample of infinity or NaN counts as black and is counted; the others of the pixel stand."""
    renderer = Renderer(furnace(0.0, 1.0, level=1), SETTINGS, device=device)
    film = renderer.new_film()
    renderer.add_iteration(film, 0)
    bad = np.full((96, 3), 1.0, np.float32)
    bad[5], bad[6, 1] = np.inf, np.nan
    renderer._gbuffer.normal_or_direct.assign(bad)
    film.accumulate(renderer._gbuffer)
    film.count_iteration()
    assert film.rejected == 2
    image = film.radiance().reshape(-1, 3)
    np.testing.assert_array_equal(image[[5, 6]], 0.5)
    np.testing.assert_array_equal(image[7:], 1.0)


@pytest.mark.extended
def test_long_renders_do_not_drift(device):
    """The mean of ten thousand iterations is as good as float32 can say it, and the deviation as needs be.

    A step rounds the mean by 2^-24 at most, uniformly, and what step k did has the weight k/n in the end: an RMS of
    less than 2^-25 √(n/6), of which a few hundred numbers do not exceed 6. A standard deviation is only known to
    1/√(2n) of itself: rounding takes less than a hundredth of that.
    """
    n = 10_000
    renderer = Renderer(furnace(1.0, 0.0, level=1), SETTINGS, device=device)
    film = renderer.new_film()
    renderer.add_iteration(film, 0)
    samples = np.random.default_rng(0).random((n, 96, 3)).astype(np.float32)
    renderer._gbuffer.indirect.zero_()
    film = renderer.new_film()
    for sample in samples:
        renderer._gbuffer.normal_or_direct.assign(sample)
        film.accumulate(renderer._gbuffer)
        film.count_iteration()
    mean, error = film.radiance().reshape(96, 3), film.standard_error().reshape(96, 3)
    expected = samples.mean(axis=0, dtype=np.float64), samples.std(axis=0, ddof=1, dtype=np.float64) / math.sqrt(n)
    np.testing.assert_allclose(mean, expected[0], rtol=6.0 * 2.0**-25 * math.sqrt(n / 6.0))
    np.testing.assert_allclose(error, expected[1], rtol=0.01 / math.sqrt(2.0 * n))


def test_a_film_has_its_own_time():
    """What a renderer spent on earlier films is not taken for what the filter of the next one will need."""
    renderer = Renderer(cornell_box(), ir.RenderSettings(width=16, iterations=4, time_limit=100.0, light_paths=16))
    renderer.launcher.profile.add("primary", 1000.0)
    assert renderer.render().iterations == 4


def test_progress_has_the_picture_so_far():
    """The callback after iteration n sees the mean of n iterations; the last picture is that of the film."""
    pictures = []
    settings = ir.RenderSettings(width=8, height=8, iterations=3, light_paths=16, filter=False)
    film = ir.render(cornell_box(), settings, progress=lambda p: pictures.append(p.film.radiance().copy()))
    assert len(pictures) == 3 and np.array_equal(pictures[2], film.radiance())
    first = ir.render(cornell_box(), replace(settings, iterations=1)).radiance()
    assert np.array_equal(pictures[0], first) and not np.array_equal(pictures[0], pictures[1])


def test_cancelled_films_hold_whole_iterations(monkeypatch):
    """`cancel` while an iteration is being added waits until it is: no pixel has it without the others."""
    settings = ir.RenderSettings(width=32, height=32, light_paths=64)
    films = []
    for cancels in (False, True):
        renderer = Renderer(cornell_box(), settings)
        film = renderer.new_film()
        renderer.add_iteration(film, 0)
        if cancels:
            add, cancel = film.accumulate, renderer.launcher.cancel
            monkeypatch.setattr(film, "accumulate", lambda *rows, add=add, cancel=cancel: (cancel(), add(*rows)))
        renderer.add_iteration(film, 1)
        renderer.launcher.resume()
        films.append(film)
    assert films[1].iterations == 2
    np.testing.assert_array_equal(films[0].radiance(), films[1].radiance())


def test_timings_and_counts_are_those_of_one_film():
    """A renderer's films have their own rays and their own time; what comes before all belongs to the first."""
    renderer = Renderer(cornell_box(), ir.RenderSettings(width=16, height=16, iterations=2, light_paths=16))
    films = [renderer.render() for _ in range(3)]
    rays = {film.counts["primary_rays"] for film in films}
    assert rays == {3 * 256}  # two iterations, and the look through the centres
    assert all(film.counts["iterations"] == 2 for film in films)
    assert films[0].timings["upload"] > 0.0 and films[1].timings["upload"] == films[2].timings["upload"] == 0.0
    # Every phase within the render is part of its time; reading the clock takes some as well.
    for film in films:
        assert sum(film.timings[phase] for phase in ("primary", "emission", "gather", "film")) <= film.seconds
    again = renderer.render(films[1])  # nothing is left to do
    assert again.counts["primary_rays"] == 3 * 256
    total = sum(film.timings["gather"] for film in films)
    assert total == pytest.approx(renderer.launcher.profile.seconds()["gather"])


@pytest.mark.extended
@pytest.mark.parametrize("light", ["dome", "black dome", "rect", "sun"])
def test_visible_lights_have_alpha(light, tmp_path):
    """Where the camera sees a light before nothing, alpha is 1: all around in a dome, black parts of its image too."""
    lights = {
        "dome": ir.Light("L", ir.LightKind.DOME, (1.0, 1.0, 1.0)),
        "black dome": ir.Light(
            "L", ir.LightKind.DOME, (1.0,) * 3, texture=np.eye(2, dtype=np.float32)[..., None].repeat(3, 2)
        ),
        "rect": ir.Light(
            "L", ir.LightKind.RECT, (1.0,) * 3, width=1.0, height=1.0, world_from_light=np.diag([-1.0, 1, -1, 1])
        ),
        "sun": ir.Light("L", ir.LightKind.DISTANT, (1.0,) * 3, angle=10.0, world_from_light=np.diag([-1.0, 1, -1, 1])),
    }
    points = np.array([(0.5, -9, -0.5), (9, -9, -0.5), (9, 9, -0.5), (0.5, 9, -0.5)], float)
    mesh = ir.Mesh("m", points, np.array([(0, 1, 2), (0, 2, 3)], np.int32), np.zeros(2, np.int32))
    camera = ir.Camera.look_at((0, 0, 4), (0, 0, 0))
    scene = ir.Scene((mesh,), (ir.Material(),), (lights[light],), camera=camera)
    settings = ir.RenderSettings(width=16, height=16, iterations=4, light_paths=16)
    hidden = ir.render(scene, settings)
    film = ir.render(scene, replace(settings, visible_lights=True))
    hits, alpha = hidden.aov("alpha"), film.aov("alpha")
    emitted = film._radiance_of("emission").max(axis=-1) > 0.0
    assert 0.0 < hits.mean() < 1.0 and (alpha >= hits).all()
    if "dome" in light:
        assert (alpha == 1.0).all()
    else:
        assert (alpha[emitted] > 0.0).all() and (alpha[~emitted] == hits[~emitted]).all() and emitted.any()
    film.save(tmp_path / "f.npz")
    np.testing.assert_array_equal(ir.Film.load(tmp_path / "f.npz").aov("alpha"), alpha)
    with pytest.raises(ir.InputError, match="one without"):
        film.merge(hidden)


def test_change_between_pictures_is_their_noise():
    """Pictures of 2 and 4 of the same iterations tell the noise of four; tiles without new iterations keep theirs.

    One tile has independent noise of variance 1 per iteration and channel: the sum of 192 squares is known to
    √(2/192) = 10 % in each of two doublings. Five of those; the larger of two is larger than the mean.
    """
    from warp_ir.film.picture_noise import PictureNoise

    samples = 100.0 + np.random.default_rng(0).normal(size=(4, 8, 8, 3))
    pictures = {n: samples[:n].mean(axis=0).astype(np.float32) for n in (1, 2, 4)}
    noise = PictureNoise.first(pictures[1], np.array([1], np.int32))
    for n in (2, 4):
        noise = noise.updated(pictures[n], np.array([n], np.int32))
    relative = 192 / (4 * 100.0**2 * 1.01)  # of four iterations; L² + ε is 1.01 L²
    error = noise.squared_errors(np.array([4], np.int32))
    np.testing.assert_allclose(error, 2.0 * relative, rtol=0.5)  # twice: the allowance for bias
    kept = noise.updated(pictures[4], np.array([4], np.int32))
    np.testing.assert_array_equal(kept.variance, noise.variance)
    assert np.isnan(PictureNoise.first(pictures[1], np.array([1], np.int32)).squared_errors(np.array([1]))).all()


def test_pictures_without_a_copy(device):
    """`out` gets the bits of `radiance`, in NumPy's, Warp's and DLPack's memory, of the mean and of the filter."""
    for settings in (SETTINGS, replace(SETTINGS, filter=True)):
        film = ir.render(cornell_box(), settings, device=device)
        expected = film.radiance()
        array = wp.zeros((8, 12, 3), dtype=wp.float32, device=device)
        assert film.radiance(out=array) is array
        np.testing.assert_array_equal(array.numpy(), expected)
        own = film.to_warp()
        assert str(own.device) == device and own.shape == (8, 12, 3) and own.ptr != film.to_warp().ptr
        np.testing.assert_array_equal(own.numpy(), expected)
        np.testing.assert_array_equal(wp.from_dlpack(film).numpy(), expected)
        film.merge(film)
        np.testing.assert_array_equal(own.numpy(), expected)  # it is the caller's


def test_dlpack_and_numpy_on_the_host():
    """NumPy takes films by DLPack and gives memory to write to; a tensor too, where PyTorch is installed."""
    film = ir.render(cornell_box(), SETTINGS)
    expected = film.radiance()
    assert film.__dlpack_device__() == (1, 0)  # kDLCPU
    np.testing.assert_array_equal(np.from_dlpack(film), expected)
    stack = np.zeros((2, 8, 12, 3), np.float32)
    assert film.radiance(out=stack[1]).base is stack
    np.testing.assert_array_equal(stack, [0.0 * expected, expected])
    with pytest.raises(BufferError, match="made anew"):
        film.__dlpack__(copy=False)
    with pytest.raises(BufferError, match="on cpu"):
        film.__dlpack__(dl_device=(2, 0))


def test_tensors():
    """A tensor of PyTorch is written to in place, and made from a film."""
    torch = pytest.importorskip("torch")
    film = ir.render(cornell_box(), SETTINGS)
    tensor = torch.zeros(8, 12, 3)
    assert film.radiance(out=tensor) is tensor
    np.testing.assert_array_equal(tensor.numpy(), film.radiance())
    np.testing.assert_array_equal(torch.from_dlpack(film).numpy(), film.radiance())


_FROZEN = np.zeros((8, 12, 3), np.float32)
_FROZEN.flags.writeable = False


@pytest.mark.parametrize(
    "out",
    [
        np.zeros((8, 12, 3)),
        np.zeros((12, 8, 3), np.float32),
        np.zeros((3, 12, 8), np.float32).T,
        np.zeros((8, 24, 3), np.float32)[:, ::2],
        _FROZEN,
        [[0.0]],
        wp.zeros((8, 12), dtype=wp.float32, device="cpu"),
        wp.zeros((8, 24, 3), dtype=wp.float32, device="cpu")[:, ::2],
    ],
)
def test_places_that_cannot_be_written_to(out):
    """Another type, shape or layout, memory that is read-only, and what is no array are refused in one line."""
    film = ir.Film(12, 8, Launcher("cpu"))
    with pytest.raises(ir.InputError, match=r"out: must be a C-contiguous float32 array \[8, 12, 3\] on cpu"):
        film.radiance(out=out)
