"""Lights that lie in the plane of a surface, as the lamps of a ceiling do, give all their light."""

import dataclasses

import numpy as np
import pytest

import warp_ir as ir
from tests.physics.closed_form import assert_mean, irradiance_at_origin, placed, render
from tests.physics.scenes import DOWN
from warp_ir.estimators import ESTIMATORS
from warp_ir.procedural import floor, quad
from warp_ir.scene import LightKind

pytestmark = pytest.mark.extended

TO_LEFT = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # takes the light's -Z to the world's -X


def over_floor(light, surface):
    scene = floor(light, size=8.0)
    return dataclasses.replace(
        scene, meshes=(*scene.meshes, surface), materials=(*scene.materials, ir.Material("black", (0.0,) * 3))
    )


def ceiling(height):
    return quad("ceiling", [(-4, height, 4), (-4, height, -4), (4, height, -4), (4, height, 4)], material=1)


def turned(scene, angle):
    """The scene, turned so that no plane of it is a plane of coordinates."""
    axis = np.array([0.36, 0.48, 0.8])
    k = np.cross(np.eye(3), axis)
    matrix = placed(np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * k @ k)
    return dataclasses.replace(
        scene,
        meshes=tuple(dataclasses.replace(m, points=m.points @ matrix[:3, :3].T) for m in scene.meshes),
        lights=tuple(
            dataclasses.replace(light, world_from_light=matrix @ light.world_from_light) for light in scene.lights
        ),
        camera=dataclasses.replace(scene.camera, world_from_camera=matrix @ scene.camera.world_from_camera),
    )


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("angle", [0.0, 0.5, 2.0])
@pytest.mark.parametrize(
    "lamp",
    [
        ir.Light("rect", LightKind.RECT, (1.0,) * 3, placed(DOWN, (0.1, 1.3, 0.2)), width=5.0, height=4.0),
        ir.Light("disk", LightKind.DISK, (1.0,) * 3, placed(DOWN, (0.1, 1.3, 0.2)), radius=2.5),
    ],
    ids=lambda lamp: lamp.name,
)
def test_a_lamp_in_the_plane_of_the_ceiling(lamp, angle, estimator, device):
    """The ceiling, black itself, takes nothing from the lamp in its plane: E is the integral over the lamp."""
    scene = turned(over_floor(lamp, ceiling(1.3)), angle)
    film = render(scene, estimator, device, max_bounces=0, light_paths=1024)
    assert_mean(film, irradiance_at_origin(lamp) / np.pi)


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("angle", [0.0, 0.5])
def test_a_lamp_in_the_plane_of_the_next_wall(angle, estimator, device):
    """A lamp that fills a wall, next to a corner: E is the integral over the lamp, from 0.05 away on."""
    lamp = ir.Light("wall", LightKind.RECT, (1.0,) * 3, placed(TO_LEFT, (0.05, 1.0, 0.0)), width=2.0, height=2.0)
    wall = quad("wall", [(0.05, 0, 4), (0.05, 4, 4), (0.05, 4, -4), (0.05, 0, -4)], material=1)
    film = render(turned(over_floor(lamp, wall), angle), estimator, device, max_bounces=0, light_paths=1024)
    assert_mean(film, irradiance_at_origin(lamp, 2000) / np.pi)


@pytest.mark.parametrize("angle", [0.0, 0.5, 2.0])
def test_the_camera_sees_a_lamp_in_the_plane_of_a_surface(angle, device):
    """A visible lamp covers the surface that it lies in, at every pixel; one behind the surface is hidden."""
    seen = []
    for behind in (0.0, 1.0e-3):
        lamp = ir.Light("lamp", LightKind.RECT, (1.0,) * 3, placed(np.eye(3), (0, 0, behind)), 1.0, 1.0)
        card = quad("card", [(-2, -2, 0), (-2, 2, 0), (2, 2, 0), (2, -2, 0)])
        camera = ir.Camera.look_at((0.1, 0.2, -1.3), (0, 0, 0), fov=30.0)
        scene = ir.Scene((card,), (ir.Material("black", (0.0,) * 3),), (lamp,), camera)
        film = render(turned(scene, angle), "path", device, width=32, height=32, iterations=1, visible_lights=True)
        seen.append(film.radiance())
    assert (seen[0] == 1.0).all() and (seen[1] == 0.0).all()
