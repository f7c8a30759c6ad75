"""Large loads: does what they take in memory agree with what the program predicts before it allocates?

    python benchmarks/loads.py [NAME ...] [--json FILE] [--markdown FILE]

Each load is a process of its own: the scene is made on the host; then what the process grows by in the upload and in
two iterations is compared with `warp_ir.memory`. `steady` is a thousand renders and a thousand updates of one scene.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import warp as wp
from report import Table, environment, number, publish
from scaling import room, used_memory

import warp_ir as ir
from warp_ir.device_scene.validate import upload_bytes
from warp_ir.memory import pixel_bytes, scene_bytes
from warp_ir.procedural import cornell_box, mesh, sphere
from warp_ir.renderer import Renderer
from warp_ir.scene import LightKind


def triangles() -> tuple[ir.Scene, ir.RenderSettings]:
    """Ten million triangles, a small picture."""
    return room(triangles=10_000_000), ir.RenderSettings(width=128, height=128, light_paths=1024)


def instances() -> tuple[ir.Scene, ir.RenderSettings]:
    """A million instances of a ball, a small picture."""
    points, faces = sphere(0.4, level=1)
    x, y, z = (g.reshape(-1) for g in np.mgrid[:100, :100, :100])
    matrices = np.tile(np.eye(4), (len(x), 1, 1))
    matrices[:, :3, 3] = np.stack([x, y, z], axis=1)
    scene = ir.Scene(
        (mesh("ball", points, faces),),
        (ir.Material("m", (0.5,) * 3),),
        (ir.Light("sky", LightKind.DOME, (1.0,) * 3),),
        ir.Camera.look_at((-40.0, 120.0, -40.0), (50.0, 50.0, 50.0)),
        instances=(ir.Instances("balls", (0,), matrices),),
    )
    return scene, ir.RenderSettings(width=128, height=128, light_paths=1024)


def dome() -> tuple[ir.Scene, ir.RenderSettings]:
    """A sky of 16384 x 8192 texels, a small picture."""
    texture = np.ones((8192, 16384, 3), np.float32)
    texture[::7, ::5] = 3.0
    sky = ir.Light("sky", LightKind.DOME, (1.0,) * 3, texture=texture)
    return replace(cornell_box(), lights=(sky,)), ir.RenderSettings(width=128, height=128, light_paths=1024)


def pixels() -> tuple[ir.Scene, ir.RenderSettings]:
    """7680 x 4320 pixels of a small scene."""
    return cornell_box(), ir.RenderSettings(width=7680, height=4320, light_paths=1024)


LOADS: dict[str, Callable[[], tuple[ir.Scene, ir.RenderSettings]]] = {
    "triangles": triangles,
    "instances": instances,
    "dome": dome,
    "pixels": pixels,
}


def peak_memory() -> int:
    """The most that this process has had in memory [bytes]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10


def measure(name: str) -> dict[str, float]:
    """Predictions [bytes], and what the load takes [bytes, s of CPU time] in this process."""
    Renderer(room(triangles=100), ir.RenderSettings(width=32, light_paths=64)).render()  # what is allocated once
    scene, settings = LOADS[name]()
    before, start = used_memory(wp.get_device("cpu")), time.process_time()
    renderer = Renderer(scene, settings, guiding=None)
    uploaded = time.process_time()
    film = renderer.new_film()
    for iteration in range(2):
        renderer.add_iteration(film, iteration)
    rendered = time.process_time()
    picture = film.radiance()
    assert np.isfinite(picture).all() and picture.max() > 0.0
    count = picture.shape[0] * picture.shape[1]
    film_bytes = count * pixel_bytes(scene, renderer.settings, guided=False)
    resident = sum(scene_bytes(scene).values()) + film_bytes
    return {
        "predicted": resident,
        "resident": used_memory(wp.get_device("cpu")) - before,
        "predicted_peak": max(upload_bytes(scene) + film_bytes, resident),
        "peak": max(peak_memory() - before, 0),
        "upload": uploaded - start,
        "iteration": (rendered - uploaded) / 2,
    }


def steady(count: int = 1000) -> dict[str, float]:
    """Growth [bytes] over `count` renders, and over `count` updates in which a mesh moves."""
    settings = ir.RenderSettings(width=16, height=16, iterations=1, light_paths=32)
    cpu, scene = wp.get_device("cpu"), cornell_box()
    out = {}
    for _ in range(count // 10):
        ir.render(scene, settings)
    before = used_memory(cpu)
    for _ in range(count):
        ir.render(scene, settings)
    out["renders"] = used_memory(cpu) - before
    renderer = Renderer(scene, settings)
    box = scene.meshes[-1]

    def update(k: int) -> None:
        moved = replace(box, points=box.points + 10.0 * (k % 7))
        renderer.update(replace(scene, meshes=(*scene.meshes[:-1], moved)))
        renderer.render()

    for k in range(count // 10):
        update(k)
    before = used_memory(cpu)
    for k in range(count):
        update(k)
    out["updates"] = used_memory(cpu) - before
    return out


def run(name: str) -> dict[str, float]:
    """What a process of its own measures of a load, or of "steady"."""
    command = [sys.executable, str(Path(__file__)), "--child", name]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def tables(found: dict[str, dict[str, float]]) -> list[Table]:
    """Memory and time of the loads; growth."""

    def gib(size: float) -> str:
        return number(size / 2**30)

    rows = []
    for name, load in ((name, load) for name, load in found.items() if name != "steady"):
        sizes = (gib(load[key]) for key in ("predicted", "resident", "predicted_peak", "peak"))
        rows.append(
            ((LOADS[name].__doc__ or name).rstrip("."), *sizes, number(load["upload"]), number(load["iteration"]))
        )
    heads = ("load", "predicted GiB", "resident", "predicted peak", "peak", "upload s", "iteration s")
    out = [Table("Large loads", heads, rows, "Beside the scene's own arrays on the host; seconds of CPU time.")]
    if "steady" in found:
        growth = [(f"1000 {what}", number(size / 2**20)) for what, size in found["steady"].items()]
        out.append(Table("Growth", ("what", "MiB"), growth))
    return out


def main(arguments: list[str] | None = None) -> int:
    """Measures and reports."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("names", nargs="*", choices=[*LOADS, "steady", []], help="loads (default: all, and steady)")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the tables")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    if options.child:
        print(json.dumps(steady() if options.child == "steady" else measure(options.child)))
        return 0
    found = {}
    for name in options.names or [*LOADS, "steady"]:
        found[name] = run(name)
        print(f"{name}: {found[name]}", file=sys.stderr)
    results = {"environment": environment("cpu"), "loads": found}
    publish(tables(found), results, json_path=options.json, markdown_path=options.markdown)
    return 0


if __name__ == "__main__":
    sys.exit(main())
