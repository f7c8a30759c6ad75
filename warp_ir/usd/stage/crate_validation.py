"""Sizes that a .usdc file states, checked against what it holds: USD allocates them first and reads then.

A damaged byte in a count would otherwise cost gigabytes, and the seconds to touch them, before the file is refused.
"""

import mmap
import struct
from collections.abc import Iterator

from warp_ir.scene import InputError

_MAGIC = b"PXR-USDC"
_LOCAL = struct.Struct("<4s5H3L2H")
"""What precedes each file in a ZIP archive."""
_TABLES = {"TOKENS": 0, "STRINGS": 0, "FIELDS": 2, "FIELDSETS": 1, "PATHS": 3, "SPECS": 3}
"""The tables with a count, and how many compressed blocks follow it."""
_PER_BYTE = 2048
"""Most numbers that a compressed byte can stand for: LZ4 packs 255 bytes into one, the integer coding 4 in each."""


def check_sizes(path: str) -> None:
    """Look at the tables of a .usdc file, or of those inside a .usdz; anything else is left to USD.

    Raises:
        InputError: A table is said to be larger than it can be.
    """
    for name, data in _crates(path):
        try:
            bad = _oversized(data)
        except struct.error:  # cut off: USD finds that at once
            bad = ""
        if bad:
            raise InputError(f"{path}: cannot be opened as USD: {name}the table {bad} is damaged")


def _crates(path: str) -> Iterator[tuple[str, memoryview]]:
    """The binary layers in a file, each with a prefix for messages; in a package as USD finds them, one by one."""
    with open(path, "rb") as file:
        if not file.read(1):
            return  # nothing to map
        data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    if bytes(data[:8]) == _MAGIC:
        yield "", data
    at = 0
    while bytes(data[at : at + 4]) == b"PK\3\4" and at + _LOCAL.size <= len(data):
        *_, size, _, name_length, extra_length = _LOCAL.unpack_from(data, at)
        name = bytes(data[at + _LOCAL.size :][:name_length]).decode("ascii", "replace")
        at += _LOCAL.size + name_length + extra_length
        if bytes(data[at : at + 8]) == _MAGIC:
            yield f"{name}: ", data[at : at + size]
        at += size


def _oversized(data: memoryview) -> str:
    """The name of the first table with an impossible size; empty if there is none."""
    (directory,) = struct.unpack_from("<q", data, 16)
    if not 0 < directory < len(data):
        return ""
    (count,) = struct.unpack_from("<Q", data, directory)
    if directory + 8 + 32 * count > len(data):
        return "of contents"
    for number in range(count):
        title, start, size = struct.unpack_from("<16sqq", data, directory + 8 + 32 * number)
        name: str = title.rstrip(b"\0").decode("ascii", "replace")
        if name not in _TABLES:
            continue
        if start < 0 or size < 0 or start + size > len(data) or not _fits(name, data[start : start + size]):
            return name
    return ""


def _fits(name: str, table: memoryview) -> bool:
    """Whether a table can hold what its own header says."""
    most = _PER_BYTE * len(table)
    (count,) = struct.unpack_from("<Q", table, 0)
    if count > most:
        return False
    at = 8
    if name == "TOKENS":
        plain, packed = struct.unpack_from("<QQ", table, at)
        return bool(plain <= most and packed <= len(table))
    if name == "PATHS":
        (encoded,) = struct.unpack_from("<Q", table, at)
        if encoded > most:
            return False
        at += 8
    for _ in range(_TABLES[name]):
        (packed,) = struct.unpack_from("<Q", table, at)
        at += 8 + packed
        if at > len(table):
            return False
    return True
