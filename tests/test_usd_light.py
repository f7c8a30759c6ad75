"""UsdLux radiometry against its closed forms."""

import math
from pathlib import Path

import numpy as np
import pytest

from warp_ir import LightKind, Scene, load_usd


def load(folder: Path, text: str, **options: object) -> Scene:
    file = folder / "stage.usda"
    file.write_text("#usda 1.0\n" + text)
    return load_usd(file, default_light="none", **options)


def warned(scene: Scene, *words: str) -> bool:
    return any(all(word in line for word in words) for line in scene.warnings)


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
    """A light with treatAsLine becomes a thin cylinder with the same radiance times area."""
    text = "bool treatAsLine = true\n    float inputs:length = 3\n    float inputs:radius = 0.5\n"
    scene = load(tmp_path, light_text("CylinderLight", text))
    light = scene.lights[0]
    assert warned(scene, "/L", "line") and light.radius < 0.01
    assert light.radiance[0] * 2 * math.pi * light.radius * 3 == pytest.approx(2 * math.pi * 0.5 * 3)


def test_a_light_without_area_is_dropped(tmp_path):
    """A rectangle of width 0 emits nothing; that is said and counted."""
    scene = load(tmp_path, light_text("RectLight", "float inputs:width = 0"))
    assert scene.lights == () and warned(scene, "/L", "no area") and scene.stats["lights_without_emission"] == 1


def test_lights_that_emit_nothing_are_counted(tmp_path):
    """Intensity 0 drops a light silently, black does too, negative emission with a warning."""
    scene = load(tmp_path, light_text("RectLight", "float inputs:intensity = 0"))
    assert scene.lights == () and scene.stats["lights_without_emission"] == 1 and not warned(scene, "/L")
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


def test_inputs_without_prefix_are_read(tmp_path):
    """Files from before 21.02 have plain names; authored inputs: win."""
    scene = load(tmp_path, light_text("DistantLight", "float intensity = 3000"))
    assert scene.lights[0].radiance[0] == 3000.0 and warned(scene, "/L", "old style")
    scene = load(tmp_path, light_text("SphereLight", "float radius = 3\n float inputs:radius = 2"))
    assert scene.lights[0].radius == 2.0 and not warned(scene, "/L")


SHAPED = '(prepend apiSchemas = ["ShapingAPI"])'


@pytest.mark.parametrize(
    ("kind", "head", "more", "word"),
    [
        ("SphereLight", SHAPED, "", "shaping"),
        ("RectLight", SHAPED, "float inputs:shaping:focus = 2", "shaping"),
        ("RectLight", SHAPED, "float inputs:shaping:cone:angle = 30", "shaping"),
        ("SphereLight", SHAPED, "asset inputs:shaping:ies:file = @a.ies@", "shaping"),
        ("RectLight", "", "asset inputs:texture:file = @a.png@", "texture"),
        ("RectLight", '(prepend apiSchemas = ["ShadowAPI"])', "bool inputs:shadow:enable = 0", "shadow"),
        ("RectLight", "", "uniform bool collection:lightLink:includeRoot = 0", "lightLink"),
        ("RectLight", "", "rel collection:shadowLink:excludes = </L>", "shadowLink"),
        ("RectLight", "", "rel light:filters = </L>", "filters"),
        ("DomeLight", "", "rel portals = </L>", "portals"),
        ("PortalLight", "", "", "PortalLight"),
        ("GeometryLight", "", "", "GeometryLight"),
        ("PluginLight", "", "", "PluginLight"),
    ],
)
def test_what_is_not_read_yet_is_named(tmp_path, kind, head, more, word):
    """Each feature that the picture will lack is a warning with the light's path."""
    assert warned(load(tmp_path, light_text(kind, more, head)), "/L", word)


@pytest.mark.parametrize(
    ("kind", "more"), [("RectLight", ""), ("SphereLight", "float inputs:shaping:cone:angle = 180")]
)
def test_shaping_without_effect_is_no_trouble(tmp_path, kind, more):
    """A cone that covers all directions of emission changes nothing."""
    assert not warned(load(tmp_path, light_text(kind, more, SHAPED)), "/L")


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


def test_any_gprim_can_be_a_light(tmp_path):
    """LightAPI on a Sphere: its radius is geometry, its surface emits and answers with no material."""
    text = 'def Sphere "S" (prepend apiSchemas = ["LightAPI"]) { double radius = 2\n float inputs:intensity = 3\n}'
    scene = load(tmp_path, text)
    assert scene.materials[0].emission == (3, 3, 3) and scene.materials[0].albedo == (0, 0, 0)
    assert np.abs(scene.meshes[0].points).max() == 2.0 and not warned(scene, "old style")
