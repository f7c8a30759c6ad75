"""The live view as a program, with real events: in a window under Xvfb, in a browser, and without either."""

import ctypes
import ctypes.util
import importlib.util
import json
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest

from tests.stages import SCENES
from warp_ir.image.io import read_image

pytestmark = pytest.mark.extended

BOX = SCENES / "cornell_box.usda"
needs_xvfb = pytest.mark.skipif(not shutil.which("Xvfb"), reason="needs Xvfb")
needs_events = pytest.mark.skipif(
    not (shutil.which("Xvfb") and shutil.which("xdotool")), reason="needs Xvfb and xdotool"
)


def wait_for(what, seconds=40.0):
    """Waits until a function returns something true, and returns that."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        result = what()
        if result is not None and result is not False:
            return result
        time.sleep(0.1)
    raise AssertionError(f"not within {seconds} s")


@contextmanager
def x_server():
    """An X server without a screen; yields its process and the name of its display."""
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "640x480x24", "-noreset"]
    process = subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL)
    try:
        os.close(write)
        assert select.select([read], [], [], 20.0)[0], "Xvfb does not start"
        yield process, ":" + os.read(read, 16).decode().strip()
    finally:
        os.close(read)
        process.kill()
        process.wait()


@pytest.fixture
def display():
    with x_server() as (_, name):
        yield name


@contextmanager
def running(folder, *arguments, display=None):
    """The command, started in a folder."""
    environ = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")}
    environ |= {"DISPLAY": display} if display else {}
    environ["PYTHONPATH"] = os.pathsep.join([str(SCENES.parent), environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-m", "warp_ir", *map(str, arguments)]
    # A parent that ignores Ctrl-C, such as a job in the background, must not pass this on.
    process = subprocess.Popen(
        command, cwd=folder, env=environ, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def ended(process, seconds=40.0):
    """Exit code and messages of a command that ends by itself."""
    _, errors = process.communicate(timeout=seconds)
    return process.returncode, errors.strip()


def xdotool(display, *words):
    done = subprocess.run(
        ["xdotool", *map(str, words)], env={**os.environ, "DISPLAY": display}, capture_output=True, text=True
    )
    return done.stdout.strip()


def window_of(display, process):
    def find():
        assert process.poll() is None, process.communicate()[1]
        return next(iter(xdotool(display, "search", "--onlyvisible", "--name", "warp-ir").split()), None)

    window = wait_for(find)
    xdotool(display, "windowfocus", window)
    return window


def ask_to_close(display, window):
    """What a click on a window's close button sends (WM_DELETE_WINDOW)."""
    xlib = ctypes.CDLL(ctypes.util.find_library("X11"))
    xlib.XOpenDisplay.restype = xlib.XInternAtom.restype = ctypes.c_void_p
    server = ctypes.c_void_p(xlib.XOpenDisplay(display.encode()))
    atoms = [xlib.XInternAtom(server, name, 0) for name in (b"WM_PROTOCOLS", b"WM_DELETE_WINDOW")]
    event = (ctypes.c_long * 24)()  # XClientMessageEvent
    event[0], event[4], event[5], event[6], event[7] = 33, int(window), atoms[0], 32, atoms[1]
    xlib.XSendEvent(server, ctypes.c_ulong(int(window)), 0, ctypes.c_long(0), event)
    xlib.XCloseDisplay(server)


def saved(path):
    """A picture once it is written."""
    return wait_for(lambda: read_image(path)[..., :3] if path.exists() else None)


@needs_events
def test_a_window_orbits_resizes_and_closes(tmp_path, display):
    """A drag turns the box, another size renders another size, and the close button ends the command with 0."""
    with running(tmp_path, "view", BOX, "--res", 160, 120, "--picture", "a.png", display=display) as process:
        window = window_of(display, process)
        time.sleep(2.0)
        xdotool(display, "key", "--window", window, "F2")
        before = saved(tmp_path / "a.png")
        xdotool(display, "mousemove", "--window", window, 80, 60, "mousedown", 1)
        for step in range(1, 6):
            xdotool(display, "mousemove", "--window", window, 80 + 6 * step, 60)
        xdotool(display, "mouseup", 1)
        time.sleep(2.0)
        xdotool(display, "key", "--window", window, "F2")
        after = saved(tmp_path / "a_2.png")
        assert before.shape == after.shape == (120, 160, 3)
        assert before.mean() > 0.05 and np.abs(before - after).mean() > 0.05
        xdotool(display, "windowsize", window, 90, 70)
        time.sleep(2.0)
        xdotool(display, "key", "--window", window, "F2")
        assert saved(tmp_path / "a_3.png").shape == (70, 90, 3)
        xdotool(display, "windowsize", window, 1, 1)
        time.sleep(1.0)
        ask_to_close(display, window)
        assert ended(process) == (0, "")


@needs_events
def test_what_f3_saves_renders_what_the_window_shows(tmp_path, display):
    """`render --session-layer` of the edits of a window: the light is on by half, the view as in the window."""
    with running(tmp_path, "view", BOX, "--res", 64, 64, "--edits", "e.usda", display=display) as process:
        window = window_of(display, process)
        time.sleep(1.0)
        for key in ("bracketleft", "bracketleft", "w"):
            xdotool(display, "key", "--window", window, key)
        xdotool(display, "key", "--window", window, "F3")
        layer = wait_for(lambda: (tmp_path / "e.usda").read_text() if (tmp_path / "e.usda").exists() else None)
        xdotool(display, "key", "--window", window, "Escape")
        assert ended(process) == (0, "")
    assert "inputs:intensity = 22.5" in layer and "main_cam" in layer
    with running(tmp_path, "render", BOX, "b.npy", "-w", 32, "--iterations", 2, "--session-layer", "e.usda") as process:
        assert ended(process)[0] == 0
    assert np.load(tmp_path / "b.npy").mean() > 0.0


@needs_events
def test_a_lost_display_is_one_line(tmp_path):
    """The X server dies: one line, exit code 2."""
    with x_server() as (server, name), running(tmp_path, "view", BOX, "--res", 64, 48, display=name) as process:
        window_of(name, process)
        time.sleep(1.0)
        server.kill()
        assert ended(process) == (2, "warp-ir: error: the display is gone")


@needs_events
def test_ctrl_c_ends_a_window(tmp_path, display):
    """SIGINT ends the command as it ends the others: one line, exit code 130."""
    with running(tmp_path, "view", BOX, "--res", 64, 48, display=display) as process:
        window_of(display, process)
        process.send_signal(signal.SIGINT)
        assert ended(process) == (130, "warp-ir: interrupted")


def test_no_display_is_one_line(tmp_path):
    """Without a display, and with one that does not answer: one line, exit code 2."""
    for name in (None, ":987"):
        with running(tmp_path, "view", BOX, display=name) as process:
            code, errors = ended(process)
        assert code == 2 and errors.count("\n") == 0 and "no display" in errors


def test_an_address_in_use_is_one_line(tmp_path):
    """Another server listens there, or the host is unknown: one line, exit code 2, before the stage is read."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        for address in (other.getsockname()[1], "host.invalid:8080"):
            with running(tmp_path, "view", BOX, "--web", address) as process:
                code, errors = ended(process)
            assert code == 2 and errors.count("\n") == 0 and "cannot be used" in errors


@needs_xvfb
def test_a_preview_does_not_change_the_picture(tmp_path, display):
    """A render that a window shows has the same bits as one that nobody watches."""
    for name, where, flags in (("a.npy", display, ["--preview"]), ("b.npy", None, [])):
        arguments = ["render", BOX, name, "-w", 40, "--iterations", 6, "-q", *flags]
        with running(tmp_path, *arguments, display=where) as process:
            assert ended(process) == (0, "")
    assert (np.load(tmp_path / "a.npy") == np.load(tmp_path / "b.npy")).all()


@needs_events
def test_a_preview_outlives_its_display(tmp_path):
    """The X server dies during a render: the picture is written all the same."""
    with x_server() as (server, name):
        arguments = ["render", BOX, "a.png", "-w", 64, "--time-limit", 12, "--preview"]
        with running(tmp_path, *arguments, display=name) as process:
            window_of(name, process)
            time.sleep(1.0)
            server.kill()
            assert ended(process)[0] == 0
    assert read_image(tmp_path / "a.png").shape[:2] == (64, 64)


# ---- browsers ----------------------------------------------------------------------------------------------------


class Browser:
    """Headless Chromium with one page, by its debugging protocol."""

    def __init__(self, socket):
        self._socket, self._number = socket, 0

    async def call(self, method, **parameters):
        self._number += 1
        await self._socket.send_json({"id": self._number, "method": method, "params": parameters})
        while True:
            reply = json.loads((await self._socket.receive()).data)
            if reply.get("id") == self._number:
                return reply.get("result", {})

    async def value(self, expression):
        reply = await self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        return reply.get("result", {}).get("value")

    async def until(self, expression, seconds=30.0):
        import asyncio

        end = time.monotonic() + seconds
        while time.monotonic() < end:
            value = await self.value(expression)
            if value:
                return value
            await asyncio.sleep(0.2)
        raise AssertionError(f"never true within {seconds} s: {expression}")

    async def mouse(self, kind, x, y, buttons=1):
        await self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=buttons, clickCount=1)

    async def key(self, name):
        await self.call("Input.dispatchKeyEvent", type="keyDown", key=name)
        await self.call("Input.dispatchKeyEvent", type="keyUp", key=name)


def in_browser(folder, address, visit):
    """Runs a coroutine with a `Browser` at an address."""
    import asyncio

    import aiohttp

    program = shutil.which("chromium") or shutil.which("google-chrome")

    async def run():
        profile = folder / "profile"
        flags = ["--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0", "--window-size=400,300"]
        process = subprocess.Popen(
            [program, *flags, f"--user-data-dir={profile}", "about:blank"], stderr=subprocess.DEVNULL
        )
        try:
            port_file = profile / "DevToolsActivePort"
            port = int(wait_for(lambda: port_file.read_text() or None if port_file.exists() else None).split()[0])
            async with aiohttp.ClientSession() as session:
                async with session.get(f"http://127.0.0.1:{port}/json") as reply:
                    page = next(each for each in await reply.json() if each["type"] == "page")
                async with session.ws_connect(page["webSocketDebuggerUrl"], max_msg_size=0) as socket:
                    browser = Browser(socket)
                    await browser.call("Page.navigate", url=address)
                    await visit(browser)
        finally:
            process.kill()
            process.wait()

    asyncio.run(run())


def served(process):
    """The address that a server has printed."""
    assert select.select([process.stdout], [], [], 40.0)[0], "no address"
    return process.stdout.readline().strip()


needs_browser = pytest.mark.skipif(
    not (shutil.which("chromium") or shutil.which("google-chrome")) or importlib.util.find_spec("trame") is None,
    reason="needs Chromium and the extra 'view'",
)
STATUS = "document.querySelector('#status')?.innerText"


@needs_browser
def test_a_browser_orbits_and_edits(tmp_path):
    """A picture arrives; dragging changes it; keys and sliders change the state; Ctrl-C stops the server."""
    with running(tmp_path, "view", BOX, "--res", 64, 48, "--web", 0) as process:
        address = served(process)
        assert address.startswith("http://127.0.0.1:")

        async def visit(browser):
            picture = "document.querySelector('img.picture').src"
            await browser.until(f"({STATUS} || '').includes('iteration')")
            before = await browser.value(picture)
            await browser.mouse("mousePressed", 100, 100)
            for step in range(8):
                await browser.mouse("mouseMoved", 100 + 5 * step, 100)
            await browser.mouse("mouseReleased", 135, 100, buttons=0)
            await browser.until(f"{picture} != {json.dumps(before)} && ({STATUS} || '').includes('iteration')")
            await browser.key("1")
            await browser.until(f"{STATUS}.includes('bounces 1,')")
            slider = "document.querySelector('.panel input[type=range]')"
            await browser.value(f"{slider}.value = 2; {slider}.dispatchEvent(new Event('input'))")
            await browser.until(f"{STATUS}.includes('exposure +2')")

        in_browser(tmp_path, address, visit)
        process.send_signal(signal.SIGINT)
        assert ended(process) == (130, "warp-ir: interrupted")


@needs_browser
def test_other_machines_need_the_token(tmp_path):
    """Bound to all addresses, the server prints a token: with it a page shows the view, without it nothing."""
    with running(tmp_path, "view", BOX, "--res", 64, 48, "--web", "0.0.0.0:0") as process:
        address = served(process)
        assert "?secret=" in address

        async def with_token(browser):
            await browser.until(f"({STATUS} || '').includes('bounces all')")

        async def without_token(browser):
            import asyncio

            await asyncio.sleep(6.0)
            assert not await browser.value(STATUS)

        local = address.replace("0.0.0.0", "127.0.0.1")
        in_browser(tmp_path / "with", local, with_token)
        in_browser(tmp_path / "without", local.partition("?")[0], without_token)
