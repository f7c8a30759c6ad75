"""Many cameras in many worlds of a `LiveScene`, rendered together into the caller's arrays.

    which worlds do the views show?            they get slots         images.py
    repeat, for every iteration
        camera rays                            -> GBuffer             transport.py
        light paths of every world             -> VplBuffer           transport.py, vpl/emission.py
        the VPLs of every world, in sets       -> VplSets             transport.py, vpl/sets.py
        every pixel gathers those of its world -> ViewSums            transport.py, estimators/vpl.py
    what its surface received in earlier steps -> ViewSums            history.py
        filter, mix, pack                          -> the caller's arrays images.py

Each line is one launch, or a few, for all views and worlds. From the second call with arrays of one shape on, nothing
is allocated and nothing is read back: the launches can be recorded as a CUDA graph.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from warp_ir.device.launch_list import LaunchList
from warp_ir.device.records import record_rows
from warp_ir.device.scratch import Scratch
from warp_ir.estimators.vpl import COMPENSATION_SHADOW_RAYS, SHADOW_RAYS
from warp_ir.estimators.wavefront import GatherSettings
from warp_ir.gbuffer import new_gbuffer
from warp_ir.image.tonemap import srgb_to_linear
from warp_ir.reconstruction.filter import LEVELS, SIGMA_DECAY, SIGMAS, IrradianceLayer, new_layer
from warp_ir.reconstruction.pixel_surfaces import PixelSurfaces
from warp_ir.scene import InputError
from warp_ir.settings import UNLIMITED
from warp_ir.simulation import history, images, transport
from warp_ir.simulation.history import OFF, STATIC, TEMPORAL, UNLIT, LastPictures, Motion, PastLight, ViewHistory
from warp_ir.simulation.live_scene import LiveScene
from warp_ir.simulation.transport import Clear, Outputs, ViewRays, ViewSums, WorldPaths
from warp_ir.vpl.emission import CAPACITY_PER_PATH, LightPathSettings, VplBuffer
from warp_ir.vpl.guide import ViewImportance
from warp_ir.vpl.sets import (
    BLOCK_ROWS,
    LANES,
    MAX_SETS,
    MAX_SETS_OF_BLOCKS,
    SHAPING_ROWS,
    SLOT_ROWS,
    SLOT_SHAPING_ROWS,
    VplSets,
    vec16,
)

ACCUMULATE_NAMES = ("off", "static", "temporal")
DEFAULT_BYTES = 2**28
"""Default of `Views.bytes`."""
_MOST_CALLS = 16
"""Calls, by their arrays and settings, whose packed arguments are kept."""
_OUTPUTS = {
    "color": wp.uint32,
    "hdr_color": wp.vec3,
    "albedo": wp.uint32,
    "depth": wp.float32,
    "forward_depth": wp.float32,
    "normal": wp.vec3,
    "shape_index": wp.uint32,
    "error": wp.float32,
}


_SURFACES: dict[str, Any] = {
    "instance": wp.int32,
    "triangle": wp.int32,
    "barycentric": wp.vec2,
    "position": wp.vec3,
    "normal": wp.vec3,
    "footprint": wp.float32,
    "sample": wp.int32,
}
_PAST: dict[str, Any] = {"count": wp.vec2, "direct": wp.vec3, "indirect": wp.vec3, "squares": wp.vec2, "local": wp.vec4}
_LAST: dict[str, Any] = _PAST | {"instance": wp.int32, "position": wp.vec3, "normal": wp.vec3}


@dataclass(frozen=True, kw_only=True)
class ViewSettings:
    """How views are rendered. Every value is checked on construction; an `InputError` names the field."""

    iterations: int = 1
    """Iterations of a call; rounded up to a multiple of the samples of a pixel."""
    light_paths: int = 512
    """Light paths of a world in an iteration; a power of two is best."""
    max_bounces: int | None = None
    """Largest number of indirect bounces; 0: direct light alone; None: no limit."""
    filter: bool = True
    """Whether the noise is filtered; else a picture is the unbiased mean of its iterations."""
    accumulate: str = "off"
    """"off": every call begins anew. "static": a view's mean goes on while nothing that it depends on has changed.
    "temporal": what a surface received in earlier steps goes on as well while it moves. That is biased, because light
    that changes is seen late; where nothing changes it is "static"."""
    max_history: int = 8
    """Of "temporal": for how many steps at most the past counts beside the present one, if anything moves."""
    seed: int = 0
    """Seed of the random numbers: the same seed and step give the same bits."""
    cull_back_faces: bool = False
    """Whether camera rays pass the backs of surfaces; light never does."""
    max_distance: float = 1.0e6
    """Where camera rays end, in lengths of their directions."""
    linear: bool = False
    """Whether packed colours are linear, and not sRGB."""

    def __post_init__(self) -> None:
        """Checks every field."""
        bounces = 0 if self.max_bounces is None else self.max_bounces
        numbers: tuple[tuple[str, int, int], ...]
        numbers = (("iterations", self.iterations, 1), ("light_paths", self.light_paths, 1))
        numbers += (("max_history", self.max_history, 1), ("max_bounces", bounces, 0), ("seed", self.seed, 0))
        for name, value, least in numbers:
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise InputError(f"{name}: must be a whole number of at least {least}, is {value!r}")
        if self.accumulate not in ACCUMULATE_NAMES:
            raise InputError(f"accumulate: must be one of {', '.join(ACCUMULATE_NAMES)}, is {self.accumulate!r}")
        if not self.max_distance > 0.0:
            raise InputError(f"max_distance: must be positive, is {self.max_distance!r}")


@dataclass(frozen=True, kw_only=True)
class ClearValues:
    """What pixels show where a ray hits nothing; packed values are those of `Views.render`. HDR colours are 0."""

    color: int = 0
    albedo: int = 0
    depth: float = 0.0
    normal: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shape_index: int = 0xFFFFFFFF


class Views:
    """Renders views of a `LiveScene`."""

    def __init__(self, scene: LiveScene, settings: ViewSettings | None = None, *, bytes: int = DEFAULT_BYTES) -> None:
        """Loads the kernels.

        Args:
            scene: The scene; the caller moves and refits it.
            settings: How to render; None: the defaults.
            bytes: Memory for the VPLs of worlds. If those of all worlds in view need more, worlds are done in batches.
                Pictures do not depend on it.
        """
        self.scene, self.settings = scene, settings or ViewSettings()
        self.launcher = scene.launcher
        self._bytes = bytes
        self._scratch = Scratch(self.launcher)
        self._paths = WorldPaths()
        self._shape: tuple[int, ...] = ()
        self.step = self.launcher.zeros(1, wp.int32)
        """[1], on the device: the number of the step, on which random numbers depend; every call adds 1."""
        self._calls: dict[tuple[Any, ...], LaunchList] = {}
        self._allocations = 0
        self._moving: Any = None
        self._world_buffers: dict[tuple[Any, ...], _WorldBuffers] = {}
        with self.launcher.loading():
            self.launcher.load([transport, history, images])

    def render(
        self,
        transforms: "wp.array[wp.transformf]",
        rays: Any,
        worlds: "wp.array[wp.int32] | None" = None,
        *,
        settings: ViewSettings | None = None,
        clear: ClearValues | None = None,
        step: "int | wp.array[wp.int32] | None" = None,
        color: Any = None,
        hdr_color: Any = None,
        albedo: Any = None,
        depth: Any = None,
        forward_depth: Any = None,
        normal: Any = None,
        shape_index: Any = None,
        error: Any = None,
    ) -> None:
        """Renders all views into the arrays that are given; row 0 is at the top.

        A camera looks along its -Z, +Y is up. Light is computed only where a colour or an error is wanted.

        Args:
            transforms: World from camera, transformf [views].
            rays: Origin and direction of each pixel's samples in the camera's space, vec3 [rows, columns, samples, 2].
                A direction of length 0 hits nothing. Iteration i takes sample i mod samples: there is no jitter.
            worlds: World of each view, int32 [views]; None: view i shows world i. -101 keeps the view's pixels, any
                other number that is no world clears them.
            settings: How to render; None: `Views.settings`.
            clear: What pixels without a hit show.
            step: Number of the step, on which random numbers depend; None: one more than in the last call.
            color: Packed as A << 24 | B << 16 | G << 8 | R, cut off at 1, without tone mapping, uint32 [views, rows,
                columns].
            hdr_color: Linear radiance [W sr⁻¹ m⁻²].
            albedo: Packed as `color`.
            depth: Ray parameter of the hit: the distance for directions of length 1.
            forward_depth: Distance of the hit from the camera along its -Z.
            normal: Unit normal in world space, on the ray's side.
            shape_index: `LiveScene.ids` of the instance.
            error: Standard error of the mean channel of the unfiltered mean; infinity after a single iteration.

        Raises:
            InputError: An array has another type, shape or device.
        """
        settings, clear = settings or self.settings, clear or ClearValues()
        wanted = {
            "color": color,
            "hdr_color": hdr_color,
            "albedo": albedo,
            "depth": depth,
            "forward_depth": forward_depth,
            "normal": normal,
            "shape_index": shape_index,
            "error": error,
        }
        if step is not None:
            wp.copy(self.step, step) if isinstance(step, wp.array) else self.step.fill_(step)
        arrays = (transforms, rays, worlds, *wanted.values())
        places = tuple(None if x is None else (x.ptr, x.shape, x.strides, x.dtype, str(x.device)) for x in arrays)
        key = (places, settings, clear, self.scene.lights_version)
        if key not in self._calls or self._scratch.allocations != self._allocations:
            self._check(transforms, rays, worlds)
            shape = (transforms.shape[0], rays.shape[0], rays.shape[1])
            outputs = Outputs()
            for name, dtype in _OUTPUTS.items():
                setattr(outputs, name, self._output(name, wanted[name], dtype, shape))
            lit = any(wanted[name] is not None for name in ("color", "hdr_color", "error"))
            launches = self._launches(transforms, rays, worlds, settings, clear, outputs, lit)
            if self._scratch.allocations != self._allocations or len(self._calls) >= _MOST_CALLS:
                self._calls.clear()  # arrays that they refer to may have been replaced
            self._allocations = self._scratch.allocations
            self._calls[key] = launches
        self._calls[key].run()

    def _launches(
        self,
        transforms: Any,
        rays: Any,
        worlds: Any,
        settings: ViewSettings,
        clear: ClearValues,
        outputs: Outputs,
        lit: bool,
    ) -> LaunchList:
        """What a call launches."""
        out = LaunchList(self.launcher)
        shape = (transforms.shape[0], rays.shape[0], rays.shape[1])
        views, clear_record = self._begin(transforms, rays, settings), _clear(clear, settings)
        temporal = lit and settings.accumulate == "temporal"
        history_record = self._select(worlds, views, settings, lit, shape, out)
        sums = self._sums(shape, lit and (settings.filter or temporal), outputs.error.shape[0] > 0, temporal)
        samples = rays.shape[2]
        iterations = -(-settings.iterations // samples) * samples if lit else samples
        pixels = shape[0] * shape[1] * shape[2]
        for iteration in range(iterations):
            views.sample = iteration % samples
            if samples > 1 or iteration == 0:
                out.phase = "primary"
                inputs = [self.scene.worlds, views, self.scene.ids, clear_record, self._gbuffer, sums, outputs]
                out.launch(transport._trace_views, pixels, inputs)
            if lit:
                self._light(views, iteration, settings, shape, sums, out)
        layer = new_layer(*[self._scratch.array("none4", 1, wp.vec4)[:0]] * 2)
        out.phase = "history"
        if temporal:
            self._reproject(views, sums, history_record, iterations, settings.max_history, shape, out)
        out.phase = "filter"
        if lit and (settings.filter or temporal):
            layer = self._filter(views, sums, iterations, LEVELS if settings.filter else 0, shape, out)
        out.launch(images._write_images, pixels, [views, iterations, sums, layer, clear_record, outputs])
        out.launch(history._end_views, shape[0], [iterations if lit else 0, sums.count, self.step])
        return out

    def _check(self, transforms: Any, rays: Any, worlds: Any) -> None:
        device = self.launcher.device
        if transforms.dtype is not wp.transformf or transforms.ndim != 1 or not transforms.shape[0]:
            raise InputError("transforms: must be a transformf array of one dimension")
        if rays.dtype is not wp.vec3 or rays.ndim != 4 or rays.shape[3] != 2 or 0 in rays.shape:
            raise InputError("rays: must be a vec3 array [rows, columns, samples, 2]")
        if worlds is None and transforms.shape[0] > self.scene.world_count:
            raise InputError(f"worlds: {transforms.shape[0]} views of {self.scene.world_count} worlds need them")
        if worlds is not None and (worlds.dtype is not wp.int32 or worlds.shape != transforms.shape):
            raise InputError("worlds: must be an int32 array [views]")
        for name, array in (("transforms", transforms), ("rays", rays), ("worlds", worlds)):
            if array is not None and array.device != device:
                raise InputError(f"{name}: is on {array.device}, must be on {device}")

    def _output(self, name: str, array: Any, dtype: Any, shape: tuple[int, ...]) -> Any:
        """A flat view of an output; an empty array if it is not wanted."""
        if array is None:
            return self._scratch.array(f"none.{name}", 1, dtype)[:0]
        if array.dtype is not dtype or array.shape != shape or array.device != self.launcher.device:
            raise InputError(f"{name}: must be {dtype.__name__} {list(shape)} on {self.launcher.device}")
        if not array.is_contiguous:
            raise InputError(f"{name}: must be contiguous")
        return array.flatten()

    def _begin(self, transforms: Any, rays: Any, settings: ViewSettings) -> ViewRays:
        """The record of the views; buffers are made if their shape is another than in the last call."""
        scratch, scene = self._scratch, self.scene
        shape = (transforms.shape[0], *rays.shape[:3])
        if shape != self._shape:
            self._shape = shape
            self._gbuffer, _ = new_gbuffer(
                self.launcher,
                shape[2],
                shape[0] * shape[1],
                has_normals=scene.has_normals,
                has_normal_maps=scene.data.normal_map_count > 0,
                has_emission=scene.glows,
            )
            scratch.array("count", shape[0], wp.int32).zero_()
            scratch.array("history.has_pictures", shape[0], wp.int32).zero_()
            self._used = self.launcher.zeros(scene.world_count, wp.int32)
            self._calls.clear()
        views = ViewRays()
        views.transforms, views.rays = transforms, rays
        views.world = scratch.array("views.world", shape[0], wp.int32)[: shape[0]]
        views.slot = scratch.array("views.slot", shape[0], wp.int32)
        views.rows, views.columns, views.samples = shape[1:]
        views.cull, views.max_distance = int(settings.cull_back_faces), min(settings.max_distance, 1.0e30)
        views.origin, views.scale = wp.vec3(*scene.frame.origin.tolist()), scene.frame.scale
        return views

    def _select(
        self,
        worlds: Any,
        views: ViewRays,
        settings: ViewSettings,
        lit: bool,
        shape: tuple[int, ...],
        out: LaunchList,
    ) -> ViewHistory:
        """Gives the worlds that are shown their slots, and notes which views have not changed."""
        scratch, scene = self._scratch, self.scene
        count, rays_shape = scene.world_count, (*shape[1:], views.samples, 2)
        slots = min(shape[0], count)
        ends = scratch.array("ends of worlds", count, wp.int32)[:count]
        paths = self._paths
        paths.world_of_slot = scratch.array("world of slot", slots, wp.int32)
        paths.slot_count = scratch.array("slot count", 1, wp.int32)
        out.call(self._used.zero_)
        wanted = scratch.array("none.worlds", 1, wp.int32)[:0] if worlds is None else worlds
        out.launch(images._select_worlds, shape[0], [wanted, count, views, self._used])
        out.scan(self._used, ends)
        out.launch(transport._list_worlds, count, [self._used, ends, paths])
        record = ViewHistory()
        kinds = {"off": OFF, "static": STATIC, "temporal": TEMPORAL}
        record.accumulates = int(kinds[settings.accumulate] if lit else UNLIT)
        record.transforms = scratch.array("history.transforms", shape[0], wp.transformf)
        record.last_transforms = scratch.array("history.last_transforms", shape[0], wp.transformf)
        for name in ("world", "version", "has_pictures", "relation"):
            setattr(record, name, scratch.array(f"history.{name}", shape[0], wp.int32))
        record.rays_changed = scratch.array("history.rays_changed", shape[1], wp.int32)
        if lit and settings.accumulate != "off":
            total = int(np.prod(rays_shape))
            record.rays = scratch.array("history.rays", total, wp.vec3)[:total].reshape(rays_shape)
            out.launch(history._compare_rays, shape[1], [views, record])
        inputs = [ends, scene.versions, views, record, scratch.array("count", shape[0], wp.int32)]
        out.launch(history._begin_views, shape[0], inputs)
        return record

    def _sums(self, shape: tuple[int, ...], filtered: bool, error: bool, temporal: bool) -> ViewSums:
        scratch, pixels = self._scratch, shape[0] * shape[1] * shape[2]
        sums = ViewSums()
        sums.count = scratch.array("count", shape[0], wp.int32)
        sums.nearest = scratch.array("sums.nearest", pixels, wp.float32)
        sums.albedo = scratch.array("sums.albedo", pixels, wp.vec4)
        sums.radiance = scratch.array("sums.radiance", pixels, wp.vec3)
        allocations = scratch.allocations

        def optional(name: str, wanted: bool, dtype: Any) -> Any:
            return scratch.array(name, pixels, dtype) if wanted else scratch.array("none." + name, 1, dtype)[:0]

        sums.emission = optional("sums.emission", self._gbuffer.emission.shape[0] > 0, wp.vec3)
        sums.square = optional("sums.square", error, wp.float32)
        sums.direct = optional("sums.direct", filtered, wp.vec3)
        sums.indirect = optional("sums.indirect", filtered, wp.vec3)
        sums.squares = optional("sums.squares", filtered, wp.vec2)
        sums.reused = optional("sums.reused", temporal, wp.vec2)
        for name, kind in _SURFACES.items():
            setattr(sums.surfaces, name, optional(f"surfaces.{name}", temporal, kind))
        self._last, self._past = LastPictures(), PastLight()
        for record, prefix, names in ((self._last, "last", _LAST), (self._past, "past", _PAST)):
            for name, dtype in names.items():
                setattr(record, name, optional(f"{prefix}.{name}", temporal, dtype))
            record.radiance = optional(f"{prefix}.radiance", temporal and error, wp.vec3)
            record.square = optional(f"{prefix}.square", temporal and error, wp.float32)
        if scratch.allocations != allocations:
            sums.count.zero_()  # sums that are new have to begin with the first iteration
            scratch.array("history.has_pictures", shape[0], wp.int32).zero_()
        return sums

    def _reproject(
        self,
        views: ViewRays,
        sums: ViewSums,
        record: ViewHistory,
        iterations: int,
        most: int,
        shape: tuple[int, ...],
        out: LaunchList,
    ) -> None:
        """Adds what surfaces received in earlier steps, and keeps what pixels show for the next one."""
        scene, scratch, pixels = self.scene, self._scratch, shape[0] * shape[1] * shape[2]
        motion = Motion()
        motion.transforms = scene.transforms
        motion.last_transforms = scratch.array("motion.transforms", scene.count, wp.transformf)[: scene.count]
        rows = scene.deforming_rows
        motion.moving = scratch.array("none.moving", 1, wp.int32)[:0]
        if rows.shape[0]:
            if self._moving is None:
                table = np.full(scene.data.points.shape[0], -1)
                table[rows.numpy()] = np.arange(rows.shape[0])
                self._moving = self.launcher.array(table, wp.int32)
            motion.moving = self._moving
        motion.last_points = scratch.array("motion.points", max(rows.shape[0], 1), wp.vec3)
        inputs = [scene.worlds, views, record, motion, self._last, sums, self._past]
        out.launch(history._find_past, pixels, inputs)
        limit = float(most * iterations)
        out.launch(history._weigh_past, pixels, [views, record, iterations, limit, sums, self._past])
        out.launch(history._continue_views, pixels, [views, iterations, sums, self._past, self._last])
        out.call(partial(wp.copy, motion.last_transforms, motion.transforms))
        out.launch(history._keep_points, rows.shape[0], [rows, scene.data.points, motion.last_points])

    def _light(
        self,
        views: ViewRays,
        iteration: int,
        settings: ViewSettings,
        shape: tuple[int, ...],
        sums: ViewSums,
        out: LaunchList,
    ) -> None:
        """One iteration: the VPLs of every world in view, and what every pixel receives of them."""
        scene, paths = self.scene, self._paths
        slots = min(shape[0], scene.world_count)
        buffers = self._buffers(settings, slots)
        paths.paths, paths.slots = settings.light_paths, buffers.slots
        paths.step, paths.seed, paths.iteration = self.step, wp.uint32(settings.seed), iteration
        paths.settings, paths.scramble = buffers.settings, buffers.scramble
        paths.targets, paths.areas = scene.targets, scene.areas
        gathering = GatherSettings()
        gathering.rays, gathering.compensation_rays = wp.vec2i(*SHADOW_RAYS), wp.vec2i(*COMPENSATION_SHADOW_RAYS)
        gathering.max_bounces = buffers.settings.max_bounces
        gathering.scramble = buffers.scramble[0]
        count = buffers.slots * settings.light_paths
        rows = buffers.slots * buffers.rows
        for first_slot in range(0, slots, buffers.slots):
            paths.first_slot = first_slot
            out.phase = "emission"
            out.launch(transport._scramble_slots, buffers.slots, [paths])
            inputs = [scene.worlds, paths, buffers.lengths, buffers.ends, buffers.traced]
            out.launch(transport._trace_world_paths, count, inputs)
            out.scan(buffers.lengths, buffers.ends)
            inputs = [scene.worlds, paths, buffers.traced, buffers.lengths, buffers.ends, buffers.vpls]
            out.launch(transport._store_world_paths, count, inputs)
            if buffers.settings.recorded < buffers.settings.max_bounces:
                paths.settings.again = 1
                inputs = [scene.worlds, paths, buffers.lengths, buffers.ends, buffers.vpls]
                out.launch(transport._trace_world_paths, count, inputs)
                paths.settings.again = 0
            inputs = [scene.worlds, paths, buffers.max_sets, buffers.keys, buffers.order, buffers.sets]
            out.launch(transport._divide_worlds, rows, inputs)
            out.sort(buffers.keys, buffers.order, rows, transport.KEY_BITS + (buffers.slots - 1).bit_length())
            inputs = [scene.worlds, paths, buffers.blocks, buffers.slotted, buffers.sets]
            out.launch(transport._pack_worlds, buffers.slots * max(buffers.blocks, buffers.slotted), inputs)
            out.phase = "gather"
            inputs = [scene.worlds, views, paths, self._gbuffer, buffers.sets, gathering, sums]
            out.launch(transport._gather_views, shape[0] * shape[1] * shape[2], inputs)

    def _filter(
        self, views: ViewRays, sums: ViewSums, iterations: int, levels: int, shape: tuple[int, ...], out: LaunchList
    ) -> IrradianceLayer:
        """Means of irradiance, filtered on so many levels."""
        scratch, gbuffer = self._scratch, self._gbuffer
        pixels = shape[0] * shape[1] * shape[2]
        surfaces = PixelSurfaces()
        surfaces.columns, surfaces.rows = shape[2], shape[0] * shape[1]
        surfaces.position, surfaces.normal, surfaces.footprint = gbuffer.position, gbuffer.smooth_normal, gbuffer.depth
        surfaces.edge = scratch.array("none.edge", 1, wp.uint8)
        layers = [
            new_layer(scratch.array(f"direct {k}", pixels, wp.vec4), scratch.array(f"indirect {k}", pixels, wp.vec4))
            for k in range(2)
        ]
        out.launch(images._begin_filter, pixels, [views, surfaces, iterations, sums, layers[0]])
        for level in range(levels):
            sigmas = wp.vec2(*(sigma * SIGMA_DECAY**level for sigma in SIGMAS))
            out.launch(images._filter_views, pixels, [shape[1], surfaces, *layers, 1 << level, sigmas])
            layers.reverse()
        return layers[0]

    def _buffers(self, settings: ViewSettings, slots: int) -> "_WorldBuffers":
        data = self.scene.data
        key = settings.light_paths, settings.max_bounces, slots, data.shaped_count > 0, data.modifier_count > 0
        if key not in self._world_buffers:
            self._world_buffers[key] = _WorldBuffers(self.scene, settings, slots, self._bytes)
        return self._world_buffers[key]


class _WorldBuffers:
    """The VPLs of worlds: a part of every array for each slot, and the records that refer to these."""

    def __init__(self, scene: LiveScene, settings: ViewSettings, slots: int, limit: int) -> None:
        launcher, paths = scene.launcher, settings.light_paths
        empty = launcher.empty
        max_bounces = UNLIMITED if settings.max_bounces is None else settings.max_bounces
        self.settings = LightPathSettings()
        self.settings.paths = self.settings.on_lights = paths
        self.settings.max_bounces = max_bounces
        self.settings.recorded = min(CAPACITY_PER_PATH, max_bounces)
        self.settings.capacity = paths * self.settings.recorded
        self.settings.survivors = empty(1, wp.int32)
        importance = ViewImportance()
        importance.candidates = 1
        importance.per_intensity = empty(1, wp.vec2)
        self.settings.importance = importance
        self.rows = rows = paths + self.settings.capacity
        self.slots = slots = max(1, min(slots, limit // (rows * _BYTES_PER_ROW)))
        lanes = launcher.lanes
        self.max_sets = MAX_SETS_OF_BLOCKS if lanes else MAX_SETS
        self.slotted = 0 if lanes else rows
        most = [-(-n // LANES) + MAX_SETS_OF_BLOCKS - 1 if lanes and n else 0 for n in (paths, rows - paths)]
        self.blocks = sum(most)
        shaped = int(scene.data.shaped_count > 0)
        modified = scene.data.modifier_count > 0

        self.scramble = empty((slots, 1), wp.uint32)
        self.lengths, self.ends = empty(slots * paths, wp.int32), empty(slots * paths, wp.int32)
        self.keys, self.order = empty(2 * slots * rows, wp.int64), empty(2 * slots * rows, wp.int32)
        self._owned: list[Any] = []

        def part(count: int, dtype: Any) -> Any:
            """A function from slots to parts of a new array."""
            count = max(count, 1)
            array = empty(slots * count, dtype)
            self._owned.append(array)
            return lambda slot: array[slot * count : (slot + 1) * count]

        def buffer() -> Any:
            parts = {
                "count": part(1, wp.int32),
                "position": part(rows, wp.vec4),
                "normal": part(rows, wp.vec4),
                "intensity": part(rows, wp.vec3),
                "bounce": part(rows, wp.int32),
                "pdf_area": part(paths, wp.float32),
                "lift": part(1, wp.float32),
                "modifiers": part(paths if modified else 1, wp.int32),
            }

            def make(slot: int) -> VplBuffer:
                vpls = VplBuffer()
                vpls.capacity, vpls.on_lights = rows, paths
                for name, of in parts.items():
                    setattr(vpls, name, of(slot))
                return vpls

            return make

        traced, stored = buffer(), buffer()
        self.traced = launcher.array(record_rows(traced, slots, VplBuffer, launcher), VplBuffer)
        self.vpls = launcher.array(record_rows(stored, slots, VplBuffer, launcher), VplBuffer)
        kinds = []
        for kind, (begin, end, blocks) in enumerate(((0, paths, most[0]), (paths, rows, most[1]))):
            parts = {
                "rows": part(BLOCK_ROWS * blocks, vec16),
                "shaping": part(SHAPING_ROWS * blocks * shaped * (kind == 0), vec16),
                "slots": part(SLOT_ROWS * (end - begin) * (not lanes), wp.vec4),
                "slot_shaping": part(SLOT_SHAPING_ROWS * (end - begin) * shaped * (not lanes), wp.vec4),
                "intensity_bounce": part(max(LANES * blocks, end - begin), wp.vec4),
            }

            def make(slot: int, begin: int = begin, end: int = end, parts: Any = parts, kind: int = kind) -> VplSets:
                group = VplSets()
                group.vpls = stored(slot)
                group.order = self.order[slot * rows + begin : slot * rows + max(end, begin + 1)]
                group.shaped = shaped * (kind == 0)
                for name, of in parts.items():
                    setattr(group, name, of(slot))
                return group

            kinds.append(record_rows(make, slots, VplSets, launcher))
        both = np.empty(2 * slots, kinds[0].dtype)
        both[0::2], both[1::2] = kinds
        self.sets = launcher.array(both, VplSets).reshape((slots, 2))


_BYTES_PER_ROW = 200
"""Memory of a VPL in both buffers, the sort and the sets."""


def _clear(values: ClearValues, settings: ViewSettings) -> Clear:
    clear = Clear()
    clear.color, clear.albedo = wp.uint32(values.color), wp.uint32(values.albedo)
    if settings.linear:
        clear.color, clear.albedo = wp.uint32(_to_linear(values.color)), wp.uint32(_to_linear(values.albedo))
    clear.depth, clear.normal = values.depth, wp.vec3(*values.normal)
    clear.shape_index, clear.linear = wp.uint32(values.shape_index), int(settings.linear)
    return clear


def _to_linear(packed: int) -> int:
    """A packed sRGB colour as a packed linear one; alpha stays."""
    out = packed & 0xFF000000
    for shift in (0, 8, 16):
        linear = srgb_to_linear(np.array((packed >> shift & 0xFF) / 255.0))
        out |= int(linear * 255.0) << shift
    return out
