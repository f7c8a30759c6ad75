"""Low-discrepancy samples as a pure function of (index, dimension, scramble).

The points are Sobol's (direction numbers of Joe and Kuo 2008, in their order) with Owen scrambling, computed by a hash
of the bit-reversed digits (Laine and Karras 2011; Burley 2020; constants of Vegdahl 2021). Every prefix of 2^k points
is exactly stratified in each dimension; estimates of different scrambles are independent. The sampler is stateless:
equal arguments give equal numbers on any thread of any machine.
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
"""Dimensions of one Sobol' sequence; higher dimensions use the same sequence in a shuffled order (padding)."""

_TIME_DIMENSION = wp.constant(4)  # after the pixel's two dimensions and the lens' two
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
_PIXEL_ORDER = wp.constant(wp.uint32(0xBB67AE85))  # the stream of `index_of_pixel`
_PIXEL_LEVELS = wp.constant(6)  # blocks of 64 x 64 pixels: points of larger indices take longer to compute


def sobol_matrices() -> npt.NDArray[np.uint32]:
    """Generator matrices, uint32 [SOBOL_DIMENSIONS * 32]: column k of dimension d is entry 32 d + k.

    The lowest bit is the first binary digit of the sample: bit-reversed, as Owen scrambling by hashing requires.
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
    """The scramble of one iteration of a render; different iterations and seeds have independent scrambles."""
    words = np.random.SeedSequence([seed, iteration]).generate_state(1, np.uint32)
    return int(words[0])


@cache
def _time_columns() -> tuple[int, ...]:
    """Columns of the time dimension's generator matrix, as Python integers."""
    return tuple(int(x) for x in sobol_matrices().reshape(-1, 32)[_TIME_DIMENSION])


def stratum(iteration: int, bits: int) -> int:
    """The stratum of the shutter interval, of 2^bits, that an iteration samples.

    Every aligned run of 2^bits iterations visits each stratum once. Time has a dimension of the sequence of its own, so
    that it does not correlate with the camera's samples.
    """
    x = 0
    for k, column in enumerate(_time_columns()):
        if iteration >> k & 1:
            x ^= column
    return sum((x >> k & 1) << (bits - 1 - k) for k in range(bits))


@wp.func
def hash_combine(a: wp.uint32, b: wp.uint32) -> wp.uint32:
    """A 32-bit hash of two words (the finalizer of Wellons' lowbias32)."""
    x = a ^ (b * _GOLDEN + _GOLDEN)
    x = (x ^ (x >> wp.uint32(16))) * _HASH_1
    x = (x ^ (x >> wp.uint32(15))) * _HASH_2
    return x ^ (x >> wp.uint32(16))


@wp.func
def _reverse_bits(x: wp.uint32) -> wp.uint32:
    """The 32 bits in reverse order."""
    y = ((x >> wp.uint32(1)) & _MASK_1) | ((x & _MASK_1) << wp.uint32(1))
    y = ((y >> wp.uint32(2)) & _MASK_2) | ((y & _MASK_2) << wp.uint32(2))
    y = ((y >> wp.uint32(4)) & _MASK_4) | ((y & _MASK_4) << wp.uint32(4))
    y = ((y >> wp.uint32(8)) & _MASK_8) | ((y & _MASK_8) << wp.uint32(8))
    return (y >> wp.uint32(16)) | (y << wp.uint32(16))


@wp.func
def stratum_at(matrices: wp.array[wp.uint32], iteration: int, bits: int) -> int:
    """`stratum` on the device."""
    i = wp.uint32(iteration)
    x = wp.uint32(0)
    column = 32 * _TIME_DIMENSION
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
    """Owen scrambling of a bit-reversed number: each bit is flipped depending on the bits below it."""
    y = x ^ (x * _OWEN_1)
    y = (y + seed) * ((seed >> wp.uint32(16)) | wp.uint32(1))
    y = y ^ (y * _OWEN_2)
    return y ^ (y * _OWEN_3)


@wp.func
def _permutation_seed(scramble: wp.uint32, stream: wp.uint32) -> wp.uint32:
    """The seed of one permutation (`stream`) of a scramble; seeds of different streams are independent.

    It takes two rounds of hashing: after one, the seeds of two streams correlate over the scrambles, and so would the
    coordinates of a point.
    """
    return hash_combine(hash_combine(scramble, stream), scramble)


@wp.func
def _spread(x: wp.uint32) -> wp.uint32:
    """The lowest sixteen bits of x, with a zero after each: one coordinate of a Morton code."""
    y = x & wp.uint32(0xFFFF)
    y = (y | (y << wp.uint32(8))) & _MASK_8
    y = (y | (y << wp.uint32(4))) & _MASK_4
    y = (y | (y << wp.uint32(2))) & _MASK_2
    return (y | (y << wp.uint32(1))) & _MASK_1


@wp.func
def index_of_pixel(column: int, row: int, scramble: wp.uint32) -> int:
    """The index of the point of the sequence that a pixel of the image uses: its place on a shuffled Z-order curve.

    Aligned squares of 2^k x 2^k pixels use aligned runs of 4^k points, which are stratified, so noise is blue. Every
    square visits its quadrants in an order of its own, one of 24, chosen by a hash (Ahmed and Wonka 2020,
    "Screen-space blue-noise diffusion of Monte Carlo sampling error via hierarchical ordering of pixels"): along the
    plain Z-order curve all squares are alike, and noise is a weave. Blocks of 64 x 64 pixels use the same points.
    """
    code = _spread(wp.uint32(column)) | (_spread(wp.uint32(row)) << wp.uint32(1))
    seed = _permutation_seed(scramble, _PIXEL_ORDER)
    index = wp.uint32(0)
    for level in range(_PIXEL_LEVELS):
        shift = wp.uint32(2 * level)
        bits = hash_combine(seed + wp.uint32(level), code >> (shift + wp.uint32(2)))
        # The permutations of four are the affine maps of two binary digits: two different columns of three, an offset.
        column_1 = (bits >> wp.uint32(16)) % wp.uint32(3)
        column_2 = (column_1 + wp.uint32(1) + ((bits >> wp.uint32(2)) & wp.uint32(1))) % wp.uint32(3)
        quadrant = bits & wp.uint32(3)
        if ((code >> shift) & wp.uint32(1)) != wp.uint32(0):
            quadrant = quadrant ^ (column_1 + wp.uint32(1))
        if ((code >> shift) & wp.uint32(2)) != wp.uint32(0):
            quadrant = quadrant ^ (column_2 + wp.uint32(1))
        index = index | (quadrant << shift)
    return int(index)


@wp.func
def to_unit(bits: wp.uint32) -> float:
    """Maps 32 random bits to [0, 1), using the upper 24."""
    return float(bits >> wp.uint32(8)) * 5.9604644775390625e-08  # 2⁻²⁴


@wp.func(inline=False)  # a kernel draws a dozen samples: inlined, each would be compiled
def sample_1d(matrices: wp.array[wp.uint32], index: int, dimension: int, scramble: wp.uint32) -> float:
    """Coordinate `dimension` of point `index` of the sequence with this scramble, in [0, 1)."""
    i = wp.uint32(index)
    d = dimension
    if dimension >= _DIMENSIONS:
        # Padding: the same dimensions, in an order shuffled by a nested permutation of its own (Burley 2020).
        d = dimension % _DIMENSIONS
        shuffle = _permutation_seed(scramble, ~wp.uint32(dimension // _DIMENSIONS))
        i = _reverse_bits(_permute_reversed(_reverse_bits(i), shuffle))
    x = wp.uint32(0)
    column = 32 * d
    while i != wp.uint32(0):
        # Branchless: the bits are unpredictable.
        x = x ^ (matrices[column] & (wp.uint32(0) - (i & wp.uint32(1))))
        i = i >> wp.uint32(1)
        column += 1
    x = _reverse_bits(_permute_reversed(x, _permutation_seed(scramble, wp.uint32(dimension))))
    return to_unit(x)


@wp.func
def sample_2d(matrices: wp.array[wp.uint32], index: int, dimension: int, scramble: wp.uint32) -> wp.vec2:
    """Coordinates `dimension` and `dimension` + 1 of a point, in [0, 1)²."""
    return wp.vec2(sample_1d(matrices, index, dimension, scramble), sample_1d(matrices, index, dimension + 1, scramble))
