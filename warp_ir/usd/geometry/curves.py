"""UsdGeom's curves as tubes and ribbons, all curves of a prim at once.

A tube has as many sides as its width in the picture needs, and its polygon has the circle's perimeter: a straight tube
has the area of its cylinder and, by Cauchy's formula, the width of its silhouette on average over all directions.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from pxr import Usd, UsdGeom

from warp_ir.scene import Bools, Floats, Ints
from warp_ir.usd.geometry.curve_segments import Segments, read_segments
from warp_ir.usd.geometry.detail import TOLERANCE, PixelSize, pixels_per_unit
from warp_ir.usd.geometry.nurbs import numbered
from warp_ir.usd.geometry.skinning import Skinning
from warp_ir.usd.geometry.velocities import read_points
from warp_ir.usd.values import read
from warp_ir.usd.values.primvar import SchemaPrimvar, schema_primvar
from warp_ir.usd.values.report import Report, Unreadable
from warp_ir.usd.values.triangles import TriangleMesh

CURVES = ("BasisCurves", "HermiteCurves", "NurbsCurves")
"""The schemas that are read."""
_MAX_SIDES = 32
"""Maximum number of sides of a tube."""
_MAX_PARTS = 32
"""Maximum number of straight parts of a segment."""
_MAX_TRIANGLES = 40_000_000
"""Triangles of a prim above which it is tessellated more coarsely."""
_BLOCK = 2**14
"""Samples whose vertices are computed at once."""
_MAX_MITRE = 2.0
"""Maximum factor on a tube's radius where it bends sharply."""


@dataclass(frozen=True, eq=False)
class _Samples:
    """The s points that divide the curves into straight parts; those of a curve follow each other."""

    segments: Segments
    segment: Ints
    """int [s]."""
    t: Floats
    """float64 [s], parameter in the segment, in [0, 1]."""
    weights: Floats
    """float64 [s, w], weights of the segment's control points."""
    last: Bools
    """bool [s], whether a sample is the last one of its curve; each curve has its own, even if it is closed."""

    @property
    def curve(self) -> Ints:
        """The curve of each sample, int [s]."""
        return self.segments.curve[self.segment]

    @property
    def first(self) -> Bools:
        """Whether a sample is the first one of its curve, bool [s]."""
        return np.concatenate([[True], self.last[:-1]])

    def vertex(self, values: Floats) -> Floats:
        """Values [n, c] of the points, by the basis of the curves; linearly, if control points are tangents."""
        if self.segments.tangents:
            return self.varying(values)
        return _weighted(self.segments.extended(values), self.segments.control[self.segment], self.weights)

    def varying(self, values: Floats) -> Floats:
        """Values [v, c] of the ends of segments, linearly."""
        ends = self.segments.varying[self.segment]
        start, end = values[ends[:, 0]], values[ends[:, 1]]
        out: Floats = start + self.t[:, None] * (end - start)
        return out

    def read(self, primvar: SchemaPrimvar, values: Floats, indices: Ints | None) -> Floats:
        """Values of widths or normals, [s, c], by their interpolation, or else by the one that their number fits.

        Raises:
            Unreadable: Their number fits none.
        """
        count = len(values) if indices is None else len(indices)
        if indices is not None:
            read.check_range(indices, len(values), primvar.attribute.GetName())
            values = values[indices]
        sizes = {"constant": 1, **self.segments.counts}
        if sizes.get(primvar.interpolation) == count:
            interpolation = primvar.interpolation
        else:
            fitting = [name for name, size in sizes.items() if size == count]
            if not fitting:
                needed = sizes.get(primvar.interpolation)
                name = f"{primvar.attribute.GetName()} has {count} {primvar.interpolation} values"
                raise Unreadable(name if needed is None else f"{name} where {needed} are needed")
            interpolation = fitting[0]
        if interpolation == UsdGeom.Tokens.constant:
            return np.broadcast_to(values[0], (len(self.t), values.shape[1]))
        if interpolation == UsdGeom.Tokens.uniform:
            return values[self.curve]
        return self.vertex(values) if interpolation == UsdGeom.Tokens.vertex else self.varying(values)


@dataclass(frozen=True, eq=False)
class _CurveRefiner:
    """Primvars of curves at the vertices of their tubes or ribbons (`PrimvarRefiner`)."""

    samples: _Samples
    sides: Ints
    """int [s], number of vertices around each sample."""

    def vertex(self, values: Floats) -> Floats:
        """Values of the points."""
        return np.repeat(self.samples.vertex(values), self.sides, axis=0)

    def varying(self, values: Floats) -> Floats:
        """Values of the ends of segments."""
        return np.repeat(self.samples.varying(values), self.sides, axis=0)

    def face_varying(self, values: Floats, indices: Ints | None = None) -> Floats:
        """The same as varying."""
        return self.varying(values if indices is None else values[indices])


def read_curves(
    prim: Usd.Prim,
    schema: str,
    time: Usd.TimeCode,
    report: Report,
    matrices: Floats,
    pixel: PixelSize | None = None,
    skinning: Skinning | None = None,
) -> TriangleMesh | None:
    """The triangles of BasisCurves, HermiteCurves or NurbsCurves; None if there is nothing to draw.

    Curves with normals are ribbons that face them, others are tubes without caps.

    Args:
        prim: The curves.
        schema: One of `CURVES`.
        time: Time at which attributes are read.
        report: Receives warnings.
        matrices: world_from_prim of all its instances, [k, 4, 4].
        pixel: The size of a pixel; None: not known.
        skinning: Deforms curves that are bound to a skeleton; None leaves them in their rest pose.

    Raises:
        Unreadable: An array has the wrong type, or fits nothing.
    """
    points, sampled = read_points(prim, time, report)
    if points is None or len(points) == 0:
        return None
    segments = read_segments(prim, schema, len(points), time, report)
    if segments is None:
        return None
    deformed = None if skinning is None else skinning.deform(prim, points)
    controls = _control_points(prim, segments, points if deformed is None else deformed.points, time)
    segments = _finite_curves(prim, segments, controls, report)
    if len(segments.curve) == 0:
        return None
    at = read.sample_before if sampled else _unchanged
    widths, normals = schema_primvar(prim, "widths"), schema_primvar(prim, "normals")
    width_values = _values(prim, widths, 1, time, at(widths.attribute, time), report)
    normal_values = _values(prim, normals, 3, time, at(normals.attribute, time), report)
    density = pixels_per_unit(pixel, controls[segments.control[:, 0]], matrices)
    if width_values is None:
        width_values = np.full((1, 1), _default_width(prim, controls, report)), None
    largest = _widths_of_segments(segments, *width_values)
    samples, sides = _divide(segments, controls, 0.5 * largest * density, density, normal_values is not None)
    width = samples.read(widths, *width_values)[:, 0]
    facing = None if normal_values is None else samples.read(normals, *normal_values)
    shape = _sweep(prim, samples, controls, 0.5 * width, sides, facing, report)
    if read.text(prim.GetAttribute("orientation"), time) == UsdGeom.Tokens.leftHanded:
        flipped = None if shape.normals is None else -shape.normals[:, ::-1]
        triangles = np.ascontiguousarray(shape.triangles[:, ::-1])
        shape = replace(shape, triangles=triangles, corner=triangles, normals=flipped)
    return replace(shape, sampled=sampled) if len(shape.triangles) else None


def _unchanged(_attribute: Usd.Attribute, time: Usd.TimeCode) -> Usd.TimeCode:
    return time


def _weighted(values: Floats, control: Ints, weights: Floats) -> Floats:
    """Sums of w control values [n, c] with weights [s, w], float64 [s, c]."""
    out: Floats = weights[:, 0, None] * values[control[:, 0]]
    for k in range(1, control.shape[1]):
        out += weights[:, k, None] * values[control[:, k]]
    return out


def _control_points(prim: Usd.Prim, segments: Segments, points: Floats, time: Usd.TimeCode) -> Floats:
    """All control points: points, and what lies behind them.

    Raises:
        Unreadable: There is not one tangent per point.
    """
    if not segments.tangents:
        return segments.extended(points)
    tangents = read.floats(UsdGeom.HermiteCurves(prim).GetTangentsAttr(), time, 3)
    if tangents is None or len(tangents) != len(points):
        raise Unreadable(f"it has {0 if tangents is None else len(tangents)} tangents for {len(points)} points")
    return np.concatenate([points, tangents])


def _finite_curves(prim: Usd.Prim, segments: Segments, controls: Floats, report: Report) -> Segments:
    """The segments of those curves whose control points are finite."""
    finite: Bools = np.asarray(np.isfinite(controls).all(axis=1))
    if finite.all():
        return segments
    broken = np.zeros(segments.counts["uniform"], dtype=bool)
    broken[segments.curve[~finite[segments.control].all(axis=1)]] = True
    if broken.any():
        report.warn(prim.GetPath(), "{n} curves with infinite or NaN points left out", int(broken.sum()))
    return segments.keep(~broken[segments.curve])


def _values(
    prim: Usd.Prim, primvar: SchemaPrimvar, columns: int, time: Usd.TimeCode, at: Usd.TimeCode, report: Report
) -> tuple[Floats, Ints | None] | None:
    """Widths or normals, float64 [v, columns], and indices into them; None if there are none.

    Raises:
        Unreadable: They are of another type.
    """
    if columns == 1:
        scalars = read.scalars(primvar.attribute, at)
        values = None if scalars is None else scalars[:, None]
    else:
        values = read.floats(primvar.attribute, at, columns)
    if values is None or len(values) == 0:
        return None
    usable: Bools = np.asarray(np.isfinite(values).all(axis=1))
    if columns == 1:
        usable &= values[:, 0] >= 0.0
    if not usable.all():
        what = f"{{n}} {primvar.attribute.GetName()} that are no {'widths' if columns == 1 else 'vectors'} taken as 0"
        report.warn(prim.GetPath(), what, int((~usable).sum()))
        values[~usable] = 0.0
    return values, primvar.indices(time)


def _widths_of_segments(segments: Segments, widths: Floats, indices: Ints | None) -> Floats:
    """The width of each segment, roughly: the larger one of its ends, float64 [g]."""
    values = (widths if indices is None else widths[indices.clip(0, len(widths) - 1)])[:, 0]
    sizes = segments.counts
    out: Floats = np.full(len(segments.curve), values.max())
    if len(values) == sizes["uniform"]:
        out = values[segments.curve]
    elif len(values) == sizes["varying"]:
        out = values[segments.varying].max(axis=1)
    elif len(values) == sizes["vertex"]:
        out = values[segments.control[:, :2].clip(0, len(values) - 1)].max(axis=1)
    return out


def _default_width(prim: Usd.Prim, points: Floats, report: Report) -> float:
    """The width of curves without widths, for which the schema has no fallback: thin."""
    used = points[np.isfinite(points).all(axis=1)]
    width = float(np.linalg.norm(np.ptp(used, axis=0))) / 500.0
    report.warn(prim.GetPath(), "it has no widths: 1/500 of its extent is used")
    return width


def _divide(segments: Segments, controls: Floats, radius: Floats, density: Floats, flat: bool) -> tuple[_Samples, Ints]:
    """Where the segments are divided, and how many sides each sample has, so that the outline shows neither.

    A circle of radius r and a polygon of n sides and the same perimeter differ by 3.3 r / n² at most; a chord of a
    curve differs by its second derivative over 8 n².

    Args:
        segments: The g segments.
        controls: Control points.
        radius: Radius of the tube in pixels, float64 [g].
        density: Pixels per unit, float64 [g].
        flat: Whether the curves are ribbons.
    """
    tolerance = TOLERANCE
    bend, turn = _curvature(segments, controls)
    run = np.concatenate([[0], np.flatnonzero(np.diff(segments.curve)) + 1])  # first segment of each curve
    number = np.diff(np.concatenate([run, [len(segments.curve)]]))
    while True:
        deviation = bend * density + turn**2 * radius
        parts = np.ceil(np.sqrt(deviation / (8.0 * tolerance))).clip(1, _MAX_PARTS).astype(np.int64)
        widest = np.maximum.reduceat(radius, run)
        sides = np.ceil(np.sqrt(3.3 * widest / tolerance)).clip(3, _MAX_SIDES).astype(np.int64)
        sides = np.full_like(sides, 2) if flat else sides
        if 2 * int((np.add.reduceat(parts, run) * (1 if flat else sides)).sum()) <= _MAX_TRIANGLES:
            break
        if parts.max() == 1 and sides.max() <= 3:
            break
        tolerance *= 2.0
    ends = np.zeros(len(parts), dtype=bool)
    ends[run[1:] - 1] = ends[-1] = True
    segment, k = numbered(parts + ends)
    t = k / parts[segment]
    last = k == parts[segment]
    weights, _ = segments.weights(segment, t)
    return _Samples(segments, segment, t, weights, last), np.repeat(np.repeat(sides, number), parts + ends)


def _curvature(segments: Segments, controls: Floats) -> tuple[Floats, Floats]:
    """Bounds of a segment's second derivative and of the angle by which it turns, float64 [g] each."""
    count = len(segments.curve)
    if segments.control.shape[1] == 2:
        return np.zeros(count), np.zeros(count)
    every = np.arange(count if segments.matrix is None else 1)  # the same weights in all, except for B-splines
    slopes = []
    for t in (0.0, 0.5, 1.0):
        _, derivative = segments.weights(every, np.full(len(every), t))
        slopes.append(_weighted(controls, segments.control, derivative))
    changes = [_lengths(b - a) for a, b in pairwise(slopes)]
    speed = np.mean([_lengths(slope) for slope in slopes], axis=0)
    bend = 2.0 * np.max(changes, axis=0)
    turn = np.minimum(np.sum(changes, axis=0) / np.where(speed > 0.0, speed, 1.0), 2.0 * np.pi)
    return bend, turn


def _sweep(
    prim: Usd.Prim,
    samples: _Samples,
    controls: Floats,
    radius: Floats,
    sides: Ints,
    facing: Floats | None,
    report: Report,
) -> TriangleMesh:
    """Tubes around the samples, or ribbons that face `facing` [s, 3].

    Args:
        prim: The curves, named in warnings.
        samples: The samples.
        controls: Control points.
        radius: Half of the width, float64 [s].
        sides: Number of sides, int [s]; 2 for ribbons.
        facing: Directions that ribbons face; None: tubes.
        report: Receives warnings.
    """
    centers = _weighted(controls, samples.segments.control[samples.segment], samples.weights)
    tangent, mitre, stretch = _tangents(samples, controls, centers)
    link = np.flatnonzero(~samples.last)
    length = _lengths(centers[link + 1] - centers[link])
    thick = radius > 0.0
    solid = (length > 0.0) & (thick[link] | thick[link + 1])
    if not solid.all():
        report.warn(prim.GetPath(), "{n} parts of curves without length or width left out", int((~solid).sum()))
        link = link[solid]
    if len(link) == 0:
        return TriangleMesh(centers, np.zeros((0, 3), np.int32), np.zeros(0, np.int32), np.zeros((0, 3), np.int32))
    if facing is None:
        across, up = _frames(samples, tangent)
        slope = _slopes(samples, centers, radius)
    else:
        across, slope = _unit(np.cross(tangent, facing), tangent), None
        up = np.cross(across, tangent)
    start = (np.cumsum(sides) - sides).astype(np.int32)
    points, normals = np.empty((int(sides.sum()), 3)), np.empty((int(sides.sum()), 3), np.float32)
    for n, rows in _equal_blocks(sides):
        if facing is None:
            angle = 2.0 * np.pi / n * np.arange(n, dtype=np.float32)[:, None]
            cosine, sine = np.cos(angle), np.sin(angle)
            reach = radius[rows] * (np.pi / n) / np.sin(np.pi / n)  # the polygon has the circle's perimeter
        else:
            cosine, sine, reach = np.array([[-1.0], [1.0]], np.float32), np.zeros((2, 1), np.float32), radius[rows]
        offset = cosine * across[rows, None].astype(np.float32) + sine * up[rows, None].astype(np.float32)
        if facing is not None:
            normal = np.broadcast_to(up[rows, None], offset.shape)
        elif slope is None:
            normal = offset.copy()
        else:
            tilted = offset - (slope[rows, None] * tangent[rows]).astype(np.float32)[:, None]
            normal = tilted / np.sqrt(1.0 + slope[rows] ** 2).astype(np.float32)[:, None, None]
        bent = np.flatnonzero(stretch[rows])
        if len(bent):
            along = np.einsum("sni,si->sn", offset[bent], mitre[rows[bent]])
            offset[bent] += (stretch[rows[bent], None] * along)[..., None] * mitre[rows[bent], None]
        vertices: Ints | slice = np.add.outer(start[rows], np.arange(n, dtype=np.int32)).reshape(-1)
        if rows[-1] - rows[0] + 1 == len(rows):  # the usual case, without indices
            vertices = slice(int(start[rows[0]]), int(start[rows[-1]]) + n)
        normals[vertices] = normal.reshape(-1, 3)
        points[vertices] = (centers[rows, None] + reach[:, None, None] * offset).reshape(-1, 3)
    parts: list[tuple[Ints, Ints, Floats]] = []
    for n, rows in _equal_blocks(sides[link]):
        here = link[rows]
        k = np.arange(n if facing is None else 1, dtype=np.int32)
        after = np.where(k + 1 == n, 0, k + 1).astype(np.int32)  # the next vertex of the ring
        low, high = start[here, None], start[here + 1, None]
        a, b, c, d = low + k, low + after, high + after, high + k
        drawn = np.repeat(np.stack([thick[here], thick[here + 1]], axis=1), len(k), axis=0).reshape(-1)
        triangles = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
        curve = np.repeat(samples.segments.curve[samples.segment[here]].astype(np.int32), 2 * len(k))
        if not drawn.all():
            triangles, curve = triangles[drawn], curve[drawn]
        parts.append((triangles, curve, normals[triangles]))
    triangles, curve, corner_normals = (np.concatenate(part) for part in zip(*parts, strict=True))
    return TriangleMesh(
        points=points,
        triangles=triangles,
        face=curve,
        corner=triangles,
        normals=corner_normals,
        element_counts=samples.segments.counts,
        refiner=_CurveRefiner(samples, sides),
    )


def _tangents(samples: _Samples, controls: Floats, centers: Floats) -> tuple[Floats, Floats, Floats]:
    """Directions of the curves at the samples, and how their tubes are mitred.

    Where segments meet at an angle, the direction is the mean of both, and the tube's cross section is stretched.

    Returns:
        Unit tangents [s, 3]; unit directions of stretching [s, 3], and by how much [s].
    """
    segments, segment = samples.segments, samples.segment
    chord = np.diff(centers, axis=0, append=centers[-1:])
    chord[samples.last] = 0.0
    chord[1:][samples.last[1:]] = chord[:-1][samples.last[1:]]
    _, slopes = segments.weights(segment, samples.t)
    after = _unit(_weighted(controls, segments.control[segment], slopes), chord)
    before = after.copy()
    inner = np.flatnonzero((samples.t == 0.0) & ~samples.first)
    ends, starts = np.flatnonzero(samples.last), np.flatnonzero(samples.first)
    _, slopes = segments.weights(segment[inner] - 1, np.ones(len(inner)))
    before[inner] = _unit(_weighted(controls, segments.control[segment[inner] - 1], slopes), chord[inner - 1])
    if segments.closed:
        before[starts], after[ends] = before[ends], after[starts]
    total = before + after
    length = _lengths(total)
    tangent = _unit(total, after)
    bent = length < 2.0 - 1e-9
    mitre, stretch = np.zeros_like(tangent), np.zeros(len(tangent))
    mitre[bent] = _unit((before - after)[bent], tangent[bent])
    stretch[bent] = np.minimum(2.0 / np.maximum(length[bent], 1e-12), _MAX_MITRE) - 1.0
    return tangent, mitre, stretch


def _equal_blocks(numbers: Ints) -> Iterator[tuple[int, Ints]]:
    """Each number that occurs, with indices of where it does, in blocks that fit into a cache."""
    for number in np.unique(numbers).tolist():
        rows = np.flatnonzero(numbers == number)
        for first in range(0, len(rows), _BLOCK):
            yield number, rows[first : first + _BLOCK]


def _lengths(vectors: Floats) -> Floats:
    """Lengths [s] of vectors [s, 3]."""
    lengths: Floats = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
    return lengths


def _unit(vectors: Floats, fallback: Floats) -> Floats:
    """Unit vectors [s, 3]; where there is no direction, that of the fallback, or else +Z."""
    length = _lengths(vectors)[:, None]
    usable = length[:, 0] > 0.0
    if usable.all():
        return vectors / length
    out = np.tile([0.0, 0.0, 1.0], (len(vectors), 1))
    other = _lengths(fallback)[:, None]
    second = ~usable & (other[:, 0] > 0.0)
    out[second] = fallback[second] / other[second]
    out[usable] = vectors[usable] / length[usable]
    return out


def _slopes(samples: _Samples, centers: Floats, radius: Floats) -> Floats | None:
    """Change of the radius per length along the curves, float64 [s]; None if it does not change."""
    change, length = np.diff(radius), _lengths(np.diff(centers, axis=0))
    inside = ~samples.last[:-1]
    if not change[inside].any():
        return None
    rise, run = np.zeros(len(radius)), np.zeros(len(radius))
    for part in (slice(0, -1), slice(1, None)):  # to the next sample and from the previous one
        rise[part][inside] += change[inside]
        run[part][inside] += length[inside]
    slopes: Floats = rise / np.where(run > 0.0, run, 1.0)
    return slopes


def _frames(samples: _Samples, tangent: Floats) -> tuple[Floats, Floats]:
    """Two unit vectors [s, 3] that are perpendicular to the tangents and turn as little as possible along the curves.

    A rotation takes each tangent to the next one (parallel transport); their products from the start of each curve are
    a scan in logarithmically many steps.
    """
    before = np.concatenate([tangent[:1], tangent[:-1]])
    before[samples.first] = [0.0, 0.0, 1.0]
    rotation = _rotations(before, tangent)
    position = np.arange(len(tangent)) - np.flatnonzero(samples.first)[np.cumsum(samples.first) - 1]
    step, longest = 1, int(position.max(initial=0))
    while step <= longest:
        later = np.flatnonzero(position >= step)
        rotation[later] = _product(rotation[later], rotation[later - step])
        step *= 2
    x, y, z, w = rotation.T
    across = np.stack([1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w)], axis=1)
    across = _unit(across - np.einsum("ij,ij->i", across, tangent)[:, None] * tangent, across)
    up = np.cross(tangent, across)
    if samples.segments.closed:  # the twist that is left where a closed curve meets itself is spread over it
        starts, ends = np.flatnonzero(samples.first), np.flatnonzero(samples.last)
        cosine = np.einsum("ij,ij->i", across[ends], across[starts])
        twist = np.arctan2(np.einsum("ij,ij->i", across[ends], up[starts]), cosine)
        run = np.cumsum(samples.first) - 1
        angle = -twist[run] * position / position[ends][run]
        cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
        across, up = cosine * across + sine * up, cosine * up - sine * across
    return across, up


def _rotations(start: Floats, end: Floats) -> Floats:
    """Unit quaternions [s, 4] (x, y, z, w) of the smallest rotations from unit vectors to others."""
    w = 1.0 + np.einsum("ij,ij->i", start, end)
    axis = np.cross(start, end)
    opposite = w < 1e-9
    if opposite.any():
        smallest = np.eye(3)[np.argmin(np.abs(start[opposite]), axis=1)]
        axis[opposite], w[opposite] = np.cross(start[opposite], smallest), 0.0
    quaternion = np.concatenate([axis, w[:, None]], axis=1)
    out: Floats = quaternion / _lengths(quaternion)[:, None]
    return out


def _product(p: Floats, q: Floats) -> Floats:
    """Products of quaternions [s, 4]: first the rotation q, then p."""
    (a, b, c, d), (e, f, g, h) = p.T, q.T
    return np.stack(
        [
            d * e + a * h + b * g - c * f,
            d * f - a * g + b * h + c * e,
            d * g + a * f - b * e + c * h,
            d * h - a * e - b * f - c * g,
        ],
        axis=1,
    )
