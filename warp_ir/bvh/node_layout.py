"""The records that traversal reads: eight-wide BVH nodes, blocks of eight triangles, instances."""

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

wp.set_module_options({"enable_backward": False})

BVH_WIDTH = wp.constant(8)
"""Children of a node, and triangles of a block: one vector register of float32."""
INFINITY = wp.constant(3.0e38)
NO_TREE = wp.constant(-2)
"""Value of `InstanceTree.root` and `shared_root` on CUDA: there is no tree."""
vec8 = wp.types.vector(length=8, dtype=wp.float32)
vec8i = wp.types.vector(length=8, dtype=wp.int32)


@wp.struct
class MeshTree:
    """One tree on CUDA: a Warp mesh with its BVH."""

    mesh: wp.uint64  # id of the `wp.Mesh`
    triangle_offset: int  # from the mesh's triangles to their numbers in the scene


@wp.struct
class Bvh:
    """The BVHs over triangles: those of the world, and one for each prototype. CUDA reads `meshes`, the CPU the tables.

    A triangle of the world is numbered by its row in the scene's triangle tables, one of a prototype from 0.
    """

    root: int  # of the world: node that joins its trees; on CUDA, the first of them in `meshes`
    world_tree_count: int
    meshes: wp.array[MeshTree]  # every tree, followed by those of the world again
    nodes: wp.array[vec8]  # six rows per node: lower x, y, z, upper x, y, z of its children
    children: wp.array[vec8i]  # per node: a node, or ~block of a leaf; undefined where the child's box is empty
    blocks: wp.array[vec8]  # nine rows per block of triangles: x, y, z of the first, second and third corner
    triangles: wp.array[vec8i]  # per block, the triangles' numbers; -1: none
    continues: wp.array[wp.int32]  # per block, 1 if its leaf continues in the next block


@wp.struct
class Instance:
    """Transform and data of one instance for rays that enter it: local = inverse (world - centre)."""

    inverse: wp.mat33
    centre: wp.vec3
    magnitude: float  # largest coordinate in the transforms of a ray and its hit, in the scene's space: bounds rounding
    root: int  # of its prototype's tree: a node on the CPU, an index into the meshes on CUDA
    triangle_offset: int  # from the prototype's triangles to the instance's rows in the triangle tables


@wp.struct
class InstanceTree:
    """A BVH over the boxes of instances. CUDA reads `bvh`, the CPU the tables. Several trees may share them."""

    bvh: wp.uint64  # id of the `wp.Bvh`
    root: int  # the node at which rays start, of the tables or of `bvh`: there -1 is the whole of it, NO_TREE is none
    shared_root: int  # of `bvh` alone: a second one, of what several trees share
    nodes: wp.array[vec8]  # as in `Bvh`
    children: wp.array[vec8i]  # per node: a node, or ~row of leaf_instances
    leaf_instances: wp.array[wp.int32]  # instances in the order of the leaves
    continues: wp.array[wp.int32]  # per row of leaf_instances, 1 if its leaf continues in the next row
    instances: wp.array[Instance]


@wp.struct
class TwoLevel:
    """Both levels that a ray traverses among instances."""

    bvh: Bvh
    tree: InstanceTree


@wp.struct
class RayHit:
    """The closest triangle along a ray; `triangle` is -1 if there is none."""

    triangle: int
    instance: int  # that the triangle belongs to; -1: none, it is stored in world space
    t: float  # distance in units of the ray's direction
    u: float  # barycentric weights of the first and the second corner
    v: float
    front: int  # 1 if the ray hits the side from which the corners run counter-clockwise


def empty_rows(record: Any, count: int) -> npt.NDArray[np.void]:
    """A zeroed NumPy table of `count` rows of a `wp.struct`, with the struct's fields."""
    return np.zeros(count, record.numpy_dtype())
