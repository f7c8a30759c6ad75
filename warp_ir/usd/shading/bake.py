"""Fields of shading networks as textures of one prim.

A field of one set of texture coordinates becomes an image over the part of them that the prim uses; equal parts share
it. Any other field, of positions, normals, primvars or several sets, becomes an image with a patch of texels for each
triangle and texture coordinates of its own. Both are as fine as the field needs, up to a limit: the size doubles until
interpolation between texels is as good as the picture shows.
"""

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b

import numpy as np
from pxr import Usd, UsdGeom

from warp_ir.scene import Floats, Ints, Wrap
from warp_ir.usd.images.shading_value import (
    PointRef,
    PrimvarRef,
    ShadingValue,
    SurfaceRef,
    UVMapping,
    UVRef,
    compact,
    digest,
)
from warp_ir.usd.values import primvar
from warp_ir.usd.values.report import Report
from warp_ir.usd.values.triangles import TriangleMesh, cross_products

FACE_TEXELS = "warp_ir:faceTexels"
"""Name of the texture coordinates of images with a patch for each triangle."""
_ERROR = 1.0 / 800.0
"""Mean error of interpolation between texels, in terms of the field's range or of 1, down to which textures grow."""
_COARSE = 0.02
"""Mean error from which a warning says that the largest texture is too coarse."""
_MIN_SIDE, _MAX_SIDE = 64, 2048
"""Smallest and largest side of an image over texture coordinates, in texels."""
MAX_FACE_TEXELS = 2**22
"""Largest number of texels of an image with a patch for each triangle."""
_WHOLE = 4.0
"""Texture coordinates that span at most this are rounded to whole numbers, so that more prims share an image."""
_PROBES = 2048
"""Number of points at which the error is estimated."""
_FACE_PROBES = 512
"""The same for images with a patch for each triangle."""
_CHUNK = 2**17
"""Number of points that are evaluated at a time, which limits the memory."""


class PrimSurface:
    """What networks read of a prim's triangles.

    Args:
        prim: The prim.
        shape: Its triangles.
        time: Time code of all values.
        report: Receives warnings.
    """

    def __init__(self, prim: Usd.Prim, shape: TriangleMesh, time: Usd.TimeCode, report: Report) -> None:
        self.prim, self._shape, self._time, self.report = prim, shape, time, report
        self._corners: dict[SurfaceRef, Floats | None] = {}

    def corners(self, ref: SurfaceRef) -> Floats | None:
        """Values at the corners, [m, 3, c], or [c] if they are equal; None: the prim has none."""
        if ref not in self._corners:
            self._corners[ref] = self._read(ref)
        return self._corners[ref]

    def _read(self, ref: SurfaceRef) -> Floats | None:
        if isinstance(ref, PrimvarRef):
            return primvar.corner_values(self.prim, self._shape, ref.name, ref.channels, self._time, self.report)
        if isinstance(ref, UVRef):
            uvs = primvar.texture_coordinates(self.prim, self._shape, ref.name, self._time, self.report)
            return None if uvs is None else uvs.astype(np.float64)
        if ref.what == "position":
            return self._shape.points[self._shape.triangles]
        if ref.what == "normal":
            if self._shape.normals is not None:
                return self._shape.normals.astype(np.float64)
            flat = cross_products(self._shape.points, self._shape.triangles)
            return np.asarray(np.repeat(_unit(flat)[:, None], 3, axis=1))
        matrix = UsdGeom.Xformable(self.prim).ComputeLocalToWorldTransform(self._time)
        return np.array(matrix).reshape(16)

    def at(self, refs: tuple[SurfaceRef, ...], triangles: Ints, weights: Floats) -> dict[SurfaceRef, Floats]:
        """Values at points of triangles [n] by their barycentric weights [n, 3]."""
        values = {}
        for ref in refs:
            corners = self.corners(ref)
            if corners is None:
                continue
            if corners.ndim > 1:
                corners = np.einsum("nk,nkc->nc", weights, corners[triangles])
                corners = _unit(corners) if ref == PointRef("normal") else corners
            values[ref] = corners
        return values

    @cached_property
    def areas(self) -> Floats:
        """Areas of the triangles [m]."""
        doubled: Floats = np.linalg.norm(cross_products(self._shape.points, self._shape.triangles), axis=-1)
        return 0.5 * doubled


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30))


@dataclass(frozen=True, eq=False)
class Baked:
    """A field as an image of one prim."""

    value: ShadingValue
    """The image; or a constant, if the field is one on this prim."""
    uvs: Floats | None = None
    """float32 [m, 3, 2], the texture coordinates `FACE_TEXELS` at the corners; None: it uses others."""


@dataclass(frozen=True, eq=False)
class FieldOnPrim:
    """A field on a prim, with what is constant there."""

    field: ShadingValue
    surface: PrimSurface

    @cached_property
    def varying(self) -> tuple[SurfaceRef, ...]:
        """What it reads that varies over the prim."""
        corners = {ref: self.surface.corners(ref) for ref in self.field.reads}
        return tuple(ref for ref, values in corners.items() if values is not None and values.ndim > 1)

    @property
    def over_uv(self) -> bool:
        """Whether it is a function of one set of texture coordinates, or constant."""
        return not self.varying or (len(self.varying) == 1 and isinstance(self.varying[0], UVRef))

    @cached_property
    def constants(self) -> dict[SurfaceRef, Floats]:
        """What it reads that the prim has once."""
        corners = {ref: self.surface.corners(ref) for ref in self.field.reads if ref not in self.varying}
        return {ref: values for ref, values in corners.items() if values is not None}

    def bake(self, patches: int, cache: dict[Hashable, ShadingValue]) -> Baked:
        """The field as a texture of the prim.

        Args:
            patches: Texels along an edge of a triangle's patch (`patch_size`), if it is not `over_uv`.
            cache: Images over texture coordinates that prims share; new ones are added.
        """
        if not self.over_uv:
            return _bake_faces(self.field, self.surface, patches)
        given = tuple((ref, tuple(values.tolist())) for ref, values in self.constants.items())
        if not self.varying:
            return Baked(self._constant())
        ref = self.varying[0]
        assert isinstance(ref, UVRef)
        corners = self.surface.corners(ref)
        assert corners is not None
        low, high = _part(corners)
        key = digest("bake", self.field.key, given, tuple(low), tuple(high))
        if key not in cache:
            cache[key] = self._over_uv(ref, low, high, key)
        return Baked(cache[key])

    def _constant(self) -> ShadingValue:
        number = np.asarray(self.field.evaluate(self.constants), np.float64).reshape(1, 1, -1)
        return ShadingValue(number, number[0, 0], None, ("baked", self.field.key, tuple(number[0, 0])))

    def _over_uv(self, ref: UVRef, low: Floats, high: Floats, key: Hashable) -> ShadingValue:
        """An image of the field over a rectangle of texture coordinates."""
        extent = high - low

        def at(st: Floats) -> Floats:
            return np.asarray(self.field.evaluate({**self.constants, ref: low + st * extent}))

        aspect = float(np.clip(extent[0] / extent[1], 1 / 16, 16))
        widest = [max(round(_MAX_SIDE * min(side, 1.0)), 1) for side in (aspect, 1.0 / aspect)]
        probes = np.random.default_rng(3).random((_PROBES, 2))
        exact = at(probes)
        if exact.ndim == 1:
            return self._constant()
        unit = max(1.0, float(np.ptp(exact, axis=0).max()))
        factor, error = _MAX_SIDE // _MIN_SIDE, math.inf
        while factor >= 1 and error > _ERROR * unit:
            size = np.maximum(np.array(widest) // factor, 1)
            error = _interpolation_error(at, probes, exact, size)
            factor //= 2
        _warn_if_coarse(self.surface, error / unit, "x".join(str(n) for n in size))
        columns, rows = (np.arange(n) + 0.5 for n in size)
        s, t = np.meshgrid(columns / size[0], 1.0 - rows / size[1])
        pixels = _evaluated(at, np.stack([s, t], axis=-1).reshape(-1, 2)).reshape(size[1], size[0], -1)
        scale = 1.0 / extent
        transform = tuple(
            (float(scale[k]) * (k == 0), float(scale[k]) * (k == 1), float(-low[k] * scale[k])) for k in (0, 1)
        )
        wraps = [
            Wrap.REPEAT if np.abs(at(probes + np.eye(2)[k]) - exact).max() < 1e-6 * unit else Wrap.CLAMP for k in (0, 1)
        ]
        mapping = UVMapping(ref.name, (transform[0], transform[1]), (wraps[0], wraps[1]))
        return ShadingValue(compact(pixels), pixels[0, 0], mapping, key, self.field.name or "a shading network")


def _part(corners: Floats) -> tuple[Floats, Floats]:
    """The rectangle of texture coordinates that an image covers, its corners [2] each."""
    flat = corners.reshape(-1, 2)
    low, high = flat.min(axis=0), flat.max(axis=0)
    if (high - low).max() <= _WHOLE:
        low, high = np.floor(low + 1e-5), np.ceil(high - 1e-5)
    return low, np.maximum(high, low + 1e-6 + 1e-6 * np.abs(low))


def _interpolation_error(at: Callable[[Floats], Floats], points: Floats, exact: Floats, size: Ints) -> float:
    """Mean error of bilinear interpolation between texels of an image of a size (columns, rows) at points [n, 2]."""
    place = points * size - 0.5
    below = np.floor(place)
    t = place - below
    total = np.zeros_like(exact, np.float64)
    for corner in ((0, 0), (1, 0), (0, 1), (1, 1)):
        texel = np.clip(below + corner, 0, np.asarray(size) - 1)
        weight = np.prod(np.where(corner, t, 1.0 - t), axis=-1, keepdims=True)
        total += weight * at((texel + 0.5) / size)
    return float(np.abs(total - exact).mean())


def _evaluated(at: Callable[[Floats], Floats], points: Floats) -> Floats:
    """Values at points, a part at a time."""
    return np.concatenate([np.asarray(at(points[k : k + _CHUNK]), np.float32) for k in range(0, len(points), _CHUNK)])


def _warn_if_coarse(surface: PrimSurface, error: float, size: str) -> None:
    if error > _COARSE:
        surface.report.warn(surface.prim.GetPath(), f"a pattern of its material is finer than the {size} texels for it")


def patch_size(fields: list[ShadingValue], surface: PrimSurface, density: float, most: int) -> int:
    """Texels along an edge of the triangles' patches, 2 or more, with which fields are fine enough on a prim.

    Args:
        fields: The fields.
        surface: The prim.
        density: Texels per unit of the prim's space beyond which the picture shows no difference.
        most: Largest number of texels.
    """
    count = len(surface.areas)
    rng = np.random.default_rng(3)
    total = surface.areas.sum()
    chosen = rng.choice(count, _FACE_PROBES, p=surface.areas / total if total > 0.0 else None)
    seen = density * math.sqrt(2.0 * float(np.quantile(surface.areas[chosen], 0.9)))
    xy = rng.random((_FACE_PROBES, 2))
    xy = np.where(xy.sum(axis=1, keepdims=True) > 1.0, 1.0 - xy, xy)
    size, error, unit = 2, math.inf, 1.0
    while True:
        error = 0.0
        for field in fields:

            def at(xy: Floats, field: ShadingValue = field) -> Floats:
                weights = np.concatenate([1.0 - xy.sum(axis=1, keepdims=True), xy], axis=1)
                return np.asarray(field.evaluate(surface.at(field.reads, chosen, weights)))

            exact = at(xy)
            unit = max(1.0, float(np.ptp(exact, axis=0).max())) if exact.ndim > 1 else 1.0
            place = xy * (size - 1)
            below = np.floor(place)
            t = place - below
            interpolated: Floats = np.zeros_like(exact, np.float64)
            for corner in ((0, 0), (1, 0), (0, 1), (1, 1)):
                weight = np.prod(np.where(corner, t, 1.0 - t), axis=-1, keepdims=True)
                interpolated = interpolated + weight * at((below + corner) / (size - 1))
            error = max(error, float(np.abs(interpolated - exact).mean()) / unit)
        if error <= _ERROR or size >= seen:
            break
        if texels(count, 2 * size) > min(most, MAX_FACE_TEXELS):
            _warn_if_coarse(surface, error, f"{texels(count, size)}")
            break
        size *= 2
    return size


def texels(triangles: int, size: int) -> int:
    """Texels of the patches of triangles: two triangles share (n + 1) by (n + 2) texels."""
    return -(-triangles // 2) * (size + 1) * (size + 2)


def _bake_faces(field: ShadingValue, surface: PrimSurface, size: int) -> Baked:
    """An image of a field with a patch of texels for each triangle.

    Two triangles share a block of (n + 1) by (n + 2) texels: the corners of the first are at the centres of texels
    (0, 0), (n - 1, 0) and (0, n - 1), those of the second likewise from the opposite end. Bilinear interpolation within
    a triangle reads no texel of the other; those next to it continue the triangle beyond its edge.
    """
    count = len(surface.areas)
    blocks = -(-count // 2)
    width, height = size + 1, size + 2
    across = max(math.isqrt(max(blocks * height // width, 1)), 1)
    down = -(-blocks // across)
    column, row = np.meshgrid(np.arange(width), np.arange(height))
    first = column + row <= size
    x = np.where(first, column, width - 1 - column) / (size - 1)
    y = np.where(first, row, height - 1 - row) / (size - 1)
    weights = np.stack([1.0 - x - y, x, y], axis=-1).reshape(-1, 3)
    is_second = ~first.reshape(-1)
    channels = field.pixels.shape[-1]
    pixels = np.zeros((blocks, width * height, channels), np.float32)
    per_chunk = max(_CHUNK // (width * height), 1)
    for start in range(0, blocks, per_chunk):
        index = np.arange(start, min(start + per_chunk, blocks))
        triangles = np.minimum(2 * index[:, None] + is_second, count - 1).reshape(-1)
        values = field.evaluate(surface.at(field.reads, triangles, np.tile(weights, (len(index), 1))))
        pixels[index] = np.broadcast_to(values, (len(triangles), channels)).reshape(len(index), -1, channels)
    if blocks < across * down:
        filler = np.broadcast_to(pixels.mean(axis=(0, 1)), (across * down - blocks, width * height, channels))
        pixels = np.concatenate([pixels, filler])
    image = pixels.reshape(down, across, height, width, channels).swapaxes(1, 2)
    image = image.reshape(down * height, across * width, channels)
    block = np.arange(count) // 2
    left, top = (block % across) * width, (block // across) * height
    ends = np.array([[0, 0], [size - 1, 0], [0, size - 1]])
    texels = np.where((np.arange(count) % 2 == 0)[:, None, None], ends, np.array([width - 1, height - 1]) - ends)
    s = (left[:, None] + texels[..., 0] + 0.5) / (across * width)
    t = 1.0 - (top[:, None] + texels[..., 1] + 0.5) / (down * height)
    image = compact(image)
    key = digest("faces", image.shape, blake2b(np.ascontiguousarray(image).tobytes()).digest())
    mapping = UVMapping(FACE_TEXELS, wrap=(Wrap.CLAMP, Wrap.CLAMP))
    value = ShadingValue(image, image[0, 0], mapping, key, field.name or "a shading network")
    return Baked(value, np.stack([s, t], axis=-1).astype(np.float32))
