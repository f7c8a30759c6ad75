"""Black pictures say why, and no other picture does."""

import math

import numpy as np
import pytest

from tests.stages import SCENES, load, need_real_files
from warp_ir import InputError, Scene, load_usd
from warp_ir.cli import main

WORDS = ("the camera is inside", "all geometry", "it emits nothing", "sees no geometry", "picture is black")


def said(scene: Scene) -> list[str]:
    return [line for line in scene.warnings if any(word in line for word in WORDS)]


GLOW = """
def Material "Glow" {
    token outputs:surface.connect = </Glow/S.outputs:surface>
    def Shader "S" {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:emissiveColor = (1, 1, 1)
        token outputs:surface
    }
}
"""
CAMERA = """
def Camera "Cam" {
    float2 clippingRange = (%s, %s)
    double3 xformOp:translate = (0, 0, %s)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
"""


def ball(more: str = "", radius: float = 2.0) -> str:
    return f'{GLOW}def Sphere "Ball" {{ double radius = {radius}\n rel material:binding = </Glow>\n {more}\n}}\n'


WALL = """
def Xform "Room" {
    def Cube "Box" {
        double size = %s
    }
    double3 xformOp:translate = (0, 0, -1)
    double3 xformOp:rotateXYZ = (0, 30, 0)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]
}
"""


@pytest.mark.parametrize("instanced", [False, True])
@pytest.mark.parametrize(
    ("size", "near", "turn", "touches"),
    [
        (4.0, 0.0, 30, True),  # the centre of a wall
        (4.0, 1e-9, 30, True),
        (4.0, 0.001, 30, False),  # the wall is clipped away
        (4.001, 0.0, 30, False),
        (4.0, 0.0, 0, False),  # inside the room
        (3.0, 0.0, 30, False),
    ],
)
def test_a_camera_in_a_wall(tmp_path, size, near, turn, touches, instanced):
    """Rays that start in a surface hit it at once; only clipping lets them pass."""
    x, z = 2.0 * math.sin(math.radians(turn)), 2.0 * math.cos(math.radians(turn)) - 1.0
    camera = CAMERA % (near, 100, 0) if turn == 0 else (CAMERA % (near, 100, 0)).replace("(0, 0, 0)", f"({x}, 0, {z})")
    room = WALL % size
    if instanced:
        room = f"""
def PointInstancer "Many" {{
    rel prototypes = </Many/Room>
    int[] protoIndices = [0, 0]
    point3f[] positions = [(100, 0, 0), (0, 0, 0)]
    {room}
}}"""
    lines = [line for line in load(tmp_path, room + camera).warnings if "lies in the surface of" in line]
    assert len(lines) == touches and all("Box" in line for line in lines)


def test_a_camera_in_a_ball_that_glows_outwards(tmp_path):
    """From inside a closed surface that emits from its outer side nothing is lit: said, and so it is."""
    scene = load(tmp_path, ball() + CAMERA % (0.1, 100, 0))
    assert said(scene) == [
        "/Ball: the camera is inside it, and it emits outwards only (doubleSided, orientation): the picture is black"
    ]


@pytest.mark.parametrize(
    "text",
    [
        ball("bool doubleSided = true"),
        ball() + 'def SphereLight "L" {}',
        ball() + 'def Sphere "Lamp" { double radius = 0.1\n rel material:binding = </Glow>\n'
        ' double3 xformOp:translate = (0, 1, 0)\n uniform token[] xformOpOrder = ["xformOp:translate"]\n}',
        ball(radius=0.5).replace("Sphere", "Cube") + 'def Xform "X" {}',
    ],
)
def test_lit_pictures_say_nothing(tmp_path, text):
    """A surface that emits inwards too, a lamp within, or a camera outside: nothing is said."""
    assert said(load(tmp_path, text + CAMERA % (0.1, 100, 1.5))) == []


@pytest.mark.parametrize(
    ("near", "far", "z", "word"),
    [
        (1.0, 1e6, 10.0, ""),
        (13.0, 1e6, 10.0, "clippingRange: near, 13, lies behind all geometry"),
        (1.0, 7.0, 10.0, "clippingRange: far, 7, lies before all geometry"),
        (1.0, 1e6, -3.0, "all geometry is behind the camera"),
        (11.5, 1e6, 10.0, ""),
    ],
)
def test_clipped_geometry_is_explained(tmp_path, near, far, z, word):
    """A clipping range, or a camera turned away, that leaves nothing of a ball of radius 2 around the origin."""
    scene = load(tmp_path, ball() + CAMERA % (near, far, z))
    assert (said(scene) == []) == (word == "") and all(word in line and "/Cam" in line for line in said(scene))


@pytest.mark.parametrize(
    ("attribute", "word"),
    [
        ("float inputs:intensity = 0", "inputs:intensity is 0"),
        ("color3f inputs:color = (0, 0, 0)", "inputs:color is black"),
        ("float inputs:diffuse = 0", "inputs:diffuse is 0"),
    ],
)
def test_dark_lights_are_explained(tmp_path, attribute, word):
    """Where lights exist and none emits, each says why; where another does, none says a word."""
    dark = f'def SphereLight "L" {{ {attribute}\n}}\ndef Sphere "S" {{}}\n'
    assert said(load(tmp_path, dark)) == [f"/L: {word}: it emits nothing"]
    assert said(load(tmp_path, dark + 'def DistantLight "Sun" {}')) == []
    mesh_light = f'def Sphere "S" (prepend apiSchemas = ["LightAPI"]) {{ {attribute}\n}}'
    assert said(load(tmp_path, mesh_light)) == [f"/S: {word}: it emits nothing"]


def test_a_picture_without_geometry_says_so(tmp_path, capsys):
    """What only the finished picture tells: the camera looks past everything."""
    aside = CAMERA % (0.1, 1000, 3.0)
    place = 'double3 xformOp:translate = (40, 0, 0)\n uniform token[] xformOpOrder = ["xformOp:translate"]'
    file = tmp_path / "a.usda"
    file.write_text("#usda 1.0\n" + ball(place, radius=0.1) + aside)
    small = ["--width", "8", "--iterations", "1"]
    assert main(["render", str(file), str(tmp_path / "a.npy"), *small]) == 0
    assert "/Cam: the camera sees no geometry" in capsys.readouterr().err
    assert np.load(tmp_path / "a.npy").max() == 0.0
    file.write_text("#usda 1.0\n" + ball(radius=0.1) + aside)
    assert main(["render", str(file), str(tmp_path / "a.npy"), *small]) == 0
    assert "sees no geometry" not in capsys.readouterr().err


ROOM = """
def Cube "Room" { }
def SphereLight "L" { float inputs:radius = 0.1
}
def Cube "Coal" {
    double size = 0.01
    color3f[] primvars:displayColor = [(0, 0, 0)]
}
"""


@pytest.mark.parametrize(
    ("flags", "word"),
    [
        (["--eye", "-3", "0", "0"], "eye: no light reaches what the camera sees"),
        (["--eye", "-1", "0.1", "0.2", "--look-at", "0", "0", "0"], "eye: it lies in the surface of /Room"),
        (["--eye", "0.5", "0.2", "0.1", "--mask", "/Room", "--default-light", "none"], "eye: no light reaches"),
        (["--mask", "/Coal", "--default-light", "dome"], "framing camera: the surfaces that the camera sees reflect"),
        (["--eye", "0.5", "0.2", "0.1"], ""),
        (["--eye", "-3", "0", "0", "--mask", "/Room"], ""),
    ],
)
def test_black_pictures_say_so(tmp_path, capsys, flags, word):
    """A closed room from outside, from in its wall, without light, of coal: it is said, and no error claimed."""
    file, picture = tmp_path / "a.usda", tmp_path / "a.npy"
    file.write_text("#usda 1.0\n" + ROOM)
    assert main(["render", str(file), str(picture), "--width", "8", "--iterations", "4", *flags]) == 0
    out, err = capsys.readouterr()
    assert (word in err) and ("picture is black" in err) == bool(word)
    assert ("estimated error" in out) == (np.load(picture)[..., :3].max() > 0.0) == (not word)


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.usda")), ids=lambda p: p.stem)
def test_no_false_alarms(path):
    """None of the project's scenes is black."""
    assert said(load_usd(path)) == []


@pytest.mark.slow
def test_no_false_alarms_on_real_files():
    """Of the real files those only say something that are known to show nothing."""
    for path in need_real_files():
        try:
            scene = load_usd(path)
        except InputError:
            continue
        assert [line for line in said(scene) if "it emits nothing" not in line] == [], path
