"""Subdivision surfaces: uniform refinement by Catmull-Clark, Loop or bilinear rules, of points and of primvars alike.

One level splits a face of c vertices into c quadrilaterals (Loop: a triangle into four). Every refined value is a
weighted mean of values around a face, an edge or a vertex. The weights depend only on topology and sharpness, so they
are computed once and applied to points and primvars. Rules as in OpenSubdiv: Catmull and Clark 1978, Loop 1987,
semi-sharp creases of DeRose, Kass and Truong 1998, seams of face-varying values as boundaries.
"""

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from warp_ir.scene import Bools, Floats, Ints

INFINITE = 10.0
"""Sharpness from which an edge or a vertex stays sharp at every level (OpenSubdiv's constant)."""
_SMOOTH_TRIANGLE = 0.47
"""Weight of a triangle's face point in an edge point with triangleSubdivisionRule "smooth"; else 1/4."""


class Scheme(Enum):
    """Subdivision schemes; the values are UsdGeom's tokens."""

    CATMULL_CLARK = "catmullClark"
    LOOP = "loop"
    BILINEAR = "bilinear"


@dataclass(frozen=True, eq=False)
class Cage:
    """The control cage: the mesh to refine.

    Every face has at least three vertices; Loop subdivision needs triangles.
    """

    counts: Ints
    """int64 [f], vertices per face."""
    indices: Ints
    """int64 [v], point of each face-vertex, in [0, points)."""
    points: int
    """Number of points."""
    edges: Ints
    """int64 [c, 2], pairs of points whose edge is a crease."""
    edge_sharpness: Floats
    """float64 [c], in [0, INFINITE]."""
    point_sharpness: Floats
    """float64 [points], in [0, INFINITE]."""
    sharp_boundary: bool = True
    """Whether edges with one face are infinitely sharp (interpolateBoundary is not "none")."""
    smooth_triangles: bool = False
    """Whether triangleSubdivisionRule is "smooth"."""
    face: Ints | None = None
    """int64 [f], the prim's face that each face is or is part of; None: the same indices."""
    corner: Ints | None = None
    """int64 [v], the prim's face-vertex of each face-vertex; None: the same indices."""

    def with_sharp_corners(self) -> "Cage":
        """This cage with points of a single face made infinitely sharp (interpolateBoundary "edgeAndCorner")."""
        single = np.bincount(self.indices, minlength=self.points) == 1
        return replace(self, point_sharpness=np.where(single, INFINITE, self.point_sharpness))


class Refinement:
    """A cage refined a number of times.

    Args:
        cage: The control cage.
        scheme: The subdivision scheme.
        levels: Number of refinements, at least 1.
        linear: UsdGeom's faceVaryingLinearInterpolation, for `face_varying`.

    Attributes:
        face: int64 [f'], the prim's face that each refined face is part of.
        indices: int64 [f', 4], or [f', 3] for Loop, refined point of each refined face-vertex.
        has_surface: bool [f'], False where no surface is defined (next to boundaries that are not interpolated).
    """

    def __init__(self, cage: Cage, scheme: Scheme, levels: int, linear: str = "cornersPlus1") -> None:
        self._cage, self._scheme, self._linear = cage, scheme, linear
        self._steps: list[_SubdivisionStep] = []
        parent: Ints = np.arange(len(cage.counts))
        mesh = self._base = _Topology.from_cage(cage)
        for _ in range(levels):
            step = _SubdivisionStep(mesh, scheme)
            self._steps.append(step)
            parent = parent[step.parent]
            mesh = step.child
        self._finest = mesh
        self.has_surface: Bools = self._base.faces_with_surface()[parent]
        self.face: Ints = parent if cage.face is None else cage.face[parent]
        self.indices: Ints = mesh.indices.reshape(len(mesh.counts), -1)

    def vertex(self, values: Floats) -> Floats:
        """Values [points, c] at the refined points by the rules of the scheme, float64 [points', c]."""
        for step in self._steps:
            values = step.smooth(values)
        return values

    def varying(self, values: Floats) -> Floats:
        """Values [points, c] at the refined points, linear over every face of the cage, float64 [points', c]."""
        for step in self._steps:
            values = step.linear(values)
        return values

    def face_varying(self, values: Floats, indices: Ints | None = None) -> Floats:
        """Values of the prim's face-vertices at the refined face-vertices, float64 [f' k, c].

        Args:
            values: [v, c], or [n, c] with indices.
            indices: int [v] into the values. Face-vertices of a point with different indices are divided by a seam;
                without indices, every face is interpolated separately.
        """
        if self._cage.corner is not None:
            values = values[self._cage.corner] if indices is None else values
            indices = None if indices is None else indices[self._cage.corner]
        if self._linear == "all" or self._scheme is Scheme.BILINEAR or indices is None:
            values = values if indices is None else values[indices]
            for step in self._steps:
                values = step.corners(values)
            return values
        cut, first = self._cut_along_seams(indices)
        refined = Refinement(cut, self._scheme, len(self._steps))
        return refined.vertex(values[indices[first]])[refined.indices.reshape(-1)]

    def normals(self, points: Floats) -> Floats:
        """Unit normals at the refined face-vertices, float64 [f' k, 3], smooth except across sharp refined edges.

        A normal is the sum over corners of the cross products of their two edges, so that it is weighted by area.

        Args:
            points: Refined points, float64 [points', 3].
        """
        corner = points[self.indices.reshape(-1)]
        products = corner_products(corner, self._finest.next, self._finest.previous)
        group = self._finest.smooth_groups()
        return unit_sums(products, group, int(group.max(initial=-1)) + 1)[group]

    def _cut_along_seams(self, indices: Ints) -> tuple[Cage, Ints]:
        """The cage cut along the seams of face-varying values.

        Returns:
            The cage, whose points are the distinct pairs of a point and a value index; and a face-vertex of each.
        """
        cage, base = self._cage, self._base
        pairs = cage.indices * (int(indices.max(initial=0)) + 1) + indices
        _, first, split = np.unique(pairs, return_index=True, return_inverse=True)
        point = cage.indices[first]
        count = len(first)
        faces = np.bincount(split, minlength=count)
        siblings = np.bincount(point, minlength=cage.points)[point]
        sharp = cage.point_sharpness[point]
        edges = np.stack([split, split[base.next]], axis=1)
        cut = Cage(cage.counts, split, count, edges, base.sharpness[base.edge], sharp)
        if self._linear != "none":
            sharp = np.where(faces == 1, INFINITE, sharp)
        if self._linear in ("cornersPlus1", "cornersPlus2"):
            sharp = np.where(siblings > 2, INFINITE, sharp)
        if self._linear in ("cornersPlus2", "boundaries"):
            mesh = _Topology.from_cage(cut)
            boundary = np.zeros(count, dtype=bool)
            boundary[mesh.ends[mesh.face_counts == 1].reshape(-1)] = True
            if self._linear == "boundaries":
                sharp = np.where(boundary, INFINITE, sharp)
            else:  # concave corners opposite to convex ones, and darts: the ends of a seam
                corner = np.bincount(point, weights=faces == 1, minlength=cage.points)[point] > 0
                mesh_boundary = np.zeros(cage.points, dtype=bool)
                mesh_boundary[base.ends[base.face_counts == 1].reshape(-1)] = True
                dart = (siblings == 1) & boundary & ~mesh_boundary[point]
                sharp = np.where((siblings == 2) & corner | dart, INFINITE, sharp)
        return replace(cut, point_sharpness=sharp, smooth_triangles=cage.smooth_triangles), first


def corner_products(corner: Floats, following: Ints, previous: Ints) -> Floats:
    """Cross products of the edges at face-vertices, to the next and to the previous one, float64 [3, v].

    Args:
        corner: Positions of the face-vertices, float64 [v, 3].
        following: The next face-vertex of the same face, int [v].
        previous: The face-vertex before it, int [v].
    """
    (x, y, z), (u, v, w) = (corner[following] - corner).T, (corner[previous] - corner).T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u])


def unit_sums(vectors: Floats, group: Ints, count: int) -> Floats:
    """Sums of the vectors [3, v] of each group [v], as unit vectors, float64 [count, 3]; 0 where they cancel out."""
    total = np.stack([np.bincount(group, weights=row, minlength=count) for row in vectors], axis=1)
    length = np.sqrt(np.einsum("ni,ni->n", total, total))[:, None]
    return np.asarray(total / np.where(length > 0.0, length, 1.0))


class _Topology:
    """Faces, edges and points of a mesh, and their sharpness.

    Attributes:
        counts: int64 [f], vertices per face.
        indices: int64 [v], point of each face-vertex.
        points: Number of points.
        face: int64 [v], face of each face-vertex.
        next: int64 [v], the next face-vertex of the same face; `previous` [v], the one before.
        edge: int64 [v], the edge from each face-vertex to the next.
        ends: int64 [e, 2], the two points of each edge.
        face_counts: int64 [e], number of faces at each edge.
        sharpness: float64 [e], sharpness of the edges.
        point_sharpness: float64 [points], sharpness of the points.
    """

    def __init__(
        self,
        cage: Cage,
        counts: Ints,
        indices: Ints,
        edge: Ints,
        ends: Ints,
        sharpness: Floats,
        point_sharpness: Floats,
    ) -> None:
        self.cage, self.counts, self.indices, self.points = cage, counts, indices, len(point_sharpness)
        self.edge, self.ends, self.point_sharpness = edge, ends, point_sharpness
        offsets = np.cumsum(counts) - counts
        self.face: Ints = np.repeat(np.arange(len(counts)), counts)
        self.next: Ints = np.arange(1, len(indices) + 1)
        self.next[offsets + counts - 1] = offsets
        self.previous: Ints = np.arange(-1, len(indices) - 1)
        self.previous[offsets] = offsets + counts - 1
        self.face_counts: Ints = np.bincount(edge, minlength=len(ends))
        # Non-manifold edges have no smooth surface.
        infinite = (self.face_counts > 2) | ((self.face_counts == 1) & cage.sharp_boundary)
        self.sharpness: Floats = np.where(infinite, INFINITE, sharpness)

    @staticmethod
    def from_cage(cage: Cage) -> "_Topology":
        """The topology of a cage, with its creases."""
        following = np.arange(1, len(cage.indices) + 1)
        ends = np.cumsum(cage.counts)
        following[ends - 1] = ends - cage.counts

        def key(a: Ints, b: Ints) -> Ints:
            keys: Ints = np.minimum(a, b).astype(np.int64) * cage.points + np.maximum(a, b)
            return keys

        keys, edge = np.unique(key(cage.indices, cage.indices[following]), return_inverse=True)
        sharpness = np.zeros(len(keys))
        if len(cage.edges):
            crease = key(cage.edges[:, 0], cage.edges[:, 1])
            index = np.searchsorted(keys, crease).clip(max=len(keys) - 1)
            is_edge = keys[index] == crease  # creases between points without an edge are ignored
            np.maximum.at(sharpness, index[is_edge], cage.edge_sharpness[is_edge])
        pairs = np.stack(np.divmod(keys, cage.points), axis=1)
        return _Topology(cage, cage.counts, cage.indices, edge, pairs, sharpness, cage.point_sharpness)

    def faces_with_surface(self) -> Bools:
        """Mask [f] of the faces without a point on a boundary edge that is not interpolated."""
        open_ends = self.ends[(self.face_counts == 1) & (self.sharpness < INFINITE)].reshape(-1)
        is_open = np.zeros(self.points, dtype=bool)
        is_open[open_ends] = True
        open_points = np.bincount(self.face, weights=is_open[self.indices], minlength=len(self.counts))
        return np.asarray(open_points == 0)

    def smooth_groups(self) -> Ints:
        """Smoothing groups: a number per face-vertex [v], equal for those of a point that no sharp edge divides."""
        points, sharp = self.indices, self.sharpness > 0.0
        divided = np.zeros(self.points, dtype=bool)
        divided[self.ends[sharp].reshape(-1)] = True
        at_divided = np.flatnonzero(divided[points])
        if len(at_divided) == 0:
            return points
        # At divided points only, corners are joined pairwise across every smooth edge with two faces.
        smooth_edges = np.flatnonzero(divided[self.ends].any(axis=1) & (self.face_counts == 2) & ~sharp)
        is_smooth = np.zeros(len(self.ends), dtype=bool)
        is_smooth[smooth_edges] = True
        around = np.flatnonzero(is_smooth[self.edge])
        one, two = around[np.argsort(self.edge[around], kind="stable")].reshape(-1, 2).T
        alike = points[one] == points[two]  # faces of opposite winding traverse their edge in the same direction
        links = np.concatenate(
            [
                np.stack([one, np.where(alike, two, self.next[two])], axis=1),
                np.stack([self.next[one], np.where(alike, self.next[two], two)], axis=1),
            ]
        )
        links = links[divided[points[links[:, 0]]]]
        label = np.arange(len(points))
        while True:  # connected components by label propagation; a few rounds suffice
            old = label[links]
            low = old.min(axis=1)
            merged = label.copy()
            np.minimum.at(merged, old[:, 0], low)
            np.minimum.at(merged, old[:, 1], low)
            merged = merged[merged[merged]]
            if (merged == label).all():
                break
            label = merged
        group = points.copy()
        group[at_divided] = self.points + label[at_divided]
        return group


class _SubdivisionStep:
    """One level of refinement: the refined topology, and the interpolation of values.

    The refined points are the vertex points, then an edge point per edge, then (not with Loop) a face point per face.
    """

    def __init__(self, mesh: _Topology, scheme: Scheme) -> None:
        self._mesh, self._loop = mesh, scheme is Scheme.LOOP
        edge_sharpness, point_sharpness = _child_sharpness(mesh.sharpness), _child_sharpness(mesh.point_sharpness)
        self._entries: tuple[Ints, Ints, Floats, int] | None = None
        if scheme is not Scheme.BILINEAR:
            self._entries = self._smooth_entries(*_vertex_weights(mesh, edge_sharpness, point_sharpness))
        edges, corners = len(mesh.ends), len(mesh.indices)
        edge_point = mesh.points + np.arange(edges)
        point, next_edge, previous_edge = mesh.indices, mesh.edge, mesh.edge[mesh.previous]
        # Child edges are numbered: the two halves of every edge, in the order of its ends, then those inside of faces.
        halves = np.stack([mesh.ends, np.stack([edge_point, edge_point], axis=1)], axis=2).reshape(-1, 2)
        next_half = 2 * next_edge + (mesh.ends[next_edge, 0] != point)
        previous_half = 2 * previous_edge + (mesh.ends[previous_edge, 0] != point)
        interior = 2 * edges + np.arange(corners)
        if self._loop:
            # Three child triangles at the corners, each bounded by an interior edge, and one in the middle.
            triples = [x.reshape(-1, 3) for x in (point, mesh.points + next_edge, mesh.points + previous_edge)]
            corner = np.stack(triples, axis=2).reshape(-1, 9)
            faces = np.concatenate([corner, triples[1]], axis=1).reshape(-1, 3)
            inner = interior.reshape(-1, 3)
            at_corners = [next_half.reshape(-1, 3), inner, previous_half.reshape(-1, 3)]
            outer = np.stack(at_corners, axis=2).reshape(-1, 9)
            edge = np.concatenate([outer, np.roll(inner, -1, axis=1)], axis=1).reshape(-1)
            interior_ends = np.stack([mesh.points + next_edge, mesh.points + previous_edge], axis=1)
            self.parent: Ints = np.repeat(np.arange(len(mesh.counts)), 4)
            total = mesh.points + edges
        else:
            face_point = mesh.points + edges + mesh.face
            faces = np.stack([point, mesh.points + next_edge, face_point, mesh.points + previous_edge], axis=1)
            edge = np.stack([next_half, interior, interior[mesh.previous], previous_half], axis=1).reshape(-1)
            interior_ends = np.stack([mesh.points + next_edge, face_point], axis=1)
            self.parent = mesh.face
            total = mesh.points + edges + len(mesh.counts)
        self.child = _Topology(
            mesh.cage,
            np.full(len(faces), faces.shape[1]),
            faces.reshape(-1),
            edge,
            np.concatenate([halves, interior_ends]),
            np.concatenate([np.repeat(edge_sharpness, 2), np.zeros(corners)]),
            np.concatenate([point_sharpness, np.zeros(total - mesh.points)]),
        )

    def smooth(self, values: Floats) -> Floats:
        """Values of points [n, c] at the refined points, by the rules of the scheme."""
        if self._entries is None:
            return self.linear(values)
        rows, columns, weights, edges = self._entries
        faces = None if self._loop else self._face_means(values[self._mesh.indices])
        source = values if faces is None else np.concatenate([values, faces])
        count = len(values) + edges
        sums = [np.bincount(rows, weights * source[columns, k], minlength=count) for k in range(values.shape[1])]
        refined = np.stack(sums, axis=1).astype(np.float64, copy=False)
        return refined if faces is None else np.concatenate([refined, faces])

    def linear(self, values: Floats) -> Floats:
        """Values of points [n, c] at the refined points, linear over every face."""
        edge_means = 0.5 * (values[self._mesh.ends[:, 0]] + values[self._mesh.ends[:, 1]])
        if self._loop:
            return np.concatenate([values, edge_means])
        return np.concatenate([values, edge_means, self._face_means(values[self._mesh.indices])])

    def corners(self, values: Floats) -> Floats:
        """Values of face-vertices [v, c] at the refined face-vertices, linear over every face."""
        next_mean = 0.5 * (values + values[self._mesh.next])
        previous_mean = next_mean[self._mesh.previous]
        columns = values.shape[1]
        if self._loop:
            corner = np.stack([values, next_mean, previous_mean], axis=1).reshape(-1, 9, columns)
            return np.concatenate([corner, next_mean.reshape(-1, 3, columns)], axis=1).reshape(-1, columns)
        face_mean = self._face_means(values)[self._mesh.face]
        return np.stack([values, next_mean, face_mean, previous_mean], axis=1).reshape(-1, columns)

    def _face_means(self, values: Floats) -> Floats:
        """Mean over each face of the values of its face-vertices [v, c], [f, c]."""
        counts = self._mesh.counts
        if len(counts) and (counts == counts[0]).all():
            mean: Floats = values.reshape(len(counts), int(counts[0]), -1).mean(axis=1)
            return mean
        sums = [np.bincount(self._mesh.face, values[:, k], minlength=len(counts)) for k in range(values.shape[1])]
        means: Floats = np.stack(sums, axis=1) / counts[:, None]
        return means

    def _smooth_entries(self, smooth: Floats, own: Floats, along: Floats) -> tuple[Ints, Ints, Floats, int]:
        """The sparse matrix from points and face points to vertex points and edge points.

        Args:
            smooth: Fraction of the smooth vertex rule at each point, [n].
            own: Weight of a point in its own vertex point by the crease and corner rules, [n].
            along: Weights by the crease rule of the opposite end of each edge, for both of its ends, [e, 2].

        Returns:
            Rows, columns and weights of the entries, and the number of edges.
        """
        mesh = self._mesh
        edges, index = len(mesh.ends), np.arange(mesh.points)
        valence = np.maximum(np.bincount(mesh.ends.reshape(-1), minlength=mesh.points), 1)
        faces = np.maximum(np.bincount(mesh.indices, minlength=mesh.points), 1)
        if self._loop:
            far = (0.625 - (0.375 + 0.25 * np.cos(2.0 * np.pi / valence)) ** 2) / valence
            near = 1.0 - valence * far
        else:
            far, near = 1.0 / valence**2, 1.0 - 2.0 / valence
        near = np.where(smooth > 0.0, near, 0.0)
        rows = [index, mesh.ends[:, 0], mesh.ends[:, 1]]
        columns = [index, mesh.ends[:, 1], mesh.ends[:, 0]]
        weights = [own + smooth * near, *(along + (smooth * far)[mesh.ends]).T]
        row, crease = (
            mesh.points + np.arange(edges),
            np.where(mesh.face_counts == 2, np.minimum(mesh.sharpness, 1.0), 1.0),
        )
        if self._loop:
            opposite_point = mesh.indices[mesh.previous]
            opposite = 0.125 * (1.0 - crease)[mesh.edge]
            end = 0.375 * (1.0 - crease) + 0.5 * crease
            rows += [row, row, mesh.points + mesh.edge]
            columns += [mesh.ends[:, 0], mesh.ends[:, 1], opposite_point]
            weights += [end, end, opposite]
        else:
            triangle = (mesh.counts == 3) & mesh.cage.smooth_triangles
            face_weight = np.where(triangle, _SMOOTH_TRIANGLE, 0.25)[mesh.face]
            mean_weight = 0.5 * np.bincount(mesh.edge, face_weight, minlength=edges)
            end = (1.0 - crease) * (0.5 - mean_weight) + 0.5 * crease
            rows += [mesh.indices, row, row, mesh.points + mesh.edge]
            columns += [mesh.points + mesh.face, mesh.ends[:, 0], mesh.ends[:, 1], mesh.points + mesh.face]
            weights += [
                (smooth / (valence * faces))[mesh.indices],
                end,
                end,
                ((1.0 - crease) * mean_weight)[mesh.edge],
            ]
        return np.concatenate(rows), np.concatenate(columns), np.concatenate(weights), edges


def _vertex_weights(
    mesh: _Topology, child_edge_sharpness: Floats, child_point_sharpness: Floats
) -> tuple[Floats, Floats, Floats]:
    """Weights of the vertex rules (smooth, crease, corner) at each point.

    A point follows the rule of its sharpness before this level. Where an edge or the point itself loses its sharpness
    at this level, the rules of parent and child are blended by the remaining fractional sharpness.

    Args:
        mesh: The topology.
        child_edge_sharpness: Sharpness of the edges after this level.
        child_point_sharpness: Sharpness of the points after this level.

    Returns:
        `smooth`, `own` and `along`, the arguments of `_SubdivisionStep._smooth_entries`.
    """
    ends, n = mesh.ends, mesh.points

    def around(per_edge: Floats | Bools) -> Floats:
        doubled = np.repeat(np.asarray(per_edge, dtype=np.float64), 2)
        return np.asarray(np.bincount(ends.reshape(-1), doubled, minlength=n))

    before, after = mesh.sharpness > 0.0, child_edge_sharpness > 0.0
    sharp_before, sharp_after = around(before), around(after)
    isolated = np.bincount(mesh.indices, minlength=n) == 0
    corner_before = (mesh.point_sharpness > 0.0) | (sharp_before > 2) | isolated
    corner_after = (child_point_sharpness > 0.0) | (sharp_after > 2) | isolated
    crease_before = ~corner_before & (sharp_before == 2)
    crease_after = ~corner_after & (sharp_after == 2)
    point_fades = (mesh.point_sharpness > 0.0) & (child_point_sharpness == 0.0)
    edge_fades = before & ~after
    fading = around(edge_fades) + point_fades
    remaining = around(np.where(edge_fades, mesh.sharpness, 0.0)) + np.where(point_fades, mesh.point_sharpness, 0.0)
    blended = (corner_before & ~corner_after) | (crease_before & ~crease_after & ~corner_after)
    fraction = np.where(blended & (fading > 0.0), np.minimum(remaining / np.maximum(fading, 1.0), 1.0), 1.0)
    crease_0, crease_1 = fraction * crease_before, (1.0 - fraction) * crease_after
    corner = fraction * corner_before + (1.0 - fraction) * corner_after
    smooth = 1.0 - crease_0 - crease_1 - corner
    along = 0.125 * (crease_0[ends] * before[:, None] + crease_1[ends] * after[:, None])
    return smooth, corner + 0.75 * (crease_0 + crease_1), along


def _child_sharpness(sharpness: Floats) -> Floats:
    """Sharpness after one level: one less, at least 0; infinite sharpness remains."""
    child: Floats = np.where(sharpness >= INFINITE, INFINITE, np.maximum(sharpness - 1.0, 0.0))
    return child
