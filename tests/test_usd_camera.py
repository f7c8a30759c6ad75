"""Cameras: which one, what it sees, and the one that frames the scene."""

import math

import numpy as np
import pytest

from tests.stages import load, mesh_text, warned
from warp_ir import InputError, Projection


def camera_text(more: str = "", name: str = "C") -> str:
    return f'def Camera "{name}" {{\n    {more}\n}}\n'


def test_the_window_of_the_default_camera(tmp_path):
    """The window is the aperture over the focal length; units cancel."""
    camera = load(tmp_path, camera_text()).camera
    x, y = 0.5 * 20.955 / 50, 0.5 * 15.2908 / 50
    assert camera.window == pytest.approx((-x, x, -y, y)) and camera.projection == Projection.PERSPECTIVE
    assert camera.clipping == (1.0, 1e6) and camera.exposure == 1.0 and camera.name == "/C"


def test_aperture_offsets_shift_the_window(tmp_path):
    """Offsets move the window by offset / focal length."""
    more = """float horizontalAperture = 20
    float verticalAperture = 10
    float focalLength = 10
    float horizontalApertureOffset = 3
    float verticalApertureOffset = -1"""
    assert load(tmp_path, camera_text(more)).camera.window == pytest.approx((-0.7, 1.3, -0.6, 0.4))


def test_an_orthographic_window_is_in_scene_units(tmp_path):
    """Apertures are tenths of a scene unit; the focal length does not matter."""
    camera = load(tmp_path, camera_text('token projection = "orthographic"\n float focalLength = 0')).camera
    assert camera.projection == Projection.ORTHOGRAPHIC
    assert camera.window == pytest.approx((-1.04775, 1.04775, -0.76454, 0.76454))


def test_scale_and_mirroring_are_removed_from_the_transform(tmp_path):
    """world_from_camera is a rotation and a translation."""
    more = """double3 xformOp:translate = (1, 2, 3)
    float xformOp:rotateY = 90
    float3 xformOp:scale = (-2, 3, 4)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateY", "xformOp:scale"]"""
    matrix = load(tmp_path, camera_text(more)).camera.world_from_camera
    expected = np.array([[0, 0, 1, 1], [0, 1, 0, 2], [-1, 0, 0, 3], [0, 0, 0, 1]])
    assert matrix == pytest.approx(expected, abs=1e-6)


def test_a_collapsed_transform_is_named(tmp_path):
    """A camera scaled to nothing stands at the origin."""
    more = 'float3 xformOp:scale = (0, 0, 0)\n uniform token[] xformOpOrder = ["xformOp:scale"]'
    scene = load(tmp_path, camera_text(more))
    assert warned(scene, "/C", "degenerate") and (scene.camera.world_from_camera == np.eye(4)).all()


def test_exposure_controls_scale_the_film(tmp_path):
    """The factor is responsivity · time · iso / 100 · 2^exposure / fStop²."""
    more = """float exposure = 3
    float exposure:iso = 200
    float exposure:time = 0.5
    float exposure:fStop = 2
    float exposure:responsivity = 1.5"""
    assert load(tmp_path, camera_text(more)).camera.exposure == pytest.approx(1.5 * 0.5 * 2 * 8 / 4)


def test_the_lens_is_focal_length_over_f_stop_wide(tmp_path):
    """Its radius is half of that, in scene units: the focal length is in tenths of one. No fStop, no lens."""
    camera = load(tmp_path, camera_text("float fStop = 2\n float focalLength = 80\n float focusDistance = 7")).camera
    assert camera.lens_radius == pytest.approx(80 * 0.1 / 2 / 2) and camera.focus_distance == 7.0
    assert load(tmp_path, camera_text("float focusDistance = 7")).camera.lens_radius == 0.0


def test_a_lens_focused_at_infinity(tmp_path):
    """A focus distance of infinity is one, and its lens blurs what is near."""
    scene = load(tmp_path, camera_text("float fStop = 2\n float focusDistance = inf"))
    assert scene.camera.lens_radius > 0.0 and scene.camera.focus_distance == np.inf and not warned(scene, "focus")
    scene = load(tmp_path, camera_text("float fStop = 2\n float focusDistance = nan"))
    assert scene.camera.lens_radius == 0.0 and warned(scene, "focusDistance is nan, not a finite number")


@pytest.mark.parametrize("more", ["", 'token projection = "orthographic"\n float focusDistance = 7'])
def test_a_lens_that_cannot_be_is_named(tmp_path, more):
    """Without a focus distance, or without perspective, an fStop blurs nothing."""
    scene = load(tmp_path, camera_text("float fStop = 2\n" + more))
    assert scene.camera.lens_radius == 0.0 and warned(scene, "/C", "no depth of field")


def test_an_empty_clipping_range_clips_nothing(tmp_path):
    """A far plane before the near plane would hide everything."""
    scene = load(tmp_path, camera_text("float2 clippingRange = (5, 1)"))
    assert scene.camera.clipping == (0.0, math.inf) and warned(scene, "/C", "clippingRange")


def test_clipping_planes(tmp_path):
    """They are read as they are; what is no plane, or more than a box has sides, is ignored and named."""
    scene = load(tmp_path, camera_text("float4[] clippingPlanes = [(0, 0, 1, 2), (1, 0, 0, -3)]"))
    assert scene.camera.clipping_planes == ((0.0, 0.0, 1.0, 2.0), (1.0, 0.0, 0.0, -3.0)) and not warned(scene, "/C")
    scene = load(tmp_path, camera_text("float4[] clippingPlanes = [(0, 0, 0, 2), (nan, 0, 0, 1)]"))
    assert scene.camera.clipping_planes == () and warned(scene, "/C", "clippingPlanes: 2 invalid planes")
    planes = ", ".join(["(1, 0, 0, 5)"] * 7)
    scene = load(tmp_path, camera_text(f"float4[] clippingPlanes = [{planes}]"))
    assert len(scene.camera.clipping_planes) == 6 and warned(scene, "/C", "only the first 6 of 7")
    scene = load(tmp_path, camera_text("int[] clippingPlanes = [1, 2]"))
    assert scene.camera.clipping_planes == () and warned(scene, "/C", "clippingPlanes")


@pytest.mark.parametrize("name", ["focalLength", "horizontalAperture", "verticalAperture"])
@pytest.mark.parametrize("number", ["0", "-1", "nan", "inf"])
def test_an_impossible_camera_is_an_error_that_names_it(tmp_path, name, number):
    """Focal length and apertures must be positive numbers."""
    with pytest.raises(InputError, match=f"/C.*{name}"):
        load(tmp_path, camera_text(f"float {name} = {number}"))


def test_cameras_are_chosen_by_path_or_name(tmp_path):
    """A camera is known by its path or its name; an unknown one is an error that lists the others."""
    text = camera_text(name="A") + 'def Xform "X" {\n' + camera_text(name="B") + "}\n"
    assert load(tmp_path, text, camera="/X/B").camera.name == "/X/B"
    assert load(tmp_path, text, camera="B").camera.name == "/X/B"
    with pytest.raises(InputError, match=r"'D'.*/A, /X/B"):
        load(tmp_path, text, camera="D")


def test_the_order_of_choice(tmp_path):
    """Render settings come before main_cam, main_cam before the first camera; the first is a guess, and said."""
    two = camera_text(name="A") + camera_text(name="B")
    scene = load(tmp_path, two)
    assert scene.camera.name == "/A" and warned(scene, "/A", "first of 2")
    text = two + camera_text(name="main_cam")
    scene = load(tmp_path, text)
    assert scene.camera.name == "/main_cam" and not warned(scene, "first of")
    settings = 'def RenderSettings "S" { rel camera = </B>\n}\n'
    assert load(tmp_path, text + settings).camera.name == "/B"
    assert load(tmp_path, text + settings, camera="A").camera.name == "/A"
    product = 'def RenderSettings "S" { rel products = </P>\n}\ndef RenderProduct "P" { rel camera = </B>\n}\n'
    assert load(tmp_path, text + product).camera.name == "/B"
    other = 'def RenderSettings "R" { rel camera = </A>\n}\n'
    assert load(tmp_path, '(renderSettingsPrimPath = "/R")\n' + text + settings + other).camera.name == "/A"
    scene = load(tmp_path, text + settings.replace("</B>", "</Gone>"))
    assert scene.camera.name == "/main_cam" and warned(scene, "/S", "/Gone")


@pytest.mark.parametrize(("axis", "matrix"), [
    ("Y", [[1, 0, 0, 10], [0, 1, 0, 0], [0, 0, 1, None], [0, 0, 0, 1]]),
    ("Z", [[1, 0, 0, 10], [0, 0, -1, None], [0, 1, 0, 0], [0, 0, 0, 1]]),
])  # fmt: skip
def test_without_a_camera_the_scene_is_framed_as_usdrecord_does(tmp_path, axis, matrix):
    """A 50 mm camera looks along -Z (Y up) or +Y (Z up) from half the diagonal / tan(fov / 2) + half the depth."""
    scene = load(tmp_path, f"""(upAxis = "{axis}")
def Cube "C" {{
    double3 xformOp:translate = (10, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}}""")  # fmt: skip
    distance = math.hypot(1, 1) / (0.5 * 20.955 / 50) + 1
    number = -distance if axis == "Z" else distance
    expected = [[number if entry is None else entry for entry in row] for row in matrix]
    assert scene.camera.world_from_camera == pytest.approx(np.array(expected, dtype=float), abs=1e-5)
    assert warned(scene, "no camera", "-Z" if axis == "Y" else "+Y")


@pytest.mark.parametrize(("axis", "up"), [("Y", (0, 1, 0)), ("Z", (0, 0, 1))])
def test_an_eye_stands_in_place_of_a_camera(tmp_path, axis, up):
    """It stands where it is told, upright, and looks where it is told, or at the middle of the scene."""
    text = f"""(upAxis = "{axis}")
def Camera "C" {{}}
def Cube "B" {{
    double3 xformOp:translate = (10, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}}"""
    for target, look_at in (((10, 0, 0), None), ((1, 7, 9), (1, 7, 9))):
        scene = load(tmp_path, text, eye=(1, 2, 3), look_at=look_at)
        matrix, forward = scene.camera.world_from_camera, np.array(target) - (1, 2, 3)
        assert matrix[:3, 3] == pytest.approx((1, 2, 3)) and not warned(scene, "no camera")
        assert -matrix[:3, 2] == pytest.approx(forward / np.linalg.norm(forward))
        assert matrix[:3, 0] @ up == pytest.approx(0.0) and matrix[:3, 1] @ up > 0.0


@pytest.mark.parametrize("wrong", [{"camera": "C", "eye": (1, 2, 3)}, {"look_at": (0, 0, 0)}])
def test_an_eye_alone_is_a_camera(tmp_path, wrong):
    """Either a camera of the stage or an eye; what is to be looked at belongs to the latter."""
    with pytest.raises(InputError, match="eye: it replaces camera"):
        load(tmp_path, 'def Camera "C" {}', **wrong)


@pytest.mark.parametrize(("axis", "size"), [("Y", (1, 4, 2)), ("Z", (1, 2, 4)), ("Y", (4, 1, 2)), ("Y", (1, 1.6, 1))])
def test_all_of_the_scene_is_framed(tmp_path, axis, size):
    """Every corner of a box lies in the window, and a tall box fills its height."""
    scene = load(tmp_path, f"""(upAxis = "{axis}")
def Cube "C" {{
    double size = 1
    double3 xformOp:scale = {size}
    uniform token[] xformOpOrder = ["xformOp:scale"]
}}""")  # fmt: skip
    corners = np.array([[x, y, z, 1.0] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    corners[:, :3] *= size
    seen = corners @ np.linalg.inv(scene.camera.world_from_camera).T
    x, y = (np.abs(seen[:, k] / seen[:, 2]).max() for k in (0, 1))
    assert x <= scene.camera.window[1] * (1 + 1e-9) and y <= scene.camera.window[3] * (1 + 1e-9)
    height = size[1] if axis == "Y" else size[2]
    if height > 1.7 * size[0]:
        assert y == pytest.approx(scene.camera.window[3])


def framed_quad(scene):
    """Corners of the only quadrilateral in the picture, [4, 2] from -1 to 1, and the fraction of it that it covers."""
    corners = np.pad(scene.meshes[0].points, ((0, 0), (0, 1)), constant_values=1.0)
    for group in scene.instances:
        corners = corners @ group.matrices[0].T
    x, y, z, _ = np.linalg.inv(scene.camera.world_from_camera) @ corners.T
    assert (z < 0.0).all()
    x, y = -x / z / scene.camera.window[1], -y / z / scene.camera.window[3]
    doubled = np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
    return np.stack([x, y], axis=1), abs(doubled) / 8.0


@pytest.mark.parametrize("size", [1e-9, 0.01, 1.0, 1e9])
@pytest.mark.parametrize("axis", ["Y", "Z"])
def test_the_size_of_a_scene_does_not_matter(tmp_path, axis, size):
    """There is no near plane to step back from: a cube fills the same part of the picture at every size."""
    scene = load(tmp_path, f'(upAxis = "{axis}")\ndef Cube "C" {{ double size = {size}\n}}')
    distance = size * (math.sqrt(0.5) / (0.5 * 20.955 / 50) + 0.5)
    at = np.abs(scene.camera.world_from_camera[:3, 3])
    assert at == pytest.approx([0, distance, 0] if axis == "Z" else [0, 0, distance])


@pytest.mark.parametrize("instanced", [False, True])
@pytest.mark.parametrize("angle", [0.0, 30.0, 45.0, 90.0, 120.0])
@pytest.mark.parametrize("axis", ["Y", "Z"])
def test_what_is_edge_on_is_framed_from_elsewhere(tmp_path, axis, angle, instanced):
    """A square that holds the line of sight, however it is turned about it, is whole in the picture, and well seen.

    At 45 degrees to the view at least |cos 45| sin 45 = 1/2 of its area is seen.
    """
    side = np.array([math.cos(math.radians(angle)), math.sin(math.radians(angle))])
    corners = [(*(u * side), w) for u, w in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    corners = [(x, -z, y) if axis == "Z" else (x, y, z) for x, y, z in corners]
    text = mesh_text(corners, [4], range(4), name="P")
    if instanced:
        copies = [f'def Xform "I{k}" (instanceable = true\n references = </A>) {{\n}}\n' for k in range(2)]
        text = f'class Xform "A" {{{text}\n}}\n' + "".join(copies)
    scene = load(tmp_path, f'(upAxis = "{axis}")\n{text}')
    corners, fraction = framed_quad(scene)
    assert np.abs(corners).max() <= 1.0 + 1e-6 and fraction > 0.1
    assert warned(scene, "no camera", f"{'-Z' if axis == 'Y' else '+Y'} and ")


@pytest.mark.parametrize(
    ("size", "turned"),
    [
        *(((1, 0.02, 1), False), ((1, 0.002, 1), True), ((0.002, 1, 1), True), ((1, 1, 1e-4), False)),
        *(((1, 1e-4, 1e-4), False), ((1e-4, 1, 1e-4), False), ((1e-4, 1e-4, 1), False)),
    ],
)
def test_only_what_is_hardly_seen_is_framed_from_elsewhere(tmp_path, size, turned):
    """A plate of 2 % of its width is seen as in usdrecord, one of 0.2 % from above; a rod is thin from anywhere."""
    scene = load(tmp_path, f"""
def Cube "C" {{
    double size = 1
    double3 xformOp:scale = {size}
    uniform token[] xformOpOrder = ["xformOp:scale"]
}}""")  # fmt: skip
    assert warned(scene, "no camera", "-Z and") == turned
    assert np.allclose(scene.camera.world_from_camera[:3, :3], np.eye(3)) != turned


def test_two_cameras_of_one_name_are_an_error(tmp_path):
    """The error names both paths; a path chooses one of them."""
    text = "".join(f'def Xform "{group}" {{ def Camera "Cam" {{\n}}\n }}\n' for group in "AB")
    with pytest.raises(InputError, match="2 cameras are named 'Cam': /A/Cam, /B/Cam"):
        load(tmp_path, text, camera="Cam")
    assert load(tmp_path, text, camera="/B/Cam").camera.name == "/B/Cam"
    assert warned(load(tmp_path, text.replace('"Cam"', '"main_cam"')), "/A/main_cam", "2 cameras named main_cam")


def test_two_render_passes_of_one_name_are_an_error(tmp_path):
    """So it is with render passes."""
    text = "".join(f'def Xform "{group}" {{ def RenderPass "Beauty" {{\n}}\n }}\n' for group in "AB")
    with pytest.raises(InputError, match="2 render passes are named 'Beauty': /A/Beauty, /B/Beauty"):
        load(tmp_path, text, render_pass="Beauty")
