"""A render by an executor: rounds of parts, added to the film in order."""

import math
import time
from collections.abc import Callable, Hashable
from contextlib import closing
from dataclasses import replace

import numpy as np

from warp_ir.device.launcher import Cancelled
from warp_ir.engine.executor import Executor, in_order
from warp_ir.engine.plan import Round, part_iterations, parts_of_round
from warp_ir.film import Film
from warp_ir.film.denoise import denoise_seconds
from warp_ir.interrupt import cancel_on_signal
from warp_ir.renderer import Renderer
from warp_ir.scheduling import Progress, RoundScheduler

_PICTURE_SECONDS = 8.0e-6
"""Approximate time in which a thread of a CPU makes the picture of a pixel [s]; on a GPU it is a hundredth."""
_ADD_SECONDS = 1.0e-6
"""Approximate time in which the samples of a pixel are added to the film, before it has been measured [s]."""


def render_parts(
    renderer: Renderer,
    executor: Executor,
    film: Film | None = None,
    progress: Callable[[Progress], None] | None = None,
    *,
    started: float | None = None,
    reserve: float = 0.0,
    iterations: range | None = None,
    size: int | None = None,
) -> Film:
    """`Renderer.render` by an executor, in parts: the limits of the settings are those of the whole.

    The picture depends on `size` and on the kind of the devices, and neither on their number nor on their speed; with a
    time limit, it holds what was done in time.

    Args:
        renderer: Makes the picture; the executor renders its scene.
        executor: Renders the parts.
        film: A film from `renderer.new_film`, to be continued; None: a new one.
        progress: Called after the parts of the same iterations.
        started: `time.perf_counter` from which the time counts; None: this call.
        reserve: Time of the limit that the caller needs after this call [s].
        iterations: Those that the film is to hold in the end; None: the first ones, up to the limits.
        size: Iterations of a part; None: as `part_iterations` says.

    Raises:
        InputError: A part cannot be rendered, or the devices are gone; the film holds what was added.
    """
    start = time.perf_counter() if started is None else started
    film = film or renderer.new_film()
    start -= film.seconds
    first, settings = 0, renderer.settings
    if iterations is not None:
        first, settings = iterations.start, replace(settings, iterations=len(iterations))
    adaptive = renderer.is_adaptive()
    scheduler = RoundScheduler(film, settings, adaptive)
    with cancel_on_signal(renderer.launcher, film):
        executor.prepare(renderer)
        adding = _ADD_SECONDS * film.width * film.height
        reserve += _picture_seconds(renderer, film)
        while not film.interrupted and film.iterations < settings.iteration_limit:
            begin, end = film.iterations, scheduler.round_end()
            deadline = math.inf
            if settings.time_limit is not None:
                left = settings.time_limit - reserve - adding * executor.slots() - (time.perf_counter() - start)
                deadline = time.time() + left
            rounds = adaptive or settings.target_error is not None
            known = end - begin if rounds else settings.iteration_limit
            each = size or part_iterations(film.width * film.height, known, executor.kind, rounds=rounds)
            skipped = (film.iterations - film.tile_iterations).astype(np.int32)
            parts = parts_of_round(film, Round(film.chosen, skipped, deadline), end, each, first)
            fraction = 0.0
            group: list[Hashable] = []  # parts with the same iterations: a film holds whole iterations
            try:
                with closing(in_order(executor, parts, lambda: film.interrupted != 0)) as finished:
                    for part, handle in finished:
                        group.append(handle)
                        if len(group) < part.strips:
                            continue
                        with executor.pause(), renderer.launcher.exclusive:
                            before, now = film.iterations, time.perf_counter()
                            for handle in group:
                                samples = executor.fetch(handle)
                                film.add(samples, max(film.iterations, before + samples.iterations))
                            adding = (time.perf_counter() - now) / len(group)
                            group.clear()
                            film.seconds = time.perf_counter() - start
                            if film.iterations == end:
                                scheduler.finish_round()
                            report = scheduler.report(reserve)
                            fraction = report.fraction
                            if progress is not None and film.iterations > before:
                                progress(report)
            except Cancelled:
                break
            finally:
                executor.cancel(group)
            if fraction >= 1.0 or film.iterations == begin or film.iterations < end:
                break
    film.radiance()
    film.seconds = time.perf_counter() - start
    renderer.report_profile(film)
    return film


def _picture_seconds(renderer: Renderer, film: Film) -> float:
    """Estimated time to make the picture [s]."""
    pixels, settings = film.width * film.height, renderer.settings
    seconds = 0.0
    if film.reconstruction is not None:
        threads = renderer.launcher.threads if renderer.launcher.device.is_cpu else 100
        seconds += _PICTURE_SECONDS * pixels / threads
    if settings.denoise:
        seconds += denoise_seconds(pixels, settings.time_limit)
    return seconds
