"""MaterialX documents (.mtlx) as layers of UsdShade prims, laid out as by OpenUSD's plug-in.

`/MaterialX/Materials/NAME` is a material. It contains the surface shader, the nodes and node graphs connected to it,
and interface inputs for the shader's values. USD's wheels have no reader for such files. The package MaterialX parses
them, upgrades old versions and knows the definition of each node.
"""

import os
import re
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from pxr import Ar, Gf, Sdf, Tf, Usd, UsdShade

from warp_ir.usd.values.report import Unreadable

if TYPE_CHECKING:
    import MaterialX

_MAX_BYTES = 2**24
"""Maximum size of a document; hand-written ones have a few thousand bytes."""
_MAX_ELEMENTS = 100_000
_MAX_DEPTH = 64
"""Maximum nesting depth of elements: the library's parser is recursive."""
_MAX_PRIMS = 20_000
"""Maximum number of nodes over all materials: each material has copies of the nodes that it uses."""
_SKIPPED = ((b"<!--", b"-->"), (b"<![CDATA[", b"]]>"), (b"<?", b"?>"))
"""Begin and end of markup without elements."""
_QUOTE_OR_END = re.compile(rb"[\"'>]")
_DOCTYPE_MARKUP = re.compile(rb"\"[^\"]*\"|'[^']*'|<\?.*?\?>|<!--.*?-->|<!|>", re.DOTALL)
"""What counts in a document type declaration: quoted text, instructions and comments, then begin and end of groups."""
_TYPES = {
    "float": Sdf.ValueTypeNames.Float,
    "integer": Sdf.ValueTypeNames.Int,
    "boolean": Sdf.ValueTypeNames.Bool,
    "color3": Sdf.ValueTypeNames.Color3f,
    "color4": Sdf.ValueTypeNames.Color4f,
    "vector2": Sdf.ValueTypeNames.Float2,
    "vector3": Sdf.ValueTypeNames.Float3,
    "vector4": Sdf.ValueTypeNames.Float4,
    "string": Sdf.ValueTypeNames.String,
    "filename": Sdf.ValueTypeNames.Asset,
}
"""MaterialX's types in USD; matrices and arrays have no effect on the rendering."""

_VECTORS = {2: Gf.Vec2f, 3: Gf.Vec3f, 4: Gf.Vec4f}


def available() -> bool:
    """Whether the package MaterialX is installed."""
    try:
        import MaterialX  # noqa: F401
    except ImportError:
        return False
    return True


def materialx_layer(source: str) -> tuple[Sdf.Layer, list[str]]:
    """A document as a layer in memory, with messages on what it lacks.

    Args:
        source: Resolved path, which may lie in a package (`a.usdz[b.mtlx]`).

    Raises:
        Unreadable: The file is missing, not a MaterialX document, or too large or deep.
    """
    content = _content(source)
    includes = _check_size(content)
    document = _document(content)
    layer = Sdf.Layer.CreateAnonymous(f"{os.path.basename(source)}.usda")
    writer = _Writer(Usd.Stage.Open(layer), document, Ar.ResolvedPath(source))
    writer.write()
    left_out = [*writer.left_out, *(["included documents are not read"] if includes else [])]
    if document.getLooks():
        left_out.append("its looks are not read: they assign no materials")
    return layer, left_out


def _content(source: str) -> bytes:
    """The content of a file, limited in size."""
    readable = not os.path.exists(source) or os.path.isfile(source)  # a path in a package does not exist by itself
    try:
        asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(source)) if readable else None
    except Tf.ErrorException:
        asset = None
    if asset is None:
        raise Unreadable("not found")
    if asset.GetSize() > _MAX_BYTES:
        raise Unreadable(f"{asset.GetSize()} bytes; the limit is {_MAX_BYTES}")
    return bytes(asset.GetBuffer() or b"").partition(b"\0")[0]  # the library's parser ends there


def _check_size(content: bytes) -> bool:
    """Checks that a document has a limited number and depth of elements; returns whether it includes others.

    It follows the library's parser, pugixml, which accepts more than XML allows: blanks or text before the
    declaration, or `&` and `<` in attributes. It expands no entities. What it refuses may have any depth here.

    Raises:
        Unreadable: It has too many elements, they are nested too deeply, or a tag has no end.
    """
    depth, elements, includes, at = 0, 0, False, content.find(b"<")
    while at >= 0:
        if content.startswith(b"<!DOCTYPE", at):
            at = _doctype_end(content, at + 9)
        elif (end := next((end for start, end in _SKIPPED if content.startswith(start, at)), b"")) != b"":
            at = _after(content, end, at)
        elif content.startswith(b"</", at):
            depth, at = depth - 1, _after(content, b">", at)
        else:
            start, at = at, _tag_end(content, at)
            depth, elements = depth + (content[at - 2 : at] != b"/>"), elements + 1
            includes = includes or content.startswith(b"<xi:include", start)
            if depth > _MAX_DEPTH or elements > _MAX_ELEMENTS:
                raise Unreadable("it has too many elements, or they are nested too deeply")
        at = content.find(b"<", at)
    return includes


def _after(content: bytes, what: bytes, at: int) -> int:
    """The position after the next occurrence of some bytes."""
    found = content.find(what, at)
    if found < 0:
        raise Unreadable("no XML: a tag has no end")
    return found + len(what)


def _tag_end(content: bytes, at: int) -> int:
    """The position after a start tag; `>` in a quoted value does not end it."""
    while True:
        found = _QUOTE_OR_END.search(content, at)
        if found is None:
            raise Unreadable("no XML: a tag has no end")
        if found[0] == b">":
            return found.end()
        at = _after(content, found[0], found.end())


def _doctype_end(content: bytes, at: int) -> int:
    """The position after a document type declaration, whose markup is skipped."""
    depth = 0
    for found in _DOCTYPE_MARKUP.finditer(content, at):
        depth += {b"<!": 1, b">": -1}.get(found[0], 0)
        if depth < 0:
            return found.end()
    raise Unreadable("no XML: its document type declaration has no end")


def _document(content: bytes) -> "MaterialX.Document":
    """The document parsed by the library, with the standard definitions.

    Raises:
        Unreadable: The library refuses it.
    """
    import MaterialX as mx

    document, options = mx.createDocument(), mx.XmlReadOptions()
    options.readXIncludeFunction = None  # included files are not trusted
    try:
        mx.readFromXmlString(document, content.decode("utf-8", "replace"), mx.FileSearchPath(), options)
        document.setDataLibrary(standard_library())
    except Exception as error:  # the library's errors have no common base class
        raise Unreadable(f"no MaterialX: {_first_line(error)}") from None
    return document


@lru_cache(maxsize=1)
def standard_library() -> "MaterialX.Document":
    """The library's standard definitions."""
    import MaterialX as mx

    library = mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    return library


class _Writer:
    """Writes the materials of a document as prims.

    Args:
        stage: The stage to write to.
        document: The document.
        anchor: The path that relative paths in it refer to.
    """

    def __init__(self, stage: Usd.Stage, document: "MaterialX.Document", anchor: Ar.ResolvedPath) -> None:
        self._stage, self._document, self._anchor = stage, document, anchor
        self._pending: list[tuple[MaterialX.Node, Sdf.Path]] = []
        self._written: set[Sdf.Path] = set()
        self.left_out: list[str] = []

    def write(self) -> None:
        """Writes all materials."""
        root = self._stage.DefinePrim("/MaterialX")
        self._stage.SetDefaultPrim(root)
        folder = self._stage.DefinePrim("/MaterialX/Materials").GetPath()
        for node in self._document.getMaterialNodes():
            try:
                self._material(node, folder)
            except Unreadable:
                raise
            except Exception as error:  # the library's errors have no common base class
                self.left_out.append(f"{node.getName()}: {_first_line(error)}")

    def _material(self, node: "MaterialX.Node", folder: Sdf.Path) -> None:
        material = UsdShade.Material.Define(self._stage, _child(folder, node.getName()))
        for material_input in node.getInputs():
            shader = material_input.getConnectedNode()
            if shader is None or material_input.getName() != "surfaceshader":
                continue
            path = self._node(shader, material.GetPath())
            self._write_pending(material)
            written = UsdShade.Shader.Get(self._stage, path)
            # The shader's values become interface inputs, so that references to the material can override them.
            for shader_input in written.GetInputs():
                value = shader_input.Get()
                if value is not None:
                    interface_input = material.CreateInput(shader_input.GetBaseName(), shader_input.GetTypeName())
                    interface_input.Set(value)
                    if shader_input.GetAttr().HasColorSpace():
                        interface_input.GetAttr().SetColorSpace(shader_input.GetAttr().GetColorSpace())
                    shader_input.GetAttr().Clear()
                    shader_input.ConnectToSource(interface_input)
            material.CreateSurfaceOutput("mtlx").ConnectToSource(
                written.CreateOutput("surface", Sdf.ValueTypeNames.Token)
            )

    def _node(self, node: "MaterialX.Node", scope: Sdf.Path) -> Sdf.Path:
        """The prim path of a node, which is queued for writing."""
        path = _child(scope, node.getName())
        if path not in self._written:
            if len(self._written) >= _MAX_PRIMS:
                raise Unreadable(f"more than {_MAX_PRIMS} nodes are used")
            self._written.add(path)
            self._pending.append((node, path))
        return path

    def _write_pending(self, material: UsdShade.Material) -> None:
        """Writes the queued nodes and the nodes connected to them."""
        while self._pending:
            node, path = self._pending.pop()
            if node.getCategory() == "nodegraph":
                graph = UsdShade.NodeGraph.Define(self._stage, path)
                for element in node.getInputs():
                    self._input(element, graph.ConnectableAPI(), material.GetPath())
                for element in node.getOutputs():
                    out = graph.CreateOutput(element.getName(), _type(element))
                    self._connect(element, out, path)
                continue
            definition = node.getNodeDef()
            own = None if definition is None else self._own_graph(definition)
            if own is not None:
                self._custom_node(node, definition, own, path)
                continue
            shader = UsdShade.Shader.Define(self._stage, path)
            name = definition.getName() if definition is not None else f"ND_{node.getCategory()}_{node.getType()}"
            shader.SetShaderId(name)
            for element in node.getInputs():
                self._input(element, shader.ConnectableAPI(), path.GetParentPath())

    def _own_graph(self, definition: "MaterialX.NodeDef") -> "MaterialX.NodeGraph | None":
        """The graph by which the document itself defines a node; None: the node is the library's, or is none."""
        graphs = [g for g in self._document.getNodeGraphs() if g.getNodeDefString() == definition.getName()]
        return graphs[0] if graphs and not standard_library().getNodeDef(definition.getName()) else None

    def _custom_node(
        self, node: "MaterialX.Node", definition: "MaterialX.NodeDef", graph: "MaterialX.NodeGraph", path: Sdf.Path
    ) -> None:
        """Writes a node that the document defines as a node graph of its own, with the definition's defaults."""
        owner = UsdShade.NodeGraph.Define(self._stage, path).ConnectableAPI()
        for declared in definition.getActiveInputs():
            element = node.getInput(declared.getName())
            self._input(declared if element is None else element, owner, path.GetParentPath())
        for element in graph.getOutputs():
            self._connect(element, owner.CreateOutput(element.getName(), _type(element)), path)

    def _input(self, element: "MaterialX.PortElement", owner: UsdShade.ConnectableAPI, scope: Sdf.Path) -> None:
        """Writes an input with its connection or value; `scope` contains the nodes that it may name."""
        if element.getType() not in _TYPES:
            return
        port = owner.CreateInput(Tf.MakeValidIdentifier(element.getName()), _type(element))
        if element.getInterfaceName():
            graph = UsdShade.ConnectableAPI(self._stage.GetPrimAtPath(scope))
            port.ConnectToSource(graph.CreateInput(Tf.MakeValidIdentifier(element.getInterfaceName()), _type(element)))
            return
        if self._connect(element, port, scope):
            return
        value = self._value(element)
        if value is None:
            return
        port.Set(value)
        space = element.getActiveColorSpace() if element.getType() in ("color3", "color4", "filename") else ""
        # The document's default colour space applies to colours; to images only their own one does.
        if space and (element.getType() != "filename" or element.hasAttribute("colorspace")):
            port.GetAttr().SetColorSpace(space)

    def _connect(
        self, element: "MaterialX.PortElement", port: UsdShade.Input | UsdShade.Output, scope: Sdf.Path
    ) -> bool:
        """Connects an input, or an output of a graph, as the document says; returns whether it is connected."""
        graph_name, node_name = element.getAttribute("nodegraph"), element.getNodeName()
        parent = element.getParent() if element.getCategory() == "output" else element.getParent().getParent()
        if graph_name:
            source = self._document.getNodeGraph(graph_name)
        elif node_name:
            source = parent.getChild(node_name)
        else:
            return False
        if source is None:
            raise ValueError(f"{element.getNamePath()} is connected to '{graph_name or node_name}', which is not there")
        path = self._node(source, scope)
        prim = UsdShade.ConnectableAPI(self._stage.OverridePrim(path))
        port.ConnectToSource(prim.CreateOutput(element.getOutputString() or "out", _type(element)))
        return True

    def _value(self, element: "MaterialX.PortElement") -> object:
        """The value of an element as USD stores it; None: it has none that is supported."""
        if element.getType() == "filename":
            return Sdf.AssetPath(self._path(element.getResolvedValueString(), element.getValueString()))
        value = element.getValue()
        if value is None or isinstance(value, bool | int | float | str):
            return value
        numbers = [float(x) for x in np.asarray(value.asTuple()).reshape(-1)]
        return _VECTORS[len(numbers)](*numbers) if len(numbers) in _VECTORS else None

    def _path(self, with_prefix: str, authored: str) -> str:
        """Absolute path of a file; as written if its fileprefix leads nowhere, since other readers ignore prefixes."""
        named = [text for text in (with_prefix, authored) if text]
        paths = [Ar.GetResolver().CreateIdentifier(_relative(text), self._anchor) for text in named]
        return next((path for path in paths if _exists(path)), paths[0] if paths else "")


def _relative(path: str) -> str:
    """A path that is resolved relative to the document only."""
    return path if os.path.isabs(path) or path.startswith(("./", "../")) else f"./{path}"


def _exists(path: str) -> bool:
    if "<UDIM>" in path:
        return os.path.isdir(os.path.dirname(path))
    return bool(Ar.GetResolver().Resolve(path))


def _child(scope: Sdf.Path, name: str) -> Sdf.Path:
    return scope.AppendChild(Tf.MakeValidIdentifier(name))


def _type(element: "MaterialX.PortElement") -> Sdf.ValueTypeName:
    return _TYPES.get(element.getType(), Sdf.ValueTypeNames.Token)


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0].strip() if lines else type(error).__name__
