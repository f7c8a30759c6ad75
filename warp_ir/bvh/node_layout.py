"""The records of wide trees: what kernels take to find their way through triangles and instances."""

import warp as wp

wp.set_module_options({"enable_backward": False})

LANES = wp.constant(8)
INFINITY = wp.constant(3.0e38)
vec8 = wp.types.vector(length=8, dtype=wp.float32)
vec8i = wp.types.vector(length=8, dtype=wp.int32)


@wp.struct
class MeshTree:
    """A tree on CUDA."""

    mesh: wp.uint64
    shift: int  # from the mesh's triangles to their numbers


@wp.struct
class Bvh:
    """Trees over triangles: those of the world, and one for each prototype. On CUDA the meshes count, else the tables.

    In the world a triangle's number is its row in the tables of the scene; in a prototype it is counted from 0.
    """

    root: int  # of the world: the node where its trees come together; on CUDA, where they begin in `meshes`
    world_count: int  # how many they are
    meshes: wp.array[MeshTree]  # every tree, and after them those of the world again
    nodes: wp.array[vec8]  # six rows per node: lower x, y, z, upper x, y, z of its children
    children: wp.array[vec8i]  # per node; a node, or ~block; what an empty box holds is never looked at
    blocks: wp.array[vec8]  # nine rows per block of triangles: x, y, z of the first corner, the second, the third
    triangles: wp.array[vec8i]  # per block, their numbers; -1 for none
    chained: wp.array[wp.int32]  # per block, 1 if its leaf goes on in the next


@wp.struct
class Instance:
    """Where a prototype is seen, and what a ray needs to know on its way in: local = inverse (world - centre)."""

    inverse: wp.mat33
    centre: wp.vec3
    size: float  # of the coordinates that rays are computed with on their way in and out, in the scene's space
    root: int  # of its prototype: a node on the CPU, an index into the meshes on CUDA
    shift: int  # from the triangles of the hierarchy to the instance's own rows in the triangle tables


@wp.struct
class InstanceTree:
    """A hierarchy over the boxes of instances. On CUDA `bvh` counts, on the CPU the tables."""

    bvh: wp.uint64
    nodes: wp.array[vec8]  # as in `Bvh`
    children: wp.array[vec8i]  # per node; a node, or ~slot
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
