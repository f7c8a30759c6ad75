"""Subdivision surfaces: uniform refinement by Catmull-Clark, Loop or bilinear rules, of points and of primvars alike.

One level turns a face of c vertices into c quadrilaterals (Loop: a triangle into four). Every new value is a weighted
mean of old ones around a face, an edge or a vertex; the weights depend on the topology and the sharpness alone, so
they are found once and applied to whatever lives on the mesh. Rules as in OpenSubdiv: Catmull and Clark 1978, Loop
1987, semi-sharp creases of DeRose, Kass and Truong 1998, seams of face-varying values as boundaries.
"""

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from warp_ir.scene import Floats, Ints
from warp_ir.usd.values.triangles import Mask

INFINITE = 10.0
"""Sharpness from which on an edge or a vertex stays sharp at every level (OpenSubdiv's constant)."""
_SMOOTH_TRIANGLE = 0.47
"""Weight of a triangle's middle in an edge's point under triangleSubdivisionRule "smooth"; 1/4 otherwise."""


class Scheme(Enum):
    """How a mesh is refined; the values are UsdGeom's tokens."""

    CATMULL_CLARK = "catmullClark"
    LOOP = "loop"
    BILINEAR = "bilinear"


@dataclass(frozen=True, eq=False)
class Cage:
    """The mesh to refine.

    Faces with less than three vertices must not occur; Loop takes triangles alone.
    """

    counts: Ints
    """int64 [f]: vertices per face."""
    indices: Ints
    """int64 [v]: point of each face-vertex, all in [0, points)."""
    points: int
    """How many points there are."""
    edges: Ints
    """int64 [c, 2]: pairs of points whose edge is a crease."""
    edge_sharpness: Floats
    """float64 [c], in [0, INFINITE]."""
    point_sharpness: Floats
    """float64 [points], in [0, INFINITE]."""
    sharp_boundary: bool = True
    """Whether edges with one face are infinitely sharp (interpolateBoundary is not "none")."""
    smooth_triangles: bool = False
    """Whether triangleSubdivisionRule is "smooth"."""
    face: Ints | None = None
    """int64 [f]: the prim's face each face is, or is part of; None: the same."""
    corner: Ints | None = None
    """int64 [v]: the prim's face-vertex each face-vertex is; None: the same."""

    def with_sharp_corners(self) -> "Cage":
        """This cage with points that have a single face infinitely sharp (interpolateBoundary "edgeAndCorner")."""
        single = np.bincount(self.indices, minlength=self.points) == 1
        return replace(self, point_sharpness=np.where(single, INFINITE, self.point_sharpness))


class Refinement:
    """A cage refined a number of times.

    Args:
        cage: What to refine.
        scheme: By which rules.
        levels: How often, at least once.
        linear: UsdGeom's faceVaryingLinearInterpolation, for `face_varying`.

    Attributes:
        face: int64 [f']: the prim's face each refined face is part of.
        indices: int64 [f', 4], or [f', 3] for Loop: refined point of each refined face-vertex.
        drawn: bool [f']: False where no surface is defined (at boundaries that are not interpolated).
    """

    def __init__(self, cage: Cage, scheme: Scheme, levels: int, linear: str = "cornersPlus1") -> None:
        self._cage, self._scheme, self._linear = cage, scheme, linear
        self._steps: list[_Step] = []
        parent: Ints = np.arange(len(cage.counts))
        mesh = self._base = _Mesh.of(cage)
        for _ in range(levels):
            step = _Step(mesh, scheme)
            self._steps.append(step)
            parent = parent[step.parent]
            mesh = step.child
        self._finest = mesh
        self.drawn: Mask = self._base.has_surface()[parent]
        self.face: Ints = parent if cage.face is None else cage.face[parent]
        self.indices: Ints = mesh.indices.reshape(len(mesh.counts), -1)

    def vertex(self, values: Floats) -> Floats:
        """Values [points, c] on the smooth surface, float64 [points', c]."""
        for step in self._steps:
            values = step.smooth(values)
        return values

    def varying(self, values: Floats) -> Floats:
        """Values [points, c] interpolated linearly over every face of the cage, float64 [points', c]."""
        for step in self._steps:
            values = step.linear(values)
        return values

    def face_varying(self, values: Floats, indices: Ints | None = None) -> Floats:
        """Values of the prim's face-vertices at the refined ones, float64 [f' k, c].

        Args:
            values: [v, c], or [n, c] with indices.
            indices: int [v] into the values: face-vertices of a point that share an index belong together, others
                have a seam between them. Without indices every face stands alone.
        """
        if self._cage.corner is not None:
            values = values[self._cage.corner] if indices is None else values
            indices = None if indices is None else indices[self._cage.corner]
        if self._linear == "all" or self._scheme is Scheme.BILINEAR or indices is None:
            values = values if indices is None else values[indices]
            for step in self._steps:
                values = step.corners(values)
            return values
        seams, first = self._seams(indices)
        refined = Refinement(seams, self._scheme, len(self._steps))
        return refined.vertex(values[indices[first]])[refined.indices.reshape(-1)]

    def normals(self, points: Floats) -> Floats:
        """Unit normals of the refined face-vertices, float64 [f' k, 3]: smooth, but not across what is still sharp.

        A corner's share is the cross product of its two edges: area counts, and slivers do not.

        Args:
            points: Refined points, float64 [points', 3].
        """
        corners = points[self.indices]
        side = np.roll(corners, -1, axis=1) - corners
        (x, y, z), (u, v, w) = np.moveaxis(side, 2, 0), np.moveaxis(-np.roll(side, 1, axis=1), 2, 0)
        group = self._finest.smooth_groups()
        shares = (y * w - z * v, z * u - x * w, x * v - y * u)
        total = np.stack([np.bincount(group, weights=share.reshape(-1)) for share in shares], axis=1)
        length = np.sqrt(np.einsum("ni,ni->n", total, total))[:, None]
        return (total / np.where(length > 0.0, length, 1.0))[group]

    def _seams(self, indices: Ints) -> tuple[Cage, Ints]:
        """The cage cut along its seams: its points are the pairs of a point and a value; and a face-vertex of each."""
        cage, base = self._cage, self._base
        pairs = cage.indices * (int(indices.max(initial=0)) + 1) + indices
        _, first, split = np.unique(pairs, return_index=True, return_inverse=True)
        point = cage.indices[first]
        count = len(first)
        faces = np.bincount(split, minlength=count)
        siblings = np.bincount(point, minlength=cage.points)[point]
        sharp = cage.point_sharpness[point]
        ring = np.stack([split, split[base.next]], axis=1)
        cut = Cage(cage.counts, split, count, ring, base.sharpness[base.edge], sharp)
        if self._linear != "none":
            sharp = np.where(faces == 1, INFINITE, sharp)
        if self._linear in ("cornersPlus1", "cornersPlus2"):
            sharp = np.where(siblings > 2, INFINITE, sharp)
        if self._linear in ("cornersPlus2", "boundaries"):
            mesh = _Mesh.of(cut)
            rim = np.zeros(count, dtype=bool)
            rim[mesh.ends[mesh.faces == 1].reshape(-1)] = True
            if self._linear == "boundaries":
                sharp = np.where(rim, INFINITE, sharp)
            else:  # a concave corner beside a convex one, and the end of a seam
                corner = np.bincount(point, weights=faces == 1, minlength=cage.points)[point] > 0
                whole = np.zeros(cage.points, dtype=bool)
                whole[base.ends[base.faces == 1].reshape(-1)] = True
                sharp = np.where((siblings == 2) & corner | (siblings == 1) & rim & ~whole[point], INFINITE, sharp)
        return replace(cut, point_sharpness=sharp, smooth_triangles=cage.smooth_triangles), first


class _Mesh:
    """Faces with their edges and what is sharp.

    Attributes:
        counts: int64 [f], vertices per face; `indices` [v], their points, of which there are `points`.
        face: int64 [v], face of each face-vertex; `next` and `before` [v], its neighbours in that face.
        edge: int64 [v], the edge from each face-vertex to the next.
        ends: int64 [e, 2], the points of an edge; `faces` [e], how many faces it has.
        sharpness: float64 [e] of the edges, [points] `point_sharpness` of the points.
    """

    def __init__(
        self, cage: Cage, counts: Ints, indices: Ints, edge: Ints, ends: Ints, sharpness: Floats, corners: Floats
    ) -> None:
        self.cage, self.counts, self.indices, self.points = cage, counts, indices, len(corners)
        self.edge, self.ends, self.point_sharpness = edge, ends, corners
        offsets = np.cumsum(counts) - counts
        self.face: Ints = np.repeat(np.arange(len(counts)), counts)
        self.next: Ints = np.arange(1, len(indices) + 1)
        self.next[offsets + counts - 1] = offsets
        self.before: Ints = np.arange(-1, len(indices) - 1)
        self.before[offsets] = offsets + counts - 1
        self.faces: Ints = np.bincount(edge, minlength=len(ends))
        # Where more than two faces meet no smooth surface exists.
        infinite = (self.faces > 2) | ((self.faces == 1) & cage.sharp_boundary)
        self.sharpness: Floats = np.where(infinite, INFINITE, sharpness)

    @staticmethod
    def of(cage: Cage) -> "_Mesh":
        """The cage itself."""
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
            place = np.searchsorted(keys, crease).clip(max=len(keys) - 1)
            known = keys[place] == crease  # what is no edge cannot be sharp
            np.maximum.at(sharpness, place[known], cage.edge_sharpness[known])
        pairs = np.stack(np.divmod(keys, cage.points), axis=1)
        return _Mesh(cage, cage.counts, cage.indices, edge, pairs, sharpness, cage.point_sharpness)

    def has_surface(self) -> Mask:
        """Which faces [f] do not touch an edge of the boundary that is left open."""
        open_edges = self.ends[(self.faces == 1) & (self.sharpness < INFINITE)].reshape(-1)
        loose = np.zeros(self.points, dtype=bool)
        loose[open_edges] = True
        touching = np.bincount(self.face, weights=loose[self.indices], minlength=len(self.counts))
        return np.asarray(touching == 0)

    def smooth_groups(self) -> Ints:
        """A number for each face-vertex [v]; those of a point that no sharp edge divides have the same."""
        points, sharp = self.indices, self.sharpness > 0.0
        divided = np.zeros(self.points, dtype=bool)
        divided[self.ends[sharp].reshape(-1)] = True
        loose = np.flatnonzero(divided[points])
        if len(loose) == 0:
            return points
        # Only there the corners are joined one by one, over every edge with two faces that is not sharp.
        near = np.flatnonzero(divided[self.ends].any(axis=1) & (self.faces == 2) & ~sharp)
        wanted = np.zeros(len(self.ends), dtype=bool)
        wanted[near] = True
        around = np.flatnonzero(wanted[self.edge])
        one, two = around[np.argsort(self.edge[around], kind="stable")].reshape(-1, 2).T
        alike = points[one] == points[two]  # two faces wound against each other run along their edge the same way
        links = np.concatenate(
            [
                np.stack([one, np.where(alike, two, self.next[two])], axis=1),
                np.stack([self.next[one], np.where(alike, self.next[two], two)], axis=1),
            ]
        )
        links = links[divided[points[links[:, 0]]]]
        label = np.arange(len(points))
        while True:  # each round joins every group with a neighbour: there are few
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
        group[loose] = self.points + label[loose]
        return group


class _Step:
    """One level of refinement: the refined mesh, and how values get there.

    The refined points are the old points, then one per edge, then (not with Loop) one per face.
    """

    def __init__(self, mesh: _Mesh, scheme: Scheme) -> None:
        self._mesh, self._loop = mesh, scheme is Scheme.LOOP
        softer, rounder = _softened(mesh.sharpness), _softened(mesh.point_sharpness)
        self._entries: tuple[Ints, Ints, Floats, int] | None = None
        if scheme is not Scheme.BILINEAR:
            self._entries = self._smooth_entries(*_point_weights(mesh, softer, rounder))
        edges, corners = len(mesh.ends), len(mesh.indices)
        middle = mesh.points + np.arange(edges)
        point, ahead, behind = mesh.indices, mesh.edge, mesh.edge[mesh.before]
        # Edges are cut in halves, numbered by which end they keep; behind them come those inside of the faces.
        halves = np.stack([mesh.ends, np.stack([middle, middle], axis=1)], axis=2).reshape(-1, 2)
        out, back = 2 * ahead + (mesh.ends[ahead, 0] != point), 2 * behind + (mesh.ends[behind, 0] != point)
        inside = 2 * edges + np.arange(corners)
        if self._loop:
            # Three triangles at the corners, each cut off by an inner edge, and the one in the middle.
            triples = [x.reshape(-1, 3) for x in (point, mesh.points + ahead, mesh.points + behind)]
            corner = np.stack(triples, axis=2).reshape(-1, 9)
            faces = np.concatenate([corner, triples[1]], axis=1).reshape(-1, 3)
            cut = inside.reshape(-1, 3)
            rim = np.stack([out.reshape(-1, 3), cut, back.reshape(-1, 3)], axis=2).reshape(-1, 9)
            edge = np.concatenate([rim, np.roll(cut, -1, axis=1)], axis=1).reshape(-1)
            inner = np.stack([mesh.points + ahead, mesh.points + behind], axis=1)
            self.parent: Ints = np.repeat(np.arange(len(mesh.counts)), 4)
            total = mesh.points + edges
        else:
            center = mesh.points + edges + mesh.face
            faces = np.stack([point, mesh.points + ahead, center, mesh.points + behind], axis=1)
            edge = np.stack([out, inside, inside[mesh.before], back], axis=1).reshape(-1)
            inner = np.stack([mesh.points + ahead, center], axis=1)
            self.parent = mesh.face
            total = mesh.points + edges + len(mesh.counts)
        self.child = _Mesh(
            mesh.cage,
            np.full(len(faces), faces.shape[1]),
            faces.reshape(-1),
            edge,
            np.concatenate([halves, inner]),
            np.concatenate([np.repeat(softer, 2), np.zeros(corners)]),
            np.concatenate([rounder, np.zeros(total - mesh.points)]),
        )

    def smooth(self, values: Floats) -> Floats:
        """Values at the points [n, c] after this step, by the rules of the scheme."""
        if self._entries is None:
            return self.linear(values)
        rows, columns, weights, edges = self._entries
        faces = None if self._loop else self._face_means(values[self._mesh.indices])
        source = values if faces is None else np.concatenate([values, faces])
        count = len(values) + edges
        sums = [np.bincount(rows, weights * source[columns, k], minlength=count) for k in range(values.shape[1])]
        new = np.stack(sums, axis=1).astype(np.float64, copy=False)
        return new if faces is None else np.concatenate([new, faces])

    def linear(self, values: Floats) -> Floats:
        """Values at the points [n, c] after this step, each face on its own."""
        middles = 0.5 * (values[self._mesh.ends[:, 0]] + values[self._mesh.ends[:, 1]])
        if self._loop:
            return np.concatenate([values, middles])
        return np.concatenate([values, middles, self._face_means(values[self._mesh.indices])])

    def corners(self, values: Floats) -> Floats:
        """Values at the face-vertices [v, c] after this step, each face on its own."""
        ahead = 0.5 * (values + values[self._mesh.next])
        behind = ahead[self._mesh.before]
        columns = values.shape[1]
        if self._loop:
            corner = np.stack([values, ahead, behind], axis=1).reshape(-1, 9, columns)
            return np.concatenate([corner, ahead.reshape(-1, 3, columns)], axis=1).reshape(-1, columns)
        center = self._face_means(values)[self._mesh.face]
        return np.stack([values, ahead, center, behind], axis=1).reshape(-1, columns)

    def _face_means(self, values: Floats) -> Floats:
        """Mean of each face's values, from those of its face-vertices [v, c]: [f, c]."""
        counts = self._mesh.counts
        if len(counts) and (counts == counts[0]).all():
            mean: Floats = values.reshape(len(counts), int(counts[0]), -1).mean(axis=1)
            return mean
        sums = [np.bincount(self._mesh.face, values[:, k], minlength=len(counts)) for k in range(values.shape[1])]
        means: Floats = np.stack(sums, axis=1) / counts[:, None]
        return means

    def _smooth_entries(self, smooth: Floats, own: Floats, along: Floats) -> tuple[Ints, Ints, Floats, int]:
        """The matrix from [points, faces] to [points, edges] as rows, columns and weights; and the number of edges.

        Args:
            smooth: How much of the smooth rule each point follows, [n].
            own: Weight of a point for itself by the other rules, [n].
            along: Weight of the far end of an edge by the other rules, for both ends of each edge, [e, 2].
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
        row, crease = mesh.points + np.arange(edges), np.where(mesh.faces == 2, np.minimum(mesh.sharpness, 1.0), 1.0)
        if self._loop:
            third = mesh.indices[mesh.before]
            opposite = 0.125 * (1.0 - crease)[mesh.edge]
            end = 0.375 * (1.0 - crease) + 0.5 * crease
            rows += [row, row, mesh.points + mesh.edge]
            columns += [mesh.ends[:, 0], mesh.ends[:, 1], third]
            weights += [end, end, opposite]
        else:
            triangle = (mesh.counts == 3) & mesh.cage.smooth_triangles
            middle = np.where(triangle, _SMOOTH_TRIANGLE, 0.25)[mesh.face]
            both = 0.5 * np.bincount(mesh.edge, middle, minlength=edges)
            end = (1.0 - crease) * (0.5 - both) + 0.5 * crease
            rows += [mesh.indices, row, row, mesh.points + mesh.edge]
            columns += [mesh.points + mesh.face, mesh.ends[:, 0], mesh.ends[:, 1], mesh.points + mesh.face]
            weights += [
                (smooth / (valence * faces))[mesh.indices],
                end,
                end,
                ((1.0 - crease) * both)[mesh.edge],
            ]
        return np.concatenate(rows), np.concatenate(columns), np.concatenate(weights), edges


def _point_weights(mesh: _Mesh, softer: Floats, rounder: Floats) -> tuple[Floats, Floats, Floats]:
    """How points move: the share of the smooth rule [n], their own weight [n] and their edges' [e, 2] by the others.

    A point follows the rule that its sharpness asks for before this level; where an edge or the point itself loses its
    sharpness at this level, that and the rule after it are mixed by the fraction of the sharpness that was left.

    Args:
        mesh: The topology.
        softer: Sharpness of the edges after this level.
        rounder: Sharpness of the points after this level.
    """
    ends, n = mesh.ends, mesh.points

    def around(per_edge: Floats | Mask) -> Floats:
        doubled = np.repeat(np.asarray(per_edge, dtype=np.float64), 2)
        return np.asarray(np.bincount(ends.reshape(-1), doubled, minlength=n))

    before, after = mesh.sharpness > 0.0, softer > 0.0
    sharp_before, sharp_after = around(before), around(after)
    alone = np.bincount(mesh.indices, minlength=n) == 0
    corner_before = (mesh.point_sharpness > 0.0) | (sharp_before > 2) | alone
    corner_after = (rounder > 0.0) | (sharp_after > 2) | alone
    crease_before = ~corner_before & (sharp_before == 2)
    crease_after = ~corner_after & (sharp_after == 2)
    ends_here = (mesh.point_sharpness > 0.0) & (rounder == 0.0)
    fading = before & ~after
    fades = around(fading) + ends_here
    left = around(np.where(fading, mesh.sharpness, 0.0)) + np.where(ends_here, mesh.point_sharpness, 0.0)
    mixed = (corner_before & ~corner_after) | (crease_before & ~crease_after & ~corner_after)
    share = np.where(mixed & (fades > 0.0), np.minimum(left / np.maximum(fades, 1.0), 1.0), 1.0)
    crease_0, crease_1 = share * crease_before, (1.0 - share) * crease_after
    corner = share * corner_before + (1.0 - share) * corner_after
    smooth = 1.0 - crease_0 - crease_1 - corner
    along = 0.125 * (crease_0[ends] * before[:, None] + crease_1[ends] * after[:, None])
    return smooth, corner + 0.75 * (crease_0 + crease_1), along


def _softened(sharpness: Floats) -> Floats:
    """What one level leaves of a sharpness."""
    left: Floats = np.where(sharpness >= INFINITE, INFINITE, np.maximum(sharpness - 1.0, 0.0))
    return left
