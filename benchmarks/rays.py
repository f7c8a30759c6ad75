"""Throughput of rays and VPL evaluations, compared with Embree on the same rays and with loops without work.

    python benchmarks/rays.py [-k NAME ...] [--device cpu] [--width 256] [--quick] [--json FILE] [--markdown FILE]

Camera rays pass through the pixels in order, diffuse rays leave the hit points in cosine-weighted directions, and
shadow rays connect the hit points to random VPLs: these are the three types of rays in a render. Every number is the
best of several repetitions, because the limit of the throughput is measured. On the CPU it is per thread and second of
CPU time, which other processes disturb less than they do the clock.
"""

import argparse
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp
from make_references import PICTURES, ROOT
from report import Table, environment, number, publish

import warp_ir as ir
from warp_ir.device.launcher import Launcher
from warp_ir.device.scratch import Scratch
from warp_ir.device_scene import CameraData, DeviceScene, SceneData, camera_data, upload_scene
from warp_ir.gbuffer import GBuffer, camera_ray, new_gbuffer, trace_primary
from warp_ir.settings import UNLIMITED
from warp_ir.surface import closest, visible
from warp_ir.vpl.contribution import geometry_term
from warp_ir.vpl.emission import VplBuffer, emit_vpls
from warp_ir.vpl.guide import unguided

wp.set_module_options({"enable_backward": False})

Vectors = npt.NDArray[np.floating]
SCENES = ("cornell_box", "corridor", "crowded_room", "thousand_lights", "two_rooms")
REPETITIONS = 5
PATHS = 256
"""Light paths that create the VPLs."""
GAP_BEFORE = "It was 1.9 to 3.4 times as fast when traversal was written in Warp; the goal is 1.5."
"""What Embree / ours was for crowded_room, cornell_box and two_rooms at a width of 128 (single run)."""
CONNECTIONS = 1.9e11
"""VPL evaluations: 1.9 million samples times 100 000 VPLs, as in Hašan et al. 2007, "Matrix Row-Column Sampling"."""


@wp.kernel
def _camera_rays(first: int, camera: CameraData, origins: wp.array[wp.vec3], directions: wp.array[wp.vec3]) -> None:
    """The ray through the middle of every pixel."""
    i = first + wp.tid()
    ray = camera_ray(camera, i, wp.vec2(0.5, 0.5), wp.vec2(0.0, 0.0))
    origins[i] = ray.origin
    directions[i] = ray.direction


@wp.kernel
def _closest(
    first: int,
    scene: SceneData,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    triangles: wp.array[wp.int32],
) -> None:
    """The triangle that each ray hits, or -1."""
    i = first + wp.tid()
    hit = closest(scene, origins[i], directions[i], 3.0e38)
    triangles[i] = hit.triangle


@wp.kernel
def _visible(
    first: int,
    scene: SceneData,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    triangles: wp.array[wp.int32],
) -> None:
    """0 where the segment from the origin to origin + direction is blocked, else -1."""
    i = first + wp.tid()
    end = origins[i] + directions[i]
    triangles[i] = wp.where(visible(scene, origins[i], wp.vec4(end[0], end[1], end[2], 1.0)), -1, 0)


@wp.kernel
def _empty_trace(
    first: int,
    scene: SceneData,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    triangles: wp.array[wp.int32],
) -> None:
    """Reads and writes the same memory as the tracing kernels, without tracing."""
    i = first + wp.tid()
    triangles[i] = wp.where(wp.dot(origins[i], directions[i]) > 0.0, -1, 0)


@wp.kernel
def _read_vpls(first: int, scene: SceneData, gbuffer: GBuffer, vpls: VplBuffer, out: wp.array[wp.vec3]) -> None:
    """Reads all VPLs for each pixel without evaluating them."""
    i = first + wp.tid()
    total = wp.vec3(0.0)
    for k in range(vpls.count[0]):
        total += vpls.intensity[k] * (vpls.position[k][0] + vpls.normal[k][0])
    out[i] = total


@wp.kernel
def _light_by_vpls(first: int, scene: SceneData, gbuffer: GBuffer, vpls: VplBuffer, out: wp.array[wp.vec3]) -> None:
    """Unshadowed illumination: the sum of I G over the VPLs."""
    i = first + wp.tid()
    total = wp.vec3(0.0)
    for k in range(vpls.count[0]):
        g = geometry_term(
            gbuffer.position[i],
            gbuffer.normal_or_direct[i],
            gbuffer.shading_normal[i],
            vpls.position[k],
            vpls.normal[k],
        )
        total += vpls.intensity[k] * g
    out[i] = total


@wp.kernel
def _shadowed_vpls(first: int, scene: SceneData, gbuffer: GBuffer, vpls: VplBuffer, out: wp.array[wp.vec3]) -> None:
    """Shadowed illumination: the sum of I G V over the VPLs."""
    i = first + wp.tid()
    total = wp.vec3(0.0)
    for k in range(vpls.count[0]):
        g = geometry_term(
            gbuffer.position[i],
            gbuffer.normal_or_direct[i],
            gbuffer.shading_normal[i],
            vpls.position[k],
            vpls.normal[k],
        )
        if g > 0.0 and visible(scene, gbuffer.position[i], vpls.position[k]):
            total += vpls.intensity[k] * g
    out[i] = total


def best_seconds(work: Callable[[], object], device: str) -> float:
    """The shortest duration [s] of several repetitions, after a warm-up: CPU time of all threads, on CUDA real time."""
    clock = time.process_time if device == "cpu" else time.perf_counter
    work()
    seconds = []
    for _ in range(REPETITIONS):
        start = clock()
        work()
        seconds.append(clock() - start)
    return min(seconds)


def ray_sets(
    camera: CameraData, gbuffer: GBuffer, vpls: VplBuffer, launcher: Launcher
) -> dict[str, tuple[Vectors, Vectors]]:
    """Origins and directions, float32 [n, 3], of the three types; a shadow ray's direction ends at its VPL."""
    count = camera.columns * camera.rows
    origins, directions = launcher.empty(count, wp.vec3), launcher.empty(count, wp.vec3)
    launcher.launch(_camera_rays, count, [camera, origins, directions])
    random = np.random.default_rng(1)
    hit = gbuffer.mesh.numpy() >= 0
    position, normal = gbuffer.position.numpy()[hit], gbuffer.normal_or_direct.numpy()[hit]
    # A point on the unit sphere around the tip of the normal is a cosine-weighted direction.
    sphere = random.normal(size=normal.shape)
    diffuse = normal + sphere / np.linalg.norm(sphere, axis=1, keepdims=True) * 0.9999
    targets = vpls.position.numpy()[: vpls.count.numpy()[0]]
    targets = targets[targets[:, 3] == 1.0, :3]  # without directional VPLs
    result = {"camera": (origins.numpy(), directions.numpy()), "diffuse": (position, diffuse.astype(np.float32))}
    if len(targets) and len(position):
        result["shadow"] = (position, targets[random.integers(len(targets), size=len(position))] - position)
    return result


class Embree:
    """Embree with the same triangles; it traces single rays on the same number of threads."""

    def __init__(self, scene: DeviceScene, threads: int) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._scene = EmbreeScene()
        points, indices = scene.data.points.numpy(), scene.data.indices.numpy().reshape(-1, 3)
        TriangleMesh(self._scene, points, indices)
        self._threads = threads
        self._pool = ThreadPoolExecutor(threads)

    def trace(self, origins: Vectors, directions: Vectors, *, shadow: bool) -> npt.NDArray[np.integer]:
        """The triangle that each ray hits, or -1; for shadow rays 0 (blocked) or -1."""

        def part(k: int) -> npt.NDArray[np.integer]:
            span = slice(len(origins) * k // self._threads, len(origins) * (k + 1) // self._threads)
            if not shadow:
                return self._scene.run(origins[span], directions[span], query="INTERSECT")
            t_max = np.full(span.stop - span.start, 0.999999, np.float32)
            return self._scene.run(origins[span], directions[span], dists=t_max, query="OCCLUDED")

        return np.concatenate(list(self._pool.map(part, range(self._threads))))


def measure(name: str, scene: ir.Scene, device: str, width: int) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Measures rays per second of each type, and VPL evaluations per second."""
    launcher = Launcher(device)
    launcher.load([sys.modules[__name__]])
    uploaded = upload_scene(scene, launcher)
    settings = ir.RenderSettings(width=width, height=width).resolve()
    camera = camera_data(scene.camera, uploaded.frame, settings)
    gbuffer, _ = new_gbuffer(
        launcher, width, width, has_normals=False, has_normal_maps=uploaded.data.normal_map_count > 0, has_emission=True
    )
    trace_primary(uploaded, camera, launcher, gbuffer, iteration=0, seed=0)
    vpls = emit_vpls(
        unguided(uploaded, launcher),
        Scratch(launcher),
        light_paths=PATHS,
        absorption="roulette",
        max_bounces=UNLIMITED,
        scramble=1,
    )
    try:
        embree = Embree(uploaded, launcher.threads) if device == "cpu" else None
    except ImportError:
        embree = None

    def seconds_of(kernel: wp.Kernel, count: int, inputs: list[object]) -> float:
        def work() -> None:
            launcher.launch(kernel, count, [uploaded.data, *inputs])
            wp.synchronize_device(launcher.device)

        return best_seconds(work, device)

    rows = []
    for kind, (origins, directions) in ray_sets(camera, gbuffer, vpls, launcher).items():
        count, shadow = len(origins), kind == "shadow"
        triangles = launcher.empty(count, wp.int32)
        inputs = [launcher.array(origins, wp.vec3), launcher.array(directions, wp.vec3), triangles]
        row = {"scene": name, "kind": kind, "rays": count, "empty": count / seconds_of(_empty_trace, count, inputs)}
        row["ours"] = count / seconds_of(_visible if shadow else _closest, count, inputs)
        if embree is not None:
            seconds = best_seconds(lambda o=origins, d=directions, s=shadow: embree.trace(o, d, shadow=s), device)
            row["embree"] = count / seconds
            theirs = embree.trace(origins, directions, shadow=shadow)
            row["agree"] = float(np.mean(triangles.numpy() == theirs))
        rows.append(row)

    side = max(1, width // 4)  # a smaller picture, because brute force is slow
    small = camera_data(scene.camera, uploaded.frame, ir.RenderSettings(width=side, height=side))
    gbuffer, _ = new_gbuffer(
        launcher, side, side, has_normals=False, has_normal_maps=uploaded.data.normal_map_count > 0, has_emission=True
    )
    trace_primary(uploaded, small, launcher, gbuffer, iteration=0, seed=0)
    out = launcher.empty(side * side, wp.vec3)
    n = int(vpls.count.numpy()[0])
    gather: dict[str, Any] = {"scene": name, "vpls": n}
    for label, kernel in {"empty": _read_vpls, "unshadowed": _light_by_vpls, "shadowed": _shadowed_vpls}.items():
        gather[label] = side * side * n / seconds_of(kernel, side * side, [gbuffer, vpls, out])
    return rows, gather


def tables(rows: list[dict[str, Any]], gathers: list[dict[str, Any]]) -> list[Table]:
    """Both results as tables, in millions per second."""

    def millions(row: dict[str, Any], key: str) -> str:
        return number(row[key] / 1e6) if key in row else "–"

    rays = []
    for row in rows:
        gap = number(row["embree"] / row["ours"]) if "embree" in row else "–"
        agree = f"{100.0 * row['agree']:.3f} %" if "agree" in row else "–"
        speeds = [millions(row, key) for key in ("ours", "embree", "empty")]
        rays.append((row["scene"], row["kind"], *speeds, gap, agree))
    note = "Same triangles, rays and threads; Embree traces single rays through embreex. " + GAP_BEFORE
    columns = ("scene", "kind", "ours M/s", "Embree M/s", "empty kernel M/s", "Embree / ours", "same result")
    lines = []
    for row in gathers:
        speeds = [millions(row, key) for key in ("shadowed", "unshadowed", "empty")]
        lines.append((row["scene"], str(row["vpls"]), *speeds, number(CONNECTIONS / row["shadowed"])))
    heads = ("scene", "VPLs", "with shadow ray M/s", "without M/s", "reading only M/s", "1.9·10¹¹ take s")
    return [
        Table("Rays per second", columns, rays, note),
        Table("VPL evaluations per second, by brute force", heads, lines),
    ]


def main(arguments: list[str] | None = None) -> int:
    """Measures and reports."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    names = sorted({stem for stem, *_ in PICTURES.values()})
    parser.add_argument("-k", dest="names", nargs="+", metavar="NAME", choices=names, help="scenes")
    parser.add_argument("--device", default="cpu", help="cpu or cuda:N; Embree is measured only with cpu")
    parser.add_argument("--quick", action="store_true", help="one scene only, to check that the program runs")
    parser.add_argument("--width", type=int, default=256, help="width of the square picture whose rays are traced")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the tables")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    rows, gathers = [], []
    for name in options.names or SCENES[: 1 if options.quick else None]:
        scene = ir.load_usd(ROOT / "scenes_usd" / f"{name}.usda")
        measured, gather = measure(name, scene, options.device, options.width)
        rows += measured
        gathers.append(gather)
    results = {"environment": environment(options.device), "rays": rows, "gather": gathers}
    publish(tables(rows, gathers), results, json_path=options.json, markdown_path=options.markdown)
    return 0


if __name__ == "__main__":
    sys.exit(main())
