"""A ray against eight boxes or eight triangles, side by side in vector registers.

Boxes are tested conservatively (Ize 2013) and triangles by the sheared edge functions of Woop, Benthin and Wald (2013),
evaluated so that two triangles get the same value for a common edge: no ray slips between them.
"""

import warp as wp

from warp_ir.bvh.node_layout import vec8

wp.set_module_options({"enable_backward": False})

_TINY = wp.constant(1.0e-18)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return true;
#else
    return false;
#endif
""")
def on_cuda() -> bool:
    """Known at compile time: the other way costs nothing."""
    ...


@wp.func
def reciprocal(direction: wp.vec3) -> wp.vec3:
    """1 over each component; what is next to 0 is kept away from it."""
    inverse = wp.vec3()
    for k in range(3):
        d = direction[k]
        if wp.abs(d) < _TINY:
            d = wp.where(d < 0.0, -_TINY, _TINY)
        inverse[k] = 1.0 / d
    return inverse


@wp.func_native("""
    wp::vec_t<8, float> t;
    for (int i = 0; i < 8; ++i) {
        const float ax = (near_x[i] - o[0]) * inverse[0], bx = (far_x[i] - p[0]) * inverse[0];
        const float ay = (near_y[i] - o[1]) * inverse[1], by = (far_y[i] - p[1]) * inverse[1];
        const float az = (near_z[i] - o[2]) * inverse[2], bz = (far_z[i] - p[2]) * inverse[2];
        float near = ax > ay ? ax : ay;
        near = near > az ? near : az;
        near = near > 0.0f ? near : 0.0f;
        float far = bx < by ? bx : by;
        far = (far < bz ? far : bz) * 1.0000004f;
        t[i] = near <= far ? near : 3.0e38f;
    }
    return t;
""")
def enter(
    near_x: vec8,
    near_y: vec8,
    near_z: vec8,
    far_x: vec8,
    far_y: vec8,
    far_z: vec8,
    o: wp.vec3,
    p: wp.vec3,
    inverse: wp.vec3,
) -> vec8:
    """Where a ray enters each of eight boxes; infinity where it misses.

    Both o and p are its origin, unless boxes are to be larger: then o lies as far ahead in each axis, and p behind.
    """
    ...


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    // Without fused operations a b - c d and c d - a b are each other's negative: that is what closes the edges.
    #pragma clang fp contract(off)
#endif
    wp::vec_t<8, float> out;
    for (int i = 0; i < 8; ++i) {
        const float pz = az[i] - o[2], px = (ax[i] - o[0]) - s[0] * pz, py = (ay[i] - o[1]) - s[1] * pz;
        const float qz = bz[i] - o[2], qx = (bx[i] - o[0]) - s[0] * qz, qy = (by[i] - o[1]) - s[1] * qz;
        const float rz = cz[i] - o[2], rx = (cx[i] - o[0]) - s[0] * rz, ry = (cy[i] - o[1]) - s[1] * rz;
        const float u = rx * qy - ry * qx, v = px * ry - py * rx, w = qx * py - qy * px;
        const float uv_min = u < v ? u : v, uv_max = u > v ? u : v;
        const float lowest = uv_min < w ? uv_min : w, highest = uv_max > w ? uv_max : w;
        const float determinant = u + v + w;
        const float t = s[2] * (u * pz + v * qz + w * rz) / determinant;
        const bool inside = (lowest >= 0.0f) | (highest <= 0.0f);
        out[i] = (inside & (determinant != 0.0f) & (t >= 0.0f)) ? t : 3.0e38f;
    }
    return out;
""")
def meet(
    ax: vec8,
    ay: vec8,
    az: vec8,
    bx: vec8,
    by: vec8,
    bz: vec8,
    cx: vec8,
    cy: vec8,
    cz: vec8,
    o: wp.vec3,
    s: wp.vec3,
) -> vec8:
    """Where a ray meets each of eight triangles; infinity where it misses."""
    ...


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    // Without fused operations a b - c d and c d - a b are each other's negative: that is what closes the edges.
    #pragma clang fp contract(off)
#endif
    wp::vec_t<8, float> out;
    for (int i = 0; i < 8; ++i) {
        const float pz = az[i] - o[2], px = (ax[i] - o[0]) - s[0] * pz, py = (ay[i] - o[1]) - s[1] * pz;
        const float qz = bz[i] - o[2], qx = (bx[i] - o[0]) - s[0] * qz, qy = (by[i] - o[1]) - s[1] * qz;
        const float rz = cz[i] - o[2], rx = (cx[i] - o[0]) - s[0] * rz, ry = (cy[i] - o[1]) - s[1] * rz;
        const float u = rx * qy - ry * qx, v = px * ry - py * rx, w = qx * py - qy * px;
        const float eu = fabsf(qy - ry) * e[0] + fabsf(qx - rx) * e[1];
        const float ev = fabsf(ry - py) * e[0] + fabsf(rx - px) * e[1];
        const float ew = fabsf(py - qy) * e[0] + fabsf(px - qx) * e[1];
        const float determinant = u + v + w;
        const float t = s[2] * (u * pz + v * qz + w * rz) / determinant;
        const bool inside = ((u >= -eu) & (v >= -ev) & (w >= -ew)) | ((u <= eu) & (v <= ev) & (w <= ew));
        out[i] = (inside & (determinant != 0.0f) & (t >= 0.0f)) ? t : 3.0e38f;
    }
    return out;
""")
def meet_loosely(
    ax: vec8,
    ay: vec8,
    az: vec8,
    bx: vec8,
    by: vec8,
    bz: vec8,
    cx: vec8,
    cy: vec8,
    cz: vec8,
    o: wp.vec3,
    s: wp.vec3,
    e: wp.vec2,
) -> vec8:
    """Likewise, with triangles that are larger by e in the two axes across the ray."""
    ...


@wp.func_native("""
    int mask = 0;
    for (int i = 0; i < 8; ++i) mask |= (t[i] < t_max ? 1 : 0) << i;
    return mask;
""")
def below(t: vec8, t_max: float) -> int:
    """A bit for each lane that is less than t_max."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(mask) - 1;
#else
    return __builtin_ctz(mask);
#endif
""")
def first_lane(mask: int) -> int:
    """The lowest bit that is set; `mask` is not 0."""
    ...
