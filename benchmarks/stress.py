"""Cases that are hard on numbers: tiny, huge and far scenes, thin walls, slivers, lights of any size and power.

    python benchmarks/stress.py [-k WORD ...] [--estimators NAME ...] [--seeds N] [--json FILE] [--markdown FILE]

Every case gives one number and the limit that it has to keep, for each estimator; the tests ask the same cases
(tests/physics/test_stress.py). The exit code is 1 if a limit is not kept.
"""

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from report import Table, environment, number, publish

import warp_ir as ir
from warp_ir.estimators import ESTIMATORS
from warp_ir.metrics import relative_mse
from warp_ir.procedural import cube, floor, furnace, mesh, quad, sphere
from warp_ir.renderer import Renderer
from warp_ir.scene import LightKind, Projection

_SHARE = 0.05
"""How much scale and position may change the relMSE."""


@dataclass(frozen=True)
class Finding:
    """What a case measured."""

    value: float
    limit: float
    """The value must not be larger."""
    what: str
    """What the value is."""

    @property
    def holds(self) -> bool:
        """Whether the limit is kept; a value that is no number keeps none."""
        return bool(self.value <= self.limit)


CASES: dict[str, Callable[[str, int], Finding]] = {}
"""Cases by name: functions of an estimator and a number of seeds."""


def _case(name: str, *arguments: Any) -> Callable[[Callable[..., Finding]], Callable[..., Finding]]:
    """Adds a function to the cases, with further arguments of its own."""

    def add(function: Callable[..., Finding]) -> Callable[..., Finding]:
        CASES[name] = lambda estimator, seeds: function(estimator, seeds, *arguments)
        return function

    return add


# ---- scenes ------------------------------------------------------------------------------------------------------


def _placed(position: Any, linear: Any = None) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = np.eye(3) if linear is None else linear
    matrix[:3, 3] = position
    return matrix


_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Takes a light's -Z to the world's -Y."""


def room(*more: ir.Mesh, lights: tuple[ir.Light, ...] | None = None, albedo: float = 0.6) -> ir.Scene:
    """A closed room of edge 2 around the origin with a ball in it, under a square lamp."""
    points, triangles = sphere(0.4, level=2)
    ball = mesh("ball", points + np.array([0.2, -0.5, -0.3]), triangles, 1)
    lamp = ir.Light("lamp", LightKind.RECT, (6.0, 5.0, 4.0), _placed((0.1, 0.9, 0.0), _DOWN), width=0.5, height=0.4)
    return ir.Scene(
        (mesh("room", *cube(2.0, inward=True)), ball, *more),
        (ir.Material("grey", (albedo,) * 3), ir.Material("red", (0.7, 0.2, 0.1))),
        (lamp,) if lights is None else lights,
        ir.Camera.look_at((-0.6, 0.1, 0.85), (0.2, -0.3, -0.4), fov=65.0),
    )


def moved(scene: ir.Scene, scale: float, shift: float) -> ir.Scene:
    """The scene scaled, then moved along all axes."""
    matrix = _placed((shift,) * 3, scale * np.eye(3))
    camera = matrix @ scene.camera.world_from_camera
    camera[:3, :3] /= scale
    return replace(
        scene,
        meshes=tuple(replace(m, points=m.points * scale + shift) for m in scene.meshes),
        lights=tuple(replace(x, world_from_light=matrix @ x.world_from_light) for x in scene.lights),
        camera=replace(scene.camera, world_from_camera=camera),
    )


def dark_room(thickness: float, turn: np.ndarray) -> ir.Scene:
    """A closed box around the camera, in bright light from outside."""
    walls = []
    for size in (2.0, 2.0 * (1.0 + thickness)) if thickness > 0.0 else (2.0,):
        points, triangles = cube(size)
        walls.append(mesh(f"wall {size}", points @ turn.T, triangles))
    points, triangles = cube(0.2)
    outside = [mesh(f"lamp {k}", (points + np.eye(3)[k] * 1.5) @ turn.T, triangles, 1) for k in range(3)]
    dome = ir.Light("sky", LightKind.DOME, (10.0,) * 3)
    sun = ir.Light("sun", LightKind.DISTANT, (1.0e4,) * 3, angle=1.0)
    return ir.Scene(
        meshes=(*walls, *outside),
        materials=(ir.Material("wall", (0.9,) * 3), ir.Material("lamp", (0.5,) * 3, (100.0,) * 3)),
        lights=(dome, sun),
        camera=ir.Camera.look_at((0.3, 0.2, 0.5), (-0.2, 0.0, -1.0), fov=100.0),
    )


# ---- measures ----------------------------------------------------------------------------------------------------

_ITERATIONS = {"vpl": 4, "keller": 2, "path": 8}


def render(scene: ir.Scene, estimator: str, seed: int = 0, iterations: int | None = None, **more: Any) -> ir.Film:
    """A small unfiltered picture."""
    settings: dict[str, Any] = dict(width=16, height=16, light_paths=128, filter=False, absorption="roulette")
    settings |= dict(estimator=estimator, seed=seed, iterations=iterations or _ITERATIONS[estimator]) | more
    return ir.render(scene, ir.RenderSettings(**settings))


def not_finite(film: ir.Film) -> float:
    """The number of values that are infinite, negative or no numbers, and of samples that were dropped for that."""
    picture, error = film.radiance(), film.standard_error()
    bad = ~np.isfinite(picture) | (picture < 0.0) | ~np.isfinite(error)
    return float(bad.sum() + film.rejected)


def score(scene: ir.Scene, other: ir.Scene, estimator: str, seeds: int, reference: str = "") -> Finding:
    """The difference of the mean pictures of two scenes in standard errors of their renders."""
    means = [
        [render(s, name, seed).radiance().astype(np.float64).mean() for seed in range(k * 1000, k * 1000 + 2 * seeds)]
        for k, (s, name) in enumerate(((scene, estimator), (other, reference or estimator)))
    ]
    error = np.hypot(*(np.std(x, ddof=1) / np.sqrt(len(x)) for x in means))
    shift = abs(float(np.mean(means[0]) - np.mean(means[1])))
    # Student's t of some 14 degrees of freedom: 6 is a false alarm in 10⁴; below 1e-5 it is rounding.
    return Finding(
        max(shift - 1e-5 * float(np.mean(means[1])), 0.0) / max(float(error), 1e-300), 6.0, "standard errors"
    )


def finite(scene: ir.Scene, estimator: str) -> Finding:
    """Whether all values are numbers, filtered or not."""
    films = [render(scene, estimator, filter=filtered, max_bounces=100) for filtered in (False, True)]
    return Finding(sum(map(not_finite, films)), 0.0, "values that are no numbers, or negative")


@cache
def _truth() -> np.ndarray:
    """The picture of the room by many iterations of `vpl`."""
    return render(room(), "vpl", 10_000, iterations=2048, light_paths=256).radiance().astype(np.float64)


@cache
def _errors(estimator: str, seeds: int, scale: float, shift: float) -> tuple[float, float]:
    """The mean relMSE of renders of the moved room, and its standard error."""
    scene = moved(room(), scale, shift)
    errors = [relative_mse(render(scene, estimator, seed).radiance(), _truth()) for seed in range(4 * seeds)]
    return float(np.mean(errors)), float(np.std(errors, ddof=1) / np.sqrt(len(errors)))


# ---- cases -------------------------------------------------------------------------------------------------------


@_case("scaled by 1e-4", 1e-4, 0.0)
@_case("scaled by 1e-2", 1e-2, 0.0)
@_case("scaled by 1e3", 1e3, 0.0)
@_case("scaled by 1e6", 1e6, 0.0)
@_case("moved by 1e5 of its size", 1.0, 2e5)
def _scale(estimator: str, seeds: int, scale: float, shift: float) -> Finding:
    """The relMSE changes by less than 5 %, beyond three standard errors of the comparison."""
    (here, error), (there, other) = _errors(estimator, seeds, 1.0, 0.0), _errors(estimator, seeds, scale, shift)
    noise = 3.0 * float(np.hypot(error, other)) / here
    return Finding(abs(there / here - 1.0), _SHARE + noise, "change of the relMSE")


@_case("camera in a corner", (-1.0, -1.0, -1.0), (0.2, 0.1, 0.3))
@_case("camera on a wall", (-1.0, 0.2, 0.1), (0.5, 0.0, -0.1))
@_case("camera on a wall, looking along it", (-1.0, 0.2, 0.1), (-1.0, 0.0, -0.5))
@_case("camera 1e-7 before a wall", (-1.0 + 1e-7, 0.2, 0.1), (0.5, 0.0, -0.1))
def _camera(estimator: str, seeds: int, eye: tuple[float, ...], target: tuple[float, ...]) -> Finding:
    """All values are numbers."""
    return finite(replace(room(), camera=ir.Camera.look_at(eye, target, fov=80.0)), estimator)


@_case("camera within a wall")
def _camera_in_wall(estimator: str, seeds: int) -> Finding:
    """Between the two faces of a wall it is dark."""
    points, triangles = cube(0.4)
    wall = mesh("wall", points, triangles)
    camera = ir.Camera.look_at((0.1, 0.05, 0.0), (0.0, 0.0, -1.0), fov=80.0)
    scene = replace(room(wall), camera=camera)
    return Finding(float(render(scene, estimator).radiance().max()), 0.0, "radiance")


def _lamp(kind: LightKind, position: tuple[float, ...], size: float = 0.05, flux: float = 10.0) -> ir.Light:
    """A lamp that shines downwards; whatever its size, its power stays."""
    area = {LightKind.SPHERE: 4.0 * np.pi * size**2, LightKind.CYLINDER: 4.0 * np.pi * size**2, LightKind.RECT: size**2}
    radiance = flux / (np.pi * area.get(kind, 1.0))
    return ir.Light("l", kind, (radiance,) * 3, _placed(position, _DOWN), size, size, size, 2.0 * size)


@_case("lamp in a corner", _lamp(LightKind.SPHERE, (0.999, 0.999, -0.999)))
@_case("lamp half in a wall", _lamp(LightKind.SPHERE, (1.0, 0.3, -0.2)))
@_case("tube in the plane of a wall", _lamp(LightKind.CYLINDER, (1.0, 0.3, -0.2)))
@_case("panel in the plane of the ceiling", _lamp(LightKind.RECT, (0.2, 1.0, -0.2), 0.4))
@_case("panel edge-on in a wall", _lamp(LightKind.RECT, (1.0, 0.3, -0.2), 0.4))
@_case("point lamp 1e-6 before a wall", _lamp(LightKind.POINT, (1.0 - 1e-6, 0.3, -0.2)))
def _lights_in_walls(estimator: str, seeds: int, lamp: ir.Light) -> Finding:
    """All values are numbers, and the mean of the picture is the one of `path`."""
    scene = room(lights=(lamp,))
    broken = finite(scene, estimator)
    return broken if broken.value or estimator == "path" else score(scene, scene, estimator, seeds, "path")


@_case("point lamp exactly in a corner")
def _point_in_corner(estimator: str, seeds: int) -> Finding:
    """Rounding decides on which side of three walls it is; all values are numbers."""
    return finite(room(lights=(_lamp(LightKind.POINT, (1.0, 1.0, -1.0)),)), estimator)


@_case("lamp within a wall")
def _lamp_in_wall(estimator: str, seeds: int) -> Finding:
    """A lamp between the two faces of a wall lights nothing."""
    points, triangles = cube(0.4)
    scene = room(mesh("wall", points, triangles), lights=(_lamp(LightKind.SPHERE, (0.0, 0.05, 0.0)),))
    return Finding(float(render(scene, estimator).radiance().max()), 0.0, "radiance")


_TURN = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]


@_case("walls of no thickness", 0.0, np.eye(3))
@_case("walls of no thickness, turned", 0.0, _TURN)
@_case("walls 1e-6 thick", 1e-6, np.eye(3))
@_case("walls 1e-6 thick, turned", 1e-6, _TURN)
@_case("walls 1e-3 thick, turned", 1e-3, _TURN)
def _walls(estimator: str, seeds: int, thickness: float, turn: np.ndarray) -> Finding:
    """No light gets through: exactly 0."""
    film = render(dark_room(thickness, turn), estimator, width=32, height=32, iterations=4, light_paths=256)
    holes = float((film.aov("alpha") < 1.0).sum())
    return Finding(float(film.radiance().max()) + holes, 0.0, "radiance and pixels with holes")


@_case("coplanar duplicates")
def _duplicates(estimator: str, seeds: int) -> Finding:
    """Surfaces that lie in others of their material change nothing."""
    plain = room()
    return score(replace(plain, meshes=(*plain.meshes, *plain.meshes)), plain, estimator, seeds)


def _slivers(count: int) -> ir.Mesh:
    """The floor of the room in strips that are 1e-6 wide at one end."""
    cuts = np.sort(np.concatenate([[-1.0, 1.0], np.random.default_rng(0).uniform(-1.0, 1.0, count)]))
    ends = np.clip(np.linspace(-1.0, -1.0 + 1e-6 * len(cuts), len(cuts)), -1.0, 1.0)
    ends[-1] = 1.0
    low, high = (
        np.stack([x, np.full(len(x), -1.0), np.full(len(x), z)], axis=1) for x, z in ((cuts, 1.0), (ends, -1.0))
    )
    k, n = np.arange(len(cuts) - 1), len(cuts)
    triangles = np.concatenate([np.stack([k, k + 1, n + k + 1], axis=1), np.stack([k, n + k + 1, n + k], axis=1)])
    return mesh("floor", np.concatenate([low, high]), triangles)


@_case("slivers and needles")
def _needles(estimator: str, seeds: int) -> Finding:
    """A floor cut into slivers, over a floor of two triangles, reflects as that does."""
    return score(room(_slivers(200)), room(), estimator, seeds)


@_case("triangles without area")
def _no_area(estimator: str, seeds: int) -> Finding:
    """Points and lines that are called triangles change no pixel beyond the noise."""
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (30, 3))
    flat = mesh("flat", points, [[k, k, (k + 1) % 30] for k in range(30)] + [[k, k, k] for k in range(30)])
    broken = finite(room(flat), estimator)
    return broken if broken.value else score(room(flat), room(), estimator, seeds)


@_case("triangles that are no numbers")
def _nan(estimator: str, seeds: int) -> Finding:
    """A scene with a point that is no number, or infinite, is refused; loaders leave such faces out and warn."""
    refused = 0
    for value in (np.nan, np.inf, -np.inf):
        try:
            render(room(mesh("bad", [[0, 0, 0], [1, 0, 0], [0, value, 0]], [[0, 1, 2]])), estimator)
        except ir.InputError as error:
            refused += str(error).startswith("bad: ")
    return Finding(3.0 - refused, 0.0, "scenes that were not refused")


_SIZES = [
    (LightKind.SPHERE, 1e-6),
    (LightKind.RECT, 1e-6),
    (LightKind.CYLINDER, 1e-6),
    (LightKind.RECT, 1e6),
    (LightKind.SPHERE, 1e6),
]


def _sized(estimator: str, seeds: int, kind: LightKind, size: float) -> Finding:
    """A lamp of any size lights the floor of an open room as `path` says."""
    height = 0.9 if size < 1.0 else 1.5 * size
    lamp = _lamp(kind, (0.1, height, 0.0), size, flux=10.0 * max(size, 1.0) ** 2)
    plain = room(lights=(lamp,))
    points, triangles = cube(2.0, inward=True)
    scene = plain if size < 1.0 else replace(plain, meshes=(mesh("room", points, triangles[:-2]), *plain.meshes[1:]))
    broken = finite(scene, estimator)
    return broken if broken.value or estimator == "path" else score(scene, scene, estimator, seeds, "path")


for _kind, _size in _SIZES:
    _case(f"{_kind.name.lower()} lamp of {_size:g} of the size", _kind, _size)(_sized)


@_case("lights of 1e-12 to 1e12 in power, mixed")
def _powers(estimator: str, seeds: int) -> Finding:
    """The picture is that of the strongest alone: the others are below its rounding."""
    lamps = tuple(
        replace(_lamp(LightKind.SPHERE, (0.3 * k - 0.6, 0.8, 0.0)), radiance=(10.0**power,) * 3)
        for k, power in enumerate((-12, -6, 0, 4, 12))
    )
    return score(room(lights=lamps), room(lights=lamps[-1:]), estimator, seeds)


@_case("intensity 1e-12", 1e-12)
@_case("intensity 1e12", 1e12)
def _intensity(estimator: str, seeds: int, power: float) -> Finding:
    """The picture of a lamp scales with it, to the rounding of float32."""
    plain = room()
    (lamp,) = plain.lights
    other = replace(plain, lights=(replace(lamp, radiance=tuple(power * x for x in lamp.radiance)),))
    one, two = (render(s, estimator).radiance().astype(np.float64) for s in (plain, other))
    return Finding(float(np.abs(two / power - one).max() / one.max()), 1e-4, "relative difference")


@_case("a stray prim 1e6 away")
def _stray(estimator: str, seeds: int) -> Finding:
    """It changes nothing."""
    far = quad("stray", np.array([(-1, 0, -1), (-1, 0, 1), (1, 0, 1), (1, 0, -1)]) * 0.01 + 2e6)
    return score(room(far), room(), estimator, seeds)


def _shaded(normals: str) -> ir.Scene:
    """The room with a coarse ball whose normals are smooth, tilted or at random."""
    points, triangles = sphere(0.4, level=1)
    corners = (points / 0.4)[triangles]
    rng = np.random.default_rng(0)
    if normals == "tilted":
        corners = corners + 1.5 * rng.normal(size=3)
    if normals == "inconsistent":
        corners = corners * rng.choice([-1.0, 1.0], (*corners.shape[:2], 1))
    corners = corners / np.linalg.norm(corners, axis=2, keepdims=True)
    ball = replace(mesh("ball", points + np.array([0.2, -0.5, -0.3]), triangles, 1), normals=corners.astype(np.float32))
    plain = room()
    return replace(plain, meshes=(plain.meshes[0], ball))


@_case("a coarse mesh with smooth normals", "smooth")
@_case("a coarse mesh with tilted normals", "tilted")
@_case("a coarse mesh with inconsistent normals", "inconsistent")
def _normals(estimator: str, seeds: int, normals: str) -> Finding:
    """All values are numbers, and the mean is the one of `path`."""
    scene = _shaded(normals)
    broken = finite(scene, estimator)
    return broken if broken.value or estimator == "path" else score(scene, scene, estimator, seeds, "path")


@_case("albedo 0")
def _black(estimator: str, seeds: int) -> Finding:
    """A black furnace shows its emission, exactly."""
    film = render(furnace(0.0, 0.75, level=2), estimator)
    return Finding(float(np.abs(film.radiance() - 0.75).max()), 0.0, "difference")


@_case("albedo 0.999", 0.999)
@_case("albedo 1", 1.0)
def _white(estimator: str, seeds: int, albedo: float) -> Finding:
    """A room that hardly absorbs ends, in numbers: lit by itself, and by a point."""
    glowing = render(furnace(albedo, level=1), estimator, iterations=2, light_paths=32, width=4, height=4)
    lit = room(lights=(_lamp(LightKind.POINT, (0.1, 0.2, 0.3)),), albedo=albedo)
    film = render(lit, estimator, iterations=2, light_paths=32, width=4, height=4)
    return Finding(not_finite(glowing) + not_finite(film), 0.0, "values that are no numbers, or negative")


@_case("albedo above 1")
def _above_one(estimator: str, seeds: int) -> Finding:
    """It is refused with the material's name; loaders clamp it and warn."""
    try:
        render(room(albedo=1.001), estimator)
    except ir.InputError as error:
        return Finding(float("grey" not in str(error)), 0.0, "messages without a name")
    return Finding(1.0, 0.0, "scenes that were not refused")


@_case("a lamp and a VPL on the shading point")
def _on_the_point(estimator: str, seeds: int) -> Finding:
    """A point lamp where every pixel looks, so that the first VPL lies there: all values are numbers."""
    lamp = ir.Light("l", LightKind.POINT, (1.0,) * 3, _placed((0.0, 0.0, 0.0)))
    ceiling = quad("ceiling", [(-1, 0.5, 1), (-1, 0.5, -1), (1, 0.5, -1), (1, 0.5, 1)])
    scene = floor(lamp, albedo=0.8, size=2.0)
    return finite(replace(scene, meshes=(*scene.meshes, ceiling)), estimator)


@_case("grazing light")
def _grazing(estimator: str, seeds: int) -> Finding:
    """The sun 0.001° above the horizon of a floor: E = E₀ sin 0.001°, to 1 %, as float32 holds so small an angle."""
    angle = np.radians(1e-3)
    back = np.array([np.cos(angle), np.sin(angle), 0.0])  # towards the sun
    frame = np.stack([[0.0, 0.0, 1.0], np.cross(back, [0.0, 0.0, 1.0]), back], axis=1)
    sun = ir.Light("sun", LightKind.DISTANT, (1e5,) * 3, _placed((0, 0, 0), frame), angle=0.0)
    film = render(floor(sun), estimator, max_bounces=0, light_paths=256)
    expected = 1e5 * np.sin(angle) / np.pi
    return Finding(abs(float(film.radiance().mean()) / expected - 1.0), 0.01, "relative difference")


@_case("grazing view")
def _grazing_view(estimator: str, seeds: int) -> Finding:
    """A camera 1e-6 above the floor that looks along it: all values are numbers."""
    camera = ir.Camera.look_at((-0.9, -1.0 + 1e-6, 0.9), (0.9, -1.0, -0.9), fov=30.0)
    return finite(replace(room(), camera=camera), estimator)


@_case("fireflies over iterations")
def _fireflies(estimator: str, seeds: int) -> Finding:
    """The brightest pixel, over the mean, does not grow from n iterations to 16 n, beyond three standard errors."""
    lamps = (_lamp(LightKind.POINT, (0.98, 0.98, -0.98)), _lamp(LightKind.SPHERE, (-0.97, -0.2, 0.3), 0.02))
    scene, first = room(lights=lamps, albedo=0.8), 2 * _ITERATIONS[estimator]

    def brightest(seed: int, iterations: int) -> float:
        picture = render(scene, estimator, seed, iterations=iterations).radiance()
        return float(picture.max() / picture.mean())

    growth = [brightest(seed, 16 * first) / brightest(seed, first) for seed in range(max(seeds, 4))]
    noise = 3.0 * float(np.std(growth, ddof=1)) / np.sqrt(len(growth))
    return Finding(float(np.mean(growth)), 1.0 + noise, "growth of the brightest pixel")


def drift(estimator: str, iterations: int) -> Finding:
    """A furnace of ρ = 1/2 is 2 after any number of iterations: its distance in standard errors.

    Nor does a picture of emission alone move by a bit, over a tenth as many.
    """
    settings = dict(width=1, height=1, filter=False, light_paths=16, absorption="roulette", estimator=estimator)
    still = Renderer(furnace(0.0, 1.0 / 3.0, level=0), ir.RenderSettings(**settings), guiding=None)
    lit = Renderer(furnace(0.5, level=0), ir.RenderSettings(**settings), guiding=None)
    films = still.new_film(), lit.new_film()
    for iteration in range(iterations):
        if iteration % 10 == 0:
            still.add_iteration(films[0], iteration)
        lit.add_iteration(films[1], iteration)
    moved_bits = float((films[0].radiance() != np.float32(1.0 / 3.0)).sum())
    mean, error = (float(x.astype(np.float64).mean()) for x in (films[1].radiance(), films[1].standard_error()))
    return Finding(float(moved_bits + abs(mean - 2.0) / error), 5.0, "standard errors")


@_case("10^5 iterations")
def _many_iterations(estimator: str, seeds: int) -> Finding:
    """No drift; with fewer seeds than four a hundredth of them."""
    return drift(estimator, 100_000 if seeds >= 4 else 1000)


@_case("nothing at all")
def _nothing(estimator: str, seeds: int) -> Finding:
    """An empty scene, with an orthographic camera."""
    camera = ir.Camera(projection=Projection.ORTHOGRAPHIC)
    return Finding(float(render(ir.Scene(camera=camera), estimator).radiance().max()), 0.0, "radiance")


# ---- report ------------------------------------------------------------------------------------------------------


def tables(rows: list[dict[str, Any]], names: list[str]) -> list[Table]:
    """One table: the value of each estimator, and what it is."""
    lines = []
    for case in dict.fromkeys(row["case"] for row in rows):
        own = {row["estimator"]: row for row in rows if row["case"] == case}
        first = next(iter(own.values()))
        values = [number(own[n]["value"]) + ("" if own[n]["holds"] else " ✗") if n in own else "–" for n in names]
        limit = max(row["limit"] for row in own.values())
        lines.append((case, *values, "0" if limit == 0.0 else f"≤ {limit:.3g}", first["what"]))
    kept = sum(row["holds"] for row in rows)
    note = f"{kept} of {len(rows)} limits are kept. The limit of a comparison includes three standard errors of it."
    return [Table("Numbers under stress", ("case", *names, "limit", "what"), lines, note)]


def main(arguments: list[str] | None = None) -> int:
    """Measures and reports."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("-k", nargs="+", default=[], metavar="WORD", help="cases whose names contain one of the words")
    parser.add_argument("--estimators", nargs="+", choices=list(ESTIMATORS), default=list(ESTIMATORS))
    parser.add_argument("--seeds", type=int, default=8, help="renders that are averaged; below 4: a quick look")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the table")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    rows = []
    for name, case in CASES.items():
        if options.k and not any(word in name for word in options.k):
            continue
        for estimator in options.estimators:
            start = time.process_time()
            found = case(estimator, options.seeds)
            cost = dict(seconds=time.process_time() - start, holds=found.holds)
            rows.append(
                dict(case=name, estimator=estimator, value=found.value, limit=found.limit, what=found.what) | cost
            )
            print(f"{name} · {estimator}: {found.value:.3g} {found.what}, limit {found.limit:.3g}", file=sys.stderr)
    results = {"environment": environment("cpu"), "stress": rows}
    publish(tables(rows, options.estimators), results, json_path=options.json, markdown_path=options.markdown)
    return 0 if all(row["holds"] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
