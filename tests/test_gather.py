"""A few rays stand for many VPLs, and no two of them for the same ones."""

import dataclasses

import numpy as np
import pytest

import warp_ir as ir
from tests.physics.closed_form import assert_mean, irradiance_at_origin, placed, rotation_x
from warp_ir.procedural import floor, quad
from warp_ir.scene import LightKind, Material

pytestmark = pytest.mark.extended


def half_hidden(others):
    """The floor below a lamp of which half is hidden; `others` times as much light is below the floor."""
    down, up = (placed(rotation_x(angle), (0.0, y, 0.0)) for angle, y in ((-90.0, 3.0), (90.0, -3.0)))
    lamp = ir.Light("lamp", LightKind.RECT, (1.0, 1.0, 1.0), down)
    more = ir.Light("more", LightKind.RECT, (others, others, others), up)
    scene = floor(lamp)
    board = quad("board", [[0, 2, 9], [-9, 2, 9], [-9, 2, -9], [0, 2, -9]], 1, double_sided=True)
    black = Material("black", (0.0, 0.0, 0.0))
    return dataclasses.replace(
        scene, meshes=(*scene.meshes, board), materials=(*scene.materials, black), lights=(lamp, more)
    )


def test_rays_go_to_different_vpls(device):
    """Four rays to the sixteen VPLs that count, of 256, find one to three of them visible where half are.

    So the variance of a pixel is at most that of two values, 1/2 and 3/2 of the mean: 1/4 of its square. It would be
    the square if all four went to the same VPL.
    """
    settings = ir.RenderSettings(width=16, height=16, light_paths=256, iterations=16, filter=False, max_bounces=0)
    film = ir.render(half_hidden(15.0), settings, device=device)
    mean = film.radiance().mean(dtype=np.float64)
    variance = settings.iterations * (film.standard_error().astype(np.float64) ** 2).mean()
    assert variance < 0.25 * mean**2


@pytest.mark.parametrize("paths", [1, 64, 4096, 1 << 17])
def test_any_number_of_vpls(paths, device):
    """From one VPL to sets of many thousands: half of the lamp's light arrives.

    The bias allows for the lamp's VPLs, which lie a few ulp off the lamp, and for the float32 of the light's path.
    """
    scene = half_hidden(1.0)
    settings = ir.RenderSettings(width=8, height=8, light_paths=paths, iterations=16, filter=False, max_bounces=0)
    film = ir.render(scene, settings, device=device)
    assert_mean(film, 0.5 * irradiance_at_origin(scene.lights[0]) / np.pi, bias=1.0e-4)
