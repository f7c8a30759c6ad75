"""Procedural scenes; most have a radiance that is known in closed form."""

import numpy as np

from warp_ir.scene import Camera, Color, Floats, Ints, Light, Material, Mesh, Projection, Scene


def quad(name: str, corners: object, material: int = 0, *, double_sided: bool = False) -> Mesh:
    """A quadrilateral with four corners [4, 3], counter-clockwise seen from its front."""
    return mesh(name, corners, [[0, 1, 2], [0, 2, 3]], material, double_sided=double_sided)


def mesh(name: str, points: object, triangles: object, material: int = 0, *, double_sided: bool = False) -> Mesh:
    """A mesh of one material from array-like points [n, 3] and triangles [m, 3]."""
    indices = np.asarray(triangles, np.int32).reshape(-1, 3)
    return Mesh(
        name,
        np.asarray(points, np.float64).reshape(-1, 3),
        indices,
        np.full(len(indices), material, np.int32),
        double_sided=double_sided,
    )


def cube(size: float = 2.0, *, inward: bool = False) -> tuple[Floats, Ints]:
    """Points [8, 3] and triangles [12, 3] of an axis-aligned cube around the origin with edges of length `size`."""
    points = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], np.float64) * (0.5 * size)
    quads = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])
    triangles = quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3).astype(np.int32)
    return points, triangles[:, ::-1].copy() if inward else triangles


def sphere(radius: float = 1.0, level: int = 4, *, inward: bool = False) -> tuple[Floats, Ints]:
    """Points and triangles of an octahedron subdivided `level` times, vertices on the sphere: 8·4^level triangles."""
    points = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    corners = points[faces]
    for _ in range(level):
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        ab, bc, ca = (m / np.linalg.norm(m, axis=1, keepdims=True) for m in (a + b, b + c, c + a))
        corners = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    points, indices = np.unique(corners.reshape(-1, 3).round(12), axis=0, return_inverse=True)
    triangles = indices.reshape(-1, 3).astype(np.int32)
    return points * radius, triangles[:, ::-1].copy() if inward else triangles


def furnace(albedo: float = 0.5, emission: float = 1.0, *, shape: str = "sphere", level: int = 4) -> Scene:
    """A furnace: a closed room with the same emission Le and albedo ρ everywhere, where L = Le / (1 - ρ)."""
    points, triangles = sphere(level=level, inward=True) if shape == "sphere" else cube(inward=True)
    return Scene(
        meshes=(mesh("furnace", points, triangles),),
        materials=(Material("wall", (albedo,) * 3, (emission,) * 3),),
        camera=Camera.look_at((0.2, 0.1, 0.3), (0.0, 0.0, -1.0), fov=70.0),
        name=f"{shape} furnace",
    )


def floor(light: Light, *, albedo: float = 1.0, size: float = 100.0, height: float = 1.0e-6) -> Scene:
    """A light over the plane y = 0 without interreflection: the image has L = ρ E / π, E the irradiance at the origin.

    The orthographic camera looks down from above with a window of width `height`, so that every pixel shows the origin.
    """
    s = 0.5 * size
    plane = quad("floor", [[-s, 0, s], [s, 0, s], [s, 0, -s], [-s, 0, -s]])
    from_above = np.array([[1, 0, 0, 0], [0, 0, 1, 1], [0, -1, 0, 0], [0, 0, 0, 1]], np.float64)
    h = 0.5 * height
    return Scene(
        meshes=(plane,),
        materials=(Material("floor", (albedo,) * 3),),
        lights=(light,),
        camera=Camera(world_from_camera=from_above, window=(-h, h, -h, h), projection=Projection.ORTHOGRAPHIC),
        name="floor",
    )


def cornell_box(*, light: Color = (17.0, 12.0, 4.0)) -> Scene:
    """The Cornell box in its published dimensions [mm], lit by an emissive surface.

    Cornell University Program of Computer Graphics, "Cornell Box Data"; reflectances as commonly rounded to RGB.
    """
    white, red, green = (0.725, 0.71, 0.68), (0.63, 0.065, 0.05), (0.14, 0.45, 0.091)
    materials = (
        Material("white", white),
        Material("red", red),
        Material("green", green),
        Material("light", (0.78, 0.78, 0.78), light),
    )
    short = [[130, 65], [82, 225], [240, 272], [290, 114]]
    tall = [[423, 247], [265, 296], [314, 456], [472, 406]]
    x, y, z = 556.0, 548.8, 559.2
    meshes = (
        quad("floor", [[x, 0, 0], [0, 0, 0], [0, 0, z], [x, 0, z]]),
        quad("ceiling", [[x, y, 0], [x, y, z], [0, y, z], [0, y, 0]]),
        quad("back", [[x, 0, z], [0, 0, z], [0, y, z], [x, y, z]]),
        quad("right", [[0, 0, z], [0, 0, 0], [0, y, 0], [0, y, z]], 2),
        quad("left", [[x, 0, 0], [x, 0, z], [x, y, z], [x, y, 0]], 1),
        quad("light", [[343, y - 0.5, 227], [343, y - 0.5, 332], [213, y - 0.5, 332], [213, y - 0.5, 227]], 3),
        *(_block(name, base, height) for name, base, height in (("short", short, 165.0), ("tall", tall, 330.0))),
    )
    eye, target = (278.0, 273.0, -800.0), (278.0, 273.0, 0.0)
    return Scene(meshes, materials, camera=Camera.look_at(eye, target, fov=39.3077), name="cornell box")


def _block(name: str, base: list[list[int]], height: float) -> Mesh:
    """A box of a given height over four points (x, z) of the floor, without its bottom face."""
    low = [[x, 0.0, z] for x, z in base]
    high = [[x, height, z] for x, z in base]
    quads = [[4, 5, 6, 7], *([(k + 1) % 4, (k + 1) % 4 + 4, k + 4, k] for k in range(4))]
    triangles = [[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)]
    return mesh(name, low + high, triangles)
