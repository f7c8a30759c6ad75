"""Live scenes and views of them that several tests use."""

import numpy as np
import warp as wp

import warp_ir as ir
from warp_ir.simulation.bodies import quaternions

NAMES = {
    "color": wp.uint32,
    "hdr_color": wp.vec3,
    "albedo": wp.uint32,
    "depth": wp.float32,
    "forward_depth": wp.float32,
    "normal": wp.vec3,
    "shape_index": wp.uint32,
    "error": wp.float32,
}


def rays(columns=16, rows=None, window=(-0.5, 0.5, -0.5, 0.5), samples=1):
    """The rays of a pinhole camera, float32 [rows, columns, samples, 2, 3]; samples lie on a grid."""
    rows = rows or columns
    left, right, bottom, top = window
    side = round(samples**0.5)
    u = (np.arange(side) + 0.5) / side
    out = np.zeros((rows, columns, samples, 2, 3), np.float32)
    for s in range(samples):
        x = left + (np.arange(columns) + u[s % side]) / columns * (right - left)
        y = top - (np.arange(rows) + u[s // side]) / rows * (top - bottom)
        out[:, :, s, 1, 0], out[:, :, s, 1, 1], out[:, :, s, 1, 2] = x[None], y[:, None], -1.0
    return out


def pose(matrix):
    """The transform of a rigid matrix."""
    return np.concatenate([matrix[:3, 3], quaternions(matrix[None, :3, :3])[0]]).astype(np.float32)


def shift(x=0.0, y=0.0, z=0.0):
    """The transform of a translation."""
    return np.array([x, y, z, 0.0, 0.0, 0.0, 1.0], np.float32)


def look_at(eye, target=(0.0, 0.0, 0.0)):
    """The transform of a camera."""
    return pose(ir.Camera.look_at(eye, target).world_from_camera)


def array(values, dtype):
    return wp.array(np.asarray(values), dtype=dtype, device="cpu")


def shots(views, poses, bundle, worlds=None, names=("hdr_color",), into=None, **options):
    """The images of some names, as NumPy arrays; `into` are the arrays that are overwritten."""
    shape = (len(poses), *bundle.shape[:2])
    out = into or {name: wp.zeros(shape, dtype=NAMES[name], device="cpu") for name in names}
    worlds = None if worlds is None else array(worlds, wp.int32)
    views.render(array(poses, wp.transformf), array(bundle, wp.vec3), worlds, **out, **options)
    return {name: values.numpy().copy() for name, values in out.items()}
