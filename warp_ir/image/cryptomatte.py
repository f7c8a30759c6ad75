"""Cryptomatte: which objects and materials cover a pixel, and how much of it, as channels of an EXR file.

Friedman and Jones, "Fully automatic ID mattes with support for motion blur and transparency" (SIGGRAPH 2015 posters);
the specification 1.1 (github.com/Psyop/Cryptomatte) says how names become numbers and numbers become channels.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

KINDS = ("object", "material")
"""What a `Cryptomatte` can be of."""
RANKS = 6
"""Names per pixel that are stored: the specification's default, in three layers of two."""


@dataclass(frozen=True, eq=False)
class Cryptomatte:
    """The names that cover each pixel, in the order of their coverage."""

    kind: str
    """One of `KINDS`."""
    names: tuple[str, ...]
    """All names, each once."""
    index: npt.NDArray[np.int32]
    """[h, w, RANKS], indices into `names`; -1: no further name."""
    coverage: npt.NDArray[np.float32]
    """[h, w, RANKS], fraction of the pixel in [0, 1]."""

    def channels(self) -> Mapping[str, npt.NDArray[np.float32]]:
        """The channels of an EXR file, float32 [h, w]: in each layer name, coverage, next name, its coverage."""
        numbers = np.array([0.0, *(float_id(name) for name in self.names)], np.float32)[self.index + 1]
        out: dict[str, npt.NDArray[np.float32]] = {}
        for rank in range(0, RANKS, 2):
            layer = f"{self._type}{rank // 2:02}"
            planes = [
                numbers[..., rank],
                self.coverage[..., rank],
                numbers[..., rank + 1],
                self.coverage[..., rank + 1],
            ]
            out |= {f"{layer}.{channel}": plane for channel, plane in zip("RGBA", planes, strict=True)}
        return out

    def metadata(self) -> Mapping[str, str]:
        """Attributes of an EXR file, with the manifest that tells what the numbers stand for."""
        key = f"{murmur3(self._type.encode()):08x}"[:7]  # seven characters at most, the same in all files
        prefix = f"cryptomatte/{key}"
        manifest = {name: f"{float_bits(name):08x}" for name in self.names}
        return {
            f"{prefix}/name": self._type,
            f"{prefix}/hash": "MurmurHash3_32",
            f"{prefix}/conversion": "uint32_to_float32",
            f"{prefix}/manifest": json.dumps(manifest),
        }

    @property
    def _type(self) -> str:
        return f"crypto_{self.kind}"


def float_id(name: str) -> float:
    """The number that stands for a name in an image: its hash, taken for the bits of a float32."""
    return float(np.array(float_bits(name), np.uint32).view(np.float32))


def float_bits(name: str) -> int:
    """The hash of a name with an exponent from 1 to 254: neither infinite, NaN nor denormal as a float32."""
    bits = murmur3(name.encode())
    exponent = min(max(bits >> 23 & 0xFF, 1), 254)
    return bits & 0x807FFFFF | exponent << 23


def murmur3(data: bytes) -> int:
    """MurmurHash3_x86_32 with the seed 0 (Appleby 2011)."""
    h, whole = 0, len(data) // 4 * 4
    for start in range(0, len(data), 4):
        k = int.from_bytes(data[start : start + 4], "little")
        k = k * 0xCC9E2D51 & 0xFFFFFFFF
        k = (k << 15 | k >> 17) * 0x1B873593 & 0xFFFFFFFF
        h ^= k
        if start < whole:  # the last bytes, if there are fewer than four, are only mixed in
            h = ((h << 13 | h >> 19) * 5 + 0xE6546B64) & 0xFFFFFFFF
    h ^= len(data)
    h = (h ^ h >> 16) * 0x85EBCA6B & 0xFFFFFFFF
    h = (h ^ h >> 13) * 0xC2B2AE35 & 0xFFFFFFFF
    return h ^ h >> 16
