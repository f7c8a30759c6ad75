"""Shadow rays go to what is visible, and the light is the same."""

from dataclasses import replace

import numpy as np
import pytest

import warp_ir as ir
from warp_ir.procedural import quad
from warp_ir.renderer import Renderer
from warp_ir.scene import LightKind
from warp_ir.settings import GuidingSettings
from warp_ir.vpl.visibility import CELLS, CELLS_OF_LANE

pytestmark = pytest.mark.extended

SKY = ir.Light("sky", LightKind.DOME, (1.0, 1.0, 1.0))
ALBEDO = 0.5
UNLEARNED = GuidingSettings(visibility=False)


def beside_a_wall(turn=0.0):
    """A floor whose points see half of the sky: a wall 1000 m high and wide stands at x = 0, 1.3 m from what is seen.

    All is turned about the z axis by an angle [rad].
    """
    floor = quad("floor", [[0, -500, 0], [500, -500, 0], [500, 500, 0], [0, 500, 0]])
    wall = quad("wall", [[0, -500, 0], [0, 500, 0], [0, 500, 1000], [0, -500, 1000]], 1)
    camera = ir.Camera.look_at((2.0, 0.0, 2.0), (2.0, 0.0, 0.0), up=(0, 1, 0), fov=40.0)
    materials = ir.Material("floor", (ALBEDO,) * 3), ir.Material("black", (0.0,) * 3)
    turned = np.eye(4)
    turned[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    meshes = tuple(replace(part, points=part.points @ turned[:3, :3].T) for part in (floor, wall))
    return ir.Scene(meshes, materials, (SKY,), replace(camera, world_from_camera=turned @ camera.world_from_camera))


def film_of(scene, guiding, **settings):
    settings = ir.RenderSettings(**{"width": 32, "height": 32, "filter": False, "light_paths": 256, **settings})
    return Renderer(scene, settings, guiding=guiding).render()


def learned(scene, **settings):
    """A renderer that has learned, the VPLs of its iteration, and `TileVisibility`."""
    settings = ir.RenderSettings(**{"width": 32, "height": 32, "filter": False, "light_paths": 256, **settings})
    renderer = Renderer(scene, settings)
    renderer.add_iteration(renderer.new_film(), 0)
    estimator = renderer._shutter[0].estimator
    return renderer, estimator.prepare(0).visibility


def test_half_of_the_sky_is_behind_a_wall():
    """The visible share of the directions is 1 on one side and 0 on the other, as octants are ordered in Morton codes.

    Half of the sections are below the floor, where nothing is tried: their share is the mean. Of some ten rays and 0.3
    rays of the mean, 1/2, a share of none is 0.015, and one of all 0.985; of two rays 0.07 and 0.93.
    """
    _, visibility = learned(beside_a_wall())
    shares = visibility.to_lights.numpy().reshape(-1, CELLS) ** 2
    assert shares.shape == (16, CELLS)
    assert shares.mean() == pytest.approx(0.5, abs=0.06)
    assert np.mean(np.abs(shares - 0.5) < 0.06) == pytest.approx(0.5, abs=0.06)
    assert np.mean((shares < 0.1) | (shares > 0.9)) == pytest.approx(0.5, abs=0.06)


def test_noise_is_less_and_the_light_the_same():
    """A point that sees half of a uniform sky has E = π/2 L; drawn by visibility, its variance is at least halved.

    Unlearned, half of the rays are lost: of M rays the squared relative error is 1/M at most. The wall is not parallel
    to the sides of octants, by which the curve through the directions is divided: else exactly half of them arrive.
    """
    scene = beside_a_wall(turn=0.4)
    films = [film_of(scene, guiding, iterations=32, max_bounces=0) for guiding in (GuidingSettings(), UNLEARNED)]
    for film in films:
        mean = film.radiance().mean(dtype=np.float64)
        # A direction at the azimuth of the wall's end, atan(500 m / 2 m), is free on both sides: 0.3 % of the light.
        assert mean == pytest.approx(0.5 * ALBEDO, rel=0.01)
    learned_error, unlearned_error = (film.error() for film in films)
    assert learned_error**2 < 0.5 * unlearned_error**2


def test_rays_go_where_the_noise_is():
    """Where all light is direct seven of eight rays go to lights; where no light is in view, seven go to surfaces."""
    open_floor = replace(beside_a_wall(), materials=(ir.Material("black", (0.02,) * 3),) * 2)
    _, visibility = learned(open_floor)
    assert (visibility.rays.numpy() == (7, 1)).all()
    panel = quad("panel", [[0, 0, 2], [1, 0, 2], [1, 1, 2], [0, 1, 2]], 1)  # which shines upwards
    floor = quad("floor", [[-5, -5, 0], [5, -5, 0], [5, 5, 0], [-5, 5, 0]])
    ceiling = quad("ceiling", [[-5, -5, 4], [-5, 5, 4], [5, 5, 4], [5, -5, 4]])
    camera = ir.Camera.look_at((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), up=(0, 1, 0), fov=60.0)
    materials = ir.Material("white", (0.8,) * 3), ir.Material("panel", (0.0,) * 3, (10.0,) * 3)
    _, visibility = learned(ir.Scene((floor, ceiling, panel), materials, camera=camera))
    assert (visibility.rays.numpy() == (1, 7)).all()


def test_a_data_window_learns_what_the_picture_does():
    """Tiles of a window have the numbers that they have in the whole picture, wherever its edges are."""
    scene = beside_a_wall()
    _, whole = learned(scene, width=64, height=64)
    _, part = learned(scene, width=64, height=64, data_window=(0.3, 0.2, 0.7, 0.9))
    rows = slice(part.first_row, part.first_row + part.rows)
    columns = slice(part.first_column, part.first_column + part.columns)
    assert part.columns < whole.columns and part.rows < whole.rows
    for a, b in ((whole.to_lights, part.to_lights), (whole.to_surfaces, part.to_surfaces)):
        of_whole = a.numpy().reshape(8, 8, CELLS)[rows, columns]
        assert np.array_equal(of_whole.reshape(-1), b.numpy())


def test_whoever_begins_late_learns_the_same():
    """Iteration 3 has the same bits, whether it is the first or not."""
    scene = beside_a_wall()
    settings = ir.RenderSettings(width=24, height=24, filter=False, light_paths=128)
    pictures = []
    for before in ([], [0, 1]):
        renderer = Renderer(scene, settings)
        for iteration in before:
            renderer.add_iteration(renderer.new_film(), iteration)
        film = renderer.new_film()
        renderer.add_iteration(film, 3)
        pictures.append(film.radiance())
    assert np.array_equal(*pictures)


def test_there_are_four_sections_in_a_lane():
    """Sixteen lanes of four sections make up a set: what kernels load at once is a section of all lanes."""
    assert CELLS == 16 * CELLS_OF_LANE
