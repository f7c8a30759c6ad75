"""The committed test scenes and reference pictures are what their scripts say they are."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from pxr import Usd, UsdGeom, UsdLux, UsdShade

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "scenes_usd"
REFERENCES = ROOT / "benchmarks" / "references"


def _script(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


sys.path.insert(0, str(ROOT / "scripts"))  # where Python finds what a script imports
make_scenes = _script(ROOT / "scripts" / "make_scenes.py")
make_references = _script(ROOT / "benchmarks" / "make_references.py")
NAMES = [make.__name__ for make in make_scenes.SCENES]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    make_scenes.write_scenes(folder)
    return folder


def _open(name):
    return Usd.Stage.Open(str(FOLDER / f"{name}.usda"))


def _meshes(stage):
    prims = stage.Traverse(Usd.TraverseInstanceProxies())
    return [UsdGeom.Mesh(prim) for prim in prims if prim.IsA(UsdGeom.Mesh)]


def _world_points(mesh):
    matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(mesh.GetPrim()))
    return np.array(mesh.GetPointsAttr().Get(), dtype=np.float64) @ matrix[:3, :3] + matrix[3, :3]


@pytest.mark.extended
def test_committed_files_are_what_the_script_writes(written):
    """Byte for byte; textures pixel for pixel, since PNG compressors differ."""
    committed = {path.relative_to(FOLDER) for path in FOLDER.rglob("*") if path.is_file()}
    assert committed == {path.relative_to(written) for path in written.rglob("*") if path.is_file()}
    for path in committed:
        if path.suffix == ".png":
            pictures = (oiio.ImageBuf(str(root / path)).get_pixels(oiio.UINT8) for root in (written, FOLDER))
            np.testing.assert_array_equal(*pictures)
        else:
            assert (written / path).read_bytes() == (FOLDER / path).read_bytes(), path


def test_files_are_small():
    sizes = {path.name: path.stat().st_size for path in FOLDER.rglob("*") if path.is_file()}
    assert max(sizes.values()) < 1_000_000
    assert sum(size for name, size in sizes.items() if name.endswith(".png")) < 200_000


@pytest.mark.parametrize("name", NAMES)
def test_scene_is_complete(name):
    """Metadata, a camera, something that emits, and a bound material and a valid topology on every mesh."""
    stage = _open(name)
    assert stage.GetDefaultPrim() and stage.HasAuthoredMetadata("metersPerUnit")
    assert stage.HasAuthoredMetadata("upAxis")
    assert stage.GetRootLayer().documentation
    assert stage.GetRootLayer().customLayerData["license"] == "CC0-1.0"
    assert stage.GetPrimAtPath("/World/main_cam").IsA(UsdGeom.Camera)
    lights = [prim for prim in stage.Traverse() if prim.HasAPI(UsdLux.LightAPI)]
    assert lights or name.startswith("furnace")
    for mesh in _meshes(stage):
        counts, indices = mesh.GetFaceVertexCountsAttr().Get(), mesh.GetFaceVertexIndicesAttr().Get()
        valid, reason = UsdGeom.Mesh.ValidateTopology(indices, counts, len(mesh.GetPointsAttr().Get()))
        assert valid, f"{mesh.GetPath()}: {reason}"
        material, _ = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()
        assert material, mesh.GetPath()


def test_cornell_box_has_the_published_vertices():
    """https://www.graphics.cornell.edu/online/box/data.html."""
    published = {
        "Floor": [(552.8, 0, 0), (0, 0, 0), (0, 0, 559.2), (549.6, 0, 559.2)],
        "Ceiling": [(556, 548.8, 0), (556, 548.8, 559.2), (0, 548.8, 559.2), (0, 548.8, 0)],
        "LeftWall": [(552.8, 0, 0), (549.6, 0, 559.2), (556, 548.8, 559.2), (556, 548.8, 0)],
        "ShortBlock": [(130, 165, 65), (82, 165, 225), (240, 165, 272), (290, 165, 114)],
        "TallBlock": [(423, 330, 247), (265, 330, 296), (314, 330, 456), (472, 330, 406)],
    }
    stage = _open("cornell_box")
    for name, corners in published.items():
        points = UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/Box/{name}")).GetPointsAttr().Get()
        np.testing.assert_allclose(np.array(points)[:4], corners, rtol=1e-6)
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/World/main_cam")).GetCamera(Usd.TimeCode.Default())
    np.testing.assert_allclose(camera.frustum.position, (278, 273, -800))
    np.testing.assert_allclose(camera.frustum.ComputeViewDirection(), (0, 0, 1), atol=1e-12)
    assert camera.horizontalAperture == camera.verticalAperture == 25.0 and camera.focalLength == 35.0


@pytest.mark.parametrize("name", ["furnace_sphere", "furnace_cube"])
def test_furnaces_are_closed_and_face_inward(name):
    """The signed volume of an inward-facing closed surface is negative, and every edge has two faces."""
    stage = _open(name)
    (mesh,) = _meshes(stage)
    points, indices = _world_points(mesh), np.array(mesh.GetFaceVertexIndicesAttr().Get())
    faces = np.split(indices, np.cumsum(mesh.GetFaceVertexCountsAttr().Get())[:-1])
    edges = [edge for face in faces for edge in zip(face.tolist(), np.roll(face, -1).tolist(), strict=True)]
    assert len(set(edges)) == len(edges) and {(b, a) for a, b in edges} == set(edges)
    fans = np.array([(f[0], f[k], f[k + 1]) for f in faces for k in range(1, len(f) - 1)])
    volume = np.linalg.det(points[fans]).sum() / 6.0
    assert volume == pytest.approx(-8.0 if name == "furnace_cube" else -4.0 * np.pi / 3.0, rel=5e-3)


def test_corridor_light_cannot_be_seen_nor_light_what_the_camera_sees():
    """The lamp shines along +x from x = 3; sight past the inner corner ends before that."""
    stage = _open("corridor")
    lamp = UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetPrimAtPath("/World/Lights/Lamp"))
    np.testing.assert_allclose(-np.array(lamp)[2, :3], (1, 0, 0), atol=1e-6)
    eye = UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetPrimAtPath("/World/main_cam"))
    x, _, z = eye.ExtractTranslation()
    farthest = x + (2.0 - x) * (8.0 - z) / (6.0 - z)  # over the inner corner (2, 6) onto the wall z = 8
    assert farthest < lamp.ExtractTranslation()[0]


def test_crowded_room_is_crowded_by_instances():
    stage = _open("crowded_room")
    triangles = sum(int(np.sum(np.array(m.GetFaceVertexCountsAttr().Get()) - 2)) for m in _meshes(stage))
    assert triangles >= 100_000
    assert len(stage.GetPrototypes()) == 4
    assert sum(prim.HasAPI(UsdLux.LightAPI) for prim in stage.Traverse()) == 2


def test_thousand_lights():
    stage = _open("thousand_lights")
    lights = [UsdLux.LightAPI(prim) for prim in stage.Traverse() if prim.HasAPI(UsdLux.LightAPI)]
    assert len(lights) == 1000
    assert len({tuple(light.GetColorAttr().Get()) for light in lights}) > 500


def test_every_light_type_is_there():
    stage = _open("light_types")
    kinds = {prim.GetTypeName() for prim in stage.Traverse() if prim.HasAPI(UsdLux.LightAPI)}
    assert kinds == {f"{kind}Light" for kind in ("Rect", "Disk", "Sphere", "Cylinder", "Distant", "Dome")}


def test_thin_walls_are_closed_thin_and_dark_inside():
    """Six walls reach past each other's planes; slabs are 1e-6 of the box thick; no light is inside."""
    stage = _open("thin_walls")
    for axis, letter in enumerate("XYZ"):
        sheet, slab = (
            _world_points(UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/DarkBox/{kind}{letter}")))
            for kind in ("sheet", "slab")
        )
        assert np.ptp(sheet[:, axis]) == 0.0 and sheet[0, axis] == -1.0
        assert 0.0 < np.ptp(slab[:, axis]) < 2.5e-6 and slab[:, axis].min() == 1.0
        for wall in (sheet, slab):
            across = np.delete(wall, axis, axis=1)
            assert across.min() < -1.0 and across.max() > 1.000002
    for prim in stage.Traverse():
        if prim.HasAPI(UsdLux.LightAPI):
            position = UsdGeom.XformCache().GetLocalToWorldTransform(prim).ExtractTranslation()
            radius = prim.GetAttribute("inputs:radius").Get() or 0.0
            assert max(abs(np.array(position))) - radius > 1.0005


def test_texture_fallbacks_are_the_textures_means():
    """So that a reader without textures shows the same room, less its patterns."""
    stage, found = _open("two_rooms"), 0
    for prim in stage.Traverse():
        shader = UsdShade.Shader(prim)
        if shader and shader.GetIdAttr().Get() == "UsdUVTexture":
            picture = FOLDER / shader.GetInput("file").Get().path
            srgb = oiio.ImageBuf(str(picture)).get_pixels(oiio.FLOAT)
            linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
            fallback = shader.GetInput("fallback").Get()
            np.testing.assert_allclose(np.array(fallback)[:3], linear.mean(axis=(0, 1)), atol=1e-3)
            found += 1
    assert found == 3


def test_turntable_turns_once_in_24_frames():
    stage = _open("turntable")
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (1, 24)
    (op,) = UsdGeom.Xformable(stage.GetPrimAtPath("/World/Turntable")).GetOrderedXformOps()
    assert [op.Get(frame) for frame in op.GetTimeSamples()] == [15.0 * k for k in range(24)]


@pytest.mark.parametrize("name", make_references.PICTURES)
def test_reference_belongs_to_the_scene(name):
    """Made from the scene file as it is, its size as listed, its floor what its standard error says."""
    stem, width, height, _ = make_references.PICTURES[name]
    with np.load(REFERENCES / f"{name}.npz") as stored:
        mean, standard_error = stored["mean"], stored["standard_error"]
        assert stored["scene_sha256"] == make_references.digest(FOLDER / f"{stem}.usda")
        floor = make_references.relative_mse_floor(mean, standard_error)
        assert floor == pytest.approx(float(stored["floor"]), rel=1e-3)
    assert mean.shape == standard_error.shape == (height, width, 3)
    assert np.isfinite(mean).all() and np.isfinite(standard_error).all()
    assert floor < 2e-3


def test_furnace_reference_is_two():
    """Le / (1 − ρ) = 2: the other renderer, and our translation for it, agree with the closed form."""
    with np.load(REFERENCES / "furnace_cube.npz") as stored:
        mean, standard_error = stored["mean"], stored["standard_error"]
    # All channels of a pixel share their paths, so a third of the values are independent.
    sigma = np.sqrt(np.mean(standard_error**2) / (mean.size / 3))
    assert abs(mean.mean() - 2.0) < 4.0 * sigma


def test_references_are_small():
    assert sum(path.stat().st_size for path in REFERENCES.iterdir()) < 2_000_000
