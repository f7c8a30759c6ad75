"""The light on tubes, spheres, ribbons and patches, from a stage's text to the picture, against closed forms."""

import numpy as np
import pytest

import warp_ir as ir
from tests.physics.level import light, usd
from tests.stages import load

pytestmark = pytest.mark.extended

CAMERA = """
def Camera "C" {
    uniform token projection = "orthographic"
    float horizontalAperture = 40
    float verticalAperture = 40
    double3 xformOp:translate = (0, 0, 10)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
"""
"""Sees the square of side 4 around the origin along -Z."""
SUN = light(
    "DistantLight", "float inputs:intensity = 3.141592653589793\n float inputs:angle = 0\n bool inputs:normalize = 1"
)
"""Irradiance π on what faces +Z, so that a white surface there has radiance 1."""
COLOR = "color3f[] primvars:displayColor = [(0.5, 0.5, 0.5)]"
TUBE = f"""
def BasisCurves "P" {{
    uniform token type = "linear"
    point3f[] points = [(0, -3, 0), (0, 3, 0)]
    int[] curveVertexCounts = [2]
    float[] widths = [2] (interpolation = "constant")
    {COLOR}
"""
BALL = f"""
def Points "P" {{
    point3f[] points = [(0, 0, 0)]
    float[] widths = [2]
    {COLOR}
"""


def ribbon(normal):
    """The tube as a ribbon that faces a direction."""
    return f"{TUBE}    normal3f[] normals = {usd([normal])} (interpolation = 'constant')\n}}\n"


def total(folder, text):
    """Integral of the radiance over the film, in units of the scene."""
    settings = ir.RenderSettings(width=64, height=64, iterations=16, estimator="path", max_bounces=0, filter=False)
    film = ir.render(load(folder, text + CAMERA), settings)
    return float(film.radiance()[..., 0].astype(float).mean() * 16.0)


@pytest.mark.parametrize(
    "text, expected",
    [
        # Radiance 0.5 cosθ over the silhouette: ∫ sqrt(1 - x²) dx = π / 2, over a height of 4.
        (TUBE + "}\n", 0.5 * 0.5 * np.pi * 4.0),
        # Over the disk: ∫ sqrt(1 - r²) 2 π r dr = 2 π / 3.
        (BALL + "}\n", 0.5 * 2.0 * np.pi / 3.0),
        # A ribbon that faces the sun, and one turned by 60°: half as wide, and half as bright.
        (ribbon((0, 0, 1)), 0.5 * 2.0 * 4.0),
        (ribbon((np.sqrt(0.75), 0, 0.5)), 0.5 * 0.5 * 1.0 * 4.0),
    ],
    ids=["tube", "ball", "ribbon", "turned ribbon"],
)
def test_lit_by_a_sun(tmp_path, text, expected):
    """The sun is behind the eye. Facets lean away from the smooth surface at the outline: 1 %."""
    assert total(tmp_path, text + SUN) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("text, silhouette", [(TUBE + "}\n", 8.0), (BALL + "}\n", np.pi)], ids=["tube", "ball"])
def test_under_a_uniform_sky(tmp_path, text, silhouette):
    """The outside of a convex shape has the albedo's radiance everywhere. The outline is that of facets: 1 %."""
    sky = light("DomeLight", "float inputs:intensity = 1")
    assert total(tmp_path, text + sky) == pytest.approx(0.5 * silhouette, rel=0.01)
