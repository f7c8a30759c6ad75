"""Pictures of VPL clouds, without a display."""

from types import SimpleNamespace

import numpy as np
import pytest

from warp_ir import Camera, InputError, Projection, Scene
from warp_ir.image.io import read_image
from warp_ir.preview import dot_colors, picture_vpls
from warp_ir.procedural import cornell_box


def cloud(positions, intensity, directional=None, bounce=None):
    """VPLs as `trace_vpls` would give them."""
    n = len(positions)
    return SimpleNamespace(
        positions=np.asarray(positions, dtype=float).reshape(n, 3),
        normals=np.zeros((n, 3)),
        intensity=np.asarray(intensity, dtype=float).reshape(n, 3),
        bounce=np.zeros(n, dtype=int) if bounce is None else np.asarray(bounce),
        directional=np.zeros(n, dtype=bool) if directional is None else np.asarray(directional),
    )


def test_colors_show_hue_and_decades():
    """The strongest VPL is bright in its hue; a hundredth of it is darker, and no power still visible."""
    bright, dim, dark = dot_colors(np.array([[2.0, 0.0, 0.0], [0.02, 0.0, 0.0], [2e-9, 0.0, 0.0]]))
    assert bright.tolist() == [255, 0, 0]
    assert bright[0] > dim[0] > dark[0] > 50


def test_colors_of_nothing():
    """An empty cloud and a black one have colours too."""
    assert dot_colors(np.zeros((0, 3))).shape == (0, 3)
    assert dot_colors(np.zeros((2, 3))).tolist() == [[0, 0, 0], [0, 0, 0]]


@pytest.mark.extended
@pytest.mark.parametrize("projection", list(Projection))
def test_vpl_is_where_the_camera_sees_it(tmp_path, projection):
    """A green VPL at 3/4 of the width and 1/4 of the height is green pixels there, off-centre window and all."""
    window = (-1.0, 3.0, -3.0, 1.0)
    scene = Scene(camera=Camera(window=window, projection=projection))
    path = picture_vpls(scene, cloud([[2, 0, -1]], [[0, 1, 0]]), tmp_path / "a.png", view="camera", width=80)
    pixels = read_image(path)[..., :3]
    green = np.argwhere(pixels[..., 1] > 0.9)
    assert pixels.shape == (80, 80, 3) and len(green)
    # Rasterised to whole pixels: the centre is off by at most one.
    np.testing.assert_allclose(green.mean(axis=0), [19.5, 59.5], atol=1.0)


@pytest.mark.extended
@pytest.mark.parametrize("view", ["outside", "camera"])
def test_one_sees_into_a_room(tmp_path, view):
    """VPLs inside the closed Cornell box are seen from outside as from its camera."""
    scene = cornell_box()
    vpls = cloud([[278, 273, 280], [100, 10, 100]], [[0, 1, 0], [0, 1, 0]], bounce=[0, 7])
    pixels = read_image(picture_vpls(scene, vpls, tmp_path / "a.png", view=view, width=320))
    assert ((pixels[..., 1] > 0.9) & (pixels[..., 0] < 0.2)).any()


@pytest.mark.extended
def test_empty_scene_and_directional_vpls(tmp_path):
    """Nothing at all is a picture, and so is light that comes from nowhere in particular."""
    picture_vpls(Scene(), cloud(np.zeros((0, 3)), np.zeros((0, 3))), tmp_path / "a.png", width=32)
    sky = cloud([[0, 1, 0]], [[1, 1, 1]], directional=[True])
    picture_vpls(Scene(), sky, tmp_path / "b.png", width=32)
    assert (tmp_path / "a.png").is_file() and (tmp_path / "b.png").is_file()


def test_bad_requests_are_named(tmp_path):
    """Another extension or view is refused before anything is drawn."""
    nothing = cloud(np.zeros((0, 3)), np.zeros((0, 3)))
    with pytest.raises(InputError, match="unknown extension"):
        picture_vpls(Scene(), nothing, tmp_path / "a.gif")
    with pytest.raises(InputError, match="view: must be outside or camera"):
        picture_vpls(Scene(), nothing, tmp_path / "a.png", view="inside")
