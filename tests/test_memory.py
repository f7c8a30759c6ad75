"""The memory estimates of a scene and of a pixel, against the arrays that are allocated."""

import gc
import json
import weakref
from dataclasses import replace

import numpy as np
import pytest

import warp_ir as ir
from tests.physics.closed_form import placed
from tests.physics.scenes import DOWN, everything, lamp_profile
from warp_ir.cli import main
from warp_ir.device.launcher import Launcher
from warp_ir.device_scene import upload_scenes
from warp_ir.memory import pixel_bytes, scene_bytes
from warp_ir.procedural import cornell_box, furnace, mesh, sphere
from warp_ir.renderer import Renderer
from warp_ir.scene import LightKind, Shaping


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
