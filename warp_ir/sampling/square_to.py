"""Maps from the unit square to the disk, the hemisphere and the cone."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def from_local(v: wp.vec3, n: wp.vec3) -> wp.vec3:
    """Transforms `v` from an orthonormal frame whose z axis is the unit vector `n` (Duff et al. 2017)."""
    s = wp.where(n[2] >= 0.0, 1.0, -1.0)
    a = -1.0 / (s + n[2])
    b = n[0] * n[1] * a
    x = wp.vec3(1.0 + s * n[0] * n[0] * a, s * b, -s * n[0])
    y = wp.vec3(b, s + n[1] * n[1] * a, -n[1])
    return v[0] * x + v[1] * y + v[2] * n


@wp.func
def to_local(v: wp.vec3, n: wp.vec3) -> wp.vec3:
    """The inverse of `from_local`."""
    x = from_local(wp.vec3(1.0, 0.0, 0.0), n)
    y = from_local(wp.vec3(0.0, 1.0, 0.0), n)
    return wp.vec3(wp.dot(v, x), wp.dot(v, y), wp.dot(v, n))


@wp.func
def square_to_disk(u: wp.vec2) -> wp.vec2:
    """A uniform point of the unit disk, by the concentric map (Shirley and Chiu 1997)."""
    a = 2.0 * u[0] - 1.0
    b = 2.0 * u[1] - 1.0
    r = a
    phi = float(0.0)
    if wp.abs(a) > wp.abs(b):
        phi = 0.25 * wp.pi * (b / a)
    elif b != 0.0:
        r = b
        phi = 0.5 * wp.pi - 0.25 * wp.pi * (a / b)
    return wp.vec2(r * wp.cos(phi), r * wp.sin(phi))


@wp.func
def square_to_cosine_hemisphere(u: wp.vec2, n: wp.vec3) -> wp.vec3:
    """A unit direction around `n` with pdf cosθ/π per solid angle."""
    d = square_to_disk(u)
    z = wp.sqrt(wp.max(0.0, 1.0 - wp.dot(d, d)))
    return wp.normalize(from_local(wp.vec3(d[0], d[1], z), n))


@wp.func
def square_to_cone(u: wp.vec2, one_minus_cos: float, n: wp.vec3) -> wp.vec3:
    """A unit direction, uniform in the cone around `n` of half angle θ_max, given as 1 - cosθ_max (2: the sphere)."""
    h = u[0] * one_minus_cos
    r = wp.sqrt(wp.max(0.0, h * (2.0 - h)))
    phi = 2.0 * wp.pi * u[1]
    return wp.normalize(from_local(wp.vec3(r * wp.cos(phi), r * wp.sin(phi), 1.0 - h), n))
