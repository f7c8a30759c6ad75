"""A Ray cluster: parts are its tasks, on one machine or on many, which may come and go.

Ray is imported here alone, and first of all when a cluster is asked for. The scene is put once into the object store,
or read by its path where the machines share files; each worker uploads it once and keeps it. A task that is lost with
its worker or its machine is given to another by Ray. Samples stay in the object store until they are added to the film,
one part after the other.
"""

import logging
import os
import signal
import socket
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import warp as wp

from warp_ir import __version__
from warp_ir.engine.plan import Part, Round
from warp_ir.engine.worker import PartRenderer
from warp_ir.files import first_line, reason
from warp_ir.film import FilmSamples
from warp_ir.renderer import Renderer
from warp_ir.scene import InputError, Scene, scene_hash
from warp_ir.settings import GuidingSettings, RenderSettings

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from warp_ir.usd.settings.render_spec import Product

_LOGGER = logging.getLogger("warp_ir")
_MAX_THREADS = 8
"""Largest default number of threads of a worker: more machines fit workers of few."""
_RETRIES = 8
"""Times that a part is begun anew because its worker or its machine died."""
_QUEUED = 2
"""Parts that are given to Ray, over those that run: a worker finds the next one, and an autoscaler sees a demand."""
_HEAD_SECONDS = 20.0
"""Time after which a head that does not answer is given up [s]."""
_LOOK_EVERY = 1.0
"""Time between two looks at the machines of the cluster [s]."""
_ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",  # nothing is sent to anyone
    "RAY_USAGE_STATS_PROMPT_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_BACKEND_LOG_LEVEL": "fatal",  # what happens to parts is said by us
    "RAY_SCHEDULER_EVENTS": "0",
}
_ATTEMPTS = 3
"""Times that a local cluster is started: Ray gives its processes 15 s, which a busy machine may not have."""
_CONNECT_SECONDS = 10.0
"""Time in which the address of a cluster has to answer [s]: Ray itself tries for minutes."""


@dataclass(frozen=True)
class StageSource:
    """A stage that every worker reads by its path."""

    path: str
    options: Mapping[str, Any]
    """Keyword arguments of `StageReader`."""
    time: float | str | None
    product: "Product | None"

    def load(self) -> Scene:
        """Reads the scene."""
        from warp_ir.usd import StageReader

        return StageReader(self.path, **self.options).read(self.time, self.product)


@dataclass(frozen=True)
class _Job:
    """What the parts of a picture have in common."""

    scene: "StageSource | list[Any]"
    """In a list: a reference, which Ray does not follow before a worker does."""
    hash: str
    """Of the scene, where it is read by its path."""
    settings: RenderSettings
    guiding: GuidingSettings | None
    device: str
    threads: int
    versions: tuple[str, str]


class RayCluster:
    """Renders parts as tasks of a Ray cluster."""

    def __init__(
        self,
        device: str = "auto",
        *,
        address: str | None = None,
        workers: int | None = None,
        threads: int | None = None,
    ) -> None:
        """Connects to a cluster, or starts one on this machine.

        Args:
            device: "cpu", "cuda", or "auto" for GPUs if the cluster has any.
            address: Of a cluster, "HOST:PORT" or "auto"; None: a local one, which `close` ends.
            workers: Largest number of parts that run at the same time; None: as many as the cluster has room for.
            threads: CPUs of a worker; None: up to 8, but no more than each machine has; 1 for a GPU.

        Raises:
            InputError: Ray is missing, or there is no such cluster or device.
        """
        if device not in ("auto", "cpu", "cuda"):
            raise InputError(f"device: must be auto, cpu or cuda, as a Ray cluster chooses which, is {device!r}")
        if address is not None and "://" in address:
            raise InputError(f"address: {address!r}: must be HOST:PORT or auto, of a machine in the same cluster")
        for name, value in _ENVIRONMENT.items():
            os.environ.setdefault(name, value)
        try:
            import ray
        except ImportError as error:
            raise InputError("engine: ray is not installed: pip install 'warp-ir[cluster]'") from error
        self._ray: Any = ray  # whose types are there only if it is
        self._workers = workers
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        options: dict[str, Any] = {"address": address}
        if address is None:
            each = threads or (1 if device == "cuda" else min(_MAX_THREADS, max(1, cores // (workers or 1))))
            cpus = each * workers if workers else max(cores, each)
            options = {"address": "local", "num_cpus": cpus, "include_dashboard": False}
        self._connect(options)
        gpus = any(self._resources("GPU"))
        if device == "cuda" and not gpus:
            self.close()
            raise InputError("device: no machine of the cluster has a GPU")
        self.kind = "cuda" if gpus and device != "cpu" else "cpu"
        fewest = min((int(n) for n in self._resources("CPU") if n >= 1), default=1)
        self.threads = threads or (1 if self.kind == "cuda" else min(_MAX_THREADS, fewest))
        """CPUs of a worker."""
        self.source: StageSource | None = None
        """Where workers read the scene; None: in the object store."""
        self._job: tuple[str, list[Any]] = "", []
        self._jobs = 0
        self._round: tuple[Round | None, list[Any]] = None, []
        self._capacity, self._looked = 0, -_LOOK_EVERY
        host, _, port = ray.get_runtime_context().gcs_address.rpartition(":")
        self._head, self._answered = (host.strip("[]"), int(port)), time.monotonic()
        self._options = {"num_cpus": self.threads, "num_gpus": int(self.kind == "cuda"), "max_retries": _RETRIES}
        self._tasks: dict[Callable[..., Any], Any] = {}

    def _connect(self, options: dict[str, Any]) -> None:
        host, colon, port = options["address"].rpartition(":")
        try:
            if colon:
                socket.create_connection((host.strip("[]"), int(port)), _CONNECT_SECONDS).close()
        except (OSError, ValueError, OverflowError) as error:
            raise InputError(f"address: no Ray cluster at {options['address']!r}: {reason(error)}") from error
        with suppress(AttributeError):  # it prints what befalls nodes and tasks on the standard output
            self._ray._private.worker._worker_logs_enabled = False
        handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            for attempts_left in reversed(range(_ATTEMPTS if options["address"] == "local" else 1)):
                try:
                    self._ray.init(log_to_driver=False, logging_level=logging.CRITICAL, **options)
                    return
                except Exception as error:  # Ray raises plain ones, too
                    self._ray.shutdown()
                    what = first_line(str(error)) or type(error).__name__
                    if not attempts_left:
                        raise InputError(f"address: no Ray cluster at {options['address']!r}: {what}") from error
        finally:
            for number, handler in handlers.items():  # Ray sets its own
                with suppress(ValueError, TypeError):  # not in the main thread
                    signal.signal(number, handler)

    def _resources(self, name: str) -> list[float]:
        """How much of a resource each machine has."""
        return [node["Resources"].get(name, 0.0) for node in self._ray.nodes() if node["Alive"]]

    def prepare(self, renderer: Renderer) -> None:
        """Puts the scene into the object store."""
        source = self.source
        job = _Job(
            scene=self.put(renderer.origin) if source is None else source,
            hash="" if source is None else scene_hash(renderer.origin),
            settings=renderer.part_settings(),
            guiding=renderer.guiding,
            device=self.kind,
            threads=self.threads,
            versions=(__version__, wp.__version__),
        )
        self._jobs += 1
        self._job = f"{self._ray.get_runtime_context().get_job_id()} {self._jobs}", self.put(job)

    def capacity(self) -> int:
        """Number of workers for which the cluster has room, within `workers`."""
        now = time.monotonic()
        if now - self._looked >= _LOOK_EVERY and self._is_head_there():
            self._looked = now
            need = self._resources("GPU") if self.kind == "cuda" else [n / self.threads for n in self._resources("CPU")]
            room = sum(int(n) for n in need)
            if room == 0 and self._capacity == 0:
                what = "GPU" if self.kind == "cuda" else f"{self.threads} CPUs"
                _LOGGER.warning("%s", f"no machine of the cluster has {what} yet: waiting for one")
            if room != self._capacity and self._capacity:
                _LOGGER.info("%s", f"the cluster has room for {room} workers now, not {self._capacity}")
            self._capacity = room
        return max(1, min(self._capacity, self._workers or self._capacity))

    def _is_head_there(self) -> bool:
        """Whether the head answers; Ray itself would end the process without a word after a minute.

        Raises:
            InputError: It has not answered for some time.
        """
        try:
            socket.create_connection(self._head, 1.0).close()
        except OSError as error:
            if time.monotonic() - self._answered > _HEAD_SECONDS:
                raise InputError(f"the head of the Ray cluster does not answer: {reason(error)}") from error
            time.sleep(0.1)
            return False
        self._answered = time.monotonic()
        return True

    def slots(self) -> int:
        """Two for each worker: one that runs, and one that is queued."""
        capacity = self.capacity()
        return self._workers if self._workers and self._workers < self._capacity else _QUEUED * capacity

    def start(self, part: Part) -> Hashable:
        """Gives Ray a task."""
        if self._round[0] is not part.round:
            self._round = part.round, self.put(part.round)
        work = part.iterations, part.strip, part.strips, part.least
        return self.start_call(_render_part, *self._job, self._round[1], work)

    def put(self, value: object) -> list[Any]:
        """Puts something into the object store; workers look into the list, which Ray does not follow."""
        return [self._ray.put(value)]

    def start_call(self, function: Callable[..., Any], *arguments: Any) -> Hashable:
        """Gives Ray a task of another kind, which a worker has its CPUs or its GPU for."""
        if function not in self._tasks:
            self._tasks[function] = self._ray.remote(**self._options)(function)
        handle: Hashable = self._tasks[function].remote(*arguments)
        return handle

    def finished(self, running: Sequence[Hashable], seconds: float) -> Iterable[Hashable]:
        """Waits for the first, and looks which others have finished; nothing is fetched."""
        done, rest = self._ray.wait(list(running), num_returns=1, timeout=seconds, fetch_local=False)
        if done and rest:
            done += self._ray.wait(rest, num_returns=len(rest), timeout=0, fetch_local=False)[0]
        handles: list[Hashable] = done
        return handles

    def fetch(self, handle: Hashable) -> Any:
        """Fetches what a task has returned from the object store: the samples of a part."""
        errors = self._ray.exceptions
        try:
            return self._ray.get(handle)
        except errors.RayTaskError as error:
            cause = error.cause
            if isinstance(cause, InputError):
                raise InputError(str(cause)) from None
            raise InputError(f"a worker failed: {type(cause).__name__}: {cause}") from error
        except errors.RayError as error:
            what = first_line(str(error)) or type(error).__name__
            raise InputError(f"a task was lost: {what}") from error

    def cancel(self, handles: Iterable[Hashable]) -> None:
        """Interrupts the tasks that run, and takes back those that do not."""
        for handle in handles:
            with suppress(self._ray.exceptions.RayError, ValueError):
                self._ray.cancel(handle, recursive=False)

    def pause(self) -> "AbstractContextManager[None]":
        """Nothing to wait for: the whole picture's renderer has a device of its own."""
        return nullcontext()

    def close(self) -> None:
        """Leaves the cluster, and ends it if it was started here."""
        self._ray.shutdown()


_held: tuple[str, PartRenderer] | None = None
"""In a worker: the job of its latest part, and the renderer."""


@contextmanager
def _renderer_of(key: str, reference: list[Any]) -> Iterator[PartRenderer]:
    """The renderer of a job, in a worker; it is not used again after an error or an interruption."""
    global _held
    import ray

    held, _held = _held, None
    if held is None or held[0] != key:
        job: _Job = ray.get(reference[0])
        versions = __version__, wp.__version__
        if job.versions != versions:
            has, wants = (" and Warp ".join(each) for each in (versions, job.versions))
            raise InputError(f"a worker has warp_ir {has}, not {wants}")
        scene = job.scene.load() if isinstance(job.scene, StageSource) else ray.get(job.scene[0])
        if job.hash and scene_hash(scene) != job.hash:
            raise InputError(f"{job.scene.path}: is another scene where a worker reads it")  # type: ignore[union-attr]
        if held is not None:
            held[1].renderer.update(scene, job.settings)
            renderer = held[1].renderer
        else:
            device = "cuda:0" if job.device == "cuda" else "cpu"
            renderer = Renderer(scene, job.settings, device=device, threads=job.threads, guiding=job.guiding)
        held = key, PartRenderer(renderer)
    yield held[1]
    _held = held


_latest_round: tuple[Any, Round] | None = None
"""In a worker: the latest round, and its reference."""


def _render_part(
    key: str, job: list[Any], round: list[Any], work: tuple[range, tuple[int, int], int, int]
) -> FilmSamples:
    """Renders a part in a worker."""
    global _latest_round
    import ray

    if _latest_round is None or _latest_round[0] != round[0]:
        _latest_round = round[0], ray.get(round[0])
    with _renderer_of(key, job) as renderer:
        return renderer.render(Part(*work, _latest_round[1]))
