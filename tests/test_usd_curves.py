"""Curves, points and patches: areas, outlines, primvars and interpolations against closed forms."""

import numpy as np
import pytest
from pxr import Usd, UsdGeom, Vt

from tests.stages import area, area_vectors, load, volume, warned
from warp_ir import load_usd

LINE = "point3f[] points = [(0, 0, 0), (0, 2, 0)]\n int[] curveVertexCounts = [2]"
CONSTANT = "(interpolation = 'constant')"
SQUARE = [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1), (1, 0)]
"""Control points of a circle of radius 1 as quadratic rational segments, with `CIRCLE_WEIGHTS`."""
CIRCLE_WEIGHTS = [1.0, 0.5**0.5] * 4 + [1.0]
CIRCLE_KNOTS = "[0, 0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 4]"
CAMERA = """
def Camera "C" {{
    double3 xformOp:translate = (0, 0, {distance})
    uniform token[] xformOpOrder = ["xformOp:translate"]
}}
"""


def rows(points):
    """Points as the text of an array."""
    return "[" + ", ".join("(" + ", ".join(repr(float(x)) for x in point) + ")" for point in points) + "]"


def curves(text, widths=f"float[] widths = [0.2] {CONSTANT}", kind="BasisCurves"):
    """A prim of curves."""
    return f'def {kind} "P" {{\n{text}\n{widths}\n}}\n'


def linear(text=LINE, **kwargs):
    """Linear curves."""
    return curves(f'uniform token type = "linear"\n{text}', **kwargs)


def only_mesh(scene):
    """The mesh of a scene that has one."""
    (mesh,) = scene.meshes
    return mesh


def circle(count, radius=1.0):
    """Points of a regular polygon in the plane z = 0."""
    angle = 2.0 * np.pi * np.arange(count) / count
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.0 * angle], axis=1)


@pytest.mark.parametrize("distance", [5.0, 50.0, 5000.0])
def test_a_straight_tube_has_the_area_of_its_cylinder(tmp_path, distance):
    """The perimeter of its polygon is the circle's, whatever the number of sides; fewer from far away, at least 3."""
    mesh = only_mesh(load(tmp_path, linear() + CAMERA.format(distance=distance)))
    assert area(mesh) == pytest.approx(2.0 * np.pi * 0.1 * 2.0, rel=1e-6)
    pixel = distance * 20.955 / 50.0 / 1920.0
    reach = np.linalg.norm(mesh.points[:, [0, 2]], axis=1)
    assert np.abs(reach - 0.1).max() < pixel / 3.0
    assert len(mesh.triangles) // 2 == 3 or distance < 1000.0
    outward = np.einsum("mi,mci->mc", area_vectors(mesh), mesh.normals)
    assert (outward > 0.0).all()
    assert (np.einsum("mi,mi->m", area_vectors(mesh), mesh.points[mesh.triangles].mean(axis=1) - [0, 1, 0]) > 0).all()


def test_the_silhouette_of_a_tube_has_its_width_on_average(tmp_path):
    """Cauchy: the mean width over directions is the perimeter over π. Directions on a grid: exact to 1e-4."""
    mesh = only_mesh(load(tmp_path, linear() + CAMERA.format(distance=5000.0)))
    angle = np.linspace(0.0, np.pi, 3000, endpoint=False)
    across = mesh.points[:, [0, 2]] @ np.stack([np.cos(angle), np.sin(angle)])
    assert np.mean(np.ptp(across, axis=0)) == pytest.approx(0.2, rel=1e-4)


def test_curves_bend_without_losing_width(tmp_path):
    """The sides of a closed square are mitred: its area is that of four cylinders of the length of its middle line."""
    square = "point3f[] points = [(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0)]\n int[] curveVertexCounts = [4]"
    mesh = only_mesh(load(tmp_path, linear(square + '\n uniform token wrap = "periodic"')))
    assert area(mesh) == pytest.approx(2.0 * np.pi * 0.1 * 8.0, rel=1e-6)
    across = np.ptp(mesh.points, axis=0)
    assert across[0] == pytest.approx(2.2, abs=0.002) and across[1] == pytest.approx(2.2, abs=0.002)


@pytest.mark.parametrize(
    "basis, radius", [("bspline", (4.0 + 2.0 * np.cos(2.0 * np.pi / 24.0)) / 6.0), ("catmullRom", 1.0)]
)
def test_periodic_curves_are_closed(tmp_path, basis, radius):
    """A ring of control points gives a torus: area 4 π² R r, volume 2 π² R r². Chords leave out 1e-3."""
    text = f"""point3f[] points = {rows(circle(24))}
        int[] curveVertexCounts = [24]
        uniform token basis = "{basis}"
        uniform token wrap = "periodic"
    """
    mesh = only_mesh(load(tmp_path, curves(text)))
    assert area(mesh) == pytest.approx(4.0 * np.pi**2 * radius * 0.1, rel=1e-3)
    assert volume(mesh) == pytest.approx(2.0 * np.pi**2 * radius * 0.01, rel=0.02)


@pytest.mark.parametrize(
    "basis, wrap, points, ends",
    [
        ("bezier", "nonperiodic", 7, (0.0, 6.0)),
        ("bspline", "nonperiodic", 7, (1.0, 5.0)),
        ("catmullRom", "nonperiodic", 7, (1.0, 5.0)),
        ("bspline", "pinned", 7, (0.0, 6.0)),
        ("catmullRom", "pinned", 2, (0.0, 1.0)),
        ("bezier", "pinned", 4, (0.0, 3.0)),
    ],
)
def test_where_curves_begin_and_end(tmp_path, basis, wrap, points, ends):
    """Every basis reproduces a line of equidistant control points, between ends that the wrap mode decides."""
    text = f"""point3f[] points = {rows([(0, k, 0) for k in range(points)])}
        int[] curveVertexCounts = [{points}]
        uniform token basis = "{basis}"
        uniform token wrap = "{wrap}"
        color3f[] primvars:displayColor = {rows([(k / 10.0, 0, 0) for k in range(points)])} (interpolation = "vertex")
    """
    mesh = only_mesh(load(tmp_path, curves(text)))
    assert mesh.points[:, 1].min() == pytest.approx(ends[0], abs=1e-6)
    assert mesh.points[:, 1].max() == pytest.approx(ends[1], abs=1e-6)
    assert mesh.colors[..., 0] == pytest.approx(mesh.points[mesh.triangles][..., 1] / 10.0, abs=1e-6)


@pytest.mark.parametrize(
    "interpolation, values, expected",
    [
        ("constant", [0.2], (0.2, 0.2, 0.2, 0.2)),
        ("uniform", [0.2, 0.4], (0.2, 0.2, 0.4, 0.4)),
        ("varying", [0.1, 0.2, 0.3, 0.4, 0.5], (0.1, 0.3, 0.4, 0.5)),
        ("vertex", [0.1, 0.1, 0.3, 0.3, 0.3, 0.3, 0.3, 0.4, 0.5, 0.5, 0.2], (0.1, 0.3, 0.4, 0.2)),
    ],
)
def test_widths_of_every_interpolation(tmp_path, interpolation, values, expected):
    """Two Bézier curves of 7 and 4 points, that is of 2 and 1 segments: the widths at their ends."""
    first, second = [(0, k, 0) for k in range(7)], [(9, k, 0) for k in range(4)]
    text = f"point3f[] points = {rows(first + second)}\n int[] curveVertexCounts = [7, 4]"
    mesh = only_mesh(load(tmp_path, curves(text, f"float[] widths = {values} (interpolation = '{interpolation}')")))

    def width(x, y):
        ring = mesh.points[(np.abs(mesh.points[:, 0] - x) < 1.0) & (np.abs(mesh.points[:, 1] - y) < 1e-9)]
        return 2.0 * np.linalg.norm(ring - [x, y, 0], axis=1).mean()

    found = width(0, 0), width(0, 6), width(9, 0), width(9, 3)
    # The polygon of n sides is larger than its circle by (π/n)/sin(π/n).
    if interpolation == "vertex":
        expected = (values[0], values[6], values[7], values[10])
    assert found == pytest.approx(expected, rel=0.02)


def test_a_taper_is_a_cone(tmp_path):
    """Width 0 at one end: its area is π r s but for the polygon's slant, and its normals lean with the cone."""
    mesh = only_mesh(load(tmp_path, linear(widths="float[] widths = [1, 0] (interpolation = 'vertex')")))
    assert area(mesh) == pytest.approx(np.pi * 0.5 * np.hypot(0.5, 2.0), rel=1e-3)
    assert mesh.normals[..., 1] == pytest.approx(0.5 / np.hypot(0.5, 2.0), abs=1e-6)


def test_curves_with_normals_are_ribbons(tmp_path):
    """A ribbon faces its normals with its width across; that of a helicoid has its area.

    Two triangles across a strip that is twisted by a per half width are too large by a² / 3 at most.
    """
    mesh = only_mesh(load(tmp_path, linear(LINE + "\n normal3f[] normals = [(0, 0, 1), (0, 0, 1)]")))
    assert len(mesh.triangles) == 2 and mesh.normals is not None
    assert area_vectors(mesh).sum(axis=0) == pytest.approx([0.0, 0.0, 0.4], abs=1e-7)
    assert mesh.normals == pytest.approx(np.broadcast_to([0.0, 0.0, 1.0], mesh.normals.shape))
    height = np.linspace(0.0, 2.0, 101)
    normals = rows(np.stack([np.sin(height), 0.0 * height, np.cos(height)], axis=1))
    text = f"""point3f[] points = {rows([(0, y, 0) for y in height])}
        int[] curveVertexCounts = [101]
        normal3f[] normals = {normals} (interpolation = "varying")
    """
    mesh = only_mesh(load(tmp_path, linear(text, widths=f"float[] widths = [0.2] {CONSTANT}")))
    x = np.linspace(-0.1, 0.1, 2001)
    assert area(mesh) == pytest.approx(2.0 * np.trapezoid(np.sqrt(1.0 + x * x), x), rel=0.1**2 / 3.0)


def test_hermite_curves_follow_their_tangents(tmp_path):
    """With tangents of a parabola the curve is that parabola; colours are interpolated along it."""
    text = """point3f[] points = [(0, 0, 0), (1, 1, 0), (2, 4, 0)]
        vector3f[] tangents = [(1, 0, 0), (1, 2, 0), (1, 4, 0)]
        int[] curveVertexCounts = [3]
        color3f[] primvars:displayColor = [(0, 0, 0), (0.5, 0, 0), (1, 0, 0)] (interpolation = "vertex")
    """
    mesh = only_mesh(load(tmp_path, curves(text, f"float[] widths = [1e-3] {CONSTANT}", "HermiteCurves")))
    x, y, _ = mesh.points.T
    assert y == pytest.approx(x**2, abs=5e-3)
    assert mesh.colors[..., 0] == pytest.approx(mesh.points[mesh.triangles][..., 0] / 2.0, abs=1e-3)


def test_rational_nurbs_curves_are_circles(tmp_path):
    """A quadratic with weights is an exact circle; a range of the parameter draws a part of it."""

    def text(ranges):
        return f"""point3f[] points = {rows([(x, y, 0) for x, y in SQUARE])}
            int[] curveVertexCounts = [9]
            int[] order = [3]
            double[] knots = {CIRCLE_KNOTS}
            double2[] ranges = [{ranges}]
            double[] pointWeights = {CIRCLE_WEIGHTS}
        """

    thin = f"float[] widths = [1e-4] {CONSTANT}"
    mesh = only_mesh(load(tmp_path, curves(text("(0, 4)"), thin, "NurbsCurves")))
    assert np.linalg.norm(mesh.points[:, :2], axis=1) == pytest.approx(1.0, abs=1e-4)
    assert area(mesh) == pytest.approx(2.0 * np.pi * np.pi * 1e-4, rel=2e-3)
    mesh = only_mesh(load(tmp_path, curves(text("(1, 2)"), thin, "NurbsCurves")))
    assert mesh.points[:, 0].max() < 1e-3 and mesh.points[:, 1].min() > -1e-3


def test_broken_curves_are_named_and_the_others_drawn(tmp_path):
    """NaN points, too few points, counts beyond the points and negative widths cost their curve, with one line each."""
    text = """point3f[] points = [(0, 0, 0), (0, 1, 0), (nan, 0, 0), (1, 1, 0), (2, 0, 0), (3, 0, 0), (3, 1, 0)]
        int[] curveVertexCounts = [2, 2, 1, 2, 9]
    """
    scene = load(tmp_path, linear(text))
    mesh = only_mesh(scene)
    assert area(mesh) == pytest.approx(2.0 * 2.0 * np.pi * 0.1, rel=1e-6)
    assert warned(scene, "1 curves with infinite or NaN points")
    assert warned(scene, "1 curves with too few points") and warned(scene, "add up to 16, but it has 7 points")
    scene = load(tmp_path, linear(LINE, widths="float[] widths = [-1, 0.2] (interpolation = 'vertex')"))
    assert warned(scene, "1 widths") and len(only_mesh(scene).triangles) > 0
    scene = load(tmp_path, linear(LINE, widths=f"float[] widths = [0] {CONSTANT}"))
    assert not scene.meshes and warned(scene, "1 parts of curves without length or width")
    scene = load(tmp_path, linear(LINE, widths="float[] widths = [1, 2, 3]"))
    assert not scene.meshes and warned(scene, "widths has 3 vertex values where 2 are needed")
    scene = load(tmp_path, linear(LINE, widths=""))
    assert warned(scene, "no widths") and len(only_mesh(scene).triangles) > 0


def test_frames_do_not_twist(tmp_path):
    """Along a curve that turns in all directions, the vertices around it move straight on (parallel transport)."""
    t = np.linspace(0.0, 12.0, 400)
    knot = np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], axis=1)
    text = f"point3f[] points = {rows(knot)}\n int[] curveVertexCounts = [400]"
    mesh = only_mesh(load(tmp_path, linear(text)))
    assert area(mesh) == pytest.approx(2 * np.pi * 0.1 * np.linalg.norm(np.diff(knot, axis=0), axis=1).sum(), rel=2e-3)


def test_curves_in_instances_and_over_time(tmp_path):
    """A point instancer copies curves; time samples and velocities move them."""
    text = f"""
    def PointInstancer "I" {{
        rel prototypes = [</I/P>]
        int[] protoIndices = [0, 0]
        point3f[] positions = [(0, 0, 0), (5, 0, 0)]
        {linear()}
    }}
    """
    assert area(only_mesh(load(tmp_path, text))) == pytest.approx(2.0 * 2.0 * np.pi * 0.1 * 2.0, rel=1e-6)
    moving = linear(LINE.replace("points = [(0, 0, 0), (0, 2, 0)]", "points.timeSamples = {0: [(0, 0, 0), (0, 2, 0)]}"))
    velocities = "vector3f[] velocities.timeSamples = {0: [(0, 0, 24), (0, 0, 24)]}"
    moving = moving.replace("int[]", f"{velocities}\n int[]")
    mesh = only_mesh(load(tmp_path, moving, time=3.0))
    assert mesh.points[:, 2].mean() == pytest.approx(3.0, abs=1e-6)


def test_points_are_spheres(tmp_path):
    """Their area is exact at every size, and colours, materials by subset and opacity belong to points."""
    text = """def Points "P" {
        point3f[] points = [(0, 0, 0), (0, 2, 0), (0, 4, 0), (0, 6, 0)]
        float[] widths = [0.002, 0.4, 1, 0]
        color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)] (interpolation = "vertex")
    }
    """
    scene = load(tmp_path, text)
    mesh = only_mesh(scene)
    assert area(mesh) == pytest.approx(np.pi * (0.002**2 + 0.4**2 + 1.0), rel=1e-6)
    assert warned(scene, "1 points without a positive width")
    assert (np.einsum("mi,mci->mc", area_vectors(mesh), mesh.normals) > 0.0).all()
    y = mesh.points[mesh.triangles][..., 1].mean(axis=1)
    for k, height in enumerate((0.0, 2.0, 4.0)):
        colors = mesh.colors[np.abs(y - height) < 0.6]
        assert (colors == np.eye(3)[k]).all() and len(colors)
    detail = [(np.abs(y - height) < 0.6).sum() for height in (0.0, 2.0, 4.0)]
    assert detail[0] == 8 and detail[2] > detail[0]


def test_materials_of_points_by_subset(tmp_path):
    """A GeomSubset of points binds a material to them."""
    text = """
    def Material "A" {
        token outputs:surface.connect = </A/S.outputs:surface>
        def Shader "S" {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor = (1, 0, 0)
            token outputs:surface
        }
    }
    def Points "P" {
        point3f[] points = [(0, 0, 0), (0, 2, 0)]
        float[] widths = [0.5] (interpolation = "constant")
        def GeomSubset "G" (prepend apiSchemas = ["MaterialBindingAPI"]) {
            uniform token elementType = "point"
            uniform token familyName = "materialBind"
            int[] indices = [1]
            rel material:binding = </A>
        }
    }
    """
    scene = load(tmp_path, text)
    mesh = only_mesh(scene)
    red = [k for k, material in enumerate(scene.materials) if material.albedo == (1.0, 0.0, 0.0)]
    y = mesh.points[mesh.triangles][..., 1].mean(axis=1)
    assert ((mesh.material == red[0]) == (y > 1.0)).all()


def test_velocities_move_points(tmp_path):
    """Between samples points move by their velocities, with the widths of the sample."""
    text = """def Points "P" {
        point3f[] points.timeSamples = {0: [(0, 0, 0)], 10: [(9, 9, 9), (1, 1, 1)]}
        vector3f[] velocities.timeSamples = {0: [(24, 0, 0)], 10: [(0, 0, 0), (0, 0, 0)]}
        float[] widths.timeSamples = {0: [0.5], 10: [3, 3]}
    }
    """
    mesh = only_mesh(load(tmp_path, text, time=4.0))
    assert mesh.points.mean(axis=0) == pytest.approx([4.0, 0.0, 0.0], abs=1e-6)
    assert area(mesh) == pytest.approx(np.pi * 0.25, rel=1e-6)


PATCH = """def NurbsPatch "P" {{
    int uVertexCount = {u}
    int vVertexCount = 2
    int uOrder = {order}
    int vOrder = 2
    double[] uKnots = {knots}
    double[] vKnots = [0, 0, 1, 1]
    point3f[] points = {points}
    {more}
}}
"""


def cylinder_patch(more=""):
    """A cylinder of radius 1 and height 2, with u around it in [0, 4]."""
    points = rows([(x, y, z) for z in (0, 2) for x, y in SQUARE])
    weights = f"double[] pointWeights = {CIRCLE_WEIGHTS * 2}\n{more}"
    return PATCH.format(u=9, order=3, knots=CIRCLE_KNOTS, points=points, more=weights)


def square_patch(more=""):
    """The square [0, 2]² in the plane z = 0, with parameters in [0, 1]²."""
    points = rows([(0, 0, 0), (2, 0, 0), (0, 2, 0), (2, 2, 0)])
    return PATCH.format(u=2, order=2, knots="[0, 0, 1, 1]", points=points, more=more)


def test_a_rational_patch_is_a_cylinder(tmp_path):
    """Radius, area and normals of a cylinder, wound outward (dP/du x dP/dv); leftHanded turns it over."""
    mesh = only_mesh(load(tmp_path, cylinder_patch()))
    assert area(mesh) == pytest.approx(4.0 * np.pi, rel=1e-3)
    assert np.linalg.norm(mesh.points[:, :2], axis=1) == pytest.approx(1.0)
    outward = mesh.points[mesh.triangles] * [1, 1, 0]
    assert mesh.normals == pytest.approx(outward, abs=1e-6)
    mesh = only_mesh(load(tmp_path, cylinder_patch('uniform token orientation = "leftHanded"')))
    assert mesh.normals == pytest.approx(-mesh.points[mesh.triangles] * [1, 1, 0], abs=1e-6)
    half = only_mesh(load(tmp_path, cylinder_patch("double2 uRange = (0, 2)")))
    assert area(half) == pytest.approx(2.0 * np.pi, rel=1e-3) and half.points[:, 1].min() > -1e-9


def test_a_patch_is_trimmed(tmp_path):
    """Inside the outer loop and outside the circular hole in it, by the even-odd rule; primvars survive the cut."""
    hole = rows(
        [((0.5 + 0.25 * x) * w, (0.5 + 0.25 * y) * w, w) for (x, y), w in zip(SQUARE, CIRCLE_WEIGHTS, strict=True)]
    )
    trim = f"""
        int[] trimCurve:counts = [1, 1]
        int[] trimCurve:orders = [2, 3]
        int[] trimCurve:vertexCounts = [5, 9]
        double[] trimCurve:knots = [0, 0, 1, 2, 3, 4, 4, {CIRCLE_KNOTS[1:]}
        double2[] trimCurve:ranges = [(0, 4), (0, 4)]
        double3[] trimCurve:points = [(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1), (0, 0, 1), {hole[1:]}
        color3f[] primvars:displayColor = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)] (interpolation = "vertex")
    """
    mesh = only_mesh(load(tmp_path, square_patch(trim)))
    assert area(mesh) == pytest.approx(4.0 - np.pi * 0.25, rel=1e-3)
    assert mesh.colors[..., :2] == pytest.approx(mesh.points[mesh.triangles][..., :2] / 2.0, abs=1e-6)
    distance = np.linalg.norm(mesh.points[np.unique(mesh.triangles), :2] - 1.0, axis=1)
    assert distance.min() == pytest.approx(0.5, abs=0.003)


def test_a_broken_patch_is_named(tmp_path):
    """Knots that do not fit cost the prim, trim curves that do not fit cost the trim; one line each."""
    scene = load(tmp_path, PATCH.format(u=3, order=2, knots="[0, 0, 1, 1]", points="[(0, 0, 0)]", more=""))
    assert not scene.meshes and warned(scene, "u: 3 points of order 2 do not fit 4 knots")
    scene = load(tmp_path, square_patch("int[] trimCurve:counts = [1]"))
    assert area(only_mesh(scene)) == pytest.approx(4.0) and warned(scene, "trim curves do not fit")


def test_hair_takes_three_sides(tmp_path):
    """Curves thinner than a pixel cost six triangles a segment, and are read for all curves at once."""
    count, points = 2000, 6
    generator = np.random.default_rng(1)
    roots = generator.uniform(-1.0, 1.0, (count, 1, 3)) * [1, 0, 1]
    hair = roots + np.arange(points)[:, None] * [0.0, 0.02, 0.0]
    stage = Usd.Stage.CreateNew(str(tmp_path / "hair.usdc"))
    prim = UsdGeom.BasisCurves.Define(stage, "/Hair")
    prim.GetTypeAttr().Set("linear")
    prim.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(hair.reshape(-1, 3).astype(np.float32)))
    prim.GetCurveVertexCountsAttr().Set(Vt.IntArray.FromNumpy(np.full(count, points, np.int32)))
    prim.GetWidthsAttr().Set(Vt.FloatArray([1e-4]))
    prim.SetWidthsInterpolation("constant")
    stage.Save()
    mesh = only_mesh(load_usd(tmp_path / "hair.usdc"))
    assert len(mesh.triangles) == 6 * count * (points - 1)
    assert area(mesh) == pytest.approx(np.pi * 1e-4 * 0.1 * count, rel=1e-4)


POINTS = [
    *("[]", "[(0, 0, 0)]", "[(0, 0, 0), (0, 0, 0)]", "[(0, 0, 0), (1, 0, 0), (2, 1, 0), (3, 0, 1)]"),
    *("[(nan, 0, 0), (1, 0, 0), (2, inf, 0), (3, 0, 1)]", "[(1e30, 0, 0), (-1e30, 0, 0), (0, 1e30, 1), (0, 0, 0)]"),
    "[(0, 0, 0), (1, 0, 0), (0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 0, 1), (3, 0, 0), (5, 5, 5)]",
]
ODD = {
    "counts": ["[]", "[2]", "[4]", "[4, 4]", "[0, 4]", "[-1, 4]", "[100000000]", "[3, 1, 4]"],
    "widths": ["[]", "[0.1]", "[0, 0]", "[nan, 0.1, 0.1, 0.1]", "[-1]", "[1e30]", "[0.1, 0.2]"],
    "order": ["[]", "[4]", "[1]", "[2, 3]", "[-5]", "[40]", "[3]"],
    "knots": ["[]", "[0, 0, 0, 0, 1, 1, 1, 1]", "[0, 1, 2, 3, 4, 5, 6, 7]", "[7, 6, 5, 4, 3, 2, 1, 0]", "[nan, 0, 1]"],
    "ranges": ["[]", "[(0, 1)]", "[(1, 0)]", "[(nan, 1)]", "[(-5, 50)]"],
}


@pytest.mark.parametrize("seed", range(40))
def test_odd_arrays_are_survived(tmp_path, seed):
    """Arrays of any length, with any numbers, give finite triangles or none."""
    choose = np.random.default_rng(seed).choice
    odd = {name: choose(values) for name, values in ODD.items()}
    kind = choose(["BasisCurves", "HermiteCurves", "NurbsCurves", "Points", "NurbsPatch"])
    text = f"""def {kind} "P" {{
        point3f[] points = {choose(POINTS)}
        float[] widths = {odd["widths"]} (interpolation = "{choose(["constant", "uniform", "varying", "vertex"])}")
        {f"int[] curveVertexCounts = {odd['counts']}" if "Curves" in kind else ""}
        {f"normal3f[] normals = {choose(POINTS)}" if choose(2) and "Curves" in kind else ""}
        {f"vector3f[] tangents = {choose(POINTS)}" if kind == "HermiteCurves" else ""}
        color3f[] primvars:displayColor = {choose(POINTS)} (interpolation = "{choose(["uniform", "vertex"])}")
    """
    if kind == "BasisCurves":
        text += f"""uniform token type = "{choose(["linear", "cubic"])}"
        uniform token basis = "{choose(["bezier", "bspline", "catmullRom", "power"])}"
        uniform token wrap = "{choose(["nonperiodic", "periodic", "pinned"])}"
        """
    if kind == "NurbsCurves":
        text += f"int[] order = {odd['order']}\n double[] knots = {odd['knots']}\n double2[] ranges = {odd['ranges']}\n"
    if kind == "NurbsPatch":
        text += f"""int uVertexCount = {choose([2, 4, -1])}
        int vVertexCount = {choose([2, 1])}
        int uOrder = {choose([2, 4, 0])}
        int vOrder = {choose([2, 1])}
        double[] uKnots = {odd["knots"]}
        double[] vKnots = {choose(["[0, 0, 1, 1]", odd["knots"]])}
        int[] trimCurve:counts = [1]
        int[] trimCurve:orders = {odd["order"]}
        int[] trimCurve:vertexCounts = {odd["counts"]}
        double[] trimCurve:knots = {odd["knots"]}
        """
    for mesh in load(tmp_path, text + "}\n").meshes:
        assert np.isfinite(mesh.points[mesh.triangles]).all() and np.isfinite(mesh.normals).all()
