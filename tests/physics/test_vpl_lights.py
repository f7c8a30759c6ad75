"""VPLs written as UsdLux lights: direct light by them is what the VPLs give."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import warp_ir as ir
from warp_ir.usd.vpl_layers import write_lights

ROOT = Path(__file__).parent.parent.parent
SETTINGS = ir.RenderSettings(
    estimator="keller", width=24, height=24, light_paths=48, max_bounces=3, seed=2, iterations=1
)


@pytest.fixture(scope="module")
def lit_by_vpls(tmp_path_factory):
    """A room whose lights are replaced by its VPLs, through a file, and its picture by `keller` from these VPLs."""
    scene = ir.load_usd(ROOT / "scenes_usd" / "cornell_box.usda")
    vpls = ir.trace_vpls(scene, SETTINGS)
    path = tmp_path_factory.mktemp("lights") / "lights.usda"
    write_lights(path, scene, vpls, "Y", 0.01)
    lights = ir.load_usd(path, default_light="none").lights
    assert len(lights) == len(vpls.positions)
    return replace(scene, lights=lights), ir.render(scene, SETTINGS).radiance()


def assert_same_light(picture, expected):
    """Most pixels are as bright as in the other picture, within 2 %.

    `keller` has one ray in a pixel, where the other picture has its mean: beside a VPL the two differ, and the mean
    over the picture is that of a few such pixels. The median does not see them. Pixels at the border show the edge of
    the room, which one ray either hits or misses.
    """
    inner = slice(2, -2)
    ratio = picture[inner, inner].mean(axis=2) / expected[inner, inner].mean(axis=2)
    assert abs(np.median(ratio) - 1.0) < 0.02


@pytest.mark.extended
def test_direct_light_by_the_lights_is_that_of_the_vpls(lit_by_vpls):
    """Path tracing without bounces, lit by the file, has the picture of the VPLs."""
    scene, expected = lit_by_vpls
    film = ir.render(scene, replace(SETTINGS, estimator="path", max_bounces=0, iterations=1024, light_paths=None))
    assert_same_light(film.radiance(), expected)


@pytest.mark.slow
def test_mitsuba_sees_the_same(lit_by_vpls, monkeypatch):
    """Mitsuba, lit by the lights of the file, has that picture as well."""
    mitsuba = pytest.importorskip("mitsuba")
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    from make_references import to_mitsuba, use_mitsuba

    use_mitsuba("llvm_ad_rgb")
    scene, expected = lit_by_vpls
    translated = to_mitsuba(scene, SETTINGS.width, SETTINGS.height, 0)
    integrator = mitsuba.load_dict({"type": "path", "max_depth": 2, "hide_emitters": True})
    picture = np.array(mitsuba.render(translated, integrator=integrator, spp=4096))[..., :3]
    assert_same_light(picture, expected)
