"""Animation and motion blur: only what moves is read and uploaded again; an open shutter blurs moving surfaces."""

import json
import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import warp_ir as ir
from warp_ir.cli import main
from warp_ir.device.launcher import Launcher
from warp_ir.device_scene.upload import upload_scenes
from warp_ir.procedural import cornell_box
from warp_ir.usd.geometry.prototypes import MAX_FLATTENED_TRIANGLES
from warp_ir.usd.load import StageReader

pytestmark = pytest.mark.extended

SCENES = Path(__file__).parent.parent / "scenes_usd"
TURNTABLE = SCENES / "turntable.usda"

HEADER = """#usda 1.0
(
    startTimeCode = 1
    endTimeCode = 10
)
"""
QUAD = """def Mesh "{name}" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
    {more}
}}
"""
GLOW = """def Material "Glow" {
    token outputs:surface.connect = </Glow/S.outputs:surface>
    def Shader "S" {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor = (0, 0, 0)
        color3f inputs:emissiveColor = (1, 1, 1)
        %s
        token outputs:surface
    }
}
"""
MOVES = """double3 xformOp:translate.timeSamples = {{ {samples} }}
    uniform token[] xformOpOrder = ["xformOp:translate"]"""


def quad(name, more=""):
    return QUAD.format(name=name, more=more)


def moves(samples):
    return MOVES.format(samples=samples)


def xform(attributes, children):
    return f'def Xform "X" {{ {attributes}\n{children}}}\n'


def write(folder, *parts):
    file = folder / "stage.usda"
    file.write_text(HEADER + "".join(parts))
    return file


def same(one, other):
    """Whether two records have equal fields."""
    for f in fields(one):
        a, b = getattr(one, f.name), getattr(other, f.name)
        if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
            if not np.array_equal(a, b):
                return False
        elif a != b:
            return False
    return True


# ---- reading ---------------------------------------------------------------------------------------------


def test_static_prims_are_read_once():
    """The studio and the lamps around the turntable are the same objects in every frame; what rotates is not."""
    reader = StageReader(TURNTABLE)
    first, second = reader.read(1.0), reader.read(2.0)
    kept = {a.name for a, b in zip(first.meshes, second.meshes, strict=True) if a is b}
    assert kept == {"/World/Sweep"}
    assert all(a is b for a, b in zip(first.lights, second.lights, strict=True)) and len(first.lights) == 2
    assert [m.name for m in first.meshes] == [m.name for m in second.meshes] and len(first.meshes) == 7


@pytest.mark.parametrize("time", [1.0, 2.5, 7.0])
def test_a_frame_does_not_depend_on_frames_read_before(time):
    """Reading frames in sequence gives the same scene as opening the stage for one frame alone."""
    reader = StageReader(TURNTABLE)
    for other in (20.0, 3.0):
        reader.read(other)
    one, alone = reader.read(time), ir.load_usd(TURNTABLE, time=time)
    assert all(same(a, b) for a, b in zip(one.meshes, alone.meshes, strict=True))
    assert one.materials == alone.materials and same(one.camera, alone.camera)
    assert one.warnings == alone.warnings and one.stats == alone.stats


VARYING = {
    "transform": quad("M", moves("1: (0, 0, 0), 2: (1, 0, 0)")),
    "parent": xform(moves("1: (0, 0, 0), 2: (1, 0, 0)"), quad("M")),
    "visibility": quad("M", 'token visibility.timeSamples = { 1: "inherited", 2: "invisible" }'),
    "points": quad("M").replace("point3f[] points =", "point3f[] points.timeSamples = { 2: [], 1:").replace(
        "(-1, 1, 0)]", "(-1, 1, 0)] }"
    ),
    "color": quad("M", "color3f[] primvars:displayColor.timeSamples = { 1: [(1, 0, 0)], 2: [(0, 1, 0)] }"),
    "inherited color": xform(
        "color3f[] primvars:displayColor.timeSamples = { 1: [(1, 0, 0)], 2: [(0, 1, 0)] }", quad("M")
    ),
    "material": GLOW % "color3f inputs:emissiveColor.timeSamples = { 1: (1, 1, 1), 2: (2, 2, 2) }"
    + quad("M", "rel material:binding = </Glow>"),
    "instancer": xform(
        """int[] protoIndices = [0]
    point3f[] positions.timeSamples = { 1: [(0, 0, 0)], 2: [(3, 0, 0)] }
    rel prototypes = </X/M>""",
        quad("M"),
    ).replace("Xform", "PointInstancer"),
}  # fmt: skip


@pytest.mark.parametrize("what", VARYING)
def test_time_varying_prims_are_read_again(tmp_path, what):
    """Time samples of transforms, visibility, points, primvars, materials and instancers, own or of a dependency."""
    text = VARYING[what].replace("color3f inputs:emissiveColor = (1, 1, 1)\n", "")
    file = write(tmp_path, quad("Static"), text)
    reader = StageReader(file)
    first, second = reader.read(1.0), reader.read(2.0)
    for time, scene in ((1.0, first), (2.0, second)):
        alone = ir.load_usd(file, time=time)
        assert [m.name for m in scene.meshes] == [m.name for m in alone.meshes]
        assert all(same(a, b) for a, b in zip(scene.meshes, alone.meshes, strict=True))
        assert scene.materials == alone.materials
    assert first.meshes[0] is second.meshes[0] and first.meshes[0].name == "/Static"
    before, after = first.meshes[1:], second.meshes[1:]
    changed = [m.points for m in before], first.materials
    assert len(before) != len(after) or first.materials != second.materials or not all(
        np.array_equal(a, b.points) for a, b in zip(changed[0], after, strict=True)
    )  # fmt: skip


def test_velocities_move_points(tmp_path):
    """Velocities extrapolate points from the nearest sample, even if there is only one."""
    more = "vector3f[] velocities = [(1, 0, 0), (1, 0, 0), (1, 0, 0), (1, 0, 0)]"
    reader = StageReader(write(tmp_path, quad("Static"), quad("Carried", more)))
    reader.read()
    assert reader.moving_meshes == 1


def test_warnings_and_counts_are_those_of_every_frame(tmp_path):
    """Warnings about prims that are read once appear in every frame's report, once."""
    # Besides a sound face, one without an area.
    wrong = ("faceVertexCounts = [4]", "faceVertexCounts = [4, 3]"), ("[0, 1, 2, 3]", "[0, 1, 2, 3, 1, 1, 2]")
    parts = [quad("Bad"), quad("Worse", moves("1: (0, 0, 0), 2: (1, 0, 0)"))]
    file = write(tmp_path, *(part.replace(*wrong[0]).replace(*wrong[1]) for part in parts))
    reader = StageReader(file)
    scenes = [reader.read(time) for time in (1.0, 2.0, 3.0)]
    assert len({scene.warnings for scene in scenes}) == 1 and "/Bad, /Worse: 2" in "".join(scenes[0].warnings)
    assert len({tuple(scene.stats.items()) for scene in scenes}) == 1


# ---- uploading -------------------------------------------------------------------------------------------


def test_an_updated_renderer_renders_the_same(device):
    """The picture after an update is bitwise that of a new renderer."""
    reader = StageReader(TURNTABLE)
    settings = ir.RenderSettings(width=16, iterations=2, light_paths=16)
    renderer = ir.Renderer(reader.read(1.0), settings, device=device)
    renderer.render()
    for time in (2.0, 9.0):
        scene = reader.read(time)
        renderer.update(scene)
        np.testing.assert_array_equal(
            renderer.render().radiance(), ir.render(scene, settings, device=device).radiance()
        )


def test_shared_parts_are_uploaded_once():
    """A moving camera uploads nothing; a moving lamp leaves the surfaces and their tree on the device."""
    scene = ir.load_usd(SCENES / "cornell_box.usda")
    settings = ir.RenderSettings(width=8, iterations=1, light_paths=16)
    renderer = ir.Renderer(scene, settings)
    uploaded = renderer.scene
    moved = replace(scene.camera, world_from_camera=scene.camera.world_from_camera + np.eye(4)[:, [0, 1, 2, 3]] * 0)
    renderer.update(replace(scene, camera=moved))
    assert renderer.scene.data is uploaded.data
    lamp = replace(scene.lights[0], radiance=(1.0, 2.0, 3.0))
    renderer.update(replace(scene, lights=(lamp, *scene.lights[1:])))
    assert renderer.scene.data.points is uploaded.data.points
    assert renderer.scene.data.light_radiance is not uploaded.data.light_radiance
    other = replace(scene, lights=(lamp, *scene.lights[1:]))
    np.testing.assert_array_equal(renderer.render().radiance(), ir.render(other, settings).radiance())


def test_reused_meshes_are_checked_against_new_materials():
    """A mesh whose material indices were valid is rejected when the new scene has fewer materials."""
    scene = ir.load_usd(SCENES / "cornell_box.usda")
    renderer = ir.Renderer(scene, ir.RenderSettings(width=4, iterations=1, light_paths=16))
    with pytest.raises(ir.InputError, match="material refers to materials outside"):
        renderer.update(replace(scene, materials=scene.materials[:1]))


def test_a_dome_is_not_uploaded_again_when_others_move(device):
    """Textures of lights are uploaded once; the picture is bitwise that of a new renderer."""
    sky = ir.Light("sky", ir.LightKind.DOME, (1.0, 1.0, 1.0), texture=np.full((8, 16, 3), 0.5, np.float32))
    shaping = ir.Shaping(cone_angle=30.0)
    scene = cornell_box()
    settings = ir.RenderSettings(width=8, height=8, iterations=1, light_paths=64)

    def with_lamp(x, texture=sky.texture):
        place = np.eye(4)
        place[:3, 3] = x, 300.0, 100.0
        lamp = ir.Light("lamp", ir.LightKind.SPHERE, (50.0,) * 3, world_from_light=place, radius=20.0, shaping=shaping)
        return replace(scene, lights=(replace(sky, texture=texture), lamp))

    renderer = ir.Renderer(with_lamp(100.0), settings, device=device)
    there = renderer.scene.distributions.upload(renderer.launcher)
    moved = with_lamp(200.0)
    renderer.update(moved)
    assert renderer.scene.distributions.upload(renderer.launcher) is there
    fresh = ir.Renderer(moved, settings, device=device)
    np.testing.assert_array_equal(renderer.render().radiance(), fresh.render().radiance())
    renderer.update(with_lamp(200.0, np.ones((8, 16, 3), np.float32)))
    assert renderer.scene.distributions.upload(renderer.launcher) is not there


def test_stats_count_reused_meshes(tmp_path):
    """The statistics say how many meshes of a frame are those of the frame before."""
    stats = tmp_path / "s.json"
    command = ["render", str(TURNTABLE), str(tmp_path / "#.npy"), "-w", "8", "--iterations", "1", "--frames", "1:3"]
    assert main([*command, "--light-paths", "16", "--device", "cpu", "-q", "--stats", str(stats)]) == 0
    frames = json.loads(stats.read_text())["frames"]
    assert [frame["kept"] for frame in frames] == [
        {"meshes": 0, "lights": 0}, {"meshes": 1, "lights": 2}, {"meshes": 1, "lights": 2}
    ]  # fmt: skip


# ---- motion blur -----------------------------------------------------------------------------------------

CAMERA = """def Camera "C" {
    float horizontalAperture = 40
    float verticalAperture = 40
    float focalLength = 40
    float2 clippingRange = (0.01, 100)
    double shutter:open = %s
    double shutter:close = %s
    %s
}
"""
AT_4 = """double3 xformOp:translate = (0, 0, 4)
    uniform token[] xformOpOrder = ["xformOp:translate"]"""
MOMENTS = 16


def coverage(n, shift, half):
    """Share of the time in which each of n columns is covered: the quad [-half, half] moves by ± shift.

    The camera sees [-2, 2]. Two edges pass, each uncovers a column in proportion to the time.
    """
    x = ((np.arange(n * 16) + 0.5) / (n * 16) * 4 - 2)[:, None]
    times = np.linspace(-1, 1, 2001)
    return (np.abs(x - shift * times) < half).mean(axis=1).reshape(n, 16).mean(axis=1)


@pytest.mark.parametrize("what", ["transform", "points", "camera"])
def test_coverage_of_a_moving_quad(tmp_path, what, device):
    """A quad that moves while the shutter is open covers a pixel for a share of the time: a trapezium.

    Sixteen moments stand for the time: at a place that an edge passes, the share is wrong by 1/32 at most.
    """
    shift, half, n, iterations = 0.75, 0.5, 32, 64
    small = "point3f[] points = [(-0.5, -9, 0), (0.5, -9, 0), (0.5, 9, 0), (-0.5, 9, 0)]"
    # Speed 1.5 per time code, around 0 at time 5; the shutter is open from 4.5 to 5.5.
    samples = "0: (-7.5, 0, {z}), 10: (7.5, 0, {z})"
    mesh, camera = quad("Q"), CAMERA % (-0.5, 0.5, AT_4)
    if what == "transform":
        mesh = quad("Q", moves(samples.format(z=0)))
    elif what == "points":
        begin, end = (
            f"[({x - 0.5}, -9, 0), ({x + 0.5}, -9, 0), ({x + 0.5}, 9, 0), ({x - 0.5}, 9, 0)]" for x in (-7.5, 7.5)
        )
        mesh = quad("Q", f"point3f[] points.timeSamples = {{ 0: {begin}, 10: {end} }}")
    else:
        camera = CAMERA % (-0.5, 0.5, moves(samples.format(z=4)))
    mesh = mesh.replace(
        "point3f[] points = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]", "" if what == "points" else small
    )
    scene = ir.load_usd(write(tmp_path, camera, mesh), time=5.0)
    assert len(scene.shutter) == MOMENTS
    settings = ir.RenderSettings(width=n, height=n, iterations=iterations, light_paths=1)
    alpha = ir.render(scene, settings, device=device).aov("alpha").mean(axis=0)
    noise = 0.5 / math.sqrt(n * iterations)
    np.testing.assert_allclose(alpha, coverage(n, shift, half), atol=1 / 32 + 4 * noise)
    # The edges' ramps are as wide as the way, and everything is there: total coverage is that of the quad.
    assert alpha.sum() * 4 / n == pytest.approx(2 * half, abs=4 * noise * 4 / math.sqrt(n))
    sharp = ir.render(scene, replace(settings, motion_blur=False), device=device).aov("alpha").mean(axis=0)
    np.testing.assert_allclose(sharp, coverage(n, 0.0, half), atol=4 * noise)


def test_a_varying_light_gives_its_mean(tmp_path):
    """A lamp whose intensity rises from 0 to 2 while the shutter is open illuminates like one of intensity 1."""
    lamp = """def SphereLight "L" {
    float inputs:radius = 0.1
    %s
    double3 xformOp:translate = (0, 0, 2)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
"""
    camera = CAMERA % (0, 1, AT_4)
    settings = ir.RenderSettings(width=8, height=8, iterations=64, light_paths=256, filter=False)
    animated = "float inputs:intensity.timeSamples = { 5: 0, 6: 200 }"
    blurred = ir.load_usd(write(tmp_path, camera, quad("Q"), lamp % animated), time=5.0)
    assert len(blurred.shutter) == MOMENTS and all(s.meshes[0] is blurred.meshes[0] for s in blurred.shutter)
    steady = ir.load_usd(write(tmp_path, camera, quad("Q"), lamp % "float inputs:intensity = 100"), time=5.0)
    # The mean over midpoints of a linear function is its mean; the random numbers differ by nothing but the weights.
    a, b = ir.render(blurred, settings), ir.render(steady, settings)
    error = np.sqrt((b.standard_error() ** 2).sum()) / b.radiance().size * 8  # pixels share their VPLs
    assert abs(a.radiance().mean() - b.radiance().mean()) < 4 * error


def test_no_blur_without_motion_or_shutter(tmp_path):
    """A closed shutter, a static stage, or the stage's own settings give one shutter sample."""
    moving = quad("Q", moves("1: (0, 0, 0), 2: (1, 0, 0)"))
    assert ir.load_usd(write(tmp_path, CAMERA % (0, 0.5, AT_4), moving), motion_blur=False).shutter == ()
    wish = 'def RenderSettings "S" { bool disableMotionBlur = 1\n}\n'
    assert len(ir.load_usd(write(tmp_path, CAMERA % (0, 0.5, AT_4), moving)).shutter) == MOMENTS
    assert ir.load_usd(write(tmp_path, CAMERA % (0, 0.5, AT_4), moving), time="default").shutter == ()
    for parts in (
        (CAMERA % (0, 0, AT_4), moving),
        (CAMERA % (0, 0.5, AT_4), quad("Q")),
        (CAMERA % (0, 0.5, AT_4), moving, wish),
    ):
        assert ir.load_usd(write(tmp_path, *parts)).shutter == ()
    scene = ir.load_usd(write(tmp_path, CAMERA % (1, 0.5, AT_4), moving))
    assert scene.shutter == () and any("/C" in line and "is before shutter:open" in line for line in scene.warnings)


FLIES = moves("0: (0, 0, 0), 10: (20, 0, 0)")
FLYING = "vector3f[] velocities.timeSamples = { 0: [(48, 0, 0), (0, 24, 0)], 10: [(0, 0, 0), (0, 0, 0)] }"
INSTANCER = """def PointInstancer "P" {
    int[] protoIndices = [0, 0]
    point3f[] positions.timeSamples = { 0: [(0, 0, 0), (5, 0, 0)], 10: [(0, 0, 0), (1, 1, 1)] }
    rel prototypes = </P/Q>
    %s
    %s
}
"""
ASSET = f'class Xform "Asset" {{\n {quad("Q")} }}\n'
NATIVE = """def Xform "%s" (
    instanceable = true
    references = </Asset>
) { %s
}
"""
MOVING = {
    "mesh": quad("Q", FLIES),
    "child": xform(FLIES, quad("Q", moves("0: (0, 1, 0)")) + quad("R")),
    "native instance": ASSET + NATIVE % ("N", FLIES),
    "native instances": ASSET + xform(FLIES, NATIVE % ("N", "") + NATIVE % ("O", moves("0: (0, 0, 3)"))),
    "child of native instances": ASSET.replace("]\n    \n}", f"]\n    {FLIES}\n}}")
    + NATIVE % ("N", "")
    + NATIVE % ("O", moves("0: (0, 0, 3)")),
    "point instances": INSTANCER % (FLYING, quad("Q")),
    "nested instances": INSTANCER.replace('"P"', '"O"').replace("</P/Q>", "</O/P>")
    % ("", (INSTANCER % (FLYING, quad("Q"))).replace("</P/Q>", "</O/P/Q>")),
}


@pytest.mark.parametrize("what", MOVING)
def test_what_moves_rigidly_is_stored_once(tmp_path, what, monkeypatch):
    """At every shutter sample all is where it is when written out, and the meshes are those of the first sample."""
    file = write(tmp_path, CAMERA % (0, 1, AT_4), MOVING[what])
    flat = ir.load_usd(file, time=2.0).shutter
    monkeypatch.setattr("warp_ir.usd.geometry.prototypes.MAX_FLATTENED_TRIANGLES", 0)
    stored = ir.load_usd(file, time=2.0).shutter
    assert len(flat) == len(stored) == MOMENTS
    for one, other in zip(flat, stored, strict=True):
        assert one.instances == () and len(other.instances) == (2 if what == "child" else 1)
        corners = [
            np.concatenate([mesh.points[mesh.triangles].reshape(-1, 9) for mesh in scene.meshes])
            for scene in (one, other.flat())
        ]
        rows = [found[np.lexsort(found.round(6).T)] for found in corners]
        np.testing.assert_allclose(rows[1], rows[0], atol=1e-12)
        # A child that moves in a native prototype, or an instance in a prototype, is part of the mesh.
        if what not in ("child of native instances", "nested instances"):
            assert all(mesh is first for mesh, first in zip(other.meshes, stored[0].meshes, strict=True))


def test_moving_instances_take_the_memory_of_one_prototype(tmp_path):
    """What counts is the triangles of all shutter samples: 100 spheres, a matrix each and for each of 16 samples."""
    count = 100
    places = [(3.0 * k, 0.0, 0.0) for k in range(count)]
    more = f"""
    int[] protoIndices = {[0] * count}
    point3f[] positions.timeSamples = {{ 0: {places}, 10: {places} }}
    vector3f[] velocities.timeSamples = {{ 0: {[(0.0, 24.0, 0.0)] * count}, 10: {places} }}
    rel prototypes = </P/S>
    def Sphere "S" {{
    }}
"""
    file = write(tmp_path, CAMERA % (-0.5, 0.5, AT_4), f'def PointInstancer "P" {{{more}}}')
    scene = ir.load_usd(file, time=2.0)
    (mesh,) = scene.shutter[0].meshes
    assert count * len(mesh.triangles) < MAX_FLATTENED_TRIANGLES  # of one sample, and of all sixteen:
    assert MOMENTS * count * len(mesh.triangles) > MAX_FLATTENED_TRIANGLES
    assert len(ir.load_usd(file, time=2.0, motion_blur=False).instances) == 0
    for k, sample in enumerate(scene.shutter):
        assert sample.meshes[0] is mesh and sample.triangle_count == len(mesh.triangles)
        (group,) = sample.instances
        # One unit per time code, 24 of which are a second; samples are at the midpoints of parts of the interval.
        np.testing.assert_allclose(group.matrices[:, 1, 3], 2.0 - 0.5 + (k + 0.5) / MOMENTS, atol=1e-12)
    uploaded = upload_scenes(scene.shutter, Launcher("cpu"))
    assert {each.data.triangle_count for each in uploaded} == {len(mesh.triangles)}
    assert {each.data.instance_count for each in uploaded} == {count}


def test_stored_instances_blur_as_if_written_out(tmp_path, monkeypatch):
    """Both trace the same paths, up to rounding: the pictures agree but for pixels where a ray passes an edge."""
    lamp = 'def SphereLight "L" { float inputs:intensity = 30\n double3 xformOp:translate = (0, 2, 3)\n'
    lamp += 'uniform token[] xformOpOrder = ["xformOp:translate"]\n}\n'
    slow = MOVING["point instances"].replace("(48, 0, 0), (0, 24, 0)", "(12, 0, 0), (-24, 24, 0)")
    file = write(tmp_path, CAMERA % (-0.5, 0.5, AT_4), lamp, slow, quad("Wall", moves("0: (0, 0, -1)")))
    settings = ir.RenderSettings(width=32, height=32, iterations=32, light_paths=64)
    pictures = []
    for limit in (2**20, 0):
        monkeypatch.setattr("warp_ir.usd.geometry.prototypes.MAX_FLATTENED_TRIANGLES", limit)
        scene = ir.load_usd(file, time=1.0)
        assert bool(scene.shutter[0].instances) == (limit == 0)
        pictures.append(ir.render(scene, settings).radiance())
    different = np.abs(pictures[0] - pictures[1]).max(axis=-1) > 1e-3 * pictures[0].mean()
    assert different.mean() < 0.01 and pictures[1].mean() == pytest.approx(pictures[0].mean(), rel=1e-3)


def test_moving_triangles_limit_the_shutter_samples(tmp_path, monkeypatch):
    """Moving triangles are stored once per shutter sample, and limit their number; static ones do not."""
    camera, moving = CAMERA % (0, 0.5, AT_4), moves("1: (0, 0, 0), 2: (1, 0, 0)")
    still = "".join(quad(f"S{k}") for k in range(20))
    few = write(tmp_path, camera, quad("Q", moving), still)
    monkeypatch.setattr("warp_ir.usd.load._MAX_SHUTTER_TRIANGLES", 2 * MOMENTS)
    scene = ir.load_usd(few)
    assert len(scene.shutter) == MOMENTS and not any("shutter samples" in line for line in scene.warnings)
    scene = ir.load_usd(write(tmp_path, camera, quad("Q", moving), quad("R", moving), still))
    assert len(scene.shutter) == MOMENTS // 2 and any(
        "/C" in line and "8 shutter samples" in line for line in scene.warnings
    )


def test_blur_is_not_filtered_away():
    """With and without the filter a blurred picture has the same mean."""
    scene = ir.load_usd(TURNTABLE, time=5.0)
    reader = StageReader(TURNTABLE)
    scene = replace(scene, shutter=tuple(reader.read(5.0 + k / 4) for k in range(4)))
    settings = ir.RenderSettings(width=48, iterations=16, light_paths=128)
    filtered, plain = (ir.render(scene, replace(settings, filter=f)).radiance().mean() for f in (True, False))
    assert filtered == pytest.approx(plain, rel=0.01)


def test_an_odd_number_of_shutter_samples_is_an_error():
    """The number must be a power of two, for iterations to be stratified over the samples."""
    scene = ir.load_usd(TURNTABLE)
    with pytest.raises(ir.InputError, match="power of two"):
        ir.render(replace(scene, shutter=(scene,) * 3), ir.RenderSettings(width=4, iterations=1))
