"""Shading normals: interpolated, normal-mapped, and the height of the smooth surface that they imply."""

import warp as wp

from warp_ir.device_scene import SceneData
from warp_ir.surface.hit import Hit, scene_at
from warp_ir.surface.material import uv_at
from warp_ir.surface.ray_query import intersect_scene
from warp_ir.texture import lookup, mip_level, uv_to_st

wp.set_module_options({"enable_backward": False})


@wp.func
def shading_normal(scene: SceneData, hit: Hit) -> wp.vec3:
    """The interpolated normal on the side of the geometric one; the geometric one where the triangle has no normals."""
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


@wp.func
def mapped_normal(scene: SceneData, hit: Hit, normal: wp.vec3, footprint: float) -> wp.vec3:
    """A unit shading normal tilted by the material's normal map, the mean over a patch of width `footprint`.

    Normals on the back are the opposite of those on the front. The tangent frame's plane is perpendicular to `normal`
    and its x axis along ∂p/∂u; mirrored texture coordinates flip its y axis.
    """
    if scene.normal_map_count > 0:
        return _mapped_normal(scene.address, hit, normal, footprint)
    return normal


@wp.func(inline=False)
def _mapped_normal(address: wp.uint64, hit: Hit, normal: wp.vec3, footprint: float) -> wp.vec3:
    """`mapped_normal` as a called function."""
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
    # Directions of ∂p/∂u and ∂p/∂v, not normalised.
    orientation = wp.sign(ab_uv[0] * ac_uv[1] - ab_uv[1] * ac_uv[0])
    dp_du = orientation * (ab * ac_uv[1] - ac * ab_uv[1])
    dp_dv = orientation * (ac * ab_uv[0] - ab * ac_uv[0])
    tangent_row = p.triangle_tangents[hit.triangle]
    if tangent_row >= 0:
        a = p.corner_tangents[tangent_row]
        b = p.corner_tangents[tangent_row + 1]
        c = p.corner_tangents[tangent_row + 2]
        tangent = hit.u * a + hit.v * b + (1.0 - hit.u - hit.v) * c
        if hit.instance >= 0:
            tangent = scene.instance_axes[hit.instance] * tangent
        if wp.length_sq(tangent) > 0.0:
            dp_du = tangent
    front_normal = wp.where(hit.front == 1, normal, -normal)
    x = wp.normalize(dp_du - front_normal * wp.dot(front_normal, dp_du))
    y = wp.cross(front_normal, x)
    y = wp.where(wp.dot(y, dp_dv) < 0.0, -y, y)
    uv = uv_at(p, hit.triangle, row.uv_set, hit.u, hit.v)
    level = mip_level(p.textures, row, uv[2] / hit.area, footprint)
    n = lookup(p.textures, row, uv_to_st(row, wp.vec2(uv[0], uv[1])), level)
    mapped = n[0] * x + n[1] * y + n[2] * front_normal
    length = wp.length(mapped)
    if uv[2] == 0.0 or wp.length_sq(x) == 0.0 or not (length > 1.0e-6):
        return normal
    return wp.where(hit.front == 1, mapped, -mapped) / length


@wp.func
def smooth_height(scene: SceneData, hit: Hit, normal: wp.vec3) -> float:
    """The height, along the interpolated `normal`, of the smooth surface that the corners' normals imply at a hit.

    It is 0 where the normals do not bend outwards, and where geometry stands on the surface or close above it.
    """
    if scene.triangle_normals[hit.triangle] < 0:
        return 0.0
    return _smooth_height(scene.address, hit, normal)


@wp.func
def _bend(a: wp.vec3, b: wp.vec3, normal_a: wp.vec3, normal_b: wp.vec3, side: float) -> float:
    """How far each end of an edge lies below the tangent plane of the other, in sum; 0 if the normals bend inwards.

    Normals that are all tilted alike bend nothing: what one end rises, the other falls.
    """
    return wp.max(wp.dot(normal_b - normal_a, b - a) * side, 0.0)


@wp.func(inline=False)
def _smooth_height(address: wp.uint64, hit: Hit, normal: wp.vec3) -> float:
    """`smooth_height` as a called function.

    The heights of the tangent planes at the corners, Σ wᵢ nᵢ·(pᵢ - p) (Hanika 2021), equal the sum over the edges of
    wᵢ wⱼ (nⱼ - nᵢ)·(pⱼ - pᵢ), of which only the outward bends are taken.
    """
    scene = scene_at(address)[0]
    row = scene.triangle_normals[hit.triangle]
    na = scene.corner_normals[row]
    nb = scene.corner_normals[row + 1]
    nc = scene.corner_normals[row + 2]
    a = scene.points[scene.indices[3 * hit.triangle]]
    b = scene.points[scene.indices[3 * hit.triangle + 1]]
    c = scene.points[scene.indices[3 * hit.triangle + 2]]
    if hit.instance >= 0:
        to_device = wp.transpose(scene.instances[hit.instance].inverse)
        na = wp.normalize(to_device * na)
        nb = wp.normalize(to_device * nb)
        nc = wp.normalize(to_device * nc)
        axes = scene.instance_axes[hit.instance]
        a = axes * a
        b = axes * b
        c = axes * c
    w = 1.0 - hit.u - hit.v
    side = wp.where(wp.dot(hit.u * na + hit.v * nb + w * nc, normal) < 0.0, -1.0, 1.0)
    height = hit.u * hit.v * _bend(a, b, na, nb, side)
    height += hit.v * w * _bend(b, c, nb, nc, side)
    height += w * hit.u * _bend(c, a, nc, na, side)
    # Not past geometry that stands on the surface or close above it.
    if height > 0.0:
        if intersect_scene(address, hit.position, normal * height, 2.0, True).triangle >= 0:
            return 0.0
    return height
