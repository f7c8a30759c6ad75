"""Access to the nodes of the binary BVHs that Warp builds (`wp::BVH` in Warp's bvh.h), and rays through them."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func_native("return (uint64_t)&((const wp::Mesh*)mesh)->bvh;")
def tree_of_mesh(mesh: wp.uint64) -> wp.uint64:
    """The address of a mesh's tree; for a `wp.Bvh` it is the id itself."""
    ...


@wp.func_native("""
    const wp::BVHPackedNodeHalf& n = upper ? ((const wp::BVH*)tree)->node_uppers[node]
                                           : ((const wp::BVH*)tree)->node_lowers[node];
    return wp::vec3(n.x, n.y, n.z);
""")
def box_corner(tree: wp.uint64, node: int, upper: int) -> wp.vec3:
    """The lower (`upper` 0) or upper (1) corner of a node's box."""
    ...


@wp.func_native("""
    const wp::BVH& bvh = *(const wp::BVH*)tree;
    return (int)(upper ? bvh.node_uppers[node].i : bvh.node_lowers[node].i);
""")
def child_or_range(tree: wp.uint64, node: int, upper: int) -> int:
    """The left (`upper` 0) or right (1) child of an inner node; the begin (0) or end (1) of a leaf's primitives."""
    ...


@wp.func_native("return (int)((const wp::BVH*)tree)->node_lowers[node].b;")
def is_leaf(tree: wp.uint64, node: int) -> int:
    """1 if a node holds primitives, 0 if it has children."""
    ...


@wp.func_native("return ((const wp::BVH*)tree)->primitive_indices[i];")
def primitive_at(tree: wp.uint64, i: int) -> int:
    """The primitive at position i in the order of the leaves."""
    ...


@wp.func_native("return *((const wp::BVH*)tree)->root;")
def root_node(tree: wp.uint64) -> int:
    """The index of the root node."""
    ...


@wp.func_native("return ((const wp::BVH*)tree)->num_nodes;")
def node_count(tree: wp.uint64) -> int:
    """The number of nodes."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const auto product = [](float a, float b) { return __fmul_rn(a, b); };
    const auto difference = [](float a, float b) { return __fsub_rn(a, b); };
    const auto load = [](const wp::BVHPackedNodeHalf* half) {  // 16 bytes at once
        static_assert(sizeof(wp::BVHPackedNodeHalf) == sizeof(float4));
        const float4 v = __ldg(reinterpret_cast<const float4*>(half));
        wp::BVHPackedNodeHalf out;
        out.x = v.x, out.y = v.y, out.z = v.z;
        out.i = __float_as_uint(v.w) & 0x7FFFFFFFu, out.b = __float_as_uint(v.w) >> 31;
        return out;
    };
#else
    #pragma clang fp contract(off)
    const auto product = [](float a, float b) { return a * b; };
    const auto difference = [](float a, float b) { return a - b; };
    const auto load = [](const wp::BVHPackedNodeHalf* half) { return *half; };
#endif
    const wp::Mesh& triangles = *(const wp::Mesh*)mesh;
    const wp::BVH& bvh = triangles.bvh;
    const float sx = direction[x] / direction[z], sy = direction[y] / direction[z], sz = 1.0f / direction[z];
    // Looked up once: an index that is not constant keeps a vector out of registers.
    const float ox = origin[x], oy = origin[y], oz = origin[z];
    const float pad_x = error[x] + fabsf(sx) * error[z], pad_y = error[y] + fabsf(sy) * error[z];
    wp::vec_t<4, double> hit(-1.0, t_max, 0.0, 0.0);
    // Warp's trees have at most 32 levels.
    int stack[34];
    float stack_t[34];
    stack[0] = *bvh.root;
    stack_t[0] = 0.0f;
    int depth = 1;
    while (depth > 0) {
        const int node = stack[--depth];
        if (stack_t[depth] >= t_max) continue;
        const wp::BVHPackedNodeHalf first = load(bvh.node_lowers + node), second = load(bvh.node_uppers + node);
        if (first.b) {
            for (int i = first.i; i < (int)second.i; ++i) {
                const int triangle = bvh.primitive_indices[i];
                float px[3], py[3], pz[3];
                for (int k = 0; k < 3; ++k) {
                    const wp::vec3& corner = triangles.points[triangles.indices[3 * triangle + k]];
                    pz[k] = difference(corner[z], oz);
                    px[k] = difference(difference(corner[x], ox), product(sx, pz[k]));
                    py[k] = difference(difference(corner[y], oy), product(sy, pz[k]));
                }
                const float u = difference(product(px[2], py[1]), product(py[2], px[1]));
                const float v = difference(product(px[0], py[2]), product(py[0], px[2]));
                const float w = difference(product(px[1], py[0]), product(py[1], px[0]));
                const float eu = fabsf(py[1] - py[2]) * pad_x + fabsf(px[1] - px[2]) * pad_y;
                const float ev = fabsf(py[2] - py[0]) * pad_x + fabsf(px[2] - px[0]) * pad_y;
                const float ew = fabsf(py[0] - py[1]) * pad_x + fabsf(px[0] - px[1]) * pad_y;
                const bool inside = ((u >= -eu) & (v >= -ev) & (w >= -ew)) | ((u <= eu) & (v <= ev) & (w <= ew));
                const float determinant = u + v + w;
                if (!inside || determinant == 0.0f) continue;
                const float t = sz * (u * pz[0] + v * pz[1] + w * pz[2]) / determinant;
                if (t >= 0.0f && t < t_max) {
                    t_max = t;
                    hit = wp::vec_t<4, double>(determinant > 0.0f ? 2.0 * triangle + 1.0 : 2.0 * triangle, t,
                                               u / determinant, v / determinant);
                    if (any_hit) return hit;
                }
            }
        } else {
            const int children[2] = {(int)first.i, (int)second.i};
            float t[2];
            for (int k = 0; k < 2; ++k) {
                const wp::BVHPackedNodeHalf lower = load(bvh.node_lowers + children[k]);
                const wp::BVHPackedNodeHalf upper = load(bvh.node_uppers + children[k]);
                const float low[3] = {lower.x, lower.y, lower.z}, high[3] = {upper.x, upper.y, upper.z};
                float near = 0.0f, far = 3.0e38f;
                for (int axis = 0; axis < 3; ++axis) {
                    const float padding = error[axis];
                    const float a = (low[axis] - padding - origin[axis]) * inverse[axis];
                    const float b = (high[axis] + padding - origin[axis]) * inverse[axis];
                    near = wp::max(near, wp::min(a, b));
                    far = wp::min(far, wp::max(a, b));
                }
                t[k] = near <= far * 1.0000004f ? near : 3.0e38f;
            }
            const int nearer = t[1] < t[0] ? 1 : 0;
            for (int k = 1; k >= 0; --k) {
                const int child = k ^ nearer;
                if (t[child] < t_max) {
                    stack[depth] = children[child];
                    stack_t[depth++] = t[child];
                }
            }
        }
    }
    return hit;
""")
def intersect_mesh(
    mesh: wp.uint64,
    origin: wp.vec3,
    direction: wp.vec3,
    inverse: wp.vec3,
    x: int,
    y: int,
    z: int,
    t_max: float,
    any_hit: bool,
    error: wp.vec3,
) -> wp.vec4d:
    """The closest triangle of a `wp.Mesh` before t_max, tested as in `intersect8.py`: Warp's own query leaks at edges.

    x, y and z permute the axes so that z is the direction's largest, and preserve the winding; `inverse` is 1 /
    direction; boxes and triangles are padded by `error`. Products and differences are not contracted on CUDA either.

    Returns:
        2 · triangle + (1 if the ray hits its front), t, and the barycentric weights of the first two corners; -1 first
        if there is none. float64 holds every triangle's number.
    """
    ...
