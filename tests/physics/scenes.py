"""Scenes, and parts of them, in which several tests of light are set."""

import dataclasses
import math

import numpy as np

import warp_ir as ir
from tests.physics.closed_form import placed, render, rotation_x
from warp_ir.procedural import cornell_box, cube, floor, mesh, quad, sphere
from warp_ir.scene import LightKind, Shaping

DOWN = rotation_x(-90.0)  # takes the light's -Z to the world's -Y
TILTED = rotation_x(-70.0)
SQUEEZED = np.diag([1.5, 1.0, 0.5])
SHAPINGS = [
    Shaping(cone_angle=40.0, cone_softness=0.8),
    Shaping(cone_angle=90.0, focus=8.0),
    Shaping(focus=3.0, focus_tint=(0.25,) * 3),
    Shaping(cone_angle=35.0),
]
LAMP = ir.Light("lamp", LightKind.RECT, (4.0,) * 3, placed(DOWN, (0.2, 2.5, 0.1)), width=0.6, height=0.6)
BLACK_GLOW = ir.Material("glow", (0.0,) * 3, (3.0,) * 3)


def towards(direction):
    """world_from_light of a light whose light comes from a direction."""
    back = np.array(direction, dtype=float) / np.linalg.norm(direction)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = right, np.cross(back, right), back
    return matrix


def over_floor(light, estimator, device, **settings):
    return render(floor(light), estimator, device, **(dict(max_bounces=0, light_paths=1024) | settings))


def ball_over_floor(light):
    """A floor with a ball on it, seen from the side; meshes 0 and 1."""
    points, triangles = sphere(0.4, level=3)
    ground = quad("ground", [(-5, 0, 5), (5, 0, 5), (5, 0, -5), (-5, 0, -5)])
    return ir.Scene(
        meshes=(ground, mesh("ball", points + np.array([0.0, 0.6, 0.0]), triangles)),
        materials=(ir.Material("white", (0.8,) * 3),),
        lights=(light,),
        camera=ir.Camera.look_at((0.0, 2.5, 3.0), (0.0, 0.0, 0.0)),
    )


def shadow_of_ball(shadowed, free):
    """A mask of the ground's pixels whose light the ball of `ball_over_floor` takes, but none on the ball's edge."""
    ground = shadowed.aov("prim_id") == 0
    inside = ground.copy()
    for rows in (-1, 0, 1):
        for columns in (-1, 0, 1):
            inside &= np.roll(ground, (rows, columns), (0, 1))
    under = inside & (shadowed.radiance()[..., 0] < 0.5 * free.radiance()[..., 0])
    assert under.sum() >= 10
    return under


def pixels(film, which):
    return film.radiance()[which].mean(), film.standard_error()[which].mean()


def ball(around=12, down=8, radius=1.0, center=(0.0, 0.0, 0.0)):
    """A sphere of few triangles, with its own normals at their corners."""
    longitude = 2 * np.pi * (np.arange(around) + 0.5) / around
    latitude = np.pi * np.arange(down + 1) / down
    ring = np.stack([np.cos(longitude), 0 * longitude, np.sin(longitude)], axis=1)
    points = (np.sin(latitude)[:, None, None] * ring + np.cos(latitude)[:, None, None] * [0, 1, 0]).reshape(-1, 3)
    i, j = np.arange(around), (np.arange(around) + 1) % around
    rows = around * np.arange(down)[:, None]
    upper = np.stack([rows + i, rows + j, rows + around + j], axis=-1)[1:].reshape(-1, 3)
    lower = np.stack([rows + i, rows + around + j, rows + around + i], axis=-1)[:-1].reshape(-1, 3)
    triangles = np.concatenate([upper, lower]).astype(np.int32)
    normals = points[triangles].astype(np.float32)
    material = np.zeros(len(triangles), dtype=np.int32)
    return ir.Mesh("ball", radius * points + np.array(center), triangles, material, normals)


def lamp_profile(rows=180, columns=8):
    """A profile with a dark sector, in candela-like numbers: 100 (1 + cos 2θ) down to 120°, times 1 or 1/4 around."""
    theta = np.pi * (np.arange(rows) + 0.5) / rows
    around = np.where(np.arange(columns) < columns // 2, 1.0, 0.25)
    return (100.0 * (1.0 + np.cos(2.0 * theta)) * (theta < math.radians(120.0)))[:, None] * around


def sky_texture():
    """A gradient, a black patch, and a sun of 2000 times its brightness in one texel."""
    texture = np.linspace(1.0, 0.2, 16)[:, None] * np.linspace(1.0, 2.0, 32)[None, :]
    texture[9:, 4:20] = 0.0
    texture[4, 11] = 2000.0
    return texture


def box_with_lights():
    """A Cornell box with an analytic light of each kind beside its emissive surface."""
    scene = cornell_box()
    lights = []
    for k, kind in enumerate(LightKind):
        matrix = np.eye(4)
        matrix[:3, 3] = (100.0 + 50.0 * k, 400.0, 250.0)
        strength = 1.0e4 if kind == LightKind.POINT else 0.3
        lights.append(ir.Light(kind.name, kind, (strength,) * 3, matrix, 40.0, 30.0, 15.0, 40.0, 30.0))
    return dataclasses.replace(scene, lights=tuple(lights))


def everything():
    """A room with every kind of light, and all that can be asked of them."""
    points, triangles = sphere(0.5, level=2)
    ball = mesh("ball", points + np.array([0.7, -1.0, 0.3]), triangles)
    shade = quad("shade", [(-1.2, 0.9, -0.6), (-0.2, 0.9, -0.6), (-0.2, 0.9, 0.4), (-1.2, 0.9, 0.4)])
    texture = np.random.default_rng(1).random((5, 7, 3)).astype(np.float32) ** 4
    sky = np.repeat(sky_texture()[:, :, None], 3, axis=2).astype(np.float32)
    lights = (
        ir.Light("a", LightKind.RECT, (6.0, 4.0, 2.0), placed(DOWN, (-0.7, 1.5, 0.0)), width=0.8, height=0.5,
                 texture=texture, shadowless=frozenset({2})),
        ir.Light("b", LightKind.SPHERE, (8.0, 8.0, 9.0), placed(TILTED, (1.0, 1.2, -0.8)), radius=0.15,
                 shaping=Shaping(cone_angle=50.0, cone_softness=0.5, focus=1.0, focus_tint=(0.5, 0.1, 0.0))),
        ir.Light("c", LightKind.DISK, (9.0, 2.0, 2.0), placed(rotation_x(20.0), (0.0, 0.0, 1.5)), radius=0.2,
                 shaping=Shaping(cone_angle=25.0), unlit=frozenset({1})),
        ir.Light("d", LightKind.POINT, (0.004,) * 3, placed(DOWN, (-1.5, 0.4, 1.0)),
                 shaping=Shaping(profile=lamp_profile())),
        ir.Light("e", LightKind.CYLINDER, (3.0, 3.0, 1.0), placed(SQUEEZED, (0.5, -1.8, -1.2)), length=1.0, radius=0.05,
                 shadows=False),
        ir.Light("f", LightKind.DOME, (0.05,) * 3, texture=sky),
        ir.Light("g", LightKind.DISTANT, (30.0,) * 3, placed(rotation_x(-50.0), (0, 0, 0)), angle=5.0),
    )  # fmt: skip
    # Open towards +z, where the sky looks in.
    points, triangles = cube(4.0, inward=True)
    normals = np.cross(
        points[triangles][:, 1] - points[triangles][:, 0], points[triangles][:, 2] - points[triangles][:, 0]
    )
    walls = mesh("walls", points, triangles[normals[:, 2] > -1e-6])
    camera = ir.Camera.look_at((0.1, 0.2, 3.5), (0.0, 0.0, 0.0), fov=60.0)
    materials = (ir.Material("wall", (0.7, 0.6, 0.5)),)
    return ir.Scene((walls, ball, shade), materials, lights, camera)


def panel(light, k=0, *, double_sided=False, **control):
    """The rectangle of a RECT light as two triangles of material k, with the light's controls."""
    x, y = 0.5 * light.width, 0.5 * light.height
    corners = np.array([(-x, -y, 0), (-x, y, 0), (x, y, 0), (x, -y, 0)])  # counter-clockwise seen from -Z
    points = corners @ light.world_from_light[:3, :3].T + light.world_from_light[:3, 3]
    own = dict(shaping=light.shaping, shadows=light.shadows, unlit=light.unlit, shadowless=light.shadowless)
    out = quad(light.name, points)
    return dataclasses.replace(
        out,
        material=np.full(2, k, np.int32),
        double_sided=double_sided,
        light=ir.MeshLight(light.name, light.world_from_light, **(own | control)),
    )


def with_panel(scene, *lights, material=BLACK_GLOW):
    """The scene without its lights, and with panels in their places as its last meshes."""
    panels = tuple(panel(light, len(scene.materials)) for light in lights)
    materials = (*scene.materials, material)
    return dataclasses.replace(scene, meshes=(*scene.meshes, *panels), materials=materials, lights=())


def glowing_room():
    """A room that only surfaces light, with all that can be asked of them; one of them stands in a corner."""
    points, triangles = sphere(0.5, level=2)
    ball = mesh("ball", points + np.array([0.7, -1.0, 0.3]), triangles)
    shade = quad("shade", [(-1.2, 0.9, -0.6), (-0.2, 0.9, -0.6), (-0.2, 0.9, 0.4), (-1.2, 0.9, 0.4)])
    points, triangles = cube(4.0, inward=True)
    walls = mesh("walls", points, triangles)
    spot = Shaping(cone_angle=50.0, cone_softness=0.5, focus=1.0, focus_tint=(0.5, 0.1, 0.0))
    lamps = [
        (ir.Light("a", LightKind.RECT, (1.0,) * 3, placed(DOWN, (-0.7, 1.5, 0.0)), width=0.8, height=0.5,
                  shadowless=frozenset({2})), {}),
        (ir.Light("c", LightKind.RECT, (1.0,) * 3, placed(rotation_x(20.0), (0.0, 0.0, 1.5)), width=0.4, height=0.3,
                  shaping=Shaping(cone_angle=25.0), unlit=frozenset({1})), {}),
        (ir.Light("e", LightKind.RECT, (1.0,) * 3, placed(rotation_x(-120.0), (1.9, -1.3, -1.2)), width=0.6, height=0.3,
                  shadows=False), dict(double_sided=True)),
    ]  # fmt: skip
    panels = [panel(light, 1 + k, **how) for k, (light, how) in enumerate(lamps)]
    points, triangles = sphere(0.15, level=2)
    bulb = mesh("bulb", points + np.array([1.0, 1.2, -0.8]), triangles, material=4)
    bulb = dataclasses.replace(bulb, light=ir.MeshLight("bulb", placed(TILTED, (1.0, 1.2, -0.8)), spot))
    sky = np.repeat(sky_texture()[:, :, None], 3, axis=2).astype(np.float32)
    materials = (
        ir.Material("wall", (0.7, 0.6, 0.5)),
        ir.Material("a", (0.5,) * 3, (6.0, 4.0, 2.0)),
        ir.Material("c", (0.0,) * 3, (20.0, 4.0, 4.0), glow=(1.0, 1.0, 1.0)),
        ir.Material("e", (0.3,) * 3, (3.0, 3.0, 1.0)),
        ir.Material("bulb", (0.0,) * 3, (16.0, 16.0, 18.0)),
    )
    return ir.Scene(
        (walls, ball, shade, *panels, bulb),
        materials,
        (ir.Light("f", LightKind.DOME, (0.05,) * 3, texture=sky),),
        ir.Camera.look_at((0.1, 0.2, 1.9), (0.0, 0.0, 0.0), fov=75.0),
    )
