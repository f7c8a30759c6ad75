"""Materials in .mdl files that are a known one with other arguments, as Omniverse's libraries and converters have it.

MDL is a language. Of it one form is read: `export material NAME(*) = OmniPBR(diffuse_texture: texture_2d("a.png"), …);`
"""

import math
import os
import re
from dataclasses import dataclass, field

from pxr import Ar, Sdf, Tf

_MOST_BYTES = 2**17
"""Such files are short; what is longer is a program."""
_STRING = r'"(?:[^"\\]|\\.)*(?:"|\\?\Z)'
_COMMENT = r"/\*(?:.*?\*/|.*)|//[^\n]*"
_NUMBER = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
# Nothing here matches the same in two ways, which a text could be made for that takes forever.
_NUMBERS = re.compile(rf"(?:(?:color|float[234]?|int|bool)\s*\()?\s*{_NUMBER}f?\s*(?:,\s*{_NUMBER}f?\s*)*\)?")


@dataclass(frozen=True)
class Call:
    """A material that another one is called with."""

    name: str
    """Of the other one, without its module."""
    numbers: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """Its arguments: numbers, colours, vectors, truth values."""
    words: dict[str, str] = field(default_factory=dict)
    """Names of constants."""
    files: dict[str, tuple[Sdf.AssetPath, str]] = field(default_factory=dict)
    """Textures, and what they are said to hold: "sRGB", "raw" or "auto"."""


def read_call(asset: Sdf.AssetPath, name: str) -> Call | None:
    """What a material of an .mdl file calls; None if there is no such file, or it says more than that."""
    text = _text(asset.resolvedPath)
    head = re.search(rf"export\s+material\s+{re.escape(name)}\s*\(\s*\*\s*\)\s*", text)
    if head is None:
        return None
    begin = head.end()
    if text.startswith("[[", begin):  # annotations
        begin = text.find("]]", begin) + 2
    found = re.compile(r"\s*=\s*(?:\w*::)*(\w+)\s*\(").match(text, begin)
    if found is None:
        return None
    call = Call(found[1])
    for argument in _arguments(text[found.end() :]):
        key, colon, value = argument.partition(":")
        if colon:
            _take(call, key.strip(), value.strip(), asset.resolvedPath)
    return call


def _text(source: str) -> str:
    """A file's text without its comments; "" if there is none, or too much of it."""
    if not source or (os.path.exists(source) and not os.path.isfile(source)):
        return ""
    try:
        opened = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(source))
        content = opened.GetBuffer() if opened and opened.GetSize() <= _MOST_BYTES else None
    except Tf.ErrorException:
        return ""
    whole = bytes(content or b"").decode("utf-8", "replace")
    # A string may look like a comment.
    return re.sub(
        f"{_STRING}|{_COMMENT}", lambda found: found[0] if found[0][0] == '"' else " ", whole, flags=re.DOTALL
    )


def _arguments(text: str) -> list[str]:
    """What stands between commas up to the parenthesis that closes what is open."""
    depth, parts = 0, [""]
    for piece in re.findall(f"{_STRING}|.", text, re.DOTALL):
        if piece in "([{":
            depth += 1
        elif piece in ")]}":
            depth -= 1
            if depth < 0:
                break
        if piece == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += piece
    return parts


def _take(call: Call, key: str, value: str, source: str) -> None:
    """Notes an argument, if it is a constant."""
    texture = re.match(r'texture_2d\s*\(\s*"([^"]+)"(.*)', value, re.DOTALL)
    if texture is not None:
        space = "sRGB" if "gamma_srgb" in texture[2] else "raw" if "gamma_linear" in texture[2] else "auto"
        call.files[key] = _asset(texture[1], source), space
    elif _NUMBERS.fullmatch(value):
        numbers = tuple(float(number) for number in re.findall(_NUMBER, value.partition("(")[2] or value))
        if all(math.isfinite(number) for number in numbers):
            call.numbers[key] = numbers
    elif value in ("true", "false"):
        call.numbers[key] = (float(value == "true"),)
    elif re.fullmatch(r"[\w:]+", value):
        call.words[key] = value.rpartition("::")[2]


def _asset(path: str, source: str) -> Sdf.AssetPath:
    """A file that is named relative to another."""
    relative = path if os.path.isabs(path) or path.startswith(("./", "../")) else f"./{path}"
    identifier = Ar.GetResolver().CreateIdentifier(relative, Ar.ResolvedPath(source))
    return Sdf.AssetPath(path, str(Ar.GetResolver().Resolve(identifier)))
