"""What VPLs give to the picture, by where they are and where they face."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.guiding.emitter_selection import PRIOR
from warp_ir.guiding.probes import VplConnections, clamp_outliers
from warp_ir.vpl.guide import CELLS, MIN_SURVIVAL, SIDES, Guide, VplImportance

Floats = npt.NDArray[np.float64]

_LEVELS = CELLS.bit_length() - 1
_MUCH = 0.5
"""VPLs that give more than this, over what the VPLs give by which the picture is lit, are kept."""
_MOST_KEPT = 0.5
"""Share of the VPLs that may be kept at most, if dropping the others is to be worth while."""
_FEW = 8.0
"""VPLs in a cell that tell how dense they are."""
_USUAL_DENSITY = 2.0
"""Of VPLs where they count, where light is everywhere."""


@dataclass(frozen=True)
class VplSurvival:
    """Which VPLs are kept."""

    table: Any
    """The `VplImportance`."""
    kept: float
    """Their share in all."""
    density: float
    """Where they count, over that on all surfaces."""


def learn_survival(found: VplConnections, guide: Guide, launcher: Launcher) -> VplSurvival | None:
    """Which VPLs to keep; None if most of them give about as much."""
    gives = clamp_outliers(found.gives * found.intensity)
    if not gives.any():
        return None
    cell, intensity = found.cell, found.intensity
    even = np.arange(len(cell)) % 2 == 0
    if not (intensity[even].any() and intensity[~even].any()):
        return None
    # Two tables that know nothing of each other: their product is no larger for their noise.
    coarse = larger(cell, _LEVELS - 1)
    one, other = (means(cell[k], intensity[k], gives[k], _LEVELS - 1)[coarse] * intensity for k in (even, ~even))
    much = _MUCH * (one * other).sum() / gives.sum()
    if not much > 0.0:
        return None
    per_intensity = means(cell, intensity, gives)
    probability = np.clip(per_intensity[cell] * intensity / much, MIN_SURVIVAL, 1.0)
    kept = float(probability.mean())
    if kept > _MOST_KEPT:
        return None
    table = VplImportance()
    table.known, table.extent = 1, found.extent
    table.per_intensity = launcher.array(per_intensity / much, wp.float32)
    local = _density(found, per_intensity[cell] * intensity, probability)
    everywhere = float(probability.sum()) / guide.scene.area
    return VplSurvival(table, kept, max(local / everywhere / _USUAL_DENSITY, 1.0))


def means(cell: npt.NDArray[np.int64], intensity: Floats, gives: Floats, levels: int = _LEVELS) -> Floats:
    """What VPLs give per intensity, in every cell; where there are few, cells around it count, too.

    Args:
        cell: Of each VPL.
        intensity: Of each VPL.
        gives: Of each VPL.
        levels: How often the cube is halved; fewer times than into `CELLS`, the result is that of larger cells.
    """
    prior = PRIOR * intensity.mean()
    out = np.full((SIDES, 1, 1, 1), gives.sum() / intensity.sum())
    for level in range(1, levels + 1):
        n = 2**level
        sums, weights = (np.bincount(larger(cell, level), x, SIDES * n**3) for x in (gives, intensity))
        around = out.repeat(2, axis=1).repeat(2, axis=2).repeat(2, axis=3).reshape(-1)
        out = ((sums + prior * around) / (weights + prior)).reshape(SIDES, n, n, n)
    return out.reshape(-1)


def larger(cell: npt.NDArray[np.int64], level: int) -> npt.NDArray[np.int64]:
    """The cells around cells, of a cube that is halved `level` times."""
    side, place = np.divmod(cell, CELLS**3)
    x, y, z = (place // CELLS**k % CELLS >> (_LEVELS - level) for k in (2, 1, 0))
    return np.asarray(((((side << level) + x) << level) + y << level) + z)


def _density(found: VplConnections, gives: Floats, probability: Floats) -> float:
    """VPLs kept per area around those that give much, from the smallest cells that hold enough; 0 if none do."""
    for level in range(_LEVELS, 1, -1):
        around = larger(found.cell, level)
        others = np.bincount(around, probability)[around] - probability
        number = float((gives * others).sum() / gives.sum())
        if number >= _FEW:
            return number / (found.extent / 2**level) ** 2
    return 0.0
