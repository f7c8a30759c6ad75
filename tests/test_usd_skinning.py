"""Skinning: meshes follow their skeletons and blend shapes, or stay at rest with a warning."""

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdSkel

from tests.stages import area_vectors, load, real_file, warned
from warp_ir import load_usd

# A strip along x from 0 to 2 whose second bone, from x = 1, turns by 90° about z: frame 0 at rest, frame 10 turned.
POINTS = [(0, 0, 0), (0, 0, 1), (1, 0, 0), (1, 0, 1), (2, 0, 0), (2, 0, 1)]
STRIP = """def SkelRoot "Root" {
    %(root)s
    def Skeleton "Skel" (prepend apiSchemas = ["SkelBindingAPI"]) {
        uniform token[] joints = ["a", "a/b"]
        uniform matrix4d[] bindTransforms = [((1,0,0,0),(0,1,0,0),(0,0,1,0),(0,0,0,1)),
            ((1,0,0,0),(0,1,0,0),(0,0,1,0),(1,0,0,1))]
        uniform matrix4d[] restTransforms = [((1,0,0,0),(0,1,0,0),(0,0,1,0),(0,0,0,1)),
            ((1,0,0,0),(0,1,0,0),(0,0,1,0),(1,0,0,1))]
        %(animation)s
    }
    def SkelAnimation "Turn" {
        uniform token[] joints = ["a", "a/b"]
        float3[] translations = [(0, 0, 0), (1, 0, 0)]
        quatf[] rotations.timeSamples = { 0: [(1, 0, 0, 0), (1, 0, 0, 0)],
            10: [(1, 0, 0, 0), (0.70710678, 0, 0, 0.70710678)] }
        half3[] scales = [(1, 1, 1), (1, 1, 1)]
        uniform token[] blendShapes = ["up"]
        float[] blendShapeWeights.timeSamples = { 0: [0], 10: [%(weight)s] }
    }
    def SkelAnimation "Still" {
        uniform token[] joints = ["a", "a/b"]
        float3[] translations = [(0, 0, 0), (1, 0, 0)]
        quatf[] rotations = [(1, 0, 0, 0), (1, 0, 0, 0)]
        half3[] scales = [(1, 1, 1), (1, 1, 1)]
    }
    def Mesh "M" (prepend apiSchemas = ["SkelBindingAPI"]) {
        point3f[] points = [(0,0,0), (0,0,1), (1,0,0), (1,0,1), (2,0,0), (2,0,1)]
        int[] faceVertexCounts = [4, 4]
        int[] faceVertexIndices = [0, 1, 3, 2, 2, 3, 5, 4]
        uniform token subdivisionScheme = "none"
        %(normals)s
        rel skel:skeleton = </Root/Skel>
        int[] primvars:skel:jointIndices = %(indices)s
        float[] primvars:skel:jointWeights = %(weights)s
        %(mesh)s
    }
}"""
ANIMATED = "rel skel:animationSource = </Root/Turn>"
SIX = '[0, 0, 0, 0, 1, 1] (elementSize = 1\n interpolation = "vertex")'
ONES = '[1, 1, 1, 1, 1, 1] (elementSize = 1\n interpolation = "vertex")'
REST = np.array(POINTS, dtype=float)
TURNED = np.array([(0, 0, 0), (0, 0, 1), (1, 0, 0), (1, 0, 1), (1, 1, 0), (1, 1, 1)], dtype=float)


def strip(**parts):
    given = dict(root="", animation=ANIMATED, weight=0, normals="", indices=SIX, weights=ONES, mesh="")
    return STRIP % (given | parts)


def test_a_bone_turns_its_points(tmp_path):
    """The second half of the strip stands up at frame 10, is at rest at 0, and half-way at 5: 45°."""
    assert load(tmp_path, strip(), time=0.0).meshes[0].points == pytest.approx(REST)
    mesh = load(tmp_path, strip(), time=10.0).meshes[0]
    assert mesh.points == pytest.approx(TURNED, abs=1e-6)
    half = load(tmp_path, strip(), time=5.0).meshes[0].points
    assert half[4] == pytest.approx([1 + np.sqrt(0.5), np.sqrt(0.5), 0], abs=1e-6)


def test_weights_blend_linearly(tmp_path):
    """A point between two bones is the weighted mean of where each would put it, whatever the weights add up to."""
    weights = "[1, 0, 1, 0, 1, 0, 1, 0, 0.5, 0.5, 0.25, 0.5]"
    indices = "[0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1]"
    more = '(elementSize = 2\n interpolation = "vertex")'
    scene = load(tmp_path, strip(indices=indices + more, weights=weights + more), time=10.0)
    points = scene.meshes[0].points
    assert points[4] == pytest.approx(0.5 * np.array([2, 0, 0]) + 0.5 * np.array([1, 1, 0]), abs=1e-6)
    stage = Usd.Stage.Open(str(tmp_path / "stage.usda"))
    cache, root = UsdSkel.Cache(), UsdSkel.Root(stage.GetPrimAtPath("/Root"))
    cache.Populate(root, Usd.PrimDefaultPredicate)
    prim = stage.GetPrimAtPath("/Root/M")
    joints = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/Root/Skel"))).ComputeSkinningTransforms(10.0)
    expected = UsdGeom.Mesh(prim).GetPointsAttr().Get()
    assert cache.GetSkinningQuery(prim).ComputeSkinnedPoints(joints, expected, 10.0)
    assert points == pytest.approx(np.array(expected, dtype=float), abs=1e-6)


@pytest.mark.parametrize("method", ["classicLinear", "dualQuaternion"])
def test_normals_turn_with_the_bones(tmp_path, method):
    """A normal at 45° to the surface stays so; a bone that turns by 90° turns it by 90°."""
    normals = f"""normal3f[] normals = {[(0, -1, 1)] * 6}
        uniform token primvars:skel:skinningMethod = "{method}" """
    mesh = load(tmp_path, strip(normals=normals), time=10.0).meshes[0]
    assert mesh.points == pytest.approx(TURNED, abs=1e-6)
    rest, turned = np.array([0, -1, 1]) / np.sqrt(2), np.array([1, 0, 1]) / np.sqrt(2)
    bent = mesh.triangles >= 4
    assert mesh.normals[bent] == pytest.approx(np.tile(turned, (bent.sum(), 1)), abs=1e-6)
    assert mesh.normals[~bent] == pytest.approx(np.tile(rest, ((~bent).sum(), 1)), abs=1e-6)


def test_one_bone_for_all_moves_the_mesh_rigidly(tmp_path):
    """Constant influences: the mesh as a whole goes with its bone."""
    constant = '(elementSize = 1\n interpolation = "constant")'
    mesh = load(tmp_path, strip(indices="[1]" + constant, weights="[1]" + constant), time=10.0).meshes[0]
    x, y, z = REST.T
    assert mesh.points == pytest.approx(np.stack([1 - y, x - 1, z], axis=1), abs=1e-6)


def test_the_spaces_of_mesh_skeleton_and_binding(tmp_path):
    """The binding's transform comes first; the mesh's own transform does not count, its skeleton's does."""
    bind = "matrix4d primvars:skel:geomBindTransform = ((1,0,0,0),(0,1,0,0),(0,0,1,0),(0,3,0,1))"
    move = 'double3 xformOp:translate = (5, 0, 0)\n uniform token[] xformOpOrder = ["xformOp:translate"]'
    mesh = load(tmp_path, strip(mesh=f"{bind}\n{move}"), time=0.0).meshes[0]
    assert mesh.points == pytest.approx(REST + np.array([0, 3, 0]), abs=1e-6)
    raised = load(tmp_path, strip(root=move), time=10.0).meshes[0]
    assert raised.points == pytest.approx(TURNED + np.array([5, 0, 0]), abs=1e-6)


BLEND = """uniform token[] skel:blendShapes = ["up"]
        rel skel:blendShapeTargets = </Root/M/Up>
        def BlendShape "Up" {
            uniform vector3f[] offsets = [(0, 4, 0), (0, 4, 0)]
            uniform vector3f[] normalOffsets = [(0, 0, 1), (0, 0, 1)]
            uniform int[] pointIndices = [0, 1]
            uniform vector3f[] inbetweens:half = [(0, 1, 0), (0, 1, 0)] (weight = 0.5)
        }"""


@pytest.mark.parametrize(("weight", "height"), [(0, 0.0), (1, 4.0), (0.5, 1.0), (0.75, 2.5)])
def test_blend_shapes_and_their_inbetweens(tmp_path, weight, height):
    """Offsets come at full weight, the inbetween's at its own; between them linearly. The skeleton comes after."""
    mesh = load(tmp_path, strip(mesh=BLEND, weight=weight), time=10.0).meshes[0]
    expected = TURNED.copy()
    expected[:2, 1] += height
    assert mesh.points == pytest.approx(expected, abs=1e-6)


def test_blend_shapes_move_normals(tmp_path):
    """NormalOffsets are added before the skeleton turns the normals."""
    normals = f"normal3f[] normals = {[(0, -1, 0)] * 6}"
    mesh = load(tmp_path, strip(mesh=BLEND, weight=1, normals=normals), time=10.0).meshes[0]
    moved = mesh.triangles < 2
    expected = np.array([0, -1, 1]) / np.sqrt(2)
    assert mesh.normals[moved] == pytest.approx(np.tile(expected, (moved.sum(), 1)), abs=1e-6)


@pytest.mark.parametrize("method", ["classicLinear", "dualQuaternion"])
@pytest.mark.parametrize(
    ("joints", "indices"),
    [
        (["a/b", "a"], [1, 1, 1, 1, 0, 0]),
        (["a/b", "none", "a"], [2, 2, 2, 2, 0, 0]),
        (["none", "a/b"], [0, 0, 0, 0, 1, 1]),
    ],
)
def test_a_mesh_can_number_the_joints_itself(tmp_path, joints, indices, method):
    """Indices refer to the mesh's skel:joints: in another order, fewer, or with one that the skeleton lacks (identity).

    USD's own skinning is the referee; the order of the joints in the skeleton must not matter.
    """
    order = f"uniform token[] skel:joints = {joints}".replace("'", '"')
    order += f'\n uniform token primvars:skel:skinningMethod = "{method}"'
    text = strip(mesh=order, indices=f'{indices} (elementSize = 1\n interpolation = "vertex")')
    scene = load(tmp_path, text, time=10.0)
    assert scene.meshes[0].points == pytest.approx(TURNED, abs=1e-6) and not warned(scene, "rest pose")
    stage = Usd.Stage.Open(str(tmp_path / "stage.usda"))
    cache, root = UsdSkel.Cache(), UsdSkel.Root(stage.GetPrimAtPath("/Root"))
    cache.Populate(root, Usd.PrimDefaultPredicate)
    prim = stage.GetPrimAtPath("/Root/M")
    skeleton = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/Root/Skel")))
    points = UsdGeom.Mesh(prim).GetPointsAttr().Get()
    transforms = skeleton.ComputeSkinningTransforms(10.0)
    assert cache.GetSkinningQuery(prim).ComputeSkinnedPoints(transforms, points, 10.0)
    assert scene.meshes[0].points == pytest.approx(np.array(points, dtype=float), abs=1e-6)


@pytest.mark.parametrize(("joints", "indices"), [([], [0] * 6), (["a/b"], [0, 0, 0, 0, 1, 1])])
def test_indices_beyond_the_joints_of_the_mesh(tmp_path, joints, indices):
    """The mesh's own list of joints is the one that an index must be in."""
    order = f"uniform token[] skel:joints = {joints}".replace("'", '"')
    text = strip(mesh=order, indices=f'{indices} (elementSize = 1\n interpolation = "vertex")')
    scene = load(tmp_path, text, time=10.0)
    assert warned(scene, "/Root/M", "rest pose")
    assert scene.meshes[0].points == pytest.approx(REST)


def test_a_mesh_and_an_animation_can_order_blend_shapes_differently(tmp_path):
    """Weights go to the shapes of their names; a shape that the animation does not name stays at 0."""
    two = BLEND.replace('["up"]', '["other", "up"]').replace("</Root/M/Up>", "[</Root/M/Other>, </Root/M/Up>]")
    other = 'def BlendShape "Other" {\n uniform vector3f[] offsets = [(9, 9, 9)]\n uniform int[] pointIndices = [3]\n}'
    expected = TURNED.copy()
    expected[:2, 1] += 4.0
    scene = load(tmp_path, strip(mesh=f"{two}\n{other}", weight=1), time=10.0)
    assert scene.meshes[0].points == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("weight", [1, 0.5])
def test_offsets_that_are_no_vectors_are_named(tmp_path, weight):
    """Normal offsets of another type, of a shape or of its inbetween: a warning, and the mesh at rest."""
    bad = "= [1, 2]\n"
    blend = BLEND.replace("vector3f[] normalOffsets = [(0, 0, 1), (0, 0, 1)]", f"int[] normalOffsets {bad}")
    blend = blend.replace("(weight = 0.5)", f"(weight = 0.5)\n uniform int[] inbetweens:half:normalOffsets {bad}")
    scene = load(tmp_path, strip(mesh=blend, weight=weight), time=10.0)
    assert warned(scene, "/Root/M", "ormalOffsets is a IntArray", "rest pose")
    assert scene.meshes[0].points == pytest.approx(REST)


def test_instances_share_a_pose_unless_their_animations_differ(tmp_path):
    """A rig inside a prototype is posed once; with an animation above each instance, each has its own pose."""
    rig = strip(animation="").replace('def SkelRoot "Root" {', 'over "Root" {\ndef SkelRoot "Rig" {') + "\n}"
    rig = rig.replace("</Root/", "</Root/Rig/")
    places = "".join(
        f"""
def Xform "{name}" (instanceable = true
    prepend references = </Root>
    prepend apiSchemas = ["SkelBindingAPI"]) {{
    rel skel:animationSource = </{name}/Rig/{animation}>
    double3 xformOp:translate = (0, 0, {5 * k})
    uniform token[] xformOpOrder = ["xformOp:translate"]
}}"""
        for k, (name, animation) in enumerate([("A", "Turn"), ("B", "Still"), ("C", "Turn")], start=1)
    )
    scene = load(tmp_path, rig + places, time=10.0)
    found = {m.name.split("/")[1]: m.points for m in scene.meshes}
    assert found["A"] == pytest.approx(TURNED + np.array([0, 0, 5]), abs=1e-6)
    assert found["C"] == pytest.approx(TURNED + np.array([0, 0, 15]), abs=1e-6)
    assert found["B"] == pytest.approx(REST + np.array([0, 0, 10]), abs=1e-6)


def test_refined_surfaces_are_posed_before_they_are_refined(tmp_path):
    """The cage is skinned, then subdivided: a rigid turn commutes with the rules."""
    constant = '(elementSize = 1\n interpolation = "constant")'
    text = strip(indices="[1]" + constant, weights="[1]" + constant).replace('"none"', '"catmullClark"')
    still, turned = (load(tmp_path, text, time=t, complexity="high").meshes[0] for t in (0.0, 10.0))
    x, y, z = still.points.T
    assert turned.points == pytest.approx(np.stack([1 - y, x - 1, z], axis=1), abs=1e-6)


def test_cages_are_smooth_in_their_pose(tmp_path):
    """The normals of a cage are computed from the posed points: at the bend they halve the right angle."""
    smooth = load(tmp_path, strip().replace('"none"', '"catmullClark"'), time=10.0).meshes[0]
    assert smooth.points == pytest.approx(TURNED, abs=1e-6)
    bend = smooth.normals[(smooth.triangles == 2) | (smooth.triangles == 3)]
    assert bend == pytest.approx(np.tile(np.array([-1, 1, 0]) / np.sqrt(2), (len(bend), 1)), abs=1e-6)


@pytest.mark.parametrize(
    ("parts", "word"),
    [
        (dict(indices=SIX.replace("1, 1]", "1, 7]")), "out of range"),
        (dict(indices=SIX.replace("0, 0, 0", "0, 0")), "do not fit"),
        (dict(weights=ONES.replace("[1,", "[nan,")), "NaN"),
        (dict(mesh=BLEND.replace("[0, 1]", "[0, 9]"), weight=1), "do not fit the points"),
        (dict(mesh=BLEND.replace("</Root/M/Up>", "</Root/M/Gone>"), weight=1), "does not exist"),
        (dict(mesh="matrix4d primvars:skel:geomBindTransform = ((nan,0,0,0),(0,1,0,0),(0,0,1,0),(0,3,0,1))"), "NaN"),
    ],
)
def test_a_bad_binding_leaves_the_rest_pose(tmp_path, parts, word):
    """What does not fit together is named, and the mesh is drawn as authored."""
    scene = load(tmp_path, strip(**parts), time=10.0)
    assert warned(scene, "/Root/M", word, "rest pose")
    assert scene.meshes[0].points == pytest.approx(REST)


@pytest.mark.parametrize(
    "breakage",
    [
        ('uniform token[] joints = ["a", "a/b"]\n        uniform matrix4d[] bind', "uniform matrix4d[] bind"),
        ("uniform matrix4d[] bindTransforms = [((1,0,0,0),(0,1,0,0),(0,0,1,0),(0,0,0,1)),",
         "uniform matrix4d[] bindTransforms = ["),
        ("rel skel:skeleton = </Root/Skel>", "rel skel:skeleton = </Root/Gone>"),
        ("rel skel:skeleton = </Root/Skel>", ""),
    ],
)  # fmt: skip
def test_a_bad_skeleton_leaves_the_rest_pose(tmp_path, breakage):
    """A skeleton without joints, with the wrong number of bind transforms, or none at all: a warning."""
    text = strip()
    assert breakage[0] in text
    scene = load(tmp_path, text.replace(*breakage), time=10.0)
    assert scene.meshes[0].points == pytest.approx(REST)
    assert warned(scene, "/Root/M", "rest pose")


def test_outside_of_a_skel_root_nothing_is_skinned(tmp_path):
    """UsdSkel deforms only what is below a SkelRoot."""
    scene = load(tmp_path, strip().replace("def SkelRoot", "def Xform"), time=10.0)
    assert scene.meshes[0].points == pytest.approx(REST)
    assert np.linalg.norm(area_vectors(scene.meshes[0]), axis=1).sum() == pytest.approx(2.0)


@pytest.mark.extended
@pytest.mark.parametrize(("name", "time"), [("CesiumMan", 10.0), ("RiggedSimple", 10.0), ("RiggedFigure", 0.0)])
def test_real_figures_are_where_usd_bakes_them(name, time):
    """BakeSkinning, on a layer of its own, puts the points where they are drawn (to its float32)."""
    file = real_file(f"usdwg_usdz/test_assets/USDZ/{name}/{name}.usdz")
    mesh = load_usd(file, time=time).meshes[0]
    stage = Usd.Stage.Open(str(file))
    stage.SetEditTarget(stage.GetSessionLayer())
    for prim in stage.Traverse():
        if prim.IsA(UsdSkel.Root):
            assert UsdSkel.BakeSkinning(UsdSkel.Root(prim), Gf.Interval(time, time))
    baked = UsdGeom.Mesh(stage.GetPrimAtPath(mesh.name))
    matrix = np.array(UsdGeom.XformCache(time).GetLocalToWorldTransform(baked.GetPrim()))
    points = np.array(baked.GetPointsAttr().Get(time), dtype=float) @ matrix[:3, :3] + matrix[3, :3]
    assert mesh.points == pytest.approx(points, abs=1e-6 * np.ptp(points))
