"""Tabulated 2D distributions over a rectangle or over directions: textures of lights, skies, photometry of lamps.

A distribution divides a rectangle evenly into cells, or the directions up to a polar angle into rows (bands of the
polar angle θ) and columns (sectors of the azimuth φ). Sampling inverts two cumulative distribution functions, first
that of the rows and then that of the row's columns; within a cell samples are uniform by area or by solid angle.
Values are interpolated bilinearly between the centres of cells.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.scene import Floats

wp.set_module_options({"enable_backward": False})

_UNIFORM_FRACTION = 0.01
"""Fraction of the samples spread evenly over all cells of positive weight, so that rounding leaves none unreachable."""
_CDF_STEPS = 2.0**24
"""Sample numbers are multiples of 1/_CDF_STEPS; so are the CDFs, which makes every cell's probability exact."""
_MAX_COMPARED_SIZE = 2**18
"""Tables of at most this many numbers are compared by value, larger ones by identity."""


@wp.struct
class Distribution2D:
    """One table of rows x columns cells; the first row is at v = 0 or θ = 0."""

    rows: int
    columns: int
    cdf: int  # index of the rows + 1 values of the row CDF; columns + 1 for every row follow
    texels: int  # index of the rows x columns values
    max_theta: float  # over directions: the polar angle at which the last row ends [rad]; 0: over a rectangle


@wp.struct
class Distribution2DTables:
    """All distributions of a scene."""

    distributions: wp.array[Distribution2D]
    cdf: wp.array[wp.float32]
    texels: wp.array[wp.vec3]


@wp.struct
class CellSample:
    """A sampled cell, and a point in it."""

    row: int
    column: int
    x: float  # in [0, 1) along the row
    y: float  # in [0, 1) across the rows
    probability: float  # of the cell


@wp.func
def _find_interval(cdf: wp.array[wp.float32], first: int, count: int, u: float) -> int:
    """The non-empty interval, of `count`, whose CDF values enclose u."""
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
def sample_cell(tables: Distribution2DTables, index: int, u: wp.vec2) -> CellSample:
    """Samples a cell in proportion to its weight: u[1] selects the row, u[0] the column."""
    distribution = tables.distributions[index]
    cell = CellSample()
    cell.row = _find_interval(tables.cdf, distribution.cdf, distribution.rows, u[1])
    low = tables.cdf[distribution.cdf + cell.row]
    row_probability = tables.cdf[distribution.cdf + cell.row + 1] - low
    cell.y = (u[1] - low) / row_probability
    first = distribution.cdf + distribution.rows + 1 + cell.row * (distribution.columns + 1)
    cell.column = _find_interval(tables.cdf, first, distribution.columns, u[0])
    low = tables.cdf[first + cell.column]
    column_probability = tables.cdf[first + cell.column + 1] - low
    cell.x = (u[0] - low) / column_probability
    cell.probability = row_probability * column_probability
    return cell


@wp.func
def _cell_probability(tables: Distribution2DTables, distribution: Distribution2D, row: int, column: int) -> float:
    """The probability of sampling a cell."""
    first = distribution.cdf + distribution.rows + 1 + row * (distribution.columns + 1) + column
    row_probability = tables.cdf[distribution.cdf + row + 1] - tables.cdf[distribution.cdf + row]
    return row_probability * (tables.cdf[first + 1] - tables.cdf[first])


@wp.func
def _versine(theta: float) -> float:
    """1 - cosθ, exact for small angles."""
    s = wp.sin(0.5 * theta)
    return 2.0 * s * s


@wp.func
def _cell_solid_angle(distribution: Distribution2D, row: int) -> float:
    """Solid angle [sr] of one cell of a row."""
    row_angle = distribution.max_theta / float(distribution.rows)
    height = _versine(row_angle * float(row + 1)) - _versine(row_angle * float(row))
    return height * 2.0 * wp.pi / float(distribution.columns)


@wp.func(inline=False)
def cell_direction(tables: Distribution2DTables, index: int, cell: CellSample) -> wp.vec4:
    """The unit direction around +z of a sample in a cell, and its pdf per solid angle."""
    distribution = tables.distributions[index]
    row_angle = distribution.max_theta / float(distribution.rows)
    h = wp.lerp(_versine(row_angle * float(cell.row)), _versine(row_angle * float(cell.row + 1)), cell.y)
    r = wp.sqrt(wp.max(0.0, h * (2.0 - h)))
    phi = 2.0 * wp.pi * (float(cell.column) + cell.x) / float(distribution.columns)
    return wp.vec4(
        r * wp.cos(phi), r * wp.sin(phi), 1.0 - h, cell.probability / _cell_solid_angle(distribution, cell.row)
    )


@wp.func
def texel_coordinates(distribution: Distribution2D, d: wp.vec3) -> wp.vec2:
    """Column and row, with fractions, at which a unit direction around +z lies."""
    theta = wp.atan2(wp.sqrt(d[0] * d[0] + d[1] * d[1]), d[2])
    phi = wp.atan2(d[1], d[0])
    revolutions = phi / (2.0 * wp.pi)
    if revolutions < 0.0:
        revolutions += 1.0
    return wp.vec2(revolutions * float(distribution.columns), theta / distribution.max_theta * float(distribution.rows))


@wp.func(inline=False)
def direction_pdf(tables: Distribution2DTables, index: int, d: wp.vec3) -> float:
    """The pdf per solid angle with which `cell_direction` samples a unit direction."""
    distribution = tables.distributions[index]
    texel = texel_coordinates(distribution, d)
    row = wp.clamp(int(texel[1]), 0, distribution.rows - 1)
    return _cell_probability(
        tables, distribution, row, wp.clamp(int(texel[0]), 0, distribution.columns - 1)
    ) / _cell_solid_angle(distribution, row)


@wp.func(inline=False)
def uv_pdf(tables: Distribution2DTables, index: int, uv: wp.vec2) -> float:
    """The pdf per du dv of the samples of a rectangle at uv coordinates in [0, 1]²."""
    distribution = tables.distributions[index]
    row = wp.clamp(int(uv[1] * float(distribution.rows)), 0, distribution.rows - 1)
    column = wp.clamp(int(uv[0] * float(distribution.columns)), 0, distribution.columns - 1)
    return _cell_probability(tables, distribution, row, column) * float(distribution.rows) * float(distribution.columns)


@wp.func
def cell_uv(tables: Distribution2DTables, index: int, cell: CellSample) -> wp.vec2:
    """The uv coordinates in [0, 1]² of a sample of a rectangle."""
    distribution = tables.distributions[index]
    return wp.vec2(
        (float(cell.column) + cell.x) / float(distribution.columns),
        (float(cell.row) + cell.y) / float(distribution.rows),
    )


@wp.func
def _texel(tables: Distribution2DTables, distribution: Distribution2D, row: int, column: int) -> wp.vec3:
    """The value of a cell; outside the table that of the nearest cell."""
    r = wp.clamp(row, 0, distribution.rows - 1)
    c = wp.clamp(column, 0, distribution.columns - 1)
    if distribution.max_theta > 0.0:  # the azimuth is periodic
        c = ((column % distribution.columns) + distribution.columns) % distribution.columns
    return tables.texels[distribution.texels + r * distribution.columns + c]


@wp.func(inline=False)
def interpolate(tables: Distribution2DTables, index: int, texel: wp.vec2) -> wp.vec3:
    """The value at a column and row with fractions, interpolated bilinearly between the centres of cells."""
    distribution = tables.distributions[index]
    x = texel[0] - 0.5
    y = texel[1] - 0.5
    column = int(wp.floor(x))
    row = int(wp.floor(y))
    fx = x - float(column)
    fy = y - float(row)
    upper = wp.lerp(_texel(tables, distribution, row, column), _texel(tables, distribution, row, column + 1), fx)
    lower = wp.lerp(
        _texel(tables, distribution, row + 1, column), _texel(tables, distribution, row + 1, column + 1), fx
    )
    return wp.lerp(upper, lower, fy)


@wp.func
def value_at_uv(tables: Distribution2DTables, index: int, uv: wp.vec2) -> wp.vec3:
    """The value of a rectangle at uv coordinates in [0, 1]²."""
    distribution = tables.distributions[index]
    return interpolate(tables, index, wp.vec2(uv[0] * float(distribution.columns), uv[1] * float(distribution.rows)))


@wp.func
def value_at_direction(tables: Distribution2DTables, index: int, d: wp.vec3) -> wp.vec3:
    """The value in a unit direction around +z."""
    return interpolate(tables, index, texel_coordinates(tables.distributions[index], d))


@dataclass(frozen=True, eq=False)
class _HostDistribution:
    """The arguments of `Distribution2DList.add`."""

    values: Floats
    max_theta: float
    weights: Floats | None
    store_values: bool

    def equals(self, other: "_HostDistribution") -> bool:
        """Whether the tables are certainly equal: large ones only if they are the same objects."""
        return (self.max_theta, self.store_values) == (other.max_theta, other.store_values) and all(
            a is b
            or (a is not None and b is not None and max(a.size, b.size) <= _MAX_COMPARED_SIZE and np.array_equal(a, b))
            for a, b in ((self.values, other.values), (self.weights, other.weights))
        )


class Distribution2DList:
    """Distributions on the host, to be uploaded together."""

    def __init__(self, previous: Sequence["Distribution2DList"] = ()) -> None:
        """Creates an empty list; `upload` reuses the tables of a list in `previous` with equal contents."""
        self._previous = previous
        self._distributions: list[_HostDistribution] = []
        self._tables: Distribution2DTables | None = None

    def add(
        self, values: Floats, *, max_theta: float = 0.0, weights: Floats | None = None, store_values: bool = True
    ) -> int:
        """Adds a distribution and returns its index.

        Args:
            values: [rows, columns, 3], not negative; must not change afterwards.
            max_theta: Polar angle at which the last row ends [rad]; 0: over a rectangle.
            weights: [rows, columns], relative probabilities of the cells; None: the integral over the cell of the mean
                of the channels.
            store_values: Whether kernels look the values up; otherwise only the CDFs are uploaded.
        """
        self._distributions.append(_HostDistribution(values, max_theta, weights, store_values))
        return len(self._distributions) - 1

    def upload(self, launcher: Launcher) -> Distribution2DTables:
        """The tables on the device; an empty list has one unused row, since kernels never get a null pointer."""
        if self._tables is None:
            reused = next((p._tables for p in self._previous if self._equals(p)), None)
            self._tables = reused or self._upload(launcher)
            self._previous = ()
        return self._tables

    def _equals(self, other: "Distribution2DList") -> bool:
        return len(self._distributions) == len(other._distributions) and all(
            a.equals(b) for a, b in zip(self._distributions, other._distributions, strict=True)
        )

    def _upload(self, launcher: Launcher) -> Distribution2DTables:
        table = np.zeros(max(len(self._distributions), 1), Distribution2D.numpy_dtype())
        cdf, texels = [np.zeros(0 if self._distributions else 1, np.float32)], [np.zeros((0, 3), np.float32)]
        cdf_length = texels_length = 0
        for k, distribution in enumerate(self._distributions):
            rows, columns = distribution.values.shape[:2]
            weights = distribution.weights
            if weights is None:
                weights = cell_means(distribution.values.mean(axis=2), periodic=distribution.max_theta > 0.0)
                weights = weights * row_areas(rows, distribution.max_theta)[:, None]
            table[k] = (rows, columns, cdf_length, texels_length, distribution.max_theta)
            cdf.append(_nested_cdf(weights))
            cdf_length += len(cdf[-1])
            if distribution.store_values:
                texels.append(distribution.values.reshape(-1, 3).astype(np.float32))
                texels_length += rows * columns
        out = Distribution2DTables()
        out.distributions = launcher.array(table, Distribution2D)
        out.cdf = launcher.array(np.concatenate(cdf), wp.float32)
        out.texels = launcher.array(np.concatenate(texels) if texels_length else np.zeros((1, 3)), wp.vec3)
        return out


def row_areas(rows: int, max_theta: float) -> npt.NDArray[np.float64]:
    """Summed area of the cells of each row, float64 [rows]: of the unit square, or a solid angle [sr]."""
    if max_theta == 0.0:
        return np.full(rows, 1.0 / rows)
    edges = 2.0 * np.sin(0.5 * max_theta * np.arange(rows + 1) / rows) ** 2
    return 2.0 * np.pi * np.diff(edges)


def cell_means(values: Floats, *, periodic: bool) -> npt.NDArray[np.float64]:
    """Means of the bilinear interpolation over each cell, to which the neighbours' values contribute.

    Args:
        values: [rows, columns], at the centres of the cells.
        periodic: Whether the last column is followed by the first.
    """
    out = np.pad(np.asarray(values, np.float64), ((1, 1), (0, 0)), mode="edge")
    out = 0.125 * (out[:-2] + 6.0 * out[1:-1] + out[2:])
    out = np.pad(out, ((0, 0), (1, 1)), mode="wrap" if periodic else "edge")
    return 0.125 * (out[:, :-2] + 6.0 * out[:, 1:-1] + out[:, 2:])


def _nested_cdf(weights: Floats) -> npt.NDArray[np.float32]:
    """The CDF of the rows [rows + 1], followed by that of the cells of each row [columns + 1]."""
    rows, columns = weights.shape
    weights = np.asarray(weights, np.float64)
    if weights.max() > 0.0:
        weights = weights / weights.max()
        positive = weights > 0.0
        weights = (1.0 - _UNIFORM_FRACTION) * weights / weights.sum() + _UNIFORM_FRACTION * positive / positive.sum()
    out = np.zeros(rows + 1 + rows * (columns + 1), np.float32)
    out[: rows + 1] = _cdf(weights.sum(axis=1)[None])[0]
    out[rows + 1 :] = _cdf(weights).reshape(-1)
    return out


def _cdf(weights: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """CDFs [n, k + 1] of rows of weights [n, k], rounded to multiples of 1/_CDF_STEPS."""
    sums = np.cumsum(weights, axis=1)
    total = np.where(sums[:, -1:] > 0.0, sums[:, -1:], 1.0)
    out = np.zeros((len(weights), weights.shape[1] + 1), np.float32)
    out[:, 1:] = np.round(sums / total * _CDF_STEPS) / _CDF_STEPS
    out[:, -1] = 1.0
    return out
