"""From the file to the picture: how much light a camera shows, and shapes and moments that change how much there is.

A square of radiance 2 before a camera makes a mean of 2 times the part of the window that it fills.
"""

import math

import numpy as np
import pytest

import warp_ir as ir
from tests.physics.closed_form import placed, rotation
from tests.physics.level import assert_level, at, check, irradiance, light, load, material, mesh, rectangle

pytestmark = pytest.mark.extended

GLOW = material("color3f inputs:diffuseColor = (0, 0, 0)\n        color3f inputs:emissiveColor = (2, 2, 2)", "Glow")
BOUND = "rel material:binding = </Glow>"
API = '"MaterialBindingAPI"'


def square(half=0.25, z=-5.0, more="", name="Square"):
    """A square that faces +Z, 0.1 wide at the unit distance."""
    points = [(-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z)]
    return mesh(name, points, more=f"{BOUND}\n    {more}", api=API)


def camera(more="", head=""):
    """A window of 0.4 x 0.3 at the unit distance, at the origin, along -Z."""
    return f"""
def Camera "Cam" {{
    float horizontalAperture = 20
    float verticalAperture = 15
    float focalLength = 50
    float2 clippingRange = (0.01, 1000)
    {more}
}}
{head}
"""


def picture(folder, text, options=None, **settings):
    """Mean radiance of the picture that the stage asks for."""
    scene = load(folder, text + GLOW, **(options or {}))
    given = dict(width=16, height=12, iterations=64, max_bounces=0, filter=False, estimator="path")
    if "width" in scene.settings:
        given = {k: v for k, v in given.items() if k not in ("width", "height")}
    film = ir.render(scene, ir.RenderSettings(**(given | scene.settings | settings)))
    return film.radiance().astype(float).mean(axis=(0, 1)), film


FRACTION = 0.1 * 0.1 / (0.4 * 0.3)
CAMERAS = {
    "perspective": ("", FRACTION),
    "a lens half as long": ("float focalLength = 25", FRACTION / 4),
    "orthographic": ('uniform token projection = "orthographic"', 0.25 / 3.0),
    "half off to the side": ("float horizontalApertureOffset = 10", FRACTION / 2),
    "half off above": ("float verticalApertureOffset = -7.5", FRACTION / 2),
    "exposure": ("float exposure = 1.5", FRACTION * 2.0**1.5),
    "all of exposure": (
        "float exposure = -1\n float exposure:iso = 400\n float exposure:time = 0.25\n float exposure:fStop = 2\n"
        " float exposure:responsivity = 1.5",
        FRACTION * 1.5 * 0.25 * 4.0 * 0.5 / 4.0,
    ),
    "scaled and mirrored": (at(placed(np.diag([-3.0, 2.0, 0.5]))), FRACTION),
    "out of focus": ("float fStop = 20\n float focusDistance = 2", FRACTION),
    "clipped near": ("float2 clippingRange = (6, 100)", 0.0),
    "clipped far": ("float2 clippingRange = (0.1, 4)", 0.0),
    "half cut away": ("float4[] clippingPlanes = [(1, 0, 0, 0)]", FRACTION / 2),
}  # fmt: skip


@pytest.mark.parametrize("name", CAMERAS)
def test_cameras(tmp_path, name):
    """The part of the window that the square fills, times the exposure; a lens spreads it and loses nothing."""
    more, expected = CAMERAS[name]
    # What is said again replaces what the camera has.
    said = {line.split("=")[0].strip() for line in more.splitlines()}
    text = "\n".join(line for line in camera().splitlines() if line.split("=")[0].strip() not in said)
    text = text.replace('def Camera "Cam" {', f'def Camera "Cam" {{\n    {more}')
    warnings = ["clippingRange"] if expected == 0.0 else []
    found, _ = picture(tmp_path, text + square(), dict(warnings=warnings))
    assert_level(found, 2.0 * expected) if expected else np.testing.assert_array_equal(found, 0.0)


POLICIES = {
    # resolution, shape of a pixel, policy: part of the window that the square fills
    "expandAperture": ((16, 16), 1.0, 0.01 / (0.4 * 0.4)),
    "cropAperture": ((16, 16), 1.0, 0.01 / (0.3 * 0.3)),
    "adjustApertureWidth": ((16, 16), 1.0, 0.01 / (0.3 * 0.3)),
    "adjustApertureHeight": ((16, 16), 1.0, 0.01 / (0.4 * 0.4)),
    "adjustPixelAspectRatio": ((16, 16), 1.0, 0.01 / (0.4 * 0.3)),
    "": ((16, 16), 2.0, 0.01 / (0.6 * 0.3)),
}


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("window", [False, True])
def test_render_settings(tmp_path, policy, window):
    """Every conform policy, wide pixels, and a data window of half the width and height: four times the part."""
    (width, height), aspect, expected = POLICIES[policy]
    text = f"""
def RenderSettings "S" {{
    rel camera = </Cam>
    uniform int2 resolution = ({width}, {height})
    uniform float pixelAspectRatio = {aspect}
    {f'uniform token aspectRatioConformPolicy = "{policy}"' if policy else ""}
    {"uniform float4 dataWindowNDC = (0.25, 0.25, 0.75, 0.75)" if window else ""}
}}
"""
    found, film = picture(tmp_path, camera() + text + square(), iterations=256 if window else 64)
    assert film.radiance().shape[:2] == ((8, 8) if window else (16, 16))
    assert_level(found, 2.0 * expected * (4.0 if window else 1.0))


def test_an_open_shutter(tmp_path):
    """What leaves the picture while the shutter is open is seen for the share of the time that it is in it."""
    move = """double3 xformOp:translate.timeSamples = { 1: (0, 0, 0), 2: (2, 0, 0) }
    uniform token[] xformOpOrder = ["xformOp:translate"]"""
    head = "(\n    startTimeCode = 1\n    endTimeCode = 2\n)\n"
    text = head + camera("double shutter:open = 0\n    double shutter:close = 1") + square(more=move)
    found, _ = picture(tmp_path, text, iterations=128)
    # From 2t - 0.25 to 2t + 0.25, where the window ends at 1: all of it until t = 0.375, none from t = 0.625 on.
    assert_level(found, 2.0 * FRACTION * 0.5, 0.015)
    frozen, _ = picture(tmp_path, text, options=dict(motion_blur=False))
    assert_level(frozen, 2.0 * FRACTION)


DOWN = rotation(0, -90.0)
HERE = placed(DOWN, (0.2, 1.5, 0.1))


@pytest.mark.parametrize("what", ["intensity", "transform", "layer offset", "held", "velocity", "skeleton"])
def test_moments(tmp_path, what):
    """Samples are linear in between, or held; layers may be scaled and moved in time; points fly and follow bones."""
    head = "(\n    timeCodesPerSecond = 24\n    startTimeCode = 4\n)\n"
    expected = irradiance(rectangle(HERE), lambda u, v, d: 1.0)
    text = light("RectLight", "float inputs:intensity.timeSamples = { 0: 1, 10: 11 }", HERE)
    factor = 5.0
    if what == "transform":
        ops = """double3 xformOp:translate.timeSamples = { 0: (-0.8, 1.5, 0.1), 10: (1.7, 1.5, 0.1) }
    float xformOp:rotateX = -90
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]"""
        text = f'def RectLight "L" {{\n    {ops}\n}}\n'
        factor = 1.0
    elif what == "layer offset":
        inner = light("RectLight", "float inputs:intensity.timeSamples = { 0: 1, 10: 11 }", HERE)
        (tmp_path / "inner.usda").write_text(
            '#usda 1.0\n(\n    timeCodesPerSecond = 24\n defaultPrim = "L"\n)\n' + inner
        )
        text = 'def "L" (references = @inner.usda@ (offset = 2; scale = 0.5)) {\n}\n'
    elif what == "held":
        held = "bool inputs:normalize.timeSamples = { 0: 0, 5: 1 }"
        text = light("RectLight", held + "\n    float inputs:intensity = 3\n    float inputs:width = 2", HERE)
        expected, factor = irradiance(rectangle(HERE, 2.0), lambda u, v, d: 1.0), 3.0
    elif what in ("velocity", "skeleton"):
        factor = 2.0
        corners = np.array([(0.5, -0.5, 0), (-0.5, -0.5, 0), (-0.5, 0.5, 0), (0.5, 0.5, 0)]) @ DOWN.T + (0.2, 1.5, 0.1)
        if what == "velocity":
            # The only sample is half a second before, and it flies along x by 1 a second.
            text = mesh("L", corners, more=BOUND, api=API).replace("[] points = [", "[] points.timeSamples = { -8: [")
            flying = f"vector3f[] velocities.timeSamples = {{ -8: {[(1, 0, 0)] * 4} }}"
            text = text.replace("]\n    int[] faceVertexCounts", f"] }}\n    {flying}\n    int[] faceVertexCounts")
            expected = irradiance(rectangle(placed(DOWN, (0.7, 1.5, 0.1))), lambda u, v, d: 1.0)
        else:
            text = f"""
def SkelRoot "Root" {{
    def Skeleton "Skel" (prepend apiSchemas = ["SkelBindingAPI"]) {{
        uniform token[] joints = ["a"]
        uniform matrix4d[] bindTransforms = [((1,0,0,0),(0,1,0,0),(0,0,1,0),(0,0,0,1))]
        uniform matrix4d[] restTransforms = [((1,0,0,0),(0,1,0,0),(0,0,1,0),(0,0,0,1))]
        rel skel:animationSource = </Root/Turn>
    }}
    def SkelAnimation "Turn" {{
        uniform token[] joints = ["a"]
        float3[] translations = [(0.1, 0.2, -0.3)]
        quatf[] rotations.timeSamples = {{ 0: [(1, 0, 0, 0)], 8: [({math.cos(0.5)}, {math.sin(0.5)}, 0, 0)] }}
        half3[] scales = [(1, 1, 1)]
    }}
    {
                mesh(
                    "L",
                    corners,
                    more=BOUND
                    + '''
    rel skel:skeleton = </Root/Skel>
    int[] primvars:skel:jointIndices = [0] (elementSize = 1
    interpolation = "constant")
    float[] primvars:skel:jointWeights = [1] (elementSize = 1
    interpolation = "constant")''',
                    api='"MaterialBindingAPI", "SkelBindingAPI"',
                )
            }
}}
"""
            turned = placed(rotation(0, math.degrees(0.5)), (0.1, 0.2, -0.3)) @ HERE
            expected = irradiance(rectangle(turned), lambda u, v, d: 1.0)
        text += GLOW
    check_at(tmp_path, head + text, factor * expected)


def check_at(folder, text, expected):
    """As `check`, of a stage that begins with its metadata."""
    from tests.physics.level import EYE, floor, level

    scene = load(folder, text + floor() + EYE)
    assert_level(level(scene, "vpl", iterations=32), expected / math.pi, 0.005)


def emitter(points, faces, more):
    return mesh("L", points, faces, f"{BOUND}\n    {more}", api=API) + GLOW


TETRA = np.array([(-0.4, 1.4, -0.4), (0.7, 1.4, -0.3), (0.2, 1.4, 0.7), (0.1, 2.4, 0.0)])
L_SHAPE = [(0, 0), (1, 0), (1, 0.4), (0.4, 0.4), (0.4, 1), (0, 1)]


def triangle(a, b, c):
    """Parametrised with v from the corner a to the opposite side, along which u runs."""
    return lambda u, v: a + v[..., None] * ((b - a) * (1.0 - u)[..., None] + (c - a) * u[..., None])


@pytest.mark.parametrize("kind", ["TetMesh", "concave", "hole", "extra points"])
def test_shapes_that_glow(tmp_path, kind):
    """The bottom of a tetrahedron, an L and what is left of a grid with a hole: ∫ cosθ cosθ' / d² dA, summed."""
    if kind == "TetMesh":
        points = [tuple(p) for p in TETRA.tolist()]
        text = f"""
def TetMesh "L" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
    point3f[] points = {points}
    int4[] tetVertexIndices = [(0, 1, 2, 3)]
    int3[] surfaceFaceVertexIndices = [(0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)]
    {BOUND}
}}
{GLOW}"""
        parts = [triangle(TETRA[0], TETRA[1], TETRA[2])]
    elif kind == "concave":
        corners = [(x - 0.2, 1.2, y - 0.3) for x, y in L_SHAPE]  # x to the right, z towards: seen from below
        text = emitter(corners, [range(6)], "")
        parts = [
            rectangle(placed(DOWN, (0.3, 1.2, -0.1)), 1.0, 0.4),
            rectangle(placed(DOWN, (0.0, 1.2, 0.4)), 0.4, 0.6),
        ]
    else:
        grid = [(x, 1.0, z) for z in (-0.5, 0.0, 0.5) for x in (-0.5, 0.0, 0.5)]
        faces = [(0, 1, 4, 3), (1, 2, 5, 4), (3, 4, 7, 6), (4, 5, 8, 7)]
        more = "int[] holeIndices = [1]" if kind == "hole" else ""
        text = emitter(grid + [(9.0, 9.0, 9.0)] * (kind != "hole"), faces, more)
        centres = [(-0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)] + [(0.25, -0.25)] * (kind != "hole")
        parts = [rectangle(placed(DOWN, (x, 1.0, z)), 0.5, 0.5) for x, z in centres]
    check(tmp_path, text, 2.0 * sum(irradiance(part, lambda u, v, d: 1.0) for part in parts))


def test_a_subdivided_square(tmp_path):
    """Its boundary is a closed cubic B-spline of its four corners, if they are not kept: of 2 · 244/720 of its area.

    ½ ∮ p × dp = Σ w_k p_i × p_{i+k} with w = (245, 56, 1)/720. Three refinements make 32 sides: less by 2π²/3 · 32⁻².
    """
    smooth = 'uniform token interpolateBoundary = "edgeOnly"'
    plain = 'uniform token subdivisionScheme = "none"'
    text = camera('uniform token projection = "orthographic"') + square(more=smooth)
    for scheme, expected in (("catmullClark", 2.0 * 244.0 / 720.0), ("bilinear", 1.0)):
        stage = text.replace(plain, f'uniform token subdivisionScheme = "{scheme}"')
        found, _ = picture(tmp_path, stage, options=dict(complexity="veryhigh"))
        assert_level(found, 2.0 * expected * 0.25 / 3.0)


@pytest.mark.parametrize("scheme", ["catmullClark", "bilinear"])
def test_normals_of_a_subdivided_square_do_not_tilt_it(tmp_path, scheme):
    """UsdGeomMesh ignores normals with a scheme: under a white sky a flat square of albedo ½ shows ½ everywhere.

    Along the square they would show half the sky. The albedo is all: the sky is uniform, and nothing hides it.
    """
    more = f"""normal3f[] normals = {[(0, 1, 0)] * 4} (interpolation = "vertex")
    color3f[] primvars:displayColor = [(0.5, 0.5, 0.5)]"""
    points = [(-5, -5, -5), (5, -5, -5), (5, 5, -5), (-5, 5, -5)]
    text = camera() + mesh("Square", points, more=more).replace('"none"', f'"{scheme}"') + light("DomeLight")
    found, _ = picture(tmp_path, text, options=dict(warnings=("cage",)))
    assert_level(found, 0.5)
