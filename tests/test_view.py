"""The live view without a window: camera controls, edits, pixels, controls, and what it renders next."""

import base64
import io
import math
import re
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.stages import SCENES
from warp_ir import Camera, InputError, Light, LightKind, Material, Projection, RenderSettings, Scene, load_usd
from warp_ir.image.io import read_image
from warp_ir.image.tonemap import tone_map
from warp_ir.procedural import cornell_box, quad
from warp_ir.view import navigation, terminal
from warp_ir.view.controls import ACTIONS, Controls
from warp_ir.view.display import display_pixels, scaled, visible_vpls
from warp_ir.view.edits import Edits, LightEdit, light_names, surface_at
from warp_ir.view.session import LiveView
from warp_ir.view.source import SceneSource, StageSource

UP = np.array([0.0, 1.0, 0.0])
EYE = Camera.look_at((0, 1, 4), (0, 1, 0), aspect=1.5, name="eye")


def place(camera):
    return camera.world_from_camera[:3, 3]


def rigid(camera):
    turn = camera.world_from_camera[:3, :3]
    return np.abs(turn.T @ turn - np.eye(3)).max() < 1e-9 and np.linalg.det(turn) > 0.0


# ---- camera controls ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("right, upwards", [(0.3, 0.0), (0.0, 0.4), (-0.7, -0.2), (2.0, 5.0)])
def test_orbit_keeps_distance_and_aim(right, upwards):
    """The camera stays on a sphere around the pivot, which stays in the middle of the picture, upright."""
    pivot = np.array([0.0, 1.0, 0.0])
    turned = navigation.orbit(EYE, pivot, UP, right, upwards)
    assert rigid(turned)
    assert np.linalg.norm(place(turned) - pivot) == pytest.approx(4.0)
    column, row, depth = turned.project(pivot[None])
    assert (column[0], row[0], depth[0]) == pytest.approx((0.5, 0.5, 4.0))
    assert abs(turned.world_from_camera[1, 0]) < 1e-9  # its horizon is level
    assert turned.world_from_camera[1, 1] > 0.0  # it never goes over the pole


def test_dragging_right_moves_the_scene_right():
    """Surfaces nearer than the pivot follow the pointer: the camera goes to the left, and down if dragged upwards."""
    turned = navigation.orbit(EYE, np.array([0.0, 1.0, 0.0]), UP, 0.2, 0.2)
    assert place(turned)[0] < 0.0 and place(turned)[1] < 1.0


def test_looking_around_stays_and_turns_to_where_one_looks():
    """The eye does not move; to the right and upwards the viewing direction gains +X and +Y."""
    turned = navigation.look_around(EYE, UP, 0.2, 0.1)
    forward = -turned.world_from_camera[:3, 2]
    assert (place(turned) == place(EYE)).all() and rigid(turned)
    assert forward[0] == pytest.approx(math.sin(0.2) * math.cos(0.1)) and forward[1] == pytest.approx(math.sin(0.1))


@pytest.mark.parametrize("projection", list(Projection))
def test_pan_takes_the_pivot_along(projection):
    """Panning by a tenth of the picture's height shifts the pivot by that in the picture."""
    camera = replace(EYE, projection=projection)
    pivot = np.array([0.3, 1.2, 0.0])
    before = camera.project(pivot[None])
    after = navigation.pan(camera, pivot, -0.1, 0.0).project(pivot[None])
    assert after[0][0] - before[0][0] == pytest.approx(0.1 / 1.5) and after[1][0] == pytest.approx(before[1][0])


@pytest.mark.parametrize("projection", list(Projection))
def test_dolly_enlarges_by_its_factor(projection):
    """At half the distance, or in half the window, the pivot's neighbourhood is twice as large."""
    camera = replace(EYE, projection=projection)
    pivot = np.array([0.0, 1.0, 0.0])
    near = navigation.dolly(camera, pivot, 0.5)
    points = pivot + np.array([[-0.1, 0, 0], [0.1, 0, 0]])
    assert np.diff(near.project(points)[0]) == pytest.approx(2 * np.diff(camera.project(points)[0]))


def test_walking_stays_on_the_ground():
    """Forward is along the ground, whether one looks up, ahead, or straight down."""
    for target in ((0, 3, 0), (0, 1, 0), (0, 0.1, 3.9)):
        camera = Camera.look_at((0, 1, 4), target)
        moved = navigation.walk(camera, UP, 0.0, 0.0, 2.0)
        assert place(moved) == pytest.approx((0, 1, 2))
    assert place(navigation.walk(EYE, UP, 1.0, 0.5, 0.0)) == pytest.approx((1, 1.5, 4))


@pytest.mark.parametrize("projection", list(Projection))
def test_framed_shows_the_whole_box(projection):
    """All corners of the box are in the picture and before the camera, whose direction stays."""
    camera = replace(Camera.look_at((5, 9, 4), (0, 1, 0), aspect=1.5), projection=projection)
    corners = np.array(np.meshgrid([0, 2], [0, 3], [0, 1.0])).reshape(3, -1).T
    shown = navigation.framed(camera, corners.min(axis=0), corners.max(axis=0))
    column, row, depth = shown.project(corners)
    assert (depth > 0).all() and np.min([column, row]) > 0.0 and np.max([column, row]) < 1.0
    assert (shown.world_from_camera[:3, :3] == camera.world_from_camera[:3, :3]).all()


# ---- edits -------------------------------------------------------------------------------------------------------


def lamp_scene():
    light = Light("/Lamp", LightKind.POINT, (1.0, 2.0, 3.0))
    other = Light("/Other", LightKind.DOME, (1.0, 1.0, 1.0))
    materials = Material("/Red", (0.5, 0, 0)), Material("/Glow", emission=(1.0, 1.0, 0.0)), Material("displayColor")
    corners = [[-1, 0, 0], [1, 0, 0], [1, 2, 0], [-1, 2, 0]]
    floor = [[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]]
    meshes = quad("/Wall", corners, 0), quad("/Floor", floor, 2)
    return Scene(meshes, materials, (light, other), EYE)


def test_edits_change_what_they_name():
    """Gain scales, offset moves, off removes, a colour replaces; all else is the same object."""
    scene = lamp_scene()
    edits = Edits().with_light("/Lamp", LightEdit(gain=2.0, offset=(0.0, 1.0, 0.0))).with_color("/Red", (0.1, 0.2, 0.3))
    edited = edits.with_light("/Glow", LightEdit(gain=0.5)).apply(scene)
    assert edited.lights[0].radiance == (2.0, 4.0, 6.0)
    assert edited.lights[0].world_from_light[:3, 3].tolist() == [0.0, 1.0, 0.0]
    assert edited.lights[1] is scene.lights[1] and edited.meshes[0] is scene.meshes[0]
    assert edited.materials[0].albedo == (0.1, 0.2, 0.3) and edited.materials[1].emission == (0.5, 0.5, 0.0)
    off = Edits().with_light("/Lamp", LightEdit(on=False)).apply(scene)
    assert off.lights == (scene.lights[1],)
    assert scene.lights[0].radiance == (1.0, 2.0, 3.0)


def test_edits_that_change_nothing_are_none():
    """An edit that is taken back leaves no trace, and the scene is the same object."""
    scene = lamp_scene()
    edits = Edits().with_light("/Lamp", LightEdit(on=False)).with_light("/Lamp", LightEdit())
    assert edits == Edits() and edits.apply(scene) is scene


def test_surfaces_without_a_material_are_painted_alone():
    """The colour of a mesh without a material is its own: other meshes keep the shared displayColor."""
    scene = lamp_scene()
    name, color = surface_at(scene, 1, np.array([0.2, 0.0, 0.3]))
    assert name == "/Floor" and color == (0.18, 0.18, 0.18)
    edited = Edits().with_color(name, (0.9, 0.8, 0.7)).apply(scene)
    assert edited.materials[int(edited.meshes[1].material[0])].albedo == (0.9, 0.8, 0.7)
    assert edited.materials[:3] == scene.materials
    assert light_names(scene) == ("/Lamp", "/Other", "/Glow")


def test_the_triangle_at_a_point_names_the_surface():
    """A mesh of two materials is told apart by where it is picked."""
    scene = lamp_scene()
    two = replace(scene.meshes[0], material=np.array([0, 1], np.int32))
    scene = replace(scene, meshes=(two, scene.meshes[1]))
    centres = two.points[two.triangles].mean(axis=1)
    assert [surface_at(scene, 0, point)[0] for point in centres] == ["/Red", "/Glow"]


# ---- pixels ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tonemap", ["srgb", "filmic"])
def test_display_is_tone_mapping_in_eight_bits(tonemap):
    """Half-precision floats have 11 bits: the table is within one step of 255 of exact tone mapping."""
    radiance = np.geomspace(1e-4, 1e3, 3000).astype(np.float32).reshape(-1, 10, 3)
    shown = display_pixels(radiance, 1.0, tonemap)
    assert np.abs(shown - 255.0 * tone_map(radiance, 1.0, tonemap)).max() <= 1.0
    odd = np.array([[[np.nan, np.inf, -1.0]]], np.float32)
    assert display_pixels(odd, 0.0, tonemap)[0, 0].tolist() == [0, 255, 0]


def test_scaling_keeps_constants_and_ramps():
    """A constant stays, and a ramp stays a ramp, in any size."""
    assert (scaled(np.full((3, 5, 3), 77, np.uint8), 11, 7) == 77).all()
    ramp = np.broadcast_to(np.arange(0, 240, 24, dtype=np.uint8)[None, :, None], (4, 10, 3))
    middle = scaled(ramp, 40, 1)[0, 4:-4, 0].astype(int)
    assert set(np.diff(middle)) == {6}
    assert scaled(ramp, 1, 1).shape == (1, 1, 3)


def test_hidden_vpls_are_not_drawn():
    """Only the VPL that faces the camera in front of the surface is seen, and where the camera projects it."""
    positions = np.array([[0.5, 1, 0], [0.5, 1, -2], [0.5, 1, 0], [0, 1, 9], [0, 0, 1]], float)
    normals = np.array([[0, 0, 1], [0, 0, 1], [0, 0, -1], [0, 0, 1], [0, 0, 0]], np.float32)
    vpls = SimpleNamespace(positions=positions, normals=normals, directional=np.array([0, 0, 0, 0, 1], bool))
    column, row, index = visible_vpls(vpls, EYE, np.full((20, 30), 4.0))
    assert index.tolist() == [0]
    assert row[0] == pytest.approx(0.5) and column[0] == pytest.approx(
        0.5 + 0.5 / (2 * 1.5 * 4 * math.tan(math.pi / 8))
    )


# ---- terminals ---------------------------------------------------------------------------------------------------


def test_terminals_are_known_by_their_environment():
    """Each protocol where it is spoken; inside a multiplexer, blocks at most; nothing where nothing is known."""
    known = {
        "kitty": {"TERM": "xterm-kitty"},
        "iterm": {"TERM": "xterm-256color", "TERM_PROGRAM": "iTerm.app"},
        "sixel": {"TERM": "foot"},
        "blocks": {"TERM": "xterm-256color", "COLORTERM": "truecolor"},
        None: {"TERM": "xterm-256color"},
    }
    for protocol, environ in known.items():
        assert terminal.terminal_protocol(environ) == protocol
    assert terminal.terminal_protocol({"TERM": "xterm-kitty", "TMUX": "1", "COLORTERM": "truecolor"}) == "blocks"


def test_half_blocks_hold_two_rows_of_pixels():
    """The upper pixel is the colour of the block, the lower that behind it."""
    text = terminal.half_blocks(np.array([[[1, 2, 3]], [[4, 5, 6]]], np.uint8))
    assert text == "\x1b[38;2;1;2;3;48;2;4;5;6m\u2580\x1b[0m\n"


def test_sixels_draw_the_picture():
    """Decoded, the sixels are the picture, but for dithering by one of six levels."""
    pixels = np.random.default_rng(1).integers(0, 256, (13, 9, 3)).astype(np.uint8)
    text = terminal.sixels(pixels)
    body = text[text.index("#") : -2]
    palette, shown = {}, np.full((18, 9, 3), -1.0)
    x = top = color = 0
    for token in re.findall(r"#\d+(?:;[\d;]+)?|!\d+.|[$-]|[?-~]", body):
        if token[0] == "#" and ";" in token:
            number, _, *channels = map(int, token[1:].split(";"))
            palette[number] = channels
        elif token[0] == "#":
            color = int(token[1:])
        elif token == "$":
            x = 0
        elif token == "-":
            x, top = 0, top + 6
        else:
            count = int(token[1:-1]) if token[0] == "!" else 1
            for bit in range(6):
                if (ord(token[-1]) - 63) >> bit & 1:
                    shown[top + bit, x : x + count] = palette[color]
            x += count
    assert np.abs(shown[:13] * 2.55 - pixels).max() <= 255 / 5 + 2
    assert (shown[13:] == -1).all()


def test_pictures_for_terminals_are_png(tmp_path):
    """What kitty is sent, put together from its messages, is the picture."""
    pixels = np.random.default_rng(2).integers(0, 256, (70, 90, 3)).astype(np.uint8)
    messages = re.findall(r"\x1b_G([^;]*);([^\x1b]*)\x1b", terminal.kitty(pixels, 9, 7))
    assert len(messages) > 1 and all(len(body) <= 4096 for _, body in messages)
    path = tmp_path / "a.png"
    path.write_bytes(base64.b64decode("".join(body for _, body in messages)))
    assert (np.round(255.0 * read_image(path)) == pixels).all()


@pytest.mark.parametrize("protocol", ["kitty", "iterm", "sixel", "blocks"])
def test_the_next_picture_replaces_the_last(protocol):
    """The cursor goes up by the rows of the picture and its line before the next one."""
    stream = io.StringIO()
    shown = terminal.TerminalPicture(stream, protocol)
    shown.show(np.zeros((9, 16, 3), np.uint8), "one")
    first = stream.getvalue()
    shown.show(np.zeros((9, 16, 3), np.uint8), "two")
    second = stream.getvalue()[len(first) :]
    assert "one" in first and "two" in second and second.startswith("\x1b[")
    if protocol == "blocks":
        assert second.startswith(f"\x1b[{first.count(chr(10))}A")


# ---- the view ----------------------------------------------------------------------------------------------------


def view_of(source=None, width=48, height=27, **options):
    settings = RenderSettings(width=width, height=height, **options)
    return LiveView(source or SceneSource(cornell_box()), settings, exposure=0.0)


def next_frame(view, seconds=20.0):
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        frame = view.step()
        if frame is not None:
            return frame
    raise AssertionError("no frame")


def resting_view():
    """A view whose film has the resolution of its window, and is far from converged."""
    view = view_of(width=320, height=180, iterations=1000)
    next_frame(view)
    time.sleep(0.2)
    while view._film is None or view._film.width < 320:
        view.step()
    return view


def settle(view, seconds=60.0):
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        frame = view.step()
        if frame is not None and frame.converged:
            return frame
    raise AssertionError("did not converge")


@pytest.mark.extended
def test_a_resting_view_refines_until_it_has_converged():
    """The first picture is there at once; then iterations are added until their limit, and then nothing happens."""
    view = view_of(iterations=6)
    first = next_frame(view)
    last = settle(view)
    assert first.pixels.any() and last.pixels.shape == (27, 48, 3) and not last.coarse
    assert last.iterations == 6 and 0.0 < last.error < 1.0 and "error" in last.status
    assert view.step() is None


def test_motion_is_coarse_and_never_blank():
    """In a large window each motion gives at once a picture of fewer pixels, in which the box is lit."""
    view = view_of(width=640, height=360)
    for _ in range(3):
        view.navigate(lambda camera: navigation.orbit(camera, view.pivot(), view.up, 0.02, 0.0))
        frame = view.step()
        assert frame is not None and frame.coarse
        assert frame.pixels.shape[0] < 360 and frame.pixels.mean() > 10.0
        assert frame.state.camera is view.state.camera


@pytest.mark.extended
def test_a_motion_interrupts_the_work_on_a_resting_picture():
    """A change during an iteration cancels it: the step ends without a frame, and the next shows the change."""
    view = resting_view()
    moving = threading.Timer(0.02, lambda: view.change(max_bounces=0))
    launcher = view._renderer.launcher
    cancelled = []
    cancel, launcher.cancel = launcher.cancel, lambda: (cancelled.append(1), cancel())
    moving.start()
    while view.state.max_bounces is None:
        view.step()
    moving.join()
    frame = next_frame(view)
    assert cancelled and frame.state.max_bounces == 0 and frame.pixels.any()


@pytest.mark.extended
def test_another_exposure_interrupts_an_iteration_and_keeps_the_film():
    """It shows at once, with the iterations that the film has; that which was interrupted is done again."""
    view = resting_view()
    film = view._film
    brighten = threading.Timer(0.02, lambda: view.change(exposure=1.0))
    brighten.start()
    while view.state.exposure == 0.0:
        done = film.iterations
        view.step()
    brighten.join()
    frame = next_frame(view)
    assert frame.state.exposure == 1.0 and view._film is film and frame.iterations in (done, done + 1)


def test_display_changes_render_nothing():
    """Exposure and tone curve map the same radiance: brighter, and without another iteration."""
    view = view_of(iterations=4)
    before = settle(view)
    view.change(exposure=2.0)
    after = view.step()
    assert after.iterations == before.iterations == 4
    assert after.pixels.mean() > 1.3 * before.pixels.mean()
    view.change(auto_exposure=True)
    automatic = view.step()
    assert 60 < automatic.pixels.mean() < 180 and view.state.exposure != 2.0


@pytest.mark.extended
def test_bounces_by_hand_are_the_series():
    """Direct light alone is darker than with one bounce, and that darker than all."""
    view = view_of(iterations=8)
    means = []
    for bounces in (0, 1, None):
        view.change(max_bounces=bounces)
        settle(view)
        means.append(view._radiance.mean())
    assert means[0] < 0.9 * means[1] and means[1] < 0.95 * means[2]


@pytest.mark.extended
def test_resizing_renders_the_new_size():
    """Any size of the window is rendered, down to one pixel."""
    view = view_of(iterations=2)
    for width, height in ((31, 17), (1, 1), (64, 2), (0, 5)):
        view.resize(width, height)
        assert settle(view).pixels.shape == (max(height, 1), max(width, 1), 3)


@pytest.mark.extended
def test_scenes_without_light_or_geometry_are_shown():
    """A dark scene, and an empty one, are black pictures and no error."""
    dark = replace(lamp_scene(), lights=(), materials=(Material("/A"),) * 3)
    for scene in (dark, Scene()):
        view = view_of(SceneSource(scene), iterations=2)
        assert not settle(view).pixels.any()
        view.change(vpls=True)
        controls = Controls(view)
        for action in ACTIONS:
            for key in action.keys:
                if key not in ("F2", "F3", "Escape"):
                    controls.key(key)
        controls.wheel(1.0)
        controls.pick(0.5, 0.5)
        assert next_frame(view).pixels.shape[2] == 3


@pytest.mark.extended
def test_light_edits_scale_the_picture():
    """Four times the light is four times the radiance, with the same light paths: the same noise."""
    view = view_of(SceneSource(lamp_scene()), iterations=2)
    view.change(edits=Edits().with_light("/Glow", LightEdit(on=False)).with_light("/Other", LightEdit(on=False)))
    settle(view)
    before = view._radiance.copy()
    view.edit_light("/Lamp", gain=4.0)
    settle(view)
    assert before.max() > 0.0 and np.allclose(view._radiance, 4.0 * before, rtol=1e-4)
    view.edit_light("/Lamp", on=False)
    assert not settle(view).pixels.any()


def test_unusable_edits_keep_what_was_shown():
    """A state that cannot be rendered is refused in words, and the last one stays."""
    view = view_of(iterations=2)
    settle(view)
    view.change(max_bounces=-5)
    frame = next_frame(view)
    assert "max_bounces" in view.message and view.state.max_bounces is None and frame.pixels.any()


@pytest.mark.extended
def test_surfaces_are_picked_where_they_are_seen():
    """The left wall of the box is red, the right one green; what is picked there is painted."""
    view = view_of(width=64, height=64, iterations=2)
    settle(view)
    controls = Controls(view)
    controls.pick(0.03, 0.5)
    red = controls.color
    controls.pick(0.97, 0.5)
    green = controls.color
    assert red[0] > 2 * red[1] and green[1] > 2 * green[0]
    controls.paint((0.1, 0.1, 0.9))
    assert settle(view).pixels[32, 62, 2] > 1.5 * settle_pixels(view)[32, 62, 1]


def settle_pixels(view):
    return display_pixels(view._radiance, 0.0, "srgb")


@pytest.mark.extended
def test_vpls_lie_over_the_picture():
    """The overlay changes some pixels, keeps the others, and has the size of the window even over a coarse picture."""
    view = view_of(width=200, height=200, iterations=1)
    plain = settle(view).pixels
    view.change(vpls=True)
    drawn = next_frame(view).pixels
    different = (plain != drawn).any(axis=2).mean()
    assert drawn.shape == plain.shape and 0.001 < different < 0.4
    view.navigate(lambda camera: navigation.move(camera, 0.1, 0.0, 0.0))
    assert next_frame(view).pixels.shape == plain.shape


def test_automatic_exposure_at_the_start_only_where_nothing_would_show():
    """A box a million times brighter is shown with fewer stops; the ordinary one as it is."""
    bright = LiveView(SceneSource(cornell_box(light=(17e6, 12e6, 4e6))), RenderSettings(width=32, height=32))
    assert bright.step() is not None
    assert bright.state.exposure < -10.0 and "exposure" in bright.message
    ordinary = LiveView(SceneSource(cornell_box()), RenderSettings(width=32, height=32))
    ordinary.step()
    assert ordinary.state.exposure == 0.0


# ---- keys and pointer --------------------------------------------------------------------------------------------


class FakeView:
    """A view that only remembers."""

    def __init__(self, scene=None):
        self.scene = scene or lamp_scene()
        self.state = SimpleNamespace(
            camera=EYE, width=300, height=200, edits=Edits(), max_bounces=None, exposure=0.0, time=None
        )
        self.cameras = (EYE, replace(EYE, name="second"))
        self.lights = light_names(self.scene)
        self.source = SimpleNamespace(frames=(1.0, 3.0))
        self.up, self.message = UP, ""

    def change(self, **values):
        vars(self.state).update(values)

    def navigate(self, control):
        self.state.camera = control(self.state.camera)

    def look_through(self, camera):
        self.state.camera = camera

    def say(self, text):
        self.message = text

    def pivot(self):
        return np.array([0.0, 1.0, 0.0])

    def edit_light(self, name, **values):
        edits = self.state.edits
        self.state.edits = edits.with_light(name, replace(edits.light(name), **values))


def test_bounces_step_to_all_and_back():
    """0, 1, ... 9, all; a digit goes straight to its number."""
    view = FakeView()
    controls = Controls(view)
    controls.key("B")
    assert view.state.max_bounces == 9
    controls.key("b")
    assert view.state.max_bounces is None
    controls.key("0")
    controls.key("B")
    assert view.state.max_bounces == 0


def test_dragging_and_walking():
    """Shift pans, left turns, the wheel moves closer, and a key that is held walks for the time it is held."""
    view = FakeView()
    controls = Controls(view)
    controls.press("left", 0.5, 0.5, shift=True)
    controls.drag(0.6, 0.5)
    controls.release()
    assert place(view.state.camera)[0] < 0.0 and place(view.state.camera)[2] == pytest.approx(4.0)
    controls.drag(0.9, 0.9)  # no button is down
    before = place(view.state.camera).copy()
    controls.wheel(1.0)
    assert place(view.state.camera)[2] < before[2]
    controls.key("w")
    controls.tick()
    time.sleep(0.02)
    controls.tick()
    walked = place(view.state.camera)[2]
    controls.key("w", pressed=False)
    time.sleep(0.02)
    controls.tick()
    assert place(view.state.camera)[2] == walked < before[2]


def test_inside_of_a_room_one_looks_around():
    """Dragging in a room turns the head; seen from outside, the room."""
    inside = Camera.look_at((0.2, 1.0, 0.0), (1, 1, 0))
    for camera, looks in ((inside, True), (EYE, False)):
        view = FakeView()
        view.scene = replace(view.scene, meshes=(*view.scene.meshes, quad("/Far", [[-2, -1, 2]] * 4)))
        view.state.camera = camera
        controls = Controls(view)
        assert controls.first_person == looks
        controls.press("left", 0.5, 0.5)
        controls.drag(0.6, 0.5)
        assert (place(view.state.camera) == place(camera)).all() == looks


def test_keys_for_lights_cameras_and_time():
    """Choosing, switching, scaling, moving; cameras in a ring; frames from the first to the last and around."""
    view = FakeView()
    controls = Controls(view)
    assert controls.light == "/Lamp"
    for key in ("]", "]", "Left", "o"):
        controls.key(key)
    edit = view.state.edits.light("/Lamp")
    assert edit.gain == pytest.approx(2.0) and not edit.on and edit.offset[0] < 0.0
    controls.key("l")
    assert controls.light == "/Other"
    controls.key("c")
    assert view.state.camera.name == "second"
    for key, code in ((".", 2.0), (".", 3.0), (".", 1.0), (",", 3.0)):
        controls.key(key)
        assert view.state.time == code


def test_every_key_is_listed_once():
    """No key does two things, and the help has a line for each action."""
    keys = [key for action in ACTIONS for key in action.keys]
    assert len(keys) == len(set(keys)) and not set("wasdqe") & set(keys)
    lines = Controls(FakeView()).help_lines()
    assert all(any(action.help in line for line in lines) for action in ACTIONS)


# ---- stages ------------------------------------------------------------------------------------------------------


STAGE = """#usda 1.0
def Camera "cam" {
    double3 xformOp:translate = (0, 0, 5)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
def Camera "other" {
}
def SphereLight "Lamp" {
    float inputs:intensity = 3
    double3 xformOp:translate = (0, 1, 3)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
def Mesh "Wall" {
    point3f[] points = [(-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0)]
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    uniform token subdivisionScheme = "none"
    color3f[] primvars:displayColor = [(0.5, 0.5, 0.5)]
}
"""


def stage_source(path):
    from warp_ir.usd import StageReader

    return StageSource(lambda: StageReader(path, motion_blur=False))


def touch(path, text):
    """Rewrites a file, later than before by the clock of the file system."""
    import os

    path.write_text(text, encoding="utf-8")
    stamp = path.stat().st_mtime_ns + 1_000_000_000
    os.utime(path, ns=(stamp, stamp))


@pytest.mark.extended
def test_a_changed_stage_is_read_again(tmp_path):
    """A brighter light in the file is brighter in the view, whose camera stays; a broken file changes nothing."""
    layer, root = tmp_path / "layer.usda", tmp_path / "root.usda"
    layer.write_text(STAGE, encoding="utf-8")
    root.write_text("#usda 1.0\n(subLayers = [@./layer.usda@])\n", encoding="utf-8")
    view = view_of(stage_source(root), iterations=2)
    settle(view)
    before = view._radiance.mean()
    view.navigate(lambda camera: navigation.move(camera, 0.0, 0.0, 0.1))
    camera = view.state.camera
    touch(layer, STAGE.replace("intensity = 3", "intensity = 30"))
    time.sleep(0.6)
    settle(view)
    assert view._radiance.mean() == pytest.approx(10.0 * before, rel=0.1) and view.state.camera is camera
    bright = view._radiance.mean()
    touch(layer, "#usda 1.0\ndef Mesh {{{ broken")
    time.sleep(0.6)
    view.step()
    assert view.message.startswith("not loaded:") and "layer.usda" in view.message
    view.change(max_bounces=0)
    settle(view)
    assert view._radiance.mean() == pytest.approx(bright, rel=0.3)
    touch(layer, STAGE)
    time.sleep(0.6)
    view.change(max_bounces=None)
    settle(view)
    assert view._radiance.mean() == pytest.approx(before, rel=0.1)


def test_saved_edits_give_the_picture_of_the_view(tmp_path):
    """The layer, used as a session layer, loads as the edited scene: camera, light and colour."""
    path = tmp_path / "stage.usda"
    path.write_text(STAGE, encoding="utf-8")
    view = view_of(stage_source(path), iterations=2)
    next_frame(view)
    view.navigate(lambda camera: navigation.orbit(camera, np.zeros(3), UP, 0.3, 0.2))
    view.edit_light("/Lamp", gain=2.0, offset=(0.5, 0.0, 1.0))
    view.edit_color("/Wall", (0.1, 0.2, 0.3))
    edited = replace(view.state.edits.apply(view.scene), camera=view.state.camera)
    next_frame(view)
    view.save_edits(tmp_path / "edits.usda")
    settle(view)
    assert "--session-layer" in view.message and ";" not in view.message
    loaded = load_usd(path, session_layer=tmp_path / "edits.usda")
    assert loaded.camera.world_from_camera == pytest.approx(edited.camera.world_from_camera)
    assert loaded.camera.window == pytest.approx(edited.camera.window)
    assert loaded.lights[0].radiance == pytest.approx(edited.lights[0].radiance)
    assert loaded.lights[0].world_from_light == pytest.approx(edited.lights[0].world_from_light)
    wall = loaded.materials[int(loaded.meshes[0].material[0])]
    assert wall.albedo == pytest.approx((0.1, 0.2, 0.3))


def test_a_layer_says_which_camera_it_needs(tmp_path):
    """Edits of a camera that is not rendered by default: the message names the flag; a new camera is rendered."""
    path = tmp_path / "stage.usda"
    path.write_text(STAGE, encoding="utf-8")
    source = stage_source(path)
    first, other = source.cameras(None)
    assert source.save_edits(tmp_path / "a.usda", None, first, Edits()) == []
    assert source.save_edits(tmp_path / "b.usda", None, other, Edits()) == ["render it with --camera /other"]
    assert source.save_edits(tmp_path / "c.usda", None, EYE, Edits()) == []
    loaded = load_usd(path, session_layer=tmp_path / "c.usda").camera
    assert loaded.name == "/main_cam" and loaded.world_from_camera == pytest.approx(EYE.world_from_camera)


@pytest.mark.parametrize("name", ["cornell_box", "light_types", "two_rooms"])
def test_saved_edits_of_the_repositorys_stages(tmp_path, name):
    """All lights twice as strong, all materials another colour, and a camera elsewhere, by a layer."""
    from warp_ir.usd import StageReader

    source = StageSource(lambda: StageReader(SCENES / f"{name}.usda", motion_blur=False))
    scene = source.read(None)
    edits = Edits()
    for light in light_names(scene):
        edits = edits.with_light(light, LightEdit(gain=2.0))
    for material in scene.materials:
        edits = edits.with_color(material.name, (0.2, 0.4, 0.6)) if material.name.startswith("/") else edits
    camera = navigation.move(scene.camera, 0.1, 0.0, 0.0)
    assert source.save_edits(tmp_path / "edits.usda", None, camera, edits) == []
    loaded = load_usd(SCENES / f"{name}.usda", session_layer=tmp_path / "edits.usda")
    edited = edits.apply(scene)
    assert loaded.camera.world_from_camera == pytest.approx(camera.world_from_camera)
    assert [light.name for light in loaded.lights] == [light.name for light in edited.lights]
    for one, other in zip(loaded.lights, edited.lights, strict=True):
        assert one.radiance == pytest.approx(other.radiance, rel=1e-5)
        assert one.world_from_light == pytest.approx(other.world_from_light)
    by_name = {material.name: material for material in loaded.materials}
    for material in edited.materials:
        if material.name.startswith("/"):
            assert by_name[material.name].albedo == pytest.approx(material.albedo)
            assert by_name[material.name].emission == pytest.approx(material.emission, rel=1e-5)


def test_pictures_are_saved_as_they_are_shown(tmp_path):
    """The file has the exposure of the view; the number of the name goes up where a file exists."""
    view = view_of(iterations=2)
    frame = settle(view)
    controls = Controls(view, picture=tmp_path / "a.png")
    for _ in range(2):
        controls.key("F2")
        view.step()
    saved = read_image(tmp_path / "a_2.png")
    opaque = saved[..., 3] == 1.0  # elsewhere the colours of the file are divided by alpha
    # The file is rounded once, the window by a half-precision float as well.
    assert np.abs(255.0 * saved[..., :3] - frame.pixels)[opaque].max() <= 1.01 and opaque.mean() > 0.2
    with pytest.raises(InputError):
        view.source.save_edits(tmp_path / "a.usda", None, None, Edits())
