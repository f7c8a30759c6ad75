"""The shaping of lights on the host: its frame and validation, and integrals over it by quadrature."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from warp_ir.sampling.distribution2d import cell_means, row_areas
from warp_ir.scene import Floats, InputError, Light, MeshLight, Shaping

_PHOTON_ROWS = 1024
"""Rows of the distribution from which the photons of a shaped light take their directions."""
_MIN_RAMP = 0.05
"""Smallest `approximate_shaping` within the cone of a shaped light: dim directions are still sampled now and then."""


@dataclass(frozen=True)
class EmissionIntegrals:
    """Integrals of a shaping factor f over the directions of emission."""

    weights: npt.NDArray[np.float64]
    """Relative probabilities of the cells of a distribution over directions, [rows, columns]."""
    max_theta: float
    """Polar angle that the distribution covers [rad]."""
    power: float
    """Emitted power relative to that of the same light unshaped."""
    second_moment: float
    """4π ∫f² / (∫f)²: E[w²]/E[w]² of the weights of photons whose directions are sampled as if unshaped."""


@dataclass(frozen=True)
class Ramp:
    """A clamped linear function of the cosine to the axis that approximates a shaping factor."""

    slope: float = 0.0
    offset: float = 1.0
    minimum: float = 1.0
    cutoff_cosine: float = -2.0
    """Cosine to the axis below which the factor is 0."""


def shaping_frame(light: Light | MeshLight) -> npt.NDArray[np.float64]:
    """An orthonormal frame in the world, whatever the light's scale and shear.

    Returns:
        float64 [3, 3], rows: the light's X, its Y, and its -Z, the axis of the shaping.
    """
    linear = light.world_from_light[:3, :3].astype(np.float64)
    axis = -linear[:, 2]
    if not np.linalg.norm(axis) > 0.0:
        axis = -np.cross(linear[:, 0], linear[:, 1])
    if not np.linalg.norm(axis) > 0.0:
        axis = np.array([0.0, 0.0, -1.0])
    axis = axis / np.linalg.norm(axis)
    x = linear[:, 0] - axis * (axis @ linear[:, 0])
    if not np.linalg.norm(x) > 1.0e-12 * np.linalg.norm(linear):
        x = np.eye(3)[int(np.argmin(np.abs(axis)))]
        x = x - axis * (axis @ x)
    x = x / np.linalg.norm(x)
    y = np.cross(x, axis)  # X, Y and -axis are right-handed, as the light's own axes are ...
    return np.stack([x, y if y @ linear[:, 1] >= 0.0 else -y, axis])  # ... unless it is mirrored


def shaping_axis(light: Light | MeshLight) -> npt.NDArray[np.float64]:
    """The unit axis of a light's shaping in the world, [3]."""
    return np.asarray(shaping_frame(light)[2])


def check_shaping(name: str, shaping: Shaping) -> None:
    """Raises an `InputError` that names the light if a value is not usable."""
    numbers = (shaping.cone_angle, shaping.cone_softness, shaping.focus, *shaping.focus_tint)
    if not all(0.0 <= x < math.inf for x in numbers) or shaping.cone_softness > 1.0:
        raise InputError(f"{name}: shaping must be finite and not negative, softness at most 1, is {shaping}")
    profile = shaping.profile
    if profile is not None and not (profile.ndim == 2 and profile.size and np.isfinite(profile).all()):
        raise InputError(f"{name}: a profile must be a finite table [rows, columns]")
    if profile is not None and profile.min() < 0.0:
        raise InputError(f"{name}: a profile must not be negative")


def shaped_power(light: MeshLight, normals: Floats, *, double_sided: bool) -> npt.NDArray[np.float64]:
    """Approximates the factor by which shaping changes the power of surfaces; positive for every one that may emit.

    Args:
        light: The light of the surfaces.
        normals: Unit normals of the surfaces, [n, 3].
        double_sided: Whether they emit from both sides.

    Returns:
        float64 [n], power relative to that of the same surfaces unshaped.
    """
    shaping = light.shaping
    if shaping is None:
        return np.ones(len(normals))
    edge = math.radians(min(shaping.cone_angle, 180.0))
    theta = edge * (np.arange(512) + 0.5) / 512.0
    factor = _mean_factor(shaping, theta).mean(axis=1)
    factor = factor * (1.0 if shaping.profile is None else float(shaping.profile.max()))
    # The cosine to the normal of a surface tilted by β, integrated over the azimuth at angle θ: ∫ (a + b cosφ)⁺ dφ.
    tilt = np.linspace(0.0, math.pi, 129)
    a, b = np.cos(theta) * np.cos(tilt)[:, None], np.sin(theta) * np.sin(tilt)[:, None]
    half = np.arccos(np.clip(-a / np.maximum(b, 1.0e-12), -1.0, 1.0))
    power = (2.0 * (a * half + b * np.sin(half)).clip(0.0) * factor) @ (np.sin(theta) * edge / 512.0) / math.pi
    if double_sided:
        power = 0.5 * (power + power[::-1])
    angle = np.arccos(np.clip(normals @ shaping_axis(light), -1.0, 1.0))
    return np.asarray(np.interp(angle, tilt, np.maximum(power, _MIN_RAMP * power.max())))


def integrate_emission(shaping: Shaping, *, cosine: bool) -> EmissionIntegrals:
    """Integrates the factor of a shaping, its profile divided by its maximum, over all directions.

    Args:
        shaping: The shaping of the light.
        cosine: Whether directions are weighted by their cosine to the axis (a flat light) or equally.
    """
    theta = math.radians(min(shaping.cone_angle, 180.0))
    if cosine:
        theta = min(theta, 0.5 * math.pi)
    theta = max(theta, 1.0e-6)
    columns = 1 if shaping.profile is None else shaping.profile.shape[1]
    points = 4  # quadrature points per row of a cell: enough that no cell that emits has weight 0
    angle = theta * (np.arange(points * _PHOTON_ROWS) + 0.5) / (points * _PHOTON_ROWS)
    factor = _mean_factor(shaping, angle)  # [points · rows, columns]
    if cosine:
        factor = factor * np.cos(angle)[:, None]
    area = row_areas(points * _PHOTON_ROWS, theta)[:, None] / columns
    integral, square_integral = float((factor * area).sum()), float((factor**2 * area).sum())
    weights = (factor * area).reshape(_PHOTON_ROWS, points, columns).sum(axis=1)
    if columns > 1:  # interpolation extends a column into its neighbours
        weights = cell_means(weights, periodic=True)
    unshaped = math.pi if cosine else 4.0 * math.pi
    second_moment = 4.0 * math.pi * square_integral / max(integral, 1.0e-30) ** 2
    return EmissionIntegrals(weights, theta, integral / unshaped, second_moment)


def fit_ramp(shaping: Shaping | None) -> Ramp:
    """Fits a ramp over the cosine to the axis to the shaping factor.

    If the factor decreases from the axis outwards, the ramp passes through 3/4 and 1/4 where the factor does; otherwise
    it is constant. An error of a factor of 2 in a resampling weight costs little variance.
    """
    if shaping is None:
        return Ramp()
    angle = math.radians(min(shaping.cone_angle, 180.0)) * np.arange(4097) / 4096.0
    factor = _mean_factor(shaping, angle).max(axis=1)
    positive = np.nonzero(factor > 0.0)[0]
    margin = angle[1] + (0.0 if shaping.profile is None else math.pi / len(shaping.profile))
    end = min(float(angle[positive[-1]]) + margin, math.pi) if len(positive) else 0.0
    cutoff = math.cos(end) - 4.0e-6 if end < math.pi else -2.0
    factor = factor / max(float(factor.max()), 1.0e-30)
    if factor[0] < 0.75 or factor.min() >= 0.75:
        return Ramp(cutoff_cosine=cutoff)
    high = math.cos(angle[np.argmax(factor < 0.75)])
    low = math.cos(angle[np.argmax(factor < 0.25)] if factor.min() < 0.25 else angle[-1])
    slope = 0.5 / max(high - low, 1.0e-6)
    return Ramp(slope, 0.75 - slope * high, _MIN_RAMP, cutoff)


def _mean_factor(shaping: Shaping, angle: Floats) -> npt.NDArray[np.float64]:
    """Mean over the channels of the factor at polar angles [n] and the profile's columns; float64 [n, columns].

    The profile is divided by its maximum.
    """
    edge = math.radians(min(shaping.cone_angle, 180.0))
    fade = edge * (1.0 - shaping.cone_softness)
    t = np.clip((angle - fade) / max(edge - fade, 1.0e-12), 0.0, 1.0)
    factor = (
        np.where(angle > fade, 1.0 - t * t * (3.0 - 2.0 * t), 1.0) if shaping.cone_softness else np.ones(len(angle))
    )
    if shaping.focus > 0.0:
        f = np.abs(np.cos(angle)) ** shaping.focus
        factor = factor * (f + (1.0 - f) * float(np.mean(shaping.focus_tint)))
    if shaping.profile is None:
        return factor[:, None]
    rows = len(shaping.profile)
    position = np.clip(angle / math.pi * rows - 0.5, 0.0, rows - 1.0)
    low = np.minimum(position.astype(int), rows - 1)
    high = np.minimum(low + 1, rows - 1)
    fraction = (position - low)[:, None]
    table = shaping.profile / max(float(shaping.profile.max()), 1.0e-30)
    return np.asarray(factor[:, None] * (table[low] * (1.0 - fraction) + table[high] * fraction))
