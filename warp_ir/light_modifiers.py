"""What UsdLux adds to the physics of a light: shaping of its emission, links, and shadows that are not cast.

Only lights that ask for any of it have a `LightModifiers`; a scene without one pays a comparison.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.sampling.distribution2d import (
    Distribution2DList,
    Distribution2DTables,
    cell_means,
    cell_measure,
    value_along,
)
from warp_ir.scene import InputError, Light, LightKind, Mesh, MeshLight, Shaping

wp.set_module_options({"enable_backward": False})

_BANDS = 1024
"""Rows of the table from which the photons of a shaped light take their directions."""
_LEAST = 0.05
"""Smallest `approximate_shaping` in the support of a shaped light: what is dim there is found now and then."""
_ALONG = 0.999999
"""Cosine to the axis of shaping above which a flat light faces along it."""
_SPHERE_WASTE = 8.0 / 3.0
"""E[w²]/E[w]² of photons w = cos⁺θ that leave a sphere in a direction chosen apart from the place: (1/6) / (1/4)²."""


@wp.struct
class LightModifiers:
    """One light's."""

    frame: wp.mat33  # rows: the light's +X, +Y and the axis of shaping, its -Z
    shaped: int  # 0: the factor is 1
    fade: float  # polar angle at which a soft cone begins to fade [rad]
    edge: float  # and at which it is dark
    focus: float
    tint: wp.vec3
    profile: int  # grid of factors; -1: none
    photons: int  # grid of directions; -1: photons leave as from an unshaped light, with the factor as a weight
    slope: float  # how `approximate_shaping` goes with the cosine to the axis
    offset: float
    least: float
    cutoff: float  # cosine to the axis below which the light is dark
    shadows: int  # 0: its direct light has none
    unlit: int  # row of the link table that tells which meshes it does not light; -1: it lights all
    shadowless: int  # row that tells which meshes its light passes through; -1: none


@wp.struct
class LightModifierTables:
    """All controls of a scene."""

    count: int
    shaped_count: int  # of them with a shaping
    of_light: wp.array[wp.int32]  # [lights], row of `rows` or -1
    surface_count: int  # meshes with a control
    of_mesh: wp.array[wp.int32]  # [meshes], likewise; one row if none has any
    rows: wp.array[LightModifiers]
    meshes: int
    links: wp.array[wp.int32]  # [link rows x meshes], 1: the mesh is in the set
    sampled_count: int  # lights with an area that see other surfaces than rays do
    sampled: wp.array[wp.int32]  # those lights
    sampled_surfaces: int  # meshes that do, and emit


@wp.func(inline=False)
def shaping_factor(modifiers: LightModifiers, distributions: Distribution2DTables, direction: wp.vec3) -> wp.vec3:
    """Factor of the radiance that a light emits along a unit direction."""
    out = wp.vec3(1.0)
    if modifiers.shaped == 0:
        return out
    d = modifiers.frame * direction
    theta = wp.atan2(wp.sqrt(d[0] * d[0] + d[1] * d[1]), d[2])
    if theta > modifiers.edge:
        return wp.vec3(0.0)
    if theta > modifiers.fade:
        t = (theta - modifiers.fade) / (modifiers.edge - modifiers.fade)
        out = out * (1.0 - t * t * (3.0 - 2.0 * t))
    if modifiers.focus > 0.0:
        f = wp.pow(wp.min(wp.abs(d[2]), 1.0), modifiers.focus)
        out = wp.cw_mul(out, wp.vec3(f) + modifiers.tint * (1.0 - f))
    if modifiers.profile >= 0:
        out = wp.cw_mul(out, value_along(distributions, modifiers.profile, d))
    return out


@wp.func
def approximate_shaping(modifiers: LightModifiers, position: wp.vec3, target: wp.vec4) -> float:
    """Roughly the factor from a point on a light towards a position, never 0: for weighing VPLs, not for light."""
    to_light = wp.vec3(target[0], target[1], target[2]) - position * target[3]
    cosine = -wp.dot(
        wp.vec3(modifiers.frame[2, 0], modifiers.frame[2, 1], modifiers.frame[2, 2]), wp.normalize(to_light)
    )
    return wp.clamp(modifiers.slope * cosine + modifiers.offset, modifiers.least, 1.0)


@wp.func
def in_link_set(tables: LightModifierTables, row: int, mesh: int) -> bool:
    """Whether a mesh is in a set of the link table; row -1 is the empty set."""
    if row < 0 or mesh < 0:
        return False
    return tables.links[row * tables.meshes + mesh] == 1


def needs_modifiers(light: Light | MeshLight) -> bool:
    """Whether a light asks for anything beyond its radiance and shape."""
    return light.shaping is not None or not light.shadows or bool(light.unlit) or bool(light.shadowless)


def upload_light_modifiers(
    lights: tuple[Light, ...], axes: Any, meshes: Sequence[Mesh], distributions: Distribution2DList, launcher: Launcher
) -> tuple[Any, npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """The `LightModifierTables`, and for every light what shaping makes of its radiance and of its power.

    Args:
        lights: Of the scene.
        axes: Their axes in the device's frame [lights, 3, 3]; the third column of a flat light is its unit normal.
        meshes: Of the scene; those that are lights have controls too.
        distributions: Takes the profiles and the directions of photons.
        launcher: Where to.

    Returns:
        The tables; factors of the radiance [lights], by which profiles were divided to have the maximum 1; and of the
        power [lights], beside those.

    Raises:
        InputError: A value is not usable; the message names the light.
    """
    rows = _Rows(len(meshes), distributions)
    of_light = np.full(max(len(lights), 1), -1, np.int32)
    radiance, power = np.ones(len(lights)), np.ones(len(lights))
    for k, light in enumerate(lights):
        if not needs_modifiers(light):
            continue
        if light.shaping is not None and light.shaping.profile is not None:
            _check(light.name, light.shaping)
            radiance[k] = float(light.shaping.profile.max())
        flat = light.kind in (LightKind.RECT, LightKind.DISK) and float(axes[k][:, 2] @ _axis(light)) > _ALONG
        of_light[k] = len(rows.rows)
        share = rows.add(light, flat=flat, kind=light.kind, peak=max(radiance[k], 1.0e-30))
        power[k] = share if light.kind != LightKind.DISTANT else 1.0  # whose directions lie around the axis anyway
    of_mesh = np.full(len(meshes), -1, np.int32)
    for k, mesh in enumerate(meshes):
        if mesh.light is not None and needs_modifiers(mesh.light):
            of_mesh[k] = len(rows.rows)
            rows.add(mesh.light, flat=_is_flat(mesh, _axis(mesh.light)))

    out = rows.upload(launcher)
    out.shaped_count = sum(light.shaping is not None for light in (*lights, *(m.light for m in meshes if m.light)))
    out.of_light = launcher.array(of_light, wp.int32)
    out.surface_count = int((of_mesh >= 0).sum())
    out.of_mesh = launcher.array(of_mesh if out.surface_count else [-1], wp.int32)
    sampled = [k for k, x in enumerate(lights) if x.kind <= LightKind.CYLINDER and not (x.shadows and not x.shadowless)]
    out.sampled_count = len(sampled)
    out.sampled = launcher.array(sampled or [0], wp.int32)
    out.sampled_surfaces = sum(m.light is not None and not (m.light.shadows and not m.light.shadowless) for m in meshes)
    return out, radiance, power


class _Rows:
    """The rows of controls and links while they are gathered."""

    def __init__(self, meshes: int, distributions: Distribution2DList) -> None:
        self.rows: list[tuple[Any, ...]] = []
        self._meshes, self._grids = meshes, distributions
        self._links: dict[frozenset[int], int] = {}

    def add(
        self, light: Light | MeshLight, *, flat: bool, kind: LightKind = LightKind.SPHERE, peak: float = 1.0
    ) -> float:
        """Adds the row of one light.

        Args:
            light: Whose.
            flat: Whether all of it faces along the axis of its shaping.
            kind: Photons leave surfaces as they leave a sphere.
            peak: By which a profile is divided.

        Returns:
            What shaping makes of the power, the profile being divided by its maximum.

        Raises:
            InputError: A value is not usable; the message names the light.
        """
        for link in (light.unlit, light.shadowless):
            if any(not 0 <= mesh < self._meshes for mesh in link):
                raise InputError(f"{light.name}: it is linked to meshes outside 0..{self._meshes - 1}")
        shaping = light.shaping or Shaping()
        _check(light.name, shaping)
        profile, photons, share = -1, -1, 1.0
        if light.shaping is not None:
            if shaping.profile is not None:
                table = np.repeat(shaping.profile[:, :, None] / peak, 3, axis=2)
                profile = self._grids.add(table, theta=math.pi)
            weights, theta, share, waste = _emission(shaping, cosine=flat)
            best = flat or kind == LightKind.POINT or waste > _SPHERE_WASTE
            if best and kind <= LightKind.POINT and weights.max() > 0.0:
                blank = np.zeros((*weights.shape, 3))
                photons = self._grids.add(blank, theta=theta, weights=weights, keep=False)
        edge = math.radians(shaping.cone_angle) if shaping.cone_angle < 180.0 else 4.0  # beyond any angle there is
        fade = edge if shaping.cone_softness == 0.0 else edge * (1.0 - shaping.cone_softness)
        links = (self._links.setdefault(s, len(self._links)) if s else -1 for s in (light.unlit, light.shadowless))
        where = (profile, photons, *_ramp(light.shaping), int(light.shadows), *links)
        shaped = int(light.shaping is not None)
        self.rows.append((_frame(light), shaped, fade, edge, shaping.focus, shaping.focus_tint, *where))
        return share

    def upload(self, launcher: Launcher) -> Any:
        """The `LightModifierTables` with rows and links."""
        out = LightModifierTables()
        out.count = len(self.rows)
        table = np.zeros(max(len(self.rows), 1), LightModifiers.numpy_dtype())
        for k, row in enumerate(self.rows):
            table[k] = row
        out.rows = launcher.array(table, LightModifiers)
        out.meshes = self._meshes
        bits = np.zeros((max(len(self._links), 1), max(self._meshes, 1)), np.int32)
        for link, index in self._links.items():
            bits[index, list(link)] = 1
        out.links = launcher.array(bits.reshape(-1), wp.int32)
        return out


def shaped_power(light: MeshLight, normals: Any, *, double_sided: bool) -> npt.NDArray[np.float64]:
    """What shaping makes of the power of surfaces, roughly: for choosing them, so it is 0 for none that may emit.

    Args:
        light: Whose surfaces.
        normals: Unit, [n, 3].
        double_sided: Whether they emit from both sides.

    Returns:
        [n], relative to the same surfaces unshaped.
    """
    shaping = light.shaping
    if shaping is None:
        return np.ones(len(normals))
    edge = math.radians(min(shaping.cone_angle, 180.0))
    theta = edge * (np.arange(512) + 0.5) / 512.0
    factor = _factor(shaping, theta).mean(axis=1) * (1.0 if shaping.profile is None else float(shaping.profile.max()))
    # Of a surface tilted by β, the cosine at polar angle θ, integrated over the azimuth: ∫ (a + b cosφ)⁺ dφ.
    tilt = np.linspace(0.0, math.pi, 129)
    a, b = np.cos(theta) * np.cos(tilt)[:, None], np.sin(theta) * np.sin(tilt)[:, None]
    half = np.arccos(np.clip(-a / np.maximum(b, 1.0e-12), -1.0, 1.0))
    share = (2.0 * (a * half + b * np.sin(half)).clip(0.0) * factor) @ (np.sin(theta) * edge / 512.0) / math.pi
    if double_sided:
        share = 0.5 * (share + share[::-1])
    angle = np.arccos(np.clip(normals @ _axis(light), -1.0, 1.0))
    return np.asarray(np.interp(angle, tilt, np.maximum(share, _LEAST * share.max())))


def _axis(light: Light | MeshLight) -> npt.NDArray[np.float64]:
    """The axis of its shaping, unit."""
    return _frame(light)[2]


def _is_flat(mesh: Mesh, axis: npt.NDArray[np.float64]) -> bool:
    """Whether all of a mesh emits along an axis."""
    a, b, c = (mesh.points[mesh.triangles[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    return not mesh.double_sided and bool((cross @ axis >= _ALONG * np.linalg.norm(cross, axis=1)).all())


def _check(name: str, shaping: Shaping) -> None:
    numbers = (shaping.cone_angle, shaping.cone_softness, shaping.focus, *shaping.focus_tint)
    if not all(0.0 <= x < math.inf for x in numbers) or shaping.cone_softness > 1.0:
        raise InputError(f"{name}: shaping must be finite and not negative, softness at most 1, is {shaping}")
    profile = shaping.profile
    if profile is not None and not (profile.ndim == 2 and profile.size and np.isfinite(profile).all()):
        raise InputError(f"{name}: a profile must be a finite table [rows, columns]")
    if profile is not None and profile.min() < 0.0:
        raise InputError(f"{name}: a profile must not be negative")


def _frame(light: Light | MeshLight) -> npt.NDArray[np.float64]:
    """Rows: the light's X, its Y and -Z as unit vectors of the world, at right angles whatever its scale or shear."""
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
    y = np.cross(x, axis)  # so that X, Y and -axis are right-handed, as the light's own axes are ...
    return np.stack([x, y if y @ linear[:, 1] >= 0.0 else -y, axis])  # ... unless it is mirrored


def _emission(shaping: Shaping, *, cosine: bool) -> tuple[npt.NDArray[np.float64], float, float, float]:
    """How a shaped light emits, by quadrature over directions.

    Args:
        shaping: Of the light.
        cosine: Whether directions count by their cosine to the axis (a flat light), else alike.

    Returns:
        Weights of the directions [rows, columns] of a grid; the polar angle it covers [rad]; power relative to the
        same light unshaped; and 4π ∫f² / (∫f)², the waste of photons that do not know of the shaping.
    """
    theta = math.radians(min(shaping.cone_angle, 180.0))
    if cosine:
        theta = min(theta, 0.5 * math.pi)
    theta = max(theta, 1.0e-6)
    columns = 1 if shaping.profile is None else shaping.profile.shape[1]
    fine = 4  # points per row and cell: enough that none is taken for dark that is not
    angle = theta * (np.arange(fine * _BANDS) + 0.5) / (fine * _BANDS)
    factor = _factor(shaping, angle)  # [fine rows, columns]
    if cosine:
        factor = factor * np.cos(angle)[:, None]
    measure = cell_measure(fine * _BANDS, theta)[:, None] / columns
    total, squares = float((factor * measure).sum()), float((factor**2 * measure).sum())
    weights = (factor * measure).reshape(_BANDS, fine, columns).sum(axis=1)
    if columns > 1:  # a column reaches over to its neighbours by interpolation
        weights = cell_means(weights, around=True)
    whole = math.pi if cosine else 4.0 * math.pi
    return weights, theta, total / whole, 4.0 * math.pi * squares / max(total, 1.0e-30) ** 2


def _ramp(shaping: Shaping | None) -> tuple[float, float, float, float]:
    """Slope, offset and least value of a ramp over the cosine that goes with the factor, and the cosine where it ends.

    Where a light fades from its axis outwards the ramp passes through 3/4 and 1/4 where the factor does, as nobody
    will notice an error of 2 in a weight; else it is level.
    """
    if shaping is None:
        return 0.0, 1.0, 1.0, -2.0
    angle = math.radians(min(shaping.cone_angle, 180.0)) * np.arange(4097) / 4096.0
    factor = _factor(shaping, angle).max(axis=1)
    lit = np.nonzero(factor > 0.0)[0]
    margin = angle[1] + (0.0 if shaping.profile is None else math.pi / len(shaping.profile))
    end = min(float(angle[lit[-1]]) + margin, math.pi) if len(lit) else 0.0
    cutoff = math.cos(end) - 4.0e-6 if end < math.pi else -2.0
    factor = factor / max(float(factor.max()), 1.0e-30)
    if factor[0] < 0.75 or factor.min() >= 0.75:
        return 0.0, 1.0, 1.0, cutoff
    high = math.cos(angle[np.argmax(factor < 0.75)])
    low = math.cos(angle[np.argmax(factor < 0.25)] if factor.min() < 0.25 else angle[-1])
    slope = 0.5 / max(high - low, 1.0e-6)
    return slope, 0.75 - slope * high, _LEAST, cutoff


def _factor(shaping: Shaping, angle: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Mean over the channels of the factor at polar angles [n] and the profile's columns; float64 [n, columns]."""
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
    place = np.clip(angle / math.pi * rows - 0.5, 0.0, rows - 1.0)
    low = np.minimum(place.astype(int), rows - 1)
    high = np.minimum(low + 1, rows - 1)
    part = (place - low)[:, None]
    table = shaping.profile / max(float(shaping.profile.max()), 1.0e-30)
    return factor[:, None] * (table[low] * (1.0 - part) + table[high] * part)
