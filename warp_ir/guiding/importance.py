"""Importance of VPLs: their contribution to the picture, by position and orientation."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.guiding.emitter_selection import PRIOR
from warp_ir.guiding.probes import VplConnections, clamp_outliers
from warp_ir.vpl.guide import CELLS, MIN_SURVIVAL, SIDES, Guide, VplImportance

Floats = npt.NDArray[np.float64]

_LEVELS = CELLS.bit_length() - 1
_THRESHOLD = 0.5
"""VPLs that contribute more than this share of a typical contribution always survive."""
_MAX_SURVIVAL_RATE = 0.5
"""Largest share of surviving VPLs at which roulette over VPLs pays."""
_MIN_VPLS_IN_CELL = 8.0
"""Least number of VPLs in a cell from which their density is estimated."""
_UNIFORM_DENSITY = 2.0
"""Density of VPLs around those that matter, relative to the mean, in a scene that is lit evenly."""


@dataclass(frozen=True)
class VplSurvival:
    """The learned survival of VPLs."""

    importance: VplImportance
    """Contribution per intensity, by cell."""
    survival_rate: float
    """Share of the VPLs that survive."""
    density_ratio: float
    """Density of surviving VPLs where they matter, relative to the mean over all surfaces."""


def learn_survival(connections: VplConnections, guide: Guide, launcher: Launcher) -> VplSurvival | None:
    """Learns the survival of VPLs; None if most of them contribute about as much."""
    contribution = clamp_outliers(connections.contribution * connections.intensity)
    if not contribution.any():
        return None
    cell, intensity = connections.cell, connections.intensity
    even = np.arange(len(cell)) % 2 == 0
    if not (intensity[even].any() and intensity[~even].any()):
        return None
    # Two tables from independent halves: the expectation of their product contains no variance.
    coarse = coarse_cells(cell, _LEVELS - 1)
    first_half, second_half = (
        importance_by_cell(cell[k], intensity[k], contribution[k], _LEVELS - 1)[coarse] * intensity
        for k in (even, ~even)
    )
    threshold = _THRESHOLD * (first_half * second_half).sum() / contribution.sum()
    if not threshold > 0.0:
        return None
    per_intensity = importance_by_cell(cell, intensity, contribution)
    probability = np.clip(per_intensity[cell] * intensity / threshold, MIN_SURVIVAL, 1.0)
    survival_rate = float(probability.mean())
    if survival_rate > _MAX_SURVIVAL_RATE:
        return None
    importance = VplImportance()
    importance.known, importance.extent = 1, connections.extent
    importance.per_intensity = launcher.array(per_intensity / threshold, wp.float32)
    local_density = _density(connections, per_intensity[cell] * intensity, probability)
    mean_density = float(probability.sum()) / guide.scene.area
    return VplSurvival(importance, survival_rate, max(local_density / mean_density / _UNIFORM_DENSITY, 1.0))


def importance_by_cell(
    cell: npt.NDArray[np.int64], intensity: Floats, contribution: Floats, levels: int = _LEVELS
) -> Floats:
    """Contribution per intensity of each cell; a cell with few VPLs takes part of its parent cell's value.

    Args:
        cell: Cell of each VPL.
        intensity: Intensity of each VPL.
        contribution: Contribution of each VPL.
        levels: How often the cube is halved along each axis; the finest level has `CELLS` cells.
    """
    prior = PRIOR * intensity.mean()
    out = np.full((SIDES, 1, 1, 1), contribution.sum() / intensity.sum())
    for level in range(1, levels + 1):
        n = 2**level
        sums, weights = (np.bincount(coarse_cells(cell, level), x, SIDES * n**3) for x in (contribution, intensity))
        parent = out.repeat(2, axis=1).repeat(2, axis=2).repeat(2, axis=3).reshape(-1)
        out = ((sums + prior * parent) / (weights + prior)).reshape(SIDES, n, n, n)
    return out.reshape(-1)


def coarse_cells(cell: npt.NDArray[np.int64], level: int) -> npt.NDArray[np.int64]:
    """The cells that contain the given cells, in a cube that is halved `level` times along each axis."""
    side, place = np.divmod(cell, CELLS**3)
    x, y, z = (place // CELLS**k % CELLS >> (_LEVELS - level) for k in (2, 1, 0))
    return np.asarray(((((side << level) + x) << level) + y << level) + z)


def _density(connections: VplConnections, contribution: Floats, probability: Floats) -> float:
    """Surviving VPLs per area around those that contribute most; 0 if no cell holds enough of them.

    The smallest cells that hold at least `_MIN_VPLS_IN_CELL` are used.
    """
    for level in range(_LEVELS, 1, -1):
        parent = coarse_cells(connections.cell, level)
        others = np.bincount(parent, probability)[parent] - probability
        neighbours = float((contribution * others).sum() / contribution.sum())
        if neighbours >= _MIN_VPLS_IN_CELL:
            return float(neighbours / (connections.extent / 2**level) ** 2)
    return 0.0
