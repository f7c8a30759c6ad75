"""Several devices of this process, each with a renderer and a thread of its own."""

import threading
from collections.abc import Hashable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager, nullcontext

from warp_ir.device.launcher import Cancelled
from warp_ir.engine.plan import Part
from warp_ir.engine.worker import PartRenderer
from warp_ir.film import FilmSamples
from warp_ir.renderer import Renderer
from warp_ir.scene import InputError


class Devices:
    """Renders parts on devices of one kind."""

    def __init__(self, names: Sequence[str], threads: int | None = None) -> None:
        """Opens nothing yet.

        Args:
            names: Names of devices, such as ["cuda:0", "cuda:1"]. The CPU may be named several times.
            threads: CPU threads of each device; by default one for each core.

        Raises:
            InputError: They are of different kinds, or a GPU is named twice.
        """
        kinds = {name.partition(":")[0] for name in names}
        if len(kinds) != 1:
            raise InputError(f"device: {', '.join(names)} are of different kinds, which render other bits")
        (self.kind,) = kinds
        if self.kind != "cpu" and len(set(names)) < len(names):
            raise InputError(f"device: {', '.join(names)}: a GPU is named twice")
        self._names, self._threads = tuple(names), threads
        self._renderers: list[Renderer] = []  # the first one is that of the whole picture
        self._idle: list[tuple[PartRenderer, AbstractContextManager[object]]] = []
        self._pool = ThreadPoolExecutor(len(names), "device")
        self._gate = threading.Lock()

    def prepare(self, renderer: Renderer) -> None:
        """Uploads the scene to the devices other than the first, which is the renderer's, unless it is there."""
        settings = renderer.part_settings()
        others = self._renderers[1:]
        for each in others:
            each.update(renderer.origin, settings)
        if not others:
            for name in self._names[1:]:
                others.append(
                    Renderer(renderer.origin, settings, device=name, threads=self._threads, guiding=renderer.guiding)
                )
        self._renderers = [renderer, *others]
        # Whoever adds to the film of the whole needs the first device in between.
        gates: list[AbstractContextManager[object]] = [self._gate, *(nullcontext() for _ in others)]
        self._idle = [(PartRenderer(each), gate) for each, gate in zip(self._renderers, gates, strict=True)]

    def slots(self) -> int:
        """One for each device."""
        return len(self._names)

    def start(self, part: Part) -> Hashable:
        """Starts a part on a device that is idle."""
        device = self._idle.pop()
        future = self._pool.submit(device[0].render, part, device[1])
        future.add_done_callback(lambda _: self._idle.append(device))
        return future

    def finished(self, running: Sequence[Hashable], seconds: float) -> Iterable[Hashable]:
        """Waits for the first of them."""
        futures = [future for future in running if isinstance(future, Future)]
        return wait(futures, seconds, FIRST_COMPLETED).done

    def fetch(self, handle: Hashable) -> FilmSamples:
        """What the thread has returned."""
        assert isinstance(handle, Future)
        samples: FilmSamples = handle.result()
        return samples

    def cancel(self, handles: Iterable[Hashable]) -> None:
        """Abandons the launches in flight, and waits until the threads have ended them."""
        futures = [future for future in handles if isinstance(future, Future)]
        if all(future.done() for future in futures):
            return
        for each in self._renderers:
            each.launcher.cancel()
        wait(futures)
        for each in self._renderers:
            each.launcher.resume()
        errors = [future.exception() for future in futures]
        for error in errors:
            if error is not None and not isinstance(error, Cancelled):
                raise error

    @contextmanager
    def pause(self) -> Iterator[None]:
        """Lets no iteration begin on the first device."""
        with self._gate:
            yield

    def close(self) -> None:
        """Ends the threads."""
        self._pool.shutdown()
