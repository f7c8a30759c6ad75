"""Textured rooms, lamps and screens whose light is known in closed form."""

import dataclasses

import numpy as np
import pytest

import warp_ir as ir
from tests.physics.closed_form import assert_mean, placed, render, rotation_x
from warp_ir.estimators import ESTIMATORS
from warp_ir.procedural import cornell_box, furnace, quad, sphere
from warp_ir.scene import LightKind, Texture, Wrap

pytestmark = pytest.mark.extended

CHECKER = 0.2 + 0.6 * (np.indices((8, 8)).sum(axis=0) % 2)[..., None] * np.ones(3)


def square_uvs(mesh, copies=1.0):
    """A quad with the texture on it, `copies` times in each direction."""
    corners = copies * np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    return dataclasses.replace(mesh, uvs={"st": corners[[[0, 1, 2], [0, 2, 3]]]})


def room(albedo=(0.5,) * 3, **looks):
    """A furnace: a sphere seen from inside, its texture wrapped so that areas keep their share (Lambert 1772)."""
    scene = furnace(level=4)
    mesh = scene.meshes[0]
    p = mesh.points[mesh.triangles]
    around = np.arctan2(p[..., 1], p[..., 0]) / (2 * np.pi)
    middle = around[:, :1]
    around = around - np.round(around - middle)  # no triangle spans the seam
    uvs = np.stack([around, 0.5 * p[..., 2] + 0.5], axis=-1).astype(np.float32)
    material = dataclasses.replace(scene.materials[0], albedo=albedo, **looks)
    return dataclasses.replace(scene, meshes=(dataclasses.replace(mesh, uvs={"st": uvs}),), materials=(material,))


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_furnace_with_a_textured_albedo(estimator, device):
    """In a sphere everything sees everything alike: E/π = Le / (1 - mean ρ), so L = Le + ρ(x) E/π.

    The mean over the picture of L/(mean ρ over the picture) checks both. The few triangles at the poles, 1 % of the
    area, do not keep their share.
    """
    scene = room(albedo_texture=Texture("checker", CHECKER))
    film = render(scene, estimator, device, width=16, height=16)
    rho = float(film.aov("albedo").mean())
    assert 0.3 < rho < 0.7
    assert_mean(film, 1.0 + rho / (1.0 - 0.5), bias=0.01)
    assert float(film.aov("albedo").std()) > 0.05


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_furnace_with_a_textured_glow(estimator, device):
    """A sphere whose emission has the mean Le: E/π = mean Le / (1 - ρ), whatever its pattern; black parts included."""
    glow = np.zeros((8, 8, 3))
    glow[1:3, 2:6] = (8.0, 4.0, 2.0)
    glow *= np.array([1.0, 1.0, 1.0]) / glow.mean(axis=(0, 1))
    film = render(room(emission_texture=Texture("glow", glow)), estimator, device, width=16, height=16)
    # A picture of the emission itself apart: what is reflected is ρ mean Le / (1 - ρ) = 1.
    reflected = film.aov("direct").mean() + film.aov("indirect").mean() - film._radiance_of("emission").mean()
    error = 5.0 * float(film.standard_error().mean())
    assert abs(reflected - 1.0) < error + 0.02


def lit_floor(light_mesh, light_material, *more, materials=()):
    """A white floor seen from above, with something over it."""
    floor = quad("floor", [(-9, 0, 9), (9, 0, 9), (9, 0, -9), (-9, 0, -9)])
    camera = ir.Camera.look_at((0.001, 0.5, 0.0), (0.0, 0.0, 0.0), fov=1.0)
    white = ir.Material("white", (1.0, 1.0, 1.0))
    return ir.Scene((floor, light_mesh, *more), (white, light_material, *materials), camera=camera)


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("wrap", [Wrap.REPEAT, Wrap.MIRROR])
def test_flux_of_a_textured_lamp_is_its_mean(estimator, wrap, device):
    """A lamp with a fine pattern lights the floor as one of its mean radiance would."""
    lamp = quad("lamp", [(-0.5, 2, -0.5), (0.5, 2, -0.5), (0.5, 2, 0.5), (-0.5, 2, 0.5)], 1)
    pattern = np.zeros((16, 16, 3))
    pattern[::4, ::4] = (32.0, 16.0, 0.0)
    texture = Texture("glow", pattern, (wrap, wrap))
    plain = lit_floor(lamp, ir.Material("lamp", (0.0,) * 3, texture.mean))
    textured = lit_floor(square_uvs(lamp, 4.0), ir.Material("lamp", (0.0,) * 3, emission_texture=texture))
    expected = render(plain, "path", device, iterations=4096, max_bounces=0)
    film = render(textured, estimator, device, iterations=256, max_bounces=0)
    exact = float(expected.radiance().mean())
    assert_mean(film, exact, bias=5.0 * float(expected.standard_error().mean()) / exact)


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("cutoff", [0.0, 0.5])
@pytest.mark.parametrize("pattern", ["stripes", "grey"])
def test_a_half_open_screen_passes_half(estimator, cutoff, pattern, device):
    """A sun over a black screen: through holes in half of it, or through one of opacity 1/2, comes half the light.

    The camera is under the screen. With a cutoff of 1/2 the grey screen (0.49) is not there at all.
    """
    sun = ir.Light("sun", LightKind.DISTANT, (2.0,) * 3, placed(rotation_x(-90.0), (0, 0, 0)), angle=0.0)
    screen = square_uvs(quad("screen", [(-9, 2, 9), (9, 2, 9), (9, 2, -9), (-9, 2, -9)], 1), 9.0)
    holes = np.indices((64, 64)).sum(axis=0)[..., None] // 32 % 2 if pattern == "stripes" else np.full((1, 1, 1), 0.49)
    material = ir.Material("s", (0.0,) * 3, opacity_texture=Texture("o", holes.astype(float)), cutoff=cutoff)
    scene = dataclasses.replace(lit_floor(screen, material), lights=(sun,))
    camera = ir.Camera.look_at((0.001, 1.5, 0.0), (0.0, 0.0, 0.0), fov=100.0)
    film = render(dataclasses.replace(scene, camera=camera), estimator, device, width=32, height=32, max_bounces=0)
    expected = {"stripes": 0.5, "grey": 0.51 if cutoff == 0.0 else 1.0}[pattern] * 2.0 / np.pi
    # The edges of the holes are sampled by as many pixels as they cross: 5 % of what is in view.
    assert_mean(film, expected, bias=0.05 if pattern == "stripes" else 0.0)


def test_camera_rays_pass_holes(device):
    """Through a screen that is cut out everywhere, the picture is that without it, bit for bit but for rounding."""
    scene = cornell_box()
    open_screen = square_uvs(
        quad("screen", [(100, 100, -100), (400, 100, -100), (400, 400, -100), (100, 400, -100)], 4)
    )
    absent = ir.Material("absent", opacity=0.2, cutoff=0.5)
    count = len(scene.materials)
    open_screen = dataclasses.replace(open_screen, material=np.full(2, count, np.int32))
    more = dataclasses.replace(scene, meshes=(*scene.meshes, open_screen), materials=(*scene.materials, absent))
    one, two = (render(s, "path", device, width=16, height=16, iterations=16) for s in (scene, more))
    assert np.median(np.abs(one.radiance() - two.radiance())) < 1e-3
    assert abs(one.aov("depth") - two.aov("depth")).max() < 1e-3 * one.aov("depth").max()


def textured_cornell():
    """The Cornell box with everything on: patterned walls, a patterned glow, a screen with holes and one half there."""
    scene = cornell_box()
    rng = np.random.default_rng(2)
    walls = tuple(
        dataclasses.replace(m, albedo_texture=Texture(m.name, rng.random((16, 16, 3)), (Wrap.MIRROR, Wrap.REPEAT)))
        for m in scene.materials
    )
    meshes = tuple(
        dataclasses.replace(m, uvs={"st": rng.random((len(m.triangles), 3, 2)).astype(np.float32)})
        for m in scene.meshes
    )
    screen = square_uvs(quad("screen", [(100, 50, 100), (400, 50, 100), (400, 400, 200), (100, 400, 200)]))
    glow = np.where(rng.random((8, 8, 3)) < 0.3, rng.random((8, 8, 3)) * 40.0, 0.0)
    holes = (rng.random((8, 8, 1)) < 0.5).astype(np.float64)
    other = ir.Material(
        "screen",
        albedo_texture=Texture("c", rng.random((4, 4, 3))),
        emission_texture=Texture("g", glow),
        opacity_texture=Texture("o", holes),
        cutoff=0.5,
    )
    half = dataclasses.replace(other, name="half", cutoff=0.0, emission_texture=None, emission=(0.0, 2.0, 0.0))
    second = dataclasses.replace(screen, points=screen.points + np.array([50.0, 60.0, 150.0]))
    count = len(walls)
    screens = [dataclasses.replace(m, material=np.full(2, count + k, np.int32)) for k, m in enumerate((screen, second))]
    return dataclasses.replace(scene, meshes=(*meshes, *screens), materials=(*walls, other, half))


@pytest.mark.parametrize(
    "estimator, absorption", [("keller", "fractional"), ("keller", "roulette"), ("vpl", "roulette")]
)
def test_vpls_agree_with_path_on_textures(estimator, absorption):
    """As in `test_agreement`: per pixel the Z scores of the difference are few beyond 4.5, and the mean agrees."""
    common = dict(width=12, height=12)
    scene = textured_cornell()
    one = render(scene, estimator, iterations=48 if estimator == "keller" else 256, absorption=absorption, **common)
    two = render(scene, "path", iterations=2048, **common)
    error = np.hypot(one.standard_error(), two.standard_error())
    z = (one.radiance() - two.radiance()) / np.maximum(error, 1e-12)
    assert (np.abs(z) > 4.5).mean() <= 0.005
    shift = float(one.radiance().mean() - two.radiance().mean())
    assert abs(shift) < 4.0 * float(error.mean())


def test_twice_the_glow_is_twice_the_picture(device):
    """A texture twice as bright doubles every bit of the film."""
    films = []
    for factor in (1.0, 2.0):
        glow = Texture("glow", np.random.default_rng(1).random((8, 8, 3)) * factor)
        films.append(render(room(emission_texture=glow), "vpl", device, iterations=4))
    assert (films[0].radiance() * 2.0 == films[1].radiance()).all()


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(pixels=np.full((2, 2, 3), 2.0)), "lie in"),
        (dict(pixels=np.full((2, 2, 3), np.nan)), "finite"),
        (dict(pixels=np.zeros((2, 2))), "shape"),
        (dict(pixels=np.zeros((0, 2, 3))), "shape"),
        (dict(transform=np.full((2, 3), np.inf)), "transform"),
        (dict(transform=np.full((2, 3), 1e300)), "transform"),
        (dict(outside=(np.nan, 0.0, 0.0)), "outside"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*:RuntimeWarning")
def test_bad_textures_are_refused(launcher, change, message):
    """Kernels trust their input: an `InputError` names material and texture."""
    from warp_ir.device_scene import upload_scene

    texture = dataclasses.replace(Texture("pattern", np.zeros((2, 2, 3))), **change)
    points, triangles = sphere(level=1)
    mesh = ir.Mesh("m", points, triangles, np.zeros(len(triangles), np.int32))
    material = ir.Material("look", albedo_texture=texture) if np.ndim(texture.pixels) == 3 else None
    with pytest.raises(ir.InputError, match=f"texture pattern.*{message}"):
        upload_scene(ir.Scene((mesh,), (material or ir.Material("look", opacity_texture=texture),)), launcher)
