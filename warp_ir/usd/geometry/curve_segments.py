"""UsdGeom's curves as polynomial segments: control points and basis functions of each, for all curves at once."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom

from warp_ir.scene import Bools, Floats, Ints
from warp_ir.usd.geometry.nurbs import Spans, find_spans, numbered, rational
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable

_LINEAR = np.array([[1.0, 0.0], [-1.0, 1.0]])
_BASES = {
    "bezier": np.array([[1, 0, 0, 0], [-3, 3, 0, 0], [3, -6, 3, 0], [-1, 3, -3, 1]], np.float64),
    "bspline": np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]], np.float64) / 6.0,
    "catmullRom": np.array([[0, 2, 0, 0], [-1, 0, 1, 0], [2, -5, 4, -1], [-1, 3, -3, 1]], np.float64) / 2.0,
}
"""Basis matrices of cubic curves: row k has the coefficients of t^k, a column per control point."""
_HERMITE = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [-3, 3, -2, -1], [2, -2, 1, 1]], np.float64)
"""Its columns: two points and their tangents."""
_MAX_ORDER = 32
"""Maximum order of a NURBS curve."""


@dataclass(frozen=True, eq=False)
class Segments:
    """The g polynomial segments of a prim's curves, in the order of the curves."""

    curve: Ints
    """int [g], index of the curve of which each segment is part."""
    control: Ints
    """int [g, w], control points: rows of what `extended` returns."""
    varying: Ints
    """int [g, 2], indices of the varying values at both ends."""
    counts: dict[str, int]
    """`TriangleMesh.element_counts` of the prim."""
    matrix: Floats | None = None
    """Basis matrix [w, w]; None: `spans` have the basis functions."""
    spans: Spans | None = None
    """The segments of B-splines with knots of their own."""
    point_weights: Floats | None = None
    """float64 [g, w], weights of the control points of rational segments; None: all are 1."""
    phantoms: Ints = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    """int [f, 2]: behind the points, row k is 2 P[a] - P[b] for (a, b) = phantoms[k]."""
    closed: bool = False
    """Whether every curve ends where it begins."""
    tangents: bool = False
    """Whether the last two control points of a segment are tangents, which lie behind the points."""

    def extended(self, values: Floats) -> Floats:
        """Values [n, c] of the points, and those of the phantom points behind them."""
        if len(self.phantoms) == 0:
            return values
        return np.concatenate([values, 2.0 * values[self.phantoms[:, 0]] - values[self.phantoms[:, 1]]])

    def weights(self, segment: Ints, t: Floats) -> tuple[Floats, Floats]:
        """Weights of the control points and their derivatives by t, float64 [s, w] each, at t [s] in [0, 1]."""
        if self.matrix is not None:
            exponents = np.arange(1, len(self.matrix))
            return _polynomials(self.matrix, t), _polynomials(exponents[:, None] * self.matrix[1:], t)
        assert self.spans is not None
        values, slopes = self.spans.weights(segment, t)
        return (values, slopes) if self.point_weights is None else rational(values, slopes, self.point_weights[segment])

    def keep(self, mask: Bools) -> "Segments":
        """The segments that a mask [g] selects; it selects whole curves."""
        return replace(
            self,
            curve=self.curve[mask],
            control=self.control[mask],
            varying=self.varying[mask],
            spans=None if self.spans is None else self.spans.keep(mask),
            point_weights=None if self.point_weights is None else self.point_weights[mask],
        )


def read_segments(prim: Usd.Prim, schema: str, point_count: int, time: Usd.TimeCode, report: Report) -> Segments | None:
    """The segments of a BasisCurves, HermiteCurves or NurbsCurves; None if it has no curves.

    Curves that cannot be drawn are left out with a warning.

    Args:
        prim: The curves.
        schema: Name of the schema.
        point_count: Number of its points.
        time: Time at which attributes are read.
        report: Receives warnings.

    Raises:
        Unreadable: An array has the wrong type, or the points do not fit its curves at all.
    """
    counts = read.ints(UsdGeom.Curves(prim).GetCurveVertexCountsAttr(), time)
    if counts is None or len(counts) == 0 or point_count == 0:
        return None
    if counts.min() < 0:
        raise Unreadable("curveVertexCounts has negative values")
    first = np.cumsum(counts) - counts
    fits = first + counts <= point_count
    if not fits.all() or counts.sum() != point_count:
        what = f"curveVertexCounts add up to {counts.sum()}, but it has {point_count} points"
        report.warn(prim.GetPath(), f"{what}: curves without points are left out")
    if schema == "NurbsCurves":
        return _nurbs(prim, counts, first, fits, point_count, time, report)
    if schema == "HermiteCurves":
        segments = _hermite(counts, first, fits, point_count)
    else:
        segments = _basis_curves(prim, counts, first, fits, point_count, time, report)
    lacking = fits & (counts > 0)
    if segments is not None:
        lacking[segments.curve] = False
    if lacking.any():
        report.warn(prim.GetPath(), "{n} curves with too few points left out", int(lacking.sum()))
    return segments


def _basis_curves(
    prim: Usd.Prim, counts: Ints, first: Ints, fits: Bools, point_count: int, time: Usd.TimeCode, report: Report
) -> Segments | None:
    """Segments of BasisCurves."""
    curves = UsdGeom.BasisCurves(prim)
    wrap = read.text(curves.GetWrapAttr(), time, "nonperiodic")
    closed = wrap == UsdGeom.Tokens.periodic
    if read.text(curves.GetTypeAttr(), time, "cubic") == UsdGeom.Tokens.linear:
        return _chain(counts, first, fits, point_count, _LINEAR, closed)
    basis = read.text(curves.GetBasisAttr(), time, "bezier")
    if basis not in _BASES:
        raise Unreadable(f"its basis is '{basis}', not one of {', '.join(_BASES)}")
    if basis == "bezier":
        remainder = counts % 3 if closed else (counts - 4) % 3
        lost = int((fits & (counts >= (3 if closed else 4)) & (remainder != 0)).sum())
        if lost:
            report.warn(prim.GetPath(), "{n} Bézier curves have surplus points, which are ignored", lost)
    return _cubic(counts, first, fits, point_count, basis, wrap)


def _hermite(counts: Ints, first: Ints, fits: Bools, point_count: int) -> Segments | None:
    """Segments of HermiteCurves: their control points are two points, and two tangents, which lie behind all points."""
    chain = _chain(counts, first, fits, point_count, _HERMITE)
    if chain is None:
        return None
    control = np.concatenate([chain.control, chain.control + point_count], axis=1)
    return replace(chain, control=control, tangents=True)


def _chain(
    counts: Ints, first: Ints, fits: Bools, point_count: int, matrix: Floats, closed: bool = False
) -> Segments | None:
    """Segments from each point to the next one."""
    number = np.where(fits & (counts >= (3 if closed else 2)), counts if closed else counts - 1, 0)
    curve, k = numbered(number)
    ends = first[curve, None] + np.stack([k, (k + 1) % counts[curve]], axis=1)
    return _segments(curve, ends, ends, counts, point_count, point_count, matrix=matrix, closed=closed)


def _cubic(counts: Ints, first: Ints, fits: Bools, point_count: int, basis: str, wrap: str) -> Segments | None:
    """Cubic segments of a basis."""
    step = 3 if basis == "bezier" else 1
    closed = wrap == UsdGeom.Tokens.periodic
    pinned = wrap == UsdGeom.Tokens.pinned and basis != "bezier"
    if closed:
        number = np.where(counts >= 3, counts // step, 0)
    elif pinned:
        number = np.where(counts >= 2, counts - 1, 0)
    else:
        number = np.where(counts >= 4, (counts - 4) // step + 1, 0)
    varying_number = number if closed else np.where(number > 0, number + 1, 0)
    varying_first = np.cumsum(varying_number) - varying_number
    curve, k = numbered(np.where(fits, number, 0))
    local = k[:, None] * step + np.arange(4) - (1 if pinned else 0)
    size = counts[curve, None]
    phantoms = np.zeros((0, 2), np.int64)
    if pinned:
        drawn = np.flatnonzero(fits & (number > 0))
        before, last = np.zeros(len(counts), np.int64), first + counts - 1
        before[drawn] = point_count + 2 * np.arange(len(drawn))
        pairs = [[first[drawn], first[drawn] + 1], [last[drawn], last[drawn] - 1]]
        phantoms = np.array(pairs).transpose(2, 0, 1).reshape(-1, 2)
        control = first[curve, None] + local
        control = np.where(local < 0, before[curve, None], control)
        control = np.where(local >= size, before[curve, None] + 1, control)
    else:
        control = first[curve, None] + (local % size if closed else local)
    ends = varying_first[curve, None] + np.stack([k, (k + 1) % number[curve] if closed else k + 1], axis=1)
    return _segments(
        *(curve, control, ends, counts, point_count, int(varying_number.sum())),
        matrix=_BASES[basis],
        phantoms=phantoms,
        closed=closed,
    )


def _nurbs(
    prim: Usd.Prim, counts: Ints, first: Ints, fits: Bools, point_count: int, time: Usd.TimeCode, report: Report
) -> Segments | None:
    """Segments of NurbsCurves: the spans between their knots."""
    curves, path = UsdGeom.NurbsCurves(prim), prim.GetPath()
    orders = read.ints(curves.GetOrderAttr(), time)
    knots = read.scalars(curves.GetKnotsAttr(), time)
    ranges = read.floats(curves.GetRangesAttr(), time, 2)
    weights = read.scalars(curves.GetPointWeightsAttr(), time)
    if orders is None or knots is None or len(orders) not in (1, len(counts)):
        raise Unreadable(f"its {len(counts)} curves need an order each, and knots")
    orders = np.broadcast_to(orders, len(counts))
    if len(knots) != (counts + orders).sum() or orders.max() > _MAX_ORDER or orders.min() < 0:
        raise Unreadable(f"{len(knots)} knots do not fit {counts.sum()} points of its orders")
    if ranges is not None and len(ranges) != len(counts):
        report.warn(path, f"ranges has {len(ranges)} values for {len(counts)} curves; ignored")
        ranges = None
    if weights is not None and not (len(weights) == point_count and (np.isfinite(weights) & (weights > 0.0)).all()):
        if len(weights):
            report.warn(path, f"pointWeights is not a positive number for each of {point_count} points; ignored")
        weights = None
    found, valid = find_spans(counts, orders, knots, ranges)
    if not valid.all():
        report.warn(path, "{n} curves whose order or knots do not fit are left out", int((~valid).sum()))
    found = found.keep(fits[found.curve])
    columns = np.arange(int(orders.max()))
    control = first[found.curve, None] + found.first[:, None] + np.where(columns < found.order[:, None], columns, 0)
    number = np.maximum(counts - orders + 2, 0)
    varying = (np.cumsum(number) - number)[found.curve] + found.first
    varying_ends = np.stack([varying, varying + 1], axis=1)
    parts = found.curve, control, varying_ends, counts, point_count, int(number.sum())
    return _segments(*parts, spans=found, point_weights=None if weights is None else weights[control])


def _segments(
    curve: Ints, control: Ints, varying: Ints, counts: Ints, points: int, varying_count: int, **basis: Any
) -> Segments | None:
    """The record of the segments; None if there are none."""
    numbers = {"uniform": len(counts), "vertex": points, "varying": varying_count, "faceVarying": varying_count}
    return Segments(curve, control, varying, numbers, **basis) if len(curve) else None


def _polynomials(coefficients: Floats, t: Floats) -> Floats:
    """Polynomials at t [s] by Horner's rule, float64 [s, w], contiguous along s; row k: the coefficients of t^k [w]."""
    values = np.empty((coefficients.shape[1], len(t)))
    for row, column in zip(values, coefficients.T, strict=True):
        row[:] = column[-1]
        for coefficient in column[-2::-1]:
            row *= t
            row += coefficient
    return values.T
