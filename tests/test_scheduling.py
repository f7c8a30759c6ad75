"""Iterations are for the tiles that need them, and end where a limit is reached."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

import warp_ir as ir
from warp_ir.film import Film
from warp_ir.procedural import cornell_box
from warp_ir.renderer import Renderer
from warp_ir.scheduling import AdaptiveScheduler, select_tiles

pytestmark = pytest.mark.extended

SETTINGS = ir.RenderSettings(width=36, height=20, light_paths=64)  # 5 x 3 tiles, some of which reach beyond


def pixels_of(tiles, film):
    """A mask of tiles as one of pixels."""
    rows = -(-film.height // 8)
    return tiles.reshape(rows, -1).repeat(8, axis=0).repeat(8, axis=1)[: film.height, : film.width]


def test_equal_tiles_are_all_worth_it():
    """Where no tile is better than another, an iteration's fixed cost is best spent on all of them."""
    assert select_tiles(np.full(64, 0.1), np.full(64, 4, np.int32)).all()


def test_no_fewer_than_an_eighth():
    """If one tile has all the error, cores have an eighth to work on: that one among them."""
    squares = np.zeros(64)
    squares[37] = 1.0
    chosen = select_tiles(squares, np.full(64, 4, np.int32))
    assert chosen.sum() == 8 and chosen[37]


def test_all_tiles_have_two_iterations_if_there_is_time():
    """After one, all are chosen, or as many as there is time for: the worst; all again if that is next to none."""
    squares, once = np.arange(64.0), np.ones(64, np.int32)
    assert select_tiles(squares, once).all()
    np.testing.assert_array_equal(np.flatnonzero(select_tiles(squares, once, max_tiles=20.5)), np.arange(44, 64))
    assert select_tiles(squares, once, max_tiles=7.0).all()


def test_iterations_go_with_the_root_of_the_error():
    """In the end n is in proportion to √e, and the error about that of the best way to share iterations out.

    With N samples of T tiles that is (Σ√e)²/N against T Σe/N of equal shares: 7 % less where e is uniform from 0.1 to
    1.1. No tile has more than one sample of an iteration: the worst have one of each, as further ones have their price.
    The others' n, twenty and more, lag or lead by two: a tenth of the smallest.
    """
    errors = np.random.default_rng(1).random(256) + 0.1
    n = np.full(256, 2, np.int32)
    while n.sum() < 256 * 40:
        n += select_tiles(errors / n, n)
    best, free = np.sqrt(errors).sum() ** 2 / n.sum(), n < n.max() - 2
    assert best <= (errors / n).sum() < 1.02 * best < 0.96 * 256 * errors.sum() / n.sum()
    ratio = n[free] / np.sqrt(errors[free])
    assert free.mean() > 0.3 and ratio.max() / ratio.min() < 1.2


def test_tiles_sum_to_the_error(device):
    """The parts that tiles have in the squared error add up to it; those beyond the film's edge are no pixels."""
    film = ir.render(cornell_box(), ir.RenderSettings(width=36, height=20, light_paths=64, iterations=3), device=device)
    assert film.squared_errors().shape == (15,)
    assert math.sqrt(film.squared_errors(filtered=True).sum()) == film.error()
    assert (film.squared_errors(filtered=True) >= film.squared_errors()).all()


@pytest.mark.parametrize("estimator", ["vpl", "keller", "path"])
def test_an_iteration_for_some_tiles(estimator, device):
    """Pixels of the chosen tiles are those of a whole iteration, bit for bit; the others as they were."""
    settings = ir.RenderSettings(width=36, height=20, light_paths=64, filter=False, estimator=estimator)
    renderer = Renderer(cornell_box(), settings, device=device)
    before, whole, film = (renderer.new_film() for _ in range(3))
    chosen = np.arange(15) % 4 == 1
    for each, iterations in ((before, 2), (whole, 3), (film, 2)):
        for i in range(iterations):
            renderer.add_iteration(each, i)
    film.choose(chosen)
    rays = renderer.launcher.profile.counts["primary_rays"]
    renderer.add_iteration(film, 2)
    inside = pixels_of(chosen, film)
    assert renderer.launcher.profile.counts["primary_rays"] - rays == inside.sum()
    assert film.skipped == (~inside).sum()
    np.testing.assert_array_equal(film.tile_iterations, 2 + chosen)
    for name in ("radiance", "standard_error"):
        expected = np.where(inside[..., None], getattr(whole, name)(), getattr(before, name)())
        np.testing.assert_array_equal(getattr(film, name)(), expected)
    for name in ("alpha", "depth", "albedo"):
        mask = inside.reshape(inside.shape + (1,) * (film.aov(name).ndim - 2))
        np.testing.assert_array_equal(film.aov(name), np.where(mask, whole.aov(name), before.aov(name)))
    # Camera rays go on where a tile left off: those of its third iteration are the third points of its sequence.
    film.choose(~chosen)
    renderer.add_iteration(film, 3)
    np.testing.assert_array_equal(film.aov("depth"), whole.aov("depth"))


def test_films_of_some_tiles_merge():
    """Each pixel's mean counts as often as it has iterations."""
    renderer = Renderer(cornell_box(), ir.RenderSettings(width=36, height=20, light_paths=64, filter=False))
    films = [renderer.new_film() for _ in range(2)]
    for film, start in zip(films, (0, 10), strict=True):
        for i in range(3):
            film.choose(np.ones(15, bool) if i < 2 else np.arange(15) % (2 + start) == 0)
            renderer.add_iteration(film, start + i)
    n = [pixels_of(film.tile_iterations, film)[..., None] for film in films]
    expected = (n[0] * films[0].radiance() + n[1] * films[1].radiance()) / (n[0] + n[1])
    films[0].merge(films[1])
    np.testing.assert_allclose(films[0].radiance(), expected, rtol=1e-6)
    np.testing.assert_array_equal(pixels_of(films[0].tile_iterations, films[0])[..., None], n[0] + n[1])


def test_a_target_leaves_out_good_tiles(tmp_path):
    """A render to an error skips samples, reaches it, has the same bits on any number of threads, and when resumed."""
    scene, target = cornell_box(), 0.08
    settings = ir.RenderSettings(width=48, height=48, light_paths=256, target_error=target)
    films = []
    for threads in (1, 2):
        renderer = Renderer(scene, settings, threads=threads)
        films.append(renderer.render())
    whole = films[0]
    assert whole.error() <= target and whole.counts["skipped_samples"] == whole.skipped > 0
    np.testing.assert_array_equal(whole.radiance(), films[1].radiance())
    part = Renderer(scene, settings)

    def interrupt(report):
        if report.iterations == whole.iterations - 1:
            part.film.interrupted = 2

    part.film = part.new_film()
    part.render(part.film, interrupt)
    assert part.film.skipped > 0
    part.film.save(tmp_path / "film.npz")
    resumed = part.new_film()
    resumed.resume(tmp_path / "film.npz")
    np.testing.assert_array_equal(part.render(resumed).radiance(), whole.radiance())
    assert resumed.iterations == whole.iterations


@pytest.mark.parametrize("more", [{"filter": False}, {"iterations": 12}, {"estimator": "path"}])
def test_what_is_asked_for_is_not_left_out(more):
    """A mean without bias takes all samples; so do iterations that are counted."""
    settings = ir.RenderSettings(width=36, height=20, light_paths=64, target_error=0.2, **more)
    film = ir.render(cornell_box(), settings)
    assert film.skipped == 0


@pytest.mark.parametrize("limit, iterations", [(0.7, 2), (0.45, 1), (0.2, 1), (3.0, None)])
def test_a_time_limit_is_that_of_the_call(monkeypatch, limit, iterations):
    """By a simulated clock: uploading takes 0.05 s, a first look 0.05 s, an iteration 0.3 s and the picture 0.1 s.

    That is 0.5 s with one iteration, which is the least; in 0.7 s some tiles get another, a fifth of the time that is
    left for them being kept in case they take longer than the mean.
    """
    now = [0.0]

    def taking(seconds, function):
        def timed(self, *arguments):
            now[0] += seconds(self, *arguments) if callable(seconds) else seconds
            return function(self, *arguments)

        return timed

    monkeypatch.setattr("warp_ir.renderer.time", SimpleNamespace(perf_counter=lambda: now[0]))
    for name, seconds in (
        ("_upload", 0.05), ("new_film", 0.05), ("add_iteration", lambda _, film, i: 0.06 + 0.24 * film.chosen.mean()),
    ):  # fmt: skip
        monkeypatch.setattr(Renderer, name, taking(seconds, getattr(Renderer, name)))
    monkeypatch.setattr(Film, "radiance", taking(0.1, Film.radiance))
    monkeypatch.setattr(Renderer, "_picture_seconds", lambda *_: 0.1)
    update = AdaptiveScheduler.update
    monkeypatch.setattr(AdaptiveScheduler, "update", lambda self, reserve, fixed_share: update(self, reserve, 0.2))
    film = ir.render(cornell_box(), ir.RenderSettings(width=64, height=64, light_paths=16, time_limit=limit))
    assert iterations in (None, film.iterations)
    assert film.seconds == pytest.approx(now[0]) and film.seconds <= max(limit, 0.5)
    assert film.seconds > 0.93 * limit and (film.skipped > 0) == (limit > 0.5)


def test_the_time_that_is_left_goes_to_the_worst_tiles():
    """An iteration that does not fit any more is for as many tiles as do, of an iteration that fits for all.

    One took 1 s, a fifth of it whatever its tiles: with 0.9 s left, of which a fifth is not planned with, there is time
    for (0.72 - 0.2) / 0.8 = 0.65 of 15 tiles. With 0.25 s left there is time for none: it ends.
    """
    for limit, tiles in ((2.5, 15), (1.9, 9), (1.25, None)):
        settings = ir.RenderSettings(width=36, height=20, light_paths=64, time_limit=limit)
        renderer = Renderer(cornell_box(), settings)
        film = renderer.new_film()
        stopping = AdaptiveScheduler(film, settings, True)
        renderer.add_iteration(film, 0)
        film.seconds = 1.0
        report = stopping.update(0.0, 0.2)
        assert (report.fraction < 1.0) == (tiles is not None)
        if tiles is not None:
            assert film.chosen.sum() == tiles
            squares = film.squared_errors()
            assert tiles == 15 or squares[film.chosen].min() >= squares[~film.chosen].max()
