"""The shape of one light: its intersection with a ray, its area, and its radiance before shaping and shadows."""

import warp as wp

from warp_ir.device_scene import SceneData
from warp_ir.sampling.distribution2d import uv_pdf, value_at_uv
from warp_ir.sampling.solid_angle import solid_angle_pdf
from warp_ir.scene import LightKind
from warp_ir.surface import SHADOW_RAY_END

wp.set_module_options({"enable_backward": False})

_RECT = wp.constant(int(LightKind.RECT))
_DISK = wp.constant(int(LightKind.DISK))
_SPHERE = wp.constant(int(LightKind.SPHERE))
_CYLINDER = wp.constant(int(LightKind.CYLINDER))
_EIGHT_ULP = wp.constant(8.0 * 2.0**-23)


@wp.func
def light_texture(scene: SceneData, light: int) -> int:
    """The distribution whose values multiply a light's radiance; -1: none."""
    if scene.textured_light_count == 0:
        return -1
    return scene.light_tables[0].texture[light]


@wp.func
def modifier_row_of_light(scene: SceneData, light: int) -> int:
    """The row of a light's `LightModifiers`; -1: none. Light -1 is a surface."""
    if scene.modifier_count == 0 or light < 0:
        return -1
    return scene.light_tables[0].modifiers.row_of_light[light]


@wp.func
def modifier_row_of_surface(scene: SceneData, triangle: int) -> int:
    """The row of the `LightModifiers` of an emissive surface; -1: none."""
    if scene.modifier_count == 0:
        return -1
    if scene.light_tables[0].modifiers.modified_mesh_count == 0:
        return -1
    return scene.light_tables[0].modifiers.row_of_mesh[scene.triangle_mesh[triangle]]


@wp.func
def area_scale(scene: SceneData, light: int, n: wp.vec3) -> float:
    """Area element of a shape over that of the unit shape, where the unit shape's normal is `n` (Nanson's formula)."""
    return wp.abs(wp.determinant(scene.light_axes[light])) * wp.length(wp.transpose(scene.light_inverse[light]) * n)


@wp.func
def unit_area(kind: int) -> float:
    """Area of the unit shape of a kind of light."""
    if kind == _RECT:
        return 1.0
    if kind == _DISK:
        return wp.pi
    if kind == _SPHERE:
        return 4.0 * wp.pi
    return 2.0 * wp.pi


@wp.func
def outward_normal(scene: SceneData, light: int, p: wp.vec3) -> wp.vec3:
    """The unit normal of the emitting side of a light with an area at a point of it."""
    kind = scene.light_kind[light]
    n = wp.vec3(0.0, 0.0, 1.0)
    if kind == _SPHERE or kind == _CYLINDER:
        n = scene.light_inverse[light] * (p - scene.light_origin[light])
        if kind == _CYLINDER:
            n = wp.vec3(0.0, n[1], n[2])
    return wp.normalize(wp.transpose(scene.light_inverse[light]) * n)


@wp.func
def is_large(scene: SceneData, light: int) -> bool:
    """Whether a light is so much larger than the scene that half of its samples are by solid angle."""
    return scene.large_light_count > 0 and scene.light_large[light] == 1


@wp.func
def large_light_pdf(scene: SceneData, light: int, p: wp.vec3) -> float:
    """The pdf per area of the samples on a light that `is_large`, once it is selected, at a point of it."""
    n = outward_normal(scene, light, p)
    kind = scene.light_kind[light]
    unit_n = wp.normalize(wp.transpose(scene.light_axes[light]) * n)
    pdf = 0.5 / (unit_area(kind) * area_scale(scene, light, unit_n))
    texture = light_texture(scene, light)
    if texture >= 0:
        pdf *= uv_pdf(scene.light_tables[0].distributions, texture, uv_of_point(scene, light, p))
    to_light = p - scene.focus
    squared = wp.dot(to_light, to_light) + 1.0e-30
    direction = to_light / wp.sqrt(squared)
    cosine = -wp.dot(n, direction)
    if cosine > 0.0:
        pdf += (
            0.5
            * solid_angle_pdf(
                kind,
                scene.light_axes[light],
                scene.light_inverse[light],
                scene.light_origin[light] - scene.focus,
                direction,
            )
            * (cosine / squared)
        )
    return pdf


@wp.func
def light_axis(scene: SceneData, light: int) -> wp.vec3:
    """The third axis: the unit direction towards a distant light, or the unit normal of a flat one."""
    m = scene.light_axes[light]
    return wp.vec3(m[0, 2], m[1, 2], m[2, 2])


@wp.func
def dome_from_world(scene: SceneData, light: int, direction: wp.vec3) -> wp.vec3:
    """A world direction in the frame of a dome's texture, whose pole is +z and whose first column begins at +x."""
    d = wp.transpose(scene.light_axes[light]) * direction
    return wp.vec3(-d[2], d[0], d[1])


@wp.func
def world_from_dome(scene: SceneData, light: int, d: wp.vec3) -> wp.vec3:
    """The inverse of `dome_from_world`."""
    return scene.light_axes[light] * wp.vec3(d[1], d[2], -d[0])


@wp.func
def intersect_shape(scene: SceneData, light: int, origin: wp.vec3, direction: wp.vec3) -> wp.vec4:
    """Intersects a ray with the emitting side of a light: the unit shape's normal there, and t (-1: a miss)."""
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
    x_scale = wp.where(kind == _CYLINDER, 0.0, 1.0)
    o2 = wp.vec3(o[0] * x_scale, o[1], o[2])
    d2 = wp.vec3(d[0] * x_scale, d[1], d[2])
    a = wp.dot(d2, d2)
    b = wp.dot(o2, d2)
    if b >= 0.0 or a == 0.0:
        return miss
    # The squared distance of the line from the axis, without cancellation for a distant origin.
    nearest = o2 - d2 * (b / a)
    half_chord_squared = 1.0 - wp.dot(nearest, nearest)
    if half_chord_squared <= 0.0:
        return miss
    t = -b / a - wp.sqrt(
        half_chord_squared / a
    )  # the first intersection: the second is on the inside, which does not emit
    if t <= 0.0 or (kind == _CYLINDER and wp.abs(o[0] + t * d[0]) > 0.5):
        return miss
    n = wp.normalize(o2 + t * d2)
    return wp.vec4(n[0], n[1], n[2], t)


@wp.func
def meets_before(scene: SceneData, light: int, origin: wp.vec3, direction: wp.vec3, hit: wp.vec4, t_max: float) -> bool:
    """Whether a ray in a unit direction meets a light before a surface at `t_max`; `hit` is from `intersect_shape`.

    A light in the plane of a surface counts, as it does for shadow rays: these end before the light, off its side.
    """
    if hit[3] <= 0.0:
        return False
    if hit[3] < t_max:
        return True
    normal = wp.normalize(wp.transpose(scene.light_inverse[light]) * wp.vec3(hit[0], hit[1], hit[2]))
    p = offset_from_light(origin + direction * hit[3], normal)
    return SHADOW_RAY_END * wp.dot(p - origin, normal) > t_max * wp.dot(direction, normal)


@wp.func
def shape_radiance(scene: SceneData, light: int, origin: wp.vec3, direction: wp.vec3, t: float) -> wp.vec3:
    """Radiance of a light with an area where a ray meets it at t, before shaping."""
    texture = light_texture(scene, light)
    if texture < 0:
        return scene.light_radiance[light]
    uv = texture_uv(scene, light, origin, direction, t)
    return wp.cw_mul(scene.light_radiance[light], value_at_uv(scene.light_tables[0].distributions, texture, uv))


@wp.func
def texture_uv(scene: SceneData, light: int, origin: wp.vec3, direction: wp.vec3, t: float) -> wp.vec2:
    """Texture coordinates in [0, 1]² where a ray meets a rectangle at t: u from +X to -X, v from +Y to -Y."""
    return uv_of_point(scene, light, origin + t * direction)


@wp.func
def uv_of_point(scene: SceneData, light: int, p: wp.vec3) -> wp.vec2:
    """Texture coordinates of a point of a rectangle."""
    q = scene.light_inverse[light] * (p - scene.light_origin[light])
    return wp.vec2(0.5 - q[0], 0.5 - q[1])


@wp.func
def point_radiance(scene: SceneData, light: int, p: wp.vec3) -> wp.vec3:
    """Radiance of a light with an area at a point of it, before shaping."""
    texture = light_texture(scene, light)
    if texture < 0:
        return scene.light_radiance[light]
    uv = uv_of_point(scene, light, p)
    return wp.cw_mul(scene.light_radiance[light], value_at_uv(scene.light_tables[0].distributions, texture, uv))


@wp.func
def offset_from_light(p: wp.vec3, direction: wp.vec3) -> wp.vec3:
    """A point on a light, offset by 8 ulp along a unit direction, since lights often lie in the plane of a ceiling."""
    return p + direction * (wp.max(wp.abs(p)) * _EIGHT_ULP)
