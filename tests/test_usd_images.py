"""Image assets: what is stored becomes linear light, from a folder or a package, whole or refused in one line."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import OpenImageIO as oiio
import pytest
from pxr import Sdf, Usd, UsdUtils

from tests import fuzz
from tests.stages import load, mesh, only_material, textured, warned, write_image
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
    """The colour of an EXR file with layers is read."""
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


WINDOWS = [
    ((4, 4, 4, 4), (0, 0, 8, 8)),  # a crop: a quarter of the picture
    ((-2, -3, 12, 14), (0, 0, 8, 8)),  # overscan on all sides
    ((2, -2, 12, 7), (-3, 1, 9, 8)),  # both, and an origin that is not 0
    ((20, 20, 4, 4), (0, 0, 8, 8)),  # nothing that is seen
]
"""Data and display windows: left, top, width, height."""


def _windowed(path, data, full, **layout):
    """A file whose data window holds random colours; returns what the display window shows."""
    x, y, width, height = data
    values = np.random.default_rng(1).random((height, width, 3)).astype(np.float16).astype(np.float32)
    spec = oiio.ImageSpec(width, height, 3, "float")
    spec.x, spec.y = x, y
    spec.full_x, spec.full_y, spec.full_width, spec.full_height = full
    for name, value in layout.items():
        setattr(spec, name, value)
    writer = oiio.ImageOutput.create(str(path))
    assert writer.open(str(path), spec), oiio.geterror()
    assert writer.write_image(values), writer.geterror()
    writer.close()
    shown = np.zeros((full[3], full[2], 3), np.float32)
    for row in range(height):
        for column in range(width):
            i, j = y + row - full[1], x + column - full[0]
            if 0 <= i < full[3] and 0 <= j < full[2]:
                shown[i, j] = values[row, column]
    return shown


@pytest.mark.parametrize("tile", [0, 16])
@pytest.mark.parametrize(("data", "full"), WINDOWS)
def test_texture_space_is_the_display_window(tmp_path, monkeypatch, data, full, tile):
    """OpenEXR's data window is where the pixels are, the display window the picture; without data it is black."""
    shown = _windowed(tmp_path / "a.exr", data, full, tile_width=tile, tile_height=tile)
    image = read_texture(str(tmp_path / "a.exr"))
    assert (image.width, image.height) == full[2:]
    np.testing.assert_array_equal(image.pixels, shown)
    monkeypatch.setattr("warp_ir.usd.images.asset._VALUES_PER_BAND", 30)
    np.testing.assert_array_equal(read_texture(str(tmp_path / "a.exr")).pixels, shown)
    small = read_texture(str(tmp_path / "a.exr"), max_pixels=9).pixels
    factor = -(-full[2] // small.shape[1])
    for i in range(small.shape[0]):
        for j in range(small.shape[1]):
            block = shown[factor * i :, factor * j :][:factor, :factor].mean(axis=(0, 1), dtype=np.float64)
            np.testing.assert_allclose(small[i, j], block, atol=1e-6)  # float32, one rounding per band


def test_a_tiff_of_a_larger_picture(tmp_path):
    """TIFF has an offset and the full size; without the latter an offset is a place on a page, and not in a texture."""
    shown = _windowed(tmp_path / "a.tif", (2, 3, 4, 4), (0, 0, 8, 9))
    np.testing.assert_array_equal(read_texture(str(tmp_path / "a.tif")).pixels, shown)
    _windowed(tmp_path / "b.tif", (2, 3, 4, 4), (0, 0, 4, 4))  # a full size equal to the image's is not written
    shown = _windowed(tmp_path / "c.tif", (0, 0, 4, 4), (0, 0, 4, 4))
    np.testing.assert_array_equal(read_texture(str(tmp_path / "b.tif")).pixels, shown)


def test_alpha_outside_the_data_window(tmp_path):
    """Where there is no data, a file with alpha is transparent, and one without is opaque."""
    for channels, expected in ((3, 1.0), (4, 0.0)):
        spec = oiio.ImageSpec(1, 1, channels, "half")
        spec.x, spec.full_width = 1, 2
        writer = oiio.ImageOutput.create(str(tmp_path / "a.exr"))
        assert writer.open(str(tmp_path / "a.exr"), spec) and writer.write_image(np.ones((1, 1, channels), np.float32))
        writer.close()
        assert read_texture(str(tmp_path / "a.exr")).alpha.tolist() == [[expected, 1.0]]


def test_a_window_that_claims_too_much(tmp_path):
    """A display window is limited as an image is."""
    spec = oiio.ImageSpec(1, 1, 3, "half")
    spec.full_width = spec.full_height = 1_000_000
    writer = oiio.ImageOutput.create(str(tmp_path / "a.exr"))
    assert writer.open(str(tmp_path / "a.exr"), spec) and writer.write_image(np.ones((1, 1, 3), np.float32))
    writer.close()
    with pytest.raises(Unreadable, match="claims 1000000 x 1000000 pixels"):
        read_texture(str(tmp_path / "a.exr"))


@pytest.mark.parametrize("light", ["DomeLight", "RectLight"])
@pytest.mark.parametrize(("data", "full"), WINDOWS[:3])
def test_windows_of_textures_on_lights(tmp_path, light, data, full):
    """An overscanned sky is no brighter than the same sky without overscan."""
    shown = _windowed(tmp_path / "a.exr", data, full)
    scene = load(tmp_path, f'def {light} "L" {{\n asset inputs:texture:file = @a.exr@\n}}\n' + mesh("", material="/B"))
    (lamp,) = scene.lights
    np.testing.assert_array_equal(lamp.texture, shown)


def test_windows_of_textures_on_surfaces(tmp_path):
    """The mean albedo of a picture whose data fill a quarter of it is a quarter of theirs."""
    shown = _windowed(tmp_path / "a.exr", *WINDOWS[0])
    material = only_material(load(tmp_path, textured(file="a.exr") + mesh()))
    np.testing.assert_allclose(material.albedo, shown.mean(axis=(0, 1)), rtol=2.0**-11)


@pytest.mark.parametrize("names", [("R", "G", "B"), ("Y",)])
def test_the_part_with_colour_counts(tmp_path, names):
    """The part of a multi-part EXR with R, G and B is read, else the one with luminance, in whatever place."""
    parts = [("Z",), ("N.X", "N.Y", "N.Z"), names, ("albedo.R", "albedo.G", "albedo.B")]
    specs = []
    for k, channels in enumerate(parts):
        spec = oiio.ImageSpec(2, 3, len(channels), "float")
        spec.channelnames = channels
        spec.attribute("oiio:subimagename", f"part{k}")
        specs.append(spec)
    path = str(tmp_path / "a.exr")
    writer = oiio.ImageOutput.create(path)
    assert writer.open(path, tuple(specs)), oiio.geterror()
    for k, spec in enumerate(specs):
        assert k == 0 or writer.open(path, spec, "AppendSubimage")
        assert writer.write_image(np.full((3, 2, len(parts[k])), float(k), np.float32))
    writer.close()
    image = read_texture(path)
    assert image.pixels.shape == (3, 2, len(names)) and (image.pixels == 2.0).all()


def test_damage_that_no_text_can_quote(tmp_path):
    """An error message that quotes bytes which are no UTF-8 is a warning, and the texture's fallback is used."""
    write_image(tmp_path / "a.exr", np.ones((4, 4, 3), np.float32), "half")
    content = (tmp_path / "a.exr").read_bytes()
    fallback = "float4 inputs:fallback = (0.25, 0.5, 0.75, 1)"
    for good, bad in ((b"chlist", b"\xff\xfelist"), (b"dataWindow\0box", b"dataWindow\0\xffox")):
        assert content.count(good) == 1
        (tmp_path / "a.exr").write_bytes(content.replace(good, bad))
        with pytest.raises(Unreadable, match="cannot be read") as error:
            read_texture(str(tmp_path / "a.exr"))
        assert str(error.value).isprintable()
        scene = load(tmp_path, textured(fallback, file="a.exr") + mesh())
        assert warned(scene, "a.exr", "cannot be read", "fallback")
        np.testing.assert_allclose(only_material(scene).albedo, (0.25, 0.5, 0.75))


@pytest.mark.extended
def test_mutated_images_are_read_or_refused(tmp_path):
    """500 files with bytes flipped, moved and cut: an image, or one line; nothing else."""
    sources = []
    pixels = np.random.default_rng(1).random((16, 24, 3), np.float32)
    for compression in ("none", "rle", "zip", "piz", "pxr24", "b44", "dwaa"):
        sources.append(write_image(tmp_path / f"{compression}.exr", pixels, "half", compression=compression))
    sources += [write_image(tmp_path / f"a.{name}", pixels, "float") for name in ("exr", "tif", "hdr")]
    sources += [write_image(tmp_path / f"b.{name}", np.uint8(255 * pixels)) for name in ("png", "tif", "jpg", "tga")]
    for tile, name in ((0, "w.exr"), (16, "t.exr"), (0, "w.tif")):
        _windowed(tmp_path / name, (1, 2, 20, 21), (0, 0, 30, 30), tile_width=tile, tile_height=tile)
        sources.append(str(tmp_path / name))
    contents = [(path, Path(path).read_bytes()) for path in sources]
    read = 0
    for seed in range(500):
        path, content = contents[seed % len(contents)]
        mutant = tmp_path / f"mutant{path[path.rindex('.') :]}"
        mutant.write_bytes(fuzz.damage(content, np.random.default_rng(seed)))
        try:
            image = read_texture(str(mutant))
            assert np.isfinite(image.pixels).all()
            read += 1
        except Unreadable as error:
            assert str(error).isprintable(), f"seed {seed}"
    assert 50 < read < 450  # mutations that never, or always, stop the reader test little
