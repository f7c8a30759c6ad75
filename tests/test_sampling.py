"""The sequence is Sobol's, its scrambling keeps what makes it good, and the warps have the densities they claim."""

import numpy as np
import pytest
import warp as wp
from scipy import stats
from scipy.stats import qmc

from warp_ir.sampling import sobol
from warp_ir.sampling.square_to import square_to_cone, square_to_cosine_hemisphere, square_to_disk

pytestmark = pytest.mark.extended

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _draw(first: int, m: wp.array[wp.uint32], dimension: int, scramble: wp.uint32, out: wp.array[wp.float32]):
    i = first + wp.tid()
    out[i] = sobol.sample_1d(m, i, dimension, scramble)


@wp.kernel
def _draw_first(first: int, m: wp.array[wp.uint32], dimension: int, out: wp.array[wp.float32]):
    i = first + wp.tid()
    out[i] = sobol.sample_1d(m, 0, dimension, sobol.hash_combine(wp.uint32(7), wp.uint32(i)))


@wp.kernel
def _warp(first: int, m: wp.array[wp.uint32], n: wp.vec3, cone: float, out: wp.array2d[wp.vec3]):
    i = first + wp.tid()
    u = sobol.sample_2d(m, i, 0, wp.uint32(7))
    d = square_to_disk(u)
    out[0, i] = wp.vec3(d[0], d[1], 0.0)
    out[1, i] = square_to_cosine_hemisphere(u, n)
    out[2, i] = square_to_cone(u, cone, n)


@pytest.fixture(scope="module")
def draw(launcher):
    matrices = launcher.array(sobol.sobol_matrices(), wp.uint32)

    def draw(count, dimension, scramble):
        out = launcher.empty(count, wp.float32)
        launcher.launch(_draw, count, [matrices, dimension, wp.uint32(scramble), out])
        return out.numpy()

    return draw


def test_matrices_are_sobols():
    """Unscrambled, the first 256 points are SciPy's (which visits each block of 2^k in Gray-code order)."""
    columns = sobol.sobol_matrices().reshape(sobol.SOBOL_DIMENSIONS, 32)
    bits = (np.arange(256)[:, None] >> np.arange(32)) & 1
    words = np.bitwise_xor.reduce(np.where(bits[:, None, :] == 1, columns[None], 0), axis=2)
    points = np.array([[int(f"{w:032b}"[::-1], 2) for w in row] for row in words]) / 2.0**32
    theirs = qmc.Sobol(sobol.SOBOL_DIMENSIONS, scramble=False).random(256)
    assert {tuple(p) for p in points} == {tuple(p) for p in theirs}


@pytest.mark.parametrize("dimension", [0, 1, 5, 15, 16, 40])
@pytest.mark.parametrize("scramble", [0, 1, 0xDEADBEEF])
def test_every_prefix_is_stratified(draw, dimension, scramble):
    """Of the first 2^k points exactly one lies in each of 2^k equal intervals, in every dimension and scramble."""
    u = draw(1024, dimension, scramble)
    assert u.min() >= 0.0 and u.max() < 1.0
    for k in (3, 6, 10):
        assert sorted((u[: 2**k] * 2**k).astype(int)) == list(range(2**k))


@pytest.mark.parametrize("scramble", [3, 99])
def test_first_two_dimensions_are_a_net(draw, scramble):
    """(0,2)-sequence: one of 64 points in each elementary interval 2^-a x 2^-(6-a), scrambled too."""
    u, v = draw(64, 0, scramble), draw(64, 1, scramble)
    for a in range(7):
        cells = (u * 2**a).astype(int) * 2 ** (6 - a) + (v * 2 ** (6 - a)).astype(int)
        assert sorted(cells) == list(range(64))


@pytest.mark.parametrize("dimensions", [(0, 1, 2), (0, 4, 8), (3, 9, 15), (0, 16, 32), (5, 6, 22)])
def test_coordinates_are_independent(launcher, dimensions):
    """Over the scrambles, three coordinates of a point fill the cube evenly: χ² of 16³ cells, 2²⁰ points.

    A path tracer that starts every pixel at point 0 lives on this alone.
    """
    matrices = launcher.array(sobol.sobol_matrices(), wp.uint32)
    cell = np.zeros(1 << 20, int)
    for dimension in dimensions:
        out = launcher.empty(len(cell), wp.float32)
        launcher.launch(_draw_first, len(cell), [matrices, dimension, out])
        cell = 16 * cell + (out.numpy() * 16).astype(int)
    assert stats.chisquare(np.bincount(cell, minlength=16**3)).pvalue > 1e-4


def test_scrambles_are_independent(draw):
    """Means of one point each under 4096 scrambles are uniform, and two dimensions or indices uncorrelated."""
    u = np.array([draw(2, 0, s) for s in range(2048)])
    v = np.array([draw(2, 1, s)[0] for s in range(2048)])
    assert stats.kstest(u[:, 0], "uniform").pvalue > 1e-4
    # Correlation of independent samples: 0 ± 1/√2048; points 0 and 1 lie in opposite halves: 1/12 - 1/8 of 1/12.
    assert abs(np.corrcoef(u[:, 0], v)[0, 1]) < 5 / np.sqrt(2048)
    assert np.corrcoef(u[:, 0], u[:, 1])[0, 1] == pytest.approx(-0.75, abs=0.1)


def test_same_arguments_same_number(draw):
    """No hidden state: drawing again, or fewer, gives the same bits."""
    np.testing.assert_array_equal(draw(100, 3, 5), draw(200, 3, 5)[:100])


@pytest.mark.parametrize("normal", [(0, 0, 1), (0, 0, -1), (0.6, 0.0, -0.8), (1, 0, 0)])
def test_warps(launcher, normal):
    """Disk, cosine hemisphere and cone: lengths, moments, and a chi-square against uniform cells.

    Means of n = 4096 low-discrepancy points: a quarter of the spread of random ones, 1/(4√n), times five.
    """
    n, cone = 4096, 0.3
    axis = np.array(normal, np.float64)
    out = launcher.empty((3, n), wp.vec3)
    matrices = launcher.array(sobol.sobol_matrices(), wp.uint32)
    launcher.launch(_warp, n, [matrices, wp.vec3(*normal), cone, out])
    disk, cosine, cap = out.numpy().astype(np.float64)
    slack = 5 / (4 * np.sqrt(n))

    assert np.linalg.norm(disk, axis=1).max() <= 1.0 + 1e-6
    assert abs(disk.mean(axis=0)).max() < slack
    np.testing.assert_allclose(np.linalg.norm(cosine, axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(cap, axis=1), 1.0, atol=1e-6)

    z = cosine @ axis
    assert z.min() >= -1e-6
    np.testing.assert_allclose([z.mean(), (z**2).mean()], [2 / 3, 1 / 2], atol=slack)  # ∫ cosᵏθ cosθ/π dω
    h = 1.0 - cap @ axis
    assert h.max() <= cone + 1e-6
    np.testing.assert_allclose([h.mean(), (h**2).mean()], [cone / 2, cone**2 / 3], atol=slack)

    # sin²θ of the hemisphere, r² of the disk and 1 - cosθ of the cone are uniform, and so are the angles about it.
    for value in (1.0 - z**2, (disk**2).sum(axis=1), h / cone):
        counts = np.histogram(value, bins=16, range=(0, 1 + 1e-6))[0]
        assert stats.chisquare(counts).pvalue > 1e-3


@wp.kernel
def _index_pixels(first: int, columns: int, scramble: wp.uint32, out: wp.array[wp.int32]):
    i = first + wp.tid()
    out[i] = sobol.index_of_pixel(i % columns, i // columns, scramble)


@pytest.fixture(scope="module")
def index_pixels(launcher):
    def index_pixels(size, scramble):
        out = launcher.empty(size * size, wp.int32)
        launcher.launch(_index_pixels, size * size, [size, wp.uint32(scramble), out])
        return out.numpy().reshape(size, size)

    return index_pixels


@pytest.mark.parametrize("scramble", [0, 1, 0xDEADBEEF])
def test_squares_of_pixels_use_aligned_runs_of_points(index_pixels, scramble):
    """The 4^k pixels of every aligned square use one aligned run of 4^k points: so squares are stratified."""
    size = 256
    index = index_pixels(size, scramble)
    for k in range(1, 7):
        side = 1 << k
        squares = index.reshape(size // side, side, size // side, side).swapaxes(1, 2).reshape(-1, 4**k)
        squares.sort(axis=1)
        np.testing.assert_array_equal(squares, (squares[:, :1] // 4**k) * 4**k + np.arange(4**k))


def test_squares_of_pixels_are_visited_in_different_orders(index_pixels):
    """2 x 2 pixels come in all 24 orders, independent of those of neighbours and of other scrambles: χ² of pairs."""
    index = np.array([index_pixels(256, scramble) for scramble in (5, 6)]) % 4
    squares = index.reshape(2, 128, 2, 128, 2).swapaxes(2, 3).reshape(2, 128, 128, 4)
    codes = squares @ [64, 16, 4, 1]
    order = np.unique(codes, return_inverse=True)[1].reshape(codes.shape)
    pairs = (
        (order[0, :, :-1], order[0, :, 1:]),
        (order[0, :-1], order[0, 1:]),
        (order[0, :-1, :-1], order[0, 1:, 1:]),
        (order[0], order[1]),
    )
    for one, other in pairs:
        counts = np.bincount((24 * one + other).reshape(-1), minlength=24 * 24)
        assert len(counts) == 24 * 24
        assert stats.chisquare(counts).pvalue > 1e-4
