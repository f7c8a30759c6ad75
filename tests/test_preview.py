"""VPLs in their scene: pictures, pages, models and animations, without a display."""

import json
import re
import shutil
import subprocess
from types import SimpleNamespace

import numpy as np
import pytest

from warp_ir import Camera, InputError, Mesh, Projection, RenderSettings, Scene, trace_vpls
from warp_ir.image.io import read_image
from warp_ir.preview import animate_vpls, pick_vpls, picture_vpls, plotter, write_html, write_model
from warp_ir.preview.plot import dot_colors
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
        path=np.arange(n),
        parent=np.full(n, -1),
        contribution=None,
        pixel_position=None,
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
    # A triangle behind the camera makes the scene, and so the discs, larger than a pixel.
    behind = Mesh("behind", np.array([[-8, 0, 9], [8, 0, 9], [0, 8, 9.0]]), np.array([[0, 1, 2]]), np.zeros(1, int))
    scene = Scene((behind,), camera=Camera(window=window, projection=projection))
    vpl = cloud([[2, 0, -1]], [[0, 1, 0]])
    vpl.normals[:] = 0, 0, 1  # towards the camera
    path = picture_vpls(scene, vpl, tmp_path / "a.png", view="camera", width=80)
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


def test_choices_that_cannot_be_are_named():
    """A colouring that needs contributions is refused without them, and so is a choice by them."""
    nothing = cloud(np.zeros((0, 3)), np.zeros((0, 3)))
    with pytest.raises(InputError, match="color_by: must be one of"):
        plotter(Scene(), nothing, color_by="size", off_screen=True)
    with pytest.raises(InputError, match="no contribution"):
        plotter(Scene(), nothing, min_contribution=0.5, off_screen=True)


@pytest.mark.extended
class TestOfTheCornellBox:
    """Drawings, pages and animations of VPLs that were traced."""

    SCENE = cornell_box()

    @pytest.fixture(scope="class")
    @classmethod
    def vpls(cls):
        return trace_vpls(cls.SCENE, RenderSettings(width=64, light_paths=64, seed=1), contribution_to=(32, 48))

    def test_bounces_and_contributions_choose_vpls(self, vpls):
        """As many discs are drawn as there are VPLs after these bounces, or with at least this contribution."""
        first = plotter(self.SCENE, vpls, bounces=[1], color_by="bounce", off_screen=True)
        assert first.actors["vpls"].mapper.dataset.n_cells == np.count_nonzero(vpls.bounce == 1)
        contribution = vpls.contribution.mean(axis=1)
        strong = contribution >= 0.1 * contribution.max()
        chosen = plotter(self.SCENE, vpls, min_contribution=0.1, color_by="contribution", off_screen=True)
        assert sorted(chosen.actors["vpls"].mapper.dataset.cell_data["vpl"]) == np.flatnonzero(strong).tolist()
        for plot in (first, chosen):
            plot.close()

    def test_paths_and_shadow_rays_are_lines(self, vpls):
        """There is a line to every VPL on a surface, and one from the pixel to every VPL that lights it."""
        plot = plotter(self.SCENE, vpls, paths=True, color_by="flux", off_screen=True)
        assert plot.actors["paths"].mapper.dataset.n_cells == np.count_nonzero(vpls.parent >= 0) > 0
        lit = (vpls.contribution > 0.0).any(axis=1)
        rays = plot.actors["shadow rays"].mapper.dataset
        assert rays.n_cells == np.count_nonzero(lit) > 0
        np.testing.assert_allclose(rays.points[0], vpls.pixel_position, rtol=1e-5)
        plot.close()

    def test_a_click_on_a_disc_tells_its_numbers(self, vpls):
        """The text of a picked VPL names its index, its bounce and its contribution."""
        from warp_ir.preview.plot import describe

        lines = describe(vpls, 5).splitlines()
        assert lines[0].startswith(f"VPL 5, bounce {vpls.bounce[5]}, parent {vpls.parent[5]}")
        assert lines[-1].startswith("contribution ")

    def test_a_right_click_picks_the_disc_under_the_pointer(self, vpls):
        """Clicked where VPLs are, the window names a VPL that is there: that one, or one whose disc is before it."""
        plot = plotter(self.SCENE, vpls, off_screen=True)
        pick_vpls(plot, vpls)
        plot.show(auto_close=False)

        def place(k):
            """Column and row of a VPL in the window [pixels]."""
            plot.renderer.SetWorldPoint(*map(float, vpls.positions[k]), 1.0)
            plot.renderer.WorldToDisplay()
            return np.array(plot.renderer.GetDisplayPoint()[:2])

        on_surfaces = np.flatnonzero(vpls.parent >= 0)[:24]
        picked = {}
        for k in on_surfaces:
            column, row = np.round(place(k)).astype(int).tolist()
            plot.remove_actor("vpl text", render=False)
            plot.iren._mouse_right_button_press(column, row)
            plot.iren._mouse_right_button_release(column, row)
            if "vpl text" in plot.actors:
                text = "".join(plot.actors["vpl text"].GetText(corner) or "" for corner in range(8))
                picked[k] = int(re.match(r"VPL (\d+),", text)[1])
        away = {k: float(np.linalg.norm(place(j) - place(k))) for k, j in picked.items()}
        plot.close()
        assert len(picked) > len(on_surfaces) // 4  # discs face the room: some are seen from behind or are hidden
        assert sum(k == j for k, j in picked.items()) > len(picked) // 2
        assert max(away.values()) < 40.0

    def test_a_right_click_on_a_surface_asks_the_pixel_that_shows_it(self):
        """The shadow rays that are drawn begin where was clicked, to the size of a pixel, at VPLs that light it."""
        settings = RenderSettings(width=64, height=64, light_paths=64)
        vpls = trace_vpls(self.SCENE, settings)
        plot = plotter(self.SCENE, vpls, view="camera", width=256, off_screen=True)
        pick_vpls(plot, vpls, self.SCENE, settings)
        plot.show(auto_close=False)
        column, row = 100, 90  # of the window, from its lower left corner: the floor before the boxes, or a box
        plot.iren._mouse_right_button_press(column, row)
        plot.iren._mouse_right_button_release(column, row)
        text = "".join(plot.actors["vpl text"].GetText(corner) or "" for corner in range(8))
        rays = plot.actors["shadow rays"].mapper.dataset
        start = rays.points[0]
        plot.renderer.SetWorldPoint(*map(float, start), 1.0)
        plot.renderer.WorldToDisplay()
        seen = np.array(plot.renderer.GetDisplayPoint()[:2])
        plot.close()
        assert text == f"pixel {column // 4} {63 - row // 4}"
        assert rays.n_cells > 5 and np.abs(seen - (column, row)).max() <= 4.0

    def test_a_model_has_the_colours(self, vpls, tmp_path):
        """The .gltf is complete in itself, and its meshes have vertex colours."""
        plot = plotter(self.SCENE, vpls, off_screen=True)
        model = json.loads(write_model(plot, tmp_path / "a.gltf").read_text())
        plot.close()
        assert all(buffer["uri"].startswith("data:") for buffer in model["buffers"])
        colored = [p for mesh in model["meshes"] for p in mesh["primitives"] if "COLOR_0" in p["attributes"]]
        assert len(colored) >= 2

    @pytest.mark.parametrize("suffix", ["gif", "mp4"])
    def test_an_animation_has_a_frame_for_every_step(self, vpls, tmp_path, suffix):
        """Bounce by bounce: twelve frames for each, and as many at the end."""
        imageio = pytest.importorskip("imageio.v2", reason="needs the extra 'view'")
        path = animate_vpls(self.SCENE, vpls, tmp_path / f"a.{suffix}", order="bounce", width=64)
        with imageio.get_reader(path) as reader:
            shown = reader.count_frames() if suffix == "mp4" else len(reader)
        steps = len(np.unique(vpls.bounce))
        # A .gif stores equal frames once.
        assert shown == 12 * (steps + 1) if suffix == "mp4" else 1 < shown <= 12 * (steps + 1)

    def test_a_page_shows_the_scene_in_a_browser(self, vpls, tmp_path):
        """The page asks no network, and a browser draws the red wall and the discs."""
        pytest.importorskip("trame_pyvista", reason="needs the extra 'view'")
        plot = plotter(self.SCENE, vpls, off_screen=True)
        page = write_html(plot, tmp_path / "a.html")
        plot.close()
        text = page.read_text(encoding="utf-8")
        assert "<script src=" not in text and 'rel="stylesheet" href="http' not in text
        browser = shutil.which("chromium") or shutil.which("google-chrome")
        if browser is None:
            pytest.skip("needs Chromium")
        flags = "--headless --no-sandbox --disable-gpu --use-gl=swiftshader --enable-unsafe-swiftshader".split()
        size = ["--window-size=400,300", "--virtual-time-budget=20000"]
        shot = tmp_path / "a.png"
        command = [browser, *flags, *size, f"--user-data-dir={tmp_path / 'profile'}", f"--screenshot={shot}"]
        subprocess.run([*command, page.as_uri()], check=True, capture_output=True, timeout=120)
        pixels = read_image(shot)[..., :3]
        red = (pixels[..., 0] > 0.2) & (pixels[..., 0] > 2.0 * pixels[..., 1])
        assert red.mean() > 0.02
