"""Traversal of an eight-wide tree by one ray, eight boxes or eight triangles at once in vector registers.

Boxes are tested conservatively (Ize 2013), triangles by the sheared edge functions of Woop, Benthin and Wald (2013),
evaluated so that two triangles get the same value for a common edge: the test is watertight.

The functions are C++, for Warp's native functions: Warp clears every local array, here the stack, and tests lanes one
by one.
"""

import warp as wp

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


_INSIDE = """
        const float8 uv_min = u < v ? u : v, uv_max = u > v ? u : v;
        const float8 lowest = uv_min < w ? uv_min : w, highest = uv_max > w ? uv_max : w;
        const auto inside = (lowest >= 0.0f) | (highest <= 0.0f);
"""
_INSIDE_PADDED = """
        const auto absolute = [](float8 a) { return a < 0.0f ? -a : a; };
        const float8 eu = absolute(qy - ry) * ray.padding[0] + absolute(qx - rx) * ray.padding[1];
        const float8 ev = absolute(ry - py) * ray.padding[0] + absolute(rx - px) * ray.padding[1];
        const float8 ew = absolute(py - qy) * ray.padding[0] + absolute(px - qx) * ray.padding[1];
        const auto inside = ((u >= -eu) & (v >= -ev) & (w >= -ew)) | ((u <= eu) & (v <= ev) & (w <= ew));
"""

_STACK_SIZE = 33 * 7 + 1
"""Warp's builders stop at depth 31, the top level adds at most two, and each level leaves at most seven children on the
stack."""

_SOURCE = """
    typedef float float8 __attribute__((ext_vector_type(8), aligned(4)));
    typedef bool bool8 __attribute__((ext_vector_type(8)));
    const auto lanes_of = [](auto condition) {
        return (int)__builtin_bit_cast(unsigned char, __builtin_convertvector(condition, bool8));
    };

    struct Ray {
        float near_origin[3], far_origin[3], inverse[3];  // 1 / direction
        int x, y, z;  // axes, permuted so that z is the direction's largest; the winding is preserved
        float origin[3], shear[3], padding[2];  // origin along x, y, z; (x, y, 1) / z of the direction; along x, y
    };

    // A ray whose coordinates have errors: boxes and triangles are padded by them.
    const auto make_ray = [](const wp::vec3& origin, const wp::vec3& direction, const wp::vec3& error) {
        Ray ray;
        for (int k = 0; k < 3; ++k) {
            float d = direction[k];
            if (fabsf(d) < 1.0e-18f) d = d < 0.0f ? -1.0e-18f : 1.0e-18f;
            ray.inverse[k] = 1.0f / d;
            const float forward = d < 0.0f ? -error[k] : error[k];
            ray.near_origin[k] = origin[k] + forward;
            ray.far_origin[k] = origin[k] - forward;
        }
        int z = fabsf(direction[1]) > fabsf(direction[0]) ? 1 : 0;
        if (fabsf(direction[2]) > fabsf(direction[z])) z = 2;
        const bool backward = direction[z] < 0.0f;
        const int x = (z + (backward ? 2 : 1)) % 3, y = (z + (backward ? 1 : 2)) % 3;
        ray.x = x, ray.y = y, ray.z = z;
        ray.origin[0] = origin[x], ray.origin[1] = origin[y], ray.origin[2] = origin[z];
        ray.shear[0] = direction[x] / direction[z], ray.shear[1] = direction[y] / direction[z];
        ray.shear[2] = 1.0f / direction[z];
        ray.padding[0] = error[x] + fabsf(ray.shear[0]) * error[z];
        ray.padding[1] = error[y] + fabsf(ray.shear[1]) * error[z];
        return ray;
    };

    // Calls `intersect_leaf` for the leaves of a tree that a ray enters before t_max, which it may lower, until it
    // returns true. The nearest child comes first.
    const auto traverse = [lanes_of](
        const auto& tree, int root, const Ray& ray, const float& t_max, const auto& intersect_leaf
    ) {
        const float8* nodes = (const float8*)tree.nodes.data;
        const int near_x = ray.inverse[0] < 0.0f ? 3 : 0, near_y = ray.inverse[1] < 0.0f ? 4 : 1;
        const int near_z = ray.inverse[2] < 0.0f ? 5 : 2;
        // The t of entry, whose bits are ordered as its values are since none is negative; below it node or ~leaf.
        uint64_t stack[STACK_SIZE];
        int depth = 0, node = root;
        while (true) {
            if (node >= 0) {
                const float8* box = nodes + 6 * (int64_t)node;
                const float8 ax = (box[near_x] - ray.near_origin[0]) * ray.inverse[0];
                const float8 ay = (box[near_y] - ray.near_origin[1]) * ray.inverse[1];
                const float8 az = (box[near_z] - ray.near_origin[2]) * ray.inverse[2];
                const float8 bx = (box[3 - near_x] - ray.far_origin[0]) * ray.inverse[0];
                const float8 by = (box[5 - near_y] - ray.far_origin[1]) * ray.inverse[1];
                const float8 bz = (box[7 - near_z] - ray.far_origin[2]) * ray.inverse[2];
                float8 near = ax > ay ? ax : ay;
                near = near > az ? near : az;
                near = near > 0.0f ? near : 0.0f;
                float8 far = bx < by ? bx : by;
                far = (far < bz ? far : bz) * 1.0000004f;
                int lanes = lanes_of((near <= far) & (near < t_max));
                if (lanes != 0) {
                    float t[8];
                    *(float8*)t = near;
                    const auto take_lane = [&]() {
                        const int lane = __builtin_ctz(lanes);
                        lanes &= lanes - 1;
                        return (uint64_t)__builtin_bit_cast(uint32_t, t[lane]) << 32
                            | (uint32_t)tree.children.data[node][lane];
                    };
                    uint64_t nearest = take_lane();
                    while (lanes != 0) {
                        const uint64_t child = take_lane();
                        stack[depth++] = nearest < child ? child : nearest;
                        nearest = nearest < child ? nearest : child;
                    }
                    node = (int)(uint32_t)nearest;
                    continue;
                }
            } else if (intersect_leaf(~node)) {
                return;
            }
            do {
                if (depth == 0) return;
                --depth;
            } while (__builtin_bit_cast(float, (uint32_t)(stack[depth] >> 32)) >= t_max);
            node = (int)(uint32_t)stack[depth];
        }
    };

    // Finds a hit of one of eight triangles before hit.t; whether the search is over.
    const auto intersect_block = [lanes_of](const auto& bvh, int block, const Ray& ray, bool any_hit, auto& hit) {
        // Without fused multiply-add, a b - c d is exactly -(c d - a b): both triangles at an edge get the same value.
        #pragma clang fp contract(off)
        const float8* a = (const float8*)bvh.blocks.data + 9 * (int64_t)block, *b = a + 3, *c = a + 6;
        const float* o = ray.origin, *shear = ray.shear;
        const int x = ray.x, y = ray.y, z = ray.z;
        const float8 pz = a[z] - o[2], px = (a[x] - o[0]) - shear[0] * pz, py = (a[y] - o[1]) - shear[1] * pz;
        const float8 qz = b[z] - o[2], qx = (b[x] - o[0]) - shear[0] * qz, qy = (b[y] - o[1]) - shear[1] * qz;
        const float8 rz = c[z] - o[2], rx = (c[x] - o[0]) - shear[0] * rz, ry = (c[y] - o[1]) - shear[1] * rz;
        const float8 u = rx * qy - ry * qx, v = px * ry - py * rx, w = qx * py - qy * px;
INSIDE
        if (lanes_of(inside) == 0) return false;
        const float8 determinant = u + v + w;
        const float8 t = shear[2] * (u * pz + v * qz + w * rz) / determinant;
        int lanes = lanes_of(inside & (determinant != 0.0f) & (t >= 0.0f) & (t < hit.t));
        if (lanes == 0) return false;
        if (any_hit) {
            hit.triangle = 0;
            return true;
        }
        for (; lanes != 0; lanes &= lanes - 1) {
            const int lane = __builtin_ctz(lanes);
            if (t[lane] < hit.t) {
                hit.t = t[lane];
                hit.triangle = bvh.triangles.data[block][lane];
                hit.u = u[lane] / determinant[lane];
                hit.v = v[lane] / determinant[lane];
                hit.front = determinant[lane] > 0.0f ? 1 : 0;
            }
        }
        return false;
    };

    // Finds the closest triangle of one tree before hit.t, or with `any_hit` any one, which is then called 0.
    const auto intersect_tree = [&](const auto& bvh, int root, const Ray& ray, bool any_hit, auto& hit) {
        traverse(bvh, root, ray, hit.t, [&](int first_block) {
            for (int block = first_block;; ++block) {
                if (intersect_block(bvh, block, ray, any_hit, hit)) return true;
                if (bvh.continues.data[block] == 0) return false;
            }
        });
    };
"""


def traversal_source(*, padded: bool) -> str:
    """C++ definitions for a native function on the CPU: `make_ray`, `traverse`, `intersect_tree`.

    Triangles are padded by the ray's errors if `padded`, boxes always: a test that nothing is added to is faster.
    """
    source = _SOURCE.replace("STACK_SIZE", str(_STACK_SIZE))
    return source.replace("INSIDE", (_INSIDE_PADDED if padded else _INSIDE).strip("\n"))
