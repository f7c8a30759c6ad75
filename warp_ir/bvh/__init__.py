"""Ray–triangle intersection.

On CUDA rays traverse the binary tree of a Warp mesh. On the CPU the same tree is collapsed to nodes of eight children
and leaves of eight triangles, which a ray tests eight at a time in vector registers (Wald, Benthin and Boulos 2008:
"Getting Rid of Packets"). Both are watertight.

Instanced prototypes are stored once: a second BVH, over the boxes of the instances, leads rays into the prototype's
BVH, where they are traced in the prototype's space.
"""

from warp_ir.bvh.build import build_instance_tree
from warp_ir.bvh.forest import BvhForest
from warp_ir.bvh.intersect8 import on_cuda
from warp_ir.bvh.node_layout import NO_TREE, Bvh, Instance, InstanceTree, RayHit, TwoLevel, empty_rows, vec8, vec8i
from warp_ir.bvh.traverse import intersect, intersect_instances

__all__ = [
    "NO_TREE",
    "Bvh",
    "BvhForest",
    "Instance",
    "InstanceTree",
    "RayHit",
    "TwoLevel",
    "build_instance_tree",
    "empty_rows",
    "intersect",
    "intersect_instances",
    "on_cuda",
    "vec8",
    "vec8i",
]
