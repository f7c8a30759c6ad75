"""The importance of light paths: what the picture gains from them, by cell of space and direction.

Light that a surface reflects contributes to the picture as a VPL, and by the VPLs that its path leaves afterwards. Per
intensity of a VPL at y, with q the intensity of the path's next VPL over that at y,

    V(y) = J(y) + C(y)        C(y) = E[q V(next)]

which is the adjoint of the light transport equation (importance; Christensen 2003). J is measured by connecting the
vertices of probe paths with points that the camera sees. C follows from the segments of the same paths, by iteration:
so the importance of a room that the camera does not see is known from the paths that lead from there to one that it
sees.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.device_scene import DeviceScene
from warp_ir.guiding.probes import Floats, Vertices, cells_extent
from warp_ir.vpl.guide import CELLS, MIN_SURVIVAL, SIDES, ViewImportance

Ints = npt.NDArray[np.int64]

_LEVELS = CELLS.bit_length() - 1
_PRIOR = 1.0
"""Number of vertices that the value of the cell twice as large counts for."""
_ITERATIONS = 12
"""Iterations of the equation for V: so many segments away from the points in view is it known."""
_THRESHOLD = 0.5
"""VPLs that contribute more than this share of a typical contribution always survive."""
_MAX_SURVIVAL_RATE = 0.5
"""Largest share of surviving VPLs at which roulette over VPLs pays."""
_MIN_VPLS_IN_CELL = 8.0
"""Least number of VPLs in a cell from which their density is estimated."""
_UNIFORM_DENSITY = 2.0
"""Density of VPLs around those that matter, relative to the mean, in a scene that is lit evenly."""


class CellTree:
    """The cells that vertices lie in, and those twice, four times, ... as large around them."""

    def __init__(self, cell: Ints) -> None:
        """Starts from the cell of each vertex."""
        codes, self.leaf = np.unique(cell, return_inverse=True)
        """The leaf of each vertex."""
        self.codes = [codes]
        """The numbers, at each level, of the cells that hold vertices; the first level is the finest."""
        self.parents: list[Ints] = []
        """The index, for each cell of a level, of the cell of the next level that contains it."""
        for level in range(_LEVELS, 0, -1):
            side, x, y, z = (codes >> 3 * level, *(codes >> k * level & (1 << level) - 1 for k in (2, 1, 0)))
            half = level - 1
            codes, parent = np.unique(
                (((((side << half) + (x >> 1)) << half) + (y >> 1)) << half) + (z >> 1), return_inverse=True
            )
            self.codes.append(codes)
            self.parents.append(parent)

    def levels(self, per_vertex: Floats) -> list[Floats]:
        """Sums over the cells of each level, from the finest to the coarsest."""
        out: list[Floats] = [np.bincount(self.leaf, per_vertex, len(self.codes[0])).astype(np.float64)]
        for parent, codes in zip(self.parents, self.codes[1:], strict=True):
            out.append(np.bincount(parent, out[-1], len(codes)).astype(np.float64))
        return out

    def means(self, value: Floats, counts: list[Floats]) -> list[Floats]:
        """Means of each level's cells; one with few vertices takes part of the mean of its parent.

        Args:
            value: Value of each vertex; 0 where it does not count.
            counts: Number of vertices that count in each level's cells (`levels`).
        """
        sums = self.levels(value)
        out = [np.divide(sums[-1], counts[-1], out=np.zeros_like(sums[-1]), where=counts[-1] > 0.0)]
        for total, count, parent in zip(sums[-2::-1], counts[-2::-1], self.parents[::-1], strict=True):
            out.append((total + _PRIOR * out[-1][parent]) / (count + _PRIOR))
        return out[::-1]

    def dense(self, means: list[Floats]) -> npt.NDArray[np.float32]:
        """The finest means as a table of all cells [sides, cells, cells, cells]; where none is known, of the parent."""
        out = np.full((SIDES, 1, 1, 1), means[-1].mean(), np.float32)
        out.reshape(-1)[self.codes[-1]] = means[-1]
        for codes, mean in zip(self.codes[-2::-1], means[-2::-1], strict=True):
            out = out.repeat(2, axis=1).repeat(2, axis=2).repeat(2, axis=3)
            out.reshape(-1)[codes] = mean
        return out.reshape(-1)


@dataclass(frozen=True)
class LearnedImportance:
    """The importance that probe paths tell of."""

    tree: CellTree
    own: list[Floats]
    """J: contribution of a VPL itself per intensity, of each level's cells."""
    following: list[Floats]
    """C: contribution of what follows it."""

    def own_at(self, last: int) -> Floats:
        """J at the last vertices, of cells twice as large as the finest, where it has less noise."""
        return self.own[1][self.tree.parents[0][self.tree.leaf[-last:]]]

    def record(
        self, launcher: Launcher, candidates: int, extent: float, vertices: Vertices, contribution: float
    ) -> ViewImportance:
        """The record for kernels.

        Args:
            launcher: Launcher of the device.
            candidates: Number of directions of which a light path takes one.
            extent: Edge length of the cube of cells.
            vertices: The vertices that it was learned from.
            contribution: Expected contribution of a light path.
        """
        out = ViewImportance()
        out.known, out.candidates, out.extent, out.path_contribution = 1, candidates, extent, contribution
        table = np.stack([self.tree.dense(self.own), self.tree.dense(self.following)], axis=1)
        out.per_intensity = launcher.array(table, wp.vec2)
        value = (self.own[0] + self.following[0])[self.tree.leaf]
        weight = np.where(vertices.is_first, vertices.intensity, 0.0)
        out.at_emission = float((value * weight).sum() / max(weight.sum(), 1.0e-300))
        return out


def learn_importance(vertices: Vertices) -> LearnedImportance:
    """Learns the importance from vertices of probe paths."""
    tree = CellTree(vertices.cell)
    own = tree.means(vertices.contribution, tree.levels(np.ones(len(vertices.cell))))
    goes_on = vertices.continues & (vertices.next >= 0)
    origin, target = np.nonzero(goes_on)[0], tree.leaf[vertices.next[goes_on]]
    ratio = vertices.ratio[goes_on]
    counts = tree.levels(vertices.continues.astype(np.float64))
    following = [np.zeros_like(x) for x in own]
    gained = np.zeros(len(vertices.cell))
    for _ in range(_ITERATIONS):
        gained[origin] = ratio * (own[0] + following[0])[target]
        following = tree.means(gained, counts)
    return LearnedImportance(tree, own, following)


def path_variance(vertices: Vertices, own: Floats, paths: int) -> float:
    """Variance of the contribution of a light path to the picture, over the square of its mean.

    Args:
        vertices: Vertices of light paths, some of which contribute.
        own: J at each of them.
        paths: Number of light paths.
    """
    of_path = np.bincount(vertices.path, own * vertices.intensity, paths)
    return float(paths * (of_path**2).sum() / of_path.sum() ** 2 - 1.0)


@dataclass(frozen=True)
class VplSurvival:
    """The learned survival of VPLs."""

    threshold: float
    """Contribution from which on a VPL always survives."""
    survivors: float
    """Expected number of the probe's VPLs that survive."""
    density_ratio: float
    """Density of surviving VPLs where they matter, relative to the mean over all surfaces."""


def learn_survival(vertices: Vertices, own: Floats, scene: DeviceScene) -> VplSurvival | None:
    """Learns the survival of VPLs; None if most of them contribute about as much.

    Args:
        vertices: Vertices of light paths, some of which contribute.
        own: J at each of them.
        scene: The scene.
    """
    contribution = own * vertices.intensity
    threshold = _THRESHOLD * float((contribution**2).sum() / contribution.sum())
    probability = np.clip(contribution / threshold, MIN_SURVIVAL, 1.0)
    survivors = float(probability.sum())
    if survivors > _MAX_SURVIVAL_RATE * len(probability):
        return None
    local_density = _density(vertices, contribution, probability, cells_extent(scene))
    return VplSurvival(threshold, survivors, max(local_density / (survivors / scene.area) / _UNIFORM_DENSITY, 1.0))


def _density(vertices: Vertices, contribution: Floats, probability: Floats, extent: float) -> float:
    """Surviving VPLs per area around those that contribute most; 0 if no cell holds enough of them.

    The smallest cells that hold at least `_MIN_VPLS_IN_CELL` are used.
    """
    tree = CellTree(vertices.cell)
    weight, survivors, both = (tree.levels(x) for x in (contribution, probability, contribution * probability))
    for k in range(_LEVELS - 1):
        neighbours = float(((weight[k] * survivors[k]).sum() - both[k].sum()) / weight[k].sum())
        if neighbours >= _MIN_VPLS_IN_CELL:
            return neighbours / (extent / float(1 << _LEVELS - k)) ** 2
    return 0.0
