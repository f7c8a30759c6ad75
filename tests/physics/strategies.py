"""Strategies of hypothesis that draw scenes: rooms, things in them, lights and a camera at random.

Numbers are drawn as multiples of a thousandth of their range, so that what fails shrinks to round ones: then surfaces
and lights share planes and corners, where most is to be found.
"""

import math

import numpy as np
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st

import warp_ir as ir
from tests.physics.closed_form import placed, rotation
from tests.physics.scenes import ball
from warp_ir.procedural import cube, mesh, quad, sphere
from warp_ir.scene import LightKind, Projection, Shaping


def examples(count: int):
    """The settings of a test of scenes: the same ones in every run, and as many of them, however long they take."""
    return settings(
        derandomize=True,
        database=None,
        deadline=None,
        max_examples=count,
        phases=(Phase.explicit, Phase.generate, Phase.shrink),
        suppress_health_check=list(HealthCheck),
    )


def numbers(low, high):
    """A number of a range."""
    return st.integers(0, 1000).map(lambda k: low + (high - low) * k / 1000.0)


def powers(low, high):
    """A number whose decimal logarithm is of a range."""
    return numbers(low, high).map(lambda exponent: 10.0**exponent)


def colors(low, high):
    """Three numbers of a range, equal ones among them."""
    return st.one_of(numbers(low, high).map(lambda x: (x,) * 3), st.tuples(*[numbers(low, high)] * 3))


@st.composite
def turns(draw):
    """A rotation about each axis in turn."""
    angles = draw(st.tuples(*[st.one_of(st.sampled_from([0.0, 90.0]), numbers(0.0, 360.0))] * 3))
    return np.linalg.multi_dot([rotation(axis, angle) for axis, angle in enumerate(angles)])


@st.composite
def materials(draw, most):
    """One to three materials of albedos up to `most`, of which some emit."""
    count = draw(st.integers(1, 3))
    out = []
    for k in range(count):
        albedo = draw(st.one_of(colors(0.0, most), st.just((most,) * 3)))
        emission = draw(colors(0.0, 2.0)) if draw(st.integers(0, 5)) == 5 else (0.0,) * 3
        out.append(ir.Material(f"m{k}", albedo, emission))
    return tuple(out)


@st.composite
def things(draw, size, count, name):
    """A box, a ball, a card, a needle or a coarse smooth ball somewhere in the room."""
    kind = draw(st.sampled_from(["box", "ball", "card", "needle", "smooth ball"]))
    place = np.array(draw(st.tuples(*[numbers(-0.5, 0.5)] * 3))) * size
    radius = draw(numbers(0.05, 0.3)) * min(size)
    turn, material = draw(turns()), draw(st.integers(0, count - 1))
    if kind == "smooth ball":
        coarse = ball(around=6, down=4, radius=radius, center=place)
        return ir.Mesh(name, coarse.points, coarse.triangles, coarse.material + np.int32(material), coarse.normals)
    if kind == "ball":
        points, triangles = sphere(radius, level=1)
    elif kind == "box":
        points, triangles = cube(2.0 * radius)
    else:
        x, y = (radius, radius) if kind == "card" else (1.0e-4 * radius, 3.0 * radius)
        flat = quad(name, [(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)], double_sided=draw(st.booleans()))
        points, triangles = flat.points, flat.triangles
    return mesh(name, points @ turn.T + place, triangles, material)


@st.composite
def shapings(draw):
    """None, or a cone, or a focus, or a profile with a dark sector."""
    kind = draw(st.integers(0, 5))
    if kind == 1:
        return Shaping(cone_angle=draw(numbers(5.0, 170.0)), cone_softness=draw(numbers(0.0, 1.0)))
    if kind == 2:
        return Shaping(focus=draw(numbers(0.0, 20.0)), focus_tint=draw(colors(0.0, 1.0)))
    if kind == 3:
        rows = draw(st.lists(numbers(0.0, 3.0), min_size=2, max_size=6))
        return Shaping(profile=np.array(rows)[:, None] * np.array([[1.0, 0.25]]))
    return None


@st.composite
def lights(draw, size, reach, sizes, brightness, name):
    """A light of any kind; its place within `reach` of the room's half size, its own size a part of the room's."""
    kind = draw(st.sampled_from(list(LightKind)))
    place = np.array(draw(st.tuples(*[numbers(-reach, reach)] * 3))) * 0.5 * np.asarray(size)
    width, height, radius = (draw(sizes) * min(size) for _ in range(3))
    shaping, shadows = draw(shapings()), draw(st.integers(0, 9)) < 9
    # Whatever its size, its power is that of a radiance of about 1 from a tenth of the room.
    area = {LightKind.RECT: width * height, LightKind.CYLINDER: 6.0 * width * radius, LightKind.POINT: 1.0}
    area = area.get(kind, 12.0 * radius**2)
    level = draw(brightness) * 0.1 * min(size) ** 2 / area
    if kind in (LightKind.DISTANT, LightKind.DOME):
        level = draw(brightness)
    texture = None
    if kind in (LightKind.RECT, LightKind.DOME) and draw(st.booleans()):
        texels = draw(st.lists(numbers(0.0, 4.0), min_size=8, max_size=8))
        texture = np.repeat(np.reshape(texels, (2, 4, 1)), 3, axis=2).astype(np.float32)
    if kind == LightKind.DISTANT and draw(st.booleans()):
        angle = 0.0
    else:
        angle = draw(numbers(0.5, 60.0))
    color = tuple(level * x for x in draw(colors(0.2, 1.0)))
    return ir.Light(
        name, kind, color, placed(draw(turns()), place), width, height, radius, 2.0 * width, angle, texture,
        shaping if kind != LightKind.DOME else None, shadows,
    )  # fmt: skip


@st.composite
def cameras(draw, size, reach):
    """A pinhole, a lens or an orthographic camera within `reach` of the room's half size."""
    eye = np.array(draw(st.tuples(*[numbers(-reach, reach)] * 3))) * 0.5 * size
    turn = draw(turns())
    kind, fov = draw(st.integers(0, 4)), draw(numbers(20.0, 110.0))
    half = math.tan(math.radians(0.5 * fov))
    if kind == 3:
        half *= 0.25 * min(size)
        return ir.Camera("c", placed(turn, eye), (-half, half, -half, half), Projection.ORTHOGRAPHIC)
    lens = dict(lens_radius=0.01 * min(size), focus_distance=0.5 * min(size)) if kind == 4 else {}
    return ir.Camera("c", placed(turn, eye), (-half, half, -half, half), **lens)


@st.composite
def scenes(draw, *, wild=False):
    """A scene of a room, or of its floor, with up to four things and one to three lights.

    Args:
        draw: What hypothesis passes.
        wild: Albedos up to 1, lights of 10⁻⁶ to 10⁶ of the room and of 10⁻¹² to 10¹² of the power, anywhere; else
            lights of a size and a place to which a path tracer's standard error does justice.
    """
    size = np.array(draw(st.tuples(*[numbers(1.0, 4.0)] * 3)))
    looks = draw(materials(1.0 if wild else 0.9))
    points, triangles = cube(1.0, inward=True)
    kept = draw(st.sampled_from([12, 12, 10, 8, 6]))  # all walls, or some, as they come
    meshes = [mesh("room", points * size, triangles[12 - kept :], draw(st.integers(0, len(looks) - 1)))]
    for k in range(draw(st.integers(0, 4))):
        meshes.append(draw(things(size, len(looks), f"thing {k}")))
    if draw(st.integers(0, 4)) == 4:  # a double of what there is
        meshes.append(meshes[-1])
    sizes = powers(-6.0, 6.0) if wild else numbers(0.05, 0.4)
    brightness = powers(-12.0, 12.0) if wild else powers(-1.0, 1.0)
    lamps = [
        draw(lights(size, 1.2 if wild else 0.8, sizes, brightness, f"light {k}"))
        for k in range(draw(st.integers(1, 3)))
    ]
    return ir.Scene(tuple(meshes), looks, tuple(lamps), draw(cameras(size, 1.1 if wild else 0.8)))
