"""MuJoCo Warp's rendering functions, with light that bounces.

    import mujoco_warp as mjw
    from warp_ir.mujoco import create_render_context, refit_bvh, render    # instead of those of mujoco_warp

    rc = create_render_context(mjm, nworld, cam_res=(64, 64), render_rgb=True)
    refit_bvh(m, d, rc)
    render(m, d, rc)                       # into rc.rgb_data, depth_data, seg_data
    mjw.get_rgb(rc, 0, image)

The buffers, their addresses and conventions are MuJoCo Warp's: a context of its own makes them. World k of the batch is
world k of a `LiveScene`. All of a step is done by kernels.
"""

import warnings
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import mujoco_warp
import numpy as np
import warp as wp

from warp_ir.mujoco.model_scene import model_scene
from warp_ir.scene import InputError
from warp_ir.simulation import LiveScene, Views, ViewSettings
from warp_ir.simulation.live_scene import fixed_frame
from warp_ir.simulation.placement import Placements, color_instance, move_instance

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_GEOM = wp.constant(int(mujoco.mjtObj.mjOBJ_GEOM))
_NOTHING = wp.constant(wp.uint32(0xFFFFFFFF))


@wp.struct
class Pictures:
    """What `Views` writes, one row for each camera and world, linear."""

    color: wp.array3d[wp.uint32]
    albedo: wp.array3d[wp.uint32]
    normal: wp.array3d[wp.vec3]
    depth: wp.array3d[wp.float32]
    geom: wp.array3d[wp.uint32]


@wp.struct
class Target:
    """Where the images of cameras go in a context's buffers; an address of -1 is not wanted."""

    worlds: int
    rgb: wp.array2d[wp.uint32]
    depth: wp.array2d[wp.float32]
    segmentation: wp.array2d[wp.vec2i]
    addresses: wp.array[wp.vec3i]  # [cameras]
    headlight: wp.vec3  # radiance of a white surface that faces the camera
    background: wp.uint32  # as in the buffers


@wp.kernel
def _pose_geoms(
    first: int,
    geoms: wp.array[wp.int32],
    worlds: wp.array[wp.int32],
    position: wp.array2d[wp.vec3],
    rotation: wp.array2d[wp.mat33],
    placements: Placements,
    changed: wp.array[wp.int32],
) -> None:
    """Moves the instance of a geom to where it is in its world."""
    i = first + wp.tid()
    turn = wp.quat_from_matrix(rotation[worlds[i], geoms[i]])
    move_instance(placements, changed, i, wp.transformf(position[worlds[i], geoms[i]], turn))


@wp.struct
class Colors:
    """Colours of geoms; fewer rows than worlds are repeated."""

    material: wp.array2d[wp.int32]
    geom: wp.array2d[wp.vec4]
    of_material: wp.array2d[wp.vec4]


@wp.kernel
def _color_geoms(
    first: int,
    geoms: wp.array[wp.int32],
    worlds: wp.array[wp.int32],
    source: Colors,
    placements: Placements,
    colors: wp.array[wp.vec3],
    changed: wp.array[wp.int32],
) -> None:
    """Colours the instance of a geom; the default colour is that of the material."""
    i = first + wp.tid()
    world = worlds[i]
    c = source.geom[world % source.geom.shape[0], geoms[i]]
    material = source.material[world % source.material.shape[0], geoms[i]]
    if material >= 0 and c == wp.vec4(0.5, 0.5, 0.5, 1.0):
        c = source.of_material[world % source.of_material.shape[0], material]
    rgb = wp.vec3(wp.clamp(c[0], 0.0, 1.0), wp.clamp(c[1], 0.0, 1.0), wp.clamp(c[2], 0.0, 1.0))
    color_instance(placements, colors, changed, i, rgb)


@wp.kernel
def _pose_cameras(
    first: int,
    cameras: wp.array[wp.int32],
    position: wp.array2d[wp.vec3],
    rotation: wp.array2d[wp.mat33],
    out: wp.array[wp.transformf],
) -> None:
    """The pose of a camera in a world."""
    i = first + wp.tid()
    world = i % position.shape[0]
    camera = cameras[i // position.shape[0]]
    out[i] = wp.transformf(position[world, camera], wp.quat_from_matrix(rotation[world, camera]))


@wp.func
def _channel(packed: wp.uint32, k: int) -> float:
    return float((packed >> wp.uint32(8 * k)) & wp.uint32(255))


@wp.kernel
def _write_pictures(first: int, poses: wp.array[wp.transformf], pictures: Pictures, out: Target) -> None:
    """Writes a pixel as MuJoCo Warp has it: 0xAARRGGBB, depth along the axis, (geom, mjOBJ_GEOM).

    The headlight shines along the camera's axis, without shadows: so it is added here.
    """
    k = first + wp.tid()
    rows = pictures.color.shape[1]
    columns = pictures.color.shape[2]
    view = k // (rows * columns)
    place = k - view * (rows * columns)
    row = place // columns
    column = place - row * columns
    world = view % out.worlds
    at = out.addresses[view // out.worlds]
    if at[0] >= 0:
        color = pictures.color[view, row, column]
        rho = pictures.albedo[view, row, column]
        forward = wp.transform_vector(poses[view], wp.vec3(0.0, 0.0, -1.0))
        facing = wp.max(-wp.dot(pictures.normal[view, row, column], forward), 0.0)
        missed = 1.0 - _channel(color, 3) / 255.0
        packed = out.background
        if missed < 1.0:
            packed = wp.uint32(0xFF000000)
            for channel in range(3):
                added = _channel(rho, channel) * out.headlight[channel] * facing
                added += missed * _channel(out.background, 2 - channel)
                value = wp.uint32(wp.min(_channel(color, channel) + added, 255.0))
                packed = packed | (value << wp.uint32(16 - 8 * channel))
        out.rgb[world, at[0] + place] = packed
    if at[1] >= 0:
        out.depth[world, at[1] + place] = pictures.depth[view, row, column]
    if at[2] >= 0:
        geom = pictures.geom[view, row, column]
        pair = wp.vec2i(-1)
        if geom != _NOTHING:
            pair = wp.vec2i(int(geom), _GEOM)
        out.segmentation[world, at[2] + place] = pair


@dataclass
class _Group:
    """Cameras of one bundle of rays, which are rendered together in all worlds."""

    cameras: "wp.array[wp.int32]"
    rays: Any
    worlds: "wp.array[wp.int32]"
    poses: "wp.array[wp.transformf]"
    pictures: Pictures
    target: Target
    views: Views


class RenderContext:
    """What `create_render_context` makes: MuJoCo Warp's buffers, and a scene of ours."""

    def __init__(self, mjm: mujoco.MjModel, theirs: Any, worlds: int, settings: ViewSettings) -> None:
        """Reads the model; see `create_render_context`."""
        self.rgb_data, self.rgb_adr = theirs.rgb_data, theirs.rgb_adr
        self.depth_data, self.depth_adr = theirs.depth_data, theirs.depth_adr
        self.seg_data, self.seg_adr = theirs.seg_data, theirs.seg_adr
        self.cam_res, self.cam_id_map, self.nrender = theirs.cam_res, theirs.cam_id_map, theirs.nrender
        geoms = theirs.enabled_geom_ids.numpy()
        geoms = geoms[mjm.geom_rgba[geoms, 3] > 0.0]
        ids = theirs.hfield_bvh_id.numpy().tolist()
        heightfields = {k: theirs.hfield_registry[i] for k, i in enumerate(ids) if i in theirs.hfield_registry}
        read = model_scene(
            mjm,
            geoms,
            worlds,
            heightfields,
            smooth=theirs.enable_vertex_normals,
            ambient=theirs.use_ambient_lighting,
        )
        self.live = LiveScene(
            read.scene,
            worlds=read.worlds,
            world_count=worlds,
            ids=read.geoms,
            unbounded=read.unbounded,
            frame=fixed_frame(read.scene, read.unbounded),
            device=str(theirs.rgb_data.device),
        )
        """The scene, on the device."""
        array = self.live.launcher.array
        self._geoms, self._worlds = array(read.geoms, wp.int32), array(read.worlds, wp.int32)
        self._colors: Colors | None = None
        self._color_places: list[int] = []
        headlight = mjm.vis.headlight.diffuse.tolist() if mjm.vis.headlight.active else (0.0, 0.0, 0.0)
        self._settings = replace(settings, linear=True, cull_back_faces=bool(theirs.enable_backface_culling))
        self._groups = self._group_cameras(mjm, theirs, worlds, headlight)

    def _group_cameras(self, mjm: mujoco.MjModel, theirs: Any, worlds: int, headlight: Any) -> list[_Group]:
        array, zeros = self.live.launcher.array, self.live.launcher.zeros
        sizes, ids = theirs.cam_res.numpy(), theirs.cam_id_map.numpy()
        addresses = np.stack([theirs.rgb_adr.numpy(), theirs.depth_adr.numpy(), theirs.seg_adr.numpy()], axis=1)
        wanted = np.stack([theirs.render_rgb.numpy(), theirs.render_depth.numpy(), theirs.render_seg.numpy()], axis=1)
        addresses = np.where(wanted, addresses, -1)
        samples = theirs.samples_per_pixel**2
        rays = np.stack([theirs.ray_offset.numpy(), theirs.ray.numpy()], axis=1).reshape(samples, -1, 2, 3)
        groups: dict[tuple[Any, ...], tuple[Any, list[int]]] = {}
        first = 0
        for k, (columns, rows) in enumerate(sizes.tolist()):
            own = rays[:, first : first + rows * columns].reshape(samples, rows, columns, 2, 3).transpose(1, 2, 0, 3, 4)
            first += rows * columns
            if wanted[k].any():
                groups.setdefault((own.shape, own.tobytes()), (own, []))[1].append(k)
        out = []
        for own, cameras in groups.values():
            shape = (len(cameras) * worlds, *own.shape[:2])
            pictures, target = Pictures(), Target()
            for name in ("color", "albedo", "geom"):
                setattr(pictures, name, zeros(shape, wp.uint32))
            pictures.normal, pictures.depth = zeros(shape, wp.vec3), zeros(shape, wp.float32)
            target.worlds, target.headlight = worlds, wp.vec3(*headlight)
            target.background = wp.uint32(int(theirs.background_color))
            target.rgb, target.depth, target.segmentation = theirs.rgb_data, theirs.depth_data, theirs.seg_data
            target.addresses = array(addresses[cameras], wp.vec3i)
            farthest = theirs.zfar / max(float(-own[..., 1, 2].max()), 1.0e-6) if theirs.zfar > 0.0 else 1.0e10
            out.append(
                _Group(
                    array(ids[cameras], wp.int32),
                    array(np.ascontiguousarray(own, np.float32), wp.vec3),
                    array(np.tile(np.arange(worlds), len(cameras)), wp.int32),
                    zeros(shape[0], wp.transformf),
                    pictures,
                    target,
                    Views(self.live, replace(self._settings, max_distance=farthest)),
                )
            )
        return out

    def refit(self, m: Any, d: Any) -> None:
        """Takes poses and colours, and refits."""
        live, count = self.live, self.live.count
        inputs = [self._geoms, self._worlds, d.geom_xpos, d.geom_xmat, live.placements, live.changed]
        live.repeat(_pose_geoms, count, inputs)
        source = m.geom_matid, m.geom_rgba, m.mat_rgba
        if self._colors is None or self._color_places != [x.ptr for x in source]:
            self._color_places = [x.ptr for x in source]
            self._colors = Colors()
            self._colors.material, self._colors.geom, self._colors.of_material = source
        inputs = [self._geoms, self._worlds, self._colors, live.placements, live.data.instance_colors, live.changed]
        live.repeat(_color_geoms, count, inputs)
        live.refit()

    def render(self, d: Any) -> None:
        """Renders all cameras in all worlds."""
        for group in self._groups:
            launch = self.live.repeat
            inputs = [group.cameras, d.cam_xpos, d.cam_xmat, group.poses]
            launch(_pose_cameras, group.poses.shape[0], inputs)
            pictures = group.pictures
            group.views.render(
                group.poses,
                group.rays,
                group.worlds,
                color=pictures.color,
                albedo=pictures.albedo,
                normal=pictures.normal,
                forward_depth=pictures.depth,
                shape_index=pictures.geom,
            )
            launch(_write_pictures, pictures.color.size, [group.poses, pictures, group.target])


def create_render_context(
    mjm: mujoco.MjModel, nworld: int = 1, *, settings: ViewSettings | None = None, **options: Any
) -> RenderContext:
    """Creates a context.

    Args:
        mjm: The model.
        nworld: The number of worlds.
        settings: How light is computed; None: the defaults of `ViewSettings`.
        options: Those of `mujoco_warp.create_render_context`. Shadows are always there; specular highlights and
            textures are not.

    Raises:
        InputError: The model or the options ask for what cannot be rendered.
    """
    for name in ("render_skybox", "splat_position"):
        if options.get(name) not in (None, False):
            raise InputError(f"{name}: cannot be rendered")
    if not options.get("use_precomputed_rays", True):
        raise InputError("use_precomputed_rays: cameras that differ between worlds cannot be rendered")
    if mjm.nflex:
        raise InputError("the model has flexes, which cannot be rendered")
    if options.get("use_textures", True) and mjm.ntex and (mjm.mat_texid >= 0).any():
        warnings.warn("textures of MuJoCo materials are not shown; use_textures=False says so", stacklevel=2)
    theirs = mujoco_warp.create_render_context(mjm, nworld, **{**options, "use_textures": False})
    return RenderContext(mjm, theirs, nworld, settings or ViewSettings())


def refit_bvh(m: Any, d: Any, rc: RenderContext) -> None:
    """Takes poses and colours of all worlds from MuJoCo Warp's model and data, and refits what rays traverse."""
    rc.refit(m, d)


def render(m: Any, d: Any, rc: RenderContext) -> None:
    """Renders into the context's buffers."""
    rc.render(d)
