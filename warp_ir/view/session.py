"""The view without a window: what is shown, how it is changed, and what is rendered next. READ FIRST of this package.

A user interface changes the `ViewState` and shows `Frame`s. `LiveView.step` does one short piece of work:

    what the camera sees has changed  -> one iteration of few pixels, filtered: a picture at once
    it has rested for a moment        -> finer levels, of which each costs at most some four times as much
    at full resolution                -> iterations are added to a film until its error is small
    only the display has changed      -> the last radiance is mapped again

A change interrupts the work on a resting picture, so that the next picture of a motion need not wait for it. `run`
calls `step` in a thread of its own until `close`.
"""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from warp_ir.device.launcher import Cancelled
from warp_ir.device.scratch import Scratch
from warp_ir.film import Film
from warp_ir.image.io import write_image
from warp_ir.image.tonemap import TONEMAPS, automatic_exposure, suggest_exposure
from warp_ir.renderer import Renderer
from warp_ir.scene import Camera, Color, Floats, InputError, Scene
from warp_ir.settings import ESTIMATOR_NAMES, GuidingSettings, RenderSettings
from warp_ir.view.display import Pixels, display_pixels, draw_vpls, scaled
from warp_ir.view.edits import Edits, LightEdit, light_names, surface_at
from warp_ir.view.navigation import centre_at
from warp_ir.view.source import Source
from warp_ir.vpl.trace import Vpls, trace_uploaded

MOTION_SECONDS = 0.07
"""Time in which a picture of a motion shall be ready [s]."""
_REST_SECONDS = 0.15
"""Time without a change after which a picture is refined [s]."""
_FIRST_PIXELS = 96 * 54
"""Pixels of the first picture, from whose time those of the following ones are chosen."""
_LONGEST_SECONDS = 0.15
"""Time that a picture may take rather than have fewer pixels than the first one [s]."""
_FEWEST_PIXELS = 64 * 36
_FIXED_SECONDS = 0.025
"""Part of that time that does not depend on the number of pixels: launches, and the uploading of a camera [s]."""
_DIVISORS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 12.0, 16.0, 24.0)
"""Ratios of the sides of the window to those of a coarse picture."""
_LEVEL_DIVISOR = 2.5
"""Largest ratio of the sides of a picture to those of the next coarser one, where the coarser is slow."""
_LAST_DIVISOR = 1.2
"""Smallest such ratio for which there is a level at all."""
_SLOW_SECONDS = 0.5
"""Estimated time of an iteration at full resolution from which coarser levels are shown before [s]."""
_MOTION_PATHS = 32
"""Light paths of `keller` in motion: each VPL of its is a ray for each pixel."""
_PICTURE_SHARE = 0.25
"""Largest fraction of the time of a resting view that goes into making pictures of its film."""
_TARGET_ERROR = 0.005
"""Error at which a resting view has converged, if no other limit is set."""
_MOST_ITERATIONS = 4096
_UNLIT_ITERATIONS = 64
"""Iterations after which a view without any light is left as it is."""
_EASE = 0.35
"""Fraction of the way to the automatic exposure that a picture of a motion goes: no flicker."""
_OVERLAY_PATHS = 512
"""Light paths of the VPLs that are drawn."""


@dataclass(frozen=True)
class ViewState:
    """What a user has asked for. Fields of `_RENDERED` need new iterations, the others only another display."""

    camera: Camera
    width: int
    height: int
    time: float | str | None = None
    """Time code; None: the stage's start."""
    edits: Edits = field(default_factory=Edits)
    estimator: str = ESTIMATOR_NAMES[0]
    max_bounces: int | None = None
    """None: all."""
    filter: bool = True
    exposure: float = 0.0
    """Stops; with `auto_exposure` the exposure that was chosen."""
    auto_exposure: bool = False
    tonemap: str = TONEMAPS[0]
    vpls: bool = False
    """Whether VPLs are drawn over the picture."""


_RENDERED = ("camera", "width", "height", "time", "edits", "estimator", "max_bounces", "filter")


@dataclass(frozen=True, eq=False)
class Frame:
    """A picture for the window, of whatever resolution, which the window scales."""

    pixels: Pixels
    state: ViewState
    coarse: bool
    """Whether it has fewer pixels than the window."""
    iterations: int
    error: float
    """`Film.error`; NaN if unknown."""
    converged: bool
    seconds: float
    """From the change that it shows, if it is the first to show it, to the picture."""

    @property
    def status(self) -> str:
        """Iterations and error in a few words."""
        if self.coarse:
            return "coarse"
        percent = 100.0 * self.error
        error = f", error {percent:{'.2g' if percent < 99.5 else '.0f'}} %" if math.isfinite(percent) else ""
        return f"{self.iterations} iteration{'s' * (self.iterations != 1)}{error}{', converged' * self.converged}"


@dataclass(frozen=True, eq=False)
class _Good:
    """What was shown last, to which a view goes back from what cannot be shown."""

    scene: Scene
    time: float | str | None
    cameras: tuple[Camera, ...]
    state: ViewState


class LiveView:
    """A scene in view. `change` and the methods that call it may be called by any thread, `step` by one."""

    def __init__(
        self,
        source: Source,
        settings: RenderSettings | None = None,
        *,
        time_code: float | str | None = None,
        exposure: float | None = None,
        tonemap: str = TONEMAPS[0],
        device: str = "cpu",
        threads: int | None = None,
    ) -> None:
        """Reads the scene, uploads it, and compiles what it needs.

        Args:
            source: The scene.
            settings: How it is rendered, and the size of the window; None: what the source asks for.
            time_code: Time code at which the view starts.
            exposure: Stops; None: 0, unless that shows almost nothing but black or white.
            tonemap: Tone curve.
            device: "cpu", "cuda" or "cuda:N".
            threads: CPU threads; by default one per core.

        Raises:
            InputError: The scene, the settings or the device cannot be used.
        """
        self.source = source
        scene = source.read(time_code)
        settings = settings or RenderSettings(**scene.settings)
        resolved = settings.resolve(scene.camera.aspect)
        self._settings = replace(
            settings,
            width=resolved.width,
            height=resolved.height,
            motion_blur=False,
            denoise=False,
            # A window is all of its picture, in square pixels.
            data_window=(0.0, 0.0, 1.0, 1.0),
            pixel_aspect=1.0,
        )
        self.state = ViewState(
            camera=scene.camera,
            width=resolved.width,
            height=resolved.height,
            time=time_code,
            estimator=settings.estimator,
            max_bounces=settings.max_bounces,
            filter=settings.filter,
            exposure=exposure or 0.0,
            tonemap=tonemap,
        )
        self.message = ""
        """What happened last, for the user; "" if nothing did."""
        self._wants_exposure = exposure is None
        self._lock = threading.Lock()
        self.changed = threading.Condition(self._lock)
        """Notified whenever the state changes or a frame is ready."""
        self._closed = False
        self._cancellable = False
        self._changed_at = time.perf_counter()
        self._base = scene
        self._scene, self._scene_of = scene, (id(scene), self.state.edits)
        self._read_time = time_code
        self.cameras = source.cameras(time_code) or (scene.camera,)
        same_camera = next((camera for camera in self.cameras if camera.name == scene.camera.name), scene.camera)
        self.state = replace(self.state, camera=same_camera)
        self._pixels = float(_FIRST_PIXELS)
        self._film: Film | None = None
        self._radiance: npt.NDArray[np.float32] | None = None
        # What the first iteration of the film has seen: other threads read it without waiting for the renderer.
        self._depth: npt.NDArray[np.float32] = np.zeros((1, 1), np.float32)
        self._position: npt.NDArray[np.float32] = np.zeros((1, 1, 3), np.float32)
        self._mesh: npt.NDArray[np.int32] = np.full((1, 1), -1, np.int32)
        self._good: _Good | None = None
        self._jobs: deque[Callable[[], None]] = deque()
        self._rendered: ViewState | None = None  # of which `_film` holds iterations
        self._displayed: ViewState | None = None
        self._divisor, self._error, self._due = 1.0, math.nan, 0.0
        self._converged = False
        self._vpls: tuple[object, Vpls] | None = None
        # A picture of a motion is iteration 0 alone: learning to guide light paths would take longer than it.
        guiding = GuidingSettings(first_iteration=1)
        self._renderer = Renderer(
            self._with_camera(scene, self.state), self._settings_of(self.state, 16.0), device=device, threads=threads,
            guiding=guiding,
        )  # fmt: skip
        self._scratch = Scratch(self._renderer.launcher)

    # What a user interface calls

    def change(self, **values: object) -> None:
        """Changes fields of the state. Work on a resting picture is interrupted, so that what is new shows at once."""
        with self._lock:
            self._change(**values)

    def _change(self, **values: object) -> None:
        before, self.state = self.state, replace(self.state, **values)  # type: ignore[arg-type]
        if not _same(before, self.state, _RENDERED):
            self._changed_at = time.perf_counter()
        if self._cancellable:  # an iteration may take seconds, and another exposure shall show at once
            self._renderer.launcher.cancel()
        self.changed.notify_all()

    def navigate(self, control: Callable[[Camera], Camera]) -> None:
        """Moves the camera by one of the functions of `warp_ir.view.navigation`."""
        with self._lock:
            camera = control(self.state.camera)
            if np.isfinite(camera.world_from_camera).all() and np.isfinite(camera.window).all():
                self._change(camera=camera)

    def resize(self, width: int, height: int) -> None:
        """The window has another size [pixels]."""
        width, height = max(width, 1), max(height, 1)
        with self._lock:
            if (width, height) != (self.state.width, self.state.height):
                self._change(width=width, height=height)

    def edit_light(self, name: str, **values: object) -> None:
        """Changes fields of the `LightEdit` of a light."""
        with self._lock:
            edits = self.state.edits
            edit: LightEdit = replace(edits.light(name), **values)  # type: ignore[arg-type]
            self._change(edits=edits.with_light(name, edit))

    def edit_color(self, name: str, color: Color) -> None:
        """Gives a material, or a mesh without one, another albedo."""
        red, green, blue = (min(max(float(x), 0.0), 1.0) for x in color)
        with self._lock:
            self._change(edits=self.state.edits.with_color(name, (red, green, blue)))

    def look_through(self, camera: Camera) -> None:
        """Looks through one of `cameras`."""
        self.say(f"camera {camera.name}")
        self.change(camera=camera)

    def say(self, message: str) -> None:
        """Tells the user something."""
        self.message = message

    @property
    def up(self) -> Floats:
        """The up axis [3]."""
        return np.array([0.0, 1.0, 0.0] if self.source.up_axis == "Y" else [0.0, 0.0, 1.0])

    @property
    def scene(self) -> Scene:
        """The scene as it was read, without edits."""
        return self._base

    @property
    def lights(self) -> tuple[str, ...]:
        """Names of the lights, and of the materials that emit."""
        return light_names(self._base)

    def pivot(self) -> Floats:
        """The point [3] around which the camera turns: what the middle of the picture shows, else the scene's depth."""
        camera, seen = self.state.camera, self._depth
        depth = float(seen[seen.shape[0] // 2, seen.shape[1] // 2])
        if depth <= 0.0:
            lower, upper = self._base.bounds()
            to_centre = camera.world_from_camera[:3, 3] - 0.5 * (lower + upper)
            depth = max(float(to_centre @ camera.world_from_camera[:3, 2]), 0.1 * self._base.extent)
        return centre_at(self._fitted(self.state), depth)

    def surface(self, column: float, row: float) -> tuple[str, Color] | None:
        """The surface that a place of the picture shows, in fractions of it: the name of its colour, and the colour.

        None: no surface.
        """
        mesh, position, scene = self._mesh, self._position, self._scene
        if not (0.0 <= column < 1.0 and 0.0 <= row < 1.0) or position.shape[:2] != mesh.shape:
            return None
        y, x = int(row * mesh.shape[0]), int(column * mesh.shape[1])
        index = int(mesh[y, x])
        if not 0 <= index < len(scene.meshes):
            return None
        return surface_at(scene, index, position[y, x].astype(np.float64))

    def save_picture(self, path: Path) -> None:
        """Has the picture written as `render` would: radiance, or tone-mapped with the exposure of the view.

        It is written when it has the resolution of the window; where the file exists, a number is added to its name.
        """

        def save() -> None:
            film, state, file = self._film, self.state, _unused(path)
            assert film is not None
            write_image(file, film, exposure=state.exposure, tonemap=state.tonemap)
            self.say(f"{file}: {film.width} x {film.height}, {film.iterations} iterations")

        self._put(save)

    def save_edits(self, path: Path) -> None:
        """Has camera, lights and colours written as a layer for `render --session-layer`, under a name that is free."""
        state = self.state

        def save() -> None:
            file = _unused(path)
            left_out = self.source.save_edits(file, state.time, state.camera, state.edits)
            self.say(f"{file}: for --session-layer{''.join(f'; {line}' for line in left_out)}")

        self._put(save)

    def _put(self, job: Callable[[], None]) -> None:
        """Leaves a job to the thread that renders."""
        with self._lock:
            self._jobs.append(job)
            self.changed.notify_all()

    def close(self) -> None:
        """Ends `run`."""
        with self._lock:
            self._closed = True
            if self._cancellable:
                self._renderer.launcher.cancel()
            self.changed.notify_all()

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return self._closed

    # Rendering

    def run(self, show: Callable[[Frame], None]) -> None:
        """Calls `step` until `close`, and passes on its frames; waits while there is nothing to do."""
        while not self._closed:
            frame = self.step()
            if frame is not None:
                show(frame)
                continue
            with self._lock:
                if not self._closed and self.state is self._displayed and not self._jobs:
                    self.changed.wait(0.03)

    def step(self) -> Frame | None:
        """Does one piece of work; None if it has made no frame."""
        while self._jobs and self._film is not None and self._divisor <= 1.0:
            try:
                self._jobs.popleft()()
            except InputError as error:
                self.say(str(error))
        state, changed_at = self._read_source()
        if self._film is None or not _same(state, self._rendered, _RENDERED):
            return self._show_motion(state, changed_at)
        if self._displayed is not state and self._displayed is not None:
            return self._frame(state, time.perf_counter() - changed_at)
        if time.perf_counter() - changed_at < _REST_SECONDS:
            return None
        try:
            return self._refine(state, changed_at)
        except Cancelled:
            return None

    def _show_motion(self, state: ViewState, changed_at: float) -> Frame:
        """One iteration of as many pixels as there is time for."""
        begin = time.perf_counter()
        try:
            self._prepare(state, self._motion_divisor(state))
        except InputError as error:  # the scene, the settings or the edits cannot be used
            if self._good is None:
                raise
            self.say(f"not shown: {error}")
            state = self._go_back(self._good)
            self._prepare(state, self._motion_divisor(state))
        self._good = _Good(self._base, self._read_time, self.cameras, state)
        self._begin_film(state)
        frame = self._frame(state, 0.0, made=True)
        now = time.perf_counter()
        self._adapt(self._depth.size, now - begin)
        return replace(frame, seconds=now - changed_at)

    def _refine(self, state: ViewState, changed_at: float) -> Frame | None:
        """The next finer level, or an iteration at full resolution; a frame when it is due."""
        now = time.perf_counter()
        if self._divisor > 1.0:
            seconds = MOTION_SECONDS * state.width * state.height / self._pixels
            finer = self._divisor / _LEVEL_DIVISOR
            self._prepare(state, finer if seconds > _SLOW_SECONDS and finer > _LAST_DIVISOR else 1.0)
            with self._interruptible(state):
                self._begin_film(state)
                return self._frame(state, time.perf_counter() - changed_at, made=True)
        film = self._film
        assert film is not None
        if self._converged:
            return None
        limit = self._settings.iterations or _MOST_ITERATIONS
        with self._interruptible(state):
            if film.iterations < limit:
                self._renderer.add_iteration(film, film.iterations)
            if time.perf_counter() < self._due and film.iterations < limit:
                return None
            if film.iterations.bit_count() == 1:
                film.measure_noise()
            frame = self._frame(state, 0.0, made=True)
            error = film.error()
        self._error = error
        given_up = film.iterations >= _UNLIT_ITERATIONS and film.is_unlit()
        good = error <= (self._settings.target_error or _TARGET_ERROR)
        self._converged = good or given_up or film.iterations >= limit
        done = time.perf_counter()
        self._due = done + (done - now) * (1.0 / _PICTURE_SHARE - 1.0)
        return replace(frame, error=error, converged=self._converged)

    def _prepare(self, state: ViewState, divisor: float) -> None:
        """Takes the renderer to the view, with the sides of the window divided by a number."""
        self._film, self._divisor = None, divisor
        self._renderer.update(self._with_camera(self._edited(state), state), self._settings_of(state, divisor))

    def _begin_film(self, state: ViewState) -> None:
        """A film of the view with one iteration, and what that has seen."""
        film = self._renderer.new_film()
        self._renderer.add_iteration(film, 0)
        self._depth, self._position, self._mesh = (film.aov(name) for name in ("depth", "position", "prim_id"))
        if film.width * film.height >= state.width * state.height:
            self._divisor = 1.0
        self._film, self._rendered = film, state
        self._converged, self._error, self._due = False, math.nan, 0.0

    def _frame(self, state: ViewState, seconds: float, *, made: bool = False) -> Frame:
        """A frame of the film's picture; with `made`, of a picture that is made now."""
        film = self._film
        assert film is not None
        if made or self._radiance is None:
            self._radiance = film.radiance()
            state = self._exposed(state, self._radiance)
        elif state.auto_exposure and not (self._displayed and self._displayed.auto_exposure):
            state = self._exposed(state, self._radiance, immediately=True)
        pixels = display_pixels(self._radiance, state.exposure, state.tonemap)
        if state.vpls:
            full = scaled(pixels, state.width, state.height)
            pixels = draw_vpls(full, self._overlay(state), self._fitted(state), self._depth)
        self._displayed = state
        return Frame(pixels, state, self._divisor > 1.0, film.iterations, self._error, self._converged, seconds)

    def _exposed(self, state: ViewState, radiance: npt.NDArray[np.float32], immediately: bool = False) -> ViewState:
        """The state with the exposure that the picture asks for, if that is wanted."""
        exposure = state.exposure
        if state.auto_exposure:
            wanted = min(max(automatic_exposure(radiance), -100.0), 100.0)
            moving = self._displayed is not None and self._displayed.auto_exposure and not immediately
            exposure += (_EASE if moving else 1.0) * (wanted - exposure)
        elif self._wants_exposure:
            suggested = suggest_exposure(radiance, exposure)
            if suggested is not None:
                exposure = suggested
                self.say(f"exposure {exposure:+g} stops: the picture would hardly show otherwise")
        self._wants_exposure = False
        if exposure == state.exposure:
            return state
        with self._lock:
            if self.state.exposure == state.exposure:  # else the user has changed it meanwhile
                same = self.state is state
                self.state = replace(self.state, exposure=exposure)
                return self.state if same else replace(state, exposure=exposure)
        return state

    def _overlay(self, state: ViewState) -> Vpls:
        """The VPLs of the scene, traced when it changes."""
        key = (self._scene, state.estimator, state.max_bounces)
        if self._vpls is None or self._vpls[0] != key:
            settings = replace(self._settings_of(state, 1.0), light_paths=_OVERLAY_PATHS)
            resolved = settings.resolve(state.camera.aspect)
            self._vpls = key, trace_uploaded(self._renderer.scene, self._scratch, resolved)[1]
        return self._vpls[1]

    # What is rendered

    def _read_source(self) -> tuple[ViewState, float]:
        """The state to show; reads the scene anew if its files or the time have changed."""
        if self.source.changed():
            try:
                self.source.reload()
                self._take_scene(self.source.read(self.state.time), self.state.time)
                self.say("the stage has changed and is loaded again")
            except InputError as error:
                self.say(f"not loaded: {error}")
        with self._lock:
            state = self.state
        if state.time != self._read_time:
            try:
                self._take_scene(self.source.read(state.time), state.time)
            except InputError as error:
                self.say(str(error))
                self.change(time=self._read_time)
        with self._lock:
            return self.state, self._changed_at

    def _take_scene(self, scene: Scene, code: float | str | None) -> None:
        """Shows another scene, with the camera and the edits of the view; a stage's camera moves with its time."""
        cameras = self.source.cameras(code) or (scene.camera,)
        before = {camera.name: camera for camera in self.cameras}
        after = {camera.name: camera for camera in cameras}
        self._base, self._read_time = scene, code
        self._rendered = None
        with self._lock:
            self.cameras = cameras
            camera = self.state.camera
            if before.get(camera.name) is camera:  # it looks through a camera of the stage
                self.state = replace(self.state, camera=after.get(camera.name, camera))
            self._changed_at = time.perf_counter()

    def _go_back(self, good: _Good) -> ViewState:
        """Shows again what could be shown."""
        with self._lock:
            self._base, self._read_time, self.cameras = good.scene, good.time, good.cameras
            self.state = replace(good.state)
            return self.state

    def _edited(self, state: ViewState) -> Scene:
        """The scene with the edits; the same object as long as neither changes."""
        key = (id(self._base), state.edits)
        if key != self._scene_of:
            self._scene, self._scene_of = state.edits.apply(self._base), key
        return self._scene

    def _with_camera(self, scene: Scene, state: ViewState) -> Scene:
        return replace(scene, camera=state.camera, shutter=())

    def _fitted(self, state: ViewState) -> Camera:
        """The camera with its window as the picture has it."""
        settings = self._settings
        return state.camera.fit(state.width, state.height, settings.conform, settings.pixel_aspect)

    def _settings_of(self, state: ViewState, divisor: float) -> RenderSettings:
        """The settings of a picture whose sides are those of the window divided by a number."""
        moving = divisor > 1.0
        paths = self._settings.light_paths
        if moving and state.estimator == "keller":
            paths = _MOTION_PATHS
        return replace(
            self._settings,
            width=max(round(state.width / divisor), 1),
            height=max(round(state.height / divisor), 1),
            estimator=state.estimator,
            max_bounces=state.max_bounces,
            filter=state.filter,
            light_paths=paths,
            depth_of_field=self._settings.depth_of_field and not moving,
        )

    def _motion_divisor(self, state: ViewState) -> float:
        """The least of `_DIVISORS` with which a picture is ready in time."""
        full = state.width * state.height
        return next((d for d in _DIVISORS if full / d**2 <= self._pixels), _DIVISORS[-1])

    def _adapt(self, pixels: int, seconds: float) -> None:
        """Chooses the number of pixels of the next picture of a motion by the time that one took."""
        per_pixel = max(seconds - _FIXED_SECONDS, 0.2 * seconds) / pixels
        wanted = (MOTION_SECONDS - _FIXED_SECONDS) / per_pixel
        if wanted < _FIRST_PIXELS:
            wanted = min((_LONGEST_SECONDS - _FIXED_SECONDS) / per_pixel, _FIRST_PIXELS)
        ratio = wanted / self._pixels
        if not 0.8 < ratio < 1.25:
            self._pixels = max(self._pixels * min(max(ratio, 0.25), 4.0) ** 0.7, _FEWEST_PIXELS)

    @contextmanager
    def _interruptible(self, state: ViewState) -> Iterator[None]:
        """A change of the state cancels the launches inside, which raise `Cancelled`."""
        with self._lock:
            if self._closed or not _same(self.state, state, _RENDERED):
                raise Cancelled
            self._cancellable = True
        try:
            yield
        finally:
            with self._lock:
                self._cancellable = False
                self._renderer.launcher.resume()


def _unused(path: Path) -> Path:
    """The path, or the first with a number added that is no file yet."""
    candidate, number = path, 1
    while candidate.exists():
        number += 1
        candidate = path.with_name(f"{path.stem}_{number}{path.suffix}")
    return candidate


def _same(one: ViewState, other: ViewState | None, names: tuple[str, ...]) -> bool:
    """Whether two states agree in some fields; cameras, which hold arrays, are the same or not."""
    return other is not None and all(
        getattr(one, name) is getattr(other, name) or getattr(one, name) == getattr(other, name) for name in names
    )
