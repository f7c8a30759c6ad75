"""The filter takes noise away, leaves what is sharp, and in the end leaves the mean alone."""

import dataclasses

import numpy as np
import pytest
import warp as wp

import warp_ir as ir
from tests.physics.closed_form import placed, render, rotation_x
from warp_ir.metrics import relative_mse
from warp_ir.procedural import cornell_box, cube, furnace, mesh
from warp_ir.reconstruction.filter import filter_layer, new_layer
from warp_ir.reconstruction.pixel_surfaces import PixelSurfaces
from warp_ir.scene import LightKind, Shaping

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


def around_the_corner():
    """A corridor whose lamp is round the corner: few paths reach what the camera sees, and they are bright there."""
    walls = {
        "floor": ((-2, -1.1, -7), (7, -1, 3)), "ceiling": ((-2, 1, -7), (7, 1.1, 3)),
        "left": ((-1.1, -1.1, -7), (-1, 1.1, 3)), "right": ((1, -1.1, -4), (1.1, 1.1, 3)),
        "back": ((-2, -1.1, -6.1), (7, 1.1, -6)), "front": ((1, -1.1, -4), (7, 1.1, -3.9)),
        "end": ((6, -1.1, -7), (6.1, 1.1, -3)), "behind": ((-2, -1.1, 2), (2, 1.1, 2.1)),
    }  # fmt: skip
    points, triangles = cube(1.0)
    meshes = [
        mesh(name, np.array(low) + (points + 0.5) * (np.array(high) - low), triangles)
        for name, (low, high) in walls.items()
    ]
    lamp = ir.Light(
        "lamp", LightKind.RECT, (40.0,) * 3, placed(rotation_x(-90.0), (5.0, 0.99, -5.0)), width=0.5, height=0.5
    )
    camera = ir.Camera.look_at((0.0, 0.0, 1.9), (0.0, -0.1, -5.0), fov=60.0)
    return ir.Scene(tuple(meshes), (ir.Material("grey", (0.6,) * 3),), lights=(lamp,), camera=camera)


def focused(shaping):
    """A room with a small lamp of a given shaping."""
    lamp = ir.Light("lamp", LightKind.DISK, (400.0,) * 3, placed(rotation_x(-75.0), (0.3, 1.9, 0.3)), radius=0.05,
                    shaping=shaping)  # fmt: skip
    camera = ir.Camera.look_at((0.0, 0.2, 1.95), (0.0, -0.3, -1.0), fov=75.0)
    grey = ir.Material("grey", (0.6,) * 3)
    return ir.Scene((mesh("room", *cube(4.0, inward=True)),), (grey,), lights=(lamp,), camera=camera)


def ring(width):
    """An IES profile: a ring of a given width [degrees], 40 degrees off the axis."""
    return Shaping(profile=np.exp(-((((np.arange(180.0) + 0.5) - 40.0) / width) ** 2))[:, None] * np.ones((1, 8)))


@pytest.mark.parametrize("iterations", [1, 2, 8])
@pytest.mark.parametrize(
    "scene, size",
    [(around_the_corner(), 48), (focused(Shaping(focus=50.0)), 48), (focused(ring(3.0)), 48), (focused(ring(0.6)), 24)],
    ids=["corridor", "spot", "ring", "thin_ring"],
)
def test_it_neither_darkens_nor_brightens(scene, size, iterations, device):
    """The filtered picture has the mean of the plain one within 0.3 %, from the first iteration on.

    Both are made of the same samples, so that their noise is no difference; the camera rays on edges are, of which the
    filtered picture has more: their part is told by the spread over seeds. A filter that measures a difference by the
    noise of the one pixel alone darkens by up to 13 %: what is dim by chance has little.
    """
    ratios = []
    for seed in range(4):
        settings = ir.RenderSettings(width=size, height=size, iterations=iterations, seed=seed)
        plain = ir.render(scene, dataclasses.replace(settings, filter=False), device=device)
        filtered = ir.render(scene, settings, device=device)
        ratios.append(filtered.radiance().mean(dtype=float) / plain.radiance().mean(dtype=float))
    standard_error = np.std(ratios, ddof=1) / np.sqrt(len(ratios))
    assert standard_error < 0.01
    assert abs(np.mean(ratios) - 1.0) < 3e-3 + 2.0 * standard_error


def test_the_filter_loses_no_light(launcher):
    """On one surface, light that a pixel gives is light that another gets: the sum stays, whatever noise is claimed."""
    size = 40
    random = np.random.default_rng(0)
    y, x = np.divmod(np.arange(size * size), size)
    surfaces = PixelSurfaces()
    surfaces.columns = surfaces.rows = size
    surfaces.position = launcher.array(np.stack([x, y, np.zeros(size * size)], axis=-1) / size, wp.vec3)
    surfaces.normal = launcher.array(np.tile((0.0, 0.0, 1.0), (size * size, 1)), wp.vec3)
    surfaces.footprint = launcher.array(random.uniform(0.5, 2.0, size * size) / size, wp.float32)
    surfaces.edge = launcher.zeros(size * size, wp.uint8)
    rows = np.concatenate([random.exponential(1.0, (2, size * size, 3)), random.random((2, size * size, 1))], -1)
    rows[..., 3] *= rows[..., 0] ** 2  # what is dim claims little noise
    layer = new_layer(*(launcher.array(part, wp.vec4) for part in rows))
    scratch = new_layer(*(launcher.empty(size * size, wp.vec4) for _ in range(2)))
    out, _ = filter_layer(surfaces, layer, scratch, launcher)
    for before, after in zip(rows, (out.direct.numpy(), out.indirect.numpy()), strict=True):
        # Each of four levels rounds a value of the layer by some 10 units in the last place.
        np.testing.assert_allclose(after[:, :3].sum(axis=0, dtype=float), before[:, :3].sum(axis=0), rtol=40 * 2.0**-23)
        assert after[:, :3].std() < 0.8 * before[:, :3].std()  # it does filter


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
    """Where irradiance does not vary the filter changes nothing but the noise.

    On one wall it leaves less than the means over blocks of 4 x 4 pixels have: the noise that pixels share, and a
    quarter of each one's own, for its smallest step alone averages 5 x 5. In the room the edges are the noisiest, and
    pixels there have fewer neighbours on their own wall.
    """
    room = furnace(0.5, shape="cube")
    wall = dataclasses.replace(room, camera=ir.Camera.look_at((0.2, 0.1, 0.3), (0.0, 0.0, -1.0), fov=50.0))
    for scene in (room, wall):
        filtered, raw = (
            render(scene, "vpl", device, width=32, height=32, iterations=16, filter=f).radiance() for f in (True, False)
        )
        bound = raw if scene is room else raw.reshape(8, 4, 8, 4, 3).mean(axis=(1, 3))
        assert filtered.std() < bound.std()
        assert filtered.mean() == pytest.approx(2.0, rel=0.01)


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
    films, scene = [], cornell_box()
    for _ in range(2):
        renderer = ir.Renderer(scene, settings, device=device)
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
