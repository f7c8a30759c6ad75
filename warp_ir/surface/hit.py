"""The record of a ray's hit, and access to the scene's record by its address."""

import warp as wp

from warp_ir.device_scene import SceneData

wp.set_module_options({"enable_backward": False})


@wp.struct
class Hit:
    """The intersection of a ray with a surface; `triangle` is -1 for a miss."""

    triangle: int
    instance: int  # the triangle's; -1: it belongs to no instance
    t: float  # distance in lengths of the ray's direction
    u: float  # barycentric coordinates: weights of the triangle's first and second corner
    v: float
    position: wp.vec3  # origin for further rays: offset from the surface to the side of `normal`
    normal: wp.vec3  # unit geometric normal, on the ray's side
    front: int  # 1 if from that side the triangle is wound counter-clockwise
    area: float  # of the triangle in the device frame


@wp.func_native(f"""
    wp::array_t<{SceneData.native_name}> record;
    record.data = ({SceneData.native_name}*)address;
    record.shape[0] = 1;
    record.strides[0] = sizeof({SceneData.native_name});
    record.ndim = 1;
    return record;
""")
def scene_at(address: wp.uint64) -> wp.array[SceneData]:
    """The scene's record at `SceneData.address`, for functions that are called and not inlined."""
    ...
