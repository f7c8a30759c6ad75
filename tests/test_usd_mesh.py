"""Geometry: triangulation, winding, normals, implicit shapes and instancing."""

import subprocess
import sys

import numpy as np
import pytest
from pxr import Usd, UsdGeom, Vt

from tests.stages import SQUARE, area, area_vectors, diffuse, load, mesh_text, volume, warned

L_SHAPE = [(0, 0, 0), (3, 0, 0), (3, 1, 0), (1, 1, 0), (1, 3, 0), (0, 3, 0)]  # area 5
DART = [(0, 0, 0), (2, 0, 0), (0.5, 0.5, 0), (0, 2, 0)]  # reflex at 2; area 1


@pytest.mark.parametrize(("polygon", "expected"), [(SQUARE, 1.0), (DART, 1.0), (L_SHAPE, 5.0)])
@pytest.mark.parametrize("shift", range(4))
def test_a_polygon_keeps_its_area_wherever_it_starts(tmp_path, polygon, expected, shift):
    """Convex or concave, the triangles cover the polygon once: every area points the same way and they add up."""
    polygon = polygon[shift:] + polygon[:shift]
    # Tilted out of every coordinate plane.
    turn, _ = np.linalg.qr(np.array([[1.0, 2.0, 3.0], [0.5, -1.0, 2.0], [2.0, 1.0, -1.0]]))
    turn *= np.sign(np.linalg.det(turn))
    mesh = load(tmp_path, mesh_text(np.array(polygon) @ turn.T, [len(polygon)], range(len(polygon)))).meshes[0]
    vectors = area_vectors(mesh) @ turn
    assert len(mesh.triangles) == len(polygon) - 2
    assert (vectors[:, 2] > 0.0).all()
    assert vectors.sum(axis=0) == pytest.approx([0.0, 0.0, expected], abs=1e-6)


def test_mixed_faces_stay_in_order(tmp_path):
    """Triangles come face by face, whatever the faces' sizes, so that uniform values follow."""
    points = SQUARE + [(x + 5, y, 0) for x, y, _ in L_SHAPE] + [(10, 0, 0), (11, 0, 0), (10, 1, 0)]
    mesh = load(
        tmp_path,
        mesh_text(
            points,
            [4, 6, 3],
            range(13),
            """
    color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0), (0, 0, 1)] (interpolation = "uniform")""",
        ),
    ).meshes[0]
    assert np.argmax(mesh.colors[:, 0], axis=1).tolist() == [0, 0, 1, 1, 1, 1, 2]
    assert np.linalg.norm(area_vectors(mesh)[2:6], axis=1).sum() == pytest.approx(5.0)


def test_holes_are_left_out(tmp_path):
    """Faces listed in holeIndices are not drawn; indices out of range are named."""
    points = SQUARE + [(x + 2, y, z) for x, y, z in SQUARE]
    scene = load(tmp_path, mesh_text(points, [4, 4], range(8), "int[] holeIndices = [1, 9]"))
    assert area(scene.meshes[0]) == pytest.approx(1.0) and warned(scene, "/M", "1 hole")


@pytest.mark.parametrize("left_handed", [False, True])
@pytest.mark.parametrize("mirrored", [False, True])
def test_the_front_is_where_orientation_and_mirroring_say(tmp_path, left_handed, mirrored):
    """Left-handed winding and a mirroring transform each turn the front around; both cancel out."""
    more = f"""uniform token orientation = "{"leftHanded" if left_handed else "rightHanded"}"
    float3 xformOp:scale = ({-1 if mirrored else 1}, 1, 1)
    uniform token[] xformOpOrder = ["xformOp:scale"]"""
    mesh = load(tmp_path, mesh_text(SQUARE, [4], range(4), more)).meshes[0]
    # Mirrored along x, a right-handed square is still seen counter-clockwise from +z: its front stays in place.
    front = -1.0 if left_handed else 1.0
    assert np.sign(area_vectors(mesh)[:, 2]).tolist() == [front, front]


def test_a_mirrored_closed_shape_is_still_wound_outward(tmp_path):
    """A negative scale must not turn a shape inside out."""
    scene = load(
        tmp_path,
        """def Cube "C" {
    float3 xformOp:scale = (-1, 2, 1)
    uniform token[] xformOpOrder = ["xformOp:scale"]
}""",
    )
    assert volume(scene.meshes[0]) == pytest.approx(16.0)


def test_normals_are_transformed_by_the_inverse_transpose(tmp_path):
    """Under a non-uniform, mirroring scale a normal stays perpendicular to what it was perpendicular to."""
    scene = load(
        tmp_path,
        mesh_text(
            SQUARE,
            [4],
            range(4),
            """
    normal3f[] normals = [(1, 0, 1), (1, 0, 1), (1, 0, 1), (1, 0, 1)]
    float3 xformOp:scale = (-2, 1, 1)
    uniform token[] xformOpOrder = ["xformOp:scale"]""",
        ),
    )
    expected = np.array([-0.5, 0.0, 1.0]) / np.hypot(0.5, 1.0)
    assert scene.meshes[0].normals == pytest.approx(np.broadcast_to(expected, (2, 3, 3)), abs=1e-6)


@pytest.mark.parametrize(
    ("interpolation", "count"), [("constant", 1), ("uniform", 2), ("vertex", 6), ("varying", 6), ("faceVarying", 8)]
)
@pytest.mark.parametrize("indexed", [False, True])
@pytest.mark.parametrize("primvar", ["normals", "displayColor"])
def test_every_interpolation_reaches_the_right_corners(tmp_path, interpolation, count, indexed, primvar):
    """A corner's value is the one of its prim, face, point or face-vertex; indexed or not."""
    points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0), (2, 1, 0)]
    faces = [0, 1, 2, 3, 1, 4, 5, 2]
    values = np.stack([0.1 + 0.1 * np.arange(count), np.full(count, 0.3), np.full(count, 0.5)], axis=1)
    kind = "normal3f" if primvar == "normals" else "color3f"
    text = f'{kind}[] primvars:{primvar} = {list(map(tuple, values.tolist()))} (interpolation = "{interpolation}")'
    expected = values
    if indexed:
        order = np.arange(count)[::-1]
        text += f"\n    int[] primvars:{primvar}:indices = {order.tolist()}"
        expected = values[order]
    mesh = load(tmp_path, mesh_text(points, [4, 4], faces, text)).meshes[0]
    fan = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])  # face-vertices of the corners
    pick = {"constant": 0 * fan, "uniform": fan // 4, "faceVarying": fan}.get(interpolation, np.array(faces)[fan])
    expected = expected[pick]
    if primvar == "normals":
        assert mesh.normals == pytest.approx(expected / np.linalg.norm(expected, axis=-1, keepdims=True), abs=1e-6)
    elif interpolation == "constant":
        assert mesh.colors is None
    else:
        assert mesh.colors == pytest.approx(expected, abs=1e-6)


def test_primvars_normals_beat_normals_and_flat_normals_are_dropped(tmp_path):
    """primvars:normals wins over normals; normals that equal the face's own are not kept."""
    both = """normal3f[] normals = [(1, 0, 1), (1, 0, 1), (1, 0, 1), (1, 0, 1)]
    normal3f[] primvars:normals = [(0, 0, 2)] (interpolation = "constant")"""
    assert load(tmp_path, mesh_text(SQUARE, [4], range(4), both)).meshes[0].normals is None


def test_unusable_normals_fall_back_to_the_face(tmp_path):
    """A wrong count makes the mesh faceted, and is named; a zero normal is replaced by the face's."""
    scene = load(tmp_path, mesh_text(SQUARE, [4], range(4), "normal3f[] normals = [(1, 0, 1)]"))
    assert scene.meshes[0].normals is None and warned(scene, "/M", "faceted")
    scene = load(
        tmp_path,
        mesh_text(SQUARE, [4], range(4), "normal3f[] normals = [(0, 0, 0), (1, 0, 0), (nan, 0, 0), (1, 0, 0)]"),
    )
    assert scene.meshes[0].normals[0].tolist() == [[0, 0, 1], [1, 0, 0], [0, 0, 1]]


def test_subdivision_meshes_are_cages_with_one_note(tmp_path):
    """A catmullClark mesh is drawn as its cage; all of them share one warning."""
    text = mesh_text(SQUARE, [4], range(4), name="A") + mesh_text(SQUARE, [4], range(4), name="B")
    scene = load(tmp_path, text.replace('"none"', '"catmullClark"'))
    assert len(scene.meshes) == 2 and sum("cage" in line for line in scene.warnings) == 1
    assert warned(scene, "/A, /B", "2 in all")


@pytest.mark.parametrize(
    ("counts", "indices", "word"),
    [
        ([4], [0, 1, 2], "add up"),
        ([3], [0, 1, 9], "point 9"),
        ([3], [0, 1, -1], "point -1"),
        ([-3, 6], [0, 1, 2], "negative"),
    ],
)
def test_broken_topology_is_named_and_skipped(tmp_path, counts, indices, word):
    """Counts and indices that do not belong together skip the mesh, with the reason."""
    scene = load(tmp_path, mesh_text(SQUARE, counts, indices))
    assert scene.meshes == () and warned(scene, "/M", word, "skipped")


def test_points_of_another_type_are_named_and_skipped(tmp_path):
    """Points authored as a single vector are no points."""
    text = mesh_text(SQUARE, [4], range(4)).split("\n")
    text[2] = "    point3f points = (1, 2, 3)"
    assert warned(load(tmp_path, "\n".join(text)), "/M", "points is a Vec3f", "skipped")


def test_faces_at_nan_points_are_dropped(tmp_path):
    """NaN removes the faces that touch it and no others; the points that remain are finite."""
    scene = load(tmp_path, mesh_text([*SQUARE, (np.nan, 0, 0)], [3, 3], [0, 1, 2, 0, 1, 4]))
    assert len(scene.meshes[0].triangles) == 1 and warned(scene, "/M", "1 faces", "NaN")
    assert np.isfinite(scene.meshes[0].points).all()


def test_degenerate_faces_are_counted(tmp_path):
    """Two vertices, a repeated one, or no area: such faces are left out and counted."""
    points = [*SQUARE, (2, 0, 0)]
    scene = load(tmp_path, mesh_text(points, [4, 2, 3, 3], [0, 1, 2, 3, 0, 1, 0, 1, 1, 0, 1, 4]))
    assert len(scene.meshes[0].triangles) == 2
    assert scene.stats["degenerate_faces"] == 3 and warned(scene, "/M", "3 degenerate")


def test_an_empty_mesh_is_skipped_silently(tmp_path):
    """A mesh without points or faces is no trouble."""
    scene = load(tmp_path, 'def Mesh "A" {\n}\n' + mesh_text([], [], [], name="B"))
    assert scene.meshes == () and not warned(scene, "/A") and not warned(scene, "/B")


def test_a_flattening_transform_drops_what_collapses(tmp_path):
    """Scaled to a plane, a cube keeps its two parallel faces; scaled to a point, nothing."""
    text = 'def Cube "C" {{ float3 xformOp:scale = {}\n uniform token[] xformOpOrder = ["xformOp:scale"]\n}}'
    assert area(load(tmp_path, text.format("(1, 1, 0)")).meshes[0]) == pytest.approx(8.0)
    assert load(tmp_path, text.format("(0, 0, 0)")).meshes == ()
    ball = load(tmp_path, text.format("(1, 1, 0)").replace("Cube", "Sphere")).meshes[0]
    assert np.linalg.norm(ball.normals, axis=-1) == pytest.approx(1.0, abs=1e-6)


def test_the_surface_of_tetrahedra(tmp_path):
    """A TetMesh is drawn by its surface, authored or not, wound outward."""
    tet = """def TetMesh "T" {
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
    int4[] tetVertexIndices = [(0, 1, 2, 3)]
%s}"""
    surface = "    int3[] surfaceFaceVertexIndices = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]\n"
    for more in ("", surface):
        assert volume(load(tmp_path, tet % more).meshes[0]) == pytest.approx(1 / 6)


TWO_TETRAHEDRA = """def TetMesh "T" {
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, -1)]
    int4[] tetVertexIndices = [(0, 1, 2, 3), (0, 2, 1, 4)]
    %s
}
"""
SURFACE = "int3[] surfaceFaceVertexIndices = [(0, 1, 4), (0, 1, 3), (0, 3, 2), (1, 2, 3), (1, 4, 2), (0, 2, 4)]\n"


@pytest.mark.parametrize("surface", ["", SURFACE])
def test_uniform_values_of_tetrahedra_are_theirs(tmp_path, surface):
    """Each surface face has the colour of its tetrahedron: red above, blue below."""
    colors = "color3f[] primvars:displayColor = [(1, 0, 0), (0, 0, 1)] (\n interpolation = 'uniform'\n)"
    mesh = load(tmp_path, TWO_TETRAHEDRA % (surface + colors)).meshes[0]
    assert len(mesh.triangles) == 6
    above = mesh.points[mesh.triangles].mean(axis=1)[:, 2] > 0.0
    np.testing.assert_array_equal(mesh.colors[:, 0], np.where(above[:, None], [1, 0, 0], [0, 0, 1]))


def test_uniform_values_of_a_tet_mesh_may_be_those_of_its_surface(tmp_path):
    """As many colours as surface faces belong to these, in their order, as Storm draws them."""
    shades = [round(0.1 * (k + 1), 1) for k in range(6)]
    colors = f"color3f[] primvars:displayColor = {[(x, x, x) for x in shades]} (\n interpolation = 'uniform'\n)"
    mesh = load(tmp_path, TWO_TETRAHEDRA % (SURFACE + colors)).meshes[0]
    assert mesh.colors[:, 0, 0] == pytest.approx(shades)


def test_materials_of_tetrahedra(tmp_path):
    """A GeomSubset of tetrahedra binds its material to their faces."""
    subset = """def GeomSubset "S" (prepend apiSchemas = ["MaterialBindingAPI"]) {
        uniform token elementType = "tetrahedron"
        uniform token familyName = "materialBind"
        int[] indices = [1]
        rel material:binding = </A>
    }"""
    scene = load(tmp_path, TWO_TETRAHEDRA % subset + diffuse("(0, 1, 0)"))
    mesh = scene.meshes[0]
    green = [scene.materials[k].albedo == (0.0, 1.0, 0.0) for k in mesh.material]
    assert green == (mesh.points[mesh.triangles].mean(axis=1)[:, 2] < 0.0).tolist()


CACHE = """(
    timeCodesPerSecond = 10
)
def Mesh "M" {
    point3f[] points.timeSamples = { 0: %(first)s, 4: %(second)s }
    vector3f[] velocities.timeSamples = { 0: %(velocities)s, 4: [(0, 0, 0), (0, 0, 0), (0, 0, 0)] }
    %(more)s
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    uniform token subdivisionScheme = "none"
}"""
FIRST, SECOND = "[(0, 0, 0), (1, 0, 0), (0, 1, 0)]", "[(0, 0, 9), (1, 0, 9), (0, 1, 9)]"
FASTER = "[(0, 0, 20), (0, 0, 20), (0, 0, 0)]"
UPWARD = "[(0, 0, 5), (0, 0, 5), (0, 0, 5)]"


@pytest.mark.parametrize("more", ["", f"vector3f[] accelerations.timeSamples = {{ 0: {FASTER}, 4: {FASTER} }}"])
@pytest.mark.parametrize("time", [-1.0, 0.0, 1.0, 2.5, 4.0, 6.0])
def test_velocities_carry_points_between_samples(tmp_path, more, time):
    """Points are at p + v t + a t² / 2, t seconds after the sample before; USD's ComputePointsAtTime agrees."""
    points = load(tmp_path, CACHE % dict(first=FIRST, second=SECOND, velocities=UPWARD, more=more), time=time)
    stage = Usd.Stage.Open(str(tmp_path / "stage.usda"))
    expected = UsdGeom.PointBased(stage.GetPrimAtPath("/M")).ComputePointsAtTime(time, time)
    assert points.meshes[0].points == pytest.approx(np.array(expected, dtype=float), abs=1e-6)
    if 0.0 <= time < 4.0:
        t = time / 10.0
        assert points.meshes[0].points[0, 2] == pytest.approx(5.0 * t + (10.0 * t**2 if more else 0.0))


@pytest.mark.parametrize("complexity", ["low", "medium"])
def test_values_of_points_that_change_places_are_those_of_the_sample_before(tmp_path, complexity):
    """Between samples whose points are in another order, colours, coordinates and normals come with the points."""
    more = """
    color3f[] primvars:displayColor (
        interpolation = "vertex"
    )
    color3f[] primvars:displayColor.timeSamples = {
        0: [(1, 0, 0), (0, 1, 0), (0, 0, 1)], 4: [(0, 0, 1), (1, 0, 0), (0, 1, 0)] }
    normal3f[] normals.timeSamples = {
        0: [(0, 0, 1), (0.6, 0, 0.8), (0, 0.6, 0.8)], 4: [(0, 0.6, 0.8), (0, 0, 1), (0.6, 0, 0.8)] }
    """
    text = CACHE % dict(first=FIRST, second="[(0, 1, 9), (0, 0, 9), (1, 0, 9)]", velocities=UPWARD, more=more)
    scheme = "none" if complexity == "low" else "bilinear"
    scene = load(tmp_path, text.replace('"none"', f'"{scheme}"'), time=2.0, complexity=complexity)
    points, colors = (
        v.reshape(-1, 3) for v in (scene.meshes[0].points[scene.meshes[0].triangles], scene.meshes[0].colors)
    )
    assert points[:, 2] == pytest.approx(1.0)  # 0.2 s after the sample, at 5 units per second
    # Colours are linear over the triangle: red at the origin, green along x, blue along y.
    assert colors == pytest.approx(np.stack([1 - points[:, 0] - points[:, 1], points[:, 0], points[:, 1]], axis=1))
    if complexity == "low":
        assert scene.meshes[0].normals[0] == pytest.approx(np.array([(0, 0, 1), (0.6, 0, 0.8), (0, 0.6, 0.8)]))


@pytest.mark.parametrize(
    ("velocities", "word"), [("[(0, 0, 5)]", "1 values for 3 points"), ("[(0,0,nan), (0,0,0), (0,0,0)]", "NaN")]
)
def test_velocities_that_do_not_fit_are_named(tmp_path, velocities, word):
    """The points are interpolated as if there were none."""
    scene = load(tmp_path, CACHE % dict(first=FIRST, second=SECOND, velocities=velocities, more=""), time=2.0)
    assert warned(scene, "/M", "velocities", word) and scene.meshes[0].points[:, 2] == pytest.approx(4.5)


@pytest.mark.parametrize("color", ["", "color3f[] primvars:displayColor = [(1, 0, 0)]"])
@pytest.mark.parametrize(
    "opacity, expected, word",
    [
        ("[0.5]", [0.5], "partial opacity"),
        ("[1, 1]", [1.0], None),
        ("[]", [1.0], None),
        ("[0.2, 0.2, 0.8, 0.6] (interpolation = 'vertex')", [0.4, 8 / 15], "partial opacity"),
        ("[0, 0, 0, 0.6] (interpolation = 'vertex')", [0.2], "partial opacity"),
        ("[0]", [], None),
    ],
)
def test_opacity_without_a_material(tmp_path, color, opacity, expected, word):
    """DisplayOpacity is the surface's where no material is bound, the mean of each triangle; at 0 there is none."""
    text = f"float[] primvars:displayOpacity = {opacity}\n{color}"
    scene = load(tmp_path, mesh_text(SQUARE, [4], range(4), text))
    if not expected:
        assert not scene.meshes and scene.stats["triangles_absent"] == 2
    else:
        assert [m.opacity for m in scene.materials] == pytest.approx(expected)
    assert warned(scene, "/M", word or "pacity") == (word is not None)


PI = np.pi
# Areas and volumes of the schemas' defaults, in closed form.
IMPLICIT = [
    ("Sphere", "", 4 * PI, 4 / 3 * PI),
    ("Cube", "", 24.0, 8.0),
    ("Cylinder", "", 6 * PI, 2 * PI),
    ("Cylinder_1", "double radiusTop = 0.5", PI * (1.25 + 1.5 * np.hypot(2, 0.5)), 2 * PI / 3 * 1.75),
    ("Cone", "", PI * (1 + np.sqrt(5)), 2 / 3 * PI),
    ("Capsule", "", 2 * PI, PI / 4 + PI / 6),
    ("Capsule_1", "", 2 * PI, PI / 4 + PI / 6),
]


@pytest.mark.parametrize("axis", "XYZ")
@pytest.mark.parametrize(("kind", "more", "surface", "content"), IMPLICIT)
def test_implicit_shapes_have_their_area_and_volume(tmp_path, kind, more, surface, content, axis):
    """Tessellated, a shape is within 0.2 % of its area, wound outward, with unit normals that point outward.

    Inscribed, both are short in proportion to the square of the facets' size; the volume by twice as much.
    """
    axis_text = f'uniform token axis = "{axis}"' if kind not in ("Sphere", "Cube") else ""
    mesh = load(tmp_path, f'def {kind} "S" {{\n {more}\n {axis_text}\n}}').meshes[0]
    assert area(mesh) == pytest.approx(surface, rel=2e-3)
    assert volume(mesh) == pytest.approx(content, rel=4e-3)
    if kind != "Cube":
        assert np.linalg.norm(mesh.normals, axis=-1) == pytest.approx(1.0, abs=1e-6)
        assert (np.einsum("mci,mi->mc", mesh.normals, area_vectors(mesh)) > 0.0).all()


@pytest.mark.parametrize(("kind", "more", "surface", "content"), IMPLICIT)
def test_left_handed_implicit_shapes_face_inwards(tmp_path, kind, more, surface, content):
    """The schema's left-hand rule turns normals round: the volume that the winding encloses is negative."""
    text = f'def {kind} "S" {{ {more}\nuniform token orientation = "leftHanded"\n}}'
    (mesh,) = load(tmp_path, text).meshes
    assert area(mesh) == pytest.approx(surface, rel=2e-3) and volume(mesh) == pytest.approx(-content, rel=4e-3)
    if mesh.normals is not None:
        assert (np.einsum("mci,mi->mc", mesh.normals, area_vectors(mesh)) > 0.0).all()


def test_the_normals_of_a_scaled_sphere_are_those_of_the_ellipsoid(tmp_path):
    """At a point p of an ellipsoid with half axes s the normal is along p / s²."""
    mesh = load(
        tmp_path,
        """def Sphere "S" { float3 xformOp:scale = (1, 2, 0.5)
    uniform token[] xformOpOrder = ["xformOp:scale"]
}""",
    ).meshes[0]
    corners = mesh.points[mesh.triangles]
    expected = corners / np.array([1.0, 4.0, 0.25])
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    pole = np.abs(corners[..., 2]) > 0.499
    assert mesh.normals[~pole] == pytest.approx(expected[~pole], abs=1e-5)


def test_the_cone_points_along_its_axis(tmp_path):
    """The apex is at the positive end of the axis."""
    for k, axis in enumerate("XYZ"):
        points = load(tmp_path, f'def Cone "S" {{ uniform token axis = "{axis}"\n}}').meshes[0].points
        top = points[points[:, k] > 0.99]
        assert np.abs(np.delete(top, k, axis=1)).max() < 1e-12


def test_a_capsule_with_two_radii_has_no_crease(tmp_path):
    """The caps of Capsule_1 continue the flank: neighbouring rings share their normal, and none is off by much."""
    mesh = load(tmp_path, 'def Capsule_1 "S" { double radiusTop = 0.2\n double height = 2\n}').meshes[0]
    flat = area_vectors(mesh)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    assert np.einsum("mci,mi->mc", mesh.normals, flat).min() > np.cos(np.radians(6.0))


@pytest.mark.parametrize(("axis", "extent"), [("X", (0, 4, 2)), ("Y", (2, 0, 4)), ("Z", (2, 4, 0))])
def test_a_plane_lies_across_its_axis_and_is_double_sided(tmp_path, axis, extent):
    """Width and length are along the axes that the schema names; the front looks along the axis."""
    mesh = load(
        tmp_path, f'def Plane "P" {{ double width = 2\n double length = 4\n uniform token axis = "{axis}"\n}}'
    ).meshes[0]
    assert np.ptp(mesh.points, axis=0) == pytest.approx(extent)
    assert area_vectors(mesh).sum(axis=0)["XYZ".index(axis)] == pytest.approx(8.0)
    assert mesh.double_sided


@pytest.mark.parametrize("radius", ["-1", "nan", "0"])
def test_impossible_dimensions_are_named_and_skipped(tmp_path, radius):
    """A radius that is negative, not a number or zero makes no sphere."""
    scene = load(tmp_path, f'def Sphere "S" {{ double radius = {radius}\n}}')
    assert scene.meshes == () and warned(scene, "/S", "skipped")


@pytest.mark.slow
def test_a_million_triangles_load_in_seconds(tmp_path):
    """500 meshes with 1 024 000 triangles and normals, from a .usdc: below 5 s and 1 GB, as a process of its own."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "million.usdc"))
    side = np.arange(33.0)
    flat = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    corner = np.arange(32 * 33).reshape(32, 33)[:, :-1].reshape(-1)
    quads = np.stack([corner, corner + 33, corner + 34, corner + 1], axis=1).astype(np.int32)
    heights = np.random.default_rng(0).normal(scale=0.2, size=(500, len(flat), 1))
    for k in range(500):
        mesh = UsdGeom.Mesh.Define(stage, f"/World/M{k}")
        points = np.concatenate([flat, heights[k]], axis=1) + np.array([40 * (k % 25), 40 * (k // 25), 0])
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
        mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.tile(np.float32([0, 0.6, 0.8]), (len(flat), 1))))
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(quads), 4, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(quads.reshape(-1)))
        mesh.CreateSubdivisionSchemeAttr("none")
    stage.Save()
    code = """
import resource, sys, time
import warp_ir as ir
start = time.perf_counter()
scene = ir.load_usd(sys.argv[1])
print(scene.triangle_count, time.perf_counter() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"""
    command = [sys.executable, "-c", code, str(tmp_path / "million.usdc")]
    count, seconds, kibibytes = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    assert count == "1024000"
    assert float(seconds) < 5.0 and int(kibibytes) < 1_000_000


def test_equal_shapes_share_what_does_not_move(tmp_path):
    """A thousand cubes of one size keep one array of triangles and, by colour, one of materials."""
    cubes = "".join(
        f'def Cube "C{k}" {{ double3 xformOp:translate = ({3 * k}, 0, 0)\n'
        'uniform token[] xformOpOrder = ["xformOp:translate"]\n'
        f"color3f[] primvars:displayColor = [({k % 2}, 0, 0)]\n}}\n"
        for k in range(6)
    )
    scene = load(tmp_path, cubes + 'def Cube "D" {\ndouble size = 4\n}')
    *equal, other = scene.meshes
    assert len({id(mesh.triangles.base) for mesh in equal}) == 1 and area(other) == pytest.approx(96.0)
    assert [mesh.points[:, 0].mean() for mesh in equal] == pytest.approx([3.0 * k for k in range(6)])
    assert [scene.materials[mesh.material[0]].albedo[0] for mesh in equal] == [0.0, 1.0] * 3
