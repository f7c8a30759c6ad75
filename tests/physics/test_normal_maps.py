"""Surfaces whose normals come from an image, under lights whose irradiance is known in closed form."""

import dataclasses

import numpy as np
import pytest

import warp_ir as ir
from tests.physics.closed_form import assert_mean, placed, render
from tests.physics.scenes import ball, towards
from warp_ir.estimators import ESTIMATORS
from warp_ir.procedural import cornell_box, quad
from warp_ir.scene import Instances, LightKind, Texture

pytestmark = pytest.mark.extended

ALBEDO = 0.5
TEXEL = np.array([0.75, -0.5, 1.25])  # exact in the halves that textures are kept in
TILT = TEXEL / np.linalg.norm(TEXEL)
SUN = np.array([0.3, 0.9, 0.2]) / np.linalg.norm([0.3, 0.9, 0.2])


def one_texel(normal):
    return Texture("n", np.array(normal, np.float64).reshape(1, 1, 3))


def floor(uv_from_xz, below=False):
    """The square |x|, |z| < 1 at y = 0, front up, texture coordinates linear in x and z, seen from above or below."""
    mesh = quad("floor", [(-1, 0, 1), (1, 0, 1), (1, 0, -1), (-1, 0, -1)])
    corners = mesh.points[mesh.triangles][..., [0, 2]]
    uvs = (corners @ np.array(uv_from_xz, float).T).astype(np.float32)
    eye = (0, -4, 0.01) if below else (0, 4, 0.01)
    return dataclasses.replace(mesh, uvs={"st": uvs}), ir.Camera.look_at(eye, (0, 0, 0), fov=10.0)


def lit(mesh, camera, texture, light, **more):
    material = ir.Material("bumpy", (ALBEDO,) * 3, normal_texture=texture)
    return ir.Scene((mesh,), (material,), (light,), camera, **more)


def sun(direction=SUN):
    return ir.Light("sun", LightKind.DISTANT, (np.pi,) * 3, towards(direction), angle=0.0)


LAYOUTS = {
    "upright": ([[1, 0], [0, -1]], [1, 0, 0], [0, 0, -1]),
    "turned": ([[0, 1], [1, 0]], [0, 0, 1], [1, 0, 0]),
    "mirrored": ([[-1, 0], [0, -1]], [-1, 0, 0], [0, 0, -1]),
    "stretched": ([[7, 0], [0, -0.1]], [1, 0, 0], [0, 0, -1]),
}
"""How u and v follow from x and z, and where they grow."""


@pytest.mark.parametrize("layout", LAYOUTS)
def test_one_texel_tilts_a_floor(layout, device):
    """Under a sun the radiance is ρ/π E (m·ω), m being the texel's normal between the directions of u and v."""
    matrix, along_u, along_v = LAYOUTS[layout]
    mesh, camera = floor(matrix)
    normal = TILT @ np.array([along_u, along_v, [0, 1, 0]], float)
    for estimator in ESTIMATORS:
        film = render(lit(mesh, camera, one_texel(TEXEL), sun()), estimator, device, iterations=1, max_bounces=0)
        assert film.aov("normal") == pytest.approx(np.broadcast_to(normal, (8, 8, 3)), abs=1e-5)
        assert film.radiance() == pytest.approx(ALBEDO * (normal @ SUN), abs=1e-5)


def test_seen_from_behind(device):
    """The back of a tilted surface is the same surface: its normal is the opposite."""
    mesh, camera = floor(LAYOUTS["upright"][0], below=True)
    normal = -(TILT @ np.array([*LAYOUTS["upright"][1:], [0, 1, 0]], float))
    light = sun(-SUN)
    film = render(lit(mesh, camera, one_texel(TEXEL), light), "path", device, iterations=1, max_bounces=0)
    assert film.radiance() == pytest.approx(ALBEDO * (normal @ -SUN), abs=1e-5)


@pytest.mark.parametrize("linear", [np.diag([3.0, 1.0, 0.5]), np.diag([-1.0, 1.0, 1.0])], ids=["scaled", "mirrored"])
def test_instances(linear, device):
    """An instance is lit as the mesh that is placed as it is: u grows elsewhere if it is mirrored."""
    mesh, camera = floor(LAYOUTS["upright"][0])
    instances = (Instances("i", (0,), placed(linear, (0, 0, 0))[None]),)
    along_u = np.sign(linear[0, 0]) * np.array([1, 0, 0])
    normal = TILT @ np.array([along_u, [0, 0, -1], [0, 1, 0]], float)
    scene = lit(mesh, camera, one_texel(TEXEL), sun(), instances=instances)
    film = render(scene, "path", device, iterations=1, max_bounces=0)
    assert film.radiance() == pytest.approx(ALBEDO * (normal @ SUN), abs=1e-5)


@pytest.mark.parametrize("linear", [None, np.diag([3.0, 1.0, 0.5]), np.diag([-1.0, 1.0, 1.0])])
def test_given_tangents_count(linear, device):
    """Tangents that a mesh brings are where u grows, projected onto the surface; v keeps its side."""
    mesh, camera = floor(LAYOUTS["upright"][0])
    tangents = np.broadcast_to(np.float32([1.0, 0.7, -1.0]), (len(mesh.triangles), 3, 3)).copy()
    mesh = dataclasses.replace(mesh, tangents=tangents)
    instances = () if linear is None else (Instances("i", (0,), placed(linear, (0, 0, 0))[None]),)
    turned = np.array([1.0, 0.7, -1.0]) if linear is None else linear @ (1.0, 0.7, -1.0)
    along = np.array([turned[0], 0.0, turned[2]]) / np.hypot(turned[0], turned[2])
    across = np.cross([0.0, 1.0, 0.0], along)
    across *= np.sign(across @ (0.0, 0.0, -1.0))
    normal = TILT @ np.array([along, across, [0, 1, 0]])
    scene = lit(mesh, camera, one_texel(TEXEL), sun(), instances=instances)
    for written in (False, True):
        film = render(scene.flat() if written else scene, "path", device, iterations=1, max_bounces=0)
        assert film.radiance() == pytest.approx(ALBEDO * (normal @ SUN), abs=1e-5)


@pytest.mark.parametrize("texture", [one_texel((0, 0, 3.0)), one_texel((0, 0, 0.0)), one_texel((1e-9, 0, 0))])
def test_flat_and_empty_maps_change_nothing(texture, device):
    """A normal straight up, of any length, and one without a direction, leave the smooth one."""
    smooth = ball()
    uvs = smooth.points[smooth.triangles][..., :2].astype(np.float32)
    camera = ir.Camera.look_at((0, 0, 4), (0, 0, 0), fov=20.0)
    films = [
        render(lit(dataclasses.replace(smooth, uvs={"st": uvs}), camera, t, sun()), "path", device, iterations=1)
        for t in (texture, None)
    ]
    assert films[0].radiance() == pytest.approx(films[1].radiance(), abs=1e-6)


def test_without_coordinates_there_is_no_map(device):
    mesh, camera = floor(LAYOUTS["upright"][0])
    for uvs in ({}, {"st": np.zeros((2, 3, 2), np.float32)}):
        scene = lit(dataclasses.replace(mesh, uvs=uvs), camera, one_texel(TEXEL), sun())
        film = render(scene, "path", device, iterations=1, max_bounces=0)
        assert film.radiance() == pytest.approx(ALBEDO * SUN[1], abs=1e-5)


def test_seen_from_afar_bumps_are_flat(device):
    """Normals that lean one way and the other in turn have the upright mean where a pixel sees many of them."""
    pixels = np.where((np.indices((64, 64)).sum(axis=0) % 2)[..., None], TEXEL * (-1, -1, 1), TEXEL)
    mesh, camera = floor(LAYOUTS["upright"][0])
    film = render(lit(mesh, camera, Texture("n", pixels), sun()), "path", device, iterations=1, max_bounces=0)
    assert film.radiance() == pytest.approx(ALBEDO * SUN[1], abs=1e-5)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_tilted_plane_under_a_white_sky(estimator, device):
    """Of a uniform sky a plane that is lit as if tilted by α, and sees no ground, gets the part (1 + cos α)/2."""
    mesh, camera = floor(LAYOUTS["upright"][0])
    dome = ir.Light("dome", LightKind.DOME, (1.0,) * 3)
    assert_mean(render(lit(mesh, camera, one_texel(TEXEL), dome), estimator, device), ALBEDO * 0.5 * (1.0 + TILT[2]))


def bumpy_box():
    """The Cornell box with a rippled floor."""
    scene = cornell_box()
    x = np.linspace(0, 8 * np.pi, 64, endpoint=False)
    pixels = np.stack(np.broadcast_arrays(0.4 * np.cos(x), 0.4 * np.sin(x)[:, None], np.ones((64, 64))), axis=-1)
    materials = tuple(dataclasses.replace(m, normal_texture=Texture("n", pixels)) for m in scene.materials)
    meshes = tuple(
        dataclasses.replace(m, uvs={"st": (m.points[m.triangles][..., [0, 2]]).astype(np.float32)})
        for m in scene.meshes
    )
    return dataclasses.replace(scene, meshes=meshes, materials=materials)


@pytest.mark.parametrize("estimator, filtered", [("vpl", False), ("vpl", True), ("keller", False)])
def test_estimators_agree_on_bumps(estimator, filtered, device):
    """With all bounces a rippled box has the same mean radiance by every estimator, filtered or not."""
    films = [
        render(bumpy_box(), name, device, width=24, height=24, filter=on)
        for name, on in ((estimator, filtered), ("path", False))
    ]
    means = [float(film.radiance().mean()) for film in films]
    assert abs(means[0] - means[1]) < 5.0 * np.hypot(*(float(film.standard_error().mean()) for film in films))


def test_a_scene_without_maps_has_none(device):
    """Bad maps are refused by name."""
    mesh, camera = floor(LAYOUTS["upright"][0])
    for pixels in (np.full((1, 1, 3), np.nan), np.ones((1, 1, 1))):
        with pytest.raises(ir.InputError, match="bumpy: texture n"):
            render(lit(mesh, camera, Texture("n", pixels), sun()), "path", device, iterations=1)
