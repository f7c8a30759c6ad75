"""Directions towards lights fill exactly the solid angle of the light, evenly, and say with what density."""

import math

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from tests.physics.closed_form import unit_shape
from warp_ir.sampling.solid_angle import sample_solid_angle, solid_angle_pdf
from warp_ir.scene import LightKind

pytestmark = pytest.mark.extended

wp.set_module_options({"enable_backward": False})

SIDE = 128
"""Samples are a jittered grid of as many rows and columns."""


@wp.kernel
def _aim(
    first: int,
    kind: int,
    axes: wp.mat33,
    inverse: wp.mat33,
    to_light: wp.vec3,
    u: wp.array[wp.vec2],
    way: wp.array[wp.vec3],
    density: wp.array2d[wp.float32],
):
    i = first + wp.tid()
    aim = sample_solid_angle(kind, axes, inverse, to_light, u[i])
    way[i] = aim.offset
    density[0, i] = aim.pdf
    if aim.pdf > 0.0:
        density[1, i] = solid_angle_pdf(kind, axes, inverse, to_light, wp.normalize(aim.offset))


@pytest.fixture(scope="module")
def aim(launcher):
    """Ways [n, 3] from the origin to a light, and the two densities [n], the light's axes being `axes`."""
    grid = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE)), axis=-1).reshape(-1, 2)
    u = ((grid + np.random.default_rng(1).random(grid.shape)) / SIDE).astype(np.float32).clip(max=1.0 - 2.0**-24)
    samples = launcher.array(u, wp.vec2)

    def aim(kind, axes, to_light):
        way, density = launcher.zeros(len(u), wp.vec3), launcher.zeros((2, len(u)), wp.float32)
        matrices = (wp.mat33(*m.astype(np.float32).ravel()) for m in (axes, np.linalg.inv(axes)))
        launcher.launch(_aim, len(u), [int(kind), *matrices, wp.vec3(*to_light.tolist()), samples, way, density])
        return way.numpy().astype(np.float64), *density.numpy().astype(np.float64)

    return aim


def element(kind, axes, u, v):
    """Points of a light at parameters [n, n], and how much area, times its normal, each stands for; float64."""
    unit = unit_shape(kind, u, v)
    normal = {LightKind.SPHERE: unit, LightKind.CYLINDER: unit * [0.0, 1.0, 1.0]}.get(kind, np.array([0.0, 0.0, 1.0]))
    area = {
        LightKind.RECT: 1.0,
        LightKind.DISK: 2.0 * np.pi * u,
        LightKind.SPHERE: 2.0 * np.pi**2 * np.sin(np.pi * u),
        LightKind.CYLINDER: 2.0 * np.pi,
    }[kind] / u.size
    # Nanson: an area and its normal change with the cofactors of the map.
    cofactors = np.linalg.inv(axes).T * abs(np.linalg.det(axes))
    return unit @ axes.T, np.broadcast_to(area, u.shape)[..., None] * (normal @ cofactors.T)


def above(kind, axes, distance, u=0.3, v=0.2):
    """A point at a distance from the emitting side of a light, over the place with parameters u and v."""
    place, area = (x[0, 0] for x in element(kind, axes, np.full((1, 1), u), np.full((1, 1), v)))
    return place + area / np.linalg.norm(area) * distance


def seen(kind, axes, to_light, n=1000):
    """∫ dω and ∫ ω dω over the emitting side that the origin sees, by the midpoint rule over the light's area."""
    u, v = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(n) + 0.5) / n, indexing="ij")
    places, areas = element(kind, axes, u, v)
    places = places + to_light
    distance = np.linalg.norm(places, axis=-1)
    solid = np.maximum(-np.sum(places * areas, axis=-1), 0.0) / distance**3
    return solid.sum(), np.sum(places / distance[..., None] * solid[..., None], axis=(0, 1))


def lamp(kind, size, sheared, seed):
    """Axes of a light of some size, turned at random; and a direction towards it that is not along any of them."""
    shapes = {LightKind.RECT: [1.0, 0.6], LightKind.DISK: [1.0, 1.0], LightKind.SPHERE: [0.7, 0.7, 0.7]}
    axes = np.diag([*shapes.get(kind, [2.0, 0.3, 0.3]), 1.0][:3])
    if sheared:
        axes = np.array([[1.2, 0.4, 0.1], [-0.1, 1.5, 0.2], [0.3, 0.0, 0.8]]) @ axes
    axes = Rotation.random(random_state=seed).as_matrix() @ axes
    if kind in (LightKind.RECT, LightKind.DISK):  # the third axis is as long as the unit of space, and the normal
        normal = np.cross(axes[:, 0], axes[:, 1])
        axes[:, 2] = normal / np.linalg.norm(normal)
    return axes * size


FLAT_AND_ROUND = [LightKind.RECT, LightKind.DISK, LightKind.SPHERE, LightKind.CYLINDER]


@pytest.mark.parametrize("sheared", [False, True])
@pytest.mark.parametrize("size", [1.0e-6, 1.0, 1.0e6])
@pytest.mark.parametrize("kind", FLAT_AND_ROUND, ids=lambda k: k.name)
def test_what_they_fill(kind, size, sheared, aim):
    """Means of 1/p and of ω/p are the light's solid angle and its first moment; p is known of a direction alone.

    From 0.05 of the light's size to 1000 of it. Of a jittered grid of N² samples a mean errs by about σ/N, σ being
    their spread, and σ/√N² at most; 1e-4 is for float32, and for the quadrature beside near lights.
    """
    axes = lamp(kind, size, sheared, seed=3)
    for distance in (0.05, 0.5, 5.0, 1000.0):
        aside = size * min(distance, 1.0) * np.array([0.3, -0.2, 0.4])
        to_light = -(above(kind, axes, distance * size) + aside)
        solid, moment = seen(kind, axes, to_light)
        assert solid > 0.0
        way, density, again = aim(kind, axes, to_light)
        hit = density > 0.0
        np.testing.assert_allclose(again[hit], density[hit], rtol=1e-4)
        weight = np.divide(1.0, density, out=np.zeros_like(density), where=hit)
        allowed = 4.0 * weight.std() / SIDE + 1.0e-4 * solid
        assert abs(weight.mean() - solid) < allowed
        direction = way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-300)
        assert np.abs((direction * weight[:, None]).mean(axis=0) - moment).max() < allowed


EVENNESS = {LightKind.RECT: 0.1, LightKind.DISK: 0.53, LightKind.SPHERE: 1.0e-5, LightKind.CYLINDER: 0.1}
"""Largest spread of 1/p, relative to its mean."""


@pytest.mark.parametrize("kind", FLAT_AND_ROUND, ids=lambda k: k.name)
def test_how_evenly(kind, aim):
    """Lights that are not sheared are sampled evenly per solid angle, as near as they may be.

    Spheres exactly; rectangles too unless they are far; cylinders nearly; disks in a part π/4 of the samples at least,
    the others falling beside them: √(4/π - 1) = 0.53.
    """
    axes = lamp(kind, 1.0, False, seed=5)
    for distance in (0.01, 0.1, 0.5, 3.0):
        to_light = -above(kind, axes, distance, 0.4)
        solid, _ = seen(kind, axes, to_light)
        _, density, _ = aim(kind, axes, to_light)
        spread = np.divide(1.0, density, out=np.zeros_like(density), where=density > 0.0).std() / solid
        assert spread < EVENNESS[kind]


@pytest.mark.parametrize("kind", FLAT_AND_ROUND, ids=lambda k: k.name)
def test_from_where_nothing_is_seen(kind, aim):
    """Behind a flat light, inside a round one, on its surface and in its plane: nothing, or all finite."""
    axes = lamp(kind, 1.0, False, seed=7)
    behind = axes @ np.array([0.1, 0.05, -0.5 if kind <= LightKind.DISK else 0.1])
    assert (aim(kind, axes, -behind)[1] == 0.0).all()
    for lift in (-1e-7, 0.0, 1e-7, 1e-6, 1e-5):
        way, density, again = aim(kind, axes, -above(kind, axes, lift))
        assert np.isfinite(way).all() and np.isfinite(density).all() and np.isfinite(again).all()
        assert (density >= 0.0).all() and (density[density > 0.0] > 1.0 / (4.0 * math.pi) / 10.0).all()
