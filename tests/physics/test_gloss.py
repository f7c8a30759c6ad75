"""Surfaces that reflect by direction: closed forms, and quadrature of the formulas as their sources state them."""

import numpy as np
import pytest

import warp_ir as ir
from tests.physics.closed_form import assert_mean, render
from warp_ir.procedural import furnace, quad
from warp_ir.renderer import Renderer
from warp_ir.scene import Gloss, LightKind

WHITE = (1.0, 1.0, 1.0)
DOME = ir.Light(name="dome", kind=LightKind.DOME, radiance=WHITE)
pytestmark = pytest.mark.extended


def plane(gloss, view, light):
    """A plane y = 0 with a gloss under a light, seen from a unit direction with so long a lens that it is constant."""
    s = 50.0
    ground = quad("plane", [[-s, 0, s], [s, 0, s], [s, 0, -s], [-s, 0, -s]])
    camera = ir.Camera.look_at(tuple(2.0 * np.asarray(view)), (0, 0, 0), fov=0.01, up=(0, 0, 1))
    return ir.Scene((ground,), (ir.Material("plane", gloss=gloss),), lights=(light,), camera=camera)


def from_cosine(mu, azimuth=0.0):
    """A unit direction at a cosine to +Y."""
    r = np.sqrt(1.0 - mu * mu)
    return np.array([r * np.cos(azimuth), mu, r * np.sin(azimuth)])


def ggx(i, o, alpha, f0, f90):
    """The microfacet term D V F for unit directions [..., 3] with the normal +Y, from the definitions.

    D as in Walter 2007, equation 33; masking by height, Heitz 2014, equation 99.
    """
    h = i + o
    h = h / np.linalg.norm(h, axis=-1, keepdims=True)
    cosine = h[..., 1]
    tan_squared = (1.0 - cosine**2) / cosine**2
    d = alpha**2 / (np.pi * cosine**4 * (alpha**2 + tan_squared) ** 2)

    def lam(v):
        return 0.5 * (np.sqrt(1.0 + alpha**2 * (1.0 - v[..., 1] ** 2) / v[..., 1] ** 2) - 1.0)

    g = 1.0 / (1.0 + lam(i) + lam(o))
    f = f0 + (f90 - f0) * (1.0 - np.sum(h * o, axis=-1)) ** 5
    return d * g * f / (4.0 * i[..., 1] * o[..., 1])


def albedo(o, alpha, f0, f90, n=1500):
    """∫ D V F cosθi dωi, by the midpoint rule over the hemisphere, fine near the mirror direction and the horizon."""
    # In polar coordinates about the reflected view, whose radius is warped towards the peak.
    axis = np.array([-o[0], o[1], -o[2]])
    s, phi = np.meshgrid((np.arange(n) + 0.5) / n, 2 * np.pi * (np.arange(400) + 0.5) / 400, indexing="ij")
    theta, slope = np.pi * s**3, 3.0 * np.pi * s**2
    x = np.cross(axis, [0.0, 0.0, 1.0])
    x = x / np.linalg.norm(x)
    y = np.cross(axis, x)
    i = np.sin(theta)[..., None] * (np.cos(phi)[..., None] * x + np.sin(phi)[..., None] * y)
    i = i + np.cos(theta)[..., None] * axis
    above = i[..., 1] > 0.0
    i[~above] = [0.0, 1.0, 0.0]
    value = ggx(i, o, alpha, f0, f90) * i[..., 1] * np.sin(theta) * slope * above
    return float(value.sum() / n * 2 * np.pi / 400)


def test_the_quadrature_agrees_with_the_closed_form():
    """White metal of roughness 1 has the albedo 1 - ln 2 at normal incidence."""
    assert albedo(from_cosine(0.99999), 1.0, 1.0, 1.0) == pytest.approx(1.0 - np.log(2.0), abs=2e-4)


@pytest.mark.parametrize("mu", [0.999, 0.5, 0.1])
@pytest.mark.parametrize("roughness", [0.2, 0.5, 1.0])
def test_metal_under_a_white_dome_shows_its_albedo(roughness, mu, device):
    """Under a dome of radiance 1 a metal of reflectance 1 has the radiance E(μ)."""
    view = from_cosine(mu)
    film = render(plane(Gloss(WHITE, metallic=1.0, roughness=roughness), view, DOME), "path", device)
    assert_mean(film, albedo(view, roughness**2, 1.0, 1.0), bias=1e-3)  # of the quadrature


@pytest.mark.parametrize("mu", [0.999, 0.5, 0.1])
@pytest.mark.parametrize("roughness", [0.0, 0.3, 0.7])
def test_white_plastic_vanishes_in_a_white_dome(roughness, mu, device):
    """What the layer above does not reflect, a base of albedo 1 does: the surface has the radiance of the dome.

    The table of albedos is interpolated, linearly between 32 rows and columns, which costs up to 0.2 %.
    """
    film = render(plane(Gloss(WHITE, roughness=roughness), from_cosine(mu), DOME), "path", device)
    assert_mean(film, 1.0, bias=2e-3)


@pytest.mark.parametrize("mu", [0.999, 0.3])
@pytest.mark.parametrize("coat", [0.0, 0.4])
def test_a_clearcoat_creates_no_energy(coat, mu, device):
    """A coated white plastic reflects at most what arrives, and at least nine tenths near its normal."""
    gloss = Gloss(WHITE, roughness=0.5, clearcoat=1.0, clearcoat_roughness=coat)
    mean = float(render(plane(gloss, from_cosine(mu), DOME), "path", device).radiance().mean())
    assert 0.9 < mean < 1.003


@pytest.mark.parametrize("roughness", [0.1, 0.5, 1.0])
def test_sunlight_is_reflected_by_the_formula(roughness, device):
    """A sun of irradiance H across its rays is seen as f H cosθ, in every iteration."""
    towards_sun, view = from_cosine(0.7, 2.0), from_cosine(0.6, -0.5)
    axes = np.eye(4)
    z = towards_sun  # the light shines along its -Z
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    axes[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    sun = ir.Light(name="sun", kind=LightKind.DISTANT, radiance=WHITE, angle=0.0, world_from_light=axes)
    seen = [
        float(render(plane(gloss, view, sun), "path", device, iterations=2).radiance().mean())
        for gloss in (Gloss((0.0, 0.0, 0.0), specular_color=WHITE, roughness=roughness), None)
    ]
    # The Lambertian surface of albedo 0.18 shows 0.18 H cosθ / π.
    irradiance = seen[1] * np.pi / 0.18
    assert seen[0] == pytest.approx(irradiance * ggx(towards_sun, view, roughness**2, 1.0, 1.0), rel=1e-4)


@pytest.mark.parametrize("roughness", [0.08, 0.3, 0.8])
def test_an_area_light_is_reflected_as_the_quadrature_says(roughness, device):
    """Lights are sampled and met by chance: both together give ∫ f L cosθ dω, whichever is more likely."""
    view = from_cosine(0.6)
    matrix = np.eye(4)
    matrix[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # -Z down
    matrix[:3, 3] = [-1.2, 1.0, 0.1]
    lamp = ir.Light(name="lamp", kind=LightKind.RECT, radiance=WHITE, width=0.5, height=0.5, world_from_light=matrix)
    film = render(
        plane(Gloss((0.0, 0.0, 0.0), specular_color=(0.5,) * 3, roughness=roughness), view, lamp), "path", device
    )
    n = 800
    a, b = np.meshgrid(*[(np.arange(n) + 0.5) / n - 0.5] * 2, indexing="ij")
    p = np.stack([-1.2 + 0.5 * a, np.ones_like(a), 0.1 + 0.5 * b], axis=-1)
    squared = np.sum(p * p, axis=-1)
    i = p / np.sqrt(squared)[..., None]
    value = ggx(i, view, roughness**2, 0.5, 1.0) * i[..., 1] * i[..., 1] / squared
    assert_mean(film, float(value.mean()) * 0.25, bias=1e-3)


@pytest.mark.parametrize("roughness", [0.0, 0.02])
def test_a_room_of_mirrors_is_a_geometric_series(roughness, device):
    """Walls that emit Le and reflect R as a mirror have the radiance Le / (1 - R)."""
    scene = furnace(0.5, 1.0, shape="cube")
    gloss = Gloss((0.6,) * 3, metallic=1.0, roughness=roughness)
    mirrors = ir.Material("mirror", emission=WHITE, gloss=gloss)
    film = render(ir.Scene(scene.meshes, (mirrors,), camera=scene.camera), "path", device)
    assert_mean(film, 1.0 / (1.0 - 0.6))


def test_a_black_metal_is_black(device):
    """A metal reflects its base colour, at grazing incidence too."""
    film = render(plane(Gloss((0.0,) * 3, metallic=1.0), from_cosine(0.2), DOME), "path", device, iterations=4)
    assert film.radiance().max() == 0.0


def test_a_mirror_shows_what_a_camera_behind_it_would_see(device):
    """A perfect mirror shows a lamp and its surroundings without noise, in the colours of its reflectance."""
    view = from_cosine(0.6)
    film = render(plane(Gloss((1.0, 0.5, 0.25), metallic=1.0, roughness=0.0), view, DOME), "path", device)
    expected = np.broadcast_to(np.float32([1.0, 0.5, 0.25]), film.radiance().shape)
    np.testing.assert_allclose(film.radiance(), expected, rtol=2e-3)


def test_estimators_without_gloss_refuse_it(device):
    """VPLs reflect diffusely: a picture without the gloss would be another scene's."""
    scene = plane(Gloss(), from_cosine(0.5), DOME)
    with pytest.raises(ir.InputError, match="estimator: vpl reflects diffusely"):
        Renderer(scene, ir.RenderSettings(width=4), device=device)
