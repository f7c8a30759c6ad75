"""Materials in .mdl files that call a known material with other arguments, as Omniverse's libraries and tools write.

MDL is a language. Only this form is read:
`export material NAME(*) = OmniPBR(diffuse_texture: texture_2d("a.png"), …);`
"""

import math
import os
import re
from dataclasses import dataclass, field

from pxr import Ar, Sdf, Tf

_MAX_BYTES = 2**17
"""Maximum size of a file; such files are short, longer ones are programs."""
_STRING = r'"(?:[^"\\]|\\.)*(?:"|\\?\Z)'
_COMMENT = r"/\*(?:.*?\*/|.*)|//[^\n]*"
_NUMBER = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
# The pattern is unambiguous: a crafted text cannot make it backtrack exponentially.
_NUMBERS = re.compile(rf"(?:(?:color|float[234]?|int|bool)\s*\()?\s*{_NUMBER}f?\s*(?:,\s*{_NUMBER}f?\s*)*\)?")


@dataclass(frozen=True)
class MdlCall:
    """A call of a material, with its constant arguments by name."""

    name: str
    """The called material, without its module."""
    numbers: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """Numbers, colours, vectors and truth values."""
    constants: dict[str, str] = field(default_factory=dict)
    """Names of constants."""
    files: dict[str, tuple[Sdf.AssetPath, str]] = field(default_factory=dict)
    """Textures with their gamma: "sRGB", "raw" or "auto"."""


def read_mdl_call(asset: Sdf.AssetPath, name: str) -> MdlCall | None:
    """The call that defines a material of an .mdl file; None: there is no such file, or it has another form."""
    text = _source_without_comments(asset.resolvedPath)
    head = re.search(rf"export\s+material\s+{re.escape(name)}\s*\(\s*\*\s*\)\s*", text)
    if head is None:
        return None
    begin = head.end()
    if text.startswith("[[", begin):  # annotations
        begin = text.find("]]", begin) + 2
    head_of_call = re.compile(r"\s*=\s*(?:\w*::)*(\w+)\s*\(").match(text, begin)
    if head_of_call is None:
        return None
    call = MdlCall(head_of_call[1])
    for argument in _arguments(text[head_of_call.end() :]):
        key, colon, value = argument.partition(":")
        if colon:
            _add_argument(call, key.strip(), value.strip(), asset.resolvedPath)
    return call


def _source_without_comments(mdl_path: str) -> str:
    """The text of a file without comments; "" if there is none or it is too large."""
    if not mdl_path or (os.path.exists(mdl_path) and not os.path.isfile(mdl_path)):
        return ""
    try:
        opened = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(mdl_path))
        content = opened.GetBuffer() if opened and opened.GetSize() <= _MAX_BYTES else None
    except Tf.ErrorException:
        return ""
    whole = bytes(content or b"").decode("utf-8", "replace")
    # Strings may contain comment marks.
    return re.sub(
        f"{_STRING}|{_COMMENT}", lambda match: match[0] if match[0][0] == '"' else " ", whole, flags=re.DOTALL
    )


def _arguments(text: str) -> list[str]:
    """The arguments of a call: split at commas, up to the closing parenthesis."""
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


def _add_argument(call: MdlCall, key: str, value: str, mdl_path: str) -> None:
    """Stores an argument, if it is constant."""
    texture = re.match(r'texture_2d\s*\(\s*"([^"]+)"(.*)', value, re.DOTALL)
    if texture is not None:
        space = "sRGB" if "gamma_srgb" in texture[2] else "raw" if "gamma_linear" in texture[2] else "auto"
        call.files[key] = _resolved_asset(texture[1], mdl_path), space
    elif _NUMBERS.fullmatch(value):
        numbers = tuple(float(number) for number in re.findall(_NUMBER, value.partition("(")[2] or value))
        if all(math.isfinite(number) for number in numbers):
            call.numbers[key] = numbers
    elif value in ("true", "false"):
        call.numbers[key] = (float(value == "true"),)
    elif re.fullmatch(r"[\w:]+", value):
        call.constants[key] = value.rpartition("::")[2]


def _resolved_asset(path: str, mdl_path: str) -> Sdf.AssetPath:
    """The asset of a path relative to the .mdl file."""
    relative = path if os.path.isabs(path) or path.startswith(("./", "../")) else f"./{path}"
    identifier = Ar.GetResolver().CreateIdentifier(relative, Ar.ResolvedPath(mdl_path))
    return Sdf.AssetPath(path, str(Ar.GetResolver().Resolve(identifier)))
