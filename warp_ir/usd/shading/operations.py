"""Nodes of MaterialX's standard library as functions of arrays: what it builds from nothing else, and common ones.

An array has the shape [..., c]; one channel stands for all. The formulas are those of the library's shader sources
(`stdlib/genosl`, `genglsl`). All other nodes are graphs of these (`definitions.py`); that of common ones spares reading
the library, and the tests compare both.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from warp_ir.scene import Floats
from warp_ir.usd.shading import noise

_EPSILON = 1e-6
_ACESCG = (0.2722287, 0.6740818, 0.0536895)
"""MaterialX's default weights of luminance."""
UV, POSITION = "texture coordinates", "position"
"""Defaults of inputs that are not constants: the first set of texture coordinates, and the position on the prim."""


@dataclass(frozen=True)
class Operation:
    """A node that is a function of its inputs."""

    inputs: Mapping[str, tuple[float, ...] | str]
    """Default values of the inputs, in the order of the function's arguments; or `UV` or `POSITION`."""
    function: Callable[..., npt.ArrayLike]
    """Takes an array per input; and, if `by_channels`, the number of the output's channels as `channels`."""
    by_channels: bool = False


def _unary(function: Callable[[Floats], npt.ArrayLike], default: float = 0.0) -> Operation:
    return Operation({"in": (default,)}, function)


def _binary(function: Callable[[Floats, Floats], npt.ArrayLike], one: float, other: float) -> Operation:
    return Operation({"in1": (one,), "in2": (other,)}, function)


def _choice(condition: Callable[[Floats, Floats], npt.ArrayLike], value1: float, *, boolean: bool) -> Operation:
    ends = (1.0, 0.0) if boolean else (0.0, 0.0)
    inputs = {"value1": (value1,), "value2": (0.0,), "in1": (ends[0],), "in2": (ends[1],)}
    return Operation(inputs, lambda a, b, one, other: np.where(condition(a, b), one, other))


def _blend(function: Callable[[Floats, Floats], npt.ArrayLike], channels: int = 1) -> Operation:
    """A compositing node: a function of foreground and background, faded into the background."""
    zero = (0.0,) * channels
    inputs = {"fg": zero, "bg": zero, "mix": (1.0,)}
    return Operation(inputs, lambda fg, bg, mix: np.asarray(function(fg, bg)) * mix + bg * (1.0 - mix))


def divide(a: Floats, b: Floats) -> Floats:
    """The quotient, 0 where it is not defined."""
    return np.asarray(a / np.where(b == 0.0, np.inf, b))


def _modulo(a: Floats, b: Floats) -> Floats:
    return np.asarray(a - b * np.floor(divide(a, b)))


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray((a * b).sum(axis=-1, keepdims=True))


def _cross(a: Floats, b: Floats) -> Floats:
    one, other = np.broadcast_arrays(a, b)
    return np.asarray(np.cross(one, other))


def _length(a: Floats) -> Floats:
    return np.asarray(np.linalg.norm(a, axis=-1, keepdims=True))


def mix(background: Floats, foreground: Floats, weight: Floats) -> Floats:
    """Linear interpolation."""
    return np.asarray(background * (1.0 - weight) + foreground * weight)


def smoothstep(x: Floats, low: Floats, high: Floats) -> Floats:
    """Hermite interpolation between two thresholds; a step where they coincide."""
    t = np.clip(divide(x - low, high - low), 0.0, 1.0)
    return np.where(x >= high, 1.0, np.where(x <= low, 0.0, t * t * (3.0 - 2.0 * t)))


def _remap(x: Floats, inlow: Floats, inhigh: Floats, outlow: Floats, outhigh: Floats) -> Floats:
    return np.asarray(outlow + divide((x - inlow) * (outhigh - outlow), inhigh - inlow))


def concatenated(*parts: Floats) -> Floats:
    """Channels side by side."""
    return np.concatenate(np.broadcast_arrays(*parts), axis=-1)


def _combined(*parts: Floats) -> Floats:
    return concatenated(*(part[..., :1] for part in parts))


def _joined(one: Floats, other: Floats) -> Floats:
    """All channels of two values."""
    shape = np.broadcast_shapes(one.shape[:-1], other.shape[:-1])
    return np.concatenate([np.broadcast_to(part, (*shape, part.shape[-1])) for part in (one, other)], axis=-1)


def converted(value: Floats, channels: int) -> Floats:
    """A value with another number of channels: one is repeated, alpha is added as 1 and depth as 0."""
    count = value.shape[-1]
    if count == 1:
        return np.repeat(value, channels, axis=-1)
    missing = [np.full((*value.shape[:-1], 1), 1.0 if k == 3 else 0.0) for k in range(count, channels)]
    return np.concatenate([value[..., :channels], *missing], axis=-1)


def rgb_to_hsv(rgb: Floats) -> Floats:
    """Hue, saturation and value, hue in [0, 1); further channels are left."""
    r, g, b = (rgb[..., k] for k in range(3))
    top, chroma = rgb[..., :3].max(axis=-1), np.ptp(rgb[..., :3], axis=-1)
    saturation = np.where(top > 0.0, divide(chroma, top), 0.0)
    hue = np.where(r >= top, divide(g - b, chroma), np.where(g >= top, 2.0, 4.0))
    hue = np.where((r < top) & (g >= top), 2.0 + divide(b - r, chroma), hue)
    hue = np.where((r < top) & (g < top), 4.0 + divide(r - g, chroma), hue) / 6.0
    hue = np.where(saturation > 0.0, np.where(hue < 0.0, hue + 1.0, hue), 0.0)
    return np.concatenate([np.stack([hue, saturation, top], axis=-1), rgb[..., 3:]], axis=-1)


def hsv_to_rgb(hsv: Floats) -> Floats:
    """The inverse of `rgb_to_hsv`."""
    h, s, v = (hsv[..., k] for k in range(3))
    h = 6.0 * (h - np.floor(h))
    f = h - np.trunc(h)
    p, q, t = v * (1.0 - s), v * (1.0 - s * f), v * (1.0 - s * (1.0 - f))
    sector = np.trunc(h).astype(np.int64).clip(0, 5)
    rgb = [np.choose(sector, parts) for parts in ((v, q, p, p, t, v), (t, v, v, q, p, p), (p, p, t, v, v, q))]
    rgb = [np.where(s < 1e-4, v, part) for part in rgb]
    return np.concatenate([np.stack(rgb, axis=-1), hsv[..., 3:]], axis=-1)


def _luminance(color: Floats, weights: Floats) -> Floats:
    grey = _dot(color[..., :3], weights[..., :3])
    return np.concatenate([grey.repeat(3, -1), color[..., 3:]], axis=-1)


def _disjoint_over(fg: Floats, bg: Floats) -> Floats:
    alpha, below = fg[..., 3:], bg[..., 3:]
    share = np.where(alpha + below <= 1.0, 1.0, divide(1.0 - alpha, below))
    return np.concatenate(
        [
            np.where((alpha + below > 1.0) & (np.abs(below) < _EPSILON), 0.0, fg[..., :3] + bg[..., :3] * share),
            np.minimum(alpha + below, 1.0),
        ],
        axis=-1,
    )


def _matte(fg: Floats, bg: Floats) -> Floats:
    alpha = fg[..., 3:]
    return np.concatenate(
        [fg[..., :3] * alpha + bg[..., :3] * (1.0 - alpha), alpha + bg[..., 3:] * (1.0 - alpha)], axis=-1
    )


def _burn(fg: Floats, bg: Floats, weight: Floats) -> Floats:
    return np.where(np.abs(fg) < _EPSILON, 0.0, weight * (1.0 - divide(1.0 - bg, fg)) + (1.0 - weight) * bg)


def _dodge(fg: Floats, bg: Floats, weight: Floats) -> Floats:
    return np.where(np.abs(1.0 - fg) < _EPSILON, 0.0, weight * divide(bg, 1.0 - fg) + (1.0 - weight) * bg)


def rotated(vectors: Floats, degrees: Floats) -> Floats:
    """Vectors [..., 2] turned clockwise."""
    angle = np.radians(degrees[..., 0])
    x, y, s, c = vectors[..., 0], vectors[..., 1], np.sin(angle), np.cos(angle)
    return np.stack([c * x + s * y, c * y - s * x], axis=-1)


def _rotated_about(vectors: Floats, degrees: Floats, axis: Floats) -> Floats:
    angle, axis = np.radians(degrees), divide(axis, _length(axis))
    s, c = np.sin(angle), np.cos(angle)
    along = axis * _dot(axis, vectors)
    return np.asarray(vectors * c + _cross(vectors, axis) * s + along * (1.0 - c))


def unpacked_normal(packed: Floats, scale: Floats) -> Floats:
    """Normals in tangent space from values in [0, 1], as the node normalmap decodes them; the scale is of x and y."""
    across = np.broadcast_to(scale, (*scale.shape[:-1], 2))
    return np.asarray((2.0 * packed - 1.0) * np.concatenate([across, np.ones_like(scale[..., :1])], axis=-1))


def _matrix(flat: Floats) -> Floats:
    size = 3 if flat.shape[-1] == 9 else 4
    return flat.reshape(*flat.shape[:-1], size, size)


def _flat(matrix: Floats) -> Floats:
    return np.asarray(matrix).reshape(*np.shape(matrix)[:-2], -1)


def transformed(vectors: Floats, flat: Floats, weight: float = 1.0) -> Floats:
    """Row vectors times matrices [..., 9 or 16]; where these are larger, the vectors are extended by `weight`."""
    matrix, count = _matrix(flat), vectors.shape[-1]
    if matrix.shape[-1] > count:
        one = np.full((*vectors.shape[:-1], 1), weight)
        zeros = [np.zeros_like(one)] * (matrix.shape[-1] - count - 1)
        vectors = np.concatenate([vectors, *zeros, one], axis=-1)
    return np.asarray(np.einsum("...i,...ij->...j", vectors, matrix)[..., :count])


def _products(a: Floats, b: Floats) -> Floats:
    """The product; of matrices if both are."""
    return _flat(_matrix(a) @ _matrix(b)) if min(a.shape[-1], b.shape[-1]) > 4 else np.asarray(a * b)


def _quotients(a: Floats, b: Floats) -> Floats:
    if min(a.shape[-1], b.shape[-1]) > 4:
        return _flat(_matrix(a) @ _inverse(_matrix(b)))
    return divide(a, b)


def _inverse(matrix: Floats) -> Floats:
    singular = np.abs(np.linalg.det(matrix)) < 1e-300
    return np.linalg.inv(np.where(singular[..., None, None], np.eye(matrix.shape[-1]), matrix))


def _created_matrix(*rows: Floats) -> Floats:
    size = len(rows)
    ends = [np.eye(size)[k, rows[0].shape[-1] :] for k in range(size)]
    padded = [(row, np.broadcast_to(end, (*row.shape[:-1], len(end)))) for row, end in zip(rows, ends, strict=True)]
    return concatenated(*(np.concatenate(pair, axis=-1) for pair in padded))


def _place_2d(uv: Floats, pivot: Floats, scale: Floats, degrees: Floats, offset: Floats, order: Floats) -> Floats:
    """Texture coordinates scaled, turned and moved; in the other order if `order` is 1."""
    centred = uv - pivot
    one = rotated(divide(centred, scale), degrees) - offset
    return np.where(order > 0.5, divide(rotated(centred - offset, degrees), scale), one) + pivot


def _place_in_maya(uv: Floats, repeat: Floats, offset: Floats, radians: Floats) -> Floats:
    """Texture coordinates turned about the centre, repeated and moved."""
    return np.asarray((rotated(uv[..., :2] - 0.5, -np.degrees(radians)) + 0.5) * repeat + offset)


def _file_in_maya(color: Floats, gain: Floats, offset: Floats, exposure: Floats, inverts: Floats) -> Floats:
    """The colour correction of Maya's file textures."""
    rgb = np.where(inverts != 0.0, 1.0 - color, color)[..., :3] * 2.0**exposure * gain[..., :3] + offset[..., :3]
    return _joined(rgb, color[..., 3:])


_XYZ_TO_RGB = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])


def _blackbody(kelvin: Floats) -> Floats:
    """The colour of a black body of luminance 1, by Kang et al.'s fits of its chromaticity."""
    kelvin = np.clip(kelvin[..., 0], 800.0, 25000.0)
    t = 1000.0 / kelvin
    x = np.where(
        kelvin < 4000.0,
        np.polyval([-0.2661239, -0.2343580, 0.8776956, 0.179910], t),
        np.polyval([-3.0258469, 2.1070379, 0.2226347, 0.240390], t),
    )
    low = np.polyval([-1.1063814, -1.34811020, 2.18555832, -0.20219683], x)
    middle = np.polyval([-0.9549476, -1.37418593, 2.09137015, -0.16748867], x)
    high = np.polyval([3.0817580, -5.87338670, 3.75112997, -0.37001483], x)
    y = np.where(kelvin < 2222.0, low, np.where(kelvin < 4000.0, middle, high))
    xyz = np.stack([x / y, np.ones_like(x), (1.0 - x - y) / y], axis=-1)
    return np.asarray(np.maximum(xyz @ _XYZ_TO_RGB.T, 0.0))


def _range(
    x: Floats, inlow: Floats, inhigh: Floats, gamma: Floats, outlow: Floats, outhigh: Floats, clamps: Floats
) -> Floats:
    """Remapping with a power between, clamped to the output's range if asked to."""
    unit = divide(x - inlow, inhigh - inlow)
    out = outlow + np.sign(unit) * np.abs(unit) ** divide(np.ones_like(gamma), gamma) * (outhigh - outlow)
    return np.where(clamps != 0.0, np.minimum(np.maximum(out, outlow), outhigh), out)


def _saturate(color: Floats, amount: Floats, weights: Floats) -> Floats:
    return mix(_luminance(color, weights), color, amount)


def _hsv_adjust(color: Floats, amount: Floats) -> Floats:
    """Hue moved, saturation and value multiplied."""
    hsv = rgb_to_hsv(color)
    hue, rest = hsv[..., :1] + amount[..., :1], hsv[..., 1:3] * amount[..., 1:3]
    adjusted = np.broadcast_arrays(hue, rest[..., :1], rest[..., 1:])
    return hsv_to_rgb(np.concatenate([*adjusted, hsv[..., 3:]], axis=-1))


def _overlay(fg: Floats, bg: Floats) -> Floats:
    return np.where(bg >= 0.5, 1.0 - 2.0 * (1.0 - fg) * (1.0 - bg), 2.0 * fg * bg)


def _ramp4(tl: Floats, tr: Floats, bl: Floats, br: Floats, uv: Floats) -> Floats:
    s, t = np.clip(uv[..., :1], 0.0, 1.0), np.clip(uv[..., 1:2], 0.0, 1.0)
    return mix(mix(bl, br, s), mix(tl, tr, s), t)


def _checkerboard(one: Floats, other: Floats, tiling: Floats, offset: Floats, uv: Floats) -> Floats:
    odd = np.floor(uv[..., :2] * tiling - offset).sum(-1, keepdims=True) % 2.0
    return mix(other, one, odd)


def _switch(which: Floats, *values: Floats) -> Floats:
    """The value of the index below `which`; 0 beyond the last."""
    out: Floats = np.zeros(1)
    for k in range(len(values), 0, -1):
        out = np.where(which < k, values[k - 1], out)
    return out


def _number(value: Floats) -> float:
    """A uniform input: its first value."""
    return float(np.asarray(value).reshape(-1)[0])


def _noise(points: Floats, amplitude: Floats, pivot: Floats, channels: int) -> Floats:
    return np.asarray(noise.perlin(points, channels) * amplitude + pivot)


def _fractal(
    size: int,
    points: Floats,
    amplitude: Floats,
    octaves: Floats,
    lacunarity: Floats,
    diminish: Floats,
    channels: int,
) -> Floats:
    numbers = int(_number(octaves)), _number(lacunarity), _number(diminish)
    return np.asarray(noise.fractal(points[..., :size], channels, *numbers) * amplitude)


def _worley(points: Floats, jitter: Floats, style: Floats, channels: int) -> Floats:
    return noise.worley(points, channels, _number(jitter), int(_number(style)))


def _noises(suffix: str, points: str, where: str) -> dict[str, Operation]:
    size = 2 if suffix == "2d" else 3
    at: dict[str, tuple[float, ...] | str] = {points: where}
    octaves = {"amplitude": (1.0,), "octaves": (3.0,), "lacunarity": (2.0,), "diminish": (0.5,)}
    return {
        f"noise{suffix}": Operation(
            {**at, "amplitude": (1.0,), "pivot": (0.0,)},
            lambda p, amplitude, pivot, channels: _noise(p[..., :size], amplitude, pivot, channels),
            True,
        ),
        f"fractal{suffix}": Operation(
            {**at, **octaves},
            partial(_fractal, size),
            True,
        ),
        f"cellnoise{suffix}": Operation(at, lambda p: noise.cell(p[..., :size])),
        f"worleynoise{suffix}": Operation(
            {**at, "jitter": (1.0,), "style": (0.0,)},
            lambda p, jitter, style, channels: _worley(p[..., :size], jitter, style, channels),
            True,
        ),
    }


_HSV: tuple[float, ...] = (0.0, 0.0, 0.0)
_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
_LR = {"valuel": (0.0,), "valuer": (0.0,)}
_TB = {"valuet": (0.0,), "valueb": (0.0,)}
_CENTER: dict[str, tuple[float, ...] | str] = {"center": (0.5,), "texcoord": UV}
_AT: dict[str, tuple[float, ...] | str] = {"texcoord": UV}

OPERATIONS: dict[str, Operation] = {
    "constant": Operation({"value": (0.0,)}, np.asarray),
    "dot": _unary(np.asarray),
    "absval": _unary(np.abs),
    "sign": _unary(np.sign),
    "floor": _unary(np.floor),
    "ceil": _unary(np.ceil),
    "round": _unary(np.rint),
    "fract": _unary(lambda a: a - np.floor(a)),
    "sqrt": _unary(lambda a: np.sqrt(np.maximum(a, 0.0))),
    "ln": _unary(lambda a: np.log(np.maximum(a, 1e-300)), 1.0),
    "exp": _unary(np.exp),
    "sin": _unary(np.sin),
    "cos": _unary(np.cos),
    "tan": _unary(np.tan),
    "asin": _unary(lambda a: np.arcsin(np.clip(a, -1.0, 1.0))),
    "acos": _unary(lambda a: np.arccos(np.clip(a, -1.0, 1.0))),
    "atan2": Operation({"iny": (0.0,), "inx": (1.0,)}, np.arctan2),
    "add": _binary(np.add, 0.0, 0.0),
    "subtract": _binary(np.subtract, 0.0, 0.0),
    "multiply": _binary(_products, 0.0, 1.0),
    "divide": _binary(_quotients, 0.0, 1.0),
    "modulo": _binary(_modulo, 0.0, 1.0),
    "power": _binary(lambda a, b: np.maximum(a, 0.0) ** b, 0.0, 1.0),
    "min": _binary(np.minimum, 0.0, 0.0),
    "max": _binary(np.maximum, 0.0, 0.0),
    "invert": Operation({"in": (0.0,), "amount": (1.0,)}, lambda a, amount: amount - a),
    "clamp": Operation({"in": (0.0,), "low": (0.0,), "high": (1.0,)}, lambda a, b, c: np.minimum(np.maximum(a, b), c)),
    "smoothstep": Operation({"in": (0.0,), "low": (0.0,), "high": (1.0,)}, smoothstep),
    "remap": Operation({"in": (0.0,), "inlow": (0.0,), "inhigh": (1.0,), "outlow": (0.0,), "outhigh": (1.0,)}, _remap),
    "normalize": _unary(lambda a: divide(a, _length(a))),
    "magnitude": _unary(_length),
    "dotproduct": _binary(_dot, 0.0, 0.0),
    "crossproduct": Operation({"in1": (0.0,) * 3, "in2": (0.0,) * 3}, _cross),
    "rotate2d": Operation({"in": (0.0, 0.0), "amount": (0.0,)}, rotated),
    "rotate3d": Operation({"in": (0.0,) * 3, "amount": (0.0,), "axis": (0.0, 1.0, 0.0)}, _rotated_about),
    "place2d": Operation(
        {
            "texcoord": UV,
            "pivot": (0.0, 0.0),
            "scale": (1.0, 1.0),
            "rotate": (0.0,),
            "offset": (0.0, 0.0),
            "operationorder": (0.0,),
        },
        _place_2d,
    ),
    "transformmatrix": Operation({"in": (0.0,) * 3, "mat": _IDENTITY}, transformed),
    "creatematrix": Operation(
        {"in1": (1.0, 0.0, 0.0), "in2": (0.0, 1.0, 0.0), "in3": (0.0, 0.0, 1.0)}, _created_matrix
    ),
    "creatematrix_4": Operation({f"in{k + 1}": tuple(np.eye(4)[k, :3]) for k in range(4)}, _created_matrix),
    "transpose": Operation({"in": _IDENTITY}, lambda a: _flat(np.swapaxes(_matrix(a), -1, -2))),
    "invertmatrix": Operation({"in": _IDENTITY}, lambda a: _flat(_inverse(_matrix(a)))),
    "determinant": Operation({"in": _IDENTITY}, lambda a: np.linalg.det(_matrix(a))[..., None]),
    "rgbtohsv": Operation({"in": _HSV}, rgb_to_hsv),
    "hsvtorgb": Operation({"in": _HSV}, hsv_to_rgb),
    "luminance": Operation({"in": _HSV, "lumacoeffs": _ACESCG}, _luminance),
    "blackbody": Operation({"temperature": (5000.0,)}, _blackbody),
    "premult": Operation(
        {"in": (0.0, 0.0, 0.0, 1.0)}, lambda a: np.concatenate([a[..., :3] * a[..., 3:], a[..., 3:]], -1)
    ),
    "unpremult": Operation(
        {"in": (0.0, 0.0, 0.0, 1.0)}, lambda a: np.concatenate([divide(a[..., :3], a[..., 3:]), a[..., 3:]], -1)
    ),
    "mix": Operation({"bg": (0.0,), "fg": (0.0,), "mix": (0.0,)}, mix),
    "plus": _blend(np.add),
    "minus": _blend(lambda fg, bg: bg - fg),
    "difference": _blend(lambda fg, bg: np.abs(bg - fg)),
    "screen": _blend(lambda fg, bg: 1.0 - (1.0 - fg) * (1.0 - bg)),
    "burn": Operation({"fg": (0.0,), "bg": (0.0,), "mix": (1.0,)}, _burn),
    "dodge": Operation({"fg": (0.0,), "bg": (0.0,), "mix": (1.0,)}, _dodge),
    "in": _blend(lambda fg, bg: fg * bg[..., 3:], 4),
    "out": _blend(lambda fg, bg: fg * (1.0 - bg[..., 3:]), 4),
    "mask": _blend(lambda fg, bg: bg * fg[..., 3:], 4),
    "over": _blend(lambda fg, bg: fg + bg * (1.0 - fg[..., 3:]), 4),
    "matte": _blend(_matte, 4),
    "disjointover": _blend(_disjoint_over, 4),
    "inside": Operation({"in": (0.0,), "mask": (1.0,)}, np.multiply),
    "outside": Operation({"in": (0.0,), "mask": (0.0,)}, lambda a, mask: a * (1.0 - mask)),
    "overlay": _blend(_overlay),
    "range": Operation(
        {
            "in": (0.0,),
            "inlow": (0.0,),
            "inhigh": (1.0,),
            "gamma": (1.0,),
            "outlow": (0.0,),
            "outhigh": (1.0,),
            "doclamp": (0.0,),
        },
        _range,
    ),
    "contrast": Operation(
        {"in": (0.0,), "amount": (1.0,), "pivot": (0.5,)}, lambda a, amount, pivot: (a - pivot) * amount + pivot
    ),
    "saturate": Operation({"in": _HSV, "amount": (1.0,), "lumacoeffs": _ACESCG}, _saturate),
    "hsvadjust": Operation({"in": _HSV, "amount": (0.0, 1.0, 1.0)}, _hsv_adjust),
    "safepower": _binary(lambda a, b: np.sign(a) * np.abs(a) ** b, 0.0, 1.0),
    "distance": Operation({"in1": (0.0,), "in2": (0.0,)}, lambda a, b: _length(a - b)),
    "ramp4": Operation({**{f"value{corner}": (0.0,) for corner in ("tl", "tr", "bl", "br")}, **_AT}, _ramp4),
    "checkerboard": Operation(
        {"color1": (1.0,) * 3, "color2": (0.0,) * 3, "uvtiling": (8.0, 8.0), "uvoffset": (0.0, 0.0), **_AT},
        _checkerboard,
    ),
    "switch": Operation({"which": (0.0,), **{f"in{k}": (0.0,) for k in range(1, 11)}}, _switch),
    "blur": Operation({"in": (0.0,)}, np.asarray),
    "ifgreater": _choice(np.greater, 1.0, boolean=False),
    "ifgreatereq": _choice(np.greater_equal, 1.0, boolean=False),
    "ifequal": _choice(np.equal, 0.0, boolean=False),
    "ifgreater_boolean": _choice(np.greater, 1.0, boolean=True),
    "ifgreatereq_boolean": _choice(np.greater_equal, 1.0, boolean=True),
    "ifequal_boolean": _choice(np.equal, 0.0, boolean=True),
    "and": _binary(lambda a, b: ((a != 0.0) & (b != 0.0)).astype(np.float64), 0.0, 0.0),
    "or": _binary(lambda a, b: ((a != 0.0) | (b != 0.0)).astype(np.float64), 0.0, 0.0),
    "not": _unary(lambda a: (a == 0.0).astype(np.float64)),
    "combine2": _binary(_joined, 0.0, 0.0),
    "combine3": Operation({f"in{k}": (0.0,) for k in (1, 2, 3)}, _combined),
    "combine4": Operation({f"in{k}": (0.0,) for k in (1, 2, 3, 4)}, _combined),
    "convert": Operation({"in": (0.0,)}, lambda a, channels: converted(a, channels), True),
    "convert_boolean": _unary(lambda a: (a != 0.0).astype(np.float64)),
    "ramplr": Operation({**_LR, **_AT}, lambda a, b, uv: mix(a, b, np.clip(uv[..., :1], 0.0, 1.0))),
    "ramptb": Operation({**_TB, **_AT}, lambda a, b, uv: mix(b, a, np.clip(uv[..., 1:2], 0.0, 1.0))),
    "splitlr": Operation({**_LR, **_CENTER}, lambda a, b, middle, uv: np.where(uv[..., :1] >= middle, b, a)),
    "splittb": Operation({**_TB, **_CENTER}, lambda a, b, middle, uv: np.where(uv[..., 1:2] >= middle, a, b)),
    "normalmap": Operation({"in": (0.5, 0.5, 1.0), "scale": (1.0,)}, unpacked_normal),
    # Of RealityKit and Maya, which write them into stages with MaterialX's nodes.
    "normal_map_decode": Operation({"in": (0.5, 0.5, 1.0)}, lambda a: 2.0 * a - 1.0),
    "MayaND_place2dTexture": Operation(
        {"uvCoord": UV, "repeatUV": (1.0, 1.0), "offset": (0.0, 0.0), "rotateUV": (0.0,)}, _place_in_maya
    ),
    "MayaND_fileTexture": Operation(
        {
            "inColor": (0.0,),
            "colorGain": (1.0,) * 3,
            "colorOffset": (0.0,) * 3,
            "exposure": (0.0,),
            "invert": (0.0,),
        },
        _file_in_maya,
    ),
    "MayaND_clamp": Operation(
        {"input": (0.0,), "min": (0.0,), "max": (1.0,)}, lambda a, b, c: np.minimum(np.maximum(a, b), c)
    ),
    **_noises("2d", "texcoord", UV),
    **_noises("3d", "position", POSITION),
}
"""Operations by the name of their node (`node` of the definition)."""
