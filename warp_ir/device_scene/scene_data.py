"""The records that kernels take: the scene as they see it."""

import warp as wp

from warp_ir.bvh import Bvh, Instance, TwoLevel
from warp_ir.light_modifiers import LightModifierTables
from warp_ir.sampling.distribution2d import Distribution2DTables
from warp_ir.scene import LightKind
from warp_ir.texture import TextureTable

wp.set_module_options({"enable_backward": False})

INSTANCE_COLOR = -2
"""In `SceneData.triangle_colors`: the triangle has the colour of its instance."""
TRIANGLE_EMITTER = len(LightKind)
"""Kind of an emitter that is a triangle of an emissive mesh; the kinds below it are `LightKind`'s."""


@wp.struct
class SurfaceTextures:
    """The textures, and where they lie; and what the camera sees of some materials."""

    textures: TextureTable
    triangle_uvs: wp.array[wp.int32]  # [m], first of its rows in corner_uvs, three for every set; -1: none
    corner_uvs: wp.array[wp.vec2]
    triangle_tangents: wp.array[wp.int32]  # [m], first of its three rows in corner_tangents; -1: its own
    corner_tangents: wp.array[wp.vec3]  # directions in which u grows
    glow: wp.array[wp.vec3]  # [materials], what the camera sees in place of the emission; negative: nothing else
    glow_texture: wp.array[wp.int32]  # [materials], row of textures.rows; -1: none
    normal_texture: wp.array[wp.int32]  # [materials], row of textures.rows; -1: none


@wp.struct
class LightTables:
    """Textures and controls of lights."""

    texture: wp.array[wp.int32]  # [lights], the grid that multiplies the radiance, or -1
    distributions: Distribution2DTables
    modifiers: LightModifierTables


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
    normal_map_count: int  # materials with one
    surface_textures: wp.array[SurfaceTextures]  # one: a pointer is passed where a table would be copied
    non_opaque_count: int  # materials whose opacity is below 1 anywhere
    glow_count: int  # materials of which the camera sees something else than their emission
    footprint: float  # width of the patch that a reflection of light stands for
    emits_back: wp.array[wp.int32]  # [m], 1 if an emissive material emits from the back too
    centre: wp.vec3  # of a sphere that holds all surfaces, next to the origin
    radius: float

    emitter_count: int
    emitter_cdf: wp.array[wp.float32]  # [emitters + 1], by power, from 0 to 1
    emitter_kind: wp.array[wp.int32]  # [emitters], LightKind, or TRIANGLE_EMITTER
    emitter_pdf_area: wp.array[wp.float32]  # [emitters], probability over area; 0 for what has none
    emitter_item: wp.array[wp.int32]  # [emitters], row of the light tables, or triangle
    triangle_emitter: wp.array[wp.int32]  # [m], its emitter or -1; one row if no material emits

    light_count: int  # analytic lights
    light_kind: wp.array[wp.int32]
    light_origin: wp.array[wp.vec3]
    light_axes: wp.array[wp.mat33]  # columns: what the unit shape's x, y, z become; rotation for DISTANT
    light_inverse: wp.array[wp.mat33]
    light_radiance: wp.array[wp.vec3]
    light_angle: wp.array[wp.float32]  # 1 - cosθ_max of a DISTANT light
    light_emitter: wp.array[wp.int32]  # its row in the emitter tables, or -1
    textured_count: int  # lights with a texture
    modifier_count: int  # lights, and surfaces, with a control
    shaped_count: int  # of them with a shaping
    only_sampled_count: int  # lights with an area that rays are not to find
    light_tables: wp.array[
        LightTables
    ]  # one row: what few scenes have must not be copied with the others' at every call
    shape_count: int  # lights with an area: RECT to CYLINDER
    shape_bvh: wp.uint64  # boxes around them
    shape_light: wp.array[wp.int32]  # [shapes], row of the light tables

    sobol: wp.array[wp.uint32]
    # Of a copy of this record on the device. Functions that are called, and not copied into their callers, take this: a
    # record of this size passed by value would be written out at every call, and kept from the registers of the caller.
    address: wp.uint64
