"""How long a step of a simulation's cameras takes beside Newton's own sensor, and how large the error is.

    python -m benchmarks.simulation_views [--sizes 64x64 640x480] [--worlds 1 4 16 64] [--device cpu] [--json FILE]

The scene has ten shapes of all kinds that fall, in every world, each with a camera of its own; it is lit by Newton's
default and ambient light. A step is what a training loop does: Newton refits its BVHs and renders with shadows; ours
refits and renders with bounced light. Seconds are CPU time of the process on one core, which other load disturbs less;
Newton's is one thread's anyway. The error is relative to 256 iterations, as in the other benchmarks: √ of the mean of
(x - r)² / (r² + 0.01 m²), m the reference's mean. Newton's picture is another one, so it has none.
"""

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path

import newton
import numpy as np
import warp as wp
from newton.sensors import SensorCamera as NewtonCamera

from warp_ir.newton import GiSettings, SensorCamera

CAMERA_AT = np.array([3.2, -4.2, 2.8])
TARGET = np.array([0.0, 0.2, 0.4])


def falling_bodies(worlds: int, device: str) -> newton.Model:
    """Ten bodies over a ground that all worlds share."""
    one = newton.ModelBuilder()
    colors = np.random.default_rng(1).uniform(0.2, 0.9, (10, 3))
    adders = (
        lambda b, c: one.add_shape_sphere(b, radius=0.3, color=c),
        lambda b, c: one.add_shape_box(b, hx=0.3, hy=0.2, hz=0.25, color=c),
        lambda b, c: one.add_shape_capsule(b, radius=0.2, half_height=0.25, color=c),
        lambda b, c: one.add_shape_cylinder(b, radius=0.25, half_height=0.3, color=c),
        lambda b, c: one.add_shape_cone(b, radius=0.3, half_height=0.3, color=c),
    )
    for k in range(10):
        turn = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.3, 0.2)), 0.7 * k)
        place = wp.vec3(0.9 * (k % 4) - 1.3, 0.9 * (k // 4) - 0.9, 0.6 + 0.3 * (k % 3))
        adders[k % 5](one.add_body(xform=wp.transform(place, turn)), tuple(colors[k].tolist()))
    model = newton.ModelBuilder()
    model.replicate(one, worlds)
    model.add_ground_plane()
    return model.finalize(device=device)


def camera_pose() -> np.ndarray:
    """The transform of a camera at `CAMERA_AT` that looks at `TARGET`, with +Z up."""
    z = CAMERA_AT - TARGET
    z /= np.linalg.norm(z)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    m = np.stack([x, np.cross(z, x), z], axis=1)
    w = 0.5 * np.sqrt(1.0 + np.trace(m))
    q = [(m[2, 1] - m[1, 2]) / (4 * w), (m[0, 2] - m[2, 0]) / (4 * w), (m[1, 0] - m[0, 1]) / (4 * w), w]
    return np.array([*CAMERA_AT, *q], np.float32)


def milliseconds(step: Callable[[], None], device: str, least: float = 0.5) -> float:
    """The least mean of three runs of a step: CPU time, on a GPU wall time."""
    clock = time.process_time if device == "cpu" else time.perf_counter
    for _ in range(4):
        step()
    wp.synchronize()
    count, best = 1, np.inf
    for _ in range(3):
        start = clock()
        for _ in range(count):
            step()
        wp.synchronize()
        spent = clock() - start
        best = min(best, spent / count)
        count = max(1, min(100, int(least / max(best, 1.0e-6))))
    return 1000.0 * best


def relative_error(image: np.ndarray, reference: np.ndarray) -> float:
    m = reference.mean()
    return float(np.sqrt(np.mean((image - reference) ** 2 / (reference**2 + 0.01 * m * m))))


def measure(width: int, height: int, worlds: int, device: str) -> dict[str, float]:
    model = falling_bodies(worlds, device)
    state = model.state()
    poses = wp.array(np.tile(camera_pose(), (worlds, 1)), dtype=wp.transformf, device=device)
    rays = SensorCamera.compute_camera_rays_pinhole(width, height, camera_fov=0.8, device=device)
    row: dict[str, float] = {"width": width, "height": height, "worlds": worlds}

    theirs = NewtonCamera(model, default_render_config=NewtonCamera.RenderConfig(enable_shadows=True))
    theirs.create_default_light()
    color = theirs.allocate_image_color(worlds, width, height)
    row["newton refit"] = milliseconds(lambda: model.bvh_refit_shapes(state), device)

    def their_step() -> None:
        model.bvh_refit_shapes(state)
        theirs.update(state, poses, rays, color_image=color)

    row["newton"] = milliseconds(their_step, device)

    def ours(iterations: int, filtered: bool) -> tuple[SensorCamera, Callable[[], None], wp.array]:
        camera = SensorCamera(model, gi=GiSettings(iterations=iterations, filter=filtered))
        camera.create_default_light()
        hdr = camera.allocate_image_color_hdr(worlds, width, height)
        return camera, lambda: camera.update(state, poses, rays, color_image=color, hdr_color_image=hdr), hdr

    camera, step, _ = ours(1, False)
    step()
    row["refit"] = milliseconds(lambda: camera.follow(state), device)
    pictures = {}
    for filtered in (False, True):
        for iterations in (1, 4):
            _, step, hdr = ours(iterations, filtered)
            name = f"{iterations} {'filtered' if filtered else 'plain'}"
            row[name] = milliseconds(step, device)
            pictures[name] = hdr.numpy()[0]
    _, step, hdr = ours(256, False)
    if width * height * worlds <= 64 * 64 * 4:  # else it would take minutes on a CPU
        step()
        for name, picture in pictures.items():
            row[f"error {name}"] = relative_error(picture, hdr.numpy()[0])
    return row


def table(rows: list[dict[str, float]]) -> str:
    """The rows as a table of Markdown; times in ms, and in views per second for ours with a filter."""
    lines = [
        "| size | worlds | Newton: refit, step | refit, iteration, filtered | ratio | views/s | error, filtered |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        errors = [r.get(f"error 1 {kind}") for kind in ("plain", "filtered")]
        shown = ", ".join("" if e is None else f"{e:.2f}" for e in errors)
        lines.append(
            f"| {r['width']}x{r['height']} | {r['worlds']} | {r['newton refit']:.2f}, {r['newton']:.1f}"
            f" | {r['refit']:.2f}, {r['1 plain']:.1f}, {r['1 filtered']:.1f} | {r['1 filtered'] / r['newton']:.1f}"
            f" | {1000.0 * r['worlds'] / r['1 filtered']:.0f} | {shown} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", default=["64x64"], help="widths and heights")
    parser.add_argument("--worlds", nargs="+", type=int, default=[1, 4, 16])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path, help="file for all numbers")
    args = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    if args.device == "cpu" and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})  # threads that wait for each other would count
    rows = []
    for size in args.sizes:
        width, height = (int(n) for n in size.split("x"))
        for worlds in args.worlds:
            rows.append(measure(width, height, worlds, args.device))
            print(table(rows[-1:]).splitlines()[-1], flush=True)
    print(table(rows))
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
