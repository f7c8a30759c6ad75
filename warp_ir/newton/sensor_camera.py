"""`SensorCamera`: takes the place of `newton.sensors.SensorCamera`, and light bounces.

    from warp_ir.newton import SensorCamera          # instead of newton.sensors

A call reads the state by kernels, refits what rays traverse, and renders all views:

    state.body_q, particle_q, shape_color  ->  LiveScene     simulation/live_scene.py
    views, in worlds                       ->  images        simulation/views.py

The conventions of Newton's sensor hold. Unlike it, all lights cast shadows, surfaces reflect and block light from both
sides whatever camera rays pass, and the light that bounces is there.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.sensors import SensorCamera as NewtonSensorCamera

from warp_ir.newton.model_scene import ModelScene, check_model, model_scene
from warp_ir.scene import Floats, InputError, Light, LightKind
from warp_ir.simulation import ClearValues, LiveScene, Views, ViewSettings
from warp_ir.simulation.images import from_srgb
from warp_ir.simulation.live_scene import fixed_frame
from warp_ir.simulation.placement import Placements, color_instance, move_instance

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

AMBIENT_SKY = (0.2, 0.2, 0.225)
"""Radiance from above unless `set_ambient_light` is called, as in Newton."""
AMBIENT_GROUND = (0.05, 0.05, 0.06)
_DOME_ROWS = 256


@dataclass(frozen=True, kw_only=True)
class GiSettings:
    """How light is computed. Every value is checked on construction of the sensor; an `InputError` names the field."""

    iterations: int = 1
    """Iterations of a call: the error falls with the root of their number, and time is in proportion to it."""
    light_paths: int = 512
    """Light paths of a world in an iteration."""
    max_bounces: int | None = None
    """Largest number of indirect bounces; 0: direct light alone; None: no limit."""
    filter: bool = True
    """Whether the noise is filtered; else a picture is the unbiased mean of its iterations."""
    accumulate: str = "off"
    """"off": every call begins anew. "static": a view's mean goes on while nothing that it depends on has changed.
    "temporal": what a surface received in earlier steps goes on while it moves, which is biased: changes of light are
    seen late."""
    max_history: int = 8
    """Of "temporal": for how many steps at most the past counts."""
    seed: int = 0
    """Seed of the random numbers."""
    extent: float | None = None
    """Radius [m] around what a world's bodies cover at first, at which half of the photons of suns and skies is aimed;
    None: that of the bodies. What is infinite does not count."""
    lights: Sequence[Light] = ()
    """More lights, in all worlds."""


@wp.kernel
def _pose_shapes(
    first: int,
    shapes: wp.array[wp.int32],
    shape_body: wp.array[wp.int32],
    shape_transform: wp.array[wp.transformf],
    body_q: wp.array[wp.transformf],
    placements: Placements,
    changed: wp.array[wp.int32],
) -> None:
    """Moves the instance of a shape to where its body is."""
    i = first + wp.tid()
    body = shape_body[shapes[i]]
    pose = shape_transform[shapes[i]]
    if body >= 0:
        pose = wp.transform_multiply(body_q[body], pose)
    move_instance(placements, changed, i, pose)


@wp.kernel
def _pose_particles(
    first: int,
    particles: wp.array[wp.int32],
    particle_q: wp.array[wp.vec3],
    row: int,
    placements: Placements,
    changed: wp.array[wp.int32],
) -> None:
    """Moves the instance of a particle; those of particles begin at a row."""
    i = first + wp.tid()
    pose = wp.transformf(particle_q[particles[i]], wp.quat_identity())
    move_instance(placements, changed, row + i, pose)


@wp.kernel
def _color_shapes(
    first: int,
    shapes: wp.array[wp.int32],
    shape_color: wp.array[wp.vec3],
    placements: Placements,
    colors: wp.array[wp.vec3],
    changed: wp.array[wp.int32],
) -> None:
    """Colours the instance of a shape by its sRGB colour."""
    i = first + wp.tid()
    c = shape_color[shapes[i]]
    linear = wp.vec3()
    for k in range(3):
        linear[k] = from_srgb(wp.clamp(c[k], 0.0, 1.0))
    color_instance(placements, colors, changed, i, linear)


class SensorCamera:
    """Renders a Newton model with global illumination; see `newton.sensors.SensorCamera` for what is not said here."""

    AntiAliasing = NewtonSensorCamera.AntiAliasing
    ClearData = NewtonSensorCamera.ClearData
    DeformableSurfaceMode = NewtonSensorCamera.DeformableSurfaceMode
    GaussianRenderMode = NewtonSensorCamera.GaussianRenderMode
    RenderConfig = NewtonSensorCamera.RenderConfig
    RenderOrder = NewtonSensorCamera.RenderOrder
    TextureProjectionMode = NewtonSensorCamera.TextureProjectionMode
    Utils = NewtonSensorCamera.Utils
    WorldRenderFlag = NewtonSensorCamera.WorldRenderFlag

    compute_camera_rays_pinhole = staticmethod(NewtonSensorCamera.compute_camera_rays_pinhole)
    compute_camera_rays_pinhole_opencv = staticmethod(NewtonSensorCamera.compute_camera_rays_pinhole_opencv)
    compute_camera_rays_fisheye_opencv = staticmethod(NewtonSensorCamera.compute_camera_rays_fisheye_opencv)
    compute_camera_rays_fisheye_ftheta = staticmethod(NewtonSensorCamera.compute_camera_rays_fisheye_ftheta)
    compute_camera_rays_fisheye_kannala_brandt = staticmethod(
        NewtonSensorCamera.compute_camera_rays_fisheye_kannala_brandt
    )

    def __init__(
        self,
        model: Any,
        *,
        default_clear_data: Any = None,
        default_render_config: Any = None,
        load_textures: bool = True,
        deformable_surface_mode: Any = NewtonSensorCamera.DeformableSurfaceMode.BOTH,
        gi: GiSettings | None = None,
    ) -> None:
        """Reads a model.

        Args:
            model: The model; its device is that of the sensor.
            default_clear_data: As in Newton.
            default_render_config: As in Newton. Textures, ambient light, particles, the global world, culling, colour
                space, anti-aliasing and distance are honoured; shadows are always there, and what tunes Newton's
                kernels has no meaning here.
            load_textures: As in Newton.
            deformable_surface_mode: As in Newton.
            gi: How light is computed; None: the defaults.

        Raises:
            InputError: The model has what cannot be rendered: Gaussians, body variants.
        """
        check_model(model)
        self.model = model
        """The model."""
        self.gi = gi or GiSettings()
        """How light is computed."""
        self.default_clear_data = self.ClearData() if default_clear_data is None else default_clear_data
        """As in Newton."""
        self.default_render_config = self.RenderConfig() if default_render_config is None else default_render_config
        """As in Newton."""
        self._load_textures = load_textures
        self._mode = self.DeformableSurfaceMode(deformable_surface_mode)
        self._checkered: tuple[frozenset[int], Any] | None = None
        self._sky: tuple[float, ...] = AMBIENT_SKY
        self._ground: tuple[float, ...] = AMBIENT_GROUND
        self._light: Light | None = None
        self._scenes: dict[tuple[bool, bool], _SensorScene] = {}
        self._visuals = None
        if self._mode != self.DeformableSurfaceMode.SIMULATION_ONLY and model.deformable_visual_meshes:
            self._visuals = newton.geometry.DeformableVisuals(model)
        self._given_visuals: Any = None
        self._settings({}, self.default_render_config)
        self._scene(self.default_render_config)

    @property
    def device(self) -> Any:
        """Device of the model."""
        return self.model.device

    def allocate_image(self, view_count: int, width: int, height: int, dtype: Any) -> Any:
        """An array of zeros [views, rows, columns] of a Warp type."""
        return wp.zeros((int(view_count), int(height), int(width)), dtype=dtype, device=self.device)

    def allocate_image_color(self, view_count: int, width: int, height: int) -> Any:
        """An array for packed colours."""
        return self.allocate_image(view_count, width, height, wp.uint32)

    def allocate_image_depth(self, view_count: int, width: int, height: int) -> Any:
        """An array for depths [m]."""
        return self.allocate_image(view_count, width, height, wp.float32)

    def allocate_image_depth_forward(self, view_count: int, width: int, height: int) -> Any:
        """An array for depths along the camera's axis [m]."""
        return self.allocate_image_depth(view_count, width, height)

    def allocate_image_shape_index(self, view_count: int, width: int, height: int) -> Any:
        """An array for shape indices."""
        return self.allocate_image(view_count, width, height, wp.uint32)

    def allocate_image_normal(self, view_count: int, width: int, height: int) -> Any:
        """An array for normals."""
        return self.allocate_image(view_count, width, height, wp.vec3f)

    def allocate_image_albedo(self, view_count: int, width: int, height: int) -> Any:
        """An array for packed albedos."""
        return self.allocate_image(view_count, width, height, wp.uint32)

    def allocate_image_color_hdr(self, view_count: int, width: int, height: int) -> Any:
        """An array for linear colours."""
        return self.allocate_image(view_count, width, height, wp.vec3f)

    def allocate_image_error(self, view_count: int, width: int, height: int) -> Any:
        """An array for standard errors."""
        return self.allocate_image(view_count, width, height, wp.float32)

    def compute_camera_transforms_usd(self, cameras: Any, *, time: Any = None, xform: Any = None) -> Any:
        """Poses of USD cameras, by Newton's sensor."""
        own = NewtonSensorCamera(self.model, load_textures=False)
        return own.compute_camera_transforms_usd(cameras, time=time, xform=xform)

    def create_default_light(
        self, *, enable_shadows: bool = True, direction: Any = None, color: Sequence[float] | None = None
    ) -> None:
        """Creates a distant light, in place of one created before.

        Args:
            enable_shadows: Must be true: all light casts shadows here.
            direction: Unit direction in which it shines; None: downwards at an angle, as in Newton.
            color: Linear colour c, of which a surface that faces the light reflects albedo c; None: 1.

        Raises:
            InputError: Shadows are to be left out.
        """
        if not enable_shadows:
            raise InputError("enable_shadows: all light casts shadows here")
        if direction is None:
            direction = _down(int(self.model.up_axis))
        irradiance = tuple(math.pi * float(c) for c in (color if color is not None else (1.0, 1.0, 1.0)))
        frame = _frame_with_z(-np.array([float(x) for x in direction]))
        self._light = Light("default", LightKind.DISTANT, irradiance, world_from_light=frame, angle=0.0)
        self._forget_lights()

    def set_ambient_light(self, sky_color: Sequence[float], ground_color: Sequence[float] | None = None) -> None:
        """Sets the radiance of the upper and of the lower half of the sky; None: both halves are alike."""
        self._sky = tuple(float(c) for c in sky_color)
        self._ground = self._sky if ground_color is None else tuple(float(c) for c in ground_color)
        self._forget_lights()

    def assign_checkerboard_material(self, *, shape_indices: Any, resolution: int = 64, checker_size: int = 32) -> None:
        """Gives selected shapes a grey checkerboard, and all others no texture; shown if textures are enabled."""
        rows = np.asarray(shape_indices, np.int64).reshape(-1)
        if ((rows < 0) | (rows >= self.model.shape_count)).any():
            raise ValueError("shape_indices contains an out-of-range shape index")
        square = np.arange(resolution) // checker_size
        grey = np.where((square[:, None] + square) % 2 == 0, 0x80, 0xBF).astype(np.uint8)
        self._checkered = frozenset(rows.tolist()), np.repeat(grey[:, :, None], 3, axis=2)
        self._scenes.clear()

    def sync_deformable_meshes(self, state: Any, *, deformable_visuals: Any = None) -> None:
        """Takes the points of deformable surfaces from a state; `update` does it, unless told not to.

        Args:
            state: The state.
            deformable_visuals: Visual buffers of the model that are up to date; None: they are computed.
        """
        if deformable_visuals is not None:
            if not isinstance(deformable_visuals, newton.geometry.DeformableVisuals):
                raise TypeError(
                    f"deformable_visuals must be DeformableVisuals, got {type(deformable_visuals).__name__}"
                )
            if deformable_visuals.model is not self.model:
                raise ValueError("DeformableVisuals was created for another model.")
            if self._visuals is None:
                raise ValueError("this camera does not render deformable visual meshes")
            deformable_visuals.wait()
        elif self._visuals is not None:
            self._visuals.update(state)
        for scene in self._scenes.values():
            scene.set_surfaces(state, deformable_visuals or self._visuals)

    def follow(self, state: Any, *, render_config: Any = None) -> None:
        """Takes poses, points and colours from a state, and refits: what `update` does before it renders."""
        self.sync_deformable_meshes(state)
        self._scene(self.default_render_config if render_config is None else render_config).follow(state)

    def update(
        self,
        state: Any,
        camera_transforms: Any,
        camera_rays: Any,
        *,
        color_image: Any = None,
        depth_image: Any = None,
        forward_depth_image: Any = None,
        shape_index_image: Any = None,
        normal_image: Any = None,
        albedo_image: Any = None,
        hdr_color_image: Any = None,
        world_indices: Any = None,
        clear_data: Any = None,
        render_config: Any = None,
        sync_deformables: bool = True,
        deformable_visuals: Any = None,
        error_image: Any = None,
        step: Any = None,
    ) -> None:
        """Renders; no BVH of the model has to be refit.

        Args:
            state: As in Newton.
            camera_transforms: As in Newton.
            camera_rays: As in Newton. Iteration i takes sample i mod samples; there is no jitter.
            color_image: As in Newton.
            depth_image: As in Newton.
            forward_depth_image: As in Newton.
            shape_index_image: As in Newton.
            normal_image: As in Newton.
            albedo_image: As in Newton.
            hdr_color_image: As in Newton.
            world_indices: As in Newton.
            clear_data: As in Newton.
            render_config: As in Newton; another one than in the last call costs time on the host.
            sync_deformables: As in Newton.
            deformable_visuals: As in Newton.
            error_image: Standard error of the mean channel of the unfiltered colour, float32 [views, rows, columns];
                infinity after a single iteration.
            step: Number of the step, on which random numbers depend; None: one more than in the last call.

        Raises:
            ValueError: An array has a wrong shape, or there are several samples without anti-aliasing.
        """
        config = self.default_render_config if render_config is None else render_config
        if not sync_deformables and deformable_visuals is not None:
            raise ValueError("deformable_visuals requires sync_deformables=True")
        if camera_rays.ndim == 4 and camera_rays.shape[2] > 1 and config.anti_aliasing == self.AntiAliasing.NONE:
            raise ValueError("anti_aliasing must be SSAA or MSAA for camera_rays with more than one sample")
        scene = self._scene(config)
        if sync_deformables:
            self.sync_deformable_meshes(state, deformable_visuals=deformable_visuals)
        scene.follow(state)
        data = self.default_clear_data if clear_data is None else clear_data
        scene.views.render(
            camera_transforms,
            camera_rays,
            world_indices,
            settings=self._settings(scene.known_settings, config),
            clear=ClearValues(
                color=data.clear_color,
                albedo=data.clear_albedo,
                depth=data.clear_depth,
                normal=tuple(data.clear_normal),
                shape_index=data.clear_shape_index,
            ),
            step=step,
            color=color_image,
            hdr_color=hdr_color_image,
            albedo=albedo_image,
            depth=depth_image,
            forward_depth=forward_depth_image,
            normal=normal_image,
            shape_index=shape_index_image,
            error=error_image,
        )

    def _settings(self, known: "dict[tuple[Any, ...], ViewSettings]", config: Any) -> ViewSettings:
        """The settings of views for a configuration."""
        linear = config.output_color_space == type(config.output_color_space).LINEAR
        key = linear, config.enable_backface_culling, config.max_distance
        if key not in known:
            known[key] = ViewSettings(
                iterations=self.gi.iterations,
                light_paths=self.gi.light_paths,
                max_bounces=self.gi.max_bounces,
                filter=self.gi.filter,
                accumulate=self.gi.accumulate,
                max_history=self.gi.max_history,
                seed=self.gi.seed,
                cull_back_faces=bool(config.enable_backface_culling),
                max_distance=float(config.max_distance),
                linear=linear,
            )
        return known[key]

    def _scene(self, config: Any) -> "_SensorScene":
        """The scene for a configuration, with its lights and textures."""
        key = bool(config.enable_particles), bool(config.enable_global_world)
        if key not in self._scenes:
            read = model_scene(
                self.model,
                load_textures=self._load_textures,
                checkered=self._checkered,
                particles=key[0],
                shared=key[1],
                simulated=self._mode != self.DeformableSurfaceMode.VISUAL_ONLY,
                skinned=self._visuals is not None,
            )
            self._scenes[key] = _SensorScene(self.model, read, self.gi)
        scene = self._scenes[key]
        ambient = bool(config.enable_ambient_lighting)
        if scene.ambient != ambient:
            scene.live.set_lights(self._lights(ambient))
            scene.ambient = ambient
        scene.live.show_textures(bool(config.enable_textures))
        return scene

    def _forget_lights(self) -> None:
        for scene in self._scenes.values():
            scene.ambient = None

    def _lights(self, ambient: bool) -> list[Light]:
        """All lights: the default one, the sky, and those of the settings."""
        out = list(self.gi.lights)
        if self._light is not None:
            out.append(self._light)
        if ambient and max(*self._sky, *self._ground) > 0.0:
            up = np.zeros(3)
            up[int(self.model.up_axis)] = 1.0
            frame = _frame_with_y(up)
            if self._sky == self._ground:
                out.append(Light("ambient", LightKind.DOME, self._sky, world_from_light=frame))
            else:
                halves = np.repeat(np.array([self._sky, self._ground], np.float32), _DOME_ROWS // 2, axis=0)
                texture = np.repeat(halves[:, None], 2, axis=1)
                out.append(Light("ambient", LightKind.DOME, (1.0, 1.0, 1.0), world_from_light=frame, texture=texture))
        return out


class _SensorScene:
    """A model on the device, and how its state gets there."""

    def __init__(self, model: Any, read: ModelScene, gi: GiSettings) -> None:
        self.model = model
        self.live = LiveScene(
            read.scene,
            worlds=read.worlds,
            world_count=max(int(model.world_count), 1),
            ids=read.ids,
            deforming=(*read.simulated, *read.skinned),
            unbounded=read.unbounded,
            extent=gi.extent,
            frame=fixed_frame(read.scene, read.unbounded),
            device=str(model.device),
        )
        self.views = Views(self.live)
        self.known_settings: dict[tuple[Any, ...], ViewSettings] = {}
        self.ambient: bool | None = None
        array = self.live.launcher.array
        self._shapes, self._particles = array(read.shape, wp.int32), array(read.particle, wp.int32)
        self._shape_count, self._particle_count = len(read.shape), len(read.particle)
        self._simulated, self._skinned = read.simulated, read.skinned
        self._simulated_points = array(read.simulated_points, wp.int32)
        self._skinned_points = array(read.skinned_points, wp.int32)
        self._no_bodies = self.live.launcher.zeros(1, wp.transformf)

    def set_surfaces(self, state: Any, visuals: Any) -> None:
        """Takes the points of deformable surfaces."""
        if self._simulated:
            self.live.set_points(self._simulated, state.particle_q, self._simulated_points)
        if self._skinned:
            self.live.set_points(self._skinned, visuals.points, self._skinned_points)

    def follow(self, state: Any) -> None:
        """Takes poses and colours, and refits."""
        model, live = self.model, self.live
        if self._shape_count:
            bodies = self._no_bodies if state.body_q is None else state.body_q
            inputs = [self._shapes, model.shape_body, model.shape_transform, bodies, live.placements, live.changed]
            live.repeat(_pose_shapes, self._shape_count, inputs)
            inputs = [self._shapes, model.shape_color, live.placements, live.data.instance_colors, live.changed]
            live.repeat(_color_shapes, self._shape_count, inputs)
        if self._particle_count:
            inputs = [self._particles, state.particle_q, self._shape_count, live.placements, live.changed]
            live.repeat(_pose_particles, self._particle_count, inputs)
        live.refit()


def _down(up_axis: int) -> Floats:
    """The direction (-1, 1, -1)/√3 of a model whose up axis is Z, rotated to another one as Newton does."""
    quaternion = newton.Axis.Z.quat_between_axes(newton.Axis(up_axis))
    direction = wp.vec3(-0.57735026, 0.57735026, -0.57735026)
    if up_axis != int(newton.Axis.Z):
        direction = wp.quat_rotate(quaternion, direction)
    return np.array([float(x) for x in direction])


def _frame_with_z(z: Floats) -> Floats:
    """A rigid matrix [4, 4] whose z axis is given."""
    z = z / np.linalg.norm(z)
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    out = np.eye(4)
    out[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return out


def _frame_with_y(y: Floats) -> Floats:
    """A rigid matrix [4, 4] whose y axis is given."""
    out = _frame_with_z(y)
    out[:3, :3] = out[:3, [0, 2, 1]] * np.array([1.0, 1.0, -1.0])
    return out
