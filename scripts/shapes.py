"""Shapes of the test scenes: points, float64 [n, 3], and faces, which are sequences of point indices."""

import numpy as np

BOX_FACES = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
"""The faces -x, +x, -y, +y, -z, +z of the corners that `box_points` returns, counter-clockwise seen from outside."""


def box_points(lower, upper):
    """The eight corners of a box, float64 [8, 3]; z varies fastest."""
    return np.stack(np.meshgrid(*zip(lower, upper, strict=True), indexing="ij"), axis=-1).reshape(8, 3)


def _grid_faces(rows, columns, wrap_rows=False):
    """Quads of a grid of points [rows, columns] that is closed along its columns, and along its rows if `wrap_rows`."""
    i = np.arange(rows if wrap_rows else rows - 1)[:, None]
    j = np.arange(columns)[None, :]
    index = [((i + a) % rows) * columns + (j + b) % columns for a, b in ((0, 0), (0, 1), (1, 1), (1, 0))]
    return np.stack(index, axis=-1).reshape(-1, 4)


def unit_sphere(rows, columns):
    """A closed unit sphere with poles on the Y axis: points, and faces with their front outside."""
    theta = np.pi * np.arange(1, rows) / rows
    phi = 2.0 * np.pi * np.arange(columns) / columns
    ring = np.stack([np.cos(phi), np.zeros(columns), -np.sin(phi)], axis=-1)
    rings = np.sin(theta)[:, None, None] * ring + np.cos(theta)[:, None, None] * (0.0, 1.0, 0.0)
    points = np.concatenate([rings.reshape(-1, 3), [(0.0, 1.0, 0.0), (0.0, -1.0, 0.0)]])
    top, last = len(points) - 2, (rows - 2) * columns
    faces = [tuple(face) for face in _grid_faces(rows - 1, columns)[:, ::-1].tolist()]
    for j in range(columns):
        k = (j + 1) % columns
        faces += [(top, j, k), (top + 1, last + k, last + j)]
    return points, faces


def boulder(rows=18, columns=36):
    """An irregular sphere that stands on y = 0."""
    points, faces = unit_sphere(rows, columns)
    x, y, z = points.T
    bumps = np.sin(5 * x + 1) * np.sin(4 * y + 2) * np.sin(6 * z) + 0.5 * np.sin(11 * x) * np.sin(9 * y + 1)
    points = points * (1.0 + 0.16 * bumps)[:, None] * (0.28, 0.24, 0.28)
    return points - (0.0, points[:, 1].min(), 0.0), faces


def vase(rows=20, columns=40):
    """A fluted vase that stands on y = 0, a closed surface with a narrow neck."""
    points, faces = unit_sphere(rows, columns)
    height = 0.5 - 0.5 * points[:, 1]
    angle = np.arctan2(points[:, 2], points[:, 0])
    radius = 0.16 + 0.07 * np.sin(2 * np.pi * (height * 1.1 + 0.45)) + 0.008 * np.cos(10 * angle + 6 * height)
    rim = np.hypot(points[:, 0], points[:, 2]) > 1e-9
    points = np.stack([rim * radius * np.cos(angle), 0.62 * (1.0 - height), rim * radius * np.sin(angle)], axis=-1)
    return points, faces


def knot(rows=96, columns=9, tube=0.075):
    """A trefoil knot that stands on y = 0: points, faces and smooth normals."""
    t = 2.0 * np.pi * np.arange(rows) / rows

    def curve(t):
        ring = 2.0 + np.cos(3 * t)
        return 0.11 * np.stack([ring * np.cos(2 * t), ring * np.sin(2 * t), 1.5 * np.sin(3 * t)], axis=-1)

    tangent = curve(t + 1e-4) - curve(t - 1e-4)
    side = np.cross(tangent, (0.0, 0.0, 1.0))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, tangent)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    phi = 2.0 * np.pi * np.arange(columns) / columns
    normals = np.cos(phi)[None, :, None] * side[:, None] + np.sin(phi)[None, :, None] * up[:, None]
    points = (curve(t)[:, None] + tube * normals).reshape(-1, 3)
    return points - (0.0, points[:, 1].min(), 0.0), _grid_faces(rows, columns, True)[:, ::-1], normals.reshape(-1, 3)


def chair():
    """A chair of six boxes that stands on y = 0 and faces +z."""
    parts = [((-0.2, 0.42, -0.2), (0.2, 0.46, 0.2)), ((-0.2, 0.6, -0.2), (0.2, 0.95, -0.16))]
    parts += [((x, 0.0, z), (x + 0.04, 0.42 if z > 0 else 0.6, z + 0.04)) for x in (-0.2, 0.16) for z in (-0.2, 0.16)]
    points = np.concatenate([box_points(*part) for part in parts])
    return points, np.concatenate([BOX_FACES + 8 * k for k in range(len(parts))])
