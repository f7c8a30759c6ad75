"""How fast rays and VPLs are: against Embree on the same triangles and rays, and against a loop that does nothing.

    python benchmarks/rays.py [-k NAME ...] [--device cpu] [--width 256] [--quick] [--json FILE] [--markdown FILE]

Camera rays go through the pixels in order, diffuse rays leave what they hit in cosine-weighted directions, and
shadow rays go from there to random VPLs: the three kinds that rendering consists of. Every number is the best of
several repetitions, for it is a limit that is looked for.
"""

import argparse
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from make_references import PICTURES, ROOT
from report import Table, environment, number, publish

import warp_ir as ir
from warp_ir.device.launcher import Launcher
from warp_ir.device_scene import CameraData, DeviceScene, SceneData, camera_data, upload_scene
from warp_ir.estimators.keller import geometry_term
from warp_ir.gbuffer import GBuffer, camera_ray, new_gbuffer, trace_primary
from warp_ir.surface import closest, visible
from warp_ir.vpl.emission import VplBuffer, emit_vpls
from warp_ir.vpl.guide import unguided

wp.set_module_options({"enable_backward": False})

SCENES = ("cornell_box", "corridor", "crowded_room", "thousand_lights", "two_rooms")
REPETITIONS = 5
PATHS = 256
"""Light paths whose VPLs are evaluated."""
CONNECTIONS = 1.9e11
"""1.9 million samples times 100 000 VPLs: the workload of Hašan et al. 2007, "Matrix Row-Column Sampling"."""


@wp.kernel
def _camera_rays(first: int, camera: CameraData, origins: wp.array[wp.vec3], directions: wp.array[wp.vec3]) -> None:
    """The ray through the middle of every pixel."""
    i = first + wp.tid()
    ray = camera_ray(camera, i, wp.vec2(0.5, 0.5), wp.vec2(0.0, 0.0))
    origins[i] = ray.origin
    directions[i] = ray.direction


@wp.kernel
def _closest(
    first: int, scene: SceneData, origins: wp.array[wp.vec3], directions: wp.array[wp.vec3], found: wp.array[wp.int32]
) -> None:
    """The triangle that each ray hits, or -1."""
    i = first + wp.tid()
    hit = closest(scene, origins[i], directions[i], 3.0e38)
    found[i] = hit.triangle


@wp.kernel
def _visible(
    first: int, scene: SceneData, origins: wp.array[wp.vec3], directions: wp.array[wp.vec3], found: wp.array[wp.int32]
) -> None:
    """0 where something lies on the way to origin + direction, else -1."""
    i = first + wp.tid()
    end = origins[i] + directions[i]
    found[i] = wp.where(visible(scene, origins[i], wp.vec4(end[0], end[1], end[2], 1.0)), -1, 0)


@wp.kernel
def _nothing(
    first: int, scene: SceneData, origins: wp.array[wp.vec3], directions: wp.array[wp.vec3], found: wp.array[wp.int32]
) -> None:
    """Reads and writes what the others do."""
    i = first + wp.tid()
    found[i] = wp.where(wp.dot(origins[i], directions[i]) > 0.0, -1, 0)


@wp.kernel
def _read_vpls(first: int, scene: SceneData, gbuffer: GBuffer, vpls: VplBuffer, out: wp.array[wp.vec3]) -> None:
    """The loop over VPLs with nothing in it but reading them."""
    i = first + wp.tid()
    total = wp.vec3(0.0)
    for k in range(vpls.count[0]):
        total += vpls.intensity[k] * (vpls.position[k][0] + vpls.normal[k][0])
    out[i] = total


@wp.kernel
def _light_by_vpls(first: int, scene: SceneData, gbuffer: GBuffer, vpls: VplBuffer, out: wp.array[wp.vec3]) -> None:
    """Unshadowed light: I G summed."""
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
    """Light with its shadows: I G V summed."""
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


def best_seconds(work: Callable[[], Any]) -> float:
    """The shortest of several repetitions, after one that does not count."""
    work()
    seconds = []
    for _ in range(REPETITIONS):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def ray_sets(camera: Any, gbuffer: Any, vpls: Any, launcher: Launcher) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Origins and directions, float32 [n, 3], of the three kinds; a shadow ray's direction leads to its VPL."""
    count = camera.columns * camera.rows
    origins, directions = launcher.empty(count, wp.vec3), launcher.empty(count, wp.vec3)
    launcher.launch(_camera_rays, count, [camera, origins, directions])
    random = np.random.default_rng(1)
    seen = gbuffer.mesh.numpy() >= 0
    position, normal = gbuffer.position.numpy()[seen], gbuffer.normal_or_direct.numpy()[seen]
    # A point on the unit sphere around the tip of the normal is a cosine-weighted direction.
    sphere = random.normal(size=normal.shape)
    diffuse = normal + sphere / np.linalg.norm(sphere, axis=1, keepdims=True) * 0.9999
    near = vpls.position.numpy()[: vpls.count.numpy()[0]]
    near = near[near[:, 3] == 1.0, :3]
    result = {"camera": (origins.numpy(), directions.numpy()), "diffuse": (position, diffuse.astype(np.float32))}
    if len(near) and len(position):
        result["shadow"] = (position, near[random.integers(len(near), size=len(position))] - position)
    return result


class Embree:
    """The same triangles in Embree, single rays, on as many threads as we use."""

    def __init__(self, scene: DeviceScene, threads: int) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._scene = EmbreeScene()
        points, indices = scene.data.points.numpy(), scene.data.indices.numpy().reshape(-1, 3)
        TriangleMesh(self._scene, points, indices)
        self._threads = threads
        self._pool = ThreadPoolExecutor(threads)

    def trace(self, origins: np.ndarray, directions: np.ndarray, *, shadow: bool) -> np.ndarray:
        """The triangle hit or -1; for shadow rays 0 or -1."""

        def part(k: int) -> np.ndarray:
            span = slice(len(origins) * k // self._threads, len(origins) * (k + 1) // self._threads)
            if not shadow:
                return self._scene.run(origins[span], directions[span], query="INTERSECT")
            reach = np.full(span.stop - span.start, 0.999999, np.float32)
            return self._scene.run(origins[span], directions[span], dists=reach, query="OCCLUDED")

        return np.concatenate(list(self._pool.map(part, range(self._threads))))


def measure(name: str, scene: ir.Scene, device: str, width: int) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Rays per second of every kind, and VPL evaluations per second."""
    launcher = Launcher(device)
    launcher.load([sys.modules[__name__]])
    uploaded = upload_scene(scene, launcher)
    settings = ir.RenderSettings(width=width, height=width)
    camera = camera_data(scene.camera, uploaded.frame, settings)
    gbuffer, _ = new_gbuffer(launcher, width, width, mapped=uploaded.data.normal_map_count > 0, glows=True)
    trace_primary(uploaded, camera, launcher, gbuffer, iteration=0, seed=0)
    vpls = emit_vpls(
        unguided(uploaded, launcher),
        launcher,
        paths=PATHS,
        absorption="roulette",
        max_bounces=settings.max_bounces,
        scramble=1,
    )
    try:
        embree = Embree(uploaded, launcher.threads) if device == "cpu" else None
    except ImportError:
        embree = None

    def timed(kernel: Any, count: int, inputs: list[Any]) -> float:
        def work() -> None:
            launcher.launch(kernel, count, [uploaded.data, *inputs])
            wp.synchronize_device(launcher.device)

        return best_seconds(work)

    rows = []
    for kind, (origins, directions) in ray_sets(camera, gbuffer, vpls, launcher).items():
        count, shadow = len(origins), kind == "shadow"
        found = launcher.empty(count, wp.int32)
        inputs = [launcher.array(origins, wp.vec3), launcher.array(directions, wp.vec3), found]
        row = {"scene": name, "kind": kind, "rays": count, "empty": count / timed(_nothing, count, inputs)}
        row["ours"] = count / timed(_visible if shadow else _closest, count, inputs)
        if embree is not None:
            row["embree"] = count / best_seconds(lambda o=origins, d=directions, s=shadow: embree.trace(o, d, shadow=s))
            theirs = embree.trace(origins, directions, shadow=shadow)
            row["agree"] = float(np.mean(found.numpy() == theirs))
        rows.append(row)

    side = max(1, width // 4)  # brute force is slow: a smaller picture will do
    small = camera_data(scene.camera, uploaded.frame, ir.RenderSettings(width=side, height=side))
    gbuffer, _ = new_gbuffer(launcher, side, side, mapped=uploaded.data.normal_map_count > 0, glows=True)
    trace_primary(uploaded, small, launcher, gbuffer, iteration=0, seed=0)
    out = launcher.empty(side * side, wp.vec3)
    n = int(vpls.count.numpy()[0])
    gather: dict[str, Any] = {"scene": name, "vpls": n}
    for label, kernel in {"empty": _read_vpls, "unshadowed": _light_by_vpls, "shadowed": _shadowed_vpls}.items():
        gather[label] = side * side * n / timed(kernel, side * side, [gbuffer, vpls, out])
    return rows, gather


def tables(rows: list[dict[str, Any]], gathers: list[dict[str, Any]]) -> list[Table]:
    """Both results as text, in millions per second."""

    def millions(row: dict[str, Any], key: str) -> str:
        return number(row[key] / 1e6) if key in row else "–"

    rays = []
    for row in rows:
        ratio = number(row["ours"] / row["embree"]) if "embree" in row else "–"
        agree = f"{100.0 * row['agree']:.3f} %" if "agree" in row else "–"
        speeds = [millions(row, key) for key in ("ours", "embree", "empty")]
        rays.append((row["scene"], row["kind"], *speeds, ratio, agree))
    note = "Same triangles, rays and threads; Embree by single rays through embreex."
    columns = ("scene", "kind", "ours M/s", "Embree M/s", "empty kernel M/s", "ours / Embree", "same answer")
    lines = []
    for row in gathers:
        speeds = [millions(row, key) for key in ("shadowed", "unshadowed", "empty")]
        lines.append((row["scene"], str(row["vpls"]), *speeds, number(CONNECTIONS / row["shadowed"])))
    heads = ("scene", "VPLs", "with shadow ray M/s", "without M/s", "reading alone M/s", "1.9·10¹¹ take s")
    return [
        Table("Rays per second", columns, rays, note),
        Table("VPL evaluations per second, by brute force", heads, lines),
    ]


def main(arguments: list[str] | None = None) -> int:
    """Measures and reports."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    names = sorted({stem for stem, *_ in PICTURES.values()})
    parser.add_argument("-k", dest="names", nargs="+", metavar="NAME", choices=names, help="scenes")
    parser.add_argument("--device", default="cpu", help="cpu or cuda:N; Embree runs beside cpu alone")
    parser.add_argument("--quick", action="store_true", help="one scene: does it run?")
    parser.add_argument("--width", type=int, default=256, help="of the square picture whose rays are traced")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the tables")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    rows, gathers = [], []
    for name in options.names or SCENES[: 1 if options.quick else None]:
        scene = ir.load_usd(ROOT / "scenes_usd" / f"{name}.usda")
        found, gather = measure(name, scene, options.device, options.width)
        rows += found
        gathers.append(gather)
    results = {"environment": environment(options.device), "rays": rows, "gather": gathers}
    publish(tables(rows, gathers), results, json_path=options.json, markdown_path=options.markdown)
    return 0


if __name__ == "__main__":
    sys.exit(main())
