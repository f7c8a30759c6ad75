"""Gain of path guiding in scenes of which the camera sees only a small part.

The program prints the variance of one iteration and its CPU time, with and without guiding.
"""

import argparse
import time
from collections.abc import Sequence

import numpy as np
from methods import load_task, stored_tasks

import warp_ir as ir
from warp_ir.procedural import cube, mesh, quad
from warp_ir.renderer import Renderer
from warp_ir.scene import Camera, Floats, Light, LightKind, Material, Mesh, Scene
from warp_ir.settings import GuidingSettings

_WHITE, _RED, _LAMP, _GROUND = range(4)
_MATERIALS = (
    Material("white", (0.7, 0.7, 0.68)),
    Material("red", (0.6, 0.15, 0.1)),
    Material("lamp", (0.7, 0.7, 0.7), (20.0, 18.0, 15.0)),
    Material("ground", (0.35, 0.4, 0.25)),
)


def _box(name: str, low: Sequence[float], high: Sequence[float], material: int = _WHITE) -> Mesh:
    points, triangles = cube(1.0)
    lower, upper = np.asarray(low, np.float64), np.asarray(high, np.float64)
    return mesh(name, lower + (points + 0.5) * (upper - lower), triangles, material)


def _wall(name: str, begin: Sequence[float], end: Sequence[float], gap: Sequence[float] | None) -> list[Mesh]:
    """A wall of height 3 along X or Y; `gap` is its opening: begin and end along the wall, bottom and top."""
    b, e = np.array([*begin, 0.0]), np.array([*end, 3.0])
    axis = int(e[1] - b[1] > e[0] - b[0])
    if gap is None:
        return [_box(name, b, e)]
    parts = []
    for k, (start, stop, bottom, top) in enumerate(
        [
            (0.0, gap[0], 0.0, 3.0),
            (gap[1], e[axis] - b[axis], 0.0, 3.0),
            (gap[0], gap[1], gap[3], 3.0),
            (gap[0], gap[1], 0.0, gap[2]),
        ]
    ):
        if stop > start and top > bottom:
            low, high = b.copy(), e.copy()
            low[axis], high[axis], low[2], high[2] = b[axis] + start, b[axis] + stop, bottom, top
            parts.append(_box(f"{name}_{k}", low, high))
    return parts


def rooms(count: int = 10) -> Scene:
    """A storey of `count` x `count` rooms of 4 m with doors and a lamp in each; the camera is in one of them."""
    size, thick = 4.0, 0.1
    meshes = [
        _box("floor", (-1, -1, -0.1), (count * size + 1, count * size + 1, 0.0)),
        _box("ceiling", (-1, -1, 3.0), (count * size + 1, count * size + 1, 3.1)),
    ]
    for i in range(count + 1):
        for j in range(count):
            door = None if i in (0, count) else (1.5, 2.5, 0.0, 2.1)
            x, y = i * size, j * size
            meshes += _wall(f"x{i}_{j}", (x - thick, y + thick), (x + thick, y + size - thick), door)
            meshes += _wall(f"y{i}_{j}", (y - thick, x - thick), (y + size + thick, x + thick), door)
    for i in range(count):
        for j in range(count):
            x, y = i * size + 2.0, j * size + 2.0
            corners = [
                [x - 0.3, y - 0.3, 2.9],
                [x - 0.3, y + 0.3, 2.9],
                [x + 0.3, y + 0.3, 2.9],
                [x + 0.3, y - 0.3, 2.9],
            ]
            meshes.append(quad(f"lamp{i}_{j}", corners, _LAMP))
            meshes.append(_box(f"table{i}_{j}", (x + 0.6, y - 1.2, 0.0), (x + 1.6, y + 0.1, 0.8), _RED))
    x = y = (count // 2) * size
    camera = Camera.look_at((x + 0.4, y + 0.4, 1.7), (x + 3.0, y + 2.8, 1.0), up=(0, 0, 1), fov=75.0)
    return Scene(tuple(meshes), _MATERIALS, camera=camera, name="rooms")


def terrain(size: float = 1000.0, cells: int = 128) -> Scene:
    """Hills of 1 km under sun and sky; the camera sees blocks on ten metres of them."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, cells + 1) * size, np.linspace(-0.5, 0.5, cells + 1) * size)
    z = 20.0 * np.sin(x * 0.021) * np.cos(y * 0.017) + 6.0 * np.sin(x * 0.06 + 1.0) * np.sin(y * 0.05)
    z = (z - z[cells // 2, cells // 2]) * (1.0 - np.exp(-(x**2 + y**2) / 40.0**2))
    k = np.arange(cells * (cells + 1)).reshape(cells, cells + 1)[:, :-1].reshape(-1)
    triangles = np.concatenate(
        [np.stack([k, k + 1, k + cells + 2], axis=1), np.stack([k, k + cells + 2, k + cells + 1], axis=1)]
    )
    ground = mesh("ground", np.stack([x, y, z], axis=-1), triangles, _GROUND)
    blocks = [
        _box("b0", (-3, 2, -1), (-1, 4, 3)),
        _box("b1", (0.5, 1, -1), (3.0, 4, 2), _RED),
        _box("b2", (-1.2, 4.5, -1), (1.5, 6, 4)),
        _box("b3", (-1.0, -0.5, -1), (0.5, 0.5, 1)),
    ]
    tilt, turn = np.radians(50.0), np.radians(200.0)
    back = np.array([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)])
    sun = Light("sun", LightKind.DISTANT, (40000.0, 36000.0, 30000.0), world_from_light=_world_from_light(back))
    sky = Light("sky", LightKind.DOME, (0.35, 0.5, 0.9))
    camera = Camera.look_at((0.0, -9.0, 3.5), (0.0, 2.0, 1.0), up=(0, 0, 1), fov=45.0)
    return Scene((ground, *blocks), _MATERIALS, lights=(sun, sky), camera=camera, name="terrain")


def house() -> Scene:
    """A house of nine rooms in a field; sun and sky light the room of the camera through a single window."""
    meshes = [
        _box("field", (-30, -30, -0.1), (42, 42, 0.0), _GROUND),
        _box("roof", (-0.2, -0.2, 3.0), (12.2, 12.2, 3.2)),
    ]
    thick = 0.1
    for i in range(4):
        for j in range(3):
            door = None if i in (0, 3) else (1.5, 2.5, 0.0, 2.1)
            window = (1.2, 2.6, 0.9, 2.2) if (i, j) == (0, 1) else door
            x, y = i * 4.0, j * 4.0
            meshes += _wall(f"x{i}_{j}", (x - thick, y + thick), (x + thick, y + 4.0 - thick), window)
            meshes += _wall(f"y{i}_{j}", (y - thick, x - thick), (y + 4.0 + thick, x + thick), door)
    meshes.append(_box("table", (2.4, 6.6, 0.0), (3.6, 7.6, 0.8), _RED))
    tilt, turn = np.radians(35.0), np.radians(170.0)
    back = np.array([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)])
    sun = Light("sun", LightKind.DISTANT, (40000.0, 36000.0, 30000.0), world_from_light=_world_from_light(back))
    sky = Light("sky", LightKind.DOME, (0.35, 0.5, 0.9))
    camera = Camera.look_at((0.5, 4.5, 1.7), (3.2, 6.9, 0.9), up=(0, 0, 1), fov=75.0)
    return Scene(tuple(meshes), _MATERIALS, lights=(sun, sky), camera=camera, name="house")


def _world_from_light(back: Floats) -> Floats:
    """The transform [4, 4] of a distant light that comes from a unit direction."""
    x = np.cross([0.0, 0.0, 1.0], back)
    x /= np.linalg.norm(x)
    out = np.eye(4)
    out[:3, :3] = np.stack([x, np.cross(back, x), back], axis=1)
    return out


def measure(scene: Scene, width: int, iterations: int, *, guided: bool) -> tuple[float, float, float]:
    """Relative variance of an iteration per pixel and of its mean, and CPU time [s] per iteration with guiding."""
    settings = ir.RenderSettings(width=width, height=width, filter=False)
    renderer = Renderer(scene, settings, threads=1, guiding=GuidingSettings() if guided else None)
    film, means = renderer.new_film(), []
    begin = time.process_time()
    for k in range(iterations):
        one = renderer.new_film()
        renderer.add_iteration(one, k)
        film.merge(one)
        means.append(one.radiance().mean(dtype=np.float64))
    seconds = time.process_time() - begin
    return film.error() ** 2 * iterations, float(np.var(means, ddof=1) / np.mean(means) ** 2), seconds / iterations


def main() -> None:
    """Measures the scenes and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-k", metavar="NAME", nargs="+", help="scenes to measure (default: all)")
    parser.add_argument("--width", type=int, default=128)
    parser.add_argument("--iterations", type=int, default=16)
    args = parser.parse_args()
    scenes = {"rooms": rooms, "terrain": terrain, "house": house}
    print("| scene | variance | of the mean | s | with guiding | of the mean | s | gain in variance x time |")
    print("|---|---|---|---|---|---|---|---|")
    for name in args.k or [*scenes, *stored_tasks()]:
        scene = scenes[name]() if name in scenes else load_task(name).scene
        measure(scene, 32, 2, guided=True)  # compiles the kernels
        unguided_cost, guided_cost = (
            measure(scene, args.width, args.iterations, guided=guided) for guided in (False, True)
        )
        gain = unguided_cost[0] * unguided_cost[2] / (guided_cost[0] * guided_cost[2])
        cells = [f"{x:.3g}" for x in (*unguided_cost, *guided_cost)]
        print(f"| {name} | {' | '.join(cells)} | {gain:.2f} |", flush=True)


if __name__ == "__main__":
    main()
