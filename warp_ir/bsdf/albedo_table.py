"""What rough microfacets reflect in all directions together, by the cosine of the view and by roughness.

With the Fresnel factor F0 + (F90 - F0)(1 - x)⁵ that is E = F0 A + F90 B: A and B depend on the distribution alone.
"""

from functools import cache

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher

wp.set_module_options({"enable_backward": False})

SIZE = 32
"""Rows (roughness from 0 to 1) and columns (square root of the cosine from 0 to 1) of the table."""
MIRROR_ALPHA = 1.0e-3
"""Microfacets with a smaller α reflect like a mirror."""
_TURN, _HEIGHT = 24, 96  # points of the quadrature
_SIZE = wp.constant(SIZE)


@wp.struct
class AlbedoTable:
    """A and B for each view, and their means over all views."""

    by_view: wp.array2d[wp.vec2]  # [roughness, √cosine]
    mean: wp.array[wp.vec2]  # [roughness], ∫ 2μ (A, B) dμ


@wp.func
def albedo_terms(table: AlbedoTable, cosine: float, alpha: float) -> wp.vec2:
    """A and B for the cosine of a view, interpolated."""
    x = wp.sqrt(wp.clamp(cosine, 0.0, 1.0)) * float(_SIZE - 1)
    y = wp.sqrt(wp.clamp(alpha, 0.0, 1.0)) * float(_SIZE - 1)
    column = wp.min(int(x), _SIZE - 2)
    row = wp.min(int(y), _SIZE - 2)
    fx = x - float(column)
    fy = y - float(row)
    low = table.by_view[row, column] * (1.0 - fx) + table.by_view[row, column + 1] * fx
    high = table.by_view[row + 1, column] * (1.0 - fx) + table.by_view[row + 1, column + 1] * fx
    return low * (1.0 - fy) + high * fy


@wp.func
def mean_albedo_terms(table: AlbedoTable, alpha: float) -> wp.vec2:
    """∫ 2μ (A, B) dμ of `albedo_terms`."""
    y = wp.sqrt(wp.clamp(alpha, 0.0, 1.0)) * float(_SIZE - 1)
    row = wp.min(int(y), _SIZE - 2)
    fy = y - float(row)
    return table.mean[row] * (1.0 - fy) + table.mean[row + 1] * fy


@cache
def albedo_table() -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """A and B [roughness, √cosine, 2], and their means [roughness, 2].

    By quadrature over visible normals, of which each weighs G₂/G₁ (the factor of a reflected ray, Heitz 2018).
    """
    nodes = np.linspace(0.0, 1.0, SIZE)
    terms = np.array([[_terms(max(root * root, 1.0e-6), roughness**2) for root in nodes] for roughness in nodes])
    # Of the function that is interpolated between the nodes t = √μ: exact for 4 t³ times a line, by three points.
    points, weights = np.polynomial.legendre.leggauss(3)
    mean = np.zeros((SIZE, 2))
    for column in range(SIZE - 1):
        for point, weight in zip(0.5 * points + 0.5, 0.5 * weights, strict=True):
            t = (column + point) / (SIZE - 1)
            value = terms[:, column] * (1.0 - point) + terms[:, column + 1] * point
            mean += weight / (SIZE - 1) * 4.0 * t**3 * value
    return terms, mean


def _terms(mu: float, alpha: float) -> tuple[float, float]:
    """A and B for the cosine of a view."""
    if alpha < MIRROR_ALPHA:
        return 1.0 - (1.0 - mu) ** 5, (1.0 - mu) ** 5
    # Half of the turn: the other is its mirror image. The long tail of normals lies where z is least.
    phi = np.pi * (np.arange(_TURN) + 0.5)[:, None] / _TURN
    s = (np.arange(_HEIGHT) + 0.5)[None, :] / _HEIGHT
    area = 2.0 * s / (_TURN * _HEIGHT)
    o = np.array([np.sqrt(1.0 - mu * mu), 0.0, mu])
    wide = o * [alpha, alpha, 1.0]
    wide /= np.linalg.norm(wide)
    z = s * s * (1.0 + wide[2]) - wide[2]
    r = np.sqrt(np.clip(1.0 - z * z, 0.0, 1.0))
    h = np.stack([r * np.cos(phi), r * np.sin(phi), np.broadcast_to(z, (_TURN, _HEIGHT))], axis=-1) + wide
    h *= [alpha, alpha, 1.0]
    h /= np.linalg.norm(h, axis=-1, keepdims=True)
    x = h @ o
    mu_i = 2.0 * x * h[..., 2] - mu
    root_o, root_i = (np.sqrt(alpha**2 + (1.0 - alpha**2) * m * m) for m in (mu, mu_i))
    weight = np.where(mu_i > 0.0, mu_i * (mu + root_o) / np.maximum(mu_i * root_o + mu * root_i, 1.0e-300), 0.0) * area
    schlick = np.clip(1.0 - x, 0.0, 1.0) ** 5
    return float(np.sum(weight * (1.0 - schlick))), float(np.sum(weight * schlick))


def upload_albedo_table(launcher: Launcher) -> AlbedoTable:
    """The table on a device."""
    terms, mean = albedo_table()
    table = AlbedoTable()
    table.by_view = launcher.array(terms, wp.vec2)
    table.mean = launcher.array(mean, wp.vec2)
    return table
