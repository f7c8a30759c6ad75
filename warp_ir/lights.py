"""Points on emitters, and emitters along rays. Emissive triangles and the lights of UsdLux are one list.

A point on an emitter is homogeneous, position (x, y, z, w): w = 1 for a place, w = 0 for the direction
towards a distant light. Its normal (x, y, z, a) gives the emitter's cosine as max(0, a + n·ω): a = 0 for a
surface, and n = 0, a = 1 for what shines the same everywhere. So nobody who gathers light needs a second case; but
where a light has a `LightControl`, `arriving` tells how much of it gets to a point, and takes the place of `visible`.
"""

import warp as wp

from warp_ir import sampling
from warp_ir.device_scene import _TRIANGLE_EMITTER, SceneData
from warp_ir.grid import (
    cell_direction,
    cell_place,
    direction_density,
    place_density,
    sample_cell,
    value_along,
    value_at_place,
)
from warp_ir.light_control import linked, shaping_factor
from warp_ir.scene import LightKind
from warp_ir.surface import Hit, closest, emitted, offset, presence, scene_at, visible

wp.set_module_options({"enable_backward": False})

_RECT = wp.constant(int(LightKind.RECT))
_DISK = wp.constant(int(LightKind.DISK))
_SPHERE = wp.constant(int(LightKind.SPHERE))
_CYLINDER = wp.constant(int(LightKind.CYLINDER))
_POINT = wp.constant(int(LightKind.POINT))
_DISTANT = wp.constant(int(LightKind.DISTANT))
_DOME = wp.constant(int(LightKind.DOME))
_TRIANGLE = wp.constant(_TRIANGLE_EMITTER)
_CROSSINGS = wp.constant(64)
"""Most surfaces without a shadow that light is followed through."""


@wp.struct
class LightPoint:
    """A random point on a random emitter."""

    position: wp.vec4
    normal: wp.vec4
    intensity: wp.vec3  # radiance / density: W/sr for a place, W/m² for a direction
    density: float  # per area for a place, per solid angle for a direction; 0: no ray finds it, only `sample_light`
    emitter: int
    control: int  # row of its `LightControl`; -1: it has none


@wp.struct
class Bound:
    """A bound on G, higher for VPLs on lights where they lie closer together than they do on average."""

    least: float
    per_density: float  # times the density of the samples on a light, per area


@wp.func
def bound_on(bound: Bound, density: float) -> float:
    """The bound for VPLs on a light whose points are sampled with some density per area."""
    return wp.max(bound.least, bound.per_density * density)


@wp.func
def cut_share(bound: float, g: float) -> float:
    """What the bound takes of a geometry term: (1 - bound/G)⁺."""
    if g <= bound:
        return 0.0
    return 1.0 - bound / g


@wp.struct
class Emission:
    """A photon that leaves a light."""

    origin: wp.vec3
    direction: wp.vec3
    flux: wp.vec3  # [W]


@wp.func
def sample_light(scene: SceneData, u_pick: float, u: wp.vec2) -> LightPoint:
    """A point on the scene's emitters: which one, in proportion to power; where on it, uniformly."""
    return _sample_light(scene.address, u_pick, u)


@wp.func(inline=False)
def _sample_light(address: wp.uint64, u_pick: float, u: wp.vec2) -> LightPoint:
    scene = scene_at(address)[0]
    low = int(0)
    high = scene.emitter_count
    while high - low > 1:
        middle = (low + high) // 2
        if scene.emitter_cdf[middle] <= u_pick:
            low = middle
        else:
            high = middle
    probability = scene.emitter_cdf[low + 1] - scene.emitter_cdf[low]
    rest = (u_pick - scene.emitter_cdf[low]) / probability  # uniform again, for what is left to choose
    item = scene.emitter_item[low]
    out = LightPoint()
    if scene.emitter_kind[low] == _TRIANGLE:
        out = _sample_triangle(scene, item, probability, rest, u)
    elif scene.emitter_kind[low] <= _CYLINDER:
        out = _sample_shape(scene, item, probability, u)
    else:
        out = _sample_point_or_direction(scene, item, probability, u)
    out.emitter = low
    return out


@wp.func
def _sample_triangle(scene: SceneData, triangle: int, probability: float, rest: float, u: wp.vec2) -> LightPoint:
    a = scene.points[scene.indices[3 * triangle]]
    b = scene.points[scene.indices[3 * triangle + 1]]
    c = scene.points[scene.indices[3 * triangle + 2]]
    cross = wp.cross(b - a, c - a)
    n = wp.normalize(cross)
    sides = float(1.0)
    if scene.emits_back[triangle] == 1:
        sides = 2.0
        n = wp.where(rest < 0.5, n, -n)
    root = wp.sqrt(u[0])
    at_a = 1.0 - root
    at_b = root * (1.0 - u[1])
    p = offset(a, b, c, at_a, at_b, n)
    area = 0.5 * wp.length(cross)
    out = LightPoint()
    out.density = probability / (area * sides)
    out.position = wp.vec4(p[0], p[1], p[2], 1.0)
    out.normal = wp.vec4(n[0], n[1], n[2], 0.0)
    radiance = emitted(scene, triangle, at_a, at_b, area, scene.footprint)
    if scene.open_count > 0:
        radiance = radiance * presence(scene, triangle, at_a, at_b)
    out.intensity = radiance / out.density
    out.control = -1
    return out


@wp.func
def _texture_of(scene: SceneData, light: int) -> int:
    """The grid that multiplies a light's radiance, or -1."""
    if scene.textured_count == 0:
        return -1
    return scene.light_tables[0].texture[light]


@wp.func
def control_of(scene: SceneData, light: int) -> int:
    """The row of a light's control, or -1; light -1 is a surface."""
    if scene.control_count == 0 or light < 0:
        return -1
    return scene.light_tables[0].controls.of_light[light]


@wp.func
def _area_scale(scene: SceneData, light: int, n: wp.vec3) -> float:
    """Area of a shape's surface over that of the unit shape, where the unit shape's normal is `n` (Nanson)."""
    return wp.abs(wp.determinant(scene.light_axes[light])) * wp.length(wp.transpose(scene.light_inverse[light]) * n)


@wp.func
def _unit_area(kind: int) -> float:
    if kind == _RECT:
        return 1.0
    if kind == _DISK:
        return wp.pi
    if kind == _SPHERE:
        return 4.0 * wp.pi
    return 2.0 * wp.pi


@wp.func
def _sample_shape(scene: SceneData, light: int, probability: float, u: wp.vec2) -> LightPoint:
    kind = scene.light_kind[light]
    n = wp.vec3(0.0, 0.0, 1.0)
    q = wp.vec3(u[0] - 0.5, u[1] - 0.5, 0.0)
    radiance = scene.light_radiance[light]
    relative = float(1.0)
    texture = _texture_of(scene, light)
    if texture >= 0:
        cell = sample_cell(scene.light_tables[0].grids, texture, u)
        place = cell_place(scene.light_tables[0].grids, texture, cell)
        grid = scene.light_tables[0].grids.grids[texture]
        relative = cell.probability * float(grid.rows) * float(grid.columns)
        radiance = wp.cw_mul(radiance, value_at_place(scene.light_tables[0].grids, texture, place))
        q = wp.vec3(0.5 - place[0], 0.5 - place[1], 0.0)
    if kind == _DISK:
        d = sampling.to_disk(u)
        q = wp.vec3(d[0], d[1], 0.0)
    elif kind == _SPHERE:
        n = sampling.to_cone(u, 2.0, wp.vec3(0.0, 0.0, 1.0))
        q = n
    elif kind == _CYLINDER:
        phi = 2.0 * wp.pi * u[1]
        n = wp.vec3(0.0, wp.cos(phi), wp.sin(phi))
        q = wp.vec3(u[0] - 0.5, n[1], n[2])
    p = scene.light_origin[light] + scene.light_axes[light] * q
    world_n = wp.normalize(wp.transpose(scene.light_inverse[light]) * n)
    out = LightPoint()
    out.density = probability * relative / (_unit_area(kind) * _area_scale(scene, light, n))
    p += world_n * (wp.max(wp.abs(p)) * 9.5367431640625e-07)  # 8 ulp: a light often lies in the ceiling's plane
    out.position = wp.vec4(p[0], p[1], p[2], 1.0)
    out.normal = wp.vec4(world_n[0], world_n[1], world_n[2], 0.0)
    out.intensity = radiance / out.density
    out.control = control_of(scene, light)
    if _only_sampled(scene, out.control):
        out.density = 0.0
    return out


@wp.func
def _axis(scene: SceneData, light: int) -> wp.vec3:
    """The unit direction towards a distant light."""
    m = scene.light_axes[light]
    return wp.vec3(m[0, 2], m[1, 2], m[2, 2])


@wp.func
def _to_dome(scene: SceneData, light: int, direction: wp.vec3) -> wp.vec3:
    """A direction of the world where a dome's texture has its pole along +z and begins at +x."""
    d = wp.transpose(scene.light_axes[light]) * direction
    return wp.vec3(-d[2], d[0], d[1])


@wp.func
def _from_dome(scene: SceneData, light: int, d: wp.vec3) -> wp.vec3:
    return scene.light_axes[light] * wp.vec3(d[1], d[2], -d[0])


@wp.func
def _only_sampled(scene: SceneData, control: int) -> bool:
    """Whether a light sees other surfaces than rays do, so that only `sample_light` may look for it."""
    if control < 0:
        return False
    return (
        scene.light_tables[0].controls.rows[control].shadows == 0
        or scene.light_tables[0].controls.rows[control].shadowless >= 0
    )


@wp.func
def _shaping(scene: SceneData, control: int, direction: wp.vec3) -> wp.vec3:
    """Factor of the radiance that a light emits along a unit direction."""
    if control < 0:
        return wp.vec3(1.0)
    return shaping_factor(scene.light_tables[0].controls.rows[control], scene.light_tables[0].grids, direction)


@wp.func
def _may_find(scene: SceneData, control: int, mesh: int, bsdf_density: float) -> bool:
    """Whether a ray from a mesh (-1: the eye) counts the light it finds, `bsdf_density` being as for `lights_found`."""
    if control < 0:
        return True
    if linked(scene.light_tables[0].controls, scene.light_tables[0].controls.rows[control].unlit, mesh):
        return False
    return bsdf_density < 0.0 or not _only_sampled(scene, control)


@wp.func
def arriving(scene: SceneData, control: int, position: wp.vec3, mesh: int, seen: bool, target: wp.vec4) -> wp.vec3:
    """How much of the light from a point on a light arrives at a point of a mesh.

    Args:
        scene: The scene.
        control: Row of the light's `LightControl`; -1: only visibility counts.
        position: The point, off its surface.
        mesh: The mesh it belongs to.
        seen: Whether the camera sees the point: only there may a light do without shadows.
        target: Homogeneous; off its surface.
    """
    if control >= 0:
        return _arriving_controlled(scene.address, control, position, mesh, seen, target)
    if visible(scene, position, target):
        return wp.vec3(1.0)
    return wp.vec3(0.0)


@wp.func(inline=False)
def _arriving_controlled(
    address: wp.uint64, row: int, position: wp.vec3, mesh: int, seen: bool, target: wp.vec4
) -> wp.vec3:
    scene = scene_at(address)[0]
    control = scene.light_tables[0].controls.rows[row]
    to_light = wp.vec3(target[0], target[1], target[2]) - position * target[3]
    factor = shaping_factor(control, scene.light_tables[0].grids, -wp.normalize(to_light))
    if wp.max(factor) <= 0.0 or linked(scene.light_tables[0].controls, control.unlit, mesh):
        return wp.vec3(0.0)
    if seen and control.shadows == 0:
        return factor
    if control.shadowless < 0:
        if visible(scene, position, target):
            return factor
        return wp.vec3(0.0)
    if _visible_past(scene, control.shadowless, position, target):
        return factor
    return wp.vec3(0.0)


@wp.func
def _visible_past(scene: SceneData, shadowless: int, position: wp.vec3, target: wp.vec4) -> bool:
    """`visible` as if the meshes of a link set were not there."""
    origin = position
    xyz = wp.vec3(target[0], target[1], target[2])
    for _ in range(_CROSSINGS):
        direction = xyz - origin * target[3]
        hit = closest(scene, origin, direction, wp.where(target[3] == 0.0, 3.0e38, 0.999999))
        if hit.triangle < 0:
            return True
        if not linked(scene.light_tables[0].controls, shadowless, scene.triangle_mesh[hit.triangle]):
            return False
        origin = _behind(scene, hit, direction)
    return False


@wp.func
def _behind(scene: SceneData, hit: Hit, direction: wp.vec3) -> wp.vec3:
    """Where a ray goes on that passes through the surface it has hit."""
    a = scene.points[scene.indices[3 * hit.triangle]]
    b = scene.points[scene.indices[3 * hit.triangle + 1]]
    c = scene.points[scene.indices[3 * hit.triangle + 2]]
    return offset(a, b, c, hit.u, hit.v, wp.normalize(direction) - hit.normal)


@wp.struct
class Landing:
    """Where a photon is reflected first."""

    hit: Hit
    weight: float  # of its flux; 0: it is lost


@wp.func
def land(scene: SceneData, row: int, first: Hit, direction: wp.vec3, u: float) -> Landing:
    """The surface that reflects a photon, whose light may pass through some meshes and not light others.

    Meshes it passes through are lit all the same, if they are linked: a coin decides, and doubles the flux.
    """
    return _land(scene.address, row, first, direction, u)


@wp.func(inline=False)
def _land(address: wp.uint64, row: int, first: Hit, direction: wp.vec3, u: float) -> Landing:
    scene = scene_at(address)[0]
    out = Landing()
    out.weight = 1.0
    out.hit = first
    control = scene.light_tables[0].controls.rows[row]
    coin = u
    for _ in range(_CROSSINGS):
        if out.hit.triangle < 0:
            return out
        mesh = scene.triangle_mesh[out.hit.triangle]
        lit = not linked(scene.light_tables[0].controls, control.unlit, mesh)
        if not linked(scene.light_tables[0].controls, control.shadowless, mesh):
            if not lit:
                out.weight = 0.0
            return out
        if lit:
            out.weight = 2.0 * out.weight
            coin = 2.0 * coin
            if coin < 1.0:
                return out
            coin -= 1.0
        out.hit = closest(scene, _behind(scene, out.hit, direction), direction, 3.0e38)
    out.weight = 0.0
    return out


@wp.func
def _sample_point_or_direction(scene: SceneData, light: int, probability: float, u: wp.vec2) -> LightPoint:
    kind = scene.light_kind[light]
    out = LightPoint()
    out.control = control_of(scene, light)
    found = float(1.0)
    if _only_sampled(scene, out.control):
        found = 0.0
    out.normal = wp.vec4(0.0, 0.0, 0.0, 1.0)
    if kind == _POINT:
        p = scene.light_origin[light]
        out.position = wp.vec4(p[0], p[1], p[2], 1.0)
        out.intensity = scene.light_radiance[light] / probability
        return out
    texture = _texture_of(scene, light)
    if texture >= 0:
        cell = sample_cell(scene.light_tables[0].grids, texture, u)
        local = cell_direction(scene.light_tables[0].grids, texture, cell)
        xyz = wp.vec3(local[0], local[1], local[2])
        d = _from_dome(scene, light, xyz)
        out.position = wp.vec4(d[0], d[1], d[2], 0.0)
        out.density = probability * local[3]
        radiance = wp.cw_mul(scene.light_radiance[light], value_along(scene.light_tables[0].grids, texture, xyz))
        out.intensity = radiance / out.density
        out.density *= found
        return out
    cone = float(2.0)
    if kind == _DISTANT:
        cone = scene.light_angle[light]
    d = sampling.to_cone(u, cone, _axis(scene, light))
    out.position = wp.vec4(d[0], d[1], d[2], 0.0)
    if cone > 0.0:
        out.density = probability / (2.0 * wp.pi * cone)
        out.intensity = scene.light_radiance[light] / out.density
        out.density *= found
    else:
        out.intensity = scene.light_radiance[light] / probability
    return out


@wp.func
def emit(scene: SceneData, point: LightPoint, u: wp.vec2, v: wp.vec2) -> Emission:
    """A photon from a point on an emitter: `u` gives its direction, `v` the place of one from far away."""
    out = Emission()
    xyz = wp.vec3(point.position[0], point.position[1], point.position[2])
    if point.position[3] == 0.0:
        # Parallel light enters through a disk that covers the scene, seen from there.
        d = sampling.to_disk(v)
        out.origin = scene.radius * (sampling.to_frame(wp.vec3(d[0], d[1], 0.0), xyz) + xyz)
        out.direction = -xyz
        out.flux = point.intensity * (wp.pi * scene.radius * scene.radius)
    elif point.normal[3] == 1.0:
        out.origin = xyz
        out.direction = sampling.to_cone(u, 2.0, wp.vec3(0.0, 0.0, 1.0))
        out.flux = point.intensity * (4.0 * wp.pi)
    else:
        out.origin = xyz
        out.direction = sampling.to_cosine_hemisphere(u, wp.vec3(point.normal[0], point.normal[1], point.normal[2]))
        out.flux = point.intensity * wp.pi
    if point.control >= 0:
        out = _shaped(scene.address, point, u, out)
    return out


@wp.func(inline=False)
def _shaped(address: wp.uint64, point: LightPoint, u: wp.vec2, unshaped: Emission) -> Emission:
    """The photon of a light with a control: in a direction that suits the shaping, or with the factor as a weight."""
    scene = scene_at(address)[0]
    control = scene.light_tables[0].controls.rows[point.control]
    photon = unshaped
    if control.photons >= 0:
        local = cell_direction(
            scene.light_tables[0].grids, control.photons, sample_cell(scene.light_tables[0].grids, control.photons, u)
        )
        photon.direction = wp.transpose(control.frame) * wp.vec3(local[0], local[1], local[2])
        n = wp.vec3(point.normal[0], point.normal[1], point.normal[2])
        cosine = wp.max(0.0, point.normal[3] + wp.dot(n, photon.direction))
        photon.flux = point.intensity * (cosine / local[3])
    photon.flux = wp.cw_mul(photon.flux, shaping_factor(control, scene.light_tables[0].grids, photon.direction))
    return photon


@wp.func
def _hit_shape(scene: SceneData, light: int, origin: wp.vec3, direction: wp.vec3) -> wp.vec4:
    """Where a ray meets the emitting side of a light: the unit shape's normal there, and t (-1: it does not)."""
    kind = scene.light_kind[light]
    o = scene.light_inverse[light] * (origin - scene.light_origin[light])
    d = scene.light_inverse[light] * direction
    miss = wp.vec4(0.0, 0.0, 0.0, -1.0)
    if kind == _RECT or kind == _DISK:
        if d[2] >= 0.0 or o[2] <= 0.0:
            return miss
        t = -o[2] / d[2]
        x = o[0] + t * d[0]
        y = o[1] + t * d[1]
        if kind == _RECT and (wp.abs(x) > 0.5 or wp.abs(y) > 0.5):
            return miss
        if kind == _DISK and x * x + y * y > 1.0:
            return miss
        return wp.vec4(0.0, 0.0, 1.0, t)
    flat = wp.where(kind == _CYLINDER, 0.0, 1.0)
    o2 = wp.vec3(o[0] * flat, o[1], o[2])
    d2 = wp.vec3(d[0] * flat, d[1], d[2])
    a = wp.dot(d2, d2)
    b = wp.dot(o2, d2)
    if b >= 0.0 or a == 0.0:
        return miss
    # The squared distance of the line from the axis, computed so that a far origin does not cancel it.
    nearest = o2 - d2 * (b / a)
    h = 1.0 - wp.dot(nearest, nearest)
    if h <= 0.0:
        return miss
    t = -b / a - wp.sqrt(h / a)  # the first of the two: the other is seen from inside
    if t <= 0.0 or (kind == _CYLINDER and wp.abs(o[0] + t * d[0]) > 0.5):
        return miss
    n = wp.normalize(o2 + t * d2)
    return wp.vec4(n[0], n[1], n[2], t)


@wp.func
def _face_radiance(scene: SceneData, light: int, origin: wp.vec3, direction: wp.vec3, t: float) -> wp.vec3:
    """Radiance of a light with an area where a ray meets it, before shaping."""
    texture = _texture_of(scene, light)
    if texture < 0:
        return scene.light_radiance[light]
    place = _place(scene, light, origin, direction, t)
    return wp.cw_mul(scene.light_radiance[light], value_at_place(scene.light_tables[0].grids, texture, place))


@wp.func
def _place(scene: SceneData, light: int, origin: wp.vec3, direction: wp.vec3, t: float) -> wp.vec2:
    """Place in [0, 1]² on the texture of a rectangle that a ray meets at t: from +X to -X, from +Y to -Y."""
    q = scene.light_inverse[light] * (origin + t * direction - scene.light_origin[light])
    return wp.vec2(0.5 - q[0], 0.5 - q[1])


@wp.func
def _weight(bsdf_density: float, light_density: float) -> float:
    """The balance heuristic (Veach 1997); 1 if the ray was no sample of a BSDF."""
    if bsdf_density < 0.0:
        return 1.0
    return bsdf_density / (bsdf_density + light_density)


@wp.func
def _probability(scene: SceneData, emitter: int) -> float:
    if emitter < 0:
        return 0.0
    return scene.emitter_cdf[emitter + 1] - scene.emitter_cdf[emitter]


@wp.func
def lights_found(
    scene: SceneData, origin: wp.vec3, direction: wp.vec3, t_max: float, escapes: bool, bsdf_density: float, mesh: int
) -> wp.vec3:
    """Radiance of the analytic lights that a ray meets before t_max; of those at infinity too if it escapes.

    Lights block nothing, so all along the ray count that are linked to the mesh it leaves (-1: the eye).
    `bsdf_density` is the density per solid angle with which the direction was sampled, for weighting against
    `sample_light`; negative: no weighting.
    """
    if scene.shape_count > 0 or escapes:
        return _lights_found(scene.address, origin, direction, t_max, escapes, bsdf_density, mesh)
    return wp.vec3(0.0)


@wp.func(inline=False)
def _lights_found(
    address: wp.uint64, origin: wp.vec3, direction: wp.vec3, t_max: float, escapes: bool, bsdf_density: float, mesh: int
) -> wp.vec3:
    scene = scene_at(address)[0]
    total = wp.vec3(0.0)
    if scene.shape_count > 0:
        query = wp.bvh_query_ray(scene.shape_bvh, origin, direction)
        shape = int(0)
        while wp.bvh_query_next(query, shape, t_max):
            light = scene.shape_light[shape]
            hit = _hit_shape(scene, light, origin, direction)
            if hit[3] > 0.0 and hit[3] < t_max and _may_find(scene, control_of(scene, light), mesh, bsdf_density):
                n = wp.vec3(hit[0], hit[1], hit[2])
                world_n = wp.normalize(wp.transpose(scene.light_inverse[light]) * n)
                cosine = -wp.dot(world_n, direction)
                area = _unit_area(scene.light_kind[light]) * _area_scale(scene, light, n)
                density = _probability(scene, scene.light_emitter[light]) * hit[3] * hit[3] / (area * cosine)
                if _texture_of(scene, light) >= 0:
                    place = _place(scene, light, origin, direction, hit[3])
                    density *= place_density(scene.light_tables[0].grids, _texture_of(scene, light), place)
                if cosine > 0.0:
                    radiance = _face_radiance(scene, light, origin, direction, hit[3])
                    radiance = wp.cw_mul(radiance, _shaping(scene, control_of(scene, light), -direction))
                    total += radiance * _weight(bsdf_density, density)
    if escapes:
        for light in range(scene.light_count):
            if scene.light_kind[light] >= _DISTANT and _may_find(scene, control_of(scene, light), mesh, bsdf_density):
                total += _from_infinity(scene, light, direction, bsdf_density)
    return total


@wp.func
def _from_infinity(scene: SceneData, light: int, direction: wp.vec3, bsdf_density: float) -> wp.vec3:
    """Radiance of a distant light or a dome along a unit direction, weighted."""
    cone = wp.where(scene.light_kind[light] == _DOME, 2.0, scene.light_angle[light])
    apart = direction - _axis(scene, light)
    if scene.light_kind[light] == _DISTANT and 0.5 * wp.dot(apart, apart) >= cone:
        return wp.vec3(0.0)
    radiance = wp.cw_mul(scene.light_radiance[light], _shaping(scene, control_of(scene, light), -direction))
    density = 1.0 / (2.0 * wp.pi * cone)
    texture = _texture_of(scene, light)
    if texture >= 0:
        local = _to_dome(scene, light, direction)
        radiance = wp.cw_mul(radiance, value_along(scene.light_tables[0].grids, texture, local))
        density = direction_density(scene.light_tables[0].grids, texture, local)
    return radiance * _weight(bsdf_density, _probability(scene, scene.light_emitter[light]) * density)


@wp.func
def lights_beyond(
    scene: SceneData,
    origin: wp.vec3,
    direction: wp.vec3,
    near: float,
    cosine: float,
    bound: Bound,
    reach: float,
    mesh: int,
    seen: bool,
) -> wp.vec3:
    """Radiance of the lights that a unit direction meets, times the share (1 - bound/G)⁺ that the bound cuts.

    Args:
        scene: The scene.
        origin: A point of a mesh, off its surface.
        direction: Unit.
        near: Distance to the first surface, or `reach`.
        cosine: Of the direction at the origin.
        bound: On G.
        reach: Distance beyond which G cannot exceed the bound: lights that surfaces do not shadow count up to there.
        mesh: The mesh at the origin.
        seen: Whether the camera sees the origin.
    """
    if scene.shape_count > 0 or scene.only_sampled_count > 0:
        return _lights_beyond(scene.address, origin, direction, near, cosine, bound, reach, mesh, seen)
    return wp.vec3(0.0)


@wp.func(inline=False)
def _lights_beyond(
    address: wp.uint64,
    origin: wp.vec3,
    direction: wp.vec3,
    near: float,
    cosine: float,
    bound: Bound,
    reach: float,
    mesh: int,
    seen: bool,
) -> wp.vec3:
    scene = scene_at(address)[0]
    total = wp.vec3(0.0)
    if scene.shape_count > 0:
        query = wp.bvh_query_ray(scene.shape_bvh, origin, direction)
        shape = int(0)
        while wp.bvh_query_next(query, shape, near):
            light = scene.shape_light[shape]
            hit = _hit_shape(scene, light, origin, direction)
            if hit[3] > 0.0 and hit[3] < near and _may_find(scene, control_of(scene, light), mesh, 0.0):
                share = _cut(scene, light, hit, direction, cosine, bound)
                if share > 0.0:
                    radiance = _face_radiance(scene, light, origin, direction, hit[3])
                    total += wp.cw_mul(radiance, _shaping(scene, control_of(scene, light), -direction)) * share
    # One after the other and not in the query above: on CUDA two traversals at a time would share a stack.
    for k in range(scene.only_sampled_count):
        light = scene.light_tables[0].controls.sampled[k]
        hit = _hit_shape(scene, light, origin, direction)
        if hit[3] > 0.0 and hit[3] < reach:
            share = _cut(scene, light, hit, direction, cosine, bound)
            if share > 0.0:
                p = origin + direction * (hit[3] * 0.99999)
                arrives = arriving(scene, control_of(scene, light), origin, mesh, seen, wp.vec4(p[0], p[1], p[2], 1.0))
                total += wp.cw_mul(_face_radiance(scene, light, origin, direction, hit[3]), arrives) * share
    return total


@wp.func
def _cut(scene: SceneData, light: int, hit: wp.vec4, direction: wp.vec3, cosine: float, bound: Bound) -> float:
    """The share (1 - bound/G)⁺ for the place where a ray meets a light."""
    world_n = wp.normalize(wp.transpose(scene.light_inverse[light]) * wp.vec3(hit[0], hit[1], hit[2]))
    g = -wp.dot(world_n, direction) * cosine / (hit[3] * hit[3])
    return cut_share(bound_on(bound, scene.emitter_density[scene.light_emitter[light]]), g)


@wp.func
def surface_weight(scene: SceneData, hit: Hit, direction: wp.vec3, bsdf_density: float) -> float:
    """The weight of the emission of an emissive surface that a unit direction, sampled from a BSDF, has hit."""
    if bsdf_density < 0.0:
        return 1.0
    a = scene.points[scene.indices[3 * hit.triangle]]
    b = scene.points[scene.indices[3 * hit.triangle + 1]]
    c = scene.points[scene.indices[3 * hit.triangle + 2]]
    area = 0.5 * wp.length(wp.cross(b - a, c - a)) * float(1 + scene.emits_back[hit.triangle])
    cosine = wp.max(-wp.dot(hit.normal, direction), 1.0e-20)
    probability = _probability(scene, scene.triangle_emitter[hit.triangle])
    return _weight(bsdf_density, probability * hit.t * hit.t / (area * cosine))
