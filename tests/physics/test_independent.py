"""Scenes written twice by hand, as USD and for Mitsuba 3: the pictures agree within 1 % wherever one looks.

Nothing of the renderer helps to describe the second scene: it gets points, matrices and image files of these tests.
"""

import ctypes.util
import math
import os

import numpy as np
import pytest

import warp_ir as ir
from tests.physics.level import at, load, mesh, placed, rotation, write_image

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


def material(name, inputs, nodes=""):
    return f"""
def Material "{name}" {{
    token outputs:surface.connect = </{name}/S.outputs:surface>
    def Shader "S" {{
        uniform token info:id = "UsdPreviewSurface"
        {inputs}
        token outputs:surface
    }}
    {nodes}
}}
"""


def image_nodes(name, file, more, output="rgb"):
    return f"""def Shader "T" {{
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @{file}@
        float2 inputs:st.connect = </{name}/R.outputs:result>
        {more}
        float3 outputs:{output}
    }}
    def Shader "R" {{
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "st"
        float2 outputs:result
    }}"""


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
