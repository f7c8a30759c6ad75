"""Upload of light modifiers: the rows of the lights that need any, and the sets of linked meshes."""

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.light_modifiers.records import MODIFIERS_DTYPE, LightModifiers, LightModifierTables
from warp_ir.light_modifiers.shaping_integrals import (
    check_shaping,
    fit_ramp,
    integrate_emission,
    shaping_axis,
    shaping_frame,
)
from warp_ir.sampling.distribution2d import Distribution2DList
from warp_ir.scene import Floats, InputError, Light, LightKind, Mesh, MeshLight, Shaping

_PARALLEL_COSINE = 0.999999
"""Cosine between a surface normal and the axis of shaping above which the two count as parallel."""
_SPHERE_SECOND_MOMENT = 8.0 / 3.0
"""E[w²]/E[w]² = (1/6) / (1/4)² of the weights w = cos⁺θ of photons that leave a sphere in a direction sampled
independently of the point."""
_UNBOUNDED_ANGLE = 4.0
"""An angle above all polar angles [rad]."""


def upload_light_modifiers(
    lights: tuple[Light, ...],
    axes: Floats,
    meshes: Sequence[Mesh],
    distributions: Distribution2DList,
    launcher: Launcher,
) -> tuple[LightModifierTables, npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Uploads the modifiers of all lights and mesh lights.

    Args:
        lights: The lights of the scene.
        axes: Their axes in the device frame, [lights, 3, 3]; the third column of a flat light is its unit normal.
        meshes: The meshes of the scene; mesh lights have modifiers too.
        distributions: Receives the profiles and the distributions of photon directions.
        launcher: Launcher of the device.

    Returns:
        The tables; the factors of the radiance [lights] by which profiles were divided to have the maximum 1; and the
        further factors by which shaping changes the power [lights].

    Raises:
        InputError: A value is not usable; the message names the light.
    """
    rows = _ModifierRows(len(meshes), distributions)
    row_of_light = np.full(max(len(lights), 1), -1, np.int32)
    radiance, power = np.ones(len(lights)), np.ones(len(lights))
    for k, light in enumerate(lights):
        if not _needs_modifiers(light):
            continue
        if light.shaping is not None and light.shaping.profile is not None:
            check_shaping(light.name, light.shaping)
            radiance[k] = float(light.shaping.profile.max())
        flat = light.kind in (LightKind.RECT, LightKind.DISK)
        flat = flat and float(axes[k][:, 2] @ shaping_axis(light)) > _PARALLEL_COSINE
        row_of_light[k] = len(rows.rows)
        factor = rows.add(light, flat=flat, kind=light.kind, peak=max(radiance[k], 1.0e-30))
        power[k] = factor if light.kind != LightKind.DISTANT else 1.0  # its directions lie around the axis anyway
    row_of_mesh = np.full(len(meshes), -1, np.int32)
    for k, mesh in enumerate(meshes):
        if mesh.light is not None and _needs_modifiers(mesh.light):
            row_of_mesh[k] = len(rows.rows)
            rows.add(mesh.light, flat=_is_flat(mesh, shaping_axis(mesh.light)))

    mesh_lights = [mesh.light for mesh in meshes if mesh.light is not None]
    out = rows.upload(launcher)
    shapings = [light.shaping for light in lights] + [light.shaping for light in mesh_lights]
    out.shaped_count = sum(shaping is not None for shaping in shapings)
    out.row_of_light = launcher.array(row_of_light, wp.int32)
    out.modified_mesh_count = int((row_of_mesh >= 0).sum())
    out.row_of_mesh = launcher.array(row_of_mesh if out.modified_mesh_count else [-1], wp.int32)
    only_sampled = [k for k, x in enumerate(lights) if x.kind <= LightKind.CYLINDER and _is_only_sampled(x)]
    out.only_sampled_count = len(only_sampled)
    out.only_sampled_lights = launcher.array(only_sampled or [0], wp.int32)
    out.only_sampled_mesh_count = sum(_is_only_sampled(light) for light in mesh_lights)
    return out, radiance, power


def _needs_modifiers(light: Light | MeshLight) -> bool:
    """Whether a light needs a row of `LightModifiers`."""
    return light.shaping is not None or not light.shadows or bool(light.unlit) or bool(light.shadowless)


def _is_only_sampled(light: Light | MeshLight) -> bool:
    """Whether some surfaces do not shadow the light, so that rays, which they block, must not count it."""
    return not light.shadows or bool(light.shadowless)


class _ModifierRows:
    """The rows of the modifier table and of the link table on the host."""

    def __init__(self, mesh_count: int, distributions: Distribution2DList) -> None:
        self.rows: list[tuple[object, ...]] = []
        self._mesh_count, self._distributions = mesh_count, distributions
        self._links: dict[frozenset[int], int] = {}

    def add(
        self, light: Light | MeshLight, *, flat: bool, kind: LightKind = LightKind.SPHERE, peak: float = 1.0
    ) -> float:
        """Adds the row of one light.

        Args:
            light: The light.
            flat: Whether every point of it faces along the axis of its shaping.
            kind: Shape of the light; photons leave a mesh light as they leave a sphere.
            peak: The value by which a profile is divided.

        Returns:
            The factor by which shaping changes the power, the profile being divided by its maximum.

        Raises:
            InputError: A value is not usable; the message names the light.
        """
        for link in (light.unlit, light.shadowless):
            if any(not 0 <= mesh < self._mesh_count for mesh in link):
                raise InputError(f"{light.name}: it is linked to meshes outside 0..{self._mesh_count - 1}")
        shaping = light.shaping or Shaping()
        check_shaping(light.name, shaping)
        profile, photon_directions, power = -1, -1, 1.0
        if light.shaping is not None:
            if shaping.profile is not None:
                table = np.repeat(shaping.profile[:, :, None] / peak, 3, axis=2)
                profile = self._distributions.add(table, max_theta=math.pi)
            emission = integrate_emission(shaping, cosine=flat)
            power = emission.power
            table_is_better = flat or kind == LightKind.POINT or emission.second_moment > _SPHERE_SECOND_MOMENT
            if table_is_better and kind <= LightKind.POINT and emission.weights.max() > 0.0:
                unused = np.zeros((*emission.weights.shape, 3))
                photon_directions = self._distributions.add(
                    unused, max_theta=emission.max_theta, weights=emission.weights, store_values=False
                )
        cone_angle = math.radians(shaping.cone_angle) if shaping.cone_angle < 180.0 else _UNBOUNDED_ANGLE
        fade_angle = cone_angle if shaping.cone_softness == 0.0 else cone_angle * (1.0 - shaping.cone_softness)
        ramp = fit_ramp(light.shaping)
        self.rows.append(
            (
                shaping_frame(light),
                int(light.shaping is not None),
                fade_angle,
                cone_angle,
                shaping.focus,
                shaping.focus_tint,
                profile,
                photon_directions,
                ramp.slope,
                ramp.offset,
                ramp.minimum,
                ramp.cutoff_cosine,
                int(light.shadows),
                self._link_row(light.unlit),
                self._link_row(light.shadowless),
            )
        )
        return power

    def _link_row(self, meshes: frozenset[int]) -> int:
        """The row of the link table for a set of meshes; -1 for the empty set."""
        return self._links.setdefault(meshes, len(self._links)) if meshes else -1

    def upload(self, launcher: Launcher) -> LightModifierTables:
        """Uploads the rows and the link table; fields that depend on the scene's lights are left unset."""
        out = LightModifierTables()
        out.count = len(self.rows)
        table = np.array(self.rows, MODIFIERS_DTYPE) if self.rows else np.zeros(1, MODIFIERS_DTYPE)
        out.rows = launcher.array(table, LightModifiers)
        out.mesh_count = self._mesh_count
        members = np.zeros((max(len(self._links), 1), max(self._mesh_count, 1)), np.int32)
        for link, index in self._links.items():
            members[index, list(link)] = 1
        out.links = launcher.array(members.reshape(-1), wp.int32)
        return out


def _is_flat(mesh: Mesh, axis: npt.NDArray[np.float64]) -> bool:
    """Whether every triangle of a mesh emits along an axis."""
    a, b, c = (mesh.points[mesh.triangles[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    return not mesh.double_sided and bool((cross @ axis >= _PARALLEL_COSINE * np.linalg.norm(cross, axis=1)).all())
