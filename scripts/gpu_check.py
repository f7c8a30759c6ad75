"""Runs what only a GPU can show: one command, at most 8 minutes, no network; the most important comes first.

    python scripts/gpu_check.py --compile-for sm_90                 # beforehand, where there need be no GPU
    python scripts/gpu_check.py [--device cuda:0] [--minutes 8] [--only STEP ...]
    python scripts/gpu_check.py --device cpu --quick                # a rehearsal

Every step is a process of its own with a time box, so that one that hangs or crashes costs only its box. Results are
written as they come: `results.jsonl` (a line each), `summary.md` and what the steps print, in `out/gpu_check/`. The
exit code is 1 if a check failed. Kernels are kept in `out/kernels/` (or WARP_CACHE_PATH), which can be carried from
machine to machine. Warp looks them up there by the hash of their source and options, the architecture and the format,
none of which depends on the machine; the format is fixed to machine code (cubin) here, because Warp would otherwise
take PTX for compute_75, which the driver then compiles.
"""

import argparse
import gc
import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]
KERNELS = ROOT / "out" / "kernels"
SETTINGS = {"width": 48, "height": 48, "iterations": 2}
REPEATS = 8
"""Seeds of a picture whose mean two devices must agree on."""

Record = dict[str, Any]


def start(options: argparse.Namespace) -> Record:
    """The machine, and how long the first picture takes."""
    begin = time.perf_counter()
    import warp as wp
    from report import environment

    import warp_ir as ir
    from warp_ir.procedural import cornell_box

    film = ir.render(cornell_box(), ir.RenderSettings(**SETTINGS), device=options.device)
    compiled = film.timings.get("compile", 0.0)
    record = {"seconds": time.perf_counter() - begin, "compile": compiled, **environment(options.device)}
    device = wp.get_device(options.device)
    if device.is_cuda:
        record |= {"arch": device.arch, "driver": str(wp.get_cuda_driver_version()), "memory": device.total_memory}
    yield {"name": "first picture", "ok": bool(film.radiance().mean() > 0.0), **record}


def _cases() -> Iterator[tuple[str, Any, Record]]:
    """Scenes with settings that together need every kernel, and random ones."""
    from hash_pictures import blurred, instanced, stage
    from random_scenes import random_scene

    import warp_ir as ir
    from warp_ir.procedural import cornell_box, furnace

    box = cornell_box()
    for name in ("path", "keller", "vpl"):
        yield f"cornell box, {name}", box, {"estimator": name}
    yield "cornell box, unfiltered", box, {"filter": False}
    yield "cornell box, direct", box, {"max_bounces": 0}
    yield "furnace", furnace(0.5, level=3), {}
    yield "lens", stage("cornell_box", lens_radius=0.1, focus_distance=3.0)(), {}
    yield "lens, path", stage("cornell_box", lens_radius=0.1, focus_distance=3.0)(), {"estimator": "path"}
    yield "motion", blurred(), {"iterations": 4}
    yield "instances", instanced(), {}
    yield "instances, path", instanced(), {"estimator": "path"}
    yield "lights in view", stage("light_types")(), {"visible_lights": True}
    scenes = sorted((ROOT / "scenes_usd").glob("*.usda"), key=lambda path: path.stat().st_size)
    for seed in range(10):
        yield f"random {seed}", random_scene(seed), {}
        if seed < len(scenes):
            yield scenes[seed].stem, ir.load_usd(scenes[seed]), {}
    for seed in range(10, 20):
        yield f"random {seed}, path", random_scene(seed), {"estimator": "path"}
    for path in scenes[10:]:
        yield path.stem, ir.load_usd(path), {}
    for seed in range(20, 1000):
        yield f"random {seed}", random_scene(seed), {}


def agreement(options: argparse.Namespace) -> Iterator[Record]:
    """The CPU's picture and the GPU's agree: in most pixels where samples are the same numbers, in the mean always.

    Random scenes follow each other until the time box ends.
    """
    import numpy as np

    import warp_ir as ir

    for name, scene, more in _cases():
        pictures = {
            device: np.array(
                [
                    ir.render(scene, ir.RenderSettings(**{**SETTINGS, "seed": seed, **more}), device=device).radiance()
                    for seed in range(2 if options.quick else REPEATS)
                ]
            )
            for device in ("cpu", options.device)
        }
        cpu, gpu = pictures["cpu"], pictures[options.device]
        means = [p.mean(axis=(1, 2, 3), dtype=np.float64) for p in (cpu, gpu)]
        error = float(np.sqrt(sum(m.var(ddof=1) for m in means) / len(cpu)))
        level = float(means[0].mean())
        difference = float(means[1].mean()) - level
        # The same samples give the same mean up to rays at edges. In vpl a light path that takes another way at an edge
        # moves the sets of those that follow it: then means agree within the noise.
        close = abs(difference) <= max(2e-3 * level, 5.0 * error)
        different = float((np.abs(cpu - gpu).max(axis=3) > 2e-3 * level).mean())
        same = different <= 0.05 or more.get("estimator", "vpl") == "vpl"
        yield {
            "name": name,
            "ok": bool(np.isfinite(gpu).all() and close and same),
            "mean_ratio": difference / level if level > 0.0 else 0.0,
            "z": difference / error if error > 0.0 else 0.0,
            "different_pixels": different,
        }


WAYS: dict[str, Record] = {
    "as it is": {},
    "without graphs": {"graphs": False},
    "pixels in no order": {"_KEY_BITS": 0},
    "short waves": {"MAX_WAVE": 4096},
    "one kernel": {"wavefront": False},
}
"""Ways to gather: attributes of the launcher, or of `estimators.wavefront`. The first four have the same bits."""


def _gather(scene: Any, way: str, device: str, iterations: int, **settings: Any) -> tuple[Any, float, float, Any]:
    """A picture made in one of the `WAYS`, its seconds an iteration by the clock and in gathering, and its film."""
    import warp_ir as ir
    from warp_ir.estimators import wavefront
    from warp_ir.renderer import Renderer

    renderer = Renderer(scene, ir.RenderSettings(iterations=iterations, **settings), device=device)
    launcher, before = renderer.launcher, {name: getattr(wavefront, name) for name in ("_KEY_BITS", "MAX_WAVE")}
    launcher.wavefront, launcher.graphs, launcher.synchronous = True, True, False  # the CPU rehearses it
    for name, value in WAYS[way].items():
        setattr(launcher if hasattr(launcher, name) else wavefront, name, value)
    try:
        film, warm_up = renderer.new_film(), 3  # kernel by kernel, recorded, replayed
        for k in range(iterations):
            if k == warm_up:
                begin, phases = time.perf_counter(), launcher.profile.seconds()
            renderer.add_iteration(film, k)
        seconds = (time.perf_counter() - begin) / (iterations - warm_up)
        gathering = launcher.profile.since(phases)["gather"] / (iterations - warm_up)
        renderer.report_profile(film)
    finally:
        for name, value in before.items():
            setattr(wavefront, name, value)
    return film.radiance(), seconds, gathering, film


def gathering(options: argparse.Namespace) -> Iterator[Record]:
    """Graphs, the order of pixels and the size of waves change no bit; and what each of them gains."""
    import numpy as np
    import warp as wp
    from random_scenes import random_scene

    from warp_ir.procedural import cornell_box

    sizes = [(64, 64)] if options.quick else [(256, 256), (1920, 1080)]
    for (name, scene), (width, height) in (
        (case, size) for size in sizes for case in (("cornell box", cornell_box()), ("crowd", random_scene(8)))
    ):
        expected = None
        for way in WAYS:
            iterations = 5 if options.quick else 13
            found, seconds, gathered, film = _gather(scene, way, options.device, iterations, width=width, height=height)
            expected = found if expected is None else expected
            different = float((np.abs(found - expected).max(axis=2) > 1e-3 * expected.mean()).mean())
            # One kernel draws the same VPLs, but for rounding.
            same = np.array_equal(found, expected) if way != "one kernel" else different <= 0.01
            replayed = film.counts["graph_launches"] > 0 or way == "without graphs"
            yield {
                "name": f"{name}, {width} x {height}, {way}",
                "ok": bool(same and replayed),
                "iterations_per_second": 1.0 / seconds,
                "gather_seconds": gathered,
                "different_pixels": different,
                "graph_launches": film.counts["graph_launches"],
            }
    if wp.get_device(options.device).is_cuda:
        wp.timing_begin(wp.TIMING_KERNEL | wp.TIMING_MEMSET | wp.TIMING_MEMCPY)
        _gather(random_scene(8), "without graphs", options.device, 13, width=1920, height=1080)
        spent: dict[str, list[float]] = {}
        for result in wp.timing_end():
            spent.setdefault(result.name, []).append(result.elapsed)
        for name, times in sorted(spent.items(), key=lambda item: -sum(item[1]))[:25]:
            yield {"name": f"kernel {name}", "milliseconds": sum(times) / len(times), "launches": len(times)}


def leaks(options: argparse.Namespace) -> Iterator[Record]:
    """No ray escapes from closed meshes through edges or vertices, and no light comes through a wall."""
    import numpy as np
    import rays
    import warp as wp

    import warp_ir as ir
    from warp_ir.device.launcher import Launcher
    from warp_ir.device_scene import upload_scene
    from warp_ir.procedural import cube, mesh, sphere
    from warp_ir.scene import Camera, Light, LightKind, Scene

    launcher, random = Launcher(options.device), np.random.default_rng(1)
    count = 20_000 if options.quick else 2_000_000
    for name, (points, triangles) in {"cube": cube(), "ball": sphere(level=2), "fine ball": sphere(level=6)}.items():
        for shift in (0.0, 0.4, 1e3):
            scene = Scene((mesh(name, points + shift, triangles),))
            uploaded = upload_scene(scene, launcher)  # owns what its data refers to
            data = uploaded.data
            corners = data.points.numpy()[data.indices.numpy().reshape(-1, 3)]
            chosen = corners[random.integers(len(corners), size=count)]
            share = np.round(random.random((count, 1)) * 1.5, 3).clip(0.0, 1.0)  # a third end at a vertex
            aims = share * chosen[:, 0] + (1.0 - share) * chosen[:, 1]
            origins = np.broadcast_to(corners.mean(axis=(0, 1)) + 0.03 * np.ptp(corners, axis=(0, 1)), aims.shape)
            inputs = [launcher.array(np.ascontiguousarray(x, np.float32), wp.vec3) for x in (origins, aims - origins)]
            out = launcher.empty(count, wp.int32)
            launcher.launch(rays._closest, count, [data, *inputs, out])
            escaped = int((out.numpy() < 0).sum())
            yield {"name": f"{name} at {shift:g}", "ok": escaped == 0, "escaped": escaped, "rays": count}
    outside = np.eye(4)
    outside[:3, 3] = 0.3, 0.2, 1.5
    dark = Scene(
        (mesh("room", *cube(inward=True)),),
        lights=(Light("lamp", LightKind.POINT, (100.0,) * 3, outside), Light("sky", LightKind.DOME, (1.0,) * 3)),
        camera=Camera.look_at((0.2, 0.1, 0.3), (0.0, 0.0, -1.0), fov=90.0),
    )
    for name in ("path", "keller", "vpl"):
        settings = ir.RenderSettings(width=64, height=64, iterations=16, estimator=name)
        brightest = float(ir.render(dark, settings, device=options.device).radiance().max())
        yield {"name": f"dark room, {name}", "ok": brightest == 0.0, "brightest": brightest}


def tests(options: argparse.Namespace) -> Iterator[Record]:
    """The tests that need CUDA, and those that take a device, as far as the time box goes."""
    import pytest

    class Report:
        def __init__(self) -> None:
            self.passed, self.failed = 0, []

        def pytest_runtest_logreport(self, report: Any) -> None:
            if report.failed:
                self.failed.append(report.nodeid)
            self.passed += report.passed and report.when == "call"

    os.chdir(ROOT)
    arguments = ["-n", "0", "-q", "--no-header", "--device", options.device, "--rootdir", str(ROOT)]
    marked = [path for path in sorted(Path("tests").rglob("test_*.py")) if "mark.gpu" in path.read_text()]
    physics = sorted(Path("tests/physics").glob("test_*.py"))
    plain, extended = "not slow and not gpu and not extended", "extended and not slow and not gpu"
    selections = [("gpu", path) for path in marked if options.device != "cpu"]
    selections += [(marks, path) for marks in (plain, extended) for path in physics]
    for marks, path in selections[: 2 if options.quick else None]:
        report = Report()
        code = int(pytest.main([*arguments, "-m", marks, str(path)], plugins=[report]))
        if code != 5:  # there is one
            result = {"passed": report.passed, "failed": report.failed}
            yield {"name": f"{path.name}, -m '{marks}'", "ok": code == 0, **result}


def speed(options: argparse.Namespace) -> Iterator[Record]:
    """Iterations per second at 1080p, the time by phase, and the memory."""
    import warp as wp
    from random_scenes import random_scene

    import warp_ir as ir
    from warp_ir.procedural import cornell_box
    from warp_ir.renderer import Renderer

    device = wp.get_device(options.device)
    width, height, iterations = (192, 108, 2) if options.quick else (1920, 1080, 60)

    def used() -> int:
        if device.is_cuda and wp.is_mempool_enabled(device):
            return int(wp.get_mempool_used_mem_current(device))
        if device.is_cuda:
            return int(device.total_memory - device.free_memory)
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    scenes = {"cornell box": cornell_box(), "crowd": random_scene(8), "lamps": random_scene(9)}
    for name, scene in scenes.items():
        for more in ({}, {"filter": False}, {"estimator": "path"}):
            settings = ir.RenderSettings(width=width, height=height, iterations=iterations, **more)
            gc.collect()
            before = used()
            renderer = Renderer(scene, settings, device=options.device)
            film = renderer.new_film()
            for k in range(2):  # warms up
                renderer.add_iteration(film, k)
            begin, phases = time.perf_counter(), renderer.launcher.profile.seconds()
            for k in range(2, iterations + 2):
                renderer.add_iteration(film, k)
            seconds = time.perf_counter() - begin
            spent = renderer.launcher.profile.since(phases)
            begin = time.perf_counter()
            film.radiance()
            yield {
                "name": f"{name} {more or 'vpl'}",
                "iterations_per_second": iterations / seconds,
                "picture_seconds": time.perf_counter() - begin,
                "phases_per_iteration": {phase: t / iterations for phase, t in spent.items() if t > 0.0},
                "bytes": used() - before,
                "bytes_per_pixel": (used() - before) / (width * height),
            }
            del renderer, film


def rays_per_second(options: argparse.Namespace) -> Iterator[Record]:
    """Rays and VPL evaluations per second, of which `benchmarks/rays.py` tells more."""
    import rays

    import warp_ir as ir

    for name in rays.SCENES[: 1 if options.quick else None]:
        scene = ir.load_usd(ROOT / "scenes_usd" / f"{name}.usda")
        rows, gather = rays.measure(name, scene, options.device, 64 if options.quick else 1024)
        for row in rows:
            yield {"name": f"{name}, {row['kind']}", "rays_per_second": row["ours"], "empty": row["empty"]}
        yield {"name": f"{name}, evaluations", **{k: gather[k] for k in ("shadowed", "unshadowed", "empty")}}
        yield {"name": f"{name}, 1.9e11 connections", "seconds": rays.CONNECTIONS / gather["shadowed"]}


def error(options: argparse.Namespace) -> Iterator[Record]:
    """Error against time, beside Mitsuba's CUDA mode where that is installed."""
    from analysis import summarize
    from methods import load_task, own_methods
    from peers import find_peers
    from run import measure

    peers, missing = ({}, {}) if options.quick else find_peers(options.device)
    yield {"name": "peers", "found": list(peers), "missing": missing}
    chosen = [method for name, method in own_methods(options.device).items() if name != "keller"]
    for name in ("cornell_box", "crowded_room", "corridor", "light_types")[: 1 if options.quick else None]:
        task, methods = load_task(name), [*chosen, *peers.values()]
        for method in methods:
            method.prepare(task, [0.1])
        for row in summarize(measure(task, methods, [0.05, 0.2, 1.0][: 1 if options.quick else None], 3)):
            shown = {key: row[key] for key in ("method", "budget", "seconds", "samples", "error", "mean_ratio", "flip")}
            yield {"name": name, **shown}


STEPS: dict[str, tuple[Callable[[argparse.Namespace], Iterator[Record]], float]] = {
    "start": (start, 60.0),
    "agreement": (agreement, 100.0),
    "gathering": (gathering, 40.0),
    "tests": (tests, 70.0),
    "leaks": (leaks, 40.0),
    "speed": (speed, 70.0),
    "rays_per_second": (rays_per_second, 40.0),
    "error": (error, 60.0),
}
"""The steps of the check in their order, each with its time box [s]; together 8 minutes."""


def compile_for(arch: int) -> int:
    """Compiles every kernel of the package and of `rays.py` into `KERNELS`; returns the number of modules.

    The launcher's block size is one of the options that are hashed. What is there already is left alone.
    """
    _configure_warp()
    import warp as wp

    from warp_ir.device import definitions
    from warp_ir.device.launcher import _BLOCK_DIM

    files = [path for path in (ROOT / "warp_ir").rglob("*.py") if "@wp.kernel" in path.read_text()]
    for folder, module in (("newton", "newton"), ("mujoco", "mujoco_warp")):
        if importlib.util.find_spec(module) is None:
            files = [path for path in files if path.parent.name != folder]
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in sorted(files)]
    for name in [*names, "rays"]:
        importlib.import_module(name)
    definitions.define_all()
    modules = [m for m in (wp.get_module(name) for name in [*names, "rays"]) if m.kernels]
    for module in modules:
        module.options["block_dim"] = _BLOCK_DIM
    wp.init()
    have = {path.name for path in Path(wp.config.kernel_cache_dir).glob(f"*/*.sm{arch}.cubin")}
    new = [m for m in modules if f"{m.get_module_identifier()}.sm{arch}.cubin" not in have]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(lambda m: wp.compile_aot_module(m, arch=arch, use_ptx=False), new))
    return len(modules)


def _configure_warp() -> None:
    """Kernels as machine code, in a folder that can be carried."""
    os.environ.setdefault("WARP_CACHE_PATH", str(KERNELS))
    import warp as wp

    wp.config.cuda_output = "cubin"
    wp.config.log_level = wp.LOG_WARNING


def run_step(name: str, options: argparse.Namespace, out: Path) -> None:
    """Runs a step in this process; its records go to the file as they come."""
    _configure_warp()
    with (out / "results.jsonl").open("a") as file:
        begin = time.perf_counter()
        for record in STEPS[name][0](options):
            file.write(json.dumps({"step": name, "at": round(time.perf_counter() - begin, 2), **record}) + "\n")
            file.flush()


def summary(ended: dict[str, str], out: Path) -> tuple[str, bool]:
    """The results as Markdown, and whether all checks passed."""
    lines, good = ["# GPU check", ""], all(not how.startswith("exit") for how in ended.values())
    records = [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]
    for step, how in ended.items():
        own = [r for r in records if r["step"] == step]
        failed = [r for r in own if not r.get("ok", True)]
        good &= not failed and bool(own)
        lines += [f"## {step}: {how}, {len(own)} results, {len(failed)} failed", ""]
        for r in own:
            values = {k: v for k, v in r.items() if k not in ("step", "at", "name", "ok")}
            shown = ", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in values.items())
            lines.append(f"* {'FAILED ' if r in failed else ''}{r['name']}: {shown}")
        lines.append("")
    return "\n".join(lines), good


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--device", default="cuda:0", help="cuda:N, or cpu to rehearse (default: cuda:0)")
    parser.add_argument("--minutes", type=float, default=8.0, help="limit, by which time boxes scale (default: 8)")
    parser.add_argument("--only", nargs="+", choices=STEPS, default=list(STEPS), help="steps to run (default: all)")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "out" / "gpu_check", help="folder of the results (default: out/gpu_check)"
    )
    parser.add_argument("--quick", action="store_true", help="small sizes, to see whether the program runs")
    parser.add_argument("--compile-for", metavar="sm_NN", help="only compile the kernels for an architecture")
    parser.add_argument("--step", choices=STEPS, help=argparse.SUPPRESS)  # how a step's process is started
    options = parser.parse_args()
    if options.compile_for:
        print(f"{compile_for(int(options.compile_for.removeprefix('sm_')))} modules are in {KERNELS}")
        return 0
    out = options.out
    out.mkdir(parents=True, exist_ok=True)
    if options.step:
        run_step(options.step, options, out)
        return 0
    (out / "results.jsonl").write_text("")
    end, ended = time.monotonic() + 60.0 * options.minutes, {}
    good = True
    for name in options.only:
        box = min(STEPS[name][1] * options.minutes / 8.0, end - time.monotonic())
        if box < 5.0:
            ended[name] = "no time left"
            continue
        command = [sys.executable, __file__, "--step", name, "--device", options.device, "--out", str(out)]
        with (out / f"{name}.log").open("w") as log:
            begin = time.monotonic()
            process = subprocess.Popen(
                command + ["--quick"] * options.quick, stdout=log, stderr=log, start_new_session=True
            )
            try:
                code = process.wait(box)
                ended[name] = "done" if code == 0 else f"exit code {code}"
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, 9)
                process.wait()
                ended[name] = f"stopped at its time box of {box:.0f} s"
        ended[name] += f" ({time.monotonic() - begin:.0f} s)"
        print(f"{name}: {ended[name]}", flush=True)
        text, good = summary(ended, out)
        (out / "summary.md").write_text(text)
    print(f"{'All passed' if good else 'FAILED'}: {out / 'summary.md'}")
    return int(not good)


if __name__ == "__main__":
    sys.exit(main())
