"""Rays against triangles.

On CUDA this is Warp's own mesh query. On the CPU, where that query is scalar code on a binary tree, the same tree is
laid out anew, eight children or eight triangles side by side, and a ray meets eight at a time in vector registers
(Wald, Benthin and Boulos 2008: "Getting Rid of Packets").

What is seen in many places is stored once: a second tree, over the boxes of its instances, leads rays into the
hierarchy of the prototype, in whose space they go on.
"""

from warp_ir.bvh.build import build_instance_tree
from warp_ir.bvh.intersect8 import on_cuda
from warp_ir.bvh.node_layout import Bvh, Instance, InstanceTree, RayHit, TwoLevel
from warp_ir.bvh.traverse import intersect, intersect_instances
from warp_ir.bvh.trees import Trees

__all__ = [
    "Bvh",
    "Instance",
    "InstanceTree",
    "RayHit",
    "Trees",
    "TwoLevel",
    "build_instance_tree",
    "intersect",
    "intersect_instances",
    "on_cuda",
]
