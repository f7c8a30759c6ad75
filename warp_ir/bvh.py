"""Rays against triangles.

On CUDA this is Warp's own mesh query. On the CPU, where that query is scalar code on a binary tree, the same tree is
laid out anew, eight children or eight triangles side by side, and a ray meets eight at a time in vector registers
(Wald, Benthin and Boulos 2008: "Getting Rid of Packets"). Boxes are tested conservatively (Ize 2013) and
triangles by the sheared edge functions of Woop, Benthin and Wald (2013), evaluated so that two triangles
get the same value for a common edge: no ray slips between them.
"""

from typing import Any

import warp as wp

from warp_ir.launch import Launcher

wp.set_module_options({"enable_backward": False})

_LANES = wp.constant(8)
_LEAF_SIZE = 8
_INFINITY = wp.constant(3.0e38)
_TINY = wp.constant(1.0e-18)
# Warp's builders stop at depth 31, and a node leaves at most seven children behind on the stack.
_STACK = wp.constant(224)

vec8 = wp.types.vector(length=8, dtype=wp.float32)
vec8i = wp.types.vector(length=8, dtype=wp.int32)


@wp.struct
class Bvh:
    """A hierarchy over triangles. On CUDA `mesh` alone counts, on the CPU the tables alone."""

    mesh: wp.uint64
    nodes: wp.array[vec8]  # six rows per node: lower x, y, z, upper x, y, z of its children
    children: wp.array[vec8i]  # per node; a node, or ~block, or -2³¹ for none
    blocks: wp.array[vec8]  # nine rows per block of triangles: x, y, z of the first corner, the second, the third
    triangles: wp.array[vec8i]  # per block, their indices; -1 for none
    chained: wp.array[wp.int32]  # per block, 1 if its leaf goes on in the next


@wp.struct
class RayHit:
    """The nearest triangle along a ray; `triangle` is -1 if there is none."""

    triangle: int
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
        const float ax = (near_x[i] - o[0]) * inverse[0], bx = (far_x[i] - o[0]) * inverse[0];
        const float ay = (near_y[i] - o[1]) * inverse[1], by = (far_y[i] - o[1]) * inverse[1];
        const float az = (near_z[i] - o[2]) * inverse[2], bz = (far_z[i] - o[2]) * inverse[2];
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
    inverse: wp.vec3,
) -> vec8:
    """Where a ray enters each of eight boxes; infinity where it misses."""
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


@wp.func
def intersect(bvh: Bvh, origin: wp.vec3, direction: wp.vec3, t_max: float, any_hit: bool) -> RayHit:
    """The nearest triangle along a ray before t_max; with `any_hit` some triangle, without its coordinates."""
    hit = RayHit()
    hit.triangle = -1
    hit.t = t_max
    if _on_cuda():
        if any_hit:
            if wp.mesh_query_ray_anyhit(bvh.mesh, origin, direction, t_max):
                hit.triangle = 0
        else:
            query = wp.mesh_query_ray(bvh.mesh, origin, direction, t_max)
            if query.result:
                hit.triangle = query.face
                hit.t = query.t
                hit.u = query.u
                hit.v = query.v
                hit.front = wp.where(wp.dot(query.normal, direction) < 0.0, 1, 0)
        return hit

    inverse = wp.vec3()
    for k in range(3):
        d = direction[k]
        if wp.abs(d) < _TINY:
            d = wp.where(d < 0.0, -_TINY, _TINY)
        inverse[k] = 1.0 / d
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

    best_block = int(-1)
    best_lane = int(0)
    todo = wp.zeros(shape=_STACK, dtype=wp.int32)
    todo_t = wp.zeros(shape=_STACK, dtype=wp.float32)
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
                t = _meet(
                    bvh.blocks[base + x],
                    bvh.blocks[base + y],
                    bvh.blocks[base + z],
                    bvh.blocks[base + 3 + x],
                    bvh.blocks[base + 3 + y],
                    bvh.blocks[base + 3 + z],
                    bvh.blocks[base + 6 + x],
                    bvh.blocks[base + 6 + y],
                    bvh.blocks[base + 6 + z],
                    o,
                    shear,
                )
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
                origin,
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


@wp.func
def _sheared(bvh: Bvh, row: int, lane: int, x: int, y: int, z: int, o: wp.vec3, shear: wp.vec3) -> wp.vec2:
    """A corner in the plane across the ray, around it."""
    height = bvh.blocks[row + z][lane] - o[2]
    return wp.vec2(
        bvh.blocks[row + x][lane] - o[0] - shear[0] * height, bvh.blocks[row + y][lane] - o[1] - shear[1] * height
    )


@wp.func_native("""
    const wp::BVHPackedNodeHalf& n = upper ? ((const wp::Mesh*)mesh)->bvh.node_uppers[node]
                                           : ((const wp::Mesh*)mesh)->bvh.node_lowers[node];
    return wp::vec3(n.x, n.y, n.z);
""")
def _corner(mesh: wp.uint64, node: int, upper: int) -> wp.vec3: ...


@wp.func_native("""
    const wp::BVH& bvh = ((const wp::Mesh*)mesh)->bvh;
    return (int)(upper ? bvh.node_uppers[node].i : bvh.node_lowers[node].i);
""")
def _link(mesh: wp.uint64, node: int, upper: int) -> int:
    """Left or right child of an inner node; begin or end of a leaf's primitives."""
    ...


@wp.func_native("return (int)((const wp::Mesh*)mesh)->bvh.node_lowers[node].b;")
def _is_leaf(mesh: wp.uint64, node: int) -> int: ...


@wp.func_native("return ((const wp::Mesh*)mesh)->bvh.primitive_indices[i];")
def _primitive(mesh: wp.uint64, i: int) -> int: ...


@wp.func_native("return *((const wp::Mesh*)mesh)->bvh.root;")
def _root(mesh: wp.uint64) -> int: ...


@wp.func_native("return ((const wp::Mesh*)mesh)->bvh.num_nodes;")
def _node_count(mesh: wp.uint64) -> int: ...


@wp.kernel
def _describe(first: int, mesh: wp.uint64, out: wp.array[wp.int32]) -> None:
    """The root and the number of nodes of Warp's tree."""
    out[0] = _root(mesh)
    out[1] = _node_count(mesh)


@wp.kernel
def _count_blocks(first: int, mesh: wp.uint64, counts: wp.array[wp.int32]) -> None:
    """How many blocks of triangles a node of Warp's tree needs: none if it is no leaf."""
    node = first + wp.tid()
    counts[node] = 0
    if _is_leaf(mesh, node) == 1:
        counts[node] = (_link(mesh, node, 1) - _link(mesh, node, 0) + _LANES - 1) // _LANES


@wp.kernel
def _fill_blocks(
    first: int,
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    indices: wp.array[wp.int32],
    first_block: wp.array[wp.int32],
    bvh: Bvh,
) -> None:
    """Writes a leaf's triangles side by side; lanes left over hold a triangle that no ray meets."""
    node = first + wp.tid()
    if _is_leaf(mesh, node) == 0:
        return
    begin = _link(mesh, node, 0)
    end = _link(mesh, node, 1)
    block = first_block[node]
    while begin < end:
        for lane in range(8):
            triangle = int(-1)
            if begin + lane < end:
                triangle = _primitive(mesh, begin + lane)
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
def _area(mesh: wp.uint64, node: int) -> float:
    d = _corner(mesh, node, 1) - _corner(mesh, node, 0)
    return d[0] * d[1] + d[1] * d[2] + d[2] * d[0]


@wp.kernel
def _collapse(
    first: int,
    mesh: wp.uint64,
    sources: wp.array[wp.int32],
    first_block: wp.array[wp.int32],
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
        if _is_leaf(mesh, node) == 0:
            chosen[opening] = _link(mesh, node, 0)
            chosen[size] = _link(mesh, node, 1)
            size += 1
        opening = int(-1)
        largest = float(-1.0)
        if size < _LANES:
            for k in range(size):
                if _is_leaf(mesh, chosen[k]) == 0 and _area(mesh, chosen[k]) > largest:
                    largest = _area(mesh, chosen[k])
                    opening = k
    inner = int(0)
    for k in range(8):
        lower = wp.vec3(_INFINITY)
        upper = wp.vec3(-_INFINITY)
        if k < size:
            lower = _corner(mesh, chosen[k], 0)
            upper = _corner(mesh, chosen[k], 1)
            if _is_leaf(mesh, chosen[k]) == 1:
                chosen[k] = ~first_block[chosen[k]]
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
    """A `Bvh` over triangles, and the object that owns it.

    Args:
        points: vec3 [n] on the launcher's device.
        indices: int32 [3 m], m at least 1, within 0 and n - 1.
        launcher: Where the rays will run.
    """
    bvh = Bvh()
    mesh = wp.Mesh(points, indices, bvh_constructor="sah", bvh_leaf_size=2 if launcher.device.is_cuda else _LEAF_SIZE)
    bvh.mesh = mesh.id
    if not launcher.device.is_cuda:
        _widen(bvh, mesh, launcher)
        bvh.mesh = wp.uint64(0)
        return bvh, None
    for name, dtype in (("nodes", vec8), ("children", vec8i), ("blocks", vec8), ("triangles", vec8i)):
        setattr(bvh, name, launcher.zeros(1, dtype))
    bvh.chained = launcher.zeros(1, wp.int32)
    return bvh, mesh


def _widen(bvh: Any, mesh: Any, launcher: Launcher) -> None:
    """Fills the tables of `bvh` from Warp's tree, level by level."""
    about = launcher.zeros(2, wp.int32)
    launcher.launch(_describe, 1, [mesh.id, about])
    root, nodes = (int(x) for x in about.numpy())
    counts, ends = launcher.zeros(nodes, wp.int32), launcher.zeros(nodes + 1, wp.int32)
    launcher.launch(_count_blocks, nodes, [mesh.id, counts])
    wp.utils.array_scan(counts, ends[1:], inclusive=True)
    blocks = int(ends[nodes:].numpy()[0])
    bvh.blocks = launcher.empty(9 * blocks, vec8)
    bvh.triangles = launcher.empty(blocks, vec8i)
    bvh.chained = launcher.empty(blocks, wp.int32)
    launcher.launch(_fill_blocks, nodes, [mesh.id, mesh.points, mesh.indices, ends, bvh])

    levels, base = [], 0
    sources = launcher.array([root], wp.int32)
    while sources.shape[0] > 0:
        size = sources.shape[0]
        base += size
        level = Bvh()
        level.nodes, level.children = launcher.empty(6 * size, vec8), launcher.empty(size, vec8i)
        inner, inner_ends = launcher.empty(size, wp.int32), launcher.empty(size, wp.int32)
        launcher.launch(_collapse, size, [mesh.id, sources, ends, level, inner])
        wp.utils.array_scan(inner, inner_ends, inclusive=True)
        sources = launcher.empty(int(inner_ends.numpy()[-1]), wp.int32)
        launcher.launch(_number, size, [level, inner_ends, inner, base, sources])
        levels.append(level)
    bvh.nodes, bvh.children = launcher.empty(6 * base, vec8), launcher.empty(base, vec8i)
    row = 0
    for level in levels:
        size = level.children.shape[0]
        wp.copy(bvh.nodes, level.nodes, dest_offset=6 * row)
        wp.copy(bvh.children, level.children, dest_offset=row)
        row += size
