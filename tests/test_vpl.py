"""Light paths carry the right power to the right number of VPLs."""

import dataclasses
import math

import numpy as np
import pytest

import warp_ir as ir
from tests.physics.closed_form import placed
from warp_ir.procedural import cornell_box, floor, furnace
from warp_ir.scene import LightKind
from warp_ir.vpl.emission import survivors


def trace(scene, device="cpu", **settings):
    return ir.trace_vpls(scene, ir.RenderSettings(**settings), device=device)


@pytest.mark.parametrize("paths, albedo", [(1024, 0.5), (1000, 0.3), (7, 0.9), (64, 0.0), (1, 0.5), (256, 1.0)])
def test_survivors(paths, albedo):
    """⌊ρ̄ʲN⌋ paths are reflected j times, and the list ends when none is left."""
    counts = survivors(paths, albedo)
    assert counts[0] == paths and counts[-1] >= 1
    if 0.0 < albedo < 0.98:
        expected = [math.floor(paths * albedo**j + 1e-9) for j in range(len(counts) + 1)]
        assert list(counts) == expected[:-1] and expected[-1] == 0


def test_fractional_absorption_keeps_the_published_numbers(device):
    """In a closed room of albedo 1/2, exactly N, N/2, N/4, ... VPLs have bounce 0, 1, 2, ..."""
    vpls = trace(furnace(0.5, level=2), device, light_paths=512, absorption="fractional")
    assert list(np.bincount(vpls.bounce)) == [512, 256, 128, 64, 32, 16, 8, 4, 2, 1]


@pytest.mark.parametrize("absorption", ["fractional", "roulette"])
def test_flux_falls_by_the_albedo(absorption, device):
    """In a closed room of uniform albedo the flux at bounce k, π Σ I, is Φ ρᵏ.

    Fractional: exact to rounding, since each level is divided by its own number. Roulette: binomial,
    relative spread √((1-ρᵏ)/(N ρᵏ)); five of them.
    """
    scene, paths = furnace(0.5, 2.0, shape="cube"), 4096
    vpls = trace(scene, device, light_paths=paths, absorption=absorption)
    power = math.pi * 2.0 * 24.0  # π Le A
    for k in range(5):
        flux = math.pi * vpls.intensity[vpls.bounce == k].sum(axis=0)
        spread = 0.0 if absorption == "fractional" else math.sqrt((1 - 0.5**k) / (paths * 0.5**k))
        np.testing.assert_allclose(flux, power * 0.5**k, rtol=1e-4 + 5 * spread)


def test_max_bounces(device):
    """No VPL has more reflections than allowed, and with 0 they all lie on the light."""
    assert trace(furnace(0.8, level=2), device, max_bounces=2).bounce.max() == 2
    assert len(trace(furnace(0.8, level=2), device, max_bounces=0, light_paths=64).bounce) == 64


def test_positions_lie_on_surfaces_in_world_space(device):
    """Every VPL of a cube furnace lies on a face, its normal points inward, wherever and however large the cube is."""
    scene = furnace(0.5, shape="cube")
    mesh = dataclasses.replace(scene.meshes[0], points=scene.meshes[0].points * 1000.0 + 5.0e4)
    vpls = trace(dataclasses.replace(scene, meshes=(mesh,)), device)
    local = (vpls.positions - 5.0e4) / 1000.0
    np.testing.assert_allclose(np.abs(local).max(axis=1), 1.0, atol=5e-6)
    axis = np.abs(local).argmax(axis=1)
    rows = np.arange(len(axis))
    np.testing.assert_allclose(vpls.normals[rows, axis], -np.sign(local[rows, axis]), atol=1e-6)


def test_directional_vpls(device):
    """Distant and dome lights give VPLs at infinity, with their irradiance: Σ I = Σ E."""
    sun = ir.Light("sun", LightKind.DISTANT, (3.0,) * 3, angle=0.0)
    vpls = trace(floor(sun), device, light_paths=128)
    at_light = vpls.bounce == 0
    assert vpls.directional[at_light].all() and not vpls.directional[~at_light].any()
    np.testing.assert_allclose(vpls.positions[at_light], [[0.0, 0.0, 1.0]] * 128, atol=1e-6)
    np.testing.assert_allclose(vpls.intensity[at_light].sum(axis=0), 3.0, rtol=1e-5)


def test_black_surfaces_carry_no_vpl(device):
    """A path that meets a black surface ends there: nothing is stored that cannot light anything."""
    for absorption in ("fractional", "roulette"):
        assert trace(furnace(0.0, level=2), device, absorption=absorption).bounce.max() == 0
    assert len(trace(furnace(0.5, 0.0, level=2), device).bounce) == 0


def test_iterations_are_independent_and_repeatable(device):
    """Another iteration or seed gives other VPLs; the same gives the same bits."""
    scene = cornell_box()
    first, again = trace(scene, device), trace(scene, device)
    np.testing.assert_array_equal(first.positions, again.positions)
    np.testing.assert_array_equal(first.intensity, again.intensity)
    other = ir.trace_vpls(scene, ir.RenderSettings(), device=device, iteration=1)
    assert not np.array_equal(first.positions[:100], other.positions[:100])
    assert not np.array_equal(first.positions[:100], trace(scene, device, seed=1).positions[:100])


@pytest.mark.parametrize("noted", [0.9, 0.02])
def test_those_that_find_room_stand_for_all(monkeypatch, noted, device):
    """Of 8000 VPLs on surfaces 1000 are kept, each shining for eight, lights all: the same flux, at every bounce, too.

    In a furnace all VPLs have one intensity, so the flux as a whole is the same to rounding; a bounce with a share p of
    the VPLs keeps 1000 p of them on the mean, spread by less than √(1000 p (1 - p)); five of them.
    """
    monkeypatch.setattr("warp_ir.vpl.emission._RETRACED_SHARE", noted)  # many paths are followed again, or few
    scene, settings = furnace(0.5, 2.0, shape="cube"), {"light_paths": 8192, "seed": 3}
    every = trace(scene, device, **settings)
    monkeypatch.setattr("warp_ir.vpl.emission._MAX_CAPACITY", 1000)
    some = trace(scene, device, **settings)
    assert len(some.bounce) == 8192 + 1000
    np.testing.assert_array_equal(some.positions[:8192], every.positions[:8192])
    np.testing.assert_array_equal(some.intensity[:8192], every.intensity[:8192])
    rows = {tuple(p): k for k, p in enumerate(every.positions[8192:])}
    kept = np.array([rows[tuple(p)] for p in some.positions[8192:]])
    assert (np.diff(kept) >= 7).all() and (np.diff(kept) <= 9).all()
    times = some.intensity[8192:] / every.intensity[8192:][kept]
    np.testing.assert_allclose(times, (len(every.bounce) - 8192) / 1000.0, rtol=1e-6)
    np.testing.assert_allclose(some.intensity.sum(axis=0), every.intensity.sum(axis=0), rtol=1e-4)
    for bounce in range(1, 6):
        share = (every.bounce[8192:] == bounce).mean()
        spread = math.sqrt(1000 * share * (1 - share))
        assert abs((some.bounce[8192:] == bounce).sum() - 1000 * share) < 5 * spread


def test_every_vpl_knows_where_its_light_came_from(device):
    """The parent of a VPL lies on the same path, one bounce before, and sees it along a straight line."""
    scene = furnace(0.7, shape="cube")
    for absorption in ("fractional", "roulette"):
        vpls = trace(scene, device, light_paths=128, absorption=absorption)
        child = np.flatnonzero(vpls.bounce > 0)
        parent = vpls.parent[child]
        assert (parent >= 0).all() and (vpls.parent[vpls.bounce == 0] == -1).all()
        np.testing.assert_array_equal(vpls.bounce[parent], vpls.bounce[child] - 1)
        np.testing.assert_array_equal(vpls.path[parent], vpls.path[child])
        # In a convex room light travels from the lit side of one to the lit side of the other.
        along = vpls.positions[child] - vpls.positions[parent]
        assert (np.einsum("nk,nk->n", along, vpls.normals[parent]) > 0.0).all()
        assert (np.einsum("nk,nk->n", along, vpls.normals[child]) < 0.0).all()


@pytest.mark.extended
def test_contribution_of_a_point_light_to_a_pixel(device):
    """A point light of intensity I adds ρ/π I cosθ/d² to the pixel that sees the floor below it, and only there."""
    light = ir.Light("lamp", LightKind.POINT, (3.0, 2.0, 1.0), world_from_light=placed(np.eye(3), (0.5, 2.0, 0.0)))
    camera = ir.Camera.look_at(eye=(0.0, 4.0, 0.0), target=(0.0, 0.0, 0.0), up=(0.0, 0.0, -1.0), fov=30.0)
    scene = dataclasses.replace(floor(light, albedo=0.5), camera=camera)
    settings = ir.RenderSettings(width=9, height=9, light_paths=16, max_bounces=0)
    vpls = ir.trace_vpls(scene, settings, device=device, contribution_to=(4, 4))
    np.testing.assert_allclose(vpls.pixel_position, 0.0, atol=1e-3)
    expected = 0.5 / math.pi * np.array([3.0, 2.0, 1.0]) * 2.0 / (0.25 + 4.0) ** 1.5
    np.testing.assert_allclose(vpls.contribution.sum(axis=0), expected, rtol=1e-3)
    with pytest.raises(ir.InputError, match="contribution_to"):
        ir.trace_vpls(scene, settings, device=device, contribution_to=(9, 0))
