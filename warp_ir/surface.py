"""Rays against surfaces, and the only epsilon of the whole renderer.

Intersection points come from barycentric coordinates, which keeps their error within a few ulp of the
triangle's own coordinates however far the ray has come (Wächter and Binder 2019). A ray therefore starts
8 ulp off the surface, on the side it leaves from, and as far from the triangle's edges, behind which the next wall
may stand: farther than the error, nearer than any detail a float can hold, at any scale. For an instance, the way
of a ray into the prototype's space and that of the hit back add to the error.
"""

import warp as wp

from warp_ir.bvh import RayHit, intersect, intersect_instances
from warp_ir.device_scene import INSTANCE_COLOR, SceneData, SurfaceTextures
from warp_ir.sampling.sobol import hash_combine
from warp_ir.texture import coordinates, lookup, mip_level

wp.set_module_options({"enable_backward": False})

_EIGHT_ULP = wp.constant(8.0 * 2.0**-23)
_MOST_PULL = wp.constant(1.0e-3)  # a needle thinner than its rounding error has no inside
_INFINITY = wp.constant(3.0e38)
_MOST_LAYERS = wp.constant(1024)  # open surfaces that a ray passes before it is given up
_INSTANCE = wp.constant(INSTANCE_COLOR)


@wp.struct
class Hit:
    """Where a ray meets a surface; `triangle` is -1 if it does not."""

    triangle: int
    instance: int  # of which it is part; -1: it is in the world as it stands
    t: float  # in units of the ray's direction
    u: float  # weights of the triangle's first and second corner
    v: float
    position: wp.vec3  # off the surface, on the side of `normal`: where rays may start
    normal: wp.vec3  # unit geometric normal, on the side the ray came from
    front: int  # 1 if that is the side from which the triangle is wound counter-clockwise
    area: float  # of the triangle


@wp.func
def offset(a: wp.vec3, b: wp.vec3, c: wp.vec3, u: float, v: float, direction: wp.vec3) -> wp.vec3:
    """Where rays may start near the point u a + v b + (1 - u - v) c of a triangle.

    It is moved by more than its rounding error away from the triangle's edges, and along `direction`, a sum of unit
    vectors on the side the rays leave from.
    """
    return _start(a, b, c, u, v, direction, _largest(a, b, c) * _EIGHT_ULP)


@wp.func
def _largest(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> float:
    return wp.max(wp.max(wp.max(wp.abs(a)), wp.max(wp.abs(b))), wp.max(wp.abs(c)))


@wp.func
def _start(a: wp.vec3, b: wp.vec3, c: wp.vec3, u: float, v: float, direction: wp.vec3, error: float) -> wp.vec3:
    """A point of a triangle, moved away from its edges and along `direction` by a given error."""
    longest = wp.sqrt(wp.max(wp.max(wp.length_sq(b - a), wp.length_sq(c - b)), wp.length_sq(a - c)))
    # Towards the centroid by `error` at an edge, as the lowest of the triangle's heights measures it.
    pull = wp.min(error * longest / wp.length(wp.cross(b - a, c - a)), _MOST_PULL)
    inner = a * (u + pull * (1.0 - 3.0 * u)) + b * (v + pull * (1.0 - 3.0 * v))
    return inner + c * (1.0 - u - v + pull * (3.0 * (u + v) - 2.0)) + direction * error


@wp.func
def spawn_ray_origin(scene: SceneData, hit: Hit, direction: wp.vec3) -> wp.vec3:
    """Where rays may start near a hit; `direction` as for `offset`."""
    a = scene.points[scene.indices[3 * hit.triangle]]
    b = scene.points[scene.indices[3 * hit.triangle + 1]]
    c = scene.points[scene.indices[3 * hit.triangle + 2]]
    if hit.instance < 0:
        return offset(a, b, c, hit.u, hit.v, direction)
    axes = scene.instance_axes[hit.instance]
    a = axes * a
    b = axes * b
    c = axes * c
    error = (_largest(a, b, c) + scene.instances[hit.instance].magnitude) * _EIGHT_ULP
    return _start(a, b, c, hit.u, hit.v, direction, error) + scene.instances[hit.instance].centre


@wp.func
def _uv_at(surface_textures: SurfaceTextures, triangle: int, uv_set: int, u: float, v: float) -> wp.vec3:
    """Texture coordinates at a point of a triangle, and the area of the triangle's image in the uv plane."""
    row = surface_textures.triangle_uvs[triangle]
    if row < 0:
        return wp.vec3(0.0)
    row += 3 * uv_set
    a = surface_textures.corner_uvs[row]
    b = surface_textures.corner_uvs[row + 1]
    c = surface_textures.corner_uvs[row + 2]
    uv = u * a + v * b + (1.0 - u - v) * c
    ab = b - a
    ac = c - a
    return wp.vec3(uv[0], uv[1], 0.5 * wp.abs(ab[0] * ac[1] - ab[1] * ac[0]))


@wp.func(inline=False)  # so that scenes without textures do not carry the code about
def _textured(
    surface_textures: wp.array[SurfaceTextures],
    texture: int,
    triangle: int,
    u: float,
    v: float,
    area: float,
    footprint: float,
) -> wp.vec3:
    """A texture at a point of a triangle, as the mean over a patch as wide as `footprint`; 0: as sharp as it is."""
    p = surface_textures[0]
    row = p.textures.rows[texture]
    uv = _uv_at(p, triangle, row.uv_set, u, v)
    level = mip_level(p.textures, row, uv[2] / area, footprint)
    return lookup(p.textures, row, coordinates(row, wp.vec2(uv[0], uv[1])), level)


@wp.func
def alpha_at(scene: SceneData, triangle: int, u: float, v: float) -> float:
    """The share of the rays that meet the surface at a point of a triangle: its opacity, or 0 or 1 with a cutoff."""
    material = scene.triangle_material[triangle]
    opacity = scene.opacity[material]
    if opacity >= 1.0:
        return 1.0
    if scene.opacity_texture[material] >= 0:
        opacity = _textured(scene.surface_textures, scene.opacity_texture[material], triangle, u, v, 1.0, 0.0)[0]
    cutoff = scene.cutoff[material]
    if cutoff > 0.0:
        return wp.where(opacity < cutoff, 0.0, 1.0)
    return opacity


@wp.func
def _passes_through(scene: SceneData, triangle: int, u: float, v: float) -> bool:
    """Whether a ray passes a triangle where it meets it; the same ray always does."""
    there = alpha_at(scene, triangle, u, v)
    if there <= 0.0 or there >= 1.0:
        return there <= 0.0
    bits = hash_combine(hash_combine(wp.uint32(triangle), wp.cast(u, wp.uint32)), wp.cast(v, wp.uint32))
    return (float(bits >> wp.uint32(8)) + 0.5) * (1.0 / 16777216.0) > there


@wp.func_native(f"""
    wp::array_t<{SceneData.native_name}> one;
    one.data = ({SceneData.native_name}*)address;
    one.shape[0] = 1;
    one.strides[0] = sizeof({SceneData.native_name});
    one.ndim = 1;
    return one;
""")
def scene_at(address: wp.uint64) -> wp.array[SceneData]:
    """The record at `SceneData.address`, for functions that are called."""
    ...


@wp.func(inline=False)  # the only traversal in a kernel: many copies of it would compile slowly and run no faster
def _intersect(address: wp.uint64, origin: wp.vec3, direction: wp.vec3, t_max: float, any_hit: bool) -> RayHit:
    """The nearest triangle along a ray, open or not; with `any_hit` some, without its coordinates."""
    scene = scene_at(address)[0]
    found = intersect(scene.bvh, origin, direction, t_max, any_hit)
    if scene.instance_count > 0 and not (any_hit and found.triangle >= 0):
        inside = intersect_instances(scene.two_level, origin, direction, found.t, any_hit)
        if inside.triangle >= 0:
            found = inside
    return found


@wp.func
def _closest_triangle(address: wp.uint64, origin: wp.vec3, direction: wp.vec3, t_max: float) -> Hit:
    """The nearest triangle along a ray, open or not."""
    hit = Hit()
    hit.triangle = -1
    hit.instance = -1
    found = _intersect(address, origin, direction, t_max, False)
    if found.triangle >= 0:
        scene = scene_at(address)[0]
        hit.triangle = found.triangle
        hit.instance = found.instance
        hit.t = found.t
        hit.u = found.u
        hit.v = found.v
        hit.front = found.front
        a = scene.points[scene.indices[3 * hit.triangle]]
        b = scene.points[scene.indices[3 * hit.triangle + 1]]
        c = scene.points[scene.indices[3 * hit.triangle + 2]]
        ab = b - a
        ac = c - a
        n = wp.cross(ab, ac)
        if hit.instance >= 0:
            axes = scene.instance_axes[hit.instance]
            hit.area = 0.5 * wp.length(wp.cross(axes * ab, axes * ac))
            n = wp.transpose(scene.instances[hit.instance].inverse) * n
        else:
            hit.area = 0.5 * wp.length(n)
        n = wp.normalize(n)
        hit.normal = wp.where(hit.front == 1, n, -n)
        # Back the way the ray came as well: it has crossed nothing, not even a wall that stands on this triangle.
        hit.position = spawn_ray_origin(scene, hit, hit.normal - wp.normalize(direction))
    return hit


@wp.func
def _to_target(origin: wp.vec3, target: wp.vec4) -> wp.vec3:
    return wp.vec3(target[0], target[1], target[2]) - origin * target[3]


@wp.func(inline=False)
def _closest_opaque(address: wp.uint64, origin: wp.vec3, target: wp.vec4, t_max: float) -> Hit:
    """The nearest triangle on the way to a homogeneous point that is there where the ray meets it."""
    along = _to_target(origin, target)
    start = origin
    passed = float(0.0)
    for _layer in range(_MOST_LAYERS):
        # Every step off a surface moves the ray a little: it is aimed anew, or not only the last surface would end it.
        way = _to_target(start, target)
        hit = _closest_triangle(address, start, way, wp.where(target[3] == 0.0, t_max - passed, t_max))
        if hit.triangle < 0:
            return hit
        scene = scene_at(address)[0]
        if not _passes_through(scene, hit.triangle, hit.u, hit.v):
            hit.t += passed
            return hit
        start = spawn_ray_origin(scene, hit, wp.normalize(way) - hit.normal)
        passed = wp.dot(start - origin, along) / wp.length_sq(along)
        if passed >= t_max:
            break
    nothing = Hit()
    nothing.triangle = -1
    nothing.instance = -1
    return nothing


@wp.func
def closest(scene: SceneData, origin: wp.vec3, direction: wp.vec3, t_max: float) -> Hit:
    """The nearest surface along a ray."""
    return _closest(scene.address, origin, direction, t_max)


@wp.func(inline=False)
def _closest(address: wp.uint64, origin: wp.vec3, direction: wp.vec3, t_max: float) -> Hit:
    scene = scene_at(address)[0]
    if scene.non_opaque_count > 0:
        target = wp.vec4(direction[0], direction[1], direction[2], 0.0)
        return _closest_opaque(address, origin, target, t_max)
    return _closest_triangle(address, origin, direction, t_max)


@wp.func
def visible(scene: SceneData, origin: wp.vec3, target: wp.vec4) -> bool:
    """Whether nothing lies between a point and a homogeneous one (w = 0: a direction); both off their surfaces."""
    reach = wp.where(target[3] == 0.0, _INFINITY, 0.999999)
    if scene.non_opaque_count > 0:
        return _closest_opaque(scene.address, origin, target, reach).triangle < 0
    return _intersect(scene.address, origin, _to_target(origin, target), reach, True).triangle < 0


@wp.func
def shading_normal(scene: SceneData, hit: Hit) -> wp.vec3:
    """The interpolated normal on the side of the geometric one; the geometric one where there is none."""
    row = scene.triangle_normals[hit.triangle]
    if row < 0:
        return hit.normal
    a = scene.corner_normals[row]
    b = scene.corner_normals[row + 1]
    c = scene.corner_normals[row + 2]
    if hit.instance >= 0:
        to_device = wp.transpose(scene.instances[hit.instance].inverse)
        a = wp.normalize(to_device * a)
        b = wp.normalize(to_device * b)
        c = wp.normalize(to_device * c)
    n = hit.u * a + hit.v * b + (1.0 - hit.u - hit.v) * c
    length = wp.length(n)
    if length < 1.0e-6:
        return hit.normal
    return wp.where(wp.dot(n, hit.normal) < 0.0, -n, n) / length


@wp.func(inline=False)
def _mapped(address: wp.uint64, hit: Hit, normal: wp.vec3, footprint: float) -> wp.vec3:
    """The normal that a material's texture makes of a unit `normal` on the side that was hit."""
    scene = scene_at(address)[0]
    p = scene.surface_textures[0]
    texture = p.normal_texture[scene.triangle_material[hit.triangle]]
    uvs = p.triangle_uvs[hit.triangle]
    if texture < 0 or uvs < 0:
        return normal
    row = p.textures.rows[texture]
    first = uvs + 3 * row.uv_set
    ab_uv = p.corner_uvs[first + 1] - p.corner_uvs[first]
    ac_uv = p.corner_uvs[first + 2] - p.corner_uvs[first]
    ab = scene.points[scene.indices[3 * hit.triangle + 1]] - scene.points[scene.indices[3 * hit.triangle]]
    ac = scene.points[scene.indices[3 * hit.triangle + 2]] - scene.points[scene.indices[3 * hit.triangle]]
    if hit.instance >= 0:
        ab = scene.instance_axes[hit.instance] * ab
        ac = scene.instance_axes[hit.instance] * ac
    # The directions in which u and v grow, but for lengths.
    turn = wp.sign(ab_uv[0] * ac_uv[1] - ab_uv[1] * ac_uv[0])
    along_u = turn * (ab * ac_uv[1] - ac * ab_uv[1])
    along_v = turn * (ac * ab_uv[0] - ab * ac_uv[0])
    smooth = p.triangle_tangents[hit.triangle]
    if smooth >= 0:
        a = p.corner_tangents[smooth]
        b = p.corner_tangents[smooth + 1]
        c = p.corner_tangents[smooth + 2]
        mean = hit.u * a + hit.v * b + (1.0 - hit.u - hit.v) * c
        if hit.instance >= 0:
            mean = scene.instance_axes[hit.instance] * mean
        if wp.length_sq(mean) > 0.0:
            along_u = mean
    out = wp.where(hit.front == 1, normal, -normal)
    x = wp.normalize(along_u - out * wp.dot(out, along_u))
    y = wp.cross(out, x)
    y = wp.where(wp.dot(y, along_v) < 0.0, -y, y)
    uv = _uv_at(p, hit.triangle, row.uv_set, hit.u, hit.v)
    level = mip_level(p.textures, row, uv[2] / hit.area, footprint)
    n = lookup(p.textures, row, coordinates(row, wp.vec2(uv[0], uv[1])), level)
    mapped = n[0] * x + n[1] * y + n[2] * out
    length = wp.length(mapped)
    if uv[2] == 0.0 or wp.length_sq(x) == 0.0 or not (length > 1.0e-6):
        return normal
    return wp.where(hit.front == 1, mapped, -mapped) / length


@wp.func
def mapped_normal(scene: SceneData, hit: Hit, normal: wp.vec3, footprint: float) -> wp.vec3:
    """A shading normal as the material's normal map tilts it, as the mean over a patch as wide as `footprint`.

    The surface seen from behind is the same, so its normals are the opposite of those in front. The tangent plane is
    that of `normal`, its first axis where u grows; what a mirrored image mirrors is the second.
    """
    if scene.normal_map_count > 0:
        return _mapped(scene.address, hit, normal, footprint)
    return normal


@wp.func
def terminator_offset(scene: SceneData, hit: Hit) -> wp.vec3:
    """From a hit to the smooth surface that its triangle's normals stand for; zero where that is not above it.

    The point is projected onto the planes of the corners and their normals, and the results are interpolated (Hanika
    2021, Hacking the Shadow Terminator). Light that falls on the smooth surface at grazing angles passes behind the
    triangle's plane: from the triangle itself it could not be seen.
    """
    if scene.triangle_normals[hit.triangle] < 0:
        return wp.vec3(0.0)
    return _terminator_offset(scene.address, hit)


@wp.func(inline=False)
def _terminator_offset(address: wp.uint64, hit: Hit) -> wp.vec3:
    scene = scene_at(address)[0]
    row = scene.triangle_normals[hit.triangle]
    rise = wp.vec3(0.0)
    for k in range(3):
        weight = wp.where(k == 0, hit.u, wp.where(k == 1, hit.v, 1.0 - hit.u - hit.v))
        n = scene.corner_normals[row + k]
        corner = scene.points[scene.indices[3 * hit.triangle + k]]
        if hit.instance >= 0:
            n = wp.normalize(wp.transpose(scene.instances[hit.instance].inverse) * n)
            corner = scene.instance_axes[hit.instance] * corner + scene.instances[hit.instance].centre
        n = wp.where(wp.dot(n, hit.normal) < 0.0, -n, n)
        below = wp.dot(corner - hit.position, n)
        rise += weight * wp.max(below, 0.0) * n
    # What stands on the surface, or close above it, must stay above the point.
    if wp.length_sq(rise) > 0.0:
        if _intersect(address, hit.position, rise, 2.0, True).triangle >= 0:
            return wp.vec3(0.0)
    return rise


@wp.func
def albedo(scene: SceneData, hit: Hit, footprint: float) -> wp.vec3:
    """Hemispherical reflectance ρ at a hit, as the mean over a patch as wide as `footprint` where it is textured."""
    material = scene.triangle_material[hit.triangle]
    if scene.texture_count > 0:
        if scene.albedo_texture[material] >= 0:
            return _textured(
                scene.surface_textures, scene.albedo_texture[material], hit.triangle, hit.u, hit.v, hit.area, footprint
            )
    row = scene.triangle_colors[hit.triangle]
    if row == _INSTANCE:
        return scene.instance_colors[hit.instance]
    if row < 0:
        return scene.albedo[material]
    return (
        hit.u * scene.corner_colors[row]
        + hit.v * scene.corner_colors[row + 1]
        + (1.0 - hit.u - hit.v) * scene.corner_colors[row + 2]
    )


@wp.func
def emitted(scene: SceneData, triangle: int, u: float, v: float, area: float, footprint: float) -> wp.vec3:
    """Radiance [W sr⁻¹ m⁻²] that the emitting side of a triangle emits at a point, if the surface is there."""
    material = scene.triangle_material[triangle]
    if scene.texture_count > 0:
        if scene.emission_texture[material] >= 0:
            return _textured(scene.surface_textures, scene.emission_texture[material], triangle, u, v, area, footprint)
    return scene.emission[material]


@wp.func
def emission(scene: SceneData, hit: Hit, footprint: float) -> wp.vec3:
    """Radiance [W sr⁻¹ m⁻²] that a surface emits towards the ray that hit it."""
    if hit.front == 1 or scene.emits_back[hit.triangle] == 1:
        return emitted(scene, hit.triangle, hit.u, hit.v, hit.area, footprint)
    return wp.vec3(0.0)


@wp.func
def has_glow(scene: SceneData, triangle: int) -> bool:
    """Whether the camera sees something else of a triangle than the `emission` by which it lights the scene."""
    if scene.camera_emission_count == 0:
        return False
    return scene.surface_textures[0].camera_emission[scene.triangle_material[triangle]][0] >= 0.0


@wp.func
def glow(scene: SceneData, hit: Hit, footprint: float) -> wp.vec3:
    """What it sees then."""
    if hit.front == 0 and scene.emits_back[hit.triangle] == 0:
        return wp.vec3(0.0)
    material = scene.triangle_material[hit.triangle]
    texture = scene.surface_textures[0].camera_emission_texture[material]
    if texture >= 0:
        return _textured(scene.surface_textures, texture, hit.triangle, hit.u, hit.v, hit.area, footprint)
    return scene.surface_textures[0].camera_emission[material]
