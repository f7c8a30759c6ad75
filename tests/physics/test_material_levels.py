"""From the file to the picture: what a surface reflects, emits and lets through, where the answer is a closed form.

A sun of irradiance π makes a surface that faces it as bright as its albedo. A wall that such a sun lights is a lamp of
radiance ρ(u, v) for the floor before it.
"""

import math

import numpy as np
import pytest

from tests.physics.closed_form import bilinear, placed, rotation
from tests.physics.level import EYE, assert_level, floor, image_nodes, irradiance, level, light, load, mesh, srgb
from tests.stages import write_image

pytestmark = pytest.mark.extended

SUN = light(
    "DistantLight", f"float inputs:angle = 0\n    float inputs:intensity = {math.pi}", placed(rotation(0, -90.0))
)
RNG = np.random.default_rng(7)
BYTES = RNG.integers(0, 256, (4, 4, 4), dtype=np.uint8)
LINEAR = srgb(BYTES)


def look(inputs="", nodes="", surface="UsdPreviewSurface", output="surface"):
    return f"""
def Material "Look" {{
    token outputs:{output}.connect = </Look/S.outputs:surface>
    def Shader "S" {{
        uniform token info:id = "{surface}"
        {inputs}
        token outputs:surface
    }}
    {nodes}
}}
"""


def texture(more="", output="rgb", target="color3f inputs:diffuseColor", file="t.png", place="R", nodes="", rest=""):
    """A material whose input is an image."""
    return look(
        f"{target}.connect = </Look/T.outputs:{output}>\n        {rest}",
        f"{image_nodes(file, more, output, place=place)}\n    {nodes}",
    )


def tile(more="", st=(0.5, 0.5), api='"MaterialBindingAPI"', name="Tile"):
    """The plane y = 0 under the eye, which sees one point of its texture."""
    points = [(-1, 0, 1), (1, 0, 1), (1, 0, -1), (-1, 0, -1)]
    st = f'texCoord2f[] primvars:st = [{tuple(st)}] (interpolation = "constant")'
    return mesh(name, points, more=f"rel material:binding = </Look>\n    {st}\n    {more}", api=api)


def at_st(u, v, texels, wrap="wrap"):
    """The bilinear lookup of an image that goes on beyond its edges as `np.pad` says; (0, 0) is its lower left."""
    n = len(texels)
    big = np.pad(texels, ((2 * n, 2 * n), (2 * n, 2 * n), (0, 0)), wrap)
    return bilinear(big, np.array([[(u + 2.0) / 5.0]]), np.array([[(3.0 - v) / 5.0]]))[0, 0]


WRAP = 'token inputs:wrapS = "{0}"\n        token inputs:wrapT = "{0}"'
REPEAT = WRAP.format("repeat")
IMAGES = {
    # name of the file: pixels, type, what they mean
    "t.png": (BYTES, "uint8", LINEAR[..., :3]),
    "deep.png": (BYTES.astype(np.uint16) * 257, "uint16", BYTES[..., :3] / 255.0),
    "t.exr": (LINEAR[..., :3].astype(np.float32) * 0.9, "half", LINEAR[..., :3] * 0.9),
    "t.hdr": (np.full((4, 4, 3), 0.5, np.float32), "float", np.full((4, 4, 3), 0.5)),
    "grey.png": (BYTES[..., :1], "uint8", np.repeat(BYTES[..., :1] / 255.0, 3, axis=-1)),
    "t.tif": (BYTES[..., :3], "uint8", LINEAR[..., :3]),
}


@pytest.mark.parametrize("name", IMAGES)
def test_images(tmp_path, name):
    """8 bits in colour are sRGB, all others linear; grey is grey; (0, 0) is the lower left."""
    pixels, kind, linear = IMAGES[name]
    write_image(tmp_path / name, pixels, kind)
    for st in ((0.125, 0.125), (0.6, 0.3), (0.8, 0.95)):
        found = level(load(tmp_path, texture(REPEAT, file=name) + tile(st=st) + SUN + EYE), iterations=1)
        assert_level(found, at_st(*st, linear), 2e-3)


@pytest.mark.parametrize("wrap, pad", [
    ("repeat", "wrap"), ("mirror", "symmetric"), ("clamp", "edge"), ("black", "constant"),
])  # fmt: skip
def test_wrap_modes(tmp_path, wrap, pad):
    """Beyond the edges an image repeats, is mirrored, goes on or ends."""
    write_image(tmp_path / "t.png", BYTES, "uint8")
    for st in ((0.4, 0.7), (1.3, 0.2), (-0.35, 1.6)):
        scene = load(tmp_path, texture(WRAP.format(wrap)) + tile(st=st) + SUN + EYE)
        expected = at_st(*st, LINEAR[..., :3], pad)
        if expected.max() == 0.0:
            np.testing.assert_array_equal(level(scene, iterations=1), 0.0)
        else:
            assert_level(level(scene, iterations=1), expected, 2e-3)


PLAIN = at_st(0.3, 0.6, LINEAR)
RAW = at_st(0.3, 0.6, BYTES / 255.0)


def turned(u, v):
    """UsdTransform2d: scaled by (2, 0.5), turned by 30° counter-clockwise, moved by (0.1, -0.2)."""
    x, y = rotation(2, 30.0)[:2, :2] @ (2.0 * u, 0.5 * v) + (0.1, -0.2)
    return x, y


PLACED = """def Shader "P" {
        uniform token info:id = "UsdTransform2d"
        float2 inputs:in.connect = </Look/R.outputs:result>
        float2 inputs:scale = (2, 0.5)
        float inputs:rotation = 30
        float2 inputs:translation = (0.1, -0.2)
        float2 outputs:result
    }"""
COLOR = """def Shader "C" {
        uniform token info:id = "UsdPrimvarReader_float3"
        string inputs:varname = "paint"
        float3 outputs:result
    }"""
BASE = "color3f inputs:diffuseColor = (0.8, 0.4, 0.2)\n        "
SURFACES = {
    # material, what is seen of it at st (0.3, 0.6), whether it warns, options of load_usd
    "constant": (look(BASE), (0.8, 0.4, 0.2)),
    "unauthored": (look(), (0.18, 0.18, 0.18)),
    "scale and bias": (
        texture(REPEAT + "\n float4 inputs:scale = (0.5, 0.25, 0.75, 1)\n float4 inputs:bias = (0.1, 0.2, 0, 0)"),
        PLAIN[:3] * (0.5, 0.25, 0.75) + (0.1, 0.2, 0.0),
    ),
    "raw": (texture(REPEAT + '\n        token inputs:sourceColorSpace = "raw"'), RAW[:3]),
    "sRGB": (texture(REPEAT + '\n        token inputs:sourceColorSpace = "sRGB"'), PLAIN[:3]),
    "a channel": (texture(REPEAT, output="g"), PLAIN[[1, 1, 1]]),
    "transform": (texture(REPEAT, place="P", nodes=PLACED), at_st(*turned(0.3, 0.6), LINEAR[..., :3])),
    "fallback": (texture("float4 inputs:fallback = (0.6, 0.3, 0.1, 1)", file="no.png"), (0.6, 0.3, 0.1), "no.png"),
    "metal": (look(BASE + "float inputs:metallic = 1"), (0.8, 0.4, 0.2), "metal"),
    "black metal": (look(BASE + "float inputs:metallic = 0.75"), (0.2, 0.1, 0.05), "metal", dict(metals="black")),
    "specular": (
        look(BASE + "int inputs:useSpecularWorkflow = 1\n        color3f inputs:specularColor = (0.5, 0, 0.25)"),
        (0.8 * 0.5 + 0.5, 0.4, 0.2 * 0.75 + 0.25),
        "specular",
    ),
    "standard surface": (
        look("color3f inputs:base_color = (0.8, 0.4, 0.2)\n        float inputs:base = 0.5",
             surface="ND_standard_surface_surfaceshader", output="mtlx:surface"),
        (0.4, 0.2, 0.1),
    ),
    "OpenPBR": (
        look("color3f inputs:base_color = (0.8, 0.4, 0.2)\n        float inputs:base_weight = 0.25",
             surface="ND_open_pbr_surface_surfaceshader", output="mtlx:surface"),
        (0.2, 0.1, 0.05),
    ),
    "primvar": (look("color3f inputs:diffuseColor.connect = </Look/C.outputs:result>", COLOR), (0.7, 0.1, 0.5)),
    "emission": (look(BASE + "color3f inputs:emissiveColor = (0.5, 2, 1)"), (1.3, 2.4, 1.2)),
    "textured emission": (
        texture(REPEAT, target="color3f inputs:emissiveColor", rest="color3f inputs:diffuseColor = (0, 0, 0)"),
        PLAIN[:3],
    ),
    "ACEScg": (
        look('color3f inputs:diffuseColor = (0.4, 0.3, 0.2) (colorSpace = "lin_ap1_scene")'),
        (0.4788, 0.2880, 0.1823),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SURFACES)
def test_surfaces(tmp_path, name):
    """Every way to say a colour, as the eye sees it in a sun."""
    text, expected, *rest = SURFACES[name]
    write_image(tmp_path / "t.png", BYTES, "uint8")
    paint = 'color3f[] primvars:paint = [(0.7, 0.1, 0.5)] (interpolation = "constant")'
    words = [word for word in rest[:1] if word]
    scene = load(tmp_path, text + tile(paint, (0.3, 0.6)) + SUN + EYE, warnings=words, **(rest[1] if rest[1:] else {}))
    assert_level(level(scene, iterations=256 if "emission" in name else 1), expected, 2e-3)


def test_tiles(tmp_path):
    """UDIM: tile 1001 + u + 10 v shows the unit square from (u, v)."""
    for number, value in ((1001, 64), (1002, 128), (1012, 255)):
        write_image(tmp_path / f"t.{number}.png", np.full((4, 4, 3), value, np.uint8), "uint8")
    for st, value in (((0.5, 0.5), 64), ((1.3, 0.7), 128), ((1.5, 1.2), 255)):
        scene = load(tmp_path, texture(file="t.<UDIM>.png") + tile(st=st) + SUN + EYE)
        assert_level(level(scene, iterations=1), float(srgb(value)), 2e-3)


POINTS = [(-1, 0, 1), (0, 0, 1), (1, 0, 1), (-1, 0, -1), (0, 0, -1), (1, 0, -1)]
FACES = [(0, 1, 4, 3), (1, 2, 5, 4)]
PALETTE = RNG.random((8, 3)).round(3)
DISPLAYED = {
    # interpolation and values: the colour at (-0.2, -0.4) and (0.5, 0.3), in USD's order of the elements
    "constant": (PALETTE[:1], lambda p: PALETTE[0]),
    "uniform": (PALETTE[:2], lambda p: PALETTE[0 if p[0] < 0 else 1]),
    "vertex": (PALETTE[:6], None),
    "varying": (PALETTE[:6], None),
    "faceVarying": (PALETTE[:8], None),
}


@pytest.mark.parametrize("indexed", [False, True])
@pytest.mark.parametrize("interpolation", DISPLAYED)
def test_display_colors(tmp_path, interpolation, indexed):
    """Of a prim, a face, a point or a corner; linear on the triangles (a quad's first and third corner are joined)."""
    values, color = DISPLAYED[interpolation]
    order = np.random.default_rng(3).permutation(len(values)) if indexed else np.arange(len(values))
    stored = [tuple(row) for row in values[order].tolist()]
    text = f'color3f[] primvars:displayColor = {stored} (interpolation = "{interpolation}")'
    if indexed:
        text += f"\n    int[] primvars:displayColor:indices = {np.argsort(order).tolist()}"
    points = np.array(POINTS, float)
    for p in ((-0.2, -0.4), (0.5, 0.3)):
        shift = (-p[0], 0.0, -p[1])
        scene = load(tmp_path, mesh("M", points + shift, FACES, text) + SUN + EYE)
        if color is None:
            face = 0 if p[0] < 0 else 1
            ids = FACES[face] if interpolation != "faceVarying" else range(4 * face, 4 * face + 4)
            corners = points[list(FACES[face])][:, [0, 2]]
            for triple in ((0, 1, 2), (0, 2, 3)):
                a = np.vstack([corners[list(triple)].T, np.ones(3)])
                weights = np.linalg.solve(a, [*p, 1.0])
                if (weights >= -1e-9).all():
                    expected = weights @ values[[list(ids)[k] for k in triple]]
        else:
            expected = color(p)
        assert_level(level(scene, iterations=1), expected, 1e-3)


@pytest.mark.parametrize("estimator", ["vpl", "path"])
@pytest.mark.parametrize("how", ["cut", "kept", "partial", "alpha", "displayOpacity", "closed alpha"])
def test_light_through_surfaces(tmp_path, how, estimator):
    """A screen over the floor lets the sun through: all of it, none, its share, or where its image says."""
    write_image(tmp_path / "t.png", np.dstack([np.full((8, 8, 3), 255), np.indices((8, 8)).sum(0) % 2 * 255])
                .astype(np.uint8), "uint8")  # fmt: skip
    inputs = {"cut": ("0.3", "0.4", 1.0), "kept": ("0.5", "0.4", 0.0), "partial": ("0.3", "0", 0.7)}
    more, warnings = "", ["opacity"] if how in ("partial", "displayOpacity") else []
    if how in inputs:
        opacity, threshold, expected = inputs[how]
        screen = look(f"float inputs:opacity = {opacity}\n        float inputs:opacityThreshold = {threshold}")
    elif how == "displayOpacity":
        screen, expected = "", 0.75
        more = "float[] primvars:displayOpacity = [0.25]"
    else:
        # Where a checkerboard of 0 and 1, bilinearly, is below 0.9 the surface is absent; the eye's own point has st.
        threshold = 0.9 if how == "alpha" else 0.1
        target = f"float inputs:opacityThreshold = {threshold}\n        float inputs:opacity"
        screen = texture(REPEAT, output="a", target=target)
        expected = 1.0 if how == "alpha" else 0.0
    st = (0.5, 0.5)  # between four texels: 1/2
    hung = tile(more, st, name="Screen", api="" if how == "displayOpacity" else '"MaterialBindingAPI"')
    if how == "displayOpacity":
        hung = hung.replace("rel material:binding = </Look>", "")
    hung = hung.replace("(-1.0, 0.0, 1.0)", "(-1.0, 0.5, 1.0)").replace("(1.0, 0.0, 1.0)", "(1.0, 0.5, 1.0)")
    hung = hung.replace("(1.0, 0.0, -1.0)", "(1.0, 0.5, -1.0)").replace("(-1.0, 0.0, -1.0)", "(-1.0, 0.5, -1.0)")
    # Rays draw lots by where they meet the screen: see more of it than a point.
    wide = EYE.replace("1e-4\n", "1\n")
    scene = load(tmp_path, floor() + screen + hung + SUN + wide, warnings=warnings)
    found = level(scene, estimator, iterations=64)
    if expected in (0.0, 1.0):
        assert_level(found, expected, 1e-3) if expected else np.testing.assert_array_equal(found, 0.0)
    else:
        assert_level(found, expected, 0.02 if estimator == "vpl" else 0.01)


FRONT = light("DistantLight", f"float inputs:angle = 0\n    float inputs:intensity = {math.pi}")


def wall(u, v):
    """Points of a wall that stands on the floor behind the origin and faces it; u to the right, v down."""
    return np.stack([1.2 * (u - 0.5), 1.3 - 1.2 * v, 0.0 * u - 0.7], axis=-1)


def standing(more, name="Wall", api='"MaterialBindingAPI"', left=0.0, right=1.0, extra=""):
    """The wall, or the part between left and right, with a uv set; it repeats an image three times across."""
    corners = [(left, 1.0), (right, 1.0), (right, 0.0), (left, 0.0)]
    points = [wall(np.float64(u), np.float64(v)) for u, v in corners]
    st = f'texCoord2f[] primvars:st = {[(3.0 * u, 1.0 - v) for u, v in corners]} (interpolation = "vertex")'
    return mesh(name, points, more=f"{more}\n    {st}\n    {extra}", api=api)


def ramp(u, v):
    return np.stack([0.1 + 0.8 * u, 0.9 - 0.5 * v, 0.2 + 0.0 * u], axis=-1)


BOUND = "rel material:binding = </Look>"
HALF = np.float64([[[0.0], [1.0]]])
PAIR = [(0.9, 0.2, 0.1), (0.1, 0.3, 0.8)]


def tripled(texels):
    return lambda u, v: bilinear(np.tile(texels, (1, 3, 1)), u, v, periodic=True)


def halves(u):
    return np.where((u < 0.5)[..., None], PAIR[0], PAIR[1])


SUBSET = """def GeomSubset "G{0}" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
        uniform token elementType = "face"
        uniform token familyName = "materialBind"
        int[] indices = [{0}]
        rel material:binding = </Look{0}>
    }}"""
TWO_LOOKS = "".join(
    look(f"color3f inputs:diffuseColor = {color}").replace("Look", f"Look{k}") for k, color in enumerate(PAIR)
)
RAMP = [tuple(ramp(u, v).tolist()) for u, v in ((0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0))]
WALLS = {
    # what is authored, albedo at (u, v), words of a warning
    "image": (texture(REPEAT) + standing(BOUND), tripled(LINEAR[..., :3])),
    "image of MaterialX": (
        look("color3f inputs:base_color.connect = </Look/I.outputs:out>\n float inputs:base = 0.5", """def Shader "I" {
            uniform token info:id = "ND_image_color3"
            asset inputs:file = @t.png@ (colorSpace = "srgb_texture")
            color3f outputs:out
        }""", "ND_standard_surface_surfaceshader", "mtlx:surface") + standing(BOUND),
        lambda u, v: 0.5 * tripled(LINEAR[..., :3])(u, v),
    ),
    "colours of points": (
        standing(f'color3f[] primvars:displayColor = {RAMP} (interpolation = "vertex")', api=""), ramp
    ),
    "colours of corners": (
        standing(f'color3f[] primvars:displayColor = {RAMP} (interpolation = "faceVarying")', api=""), ramp
    ),
    "primvar reader": (
        look("color3f inputs:diffuseColor.connect = </Look/C.outputs:result>", COLOR)
        + standing(BOUND + f'\n    color3f[] primvars:paint = {RAMP} (interpolation = "vertex")'),
        ramp,
    ),
    "meshes": (
        TWO_LOOKS + standing(BOUND.replace("Look", "Look0"), "A", right=0.5)
        + standing(BOUND.replace("Look", "Look1"), "B", left=0.5),
        lambda u, v: halves(u),
    ),
    "subsets": (
        TWO_LOOKS + mesh("Wall", [wall(np.float64(u), np.float64(v)) for v in (1.0, 0.0) for u in (0.0, 0.5, 1.0)],
                         [(0, 1, 4, 3), (1, 2, 5, 4)], SUBSET.format(0) + "\n" + SUBSET.format(1) + "\n"),
        lambda u, v: halves(u),
    ),
    "instances": (
        'over "Proto" {' + standing("", "Half", "", right=0.5) + "}\n" + "".join(
            f"""def Xform "I{k}" (instanceable = true
    prepend references = </Proto>) {{
    color3f[] primvars:displayColor = [{color}]
    double3 xformOp:translate = ({0.6 * k}, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}}
""" for k, color in enumerate(PAIR)),
        lambda u, v: halves(u),
    ),
    "cut-out": (
        texture(REPEAT, output="a", target=BASE + "float inputs:opacityThreshold = 0.5\n        float inputs:opacity",
                file="half.png") + standing(BOUND),
        # Between the middles of two texels the threshold is crossed in the middle.
        lambda u, v: np.where(((3.0 * u) % 1.0 > 0.5)[..., None], (0.8, 0.4, 0.2), 0.0),
    ),
    "half there": (
        look(BASE + "float inputs:opacity = 0.5") + standing(BOUND),
        lambda u, v: 0.5 * np.array([0.8, 0.4, 0.2]) + 0.0 * u[..., None],
        "opacity",
    ),
    "metal": (
        look(BASE + "float inputs:metallic = 1") + standing(BOUND),
        lambda u, v: np.array([0.8, 0.4, 0.2]) + 0.0 * u[..., None],
        "metal",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WALLS)
def test_lit_walls(tmp_path, name):
    """The floor's radiance is 1/π ∫ ρ(u, v) cosθ cosθ' / d² dA: what the eye sees of a wall is what it reflects."""
    text, albedo, *words = WALLS[name]
    write_image(tmp_path / "t.png", BYTES, "uint8")
    write_image(tmp_path / "half.png", np.dstack([np.full((1, 2, 3), 255), HALF * 255]).astype(np.uint8), "uint8")
    scene = load(tmp_path, floor(size=0.05) + text + FRONT + EYE, warnings=words)
    expected = irradiance(wall, lambda u, v, d: albedo(u, v)) / math.pi
    assert_level(level(scene, "vpl", max_bounces=1, iterations=64), expected)
    assert_level(level(scene, "path", max_bounces=1, iterations=64), expected, 0.05)
