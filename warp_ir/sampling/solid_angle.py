"""Directions towards a light with an area, and their density per solid angle as a point sees it.

Points sampled by area are bad when a light is near: most of what arrives comes from a small part of it. Here spheres
are sampled as the cone that they fill (Shirley et al. 1996), rectangles nearby evenly per solid angle (Ureña et al.
2013, An Area-Preserving Parametrization for Spherical Rectangles), disks nearby as the square around them, and
cylinders evenly in the angle around their axis and in the sine of the angle along it, which together are a measure of
solid angle as well (Archimedes); flat lights that are far, by area. Lights that are scaled or sheared are sampled in a
space where they are not: a linear map A changes solid angles by |A d|³ / |det A|. No difference of nearly equal numbers
decides how bright anything is, however small, large, near or far the light.
"""

import warp as wp

from warp_ir.sampling.square_to import from_local, square_to_disk
from warp_ir.scene import LightKind

wp.set_module_options({"enable_backward": False})

_RECT = wp.constant(int(LightKind.RECT))
_DISK = wp.constant(int(LightKind.DISK))
_SPHERE = wp.constant(int(LightKind.SPHERE))
_NEAR_DISK = wp.constant(1.5)  # squared distance within which a disk of radius 1 is sampled as its square
_LEAST_ANGLE = wp.constant(1.0e-2)  # [sr], below which a difference of angles tells too little


@wp.struct
class Aim:
    """A sampled way from a point to a light."""

    way: wp.vec3  # to where the light emits towards the point
    pdf: float  # of its direction, per solid angle; 0: nothing arrives this way


@wp.struct
class _Space:
    """Where a light is a rectangle, the unit disk or sphere or a cylinder of radius 1, and little else is bent."""

    scale: wp.vec3  # coordinates there over those in the light's unit space
    volume_root: float  # ∛|det A|, A leading from there to the world
    centre: wp.vec3  # of the light as the point sees it


@wp.func
def _space(kind: int, axes: wp.mat33, inverse: wp.mat33, to_light: wp.vec3) -> _Space:
    x = wp.vec3(axes[0, 0], axes[1, 0], axes[2, 0])
    y = wp.vec3(axes[0, 1], axes[1, 1], axes[2, 1])
    z = wp.vec3(axes[0, 2], axes[1, 2], axes[2, 2])
    out = _Space()
    out.scale = wp.vec3(1.0)
    if kind == _RECT or kind == _DISK:
        area = wp.length(wp.cross(x, y))
        if kind == _RECT:
            out.scale = wp.vec3(wp.length(x), area / wp.length(x), wp.length(z))
            out.volume_root = 1.0
        else:
            out.volume_root = wp.sqrt(area)
            out.scale = wp.vec3(1.0, 1.0, wp.length(z) / out.volume_root)
    else:
        if kind != _SPHERE:
            out.scale = wp.vec3(wp.length(x) / wp.sqrt(wp.length(wp.cross(y, z))), 1.0, 1.0)
        out.volume_root = wp.cbrt(wp.abs(wp.determinant(axes)) / out.scale[0])
    out.centre = wp.cw_mul(out.scale, inverse * to_light)
    return out


@wp.func(inline=False)
def sample_solid_angle(kind: int, axes: wp.mat33, inverse: wp.mat33, to_light: wp.vec3, u: wp.vec2) -> Aim:
    """A random way to a light.

    Args:
        kind: RECT, DISK, SPHERE or CYLINDER.
        axes: Columns: what the axes of the unit shape become.
        inverse: Of `axes`.
        to_light: From the point to the light's origin.
        u: In [0, 1)².
    """
    space = _space(kind, axes, inverse, to_light)
    found = Aim()
    if kind == _RECT or kind == _DISK:
        found = _sample_flat(kind, space, u)
    elif kind == _SPHERE:
        found = _sample_sphere(space.centre, u)
    else:
        found = _sample_cylinder(space, u)
    if found.pdf > 0.0:
        p = found.way
        found.way = axes * wp.cw_div(p, space.scale)
        stretched = wp.length(found.way) / (wp.length(p) * space.volume_root)
        found.pdf *= stretched * stretched * stretched
    return found


@wp.func(inline=False)
def solid_angle_pdf(kind: int, axes: wp.mat33, inverse: wp.mat33, to_light: wp.vec3, direction: wp.vec3) -> float:
    """The density with which `sample_solid_angle` gives a unit direction that meets the emitting side of the light."""
    space = _space(kind, axes, inverse, to_light)
    d = wp.cw_mul(space.scale, inverse * direction)
    pdf = float(0.0)
    if kind == _RECT or kind == _DISK:
        pdf = _flat_pdf(kind, space, d)
    elif kind == _SPHERE:
        pdf = _sphere_pdf(space.centre)
    else:
        pdf = _cylinder_pdf(space, d)
    stretched = 1.0 / (wp.length(d) * space.volume_root)
    return pdf * stretched * stretched * stretched


@wp.func
def _one_minus_cos(centre: wp.vec3) -> float:
    """Of the angular radius of the unit sphere; the point is outside."""
    squared = wp.dot(centre, centre)
    return 1.0 / (squared * (1.0 + wp.sqrt((squared - 1.0) / squared)))


@wp.func
def _sample_sphere(centre: wp.vec3, u: wp.vec2) -> Aim:
    out = Aim()
    squared = wp.dot(centre, centre)
    if not squared > 1.0:
        return out
    distance = wp.sqrt(squared)
    whole = _one_minus_cos(centre)
    h = u[0] * whole  # 1 - cosθ
    sine_squared = h * (2.0 - h)
    half_chord = wp.sqrt(wp.max(0.0, 1.0 - sine_squared * squared))
    t = (squared - 1.0) / (distance * (1.0 - h) + half_chord)
    r = wp.sqrt(sine_squared)
    phi = 2.0 * wp.pi * u[1]
    around = wp.vec3(r * wp.cos(phi), r * wp.sin(phi), 1.0 - h)
    out.way = t * from_local(around, centre / distance)
    out.pdf = 1.0 / (2.0 * wp.pi * whole)
    return out


@wp.func
def _sphere_pdf(centre: wp.vec3) -> float:
    if not wp.dot(centre, centre) > 1.0:
        return 0.0
    return 1.0 / (2.0 * wp.pi * _one_minus_cos(centre))


@wp.func
def _half(kind: int, space: _Space) -> wp.vec2:
    """Half the sides of a rectangle, or of the square around a disk."""
    if kind == _DISK:
        return wp.vec2(1.0, 1.0)
    return wp.vec2(0.5 * space.scale[0], 0.5 * space.scale[1])


@wp.func
def _corner(x: float, y: float, z: float) -> float:
    """Solid angle of the rectangle from (0, 0) to (x, y) at a distance z > 0, signed like x y."""
    return wp.atan2(x * y, z * wp.sqrt(x * x + y * y + z * z))


@wp.func
def _rectangle_angle(low: wp.vec2, high: wp.vec2, z: float) -> float:
    """Solid angle of a rectangle at a distance z > 0."""
    right = _corner(high[0], high[1], z) - _corner(high[0], low[1], z)
    return right - _corner(low[0], high[1], z) + _corner(low[0], low[1], z)


@wp.func
def _nearby(kind: int, centre: wp.vec3, half: wp.vec2) -> bool:
    """Whether sampling a flat light by its area would be noisy."""
    reach = wp.where(kind == _DISK, _NEAR_DISK, 4.0 * wp.length_sq(half))
    return wp.length_sq(centre) < reach


@wp.func
def _area(kind: int, half: wp.vec2) -> float:
    return wp.where(kind == _DISK, wp.pi, 4.0 * half[0] * half[1])


@wp.func
def _sample_flat(kind: int, space: _Space, u: wp.vec2) -> Aim:
    out = Aim()
    z = -space.centre[2]  # the light shines along +z
    if not z > 0.0:
        return out
    centre = wp.vec2(space.centre[0], space.centre[1])
    half = _half(kind, space)
    low = centre - half
    high = centre + half
    angle = float(0.0)
    if _nearby(kind, space.centre, half):
        angle = _rectangle_angle(low, high, z)
    if angle > _LEAST_ANGLE:
        p = _in_rectangle(low, high, z, angle, u)
        out.way = wp.vec3(p[0], p[1], -z)
        if kind == _RECT or wp.length_sq(p - centre) <= 1.0:
            out.pdf = 1.0 / angle
        return out
    p = wp.vec2(wp.lerp(low[0], high[0], u[0]), wp.lerp(low[1], high[1], u[1]))
    if kind == _DISK:
        p = centre + square_to_disk(u)
    out.way = wp.vec3(p[0], p[1], -z)
    out.pdf = _per_area(out.way, _area(kind, half))
    return out


@wp.func
def _per_area(way: wp.vec3, area: float) -> float:
    """Density per solid angle of a point drawn evenly from an area across the z axis: d² / (A cosθ)."""
    distance = wp.length(way)
    return distance * distance * distance / (area * wp.abs(way[2]))


@wp.func
def _flat_pdf(kind: int, space: _Space, d: wp.vec3) -> float:
    z = -space.centre[2]
    if not (z > 0.0 and d[2] < 0.0):
        return 0.0
    centre = wp.vec2(space.centre[0], space.centre[1])
    half = _half(kind, space)
    if _nearby(kind, space.centre, half):
        angle = _rectangle_angle(centre - half, centre + half, z)
        if angle > _LEAST_ANGLE:
            return 1.0 / angle
    return _per_area(d * (z / -d[2]), _area(kind, half))


@wp.func
def _in_rectangle(low: wp.vec2, high: wp.vec2, z: float, angle: float, u: wp.vec2) -> wp.vec2:
    """A point of a rectangle at a distance z, uniform per solid angle; names of the paper."""
    # x by the solid angle of what lies below it ...
    au = u[0] * angle + wp.pi + _corner(low[0], high[1], z) - _corner(low[0], low[1], z)
    below = z * z + low[1] * low[1]
    b0 = -low[1] / wp.sqrt(below)
    b1 = high[1] / wp.sqrt(z * z + high[1] * high[1])
    fu = (wp.cos(au) * b0 - b1) / wp.sin(au)
    xu = z / wp.sqrt(wp.max(fu * fu - z * z / below, 1.0e-30))
    xu = wp.clamp(wp.where(fu < 0.0, -xu, xu), low[0], high[0])
    # ... and y evenly in the sine of its angle.
    d = wp.sqrt(xu * xu + z * z)
    h = wp.lerp(low[1] / wp.sqrt(d * d + low[1] * low[1]), high[1] / wp.sqrt(d * d + high[1] * high[1]), u[1])
    yv = h * d / wp.sqrt(wp.max(1.0 - h * h, 1.0e-30))
    return wp.vec2(xu, wp.clamp(yv, low[1], high[1]))


@wp.func
def _sines(x0: float, x1: float, distance: float) -> float:
    """The difference of the sines of the angles under which x0 < x1 on a line are seen from a distance."""
    r0 = wp.sqrt(x0 * x0 + distance * distance)
    r1 = wp.sqrt(x1 * x1 + distance * distance)
    if x0 * x1 <= 0.0:
        return x1 / r1 - x0 / r0
    return (x1 - x0) * (x1 + x0) * (distance / r0) * (distance / r1) / (x1 * r0 + x0 * r1)


@wp.func
def _to_wall(centre: wp.vec3, e: wp.vec2) -> float:
    """Distance across the axis, in the unit direction `e`, to the near side of a cylinder of radius 1."""
    across = wp.vec2(centre[1], centre[2])
    aside = centre[1] * e[1] - centre[2] * e[0]
    return (wp.dot(across, across) - 1.0) / (wp.dot(across, e) + wp.sqrt(wp.max(0.0, 1.0 - aside * aside)))


@wp.func
def _half_width(centre: wp.vec3) -> float:
    """Half the angle around its axis that a cylinder of radius 1 fills; 0 from inside."""
    squared = centre[1] * centre[1] + centre[2] * centre[2]
    if not squared > 1.0:
        return 0.0
    return wp.atan2(1.0, wp.sqrt(squared - 1.0))


@wp.func
def _sample_cylinder(space: _Space, u: wp.vec2) -> Aim:
    out = Aim()
    centre = space.centre
    half = _half_width(centre)
    if half == 0.0:
        return out
    psi = half * (2.0 * u[0] - 1.0)
    c = wp.cos(psi)
    s = wp.sin(psi)
    to_axis = wp.normalize(wp.vec2(centre[1], centre[2]))
    e = wp.vec2(c * to_axis[0] - s * to_axis[1], s * to_axis[0] + c * to_axis[1])
    distance = _to_wall(centre, e)
    x0 = centre[0] - 0.5 * space.scale[0]
    x1 = centre[0] + 0.5 * space.scale[0]
    sines = _sines(x0, x1, distance)
    h = x0 / wp.sqrt(x0 * x0 + distance * distance) + u[1] * sines
    x = wp.clamp(h * distance / wp.sqrt(wp.max(1.0 - h * h, 1.0e-30)), x0, x1)
    out.way = wp.vec3(x, distance * e[0], distance * e[1])
    out.pdf = 1.0 / (2.0 * half * sines)
    return out


@wp.func
def _cylinder_pdf(space: _Space, d: wp.vec3) -> float:
    half = _half_width(space.centre)
    if half == 0.0:
        return 0.0
    distance = _to_wall(space.centre, wp.normalize(wp.vec2(d[1], d[2])))
    x0 = space.centre[0] - 0.5 * space.scale[0]
    x1 = space.centre[0] + 0.5 * space.scale[0]
    return 1.0 / (2.0 * half * _sines(x0, x1, distance))
