"""Sampling of directions from a point towards an area light, and their pdf per solid angle.

Sampling a near light by area is noisy: most of its irradiance comes from a small part of it. Spheres are sampled as the
cone that they subtend (Shirley et al. 1996); near rectangles uniformly per solid angle (Ureña et al. 2013, An
Area-Preserving Parametrization for Spherical Rectangles); near disks by the square around them; cylinders uniformly in
the azimuth around their axis and in the sine of the elevation along it, the product of which measures solid angle
(Archimedes); distant flat lights by area. Scaled or sheared lights are sampled in a canonical space where they are
neither: a linear map A changes solid angles by |A d|³ / |det A|. No result depends on the difference of nearly equal
numbers, however small, large, near or far the light.
"""

import warp as wp

from warp_ir.sampling.square_to import from_local, square_to_disk
from warp_ir.scene import LightKind

wp.set_module_options({"enable_backward": False})

_RECT = wp.constant(int(LightKind.RECT))
_DISK = wp.constant(int(LightKind.DISK))
_SPHERE = wp.constant(int(LightKind.SPHERE))
_NEAR_DISK = wp.constant(1.5)  # squared distance within which a disk of radius 1 is sampled by the square around it
_MIN_SOLID_ANGLE = wp.constant(1.0e-2)  # [sr], below which the difference of arctangents loses too many digits


@wp.struct
class DirectionSample:
    """A sampled direction from a point towards a light."""

    offset: wp.vec3  # from the point to the sampled point on the light
    pdf: float  # per solid angle; 0: the light does not emit towards the point in this direction


@wp.struct
class _CanonicalSpace:
    """A space where the light is a rectangle, the unit disk, the unit sphere or a cylinder of radius 1.

    The map A from it to the world is as close to a rotation as the light's shape allows.
    """

    scale: wp.vec3  # canonical coordinates over coordinates in the light's unit space
    cbrt_det: float  # ∛|det A|
    centre: wp.vec3  # of the light, relative to the point


@wp.func
def _canonical_space(kind: int, axes: wp.mat33, inverse: wp.mat33, to_light: wp.vec3) -> _CanonicalSpace:
    """The canonical space of a light; arguments as for `sample_solid_angle`."""
    x = wp.vec3(axes[0, 0], axes[1, 0], axes[2, 0])
    y = wp.vec3(axes[0, 1], axes[1, 1], axes[2, 1])
    z = wp.vec3(axes[0, 2], axes[1, 2], axes[2, 2])
    out = _CanonicalSpace()
    out.scale = wp.vec3(1.0)
    if kind == _RECT or kind == _DISK:
        area = wp.length(wp.cross(x, y))
        if kind == _RECT:
            out.scale = wp.vec3(wp.length(x), area / wp.length(x), wp.length(z))
            out.cbrt_det = 1.0
        else:
            out.cbrt_det = wp.sqrt(area)
            out.scale = wp.vec3(1.0, 1.0, wp.length(z) / out.cbrt_det)
    else:
        if kind != _SPHERE:
            out.scale = wp.vec3(wp.length(x) / wp.sqrt(wp.length(wp.cross(y, z))), 1.0, 1.0)
        out.cbrt_det = wp.cbrt(wp.abs(wp.determinant(axes)) / out.scale[0])
    out.centre = wp.cw_mul(out.scale, inverse * to_light)
    return out


@wp.func(inline=False)
def sample_solid_angle(kind: int, axes: wp.mat33, inverse: wp.mat33, to_light: wp.vec3, u: wp.vec2) -> DirectionSample:
    """Samples a direction from a point towards a light.

    Args:
        kind: RECT, DISK, SPHERE or CYLINDER.
        axes: Columns: the images of the unit shape's axes.
        inverse: The inverse of `axes`.
        to_light: From the point to the light's origin.
        u: Sample in [0, 1)².
    """
    space = _canonical_space(kind, axes, inverse, to_light)
    sample = DirectionSample()
    if kind == _RECT or kind == _DISK:
        sample = _sample_flat(kind, space, u)
    elif kind == _SPHERE:
        sample = _sample_sphere(space.centre, u)
    else:
        sample = _sample_cylinder(space, u)
    if sample.pdf > 0.0:
        p = sample.offset
        sample.offset = axes * wp.cw_div(p, space.scale)
        stretch = wp.length(sample.offset) / (wp.length(p) * space.cbrt_det)
        sample.pdf *= stretch * stretch * stretch
    return sample


@wp.func(inline=False)
def solid_angle_pdf(kind: int, axes: wp.mat33, inverse: wp.mat33, to_light: wp.vec3, direction: wp.vec3) -> float:
    """The pdf per solid angle of `sample_solid_angle` for a unit direction that meets the light's emitting side."""
    space = _canonical_space(kind, axes, inverse, to_light)
    d = wp.cw_mul(space.scale, inverse * direction)
    pdf = float(0.0)
    if kind == _RECT or kind == _DISK:
        pdf = _flat_pdf(kind, space, d)
    elif kind == _SPHERE:
        pdf = _sphere_pdf(space.centre)
    else:
        pdf = _cylinder_pdf(space, d)
    stretch = 1.0 / (wp.length(d) * space.cbrt_det)
    return pdf * stretch * stretch * stretch


@wp.func
def _one_minus_cos_radius(centre: wp.vec3) -> float:
    """1 - cosθ of the angular radius θ of the unit sphere around `centre`; the origin is outside."""
    squared = wp.dot(centre, centre)
    return 1.0 / (squared * (1.0 + wp.sqrt((squared - 1.0) / squared)))


@wp.func
def _sample_sphere(centre: wp.vec3, u: wp.vec2) -> DirectionSample:
    """A direction uniform in the cone that the unit sphere around `centre` subtends."""
    out = DirectionSample()
    squared = wp.dot(centre, centre)
    if not squared > 1.0:
        return out
    distance = wp.sqrt(squared)
    one_minus_cos = _one_minus_cos_radius(centre)
    h = u[0] * one_minus_cos  # 1 - cosθ
    sine_squared = h * (2.0 - h)
    half_chord = wp.sqrt(wp.max(0.0, 1.0 - sine_squared * squared))
    t = (squared - 1.0) / (distance * (1.0 - h) + half_chord)
    r = wp.sqrt(sine_squared)
    phi = 2.0 * wp.pi * u[1]
    local = wp.vec3(r * wp.cos(phi), r * wp.sin(phi), 1.0 - h)
    out.offset = t * from_local(local, centre / distance)
    out.pdf = 1.0 / (2.0 * wp.pi * one_minus_cos)
    return out


@wp.func
def _sphere_pdf(centre: wp.vec3) -> float:
    """The pdf of `_sample_sphere`, the same for all its directions."""
    if not wp.dot(centre, centre) > 1.0:
        return 0.0
    return 1.0 / (2.0 * wp.pi * _one_minus_cos_radius(centre))


@wp.func
def _half_sides(kind: int, space: _CanonicalSpace) -> wp.vec2:
    """Half the side lengths of a rectangle, or of the square around a disk."""
    if kind == _DISK:
        return wp.vec2(1.0, 1.0)
    return wp.vec2(0.5 * space.scale[0], 0.5 * space.scale[1])


@wp.func
def _corner_solid_angle(x: float, y: float, z: float) -> float:
    """Solid angle of the rectangle from (0, 0) to (x, y) at a distance z > 0, with the sign of x y."""
    return wp.atan2(x * y, z * wp.sqrt(x * x + y * y + z * z))


@wp.func
def _rectangle_solid_angle(low: wp.vec2, high: wp.vec2, z: float) -> float:
    """Solid angle of a rectangle at a distance z > 0."""
    right = _corner_solid_angle(high[0], high[1], z) - _corner_solid_angle(high[0], low[1], z)
    return right - _corner_solid_angle(low[0], high[1], z) + _corner_solid_angle(low[0], low[1], z)


@wp.func
def _is_near(kind: int, centre: wp.vec3, half: wp.vec2) -> bool:
    """Whether a flat light is so near that sampling it by area would be noisy."""
    near_distance_squared = wp.where(kind == _DISK, _NEAR_DISK, 4.0 * wp.length_sq(half))
    return wp.length_sq(centre) < near_distance_squared


@wp.func
def _area(kind: int, half: wp.vec2) -> float:
    """Area of a rectangle or of the unit disk."""
    return wp.where(kind == _DISK, wp.pi, 4.0 * half[0] * half[1])


@wp.func
def _sample_flat(kind: int, space: _CanonicalSpace, u: wp.vec2) -> DirectionSample:
    """A direction towards a rectangle or a disk: by solid angle if it is near, else by area."""
    out = DirectionSample()
    z = -space.centre[2]  # the light shines along +z
    if not z > 0.0:
        return out
    centre = wp.vec2(space.centre[0], space.centre[1])
    half = _half_sides(kind, space)
    low = centre - half
    high = centre + half
    solid_angle = float(0.0)
    if _is_near(kind, space.centre, half):
        solid_angle = _rectangle_solid_angle(low, high, z)
    if solid_angle > _MIN_SOLID_ANGLE:
        p = _sample_spherical_rectangle(low, high, z, solid_angle, u)
        out.offset = wp.vec3(p[0], p[1], -z)
        if kind == _RECT or wp.length_sq(p - centre) <= 1.0:
            out.pdf = 1.0 / solid_angle
        return out
    p = wp.vec2(wp.lerp(low[0], high[0], u[0]), wp.lerp(low[1], high[1], u[1]))
    if kind == _DISK:
        p = centre + square_to_disk(u)
    out.offset = wp.vec3(p[0], p[1], -z)
    out.pdf = _area_to_solid_angle_pdf(out.offset, _area(kind, half))
    return out


@wp.func
def _area_to_solid_angle_pdf(offset: wp.vec3, area: float) -> float:
    """Solid-angle pdf of a point sampled uniformly on an area A across the z axis: d² / (A cosθ)."""
    distance = wp.length(offset)
    return distance * distance * distance / (area * wp.abs(offset[2]))


@wp.func
def _flat_pdf(kind: int, space: _CanonicalSpace, d: wp.vec3) -> float:
    """The pdf of `_sample_flat` for a direction that hits the light."""
    z = -space.centre[2]
    if not (z > 0.0 and d[2] < 0.0):
        return 0.0
    centre = wp.vec2(space.centre[0], space.centre[1])
    half = _half_sides(kind, space)
    if _is_near(kind, space.centre, half):
        solid_angle = _rectangle_solid_angle(centre - half, centre + half, z)
        if solid_angle > _MIN_SOLID_ANGLE:
            return 1.0 / solid_angle
    return _area_to_solid_angle_pdf(d * (z / -d[2]), _area(kind, half))


@wp.func
def _sample_spherical_rectangle(low: wp.vec2, high: wp.vec2, z: float, solid_angle: float, u: wp.vec2) -> wp.vec2:
    """A point of a rectangle at a distance z, uniform per solid angle; variables are named as by Ureña et al."""
    # x inverts the solid angle of the rectangle up to it ...
    au = u[0] * solid_angle + wp.pi + _corner_solid_angle(low[0], high[1], z) - _corner_solid_angle(low[0], low[1], z)
    below = z * z + low[1] * low[1]
    b0 = -low[1] / wp.sqrt(below)
    b1 = high[1] / wp.sqrt(z * z + high[1] * high[1])
    fu = (wp.cos(au) * b0 - b1) / wp.sin(au)
    xu = z / wp.sqrt(wp.max(fu * fu - z * z / below, 1.0e-30))
    xu = wp.clamp(wp.where(fu < 0.0, -xu, xu), low[0], high[0])
    # ... and y is uniform in the sine of its elevation.
    d = wp.sqrt(xu * xu + z * z)
    h = wp.lerp(low[1] / wp.sqrt(d * d + low[1] * low[1]), high[1] / wp.sqrt(d * d + high[1] * high[1]), u[1])
    yv = h * d / wp.sqrt(wp.max(1.0 - h * h, 1.0e-30))
    return wp.vec2(xu, wp.clamp(yv, low[1], high[1]))


@wp.func
def _sine_difference(x0: float, x1: float, distance: float) -> float:
    """Sin of the elevation of x1 less that of x0 < x1, both on a line at a distance, without cancellation."""
    r0 = wp.sqrt(x0 * x0 + distance * distance)
    r1 = wp.sqrt(x1 * x1 + distance * distance)
    if x0 * x1 <= 0.0:
        return x1 / r1 - x0 / r0
    return (x1 - x0) * (x1 + x0) * (distance / r0) * (distance / r1) / (x1 * r0 + x0 * r1)


@wp.func
def _distance_to_cylinder(centre: wp.vec3, e: wp.vec2) -> float:
    """Distance in the unit direction `e` across the axis to the near side of a cylinder of radius 1."""
    centre_2d = wp.vec2(centre[1], centre[2])
    perpendicular = centre[1] * e[1] - centre[2] * e[0]
    return (wp.dot(centre_2d, centre_2d) - 1.0) / (
        wp.dot(centre_2d, e) + wp.sqrt(wp.max(0.0, 1.0 - perpendicular * perpendicular))
    )


@wp.func
def _half_azimuth(centre: wp.vec3) -> float:
    """Half the azimuth that a cylinder of radius 1 subtends across its axis; 0 from inside."""
    squared = centre[1] * centre[1] + centre[2] * centre[2]
    if not squared > 1.0:
        return 0.0
    return wp.atan2(1.0, wp.sqrt(squared - 1.0))


@wp.func
def _sample_cylinder(space: _CanonicalSpace, u: wp.vec2) -> DirectionSample:
    """A direction towards a cylinder, uniform in the azimuth and in the sine of the elevation."""
    out = DirectionSample()
    centre = space.centre
    half = _half_azimuth(centre)
    if half == 0.0:
        return out
    psi = half * (2.0 * u[0] - 1.0)
    c = wp.cos(psi)
    s = wp.sin(psi)
    to_axis = wp.normalize(wp.vec2(centre[1], centre[2]))
    e = wp.vec2(c * to_axis[0] - s * to_axis[1], s * to_axis[0] + c * to_axis[1])
    distance = _distance_to_cylinder(centre, e)
    x0 = centre[0] - 0.5 * space.scale[0]
    x1 = centre[0] + 0.5 * space.scale[0]
    sine_difference = _sine_difference(x0, x1, distance)
    h = x0 / wp.sqrt(x0 * x0 + distance * distance) + u[1] * sine_difference
    x = wp.clamp(h * distance / wp.sqrt(wp.max(1.0 - h * h, 1.0e-30)), x0, x1)
    out.offset = wp.vec3(x, distance * e[0], distance * e[1])
    out.pdf = 1.0 / (2.0 * half * sine_difference)
    return out


@wp.func
def _cylinder_pdf(space: _CanonicalSpace, d: wp.vec3) -> float:
    """The pdf of `_sample_cylinder` for a direction that hits the light."""
    half = _half_azimuth(space.centre)
    if half == 0.0:
        return 0.0
    distance = _distance_to_cylinder(space.centre, wp.normalize(wp.vec2(d[1], d[2])))
    x0 = space.centre[0] - 0.5 * space.scale[0]
    x1 = space.centre[0] + 0.5 * space.scale[0]
    return 1.0 / (2.0 * half * _sine_difference(x0, x1, distance))
