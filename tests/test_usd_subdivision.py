"""Subdivision surfaces: the rules against hand-computed weights and known limits, and what lives on the surface."""

import numpy as np
import pytest

import warp_ir.usd.geometry.subdivision
from tests.stages import SQUARE, area, area_vectors, load, mesh_text, volume, warned
from warp_ir import InputError
from warp_ir.cli import main
from warp_ir.usd.geometry.refine import INFINITE, Cage, Refinement, Scheme

CUBE = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
CUBE_FACES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
CUBE_EDGES = sorted({(min(a, b), max(a, b)) for f in CUBE_FACES for a, b in zip(f, np.roll(f, -1), strict=True)})
LEVELS = {"medium": 1, "high": 2, "veryhigh": 3}


def cage(faces, points, edges=(), sharpness=(), corners=None, **rules):
    return Cage(
        counts=np.array([len(f) for f in faces]),
        indices=np.concatenate(faces),
        points=points,
        edges=np.array(edges, dtype=np.int64).reshape(-1, 2),
        edge_sharpness=np.array(sharpness, dtype=float),
        point_sharpness=np.zeros(points) if corners is None else np.array(corners, dtype=float),
        **rules,
    )


def grid(n, triangles=False):
    """Points [(n + 1)², 2] and faces of a square grid."""
    at = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    quads = np.stack([at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]], axis=-1).reshape(-1, 4)
    points = np.stack(np.meshgrid(np.arange(n + 1.0), np.arange(n + 1.0), indexing="ij"), axis=-1).reshape(-1, 2)
    return points, list(quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3) if triangles else quads)


def scheme_text(points, faces, more="", scheme="catmullClark", name="M"):
    text = mesh_text(points, [len(f) for f in faces], np.concatenate(faces).tolist(), more, name)
    return text.replace('subdivisionScheme = "none"', f'subdivisionScheme = "{scheme}"')


def impulse(faces, count, where, scheme=Scheme.CATMULL_CLARK):
    """The weight of one point in every refined point."""
    values = np.zeros((count, 1))
    values[where] = 1.0
    return Refinement(cage(faces, count), scheme, 1).vertex(values)[:, 0]


def test_catmull_clark_on_a_regular_grid():
    """Face 1/4; edge 3/8 and 1/16; vertex 9/16, 3/32 and 1/64: the masks of the uniform bicubic B-spline."""
    _, faces = grid(6)
    weights = impulse(faces, 49, 24)
    old = weights[:49].reshape(7, 7)
    expected = np.zeros((7, 7))
    expected[2:5, 2:5] = np.outer([1, 6, 1], [1, 6, 1]) / 64.0
    assert old == pytest.approx(expected, abs=1e-15)
    assert sorted(set(np.round(weights[-36:], 12))) == [0.0, 0.25]
    edges = weights[49:-36]
    assert np.sort(edges[edges > 0.0]) == pytest.approx([1 / 16] * 8 + [3 / 8] * 4)


def test_loop_on_a_regular_grid():
    """Vertex 5/8 and 1/16, edge 3/8 and 1/8."""
    _, faces = grid(6, triangles=True)
    weights = impulse(faces, 49, 24, Scheme.LOOP)
    old, edges = weights[:49], weights[49:]
    assert old[24] == pytest.approx(5 / 8) and np.sort(old)[-7:-1] == pytest.approx(1 / 16)
    assert np.sort(edges[edges > 0.0]) == pytest.approx([1 / 8] * 6 + [3 / 8] * 6)


def test_the_smooth_rule_for_triangles():
    """Between two triangles an edge's point takes 0.47 of each middle under "smooth", 1/4 otherwise."""
    faces = [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]
    points = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1.0)])
    for smooth, share in ((False, 0.25), (True, 0.47)):
        new = Refinement(cage(faces, 4, smooth_triangles=smooth), Scheme.CATMULL_CLARK, 1).vertex(points)
        middle = share * (points[:3].mean(axis=0) + points[[0, 1, 3]].mean(axis=0))
        assert new[4] == pytest.approx((0.5 - share) * (points[0] + points[1]) + middle)


def test_a_cube_goes_where_catmull_and_clark_say():
    """Corners to (1, 1, 1) / 2 and centres of faces to 0.8395...: (n² v + 4 Σe + Σf) / (n (n + 5)) of level 1.

    The distance to the limit falls by a factor of at least 4 per level at regular points, 5.9 at valence 3.
    """
    for level in (1, 2, 5, 8):
        points = Refinement(cage(CUBE_FACES, 8), Scheme.CATMULL_CLARK, level).vertex(CUBE)
        if level == 1:
            assert points[:8] == pytest.approx(5 / 9 * CUBE)
            assert np.sort(np.abs(points[8:20]), axis=1) == pytest.approx(np.tile([0, 0.75, 0.75], (12, 1)))
            assert points[20:] == pytest.approx(np.array([CUBE[f].mean(axis=0) for f in CUBE_FACES]))
        assert points[:8] == pytest.approx(0.5 * CUBE, abs=0.6 / 4**level)
        assert np.abs(points[20:26]).max() == pytest.approx((16 + 12 + 20 / 9) / 36, abs=1.0 / 4**level)


@pytest.mark.parametrize("scheme", list(Scheme))
def test_refinement_keeps_affine_maps_and_topology(scheme):
    """Every rule is an affine mean; a torus stays one: V - E + F = 0 at every level."""
    points, faces = grid(5)
    ring = np.arange(36).reshape(6, 6)
    ring[-1], ring[:, -1] = ring[0], ring[:, 0]
    used, joined = np.unique(ring.reshape(-1)[np.array(faces)], return_inverse=True)
    faces = (
        list(joined.reshape(-1, 4))
        if scheme is not Scheme.LOOP
        else list(joined.reshape(-1, 4)[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3))
    )
    rng = np.random.default_rng(1)
    points, matrix, offset = rng.normal(size=(len(used), 3)), rng.normal(size=(3, 3)), rng.normal(size=3)
    for level in (1, 2):
        refinement = Refinement(cage(faces, len(used)), scheme, level)
        moved = refinement.vertex(points @ matrix + offset)
        assert moved == pytest.approx(refinement.vertex(points) @ matrix + offset)
        rim = refinement.indices, np.roll(refinement.indices, -1, axis=1)
        edges = np.unique(np.sort(np.stack(rim, axis=-1).reshape(-1, 2), axis=1), axis=0)
        assert len(moved) - len(edges) + len(refinement.indices) == 0
        assert len(refinement.indices) == len(faces) * 4**level


@pytest.mark.parametrize("complexity", LEVELS)
def test_a_flat_square_stays_flat_and_whole(tmp_path, complexity):
    """With edgeAndCorner a square keeps its outline: its area, its plane, and no normals but its own."""
    points, faces = grid(3)
    text = scheme_text(np.pad(points, ((0, 0), (0, 1))), faces)
    mesh = load(tmp_path, text, complexity=complexity).meshes[0]
    assert area(mesh) == pytest.approx(9.0) and len(mesh.triangles) == 2 * 9 * 4 ** LEVELS[complexity]
    assert mesh.normals is None and (area_vectors(mesh)[:, 2] > 0.0).all()


def test_boundaries_follow_interpolate_boundary(tmp_path):
    """EdgeOnly rounds the corners of a square by the cubic B-spline; none draws only faces clear of the boundary."""
    points, faces = grid(3)
    points = np.pad(points, ((0, 0), (0, 1)))
    rounded = load(
        tmp_path, scheme_text(points, faces, 'uniform token interpolateBoundary = "edgeOnly"'), complexity="medium"
    ).meshes[0]
    # At a corner 3/4 (0, 0) + 1/8 (1, 0) + 1/8 (0, 1): the triangle cut off between two edge midpoints.
    corner = rounded.points[:1]
    assert corner == pytest.approx(np.array([[1 / 8, 1 / 8, 0.0]]))
    assert area(rounded) == pytest.approx(9.0 - 4 * 0.5 * 0.5 * 0.25)
    none = load(tmp_path, scheme_text(points, faces, 'uniform token interpolateBoundary = "none"'), complexity="medium")
    assert area(none.meshes[0]) == pytest.approx(1.0) and not warned(none, "degenerate")


@pytest.mark.parametrize("complexity", LEVELS)
@pytest.mark.parametrize("sharpness", ["[10]", "[10, 10, 10]"])
def test_infinitely_sharp_creases_keep_the_cube(tmp_path, complexity, sharpness):
    """All edges creased, the cube is itself at every level, and faceted; whether sharpness is per crease or edge."""
    rim = [0, 1, 3, 2, 0], [4, 5, 7, 6, 4]
    chains = [list(chain) for chain in rim] + [[0, 4], [1, 5], [2, 6], [3, 7]]
    counts = [len(chain) - (sharpness != "[10]") for chain in chains]
    values = [10.0] * (len(chains) if sharpness == "[10]" else sum(counts))
    more = f"""int[] creaseIndices = {[int(i) for chain in chains for i in chain]}
    int[] creaseLengths = {[len(chain) for chain in chains]}
    float[] creaseSharpnesses = {values}"""
    mesh = load(tmp_path, scheme_text(CUBE, CUBE_FACES, more), complexity=complexity).meshes[0]
    assert volume(mesh) == pytest.approx(8.0) and area(mesh) == pytest.approx(24.0) and mesh.normals is None


def test_semi_sharp_creases_are_mixed_by_their_fraction():
    """Sharpness 1/2 is halfway between the sharp and the smooth rule; 1 is sharp once, then smooth."""
    smooth = Refinement(cage(CUBE_FACES, 8), Scheme.CATMULL_CLARK, 1).vertex(CUBE)
    hard = Refinement(cage(CUBE_FACES, 8, CUBE_EDGES, [INFINITE] * 12), Scheme.CATMULL_CLARK, 1).vertex(CUBE)
    half = Refinement(cage(CUBE_FACES, 8, CUBE_EDGES, [0.5] * 12), Scheme.CATMULL_CLARK, 1).vertex(CUBE)
    assert half == pytest.approx(0.5 * (smooth + hard))
    once = Refinement(cage(CUBE_FACES, 8, CUBE_EDGES, [1.0] * 12), Scheme.CATMULL_CLARK, 2).vertex(CUBE)
    faces = list(Refinement(cage(CUBE_FACES, 8), Scheme.BILINEAR, 1).indices)
    after = Refinement(cage(faces, 26), Scheme.CATMULL_CLARK, 1).vertex(hard)
    # The edges are numbered differently: points are compared in order of their coordinates.
    once, after = (np.array(sorted(np.round(points, 9).tolist())) for points in (once, after))
    assert once == pytest.approx(after)


def test_a_crease_of_two_edges_and_a_sharp_corner():
    """A point on a crease is 3/4 itself and 1/8 of each neighbour on the crease; a sharp corner stays put."""
    _, faces = grid(4)
    heights = np.random.default_rng(2).normal(size=(25, 1))
    crease = Refinement(cage(faces, 25, [(10, 11), (11, 12), (12, 13), (13, 14)], [10.0] * 4), Scheme.CATMULL_CLARK, 1)
    new = crease.vertex(heights)
    assert new[12] == pytest.approx(0.75 * heights[12] + 0.125 * (heights[11] + heights[13]))
    corner = np.zeros(25)
    corner[12] = 10.0
    assert Refinement(cage(faces, 25, corners=corner), Scheme.CATMULL_CLARK, 3).vertex(heights)[12] == heights[12]
    corner[12] = 0.25
    soft = Refinement(cage(faces, 25), Scheme.CATMULL_CLARK, 1).vertex(heights)[12]
    mixed = Refinement(cage(faces, 25, corners=corner), Scheme.CATMULL_CLARK, 1).vertex(heights)[12]
    assert mixed == pytest.approx(0.25 * heights[12] + 0.75 * soft)


def test_normals_are_smooth_but_not_across_creases(tmp_path):
    """A refined cube has the normals of a ball, within the angle a facet spans; a creased rim has one per side."""
    mesh = load(tmp_path, scheme_text(CUBE, CUBE_FACES), complexity="veryhigh").meshes[0]
    outward = mesh.points[mesh.triangles] / np.linalg.norm(mesh.points[mesh.triangles], axis=-1, keepdims=True)
    assert np.einsum("mci,mci->mc", mesh.normals, outward).min() > np.cos(np.radians(4.0))
    _, first = np.unique(mesh.triangles, return_index=True)
    every = mesh.normals.reshape(-1, 3)[first][mesh.triangles]
    assert mesh.normals == pytest.approx(every, abs=1e-6)  # one normal per point
    more = """int[] creaseIndices = [1, 5, 7, 3, 1]
    int[] creaseLengths = [5]
    float[] creaseSharpnesses = [10]"""
    lid = load(tmp_path, scheme_text(CUBE, CUBE_FACES, more), complexity="high").meshes[0]
    top = np.isclose(lid.points[lid.triangles][..., 2], 1.0).all(axis=1)
    assert area_vectors(lid)[top].sum(axis=0)[2] > 2.0
    assert lid.normals[top] == pytest.approx(np.broadcast_to([0.0, 0.0, 1.0], (top.sum(), 3, 3)), abs=1e-6)
    assert lid.normals[~top][..., 2].max() < 0.5


@pytest.mark.parametrize("more", ["normal3f[] normals", "normal3f[] primvars:normals"])
@pytest.mark.parametrize("scheme", ["catmullClark", "loop", "bilinear"])
def test_authored_normals_are_for_polygons_only(tmp_path, scheme, more):
    """UsdGeomMesh: with a scheme other than none, normals are ignored; on a flat square the face's own remain."""
    tilted = f'{more} = {[(0, 1, 0)] * 4} (interpolation = "vertex")'
    text = scheme_text(SQUARE, [[0, 1, 2], [0, 2, 3]], tilted, scheme)
    assert load(tmp_path, text).meshes[0].normals is None
    # The same normals are used on polygons.
    polygons = load(tmp_path, text.replace(f'"{scheme}"', '"none"')).meshes[0]
    assert polygons.normals == pytest.approx(np.broadcast_to([0.0, 1.0, 0.0], (2, 3, 3)))


@pytest.mark.parametrize("left_handed", [False, True])
def test_cages_have_the_smooth_normals_of_storm(tmp_path, left_handed):
    """Sums of the corners' cross products at each point: on a cube its diagonals, creased or not, of any size.

    Bilinear cages and polygons are faceted.
    """
    more = """int[] creaseIndices = [1, 5, 7, 3, 1]
    int[] creaseLengths = [5]
    float[] creaseSharpnesses = [10]"""
    more += '\n    uniform token orientation = "leftHanded"' if left_handed else ""
    side = -1.0 if left_handed else 1.0
    for size in (1e-6, 1.0):
        mesh = load(tmp_path, scheme_text(size * CUBE, CUBE_FACES, more)).meshes[0]
        expected = side * CUBE[mesh.triangles] / np.sqrt(3.0)
        assert mesh.normals == pytest.approx(expected, abs=1e-6) and len(mesh.points) == 8
    for scheme in ("bilinear", "none"):
        assert load(tmp_path, scheme_text(CUBE, CUBE_FACES, more, scheme)).meshes[0].normals is None


def test_normals_of_a_loop_cage_are_weighted_by_area(tmp_path):
    """At the tip of a slanted tetrahedron the normal is the sum of its three area vectors, each doubled."""
    points = np.array([(0, 0, 0), (3, 0, 0), (0, 2, 0), (0.5, 0.25, 1.0)])
    faces = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    mesh = load(tmp_path, scheme_text(points, faces, scheme="loop")).meshes[0]
    tip = sum(np.cross(points[b] - points[a], points[c] - points[a]) for a, b, c in faces[1:])
    found = mesh.normals[mesh.triangles == 3]
    assert found == pytest.approx(np.tile(tip / np.linalg.norm(tip), (3, 1)), abs=1e-6)


def test_flat_cages_stay_flat(tmp_path):
    """Concave faces, empty ones, holes and faces at points that are not finite turn no normal of a plane."""
    points = [(0, 0, 0), (2, 0, 0), (2, 1, 0), (1, 1, 0), (1, 2, 0), (0, 2, 0), (np.nan, 5, 3)]
    text = mesh_text(points, [6, 0, 3], [0, 1, 2, 3, 4, 5, 3, 4, 6]).replace('"none"', '"catmullClark"')
    mesh = load(tmp_path, text).meshes[0]
    assert area(mesh) == pytest.approx(3.0) and mesh.normals is None
    # A hole is not drawn, but the surface goes on through it: the rim keeps the normals of the cube.
    open_cube = load(tmp_path, scheme_text(CUBE, CUBE_FACES, "int[] holeIndices = [0]")).meshes[0]
    assert area(open_cube) == pytest.approx(20.0)
    assert open_cube.normals == pytest.approx(CUBE[open_cube.triangles] / np.sqrt(3.0), abs=1e-6)


def test_left_handed_surfaces_are_turned_around(tmp_path):
    """The same faces read the other way round: volume and normals change sign."""
    text = scheme_text(CUBE, CUBE_FACES)
    right = load(tmp_path, text, complexity="medium").meshes[0]
    left = load(
        tmp_path,
        text.replace("    uniform", '    uniform token orientation = "leftHanded"\n    uniform', 1),
        complexity="medium",
    ).meshes[0]
    assert volume(left) == pytest.approx(-volume(right)) and volume(right) > 0.0
    assert left.normals[:, ::-1] == pytest.approx(-right.normals, abs=1e-6)


COLOR = np.array([[0.05, 0.01, 0.02], [0.02, 0.06, 0.01]])  # an affine map from the plane to colours


def _grid_colors(tmp_path, primvar, linear="cornersPlus1", boundary="edgeOnly"):
    points, faces = grid(4)
    more = f"""uniform token interpolateBoundary = "{boundary}"
    uniform token faceVaryingLinearInterpolation = "{linear}"
    {primvar}"""
    mesh = load(tmp_path, scheme_text(np.pad(points, ((0, 0), (0, 1))), faces, more), complexity="high").meshes[0]
    return mesh, 0.2 + mesh.points[mesh.triangles][..., :2] @ COLOR


def _color_text(values, interpolation, indices=None):
    text = f'color3f[] primvars:displayColor = {list(map(tuple, values.tolist()))} (interpolation = "{interpolation}")'
    return text + ("" if indices is None else f"\n    int[] primvars:displayColor:indices = {list(map(int, indices))}")


def test_vertex_values_follow_the_points(tmp_path):
    """A vertex primvar that is affine in the points stays so, wherever the points go; a varying one does not move."""
    points, _ = grid(4)
    colors = 0.2 + points @ COLOR
    mesh, expected = _grid_colors(tmp_path, _color_text(colors, "vertex"))
    assert mesh.colors == pytest.approx(expected, abs=1e-6)
    mesh, expected = _grid_colors(tmp_path, _color_text(colors, "varying"))
    corner = mesh.triangles == 0
    assert mesh.colors[corner] == pytest.approx(np.tile([0.2, 0.2, 0.2], (corner.sum(), 1)), abs=1e-6)
    assert mesh.points[0, 0] > 0.1


@pytest.mark.parametrize("linear", ["none", "cornersOnly", "cornersPlus1", "cornersPlus2", "boundaries", "all"])
def test_face_varying_values_follow_their_rule(tmp_path, linear):
    """Without seams, smooth inside; the rim is smooth (none), sharp at its corners, or straight altogether.

    The grid is edgeOnly: its own corners are rounded, and only "none" rounds the values' with them.
    """
    points, faces = grid(4)
    colors = 0.2 + points @ COLOR
    mesh, expected = _grid_colors(tmp_path, _color_text(colors, "faceVarying", np.concatenate(faces)), linear)
    x, y = mesh.points[:, 0], mesh.points[:, 1]
    inside = ((np.abs(x - 2.0) < 0.9) & (np.abs(y - 2.0) < 0.9))[mesh.triangles]
    corner = mesh.triangles == 0
    # On a regular grid the smooth rule keeps affine values wherever the rim is far.
    assert mesh.colors[inside] == pytest.approx(expected[inside], abs=1e-6)
    if linear == "none":
        assert mesh.colors == pytest.approx(expected, abs=1e-6)
    else:
        assert mesh.colors[corner] == pytest.approx(np.tile([0.2] * 3, (corner.sum(), 1)), abs=1e-6)


def test_seams_divide_face_varying_values(tmp_path):
    """Two islands of values never mix: every value stays on its side, and the smooth rule holds on each."""
    _, faces = grid(4)
    flat = np.concatenate(faces)
    left = np.repeat([f.max() <= 14 for f in faces], 4)  # the columns x < 2
    values = np.concatenate([np.full((25, 3), 0.25), np.full((25, 3), 0.75)])
    mesh, _ = _grid_colors(tmp_path, _color_text(values, "faceVarying", flat + 25 * ~left))
    side = mesh.points[mesh.triangles].mean(axis=1)[:, 0] < 2.0
    assert mesh.colors[side] == pytest.approx(0.25) and mesh.colors[~side] == pytest.approx(0.75)


def test_uniform_values_subsets_and_holes_follow_their_faces(tmp_path):
    """Refined faces belong to the face they came from: its colour, its material, its absence."""
    points, faces = grid(2)
    colors = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]], dtype=float)
    more = f"""int[] holeIndices = [3]
    {_color_text(colors, "uniform")}
    def GeomSubset "S" {{
        uniform token elementType = "face"
        uniform token familyName = "materialBind"
        int[] indices = [1]
        rel material:binding = </L>
    }}"""
    text = scheme_text(np.pad(points, ((0, 0), (0, 1))), faces, more)
    text += """
def Material "L" {
    token outputs:surface.connect = </L/P.outputs:surface>
    def Shader "P" {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor = (0.5, 0.5, 0.5)
        token outputs:surface
    }
}"""
    scene = load(tmp_path, text, complexity="high")
    mesh = scene.meshes[0]
    middle = mesh.points[mesh.triangles].mean(axis=1)
    face = 2 * (middle[:, 0] > 1.0) + (middle[:, 1] > 1.0)
    assert np.bincount(face, minlength=4).tolist() == [32, 32, 32, 0]
    expected = np.where((face == 1)[:, None], 0.5, colors[face])
    assert mesh.colors[:, 0] == pytest.approx(expected)


def test_only_the_wanted_is_refined(tmp_path):
    """Polygonal meshes stay as they are; Loop with polygons refines its triangles; bilinear adds no curvature."""
    text = mesh_text(SQUARE, [4], range(4), name="P") + scheme_text(SQUARE, [[0, 1, 2, 3]], scheme="loop", name="L")
    scene = load(tmp_path, text, complexity="high")
    plain, loop = scene.meshes
    assert warned(scene, "/L", "Loop", "cut")
    assert len(plain.triangles) == 2 and len(loop.triangles) == 2 * 16
    triangle = load(tmp_path, scheme_text(SQUARE[:3], [[0, 1, 2]], scheme="loop"), complexity="high").meshes[0]
    assert area(triangle) == pytest.approx(0.5) and len(triangle.triangles) == 16
    bent = [(0, 0, 0), (1, 0, 1), (1, 1, 0), (0, 1, 1)]
    bilinear = load(tmp_path, scheme_text(bent, [[0, 1, 2, 3]], scheme="bilinear"), complexity="veryhigh").meshes[0]
    x, y, z = bilinear.points.T
    assert z == pytest.approx(x + y - 2 * x * y)  # the bilinear patch
    assert bilinear.normals is None


@pytest.mark.parametrize(
    ("more", "word"),
    [
        ("int[] creaseIndices = [0, 9]\n int[] creaseLengths = [2]\n float[] creaseSharpnesses = [1]", "point 9"),
        ("int[] creaseIndices = [0, 1]\n int[] creaseLengths = [3]\n float[] creaseSharpnesses = [1]", "chains"),
        ("int[] creaseIndices = [0, 1]\n int[] creaseLengths = [2]\n float[] creaseSharpnesses = [1, 2]", "2 values"),
        ("int[] cornerIndices = [-1]\n float[] cornerSharpnesses = [1]", "point -1"),
        ("int[] cornerIndices = [1]\n float[] cornerSharpnesses = [1, 2]", "2 values"),
        ("float cornerIndices = 1\n float[] cornerSharpnesses = [1]", "array of integers"),
    ],
)
def test_unusable_creases_and_corners_are_named(tmp_path, more, word):
    """Arrays that do not fit are ignored with a warning, and the surface is smooth."""
    scene = load(tmp_path, scheme_text(CUBE, CUBE_FACES, more), complexity="medium")
    assert warned(scene, "/M", word, "ignored") and len(scene.meshes[0].triangles) == 48


@pytest.mark.parametrize("scheme", ["catmullClark", "loop", "bilinear"])
@pytest.mark.parametrize(
    "faces",
    [
        [[0, 1, 2], [0, 2, 1], [0, 1, 3]],  # three faces at an edge
        [[0, 0, 1, 2], [3, 3, 3]],  # repeated points
        [[0, 1], [0, 1, 2]],  # a face of two
        [[0, 1, 2, 3], [3, 2, 1, 0]],  # the same face twice, back to back
        [[0, 1, 2], [0, 3, 4]],  # joined at a point
        [[5, 1, 2], [0, 1, 2]],  # a point that is not a number
        [[5, 5, 5]],
    ],
)
def test_broken_surfaces_are_refined_or_dropped(tmp_path, scheme, faces):
    """Whatever the topology, what comes out is finite, in range and shaded by unit normals."""
    points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (np.nan, 0, 0)]
    more = "int[] creaseIndices = [0, 4, 1]\n int[] creaseLengths = [3]\n float[] creaseSharpnesses = [inf]"
    for mesh in load(tmp_path, scheme_text(points, faces, more, scheme), complexity="high").meshes:
        assert np.isfinite(mesh.points).all() and mesh.triangles.max() < len(mesh.points)
        if mesh.normals is not None:
            assert np.linalg.norm(mesh.normals, axis=-1) == pytest.approx(1.0, abs=1e-5)


def test_too_fine_a_refinement_is_refused_before_it_is_made(tmp_path, monkeypatch):
    """The limit is for all surfaces together; the message names the prim and the remedy."""
    monkeypatch.setattr(warp_ir.usd.geometry.subdivision, "_MAX_REFINED_TRIANGLES", 100)
    text = scheme_text(CUBE, CUBE_FACES, name="A") + scheme_text(CUBE, CUBE_FACES, name="B")
    assert len(load(tmp_path, text, complexity="medium").meshes) == 2
    with pytest.raises(InputError, match=r"/A: .* 192 triangles, more than 100: choose a lower complexity"):
        load(tmp_path, text, complexity="high")


def test_complexity_is_checked_and_a_flag(tmp_path, capsys):
    """An unknown complexity is an error; --complexity and -c choose it, and the note about cages goes away."""
    with pytest.raises(InputError, match="complexity"):
        load(tmp_path, "", complexity="ultra")
    (tmp_path / "cube.usda").write_text("#usda 1.0\n" + scheme_text(CUBE, CUBE_FACES))
    assert main(["info", str(tmp_path / "cube.usda")]) == 0
    out = capsys.readouterr()
    assert "cage" in out.out + out.err
    assert main(["info", str(tmp_path / "cube.usda"), "-c", "medium"]) == 0
    out = capsys.readouterr()
    assert "48" in out.out and "cage" not in out.out + out.err
