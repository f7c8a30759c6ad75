"""Scenes from a seed: houses, corridors, clutter, lamps, windows, which nobody can have tuned a renderer to.

    python benchmarks/random_scenes.py SEED ... [--usd FOLDER]    # what the scenes hold; also as stages

`KINDS[seed % 10]` decides what is asked, and the generator draws the rest: any ten consecutive seeds ask one of each
kind. Units are metres, Z is up. A draw counts if it is seen and lit, which a few rays against the bounding boxes of its
parts decide, without any renderer; else the same stream of random numbers goes on to the next draw:

* seen: the camera is 0.25 m from all boxes; of its rays nine in ten end on one (seven where there is no roof), half of
  them after 1.2 m or more, on at least six boxes;
* lit: 1000 random walks from the camera, of up to `BOUNCES` reflections each, come at least twenty times to a point
  that faces a lamp and sees it, or to the sky.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from warp_ir.image import write_image
from warp_ir.procedural import cube, mesh, quad, sphere
from warp_ir.scene import Camera, Color, Floats, Ints, Light, LightKind, Material, Mesh, Scene, Texture

KINDS = {
    "room": "one room with one to three lamps",
    "panels": "one to four rooms with glowing panels, balls or tubes; the camera's is lit",
    "next": "two to four rooms; the camera's is lit from the next",
    "far": "three or four rooms in a row of doors; the lamp is in the last, the camera in the first",
    "corridor": "a corridor with its light round the corner; the camera looks to the corner",
    "away": "a corridor with its light round the corner; the camera looks away from it",
    "window": "one to three rooms, daylight through windows",
    "open": "rooms without a roof under sky and sun",
    "crowd": "one room with about 100 000 triangles of clutter",
    "lamps": "two to four rooms with four to thirty lamps of all kinds",
}
"""What a seed asks, by name."""
BOUNCES = 10
_THICK = 0.1
"""Thickness of walls [m]."""
_DRAWS = 200
"""Draws before a seed is given up."""

Box = tuple[Floats, Floats]
"""Lower and upper corner of an axis-aligned box, float64 [3] each."""
Cell = tuple[int, int]


@dataclass
class _Draw:
    """A scene under construction."""

    rng: np.random.Generator
    materials: list[Material] = field(default_factory=list)
    meshes: list[Mesh] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)
    boxes: list[Box] = field(default_factory=list)
    """Bounding boxes of what blocks light, for the rule."""
    lamps: list[tuple[Floats, Floats]] = field(default_factory=list)
    """Points on lamps and the directions in which they shine (0: all)."""
    sun: Floats | None = None
    """Direction to the sun, a unit vector."""
    sky: bool = False
    free: list[Box] = field(default_factory=list)
    """Where no clutter may stand."""

    def uniform(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def add(self, part: Mesh, *, blocks: bool = True) -> None:
        """Adds a mesh, under a name of its own."""
        self.meshes.append(replace(part, name=f"{part.name}_{len(self.meshes)}"))
        if blocks:
            self.boxes.append((part.points.min(axis=0), part.points.max(axis=0)))

    def paint(self, *, textured: float = 0.0, low: float = 0.1, high: float = 0.85) -> int:
        """A new material, textured with the probability given; returns its index."""
        grey, tint = self.uniform(low, high), self.uniform(0.0, 0.7) ** 2
        color = np.clip(grey * (1.0 + tint * self.rng.uniform(-1.0, 1.0, 3)), 0.02, 0.9)
        texture = _texture(self.rng, color) if self.chance(textured) else None
        red, green, blue = color.tolist()
        self.materials.append(Material(f"paint_{len(self.materials)}", (red, green, blue), albedo_texture=texture))
        return len(self.materials) - 1

    def color(self, power: float) -> Color:
        """A light's colour, from warm to cold, of the given mean."""
        warm = self.uniform(-0.3, 0.4)
        return (power * (1.0 + warm), power, power * (1.0 - warm))


def _texture(rng: np.random.Generator, color: Floats) -> Texture:
    """A pattern of 64 x 64 texels whose values are those of 8-bit sRGB: checks, stripes, bricks or soft noise."""
    y, x = np.mgrid[:64, :64]
    cell = int(rng.choice([4, 8, 16]))
    match int(rng.integers(4)):
        case 0:
            value = ((x // cell + y // cell) % 2).astype(np.float64)
        case 1:
            value = ((x if rng.random() < 0.5 else y) // cell % 2).astype(np.float64)
        case 2:
            shifted = x + cell * (y // cell % 2)
            value = rng.uniform(0.3, 1.0, (64, 64))[y // cell, shifted // (2 * cell) % 32]
            value = np.where((y % cell < 1) | (shifted % (2 * cell) < 1), 0.0, value)
        case _:
            grid = rng.random((64 // cell, 64 // cell))
            value = np.repeat(np.repeat(grid, cell, axis=0), cell, axis=1)
    contrast = rng.uniform(0.2, 0.8)
    linear = color * (1.0 - contrast + contrast * value[..., None])
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    steps = np.round(255.0 * srgb) / 255.0
    pixels = np.where(steps <= 0.04045, steps / 12.92, ((steps + 0.055) / 1.055) ** 2.4)
    return Texture("pattern", pixels.astype(np.float32))


def _box(name: str, low: ArrayLike, high: ArrayLike, material: int, cells: int = 1) -> Mesh:
    """A box whose faces have `cells` x `cells` squares each, with texture coordinates in metres."""
    lower, upper = np.asarray(low, np.float64), np.asarray(high, np.float64)
    if cells == 1:
        points, triangles = cube(1.0)
    else:
        u, v = (g.reshape(-1) for g in np.mgrid[: cells + 1, : cells + 1] / cells - 0.5)
        sides = []
        for axis in range(3):
            for sign in (-0.5, 0.5):
                side = np.empty((len(u), 3))
                side[:, axis] = sign
                side[:, (axis + 1) % 3], side[:, (axis + 2) % 3] = (u, v) if sign > 0 else (v, u)
                sides.append(side)
        k = np.arange((cells + 1) * cells).reshape(cells, cells + 1)[:, :-1].reshape(-1)
        face = np.stack([k, k + cells + 1, k + cells + 2, k, k + cells + 2, k + 1], axis=1).reshape(-1, 3)
        points = np.concatenate(sides)
        triangles = np.concatenate([face + n * len(u) for n in range(6)])
    part = mesh(name, lower + (points + 0.5) * (upper - lower), triangles, material)
    return replace(part, uvs={"st": _planar(part)})


def _planar(part: Mesh) -> Floats:
    """Texture coordinates [m, 3, 2]: the two coordinates along each triangle's plane, in units of a metre."""
    corners = part.points[part.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.abs(normals).argmax(axis=1)
    along = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    return np.take_along_axis(corners, along[:, None, :], axis=2).astype(np.float32)


@dataclass
class _Plan:
    """Rooms on a grid and what is between them."""

    x: Floats
    y: Floats
    cells: list[Cell]
    """From the camera's (first) to the lamp's (last), where that matters."""
    openings: dict[frozenset[Cell], str]
    """"door" or "open" between neighbours; nothing: a wall."""
    height: float
    windows: list[tuple[Cell, int]] = field(default_factory=list)
    """Cells and sides (-x, +x, -y, +y) with a window."""
    roof: bool = True

    def room(self, cell: Cell) -> Box:
        i, j = cell
        return np.array([self.x[i], self.y[j], 0.0]), np.array([self.x[i + 1], self.y[j + 1], self.height])


_SIDES = ((-1, 0), (1, 0), (0, -1), (0, 1))


def _neighbour(cell: Cell, side: int) -> Cell:
    return cell[0] + _SIDES[side][0], cell[1] + _SIDES[side][1]


def _plan(draw: _Draw, kind: str) -> _Plan:
    """Rooms for a kind: a self-avoiding walk over a grid, whose neighbours have doors."""
    rng = draw.rng
    height = draw.uniform(2.4, 3.4)
    if kind in ("corridor", "away"):
        wide = draw.uniform(1.2, 2.2)
        x = np.array([0.0, draw.uniform(3.0, 9.0), 0.0])
        y = np.array([0.0, wide, wide + draw.uniform(2.5, 6.0)])
        x[2] = x[1] + draw.uniform(1.2, 2.2)
        cells: list[Cell] = [(0, 0), (1, 0), (1, 1)]
        openings = {frozenset(pair): "open" for pair in pairwise(cells)}
        return _Plan(x, y, cells, openings, height)
    least, most = {
        "room": (1, 1),
        "panels": (1, 4),
        "next": (2, 4),
        "far": (3, 4),
        "window": (1, 3),
        "open": (1, 3),
        "crowd": (1, 1),
        "lamps": (2, 4),
    }[kind]
    count = int(rng.integers(least, most + 1))
    size = (5.0, 8.0) if kind == "crowd" else (2.6, 5.5)
    x, y = (np.concatenate([[0.0], np.cumsum(rng.uniform(*size, 4))]) for _ in range(2))
    cells = [(0, 0)]
    while len(cells) < count:
        nexts = [_neighbour(cells[-1], side) for side in range(4)]
        nexts = [c for c in nexts if c not in cells and 0 <= c[0] < 4 and 0 <= c[1] < 4]
        if not nexts:
            cells = [(0, 0)]
            continue
        cells.append(nexts[int(rng.integers(len(nexts)))])
    openings = {frozenset(pair): "door" for pair in pairwise(cells)}
    if kind not in ("far", "next"):
        for a in cells:
            for b in cells:
                if abs(a[0] - b[0]) + abs(a[1] - b[1]) == 1 and draw.chance(0.4):
                    openings.setdefault(frozenset((a, b)), "door")
    plan = _Plan(x, y, cells, openings, height, roof=kind != "open")
    if kind == "window":
        outer = [(c, s) for c in cells for s in range(4) if _neighbour(c, s) not in cells]
        for index in rng.permutation(len(outer))[: int(rng.integers(1, 4))]:
            plan.windows.append(outer[index])
        if not any(cell == cells[-1] for cell, _ in plan.windows):
            plan.windows.append(next(o for o in outer if o[0] == cells[-1]))
    return plan


def _build(draw: _Draw, plan: _Plan) -> None:
    """Floor, ceiling, walls with their openings, and posts in the corners, which hide where walls meet."""
    walls = [draw.paint(textured=0.35, low=0.35) for _ in range(3)]
    rooms = [plan.room(cell) for cell in plan.cells]
    low = np.min([r[0] for r in rooms], axis=0)
    high = np.max([r[1] for r in rooms], axis=0)
    margin = 12.0 if plan.windows or not plan.roof else 0.3
    floor = draw.paint(textured=0.6, low=0.15, high=0.7)
    draw.add(_box("floor", (*(low[:2] - margin), -0.1), (*(high[:2] + margin), 0.0), floor))
    if plan.roof:
        ceiling = draw.paint(low=0.5)
        draw.add(_box("ceiling", (*(low[:2] - 0.3), plan.height), (*(high[:2] + 0.3), plan.height + 0.1), ceiling))
    top = plan.height + (0.05 if plan.roof else 0.0)
    posts: dict[tuple[float, float], None] = {}
    done = set()
    for cell in plan.cells:
        for side in range(4):
            other = _neighbour(cell, side)
            pair = frozenset((cell, other))
            if pair in done:
                continue
            done.add(pair)
            kind = plan.openings.get(pair, "")
            room_low, room_high = plan.room(cell)
            across, along = (0, 1) if side < 2 else (1, 0)
            place = (room_high if side % 2 else room_low)[across]
            begin, end = room_low[along], room_high[along]
            for at in (begin, end):
                corner = (place, at) if across == 0 else (at, place)
                posts[float(corner[0]), float(corner[1])] = None
            if kind == "open":
                continue
            gap = None
            if kind == "door":
                wide = min(draw.uniform(0.8, 1.6), 0.8 * (end - begin))
                start = draw.uniform(0.15, end - begin - wide - 0.15)
                gap = (start, start + wide, -0.1, min(draw.uniform(2.0, 2.4), plan.height - 0.1))
            elif (cell, side) in plan.windows:
                wide = draw.uniform(0.3, 0.7) * (end - begin)
                start = draw.uniform(0.15, end - begin - wide - 0.15)
                sill = draw.uniform(0.4, 1.2)
                gap = (start, start + wide, sill, draw.uniform(sill + 0.7, plan.height - 0.1))
            material = walls[int(draw.rng.integers(len(walls)))]
            for a, b, bottom, above in _pieces(end - begin, top, gap):
                lower, upper = np.zeros(3), np.zeros(3)
                lower[across], upper[across] = place - 0.5 * _THICK, place + 0.5 * _THICK
                lower[along], upper[along], lower[2], upper[2] = begin + a, begin + b, bottom, above
                draw.add(_box("wall", lower, upper, material))
            if gap is not None and kind == "door":
                lower, upper = np.zeros(3), np.full(3, 2.0)
                lower[across], upper[across] = place - 0.6, place + 0.6
                lower[along], upper[along] = begin + gap[0], begin + gap[1]
                draw.free.append((lower, upper))
    half = 0.5 * _THICK + 0.01
    for px, py in posts:
        draw.add(_box("post", (px - half, py - half, -0.05), (px + half, py + half, top + 0.01), walls[0]))


def _pieces(
    length: float, top: float, gap: tuple[float, float, float, float] | None
) -> Iterator[tuple[float, float, float, float]]:
    """The parts of a wall around its opening: begin and end along the wall, bottom and top."""
    if gap is None:
        yield 0.0, length, -0.05, top
        return
    start, stop, bottom, above = gap
    yield 0.0, start, -0.05, top
    yield stop, length, -0.05, top
    yield start, stop, above, top
    if bottom > 0.0:
        yield start, stop, -0.05, bottom


def _clutter(draw: _Draw, plan: _Plan, at: Cell, count: int, triangles: int) -> None:
    """Boxes, balls, boulders, tables and stacks of about `triangles` triangles, half of them in the room `at`."""
    paints = [draw.paint(textured=0.25, low=0.05) for _ in range(5)]
    each = max(triangles / max(count, 1), 12.0)
    placed: list[Box] = []
    for _ in range(count):
        cell = at if draw.chance(0.5) else plan.cells[int(draw.rng.integers(len(plan.cells)))]
        low, high = plan.room(cell)
        size = draw.uniform(0.15, 0.6) * min(1.0, 0.3 * (high[:2] - low[:2]).min())
        material = paints[int(draw.rng.integers(len(paints)))]
        for _ in range(20):
            base = np.array([*draw.rng.uniform(low[:2] + size + 0.15, high[:2] - size - 0.15), 0.0])
            box = (base - np.array([size, size, 0.0]), base + np.array([size, size, 2.0 * size]))
            near = [b for b in placed if _overlap(b, box)]
            if near and draw.chance(0.5):  # a stack
                base[2] = max(b[1][2] for b in near)
                box = (box[0] + (0, 0, base[2]), box[1] + (0, 0, base[2]))
                near = [b for b in near if _overlap(b, box)]
            if not near and box[1][2] < plan.height - 0.3 and not any(_overlap(f, box) for f in draw.free):
                break
        else:
            continue
        placed.append(box)
        for part in _thing(draw, size, each, material):
            draw.add(replace(part, points=part.points + base))


def _thing(draw: _Draw, size: float, triangles: float, material: int) -> list[Mesh]:
    """Something within `size` of the axis, at most 2 `size` high, that stands on z = 0."""
    turn = draw.uniform(0.0, 2.0 * np.pi)
    c, s = np.cos(turn), np.sin(turn)
    turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    r = size / np.sqrt(2.0)
    match int(draw.rng.integers(4)):
        case 0:  # a box
            cells = int(np.clip(np.sqrt(triangles / 12.0), 1, 60))
            parts = [_box("box", (-r, -r, 0.0), (r, r, draw.uniform(0.3, 2.0) * size), material, cells)]
        case 1:  # a table
            h, leg = draw.uniform(0.8, 1.8) * size, 0.12 * size
            parts = [_box("table", (-r, -r, h - leg), (r, r, h), material)]
            for x in (-r, r - leg):
                for y in (-r, r - leg):
                    parts.append(_box("leg", (x, y, 0.0), (x + leg, y + leg, h - leg), material))
        case shape:  # a ball, or a boulder
            level = int(np.clip(round(np.log2(triangles / 8.0) / 2.0), 1, 6))
            points, faces = sphere(size, level)
            if shape == 3:
                wave = np.sin(points @ draw.rng.uniform(-6.0, 6.0, (3, 3)) / size + draw.rng.uniform(0.0, 6.0, 3))
                points = points * (0.85 + 0.15 * wave.prod(axis=1))[:, None]
            ball = mesh("ball", points - (0.0, 0.0, points[:, 2].min()), faces, material)
            parts = [replace(ball, uvs={"st": _planar(ball)})]
    return [replace(part, points=part.points @ turned.T) for part in parts]


def _overlap(a: Box, b: Box) -> bool:
    return bool((a[0] < b[1]).all() and (b[0] < a[1]).all())


def _lamp(draw: _Draw, room: Box, *, glowing: bool, strength: float = 1.0) -> None:
    """A lamp somewhere under the ceiling of a room: a light, or a surface that glows."""
    low, high = room
    margin = np.minimum(0.5, 0.3 * (high - low)[:2])
    x, y = draw.rng.uniform(low[:2] + margin, high[:2] - margin)
    size = draw.uniform(0.08, 0.4) * min(1.0, 0.5 * (high[:2] - low[:2]).min())
    drop = draw.uniform(0.06, 0.4) if draw.chance(0.5) else draw.uniform(0.3, 1.2)
    z = high[2] - drop
    down = np.array([0.0, 0.0, -1.0])
    power = strength * draw.uniform(1.0, 4.0) / size**2
    if glowing:
        _glow(draw, np.array([x, y, z]), size, power, room)
        return
    place = np.eye(4)
    place[:3, 3] = x, y, z
    kind = LightKind(int(draw.rng.integers(5)))
    shapes: dict[LightKind, dict[str, float]] = {
        LightKind.RECT: {"width": size, "height": size * draw.uniform(0.3, 3.0)},
        LightKind.DISK: {"radius": 0.6 * size},
        LightKind.SPHERE: {"radius": 0.2 * size},
        LightKind.CYLINDER: {"radius": 0.05 * size, "length": 1.5 * size},
        LightKind.POINT: {},
    }
    if kind is LightKind.POINT:
        power *= size**2
    if kind in (LightKind.SPHERE, LightKind.CYLINDER):
        place[2, 3] = z = min(z, high[2] - 0.25 * size - 0.05)
    shines = down if kind in (LightKind.RECT, LightKind.DISK) else np.zeros(3)
    draw.lights.append(Light(f"lamp_{len(draw.lights)}", kind, draw.color(power), place, **shapes[kind]))
    at = np.array([x, y, z])
    draw.lamps.append((at, shines))
    draw.free.append((at - 0.3 - size, at + 0.3 + size))


def _glow(draw: _Draw, at: Floats, size: float, power: float, room: Box) -> None:
    """A panel on the ceiling or on a wall, a ball, or a tube that hangs."""
    index = len(draw.materials)
    draw.materials.append(Material(f"glow_{index}", (0.5, 0.5, 0.5), draw.color(power)))
    low, high = room
    s, shines = 0.5 * size, np.zeros(3)
    match int(draw.rng.integers(4)):
        case 0 | 1:  # on a wall where another number says so
            shape = np.array([[-s, -s, 0.0], [-s, s, 0.0], [s, s, 0.0], [s, -s, 0.0]])
            shines = np.array([0.0, 0.0, -1.0])
            at[2] = high[2] - draw.uniform(0.01, 0.1)
            if draw.chance(0.4):
                axis, end = int(draw.rng.integers(2)), int(draw.rng.integers(2))
                sign = 1.0 - 2.0 * end
                shines = np.zeros(3)
                shines[axis] = sign
                side = np.cross([0.0, 0.0, 1.0], shines)
                shape = np.stack([-s * side, s * side, s * side, -s * side]) + s * np.array(
                    [[0, 0, -1], [0, 0, -1], [0, 0, 1], [0, 0, 1]]
                )
                at[2] = draw.uniform(1.0, high[2] - s - 0.1)
                at[axis] = (high if end else low)[axis] + sign * (0.5 * _THICK + 0.02)
            part = quad("panel", at + shape, index)
        case 2:
            points, faces = sphere(0.4 * size, int(draw.rng.integers(1, 4)))
            part = mesh("bulb", at - (0.0, 0.0, 0.2) + points, faces, index)
        case _:
            part = _box("tube", at - np.array([size, 0.03, 0.25]), at + np.array([size, 0.03, -0.19]), index)
    draw.add(part, blocks=False)
    draw.lamps.append((part.points.mean(axis=0), shines))
    draw.free.append((part.points.min(axis=0) - 0.15, part.points.max(axis=0) + 0.15))


def _daylight(draw: _Draw, plan: _Plan) -> None:
    """A sky, a sun or both; a sun shines into a window, if there is one."""
    both = int(draw.rng.integers(3))
    if both != 1:
        draw.sky = True
        blue = draw.uniform(0.0, 0.5)
        draw.lights.append(Light("sky", LightKind.DOME, (1.0 - blue, 1.0 - 0.5 * blue, 1.0)))
    if both != 0:
        tilt, turn = np.radians(draw.uniform(20.0, 65.0)), draw.uniform(0.0, 2.0 * np.pi)
        if plan.windows:
            side = plan.windows[-1][1]
            turn = np.arctan2(_SIDES[side][1], _SIDES[side][0]) + draw.uniform(-0.8, 0.8)
        to_sun = np.array([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)])
        angle = float(draw.rng.choice([0.53, 2.0, 8.0]))
        solid = 2.0 * np.pi * (1.0 - np.cos(np.radians(angle / 2)))
        x = np.cross([0.0, 0.0, 1.0], to_sun)
        x /= np.linalg.norm(x)
        place = np.eye(4)
        place[:3, :3] = np.stack([x, np.cross(to_sun, x), to_sun], axis=1)
        color = draw.color(draw.uniform(2.0, 12.0) / solid)
        draw.lights.append(Light("sun", LightKind.DISTANT, color, place, angle=angle))
        draw.sun = to_sun


def _camera_cell(plan: _Plan, kind: str) -> Cell:
    """The lit room, or where the light comes from elsewhere the first."""
    return plan.cells[-1] if kind in ("room", "panels", "window", "crowd", "lamps") else plan.cells[0]


def _camera(draw: _Draw, plan: _Plan, kind: str) -> tuple[Camera, Floats, Floats]:
    """A camera in its room, its position and its direction."""
    low, high = plan.room(_camera_cell(plan, kind))
    margin = np.minimum(0.5, 0.3 * (high - low)[:2])
    eye = np.array([*draw.rng.uniform(low[:2] + margin, high[:2] - margin), draw.uniform(1.0, 1.9)])
    middle = 0.5 * (low + high) - eye
    turn = np.arctan2(middle[1], middle[0]) + draw.uniform(-0.9, 0.9)
    if kind in ("corridor", "away"):
        turn = draw.uniform(-0.35, 0.35)
        share = draw.uniform(0.1, 0.5)
        if kind == "away":
            turn, share = turn + np.pi, draw.uniform(0.5, 0.9)
        eye[0] = low[0] + share * (high[0] - low[0])
    pitch = np.radians(draw.uniform(-25.0, 8.0))
    forward = np.array([np.cos(turn) * np.cos(pitch), np.sin(turn) * np.cos(pitch), np.sin(pitch)])
    fov = draw.uniform(50.0, 85.0)
    return Camera.look_at(tuple(eye), tuple(eye + forward), up=(0.0, 0.0, 1.0), fov=fov), eye, forward


def _draw(rng: np.random.Generator, kind: str, name: str) -> Scene | None:
    """One draw of a scene; None if it is not seen or not lit."""
    draw = _Draw(rng)
    plan = _plan(draw, kind)
    _build(draw, plan)
    glowing = kind == "panels" or (kind not in ("window", "open", "lamps") and draw.chance(0.4))
    lit = [plan.room(plan.cells[-1])]
    if kind in ("window", "open"):
        _daylight(draw, plan)
    elif kind == "lamps":
        for _ in range(int(rng.integers(4, 31))):
            room = plan.room(plan.cells[int(rng.integers(len(plan.cells)))])
            _lamp(draw, room, glowing=False, strength=10.0 ** draw.uniform(-1.0, 0.5))
    else:
        for _ in range(1 if kind == "far" else int(rng.integers(1, 4))):
            _lamp(draw, lit[0], glowing=glowing)
    camera, eye, forward = _camera(draw, plan, kind)
    draw.free.append((np.minimum(eye, eye + forward) - 0.35, np.maximum(eye, eye + forward) + 0.35))
    at = _camera_cell(plan, kind)
    if kind == "crowd":
        _clutter(draw, plan, at, int(rng.integers(120, 260)), int(rng.integers(60_000, 150_000)))
    else:
        _clutter(draw, plan, at, int(rng.integers(6, 30)), int(10.0 ** draw.uniform(2.5, 4.0)))
    scene = Scene(tuple(draw.meshes), tuple(draw.materials), tuple(draw.lights), camera, name)
    return scene if _is_seen(draw, plan, eye, camera) and _is_lit(draw, eye, camera) else None


def _camera_rays(camera: Camera, u: Floats, v: Floats) -> Floats:
    """Unit directions [n, 3] through points (u, v) of [0, 1]² of a square picture."""
    left, right, bottom, top = camera.fit(1, 1).window
    local = np.stack([left + u * (right - left), bottom + v * (top - bottom), np.full(u.shape, -1.0)], axis=1)
    directions = local @ camera.world_from_camera[:3, :3].T
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _hit(origins: Floats, directions: Floats, boxes: Floats) -> tuple[Floats, Floats, Ints]:
    """Distances [n] to the nearest of the boxes [m, 2, 3] (inf: none; 0: inside of one), normals [n, 3], which box."""
    with np.errstate(divide="ignore", invalid="ignore"):
        slabs = (boxes[None] - origins[:, None, None]) / directions[:, None, None]
    near, far = slabs.min(axis=2), slabs.max(axis=2)
    axis = near.argmax(axis=2)
    enter, leave = near.max(axis=2), far.min(axis=2)
    distances = np.where((enter <= leave) & (leave > 0.0), np.maximum(enter, 0.0), np.inf)
    first, rows = distances.argmin(axis=1), np.arange(len(origins))
    normals = np.zeros_like(origins)
    side = axis[rows, first]
    normals[rows, side] = -np.sign(directions[rows, side])
    return distances[rows, first], normals, first


def _is_seen(draw: _Draw, plan: _Plan, eye: Floats, camera: Camera) -> bool:
    boxes = np.array(draw.boxes)
    if ((eye > boxes[:, 0] - 0.25) & (eye < boxes[:, 1] + 0.25)).all(axis=1).any():
        return False
    u, v = (g.reshape(-1) for g in (np.mgrid[:16, :16] + 0.5) / 16)
    directions = _camera_rays(camera, u, v)
    distances, _, first = _hit(np.tile(eye, (len(u), 1)), directions, boxes)
    ends = np.isfinite(distances)
    several = len(np.unique(first[ends])) >= 6
    return several and bool(ends.mean() > (0.9 if plan.roof else 0.7) and np.median(distances) > 1.2)


def _is_lit(draw: _Draw, eye: Floats, camera: Camera) -> bool:
    boxes, rng = np.array(draw.boxes), np.random.default_rng(1)
    directions = _camera_rays(camera, *rng.random((2, 1000)))
    origins = np.tile(eye, (1000, 1))
    found = 0
    for bounce in range(BOUNCES + 1):
        distances, normals, _ = _hit(origins, directions, boxes)
        kept = np.isfinite(distances)
        if draw.sky and bounce > 0:
            found += int((~kept & (directions[:, 2] > 0.0)).sum())
        points = origins[kept] + distances[kept, None] * directions[kept]
        normals = normals[kept]
        points = points + 1e-3 * normals
        lamp = rng.integers(max(len(draw.lamps), 1), size=len(points))
        if draw.lamps:
            towards = np.array([at for at, _ in draw.lamps])[lamp] - points
            far = np.linalg.norm(towards, axis=1)
            towards /= far[:, None]
            shines = np.array([way for _, way in draw.lamps])[lamp]
            facing = (shines * towards).sum(axis=1) < np.where(shines.any(axis=1), -0.05, 0.5)
        else:
            sun = draw.sun if draw.sun is not None else np.array([0.0, 0.0, 1.0])
            towards, far = np.tile(sun, (len(points), 1)), np.full(len(points), np.inf)
            facing = np.full(len(points), draw.sun is not None)
        chosen = facing & ((towards * normals).sum(axis=1) > 0.05)
        free = _hit(points[chosen], towards[chosen], boxes)[0]
        found += int((np.isinf(free) | (free > far[chosen] - 0.05)).sum())
        ball = rng.normal(size=points.shape)
        directions = normals + ball / np.linalg.norm(ball, axis=1, keepdims=True)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        origins = points
        if found >= 20:
            return True
    return False


def random_scene(seed: int) -> Scene:
    """The scene of a seed, the same on every machine."""
    kind = list(KINDS)[seed % len(KINDS)]
    rng = np.random.default_rng([0x5CE7E, seed])
    for _ in range(_DRAWS):
        if (scene := _draw(rng, kind, f"{kind}_{seed}")) is not None:
            return scene
    raise RuntimeError(f"seed {seed}: none of {_DRAWS} draws is seen and lit")


def write_usd(scene: Scene, path: Path) -> None:
    """Writes a random scene as a stage, its textures beside it: `load_usd` reads the same scene from it."""
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    looks = []
    for material in scene.materials:
        look = UsdShade.Material.Define(stage, f"/World/Looks/{material.name}")
        surface = UsdShade.Shader.Define(stage, look.GetPath().AppendChild("Surface"))
        surface.CreateIdAttr("UsdPreviewSurface")
        diffuse = surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
        diffuse.Set(Gf.Vec3f(*material.albedo))
        if material.albedo_texture is not None:
            file = path.with_name(f"{path.stem}_{material.name}.png")
            write_image(file, material.albedo_texture.pixels)
            image = UsdShade.Shader.Define(stage, look.GetPath().AppendChild("Texture"))
            image.CreateIdAttr("UsdUVTexture")
            image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(f"./{file.name}")
            image.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
            for wrap in ("wrapS", "wrapT"):
                image.CreateInput(wrap, Sdf.ValueTypeNames.Token).Set("repeat")
            reader = UsdShade.Shader.Define(stage, look.GetPath().AppendChild("St"))
            reader.CreateIdAttr("UsdPrimvarReader_float2")
            reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
            coordinates = image.CreateInput("st", Sdf.ValueTypeNames.Float2)
            coordinates.ConnectToSource(reader.CreateOutput("result", Sdf.ValueTypeNames.Float2))
            diffuse.ConnectToSource(image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3))
        surface.CreateInput("emissiveColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*material.emission))
        surface.CreateInput("useSpecularWorkflow", Sdf.ValueTypeNames.Int).Set(1)
        surface.CreateInput("specularColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(0.0))
        surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0)
        look.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
        looks.append(look)
    for part in scene.meshes:
        prim = UsdGeom.Mesh.Define(stage, f"/World/{part.name}")
        prim.CreatePointsAttr(part.points.astype(np.float32))
        prim.CreateFaceVertexCountsAttr([3] * len(part.triangles))
        prim.CreateFaceVertexIndicesAttr(part.triangles.reshape(-1).astype(np.int32))
        prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        if "st" in part.uvs:
            kind = Sdf.ValueTypeNames.TexCoord2fArray
            primvar = UsdGeom.PrimvarsAPI(prim).CreatePrimvar("st", kind, UsdGeom.Tokens.faceVarying)
            primvar.Set(part.uvs["st"].reshape(-1, 2))
        UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(looks[int(part.material[0])])
    for light in scene.lights:
        scale, kind = light.radiance, light.kind
        given: dict[str, float] = {}
        match kind:
            case LightKind.RECT:
                prim, given = UsdLux.RectLight, {"width": light.width, "height": light.height}
            case LightKind.DISK:
                prim, given = UsdLux.DiskLight, {"radius": light.radius}
            case LightKind.SPHERE:
                prim, given = UsdLux.SphereLight, {"radius": light.radius}
            case LightKind.CYLINDER:
                prim, given = UsdLux.CylinderLight, {"radius": light.radius, "length": light.length}
            case LightKind.DISTANT:
                prim, given = UsdLux.DistantLight, {"angle": light.angle}
            case LightKind.POINT:  # the limit of spheres of the same power: intensity / 4, if that is normalized
                prim, given = UsdLux.SphereLight, {"normalize": True}
                scale = tuple(4.0 * channel for channel in scale)
            case _:
                prim = UsdLux.DomeLight
        defined = prim.Define(stage, f"/World/{light.name}")
        defined.CreateColorAttr(Gf.Vec3f(*(channel / max(scale) for channel in scale)))
        defined.CreateIntensityAttr(max(scale))
        if kind is LightKind.POINT:
            defined.CreateTreatAsPointAttr(True)
        for name, number in given.items():
            defined.GetPrim().GetAttribute(f"inputs:{name}").Set(number)
        UsdGeom.Xformable(defined).AddTransformOp().Set(Gf.Matrix4d(light.world_from_light.T.tolist()))
    eye = UsdGeom.Camera.Define(stage, "/World/main_cam")
    left, right, bottom, top = scene.camera.fit(1, 1).window
    eye.CreateHorizontalApertureAttr(right - left)
    eye.CreateVerticalApertureAttr(top - bottom)
    eye.CreateFocalLengthAttr(1.0)
    eye.CreateClippingRangeAttr(Gf.Vec2f(0.01, 1000.0))
    UsdGeom.Xformable(eye).AddTransformOp().Set(Gf.Matrix4d(scene.camera.world_from_camera.T.tolist()))
    stage.SetDefaultPrim(stage.GetPrimAtPath("/World"))
    stage.GetRootLayer().Save()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("seeds", type=int, nargs="+", metavar="SEED")
    parser.add_argument("--usd", type=Path, metavar="FOLDER", help="also write the scenes as stages to this folder")
    options = parser.parse_args()
    for seed in options.seeds:
        scene = random_scene(seed)
        if options.usd is not None:
            options.usd.mkdir(parents=True, exist_ok=True)
            write_usd(scene, options.usd / f"{scene.name}.usda")
        print(f"{scene.name}: {scene.triangle_count} triangles, {len(scene.meshes)} meshes, {len(scene.lights)} lights")


if __name__ == "__main__":
    main()
