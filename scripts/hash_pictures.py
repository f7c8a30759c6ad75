"""Prints a hash of the pixels of each of some thirty small renders of all estimators, filters and types of scenes.

A change that must not affect pictures must not change a hash. Hashes are only comparable on one machine and one device:
compilers for other processors round differently.

    python scripts/hash_pictures.py --write before.json     # before the change
    python scripts/hash_pictures.py --compare before.json   # after it; exit code 1 if a picture has changed
"""

import argparse
import hashlib
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

import warp_ir as ir

SCENES = Path(__file__).parent.parent / "scenes_usd"
AOVS = ("direct", "indirect", "albedo", "normal", "position", "depth", "alpha", "prim_id")

Arrays = list[npt.NDArray[np.generic]]
Render = Callable[[str], Arrays]
"""Renders a picture on the device of a name and returns all its arrays."""


def film_of(scene: Callable[[], ir.Scene], **settings: object) -> Render:
    """A function that renders a scene and returns its radiance, standard error and AOVs."""

    def render(device: str) -> Arrays:
        film = ir.render(scene(), ir.RenderSettings(**settings), device=device)
        return [film.radiance(), film.standard_error(), *(film.aov(name) for name in AOVS)]

    return render


def vpls_of(scene: Callable[[], ir.Scene], **settings: object) -> Render:
    """A function that traces the VPLs of a scene and returns their arrays."""

    def trace(device: str) -> Arrays:
        vpls = ir.trace_vpls(scene(), ir.RenderSettings(**settings), device=device)
        return [vpls.positions, vpls.normals, vpls.intensity, vpls.bounce]

    return trace


def stage(name: str, **camera: object) -> Callable[[], ir.Scene]:
    """A function that reads a test scene; `camera` replaces fields of its camera."""

    def load() -> ir.Scene:
        scene = ir.load_usd(SCENES / f"{name}.usda")
        return replace(scene, camera=replace(scene.camera, **camera)) if camera else scene

    return load


def turntable() -> ir.Scene:
    """Reads the turntable at frame 4."""
    return ir.StageReader(SCENES / "turntable.usda").read(4.0)


def blurred() -> ir.Scene:
    """The Cornell box; its last mesh moves and its camera pans while the shutter is open, in four samples."""
    scene = ir.load_usd(SCENES / "cornell_box.usda")

    def sample(time: float) -> ir.Scene:
        last = replace(scene.meshes[-1], points=scene.meshes[-1].points + np.array([40.0 * time, 20.0 * time, 0.0]))
        pan = np.eye(4)
        pan[0, 3] = 10.0 * time
        camera = replace(scene.camera, world_from_camera=pan @ scene.camera.world_from_camera)
        return replace(scene, meshes=(*scene.meshes[:-1], last), camera=camera)

    return replace(scene, shutter=tuple(sample(k / 4) for k in range(4)))


def instanced() -> ir.Scene:
    """The Cornell box with two copies of its last mesh as instances, one of them mirrored."""
    scene = ir.load_usd(SCENES / "cornell_box.usda")
    matrices = np.stack([np.eye(4), np.diag([-1.0, 1.0, 1.0, 1.0])])
    matrices[1, 0, 3] = 556.0
    last = len(scene.meshes) - 1
    return replace(scene, instances=(ir.Instances("copies", (last,), matrices),))


def renders() -> Iterator[tuple[str, Render]]:
    """The name of each picture and the function that renders it."""
    small = {"width": 64, "iterations": 6}
    yield "cornell_box vpl", film_of(stage("cornell_box"), **small)
    yield "cornell_box vpl plain", film_of(stage("cornell_box"), filter=False, **small)
    yield "cornell_box vpl lights", film_of(stage("cornell_box"), visible_lights=True, **small)
    yield "cornell_box vpl denoise", film_of(stage("cornell_box"), denoise=True, **small)
    yield "cornell_box vpl lens", film_of(stage("cornell_box", lens_radius=0.1, focus_distance=3.0), **small)
    yield "cornell_box vpl error", film_of(stage("cornell_box"), width=64, target_error=0.05)
    yield "cornell_box vpl fractional", film_of(stage("cornell_box"), absorption="fractional", max_bounces=3, **small)
    yield "cornell_box keller", film_of(stage("cornell_box"), estimator="keller", width=32, iterations=2)
    yield (
        "cornell_box keller bounded",
        film_of(
            stage("cornell_box"), estimator="keller", absorption="roulette", bound_radius=0.1, width=32, iterations=2
        ),
    )
    yield "cornell_box path", film_of(stage("cornell_box"), estimator="path", **small)
    for name in ("corridor", "crowded_room", "two_rooms", "light_types", "thousand_lights", "thin_walls"):
        yield f"{name} vpl", film_of(stage(name), visible_lights=True, **small)
        yield f"{name} path", film_of(stage(name), estimator="path", visible_lights=True, width=48, iterations=2)
    for name in ("furnace_sphere", "furnace_cube"):
        yield f"{name} vpl", film_of(stage(name), width=32, iterations=4)
    yield "turntable vpl", film_of(turntable, **small)
    yield "turntable path", film_of(turntable, estimator="path", width=48, iterations=2)
    yield "cornell_box blurred vpl", film_of(blurred, **small)
    yield "cornell_box blurred path", film_of(blurred, estimator="path", width=48, iterations=4)
    yield "cornell_box instanced vpl", film_of(instanced, **small)
    for name in ("cornell_box", "light_types", "two_rooms"):
        yield f"{name} vpls", vpls_of(stage(name))


def main() -> None:
    parser = argparse.ArgumentParser(description="Hash the pixels of some small renders.")
    parser.add_argument("--device", default="cpu", help="cpu, cuda:0, ... (default: cpu)")
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the hashes as JSON")
    parser.add_argument("--compare", type=Path, metavar="FILE", help="compare with the hashes in this file")
    parser.add_argument("-k", dest="name", default="", metavar="TEXT", help="only pictures whose name contains this")
    args = parser.parse_args()

    earlier = json.loads(args.compare.read_text()) if args.compare else {}
    hashes, changed = {}, []
    for name, render in renders():
        if args.name not in name:
            continue
        hashes[name] = hashlib.sha256(
            b"".join(np.ascontiguousarray(a).tobytes() for a in render(args.device))
        ).hexdigest()[:16]
        differs = earlier.get(name, hashes[name]) != hashes[name]
        changed += [name] * differs
        print(f"{hashes[name]}  {name}{'  CHANGED' if differs else ''}", flush=True)
    if args.write:
        args.write.write_text(json.dumps(hashes, indent=1) + "\n")
    if changed:
        sys.exit(f"{len(changed)} of {len(hashes)} pictures have changed")


if __name__ == "__main__":
    main()
