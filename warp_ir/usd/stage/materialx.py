"""MaterialX documents (.mtlx) as layers of UsdShade prims, laid out as OpenUSD's own plug-in does.

`/MaterialX/Materials/NAME` is a material: its surface shader, the nodes and node graphs that feed it, and an interface
of the values that the shader is given. USD's wheels have no reader for such files; the package MaterialX parses them,
brings old versions up to date and knows which definition a node has.
"""

import os
from functools import lru_cache
from typing import Any
from xml.parsers import expat

import numpy as np
from pxr import Ar, Gf, Sdf, Tf, Usd, UsdShade

from warp_ir.usd.values.report import Unreadable

_MAX_BYTES = 2**24
"""Of one document; those that people write have a few thousand."""
_MAX_ELEMENTS = 100_000
_MAX_DEPTH = 64
"""Of elements in elements: the parser of the library is recursive."""
_MAX_PRIMS = 20_000
"""Nodes written for all materials together: each has its own copy of what it uses."""
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
"""What USD calls MaterialX's types; matrices and arrays feed nothing that is rendered."""
_VECTORS = {2: Gf.Vec2f, 3: Gf.Vec3f, 4: Gf.Vec4f}


def available() -> bool:
    """Whether the package MaterialX is installed."""
    try:
        import MaterialX  # noqa: F401
    except ImportError:
        return False
    return True


def materialx_layer(source: str) -> tuple[Sdf.Layer, list[str]]:
    """A document as a layer in memory, and what of it is left out.

    Args:
        source: Its resolved path, which may lie in a package (`a.usdz[b.mtlx]`).

    Raises:
        Unreadable: It is missing, no MaterialX document, or unreasonably large or deep.
    """
    content = _content(source)
    includes = _check(content)
    document = _document(content)
    layer = Sdf.Layer.CreateAnonymous(f"{os.path.basename(source)}.usda")
    writer = _Writer(Usd.Stage.Open(layer), document, Ar.ResolvedPath(source))
    writer.write()
    left_out = [*writer.left_out, *(["the documents that it includes are not read"] if includes else [])]
    if document.getLooks():
        left_out.append("its looks are not read: they bind no materials")
    return layer, left_out


def _content(source: str) -> bytes:
    opened = None if os.path.exists(source) and not os.path.isfile(source) else _asset(source)
    if opened is None:
        raise Unreadable("not found")
    if opened.GetSize() > _MAX_BYTES:
        raise Unreadable(f"{opened.GetSize()} bytes; the limit is {_MAX_BYTES}")
    return bytes(opened.GetBuffer() or b"")


def _asset(source: str) -> Any:
    try:
        return Ar.GetResolver().OpenAsset(Ar.ResolvedPath(source))
    except Tf.ErrorException:
        return None


def _check(content: bytes) -> bool:
    """See that it is XML without entities, not too large and not too deep; whether it includes other documents.

    Raises:
        Unreadable: It is not.
    """
    open_elements, elements, includes = 0, 0, False

    def start(name: str, _attributes: dict[str, str]) -> None:
        nonlocal open_elements, elements, includes
        open_elements, elements, includes = open_elements + 1, elements + 1, includes or name == "xi:include"
        if open_elements > _MAX_DEPTH or elements > _MAX_ELEMENTS:
            raise Unreadable("its elements are too many or nested too deeply")

    def end(_name: str) -> None:
        nonlocal open_elements
        open_elements -= 1

    def declared(*_: object) -> None:
        raise Unreadable("it declares a document type, which MaterialX has no use for")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.StartDoctypeDeclHandler = declared
    try:
        parser.Parse(content, True)
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise Unreadable(f"no XML: {error}") from None
    return includes


def _document(content: bytes) -> Any:
    """The document of the library, with the standard definitions.

    Raises:
        Unreadable: The library refuses it.
    """
    import MaterialX as mx

    document, options = mx.createDocument(), mx.XmlReadOptions()
    options.readXIncludeFunction = None  # a file may not make others be read
    try:
        mx.readFromXmlString(document, content.decode("utf-8", "replace"), mx.FileSearchPath(), options)
        document.setDataLibrary(_standard_library())
    except Exception as error:  # the library has no common base of its errors
        raise Unreadable(f"no MaterialX: {_first_line(error)}") from None
    return document


@lru_cache(maxsize=1)
def _standard_library() -> Any:
    import MaterialX as mx

    library = mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    return library


class _Writer:
    """Writes the materials of a document as prims.

    Args:
        stage: Where to.
        document: The document.
        anchor: What the paths in it are relative to.
    """

    def __init__(self, stage: Usd.Stage, document: Any, anchor: Ar.ResolvedPath) -> None:
        self._stage, self._document, self._anchor = stage, document, anchor
        self._waiting: list[tuple[Any, Sdf.Path]] = []
        self._written: set[Sdf.Path] = set()
        self.left_out: list[str] = []

    def write(self) -> None:
        root = self._stage.DefinePrim("/MaterialX")
        self._stage.SetDefaultPrim(root)
        folder = self._stage.DefinePrim("/MaterialX/Materials").GetPath()
        for node in self._document.getMaterialNodes():
            try:
                self._material(node, folder)
            except Unreadable:
                raise
            except Exception as error:  # the library has no common base of its errors
                self.left_out.append(f"{node.getName()}: {_first_line(error)}")

    def _material(self, node: Any, folder: Sdf.Path) -> None:
        material = UsdShade.Material.Define(self._stage, _child(folder, node.getName()))
        for slot in node.getInputs():
            shader = slot.getConnectedNode()
            if shader is None or slot.getName() != "surfaceshader":
                continue
            path = self._node(shader, material.GetPath())
            self._fill(material)
            written = UsdShade.Shader.Get(self._stage, path)
            # The values of the surface are the material's interface: whoever references it may change them there.
            for given in written.GetInputs():
                value = given.Get()
                if value is not None:
                    ours = material.CreateInput(given.GetBaseName(), given.GetTypeName())
                    ours.Set(value)
                    if given.GetAttr().HasColorSpace():
                        ours.GetAttr().SetColorSpace(given.GetAttr().GetColorSpace())
                    given.GetAttr().Clear()
                    given.ConnectToSource(ours)
            material.CreateSurfaceOutput("mtlx").ConnectToSource(
                written.CreateOutput("surface", Sdf.ValueTypeNames.Token)
            )

    def _node(self, node: Any, scope: Sdf.Path) -> Sdf.Path:
        """The path at which a node will be written."""
        path = _child(scope, node.getName())
        if path not in self._written:
            if len(self._written) >= _MAX_PRIMS:
                raise Unreadable(f"more than {_MAX_PRIMS} nodes are used")
            self._written.add(path)
            self._waiting.append((node, path))
        return path

    def _fill(self, material: UsdShade.Material) -> None:
        """Writes nodes, and those that they lead to, until none is left."""
        while self._waiting:
            node, path = self._waiting.pop()
            if node.getCategory() == "nodegraph":
                graph = UsdShade.NodeGraph.Define(self._stage, path)
                for element in node.getInputs():
                    self._input(element, graph.ConnectableAPI(), material.GetPath())
                for element in node.getOutputs():
                    out = graph.CreateOutput(element.getName(), _type(element))
                    self._connect(element, out, path)
                continue
            shader = UsdShade.Shader.Define(self._stage, path)
            definition = node.getNodeDef()
            name = definition.getName() if definition is not None else f"ND_{node.getCategory()}_{node.getType()}"
            shader.SetShaderId(name)
            for element in node.getInputs():
                self._input(element, shader.ConnectableAPI(), path.GetParentPath())

    def _input(self, element: Any, owner: UsdShade.ConnectableAPI, scope: Sdf.Path) -> None:
        """One input: connected, or with its value; `scope` holds the nodes it may name."""
        if element.getType() not in _TYPES:
            return
        made = owner.CreateInput(Tf.MakeValidIdentifier(element.getName()), _type(element))
        if element.getInterfaceName():
            graph = UsdShade.ConnectableAPI(self._stage.GetPrimAtPath(scope))
            made.ConnectToSource(graph.CreateInput(Tf.MakeValidIdentifier(element.getInterfaceName()), _type(element)))
            return
        if self._connect(element, made, scope):
            return
        value = self._value(element)
        if value is None:
            return
        made.Set(value)
        space = element.getActiveColorSpace() if element.getType() in ("color3", "color4", "filename") else ""
        # What the document says of all its colours is said of images only where it stands on them.
        if space and (element.getType() != "filename" or element.hasAttribute("colorspace")):
            made.GetAttr().SetColorSpace(space)

    def _connect(self, element: Any, made: UsdShade.Input | UsdShade.Output, scope: Sdf.Path) -> bool:
        """Connects an input or an output of a graph to what the document says; whether it says anything."""
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
        made.ConnectToSource(prim.CreateOutput(element.getOutputString() or "out", _type(element)))
        return True

    def _value(self, element: Any) -> Any:
        if element.getType() == "filename":
            return Sdf.AssetPath(self._path(element.getResolvedValueString(), element.getValueString()))
        found = element.getValue()
        if found is None or isinstance(found, bool | int | float | str):
            return found
        numbers = [float(x) for x in np.asarray(found.asTuple()).reshape(-1)]
        return _VECTORS[len(numbers)](*numbers) if len(numbers) in _VECTORS else None

    def _path(self, with_prefix: str, authored: str) -> str:
        """Absolute path of a file; if a fileprefix leads nowhere, as it was written: other readers know no prefixes."""
        named = [text for text in (with_prefix, authored) if text]
        paths = [Ar.GetResolver().CreateIdentifier(_relative(text), self._anchor) for text in named]
        return next((path for path in paths if _exists(path)), paths[0] if paths else "")


def _relative(path: str) -> str:
    """A path that is sought beside the document, and nowhere else."""
    return path if os.path.isabs(path) or path.startswith(("./", "../")) else f"./{path}"


def _exists(path: str) -> bool:
    if "<UDIM>" in path:
        return os.path.isdir(os.path.dirname(path))
    return bool(Ar.GetResolver().Resolve(path))


def _child(scope: Sdf.Path, name: str) -> Sdf.Path:
    return scope.AppendChild(Tf.MakeValidIdentifier(name))


def _type(element: Any) -> Sdf.ValueTypeName:
    return _TYPES.get(element.getType(), Sdf.ValueTypeNames.Token)


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0].strip() if lines else type(error).__name__
