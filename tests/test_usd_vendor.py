"""Shaders of other renderers: what of them a diffuse surface shows."""

import time

import numpy as np
import pytest

from tests.stages import RGBA, ST, load, material_text, mesh, only_material, warned, write_image
from warp_ir.scene import Wrap
from warp_ir.usd.images.asset import srgb_to_linear

DIFFUSE = "color3f inputs:diffuseColor ="
MEAN = RGBA[..., :3].mean(axis=-1)


def mdl(inputs="", name="OmniPBR", more=""):
    """A material as Omniverse writes it."""
    return f"""
def Material "A" {{
    token outputs:mdl:surface.connect = </A/S.outputs:out>
    token outputs:mdl:volume.connect = </A/S.outputs:out>
    def Shader "S" {{
        uniform token info:implementationSource = "sourceAsset"
        uniform asset info:mdl:sourceAsset = @{name}.mdl@
        uniform token info:mdl:sourceAsset:subIdentifier = "{name}"
        {inputs}
        token outputs:out
    }}
    {more}
}}
"""


@pytest.fixture
def image(tmp_path):
    """a.png, of which the tests know every byte."""
    write_image(tmp_path / "a.png", RGBA)
    return RGBA / 255.0


def test_omni_pbr_constants(tmp_path):
    """Tinted base colour; the emission is a radiant exitance, of a diffuse emitter of radiance M / pi."""
    text = mdl("""color3f inputs:diffuse_color_constant = (0.5, 0.25, 0.125)
        color3f inputs:diffuse_tint = (0.5, 1, 1)
        float inputs:albedo_brightness = 9
        bool inputs:enable_emission = 1
        color3f inputs:emissive_color = (1, 0.5, 0.25)
        float inputs:emissive_intensity = 6
        bool inputs:enable_opacity = 1
        float inputs:opacity_constant = 0.75""")
    scene = load(tmp_path, text + mesh())
    material = only_material(scene)
    assert material.albedo == (0.25, 0.25, 0.125) and material.opacity == 0.75
    assert material.emission == pytest.approx(np.array((6.0, 3.0, 1.5)) / np.pi)
    assert warned(scene, "/A", "OmniPBR", "(1 materials)")


def test_omni_pbr_that_says_nothing_has_its_defaults(tmp_path):
    """Switches that are off leave emission and opacity as they are."""
    text = mdl("float inputs:emissive_intensity = 6\n float inputs:opacity_constant = 0")
    material = only_material(load(tmp_path, text + mesh()))
    assert (material.albedo, material.emission, material.opacity) == ((0.2,) * 3, (0.0,) * 3, 1.0)


def test_omni_pbr_maps(tmp_path, image):
    """The albedo map takes the constant's place, repeated and scaled about the origin; DirectX's normals turn."""
    text = mdl("""color3f inputs:diffuse_color_constant = (0.5, 0.25, 0.125)
        asset inputs:diffuse_texture = @a.png@ (colorSpace = "sRGB")
        float inputs:albedo_brightness = 0.5
        float inputs:albedo_add = 0.125
        float inputs:albedo_desaturation = 1
        asset inputs:normalmap_texture = @a.png@
        float2 inputs:texture_scale = (2, 3)
        float2 inputs:texture_translate = (0.5, 0.25)""")
    material = only_material(load(tmp_path, text + mesh()))
    texture = material.albedo_texture
    expected = 0.5 * srgb_to_linear(image[..., :3]).mean(axis=-1, keepdims=True) + 0.125
    np.testing.assert_allclose(texture.pixels, np.repeat(expected, 3, 2), atol=2.0**-11)
    assert texture.wrap == (Wrap.REPEAT, Wrap.REPEAT) and texture.uv == "st"
    np.testing.assert_allclose(texture.transform, [[2, 0, 0.5], [0, 3, 0.25]])
    normal = (2.0 * image[..., :3] - 1.0) * (1.0, -1.0, 1.0)
    np.testing.assert_allclose(material.normal_texture.pixels, normal, atol=2.0**-10)


def test_omni_pbr_opacity_maps_and_projection(tmp_path, image):
    """The mean of the channels, cut at a threshold; a texture that is projected has no place on the surface."""
    text = mdl("""bool inputs:enable_opacity = 1
        bool inputs:enable_opacity_texture = 1
        asset inputs:opacity_texture = @a.png@
        float inputs:opacity_threshold = 0.25""")
    material = only_material(load(tmp_path, text + mesh()))
    np.testing.assert_allclose(material.opacity_texture.pixels[..., 0], MEAN / 255.0, atol=2.0**-11)
    assert material.cutoff == 0.25
    scene = load(tmp_path, mdl("asset inputs:diffuse_texture = @a.png@\n bool inputs:project_uvw = 1") + mesh())
    mean = srgb_to_linear(image[..., :3]).mean(axis=(0, 1))
    assert only_material(scene).albedo == pytest.approx(mean, rel=1e-3) and only_material(scene).albedo_texture is None
    assert warned(scene, "/A", "projected")


def test_a_map_that_is_missing_leaves_the_constant(tmp_path):
    """Files often name textures on servers."""
    text = mdl("color3f inputs:diffuse_color_constant = (0.5, 0.25, 0.125)\n asset inputs:diffuse_texture = @b.png@")
    scene = load(tmp_path, text + mesh())
    assert only_material(scene).albedo == (0.5, 0.25, 0.125) and warned(scene, "/A", "diffuse_texture", "b.png")


@pytest.mark.parametrize(("mode", "factor"), [("emission_lx", 1.0 / np.pi), ("emission_nt", 1.0)])
def test_omni_surface(tmp_path, mode, factor):
    """Weighted colours; lux are of all directions, nits of one."""
    text = mdl(
        f"""color3f inputs:diffuse_reflection_color = (0.5, 0.25, 0.125)
        float inputs:emission_weight = 0.5
        float inputs:emission_intensity = 8
        token inputs:emission_mode = "{mode}\"""",
        "OmniSurface",
    )
    material = only_material(load(tmp_path, text + mesh()))
    assert material.albedo == pytest.approx((0.4, 0.2, 0.1))
    assert material.emission == pytest.approx((4.0 * factor,) * 3)


def test_glTF_in_mdl(tmp_path, image):
    """A factor times a node that looks a texture up."""
    node = """def Shader "T" {
        uniform token info:implementationSource = "sourceAsset"
        uniform asset info:mdl:sourceAsset = @gltf/pbr.mdl@
        uniform token info:mdl:sourceAsset:subIdentifier = "gltf_texture_lookup"
        asset inputs:texture = @a.png@
        token outputs:out
    }"""
    text = mdl(
        """color3f inputs:base_color_factor = (0.5, 0.25, 0.125)
        token inputs:base_color_texture.connect = </A/T.outputs:out>
        color3f inputs:emissive_factor = (1, 2, 3)
        float inputs:emissive_strength = 2""",
        "gltf_material",
        node,
    )
    material = only_material(load(tmp_path, text + mesh()))
    expected = srgb_to_linear(image[..., :3]) * (0.5, 0.25, 0.125)
    np.testing.assert_allclose(material.albedo_texture.pixels, expected, atol=2.0**-11)
    assert material.emission == (2.0, 4.0, 6.0)


@pytest.mark.parametrize(
    ("output", "shader", "inputs", "albedo", "emission"),
    [
        ("ri:surface", "PxrSurface", f"{DIFFUSE} (1, 0.5, 0)\n float inputs:diffuseGain = 0.25", 1, 0),
        ("ri:surface", "PxrDisneyBsdf", "color3f inputs:baseColor = (0.25, 0.125, 0)", 1, 0),
        ("arnold:surface", "arnold:lambert", "color3f inputs:Kd_color = (0.5, 0.25, 0)\n float inputs:Kd = 0.5", 1, 0),
        ("arnold:surface", "arnold:flat", "color3f inputs:color = (0.25, 0.125, 0)", 0, 1),
        ("ri:surface", "PxrConstant", "color3f inputs:emitColor = (0.25, 0.125, 0)", 0, 1),
        ("arnold:surface", "arnold:standard_surface", "color3f inputs:base_color = (0.25, 0.125, 0)", 1, 0),
        ("mtlx:surface", "ND_surface_unlit", "color3f inputs:emission_color = (0.25, 0.125, 0)", 0, 1),
        ("surface", "mine", f"{DIFFUSE} (0.25, 0.125, 0)\n color3f inputs:emission_color = (1, 1, 1)", 1, 0),
    ],
)  # fmt: skip
def test_a_base_colour_by_its_usual_names(tmp_path, output, shader, inputs, albedo, emission):
    """Weights count, and an emission whose strength is 0 unless it is said does not shine."""
    material = only_material(load(tmp_path, material_text(inputs, shader=shader, output=output) + mesh()))
    color = np.array((0.25, 0.125, 0.0))
    assert material.albedo == pytest.approx(albedo * color) and material.emission == pytest.approx(emission * color)


def test_an_empty_array_is_no_value(tmp_path):
    """Whatever it feeds keeps its default, and the surface is there."""
    scene = load(tmp_path, material_text("float[] inputs:opacity = []\n color3f[] inputs:diffuseColor = []") + mesh())
    assert only_material(scene).albedo == (0.18,) * 3 and scene.meshes
    assert warned(scene, "/A", "opacity", "not a finite number")


def test_a_base_colour_that_is_not_understood_is_grey(tmp_path):
    """As a surface of which nothing is known, and not black, which would take light away."""
    text = material_text("color3f inputs:baseColor.connect = </A/N.outputs:out>", shader="mine").rstrip()[:-1]
    node = 'def Shader "N" {\n uniform token info:id = "clouds"\n color3f outputs:out\n}\n}\n'
    scene = load(tmp_path, text + node + mesh())
    assert only_material(scene).albedo == (0.18,) * 3 and warned(scene, "/A", "clouds is not supported")


def test_what_is_understood_exactly_comes_first(tmp_path):
    """A UsdPreviewSurface for all renderers is taken, and nothing said of the MDL beside it."""
    text = mdl("color3f inputs:diffuse_color_constant = (1, 0, 0)").rstrip()[:-1]
    preview = material_text("color3f inputs:diffuseColor = (0.5, 0.25, 0.125)").split("{", 1)[1]
    scene = load(tmp_path, text + preview.replace("/A/S.", "/A/P.").replace('"S"', '"P"') + mesh())
    assert only_material(scene).albedo == (0.5, 0.25, 0.125) and not warned(scene, "OmniPBR")


def gltf(inputs, nodes=""):
    text = material_text(inputs, shader="ND_gltf_pbr_surfaceshader", output="mtlx:surface")
    return text.rstrip()[:-1] + nodes + "}\n" + mesh(ST)


def test_gltf_pbr(tmp_path):
    """A material of glTF as MaterialX has it: it is a metal unless it says otherwise."""
    scene = load(tmp_path, gltf("color3f inputs:base_color = (0.5, 0.25, 0.125)\n float inputs:alpha = 0.5"))
    assert only_material(scene).albedo == (0.5, 0.25, 0.125) and only_material(scene).opacity == 1.0
    assert warned(scene, "metal")
    text = gltf("""float inputs:metallic = 0
        float inputs:alpha = 0.5
        int inputs:alpha_mode = 2
        color3f inputs:emissive = (1, 0.5, 0)
        float inputs:emissive_strength = 4""")
    material = only_material(load(tmp_path, text))
    assert (material.opacity, material.emission) == (0.5, (4.0, 2.0, 0.0))
    assert not load(tmp_path, text.replace("mode = 2", "mode = 1").replace("= 0.5", "= 0.25")).meshes


def test_gltf_images(tmp_path, image):
    """The coloured image has colour and alpha apart; scaled about the upper left corner, as glTF counts."""
    nodes = """
    def Shader "T" {
        uniform token info:id = "ND_gltf_colorimage"
        asset inputs:file = @a.png@
        color4f inputs:color = (0.5, 0.25, 0.125, 0.5)
        float2 inputs:scale = (2, 2)
        float2 inputs:offset = (0.5, 0.25)
        color3f outputs:outcolor
        float outputs:outa
    }
"""
    text = gltf(
        """color3f inputs:base_color.connect = </A/T.outputs:outcolor>
        float inputs:alpha.connect = </A/T.outputs:outa>
        int inputs:alpha_mode = 2
        float inputs:metallic = 0""",
        nodes,
    )
    material = only_material(load(tmp_path, text))
    expected = srgb_to_linear(image[..., :3]) * (0.5, 0.25, 0.125)
    np.testing.assert_allclose(material.albedo_texture.pixels, expected, atol=2.0**-11)
    np.testing.assert_allclose(material.opacity_texture.pixels[..., 0], 0.5 * image[..., 3], atol=2.0**-11)
    # KHR_texture_transform: (u, 1 - v) -> scale (u, 1 - v) + offset.
    np.testing.assert_allclose(material.albedo_texture.transform, [[2, 0, 0.5], [0, 2, -1.25]])


MODULE = """mdl 1.4;
import ::OmniPBR::OmniPBR; // "not a string
/* export material Oak(*) = OmniPBR(albedo_add: 9.f); */
export material Pine(*) = OmniPBR(diffuse_color_constant: color(1.f));
export material Oak(*)
[[ anno::display_name("Oak, (light)"), anno::author("//x") ]]
 = ::OmniPBR::OmniPBR(
    diffuse_color_constant: color(0.5f, 0.25f, .125f), // of the core
    TEXTURE
    albedo_brightness: 0.5f,
    enable_emission: true, emissive_color: color(1, 2, 4), emissive_intensity: 3.e0f,
    texture_scale: float2(2.f, 3.f),
    bump_factor: math::pow(2.f, 3.f),
    opacity_mode: ::base::mono_average);
"""


@pytest.fixture
def oak(tmp_path):
    """A library with a material and a texture."""
    (tmp_path / "lib").mkdir()
    write_image(tmp_path / "lib" / "a.png", RGBA)
    (tmp_path / "lib" / "Oak.mdl").write_text(MODULE.replace("TEXTURE", ""))
    return tmp_path


def library(inputs="", name="Oak"):
    return mdl(inputs, name).replace(f"@{name}.mdl@", "@lib/Oak.mdl@") + mesh()


def test_a_material_of_a_library(oak):
    """Its arguments are in the file, and what the stage says of it is stronger."""
    material = only_material(load(oak, library()))
    assert material.albedo == (0.5, 0.25, 0.125)
    assert material.emission == pytest.approx(np.array((3.0, 6.0, 12.0)) / np.pi)
    assert only_material(load(oak, library(name="Pine"))).albedo == (1.0, 1.0, 1.0)
    material = only_material(load(oak, library("bool inputs:enable_emission = 0")))
    assert material.albedo == (0.5, 0.25, 0.125) and material.emission == (0.0, 0.0, 0.0)


def test_a_texture_of_a_library(oak, image):
    """It lies beside the .mdl file, which says what it holds."""
    texture = 'diffuse_texture: texture_2d("./a.png", ::tex::gamma_linear),'
    (oak / "lib" / "Oak.mdl").write_text(MODULE.replace("TEXTURE", texture))
    found = only_material(load(oak, library())).albedo_texture
    np.testing.assert_allclose(found.pixels, 0.5 * image[..., :3], atol=2.0**-11)
    np.testing.assert_allclose(found.transform, [[2, 0, 0], [0, 3, 0]])


@pytest.mark.parametrize(
    "text",
    [
        "export material Oak(*) = Wood(diffuse_color_constant: color(1.f));",
        "export material Oak(float a = 1.f) = OmniPBR(diffuse_color_constant: color(1.f));",
        "export material Oak(*) = OmniPBR(diffuse_color_constant: color(1e999f)",
        "export material Oak(*) = OmniPBR(a: " + "1" * 100_000 + "x)",
        "export material Oak(*) [[" * 5000,
        "/*" * 60_000,
        '"\\' * 60_000,
        "export material Oak(*) = OmniPBR(" * 3000,
        "x" * 2**18,
        "\0\xff",
    ],
)
def test_files_that_are_something_else_are_harmless(oak, text):
    """What is not of this form, or no text, leaves what the stage itself says, within moments."""
    (oak / "lib" / "Oak.mdl").write_text(text)
    begin = time.perf_counter()
    scene = load(oak, library("color3f inputs:diffuse_color_constant = (0.5, 0.25, 0.125)"))
    assert only_material(scene).albedo == (0.5, 0.25, 0.125) and time.perf_counter() - begin < 10.0
