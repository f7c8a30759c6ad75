"""Scenes written twice by hand, as USD and for Mitsuba 3: the pictures agree within 1 % wherever one looks.

Nothing of the renderer helps to describe the second scene: it gets points, matrices and image files of these tests.
"""

import ctypes.util
import math
import os

import numpy as np
import pytest

import warp_ir as ir
from tests.physics.closed_form import placed, rotation
from tests.physics.level import at, image_nodes, load, material, mesh, usd
from tests.stages import write_image

pytestmark = pytest.mark.slow

WIDTH, HEIGHT, BLOCK = 48, 32, 8
FOV = math.degrees(2.0 * math.atan(0.4))
EYE, TARGET = np.array([0.6, 1.6, 4.2]), np.array([0.0, 0.7, 0.0])


@pytest.fixture(scope="module")
def mi():
    """Mitsuba, vectorised where there is LLVM."""
    mitsuba = pytest.importorskip("mitsuba")
    variant = "scalar_rgb"
    if "DRJIT_LIBLLVM_PATH" not in os.environ:
        found = [ctypes.util.find_library(f"LLVM-{version}") for version in range(22, 15, -1)]
        if any(found):
            os.environ["DRJIT_LIBLLVM_PATH"] = next(filter(None, found))
    if "DRJIT_LIBLLVM_PATH" in os.environ:
        variant = "llvm_ad_rgb"
    mitsuba.set_variant(variant)
    return mitsuba


def view():
    """World from camera, for USD."""
    back = (EYE - TARGET) / np.linalg.norm(EYE - TARGET)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    return placed(np.column_stack([right, np.cross(back, right), back]), EYE)


CAMERA = f"""
def Camera "Cam" {{
    float horizontalAperture = 40
    float verticalAperture = {40.0 * HEIGHT / WIDTH}
    float focalLength = 50
    float2 clippingRange = (0.01, 1000)
    {at(view())}
    %s
}}
"""


def rgb(*values):
    return {"type": "rgb", "value": [float(x) for x in (values if len(values) == 3 else values * 3)]}


def diffuse(reflectance):
    return {"type": "twosided", "nested": {"type": "diffuse", "reflectance": reflectance}}


def polygon(mi, points, faces, bsdf, uvs=None, colors=None, emission=None):
    """A mesh of arrays; its corners are not shared."""
    triangles = [(face[0], face[k], face[k + 1]) for face in faces for k in range(1, len(face) - 1)]
    corners = np.array(triangles).ravel()
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    properties["face_normals"] = True
    if emission is not None:
        properties["emitter"] = mi.load_dict({"type": "area", "radiance": emission})
    out = mi.Mesh("mesh", len(corners), len(triangles), has_vertex_texcoords=uvs is not None, props=properties)
    if colors is not None:
        out.add_attribute("vertex_color", 3, np.asarray(colors, np.float32)[corners].ravel())
    parameters = mi.traverse(out)
    parameters["vertex_positions"] = np.asarray(points, np.float32)[corners].ravel()
    parameters["faces"] = np.arange(len(corners), dtype=np.uint32)
    if uvs is not None:
        # There v runs down the image.
        parameters["vertex_texcoords"] = (np.asarray(uvs)[corners] * [1, -1] + [0, 1]).astype(np.float32).ravel()
    parameters.update()
    return out


def sensor(mi, **more):
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    look = mi.ScalarTransform4f().look_at(origin=EYE.tolist(), target=TARGET.tolist(), up=[0, 1, 0])
    common = {"type": "perspective", "to_world": look, "fov": FOV, "fov_axis": "x", "near_clip": 0.01}
    return {**common, "film": film, **more}


def reference(mi, scene, bounces, passes=16, samples=256):
    """Mean and standard error [h, w, 3]."""
    if "llvm" not in mi.variant():
        samples //= 8
    integrator = {"type": "volpath", "max_depth": bounces + 2, "rr_depth": 1000, "hide_emitters": True}
    made = mi.load_dict({"type": "scene", "integrator": integrator, **scene})
    pictures = np.array([np.array(mi.render(made, spp=samples, seed=k)) for k in range(passes)], float)
    return pictures.mean(axis=0), pictures.std(axis=0, ddof=1) / math.sqrt(passes)


def blocks(picture):
    return picture.reshape(HEIGHT // BLOCK, BLOCK, WIDTH // BLOCK, BLOCK, 3).mean(axis=(1, 3))


def agree(scene, expected, bounces, iterations=192, **settings):
    """All of the picture, within 1 %; every block of 8 x 8 pixels, within 1 % and 4 standard errors of both."""
    mean, error = expected
    given = dict(width=WIDTH, height=HEIGHT, light_paths=1024, max_bounces=bounces, filter=False) | settings
    film = ir.render(scene, ir.RenderSettings(iterations=iterations, **given))
    found = film.radiance().astype(float)
    ratio = found.mean(axis=(0, 1)) / mean.mean(axis=(0, 1))
    assert np.abs(ratio - 1.0).max() < 0.01, ratio
    # Ours are correlated within a block, as VPLs are; theirs are not.
    spread = np.hypot(blocks(film.standard_error()), np.sqrt(blocks(error**2)) / BLOCK)
    difference = np.abs(blocks(found) - blocks(mean))
    assert (difference <= 0.01 * blocks(mean) + 4.0 * spread + 1e-4 * mean.mean()).all()
    assert spread.mean() < 0.02 * mean.mean()
    return ratio


ROOM = {
    "Floor": ([(-3, 0, 3), (3, 0, 3), (3, 0, -2), (-3, 0, -2)], (0.7, 0.6, 0.5)),
    "Back": ([(-3, 0, -2), (3, 0, -2), (3, 3, -2), (-3, 3, -2)], (0.4, 0.6, 0.7)),
    "Side": ([(-2, 0, 3), (-2, 0, -2), (-2, 3, -2), (-2, 3, 3)], (0.8, 0.3, 0.2)),
}
CUBE = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.5
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def room_usd():
    return "".join(
        mesh(name, points, more=f"color3f[] primvars:displayColor = [{color}]")
        for name, (points, color) in ROOM.items()
    )


def room_mi(mi):
    return {name: polygon(mi, points, [(0, 1, 2, 3)], diffuse(rgb(*color))) for name, (points, color) in ROOM.items()}


def moved(matrix, points):
    return np.asarray(points) @ np.asarray(matrix)[:3, :3].T + np.asarray(matrix)[:3, 3]


def test_lights(mi, tmp_path):
    """Every light of UsdLux, scaled, normalized, textured, in an instance, and a mesh light; three bounces."""
    pixels = np.random.default_rng(1).integers(30, 256, (8, 8, 3), dtype=np.uint8)
    write_image(tmp_path / "t.png", pixels, "uint8")
    down = rotation(0, -90.0)
    rect = placed(rotation(2, 20.0) @ down @ np.diag([1.4, 0.6, 2.0]), (-0.6, 2.6, 0.3))
    disk = placed(rotation(0, -60.0) @ np.diag([0.5, 1.5, 1.0]), (1.2, 2.2, 1.0))
    ball = placed(np.eye(3), (0.9, 0.5, 0.6))
    tube = placed(rotation(2, 30.0), (-1.2, 0.9, -1.2))
    inner, outer = placed(down, (0.1, 0.0, 0.2)), placed(rotation(1, 40.0) @ np.diag([0.7, 0.7, 0.9]), (0.2, 2.4, -1.3))
    # Out of sight: `hide_emitters` would let the eye look through it.
    plate = placed(rotation(1, 80.0) @ np.diag([0.9, 0.6, 1.0]), (2.6, 1.0, 0.8))
    sun = rotation(1, 35.0) @ rotation(0, -50.0)
    text = room_usd() + CAMERA % "" + f"""
def RectLight "Rect" {{
    {at(rect)}
    float inputs:intensity = 6
    float inputs:width = 1.2
    bool inputs:normalize = true
    asset inputs:texture:file = @t.png@
}}
def DiskLight "Disk" {{
    {at(disk)}
    float inputs:exposure = 2
    color3f inputs:color = (1, 0.5, 0.2)
    float inputs:radius = 0.4
}}
def SphereLight "Ball" {{
    {at(ball)}
    float inputs:intensity = 2
    float inputs:radius = 0.2
    bool inputs:normalize = true
}}
def CylinderLight "Tube" {{
    {at(tube)}
    float inputs:intensity = 3
    float inputs:radius = 0.05
    float inputs:length = 0.8
}}
def DistantLight "Sun" {{
    {at(placed(sun))}
    float inputs:intensity = 0.4
    float inputs:angle = 0
}}
def SphereLight "Point" {{
    {at(placed(np.eye(3), (1.6, 1.0, -1.0)))}
    float inputs:intensity = 1.5
    bool treatAsPoint = true
    bool inputs:normalize = true
}}
over "Proto" {{
    def RectLight "Lamp" {{
        {at(inner)}
        float inputs:intensity = 5
        bool inputs:normalize = true
    }}
}}
def Xform "Instance" (instanceable = true
    prepend references = </Proto>) {{
    {at(outer)}
}}
""" + mesh("Plate", moved(plate, [(0.5, -0.5, 0), (-0.5, -0.5, 0), (-0.5, 0.5, 0), (0.5, 0.5, 0)]),
           more="float inputs:intensity = 4\n uniform token light:materialSyncMode = \"noMaterialResponse\"",
           api='"MeshLightAPI"')  # fmt: skip

    def lamp(shape, radiance):
        return {**shape, "emitter": {"type": "area", "radiance": radiance}, "surface": {"type": "null"}}

    def flat(matrix, radiance, width=1.0, height=1.0):
        turn = np.asarray(matrix) @ np.diag([-width / 2, height / 2, -1.0, 1.0])
        return lamp({"type": "rectangle", "to_world": mi.ScalarTransform4f(turn)}, radiance)

    around = np.linspace(0, 2 * np.pi, 257)[:-1][::-1]
    rim = np.column_stack([np.cos(around), np.sin(around), 0 * around]) * 0.4
    image = {"type": "bitmap", "filename": str(tmp_path / "t.png"), "wrap_mode": "clamp"}
    area = 1.2 * np.linalg.norm(np.cross(rect[:3, 0], rect[:3, 1]))
    placed_lamp = outer @ inner
    small = np.linalg.norm(np.cross(placed_lamp[:3, 0], placed_lamp[:3, 1]))
    # Mitsuba's textures have no factor: the whole scene is dimmed instead, so that the image has the radiance 1.
    dim = area / 6.0
    scene = {
        **room_mi(mi),
        "sensor": sensor(mi),
        "rect": flat(rect, image, 1.2),
        "disk": polygon(mi, moved(disk, rim), [range(256)], {"type": "null"},
                        emission=rgb(4 * dim, 2 * dim, 0.8 * dim)),
        "ball": lamp({"type": "sphere", "center": ball[:3, 3].tolist(), "radius": 0.2},
                     rgb(dim * 2 / (4 * math.pi * 0.04))),
        "tube": lamp({"type": "cylinder", "p0": [-0.4, 0, 0], "p1": [0.4, 0, 0], "radius": 0.05,
                      "to_world": mi.ScalarTransform4f(tube)}, rgb(3 * dim)),
        "sun": {"type": "directional", "direction": (-sun[:, 2]).tolist(), "irradiance": rgb(0.4 * dim)},
        "point": {"type": "point", "position": [1.6, 1.0, -1.0], "intensity": rgb(1.5 / 4 * dim)},
        "lamp": flat(placed_lamp, rgb(5 / small * dim)),
        "plate": polygon(mi, moved(plate, [(0.5, -0.5, 0), (-0.5, -0.5, 0), (-0.5, 0.5, 0), (0.5, 0.5, 0)]),
                         [(0, 1, 2, 3)], diffuse(rgb(0)), emission=rgb(4 * dim)),
    }  # fmt: skip
    mean, error = reference(mi, scene, 3)
    agree(load(tmp_path, text), (mean / dim, error / dim), 3)


def cube_usd(name, more="", inside=""):
    return mesh(name, CUBE, SIDES, f"{more}\n{inside}")


def cube_mi(mi, matrix, color):
    return polygon(mi, moved(matrix, CUBE), SIDES, diffuse(rgb(*color)))


def test_a_sky_through_screens(mi, tmp_path):
    """A turned lat-long sky with a small sun; a screen with holes, one that is half there, a cube; two bounces."""
    rows, columns = np.meshgrid((np.arange(64) + 0.5) / 64, (np.arange(128) + 0.5) / 128, indexing="ij")
    sky = np.stack([0.6 + 0.4 * np.sin(2 * np.pi * columns), 0.7 - 0.3 * rows, 0.5 + 0.5 * np.cos(np.pi * rows)], -1)
    sky[12:15, 80:84] += (60.0, 50.0, 40.0)
    write_image(tmp_path / "sky.exr", sky.astype(np.float32))
    holes = np.kron(np.indices((4, 4)).sum(0) % 2, np.ones((16, 16)))[..., None] * 255
    write_image(tmp_path / "holes.png", np.concatenate([holes] * 3, -1).astype(np.uint8), "uint8")
    turn = rotation(1, 130.0) @ rotation(0, 20.0)
    screen = [(-1.6, 1.8, -1.2), (-0.2, 1.8, -1.2), (-0.2, 1.6, 1.0), (-1.6, 1.6, 1.0)]
    veil = [(0.3, 0.0, -0.6), (1.5, 0.0, -0.9), (1.5, 1.4, -0.9), (0.3, 1.4, -0.6)]
    block = placed(rotation(1, 25.0) @ np.diag([0.6, 0.8, 0.6]), (-0.6, 0.4, 0.4))
    st = 'texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = "vertex")'
    api = '"MaterialBindingAPI"'
    text = room_usd() + CAMERA % "" + f"""
def DomeLight "Sky" {{
    {at(placed(turn))}
    float inputs:intensity = 2
    float inputs:exposure = -1
    asset inputs:texture:file = @sky.exr@
    token inputs:texture:format = "latlong"
}}
""" + cube_usd("Block", at(block), "color3f[] primvars:displayColor = [(0.3, 0.8, 0.4)]")  # fmt: skip
    text += mesh("Screen", screen, more=f"{st}\n rel material:binding = </Holes>", api=api)
    text += mesh("Veil", veil, more="rel material:binding = </Half>", api=api)
    clamp = 'token inputs:wrapS = "clamp"\n token inputs:wrapT = "clamp"\n token inputs:sourceColorSpace = "raw"'
    holed = """float inputs:opacityThreshold = 0.5
        color3f inputs:diffuseColor = (0.6, 0.2, 0.2)
        float inputs:opacity.connect = </Holes/T.outputs:r>"""
    text += material(holed, "Holes", image_nodes("holes.png", clamp, "r", "Holes"))
    text += material("color3f inputs:diffuseColor = (0.2, 0.3, 0.9)\n float inputs:opacity = 0.5", "Half")

    image = {"type": "bitmap", "filename": str(tmp_path / "holes.png"), "raw": True, "wrap_mode": "clamp",
             "filter_type": "nearest"}  # fmt: skip
    uvs = [(0, 0), (1, 0), (1, 1), (0, 1)]
    quad = [(0, 1, 2, 3)]
    scene = {
        **room_mi(mi),
        "sensor": sensor(mi),
        "sky": {
            "type": "envmap",
            "filename": str(tmp_path / "sky.exr"),
            "to_world": mi.ScalarTransform4f(placed(turn)),
        },
        "block": cube_mi(mi, block, (0.3, 0.8, 0.4)),
        "screen": polygon(
            mi, screen, quad, {"type": "mask", "opacity": image, "nested": diffuse(rgb(0.6, 0.2, 0.2))}, uvs
        ),
        "veil": polygon(mi, veil, quad, {"type": "mask", "opacity": 0.5, "nested": diffuse(rgb(0.2, 0.3, 0.9))}),
    }
    agree(load(tmp_path, text, warnings=["opacity"]), reference(mi, scene, 2), 2, iterations=512)


def test_materials(mi, tmp_path):
    """Images that repeat, are mirrored and turned, UDIM, colours of points, metal and speculars; three bounces."""
    random = np.random.default_rng(5)
    pixels = random.integers(0, 256, (8, 8, 3), dtype=np.uint8)
    write_image(tmp_path / "t.png", pixels, "uint8")
    for number in (1001, 1002):
        write_image(tmp_path / f"u.{number}.png", random.integers(0, 256, (8, 8, 3), dtype=np.uint8), "uint8")
    api = '"MaterialBindingAPI"'
    lamp = placed(rotation(0, -90.0), (0.2, 2.7, 0.0))
    points = {name: room[0] for name, room in ROOM.items()}
    st = [(0, 0), (2.5, 0), (2.5, 2), (0, 2)]
    wide = [(0, 0), (2, 0), (2, 1), (0, 1)]
    text = CAMERA % "" + f"""
def RectLight "Lamp" {{
    {at(lamp)}
    float inputs:intensity = 8
    float inputs:width = 1.2
    float inputs:height = 0.7
}}
"""  # fmt: skip

    def wall(name, uvs, look):
        coordinates = f'texCoord2f[] primvars:st = {uvs} (interpolation = "vertex")'
        return mesh(name, points[name], more=f"{coordinates}\n rel material:binding = </{look}>", api=api)

    text += wall("Floor", st, "Turned") + wall("Back", st, "Mirror") + wall("Side", wide, "Tiles")
    turned = """def Shader "P" {
        uniform token info:id = "UsdTransform2d"
        float2 inputs:in.connect = </Turned/R.outputs:result>
        float2 inputs:scale = (0.75, 1.5)
        float inputs:rotation = 20
        float2 inputs:translation = (0.3, 0.1)
        float2 outputs:result
    }"""
    repeat, mirror = (f'token inputs:wrapS = "{w}"\n token inputs:wrapT = "{w}"' for w in ("repeat", "mirror"))
    for name, file, more in (("Turned", "t.png", repeat), ("Mirror", "t.png", mirror), ("Tiles", "u.<UDIM>.png", "")):
        if name == "Mirror":
            more += "\n float4 inputs:scale = (0.5, 0.9, 0.7, 1)\n float4 inputs:bias = (0.1, 0, 0.2, 0)"
        nodes = image_nodes(file, more, name=name)
        if name == "Turned":
            nodes = nodes.replace("</Turned/R.", "</Turned/P.") + "\n    " + turned
        text += material(f"color3f inputs:diffuseColor.connect = </{name}/T.outputs:rgb>", name, nodes)
    colors = random.random((8, 3)).round(3)
    metal = placed(rotation(1, 30.0) @ np.diag([0.7, 1.1, 0.7]), (-0.6, 0.55, -0.4))
    plastic = placed(np.diag([0.5, 0.5, 0.5]), (0.6, 0.25, 0.9))
    painted = placed(rotation(1, -20.0) @ np.diag([0.6, 0.7, 0.6]), (1.3, 0.35, -0.3))
    # Triangles, so that nobody has to choose a diagonal.
    triangles = [t for a, b, c, d in SIDES for t in ((a, b, c), (a, c, d))]
    for name, matrix in (("Metal", metal), ("Plastic", plastic)):
        text += mesh(name + "Box", CUBE, SIDES, f"{at(matrix)} rel material:binding = </{name}>", api)
    painting = f'color3f[] primvars:displayColor = {usd(colors)} (interpolation = "vertex")'
    text += mesh("Painted", CUBE, triangles, f"{at(painted)} {painting}")
    text += material("color3f inputs:diffuseColor = (0.9, 0.7, 0.3)\n float inputs:metallic = 1", "Metal")
    specular = "color3f inputs:diffuseColor = (0.2, 0.5, 0.6)\n int inputs:useSpecularWorkflow = 1\n"
    text += material(specular + "color3f inputs:specularColor = (0.2, 0.2, 0.2)", "Plastic")

    def bitmap(file, wrap):
        return {"type": "bitmap", "filename": str(tmp_path / file), "wrap_mode": wrap}

    # The mirrored image with its scale and bias, decoded by the definition of sRGB.
    x = pixels / 255.0
    light = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    mixed = mi.Bitmap((light * (0.5, 0.9, 0.7) + (0.1, 0.0, 0.2)).astype(np.float32))
    adjusted = {"type": "bitmap", "bitmap": mixed, "raw": True, "wrap_mode": "mirror"}
    spun = (np.array(st) * (0.75, 1.5)) @ rotation(2, 20.0)[:2, :2].T + (0.3, 0.1)
    quad = [(0, 1, 2, 3)]
    left, right = np.array(points["Side"], float), np.array(points["Side"], float)
    left[[1, 2]] = right[[0, 3]] = 0.5 * (left[[0, 3]] + left[[1, 2]])
    unit = [(0, 0), (1, 0), (1, 1), (0, 1)]
    flip = lamp @ np.diag([-0.6, 0.35, -1.0, 1.0])
    scene = {
        "sensor": sensor(mi),
        "lamp": {"type": "rectangle", "to_world": mi.ScalarTransform4f(flip), "bsdf": {"type": "null"},
                 "emitter": {"type": "area", "radiance": rgb(8)}},
        "floor": polygon(mi, points["Floor"], quad, diffuse(bitmap("t.png", "repeat")), spun),
        "back": polygon(mi, points["Back"], quad, diffuse(adjusted), st),
        "left": polygon(mi, left, quad, diffuse(bitmap("u.1001.png", "clamp")), unit),
        "right": polygon(mi, right, quad, diffuse(bitmap("u.1002.png", "clamp")), unit),
        "metal": cube_mi(mi, metal, (0.9, 0.7, 0.3)),
        "plastic": cube_mi(mi, plastic, 0.8 * np.array([0.2, 0.5, 0.6]) + 0.2),
        "painted": polygon(mi, moved(painted, CUBE), triangles,
                           diffuse({"type": "mesh_attribute", "name": "vertex_color"}), colors=colors),
    }  # fmt: skip
    agree(load(tmp_path, text, warnings=["metal", "specular"]), reference(mi, scene, 3), 3)


def copies(name, target, matrices):
    return "".join(
        f'def Xform "{name}{k}" (instanceable = true\n prepend references = <{target}>) {{\n {at(m)} }}\n'
        for k, m in enumerate(matrices)
    )


def test_instances(mi, tmp_path, monkeypatch):
    """Nested native instances and a turned, scaled point instancer, written out or stored once; three bounces."""
    inner = [
        placed(rotation(1, 20.0) @ np.diag([0.4, 0.6, 0.4]), (0.0, 0.3, 0.0)),
        placed(np.diag([0.2] * 3), (0.5, 0.1, 0.3)),
    ]
    outer = [
        placed(rotation(1, 75.0), (-0.9, 0.0, 0.2)),
        placed(rotation(1, -30.0) @ np.diag([1.3, 0.8, -1.0]), (0.8, 0.0, -0.9)),
    ]
    angle, scales = math.radians(50.0), [(0.3, 0.3, 0.5), (0.5, 0.2, 0.2)]
    places = [(0.3, 0.4, 1.1), (-0.2, 1.4, -0.8)]
    turns = [rotation(0, 50.0), rotation(2, 50.0)]
    own = placed(rotation(1, 10.0), (0.1, 0.0, 0.0))
    cloud = placed(rotation(1, 5.0), (0.2, 0.0, 0.1))
    w, s = math.cos(angle / 2), math.sin(angle / 2)
    lamp = placed(rotation(0, -90.0), (0.0, 2.8, 0.2))
    color = "color3f[] primvars:displayColor = [%s]"
    text = room_usd() + CAMERA % "" + f"""
def RectLight "Lamp" {{
    {at(lamp)}
    float inputs:intensity = 12
}}
over "Pair" {{
    {copies("C", "/Cube", inner)}
}}
over "Cube" {{
    {cube_usd("Box", color % "(0.8, 0.7, 0.2)")}
}}
{copies("P", "/Pair", outer)}
def PointInstancer "Cloud" {{
    rel prototypes = </Cloud/Brick>
    int[] protoIndices = [0, 0]
    point3f[] positions = {places}
    quatf[] orientationsf = [({w}, {s}, 0, 0), ({w}, 0, 0, {s})]
    float3[] scales = {scales}
    {at(cloud)}
    {cube_usd("Brick", at(own), color % "(0.2, 0.4, 0.9)")}
}}
"""  # fmt: skip
    matrices = [a @ b for a in outer for b in inner]
    bricks = [
        cloud @ placed(turn @ np.diag(scale), place) @ own
        for turn, scale, place in zip(turns, scales, places, strict=True)
    ]
    scene = {
        **room_mi(mi),
        "sensor": sensor(mi),
        "lamp": {"type": "rectangle", "to_world": mi.ScalarTransform4f(lamp @ np.diag([-0.5, 0.5, -1.0, 1.0])),
                 "bsdf": {"type": "null"}, "emitter": {"type": "area", "radiance": rgb(12)}},
        **{f"cube{k}": cube_mi(mi, m, (0.8, 0.7, 0.2)) for k, m in enumerate(matrices)},
        **{f"brick{k}": cube_mi(mi, m, (0.2, 0.4, 0.9)) for k, m in enumerate(bricks)},
    }  # fmt: skip
    expected = reference(mi, scene, 3)
    agree(load(tmp_path, text), expected, 3)
    monkeypatch.setattr("warp_ir.usd.geometry.prototypes.MAX_FLATTENED_TRIANGLES", 0)
    stored = load(tmp_path, text)
    assert stored.instances
    agree(stored, expected, 3)


@pytest.mark.parametrize("how", ["lens", "offset", "orthographic"])
def test_cameras(mi, tmp_path, how):
    """A thin lens with its focus on the cube, a shifted aperture, and parallel rays; two bounces."""
    lamp = placed(rotation(0, -90.0), (0.3, 2.7, 0.4))
    block = placed(rotation(1, 25.0) @ np.diag([0.6, 0.8, 0.6]), (-0.3, 0.4, 0.4))
    more = {
        "lens": "float fStop = 16\n    float focusDistance = 3.8",
        "offset": "float horizontalApertureOffset = 6\n    float verticalApertureOffset = -4",
        "orthographic": 'uniform token projection = "orthographic"',
    }[how]
    text = room_usd() + CAMERA % more + f"""
def RectLight "Lamp" {{
    {at(lamp)}
    float inputs:intensity = 9
}}
""" + cube_usd("Block", at(block), "color3f[] primvars:displayColor = [(0.3, 0.8, 0.4)]")  # fmt: skip
    seen = sensor(mi)
    if how == "lens":
        # The focal length is 50 tenths of a unit.
        seen |= {"type": "thinlens", "aperture_radius": 0.5 * 5.0 / 16.0, "focus_distance": 3.8}
    elif how == "offset":
        seen |= {"principal_point_offset_x": 6 / 40, "principal_point_offset_y": 4 / (40 * HEIGHT / WIDTH)}
    else:
        look = mi.ScalarTransform4f().look_at(origin=EYE.tolist(), target=TARGET.tolist(), up=[0, 1, 0])
        seen = {k: v for k, v in seen.items() if not k.startswith("fov")}
        seen |= {"type": "orthographic", "to_world": look @ mi.ScalarTransform4f().scale([2.0, 2.0, 1.0])}
    scene = {
        **room_mi(mi),
        "sensor": seen,
        "block": cube_mi(mi, block, (0.3, 0.8, 0.4)),
        "lamp": {"type": "rectangle", "to_world": mi.ScalarTransform4f(lamp @ np.diag([-0.5, 0.5, -1.0, 1.0])),
                 "bsdf": {"type": "null"}, "emitter": {"type": "area", "radiance": rgb(9)}},
    }  # fmt: skip
    agree(load(tmp_path, text), reference(mi, scene, 2), 2)


def test_curves_and_points(mi, tmp_path):
    """Tubes along B-splines, of a width that changes, and spheres of three sizes; tubes end in the floor."""
    rng = np.random.default_rng(8)
    strands = []
    for k in range(5):
        foot, across = np.array([-1.2 + 0.5 * k, -0.4, -0.6 + 0.25 * k]), rng.uniform(-0.4, 0.4, (3, 3))
        heights = np.array([[0.6], [1.2], [0.7]])
        arch = foot + np.array([[0.1, 0, 0.1], [0.4, 0, 0.2], [0.7, 0, 0.3]]) + across * (1, 0, 1) + heights * (0, 1, 0)
        strands.append(np.concatenate([[foot] * 2, arch, [arch[-1] * (1, 0, 1) + (0, -0.4, 0)] * 2]))
    radii = np.tile([0.05, 0.05, 0.12, 0.07, 0.1, 0.05, 0.05], (len(strands), 1))
    points = np.concatenate(strands)
    centres, sizes = np.array([(-0.9, 0.25, 0.9), (0.3, 0.4, 1.0), (1.0, 1.3, 0.0)]), (0.25, 0.4, 0.2)
    lamp, green = placed(rotation(0, -90.0), (0.0, 2.8, 0.2)), rgb(0.3, 0.7, 0.4)
    text = room_usd() + CAMERA % "" + f"""
def RectLight "Lamp" {{
    {at(lamp)}
    float inputs:intensity = 12
}}
def BasisCurves "Hair" {{
    uniform token type = "cubic"
    uniform token basis = "bspline"
    uniform token wrap = "nonperiodic"
    int[] curveVertexCounts = {[7] * len(strands)}
    point3f[] points = {usd(points)}
    float[] widths = {(2.0 * radii).ravel().tolist()} (interpolation = "vertex")
    color3f[] primvars:displayColor = [(0.8, 0.5, 0.2)]
}}
def Points "Balls" {{
    point3f[] points = {usd(centres)}
    float[] widths = {[2.0 * size for size in sizes]} (interpolation = "vertex")
    color3f[] primvars:displayColor = [(0.3, 0.7, 0.4)]
}}
"""  # fmt: skip
    rows = [
        "\n".join(f"{x} {y} {z} {r}" for (x, y, z), r in zip(strand, radius, strict=True))
        for strand, radius in zip(strands, radii, strict=True)
    ]
    (tmp_path / "hair.txt").write_text("\n\n".join(rows) + "\n")
    scene = {
        **room_mi(mi),
        "sensor": sensor(mi),
        "lamp": {"type": "rectangle", "to_world": mi.ScalarTransform4f(lamp @ np.diag([-0.5, 0.5, -1.0, 1.0])),
                 "bsdf": {"type": "null"}, "emitter": {"type": "area", "radiance": rgb(12)}},
        "hair": {"type": "bsplinecurve", "filename": f"{tmp_path}/hair.txt", "bsdf": diffuse(rgb(0.8, 0.5, 0.2))},
        **{f"ball{k}": {"type": "sphere", "center": centres[k].tolist(), "radius": sizes[k], "bsdf": diffuse(green)}
           for k in range(3)},
    }  # fmt: skip
    agree(load(tmp_path, text), reference(mi, scene, 3), 3)
