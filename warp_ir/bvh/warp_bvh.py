"""Access to the nodes of the binary BVHs that Warp builds (`wp::BVH` in Warp's bvh.h)."""

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
