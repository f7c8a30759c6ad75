"""A Newton model as a `LiveScene`: its shapes, particles and deformable surfaces, read once."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import newton
import numpy as np
import warp as wp

from warp_ir.image.tonemap import srgb_to_linear
from warp_ir.scene import Floats, InputError, Instances, Ints, Material, Mesh, Scene, Texture
from warp_ir.simulation import shapes

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

TRIANGLES_ID = 0xFFFFFFFD
PARTICLES_ID = 0xFFFFFFFE
_UV = "st"


@dataclass
class ModelScene:
    """The scene of a model, and where the rows of its instances come from."""

    scene: Scene
    worlds: Ints
    """World of each instance; -1: all."""
    ids: Ints
    """What an image of shape indices shows of each instance."""
    unbounded: list[int]
    """Rows of infinite planes."""
    shape: Ints
    """Row of `model.shape_*` of the first instances, those that are shapes."""
    particle: Ints
    """Index of the particle of the instances after these."""
    simulated: list[str] = field(default_factory=list)
    """Names of the surfaces of cloth and soft bodies."""
    simulated_points: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """Particle of each of their points, one surface after the other."""
    skinned: list[str] = field(default_factory=list)
    """Names of the visual meshes, which follow those in the order of what deforms."""
    skinned_points: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """Vertex of `DeformableVisuals` of each of their points."""


@wp.kernel
def _count_mesh(first: int, mesh: wp.uint64, counts: wp.array[wp.int32]) -> None:
    """Writes the numbers of points and of indices of a mesh."""
    counts[0] = wp.mesh_get(mesh).points.shape[0]
    counts[1] = wp.mesh_get(mesh).indices.shape[0]


@wp.kernel
def _copy_mesh(first: int, mesh: wp.uint64, points: wp.array[wp.vec3], indices: wp.array[wp.int32]) -> None:
    """Copies a point and an index of a mesh."""
    i = first + wp.tid()
    if i < points.shape[0]:
        points[i] = wp.mesh_get(mesh).points[i]
    if i < indices.shape[0]:
        indices[i] = wp.mesh_get(mesh).indices[i]


def model_scene(
    model: Any,
    *,
    load_textures: bool,
    checkered: "tuple[frozenset[int], Any] | None",
    particles: bool,
    shared: bool,
    simulated: bool,
    skinned: bool,
) -> ModelScene:
    """Reads a model.

    Args:
        model: The `newton.Model`.
        load_textures: Whether images are loaded.
        checkered: Shapes that have a checkerboard, the only ones with a texture then, and its pixels; None: those of
            the meshes.
        particles: Whether particles are drawn that are not part of a surface.
        shared: Whether what belongs to no world is drawn.
        simulated: Whether the triangles of the simulation are drawn.
        skinned: Whether deformable visual meshes are drawn.
    """
    builder = _Builder(model, load_textures, checkered)
    builder.add_shapes(shared)
    if particles:
        builder.add_particles(shared)
    if simulated:
        builder.add_simulated(shared)
    if skinned:
        builder.add_skinned(shared)
    return builder.result()


class _Builder:
    def __init__(self, model: Any, load_textures: bool, checkered: "tuple[frozenset[int], Any] | None") -> None:
        self._model, self._load_textures, self._checkered = model, load_textures, checkered
        self._materials: list[Material] = [Material("plain", albedo=(1.0, 1.0, 1.0))]
        self._material_of: dict[int, int] = {}
        self._kept: list[Any] = []  # images, whose ids are keys
        self._meshes: list[Mesh] = []
        self._groups: list[Instances] = []
        self._worlds: list[Ints] = []
        self._ids: list[Ints] = []
        self._shape = np.zeros(0, np.int64)
        self._particle = np.zeros(0, np.int64)
        self._unbounded: list[int] = []
        self._names: list[list[str]] = [[], []]
        self._points: list[list[Ints]] = [[], []]

    def add_shapes(self, shared: bool) -> None:
        """Adds the visible shapes, prototype by prototype."""
        model = self._model
        if not model.shape_count:
            return
        types, scales = model.shape_type.numpy(), model.shape_scale.numpy()
        flags, worlds, bodies = model.shape_flags.numpy(), model.shape_world.numpy(), model.shape_body.numpy()
        sources, transforms = model.shape_source_ptr.numpy(), model.shape_transform.numpy()
        visible = (flags & int(newton.ShapeFlags.VISIBLE)) != 0
        if model.shape_opacity is not None:
            visible &= model.shape_opacity.numpy() > 0.0
        visible &= types != int(newton.GeoType.NONE)
        if not shared:
            visible &= worlds >= 0
        rows_of: dict[tuple[Any, ...], list[int]] = {}
        for row in np.flatnonzero(visible).tolist():
            kind = newton.GeoType(int(types[row]))
            image = self._image(row, kind)
            key = (kind, *_proportions(kind, scales[row], image is not None), int(sources[row]), id(image))
            rows_of.setdefault(key, []).append(row)
        body_q = None if model.body_q is None else model.body_q.numpy()
        shape: list[int] = []
        for key, rows in rows_of.items():
            kind = key[0]
            image = self._image(rows[0], kind)
            triangles = self._triangles(rows[0], kind, scales[rows[0]], image)
            stretch = np.ones((len(rows), 3))
            if not _is_scaled(kind, image is not None):
                stretch = np.array([_stretch(kind, scales[row]) for row in rows])
            matrices = np.zeros((len(rows), 4, 4))
            for k, row in enumerate(rows):
                pose = _matrix(transforms[row])
                if bodies[row] >= 0 and body_q is not None:
                    pose = _matrix(body_q[bodies[row]]) @ pose
                matrices[k] = pose @ np.diag([*stretch[k], 1.0])
            if kind == newton.GeoType.PLANE and not (scales[rows[0]][:2] > 0.0).all():
                self._unbounded += range(len(shape), len(shape) + len(rows))
            self._add(
                f"shapes {len(self._groups)}", triangles, matrices, worlds[rows], np.array(rows), self._material(image)
            )
            shape += rows
        self._shape = np.array(shape, np.int64)

    def add_particles(self, shared: bool) -> None:
        """Adds the particles that no triangle and no tetrahedron has, as spheres."""
        model = self._model
        if not model.particle_count:
            return
        alone = np.ones(model.particle_count, bool)
        if model.tri_count:
            for topology in (model.tri_indices, model.tet_indices):
                if topology is not None and topology.shape[0]:
                    alone[topology.numpy().reshape(-1)] = False
        radius, worlds = model.particle_radius.numpy(), model.particle_world.numpy()
        alone &= radius > 0.0
        if not shared:
            alone &= worlds >= 0
        rows = np.flatnonzero(alone)
        if not len(rows):
            return
        matrices = np.zeros((len(rows), 4, 4))
        matrices[:, 3, 3] = 1.0
        matrices[:, [0, 1, 2], [0, 1, 2]] = radius[rows, None]
        matrices[:, :3, 3] = model.particle_q.numpy()[rows]
        ids = np.full(len(rows), PARTICLES_ID, np.int64)
        self._particle = rows
        self._add("particles", shapes.sphere(), matrices, worlds[rows], ids, 0)

    def add_simulated(self, shared: bool) -> None:
        """Adds the triangles of cloth and soft bodies, one mesh a world."""
        model = self._model
        if not (model.particle_count and model.tri_count):
            return
        triangles = model.tri_indices.numpy().reshape(-1, 3)
        worlds = model.particle_world.numpy()[triangles[:, 0]]
        colors = np.ones((len(triangles), 3))
        if model.tri_color is not None and model.tri_color.shape[0] == model.tri_count:
            colors = srgb_to_linear(model.tri_color.numpy().astype(np.float64).clip(0.0, 1.0))
        points = model.particle_q.numpy().astype(np.float64)
        for world in np.unique(worlds).tolist():
            if world >= 0 or shared:
                own = worlds == world
                used, indices = np.unique(triangles[own], return_inverse=True)
                name = f"simulated {world}"
                self._add_surface(0, name, points[used], indices.reshape(-1, 3), world, used, colors[own])

    def add_skinned(self, shared: bool) -> None:
        """Adds the deformable visual meshes."""
        model = self._model
        meshes = model.deformable_visual_meshes
        if not meshes:
            return
        ranges = newton.geometry.DeformableVisuals(model).mesh_ranges
        for k, mesh in enumerate(meshes):
            world = int(mesh.world)
            if world < 0 and not shared:
                continue
            triangles = mesh.indices.numpy().reshape(-1, 3)
            points = mesh.rest_vertices.numpy().astype(np.float64)
            texture = mesh.texture if mesh.uvs is not None else None
            image = texture if self._load_textures else None
            uvs = None if mesh.uvs is None else mesh.uvs.numpy().reshape(-1, 2)[triangles].astype(np.float32)
            vertices = np.arange(*ranges[k])
            colors = np.ones((len(triangles), 3))
            self._add_surface(1, f"skinned {k}", points, triangles, world, vertices, colors, uvs, self._material(image))

    def result(self) -> ModelScene:
        """What has been added."""
        scene = Scene(tuple(self._meshes), tuple(self._materials), instances=tuple(self._groups))
        empty = np.zeros(0, np.int64)
        return ModelScene(
            scene=scene,
            worlds=np.concatenate([empty, *self._worlds]),
            ids=np.concatenate([empty, *self._ids]),
            unbounded=self._unbounded,
            shape=self._shape,
            particle=self._particle,
            simulated=self._names[0],
            simulated_points=np.concatenate([empty, *self._points[0]]),
            skinned=self._names[1],
            skinned_points=np.concatenate([empty, *self._points[1]]),
        )

    def _add(
        self, name: str, triangles: shapes.Triangles, matrices: Floats, worlds: Ints, ids: Ints, material: int
    ) -> None:
        """Adds a prototype and its instances, which are coloured."""
        count = len(triangles.triangles)
        mesh = Mesh(
            name,
            triangles.points,
            triangles.triangles,
            np.full(count, material, np.int32),
            normals=triangles.normals,
            uvs={} if triangles.uvs is None else {_UV: triangles.uvs},
            bare=np.ones(count, bool),
        )
        self._groups.append(Instances(name, (len(self._meshes),), matrices, np.ones((len(matrices), 3), np.float32)))
        self._meshes.append(mesh)
        self._worlds.append(np.asarray(worlds, np.int64))
        self._ids.append(np.asarray(ids, np.int64))

    def _add_surface(
        self,
        kind: int,
        name: str,
        points: Floats,
        triangles: Ints,
        world: int,
        sources: Ints,
        colors: Floats,
        uvs: Floats | None = None,
        material: int = 0,
    ) -> None:
        """Adds a mesh that deforms."""
        corner_colors = np.repeat(colors[:, None], 3, axis=1).astype(np.float32)
        mesh = Mesh(
            name,
            points,
            triangles.astype(np.int32),
            np.full(len(triangles), material, np.int32),
            colors=corner_colors,
            uvs={} if uvs is None else {_UV: uvs},
        )
        self._groups.append(Instances(name, (len(self._meshes),), np.eye(4)[None]))
        self._meshes.append(mesh)
        self._worlds.append(np.array([world], np.int64))
        self._ids.append(np.array([TRIANGLES_ID], np.int64))
        self._names[kind].append(name)
        self._points[kind].append(np.asarray(sources, np.int64))

    def _image(self, row: int, kind: Any) -> Any:
        """What a shape has for a texture; None: nothing."""
        if self._checkered is not None:
            return self._checkered[1] if row in self._checkered[0] else None
        source = self._model.shape_source[row]
        if not self._load_textures or not isinstance(source, newton.Mesh):
            return None
        return source.texture

    def _material(self, image: Any) -> int:
        """The material of an image; one for each image."""
        if image is None:
            return 0
        if id(image) not in self._material_of:
            pixels = newton.utils.normalize_texture(newton.utils.load_texture(image), require_channels=True)
            if pixels is None:
                raise ValueError(f"Failed to load texture: {image}")
            linear = srgb_to_linear(pixels[..., :3] / 255.0).astype(np.float32)
            texture = Texture(f"image {len(self._materials)}", linear, uv=_UV)
            self._material_of[id(image)] = len(self._materials)
            self._materials.append(Material(texture.name, albedo_texture=texture))
            self._kept.append(image)
        return self._material_of[id(image)]

    def _triangles(self, row: int, kind: Any, scale: Floats, image: Any) -> shapes.Triangles:
        """The triangles of a prototype, to be stretched by `_stretch` unless they are scaled."""
        geo = newton.GeoType
        textured = image is not None
        if kind in (geo.MESH, geo.CONVEX_MESH, geo.HFIELD):
            return self._mesh_triangles(row, kind, scale, textured)
        if kind == geo.PLANE:
            out = shapes.plane(float(scale[0]), float(scale[1]))
        elif kind == geo.BOX:
            out = shapes.box()
        elif kind in (geo.SPHERE, geo.ELLIPSOID):
            out = shapes.sphere()
        elif kind == geo.CAPSULE:
            out = shapes.capsule(float(scale[0]), float(scale[1]))
        elif kind == geo.CYLINDER:
            out = shapes.cylinder(_barrel(scale))
        elif kind == geo.CONE:
            out = shapes.cone()
        else:
            raise ValueError(f"shape {row} is a {kind.name}, which cannot be rendered")
        if textured:
            out = _stretched(out, np.ones(3) if _is_scaled(kind, False) else _stretch(kind, scale))
            out = shapes.Triangles(out.points, out.triangles, out.normals, shapes.projected_uvs(out))
        return out

    def _mesh_triangles(self, row: int, kind: Any, scale: Floats, textured: bool) -> shapes.Triangles:
        """The mesh that Newton traces; a heightfield is one, and so is a convex hull."""
        model, source = self._model, self._model.shape_source[row]
        mesh = wp.uint64(model.shape_source_ptr.numpy()[row])
        device = model.device
        counts = wp.zeros(2, dtype=wp.int32, device=device)
        wp.launch(_count_mesh, dim=1, inputs=[0, mesh, counts], device=device)
        n, m = counts.numpy().tolist()
        points, indices = wp.empty(n, dtype=wp.vec3, device=device), wp.empty(m, dtype=wp.int32, device=device)
        wp.launch(_copy_mesh, dim=max(n, m), inputs=[0, mesh, points, indices], device=device)
        triangles = indices.numpy().reshape(-1, 3)
        normals = uvs = None
        if kind == newton.GeoType.MESH and source.normals is not None:
            normals = np.asarray(source.normals, np.float32)[triangles]
            length = np.linalg.norm(normals, axis=2, keepdims=True)
            normals = np.where(length > 1.0e-6, normals / np.maximum(length, 1.0e-6), np.float32([0.0, 0.0, 1.0]))
            normals = normals.astype(np.float32)
        out = shapes.Triangles(points.numpy().astype(np.float64), triangles, normals)
        if textured:
            out = _stretched(out, scale)
            if kind == newton.GeoType.MESH and source.uvs is not None:
                transform = np.asarray(source.texture_transform, np.float64)
                flat = np.asarray(source.uvs, np.float64) @ transform[:, :2].T + transform[:, 2]
                uvs = flat[triangles].astype(np.float32)
                out = shapes.Triangles(out.points, triangles, out.normals, uvs)
            else:
                out = shapes.Triangles(out.points, triangles, out.normals, shapes.projected_uvs(out))
        return out


def _proportions(kind: Any, scale: Floats, textured: bool) -> tuple[float, ...]:
    """What of a scale the prototype depends on."""
    geo = newton.GeoType
    if textured or kind in (geo.PLANE, geo.CAPSULE):
        return tuple(scale.tolist())
    if kind == geo.CYLINDER:
        return (_barrel(scale),)
    return ()


def _is_scaled(kind: Any, textured: bool) -> bool:
    """Whether a prototype has its size already."""
    return textured or kind in (newton.GeoType.PLANE, newton.GeoType.CAPSULE)


def _stretch(kind: Any, scale: Floats) -> Floats:
    """The factors along x, y and z from a prototype to a shape."""
    geo = newton.GeoType
    if kind == geo.SPHERE:
        return np.full(3, float(scale[0]))
    if kind in (geo.CYLINDER, geo.CONE):
        return np.array([scale[0], scale[0], scale[1]], np.float64)
    if kind in (geo.PLANE, geo.CAPSULE):
        return np.ones(3)
    return np.array(scale, np.float64)


def _barrel(scale: Floats) -> float:
    """The excess of the square of the radius in the middle of a cylinder, relative to that at its ends."""
    r, h, barrel = (float(x) for x in scale)
    if not (barrel > 0.0 and h > 0.0):
        return 0.0
    middle = r + barrel - float(np.sqrt(barrel * barrel - h * h))
    return (middle * middle - r * r) / (r * r)


def _stretched(shape: shapes.Triangles, factors: "Floats | Sequence[float]") -> shapes.Triangles:
    """A shape of another size."""
    factors = np.asarray(factors, np.float64)
    normals = shape.normals
    if normals is not None:
        normals = normals / factors
        normals = (normals / np.linalg.norm(normals, axis=2, keepdims=True)).astype(np.float32)
    return shapes.Triangles(shape.points * factors, shape.triangles, normals, shape.uvs)


def _matrix(transform: Floats) -> Floats:
    """The matrix [4, 4] of a transform (x, y, z, and the quaternion x, y, z, w)."""
    out = np.eye(4)
    x, y, z, w = (float(v) for v in transform[3:7])
    out[:3, :3] = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
    out[:3, 3] = transform[:3]
    return out


def check_model(model: Any) -> None:
    """Raises for what cannot be rendered yet."""
    if model.shape_count and (model.shape_type.numpy() == int(newton.GeoType.GAUSSIAN)).any():
        raise InputError("model: Gaussians have no surface and are not rendered")
    if any(model.body_variant_labels(body) for body in range(model.body_count)):
        raise InputError("model: body variants are not supported")
