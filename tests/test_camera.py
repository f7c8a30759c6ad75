"""What the camera does to the picture: policies, data windows, the lens."""

import math
from dataclasses import replace

import numpy as np
import pytest

import warp_ir as ir
from warp_ir.scene import CONFORM_POLICIES

FLOOR = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float64)
TWO = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)


def quad(name, corners, material=0):
    """Two triangles."""
    return ir.Mesh(name, np.array(corners, dtype=np.float64), TWO, np.full(2, material, np.int32))


def glowing(corners, camera, **more):
    """A quad of radiance 1 before nothing."""
    glow = ir.Material("glow", albedo=(0.0, 0.0, 0.0), emission=(1.0, 1.0, 1.0))
    return ir.Scene((quad("quad", corners),), (glow,), camera=camera, **more)


def render(scene, **settings):
    return ir.render(scene, ir.RenderSettings(**{"light_paths": 16, "filter": False, **settings}))


# ---- the window ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", CONFORM_POLICIES)
@pytest.mark.parametrize("size", [(40, 20, 1.0), (20, 40, 1.0), (30, 30, 2.0), (30, 30, 0.5)])
def test_conform_policies(policy, size):
    """UsdRender: with image aspect a and aperture aspect c, each policy sets one side from the other."""
    width, height, pixel_aspect = size
    camera = ir.Camera(window=(-0.2, 1.0, -0.3, 0.5))
    w, h = 1.2, 0.8
    a, c = width / height * pixel_aspect, w / h
    if policy == "expandAperture":
        w, h = (h * a, h) if a > c else (w, w / a)
    elif policy == "cropAperture":
        w, h = (w, w / a) if a > c else (h * a, h)
    elif policy == "adjustApertureWidth":
        w = h * a
    elif policy == "adjustApertureHeight":
        h = w / a
    expected = (0.4 - w / 2, 0.4 + w / 2, 0.1 - h / 2, 0.1 + h / 2)
    assert camera.fit(width, height, policy, pixel_aspect).window == pytest.approx(expected, rel=1e-12)


def test_the_height_follows_the_shape_of_the_pixels():
    """Without a height, pixels twice as wide as high make the picture twice as many rows high."""
    scene = glowing(FLOOR, ir.Camera.look_at((0, 0, 3), (0, 0, 0), aspect=1.5))
    film = render(scene, width=12, pixel_aspect=2.0, iterations=1)
    assert (film.width, film.height) == (12, 16)


@pytest.mark.parametrize("estimator", ["vpl", "path", "keller"])
def test_a_data_window_is_cut_from_the_whole_picture(estimator, device):
    """Its pixels are those of the whole picture, bit for bit: their random numbers know where they are."""
    scene = ir.load_usd("scenes_usd/cornell_box.usda")
    scene = replace(scene, camera=replace(scene.camera, lens_radius=0.05, focus_distance=2.0))
    settings = dict(width=20, height=20, iterations=2, light_paths=16, filter=False, estimator=estimator)
    whole = ir.render(scene, ir.RenderSettings(**settings), device=device)
    part = ir.render(scene, ir.RenderSettings(**settings, data_window=(0.2, 0.05, 0.7, 0.55)), device=device)
    # Columns 4 ... 13 and, counted from the top, rows 9 ... 18.
    for cut, all_of_it in ((part.radiance(), whole.radiance()), (part.aov("depth"), whole.aov("depth"))):
        np.testing.assert_array_equal(cut, all_of_it[9:19, 4:14])


def test_a_data_window_may_reach_beyond_the_picture():
    """Overscan shows what lies outside: an image of 8 columns and 2 more on either side is one of 12."""
    camera = ir.Camera.look_at((0, 0, 3), (0, 0, 0))
    film = render(glowing(FLOOR, camera), width=8, height=8, iterations=1, data_window=(-0.25, 0.0, 1.25, 1.0))
    left, right, bottom, top = camera.window
    wide = replace(camera, window=(1.5 * left, 1.5 * right, bottom, top))
    other = render(glowing(FLOOR, wide), width=12, height=8, iterations=1)
    assert film.radiance().shape == other.radiance().shape == (8, 12, 3)
    assert (film.aov("alpha")[:, 1] == other.aov("alpha")[:, 1]).all()


@pytest.mark.parametrize(
    "window", [(0, 0, 0, 1), (0, 1, 1, 0), (0, 0, math.nan, 1), (0.51, 0, 0.52, 1), (0, 0, 1e9, 1)]
)
def test_an_empty_data_window_is_an_error(window):
    """A picture without pixels, or with more than any machine holds, is refused by name."""
    with pytest.raises(ir.InputError, match="data_window"):
        render(glowing(FLOOR, ir.Camera.look_at((0, 0, 3), (0, 0, 0))), width=8, height=8, data_window=window)


def test_an_exr_says_where_a_data_window_belongs(tmp_path):
    """Display window and data window, as OpenEXR has them."""
    import OpenImageIO as oiio

    scene = glowing(FLOOR, ir.Camera.look_at((0, 0, 3), (0, 0, 0)))
    film = render(scene, width=10, height=10, iterations=1, data_window=(0.5, 0.0, 1.0, 0.3), pixel_aspect=1.5)
    ir.write_image(tmp_path / "a.exr", film)
    spec = oiio.ImageInput.open(str(tmp_path / "a.exr")).spec()
    assert (spec.x, spec.y, spec.width, spec.height) == (5, 7, 5, 3)
    assert (spec.full_x, spec.full_y, spec.full_width, spec.full_height) == (0, 0, 10, 10)
    assert spec.get_float_attribute("PixelAspectRatio") == 1.5


# ---- the lens --------------------------------------------------------------------------------------------


def lens_camera(radius, focus, *, window=0.5):
    """At the origin, looking along -Z."""
    return ir.Camera(window=(-window, window, -window, window), lens_radius=radius, focus_distance=focus)


@pytest.mark.extended
@pytest.mark.parametrize("focus", [2.0, math.inf])
def test_a_small_light_out_of_focus_is_a_disk(focus, device):
    """A point at depth d is spread evenly over a disk of radius r |1/d - 1/f| on the plane z = -1.

    The point is a quad an eighth of the disk's width across; the disk's flux is that of the quad seen sharp, and its
    second moment R²/2 (plus that of the quad) tells its radius.
    """
    depth, radius = 4.0, 0.4  # |1/4 - 1/2| = |1/4 - 0|: the disks are alike
    blur = radius * abs(1 / depth - 1 / focus)
    half = blur / 8 * depth
    corners = [(-half, -half, -depth), (half, -half, -depth), (half, half, -depth), (-half, half, -depth)]
    n, window, iterations = 64, 0.2, 1024
    scene = glowing(corners, lens_camera(radius, focus, window=window))
    settings = ir.RenderSettings(width=n, height=n, iterations=iterations, light_paths=1, filter=False)
    picture = ir.render(scene, settings, device=device).radiance()[..., 0].astype(np.float64)
    x = (np.arange(n) + 0.5) / n * 2 * window - window
    flux, sharp = picture.sum() * (2 * window / n) ** 2, (2 * half / depth) ** 2
    # n² x iterations independent rays hit with probability p: the relative standard error is 1 / √hits.
    hits = flux / (2 * window / n) ** 2 * iterations
    assert hits > 1000
    assert flux == pytest.approx(sharp, rel=4 / math.sqrt(hits))
    squares = (x[None, :] ** 2 + x[:, None] ** 2) * picture
    moment = squares.sum() / picture.sum()
    expected = blur**2 / 2 + (half / depth) ** 2 * 2 / 3
    assert moment == pytest.approx(expected, rel=4 / math.sqrt(3 * hits) + (2 * window / n) ** 2 / 6 / expected)
    reach = np.sqrt(x[None, :] ** 2 + x[:, None] ** 2)
    assert picture[reach > blur + half / depth * 1.5 + 2 * window / n].max() == 0.0


@pytest.mark.extended
def test_an_edge_out_of_focus_is_the_integral_of_the_disk(device):
    """Before a half-plane the blur is the share of the disk on its side: ½ + (t √(1 - t²) + asin t)/π, t = x/R."""
    depth, focus, radius = 4.0, 1.0, 0.2
    blur = radius * abs(1 / depth - 1 / focus)
    corners = [(0, -9, -depth), (9, -9, -depth), (9, 9, -depth), (0, 9, -depth)]
    n, window, iterations = 32, 0.3, 256
    scene = glowing(corners, lens_camera(radius, focus, window=window))
    settings = ir.RenderSettings(width=n, height=n, iterations=iterations, light_paths=1, filter=False)
    rows = ir.render(scene, settings, device=device).radiance()[..., 0].mean(axis=0)
    x = (np.arange(16 * n) + 0.5) / (16 * n) * 2 * window - window
    t = np.clip(x / blur, -1, 1)
    share = (0.5 + (t * np.sqrt(1 - t * t) + np.arcsin(t)) / math.pi).reshape(n, 16).mean(axis=1)
    np.testing.assert_allclose(rows, share, atol=4 * 0.5 / math.sqrt(n * iterations))


@pytest.mark.extended
def test_what_is_in_focus_is_sharp(device):
    """At the focus distance a lens changes nothing but noise: alpha is that of the pinhole, exactly."""
    corners = [(-0.37, -0.61, -2), (0.83, -0.61, -2), (0.83, 0.29, -2), (-0.37, 0.29, -2)]
    settings = ir.RenderSettings(width=32, height=32, iterations=8, light_paths=1)
    pictures = [
        ir.render(glowing(corners, lens_camera(radius, 2.0)), settings, device=device).aov("alpha")
        for radius in (0.0, 0.3)
    ]
    # Rays through the same point of the film meet there to rounding.
    assert np.abs(pictures[0] - pictures[1]).max() <= 1 / 8 and np.mean(pictures[0] != pictures[1]) < 0.01


@pytest.mark.extended
def test_depth_of_field_can_be_declined():
    """Without it the picture is the pinhole's, bit for bit; an orthographic camera has no lens."""
    scene = ir.load_usd("scenes_usd/cornell_box.usda")
    settings = ir.RenderSettings(width=16, iterations=2, light_paths=16)
    sharp = ir.render(scene, settings).radiance()
    lens = replace(scene, camera=replace(scene.camera, lens_radius=0.1, focus_distance=1.0))
    np.testing.assert_array_equal(ir.render(lens, replace(settings, depth_of_field=False)).radiance(), sharp)
    assert not np.array_equal(ir.render(lens, settings).radiance(), sharp)
    flat = replace(scene.camera, projection=ir.Projection.ORTHOGRAPHIC)
    pictures = [ir.render(replace(scene, camera=replace(flat, lens_radius=r)), settings).radiance() for r in (0.0, 0.1)]
    np.testing.assert_array_equal(*pictures)


@pytest.mark.parametrize("wrong", [{"lens_radius": -1.0}, {"lens_radius": 1.0, "focus_distance": 0.0}])
def test_an_impossible_lens_is_an_error(wrong):
    """A negative radius, or a focus in the camera."""
    scene = glowing(FLOOR, replace(ir.Camera.look_at((0, 0, 3), (0, 0, 0)), **wrong))
    with pytest.raises(ir.InputError, match="lens_radius"):
        render(scene, width=4, iterations=1)


def test_a_camera_beyond_all_floats_is_an_error():
    """A position of 1e300 is finite on the host, and nowhere on the device."""
    far = np.eye(4)
    far[0, 3] = 1e300
    camera = ir.Camera(world_from_camera=far)
    with pytest.raises(ir.InputError, match="too far"):
        render(glowing(FLOOR, camera), width=4, iterations=1)


@pytest.mark.extended
@pytest.mark.parametrize("estimator", ["vpl", "path"])
@pytest.mark.parametrize("orthographic", [False, True])
def test_clipping_planes_cut_what_the_camera_sees(estimator, orthographic):
    """Planes in the camera's space cut camera rays alone: what is cut away still lights and shadows the rest.

    A wall at a depth of 3, one in front of it at a depth of 2, in a scene of 100 times the camera's units, aside.
    """
    at = np.eye(4)
    at[:3, 3] = 100.0, 200.0, 303.0
    camera = ir.Camera(world_from_camera=at, window=(-0.2, 0.2, -0.2, 0.2))
    if orthographic:
        camera = replace(camera, projection=ir.Projection.ORTHOGRAPHIC)
    glow = ir.Material("glow", albedo=(0.0,) * 3, emission=(1.0,) * 3)
    grey = ir.Material("grey", albedo=(0.5,) * 3)
    place = at[:3, 3] - [0.0, 0.0, 3.0]
    behind, before = quad("behind", 2.0 * FLOOR + place, 1), quad("before", 2.0 * FLOOR + place + [0, 0, 1.0], 0)
    # The nearer one turns its dark side to the camera, and lights the other.
    before = replace(before, triangles=before.triangles[:, ::-1].copy())

    def look(*planes):
        scene = ir.Scene((behind, before), (glow, grey), camera=replace(camera, clipping_planes=planes))
        return render(scene, width=8, height=8, iterations=64, estimator=estimator, max_bounces=0)

    whole = look()
    assert (whole.aov("prim_id") == 1).all() and whole.radiance().max() == 0.0
    film = look((0.0, 0.0, -1.0, -2.5))  # depth > 2.5
    assert (film.aov("prim_id") == 0).all()
    np.testing.assert_allclose(film.aov("depth"), 3.0, rtol=1e-5)
    # L ρ F, with the form factor of a square of side 4 at a distance of 1 from a point opposite its middle.
    x = 2.0 / math.sqrt(5.0)
    expected = 0.5 * 4.0 / math.pi * x * math.atan(x)
    error = film.standard_error().mean()
    assert abs(film.radiance().mean() - expected) < 5.0 * error + 5e-3 * expected
    half = look((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -5.0, -12.5))  # the right half of it; planes need no unit normal
    assert (half.aov("prim_id")[:, 4:] == 0).all() and (half.aov("prim_id")[:, :4] == -1).all()
    assert (look((0.0, 0.0, 1.0, 1.0)).aov("prim_id") == -1).all()  # depth < 1
    assert (look((0.0, 0.0, 1.0, 1.0), (0.0, 0.0, -1.0, -2.5)).aov("prim_id") == -1).all()  # nothing at all


def test_bad_clipping_planes_are_refused():
    """More than a box has sides, or not finite: an error that names the camera."""
    for planes in (((1.0, 0.0, 0.0, 0.0),) * 7, ((math.nan, 0.0, 0.0, 1.0),)):
        camera = ir.Camera("odd", clipping_planes=planes)
        with pytest.raises(ir.InputError, match="odd"):
            render(glowing(FLOOR, camera), width=2, height=2, iterations=1)
