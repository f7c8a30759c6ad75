"""Shading nodes against the definitions of MaterialX's own library, and patterns on surfaces."""

import re

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdShade

from tests.stages import load, material_text, mesh, only_material, warned, write_image
from warp_ir.scene import Wrap
from warp_ir.usd.images.cache import ImageCache
from warp_ir.usd.images.shading_value import ShadingValue, UVMapping, constant, look_up
from warp_ir.usd.shading import noise
from warp_ir.usd.shading.bake import _ERROR, FACE_TEXELS
from warp_ir.usd.shading.definitions import CHANNELS, NodeKind, graph_of
from warp_ir.usd.shading.hextile import HexTiling, blended, hex_tiles
from warp_ir.usd.shading.network import ShadingNetwork, _UsdNode
from warp_ir.usd.shading.operations import OPERATIONS, rotated, transformed
from warp_ir.usd.stage.materialx import available, standard_library
from warp_ir.usd.values.report import Report, Unreadable

pytestmark = [
    pytest.mark.extended,
    pytest.mark.skipif(not available(), reason="needs the package MaterialX"),
]
USD_TYPES = {1: "Double", 2: "Double2", 3: "Double3", 4: "Double4", 9: "Matrix3d", 16: "Matrix4d"}
UNREAD = {
    "artistic_ior",
    "bitangent",
    "bump",
    "chiang_hair_absorption_from_color",
    "chiang_hair_roughness",
    "deon_hair_absorption_from_melanin",
    "facingratio",
    "flake2d",
    "flake3d",
    "glossiness_anisotropy",
    "gooch_shade",
    "heighttonormal",
    "hextiledimage",  # without a file
    "hextilednormalmap",
    "reflect",
    "refract",
    "roughness_anisotropy",
    "roughness_dual",
    "standard_surface_to_gltf_pbr",
    "tangent",
    "viewdirection",
}
"""Nodes of the library that are named in warnings: they depend on the view, on tangents, or make no colour."""


def node_of(definition, rng=None, low=0.05, high=0.95):
    """A node of a definition in a stage of its own, with random numbers for its inputs; and these by name."""
    stage = Usd.Stage.CreateInMemory()
    shader = UsdShade.Shader.Define(stage, "/S")
    shader.SetShaderId(definition.getName())
    given = {}
    for port in definition.getActiveInputs() if rng is not None else ():
        channels = CHANNELS.get(port.getType())
        if channels is None:
            continue
        numbers = rng.uniform(low, high, channels)
        if port.getType() in ("integer", "boolean"):
            numbers = rng.integers(
                0, 2 if port.getName() == "operationorder" or port.getType() == "boolean" else 4, 1
            ).astype(np.float64)
        given[port.getName()] = numbers
        kind = getattr(Sdf.ValueTypeNames, USD_TYPES[channels])
        value = numbers[0] if channels == 1 else kind.type.pythonClass(*numbers.tolist())
        shader.CreateInput(port.getName(), kind).Set(value)
    network = ShadingNetwork(ImageCache(Report("test")), "/S", Usd.TimeCode(1))
    # The stage must live as long as its prims are used.
    return stage, network, _UsdNode(network, shader, 64), given


def numeric_definitions(names=None):
    return [
        definition
        for definition in standard_library().getNodeDefs()
        if definition.getType() in CHANNELS and (names is None or definition.getNodeString() in names)
    ]


GRAPHS = [d.getName() for d in numeric_definitions(OPERATIONS) if graph_of(d) is not None] if available() else []


@pytest.mark.parametrize("category", sorted({standard_library().getNodeDef(n).getNodeString() for n in GRAPHS}))
def test_closed_forms_are_the_graphs_of_the_library(category):
    """Where both exist, a node is what its graph of simpler nodes gives, for random inputs."""
    rng = np.random.default_rng(1)
    for definition in (standard_library().getNodeDef(n) for n in GRAPHS):
        if definition.getNodeString() != category:
            continue
        for _ in range(4):
            _stage, network, node, _ = node_of(definition, rng)
            kind = NodeKind(category, definition.getType())
            ours = network._computed(node, kind, "out").mean
            graph = network._graph(node, NodeKind(category, definition.getType(), definition), "out").mean
            np.testing.assert_allclose(
                *np.broadcast_arrays(ours, graph), rtol=1e-9, atol=1e-12, err_msg=definition.getName()
            )


GLSL = {
    "abs": np.abs,
    "floor": np.floor,
    "ceil": np.ceil,
    "round": np.round,
    "fract": lambda a: a - np.floor(a),
    "sign": np.sign,
    "sqrt": np.sqrt,
    "exp": np.exp,
    "log": np.log,
    "pow": np.power,
    "min": np.minimum,
    "max": np.maximum,
    "clamp": lambda a, low, high: np.minimum(np.maximum(a, low), high),
    "mix": lambda a, b, t: a * (1 - t) + b * t,
    "length": np.linalg.norm,
    "dot": np.dot,
    "cross": np.cross,
    "normalize": lambda a: a / np.linalg.norm(a),
    "mx_mod": lambda a, b: a - b * np.floor(a / b),
    **{f"mx_{name}": getattr(np, name) for name in ("sin", "cos", "tan")},
    "mx_asin": np.arcsin,
    "mx_acos": np.arccos,
    "mx_atan": np.arctan2,
    **{f"vec{n}": lambda *parts: np.concatenate([np.atleast_1d(part) for part in parts]) for n in (2, 3, 4)},
    "float": lambda a: a,
}
"""What the library's sources for GLSL call, for NumPy."""


def test_operations_are_the_sources_of_the_library():
    """The library's expressions for its GLSL target, evaluated by Python, give what the operations give."""
    rng, compared = np.random.default_rng(2), set()
    for definition in numeric_definitions(OPERATIONS):
        implementation = definition.getImplementation("genglsl")
        source = "" if implementation is None else implementation.getAttribute("sourcecode")
        if (
            not source
            or "matrix" in definition.getName()
            or "?" in source
            or "&" in source
            or "|" in source
            or "!" in source
        ):
            continue
        source = source.rstrip(";").replace(".xyz", "[:3]").replace(".a", "[3]").replace(".w", "[3]")
        expression = re.sub(r"\{\{(\w+)\}\}", r"in_\1", source)
        for _ in range(3):
            _stage, network, node, given = node_of(definition, rng)
            names = {f"in_{key}": value if len(value) > 1 else value[0] for key, value in given.items()}
            expected = np.atleast_1d(eval(expression, {**GLSL, **names}))  # the library's own text
            ours = network._computed(node, NodeKind(definition.getNodeString(), definition.getType()), "out").mean
            np.testing.assert_allclose(*np.broadcast_arrays(ours, expected), rtol=1e-9, err_msg=definition.getName())
        compared.add(definition.getNodeString())
    assert len(compared) > 45


def test_all_nodes_of_the_library_are_read_or_named():
    """Every node of the library that makes numbers has a value by default, but for those that are listed here."""
    unread = set()
    for definition in numeric_definitions():
        _stage, network, node, _ = node_of(definition)
        try:
            for output in definition.getOutputs():
                value = network._computed(
                    node, NodeKind(definition.getNodeString(), definition.getType(), definition), output.getName()
                )
                assert np.isfinite(value.pixels).all()
        except Unreadable:
            unread.add(definition.getNodeString())
    assert unread <= UNREAD


def test_noises_are_those_of_the_library():
    """Values of the library's `mx_noise.glsl`, compiled as C++, at two points; the tolerance is float32's."""
    points = np.array([[1.25, -2.5, 0.75], [-7.3, 4.1, 12.9]])
    flat = points[:, :2]
    expected = {
        "perlin": (
            noise.perlin(flat, 3),
            (0.402031839, 0.767074823, -0.596021473),
            (-0.434051841, -0.547169924, 0.335539937),
        ),
        "perlin 3d": (noise.perlin(points, 1), (0.0657166541,), (-0.251253992,)),
        "fractal": (
            noise.fractal(flat, 4, 3, 2.0, 0.5),
            (0.567431808, 0.518974841, -0.513321459, -0.376349598),
            (-0.405883789, -0.527330756, 0.640936375, 0.608307481),
        ),
        "fractal 3d": (
            noise.fractal(points, 4, 3, 2.0, 0.5),
            (0.127091646, -0.529696047, 0.024020493, -0.230927944),
            (-0.2161697, 0.212094292, 0.0599746332, -0.290673226),
        ),
        "worley": (
            noise.worley(flat, 3, 0.8, 0),
            (0.183217093, 0.783081412, 1.14226019),
            (0.118849002, 0.384814054, 0.464758277),
        ),
        "worley 3d": (
            noise.worley(points, 3, 1.0, 0),
            (0.704702735, 0.83113116, 1.02779722),
            (0.342394441, 0.669538796, 0.862002492),
        ),
        "solid": (
            noise.worley(flat, 3, 1.0, 1),
            (0.415509999, 0.478500575, 0.835977018),
            (0.86611712, 0.0926670581, 0.981447458),
        ),
        "cells": (noise.cell(points), (0.415509999,), (0.138385579,)),
    }
    for name, (ours, *values) in expected.items():
        np.testing.assert_allclose(ours, values, atol=3e-5, err_msg=name)


def test_gradient_noise_is_smooth_and_zero_at_the_lattice():
    """Perlin's noise vanishes at integers, lies in [-1, 1], and differs by less than its slope allows nearby."""
    rng = np.random.default_rng(3)
    assert np.abs(noise.perlin(rng.integers(-50, 50, (100, 3)).astype(float), 3)).max() == 0.0
    points = rng.uniform(-50.0, 50.0, (2000, 2))
    values = noise.perlin(points, 1)
    assert np.abs(values).max() <= 1.0 and abs(values.mean()) < 5.0 * values.std() / 2000**0.5
    assert np.abs(noise.perlin(points + 1e-6, 1) - values).max() < 2e-5


def test_hex_tiling():
    """The weights sum to 1; an image of one colour stays as it is; without randomness the copies coincide."""
    uv = np.random.default_rng(4).uniform(-3.0, 3.0, (500, 2))
    coordinates, weights = hex_tiles(uv, HexTiling())
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-12)
    assert weights.min() > -1e-12
    grey = [np.full((500, 3), 0.25)] * 3
    np.testing.assert_allclose(blended(grey, weights, 0.7, 0.5, np.array([0.3, 0.6, 0.1])), 0.25, rtol=1e-12)
    for st in hex_tiles(uv, HexTiling(rotation=0.0, scale=0.0, offset=0.0))[0]:
        np.testing.assert_allclose(st, uv, atol=1e-12)
    assert not np.allclose(coordinates[0], uv)


def test_vectors_are_rows():
    """MaterialX multiplies row vectors by matrices, and turns clockwise."""
    np.testing.assert_allclose(transformed(np.array([1.0, 2.0]), np.arange(9.0)), [1 * 0 + 2 * 3 + 6, 1 + 2 * 4 + 7])
    np.testing.assert_allclose(rotated(np.array([1.0, 0.0]), np.array([90.0])), [0.0, -1.0], atol=1e-15)


def pattern(nodes, colour="X", more="", shader="ND_standard_surface_surfaceshader"):
    """A material whose base colour is a node, on a square."""
    inputs = f"float inputs:base = 1\n color3f inputs:base_color.connect = </A/{colour}.outputs:out>"
    return material_text(inputs, shader=shader, output="mtlx:surface").rstrip()[:-1] + nodes + "}\n" + more


def node(name, identifier, inputs="", kind="color3f"):
    return f"""
    def Shader "{name}" {{
        uniform token info:id = "{identifier}"
        {inputs}
        {kind} outputs:out
    }}
"""


def seen(texture, corners, weights):
    """A texture at a point of each triangle."""
    rows = tuple(tuple(row) for row in texture.transform.tolist())
    value = ShadingValue(texture.pixels, np.zeros(3), UVMapping(texture.uv, rows, texture.wrap), None)
    return look_up(value, np.einsum("k,mkc->mc", weights, corners))


def test_a_checkerboard_is_a_texture(tmp_path):
    """Checks on texture coordinates become an image over the part of them that is used: half of it each colour."""
    checks = node(
        "X", "ND_checkerboard_color3", "color3f inputs:color1 = (0.8, 0.4, 0)\n color3f inputs:color2 = (0, 0.2, 0.6)"
    )
    scene = load(tmp_path, pattern(checks, more=mesh()))
    texture = only_material(scene).albedo_texture
    assert texture.uv == "st" and not warned(scene, "/A") and max(texture.pixels.shape) <= 2048
    np.testing.assert_allclose(texture.mean, (0.4, 0.3, 0.3), atol=2e-3)
    assert only_material(scene).albedo == texture.mean
    assert set(np.unique(texture.pixels[..., 0])) <= set(np.float16([0.0, 0.8]))


def test_a_pattern_of_positions_is_on_the_faces(tmp_path):
    """The position as a colour is seen at every point of every triangle, whatever its texture coordinates."""
    quarter = "float3 inputs:in1.connect = </A/O.outputs:out>\n float inputs:in2 = 0.25"
    nodes = node("X", "ND_multiply_vector3FA", quarter, "float3") + node("O", "ND_position_vector3", kind="float3")
    scene = load(tmp_path, pattern(nodes, more=mesh("")))
    shape, texture = scene.meshes[0], only_material(scene).albedo_texture
    assert texture.uv == FACE_TEXELS and shape.uvs[FACE_TEXELS].shape == (len(shape.triangles), 3, 2)
    for weights in np.random.default_rng(5).dirichlet((1, 1, 1), 20):
        expected = 0.25 * np.einsum("k,mkc->mc", weights, shape.points[shape.triangles])
        np.testing.assert_allclose(seen(texture, shape.uvs[FACE_TEXELS], weights), expected, atol=1e-3)


def test_noise_of_positions_is_fine_enough(tmp_path):
    """A noise on a square is seen with the mean error to which patterns are baked, `_ERROR`, and rounding to halves."""
    half = "float inputs:amplitude = 0.5\n float inputs:pivot = 0.5\n"
    nodes = node("N", "ND_noise3d_float", half + "float3 inputs:position.connect = </A/P.outputs:out>", "float")
    six = "float3 inputs:in1.connect = </A/O.outputs:out>\n float inputs:in2 = 6"
    nodes += node("P", "ND_multiply_vector3FA", six, "float3")
    nodes += node("O", "ND_position_vector3", kind="float3")
    nodes += node("X", "ND_convert_float_color3", "float inputs:in.connect = </A/N.outputs:out>")
    scene = load(tmp_path, pattern(nodes, more=mesh("")))
    shape, texture = scene.meshes[0], only_material(scene).albedo_texture
    errors = []
    for weights in np.random.default_rng(6).dirichlet((1, 1, 1), 200):
        points = np.einsum("k,mkc->mc", weights, shape.points[shape.triangles])
        expected = (noise.perlin(6.0 * points, 1) * 0.5 + 0.5).clip(0.0, 1.0)
        errors.append(np.abs(seen(texture, shape.uvs[FACE_TEXELS], weights) - expected))
    assert np.mean(errors) < 1.5 * _ERROR  # the error was estimated at 2048 other points


def test_images_of_several_mappings(tmp_path):
    """Two images with different tilings are multiplied where they are seen, not as means."""
    write_image(tmp_path / "a.png", np.uint8([[[255, 255, 255], [0, 0, 0]]]))
    text = node(
        "X",
        "ND_multiply_color3",
        "color3f inputs:in1.connect = </A/I.outputs:out>\n color3f inputs:in2.connect = </A/J.outputs:out>",
    )
    text += node("I", "ND_image_color3", "asset inputs:file = @a.png@")
    text += node("J", "ND_tiledimage_color3", "asset inputs:file = @a.png@\n float2 inputs:uvtiling = (2, 1)")
    texture = only_material(load(tmp_path, pattern(text, more=mesh()))).albedo_texture
    s = np.linspace(0.0, 1.0, 401)[:-1] + 1 / 800

    def image(s):  # two texels, bilinear, periodic
        return np.clip(np.abs(np.mod(s - 0.25, 1.0) - 0.5) * 2.0, 0.0, 1.0)

    expected = image(s) * image(2.0 * s)
    np.testing.assert_allclose(
        seen(texture, np.stack([s, 0 * s + 0.5], -1)[:, None].repeat(3, 1), np.ones(3) / 3)[:, 0], expected, atol=0.02
    )


def test_the_world_is_where_prims_are(tmp_path):
    """Positions in the world are those of the prim moved; those of the object are not."""
    for space, shift in (("world", 0.25), ("object", 0.0)):
        text = node("X", "ND_position_vector3", f'string inputs:space = "{space}"', "float3")
        moved = 'double3 xformOp:translate = (0, 0, 0.25)\n uniform token[] xformOpOrder = ["xformOp:translate"]'
        placed = f'def Xform "G" {{ {moved}\n {mesh("")} }}'
        texture = only_material(load(tmp_path, pattern(text, more=placed))).albedo_texture
        assert texture.mean[2] == pytest.approx(shift, abs=1e-3)


def test_a_custom_node_of_a_document(tmp_path):
    """A node that a .mtlx document defines by a graph is that graph, with the definition's defaults."""
    (tmp_path / "m.mtlx").write_text("""<?xml version="1.0"?>
<materialx version="1.39">
  <nodedef name="ND_tint" node="tint">
    <input name="in" type="color3" value="1, 1, 1"/>
    <input name="amount" type="float" value="0.5"/>
    <output name="out" type="color3"/>
  </nodedef>
  <nodegraph name="NG_tint" nodedef="ND_tint">
    <multiply name="m" type="color3">
      <input name="in1" type="color3" interfacename="in"/>
      <input name="in2" type="float" interfacename="amount"/>
    </multiply>
    <output name="out" type="color3" nodename="m"/>
  </nodegraph>
  <tint name="t" type="color3"><input name="in" type="color3" value="0.8, 0.4, 0.2"/></tint>
  <standard_surface name="s" type="surfaceshader">
    <input name="base" type="float" value="1"/>
    <input name="base_color" type="color3" nodename="t"/>
  </standard_surface>
  <surfacematerial name="A" type="material">
    <input name="surfaceshader" type="surfaceshader" nodename="s"/>
  </surfacematerial>
</materialx>""")
    text = 'def "D" (references = @m.mtlx@</MaterialX>) {}\n' + mesh(material="/D/Materials/A")
    assert only_material(load(tmp_path, text)).albedo == pytest.approx((0.4, 0.2, 0.1))


def test_what_depends_on_the_view_is_named(tmp_path):
    """A node by the view direction gives the default and is named."""
    text = node("X", "ND_convert_float_color3", "float inputs:in.connect = </A/F.outputs:out>")
    text += node("F", "ND_facingratio_float", kind="float")
    scene = load(tmp_path, pattern(text, more=mesh()))
    assert warned(scene, "/A", "ND_facingratio_float", "Vworld") and only_material(scene).albedo == (0.8, 0.8, 0.8)


def test_textures_of_realitykit_and_maya(tmp_path):
    """RealityKit's image is an image; Maya's file texture corrects its colours, and places it by a node of its own."""
    write_image(tmp_path / "a.png", np.uint8([[[255, 0, 0, 255], [255, 255, 255, 0]]]))
    image = "asset inputs:file = @a.png@\n"
    text = node("X", "ND_RealityKitTexture2D_color3", f'{image} string inputs:u_wrap_mode = "clamp_to_edge"')
    texture = only_material(load(tmp_path, pattern(text, more=mesh()))).albedo_texture
    assert texture.wrap == (Wrap.CLAMP, Wrap.REPEAT) and texture.pixels.shape == (1, 2, 3)
    corrected = "color3f inputs:inColor.connect = </A/I.outputs:out>\n color3f inputs:colorGain = (0.5, 1, 1)"
    text = node("X", "MayaND_fileTexture_color3", corrected)
    text += node("I", "ND_image_color3", image + "float2 inputs:texcoord.connect = </A/P.outputs:out>")
    text += node("P", "MayaND_place2dTexture_vector2", "float2 inputs:repeatUV = (4, 2)", "float2")
    texture = only_material(load(tmp_path, pattern(text, more=mesh()))).albedo_texture
    assert texture.pixels[0].tolist() == [[0.5, 0, 0], [0.5, 1, 1]]
    np.testing.assert_allclose(texture.transform, [[4, 0, 0], [0, 2, 0]], atol=1e-12)


def arnold(nodes, more):
    inputs = "float inputs:base = 1\n color3f inputs:base_color.connect = </A/X.outputs:out>"
    return material_text(inputs, shader="arnold:standard_surface").rstrip()[:-1] + nodes + "}\n" + more


def test_ramps_and_checks_of_arnold(tmp_path):
    """A linear ramp over u is its closed form; checks fill half of the area."""
    ramp = """token inputs:type = "u"
        float[] inputs:position = [0.25, 0.75]
        color3f[] inputs:color = [(0, 0, 0.2), (0.8, 0.4, 0.2)]
        int[] inputs:interpolation = [1, 1]"""
    texture = only_material(load(tmp_path, arnold(node("X", "arnold:ramp_rgb", ramp), mesh()))).albedo_texture
    s = np.linspace(0.01, 0.99, 50)
    colours = seen(texture, np.stack([s, 0 * s + 0.5], -1)[:, None].repeat(3, 1), np.ones(3) / 3)
    t = np.clip((s - 0.25) / 0.5, 0.0, 1.0)[:, None]
    np.testing.assert_allclose(colours, t * (0.8, 0.4, 0.0) + (0, 0, 0.2), atol=0.02)
    checks = "color3f inputs:color1 = (1, 1, 0)\n color3f inputs:color2 = (0, 1, 0)\n float inputs:u_frequency = 3"
    material = only_material(load(tmp_path, arnold(node("X", "arnold:checkerboard", checks), mesh())))
    assert material.albedo == pytest.approx((0.5, 1.0, 0.0), abs=2e-3)


def test_user_data_of_arnold(tmp_path):
    """A primvar by name, else the node's default."""
    user = node(
        "X", "arnold:user_data_rgb", 'string inputs:attribute = "tint"\n color3f inputs:default = (0.1, 0.2, 0.3)'
    )
    more = mesh("color3f primvars:tint = (0.3, 0.2, 0.1)") + mesh("", "N")
    scene = load(tmp_path, arnold(user, more))
    albedos = [scene.materials[m.material[0]].albedo for m in scene.meshes]
    assert albedos == [pytest.approx((0.3, 0.2, 0.1)), pytest.approx((0.1, 0.2, 0.3))]


def test_constants_of_the_closed_forms_are_broadcast():
    """One channel stands for all, in operations as well."""
    assert OPERATIONS["mix"].function(np.zeros(1), np.ones(3), np.full(1, 0.25)).tolist() == [0.25] * 3
    assert constant(0.5).pixels.shape == (1, 1, 1)
