"""The memory estimates of a scene and of a pixel, against the arrays that are allocated."""

import gc
import json
import math
import os
import re
import resource
import subprocess
import sys
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom

import warp_ir as ir
from tests.physics.closed_form import placed
from tests.physics.scenes import DOWN, everything, lamp_profile
from warp_ir import memory
from warp_ir.cli import main
from warp_ir.device.launcher import Launcher
from warp_ir.device_scene import upload_scenes
from warp_ir.memory import pixel_bytes, scene_bytes
from warp_ir.procedural import cornell_box, furnace, mesh, sphere
from warp_ir.renderer import Renderer
from warp_ir.scene import LightKind, Shaping

ROOM = Path(__file__).parent.parent / "scenes_usd" / "cornell_box.usda"


class Counting(Launcher):
    """A launcher that records every array it allocates."""

    def __init__(self, device="cpu", threads=None):
        super().__init__(device, threads)
        self._allocated = []

    def _record_array(self, array):
        self._allocated.append(weakref.ref(array))
        return array

    def empty(self, *args):
        return self._record_array(super().empty(*args))

    def zeros(self, *args):
        return self._record_array(super().zeros(*args))

    def array(self, *args):
        return self._record_array(super().array(*args))

    def alive(self):
        gc.collect()
        return sum(array.capacity for reference in self._allocated if (array := reference()) is not None)


def textured():
    rng = np.random.default_rng(0)
    points, triangles = sphere(1.0, level=4)
    ball = mesh("ball", points, triangles)
    corners = points[triangles].astype(np.float32)
    uvs = {"st": corners[..., :2].copy(), "unused": corners[..., :2].copy()}
    ball = ir.Mesh("ball", ball.points, ball.triangles, ball.material, normals=corners, uvs=uvs)
    images = [ir.Texture(f"t{k}", rng.random((64 << k, 100, 3)).astype(np.float32)) for k in range(3)]
    materials = tuple(ir.Material(t.name, albedo_texture=t, emission_texture=t) for t in images)
    return ir.Scene((ball,), materials)


def instanced(*, emission=0.0, count=3000):
    points, triangles = sphere(1.0, level=3)
    matrices = np.tile(np.eye(4), (count, 1, 1))
    matrices[:, 0, 3] = 3.0 * np.arange(count)
    balls = [mesh(name, points, triangles) for name in ("a", "b")]
    other = matrices + np.array([[1.0], [1.0], [1.0], [0.0]])
    groups = tuple(ir.Instances(m.name, (k,), x) for k, (m, x) in enumerate(zip(balls, (matrices, other), strict=True)))
    return ir.Scene(tuple(balls), (ir.Material("m", (0.5,) * 3, (emission,) * 3),), instances=groups)


def lamps():
    spot = Shaping(cone_angle=20.0)
    photometry = Shaping(profile=lamp_profile(720, 360))
    sky = np.ones((256, 512, 3), np.float32)
    lights = [ir.Light("l", LightKind.DISK, (1.0,) * 3, placed(DOWN, (k, 2, 0)), shaping=spot) for k in range(20)]
    lights += [
        ir.Light("p", LightKind.POINT, (1.0,) * 3, placed(DOWN, (0, k, 0)), shaping=photometry) for k in range(2)
    ]
    return ir.Scene(
        cornell_box().meshes, cornell_box().materials, (*lights, ir.Light("s", LightKind.DOME, (1,) * 3, texture=sky))
    )


def moving():
    points, triangles = sphere(1.0, level=4)
    still = mesh("still", points, triangles)
    samples = tuple(ir.Scene((still, mesh("moves", points + k, triangles))) for k in range(4))
    return ir.Scene(samples[0].meshes, shutter=samples)


def moving_under_a_dome():
    scene, sky = moving(), ir.Light("s", LightKind.DOME, (1,) * 3, texture=np.ones((256, 512, 3), np.float32))
    return replace(scene, lights=(sky,), shutter=tuple(replace(sample, lights=(sky,)) for sample in scene.shutter))


SCENES = {
    "cornell box": cornell_box,
    "furnace": lambda: furnace(level=5),
    "many lights": lambda: ir.Scene(
        lights=tuple(ir.Light("l", LightKind.SPHERE, (1.0,) * 3, placed(np.eye(3), (k, 0, 0))) for k in range(2000))
    ),
    "textures": textured,
    "instances": instanced,
    "instances that emit": lambda: instanced(emission=1.0, count=20),
    "lamps": lamps,
    "everything": everything,
    "shutter samples": moving,
    "shutter samples under a dome": moving_under_a_dome,
}


@pytest.mark.extended
@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES.keys())
def test_the_estimate_is_good_to_a_fifth(scene):
    """The estimate equals the bytes of all arrays of the uploaded scene within 20 %."""
    scene = scene()
    launcher = Counting()
    uploaded = upload_scenes(scene.shutter or (scene,), launcher)
    assert sum(scene_bytes(scene).values()) == pytest.approx(launcher.alive(), rel=0.2)
    del uploaded


def normal_mapped():
    normals = ir.Texture("n", np.full((4, 4, 3), (0.0, 0.0, 1.0)))
    return ir.Scene(furnace(level=1).meshes, (ir.Material("m", normal_texture=normals),))


def smooth():
    (ball,) = furnace(level=1).meshes
    return ir.Scene((replace(ball, normals=ball.points[ball.triangles].astype(np.float32)),))


def through_a_lens():
    scene = lamps()
    return replace(scene, camera=replace(scene.camera, lens_radius=0.1, focus_distance=1.0))


@pytest.mark.extended
@pytest.mark.parametrize(
    "scene",
    [cornell_box(), lamps(), normal_mapped(), smooth(), through_a_lens(), moving()],
    ids=["visible emission", "lamps", "normal map", "normals", "lens", "moving"],
)
@pytest.mark.parametrize("settings", [{}, {"filter": False}, {"estimator": "path"}, {"visible_lights": True}], ids=str)
def test_bytes_per_pixel(scene, settings, monkeypatch):
    """The estimate is the growth of all arrays per added pixel, after two iterations and a resolved picture."""
    monkeypatch.setattr("warp_ir.renderer.Launcher", Counting)
    alive = []
    for width in (16, 48):
        options = ir.RenderSettings(width=width, height=width, light_paths=16, **settings)
        renderer = Renderer(scene, options, guiding=None)  # which may trace more light paths for more pixels
        film = renderer.new_film()
        for iteration in range(2):
            renderer.add_iteration(film, iteration)
        picture = film.radiance()
        film.error()
        alive.append(renderer.launcher.alive() + picture.nbytes)
    estimate = pixel_bytes(scene, renderer.settings, guided=False)
    assert (alive[1] - alive[0]) / (48**2 - 16**2) == pytest.approx(estimate, rel=0.01)


LAMP = """#usda 1.0
def Sphere "S" (prepend apiSchemas = ["LightAPI", "ShapingAPI", "ShadowAPI"]) {
    float inputs:shaping:cone:angle = 20
    bool inputs:shadow:enable = false
    rel collection:lightLink:excludes = [</T>]
}
def Sphere "T" {
}
def Sphere "Hidden" {
    token visibility = "invisible"
}
"""


def test_info_reports_what_is_skipped_and_guessed(tmp_path, capsys):
    """The table and --json report defaults for what the stage lacks, skipped prims, and the modifiers of lights."""
    file = tmp_path / "a.usda"
    file.write_text(LAMP)
    assert main(["info", str(file), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["skipped"] == {"prims_invisible": 1} and list(facts["guessed"]) == ["camera"]
    (lamp,) = facts["mesh_lights"]
    assert lamp["name"] == "/S" and lamp["shaping"]["cone_angle"] == 20.0
    assert lamp["unlit_meshes"] == 1 and not lamp["shadows"] and lamp["radiance"] == [1.0, 1.0, 1.0]
    assert facts["cost"]["scene_bytes"] == sum(facts["cost"]["bytes"].values())
    assert main(["info", str(file)]) == 0
    table = capsys.readouterr().out
    assert "1 prims invisible" in table and "camera: one that frames" in table
    assert "shaped, no shadows, does not light 1 meshes  /S" in table
    file.write_text('#usda 1.0\ndef Sphere "T" {\n}\ndef Camera "A" {\n}\ndef Camera "B" {\n}\n')
    assert main(["info", str(file), "--json"]) == 0
    guessed = json.loads(capsys.readouterr().out)["guessed"]
    assert guessed["camera"] == "the first of 2" and "white dome" in guessed["light"]


# ---- what there is ---------------------------------------------------------------------------------------


def test_what_is_available_is_no_more_than_is_free(monkeypatch):
    """It is what /proc/meminfo says, and less under `ulimit -v`, by what the process has mapped already."""
    free = memory.available_memory()
    assert 0 < free <= os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (mapped + (1 << 28), limits[1]))
    try:
        left = memory.available_memory()
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
    assert 0.8 * 2**28 < left <= 2**28


@pytest.mark.parametrize("version", [1, 2])
def test_control_groups_limit_the_memory(tmp_path, monkeypatch, version):
    """The least that a group or one around it leaves counts; copies of files are free; containers have own roots."""
    root = tmp_path / "memory" if version == 1 else tmp_path
    limit, usage = memory._CGROUP_FILES[version == 1]
    inactive = "total_inactive_file" if version == 1 else "inactive_file"
    groups = ("", "max", 0), ("batch", 5000, 3000), ("batch/job", 4000, 1500), ("batch/job/deep", "max", 7)
    for path, bound, used in groups:
        group = root / path
        group.mkdir(parents=True, exist_ok=True)
        (group / limit).write_text(str(2**63 - 4096 if bound == "max" and version == 1 else bound) + "\n")
        (group / usage).write_text(f"{used}\n")
        (group / "memory.stat").write_text(f"anon 1\n{inactive} 200\n")
    own = tmp_path / "own"
    monkeypatch.setattr(memory, "_CGROUPS", tmp_path)
    monkeypatch.setattr(memory, "_OWN_CGROUPS", own)
    prefix = "4:cpu:/other\n3:memory:" if version == 1 else "0::"
    inside = dict.fromkeys(("/batch/job/deep", "/batch/job", "/batch"), 2200)
    for path, left in (inside | dict.fromkeys(("/", "/elsewhere"), math.inf)).items():
        own.write_text(f"{prefix}{path}\n")
        assert memory._left_by_cgroups() == left, path
        if left < math.inf:
            assert memory.available_memory() == left
    (root / "batch" / "job" / limit).write_text("1000\n")  # less than is used
    own.write_text(f"{prefix}/batch/job\n")
    assert memory.available_memory() == 0.0
    (root / limit).write_text("600\n")  # in a container
    (root / usage).write_text("500\n")
    own.write_text(f"{prefix}/of/the/machine\n")
    assert memory.available_memory() == 300


@pytest.mark.extended
def test_a_real_control_group(tmp_path):
    """A process in a group of 3 GB is told so; with 4096 x 4096 pixels it ends in one line with the numbers."""
    group = Path("/sys/fs/cgroup/memory/warp_ir_test")
    try:
        group.mkdir()
        (group / "memory.limit_in_bytes").write_text(str(3 * 2**30))
    except OSError:
        pytest.skip("no control groups of version 1, or not root")
    enter = "import sys; from pathlib import Path; Path(sys.argv.pop(1)).write_text('0'); "
    python = enter + "from warp_ir.cli import command; command()"
    words = ["render", str(ROOM), str(tmp_path / "a.npy"), "--res", "4096", "4096", "--iterations", "1"]
    try:
        process = [sys.executable, "-c", python, str(group / "cgroup.procs"), *words]
        done = subprocess.run(process, capture_output=True, text=True)
    finally:
        group.rmdir()
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert re.search(r"4096 x 4096 pixels need about 4\.. GiB, cpu has [12]\.. GiB", done.stderr)


def test_what_is_too_large_is_refused_with_the_numbers(tmp_path, monkeypatch):
    """Faces and instances, before they are expanded; what is small is not looked at."""
    faces, instances = tmp_path / "faces.usda", tmp_path / "instances.usda"
    stage = Usd.Stage.CreateNew(str(faces))
    mesh = UsdGeom.Mesh.Define(stage, "/M")
    count = 300_000
    mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    mesh.CreateFaceVertexCountsAttr([3] * count)
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2] * count)
    stage.Save()
    stage = Usd.Stage.CreateNew(str(instances))
    UsdGeom.Cube.Define(stage, "/C")
    instancer = UsdGeom.PointInstancer.Define(stage, "/P")
    instancer.CreatePrototypesRel().AddTarget("/C")
    instancer.CreatePositionsAttr([(0, 0, 0)])
    instancer.CreateProtoIndicesAttr([0] * 200_000)
    stage.Save()
    monkeypatch.setattr(memory, "available_memory", lambda: 70_000_000.0)
    with pytest.raises(ir.InputError, match=r"/M: 300000 faces need about 0\.1 GiB of memory, 0\.1 GiB are available"):
        ir.load_usd(faces)
    with pytest.raises(ir.InputError, match=r"/P: 200000 instances need about 0\.1 GiB of memory, 0\.1 GiB are"):
        ir.load_usd(instances)
    memory.require_memory(60_000_000, "what is small is not looked at: it would")


def test_a_sky_that_does_not_fit_is_refused(monkeypatch):
    """What the upload of 2²⁰ texels takes at its peak is asked for before anything is allocated."""
    monkeypatch.setattr(Launcher, "memory", lambda self: 2.0**25)
    sky = ir.Light("sky", LightKind.DOME, (1.0,) * 3, texture=np.ones((512, 2048, 3), np.float32))
    with pytest.raises(ir.InputError, match=r"1048576 texels of lights need about 0\.1 GiB, cpu has 0\.0 GiB"):
        upload_scenes((ir.Scene(lights=(sky,)),), Launcher("cpu"))


LIMITED = ["render", str(ROOM), "a.npy", "--iterations", "1", "--light-paths", "64"]


@pytest.mark.extended
@pytest.mark.parametrize(
    ("limit", "words", "said"),
    [
        (1_000_000, LIMITED, "ulimit -v: 1.0 GiB of address space are too few"),
        (3_000_000, [*LIMITED, "--res", "4096", "4096"], "4096 x 4096 pixels need about 4"),
    ],
)
def test_ulimit_is_one_line(tmp_path, limit, words, said):
    """A process of limited address space refuses what does not fit, and does not start with less than it needs."""
    command = ["sh", "-c", f'ulimit -v {limit}; exec "$@"', "sh", sys.executable, "-m", "warp_ir", *words]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=env)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and said in done.stderr, done.stderr
    assert os.listdir(tmp_path) == []
