"""The algorithm on one page.

    upload the scene
    repeat, for iteration i = 0, 1, 2, ...
        camera rays find what each pixel sees          -> GBuffer     gbuffer.py
        light paths leave virtual point lights (VPLs)  -> VplBuffer   vpl/emission.py
        every pixel sums the light of the VPLs         -> GBuffer     estimators/, vpl/gather.py
        the estimate is added to the mean              -> Film        film/accumulate.py
    the picture is the mean, filtered                                 reconstruction/

Iteration i depends on (scene, camera, settings, i) and on nothing else. So a picture has the same bits on any number of
threads, and films of different iterations can be merged.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import ModuleType

import warp as wp

import warp_ir.bvh.build
from warp_ir.coverage import SAMPLES, measure_coverage
from warp_ir.device.graph import RepeatedLaunches
from warp_ir.device.launcher import Cancelled, Launcher
from warp_ir.device.scratch import Scratch
from warp_ir.device_scene import CameraData, DeviceScene, camera_data, upload_scenes
from warp_ir.estimators import Estimator, estimator_of
from warp_ir.film import ACCUMULATE_MODULES, Film
from warp_ir.film.denoise import denoise_seconds
from warp_ir.gbuffer import GBuffer, new_gbuffer
from warp_ir.image.cryptomatte import Cryptomatte
from warp_ir.interrupt import cancel_on_signal
from warp_ir.memory import gibibytes, pixel_bytes
from warp_ir.reconstruction import BLUR_MODULES, FILTER_MODULES, SCRATCH, Reconstruction, surfaces_move
from warp_ir.sampling.sobol import stratum
from warp_ir.scene import InputError, LightKind, Scene
from warp_ir.scheduling import AdaptiveScheduler, Progress
from warp_ir.settings import GuidingSettings, RenderSettings

_GUIDING = GuidingSettings()


class Renderer:
    """A scene on a device, ready to add iterations to films."""

    def __init__(
        self,
        scene: Scene,
        settings: RenderSettings | None = None,
        *,
        device: str = "cpu",
        threads: int | None = None,
        guiding: GuidingSettings | None = _GUIDING,
    ):
        """Uploads the scene and compiles the kernels that its estimator needs.

        Args:
            scene: What to render.
            settings: How to render it; None: what the scene's file asks for (`Scene.settings`), and else the defaults.
            device: "cpu", "cuda" or "cuda:N".
            threads: CPU threads; by default one per core. The picture does not depend on it.
            guiding: When light paths are guided; None: never.

        Raises:
            InputError: The scene, the settings or the device cannot be used.
        """
        settings = settings or RenderSettings(**scene.settings)
        self.wanted = settings
        """The settings as given; in `settings` the height is definite."""
        if settings.denoise:
            denoise_seconds(1)  # starts the denoiser before the work: it may be missing, and starting takes a while
        self.launcher = Launcher(device, threads)
        self._scratch = Scratch(self.launcher)
        self.guiding = guiding
        """When light paths are guided."""
        self._reported: tuple[dict[str, float], dict[str, int]] = ({}, {})
        self._shutter: list[_ShutterState] = []
        self.origin = scene
        """The scene as it was given, with its shutter samples."""
        self._layout: _BufferLayout | None = None
        self._held = 0  # bytes of the pixels
        self._take_settings(scene)
        before = [*([warp_ir.bvh.build] if self.launcher.device.is_cpu else []), *self._estimator_modules()]
        after = [*(FILTER_MODULES if self._resolved.filter else []), *ACCUMULATE_MODULES]
        with self.launcher.loading():
            self.launcher.expect([*before, *after])
            if self.launcher.wavefront:  # a GPU's code takes longest: all side by side, before the upload
                self.launcher.load([*before, *after])
                self._upload(scene)
            else:
                self.launcher.load(before)  # what takes longest comes first
                self._upload(scene)
                self.launcher.load(after)

    def update(self, scene: Scene, settings: RenderSettings | None = None) -> None:
        """Replaces the scene, and uploads only what the two scenes do not share.

        Nothing can be added to films of the old scene or the old settings afterwards.

        Args:
            scene: What to render from now on; the present scene, to change the settings alone.
            settings: How to render it; None: as before.

        Raises:
            InputError: The scene or the settings cannot be used.
        """
        with self.launcher.exclusive:
            self.launcher.profile.clear()
            self._reported = {}, {}
            before, estimator = self._resolved, self._estimator
            self._take_settings(scene, settings)
            with self.launcher.loading():
                if self._estimator is not estimator:
                    self.launcher.load(self._estimator_modules())
                if self._resolved.filter and not before.filter:
                    self.launcher.load(FILTER_MODULES)
                self._upload(scene)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the picture cannot show precisely: one line each, beginning with the prim's path."""
        return tuple(
            f"{name}: its triangles reach so far that float32 is coarse where the camera sees them; divide them"
            for name in dict.fromkeys(name for state in self._shutter for name in state.scene.coarse)
        )

    @property
    def scene(self) -> DeviceScene:
        """The scene on the device; with motion blur, its first shutter sample."""
        return self._shutter[0].scene

    def new_film(self) -> Film:
        """An empty film of the size that the settings ask for."""
        with self.launcher.exclusive:
            first = self._shutter[0]
            assert self._layout is not None
            film = Film(
                first.camera.columns,
                first.camera.rows,
                self.launcher,
                first.scene.frame,
                has_emission=self._layout.emission,
                sees_lights=self._resolved.visible_lights,
                sees_dome=self._resolved.visible_lights
                and any(light.kind == LightKind.DOME for light in first.scene.source.lights),
            )
            film.settings, film.origin = self.settings, self.origin
            film.emits = any(state.scene.emits for state in self._shutter)
            if self._resolved.filter:
                self._gbuffer.tiles = film.tiles
                film.reconstruction = Reconstruction(
                    self._shutter, self.launcher, self._gbuffer, self._block, self.settings.seed
                )
            return film

    def add_iteration(self, film: Film, iteration: int) -> None:
        """Adds iteration number `iteration` to a film: a pure function of the scene, the settings and that number.

        Films of one renderer may be added to from several threads: they take turns.

        Raises:
            InputError: The film is not one that `new_film` makes for the present scene.
        """
        with self.launcher.exclusive:
            if film.origin is not self.origin or (film.width, film.height) != self._size():
                raise InputError("film: is not of this renderer's present scene and size; new_film() makes one")
            self._gbuffer.tiles = film.tiles
            number = stratum(iteration, len(self._shutter).bit_length() - 1)
            state = self._shutter[number]

            def launches() -> None:
                state.estimator.estimate(iteration, self._gbuffer)
                # An iteration is added whole or not at all.
                with self.launcher.phase("film"), self.launcher.uninterruptible():
                    film.accumulate(self._gbuffer, state.exposure, number)

            prepared = state.estimator.prepare(iteration)
            state.launches.run((film, film.tiles, self._block, prepared), launches)
            film.count_iteration()
            wp.synchronize_device(self.launcher.device)

    def render(
        self,
        film: Film | None = None,
        progress: Callable[[Progress], None] | None = None,
        *,
        started: float | None = None,
        reserve: float = 0.0,
        iterations: range | None = None,
    ) -> Film:
        """Adds iterations to a film until one of the settings' limits is reached; at least one.

        The time limit is that of this call: a new film's first look at the scene, learning, filtering and denoising
        are in it. SIGINT (Ctrl-C) and SIGTERM end it early: the film then holds the iterations done so far, and
        `film.interrupted` is the number of the signal.

        Args:
            film: A film from `new_film`, to be continued; None: a new one.
            progress: Called after every iteration.
            started: `time.perf_counter` from which the time counts, before uploading for example; None: this call.
            reserve: Time of the limit that the caller needs after this call, for writing the picture for example [s].
            iterations: Those that the film is to hold in the end, to be merged with films of others; it may hold the
                first of them. None: the first ones, up to the limits.
        """
        start = time.perf_counter() if started is None else started
        film = film or self.new_film()
        start -= film.seconds
        with cancel_on_signal(self.launcher, film):
            film.seconds = time.perf_counter() - start
            first, settings = 0, self.settings
            if iterations is not None:
                first, settings = iterations.start, replace(settings, iterations=len(iterations))
            scheduler = AdaptiveScheduler(film, settings, self.is_adaptive())
            profile = self.launcher.profile
            before, rays = profile.seconds(), profile.counts["primary_rays"]
            while not film.interrupted and film.iterations < settings.iteration_limit:
                try:
                    self.add_iteration(film, first + film.iterations)
                    film.seconds = time.perf_counter() - start
                    spent, samples = profile.since(before), profile.counts["primary_rays"] - rays
                    picture = self._picture_seconds(film, spent["primary"] / samples, spent["film"] / samples)
                    report = scheduler.update(reserve=reserve + picture, fixed_share=spent["emission"] / spent.total())
                except Cancelled:
                    break
                if progress is not None:
                    progress(report)
                if report.fraction >= 1.0:
                    break
        film.radiance()  # makes the picture, which the film keeps, within the time of the render
        film.seconds = time.perf_counter() - start
        self.report_profile(film)
        return film

    def cryptomattes(self) -> tuple[Cryptomatte, Cryptomatte]:
        """The objects, by the names of their meshes, and the materials that cover each pixel, and how much of it.

        Counted by the camera rays of the first 64 iterations, which are traced for it, however many a film has.
        """
        with self.launcher.exclusive, self.launcher.phase("coverage"), self.launcher.uninterruptible():
            shift = len(self._shutter).bit_length() - 1
            numbers = [stratum(iteration, shift) for iteration in range(SAMPLES)]
            shutter = [(state.scene, state.camera) for state in self._shutter]
            return measure_coverage(shutter, numbers, self.settings.seed, self.launcher)

    def is_adaptive(self) -> bool:
        """Whether iterations may leave out tiles.

        A picture whose tiles are chosen by their noise is no unbiased mean, and shutter samples are shared by all
        pixels.
        """
        settings = self._resolved
        limited = settings.time_limit is not None or settings.target_error is not None
        return limited and settings.iterations is None and settings.filter and len(self._shutter) == 1

    def part_settings(self) -> RenderSettings:
        """The settings for renderers of parts of the picture, on devices of any size: without limits and defaults."""
        settings = replace(self.settings, light_paths=self._resolved.light_paths)
        return replace(settings, iterations=None, time_limit=None, target_error=None, denoise=False)

    def report_profile(self, film: Film) -> None:
        """Adds the timings and counts since the last report to the film's."""
        seconds, counts = self.launcher.profile.seconds(), self.launcher.profile.counted()
        for phase in seconds:
            film.timings[phase] = film.timings.get(phase, 0.0) + seconds[phase] - self._reported[0].get(phase, 0.0)
        for what in counts:
            film.counts[what] = film.counts.get(what, 0) + counts[what] - self._reported[1].get(what, 0)
        film.counts["iterations"] = film.iterations
        film.counts["skipped_samples"] = film.skipped
        film.counts.setdefault("graph_launches", 0)
        self._reported = seconds, counts

    def _estimator_modules(self) -> list[ModuleType]:
        """The modules of kernels that the estimator needs on this device."""
        waves = self._estimator.WAVEFRONT_MODULES if self.launcher.wavefront else []
        return [*self._estimator.MODULES, *waves]

    def _take_settings(self, scene: Scene, settings: RenderSettings | None = None) -> None:
        """Fills in what depends on the scene's camera, and refuses pictures too large for the memory.

        If it refuses, the settings stay as they were.
        """
        wanted = settings or self.wanted
        estimator = estimator_of(wanted.estimator, scene)
        resolved = wanted.resolve(scene.camera.aspect, self.guiding, self.launcher.max_light_paths())
        definite = replace(wanted, height=resolved.height)
        _, _, columns, rows = definite.pixels()
        guided = resolved.guiding is not None and resolved.guiding.visibility
        needed = columns * rows * pixel_bytes(scene, resolved, guided=guided)
        if needed > self._held and needed > (available := self.launcher.memory() + self._held):
            raise InputError(
                f"width: {columns} x {rows} pixels need about {gibibytes(needed)},"
                f" {self.launcher.device} has {gibibytes(available)}"
            )
        self.wanted, self.settings, self._resolved, self._held = wanted, definite, resolved, needed
        self._estimator = estimator

    def _upload(self, scene: Scene) -> None:
        """Uploads every shutter sample of the scene, and allocates the buffers that an iteration fills in."""
        settings, launcher = self._resolved, self.launcher
        if len(scene.shutter) & (len(scene.shutter) - 1):
            raise InputError(f"scene: shutter has {len(scene.shutter)} samples, which is no power of two")
        scenes = scene.shutter if settings.motion_blur and scene.shutter else (scene,)
        uploaded = upload_scenes(scenes, launcher, list({id(s.scene): s.scene for s in self._shutter}.values()))
        self._shutter, self.origin = [], scene
        for sample, device_scene in zip(scenes, uploaded, strict=True):
            camera = camera_data(sample.camera, device_scene.frame, self.settings)
            camera.blurs = int(camera.blurs == 1 or len(scenes) > 1)
            estimator = self._estimator(device_scene, camera, settings, self._scratch)
            launches = RepeatedLaunches(self._scratch)
            self._shutter.append(_ShutterState(device_scene, camera, estimator, sample.camera.exposure, launches))
        if camera.blurs and settings.filter:
            launcher.load(BLUR_MODULES)
        layout = _BufferLayout(
            columns=camera.columns,
            rows=camera.rows,
            normals=any(sample.has_normals for sample in scenes),
            normal_maps=any(each.data.normal_map_count > 0 for each in uploaded),
            emission=settings.visible_lights or any(sample.glows for sample in scenes),
            moving=settings.filter and surfaces_move(uploaded),
            spare=SCRATCH if settings.filter else 0,
        )
        if self._layout != layout:
            self._gbuffer, self._block = layout.allocate(launcher)
            self._layout = layout

    def _size(self) -> tuple[int, int]:
        """Columns and rows of the films."""
        return self._shutter[0].camera.columns, self._shutter[0].camera.rows

    def _picture_seconds(self, film: Film, per_ray: float, per_addition: float) -> float:
        """Estimated time to make the picture [s], if a camera ray and adding a sample to the film take as long [s]."""
        seconds = 0.0
        if film.reconstruction is not None:
            rays, additions = film.reconstruction.cost(film.iterations)
            seconds += film.width * film.height * (rays * per_ray + additions * per_addition)
        if self.settings.denoise:
            seconds += denoise_seconds(film.width * film.height, self.settings.time_limit)
        return seconds


@dataclass(frozen=True)
class _ShutterState:
    """One sample of the time in which the shutter is open: the scene then, its camera, and what computes its light."""

    scene: DeviceScene
    camera: CameraData
    estimator: Estimator
    exposure: float
    launches: RepeatedLaunches


@dataclass(frozen=True)
class _BufferLayout:
    """What the buffers of an iteration must hold; they are allocated anew only when it changes."""

    columns: int
    rows: int
    normals: bool
    normal_maps: bool
    emission: bool
    moving: bool
    spare: int

    def allocate(self, launcher: Launcher) -> "tuple[GBuffer, wp.array[wp.float32]]":
        """The G-buffer, and the block of memory it lies in."""
        return new_gbuffer(
            launcher,
            self.columns,
            self.rows,
            has_normals=self.normals,
            has_normal_maps=self.normal_maps,
            has_emission=self.emission,
            moving=self.moving,
            spare=self.spare,
        )


def render(
    scene: Scene,
    settings: RenderSettings | None = None,
    *,
    device: str = "cpu",
    progress: Callable[[Progress], None] | None = None,
) -> Film:
    """Renders a scene until one of the settings' limits is reached; the time limit is that of the whole call.

    SIGINT (Ctrl-C) and SIGTERM end it early: the film then holds the iterations done so far, and `film.interrupted` is
    the number of the signal.

    Args:
        scene: What to render, from `load_usd` or made by hand.
        settings: How to render it; None: what the scene's file asks for (`Scene.settings`), and else the defaults.
        device: "cpu", "cuda" or "cuda:N".
        progress: Called after every iteration.

    Raises:
        InputError: The scene, the settings or the device cannot be used; the message says why in one line.
    """
    started = time.perf_counter()
    renderer = Renderer(scene, settings, device=device)
    return renderer.render(progress=progress, started=started)
