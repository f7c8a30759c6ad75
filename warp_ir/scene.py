"""The scene as the host sees it: frozen records of NumPy arrays, no Warp, no USD.

Everything is in world space (meshes that are instanced: in their prototype's) and in scene units (whatever unit
the stage uses: transport never needs to know). Matrices act on column vectors, ``world = matrix @ local``, and are
float64 so that a scene far from the origin keeps its detail until it is uploaded.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from warp_ir.placing import areas_of_copies, bounds_of_copies, place

Color = tuple[float, float, float]
Floats = npt.NDArray[np.floating]
Ints = npt.NDArray[np.integer]

CONFORM_POLICIES = (
    "expandAperture",
    "cropAperture",
    "adjustApertureWidth",
    "adjustApertureHeight",
    "adjustPixelAspectRatio",
)
"""How a camera's window meets an image of another aspect (UsdRender's aspectRatioConformPolicy)."""


MAX_CLIPPING_PLANES = 6
"""Of a `Camera`: as many as a box has sides."""


class InputError(ValueError):
    """The user's input cannot be rendered; the message is one line that says what and where."""


class LightKind(IntEnum):
    """The shapes a `Light` can have; the comment gives the local shape, as UsdLux defines it."""

    RECT = 0  # width x height in the XY plane, emits along -Z
    DISK = 1  # radius in the XY plane, emits along -Z
    SPHERE = 2  # radius, emits outward
    CYLINDER = 3  # length along X, radius; lateral surface, emits outward
    POINT = 4  # the limit of a small sphere; emits the same intensity everywhere
    DISTANT = 5  # shines along -Z from a cone of `angle` degrees (full angle); 0 = parallel
    DOME = 6  # surrounds the scene


class Projection(IntEnum):
    """How a `Camera` maps points to its film."""

    PERSPECTIVE = 0
    ORTHOGRAPHIC = 1


class Wrap(IntEnum):
    """What a `Texture` is beyond its edges."""

    BLACK = 0  # the value `outside`
    CLAMP = 1
    REPEAT = 2
    MIRROR = 3


@dataclass(frozen=True, eq=False)
class Texture:
    """An image on surfaces."""

    name: str
    """The asset, or any label for messages."""
    pixels: Floats
    """float [h, w, 3] or [h, w, 1], linear, row 0 at the top: the values that the material has, nothing left to do."""
    wrap: tuple[Wrap, Wrap] = (Wrap.REPEAT, Wrap.REPEAT)
    """In the directions of s and t."""
    outside: Color = (0.0, 0.0, 0.0)
    """The value beyond the edges where `wrap` is BLACK."""
    uv: str = "st"
    """Which of `Mesh.uvs` it is placed by; (0, 0) where a mesh does not have it."""
    transform: Floats = field(default_factory=lambda: np.eye(2, 3))
    """float64 [2, 3], s and t from (u, v, 1). (0, 0) is the image's lower left corner, (1, 1) its upper right."""

    @property
    def mean(self) -> Color:
        """Mean of the pixels; grey where there is one channel."""
        red, green, blue = np.broadcast_to(np.mean(self.pixels, axis=(0, 1), dtype=np.float64), 3).tolist()
        return red, green, blue


@dataclass(frozen=True)
class Material:
    """A Lambertian surface that may emit. Where a texture is given, its mean replaces the value beside it."""

    name: str = ""
    """Prim path, or any label for messages."""
    albedo: Color = (0.18, 0.18, 0.18)
    """Hemispherical reflectance ρ per channel, in [0, 1]."""
    emission: Color = (0.0, 0.0, 0.0)
    """Emitted radiance [W sr⁻¹ m⁻²], the same in all directions of the emitting side."""
    opacity: float = 1.0
    """In [0, 1]: see `cutoff`."""
    cutoff: float = 0.0
    """The surface is absent where the opacity is less; 0: it is there for that share of the rays."""
    albedo_texture: Texture | None = None
    emission_texture: Texture | None = None
    opacity_texture: Texture | None = None
    glow: Color | None = None
    """Radiance that the camera sees of the emitting side, where that is not `emission`, by which it lights the scene;
    None: the same, shaped as the mesh's `MeshLight` has it."""
    glow_texture: Texture | None = None
    normal_texture: Texture | None = None
    """Normals [x, y, z], of any length, by which the camera sees the surface lit: x where the first of the mesh's
    texture coordinates grows, y where the second does, z out of the front. Without such coordinates it does nothing."""

    def __post_init__(self) -> None:
        if self.albedo_texture is not None:
            object.__setattr__(self, "albedo", self.albedo_texture.mean)
        if self.emission_texture is not None:
            object.__setattr__(self, "emission", self.emission_texture.mean)
        if self.glow_texture is not None:
            object.__setattr__(self, "glow", self.glow_texture.mean)
        if self.opacity_texture is not None:
            object.__setattr__(self, "opacity", self.opacity_texture.mean[0])

    @property
    def textures(self) -> tuple[Texture, ...]:
        """Those it has."""
        images = (
            self.albedo_texture,
            self.emission_texture,
            self.opacity_texture,
            self.glow_texture,
            self.normal_texture,
        )
        return tuple(image for image in images if image is not None)


@dataclass(frozen=True, eq=False)
class Shaping:
    """How a light's radiance depends on the direction of emission (UsdLux ShapingAPI), θ being its angle to the axis.

    The axis is the light's -Z, whatever its shape. Factors multiply.
    """

    cone_angle: float = 180.0
    """Half angle [degrees] of the cone outside which the light is dark."""
    cone_softness: float = 0.0
    """Part of that angle, from 0 to 1, over which the light fades out smoothly."""
    focus: float = 0.0
    """Exponent of the factor |cosθ|^focus."""
    focus_tint: Color = (0.0, 0.0, 0.0)
    """What the focus fades to: the factor is |cosθ|^focus + (1 - |cosθ|^focus) · focus_tint."""
    profile: Floats | None = None
    """Photometry of a lamp, [rows, columns]: the factor at the middle of cells that divide θ from 0° to 180° and the
    azimuth from 0° to 360°, from the light's +X towards its +Y; interpolated between them."""


@dataclass(frozen=True, eq=False)
class MeshLight:
    """What makes a light of a mesh whose materials emit, beyond that (UsdLux MeshLightAPI)."""

    name: str = ""
    """Prim path of the light, or any label for messages."""
    world_from_light: Floats = field(default_factory=lambda: np.eye(4))
    """float64 [4, 4]; its -Z is the axis of the shaping."""
    shaping: Shaping | None = None
    """Multiplies the radiance that the materials emit; None: the same in all directions."""
    shadows: bool = True
    """As for `Light`, and so are the other two."""
    unlit: frozenset[int] = frozenset()
    shadowless: frozenset[int] = frozenset()


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in world space, or in the space of the prototype that they are part of (`Instances`).

    Surfaces reflect and block on both sides. The winding (counter-clockwise seen from the front)
    decides only which side emits, and where the geometric normal points.
    """

    name: str
    """Prim path, or any label for messages."""
    points: Floats
    """float64 [n, 3]."""
    triangles: Ints
    """int32 [m, 3], indices into `points`, counter-clockwise seen from the front."""
    material: Ints
    """int32 [m], indices into `Scene.materials`."""
    normals: Floats | None = None
    """float32 [m, 3, 3], unit shading normals of the triangles' corners; None: faceted."""
    colors: Floats | None = None
    """float32 [m, 3, 3], albedo of the triangles' corners, in place of the material's; None: the material's."""
    double_sided: bool = False
    """Whether an emissive material emits from the back as well."""
    uvs: Mapping[str, Floats] = field(default_factory=dict)
    """Texture coordinates of the triangles' corners by name, float32 [m, 3, 2]."""
    bare: npt.NDArray[np.bool_] | None = None
    """bool [m], triangles that take the colour of their instance where `Instances.colors` has one; None: none do."""
    tangents: Floats | None = None
    """float32 [m, 3, 3], directions in which u grows at the corners, for normal maps; None: each triangle's own."""
    light: MeshLight | None = None
    """Shaping, links and shadows of what its materials emit; None: it emits all around, lights everything, and
    everything shadows it."""


@dataclass(frozen=True, eq=False)
class Instances:
    """Meshes that are stored once and seen in many places."""

    name: str
    """Path of the prototype, or any label for messages."""
    meshes: tuple[int, ...]
    """Indices into `Scene.meshes`; a mesh is part of one `Instances` at most, and then not seen by itself."""
    matrices: Floats
    """world_from_prototype, float64 [k, 4, 4], invertible; mirrored and sheared ones are fine."""
    colors: Floats | None = None
    """float32 [k, 3], albedo of the triangles that `Mesh.bare` selects; None: their material's."""


@dataclass(frozen=True, eq=False)
class Light:
    """A light that is not a surface of the scene: it casts light, blocks none, reflects none."""

    name: str
    """Prim path, or any label for messages."""
    kind: LightKind
    """Which of the dimensions below count."""
    radiance: Color
    """Emitted radiance [W sr⁻¹ m⁻²]; for POINT the intensity [W sr⁻¹]; for DISTANT with angle 0 the
    irradiance [W m⁻²] on a surface that faces the light."""
    world_from_light: Floats = field(default_factory=lambda: np.eye(4))
    """float64 [4, 4]; scale and shear allowed for the shapes with an area, ignored by DISTANT and DOME."""
    width: float = 1.0
    height: float = 1.0
    radius: float = 0.5
    length: float = 1.0
    angle: float = 0.53
    """Full angle of a DISTANT light's cone [degrees]."""
    texture: Floats | None = None
    """float32 [h, w, 3], multiplies the radiance of a RECT or DOME light, bilinear between texels. On a rectangle row 0
    is at +Y and column 0 at +X: upright and unmirrored on the side that is lit. On a dome row 0 is around +Y, and the
    columns go round from -Z by way of +X, +Z and -X."""
    shaping: Shaping | None = None
    """None: the same radiance in all directions."""
    shadows: bool = True
    """False: nothing shadows its direct light, what the camera sees of it; light by way of surfaces is always real."""
    unlit: frozenset[int] = frozenset()
    """Indices of the `Scene.meshes` that it does not light."""
    shadowless: frozenset[int] = frozenset()
    """Indices of the `Scene.meshes` that its light passes through as if they were not there."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A perspective or orthographic camera that looks along its -Z, with +Y up."""

    name: str = ""
    world_from_camera: Floats = field(default_factory=lambda: np.eye(4))
    """float64 [4, 4], rotation and translation only."""
    window: tuple[float, float, float, float] = (-0.5, 0.5, -0.5, 0.5)
    """left, right, bottom, top of the film: on the plane z = -1 (perspective) or in scene units."""
    projection: Projection = Projection.PERSPECTIVE
    clipping: tuple[float, float] = (0.0, math.inf)
    """Nearest and farthest depth along -Z that camera rays see, in scene units."""
    exposure: float = 1.0
    """Linear factor on the film's radiance (UsdGeomCamera's exposure controls; 1 by default)."""
    lens_radius: float = 0.0
    """Radius of the thin lens of a perspective camera, in scene units; 0: a pinhole, all is sharp."""
    focus_distance: float = 1.0
    """Depth along -Z at which a camera with a lens is sharp, in scene units."""
    clipping_planes: tuple[tuple[float, float, float, float], ...] = ()
    """At most `MAX_CLIPPING_PLANES` of (a, b, c, d): camera rays see only where a x + b y + c z + d >= 0, x, y, z being
    the place in the camera's space."""

    @property
    def aspect(self) -> float:
        """Width of the window over its height."""
        left, right, bottom, top = self.window
        return (right - left) / (top - bottom)

    def fit(self, width: int, height: int, policy: str = CONFORM_POLICIES[0], pixel_aspect: float = 1.0) -> "Camera":
        """This camera with its window made to fit an image, about its middle.

        Args:
            width: Of the image, in pixels.
            height: Of the image.
            policy: One of `CONFORM_POLICIES`: the window grows (expandAperture), shrinks (cropAperture), changes in
                one of its sides alone (adjustApertureWidth, adjustApertureHeight), or stays as it is and the pixels
                are stretched over it (adjustPixelAspectRatio).
            pixel_aspect: Width of a pixel over its height.
        """
        left, right, bottom, top = self.window
        grow = width / height * pixel_aspect / self.aspect  # 1: it fits already
        wider, taller = {
            "expandAperture": (max(grow, 1.0), max(1.0 / grow, 1.0)),
            "cropAperture": (min(grow, 1.0), min(1.0 / grow, 1.0)),
            "adjustApertureWidth": (grow, 1.0),
            "adjustApertureHeight": (1.0, 1.0 / grow),
            "adjustPixelAspectRatio": (1.0, 1.0),
        }[policy]
        x, half_x = 0.5 * (left + right), 0.5 * (right - left) * wider
        y, half_y = 0.5 * (bottom + top), 0.5 * (top - bottom) * taller
        return replace(self, window=(x - half_x, x + half_x, y - half_y, y + half_y))

    @staticmethod
    def look_at(
        eye: Sequence[float],
        target: Sequence[float],
        up: Sequence[float] = (0.0, 1.0, 0.0),
        *,
        fov: float = 45.0,
        aspect: float = 1.0,
        name: str = "",
    ) -> "Camera":
        """A perspective camera at `eye` that looks at `target`.

        Args:
            eye: Position, scene units.
            target: The point in the middle of the picture.
            up: Any direction that is upright in the picture; not parallel to the view.
            fov: Vertical field of view [degrees].
            aspect: Width over height of the window.
            name: A label for messages.
        """
        origin = np.asarray(eye, dtype=np.float64)
        back = origin - np.asarray(target, dtype=np.float64)
        right = np.cross(np.asarray(up, dtype=np.float64), back)
        if not (np.linalg.norm(back) > 0.0 and np.linalg.norm(right) > 0.0):
            raise InputError("camera: eye and target coincide, or up is parallel to the view")
        back /= np.linalg.norm(back)
        right /= np.linalg.norm(right)
        matrix = np.eye(4)
        matrix[:3, 0], matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = right, np.cross(back, right), back, origin
        y = math.tan(math.radians(fov) / 2.0)
        return Camera(name=name, world_from_camera=matrix, window=(-y * aspect, y * aspect, -y, y))


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything a picture depends on, apart from the `RenderSettings`."""

    meshes: tuple[Mesh, ...] = ()
    materials: tuple[Material, ...] = (Material(),)
    lights: tuple[Light, ...] = ()
    camera: Camera = field(default_factory=Camera)
    name: str = ""
    """File or label the scene came from."""
    instances: tuple[Instances, ...] = ()
    """Which of the meshes are prototypes, and where those are; all other meshes are in the world as they stand."""
    warnings: tuple[str, ...] = ()
    """What was skipped, approximated or guessed: one line each, beginning with the prim's path."""
    stats: Mapping[str, int] = field(default_factory=dict)
    """Counts of what was read and what was skipped, for `--stats` and `warp-ir info`."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Fields of `RenderSettings` that the file asks for; `render` without settings of yours does so."""
    shutter: tuple["Scene", ...] = ()
    """The scene at moments spread evenly over the time in which the camera's shutter is open, in order, a power of two
    of them; empty: nothing moves. Iterations take them in turn. What does not move are the same objects in all of them.
    """

    @property
    def glows(self) -> bool:
        """Whether any surface emits, or looks as if it did."""
        return any(max(material.emission) > 0.0 or material.glow is not None for material in self.materials)

    @property
    def triangle_count(self) -> int:
        """Number of triangles over all meshes: what is stored."""
        return sum(len(mesh.triangles) for mesh in self.meshes)

    @property
    def triangles_seen(self) -> int:
        """Number of triangles in the world: those of a prototype count once for every instance."""
        more = sum((len(i.matrices) - 1) * sum(len(self.meshes[k].triangles) for k in i.meshes) for i in self.instances)
        return self.triangle_count + more

    def bounds(self) -> tuple[Floats, Floats]:
        """Lower and upper corner of the meshes' bounding box, float64 [3]; a unit cube if there are none."""
        # Only points that a triangle uses count: stray points must not move the scene's frame.
        placed = [x for x in self._placed() if len(x[0].triangles) and (x[1] is None or len(x[1].matrices))]
        boxes = [_box(mesh, group) for mesh, group in placed]
        if not boxes:
            return np.full(3, -0.5), np.full(3, 0.5)
        return np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)

    @property
    def extent(self) -> float:
        """Diagonal of the bounding box, in scene units: what relative lengths are relative to."""
        lower, upper = self.bounds()
        return float(np.linalg.norm(upper - lower))

    def area(self) -> float:
        """Area of all surfaces, one side each, in square scene units."""
        return float(sum(_area_in_world(mesh, group).sum() for mesh, group in self._placed()))

    def mean_albedo(self) -> float:
        """Mean reflectivity ρ̄ of the surfaces, weighted by area, averaged over the channels (Keller 1997)."""
        albedo = np.array([m.albedo for m in self.materials], dtype=np.float64).reshape(-1, 3).mean(axis=1)
        total, reflected = 0.0, 0.0
        for mesh, group in self._placed():
            if group is None:
                areas = _areas_by_material(mesh)
                total += float(areas.sum())
                reflected += float(areas @ albedo[: len(areas)]) if mesh.colors is None else _colored_area(mesh)
                continue
            area = _areas(mesh)
            rho = albedo[mesh.material] if mesh.colors is None else mesh.colors.mean(axis=(1, 2))
            copies = _area_in_world(mesh, group)
            share = area / area.sum() if area.sum() > 0.0 else area
            means: Floats = np.full(len(copies), share @ rho)
            if group.colors is not None and mesh.bare is not None:
                bare = mesh.bare
                means = share[~bare] @ rho[~bare] + share[bare].sum() * group.colors.mean(axis=1)
            total += float(copies.sum())
            reflected += float((copies * means).sum())
        return reflected / total if total > 0.0 else 0.0

    def flat(self, meshes: Collection[int] | None = None) -> "Scene":
        """This scene with instanced meshes written out, copy by copy; their indices stay.

        Args:
            meshes: Which; None: all of them.
        """
        written, left = list(self.meshes), []
        for group in self.instances:
            chosen = [k for k in group.meshes if meshes is None or k in meshes]
            for k in chosen:
                written[k] = _written_out(self.meshes[k], group, self.materials)
            rest = tuple(k for k in group.meshes if k not in chosen)
            if rest:
                left.append(replace(group, meshes=rest))
        return replace(self, meshes=tuple(written), instances=tuple(left))

    def _placed(self) -> list[tuple[Mesh, Instances | None]]:
        """Every mesh with the instances it is part of."""
        groups = {k: group for group in self.instances for k in group.meshes}
        return [(mesh, groups.get(k)) for k, mesh in enumerate(self.meshes)]


# A mesh that does not move is part of many scenes: what is computed of it is kept as long as it lives.
_AREAS: WeakKeyDictionary[Mesh, Floats] = WeakKeyDictionary()
_AREAS_BY_MATERIAL: WeakKeyDictionary[Mesh, Floats] = WeakKeyDictionary()
_COLORED_AREAS: WeakKeyDictionary[Mesh, float] = WeakKeyDictionary()
_MATERIALS: WeakKeyDictionary[Mesh, tuple[int, ...]] = WeakKeyDictionary()
_AREAS_OF_COPIES: WeakKeyDictionary[Instances, WeakKeyDictionary[Mesh, Floats]] = WeakKeyDictionary()
_BOXES: WeakKeyDictionary[Mesh | Instances, WeakKeyDictionary[Mesh, tuple[Floats, Floats]]] = WeakKeyDictionary()


def materials_of(mesh: Mesh) -> tuple[int, ...]:
    """Indices of the materials that a mesh's triangles have, ascending."""
    if mesh not in _MATERIALS:
        _MATERIALS[mesh] = tuple(np.unique(mesh.material).tolist())
    return _MATERIALS[mesh]


def _areas(mesh: Mesh) -> Floats:
    """Areas of a mesh's triangles, float64 [m]."""
    if mesh not in _AREAS:
        a, b, c = (mesh.points[mesh.triangles[:, k]] for k in range(3))
        _AREAS[mesh] = np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))
    return _AREAS[mesh]


def _areas_by_material(mesh: Mesh) -> Floats:
    """Area of a mesh's triangles of each material, up to the last that it has."""
    if mesh not in _AREAS_BY_MATERIAL:
        _AREAS_BY_MATERIAL[mesh] = np.bincount(mesh.material, weights=_areas(mesh)).astype(np.float64)
    return _AREAS_BY_MATERIAL[mesh]


def _colored_area(mesh: Mesh) -> float:
    """Area times albedo of a mesh with colours."""
    assert mesh.colors is not None
    if mesh not in _COLORED_AREAS:
        _COLORED_AREAS[mesh] = float((_areas(mesh) * mesh.colors.mean(axis=(1, 2))).sum())
    return _COLORED_AREAS[mesh]


def _area_in_world(mesh: Mesh, group: Instances | None) -> Floats:
    """Areas of a mesh's triangles, or of its copies, float64."""
    if group is None:
        return _areas(mesh)
    known = _AREAS_OF_COPIES.setdefault(group, WeakKeyDictionary())
    if mesh not in known:
        known[mesh] = areas_of_copies(mesh.points, mesh.triangles, group.matrices)
    return known[mesh]


def _box(mesh: Mesh, group: Instances | None) -> tuple[Floats, Floats]:
    """Lower and upper corner [3] of the points that the triangles use, or of their copies."""
    known = _BOXES.setdefault(group or mesh, WeakKeyDictionary())
    if mesh not in known:
        used = mesh.points[np.unique(mesh.triangles)]
        if group is None:
            known[mesh] = (used.min(axis=0), used.max(axis=0))
        else:
            known[mesh] = bounds_of_copies(used, group.matrices)
    return known[mesh]


def _written_out(mesh: Mesh, group: Instances, materials: Sequence[Material]) -> Mesh:
    """An instanced mesh as one in the world: all its copies, one after the other."""
    copies = len(group.matrices)
    points, triangles, normals = place(mesh.points, mesh.triangles, mesh.normals, group.matrices)
    mirrored = np.linalg.det(group.matrices[:, :3, :3]) < 0.0
    # What else a mesh has, it has per triangle, or per corner of each.
    tables: dict[str, Any] = {
        f.name: _repeated(getattr(mesh, f.name), mirrored)
        for f in fields(mesh)
        if f.name not in ("points", "triangles", "normals", "bare")
    }
    if mesh.tangents is not None:
        linear = np.repeat(group.matrices[:, :3, :3], 3 * len(mesh.triangles), axis=0)
        tables["tangents"] = np.einsum("nij,nj->ni", linear, tables["tangents"].reshape(-1, 3)).reshape(-1, 3, 3)
    if group.colors is not None and mesh.bare is not None:
        own = mesh.colors
        if own is None:
            albedo = np.array([m.albedo for m in materials], np.float32)[mesh.material]
            own = np.repeat(albedo[:, None], 3, axis=1)
        given = group.colors.astype(np.float32)[:, None, None]
        own = _repeated(own, mirrored).reshape(copies, -1, 3, 3)
        tables["colors"] = np.where(mesh.bare[None, :, None, None], given, own).reshape(-1, 3, 3)
    return replace(mesh, points=points, triangles=triangles, normals=normals, bare=None, **tables)


def _repeated(value: Any, mirrored: Any) -> Any:
    """A table, or each of a mapping of tables, once for every copy; anything else as it is.

    Rows [m, 3, c] are of corners, which `place` turns round in mirrored copies.
    """
    if isinstance(value, np.ndarray):
        turned = value[:, ::-1] if value.ndim == 3 else value
        return np.concatenate([turned if is_mirrored else value for is_mirrored in mirrored])
    return {key: _repeated(v, mirrored) for key, v in value.items()} if isinstance(value, Mapping) else value
