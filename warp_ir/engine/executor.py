"""What renders parts, and the order in which their samples come back."""

import itertools
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from typing import Protocol

from warp_ir.engine.plan import Part
from warp_ir.film import FilmSamples
from warp_ir.renderer import Renderer

_WAIT = 0.2
"""Time between two looks at whether the render is to stop [s]."""
_RUN_AHEAD = 2
"""Parts that have been started and not been added yet, over those that run at the same time: more are not started, so
that neither memory nor what a lost machine takes with it grows with the number of parts."""


class Executor(Protocol):
    """Renders parts of a picture somewhere. A handle stands for one that has been started."""

    kind: str
    """Kind of its devices, "cpu" or "cuda": parts have the same bits on all of them."""

    def prepare(self, renderer: Renderer) -> None:
        """Takes the scene and the settings of the parts that follow from the renderer of the whole picture."""

    def slots(self) -> int:
        """Number of parts that should have been started at the same time, at the moment."""

    def start(self, part: Part) -> Hashable:
        """Starts a part; fewer than `slots` are running."""

    def finished(self, running: Sequence[Hashable], seconds: float) -> Iterable[Hashable]:
        """Those of the handles that have finished, after waiting for the first one for so long at most."""

    def fetch(self, handle: Hashable) -> FilmSamples:
        """The samples of a part that has finished; it is called once for each.

        Raises:
            InputError: The part could not be rendered.
        """

    def cancel(self, handles: Iterable[Hashable]) -> None:
        """Ends parts whose samples nobody needs any more."""

    def pause(self) -> AbstractContextManager[None]:
        """While the context lasts, no part begins an iteration on the device of the whole picture's renderer."""


def in_order(executor: Executor, parts: Iterable[Part], stopped: Callable[[], bool]) -> Iterator[tuple[Part, Hashable]]:
    """Starts parts, and yields those that have finished with their handles, in the order in which they are given.

    A part is taken from `parts` when it can be started. When `stopped` returns true, or the caller stops, those that
    have not been yielded are cancelled.
    """
    numbered = enumerate(parts)
    begun: deque[tuple[int, Part, Hashable]] = deque()  # not yielded yet, in order
    running: dict[Hashable, int] = {}
    try:
        for number in itertools.count():
            while not stopped():
                slots = executor.slots()
                while len(running) < slots and len(begun) < _RUN_AHEAD * slots:
                    taken = next(numbered, None)
                    if taken is None:
                        break
                    handle = executor.start(taken[1])
                    begun.append((*taken, handle))
                    running[handle] = taken[0]
                if not begun or begun[0][2] not in running:
                    break
                for handle in executor.finished(list(running), _WAIT):
                    del running[handle]
            if not begun or stopped():
                return
            assert begun[0][0] == number
            _, part, handle = begun.popleft()
            yield part, handle
    finally:
        executor.cancel([handle for _, _, handle in begun])
