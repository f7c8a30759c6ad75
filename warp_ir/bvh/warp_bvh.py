"""Reading the binary trees that Warp builds."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func_native("return (uint64_t)&((const wp::Mesh*)mesh)->bvh;")
def tree_of(mesh: wp.uint64) -> wp.uint64:
    """Where the tree of a mesh lies; a `wp.Bvh`'s id is that itself."""
    ...


@wp.func_native("""
    const wp::BVHPackedNodeHalf& n = upper ? ((const wp::BVH*)tree)->node_uppers[node]
                                           : ((const wp::BVH*)tree)->node_lowers[node];
    return wp::vec3(n.x, n.y, n.z);
""")
def box_corner(tree: wp.uint64, node: int, upper: int) -> wp.vec3:
    """The lower or the upper corner of a node's box."""
    ...


@wp.func_native("""
    const wp::BVH& bvh = *(const wp::BVH*)tree;
    return (int)(upper ? bvh.node_uppers[node].i : bvh.node_lowers[node].i);
""")
def link(tree: wp.uint64, node: int, upper: int) -> int:
    """Left or right child of an inner node; begin or end of a leaf's primitives."""
    ...


@wp.func_native("return (int)((const wp::BVH*)tree)->node_lowers[node].b;")
def is_leaf(tree: wp.uint64, node: int) -> int:
    """1 if a node holds primitives, 0 if it holds nodes."""
    ...


@wp.func_native("return ((const wp::BVH*)tree)->primitive_indices[i];")
def primitive(tree: wp.uint64, i: int) -> int:
    """The primitive in place i of the leaves."""
    ...


@wp.func_native("return *((const wp::BVH*)tree)->root;")
def tree_root(tree: wp.uint64) -> int:
    """The number of the root."""
    ...


@wp.func_native("return ((const wp::BVH*)tree)->num_nodes;")
def node_count(tree: wp.uint64) -> int:
    """How many nodes there are."""
    ...
