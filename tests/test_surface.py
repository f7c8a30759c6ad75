"""Rays start off the surface they leave, at any scale, and find the next one."""

import math
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import warp_ir as ir
from warp_ir.device_scene import SceneData, upload_scene
from warp_ir.procedural import cube, mesh, sphere
from warp_ir.sampling import sobol
from warp_ir.sampling.square_to import square_to_cone, square_to_cosine_hemisphere
from warp_ir.surface import closest, visible

pytestmark = pytest.mark.extended

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _bounce(first: int, scene: SceneData, origin: wp.vec3, self_hits: wp.array[wp.int32], escapes: wp.array[wp.int32]):
    """From inside, to a surface, and from there into the half-space behind it: nothing but that surface is there."""
    i = first + wp.tid()
    u = sobol.sample_2d(scene.sobol, i, 0, wp.uint32(1))
    hit = closest(scene, origin, square_to_cone(u, 2.0, wp.vec3(0.0, 0.0, 1.0)), 3.0e38)
    if hit.triangle < 0:
        escapes[i] = 1
    else:
        v = sobol.sample_2d(scene.sobol, i, 2, wp.uint32(1))
        out = square_to_cosine_hemisphere(v, hit.normal)
        onward = closest(scene, hit.position, out, 3.0e38)
        if onward.triangle == hit.triangle:
            self_hits[i] = 1
        if onward.triangle < 0:
            escapes[i] = 1
        elif not visible(scene, hit.position, wp.vec4(onward.position[0], onward.position[1], onward.position[2], 1.0)):
            self_hits[i] = 1


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e6])
@pytest.mark.parametrize("shift", [0.0, 1e5])
@pytest.mark.parametrize("shape", ["sphere", "cube"])
def test_no_ray_hits_where_it_starts(launcher, scale, shift, shape):
    """In a closed room no ray hits its own triangle, none escapes, and what it hits is seen from where it started."""
    points, triangles = sphere(level=4) if shape == "sphere" else cube()
    room = mesh("room", (points + shift) * scale, triangles)
    uploaded = upload_scene(ir.Scene(meshes=(room,)), launcher)
    n = 20_000
    self_hits, escapes = launcher.zeros(n, wp.int32), launcher.zeros(n, wp.int32)
    origin = wp.vec3(0.01, 0.02, 0.005)
    launcher.launch(_bounce, n, [uploaded.data, origin, self_hits, escapes])
    assert self_hits.numpy().sum() == 0
    assert escapes.numpy().sum() == 0


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(triangles=np.array([[0, 1, 8]], np.int32), material=np.zeros(1, np.int32)), "refer to points outside"),
        (dict(triangles=np.array([[0, 1, -1]], np.int32), material=np.zeros(1, np.int32)), "refer to points outside"),
        (dict(triangles=np.zeros((2, 4), np.int32)), "shape"),
        (dict(points=np.full((8, 3), np.nan)), "finite"),
        (dict(points=np.full((8, 3), np.inf)), "finite"),
        (dict(material=np.full(12, 5, np.int32)), "materials outside"),
        (dict(material=np.zeros(3, np.int32)), "one index per triangle"),
        (dict(normals=np.zeros((1, 3, 3), np.float32)), "normals must have shape"),
        (dict(colors=np.full((12, 3, 3), 2.0, np.float32)), "colors must lie"),
    ],
)
def test_bad_meshes_never_reach_warp(launcher, change, message):
    """What would crash Warp, or read memory that is not there, is an error that names the mesh."""
    import dataclasses

    bad = dataclasses.replace(mesh("/World/bad", *cube()), **change)
    with pytest.raises(ir.InputError, match=f"/World/bad: .*{message}"):
        upload_scene(ir.Scene(meshes=(bad,)), launcher)


def _brightness(radiance=1.0, texture=1.0, emission=1.0, image=1.0, exposure=1.0):
    """A square with a lamp, a texture on each."""
    pixels = np.full((1, 1, 3), image, np.float32)
    glowing = ir.Material("/Glow", emission=(emission,) * 3)
    shining = ir.Material("/Shine", emission_texture=ir.Texture("a.exr", pixels))
    lamp = ir.Light("/Lamp", ir.LightKind.RECT, (radiance,) * 3, texture=np.full((1, 1, 3), texture, np.float32))
    square = mesh("m", [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2], [0, 1, 2]])
    square = replace(square, material=np.array([0, 1], np.int32))
    return ir.Scene(
        meshes=(square,), materials=(glowing, shining), lights=(lamp,), camera=ir.Camera("/Eye", exposure=exposure)
    )


@pytest.mark.parametrize(
    ("name", "bright"),
    [
        ("/Lamp", dict(radiance=1e30)),
        ("/Lamp", dict(radiance=1e39)),
        ("/Lamp", dict(radiance=1e300)),
        ("/Lamp", dict(radiance=math.inf)),
        ("/Lamp", dict(radiance=1e20, texture=1e12)),
        ("/Glow", dict(emission=1e39)),
        ("/Shine", dict(image=1e35)),
        ("/Eye", dict(exposure=1e20, radiance=1e20)),
    ],
)
def test_radiance_beyond_float32_is_refused(launcher, name, bright):
    """It would be infinite on the device, where samples that are not finite are replaced by black."""
    with pytest.raises(ir.InputError, match=f"{name}.*(less than|in \\[0,|exceeds) ?1e\\+3"):
        upload_scene(_brightness(**bright), launcher)


@pytest.mark.parametrize("bright", [dict(radiance=9e29), dict(emission=9e29), dict(image=9e29), dict(exposure=9e37)])
def test_radiance_of_any_other_size_is_accepted(launcher, bright):
    assert upload_scene(_brightness(**bright), launcher).emits


@pytest.mark.parametrize("triangles", [np.zeros((0, 3)), [[0, 0, 0]], [[0, 1, 1]]])
def test_empty_and_degenerate_meshes_render(triangles):
    """A scene without a single proper triangle is a black picture, not a crash."""
    scene = ir.Scene(meshes=(mesh("m", [[0, 0, 0], [1, 0, 0]], triangles),), lights=(ir.Light("d", 6, (1, 1, 1)),))
    for estimator in ("keller", "path"):
        film = ir.render(scene, ir.RenderSettings(width=4, height=4, iterations=1, estimator=estimator))
        assert film.radiance().max() == 0.0


def test_a_picture_too_large_for_the_memory_is_refused(monkeypatch):
    """Before anything is allocated, with the size it would need and the size there is."""
    from warp_ir.device.launcher import Launcher

    monkeypatch.setattr(Launcher, "memory", lambda self: 2.0**30)
    with pytest.raises(ir.InputError, match=r"4000 x 4000 pixels need about 4.5 GiB, cpu has 1.0 GiB"):
        ir.render(ir.Scene(), ir.RenderSettings(width=4000, height=4000))
