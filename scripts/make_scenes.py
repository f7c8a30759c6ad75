"""Writes the test scenes in `scenes_usd/`: USD text, three small textures, and the README with its table.

    python scripts/make_scenes.py [FOLDER]

The output is deterministic to the byte: numbers are rounded, and seeds are fixed. Each scene is a function
that fills a `Builder`; its docstring becomes the documentation of the layer. Surfaces are purely diffuse (specular
workflow with black specular colour) and faceted, so that all renderers that read UsdPreviewSurface render the same
scene. The licence of the scenes is CC0.
"""

import argparse
import colorsys
import math
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from pxr import Usd, UsdGeom, UsdLux
from scene_builder import Builder, rounded
from shapes import BOX_FACES, boulder, box_points, chair, knot, unit_sphere, vase
from textures import TEXTURES, linear_mean

WHITE, GREY, DARK = (0.73, 0.72, 0.70), (0.5, 0.5, 0.5), (0.2, 0.2, 0.21)


def cornell_box():
    """The Cornell box.

    The published dimensions, blocks and camera (Cornell University Program of Computer Graphics, 1998); the
    light is a RectLight a hair (0.1 of 548.8) below the ceiling.
    """
    scene = Builder(cornell_box.__doc__, meters_per_unit=0.001)
    white = scene.material("White", (0.725, 0.71, 0.68))
    red, green = scene.material("Red", (0.63, 0.065, 0.05)), scene.material("Green", (0.14, 0.45, 0.091))
    walls = {
        "Floor": (white, [(552.8, 0, 0), (0, 0, 0), (0, 0, 559.2), (549.6, 0, 559.2)]),
        "Ceiling": (white, [(556, 548.8, 0), (556, 548.8, 559.2), (0, 548.8, 559.2), (0, 548.8, 0)]),
        "BackWall": (white, [(549.6, 0, 559.2), (0, 0, 559.2), (0, 548.8, 559.2), (556, 548.8, 559.2)]),
        "RightWall": (green, [(0, 0, 559.2), (0, 0, 0), (0, 548.8, 0), (0, 548.8, 559.2)]),
        "LeftWall": (red, [(552.8, 0, 0), (549.6, 0, 559.2), (556, 548.8, 559.2), (556, 548.8, 0)]),
    }
    for name, (material, corners) in walls.items():
        scene.quad(f"Box/{name}", corners, material)
    blocks = {
        "ShortBlock": (165, [(130, 65), (82, 225), (240, 272), (290, 114)]),
        "TallBlock": (330, [(423, 247), (265, 296), (314, 456), (472, 406)]),
    }
    for name, (height, base) in blocks.items():
        points = [(x, height, z) for x, z in base] + [(x, 0, z) for x, z in base]
        sides = [(k, k + 4, (k + 1) % 4 + 4, (k + 1) % 4) for k in range(4)]
        scene.mesh(f"Box/{name}", points, [(0, 1, 2, 3), *(side[::-1] for side in sides)], white)
    light = scene.light(UsdLux.RectLight, "Ceiling", (1.0, 0.86, 0.68), 45.0, width=130.0, height=105.0)
    scene.aim(light, (278, 548.7, 279.5), (278, 0, 279.5))
    scene.camera((278, 273, -800), (278, 273, 0), focal=35.0, aperture=(25.0, 25.0), clip=(1, 10000))
    return scene


def furnace_sphere():
    """A closed sphere of albedo 1/2 that emits 1, seen from inside: every pixel is 1 / (1 - 1/2) = 2."""
    scene = Builder(furnace_sphere.__doc__)
    points, faces = unit_sphere(64, 128)
    glowing = scene.material("Glowing", GREY, emission=(1.0, 1.0, 1.0))
    scene.mesh("Sphere", points, [face[::-1] for face in faces], glowing)
    scene.camera((0.2, 0.1, 0.3), (-1.0, 0.0, -0.5), focal=15.0)
    return scene


def furnace_cube():
    """A closed cube of albedo 1/2 that emits 1, seen from inside: every pixel is 1 / (1 - 1/2) = 2."""
    scene = Builder(furnace_cube.__doc__)
    glowing = scene.material("Glowing", GREY, emission=(1.0, 1.0, 1.0))
    scene.box("Cube", (-1, -1, -1), (1, 1, 1), glowing, inward=True)
    scene.camera((0.3, 0.2, 0.4), (-1.0, -0.2, -1.0), focal=15.0)
    return scene


def corridor():
    """An L-shaped corridor with the lamp round the corner.

    It shines away from the corner, into the other leg: no light reaches the camera that was not
    reflected twice or more.
    """
    scene = Builder(corridor.__doc__)
    plaster, floor = scene.material("Plaster", WHITE), scene.material("Floor", (0.42, 0.36, 0.3))
    blue, orange = scene.material("Blue", (0.25, 0.42, 0.66)), scene.material("Orange", (0.82, 0.46, 0.2))
    outline = [(0, 0), (2, 0), (2, 6), (7, 6), (7, 8), (0, 8)]
    names = {
        "Entrance": plaster,
        "Right": blue,
        "Inner": plaster,
        "Far": orange,
        "End": plaster,
        "Left": plaster,
    }
    for (name, material), (x0, z0), (x1, z1) in zip(names.items(), outline, outline[1:] + outline[:1], strict=True):
        scene.quad(f"Walls/{name}", [(x0, 0, z0), (x0, 2.5, z0), (x1, 2.5, z1), (x1, 0, z1)][::-1], material)
    for name, y, material in (("Floor", 0.0, floor), ("Ceiling", 2.5, plaster)):
        face = (0, 1, 2, 5), (2, 3, 4, 5)
        points = [(x, y, z) for x, z in outline]
        scene.mesh(f"Walls/{name}", points, [f if y else f[::-1] for f in face], material)
    for k in range(3):
        z = 1.9 + 1.6 * k
        scene.box(f"Pillars/pillar_{k}", (0.0, 0.0, z), (0.22, 2.5, z + 0.3), plaster)
    scene.box("Bench", (1.5, 0.3, 3.2), (1.98, 0.42, 4.8), orange)
    for k, z in enumerate((3.3, 4.6)):
        scene.box(f"BenchLegs/leg_{k}", (1.55, 0.0, z), (1.93, 0.3, z + 0.1), floor)
    light = scene.light(UsdLux.RectLight, "Lamp", (1.0, 0.9, 0.75), 90.0, width=1.2, height=1.2)
    scene.aim(light, (3.0, 1.3, 7.0), (7.0, 1.3, 7.0))
    scene.camera((0.95, 1.45, 0.15), (1.15, 1.15, 7.0), focal=22.0)
    return scene


def crowded_room():
    """A room full of vases, knots, boulders and chairs.

    Native instances of four prototypes on the floor and on shelves, each with a colour of its own, lit by a
    warm ceiling panel and a cool window.
    """
    scene = Builder(crowded_room.__doc__)
    stream = np.random.default_rng(3)
    plaster, wood = scene.material("Plaster", WHITE), scene.material("Wood", (0.45, 0.29, 0.17))
    scene.room(
        (-3, 0, -3),
        (3, 2.8, 3),
        other=plaster,
        floor=scene.material("Floor", (0.4, 0.37, 0.33)),
        left=scene.material("Teal", (0.22, 0.45, 0.45)),
    )
    palette = [
        scene.material(f"Paint_{k}", rounded(colorsys.hsv_to_rgb(k / 9, 0.35 + 0.4 * (k % 3) / 2, 0.75), 3))
        for k in range(9)
    ]
    shapes = {"boulder": boulder(), "vase": vase(), "knot": knot()[:2], "chair": chair()}
    scene.stage.CreateClassPrim("/World/Prototypes")
    for name, (points, faces) in shapes.items():
        scene.stage.DefinePrim(f"/World/Prototypes/{name}", "Xform")
        scene.mesh(f"Prototypes/{name}/Shape", points, faces, digits=3)

    def instance(group, name, *transform):
        count = len(scene.stage.DefinePrim(f"/World/{group}", "Scope").GetChildren())
        prim = UsdGeom.Xform.Define(scene.stage, f"/World/{group}/{name}_{count}").GetPrim()
        prim.GetReferences().AddInternalReference(f"/World/Prototypes/{name}")
        prim.SetInstanceable(True)
        scene.place(prim, *transform)
        scene.bind(prim, palette[int(9 * stream.random())])

    names = ("boulder", "vase", "knot", "chair")
    for row in range(5):
        for column in range(7):
            x, z = np.array([0.8 * column - 2.4, 0.8 * row - 1.7]) + 0.16 * (stream.random(2) - 0.5)
            name = names[int(4 * stream.random())]
            size = 0.9 if name == "chair" else 0.8 + 0.6 * stream.random()
            instance("Clutter", name, (x, 0, z), (0, 360 * stream.random(), 0), (size,) * 3)
    for level in range(4):
        y = 0.45 + 0.55 * level
        scene.box(f"Shelves/back_{level}", (-2.9, y - 0.03, -2.99), (2.9, y, -2.5), wood)
        scene.box(f"Shelves/right_{level}", (2.5, y - 0.03, -2.4), (2.99, y, 1.4), wood)
        places = [(-2.6 + 0.4 * k, y, -2.75) for k in range(14)] + [(2.75, y, -2.1 + 0.44 * k) for k in range(8)]
        for place in places:
            name, turn = names[int(3 * stream.random())], 360 * stream.random()
            instance(f"Shelf_{level}", name, place, (0, turn, 0), (0.55 + 0.2 * stream.random(),) * 3)
    panel = scene.light(UsdLux.RectLight, "Panel", (1.0, 0.85, 0.65), 9.0, width=1.4, height=1.4)
    scene.aim(panel, (0.4, 2.75, -0.3), (0.4, 0, -0.3))
    window = scene.light(UsdLux.RectLight, "Window", (0.6, 0.8, 1.0), 6.0, width=1.8, height=1.2)
    scene.aim(window, (-2.95, 1.6, 0.2), (0, 1.6, 0.2))
    scene.camera((-2.5, 1.75, 2.85), (0.75, 0.7, -1.5), focal=20.0)
    return scene


def thousand_lights():
    """A thousand small sphere lights in garlands round a room, every hue in its place."""
    scene = Builder(thousand_lights.__doc__)
    plaster = scene.material("Plaster", WHITE)
    scene.room((-3, 0, -3), (3, 3, 3), other=plaster, floor=scene.material("Floor", (0.5, 0.48, 0.45)))
    stone = scene.material("Stone", (0.6, 0.58, 0.55))
    for k, (x, z, height) in enumerate([(-1.6, -1.4, 1.6), (0.1, -1.9, 2.1), (1.7, -1.2, 1.2), (0.9, 0.4, 0.5)]):
        scene.box(f"Columns/column_{k}", (x - 0.3, 0, z - 0.3), (x + 0.3, height, z + 0.3), stone)
    scene.mesh("Boulder", 2.0 * boulder()[0] + (-0.9, 0, 0.2), boulder()[1], stone, digits=3)
    for k in range(1000):
        strand, along = k % 10, (k // 10 + 0.5) / 100
        angle = 2 * math.pi * (along + strand / 10)
        radius = 2.55 + 0.12 * math.cos(4 * angle + strand)
        position = (
            radius * math.cos(angle),
            0.35 + 0.25 * strand + 0.14 * math.sin(6 * angle + 2 * strand),
            radius * math.sin(angle),
        )
        color = colorsys.hsv_to_rgb((angle / (2 * math.pi) + 0.031 * strand) % 1.0, 0.9, 1.0)
        light = scene.light(UsdLux.SphereLight, f"light_{k:03d}", color, 12.0, radius=0.02)
        scene.place(light, position)
    scene.camera((0.0, 1.7, 2.3), (0.0, 1.05, -1.5), focal=17.0)
    return scene


def thin_walls():
    """A dark box beside bright lights, seen from inside: every pixel is exactly 0.

    Three of its walls have no thickness, three are slabs of a millionth of its size; the walls run past the
    edges, so the box has no seams. One light is a thousandth away from a sheet, one from a slab. The camera
    outside_cam shows it all from outside.
    """
    scene = Builder(thin_walls.__doc__)
    white = scene.material("White", WHITE)
    scene.room((-3, -3, -3), (3, 3, 3), other=white)
    axes = "XYZ"  # the negative side of each axis is a sheet, the positive one a slab
    for axis in range(3):
        lower, upper = np.full(3, -1.1), np.full(3, 1.1)
        lower[axis] = upper[axis] = -1.0
        face = BOX_FACES[2 * axis]
        scene.quad(f"DarkBox/sheet{axes[axis]}", box_points(lower, upper)[face], white)
        lower[axis], upper[axis] = 1.0, 1.000002
        scene.box(f"DarkBox/slab{axes[axis]}", lower, upper, white, digits=6)
    for axis in range(3):
        for sign in (-1, 1):
            position = np.zeros(3)
            position[axis] = 2.5 * sign
            name = f"{'minus' if sign < 0 else 'plus'}{axes[axis]}"
            light = scene.light(UsdLux.RectLight, name, (1.0, 0.95, 0.85), 4.0)
            scene.aim(light, position, (0, 0, 0))
    for name, position in (("closeToSheet", (-1.011, 0.4, 0.3)), ("closeToSlab", (0.2, 1.011, -0.4))):
        light = scene.light(UsdLux.SphereLight, name, (1.0, 0.95, 0.85), 400.0, radius=0.01)
        scene.place(light, position)
    scene.camera((0.6, 0.5, 0.8), (-0.5, -0.3, -1.0), focal=14.0, clip=(0.001, 100))
    scene.camera((2.8, 2.2, 2.9), (0, -0.1, 0), name="outside_cam", focal=18.0)
    return scene


def light_types():
    """Every light type in a cabinet of six bays.

    Above: dome light, which comes in below a canopy, distant light through the open roof, and a sphere light.
    Below: rectangle, disk and cylinder. The camera's aperture is shifted, so that uprights stay upright.
    """
    scene = Builder(light_types.__doc__)
    white = scene.material("White", WHITE)
    # Slabs that meet without overlapping. The sun stands in the plane of the front, so it enters open roofs only.
    slabs = {
        "bottom": ((-3.2, -0.1, -2), (3.2, 0, 0)),
        "shelf": ((-3.1, 2.0, -2), (3.1, 2.1, 0)),
        "roof": ((1.05, 4.1, -2), (3.1, 4.2, 0)),
        "canopy": ((-3.6, 5.2, -2), (-1.2, 5.25, 0.3)),
        "back": ((-4.5, 0, -2.1), (3.2, 5.0, -2)),
        "left": ((-3.2, 0, -2), (-3.1, 4.2, 0)),
        "right": ((3.1, 0, -2), (3.2, 4.2, 0)),
    }
    for k, x in enumerate((-1.05, 0.95)):
        slabs[f"lower_{k}"] = (x, 0, -2), (x + 0.1, 2.0, 0)
        slabs[f"upper_{k}"] = (x, 2.1, -2), (x + 0.1, 4.1, 0)
    for name, (lower, upper) in slabs.items():
        scene.box(f"Cabinet/{name}", lower, upper, white)
    centres = (-2.075, 0.0, 2.075)
    for k in range(6):
        colour = scene.material(f"Block_{k}", rounded(colorsys.hsv_to_rgb(k / 6, 0.5, 0.75), 3))
        block = scene.box(f"Blocks/block_{k}", (-0.3, 0, -0.3), (0.3, 0.7, 0.3), colour)
        scene.place(block, (centres[k % 3], 2.1 * (k // 3), -1.1), (0, 30, 0))
    warm = (1.0, 0.88, 0.7)
    rect = scene.light(UsdLux.RectLight, "Rect", warm, 10.0, width=0.9, height=0.5)
    scene.aim(rect, (centres[0], 1.9, -0.8), (centres[0], 0, -0.8))
    disk = scene.light(UsdLux.DiskLight, "Disk", warm, 10.0, radius=0.35)
    scene.aim(disk, (centres[1], 1.9, -0.8), (centres[1], 0, -0.8))
    cylinder = scene.light(UsdLux.CylinderLight, "Cylinder", warm, 12.0, length=1.2, radius=0.04)
    scene.place(cylinder, (centres[2], 1.6, -0.8))
    sphere = scene.light(UsdLux.SphereLight, "Sphere", warm, 10.0, radius=0.12)
    scene.place(sphere, (centres[2], 3.6, -0.8))
    sun = scene.light(UsdLux.DistantLight, "Distant", (1.0, 0.93, 0.8), 3.0, angle=2.0, normalize=True)
    scene.place(sun, (0, 8, 0), (-90, 0, 12))
    scene.light(UsdLux.DomeLight, "Dome", (0.5, 0.72, 1.0), 0.35)
    scene.camera((0, 3.4, 7.2), (0, 3.4, 0), focal=40.0, aperture=(36.0, 24.0), shift=-7.5)
    return scene


def two_rooms():
    """Two textured rooms and a doorway: the lamp is in the far room, the camera in the near one."""
    scene = Builder(two_rooms.__doc__)
    means = {name: rounded(linear_mean(make()), 3) for name, make in TEXTURES.items()}
    planks, bricks, rug = (scene.material(k.capitalize(), means[k], texture=k) for k in TEXTURES)
    plaster, wood = scene.material("Plaster", (0.75, 0.72, 0.66)), scene.material("Wood", (0.35, 0.22, 0.13))
    blue = scene.material("Blue", (0.2, 0.32, 0.5))
    lower, upper = np.array((-4.0, 0.0, -2.0)), np.array((4.0, 2.6, 2.0))
    points = box_points(lower, upper)
    names = ("left", "right", "floor", "ceiling", "back", "front")
    textured = {"floor": (planks, (0, 2), 2.0), "right": (bricks, (2, 1), 2.0), "back": (bricks, (0, 1), 2.0)}
    for name, face in zip(names, BOX_FACES[:, ::-1], strict=True):
        material, axes, tile = textured.get(name, (plaster, None, None))
        st = None if axes is None else points[face][:, axes] / tile
        scene.quad(f"Rooms/{name}", points[face], material, st=st)
    for name, low, high in (
        ("near", (-0.1, 0, 0.9), (0.1, 2.6, 2)),
        ("far", (-0.1, 0, -2), (0.1, 2.6, -0.6)),
        ("lintel", (-0.1, 2.1, -0.6), (0.1, 2.6, 0.9)),
    ):
        scene.box(f"Wall/{name}", low, high, plaster)
    corners = [(-2.9, 0.01, -1.0), (-2.9, 0.01, 1.0), (-0.7, 0.01, 1.0), (-0.7, 0.01, -1.0)]
    scene.quad("Rug", corners, rug, st=[(0, 0), (0, 1), (1, 1), (1, 0)])
    scene.box("Table/top", (-2.3, 0.42, -0.55), (-1.3, 0.47, 0.05), wood)
    for k, (x, z) in enumerate([(-2.25, -0.5), (-1.4, -0.5), (-2.25, -0.05), (-1.4, -0.05)]):
        scene.box(f"Table/leg_{k}", (x, 0.01, z), (x + 0.05, 0.42, z + 0.05), wood)
    scene.mesh("Vase", 0.7 * vase()[0] + (-1.8, 0.47, -0.25), vase()[1], blue, digits=3)
    scene.box("Cabinet", (-2.6, 0, -1.98), (-1.0, 1.0, -1.55), wood)
    scene.box("Sofa/seat", (2.2, 0, -1.6), (3.6, 0.45, 0.4), blue)
    scene.box("Sofa/back", (3.6, 0, -1.6), (3.85, 0.95, 0.4), blue)
    light = scene.light(UsdLux.RectLight, "Lamp", (1.0, 0.92, 0.8), 75.0, width=1.0, height=1.0)
    scene.aim(light, (1.9, 2.55, 0.1), (1.9, 0, 0.1))
    scene.camera((-3.8, 1.5, 1.6), (-0.4, 0.95, -0.35), focal=24.0, aperture=(36.0, 27.0))
    return scene


def turntable():
    """A knot and four blocks turn once in 24 frames on a disc in a studio; the knot has smooth normals."""
    scene = Builder(turntable.__doc__)
    stage = scene.stage
    stage.SetStartTimeCode(1)
    stage.SetEndTimeCode(24)
    stage.SetTimeCodesPerSecond(24)
    paper, clay = scene.material("Paper", WHITE), scene.material("Clay", (0.72, 0.36, 0.22))
    bend = np.linspace(0.0, math.pi / 2, 17)
    profile = [
        (0.0, 3.0),
        *zip(0.9 - 0.9 * np.cos(bend), -1.1 - 0.9 * np.sin(bend), strict=True),
        (3.2, -2.0),
    ]
    sweep = np.array([(x, y, z) for y, z in profile for x in (-3.5, 3.5)])
    scene.mesh("Sweep", sweep, [(2 * k, 2 * k + 1, 2 * k + 3, 2 * k + 2) for k in range(len(profile) - 1)], paper)
    table = UsdGeom.Xform.Define(stage, "/World/Turntable")
    turn = table.AddRotateYOp()
    for frame in range(24):
        turn.Set(15.0 * frame, frame + 1)
    phi = 2 * np.pi * np.arange(64) / 64
    disc = np.array([(0.9 * math.cos(a), y, -0.9 * math.sin(a)) for y in (0.0, 0.1) for a in phi])
    rim = [(k, (k + 1) % 64, (k + 1) % 64 + 64, k + 64) for k in range(64)]
    slate = scene.material("Slate", DARK)
    scene.mesh("Turntable/Disc", disc, [*rim, tuple(range(64, 128)), tuple(range(63, -1, -1))], slate)
    points, faces, normals = knot(rows=192, columns=24, tube=0.07)
    trefoil = scene.mesh("Turntable/Knot", points, faces, clay, normals=normals, digits=4)
    scene.place(trefoil, (0, 0.1, 0))
    for k, hue in enumerate((0.1, 0.35, 0.6, 0.85)):
        colour = scene.material(f"Block_{k}", rounded(colorsys.hsv_to_rgb(hue, 0.6, 0.7), 3))
        block = scene.box(f"Turntable/block_{k}", (-0.1, 0, -0.1), (0.1, 0.2 + 0.08 * k, 0.1), colour)
        angle = math.pi * (k + 0.5) / 2
        scene.place(block, (0.62 * math.cos(angle), 0.1, 0.62 * math.sin(angle)), (0, 25 * k, 0))
    key = scene.light(UsdLux.RectLight, "Key", (1.0, 0.93, 0.82), 10.0, width=1.2, height=1.2)
    scene.aim(key, (-1.8, 2.4, 1.4), (0, 0.4, 0))
    fill = scene.light(UsdLux.DiskLight, "Fill", (0.7, 0.82, 1.0), 3.5, radius=0.8)
    scene.aim(fill, (2.6, 1.6, 1.2), (0, 0.4, 0))
    scene.camera((0, 1.35, 2.9), (0, 0.38, 0), focal=36.0, aperture=(36.0, 27.0))
    return scene


SCENES = {
    cornell_box: "reference",
    furnace_sphere: "2 everywhere",
    furnace_cube: "2 everywhere",
    corridor: "reference; direct light in view is 0",
    crowded_room: "reference",
    thousand_lights: "reference",
    thin_walls: "0 everywhere, exactly",
    light_types: "reference",
    two_rooms: "reference",
    turntable: "frames 1 to 24 differ, frame 25 would be frame 1",
}


README = """\
# Test scenes

`scripts/make_scenes.py` writes these files: change them there. Each scene has a camera `main_cam`, and the `doc` of its
layer describes it in more detail. References are the pictures in `benchmarks/references/`. All files in this folder,
including the textures, are dedicated to the public domain ([CC0 1.0](https://creativecommons.org/publicdomain/zero/1.0/)).

| file | what it shows | known answer | triangles | lights | licence |
|---|---|---|---:|---:|---|
"""


def _count(stage):
    """The numbers of triangles and lights, with all instances."""
    triangles = lights = 0
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        if prim.IsA(UsdGeom.Mesh):
            triangles += int(np.sum(np.array(UsdGeom.Mesh(prim).GetFaceVertexCountsAttr().Get()) - 2))
        lights += prim.HasAPI(UsdLux.LightAPI)
    return triangles, lights


def write_scenes(folder):
    """Writes every scene, the textures and README.md into `folder`."""
    folder = Path(folder)
    (folder / "textures").mkdir(parents=True, exist_ok=True)
    for name, make in TEXTURES.items():
        pixels = np.ascontiguousarray(make())
        target = oiio.ImageOutput.create("x.png")
        target.open(str(folder / "textures" / f"{name}.png"), oiio.ImageSpec(256, 256, 3, "uint8"))
        target.write_image(pixels)
        target.close()
    rows = []
    for make, answer in SCENES.items():
        scene = make()
        scene.stage.GetRootLayer().Export(str(folder / f"{make.__name__}.usda"))
        summary = make.__doc__.strip().split("\n")[0]
        triangles, lights = _count(scene.stage)
        rows.append(f"| `{make.__name__}.usda` | {summary} | {answer} | {triangles:,} | {lights} | CC0 |")
    (folder / "README.md").write_text(README + "\n".join(rows) + "\n", encoding="utf-8", newline="\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    default = Path(__file__).parents[1] / "scenes_usd"
    parser.add_argument("folder", metavar="FOLDER", nargs="?", default=default, help="folder to write to")
    write_scenes(parser.parse_args().folder)
