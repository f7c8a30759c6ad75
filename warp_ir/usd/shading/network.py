"""Shading networks: evaluates the inputs of surface shaders through the nodes that are connected to them."""

import math
from collections.abc import Callable

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

_MAX_DEPTH = 32
"""Maximum length of a chain of connected nodes."""
_MAX_NODES = 256
"""Maximum number of node evaluations per input; shared nodes count every time."""
_WRAPS = {"black": Wrap.BLACK, "clamp": Wrap.CLAMP, "repeat": Wrap.REPEAT, "mirror": Wrap.MIRROR}
_PRIMVAR_READERS = {"UsdPrimvarReader": ("varname", "fallback"), "geompropvalue": ("geomprop", "default")}
"""Nodes that read primvars, with their inputs for the primvar's name and for its fallback."""
_CHANNELS = {
    **dict.fromkeys(("float", "int", "integer"), 1),
    **dict.fromkeys(("float2", "vector2"), 2),
    **dict.fromkeys(("float3", "vector3", "color3", "normal", "point", "vector"), 3),
    **dict.fromkeys(("float4", "vector4", "color4"), 4),
}
"""Number of channels by type of the primvar."""
_VENDOR_IMAGES = {
    **dict.fromkeys(("arnold:image", "image", "PxrTexture"), "filename"),
    "gltf_texture_lookup": "texture",
    "file_texture": "texture",
    "lookup_color": "tex",
}
"""Vendors' nodes that read images, with their inputs for the file."""
_MATERIALX_WRAPS = {"constant": Wrap.BLACK, "clamp": Wrap.CLAMP, "periodic": Wrap.REPEAT, "mirror": Wrap.MIRROR}


class ShadingNetwork:
    """Evaluates the inputs of shading nodes.

    Args:
        images: Cache of images.
        material: Path of the material, named in warnings.
        time: Time code of all values.
    """

    def __init__(self, images: ImageCache, material: object, time: Usd.TimeCode) -> None:
        self._images, self._time = images, time
        self.material = material
        self._nodes = 0

    def warn(self, what: str) -> None:
        """Warns, naming the material."""
        self._images.report.warn(self.material, what)

    def texture(self, value: ShadingValue) -> Texture:
        """An image with texture coordinates as a `Texture`."""
        return self._images.texture(value)

    def evaluate(self, shader_input: UsdShade.Input, default: ShadingValue) -> ShadingValue:
        """The value of a shader's input; the default if nothing is authored or it cannot be read."""
        self._nodes = 0
        try:
            return self._input(shader_input, default, _MAX_DEPTH)
        except Unreadable as trouble:
            self.warn(f"{shader_input.GetBaseName()}: {trouble}; the default is used")
            return default

    def token(self, shader_input: UsdShade.Input) -> str:
        """An input as a token, numbers converted to text; "" if it has no value."""
        attribute = read.producer(shader_input)
        value = None if attribute is None else read.raw(attribute, self._time)
        return "" if value is None else str(value)

    def image(
        self, shader_input: UsdShade.Input, channels: list[int], uv: str, transform: Floats, *, color: bool
    ) -> ShadingValue | None:
        """The image that an input names, with wrap mode repeat, or the value of a connected node.

        Args:
            shader_input: An asset input.
            channels: Indices of the channels, of r, g, b and a.
            uv: The primvar with the texture coordinates.
            transform: Transform of the texture coordinates, [3, 3].
            color: Whether the image may be colour-encoded.

        Returns:
            The value; None: there is none that can be read.
        """
        attribute = read.producer(shader_input)
        if attribute is None:
            return None
        self._nodes = 0
        try:
            if UsdShade.Output.IsOutput(attribute):
                return self._input(shader_input, constant(*[0.0] * len(channels)), _MAX_DEPTH)
            if not self._asset_path(attribute):
                return None
            return self._image_value(attribute, channels, "auto" if color else "raw", _placement(uv, transform))
        except Unreadable as trouble:
            self.warn(f"{shader_input.GetBaseName()}: {trouble}; it is skipped")
            return None

    def image_file(
        self, asset: Sdf.AssetPath, channels: list[int], space: str, uv: str, transform: Floats
    ) -> ShadingValue | None:
        """The image of a file, with wrap mode repeat, as in `image`; None: it cannot be read."""
        try:
            pixels, key = self._images.pixels(asset, space, channels)
            mapping = _place(uv, transform, (Wrap.REPEAT, Wrap.REPEAT), (1, 1))
        except Unreadable as trouble:
            self.warn(f"{trouble}; it is skipped")
            return None
        return ShadingValue(pixels, np.zeros(len(channels)), mapping, (key, tuple(channels)), asset.path)

    def _image_value(
        self,
        attribute: Usd.Attribute | None,
        channels: list[int],
        space: str,
        mapping: Callable[[tuple[int, int]], UVMapping],
        outside: Floats | None = None,
    ) -> ShadingValue:
        """Channels of the image that an attribute names.

        Args:
            attribute: The asset; None: Unreadable is raised.
            channels: Indices of the channels, of r, g, b and a.
            space: Colour space, "auto" or "raw".
            mapping: Returns the placement for a number of UDIM tiles (across, up).
            outside: Value outside an image that does not repeat, [c]; None: 0.

        Raises:
            Unreadable: There is no readable image.
        """
        outside = np.zeros(len(channels)) if outside is None else outside
        _, pixels, key, tiles = self._images.look_up(
            attribute, self._time, space, np.resize(outside, 4), channels, self.warn
        )
        key = (key, tuple(channels), tuple(outside))
        return self._images.shared(ShadingValue(pixels, outside, mapping(tiles), key, self._asset_path(attribute)))

    def _input(self, shader_input: UsdShade.Input, default: ShadingValue, depth: int) -> ShadingValue:
        """The value of an input: authored, or of the node that is connected to it."""
        attribute = read.producer(shader_input)
        if attribute is None:
            return default
        if not UsdShade.Output.IsOutput(attribute):
            return self._authored(attribute, default)
        self._nodes += 1
        if depth == 0 or self._nodes > _MAX_NODES:
            raise Unreadable("the shading network is too large or too deep")
        node, output = UsdShade.Shader(attribute.GetPrim()), attribute.GetBaseName()
        identifier = str(node.GetShaderId() or "an unnamed node")
        name = identifier.removeprefix("ND_")
        if name in ("UsdUVTexture", "UsdUVTexture_23"):
            return self._usd_uv_texture(node, output, default)
        reader, _, kind = name.partition("_")
        if reader in _PRIMVAR_READERS and kind in _CHANNELS:
            name_input, fallback_input = _PRIMVAR_READERS[reader]
            primvar = PrimvarRef(self._text(node.GetInput(name_input)), _CHANNELS[kind])
            fallback = self._input(node.GetInput(fallback_input), constant(*[0.0] * primvar.channels), depth - 1)
            return from_primvar(primvar, fallback)
        if identifier.startswith("ND_"):
            if name.startswith(("image_", "tiledimage_", "gltf_image_", "gltf_colorimage", "gltf_normalmap")):
                return self._materialx_image(node, name, output)
            value = self._operation(node, name, output, depth - 1)
            if value is not None:
                return value
        kind = shader_name(node)
        if kind in _VENDOR_IMAGES:
            channels = {"a": [3], "resultA": [3]}.get(output, [0, 1, 2])
            attribute = read.producer(node.GetInput(_VENDOR_IMAGES[kind]))
            uv = self._text(node.GetInput("uvset"), "st")
            return self._image_value(attribute, channels, "auto", _placement(uv, np.eye(3)))
        raise Unreadable(f"the node {kind or identifier} is not supported")

    def _authored(self, attribute: Usd.Attribute, default: ShadingValue) -> ShadingValue:
        """The number or colour that an attribute holds; the default if it has no value."""
        authored = read.raw(attribute, self._time)
        if authored is None:
            return default
        array = np.asarray(authored)
        if array.ndim > 1 or array.size == 0 or array.dtype.kind not in "fiub" or not np.isfinite(array).all():
            what = "a finite colour" if array.shape == (3,) else "a finite number"
            raise Unreadable(f"{attribute.GetName()} is {read.short(authored)}, not {what}")
        array = np.atleast_1d(array).astype(np.float64)
        if len(array) == 3 and read.is_color(attribute):
            array = read.to_linear_rec709(attribute, array.reshape(1, 3))[0]
        return constant(*array.tolist())

    def _operation(self, node: UsdShade.Shader, name: str, output: str, depth: int) -> ShadingValue | None:
        """MaterialX's arithmetic nodes; None: it is another node."""

        def argument(key: str, *default: float) -> ShadingValue:
            return self._input(node.GetInput(key), constant(*default), depth)

        kind = name.split("_")[0]
        if kind == "constant":
            return argument("value", 0.0)
        if kind in ("convert", "dot"):
            operand, target = argument("in", 0.0), name.rsplit("_", 1)[-1]
            return as_color(operand) if target in ("color3", "vector3") else operand
        if kind == "extract":
            operand = argument("in", 0.0)
            index = int(argument("index", 0.0).mean[0])
            return select(operand, [min(max(index, 0), operand.pixels.shape[2] - 1)])
        if kind.startswith("separate"):
            operand = argument("in", 0.0)
            index = {"r": 0, "x": 0, "g": 1, "y": 1, "b": 2, "z": 2}.get(output.removeprefix("out")[-1:], 3)
            return select(operand, [min(index, operand.pixels.shape[2] - 1)])
        if kind in ("combine2", "combine3", "combine4"):
            parts = [argument(f"in{k + 1}", 0.0) for k in range(int(kind[-1]))]
            return combine(kind, lambda *a: np.concatenate(np.broadcast_arrays(*(x[..., :1] for x in a)), -1), *parts)
        if kind in ("multiply", "divide"):
            call = np.multiply if kind == "multiply" else lambda a, b: a / np.where(b == 0.0, np.inf, b)
            return combine(kind, call, argument("in1", 0.0), argument("in2", 1.0))
        if kind in ("add", "subtract", "min", "max", "minimum", "maximum", "power", "difference"):
            functions: dict[str, Callable[[Floats, Floats], Floats]] = {
                "add": np.add,
                "subtract": np.subtract,
                "difference": lambda a, b: np.abs(a - b),
                "power": lambda a, b: np.maximum(a, 0.0) ** b,
            }
            call = functions.get(kind, np.minimum if kind.startswith("min") else np.maximum)
            return combine(kind, call, argument("in1", 0.0), argument("in2", 1.0 if kind == "power" else 0.0))
        if kind == "mix":
            inputs = argument("bg", 0.0), argument("fg", 0.0), argument("mix", 0.0)
            return combine(kind, lambda bg, fg, mix: bg * (1.0 - mix) + fg * mix, *inputs)
        if kind == "invert":
            return combine(kind, np.subtract, argument("amount", 1.0), argument("in", 0.0))
        if kind == "clamp":
            return combine(kind, np.clip, argument("in", 0.0), argument("low", 0.0), argument("high", 1.0))
        if kind == "normalmap":
            if self._text(node.GetInput("space"), "tangent") != "tangent":
                raise Unreadable("only normal maps in tangent space are read")
            weight = argument("scale", 1.0)
            return combine(kind, _unpacked_normal, as_color(argument("in", 0.5, 0.5, 1.0)), weight)
        if kind == "luminance":
            weights = np.array([0.2126729, 0.7151522, 0.0721750])
            return combine(
                kind, lambda a: np.repeat((a[..., :3] @ weights)[..., None], 3, -1), as_color(argument("in", 0.0))
            )
        return None

    def _usd_uv_texture(self, node: UsdShade.Shader, output: str, default: ShadingValue) -> ShadingValue:
        """UsdUVTexture: out = image * scale + bias."""
        fallback = self._constant(node, "fallback", [0.0, 0.0, 0.0, 1.0])
        scale, bias = self._constant(node, "scale", [1.0] * 4), self._constant(node, "bias", [0.0] * 4)
        channels = {"r": [0], "g": [1], "b": [2], "a": [3], "rgb": [0, 1, 2]}.get(output, [0, 1, 2])
        attribute = read.producer(node.GetInput("file"))
        space = self._text(node.GetInput("sourceColorSpace"), "auto")
        try:
            image, pixels, key, tiles = self._images.look_up(
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
        uv, transform = self._texture_coordinates(node.GetInput("st"), _MAX_DEPTH, unconnected=_constant_uv(0.0, 0.0))
        mapping = _place(uv, transform, (wraps[0], wraps[1]), tiles)
        outside = fallback if tiles != (1, 1) else np.zeros(4)  # wrap mode black is transparent black
        key = (key, tuple(channels), tuple(outside[channels]))
        value = ShadingValue(pixels, outside[channels], mapping, key, self._asset_path(attribute))
        value = self._images.shared(value)
        if (scale[channels] == 1.0).all() and (bias[channels] == 0.0).all():
            return value
        label = ("scale", tuple(scale[channels]), tuple(bias[channels]))
        return combine(label, lambda a: a * scale[channels].astype(a.dtype) + bias[channels].astype(a.dtype), value)

    def _materialx_image(self, node: UsdShade.Shader, name: str, output: str) -> ShadingValue:
        """MaterialX's nodes image and tiledimage, and its glTF images."""
        gltf = name.startswith("gltf_")
        wanted = name.removesuffix("_1_0").rsplit("_", 1)[-1]
        count = {"float": 1, "vector2": 2, "color4": 4, "vector4": 4, "colorimage": 4}.get(wanted, 3)
        default = self._constant(node, "default", [0.5, 0.5, 1.0] if "normalmap" in name else [0.0] * count)
        attribute = read.producer(node.GetInput("file"))
        modes = [
            _MATERIALX_WRAPS.get(self._text(node.GetInput(f"{axis}addressmode"), "periodic"), Wrap.REPEAT)
            for axis in "uv"
        ]
        uv, transform = self._texture_coordinates(node.GetInput("texcoord"), _MAX_DEPTH, unconnected=np.eye(3))
        if name.startswith("tiledimage_"):
            tiling = self._constant(node, "uvtiling", [1.0, 1.0])
            offset = self._constant(node, "uvoffset", [0.0, 0.0])
            modes = [Wrap.REPEAT, Wrap.REPEAT]
            transform = np.array([[tiling[0], 0, -offset[0]], [0, tiling[1], -offset[1]], [0, 0, 1]]) @ transform
        if gltf:
            pivot, scale = self._constant(node, "pivot", [0.0, 1.0]), self._constant(node, "scale", [1.0, 1.0])
            x, y = self._constant(node, "offset", [0.0, 0.0])
            rotation = _rotation(self._constant(node, "rotate", [0.0])[0])
            transform = (
                _translation(*pivot)
                @ _translation(x, -y)
                @ rotation
                @ np.diag([*scale, 1.0])
                @ _translation(*-pivot)
                @ transform
            )
        space = "auto" if wanted.startswith("color") else "raw"
        try:
            value = self._image_value(
                attribute, list(range(count)), space, _placement(uv, transform, (modes[0], modes[1])), default
            )
        except Unreadable as trouble:
            self.warn(f"{trouble}; the image's default is used")
            value = constant(*default.tolist())
        if name.startswith("gltf_normalmap"):
            return combine("normalmap", _unpacked_normal, value, constant(1.0))
        for factor in ("factor", "color", "geomcolor") if gltf else ():
            if read.producer(node.GetInput(factor)) is not None:
                value = combine("factor", np.multiply, value, self._input(node.GetInput(factor), value, _MAX_DEPTH))
        if wanted == "colorimage":
            return select(value, [3] if output == "outa" else [0, 1, 2])
        return value

    def _asset_path(self, attribute: Usd.Attribute | None) -> str:
        """The authored path of an asset attribute; "" if it has none."""
        asset = read.raw(attribute, self._time) if attribute is not None else None
        return asset.path if isinstance(asset, Sdf.AssetPath) else str(asset or "")

    def _texture_coordinates(self, shader_input: UsdShade.Input, depth: int, unconnected: Floats) -> tuple[str, Floats]:
        """The set of texture coordinates that an input reads, and their transform [3, 3]."""
        attribute = read.producer(shader_input)
        if attribute is None or not UsdShade.Output.IsOutput(attribute):
            authored = np.asarray(read.raw(attribute, self._time) if attribute is not None else None)
            if authored.shape != (2,) or authored.dtype.kind not in "fiu" or not np.isfinite(authored).all():
                return "st", unconnected
            return "st", _constant_uv(float(authored[0]), float(authored[1]))
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
            uv, inner = self._texture_coordinates(node.GetInput("in"), depth - 1, unconnected)
            translation, scale = (
                self._constant(node, "translation", [0.0, 0.0]),
                self._constant(node, "scale", [1.0, 1.0]),
            )
            rotation = _rotation(self._constant(node, "rotation", [0.0])[0])
            rotation[:2, 2] = translation
            return uv, rotation @ np.diag([scale[0], scale[1], 1.0]) @ inner
        if name.startswith("place2d_vector2"):
            uv, inner = self._texture_coordinates(node.GetInput("texcoord"), depth - 1, np.eye(3))
            pivot, offset = self._constant(node, "pivot", [0.0, 0.0]), self._constant(node, "offset", [0.0, 0.0])
            scale = self._constant(node, "scale", [1.0, 1.0])
            shrink = np.diag([1.0 / scale[0] if scale[0] else 0.0, 1.0 / scale[1] if scale[1] else 0.0, 1.0])
            rotation = _rotation(-self._constant(node, "rotate", [0.0])[0])
            return uv, _translation(*pivot) @ _translation(*-offset) @ rotation @ shrink @ _translation(*-pivot) @ inner
        if name.startswith(("multiply_vector2", "add_vector2")):
            uv, inner = self._texture_coordinates(node.GetInput("in1"), depth - 1, np.eye(3))
            amount = np.resize(self._constant(node, "in2", [float(name.startswith("multiply"))]), 2)
            return uv, (np.diag([*amount, 1.0]) if name.startswith("multiply") else _translation(*amount)) @ inner
        raise Unreadable(f"texture coordinates from the node {name} are not supported")

    def _constant(self, node: UsdShade.Shader, name: str, default: list[float]) -> Floats:
        """An input as numbers, float64 [c]; the mean if an image is connected."""
        value = self._input(node.GetInput(name), constant(*default), 2)
        if value.primvars:
            self.warn(f"{name} reads the primvar '{value.primvars[0].name}': the reader's fallback is used")
        numbers = value.mean
        return numbers if len(numbers) == len(default) else np.resize(numbers, len(default))

    def _text(self, shader_input: UsdShade.Input, default: str = "") -> str:
        """An input as a string or token; the default if it has no value."""
        attribute = read.producer(shader_input)
        return read.text(attribute, self._time, default) or default if attribute is not None else default


def _unpacked_normal(packed: Floats, scale: Floats) -> Floats:
    """Normals from values in [0, 1], as MaterialX's node normalmap decodes them; the scale applies to x and y."""
    across = np.broadcast_to(scale, (*scale.shape[:-1], 2))
    return np.asarray((2.0 * packed - 1.0) * np.concatenate([across, np.ones_like(scale[..., :1])], axis=-1))


def _placement(
    uv: str, transform: Floats, wrap: tuple[Wrap, Wrap] = (Wrap.REPEAT, Wrap.REPEAT)
) -> Callable[[tuple[int, int]], UVMapping]:
    """The placement of an image as a function of its number of UDIM tiles (across, up)."""
    return lambda tiles: _place(uv, transform, wrap, tiles)


def _place(uv: str, transform: Floats, wrap: tuple[Wrap, Wrap], tiles: tuple[int, int]) -> UVMapping:
    """The placement of an image; UDIM tiles are joined to one image that does not repeat."""
    if tiles != (1, 1):
        transform = np.diag([1.0 / tiles[0], 1.0 / tiles[1], 1.0]) @ transform
        wrap = (Wrap.BLACK, Wrap.BLACK)
    if not (np.abs(transform) < 1e30).all():
        raise Unreadable("the transform of the texture coordinates is not finite")
    s, t = transform[0].tolist(), transform[1].tolist()
    return UVMapping(uv, ((s[0], s[1], s[2]), (t[0], t[1], t[2])), wrap)


def _constant_uv(s: float, t: float) -> Floats:
    """Transform of all texture coordinates to one point."""
    return np.array([[0.0, 0.0, s], [0.0, 0.0, t], [0.0, 0.0, 1.0]])


def _translation(x: float, y: float) -> Floats:
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def _rotation(degrees: float) -> Floats:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
