"""BVH traversal returns the closest triangle and is watertight; refit and joined trees give the same hits."""

from itertools import pairwise

import numpy as np
import pytest
import warp as wp

from warp_ir.bvh import Bvh, BvhForest, intersect
from warp_ir.bvh.traverse import traverse_mesh
from warp_ir.procedural import cube, sphere

pytestmark = pytest.mark.extended

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _shoot(
    first: int,
    bvh: Bvh,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    t: wp.array[wp.float32],
    triangle: wp.array[wp.int32],
    uv: wp.array[wp.vec2],
    any_hit: wp.array[wp.int32],
):
    i = first + wp.tid()
    hit = intersect(bvh, origins[i], directions[i], 3.0e38, False)
    t[i] = hit.t
    triangle[i] = hit.triangle
    uv[i] = wp.vec2(hit.u, hit.v)
    any_hit[i] = intersect(bvh, origins[i], directions[i], 3.0e38, True).triangle


def shoot(launcher, points, triangles, origins, directions):
    """t, triangle, barycentrics and the any-hit triangle of each ray, as NumPy arrays."""
    trees = BvhForest(launcher)
    trees.build([(launcher.array(points, wp.vec3), launcher.array(triangles.reshape(-1), wp.int32), 0)])
    (bvh,) = trees.join([[0]])
    n = len(directions)
    out = [launcher.empty(n, d) for d in (wp.float32, wp.int32, wp.vec2, wp.int32)]
    origins = np.broadcast_to(origins, directions.shape)
    launcher.launch(_shoot, n, [bvh, launcher.array(origins, wp.vec3), launcher.array(directions, wp.vec3), *out])
    return [x.numpy() for x in out]


def brute_force(points, triangles, origins, directions):
    """The closest t per ray in float64 (Möller and Trumbore 1997); infinity for a miss."""
    a, b, c = (points[triangles[:, k]].astype(np.float64) for k in range(3))
    best = np.full(len(directions), np.inf)
    for i, (o, d) in enumerate(zip(np.broadcast_to(origins, directions.shape), directions, strict=True)):
        p = np.cross(d, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1.0 / np.sum((b - a) * p, axis=1)
            u = np.sum((o - a) * p, axis=1) * inverse
            q = np.cross(o - a, b - a)
            v = q @ d * inverse
            t = np.sum((c - a) * q, axis=1) * inverse
        hits = t[(u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)]
        best[i] = hits.min() if len(hits) else np.inf
    return best


def soup(count, seed=0):
    """Random triangles in the unit cube."""
    random = np.random.default_rng(seed)
    corners = random.random((count, 1, 3)) + random.normal(size=(count, 3, 3)) * 0.05
    return corners.reshape(-1, 3).astype(np.float32), np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 64, 65, 1000])
def test_closest_triangle_of_a_soup(launcher, count):
    """The closest hit is that of testing every triangle in double precision, and the barycentrics give its position."""
    points, triangles = soup(count)
    random = np.random.default_rng(1)
    origins = random.uniform(-0.5, 1.5, (500, 3)).astype(np.float32)
    directions = (random.random((500, 3)) - origins).astype(np.float32)
    t, triangle, uv, any_hit = shoot(launcher, points, triangles, origins, directions)
    expected = brute_force(points, triangles, origins, directions)
    hit = triangle >= 0
    np.testing.assert_array_equal(hit, np.isfinite(expected))
    np.testing.assert_array_equal(any_hit >= 0, hit)
    np.testing.assert_allclose(t[hit], expected[hit], rtol=1e-4)
    weights = np.column_stack([uv, 1.0 - uv.sum(axis=1)])[hit]
    by_uv = np.einsum("nk,nkc->nc", weights, points[triangles[triangle[hit]]])
    np.testing.assert_allclose(by_uv, origins[hit] + t[hit, None] * directions[hit], atol=1e-5)


@pytest.mark.parametrize("shift", [0.0, 0.4, 1.0e3])
@pytest.mark.parametrize("target", ["vertices", "edges", "random"])
@pytest.mark.parametrize("shape", ["sphere", "cube"])
def test_closed_meshes_are_watertight(launcher, shape, target, shift):
    """No ray from inside a closed mesh escapes: not through a vertex, not through an edge, at any position in space."""
    points, triangles = sphere(level=5) if shape == "sphere" else cube()
    points = (points * 0.5 + shift).astype(np.float32)
    origin = (np.array([0.03, 0.07, -0.05]) + shift).astype(np.float32)
    random = np.random.default_rng(2)
    if target == "vertices":
        aims = points
    elif target == "edges":
        s = random.random((len(triangles), 3, 1)).astype(np.float32)
        corners = points[triangles]
        aims = (s * corners + (1 - s) * np.roll(corners, 1, axis=1)).reshape(-1, 3)
    else:
        aims = origin + random.normal(size=(20_000, 3)).astype(np.float32)
    _, triangle, _, any_hit = shoot(launcher, points, triangles, origin, (aims - origin).astype(np.float32))
    assert (triangle < 0).sum() == 0
    assert (any_hit < 0).sum() == 0


@wp.kernel
def _shoot_at_mesh(
    first: int,
    mesh: wp.uint64,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    t: wp.array[wp.float32],
    triangle: wp.array[wp.int32],
    uv: wp.array[wp.vec2],
    any_hit: wp.array[wp.int32],
):
    i = first + wp.tid()
    hit = traverse_mesh(mesh, origins[i], directions[i], 3.0e38, False, wp.vec3(0.0))
    t[i] = hit.t
    triangle[i] = hit.triangle
    uv[i] = wp.vec2(hit.u, hit.v)
    any_hit[i] = traverse_mesh(mesh, origins[i], directions[i], 3.0e38, True, wp.vec3(0.0)).triangle


def shoot_at_mesh(launcher, points, triangles, origins, directions):
    """As `shoot`, by the traversal that CUDA uses."""
    mesh = wp.Mesh(
        launcher.array(points, wp.vec3),
        launcher.array(triangles.reshape(-1), wp.int32),
        bvh_constructor="sah",
        bvh_leaf_size=2,
    )
    n = len(directions)
    out = [launcher.empty(n, d) for d in (wp.float32, wp.int32, wp.vec2, wp.int32)]
    origins = np.broadcast_to(origins, directions.shape)
    rays = launcher.array(origins, wp.vec3), launcher.array(directions, wp.vec3)
    launcher.launch(_shoot_at_mesh, n, [mesh.id, *rays, *out])
    return [x.numpy() for x in out]


@pytest.mark.parametrize("count", [1, 2, 65, 1000])
def test_both_traversals_find_the_same(launcher, count):
    """What CUDA traverses gives the triangles and, up to the last bits, the distances of the eight-wide tree."""
    points, triangles = soup(count)
    random = np.random.default_rng(1)
    origins = random.uniform(-0.5, 1.5, (500, 3)).astype(np.float32)
    directions = (random.random((500, 3)) - origins).astype(np.float32)
    wide = shoot(launcher, points, triangles, origins, directions)
    binary = shoot_at_mesh(launcher, points, triangles, origins, directions)
    np.testing.assert_array_equal(binary[1], wide[1])
    np.testing.assert_array_equal(binary[3] >= 0, wide[3] >= 0)
    hit = wide[1] >= 0
    np.testing.assert_allclose(binary[0][hit], wide[0][hit], rtol=1e-5)
    np.testing.assert_allclose(binary[2][hit], wide[2][hit], atol=1e-4)


@pytest.mark.parametrize("traverse", [shoot, shoot_at_mesh])
@pytest.mark.parametrize("shape", ["sphere", "cube", "needles"])
def test_no_ray_in_many_escapes(launcher, shape, traverse):
    """No ray out of 200 000 in closed meshes slips through; three in four are aimed at edges and vertices.

    Warp's own query loses one in some thousand on such a sphere.
    """
    points, triangles = cube() if shape == "cube" else sphere(level=5)
    random = np.random.default_rng(3)
    points = (points * (0.5, 0.01 if shape == "needles" else 0.5, 0.5) + 0.4).astype(np.float32)
    n = 200_000
    origins = (random.uniform(-0.1, 0.1, (n, 3)) * (1.0, 0.02, 1.0) + 0.4).astype(np.float32)
    corners = points[triangles[random.integers(0, len(triangles), n)]]
    s = random.random((n, 1))
    s[: n // 4] = 0.0
    aims = s * corners[:, 0] + (1.0 - s) * corners[:, 1]
    aims[3 * n // 4 :] = origins[3 * n // 4 :] + random.normal(size=(n - 3 * n // 4, 3))
    _, triangle, _, any_hit = traverse(launcher, points, triangles, origins, (aims - origins).astype(np.float32))
    assert (triangle < 0).sum() == 0
    assert (any_hit < 0).sum() == 0


def test_axis_parallel_rays_in_the_plane_of_a_wall(launcher):
    """Rays along an axis, with zeros in their direction and their origin on the plane of a box, hit what is ahead."""
    points, triangles = cube()
    points = np.concatenate([points, points * 0.25]).astype(np.float32)
    triangles = np.concatenate([triangles, triangles + 8])
    origins = np.array([[-0.9, 0.25, 0.1], [-0.9, 0.0, 0.0], [0.0, 0.9, -0.1], [0.1, 0.1, 0.9]], np.float32)
    directions = np.array([[1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 0, -1]], np.float32)
    t, _, _, _ = shoot(launcher, points, triangles, origins, directions)
    np.testing.assert_allclose(t[1:], 0.65, rtol=1e-6)
    assert t[0] in (pytest.approx(0.65), pytest.approx(1.9))


def test_many_coincident_triangles(launcher):
    """A thousand copies of one triangle, which no tree can separate, give one hit."""
    points = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1]], np.float32)
    triangles = np.tile(np.array([[0, 1, 2]], np.int32), (1000, 1))
    t, triangle, _, _ = shoot(
        launcher, points, triangles, np.zeros(3), np.array([[0.2, 0.2, 1], [2, 2, 1]], np.float32)
    )
    assert t[0] == 1.0 and triangle[0] >= 0 and triangle[1] == -1


# ---- refit trees -------------------------------------------------------------------------------------


def rays(count, seed):
    """Origins around the unit cube, and directions into it."""
    random = np.random.default_rng(seed)
    origins = random.uniform(-0.5, 1.5, (count, 3)).astype(np.float32)
    return origins, (random.random((count, 3)) - origins).astype(np.float32)


def hits(launcher, bvh, origins, directions):
    out = [launcher.empty(len(origins), d) for d in (wp.float32, wp.int32, wp.vec2, wp.int32)]
    launcher.launch(
        _shoot, len(origins), [bvh, launcher.array(origins, wp.vec3), launcher.array(directions, wp.vec3), *out]
    )
    return [x.numpy() for x in out]


def build_forest(launcher, soups):
    """One tree per soup in the tables of a common scene; returns the forest, the tables, and each soup's point rows."""
    points = launcher.array(np.concatenate([p for p, _ in soups]), wp.vec3)
    starts = np.cumsum([0] + [len(p) for p, _ in soups])
    indices = launcher.array(np.concatenate([t + s for (_, t), s in zip(soups, starts[:-1], strict=True)]), wp.int32)
    indices = indices.flatten()
    trees, batches = BvhForest(launcher), []
    for k, (_, t) in enumerate(soups):
        own = launcher.array(t.reshape(-1), wp.int32)
        batches.append((points[int(starts[k]) : int(starts[k + 1])], own, int(starts[k]) // 3))
    trees.build(batches)
    return trees, points, indices, [range(int(a), int(b)) for a, b in pairwise(starts)]


@pytest.mark.parametrize("count", [1, 2, 9, 64])
def test_several_trees_are_one_world(launcher, count):
    """The joined trees of several soups give the hits of one tree over all triangles: the same triangles and t."""
    soups = [soup(17 * k + 1, seed=k) for k in range(count)]
    trees, _, _, _ = build_forest(launcher, soups)
    (bvh,) = trees.join([range(count)])
    starts = np.cumsum([0] + [len(p) for p, _ in soups])
    points = np.concatenate([p for p, _ in soups])
    triangles = np.concatenate([t + s for (_, t), s in zip(soups, starts[:-1], strict=True)])
    origins, directions = rays(2000, 1)
    t, triangle, uv, any_hit = hits(launcher, bvh, origins, directions)
    expected = shoot(launcher, points, triangles, origins, directions)
    for ours, theirs in zip((t, triangle, uv, any_hit >= 0), (*expected[:3], expected[3] >= 0), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("count", [1, 8, 9, 700])
@pytest.mark.parametrize("way", ["shifted", "bent", "exploded"])
def test_a_refit_tree_gives_the_hits_of_a_new_one(launcher, count, way):
    """Hits in a refit tree are bitwise those of a new one; other trees of the forest are unchanged."""
    still, moving = soup(50, seed=4), soup(count, seed=5)
    trees, points, indices, ranges = build_forest(launcher, [still, moving])
    trees.join([[0, 1]])
    p = moving[0].astype(np.float64)
    if way == "shifted":
        p += (0.3, -0.2, 0.1)
    elif way == "bent":
        p[:, 1] += 0.2 * np.sin(9.0 * p[:, 0])
    else:
        p = p.reshape(-1, 3, 3)[np.random.default_rng(6).permutation(count)].reshape(-1, 3) * 1.3 - 0.15
    p = p.astype(np.float32)
    wp.copy(points, launcher.array(p, wp.vec3), dest_offset=ranges[1].start)
    good = trees.refit(1, points, indices, ranges[1], 50)
    assert good or way == "exploded"
    (bvh,) = trees.join([[0, 1]])
    origins, directions = rays(3000, 7)
    t, triangle, uv, any_hit = hits(launcher, bvh, origins, directions)
    everything = np.concatenate([still[0], p]), np.concatenate([still[1], moving[1] + 150])
    expected = shoot(launcher, *everything, origins, directions)
    assert (triangle >= 50).any() and (triangle < 50).any()
    for ours, theirs in zip((t, triangle, uv, any_hit >= 0), (*expected[:3], expected[3] >= 0), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_refit_reports_a_tree_whose_boxes_have_grown(launcher):
    """The cost of a tree is invariant under translation and scaling; it grows when triangles change places."""
    moving = soup(5000, seed=8)
    trees, points, indices, ranges = build_forest(launcher, [moving])
    assert trees.refit(0, points, indices, ranges[0], 0)
    places = moving[0].reshape(-1, 3, 3)
    for moved, good in ((places * 3.0 + 1.0, True), (places[::-1], False), (places, True)):
        points.assign(np.ascontiguousarray(moved.reshape(-1, 3)))
        assert trees.refit(0, points, indices, ranges[0], 0) is good


def test_rebuilding_the_last_trees_keeps_the_first(launcher):
    """The last trees are replaced, by fewer here, and the first give the same hits as before."""
    first, second, third = (soup(100, seed=s) for s in (9, 10, 11))
    trees, points, _, ranges = build_forest(launcher, [first, second, second])
    origins, directions = rays(2000, 12)
    one = hits(launcher, trees.join([[0]])[0], origins, directions)
    own = launcher.array(third[1].reshape(-1), wp.int32)
    wp.copy(points, launcher.array(third[0], wp.vec3), dest_offset=ranges[1].start)
    trees.build([(points[ranges[1].start : ranges[1].stop], own, 100)], keep_count=1)
    same, other, both = (hits(launcher, b, origins, directions) for b in trees.join([[0], [1], [0, 1]]))
    np.testing.assert_array_equal(one[0], same[0])
    np.testing.assert_array_equal(both[0], np.minimum(same[0], other[0]))
    np.testing.assert_array_equal(other[0], shoot(launcher, *third, origins, directions)[0])
