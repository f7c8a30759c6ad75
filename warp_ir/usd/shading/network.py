"""Networks of shading nodes, evaluated: what an input of a surface shader gets."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdShade

from warp_ir.scene import Floats, Texture, Wrap
from warp_ir.usd.images.cache import ImageCache
from warp_ir.usd.images.shading_value import (
    PrimvarRef,
    ShadingValue,
    UVMapping,
    as_color,
    combine,
    constant,
    from_primvar,
    select,
)
from warp_ir.usd.shading.vendor_shaders import shader_name
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Unreadable

_DEPTH = 32
"""Longest chain of nodes that is followed."""
_NODE_BUDGET = 256
"""Most nodes that one input may need: shared nodes count every time they are used."""
_WRAPS = {"black": Wrap.BLACK, "clamp": Wrap.CLAMP, "repeat": Wrap.REPEAT, "mirror": Wrap.MIRROR}
_READERS = {"UsdPrimvarReader": ("varname", "fallback"), "geompropvalue": ("geomprop", "default")}
"""Nodes that read primvars: their inputs for its name, and for the value where there is none."""
_CHANNELS = {
    **dict.fromkeys(("float", "int", "integer"), 1),
    **dict.fromkeys(("float2", "vector2"), 2),
    **dict.fromkeys(("float3", "vector3", "color3", "normal", "point", "vector"), 3),
    **dict.fromkeys(("float4", "vector4", "color4"), 4),
}
"""Of what they read."""
_FOREIGN_IMAGES = {
    **dict.fromkeys(("arnold:image", "image", "PxrTexture"), "filename"),
    "gltf_texture_lookup": "texture",
    "file_texture": "texture",
    "lookup_color": "tex",
}
"""Other renderers' nodes that read images: their inputs for the file."""
_MATERIALX_WRAPS = {"constant": Wrap.BLACK, "clamp": Wrap.CLAMP, "periodic": Wrap.REPEAT, "mirror": Wrap.MIRROR}


class Network:
    """Evaluates the inputs of shading nodes.

    Args:
        images: Of the scene.
        material: Named in warnings.
        time: Of the values.
    """

    def __init__(self, images: ImageCache, material: object, time: Usd.TimeCode) -> None:
        self._images, self._time = images, time
        self.material = material
        self._nodes = 0

    def warn(self, what: str) -> None:
        """Say something about the material."""
        self._images.report.warn(self.material, what)

    def texture(self, signal: ShadingValue) -> Texture:
        """A signal that has a place, as a texture."""
        return self._images.texture(signal)

    def evaluate(self, shader_input: UsdShade.Input, default: ShadingValue) -> ShadingValue:
        """What a shader's input gets; the default where nothing is authored, or where it cannot be read."""
        self._nodes = 0
        try:
            return self._input(shader_input, default, _DEPTH)
        except Unreadable as trouble:
            self.warn(f"{shader_input.GetBaseName()}: {trouble}; the default is used")
            return default

    def word(self, shader_input: UsdShade.Input) -> str:
        """A token that an input holds, or a number in digits; "" where there is none."""
        attribute = read.producer(shader_input)
        found = None if attribute is None else read.raw(attribute, self._time)
        return "" if found is None else str(found)

    def picture(
        self, shader_input: UsdShade.Input, channels: list[int], uv: str, transform: Floats, *, color: bool
    ) -> ShadingValue | None:
        """The image that an input names, repeated, or what is connected to it; None where no image can be read.

        Args:
            shader_input: An asset, or what takes a node.
            channels: Numbers of those that are wanted, of r, g, b and a.
            uv: The primvar that places it.
            transform: What is done to it, [3, 3].
            color: Whether it may be decoded.
        """
        attribute = read.producer(shader_input)
        if attribute is None:
            return None
        self._nodes = 0
        try:
            if UsdShade.Output.IsOutput(attribute):
                return self._input(shader_input, constant(*[0.0] * len(channels)), _DEPTH)
            if not self._path(attribute):
                return None
            return self._file(attribute, channels, "auto" if color else "raw", _placed_by(uv, transform))
        except Unreadable as trouble:
            self.warn(f"{shader_input.GetBaseName()}: {trouble}; it is left out")
            return None

    def file(
        self, asset: Sdf.AssetPath, channels: list[int], space: str, uv: str, transform: Floats
    ) -> ShadingValue | None:
        """An image, repeated, as `picture` has it; None where it cannot be read."""
        try:
            pixels, key = self._images.pixels(asset, space, channels)
            place = _placed(uv, transform, (Wrap.REPEAT, Wrap.REPEAT), (1, 1))
        except Unreadable as trouble:
            self.warn(f"{trouble}; it is left out")
            return None
        return ShadingValue(pixels, np.zeros(len(channels)), place, (key, tuple(channels)), asset.path)

    def _file(
        self,
        attribute: Usd.Attribute | None,
        channels: list[int],
        space: str,
        place: Callable[[tuple[int, int]], UVMapping],
        outside: Floats | None = None,
    ) -> ShadingValue:
        """Channels of the image that an attribute names; `place` says where, given the UDIM tiles across and up.

        Raises:
            Unreadable: There is none.
        """
        outside = np.zeros(len(channels)) if outside is None else outside
        _, pixels, key, atlas = self._images.look_up(
            attribute, self._time, space, np.resize(outside, 4), channels, self.warn
        )
        return ShadingValue(pixels, outside, place(atlas), (key, tuple(channels)), self._path(attribute))

    def _input(self, shader_input: UsdShade.Input, default: ShadingValue, depth: int) -> ShadingValue:
        attribute = read.producer(shader_input)
        if attribute is None:
            return default
        if not UsdShade.Output.IsOutput(attribute):
            channels = read.raw(attribute, self._time)
            if channels is None:
                return default
            array = np.asarray(channels)
            if array.ndim > 1 or array.size == 0 or array.dtype.kind not in "fiub" or not np.isfinite(array).all():
                what = "a finite colour" if array.shape == (3,) else "a finite number"
                raise Unreadable(f"{attribute.GetName()} is {read.short(channels)}, not {what}")
            array = np.atleast_1d(array).astype(np.float64)
            if len(array) == 3 and read.is_color(attribute):
                array = read.to_linear_rec709(attribute, array.reshape(1, 3))[0]
            return constant(*array.tolist())
        self._nodes += 1
        if depth == 0 or self._nodes > _NODE_BUDGET:
            raise Unreadable("the network of nodes is too deep")
        node, output = UsdShade.Shader(attribute.GetPrim()), attribute.GetBaseName()
        identifier = str(node.GetShaderId() or "an unnamed node")
        name = identifier.removeprefix("ND_")
        if name in ("UsdUVTexture", "UsdUVTexture_23"):
            return self._uv_texture(node, output, default)
        reader, _, kind = name.partition("_")
        if reader in _READERS and kind in _CHANNELS:
            named, otherwise = _READERS[reader]
            primvar = PrimvarRef(self._text(node.GetInput(named)), _CHANNELS[kind])
            fallback = self._input(node.GetInput(otherwise), constant(*[0.0] * primvar.channels), depth - 1)
            return from_primvar(primvar, fallback)
        if identifier.startswith("ND_"):
            if name.startswith(("image_", "tiledimage_", "gltf_image_", "gltf_colorimage", "gltf_normalmap")):
                return self._image(node, name, output)
            made = self._operation(node, name, output, depth - 1)
            if made is not None:
                return made
        kind = shader_name(node)
        if kind in _FOREIGN_IMAGES:
            channels = {"a": [3], "resultA": [3]}.get(output, [0, 1, 2])
            attribute = read.producer(node.GetInput(_FOREIGN_IMAGES[kind]))
            uv = self._text(node.GetInput("uvset"), "st")
            return self._file(attribute, channels, "auto", _placed_by(uv, np.eye(3)))
        raise Unreadable(f"the node {kind or identifier} is not understood")

    def _operation(self, node: UsdShade.Shader, name: str, output: str, depth: int) -> ShadingValue | None:
        """MaterialX's arithmetic; None if the node is none."""

        def get(key: str, *default: float) -> ShadingValue:
            return self._input(node.GetInput(key), constant(*default), depth)

        kind = name.split("_")[0]
        if kind == "constant":
            return get("value", 0.0)
        if kind in ("convert", "dot"):
            found, wanted = get("in", 0.0), name.rsplit("_", 1)[-1]
            return as_color(found) if wanted in ("color3", "vector3") else found
        if kind == "extract":
            found = get("in", 0.0)
            index = int(get("index", 0.0).mean[0])
            return select(found, [min(max(index, 0), found.pixels.shape[2] - 1)])
        if kind.startswith("separate"):
            found = get("in", 0.0)
            index = {"r": 0, "x": 0, "g": 1, "y": 1, "b": 2, "z": 2}.get(output.removeprefix("out")[-1:], 3)
            return select(found, [min(index, found.pixels.shape[2] - 1)])
        if kind in ("combine2", "combine3", "combine4"):
            parts = [get(f"in{k + 1}", 0.0) for k in range(int(kind[-1]))]
            return combine(kind, lambda *a: np.concatenate(np.broadcast_arrays(*(x[..., :1] for x in a)), -1), *parts)
        if kind in ("multiply", "divide"):
            call = np.multiply if kind == "multiply" else lambda a, b: a / np.where(b == 0.0, np.inf, b)
            return combine(kind, call, get("in1", 0.0), get("in2", 1.0))
        if kind in ("add", "subtract", "min", "max", "minimum", "maximum", "power", "difference"):
            functions: dict[str, Callable[..., Any]] = {
                "add": np.add,
                "subtract": np.subtract,
                "difference": lambda a, b: np.abs(a - b),
                "power": lambda a, b: np.maximum(a, 0.0) ** b,
            }
            call = functions.get(kind, np.minimum if kind.startswith("min") else np.maximum)
            return combine(kind, call, get("in1", 0.0), get("in2", 1.0 if kind == "power" else 0.0))
        if kind == "mix":
            inputs = get("bg", 0.0), get("fg", 0.0), get("mix", 0.0)
            return combine(kind, lambda bg, fg, mix: bg * (1.0 - mix) + fg * mix, *inputs)
        if kind == "invert":
            return combine(kind, np.subtract, get("amount", 1.0), get("in", 0.0))
        if kind == "clamp":
            return combine(kind, np.clip, get("in", 0.0), get("low", 0.0), get("high", 1.0))
        if kind == "normalmap":
            if self._text(node.GetInput("space"), "tangent") != "tangent":
                raise Unreadable("only normal maps in tangent space are read")
            weight = get("scale", 1.0)
            return combine(kind, _unpacked_normal, as_color(get("in", 0.5, 0.5, 1.0)), weight)
        if kind == "luminance":
            weights = np.array([0.2126729, 0.7151522, 0.0721750])
            return combine(
                kind, lambda a: np.repeat((a[..., :3] @ weights)[..., None], 3, -1), as_color(get("in", 0.0))
            )
        return None

    def _uv_texture(self, node: UsdShade.Shader, output: str, default: ShadingValue) -> ShadingValue:
        """UsdUVTexture: out = image * scale + bias."""
        fallback = self._constant(node, "fallback", [0.0, 0.0, 0.0, 1.0])
        scale, bias = self._constant(node, "scale", [1.0] * 4), self._constant(node, "bias", [0.0] * 4)
        channels = {"r": [0], "g": [1], "b": [2], "a": [3], "rgb": [0, 1, 2]}.get(output, [0, 1, 2])
        attribute = read.producer(node.GetInput("file"))
        space = self._text(node.GetInput("sourceColorSpace"), "auto")
        try:
            image, pixels, key, atlas = self._images.look_up(
                attribute, self._time, space, fallback, channels, self.warn
            )
        except Unreadable as trouble:
            self.warn(f"{trouble}; the texture's fallback is used")
            return constant(*fallback[channels].tolist())
        wraps = []
        for axis, name in enumerate(("wrapS", "wrapT")):
            mode = self._text(node.GetInput(name), "useMetadata")
            if mode not in _WRAPS:
                mode = image.wrap[axis] or self._images.default_wrap
            wraps.append(_WRAPS[mode])
        uv, transform = self._coordinates(node.GetInput("st"), _DEPTH, unconnected=_at(0.0, 0.0))
        place = _placed(uv, transform, (wraps[0], wraps[1]), atlas)
        outside = fallback if atlas != (1, 1) else np.zeros(4)  # black is transparent black
        key = (key, tuple(channels))
        signal = ShadingValue(pixels, outside[channels], place, key, self._path(attribute))
        if (scale[channels] == 1.0).all() and (bias[channels] == 0.0).all():
            return signal
        label = ("scale", tuple(scale[channels]), tuple(bias[channels]))
        return combine(label, lambda a: a * scale[channels].astype(a.dtype) + bias[channels].astype(a.dtype), signal)

    def _image(self, node: UsdShade.Shader, name: str, output: str) -> ShadingValue:
        """MaterialX's image and tiledimage, and glTF's images in MaterialX."""
        gltf = name.startswith("gltf_")
        wanted = name.removesuffix("_1_0").rsplit("_", 1)[-1]
        count = {"float": 1, "vector2": 2, "color4": 4, "vector4": 4, "colorimage": 4}.get(wanted, 3)
        default = self._constant(node, "default", [0.5, 0.5, 1.0] if "normalmap" in name else [0.0] * count)
        attribute = read.producer(node.GetInput("file"))
        modes = [
            _MATERIALX_WRAPS.get(self._text(node.GetInput(f"{axis}addressmode"), "periodic"), Wrap.REPEAT)
            for axis in "uv"
        ]
        uv, transform = self._coordinates(node.GetInput("texcoord"), _DEPTH, unconnected=np.eye(3))
        if name.startswith("tiledimage_"):
            tiling = self._constant(node, "uvtiling", [1.0, 1.0])
            offset = self._constant(node, "uvoffset", [0.0, 0.0])
            modes = [Wrap.REPEAT, Wrap.REPEAT]
            transform = np.array([[tiling[0], 0, -offset[0]], [0, tiling[1], -offset[1]], [0, 0, 1]]) @ transform
        if gltf:
            pivot, scale = self._constant(node, "pivot", [0.0, 1.0]), self._constant(node, "scale", [1.0, 1.0])
            x, y = self._constant(node, "offset", [0.0, 0.0])
            turn = _rotation(self._constant(node, "rotate", [0.0])[0])
            transform = _moved(*pivot) @ _moved(x, -y) @ turn @ np.diag([*scale, 1.0]) @ _moved(*-pivot) @ transform
        space = "auto" if wanted.startswith("color") else "raw"
        try:
            signal = self._file(
                attribute, list(range(count)), space, _placed_by(uv, transform, (modes[0], modes[1])), default
            )
        except Unreadable as trouble:
            self.warn(f"{trouble}; the image's default is used")
            signal = constant(*default.tolist())
        if name.startswith("gltf_normalmap"):
            return combine("normalmap", _unpacked_normal, signal, constant(1.0))
        for factor in ("factor", "color", "geomcolor") if gltf else ():
            if read.producer(node.GetInput(factor)) is not None:
                signal = combine("factor", np.multiply, signal, self._input(node.GetInput(factor), signal, _DEPTH))
        if wanted == "colorimage":
            return select(signal, [3] if output == "outa" else [0, 1, 2])
        return signal

    def _path(self, attribute: Usd.Attribute | None) -> str:
        """The path that an asset attribute holds."""
        asset = read.raw(attribute, self._time) if attribute is not None else None
        return asset.path if isinstance(asset, Sdf.AssetPath) else str(asset or "")

    def _coordinates(self, shader_input: UsdShade.Input, depth: int, unconnected: Floats) -> tuple[str, Floats]:
        """The uv set that an input reads, and what is done to it, [3, 3]."""
        attribute = read.producer(shader_input)
        if attribute is None or not UsdShade.Output.IsOutput(attribute):
            authored = np.asarray(read.raw(attribute, self._time) if attribute is not None else None)
            if authored.shape != (2,) or authored.dtype.kind not in "fiu" or not np.isfinite(authored).all():
                return "st", unconnected
            return "st", _at(float(authored[0]), float(authored[1]))
        node = UsdShade.Shader(attribute.GetPrim())
        name = str(node.GetShaderId() or "").removeprefix("ND_")
        if depth == 0:
            raise Unreadable("the network of texture coordinates is too deep")
        if name in ("UsdPrimvarReader_float2", "UsdPrimvarReader_vector2"):
            return self._text(node.GetInput("varname"), "st"), np.eye(3)
        if name == "texcoord_vector2":
            return "st", np.eye(3)
        if name == "geompropvalue_vector2":
            return self._text(node.GetInput("geomprop"), "st"), np.eye(3)
        if name == "UsdTransform2d":
            uv, before = self._coordinates(node.GetInput("in"), depth - 1, unconnected)
            move, scale = self._constant(node, "translation", [0.0, 0.0]), self._constant(node, "scale", [1.0, 1.0])
            turn = _rotation(self._constant(node, "rotation", [0.0])[0])
            turn[:2, 2] = move
            return uv, turn @ np.diag([scale[0], scale[1], 1.0]) @ before
        if name.startswith("place2d_vector2"):
            uv, before = self._coordinates(node.GetInput("texcoord"), depth - 1, np.eye(3))
            pivot, offset = self._constant(node, "pivot", [0.0, 0.0]), self._constant(node, "offset", [0.0, 0.0])
            scale = self._constant(node, "scale", [1.0, 1.0])
            shrink = np.diag([1.0 / scale[0] if scale[0] else 0.0, 1.0 / scale[1] if scale[1] else 0.0, 1.0])
            turn = _rotation(-self._constant(node, "rotate", [0.0])[0])
            return uv, _moved(*pivot) @ _moved(*-offset) @ turn @ shrink @ _moved(*-pivot) @ before
        if name.startswith(("multiply_vector2", "add_vector2")):
            uv, before = self._coordinates(node.GetInput("in1"), depth - 1, np.eye(3))
            amount = np.resize(self._constant(node, "in2", [float(name.startswith("multiply"))]), 2)
            return uv, (np.diag([*amount, 1.0]) if name.startswith("multiply") else _moved(*amount)) @ before
        raise Unreadable(f"texture coordinates from the node {name} are not understood")

    def _constant(self, node: UsdShade.Shader, name: str, default: list[float]) -> Floats:
        """An input's numbers, float64 [c]; a network's are averaged."""
        signal = self._input(node.GetInput(name), constant(*default), 2)
        if signal.primvars:
            self.warn(f"{name} reads the primvar '{signal.primvars[0].name}': it takes the reader's fallback")
        found = signal.mean
        return found if len(found) == len(default) else np.resize(found, len(default))

    def _text(self, shader_input: UsdShade.Input, default: str = "") -> str:
        attribute = read.producer(shader_input)
        return read.text(attribute, self._time, default) or default if attribute is not None else default


def _unpacked_normal(packed: Floats, scale: Floats) -> Floats:
    """Normals from numbers between 0 and 1, by MaterialX's node normalmap, whose scale is for x and y."""
    across = np.broadcast_to(scale, (*scale.shape[:-1], 2))
    return np.asarray((2.0 * packed - 1.0) * np.concatenate([across, np.ones_like(scale[..., :1])], axis=-1))


def _placed_by(
    uv: str, transform: Floats, wrap: tuple[Wrap, Wrap] = (Wrap.REPEAT, Wrap.REPEAT)
) -> Callable[[tuple[int, int]], UVMapping]:
    """Where an image lies, given its UDIM tiles."""
    return lambda tiles: _placed(uv, transform, wrap, tiles)


def _placed(uv: str, transform: Floats, wrap: tuple[Wrap, Wrap], tiles: tuple[int, int]) -> UVMapping:
    if tiles != (1, 1):
        transform = np.diag([1.0 / tiles[0], 1.0 / tiles[1], 1.0]) @ transform
        wrap = (Wrap.BLACK, Wrap.BLACK)
    if not (np.abs(transform) < 1e30).all():
        raise Unreadable("the transform of the texture coordinates is not finite")
    s, t = transform[0].tolist(), transform[1].tolist()
    return UVMapping(uv, ((s[0], s[1], s[2]), (t[0], t[1], t[2])), wrap)


def _at(s: float, t: float) -> Floats:
    """Everything to one point."""
    return np.array([[0.0, 0.0, s], [0.0, 0.0, t], [0.0, 0.0, 1.0]])


def _moved(x: float, y: float) -> Floats:
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def _rotation(degrees: float) -> Floats:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
