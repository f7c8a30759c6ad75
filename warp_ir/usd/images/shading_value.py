"""Values of shading networks: constants, images mapped to a surface, or functions of primvars.

Networks are evaluated per texel when a stage is read, so that rendering costs one texture lookup: an image that is
scaled, tinted or mixed with constants is an image again. Images of the same UV mapping are combined texel by texel;
of images with different mappings, all but the first are replaced by their means.
"""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from warp_ir.image.mipmap import resized, value_range
from warp_ir.scene import Floats, Wrap
from warp_ir.scene.types import pixel_mean


@dataclass(frozen=True)
class UVMapping:
    """How an image is mapped to a surface: fields as in `Texture`."""

    uv: str = "st"
    transform: tuple[tuple[float, float, float], tuple[float, float, float]] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    wrap: tuple[Wrap, Wrap] = (Wrap.REPEAT, Wrap.REPEAT)


@dataclass(frozen=True)
class PrimvarRef:
    """A primvar that a network reads."""

    name: str
    channels: int


PrimvarValues = Mapping[PrimvarRef, Floats]
"""Values of the primvars that a surface has: float [c] if constant, else per corner [m, 3, c]."""


@dataclass(frozen=True, eq=False)
class ShadingValue:
    """The value of an output of a shading network."""

    pixels: Floats
    """float [h, w, c], [1, 1, c] for a constant; row 0 at the top."""
    outside: Floats
    """float [c], the border value outside of the image (wrap mode BLACK)."""
    mapping: UVMapping | None
    """How the image is mapped to the surface; None: a constant."""
    key: Hashable
    """Equal for equal values."""
    name: str = ""
    """Path of the image."""
    primvars: tuple[PrimvarRef, ...] = ()
    """The primvars that it depends on; `pixels` is the value on surfaces without any of them."""
    function: Callable[[PrimvarValues], Floats] | None = None
    """The value as a function of primvars, images replaced by their means; None: independent of primvars."""

    @cached_property
    def mean(self) -> Floats:
        """Mean over the pixels, float64 [c]."""
        return pixel_mean(self.pixels)

    @cached_property
    def lowest(self) -> float:
        """Minimum over the pixels and their channels."""
        return value_range(self.pixels)[0]

    @cached_property
    def highest(self) -> float:
        """Maximum over the pixels and their channels."""
        return value_range(self.pixels)[1]

    def evaluate(self, primvars: PrimvarValues) -> Floats:
        """The value on a surface with these primvars, [c] or [m, 3, c]."""
        return self.mean if self.function is None else self.function(primvars)


def from_primvar(primvar: PrimvarRef, fallback: ShadingValue) -> ShadingValue:
    """The value of a primvar, or the mean of the fallback on surfaces without it."""
    default = np.resize(fallback.mean, primvar.channels)
    return replace(
        constant(*default.tolist()),
        primvars=(primvar,),
        function=lambda values: values.get(primvar, default),
        key=primvar,
    )


def constant(*channels: float) -> ShadingValue:
    """A constant of one value per channel."""
    value = np.array(channels, np.float64)
    return ShadingValue(value.reshape(1, 1, -1), value, None, tuple(channels))


def combine(label: Hashable, function: Callable[..., npt.ArrayLike], *values: ShadingValue) -> ShadingValue:
    """Applies a function to values, texel by texel.

    Args:
        label: Identifies the function in the key of the result.
        function: Takes one array [..., c] per value and returns an array [..., c].
        values: The arguments of the function.
    """
    images = [v for v in values if v.mapping is not None]
    key = (label, *(v.key for v in values))
    primvars = tuple(dict.fromkeys(p for v in values for p in v.primvars))
    of_primvars = (lambda given: _finite(function(*(v.evaluate(given) for v in values)))) if primvars else None
    if not images:
        result = _finite(function(*(v.pixels for v in values)))
        return ShadingValue(result, result[0, 0], None, key, "", primvars, of_primvars)
    first = images[0]
    aligned = [v for v in images if v.mapping == first.mapping]
    height, width = (max(v.pixels.shape[axis] for v in aligned) for axis in (0, 1))
    pixels, outside = [], []
    for v in values:
        if v.mapping is not None and v.mapping != first.mapping:
            pixels.append(v.mean.reshape(1, 1, -1))
            outside.append(v.mean)
        else:
            fits = v.mapping is None or v.pixels.shape[:2] == (height, width)
            pixels.append(v.pixels if fits else resized(v.pixels, height, width))
            outside.append(v.outside)
    result = _finite(function(*(np.asarray(p, np.float32) for p in pixels)))
    result = np.broadcast_to(result, (height, width, result.shape[-1]))
    border = _finite(function(*outside))
    return ShadingValue(compact(result), border, first.mapping, key, first.name, primvars, of_primvars)


def _finite(values: npt.ArrayLike) -> Floats:
    """The values with NaN replaced by 0 and infinities by ±3e38: authored arithmetic may overflow."""
    array: Floats = np.asarray(values)
    return array if np.isfinite(array).all() else np.nan_to_num(array, nan=0.0, posinf=3.0e38, neginf=-3.0e38)


def select(value: ShadingValue, channels: list[int]) -> ShadingValue:
    """The given channels of a value, in that order."""
    pixels, outside = value.pixels[..., channels], np.asarray(value.outside)[channels]
    function = None if value.function is None else lambda primvars: value.evaluate(primvars)[..., channels]
    key = ("select", tuple(channels), value.key)
    return replace(value, pixels=pixels, outside=outside, key=key, function=function)


def as_color(value: ShadingValue) -> ShadingValue:
    """A value of three channels: the first three, or the first one repeated."""
    count = value.pixels.shape[2]
    if count == 3:
        return value
    return select(value, [0, 1, 2] if count > 3 else [0, 0, 0])


def compact(pixels: Floats) -> Floats:
    """The pixels in half precision (11 significant bits from 6e-5 to 65504), unless one exceeds its range."""
    if pixels.dtype == np.float16 or np.abs(pixels).max() > 6.0e4:
        return pixels
    return pixels.astype(np.float16)


def look_up(value: ShadingValue, uvs: Floats) -> Floats:
    """The value at texture coordinates [..., 2], bilinearly interpolated, float64 [..., c]."""
    if value.mapping is None:
        return np.broadcast_to(value.mean, (*uvs.shape[:-1], len(value.mean)))
    height, width, _ = value.pixels.shape
    st = uvs.astype(np.float64) @ np.array(value.mapping.transform)[:, :2].T + np.array(value.mapping.transform)[:, 2]
    neighbours, outside = [], np.zeros(st.shape[:-1], dtype=bool)
    for axis, size in ((0, width), (1, height)):
        x = st[..., axis] if axis == 0 else 1.0 - st[..., axis]
        wrap = value.mapping.wrap[axis]
        if wrap == Wrap.MIRROR:
            x = 1.0 - np.abs(np.mod(x, 2.0) - 1.0)
        elif wrap == Wrap.BLACK:
            outside |= (x < 0.0) | (x > 1.0)
        place = x * size - 0.5
        low = np.floor(place).astype(np.int64)
        pair = [low, low + 1]
        pair = [np.mod(k, size) if wrap == Wrap.REPEAT else k.clip(0, size - 1) for k in pair]
        neighbours.append((pair, (place - low)[..., None]))
    (columns, s), (rows, t) = neighbours
    pixels = value.pixels
    top, bottom = ((1.0 - s) * pixels[row, columns[0]] + s * pixels[row, columns[1]] for row in rows)
    out: Floats = (1.0 - t) * top + t * bottom
    out[outside] = value.outside
    return out
