"""Rays against triangles.

On CUDA this is Warp's own mesh query. On the CPU, where that query is scalar code on a binary tree, the same tree is
laid out anew, eight children or eight triangles side by side, and a ray meets eight at a time in vector registers
(Wald, Benthin and Boulos 2008: "Getting Rid of Packets"). Boxes are tested conservatively (Ize 2013) and
triangles by the sheared edge functions of Woop, Benthin and Wald (2013), evaluated so that two triangles
get the same value for a common edge: no ray slips between them.

What is seen in many places is stored once: a second tree, over the boxes of its instances, leads rays into the
hierarchy of the prototype, in whose space they go on. There, boxes and triangles are larger by what the ray's way in
is rounded by: so none slips between two instances either.
"""

from collections.abc import Sequence
from typing import Any

import warp as wp

from warp_ir.launch import Launcher

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_LANES = wp.constant(8)
_LEAF_SIZE = 8
_INFINITY = wp.constant(3.0e38)
_TINY = wp.constant(1.0e-18)
_ULP = wp.constant(2.0**-23)
# Warp's builders stop at depth 31, and a node leaves at most seven children behind on the stack.
_STACK = wp.constant(224)

vec8 = wp.types.vector(length=8, dtype=wp.float32)
vec8i = wp.types.vector(length=8, dtype=wp.int32)


@wp.struct
class Bvh:
    """Hierarchies over triangles: of the world, and of each prototype. On CUDA the meshes count, else the tables."""

    mesh: wp.uint64  # of the world
    prototypes: wp.array[wp.uint64]  # meshes of the prototypes
    nodes: wp.array[vec8]  # six rows per node: lower x, y, z, upper x, y, z of its children
    children: wp.array[vec8i]  # per node; a node, or ~block, or -2³¹ for none
    blocks: wp.array[vec8]  # nine rows per block of triangles: x, y, z of the first corner, the second, the third
    triangles: wp.array[vec8i]  # per block, their indices; -1 for none
    chained: wp.array[wp.int32]  # per block, 1 if its leaf goes on in the next


@wp.struct
class Instance:
    """Where a prototype is seen, and what a ray needs to know on its way in: local = inverse (world - centre)."""

    inverse: wp.mat33
    centre: wp.vec3
    size: float  # of the coordinates that rays are computed with on their way in and out, in the scene's space
    root: int  # of its prototype: a node on the CPU, an index into the prototypes on CUDA
    shift: int  # from the triangles of the hierarchy to the instance's own rows in the triangle tables


@wp.struct
class InstanceTree:
    """A hierarchy over the boxes of instances. On CUDA `bvh` counts, on the CPU the tables."""

    bvh: wp.uint64
    nodes: wp.array[vec8]  # as in `Bvh`
    children: wp.array[vec8i]  # per node; a node, or ~slot, or -2³¹ for none
    slots: wp.array[wp.int32]  # instances in the order of the leaves
    chained: wp.array[wp.int32]  # per slot, 1 if its leaf goes on in the next
    instances: wp.array[Instance]


@wp.struct
class TwoLevel:
    """What a ray needs to find its way through instances."""

    bvh: Bvh
    tree: InstanceTree


@wp.struct
class RayHit:
    """The nearest triangle along a ray; `triangle` is -1 if there is none."""

    triangle: int
    instance: int  # of which it is part; -1: it is in the world as it stands
    t: float  # in units of the ray's direction
    u: float  # weights of the first and the second corner
    v: float
    front: int  # 1 if the ray meets the side from which the triangle is wound counter-clockwise


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return true;
#else
    return false;
#endif
""")
def _on_cuda() -> bool:
    """Known at compile time: the other way costs nothing."""
    ...


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
def _enter(
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
def _meet(
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
def _meet_loosely(
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
def _below(t: vec8, t_max: float) -> int:
    """A bit for each lane that is less than t_max."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(mask) - 1;
#else
    return __builtin_ctz(mask);
#endif
""")
def _first_lane(mask: int) -> int:
    """The lowest bit that is set; `mask` is not 0."""
    ...


def _hierarchy(name: str, loose: bool) -> Any:
    """The function that follows a ray through a hierarchy, whose boxes and triangles are larger if it is loose."""

    @wp.func(name=name + "_walk")
    def walk(
        bvh: Bvh, root: int, origin: wp.vec3, direction: wp.vec3, t_max: float, any_hit: bool, error: wp.vec3
    ) -> RayHit:
        """The CPU's part, apart from CUDA's: where it is not called, its stack takes no memory either."""
        hit = RayHit()
        hit.triangle = -1
        hit.instance = -1
        hit.t = t_max
        inverse = _reciprocal(direction)
        near_x = wp.where(inverse[0] < 0.0, 3, 0)
        near_y = wp.where(inverse[1] < 0.0, 4, 1)
        near_z = wp.where(inverse[2] < 0.0, 5, 2)

        # The axes permuted so that z is the one the ray follows most, keeping the winding.
        z = int(0)
        if wp.abs(direction[1]) > wp.abs(direction[0]):
            z = 1
        if wp.abs(direction[2]) > wp.abs(direction[z]):
            z = 2
        x = (z + 1) % 3
        y = (z + 2) % 3
        if direction[z] < 0.0:
            x = (z + 2) % 3
            y = (z + 1) % 3
        shear = wp.vec3(direction[x], direction[y], 1.0) / direction[z]
        o = wp.vec3(origin[x], origin[y], origin[z])

        ahead = origin
        behind = origin
        across = wp.vec2(0.0)
        if wp.static(loose):
            ahead += wp.vec3(
                wp.sign(inverse[0]) * error[0], wp.sign(inverse[1]) * error[1], wp.sign(inverse[2]) * error[2]
            )
            behind = origin - (ahead - origin)
            across = wp.vec2(error[x] + wp.abs(shear[0]) * error[z], error[y] + wp.abs(shear[1]) * error[z])

        best_block = int(-1)
        best_lane = int(0)
        todo = wp.zeros(shape=_STACK, dtype=wp.int32)
        todo_t = wp.zeros(shape=_STACK, dtype=wp.float32)
        todo[0] = root
        depth = int(1)
        while depth > 0:
            depth -= 1
            node = todo[depth]
            if todo_t[depth] >= hit.t:
                continue
            if node < 0:
                block = ~node
                more = int(1)
                while more == 1:
                    base = 9 * block
                    ax = bvh.blocks[base + x]
                    ay = bvh.blocks[base + y]
                    az = bvh.blocks[base + z]
                    bx = bvh.blocks[base + 3 + x]
                    by = bvh.blocks[base + 3 + y]
                    bz = bvh.blocks[base + 3 + z]
                    cx = bvh.blocks[base + 6 + x]
                    cy = bvh.blocks[base + 6 + y]
                    cz = bvh.blocks[base + 6 + z]
                    if wp.static(loose):
                        t = _meet_loosely(ax, ay, az, bx, by, bz, cx, cy, cz, o, shear, across)
                    else:
                        t = _meet(ax, ay, az, bx, by, bz, cx, cy, cz, o, shear)
                    mask = _below(t, hit.t)
                    while mask != 0:
                        lane = _first_lane(mask)
                        mask = mask & (mask - 1)
                        if t[lane] < hit.t:
                            hit.t = t[lane]
                            best_block = block
                            best_lane = lane
                    more = bvh.chained[block]
                    block += 1
                if any_hit and best_block >= 0:
                    hit.triangle = 0
                    return hit
            else:
                base = 6 * node
                t = _enter(
                    bvh.nodes[base + near_x],
                    bvh.nodes[base + near_y],
                    bvh.nodes[base + near_z],
                    bvh.nodes[base + 3 - near_x],
                    bvh.nodes[base + 5 - near_y],
                    bvh.nodes[base + 7 - near_z],
                    ahead,
                    behind,
                    inverse,
                )
                mask = _below(t, hit.t)
                children = bvh.children[node]
                bottom = depth
                while mask != 0:
                    lane = _first_lane(mask)
                    mask = mask & (mask - 1)
                    # Sorted in, so that the nearest comes off first.
                    place = depth
                    while place > bottom and todo_t[place - 1] < t[lane]:
                        todo_t[place] = todo_t[place - 1]
                        todo[place] = todo[place - 1]
                        place -= 1
                    todo_t[place] = t[lane]
                    todo[place] = children[lane]
                    depth += 1
        if best_block >= 0:
            hit.triangle = bvh.triangles[best_block][best_lane]
            base = 9 * best_block
            a = _sheared(bvh, base, best_lane, x, y, z, o, shear)
            b = _sheared(bvh, base + 3, best_lane, x, y, z, o, shear)
            c = _sheared(bvh, base + 6, best_lane, x, y, z, o, shear)
            u = c[0] * b[1] - c[1] * b[0]
            v = a[0] * c[1] - a[1] * c[0]
            determinant = u + v + (b[0] * a[1] - b[1] * a[0])
            hit.u = u / determinant
            hit.v = v / determinant
            hit.front = wp.where(determinant > 0.0, 1, 0)
        return hit

    @wp.func(name=name)
    def hierarchy(
        bvh: Bvh,
        mesh: wp.uint64,
        root: int,
        origin: wp.vec3,
        direction: wp.vec3,
        t_max: float,
        any_hit: bool,
        error: wp.vec3,
    ) -> RayHit:
        """The nearest triangle of one hierarchy, which is `mesh` on CUDA and begins at `root` on the CPU.

        `error` is how far the ray may be off in each axis, if the hierarchy is loose.
        """
        hit = RayHit()
        hit.triangle = -1
        hit.instance = -1
        hit.t = t_max
        if _on_cuda():
            if any_hit:
                if wp.mesh_query_ray_anyhit(mesh, origin, direction, t_max):
                    hit.triangle = 0
            else:
                query = wp.mesh_query_ray(mesh, origin, direction, t_max)
                if query.result:
                    hit.triangle = query.face
                    hit.t = query.t
                    hit.u = query.u
                    hit.v = query.v
                    hit.front = wp.where(wp.dot(query.normal, direction) < 0.0, 1, 0)
            return hit
        return walk(bvh, root, origin, direction, t_max, any_hit, error)

    return hierarchy


_through_world = _hierarchy("through_world", False)
_through_prototype = _hierarchy("through_prototype", True)


@wp.func
def intersect(bvh: Bvh, origin: wp.vec3, direction: wp.vec3, t_max: float, any_hit: bool) -> RayHit:
    """The nearest triangle of the world along a ray before t_max; with `any_hit` some, without its coordinates."""
    return _through_world(bvh, bvh.mesh, 0, origin, direction, t_max, any_hit, wp.vec3(0.0))


@wp.func
def _reciprocal(direction: wp.vec3) -> wp.vec3:
    inverse = wp.vec3()
    for k in range(3):
        d = direction[k]
        if wp.abs(d) < _TINY:
            d = wp.where(d < 0.0, -_TINY, _TINY)
        inverse[k] = 1.0 / d
    return inverse


@wp.func
def _sheared(bvh: Bvh, row: int, lane: int, x: int, y: int, z: int, o: wp.vec3, shear: wp.vec3) -> wp.vec2:
    """A corner in the plane across the ray, around it."""
    height = bvh.blocks[row + z][lane] - o[2]
    return wp.vec2(
        bvh.blocks[row + x][lane] - o[0] - shear[0] * height, bvh.blocks[row + y][lane] - o[1] - shear[1] * height
    )


@wp.func
def _enter_instance(
    bvh: Bvh, tree: InstanceTree, number: int, origin: wp.vec3, direction: wp.vec3, t_max: float, any_hit: bool
) -> RayHit:
    """The nearest triangle of one instance; the ray keeps its parameter t in the prototype's space."""
    instance = tree.instances[number]
    mesh = bvh.mesh
    if _on_cuda():
        mesh = bvh.prototypes[instance.root]
    from_centre = origin - instance.centre
    o = instance.inverse * from_centre
    d = instance.inverse * direction
    ulp = (instance.size + wp.max(wp.abs(from_centre))) * _ULP
    error = wp.vec3(0.0)
    for k in range(3):
        error[k] = ulp * (
            wp.abs(instance.inverse[k, 0]) + wp.abs(instance.inverse[k, 1]) + wp.abs(instance.inverse[k, 2])
        )
    hit = _through_prototype(bvh, mesh, instance.root, o, d, t_max, any_hit, error)
    if hit.triangle >= 0:
        hit.triangle += instance.shift
        hit.instance = number
    return hit


@wp.func
def _walk_instances(
    bvh: Bvh, tree: InstanceTree, origin: wp.vec3, direction: wp.vec3, t_max: float, any_hit: bool
) -> RayHit:
    """The CPU's part, as above."""
    hit = RayHit()
    hit.triangle = -1
    hit.instance = -1
    hit.t = t_max
    inverse = _reciprocal(direction)
    near_x = wp.where(inverse[0] < 0.0, 3, 0)
    near_y = wp.where(inverse[1] < 0.0, 4, 1)
    near_z = wp.where(inverse[2] < 0.0, 5, 2)
    todo = wp.zeros(shape=_STACK, dtype=wp.int32)
    todo_t = wp.zeros(shape=_STACK, dtype=wp.float32)
    depth = int(1)
    while depth > 0:
        depth -= 1
        node = todo[depth]
        if todo_t[depth] >= hit.t:
            continue
        if node < 0:
            slot = ~node
            more = int(1)
            while more == 1:
                found = _enter_instance(bvh, tree, tree.slots[slot], origin, direction, hit.t, any_hit)
                if found.triangle >= 0:
                    hit = found
                    if any_hit:
                        return hit
                more = tree.chained[slot]
                slot += 1
        else:
            base = 6 * node
            t = _enter(
                tree.nodes[base + near_x],
                tree.nodes[base + near_y],
                tree.nodes[base + near_z],
                tree.nodes[base + 3 - near_x],
                tree.nodes[base + 5 - near_y],
                tree.nodes[base + 7 - near_z],
                origin,
                origin,
                inverse,
            )
            mask = _below(t, hit.t)
            children = tree.children[node]
            bottom = depth
            while mask != 0:
                lane = _first_lane(mask)
                mask = mask & (mask - 1)
                place = depth
                while place > bottom and todo_t[place - 1] < t[lane]:
                    todo_t[place] = todo_t[place - 1]
                    todo[place] = todo[place - 1]
                    place -= 1
                todo_t[place] = t[lane]
                todo[place] = children[lane]
                depth += 1
    return hit


@wp.func(inline=False)
def intersect_instances(
    scene: wp.array[TwoLevel], origin: wp.vec3, direction: wp.vec3, t_max: float, any_hit: bool
) -> RayHit:
    """The nearest triangle of any instance before t_max; with `any_hit` some, without its coordinates.

    `scene` has one row, and is no struct, for a struct that a call needs would be copied by every ray, even by those of
    scenes without instances.
    """
    bvh = scene[0].bvh
    tree = scene[0].tree
    hit = RayHit()
    hit.triangle = -1
    hit.instance = -1
    hit.t = t_max
    number = int(0)
    if _on_cuda():
        query = wp.bvh_query_ray(tree.bvh, origin, direction)
        while wp.bvh_query_next(query, number, hit.t):
            found = _enter_instance(bvh, tree, number, origin, direction, hit.t, any_hit)
            if found.triangle >= 0:
                hit = found
                if any_hit:
                    return hit
        return hit
    return _walk_instances(bvh, tree, origin, direction, t_max, any_hit)


@wp.func_native("return (uint64_t)&((const wp::Mesh*)mesh)->bvh;")
def _tree_of(mesh: wp.uint64) -> wp.uint64:
    """Where the tree of a mesh lies; a `wp.Bvh`'s id is that itself."""
    ...


@wp.func_native("""
    const wp::BVHPackedNodeHalf& n = upper ? ((const wp::BVH*)tree)->node_uppers[node]
                                           : ((const wp::BVH*)tree)->node_lowers[node];
    return wp::vec3(n.x, n.y, n.z);
""")
def _corner(tree: wp.uint64, node: int, upper: int) -> wp.vec3: ...


@wp.func_native("""
    const wp::BVH& bvh = *(const wp::BVH*)tree;
    return (int)(upper ? bvh.node_uppers[node].i : bvh.node_lowers[node].i);
""")
def _link(tree: wp.uint64, node: int, upper: int) -> int:
    """Left or right child of an inner node; begin or end of a leaf's primitives."""
    ...


@wp.func_native("return (int)((const wp::BVH*)tree)->node_lowers[node].b;")
def _is_leaf(tree: wp.uint64, node: int) -> int: ...


@wp.func_native("return ((const wp::BVH*)tree)->primitive_indices[i];")
def _primitive(tree: wp.uint64, i: int) -> int: ...


@wp.func_native("return *((const wp::BVH*)tree)->root;")
def _root(tree: wp.uint64) -> int: ...


@wp.func_native("return ((const wp::BVH*)tree)->num_nodes;")
def _node_count(tree: wp.uint64) -> int: ...


@wp.kernel
def _locate(first: int, mesh: wp.uint64, out: wp.array[wp.uint64]) -> None:
    """Warp's tree over a mesh."""
    out[0] = _tree_of(mesh)


@wp.kernel
def _describe(first: int, tree: wp.uint64, out: wp.array[wp.int32]) -> None:
    """The root and the number of nodes of Warp's tree."""
    out[0] = _root(tree)
    out[1] = _node_count(tree)


@wp.kernel
def _count_blocks(first: int, tree: wp.uint64, lanes: int, counts: wp.array[wp.int32]) -> None:
    """How many blocks of so many primitives a node of Warp's tree needs: none if it is no leaf."""
    node = first + wp.tid()
    counts[node] = 0
    if _is_leaf(tree, node) == 1:
        counts[node] = (_link(tree, node, 1) - _link(tree, node, 0) + lanes - 1) // lanes


@wp.kernel
def _fill_slots(first: int, tree: wp.uint64, first_slot: wp.array[wp.int32], instances: InstanceTree) -> None:
    """Writes a leaf's instances one after the other."""
    node = first + wp.tid()
    if _is_leaf(tree, node) == 0:
        return
    begin = _link(tree, node, 0)
    end = _link(tree, node, 1)
    for i in range(begin, end):
        instances.slots[first_slot[node] + i - begin] = _primitive(tree, i)
        instances.chained[first_slot[node] + i - begin] = wp.where(i + 1 < end, 1, 0)


@wp.kernel
def _fill_blocks(
    first: int,
    tree: wp.uint64,
    points: wp.array[wp.vec3],
    indices: wp.array[wp.int32],
    first_block: wp.array[wp.int32],
    bvh: Bvh,
) -> None:
    """Writes a leaf's triangles side by side; lanes left over hold a triangle that no ray meets."""
    node = first + wp.tid()
    if _is_leaf(tree, node) == 0:
        return
    begin = _link(tree, node, 0)
    end = _link(tree, node, 1)
    block = first_block[node]
    while begin < end:
        for lane in range(8):
            triangle = int(-1)
            if begin + lane < end:
                triangle = _primitive(tree, begin + lane)
            for corner in range(3):
                p = wp.vec3(0.0)
                if triangle >= 0:
                    p = points[indices[3 * triangle + corner]]
                for axis in range(3):
                    bvh.blocks[9 * block + 3 * corner + axis][lane] = p[axis]
            bvh.triangles[block][lane] = triangle
        begin += _LANES
        bvh.chained[block] = wp.where(begin < end, 1, 0)
        block += 1


@wp.func
def _area(tree: wp.uint64, node: int) -> float:
    d = _corner(tree, node, 1) - _corner(tree, node, 0)
    return d[0] * d[1] + d[1] * d[2] + d[2] * d[0]


@wp.kernel
def _collapse(
    first: int,
    tree: wp.uint64,
    sources: wp.array[wp.int32],
    first_block: wp.array[wp.int32],
    base: int,
    level: Bvh,
    counts: wp.array[wp.int32],
) -> None:
    """Makes a wide node of a binary one: opens the largest inner node below it until there are eight children."""
    i = first + wp.tid()
    chosen = vec8i(-1)
    chosen[0] = sources[i]
    size = int(1)
    opening = int(0)
    while opening >= 0:
        node = chosen[opening]
        if _is_leaf(tree, node) == 0:
            chosen[opening] = _link(tree, node, 0)
            chosen[size] = _link(tree, node, 1)
            size += 1
        opening = int(-1)
        largest = float(-1.0)
        if size < _LANES:
            for k in range(size):
                if _is_leaf(tree, chosen[k]) == 0 and _area(tree, chosen[k]) > largest:
                    largest = _area(tree, chosen[k])
                    opening = k
    inner = int(0)
    for k in range(8):
        lower = wp.vec3(_INFINITY)
        upper = wp.vec3(-_INFINITY)
        if k < size:
            lower = _corner(tree, chosen[k], 0)
            upper = _corner(tree, chosen[k], 1)
            if _is_leaf(tree, chosen[k]) == 1:
                chosen[k] = ~(base + first_block[chosen[k]])
            else:
                inner += 1
        for axis in range(3):
            level.nodes[6 * i + axis][k] = lower[axis]
            level.nodes[6 * i + 3 + axis][k] = upper[axis]
    level.children[i] = chosen
    counts[i] = inner


@wp.kernel
def _number(
    first: int,
    level: Bvh,
    ends: wp.array[wp.int32],
    counts: wp.array[wp.int32],
    base: int,
    sources: wp.array[wp.int32],
) -> None:
    """Gives the inner children of a level their numbers, and lists them as the next level's sources."""
    i = first + wp.tid()
    slot = ends[i] - counts[i]
    children = level.children[i]
    for k in range(8):
        if children[k] >= 0:
            sources[slot] = children[k]
            children[k] = base + slot
            slot += 1
    level.children[i] = children


def build_bvh(points: Any, indices: Any, launcher: Launcher) -> tuple[Any, Any]:
    """A `Bvh` over the triangles of the world alone, and the object that owns it; see `build_bvhs`."""
    bvh, _, owner = build_bvhs([(points, indices)], launcher)
    return bvh, owner


def build_bvhs(parts: Sequence[tuple[Any, Any]], launcher: Launcher) -> tuple[Any, list[int], Any]:
    """A `Bvh` over the triangles of the world and of prototypes.

    Args:
        parts: points, vec3 [n], and indices, int32 [3 m], on the launcher's device; m at least 1, indices within 0
            and n - 1. First those of the world, then those of each prototype, in its own space.
        launcher: Where the rays will run.

    Returns:
        The `Bvh`; of each prototype the `Instance.root`; the object that owns what the `Bvh` refers to by id.
    """
    bvh = Bvh()
    if launcher.device.is_cuda:
        meshes = [wp.Mesh(points, indices, bvh_constructor="sah", bvh_leaf_size=2) for points, indices in parts]
        bvh.mesh = meshes[0].id
        bvh.prototypes = launcher.array([mesh.id for mesh in meshes[1:]] or [0], wp.uint64)
        for name, dtype in (("nodes", vec8), ("children", vec8i), ("blocks", vec8), ("triangles", vec8i)):
            setattr(bvh, name, launcher.zeros(1, dtype))
        bvh.chained = launcher.zeros(1, wp.int32)
        return bvh, list(range(len(parts) - 1)), meshes
    bvh.prototypes = launcher.zeros(1, wp.uint64)
    tables, roots, node, block = [], [], 0, 0
    for points, indices in parts:
        mesh = wp.Mesh(points, indices, bvh_constructor="sah", bvh_leaf_size=_LEAF_SIZE)
        table = _widen(mesh, node, block, launcher)
        tables.append(table)
        roots.append(node)
        node += table.children.shape[0]
        block += table.chained.shape[0]
    for name, dtype in (
        ("nodes", vec8),
        ("children", vec8i),
        ("blocks", vec8),
        ("triangles", vec8i),
        ("chained", wp.int32),
    ):
        setattr(bvh, name, _concatenated([getattr(table, name) for table in tables], dtype, launcher))
    return bvh, roots[1:], None


def build_instance_tree(lower: Any, upper: Any, instances: Any, launcher: Launcher) -> tuple[Any, Any]:
    """An `InstanceTree`, and the object that owns it.

    Args:
        lower: float32 [k, 3], corners of the boxes around the instances, k at least 1.
        upper: Likewise.
        instances: Structured array [k] of `Instance`.
        launcher: Where the rays will run.
    """
    out = InstanceTree()
    corners = launcher.array(lower, wp.vec3), launcher.array(upper, wp.vec3)
    boxes = wp.Bvh(*corners, constructor="sah", leaf_size=1)
    out.instances = launcher.array(instances, Instance)
    if launcher.device.is_cuda:
        out.bvh = boxes.id
        out.nodes, out.children = launcher.zeros(1, vec8), launcher.zeros(1, vec8i)
        out.slots, out.chained = launcher.zeros(1, wp.int32), launcher.zeros(1, wp.int32)
        return out, boxes
    ends, count = _count(boxes.id, 1, launcher)
    out.slots, out.chained = launcher.empty(count, wp.int32), launcher.empty(count, wp.int32)
    launcher.launch(_fill_slots, ends.shape[0] - 1, [boxes.id, ends, out])
    out.nodes, out.children = _wide_nodes(boxes.id, ends, 0, 0, launcher)
    return out, None


def _widen(mesh: Any, node_base: int, block_base: int, launcher: Launcher) -> Any:
    """The tables of a mesh from Warp's tree, their nodes and blocks numbered from the given ones on."""
    located = launcher.zeros(1, wp.uint64)
    launcher.launch(_locate, 1, [mesh.id, located])
    tree = int(located.numpy()[0])
    ends, blocks = _count(tree, _LANES, launcher)
    bvh = Bvh()
    bvh.blocks = launcher.empty(9 * blocks, vec8)
    bvh.triangles = launcher.empty(blocks, vec8i)
    bvh.chained = launcher.empty(blocks, wp.int32)
    launcher.launch(_fill_blocks, ends.shape[0] - 1, [tree, mesh.points, mesh.indices, ends, bvh])
    bvh.nodes, bvh.children = _wide_nodes(tree, ends, node_base, block_base, launcher)
    return bvh


def _count(tree: int, lanes: int, launcher: Launcher) -> tuple[Any, int]:
    """The first block of each node of Warp's tree, if it is a leaf, in blocks of so many lanes; and their number."""
    about = launcher.zeros(2, wp.int32)
    launcher.launch(_describe, 1, [tree, about])
    nodes = int(about.numpy()[1])
    counts, ends = launcher.zeros(nodes, wp.int32), launcher.zeros(nodes + 1, wp.int32)
    launcher.launch(_count_blocks, nodes, [tree, lanes, counts])
    wp.utils.array_scan(counts, ends[1:], inclusive=True)
    return ends, int(ends[nodes:].numpy()[0])


def _wide_nodes(tree: int, first_block: Any, node_base: int, block_base: int, launcher: Launcher) -> tuple[Any, Any]:
    """Nodes and children of the wide tree, level by level."""
    about = launcher.zeros(2, wp.int32)
    launcher.launch(_describe, 1, [tree, about])
    levels, base = [], node_base
    sources = launcher.array(about.numpy()[:1], wp.int32)
    while sources.shape[0] > 0:
        size = sources.shape[0]
        base += size
        level = Bvh()
        level.nodes, level.children = launcher.empty(6 * size, vec8), launcher.empty(size, vec8i)
        inner, inner_ends = launcher.empty(size, wp.int32), launcher.empty(size, wp.int32)
        launcher.launch(_collapse, size, [tree, sources, first_block, block_base, level, inner])
        wp.utils.array_scan(inner, inner_ends, inclusive=True)
        sources = launcher.empty(int(inner_ends.numpy()[-1]), wp.int32)
        launcher.launch(_number, size, [level, inner_ends, inner, base, sources])
        levels.append(level)
    nodes = _concatenated([level.nodes for level in levels], vec8, launcher)
    return nodes, _concatenated([level.children for level in levels], vec8i, launcher)


def _concatenated(arrays: Sequence[Any], dtype: Any, launcher: Launcher) -> Any:
    if len(arrays) == 1:
        return arrays[0]
    out = launcher.empty(sum(array.shape[0] for array in arrays), dtype)
    row = 0
    for array in arrays:
        wp.copy(out, array, dest_offset=row)
        row += array.shape[0]
    return out
