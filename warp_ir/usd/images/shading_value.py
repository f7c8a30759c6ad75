"""Values of shading networks: constants, images mapped to a surface, or fields, functions of what a surface has.

Networks are evaluated when a stage is read, so that rendering costs one texture lookup: an image that is scaled, tinted
or mixed with constants, or with images of the same mapping, is an image again. What depends on anything else, such as
texture coordinates, positions, primvars or images of several mappings, is a field: it is evaluated at points of each
surface that has it (`shading/bake.py`).
"""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import blake2b

import numpy as np
import numpy.typing as npt

from warp_ir.image.mipmap import resized, value_range
from warp_ir.scene import Floats, Wrap
from warp_ir.scene.types import pixel_mean

_SAMPLES = 32
"""Number of rows and columns of the points at which a field is evaluated to know its range and its mean."""


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


@dataclass(frozen=True)
class UVRef:
    """A set of texture coordinates that a network reads; two channels."""

    name: str


@dataclass(frozen=True)
class PointRef:
    """Something else of the surface that a network reads."""

    what: str
    """"position" and "normal" (three channels, in the prim's own space), or "transform", the matrix to world space that
    row vectors are multiplied by (16 channels)."""


SurfaceRef = PrimvarRef | UVRef | PointRef
"""What networks read of surfaces."""
SurfaceValues = Mapping[SurfaceRef, Floats]
"""What a surface has of it: float [c] if constant, else at its points, [..., c]."""
_Field = Callable[[SurfaceValues, dict[int, Floats]], npt.ArrayLike]
"""A field's value by what a surface has; the dictionary holds the results of fields by their `id`."""


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
    reads: tuple[SurfaceRef, ...] = ()
    """What it reads of surfaces if it is a field; else empty. Then `pixels` are examples: values at sample points, on a
    surface without any primvars."""
    field: _Field | None = None
    """The value as a function of what it reads; None: it is no field."""

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

    @property
    def primvars(self) -> tuple[PrimvarRef, ...]:
        """The primvars that it reads."""
        return tuple(ref for ref in self.reads if isinstance(ref, PrimvarRef))

    @property
    def only_primvars(self) -> bool:
        """Whether it reads primvars of a surface and nothing else."""
        return bool(self.reads) and len(self.primvars) == len(self.reads)

    def evaluate(self, surface: SurfaceValues) -> Floats:
        """The value on a surface, [c] or [..., c]; that of an image where the surface has no texture coordinates."""
        return _evaluate(self, surface, {})


def _evaluate(value: ShadingValue, surface: SurfaceValues, results: dict[int, Floats]) -> Floats:
    if value.mapping is not None:
        ref = UVRef(value.mapping.uv)
        return look_up(value, surface[ref]) if ref in surface else value.mean
    if value.field is None:
        return value.mean
    if id(value) not in results:
        results[id(value)] = np.asarray(value.field(surface, results))
    return results[id(value)]


def _samples(ref: SurfaceRef) -> Floats:
    """What a surface may have, at `_SAMPLES` by `_SAMPLES` points."""
    rng = np.random.default_rng(17)
    grid = np.stack(np.meshgrid(np.arange(_SAMPLES), np.arange(_SAMPLES)), axis=-1) + rng.random((_SAMPLES,) * 2 + (2,))
    uv = grid / _SAMPLES
    if isinstance(ref, UVRef):
        return uv
    assert isinstance(ref, PointRef)
    if ref.what == "transform":
        return np.eye(4).reshape(1, 1, 16)
    z, angle = 2.0 * uv[..., :1] - 1.0, 2.0 * np.pi * uv[..., 1:]
    across = np.sqrt(1.0 - z * z)
    normal = np.concatenate([across * np.cos(angle), across * np.sin(angle), z], axis=-1)
    return normal if ref.what == "normal" else rng.random((_SAMPLES, _SAMPLES, 3)) * 2.0 - 1.0


def from_surface(ref: UVRef | PointRef) -> ShadingValue:
    """What a surface has at each point; 0 if it has no such texture coordinates."""
    pixels = _samples(ref)
    default = np.zeros(pixels.shape[-1])
    return ShadingValue(pixels, pixels[0, 0], None, ref, "", (ref,), lambda surface, _: surface.get(ref, default))


def from_primvar(primvar: PrimvarRef, fallback: ShadingValue) -> ShadingValue:
    """The value of a primvar, or the mean of the fallback on surfaces without it."""
    default = np.resize(fallback.mean, primvar.channels)
    return replace(
        constant(*default.tolist()),
        reads=(primvar,),
        field=lambda surface, _: surface.get(primvar, default),
        key=(primvar, tuple(default)),
    )


def constant(*channels: float) -> ShadingValue:
    """A constant of one value per channel."""
    value = np.array(channels, np.float64)
    return ShadingValue(value.reshape(1, 1, -1), value, None, tuple(channels))


def digest(*parts: Hashable) -> bytes:
    """A key of constant size: equal for parts of equal text."""
    return blake2b(repr(parts).encode(), digest_size=16).digest()


@np.errstate(all="ignore")
def combine(label: Hashable, function: Callable[..., npt.ArrayLike], *values: ShadingValue) -> ShadingValue:
    """Applies a function to values: texel by texel if they are constants and images of one mapping, else as a field.

    Args:
        label: Identifies the function in the key of the result.
        function: Takes one array [..., c] per value and returns an array [..., c].
        values: The arguments of the function.
    """
    images = [v for v in values if v.mapping is not None]
    key = digest(label, *(v.key for v in values))
    if any(v.reads for v in values) or len({v.mapping for v in images}) > 1:
        return _combined_fields(key, function, values)
    if not images:
        result = _finite(function(*(v.pixels for v in values)))
        return ShadingValue(result, result[0, 0], None, key)
    first = images[0]
    height, width = (max(v.pixels.shape[axis] for v in images) for axis in (0, 1))
    pixels = []
    for v in values:
        fits = v.mapping is None or v.pixels.shape[:2] == (height, width)
        pixels.append(v.pixels if fits else resized(v.pixels, height, width))
    result = _finite(function(*(np.asarray(p, np.float32) for p in pixels)))
    result = np.broadcast_to(result, (height, width, result.shape[-1]))
    border = _finite(function(*(v.outside for v in values)))
    return ShadingValue(compact(result), border, first.mapping, key, first.name)


def _combined_fields(
    key: Hashable, function: Callable[..., npt.ArrayLike], values: tuple[ShadingValue, ...]
) -> ShadingValue:
    """A function of values as a field."""
    mappings = [v.mapping for v in values if v.mapping is not None]
    reads = tuple(dict.fromkeys([*(ref for v in values for ref in v.reads), *(UVRef(m.uv) for m in mappings)]))
    examples = [look_up(v, _samples(UVRef(v.mapping.uv))) if v.mapping is not None else v.pixels for v in values]

    def field(surface: SurfaceValues, results: dict[int, Floats]) -> Floats:
        with np.errstate(all="ignore"):
            return _finite(function(*(_evaluate(v, surface, results) for v in values)))

    pixels = _finite(function(*examples))
    name = next((v.name for v in values if v.name), "")
    return ShadingValue(pixels, pixels[0, 0], None, key, name, reads, field)


def sampled(image: ShadingValue, coordinates: ShadingValue) -> ShadingValue:
    """An image at coordinates [..., 2] that are no affine function of a surface's, as a field."""
    return combine(
        ("sampled", image.key, image.mapping), lambda st: look_up(image, np.asarray(st, np.float64)), coordinates
    )


def as_affine(coordinates: ShadingValue) -> tuple[str, Floats] | None:
    """The set of texture coordinates of which a value is an affine function, and the matrix [3, 3]; None: it is not.

    It is fitted at three points and compared at others, so that it does not matter by which nodes it is computed.
    """
    if coordinates.mapping is not None or coordinates.pixels.shape[-1] < 2:
        return None
    matrix = np.eye(3)
    if not coordinates.reads:
        matrix[:2] = 0.0
        matrix[:2, 2] = coordinates.mean[:2]
        return "st", matrix
    ref = coordinates.reads[0]
    if len(coordinates.reads) > 1 or not isinstance(ref, UVRef):
        return None
    rng = np.random.default_rng(5)
    uv = np.concatenate([[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], rng.random((48, 2)), rng.normal(0.0, 30.0, (48, 2))])
    st = np.broadcast_to(coordinates.evaluate({ref: uv}), (len(uv), coordinates.pixels.shape[-1]))[:, :2]
    matrix[:2] = np.stack([st[1] - st[0], st[2] - st[0], st[0]], axis=1)
    expected = uv @ matrix[:2, :2].T + matrix[:2, 2]
    if np.abs(st - expected).max() > 1e-9 * max(1.0, float(np.abs(expected).max())):
        return None
    return ref.name, matrix


def _finite(values: npt.ArrayLike) -> Floats:
    """The values with NaN replaced by 0 and infinities by ±3e38: authored arithmetic may overflow."""
    array: Floats = np.asarray(values)
    return array if np.isfinite(array).all() else np.nan_to_num(array, nan=0.0, posinf=3.0e38, neginf=-3.0e38)


def select(value: ShadingValue, channels: list[int]) -> ShadingValue:
    """The given channels of a value, in that order."""
    pixels, outside = value.pixels[..., channels], np.asarray(value.outside)[channels]
    key = ("select", tuple(channels), value.key)
    if value.field is None:
        return replace(value, pixels=pixels, outside=outside, key=key)

    def field(surface: SurfaceValues, results: dict[int, Floats]) -> Floats:
        return _evaluate(value, surface, results)[..., channels]

    return replace(value, pixels=pixels, outside=outside, key=key, field=field)


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
