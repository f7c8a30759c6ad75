"""Growth of time and memory with the numbers of pixels, triangles, light paths, lights and threads.

    python benchmarks/scaling.py [--device cpu] [--estimators NAME ...] [--quick] [--json FILE] [--markdown FILE]

One number is changed at a time in a procedural scene: a lit box with a wrinkled ball of any number of triangles. The
time is that of one iteration: the shortest of several, with all values of a question taking turns. The upload time is
reported as well.
"""

import argparse
import ctypes
import gc
import math
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from methods import own_methods
from report import Table, environment, number, publish

import warp_ir as ir
from warp_ir import procedural
from warp_ir.device.launcher import Launcher
from warp_ir.renderer import Renderer

SIZE = 10.0
"""Edge of the room in scene units."""


@dataclass(frozen=True)
class Question:
    """The cost of one number of the scene or the settings."""

    name: str
    values: tuple[int, ...]
    base: int
    """The value with which the others are compared."""
    goal: float
    """Upper limit of the time at the last value divided by the time at `base`."""

    def make(self, value: int, width: int) -> tuple[ir.Scene, dict[str, Any], int | None]:
        """Scene, settings and CPU threads (None: all) for one value."""
        settings: dict[str, Any] = {"width": width}
        match self.name:
            case "pixels":
                return room(), {"width": math.isqrt(value)}, None
            case "triangles":
                return room(triangles=value), settings, None
            case "light paths":
                return room(), {**settings, "light_paths": value}, None
            case "lights":
                return room(lights=value), settings, None
        return room(), settings, value


def questions(quick: bool, cores: int) -> list[Question]:
    """All questions with their goals."""
    if quick:
        return [Question("pixels", (32**2, 64**2), 32**2, 4.4), Question("lights", (1, 100), 1, 2.0)]
    all_questions = [
        Question("pixels", (64**2, 128**2, 256**2, 512**2), 128**2, 16 * 1.1),
        Question("triangles", (1_000, 10_000, 100_000, 1_000_000), 10_000, 3.0),
        Question("light paths", (256, 1024, 4096), 256, 2.0),
        Question("lights", (1, 100, 10_000), 1, 2.0),
    ]
    return [*all_questions, Question("threads", (1, 2), 1, 1 / 1.8)] if cores > 1 else all_questions


def ball(triangles: int) -> ir.Mesh:
    """A wrinkled ball of about that many triangles: a grid over the sphere, displaced by sine waves."""
    rows = max(4, int(np.sqrt(triangles / 4.0)))
    columns = 2 * rows
    theta, phi = np.meshgrid(
        np.pi * np.arange(rows + 1) / rows, 2 * np.pi * np.arange(columns) / columns, indexing="ij"
    )
    radius = 0.25 * SIZE * (1.0 + 0.08 * np.sin(9.0 * theta) * np.sin(8.0 * phi) + 0.02 * np.sin(40.0 * (theta + phi)))
    x, y, z = np.sin(theta) * np.cos(phi), np.cos(theta) + 0.0 * phi, np.sin(theta) * np.sin(phi)
    points = np.stack([x, y, z], axis=-1) * radius[..., None]
    i, j = np.indices((rows, columns))
    a, b = i * columns + j, i * columns + (j + 1) % columns
    quads = np.stack([a, b, b + columns, a + columns], axis=-1).reshape(-1, 4)
    return procedural.mesh("ball", points, quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3), 1)


def room(*, triangles: int = 10_000, lights: int = 1) -> ir.Scene:
    """The ball in a box, under a grid of lamps whose total power does not depend on their number."""
    walls, indices = procedural.cube(SIZE, inward=True)
    side = int(np.ceil(np.sqrt(lights)))
    lamps = []
    for k in range(lights):
        world = np.eye(4)
        # A RECT light emits along its own -Z: it is rotated to emit downwards.
        world[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
        x, z = (np.array([k % side, k // side]) + 0.5) / side - 0.5
        world[:3, 3] = [0.8 * SIZE * x, 0.49 * SIZE, 0.8 * SIZE * z]
        edge = 0.3 * SIZE / side
        radiance = 10.0 * side * side / lights
        lamps.append(ir.Light(f"lamp {k}", ir.LightKind.RECT, (radiance,) * 3, world, width=edge, height=edge))
    return ir.Scene(
        meshes=(procedural.mesh("room", walls, indices), ball(triangles)),
        materials=(ir.Material("wall", (0.7, 0.7, 0.7)), ir.Material("ball", (0.6, 0.4, 0.3))),
        lights=tuple(lamps),
        camera=ir.Camera.look_at((0.0, 0.1 * SIZE, 0.48 * SIZE), (0.0, 0.0, 0.0), fov=75.0),
        name="room",
    )


def iteration_seconds(renderers: dict[int, Renderer], seconds: float) -> dict[int, float]:
    """The shortest time of an iteration of each renderer.

    The renderers take turns for `seconds` each, at least three times after a warm-up.
    """
    films = {value: renderer.new_film() for value, renderer in renderers.items()}
    times: dict[int, list[float]] = {value: [] for value in renderers}
    spent = 0.0
    while min(map(len, times.values())) < 4 or spent < seconds * len(renderers):
        for value, renderer in renderers.items():
            start = time.perf_counter()
            renderer.add_iteration(films[value], films[value].iterations)
            times[value].append(time.perf_counter() - start)
            spent += times[value][-1]
    return {value: min(durations[1:]) for value, durations in times.items()}


def used_memory(device: wp.Device) -> int:
    """Memory in use [bytes]: that of the GPU, or the resident memory of this process."""
    gc.collect()
    if hasattr(ctypes.CDLL(None), "malloc_trim"):  # glibc keeps freed memory unless told to return it
        ctypes.CDLL(None).malloc_trim(0)
    if device.is_cuda:
        wp.synchronize_device(device)
        return device.total_memory - device.free_memory
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


def memory(device: str, estimator: dict[str, Any], quick: bool) -> dict[str, float]:
    """Growth of the process in bytes per triangle and per pixel, from a small scene or picture to a large one."""
    warp_device = wp.get_device(device)
    many, few = (100_000, 1_000) if quick else (1_000_000, 1_000)
    wide, narrow = (512, 64) if quick else (1024, 64)
    scenes = {count: room(triangles=count) for count in (few, many)}

    def growth_of(triangles: int, width: int) -> int:
        before = used_memory(warp_device)
        renderer = Renderer(scenes[triangles], ir.RenderSettings(width=width, **estimator), device=device)
        film = renderer.new_film()
        renderer.add_iteration(film, 0)
        renderer.add_iteration(film, 1)
        picture = film.radiance()
        growth = used_memory(warp_device) - before
        del renderer, film, picture
        return growth

    growth_of(few, narrow)  # allocates what is allocated only once
    base = growth_of(few, narrow)
    triangles = scenes[many].triangle_count - scenes[few].triangle_count
    return {
        "bytes_per_triangle": (growth_of(many, narrow) - base) / triangles,
        "bytes_per_pixel": (growth_of(few, wide) - base) / (wide**2 - narrow**2),
    }


def measure(device: str, name: str, estimator: dict[str, Any], quick: bool) -> list[dict[str, Any]]:
    """Measures the time of an iteration and of the upload for every value of every question."""
    width = 32 if quick else 128
    rows = []
    for question in questions(quick, Launcher(device).threads):
        renderers = {}
        for value in question.values:
            scene, settings, threads = question.make(value, width)
            renderers[value] = Renderer(
                scene, ir.RenderSettings(**{**estimator, **settings}), device=device, threads=threads
            )
        seconds = iteration_seconds(renderers, 0.02 if quick else 0.5)
        for value, renderer in renderers.items():
            rows.append(
                {
                    "estimator": name,
                    "question": question.name,
                    "value": value,
                    "seconds": seconds[value],
                    "ratio": seconds[value] / seconds[question.base],
                    "wanted": question.goal if value == question.values[-1] else None,
                    "upload": renderer.launcher.profile.seconds()["upload"],
                }
            )
    return rows


def frame_rate(device: str, estimator: dict[str, Any], quick: bool) -> dict[str, float]:
    """Iterations per second of a 1080p picture of 100 000 triangles (`quick`: of a small picture of 1 000)."""
    width, height, triangles = (64, 36, 1_000) if quick else (1920, 1080, 100_000)
    settings = ir.RenderSettings(**{**estimator, "width": width, "height": height})
    renderer = Renderer(room(triangles=triangles), settings, device=device)
    seconds = iteration_seconds({0: renderer}, 0.0)[0]
    return {"width": width, "height": height, "triangles": triangles, "iterations_per_second": 1.0 / seconds}


def tables(
    rows: list[dict[str, Any]], memories: dict[str, dict[str, float]], frames: dict[str, dict[str, float]]
) -> list[Table]:
    """Tables of the time relative to the base value of each question, of memory, and of the rate at full size."""
    lines = []
    for row in rows:
        goal, reached = "", ""
        if row["wanted"] is not None:
            goal, reached = f"< {row['wanted']:.3g}", "yes" if row["ratio"] < row["wanted"] else "no"
        times = (number(1e3 * row["seconds"]), number(row["ratio"]))
        cells = (f"{row['value']:,}", *times, goal, reached, number(row["upload"]))
        lines.append((row["question"], row["estimator"], *cells))
    columns = ("question", "estimator", "value", "ms per iteration", "× time", "goal", "reached", "upload s")
    growths = [
        (name, number(growth["bytes_per_triangle"]), "< 200", number(growth["bytes_per_pixel"]), "< 300")
        for name, growth in memories.items()
    ]
    heads = ("estimator", "bytes per triangle", "goal", "bytes per pixel", "goal")
    note = "Growth of the process without the scene's own arrays on the host."
    rates = [
        (
            name,
            f"{rate['width']} × {rate['height']}",
            f"{rate['triangles']:,}",
            number(rate["iterations_per_second"]),
        )
        for name, rate in frames.items()
    ]
    full_size = Table("Full size", ("estimator", "pixels", "triangles", "iterations per second"), rates)
    return [Table("Cost against size", columns, lines), Table("Memory", heads, growths, note), full_size]


def main(arguments: list[str] | None = None) -> int:
    """Measures and reports."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--device", default="cpu", help="cpu or cuda:N")
    parser.add_argument(
        "--estimators", nargs="+", metavar="NAME", help="estimators to measure (default: the default one and path)"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the tables")
    parser.add_argument("--quick", action="store_true", help="small sizes, to check that the program runs")
    options = parser.parse_args(arguments)
    known = own_methods(options.device)
    names = options.estimators or list(dict.fromkeys((ir.RenderSettings().estimator, "path")))
    if unknown := sorted(set(names) - set(known)):
        parser.error(f"no estimator {', '.join(unknown)}; there are {', '.join(known)}")
    wp.config.log_level = wp.LOG_WARNING
    rows, memories, frames = [], {}, {}
    for name in names:
        choices = known[name].choices
        memories[name] = memory(options.device, choices, options.quick)
        rows += measure(options.device, name, choices, options.quick)
        frames[name] = frame_rate(options.device, choices, options.quick)
    results = {"environment": environment(options.device), "scaling": rows, "memory": memories, "frames": frames}
    publish(tables(rows, memories, frames), results, json_path=options.json, markdown_path=options.markdown)
    return 0


if __name__ == "__main__":
    sys.exit(main())
