"""Replaces references to .mtlx files by references to layers that are built from them in memory.

USD needs a plug-in for such files, which its wheels lack. A session layer cannot change a reference inside an instance,
and layers are shared by all stages of a process. So the layers between the root and a document are copied in memory,
and the copies refer to one another. Other layers are not copied; without documents nothing is.
"""

from functools import partial

from pxr import Ar, Sdf, Tf, Usd, UsdUtils

from warp_ir.usd.stage.materialx import available, materialx_layer
from warp_ir.usd.values.report import Report, Unreadable

_Layers = dict[str, Sdf.Layer]


def layers_with_mtlx(stage: Usd.Stage, report: Report) -> tuple[Sdf.Layer, ...]:
    """The layers to open instead of a stage, so that its .mtlx files are read: the root layer, and the layers it needs.

    The stage's session layer is changed in place.

    Args:
        stage: The stage, composed without the documents.
        report: Receives warnings of documents that cannot be read.

    Returns:
        () if the stage needs no change. The layers must stay referenced until the new stage is open.
    """
    if not any(".mtlx" in str(error).lower() for error in stage.GetCompositionErrors()):
        return ()  # searching a damaged layer for paths could end the process
    used_layers = [layer for layer in stage.GetUsedLayers() if layer]
    dependencies = {layer: _dependencies(layer) for layer in used_layers}
    wanted = {path for paths in dependencies.values() for path in paths.values() if _is_mtlx(path)}
    if not wanted or Sdf.FileFormat.FindByExtension("mtlx") is not None:
        return ()
    if not available():
        report.warn("/", f"{len(wanted)} .mtlx files cannot be read: the package MaterialX is not installed")
        return ()
    documents = {path: _document_layer(path, report) for path in sorted(wanted)}
    copies: _Layers = {}
    while True:
        known = documents.keys() | copies.keys()
        new = [
            layer
            for layer in used_layers
            if layer.identifier not in copies and not known.isdisjoint(dependencies[layer].values())
        ]
        if not new:
            break
        copies |= {layer.identifier: Sdf.Layer.CreateAnonymous(_copy_name(layer)) for layer in new}
    session, root = stage.GetSessionLayer(), stage.GetRootLayer()
    copies[session.identifier] = session
    for layer in used_layers:
        if layer.identifier in copies:
            copy = copies[layer.identifier]
            if layer != session:
                copy.TransferContent(layer)
            UsdUtils.ModifyAssetPaths(copy, partial(_remapped_path, layer, documents | copies))
    return copies.get(root.identifier, root), *copies.values(), *documents.values()


def _dependencies(layer: Sdf.Layer) -> dict[str, str]:
    """Asset paths of sublayers, references and payloads: as authored, with the identifiers they resolve to."""
    return {path: _identifier(layer, path) for path in layer.GetCompositionAssetDependencies()}


def _identifier(layer: Sdf.Layer, path: str) -> str:
    """Identifier of the layer that a path in another layer refers to."""
    try:
        target = Sdf.Layer.FindRelativeToLayer(layer, path)
    except Tf.ErrorException:
        target = None
    return str(target.identifier) if target else _absolute(layer, path)


def _absolute(layer: Sdf.Layer, path: str) -> str:
    """The absolute form of a path in a layer, if it has one."""
    try:
        return str(layer.ComputeAbsolutePath(path))
    except Tf.ErrorException:
        return path


def _remapped_path(layer: Sdf.Layer, replacements: _Layers, path: str) -> str:
    """An asset path as the anonymous copy of a layer needs it: absolute, or the identifier of a replacement."""
    if not path or path.startswith(("`", "anon:")):
        return replacements[path].identifier if path in replacements else path
    replacement = replacements.get(_identifier(layer, path))
    if replacement is not None:
        return str(replacement.identifier)
    absolute = _absolute(layer, path)
    # An unresolved search path may be a UDIM pattern, which is relative to the layer.
    return _absolute(layer, f"./{path}") if absolute == path and "<UDIM>" in path else absolute


def _is_mtlx(path: str) -> bool:
    """Whether a path names a MaterialX document, in a package or not."""
    path = Sdf.Layer.SplitIdentifier(path)[0]
    return (Ar.SplitPackageRelativePathInner(path)[1] or path).lower().endswith(".mtlx")


def _copy_name(layer: Sdf.Layer) -> str:
    """The name of a layer's copy; its extension selects a format that can be created (packages cannot)."""
    name = str(layer.GetDisplayName())
    return name if name.endswith((".usda", ".usdc", ".usd")) else f"{name}.usda"


def _document_layer(path: str, report: Report) -> Sdf.Layer:
    """The layer of a document; an empty one, with a warning, if it cannot be read."""
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
