"""Rays through the trees: nearest first, eight boxes or eight triangles at a time (Wald, Benthin and Boulos 2008).

In a prototype's space boxes and triangles are larger by what the ray's way in is rounded by: so none slips between two
instances either.
"""

from typing import Any

import warp as wp

from warp_ir.bvh.intersect8 import below, enter, first_lane, meet, meet_loosely, on_cuda, reciprocal
from warp_ir.bvh.node_layout import Bvh, InstanceTree, RayHit, TwoLevel, vec8, vec8i

wp.set_module_options({"enable_backward": False})

_ULP = wp.constant(2.0**-23)
# Warp's builders stop at depth 31, there are two levels above its trees, and a node leaves at most seven children
# behind on the stack.
_STACK = wp.constant(33 * 7 + 1)


@wp.func
def _push(
    todo: wp.array[wp.int32],
    todo_t: wp.array[wp.float32],
    bottom: int,
    t: vec8,
    t_max: float,
    children: vec8i,
) -> int:
    """Puts the children that a ray enters before t_max on the stack, so that the nearest comes off first."""
    depth = bottom
    mask = below(t, t_max)
    while mask != 0:
        lane = first_lane(mask)
        mask = mask & (mask - 1)
        place = depth
        while place > bottom and todo_t[place - 1] < t[lane]:
            todo_t[place] = todo_t[place - 1]
            todo[place] = todo[place - 1]
            place -= 1
        todo_t[place] = t[lane]
        todo[place] = children[lane]
        depth += 1
    return depth


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
        inverse = reciprocal(direction)
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
                        t = meet_loosely(ax, ay, az, bx, by, bz, cx, cy, cz, o, shear, across)
                    else:
                        t = meet(ax, ay, az, bx, by, bz, cx, cy, cz, o, shear)
                    mask = below(t, hit.t)
                    while mask != 0:
                        lane = first_lane(mask)
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
                t = enter(
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
                depth = _push(todo, todo_t, depth, t, hit.t, bvh.children[node])
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
        if on_cuda():
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
    if on_cuda():
        hit = RayHit()
        hit.triangle = -1
        hit.instance = -1
        hit.t = t_max
        for k in range(bvh.world_count):
            tree = bvh.meshes[bvh.root + k]
            found = _through_world(bvh, tree.mesh, 0, origin, direction, hit.t, any_hit, wp.vec3(0.0))
            if found.triangle >= 0:
                found.triangle += tree.shift
                hit = found
                if any_hit:
                    return hit
        return hit
    return _through_world(bvh, wp.uint64(0), bvh.root, origin, direction, t_max, any_hit, wp.vec3(0.0))


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
    mesh = wp.uint64(0)
    if on_cuda():
        mesh = bvh.meshes[instance.root].mesh
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
    inverse = reciprocal(direction)
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
            t = enter(
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
            depth = _push(todo, todo_t, depth, t, hit.t, tree.children[node])
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
    if on_cuda():
        query = wp.bvh_query_ray(tree.bvh, origin, direction)
        while wp.bvh_query_next(query, number, hit.t):
            found = _enter_instance(bvh, tree, number, origin, direction, hit.t, any_hit)
            if found.triangle >= 0:
                hit = found
                if any_hit:
                    return hit
        return hit
    return _walk_instances(bvh, tree, origin, direction, t_max, any_hit)
