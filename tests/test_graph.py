"""Iterations that are launched as a graph: the same launches, the same bits, one call and one wait.

Warp records and replays graphs on the CPU as well; a renderer uses them there if its launcher is told to.
"""

import numpy as np
import pytest
import warp as wp

import warp_ir as ir
from tests.physics.scenes import box_with_lights
from tests.test_cuda import blind
from warp_ir.device.launcher import Cancelled, Launcher
from warp_ir.procedural import cornell_box
from warp_ir.renderer import Renderer
from warp_ir.settings import GuidingSettings

pytestmark = pytest.mark.extended

SETTINGS = {"width": 40, "height": 36, "iterations": 5, "light_paths": 64}


def as_on_a_gpu(scene, *, graphs, **settings):
    """A renderer that does on the CPU what it would do on a GPU."""
    renderer = Renderer(scene, ir.RenderSettings(**{**SETTINGS, **settings}), guiding=GuidingSettings(1))
    renderer.launcher.wavefront, renderer.launcher.synchronous = True, False
    renderer.launcher.graphs = graphs
    return renderer


def rendered(renderer):
    film = renderer.new_film()
    for iteration in range(film.settings.iterations):
        renderer.add_iteration(film, iteration)
    renderer.report_profile(film)
    return film


@pytest.fixture
def launched(monkeypatch):
    """The names of what is launched, in order, sorts and scans and graphs included."""
    names = []

    def log(owner, name, label):
        plain = getattr(owner, name)

        def wrapped(*args, **keywords):
            names.append(label(args))
            return plain(*args, **keywords)

        monkeypatch.setattr(owner, name, wrapped)

    log(Launcher, "launch", lambda args: args[1].key)
    log(wp.utils, "radix_sort_pairs", lambda _: "sort")
    log(wp.utils, "array_scan", lambda _: "scan")
    log(wp, "capture_launch", lambda _: "graph")
    return names


@pytest.mark.parametrize(
    "scene, settings",
    [
        (cornell_box, {}),
        (box_with_lights, {}),
        (box_with_lights, {"estimator": "keller"}),
        (box_with_lights, {"estimator": "path"}),
        (cornell_box, {"filter": False, "max_bounces": 0}),
    ],
)
def test_graphs_change_no_bit(scene, settings):
    """The picture, its error and all counts are those of launching kernel by kernel.

    The guide is learned for iteration 1, with VPLs that it need not make again: its launches differ from those before
    and after. It and iterations 0 and 2 are launched kernel by kernel.
    """
    plain, graph = (rendered(as_on_a_gpu(scene(), graphs=graphs, **settings)) for graphs in (False, True))
    np.testing.assert_array_equal(graph.radiance(), plain.radiance())
    np.testing.assert_array_equal(graph.standard_error(), plain.standard_error())
    guided = settings.get("estimator", "vpl") == "vpl"
    assert graph.counts.pop("graph_launches") == (2 if guided else 4) and plain.counts.pop("graph_launches") == 0
    assert graph.counts == plain.counts


def test_launches_of_an_iteration(launched, monkeypatch):
    """An iteration is some twenty launches, the same ones each time; a graph is one. The host waits once for either."""
    renderer = as_on_a_gpu(cornell_box(), graphs=True)
    film = renderer.new_film()
    renderer.add_iteration(film, 0)
    renderer.add_iteration(film, 1)  # learns the guide
    launched.clear()
    renderer.add_iteration(film, 2)
    plain = launched.copy()
    assert plain == [
        *("_trace_primary", "_trace_light_paths", "scan", "_store_light_paths", "_trace_light_paths"),
        *("_divide_into_sets", "sort", "_pack", "_pack_slots"),  # `_pack` is for the CPU's lanes
        *("_write_keys", "sort", "_draw_vpls", "_send_shadow_rays", "_compensate"),
        *("scan", "_list_continuing", "_gather_pixels"),
        *("_add_iteration", "_accumulate_samples"),
    ]
    launched.clear()
    renderer.add_iteration(film, 3)
    assert launched == [*plain, "graph"]  # recorded, then run
    launched.clear()
    with blind(monkeypatch) as waits:
        renderer.add_iteration(film, 4)
        assert launched == ["graph"] and len(waits) == 1


def test_a_graph_is_made_anew_when_something_changes():
    """Another film, or other tiles, are other launches: they are made kernel by kernel before they are recorded."""
    pictures, graphs = [], []
    for use in (False, True):
        renderer = as_on_a_gpu(cornell_box(), graphs=use)
        films = [renderer.new_film(), renderer.new_film()]
        for iteration in range(8):
            if iteration == 4:
                tiles = np.ones_like(films[0].chosen)
                tiles[::2] = False
                films[0].choose(tiles)
            renderer.add_iteration(films[0], iteration)
        for iteration in range(3):
            renderer.add_iteration(films[1], iteration)
        pictures.append([film.radiance() for film in films])
        graphs.append(renderer.launcher.profile.counts["graph_launches"])
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert graphs == [0, 1 + 3 + 1]


def test_where_recording_fails_kernels_are_launched(monkeypatch):
    """A driver that records no graph costs time and a warning, and the picture is the same."""

    def fail(*_):
        raise RuntimeError("no graphs here")

    expected = rendered(as_on_a_gpu(cornell_box(), graphs=False))
    monkeypatch.setattr(Launcher, "record", fail)
    renderer = as_on_a_gpu(cornell_box(), graphs=True)
    with pytest.warns(RuntimeWarning, match="no graphs here"):
        film = rendered(renderer)
    np.testing.assert_array_equal(film.radiance(), expected.radiance())
    assert film.counts == expected.counts and not renderer.launcher.graphs


def test_a_cancelled_iteration_is_not_added():
    """A graph that has begun runs to its end; one that has not is left out, and so is the iteration."""
    renderer = as_on_a_gpu(cornell_box(), graphs=True)
    film = rendered(renderer)
    before = film.radiance()
    renderer.launcher.cancel()
    with pytest.raises(Cancelled):
        renderer.add_iteration(film, 5)
    renderer.launcher.resume()
    assert film.iterations == 5
    np.testing.assert_array_equal(film.radiance(), before)
