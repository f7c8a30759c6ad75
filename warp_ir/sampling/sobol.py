"""Low-discrepancy samples as a pure function of (index, dimension, scramble).

Sobol' points (direction numbers of Joe and Kuo 2008, in their order) with Owen's nested uniform scrambling,
done by a hash of the bit-reversed digits (Laine and Karras 2011; Burley 2020; constants of Vegdahl 2021).
Every prefix of 2^k points is stratified in each dimension, exactly; two scrambles are independent
estimates. There is no state: the same arguments give the same number on any thread of any machine.
"""

from functools import cache

import numpy as np
import numpy.typing as npt
import warp as wp

wp.set_module_options({"enable_backward": False})

# Joe and Kuo 2008, new-joe-kuo-6: degree s and coefficients a of the primitive polynomial, initial numbers m.
_JOE_KUO = (
    (1, 0, (1,)),
    (2, 1, (1, 3)),
    (3, 1, (1, 3, 1)),
    (3, 2, (1, 1, 1)),
    (4, 1, (1, 1, 3, 3)),
    (4, 4, (1, 3, 5, 13)),
    (5, 2, (1, 1, 5, 5, 17)),
    (5, 4, (1, 1, 5, 5, 5)),
    (5, 7, (1, 1, 7, 11, 19)),
    (5, 11, (1, 1, 5, 1, 1)),
    (5, 13, (1, 1, 1, 3, 11)),
    (5, 14, (1, 3, 5, 5, 31)),
    (6, 1, (1, 3, 3, 9, 7, 49)),
    (6, 13, (1, 1, 1, 15, 21, 21)),
    (6, 16, (1, 3, 1, 13, 27, 49)),
)
SOBOL_DIMENSIONS = len(_JOE_KUO) + 1
"""Dimensions that are one Sobol' sequence; beyond them, the sequence is shuffled and used again."""

_TIME = wp.constant(4)  # after the place in the pixel and that on the lens
_DIMENSIONS = wp.constant(SOBOL_DIMENSIONS)
_GOLDEN = wp.constant(wp.uint32(0x9E3779B9))
_HASH_1 = wp.constant(wp.uint32(0x7FEB352D))
_HASH_2 = wp.constant(wp.uint32(0x846CA68B))
_OWEN_1 = wp.constant(wp.uint32(0x3D20ADEA))
_OWEN_2 = wp.constant(wp.uint32(0x05526C56))
_OWEN_3 = wp.constant(wp.uint32(0x53A22864))
_MASK_1 = wp.constant(wp.uint32(0x55555555))
_MASK_2 = wp.constant(wp.uint32(0x33333333))
_MASK_4 = wp.constant(wp.uint32(0x0F0F0F0F))
_MASK_8 = wp.constant(wp.uint32(0x00FF00FF))


def sobol_matrices() -> npt.NDArray[np.uint32]:
    """Generator matrices, uint32 [SOBOL_DIMENSIONS * 32]: column k of dimension d is entry 32 d + k.

    The lowest bit is the first binary digit of the sample (bit-reversed), which is what the scrambling wants.
    """
    columns = np.zeros((SOBOL_DIMENSIONS, 32), dtype=np.uint32)
    columns[0] = 1 << np.arange(32, dtype=np.uint64)
    for d, (s, a, m) in enumerate(_JOE_KUO, start=1):
        v = [m[k] << (31 - k) for k in range(s)]
        for k in range(s, 32):
            x = v[k - s] ^ (v[k - s] >> s)
            for j in range(1, s):
                x ^= ((a >> (s - 1 - j)) & 1) * v[k - j]
            v.append(x)
        columns[d] = [int(f"{x:032b}"[::-1], 2) for x in v]
    return columns.reshape(-1)


def iteration_scramble(seed: int, iteration: int) -> int:
    """The scramble of one iteration of a render: iterations and seeds are independent of each other."""
    words = np.random.SeedSequence([seed, iteration]).generate_state(1, np.uint32)
    return int(words[0])


@cache
def _time_columns() -> tuple[int, ...]:
    return tuple(int(x) for x in sobol_matrices().reshape(-1, 32)[_TIME])


def stratum(iteration: int, bits: int) -> int:
    """Which of 2^bits parts of the time an iteration is for: 2^bits that begin at a multiple of that take all in turn.

    It has a dimension of its own beside those of the camera: what is sampled together must not go hand in hand.
    """
    x = 0
    for k, column in enumerate(_time_columns()):
        if iteration >> k & 1:
            x ^= column
    return sum((x >> k & 1) << (bits - 1 - k) for k in range(bits))


@wp.func
def hash_combine(a: wp.uint32, b: wp.uint32) -> wp.uint32:
    """A new 32-bit scramble from two (the finalizer of Wellons' lowbias32)."""
    x = a ^ (b * _GOLDEN + _GOLDEN)
    x = (x ^ (x >> wp.uint32(16))) * _HASH_1
    x = (x ^ (x >> wp.uint32(15))) * _HASH_2
    return x ^ (x >> wp.uint32(16))


@wp.func
def _reverse_bits(x: wp.uint32) -> wp.uint32:
    y = ((x >> wp.uint32(1)) & _MASK_1) | ((x & _MASK_1) << wp.uint32(1))
    y = ((y >> wp.uint32(2)) & _MASK_2) | ((y & _MASK_2) << wp.uint32(2))
    y = ((y >> wp.uint32(4)) & _MASK_4) | ((y & _MASK_4) << wp.uint32(4))
    y = ((y >> wp.uint32(8)) & _MASK_8) | ((y & _MASK_8) << wp.uint32(8))
    return (y >> wp.uint32(16)) | (y << wp.uint32(16))


@wp.func
def stratum_at(matrices: wp.array[wp.uint32], iteration: int, bits: int) -> int:
    """The same as `stratum`."""
    i = wp.uint32(iteration)
    x = wp.uint32(0)
    column = 32 * _TIME
    while i != wp.uint32(0):
        if (i & wp.uint32(1)) != wp.uint32(0):
            x = x ^ matrices[column]
        i = i >> wp.uint32(1)
        column += 1
    if bits == 0:
        return 0
    return int(_reverse_bits(x) >> wp.uint32(32 - bits))


@wp.func
def _permute_reversed(x: wp.uint32, seed: wp.uint32) -> wp.uint32:
    """Owen's scrambling of a bit-reversed number: each bit is flipped depending on the bits below it."""
    y = x ^ (x * _OWEN_1)
    y = (y + seed) * ((seed >> wp.uint32(16)) | wp.uint32(1))
    y = y ^ (y * _OWEN_2)
    return y ^ (y * _OWEN_3)


@wp.func
def _seed(scramble: wp.uint32, stream: wp.uint32) -> wp.uint32:
    """Independent seeds of the permutations of one scramble.

    Two rounds: after one, seeds of two streams still hang together over the scrambles, and so would the
    coordinates of a point.
    """
    return hash_combine(hash_combine(scramble, stream), scramble)


@wp.func
def to_unit(bits: wp.uint32) -> float:
    """Random bits as a number in [0, 1)."""
    return float(bits >> wp.uint32(8)) * 5.9604644775390625e-08  # 2⁻²⁴


@wp.func(inline=False)  # kernels ask for a dozen
def sample_1d(matrices: wp.array[wp.uint32], index: int, dimension: int, scramble: wp.uint32) -> float:
    """Coordinate `dimension` of point `index` of the sequence `scramble`, in [0, 1)."""
    i = wp.uint32(index)
    d = dimension
    if dimension >= _DIMENSIONS:
        # Padding: the same dimensions in an order shuffled by another nested permutation (Burley 2020).
        d = dimension % _DIMENSIONS
        shuffle = _seed(scramble, ~wp.uint32(dimension // _DIMENSIONS))
        i = _reverse_bits(_permute_reversed(_reverse_bits(i), shuffle))
    x = wp.uint32(0)
    column = 32 * d
    while i != wp.uint32(0):
        # No branch on bits that nobody can predict.
        x = x ^ (matrices[column] & (wp.uint32(0) - (i & wp.uint32(1))))
        i = i >> wp.uint32(1)
        column += 1
    x = _reverse_bits(_permute_reversed(x, _seed(scramble, wp.uint32(dimension))))
    return to_unit(x)


@wp.func
def sample_2d(matrices: wp.array[wp.uint32], index: int, dimension: int, scramble: wp.uint32) -> wp.vec2:
    """Coordinates `dimension` and `dimension` + 1 of a point, in [0, 1)²."""
    return wp.vec2(sample_1d(matrices, index, dimension, scramble), sample_1d(matrices, index, dimension + 1, scramble))
