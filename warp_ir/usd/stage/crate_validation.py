"""Validates the table sizes in crate files (.usdc) before USD allocates them.

Otherwise a damaged byte in a count costs gigabytes, and the seconds to touch them, before USD refuses the file.
"""

import mmap
import struct
import zlib
from collections.abc import Iterator

from warp_ir.scene import InputError

_MAGIC = b"PXR-USDC"
_LOCAL = struct.Struct("<4s5H3L2H")
"""Header of each file in a ZIP archive."""
_TABLES = {"TOKENS": 0, "STRINGS": 0, "FIELDS": 2, "FIELDSETS": 1, "PATHS": 3, "SPECS": 3}
"""Tables that begin with a count, with the number of compressed blocks that follow it."""
_MAX_VALUES_PER_BYTE = 2048
"""Maximum number of values per compressed byte: LZ4 packs 255 bytes into one, integer coding 4 values into each."""


def validate_crate(path: str) -> None:
    """Check the table sizes of a crate file, or of those in a .usdz package; other files are left to USD.

    Raises:
        InputError: A table is larger than its data can be, or the checksum of a package does not fit its data.
    """
    for name, data in _crate_files(path):
        try:
            bad = _oversized_table(data)
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


def _oversized_table(data: memoryview) -> str:
    """Name of the first table with an impossible size; "" if there is none."""
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
