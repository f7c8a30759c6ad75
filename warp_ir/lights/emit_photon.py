"""Photons: their emission from a light, and their first reflection where some meshes do not shadow the light."""

import warp as wp

from warp_ir.device_scene import SceneData
from warp_ir.light_modifiers import in_link_set, shaping_factor
from warp_ir.lights.sample_area import EmitterSample
from warp_ir.lights.visibility import CROSSINGS, continue_behind
from warp_ir.sampling.distribution2d import cell_direction, sample_cell
from warp_ir.sampling.square_to import from_local, square_to_cone, square_to_cosine_hemisphere, square_to_disk
from warp_ir.surface import Hit, closest, scene_at, visible

wp.set_module_options({"enable_backward": False})

_FAR_SQUARED = wp.constant(16.0)
"""Squared distance of points on lights whose photons are aimed, relative to the radius of the ball of details."""


@wp.struct
class Photon:
    """A photon as it leaves a light."""

    origin: wp.vec3
    direction: wp.vec3
    flux: wp.vec3  # [W]


@wp.struct
class PhotonTarget:
    """The target of the photons of infinite lights: annuli around a focus, each sampled with its own probability.

    The annuli lie in the plane perpendicular to the photon's direction. Each has half the outer radius of the next.
    """

    annulus_count: int  # 0: photons are spread uniformly over the scene's bounding sphere
    focus: wp.array[wp.vec4]  # [lights], x, y, z, and the outer radius of the last annulus, which covers the scene
    cdf: wp.array[wp.float32]  # [lights, annulus_count + 1], CDF of the annuli of every light


@wp.func
def emit_photon(scene: SceneData, point: EmitterSample, photon_target: PhotonTarget, u: wp.vec2, v: wp.vec2) -> Photon:
    """Samples the photon of a point on an emitter: `u` its direction, `v` the origin if the light is infinite."""
    out = Photon()
    xyz = wp.vec3(point.position[0], point.position[1], point.position[2])
    if point.position[3] == 0.0:
        # Photons of an infinite light start on a disk perpendicular to their direction that covers the scene.
        out.direction = -xyz
        if photon_target.annulus_count == 0:
            d = square_to_disk(v)
            out.origin = scene.centre + scene.radius * (from_local(wp.vec3(d[0], d[1], 0.0), xyz) + xyz)
            out.flux = point.intensity * (wp.pi * scene.radius * scene.radius)
        else:
            target = _sample_target(photon_target, scene.emitter_item[point.emitter], v)
            focus = photon_target.focus[scene.emitter_item[point.emitter]]
            offset = from_local(wp.vec3(target[0], target[1], 0.0), xyz)
            out.origin = wp.vec3(focus[0], focus[1], focus[2]) + offset
            out.origin = _start_outside(scene, out.origin, xyz)
            out.flux = point.intensity * target[2]
    elif wp.length_sq(scene.focus - xyz) > _FAR_SQUARED * scene.focus_radius * scene.focus_radius:
        out = _aim_at_focus(scene, point, u)
    elif point.normal[3] == 1.0:
        out.origin = xyz
        out.direction = square_to_cone(u, 2.0, wp.vec3(0.0, 0.0, 1.0))
        out.flux = point.intensity * (4.0 * wp.pi)
    else:
        out.origin = xyz
        out.direction = square_to_cosine_hemisphere(u, wp.vec3(point.normal[0], point.normal[1], point.normal[2]))
        out.flux = point.intensity * wp.pi
    if point.modifier_row >= 0:
        out = _shape_photon(scene.address, point, u, out)
    return out


@wp.func
def _start_outside(scene: SceneData, p: wp.vec3, to_light: wp.vec3) -> wp.vec3:
    """Where a photon of an infinite light starts that passes a point: outside the scene.

    If nothing is in its way it starts outside the ball of details alone, where float32 is precise.
    """
    if scene.focus_radius < scene.radius:
        near = p + (scene.focus_radius - wp.dot(p - scene.focus, to_light)) * to_light
        if visible(scene, near, wp.vec4(to_light[0], to_light[1], to_light[2], 0.0)):
            return near
    return p + (scene.radius - wp.dot(p - scene.centre, to_light)) * to_light


@wp.func
def _aim_at_focus(scene: SceneData, point: EmitterSample, u: wp.vec2) -> Photon:
    """A photon of a distant point on an emitter, aimed at the ball of details; half of them if that is not all."""
    out = Photon()
    out.origin = wp.vec3(point.position[0], point.position[1], point.position[2])
    n = wp.vec3(point.normal[0], point.normal[1], point.normal[2])
    to_focus = scene.focus - out.origin
    axis = wp.normalize(to_focus)
    sine_squared = scene.focus_radius * scene.focus_radius / wp.dot(to_focus, to_focus)
    cone = sine_squared / (1.0 + wp.sqrt(1.0 - sine_squared))  # 1 - cosθ of the ball
    aimed = wp.where(scene.focus_radius < scene.radius, 0.5, 1.0)
    if u[0] < aimed:
        out.direction = square_to_cone(wp.vec2(u[0] / aimed, u[1]), cone, axis)
    else:
        v = wp.vec2((u[0] - aimed) / (1.0 - aimed), u[1])
        if point.normal[3] == 1.0:
            out.direction = square_to_cone(v, 2.0, wp.vec3(0.0, 0.0, 1.0))
        else:
            out.direction = square_to_cosine_hemisphere(v, n)
    cosine = wp.max(0.0, point.normal[3] + wp.dot(n, out.direction))
    pdf = (1.0 - aimed) * cosine / (wp.pi * (1.0 + 3.0 * point.normal[3]))
    difference = out.direction - axis
    if u[0] < aimed or 0.5 * wp.length_sq(difference) < cone:
        pdf += aimed / (2.0 * wp.pi * cone)
    out.flux = point.intensity * (cosine / pdf)
    return out


@wp.func
def _sample_target(photon_target: PhotonTarget, light: int, v: wp.vec2) -> wp.vec3:
    """Samples where a photon crosses the plane of the focus: x and y in that plane, and 1/pdf per area."""
    first = light * (photon_target.annulus_count + 1)
    annulus = int(0)
    while annulus < photon_target.annulus_count - 1 and photon_target.cdf[first + annulus + 1] <= v[0]:
        annulus += 1
    probability = photon_target.cdf[first + annulus + 1] - photon_target.cdf[first + annulus]
    outer = photon_target.focus[light][3] / float(1 << (photon_target.annulus_count - 1 - annulus))
    inner = wp.where(annulus == 0, 0.0, 0.5 * outer)
    u_remapped = (v[0] - photon_target.cdf[first + annulus]) / probability
    r = wp.sqrt(inner * inner + u_remapped * (outer * outer - inner * inner))
    phi = 2.0 * wp.pi * v[1]
    area = wp.pi * (outer * outer - inner * inner)
    return wp.vec3(r * wp.cos(phi), r * wp.sin(phi), area / probability)


@wp.func(inline=False)
def _shape_photon(address: wp.uint64, point: EmitterSample, u: wp.vec2, unshaped: Photon) -> Photon:
    """Applies the shaping of a light: the direction is sampled from its distribution, if any, and the flux weighted."""
    scene = scene_at(address)[0]
    modifiers = scene.light_tables[0].modifiers.rows[point.modifier_row]
    photon = unshaped
    if modifiers.photon_directions >= 0:
        local = cell_direction(
            scene.light_tables[0].distributions,
            modifiers.photon_directions,
            sample_cell(scene.light_tables[0].distributions, modifiers.photon_directions, u),
        )
        photon.direction = wp.transpose(modifiers.frame) * wp.vec3(local[0], local[1], local[2])
        n = wp.vec3(point.normal[0], point.normal[1], point.normal[2])
        cosine = wp.max(0.0, point.normal[3] + wp.dot(n, photon.direction))
        photon.flux = point.intensity * (cosine / local[3])
    photon.flux = wp.cw_mul(
        photon.flux, shaping_factor(modifiers, scene.light_tables[0].distributions, photon.direction)
    )
    return photon


@wp.struct
class PhotonHit:
    """The first reflection of a photon."""

    hit: Hit
    weight: float  # factor of its flux; 0: the photon ends


@wp.func
def first_reflection(scene: SceneData, row: int, first: Hit, direction: wp.vec3, u: float) -> PhotonHit:
    """The surface that first reflects a photon of a light that some meshes do not shadow and that excludes others.

    A mesh that does not shadow the light still receives it if it is linked: with probability 1/2 the photon is
    reflected there, and its flux is doubled in both cases.
    """
    return _first_reflection(scene.address, row, first, direction, u)


@wp.func(inline=False)
def _first_reflection(address: wp.uint64, row: int, first: Hit, direction: wp.vec3, u: float) -> PhotonHit:
    """`first_reflection` as a called function."""
    scene = scene_at(address)[0]
    out = PhotonHit()
    out.weight = 1.0
    out.hit = first
    modifiers = scene.light_tables[0].modifiers.rows[row]
    u_remapped = u
    for _ in range(CROSSINGS):
        if out.hit.triangle < 0:
            return out
        mesh = scene.triangle_mesh[out.hit.triangle]
        is_linked = not in_link_set(scene.light_tables[0].modifiers, modifiers.unlit, mesh)
        if not in_link_set(scene.light_tables[0].modifiers, modifiers.shadowless, mesh):
            if not is_linked:
                out.weight = 0.0
            return out
        if is_linked:
            out.weight = 2.0 * out.weight
            u_remapped = 2.0 * u_remapped
            if u_remapped < 1.0:
                return out
            u_remapped -= 1.0
        out.hit = closest(scene, continue_behind(scene, out.hit, direction), direction, 3.0e38)
    out.weight = 0.0
    return out
