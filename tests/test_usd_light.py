"""UsdLux radiometry against its closed forms."""

import functools
import math

import numpy as np
import pytest

from tests import stages
from tests.stages import photometry, sky_directions, warned, write_image
from warp_ir import LightKind, StageReader

load = functools.partial(stages.load, default_light="none")


def light_text(kind: str, more: str = "", head: str = "") -> str:
    return f'def {kind} "L" {head} {{\n    {more}\n}}\n'


A, B, C = 2.0, 3.0, 0.5  # half axes after the scale below, for radius 1
SCALE = f"""
    float3 xformOp:scale = ({A}, {B}, {C})
    uniform token[] xformOpOrder = ["xformOp:scale"]"""
PERIMETER = math.pi * (3 * (B + C) - math.sqrt((3 * B + C) * (B + 3 * C)))
SCALED = [
    ("RectLight", LightKind.RECT, "float inputs:width = 4\n    float inputs:height = 0.5", 4 * A * 0.5 * B),
    ("DiskLight", LightKind.DISK, "float inputs:radius = 2", math.pi * 4 * A * B),
    (
        "SphereLight",
        LightKind.SPHERE,
        "float inputs:radius = 2",
        4 * math.pi * 4 * (((A * B) ** 1.6 + (A * C) ** 1.6 + (B * C) ** 1.6) / 3) ** (1 / 1.6),
    ),
    (
        "CylinderLight",
        LightKind.CYLINDER,
        "float inputs:length = 5\n    float inputs:radius = 2",
        5 * A * 2 * PERIMETER,
    ),
]


@pytest.mark.parametrize(("kind", "code", "size", "area"), SCALED)
def test_normalize_divides_by_the_area_in_the_world(tmp_path, kind, code, size, area):
    """Under a non-uniform scale the radiance is intensity · 2^exposure, over the world-space area if normalized."""
    text = f"{size}\n    float inputs:intensity = 3\n    float inputs:exposure = 2\n{SCALE}\n"
    plain = load(tmp_path, light_text(kind, text)).lights[0]
    assert plain.kind == code and plain.radiance == (12.0, 12.0, 12.0)
    assert np.diag(plain.world_from_light).tolist() == [A, B, C, 1.0]
    normalized = load(tmp_path, light_text(kind, text + "    bool inputs:normalize = true")).lights[0]
    assert normalized.radiance == pytest.approx(np.full(3, 12.0 / area))


@pytest.mark.parametrize(
    ("kind", "area"),
    [("RectLight", 1), ("DiskLight", math.pi / 4), ("SphereLight", math.pi), ("CylinderLight", math.pi)],
)
def test_the_sizes_of_the_schema(tmp_path, kind, area):
    """Unauthored, a light is 1 wide, has the radius 0.5 and emits radiance 1 (normalized: 1 / area)."""
    assert load(tmp_path, light_text(kind)).lights[0].radiance == (1.0, 1.0, 1.0)
    normalized = load(tmp_path, light_text(kind, "bool inputs:normalize = true")).lights[0]
    assert normalized.radiance == pytest.approx(np.full(3, 1 / area))


def test_a_sheared_rectangle_has_the_area_of_its_parallelogram(tmp_path):
    """The area of a rectangle is the length of the cross product of its transformed edges."""
    more = """matrix4d xformOp:transform = ((1, 0, 0, 0), (1, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))
    uniform token[] xformOpOrder = ["xformOp:transform"]
    bool inputs:normalize = true"""
    light = load(tmp_path, light_text("RectLight", more)).lights[0]
    assert light.radiance == pytest.approx((1.0, 1.0, 1.0)) and light.world_from_light[0, 1] == 1.0


def test_colour_temperature_and_diffuse_multiply(tmp_path):
    """L = intensity · color · blackbody (only if enabled, clamped to 10000 K) · diffuse."""
    more = "color3f inputs:color = (1, 0.5, 0)\n float inputs:diffuse = 0.5\n float inputs:colorTemperature = 2000\n"
    assert load(tmp_path, light_text("RectLight", more)).lights[0].radiance == (0.5, 0.25, 0.0)
    more += "bool inputs:enableColorTemperature = true"
    warm = load(tmp_path, light_text("RectLight", more)).lights[0].radiance
    assert warm == pytest.approx((0.5 * 2.521, 0.25 * 0.647, 0.0), abs=1e-3)
    hot, clamped = (
        load(tmp_path, light_text("RectLight", more.replace("2000", kelvin))).lights[0].radiance
        for kelvin in ("10000", "99999")
    )
    assert hot == clamped


@pytest.mark.parametrize(("angle", "factor"), [
    (0.53, math.pi * math.sin(math.radians(0.265)) ** 2),
    (180.0, math.pi),
    (270.0, 1.5 * math.pi),
    (360.0, 2 * math.pi),
    (720.0, 2 * math.pi),
    (0.0, 1.0),
    (-5.0, 1.0),
])  # fmt: skip
def test_a_normalized_distant_light_is_in_lux(tmp_path, angle, factor):
    """Normalized, intensity is the irradiance of a facing surface: L times its projected solid angle, at any angle."""
    more = f"float inputs:angle = {angle}\n    float inputs:intensity = 7\n    bool inputs:normalize = true"
    light = load(tmp_path, light_text("DistantLight", more)).lights[0]
    assert np.array(light.radiance) * factor == pytest.approx([7.0, 7.0, 7.0])
    assert light.angle == pytest.approx(min(max(angle, 0.0), 360.0))


def test_a_hardly_wider_than_parallel_sun_is_parallel(tmp_path):
    """Below 1e-5 degrees the radiance would overflow: the irradiance is given instead."""
    more = "float inputs:angle = 1e-30\n    float inputs:intensity = 7\n    bool inputs:normalize = true"
    light = load(tmp_path, light_text("DistantLight", more)).lights[0]
    assert light.angle == 0.0 and light.radiance == (7.0, 7.0, 7.0)


def test_the_default_sun(tmp_path):
    """A DistantLight without any opinion gives a white facing surface the radiance 1.0696."""
    light = load(tmp_path, light_text("DistantLight")).lights[0]
    assert light.radiance[0] == 50000.0
    assert light.radiance[0] * math.sin(math.radians(light.angle / 2)) ** 2 == pytest.approx(1.0696, abs=1e-4)


@pytest.mark.parametrize("kind", ["DomeLight", "DomeLight_1"])
def test_a_dome_ignores_normalize(tmp_path, kind):
    """A dome's radiance is its intensity."""
    more = "float inputs:intensity = 2\n    bool inputs:normalize = true"
    light = load(tmp_path, light_text(kind, more)).lights[0]
    assert light.kind == LightKind.DOME and light.radiance == (2.0, 2.0, 2.0)


def test_a_point_light_is_the_limit_of_a_small_sphere(tmp_path):
    """With treatAsPoint a light keeps the sphere's intensity L π r²; normalized, it is L / 4."""
    text = "bool treatAsPoint = true\n    float inputs:radius = 0.1\n    float inputs:intensity = 8\n"
    light = load(tmp_path, light_text("SphereLight", text)).lights[0]
    assert light.kind == LightKind.POINT and light.radiance == pytest.approx(np.full(3, 8 * math.pi * 0.01))
    light = load(tmp_path, light_text("SphereLight", text + "bool inputs:normalize = true")).lights[0]
    assert light.radiance == pytest.approx((2.0, 2.0, 2.0))


def test_a_sphere_of_radius_zero_still_shines(tmp_path):
    """Radius 0 is a point with the intensity L / 4; unless normalized that is a guess, and said."""
    text = "float inputs:radius = 0\n    float inputs:intensity = 8\n"
    scene = load(tmp_path, light_text("SphereLight", text))
    assert scene.lights[0].kind == LightKind.POINT and scene.lights[0].radiance == (2.0, 2.0, 2.0)
    assert warned(scene, "/L", "radius 0")
    scene = load(tmp_path, light_text("SphereLight", text + "bool inputs:normalize = true"))
    assert scene.lights[0].radiance == (2.0, 2.0, 2.0) and not warned(scene, "/L")


def test_a_line_light_keeps_its_power(tmp_path):
    """With treatAsLine a light is so thin a cylinder that nobody can tell, with the same radiance times area."""
    text = "bool treatAsLine = true\n    float inputs:length = 3\n    float inputs:radius = 0.5\n"
    scene = load(tmp_path, light_text("CylinderLight", text))
    light = scene.lights[0]
    assert scene.warnings == ("/: the stage draws no geometry",) and light.radius < 0.001
    assert light.radiance[0] * 2 * math.pi * light.radius * 3 == pytest.approx(2 * math.pi * 0.5 * 3)
    text += "bool inputs:normalize = true"
    light = load(tmp_path, light_text("CylinderLight", text)).lights[0]
    assert light.radiance[0] * 2 * math.pi * light.radius * 3 == pytest.approx(1.0)


def test_a_light_without_area_is_dropped(tmp_path):
    """A rectangle of width 0 emits nothing; that is said and counted."""
    scene = load(tmp_path, light_text("RectLight", "float inputs:width = 0"))
    assert scene.lights == () and warned(scene, "/L", "no area") and scene.stats["lights_without_emission"] == 1


def test_lights_that_emit_nothing_are_counted(tmp_path):
    """Intensity 0 drops a light silently if there are others, black does too, negative emission with a warning."""
    sun = '\ndef DistantLight "Sun" {\n}\n'
    scene = load(tmp_path, light_text("RectLight", "float inputs:intensity = 0") + sun)
    assert len(scene.lights) == 1 and scene.stats["lights_without_emission"] == 1 and not warned(scene, "/L")
    scene = load(tmp_path, light_text("RectLight", "float inputs:intensity = -1"))
    assert scene.lights == () and warned(scene, "/L", "negative")


TINY = "inputs:radius = 1e-30\n    bool inputs:normalize = true"


@pytest.mark.parametrize(
    "bad", ["inputs:intensity = nan", "inputs:intensity = inf", "inputs:exposure = 1e9", "inputs:radius = nan", TINY]
)
def test_absurd_inputs_skip_the_light(tmp_path, bad):
    """A light whose emission or size is not finite is named and skipped."""
    scene = load(tmp_path, light_text("SphereLight", f"float {bad}"))
    assert scene.lights == () and warned(scene, "/L", "skipped")


def test_products_beyond_float32_skip_the_light(tmp_path):
    """Each factor alone would do: a texture times an intensity, a material's emission times a light's."""
    write_image(tmp_path / "t.exr", np.full((1, 1, 3), 1e11, np.float32), "float")
    more = "asset inputs:texture:file = @t.exr@\n    float inputs:intensity = 1e25"
    for kind in ("RectLight", "DomeLight"):
        scene = load(tmp_path, light_text(kind, more))
        assert scene.lights == () and warned(scene, "/L", "exceeds 1e+30; the light is skipped")
    glow = stages.material_text("color3f inputs:emissiveColor = (1e20, 1e20, 1e20)")
    panel = stages.mesh("float inputs:intensity = 1e20").replace(
        '"MaterialBindingAPI"', '"MaterialBindingAPI", "MeshLightAPI"'
    )
    scene = load(tmp_path, glow + panel)
    assert max(max(m.emission) for m in scene.materials) == pytest.approx(1e20)
    assert warned(scene, "/M", "exceeds 1e+30; it does not emit as a light")


def test_inputs_without_prefix_are_read(tmp_path):
    """Files from before 21.02 have plain names; authored inputs: win."""
    scene = load(tmp_path, light_text("DistantLight", "float intensity = 3000"))
    assert scene.lights[0].radiance[0] == 3000.0 and warned(scene, "/L", "legacy inputs")
    scene = load(tmp_path, light_text("SphereLight", "float radius = 3\n float inputs:radius = 2"))
    assert scene.lights[0].radius == 2.0 and not warned(scene, "/L")


def test_inputs_may_be_connected_to_interfaces(tmp_path):
    """A connection to an input of another prim gives its value; one to a shader is named, and the own value counts."""
    text = """def Material "Rig" {
    float inputs:dimmer = 7
}
def Shader "Noise" {
    color3f outputs:rgb
}
def SphereLight "L" {
    float inputs:intensity = 1
    float inputs:intensity.connect = </Rig.inputs:dimmer>
    color3f inputs:color = (1, 0.5, 0.25)
    color3f inputs:color.connect = </Noise.outputs:rgb>
}
"""
    scene = load(tmp_path, text)
    assert scene.lights[0].radiance == (7.0, 3.5, 1.75)
    assert warned(scene, "/L", "inputs:color", "shader") and not warned(scene, "intensity")


SHAPED = '(prepend apiSchemas = ["ShapingAPI"])'
SHADOWS = '(prepend apiSchemas = ["ShadowAPI"])'


@pytest.mark.parametrize(
    ("kind", "head", "more", "word"),
    [
        ("SphereLight", SHAPED, "asset inputs:shaping:ies:file = @nowhere.ies@", "not found"),
        ("DomeLight", SHAPED, "float inputs:shaping:focus = 2", "shaping does not apply"),
        ("RectLight", "", "asset inputs:texture:file = @nowhere.png@", "not found"),
        ("DomeLight", "", "asset inputs:texture:file = @nowhere.exr@", "constant colour"),
        ("DiskLight", "", "asset inputs:texture:file = @a.png@", "only RectLight and DomeLight"),
        ("RectLight", SHADOWS, "color3f inputs:shadow:color = (1, 0, 0)", "shadows are not supported"),
        ("RectLight", "", "rel light:filters = </L>", "filters"),
        ("RectLight", "", "rel filters = </L>", "filters"),
        ("PortalLight", "", "", "portals"),
        ("GeometryLight", "", "", "geometry"),
        ("PluginLight", "", "", "PluginLight"),
        ("LightFilter", "", "", "light filters are not supported"),
        ("RenderPass", "", "", "no render pass is selected"),
        (
            "DomeLight",
            "",
            'asset inputs:texture:file = @nowhere.exr@\ntoken inputs:texture:format = "odd"',
            "is unknown; it is read as latlong",
        ),
    ],
)
def test_what_is_not_honoured_is_named(tmp_path, kind, head, more, word):
    """Each feature that the picture will lack is a warning with the light's path."""
    assert warned(load(tmp_path, light_text(kind, more, head)), "/L", word)


def test_portals_cost_no_word(tmp_path):
    """The portals of a dome would guide its sampling, no more: its light is the same without."""
    scene = load(tmp_path, light_text("DomeLight", "rel portals = </L>"))
    assert len(scene.lights) == 1 and not warned(scene, "/L")


@pytest.mark.parametrize("prefix", ["inputs:", ""])
def test_shaping_needs_its_schema(tmp_path, prefix):
    """Inputs of ShapingAPI without the schema are only attributes: the light shines to all sides, and that is said."""
    more = f"float {prefix}shaping:cone:angle = 30\nfloat {prefix}shaping:focus = 2"
    scene = load(tmp_path, light_text("SphereLight", more))
    assert scene.lights[0].shaping is None
    assert warned(scene, "/L", "shaping:cone:angle, shaping:focus: ignored, since ShapingAPI is not applied")


def shaping(folder, kind, more):
    return load(folder, light_text(kind, more, SHAPED)).lights[0].shaping


def test_shaping_is_read(tmp_path):
    """Cone, softness, focus and its tint, clamped to their ranges; applied alone, the schema is a cone of 90°."""
    assert shaping(tmp_path, "SphereLight", "").cone_angle == 90.0
    text = """float inputs:shaping:cone:angle = 30
    float inputs:shaping:cone:softness = 1.5
    float inputs:shaping:focus = 4
    color3f inputs:shaping:focusTint = (0.5, 0, -1)"""
    read = shaping(tmp_path, "RectLight", text)
    assert (read.cone_angle, read.cone_softness, read.focus, read.focus_tint) == (30.0, 1.0, 4.0, (0.5, 0.0, 0.0))


@pytest.mark.parametrize(
    ("kind", "more"),
    [
        ("RectLight", ""),
        ("DistantLight", ""),
        ("SphereLight", "float inputs:shaping:cone:angle = 180\n float inputs:shaping:focus = -2"),
        ("DomeLight", ""),
    ],
)
def test_shaping_without_effect_is_none(tmp_path, kind, more):
    """A cone that covers all directions of emission changes nothing and costs nothing."""
    scene = load(tmp_path, light_text(kind, more, SHAPED))
    assert scene.lights[0].shaping is None and not warned(scene, "/L")


IES = "asset inputs:shaping:ies:file = @./lamp.ies@\n    float inputs:shaping:cone:angle = 180\n    "


def profile(folder, content, more=""):
    (folder / "lamp.ies").write_text(content)
    return shaping(folder, "SphereLight", IES + more).profile


def test_photometry_is_read(tmp_path):
    """Candela over polar angle, linear between the file's angles and nothing beyond them, times the multiplier."""
    table = profile(tmp_path, photometry([0, 30, 90], [0], [[100, 40, 10]], factor=2.0))
    assert table.shape[1] == 1
    theta = (np.arange(len(table)) + 0.5) * 180.0 / len(table)
    expected = np.where(theta < 90.0, 2.0 * np.interp(theta, [0, 30, 90], [100, 40, 10]), 0.0)
    np.testing.assert_allclose(table[:, 0], expected)
    tilted = photometry([0, 30, 90], [0], [[200, 80, 20]], head="TILT=INCLUDE\n1\n2\n0 90\n1 0.5")
    np.testing.assert_allclose(profile(tmp_path, tilted), table)


@pytest.mark.parametrize(
    ("horizontal", "at", "same"),
    [
        ([0, 45, 90], 10.0, [170.0, 190.0, 350.0]),
        ([0, 90, 180], 100.0, [260.0]),
        ([90, 180, 270], 100.0, [80.0]),
        ([0, 120, 240, 360], 10.0, []),
    ],
)
def test_symmetric_photometry_goes_all_round(tmp_path, horizontal, at, same):
    """A quadrant, half a turn and the half from 90° to 270° are mirrored; columns count from 0°."""
    rows = [[10.0 * (k + 1), 1.0] for k in range(len(horizontal))]
    if horizontal[-1] == 360:
        rows[-1] = rows[0]
    table = profile(tmp_path, photometry([0, 90], horizontal, rows))

    def value(phi):
        return table[0, int(phi / 360.0 * table.shape[1])]

    folded = next((p for p in (at, *same) if horizontal[0] <= p <= horizontal[-1]), at)
    middle = (int(folded / 360.0 * table.shape[1]) + 0.5) * 360.0 / table.shape[1]
    expected = np.interp(middle, horizontal, [r[0] for r in rows])
    assert value(folded) == pytest.approx(expected, rel=5e-3)
    # The middle of a mirrored column is off by up to a column's width.
    assert all(value(p) == pytest.approx(value(at), rel=0.05) for p in same)


@pytest.mark.parametrize(("kind", "plane"), [(2, "B"), (3, "A")])
def test_photometry_of_headlamps_and_floodlights(tmp_path, kind, plane):
    """Types A and B count from the aim, to the right (+X) and up (+Y): A around the vertical axis, B the horizontal.

    Candela 200 + 2 h + v, linear in both angles, so that interpolation is exact; directions from their definitions.
    """
    h, v = [-90, -30, 0, 90], [-90, 0, 45, 90]
    table = profile(tmp_path, photometry(v, h, [[300 + 2 * x + y for y in v] for x in h], kind=kind))
    rows, columns = table.shape
    for across, above in ((0.0, 40.0), (-50.0, 0.0), (30.0, 60.0), (20.0, -70.0)):
        a, b = np.radians(across), np.radians(above)
        direction = (np.sin(a) * np.cos(b), np.sin(b), np.cos(a) * np.cos(b))
        if plane == "B":
            direction = (np.sin(a), np.cos(a) * np.sin(b), np.cos(a) * np.cos(b))
        theta = np.degrees(np.arccos(direction[2]))
        phi = np.degrees(np.arctan2(direction[1], direction[0])) % 360.0
        found = table[int(theta / 180.0 * rows), int(phi / 360.0 * columns)]
        assert found == pytest.approx(300 + 2 * across + above, abs=3.0)  # half a cell of 0.25° and 1° away
    assert (table[rows // 2 :] == 0.0).all()
    # From 0° alone, both sides are the same.
    half = profile(tmp_path, photometry([0, 90], [0, 90], [[100, 10], [10, 1]], kind=kind))
    np.testing.assert_allclose(half, half[:, ::-1], atol=1e-9)
    np.testing.assert_allclose(half, np.roll(half[:, ::-1], columns // 2, axis=1), atol=1e-9)


def test_photometry_scales_and_normalizes(tmp_path):
    """An angleScale of 1/2 narrows the beam to half its angle; normalized, the mean over the (hemi)sphere is 1."""
    file = photometry([0, 60, 60.001, 90], [0], [[100, 100, 0, 0]])
    wide = profile(tmp_path, file)
    narrow = profile(tmp_path, file, "float inputs:shaping:ies:angleScale = 0.5")
    assert (wide > 50).sum() == pytest.approx(60 / 180 * len(wide), abs=1)
    assert (narrow > 50).sum() == pytest.approx(30 / 180 * len(wide), abs=1)
    up = photometry([90, 120, 120.001, 180], [0], [[0, 0, 100, 100]])
    assert (profile(tmp_path, up) > 50).sum() == pytest.approx(60 / 180 * len(wide), abs=1)
    narrow = profile(tmp_path, up, "float inputs:shaping:ies:angleScale = -0.5")
    assert (narrow > 50).sum() == pytest.approx(30 / 180 * len(wide), abs=1) and narrow[-1, 0] == pytest.approx(100)
    # About the other pole, θ_ies = 2 θ - 180°, and no less than 0: bright up to θ = 120°.
    spread = profile(tmp_path, file, "float inputs:shaping:ies:angleScale = -0.5")
    assert (spread > 50).sum() == pytest.approx((90 + 30) / 180 * len(wide), abs=1) and spread[0, 0] == 100
    none = light_text("SphereLight", IES + "float inputs:shaping:ies:angleScale = 1e-15", SHAPED)
    assert warned(load(tmp_path, none), "/L", "the profile is 0 with this angleScale")
    # 100 cd in a cone of 60°: 100 · 2π (1 - cos 60°) / 2π = 50 in the mean of the hemisphere.
    assert profile(tmp_path, file, "bool inputs:shaping:ies:normalize = true").max() == pytest.approx(2.0, rel=5e-3)


@pytest.mark.parametrize(
    "content",
    [
        "",
        "IESNA:LM-63-2002\nTILT=NONE\n1 2 3",
        "TILT=NONE\n1 1000 1 99999999 99999999 1 2 0 0 0\n1 1 1\n0",
        "TILT=NONE\n1 1000 1 -3 1 1 2 0 0 0\n1 1 1\n0",
        photometry([0, 90], [0], [["nan", 1]]),
        photometry([90, 0], [0], [[1, 1]]),
        photometry([0, 90], [0], [["many", 1]]),
        photometry([0, 90], [0], [[1, 1]], kind=4),
        photometry([-90, 91], [0], [[1, 1]], kind=2),
        photometry([-1, 90], [0], [[1, 1]]),
        "\x00\xff" * 100,
    ],
)
def test_bad_photometry_is_named(tmp_path, content):
    """A file that is no photometry leaves the light unshaped, and says so."""
    (tmp_path / "lamp.ies").write_text(content)
    scene = load(tmp_path, light_text("SphereLight", IES, SHAPED))
    assert scene.lights[0].shaping is None and warned(scene, "/L", "lamp.ies")


def test_textures_are_read(tmp_path):
    """The file's linear values multiply the radiance; row 0 is the top of the image; 8 bits are sRGB."""
    pixels = np.arange(24, dtype=np.float32).reshape(2, 4, 3) - 3.0
    write_image(tmp_path / "t.exr", pixels)
    write_image(tmp_path / "t.png", np.full((1, 1, 3), 188, np.uint8))
    for kind in ("RectLight", "DomeLight", "DomeLight_1"):
        light = load(tmp_path, light_text(kind, "asset inputs:texture:file = @./t.exr@")).lights[0]
        np.testing.assert_array_equal(light.texture, np.maximum(pixels, 0.0))
        light = load(tmp_path, light_text(kind, "asset inputs:texture:file = @./t.png@")).lights[0]
        np.testing.assert_allclose(light.texture, 0.5029, atol=1e-4)


@pytest.mark.parametrize(
    ("kind", "axis", "pole", "up"),
    [
        ("DomeLight", "Z", "", (0, 1, 0)),
        ("DomeLight_1", "Z", "", (0, 0, 1)),
        ("DomeLight_1", "Y", "", (0, 1, 0)),
        ("DomeLight_1", "Y", "Z", (0, 0, 1)),
        ("DomeLight_1", "Z", "Y", (0, 1, 0)),
    ],
)
def test_the_pole_of_a_dome(tmp_path, kind, axis, pole, up):
    """A DomeLight's pole is +Y in any stage; a DomeLight_1's is the stage's up axis unless poleAxis says otherwise."""
    write_image(tmp_path / "t.exr", np.ones((2, 4, 3), np.float32))
    more = "asset inputs:texture:file = @./t.exr@\n" + (f'uniform token poleAxis = "{pole}"' if pole else "")
    scene = load(tmp_path, light_text(kind, more).join([f'(upAxis = "{axis}")\n', ""]))
    matrix = scene.lights[0].world_from_light
    np.testing.assert_allclose(matrix[:3, 1], up, atol=1e-12)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1.0)
    if up == (0, 0, 1):  # (x, y, z) → (x, z, -y): the middle of the texture, local +Z, lies along -Y
        np.testing.assert_allclose(matrix[:3, 2], (0, -1, 0), atol=1e-12)


@pytest.mark.parametrize("layout", ["angular", "mirroredBall", "cubeMapVerticalCross"])
def test_layouts_of_domes(tmp_path, layout):
    """A sky of L = 2 + d · (0.5, 1, 0.2) in any layout becomes the lat-long sky of the same radiance.

    Half a pixel of 200 or so is 0.016 rad at most; the back of a mirrored ball, compressed into its rim, is left out.
    """
    slope = np.array([0.5, 1.0, 0.2])
    d = sky_directions(layout, 100 if layout == "cubeMapVerticalCross" else 256)
    sky = np.nan_to_num(2.0 + d @ slope, nan=7.0)
    write_image(tmp_path / "t.exr", np.repeat(sky[:, :, None], 3, axis=2).astype(np.float32))
    more = f'asset inputs:texture:file = @./t.exr@\ntoken inputs:texture:format = "{layout}"'
    scene = load(tmp_path, light_text("DomeLight", more))
    assert not warned(scene, "/L")
    texture = scene.lights[0].texture
    height, width = texture.shape[:2]
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    around, polar = (0.5 - u) * 2.0 * np.pi, v * np.pi
    shown = np.stack([np.sin(polar) * np.sin(around), np.cos(polar), np.sin(polar) * np.cos(around)], axis=-1)
    well = shown[..., 2] > -0.95
    np.testing.assert_allclose(texture[..., 0][well], (2.0 + shown @ slope)[well], atol=0.02)


def test_a_cross_of_another_shape_is_named(tmp_path):
    """An image that is not 3 x 4 faces is no vertical cross."""
    write_image(tmp_path / "t.exr", np.ones((8, 8, 3), np.float32))
    more = 'asset inputs:texture:file = @./t.exr@\ntoken inputs:texture:format = "cubeMapVerticalCross"'
    assert warned(load(tmp_path, light_text("DomeLight", more)), "/L", "no vertical cross")


def test_shadows_can_be_switched_off(tmp_path):
    """ShadowAPI's enable; without the schema it does not count, and is named."""
    off = "bool inputs:shadow:enable = 0"
    scene = load(tmp_path, light_text("RectLight", off, SHADOWS))
    assert not scene.lights[0].shadows and not warned(scene, "/L")
    scene = load(tmp_path, light_text("RectLight", off))
    assert scene.lights[0].shadows and warned(scene, "/L", "ShadowAPI is not applied")


LINKED = """
def Xform "Geom" {
    def Cube "a" {}
    def Cube "b" {}
    def Xform "c" {
        def Cube "inner" {}
    }
}
"""


@pytest.mark.parametrize(
    ("more", "unlit", "shadowless"),
    [
        ("", set(), set()),
        (
            "uniform bool collection:lightLink:includeRoot = 0\n rel collection:lightLink:includes = </Geom/a>",
            {1, 2},
            (),
        ),
        ("rel collection:lightLink:excludes = </Geom/c>", {2}, set()),
        ("rel collection:shadowLink:excludes = [</Geom/a>, </Geom/b>]", set(), {0, 1}),
        ("uniform bool collection:lightLink:includeRoot = 0", {0, 1, 2}, set()),
        ('uniform token collection:lightLink:expansionRule = "explicitOnly"', {0, 1, 2}, set()),
        ("rel collection:lightLink:includes = </Geom/a>", set(), set()),
    ],
)
def test_links_are_read(tmp_path, more, unlit, shadowless):
    """The meshes outside the lightLink collection are not lit, those outside shadowLink cast no shadow."""
    scene = load(tmp_path, light_text("SphereLight", more) + LINKED)
    assert [m.name for m in scene.meshes] == ["/Geom/a", "/Geom/b", "/Geom/c/inner"]
    assert scene.lights[0].unlit == frozenset(unlit) and scene.lights[0].shadowless == frozenset(shadowless)
    assert not warned(scene, "link")


def test_links_by_expressions(tmp_path):
    """Two lights with expressions of their own light what these match, and no other's."""
    expression = "uniform bool collection:lightLink:includeRoot = 0\n"
    expression += 'uniform pathExpression collection:lightLink:membershipExpression = "/Geom/{}"'
    first = light_text("SphereLight", expression.format("a"))
    second = light_text("SphereLight", expression.format("/inner")).replace('"L"', '"K"')
    scene = load(tmp_path, first + second + LINKED)
    assert [light.unlit for light in scene.lights] == [{1, 2}, {0, 1}]


def test_links_to_parts_of_meshes_are_named(tmp_path):
    """A link that tells face subsets of a mesh apart is not followed into the mesh, and said."""
    more = (
        "uniform bool collection:lightLink:includeRoot = 0\n rel collection:lightLink:includes = [</M/left>, </Geom/a>]"
    )
    subset = 'def Cube "M" {\n def GeomSubset "left" {\n int[] indices = [0]\n}\n}\n'
    scene = load(tmp_path, light_text("SphereLight", more) + subset + LINKED)
    assert scene.lights[0].unlit == frozenset({0, 2, 3}) and warned(scene, "/L", "links to GeomSubsets")


def test_lights_of_instanced_prototypes(tmp_path):
    """Each instance of a point instancer has its light, and normalize sees each one's scale."""
    text = """def PointInstancer "I" {
    rel prototypes = </I/P>
    int[] protoIndices = [0, 0]
    point3f[] positions = [(0, 0, 0), (5, 0, 0)]
    float3[] scales = [(1, 1, 1), (2, 2, 2)]
    def Xform "P" {
        def RectLight "L" {
            bool inputs:normalize = true
        }
    }
}"""
    scene = load(tmp_path, text)
    assert [light.radiance[0] for light in scene.lights] == [1.0, 0.25] and not warned(scene, "/I")
    assert [light.world_from_light[0, 3] for light in scene.lights] == [0.0, 5.0]


def test_geometry_lights(tmp_path):
    """The deprecated GeometryLight makes the gprim emit to which it refers."""
    text = """def GeometryLight "L" {
    rel geometry = </S>
    float inputs:intensity = 3
}
def Sphere "S" {}
def Sphere "T" {}
"""
    scene = load(tmp_path, text)
    glow = {mesh.name: scene.materials[mesh.material[0]].emission for mesh in scene.meshes}
    assert glow == {"/S": (3.0, 3.0, 3.0), "/T": (0.0, 0.0, 0.0)} and not warned(scene, "/L")


def test_geometry_lights_may_change(tmp_path):
    """Their inputs, and the transform that is the axis of their shaping, are read anew at every time."""
    text = """def GeometryLight "L" (prepend apiSchemas = ["ShapingAPI"]) {
    rel geometry = </S>
    float inputs:intensity.timeSamples = { 0: 1, 2: 5 }
    double3 xformOp:translate.timeSamples = { 0: (0, 0, 0), 2: (4, 0, 0) }
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
def Sphere "S" {
}
"""
    (tmp_path / "a.usda").write_text("#usda 1.0\n" + text)
    reader = StageReader(tmp_path / "a.usda")
    for time in (0.0, 1.0, 2.0):
        (mesh,) = (scene := reader.read(time)).meshes
        assert scene.materials[mesh.material[0]].emission[0] == pytest.approx(1.0 + 2.0 * time)
        assert mesh.light.name == "/L" and mesh.light.world_from_light[0, 3] == pytest.approx(2.0 * time)


MESH_LIGHT = """def Mesh "M" (prepend apiSchemas = ["%s"]) {
    point3f[] points = [(0, 0, 0), (2, 0, 0), (2, 3, 0), (0, 3, 0)]
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    uniform token subdivisionScheme = "none"
    float inputs:intensity = 12
    %s
}
def Material "Glow" {
    token outputs:surface.connect = </Glow/S.outputs:surface>
    def Shader "S" {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor = (0.5, 0.5, 0.5)
        color3f inputs:emissiveColor = (1, 0.5, 0)
        token outputs:surface
    }
}
"""
BIND = "rel material:binding = </Glow>\n    "


@pytest.mark.parametrize(
    ("more", "emission", "albedo"),
    [
        ("", (12, 12, 12), 0.18),
        (BIND, (12, 6, 0), 0.5),
        (BIND + 'uniform token light:materialSyncMode = "noMaterialResponse"', (12, 12, 12), 0.0),
        (BIND + 'uniform token light:materialSyncMode = "independent"', (12, 12, 12), 0.5),
        ("bool inputs:normalize = true", (2, 2, 2), 0.18),
    ],
)
def test_a_mesh_light_is_an_emissive_surface(tmp_path, more, emission, albedo):
    """MeshLightAPI emits its light, tinted by the material's glow or not as materialSyncMode says."""
    scene = load(tmp_path, MESH_LIGHT % ("MeshLightAPI", more))
    (material,) = scene.materials
    assert material.emission == pytest.approx(emission) and material.albedo[0] == pytest.approx(albedo)
    assert scene.lights == () and not scene.meshes[0].double_sided


@pytest.mark.parametrize(
    ("mode", "more", "glow"),
    [
        ("independent", "", (1.0, 0.5, 0.0)),
        ("materialGlowTintsLight", "", (1.0, 0.5, 0.0)),
        ("materialGlowTintsLight", "float inputs:exposure = -2\n float inputs:intensity = 4", None),
        ("noMaterialResponse", "", None),
    ],
)
def test_the_camera_sees_the_material_and_not_the_light(tmp_path, mode, more, glow):
    """The schema: all rays "see the emissive/glow response as dictated by the bound Material", unless it is ignored.

    A light of radiance 1 that a material tints is what the material is.
    """
    more += f'\n{BIND}uniform token light:materialSyncMode = "{mode}"'
    text = MESH_LIGHT.replace("float inputs:intensity = 12", "") if "intensity" in more else MESH_LIGHT
    (material,) = load(tmp_path, text % ("MeshLightAPI", more)).materials
    assert material.glow == glow


def test_mesh_lights_have_shaping_links_and_shadows(tmp_path):
    """ShapingAPI, ShadowAPI and the links of a surface that emits are read as those of any light, without a word."""
    more = """bool inputs:shadow:enable = false
    float inputs:shaping:cone:angle = 20
    float inputs:shaping:focus = 3
    rel collection:lightLink:excludes = [</N>]
    rel collection:shadowLink:excludes = [</M>]
    double3 xformOp:translate = (0, 0, 5)
    uniform token[] xformOpOrder = ["xformOp:translate"]"""
    apis = 'MeshLightAPI", "ShapingAPI", "ShadowAPI'
    scene = load(tmp_path, MESH_LIGHT % (apis, more) + 'def Sphere "N" {}\n')
    light = scene.meshes[0].light
    assert light.shaping.cone_angle == 20.0 and light.shaping.focus == 3.0 and not light.shadows
    assert light.unlit == {1} and light.shadowless == {0} and scene.meshes[1].light is None
    assert light.world_from_light[2, 3] == 5.0 and not warned(scene, "/M")


def test_places_of_a_mesh_light_that_differ_are_told_apart(tmp_path):
    """Every copy of a shaped light has its axis; of a normalized one its radiance, by its own area."""
    text = """def Xform "P" {
    def Mesh "M" (prepend apiSchemas = ["MeshLightAPI"%s]) {
        point3f[] points = [(0, 0, 0), (2, 0, 0), (2, 3, 0), (0, 3, 0)]
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        uniform token subdivisionScheme = "none"
        float inputs:intensity = 12
        bool inputs:normalize = true
    }
}
def PointInstancer "I" {
    rel prototypes = </P>
    int[] protoIndices = [0, 0]
    point3f[] positions = [(0, 0, 0), (10, 0, 0)]
    float3[] scales = [(1, 1, 1), %s]
    quath[] orientations = [(1, 0, 0, 0), (0, 1, 0, 0)]
}
"""
    alike = load(tmp_path, text % ("", "(1, 1, 1)"))
    assert [len(mesh.triangles) for mesh in alike.meshes] == [2, 4]
    scaled = load(tmp_path, text % ("", "(2, 2, 2)"))
    emission = [scaled.materials[mesh.material[0]].emission[0] for mesh in scaled.meshes]
    assert emission == pytest.approx([2.0, 2.0, 0.5])
    shaped = load(tmp_path, text % (', "ShapingAPI"', "(1, 1, 1)"))
    assert [mesh.light.world_from_light[2, 2] for mesh in shaped.meshes] == pytest.approx([1.0, 1.0, -1.0])


def test_textures_of_mesh_lights(tmp_path):
    """texture:file multiplies the emission and is placed by the mesh's st."""
    pixels = np.zeros((2, 2, 3), np.float32)
    pixels[0, 1] = (1.0, 0.5, 0.25)
    write_image(tmp_path / "t.exr", pixels)
    more = """asset inputs:texture:file = @t.exr@
    texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = "vertex")"""
    scene = load(tmp_path, MESH_LIGHT % ("MeshLightAPI", more))
    texture = scene.materials[0].emission_texture
    np.testing.assert_allclose(texture.pixels, 12.0 * pixels, rtol=1e-3)
    np.testing.assert_array_equal(scene.meshes[0].uvs[texture.uv][0], [(0, 0), (1, 0), (1, 1)])
    assert not warned(scene, "/M")
    scene = load(tmp_path, MESH_LIGHT % ("MeshLightAPI", "asset inputs:texture:file = @t.exr@"))
    assert warned(scene, "/M", "no primvar 'st'")


def test_any_gprim_can_be_a_light(tmp_path):
    """LightAPI on a Sphere: its radius is geometry, its surface emits and answers with no material."""
    text = 'def Sphere "S" (prepend apiSchemas = ["LightAPI"]) { double radius = 2\n float inputs:intensity = 3\n}'
    scene = load(tmp_path, text)
    assert scene.materials[0].emission == (3, 3, 3) and scene.materials[0].albedo == (0, 0, 0)
    assert np.abs(scene.meshes[0].points).max() == 2.0 and not warned(scene, "legacy inputs")
