"""How a device renders a part."""

import time
from contextlib import AbstractContextManager, nullcontext

from warp_ir.engine.plan import Part
from warp_ir.film import FilmSamples
from warp_ir.renderer import Renderer

_OPEN = nullcontext()


class PartRenderer:
    """A renderer with a film that takes one part after the other."""

    def __init__(self, renderer: Renderer) -> None:
        """Takes over a renderer, which is used for nothing else meanwhile."""
        self.renderer = renderer
        self._film = renderer.new_film()

    def render(self, part: Part, gate: AbstractContextManager[object] = _OPEN) -> FilmSamples:
        """Renders a part; `gate` is entered before each iteration, and may make it wait."""
        film, longest = self._film, 0.0
        film.clear(part.tiles, part.round.skipped)
        for number, iteration in enumerate(part.iterations):
            begin = time.time()
            if number >= part.least and begin + longest >= part.round.deadline:
                break
            with gate:
                pass
            self.renderer.add_iteration(film, iteration)
            longest = max(longest, time.time() - begin) if number else 0.0  # the first one prepares much
        self.renderer.report_profile(film)
        return film.samples()
