"""Gathering in waves, as on a GPU: every pixel has the same light, and the threads of a warp have the same VPLs."""

import numpy as np
import pytest
import warp as wp

import warp_ir as ir
import warp_ir.vpl.sets
from tests.physics.scenes import box_with_lights
from tests.stages import SCENES
from warp_ir.device.launcher import Launcher
from warp_ir.estimators import wavefront
from warp_ir.procedural import cornell_box, floor
from warp_ir.renderer import Renderer
from warp_ir.scene import Light, LightKind

pytestmark = pytest.mark.extended

SETTINGS = {"width": 40, "height": 36, "iterations": 2, "filter": False}


def in_waves(scene, **settings):
    """A film and its renderer that gathers in waves, as it would on a GPU."""
    renderer = Renderer(scene, ir.RenderSettings(**{**SETTINGS, **settings}))
    renderer.launcher.wavefront = True
    film = renderer.new_film()
    for iteration in range(film.settings.iterations):
        renderer.add_iteration(film, iteration)
    return film, renderer


def lit_from_far():
    """A floor under the sky, whose VPLs are directions."""
    return floor(Light("sky", LightKind.DOME, (1.0,) * 3))


def shaped():
    """Lights with cones, focus and links."""
    return ir.load_usd(SCENES / "light_types.usda")


@pytest.mark.parametrize(
    "scene, settings",
    [
        (cornell_box, {}),
        (cornell_box, {"light_paths": 1 << 15}),  # hundreds of sets
        (cornell_box, {"max_bounces": 0}),
        (cornell_box, {"data_window": (0.1, 0.2, 0.8, 0.9)}),
        (box_with_lights, {}),
        (shaped, {}),
        (lit_from_far, {}),
    ],
)
def test_the_picture_is_the_same(scene, settings, monkeypatch):
    """Waves give every pixel the light that gathering in blocks gives it, since they draw the same VPLs.

    The sums are the same up to the order of a few additions, 1e-5 in terms of float32. A target of the systematic
    sampling can fall between the two sums, in a pixel of thousands, which then has another VPL.
    """
    monkeypatch.setattr(warp_ir.vpl.sets, "MAX_SETS_OF_BLOCKS", warp_ir.vpl.sets.MAX_SETS)
    expected = ir.render(scene(), ir.RenderSettings(**{**SETTINGS, **settings})).radiance()
    found = in_waves(scene(), **settings)[0].radiance()
    different = np.abs(found - expected).max(axis=2) > 1e-5 * (expected.max(axis=2) + expected.mean())
    assert different.mean() <= 0.002
    assert found.mean() == pytest.approx(expected.mean(), rel=1e-3)


@pytest.mark.parametrize("how", ["short waves", "no order"])
def test_the_order_of_threads_changes_no_bit(how, monkeypatch):
    """The light of a pixel does not depend on the thread and the wave that compute it."""
    expected = in_waves(shaped())[0].radiance()
    if how == "no order":
        monkeypatch.setattr(wavefront, "_KEY_BITS", 0)
    else:
        monkeypatch.setattr(wavefront, "MAX_WAVE", 1000)
    np.testing.assert_array_equal(in_waves(shaped())[0].radiance(), expected)


def test_a_warp_loads_one_set():
    """Pixels are in the order of their sets, and those that reflect nothing come last.

    So of the warps of 32 threads only those between two sets have more than one: fewer than there are sets.
    """
    film, renderer = in_waves(cornell_box(), width=128, height=128, iterations=1, light_paths=4096)
    size = film.width * film.height
    keys = renderer._scratch.array("wave.keys", 2 * size, wp.int32).numpy()[:size]
    order = renderer._scratch.array("wave.order", 2 * size, wp.int32).numpy()[:size]
    background = int((renderer._gbuffer.mesh.numpy() < 0).sum())
    sets = len(np.unique(keys[: size - background]))
    assert sets >= 16
    assert (np.diff(keys) >= 0).all() and sorted(order) == list(range(size))
    assert (keys[size - background :] == wavefront._REFLECTS_NOTHING).all()
    warps = keys.reshape(-1, 32)
    assert (warps.min(axis=1) != warps.max(axis=1)).sum() <= sets


def test_a_gpu_traces_as_many_paths_as_it_holds():
    """An H200 has 132 multiprocessors with room for 384 threads that trace rays; 32768 is the power of two below."""
    launcher = Launcher()
    assert launcher.max_light_paths() == 4096

    class Device:
        sm_count = 132

    launcher.device = Device()
    assert launcher.max_light_paths() == 32768
    assert ir.RenderSettings(width=1920, height=1080).resolve(max_paths=32768).light_paths == 32768
    assert ir.RenderSettings(width=128, height=128).resolve(max_paths=32768).light_paths == 2048


def test_modules_are_compiled_side_by_side(monkeypatch):
    """Where gathering is in waves, as on a GPU, everything is asked for at once, and before the upload."""
    asked = []
    plain = Launcher.__init__

    def as_on_a_gpu(self, *args):
        plain(self, *args)
        self.wavefront = True

    monkeypatch.setattr(Launcher, "__init__", as_on_a_gpu)
    monkeypatch.setattr(Launcher, "load", lambda _, modules: asked.append([m.__name__ for m in modules]))
    monkeypatch.setattr(Renderer, "_upload", lambda *_: asked.append("upload"))
    Renderer(cornell_box(), ir.RenderSettings(**{**SETTINGS, "filter": True}))
    first, upload = asked
    assert upload == "upload" and len(first) == len(set(first)) > 6
    assert {"warp_ir.vpl.emission", "warp_ir.estimators.wavefront"} <= set(first)
