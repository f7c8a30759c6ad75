"""The scene as the kernels see it, and the one function that puts it there.

On the device the scene lives in its own frame: centred on the middle of its bounding box and scaled by
a power of two until its extent is between 1/2 and 1. Radiance does not change when a scene is scaled,
so nothing else has to know; and a scene in millimetres, or far from the origin, is as exact as any.

A prototype lives in a frame of its own, made the same way; its instances are matrices from there to the scene's.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir import sampling
from warp_ir.bvh import Bvh, Instance, TwoLevel, build_bvhs, build_instance_tree
from warp_ir.grid import GridList, GridTables, cell_measure
from warp_ir.launch import Launcher
from warp_ir.light_control import ControlTables, upload_controls
from warp_ir.placing import boxes, cofactors
from warp_ir.scene import Camera, InputError, Instances, Light, LightKind, Material, Mesh, Projection, Scene, Texture
from warp_ir.settings import RenderSettings
from warp_ir.texture import TextureTable, mean_on_triangles, upload_textures

wp.set_module_options({"enable_backward": False})

MAX_TRIANGLES = 200_000_000
"""Above this a scene is refused before anything is allocated."""
_BYTES_PER_TRIANGLE = 200
_BYTES_PER_INSTANCE = 400
INSTANCE_COLOR = -2
"""In `SceneData.triangle_colors`: the triangle has the colour of its instance."""
_PATCHES = 2**14
"""Where light is reflected, textures are means over as many patches of the scene's surface: VPLs are no denser."""
_LARGEST_UV = 1.0e6
"""Texture coordinates beyond are clamped: floats have no digits left for them."""
_TRIANGLE_EMITTER = len(LightKind)
"""Kind of an emitter that is a triangle of an emissive mesh; the kinds below it are `LightKind`'s."""


@wp.struct
class Patterns:
    """The textures, and where they lie."""

    textures: TextureTable
    triangle_uvs: wp.array[wp.int32]  # [m], first of its rows in corner_uvs, three for every set; -1: none
    corner_uvs: wp.array[wp.vec2]


@wp.struct
class LightTables:
    """Textures and controls of lights."""

    texture: wp.array[wp.int32]  # [lights], the grid that multiplies the radiance, or -1
    grids: GridTables
    controls: ControlTables


@wp.struct
class SceneData:
    """Geometry, materials and emitters. Empty tables hold one unused row; the counts tell."""

    bvh: Bvh  # every surface; never empty
    instance_count: int
    two_level: wp.array[TwoLevel]  # `bvh` and the tree over the instances: one row
    instances: wp.array[Instance]
    instance_axes: wp.array[wp.mat33]  # device_from_local, around Instance.centre
    instance_colors: wp.array[wp.vec3]  # one row if none has any
    triangle_count: int
    points: wp.array[wp.vec3]  # in the device frame; those of a prototype in its own
    indices: wp.array[wp.int32]  # [3 m]
    triangle_material: wp.array[wp.int32]  # [m]
    triangle_mesh: wp.array[wp.int32]  # [m], index into Scene.meshes
    triangle_normals: wp.array[wp.int32]  # [m], first of its three rows in corner_normals; -1: faceted
    triangle_colors: wp.array[
        wp.int32
    ]  # [m], first of its three rows in corner_colors; -1: the material's; -2: the instance's
    corner_normals: wp.array[wp.vec3]
    corner_colors: wp.array[wp.vec3]
    albedo: wp.array[wp.vec3]  # [materials]
    emission: wp.array[wp.vec3]  # [materials] radiance
    opacity: wp.array[wp.float32]  # [materials]
    cutoff: wp.array[wp.float32]  # [materials], absent below it; 0: present at random
    albedo_texture: wp.array[wp.int32]  # [materials], row of textures.rows; -1: none
    emission_texture: wp.array[wp.int32]
    opacity_texture: wp.array[wp.int32]
    texture_count: int
    patterns: wp.array[Patterns]  # one: a pointer is passed where a table would be copied
    open_count: int  # materials whose opacity is below 1 anywhere
    footprint: float  # width of the patch that a reflection of light stands for
    emits_back: wp.array[wp.int32]  # [m], 1 if an emissive material emits from the back too
    radius: float  # of a sphere around the origin that holds all surfaces

    emitter_count: int
    emitter_cdf: wp.array[wp.float32]  # [emitters + 1], by power, from 0 to 1
    emitter_kind: wp.array[wp.int32]  # [emitters], LightKind, or _TRIANGLE_EMITTER
    emitter_density: wp.array[wp.float32]  # [emitters], probability over area; 0 for what has none
    emitter_item: wp.array[wp.int32]  # [emitters], row of the light tables, or triangle
    triangle_emitter: wp.array[wp.int32]  # [m], its emitter or -1; one row if no surface emits

    light_count: int  # analytic lights
    light_kind: wp.array[wp.int32]
    light_origin: wp.array[wp.vec3]
    light_axes: wp.array[wp.mat33]  # columns: what the unit shape's x, y, z become; rotation for DISTANT
    light_inverse: wp.array[wp.mat33]
    light_radiance: wp.array[wp.vec3]
    light_angle: wp.array[wp.float32]  # 1 - cosθ_max of a DISTANT light
    light_emitter: wp.array[wp.int32]  # its row in the emitter tables, or -1
    textured_count: int  # lights with a texture
    control_count: int  # lights with a control
    shaped_count: int  # of them with a shaping
    only_sampled_count: int  # of them those with an area that rays are not to find
    light_tables: wp.array[
        LightTables
    ]  # one row: what few scenes have must not be copied with the others' at every call
    shape_count: int  # lights with an area: RECT to CYLINDER
    shape_bvh: wp.uint64  # boxes around them
    shape_light: wp.array[wp.int32]  # [shapes], row of the light tables

    sobol: wp.array[wp.uint32]
    address: wp.uint64  # of a copy of this record on the device: what is called seldom takes no more than this


@wp.struct
class CameraData:
    """A camera in the scene's device frame, and the image it fills."""

    columns: int  # of the film: the whole image, or the data window in it
    rows: int
    first_column: int  # of the film in the image
    first_row: int
    image_columns: int
    image_rows: int
    shows_lights: int  # 1: analytic lights are visible
    origin: wp.vec3
    right: wp.vec3
    up: wp.vec3
    back: wp.vec3
    left: float
    bottom: float
    width: float
    height: float
    near: float
    far: float
    orthographic: int
    lens_radius: float  # 0: a pinhole
    focus: float  # depth of the plane that is sharp
    blurs: int  # 1: the rays of a pixel differ in more than where they cross it


@dataclass(frozen=True)
class DeviceFrame:
    """Where the device's frame lies: device = (world - origin) * scale, scale a power of two."""

    origin: npt.NDArray[np.float64]
    scale: float

    def to_device(self, points: Any) -> npt.NDArray[np.float32]:
        """World positions [..., 3] in the device's frame, float32."""
        return ((np.asarray(points, np.float64) - self.origin) * self.scale).astype(np.float32)

    def to_world(self, points: Any) -> npt.NDArray[np.float64]:
        """Device positions [..., 3] in world space."""
        return np.asarray(points, np.float64) / self.scale + self.origin


@dataclass(frozen=True)
class DeviceScene:
    """An uploaded scene; owns what `data` refers to by id."""

    data: Any
    """The `SceneData` for kernels."""
    frame: DeviceFrame
    extent: float
    """Diagonal of the bounding box in the device's frame."""
    area: float
    """Area of all surfaces in the device's frame."""
    mean_albedo: float
    """Mean reflectivity ρ̄ of the surfaces."""
    max_albedo: float
    """Largest albedo of any surface and channel."""
    emits: bool
    """Whether anything in the scene emits."""
    keep: tuple[Any, ...]
    """The owners of the surfaces and of the lights: a struct holds only their ids, and a freed id crashes."""
    source: Scene
    """What was uploaded."""


def upload_scene(scene: Scene, launcher: Launcher) -> DeviceScene:
    """Checks a scene and copies it to the launcher's device.

    Raises:
        InputError: An array has the wrong shape or a bad value; the message names the mesh or light.
    """
    return upload_moments((scene,), launcher)[0]


def upload_moments(
    scenes: Sequence[Scene], launcher: Launcher, previous: Sequence[DeviceScene] = ()
) -> list[DeviceScene]:
    """Checks scenes and copies them to the launcher's device, into one frame.

    What a scene shares with another of them, or with a `previous` one, is uploaded once: surfaces if their meshes
    are the same objects and their materials are equal, lights if they are the same objects.

    Raises:
        InputError: As for `upload_scene`.
    """
    with launcher.phase("upload"):
        checked = {id(mesh) for other in previous for mesh in other.source.meshes}
        for scene in scenes:
            _check(scene, launcher, checked)
            checked |= {id(mesh) for mesh in scene.meshes}
        bounds = [scene.bounds() for scene in scenes]
        lower, upper = np.min([b[0] for b in bounds], axis=0), np.max([b[1] for b in bounds], axis=0)
        done: list[DeviceScene] = []
        for scene in scenes:
            done.append(_upload(scene, lower, upper, launcher, [*done, *previous]))
        return done


def _upload(scene: Scene, lower: Any, upper: Any, launcher: Launcher, others: list[DeviceScene]) -> DeviceScene:
    """One scene into the frame of a bounding box; `others` may have parts of it."""
    extent = float(np.linalg.norm(upper - lower))
    if not np.isfinite(extent):
        raise InputError("scene: its extent is too large for a float")
    frame = _frame(lower, upper)
    scale = frame.scale
    # All of a scene is in its frame: in another one nothing can be used again.
    others = [o for o in others if o.frame.scale == scale and (o.frame.origin == frame.origin).all()]
    surfaces = next((o for o in others if _same_surfaces(o.source, scene)), None)
    lights = next((o for o in others if _same(o.source.lights, scene.lights)), None)
    if surfaces is not None and surfaces is lights:
        return replace(surfaces, source=scene)

    data = SceneData()
    if surfaces is not None:
        for name in SceneData.vars:
            setattr(data, name, getattr(surfaces.data, name))
    area = scene.area() * scale**2
    data.footprint = math.sqrt(area / _PATCHES)
    data.radius = 0.5 * extent * scale * 1.0001 if extent > 0.0 else 1.0
    stored, numbers = _arranged(scene)
    owners = surfaces.keep[0] if surfaces is not None else _upload_surfaces(stored, numbers, frame, data, launcher)
    # Links name meshes by their numbers in the scene, not by where they are stored.
    shapes, gain = _upload_lights(scene, frame, data, launcher)
    _upload_emitters(stored, gain, frame, data, launcher)
    data.sobol = launcher.array(sampling.sobol_matrices(), wp.uint32)
    itself = launcher.array([data], SceneData)
    data.address = wp.uint64(itself.ptr)
    colors = [x.colors.max() for x in (*scene.meshes, *scene.instances) if x.colors is not None and len(x.colors)]
    used = {int(k) for m in scene.meshes if m.colors is None for k in np.unique(m.material)}
    colors += [t.pixels.max() for k in used if (t := scene.materials[k].albedo_texture) is not None]
    return DeviceScene(
        data=data,
        frame=frame,
        extent=extent * scale if extent > 0.0 else 1.0,
        area=area,
        mean_albedo=scene.mean_albedo(),
        max_albedo=float(max([*colors, *(max(scene.materials[k].albedo) for k in used)], default=0.0)),
        emits=data.emitter_count > 0,
        keep=(owners, shapes, itself),
        source=scene,
    )


def _same(one: Sequence[Any], other: Sequence[Any]) -> bool:
    return len(one) == len(other) and all(a is b for a, b in zip(one, other, strict=True))


def _same_surfaces(one: Scene, other: Scene) -> bool:
    """Whether two scenes have the same meshes and instances, and equal materials."""
    same = _same(one.meshes, other.meshes) and _same(one.instances, other.instances)
    return same and (one.materials is other.materials or one.materials == other.materials)


def _frame(lower: Any, upper: Any) -> DeviceFrame:
    """The frame in which a box is centred, and its diagonal between 1/2 and 1."""
    extent = float(np.linalg.norm(upper - lower))
    # Rooms of exactly 2^k units must not jump between scales by rounding: frexp is exact.
    return DeviceFrame(0.5 * (lower + upper), 2.0 ** -math.frexp(extent)[1] if extent > 0.0 else 1.0)


def camera_data(camera: Camera, frame: DeviceFrame, settings: RenderSettings) -> Any:
    """The `CameraData` of a camera fitted to the image that the settings describe; their height must be set.

    Raises:
        InputError: The window is empty, or something is not finite.
    """
    assert settings.height is not None
    if not (np.isfinite(camera.world_from_camera).all() and np.isfinite(camera.window).all()):
        raise InputError(f"camera {camera.name!r}: transform and window must be finite")
    left, right, bottom, top = camera.window
    if not (right > left and top > bottom):
        raise InputError(f"camera {camera.name!r}: the window is empty")
    perspective = camera.projection == Projection.PERSPECTIVE
    lens = camera.lens_radius if perspective and settings.depth_of_field else 0.0
    if not (0.0 <= lens < np.inf and (lens == 0.0 or 0.0 < camera.focus_distance < np.inf)):
        raise InputError(f"camera {camera.name!r}: lens_radius and focus_distance must be finite and not negative")
    fitted = camera.fit(settings.width, settings.height, settings.conform, settings.pixel_aspect)
    left, right, bottom, top = fitted.window
    unit = 1.0 if perspective else frame.scale
    out = CameraData()
    out.first_column, out.first_row, out.columns, out.rows = settings.pixels()
    out.image_columns, out.image_rows = settings.width, settings.height
    out.shows_lights = int(settings.visible_lights)
    with np.errstate(over="ignore"):
        origin = frame.to_device(camera.world_from_camera[:3, 3])
    if not np.isfinite(origin).all():
        raise InputError(f"camera {camera.name!r}: it is too far from the scene")
    out.origin = wp.vec3(*origin)
    out.right, out.up, out.back = (wp.vec3(*camera.world_from_camera[:3, k]) for k in range(3))
    out.left, out.bottom = left * unit, bottom * unit
    out.width, out.height = (right - left) * unit, (top - bottom) * unit
    out.near = camera.clipping[0] * frame.scale
    out.far = min(camera.clipping[1] * frame.scale, 3.0e38)
    out.orthographic = int(not perspective)
    out.lens_radius, out.focus = lens * frame.scale, min(camera.focus_distance * frame.scale, 3.0e38)
    out.blurs = int(lens > 0.0)
    return out


def _check(scene: Scene, launcher: Launcher, checked: Collection[int]) -> None:
    """Warp trusts its input: a bad index reads anywhere. So nothing bad may pass here, but meshes `checked` before."""
    for mesh in scene.meshes:
        if id(mesh) not in checked:
            _check_mesh(mesh)
        if len(mesh.triangles) and not 0 <= mesh.material.min() <= mesh.material.max() < len(scene.materials):
            raise InputError(f"{mesh.name}: material refers to materials outside 0..{len(scene.materials) - 1}")
    _check_instances(scene)
    glowing = _glowing(scene)
    written = [(g, k) for g in scene.instances for k in g.meshes if k in glowing]
    again = [(len(group.matrices) - 1) * len(scene.meshes[k].triangles) for group, k in written]
    triangles, instances = scene.triangle_count + sum(again), sum(len(g.matrices) for g in scene.instances)
    if triangles > MAX_TRIANGLES:
        copies = f", {sum(again)} of them copies of instances that emit" if again else ""
        raise InputError(f"scene: {triangles} triangles{copies}; the limit is {MAX_TRIANGLES}")
    needed = _BYTES_PER_TRIANGLE * triangles + _BYTES_PER_INSTANCE * instances
    if needed > launcher.memory():
        raise InputError(
            f"scene: {triangles} triangles and {instances} instances need about {needed / 2**30:.1f} GiB,"
            f" {launcher.device} has {launcher.memory() / 2**30:.1f}"
        )
    for material in scene.materials:
        _check_material(material)
        if not all(0.0 <= a <= 1.0 for a in material.albedo):
            raise InputError(f"{material.name}: albedo must lie in [0, 1], is {material.albedo}")
        if not all(0.0 <= e < np.inf for e in material.emission):
            raise InputError(f"{material.name}: emission must be finite and not negative, is {material.emission}")
    for light in scene.lights:
        if not all(0.0 <= e < np.inf for e in light.radiance):
            raise InputError(f"{light.name}: radiance must be finite and not negative, is {light.radiance}")
        if light.world_from_light.shape != (4, 4) or not np.isfinite(light.world_from_light).all():
            raise InputError(f"{light.name}: world_from_light must be a finite 4x4 matrix")
        texture = light.texture
        if texture is not None:
            if light.kind not in (LightKind.RECT, LightKind.DOME):
                raise InputError(f"{light.name}: only RECT and DOME lights take a texture")
            if texture.ndim != 3 or texture.shape[2] != 3 or texture.size == 0:
                raise InputError(f"{light.name}: texture must have shape [h, w, 3]")
            if not (np.isfinite(texture).all() and texture.min() >= 0.0):
                raise InputError(f"{light.name}: texture must be finite and not negative")


def _check_material(material: Material) -> None:
    def demand(good: Any, what: str) -> None:
        if not good:
            raise InputError(f"{material.name}: {what}")

    demand(0.0 <= material.opacity <= 1.0 and 0.0 <= material.cutoff <= 1.0, "opacity and cutoff must lie in [0, 1]")
    for texture in material.textures:
        pixels = texture.pixels
        shaped = pixels.ndim == 3 and min(pixels.shape) >= 1 and pixels.shape[2] in (1, 3)
        demand(shaped, f"texture {texture.name}: pixels must have shape [h, w, 3] or [h, w, 1]")
        demand(
            np.isfinite(pixels).all() and pixels.min() >= 0.0, f"texture {texture.name}: pixels must be finite, >= 0"
        )
        placed = texture.transform.shape == (2, 3) and np.isfinite(texture.transform.astype(np.float32)).all()
        demand(placed, f"texture {texture.name}: transform must be a finite 2x3 matrix")
        demand(np.isfinite(texture.outside).all(), f"texture {texture.name}: outside must be finite")
    for bounded in (material.albedo_texture, material.opacity_texture):
        if bounded is not None:
            top = max(bounded.pixels.max(), *bounded.outside)
            demand(top <= 1.0 and min(bounded.outside) >= 0.0, f"texture {bounded.name}: values must lie in [0, 1]")


def _check_instances(scene: Scene) -> None:
    taken: set[int] = set()
    for group in scene.instances:
        count = len(group.matrices)

        def demand(good: Any, what: str, name: str = group.name) -> None:
            if not good:
                raise InputError(f"{name}: {what}")

        demand(all(0 <= k < len(scene.meshes) for k in group.meshes), f"meshes outside 0..{len(scene.meshes) - 1}")
        demand(len({*group.meshes} - taken) == len(group.meshes), "a mesh is instanced twice")
        taken.update(group.meshes)
        demand(group.matrices.shape == (count, 4, 4) and count > 0, "matrices must have shape [k, 4, 4], k > 0")
        demand(np.isfinite(group.matrices).all(), "matrices must be finite")
        demand((group.matrices[:, 3] == (0.0, 0.0, 0.0, 1.0)).all(), "matrices must be affine")
        if group.colors is not None:
            demand(group.colors.shape == (count, 3), "colors must have shape [k, 3], one per instance")
            demand(group.colors.min() >= 0.0 and group.colors.max() <= 1.0, "colors must lie in [0, 1]")


def _check_mesh(mesh: Mesh) -> None:
    count = len(mesh.triangles)

    def demand(good: Any, what: str) -> None:
        if not good:
            raise InputError(f"{mesh.name}: {what}")

    demand(mesh.points.ndim == 2 and mesh.points.shape[1] == 3, "points must have shape [n, 3]")
    demand(mesh.triangles.shape == (count, 3), "triangles must have shape [m, 3]")
    demand(mesh.material.shape == (count,), "material must have shape [m], one index per triangle")
    if count:
        demand(
            mesh.triangles.min() >= 0 and mesh.triangles.max() < len(mesh.points),
            f"triangles refer to points outside 0..{len(mesh.points) - 1}",
        )
        demand(np.isfinite(mesh.points[mesh.triangles]).all(), "points must be finite")
    for name, corners in (("normals", mesh.normals), ("colors", mesh.colors)):
        if corners is not None:
            demand(corners.shape == (count, 3, 3), f"{name} must have shape [m, 3, 3]")
            demand(np.isfinite(corners).all(), f"{name} must be finite")
    for name, corners in mesh.uvs.items():
        demand(corners.shape == (count, 3, 2), f"uvs {name!r} must have shape [m, 3, 2]")
        demand(np.isfinite(corners).all(), f"uvs {name!r} must be finite")
    if mesh.bare is not None:
        demand(mesh.bare.shape == (count,) and mesh.bare.dtype == bool, "bare must have shape [m] and be of bools")
    if mesh.colors is not None and count:
        demand(mesh.colors.min() >= 0.0 and mesh.colors.max() <= 1.0, "colors must lie in [0, 1]")


def _glowing(scene: Scene) -> set[int]:
    """The instanced meshes that emit. They are written out: every place of theirs is an emitter of its own."""
    emits = np.array([max(m.emission) > 0.0 for m in scene.materials], bool)
    if not emits.any():
        return set()
    return {k for group in scene.instances for k in group.meshes if emits[scene.meshes[k].material].any()}


def _arranged(scene: Scene) -> tuple[Scene, list[int]]:
    """The scene as it is stored, meshes of the world before those of prototypes; and the meshes' former numbers."""
    if not scene.instances:
        return scene, list(range(len(scene.meshes)))
    scene = scene.flat(_glowing(scene))
    groups = [g for g in scene.instances if any(len(scene.meshes[k].triangles) for k in g.meshes)]
    below = [k for g in groups for k in g.meshes]
    unseen = {k for g in scene.instances for k in g.meshes} - {*below}
    numbers = [k for k in range(len(scene.meshes)) if k not in unseen and k not in set(below)] + below
    place = {k: i for i, k in enumerate(numbers)}
    instances = tuple(replace(g, meshes=tuple(place[k] for k in g.meshes)) for g in groups)
    return replace(scene, meshes=tuple(scene.meshes[k] for k in numbers), instances=instances), numbers


def _upload_surfaces(scene: Scene, numbers: Sequence[int], frame: DeviceFrame, data: Any, launcher: Launcher) -> Any:
    """Fills the geometry and material tables; returns the owners of what they refer to by id."""
    meshes = [m for m in scene.meshes if len(m.triangles)]
    data.triangle_count = sum(len(m.triangles) for m in meshes)
    storage = _Storage(scene, frame)
    material = np.concatenate([m.material for m in meshes]) if meshes else np.zeros(1)
    data.points = launcher.array(storage.points, wp.vec3)
    data.indices = launcher.array(storage.indices, wp.int32)
    data.triangle_material = launcher.array(material.astype(np.int32), wp.int32)
    source = [numbers[k] for k, m in enumerate(scene.meshes) if len(m.triangles)]
    counts = [len(m.triangles) for m in meshes]
    data.triangle_mesh = launcher.array(np.repeat(source, counts).astype(np.int32) if meshes else [-1], wp.int32)
    data.emits_back = launcher.array(
        np.repeat([m.double_sided for m in meshes], counts).astype(np.int32) if meshes else [0], wp.int32
    )
    bare = _colored_by_instance(scene, counts)
    data.triangle_normals, data.corner_normals = _upload_corners([m.normals for m in meshes], counts, launcher)
    data.triangle_colors, data.corner_colors = _upload_corners(
        [m.colors for m in meshes], counts, launcher, from_instance=bare
    )
    patterns = _upload_materials(scene.materials or (Material(),), meshes, counts, data, launcher)
    parts = [(data.points, data.indices)]
    if scene.instances:
        parts = [
            (launcher.array(storage.points[p], wp.vec3), launcher.array(storage.indices[t] - p.start, wp.int32))
            for p, t in storage.parts
        ]
        if not storage.parts[0][0].stop:
            parts[0] = (launcher.zeros(3, wp.vec3), launcher.array([0, 1, 2], wp.int32))
    data.bvh, roots, owner = build_bvhs(parts, launcher)
    return owner, patterns, _upload_instances(scene, frame, storage, roots, data, launcher)


def _upload_materials(
    materials: tuple[Material, ...], meshes: list[Mesh], counts: list[int], data: Any, launcher: Launcher
) -> Any:
    """Fills the tables of materials and textures, and the uv sets that the textures use; returns their owner."""
    textures = list(dict.fromkeys(texture for material in materials for texture in material.textures))
    row: dict[Texture | None, int] = {texture: k for k, texture in enumerate(textures)} | {None: -1}
    uv_sets = list(dict.fromkeys(texture.uv for texture in textures))
    data.albedo = launcher.array([m.albedo for m in materials], wp.vec3)
    data.emission = launcher.array([m.emission for m in materials], wp.vec3)
    data.opacity = launcher.array([m.opacity for m in materials], wp.float32)
    data.cutoff = launcher.array([m.cutoff for m in materials], wp.float32)
    data.albedo_texture = launcher.array([row[m.albedo_texture] for m in materials], wp.int32)
    data.emission_texture = launcher.array([row[m.emission_texture] for m in materials], wp.int32)
    data.opacity_texture = launcher.array([row[m.opacity_texture] for m in materials], wp.int32)
    data.open_count = sum(m.opacity < 1.0 for m in materials)
    data.texture_count = len(textures)
    patterns = Patterns()
    patterns.textures = upload_textures(textures, uv_sets, launcher)
    corners: list[Any] = []
    for mesh in meshes:
        sets = [mesh.uvs.get(name) for name in uv_sets]
        if all(s is None for s in sets):
            corners.append(None)
        else:
            zero = np.zeros((len(mesh.triangles), 3, 2), np.float32)
            chosen = np.stack([zero if s is None else s for s in sets], axis=1)
            corners.append(np.asarray(chosen, np.float32).clip(-_LARGEST_UV, _LARGEST_UV))
    rows = 3 * max(len(uv_sets), 1)
    patterns.triangle_uvs, patterns.corner_uvs = _upload_corners(corners, counts, launcher, wp.vec2, rows)
    data.patterns = launcher.array([patterns], Patterns)
    return patterns


class _Storage:
    """Where points and triangles lie in the tables; prototypes of the same geometry share their points and tree."""

    def __init__(self, scene: Scene, frame: DeviceFrame) -> None:
        """Lays out an arranged scene.

        `points` [n, 3] and `indices` [3 m] are the tables, `parts` the ranges of both that are a hierarchy each, the
        world's first. For each of the scene's instances, `part` is the number of its prototype, from 0, `first` its
        first triangle, and `frames` its prototype's frame.
        """
        instanced = {k for group in scene.instances for k in group.meshes}
        self._points: list[Any] = []
        self._indices: list[Any] = []
        self._point_count = self._index_count = 0
        for k, mesh in enumerate(scene.meshes):
            if k not in instanced and len(mesh.triangles):
                self._add(mesh, frame, self._point_count)
        self.parts = [(slice(0, self._point_count), slice(0, self._index_count))]
        self.part: list[int] = []
        self.first: list[int] = []
        self.frames: list[DeviceFrame] = []
        self.halves: list[npt.NDArray[np.float64]] = []
        known: dict[tuple[int, ...], int] = {}
        for group in scene.instances:
            meshes = [scene.meshes[k] for k in group.meshes if len(scene.meshes[k].triangles)]
            self.first.append(self._index_count // 3)
            geometry = tuple(id(x) for mesh in meshes for x in (mesh.points, mesh.triangles))
            if geometry in known:
                twin = known[geometry]
                self.part.append(self.part[twin])
                self.frames.append(self.frames[twin])
                self.halves.append(self.halves[twin])
                begin, count = self.parts[self.part[twin] + 1][1].start, 3 * sum(len(m.triangles) for m in meshes)
                self._indices.append(np.concatenate(self._indices)[begin : begin + count])
                self._index_count += count
                continue
            known[geometry] = len(self.part)
            corners = [mesh.points[np.unique(mesh.triangles)] for mesh in meshes]
            lower = np.min([c.min(axis=0) for c in corners], axis=0)
            upper = np.max([c.max(axis=0) for c in corners], axis=0)
            own = _frame(lower, upper)
            point, index = self._point_count, self._index_count
            for mesh in meshes:
                self._add(mesh, own, self._point_count)
            self.part.append(len(self.parts) - 1)
            self.parts.append((slice(point, self._point_count), slice(index, self._index_count)))
            self.frames.append(own)
            self.halves.append(0.5 * (upper - lower) * own.scale)
        # An empty mesh crashes Warp; three coincident points are never hit.
        self.points = np.concatenate(self._points or [np.zeros((3, 3), np.float32)])
        self.indices = np.concatenate(self._indices or [np.arange(3)]).astype(np.int32)

    def _add(self, mesh: Mesh, frame: DeviceFrame, first: int) -> None:
        points = frame.to_device(mesh.points)
        # A stray point that no triangle uses may be anything: keep it from the bounds and the compiler.
        points[~np.isfinite(points).all(axis=1)] = 0.0
        self._points.append(points)
        self._indices.append((mesh.triangles + first).reshape(-1))
        self._point_count += len(points)
        self._index_count += mesh.triangles.size


def _upload_instances(
    scene: Scene, frame: DeviceFrame, storage: _Storage, roots: Sequence[int], data: Any, launcher: Launcher
) -> Any:
    """Fills the instance tables; returns the owner of the tree over them."""
    data.instance_colors = launcher.zeros(1, wp.vec3)
    if not scene.instances:
        data.two_level, data.instances = launcher.zeros(1, TwoLevel), launcher.zeros(1, Instance)
        data.instance_axes = launcher.zeros(1, wp.mat33)
        return None
    lowers, uppers, tables, all_axes = [], [], [], []
    for k, group in enumerate(scene.instances):
        own = storage.frames[k]
        linear = group.matrices[:, :3, :3]
        axes = linear * (frame.scale / own.scale)
        centre = frame.to_device(linear @ own.origin + group.matrices[:, :3, 3])
        inverse = _inverses(axes, group)
        # A ray comes in by the inverse and its hit goes out by the axes: the errors of both, in the device frame.
        reach = np.abs(axes) @ storage.halves[k]
        size = (np.abs(axes) @ (np.abs(inverse) @ reach[:, :, None]))[:, :, 0].max(axis=1)
        size += np.abs(centre).max(axis=1)
        lower, upper = boxes(-storage.halves[k], storage.halves[k], _matrices(axes, centre))
        margin = size[:, None] * (16.0 * 2.0**-23)
        table = np.zeros(len(axes), Instance.numpy_dtype())
        table["inverse"], table["centre"], table["size"] = inverse, centre, size
        table["root"], table["shift"] = roots[storage.part[k]], storage.first[k]
        lowers.append((lower - margin).astype(np.float32))
        uppers.append((upper + margin).astype(np.float32))
        tables.append(table)
        all_axes.append(axes.astype(np.float32))
    if any(group.colors is not None for group in scene.instances):
        colors = [np.zeros((len(g.matrices), 3)) if g.colors is None else g.colors for g in scene.instances]
        data.instance_colors = launcher.array(np.concatenate(colors).astype(np.float32), wp.vec3)
    data.instance_axes = launcher.array(np.concatenate(all_axes), wp.mat33)
    lower, upper = np.concatenate(lowers), np.concatenate(uppers)
    both = TwoLevel()
    both.bvh = data.bvh
    both.tree, owner = build_instance_tree(lower, upper, np.concatenate(tables), launcher)
    data.instance_count, data.instances = len(lower), both.tree.instances
    data.two_level = launcher.array([both], TwoLevel)
    return owner, both


def _inverses(axes: npt.NDArray[np.float64], group: Instances) -> npt.NDArray[np.float64]:
    """Inverses [k, 3, 3] that a float32 can hold."""
    with np.errstate(all="ignore"):
        cofactor = cofactors(axes)
        inverse = cofactor.transpose(0, 2, 1) / np.sum(axes[:, 0] * cofactor[:, 0], axis=1)[:, None, None]
        good = np.isfinite(inverse.astype(np.float32)).all(axis=(1, 2)) & np.isfinite(axes).all(axis=(1, 2))
    if not good.all():
        raise InputError(f"{group.name}: the matrix of instance {int(np.argmin(good))} is singular")
    return inverse


def _matrices(axes: Any, centre: Any) -> npt.NDArray[np.float64]:
    out = np.zeros((len(axes), 4, 4))
    out[:, :3, :3], out[:, :3, 3] = axes, centre
    return out


def _colored_by_instance(scene: Scene, counts: Sequence[int]) -> npt.NDArray[np.bool_] | None:
    """Which triangles [m] have the colour of their instance; None: none has."""
    colored = {k for group in scene.instances if group.colors is not None for k in group.meshes}
    meshes = [(m, k in colored and m.bare is not None) for k, m in enumerate(scene.meshes) if len(m.triangles)]
    if not any(takes for _, takes in meshes):
        return None
    rows = [m.bare if takes else np.zeros(c, bool) for (m, takes), c in zip(meshes, counts, strict=True)]
    return np.concatenate(rows)


def _upload_corners(
    corners: list[Any],
    counts: list[int],
    launcher: Launcher,
    dtype: Any = wp.vec3,
    per_triangle: int = 3,
    from_instance: Any = None,
) -> tuple[Any, Any]:
    """Per-triangle offsets (-1: none) into one table of the corner values of the meshes that have them."""
    columns = wp.types.type_size(dtype)
    rows = np.full(max(sum(counts), 1), -1, np.int32)
    values, triangle, row = [], 0, 0
    for corner, count in zip(corners, counts, strict=True):
        if corner is not None:
            rows[triangle : triangle + count] = row + per_triangle * np.arange(count)
            values.append(corner.reshape(-1, columns))
            row += per_triangle * count
        triangle += count
    if from_instance is not None:
        rows[from_instance] = INSTANCE_COLOR
    table = np.concatenate(values) if values else np.zeros((1, columns))
    return launcher.array(rows, wp.int32), launcher.array(table.astype(np.float32), dtype)


def _upload_lights(
    scene: Scene, frame: DeviceFrame, data: Any, launcher: Launcher
) -> tuple[Any, npt.NDArray[np.float64]]:
    """Fills the light tables.

    Returns:
        The owners of what is referred to by address, and what textures and shaping make of each light's power.
    """
    lights = scene.lights
    axes = np.array([_light_axes(light) * _unit(light, frame) for light in lights]).reshape(-1, 3, 3)
    origin = frame.to_device(np.array([light.world_from_light[:3, 3] for light in lights]).reshape(-1, 3))
    radiance = np.array([light.radiance for light in lights], np.float64).reshape(-1, 3)
    points = np.array([light.kind == LightKind.POINT for light in lights], bool)
    radiance[points] *= frame.scale**2  # intensity is radiance times area
    angle = [1.0 - math.cos(math.radians(0.5 * min(max(light.angle, 0.0), 360.0))) for light in lights]
    grids = GridList()
    texture, gain = _add_textures(lights, grids)
    tables = LightTables()
    tables.controls, peak, share = upload_controls(lights, axes, len(scene.meshes), grids, launcher)
    radiance *= peak[:, None]

    data.light_count = len(lights)
    data.light_kind = launcher.array([int(light.kind) for light in lights] or [0], wp.int32)
    data.light_origin = launcher.array(_rows(origin), wp.vec3)
    data.light_axes = launcher.array(_rows(axes, (3, 3)), wp.mat33)
    data.light_inverse = launcher.array(_rows(np.array([_inverse(a) for a in axes]), (3, 3)), wp.mat33)
    data.light_radiance = launcher.array(_rows(radiance), wp.vec3)
    data.light_angle = launcher.array(angle or [0.0], wp.float32)
    tables.texture = launcher.array(texture or [-1], wp.int32)
    tables.grids = grids.upload(launcher)
    data.textured_count = sum(k >= 0 for k in texture)
    data.control_count, data.shaped_count = tables.controls.count, tables.controls.shaped_count
    data.only_sampled_count = tables.controls.sampled_count
    data.light_tables = launcher.array([tables], LightTables)

    shapes = [k for k, light in enumerate(lights) if light.kind <= LightKind.CYLINDER]
    reach = np.abs(axes[shapes]).sum(axis=2) * 1.001 if shapes else np.zeros((1, 3))
    centre = origin[shapes] if shapes else np.full((1, 3), 1.0e6)
    data.shape_count = len(shapes)
    data.shape_light = launcher.array(shapes or [0], wp.int32)
    bvh = wp.Bvh(launcher.array(centre - reach, wp.vec3), launcher.array(centre + reach, wp.vec3))
    data.shape_bvh = bvh.id
    return (bvh, tables), gain * share


def _add_textures(lights: tuple[Light, ...], grids: GridList) -> tuple[list[int], npt.NDArray[np.float64]]:
    """Adds the lights' textures to the grids; returns each light's grid (-1: none) and what it makes of the power."""
    index, means = [], np.ones(len(lights))
    known: dict[tuple[int, bool], int] = {}  # lights may share an image
    for k, light in enumerate(lights):
        if light.texture is None:
            index.append(-1)
            continue
        key = id(light.texture), light.kind == LightKind.DOME
        theta = math.pi if light.kind == LightKind.DOME else 0.0
        tint = np.array(light.radiance) / max(float(np.mean(light.radiance)), 1.0e-30)
        measure = cell_measure(len(light.texture), theta)
        rows = light.texture.mean(axis=1, dtype=np.float64) @ tint / 3.0
        means[k] = float(rows @ measure / measure.sum())
        if key not in known:
            known[key] = grids.add(light.texture, theta=theta)
        index.append(known[key])
    return index, means


def _rows(table: Any, shape: tuple[int, ...] = (3,)) -> Any:
    """The table, or one row of zeros where it is empty: kernels never get a null pointer."""
    return np.asarray(table, np.float32) if len(table) else np.zeros((1, *shape), np.float32)


def _unit(light: Light, frame: DeviceFrame) -> float:
    return frame.scale if light.kind <= LightKind.CYLINDER else 1.0


def _light_axes(light: Light) -> npt.NDArray[np.float64]:
    """Columns: the images of the unit shape's axes; for the flat shapes z is the unit emitting normal."""
    linear = light.world_from_light[:3, :3].astype(np.float64)
    if light.kind in (LightKind.RECT, LightKind.DISK):
        size = (light.width, light.height) if light.kind == LightKind.RECT else (light.radius, light.radius)
        x, y = linear[:, 0] * size[0], linear[:, 1] * size[1]
        normal = -np.cross(x, y) * (-1.0 if np.linalg.det(linear) < 0.0 else 1.0)
        length = np.linalg.norm(normal)
        if not length > 0.0:
            raise InputError(f"{light.name}: the light has no area")
        return np.stack([x, y, normal / length], axis=1)
    if light.kind == LightKind.SPHERE:
        return linear * light.radius
    if light.kind == LightKind.CYLINDER:
        return linear * np.array([light.length, light.radius, light.radius])
    rotation = np.linalg.qr(linear)[0] if np.linalg.det(linear) != 0.0 else np.eye(3)
    return rotation * np.where(np.sum(rotation * linear, axis=0) < 0.0, -1.0, 1.0)


def _inverse(axes: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    try:
        return np.linalg.inv(axes)
    except np.linalg.LinAlgError:
        return np.zeros((3, 3))  # collapsed to a plane: it still emits, but no ray can find it


def _upload_emitters(
    scene: Scene, gain: npt.NDArray[np.float64], frame: DeviceFrame, data: Any, launcher: Launcher
) -> None:
    """One list of everything that emits, with the probabilities of choosing each: in proportion to its power.

    Any positive probabilities are right; a power is estimated from mean radiance times area, no more. `gain` is what
    textures and shaping make of each light's.
    """
    kinds: list[npt.NDArray[np.int32]] = []
    items: list[npt.NDArray[np.int32]] = []
    powers: list[npt.NDArray[np.float64]] = []
    areas: list[npt.NDArray[np.float64]] = []
    radiance = data.light_radiance.numpy()
    axes = data.light_axes.numpy()
    for k, light in enumerate(scene.lights):
        extent = _power_per_radiance(light, axes[k], data.radius)
        power = float(np.mean(radiance[k], dtype=np.float64)) * extent * gain[k]
        kinds.append(np.array([light.kind], np.int32))
        items.append(np.array([k], np.int32))
        powers.append(np.array([power]))
        areas.append(np.array([extent / math.pi if light.kind <= LightKind.CYLINDER else np.inf]))

    emission = np.array([m.emission for m in scene.materials], np.float64).reshape(-1, 3).mean(axis=1)
    first = 0
    for mesh in scene.meshes:
        glowing = np.nonzero(emission[mesh.material] > 0.0)[0] if emission.any() else np.zeros(0, np.int64)
        if len(glowing):
            a, b, c = (mesh.points[mesh.triangles[glowing, k]] * frame.scale for k in range(3))
            area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
            sides = 2.0 if mesh.double_sided else 1.0
            kinds.append(np.full(len(glowing), _TRIANGLE_EMITTER, np.int32))
            items.append((first + glowing).astype(np.int32))
            areas.append(sides * area)
            powers.append(math.pi * sides * area * _mean_emission(scene, mesh, glowing, area, data.footprint))
        first += len(mesh.triangles)

    tables = (np.concatenate(x) if x else np.zeros(0) for x in (kinds, items, powers, areas))
    kind, item, power, spread = tables
    on = power > 0.0
    kind, item, power, spread = kind[on], item[on], power[on], spread[on]
    data.emitter_count = len(power)
    cdf = np.concatenate([[0.0], np.cumsum(power / power.sum())]) if len(power) else np.array([0.0, 1.0])
    cdf[-1] = 1.0
    data.emitter_cdf = launcher.array(cdf, wp.float32)
    data.emitter_density = launcher.array(np.diff(cdf) / spread if len(power) else [0.0], wp.float32)
    data.emitter_kind = launcher.array(kind.astype(np.int32) if len(kind) else [0], wp.int32)
    data.emitter_item = launcher.array(item.astype(np.int32) if len(item) else [0], wp.int32)

    emitter = np.arange(len(power), dtype=np.int32)
    light_emitter = np.full(max(len(scene.lights), 1), -1, np.int32)
    analytic = kind != _TRIANGLE_EMITTER
    light_emitter[item[analytic].astype(np.int64)] = emitter[analytic]
    data.light_emitter = launcher.array(light_emitter, wp.int32)
    triangle_emitter = np.full(data.triangle_count if (~analytic).any() else 1, -1, np.int32)
    triangle_emitter[item[~analytic].astype(np.int64)] = emitter[~analytic]
    data.triangle_emitter = launcher.array(triangle_emitter, wp.int32)


def _mean_emission(scene: Scene, mesh: Mesh, triangles: Any, areas: Any, footprint: float) -> Any:
    """Emitted radiance of triangles, mean of the channels: roughly where it is textured, but nowhere 0 in error."""
    out = np.zeros(len(triangles))
    for k in np.unique(mesh.material[triangles]):
        material, chosen = scene.materials[k], mesh.material[triangles] == k
        texture = material.emission_texture
        if texture is None:
            out[chosen] = np.mean(material.emission)
        else:
            uvs = mesh.uvs.get(texture.uv, np.zeros((len(mesh.triangles), 3, 2)))[triangles[chosen]]
            uvs = uvs.clip(-_LARGEST_UV, _LARGEST_UV)
            out[chosen] = mean_on_triangles(texture, uvs, areas[chosen], footprint)
    return out


def _power_per_radiance(light: Light, axes: Any, radius: float) -> float:
    """Flux into the scene [device units] per mean radiance: exact for flat lights, good enough for the others."""
    x, y, z = (float(np.linalg.norm(axes[:, k])) for k in range(3))
    disk = math.pi * radius**2
    if light.kind == LightKind.RECT:
        return math.pi * float(np.linalg.norm(np.cross(axes[:, 0], axes[:, 1])))
    if light.kind == LightKind.DISK:
        return math.pi * math.pi * float(np.linalg.norm(np.cross(axes[:, 0], axes[:, 1])))
    if light.kind == LightKind.SPHERE:
        return math.pi * 4.0 * math.pi * (x * y + y * z + z * x) / 3.0
    if light.kind == LightKind.CYLINDER:
        return math.pi * x * math.pi * (y + z)
    if light.kind == LightKind.POINT:
        return 4.0 * math.pi
    if light.kind == LightKind.DOME:
        return 4.0 * math.pi * disk
    cone = 2.0 * math.pi * (1.0 - math.cos(math.radians(0.5 * light.angle)))
    return disk * (cone if light.angle > 0.0 else 1.0)
