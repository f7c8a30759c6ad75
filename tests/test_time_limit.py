"""The arithmetic of a time limit, with a clock that is simulated: nothing is rendered."""

import numpy as np
import pytest

from warp_ir.scheduling import AdaptiveScheduler
from warp_ir.settings import RenderSettings

FIXED = 0.2
"""Fraction of an iteration's time that does not depend on its tiles."""


class SimulatedFilm:
    """What a scheduler reads of a film of 256 tiles, and the seconds that its iterations take."""

    def __init__(self, iteration_seconds, tile_seconds):
        self.iteration_seconds, self.tile_seconds = iteration_seconds, tile_seconds
        self.iterations, self.seconds = 0, 0.0
        self.tile_iterations = np.zeros(256, np.int32)
        self.chosen = np.ones(256, bool)

    def add_iteration(self):
        self.iterations += 1
        self.tile_iterations += self.chosen
        share = (self.tile_seconds * self.chosen).sum() / self.tile_seconds.sum()
        self.seconds += self.iteration_seconds * (FIXED + (1.0 - FIXED) * share)

    def squared_errors(self):
        return self.tile_seconds / self.tile_iterations

    def filtered_errors(self, plain):
        return plain

    def is_unlit(self):
        return False

    def choose(self, tiles):
        self.chosen = tiles


def seconds_taken(film, limit, before, picture, adaptive=True):
    """Seconds that a render takes whose upload takes `before`, and its picture `picture`, both known."""
    film.seconds = before
    scheduler = AdaptiveScheduler(film, RenderSettings(height=128, width=128, time_limit=limit), adaptive)
    while True:
        film.add_iteration()
        if scheduler.update(picture, FIXED).fraction >= 1.0:
            return film.seconds + picture


@pytest.mark.parametrize("iteration", [0.01, 0.1, 0.2, 0.3, 0.45, 0.5])
@pytest.mark.parametrize("limit", [0.6, 1.0, 2.0])
def test_a_render_ends_within_five_percent_of_its_limit(iteration, limit):
    """Upload, look, iterations and picture are within the limit, and 5 % of it at most are left, or too few tiles.

    The tiles with the largest error take up to twice as long as the mean, which is what the plan cannot know. An
    iteration of fewer than an eighth of the tiles is none: 0.3 iterations' time is left then.
    """
    film = SimulatedFilm(iteration, np.linspace(0.5, 1.5, 256))
    taken = seconds_taken(film, limit, before=0.05, picture=0.05)
    assert taken <= 1.05 * limit
    assert taken > 0.95 * limit or limit - taken < 0.45 * iteration


@pytest.mark.parametrize("adaptive", [True, False])
def test_one_iteration_is_the_least(adaptive):
    """A limit that one iteration exceeds ends after that."""
    film = SimulatedFilm(0.45, np.ones(256))
    assert seconds_taken(film, 0.3, 0.1, 0.1, adaptive) == pytest.approx(0.65)
    assert film.iterations == 1


@pytest.mark.parametrize("iteration", [0.02, 0.45])
def test_without_choice_of_tiles_only_whole_iterations_are_begun(iteration):
    """An iteration that does not fit is not begun: the time is below the limit by one iteration at most."""
    taken = seconds_taken(SimulatedFilm(iteration, np.ones(256)), 1.2, 0.05, 0.05, adaptive=False)
    assert 1.2 - iteration - 1e-9 <= taken <= 1.2
