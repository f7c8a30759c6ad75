"""Textures on the device: every image as a mip chain, and one function that looks it up.

Each level has half the pixels a side and exactly the image's mean. A lookup takes the width of the patch of surface to
average over (the footprint), and interpolates bilinearly on the level whose pixels are about as wide. Distant surfaces
and diffuse reflections therefore cost no more than near ones and do not flicker.
"""

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.image.mipmap import mip_chain, resized, value_range
from warp_ir.scene import Floats, Texture, Wrap

wp.set_module_options({"enable_backward": False})

MAX_BYTES = 2**30
"""Largest size of all textures together; above it, the largest images are halved a side until they fit."""
_BLACK = wp.constant(int(Wrap.BLACK))
_REPEAT = wp.constant(int(Wrap.REPEAT))
_MIRROR = wp.constant(int(Wrap.MIRROR))
_WINDOW = 8
"""Most pixels that a triangle spans per axis on the level from which its mean is estimated."""
_CHUNK = 2**14
"""Triangles whose means are estimated at a time, which limits the memory."""


@wp.struct
class TextureRow:
    """One texture."""

    first_level: int  # row of `TextureTable.levels`
    level_count: int
    channels: int  # 1 or 3
    wrap_s: int  # a `Wrap`
    wrap_t: int
    uv_set: int  # index of the mesh's uv set
    scale: float  # the value of a texel of 1: a power of two
    s: wp.vec3  # the texture coordinate s is (u, v, 1) · s
    t: wp.vec3  # and t is (u, v, 1) · t
    outside: wp.vec3  # value beyond the edges where the wrap mode is BLACK


@wp.struct
class TextureTable:
    """All textures; one unused row where there are none."""

    count: int
    rows: wp.array[TextureRow]
    levels: wp.array[wp.vec3i]  # columns, rows, index of the first value in texels
    texels: wp.array[wp.float16]  # the image's top row first


@wp.struct
class _Neighbours:
    """Two neighbouring pixels along one axis (-1: outside), and the weight of the second."""

    a: int
    b: int
    weight: float


@wp.func
def _neighbours(x: float, size: int, wrap: int) -> _Neighbours:
    """The two pixels around a coordinate; the image covers [0, 1]."""
    texel = float(0.0)
    if wrap == _REPEAT:
        texel = x - wp.floor(x)
    elif wrap == _MIRROR:
        texel = wp.abs(x - 2.0 * wp.floor(0.5 * x + 0.5))
    else:
        texel = wp.clamp(x, -1.0, 2.0)
    texel = texel * float(size) - 0.5
    low = wp.floor(texel)
    out = _Neighbours()
    out.weight = texel - low
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
    """The value of a pixel; -1 as a coordinate is outside the image."""
    if x < 0 or y < 0:
        return row.outside
    i = level[2] + (y * level[0] + x) * row.channels
    value = float(table.texels[i]) * row.scale
    if row.channels == 1:
        return wp.vec3(value, value, value)
    return wp.vec3(value, float(table.texels[i + 1]) * row.scale, float(table.texels[i + 2]) * row.scale)


@wp.func
def uv_to_st(row: TextureRow, uv: wp.vec2) -> wp.vec2:
    """Transforms a mesh's uv coordinates into the st coordinates of a texture."""
    return wp.vec2(
        row.s[0] * uv[0] + row.s[1] * uv[1] + row.s[2],
        row.t[0] * uv[0] + row.t[1] * uv[1] + row.t[2],
    )


@wp.func
def mip_level(table: TextureTable, row: TextureRow, uv_per_area: float, footprint: float) -> int:
    """The row of the level whose pixels are as wide as `footprint`, or up to twice as fine.

    `uv_per_area` is the area in the mesh's uv plane per unit of surface area; the footprint is a length.
    """
    finest = table.levels[row.first_level]
    area = wp.abs(row.s[0] * row.t[1] - row.s[1] * row.t[0]) * uv_per_area * float(finest[0]) * float(finest[1])
    pixels = area * footprint * footprint  # of the finest level, in the footprint
    if not (pixels > 1.0):
        return row.first_level
    level = wp.min(int(0.5 * wp.log2(wp.min(pixels, 1.0e30))), row.level_count - 1)
    return row.first_level + level


@wp.func
def lookup(table: TextureTable, row: TextureRow, st: wp.vec2, level_row: int) -> wp.vec3:
    """The value at (s, t) on a level; (0, 0) is the lower left corner, one channel is repeated in all three."""
    level = table.levels[level_row]
    x = _neighbours(st[0], level[0], row.wrap_s)
    y = _neighbours(1.0 - st[1], level[1], row.wrap_t)
    top = wp.lerp(_texel(table, row, level, x.a, y.a), _texel(table, row, level, x.b, y.a), x.weight)
    bottom = wp.lerp(_texel(table, row, level, x.a, y.b), _texel(table, row, level, x.b, y.b), x.weight)
    return wp.lerp(top, bottom, y.weight)


def upload_textures(textures: Sequence[Texture], uv_sets: Sequence[str], launcher: Launcher) -> TextureTable:
    """Uploads textures, in their order.

    Args:
        textures: Validated textures.
        uv_sets: Names of the meshes' uv sets, in the order of their rows.
        launcher: Launcher of the device.
    """
    table = TextureTable()
    table.count = len(textures)
    rows = np.zeros(max(len(textures), 1), TextureRow.numpy_dtype())
    levels: list[tuple[int, int, int]] = []
    texels: list[npt.NDArray[np.float16]] = []
    total = 0
    for k, (texture, pixels) in enumerate(zip(textures, _within_budget(textures), strict=True)):
        chain = mip_chain(pixels)
        # Half floats hold 11 bits between 6e-5 and 65504: texels are scaled to at most 1, whatever their unit.
        low, high = value_range(pixels)
        largest = max(high, -low)
        scale = 2.0 ** math.ceil(math.log2(largest)) if largest > 0.0 else 1.0
        rows[k]["first_level"], rows[k]["level_count"], rows[k]["channels"] = len(levels), len(chain), pixels.shape[2]
        rows[k]["wrap_s"], rows[k]["wrap_t"] = texture.wrap
        rows[k]["scale"] = scale
        rows[k]["uv_set"] = uv_sets.index(texture.uv)
        rows[k]["s"], rows[k]["t"] = texture.transform
        rows[k]["outside"] = texture.outside
        if pixels.dtype == np.float16 and scale == 1.0:
            chain[0] = pixels  # as it is stored
        for level in chain:
            levels.append((level.shape[1], level.shape[0], total))
            scaled = level if scale == 1.0 else level / np.float32(scale)
            texels.append(scaled.astype(np.float16, copy=False).reshape(-1))
            total += level.size
    table.rows = launcher.array(rows, TextureRow)
    table.levels = launcher.array(np.array(levels or [(1, 1, 0)], np.int32), wp.vec3i)
    table.texels = launcher.array(np.concatenate(texels) if texels else np.zeros(1, np.float16), wp.float16)
    return table


def _within_budget(textures: Sequence[Texture]) -> list[Floats]:
    """The images, the largest halved until the mip chains of all fit into `MAX_BYTES` as half floats."""
    images: list[Floats] = [np.asarray(texture.pixels) for texture in textures]
    while sum(image.size for image in images) * 2 * 4 / 3 > MAX_BYTES:
        k = int(np.argmax([image.size for image in images]))
        height, width = images[k].shape[:2]
        if height == width == 1:
            break
        images[k] = resized(images[k], max(height // 2, 1), max(width // 2, 1))
    return images


def mean_on_triangles(texture: Texture, uvs: Floats, areas: Floats, footprint: float) -> Floats:
    """Estimates the mean over channels and area of `lookup` on each triangle: positive wherever `lookup` is, [m].

    Args:
        texture: The texture.
        uvs: Coordinates of the triangles' corners in the mesh's uv set, [m, 3, 2].
        areas: Areas of the triangles, [m], in the unit of the footprint's square.
        footprint: The footprint as passed to `mip_level`.
    """
    chain = [level[..., 0] for level in mip_chain(np.asarray(texture.pixels, np.float32).mean(axis=2, keepdims=True))]
    out = np.zeros(len(uvs))
    for first in range(0, len(uvs), _CHUNK):
        part = slice(first, first + _CHUNK)
        out[part] = _chunk_means(texture, chain, np.asarray(uvs[part], np.float64), areas[part], footprint)
    return out


def _chunk_means(texture: Texture, chain: list[Floats], uvs: Floats, areas: Floats, footprint: float) -> Floats:
    """`mean_on_triangles` for a chunk, from the channels' mean at every level of the mip chain."""
    matrix = np.asarray(texture.transform, np.float64)
    st = uvs @ matrix[:, :2].T + matrix[:, 2]
    low, high = st.min(axis=1), st.max(axis=1)
    for axis in range(2):
        if texture.wrap[axis] == Wrap.BLACK:  # beyond the edges the value is constant; it is added below
            low[:, axis], high[:, axis] = low[:, axis].clip(0.0, 1.0), high[:, axis].clip(0.0, 1.0)
    sizes = np.array([level.shape[::-1] for level in chain], np.float64)
    # A level on which the triangle spans at most `_WINDOW` pixels, and which is not finer than the one looked up.
    edge1, edge2 = uvs[:, 1] - uvs[:, 0], uvs[:, 2] - uvs[:, 0]
    st_area = 0.5 * np.abs(edge1[:, 0] * edge2[:, 1] - edge1[:, 1] * edge2[:, 0]) * abs(np.linalg.det(matrix[:, :2]))
    pixels = st_area / np.maximum(areas, 1e-300) * sizes[0].prod() * footprint**2
    lookup_level = 0.5 * np.log2(np.maximum(pixels, 1.0)) + 1.0
    span = ((high - low) * sizes[0]).max(axis=1) / _WINDOW
    level_of = np.maximum(np.ceil(np.log2(np.maximum(span, 1.0))), np.floor(lookup_level)).astype(int)
    level_of = np.minimum(level_of, len(chain) - 1)
    b = (np.arange(_WINDOW) + 1.0 / 3.0) / _WINDOW
    u, v = np.meshgrid(b, b)
    is_inside = u + v < 1.0
    weights = np.stack([u[is_inside], v[is_inside], 1.0 - u[is_inside] - v[is_inside]])
    steps = np.arange(-2, _WINDOW + 3)
    out = np.zeros(len(uvs))
    for level in np.unique(level_of):
        k = np.flatnonzero(level_of == level)
        size = sizes[level]
        points = np.einsum("mki,kp->mpi", st[k], weights)
        estimate = _fetch(texture, chain[level], np.floor(points * size)).mean(axis=1)
        # The window around the triangle holds every pixel from which interpolation on the triangle may take a value.
        corner = np.floor(low[k] * size)
        x = corner[:, 0, None, None] + steps[:, None] + 0 * steps
        y = corner[:, 1, None, None] + 0 * steps[:, None] + steps
        window_mean = _fetch(texture, chain[level], np.stack([x, y], axis=-1)).mean(axis=(1, 2))
        out[k] = 0.9 * estimate + 0.1 * window_mean
    if Wrap.BLACK in texture.wrap:
        out += 0.1 * np.mean(texture.outside)
    return out


def _fetch(texture: Texture, level: Floats, pixels: Floats) -> Floats:
    """Values of a level [h, w] at integer pixel coordinates [..., 2], counted from the lower left."""
    index, outside = [], np.zeros(pixels.shape[:-1], bool)
    for axis, size in ((0, level.shape[1]), (1, level.shape[0])):
        texel = pixels[..., axis].clip(-1e9, 1e9).astype(np.int64)
        if texture.wrap[axis] == Wrap.REPEAT:
            texel %= size
        elif texture.wrap[axis] == Wrap.MIRROR:
            texel %= 2 * size
            texel = np.minimum(texel, 2 * size - 1 - texel)
        elif texture.wrap[axis] == Wrap.BLACK:
            outside |= (texel < 0) | (texel >= size)
        index.append(texel.clip(0, size - 1))
    return np.where(outside, np.mean(texture.outside), level[level.shape[0] - 1 - index[1], index[0]])
