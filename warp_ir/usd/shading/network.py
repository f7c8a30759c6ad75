"""Shading networks: evaluates the inputs of surface shaders through the nodes that are connected to them.

A node is a function of its inputs (`operations.py`), one of the special ones below (images, what a surface has), or one
that MaterialX's library defines by a graph of others (`definitions.py`); those of other renderers are in
`vendor_nodes.py`. All are evaluated alike, whether prims or the library's graphs hold them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pxr import Sdf, Usd, UsdShade

from warp_ir.scene import Floats, Texture, Wrap
from warp_ir.usd.images.cache import ImageCache
from warp_ir.usd.images.shading_value import (
    PointRef,
    PrimvarRef,
    ShadingValue,
    UVMapping,
    UVRef,
    as_affine,
    combine,
    constant,
    from_primvar,
    from_surface,
    look_up,
    sampled,
    select,
)
from warp_ir.usd.shading.definitions import CHANNELS, NodeKind, graph_of, node_kind
from warp_ir.usd.shading.hextile import HexTiling, blended, hex_tiles
from warp_ir.usd.shading.operations import (
    OPERATIONS,
    POSITION,
    UV,
    converted,
    rotated,
    transformed,
)
from warp_ir.usd.shading.vendor_nodes import VENDOR_NODES
from warp_ir.usd.shading.vendor_shaders import shader_name
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Unreadable

if TYPE_CHECKING:
    import MaterialX

_MAX_DEPTH = 64
"""Maximum length of a chain of connected nodes, those of the library's graphs included."""
_MAX_NODES = 4096
"""Maximum number of nodes per input."""
_WRAPS = {"black": Wrap.BLACK, "clamp": Wrap.CLAMP, "repeat": Wrap.REPEAT, "mirror": Wrap.MIRROR}
_MATERIALX_WRAPS = {
    **dict.fromkeys(("constant", "clamp_to_border", "clamp_to_zero"), Wrap.BLACK),
    **dict.fromkeys(("clamp", "clamp_to_edge"), Wrap.CLAMP),
    **dict.fromkeys(("mirror", "mirrored_repeat"), Wrap.MIRROR),
    "periodic": Wrap.REPEAT,
}
"""Address modes of MaterialX, and wrap modes of RealityKit."""
_Placement = Callable[[tuple[int, int]], UVMapping]
"""The placement of an image as a function of its number of UDIM tiles (across, up)."""
_VENDOR_IMAGES = {
    **dict.fromkeys(("arnold:image", "image", "PxrTexture"), "filename"),
    "gltf_texture_lookup": "texture",
    "file_texture": "texture",
    "lookup_color": "tex",
    "HwUvTexture_1": "file",
}
"""Vendors' nodes that read images, with their inputs for the file."""
_LETTERS = {**dict(zip("rgba", range(4), strict=True)), **dict(zip("xyzw", range(4), strict=True))}
_HEX_RANGES = {"rotation": (0.0, 360.0), "scale": (0.5, 2.0), "offset": (0.0, 1.0)}
"""Inputs of hextiledimage for amounts of randomness, with the default of their ranges."""


@dataclass(frozen=True)
class _UsdNode:
    """A node that is a prim."""

    network: "ShadingNetwork"
    shader: UsdShade.Shader
    depth: int

    @property
    def key(self) -> tuple[object, ...]:
        return (self.shader.GetPath(),)

    def has(self, name: str) -> bool:
        """Whether an input has a value or a connection."""
        attribute = read.producer(self.shader.GetInput(name))
        return attribute is not None and bool(UsdShade.Output.IsOutput(attribute) or attribute.HasValue())

    def connected(self, name: str) -> bool:
        """Whether an input is connected to a node."""
        attribute = read.producer(self.shader.GetInput(name))
        return attribute is not None and bool(UsdShade.Output.IsOutput(attribute))

    def value(self, name: str, default: ShadingValue) -> ShadingValue:
        """The value of an input; the default if it has none."""
        return self.network._input(self.shader.GetInput(name), default, self.depth - 1)

    def attribute(self, name: str) -> Usd.Attribute | None:
        """The attribute with the value of an input."""
        return read.producer(self.shader.GetInput(name))

    def text(self, name: str, default: str = "") -> str:
        """An input as a string or token; the default if it has no value."""
        return self.network._text(self.shader.GetInput(name), default)

    def numbers(self, name: str) -> Floats | None:
        """An array that an input holds, float64 [n] or [n, c]; None: it holds none."""
        attribute = self.attribute(name)
        array = np.asarray(None if attribute is None else read.raw(attribute, self.network.time))
        return array.astype(np.float64) if array.dtype.kind in "fiu" and array.ndim in (1, 2) else None


@dataclass(frozen=True)
class _GraphNode:
    """A node of a graph by which MaterialX's library defines another node, `outer`."""

    network: "ShadingNetwork"
    element: "MaterialX.Node"
    definition: "MaterialX.NodeDef"
    """The definition of the outer node, with the defaults of its inputs."""
    outer: "_Node"
    depth: int

    @property
    def key(self) -> tuple[object, ...]:
        return (*self.outer.key, self.element.getName())

    def _port(self, name: str) -> "MaterialX.Input | None":
        return self.element.getInput(name)

    def has(self, name: str) -> bool:
        """Whether an input has a value or a connection."""
        port = self._port(name)
        if port is None:
            return False
        return self.outer.has(port.getInterfaceName()) if port.getInterfaceName() else True

    def connected(self, name: str) -> bool:
        """Whether an input is connected to a node."""
        port = self._port(name)
        if port is None:
            return False
        return bool(port.getNodeName()) or self.outer.connected(port.getInterfaceName() or "")

    def value(self, name: str, default: ShadingValue) -> ShadingValue:
        """The value of an input; the default if it has none."""
        port = self._port(name)
        if port is None:
            return default
        if port.getNodeName():
            graph = self.element.getParent()
            source = graph.getNode(port.getNodeName())
            if source is None:
                raise Unreadable(f"the node {self.element.getName()} is connected to nothing")
            node = _GraphNode(self.network, source, self.definition, self.outer, self.depth - 1)
            return self.network._node(node, _element_kind(source), port.getOutputString() or "out")
        if port.getInterfaceName():
            return _library_input(self.outer, self.definition, port.getInterfaceName(), default)
        return _literal(port) or default

    def attribute(self, name: str) -> Usd.Attribute | None:
        """The attribute with the value of an input."""
        port = self._port(name)
        return None if port is None else self.outer.attribute(port.getInterfaceName())

    def text(self, name: str, default: str = "") -> str:
        """An input as a string or token; the default if it has no value."""
        port = self._port(name)
        if port is None:
            return default
        if not port.getInterfaceName():
            return str(port.getValueString())
        declared = self.definition.getActiveInput(port.getInterfaceName())
        return self.outer.text(port.getInterfaceName(), declared.getValueString() if declared is not None else default)

    def numbers(self, name: str) -> Floats | None:
        """An array that an input holds; the library's graphs have none."""
        return None


_Node = _UsdNode | _GraphNode


def _element_kind(element: "MaterialX.Node") -> NodeKind:
    """The kind of a node of a graph."""
    if element.getCategory() in OPERATIONS:
        return NodeKind(element.getCategory(), element.getType())
    definition = element.getNodeDef()
    if definition is not None:
        return node_kind(definition.getName())
    return NodeKind(element.getCategory(), element.getType())


def _literal(port: "MaterialX.ValueElement") -> ShadingValue | None:
    """The numbers that a port of a document holds; None: it holds none."""
    if port.getType() not in CHANNELS or not port.hasValueString():
        return None
    words = {"true": 1.0, "false": 0.0}
    text = port.getValueString().split(",")
    return constant(*(words[word.strip()] if word.strip() in words else float(word) for word in text))


def _library_input(node: _Node, definition: "MaterialX.NodeDef", name: str, default: ShadingValue) -> ShadingValue:
    """An input of a node that a graph of the library stands for; by default as its definition says."""
    port = definition.getActiveInput(name)
    if port is None:
        return node.value(name, default)
    geometry = port.getDefaultGeomPropString()
    if geometry in _GEOMETRY or (name == "texcoord" and not node.has(name)):
        default = _GEOMETRY.get(geometry, _GEOMETRY["UV0"])
    elif geometry and not node.has(name):
        raise Unreadable(f"{geometry} is not known where materials are evaluated")
    else:
        default = _literal(port) or default
    return node.value(name, default)


class ShadingNetwork:
    """Evaluates the inputs of shading nodes.

    Args:
        images: Cache of images.
        material: Path of the material, named in warnings.
        time: Time code of all values.
    """

    def __init__(self, images: ImageCache, material: object, time: Usd.TimeCode) -> None:
        self._images, self.time = images, time
        self.material = material
        self._results: dict[tuple[object, ...], ShadingValue | str] = {}
        """Values of outputs of nodes, or why they cannot be read: an exception would keep the stage from closing."""

    def warn(self, what: str) -> None:
        """Warns, naming the material."""
        self._images.report.warn(self.material, what)

    def texture(self, value: ShadingValue) -> Texture:
        """An image with texture coordinates as a `Texture`."""
        return self._images.texture(value)

    def evaluate(self, shader_input: UsdShade.Input, default: ShadingValue) -> ShadingValue:
        """The value of a shader's input; the default if nothing is authored or it cannot be read."""
        try:
            return self._input(shader_input, default, _MAX_DEPTH)
        except Unreadable as trouble:
            self.warn(f"{shader_input.GetBaseName()}: {trouble}; the default is used")
            return default

    def token(self, shader_input: UsdShade.Input) -> str:
        """An input as a token, numbers converted to text; "" if it has no value."""
        attribute = read.producer(shader_input)
        value = None if attribute is None else read.raw(attribute, self.time)
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
        mapping: _Placement,
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
            attribute, self.time, space, np.resize(outside, 4), channels, self.warn
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
        shader = UsdShade.Shader(attribute.GetPrim())
        node = _UsdNode(self, shader, depth)
        return self._node(node, node_kind(str(shader.GetShaderId() or "")), attribute.GetBaseName(), default)

    def _authored(self, attribute: Usd.Attribute, default: ShadingValue) -> ShadingValue:
        """The number, colour or matrix that an attribute holds; the default if it has no value."""
        authored = read.raw(attribute, self.time)
        if authored is None:
            return default
        array = np.asarray(authored)
        if array.shape in ((3, 3), (4, 4)):
            array = array.reshape(-1)
        if array.ndim > 1 or array.size == 0 or array.dtype.kind not in "fiub" or not np.isfinite(array).all():
            what = "a finite colour" if array.shape == (3,) else "a finite number"
            raise Unreadable(f"{attribute.GetName()} is {read.short(authored)}, not {what}")
        array = np.atleast_1d(array).astype(np.float64)
        if len(array) == 3 and read.is_color(attribute):
            array = read.to_linear_rec709(attribute, array.reshape(1, 3))[0]
        return constant(*array.tolist())

    def _node(self, node: _Node, kind: NodeKind, output: str, default: ShadingValue | None = None) -> ShadingValue:
        """The value of an output of a node, computed once."""
        key = (*node.key, output)
        if key not in self._results:
            if node.depth <= 0 or len(self._results) >= _MAX_NODES:
                raise Unreadable("the shading network is too large or too deep")
            try:
                self._results[key] = self._computed(node, kind, output)
            except Unreadable as trouble:
                self._results[key] = str(trouble)
        result = self._results[key]
        if isinstance(result, str):
            raise Unreadable(result)
        return result

    def _computed(self, node: _Node, kind: NodeKind, output: str) -> ShadingValue:
        """The value of an output of a node."""
        special = self._SPECIAL.get(kind.node)
        if special is not None:
            return special(self, node, kind, output)
        name = kind.node
        if kind.type == "boolean" and f"{name}_boolean" in OPERATIONS:
            name = f"{name}_boolean"
        elif name == "creatematrix" and kind.type == "matrix44":
            name = "creatematrix_4"
        if name in OPERATIONS:
            value = self._operation(node, name, kind)
            return select(value, [value.pixels.shape[2] - 1]) if output == "outAlpha" else value
        if kind.definition is not None:
            return self._graph(node, kind, output)
        if isinstance(node, _UsdNode):
            name = shader_name(node.shader)
            if name in _VENDOR_IMAGES:
                return self._vendor_image(node, name, output)
            if name in VENDOR_NODES:
                return VENDOR_NODES[name](node, output)
        raise Unreadable(f"the node {name or 'without a name'} is not supported")

    def _operation(self, node: _Node, name: str, kind: NodeKind) -> ShadingValue:
        """A node that is a function of its inputs."""
        if name == "normalmap" and node.text("space", "tangent") != "tangent":
            raise Unreadable("only normal maps in tangent space are read")
        operation = OPERATIONS[name]
        values = []
        for port, default in operation.inputs.items():
            if default == UV:
                values.append(self._texture_coordinates(node, port))
            elif default == POSITION:
                values.append(node.value(port, from_surface(PointRef("position"))))
            else:
                assert not isinstance(default, str)
                values.append(node.value(port, constant(*default)))
        call = partial(operation.function, channels=kind.channels) if operation.by_channels else operation.function
        return combine((name, kind.channels if operation.by_channels else 0), call, *values)

    def _graph(self, node: _Node, kind: NodeKind, output: str) -> ShadingValue:
        """A node that MaterialX's library defines by a graph of others."""
        assert kind.definition is not None
        graph = graph_of(kind.definition)
        ports = [] if graph is None else graph.getOutputs()
        port = next((p for p in ports if p.getName() == output), ports[0] if len(ports) == 1 else None)
        if graph is None or port is None:
            raise Unreadable(f"the node {kind.definition.getName()} is not supported")
        try:
            if port.getInterfaceName():
                return _library_input(node, kind.definition, port.getInterfaceName(), constant(0.0))
            inner = graph.getNode(port.getNodeName())
            if inner is None:
                raise Unreadable("it is empty")
            inside = _GraphNode(self, inner, kind.definition, node, node.depth - 1)
            return self._node(inside, _element_kind(inner), port.getOutputString() or "out")
        except Unreadable as trouble:
            name = kind.definition.getName()
            raise trouble if name in str(trouble) else Unreadable(f"in the node {name}: {trouble}") from None

    def _texture_coordinates(self, node: _Node, name: str, *, authored: bool = True) -> ShadingValue:
        """Texture coordinates that an input is connected to, else what it holds, else the first set."""
        first = from_surface(UVRef("st"))
        return node.value(name, first) if authored or node.connected(name) else first

    def _placed(
        self,
        coordinates: ShadingValue,
        image: Callable[[_Placement], ShadingValue],
        wrap: tuple[Wrap, Wrap],
    ) -> ShadingValue:
        """An image at texture coordinates.

        Args:
            coordinates: The texture coordinates.
            image: Makes the image of its placement.
            wrap: Wrap modes in s and t.
        """
        affine = as_affine(coordinates)
        if affine is not None:
            return image(_placement(*affine, wrap))
        return sampled(image(_placement("st", np.eye(3), wrap)), coordinates)

    def _usd_uv_texture(self, node: _Node, kind: NodeKind, output: str) -> ShadingValue:
        """UsdUVTexture: out = image * scale + bias."""
        fallback = self._constant(node, "fallback", [0.0, 0.0, 0.0, 1.0])
        scale, bias = self._constant(node, "scale", [1.0] * 4), self._constant(node, "bias", [0.0] * 4)
        channels = {"r": [0], "g": [1], "b": [2], "a": [3], "rgb": [0, 1, 2]}.get(output, [0, 1, 2])
        attribute = node.attribute("file")
        space = node.text("sourceColorSpace", "auto")
        try:
            image, pixels, key, tiles = self._images.look_up(attribute, self.time, space, fallback, channels, self.warn)
        except Unreadable as trouble:
            self.warn(f"{trouble}; the texture's fallback is used")
            return constant(*fallback[channels].tolist())
        wraps = []
        for axis, name in enumerate(("wrapS", "wrapT")):
            mode = node.text(name, "useMetadata")
            if mode not in _WRAPS:
                mode = image.wrap[axis] or self._images.default_wrap
            wraps.append(_WRAPS[mode])
        outside = fallback if tiles != (1, 1) else np.zeros(4)  # wrap mode black is transparent black
        key = (key, tuple(channels), tuple(outside[channels]))

        def mapped(mapping: _Placement) -> ShadingValue:
            value = ShadingValue(pixels, outside[channels], mapping(tiles), key, self._asset_path(attribute))
            return self._images.shared(value)

        value = self._placed(node.value("st", constant(0.0, 0.0)), mapped, (wraps[0], wraps[1]))
        if (scale[channels] == 1.0).all() and (bias[channels] == 0.0).all():
            return value
        label = ("scale", tuple(scale[channels]), tuple(bias[channels]))
        return combine(label, lambda a: a * scale[channels].astype(a.dtype) + bias[channels].astype(a.dtype), value)

    def _usd_transform_2d(self, node: _Node, kind: NodeKind, output: str) -> ShadingValue:
        """UsdTransform2d: scale, then rotation [degrees], then translation."""
        translation, scale = self._constant(node, "translation", [0.0, 0.0]), self._constant(node, "scale", [1.0, 1.0])
        rotation = self._constant(node, "rotation", [0.0])
        label = ("UsdTransform2d", tuple(translation), tuple(scale), tuple(rotation))
        return combine(
            label, lambda uv: rotated(uv * scale, -rotation) + translation, node.value("in", constant(0.0, 0.0))
        )

    def _image(self, node: _Node, kind: NodeKind, output: str) -> ShadingValue:
        """MaterialX's nodes image and tiledimage, and RealityKit's image."""
        default = self._constant(node, "default", [0.0] * kind.channels)
        coordinates = self._texture_coordinates(node, "texcoord")
        mode = "_wrap_mode" if kind.node == "RealityKitTexture2D" else "addressmode"
        modes = [_MATERIALX_WRAPS.get(node.text(f"{axis}{mode}", "periodic"), Wrap.REPEAT) for axis in "uv"]
        if kind.node == "tiledimage":
            modes = [Wrap.REPEAT, Wrap.REPEAT]
            factors = ("uvtiling", 1.0), ("uvoffset", 0.0), ("realworldimagesize", 1.0), ("realworldtilesize", 1.0)
            values = [node.value(name, constant(number, number)) for name, number in factors]

            def tiled(uv: Floats, tiling: Floats, offset: Floats, image: Floats, tile: Floats) -> Floats:
                return np.asarray((uv * tiling - offset) / np.where(image == 0.0, 1.0, image) * tile)

            coordinates = combine("tiled", tiled, coordinates, *values)
        try:
            return self._materialx_image(node, kind, coordinates, (modes[0], modes[1]), default)
        except Unreadable as trouble:
            self.warn(f"{trouble}; the image's default is used")
            return constant(*default.tolist())

    def _materialx_image(
        self, node: _Node, kind: NodeKind, coordinates: ShadingValue, wrap: tuple[Wrap, Wrap], default: Floats
    ) -> ShadingValue:
        """The image of a node's input `file` at texture coordinates."""
        attribute, space = node.attribute("file"), "auto" if kind.type.startswith("color") else "raw"
        channels = list(range(kind.channels))
        return self._placed(
            coordinates, lambda mapping: self._image_value(attribute, channels, space, mapping, default), wrap
        )

    def _hex_tiled_image(self, node: _Node, kind: NodeKind, output: str) -> ShadingValue:
        """MaterialX's hextiledimage."""
        default = self._constant(node, "default", [0.0] * kind.channels)
        pairs = {name: self._constant(node, f"{name}range", list(ends)) for name, ends in _HEX_RANGES.items()}
        amounts = {name: float(self._constant(node, name, [1.0])[0]) for name in _HEX_RANGES}
        ranges = {f"{name}_range": (float(ends[0]), float(ends[1])) for name, ends in pairs.items()}
        tiling = HexTiling(**amounts, **ranges)  # type: ignore[arg-type]  # names and types are those of its fields
        falloff, contrast = (float(self._constant(node, n, [0.5])[0]) for n in ("falloff", "falloffcontrast"))
        luminance = self._constant(node, "lumacoeffs", [0.2722287, 0.6740818, 0.0536895])
        repeat = (Wrap.REPEAT, Wrap.REPEAT)
        image = self._materialx_image(node, kind, from_surface(UVRef("st")), repeat, default)

        def tiled(uv: Floats, count: Floats) -> Floats:
            coordinates, weights = hex_tiles(np.asarray(uv[..., :2] * count, np.float64), tiling)
            return blended([look_up(image, st) for st in coordinates], weights, falloff, contrast, luminance)

        label = ("hextiled", image.key, tiling, falloff, contrast, tuple(luminance))
        coordinates = self._texture_coordinates(node, "texcoord")
        return combine(label, tiled, coordinates, node.value("tiling", constant(1.0, 1.0)))

    def _vendor_image(self, node: _UsdNode, name: str, output: str) -> ShadingValue:
        """Images of other renderers' nodes, with Arnold's scale and offset."""
        channels = {"a": [3], "resultA": [3], "r": [0], "g": [1], "b": [2], "resultR": [0]}.get(output, [0, 1, 2])
        coordinates = from_surface(UVRef(node.text("uvset") or "st"))
        connection = next((name for name in ("manifold", "uvcoords", "uv") if node.connected(name)), None)
        coordinates = coordinates if connection is None else node.value(connection, coordinates)
        scale = [float(self._constant(node, key, [1.0])[0]) for key in ("sscale", "tscale")]
        offset = [float(self._constant(node, key, [0.0])[0]) for key in ("soffset", "toffset")]
        if scale != [1.0, 1.0] or offset != [0.0, 0.0]:
            place = ("place", *scale, *offset)
            coordinates = combine(place, lambda uv: uv * np.array(scale) + np.array(offset), coordinates)
        value = self._placed(
            coordinates,
            lambda mapping: self._image_value(node.attribute(_VENDOR_IMAGES[name]), channels, "auto", mapping),
            (Wrap.REPEAT, Wrap.REPEAT),
        )
        if not node.has("multiply") and not node.has("offset"):
            return value
        factor, added = node.value("multiply", constant(1.0)), node.value("offset", constant(0.0))
        return combine("multiplied", lambda a, b, c: a * b + c, value, factor, added)

    def _primvar(self, node: _Node, kind: NodeKind, output: str) -> ShadingValue:
        """Nodes that read primvars; of two numbers, texture coordinates."""
        name_input, fallback_input = ("geomprop", "default")
        if kind.node in ("UsdPrimvarReader", "HwPrimvar_1"):
            name_input, fallback_input = ("varname", "fallback")
        name = node.text(name_input)
        if isinstance(node, _UsdNode) and kind.node == "HwPrimvar_1":
            kind = NodeKind(kind.node, str(node.shader.GetOutput(output).GetTypeName()))
        if kind.type not in CHANNELS:
            raise Unreadable(f"the node {kind.node} of type {kind.type or 'unknown'} is not supported")
        if kind.channels == 2:
            return from_surface(UVRef(name or "st"))
        fallback = node.value(fallback_input, constant(*[0.0] * kind.channels))
        return from_primvar(PrimvarRef(name, kind.channels), fallback)

    def _geom_color(self, node: _Node, kind: NodeKind, output: str) -> ShadingValue:
        """The prim's displayColor."""
        color = from_primvar(PrimvarRef("displayColor", 3), constant(0.0, 0.0, 0.0))
        if kind.channels == 1:
            return select(color, [0])
        return combine(("convert", kind.channels), partial(converted, channels=kind.channels), color)

    def _geometry(self, node: _Node, kind: NodeKind, output: str) -> ShadingValue:
        """Texture coordinates, or the position or normal in the prim's space or the world's."""
        if kind.node == "texcoord":
            index = int(self._constant(node, "index", [0.0])[0])
            uv = from_surface(UVRef("st" if index <= 0 else f"st{index}"))
            return uv if kind.channels == 2 else combine(("convert", 3), partial(converted, channels=3), uv)
        value = from_surface(PointRef(kind.node))
        if node.text("space", "object") != "world":
            return value
        return _to_world(value, kind.node)

    def _transformed(self, node: _Node, kind: NodeKind, output: str) -> ShadingValue:
        """MaterialX's transforms of points, vectors and normals between the prim's space and the world's."""
        value = node.value("in", constant(0.0, 0.0, 0.0))
        spaces = [node.text(name, "object") in ("world",) for name in ("fromspace", "tospace")]
        if spaces[0] == spaces[1]:
            return value
        what = {"transformpoint": "position", "transformnormal": "normal"}.get(kind.node, "vector")
        return _to_world(value, what, inverse=spaces[0])

    def _extract(self, node: _Node, kind: NodeKind, output: str) -> ShadingValue:
        """One channel, by number."""
        operand = node.value("in", constant(0.0))
        index = int(self._constant(node, "index", [0.0])[0])
        return select(operand, [min(max(index, 0), operand.pixels.shape[2] - 1)])

    def _separate(self, node: _Node, kind: NodeKind, output: str) -> ShadingValue:
        """One channel, by the name of the output."""
        operand = node.value("in", constant(0.0))
        index = {"r": 0, "x": 0, "g": 1, "y": 1, "b": 2, "z": 2}.get(output.removeprefix("out")[-1:], 3)
        return select(operand, [min(index, operand.pixels.shape[2] - 1)])

    def _swizzle(self, node: _Node, kind: NodeKind, output: str) -> ShadingValue:
        """Channels in any order, and 0 and 1, by their letters."""
        operand = node.value("in", constant(0.0))
        last = operand.pixels.shape[2] - 1
        letters = node.text("channels") or "rgba"[: kind.channels]

        def swizzled(a: Floats) -> Floats:
            numbers = {"0": np.zeros_like(a[..., :1]), "1": np.ones_like(a[..., :1])}
            parts = [numbers.get(c, a[..., [min(_LETTERS.get(c, 0), last)]]) for c in letters[: kind.channels]]
            return np.concatenate(parts, axis=-1)

        return combine(("swizzle", letters), swizzled, operand)

    def _clock(self, node: _Node, kind: NodeKind, output: str) -> ShadingValue:
        """The frame, or the time [s]."""
        frame = 0.0 if self.time.IsDefault() else self.time.GetValue()
        if kind.node == "frame":
            return constant(frame)
        attribute = node.attribute("fps")
        stage = attribute.GetStage() if attribute is not None else None
        return constant(frame / (stage.GetTimeCodesPerSecond() if stage is not None else 24.0))

    _SPECIAL: ClassVar[dict[str, Callable[["ShadingNetwork", _Node, NodeKind, str], ShadingValue]]] = {
        "UsdUVTexture": _usd_uv_texture,
        "UsdTransform2d": _usd_transform_2d,
        "UsdPrimvarReader": _primvar,
        "HwPrimvar_1": _primvar,
        "geompropvalue": _primvar,
        "geompropvalueuniform": _primvar,
        "geomcolor": _geom_color,
        "image": _image,
        "RealityKitTexture2D": _image,
        "tiledimage": _image,
        "hextiledimage": _hex_tiled_image,
        "texcoord": _geometry,
        "position": _geometry,
        "normal": _geometry,
        "transformpoint": _transformed,
        "transformvector": _transformed,
        "transformnormal": _transformed,
        "extract": _extract,
        "swizzle": _swizzle,
        **dict.fromkeys(("separate", "separate2", "separate3", "separate4"), _separate),
        "frame": _clock,
        "time": _clock,
    }

    def _asset_path(self, attribute: Usd.Attribute | None) -> str:
        """The authored path of an asset attribute; "" if it has none."""
        asset = read.raw(attribute, self.time) if attribute is not None else None
        return asset.path if isinstance(asset, Sdf.AssetPath) else str(asset or "")

    def _constant(self, node: _Node, name: str, default: list[float]) -> Floats:
        """An input as numbers, float64 [c]; the mean if it varies."""
        value = node.value(name, constant(*default))
        if value.reads:
            self.warn(f"{name} varies over the surface: a mean is used")
        numbers = value.mean
        return numbers if len(numbers) == len(default) else np.resize(numbers, len(default))

    def _text(self, shader_input: UsdShade.Input, default: str = "") -> str:
        """An input as a string or token; the default if it has no value."""
        attribute = read.producer(shader_input)
        return read.text(attribute, self.time, default) or default if attribute is not None else default


def _to_world(value: ShadingValue, what: str, *, inverse: bool = False) -> ShadingValue:
    """A "position", "normal" or "vector" of the prim's space in the world's; or the other way."""

    def moved(vectors: Floats, flat: Floats) -> Floats:
        matrix = flat.reshape(*flat.shape[:-1], 4, 4)
        if abs(np.linalg.det(matrix.reshape(-1, 4, 4)[0])) < 1e-30:
            return vectors
        if inverse != (what == "normal"):
            matrix = np.linalg.inv(matrix)
        if what == "normal":
            matrix = np.swapaxes(matrix, -1, -2)
        out = transformed(vectors, matrix.reshape(flat.shape), 1.0 if what == "position" else 0.0)
        return out / np.maximum(np.linalg.norm(out, axis=-1, keepdims=True), 1e-30) if what == "normal" else out

    return combine(("world", what, inverse), moved, value, from_surface(PointRef("transform")))


def _placement(uv: str, transform: Floats, wrap: tuple[Wrap, Wrap] = (Wrap.REPEAT, Wrap.REPEAT)) -> _Placement:
    """The placement of an image as a function of its number of UDIM tiles (across, up)."""
    return lambda tiles: _place(uv, transform, wrap, tiles)


_GEOMETRY = {
    "UV0": from_surface(UVRef("st")),
    "Pobject": from_surface(PointRef("position")),
    "Nobject": from_surface(PointRef("normal")),
    "Pworld": _to_world(from_surface(PointRef("position")), "position"),
    "Nworld": _to_world(from_surface(PointRef("normal")), "normal"),
}
"""What inputs of the library's definitions are by default (`defaultgeomprop`)."""


def _place(uv: str, transform: Floats, wrap: tuple[Wrap, Wrap], tiles: tuple[int, int]) -> UVMapping:
    """The placement of an image; UDIM tiles are joined to one image that does not repeat."""
    if tiles != (1, 1):
        transform = np.diag([1.0 / tiles[0], 1.0 / tiles[1], 1.0]) @ transform
        wrap = (Wrap.BLACK, Wrap.BLACK)
    if not (np.abs(transform) < 1e30).all():
        raise Unreadable("the transform of the texture coordinates is not finite")
    s, t = transform[0].tolist(), transform[1].tolist()
    return UVMapping(uv, ((s[0], s[1], s[2]), (t[0], t[1], t[2])), wrap)
