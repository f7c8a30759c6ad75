"""OpenColorIO: the configuration's names for what is known under others, and the views of its displays."""

import numpy as np
import OpenImageIO as oiio
import pytest

import warp_ir as ir
from tests.stages import load, mesh, only_material, textured, warned, write_image
from warp_ir.image import ocio
from warp_ir.image.color_space import from_rec709
from warp_ir.image.io import read_image
from warp_ir.image.tonemap import srgb_from_linear

CONFIG = "ocio://default"  # built into OpenColorIO
KNOWN = {"ACEScg": "lin_ap1_scene", "Linear P3-D65": "lin_p3d65_scene", "scene_linear": "lin_ap1_scene"}
"""Names, one of them a role, of spaces of the configuration that are known here as well."""
SRGB = ("sRGB - Display", "Un-tone-mapped")
COLORS = np.random.default_rng(1).random((4, 5, 3)).astype(np.float32)


@pytest.fixture(autouse=True)
def configured(monkeypatch):
    """$OCIO names the built-in configuration."""
    monkeypatch.setenv("OCIO", CONFIG)


@pytest.mark.parametrize("name", list(KNOWN))
def test_spaces_are_ours(name):
    """A space that is known by another name has the same values: the matrices are of 5 digits, in float32."""
    converted = ocio.to_color_space(COLORS, name)
    np.testing.assert_allclose(converted, from_rec709(COLORS, KNOWN[name]), atol=1e-5)
    np.testing.assert_allclose(ocio.active_config().to_rec709(converted, name), COLORS, atol=1e-5)


def test_view_without_tone_curve_is_srgb():
    """The view that only encodes is the sRGB curve, clipped at 1, and a stop doubles."""
    shown = ocio.display_values(COLORS, 0.0, SRGB)
    np.testing.assert_allclose(shown, srgb_from_linear(COLORS), atol=1e-4)
    np.testing.assert_allclose(ocio.display_values(COLORS, 1.0, SRGB), srgb_from_linear(2.0 * COLORS), atol=1e-4)
    bright = ocio.display_values(np.array([[1e38, -1.0, 0.5]]), 1000.0, SRGB)
    assert bright[0, 0] == 1.0 and ((bright >= 0.0) & (bright <= 1.0)).all()


@pytest.mark.parametrize("suffix", [".png", ".tif", ".jpg"])
def test_pictures_are_made_by_a_view(tmp_path, suffix):
    """The file has the view's values, not those of the tone curve, and says its colour space; alpha stays."""
    path = tmp_path / f"a{suffix}"
    picture = np.full((8, 8, 4), (0.4, 0.2, 0.1, 0.5), np.float32)
    view = ocio.check_view(None, None)  # the default has a tone curve
    ir.write_image(path, picture, view=view)
    unassociated = picture[..., :3] * (2.0 if suffix != ".jpg" else 1.0)
    expected = ocio.display_values(unassociated, 0.0, view)
    assert np.abs(expected - srgb_from_linear(unassociated)).max() > 0.05
    stored = read_image(path)
    np.testing.assert_allclose(stored[..., :3], expected, atol=0.51 / 255.0 if suffix != ".jpg" else 0.02)
    if suffix == ".png":
        np.testing.assert_allclose(stored[..., 3], 0.5, atol=0.51 / 255.0)
    ir.write_image(tmp_path / "grey.png", np.full((2, 2), 0.18), view=SRGB)
    assert read_image(tmp_path / "grey.png").shape == (2, 2, 3)


def test_linear_pictures_in_a_space_of_the_configuration(tmp_path):
    """The file has the values of that space, and the name that all programs know."""
    settings = ir.RenderSettings(color_space="ACEScg")
    ir.write_image(tmp_path / "a.exr", COLORS, half=False, color_space=settings.color_space)
    ir.write_image(tmp_path / "b.exr", COLORS, half=False, color_space="lin_ap1_scene")
    np.testing.assert_allclose(read_image(tmp_path / "a.exr"), read_image(tmp_path / "b.exr"), atol=1e-5)
    assert oiio.ImageInput.open(str(tmp_path / "a.exr")).spec().getattribute("colorInteropID") == "lin_ap1_scene"


@pytest.mark.parametrize("name", ["crayon", "sRGB - Display"])
def test_unknown_or_encoded_spaces_are_refused(tmp_path, name):
    """One line says what there is: the linear spaces, ours and those of the configuration."""
    with pytest.raises(ir.InputError, match=rf"color_space: must be one of lin_rec709.*, ACEScg, .*, is '{name}'$"):
        ir.RenderSettings(color_space=name)
    with pytest.raises(ir.InputError, match=rf"a\.exr: color_space: must be one of .*, is '{name}'$"):
        ir.write_image(tmp_path / "a.exr", COLORS, color_space=name)


def test_unknown_views_are_refused(monkeypatch):
    """One line says which displays and views there are, or that there is no configuration."""
    with pytest.raises(ir.InputError, match=r"--ocio-display: must be one of sRGB - Display, .*, is 'CRT'"):
        ocio.check_view("CRT", None)
    with pytest.raises(ir.InputError, match=r"--ocio-view: must be one of .*Un-tone-mapped, .*, is 'Film'"):
        ocio.check_view("sRGB - Display", "Film")
    monkeypatch.delenv("OCIO")
    with pytest.raises(ir.InputError, match="no configuration; \\$OCIO or --ocio-config names one"):
        ocio.check_view(None, None)
    with pytest.raises(ir.InputError, match=r"is 'ACEScg'; \$OCIO would add"):
        ir.RenderSettings(color_space="ACEScg")


def test_configurations_that_cannot_be_read(tmp_path, monkeypatch):
    """A missing file and one of another kind are one line, and only where they are needed."""
    (tmp_path / "bad.ocio").write_text("hello")
    for path, reason in ((tmp_path / "no.ocio", "non-existent"), (tmp_path / "bad.ocio", "Loading the OCIO profile")):
        monkeypatch.setenv("OCIO", str(path))
        ir.RenderSettings(color_space="lin_ap1_scene")
        with pytest.raises(ir.InputError, match=reason) as caught:
            ir.RenderSettings(color_space="ACEScg")
        assert "\n" not in str(caught.value)


def test_config_of_a_command_is_its_own(monkeypatch):
    """--ocio-config sets $OCIO while the command runs, and leaves it as it was."""
    monkeypatch.setenv("OCIO", "other")
    with ocio.use_config(CONFIG):
        assert ocio.active_config().path == CONFIG
    with pytest.raises(ir.InputError, match="other"):
        ocio.active_config()
    monkeypatch.delenv("OCIO")
    with ocio.use_config(CONFIG), ocio.use_config(None):
        assert ocio.active_config().path == CONFIG
    assert ocio.active_config() is None


@pytest.mark.parametrize(
    ("name", "known"),
    [
        ("Gamma 2.2 Encoded AP1", "g22_ap1_scene"),
        ("sRGB Encoded P3-D65", "srgb_p3d65_scene"),
        ("Linear Rec.2020", "lin_rec2020_scene"),
    ],
)
@pytest.mark.parametrize("file", ["t.png", "t.exr"])
def test_textures_in_spaces_of_the_configuration(tmp_path, name, known, file):
    """A texture's sourceColorSpace that USD does not know is the configuration's: a curve and a matrix.

    Textures are kept with 11 bits.
    """
    values = np.random.default_rng(2).random((4, 4, 3))
    write_image(tmp_path / file, np.uint8(values * 255.0) if file == "t.png" else values.astype(np.float32))
    pictures = []
    for space in (name, known):
        text = textured(f'token inputs:sourceColorSpace = "{space}"', file=file)
        scene = load(tmp_path, text + mesh())
        assert not warned(scene, "colour space")
        pictures.append(only_material(scene).albedo_texture.pixels)
    np.testing.assert_allclose(*pictures, atol=2.0**-10)


def test_textures_in_spaces_that_nobody_knows(tmp_path, monkeypatch):
    """A warning names both places; without a configuration, only the name. A broken configuration is named as well."""
    write_image(tmp_path / "t.png", np.full((2, 2, 3), 128, np.uint8))
    text = textured('token inputs:sourceColorSpace = "crayon"', file="t.png") + mesh()
    assert warned(load(tmp_path, text), "unknown colour space 'crayon', neither to USD nor to ocio://default")
    monkeypatch.setenv("OCIO", "/no/config.ocio")
    assert warned(load(tmp_path, text), "unknown colour space 'crayon' (OpenColorIO: ", "'auto' is used")


CONFIGURATION = """ocio_profile_version: 2
strictparsing: true
roles:
  default: raw
  scene_linear: linear
%s
displays:
  Screen:
    - !<View> {name: Plain, colorspace: linear}
colorspaces:
  - !<ColorSpace> {name: raw, isdata: true}
  - !<ColorSpace> {name: linear}
  - !<ColorSpace>
    name: mixed
    to_scene_reference: !<GroupTransform>
      children:
        - !<MatrixTransform> {matrix: [0.5, 0.3, 0.2, 0, 0.2, 0.7, 0.1, 0, 0, 0.1, 0.9, 0, 0, 0, 0, 1]}
        - !<ExponentTransform> {value: [2, 2, 2, 1]}
"""


def test_spaces_that_mix_before_the_curve_are_refused(tmp_path, monkeypatch):
    """A transform that is no curve for each channel and a matrix is not used in its place, but named."""
    (tmp_path / "c.ocio").write_text(CONFIGURATION % "  aces_interchange: linear")
    monkeypatch.setenv("OCIO", str(tmp_path / "c.ocio"))
    write_image(tmp_path / "t.png", np.full((2, 2, 3), 128, np.uint8))
    scene = load(tmp_path, textured('token inputs:sourceColorSpace = "mixed"', file="t.png") + mesh())
    assert warned(scene, "colour space 'mixed' of ", "c.ocio is no matrix and a curve", "'auto' is used")
    np.testing.assert_allclose(ocio.to_color_space(COLORS, "linear"), from_rec709(COLORS, "lin_ap0_scene"), atol=1e-6)


def test_configurations_need_a_common_space(tmp_path, monkeypatch):
    """Without a space that both sides know, no colour can be converted."""
    (tmp_path / "c.ocio").write_text(CONFIGURATION % "")
    monkeypatch.setenv("OCIO", str(tmp_path / "c.ocio"))
    with pytest.raises(ir.InputError, match="has no role aces_interchange"):
        ocio.active_config()
