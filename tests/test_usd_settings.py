"""RenderSettings, products and variables; masks, variants and session layers: what of a stage is rendered, and how."""

import json
import os
import random
import re
from pathlib import Path

import numpy as np
import pytest
from pxr import Tf, UsdGeom

from tests.stages import QUADS, diffuse, load, material_text, mesh, only_material, textured, warned, write_image
from warp_ir import InputError, RenderSettings, load_usd
from warp_ir.cli import main
from warp_ir.cli.arguments import parse
from warp_ir.image.io import read_image
from warp_ir.usd.load import StageReader

FEW = ["--iterations", "1", "--light-paths", "16", "--device", "cpu", "-q"]

ROOM = """
def Mesh "Floor" {
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
}
def SphereLight "Light" {
    double3 xformOp:translate = (0, 0, 2)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
def Camera "A" {
    float horizontalAperture = 20
    float verticalAperture = 10
    float2 clippingRange = (0.01, 100)
    double3 xformOp:translate = (0, 0, 4)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
def Camera "B" {
    float horizontalAperture = 10
    float verticalAperture = 10
    float2 clippingRange = (0.01, 100)
    double3 xformOp:translate = (0, 0, 5)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
"""

SETTINGS = """
def Scope "Render" {
    def RenderSettings "S" {
        int2 resolution = (40, 10)
        float pixelAspectRatio = 2
        token aspectRatioConformPolicy = "cropAperture"
        float4 dataWindowNDC = (0.1, 0.2, 0.9, 1)
        bool disableDepthOfField = 1
        bool disableMotionBlur = 1
        token[] includedPurposes = ["default", "proxy"]
        int warp_ir:lightPaths = 32
        int warp_ir:max_bounces = 3
        bool warp_ir:visible_lights = 1
        int warp_ir:wings = 2
        int warp_ir:seed = -4
        rel camera = </B>
        rel products = [</Render/P>, </Render/Q>, </Render/Gone>]
    }
    def RenderProduct "P" {
        token productName = "/etc/../out/beauty.exr"
        rel orderedVars = [</Render/C>, </Render/N>, </Render/Z>, </Render/Odd>, </Render/Even>]
    }
    def RenderProduct "Q" {
        int2 resolution = (8, 4)
        rel camera = </A>
        token productName = ""
    }
    def RenderVar "C" { string sourceName = "Ci"
    }
    def RenderVar "N" { string sourceName = "N"
    }
    def RenderVar "Z" { string sourceName = "depth"
    }
    def RenderVar "Odd" { string sourceName = "caustics"
    }
    def RenderVar "Even" { string sourceName = "sheen"
    }
}
"""


def stage(folder: Path, text: str, metadata: str = "") -> Path:
    file = folder / "stage.usda"
    file.write_text(f"#usda 1.0\n({metadata})\n{text}")
    return file


# ---- RenderSettings --------------------------------------------------------------------------------------


def test_settings_become_ours(tmp_path):
    """Every attribute of RenderSettings that a diffuse renderer can honour is a field of RenderSettings."""
    scene = load_usd(stage(tmp_path, ROOM + SETTINGS))
    assert RenderSettings(**scene.settings) == RenderSettings(
        width=40, height=10, pixel_aspect=2.0, conform="cropAperture", data_window=(0.1, 0.2, 0.9, 1.0),
        depth_of_field=False, motion_blur=False, light_paths=32, max_bounces=3, visible_lights=True,
    )  # fmt: skip
    assert scene.camera.name == "/B"
    assert warned(scene, "/Render/S", "warp_ir:wings", "not a setting") and warned(scene, "/Render/S", "warp_ir:seed")
    assert warned(scene, "/Render/S", "/Render/Gone") and warned(
        scene, "/Render/Odd, /Render/Even", "'caustics', 'sheen'"
    )
    assert warned(scene, "/Render/P", "/etc/../out/beauty.exr", "'beauty.exr'")


def test_products_override_only_what_they_author(tmp_path):
    """A product has the values of the settings but for its own; a name without a folder; variables as AOVs."""
    first, second = StageReader(stage(tmp_path, ROOM + SETTINGS)).spec().products
    assert (first.name, first.camera, first.aovs) == ("beauty.exr", "/B", ("normal", "depth"))
    assert first.settings["width"] == 40 and first.settings["conform"] == "cropAperture"
    assert (second.name, second.camera, second.aovs) == ("Q.exr", "/A", ())
    assert dict(second.settings) == {**first.settings, "width": 8, "height": 4}


def test_which_settings_count(tmp_path):
    """Those that are named, else those of the metadata, else the first; a schema's fallbacks count as well."""
    text = 'def RenderSettings "S" { int2 resolution = (3, 4)\n}\ndef RenderSettings "T" {\n}\n'
    scene = load_usd(stage(tmp_path, text))
    assert scene.settings["width"] == 3 and warned(scene, "/S", "first of 2")
    scene = load_usd(stage(tmp_path, text, 'renderSettingsPrimPath = "/T"'))
    assert (scene.settings["width"], scene.settings["height"]) == (2048, 1080) and not warned(scene, "first of")
    assert load_usd(tmp_path / "stage.usda", render_settings="/S").settings["width"] == 3
    with pytest.raises(InputError, match="no render settings '/U'; available: /S, /T"):
        load_usd(tmp_path / "stage.usda", render_settings="/U")
    scene = load_usd(stage(tmp_path, text, 'renderSettingsPrimPath = "/Gone"'))
    assert warned(scene, "/", "/Gone", "not a RenderSettings")
    assert load_usd(stage(tmp_path, ROOM)).settings == {}


def test_impossible_settings_are_named_and_not_used(tmp_path):
    """The rest counts."""
    text = """def RenderSettings "S" {
        int2 resolution = (0, -5)
        float pixelAspectRatio = 0
        token aspectRatioConformPolicy = "stretch"
        float4 dataWindowNDC = (1, 1, 0, 0)
        string warp_ir:estimator = "magic"
        double warp_ir:time_limit = inf
        float[] warp_ir:seed = [1, 2]
        int warp_ir:iterations = 7
    }"""
    scene = load_usd(stage(tmp_path, ROOM + text))
    assert RenderSettings(**scene.settings) == RenderSettings(iterations=7)
    for name in ("resolution", "pixelAspectRatio", "aspectRatioConformPolicy", "dataWindowNDC", "warp_ir:estimator"):
        assert warned(scene, "/S", name)


def test_purposes_of_the_settings(tmp_path):
    """What includedPurposes name is drawn, unless the user names others."""
    text = ROOM + SETTINGS + 'def Cube "Proxy" { uniform token purpose = "proxy"\n}\n'
    file = stage(tmp_path, text)
    assert [mesh.name for mesh in load_usd(file).meshes] == ["/Floor", "/Proxy"]
    assert [mesh.name for mesh in load_usd(file, purposes=("default",)).meshes] == ["/Floor"]


# ---- on the command line ---------------------------------------------------------------------------------


def test_the_command_line_beats_the_settings(tmp_path):
    """What is not given comes from the stage; a width alone keeps the shape of its resolution."""
    text = ROOM + 'def RenderSettings "S" { int2 resolution = (16, 4)\n int warp_ir:iterations = 3\n}\n'
    file, picture, stats = stage(tmp_path, text), tmp_path / "a.npy", tmp_path / "s.json"
    command = ["render", str(file), str(picture), "--device", "cpu", "-q", "--stats", str(stats)]

    def size(*more):
        assert main([*command, *more]) == 0
        return (*read_image(picture).shape[1::-1], json.loads(stats.read_text())["iterations"])

    assert size() == (16, 4, 3)
    assert size("-w", "8") == (8, 2, 3)
    assert size("--height", "2", "--iterations", "1") == (8, 2, 1)
    assert size("--res", "6", "6") == (6, 6, 3)


def test_products_go_to_the_folder_of_the_user(tmp_path):
    """A folder in place of the picture: every product by its base name, with its variables; nothing anywhere else."""
    file, out = stage(tmp_path, ROOM + SETTINGS), tmp_path / "out"
    assert main(["render", str(file), f"{out}/", *FEW, "--make-output-path"]) == 0
    assert sorted(os.listdir(out)) == ["Q.exr", "beauty.exr"]
    # 40 x 10 pixels, of them columns 4 ... 35 and rows 0 ... 7.
    assert read_image(out / "beauty.exr").shape == (8, 32, 4)
    assert read_image(out / "beauty.exr", layer="normal").shape == (8, 32, 3)
    assert read_image(out / "Q.exr").shape == (3, 6, 4)
    assert main(["render", str(file), str(out), *FEW, "--frames", "1:2"]) == 0
    assert sorted(os.listdir(out)) == ["Q.0002.exr", "Q.exr", "beauty.0002.exr", "beauty.exr"]


def test_a_folder_without_products_is_an_error(tmp_path, capsys):
    """There is no name for the picture."""
    assert main(["render", str(stage(tmp_path, ROOM)), str(tmp_path), *FEW]) == 2
    assert "has no RenderProducts" in capsys.readouterr().err


@pytest.mark.parametrize(
    "name", ["../../evil.exr", "C:\\\\evil.exr", "..", "/", "a\\nb.exr", "render.$F4.exr", "x.bmp", "sub/dir/"]
)
def test_a_stage_names_no_place_to_write(tmp_path, name):
    """Whatever a productName says, one file appears, in the user's folder."""
    text = f'def RenderSettings "S" {{ rel products = </P>\n int2 resolution = (2, 2)\n}}\n' \
           f'def RenderProduct "P" {{ token productName = "{name}"\n}}\n'  # fmt: skip
    out = tmp_path / "a" / "b"
    out.mkdir(parents=True)
    assert main(["render", str(stage(tmp_path, ROOM + text)), str(out), *FEW]) == 0
    files = [path for path in tmp_path.rglob("*") if path.is_file() and path.name != "stage.usda"]
    assert len(files) == 1 and files[0].parent == out and files[0].suffix == ".exr"


def test_info_lists(tmp_path, capsys):
    """--list is a line each, for scripts; the table and --json tell of settings, products and costs."""
    file = str(stage(tmp_path, ROOM + SETTINGS))
    assert main(["info", file, "--list", "cameras"]) == 0
    assert capsys.readouterr().out == "/A\n/B\n"
    assert main(["info", file, "--list", "settings"]) == 0
    assert "beauty.exr  /Render/P: width 40" in capsys.readouterr().out
    assert main(["info", file, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["render_settings"]["products"][0]["aovs"] == ["normal", "depth"]
    assert facts["cost"]["load_seconds"] > 0.0 and facts["moving_meshes"] == 0
    assert main(["info", file]) == 0
    assert "costs" in capsys.readouterr().out


def test_info_tells_what_materials_are(tmp_path, capsys, monkeypatch):
    """Opacity, cut-outs and textures stand beside the colours, and of what there is nothing of no count is shown."""
    image = np.zeros((1, 1, 4), np.uint8)
    write_image(tmp_path / "a.png", image)
    half = material_text("float inputs:opacity = 0.5", "B") + mesh(name="N").replace("</A>", "</B>")
    file = stage(
        tmp_path, textured("float inputs:opacityThreshold = 0.25") + mesh() + half, "startTimeCode = 3\nendTimeCode = 4"
    )
    monkeypatch.setattr(UsdGeom, "GetStageMetersPerUnit", refuse)  # as for a value of another type
    assert main(["info", str(file), "-q"]) == 0
    out = capsys.readouterr().out
    assert (
        ", a.png  /A" in out and ", opacity 0.5  /B" in out and "3 to 4; read at 3" in out and "0.01 m per unit" in out
    )
    assert "2 meshes" in out and "prims outside pass" not in out


def refuse(_: object) -> float:
    raise Tf.ErrorException("expected double, got float")


# ---- masks, variants, session layers, default time -------------------------------------------------------


def test_a_mask_loads_only_what_it_names(tmp_path):
    """And what that is related to: its material."""
    text = """
def Material "Red" {
    token outputs:surface.connect = </Red/S.outputs:surface>
    def Shader "S" {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor = (1, 0, 0)
        token outputs:surface
    }
}
def Xform "X" {
    def Cube "One" (prepend apiSchemas = ["MaterialBindingAPI"]) {
        rel material:binding = </Red>
    }
}
def Cube "Two" {
}
"""
    file = stage(tmp_path, text)
    assert len(load_usd(file).meshes) == 2
    scene = load_usd(file, mask=["/X/One"])
    assert [mesh.name for mesh in scene.meshes] == ["/X/One"]
    assert scene.materials[0].name == "/Red"
    assert [m.name for m in load_usd(file, mask=["/X", "/Two"]).meshes] == ["/X/One", "/Two"]
    text += ROOM.replace("Floor", "Three")
    scene = load_usd(stage(tmp_path, text), mask=["/X/One"], camera="/B")
    assert scene.camera.name == "/B" and len(scene.meshes) == 1
    for wrong in ("Two", "/Gone", "no path", "/X.attribute", ""):
        with pytest.raises(InputError, match=r"^mask: "):
            load_usd(file, mask=[wrong])
    out = tmp_path / "a.npy"
    assert main(["render", str(file), str(out), *FEW, "-w", "4", "--mask", "/X/One,/Two"]) == 0


VARIANTS = """
def Xform "Car" (
    variants = { string shape = "cube" }
    prepend variantSets = "shape"
) {
    variantSet "shape" = {
        "cube" {
            def Cube "Body" {
            }
        }
        "ball" {
            def Sphere "Body" {
            }
        }
    }
}
"""


def test_variants_are_selected(tmp_path):
    """A selection is stronger than the file's, and nobody else's stage sees it."""
    file = stage(tmp_path, VARIANTS)
    keep = StageReader(file)
    assert len(load_usd(file).meshes[0].triangles) == 12
    assert len(load_usd(file, variants=["/Car{shape=ball}"]).meshes[0].triangles) > 100
    assert len(keep.read().meshes[0].triangles) == 12
    assert load_usd(file, variants=["/Car{shape=}"]).meshes == ()
    for wrong, words in {
        "/Car": "not of the form",
        "/Van{shape=ball}": "no prim /Van",
        "/Car{paint=red}": "no set 'paint'; it has shape",
        "/Car{shape=egg}": "no 'egg'; it has ball, cube",
    }.items():
        with pytest.raises(InputError, match=words):
            load_usd(file, variants=[wrong])


def test_a_session_layer_is_stronger_than_the_stage(tmp_path):
    """It may select, hide and move; a selection on the command line is stronger still. The file is not touched."""
    file, layer = stage(tmp_path, VARIANTS), tmp_path / "session.usda"
    layer.write_text('#usda 1.0\nover "Car" (variants = { string shape = "ball" }) {\n}\ndef Cube "More" {\n}\n')
    before = layer.read_bytes(), file.read_bytes()
    scene = load_usd(file, session_layer=layer)
    assert {mesh.name for mesh in scene.meshes} == {"/Car/Body", "/More"} and scene.triangle_count > 100
    scene = load_usd(file, session_layer=layer, variants=["/Car{shape=cube}"])
    assert scene.triangle_count == 24
    assert before == (layer.read_bytes(), file.read_bytes())
    with pytest.raises(InputError, match="no such file"):
        load_usd(file, session_layer=tmp_path / "gone.usda")
    layer.write_text("#usda 1.0\ndef {")
    with pytest.raises(InputError, match="cannot be opened"):
        load_usd(file, session_layer=layer)


def test_the_default_time(tmp_path):
    """At the default time an attribute has its default, whatever its samples say."""
    text = (
        "(startTimeCode = 1)\n"
        + """def Cube "C" {
    double size = 2
    double size.timeSamples = { 1: 4, 2: 6 }
}"""
    )
    file = tmp_path / "stage.usda"
    file.write_text("#usda 1.0\n" + text)
    for time, size in ((None, 4), (2.0, 6), ("default", 2)):
        assert np.ptp(load_usd(file, time=time).meshes[0].points, axis=0) == pytest.approx(size)
    out = tmp_path / "a.npy"
    assert main(["render", str(file), str(out), *FEW, "-w", "2", "-d"]) == 0
    assert main(["render", str(file), str(out), *FEW, "-w", "2", "--default-time", "--frames", "1"]) == 2


def test_the_names_of_usdrecord(tmp_path):
    """Its flags are understood."""
    layer = tmp_path / "session.usda"
    layer.write_text("#usda 1.0\n")
    file = stage(tmp_path, ROOM + SETTINGS)
    out = tmp_path / "a.npy"
    flags = ["--defaultTime", "--sessionLayer", str(layer), "--renderSettingsPrimPath", "/Render/S"]
    assert main(["render", str(file), str(out), *FEW, *flags, "-cam", "A", "-w", "8"]) == 0
    assert parse(["render", "a", "b", "--renderPassPrimPath", "/P"]).render_pass == "/P"
    flags = ["--disableGpu", "--disableCameraLight", "--enableDomeLightVisibility"]
    args = parse(["render", "a", "b", *flags])
    assert (args.device, args.default_light, args.visible_lights) == ("cpu", "none", True)
    args = parse(["render", "a", "b"])
    assert (args.device, args.default_light) == ("auto", "dome") and "visible_lights" not in args


PASS = """
def Xform "Set" {
    def Cube "a" {
    }
    def Xform "b" {
        def Cube "c" {
        }
    }
}
def PointInstancer "I" {
    rel prototypes = </I/p>
    int[] protoIndices = [0, 0]
    point3f[] positions = [(0, 0, 0), (4, 0, 0)]
    def Cube "p" {
    }
}
def RenderPass "Only" {
    rel renderSource = </Render/S>
    MORE
}
"""


@pytest.mark.parametrize(
    ("more", "shapes", "lights", "outside"),
    [
        ("", {"/Floor", "/Set/a", "/Set/b/c", "/I/p"}, 1, 0),
        ("rel collection:prune:includes = [</Set/b>, </Light>]", {"/Floor", "/Set/a", "/I/p"}, 0, 2),
        ("rel collection:renderVisibility:excludes = [</Set>, </I>]", {"/Floor"}, 1, 3),
        (
            """uniform bool collection:renderVisibility:includeRoot = 0
    rel collection:renderVisibility:includes = [</Set>, </Light>]
    rel collection:renderVisibility:excludes = </Set/a>""",
            {"/Set/b/c"},
            1,
            3,
        ),
        (
            'uniform pathExpression collection:prune:membershipExpression = "/Set//c"',
            {"/Floor", "/Set/a", "/I/p"},
            1,
            1,
        ),
    ],
)
def test_a_render_pass_says_what_takes_part(tmp_path, more, shapes, lights, outside):
    """What is pruned is gone with all below it; what is outside renderVisibility is not drawn."""
    file = stage(tmp_path, ROOM + SETTINGS + PASS.replace("MORE", more))
    scene = load_usd(file, render_pass="Only", default_light="none")
    assert {mesh.name for mesh in scene.meshes} == shapes and len(scene.lights) == lights
    assert scene.stats["prims_outside_pass"] == outside and scene.settings["width"] == 40
    assert not warned(scene, "/Only")
    assert len(load_usd(file).meshes) == 4 and warned(load_usd(file), "/Only", "prims outside this one are drawn")


def test_render_passes_that_cannot_be_followed(tmp_path):
    """A pass that is not there is an error, as are two sources of settings; what is not read of one is named."""
    text = "rel collection:matte:includes = </Set>\n rel collection:cameraVisibility:excludes = </Set>"
    file = stage(tmp_path, ROOM + PASS.replace("MORE", text))
    with pytest.raises(InputError, match="no render pass '/P'; available: /Only"):
        load_usd(file, render_pass="/P")
    with pytest.raises(InputError, match="one of the two"):
        load_usd(file, render_pass="/Only", render_settings="/S")
    scene = load_usd(file, render_pass="/Only")
    assert warned(scene, "/Only", "matte") and warned(scene, "/Only", "cameraVisibility")
    assert warned(scene, "/Only", "renderSource") and scene.settings == {}


# ---- malformed stages ------------------------------------------------------------------------------------

WRONG = {
    "int": ["0", "-1", "2147483647"], "float": ["-1", "1e38", "nan", "inf"], "double": ["1e308", "nan"],
    "string": ['""', '"../x"'], "token": ['"x"', '"orthographic"'], "int2": ["(0, 0)", "(2147483647, 2147483647)"],
    "float2": ["(nan, 1)", "(5, 1)"], "float4": ["(nan, 1, 2, 3)", "(0, 0, 1e9, 1)"], "double3": ["(1e300, 0, 0)"],
    "bool": ["0", "1"], "asset": ["@a.usd@"], "token[]": ["[]", '["proxy"]'], "float[]": ["[1, nan]"],
    "matrix4d": ["((0, 0, 0, 0), (0, 0, 0, 0), (0, 0, 0, 0), (nan, 0, 0, 0))"], "pathExpression": ['"/x"'],
    "int[]": ["[1, 2]"], "point3f[]": ["[(0, 0, 0)]"],
}  # fmt: skip
"""Values of types, possible and impossible."""


def test_wrong_types_and_values_are_survived(tmp_path):
    """Attributes of settings, products and cameras with other types and values: a scene, or one line of error."""
    rng = random.Random(4)
    moving = "double3 xformOp:translate.timeSamples = { 0: (0, 0, 1), 1: (0, 0, 5) }\n    double shutter:close = 1\n"
    lines = (
        (ROOM + SETTINGS).replace('def Camera "A" {', 'def Camera "A" {\n    float fStop = 2\n' + moving).split("\n")
    )
    lines = [line for line in lines if "translate = (0, 0, 4)" not in line]
    authored = [k for k, line in enumerate(lines) if re.match(r"\s*\S+ [\w:]+ = ", line)]
    loaded = 0
    for number in range(120):
        mutated = list(lines)
        for k in rng.sample(authored, 2):
            kind = rng.choice(list(WRONG))
            before = re.match(r"(\s*)(?:uniform )?\S+ ([\w:]+) = ", lines[k])
            mutated[k] = f"{before[1]}{kind} {before[2]} = {rng.choice(WRONG[kind])}"
        file = tmp_path / f"{number}.usda"
        file.write_text("#usda 1.0\n" + "\n".join(mutated))
        try:
            scene = load_usd(file, camera=rng.choice([None, "A"]), time=rng.choice([None, 0.5]))
        except InputError as error:
            assert "\n" not in str(error)
            continue
        RenderSettings(**scene.settings)
        loaded += 1
    assert loaded > 60


@pytest.mark.parametrize(
    "purposes, bound, expected",
    [
        ('"full", ""', "full preview all", "full"),
        ('"full", "allPurpose"', "preview all", "all"),
        ('"preview"', "full preview all", "preview"),
        ('"preview"', "full all", "all"),
        ('"preview", "full", ""', "full all", "full"),
        ('"", "full"', "full all", "all"),
        ('"", "full"', "full preview", "full"),
        ('"proxy", "full"', "full proxy all", "proxy"),
        ('"full"', "preview", "preview"),
        ('"full", ""', "proxyOf preview", "preview"),
        ('"a b", "preview"', "preview all", "preview"),
    ],
)
def test_which_materials_settings_ask_for(tmp_path, purposes, bound, expected):
    """The first purpose for which something is bound; then what is bound for all; another one with a warning."""
    colors = {"full": 0.1, "preview": 0.2, "all": 0.3, "proxy": 0.4, "proxyOf": 0.5}
    text = f'def RenderSettings "S" {{\n    uniform token[] materialBindingPurposes = [{purposes}]\n}}\n'
    bindings = []
    for name in bound.split():
        text += diffuse(f"({colors[name]}, 0, 0)", name)
        bindings.append(f"rel material:binding{'' if name == 'all' else ':' + name} = </{name}>\n")
    mesh = f'def Mesh "M" (prepend apiSchemas = ["MaterialBindingAPI"]) {{{QUADS}{"".join(bindings)}}}\n'
    scene = load(tmp_path, text + mesh)
    assert only_material(scene).albedo[0] == pytest.approx(colors[expected])
    wanted = purposes.replace("allPurpose", "").replace('"', "").split(", ")
    asked = expected == "all" or expected in wanted
    assert warned(scene, "/M", "only a material of purpose", expected) != asked
    assert warned(scene, "/S", "are no purposes") == ("a b" in purposes)


@pytest.mark.parametrize(
    "name, expected",
    [("", None), ("lin_rec709", None), ("acescg", "lin_ap1_scene"), ("LinearRec2020", "lin_rec2020_scene")],
)
def test_the_rendering_color_space(tmp_path, name, expected):
    """A linear space is that of linear pictures; what cannot be one is named."""
    text = f'def RenderSettings "S" {{\n    uniform token renderingColorSpace = "{name}"\n}}\n'
    scene = load(tmp_path, text)
    assert scene.settings.get("color_space") == expected
    assert warned(scene, "/S", "renderingColorSpace") == (expected is not None)
    for bad in ("crayon", "g22_rec709_scene"):
        scene = load(tmp_path, text.replace(f'"{name}"\n', f'"{bad}"\n', 1))
        assert "color_space" not in scene.settings and warned(scene, "/S", "renderingColorSpace", bad)
