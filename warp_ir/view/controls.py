"""Keys and the pointer, whatever interface they come from: what they do to a `LiveView`, and the texts beside it."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from warp_ir.image.tonemap import TONEMAPS
from warp_ir.scene import Color, InputError
from warp_ir.settings import ESTIMATOR_NAMES
from warp_ir.view import navigation
from warp_ir.view.session import Frame, LiveView

_WALK = {"w": (0, 0, 1), "s": (0, 0, -1), "a": (-1, 0, 0), "d": (1, 0, 0), "q": (0, -1, 0), "e": (0, 1, 0)}
"""Right, up, forward of the keys that walk while they are held."""
_WALK_SPEED = 0.15
"""Extents of the scene per second."""
_FAST = 4.0
_HELD_SECONDS = 0.1
"""Longest step in time of a walk [s]: a pause of the program must not become a leap."""
_ZOOM = 0.85
"""Factor on the distance for one notch of the wheel."""
_DIRECTIONS = {
    "Left": (-1, 0, 0),
    "Right": (1, 0, 0),
    "Up": (0, 1, 0),
    "Down": (0, -1, 0),
    "PageUp": (0, 0, 1),
    "PageDown": (0, 0, -1),
}
"""Right, up and forward of the keys that move a light."""
_MOST_BOUNCES = 9
"""Largest number of bounces that is stepped to; the next is all of them."""
_LIGHT_STEP = 0.02
"""Distance that a light is moved by a key, in extents of the scene."""
_GAIN_STEP = math.sqrt(2.0)


@dataclass(frozen=True)
class Action:
    """Something that a key does."""

    keys: tuple[str, ...]
    help: str
    run: "Callable[[Controls, str], None]"


@dataclass
class Controls:
    """The state of an interface that is no part of the picture, and the meaning of its events.

    Positions are fractions of the picture from its upper left corner. Keys are characters, or one of Left, Right, Up,
    Down, PageUp, PageDown, Home, Tab, Escape, F1, F2, F3.
    """

    view: LiveView
    picture: Path = Path("view.png")
    """File that the picture is saved to."""
    layer: Path = Path("view_edits.usda")
    """File that the edits are saved to."""
    first_person: bool = False
    """Whether dragging turns the head, not the scene: at first where the camera is inside, and orbits end in walls."""
    show_help: bool = False
    show_panel: bool = False
    """Whether sliders are shown."""
    light: str = ""
    """The light that is edited; "" if there is none."""
    surface: str = ""
    """What the colour that is edited belongs to; "": nothing was picked."""
    color: Color = (0.0, 0.0, 0.0)
    closed: bool = False
    _held: dict[str, float] = field(default_factory=dict)  # keys that walk, and their speed
    _drag: "tuple[str, float, float, np.ndarray] | None" = None  # what is dragged, the last place, the pivot
    _ticked: float = field(default_factory=time.perf_counter)

    def __post_init__(self) -> None:
        self.light = next(iter(self.view.lights), "")
        lower, upper = self.view.scene.bounds()
        eye = self.view.state.camera.world_from_camera[:3, 3]
        self.first_person = bool((eye > lower).all() and (eye < upper).all())

    # The pointer

    def press(self, button: str, column: float, row: float, *, shift: bool = False) -> None:
        """A button ("left", "middle" or "right") goes down: left turns, middle or Shift pans, right moves closer."""
        what = "pan" if button == "middle" or (shift and button == "left") else "dolly" if button == "right" else "turn"
        self._drag = what, column, row, self.view.pivot()

    def drag(self, column: float, row: float) -> None:
        """The pointer has moved."""
        if self._drag is None:
            return
        what, x, y, pivot = self._drag
        state = self.view.state
        aspect = state.width / state.height
        right, upwards = (column - x) * aspect, y - row  # in heights of the picture
        self._drag = what, column, row, pivot
        up = self.view.up
        if what == "pan":
            self.view.navigate(lambda camera: navigation.pan(camera, pivot, -right, -upwards))
        elif what == "dolly":
            self.view.navigate(lambda camera: navigation.dolly(camera, pivot, math.exp(-2.0 * upwards)))
        elif self.first_person:
            self.view.navigate(lambda camera: navigation.look_around(camera, up, right, upwards))
        else:
            turn = math.pi
            self.view.navigate(lambda camera: navigation.orbit(camera, pivot, up, turn * right, turn * upwards))

    def release(self) -> None:
        """The button goes up."""
        self._drag = None

    def wheel(self, notches: float) -> None:
        """The wheel turns; upwards is closer."""
        pivot = self.view.pivot()
        self.view.navigate(lambda camera: navigation.dolly(camera, pivot, _ZOOM**notches))

    def pick(self, column: float, row: float) -> None:
        """Chooses the surface at a place, to edit its colour."""
        found = self.view.surface(column, row)
        if found is None:
            self.surface = ""
            self.view.say("no surface there")
        else:
            self.surface, self.color = found
            self.view.say(f"surface {self.surface}, albedo {' '.join(f'{x:.2f}' for x in self.color)}")

    def paint(self, color: Color) -> None:
        """Gives the chosen surface another albedo."""
        if self.surface:
            self.color = color
            self.view.edit_color(self.surface, color)

    # Keys

    def key(self, name: str, *, pressed: bool = True) -> None:
        """A key goes down or up. What it does is in `ACTIONS`; some walk as long as they are down."""
        lower = name.lower()
        if lower in _WALK and len(name) == 1:
            if pressed:
                if lower not in self._held:
                    self._ticked = time.perf_counter()
                self._held[lower] = 1.0 if name == lower else _FAST
            else:
                self._held.pop(lower, None)
            return
        action = _BY_KEY.get(name)
        if pressed and action is not None:
            try:
                action.run(self, name)
            except InputError as error:
                self.view.say(str(error))

    def tick(self) -> None:
        """Goes on walking; to be called some ten times a second or more."""
        now = time.perf_counter()
        seconds, self._ticked = min(now - self._ticked, _HELD_SECONDS), now
        if not self._held:
            return
        step = _WALK_SPEED * (self.view.scene.extent or 1.0) * seconds
        held = [np.multiply(_WALK[key], speed) for key, speed in self._held.items()]
        right, upwards, forward = (step * np.sum(held, axis=0)).tolist()
        self.view.navigate(lambda camera: navigation.walk(camera, self.view.up, right, upwards, forward))

    def forget_keys(self) -> None:
        """No key is down any more: the window has lost the focus."""
        self._held.clear()

    # What the actions do

    def step_bounces(self, step: int) -> None:
        """One bounce more or less; after `_MOST_BOUNCES` come all."""
        now = self.view.state.max_bounces
        value = min(_MOST_BOUNCES + 1 if now is None else now, _MOST_BOUNCES + 1) + step
        self.view.change(max_bounces=None if value > _MOST_BOUNCES else max(value, 0))

    def step_exposure(self, stops: float) -> None:
        """Brighter or darker, by hand from now on."""
        state = self.view.state
        self.view.change(exposure=min(max(state.exposure + stops, -100.0), 100.0), auto_exposure=False)

    def step_camera(self, step: int) -> None:
        """Looks through the next camera of the stage."""
        cameras, now = self.view.cameras, self.view.state.camera
        at = next((k for k, camera in enumerate(cameras) if camera.name == now.name), -step)
        self.view.look_through(cameras[(at + step) % len(cameras)])

    def step_light(self, step: int) -> None:
        """Chooses the next light."""
        lights = self.view.lights
        if lights:
            at = lights.index(self.light) if self.light in lights else -step
            self.light = lights[(at + step) % len(lights)]
        self.view.say(f"light {self.light}" if lights else "there is no light to choose")

    def scale_light(self, factor: float) -> None:
        """Makes the chosen light stronger or weaker."""
        if self.light:
            self.view.edit_light(self.light, gain=self.view.state.edits.light(self.light).gain * factor, on=True)

    def switch_light(self) -> None:
        """Turns the chosen light on or off."""
        if self.light:
            self.view.edit_light(self.light, on=not self.view.state.edits.light(self.light).on)

    def move_light(self, right: float, upwards: float, forward: float) -> None:
        """Moves the chosen light along the axes of the camera, in steps."""
        if self.light not in {light.name for light in self.view.scene.lights}:
            self.view.say(f"{self.light or 'there is no light; it'} cannot be moved")
            return
        axes = self.view.state.camera.world_from_camera[:3, :3]
        step = _LIGHT_STEP * (self.view.scene.extent or 1.0) * (axes @ (right, upwards, -forward))
        x, y, z = (np.array(self.view.state.edits.light(self.light).offset) + step).tolist()
        self.view.edit_light(self.light, offset=(x, y, z))

    def step_time(self, step: int) -> None:
        """The next frame of the stage."""
        frames = self.view.source.frames
        if frames is None:
            self.view.say("the stage names no frames")
            return
        first, last = frames
        now = self.view.state.time
        value = (now if isinstance(now, float | int) else first) + step
        value = first if value > last else last if value < first else value
        self.view.change(time=float(value))
        self.view.say(f"time {value:g}")

    def frame_scene(self) -> None:
        """Moves the camera so that it sees the whole scene."""
        lower, upper = self.view.scene.bounds()
        self.view.navigate(lambda camera: navigation.framed(camera, lower, upper))

    def save_picture(self) -> None:
        """Writes the picture to a file that does not exist yet."""
        self.view.save_picture(self.picture)

    def save_edits(self) -> None:
        """Writes camera and edits to a file that does not exist yet."""
        self.view.save_edits(self.layer)

    # Texts

    def status(self, frame: Frame | None) -> list[str]:
        """Lines about the picture and the chosen things."""
        state = self.view.state
        bounces = "all" if state.max_bounces is None else str(state.max_bounces)
        size = f"{state.width} x {state.height}"
        lines = [f"{size}  {frame.status if frame else 'starting'}"]
        mode = f"{state.estimator}{'' if state.filter or state.estimator != 'vpl' else ' without filter'}"
        auto = " (auto)" if state.auto_exposure else ""
        lines.append(f"{mode}, bounces {bounces}, exposure {state.exposure:+.2g}{auto}, {state.tonemap}")
        if state.edits.lights:
            edit = state.edits.light(self.light)
            lines.append(f"light {self.light} x{edit.gain:.2g}{'' if edit.on else ' off'}")
        lines.append(self.view.message if self.view.message else "F1: help")
        return lines

    def help_lines(self) -> list[str]:
        """What the pointer and the keys do."""
        drag = "look around" if self.first_person else "orbit"
        lines = [
            ("drag", f"{drag}; Shift, middle button: pan"),
            ("wheel, right drag", "closer, farther"),
            ("Ctrl click, p", "choose a surface, to edit its colour"),
            ("w a s d, q e", "walk, down and up; Shift: faster"),
        ]
        names = {tuple("0123456789"): "0 ... 9", tuple(_DIRECTIONS): "arrows, PageUp/Down"}
        lines += [(names.get(action.keys, " ".join(action.keys)), action.help) for action in ACTIONS]
        return [f"{key:<20}{text}" for key, text in lines]


def _next(names: tuple[str, ...], name: str) -> str:
    return names[(names.index(name) + 1) % len(names)]


def _toggle(name: str) -> "Callable[[Controls, str], None]":
    return lambda controls, _: controls.view.change(**{name: not getattr(controls.view.state, name)})


def _call(method: str, *values: float) -> "Callable[[Controls, str], None]":
    return lambda controls, _: getattr(controls, method)(*values)


def _set(name: str, value: bool | None = None) -> "Callable[[Controls, str], None]":
    return lambda controls, _: setattr(controls, name, not getattr(controls, name) if value is None else value)


def _stage_camera(controls: Controls, _: str) -> None:
    name = controls.view.state.camera.name
    cameras = controls.view.cameras
    controls.view.look_through(next((camera for camera in cameras if camera.name == name), cameras[0]))


ACTIONS = (
    Action(("f",), "first person, or orbit", _set("first_person")),
    Action(("c", "C"), "next, previous camera of the stage", lambda c, key: c.step_camera(1 if key == "c" else -1)),
    Action(("Home",), "back to the camera as it is in the stage", _stage_camera),
    Action(("z",), "see the whole scene", _call("frame_scene")),
    Action(("+", "-"), "exposure, half a stop", lambda c, key: c.step_exposure(0.5 if key == "+" else -0.5)),
    Action(("x",), "automatic exposure", _toggle("auto_exposure")),
    Action(("t",), "tone curve", lambda c, _: c.view.change(tonemap=_next(TONEMAPS, c.view.state.tonemap))),
    Action(tuple("0123456789"), "that many indirect bounces", lambda c, key: c.view.change(max_bounces=int(key))),
    Action(("b", "B"), "one bounce more, less; after 9: all", lambda c, key: c.step_bounces(1 if key == "b" else -1)),
    Action(("m",), "estimator", lambda c, _: c.view.change(estimator=_next(ESTIMATOR_NAMES, c.view.state.estimator))),
    Action(("n",), "noise filter", _toggle("filter")),
    Action(("v",), "virtual point lights", _toggle("vpls")),
    Action(("l", "L"), "choose next, previous light", lambda c, key: c.step_light(1 if key == "l" else -1)),
    Action(("o",), "light on, off", _call("switch_light")),
    Action(
        ("]", "["), "light stronger, weaker", lambda c, key: c.scale_light(_GAIN_STEP if key == "]" else 1 / _GAIN_STEP)
    ),
    Action(tuple(_DIRECTIONS), "move the light", lambda c, key: c.move_light(*_DIRECTIONS[key])),
    Action((".", ","), "next, previous frame", lambda c, key: c.step_time(1 if key == "." else -1)),
    Action(("F2",), "save the picture", _call("save_picture")),
    Action(("F3",), "save camera, lights and colours for --session-layer", _call("save_edits")),
    Action(("F1", "h"), "show or hide this help", _set("show_help")),
    Action(("Tab",), "show or hide the sliders", _set("show_panel")),
    Action(("Escape",), "close", _set("closed", True)),
)
"""All keys but those that walk."""
_BY_KEY = {key: action for action in ACTIONS for key in action.keys}
_BY_KEY["="] = replace(_BY_KEY["+"], run=_call("step_exposure", 0.5))  # the same key without Shift
