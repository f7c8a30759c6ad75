"""Networks of shading nodes: textures in place, arithmetic on them, and what becomes of what cannot be read."""

import time

import numpy as np
import OpenImageIO as oiio
import pytest
from pxr import Gf, Sdf, Usd, UsdUtils

import warp_ir as ir
from tests.stages import (
    RAW,
    READER,
    RGBA,
    ST,
    UNPACK,
    load,
    material_text,
    mesh,
    only_material,
    real_file,
    textured,
    warned,
    write_image,
)
from warp_ir.scene import Wrap
from warp_ir.usd.images.asset import srgb_to_linear
from warp_ir.usd.images.shading_value import ShadingValue, UVMapping, look_up
from warp_ir.usd.shading.bake import _ERROR


@pytest.fixture
def image(tmp_path):
    """a.png, of which the tests know every byte."""
    write_image(tmp_path / "a.png", RGBA)
    return RGBA / 255.0


def test_a_texture_is_put_in_place(tmp_path, image):
    """The image in linear light, halves; black outside unless it says otherwise; the uv set by its name."""
    scene = load(tmp_path, textured() + mesh())
    texture = only_material(scene).albedo_texture
    np.testing.assert_allclose(texture.pixels, srgb_to_linear(image[..., :3]), atol=2.0**-11)
    assert texture.wrap == (Wrap.BLACK, Wrap.BLACK) and texture.outside == (0.0, 0.0, 0.0) and texture.uv == "st"
    assert scene.meshes[0].uvs["st"].shape == (4, 3, 2) and scene.meshes[0].uvs["st"][2:].max() == 2.0
    assert only_material(scene).albedo == pytest.approx(srgb_to_linear(image[..., :3]).mean(axis=(0, 1)), rel=1e-3)
    assert (scene.stats["images"], scene.stats["textures"], scene.stats["texels"]) == (1, 1, 6)
    assert not warned(scene, "texture")


@pytest.mark.parametrize("output, channel", [("r", 0), ("g", 1), ("b", 2), ("a", 3)])
def test_channels_scale_and_bias(tmp_path, image, output, channel):
    """The output is image * scale + bias, channel by channel; alpha is not decoded."""
    text = textured(
        """float4 inputs:scale = (0.5, 0.25, 2, 0.75)
        float4 inputs:bias = (0.1, 0.2, 0.3, 0.05)
        token inputs:wrapS = "mirror"
        token inputs:wrapT = "clamp\"""",
        output,
    )
    texture = only_material(load(tmp_path, text + mesh())).albedo_texture
    stored = image[..., channel] if channel == 3 else srgb_to_linear(image[..., channel])
    expected = stored * (0.5, 0.25, 2.0, 0.75)[channel] + (0.1, 0.2, 0.3, 0.05)[channel]
    expected = np.repeat(expected[..., None], 3, 2).clip(0.0, 1.0)
    np.testing.assert_allclose(texture.pixels, expected, atol=2.0**-11)
    assert texture.wrap == (Wrap.MIRROR, Wrap.CLAMP)


def test_beyond_the_edges_black_is_biased_too(tmp_path, image):
    """Outside an image that is black there, scale and bias still act."""
    text = textured("float4 inputs:bias = (0.25, 0.5, 0, 0)")
    assert only_material(load(tmp_path, text + mesh())).albedo_texture.outside == (0.25, 0.5, 0.0)


def test_images_keep_their_own_borders(tmp_path, image):
    """MaterialX's address mode constant: the border is the node's default, also where materials share the image."""
    text = ""
    for name, default in (("A", "(1, 0, 0)"), ("B", "(0, 1, 0)")):
        surface = "ND_standard_surface_surfaceshader"
        inputs = f"color3f inputs:base_color.connect = </{name}/T.outputs:out>"
        text += material_text(inputs, name, surface, "mtlx:surface").rstrip()[:-1]
        text += f"""
    def Shader "T" {{
        uniform token info:id = "ND_image_color3"
        asset inputs:file = @a.png@
        color3f inputs:default = {default}
        string inputs:uaddressmode = "constant"
        string inputs:vaddressmode = "constant"
        color3f outputs:out
    }}
}}
""" + mesh(name=f"M{name}", material=f"/{name}")
    one, other = (material.albedo_texture for material in load(tmp_path, text).materials)
    assert one.outside == (1.0, 0.0, 0.0) and other.outside == (0.0, 1.0, 0.0)
    assert np.array_equal(one.pixels, other.pixels)


@pytest.mark.parametrize("wrap", ["repeat", "clamp"])
def test_the_wrap_mode_that_files_forget(tmp_path, image, wrap):
    """`texture_wrap` is what unsaid edges are."""
    texture = only_material(load(tmp_path, textured() + mesh(), texture_wrap=wrap)).albedo_texture
    assert texture.wrap == (Wrap[wrap.upper()],) * 2
    said = textured('token inputs:wrapS = "black"')
    assert only_material(load(tmp_path, said + mesh(), texture_wrap=wrap)).albedo_texture.wrap[0] == Wrap.BLACK


@pytest.mark.parametrize(
    "space, decoded", [("raw", False), ("sRGB", True), ("auto", True)]
)  # fmt: skip
def test_colour_spaces(tmp_path, image, space, decoded):
    """The node's sourceColorSpace decides; automatic is sRGB for 8 bits in colour."""
    texture = only_material(
        load(tmp_path, textured(f'token inputs:sourceColorSpace = "{space}"') + mesh())
    ).albedo_texture
    expected = srgb_to_linear(image[..., :3]) if decoded else image[..., :3]
    np.testing.assert_allclose(texture.pixels, expected, atol=2.0**-11)


def test_a_linear_wide_gamut_is_converted(tmp_path):
    """An image in ACEScg red becomes Rec.709's, negative parts cut: the colour space is the attribute's."""
    write_image(tmp_path / "a.exr", np.float32([[[0.613, 0.070, 0.021]]]), oiio.FLOAT)
    text = textured(file="a.exr").replace("@a.exr@", '@a.exr@ (colorSpace = "lin_ap1_scene")')
    pixels = only_material(load(tmp_path, text + mesh())).albedo_texture.pixels
    np.testing.assert_allclose(pixels[0, 0], (1.0, 0.0, 0.0), atol=2e-3)


@pytest.mark.parametrize("name", ["lin_ap1_scene", "g22_rec709_scene", "srgb_p3d65_scene", "lin_rec2020", "acescg"])
def test_colour_spaces_by_name(tmp_path, image, name):
    """The node may name any of USD's spaces: the picture is what USD converts its colours to, cut at 0."""
    texture = only_material(
        load(tmp_path, textured(f'token inputs:sourceColorSpace = "{name}"') + mesh())
    ).albedo_texture
    known = {"lin_rec2020": "lin_rec2020_scene", "acescg": "lin_ap1_scene"}
    source, target = Gf.ColorSpace(known.get(name, name)), Gf.ColorSpace("lin_rec709_scene")
    expected = [target.Convert(source, Gf.Vec3f(*rgb)).GetRGB() for rgb in image[..., :3].reshape(-1, 3).tolist()]
    expected = np.clip(np.reshape(expected, (2, 3, 3)), 0.0, 1.0)
    np.testing.assert_allclose(texture.pixels, expected, atol=2.0**-10)


def test_an_unknown_colour_space_is_named(tmp_path, image):
    scene = load(tmp_path, textured('token inputs:sourceColorSpace = "crayon"') + mesh())
    assert warned(scene, "/A: inputs:file", "unknown colour space 'crayon'")


def test_a_normal_map(tmp_path):
    """The pixels of a normal map are vectors: 128/127.5 - 1 of a byte; beyond the image the surface is smooth."""
    pixels = np.uint8([[[0, 128, 255], [255, 128, 128]]])
    write_image(tmp_path / "a.png", pixels)
    scene = load(tmp_path, textured(f"{UNPACK}\n {RAW}", target="normal3f inputs:normal") + mesh())
    texture = only_material(scene).normal_texture
    np.testing.assert_allclose(texture.pixels, pixels / 127.5 - 1.0, atol=2.0**-11)
    assert texture.outside == (0.0, 0.0, 1.0) and not warned(scene, "normal")
    packed = load(tmp_path, textured(RAW, target="normal3f inputs:normal") + mesh())
    assert warned(packed, "/A: normal: its mean is strongly tilted")


@pytest.mark.parametrize("value, expected", [((0, 0, 1), None), ((0.6, 0, 0.8), (0.6, 0, 0.8)), ((0, 9, 1), (0, 1, 1))])
def test_constant_normals(tmp_path, value, expected):
    """One normal everywhere is an image of one texel; straight up is none."""
    texture = only_material(load(tmp_path, material_text(f"normal3f inputs:normal = {value}") + mesh())).normal_texture
    assert (texture is None) == (expected is None)
    if texture is not None:
        assert texture.pixels == pytest.approx(np.reshape(expected, (1, 1, 3)), abs=1e-3) and texture.uv == "st"


def test_colour_spaces_are_for_colours(tmp_path):
    """A prim's colour space does not turn vectors: normals, and primvars of numbers, are what they are."""
    api = '(prepend apiSchemas = ["ColorSpaceAPI"])'
    text = material_text("normal3f inputs:normal = (0.6, 0, 0.8)\n color3f inputs:diffuseColor = (0.5, 0.5, 0)")
    text = text.replace(
        'def Material "A" {', f'def Material "A" {api} {{\n uniform token colorSpace:name = "lin_ap1_scene"'
    )
    material = only_material(load(tmp_path, text + mesh()))
    assert material.normal_texture.pixels == pytest.approx(np.reshape((0.6, 0.0, 0.8), (1, 1, 3)), abs=1e-6)
    assert material.albedo != pytest.approx((0.5, 0.5, 0.0), abs=0.01)


SPACED = '{} (prepend apiSchemas = ["ColorSpaceAPI"{}]) {{\n uniform token colorSpace:name = "{}"\n'


def spaced(text, name, more="", api="", head='def Material "A"'):
    """The text with a colour space on its material."""
    return text.replace(head + " {", SPACED.format(head, api, name) + more)


@pytest.mark.parametrize(
    ("kind", "name", "counts"),
    [("exr", "lin_ap1_scene", True), ("exr", "srgb_p3d65_scene", False), ("png", "srgb_p3d65_scene", True),
     ("png", "lin_ap1_scene", False)],
)  # fmt: skip
def test_images_inherit_a_colour_space_that_they_can_have(tmp_path, kind, name, counts):
    """As on the attribute itself, if both are linear or neither is; else the image is what "auto" makes of it."""
    linear = kind == "exr"
    pixels = np.float32([[[0.5, 0.25, 0.125]]]) if linear else np.uint8([[[128, 64, 32]]])
    write_image(tmp_path / f"a.{kind}", pixels, oiio.FLOAT if linear else oiio.UINT8)
    text = textured(file=f"a.{kind}")
    found = only_material(load(tmp_path, spaced(text, name) + mesh())).albedo_texture.pixels
    own = text.replace(f"@a.{kind}@", f'@a.{kind}@ (colorSpace = "{name}")') if counts else text
    expected = only_material(load(tmp_path, own + mesh())).albedo_texture.pixels
    np.testing.assert_array_equal(found, expected)


def test_colour_spaces_that_a_stage_defines(tmp_path):
    """Primaries of a prim's own, here those of Rec. 2020, by ColorSpaceDefinitionAPI; an unknown one is named."""
    more = """uniform token colorSpaceDefinition:d:name = "mine"
        float2 colorSpaceDefinition:d:redChroma = (0.708, 0.292)
        float2 colorSpaceDefinition:d:greenChroma = (0.170, 0.797)
        float2 colorSpaceDefinition:d:blueChroma = (0.131, 0.046)
        float2 colorSpaceDefinition:d:whitePoint = (0.3127, 0.3290)
"""
    text = material_text("color3f inputs:diffuseColor = (0.5, 0.4, 0.3)")
    own = only_material(load(tmp_path, spaced(text, "mine", more, ', "ColorSpaceDefinitionAPI:d"') + mesh()))
    known = only_material(load(tmp_path, spaced(text, "lin_rec2020_scene") + mesh()))
    assert own.albedo == pytest.approx(known.albedo, abs=1e-4) and own.albedo[0] > 0.55
    assert only_material(load(tmp_path, spaced(text, "acescg") + mesh())).albedo[0] > 0.55
    assert warned(load(tmp_path, spaced(text, "crayon") + mesh()), "/A", "unknown colour space 'crayon'")


NORMALMAP = """
    def Shader "N" {
        uniform token info:id = "ND_normalmap_float"
        float3 inputs:in.connect = </A/I.outputs:out>
        float inputs:scale = 0.5
        SPACE
        float3 outputs:out
    }
    def Shader "I" {
        uniform token info:id = "ND_image_vector3"
        asset inputs:file = @a.png@
        float3 outputs:out
    }
"""


@pytest.mark.parametrize("surface", ["standard_surface", "open_pbr_surface"])
def test_normal_maps_of_materialx(tmp_path, surface):
    """The node normalmap unpacks and scales; other vectors are in world space, which images are not."""
    pixels = np.uint8([[[128, 128, 255], [255, 0, 128]]])
    write_image(tmp_path / "a.png", pixels)
    name = "normal" if surface == "standard_surface" else "geometry_normal"
    inputs = f"float3 inputs:{name}.connect = </A/N.outputs:out>"
    text = material_text(inputs, shader=f"ND_{surface}_surfaceshader", output="mtlx:surface").rstrip()[:-1]
    texture = only_material(load(tmp_path, text + NORMALMAP.replace("SPACE", "") + "}\n" + mesh())).normal_texture
    np.testing.assert_allclose(texture.pixels, (pixels / 127.5 - 1.0) * (0.5, 0.5, 1.0), atol=2.0**-11)
    world = text + NORMALMAP.replace("SPACE", 'string inputs:space = "object"') + "}\n" + mesh()
    assert warned(load(tmp_path, world), "/A", name, "tangent space")
    image = text.replace("A/N.", "A/I.") + NORMALMAP.replace("SPACE", "") + "}\n" + mesh()
    assert warned(load(tmp_path, image), "/A", name, "only normalmap is")


def test_transforms(tmp_path, image):
    """UsdTransform2d scales, then rotates counter-clockwise, then moves: (1, 0) goes to (0, 2) + (0.25, 0.5)."""
    nodes = (
        READER
        + """
    def Shader "X" {
        uniform token info:id = "UsdTransform2d"
        float2 inputs:in.connect = </A/R.outputs:result>
        float inputs:rotation = 90
        float2 inputs:scale = (2, 3)
        float2 inputs:translation = (0.25, 0.5)
        float2 outputs:result
    }"""
    )
    texture = only_material(load(tmp_path, textured(place="X.outputs:result", nodes=nodes) + mesh())).albedo_texture
    np.testing.assert_allclose(texture.transform @ (1, 0, 1), (0.25, 2.5), atol=1e-12)
    np.testing.assert_allclose(texture.transform @ (0, 1, 1), (-2.75, 0.5), atol=1e-12)


def test_unconnected_coordinates_are_one_point(tmp_path, image):
    """The schema's st is (0, 0), whatever the mesh has."""
    text = textured().replace("float2 inputs:st.connect = </A/R.outputs:result>", "")
    assert (only_material(load(tmp_path, text + mesh())).albedo_texture.transform == 0.0).all()


@pytest.mark.parametrize("kind", ["texCoord2f", "float2", "half2", "double2", "texCoord3f"])
@pytest.mark.parametrize("form", ["faceVarying", "indexed"])
def test_uv_sets_of_any_type(tmp_path, image, kind, form):
    """Face-varying, indexed, single, half or double; corners keep their values through triangulation."""
    third = ", 9" if kind == "texCoord3f" else ""
    pairs = [(0, 0), (1, 0), (1, 1), (0, 1)]
    if form == "indexed":
        values = ", ".join(f"({u}, {v}{third})" for u, v in pairs)
        more = f"int[] primvars:st:indices = [0, 1, 2, 3, 0, 1, 2, 3]\n {kind}[] primvars:st = [{values}]"
    else:
        more = f"{kind}[] primvars:st = [{', '.join(f'({u}, {v}{third})' for u, v in pairs * 2)}]"
    scene = load(tmp_path, textured() + mesh(more + ' (interpolation = "faceVarying")'))
    uvs = scene.meshes[0].uvs["st"]
    points = scene.meshes[0].points[scene.meshes[0].triangles]
    inside = points[..., :2] - np.array([1.0, 0.0]) * (points[..., :1].max(axis=1, keepdims=True) > 1.0)
    np.testing.assert_array_equal(uvs, inside)


def test_mirrored_instances_keep_theat_uv(tmp_path, image):
    """A mirrored copy has its corners turned round: each still has the coordinates of its point."""
    text = textured() + mesh().replace("rel material", "double3 xformOp:scale = (-1, 1, 1)\n uniform token[] "
                                       'xformOpOrder = ["xformOp:scale"]\n rel material')  # fmt: skip
    scene = load(tmp_path, text)
    points = scene.meshes[0].points[scene.meshes[0].triangles]
    np.testing.assert_array_equal(scene.meshes[0].uvs["st"], np.abs(points[..., :2]))


def test_coordinates_of_another_name(tmp_path, image):
    """A mesh that lacks the set that a material asks for, and has another, is textured by it: named."""
    scene = load(tmp_path, textured() + mesh(ST.replace("primvars:st", "primvars:UVMap")))
    np.testing.assert_array_equal(scene.meshes[0].uvs["st"], load(tmp_path, textured() + mesh()).meshes[0].uvs["st"])
    assert warned(scene, "/M", "no primvar 'st'", "'UVMap' is used")


@pytest.mark.parametrize(
    "more, word",
    [
        ("", "no primvar 'st'"),
        ("float2[] primvars:uv = [(0, 0)]", "no primvar 'st'"),
        ("texCoord2f[] primvars:st = [(0, 0)] (interpolation = 'vertex')", "are needed"),
        ("int primvars:st = 3", "not an array"),
        ("texCoord2f[] primvars:st = [(0, 0), (1, 0), (nan, 1), (0, 1), (inf, 0), (2, 1)] (interpolation = 'vertex')",
         "not finite"),
    ],
)  # fmt: skip
def test_bad_coordinates_are_named(tmp_path, image, more, word):
    """The surface shows one point of the texture, or what is finite; it renders."""
    scene = load(tmp_path, textured() + mesh(more))
    assert warned(scene, "/M", word)
    settings = ir.RenderSettings(width=4, height=4, iterations=1, light_paths=16)
    assert np.isfinite(ir.render(scene, settings, device="cpu").radiance()).all()


def test_udim_tiles_are_one_texture(tmp_path):
    """Tiles 1001 and 1012 lie at (0, 0) and (1, 1); those that are missing show the fallback."""
    for number, value in ((1001, 255), (1012, 51)):
        write_image(tmp_path / f"t.{number}.png", np.full((2, 2, 3), value, np.uint8))
    text = textured('float4 inputs:fallback = (0.5, 0.25, 0, 1)\n token inputs:sourceColorSpace = "raw"',
                    file="./t.<UDIM>.png")  # fmt: skip
    texture = only_material(load(tmp_path, text + mesh())).albedo_texture
    assert texture.pixels.shape == (4, 4, 3)
    np.testing.assert_allclose(texture.pixels[3, 0], 1.0)
    np.testing.assert_allclose(texture.pixels[0, 3], 0.2, atol=1e-3)
    np.testing.assert_allclose(texture.pixels[0, 0], (0.5, 0.25, 0.0))
    np.testing.assert_allclose(texture.transform @ (1, 2, 1), (0.5, 1.0))


def test_opacity(tmp_path, image):
    """Alpha with a threshold cuts; without one it lets its share through. Opaque alpha costs nothing."""
    target = "float inputs:opacity"
    cut = textured(output="a", target=f"float inputs:opacityThreshold = 0.5\n {target}")
    material = only_material(load(tmp_path, cut + mesh()))
    assert material.cutoff == 0.5
    np.testing.assert_allclose(material.opacity_texture.pixels[..., 0], image[..., 3], atol=2.0**-11)
    scene = load(tmp_path, textured(output="a", target=target) + mesh())
    assert only_material(scene).cutoff == 0.0 and warned(scene, "/A", "partial opacity")
    write_image(tmp_path / "a.png", np.full((2, 2, 4), 255, np.uint8))
    repeat = 'token inputs:wrapS = "repeat"\n token inputs:wrapT = "repeat"'
    opaque = only_material(load(tmp_path, textured(repeat, output="a", target=target) + mesh()))
    assert opaque.opacity_texture is None and opaque.opacity == 1.0


def test_a_textured_glow_lights_the_scene(tmp_path, image):
    """A room whose only light is a texture needs no default dome."""
    scene = load(tmp_path, textured(target="color3f inputs:emissiveColor") + mesh())
    assert scene.lights == () and max(only_material(scene).emission) > 0.0


def test_images_are_read_once_and_only_where_used(tmp_path, image):
    """Two materials and two outputs of one file: one image; a material without a surface: none."""
    second = textured().replace("</A", "</B").replace('"A"', '"B"')
    unused = textured(file="lost.png").replace("</A", "</C").replace('"A"', '"C"')
    scene = load(tmp_path, textured() + second + unused + mesh() + mesh(name="N").replace("</A>", "</B>"))
    assert (scene.stats["images"], scene.stats["textures"]) == (1, 1) and not warned(scene, "lost")


def test_more_pixels_than_the_budget(tmp_path, image, monkeypatch):
    """Images are averaged down, said once, and keep their mean."""
    monkeypatch.setattr("warp_ir.usd.images.cache.MAX_TEXTURE_PIXELS", 8)
    scene = load(tmp_path, textured('token inputs:sourceColorSpace = "raw"') + mesh())
    assert scene.stats["texels"] <= 4 and warned(scene, "a.png", "averaged down")


def test_black_metals(tmp_path):
    """The strict diffuse lobe is diffuseColor (1 - metallic)."""
    text = material_text("color3f inputs:diffuseColor = (1, 0.5, 0.25)\n float inputs:metallic = 0.75")
    assert only_material(load(tmp_path, text + mesh(), metals="black")).albedo == (0.25, 0.125, 0.0625)
    with pytest.raises(ir.InputError, match="metals"):
        load(tmp_path, text, metals="gold")
    with pytest.raises(ir.InputError, match="texture_wrap"):
        load(tmp_path, text, texture_wrap="round")


@pytest.mark.parametrize("interpolation", ["constant", "vertex"])
def test_primvars_as_colours(tmp_path, interpolation):
    """A diffuseColor that reads a primvar is that of the surface, and the reader's fallback where there is none."""
    reader = """def Shader "P" {
        uniform token info:id = "UsdPrimvarReader_float3"
        string inputs:varname = "paint"
        float3 inputs:fallback = (0.25, 0.5, 0.75)
        float3 outputs:result
    }"""
    reader = f"\n{reader}\n"
    text = material_text("color3f inputs:diffuseColor.connect = </A/P.outputs:result>").rstrip()[:-1] + reader + "}\n"
    colors = [(k / 8, 0.5, 0) for k in range(6 if interpolation == "vertex" else 1)]
    painted = mesh(f"color3f[] primvars:paint = {colors} (interpolation = '{interpolation}')")
    scene = load(tmp_path, text + painted + mesh("", "N"))
    one, two = scene.meshes
    if interpolation == "vertex":
        np.testing.assert_allclose(one.colors[..., 0], one.triangles / 8)
    else:
        assert one.colors is None and scene.materials[one.material[0]].albedo == (0.0, 0.5, 0.0)
    assert scene.materials[two.material[0]].albedo == (0.25, 0.5, 0.75)


def at_uv(texture, uv):
    """A texture at texture coordinates."""
    rows = tuple(tuple(row) for row in texture.transform.tolist())
    return look_up(ShadingValue(texture.pixels, np.zeros(3), UVMapping(texture.uv, rows, texture.wrap), None), uv)


def painted(nodes, primvars, inputs="color3f inputs:base_color.connect = </A/C.outputs:out>", name="standard_surface"):
    """A MaterialX surface with nodes that read primvars, on two meshes: one has the primvars."""
    text = material_text(inputs, shader=f"ND_{name}_surfaceshader", output="mtlx:surface").rstrip()[:-1]
    return text + "\n" + nodes + "}\n" + mesh(primvars) + mesh("", "N")


def reader(name, kind, fallback=0.25):
    value = {"float": f"{fallback}", "color3": f"({fallback}, {fallback}, {fallback})"}[kind]
    usd = {"float": "float", "color3": "color3f"}[kind]
    return f"""
    def Shader "{name}" {{
        uniform token info:id = "ND_geompropvalue_{kind}"
        string inputs:geomprop = "{name}"
        {usd} inputs:default = {value}
        {usd} outputs:out
    }}
"""


def test_arithmetic_on_primvars(tmp_path):
    """What nodes make of primvars is what the surface has, of one value or of many, of one primvar or of several."""
    nodes = (
        reader("r", "float")
        + reader("g", "float")
        + """
    def Shader "B" {
        uniform token info:id = "ND_multiply_float"
        float inputs:in1.connect = </A/g.outputs:out>
        float inputs:in2 = 0.5
        float outputs:out
    }
    def Shader "C" {
        uniform token info:id = "ND_combine3_color3"
        float inputs:in1.connect = </A/r.outputs:out>
        float inputs:in2.connect = </A/g.outputs:out>
        float inputs:in3.connect = </A/B.outputs:out>
        color3f outputs:out
    }
"""
    )
    vertices = "float[] primvars:r = [0, 0.1, 0.2, 0.3, 0.4, 0.5] (interpolation = 'vertex')"
    half = "float inputs:base = 0.5\n color3f inputs:base_color.connect = </A/C.outputs:out>"
    scene = load(tmp_path, painted(nodes, f"{vertices}\n float primvars:g = 0.75", half))
    one, two = scene.meshes
    expected = np.stack(np.broadcast_arrays(0.1 * one.triangles, 0.75, 0.375), axis=-1) * 0.5
    np.testing.assert_allclose(one.colors, expected, atol=1e-6)
    assert scene.materials[two.material[0]].albedo == pytest.approx((0.125, 0.125, 0.0625))
    scene = load(tmp_path, painted(nodes, "float primvars:r = 1\n float primvars:g = 0.75", half))
    assert scene.meshes[0].colors is None
    assert scene.materials[scene.meshes[0].material[0]].albedo == pytest.approx((0.5, 0.375, 0.1875))
    assert not warned(scene, "primvar")


@pytest.mark.parametrize(
    ("interpolation", "values", "expected"),
    [
        ("constant", [0.5], [0.5] * 4),
        ("uniform", [0.25, 0.75], [0.25, 0.25, 0.75, 0.75]),
        ("vertex", [0, 0, 0.75, 0.75, 0, 0.75], [0.25, 0.5, 0.25, 0.5]),
        ("faceVarying", [0, 0, 0.75, 0.75, 0.75, 0.75, 0.75, 0.75], [0.25, 0.5, 0.75, 0.75]),
    ],
)
def test_primvars_that_emit_or_are_not_there(tmp_path, interpolation, values, expected):
    """Emission and opacity are those of each triangle; within one, the mean; and the fallback where there is none."""
    primvars = f"float[] primvars:r = {values} (interpolation = '{interpolation}')"
    inputs = """float inputs:emission.connect = </A/r.outputs:out>
        float inputs:opacity.connect = </A/r.outputs:out>
        color3f inputs:emission_color = (4, 8, 16)"""
    scene = load(tmp_path, painted(reader("r", "float"), primvars, inputs))
    one, two = scene.meshes
    looks = [scene.materials[k] for k in one.material]
    np.testing.assert_allclose([m.emission for m in looks], np.outer(expected, (4, 8, 16)), rtol=1e-6)
    np.testing.assert_allclose([m.opacity for m in looks], expected, rtol=1e-6)
    assert scene.materials[two.material[0]].emission == (1.0, 2.0, 4.0)
    assert scene.materials[two.material[0]].opacity == 0.25
    assert warned(scene, "/M", "averaged over each triangle") == (interpolation in ("vertex", "faceVarying"))
    assert warned(scene, "/M", "partial opacity")


def test_primvars_cut_out(tmp_path):
    """A threshold is for what primvars say, and where they say nothing for the fallback: nothing may be there."""
    nodes = """
    def Shader "P" {
        uniform token info:id = "UsdPrimvarReader_float"
        string inputs:varname = "there"
        float outputs:result
    }
"""
    text = material_text("float inputs:opacity.connect = </A/P.outputs:result>\n float inputs:opacityThreshold = 0.5")
    text = text.rstrip()[:-1] + nodes + "}\n"
    there = "float[] primvars:there = [0.25, 0.75] (interpolation = 'uniform')"
    scene = load(tmp_path, text + mesh(there) + mesh("", "N"))
    (one,) = scene.meshes
    assert one.name == "/M" and len(one.triangles) == 2 and one.points[one.triangles][..., 0].min() == 1.0
    assert scene.stats["triangles_absent"] == 6 and only_material(scene).opacity == 1.0


@pytest.mark.parametrize(("mode", "glow"), [("", 4.0), ('token inputs:opacityMode = "presence"', 1.0)])
def test_what_is_transparent_emits_all_the_same(tmp_path, mode, glow):
    """opacityMode: a transparent surface emits as if it were opaque, one that is partly not there loses that part."""
    text = f"float inputs:opacity = 0.25\n color3f inputs:emissiveColor = (1, 1, 1)\n {mode}"
    material = only_material(load(tmp_path, material_text(text) + mesh()))
    assert material.emission == pytest.approx((glow,) * 3) and material.opacity == 0.25


def test_primvars_under_a_coat_and_of_metals(tmp_path):
    """A coat tints a primvar, and a strictly black metal keeps its part of it."""
    inputs = """color3f inputs:base_color.connect = </A/C.outputs:out>
        float inputs:base = 1
        float inputs:coat = 1
        color3f inputs:coat_color = (0.5, 1, 1)
        float inputs:metalness = 0.75"""
    text = painted(reader("C", "color3"), "color3f primvars:C = (0.5, 0.5, 0.25)", inputs)
    scene = load(tmp_path, text, metals="black")
    assert scene.materials[scene.meshes[0].material[0]].albedo == pytest.approx((0.0625, 0.125, 0.0625))
    assert scene.materials[scene.meshes[1].material[0]].albedo == pytest.approx((0.03125, 0.0625, 0.0625))


def test_an_image_times_a_primvar(tmp_path, image):
    """The product of both is seen on surfaces that have the primvar, and the image on the others."""
    nodes = (
        reader("p", "color3", 1.0)
        + """
    def Shader "I" {
        uniform token info:id = "ND_image_color3"
        asset inputs:file = @a.png@
        color3f outputs:out
    }
    def Shader "C" {
        uniform token info:id = "ND_multiply_color3"
        color3f inputs:in1.connect = </A/I.outputs:out>
        color3f inputs:in2.connect = </A/p.outputs:out>
        color3f outputs:out
    }
"""
    )
    base = "float inputs:base = 1\n color3f inputs:base_color.connect = </A/C.outputs:out>"
    text = painted(nodes, f"{ST}\n color3f[] primvars:p = [(0.5, 0.25, 0)]", base) + mesh(name="N2")
    scene = load(tmp_path, text)
    one, _, two = (scene.materials[m.material[0]] for m in scene.meshes)
    assert one.albedo_texture.uv == "st"
    uv = np.random.default_rng(0).random((1000, 2))
    seen, alone = (at_uv(texture, uv) for texture in (one.albedo_texture, two.albedo_texture))
    assert np.abs(seen - alone * (0.5, 0.25, 0)).mean() < _ERROR + 2.0**-11  # the bound to which patterns are baked
    assert two.albedo == pytest.approx(srgb_to_linear(image[..., :3]).mean(axis=(0, 1)), rel=1e-3)


@pytest.mark.parametrize(
    "name, weight, scattered, sheen",
    [
        ("standard_surface", "subsurface", "subsurface_color", "sheen"),
        ("open_pbr_surface", "subsurface_weight", "subsurface_color", "fuzz_weight"),
    ],
)
def test_subsurface_and_sheen(tmp_path, name, weight, scattered, sheen):
    """Scattering below the surface counts as diffuse reflection of its colour; sheen is named; metals have neither."""
    base = "base" if name == "standard_surface" else "base_weight"
    metal = "metalness" if name == "standard_surface" else "base_metalness"
    inputs = f"""float inputs:{base} = 1
        color3f inputs:base_color = (0.5, 0.5, 0.5)
        float inputs:{weight} = 0.25
        color3f inputs:{scattered} = (0.9, 0.1, 0.5)
        float inputs:{sheen} = 1
        """
    text = material_text(inputs, shader=f"ND_{name}_surfaceshader", output="mtlx:surface") + mesh("")
    scene = load(tmp_path, text)
    assert only_material(scene).albedo == pytest.approx((0.6, 0.4, 0.5))
    assert warned(scene, "/A", "subsurface", "diffuse") and warned(scene, "/A", "sheen is not rendered")
    scene = load(tmp_path, text.replace(f"float inputs:{sheen}", f"float inputs:{metal}"))
    assert only_material(scene).albedo == pytest.approx((0.5, 0.5, 0.5)) and not warned(scene, "sheen")


MATERIALX = """
    def Shader "I" {
        uniform token info:id = "ND_%s"
        asset inputs:file = @a.png@
        float2 inputs:uvtiling = (2, 3)
        float2 inputs:uvoffset = (0.5, 0)
        color3f inputs:default = (0.5, 0.25, 0)
        color3f outputs:out
    }
    def Shader "X" {
        uniform token info:id = "ND_multiply_color3"
        color3f inputs:in1.connect = </A/I.outputs:out>
        color3f inputs:in2 = (0.5, 1, 0)
        color3f outputs:out
    }
"""


def materialx(node="tiledimage_color3", nodes=MATERIALX):
    base = "color3f inputs:base_color.connect = </A/X.outputs:out>\n float inputs:base = 0.5"
    text = material_text(base, shader="ND_standard_surface_surfaceshader", output="mtlx:surface")
    return text.rstrip()[:-1] + (nodes % node if "%s" in nodes else nodes) + "}\n"


@pytest.mark.parametrize("node", ["tiledimage_color3", "image_color3"])
def test_materialx_images(tmp_path, image, node):
    """Images, tiled or not, multiplied and weighted; tiling is uv * n - offset, and repeats."""
    texture = only_material(load(tmp_path, materialx(node) + mesh())).albedo_texture
    np.testing.assert_allclose(texture.pixels, srgb_to_linear(image[..., :3]) * (0.25, 0.5, 0.0), atol=2.0**-11)
    assert texture.wrap == (Wrap.REPEAT, Wrap.REPEAT)
    tiled = [(2, 0, -0.5), (0, 3, 0)] if node.startswith("tiled") else [(1, 0, 0), (0, 1, 0)]
    np.testing.assert_array_equal(texture.transform, tiled)


def test_what_is_not_understood_is_named(tmp_path, image):
    """An unknown node, a loop of nodes and a missing file each give the default, in time."""
    view = MATERIALX.replace("ND_%s", "ND_viewdirection_vector3")
    assert warned(load(tmp_path, materialx(nodes=view) + mesh()), "/A", "viewdirection", "not supported")
    loop = MATERIALX.replace("(0.5, 1, 0)", "(1, 1, 1)").replace(
        "inputs:in1.connect = </A/I.", "inputs:in1.connect = </A/X."
    )
    loop = loop.replace("color3f inputs:in2 = (1, 1, 1)", "color3f inputs:in2.connect = </A/X.outputs:out>")
    start = time.monotonic()
    assert warned(load(tmp_path, materialx(nodes=loop) + mesh()), "/A", "too deep")
    assert time.monotonic() - start < 10.0
    scene = load(tmp_path, materialx(nodes=MATERIALX.replace("a.png", "lost.png")) + mesh())
    assert warned(scene, "/A", "lost.png", "not found") and only_material(scene).albedo == (0.125, 0.125, 0.0)


def test_the_same_scene_in_every_kind_of_file(tmp_path, image):
    """usda, usdc and usdz with the same texture give the same picture, bit for bit."""
    load(tmp_path, textured() + mesh())
    source = str(tmp_path / "stage.usda")
    Usd.Stage.Open(source).Export(str(tmp_path / "stage.usdc"))
    assert UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(source), str(tmp_path / "stage.usdz"))
    settings = ir.RenderSettings(width=16, height=16, iterations=2, light_paths=64)
    films = [
        ir.render(ir.load_usd(tmp_path / f"stage.{kind}"), settings, device="cpu") for kind in ("usda", "usdc", "usdz")
    ]
    assert all((film.radiance() == films[0].radiance()).all() for film in films[1:])
    assert films[0].aov("albedo").std() > 0.01


@pytest.mark.extended
@pytest.mark.parametrize(
    "file, images",
    [
        ("usdwg_teapot/full_assets/Teapot/DrawModes.usd", 2),
        ("usdwg_shaderball/full_assets/StandardShaderBall/standard_shader_ball_scene.usda", 6),
        ("usdwg_tests/test_assets/TextureFileFormatTests/all_files.usda", 8),
        ("usdwg_tests/test_assets/TextureTransformTest/TextureTransformTest.usd", 5),
        ("usdwg_tests/test_assets/AlphaBlendModeTest/AlphaBlendModeTest.usd", 2),
        ("usdwg_usdz/test_assets/USDZ/CesiumMan/CesiumMan.usdz", 1),
    ],
)
def test_real_files(file, images):
    """Files of others load with their images, and render."""
    scene = ir.load_usd(real_file(file))
    assert scene.stats["images"] == images
    settings = ir.RenderSettings(width=16, height=16, iterations=1, light_paths=64)
    assert np.isfinite(ir.render(scene, settings, device="cpu").radiance()).all()


def test_what_is_read_in_vain_is_named(tmp_path, image):
    """Normal maps, and primvars where only constants and images count, are said once; unset interfaces are not."""
    target = "float inputs:displacement"
    assert warned(load(tmp_path, textured(output="r", target=target) + mesh()), "/A", "displacement", "not rendered")
    cut = textured(target="float inputs:opacityThreshold", output="result").replace(
        "UsdUVTexture", "UsdPrimvarReader_float"
    )
    cut = cut.replace("asset inputs:file = @a.png@", 'string inputs:varname = "veil"\n float inputs:fallback = 1')
    assert warned(load(tmp_path, cut + mesh()), "/A", "opacityThreshold", "'veil'")
    plain = material_text("float inputs:displacement.connect = </A.inputs:unset>").replace(
        "token outputs:surface.connect", "float inputs:unset\n token outputs:surface.connect"
    )
    assert not warned(load(tmp_path, plain + mesh("")), "displacement")


@pytest.mark.parametrize(
    ("inputs", "terminal", "named"),
    [
        ("", "S.outputs:displacement", False),  # which exporters always connect
        ("float inputs:displacement = 0", "S.outputs:displacement", False),
        ("float inputs:displacement = 0.1", "S.outputs:displacement", True),
        ("", "D.outputs:out", True),
    ],
)
def test_displacement_is_named(tmp_path, inputs, terminal, named):
    """Where there is some: an amount, or a shader of its own; once, with the number of materials."""
    node = 'def Shader "D" {\n uniform token info:id = "ND_displacement_float"\n token outputs:out\n}\n'
    text = f"token outputs:displacement.connect = </A/{terminal}>\n {node}\n token outputs:surface.connect"
    text = material_text(inputs).replace("token outputs:surface.connect", text, 1)
    text = text.replace("token outputs:surface\n", "token outputs:surface\n token outputs:displacement\n")
    scene = load(
        tmp_path,
        text + text.replace('"A"', '"B"').replace("</A", "</B") + mesh() + mesh(name="N").replace("</A>", "</B>"),
    )
    assert warned(scene, "/A, /B", "displacement is not rendered (2 materials)") == named


@pytest.mark.parametrize(
    "inputs",
    [
        "float4 inputs:scale = (1e38, 1e38, 1e38, 1)",
        "float4 inputs:scale = (nan, 1, 1, 1)",
        "float4 inputs:bias = (inf, 0, 0, 0)",
        'token inputs:wrapS = "sideways"',
        "int inputs:sourceColorSpace = 3",
        "float4 inputs:fallback = (nan, nan, nan, nan)",
        "float2 inputs:st = (1e38, -1e38)",
    ],
)
def test_absurd_numbers_render(tmp_path, image, inputs):
    """Whatever a node says, the scene loads and its picture is finite."""
    scene = load(tmp_path, textured(inputs) + mesh())
    settings = ir.RenderSettings(width=4, height=4, iterations=1, light_paths=16)
    assert np.isfinite(ir.render(scene, settings, device="cpu").radiance()).all()


def test_a_subset_that_reads_primvars_leaves_the_other_faces_unbound(tmp_path):
    """The only material belongs to one face and reads a primvar; the other face has neither material nor colour."""
    subset = """    def GeomSubset "Part" (prepend apiSchemas = ["MaterialBindingAPI"])
    {
        uniform token elementType = "face"
        uniform token familyName = "materialBind"
        int[] indices = [0]
        rel material:binding = </A>
    }
"""
    mesh_text = f"""def Mesh "M"
{{
    point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
    int[] faceVertexCounts = [3, 3]
    int[] faceVertexIndices = [0, 1, 2, 0, 2, 3]
    color3f[] primvars:tint = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)] (interpolation = "vertex")
{subset}}}
"""
    reader = """def Material "A"
{
    token outputs:surface.connect = </A/S.outputs:surface>
    def Shader "S"
    {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor.connect = </A/R.outputs:result>
        token outputs:surface
    }
    def Shader "R"
    {
        uniform token info:id = "UsdPrimvarReader_float3"
        string inputs:varname = "tint"
        float3 outputs:result
    }
}
"""
    mesh_read = load(tmp_path, reader + mesh_text).meshes[0]
    np.testing.assert_allclose(mesh_read.colors[0], np.eye(3))
    np.testing.assert_allclose(mesh_read.colors[1], 0.18)


GLOSSY = """
    color3f inputs:diffuseColor = (0.5, 0.25, 0.125)
    float inputs:metallic = 0.75
    float inputs:roughness = 0.3
    float inputs:ior = 1.25
    float inputs:clearcoat = 0.5
    float inputs:clearcoatRoughness = 0.2"""


def test_gloss_is_read_on_request(tmp_path):
    """With materials "all", the parameters of UsdPreviewSurface beside its albedo are those of `Gloss`."""
    text = material_text(GLOSSY) + mesh()
    assert only_material(load(tmp_path, text)).gloss is None
    gloss = only_material(load(tmp_path, text, materials="all")).gloss
    found = gloss.base_color, gloss.metallic, gloss.roughness, gloss.ior, gloss.clearcoat, gloss.clearcoat_roughness
    assert np.allclose(np.hstack(found), [0.5, 0.25, 0.125, 0.75, 0.3, 1.25, 0.5, 0.2]) and gloss.specular_color is None
    with pytest.raises(ir.InputError, match="metals: 'black' has no effect"):
        load(tmp_path, text, materials="all", metals="black")


def test_gloss_of_the_specular_workflow(tmp_path):
    """The specular workflow gives the reflectance at normal incidence; nothing is said to be approximated."""
    text = material_text("int inputs:useSpecularWorkflow = 1\n color3f inputs:specularColor = (0.5, 0.25, 0.75)")
    scene = load(tmp_path, text + mesh(), materials="all")
    assert only_material(scene).gloss.specular_color == (0.5, 0.25, 0.75)
    assert not [line for line in scene.warnings if "specular" in line]
