"""Pictures on disk: what was written is what is read, whole or not at all."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction

import numpy as np
import OpenImageIO as oiio
import pytest
from pxr import Gf

from warp_ir import Camera, InputError, Projection, RenderSettings, Scene
from warp_ir.files import check_output, whole_file
from warp_ir.image.color_space import COLOR_SPACES, REC709, matrix
from warp_ir.image.exr import COMPRESSIONS, LOSSY, ExrOptions, frame_rate
from warp_ir.image.io import AOV_CHANNELS, SUFFIXES, read_image, write_image
from warp_ir.image.tonemap import srgb_from_linear
from warp_ir.procedural import cornell_box

HEIGHT, WIDTH = 5, 7


class FakeFilm:
    """A film of known values, without a renderer."""

    width, height = WIDTH, HEIGHT
    iterations, seconds, interrupted, rejected = 3, 0.5, False, 0
    settings = RenderSettings(width=WIDTH, height=HEIGHT)
    origin = None

    def __init__(self):
        rng = np.random.default_rng(3)
        self.values = {"radiance": rng.random((HEIGHT, WIDTH, 3)).astype(np.float32)}
        for name, channels in AOV_CHANNELS.items():
            shape = (HEIGHT, WIDTH, 3)[: 3 if len(channels) == 3 else 2]
            self.values[name] = rng.random(shape).astype(np.float32)
        self.values["alpha"][:] = 1.0
        self.values["prim_id"] = np.arange(-1, HEIGHT * WIDTH - 1, dtype=np.int32).reshape(HEIGHT, WIDTH) * 4099

    def radiance(self):
        return self.values["radiance"]

    def aov(self, name):
        return self.values[name]

    def error(self):
        return 0.25


@pytest.fixture
def film():
    return FakeFilm()


@pytest.mark.parametrize("name", ["a.npy", "a.pfm", "a.exr"])
def test_linear_formats_keep_every_bit(tmp_path, film, name):
    """float32 in, the same float32 out, row 0 at the top."""
    assert write_image(tmp_path / name, film, half=False) == [tmp_path / name]
    np.testing.assert_array_equal(read_image(tmp_path / name)[..., :3], film.radiance())


def test_half_and_rgbe_keep_their_digits(tmp_path, film):
    """Half floats round to 11 bits; Radiance's shared exponent to 8 bits of the largest channel."""
    write_image(tmp_path / "a.exr", film)
    np.testing.assert_allclose(read_image(tmp_path / "a.exr")[..., :3], film.radiance(), rtol=2**-11)
    write_image(tmp_path / "a.hdr", film)
    error = np.abs(read_image(tmp_path / "a.hdr") - film.radiance())
    # The mantissa of the largest channel m is at least 128: a unit of it is at most m / 128.
    assert (error <= film.radiance().max(axis=-1, keepdims=True) / 128.0).all()


def test_half_overflow_is_the_largest_half(tmp_path):
    """What 16 bits cannot hold becomes ±65504, never infinity; a warning counts the pixels."""
    picture = np.zeros((2, 3, 3), np.float32)
    picture[0, :2] = [65519.9, 1e30, -np.inf]
    with pytest.warns(UserWarning, match=r"a\.exr: 2 of 6 pixels exceed 65504"):
        write_image(tmp_path / "a.exr", picture)
    write_image(tmp_path / "b.exr", picture, half=False)  # without a warning, which would be an error here
    write_image(tmp_path / "b.exr", np.minimum(np.abs(picture), 65504.0))
    assert read_image(tmp_path / "a.exr")[0, 0].tolist() == [65504.0, 65504.0, -65504.0]


def test_exr_layers(tmp_path, film):
    """One file holds colour, alpha and all AOVs, and identifiers and distances keep their 32 bits."""
    path = tmp_path / "a.exr"
    assert write_image(path, film, aovs=tuple(AOV_CHANNELS)) == [path]
    assert read_image(path).shape == (HEIGHT, WIDTH, 4)
    for name, channels in AOV_CHANNELS.items():
        stored = read_image(path, layer=name)
        exact = name in ("position", "depth", "prim_id", "alpha")
        wanted = film.aov(name).reshape(HEIGHT, WIDTH, len(channels))
        np.testing.assert_allclose(stored, wanted, rtol=0.0 if exact else 2**-11, err_msg=name)


def test_exr_attributes(tmp_path, film):
    """Settings, statistics and what the caller adds are in the file; what is None is not."""
    import OpenImageIO as oiio

    write_image(tmp_path / "a.exr", film, metadata={"stage": "room.usda", "big": 2**40, "camera": None})
    file = oiio.ImageInput.open(str(tmp_path / "a.exr"))
    found = {a.name: a.value for a in file.spec().extra_attribs if a.name.startswith("warp_ir:")}
    file.close()
    assert found["warp_ir:width"] == WIDTH and found["warp_ir:iterations"] == 3
    assert found["warp_ir:estimated_error"] == 0.25 and found["warp_ir:stage"] == "room.usda"
    assert found["warp_ir:big"] == 2.0**40 and "warp_ir:camera" not in found


def test_tiff_has_sixteen_bits_and_alpha(tmp_path, film):
    """A .tif is the .png with 256 times finer steps."""
    write_image(tmp_path / "a.tif", film)
    write_image(tmp_path / "a.png", film)
    fine, coarse = read_image(tmp_path / "a.tif"), read_image(tmp_path / "a.png")
    assert fine.shape == coarse.shape
    np.testing.assert_allclose(fine, coarse, atol=0.51 / 255.0)
    assert (np.round(fine * 65535.0) % 257.0 != 0.0).any()  # 8 bits are multiples of 257 of them


@pytest.mark.parametrize("name", list(COLOR_SPACES))
def test_colour_spaces_are_usds(name):
    """The matrices are those of GfColorSpace, and white stays white."""
    ours, theirs = Gf.ColorSpace(name), Gf.ColorSpace(REC709)
    expected = [ours.Convert(theirs, Gf.Vec3f(*axis)).GetRGB() for axis in np.eye(3).tolist()]
    np.testing.assert_allclose(matrix(name).T, expected, atol=1e-6)
    np.testing.assert_allclose(matrix(name) @ np.ones(3), 1.0, atol=1e-6)


@pytest.mark.parametrize("suffix", [".exr", ".hdr", ".pfm", ".npy"])
def test_linear_pictures_in_another_colour_space(tmp_path, film, suffix):
    """The film's settings decide; colours are converted, in layers too, and other values are not."""
    film.settings = RenderSettings(width=WIDTH, height=HEIGHT, color_space="lin_ap1_scene")
    write_image(tmp_path / f"a{suffix}", film, half=False, aovs=("albedo", "normal") if suffix == ".exr" else ())
    known = np.array([[0.613097, 0.339523, 0.047379], [0.070194, 0.916354, 0.013452], [0.020616, 0.109570, 0.869815]])
    stored = read_image(tmp_path / f"a{suffix}")[..., :3]
    np.testing.assert_allclose(stored, film.radiance() @ known.T, atol=1e-5 if suffix != ".hdr" else 0.01)
    if suffix == ".exr":
        layers = [read_image(tmp_path / "a.exr", name) for name in ("albedo", "normal")]
        np.testing.assert_allclose(layers[0], film.aov("albedo") @ known.T, atol=1e-5)
        np.testing.assert_array_equal(layers[1], film.aov("normal"))
        spec = oiio.ImageInput.open(str(tmp_path / "a.exr")).spec()
        assert spec.getattribute("chromaticities") == pytest.approx(COLOR_SPACES["lin_ap1_scene"])


def test_screens_show_the_same_in_any_colour_space(tmp_path, film):
    """A .png is sRGB; the argument is stronger than the settings, and has to be a name."""
    for name in (REC709, "lin_ap1_scene"):
        write_image(tmp_path / f"{name}.png", film, color_space=name)
    one, other = (read_image(tmp_path / f"{name}.png") for name in (REC709, "lin_ap1_scene"))
    np.testing.assert_array_equal(one, other)
    with pytest.raises(InputError, match=r"color_space: must be one of lin_rec709_scene, .*, is 'crayon'"):
        write_image(tmp_path / "a.exr", film, color_space="crayon")


def test_other_formats_put_aovs_beside(tmp_path, film):
    """a.png and its AOVs are files of their own, and all are written."""
    written = write_image(tmp_path / "a.png", film, aovs=("depth", "normal"))
    assert [path.name for path in written] == ["a.png", "a.depth.png", "a.normal.png"]
    assert [read_image(path).shape[2] for path in written] == [4, 1, 3]


@pytest.mark.parametrize("aov", AOV_CHANNELS)
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".hdr", ".pfm", ".npy", ".exr"])
def test_every_aov_in_every_format(tmp_path, film, aov, suffix):
    """An AOV can be a picture of its own."""
    (path,) = write_image(tmp_path / f"a{suffix}", film, aov=aov)
    assert read_image(path).shape[:2] == (HEIGHT, WIDTH)


def test_png_is_srgb(tmp_path, film):
    """8-bit values are the sRGB encoding, rounded to the nearest."""
    write_image(tmp_path / "a.png", film.radiance(), exposure=-1.0)
    wanted = srgb_from_linear(film.radiance() / 2.0)
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), wanted, atol=0.5 / 255.0 + 1e-6)


def test_png_alpha_is_unassociated(tmp_path, film):
    """A pixel half covered by a surface of radiance 1 is white with alpha 1/2; uncovered ones are clear."""
    film.values["alpha"][0, 0], film.values["radiance"][0, 0] = 0.5, 0.5
    film.values["alpha"][0, 1], film.values["radiance"][0, 1] = 0.0, 0.0
    write_image(tmp_path / "a.png", film)
    pixels = read_image(tmp_path / "a.png")
    np.testing.assert_allclose(pixels[0, 0], [1.0, 1.0, 1.0, 0.5], atol=0.5 / 255.0 + 1e-6)
    assert pixels[0, 1].tolist() == [0.0, 0.0, 0.0, 0.0]


def test_grey_arrays_and_alpha_arrays(tmp_path):
    """[h, w] and [h, w, 4] are pictures, other shapes are not."""
    for shape in ((4, 3), (4, 3, 1), (4, 3, 4)):
        for suffix in (".png", ".exr", ".hdr"):
            write_image(tmp_path / f"a{suffix}", np.ones(shape, dtype=np.float32))
    with pytest.raises(InputError, match="no picture"):
        write_image(tmp_path / "a.png", np.ones((4, 3, 2), dtype=np.float32))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.bmp", "unknown extension '.bmp'"),
        ("a", "unknown extension ''"),
        ("missing/a.png", "there is no folder"),
        ("", "is a folder"),
        ("file/a.png", "cannot be written: not a directory"),
        ("n" * 300 + ".png", "cannot be written: file name too long"),
        ("a\0.png", "null character"),
    ],
)
def test_bad_paths_are_one_line(tmp_path, name, message):
    """Before anything is rendered, one line says what is wrong with the output."""
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=message) as caught:
        check_output(tmp_path / name, SUFFIXES)
    assert "\n" not in str(caught.value)
    assert sorted(os.listdir(tmp_path)) == ["file"]


def test_devices_and_folders_are_not_replaced(tmp_path):
    """A rename would happily replace a device or a pipe by a picture."""
    os.mkfifo(tmp_path / "a.png")
    with pytest.raises(InputError, match="not a regular file"):
        check_output(tmp_path / "a.png", SUFFIXES)


def test_folder_is_made_on_request(tmp_path, film):
    """`make_folder` creates what is missing."""
    path = tmp_path / "x" / "y" / "a.png"
    assert check_output(path, SUFFIXES, make_folder=True) == path
    write_image(path, film)
    assert os.listdir(path.parent) == ["a.png"]


def test_failure_leaves_the_old_file(tmp_path):
    """If writing fails half-way, the old picture is untouched and nothing else is left."""
    path = tmp_path / "a.npy"
    path.write_text("old")
    with pytest.raises(InputError, match=r"a\.npy: cannot be written: no space left"), whole_file(path) as temporary:
        temporary.write_text("half of the new")
        raise OSError(28, "No space left on device")
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["a.npy"]


def test_links_are_followed(tmp_path, film):
    """Writing to a symbolic link replaces what it points to."""
    (tmp_path / "there").mkdir()
    (tmp_path / "a.npy").symlink_to(tmp_path / "there" / "b.npy")
    write_image(tmp_path / "a.npy", film)
    assert (tmp_path / "a.npy").is_symlink() and (tmp_path / "there" / "b.npy").is_file()


@pytest.mark.parametrize("suffix", [".exr", ".hdr", ".pfm", ".npy", ".png"])
def test_full_disk(tmp_path, suffix):
    """When the system takes no more bytes, every format ends in an `InputError` and leaves no file."""
    code = f"""
import resource, numpy as np
from warp_ir import InputError, write_image
pixels = np.random.default_rng(1).random((200, 200, 3)).astype(np.float32)
resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))
try:
    write_image({str(tmp_path / "a")!r} + {suffix!r}, pixels)
except InputError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert "cannot be written" in done.stdout and done.stdout.count("\n") == 1, done
    assert os.listdir(tmp_path) == []


def test_read_errors_are_one_line(tmp_path):
    """A missing file, a file that is no picture, and a missing layer are named."""
    (tmp_path / "text.png").write_text("no picture")
    (tmp_path / "text.npy").write_text("no array")
    for name in ("missing.exr", "missing.npy", "text.png", "text.npy"):
        with pytest.raises(InputError, match=name) as caught:
            read_image(tmp_path / name)
        assert "\n" not in str(caught.value)
    write_image(tmp_path / "a.exr", np.ones((2, 2, 3), dtype=np.float32))
    with pytest.raises(InputError, match="has no layer 'depth'"):
        read_image(tmp_path / "a.exr", layer="depth")


def test_arrays_have_no_aovs(tmp_path, film):
    """AOVs of an array, and AOVs that nobody knows, are refused."""
    with pytest.raises(InputError, match="no AOVs"):
        write_image(tmp_path / "a.exr", np.ones((2, 2, 3)), aovs=("depth",))
    with pytest.raises(InputError, match="no AOV 'beauty'"):
        write_image(tmp_path / "a.exr", film, aovs=("beauty",))


def test_names_are_the_films():
    """The AOVs that can be written are those that a film has."""
    from warp_ir import Film

    assert set(AOV_CHANNELS) == set(Film.AOV_NAMES)


def test_matrices_of_the_camera(tmp_path, film):
    """Camera space has z forwards, NDC lead to (0, 0) in the upper left and (1, 1) in the lower right corner.

    For row vectors; both projections, and a picture whose window is wider than the camera's.
    """
    camera = Camera.look_at((1.0, 2.0, 3.0), (0.0, 1.0, -2.0), fov=40.0, aspect=1.0)
    settings = RenderSettings(width=WIDTH, height=HEIGHT)
    film.settings = settings
    for projection in Projection:
        film.origin = Scene(camera=replace(camera, projection=projection, clipping=(0.5, 1000.0)))
        write_image(tmp_path / "a.exr", film)
        spec = oiio.ImageInput.open(str(tmp_path / "a.exr")).spec()
        to_camera, to_ndc = (np.reshape(spec.getattribute(name), (4, 4)) for name in ("worldToCamera", "worldToNDC"))
        left, right, bottom, top = film.origin.camera.fit(WIDTH, HEIGHT).window
        for x, y, corner in ((left, top, (0, 0)), (right, bottom, (1, 1)), (left, bottom, (0, 1))):
            depth = 7.0
            scale = depth if projection == Projection.PERSPECTIVE else 1.0
            world = camera.world_from_camera @ [x * scale, y * scale, -depth, 1.0]
            np.testing.assert_allclose(world @ to_camera, [x * scale, y * scale, depth, 1.0], atol=1e-5)
            ndc = world @ to_ndc
            np.testing.assert_allclose((ndc / ndc[3])[:2], corner, atol=1e-5)
        near = camera.world_from_camera @ [0.0, 0.0, -0.5, 1.0]
        np.testing.assert_allclose((near @ to_ndc)[2], 0.0, atol=1e-5)


def test_names_of_prims_are_in_the_file(tmp_path, film):
    """With prim_id the file tells which numbers are which meshes; without it, it does not."""
    film.origin = cornell_box()
    names = [mesh.name for mesh in film.origin.meshes]
    for aovs, wanted in ((("prim_id",), names), ((), None)):
        write_image(tmp_path / "a.exr", film, aovs=aovs)
        found = oiio.ImageInput.open(str(tmp_path / "a.exr")).spec().getattribute("warp_ir:prim_names")
        assert (found and json.loads(found)) == wanted


@pytest.mark.parametrize(
    ("rate", "fraction"),
    [(24.0, (24, 1)), (23.976, (24000, 1001)), (29.97, (30000, 1001)), (59.94, (60000, 1001)), (12.5, (25, 2))],
)
def test_frame_rates_are_exact(tmp_path, film, rate, fraction):
    """The rates of NTSC are written as decimals, and mean 24000/1001, 30000/1001, ..."""
    options = ExrOptions(frames_per_second=rate, owner="Studio")
    write_image(tmp_path / "a.exr", film, exr=options)
    spec = oiio.ImageInput.open(str(tmp_path / "a.exr")).spec()
    assert frame_rate(rate) == Fraction(*fraction)
    assert tuple(spec.getattribute("framesPerSecond")) == fraction
    assert b"framesPerSecond\0rational\0" in (tmp_path / "a.exr").read_bytes()
    assert b"owner\0string\0\6\0\0\0Studio" in (tmp_path / "a.exr").read_bytes()


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("multipart", [False, True])
def test_compression_and_parts(tmp_path, film, compression, multipart):
    """The file has the compression and the parts that were asked for; what is no colour loses nothing."""
    path = tmp_path / "a.exr"
    options = ExrOptions(compression=compression, multipart=multipart)
    write_image(path, film, aovs=("depth", "position", "prim_id", "albedo"), exr=options)
    file = oiio.ImageInput.open(str(path))
    parts = []
    while file.seek_subimage(len(parts), 0):
        spec = file.spec()
        parts.append((spec.getattribute("oiio:subimagename"), spec.getattribute("compression")))
    file.geterror()
    lossless = "zip" if compression in LOSSY else compression
    many = [("rgba", compression), *((name, lossless) for name in ("depth", "position", "prim_id"))]
    assert parts == ([*many, ("albedo", compression)] if multipart else [(None, compression)])
    for name in ("depth", "position", "prim_id"):
        wanted = film.aov(name).reshape(HEIGHT, WIDTH, -1)
        np.testing.assert_array_equal(read_image(path, name), wanted)
    np.testing.assert_allclose(read_image(path)[..., :3], film.radiance(), atol=0.1 if compression in LOSSY else 1e-3)
    assert read_image(path).shape[2] == 4


def test_bad_options_are_one_line():
    """Unknown compressions and rates that are none."""
    with pytest.raises(InputError, match="compression: must be one of zip, zips"):
        ExrOptions(compression="lzw")
    with pytest.raises(InputError, match="frames_per_second: must be a positive number"):
        ExrOptions(frames_per_second=0.0)
