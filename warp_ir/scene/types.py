"""The records of a scene: meshes, materials, lights, instances; frozen, NumPy arrays only.

Everything is in world space (meshes that are instanced: in their prototype's) and in scene units (whatever unit
the stage uses: light transport does not depend on it). Matrices act on column vectors, ``world = matrix @ local``, and
are float64, so that a scene far from the origin keeps its detail until it is uploaded.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
import numpy.typing as npt

Color = tuple[float, float, float]
Floats = npt.NDArray[np.floating]
Ints = npt.NDArray[np.integer]


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
