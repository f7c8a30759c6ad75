"""What USD would open with a stage: no pipe, for which it would wait for ever, and nothing so deep that it crashes."""

import mmap
import os
import re
from collections.abc import Iterator

import numpy as np
from pxr import Ar, Sdf, Tf

from warp_ir.files import special_kind
from warp_ir.scene import InputError
from warp_ir.usd.stage.crate_validation import MAX_DEPTH, is_crate, validate_crate

_ASSET = re.compile(rb"@(?:@@)?([^@\n]+)@")
"""An asset path in a text layer. It may also be in a string or a comment: then a file more is looked at."""
_TOKENS = re.compile(
    rb'"""(?:[^\\]|\\.)*?"""'
    rb"|'''(?:[^\\]|\\.)*?'''"
    rb'|"(?:[^"\\\n]|\\.)*"'
    rb"|'(?:[^'\\\n]|\\.)*'"
    rb"|#[^\n]*|@@@.*?@@@|@[^@\n]*@|[{}]",
    re.DOTALL,
)
"""What may hold braces in a text layer, and the braces."""
_CHUNK = 1 << 24


def check_layers(path: str, *, follow: bool = True) -> None:
    """Checks a layer and, with `follow`, all layers that it refers to, directly or not.

    Raises:
        InputError: One of them is no regular file, its prims are nested too deeply, or its tables are damaged.
    """
    todo, seen = [path], {os.path.realpath(path)}
    while todo:
        layer = todo.pop()
        _check_depth(layer)
        for asset in _assets(layer):
            found = _find(layer, asset)
            if found is None or os.path.realpath(found) in seen:
                continue
            seen.add(os.path.realpath(found))
            other = special_kind(found)
            if other:
                raise InputError(f"{found}: is {other}, not a USD file; {layer} refers to it")
            if follow:
                validate_crate(found)
                todo.append(found)


def _assets(path: str) -> Iterator[str]:
    """The asset paths in a layer, without arguments."""
    if is_crate(path):
        try:
            layer = Sdf.Layer.FindOrOpen(path)
            paths = list(layer.GetCompositionAssetDependencies()) if layer is not None else []
        except (Tf.ErrorException, RuntimeError):  # it is reported when the stage is composed
            paths = []
    else:
        text = _text(path)
        paths = [] if text is None else [m[1].decode("utf-8", "replace") for m in _ASSET.finditer(text)]
    yield from dict.fromkeys(path.partition(":SDF_FORMAT_ARGS:")[0] for path in paths)


def _find(layer: str, asset: str) -> str | None:
    """The file of a layer that another one refers to; None: there is none, or it is no file of a layer."""
    suffix = os.path.splitext(asset)[1].lower().removeprefix(".")
    if "\0" in asset or suffix not in Sdf.FileFormat.FindAllFileFormatExtensions():
        return None
    found = os.path.join(os.path.dirname(layer), asset)
    if not os.path.exists(found):
        found = Ar.GetResolver().Resolve(asset).GetPathString()
    return found if os.path.exists(found) else None


def _check_depth(path: str) -> None:
    """Raises `InputError` if the prims of a text layer are nested more deeply than USD can read."""
    text = _text(path)
    if text is None:
        return
    data = np.frombuffer(text, np.uint8)
    braces = sum(np.count_nonzero(data[i : i + _CHUNK] == ord("{")) for i in range(0, len(data), _CHUNK))
    if braces <= MAX_DEPTH:
        return
    depth = 0
    for token in _TOKENS.finditer(text):
        depth += {b"{": 1, b"}": -1}.get(token[0], 0)
        if depth > MAX_DEPTH:
            raise InputError(f"{path}: its prims are nested more than {MAX_DEPTH} deep")


def _text(path: str) -> mmap.mmap | None:
    """The content of a text layer; None if it is none."""
    try:
        with open(path, "rb") as file:
            if file.read(1) != b"#":
                return None
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError:
        return None
