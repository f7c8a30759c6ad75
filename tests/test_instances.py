"""Instances look, reflect and occlude like the flattened scene, in which every copy is stored."""

import dataclasses

import numpy as np
import pytest
import warp as wp

import warp_ir as ir
from tests.physics.closed_form import assert_mean, render
from warp_ir.device_scene import SceneData, upload_scene
from warp_ir.procedural import cube, mesh, quad, sphere
from warp_ir.sampling import sobol
from warp_ir.sampling.square_to import square_to_cone, square_to_cosine_hemisphere
from warp_ir.scene import Instances, Texture
from warp_ir.scene.instances import areas_of_copies, bounds_of_copies, transform_copies
from warp_ir.surface import albedo, closest, visible

wp.set_module_options({"enable_backward": False})


def rotations(count, random):
    """Random rotation matrices [count, 3, 3]."""
    matrices = np.linalg.qr(random.normal(size=(count, 3, 3)))[0]
    return matrices * np.sign(np.linalg.det(matrices))[:, None, None]


def scattered(count, *, uneven=True, seed=0):
    """Matrices [count, 4, 4] in a room of size 2: rotated, scaled, a third of them mirrored."""
    random = np.random.default_rng(seed)
    out = np.tile(np.eye(4), (count, 1, 1))
    scale = random.uniform(0.03, 0.1, (count, 1, 3 if uneven else 1))
    mirror = np.where(random.random((count, 1, 1)) < 0.3, -1.0, 1.0)
    out[:, :3, :3] = rotations(count, random) * scale * mirror
    out[:, :3, 3] = random.uniform(-0.85, 0.85, (count, 3))
    return out


def crowd(count=80):
    """A lit room with instances of two meshes, one smooth and coloured by its instances, one faceted and green."""
    points, triangles = sphere(level=2)
    ball = mesh("ball", points * 0.7, triangles, 1)
    bare = np.ones(len(triangles), bool)
    ball = dataclasses.replace(ball, normals=points[triangles].astype(np.float32), bare=bare)
    points, triangles = cube(1.0)
    box = mesh("box", points + np.array([0.0, 0.8, 0.0]), triangles, 2)
    lamp = quad("lamp", [[-0.3, 0.99, -0.3], [0.3, 0.99, -0.3], [0.3, 0.99, 0.3], [-0.3, 0.99, 0.3]], 3)
    colors = np.random.default_rng(1).random((count, 3)).astype(np.float32)
    return ir.Scene(
        meshes=(ball, mesh("room", *cube(2.0)), box, lamp),
        materials=(
            ir.Material("room", (0.7,) * 3),
            ir.Material("ball", (0.5,) * 3),
            ir.Material("box", (0.2, 0.7, 0.2)),
            ir.Material("lamp", (0.5,) * 3, (10.0,) * 3),
        ),
        camera=ir.Camera.look_at((0, 0, 0.95), (0, 0, -1), fov=80),
        instances=(Instances("/proto", (0, 2), scattered(count), colors),),
    )


def test_measures_are_those_of_the_flattened_scene():
    """Bounds, area and mean albedo are those of the flattened scene, to rounding."""
    scene = crowd()
    flat = scene.flat()
    assert flat.instances == () and flat.triangle_count == scene.triangles_seen
    np.testing.assert_allclose(scene.bounds(), flat.bounds(), rtol=1e-12)
    assert scene.area() == pytest.approx(flat.area(), rel=1e-12)
    # Instances scaled unevenly change the shares of a mesh's triangles; the mean takes those of the prototype.
    assert scene.mean_albedo() == pytest.approx(flat.mean_albedo(), rel=1e-6)


def test_colors_of_corners_stay_with_their_corners():
    """Corner colours follow their corners in mirrored copies too, whose winding is reversed."""
    points, triangles = sphere(level=1)
    colors = (0.5 + 0.4 * points)[triangles].astype(np.float32)
    ball = dataclasses.replace(mesh("ball", points, triangles), colors=colors)
    matrices = scattered(9)
    flat = ir.Scene((ball,), instances=(Instances("ball", (0,), matrices),)).flat().meshes[0]
    corners = flat.points[flat.triangles].reshape(9, -1, 3)
    local = (corners - matrices[:, None, :3, 3]) @ np.linalg.inv(matrices[:, :3, :3]).transpose(0, 2, 1)
    np.testing.assert_allclose(flat.colors.reshape(9, -1, 3), 0.5 + 0.4 * local, atol=1e-6)


@pytest.mark.parametrize("uneven", [False, True])
def test_bounds_and_areas_of_many_copies(uneven):
    """The search for the outermost copies returns the box around all of their points."""
    points, triangles = sphere(level=2)
    matrices = scattered(700, uneven=uneven, seed=3)
    matrices[5, :3, 3] = 3.0
    placed, wound, _ = transform_copies(points, triangles, None, matrices)
    lower, upper = bounds_of_copies(points, matrices)
    np.testing.assert_allclose([lower, upper], [placed.min(axis=0), placed.max(axis=0)], rtol=1e-12)
    a, b, c = (placed[wound[:, k]] for k in range(3))
    exact = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).reshape(700, -1).sum(axis=1)
    np.testing.assert_allclose(areas_of_copies(points, triangles, matrices), exact, rtol=1e-12)


@pytest.mark.extended
def test_a_picture_of_instances_is_that_of_copies(device):
    """Mesh ids, albedo, depth and normals are the same, except for single rays at edges, by rounding."""
    settings = ir.RenderSettings(width=96, height=96, iterations=2, estimator="path")
    one, other = (ir.render(scene, settings, device=device) for scene in (crowd(), crowd().flat()))
    same = one.aov("prim_id") == other.aov("prim_id")
    assert same.mean() > 0.999 and set(np.unique(one.aov("prim_id"))) == {0, 1, 2, 3}
    for name, tolerance in (("albedo", 1e-6), ("depth", 1e-5), ("normal", 1e-3)):
        close = np.abs(one.aov(name) - other.aov(name)).reshape(96, 96, -1).max(axis=2) <= tolerance
        assert close[same].mean() > 0.999, name


@pytest.mark.extended
@pytest.mark.parametrize("estimator", ["vpl", "path"])
def test_light_among_instances_is_that_among_copies(estimator, device):
    """The two pictures have the same mean within their standard errors."""
    one, other = (
        render(scene, estimator, device, width=16, height=16, iterations=24) for scene in (crowd(), crowd().flat())
    )
    assert_mean(one, float(other.radiance().mean()), bias=0.01)


def cut_outs():
    """Two textured balls with half of each cut out by opacity, one of them mirrored and squeezed, and a point light."""
    points, triangles = sphere(level=2)
    uvs = (0.5 + 0.5 * points[triangles][..., :2]).astype(np.float32)
    random = np.random.default_rng(4)
    pattern = Texture("pattern", random.random((16, 16, 3)).astype(np.float32))
    holes = Texture("holes", (random.random((8, 8, 1)) < 0.5).astype(np.float32))
    ball = dataclasses.replace(mesh("ball", points, triangles, 1), uvs={"st": uvs})
    places = np.tile(np.diag([0.4, 0.4, 0.4, 1.0]), (2, 1, 1))
    places[1] = np.diag([-0.3, 0.5, 0.4, 1.0])
    places[:, 0, 3] = (-0.5, 0.5)
    return ir.Scene(
        meshes=(mesh("room", *cube(2.0)), ball),
        materials=(
            ir.Material("room", (0.5,) * 3),
            ir.Material("ball", albedo_texture=pattern, opacity_texture=holes, cutoff=0.5),
        ),
        lights=(ir.Light("lamp", ir.LightKind.POINT, (1.0,) * 3, placed_at(0.0, 0.9, 0.6)),),
        camera=ir.Camera.look_at((0, 0, 0.95), (0, 0, -1), fov=80),
        instances=(Instances("ball", (1,), places),),
    )


def placed_at(*position):
    """A translation."""
    matrix = np.eye(4)
    matrix[:3, 3] = position
    return matrix


@wp.kernel
def _trace(
    first: int,
    scene: SceneData,
    albedos: wp.array[wp.vec3],
    measured: wp.array[wp.vec2],
    visibility: wp.array[wp.int32],
):
    """Traces a ray from near the lamp: filtered albedo, depth and area of the hit, its visibility from two points."""
    i = first + wp.tid()
    origin = wp.vec3(0.01, 0.1, 0.07)  # in the device's frame, in which the room's half size is 1/4
    d = square_to_cone(sobol.sample_2d(scene.sobol, i, 0, wp.uint32(1)), 2.0, wp.vec3(0.0, 0.0, 1.0))
    hit = closest(scene, origin, d, 3.0e38)
    albedos[i] = albedo(scene, hit, 0.005)
    measured[i] = wp.vec2(hit.t, hit.area)
    p = hit.position
    q = wp.vec3(-0.02, -0.07, 0.07)
    visibility[i] = wp.where(visible(scene, origin, wp.vec4(p[0], p[1], p[2], 1.0)), 2, 0)
    visibility[i] += wp.where(visible(scene, q, wp.vec4(p[0], p[1], p[2], 1.0)), 1, 0)


@pytest.mark.extended
def test_cut_outs_and_textures_of_instances_are_those_of_copies(launcher):
    """Camera and shadow rays pass the same holes and read the same texels, except for single rays at edges."""
    n, results = 20_000, []
    for scene in (cut_outs(), cut_outs().flat()):
        arrays = [launcher.zeros(n, dtype) for dtype in (wp.vec3, wp.vec2, wp.int32)]
        uploaded = upload_scene(scene, launcher)
        launcher.launch(_trace, n, [uploaded.data, *arrays])
        results.append([array.numpy() for array in arrays])
    (albedos, measured, visibility), (flat_albedos, flat_measured, flat_visibility) = results
    assert (np.isclose(albedos, flat_albedos, atol=1e-3).all(axis=1)).mean() > 0.999
    assert (np.isclose(measured, flat_measured, rtol=1e-3).all(axis=1)).mean() > 0.999
    assert (visibility == flat_visibility).mean() > 0.999 and (visibility >= 2).mean() > 0.999
    assert 0.1 < (visibility == 3).mean() < 0.9
    assert 0.1 < (albedos.std(axis=1) > 0.01).mean() < 0.9  # rays hit both the balls and the room


@pytest.mark.extended
@pytest.mark.parametrize("estimator", ["vpl", "path"])
def test_a_picture_of_cut_outs_in_instances_is_that_of_copies(estimator, device):
    """AOVs are the same, and so is the light that falls through the holes."""
    one, other = (
        render(scene, estimator, device, width=48, height=48, iterations=8) for scene in (cut_outs(), cut_outs().flat())
    )
    same = one.aov("prim_id") == other.aov("prim_id")
    assert same.mean() > 0.99 and set(np.unique(one.aov("prim_id"))) == {0, 1}
    for name, tolerance in (("albedo", 0.02), ("depth", 1e-3)):
        close = np.abs(one.aov(name) - other.aov(name)).reshape(48, 48, -1).max(axis=2) <= tolerance
        assert close[same].mean() > 0.99, name
    assert_mean(one, float(other.radiance().mean()), bias=0.01)


@pytest.mark.extended
@pytest.mark.parametrize("estimator", ["vpl", "path"])
def test_white_instances_vanish_in_white_light(estimator, device):
    """Surfaces of albedo 1 under a dome of radiance 1 have radiance 1, of any shape at any position (furnace)."""
    points, triangles = sphere(level=2)
    scene = ir.Scene(
        meshes=(mesh("ball", points, triangles),),
        materials=(ir.Material("white", (1.0,) * 3),),
        lights=(ir.Light("sky", ir.LightKind.DOME, (1.0,) * 3),),
        camera=ir.Camera.look_at((0, 0, 4), (0, 0, 0), fov=24),
        instances=(Instances("ball", (0,), scattered(200, seed=5) @ np.diag([2.5, 2.5, 2.5, 1.0])),),
    )
    film = render(scene, estimator, device, iterations=32)
    hit = film.aov("alpha") == 1.0
    assert hit.mean() > 0.3
    seen = film.radiance()[hit]
    error = film.standard_error()[hit].mean()
    assert abs(seen.mean() - 1.0) < 5.0 * error + 1e-3  # paths end by roulette at 0.999


@pytest.mark.extended
@pytest.mark.parametrize("estimator", ["vpl", "keller", "path"])
def test_a_furnace_of_instances(estimator, device):
    """A closed room of emissive tiles reaches Le / (1 - ρ): instances that emit are flattened."""
    scene = dataclasses.replace(tiled_box(3, np.eye(3)), materials=(ir.Material("wall", (0.5,) * 3, (1.0,) * 3),))
    assert_mean(render(scene, estimator, device), 2.0)


def tiled_box(count, turn):
    """A closed box of size 2, each wall of count x count instances of one square; half of them mirrored."""
    tile = quad("tile", [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], double_sided=True)
    grid = (np.arange(count) + 0.5) / count * 2.0 - 1.0
    places = []
    for axis in range(3):
        spin = np.roll(np.eye(3), axis, axis=0)
        for side in (-1.0, 1.0):
            for a in grid:
                for b in grid:
                    place = np.eye(4)
                    place[:3, :3] = turn @ spin @ np.diag([1.0 / count, side / count, 1.0])
                    place[:3, 3] = turn @ spin @ [a, b, side]
                    places.append(place)
    return ir.Scene(
        meshes=(tile,),
        materials=(ir.Material("wall", (0.5,) * 3),),
        camera=ir.Camera.look_at((0.3, 0.2, 0.5), (-0.2, 0.0, -1.0), fov=100.0),
        instances=(Instances("tile", (0,), np.array(places)),),
    )


@wp.kernel
def _reflect_around(first: int, scene: SceneData, escapes: wp.array[wp.int32], blocked: wp.array[wp.int32]):
    """Six reflections inside a closed room."""
    i = first + wp.tid()
    origin = wp.vec3(0.01, 0.02, 0.03)
    direction = square_to_cone(sobol.sample_2d(scene.sobol, i, 0, wp.uint32(1)), 2.0, wp.vec3(0.0, 0.0, 1.0))
    for bounce in range(6):
        hit = closest(scene, origin, direction, 3.0e38)
        if hit.triangle < 0:
            escapes[i] = 1
            return
        p = hit.position
        if not visible(scene, origin, wp.vec4(p[0], p[1], p[2], 1.0)):
            blocked[i] = 1
        if visible(scene, origin, wp.vec4(direction[0], direction[1], direction[2], 0.0)):
            escapes[i] = 1
        origin = p
        u = sobol.sample_2d(scene.sobol, i, 2 * bounce + 2, wp.uint32(1))
        direction = square_to_cosine_hemisphere(u, hit.normal)


@pytest.mark.extended
@pytest.mark.parametrize("scale, shift", [(1.0, 0.0), (1e-4, 10.0), (1e6, 1e11)])
@pytest.mark.parametrize("count", [1, 40])
@pytest.mark.parametrize("turned", [False, True])
def test_walls_of_instances_let_nothing_through(launcher, count, turned, scale, shift):
    """Edges between adjacent instances are watertight, and each hit is visible from its ray's origin, at any scale."""
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0] if turned else np.eye(3)
    scene = tiled_box(count, turn)
    matrices = scene.instances[0].matrices.copy()
    matrices[:, :3] *= scale
    matrices[:, :3, 3] += shift
    scene = dataclasses.replace(scene, instances=(dataclasses.replace(scene.instances[0], matrices=matrices),))
    uploaded = upload_scene(scene, launcher)
    n = 30_000
    escapes, blocked = launcher.zeros(n, wp.int32), launcher.zeros(n, wp.int32)
    launcher.launch(_reflect_around, n, [uploaded.data, escapes, blocked])
    assert escapes.numpy().sum() == 0
    assert blocked.numpy().sum() == 0


def test_a_small_instance_far_out_keeps_its_shape(launcher, device):
    """Its normals are exact although float32 world coordinates could not resolve it."""
    points, triangles = sphere(level=3)
    far = np.eye(4)
    far[:3, 3] = (1.0e5, 1.0e5, 1.0e5)
    scene = ir.Scene(
        meshes=(mesh("ball", points, triangles), mesh("there", *cube(2.0))),
        materials=(ir.Material(),),
        lights=(ir.Light("sky", ir.LightKind.DOME, (1.0,) * 3),),
        camera=ir.Camera.look_at(far[:3, 3] + [0, 0, 3], far[:3, 3], fov=30),
        instances=(Instances("ball", (0,), far[None]),),
    )
    settings = ir.RenderSettings(width=32, height=32, iterations=1, estimator="path")
    normal = ir.render(scene, settings, device=device).aov("normal").reshape(-1, 3)
    a, b, c = (points[triangles[:, k]] for k in range(3))
    exact = np.cross(b - a, c - a)
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    seen = normal[np.linalg.norm(normal, axis=1) > 0.5]
    assert len(seen) > 200
    # The cosine to the nearest of the facets' normals: facets differ by degrees, floats by 1e-6.
    assert (seen @ exact.T).max(axis=1).min() > 1.0 - 1e-6


def test_prototypes_of_one_geometry_share_it(launcher):
    """Two prototypes of the same arrays share one tree and one set of points, and have materials of their own."""
    points, triangles = sphere(level=2)
    red = mesh("red", points, triangles, 0)
    blue = dataclasses.replace(red, name="blue", material=np.full(len(triangles), 1, np.int32))
    left, right = np.tile(np.eye(4), (1, 1, 1)), np.tile(np.eye(4), (1, 1, 1))
    left[:, 0, 3], right[:, 0, 3] = -2.0, 2.0
    scene = ir.Scene(
        meshes=(red, blue),
        materials=(ir.Material("red", (1, 0, 0)), ir.Material("blue", (0, 0, 1))),
        lights=(ir.Light("sky", ir.LightKind.DOME, (1.0,) * 3),),
        camera=ir.Camera.look_at((0, 0, 9), (0, 0, 0), fov=45),
        instances=(Instances("l", (0,), left), Instances("r", (1,), right)),
    )
    data = upload_scene(scene, launcher).data
    assert data.points.shape[0] == len(points) and data.triangle_material.shape[0] == 2 * len(triangles)
    film = ir.render(scene, ir.RenderSettings(width=32, height=16, iterations=1, estimator="path"))
    assert film.aov("albedo")[8, 11].tolist() == [1, 0, 0] and film.aov("albedo")[8, 20].tolist() == [0, 0, 1]
    assert set(np.unique(film.aov("prim_id"))) == {-1, 0, 1}


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(meshes=(0, 9)), "meshes outside"),
        (dict(meshes=(0, 0)), "instanced twice"),
        (dict(matrices=np.zeros((0, 4, 4))), "must have shape"),
        (dict(matrices=np.eye(4)), "must have shape"),
        (dict(matrices=np.full((1, 4, 4), np.nan)), "finite"),
        (dict(matrices=np.ones((1, 4, 4))), "affine"),
        (dict(matrices=np.diag([1.0, 1.0, 0.0, 1.0])[None]), "singular"),
        (dict(colors=np.ones((3, 3), np.float32)), "one per instance"),
        (dict(colors=np.full((80, 3), 2.0, np.float32)), r"in \[0, 1\]"),
    ],
)
def test_bad_instances_never_reach_warp(launcher, change, message):
    """Invalid instances raise an error that names the prototype."""
    scene = crowd()
    change = dict(colors=None) | change
    bad = dataclasses.replace(scene, instances=(dataclasses.replace(scene.instances[0], **change),))
    with pytest.raises(ir.InputError, match=f"/proto: .*{message}"):
        upload_scene(bad, launcher)


def test_instances_that_do_not_fit_are_refused(launcher, monkeypatch):
    """A scene too large for the memory is rejected before anything is allocated, with its size in the message."""
    monkeypatch.setattr(type(launcher), "memory", lambda self: 1000.0)
    with pytest.raises(ir.InputError, match="80 instances need about"):
        upload_scene(crowd(), launcher)


@pytest.mark.slow
def test_rays_through_instances_take_less_than_twice_those_through_copies():
    """Compares whole renders: 400 instances of 2048 triangles against 819 200 triangles."""
    points, triangles = sphere(level=4)
    scene = dataclasses.replace(
        crowd(),
        instances=(Instances("ball", (0,), scattered(400, uneven=False) @ np.diag([1.4, 1.4, 1.4, 1.0])),),
    )
    scene = dataclasses.replace(scene, meshes=(mesh("ball", points, triangles, 1), *scene.meshes[1:]))
    settings = ir.RenderSettings(width=256, height=256, iterations=6, filter=False)
    best = [np.inf, np.inf]
    for _ in range(3):
        for k, chosen in enumerate((scene, scene.flat())):
            best[k] = min(best[k], ir.render(chosen, settings).seconds)
    assert best[0] < 2.0 * best[1], best
