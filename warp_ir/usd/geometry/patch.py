"""UsdGeomNurbsPatch as triangles: a grid in the parameters of the surface, cut along its trim curves."""

from dataclasses import dataclass, replace

import numpy as np
from pxr import Usd, UsdGeom

from warp_ir.scene import Bools, Floats, Ints
from warp_ir.usd.geometry.detail import TOLERANCE, PixelSize, pixels_per_unit
from warp_ir.usd.geometry.nurbs import Spans, find_spans, numbered, rational
from warp_ir.usd.geometry.velocities import read_points
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable
from warp_ir.usd.values.triangles import TriangleMesh, drop_degenerate, with_normals

_MAX_PARTS = 32
"""Maximum number of parts of a span in each direction."""
_TRIMMED_PARTS = 64
"""Minimum number of parts of a trimmed surface in each direction."""
_TRIM_PARTS = 16
"""Straight parts of a span of a trim curve."""
_BISECTIONS = 20
_MAX_ORDER = 32
_BLOCK = 2**22
"""Pairs of points and edges that are compared at once."""


@dataclass(frozen=True, eq=False)
class _Surface:
    """A NURBS surface: U spans times V spans."""

    u: Spans
    v: Spans
    columns: int
    """Number of control points in the direction of u, in which their index grows first."""
    point_weights: Floats | None
    """float64 [n], or None."""
    shape: tuple[int, int]
    """Number of segments in u and v, those of no length included."""

    def basis(self, place: "_Place") -> tuple[Ints, Floats, Floats, Floats]:
        """Control points int [s, w], their weights and the derivatives of these by u and by v, float64 [s, w]."""
        (u, du), (v, dv) = self.u.weights(place.u_span, place.u), self.v.weights(place.v_span, place.v)
        i = self.u.first[place.u_span, None] + np.arange(u.shape[1])
        j = self.v.first[place.v_span, None] + np.arange(v.shape[1])
        control: Ints = (j[:, :, None] * self.columns + i[:, None, :]).reshape(len(u), -1)

        def product(a: Floats, b: Floats) -> Floats:
            products: Floats = np.einsum("si,sj->sji", a, b)
            return products.reshape(len(a), -1)

        values, by_u, by_v = product(u, v), product(du, v), product(u, dv)
        if self.point_weights is None:
            return control, values, by_u, by_v
        weights = self.point_weights[control]
        return control, *rational(values, by_u, weights), rational(values, by_v, weights)[1]


@dataclass(frozen=True, eq=False)
class _Place:
    """Points of the domain: spans int [s] and parameters within them, float64 [s], for u and v."""

    u_span: Ints
    u: Floats
    v_span: Ints
    v: Floats


@dataclass(frozen=True, eq=False)
class _PatchRefiner:
    """Primvars of a patch at the vertices of its triangles (`PrimvarRefiner`)."""

    surface: _Surface
    place: _Place

    def vertex(self, values: Floats) -> Floats:
        """Values of control points, by the basis of the surface."""
        control, weights, _, _ = self.surface.basis(self.place)
        out: Floats = np.einsum("sw,swc->sc", weights, values[control])
        return out

    def varying(self, values: Floats) -> Floats:
        """Values of the corners of segments, bilinearly."""
        i, j = self.surface.u.first[self.place.u_span], self.surface.v.first[self.place.v_span]
        row, u, v = self.surface.shape[0] + 1, self.place.u[:, None], self.place.v[:, None]
        corner = j * row + i
        low = values[corner] * (1.0 - u) + values[corner + 1] * u
        high = values[corner + row] * (1.0 - u) + values[corner + row + 1] * u
        out: Floats = low * (1.0 - v) + high * v
        return out

    def face_varying(self, values: Floats, indices: Ints | None = None) -> Floats:
        """The same as varying."""
        return self.varying(values if indices is None else values[indices])


def read_patch(
    prim: Usd.Prim, time: Usd.TimeCode, report: Report, matrices: Floats, pixel: PixelSize | None = None
) -> TriangleMesh | None:
    """The triangles of a NurbsPatch; None if it has no points.

    Args:
        prim: The patch.
        time: Time at which attributes are read.
        report: Receives warnings.
        matrices: world_from_prim of all its instances, [k, 4, 4].
        pixel: The size of a pixel; None: not known.

    Raises:
        Unreadable: An array has the wrong type, or orders, knots and points do not fit.
    """
    points, sampled = read_points(prim, time, report)
    if points is None or len(points) == 0:
        return None
    surface = _read_surface(prim, points, time, report)
    loops = _trim_loops(prim, time, report)
    density = float(pixels_per_unit(pixel, points, matrices).max())
    divisions = [_divisions(surface, points, density, along_u, trimmed=bool(loops)) for along_u in (True, False)]
    place, triangles = _grid(surface, *divisions)
    if loops:
        place, triangles = _trim(surface, place, triangles, loops)
    control, values, by_u, by_v = surface.basis(place)
    vertices, u, v = (np.einsum("sw,swc->sc", w, points[control]) for w in (values, by_u, by_v))
    middle = place.u_span[triangles], place.v_span[triangles]
    face = surface.v.first[middle[1].min(axis=1)] * surface.shape[0] + surface.u.first[middle[0].min(axis=1)]
    segments = surface.shape
    corners = (segments[0] + 1) * (segments[1] + 1)
    shape = TriangleMesh(
        points=vertices,
        triangles=triangles.astype(np.int32),
        face=face.astype(np.int32),
        corner=triangles.astype(np.int32),
        element_counts={
            **{"uniform": segments[0] * segments[1], "vertex": len(points)},
            **{"varying": corners, "faceVarying": corners},
        },
        refiner=_PatchRefiner(surface, place),
        sampled=sampled,
    )
    shape = drop_degenerate(shape)
    if len(shape.triangles) == 0:
        return None
    shape = with_normals(shape, np.cross(u, v)[shape.triangles])
    if read.text(prim.GetAttribute("orientation"), time) != UsdGeom.Tokens.leftHanded:
        return shape
    normals = None if shape.normals is None else -shape.normals[:, ::-1]
    reversed_triangles = np.ascontiguousarray(shape.triangles[:, ::-1])
    return replace(shape, triangles=reversed_triangles, corner=reversed_triangles, normals=normals)


def _read_surface(prim: Usd.Prim, points: Floats, time: Usd.TimeCode, report: Report) -> _Surface:
    """The surface of a patch; raises `Unreadable`."""
    if not np.isfinite(points).all():
        raise Unreadable("it has points that are infinite or NaN")
    sizes, spans = [], []
    for name in ("u", "v"):
        count, order = (_integer(prim, name + what, time) for what in ("VertexCount", "Order"))
        knots = read.scalars(prim.GetAttribute(f"{name}Knots"), time)
        if knots is None or not 2 <= order <= min(count, _MAX_ORDER) or len(knots) != count + order:
            number = 0 if knots is None else len(knots)
            raise Unreadable(f"{name}: {count} points of order {order} do not fit {number} knots")
        limits = read.raw(prim.GetAttribute(f"{name}Range"), time)
        ranges = None if limits is None else np.array(limits, np.float64).reshape(-1, 2)
        if ranges is not None and not (len(ranges) == 1 and np.isfinite(ranges).all() and ranges[0, 0] < ranges[0, 1]):
            report.warn(prim.GetPath(), f"{name}Range is no range; ignored")
            ranges = None
        found, _ = find_spans(np.array([count]), np.array([order]), knots, ranges)
        if len(found.curve) == 0:
            raise Unreadable(f"{name}Knots and {name}Range leave nothing")
        sizes.append((count, count - order + 1))
        spans.append(found)
    if sizes[0][0] * sizes[1][0] != len(points):
        raise Unreadable(f"it has {len(points)} points, not {sizes[0][0]} times {sizes[1][0]}")
    weights = read.scalars(prim.GetAttribute("pointWeights"), time)
    if weights is not None and not (len(weights) == len(points) and (np.isfinite(weights) & (weights > 0.0)).all()):
        if len(weights):
            report.warn(
                prim.GetPath(), f"pointWeights is not a positive number for each of {len(points)} points; ignored"
            )
        weights = None
    return _Surface(spans[0], spans[1], sizes[0][0], weights, (sizes[0][1], sizes[1][1]))


def _integer(prim: Usd.Prim, name: str, time: Usd.TimeCode) -> int:
    value = read.raw(prim.GetAttribute(name), time)
    if not isinstance(value, int):
        raise Unreadable(f"{name} is missing")
    return value


def _divisions(surface: _Surface, points: Floats, density: float, along_u: bool, *, trimmed: bool) -> Ints:
    """Number of parts of each span in one direction, int [g], by how far a span is from its chord in pixels."""
    along, across = (surface.u, surface.v) if along_u else (surface.v, surface.u)
    count, others = len(along.curve), len(across.curve)
    deviation = np.zeros(count)
    span, other = (grid.reshape(-1) for grid in np.meshgrid(np.arange(count), np.arange(others), indexing="ij"))
    for t in (0.0, 0.5):
        at = []
        for s in (0.0, 0.25, 0.5, 0.75, 1.0):
            here = span, np.full(len(span), s), other, np.full(len(span), t)
            control, weights, _, _ = surface.basis(_Place(*(here if along_u else (*here[2:], *here[:2]))))
            at.append(np.einsum("sw,swc->sc", weights, points[control]))
        bends = (at[k] - 0.5 * (at[k - 1] + at[k + 1]) for k in (1, 2, 3))
        farthest = 4.0 * np.max([np.linalg.norm(bend, axis=1) for bend in bends], axis=0)  # for the whole span
        deviation = np.maximum(deviation, farthest.reshape(count, others).max(axis=1))
    parts = np.ceil(np.sqrt(deviation * density / TOLERANCE)).clip(1, _MAX_PARTS).astype(np.int64)
    return np.maximum(parts, -(-_TRIMMED_PARTS // count)) if trimmed else parts


def _grid(surface: _Surface, u_parts: Ints, v_parts: Ints) -> tuple[_Place, Ints]:
    """The points of a grid over the domain, and its triangles, int [m, 3]."""
    axes = []
    for parts in (u_parts, v_parts):
        ends = np.zeros(len(parts), np.int64)
        ends[-1] = 1
        span, k = numbered(parts + ends)
        axes.append((span, k / parts[span]))
    (u_span, u), (v_span, v) = axes
    columns, rows = len(u), len(v)
    place = _Place(np.tile(u_span, rows), np.tile(u, rows), np.repeat(v_span, columns), np.repeat(v, columns))
    i, j = np.meshgrid(np.arange(columns - 1), np.arange(rows - 1))
    a = (j * columns + i).reshape(-1)
    b, c, d = a + 1, a + columns + 1, a + columns
    return place, np.stack([a, b, c, a, c, d], axis=1).reshape(-1, 3)


def _trim_loops(prim: Usd.Prim, time: Usd.TimeCode, report: Report) -> list[Floats]:
    """The closed polygons, float64 [p, 2] in u and v, that trim curves describe."""
    names = ("counts", "orders", "vertexCounts")
    counts, orders, vertex_counts = (read.ints(prim.GetAttribute(f"trimCurve:{name}"), time) for name in names)
    knots = read.scalars(prim.GetAttribute("trimCurve:knots"), time)
    ranges = read.floats(prim.GetAttribute("trimCurve:ranges"), time, 2)
    points = read.floats(prim.GetAttribute("trimCurve:points"), time, 3)
    if counts is None or len(counts) == 0:
        return []
    if (
        orders is None
        or vertex_counts is None
        or knots is None
        or points is None
        or (
            not len(orders) == len(vertex_counts) == counts.sum()
            or len(knots) != (orders + vertex_counts).sum()
            or len(points) != vertex_counts.sum()
            or (ranges is not None and len(ranges) != len(orders))
            or orders.max(initial=2) > _MAX_ORDER
            or not np.isfinite(points).all()
        )
    ):
        report.warn(prim.GetPath(), "its trim curves do not fit together: it is not trimmed")
        return []
    spans, valid = find_spans(vertex_counts, orders, knots, ranges)
    if not valid.all() or not len(spans.curve):
        report.warn(prim.GetPath(), "its trim curves do not fit their knots: it is not trimmed")
        return []
    number = _TRIM_PARTS
    span, t = np.repeat(np.arange(len(spans.curve)), number), np.tile(np.arange(number) / number, len(spans.curve))
    weights, _ = spans.weights(span, t)
    columns = np.arange(weights.shape[1])
    first = (np.cumsum(vertex_counts) - vertex_counts)[spans.curve] + spans.first
    control = first[:, None] + np.where(columns < spans.order[:, None], columns, 0)
    homogeneous = np.einsum("sw,swc->sc", weights, points[control[span]])
    polygon = homogeneous[:, :2] / homogeneous[:, 2:]
    loop = np.repeat(np.arange(len(counts)), counts)[spans.curve[span]]
    return [polygon[loop == k] for k in range(len(counts))]


def _trim(surface: _Surface, place: _Place, triangles: Ints, loops: list[Floats]) -> tuple[_Place, Ints]:
    """The part of a triangulation of the domain that is inside of the loops, by the even-odd rule of RenderMan.

    Triangles across the boundary are cut where their edges cross it.
    """
    u_ends, v_ends = surface.u.parameters, surface.v.parameters

    def parameters(at: _Place) -> Floats:
        u0, u1 = u_ends[at.u_span].T
        v0, v1 = v_ends[at.v_span].T
        return np.stack([u0 + (u1 - u0) * at.u, v0 + (v1 - v0) * at.v], axis=1)

    start = np.concatenate(loops)
    end = np.concatenate([np.roll(loop, -1, axis=0) for loop in loops])
    domain = parameters(place)
    inside = _inside(domain, start, end)
    number = inside[triangles].sum(axis=1)
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    crossing, inverse = np.unique(edges, axis=0, return_inverse=True)
    crosses = inside[crossing[:, 0]] != inside[crossing[:, 1]]
    cut_of_edge = np.full(len(crossing), -1)
    cut_of_edge[crosses] = len(domain) + np.arange(int(crosses.sum()))
    a, b = domain[crossing[crosses, 0]], domain[crossing[crosses, 1]]
    a_inside, low, high = inside[crossing[crosses, 0]], np.zeros(len(a)), np.ones(len(a))
    for _ in range(_BISECTIONS):
        t = 0.5 * (low + high)
        same = _inside(a + t[:, None] * (b - a), start, end) == a_inside
        low, high = np.where(same, t, low), np.where(same, high, t)
    domain = np.concatenate([domain, a + low[:, None] * (b - a)])
    cuts = cut_of_edge[inverse.reshape(-1, 3)]  # of the edges 01, 12, 20
    parts = [triangles[number == 3]]
    for k in range(3):  # corner k is the only one inside, or the only one outside
        i, j = (k + 1) % 3, (k + 2) % 3
        alone = (number == 1) & inside[triangles[:, k]]
        parts.append(np.stack([triangles[alone, k], cuts[alone, k], cuts[alone, j]], axis=1))
        rest = (number == 2) & ~inside[triangles[:, k]]
        parts.append(np.stack([cuts[rest, k], triangles[rest, i], triangles[rest, j]], axis=1))
        parts.append(np.stack([cuts[rest, k], triangles[rest, j], cuts[rest, j]], axis=1))
    spans = []
    for axis, ends in enumerate((u_ends, v_ends)):
        span = (np.searchsorted(ends[:, 0], domain[:, axis], side="right") - 1).clip(0, len(ends) - 1)
        low, high = ends[span].T
        spans += [span, ((domain[:, axis] - low) / (high - low)).clip(0.0, 1.0)]
    return _Place(*spans), np.concatenate(parts)


def _inside(points: Floats, start: Floats, end: Floats) -> Bools:
    """Whether points [s, 2] are inside of closed polygons with edges from `start` to `end` [e, 2]: even-odd rule."""
    out = np.zeros(len(points), dtype=bool)
    with np.errstate(all="ignore"):
        slope = (end[:, 0] - start[:, 0]) / (end[:, 1] - start[:, 1])
    size = max(1, _BLOCK // max(1, len(start)))
    for first in range(0, len(points), size):
        x, y = points[first : first + size, :1], points[first : first + size, 1:]
        spanned = (start[:, 1] <= y) != (end[:, 1] <= y)
        on_the_right = x < start[:, 0] + (y - start[:, 1]) * slope
        out[first : first + size] = (spanned & on_the_right).sum(axis=1) % 2 == 1
    return out
