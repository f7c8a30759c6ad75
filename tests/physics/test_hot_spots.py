"""The spot that a light makes on a surface right next to it lights the scene like a lamp of its own."""

import dataclasses

import numpy as np
import pytest

import warp_ir as ir
from tests.physics.closed_form import assert_mean, placed, render
from warp_ir.estimators import ESTIMATORS
from warp_ir.procedural import cube, floor, mesh, quad
from warp_ir.scene import LightKind

pytestmark = pytest.mark.extended

ALBEDO = 0.7
NEAR = 1.0e-4


def lamp(kind, position):
    """A lamp of intensity π: a point, or a sphere of a fifth of the distance to the wall, of flux 4π · π."""
    radius = 0.2 * NEAR
    value = np.pi if kind == LightKind.POINT else np.pi / (np.pi * radius**2)
    return ir.Light("lamp", kind, (value,) * 3, placed(np.eye(3), position), radius=radius)


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("kind", [LightKind.POINT, LightKind.SPHERE], ids=lambda kind: kind.name.lower())
def test_a_lamp_next_to_the_ceiling(kind, estimator, device):
    """Half the light of a lamp of intensity I falls on a spot: at a distance H below, E = I/H² + ρ/π · 2π I/H².

    The spot is as wide as the lamp is near: 1e-3 covers the light that falls farther away, and H - 1e-4 for H.
    """
    height = 2.0
    scene = floor(lamp(kind, (0.0, height - NEAR, 0.0)), size=8.0)
    ceiling = quad("ceiling", [(-4, height, 4), (-4, height, -4), (4, height, -4), (4, height, 4)], material=1)
    materials = (*scene.materials, ir.Material("white", (ALBEDO,) * 3))
    scene = dataclasses.replace(scene, meshes=(*scene.meshes, ceiling), materials=materials)
    film = render(scene, estimator, device, max_bounces=1, light_paths=1024)
    assert_mean(film, (1.0 + 2.0 * ALBEDO) / height**2, bias=1e-3)


@pytest.mark.parametrize("estimator", ["vpl", "keller"])
@pytest.mark.parametrize("corner", [1, 2, 3])
def test_estimators_agree_on_a_lamp_in_a_corner(corner, estimator, device):
    """Next to one, two and three walls of a closed room, where spots light each other, the means are equal."""
    points, triangles = cube(2.0, inward=True)
    place = np.where(np.arange(3) < corner, 1.0 - NEAR, 0.3)
    camera = ir.Camera.look_at((-0.7, -0.6, -0.5), (0.3, -0.3, -1.0), fov=60.0)
    scene = ir.Scene(
        (mesh("room", points, triangles),), (ir.Material("grey", (0.5,) * 3),), (lamp(LightKind.POINT, place),), camera
    )
    films = [render(scene, name, device, light_paths=4096 if name != "path" else 256) for name in (estimator, "path")]
    means = [float(film.radiance().mean()) for film in films]
    assert abs(means[0] - means[1]) < 5.0 * np.hypot(*(float(film.standard_error().mean()) for film in films))
