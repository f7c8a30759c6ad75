"""Scenes whose poses, points and colours come from the device."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import warp_ir as ir
from tests.live import array, look_at, rays, shift, shots
from warp_ir.procedural import cube, mesh, quad, sphere
from warp_ir.scene import InputError, Instances, LightKind
from warp_ir.simulation.bodies import quaternions, rotations_and_stretches

pytestmark = pytest.mark.extended

SKY = ir.Light("sky", LightKind.DOME, (1.0, 1.0, 1.0))
EYE = look_at((0.5, 2.0, 5.0))
PLAIN = ir.ViewSettings(filter=False, light_paths=64)
NAMES = ("hdr_color", "depth", "normal", "shape_index")


def picture(scene, step=0, **options):
    return shots(ir.Views(scene, PLAIN), [EYE], rays(24), names=NAMES, step=step, **options)


def same(a, b):
    return all((a[name] == b[name]).all() for name in NAMES)


def things(lamp=0.0):
    """A ground, a ball, and three instances of a box with colours; the ball may be a lamp."""
    points, triangles = cube(1.0)
    matrices = np.tile(np.eye(4), (3, 1, 1))
    matrices[:, 0, 3] = -1.5, 0.0, 1.5
    matrices[:, 0, 0] = 0.5  # they keep their shape, wherever they move
    box = mesh("box", points, triangles)
    box = replace(box, bare=np.ones(len(triangles), bool))
    scene = ir.Scene(
        (
            quad("ground", [(-4, -1, 4), (4, -1, 4), (4, -1, -4), (-4, -1, -4)]),
            mesh("ball", *sphere(0.5, level=3), int(lamp > 0.0)),
            box,
        ),
        (ir.Material("grey", (0.5,) * 3), ir.Material("lamp", (0.1,) * 3, (lamp,) * 3)),
        (SKY,),
        instances=(Instances("boxes", (2,), matrices, np.full((3, 3), 0.4, np.float32)),),
    )
    return scene


def test_a_live_scene_shows_what_a_scene_shows():
    """Depth, normal and instance of a live scene are those of ray casting the same scene flattened: the AOVs."""
    scene = replace(things(), camera=ir.Camera.look_at((0.5, 2.0, 5.0), (0.0, 0.0, 0.0)))
    live = ir.LiveScene(scene)
    assert live.count == 5 and live.names == ["ground", "ball", "boxes", "boxes", "boxes"]
    out = shots(ir.Views(live, PLAIN), [EYE], rays(48, window=scene.camera.window), names=("forward_depth",))
    film = ir.render(scene, ir.RenderSettings(width=48, iterations=64))
    depth = np.where(film.aov("alpha") > 0.999, film.aov("depth"), 0.0)
    mean = [0.5 * (np.roll(depth, 1, axis) + np.roll(depth, -1, axis)) for axis in (0, 1)]
    flat = (depth > 0.0) & (np.abs(depth - mean[0]) < 0.01) & (np.abs(depth - mean[1]) < 0.003)  # of one surface
    assert flat.sum() > 400
    np.testing.assert_allclose(out["forward_depth"][0][flat], depth[flat], rtol=0.005)


@pytest.mark.parametrize("lamp", [0.0, 6.0])
def test_moved_and_moved_back_is_where_it_was(lamp):
    """Poses decide every bit, not the way to them: also of a lamp, which is sampled where it is."""
    live, other = ir.LiveScene(things(lamp)), ir.LiveScene(things(lamp))
    before, start = picture(live), live.transforms.numpy().copy()
    moved = start.copy()
    moved[1:, :3] += np.random.default_rng(0).random((4, 3)).astype(np.float32)
    live.set_transforms(array(moved, wp.transformf))
    live.refit()
    away = picture(live)
    assert not same(before, away)
    live.set_transforms(array(start, wp.transformf))
    live.refit()
    assert same(before, picture(live))
    for way in (np.full_like(start, np.nan), moved):
        other.set_transforms(array(way, wp.transformf))
        other.refit()
    assert same(away, picture(other))


def test_a_lamp_lights_from_where_it_is():
    """The irradiance under a small lamp falls with the square of its height: 4 to 1 from height 2 to 4, within 5 %."""
    points, triangles = cube(0.1)
    scene = ir.Scene(
        (quad("floor", [(-4, 0, 4), (4, 0, 4), (4, 0, -4), (-4, 0, -4)]), mesh("lamp", points, triangles, 1)),
        (ir.Material("grey", (0.5,) * 3), ir.Material("lamp", (0.0,) * 3, (50.0,) * 3)),
    )
    live = ir.LiveScene(scene)
    views = ir.Views(live, ir.ViewSettings(filter=False, iterations=64, light_paths=64, max_bounces=0))
    seen = []
    for height in (2.0, 4.0):
        live.set_transforms(array([shift(0.0, height, 0.0)], wp.transformf), array([1], wp.int32))
        live.refit()
        seen.append(shots(views, [look_at((0.5, 1.0, 0.0))], 0.05 * rays(4) + 0.95 * rays(1))["hdr_color"].mean())
    assert abs(seen[0] / seen[1] / 4.0 - 1.0) < 0.05


def test_points_move():
    """A mesh whose points are raised is the mesh made there; a selection takes them from a larger array."""
    scene = things()
    ball = scene.meshes[1]
    raised = ball.points + np.array([0.3, 0.4, 0.0])
    live = ir.LiveScene(scene, deforming=("ball",))
    live.set_points("ball", array(raised.astype(np.float32), wp.vec3))
    live.refit()
    there = replace(scene, meshes=(scene.meshes[0], replace(ball, points=raised), scene.meshes[2]))
    found, expected = picture(live), picture(ir.LiveScene(there, deforming=("ball",)))
    assert (found["shape_index"] == expected["shape_index"]).mean() > 0.99
    np.testing.assert_allclose(np.median(np.abs(found["depth"] - expected["depth"])), 0.0, atol=1.0e-5)
    more = np.concatenate([np.full((7, 3), np.nan), raised]).astype(np.float32)
    live.set_points("ball", array(ball.points.astype(np.float32), wp.vec3))
    live.set_points("ball", array(more, wp.vec3), array(np.arange(7, len(more)), wp.int32))
    live.refit()
    assert same(found, picture(live))
    with pytest.raises(InputError, match="boxes"):
        live.set_points("boxes", array(raised, wp.vec3))


def test_colours_change():
    """The albedo of an instance is what it is set to, and no other instance changes."""
    live = ir.LiveScene(things())
    live.set_colors(array([(0.9, 0.1, 0.0)], wp.vec3), array([3], wp.int32))
    live.refit()
    out = shots(ir.Views(live, ir.ViewSettings(linear=True)), [EYE], rays(48), names=("albedo", "shape_index"))
    colors = {int(i): np.unique(out["albedo"][out["shape_index"] == i]) for i in (2, 3, 4)}
    assert colors[2].tolist() == colors[4].tolist() == [0xFF666666] and colors[3].tolist() == [0xFF0019E5]


@pytest.mark.parametrize("count", [1, 7, 8, 9, 65, 300])
def test_trees_hold_every_instance(count):
    """However many instances there are, and however they are divided among worlds, a ray hits the nearest."""
    points, triangles = cube(0.2)
    rng = np.random.default_rng(count)
    matrices = np.tile(np.eye(4), (count, 1, 1))
    matrices[:, 0, 3] = np.arange(count)
    box = mesh("box", points, triangles)
    worlds = rng.integers(-1, 3, count)
    live = ir.LiveScene(ir.Scene((box,), instances=(Instances("boxes", (0,), matrices),)), worlds=worlds, world_count=3)
    order = rng.permutation(count)
    poses = np.array([shift(float(x), 0.0, 0.0) for x in order])
    live.set_transforms(array(poses, wp.transformf))
    live.refit()
    bundle = np.zeros((1, count, 1, 2, 3), np.float32)
    bundle[0, :, 0, 0, 0], bundle[..., 1, 2] = np.arange(count), -1.0
    out = shots(ir.Views(live, PLAIN), [shift(0.0, 0.0, 5.0)] * 3, bundle, names=("shape_index",))["shape_index"]
    for w in range(3):
        expected = np.full(count, 0xFFFFFFFF, np.uint32)
        rows = np.flatnonzero((worlds == w) | (worlds == -1))
        expected[order[rows]] = rows
        assert (out[w, 0] == expected).all()


def test_matrices_are_rotations_times_what_is_left():
    """M = R P with a proper rotation R, whatever M is; the quaternion of R turns vectors as R does."""
    matrices = np.random.default_rng(0).normal(size=(50, 3, 3))
    rotation, stretch = rotations_and_stretches(matrices)
    np.testing.assert_allclose(rotation @ stretch, matrices, atol=1.0e-12)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0)
    q = quaternions(rotation)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0)
    turned = [wp.quat_rotate(wp.quatd(*row), wp.vec3d(1.0, 2.0, 3.0)) for row in q.tolist()]
    np.testing.assert_allclose(turned, rotation @ [1.0, 2.0, 3.0], atol=1.0e-12)


def test_meshes_of_warp_become_a_scene():
    """Prototypes are Warp's meshes; their instances have poses and colours."""
    points, triangles = cube(1.0)
    box = wp.Mesh(array(points.astype(np.float32), wp.vec3), array(triangles.reshape(-1), wp.int32))
    live = ir.LiveScene.from_meshes([box], np.array([0, 0]), colors=np.array([(1, 0, 0), (0, 1, 0)]), lights=(SKY,))
    live.set_transforms(array([shift(-1.0), shift(1.0)], wp.transformf))
    live.refit()
    out = shots(ir.Views(live, ir.ViewSettings(linear=True)), [EYE], rays(24), names=("albedo", "shape_index"))
    for row, color in ((0, 0xFF0000FF), (1, 0xFF00FF00)):
        assert set(out["albedo"][out["shape_index"] == row]) == {color}


def test_mistakes_are_refused():
    """Worlds that are none, meshes to deform that are not there, and poses of another number."""
    with pytest.raises(InputError, match="worlds"):
        ir.LiveScene(things(), worlds=np.array([0, 0, 0, 0, 1]))
    with pytest.raises(InputError, match="cloth"):
        ir.LiveScene(things(), deforming=("cloth",))
    with pytest.raises(InputError, match="boxes"):
        ir.LiveScene(things(), deforming=("boxes",))
    with pytest.raises(InputError, match="5 instances"):
        ir.LiveScene(things()).set_transforms(array([shift()], wp.transformf))
