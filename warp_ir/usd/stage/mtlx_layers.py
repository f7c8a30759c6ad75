"""References to .mtlx files, led to layers that are made of them in memory.

USD asks a plug-in for such files, which its wheels lack. A session layer cannot lead a reference elsewhere that lies in
an instance, and layers are shared by all stages of a process: so the layers between the root and a document are copied
in memory, and the copies name one another. Nothing else is copied, and nothing at all where there is no document.
"""

from functools import partial

from pxr import Ar, Sdf, Tf, Usd, UsdUtils

from warp_ir.usd.stage.materialx import available, materialx_layer
from warp_ir.usd.values.report import Report, Unreadable

_Layers = dict[str, Sdf.Layer]


def with_documents(stage: Usd.Stage, report: Report) -> tuple[Sdf.Layer, ...]:
    """What to open instead of a stage, so that its .mtlx files are read: a root layer, and the layers that it needs.

    The session layer is changed in place: it has to be the stage's own.

    Args:
        stage: As it is composed without the documents.
        report: Where documents that cannot be read are named.

    Returns:
        Nothing where the stage can stay as it is. The layers must be held until the new stage is open.
    """
    if not any(".mtlx" in str(error).lower() for error in stage.GetCompositionErrors()):
        return ()  # looking for paths in a damaged layer could end the process
    used = [layer for layer in stage.GetUsedLayers() if layer]
    named = {layer: _dependencies(layer) for layer in used}
    wanted = {path for paths in named.values() for path in paths.values() if _is_mtlx(path)}
    if not wanted or Sdf.FileFormat.FindByExtension("mtlx") is not None:
        return ()
    if not available():
        report.warn("/", f"{len(wanted)} .mtlx files cannot be read: the package MaterialX is not installed")
        return ()
    documents = {path: _read(path, report) for path in sorted(wanted)}
    copies: _Layers = {}
    while True:
        known = documents.keys() | copies.keys()
        new = [
            layer for layer in used if layer.identifier not in copies and not known.isdisjoint(named[layer].values())
        ]
        if not new:
            break
        copies |= {layer.identifier: Sdf.Layer.CreateAnonymous(_tag(layer)) for layer in new}
    session, root = stage.GetSessionLayer(), stage.GetRootLayer()
    copies[session.identifier] = session
    for layer in used:
        if layer.identifier in copies:
            copy = copies[layer.identifier]
            if layer != session:
                copy.TransferContent(layer)
            UsdUtils.ModifyAssetPaths(copy, partial(_led, layer, documents | copies))
    return copies.get(root.identifier, root), *copies.values(), *documents.values()


def _dependencies(layer: Sdf.Layer) -> dict[str, str]:
    """The asset paths of sublayers, references and payloads: as authored, and what identifies them."""
    return {path: _identifier(layer, path) for path in layer.GetCompositionAssetDependencies()}


def _identifier(layer: Sdf.Layer, path: str) -> str:
    """The identifier of the layer that a path in another one leads to."""
    try:
        found = Sdf.Layer.FindRelativeToLayer(layer, path)
    except Tf.ErrorException:
        found = None
    return str(found.identifier) if found else _absolute(layer, path)


def _absolute(layer: Sdf.Layer, path: str) -> str:
    try:
        return str(layer.ComputeAbsolutePath(path))
    except Tf.ErrorException:
        return path


def _led(layer: Sdf.Layer, elsewhere: _Layers, path: str) -> str:
    """A path in a layer as it is written in the copy, which lies nowhere and leads where it should."""
    if not path or path.startswith(("`", "anon:")):
        return elsewhere[path].identifier if path in elsewhere else path
    found = elsewhere.get(_identifier(layer, path))
    if found is not None:
        return str(found.identifier)
    absolute = _absolute(layer, path)
    # A name that is searched for, and not found, may be a pattern: images by tiles lie beside the layer.
    return _absolute(layer, f"./{path}") if absolute == path and "<UDIM>" in path else absolute


def _is_mtlx(path: str) -> bool:
    path = Sdf.Layer.SplitIdentifier(path)[0]
    return (Ar.SplitPackageRelativePathInner(path)[1] or path).lower().endswith(".mtlx")


def _tag(layer: Sdf.Layer) -> str:
    """The name of a copy, of which the extension decides the format: packages cannot be made."""
    name = str(layer.GetDisplayName())
    return name if name.endswith((".usda", ".usdc", ".usd")) else f"{name}.usda"


def _read(path: str, report: Report) -> Sdf.Layer:
    """The layer of a document; an empty one, and a line, if it cannot be read."""
    try:
        layer, left_out = materialx_layer(path)
    except Unreadable as trouble:
        report.warn("/", f"MaterialX document {path}: {trouble}")
        empty = Sdf.Layer.CreateAnonymous("empty.usda")
        Sdf.CreatePrimInLayer(empty, "/MaterialX/Materials")
        empty.defaultPrim = "MaterialX"
        return empty
    for what in left_out:
        report.warn("/", f"MaterialX document {path}: {what}")
    return layer
