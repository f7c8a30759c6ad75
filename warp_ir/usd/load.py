"""A USD stage becomes a `Scene`: find what is drawn, read each prim once, place it, light it, look at it."""

import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pxr import Tf, Usd, UsdLux

from warp_ir.scene import InputError, Light, LightKind, Scene
from warp_ir.usd.assemble import Geometry, build_meshes
from warp_ir.usd.camera_prim import find_camera, framing_camera, read_camera, read_shutter, standing_camera
from warp_ir.usd.diagnose import explain_blackness, explain_dark_lights
from warp_ir.usd.images.cache import ImageCache
from warp_ir.usd.lights.light import LIGHTS, read_light
from warp_ir.usd.linking import Linking, link
from warp_ir.usd.settings.render_pass import find_render_pass
from warp_ir.usd.settings.render_spec import Product, RenderSpec, read_render_spec
from warp_ir.usd.stage.open import first_message, open_stage, quiet, time_code, up_axis
from warp_ir.usd.time_varying import Motion
from warp_ir.usd.traverse import Found, Site, walk
from warp_ir.usd.values.report import Report, Unreadable

_COUNTED = (
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
    "degenerate_faces",
    "triangles_absent",
    "unused_materials",
    "lights_without_emission",
    "composition_errors",
)
"""Counts that `Scene.stats` always has, in this order."""
_LEVELS = {"low": 0, "medium": 1, "high": 2, "veryhigh": 3}
"""How often `complexity` refines a subdivision surface, as usdrecord's complexities 1.0 to 1.3 do."""
_PURPOSES = ("default", "render", "proxy", "guide")
_DRAWN = ("default", "render")
"""The purposes that are drawn if nobody says otherwise."""


_DOME = Light("default dome", LightKind.DOME, (1.0, 1.0, 1.0))
_SLICES = 16
"""Moments that stand for the time in which the shutter is open."""
_SLICED_TRIANGLES = 20_000_000
"""Triangles that move, of all moments together, beyond which there are fewer moments."""


def load_usd(
    path: str | os.PathLike[str],
    *,
    time: float | str | None = None,
    **options: Any,
) -> Scene:
    """Load a USD file for rendering.

    A prim that cannot be read is skipped and named in `Scene.warnings`; the rest is loaded.

    Args:
        path: A .usd, .usda, .usdc or .usdz file.
        time: Time code; None: the stage's start; "default": the default time, at which nothing is animated.
        options: As for `StageReader`, which loads many moments of one file.

    Raises:
        InputError: The file cannot be opened, the camera does not exist or is unusable, an argument is wrong, or
            the scene is too large.
    """
    return StageReader(path, **options).read(time)


class StageReader:
    """An open stage, to be read at one moment after another: what does not move is read once.

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
            eye: Where to stand [3], in place of a camera of the stage, with USD's default lens.
            look_at: What to look at from there [3]; None: the middle of the scene.
            purposes: Which of default, render, proxy and guide to draw; None: those of the render settings, else
                default and render.
            complexity: How finely subdivision surfaces are drawn: "low" as their cages, "medium", "high" and "veryhigh"
                after one, two and three levels of refinement.
            default_light: What to do if nothing emits: "dome" adds a uniform white one of radiance 1, "none" nothing.
            metals: "diffuse" renders a metal as a diffuse surface of its base colour, "black" without its reflection.
            texture_wrap: What textures are beyond their edges where nothing says it: "black" as the specification has
                it, "clamp", "repeat" or "mirror".
            strict: Whether the first warning is an error.
            render_settings: Path of a RenderSettings prim; None: the one that the stage's metadata name, else the
                first.
            render_pass: Path or name of a RenderPass prim: its settings, and what takes part in it; None: all does.
            mask: Paths of prims: only they, what is above, below and related to them, and camera and render settings
                that are given by their paths, are loaded; () is all.
            variants: Selections of variants, `/prim{set=selection}`.
            session_layer: A USD file that is stronger than the stage.
            motion_blur: Whether to read what happens while the camera's shutter is open (`Scene.shutter`).

        Raises:
            InputError: A file cannot be opened, or an argument is wrong.
        """
        self.source = os.fspath(path)
        if purposes is not None and (isinstance(purposes, str) or not set(purposes) <= set(_PURPOSES)):
            raise InputError(f"purposes: {purposes!r} is not a selection of {', '.join(_PURPOSES)}")
        if complexity not in _LEVELS:
            raise InputError(f"complexity: {complexity!r} is none of {', '.join(_LEVELS)}")
        if default_light not in ("dome", "none"):
            raise InputError(f"default_light: '{default_light}' is neither 'dome' nor 'none'")
        if metals not in ("diffuse", "black"):
            raise InputError(f"metals: '{metals}' is neither 'diffuse' nor 'black'")
        if texture_wrap not in ("black", "clamp", "repeat", "mirror"):
            raise InputError(f"texture_wrap: '{texture_wrap}' is not one of black, clamp, repeat, mirror")
        if render_settings is not None and render_pass is not None:
            raise InputError("render_pass: a pass has its own render settings; give one of the two")
        if (eye is not None and camera is not None) or (look_at is not None and eye is None):
            raise InputError("eye: it stands in place of a camera, and look_at belongs to it")
        self._camera, self._purposes, self._default_light = camera, purposes, default_light
        self._eye, self._look_at = eye, look_at
        self._render_settings, self._motion_blur = render_settings, motion_blur
        self._levels = _LEVELS[complexity]
        self._opened = Report(self.source, strict=strict)
        self._metals, self._images = metals, ImageCache(self._opened, texture_wrap)
        with self._reading():
            self.stage = open_stage(
                self.source,
                self._opened,
                mask=mask,
                needed=[path for path in (camera, render_settings, render_pass) if path and path.startswith("/")],
                variants=variants,
                session_layer=None if session_layer is None else os.fspath(session_layer),
            )
            self._axis = up_axis(self.stage, self._opened)
            self._pass = find_render_pass(self.stage, render_pass, self._opened)
            if self._pass is not None:
                self._render_settings = self._pass.settings or None
            self._motion = Motion(self.stage)
        self._still: _Still | None = None
        self._shapes: dict[Any, Any] = {}
        self._moved = self._opened.section()

    def spec(self, time: float | str | None = None) -> RenderSpec:
        """What the stage's render settings ask for.

        Raises:
            InputError: There are no render settings of the given name.
        """
        with self._reading():
            return read_render_spec(
                self.stage, self._render_settings, time_code(self.stage, time), self._opened.section()
            )

    def read(self, time: float | str | None = None, product: Product | None = None) -> Scene:
        """The scene at a moment.

        Args:
            time: As for `load_usd`.
            product: Whose camera and settings; None: of the render settings' first.

        Raises:
            InputError: The camera or the scene cannot be used, or the time is no time.
        """
        if not (time is None or time == "default" or (isinstance(time, int | float) and math.isfinite(time))):
            raise InputError(f"time: {time} is not a finite number")
        with self._reading():
            code = time_code(self.stage, time)
            report = self._opened.section()
            report.include(self._opened)
            spec = read_render_spec(self.stage, self._render_settings, code, report)
            wanted = product or spec.products[0]
            chosen = None if self._eye else find_camera(self.stage, self._camera, wanted.camera, report)
            scene = replace(self._scene(code, chosen, spec, report), settings=dict(wanted.settings))
            slices: tuple[Scene, ...] = ()
            blurs = self._motion_blur and wanted.settings.get("motion_blur", True) and not code.IsDefault()
            if chosen is not None and blurs:
                slices = self._slices(scene, code.GetValue(), chosen, spec, report)
            return replace(scene, warnings=report.lines(), shutter=slices)

    @contextmanager
    def _reading(self) -> Iterator[None]:
        """Whatever USD or NumPy says of a damaged file is silence, or one line of error."""
        # Any number in a file may be NaN or huge; readers look at what they compute, NumPy need not say it first.
        with quiet(), np.errstate(all="ignore"):
            try:
                yield
            except Tf.ErrorException as error:  # damage that shows only when the value is unpacked
                raise InputError(f"{self.source}: cannot be read: {first_message(error)}") from None

    @property
    def moving_meshes(self) -> int:
        """How many of the gprims that were read last may be others, or elsewhere, at another time."""
        return 0 if self._still is None else len(self._still.moving.shapes)

    def _slices(
        self, scene: Scene, time: float, camera: Usd.Prim, spec: RenderSpec, report: Report
    ) -> tuple[Scene, ...]:
        """The scene at the middles of equal parts of the time in which the shutter is open."""
        opens, closes = read_shutter(camera, Usd.TimeCode(time), report)
        assert self._still is not None
        deforms = bool(self._still.moving.shapes) or self._motion.rearranges
        if closes <= opens or not (deforms or self._still.moving.lights or self._motion.moves(camera)):
            return ()
        # What stands still is there once for all moments.
        moving = scene.triangle_count - sum(len(mesh.triangles) for mesh in self._still.geometry.meshes)
        count = _SLICES
        while count > 2 and count * moving > _SLICED_TRIANGLES:
            count //= 2
        if count < _SLICES:
            report.warn(camera.GetPath(), f"motion blur of {count} moments, not {_SLICES}: what moves is large")
        moments = [time + opens + (k + 0.5) / count * (closes - opens) for k in range(count)]
        unsaid = self._opened.section()
        return tuple(self._scene(Usd.TimeCode(moment), camera, spec, unsaid) for moment in moments)

    def _scene(self, time: Usd.TimeCode, camera: Usd.Prim | None, spec: RenderSpec, report: Report) -> Scene:
        """Everything at one moment."""
        view = None if camera is None else read_camera(camera, time, report)
        key = (*(self._purposes or spec.purposes or _DRAWN), time.IsDefault(), spec.material_purposes)
        self._motion.purposes = spec.material_purposes
        still = self._still
        if still is None or self._motion.rearranges or key != still.key:
            still = self._still = self._walk(time, key)
        geometry, lights = still.geometry, still.lights
        report.include(still.report)
        if still.moving.shapes or still.moving.lights:
            moved = self._opened.section()
            geometry = self._with_moving(still, time, moved)
            lights = lights + _lights(still.moving.lights, time, moved)
            moved.include_new(self._moved)  # a shape that is known already does not tell again what it lacks
            report.include(moved)
            self._moved = moved
        meshes, materials = geometry.meshes, geometry.materials
        if not meshes:
            hint = "; it has proxies (purposes)" if report.stats["prims_proxy"] else ""
            report.warn("/", f"the stage draws no geometry{hint}")
        if not lights and not any(max(m.emission) > 0.0 for m in materials):
            dark = [site.prim for site in (*still.lamps, *still.moving.lights)]
            dark += [self.stage.GetPrimAtPath(mesh.light.name) for mesh in meshes if mesh.light is not None]
            explain_dark_lights(dark, time, report)
            if self._default_light == "dome":
                if meshes:
                    report.warn("/", "nothing emits light; a uniform white dome of radiance 1 is added")
                lights = (_DOME,)
        stats = dict.fromkeys(_COUNTED, 0) | report.stats
        stats["meshes"], stats["materials"], stats["lights"] = len(meshes), len(materials), len(lights)
        textures = {texture for material in materials for texture in material.textures}
        stats["textures"] = len(textures)
        stats["texels"] = sum(texture.pixels.shape[0] * texture.pixels.shape[1] for texture in textures)
        stats["instances"] = stats["native_instances"] + stats["point_instances"]
        stats["prototypes"] = len(geometry.instances)
        stats["prototype_places"] = sum(len(group.matrices) for group in geometry.instances)
        lights, meshes = link(self.stage, lights, meshes, report)
        scene = Scene(meshes, materials, lights, instances=geometry.instances, name=report.source)
        stats["triangles"], stats["triangles_seen"] = scene.triangle_count, scene.triangles_seen
        if self._eye:
            middle = np.mean(scene.bounds(), axis=0).tolist()
            view = standing_camera(self._eye, self._look_at or middle, self._axis)
        elif view is None:
            if meshes:
                along = "-Z" if self._axis == "Y" else "+Y"
                report.warn("/", f"no camera; one that looks along {along} frames the scene from outside")
            view = framing_camera(*scene.bounds(), self._axis)
        scene = replace(scene, camera=view, stats=stats)
        explain_blackness(scene, report)
        return replace(scene, warnings=report.lines())

    def _walk(self, time: Usd.TimeCode, key: tuple[Any, ...]) -> "_Still":
        """What is drawn, and where; what stays the same at all times is read the first time."""
        report = self._opened.section()
        found = walk(self.stage, time, key[:-2], report, self._pass)
        moving, staying = Found(), Found()
        for name in ("shapes", "lights"):
            for site in getattr(found, name):
                moves = self._motion.moves(site.prim) or (site.lamp is not None and self._motion.moves(site.lamp))
                getattr(moving if moves else staying, name).append(site)
        lamps = [site.lamp or site.prim for site in (*found.lights, *found.shapes)]
        linking = Linking(prim for prim in lamps if prim.HasAPI(UsdLux.LightAPI))
        if self._still is None or key != self._still.key or linking.rules != self._still.linking.rules:
            read = self._opened.section()
            geometry = build_meshes(
                staying.shapes,
                time,
                read,
                self._levels,
                images=self._images,
                metals=self._metals,
                purposes=key[-1],
                linking=linking,
            )
            lights = _lights(staying.lights, time, read)
            self._shapes.clear()
        else:
            read, geometry, lights = self._still.read, self._still.geometry, self._still.lights
        report.include(read)
        return _Still(key, moving, geometry, lights, tuple(staying.lights), linking, read, report)

    def _with_moving(self, still: "_Still", time: Usd.TimeCode, report: Report) -> Geometry:
        """All geometry: what stays, what only changes its place, whose shape is read once, and what changes itself."""
        sites = still.moving.shapes
        bends = [self._motion.reshapes(site.prim) for site in sites]
        rigid = [site for site, b in zip(sites, bends, strict=True) if not b]
        bending = [site for site, b in zip(sites, bends, strict=True) if b]
        whole = still.geometry
        for some, shapes in ((rigid, self._shapes), (bending, {})):
            if some:
                more = build_meshes(
                    some,
                    time,
                    report,
                    self._levels,
                    shapes,
                    self._images,
                    self._metals,
                    self._motion.purposes,
                    still.linking,
                )
                whole = _join(whole, more)
        return whole


@dataclass(frozen=True, eq=False)
class _Still:
    """What a stage keeps from one moment to the next."""

    key: tuple[Any, ...]
    """The purposes that are drawn, whether it was at the default time, and the purposes of materials."""
    moving: Found
    """What has to be read each time."""
    geometry: Geometry
    lights: tuple[Light, ...]
    lamps: tuple[Site, ...]
    """The lights that stay, those too that emit nothing."""
    linking: Linking
    read: Report
    """Of the geometry and the lights that stay."""
    report: Report
    """The same and of the walk."""


def _join(one: Geometry, other: Geometry) -> Geometry:
    """The meshes and instances of both, one table of materials."""
    materials = list(one.materials) if one.meshes else []
    known = {material: k for k, material in enumerate(materials)}
    index = []
    for material in other.materials if other.meshes else ():
        if material not in known:
            known[material] = len(materials)
            materials.append(material)
        index.append(known[material])
    renamed = np.array(index, dtype=np.int32)
    meshes = tuple(replace(mesh, material=renamed[mesh.material]) for mesh in other.meshes)
    first = len(one.meshes)
    instances = tuple(replace(group, meshes=tuple(first + k for k in group.meshes)) for group in other.instances)
    return Geometry((*one.meshes, *meshes), (*one.instances, *instances), tuple(materials))


def _lights(sites: Sequence[Site], time: Usd.TimeCode, report: Report) -> tuple[Light, ...]:
    lights: list[Light] = []
    for site in sites:
        kind = LIGHTS[site.prim.GetPrimTypeInfo().GetSchemaTypeName()]
        try:
            found = read_light(site.prim, kind, site.matrices, time, report)
        except Unreadable as trouble:
            report.warn(site.prim.GetPath(), f"{trouble}; the light is skipped")
            continue
        report.stats["lights_without_emission"] += len(site.matrices) - len(found)
        lights += found
    return tuple(lights)
