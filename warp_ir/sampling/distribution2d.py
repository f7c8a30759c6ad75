"""Tables over a rectangle or over directions, and how to sample them: light textures, skies, photometry of lamps.

A grid divides a rectangle evenly into cells; or the directions up to a polar angle into rows (bands of the polar angle
θ) and columns (sectors of the azimuth φ). A cell is drawn by two cumulative distributions, first its row and then its
column; the place in it is uniform, by area or by solid angle. Values are interpolated between the centres of cells.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher

wp.set_module_options({"enable_backward": False})

_EVENLY = 0.01
"""Part of the samples that is spread evenly over what is not black: rounding must not make dark cells unreachable."""
_STEPS = 2.0**24
"""Sample numbers are multiples of 1/_STEPS; cumulative probabilities too, so that every cell gets exactly its share."""
_COMPARED = 2**18
"""Numbers of a table up to which it is compared by its values."""


@wp.struct
class Grid:
    """One table: rows x columns cells, the first row at v = 0 or θ = 0."""

    rows: int
    columns: int
    cdf: int  # where its rows + 1 cumulative probabilities begin, then columns + 1 for every row; -1: none
    texels: int  # where its rows x columns values begin
    theta: float  # over directions: the polar angle at which the last row ends; 0: over a rectangle


@wp.struct
class Distribution2DTables:
    """All grids of a scene."""

    distributions: wp.array[Grid]
    cdf: wp.array[wp.float32]
    texels: wp.array[wp.vec3]


@wp.struct
class Cell:
    """A cell that was drawn, and where in it."""

    row: int
    column: int
    x: float  # in [0, 1) along the row
    y: float
    probability: float  # of the cell


@wp.func
def _find(cdf: wp.array[wp.float32], first: int, count: int, u: float) -> int:
    """The interval of `count` that holds u; never an empty one."""
    low = int(0)
    high = count
    while high - low > 1:
        middle = (low + high) // 2
        if cdf[first + middle] <= u:
            low = middle
        else:
            high = middle
    return low


@wp.func(inline=False)
def sample_cell(tables: Distribution2DTables, index: int, u: wp.vec2) -> Cell:
    """A cell by its probability: u[1] chooses the row, u[0] the column."""
    grid = tables.distributions[index]
    cell = Cell()
    cell.row = _find(tables.cdf, grid.cdf, grid.rows, u[1])
    low = tables.cdf[grid.cdf + cell.row]
    of_row = tables.cdf[grid.cdf + cell.row + 1] - low
    cell.y = (u[1] - low) / of_row
    first = grid.cdf + grid.rows + 1 + cell.row * (grid.columns + 1)
    cell.column = _find(tables.cdf, first, grid.columns, u[0])
    low = tables.cdf[first + cell.column]
    of_column = tables.cdf[first + cell.column + 1] - low
    cell.x = (u[0] - low) / of_column
    cell.probability = of_row * of_column
    return cell


@wp.func
def _cell_probability(tables: Distribution2DTables, grid: Grid, row: int, column: int) -> float:
    first = grid.cdf + grid.rows + 1 + row * (grid.columns + 1) + column
    of_row = tables.cdf[grid.cdf + row + 1] - tables.cdf[grid.cdf + row]
    return of_row * (tables.cdf[first + 1] - tables.cdf[first])


@wp.func
def _versine(theta: float) -> float:
    """1 - cosθ, exact for small angles."""
    s = wp.sin(0.5 * theta)
    return 2.0 * s * s


@wp.func
def _solid_angle(grid: Grid, row: int) -> float:
    """Of one cell of a row."""
    step = grid.theta / float(grid.rows)
    bands = _versine(step * float(row + 1)) - _versine(step * float(row))
    return bands * 2.0 * wp.pi / float(grid.columns)


@wp.func(inline=False)
def cell_direction(tables: Distribution2DTables, index: int, cell: Cell) -> wp.vec4:
    """The unit direction of a place in a cell, around +z, and its density per solid angle."""
    grid = tables.distributions[index]
    step = grid.theta / float(grid.rows)
    h = wp.lerp(_versine(step * float(cell.row)), _versine(step * float(cell.row + 1)), cell.y)
    r = wp.sqrt(wp.max(0.0, h * (2.0 - h)))
    phi = 2.0 * wp.pi * (float(cell.column) + cell.x) / float(grid.columns)
    return wp.vec4(r * wp.cos(phi), r * wp.sin(phi), 1.0 - h, cell.probability / _solid_angle(grid, cell.row))


@wp.func
def direction_uv(grid: Grid, d: wp.vec3) -> wp.vec2:
    """Column and row, with fractions, of a unit direction around +z."""
    theta = wp.atan2(wp.sqrt(d[0] * d[0] + d[1] * d[1]), d[2])
    phi = wp.atan2(d[1], d[0])
    turn = phi / (2.0 * wp.pi)
    if turn < 0.0:
        turn += 1.0
    return wp.vec2(turn * float(grid.columns), theta / grid.theta * float(grid.rows))


@wp.func(inline=False)
def direction_pdf(tables: Distribution2DTables, index: int, d: wp.vec3) -> float:
    """The density per solid angle with which `cell_direction` gives a unit direction."""
    grid = tables.distributions[index]
    place = direction_uv(grid, d)
    row = wp.clamp(int(place[1]), 0, grid.rows - 1)
    return _cell_probability(tables, grid, row, wp.clamp(int(place[0]), 0, grid.columns - 1)) / _solid_angle(grid, row)


@wp.func(inline=False)
def uv_pdf(tables: Distribution2DTables, index: int, u: wp.vec2) -> float:
    """The density of the samples at a place u in [0, 1]² of a rectangle, relative to uniform ones."""
    grid = tables.distributions[index]
    row = wp.clamp(int(u[1] * float(grid.rows)), 0, grid.rows - 1)
    column = wp.clamp(int(u[0] * float(grid.columns)), 0, grid.columns - 1)
    return _cell_probability(tables, grid, row, column) * float(grid.rows) * float(grid.columns)


@wp.func
def cell_uv(tables: Distribution2DTables, index: int, cell: Cell) -> wp.vec2:
    """The place u in [0, 1]² of a rectangle."""
    grid = tables.distributions[index]
    return wp.vec2((float(cell.column) + cell.x) / float(grid.columns), (float(cell.row) + cell.y) / float(grid.rows))


@wp.func
def _texel(tables: Distribution2DTables, grid: Grid, row: int, column: int) -> wp.vec3:
    r = wp.clamp(row, 0, grid.rows - 1)
    c = wp.clamp(column, 0, grid.columns - 1)
    if grid.theta > 0.0:  # all the way round
        c = ((column % grid.columns) + grid.columns) % grid.columns
    return tables.texels[grid.texels + r * grid.columns + c]


@wp.func(inline=False)
def interpolate(tables: Distribution2DTables, index: int, place: wp.vec2) -> wp.vec3:
    """The value at a column and row with fractions, bilinear between the centres of cells."""
    grid = tables.distributions[index]
    x = place[0] - 0.5
    y = place[1] - 0.5
    column = int(wp.floor(x))
    row = int(wp.floor(y))
    fx = x - float(column)
    fy = y - float(row)
    upper = wp.lerp(_texel(tables, grid, row, column), _texel(tables, grid, row, column + 1), fx)
    lower = wp.lerp(_texel(tables, grid, row + 1, column), _texel(tables, grid, row + 1, column + 1), fx)
    return wp.lerp(upper, lower, fy)


@wp.func
def value_at_uv(tables: Distribution2DTables, index: int, u: wp.vec2) -> wp.vec3:
    """The value at a place u in [0, 1]² of a rectangle."""
    grid = tables.distributions[index]
    return interpolate(tables, index, wp.vec2(u[0] * float(grid.columns), u[1] * float(grid.rows)))


@wp.func
def value_along(tables: Distribution2DTables, index: int, d: wp.vec3) -> wp.vec3:
    """The value along a unit direction around +z."""
    return interpolate(tables, index, direction_uv(tables.distributions[index], d))


@dataclass(frozen=True, eq=False)
class _Values:
    """A grid on the host."""

    values: Any
    theta: float
    weights: Any
    keep: bool

    def equals(self, other: "_Values") -> bool:
        """Whether it is surely the same; large values are compared as objects."""
        return (self.theta, self.keep) == (other.theta, other.keep) and all(
            a is b or (a is not None and b is not None and max(a.size, b.size) <= _COMPARED and np.array_equal(a, b))
            for a, b in ((self.values, other.values), (self.weights, other.weights))
        )


class Distribution2DList:
    """Grids on the host, to be uploaded together."""

    def __init__(self, former: Sequence["Distribution2DList"] = ()) -> None:
        """An empty list; if it comes to equal one of `former` ones, that one's tables are taken."""
        self._former = former
        self._grids: list[_Values] = []
        self._tables: Any = None

    def add(self, values: Any, *, theta: float = 0.0, weights: Any = None, keep: bool = True) -> int:
        """Adds a grid and returns its index.

        Args:
            values: [rows, columns, 3], not negative; not to be changed any more.
            theta: Polar angle at which the last row ends [rad]; 0: over a rectangle.
            weights: [rows, columns], with which cells are drawn; None: the integral over the cell of the mean channel.
            keep: Whether the values will be looked up.
        """
        self._grids.append(_Values(values, theta, weights, keep))
        return len(self._grids) - 1

    def upload(self, launcher: Launcher) -> Any:
        """The `Distribution2DTables`; one unused row where there is nothing, since kernels never get a null pointer."""
        if self._tables is None:
            self._tables = next((f._tables for f in self._former if self._equals(f)), None) or self._upload(launcher)
            self._former = ()
        return self._tables

    def _equals(self, other: "Distribution2DList") -> bool:
        return len(self._grids) == len(other._grids) and all(
            mine.equals(its) for mine, its in zip(self._grids, other._grids, strict=True)
        )

    def _upload(self, launcher: Launcher) -> Any:
        table = np.zeros(max(len(self._grids), 1), Grid.numpy_dtype())
        cdf, texels = [np.zeros(0 if self._grids else 1, np.float32)], [np.zeros((0, 3), np.float32)]
        cdf_length = texels_length = 0
        for k, grid in enumerate(self._grids):
            rows, columns = grid.values.shape[:2]
            weights = grid.weights
            if weights is None:
                weights = cell_means(grid.values.mean(axis=2), around=grid.theta > 0.0)
                weights = weights * cell_measure(rows, grid.theta)[:, None]
            table[k] = (rows, columns, cdf_length, texels_length, grid.theta)
            cdf.append(_cumulative(weights))
            cdf_length += len(cdf[-1])
            if grid.keep:
                texels.append(grid.values.reshape(-1, 3).astype(np.float32))
                texels_length += rows * columns
        out = Distribution2DTables()
        out.distributions = launcher.array(table, Grid)
        out.cdf = launcher.array(np.concatenate(cdf), wp.float32)
        out.texels = launcher.array(np.concatenate(texels) if texels_length else np.zeros((1, 3)), wp.vec3)
        return out


def cell_measure(rows: int, theta: float) -> npt.NDArray[np.float64]:
    """Part of the whole rectangle, or the solid angle, of a row of cells; float64 [rows]."""
    if theta == 0.0:
        return np.full(rows, 1.0 / rows)
    edges = 2.0 * np.sin(0.5 * theta * np.arange(rows + 1) / rows) ** 2
    return 2.0 * np.pi * np.diff(edges)


def cell_means(values: Any, *, around: bool) -> npt.NDArray[np.float64]:
    """The means of a bilinear interpolation over its cells: what lies between the centres reaches half a cell on.

    Args:
        values: [rows, columns], at the centres of the cells.
        around: Whether the last column is followed by the first.
    """
    out = np.pad(np.asarray(values, np.float64), ((1, 1), (0, 0)), mode="edge")
    out = 0.125 * (out[:-2] + 6.0 * out[1:-1] + out[2:])
    out = np.pad(out, ((0, 0), (1, 1)), mode="wrap" if around else "edge")
    return 0.125 * (out[:, :-2] + 6.0 * out[:, 1:-1] + out[:, 2:])


def _cumulative(weights: Any) -> npt.NDArray[np.float32]:
    """Cumulative probabilities of the rows [rows + 1] and, one after the other, of the cells of each [columns + 1]."""
    rows, columns = weights.shape
    weights = np.asarray(weights, np.float64)
    if weights.max() > 0.0:
        weights = weights / weights.max()
        lit = weights > 0.0
        weights = (1.0 - _EVENLY) * weights / weights.sum() + _EVENLY * lit / lit.sum()
    out = np.zeros(rows + 1 + rows * (columns + 1), np.float32)
    out[: rows + 1] = _steps(weights.sum(axis=1)[None])[0]
    out[rows + 1 :] = _steps(weights).reshape(-1)
    return out


def _steps(weights: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """Cumulative sums [n, k + 1] of rows [n, k], from 0 to 1, in steps that a sample number can take."""
    sums = np.cumsum(weights, axis=1)
    total = np.where(sums[:, -1:] > 0.0, sums[:, -1:], 1.0)
    out = np.zeros((len(weights), weights.shape[1] + 1), np.float32)
    out[:, 1:] = np.round(sums / total * _STEPS) / _STEPS
    out[:, -1] = 1.0
    return out
