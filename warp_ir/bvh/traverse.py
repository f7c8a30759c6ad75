"""BVH traversal, front to back, eight boxes or eight triangles at a time (Wald, Benthin and Boulos 2008).

In a prototype's space boxes and triangles are padded by the rounding error of the ray's transform, so that traversal is
watertight across the edges of adjacent instances as well.
"""

from collections.abc import Callable

import warp as wp

from warp_ir.bvh.intersect8 import (
    first_lane,
    intersect_boxes,
    intersect_padded_triangles,
    intersect_triangles,
    lanes_below,
    on_cuda,
    safe_reciprocal,
)
from warp_ir.bvh.node_layout import Bvh, InstanceTree, RayHit, TwoLevel, vec8, vec8i
from warp_ir.bvh.warp_bvh import intersect_mesh

wp.set_module_options({"enable_backward": False})

_ULP = wp.constant(2.0**-23)
# Warp's builders stop at depth 31, the top level adds at most two, and each level leaves at most seven children on the
# stack.
_STACK_SIZE = wp.constant(33 * 7 + 1)


@wp.func
def _push_children(
    stack: wp.array[wp.int32],
    stack_t: wp.array[wp.float32],
    bottom: int,
    t: vec8,
    t_max: float,
    children: vec8i,
) -> int:
    """Pushes the children that a ray enters before t_max, the nearest last; returns the new depth of the stack."""
    depth = bottom
    mask = lanes_below(t, t_max)
    while mask != 0:
        lane = first_lane(mask)
        mask = mask & (mask - 1)
        slot = depth
        while slot > bottom and stack_t[slot - 1] < t[lane]:
            stack_t[slot] = stack_t[slot - 1]
            stack[slot] = stack[slot - 1]
            slot -= 1
        stack_t[slot] = t[lane]
        stack[slot] = children[lane]
        depth += 1
    return depth


@wp.func
def _axes(direction: wp.vec3) -> wp.vec3i:
    """The axes, permuted so that the last is the largest component of the direction; the winding is preserved."""
    z = int(0)
    if wp.abs(direction[1]) > wp.abs(direction[0]):
        z = 1
    if wp.abs(direction[2]) > wp.abs(direction[z]):
        z = 2
    if direction[z] < 0.0:
        return wp.vec3i((z + 2) % 3, (z + 1) % 3, z)
    return wp.vec3i((z + 1) % 3, (z + 2) % 3, z)


@wp.func(inline=False)
def traverse_mesh(
    mesh: wp.uint64, origin: wp.vec3, direction: wp.vec3, t_max: float, any_hit: bool, error: wp.vec3
) -> RayHit:
    """The traversal on CUDA: the closest triangle of a `wp.Mesh`."""
    hit = RayHit()
    hit.instance = -1
    axes = _axes(direction)
    inverse = safe_reciprocal(direction)
    closest = intersect_mesh(mesh, origin, direction, inverse, axes[0], axes[1], axes[2], t_max, any_hit, error)
    code = wp.int64(closest[0])
    hit.triangle = -1
    if code >= wp.int64(0):
        hit.triangle = int(code >> wp.int64(1))
        hit.front = int(code & wp.int64(1))
    hit.t = float(closest[1])
    hit.u = float(closest[2])
    hit.v = float(closest[3])
    return hit


def _make_traversal(name: str, padded: bool) -> Callable[..., RayHit]:
    """Makes the function that traces a ray through one tree, with padded boxes and triangles if `padded`."""

    @wp.func(name=name + "_cpu")
    def traverse_cpu(
        bvh: Bvh, root: int, origin: wp.vec3, direction: wp.vec3, t_max: float, any_hit: bool, error: wp.vec3
    ) -> RayHit:
        """The traversal on the CPU, a function of its own: CUDA, which never calls it, reserves no stack for it."""
        hit = RayHit()
        hit.triangle = -1
        hit.instance = -1
        hit.t = t_max
        inverse = safe_reciprocal(direction)
        near_x = wp.where(inverse[0] < 0.0, 3, 0)
        near_y = wp.where(inverse[1] < 0.0, 4, 1)
        near_z = wp.where(inverse[2] < 0.0, 5, 2)

        axes = _axes(direction)
        x = axes[0]
        y = axes[1]
        z = axes[2]
        shear = wp.vec3(direction[x], direction[y], 1.0) / direction[z]
        o = wp.vec3(origin[x], origin[y], origin[z])

        near_origin = origin
        far_origin = origin
        padding = wp.vec2(0.0)
        if wp.static(padded):
            near_origin += wp.vec3(
                wp.sign(inverse[0]) * error[0], wp.sign(inverse[1]) * error[1], wp.sign(inverse[2]) * error[2]
            )
            far_origin = origin - (near_origin - origin)
            padding = wp.vec2(error[x] + wp.abs(shear[0]) * error[z], error[y] + wp.abs(shear[1]) * error[z])

        best_block = int(-1)
        best_lane = int(0)
        stack = wp.zeros(shape=_STACK_SIZE, dtype=wp.int32)
        stack_t = wp.zeros(shape=_STACK_SIZE, dtype=wp.float32)
        stack[0] = root
        depth = int(1)
        while depth > 0:
            depth -= 1
            node = stack[depth]
            if stack_t[depth] >= hit.t:
                continue
            if node < 0:
                block = ~node
                continues = int(1)
                while continues == 1:
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
                    if wp.static(padded):
                        t = intersect_padded_triangles(ax, ay, az, bx, by, bz, cx, cy, cz, o, shear, padding)
                    else:
                        t = intersect_triangles(ax, ay, az, bx, by, bz, cx, cy, cz, o, shear)
                    mask = lanes_below(t, hit.t)
                    while mask != 0:
                        lane = first_lane(mask)
                        mask = mask & (mask - 1)
                        if t[lane] < hit.t:
                            hit.t = t[lane]
                            best_block = block
                            best_lane = lane
                    continues = bvh.continues[block]
                    block += 1
                if any_hit and best_block >= 0:
                    hit.triangle = 0
                    return hit
            else:
                base = 6 * node
                t = intersect_boxes(
                    bvh.nodes[base + near_x],
                    bvh.nodes[base + near_y],
                    bvh.nodes[base + near_z],
                    bvh.nodes[base + 3 - near_x],
                    bvh.nodes[base + 5 - near_y],
                    bvh.nodes[base + 7 - near_z],
                    near_origin,
                    far_origin,
                    inverse,
                )
                depth = _push_children(stack, stack_t, depth, t, hit.t, bvh.children[node])
        if best_block >= 0:
            hit.triangle = bvh.triangles[best_block][best_lane]
            base = 9 * best_block
            a = _sheared_corner(bvh, base, best_lane, x, y, z, o, shear)
            b = _sheared_corner(bvh, base + 3, best_lane, x, y, z, o, shear)
            c = _sheared_corner(bvh, base + 6, best_lane, x, y, z, o, shear)
            u = c[0] * b[1] - c[1] * b[0]
            v = a[0] * c[1] - a[1] * c[0]
            determinant = u + v + (b[0] * a[1] - b[1] * a[0])
            hit.u = u / determinant
            hit.v = v / determinant
            hit.front = wp.where(determinant > 0.0, 1, 0)
        return hit

    @wp.func(name=name)
    def traverse(
        bvh: Bvh,
        mesh: wp.uint64,
        root: int,
        origin: wp.vec3,
        direction: wp.vec3,
        t_max: float,
        any_hit: bool,
        error: wp.vec3,
    ) -> RayHit:
        """The closest triangle of one tree, which is `mesh` on CUDA and starts at node `root` on the CPU.

        `error` bounds the rounding error of the ray in each axis; only a padded traversal reads it.
        """
        if on_cuda():
            return traverse_mesh(mesh, origin, direction, t_max, any_hit, error)
        return traverse_cpu(bvh, root, origin, direction, t_max, any_hit, error)

    return traverse


_traverse_world = _make_traversal("traverse_world", False)
_traverse_prototype = _make_traversal("traverse_prototype", True)


@wp.func
def intersect(bvh: Bvh, origin: wp.vec3, direction: wp.vec3, t_max: float, any_hit: bool) -> RayHit:
    """The closest triangle of the world along a ray before t_max; with `any_hit` any one, without barycentrics."""
    if on_cuda():
        hit = RayHit()
        hit.triangle = -1
        hit.instance = -1
        hit.t = t_max
        for k in range(bvh.world_tree_count):
            tree = bvh.meshes[bvh.root + k]
            candidate = _traverse_world(bvh, tree.mesh, 0, origin, direction, hit.t, any_hit, wp.vec3(0.0))
            if candidate.triangle >= 0:
                candidate.triangle += tree.triangle_offset
                hit = candidate
                if any_hit:
                    return hit
        return hit
    return _traverse_world(bvh, wp.uint64(0), bvh.root, origin, direction, t_max, any_hit, wp.vec3(0.0))


@wp.func
def _sheared_corner(bvh: Bvh, row: int, lane: int, x: int, y: int, z: int, o: wp.vec3, shear: wp.vec3) -> wp.vec2:
    """A triangle's corner, translated and sheared so that the ray is the z axis: its x and y."""
    height = bvh.blocks[row + z][lane] - o[2]
    return wp.vec2(
        bvh.blocks[row + x][lane] - o[0] - shear[0] * height, bvh.blocks[row + y][lane] - o[1] - shear[1] * height
    )


@wp.func
def _intersect_instance(
    bvh: Bvh, tree: InstanceTree, number: int, origin: wp.vec3, direction: wp.vec3, t_max: float, any_hit: bool
) -> RayHit:
    """The closest triangle of one instance; the transform into the prototype's space preserves the parameter t."""
    instance = tree.instances[number]
    mesh = wp.uint64(0)
    if on_cuda():
        mesh = bvh.meshes[instance.root].mesh
    from_centre = origin - instance.centre
    o = instance.inverse * from_centre
    d = instance.inverse * direction
    ulp = (instance.magnitude + wp.max(wp.abs(from_centre))) * _ULP
    error = wp.vec3(0.0)
    for k in range(3):
        error[k] = ulp * (
            wp.abs(instance.inverse[k, 0]) + wp.abs(instance.inverse[k, 1]) + wp.abs(instance.inverse[k, 2])
        )
    hit = _traverse_prototype(bvh, mesh, instance.root, o, d, t_max, any_hit, error)
    if hit.triangle >= 0:
        hit.triangle += instance.triangle_offset
        hit.instance = number
    return hit


@wp.func
def _traverse_instances_cpu(
    bvh: Bvh, tree: InstanceTree, origin: wp.vec3, direction: wp.vec3, t_max: float, any_hit: bool
) -> RayHit:
    """The traversal of the instances' BVH on the CPU, as `intersect_instances`."""
    hit = RayHit()
    hit.triangle = -1
    hit.instance = -1
    hit.t = t_max
    inverse = safe_reciprocal(direction)
    near_x = wp.where(inverse[0] < 0.0, 3, 0)
    near_y = wp.where(inverse[1] < 0.0, 4, 1)
    near_z = wp.where(inverse[2] < 0.0, 5, 2)
    stack = wp.zeros(shape=_STACK_SIZE, dtype=wp.int32)
    stack_t = wp.zeros(shape=_STACK_SIZE, dtype=wp.float32)
    depth = int(1)
    while depth > 0:
        depth -= 1
        node = stack[depth]
        if stack_t[depth] >= hit.t:
            continue
        if node < 0:
            slot = ~node
            continues = int(1)
            while continues == 1:
                candidate = _intersect_instance(bvh, tree, tree.leaf_instances[slot], origin, direction, hit.t, any_hit)
                if candidate.triangle >= 0:
                    hit = candidate
                    if any_hit:
                        return hit
                continues = tree.continues[slot]
                slot += 1
        else:
            base = 6 * node
            t = intersect_boxes(
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
            depth = _push_children(stack, stack_t, depth, t, hit.t, tree.children[node])
    return hit


@wp.func(inline=False)
def intersect_instances(
    scene: wp.array[TwoLevel], origin: wp.vec3, direction: wp.vec3, t_max: float, any_hit: bool
) -> RayHit:
    """The closest triangle of any instance before t_max; with `any_hit` any one, without barycentrics.

    `scene` is an array of one row: a struct as argument would be copied for every ray, even without instances.
    """
    bvh = scene[0].bvh
    tree = scene[0].tree
    hit = RayHit()
    hit.triangle = -1
    hit.instance = -1
    hit.t = t_max
    number = int(0)
    if on_cuda():
        query = wp.bvh_query_ray(tree.bvh, origin, direction)
        while wp.bvh_query_next(query, number, hit.t):
            candidate = _intersect_instance(bvh, tree, number, origin, direction, hit.t, any_hit)
            if candidate.triangle >= 0:
                hit = candidate
                if any_hit:
                    return hit
        return hit
    return _traverse_instances_cpu(bvh, tree, origin, direction, t_max, any_hit)
