"""The records of light modifiers on the device, and the factors that kernels compute from them."""

import numpy as np
import warp as wp

from warp_ir.sampling.distribution2d import Distribution2DTables, value_at_direction

wp.set_module_options({"enable_backward": False})


@wp.struct
class LightModifiers:
    """The modifiers of one light."""

    frame: wp.mat33  # rows: the light's +X and +Y, and the axis of its shaping, -Z
    shaped: int  # 0: the shaping factor is 1
    fade_angle: float  # polar angle at which a soft cone begins to fade [rad]
    cone_angle: float  # polar angle beyond which the light is dark [rad]
    focus: float
    focus_tint: wp.vec3
    profile: int  # distribution of factors; -1: none
    photon_directions: int  # distribution of directions; -1: sampled as if unshaped, weighted by the factor
    ramp_slope: float  # `approximate_shaping` is a linear function of the cosine to the axis, clamped
    ramp_offset: float
    ramp_min: float
    cutoff_cosine: float  # cosine to the axis below which the light is dark
    shadows: int  # 0: where the camera sees its direct light, nothing shadows it
    unlit: int  # row of the link table: the meshes it does not illuminate; -1: none
    shadowless: int  # row of the link table: the meshes that do not shadow its light; -1: none


MODIFIERS_DTYPE: np.dtype[np.void] = LightModifiers.numpy_dtype()
"""The structured type of a host array of `LightModifiers`."""


@wp.struct
class LightModifierTables:
    """The modifiers of all lights of a scene."""

    count: int
    shaped_count: int  # rows with a shaping
    row_of_light: wp.array[wp.int32]  # [lights], row of `rows` or -1
    modified_mesh_count: int  # meshes with a row
    row_of_mesh: wp.array[wp.int32]  # [meshes], row of `rows` or -1; one element if no mesh has a row
    rows: wp.array[LightModifiers]
    mesh_count: int  # meshes of the scene
    links: wp.array[wp.int32]  # [link rows x meshes], 1: the mesh is in the set
    only_sampled_count: int  # lights with an area whose visibility differs from that of rays
    only_sampled_lights: wp.array[wp.int32]  # those lights
    only_sampled_mesh_count: int  # emissive meshes whose visibility differs from that of rays


@wp.func(inline=False)
def shaping_factor(modifiers: LightModifiers, distributions: Distribution2DTables, direction: wp.vec3) -> wp.vec3:
    """The factor of the radiance that a light emits in a unit direction."""
    out = wp.vec3(1.0)
    if modifiers.shaped == 0:
        return out
    d = modifiers.frame * direction
    theta = wp.atan2(wp.sqrt(d[0] * d[0] + d[1] * d[1]), d[2])
    if theta > modifiers.cone_angle:
        return wp.vec3(0.0)
    if theta > modifiers.fade_angle:
        t = (theta - modifiers.fade_angle) / (modifiers.cone_angle - modifiers.fade_angle)
        out = out * (1.0 - t * t * (3.0 - 2.0 * t))
    if modifiers.focus > 0.0:
        f = wp.pow(wp.min(wp.abs(d[2]), 1.0), modifiers.focus)
        out = wp.cw_mul(out, wp.vec3(f) + modifiers.focus_tint * (1.0 - f))
    if modifiers.profile >= 0:
        out = wp.cw_mul(out, value_at_direction(distributions, modifiers.profile, d))
    return out


@wp.func
def approximate_shaping(modifiers: LightModifiers, position: wp.vec3, target: wp.vec4) -> float:
    """A positive approximation of the shaping factor towards `position`, for the weights with which VPLs are resampled.

    `target` is the homogeneous position of the VPL on the light.
    """
    to_light = wp.vec3(target[0], target[1], target[2]) - position * target[3]
    cosine = -wp.dot(
        wp.vec3(modifiers.frame[2, 0], modifiers.frame[2, 1], modifiers.frame[2, 2]), wp.normalize(to_light)
    )
    return wp.clamp(modifiers.ramp_slope * cosine + modifiers.ramp_offset, modifiers.ramp_min, 1.0)


@wp.func
def in_link_set(tables: LightModifierTables, row: int, mesh: int) -> bool:
    """Whether a mesh is in a set of the link table; row -1 is the empty set."""
    if row < 0 or mesh < 0:
        return False
    return tables.links[row * tables.mesh_count + mesh] == 1
