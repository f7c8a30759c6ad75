"""Validates the tables of a crate file (.usdc) on which USD's reader relies without a look.

A damaged byte in a count costs gigabytes, and the seconds to touch them, before USD refuses the file; one in the tree
of paths lets USD visit its nodes again and again, from several threads at once, until the process ends.
"""

import mmap
import struct
import zlib
from collections.abc import Iterator

import numpy as np

from warp_ir.scene import InputError

_MAGIC = b"PXR-USDC"
_LOCAL = struct.Struct("<4s5H3L2H")
"""Header of each file in a ZIP archive."""
_TABLES = {"TOKENS": 0, "STRINGS": 0, "FIELDS": 2, "FIELDSETS": 1, "PATHS": 3, "SPECS": 3}
"""Tables that begin with a count, with the number of compressed blocks that follow it."""
_FIRST_COMPRESSED = b"\0\4"
"""The version of crate files from which on tables are compressed: 0.4."""
_MAX_VALUES_PER_BYTE = 2048
"""Maximum number of values per compressed byte: LZ4 packs 255 bytes into one, integer coding 4 values into each."""


MAX_DEPTH = 10_000
"""How deeply prims may be nested: USD, whose reader calls itself, ends the process at some tens of thousands."""


def is_crate(path: str) -> bool:
    """Whether a file is a crate file."""
    with open(path, "rb") as file:
        return file.read(8) == _MAGIC


def validate_crate(path: str) -> None:
    """Check the tables of a crate file, or of those in a .usdz package; other files are left to USD.

    Raises:
        InputError: A table is larger than its data can be, the paths are no tree or too deep a tree, or the checksum
            of a package does not fit its data.
    """
    for name, data in _crate_files(path):
        try:
            bad = _damaged_table(data)
        except struct.error:  # truncated: USD detects that at once
            bad = ""
        if bad:
            raise InputError(f"{path}: cannot be opened as USD: {name}the table {bad} is damaged")


def _crate_files(path: str) -> Iterator[tuple[str, memoryview]]:
    """The crate files in a file, each with a prefix for messages; those of a package in order."""
    with open(path, "rb") as file:
        if not file.read(1):
            return  # an empty file cannot be mapped
        data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    if bytes(data[:8]) == _MAGIC:
        yield "", data
    offset = 0
    while bytes(data[offset : offset + 4]) == b"PK\3\4" and offset + _LOCAL.size <= len(data):
        *_, checksum, size, _, name_length, extra_length = _LOCAL.unpack_from(data, offset)
        name = bytes(data[offset + _LOCAL.size :][:name_length]).decode("ascii", "replace")
        offset += _LOCAL.size + name_length + extra_length
        if bytes(data[offset : offset + 8]) == _MAGIC:
            file_data = data[offset : offset + size]
            # USD itself does not look, and ends the process, or never ends, on some damaged bytes.
            if checksum and zlib.crc32(file_data) != checksum:
                raise InputError(f"{path}: cannot be opened as USD: {name} is damaged, its checksum is wrong")
            yield f"{name}: ", file_data
        offset += size


def _damaged_table(data: memoryview) -> str:
    """Name of the first table with an impossible size, or of paths that are no tree; "" if there is none."""
    (directory,) = struct.unpack_from("<q", data, 16)
    if not 0 < directory < len(data):
        return ""
    (count,) = struct.unpack_from("<Q", data, directory)
    if directory + 8 + 32 * count > len(data):
        return "of contents"
    if bytes(data[8:10]) < _FIRST_COMPRESSED:
        return ""
    for number in range(count):
        title, start, size = struct.unpack_from("<16sqq", data, directory + 8 + 32 * number)
        name: str = title.rstrip(b"\0").decode("ascii", "replace")
        if name not in _TABLES:
            continue
        table = data[max(start, 0) : start + size]
        if start < 0 or size < 0 or start + size > len(data) or not _fits(name, table):
            return name
        if name == "PATHS" and not _is_tree(table):
            return name
    return ""


def _fits(name: str, table: memoryview) -> bool:
    """Whether the sizes in a table's header fit its data."""
    limit = _MAX_VALUES_PER_BYTE * len(table)
    (count,) = struct.unpack_from("<Q", table, 0)
    if count > limit:
        return False
    offset = 8
    if name == "TOKENS":
        plain, packed = struct.unpack_from("<QQ", table, offset)
        return bool(plain <= limit and packed <= len(table))
    if name == "PATHS":
        (encoded,) = struct.unpack_from("<Q", table, offset)
        if encoded > limit:
            return False
        offset += 8
    for _ in range(_TABLES[name]):
        (packed,) = struct.unpack_from("<Q", table, offset)
        offset += 8 + packed
        if offset > len(table):
            return False
    return True


def _is_tree(table: memoryview) -> bool:
    """Whether the compressed nodes of a table PATHS are one tree, which is not too deep.

    Node i has a jump: -2 without child and sibling, -1 for a child i + 1 alone, 0 for a sibling i + 1 alone, and j > 0
    for a child i + 1 and a sibling i + j. The nodes are a tree if each but the first is reached exactly once.
    """
    (count,) = struct.unpack_from("<Q", table, 8)
    offset = 16
    for _ in range(2):  # the indices of the paths and of their tokens, which USD checks
        (packed,) = struct.unpack_from("<Q", table, offset)
        offset += 8 + packed
    (packed,) = struct.unpack_from("<Q", table, offset)
    jumps = _integers(table[offset + 8 : offset + 8 + packed], count)
    if jumps is None or (jumps < -2).any():
        return False
    nodes = np.arange(count)
    reached = np.concatenate([nodes[jumps >= -1] + 1, nodes[jumps > 0] + jumps[jumps > 0]])
    return bool(np.array_equal(np.sort(reached), nodes[1:])) and _depth(jumps) <= MAX_DEPTH


def _depth(jumps: np.ndarray) -> int:
    """How deep a tree is whose nodes have these jumps; at most: `MAX_DEPTH` or less if it has so few parents."""
    parents = int(np.count_nonzero((jumps == -1) | (jumps > 0)))
    if parents <= MAX_DEPTH:
        return parents
    depth = deepest = 0
    siblings: dict[int, int] = {}  # node -> its depth
    for node, jump in enumerate(jumps.tolist()):
        depth = siblings.pop(node, depth)
        if jump > 0:
            siblings[node + jump] = depth
        if jump == -1 or jump > 0:
            depth += 1
            deepest = max(deepest, depth)
    return deepest


def _integers(packed: memoryview, count: int) -> np.ndarray | None:
    """Integers [count] of a compressed array; None if its data are damaged.

    The data are LZ4 in chunks. Uncompressed they are the most common difference of neighbours, a code of two bits for
    each difference (that one, or 8, 16 or 32 bits of its own), and the bits (`pxr/usd/sdf/integerCoding.h`).
    """
    if count == 0:
        return np.empty(0, np.int64)
    size = 4 + (2 * count + 7) // 8 + 4 * count
    try:
        data = np.frombuffer(_uncompress(packed, size), np.uint8)
        codes = (data[4 : 4 + (2 * count + 7) // 8, None] >> np.array([0, 2, 4, 6]) & 3).ravel()[:count]
        widths = np.array([0, 1, 2, 4])[codes]
        starts = np.cumsum(widths) - widths + 4 + (2 * count + 7) // 8
        differences = np.full(count, data[:4].view("<i4")[0], np.int64)
        for code, kind in ((1, "<i1"), (2, "<i2"), (3, "<i4")):
            found = np.flatnonzero(codes == code)
            width = np.dtype(kind).itemsize
            differences[found] = data[starts[found, None] + np.arange(width)].view(kind)[:, 0]
    except (struct.error, IndexError, ValueError):
        return None
    return np.cumsum(differences).astype(np.int32)  # wraps around as the coder does


def _uncompress(packed: memoryview, size: int) -> bytes:
    """About `size` bytes that USD compressed: one block, or as many with their sizes as the first byte says."""
    if packed[0] == 0:
        return bytes(_lz4(packed[1:], size))
    chunks, offset = bytearray(), 1
    for _ in range(packed[0]):
        (length,) = struct.unpack_from("<i", packed, offset)
        chunks += _lz4(packed[offset + 4 : offset + 4 + length], size)
        offset += 4 + length
    return bytes(chunks)


def _lz4(block: memoryview, size: int) -> bytearray:
    """The bytes of a block of LZ4; more than `size` are not read further.

    Each sequence is a token (two lengths), literals, and a match: two bytes say how far back its copy begins
    (`lz4_Block_format.md`). A table of paths is short enough for Python.

    Raises:
        IndexError: The block ends within a sequence.
        ValueError: A match begins before the data.
    """
    out, at = bytearray(), 0

    def length(nibble: int) -> int:
        nonlocal at
        total, more = nibble, nibble == 15
        while more:
            total += block[at]
            more = block[at] == 255
            at += 1
        return total

    while len(out) <= size:
        token = block[at]
        at += 1
        literals = length(token >> 4)
        out += block[at : at + literals]
        at += literals
        if at >= len(block):  # the last sequence has no match
            break
        back = block[at] | block[at + 1] << 8
        at += 2
        copied = 4 + length(token & 15)
        if not 0 < back <= len(out):
            raise ValueError("a match begins before the data")
        match = out[-back:][:copied]
        out += (match * (copied // len(match) + 1))[:copied]
    return out
