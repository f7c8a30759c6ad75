"""Parts of a render on several devices: the bits of one device, whoever has rendered what, and when."""

import importlib
import itertools
import json
import random
import signal
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

import warp_ir as ir
from warp_ir.cli import main
from warp_ir.engine import Devices, render_parts
from warp_ir.engine.executor import in_order
from warp_ir.engine.plan import Round, part_iterations, parts_of_round
from warp_ir.engine.worker import PartRenderer
from warp_ir.image.io import read_image
from warp_ir.scheduling import RoundScheduler
from warp_ir.tiles import TILE, tile_count

ROOT = Path(__file__).parent.parent
ROOM = "scenes_usd/two_rooms.usda"
SMALL = {"width": 40, "light_paths": 32}


class FakeFilm:
    """The size of a film, and how far it is."""

    def __init__(self, width, height, iterations=0):
        self.width, self.height, self.iterations = width, height, iterations
        self.chosen = np.ones(tile_count(width, height), bool)

    def parts(self, end, size, *, first=0, deadline=np.inf):
        skipped = np.zeros(len(self.chosen), np.int32)
        return list(parts_of_round(self, Round(self.chosen, skipped, deadline), end, size, first))


@pytest.mark.parametrize(("width", "height"), [(64, 48), (7680, 4320), (1, 1), (2048, 513)])
@pytest.mark.parametrize(("begin", "end", "size"), [(0, 64, 8), (3, 64, 8), (0, 1, 8), (16, 17, 1), (0, 10**5, 98)])
def test_parts_are_the_whole(width, height, begin, end, size):
    """Every sampled tile gets every iteration exactly one time, in order; no part is larger than a megapixel."""
    film = FakeFilm(width, height, begin)
    film.chosen[1::3] = False
    parts = film.parts(end, size, first=1000)
    for _, strips in itertools.groupby(parts, lambda part: part.iterations):
        strips = list(strips)
        assert len(strips) == strips[0].strips
        assert np.array_equal(sum(part.tiles.astype(int) for part in strips[:40]), film.chosen.astype(int))
        assert all(part.tiles.sum() * TILE * TILE <= 2**20 for part in strips[:1])
        if len(parts) > 100:
            break
    iterations = [number for part in parts if part.strip[0] == 0 for number in part.iterations]
    assert iterations == list(range(1000 + begin, 1000 + end))


def test_a_resumed_plan_has_the_same_parts():
    """A film that goes on where a part ended has the parts that were left; elsewhere they meet at the next boundary."""
    whole = [part.iterations for part in FakeFilm(64, 48).parts(100, 8)]
    for done in (0, 8, 48, 96):
        assert [part.iterations for part in FakeFilm(64, 48, done).parts(100, 8)] == whole[done // 8 :]
    assert [part.iterations for part in FakeFilm(64, 48, 13).parts(100, 8)][1:] == whole[2:]


def test_nothing_begins_after_the_deadline():
    """Late, a film without iterations gets one all the same, and another gets none."""
    assert FakeFilm(64, 48, 8).parts(64, 8, deadline=0.0) == []
    (part,) = FakeFilm(64, 48).parts(64, 8, deadline=0.0)
    assert part.least == 1


@pytest.mark.parametrize("kind", ["cpu", "cuda"])
def test_parts_are_worth_sending_and_not_too_many(kind):
    """Sixteen iterations are the least, and a million iterations, or frames of any size, are at most 1024 parts."""
    for pixels, total in itertools.product((1, 64 * 48, 512 * 384, 7680 * 4320), (1, 64, 10**6)):
        size = part_iterations(pixels, total, kind, rounds=False)
        assert size >= 16 and total / size <= 1024
        assert size * min(pixels, 2**20) <= max(2 * 2**27, 16 * 2**20, 2**20 * total / 1000)


def test_rounds_grow_by_a_quarter():
    """Decisions are taken after 2, 4, 8, 16, 20, 24, 28, 32, 40, ... iterations, and at the limit."""
    film = FakeFilm(8, 8)
    film.seconds, film.tile_iterations = 0.0, np.zeros(1, int)
    scheduler = RoundScheduler(film, ir.RenderSettings(target_error=0.1, iterations=50), True)
    ends = []
    while film.iterations < 50:
        film.iterations = scheduler.round_end()
        ends.append(film.iterations)
    assert ends == [2, 4, 8, 16, 20, 24, 28, 32, 40, 48, 50]
    film.iterations = 0
    assert RoundScheduler(film, ir.RenderSettings(iterations=50), False).round_end() == 50


class Chaos:
    """Finishes what has been started in any order, and notes how much there was at a time."""

    kind = "cpu"

    def __init__(self, renderer=None, seed=0, slots=3):
        self.random, self.slots, self.renderer = random.Random(seed), lambda: slots, renderer
        self.results, self.cancelled, self.most, self.open = {}, [], 0, 0

    def prepare(self, renderer):
        self.part_renderer = PartRenderer(ir.Renderer(renderer.origin, renderer.part_settings(), threads=1))

    def start(self, part):
        self.open += 1
        self.most = max(self.most, self.open)
        handle = object()
        self.results[handle] = part
        return handle

    def finished(self, running, seconds):
        return self.random.sample(running, self.random.randint(0, len(running)))

    def fetch(self, handle):
        self.open -= 1
        part = self.results.pop(handle)
        for _ in range(self.random.randint(1, 2)):  # it may have been lost, and begun anew
            samples = self.part_renderer.render(part)
        return samples

    def cancel(self, handles):
        self.cancelled += handles

    def pause(self):
        return nullcontext()


@pytest.mark.parametrize("slots", [1, 2, 7])
def test_work_comes_back_in_order(slots):
    """Whatever finishes when; no more than twice the slots have been started and not been taken."""
    tasks = Chaos(slots=slots)
    got = []
    for piece, handle in in_order(tasks, iter(range(1000)), lambda: False):
        assert tasks.results.pop(handle) == piece
        tasks.open -= 1
        got.append(piece)
    assert got == list(range(1000)) and tasks.most <= 2 * slots + 1 and not tasks.cancelled


def test_work_that_nobody_wants_is_cancelled():
    """When the caller stops, or is told to, everything that was started and not taken is cancelled."""
    tasks = Chaos(slots=4)
    for piece, handle in (finished := in_order(tasks, itertools.count(), lambda: False)):
        tasks.results.pop(handle)
        if piece == 9:
            finished.close()
            break
    assert set(tasks.cancelled) == set(tasks.results) and tasks.cancelled
    tasks = Chaos(slots=4)
    assert list(in_order(tasks, itertools.count(), lambda: len(tasks.results) > 5)) is not None
    assert set(tasks.cancelled) <= set(tasks.results)


def test_the_scheduler_at_size(monkeypatch):
    """10 000 frames, 8K and 10⁶ iterations on a virtual clock: all is done one time, and little is open at a time.

    No more than four pieces for each worker have been started and not been taken, however many there are in all.
    """
    monkeypatch.syspath_prepend(str(ROOT))
    cluster = importlib.import_module("benchmarks.cluster")
    figures = cluster.Figures(1e-6, 1.0, 1e-3, 1e-7, 156.0, 1e-6, 2e-3)
    deaths = 1.0 / 600.0  # each worker dies every ten minutes
    for workers in (1, 100):
        for outcome, parts in (
            (cluster.model_frames(10_000, 60.0, workers, figures, deaths=deaths), 10_000),
            (cluster.model_picture(7680, 4320, 64, workers, figures, deaths=deaths), 4 * 32),
            (cluster.model_picture(512, 384, 10**6, workers, figures, deaths=deaths), 1024),
        ):
            assert outcome.parts == parts and outcome.most_open <= 4 * workers
            assert outcome.lost > 0 or parts < 1000
            assert 0.0 < outcome.efficiency <= 1.0


@pytest.mark.extended
def test_modelled_figures_are_those_of_the_model(monkeypatch):
    """docs/cluster.md shows what `python -m benchmarks.cluster` makes of the figures that are stored."""
    monkeypatch.syspath_prepend(str(ROOT))
    cluster = importlib.import_module("benchmarks.cluster")
    figures = cluster.Figures(**json.loads(cluster.RESULT.read_text())["figures"])
    shown = (ROOT / "docs" / "cluster.md").read_text(encoding="utf-8")
    assert "\n".join(cluster.table(figures)) in shown


def films_of(settings, *executors, **more):
    """The films that executors make of the same picture."""
    films = []
    for executor in executors:
        renderer = ir.Renderer(ir.load_usd(more.get("stage", ROOM)), ir.RenderSettings(**SMALL | settings), threads=1)
        films.append(render_parts(renderer, executor, size=more.get("size")))
        if isinstance(executor, Devices):
            executor.close()
    return films


def assert_same(one, other):
    """Two films are the same, bit for bit."""
    assert one.iterations == other.iterations
    np.testing.assert_array_equal(one.tile_iterations, other.tile_iterations)
    np.testing.assert_array_equal(one.radiance(), other.radiance())
    np.testing.assert_array_equal(one.standard_error(), other.standard_error())
    for name in ("direct", "depth", "alpha", "prim_id"):
        np.testing.assert_array_equal(one.aov(name), other.aov(name))


@pytest.mark.extended
@pytest.mark.parametrize(
    ("settings", "more"),
    [
        ({"iterations": 13}, {"size": 4}),
        ({"iterations": 5, "filter": False}, {"size": 2}),
        ({"iterations": 6, "estimator": "path"}, {"size": 2}),
        ({"target_error": 0.1}, {"size": 3}),
        ({"target_error": 0.3, "estimator": "path"}, {}),
        ({"iterations": 6, "visible_lights": True}, {"size": 2, "stage": "scenes_usd/turntable.usda"}),
    ],
)
def test_the_picture_does_not_depend_on_who_renders_what(settings, more):
    """Two devices, and an executor that finishes parts in any order, some of them twice: the bits of one device."""
    one, two, chaos = films_of(settings, Devices(["cpu"], 1), Devices(["cpu", "cpu"], 1), Chaos(seed=1), **more)
    assert_same(one, two)
    assert_same(one, chaos)
    if "iterations" in settings:
        whole = ir.render(ir.load_usd(more.get("stage", ROOM)), ir.RenderSettings(**SMALL | settings))
        # Sums of float32 in another order, as in tests/test_parts.py.
        np.testing.assert_allclose(one.radiance(), whole.radiance(), rtol=1e-4, atol=1e-5 * whole.radiance().mean())
    else:
        assert one.error() <= settings["target_error"]


@pytest.mark.extended
def test_tiles_know_what_they_have_left_out():
    """The device knows how many iterations left out each tile, in a film alone and in that of a part.

    The pixels' samples are numbered by it.
    """
    renderer = ir.Renderer(ir.load_usd(ROOM), ir.RenderSettings(**SMALL, target_error=0.1), threads=1)
    film = renderer.render()
    left_out = film.iterations - film.tile_iterations
    assert left_out.max() > 0
    np.testing.assert_array_equal(film.tiles.skipped.numpy(), left_out)
    part = renderer.new_film()
    part.clear(film.chosen, left_out)
    for iteration in range(3):
        renderer.add_iteration(part, iteration)
    np.testing.assert_array_equal(part.tiles.skipped.numpy(), left_out + 3 * ~film.chosen)
    np.testing.assert_array_equal(part.tile_iterations, 3 * film.chosen)


@pytest.mark.extended
def test_strips_of_a_large_picture_change_no_bit(monkeypatch):
    """A picture that is divided into strips of tiles has the bits of an undivided one, adaptive or not."""
    for settings in ({"iterations": 5}, {"target_error": 0.1}):
        (whole,) = films_of(settings, Chaos(), size=2)
        with monkeypatch.context() as patch:
            patch.setattr("warp_ir.engine.plan._TILE_PIXELS", 5 * TILE * TILE)
            (strips,) = films_of(settings, Chaos(seed=2), size=2)
        assert_same(whole, strips)


@pytest.mark.extended
def test_parts_are_those_of_merge(tmp_path):
    """On the command line: two devices make the bits that `--part K/N` and `merge` make of the same parts."""
    words = ["--width", "40", "--light-paths", "32", "--iterations", "6", "-q", "--threads", "1"]
    films = []
    for number in (1, 2, 3):
        assert main(["render", ROOM, str(tmp_path / f"{number}.npy"), *words, "--part", f"{number}/3"]) == 0
        films.append(str(tmp_path / f"{number}.npy.film.npz"))
    assert main(["merge", *films, str(tmp_path / "merged.npy"), "-q"]) == 0
    several = ["--device", "cpu,cpu", "--part-iterations", "2"]
    assert main(["render", ROOM, str(tmp_path / "devices.npy"), *words, *several]) == 0
    np.testing.assert_array_equal(read_image(tmp_path / "devices.npy"), read_image(tmp_path / "merged.npy"))


@pytest.mark.extended
def test_a_part_has_parts(tmp_path):
    """`--part` on two devices is the part: merged, the picture of one render up to rounding."""
    words = ["--width", "40", "--light-paths", "32", "--iterations", "7", "-q", "--threads", "1"]
    for number in (1, 2):
        several = ["--part", f"{number}/2", "--device", "cpu,cpu", "--part-iterations", "2"]
        assert main(["render", ROOM, str(tmp_path / f"{number}.npy"), *words, *several]) == 0
    films = [str(tmp_path / f"{number}.npy.film.npz") for number in (1, 2)]
    assert main(["merge", *films, str(tmp_path / "merged.npy"), "-q"]) == 0
    assert main(["render", ROOM, str(tmp_path / "whole.npy"), *words]) == 0
    wanted = read_image(tmp_path / "whole.npy")
    np.testing.assert_allclose(read_image(tmp_path / "merged.npy"), wanted, rtol=1e-4, atol=1e-5 * wanted.mean())


@pytest.mark.extended
def test_an_interrupted_film_holds_whole_parts():
    """Ctrl-C abandons the parts that run; the film goes on to the same picture."""
    (whole,) = films_of({"iterations": 20}, Chaos(), size=2)
    renderer = ir.Renderer(ir.load_usd(ROOM), ir.RenderSettings(**SMALL, iterations=20), threads=1)
    devices = Devices(["cpu", "cpu"], 1)

    def interrupt(progress):
        if progress.iterations == 6:
            signal.raise_signal(signal.SIGINT)

    film = render_parts(renderer, devices, progress=interrupt, size=2)
    assert film.interrupted == signal.SIGINT and film.iterations == 6
    film.interrupted = 0
    assert_same(render_parts(renderer, devices, film, size=2), whole)
    devices.close()


@pytest.mark.extended
def test_a_film_goes_on_by_another_executor(tmp_path):
    """A film that was saved between two parts, also in the middle of a round, becomes the same picture."""
    for settings in ({"iterations": 12}, {"target_error": 0.08}):
        (whole,) = films_of(settings, Chaos(), size=2)
        renderer = ir.Renderer(ir.load_usd(ROOM), ir.RenderSettings(**SMALL | settings), threads=1)
        path = tmp_path / "film.npz"

        def stop(progress, path=path):
            if progress.iterations == 6:
                progress.film.save(path, "key")
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            render_parts(renderer, Chaos(seed=3), progress=stop, size=2)
        film = renderer.new_film()
        film.resume(path, "key")
        assert film.iterations == 6
        assert_same(render_parts(renderer, Chaos(seed=4), film, size=2), whole)


@pytest.mark.extended
def test_a_time_limit_holds_for_the_whole():
    """Two devices end in time; what was begun is in the film."""
    renderer = ir.Renderer(ir.load_usd(ROOM), ir.RenderSettings(**SMALL, time_limit=1.5), threads=1)
    devices = Devices(["cpu", "cpu"], 1)
    film = render_parts(renderer, devices)
    devices.close()
    assert film.iterations > 1 and film.seconds < 3.0  # other programs may take the cores meanwhile


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--workers", "2"], "--workers: has no effect without --engine ray"),
        (["--address", "a:1"], "--address: has no effect without --engine ray"),
        (["--shared-files"], "--shared-files: has no effect without --engine ray"),
        (["--part-iterations", "2"], "--part-iterations: has no effect without --engine ray or several devices"),
        (["--part-iterations", "0"], "must be a whole number of at least 1"),
        (["--engine", "ray", "--device", "cuda:1"], "a Ray cluster chooses which"),
        (["--engine", "slurm"], "invalid choice: 'slurm'"),
        (["--device", "cpu,cuda:0"], "--device: cpu, cuda:0 are of different kinds"),
        (["--device", "cuda:0,cuda:0"], "a GPU is named twice"),
    ],
)
def test_flags_that_cannot_be(capsys, words, message):
    """Flags that contradict each other, or have no effect, are refused in one line."""
    assert main(["render", ROOM, "a.npy", *words]) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1


@pytest.mark.extended
def test_a_render_alone_loads_no_engine(tmp_path):
    """Neither the engine nor Ray is imported by a render that does not ask for them."""
    words = [
        "render",
        str(ROOT / ROOM),
        str(tmp_path / "a.npy"),
        "-w",
        "8",
        "--iterations",
        "1",
        "--device",
        "cpu",
        "-q",
    ]
    python = f"import sys; from warp_ir.cli import main; assert main({words!r}) == 0\n"
    python += "assert not {'ray', 'warp_ir.engine'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", python], check=True, cwd=ROOT)
