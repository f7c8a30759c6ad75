"""What surfaces look like: shaders, bindings, subsets and displayColor."""

from pathlib import Path

import numpy as np
import pytest

from tests.stages import QUADS, diffuse, load, material_text, only_material, warned
from warp_ir import Material

BOUND = 'def Mesh "M" (prepend apiSchemas = ["MaterialBindingAPI"]) {' + QUADS + "rel material:binding = </A>\n}\n"


def test_without_material_or_colour_a_surface_is_grey(tmp_path):
    """The fallback is UsdPreviewSurface's 0.18."""
    assert only_material(load(tmp_path, f'def Mesh "M" {{{QUADS}}}')).albedo == (0.18, 0.18, 0.18)


def test_preview_surface_constants(tmp_path):
    """Albedo is diffuseColor, emission emissiveColor; unauthored ones are the schema's."""
    assert only_material(load(tmp_path, material_text() + BOUND)) == Material("/A", (0.18,) * 3, (0.0,) * 3)
    text = material_text("color3f inputs:diffuseColor = (0.25, 0.5, 0.75)\n color3f inputs:emissiveColor = (17, 12, 4)")
    assert only_material(load(tmp_path, text + BOUND)) == Material("/A", (0.25, 0.5, 0.75), (17.0, 12.0, 4.0))


def test_constants_come_through_interfaces(tmp_path):
    """A value may sit on the material or on a node graph that the shader's input is connected to."""
    text = """
def Material "A" {
    color3f inputs:paint = (0.5, 0.25, 0)
    token outputs:surface.connect = </A/G/S.outputs:surface>
    def NodeGraph "G" {
        color3f inputs:inner.connect = </A.inputs:paint>
        def Shader "S" {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor.connect = </A/G.inputs:inner>
            token outputs:surface
        }
    }
}
"""
    assert only_material(load(tmp_path, text + BOUND)).albedo == (0.5, 0.25, 0.0)


def test_a_metal_keeps_its_base_colour(tmp_path):
    """A metal becomes a diffuse surface of the same hemispherical albedo, not a black one; said once."""
    inputs = "color3f inputs:diffuseColor = (1, 0.5, 0.25)\n float inputs:metallic = 1"
    text = material_text(inputs) + material_text(inputs, "B")
    scene = load(tmp_path, text + BOUND + BOUND.replace('"M"', '"N"').replace("</A>", "</B>"))
    assert [material.albedo for material in scene.materials] == [(1.0, 0.5, 0.25)] * 2
    assert sum("metal" in line for line in scene.warnings) == 1 and warned(scene, "/A, /B", "2 materials")


def test_the_specular_workflow_adds_its_reflection(tmp_path):
    """What is reflected by the specular lobe is missing in the diffuse one: albedo = d (1 - s) + s."""
    text = """color3f inputs:diffuseColor = (0.5, 0.5, 0)
        color3f inputs:specularColor = (0, 0.5, 1)
        int inputs:useSpecularWorkflow = 1
        float inputs:metallic = 1"""
    scene = load(tmp_path, material_text(text) + BOUND)
    assert only_material(scene).albedo == (0.5, 0.75, 1.0) and warned(scene, "/A", "specular")


@pytest.mark.parametrize(
    ("opacity", "threshold", "present", "noted"),
    [(1, 0, True, False), (0, 0, False, False), (0.6, 0, True, True), (0.4, 0, True, True), (0.6, 0.7, False, False),
     (0.6, 0.6, True, False)],
)  # fmt: skip
def test_opacity_cuts(tmp_path, opacity, threshold, present, noted):
    """Below its threshold a surface is absent; without one, partial opacity lets its share of light through: said."""
    text = f"float inputs:opacity = {opacity}\n float inputs:opacityThreshold = {threshold}"
    scene = load(tmp_path, material_text(text) + BOUND)
    assert bool(scene.meshes) == present and warned(scene, "/A", "opacity") == noted
    if present:
        assert only_material(scene).opacity == (np.float32(opacity) if noted else 1.0)


@pytest.mark.parametrize(
    ("value", "albedo", "word"),
    [
        ("(2, 0.5, 0.5)", (1.0, 0.5, 0.5), "clamped"),
        ("(-1, 0.5, 0.5)", (0.0, 0.5, 0.5), "clamped"),
        ("(nan, 0.5, 0.5)", (0.18, 0.18, 0.18), "not a finite colour"),
    ],
)
def test_albedo_stays_in_range(tmp_path, value, albedo, word):
    """An albedo outside [0, 1] is clamped, one that is not a number replaced; both are said."""
    scene = load(tmp_path, diffuse(value) + BOUND)
    assert only_material(scene).albedo == albedo and warned(scene, "/A", word)


@pytest.mark.parametrize(
    ("value", "emission"), [("(-1, 2, 3)", (0, 2, 3)), ("(inf, 2, 3)", (0, 0, 0)), ("(1e35, 0, 0)", (0, 0, 0))]
)
def test_emission_is_finite_and_not_negative(tmp_path, value, emission):
    """Impossible emission is repaired, and said."""
    scene = load(tmp_path, material_text(f"color3f inputs:emissiveColor = {value}") + BOUND)
    assert only_material(scene).emission == emission and warned(scene, "/A")


@pytest.mark.parametrize(
    ("fallback", "albedo"), [("", (0.0,) * 3), ("float4 inputs:fallback = (0.5, 0.25, 0, 1)", (0.5, 0.25, 0.0))]
)
def test_textures_are_replaced_by_their_fallback(tmp_path, fallback, albedo):
    """A texture without a file is its fallback, in the schema black; the material is named."""
    text = f"""color3f inputs:diffuseColor.connect = </A/T.outputs:rgb>
        token outputs:surface
    }}
    def Shader "T" {{
        uniform token info:id = "UsdUVTexture"
        {fallback}
        float3 outputs:rgb"""
    text = material_text(text).replace("\n        token outputs:surface\n    }\n}", "\n    }\n}")
    scene = load(tmp_path, text + BOUND)
    assert only_material(scene).albedo == albedo and warned(scene, "/A", "no image file", "fallback")


@pytest.mark.parametrize(
    ("shader", "inputs", "albedo", "emission"),
    [
        ("ND_UsdPreviewSurface_surfaceshader", "color3f inputs:diffuseColor = (0.5, 0, 0)", (0.5, 0, 0), (0, 0, 0)),
        (
            "ND_standard_surface_surfaceshader",
            "float inputs:base = 0.5\n color3f inputs:base_color = (1, 0.5, 0)\n"
            " float inputs:emission = 3\n color3f inputs:emission_color = (1, 0, 1)",
            (0.5, 0.25, 0),
            (3, 0, 3),
        ),
        ("ND_standard_surface_surfaceshader", "", (0.8, 0.8, 0.8), (0, 0, 0)),
        (
            "ND_standard_surface_surfaceshader",
            "color3f inputs:base_color = (1, 1, 1)\n float inputs:coat = 0.5\n color3f inputs:coat_color = (1, 0.6, 0)",
            (1, 0.8, 0.5),
            (0, 0, 0),
        ),
        (
            "ND_open_pbr_surface_surfaceshader",
            "float inputs:coat_weight = 1\n color3f inputs:coat_color = (0.5, 1, 0)",
            (0.4, 0.8, 0),
            (0, 0, 0),
        ),
        (
            "ND_open_pbr_surface_surfaceshader",
            "float inputs:base_weight = 0.5\n float inputs:emission_luminance = 2",
            (0.4, 0.4, 0.4),
            (2, 2, 2),
        ),
    ],
)
def test_inline_materialx(tmp_path, shader, inputs, albedo, emission):
    """Base, coat and emission of the MaterialX surfaces are read where no universal surface is offered."""
    material = only_material(load(tmp_path, material_text(inputs, shader=shader, output="mtlx:surface") + BOUND))
    assert material.albedo == pytest.approx(albedo) and material.emission == pytest.approx(emission)


GREEN = ("mtlx:surface", "ND_standard_surface_surfaceshader", "float inputs:base = 1\n color3f inputs:base_color")
RED = ("surface", "UsdPreviewSurface", "color3f inputs:diffuseColor")
BLUE = ("ri:surface", "PxrDisneyBsdf", "color3f inputs:baseColor")


def _offering(*offers):
    """A material with a surface for each (output, shader, input of its colour), red, green and blue in that order."""
    text = 'def Material "A" {\n'
    for k, (output, shader, color) in enumerate(offers):
        text += f"""
    token outputs:{output}.connect = </A/S{k}.outputs:out>
    def Shader "S{k}" {{
        uniform token info:id = "{shader}"
        {color} = {tuple(float(i == k) for i in range(3))}
        token outputs:out
    }}"""
    return text + "\n}\n" + BOUND


@pytest.mark.parametrize(
    ("offers", "used", "named"),
    [
        ((RED, GREEN), 1, "outputs:mtlx:surface"),
        ((GREEN, RED), 0, "outputs:mtlx:surface"),
        ((BLUE, RED, GREEN), 2, "outputs:mtlx:surface"),
        ((("mtlx:surface", "ND_layered_anything", GREEN[2]), RED), 1, "outputs:surface"),
        ((BLUE, RED), 1, None),
        ((BLUE, GREEN), 1, None),
        ((RED,), 0, None),
        ((GREEN,), 0, None),
    ],
)
def test_materialx_comes_before_the_universal_surface(tmp_path, offers, used, named):
    """Storm's render contexts are mtlx, then the universal one; where both are offered, the one used is named."""
    scene = load(tmp_path, _offering(*offers))
    expected = np.eye(3)[used] * only_material(scene).albedo
    assert only_material(scene).albedo == pytest.approx(expected) and max(expected) > 0.7
    assert warned(scene, "/A", f"{named} is used (1 materials)") if named else not warned(scene, "is used")


def test_one_surface_for_both_contexts_is_no_choice(tmp_path):
    """Two outputs with one shader need no word."""
    both = "token outputs:mtlx:surface.connect = </A/S.outputs:surface>\n"
    text = material_text("color3f inputs:diffuseColor = (1, 0, 0)").replace(
        "    def Shader", f"    {both}    def Shader", 1
    )
    assert not warned(load(tmp_path, text + BOUND), "is used")


@pytest.mark.parametrize(
    ("text", "word"),
    [
        (material_text(shader="Lambert"), "Lambert"),
        (material_text(output="ri:surface", shader="PxrVolume"), "PxrVolume"),
        (material_text(output="ri:surface").replace("def Shader", "def NodeGraph"), "outputs:ri:surface"),
        ('def Material "A" {\n}\n', "no surface shader"),
        ("", "/A does not exist"),
    ],
)
def test_a_material_that_cannot_be_read_leaves_the_display_colour(tmp_path, text, word):
    """An unknown shader, another renderer's, none at all, or no material: displayColor, and a warning."""
    bound = BOUND.replace("rel ", "color3f[] primvars:displayColor = [(0.5, 0, 0)]\n    rel ")
    scene = load(tmp_path, text + bound)
    assert only_material(scene).albedo == (0.5, 0.0, 0.0) and warned(scene, word)


def test_colour_spaces_are_converted(tmp_path):
    """A colour in sRGB encoding is decoded; one in linear Rec.709 is taken as it is."""
    text = 'color3f inputs:diffuseColor = (0.5, 1, 0) (colorSpace = "lin_rec709")'
    assert only_material(load(tmp_path, material_text(text) + BOUND)).albedo == (0.5, 1.0, 0.0)
    text = 'color3f inputs:diffuseColor = (0.5, 1, 0) (colorSpace = "srgb_rec709_scene")'
    decoded = ((0.5 + 0.055) / 1.055) ** 2.4
    assert only_material(load(tmp_path, material_text(text) + BOUND)).albedo == pytest.approx((decoded, 1, 0), abs=1e-3)


class TestBinding:
    """Which material a face gets; A is red, B is green."""

    PAINTS = diffuse("(1, 0, 0)") + diffuse("(0, 1, 0)", "B")
    HEAD = '(prepend apiSchemas = ["MaterialBindingAPI"])'

    def colors(self, folder: Path, text: str) -> list[str]:
        """The name of the material of each of the two quads' first triangles, for every mesh."""
        scene = load(folder, self.PAINTS + text)
        return [scene.materials[i].name.strip("/") for mesh in scene.meshes for i in mesh.material[::2]]

    def test_the_nearest_binding_wins(self, tmp_path):
        """A mesh's own binding is stronger than its ancestor's, unless that says otherwise."""
        text = f"""def Xform "X" {self.HEAD} {{
    rel material:binding = </B> STRENGTH
    def Mesh "Own" {self.HEAD} {{{QUADS} rel material:binding = </A>
    }}
    def Mesh "Inherits" {{{QUADS}}}
}}"""
        assert self.colors(tmp_path, text.replace("STRENGTH", "")) == ["A", "A", "B", "B"]
        strong = '(bindMaterialAs = "strongerThanDescendants")'
        assert self.colors(tmp_path, text.replace("STRENGTH", strong)) == ["B", "B", "B", "B"]

    def test_a_collection_binds_its_members(self, tmp_path):
        """On one prim, a collection's binding comes before the direct one, for its members only."""
        text = f"""def Xform "X" (prepend apiSchemas = ["MaterialBindingAPI", "CollectionAPI:some"]) {{
    uniform token collection:some:expansionRule = "expandPrims"
    rel collection:some:includes = </X/In>
    rel material:binding:collection:some = [</X.collection:some>, </A>]
    rel material:binding = </B>
    def Mesh "In" {{{QUADS}}}
    def Mesh "Out" {{{QUADS}}}
}}"""
        assert self.colors(tmp_path, text) == ["A", "A", "B", "B"]

    def test_the_full_purpose_comes_first_and_preview_last(self, tmp_path):
        """Purposes are tried in the order full, all, preview; the last with a note."""
        mesh = 'def Mesh "M" (prepend apiSchemas = ["MaterialBindingAPI"]) {' + QUADS
        text = mesh + "rel material:binding = </B>\n rel material:binding:full = </A>\n}"
        assert self.colors(tmp_path, text) == ["A", "A"]
        text = mesh + "rel material:binding = </B>\n rel material:binding:preview = </A>\n}"
        assert self.colors(tmp_path, text) == ["B", "B"]
        text = mesh + "rel material:binding:preview = </A>\n}"
        assert self.colors(tmp_path, text) == ["A", "A"]
        assert warned(load(tmp_path, self.PAINTS + text), "/M", "preview")

    def test_subsets_bind_faces(self, tmp_path):
        """A face of a materialBind subset has its material, the others the mesh's; the first subset wins."""
        subset = """
    def GeomSubset "{}" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
        uniform token elementType = "face"
        uniform token familyName = "{}"
        int[] indices = {}
        rel material:binding = </{}>
    }}"""
        mesh = f'def Mesh "M" {self.HEAD} {{{QUADS} rel material:binding = </A>\n'
        assert self.colors(tmp_path, mesh + subset.format("S", "materialBind", [1, 9], "B") + "\n}") == ["A", "B"]
        assert self.colors(tmp_path, mesh + subset.format("S", "other", [1], "B") + "\n}") == ["A", "A"]
        both = subset.format("S", "materialBind", [0], "B") + subset.format("T", "materialBind", [0, 1], "A")
        assert self.colors(tmp_path, mesh + both + "\n}") == ["B", "A"]
        scene = load(tmp_path, self.PAINTS + mesh + both + subset.format("U", "materialBind", [7], "A") + "\n}")
        assert warned(scene, "/M/T", "already in another") and warned(scene, "/M/U", "out of range")

    def test_a_subset_beside_bare_faces(self, tmp_path):
        """Where only some faces have a material, the others keep their displayColor."""
        text = f"""def Mesh "M" {{{QUADS}
    color3f[] primvars:displayColor = [(0, 0, 1), (0, 0.5, 1)] (interpolation = "uniform")
    def GeomSubset "S" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
        uniform token elementType = "face"
        uniform token familyName = "materialBind"
        int[] indices = [0]
        rel material:binding = </A>
    }}
}}"""
        mesh = load(tmp_path, self.PAINTS + text).meshes[0]
        assert mesh.colors[:, 0].tolist() == [[1, 0, 0], [1, 0, 0], [0, 0.5, 1], [0, 0.5, 1]]

    def test_only_used_materials_are_in_the_scene_and_each_once(self, tmp_path):
        """Materials that nothing is bound to are left out; one that is bound twice is there once."""
        scene = load(tmp_path, self.PAINTS + BOUND + BOUND.replace('"M"', '"N"'))
        assert only_material(scene).name == "/A" and scene.stats["materials"] == 1


class TestDisplayColor:
    """The colour of surfaces without a material."""

    def test_it_is_inherited(self, tmp_path):
        """A constant displayColor of an ancestor counts."""
        text = f'def Xform "X" {{ color3f[] primvars:displayColor = [(1, 0, 0)]\n def Mesh "M" {{{QUADS}}}\n}}'
        assert only_material(load(tmp_path, text)).albedo == (1.0, 0.0, 0.0)

    def test_equal_colours_share_a_material(self, tmp_path):
        """Two meshes of one colour need one material, and no colours per corner."""
        mesh = f'{{{QUADS} color3f[] primvars:displayColor = [(1, 0, 0), (1, 0, 0)] (interpolation = "uniform")\n}}\n'
        scene = load(tmp_path, f'def Mesh "A" {mesh} def Mesh "B" {mesh}')
        assert only_material(scene).albedo == (1.0, 0.0, 0.0) and scene.meshes[0].colors is None

    @pytest.mark.parametrize(
        ("text", "albedo", "word"),
        [
            ('[(1, 0, 0), (0, 1, 0), (0, 0, 1)] (interpolation = "uniform")', (1, 0, 0), "2 are needed"),
            (
                '[(1, 0, 0)] (interpolation = "vertex")\n int[] primvars:displayColor:indices = [5]',
                (1, 0, 0),
                "out of range",
            ),
            ("[(3, 0, -1)]", (1, 0, 0), "clamped"),
            ("[(nan, 1, 0)]", (0, 1, 0), "not finite"),
        ],
    )
    def test_wrong_values_are_repaired_and_named(self, tmp_path, text, albedo, word):
        """A wrong count leaves the first value; values outside [0, 1] are clamped."""
        scene = load(tmp_path, f'def Mesh "M" {{{QUADS} color3f[] primvars:displayColor = {text}\n}}')
        assert only_material(scene).albedo == albedo and warned(scene, "/M", word)

    def test_no_colour_at_all_is_grey(self, tmp_path):
        """An empty array is no opinion."""
        scene = load(tmp_path, f'def Mesh "M" {{{QUADS} color3f[] primvars:displayColor = []\n}}')
        assert only_material(scene).albedo == (0.18, 0.18, 0.18)


def test_double_sided_decides_where_a_surface_emits(tmp_path):
    """A mesh is single-sided unless it says otherwise."""
    assert not load(tmp_path, BOUND).meshes[0].double_sided
    assert load(tmp_path, BOUND.replace("rel ", "uniform bool doubleSided = 1\n rel ")).meshes[0].double_sided


def test_an_emissive_surface_is_light_enough(tmp_path):
    """A room lit by an emissive material alone gets no default dome."""
    assert load(tmp_path, material_text("color3f inputs:emissiveColor = (1, 1, 1)") + BOUND).lights == ()


def test_colors_are_float32_per_corner(tmp_path):
    """Colours that vary are albedos of the corners, [m, 3, 3]."""
    color = 'color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0)] (interpolation = "uniform")'
    text = f'def Mesh "M" {{{QUADS} {color}\n}}'
    colors = load(tmp_path, text).meshes[0].colors
    assert colors.shape == (4, 3, 3) and colors.dtype == np.float32
