"""BVH traversal, front to back, eight boxes or eight triangles at a time (Wald, Benthin and Boulos 2008).

In a prototype's space boxes and triangles are padded by the rounding error of the ray's transform, so that traversal is
watertight across the edges of adjacent instances as well.
"""

import warp as wp

from warp_ir.bvh.intersect8 import on_cuda, safe_reciprocal, traversal_source
from warp_ir.bvh.node_layout import NO_TREE, Bvh, Instance, InstanceTree, RayHit, TwoLevel
from warp_ir.bvh.warp_bvh import intersect_mesh

wp.set_module_options({"enable_backward": False})


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


@wp.func_native(f"""
#if !defined(__CUDA_ARCH__)
    {traversal_source(padded=False)}
    intersect_tree(bvh, bvh.root, make_ray(origin, direction, wp::vec3(0.0f)), any_hit, hit);
#endif
""")
def _intersect_world_cpu(
    bvh: Bvh,
    origin: wp.vec3,
    direction: wp.vec3,
    any_hit: bool,
    hit: wp.ref[RayHit],  # type: ignore[type-arg]  # generic at run time alone
) -> None:
    """Finds the closest triangle of the world along a ray before `hit.t`; with `any_hit` any one, called 0."""
    ...


@wp.func
def intersect(bvh: Bvh, origin: wp.vec3, direction: wp.vec3, t_max: float, any_hit: bool) -> RayHit:
    """The closest triangle of the world along a ray before t_max; with `any_hit` any one, without barycentrics."""
    hit = RayHit()
    hit.triangle = -1
    hit.instance = -1
    hit.t = t_max
    if on_cuda():
        for k in range(bvh.world_tree_count):
            tree = bvh.meshes[bvh.root + k]
            candidate = traverse_mesh(tree.mesh, origin, direction, hit.t, any_hit, wp.vec3(0.0))
            if candidate.triangle >= 0:
                candidate.triangle += tree.triangle_offset
                hit = candidate
                if any_hit:
                    return hit
        return hit
    _intersect_world_cpu(bvh, origin, direction, any_hit, hit)
    return hit


_LOCAL_RAY = """
    // A ray in a prototype's space, where it has the same parameter t, and bounds on the rounding errors in each axis.
    const auto local_ray = [](const auto& instance, wp::vec3& origin, wp::vec3& direction) {
        const wp::vec3 from_centre = wp::sub(origin, instance.centre);
        origin = wp::mul(instance.inverse, from_centre);
        direction = wp::mul(instance.inverse, direction);
        const float ulp = 1.1920929e-7f * (instance.magnitude + wp::max(wp::abs(from_centre)));
        wp::vec3 error;
        for (int k = 0; k < 3; ++k) {
            const auto& row = instance.inverse.data[k];
            error[k] = ulp * (fabsf(row[0]) + fabsf(row[1]) + fabsf(row[2]));
        }
        return error;
    };
"""


@wp.func_native(f"""
    {_LOCAL_RAY}
    const wp::vec3 error = local_ray(instance, origin, direction);
    return wp::matrix_from_rows(origin, direction, error);
""")
def _local_ray(instance: Instance, origin: wp.vec3, direction: wp.vec3) -> wp.mat33:
    """Origin, direction and rounding errors of a ray in the space of an instance's prototype."""
    ...


@wp.func_native(f"""
#if !defined(__CUDA_ARCH__)
    {traversal_source(padded=True)}
    {_LOCAL_RAY}
    traverse(tree, tree.root, make_ray(origin, direction, wp::vec3(0.0f)), hit.t, [&](int first_row) {{
        for (int row = first_row;; ++row) {{
            const int number = tree.leaf_instances.data[row];
            const auto& instance = tree.instances.data[number];
            wp::vec3 o = origin, d = direction;
            const wp::vec3 error = local_ray(instance, o, d);
            auto candidate = hit;
            candidate.triangle = -1;
            intersect_tree(bvh, instance.root, make_ray(o, d, error), any_hit, candidate);
            if (candidate.triangle >= 0) {{
                hit = candidate;
                hit.triangle += instance.triangle_offset;
                hit.instance = number;
                if (any_hit) return true;
            }}
            if (tree.continues.data[row] == 0) return false;
        }}
    }});
#endif
""")
def _intersect_instances_cpu(
    bvh: Bvh,
    tree: InstanceTree,
    origin: wp.vec3,
    direction: wp.vec3,
    any_hit: bool,
    hit: wp.ref[RayHit],  # type: ignore[type-arg]  # generic at run time alone
) -> None:
    """Finds the closest triangle of any instance before `hit.t`; with `any_hit` any one."""
    ...


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
        roots = int(2)  # not a constant: the loop would be unrolled
        for k in range(roots):
            root = wp.where(k == 0, tree.root, tree.shared_root)
            if root != NO_TREE:
                query = wp.bvh_query_ray(tree.bvh, origin, direction, root)
                while wp.bvh_query_next(query, number, hit.t):
                    instance = tree.instances[number]
                    local = _local_ray(instance, origin, direction)
                    mesh = bvh.meshes[instance.root].mesh
                    candidate = traverse_mesh(mesh, local[0], local[1], hit.t, any_hit, local[2])
                    if candidate.triangle >= 0:
                        hit = candidate
                        hit.triangle += instance.triangle_offset
                        hit.instance = number
                        if any_hit:
                            return hit
        return hit
    _intersect_instances_cpu(bvh, tree, origin, direction, any_hit, hit)
    return hit
