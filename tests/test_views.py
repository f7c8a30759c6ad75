"""Views of a live scene: conventions of images, and worlds that do not know of each other."""

import numpy as np
import pytest
import warp as wp

import warp_ir as ir
from tests.live import NAMES, array, look_at, rays, shift, shots
from warp_ir.procedural import cube, mesh, quad, sphere
from warp_ir.scene import InputError, LightKind
from warp_ir.simulation import history, images
from warp_ir.simulation.transport import ViewRays

pytestmark = pytest.mark.extended

ALL = ("color", "hdr_color", "albedo", "depth", "forward_depth", "normal", "shape_index", "error")
SKY = ir.Light("sky", LightKind.DOME, (1.0, 1.0, 1.0))
PLAIN = ir.ViewSettings(filter=False, light_paths=64)
EYE = look_at((0.0, 1.5, 4.0))


def boxes(count=2, emission=0.0, lights=(SKY,), **options):
    """One box for each world, all in one place, on a ground in all worlds; the box of world 1 may be a lamp."""
    points, triangles = cube(1.0)
    materials = (ir.Material("grey", (0.5,) * 3), ir.Material("lamp", (0.2,) * 3, (emission,) * 3))
    ground = quad("ground", [(-4, -0.5, 4), (4, -0.5, 4), (4, -0.5, -4), (-4, -0.5, -4)])
    own = [mesh(f"box {k}", points, triangles, int(emission > 0.0 and k == 1)) for k in range(count)]
    scene = ir.Scene((ground, *own), materials, tuple(lights))
    return ir.LiveScene(scene, worlds=np.array([-1, *range(count)]), world_count=count, **options)


@pytest.fixture(scope="module")
def pair():
    scene = boxes()
    return scene, ir.Views(scene, PLAIN)


def test_worlds_at_one_place_are_furnaces_of_their_own():
    """Closed boxes that emit Le and reflect ρ have L = Le / (1 - ρ), each its own, in one call.

    The mean over 8 x 8 pixels of 64 iterations is compared within five standard errors.
    """
    albedo = (0.2, 0.5, 0.8)
    points, triangles = cube(2.0, inward=True)
    materials = tuple(ir.Material(str(a), (a,) * 3, (1.0,) * 3) for a in albedo)
    scene = ir.Scene(tuple(mesh(str(k), points, triangles, k) for k in range(3)), materials)
    live = ir.LiveScene(scene, worlds=np.arange(3), world_count=3)
    settings = ir.ViewSettings(iterations=64, light_paths=64, filter=False)
    out = shots(ir.Views(live, settings), [shift(0.1, 0.2, 0.3)] * 3, rays(8), names=("hdr_color", "error"))
    for k in range(3):
        mean = out["hdr_color"][k].mean()
        error = np.sqrt((out["error"][k] ** 2).mean())  # pixels share light paths: no smaller than that of a pixel
        assert abs(mean - 1.0 / (1.0 - albedo[k])) < 5.0 * error / 4.0 + 1.0e-4
        assert error < 0.1 / (1.0 - albedo[k])


def test_a_world_is_the_same_whatever_is_in_the_others(pair):
    """No bit of world 0 depends on what world 1 has: nothing, a red box, a lamp, NaN, a body far away."""
    expected = shots(pair[1], [EYE], rays(), [0], ALL, step=3)
    red = boxes(emission=0.0)
    red.set_transforms(array([shift(0.4, 0.1, 0.2)], wp.transformf), array([2], wp.int32))
    lamp = boxes(emission=5.0)
    nan, far = boxes(), boxes()
    nan.set_transforms(array([np.full(7, np.nan)], wp.transformf), array([2], wp.int32))
    far.set_transforms(array([shift(1.0e9)], wp.transformf), array([2], wp.int32))
    for other in (boxes(1), red, lamp, nan, far):
        other.refit()
        found = shots(ir.Views(other, PLAIN), [EYE], rays(), [0], ALL, step=3)
        for name in ALL:
            assert found[name].tobytes() == expected[name].tobytes(), name
    both = shots(ir.Views(lamp, PLAIN), [EYE] * 2, rays(), [0, 1], step=3)["hdr_color"]
    assert both[1].mean() > 2.0 * both[0].mean()  # the lamp does light its own


def test_what_all_worlds_share_lights_all_of_them():
    """A lamp of no world lights every world alike."""
    points, triangles = cube(1.0)
    materials = (ir.Material("grey", (0.5,) * 3), ir.Material("lamp", (0.0,) * 3, (9.0,) * 3))
    lamp = quad("lamp", [(-1, 2, -1), (1, 2, -1), (1, 2, 1), (-1, 2, 1)], 1)
    scene = ir.Scene((lamp, *(mesh(str(k), points, triangles) for k in range(2))), materials)
    live = ir.LiveScene(scene, worlds=np.array([-1, 0, 1]), world_count=2)
    settings = ir.ViewSettings(iterations=16, light_paths=64, filter=False)
    out = shots(ir.Views(live, settings), [EYE] * 2, rays())["hdr_color"].mean(axis=(1, 2, 3))
    assert out.min() > 0.01 and abs(out[0] / out[1] - 1.0) < 0.1


def test_views_permute_with_their_worlds(pair):
    """Views in another order are the same views; two of one world are one; batches change nothing."""
    scene, views = pair
    poses = [EYE, look_at((3.0, 1.0, 2.0)), EYE, EYE]
    out = shots(views, poses, rays(), [0, 1, 1, 0], ALL, step=5)
    turned = shots(views, poses[::-1], rays(), [0, 1, 1, 0], ALL, step=5)
    batched = shots(ir.Views(scene, PLAIN, bytes=1), poses, rays(), [0, 1, 1, 0], ALL, step=5)
    for name in ALL:
        assert (out[name] == turned[name][::-1]).all() and (out[name] == batched[name]).all(), name
        assert (out[name][0] == out[name][3]).all(), name


def test_worlds_that_are_none_keep_or_clear(pair):
    """-101 keeps the pixels of a view, every other number without a world clears them."""
    clear = ir.ClearValues(color=0x11223344, albedo=0x55667788, depth=-2.0, normal=(0.0, 0.0, 1.0), shape_index=7)
    into = {name: wp.full((5, 4, 4), 3, dtype=NAMES[name], device="cpu") for name in ALL}
    out = shots(pair[1], [EYE] * 5, rays(4), [-101, -102, -1, 2, 0], into=into, clear=clear, settings=PLAIN)
    cleared = {"color": 0x11223344, "albedo": 0x55667788, "depth": -2.0, "forward_depth": -2.0, "shape_index": 7}
    cleared |= {"normal": (0.0, 0.0, 1.0), "hdr_color": 0.0, "error": 0.0}
    for name in ALL:
        assert (out[name][0] == 3).all(), name
        assert all((out[name][k] == np.array(cleared[name], out[name].dtype)).all() for k in (1, 2, 3)), name
    assert out["hdr_color"][4].max() > 0.0
    with pytest.raises(InputError, match="worlds"):
        shots(pair[1], [EYE] * 3, rays(4))


def test_rays_without_direction_hit_nothing(pair):
    """A direction of length 0 clears its pixel; one twice as long halves the depth and not the forward depth."""
    bundle = rays(8)
    bundle[0, 0, 0, 1] = 0.0
    once = shots(pair[1], [EYE], bundle, [0], ("depth", "forward_depth", "shape_index"))
    bundle[..., 1, :] *= 2.0
    twice = shots(pair[1], [EYE], bundle, [0], ("depth", "forward_depth", "shape_index"))
    assert once["shape_index"][0, 0, 0] == 0xFFFFFFFF and once["depth"][0, 0, 0] == 0.0
    hit = once["depth"] > 0.0
    assert hit.sum() > 30
    np.testing.assert_allclose(twice["depth"][hit], 0.5 * once["depth"][hit], rtol=1.0e-5)
    np.testing.assert_allclose(twice["forward_depth"], once["forward_depth"], rtol=1.0e-5)


def test_depths_and_normals_of_a_box(pair):
    """The front of the box is at z = 0.5: forward depth 4 - 0.5 for a camera that looks along -Z at height 0."""
    out = shots(pair[1], [shift(0.0, 0.0, 4.0)], rays(9), [0], ("depth", "forward_depth", "normal", "shape_index"))
    assert abs(out["forward_depth"][0, 4, 4] - 3.5) < 1.0e-5
    assert abs(out["depth"][0, 4, 4] - 3.5) < 1.0e-5
    np.testing.assert_allclose(out["normal"][0, 4, 4], (0.0, 0.0, 1.0), atol=1.0e-6)
    assert out["shape_index"][0, 4, 4] == 1


@wp.kernel(enable_backward=False)
def _pack(values: wp.array[wp.vec3], linear: int, out: wp.array[wp.uint32]):
    out[wp.tid()] = images.pack(values[wp.tid()], 1.0, linear)


def test_packed_colours_are_cut_off():
    """Bytes are cut off and not rounded; below 0 and what is not a number is 0, above 1 is the largest.

    That is 255, but in sRGB 254: float32's 1.055 - 0.055 is an ulp below 1, in Newton as well.
    """
    values = array([(-1.0, 0.0, 0.999), (2.0, np.nan, 1.0), (np.inf, 0.5, 254.999 / 255.0)], wp.vec3)
    for linear, half, most in ((1, 127, 255), (0, 187, 254)):
        out = wp.zeros(3, dtype=wp.uint32, device="cpu")
        wp.launch(_pack, dim=3, inputs=[values, linear, out], device="cpu")
        r, g, b, a = ((out.numpy() >> s) & 255 for s in (0, 8, 16, 24))
        assert (a == 255).all() and r.tolist() == [0, 255, 255] and g.tolist() == [0, 0, half]
        assert b.tolist() == [254, most, 254]


def test_samples_mix_with_what_is_clear():
    """A pixel half covered by a white box mixes colour and alpha with the clear ones in linear light."""
    points, triangles = cube(1.0)
    scene = ir.Scene((mesh("box", points, triangles),), (ir.Material("white", (1.0,) * 3),), (SKY,))
    views = ir.Views(ir.LiveScene(scene), PLAIN)
    bundle = rays(1, samples=4, window=(-0.2, 0.2, -0.1, 0.1))
    bundle[..., 1, 0] += np.where(bundle[..., 1, 0] > 0.0, 9.0, 0.0)  # two of four miss
    clear = ir.ClearValues(color=0xFF000000, albedo=0x00000000)
    out = shots(views, [shift(0.0, 0.0, 3.0)], bundle, names=("color", "albedo", "hdr_color", "depth"), clear=clear)
    assert out["albedo"][0, 0, 0] >> 24 == 127 and out["albedo"][0, 0, 0] & 255 == 187  # sRGB of 1/2
    assert out["color"][0, 0, 0] >> 24 == 255
    assert abs(out["depth"][0, 0, 0] - 2.5) < 1.0e-4
    one = shots(views, [shift(0.0, 0.0, 3.0)], bundle[:, :, :1], names=("hdr_color",))["hdr_color"]
    assert 0.3 < out["hdr_color"].mean() / one.mean() < 0.7


def test_the_mean_is_that_of_path_tracing():
    """Pictures agree with the independent estimator, within their standard errors."""
    scene = ir.Scene(
        (
            quad("ground", [(-3, 0, 3), (3, 0, 3), (3, 0, -3), (-3, 0, -3)]),
            mesh("ball", sphere(0.7, level=3)[0] + np.array([0.0, 0.8, 0.0]), sphere(0.7, level=3)[1], 1),
        ),
        (ir.Material("grey", (0.6,) * 3), ir.Material("red", (0.8, 0.2, 0.1))),
        (
            SKY,
            ir.Light(
                "lamp", LightKind.SPHERE, (8.0,) * 3, np.diag([1.0, 1.0, 1.0, 1.0]) + _moved(1.5, 2.5, 1.0), radius=0.3
            ),
        ),
        ir.Camera.look_at((0.0, 2.0, 4.0), (0.0, 0.5, 0.0)),
    )
    settings = ir.RenderSettings(width=24, estimator="path", iterations=256)
    expected = ir.render(scene, settings)
    live = ir.LiveScene(scene)
    bundle = rays(24, samples=16, window=scene.camera.window)
    views = ir.Views(live, ir.ViewSettings(iterations=128, filter=False))
    out = shots(views, [look_at((0.0, 2.0, 4.0), (0.0, 0.5, 0.0))], bundle, names=("hdr_color", "error"))
    mean, error = expected.radiance().mean(axis=2), expected.standard_error().mean(axis=2)
    interior = np.abs(np.diff(mean, axis=0, prepend=mean[:1])) + np.abs(np.diff(mean, axis=1, prepend=mean[:, :1]))
    smooth = interior < 0.1 * mean.mean()
    z = (out["hdr_color"][0].mean(axis=2) - mean) / np.hypot(error, out["error"][0] + 1.0e-3)
    assert smooth.sum() > 200 and np.sqrt((z[smooth] ** 2).mean()) < 1.6 and abs(z[smooth].mean()) < 0.5


def _moved(x, y, z):
    out = np.zeros((4, 4))
    out[:3, 3] = x, y, z
    return out


def test_static_pictures_go_on_until_something_moves():
    """While nothing moves the mean of all steps is shown; a body that moves begins its world anew, and no other."""
    scene = boxes(2)
    settings = ir.ViewSettings(filter=False, light_paths=64, accumulate="static")
    views, apart = ir.Views(scene, settings), ir.Views(scene, PLAIN)
    poses, bundle = [EYE] * 2, rays()
    steps = [shots(apart, poses, bundle, step=k)["hdr_color"] for k in range(4)]
    into = {"hdr_color": wp.zeros((2, 16, 16), dtype=wp.vec3, device="cpu")}
    for k in range(3):
        out = shots(views, poses, bundle, into=into, step=k)["hdr_color"]
        scene.refit()
    np.testing.assert_allclose(out, np.mean(steps[:3], axis=0), rtol=1.0e-5, atol=1.0e-6)
    scene.set_transforms(array([shift(0.3)], wp.transformf), array([2], wp.int32))
    scene.refit()
    out = shots(views, poses, bundle, into=into, step=3)["hdr_color"]
    np.testing.assert_allclose(out[0], np.mean([s[0] for s in steps], axis=0), rtol=1.0e-5, atol=1.0e-6)
    assert (out[1] == shots(apart, poses, bundle, step=3)["hdr_color"][1]).all()
    bundle[..., 1, 0] += 1.0e-3
    out = shots(views, poses, bundle, into=into, step=0)["hdr_color"]
    assert (out == shots(apart, poses, bundle, step=0)["hdr_color"]).all()


def test_temporal_pictures_are_static_ones_while_nothing_moves():
    """Nothing is late where nothing has changed: the mean of all steps, without a limit."""
    scene = boxes(2)
    names, pictures = ("hdr_color", "error"), []
    for accumulate in ("static", "temporal"):
        settings = ir.ViewSettings(filter=False, light_paths=64, accumulate=accumulate, max_history=2)
        views = ir.Views(scene, settings)
        for k in range(5):
            out = shots(views, [EYE] * 2, rays(), names=names, step=k)
        pictures.append(out)
    for name in names:
        np.testing.assert_allclose(pictures[1][name], pictures[0][name], rtol=1.0e-3, atol=1.0e-4)


def test_light_follows_surfaces_that_move():
    """In a furnace that tumbles around a camera light is the same everywhere and always, so the past is right.

    A mean with weights (8/9)^k has 1/17 of the variance of a step; half of the deviation is asked for. The mean is
    compared within five standard errors of what 24 steps show.
    """
    points, triangles = cube(2.0, inward=True)
    scene = ir.Scene((mesh("box", points, triangles),), (ir.Material("grey", (0.5,) * 3, (1.0,) * 3),))
    deviation, means = {}, []
    for accumulate in ("off", "temporal"):
        live = ir.LiveScene(scene)
        views = ir.Views(live, ir.ViewSettings(light_paths=64, filter=False, accumulate=accumulate))
        squares = []
        for k in range(24):
            turn = np.array([0.1 * np.sin(0.3 * k), 0.0, 0.0, np.sin(0.02 * k), 0.0, 0.0, np.cos(0.02 * k)])
            live.set_transforms(array([turn], wp.transformf))
            live.refit()
            out = shots(views, [shift(0.1, 0.02 * k, 0.3)], rays(16))["hdr_color"]
            if k >= 12:
                squares.append(np.mean((out - 2.0) ** 2))
            if accumulate == "off":
                means.append(out.mean())
        deviation[accumulate] = np.sqrt(np.mean(squares))
    assert abs(out.mean() - 2.0) < 5.0 * np.std(means) + 1.0e-3
    assert deviation["temporal"] < 0.5 * deviation["off"]


def test_what_comes_into_view_has_no_past():
    """A pixel that shows another body than before, or another world, shows this step alone."""
    scene = boxes(2)
    settings = ir.ViewSettings(filter=False, light_paths=64, accumulate="temporal")
    views, apart = ir.Views(scene, settings), ir.Views(scene, PLAIN)
    shots(views, [EYE] * 2, rays(), step=0)
    swapped = shots(views, [EYE] * 2, rays(), [1, 0], ("hdr_color",), step=1)["hdr_color"]
    assert (swapped == shots(apart, [EYE] * 2, rays(), [1, 0], step=1)["hdr_color"]).all()
    names = ("hdr_color", "shape_index")
    hidden = shots(views, [EYE], rays(), [0], names, step=2)["shape_index"] == 1
    for axis in (1, 2):  # and so do the neighbours
        hidden &= np.roll(hidden, 1, axis) & np.roll(hidden, -1, axis)
    scene.set_transforms(array([shift(1.0e9)], wp.transformf), array([1], wp.int32))
    scene.refit()
    shown = shots(views, [EYE], rays(), [0], names, step=3)
    expected = shots(apart, [EYE], rays(), [0], names, step=3)
    same = (shown["hdr_color"] == expected["hdr_color"]).all(axis=3)
    ground = shown["shape_index"] == 0
    assert (hidden & ground).sum() > 4 and same[hidden & ground].all()
    assert not same[~hidden & ground].all()


@wp.kernel(enable_backward=False)
def _find_pixels(views: ViewRays, points: wp.array[wp.vec3], starts: wp.array[wp.vec2i], out: wp.array[wp.vec3]):
    out[wp.tid()] = history.pixel_that_sees(views, 0, starts[wp.tid()], points[wp.tid()])


@pytest.mark.parametrize("kind", ["pinhole", "normalized", "fisheye", "parallel"])
def test_the_pixel_of_a_point_is_found(kind):
    """A point between two pixels' rays is found there, from pixels around.

    Where directions are not linear it is found within half the angle of a pixel, 0.04.
    """
    bundle = rays(32, window=(-0.6, 0.6, -0.6, 0.6))
    x, y = bundle[:, :, 0, 1, 0].copy(), bundle[:, :, 0, 1, 1].copy()
    if kind == "normalized":
        bundle[:, :, 0, 1] /= np.linalg.norm(bundle[:, :, 0, 1], axis=2, keepdims=True)
    if kind == "fisheye":  # angle in proportion to the distance from the centre
        angle = 1.5 * np.hypot(x, y)
        sine = np.sin(angle) / np.hypot(x, y)
        bundle[:, :, 0, 1] = np.stack([x * sine, y * sine, -np.cos(angle)], axis=2)
    if kind == "parallel":
        bundle[:, :, 0, 0, 0], bundle[:, :, 0, 0, 1] = x, y
        bundle[:, :, 0, 1] = 0.0, 0.0, -1.0
    views = ViewRays()
    views.rays, views.rows, views.columns = array(bundle, wp.vec3), 32, 32
    middle = 0.5 * (bundle[4:28, 4:28, 0] + bundle[4:28, 5:29, 0])
    points = (middle[..., 0, :] + 3.0 * middle[..., 1, :]).reshape(-1, 3)
    out = wp.zeros(len(points), dtype=wp.vec3, device="cpu")
    row, column = np.mgrid[4:28, 4:28]
    starts = array(np.stack([column - 3, row + 4], axis=2).reshape(-1, 2), wp.vec2i)
    wp.launch(_find_pixels, len(points), inputs=[views, array(points, wp.vec3), starts, out], device="cpu")
    found = out.numpy().reshape(24, 24, 3)
    assert (found[..., 2] == 1.0).all()
    assert np.abs(found[..., 0] - column - 0.5).max() < 0.02 and np.abs(found[..., 1] - row).max() < 0.02


@pytest.mark.parametrize("accumulate", ["off", "temporal"])
def test_a_step_reads_nothing_back(monkeypatch, accumulate):
    """After the first call a step copies nothing to the host, makes no array, and waits for nothing."""
    scene = boxes(2)
    views = ir.Views(scene, ir.ViewSettings(light_paths=64, accumulate=accumulate))
    poses, bundle = array([EYE] * 2, wp.transformf), array(rays(), wp.vec3)
    out = wp.zeros((2, 16, 16), dtype=wp.vec3, device="cpu")
    moved = array([shift(), shift(0.1), shift(0.2)], wp.transformf)

    def step():
        scene.set_transforms(moved)
        scene.refit()
        views.render(poses, bundle, hdr_color=out)

    for _ in range(3):
        step()

    def fail(*_, **__):
        raise AssertionError("a step must not do this")

    for name in ("empty", "zeros", "synchronize", "synchronize_device"):
        monkeypatch.setattr(wp, name, fail)
    for name in ("__init__", "numpy"):
        monkeypatch.setattr(wp.array, name, fail)
    step()


@pytest.mark.parametrize("accumulate", ["off", "temporal"])
def test_a_captured_step_has_the_same_bits(accumulate):
    """A captured step replays what was launched; the number of the step counts on the device."""
    poses, bundle = array([EYE] * 2, wp.transformf), array(rays(), wp.vec3)
    out = wp.zeros((2, 16, 16), dtype=wp.vec3, device="cpu")
    moved = array([shift(), shift(0.1), shift(0.2)], wp.transformf)

    def begin():
        scene = boxes(2)
        views = ir.Views(scene, ir.ViewSettings(light_paths=64, accumulate=accumulate))

        def step():
            scene.set_transforms(moved)
            scene.refit()
            views.render(poses, bundle, hdr_color=out)

        return step

    def move(k):
        moved.assign(array([shift(), shift(0.1 + 0.01 * k), shift(0.2)], wp.transformf))

    expected, step = [], begin()
    for k in range(6):
        move(k)
        step()
        expected.append(out.numpy().copy())
    step = begin()
    for k in range(4):
        move(k)
        step()
    with wp.ScopedCapture(device="cpu") as capture:
        step()  # it is recorded, and not done
    for k in (4, 5):
        move(k)
        wp.capture_launch(capture.graph)
        assert (out.numpy() == expected[k]).all()


def test_settings_are_checked():
    """A bad value is refused with the name of its field."""
    for bad in (
        {"iterations": 0},
        {"light_paths": 1.5},
        {"accumulate": "on"},
        {"max_bounces": -1},
        {"max_distance": 0.0},
    ):
        with pytest.raises(InputError, match=next(iter(bad))):
            ir.ViewSettings(**bad)


def test_arrays_of_another_shape_are_refused(pair):
    """An output of another shape, type or order is refused with its name."""
    transforms, bundle = array([EYE], wp.transformf), array(rays(4), wp.vec3)
    for name, bad in (("color", wp.zeros((1, 4, 5), dtype=wp.uint32)), ("depth", wp.zeros((1, 4, 4), dtype=wp.uint32))):
        with pytest.raises(InputError, match=name):
            pair[1].render(transforms, bundle, array([0], wp.int32), **{name: bad})


def test_images_are_shared_without_a_copy(pair):
    """An output may be memory of another library, by DLPack."""
    theirs = np.zeros((1, 4, 4), np.float32)
    ours = wp.from_dlpack(theirs)
    shots(pair[1], [EYE], rays(4), [0], into={"depth": ours})
    assert theirs.max() > 1.0 and (ours.numpy() == theirs).all()


def test_tensors_of_torch_are_poses_and_images(pair):
    """Poses come from a tensor and images go into one, or one is made of an image: all without a copy."""
    torch = pytest.importorskip("torch")
    poses = torch.tensor(np.array([EYE]), dtype=torch.float32)
    tensor = torch.zeros((1, 4, 4, 3))
    image = wp.from_torch(tensor, dtype=wp.vec3)
    depth = wp.zeros((1, 4, 4), dtype=wp.float32, device="cpu")
    of_depth = torch.from_dlpack(depth)
    bundle, worlds = array(rays(4), wp.vec3), array([0], wp.int32)
    for distance in (4.0, 6.0):
        poses[0, 2] = distance
        pair[1].render(wp.from_torch(poses, dtype=wp.transformf), bundle, worlds, hdr_color=image, depth=depth, step=0)
        expected = shots(pair[1], poses.numpy(), rays(4), [0], ("hdr_color", "depth"), step=0)
        assert (tensor.numpy() == expected["hdr_color"]).all() and tensor.max() > 0.0
        assert (of_depth.numpy() == expected["depth"]).all()


def test_arrays_of_jax_are_poses_and_images_become_arrays(pair):
    """Poses come from an array of JAX, and an image is one, both by DLPack without a copy."""
    jax = pytest.importorskip("jax")
    poses = wp.from_jax(jax.numpy.asarray(np.array([EYE]), dtype=np.float32), dtype=wp.transformf)
    depth = wp.zeros((1, 4, 4), dtype=wp.float32, device="cpu")
    pair[1].render(poses, array(rays(4), wp.vec3), array([0], wp.int32), depth=depth, step=0)
    expected = shots(pair[1], [EYE], rays(4), [0], ("depth",), step=0)
    assert (np.asarray(wp.to_jax(depth)) == expected["depth"]).all()
