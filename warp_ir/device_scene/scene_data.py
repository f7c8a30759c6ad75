"""The records in which kernels read the scene."""

import warp as wp

from warp_ir.bsdf import AlbedoTable
from warp_ir.bvh import Bvh, Instance, TwoLevel
from warp_ir.light_modifiers import LightModifierTables
from warp_ir.sampling.distribution2d import Distribution2DTables
from warp_ir.scene import LightKind
from warp_ir.texture import TextureTable

wp.set_module_options({"enable_backward": False})

INSTANCE_COLOR = -2
"""Value of `SceneData.triangle_colors`: the triangle has the colour of its instance."""
TRIANGLE_EMITTER = len(LightKind)
"""`SceneData.emitter_kind` of a triangle of an emissive mesh; the values below it are those of `LightKind`."""


@wp.struct
class GlossRow:
    """The parameters of a `Gloss`, and rows of textures.rows that replace them; -1: none."""

    enabled: int  # 0: the material is Lambertian
    base_color: wp.vec3
    base_color_texture: int
    metallic: float
    metallic_texture: int
    has_specular_color: int  # 1: specular_color takes the place of metallic and f0
    specular_color: wp.vec3
    specular_color_texture: int
    f0: float  # of the dielectric and of the clearcoat
    specular_weight: float  # factor of what the dielectric reflects
    roughness: float
    roughness_texture: int
    clearcoat: float
    clearcoat_texture: int
    clearcoat_roughness: float
    clearcoat_roughness_texture: int


@wp.struct
class GlossTables:
    """What materials reflect by direction."""

    rows: wp.array[GlossRow]  # [materials]
    albedo: AlbedoTable


@wp.struct
class SurfaceTextures:
    """Textures and texture coordinates of surfaces, normal maps, and emission that only the camera receives."""

    textures: TextureTable
    triangle_uvs: wp.array[wp.int32]  # [m], first of the triangle's rows in corner_uvs, three per uv set; -1: none
    corner_uvs: wp.array[wp.vec2]
    triangle_tangents: wp.array[wp.int32]  # [m], first of three rows in corner_tangents; -1: computed from the uvs
    corner_tangents: wp.array[wp.vec3]  # directions of increasing u
    camera_emission: wp.array[wp.vec3]  # [materials], radiance to the camera in place of the emission; negative: unset
    camera_emission_texture: wp.array[wp.int32]  # [materials], row of textures.rows; -1: none
    normal_texture: wp.array[wp.int32]  # [materials], row of textures.rows; -1: none
    gloss: GlossTables  # empty if no material has a `Gloss`


@wp.struct
class LightTables:
    """Textures and modifiers of lights."""

    texture: wp.array[wp.int32]  # [lights], index of the distribution that multiplies the radiance; -1: none
    distributions: Distribution2DTables
    modifiers: LightModifierTables


@wp.struct
class SceneData:
    """Geometry, materials and emitters. Tables without entries hold one unused row; the counts are 0 then."""

    bvh: Bvh  # over all triangles; never empty
    instance_count: int
    two_level: wp.array[TwoLevel]  # one row: `bvh` and the BVH over the instances
    instances: wp.array[Instance]
    instance_axes: wp.array[wp.mat33]  # linear part of device_from_local; Instance.centre is the translation
    instance_colors: wp.array[wp.vec3]  # [instances]; one row if none has a colour
    triangle_count: int
    points: wp.array[wp.vec3]  # in the device frame; those of a prototype in the prototype's frame
    indices: wp.array[wp.int32]  # [3 m]
    triangle_material: wp.array[wp.int32]  # [m]
    triangle_mesh: wp.array[wp.int32]  # [m], index into Scene.meshes
    triangle_normals: wp.array[wp.int32]  # [m], first of three rows in corner_normals; -1: faceted
    # [m], first of three rows in corner_colors; -1: the material's albedo; INSTANCE_COLOR: the instance's colour
    triangle_colors: wp.array[wp.int32]
    corner_normals: wp.array[wp.vec3]
    corner_colors: wp.array[wp.vec3]
    albedo: wp.array[wp.vec3]  # [materials]
    emission: wp.array[wp.vec3]  # [materials] radiance
    opacity: wp.array[wp.float32]  # [materials]
    cutoff: wp.array[wp.float32]  # [materials], opacity below which a surface is absent; 0: stochastic alpha test
    albedo_texture: wp.array[wp.int32]  # [materials], row of textures.rows; -1: none
    emission_texture: wp.array[wp.int32]  # as albedo_texture
    opacity_texture: wp.array[wp.int32]  # as albedo_texture
    texture_count: int
    tinted: int  # 1: the colour of an instance multiplies the texture of a triangle that has `INSTANCE_COLOR`
    normal_map_count: int  # materials with a normal map
    surface_textures: wp.array[SurfaceTextures]  # one row: calls pass a pointer instead of copying the record
    gloss_count: int  # materials with a `Gloss`
    non_opaque_count: int  # materials whose opacity is below 1 anywhere
    camera_emission_count: int  # materials whose emission to the camera differs from that to surfaces
    footprint: float  # width of the surface patch over which indirect light averages textures
    emits_back: wp.array[wp.int32]  # [m], 1 if an emissive material emits from the back too
    centre: wp.vec3  # of the bounding sphere of all surfaces, near the origin
    radius: float
    focus: wp.vec3  # centre of the ball in which the picture's details are: of the bounding sphere, unless that is
    focus_radius: float  # too large for float32 to resolve what the camera sees (`frame.py`)

    emitter_count: int
    # [emitters + 1], from 0 to 1, of the selection probabilities: by power, above a floor
    emitter_cdf: wp.array[wp.float32]
    emitter_kind: wp.array[wp.int32]  # [emitters], LightKind, or TRIANGLE_EMITTER
    emitter_pdf_area: wp.array[wp.float32]  # [emitters], selection probability / area; 0 for emitters without area
    emitter_item: wp.array[wp.int32]  # [emitters], row of the light tables, or of the triangle tables
    uneven: int  # 1: the powers of some sources differ by so much that `emitter_lift` is needed
    emitter_lift: wp.array[wp.float32]  # [emitters], factor of the weights with which their VPLs are drawn; one row
    triangle_emitter: wp.array[wp.int32]  # [m], row of the emitter tables or -1; one row if no material emits

    light_count: int  # analytic lights
    light_kind: wp.array[wp.int32]
    light_origin: wp.array[wp.vec3]
    light_axes: wp.array[wp.mat33]  # columns: images of the unit shape's x, y, z axes; a rotation for DISTANT
    light_inverse: wp.array[wp.mat33]
    light_radiance: wp.array[wp.vec3]
    light_angle: wp.array[wp.float32]  # 1 - cosθ_max of a DISTANT light
    light_emitter: wp.array[wp.int32]  # [lights], row of the emitter tables or -1
    large_light_count: int  # lights with an area that is much larger than the scene
    light_large: wp.array[wp.int32]  # [lights], 1: half of its samples are by solid angle, from the focus
    textured_light_count: int  # lights with a texture
    modifier_count: int  # lights and emissive surfaces with modifiers
    shaped_count: int  # of these, those with a shaping
    only_sampled_count: int  # lights with an area that rays do not intersect: light sampling alone accounts for them
    light_tables: wp.array[LightTables]  # one row: calls pass a pointer instead of copying the record
    shape_count: int  # lights with an area: RECT to CYLINDER
    shape_bvh: wp.uint64  # id of the `wp.Bvh` over their boxes
    shape_light: wp.array[wp.int32]  # [shapes], row of the light tables

    sobol: wp.array[wp.uint32]  # generator matrices of the low-discrepancy sequence
    # Address of a copy of this record on the device, for functions that are not inlined: passed by value, a record of
    # this size would be written to memory at every call and could not stay in the caller's registers.
    address: wp.uint64
