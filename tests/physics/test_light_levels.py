"""From the file to the picture: what UsdLux can say of a light, over a floor whose irradiance is known.

A white floor has the radiance E/π. Every case is a stage, rendered by two estimators; E comes from a closed form, or
from quadrature of the definition with the matrices that the test wrote.
"""

import math

import numpy as np
import pytest

from tests.physics.closed_form import bilinear, placed, rotation, shaped
from tests.physics.level import (
    EYE,
    assert_level,
    at,
    check,
    floor,
    irradiance,
    level,
    light,
    load,
    material,
    panel,
    rectangle,
    srgb,
    usd,
)
from tests.stages import write_image

pytestmark = pytest.mark.extended

DOWN = rotation(0, -90.0)
TILTED = rotation(1, 20.0) @ rotation(0, -70.0)
LINEAR = TILTED @ np.diag([1.6, 0.7, 0.5])
MATRIX = placed(LINEAR, (0.3, 2.0, 0.4))
AXIS = -TILTED[:, 2]
"""Where it points."""
AREA = 1.6 * 0.7
"""Of a unit square there."""


SHAPINGS = {
    "cone": dict(angle=35.0),
    "soft": dict(angle=50.0, softness=0.7),
    "focus": dict(angle=90.0, focus=6.0),
    "tint": dict(angle=60.0, softness=1.0, focus=3.0, tint=0.25),
}


def shaping_text(angle=90.0, softness=0.0, focus=0.0, tint=0.0):
    return f"""float inputs:shaping:cone:angle = {angle}
    float inputs:shaping:cone:softness = {softness}
    float inputs:shaping:focus = {focus}
    color3f inputs:shaping:focusTint = ({tint}, {tint}, {tint})"""


@pytest.mark.parametrize("kind, how", [
    ("rect", "soft"), ("mesh", "cone"), ("mesh", "soft"), ("normalized mesh", "focus"), ("normalized mesh", "tint"),
])  # fmt: skip
def test_shaping(tmp_path, kind, how):
    """E = ∫ L f(θ) cosθ cosθ' / d² dA, θ from the light's -Z; normalize divides by the area, not by the shaping."""
    settings = SHAPINGS[how]
    more = "float inputs:intensity = 5\n    " + shaping_text(**settings)
    if kind == "rect":
        text = light("RectLight", more, MATRIX, api='"ShapingAPI"')
    else:
        more += f"\n    bool inputs:normalize = {str(kind != 'mesh').lower()}"
        text = panel(more, MATRIX, api='"MeshLightAPI", "ShapingAPI"')
    radiance = 5.0 / (AREA if kind == "normalized mesh" else 1.0)
    expected = irradiance(rectangle(MATRIX), lambda u, v, d: radiance * shaped(d @ AXIS, **settings))
    check(tmp_path, text, expected)


@pytest.mark.parametrize("how", SHAPINGS)
@pytest.mark.parametrize("kind", ["SphereLight", "DistantLight"])
def test_shaping_of_balls_and_suns(tmp_path, kind, how):
    """I f(θ) cosθ' / d² under a point; under a wide sun ∫ L f(θ) cosθ dω, θ from its own axis."""
    settings = SHAPINGS[how]
    if kind == "SphereLight":
        turn = rotation(0, -60.0)
        more = "float inputs:radius = 0.5\n    bool treatAsPoint = true\n    " + shaping_text(**settings)
        text = light(kind, more, placed(turn, (0.0, 2.0, 0.5)), '"ShapingAPI"')
        to_floor = np.array([0.0, -2.0, -0.5]) / math.hypot(2.0, 0.5)
        expected = math.pi * 0.25 * shaped(to_floor @ -turn[:, 2], **settings) * 2.0 / 4.25**1.5
    else:
        turn = rotation(0, -70.0)
        more = "float inputs:intensity = 2\n    float inputs:angle = 90\n    " + shaping_text(**settings)
        text = light(kind, more, placed(turn), '"ShapingAPI"')
        theta, phi = np.meshgrid((np.arange(400) + 0.5) * np.pi / 1600, (np.arange(400) + 0.5) * np.pi / 200)
        d = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), -np.cos(theta)], -1)
        cosine = np.maximum(-(d @ turn.T)[..., 1], 0.0)
        expected = (2.0 * shaped(np.cos(theta), **settings) * cosine * np.sin(theta)).sum() * np.pi / 1600 * np.pi / 200
    check(tmp_path, text, expected)


# Linear Rec. 709 of black bodies with luminance 1.
BLACK_BODIES = {1000: (4.306, 0.118, 0.0), 3000: (1.771, 0.844, 0.272), 10000: (0.872, 0.995, 1.430)}


@pytest.mark.parametrize(
    "kind, kelvin", [("RectLight", 1000), ("mesh", 3000), ("DomeLight", 3000), ("DistantLight", 10000)]
)
def test_the_factors_of_a_light(tmp_path, kind, kelvin):
    """L = intensity · 2^exposure · color · blackbody · diffuse; specular and metersPerUnit have no part in it."""
    more = f"""float inputs:intensity = 3
    float inputs:exposure = -1.5
    color3f inputs:color = (0.2, 0.9, 0.5)
    bool inputs:enableColorTemperature = true
    float inputs:colorTemperature = {kelvin}
    float inputs:diffuse = 0.7
    float inputs:specular = 9"""
    radiance = 3.0 * 2.0**-1.5 * np.array([0.2, 0.9, 0.5]) * BLACK_BODIES[kelvin] * 0.7
    if kind == "DomeLight":
        check(tmp_path, light(kind, more, MATRIX), math.pi * radiance)
    elif kind == "DistantLight":
        solid_angle = math.pi * math.sin(math.radians(5.0)) ** 2
        check(tmp_path, light(kind, more + "\n    float inputs:angle = 10", MATRIX), solid_angle * -AXIS[1] * radiance)
    else:
        text = light(kind, more, MATRIX) if kind == "RectLight" else panel(more, MATRIX)
        check(tmp_path, text, irradiance(rectangle(MATRIX), lambda u, v, d: 1.0) * radiance)


SHEAR = np.array([[1.0, 0.5, 0.0], [0.0, 0.8, 0.3], [0.2, 0.0, 1.2]])


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("kind", ["RectLight", "mesh"])
def test_sheared_lights(tmp_path, kind, mirrored, normalize):
    """A parallelogram, mirrored or not, emits along its -Z; normalized, over the length of its edges' cross product."""
    linear = DOWN @ SHEAR @ np.diag([-1.0 if mirrored else 1.0, 1.0, 1.0])
    matrix = placed(linear, (0.2, 1.8, -0.3))
    more = f"float inputs:intensity = 4\n    bool inputs:normalize = {str(normalize).lower()}"
    radiance = 4.0 / (np.linalg.norm(np.cross(linear[:, 0], linear[:, 1])) if normalize else 1.0)
    # Mirrored, u runs the other way round, and so must the quadrature.
    place = rectangle(placed(DOWN @ SHEAR, (0.2, 1.8, -0.3)))
    text = light("RectLight", more, matrix) if kind == "RectLight" else panel(more, matrix)
    check(tmp_path, text, irradiance(place, lambda u, v, d: radiance))


SYNC = {"materialGlowTintsLight": "tints", "independent": "apart", "noMaterialResponse": "black", "": "tints"}


@pytest.mark.parametrize("mode", SYNC)
@pytest.mark.parametrize("glow", [(0.5, 0.25, 1.0), None])
def test_what_a_mesh_light_takes_from_its_material(tmp_path, mode, glow):
    """Its light, times the glow if that tints it; the eye sees the material's own glow, without one the light.

    And it reflects as its material does, unless that has no part in it: so much a sun on its front adds.
    """
    emissive = "" if glow is None else f"color3f inputs:emissiveColor = {glow}"
    sync = f'uniform token light:materialSyncMode = "{mode}"' if mode else ""
    bound = f"float inputs:intensity = 3\n    rel material:binding = </Look>\n    {sync}"
    matrix = placed(DOWN, (0.0, 1.5, 0.0))
    text = panel(bound, matrix, '"MeshLightAPI", "MaterialBindingAPI"')
    text += material(f"color3f inputs:diffuseColor = (0.4, 0.4, 0.4)\n{emissive}")
    tint = np.array(glow if glow and SYNC[mode] == "tints" else (1.0, 1.0, 1.0))
    check(tmp_path, text, 3.0 * tint * irradiance(rectangle(matrix), lambda u, v, d: 1.0), path=False)

    sun = light(
        "DistantLight", "float inputs:angle = 0\n    float inputs:intensity = 2", placed(rotation(0, 90.0)), name="Sun"
    )
    up = EYE.replace("(0,0,-1,0), (0,1,0,0), (0,0.01,0,1)", "(0,0,1,0), (0,-1,0,0), (0,1.4,0,1)")
    found = level(load(tmp_path, text + sun + up), iterations=64)
    seen = 3.0 * tint
    if SYNC[mode] == "apart" or (glow and SYNC[mode] == "tints"):
        seen = np.array(glow or (0.0,) * 3)
    reflected = 0.0 if SYNC[mode] == "black" else 0.4 * 2.0 / math.pi
    assert_level(found, seen + reflected)


@pytest.mark.parametrize("kind, suffix, normalize", [
    ("rect", "exr", True), ("rect", "png", False), ("mesh", "exr", False), ("mesh", "png", True),
])  # fmt: skip
def test_textures_on_lights(tmp_path, kind, suffix, normalize):
    """E = ∫ L T(u, v) cosθ cosθ' / d² dA, the image upright as seen from the lit side; bytes are sRGB.

    On surfaces it repeats, which shows in half a texel at the edges.
    """
    pixels = np.zeros((4, 6, 3), np.uint8)
    pixels[0, :2], pixels[3, 5], pixels[1, 3] = (255, 128, 30), (40, 255, 200), (90, 60, 255)
    image = srgb(pixels).astype(np.float32) * (1.0 if suffix == "png" else 4.0)
    write_image(tmp_path / f"t.{suffix}", pixels if suffix == "png" else image, "uint8" if suffix == "png" else "float")
    more = f"""float inputs:intensity = 3
    asset inputs:texture:file = @t.{suffix}@
    bool inputs:normalize = {str(normalize).lower()}"""
    radiance = 3.0 / (AREA if normalize else 1.0)
    expected = irradiance(rectangle(MATRIX), lambda u, v, d: radiance * bilinear(image, u, v, periodic=kind == "mesh"))
    text = light("RectLight", more, MATRIX) if kind == "rect" else panel(more, MATRIX)
    check(tmp_path, text, expected, iterations=128)


def test_a_panel_of_the_kinds_of_surfaces_that_glow(tmp_path):
    """An emissiveColor lights from the front, from both sides if doubleSided; opacity may hide or dim it."""
    matrix = placed(rotation(0, -70.0), (0.2, 1.5, 0.3))
    expected = 2.0 * irradiance(rectangle(matrix), lambda u, v, d: 1.0)
    turned = placed(rotation(0, 110.0), (0.2, 1.5, 0.3))
    bound = "rel material:binding = </Look>"
    api = '"MaterialBindingAPI"'
    look = "color3f inputs:diffuseColor = (0, 0, 0)\n    color3f inputs:emissiveColor = (2, 2, 2)\n    "
    for k, (where, more, inputs, factor) in enumerate(
        [
            (matrix, "", "", 1.0),
            (turned, "", "", 0.0),
            (turned, "uniform bool doubleSided = true", "", 1.0),
            (matrix, 'uniform token orientation = "leftHanded"', "", 0.0),
            (matrix, "", "float inputs:opacity = 0.3\n    float inputs:opacityThreshold = 0.2", 1.0),
            (matrix, "", "float inputs:opacity = 0.3\n    float inputs:opacityThreshold = 0.4", 0.0),
            (matrix, "", "float inputs:opacity = 0.3", 1.0),
            (matrix, "", 'float inputs:opacity = 0.3\n    token inputs:opacityMode = "presence"', 0.3),
        ]
    ):
        folder = tmp_path / str(k)
        folder.mkdir()
        text = floor() + EYE + panel(f"{bound}\n    {more}", where, api) + material(look + inputs)
        found = level(load(folder, text, warnings=["opacity"] if k > 5 else []), "vpl", iterations=32)
        assert_level(found, factor * expected / math.pi) if factor else np.testing.assert_array_equal(found, 0.0)


PLACES = [placed(rotation(1, 30.0) @ rotation(0, -60.0) @ np.diag([0.5, 0.9, 2.0]), (-0.4, 1.2, 0.3)),
          placed(rotation(2, 40.0) @ rotation(0, -100.0), (0.6, 1.7, 0.0))]  # fmt: skip
OUTER = placed(rotation(1, -35.0) @ np.diag([1.3, 1.1, 0.8]), (0.1, 0.2, -0.2))


def quaternion(matrix):
    """Of a rotation [3, 3], (w, x, y, z)."""
    w = 0.5 * math.sqrt(1.0 + np.trace(matrix))
    x, y, z = (matrix[j, i] - matrix[i, j] for i, j in ((1, 2), (2, 0), (0, 1)))
    return w, x / (4 * w), y / (4 * w), z / (4 * w)


@pytest.mark.parametrize("how", ["native", "nested", "points", "points in native"])
@pytest.mark.parametrize("kind", ["RectLight", "DistantLight", "mesh", "shaped mesh", "glow"])
def test_lights_in_instances(tmp_path, kind, how):
    """E of all places, each with its own matrix; normalized, the radiance is over each one's area in the world."""
    normalize = kind != "glow"
    own = placed(rotation(0, 15.0), (0.1, 0.0, 0.05))
    more = f"float inputs:intensity = 3\n    bool inputs:normalize = {str(normalize).lower()}"
    if kind in ("RectLight", "DistantLight"):
        lamp = light(kind, more, own)
    elif kind == "mesh":
        lamp = panel(more, own)
    elif kind == "shaped mesh":
        lamp = panel(more + "\n" + shaping_text(**SHAPINGS["soft"]), own, '"MeshLightAPI", "ShapingAPI"')
    else:
        lamp = panel("rel material:binding = </Look>", own, '"MaterialBindingAPI"')
        lamp += "\n" + material("color3f inputs:emissiveColor = (3, 3, 3)")
    lamp = lamp.replace("</Look", "</Lamp/Look")

    def instances(target, matrices):
        return "".join(
            f'def Xform "I{k}" (instanceable = true\n prepend references = <{target}>) {{\n {at(m)} }}\n'
            for k, m in enumerate(matrices)
        )

    text = f'over "Lamp" {{{lamp}\n}}\n'
    if how == "native":
        text += instances("/Lamp", PLACES)
        worlds = PLACES
    elif how == "nested":
        text += f'over "Group" {{\n{instances("/Lamp", PLACES)}}}\n' + instances("/Group", [OUTER])
        worlds = [OUTER @ m for m in PLACES]
    else:
        turns = [rotation(1, 30.0) @ rotation(0, -60.0), rotation(2, 40.0) @ rotation(0, -100.0)]
        scales = [(0.5, 0.9, 2.0), (1.0, 1.0, 1.0)]
        cloud = f"""
def PointInstancer "Cloud" {{
    rel prototypes = <Lamp>
    int[] protoIndices = [0, 0]
    point3f[] positions = {usd([m[:3, 3] for m in PLACES])}
    quatf[] orientationsf = {[tuple(float(x) for x in quaternion(r)) for r in turns]}
    float3[] scales = {usd(scales)}
    over "Lamp" (prepend references = </Lamp>) {{
    }}
    {at(OUTER) if how == "points" else ""}
}}
"""
        worlds = [placed(r @ np.diag(s), m[:3, 3]) for r, s, m in zip(turns, scales, PLACES, strict=True)]
        worlds = [OUTER @ m for m in worlds]
        if how == "points":
            text += cloud
        else:
            text += f'over "Group" {{\n{cloud}}}\n' + instances("/Group", [OUTER])
    text = text.replace(
        "rel prototypes = <Lamp>",
        "rel prototypes = </Cloud/Lamp>" if how == "points" else "rel prototypes = </Group/Cloud/Lamp>",
    )
    expected = 0.0
    for world in (m @ own for m in worlds):
        a = world[:3, :3]
        radiance = 3.0 / (np.linalg.norm(np.cross(a[:, 0], a[:, 1])) if normalize else 1.0)
        axis = -a[:, 2] / np.linalg.norm(a[:, 2])

        if kind == "DistantLight":  # normalized: in lux
            expected = expected + 3.0 * max(-axis[1], 0.0)
            continue

        def emitted(u, v, d, radiance=radiance, axis=axis):
            return radiance * (shaped(d @ axis, **SHAPINGS["soft"]) if kind == "shaped mesh" else 1.0)

        expected = expected + irradiance(rectangle(world), emitted)
    check(tmp_path, text, expected, path=False)


def disk_below(radius, height):
    """E under a disk that faces down, on its axis."""
    return math.pi * radius**2 / (radius**2 + height**2)


UP = placed(rotation(0, -90.0), (0.0, 2.0, 0.0))
GPRIMS = {
    # What is authored, its area, E of radiance 1 at the origin, 2 below its centre; its axis Z is the world's Y.
    "Sphere": ("double radius = 0.6", 4 * math.pi * 0.36, math.pi * 0.36 / 4.0),
    "Cube": ("double size = 1.2", 6 * 1.44, None),
    "Cylinder": ("double radius = 0.5\n double height = 1.4", 2 * math.pi * 0.5 * 1.9, disk_below(0.5, 1.3)),
    "Cone": (
        "double radius = 0.7\n double height = 1",
        math.pi * 0.7 * (0.7 + math.hypot(0.7, 1)),
        disk_below(0.7, 1.5),
    ),
    "Capsule": ("double radius = 0.4\n double height = 1", 2 * math.pi * 0.4 * 1.8, math.pi * 0.16 / 2.25),
    "Plane": ("double width = 1.2\n double length = 1.2", 1.44, None),
}


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("kind", GPRIMS)
def test_gprims_that_are_lights(tmp_path, kind, normalize):
    """π L times the part of the hemisphere's projection that the body covers; normalized, over its area."""
    size, area, expected = GPRIMS[kind]
    if expected is None:  # one face, seen from below
        face = placed(rotation(0, -90.0), (0.0, 1.4 if kind == "Cube" else 2.0, 0.0))
        expected = irradiance(rectangle(face, 1.2, 1.2), lambda u, v, d: 1.0)
    more = f"float inputs:intensity = 3\n    bool inputs:normalize = {str(normalize).lower()}\n    {size}"
    radiance = 3.0 / (area if normalize else 1.0)
    check(tmp_path, light(kind, more, UP, '"LightAPI"'), radiance * expected, within=0.01)


def test_geometry_lights(tmp_path):
    """The gprim shines as the GeometryLight says, whose own transform does not matter; it does not shine by itself."""
    text = light("GeometryLight", "rel geometry = </G>\n    float inputs:intensity = 4", OUTER)
    text += light("Sphere", "double radius = 0.6", UP, name="G")
    check(tmp_path, text, 4.0 * math.pi * 0.36 / 4.0, within=0.01)


@pytest.mark.parametrize("normalize", [False, True])
def test_lines(tmp_path, normalize):
    """E = L A / π l · (a/(h² + a²) + atan(a/h)/h) under the middle of a line of length l = 2 a; A = 1 normalized."""
    more = f"""float inputs:length = 1.6
    float inputs:radius = 0.3
    float inputs:intensity = 7
    bool treatAsLine = true
    bool inputs:normalize = {str(normalize).lower()}"""
    area, h, a = 1.0 if normalize else 2 * math.pi * 0.3 * 1.6, 1.5, 0.8
    expected = area / (math.pi * 1.6) * 7.0 * (a / (h * h + a * a) + math.atan(a / h) / h)
    check(tmp_path, light("CylinderLight", more, placed(np.eye(3), (0.0, h, 0.0))), expected)
