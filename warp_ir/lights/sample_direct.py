"""Next-event estimation: sampling of the emitters from a point, its pdf for a given ray, and MIS weights."""

import warp as wp

from warp_ir.device_scene import SceneData
from warp_ir.lights.sample_area import sample_emitter_area, select_emitter
from warp_ir.lights.shape import (
    area_scale,
    is_large,
    light_axis,
    light_texture,
    modifier_row_of_light,
    offset_from_light,
    point_radiance,
    texture_uv,
    unit_area,
)
from warp_ir.lights.visibility import only_sampled
from warp_ir.sampling.distribution2d import uv_pdf
from warp_ir.sampling.solid_angle import sample_solid_angle, solid_angle_pdf
from warp_ir.scene import LightKind
from warp_ir.surface import Hit

wp.set_module_options({"enable_backward": False})

_DISK = wp.constant(int(LightKind.DISK))
_CYLINDER = wp.constant(int(LightKind.CYLINDER))


@wp.struct
class DirectSample:
    """A sampled direction towards an emitter, and the radiance from there."""

    direction: wp.vec3  # unit, towards the light
    target: wp.vec4  # the sampled point on the light, homogeneous
    radiance: wp.vec3  # over the pdf: an estimate of ∫ L dω without shadows and shaping
    pdf: float  # of the direction, per solid angle; 0: rays cannot or must not hit the light, its MIS weight is 1
    modifier_row: int  # of the light's `LightModifiers`; -1: none


@wp.func
def _by_solid_angle(scene: SceneData, light: int) -> bool:
    """Whether a light with an area is sampled by solid angle, not by the radiance of its texture."""
    return light_texture(scene, light) < 0 or is_large(scene, light)


@wp.func
def sample_direct(scene: SceneData, position: wp.vec3, u_emitter: float, u: wp.vec2) -> DirectSample:
    """Samples an emitter, and a direction from a point towards it: by solid angle if it is a shape, else by area."""
    selection = select_emitter(scene, u_emitter)
    item = scene.emitter_item[selection.emitter]
    out = DirectSample()
    if scene.emitter_kind[selection.emitter] <= _CYLINDER and _by_solid_angle(scene, item):
        sample = sample_solid_angle(
            scene.light_kind[item],
            scene.light_axes[item],
            scene.light_inverse[item],
            scene.light_origin[item] - position,
            u,
        )
        if not sample.pdf > 0.0:
            return out
        out.direction = wp.normalize(sample.offset)
        outward = -out.direction
        if scene.light_kind[item] <= _DISK:
            outward = wp.normalize(light_axis(scene, item))
        p = offset_from_light(position + sample.offset, outward)
        out.target = wp.vec4(p[0], p[1], p[2], 1.0)
        out.pdf = sample.pdf * selection.probability
        out.radiance = point_radiance(scene, item, position + sample.offset) / out.pdf
        out.modifier_row = modifier_row_of_light(scene, item)
        if only_sampled(scene, out.modifier_row):
            out.pdf = 0.0
        return out
    point = sample_emitter_area(scene, selection, u)
    xyz = wp.vec3(point.position[0], point.position[1], point.position[2])
    to_light = xyz - position * point.position[3]
    distance_squared = wp.dot(to_light, to_light)
    out.direction = to_light / wp.sqrt(distance_squared)
    normal = wp.vec3(point.normal[0], point.normal[1], point.normal[2])
    solid_angle_per_area = wp.max(0.0, point.normal[3] - wp.dot(normal, out.direction)) / distance_squared
    out.target = point.position
    out.radiance = point.intensity * solid_angle_per_area
    if solid_angle_per_area > 0.0:
        out.pdf = point.pdf / solid_angle_per_area
    out.modifier_row = point.modifier_row
    return out


@wp.func
def power_heuristic(pdf: float, other_pdf: float) -> float:
    """MIS weight of a sample of one technique against another (power heuristic, Veach 1997, β = 2).

    Where one technique is nearly exact, as light sampling is, it leaves less noise than the balance heuristic.
    """
    ratio = other_pdf / pdf
    return 1.0 / (1.0 + ratio * ratio)


@wp.func
def selection_probability(scene: SceneData, emitter: int) -> float:
    """Probability of selecting an emitter; 0 for -1."""
    if emitter < 0:
        return 0.0
    return scene.emitter_cdf[emitter + 1] - scene.emitter_cdf[emitter]


@wp.func
def shape_pdf(scene: SceneData, light: int, origin: wp.vec3, direction: wp.vec3, t: float) -> float:
    """The pdf per solid angle with which `sample_direct` samples a direction that meets a light with an area at t."""
    kind = scene.light_kind[light]
    probability = selection_probability(scene, scene.light_emitter[light])
    if _by_solid_angle(scene, light):
        to_light = scene.light_origin[light] - origin
        return probability * solid_angle_pdf(
            kind, scene.light_axes[light], scene.light_inverse[light], to_light, direction
        )
    n = wp.vec3(0.0, 0.0, 1.0)  # only rectangles have textures
    cosine = -wp.dot(wp.normalize(wp.transpose(scene.light_inverse[light]) * n), direction)
    pdf = probability * t * t / (unit_area(kind) * area_scale(scene, light, n) * cosine)
    texture = light_texture(scene, light)
    uv = texture_uv(scene, light, origin, direction, t)
    return pdf * uv_pdf(scene.light_tables[0].distributions, texture, uv)


@wp.func
def mis_weight(bsdf_pdf: float, light_pdf: float) -> float:
    """MIS weight of a light hit by a ray sampled from a BSDF; 1 for a ray that was not (negative `bsdf_pdf`)."""
    if bsdf_pdf < 0.0:
        return 1.0
    return power_heuristic(bsdf_pdf, light_pdf)


@wp.func
def surface_mis_weight(scene: SceneData, hit: Hit, direction: wp.vec3, bsdf_pdf: float) -> float:
    """MIS weight of the emission of a surface hit by a unit direction that was sampled from a BSDF."""
    a = scene.points[scene.indices[3 * hit.triangle]]
    b = scene.points[scene.indices[3 * hit.triangle + 1]]
    c = scene.points[scene.indices[3 * hit.triangle + 2]]
    area = 0.5 * wp.length(wp.cross(b - a, c - a)) * float(1 + scene.emits_back[hit.triangle])
    cosine = wp.max(-wp.dot(hit.normal, direction), 1.0e-20)
    probability = selection_probability(scene, scene.triangle_emitter[hit.triangle])
    return mis_weight(bsdf_pdf, probability * hit.t * hit.t / (area * cosine))
