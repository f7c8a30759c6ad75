"""Next-event estimation: light that may come to a point, sampled towards it, and its density along a ray."""

import warp as wp

from warp_ir.device_scene import SceneData
from warp_ir.lights.sample_area import sample_emitter_area, select_emitter
from warp_ir.lights.shape import (
    area_scale,
    light_axis,
    modifiers_of,
    offset_from_light,
    texture_of,
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
    """Light that comes to a point from a random direction."""

    direction: wp.vec3  # unit, towards the light
    target: wp.vec4  # the place on the light, homogeneous
    radiance: wp.vec3  # over the density of the direction: an estimate of ∫ L dω, unshadowed and unshaped
    pdf: float  # of the direction, per solid angle; 0: no ray finds the light, only `sample_direct`
    modifiers: int  # row of the light's `LightModifiers`; -1: it has none


@wp.func
def sample_direct(scene: SceneData, position: wp.vec3, u_pick: float, u: wp.vec2) -> DirectSample:
    """Light that may come to a point: from which emitter, in proportion to power; if it is a shape, by solid angle."""
    choice = select_emitter(scene, u_pick)
    item = scene.emitter_item[choice.emitter]
    out = DirectSample()
    if scene.emitter_kind[choice.emitter] <= _CYLINDER and texture_of(scene, item) < 0:
        aim = sample_solid_angle(
            scene.light_kind[item],
            scene.light_axes[item],
            scene.light_inverse[item],
            scene.light_origin[item] - position,
            u,
        )
        if not aim.pdf > 0.0:
            return out
        out.direction = wp.normalize(aim.way)
        off = -out.direction
        if scene.light_kind[item] <= _DISK:
            off = wp.normalize(light_axis(scene, item))
        p = offset_from_light(position + aim.way, off)
        out.target = wp.vec4(p[0], p[1], p[2], 1.0)
        out.pdf = aim.pdf * choice.probability
        out.radiance = scene.light_radiance[item] / out.pdf
        out.modifiers = modifiers_of(scene, item)
        if only_sampled(scene, out.modifiers):
            out.pdf = 0.0
        return out
    point = sample_emitter_area(scene, choice, u)
    xyz = wp.vec3(point.position[0], point.position[1], point.position[2])
    to_light = xyz - position * point.position[3]
    squared = wp.dot(to_light, to_light)
    out.direction = to_light / wp.sqrt(squared)
    facing = wp.vec3(point.normal[0], point.normal[1], point.normal[2])
    per_area = wp.max(0.0, point.normal[3] - wp.dot(facing, out.direction)) / squared
    out.target = point.position
    out.radiance = point.intensity * per_area
    if per_area > 0.0:
        out.pdf = point.pdf / per_area
    out.modifiers = point.modifiers
    return out


@wp.func
def power_heuristic(pdf: float, other: float) -> float:
    """Weight of a sample that another way of sampling might have found as well (Veach 1997, β = 2).

    Where one way is nearly exact, as towards the lights, it leaves less of the other's noise than the balance does.
    """
    ratio = other / pdf
    return 1.0 / (1.0 + ratio * ratio)


@wp.func
def selection_probability(scene: SceneData, emitter: int) -> float:
    """With which an emitter is chosen."""
    if emitter < 0:
        return 0.0
    return scene.emitter_cdf[emitter + 1] - scene.emitter_cdf[emitter]


@wp.func
def shape_pdf(scene: SceneData, light: int, origin: wp.vec3, direction: wp.vec3, t: float) -> float:
    """The density per solid angle with which `sample_direct` gives a direction that meets a shape at t."""
    kind = scene.light_kind[light]
    probability = selection_probability(scene, scene.light_emitter[light])
    texture = texture_of(scene, light)
    if texture < 0:
        to_light = scene.light_origin[light] - origin
        return probability * solid_angle_pdf(
            kind, scene.light_axes[light], scene.light_inverse[light], to_light, direction
        )
    n = wp.vec3(0.0, 0.0, 1.0)  # only rectangles have textures
    cosine = -wp.dot(wp.normalize(wp.transpose(scene.light_inverse[light]) * n), direction)
    pdf = probability * t * t / (unit_area(kind) * area_scale(scene, light, n) * cosine)
    place = texture_uv(scene, light, origin, direction, t)
    return pdf * uv_pdf(scene.light_tables[0].distributions, texture, place)


@wp.func
def mis_weight(bsdf_pdf: float, light_pdf: float) -> float:
    """Of a light that a ray has found; 1 if the ray was no sample of a BSDF."""
    if bsdf_pdf < 0.0:
        return 1.0
    return power_heuristic(bsdf_pdf, light_pdf)


@wp.func
def surface_mis_weight(scene: SceneData, hit: Hit, direction: wp.vec3, bsdf_pdf: float) -> float:
    """The weight of the emission of an emissive surface that a unit direction, sampled from a BSDF, has hit."""
    a = scene.points[scene.indices[3 * hit.triangle]]
    b = scene.points[scene.indices[3 * hit.triangle + 1]]
    c = scene.points[scene.indices[3 * hit.triangle + 2]]
    area = 0.5 * wp.length(wp.cross(b - a, c - a)) * float(1 + scene.emits_back[hit.triangle])
    cosine = wp.max(-wp.dot(hit.normal, direction), 1.0e-20)
    probability = selection_probability(scene, scene.triangle_emitter[hit.triangle])
    return mis_weight(bsdf_pdf, probability * hit.t * hit.t / (area * cosine))
