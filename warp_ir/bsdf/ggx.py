"""The microfacet distribution GGX, in a frame whose z axis is the surface normal.

Masking and shadowing are correlated by height (Heitz 2014, Understanding the Masking-Shadowing Function). Normals are
sampled as they are visible (Heitz 2018), by caps of the sphere (Dupuy and Benyoub 2023).
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def ggx_density(h: wp.vec3, alpha: float) -> float:
    """The distribution D of normals at the half vector [1/sr]."""
    # 1 - h.z² would lose the digits that a narrow peak consists of.
    inner = h[0] * h[0] + h[1] * h[1] + alpha * alpha * h[2] * h[2]
    return alpha * alpha / (wp.pi * inner * inner)


@wp.func
def _smith_root(cosine: float, alpha: float) -> float:
    return wp.sqrt(alpha * alpha + (1.0 - alpha * alpha) * cosine * cosine)


@wp.func
def ggx_visibility(i: wp.vec3, o: wp.vec3, alpha: float) -> float:
    """Masking and shadowing over 4 cosθi cosθo."""
    return 0.5 / wp.max(i[2] * _smith_root(o[2], alpha) + o[2] * _smith_root(i[2], alpha), 1.0e-20)


@wp.func
def sample_visible_normal(o: wp.vec3, alpha: float, u: wp.vec2) -> wp.vec3:
    """A unit normal of the microfacets that are visible from `o`."""
    wide = wp.normalize(wp.vec3(o[0] * alpha, o[1] * alpha, o[2]))
    z = (1.0 - u[1]) * (1.0 + wide[2]) - wide[2]
    r = wp.sqrt(wp.clamp(1.0 - z * z, 0.0, 1.0))
    phi = 2.0 * wp.pi * u[0]
    h = wp.vec3(r * wp.cos(phi), r * wp.sin(phi), z) + wide
    return wp.normalize(wp.vec3(h[0] * alpha, h[1] * alpha, wp.max(h[2], 0.0)))


@wp.func
def reflected_pdf(h: wp.vec3, o: wp.vec3, alpha: float) -> float:
    """The pdf per solid angle of `o` reflected by `sample_visible_normal`, if that is `h`."""
    return 0.5 * ggx_density(h, alpha) / (o[2] + _smith_root(o[2], alpha))
