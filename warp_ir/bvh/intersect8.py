"""Intersection of one ray with eight boxes or eight triangles at once, in vector registers.

Boxes are tested conservatively (Ize 2013), triangles by the sheared edge functions of Woop, Benthin and Wald (2013),
evaluated so that two triangles get the same value for a common edge: the test is watertight.
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
    """Whether the code is compiled for CUDA: a constant, so the branch not taken is removed."""
    ...


@wp.func
def safe_reciprocal(direction: wp.vec3) -> wp.vec3:
    """1 over each component; components smaller than 1e-18 are replaced by that with their sign."""
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
        const float ax = (near_x[i] - near_origin[0]) * inverse[0], bx = (far_x[i] - far_origin[0]) * inverse[0];
        const float ay = (near_y[i] - near_origin[1]) * inverse[1], by = (far_y[i] - far_origin[1]) * inverse[1];
        const float az = (near_z[i] - near_origin[2]) * inverse[2], bz = (far_z[i] - far_origin[2]) * inverse[2];
        float near = ax > ay ? ax : ay;
        near = near > az ? near : az;
        near = near > 0.0f ? near : 0.0f;
        float far = bx < by ? bx : by;
        far = (far < bz ? far : bz) * 1.0000004f;
        t[i] = near <= far ? near : 3.0e38f;
    }
    return t;
""")
def intersect_boxes(
    near_x: vec8,
    near_y: vec8,
    near_z: vec8,
    far_x: vec8,
    far_y: vec8,
    far_z: vec8,
    near_origin: wp.vec3,
    far_origin: wp.vec3,
    inverse: wp.vec3,
) -> vec8:
    """The distance t at which a ray enters each of eight boxes; infinity if it misses.

    `inverse` is 1 / direction. Both origins are the ray's, unless the boxes are padded: then `near_origin` is moved
    forward by the padding in each axis, and `far_origin` back.
    """
    ...


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    // Without fused multiply-add, a b - c d is exactly -(c d - a b): both triangles at an edge get the same value.
    #pragma clang fp contract(off)
#endif
    wp::vec_t<8, float> out;
    for (int i = 0; i < 8; ++i) {
        const float pz = az[i] - origin[2], px = (ax[i] - origin[0]) - shear[0] * pz,
                    py = (ay[i] - origin[1]) - shear[1] * pz;
        const float qz = bz[i] - origin[2], qx = (bx[i] - origin[0]) - shear[0] * qz,
                    qy = (by[i] - origin[1]) - shear[1] * qz;
        const float rz = cz[i] - origin[2], rx = (cx[i] - origin[0]) - shear[0] * rz,
                    ry = (cy[i] - origin[1]) - shear[1] * rz;
        const float u = rx * qy - ry * qx, v = px * ry - py * rx, w = qx * py - qy * px;
        const float uv_min = u < v ? u : v, uv_max = u > v ? u : v;
        const float lowest = uv_min < w ? uv_min : w, highest = uv_max > w ? uv_max : w;
        const float determinant = u + v + w;
        const float t = shear[2] * (u * pz + v * qz + w * rz) / determinant;
        const bool inside = (lowest >= 0.0f) | (highest <= 0.0f);
        out[i] = (inside & (determinant != 0.0f) & (t >= 0.0f)) ? t : 3.0e38f;
    }
    return out;
""")
def intersect_triangles(
    ax: vec8,
    ay: vec8,
    az: vec8,
    bx: vec8,
    by: vec8,
    bz: vec8,
    cx: vec8,
    cy: vec8,
    cz: vec8,
    origin: wp.vec3,
    shear: wp.vec3,
) -> vec8:
    """The distance t at which a ray hits each of eight triangles; infinity if it misses.

    Axes are permuted so that z is the direction's largest; `shear` is (x, y, 1) / z of the direction.
    """
    ...


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    // Without fused multiply-add, a b - c d is exactly -(c d - a b): both triangles at an edge get the same value.
    #pragma clang fp contract(off)
#endif
    wp::vec_t<8, float> out;
    for (int i = 0; i < 8; ++i) {
        const float pz = az[i] - origin[2], px = (ax[i] - origin[0]) - shear[0] * pz,
                    py = (ay[i] - origin[1]) - shear[1] * pz;
        const float qz = bz[i] - origin[2], qx = (bx[i] - origin[0]) - shear[0] * qz,
                    qy = (by[i] - origin[1]) - shear[1] * qz;
        const float rz = cz[i] - origin[2], rx = (cx[i] - origin[0]) - shear[0] * rz,
                    ry = (cy[i] - origin[1]) - shear[1] * rz;
        const float u = rx * qy - ry * qx, v = px * ry - py * rx, w = qx * py - qy * px;
        const float eu = fabsf(qy - ry) * padding[0] + fabsf(qx - rx) * padding[1];
        const float ev = fabsf(ry - py) * padding[0] + fabsf(rx - px) * padding[1];
        const float ew = fabsf(py - qy) * padding[0] + fabsf(px - qx) * padding[1];
        const float determinant = u + v + w;
        const float t = shear[2] * (u * pz + v * qz + w * rz) / determinant;
        const bool inside = ((u >= -eu) & (v >= -ev) & (w >= -ew)) | ((u <= eu) & (v <= ev) & (w <= ew));
        out[i] = (inside & (determinant != 0.0f) & (t >= 0.0f)) ? t : 3.0e38f;
    }
    return out;
""")
def intersect_padded_triangles(
    ax: vec8,
    ay: vec8,
    az: vec8,
    bx: vec8,
    by: vec8,
    bz: vec8,
    cx: vec8,
    cy: vec8,
    cz: vec8,
    origin: wp.vec3,
    shear: wp.vec3,
    padding: wp.vec2,
) -> vec8:
    """As `intersect_triangles`, with every triangle padded by `padding` in the two axes across the ray."""
    ...


@wp.func_native("""
    int mask = 0;
    for (int i = 0; i < 8; ++i) mask |= (t[i] < t_max ? 1 : 0) << i;
    return mask;
""")
def lanes_below(t: vec8, t_max: float) -> int:
    """A bit mask of the lanes that are less than t_max."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(mask) - 1;
#else
    return __builtin_ctz(mask);
#endif
""")
def first_lane(mask: int) -> int:
    """The index of the lowest set bit; `mask` is not 0."""
    ...
