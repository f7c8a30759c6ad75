"""Loads a USD stage as a `Scene`: static prims are read once, varying prims at every time."""

import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypedDict

import numpy as np
from pxr import Tf, Usd, UsdLux

from warp_ir.scene import Camera, InputError, Light, LightKind, Mesh, Scene
from warp_ir.usd.assemble import Geometry, ShapeCache, build_meshes
from warp_ir.usd.camera_prim import all_cameras, eye_camera, find_camera, framing_camera, read_camera, read_shutter
from warp_ir.usd.diagnose import diagnose_black_picture, diagnose_dark_lights
from warp_ir.usd.geometry.detail import PixelSize, pixel_size
from warp_ir.usd.geometry.prototypes import reuse_prototypes
from warp_ir.usd.images.cache import ImageCache
from warp_ir.usd.lights.light import LIGHTS, read_light
from warp_ir.usd.lights.sky import overcast_sky
from warp_ir.usd.linking import LightLinks, link_lights
from warp_ir.usd.settings.render_pass import find_render_pass
from warp_ir.usd.settings.render_spec import Product, RenderSpec, read_render_spec
from warp_ir.usd.stage.open import first_message, layer_files, open_stage, quiet_diagnostics, time_code, up_axis
from warp_ir.usd.time_varying import TimeVarying
from warp_ir.usd.traverse import DrawnPrim, DrawnPrims, traverse_stage
from warp_ir.usd.values.report import Report, Unreadable

if TYPE_CHECKING:
    from typing_extensions import Unpack

_STATS = (
    "meshes",
    "triangles",
    "triangles_seen",
    "materials",
    "images",
    "textures",
    "texels",
    "lights",
    "instances",
    "native_instances",
    "point_instances",
    "prototypes",
    "prototype_places",
    "prims_invisible",
    "prims_other_purpose",
    "prims_outside_pass",
    "draw_modes",
    "degenerate_faces",
    "triangles_absent",
    "unused_materials",
    "lights_without_emission",
    "composition_errors",
)
"""Counters that `Scene.stats` always contains, in this order."""
_REFINEMENT_LEVELS = {"low": 0, "medium": 1, "high": 2, "veryhigh": 3}
"""Refinement levels of subdivision surfaces for usdrecord's complexities 1.0 to 1.3."""
_PURPOSES = ("default", "render", "proxy", "guide")
_DEFAULT_PURPOSES = ("default", "render")
"""Purposes that are drawn if neither the caller nor the render settings choose."""
_DEFAULT_DOME = Light("default dome", LightKind.DOME, (1.0, 1.0, 1.0))
_SHUTTER_SAMPLES = 16
"""Shutter samples: scenes at the midpoints of equal parts of the shutter interval."""
_MAX_SHUTTER_TRIANGLES = 20_000_000
"""Maximum number of triangles that are stored anew for each shutter sample; beyond it there are fewer samples."""


class StageOptions(TypedDict, total=False):
    """The keyword arguments of `StageReader`, which documents them."""

    camera: str | None
    eye: Sequence[float] | None
    look_at: Sequence[float] | None
    purposes: Sequence[str] | None
    complexity: str
    default_light: str
    metals: str
    materials: str
    texture_wrap: str
    strict: bool
    render_settings: str | None
    render_pass: str | None
    mask: Sequence[str]
    variants: Sequence[str]
    session_layer: str | os.PathLike[str] | None
    motion_blur: bool


def load_usd(
    path: str | os.PathLike[str],
    *,
    time: float | str | None = None,
    **options: "Unpack[StageOptions]",
) -> Scene:
    """Load a USD file for rendering.

    A prim that cannot be read is skipped and named in `Scene.warnings`; the rest is loaded.

    Args:
        path: A .usd, .usda, .usdc or .usdz file.
        time: Time code; None: the stage's start; "default": the default time, at which nothing is animated.
        options: Keyword arguments of `StageReader`, which loads a file at several times.

    Raises:
        InputError: The file cannot be opened, the camera does not exist or is unusable, an argument is wrong, or
            the scene is too large.
    """
    return StageReader(path, **options).read(time)


class StageReader:
    """An open stage that is read at one or several times; prims that cannot vary are read once.

    Static meshes are the same objects in every `Scene`, so that a `Renderer` need not upload them again.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        camera: str | None = None,
        eye: Sequence[float] | None = None,
        look_at: Sequence[float] | None = None,
        purposes: Sequence[str] | None = None,
        complexity: str = "low",
        default_light: str = "dome",
        metals: str = "diffuse",
        materials: str = "diffuse",
        texture_wrap: str = "black",
        strict: bool = False,
        render_settings: str | None = None,
        render_pass: str | None = None,
        mask: Sequence[str] = (),
        variants: Sequence[str] = (),
        session_layer: str | os.PathLike[str] | None = None,
        motion_blur: bool = True,
    ) -> None:
        """Opens the stage.

        Args:
            path: A .usd, .usda, .usdc or .usdz file.
            camera: Absolute path or name of the camera; None: the one the render settings name, else "main_cam",
                else the first, else one that frames the scene.
            eye: Position [3] of a camera with USD's default lens that replaces the cameras of the stage.
            look_at: The point [3] that this camera looks at; None: the centre of the scene's bounds.
            purposes: Which of default, render, proxy and guide to draw; None: those of the render settings, else
                default and render.
            complexity: Refinement of subdivision surfaces: "low" draws their cages, "medium", "high" and "veryhigh"
                one, two and three levels of refinement.
            default_light: What to do if nothing emits: "dome" adds a uniform white dome of radiance 1, "sky" an
                overcast sky over grey ground, "none" nothing.
            metals: "diffuse" renders a metal as a diffuse surface of its base colour, "black" without its reflection.
            materials: "diffuse" reads what is reflected alike in all directions, "all" gloss and mirrors as well, which
                the estimator `path` renders.
            texture_wrap: Wrap mode of textures for which the file gives none: "black" (the specification's default),
                "clamp", "repeat" or "mirror".
            strict: Whether the first warning is an error.
            render_settings: Path of a RenderSettings prim; None: the one that the stage's metadata name, else the
                first.
            render_pass: Path or name of a RenderPass prim, which gives the render settings and selects prims; None:
                all prims take part.
            mask: Paths of prims (population mask): only they, their ancestors, descendants and relations, and camera
                and render settings that are given by path, are loaded; () is all.
            variants: Selections of variants, `/prim{set=selection}`.
            session_layer: A USD file with opinions stronger than the stage's.
            motion_blur: Whether to read the scene at several times of the shutter interval (`Scene.shutter`).

        Raises:
            InputError: A file cannot be opened, or an argument is wrong.
        """
        self.source = os.fspath(path)
        if purposes is not None and (isinstance(purposes, str) or not set(purposes) <= set(_PURPOSES)):
            raise InputError(f"purposes: {purposes!r} is not a selection of {', '.join(_PURPOSES)}")
        if complexity not in _REFINEMENT_LEVELS:
            raise InputError(f"complexity: {complexity!r} is none of {', '.join(_REFINEMENT_LEVELS)}")
        if default_light not in ("dome", "sky", "none"):
            raise InputError(f"default_light: '{default_light}' is not one of 'dome', 'sky', 'none'")
        if metals not in ("diffuse", "black"):
            raise InputError(f"metals: '{metals}' is neither 'diffuse' nor 'black'")
        if materials not in ("diffuse", "all"):
            raise InputError(f"materials: '{materials}' is neither 'diffuse' nor 'all'")
        if materials == "all" and metals != "diffuse":
            raise InputError(f"metals: '{metals}' has no effect with materials 'all'")
        if texture_wrap not in ("black", "clamp", "repeat", "mirror"):
            raise InputError(f"texture_wrap: '{texture_wrap}' is not one of black, clamp, repeat, mirror")
        if render_settings is not None and render_pass is not None:
            raise InputError("render_pass: a pass names its render settings; give only one of the two")
        if (eye is not None and camera is not None) or (look_at is not None and eye is None):
            raise InputError("eye: it replaces camera, and look_at needs it")
        self._camera, self._purposes, self._default_light = camera, purposes, default_light
        self._session_layers = () if session_layer is None else (os.fspath(session_layer),)
        self._eye, self._look_at = eye, look_at
        self._render_settings, self._motion_blur = render_settings, motion_blur
        self._levels = _REFINEMENT_LEVELS[complexity]
        self._open_report = Report(self.source, strict=strict)
        self._reflection = "all" if materials == "all" else metals
        self._images = ImageCache(self._open_report, texture_wrap)
        with self._reading():
            self.stage = open_stage(
                self.source,
                self._open_report,
                mask=mask,
                needed=[path for path in (camera, render_settings, render_pass) if path and path.startswith("/")],
                variants=variants,
                session_layer=None if session_layer is None else os.fspath(session_layer),
            )
            self._up_axis = up_axis(self.stage, self._open_report)
            self._pass = find_render_pass(self.stage, render_pass, self._open_report)
            if self._pass is not None:
                self._render_settings = self._pass.settings or None
            self._time_varying = TimeVarying(self.stage)
        self._static: _StaticPart | None = None
        self._rigid_shapes: ShapeCache = {}
        self._moving_report = self._open_report.section()
        self._times = 1  # for which moving gprims are read: 1, or the number of shutter samples
        self._moving_triangles = 0  # stored anew at every time
        self._pixel: PixelSize | None = None  # of the picture; None: not known, or not the same at all times
        self._prototypes: tuple[Mesh, ...] = ()  # of moving instances, at the last time

    def spec(self, time: float | str | None = None) -> RenderSpec:
        """The render settings of the stage, with all products.

        Args:
            time: Time code, as for `load_usd`.

        Raises:
            InputError: There is no RenderSettings prim of the given name.
        """
        with self._reading():
            return read_render_spec(
                self.stage, self._render_settings, time_code(self.stage, time), self._open_report.section()
            )

    def read(self, time: float | str | None = None, product: Product | None = None) -> Scene:
        """The scene at a time.

        Args:
            time: Time code, as for `load_usd`.
            product: The product whose camera and settings are used; None: the first of the render settings.

        Raises:
            InputError: The camera or the scene cannot be used, or the time is not a finite number.
        """
        if not (time is None or time == "default" or (isinstance(time, int | float) and math.isfinite(time))):
            raise InputError(f"time: {time} is not a finite number")
        with self._reading():
            usd_time = time_code(self.stage, time)
            report = self._open_report.section()
            report.include(self._open_report)
            spec = read_render_spec(self.stage, self._render_settings, usd_time, report)
            product = product or spec.products[0]
            camera_prim = (
                None if self._eye is not None else find_camera(self.stage, self._camera, product.camera, report)
            )
            interval = 0.0, 0.0
            blurs = self._motion_blur and product.settings.get("motion_blur", True) and not usd_time.IsDefault()
            if camera_prim is not None and blurs:
                interval = read_shutter(camera_prim, usd_time, report)
            self._times = _SHUTTER_SAMPLES if interval[1] > interval[0] else 1
            scene = replace(self._scene(usd_time, camera_prim, spec, report), settings=dict(product.settings))
            shutter: tuple[Scene, ...] = ()
            if camera_prim is not None and self._times > 1:
                shutter = self._shutter_scenes(usd_time.GetValue(), interval, camera_prim, spec, report)
            return replace(scene, warnings=report.lines(), shutter=shutter)

    @contextmanager
    def _reading(self) -> Iterator[None]:
        """Silences diagnostics of USD and NumPy; damage that USD finds late becomes one `InputError`."""
        # Any number in a file may be NaN or huge; readers check their results, so NumPy's warnings add nothing.
        with quiet_diagnostics(), np.errstate(all="ignore"):
            try:
                yield
            except Tf.ErrorException as error:  # damage that USD finds only when it unpacks a value
                raise InputError(f"{self.source}: cannot be read: {first_message(error)}") from None

    @property
    def moving_meshes(self) -> int:
        """Number of gprims of the last `read` that may differ at another time."""
        return 0 if self._static is None else len(self._static.moving.gprims)

    @property
    def up_axis(self) -> str:
        """Y or Z."""
        return self._up_axis

    @property
    def frames(self) -> tuple[float, float] | None:
        """First and last time code of the stage; None: it names none."""
        with self._reading():
            if not self.stage.HasAuthoredTimeCodeRange():
                return None
            return float(self.stage.GetStartTimeCode()), float(self.stage.GetEndTimeCode())

    @property
    def files(self) -> tuple[str, ...]:
        """The files of the layers that the stage is composed of."""
        with self._reading():
            return layer_files(self.stage, self.source, *self._session_layers)

    def cameras(self, time: float | str | None = None) -> tuple[Camera, ...]:
        """All cameras of the stage that can be used, in the stage's order.

        Args:
            time: Time code, as for `load_usd`.
        """
        cameras, discarded = [], Report(self.source)
        with self._reading():
            for prim in all_cameras(self.stage):
                with suppress(InputError):
                    cameras.append(read_camera(prim, time_code(self.stage, time), discarded))
        return tuple(cameras)

    def _shutter_scenes(
        self, time: float, interval: tuple[float, float], camera: Usd.Prim, spec: RenderSpec, report: Report
    ) -> tuple[Scene, ...]:
        """The scene at the midpoints of equal parts of the shutter interval; () if nothing moves."""
        assert self._static is not None
        opens, closes = interval
        deforms = bool(self._static.moving.gprims) or self._time_varying.layout_varies
        if not (deforms or self._static.moving.lights or self._time_varying.varies(camera)):
            return ()
        count = _SHUTTER_SAMPLES
        while count > 2 and count * self._moving_triangles > _MAX_SHUTTER_TRIANGLES:
            count //= 2
        if count < _SHUTTER_SAMPLES:
            what = f"motion blur uses {count} shutter samples, not {_SHUTTER_SAMPLES}: the moving geometry is large"
            report.warn(camera.GetPath(), what)
        times = [time + opens + (k + 0.5) / count * (closes - opens) for k in range(count)]
        discarded = self._open_report.section()
        return tuple(self._scene(Usd.TimeCode(t), camera, spec, discarded) for t in times)

    def _scene(self, time: Usd.TimeCode, camera: Usd.Prim | None, spec: RenderSpec, report: Report) -> Scene:
        """The scene at one time, without shutter samples."""
        camera_record = None if camera is None else read_camera(camera, time, report)
        if self._eye is not None:
            ahead = (self._eye[0] + 1.0, *self._eye[1:])  # where it looks does not matter
            self._pixel = pixel_size(eye_camera(self._eye, ahead, self._up_axis))
        elif camera is not None and camera_record is not None and not self._time_varying.varies(camera):
            self._pixel = pixel_size(camera_record)
        else:
            self._pixel = None
        purposes = tuple(self._purposes or spec.purposes or _DEFAULT_PURPOSES)
        key = _StaticKey(purposes, spec.material_purposes, time.IsDefault())
        self._time_varying.purposes = spec.material_purposes
        static = self._static
        if static is None or self._time_varying.layout_varies or key != static.key:
            static = self._static = self._read_static(time, key)
        geometry, lights = static.geometry, static.lights
        report.include(static.report)
        self._moving_triangles = 0
        if static.moving.gprims or static.moving.lights:
            moving_report = self._open_report.section()
            geometry = self._with_moving_gprims(static, time, moving_report)
            lights = lights + _lights(static.moving.lights, time, moving_report)
            moving_report.include_new(
                self._moving_report
            )  # cached shapes do not repeat the warnings of their first read
            report.include(moving_report)
            self._moving_report = moving_report
        meshes, materials = geometry.meshes, geometry.materials
        if not meshes:
            hint = "; it has proxies (purposes)" if report.stats["prims_proxy"] else ""
            report.warn("/", f"the stage draws no geometry{hint}")
        if not lights and not any(max(m.emission) > 0.0 for m in materials):
            dark_lights = [drawn.prim for drawn in (*static.light_prims, *static.moving.lights)]
            dark_lights += [self.stage.GetPrimAtPath(mesh.light.name) for mesh in meshes if mesh.light is not None]
            diagnose_dark_lights(dark_lights, time, report)
            if self._default_light == "dome":
                if meshes:
                    report.warn("/", "nothing emits light; a uniform white dome of radiance 1 is added")
                lights = (_DEFAULT_DOME,)
            elif self._default_light == "sky":
                if meshes:
                    report.warn("/", "nothing emits light; an overcast sky over grey ground is added")
                lights = (overcast_sky(self._up_axis),)
        lights, meshes = link_lights(self.stage, lights, meshes, report)
        scene = Scene(meshes, materials, lights, instances=geometry.instances, name=report.source)
        if self._eye is not None:
            center = np.mean(scene.bounds(), axis=0).tolist()
            camera_record = eye_camera(self._eye, center if self._look_at is None else self._look_at, self._up_axis)
        elif camera_record is None:
            camera_record, direction = framing_camera(scene, self._up_axis)
            if meshes:
                report.warn("/", f"no camera; one that looks along {direction} frames the scene from outside")
        scene = replace(scene, camera=camera_record, stats=_stats(scene, report))
        diagnose_black_picture(scene, report)
        return replace(scene, warnings=report.lines())

    def _read_static(self, time: Usd.TimeCode, key: "_StaticKey") -> "_StaticPart":
        """Traverses the stage and reads its static part, or reuses that of the last traversal if the key is equal."""
        report = self._open_report.section()
        all_prims = traverse_stage(self.stage, time, key.purposes, report, self._pass)
        moving, fixed = DrawnPrims(), DrawnPrims()
        for drawn in all_prims.gprims:
            (moving if self._varies(drawn) else fixed).gprims.append(drawn)
        for drawn in all_prims.lights:
            (moving if self._varies(drawn) else fixed).lights.append(drawn)
        light_prims = [drawn.geometry_light or drawn.prim for drawn in (*all_prims.lights, *all_prims.gprims)]
        links = LightLinks(prim for prim in light_prims if prim.HasAPI(UsdLux.LightAPI))
        if self._static is None or key != self._static.key or links.key != self._static.links.key:
            read = self._open_report.section()
            geometry = build_meshes(
                fixed.gprims,
                time,
                read,
                self._levels,
                images=self._images,
                reflection=self._reflection,
                purposes=key.material_purposes,
                links=links,
                pixel=self._pixel,
            )
            lights = _lights(fixed.lights, time, read)
            self._rigid_shapes.clear()
        else:
            read, geometry, lights = self._static.read, self._static.geometry, self._static.lights
        report.include(read)
        return _StaticPart(key, moving, geometry, lights, tuple(fixed.lights), links, read, report)

    def _varies(self, drawn: DrawnPrim) -> bool:
        """Whether a prim, or the GeometryLight that makes it emit, may vary with time."""
        prims = (drawn.prim, drawn.geometry_light)
        return any(prim is not None and self._time_varying.varies(prim) for prim in prims)

    def _with_moving_gprims(self, static: "_StaticPart", time: Usd.TimeCode, report: Report) -> Geometry:
        """Static geometry, and that of varying gprims at a time.

        Shapes of gprims that move rigidly are cached, and large ones are stored once for all shutter samples, as
        prototypes; deforming ones are read anew.
        """
        deforming = [self._time_varying.deforms(drawn.prim) for drawn in static.moving.gprims]
        geometry = static.geometry
        for shape_cache, deforms in ((self._rigid_shapes, False), ({}, True)):
            gprims = [drawn for drawn, d in zip(static.moving.gprims, deforming, strict=True) if d == deforms]
            if self._times > 1 and not deforms:
                gprims = [drawn.as_instance() if drawn.level.instance_count == 1 else drawn for drawn in gprims]
            if gprims:
                added = build_meshes(
                    gprims,
                    time,
                    report,
                    self._levels,
                    shape_cache,
                    self._images,
                    self._reflection,
                    self._time_varying.purposes,
                    static.links,
                    self._times,
                    self._pixel,
                )
                rigid = set() if deforms else {k for group in added.instances for k in group.meshes}
                self._moving_triangles += sum(len(m.triangles) for k, m in enumerate(added.meshes) if k not in rigid)
                geometry = _merged(geometry, added)
        moving_instances = geometry.instances[len(static.geometry.instances) :]
        meshes, self._prototypes = reuse_prototypes(geometry.meshes, moving_instances, self._prototypes)
        return replace(geometry, meshes=meshes)


@dataclass(frozen=True)
class _StaticKey:
    """On what the static part of a stage depends."""

    purposes: tuple[str, ...]
    """Purposes that are drawn."""
    material_purposes: tuple[str, ...]
    """Purposes of material bindings, in order of preference."""
    default_time: bool
    """Whether values are those of the default time."""


@dataclass(frozen=True, eq=False)
class _StaticPart:
    """The static part of a stage, shared by all times of equal `key`."""

    key: _StaticKey
    moving: DrawnPrims
    """Prims that are read at every time."""
    geometry: Geometry
    lights: tuple[Light, ...]
    light_prims: tuple[DrawnPrim, ...]
    """Light prims that do not vary, including those that emit nothing."""
    links: LightLinks
    read: Report
    """Warnings and counts of the static geometry and lights."""
    report: Report
    """The above together with those of the traversal."""


def _merged(one: Geometry, other: Geometry) -> Geometry:
    """Both geometries with one table of materials."""
    materials = list(one.materials) if one.meshes else []
    index_of = {material: k for k, material in enumerate(materials)}
    index = []
    for material in other.materials if other.meshes else ():
        if material not in index_of:
            index_of[material] = len(materials)
            materials.append(material)
        index.append(index_of[material])
    renamed = np.array(index, dtype=np.int32)
    meshes = tuple(replace(mesh, material=renamed[mesh.material]) for mesh in other.meshes)
    first = len(one.meshes)
    instances = tuple(replace(group, meshes=tuple(first + k for k in group.meshes)) for group in other.instances)
    return Geometry((*one.meshes, *meshes), (*one.instances, *instances), tuple(materials))


def _stats(scene: Scene, report: Report) -> dict[str, int]:
    """The counters of `Scene.stats`."""
    stats = dict.fromkeys(_STATS, 0) | report.stats
    stats["meshes"], stats["materials"], stats["lights"] = len(scene.meshes), len(scene.materials), len(scene.lights)
    textures = {texture for material in scene.materials for texture in material.textures}
    stats["textures"] = len(textures)
    stats["texels"] = sum(texture.pixels.shape[0] * texture.pixels.shape[1] for texture in textures)
    stats["instances"] = stats["native_instances"] + stats["point_instances"]
    stats["prototypes"] = len(scene.instances)
    stats["prototype_places"] = sum(len(group.matrices) for group in scene.instances)
    stats["triangles"], stats["triangles_seen"] = scene.triangle_count, scene.triangles_seen
    return stats


def _lights(drawn_prims: Sequence[DrawnPrim], time: Usd.TimeCode, report: Report) -> tuple[Light, ...]:
    """The records of light prims in all their instances; unreadable prims are reported and skipped."""
    lights: list[Light] = []
    for drawn in drawn_prims:
        kind = LIGHTS[drawn.prim.GetPrimTypeInfo().GetSchemaTypeName()]
        try:
            records = read_light(drawn.prim, kind, drawn.matrices, time, report)
        except Unreadable as trouble:
            report.warn(drawn.prim.GetPath(), f"{trouble}; the light is skipped")
            continue
        report.stats["lights_without_emission"] += len(drawn.matrices) - len(records)
        lights += records
    return tuple(lights)
