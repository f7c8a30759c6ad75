"""What a cluster costs: measured on this machine, and modelled for more machines than one has.

    python -m benchmarks.cluster --measure [--json FILE]     # what the model is made of; starts a local Ray cluster
    python -m benchmarks.cluster [--figures FILE]            # the model: 1 to 1000 workers

The model runs the program's own plan and its own scheduler (`parts_of_round`, `in_order`) on a virtual clock: workers
take what was measured for a part, the program what was measured for starting one and for adding its samples. Workers
die at random; a part that is lost so begins anew.
"""

import argparse
import heapq
import json
import math
import random
import resource
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from warp_ir.engine.executor import in_order
from warp_ir.engine.plan import Round, part_iterations, parts_of_round
from warp_ir.tiles import tile_count

SCENES = Path(__file__).parents[1] / "scenes_usd"
RESULT = Path(__file__).parent / "results" / "cluster.json"
DRIVER_CORES = 16
"""Cores of the machine on which the modelled program runs."""
NETWORK = 1.25e9
"""Its network [bytes/s]: 10 Gbit/s."""
DETECTION = 30.0
"""Time until Ray notices that a machine does not answer [s], as it is set up."""


@dataclass(frozen=True)
class Figures:
    """What a part costs."""

    sample_seconds: float
    """Time of a core for a pixel of an iteration [s]."""
    setup_seconds: float
    """Time of a new worker until its first iteration: imports, kernels from the cache, scene, guide [s]."""
    start_seconds: float
    """Time of the program to start a part [s]."""
    add_seconds: float
    """Time of a core to fetch and to add the samples of a pixel of a part [s]."""
    pixel_bytes: float
    """Size of these samples [bytes]."""
    picture_seconds: float
    """Time of a core to filter the picture, per pixel [s]."""
    frame_seconds: float
    """Time of the program for a frame that a worker renders and writes [s]."""


class ModelCluster:
    """Does work on a virtual clock, as `warp_ir.engine.ray_cluster` does."""

    def __init__(
        self,
        workers: int,
        duration: Callable[[object], float],
        figures: Figures,
        *,
        spread: float = 0.1,
        deaths: float = 0.0,
        seed: int = 0,
    ) -> None:
        """A cluster of `workers`; `deaths` is the rate at which each of them dies [1/s]."""
        self.now, self.busy, self.lost, self.most_open, self.started = 0.0, 0.0, 0, 0, 0
        self._figures, self._duration, self._spread, self._deaths = figures, duration, spread, deaths
        self._random = random.Random(seed)
        self._free = [0.0] * workers  # when a worker has finished what it has
        self._fresh = workers
        self._ends: dict[Hashable, float] = {}
        self._workers = workers

    def slots(self) -> int:
        return 2 * self._workers

    def start(self, work: object, /) -> Hashable:
        self.now += self._figures.start_seconds
        self.started += 1
        begin = max(heapq.heappop(self._free), self.now)
        seconds = self._duration(work) * math.exp(self._random.gauss(0.0, self._spread))
        if self._fresh > 0:
            self._fresh -= 1
            begin += self._figures.setup_seconds
        self.busy += seconds
        while self._deaths and (death := self._random.expovariate(self._deaths)) < seconds:
            self.lost += 1
            begin += death + DETECTION + self._figures.setup_seconds
        heapq.heappush(self._free, begin + seconds)
        handle = self.started
        self._ends[handle] = begin + seconds
        self.most_open = max(self.most_open, len(self._ends))
        return handle

    def finished(self, running: Sequence[Hashable], seconds: float, /) -> Iterable[Hashable]:
        done = [handle for handle in running if self._ends[handle] <= self.now]
        if not done:
            self.now = min(self._ends[handle] for handle in running)
            done = [handle for handle in running if self._ends[handle] <= self.now]
        return done

    def take(self, handle: Hashable, seconds: float) -> None:
        """The program takes what has finished, in so much of its own time."""
        del self._ends[handle]
        self.now += seconds

    def cancel(self, handles: Iterable[Hashable], /) -> None:
        assert not list(handles), "nothing is left"


@dataclass(frozen=True)
class _Film:
    """As much of a film as a plan looks at."""

    width: int
    height: int
    chosen: np.ndarray
    iterations: int = 0


@dataclass(frozen=True)
class Outcome:
    """A render on the virtual clock."""

    workers: int
    hours: float
    efficiency: float
    """Time that workers rendered over that which they were there."""
    parts: int
    most_open: int
    """Most parts that were started and not added."""
    lost: int


def model_picture(
    width: int, height: int, iterations: int, workers: int, figures: Figures, threads: int = 8, deaths: float = 0.0
) -> Outcome:
    """One picture, its parts shared by `workers` of some threads."""
    pixels = width * height
    chosen = np.ones(tile_count(width, height), bool)
    film = _Film(width, height, chosen)
    size = part_iterations(pixels, iterations, "cpu", rounds=False)
    parts = parts_of_round(film, Round(chosen, np.zeros(0, np.int32), math.inf), iterations, size, 0)  # type: ignore

    def samples(part: object) -> float:
        return len(part.iterations) * min(64 * (part.strip[1] - part.strip[0]), pixels)  # type: ignore[attr-defined]

    def seconds(part: object) -> float:
        return samples(part) * figures.sample_seconds / threads

    cluster = ModelCluster(workers, seconds, figures, deaths=deaths)
    fetch_seconds = figures.add_seconds / DRIVER_CORES + figures.pixel_bytes / NETWORK
    count = 0
    for part, handle in in_order(cluster, parts, lambda: False):
        cluster.take(handle, samples(part) / len(part.iterations) * fetch_seconds)
        count += 1
    cluster.now += pixels * figures.picture_seconds / DRIVER_CORES
    return _outcome(cluster, workers, count)


def model_frames(frames: int, seconds: float, workers: int, figures: Figures, deaths: float = 0.0) -> Outcome:
    """An animation, each frame a task that takes a worker so many seconds."""
    cluster = ModelCluster(workers, lambda _: seconds, figures, spread=0.3, deaths=deaths)
    for _, handle in in_order(cluster, range(frames), lambda: False):
        cluster.take(handle, figures.frame_seconds)
    return _outcome(cluster, workers, frames)


def _outcome(cluster: ModelCluster, workers: int, parts: int) -> Outcome:
    return Outcome(
        workers,
        cluster.now / 3600.0,
        cluster.busy / (workers * cluster.now),
        parts,
        cluster.most_open,
        cluster.lost,
    )


WORKERS = 1, 10, 100, 1000
DEATHS = 1.0 / (24.0 * 3600.0)
"""Each worker dies once a day."""
CASES: dict[str, Callable[[int, Figures], Outcome]] = {
    "512 x 384, 1024 iterations": lambda n, f: model_picture(512, 384, 1024, n, f, deaths=DEATHS),
    "512 x 384, 10⁶ iterations": lambda n, f: model_picture(512, 384, 10**6, n, f, deaths=DEATHS),
    "1920 x 1080, 1024 iterations": lambda n, f: model_picture(1920, 1080, 1024, n, f, deaths=DEATHS),
    "8K, 256 iterations": lambda n, f: model_picture(7680, 4320, 256, n, f, deaths=DEATHS),
    "10 000 frames of 60 s": lambda n, f: model_frames(10_000, 60.0, n, f, deaths=DEATHS),
}


def table(figures: Figures) -> Iterator[str]:
    """The model as a Markdown table: hours and efficiency by number of workers."""
    yield "| render | " + " | ".join(f"{n} worker{'s' * (n > 1)}" for n in WORKERS) + " |"
    yield "|---" * (len(WORKERS) + 1) + "|"
    for name, case in CASES.items():
        cells = [case(n, figures) for n in WORKERS]
        yield f"| {name} | " + " | ".join(f"{_time(c.hours)}, {100 * c.efficiency:.0f} %" for c in cells) + " |"


def _time(hours: float) -> str:
    return f"{hours:.1f} h" if hours >= 1.0 else f"{60 * hours:.1f} min" if hours >= 1 / 60 else f"{3600 * hours:.0f} s"


def _wait(seconds: float) -> np.ndarray:
    time.sleep(seconds)
    return np.zeros(1 << 17)  # 1 MiB


def measure(workers: int = 2, tasks: int = 20, width: int = 512, height: int = 384) -> dict[str, object]:
    """Measures what the model is made of, and what a task of a second costs more than a second."""
    import warp_ir as ir
    from warp_ir.engine import Part
    from warp_ir.engine.ray_cluster import RayCluster
    from warp_ir.engine.worker import PartRenderer

    pixels = width * height
    scene = ir.load_usd(SCENES / "cornell_box.usda")
    begin = time.perf_counter()
    cluster = RayCluster("cpu", workers=workers, threads=1)
    begun = time.perf_counter() - begin
    out: dict[str, object] = {"cores": len(__import__("os").sched_getaffinity(0)), "cluster_start_seconds": begun}

    class Sleeping:
        slots, finished, cancel = cluster.slots, cluster.finished, cluster.cancel

        def start(self, seconds: float, /) -> Hashable:
            return cluster.start_call(_wait, seconds)

    def run(seconds: float, count: int) -> float:
        begin = time.perf_counter()
        for _, handle in in_order(Sleeping(), [seconds] * count, lambda: False):
            cluster.fetch(handle)
        return time.perf_counter() - begin

    run(0.0, 4 * workers)  # workers start
    walls = [run(1.0, tasks) for _ in range(3)]
    ideal = tasks / workers
    out["overhead_of_1_s_tasks"] = [round(wall / ideal - 1.0, 4) for wall in walls]
    cpu = time.process_time()
    run(0.0, 200)
    start_seconds = (time.process_time() - cpu) / 200

    grown = []
    for count in (500, 2500):
        run(0.0, count)
        grown.append(int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize())
    out["memory_after_500_and_3000_tasks"] = grown

    settings = ir.RenderSettings(width=width, height=height)
    renderer = ir.Renderer(scene, settings, threads=1)
    cluster.prepare(renderer)
    film = renderer.new_film()
    chosen = Round(film.chosen, np.zeros(len(film.chosen), np.int32), math.inf)

    def part(first: int, count: int) -> Part:
        return Part(range(first, first + count), (0, len(film.chosen)), 1, 0, chosen)

    def fetched(what: Part) -> tuple[float, object]:
        begin = time.perf_counter()
        handle = cluster.start(what)
        while not list(cluster.finished([handle], 1.0)):
            pass
        return time.perf_counter() - begin, handle

    first, handle = fetched(part(0, 1))
    adds = []
    for k in range(4):
        cpu = time.process_time()
        samples = cluster.fetch(handle)
        film.add(samples, film.iterations + samples.iterations)
        adds.append(time.process_time() - cpu)
        second, handle = fetched(part(k + 1, 1))
    size = samples.bytes
    local = PartRenderer(ir.Renderer(scene, renderer.part_settings(), threads=1))
    local.render(part(0, 1))
    cpu = time.process_time()
    local.render(part(1, 3))
    sample_seconds = (time.process_time() - cpu) / (3 * pixels)
    cpu = time.process_time()
    film.radiance()
    picture_seconds = (time.process_time() - cpu) / pixels
    cluster.close()
    out["peak_memory_bytes"] = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    out["figures"] = asdict(
        Figures(
            sample_seconds=sample_seconds,
            setup_seconds=max(first - second, 0.0),
            start_seconds=start_seconds,
            add_seconds=sorted(adds)[1] / pixels,
            pixel_bytes=size / pixels,
            picture_seconds=picture_seconds,
            frame_seconds=2.0 * start_seconds,
        )
    )
    return out


def main() -> None:
    """Measures, or prints the model."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--measure", action="store_true")
    parser.add_argument("--json", default=RESULT, metavar="FILE", help="where to write what is measured")
    parser.add_argument("--figures", default=RESULT, metavar="FILE", help="what was measured, for the model")
    args = parser.parse_args()
    if args.measure:
        measured = measure()
        Path(args.json).write_text(json.dumps(measured, indent=2) + "\n")
        print(json.dumps(measured, indent=2))
        return
    figures = Figures(**json.loads(Path(args.figures).read_text())["figures"])
    print("\n".join(table(figures)))


if __name__ == "__main__":
    main()
