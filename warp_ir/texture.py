"""Textures on the device: every image with a chain of means, and one function that looks them up.

Each level of the chain has half the pixels a side and keeps the mean exactly. Whoever looks up says how wide the
patch of surface is that the answer stands for, and gets the level whose pixels are about as wide, interpolated
between four of them: what is far away, and what light bounces off, costs no more and does not flicker.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.image.mipmap import mip_chain, resized
from warp_ir.scene import Floats, Texture, Wrap

wp.set_module_options({"enable_backward": False})

MAX_BYTES = 2**30
"""All textures together: above it, the largest are halved a side until they fit."""
_BLACK = wp.constant(int(Wrap.BLACK))
_REPEAT = wp.constant(int(Wrap.REPEAT))
_MIRROR = wp.constant(int(Wrap.MIRROR))
_WINDOW = 8
"""Pixels across a triangle when its mean is estimated."""
_CHUNK = 2**14
"""Triangles at once, likewise."""


@wp.struct
class TextureRow:
    """One texture."""

    first_level: int
    level_count: int
    channels: int  # 1 or 3
    wrap_s: int
    wrap_t: int
    uv_set: int
    scale: float  # what a texel of 1 stands for, a power of two
    s: wp.vec3  # (uv, 1) · s is the texture's first coordinate
    t: wp.vec3
    outside: wp.vec3


@wp.struct
class TextureTable:
    """All textures; one unused row where there are none."""

    count: int
    rows: wp.array[TextureRow]
    levels: wp.array[wp.vec3i]  # columns, rows, first value in texels
    texels: wp.array[wp.float16]  # the image's top row first, as everywhere


@wp.struct
class _Neighbours:
    """Two pixels along one axis, and the weight of the second; -1: outside."""

    a: int
    b: int
    weight: float


@wp.func
def _neighbours(x: float, size: int, wrap: int) -> _Neighbours:
    """The pixels around a coordinate in [0, 1]."""
    at = float(0.0)
    if wrap == _REPEAT:
        at = x - wp.floor(x)
    elif wrap == _MIRROR:
        at = wp.abs(x - 2.0 * wp.floor(0.5 * x + 0.5))
    else:
        at = wp.clamp(x, -1.0, 2.0)
    at = at * float(size) - 0.5
    low = wp.floor(at)
    out = _Neighbours()
    out.weight = at - low
    out.a = int(low)
    out.b = out.a + 1
    if wrap == _REPEAT:
        out.a = wp.where(out.a < 0, size - 1, out.a)
        out.b = wp.where(out.b >= size, 0, out.b)
    elif wrap == _BLACK:
        out.a = wp.where(out.a < 0 or out.a >= size, -1, out.a)
        out.b = wp.where(out.b < 0 or out.b >= size, -1, out.b)
        return out
    out.a = wp.clamp(out.a, 0, size - 1)
    out.b = wp.clamp(out.b, 0, size - 1)
    return out


@wp.func
def _texel(table: TextureTable, row: TextureRow, level: wp.vec3i, x: int, y: int) -> wp.vec3:
    if x < 0 or y < 0:
        return row.outside
    i = level[2] + (y * level[0] + x) * row.channels
    value = float(table.texels[i]) * row.scale
    if row.channels == 1:
        return wp.vec3(value, value, value)
    return wp.vec3(value, float(table.texels[i + 1]) * row.scale, float(table.texels[i + 2]) * row.scale)


@wp.func
def coordinates(row: TextureRow, uv: wp.vec2) -> wp.vec2:
    """The mesh's coordinates as the texture's."""
    return wp.vec2(
        row.s[0] * uv[0] + row.s[1] * uv[1] + row.s[2],
        row.t[0] * uv[0] + row.t[1] * uv[1] + row.t[2],
    )


@wp.func
def mip_level(table: TextureTable, row: TextureRow, uv_per_area: float, footprint: float) -> int:
    """The level whose pixels are as wide as `footprint`, or somewhat finer.

    `uv_per_area` is how much of the mesh's uv plane lies on a unit of area; the footprint a length.
    """
    finest = table.levels[row.first_level]
    area = wp.abs(row.s[0] * row.t[1] - row.s[1] * row.t[0]) * uv_per_area * float(finest[0]) * float(finest[1])
    pixels = area * footprint * footprint  # of the finest level, under the footprint
    if not (pixels > 1.0):
        return row.first_level
    level = wp.min(int(0.5 * wp.log2(wp.min(pixels, 1.0e30))), row.level_count - 1)
    return row.first_level + level


@wp.func
def lookup(table: TextureTable, row: TextureRow, st: wp.vec2, level_row: int) -> wp.vec3:
    """The texture at (s, t), (0, 0) being its lower left corner; a texture of one channel gives it thrice."""
    level = table.levels[level_row]
    x = _neighbours(st[0], level[0], row.wrap_s)
    y = _neighbours(1.0 - st[1], level[1], row.wrap_t)
    top = wp.lerp(_texel(table, row, level, x.a, y.a), _texel(table, row, level, x.b, y.a), x.weight)
    bottom = wp.lerp(_texel(table, row, level, x.a, y.b), _texel(table, row, level, x.b, y.b), x.weight)
    return wp.lerp(top, bottom, y.weight)


def upload_textures(textures: Sequence[Texture], uv_sets: Sequence[str], launcher: Launcher) -> Any:
    """The `TextureTable` of textures, in their order.

    Args:
        textures: Checked.
        uv_sets: The names of the meshes' uv sets, in the order of their rows.
        launcher: Whose device it is for.
    """
    table = TextureTable()
    table.count = len(textures)
    rows = np.zeros(max(len(textures), 1), TextureRow.numpy_dtype())
    levels: list[tuple[int, int, int]] = []
    texels: list[npt.NDArray[np.float16]] = []
    total = 0
    for k, (texture, pixels) in enumerate(zip(textures, _within_budget(textures), strict=True)):
        chain = mip_chain(pixels)
        # Halves hold 11 bits between 6e-5 and 65504: scaled to 1, whatever the unit.
        largest = max(float(pixels.max()), -float(pixels.min()))
        scale = 2.0 ** math.frexp(largest)[1] if largest > 0.0 else 1.0
        rows[k]["first_level"], rows[k]["level_count"], rows[k]["channels"] = len(levels), len(chain), pixels.shape[2]
        rows[k]["wrap_s"], rows[k]["wrap_t"] = texture.wrap
        rows[k]["scale"] = scale
        rows[k]["uv_set"] = uv_sets.index(texture.uv)
        rows[k]["s"], rows[k]["t"] = texture.transform
        rows[k]["outside"] = texture.outside
        for level in chain:
            levels.append((level.shape[1], level.shape[0], total))
            texels.append((level / np.float32(scale)).astype(np.float16).reshape(-1))
            total += level.size
    table.rows = launcher.array(rows, TextureRow)
    table.levels = launcher.array(np.array(levels or [(1, 1, 0)], np.int32), wp.vec3i)
    table.texels = launcher.array(np.concatenate(texels) if texels else np.zeros(1, np.float16), wp.float16)
    return table


def _within_budget(textures: Sequence[Texture]) -> list[Floats]:
    """The images, the largest halved until all fit, with their chains, into `MAX_BYTES` of halves."""
    images: list[Floats] = [np.asarray(texture.pixels) for texture in textures]
    while sum(image.size for image in images) * 2 * 4 / 3 > MAX_BYTES:
        k = int(np.argmax([image.size for image in images]))
        height, width = images[k].shape[:2]
        if height == width == 1:
            break
        images[k] = resized(images[k], max(height // 2, 1), max(width // 2, 1))
    return images


def mean_on_triangles(texture: Texture, uvs: Floats, areas: Floats, footprint: float) -> Floats:
    """Roughly the mean over the channels of what `lookup` gives on each triangle; never 0 where that is not, [m].

    Args:
        texture: The texture.
        uvs: Of the triangles' corners in the mesh's uv set, [m, 3, 2].
        areas: Of the triangles, [m], in the unit of the footprint's square.
        footprint: As given to `mip_level`.
    """
    chain = [level[..., 0] for level in mip_chain(np.asarray(texture.pixels, np.float32).mean(axis=2, keepdims=True))]
    out = np.zeros(len(uvs))
    for first in range(0, len(uvs), _CHUNK):
        part = slice(first, first + _CHUNK)
        out[part] = _chunk_means(texture, chain, np.asarray(uvs[part], np.float64), areas[part], footprint)
    return out


def _chunk_means(texture: Texture, chain: list[Floats], uvs: Floats, areas: Floats, footprint: float) -> Floats:
    matrix = np.asarray(texture.transform, np.float64)
    st = uvs @ matrix[:, :2].T + matrix[:, 2]
    low, high = st.min(axis=1), st.max(axis=1)
    for axis in range(2):
        if texture.wrap[axis] == Wrap.BLACK:  # beyond the edges there is one value, which is added below
            low[:, axis], high[:, axis] = low[:, axis].clip(0.0, 1.0), high[:, axis].clip(0.0, 1.0)
    sizes = np.array([level.shape[::-1] for level in chain], np.float64)
    # A level on which the triangle spans a few pixels, and which is not finer than what is looked up.
    edge1, edge2 = uvs[:, 1] - uvs[:, 0], uvs[:, 2] - uvs[:, 0]
    covered = 0.5 * np.abs(edge1[:, 0] * edge2[:, 1] - edge1[:, 1] * edge2[:, 0]) * abs(np.linalg.det(matrix[:, :2]))
    density = covered / np.maximum(areas, 1e-300) * sizes[0].prod() * footprint**2
    looked_up = 0.5 * np.log2(np.maximum(density, 1.0)) + 1.0
    span = ((high - low) * sizes[0]).max(axis=1) / _WINDOW
    chosen = np.maximum(np.ceil(np.log2(np.maximum(span, 1.0))), np.floor(looked_up)).astype(int)
    chosen = np.minimum(chosen, len(chain) - 1)
    b = (np.arange(_WINDOW) + 1.0 / 3.0) / _WINDOW
    u, v = np.meshgrid(b, b)
    inside = u + v < 1.0
    weights = np.stack([u[inside], v[inside], 1.0 - u[inside] - v[inside]])
    steps = np.arange(-2, _WINDOW + 3)
    out = np.zeros(len(uvs))
    for level in np.unique(chosen):
        k = np.flatnonzero(chosen == level)
        size = sizes[level]
        points = np.einsum("mki,kp->mpi", st[k], weights)
        estimate = _nearest(texture, chain[level], np.floor(points * size)).mean(axis=1)
        # Everything that interpolation can reach: pixels of a window around the triangle.
        corner = np.floor(low[k] * size)
        x = corner[:, 0, None, None] + steps[:, None] + 0 * steps
        y = corner[:, 1, None, None] + 0 * steps[:, None] + steps
        around = _nearest(texture, chain[level], np.stack([x, y], axis=-1)).mean(axis=(1, 2))
        out[k] = 0.9 * estimate + 0.1 * around
    if Wrap.BLACK in texture.wrap:
        out += 0.1 * np.mean(texture.outside)
    return out


def _nearest(texture: Texture, level: Floats, pixels: Floats) -> Floats:
    """Values of a level [h, w] at whole coordinates [..., 2], counted from the lower left."""
    index, outside = [], np.zeros(pixels.shape[:-1], bool)
    for axis, size in ((0, level.shape[1]), (1, level.shape[0])):
        at = pixels[..., axis].clip(-1e9, 1e9).astype(np.int64)
        if texture.wrap[axis] == Wrap.REPEAT:
            at %= size
        elif texture.wrap[axis] == Wrap.MIRROR:
            at %= 2 * size
            at = np.minimum(at, 2 * size - 1 - at)
        elif texture.wrap[axis] == Wrap.BLACK:
            outside |= (at < 0) | (at >= size)
        index.append(at.clip(0, size - 1))
    return np.where(outside, np.mean(texture.outside), level[level.shape[0] - 1 - index[1], index[0]])
