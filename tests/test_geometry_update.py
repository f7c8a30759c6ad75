"""Updates of moving surfaces: static geometry is untouched, and pictures are bitwise those of a new renderer."""

from dataclasses import replace

import numpy as np
import pytest

import warp_ir as ir
from warp_ir.bvh import BvhForest
from warp_ir.procedural import cube, mesh, sphere
from warp_ir.scene import Instances

pytestmark = pytest.mark.extended

SETTINGS = ir.RenderSettings(width=24, iterations=2, light_paths=16, estimator="path", filter=False)
ROOM = mesh("room", *cube(2.0), 0)
BALL = sphere(level=4)  # 2048 triangles: it has a tree of its own


def ball(time, name="ball", material=1, level=4, smooth=False):
    """A ball whose position and shape depend on time."""
    points, triangles = sphere(level=level)
    placed = points * 0.3 * (1.0 + 0.3 * np.sin(5.0 * points[:, 1:2] + time)) + (0.2 * np.cos(time), 0.0, 0.3)
    made = mesh(name, placed, triangles, material)
    return replace(made, normals=placed[triangles].astype(np.float32)) if smooth else made


LAMP = ir.Light(
    "lamp",
    ir.scene.LightKind.SPHERE,
    (9.0, 8.0, 7.0),
    np.array([[1.0, 0.0, 0.0, -0.6], [0.0, 1.0, 0.0, 0.7], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]),
    radius=0.1,
)
MATERIALS = (
    ir.Material("room", (0.7,) * 3),
    ir.Material("ball", (0.7, 0.4, 0.2)),
    ir.Material("glow", (0.1,) * 3, (2.0,) * 3),
)


def scene(*meshes, **more):
    """A scene of meshes with one lamp."""
    camera = ir.Camera.look_at((0, 0, -0.95), (0, 0, 1), fov=80)
    return ir.Scene(meshes=meshes, materials=MATERIALS, lights=(LAMP,), camera=camera, **more)


def places(time, count=5):
    """Matrices of a row of instances."""
    out = np.tile(np.eye(4), (count, 1, 1))
    out[:, :3, :3] *= 0.3
    out[:, 0, 3] = np.linspace(-0.7, 0.7, count)
    out[:, 1, 3] = 0.3 * np.sin(np.arange(count) + time)
    return out


STILL = ball(0.0, "still", level=2)
PROTOTYPE = ball(0.5, "prototype", level=3)
SMALL = [ball(float(k), f"small{k}", level=1) for k in range(4)]


def shrunk(made, k, time):
    return replace(made, points=made.points * 0.3 + (0.4 * k - 0.6, 0.3 * np.sin(time + k), 0.0))


FRAMES = {
    "a mesh": lambda time: scene(ROOM, ball(time), STILL),
    "the first mesh": lambda time: scene(ball(time), ROOM),
    "smooth": lambda time: scene(ROOM, ball(time, smooth=True), STILL),
    "all of them": lambda time: scene(replace(ROOM, points=ROOM.points * (1.0 + 0.01 * time)), ball(time)),
    "small ones": lambda time: scene(ROOM, *(shrunk(m, k, time) for k, m in enumerate(SMALL))),
    "one that emits": lambda time: scene(ROOM, ball(time, material=2), STILL),
    "one next to one that emits": lambda time: scene(ball(time), replace(STILL, material=STILL.material + 1), ROOM),
    "one that comes and goes": lambda time: scene(*([ball(time)] if int(time) % 2 else []), ROOM, STILL),
    "its triangles": lambda time: scene(ROOM, ball(time, level=3 + int(time) % 2)),
    "its looks": lambda time: scene(ROOM, ball(0.0, material=int(time) % 2)),
    "instances": lambda time: scene(ROOM, PROTOTYPE, instances=(Instances("p", (1,), places(time)),)),
    "a prototype": lambda time: scene(ROOM, ball(time), instances=(Instances("p", (1,), PLACES),)),
    "a mesh next to instances": lambda time: scene(
        ROOM, ball(time), PROTOTYPE, instances=(Instances("p", (2,), PLACES),)
    ),
    "a world of instances alone": lambda time: scene(
        ROOM, PROTOTYPE, instances=(Instances("r", (0,), np.eye(4)[None]), Instances("p", (1,), places(time)))
    ),
    "materials": lambda time: replace(
        s := scene(ROOM, STILL), materials=(ir.Material("room", (0.1 * time + 0.1,) * 3), *s.materials[1:])
    ),
}  # fmt: skip
PLACES = places(0.0)


@pytest.mark.parametrize("what", FRAMES)
def test_an_updated_picture_is_that_of_a_new_renderer(what, device):
    """After each of several updates the picture is bitwise that of rendering the frame alone."""
    renderer = ir.Renderer(FRAMES[what](0.0), SETTINGS, device=device)
    for time in (1.0, 2.0, 2.0, 3.0, 7.0, 0.0):
        frame = FRAMES[what](time)
        renderer.update(frame)
        film, alone = renderer.render(), ir.render(frame, SETTINGS, device=device)
        np.testing.assert_array_equal(film.radiance(), alone.radiance())
        for name in ("depth", "normal", "prim_id", "albedo"):
            np.testing.assert_array_equal(film.aov(name), alone.aov(name), name)


@pytest.mark.parametrize("what", ["a mesh", "smooth", "all of them", "small ones", "one that emits", "a prototype"])
def test_moving_meshes_are_refit_not_rebuilt(what, monkeypatch):
    """From the second frame on it is known what moves: tables stay in the same arrays, and trees are refit."""
    renderer = ir.Renderer(FRAMES[what](0.0), SETTINGS)
    renderer.update(FRAMES[what](0.1))
    before = renderer.scene.data
    monkeypatch.setattr(BvhForest, "build", lambda *_: pytest.fail("a tree is built"))
    for time in (0.2, 0.3):
        renderer.update(FRAMES[what](time))
        for name in ("points", "indices", "corner_normals", "triangle_material"):
            assert getattr(renderer.scene.data, name) is getattr(before, name)
        assert renderer.scene.data.bvh.nodes is before.bvh.nodes


def test_mesh_indices_follow_the_scene():
    """Adding an empty mesh changes no geometry, but the indices of the meshes after it, static or moving."""
    empty = ir.Mesh("empty", np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros(0, np.int32))
    renderer = ir.Renderer(scene(ROOM, ball(0.0)), SETTINGS)
    moved = ball(1.0)
    for frame in (scene(ROOM, moved), scene(empty, ROOM, moved), scene(ROOM, moved)):
        renderer.update(frame)
        np.testing.assert_array_equal(renderer.render().aov("prim_id"), ir.render(frame, SETTINGS).aov("prim_id"))


def test_a_degraded_tree_is_rebuilt(monkeypatch):
    """Triangles that change places degrade a tree: it is rebuilt in that frame and refit in the next."""
    points, triangles = sphere(level=4)
    corners = (points * 0.3)[triangles]
    order = np.random.default_rng(0).permutation(len(corners))
    indices = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)

    def frame(shift, shuffled):
        placed = (corners[order] if shuffled else corners).reshape(-1, 3) + np.array([shift, 0.0, 0.3])
        return scene(ROOM, mesh("ball", placed, indices, 1))

    built = []
    build = BvhForest.build
    monkeypatch.setattr(
        BvhForest, "build", lambda self, parts, keep_count=0: built.append(len(parts)) or build(self, parts, keep_count)
    )
    renderer = ir.Renderer(frame(0.0, False), SETTINGS)
    counts = []
    for shift, shuffled in ((0.1, False), (0.2, False), (0.2, True), (0.3, True)):
        built.clear()
        renderer.update(frame(shift, shuffled))
        counts.append(list(built))
        film, alone = renderer.render(), ir.render(frame(shift, shuffled), SETTINGS)
        np.testing.assert_array_equal(film.aov("depth"), alone.aov("depth"))
    assert counts == [[2], [], [1], []]


def test_shutter_samples_share_static_geometry():
    """Only moving meshes are stored once per shutter sample; the next frame overwrites them."""

    def frame(time):
        samples = tuple(scene(ROOM, ball(time + 0.1 * k), STILL) for k in range(4))
        return replace(samples[0], shutter=samples)

    settings = replace(SETTINGS, iterations=4)
    renderer = ir.Renderer(frame(0.0), settings)
    still = len(ROOM.triangles) + len(STILL.triangles)
    assert renderer.scene.data.triangle_material.shape[0] == still + 4 * len(BALL[1])
    for time in (1.0, 1.5):
        renderer.update(frame(time))
        np.testing.assert_array_equal(renderer.render().radiance(), ir.render(frame(time), settings).radiance())
        assert renderer.scene.data.triangle_material.shape[0] == still + 4 * len(BALL[1])


def test_an_update_after_a_rejected_one_is_right():
    """A frame that is rejected midway leaves no state that a later update could reuse by mistake."""
    good = scene(ROOM, ball(0.0), PROTOTYPE, instances=(Instances("p", (2,), PLACES),))
    flat = PLACES * np.array([1.0, 1.0, 0.0, 1.0])[:, None]
    bad = replace(good, meshes=(ROOM, ball(1.0), PROTOTYPE), instances=(Instances("p", (2,), flat),))
    renderer = ir.Renderer(good, SETTINGS)
    renderer.update(replace(good, meshes=(ROOM, ball(0.5), PROTOTYPE)))
    for frame in (good, replace(good, meshes=(ROOM, ball(0.5), PROTOTYPE))):
        with pytest.raises(ir.InputError, match="singular"):
            renderer.update(bad)
        renderer.update(frame)
        np.testing.assert_array_equal(renderer.render().radiance(), ir.render(frame, SETTINGS).radiance())
