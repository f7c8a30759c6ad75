"""Stages as a whole: opening, troubles, time, transforms, visibility and purpose."""

from pathlib import Path

import numpy as np
import pytest

from tests.stages import TRIANGLE, load, need_real_files, only_material, real_file_parameters, warned, write_image
from warp_ir import InputError, LightKind, load_usd


@pytest.mark.parametrize("name", ["missing.usda", ".", "text.usda", "picture.png"])
def test_what_is_no_stage_is_one_line_that_names_it(tmp_path, name):
    """A missing file, a folder, a syntax error and another format are input errors of one line."""
    (tmp_path / "text.usda").write_text("#usda 1.0\ndef Mesh {")
    (tmp_path / "picture.png").write_text("no picture")
    with pytest.raises(InputError) as error:
        load_usd(str(tmp_path / name))
    assert str(tmp_path) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "options",
    [{"purposes": ("default", "beauty")}, {"purposes": "render"}, {"time": np.nan}, {"default_light": "headlight"}],
)
def test_wrong_arguments_are_input_errors(tmp_path, options):
    """An argument outside its set is refused before anything is read."""
    with pytest.raises(InputError):
        load(tmp_path, "", **options)


def test_an_empty_stage_loads(tmp_path, capfd):
    """An empty stage is a scene: no geometry, which is said, the default dome, a framing camera."""
    scene = load(tmp_path, "")
    assert scene.meshes == () and [light.kind for light in scene.lights] == [LightKind.DOME]
    assert scene.warnings == ("/: the stage draws no geometry",)
    scene = load(tmp_path, f'def Mesh "M" {{{TRIANGLE}}}')
    assert warned(scene, "nothing emits") and warned(scene, "no camera") and not warned(scene, "no geometry")
    assert scene.name == str(tmp_path / "stage.usda")
    assert capfd.readouterr() == ("", "")


def test_default_light_can_be_declined(tmp_path):
    """With default_light="none" a dark stage stays dark."""
    assert load(tmp_path, "", default_light="none").lights == ()


def test_strict_makes_the_first_warning_an_error(tmp_path):
    """strict=True raises what would have been a warning."""
    with pytest.raises(InputError, match="no geometry"):
        load(tmp_path, "", strict=True)


def test_composition_errors_are_listed_once_and_not_spilled(tmp_path, capfd):
    """A missing reference is a warning, the rest is loaded, and stderr stays empty."""
    scene = load(tmp_path, f'def "A" (references = @gone.usda@) {{\n}}\ndef Mesh "M" {{{TRIANGLE}}}')
    assert sum("gone.usda" in line for line in scene.warnings) == 1
    assert len(scene.meshes) == 1 and scene.stats["composition_errors"] == 1
    assert capfd.readouterr() == ("", "")
    many = [f'def "A{k}" (references = @gone.usda@) {{\n}}' for k in range(9)]
    scene = load(tmp_path, "\n".join([*many, 'def "B" (references = @lost.usda@) {\n}']))
    assert warned(scene, "/A0, ", "/A3 and 5 more", "gone.usda") and warned(scene, "lost.usda")
    assert sum("composition" in line for line in scene.warnings) == 2 and scene.stats["composition_errors"] == 10


def test_a_missing_file_is_one_line_for_all_who_want_it(tmp_path):
    """Prims that lack the same file share a line, in the order of their paths; who asks is named if not the root."""
    (tmp_path / "part.usda").write_text('#usda 1.0\ndef "P" {\n def "Q" (payload = @lost.usda@) {\n}\n}')
    prims = "".join(f'def "A{k}" (references = @gone.usda@) {{\n}}\n' for k in (2, 1, 3))
    scene = load(tmp_path, prims + 'def "B" (references = @part.usda@</P>) {\n}\n')
    gone = "/A1, /A2, /A3: composition: Could not open asset @gone.usda@ for reference"
    assert [line for line in scene.warnings if "gone" in line] == [gone]
    lost = [line for line in scene.warnings if "lost" in line]
    assert len(lost) == 1 and lost[0].startswith("/B/Q: composition: ") and "part.usda@ asks for" in lost[0]


def test_types_of_other_programs_are_named_in_one_line(tmp_path):
    """Prims whose types USD does not know are no silent loss; what is below them, and fallback types, are drawn."""
    foreign = (
        f'def OtherSky "S" {{\n}}\ndef OtherGroup "G" {{\n def Mesh "M" {{{TRIANGLE}}}\n}}\ndef OtherSky "T" {{\n}}'
    )
    scene = load(tmp_path, foreign + '\ndef HoudiniLayerInfo "H" {\n}')
    told = "/S, /G, /T: not rendered: prim types unknown to USD: OtherSky, OtherGroup"
    assert [line for line in scene.warnings if "types" in line] == [told]
    assert [mesh.name for mesh in scene.meshes] == ["/G/M"]
    scene = load(tmp_path, '(fallbackPrimTypes = { token[] OtherSky = ["DomeLight"] })\ndef OtherSky "S" {\n}')
    assert len(scene.lights) == 1 and scene.lights[0].name == "/S" and not warned(scene, "types")


def test_metadata_of_the_wrong_kind_do_not_stop_the_load(tmp_path):
    """An unknown upAxis is read as Y; a wrongly typed metersPerUnit does not matter."""
    scene = load(tmp_path, f'(upAxis = "X"\n metersPerUnit = 0.0)\ndef Mesh "M" {{{TRIANGLE}}}')
    assert warned(scene, "upAxis") and len(scene.meshes) == 1


def test_one_bad_prim_does_not_stop_the_others(tmp_path):
    """A prim that cannot be read is named and skipped; prims with the same trouble share a line."""
    bad = TRIANGLE.replace("[0, 1, 2]", "[0, 1, 7]")
    scene = load(tmp_path, "\n".join(f'def Mesh "B{i}" {{{bad}}}' for i in range(7)) + f'\ndef Mesh "M" {{{TRIANGLE}}}')
    assert [mesh.name for mesh in scene.meshes] == ["/M"]
    assert warned(scene, "/B0, ", "and 3 more", "point 7 of 3", "skipped")


def test_the_default_time_is_the_start_of_the_stage(tmp_path):
    """Without a time the stage's start is loaded, as usdrecord does; values are interpolated in between."""
    text = f"""(startTimeCode = 10)
def Mesh "M" {{{TRIANGLE}
    double3 xformOp:translate.timeSamples = {{ 0: (0, 0, 0), 10: (1, 0, 0), 20: (3, 0, 0) }}
    uniform token[] xformOpOrder = ["xformOp:translate"]
}}"""
    assert load(tmp_path, text).meshes[0].points[0, 0] == 1.0
    assert load(tmp_path, text, time=15.0).meshes[0].points[0, 0] == 2.0


def test_transforms_accumulate_and_can_be_reset(tmp_path):
    """A child moves with its parent unless it resets the stack."""
    move = 'double3 xformOp:translate = (5, 0, 0)\n uniform token[] xformOpOrder = [{}"xformOp:translate"]'
    scene = load(
        tmp_path,
        f"""def Xform "A" {{
    {move.format("")}
    def Mesh "Child" {{{TRIANGLE} {move.format("")}
    }}
    def Mesh "Reset" {{{TRIANGLE} {move.format('"!resetXformStack!", ')}
    }}
}}""",
    )
    assert [mesh.points[0, 0] for mesh in scene.meshes] == [10.0, 5.0]


@pytest.mark.parametrize("op", ["double3 xformOp:translate = (nan, 0, 0)", "token xformOp:bad = 'x'"])
def test_an_unreadable_transform_is_the_identity(tmp_path, op):
    """NaN and unknown transform ops are reported, and the prim stays where its parent is."""
    name = op.split()[1]
    scene = load(
        tmp_path,
        f"""def Mesh "M" {{{TRIANGLE}
    {op}
    uniform token[] xformOpOrder = ["{name}"]
}}""",
    )
    assert warned(scene, "/M", "transform") and scene.meshes[0].points[0, 0] == 0.0


def test_an_invisible_ancestor_hides_geometry_and_lights(tmp_path):
    """Nothing below an invisible prim is drawn or shines, whatever its own visibility says."""
    scene = load(
        tmp_path,
        f"""def Xform "A" {{
    token visibility = "invisible"
    def Mesh "M" {{{TRIANGLE} token visibility = "inherited"
    }}
    def SphereLight "L" {{
    }}
}}""",
    )
    assert scene.meshes == () and [light.name for light in scene.lights] == ["default dome"]
    assert scene.stats["prims_invisible"] == 1


def test_purposes_select_what_is_drawn(tmp_path):
    """The purposes default and render are drawn; proxy and guide are not; a purpose is inherited."""
    text = "\n".join(
        f"""def Xform "{purpose}" {{
    uniform token purpose = "{purpose}"
    def Mesh "M" {{{TRIANGLE}}}
}}"""
        for purpose in ("default", "render", "proxy", "guide")
    )
    assert [mesh.name for mesh in load(tmp_path, text).meshes] == ["/default/M", "/render/M"]
    assert [mesh.name for mesh in load(tmp_path, text, purposes=("proxy",)).meshes] == ["/proxy/M"]
    assert load(tmp_path, text).stats["prims_other_purpose"] == 2


def test_a_stage_of_proxies_says_so(tmp_path):
    """If only proxies could be drawn, the warning hints at the purposes."""
    scene = load(tmp_path, f'def Mesh "M" {{{TRIANGLE} uniform token purpose = "proxy"\n}}')
    assert warned(scene, "no geometry", "proxies")


def test_classes_overs_and_inactive_prims_are_not_drawn(tmp_path):
    """Only defined, active, concrete prims count; children of unknown types do."""
    scene = load(
        tmp_path,
        f"""class Mesh "C" {{{TRIANGLE}}}
over Mesh "O" {{{TRIANGLE}}}
def Mesh "I" (active = false) {{{TRIANGLE}}}
def Whatever "W" {{ def Mesh "M" {{{TRIANGLE}}}
}}""",
    )
    assert [mesh.name for mesh in scene.meshes] == ["/W/M"]


def test_only_the_default_level_of_detail_is_drawn(tmp_path):
    """The children of a level-of-detail root are alternatives."""
    scene = load(
        tmp_path,
        f"""def Xform "L" (prepend apiSchemas = ["LODRootAPI"]) {{
    def Mesh "Fine" {{{TRIANGLE}}}
    def Mesh "Coarse" {{{TRIANGLE}}}
}}""",
    )
    assert [mesh.name for mesh in scene.meshes] == ["/L/Fine"]


def draw_mode(mode, more="", kind="component"):
    return f"""def Xform "A" (
    prepend apiSchemas = ["GeomModelAPI"]
    kind = "{kind}"
) {{
    uniform token model:drawMode = "{mode}"
    {more}
    def Cube "C" {{
    }}
}}
"""


def test_draw_modes_apply_to_components(tmp_path):
    """Models that are no components, or say so, are drawn themselves; so are prims that are no models."""
    assert len(load(tmp_path, draw_mode("bounds", kind="group")).meshes[0].triangles) == 12
    assert len(load(tmp_path, draw_mode("bounds", "uniform bool model:applyDrawMode = 0")).meshes[0].triangles) == 12
    assert len(load(tmp_path, draw_mode("default")).meshes[0].triangles) == 12
    assert len(load(tmp_path, draw_mode("bounds", "uniform bool model:applyDrawMode = 1", "group")).meshes) == 1
    scene = load(tmp_path, draw_mode("cards", 'uniform token model:cardGeometry = "fromTexture"'))
    assert warned(scene, "/A", "fromTexture") and scene.meshes[0].name == "/A/C"


def test_bounds_and_origin_are_lines(tmp_path):
    """Twelve edges around the box, in the colour of the draw mode; three axes in red, green and blue."""
    scene = load(tmp_path, draw_mode("bounds", "uniform float3 model:drawModeColor = (0.25, 0.5, 0.75)"))
    half = 1.0 + 12**0.5 / 500
    assert len(scene.meshes[0].triangles) == 12 * 12 and only_material(scene).albedo == (0.25, 0.5, 0.75)
    np.testing.assert_allclose(
        [scene.meshes[0].points.min(0), scene.meshes[0].points.max(0)], [[-half] * 3, [half] * 3]
    )
    scene = load(tmp_path, draw_mode("origin"))
    albedos = [scene.materials[k].albedo for k in np.unique(scene.meshes[0].material)]
    assert sorted(albedos) == [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)]


@pytest.mark.parametrize("geometry, places", [("cross", (0.0, 0.0)), ("box", (-1.0, 1.0))])
def test_cards_have_the_textures_of_their_faces(tmp_path, geometry, places):
    """Two quads across X, back to back or on the box; seen from +X the image has Z up and Y to the right."""
    write_image(tmp_path / "a.png", np.uint8([[[255, 0, 0, 255], [0, 255, 0, 255]], [[0, 0, 255, 255], [9, 9, 9, 0]]]))
    more = f'asset model:cardTextureXPos = @a.png@\n uniform token model:cardGeometry = "{geometry}"'
    scene = load(tmp_path, draw_mode("cards", more))
    shape, material = scene.meshes[0], only_material(scene)
    assert len(shape.triangles) == 4 and material.cutoff == 0.1 and material.opacity_texture is not None
    corners, uvs = shape.points[shape.triangles].reshape(4, 3, 3), shape.uvs[material.albedo_texture.uv]
    x = corners[..., 0].mean(axis=1)
    np.testing.assert_allclose([x.min(), x.max()], places, atol=1e-3)
    np.testing.assert_allclose(uvs[x == x.max()], (corners[x == x.max()][..., 1:] + 1) / 2, atol=1e-6)


def test_types_that_are_not_rendered_are_named_once_with_their_count(tmp_path):
    """Volumes are warned about once."""
    scene = load(tmp_path, 'def Volume "A" {\n}\ndef Volume "B" {\n}')
    assert warned(scene, "/A, /B", "Volume", "2 in all")


def _survives(file: Path) -> None:
    try:
        scene = load_usd(file)
    except InputError as error:
        assert "\n" not in str(error)
        return
    for mesh in scene.meshes:
        assert np.isfinite(mesh.points).all() and mesh.triangles.dtype == np.int32 and len(mesh.triangles) > 0
        assert mesh.triangles.min() >= 0 and mesh.triangles.max() < len(mesh.points)
        assert mesh.material.shape == mesh.triangles.shape[:1] and mesh.material.dtype == np.int32
        assert mesh.material.min() >= 0 and mesh.material.max() < len(scene.materials)
        for corners in (mesh.normals, mesh.colors):
            assert corners is None or corners.shape == (*mesh.triangles.shape, 3)
            assert corners is None or (corners.dtype == np.float32 and np.isfinite(corners).all())
    for light in scene.lights:
        assert np.isfinite(light.radiance).all() and max(light.radiance) > 0.0
    assert all(0.0 <= channel <= 1.0 for material in scene.materials for channel in material.albedo)
    assert all("\n" not in line for line in scene.warnings)


@pytest.mark.extended
def test_some_real_files_survive():
    """Every 16th file of the collection loads into consistent records, or is refused in one line."""
    for file in need_real_files()[::16]:
        _survives(file)


@pytest.mark.slow
@pytest.mark.parametrize("file", real_file_parameters())
def test_every_real_file_survives(file):
    """Any file loads into consistent records, or is refused in one line."""
    _survives(file)


def test_visibility_of_purposes(tmp_path):
    """VisibilityAPI: the nearest authored opinion counts for each purpose; guides are hidden without one."""
    pair = 'def Cube "{}g" {{\n uniform token purpose = "guide"\n}}\n'
    pair += 'def Cube "{}r" {{\n uniform token purpose = "render"\n}}\n'
    head = 'apiSchemas = ["VisibilityAPI"]'
    text = (
        pair.format("a", "a")
        + f'def Xform "X" ({head}) {{\n token renderVisibility = "invisible"\n token guideVisibility = "visible"\n'
        + pair.format("b", "b")
        + f'def Xform "Y" ({head}) {{\n token renderVisibility = "visible"\n{pair.format("c", "c")}}}\n}}\n'
    )
    scene = load(tmp_path, text, purposes=("render", "guide"))
    assert [mesh.name for mesh in scene.meshes] == ["/ar", "/X/bg", "/X/Y/cg", "/X/Y/cr"]


def test_a_package_with_a_wrong_checksum_is_refused(tmp_path):
    """One flipped bit of a layer in a .usdz is found before USD reads it, which ends the process on some of them."""
    from pxr import Usd, UsdUtils

    layer = tmp_path / "a.usdc"
    stage = Usd.Stage.CreateNew(str(layer))
    stage.DefinePrim("/World")
    stage.GetRootLayer().Save()
    package = tmp_path / "a.usdz"
    assert UsdUtils.CreateNewUsdzPackage(str(layer), str(package))
    load_usd(package)
    data = bytearray(package.read_bytes())
    data[data.index(b"PXR-USDC") + 40] ^= 1
    package.write_bytes(data)
    with pytest.raises(InputError, match="is damaged, its checksum is wrong"):
        load_usd(package)
