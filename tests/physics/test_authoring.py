"""The same scene authored in different ways is the same picture."""

import numpy as np
import pytest
from pxr import Sdf, UsdUtils

import warp_ir as ir
from tests.physics import closed_form, level
from tests.stages import diffuse

# A floor, a wall and a box with a colour on each side, under a rectangle light.
FLOOR = [(-2, 0, -2), (-2, 0, 2), (2, 0, 2), (2, 0, -2)]
WALL = [(-2, 0, -2), (2, 0, -2), (2, 3, -2), (-2, 3, -2)]
BOX = [(x, y, z) for x in (-0.5, 0.5) for y in (0, 1) for z in (-0.5, 0.5)]
SIDES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
SIDE_COLORS = [(0.8, 0.1, 0.1), (0.1, 0.8, 0.1), (0.5, 0.5, 0.5), (0.7, 0.7, 0.2), (0.2, 0.2, 0.8), (0.6, 0.3, 0.1)]
PLACES = [(-0.9, 0, 0), (0.9, 0, 0.4)]
TURN = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # Y up to Z up


def mesh(name, points, faces, more="", left=False, api=""):
    if left:
        faces = [face[::-1] for face in faces]
        more += '\n    uniform token orientation = "leftHanded"'
    return level.mesh(name, points, faces, more, api)


def box(name, place, scale, turn, how, left):
    """One box: its sides coloured by a primvar, by subsets with materials, or a mesh for each."""
    points = (np.array(BOX) + place) @ turn.T * scale
    if how == "subsets":
        parts = "".join(
            f"""
    def GeomSubset "G{k}" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
        uniform token elementType = "face"
        uniform token familyName = "materialBind"
        int[] indices = [{k}]
        rel material:binding = </L{k}>
    }}"""
            for k in range(6)
        )
        return mesh(name, points, SIDES, parts, left)
    if how == "meshes":
        bound = '"MaterialBindingAPI"'
        return f'\ndef Xform "{name}" {{' + "".join(
            mesh(f"S{k}", points, [side], f"rel material:binding = </L{k}>", left, bound)
            for k, side in enumerate(SIDES)
        ) + "\n}"  # fmt: skip
    kind = "color3f[] primvars:displayColor"
    if how == "indexed":
        order = [3, 1, 5, 0, 2, 4]
        text = f'{kind} = {[SIDE_COLORS[k] for k in order]} (interpolation = "uniform")'
        text += f"\n    int[] primvars:displayColor:indices = {[order.index(k) for k in range(6)]}"
    elif how == "faceVarying":
        text = f'{kind} = {[SIDE_COLORS[k] for k in range(6) for _ in range(4)]} (interpolation = "faceVarying")'
    else:
        text = f'{kind} = {SIDE_COLORS} (interpolation = "uniform")'
    return mesh(name, points, SIDES, text, left)


def stage(how="uniform", *, scale=1.0, up="Y", left=False, instanced=False):
    turn = TURN if up == "Z" else np.eye(3)
    grey = "color3f[] primvars:displayColor = [(0.6, 0.6, 0.6)]"
    text = f'(\n upAxis = "{up}"\n metersPerUnit = {1.0 / scale}\n)\n'
    text += "".join(diffuse(str(color), f"L{k}") for k, color in enumerate(SIDE_COLORS))
    for name, points in (("Floor", FLOOR), ("Wall", WALL)):
        text += mesh(name, np.array(points) @ turn.T * scale, [[0, 1, 2, 3]], grey, left)
    if instanced:
        text += '\nover "Proto" {' + box("Box", (0, 0, 0), scale, turn, how, left) + "\n}"
        for k, place in enumerate(PLACES):
            x, y, z = (turn @ np.array(place) * scale).tolist()
            text += f"""
def Xform "I{k}" (instanceable = true
    prepend references = </Proto>) {{
    double3 xformOp:translate = ({x}, {y}, {z})
    uniform token[] xformOpOrder = ["xformOp:translate"]
}}"""
    else:
        text += "".join(box(f"Box{k}", place, scale, turn, how, left) for k, place in enumerate(PLACES))
    for kind, rows, place, more in (
        ("RectLight", [[1, 0, 0], [0, 0, -1], [0, 1, 0]], (0, 2.9, 0.5),
         f"float inputs:width = {1.5 * scale}\n float inputs:height = {scale}\n float inputs:intensity = 6"),
        ("Camera", np.eye(3), (0, 1.2, 6), f"float2 clippingRange = ({0.01 * scale}, {100 * scale})"),
    ):  # fmt: skip
        # USD's matrices take rows: the axes of the prim, then where it is.
        matrix = np.vstack([np.array(rows, dtype=float) @ turn.T, turn @ np.array(place) * scale])
        values = ", ".join(str((*row, float(k == 3))) for k, row in enumerate(matrix.tolist()))
        text += f"""
def {kind} "{kind}" {{
    {more}
    matrix4d xformOp:transform = ({values})
    uniform token[] xformOpOrder = ["xformOp:transform"]
}}"""
    return text


def picture(folder, text, suffix=".usda", **settings):
    path = folder / "stage.usda"
    path.write_text("#usda 1.0\n" + text)
    if suffix != ".usda":
        binary = folder / "stage.usdc"
        Sdf.Layer.FindOrOpen(str(path)).Export(str(binary))
        path = binary
    if suffix == ".usdz":
        path = folder / "stage.usdz"
        assert UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(binary)), str(path))
    scene = ir.load_usd(path)
    assert scene.warnings == ()
    given = dict(width=24, height=16, iterations=2, light_paths=64) | settings
    return closed_form.render(scene, "path", **given)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return picture(tmp_path_factory.mktemp("plain"), stage()).radiance()


@pytest.mark.parametrize("suffix", [".usdc", ".usdz"])
def test_formats_give_the_same_bits(tmp_path, plain, suffix):
    """Text, binary and package hold the same numbers."""
    np.testing.assert_array_equal(picture(tmp_path, stage(), suffix).radiance(), plain)


@pytest.mark.parametrize("how", ["indexed", "faceVarying"])
def test_primvars_give_the_same_bits(tmp_path, plain, how):
    """Indexed or expanded, per face or per face-vertex, colours are the same."""
    np.testing.assert_array_equal(picture(tmp_path, stage(how)).radiance(), plain)


@pytest.mark.parametrize(
    "other",
    [
        dict(how="subsets"),
        dict(how="meshes"),
        dict(instanced=True),
        dict(how="subsets", instanced=True),
        dict(left=True),
        dict(scale=100.0),
        dict(scale=0.01),
    ],
    ids=str,
)
def test_authoring_changes_only_rounding(tmp_path, plain, other):
    """Subsets, separate meshes, instances, left-handed faces, centimetres: the same up to rounding.

    Rounding can decide a ray at an edge the other way: allow that for 1 % of the pixels.
    """
    there = picture(tmp_path, stage(**other)).radiance()
    different = np.abs(plain - there).max(axis=2) > 1e-3 * plain.mean()
    assert different.mean() <= 0.01


@pytest.mark.extended
def test_the_up_axis_changes_only_the_noise(tmp_path):
    """The scene with Z up is the same picture within its standard errors, pixel by pixel.

    With 256 iterations a z score beyond 5 has a probability of 1e-6 for each of 1152 values; 1e-3 covers the half
    texel by which rounding may move an edge.
    """
    films = [picture(tmp_path, stage(up=up), iterations=256, light_paths=16) for up in "YZ"]
    here, there = (film.radiance() for film in films)
    error = np.hypot(*(film.standard_error() for film in films))
    assert (np.abs(here - there) <= 5.0 * error + 1e-3 * here.mean()).all()
    assert np.abs(here - there).mean() < 0.05 * here.mean()  # and the errors are small enough to say something
