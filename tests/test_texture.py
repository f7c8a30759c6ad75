"""Texture lookups against their definition, and the estimates that choose among glowing triangles."""

import numpy as np
import pytest
import warp as wp

from warp_ir.image.mipmap import mip_chain, resized, value_range
from warp_ir.scene import Texture, Wrap
from warp_ir.texture import TextureTable, lookup, mean_on_triangles, mip_level, upload_textures, uv_to_st

pytestmark = pytest.mark.extended

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _look(
    first: int,
    table: TextureTable,
    uvs: wp.array[wp.vec2],
    uv_per_area: float,
    footprint: float,
    out: wp.array[wp.vec3],
):
    i = first + wp.tid()
    row = table.rows[0]
    level = mip_level(table, row, uv_per_area, footprint)
    out[i] = lookup(table, row, uv_to_st(row, uvs[i]), level)


def look(launcher, texture, uvs, uv_per_area=1.0, footprint=0.0):
    """The texture at uvs [n, 2], [n, 3]."""
    table = upload_textures([texture], [texture.uv], launcher)
    out = launcher.zeros(len(uvs), wp.vec3)
    inputs = [table, launcher.array(np.float32(uvs), wp.vec2), uv_per_area, footprint, out]
    launcher.launch(_look, len(uvs), inputs)
    return out.numpy()


def pixel(texture, x, y):
    """The value at whole coordinates from the lower left, by the definition of the wrap modes."""
    height, width = texture.pixels.shape[:2]
    at = []
    for k, size, wrap in ((x, width, texture.wrap[0]), (y, height, texture.wrap[1])):
        if wrap == Wrap.BLACK and not 0 <= k < size:
            return np.array(texture.outside)
        if wrap == Wrap.REPEAT:
            k = k % size
        elif wrap == Wrap.MIRROR:
            k = k % (2 * size)
            k = k if k < size else 2 * size - 1 - k
        at.append(min(max(k, 0), size - 1))
    return np.broadcast_to(texture.pixels[height - 1 - at[1], at[0]], 3)


@pytest.mark.parametrize("wrap", [(a, b) for a in Wrap for b in (Wrap.REPEAT, Wrap.BLACK)])
@pytest.mark.parametrize("shape", [(5, 3, 3), (4, 4, 1), (1, 1, 3)])
def test_bilinear_lookup_is_its_definition(launcher, wrap, shape):
    """Between the four nearest pixels, in every wrap mode, near and far from the unit square; halves keep 11 bits."""
    rng = np.random.default_rng(3)
    texture = Texture("t", rng.random(shape), wrap, outside=(0.25, 0.5, 0.75))
    uvs = rng.uniform(-3.3, 3.7, (500, 2))
    found = look(launcher, texture, uvs)
    height, width = shape[:2]
    for (u, v), value in zip(uvs, found, strict=True):
        x, y = u * width - 0.5, v * height - 0.5
        i, j = int(np.floor(x)), int(np.floor(y))
        fx, fy = x - i, y - j
        expected = (1 - fy) * ((1 - fx) * pixel(texture, i, j) + fx * pixel(texture, i + 1, j))
        expected = expected + fy * ((1 - fx) * pixel(texture, i, j + 1) + fx * pixel(texture, i + 1, j + 1))
        np.testing.assert_allclose(value, expected, atol=2.0**-11 + 2e-5)


def test_the_origin_is_the_lower_left(launcher):
    """(0, 0) is the lower left of the image, whose top row is stored first; a transform moves it."""
    pixels = np.zeros((2, 2, 3))
    pixels[1, 0] = (1.0, 0.0, 0.0)
    texture = Texture("t", pixels, (Wrap.CLAMP, Wrap.CLAMP))
    assert look(launcher, texture, [(0.25, 0.25)])[0].tolist() == [1.0, 0.0, 0.0]
    moved = Texture("t", pixels, (Wrap.CLAMP,) * 2, transform=np.array([[0.0, -2.0, 0.25], [2.0, 0.0, 0.25]]))
    assert look(launcher, moved, [(0.0, 0.0)])[0].tolist() == [1.0, 0.0, 0.0]
    assert look(launcher, moved, [(0.25, -0.25)])[0].tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("value", [1e-9, 0.3, 1e9])
def test_any_unit_is_as_exact(launcher, value):
    """Texels are halves, but scaled: dim and bright images keep 11 bits alike."""
    texture = Texture("t", np.full((2, 2, 3), value))
    np.testing.assert_allclose(look(launcher, texture, [(0.3, 0.6)]), value, rtol=2.0**-11)


@pytest.mark.parametrize("shape", [(1, 1, 1), (5, 3, 3), (64, 64, 3), (37, 1, 1), (100, 7, 3)])
def test_every_level_has_the_mean_of_the_image(shape):
    """Halving keeps the mean, whatever the size; the last level is one pixel."""
    pixels = np.random.default_rng(1).random(shape).astype(np.float32)
    chain = mip_chain(pixels)
    assert chain[-1].shape == (1, 1, shape[2])
    for level in chain:
        np.testing.assert_allclose(level.mean(axis=(0, 1)), pixels.mean(axis=(0, 1)), rtol=1e-5)
    np.testing.assert_allclose(resized(pixels, *shape[:2]), pixels)


def test_far_away_is_the_mean(launcher):
    """A footprint as wide as n pixels gives the mean over about n: a checkerboard becomes grey, and not before."""
    checker = np.indices((64, 64)).sum(axis=0) % 2
    texture = Texture("t", checker[..., None].astype(np.float64))
    uvs = np.random.default_rng(1).random((200, 2))
    assert look(launcher, texture, uvs, footprint=0.99 / 64).std() > 0.1
    np.testing.assert_array_equal(look(launcher, texture, uvs, footprint=2.0 / 64), 0.5)
    np.testing.assert_array_equal(look(launcher, texture, uvs, uv_per_area=16.0, footprint=0.5 / 64), 0.5)
    np.testing.assert_array_equal(look(launcher, texture, uvs, footprint=1e30), 0.5)


def test_textures_are_halved_to_fit(launcher, monkeypatch):
    """Over the limit the largest are halved a side; what is looked up keeps its mean, and nothing fails."""
    monkeypatch.setattr("warp_ir.texture.MAX_BYTES", 2100)
    texture = Texture("t", np.random.default_rng(1).random((64, 64, 3)))
    small = Texture("s", np.ones((2, 2, 1)))
    table = upload_textures([texture, small], ["st"], launcher)
    assert table.levels.numpy()[0].tolist() == [16, 16, 0] and 2 * table.texels.shape[0] <= 2100
    assert np.allclose(look(launcher, texture, [(0.5, 0.5)], footprint=9.0), texture.pixels.mean((0, 1)), rtol=1e-3)


@pytest.mark.parametrize("wrap", list(Wrap))
@pytest.mark.parametrize("footprint", [0.0, 0.02])
def test_estimates_of_glow_never_miss(launcher, wrap, footprint):
    """Wherever a lookup on a triangle is not black, the triangle's estimate is not 0; on average it is the mean.

    A tenth of the estimate is of the triangle's surroundings, hence the tolerance of the average; where most of the
    large triangles lie in the black outside, it may be the larger part.
    """
    rng = np.random.default_rng(5)
    pixels = np.where(rng.random((40, 60, 3)) < 0.01, rng.random((40, 60, 3)), 0.0)
    texture = Texture("t", pixels, (wrap, wrap))
    centres = rng.uniform(-1.5, 2.5, (400, 1, 2))
    uvs = centres + rng.normal(size=(400, 3, 2)) * 10.0 ** rng.uniform(-3, 0.5, (400, 1, 1))
    edges = uvs[:, 1:] - uvs[:, :1]
    areas = 0.5 * np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    estimates = mean_on_triangles(texture, uvs, areas, footprint)
    weights = rng.dirichlet((1, 1, 1), (400, 256))
    points = np.einsum("tpc,tcx->tpx", weights, uvs)
    found = look(launcher, texture, points.reshape(-1, 2), 1.0, footprint).mean(axis=1).reshape(400, 256)
    assert (estimates[found.max(axis=1) > 0.0] > 0.0).all()
    assert estimates.sum() == pytest.approx(found.mean(axis=1).sum(), rel=2.0 if wrap == Wrap.BLACK else 0.2)


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_the_range_of_an_image(dtype):
    """It is that of NumPy, with and without negative values, and tells NaN and infinities."""
    pixels = np.random.default_rng(0).random((8, 8, 4)).astype(dtype)
    for image in (pixels, pixels - dtype(0.5), pixels[..., :3], np.zeros_like(pixels)):
        assert value_range(image) == (image.min(), image.max())
    for wrong in (np.nan, np.inf, -np.inf):
        pixels[3, 3, 3] = wrong
        assert not np.isfinite(value_range(pixels)).all()


def test_the_mean_of_a_large_image_is_exact():
    """Rows are added in single precision, blocks of them in double: 1e-6 of a mean of a million equal signs."""
    pixels = np.random.default_rng(0).random((1100, 1000, 3)).astype(np.float16)
    assert Texture("t", pixels).mean == pytest.approx(pixels.mean(axis=(0, 1), dtype=np.float64), rel=1e-6)
