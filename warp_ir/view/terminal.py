"""Pictures in a terminal: by the protocols of kitty and iTerm2, as sixels, or as half blocks in 24-bit colours."""

import base64
import os
import shutil
import struct
import zlib
from collections.abc import Mapping
from typing import TextIO

import numpy as np

from warp_ir.view.display import Pixels, scaled

_CELL = 8, 16
"""Approximate width and height of a character [pixels], for terminals that do not scale pictures."""
_CHUNK = 4096
"""Largest number of characters in one message of kitty's protocol."""
_LEVELS = 6
"""Values of each channel of the palette of sixels."""
_BAYER = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]]) / 16.0
"""Thresholds of ordered dithering."""
_LARGEST = 640, 400
"""Largest picture that is sent [pixels]."""


def terminal_protocol(environ: Mapping[str, str]) -> str | None:
    """How a terminal shows pictures, by its environment: "kitty", "iterm", "sixel" or "blocks"; None: it cannot."""
    term, program = environ.get("TERM", ""), environ.get("TERM_PROGRAM", "")
    if environ.get("TMUX") or term.startswith(("screen", "tmux")):  # it does not pass pictures on
        return "blocks" if environ.get("COLORTERM") in ("truecolor", "24bit") else None
    if "kitty" in term or environ.get("KITTY_WINDOW_ID") or program == "ghostty":
        return "kitty"
    if program in ("iTerm.app", "WezTerm", "mintty") or environ.get("LC_TERMINAL") == "iTerm2":
        return "iterm"
    if term.startswith(("foot", "mlterm", "contour", "yaft")) or "sixel" in term:
        return "sixel"
    return "blocks" if environ.get("COLORTERM") in ("truecolor", "24bit") else None


class TerminalPicture:
    """A picture in a terminal that is replaced by the next."""

    def __init__(self, stream: TextIO, protocol: str) -> None:
        """Shows pictures by a protocol that `terminal_protocol` names."""
        self._stream, self._protocol = stream, protocol
        self._rows = 0  # of the picture that is shown, and of the line below it

    def show(self, pixels: Pixels, line: str) -> None:
        """Shows a picture, and a line of text below it."""
        columns, lines = shutil.get_terminal_size()
        wide, high = max(columns - 1, 1), max(lines - 2, 1)
        height, width = pixels.shape[:2]
        rows = min(high, max(round(wide * height / width * _CELL[0] / _CELL[1]), 1))
        wide = min(wide, max(round(rows * width / height * _CELL[1] / _CELL[0]), 1))
        if self._protocol == "blocks":
            text = half_blocks(scaled(pixels, wide, 2 * rows))
        elif self._protocol == "sixel":
            text = sixels(scaled(pixels, wide * _CELL[0], rows * _CELL[1])) + "\n"
        else:
            size = min(width, _LARGEST[0]), min(height, _LARGEST[1])
            image = scaled(pixels, *size) if size != (width, height) else pixels
            text = (kitty if self._protocol == "kitty" else iterm)(image, wide, rows) + "\n"
        start = f"\x1b[{self._rows}A\r" if self._rows else ""
        self._stream.write(f"{start}{text}\x1b[K{line[: columns - 1]}\n")
        self._stream.flush()
        self._rows = rows + 1


def half_blocks(pixels: Pixels) -> str:
    """Two rows of pixels in each line of text: the colours of the upper half of a block and of what is behind it."""
    lines = []
    for upper, lower in zip(pixels[0::2].tolist(), pixels[1::2].tolist(), strict=True):
        cells = [
            f"\x1b[38;2;{r};{g};{b};48;2;{u};{v};{w}m\u2580" for (r, g, b), (u, v, w) in zip(upper, lower, strict=True)
        ]
        lines.append("".join(cells) + "\x1b[0m\n")
    return "".join(lines)


def kitty(pixels: Pixels, columns: int, rows: int) -> str:
    """A picture by the graphics protocol of kitty, which scales it to columns and rows of characters."""
    data = _png(pixels)
    chunks = [data[k : k + _CHUNK] for k in range(0, len(data), _CHUNK)]
    out = []
    for k, chunk in enumerate(chunks):
        more = int(k + 1 < len(chunks))
        control = f"a=T,f=100,i=1,p=1,q=2,C=1,c={columns},r={rows},m={more}" if k == 0 else f"m={more}"
        out.append(f"\x1b_G{control};{chunk}\x1b\\")
    return "".join(out) + "\n" * (rows - 1)


def iterm(pixels: Pixels, columns: int, rows: int) -> str:
    """A picture by the protocol of iTerm2, which scales it to columns and rows of characters."""
    size = f"width={columns};height={rows};preserveAspectRatio=0"
    return f"\x1b]1337;File=inline=1;{size}:{_png(pixels)}\a"


def sixels(pixels: Pixels) -> str:
    """A picture as sixels: six rows of pixels at a time, in a palette of 216 colours, dithered."""
    height, width = pixels.shape[:2]
    threshold = np.tile(_BAYER, (height // 4 + 1, width // 4 + 1))[:height, :width, None]
    level = np.minimum((pixels / 255.0 * (_LEVELS - 1) + threshold * 0.999).astype(int), _LEVELS - 1)
    color = level @ (_LEVELS**2, _LEVELS, 1)
    used = np.unique(color)
    out = [f'\x1bPq"1;1;{width};{height}']
    for k in used.tolist():
        channels = [round(100 * (k // _LEVELS**p % _LEVELS) / (_LEVELS - 1)) for p in (2, 1, 0)]
        out.append(f"#{k};2;{channels[0]};{channels[1]};{channels[2]}")
    for top in range(0, height, 6):
        band = color[top : top + 6]
        bits = 1 << np.arange(len(band))
        for k in np.unique(band).tolist():
            out.append(f"#{k}{_runs(63 + bits @ (band == k))}$")
        out.append("-")
    return "".join(out) + "\x1b\\"


def _runs(codes: np.ndarray) -> str:
    """Characters with runs of more than three abbreviated."""
    starts = np.flatnonzero(np.diff(codes, prepend=-1))
    lengths = np.diff(starts, append=len(codes))
    pairs = zip(codes[starts].tolist(), lengths.tolist(), strict=True)
    return "".join(f"!{n}{chr(code)}" if n > 3 else chr(code) * n for code, n in pairs)


def _png(pixels: Pixels) -> str:
    """A picture as PNG in base 64: its rows without a filter, compressed."""
    height, width = pixels.shape[:2]
    rows = np.zeros((height, 1 + 3 * width), np.uint8)
    rows[:, 1:] = pixels.reshape(height, -1)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = (b"IHDR", header), (b"IDAT", zlib.compress(rows.tobytes(), 3)), (b"IEND", b"")
    data = b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in chunks
    )
    return base64.b64encode(b"\x89PNG\r\n\x1a\n" + data).decode("ascii")


def terminal_picture(stream: TextIO) -> TerminalPicture | None:
    """A picture in the terminal that a stream writes to; None: it is no terminal, or shows none."""
    protocol = terminal_protocol(os.environ) if stream.isatty() else None
    return None if protocol is None else TerminalPicture(stream, protocol)
