"""Walls keep light out, however thin they are: here the walks of light, and whole pictures in benchmarks/stress.py."""

import numpy as np
import pytest
import warp as wp

import warp_ir as ir
from warp_ir.device_scene import SceneData, upload_scene
from warp_ir.procedural import cube, mesh
from warp_ir.sampling import sobol
from warp_ir.sampling.square_to import square_to_cone, square_to_cosine_hemisphere
from warp_ir.surface import closest

pytestmark = pytest.mark.extended

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _walk(first: int, scene: SceneData, axis: wp.vec3, wall: float, escaped: wp.array[wp.int32]):
    """Counts the reflections until a diffuse walk from the middle is where it cannot be; 0 if it never is."""
    i = first + wp.tid()
    scramble = sobol.hash_combine(wp.uint32(7), wp.uint32(i))
    position = wp.vec3(0.0)
    direction = square_to_cone(sobol.sample_2d(scene.sobol, 0, 0, scramble), 2.0, axis)
    for bounce in range(30):
        hit = closest(scene, position, direction, 3.0e38)
        if hit.triangle < 0 or wp.dot(hit.position, axis) > wall * 1.00001:
            escaped[i] = bounce + 1
            break
        position = hit.position
        u = sobol.sample_2d(scene.sobol, 0, 2 * bounce + 2, scramble)
        direction = square_to_cosine_hemisphere(u, hit.normal)


@pytest.mark.parametrize("seed", [4, pytest.param(1, marks=pytest.mark.slow), pytest.param(8, marks=pytest.mark.slow)])
def test_no_walk_gets_through(launcher, seed):
    """Of 10⁶ walks of 30 reflections in a room with a wall of no thickness across it, none leaves its half.

    About one in 10⁸ hits falls within the rounding error of an edge, so a careless offset shows.
    """
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    points, triangles = cube(2.0)
    corners = np.array([[0.3, -1.0, -1.0], [0.3, 1.0, -1.0], [0.3, 1.0, 1.0], [0.3, -1.0, 1.0]])
    divider = mesh("divider", corners @ turn.T, np.array([[0, 1, 2], [0, 2, 3]]))
    scene = upload_scene(ir.Scene(meshes=(mesh("room", points @ turn.T, triangles), divider)), launcher)
    escaped = launcher.zeros(1 << 20, wp.int32)
    launcher.launch(_walk, len(escaped), [scene.data, wp.vec3(*turn[:, 0]), 0.3 * scene.frame.scale, escaped])
    assert np.count_nonzero(escaped.numpy()) == 0
