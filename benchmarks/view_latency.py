"""How long a live view takes from an event to its picture, and how its memory grows.

    python -m benchmarks.view_latency [--window] [--use SECONDS] [STAGE ...]

Drags, walks, turns lights up and down and changes bounces as a user would, on the view's core (`LiveView.step`), or
with `--window` through the events of a window of VTK, which needs a display. Wall time is what a user feels, and
depends on what else the machine does; CPU time is that of all threads of the process.
"""

import argparse
import json
import resource
import threading
import time
from pathlib import Path

import numpy as np
import warp as wp

import warp_ir as ir
from warp_ir.view import navigation
from warp_ir.view.controls import Controls
from warp_ir.view.session import LiveView
from warp_ir.view.source import StageSource

SCENES = Path(__file__).parents[1] / "scenes_usd"
_WARM_UP = 10
"""Events before those that are measured: the view chooses its resolution."""


def cpu_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def dragged(k: int) -> tuple[float, float]:
    """The place of the pointer after k events: a figure of eight."""
    return 0.5 + 0.04 * np.sin(0.2 * k), 0.5 + 0.02 * np.sin(0.4 * k)


def measure_core(stage: str, events: int, size: tuple[int, int]) -> dict[str, float]:
    """Events to `Controls`, pictures from `LiveView.step`, in one thread."""
    view = open_view(stage, size)
    controls = Controls(view)
    while view.step() is None:
        pass
    controls.press("left", *dragged(0))
    wall, cpu, coarse = [], [], []
    for k in range(1, events + _WARM_UP + 1):
        start, spent = time.perf_counter(), cpu_seconds()
        controls.drag(*dragged(k))
        while (frame := view.step()) is None:
            pass
        wall.append(time.perf_counter() - start)
        cpu.append(cpu_seconds() - spent)
        coarse.append(frame.pixels.shape[1])
        assert frame.pixels.any(), "a blank picture"
    controls.release()
    return summary(wall[_WARM_UP:], cpu[_WARM_UP:], coarse[_WARM_UP:])


def measure_window(stage: str, events: int, size: tuple[int, int]) -> dict[str, float]:
    """Events of VTK's interactor, pictures in the window."""
    from warp_ir.view.window import ViewWindow, wait_for_frame

    view = open_view(stage, size)
    window = ViewWindow(view, Controls(view), stage)
    worker = threading.Thread(target=window._work, daemon=True)
    worker.start()
    interactor = window.picture.interactor
    assert wait_for_frame(window, 60.0)

    def at(k: int) -> None:
        x, y = dragged(k)
        interactor.SetEventInformation(int(x * size[0]), int(y * size[1]), 0, 0, "\0", 0, None)

    at(0)
    interactor.InvokeEvent("LeftButtonPressEvent")
    wall, cpu, coarse = [], [], []
    for k in range(1, events + _WARM_UP + 1):
        start, spent = time.perf_counter(), cpu_seconds()
        at(k)
        interactor.InvokeEvent("MouseMoveEvent")
        assert wait_for_frame(window, 60.0)
        wall.append(time.perf_counter() - start)
        cpu.append(cpu_seconds() - spent)
        coarse.append(window._frame.pixels.shape[1])
    interactor.InvokeEvent("LeftButtonReleaseEvent")
    view.close()
    worker.join()
    window.picture.close()
    return summary(wall[_WARM_UP:], cpu[_WARM_UP:], coarse[_WARM_UP:])


def use_for(stage: str, seconds: float, size: tuple[int, int]) -> dict[str, float]:
    """All that a user does, in turn, for some time; the largest memory in the first and in the second half of it."""
    view = open_view(stage, size)
    controls = Controls(view)
    generator = np.random.default_rng(0)
    start = time.perf_counter()
    memory, worst, frames, home = [], 0.0, 0, view.state.camera
    while (now := time.perf_counter() - start) < seconds:
        action = generator.integers(8)
        if action < 3:
            controls.press("left", *dragged(0), shift=action == 2)
            for k in range(1, 12):
                controls.drag(*dragged(k))
                event = time.perf_counter()
                while view.step() is None:
                    pass
                worst = max(worst, time.perf_counter() - event)
            controls.release()
        elif action == 3:
            view.navigate(lambda camera: navigation.walk(camera, view.up, 0.0, 0.0, 0.01 * view.scene.extent))
        elif action == 4:
            controls.key(str(generator.choice(list("bBvxt]["))))
        elif action == 5:
            controls.step_light(1)
            controls.switch_light()
            controls.switch_light()
        elif action == 6:
            view.resize(int(generator.integers(1, size[0])), int(generator.integers(1, size[1])))
        else:
            view.change(camera=home, width=size[0], height=size[1])
        rest = time.perf_counter() + 0.5
        while time.perf_counter() < rest:
            frames += view.step() is not None
        memory.append((now, resident_bytes() / 2**20))
    early = max(m for t, m in memory if t <= 0.5 * seconds)
    late = max(m for t, m in memory if t > 0.5 * seconds)
    return {"frames": frames, "worst_s": round(worst, 3), "early_MiB": round(early), "late_MiB": round(late)}


def open_view(stage: str, size: tuple[int, int]) -> LiveView:
    source = StageSource(lambda: ir.StageReader(stage, motion_blur=False))
    return LiveView(source, ir.RenderSettings(width=size[0], height=size[1]))


def summary(wall: list[float], cpu: list[float], coarse: list[int]) -> dict[str, float]:
    return {
        "wall_ms": round(1e3 * float(np.median(wall)), 1),
        "wall_90_ms": round(1e3 * float(np.quantile(wall, 0.9)), 1),
        "cpu_ms": round(1e3 * float(np.median(cpu)), 1),
        "columns": float(np.median(coarse)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "stages", nargs="*", default=[str(SCENES / f"{n}.usda") for n in ("cornell_box", "crowded_room")]
    )
    parser.add_argument("--events", type=int, default=60)
    parser.add_argument("--res", type=int, nargs=2, default=(480, 270))
    parser.add_argument("--window", action="store_true")
    parser.add_argument("--use", type=float, metavar="SECONDS", help="use the view for so long, and watch its memory")
    args = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    for stage in args.stages:
        size = tuple(args.res)
        if args.use:
            result = use_for(stage, args.use, size)
        else:
            result = (measure_window if args.window else measure_core)(stage, args.events, size)
        print(json.dumps({"stage": Path(stage).name, **result}), flush=True)


if __name__ == "__main__":
    main()
