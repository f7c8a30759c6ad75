"""What renders parts, and the order in which their samples come back."""

from collections import deque
from collections.abc import Callable, Generator, Hashable, Iterable, Sequence
from contextlib import AbstractContextManager
from typing import Protocol, TypeVar

from warp_ir.engine.plan import Part
from warp_ir.film import FilmSamples
from warp_ir.renderer import Renderer

_WAIT = 0.2
"""Time between two looks at whether the render is to stop [s]."""
_RUN_AHEAD = 2
"""Parts that have been started and not been added yet, over those that run at the same time: more are not started, so
that neither memory nor what a lost machine takes with it grows with the number of parts."""


Work = TypeVar("Work", contravariant=True)


class Tasks(Protocol[Work]):
    """Does pieces of work somewhere. A handle stands for one that has been started."""

    def slots(self) -> int:
        """Number of pieces that should have been started and not finished, at the moment."""

    def start(self, work: Work, /) -> Hashable:
        """Starts a piece; fewer than `slots` are running."""

    def finished(self, running: Sequence[Hashable], seconds: float, /) -> Iterable[Hashable]:
        """The handles of finished parts, after waiting for the first one for `seconds` at most."""

    def cancel(self, handles: Iterable[Hashable], /) -> None:
        """Ends pieces whose results nobody needs any more."""


class Executor(Tasks[Part], Protocol):
    """Renders parts of a picture somewhere."""

    kind: str
    """Kind of its devices, "cpu" or "cuda": parts have the same bits on all of them."""

    def prepare(self, renderer: Renderer) -> None:
        """Takes the scene and the settings of the parts that follow from the renderer of the whole picture."""

    def fetch(self, handle: Hashable, /) -> FilmSamples:
        """The samples of a part that has finished; it is called once for each.

        Raises:
            InputError: The part could not be rendered.
        """

    def pause(self) -> AbstractContextManager[None]:
        """While the context lasts, no part begins an iteration on the device of the whole picture's renderer."""


Piece = TypeVar("Piece")


def in_order(
    tasks: Tasks[Piece], work: Iterable[Piece], stopped: Callable[[], bool]
) -> Generator[tuple[Piece, Hashable], None, None]:
    """Starts pieces of work, and yields those that have finished with their handles, in the order they are given in.

    A piece is taken from `work` when it can be started. When `stopped` returns true, or the caller stops, those that
    have not been yielded are cancelled.
    """
    numbered = enumerate(work)
    begun: deque[tuple[int, Piece, Hashable]] = deque()  # not yielded yet, in order
    running: dict[Hashable, int] = {}
    try:
        while True:
            while not stopped():
                slots = tasks.slots()
                while len(running) < slots and len(begun) < _RUN_AHEAD * slots:
                    taken = next(numbered, None)
                    if taken is None:
                        break
                    handle = tasks.start(taken[1])
                    begun.append((*taken, handle))
                    running[handle] = taken[0]
                if not begun or begun[0][2] not in running:
                    break
                for handle in tasks.finished(list(running), _WAIT):
                    del running[handle]
            if not begun or stopped():
                return
            _, piece, handle = begun.popleft()
            yield piece, handle
    finally:
        tasks.cancel([handle for _, _, handle in begun])
