"""Photons: how they leave a light, and where they land that not every mesh stops."""

import warp as wp

from warp_ir.device_scene import SceneData
from warp_ir.light_modifiers import in_link_set, shaping_factor
from warp_ir.lights.sample_area import EmitterSample
from warp_ir.lights.visibility import CROSSINGS, continue_behind
from warp_ir.sampling.distribution2d import cell_direction, sample_cell
from warp_ir.sampling.square_to import from_local, square_to_cone, square_to_cosine_hemisphere, square_to_disk
from warp_ir.surface import Hit, closest, scene_at

wp.set_module_options({"enable_backward": False})


@wp.struct
class Photon:
    """A photon that leaves a light."""

    origin: wp.vec3
    direction: wp.vec3
    flux: wp.vec3  # [W]


@wp.struct
class PhotonTarget:
    """Where photons from far away go: more of them pass close by a focus, if there is one.

    Seen from the light, rings lie around the focus; each is half as wide as the next and has a probability of its own.
    """

    rings: int  # 0: photons go everywhere alike
    focus: wp.array[wp.vec4]  # [lights], x, y, z, and the outer radius of the last ring; that covers the scene
    cdf: wp.array[wp.float32]  # [lights, rings + 1], of the rings of every light, from 0 to 1


@wp.func
def emit_photon(scene: SceneData, point: EmitterSample, photon_target: PhotonTarget, u: wp.vec2, v: wp.vec2) -> Photon:
    """A photon from a point on an emitter: `u` gives its direction, `v` the place of one from far away."""
    out = Photon()
    xyz = wp.vec3(point.position[0], point.position[1], point.position[2])
    if point.position[3] == 0.0:
        # Parallel light enters through a disk that covers the scene, seen from there.
        out.direction = -xyz
        if photon_target.rings == 0:
            d = square_to_disk(v)
            out.origin = scene.centre + scene.radius * (from_local(wp.vec3(d[0], d[1], 0.0), xyz) + xyz)
            out.flux = point.intensity * (wp.pi * scene.radius * scene.radius)
        else:
            entry = _sample_target(photon_target, scene.emitter_item[point.emitter], v)
            focus = photon_target.focus[scene.emitter_item[point.emitter]]
            away = from_local(wp.vec3(entry[0], entry[1], 0.0), xyz)
            out.origin = wp.vec3(focus[0], focus[1], focus[2]) + away
            out.origin += (scene.radius - wp.dot(out.origin - scene.centre, xyz)) * xyz
            out.flux = point.intensity * entry[2]
    elif point.normal[3] == 1.0:
        out.origin = xyz
        out.direction = square_to_cone(u, 2.0, wp.vec3(0.0, 0.0, 1.0))
        out.flux = point.intensity * (4.0 * wp.pi)
    else:
        out.origin = xyz
        out.direction = square_to_cosine_hemisphere(u, wp.vec3(point.normal[0], point.normal[1], point.normal[2]))
        out.flux = point.intensity * wp.pi
    if point.modifiers >= 0:
        out = _shape_photon(scene.address, point, u, out)
    return out


@wp.func
def _sample_target(photon_target: PhotonTarget, light: int, v: wp.vec2) -> wp.vec3:
    """Where a photon passes the focus, in the plane across its way, and the area over the probability of the ring."""
    begin = light * (photon_target.rings + 1)
    ring = int(0)
    while ring < photon_target.rings - 1 and photon_target.cdf[begin + ring + 1] <= v[0]:
        ring += 1
    probability = photon_target.cdf[begin + ring + 1] - photon_target.cdf[begin + ring]
    outer = photon_target.focus[light][3] / float(1 << (photon_target.rings - 1 - ring))
    inner = wp.where(ring == 0, 0.0, 0.5 * outer)
    rest = (v[0] - photon_target.cdf[begin + ring]) / probability
    r = wp.sqrt(inner * inner + rest * (outer * outer - inner * inner))
    phi = 2.0 * wp.pi * v[1]
    area = wp.pi * (outer * outer - inner * inner)
    return wp.vec3(r * wp.cos(phi), r * wp.sin(phi), area / probability)


@wp.func(inline=False)
def _shape_photon(address: wp.uint64, point: EmitterSample, u: wp.vec2, unshaped: Photon) -> Photon:
    """The photon of a light with a control: in a direction that suits the shaping, or with the factor as a weight."""
    scene = scene_at(address)[0]
    modifiers = scene.light_tables[0].modifiers.rows[point.modifiers]
    photon = unshaped
    if modifiers.photons >= 0:
        local = cell_direction(
            scene.light_tables[0].distributions,
            modifiers.photons,
            sample_cell(scene.light_tables[0].distributions, modifiers.photons, u),
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
    """Where a photon is reflected first."""

    hit: Hit
    weight: float  # of its flux; 0: it is lost


@wp.func
def first_reflection(scene: SceneData, row: int, first: Hit, direction: wp.vec3, u: float) -> PhotonHit:
    """The surface that reflects a photon, whose light may pass through some meshes and not light others.

    Meshes it passes through are lit all the same, if they are linked: a coin decides, and doubles the flux.
    """
    return _first_reflection(scene.address, row, first, direction, u)


@wp.func(inline=False)
def _first_reflection(address: wp.uint64, row: int, first: Hit, direction: wp.vec3, u: float) -> PhotonHit:
    scene = scene_at(address)[0]
    out = PhotonHit()
    out.weight = 1.0
    out.hit = first
    modifiers = scene.light_tables[0].modifiers.rows[row]
    coin = u
    for _ in range(CROSSINGS):
        if out.hit.triangle < 0:
            return out
        mesh = scene.triangle_mesh[out.hit.triangle]
        lit = not in_link_set(scene.light_tables[0].modifiers, modifiers.unlit, mesh)
        if not in_link_set(scene.light_tables[0].modifiers, modifiers.shadowless, mesh):
            if not lit:
                out.weight = 0.0
            return out
        if lit:
            out.weight = 2.0 * out.weight
            coin = 2.0 * coin
            if coin < 1.0:
                return out
            coin -= 1.0
        out.hit = closest(scene, continue_behind(scene, out.hit, direction), direction, 3.0e38)
    out.weight = 0.0
    return out
