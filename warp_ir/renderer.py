"""The algorithm on one page.

    upload the scene
    repeat, for iteration i = 0, 1, 2, ...
        camera rays find what each pixel sees          -> GBuffer     gbuffer.py
        light paths leave virtual point lights behind  -> VplBuffer   vpl.py
        every pixel sums the light of the VPLs                        estimators/
        the estimate is added                          -> Film        film.py
    the picture is the mean

Iteration i depends on (scene, camera, settings, i) and nothing else: a picture is the same bits on any
number of threads, and two films of different iterations add up to a better one.
"""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import warp as wp

import warp_ir.bvh.build
import warp_ir.estimators.keller
import warp_ir.estimators.path
import warp_ir.estimators.vpl
import warp_ir.film.accumulate
import warp_ir.gbuffer
import warp_ir.reconstruction.blur
import warp_ir.reconstruction.compose
import warp_ir.reconstruction.filter
import warp_ir.reconstruction.sample_buffer
import warp_ir.vpl.emission
import warp_ir.vpl.sets
from warp_ir.device.launcher import Cancelled, Launcher
from warp_ir.device_scene import DeviceScene, camera_data, upload_scene, upload_scenes
from warp_ir.estimators import ESTIMATORS
from warp_ir.film.denoise import denoise_seconds
from warp_ir.film.film import Film
from warp_ir.gbuffer import new_gbuffer
from warp_ir.memory import pixel_bytes
from warp_ir.reconstruction import SCRATCH, Reconstruction, surfaces_move
from warp_ir.sampling.sobol import iteration_scramble, stratum
from warp_ir.scene import InputError, Scene
from warp_ir.scheduling import AdaptiveScheduler, Progress
from warp_ir.settings import RenderSettings
from warp_ir.vpl.emission import Vpls, emit_vpls, to_host
from warp_ir.vpl.guide import unguided


class Renderer:
    """A scene on a device, ready to add iterations to films."""

    def __init__(self, scene: Scene, settings: RenderSettings, *, device: str = "cpu", threads: int | None = None):
        """Uploads the scene and compiles the kernels its estimator needs.

        Args:
            scene: What to render.
            settings: How.
            device: "cpu", "cuda" or "cuda:N".
            threads: CPU threads; by default one per core. The picture does not depend on it.

        Raises:
            InputError: The scene, the settings or the device cannot be used.
        """
        self.wanted = settings
        """The settings as given; in `settings` the height is definite."""
        self.settings = _with_height(settings, scene)
        if settings.denoise:
            denoise_seconds(1)  # before the work, not after it: it may be missing, and takes its time to start
        self.launcher = Launcher(device, threads)
        self._check_memory(scene)
        self._told: tuple[dict[str, float], dict[str, int]] = ({}, {})
        self._moments: list[_ShutterState] = []
        self._needs: dict[str, Any] = {}  # of the buffers
        large, small = _modules(settings.estimator)
        with self.launcher.loading():
            self.launcher.load([*([warp_ir.bvh.build] if self.launcher.device.is_cpu else []), *large])
            self._take(scene)
            self.launcher.load(small)

    def update(self, scene: Scene) -> None:
        """Takes another scene in place of its own, and uploads what the two do not share.

        Films of the old one are not to be added to.

        Raises:
            InputError: The scene cannot be used.
        """
        self.launcher.profile.clear()
        self._told = {}, {}
        self.settings = _with_height(self.wanted, scene)
        self._check_memory(scene)
        with self.launcher.loading():
            self._take(scene)

    def _take(self, scene: Scene) -> None:
        settings, launcher = self.settings, self.launcher
        if len(scene.shutter) & (len(scene.shutter) - 1):
            raise InputError(f"scene: shutter has {len(scene.shutter)} moments, which is no power of two")
        scenes = scene.shutter if settings.motion_blur and scene.shutter else (scene,)
        uploaded = upload_scenes(scenes, launcher, list({id(m.scene): m.scene for m in self._moments}.values()))
        self._moments = []
        for moment, data in zip(scenes, uploaded, strict=True):
            camera = camera_data(moment.camera, data.frame, settings)
            camera.blurs = int(camera.blurs == 1 or len(scenes) > 1)
            estimator = ESTIMATORS[settings.estimator](data, camera, settings, launcher)
            self._moments.append(_ShutterState(data, camera, estimator, moment.camera.exposure))
        if camera.blurs and settings.filters:
            launcher.load([warp_ir.reconstruction.blur])
        needs: dict[str, Any] = {
            "columns": camera.columns,
            "rows": camera.rows,
            "mapped": any(data.data.normal_map_count > 0 for data in uploaded),
            "glows": settings.visible_lights or any(moment.glows for moment in scenes),
            "moving": settings.filters and surfaces_move(uploaded),
            "spare": SCRATCH if settings.filters else 0,
        }
        if self._needs != needs:
            self._gbuffer, self._direct, self._indirect, self._block = new_gbuffer(launcher, **needs)
            self._needs = needs

    def _check_memory(self, scene: Scene) -> None:
        _, _, columns, rows = self.settings.pixels()
        needed, there = columns * rows * pixel_bytes(scene, self.settings), self.launcher.memory()
        if needed > there:
            raise InputError(
                f"width: {columns} x {rows} pixels need about {needed / 2**30:.0f} GiB,"
                f" {self.launcher.device} has {there / 2**30:.0f}"
            )

    @property
    def scene(self) -> DeviceScene:
        """The scene on the device; the first moment of one with motion blur."""
        return self._moments[0].scene

    def new_film(self) -> Film:
        """An empty film of the right size."""
        first = self._moments[0]
        size = first.camera.columns, first.camera.rows
        film = Film(*size, self.launcher, first.scene.frame, glows=self._needs["glows"])
        film.settings = self.settings
        if self.settings.filters:
            self._gbuffer.tiles, seed = film.tiles, self.settings.seed
            film.reconstruction = Reconstruction(self._moments, self.launcher, self._gbuffer, self._block, seed)
        return film

    def add_iteration(self, film: Film, iteration: int) -> None:
        """Adds iteration number `iteration` to a film: a pure function of the scene, the settings and that number."""
        self._gbuffer.tiles = film.tiles
        number = stratum(iteration, len(self._moments).bit_length() - 1)
        moment = self._moments[number]
        moment.estimator.estimate(iteration, self._gbuffer, self._direct, self._indirect)
        with self.launcher.phase("film"), self.launcher.uninterruptible():  # no part of an iteration without the rest
            film.add(self._gbuffer, self._direct, self._indirect, moment.exposure, number)
        wp.synchronize_device(self.launcher.device)

    def render(self, film: Film | None = None, progress: Callable[[Progress], None] | None = None) -> Film:
        """Adds iterations to a film until one of the settings' limits is reached.

        SIGINT (Ctrl-C) and SIGTERM end it early: the film holds the iterations done so far and says `interrupted`.

        Args:
            film: From `new_film`, to go on with; None: a new one.
            progress: Called after every iteration.
        """
        film = film or self.new_film()
        start = time.perf_counter() - film.seconds
        with _signals_cancel(self.launcher, film):
            stopping, profile = AdaptiveScheduler(film, self.settings, self._chooses_tiles()), self.launcher.profile
            before, rays = profile.seconds(), profile.counts["primary_rays"]
            while not film.interrupted and film.iterations < self.settings.iteration_limit:
                try:
                    self.add_iteration(film, film.iterations)
                    film.seconds = time.perf_counter() - start
                    spent = profile.since(before)
                    reserve = self._finishing_seconds(film, spent["primary"] / (profile.counts["primary_rays"] - rays))
                    report = stopping.look(reserve, spent["emission"] / spent.total())
                except Cancelled:
                    break
                if progress is not None:
                    progress(report)
                if report.fraction >= 1.0:
                    break
        film.radiance()  # filtered now, and remembered: it belongs to the render and its time
        film.seconds = time.perf_counter() - start
        self._tell(film)
        return film

    def _chooses_tiles(self) -> bool:
        """Whether iterations may be for some tiles alone.

        What is chosen by its noise is no unbiased mean any more, and a shutter's moments are for all pixels alike.
        """
        settings = self.settings
        limited = settings.time_limit is not None or settings.target_error is not None
        return limited and settings.iterations is None and settings.filters and len(self._moments) == 1

    def _finishing_seconds(self, film: Film, per_ray: float) -> float:
        """What making the picture will take [s], if a camera ray takes `per_ray`."""
        seconds = 0.0
        if film.reconstruction is not None:
            seconds += per_ray * film.width * film.height * film.reconstruction.passes(film.iterations)
        if self.settings.denoise:
            seconds += denoise_seconds(film.width * film.height, self.settings.time_limit)
        return seconds

    def _tell(self, film: Film) -> None:
        """Adds to a film's timings and counts what has happened since films were told last."""
        seconds, counts = self.launcher.profile.seconds(), self.launcher.profile.counted()
        for phase in seconds:
            film.timings[phase] = film.timings.get(phase, 0.0) + seconds[phase] - self._told[0].get(phase, 0.0)
        for what in counts:
            film.counts[what] = film.counts.get(what, 0) + counts[what] - self._told[1].get(what, 0)
        film.counts["iterations"] = film.iterations
        film.counts["skipped_samples"] = film.skipped
        self._told = seconds, counts


@dataclass(frozen=True)
class _ShutterState:
    """The scene while the shutter is open: all of it, or one of the moments that stand for the time."""

    scene: DeviceScene
    camera: Any
    estimator: Any
    exposure: float


def render(
    scene: Scene,
    settings: RenderSettings | None = None,
    *,
    device: str = "cpu",
    progress: Callable[[Progress], None] | None = None,
) -> Film:
    """Renders a scene until one of the settings' limits is reached.

    SIGINT (Ctrl-C) and SIGTERM end it early: the film holds the iterations done so far and says `interrupted`.

    Args:
        scene: What to render, from `load_usd` or made by hand.
        settings: How; what the scene's file asks for (`Scene.settings`), and else the defaults, if None.
        device: "cpu", "cuda" or "cuda:N".
        progress: Called after every iteration.

    Raises:
        InputError: The scene, the settings or the device cannot be used; the message says why in one line.
    """
    renderer = Renderer(scene, settings or RenderSettings(**scene.settings), device=device)
    return renderer.render(progress=progress)


def _with_height(settings: RenderSettings, scene: Scene) -> RenderSettings:
    """The settings with a definite height, by default from the camera's aspect."""
    height = settings.height or max(1, round(settings.width * settings.pixel_aspect / scene.camera.aspect))
    return replace(settings, height=height)  # checks the number of pixels again


def trace_vpls(
    scene: Scene, settings: RenderSettings | None = None, *, device: str = "cpu", iteration: int = 0
) -> Vpls:
    """The VPLs of one iteration, in world space, as if the whole scene was seen.

    Args:
        scene: Where to trace; empty arrays come back if nothing in it emits.
        settings: `estimator`, `light_paths`, `absorption`, `max_bounces` and `seed` count.
        device: Where to trace them.
        iteration: Which iteration's VPLs.
    """
    settings = settings or RenderSettings()
    launcher = Launcher(device)
    uploaded = upload_scene(scene, launcher)
    vpls = emit_vpls(
        unguided(uploaded, launcher),
        launcher,
        paths=settings.path_count,
        absorption=settings.path_end,
        max_bounces=settings.bounce_limit,
        scramble=iteration_scramble(settings.seed, iteration),
    )
    return to_host(vpls, uploaded)


def _modules(estimator: str) -> tuple[list[Any], list[Any]]:
    """What has kernels that an estimator needs for any scene: what takes long to compile, and the rest."""
    if estimator == "vpl":
        reconstruction = warp_ir.reconstruction.sample_buffer, warp_ir.reconstruction.filter
        return [warp_ir.gbuffer, warp_ir.vpl.emission], [
            *reconstruction,
            warp_ir.vpl.sets,
            warp_ir.film.accumulate,
            warp_ir.reconstruction.compose,
        ]
    if estimator == "keller":
        return [warp_ir.gbuffer, warp_ir.vpl.emission, warp_ir.estimators.keller], [warp_ir.film.accumulate]
    return [warp_ir.gbuffer, warp_ir.estimators.path], [warp_ir.film.accumulate]


@contextmanager
def _signals_cancel(launcher: Launcher, film: Film) -> Iterator[None]:
    """Makes SIGINT and SIGTERM stop the work in flight and mark the film, where Python allows it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, _: Any) -> None:
        film.interrupted = number
        launcher.cancel()

    previous = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
        launcher.resume()
