"""Nodes of other renderers by their meaning, as functions of their inputs: Arnold's, and RenderMan's in OSL.

Their names and defaults are those of their documentation. Blends of layers, filters and what depends on the view are
not among them.
"""

from collections.abc import Callable
from functools import partial
from typing import Protocol

import numpy as np
import numpy.typing as npt

from warp_ir.scene import Floats
from warp_ir.usd.images.shading_value import (
    PointRef,
    PrimvarRef,
    ShadingValue,
    UVRef,
    combine,
    constant,
    from_primvar,
    from_surface,
    select,
)
from warp_ir.usd.shading import noise
from warp_ir.usd.shading.operations import divide, hsv_to_rgb, mix, rgb_to_hsv, rotated

_CHANNELS = {"r": 0, "g": 1, "b": 2, "a": 3, "x": 0, "y": 1, "z": 2}
_REC709 = np.array([0.2126, 0.7152, 0.0722])


class NodeInputs(Protocol):
    """The inputs of a node."""

    def has(self, name: str) -> bool:
        """Whether an input has a value or a connection."""

    def connected(self, name: str) -> bool:
        """Whether an input is connected to a node."""

    def value(self, name: str, default: ShadingValue) -> ShadingValue:
        """The value of an input."""

    def text(self, name: str, default: str = "") -> str:
        """An input as a string or token."""

    def numbers(self, name: str) -> Floats | None:
        """An array that an input holds."""


_Reader = Callable[[NodeInputs], ShadingValue]


def _function(function: Callable[..., npt.ArrayLike], **inputs: float | tuple[float, ...]) -> _Reader:
    """A node that is a function of inputs, with their defaults."""

    def read(node: NodeInputs) -> ShadingValue:
        values = [_given(node, name, default) for name, default in inputs.items()]
        return combine(("vendor", tuple(inputs), id(function)), function, *values)

    return read


def _given(node: NodeInputs, name: str, default: float | tuple[float, ...]) -> ShadingValue:
    return node.value(name, constant(*(default if isinstance(default, tuple) else (default,))))


def _number(node: NodeInputs, name: str, default: float) -> float:
    """A uniform input; the mean if it varies."""
    return float(node.value(name, constant(default)).mean[0])


def _uv(node: NodeInputs, *connections: str) -> ShadingValue:
    """Texture coordinates: what an input is connected to, else a named set, else the first."""
    first = from_surface(UVRef(node.text("uvset") or "st"))
    return next((node.value(name, first) for name in connections if node.connected(name)), first)


def _checkerboard(node: NodeInputs) -> ShadingValue:
    """Arnold's: two checks a period in both directions."""

    def checked(uv: Floats, one: Floats, other: Floats, u: Floats, v: Floats, x: Floats, y: Floats) -> Floats:
        place = np.concatenate(np.broadcast_arrays(uv[..., :1] * u + x, uv[..., 1:2] * v + y), axis=-1)
        odd = np.floor(2.0 * place).sum(axis=-1, keepdims=True) % 2.0
        return np.where(odd > 0.5, other, one)

    one, other = _given(node, "color1", (1.0,) * 3), _given(node, "color2", (0.0,) * 3)
    numbers = [_given(node, f"{axis}_{what}", d) for what, d in (("frequency", 1.0), ("offset", 0.0)) for axis in "uv"]
    return combine("arnold:checkerboard", checked, _uv(node), one, other, *numbers)


def _pxr_checker(node: NodeInputs) -> ShadingValue:
    def checked(uv: Floats, one: Floats, other: Floats) -> Floats:
        return np.where(np.floor(uv[..., :2]).sum(axis=-1, keepdims=True) % 2.0 > 0.5, other, one)

    one, other = _given(node, "colorA", (1.0,) * 3), _given(node, "colorB", (0.0,) * 3)
    return combine("PxrChecker", checked, _uv(node, "manifold"), one, other)


def _ramp_parameter(node: NodeInputs, uv: ShadingValue) -> ShadingValue:
    """Where a ramp is looked up: its input, or a pattern over the texture coordinates."""
    kind = node.text("type", "v")

    def pattern(uv: Floats) -> Floats:
        u, v = uv[..., :1], uv[..., 1:2]
        x, y = u - np.floor(u) - 0.5, v - np.floor(v) - 0.5
        patterns = {
            "u": u,
            "diagonal": 0.5 * (u + v),
            "radial": np.arctan2(y, x) / (2.0 * np.pi) + 0.5,
            "circular": np.sqrt(2.0) * np.hypot(x, y),
            "box": 2.0 * np.maximum(np.abs(x), np.abs(y)),
        }
        return np.asarray(patterns.get(kind, v))

    if node.connected("input") or (kind == "custom" and node.has("input")):
        return select(node.value("input", constant(0.0)), [0])
    if kind == "custom":
        return constant(0.0)
    return combine(("ramp", kind), pattern, uv)


def _ramp(node: NodeInputs, position: str, values: str, interpolation: str, channels: int) -> ShadingValue:
    """Colours by position, with one interpolation for each interval: constant, linear or smooth."""
    knots, colors = node.numbers(position), node.numbers(values)
    if knots is None or colors is None or knots.ndim != 1 or not knots.size:
        return constant(*[0.0] * channels)
    colors = colors.reshape(-1, channels)[: len(knots)]
    knots = knots[: len(colors)]
    order = np.argsort(knots, kind="stable")
    knots, colors = knots[order], colors[order]
    kinds = node.numbers(interpolation)
    kinds = np.ones(len(knots)) if kinds is None or not kinds.size else np.resize(kinds, len(order))[order]

    def looked_up(x: Floats) -> Floats:
        x = np.asarray(x[..., 0], np.float64)
        low = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, max(len(knots) - 2, 0))
        high = np.minimum(low + 1, len(knots) - 1)
        t = np.clip(divide(x - knots[low], knots[high] - knots[low]), 0.0, 1.0)
        t = np.where(x >= knots[high], 1.0, t)
        kind = kinds[low]
        t = np.where(kind < 0.5, (t >= 1.0) * 1.0, np.where(kind > 1.5, t * t * (3.0 - 2.0 * t), t))[..., None]
        return np.asarray(colors[low] * (1.0 - t) + colors[high] * t)

    label = ("ramp", tuple(knots), tuple(colors.reshape(-1)), tuple(kinds))
    return combine(label, looked_up, _ramp_parameter(node, _uv(node)))


def _user_data(node: NodeInputs, name: str, default: str, channels: int) -> ShadingValue:
    """A primvar by name."""
    return from_primvar(PrimvarRef(node.text(name), channels), _given(node, default, (0.0,) * channels))


def _noise(node: NodeInputs) -> ShadingValue:
    """Arnold's: fractal gradient noise of the position, between two colours."""
    octaves, lacunarity = _number(node, "octaves", 1.0), _number(node, "lacunarity", 1.92)
    amplitude = _number(node, "amplitude", 1.0)
    position = from_surface(PointRef("position"))
    if node.text("coord_space", "object") == "uv":
        uv = _uv(node)
        position = combine("uv0", lambda a: np.concatenate([a[..., :2], 0.0 * a[..., :1]], axis=-1), uv)

    def valued(p: Floats, scale: Floats, offset: Floats, one: Floats, other: Floats) -> Floats:
        value = noise.fractal(p * scale + offset, 1, int(octaves), lacunarity, 0.5)
        return mix(one, other, np.clip(0.5 + 0.5 * amplitude * value, 0.0, 1.0))

    scale, offset = _given(node, "scale", (1.0,) * 3), _given(node, "offset", (0.0,) * 3)
    one, other = _given(node, "color1", (0.0,) * 3), _given(node, "color2", (1.0,) * 3)
    return combine(("arnold:noise", octaves, lacunarity, amplitude), valued, position, scale, offset, one, other)


def _color_correct(
    a: Floats,
    gamma: Floats,
    hue: Floats,
    saturation: Floats,
    contrast: Floats,
    pivot: Floats,
    exposure: Floats,
    factor: Floats,
    added: Floats,
    mask: Floats,
) -> Floats:
    """Arnold's, in its order: gamma, hue and saturation, contrast, exposure, multiply and add."""
    rgb = np.abs(a[..., :3]) ** divide(np.ones_like(gamma), gamma)
    hsv = rgb_to_hsv(rgb)
    rgb = hsv_to_rgb(np.concatenate([hsv[..., :1] + hue, hsv[..., 1:2] * saturation, hsv[..., 2:]], axis=-1))
    rgb = ((rgb - pivot) * contrast + pivot) * 2.0**exposure * factor[..., :3] + added[..., :3]
    return mix(a[..., :3], rgb, mask)


def _range(
    a: Floats, inlow: Floats, inhigh: Floats, outlow: Floats, outhigh: Floats, contrast: Floats, pivot: Floats
) -> Floats:
    unit = divide(a - inlow, inhigh - inlow)
    return np.asarray(outlow + ((unit - pivot) * contrast + pivot) * (outhigh - outlow))


def _clamp(node: NodeInputs) -> ShadingValue:
    by_color = node.text("mode") == "color"
    low, high = ("min_color", "max_color") if by_color else ("min", "max")
    return _function(lambda a, b, c: np.minimum(np.maximum(a, b), c), **{"input": 0.0, low: 0.0, high: 1.0})(node)


def _switch(node: NodeInputs) -> ShadingValue:
    index = int(_number(node, "index", 0.0))
    return node.value(f"input{index}", constant(0.0, 0.0, 0.0))


def _uv_transform(node: NodeInputs) -> ShadingValue:
    """Arnold's: repeats, rotation about a pivot, offset."""
    label = tuple(node.value(k, constant(0.0)).key for k in ("repeat", "offset", "rotate", "pivot_frame"))
    repeat, offset = (_given(node, k, d).mean for k, d in (("repeat", (1.0, 1.0)), ("offset", (0.0, 0.0))))
    angle = np.array([_number(node, "rotate", 0.0)])

    def moved(uv: Floats) -> Floats:
        return np.asarray(rotated(uv[..., :2] - 0.5, angle) + 0.5) * repeat[:2] + offset[:2]

    return combine(("uv_transform", label), moved, node.value("passthrough", from_surface(UVRef("st"))))


def _manifold_2d(node: NodeInputs) -> ShadingValue:
    """PxrManifold2D: scale, rotation about the centre, offset."""
    numbers = [_number(node, k, d) for k, d in (("scaleS", 1.0), ("scaleT", 1.0), ("offsetS", 0.0), ("offsetT", 0.0))]
    angle, scale, offset = _number(node, "angle", 0.0), np.array(numbers[:2]), np.array(numbers[2:])

    def moved(uv: Floats) -> Floats:
        return np.asarray(rotated(uv[..., :2] * scale + offset, np.array([-angle])))

    return combine(("PxrManifold2D", *numbers, angle), moved, _uv(node, "manifold"))


def _pxr_primvar(node: NodeInputs) -> ShadingValue:
    if node.text("type") == "float":
        return _user_data(node, "varname", "defaultFloat", 1)
    return _user_data(node, "varname", "defaultColor", 3)


def _grey(a: Floats) -> Floats:
    return np.asarray((a[..., :3] @ _REC709)[..., None]) if a.shape[-1] >= 3 else a[..., :1]


def _parts(*inputs: str, last: float = 0.0) -> _Reader:
    """Channels from inputs of one channel each; the default of a fourth is `last`."""
    defaults = {name: last if k == 3 else 0.0 for k, name in enumerate(inputs)}
    return _function(
        lambda *parts: np.concatenate(np.broadcast_arrays(*(part[..., :1] for part in parts)), axis=-1), **defaults
    )


_UNARY: dict[str, Callable[[Floats], npt.ArrayLike]] = {
    "abs": np.abs,
    "negate": np.negative,
    "complement": lambda a: 1.0 - a,
    "fraction": lambda a: a - np.floor(a),
    "sqrt": lambda a: np.sqrt(np.maximum(a, 0.0)),
    "exp": np.exp,
    "log": lambda a: np.log(np.maximum(a, 1e-300)),
    "sign": np.sign,
    "reciprocal": lambda a: divide(np.ones_like(a), a),
    "normalize": lambda a: divide(a, np.linalg.norm(a, axis=-1, keepdims=True)),
    "rgb_to_vector": np.asarray,
    "vector_to_rgb": np.asarray,
    "rgba_to_rgb": lambda a: a[..., :3],
    "rgb_to_float": lambda a: a[..., :3].mean(axis=-1, keepdims=True),
    "rgba_to_float": lambda a: a[..., :3].mean(axis=-1, keepdims=True),
    "color_convert": np.asarray,
    "cache": np.asarray,
}
_BINARY: dict[str, Callable[[Floats, Floats], npt.ArrayLike]] = {
    "add": np.add,
    "subtract": np.subtract,
    "multiply": np.multiply,
    "divide": divide,
    "min": np.minimum,
    "max": np.maximum,
}
_RAMP_RGB = partial(_ramp, position="position", values="color", interpolation="interpolation", channels=3)
_RAMP_FLOAT = partial(_ramp, position="position", values="value", interpolation="interpolation", channels=1)

_NODES: dict[str, _Reader] = {
    **{f"arnold:{name}": _function(call, input=0.0) for name, call in _UNARY.items()},
    **{f"arnold:{name}": _function(call, input1=0.0, input2=float(name == "divide")) for name, call in _BINARY.items()},
    "arnold:checkerboard": _checkerboard,
    "arnold:ramp_rgb": _RAMP_RGB,
    "arnold:ramp_float": _RAMP_FLOAT,
    "arnold:user_data_rgb": lambda node: _user_data(node, "attribute", "default", 3),
    "arnold:user_data_rgba": lambda node: _user_data(node, "attribute", "default", 4),
    "arnold:user_data_float": lambda node: _user_data(node, "attribute", "default", 1),
    "arnold:user_data_int": lambda node: _user_data(node, "attribute", "default", 1),
    "arnold:noise": _noise,
    "arnold:flat": _function(np.asarray, color=(1.0, 1.0, 1.0)),
    "arnold:mix_rgba": _function(mix, input1=(0.0,) * 3, input2=(0.0,) * 3, mix=0.5),
    "arnold:power": _function(lambda a, b: np.maximum(a, 0.0) ** b, base=(1.0,) * 3, exponent=(1.0,) * 3),
    "arnold:modulo": _function(lambda a, b: a - b * np.floor(divide(a, b)), input=0.0, divisor=1.0),
    "arnold:clamp": _clamp,
    "arnold:range": _function(
        _range,
        input=0.0,
        input_min=0.0,
        input_max=1.0,
        output_min=0.0,
        output_max=1.0,
        contrast=1.0,
        contrast_pivot=0.5,
    ),
    "arnold:color_correct": _function(
        _color_correct,
        input=(1.0,) * 3,
        gamma=1.0,
        hue_shift=0.0,
        saturation=1.0,
        contrast=1.0,
        contrast_pivot=0.18,
        exposure=0.0,
        multiply=(1.0,) * 3,
        add=(0.0,) * 3,
        mask=1.0,
    ),
    "arnold:float_to_rgb": _parts("r", "g", "b"),
    "arnold:float_to_rgba": _parts("r", "g", "b", "a", last=1.0),
    "arnold:vector_map": _function(np.asarray, input=(0.0,) * 3),
    "arnold:uv_transform": _uv_transform,
    "arnold:switch_rgba": _switch,
    "arnold:passthrough": _function(np.asarray, passthrough=(0.0,) * 3),
    "arnold:dot": _function(lambda a, b: (a * b).sum(-1, keepdims=True), input1=(0.0,) * 3, input2=(0.0,) * 3),
    "arnold:length": _function(lambda a: np.linalg.norm(a, axis=-1, keepdims=True), input=(0.0,) * 3),
    "PxrChecker": _pxr_checker,
    "PxrManifold2D": _manifold_2d,
    "PxrPrimvar": _pxr_primvar,
    "PxrMix": _function(mix, color1=(0.0,) * 3, color2=(0.0,) * 3, mix=0.0),
    "PxrInvert": _function(lambda a: 1.0 - a, inputRGB=(0.0,) * 3),
    "PxrClamp": _function(
        lambda a, b, c: np.minimum(np.maximum(a, b), c), inputRGB=(0.0,) * 3, min=(0.0,) * 3, max=(1.0,) * 3
    ),
    "PxrExposure": _function(
        lambda a, stops, gain, offset: a * 2.0**stops * gain + offset,
        inputRGB=(0.0,) * 3,
        stops=0.0,
        gain=1.0,
        offset=0.0,
    ),
    "PxrGamma": _function(
        lambda a, gamma: np.maximum(a, 0.0) ** divide(np.ones_like(gamma), gamma), inputRGB=(0.0,) * 3, gamma=1.0
    ),
    "PxrToFloat": _function(lambda a: a[..., :3].mean(axis=-1, keepdims=True), input=(0.0,) * 3),
    "PxrToFloat3": _function(lambda a: np.repeat(a[..., :1], 3, axis=-1), input=0.0),
    "PxrMultiply": _function(np.multiply, input1=(1.0,) * 3, input2=(1.0,) * 3),
    "PxrColorCorrect": _function(
        lambda a, gain, offset, gamma, saturation: mix(
            _grey(a), np.maximum(a * gain + offset, 0.0) ** divide(np.ones_like(gamma), gamma), saturation
        ),
        inputRGB=(0.0,) * 3,
        rgbGain=(1.0,) * 3,
        rgbOffset=(0.0,) * 3,
        rgbGamma=(1.0,) * 3,
        saturation=1.0,
    ),
    "PxrRemap": _function(
        lambda a, low, high, out_low, out_high: out_low + divide((a - low) * (out_high - out_low), high - low),
        inputRGB=(0.0,) * 3,
        inputMin=0.0,
        inputMax=1.0,
        outputMin=0.0,
        outputMax=1.0,
    ),
}


def _with_output(read: _Reader) -> Callable[[NodeInputs, str], ShadingValue]:
    """The reader; an output that is named as a channel is this one."""

    def read_output(node: NodeInputs, output: str) -> ShadingValue:
        value = read(node)
        index = _CHANNELS.get(output.removeprefix("result").lower()[:1], 0) if _is_channel(output) else None
        return value if index is None else select(value, [min(index, value.pixels.shape[2] - 1)])

    return read_output


def _is_channel(output: str) -> bool:
    return output in _CHANNELS or output in ("resultR", "resultG", "resultB", "resultA")


VENDOR_NODES: dict[str, Callable[[NodeInputs, str], ShadingValue]] = {
    name: _with_output(reader) for name, reader in _NODES.items()
}
"""Readers of nodes by name; they take the node's inputs and the name of an output."""
