"""The records of a scene: meshes, materials, lights, instances; frozen, NumPy arrays only.

Coordinates are in world space (those of instanced meshes in their prototype's space) and in scene units: the unit of
the stage, on which light transport does not depend. Matrices act on column vectors, ``world = matrix @ local``. They
are float64, so that a scene far from the origin keeps its detail until it is uploaded.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property

import numpy as np
import numpy.typing as npt

Color = tuple[float, float, float]
Floats = npt.NDArray[np.floating]
Ints = npt.NDArray[np.integer]
Bools = npt.NDArray[np.bool_]

MAX_RADIANCE = 1e30
"""Upper limit of radiance; larger values are errors in the input, and overflow float32 when scaled or summed."""


class InputError(ValueError):
    """The user's input cannot be rendered; the message is one line that names what is wrong and where."""


def keep_read_only(record: object, label: str, names: Sequence[str]) -> None:
    """Replaces arrays of a frozen record by views that cannot be written to: changes would have no effect.

    The arrays that they view stay as they are, writable for whoever made them.

    Args:
        record: The record.
        label: What messages call it.
        names: Fields that are arrays, or None.

    Raises:
        InputError: A field is something else.
    """
    for name in names:
        value = getattr(record, name)
        if value is None:
            continue
        if not isinstance(value, np.ndarray):
            raise InputError(f"{label}: {name} must be a NumPy array, is of type {type(value).__name__}")
        if value.flags.writeable:
            view = value.view()
            view.flags.writeable = False
            object.__setattr__(record, name, view)


def pixel_mean(pixels: Floats) -> Floats:
    """The mean of an image [h, w, c], float64 [c]; few rows at a time are added in single precision."""
    if pixels.dtype == np.float64 or pixels.size < 2**16 or pixels.ndim != 3:
        return np.asarray(np.mean(pixels, axis=(0, 1), dtype=np.float64))
    height, width, channels = pixels.shape
    total = np.zeros(channels)
    for first in range(0, height, 64):
        rows = pixels[first : first + 64].astype(np.float32, copy=False).reshape(-1, width * channels)
        total += (np.ones(len(rows), np.float32) @ rows).reshape(width, channels).sum(axis=0, dtype=np.float64)
    mean: Floats = total / (height * width)
    return mean


class LightKind(IntEnum):
    """The shapes of a `Light`; comments give them in the light's local space, as UsdLux defines it."""

    RECT = 0  # width x height in the XY plane, emits along -Z
    DISK = 1  # radius in the XY plane, emits along -Z
    SPHERE = 2  # radius, emits outward
    CYLINDER = 3  # length along X, radius; lateral surface, emits outward
    POINT = 4  # the limit of a small sphere; emits the same intensity in all directions
    DISTANT = 5  # emits along -Z, from a cone of directions of full angle `angle` [degrees]; 0: parallel light
    DOME = 6  # environment light around the scene


class Wrap(IntEnum):
    """The values of a `Texture` outside of [0, 1]² (wrap mode)."""

    BLACK = 0  # the value `outside`
    CLAMP = 1
    REPEAT = 2
    MIRROR = 3


@dataclass(frozen=True, eq=False)
class Texture:
    """An image and how it is mapped to surfaces."""

    name: str
    """Path of the asset, or any label for messages."""
    pixels: Floats
    """float [h, w, 3] or [h, w, 1], linear, row 0 at the top: the material's final values, scale and bias applied."""
    wrap: tuple[Wrap, Wrap] = (Wrap.REPEAT, Wrap.REPEAT)
    """Wrap modes in s and in t."""
    outside: Color = (0.0, 0.0, 0.0)
    """The border value, used outside of the image where `wrap` is BLACK."""
    uv: str = "st"
    """Name of the texture coordinates in `Mesh.uvs`; a mesh without them has (0, 0) everywhere."""
    transform: Floats = field(default_factory=lambda: np.eye(2, 3))
    """float64 [2, 3]: (s, t) = transform (u, v, 1). (0, 0) is the image's lower left corner, (1, 1) its upper right."""

    def __post_init__(self) -> None:
        keep_read_only(self, f"texture {self.name!r}", ("pixels", "transform"))

    @cached_property
    def mean(self) -> Color:
        """Mean of the pixels; an image of one channel is grey."""
        red, green, blue = np.broadcast_to(pixel_mean(self.pixels), 3).tolist()
        return red, green, blue


TEXTURED_GLOSS = ("base_color", "metallic", "specular_color", "roughness", "clearcoat", "clearcoat_roughness")
"""Parameters of `Gloss` that may have a texture, in the field of that name and `_texture`."""


@dataclass(frozen=True)
class Gloss:
    """How a surface reflects by direction: microfacets over a diffuse base, below a clearcoat (UsdPreviewSurface).

    A dielectric reflects ((ior - 1) / (ior + 1))² at normal incidence and everything at grazing incidence; a metal its
    base colour. The mean of a texture replaces the constant that it stands in for.
    """

    base_color: Color = (0.18, 0.18, 0.18)
    """Albedo of the diffuse base, in [0, 1]; of a metal the reflectance."""
    metallic: float = 0.0
    """0: a dielectric, 1: a metal."""
    specular_color: Color | None = None
    """Reflectance at normal incidence, in [0, 1], in place of `metallic` and `ior`: the specular workflow."""
    roughness: float = 0.5
    """In [0, 1]; its square is the α of the distribution GGX of normals. Below 0.032 the surface is a mirror."""
    ior: float = 1.5
    """Index of refraction of the dielectric, and of the clearcoat."""
    specular_weight: float = 1.0
    """Factor, in [0, 1], of what the dielectric reflects at its surface."""
    clearcoat: float = 0.0
    """Weight of the clearcoat, in [0, 1]."""
    clearcoat_roughness: float = 0.01
    """Like `roughness`."""
    base_color_texture: Texture | None = None
    metallic_texture: Texture | None = None
    specular_color_texture: Texture | None = None
    roughness_texture: Texture | None = None
    clearcoat_texture: Texture | None = None
    clearcoat_roughness_texture: Texture | None = None

    def __post_init__(self) -> None:
        for name in TEXTURED_GLOSS:
            image = getattr(self, f"{name}_texture")
            if image is not None:
                object.__setattr__(self, name, image.mean if name.endswith("color") else image.mean[0])

    @property
    def textures(self) -> tuple[Texture, ...]:
        """All textures of these parameters."""
        images = (getattr(self, f"{name}_texture") for name in TEXTURED_GLOSS)
        return tuple(image for image in images if image is not None)


@dataclass(frozen=True)
class Material:
    """A Lambertian surface that may emit. The mean of a texture replaces the constant that it stands in for."""

    name: str = ""
    """Prim path, or any label for messages."""
    albedo: Color = (0.18, 0.18, 0.18)
    """Hemispherical reflectance ρ per channel, in [0, 1]."""
    emission: Color = (0.0, 0.0, 0.0)
    """Emitted radiance [W sr⁻¹ m⁻²], the same in all directions of the emitting side."""
    opacity: float = 1.0
    """Alpha in [0, 1], used as `cutoff` says."""
    cutoff: float = 0.0
    """Alpha threshold: the surface is absent where the opacity is less. 0: a ray hits it with probability `opacity`."""
    albedo_texture: Texture | None = None
    emission_texture: Texture | None = None
    opacity_texture: Texture | None = None
    glow: Color | None = None
    """Radiance of the emitting side as the camera sees it, where it differs from `emission`, which lights the scene;
    None: `emission`, with the shaping of the mesh's `MeshLight`."""
    glow_texture: Texture | None = None
    normal_texture: Texture | None = None
    """Tangent-space normals [x, y, z] of any length: x in the direction in which the texture coordinate u grows, y in
    that of v, z out of the front. They shade what camera rays hit. A mesh without those coordinates ignores them."""
    gloss: Gloss | None = None
    """What `RenderSettings.materials` "all" reflects in place of `albedo`; None: a Lambertian surface."""

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
        """All textures of this material."""
        images = (
            self.albedo_texture,
            self.emission_texture,
            self.opacity_texture,
            self.glow_texture,
            self.normal_texture,
        )
        own = tuple(image for image in images if image is not None)
        return own if self.gloss is None else own + self.gloss.textures


@dataclass(frozen=True, eq=False)
class Shaping:
    """Factors on a light's radiance by the direction of emission (UsdLux ShapingAPI); they multiply.

    θ is the angle between that direction and the axis: the light's -Z, whatever its shape.
    """

    cone_angle: float = 180.0
    """Half angle [degrees] of the cone outside of which nothing is emitted."""
    cone_softness: float = 0.0
    """Fraction of that angle, in [0, 1], over which emission falls off smoothly to 0."""
    focus: float = 0.0
    """Exponent of the factor |cosθ|^focus."""
    focus_tint: Color = (0.0, 0.0, 0.0)
    """Tint off the axis: the factor becomes |cosθ|^focus + (1 - |cosθ|^focus) · focus_tint."""
    profile: Floats | None = None
    """Photometric profile (IES), [rows, columns]: factors at the centres of cells. Rows divide θ from 0° to 180°,
    columns the azimuth from 0° to 360°, counted from the light's +X towards its +Y; interpolated in between."""

    def __post_init__(self) -> None:
        keep_read_only(self, "shaping", ("profile",))


@dataclass(frozen=True, eq=False)
class MeshLight:
    """Light attributes of a mesh whose materials emit: shaping, light linking, shadows (UsdLux MeshLightAPI)."""

    name: str = ""
    """Prim path of the light, or any label for messages."""
    world_from_light: Floats = field(default_factory=lambda: np.eye(4))
    """float64 [4, 4]; its -Z is the axis of the shaping."""
    shaping: Shaping | None = None
    """Factors on the emitted radiance; None: the same radiance in all directions."""
    shadows: bool = True
    """Defined like `Light.shadows`."""
    unlit: frozenset[int] = frozenset()
    """Defined like `Light.unlit`."""
    shadowless: frozenset[int] = frozenset()
    """Defined like `Light.shadowless`."""

    def __post_init__(self) -> None:
        keep_read_only(self, f"light {self.name!r}", ("world_from_light",))


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in world space, or in the space of the prototype that they are part of (`Instances`).

    Surfaces reflect light and occlude on both sides. The winding (counter-clockwise seen from the front) decides only
    from which side they emit and where the geometric normal points.
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
    """float32 [m, 3, 3], unit shading normals at the triangles' corners; None: the geometric normals."""
    colors: Floats | None = None
    """float32 [m, 3, 3], albedo at the triangles' corners, which replaces the material's; None: the material's."""
    double_sided: bool = False
    """Whether an emissive material emits from the back as well."""
    uvs: Mapping[str, Floats] = field(default_factory=dict)
    """Texture coordinates at the triangles' corners by name, float32 [m, 3, 2]."""
    bare: Bools | None = None
    """bool [m], triangles whose albedo is that of their instance where `Instances.colors` is given; None: none."""
    tangents: Floats | None = None
    """float32 [m, 3, 3], tangents at the corners for normal maps: directions in which u grows; None: per triangle."""
    light: MeshLight | None = None
    """Shaping, light linking and shadows of its emission; None: it emits in all directions, lights all meshes, and all
    meshes cast shadows in its light."""

    def __post_init__(self) -> None:
        names = ("points", "triangles", "material", "normals", "colors", "bare", "tangents")
        keep_read_only(self, f"mesh {self.name!r}", names)


@dataclass(frozen=True, eq=False)
class Instances:
    """A prototype: meshes that are stored once, and the transforms of its instances."""

    name: str
    """Path of the prototype, or any label for messages."""
    meshes: tuple[int, ...]
    """Indices into `Scene.meshes`; a mesh is part of at most one `Instances`, whose instances alone are rendered."""
    matrices: Floats
    """world_from_prototype, float64 [k, 4, 4], invertible; they may mirror and shear."""
    colors: Floats | None = None
    """float32 [k, 3], albedo per instance of the triangles that `Mesh.bare` selects; None: their material's."""

    def __post_init__(self) -> None:
        keep_read_only(self, f"instances {self.name!r}", ("matrices", "colors"))


@dataclass(frozen=True, eq=False)
class Light:
    """A light that is no surface of the scene: it emits, but neither occludes nor reflects."""

    name: str
    """Prim path, or any label for messages."""
    kind: LightKind
    """Shape of the light; it decides which of the dimensions below are used."""
    radiance: Color
    """Emitted radiance [W sr⁻¹ m⁻²]; for POINT the intensity [W sr⁻¹]; for DISTANT with angle 0 the
    irradiance [W m⁻²] on a surface that faces the light."""
    world_from_light: Floats = field(default_factory=lambda: np.eye(4))
    """float64 [4, 4]; shapes with an area may be scaled and sheared, DISTANT and DOME use only the rotation."""
    width: float = 1.0
    height: float = 1.0
    radius: float = 0.5
    length: float = 1.0
    angle: float = 0.53
    """Full angle of a DISTANT light's cone [degrees]."""
    texture: Floats | None = None
    """float32 [h, w, 3], factor on the radiance of a RECT or DOME light, bilinearly interpolated. On a rectangle row 0
    is at +Y and column 0 at +X: upright and unmirrored seen from the side that emits. On a dome (latitude-longitude)
    row 0 is at +Y, and columns run from -Z over +X, +Z and -X back to -Z."""
    shaping: Shaping | None = None
    """None: the same radiance in all directions."""
    shadows: bool = True
    """False: its direct light at points that the camera sees is unoccluded. Indirect light always casts shadows."""
    unlit: frozenset[int] = frozenset()
    """Indices of the `Scene.meshes` that it does not illuminate (light linking)."""
    shadowless: frozenset[int] = frozenset()
    """Indices of the `Scene.meshes` that cast no shadow in its light (shadow linking)."""

    def __post_init__(self) -> None:
        keep_read_only(self, f"light {self.name!r}", ("world_from_light", "texture"))
