"""MaterialX documents that stages refer to: what a reader with OpenUSD's plug-in would see."""

import zipfile

import numpy as np
import pytest
from pxr import Sdf

import warp_ir as ir
from tests import stages
from tests.stages import QUADS, load, only_material, real_file, warned, write_image
from warp_ir.usd.stage import materialx, mtlx_layers
from warp_ir.usd.values.source_color_space import srgb_to_linear

pytest.importorskip("MaterialX")

DOCUMENT = """<?xml version="1.0"?>
<materialx version="1.38" colorspace="lin_rec709">
  <nodegraph name="G">
    <input name="tint" type="color3" value="0.5, 0.5, 0.25"/>
    <image name="I" type="color3"><input name="file" type="filename" value="a.png" colorspace="srgb_texture"/></image>
    <multiply name="T" type="color3">
      <input name="in1" type="color3" nodename="I"/> <input name="in2" type="color3" interfacename="tint"/>
    </multiply>
    <output name="out" type="color3" nodename="T"/>
  </nodegraph>
  <constant name="half" type="float"><input name="value" type="float" value="0.5"/></constant>
  <standard_surface name="S" type="surfaceshader">
    <input name="base" type="float" value="1"/>
    <input name="base_color" type="color3" value="0.25, 0.5, 0.75"/>
    <input name="emission" type="float" nodename="half"/>
    <input name="emission_color" type="color3" value="4, 2, 1"/>
  </standard_surface>
  <standard_surface name="SG" type="surfaceshader">
    <input name="base" type="float" value="1"/>
    <input name="base_color" type="color3" nodegraph="G" output="out"/>
  </standard_surface>
  <surfacematerial name="A" type="material">
    <input name="surfaceshader" type="surfaceshader" nodename="S"/>
  </surfacematerial>
  <surfacematerial name="Picture" type="material">
    <input name="surfaceshader" type="surfaceshader" nodename="SG"/>
  </surfacematerial>
</materialx>
"""
ROOT = 'def "MaterialX" (references = @./looks.mtlx@</MaterialX>) {\n}\n'


def mesh(binding="/MaterialX/Materials/A", name="M"):
    return stages.mesh(name=name, material=binding)


@pytest.fixture
def looks(tmp_path):
    """looks.mtlx beside the stage."""
    (tmp_path / "looks.mtlx").write_text(DOCUMENT)
    return tmp_path


def test_a_referenced_document(looks):
    """Values, and nodes that lie outside of graphs, feed the surface; the material is where USD's plug-in puts it."""
    material = only_material(load(looks, ROOT + mesh()))
    assert material.albedo == pytest.approx((0.25, 0.5, 0.75)) and material.emission == pytest.approx((2.0, 1.0, 0.5))
    assert material.name == "/MaterialX/Materials/A"


def test_graphs_images_and_interfaces(looks):
    """An image beside the document, tinted by an input of its graph."""
    pixels = np.uint8([[[10, 200, 90], [255, 0, 127]]])
    write_image(looks / "a.png", pixels)
    scene = load(looks, ROOT + mesh("/MaterialX/Materials/Picture"))
    expected = srgb_to_linear(pixels / 255.0) * (0.5, 0.5, 0.25)
    np.testing.assert_allclose(only_material(scene).albedo_texture.pixels, expected, atol=2.0**-11)
    assert not warned(scene, "MaterialX")


def test_stronger_opinions_win(looks):
    """A stage changes a value on the material's interface; the default prim need not be named."""
    over = """def "MaterialX" (references = @./looks.mtlx@) {
    over "Materials"
    {
        over "A"
        {
            color3f inputs:base_color = (0.125, 0.125, 0.125)
        }
    }
}
"""
    assert only_material(load(looks, over + mesh())).albedo == (0.125, 0.125, 0.125)


def test_as_a_sublayer(looks):
    assert only_material(load(looks, "(subLayers = [@looks.mtlx@])\n" + mesh())).albedo == pytest.approx(
        (0.25, 0.5, 0.75)
    )


def test_inside_instances_payloads_variants_and_packages(looks):
    """Wherever the reference lies: an asset that is instanced, behind a payload, in a variant, in a package."""
    asset = f"""#usda 1.0
(defaultPrim = "P")
def Xform "P" (
    variants = {{ string look = "off" }}
    prepend variantSets = "look"
) {{
    def Mesh "M" (prepend apiSchemas = ["MaterialBindingAPI"]) {{{QUADS}
        rel material:binding = </P/Looks/Materials/A>
    }}
    variantSet "look" = {{
        "off" {{
        }}
        "on" {{
            def "Looks" (payload = @./looks.mtlx@</MaterialX>) {{
            }}
        }}
    }}
}}
"""
    (looks / "asset.usda").write_text(asset)
    stage = """def Xform "A" (
    instanceable = true
    references = @./asset.usda@
    variants = { string look = "on" }
) {
}
def Xform "B" (
    instanceable = true
    references = @./asset.usda@
    variants = { string look = "on" }
) {
    double3 xformOp:translate = (9, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
"""
    scene = load(looks, stage)
    assert [m.albedo for m in scene.materials] == [pytest.approx((0.25, 0.5, 0.75))]
    assert scene.stats["native_instances"] == 2
    (looks / "one.usda").write_text("#usda 1.0\n" + stage.replace('"on"', '"off"'))
    chosen = ir.load_usd(looks / "one.usda", variants=["/A{look=on}", "/B{look=on}"])
    assert [m.albedo for m in chosen.materials] == [m.albedo for m in scene.materials]
    with Sdf.ZipFileWriter.CreateNew(str(looks / "all.usdz")) as package:
        for name in ("stage.usda", "asset.usda", "looks.mtlx"):
            package.AddFile(str(looks / name), name)
    assert zipfile.ZipFile(looks / "all.usdz").namelist()[2] == "looks.mtlx"
    packed = ir.load_usd(looks / "all.usdz")
    assert [m.albedo for m in packed.materials] == [m.albedo for m in scene.materials]


def test_from_a_session_layer_and_under_a_mask(looks):
    """A session layer refers to a document as any other; what a layer says beside it, odd paths too, stays."""
    paint = f"(subLayers = [@looks.mtlx@])\n{mesh().replace('def Mesh', 'over')}asset odd = @[[[::@\n"
    (looks / "session.usda").write_text("#usda 1.0\n" + paint.replace("asset odd", 'def "X" {\nasset odd') + "}\n")
    text = f'def Mesh "M" {{{QUADS}}}\ndef Mesh "N" {{{QUADS}}}\n'
    scene = load(looks, text, session_layer=looks / "session.usda", mask=["/M"])
    assert only_material(scene).albedo == pytest.approx((0.25, 0.5, 0.75)) and len(scene.meshes) == 1


def test_the_colour_space_of_a_document(looks):
    """The numbers of a document are in its colour space: this is Rec. 709's red in ACEScg."""
    text = DOCUMENT.replace('colorspace="lin_rec709"', 'colorspace="acescg"')
    (looks / "looks.mtlx").write_text(text.replace("0.25, 0.5, 0.75", "0.613097, 0.070194, 0.020616"))
    assert only_material(load(looks, ROOT + mesh())).albedo == pytest.approx((1.0, 0.0, 0.0), abs=1e-5)


def test_what_others_share_is_left_alone(looks):
    """Layers on the disk, and those that the process has open, are as they were."""
    (looks / "stage.usda").write_text("#usda 1.0\n" + ROOT + mesh())
    theirs = Sdf.Layer.FindOrOpen(str(looks / "stage.usda"))
    before = theirs.ExportToString()
    ir.load_usd(looks / "stage.usda")
    assert theirs.ExportToString() == before and not theirs.dirty


def test_textures_of_the_copied_layers(looks):
    """A layer that refers to a document also names images: they are found beside it as before, tiles too."""
    for tile in (1001, 1002):
        write_image(looks / f"t.{tile}.png", np.full((1, 1, 3), 255, np.uint8))
    text = """
def Material "T" {
    token outputs:surface.connect = </T/S.outputs:surface>
    def Shader "S" {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor.connect = </T/I.outputs:rgb>
        token outputs:surface
    }
    def Shader "I" {
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @t.<UDIM>.png@
        float2 inputs:st.connect = </T/R.outputs:result>
        float3 outputs:rgb
    }
    def Shader "R" {
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "st"
        float2 outputs:result
    }
}
"""
    scene = load(looks, ROOT + text + mesh("/T"))
    assert only_material(scene).albedo_texture.pixels.shape[:2] == (1, 2) and not warned(scene, "image")


BAD = {
    "no XML": "<materialx version='1.38'><surfacematerial",
    "nested too deeply": "<materialx>" + "<a>" * 500 + "</a>" * 500 + "</materialx>",
    "declaration has no end": '<!DOCTYPE x [<!ENTITY a "b">] ',
    "mismatch": "<materialx version='1.38'><a></b></materialx>",
    "no MaterialX": "<usd/>",
    "bytes; the limit": "<materialx>" + " " * 2**24 + "</materialx>",
    "included documents are not read": DOCUMENT.replace("<nodegraph", '<xi:include href="b.mtlx"/><nodegraph', 1),
    "which is not there": DOCUMENT.replace('nodename="half"', 'nodename="nobody"'),
}


DECLARATION = '<?xml version="1.0"?>'
LENIENT = {
    "blanks": " \n\t" + DECLARATION + DOCUMENT.removeprefix(DECLARATION),
    "mark": "\ufeff " + DECLARATION + DOCUMENT.removeprefix(DECLARATION),
    "comment": "<!-- <a> -->" + DECLARATION + DOCUMENT.removeprefix(DECLARATION),
    "text": "A&B " + DOCUMENT + " & <materialx/> the end \0 <a",
    "type": '<!DOCTYPE materialx [<!ELEMENT a (b)> <!ENTITY c "]>"> <!-- ]> --> <?x ]>?>]>'
    + DOCUMENT.removeprefix(DECLARATION),
    "attributes": DOCUMENT.replace("<nodegraph", """<nodegraph doc="a < b & c > d />" note='"<x>"'""", 1),
    "data": DOCUMENT.replace("<nodegraph", "<![CDATA[" + "<a>" * 100 + "]]><?x <b> ?><nodegraph", 1),
}
"""Documents that USD's own reader takes, though they are no well-formed XML or seldom written so."""


@pytest.mark.parametrize("text", LENIENT.values(), ids=LENIENT)
def test_what_the_librarys_parser_reads(looks, text):
    """The file gives the same scene as without the oddity."""
    expected = only_material(load(looks, ROOT + mesh()))
    (looks / "looks.mtlx").write_text(text, encoding="utf-8")
    scene = load(looks, ROOT + mesh())
    assert only_material(scene).albedo == expected.albedo and not warned(scene, "MaterialX document")


@pytest.mark.parametrize("head", ['<a b="', "<!--", "<?", "<![CDATA[", "<!DOCTYPE ", "</"])
def test_depth_is_found_behind_any_markup(tmp_path, head):
    """What hides elements from the check hides them from the parser as well, which recurses."""
    end = {"<a b=": '"/>', "<!--": "-->", "<?": "?>", "<![CDATA[": "]]>", "<!DOCTYPE ": ">", "</": ">"}[
        head.rstrip('"')
    ]
    inner = "<b>" if head.startswith("<a") else "x"
    text = f"{head}{inner}{end}<materialx>" + "<a>" * 500 + "</a>" * 500 + "</materialx>"
    (tmp_path / "looks.mtlx").write_text(text)
    assert warned(load(tmp_path, ROOT + mesh()), "looks.mtlx", "nested too deeply")


@pytest.mark.parametrize("words", BAD)
def test_bad_documents_are_named(tmp_path, words):
    """One line that names the document; everything else is loaded."""
    (tmp_path / "looks.mtlx").write_text(BAD[words])
    scene = load(tmp_path, ROOT + mesh())
    assert warned(scene, "/: MaterialX document", "looks.mtlx", words) and scene.triangle_count == 4
    assert not warned(scene, "composition")


@pytest.mark.parametrize(
    "old, new",
    [
        ('nodename="half"', 'nodename="S"'),
        ('<input name="value" type="float" value="0.5"/>', '<input name="value" type="float" nodename="half"/>'),
        ('nodename="I"', 'nodename="T"'),
        ('value="0.25, 0.5, 0.75"', 'value="nan, 1e999, x"'),
        ('name="A" type="material"', 'name="a:b c" type="material"'),
        ('type="color3" nodegraph="G"', 'type="matrix44" nodegraph="G"'),
        ("standard_surface", "nobody_knows"),
    ],
)
def test_odd_documents_are_survived(tmp_path, old, new):
    """Circles, wrong types, values that are none."""
    (tmp_path / "looks.mtlx").write_text(DOCUMENT.replace(old, new))
    assert load(tmp_path, ROOT + mesh() + mesh("/MaterialX/Materials/Picture", "N")).triangle_count == 8


def test_without_the_package(looks, monkeypatch):
    monkeypatch.setattr(mtlx_layers, "available", lambda: False)
    assert warned(load(looks, ROOT + mesh()), "/: 1 .mtlx files cannot be read", "MaterialX is not installed")


def test_many_materials_that_share_a_graph_are_bounded(looks, monkeypatch):
    """Every material has its own copy of its nodes, up to a limit."""
    monkeypatch.setattr(materialx, "_MAX_PRIMS", 5)
    assert warned(load(looks, ROOT + mesh()), "more than 5 nodes")


@pytest.mark.extended
def test_twins_by_reference_and_inline():
    """A Cornell box whose materials are a document equals the one that holds them itself."""
    folder = real_file("cornell_pablode/cornell-box")
    one, other = (ir.load_usd(folder / kind / "cornell-box.usda") for kind in ("mtlx-ref", "mtlx-usdshade"))
    assert [(m.albedo, m.emission) for m in one.materials] == [(m.albedo, m.emission) for m in other.materials]
