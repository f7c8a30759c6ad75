"""B-splines: the spans between the knots of many curves, and their basis functions."""

from dataclasses import dataclass

import numpy as np

from warp_ir.scene import Bools, Floats, Ints


@dataclass(frozen=True, eq=False)
class Spans:
    """The g spans of positive length between the knots of B-splines: polynomial segments."""

    curve: Ints
    """int [g], index of the curve."""
    first: Ints
    """int [g], the first control point that a span depends on, counted within the curve."""
    order: Ints
    """int [g], degree plus one, which is the number of those control points."""
    knots: Floats
    """float64 [g, 2 w - 2], w being the largest order: the 2 order - 2 knots that a span depends on, then padding."""
    part: Floats
    """float64 [g, 2], the part of the span that is drawn: its ends as shares of its length."""

    @property
    def parameters(self) -> Floats:
        """The parameter at both ends of what is drawn of each span, float64 [g, 2]."""
        rows = np.arange(len(self.order))
        low, high = self.knots[rows, self.order - 2], self.knots[rows, self.order - 1]
        return low[:, None] + (high - low)[:, None] * self.part

    def keep(self, mask: Bools) -> "Spans":
        """The spans that a mask [g] selects."""
        return Spans(self.curve[mask], self.first[mask], self.order[mask], self.knots[mask], self.part[mask])

    def weights(self, span: Ints, t: Floats) -> tuple[Floats, Floats]:
        """Basis functions and their derivatives by t, float64 [s, w] each, at t [s] in [0, 1] of spans [s]."""
        width = self.knots.shape[1] // 2 + 1
        values, slopes = np.zeros((len(span), width)), np.zeros((len(span), width))
        for order in np.unique(self.order).tolist():
            chosen = np.flatnonzero(self.order[span] == order)
            rows = span[chosen]
            n, d = _basis_functions(self.knots[rows, : 2 * order - 2], self.part[rows], t[chosen])
            values[chosen, :order], slopes[chosen, :order] = n, d
        return values, slopes


def find_spans(counts: Ints, orders: Ints, knots: Floats, ranges: Floats | None) -> tuple[Spans, Bools]:
    """The spans of B-splines, and which of the c curves are valid, bool [c]; the others have no spans.

    Args:
        counts: Number of control points of each curve, int [c].
        orders: Order of each curve, int [c].
        knots: The knots of all curves, one after the other, float64 [sum(counts + orders)].
        ranges: The range of the parameter that is drawn of each curve, float64 [c, 2]; None: all of it.
    """
    width = int(orders.max(initial=2))
    first_knot = np.cumsum(counts + orders) - (counts + orders)
    falls = np.concatenate([~(np.diff(knots) >= 0.0), [False]])
    falls[first_knot[1:] - 1] = False  # from one curve to the next
    owner = np.repeat(np.arange(len(counts)), counts + orders)
    broken = np.bincount(owner[falls | ~np.isfinite(knots)], minlength=len(counts)) > 0
    valid = (orders >= 2) & (counts >= orders) & ~broken
    curve, k = numbered(np.where(valid, counts - orders + 1, 0))
    order = orders[curve]
    at = first_knot[curve] + order - 1 + k
    low, high = knots[at], knots[at + 1]
    length = np.where(high > low, high - low, 1.0)
    part = np.tile([0.0, 1.0], (len(curve), 1))
    if ranges is not None:
        part = ((ranges[curve] - low[:, None]) / length[:, None]).clip(0.0, 1.0)
    window = at[:, None] + np.arange(2 * width - 2) + 2 - order[:, None]
    spans = Spans(curve, k, order, knots[window.clip(0, len(knots) - 1)], part)
    return spans.keep((high > low) & (part[:, 1] > part[:, 0])), valid


def numbered(counts: Ints) -> tuple[Ints, Ints]:
    """For each of sum(counts) elements of groups: the group, and the element's number in it."""
    group = np.repeat(np.arange(len(counts)), counts)
    return group, np.arange(len(group)) - np.repeat(np.cumsum(counts) - counts, counts)


def rational(values: Floats, slopes: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Basis functions and derivatives [s, w] of rational curves, whose control points have the weights [s, w]."""
    values, slopes = values * weights, slopes * weights
    total = values.sum(axis=1, keepdims=True)
    values = values / total
    return values, slopes / total - values * (slopes.sum(axis=1, keepdims=True) / total)


def _basis_functions(knots: Floats, part: Floats, t: Floats) -> tuple[Floats, Floats]:
    """The p + 1 basis functions of degree p that are not zero in a span, and their derivatives by t.

    The NURBS Book (Piegl and Tiller, 2nd edition), algorithm A2.2 and equation 2.7.

    Args:
        knots: float64 [s, 2 p], the knots on which they depend; the middle two bound the span.
        part: float64 [s, 2], where in the span t = 0 and t = 1 are, as shares of its length.
        t: float64 [s].
    """
    degree = knots.shape[1] // 2
    length = knots[:, degree] - knots[:, degree - 1]
    rate = length * (part[:, 1] - part[:, 0])
    u = knots[:, degree - 1] + length * part[:, 0] + rate * t
    values = np.zeros((len(t), degree + 1))
    lower = values
    values[:, 0] = 1.0
    for j in range(1, degree + 1):
        lower = values.copy()
        saved = np.zeros(len(t))
        for r in range(j):
            right, left = knots[:, degree + r] - u, u - knots[:, degree - j + r]
            share = lower[:, r] / (right + left)
            values[:, r] = saved + right * share
            saved = left * share
        values[:, j] = saved
    slopes = np.zeros_like(values)
    for r in range(degree):
        rise = degree * lower[:, r] / (knots[:, degree + r] - knots[:, r])
        slopes[:, r] -= rise
        slopes[:, r + 1] += rise
    return values, slopes * rate[:, None]
