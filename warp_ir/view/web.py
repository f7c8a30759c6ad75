"""A view for browsers: a server of trame that sends pictures and receives events."""

import asyncio
import base64
import contextlib
import io
import math
import os
import secrets
import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from warp_ir.image.tonemap import TONEMAPS, srgb_from_linear, srgb_to_linear
from warp_ir.scene import InputError
from warp_ir.settings import ESTIMATOR_NAMES
from warp_ir.view.controls import Controls
from warp_ir.view.display import Pixels
from warp_ir.view.session import Frame, LiveView

_QUALITY = 90
"""Quality of the JPEG pictures that are sent, 0 to 100."""
_TICK_SECONDS = 0.02
_TOKEN_BYTES = 18
_KEYS = {f"Arrow{name}": name for name in ("Left", "Right", "Up", "Down")}
"""Our names of keys for those of browsers."""
_ALL_BOUNCES = 10
"""Position of the slider for all bounces."""
_LARGEST = 4096
"""Largest side of a page's picture [pixels]."""
_LOCAL = ("127.0.0.1", "localhost", "::1")
_PLACE = "[$event.offsetX / $event.currentTarget.clientWidth, $event.offsetY / $event.currentTarget.clientHeight"
"""The start of the arguments of an event of the pointer: its place in the picture."""
_STYLE = (
    "html, body { background: black; overflow: hidden; margin: 0 }"
    " .picture { width: 100vw; height: 100vh; display: block; outline: none; touch-action: none; user-select: none }"
    " .text { position: fixed; left: 8px; color: white; background: rgba(0, 0, 0, 0.6); font: 12px monospace;"
    " padding: 4px; white-space: pre; pointer-events: none }"
    " .panel { position: fixed; right: 8px; top: 8px; width: 250px; color: white; background: rgba(0, 0, 0, 0.6);"
    " font: 12px sans-serif; padding: 8px; max-height: 95vh; overflow-y: auto }"
    " .panel > * { width: 100%; margin-bottom: 4px }"
    " .panel input, .panel select, .panel button { color: white; background: #333; width: 100% }"
)


def jpeg(pixels: Pixels) -> str:
    """A picture as the data URL of a JPEG."""
    import imageio.v3 as imageio

    data = io.BytesIO()
    imageio.imwrite(data, pixels, extension=".jpg", quality=_QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(data.getvalue()).decode("ascii")


class ViewServer:
    """A `LiveView` for browsers, all of which share it."""

    def __init__(self, view: LiveView, controls: Controls, title: str) -> None:
        """Describes the page.

        Raises:
            InputError: The extra `view` is not installed.
        """
        try:
            import imageio.v3  # noqa: F401  # writes the pictures
            from trame.app import get_server
        except ImportError:
            raise InputError("--web: needs trame; pip install 'warp-ir[view]'") from None
        self.view, self.controls = view, controls
        self._frame: Frame | None = None
        self._new: Frame | None = None
        self._error: BaseException | None = None
        self.server: Any = get_server(f"warp_ir_view_{id(self)}", client_type="vue3")
        self._describe(title)

    def _describe(self, title: str) -> None:
        from trame.ui.html import DivLayout
        from trame.widgets import client, html

        server, view, controls = self.server, self.view, self.controls
        state, controls.show_panel = view.state, True
        server.state.update(
            {
                "trame__title": title,
                "picture": "",
                "status": "starting",
                "help": "",
                "panel": controls.show_panel,
                "exposure": state.exposure,
                "bounces": _bounces(state.max_bounces),
                "gain": 0.0,
                "estimator": state.estimator,
                "tonemap": state.tonemap,
                "light": controls.light,
                "camera": state.camera.name,
                "color": "#000000",
                "surface": "",
                "time": self._time(),
            }
        )
        place, shift = _PLACE + "]", _PLACE + ", $event.button, $event.shiftKey, $event.ctrlKey]"
        with DivLayout(server) as layout:
            layout.root.style = "width: 100vw; height: 100vh"
            client.Style(_STYLE)
            html.Img(
                src=("picture",),
                classes="picture",
                draggable="false",
                tabindex="0",
                raw_attrs=[
                    # The page's keys reach the picture alone, so that typing into a field does not walk.
                    '@vue:mounted="({ el }) => { el.focus();'
                    " const tell = () => trigger('resize', [window.innerWidth, window.innerHeight]);"
                    " window.addEventListener('resize', tell); tell() }\"",
                    f"""@pointerdown="$event.currentTarget.setPointerCapture($event.pointerId);"""
                    f"""$event.currentTarget.focus(); trigger('press', {shift})" """,
                    f"""@pointermove="$event.buttons && trigger('drag', {place})" """,
                    """@pointerup="trigger('release', [])" """,
                    """@wheel.prevent="trigger('wheel', [-Math.sign($event.deltaY)])" """,
                    """@contextmenu.prevent="" """,
                    """@keydown.prevent="trigger('key', [$event.key, true])" """,
                    """@keyup.prevent="trigger('key', [$event.key, false])" """,
                    """@blur="trigger('blur', [])" """,
                ],
            )
            html.Div("{{ status }}", classes="text", style="bottom: 8px", raw_attrs=['id="status"'])
            html.Div("{{ help }}", classes="text", style="top: 8px", v_if="help")
            with html.Div(classes="panel", v_if="panel"):
                self._slider("exposure", -8, 8, 0.25)
                self._slider("bounces", 0, _ALL_BOUNCES, 1)
                self._choice("estimator", ESTIMATOR_NAMES)
                self._choice("tonemap", TONEMAPS)
                self._choice("camera", tuple(camera.name for camera in view.cameras))
                if view.lights:
                    self._choice("light", view.lights)
                    self._slider("gain", -6, 6, 0.25)
                if view.source.frames is not None:
                    self._slider("time", *view.source.frames, 1)
                html.Div("{{ surface }}", v_if="surface")
                html.Input(type="color", v_model=("color",), v_if="surface")
                for text, key in (
                    ("auto exposure", "x"),
                    ("filter", "n"),
                    ("VPLs", "v"),
                    ("light on, off", "o"),
                    ("first person, orbit", "f"),
                    ("save picture", "F2"),
                    ("save edits", "F3"),
                    ("help", "F1"),
                    ("hide this (Tab)", "Tab"),
                ):
                    html.Button(text, click=f"trigger('key', ['{key}', true])")
        self._react()

    def _slider(self, name: str, low: float, high: float, step: float) -> None:
        from trame.widgets import html

        label = f"{name} {{{{ {name} }}}}" if name != "bounces" else f"bounces {{{{ {name} > 9 ? 'all' : {name} }}}}"
        html.Div(label)
        html.Input(type="range", min=str(low), max=str(high), step=str(step), v_model_number=(name,))

    def _choice(self, name: str, values: tuple[str, ...]) -> None:
        from trame.widgets import html

        html.Div(name)
        with html.Select(v_model=(name,)):
            for value in dict.fromkeys(values):
                html.Option(value, value=value)

    def _react(self) -> None:
        """Says what the page's events and fields do."""
        controls = self.controls
        for name, event in (
            ("press", self._press),
            ("drag", controls.drag),
            ("release", controls.release),
            ("wheel", controls.wheel),
            ("blur", controls.forget_keys),
            ("resize", lambda width, height: self.view.resize(min(int(width), _LARGEST), min(int(height), _LARGEST))),
            ("key", self._key),
        ):
            self.server.controller.trigger(name)(event)
        for field in ("exposure", "bounces", "estimator", "tonemap", "camera", "light", "gain", "time", "color"):
            self.server.state.change(field)(lambda field=field, **page: self._take_field(field, page[field]))

    def _press(self, column: float, row: float, button: int = 0, shift: bool = False, control: bool = False) -> None:
        if control:
            self.controls.pick(column, row)
        else:
            self.controls.press(("left", "middle", "right")[min(int(button), 2)], column, row, shift=bool(shift))

    def _key(self, name: str, pressed: bool = True) -> None:
        if name != "Escape":  # the server is not for a page to stop
            self.controls.key(_KEYS.get(name, name), pressed=bool(pressed))

    def _take_field(self, name: str, value: Any) -> None:
        """A field of the page has changed: by its user, or because the view has."""
        view, controls, state = self.view, self.controls, self.view.state
        if name == "exposure" and abs(float(value) - state.exposure) > 0.01:
            view.change(exposure=min(max(float(value), -100.0), 100.0), auto_exposure=False)
        elif name == "bounces" and float(value) != _bounces(state.max_bounces):
            view.change(max_bounces=None if float(value) >= _ALL_BOUNCES else max(int(value), 0))
        elif (name == "estimator" and value in ESTIMATOR_NAMES) or (name == "tonemap" and value in TONEMAPS):
            view.change(**{name: value})
        elif name == "camera" and value != state.camera.name:
            chosen = next((each for each in view.cameras if each.name == value), None)
            if chosen is not None:
                view.look_through(chosen)
        elif name == "light" and value in view.lights:
            controls.light = value
        elif name == "gain" and controls.light:
            gain = 2.0 ** min(max(float(value), -20.0), 20.0)
            if abs(math.log2(gain) - _stops(state.edits.light(controls.light).gain)) > 0.01:
                view.edit_light(controls.light, gain=gain, on=True)
        elif name == "time" and view.source.frames is not None and float(value) != self._time():
            view.change(time=float(value))
        elif name == "color" and controls.surface and len(value) == 7 and value != _hex(controls.color):
            red, green, blue = srgb_to_linear(np.array([int(value[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0).tolist()
            controls.paint((red, green, blue))

    def _time(self) -> float:
        """The time code that the page shows."""
        code, frames = self.view.state.time, self.view.source.frames
        return float(code) if isinstance(code, float | int) else 0.0 if frames is None else frames[0]

    # Serving

    async def serve(self, host: str, port: int, say: Callable[[str], None]) -> None:
        """Serves the view until it is closed."""
        server = self.server
        local = host in _LOCAL
        token = None if local else secrets.token_urlsafe(_TOKEN_BYTES)
        with _arguments(token):
            task = server.start(
                port=port,
                host=host,
                exec_mode="task",
                open_browser=False,
                show_connection_info=False,
                disable_logging=True,
                thread=True,
                timeout=0,
            )
        await server.ready
        address = f"http://{f'[{host}]' if ':' in host else host}:{server.port}/"
        say(f"{address}{'' if token is None else f'?secret={token}'}")
        worker = threading.Thread(target=self._work, name="view", daemon=True)
        worker.start()
        try:
            while not (self.controls.closed or task.done() or self._error is not None):
                self.controls.tick()
                self._send()
                await asyncio.sleep(_TICK_SECONDS)
        finally:
            self.view.close()
            await asyncio.to_thread(worker.join)
            await server.stop()
        if self._error is not None:
            raise self._error

    def _work(self) -> None:
        try:
            self.view.run(self._take)
        except BaseException as error:  # raised again by `serve`
            self._error = error

    def _take(self, frame: Frame) -> None:
        self._new = frame

    def _send(self) -> None:
        """Sends the newest picture and the texts, if they have changed."""
        frame, self._new = self._new, None
        controls, state = self.controls, self.view.state
        if frame is not None:
            self._frame = frame
        with self.server.state as page:
            if frame is not None:
                page.picture = jpeg(frame.pixels)
            page.status = "\n".join(controls.status(self._frame))
            page.help = "\n".join(controls.help_lines()) if controls.show_help else ""
            page.panel = controls.show_panel
            page.exposure = round(state.exposure, 2)
            page.bounces = _bounces(state.max_bounces)
            page.estimator, page.tonemap, page.camera = state.estimator, state.tonemap, state.camera.name
            page.light, page.surface = controls.light, controls.surface
            page.gain = round(_stops(state.edits.light(controls.light).gain), 2)
            page.color, page.time = _hex(controls.color), self._time()


@contextlib.contextmanager
def _arguments(token: str | None) -> Any:
    """Keeps the command's own arguments from trame, which would read them, and hands it the token by a file."""
    import sys
    import tempfile

    before = sys.argv
    with tempfile.TemporaryDirectory() as folder:
        sys.argv = [before[0]]
        if token is not None:
            path = os.path.join(folder, "token")
            with open(os.open(path, os.O_CREAT | os.O_WRONLY, 0o600), "w", encoding="ascii") as file:
                file.write(token)
            sys.argv += ["--authKeyFile", path]
        try:
            yield
        finally:
            sys.argv = before


def _bounces(limit: int | None) -> int:
    """Position of the slider for a number of bounces."""
    return _ALL_BOUNCES if limit is None else min(limit, _ALL_BOUNCES - 1)


def _stops(gain: float) -> float:
    return math.log2(max(gain, 1e-6))


def _hex(color: tuple[float, float, float]) -> str:
    """A linear colour as the page's field shows it."""
    return "#" + "".join(f"{round(255.0 * x):02x}" for x in srgb_from_linear(np.array(color)).tolist())


def serve_view(
    view: LiveView, controls: Controls, title: str, host: str, port: int, say: Callable[[str], None]
) -> None:
    """Serves a view to browsers until it is closed; `say` is told the address.

    Raises:
        InputError: The extra `view` is not installed.
    """
    asyncio.run(ViewServer(view, controls, title).serve(host, port, say))
