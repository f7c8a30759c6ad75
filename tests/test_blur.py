"""What is seen through a lens or an open shutter: filtered as what is sharp, and as true."""

from dataclasses import replace

import numpy as np
import pytest

import warp_ir as ir
from warp_ir import procedural
from warp_ir.sampling.sobol import stratum

pytestmark = pytest.mark.extended

BLURRED = ir.RenderSettings(width=48, height=48, iterations=8, light_paths=512)


def through_a_lens():
    """The Cornell box, sharp in front and blurred over seven pixels at the back."""
    scene = procedural.cornell_box()
    return replace(scene, camera=replace(scene.camera, lens_radius=200.0, focus_distance=850.0))


def in_motion(moments=16):
    """The Cornell box, whose short block rises and whose tall one turns while the shutter is open."""
    scene = procedural.cornell_box()

    def at(time):
        for mesh in scene.meshes:
            points = mesh.points
            if mesh.name == "short":
                yield replace(mesh, points=points + np.array([120.0, 60.0, 0.0]) * (time - 0.5))
            elif mesh.name == "tall":
                middle, turn = points.mean(axis=0), 0.4 * (time - 0.5)
                c, s = np.cos(turn), np.sin(turn)
                yield replace(mesh, points=(points - middle) @ [[c, 0, -s], [0, 1, 0], [s, 0, c]] + middle)
            else:
                yield mesh

    return replace(scene, shutter=tuple(replace(scene, meshes=tuple(at((k + 0.5) / moments))) for k in range(moments)))


def panned(moments=16):
    """The Cornell box, past which the camera moves."""
    scene = procedural.cornell_box()
    cameras = []
    for k in range(moments):
        place = scene.camera.world_from_camera.copy()
        place[0, 3] += 60.0 * ((k + 0.5) / moments - 0.5)
        cameras.append(replace(scene.camera, world_from_camera=place))
    return replace(scene, shutter=tuple(replace(scene, camera=camera) for camera in cameras))


SCENES = {"lens": through_a_lens, "motion": in_motion, "pan": panned}


@pytest.fixture(scope="module", params=SCENES)
def pictures(request):
    """A blurred scene, a picture of few iterations, and one of many without the filter and its standard error."""
    scene = SCENES[request.param]()
    film = ir.render(scene, BLURRED)
    truth = ir.render(scene, replace(BLURRED, iterations=256, filter=False, seed=9))
    return scene, film, truth.radiance().astype(float), truth.standard_error().astype(float)


def relative_error(picture, truth, error):
    """Mean of the squared error relative to the brightness, less that of the reference."""
    weight = 1.0 / (truth**2 + 0.01 * truth.mean() ** 2)
    return float((((picture - truth) ** 2 - error**2) * weight).mean())


def test_blur_is_filtered(pictures):
    """At eight iterations a pixel has less than a third of the plain mean's squared error, as a median.

    The mean is that of the edges of a lamp and of contact shadows, blurred or not.
    """
    scene, film, truth, _ = pictures
    plain = ir.render(scene, replace(BLURRED, filter=False)).radiance()
    scale = truth**2 + 0.01 * truth.mean() ** 2
    new, old = (np.median((x - truth) ** 2 / scale) for x in (film.radiance(), plain))
    assert new < old / 3


def test_blur_keeps_its_brightness(pictures):
    """The filtered picture is as bright as the plain mean of other samples, within its error."""
    _, film, truth, _ = pictures
    # Pixels share their VPLs: the error of the mean is at worst that of one pixel, and seldom a fifth of it.
    spread = film.standard_error().mean(axis=(0, 1)) / truth.mean(axis=(0, 1))
    assert (np.abs(film.radiance().mean(axis=(0, 1)) / truth.mean(axis=(0, 1)) - 1.0) < 0.2 * spread + 0.005).all()


def test_blur_is_no_worse_than_its_samples(pictures):
    """After many iterations the filtered picture is no farther from the truth than the plain mean is: no bias stays."""
    scene, _, truth, error = pictures
    film = ir.render(scene, replace(BLURRED, iterations=128))
    plain = ir.render(scene, replace(BLURRED, iterations=128, filter=False)).radiance()
    assert relative_error(film.radiance(), truth, error) < relative_error(plain, truth, error)


@pytest.mark.parametrize("what", SCENES)
def test_no_sample_is_lost(what):
    """Every sample is for one pixel: as many are counted as were made on surfaces that reflect."""
    film = ir.render(SCENES[what](), replace(BLURRED, iterations=4))
    samples = {name: array.numpy() for name, array in film.reconstruction.arrays().items()}
    total = samples["count"].sum() + samples["unassigned_count"].sum()
    assert total == round(film.aov("alpha").sum() * film.iterations)
    # Most surfaces are seen through the middle of the lens and at the moment in the middle as well.
    assert samples["unassigned_count"].sum() < 0.05 * samples["count"].sum()


def test_light_stays_on_what_moves():
    """Two panels of which one is lit move by their width: all samples of each are its own, and bright or dark.

    They face different ways, and a sun shines on the one alone.
    """
    corners = np.array([[-0.5, -0.5, 0.0], [0.0, -0.5, 0.25], [0.0, 0.5, 0.25], [-0.5, 0.5, 0.0]])
    panels = procedural.quad("left", corners), procedural.quad("right", corners[::-1] * [-1.0, 1.0, 1.0])
    up, back = np.array([0.0, 1.0, 0.0]), np.array([-1.0, 0.0, 0.2])
    turn = np.eye(4)
    turn[:3, 2] = back / np.linalg.norm(back)
    turn[:3, 0], turn[:3, 1] = np.cross(up, turn[:3, 2]), up
    sun = ir.Light("sun", ir.LightKind.DISTANT, (1000.0,) * 3, world_from_light=turn, angle=1.0)
    scene = ir.Scene(
        panels,
        (ir.Material("grey", (0.5, 0.5, 0.5)),),
        (sun,),
        camera=ir.Camera.look_at((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), fov=40.0),
    )
    moved = (
        tuple(replace(p, points=p.points + np.array([x, 0.0, 0.0])) for p in panels) for x in (-0.4, -0.2, 0.0, 0.2)
    )
    scene = replace(scene, shutter=tuple(replace(scene, meshes=meshes) for meshes in moved))
    film = ir.render(scene, ir.RenderSettings(width=32, height=32, iterations=8, light_paths=64, max_bounces=0))
    samples = {name: array.numpy() for name, array in film.reconstruction.arrays().items()}
    # The third of four moments is the one in the middle: there the panels meet in the middle of the picture.
    sides = np.arange(32 * 32) % 32 < 16
    lit, dark = ((side & (samples["count"] > 0)) for side in (sides, ~sides))
    assert lit.sum() > 20 and abs(lit.sum() - dark.sum()) <= 0.1 * lit.sum()
    means = samples["direct"][lit, 0] / samples["count"][lit]
    # Irradiance over π is the same everywhere on a plane in the sun, and nothing on one turned away.
    np.testing.assert_allclose(means, means.mean(), rtol=1e-3)
    assert means.mean() > 0.0 and not samples["direct"][dark].any() and not samples["unassigned_count"].any()


def test_what_is_sharp_pays_nothing():
    """Without lens and shutter nothing is kept for them."""
    renderer = ir.Renderer(procedural.cornell_box(), replace(BLURRED, iterations=1))
    film = renderer.render()
    assert renderer._gbuffer.surface_point.shape[0] == 0
    assert not film.reconstruction._scratch._arrays
    assert ir.Renderer(in_motion(), replace(BLURRED, iterations=1))._gbuffer.surface_point.shape[0] == 48 * 48


def test_the_denoiser_gets_features_without_noise():
    """Its albedo and normals of two iterations are those of many: they come from camera rays of their own."""
    scene = through_a_lens()
    renderer = ir.Renderer(scene, replace(BLURRED, iterations=2))
    film = renderer.render()
    albedo = film.reconstruction.resolve(film._data, film.iterations, features=True)[2]
    truth = ir.render(scene, replace(BLURRED, iterations=256, filter=False, light_paths=1)).aov("albedo")
    noisy = film.aov("albedo")
    inside = slice(4, -4)
    errors = [((x - truth)[inside, inside] ** 2).mean() for x in (albedo, noisy)]
    assert errors[0] < errors[1] / 8  # 64 rays in place of 2, stratified


@pytest.mark.parametrize("bits", [0, 1, 2, 4])
def test_iterations_take_all_moments_in_turn(bits):
    """So many that begin at a multiple of their number take each once."""
    count = 1 << bits
    for first in range(0, 8 * count, count):
        assert sorted(stratum(first + k, bits) for k in range(count)) == list(range(count))


def test_time_and_place_in_the_pixel_do_not_go_hand_in_hand():
    """Every one of 16 columns of a pixel is seen at more than half of 16 moments within 256 iterations, not at one."""
    # The first coordinate of the sequence is the index with its bits reversed; scrambling only permutes the columns.
    pairs = {(stratum(k, 4), int(f"{k % 16:04b}"[::-1], 2)) for k in range(256)}
    assert all(len({moment for moment, column in pairs if column == c}) > 8 for c in range(16))
