"""Sampling of emitters by area: emissive triangles and the lights of UsdLux are one list.

A point on an emitter has a homogeneous position (x, y, z, w): w = 1 for a point, w = 0 for the direction towards an
infinite light. Its normal (x, y, z, a) gives the emitter's cosine as max(0, a + n·ω): a = 0 for a surface, n = 0 and
a = 1 for isotropic emission. One formula gathers light from every kind of emitter.
"""

import warp as wp

from warp_ir.device_scene import TRIANGLE_EMITTER, SceneData
from warp_ir.lights.shape import (
    area_scale,
    is_large,
    large_light_pdf,
    light_axis,
    light_texture,
    modifier_row_of_light,
    modifier_row_of_surface,
    offset_from_light,
    outward_normal,
    point_radiance,
    unit_area,
    world_from_dome,
)
from warp_ir.lights.visibility import only_sampled
from warp_ir.sampling.distribution2d import cell_direction, cell_uv, sample_cell, value_at_direction, value_at_uv
from warp_ir.sampling.solid_angle import sample_solid_angle
from warp_ir.sampling.square_to import square_to_cone, square_to_disk
from warp_ir.scene import LightKind
from warp_ir.surface import alpha_at, emission_at, offset_ray_origin, scene_at

wp.set_module_options({"enable_backward": False})

_DISK = wp.constant(int(LightKind.DISK))
_SPHERE = wp.constant(int(LightKind.SPHERE))
_CYLINDER = wp.constant(int(LightKind.CYLINDER))
_POINT = wp.constant(int(LightKind.POINT))
_DISTANT = wp.constant(int(LightKind.DISTANT))
_TRIANGLE = wp.constant(TRIANGLE_EMITTER)


@wp.struct
class EmitterSample:
    """A sampled point on a sampled emitter."""

    position: wp.vec4
    normal: wp.vec4
    intensity: wp.vec3  # radiance / pdf: [W/sr] for a point, [W/m²] for a direction
    pdf: float  # per area for a point, per solid angle for a direction; 0: rays cannot or must not hit the emitter
    emitter: int
    modifier_row: int  # of its `LightModifiers`; -1: none
    large_pdf: float  # per area, if the light `is_large`: `pdf` even where rays must not hit the light; else 0


@wp.struct
class EmitterSelection:
    """A sampled emitter."""

    emitter: int
    probability: float
    u_remapped: float  # the sample number stretched to [0, 1), for further decisions


@wp.func
def select_emitter(scene: SceneData, u: float) -> EmitterSelection:
    """Samples an emitter with the scene's selection probabilities."""
    low = int(0)
    high = scene.emitter_count
    while high - low > 1:
        middle = (low + high) // 2
        if scene.emitter_cdf[middle] <= u:
            low = middle
        else:
            high = middle
    out = EmitterSelection()
    out.emitter = low
    out.probability = scene.emitter_cdf[low + 1] - scene.emitter_cdf[low]
    out.u_remapped = (u - scene.emitter_cdf[low]) / out.probability
    return out


@wp.func
def sample_emitter_area(scene: SceneData, selection: EmitterSelection, u: wp.vec2) -> EmitterSample:
    """Samples a point on a selected emitter: by area, or a direction by solid angle; textured ones by radiance."""
    item = scene.emitter_item[selection.emitter]
    kind = scene.emitter_kind[selection.emitter]
    out = EmitterSample()
    if kind == _TRIANGLE:
        out = _sample_triangle(scene, item, selection.probability, selection.u_remapped, u)
    elif kind <= _CYLINDER:
        if is_large(scene, item):
            out = _sample_large(scene.address, item, selection.probability, selection.u_remapped, u)
        else:
            out = _sample_shape(scene, item, selection.probability, u)
    else:
        out = _sample_point_or_direction(scene, item, selection.probability, u)
    out.emitter = selection.emitter
    if only_sampled(scene, out.modifier_row):
        out.pdf = 0.0
    return out


@wp.func
def sample_light(scene: SceneData, u_emitter: float, u: wp.vec2) -> EmitterSample:
    """Samples a point on the scene's emitters: `select_emitter`, then `sample_emitter_area`."""
    return _sample_light(scene.address, u_emitter, u)


@wp.func(inline=False)
def _sample_light(address: wp.uint64, u_emitter: float, u: wp.vec2) -> EmitterSample:
    """`sample_light` as a called function."""
    scene = scene_at(address)[0]
    selection = select_emitter(scene, u_emitter)
    return sample_emitter_area(scene, selection, u)


@wp.func
def _sample_triangle(scene: SceneData, triangle: int, probability: float, u_side: float, u: wp.vec2) -> EmitterSample:
    """A point on an emissive triangle; `u_side` selects the side if both emit."""
    a = scene.points[scene.indices[3 * triangle]]
    b = scene.points[scene.indices[3 * triangle + 1]]
    c = scene.points[scene.indices[3 * triangle + 2]]
    cross = wp.cross(b - a, c - a)
    n = wp.normalize(cross)
    sides = float(1.0)
    if scene.emits_back[triangle] == 1:
        sides = 2.0
        n = wp.where(u_side < 0.5, n, -n)
    root = wp.sqrt(u[0])
    b0 = 1.0 - root
    b1 = root * (1.0 - u[1])
    p = offset_ray_origin(a, b, c, b0, b1, n)
    area = 0.5 * wp.length(cross)
    out = EmitterSample()
    out.pdf = probability / (area * sides)
    out.position = wp.vec4(p[0], p[1], p[2], 1.0)
    out.normal = wp.vec4(n[0], n[1], n[2], 0.0)
    radiance = emission_at(scene, triangle, b0, b1, area, scene.footprint)
    if scene.non_opaque_count > 0:
        radiance = radiance * alpha_at(scene, triangle, b0, b1)
    out.intensity = radiance / out.pdf
    out.modifier_row = modifier_row_of_surface(scene, triangle)
    return out


@wp.func
def _sample_shape(scene: SceneData, light: int, probability: float, u: wp.vec2) -> EmitterSample:
    """A point on a light with an area."""
    kind = scene.light_kind[light]
    n = wp.vec3(0.0, 0.0, 1.0)
    q = wp.vec3(u[0] - 0.5, u[1] - 0.5, 0.0)
    radiance = scene.light_radiance[light]
    relative_pdf = float(1.0)
    texture = light_texture(scene, light)
    if texture >= 0:
        cell = sample_cell(scene.light_tables[0].distributions, texture, u)
        uv = cell_uv(scene.light_tables[0].distributions, texture, cell)
        distribution = scene.light_tables[0].distributions.distributions[texture]
        relative_pdf = cell.probability * float(distribution.rows) * float(distribution.columns)
        radiance = wp.cw_mul(radiance, value_at_uv(scene.light_tables[0].distributions, texture, uv))
        q = wp.vec3(0.5 - uv[0], 0.5 - uv[1], 0.0)
    if kind == _DISK:
        d = square_to_disk(u)
        q = wp.vec3(d[0], d[1], 0.0)
    elif kind == _SPHERE:
        n = square_to_cone(u, 2.0, wp.vec3(0.0, 0.0, 1.0))
        q = n
    elif kind == _CYLINDER:
        phi = 2.0 * wp.pi * u[1]
        n = wp.vec3(0.0, wp.cos(phi), wp.sin(phi))
        q = wp.vec3(u[0] - 0.5, n[1], n[2])
    p = scene.light_origin[light] + scene.light_axes[light] * q
    world_n = wp.normalize(wp.transpose(scene.light_inverse[light]) * n)
    out = EmitterSample()
    out.pdf = probability * relative_pdf / (unit_area(kind) * area_scale(scene, light, n))
    p = offset_from_light(p, world_n)
    out.position = wp.vec4(p[0], p[1], p[2], 1.0)
    out.normal = wp.vec4(world_n[0], world_n[1], world_n[2], 0.0)
    out.intensity = radiance / out.pdf
    out.modifier_row = modifier_row_of_light(scene, light)
    return out


@wp.func(inline=False)
def _sample_large(address: wp.uint64, light: int, probability: float, u_technique: float, u: wp.vec2) -> EmitterSample:
    """A point on a light that is much larger than the scene: half by area, half by solid angle from the focus."""
    scene = scene_at(address)[0]
    out = _sample_shape(scene, light, probability, u)
    if u_technique < 0.5:
        sample = sample_solid_angle(
            scene.light_kind[light],
            scene.light_axes[light],
            scene.light_inverse[light],
            scene.light_origin[light] - scene.focus,
            u,
        )
        out.intensity = wp.vec3(0.0)
        if not sample.pdf > 0.0:
            return out
        n = outward_normal(scene, light, scene.focus + sample.offset)
        p = offset_from_light(scene.focus + sample.offset, n)
        out.position = wp.vec4(p[0], p[1], p[2], 1.0)
        out.normal = wp.vec4(n[0], n[1], n[2], 0.0)
    p = wp.vec3(out.position[0], out.position[1], out.position[2])
    out.pdf = probability * large_light_pdf(scene, light, p)
    out.intensity = point_radiance(scene, light, p) / out.pdf
    out.large_pdf = out.pdf
    return out


@wp.func
def _sample_point_or_direction(scene: SceneData, light: int, probability: float, u: wp.vec2) -> EmitterSample:
    """A point light, or a direction towards a distant light or a dome."""
    kind = scene.light_kind[light]
    out = EmitterSample()
    out.modifier_row = modifier_row_of_light(scene, light)
    out.normal = wp.vec4(0.0, 0.0, 0.0, 1.0)
    if kind == _POINT:
        p = scene.light_origin[light]
        out.position = wp.vec4(p[0], p[1], p[2], 1.0)
        out.intensity = scene.light_radiance[light] / probability
        return out
    texture = light_texture(scene, light)
    if texture >= 0:
        cell = sample_cell(scene.light_tables[0].distributions, texture, u)
        local = cell_direction(scene.light_tables[0].distributions, texture, cell)
        xyz = wp.vec3(local[0], local[1], local[2])
        d = world_from_dome(scene, light, xyz)
        out.position = wp.vec4(d[0], d[1], d[2], 0.0)
        out.pdf = probability * local[3]
        radiance = wp.cw_mul(
            scene.light_radiance[light], value_at_direction(scene.light_tables[0].distributions, texture, xyz)
        )
        out.intensity = radiance / out.pdf
        return out
    cone = float(2.0)
    if kind == _DISTANT:
        cone = scene.light_angle[light]
    d = square_to_cone(u, cone, light_axis(scene, light))
    out.position = wp.vec4(d[0], d[1], d[2], 0.0)
    if cone > 0.0:
        out.pdf = probability / (2.0 * wp.pi * cone)
        out.intensity = scene.light_radiance[light] / out.pdf
    else:
        out.intensity = scene.light_radiance[light] / probability
    return out
