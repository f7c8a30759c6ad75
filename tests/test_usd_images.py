"""Image assets: what is stored becomes linear light, from a folder or a package, whole or refused in one line."""

from types import SimpleNamespace

import numpy as np
import OpenImageIO as oiio
import pytest
from pxr import Sdf, Usd, UsdUtils

from tests.stages import write_image
from warp_ir.usd.images.asset import read_texture, srgb_to_linear
from warp_ir.usd.values.report import Unreadable

GRADIENT = np.arange(2 * 3 * 4).reshape(2, 3, 4) * 10


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("space", ["auto", "raw", "sRGB"])
def test_eight_bits(tmp_path, channels, space):
    """Automatic is sRGB for three and four channels; alpha is never decoded."""
    stored = GRADIENT[..., :channels].astype(np.uint8)
    image = read_texture(write_image(tmp_path / "a.png", stored), space)
    expected = stored / 255.0
    colors = channels if channels in (1, 3) else channels - 1
    if space == "sRGB" or (space == "auto" and channels > 2):
        expected[..., :colors] = srgb_to_linear(expected[..., :colors])
    np.testing.assert_allclose(image.pixels, expected, atol=1e-7)
    rgb = expected[..., :3] if channels > 2 else np.repeat(expected[..., :1], 3, axis=2)
    np.testing.assert_allclose(image.rgb, rgb, atol=1e-7)
    alpha = expected[..., -1] if channels in (2, 4) else np.ones((2, 3))
    np.testing.assert_allclose(image.alpha, alpha, atol=1e-7)


@pytest.mark.parametrize(
    ("name", "kind", "top"),
    [("a.png", oiio.UINT16, 65535), ("a.exr", oiio.HALF, 1), ("a.exr", oiio.FLOAT, 1), ("a.tif", oiio.FLOAT, 1)],
)
def test_more_than_eight_bits_are_linear(tmp_path, name, kind, top):
    """Half, float and 16-bit images hold light unless they are said to be sRGB. Half keeps 11 bits."""
    values = GRADIENT[..., :3] / 256.0
    stored = np.round(values * top).astype(np.uint16) if top > 1 else values.astype(np.float32)
    image = read_texture(write_image(tmp_path / name, stored, kind))
    np.testing.assert_allclose(image.pixels, values, atol=2e-5)
    decoded = read_texture(str(tmp_path / name), "sRGB")
    np.testing.assert_allclose(decoded.pixels, srgb_to_linear(values), atol=2e-5)


def test_radiance_files_keep_their_range(tmp_path):
    """A .hdr holds more than 1; its shared exponent leaves 8 bits."""
    values = np.array([[[100.0, 50.0, 25.0], [0.0, 0.0, 0.0]]], np.float32)
    image = read_texture(write_image(tmp_path / "a.hdr", values, oiio.FLOAT))
    np.testing.assert_allclose(image.pixels, values, rtol=2.0**-7)


def test_values_that_are_no_numbers(tmp_path):
    """NaN is black, infinity the largest half."""
    image = read_texture(write_image(tmp_path / "a.exr", np.float32([[[np.nan, np.inf, 1.0]]]), oiio.FLOAT))
    assert image.pixels[0, 0].tolist() == [0.0, 65504.0, 1.0]


def test_other_layers_are_left_alone(tmp_path):
    """Of an EXR with layers, the colour counts."""
    spec = oiio.ImageSpec(1, 1, 5, oiio.FLOAT)
    spec.channelnames = ("R", "G", "B", "A", "Z")
    path = str(tmp_path / "a.exr")
    writer = oiio.ImageOutput.create(path)
    writer.open(path, spec)
    writer.write_image(np.float32([[[1, 2, 3, 0.5, 99]]]))
    writer.close()
    assert read_texture(path).pixels[0, 0].tolist() == [1.0, 2.0, 3.0, 0.5]


@pytest.mark.parametrize("tile", [0, 16])
@pytest.mark.parametrize("limit", [1, 7, 1000, 33 * 50])
def test_large_images_are_averaged_down(tmp_path, monkeypatch, tile, limit):
    """No more pixels than allowed, each the mean of a square; tiled or not, in bands of any size."""
    monkeypatch.setattr("warp_ir.usd.images.asset._VALUES_PER_BAND", 100)
    values = np.random.default_rng(1).random((33, 50, 3), np.float32)
    path = str(tmp_path / "a.tif")
    spec = oiio.ImageSpec(50, 33, 3, oiio.FLOAT)
    spec.tile_width = spec.tile_height = tile
    writer = oiio.ImageOutput.create(path)
    writer.open(path, spec)
    writer.write_image(values)
    writer.close()
    image = read_texture(path, max_pixels=limit)
    height, width = image.pixels.shape[:2]
    assert height * width <= limit and (image.width, image.height) == (50, 33)
    factor = -(-50 // width)
    for y in range(height):
        for x in range(width):
            square = values[y * factor : (y + 1) * factor, x * factor : (x + 1) * factor]
            np.testing.assert_allclose(image.pixels[y, x], square.mean(axis=(0, 1)), atol=1e-6)


def test_wrap_modes_of_the_file(tmp_path):
    """What the file says of its edges is passed on."""
    path = write_image(tmp_path / "a.exr", np.ones((1, 1, 3), np.float32), oiio.FLOAT, wrapmodes="periodic,clamp")
    assert read_texture(path).wrap == ("repeat", "clamp")
    assert read_texture(write_image(tmp_path / "b.exr", np.ones((1, 1, 3), np.float32), oiio.FLOAT)).wrap == ("", "")


def test_inside_a_package(tmp_path):
    """An image in a .usdz is the same as beside a .usda."""
    path = write_image(tmp_path / "a.png", GRADIENT[..., :3].astype(np.uint8))
    stage = Usd.Stage.CreateNew(str(tmp_path / "s.usda"))
    prim = stage.DefinePrim("/P")
    prim.CreateAttribute("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath("./a.png"))
    stage.Save()
    assert UsdUtils.CreateNewUsdzPackage(str(tmp_path / "s.usda"), str(tmp_path / "s.usdz"))
    packed = Usd.Stage.Open(str(tmp_path / "s.usdz"))
    asset = packed.GetPrimAtPath("/P").GetAttribute("file").Get()
    assert asset.resolvedPath.endswith("s.usdz[a.png]")
    assert (read_texture(asset).pixels == read_texture(path).pixels).all()


def test_what_is_no_image_is_named(tmp_path):
    """Missing, empty, cut off, something else, a folder, or larger than anything real: one line with the name."""
    write_image(tmp_path / "good.png", np.random.default_rng(1).integers(0, 255, (64, 64, 3), np.uint8))
    content = (tmp_path / "good.png").read_bytes()
    (tmp_path / "cut.png").write_bytes(content[: len(content) // 2])
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "text.jpg").write_text("not an image")
    (tmp_path / "folder.png").mkdir()
    for name in ("missing.png", "cut.png", "empty.png", "text.jpg", "folder.png"):
        with pytest.raises(Unreadable, match=name) as error:
            read_texture(str(tmp_path / name))
        assert "\n" not in str(error.value)
    with pytest.raises(Unreadable, match=r"lost\.png' not found"):
        read_texture(SimpleNamespace(path="./lost.png", resolvedPath=""))
    header = bytearray(content)
    header[16:24] = (200_000).to_bytes(4, "big") * 2
    (tmp_path / "huge.png").write_bytes(header)
    with pytest.raises(Unreadable, match=r"huge\.png"):
        read_texture(str(tmp_path / "huge.png"))
