"""Native and point instancing: as if every instance had been written out."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from tests.stages import TRIANGLE, load, warned
from warp_ir import InputError, Scene, load_usd
from warp_ir.image.io import write_image
from warp_ir.usd.load import StageReader


def corners(scene: Scene) -> np.ndarray:
    """The corners of all triangles, [m, 3, 3], in order of their first corner."""
    found = np.concatenate([mesh.points[mesh.triangles] for mesh in scene.meshes])
    return found[np.lexsort(found[:, 0].round(9).T)]


def instancer(arrays: str, prototypes: str = "", name: str = "P") -> str:
    prototypes = prototypes or f'def Mesh "Proto" {{{TRIANGLE}}}'
    return f"""
def PointInstancer "{name}" {{
    rel prototypes = </{name}/Proto>
    {arrays}
    {prototypes}
}}"""


def test_native_instances_equal_copies(tmp_path):
    """Instances of a referenced asset give the triangles, materials and lights of plain references."""
    asset = f"""
def Xform "Asset" {{
    double3 xformOp:translate = (0, 2, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Mesh "M" {{{TRIANGLE}
        color3f[] primvars:displayColor = [(1, 0, 0)]
    }}
    def SphereLight "L" {{
        double3 xformOp:translate = (3, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
}}"""
    places = "".join(
        f"""
def Xform "X{i}" {{
    double3 xformOp:translate = ({10 * i}, 0, 0)
    float3 xformOp:scale = ({1 - 2 * (i % 2)}, 1, 1)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
    def "I" (references = </Asset>
        instanceable = INSTANCEABLE) {{
    }}
}}"""
        for i in range(3)
    )
    copied = load(tmp_path, asset + places.replace("INSTANCEABLE", "false"))
    shared = load(tmp_path, asset + places.replace("INSTANCEABLE", "true"))
    assert shared.stats["native_instances"] == 3 and len(shared.lights) == 4
    assert (corners(copied) == corners(shared)).all() and copied.materials == shared.materials
    assert [light.name for light in copied.lights] == [light.name for light in shared.lights]
    for a, b in zip(copied.lights, shared.lights, strict=True):
        assert (a.world_from_light == b.world_from_light).all()


def test_what_is_authored_above_an_instance_is_resolved_per_instance(tmp_path):
    """Instances of one prototype can differ in inherited colour, purpose and visibility."""
    text = f'class "A" {{ def Mesh "M" {{{TRIANGLE}}}\n}}\n'
    for name, more in (
        ("R", "color3f[] primvars:displayColor = [(1, 0, 0)]"),
        ("G", "color3f[] primvars:displayColor = [(0, 1, 0)]"),
        ("Proxy", 'uniform token purpose = "proxy"'),
        ("Hidden", 'token visibility = "invisible"'),
    ):
        text += f'def Xform "{name}" {{ {more}\n def Xform "I" (inherits = </A>\n instanceable = true) {{\n}}\n}}\n'
    scene = load(tmp_path, text)
    assert [mesh.name for mesh in scene.meshes] == ["/R/I/M", "/G/I/M"]
    assert [material.albedo for material in scene.materials] == [(1, 0, 0), (0, 1, 0)]


def test_point_instances_equal_matrices(tmp_path):
    """An instance is the prototype's transform, then scale, rotation, translation, then the instancer's."""
    half = np.sqrt(0.5)
    prototype = f"""def Mesh "Proto" {{{TRIANGLE}
        double3 xformOp:translate = (0, 0, 1)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}"""
    scene = load(
        tmp_path,
        instancer(
            f"""
    int[] protoIndices = [0, 0]
    point3f[] positions = [(0, 0, 0), (5, 0, 0)]
    quatf[] orientationsf = [(1, 0, 0, 0), ({half}, 0, 0, {half})]
    float3[] scales = [(1, 1, 1), (2, -3, 1)]
    double3 xformOp:translate = (0, 100, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]""",
            prototype,
        ),
    )
    # The second: (x, y, z) -> z + 1 -> (2x, -3y, z) -> a quarter turn about z (3y, 2x, z) -> + (5, 100, 0);
    # mirrored, so its winding is turned round.
    assert scene.meshes[0].points[scene.meshes[0].triangles] == pytest.approx(
        np.array(
            [
                [[0, 100, 1], [1, 100, 1], [0, 101, 1]],
                [[8, 100, 1], [5, 102, 1], [5, 100, 1]],
            ]
        ),
        abs=1e-6,
    )
    assert scene.stats["point_instances"] == 2 and len(scene.meshes) == 1


def test_half_precision_orientations_are_read(tmp_path):
    """Without orientationsf the quath array counts."""
    scene = load(
        tmp_path,
        instancer("""int[] protoIndices = [0]
    point3f[] positions = [(0, 0, 0)]
    quath[] orientations = [(0, 0, 0, 1)]"""),
    )
    assert corners(scene)[0, 1] == pytest.approx([-1, 0, 0], abs=1e-6)


@pytest.mark.parametrize(("ids", "hidden", "left"), [("", [0, 2], [1]), ("int64[] ids = [7, 8, 9]", [8], [0, 2])])
@pytest.mark.parametrize("how", ["invisibleIds", "inactiveIds"])
def test_masked_instances_are_not_drawn(tmp_path, ids, hidden, left, how):
    """Invisible and inactive instances are known by id, or by index if there are no ids."""
    text = instancer(f"""int[] protoIndices = [0, 0, 0]
    point3f[] positions = [(0, 0, 0), (1, 0, 0), (2, 0, 0)]
    {ids}
    {f"int64[] invisibleIds = {hidden}" if how == "invisibleIds" else ""}""")
    if how == "inactiveIds":
        text = text.replace('"P" {', f'"P" (inactiveIds = {hidden}) {{')
    assert corners(load(tmp_path, text))[:, 0, 0].tolist() == left


def test_prototypes_are_drawn_by_themselves_only_elsewhere(tmp_path):
    """A prototype outside its instancer is a prim like others; below an `over` or `class` it is not."""
    arrays = "int[] protoIndices = [0]\n    point3f[] positions = [(10, 0, 0)]"
    for keyword, count in (("def", 2), ("over", 1), ("class", 1)):
        text = f'{keyword} "Q" {{ def Mesh "Proto" {{{TRIANGLE}}}\n}}' + instancer(arrays, 'def Scope "Other" {\n}')
        assert len(load(tmp_path, text.replace("</P/Proto>", "</Q/Proto>")).meshes) == count


def test_instancers_nest(tmp_path):
    """An instancer as prototype of another multiplies."""
    inner = f"""def PointInstancer "Proto" {{
        rel prototypes = </P/Proto/M>
        int[] protoIndices = [0, 0]
        point3f[] positions = [(0, 0, 0), (1, 0, 0)]
        def Mesh "M" {{{TRIANGLE}}}
    }}"""
    scene = load(
        tmp_path, instancer("int[] protoIndices = [0, 0]\n point3f[] positions = [(0, 0, 0), (10, 0, 0)]", inner)
    )
    assert corners(scene)[:, 0, 0].tolist() == [0, 1, 10, 11]


def moved(x: float, y: float, z: float, reset: str = "") -> str:
    """Transform ops: a translation, a rotation and a scale; `reset` goes before them."""
    return f"""double3 xformOp:translate = ({x}, {y}, {z})
    float xformOp:rotateZ = 30
    double3 xformOp:scale = (2, 1, 1)
    uniform token[] xformOpOrder = [{reset}"xformOp:translate", "xformOp:rotateZ", "xformOp:scale"]"""


RESET = '"!resetXformStack!", '
RESETTING = {
    "prototype": f'def Mesh "Proto" {{{TRIANGLE} {moved(0, 1, 0, RESET)}\n}}\n',
    "child": f"""def Xform "Proto" {{
        {moved(9, 0, 0)}
        def Mesh "M" {{{TRIANGLE} {moved(0, 1, 0, RESET)}
        }}
    }}""",
    "grandchild": f"""def Xform "Proto" {{
        {moved(9, 0, 0, RESET)}
        def Xform "X" {{
            {moved(0, 0, 3)}
            def Mesh "M" {{{TRIANGLE} {moved(0, 1, 0, RESET)}
            }}
        }}
    }}""",
    "native instance": f"""def Xform "Proto" {{
        {moved(9, 0, 0)}
        def "I" (
            instanceable = true
            references = </Asset>
        ) {{
        }}
    }}""",
    "in an instancer": f"""def Xform "Proto" {{
        {moved(9, 0, 0)}
        def PointInstancer "Q" {{
            {moved(0, 1, 0, RESET)}
            rel prototypes = </P/Proto/Q/R>
            int[] protoIndices = [0, 0]
            point3f[] positions = [(0, 0, 0), (0, 0, 1)]
            def Xform "R" {{
                {moved(0, 3, 0)}
                def Mesh "M" {{{TRIANGLE} {moved(0, 1, 2, RESET)}
                }}
            }}
        }}
    }}""",
}


def instance_matrices(stage: Usd.Stage, path: str) -> list[np.ndarray]:
    """The transforms (row vectors) that an instancer gives to where the stage has the prims of its prototype."""
    cache, prim = UsdGeom.XformCache(), stage.GetPrimAtPath(path)
    now = Usd.TimeCode.Default()
    prototype = stage.GetPrimAtPath(UsdGeom.PointInstancer(prim).GetPrototypesRel().GetTargets()[0])
    instances = UsdGeom.PointInstancer(prim).ComputeInstanceTransformsAtTime(now, now)
    to_prototype = np.linalg.inv(np.array(cache.GetLocalToWorldTransform(prototype)))
    return [to_prototype @ np.array(m) @ np.array(cache.GetLocalToWorldTransform(prim)) for m in instances]


@pytest.mark.parametrize("which", RESETTING)
def test_resetting_the_transform_stack_keeps_all_instances(tmp_path, which):
    """Instances move a prim from where the stage has it, by XformCache and ComputeInstanceTransformsAtTime."""
    arrays = """int[] protoIndices = [0, 0, 0]
    point3f[] positions = [(-2, 0, 0), (0, 0, 0), (2, 0, 0)]
    quath[] orientations = [(1, 0, 0, 0), (0, 1, 0, 0), (0.5, 0.5, 0.5, 0.5)]
    float3[] scales = [(1, 1, 1), (1, 2, 1), (3, 1, 1)]
    """
    asset = f"""class Xform "Asset" {{
    {moved(5, 0, 0, RESET)}
    def Mesh "M" {{{TRIANGLE} {moved(0, 0, 1)}
    }}
}}"""
    scene = load(tmp_path, instancer(arrays + moved(0, 7, 4), RESETTING[which]) + "\n" + asset)
    stage = Usd.Stage.Open(str(tmp_path / "stage.usda"))
    everything = Usd.PrimRange(stage.GetPrimAtPath("/P"), Usd.TraverseInstanceProxies())
    (mesh,) = (prim for prim in everything if prim.IsA(UsdGeom.Mesh))
    matrices = [np.array(UsdGeom.XformCache().GetLocalToWorldTransform(mesh))]
    for path in ("/P/Proto/Q", "/P") if which == "in an instancer" else ("/P",):
        matrices = [m @ instance for m in matrices for instance in instance_matrices(stage, path)]
    triangle = np.array([(0, 0, 0, 1), (1, 0, 0, 1), (0, 1, 0, 1)])
    expected = np.stack([triangle @ m for m in matrices])[..., :3]
    assert len(expected) == (6 if which == "in an instancer" else 3)
    np.testing.assert_allclose(corners(scene), expected[np.lexsort(expected[:, 0].round(9).T)], atol=1e-9)


def test_lights_that_reset_the_transform_stack_are_instanced(tmp_path):
    """So are lights: three of them, 2 apart, above the instances."""
    light = f"""def Xform "Proto" {{
        {moved(9, 0, 0)}
        def SphereLight "L" {{
            double3 xformOp:translate = (0, 1, 0)
            uniform token[] xformOpOrder = [{RESET}"xformOp:translate"]
        }}
    }}"""
    positions = "int[] protoIndices = [0, 0, 0]\n point3f[] positions = [(-2, 0, 0), (0, 0, 0), (2, 0, 0)]"
    lights = load(tmp_path, instancer(positions, light)).lights
    assert [light.world_from_light[:3, 3].tolist() for light in lights] == [[x, 1.0, 0.0] for x in (-2.0, 0.0, 2.0)]


def test_a_reset_below_a_flat_instancer_is_named(tmp_path):
    """Where the stage has the prim cannot be told relative to a parent whose transform is singular."""
    flat = """double3 xformOp:scale = (1, 0, 1)
    uniform token[] xformOpOrder = ["xformOp:scale"]
    int[] protoIndices = [0]
    point3f[] positions = [(0, 0, 0)]"""
    scene = load(tmp_path, instancer(flat, RESETTING["child"]))
    assert warned(scene, "/P/Proto/M", "resets", "/P cannot be inverted")


def test_a_prototype_that_contains_its_instancer_does_not_loop(tmp_path):
    """Recursion is cut and named."""
    scene = load(
        tmp_path,
        f"""def Xform "A" {{
    def Mesh "M" {{{TRIANGLE}}}
    def PointInstancer "P" {{
        rel prototypes = </A>
        int[] protoIndices = [0]
        point3f[] positions = [(1, 0, 0)]
    }}
}}""",
    )
    assert len(scene.meshes) == 1 and warned(scene, "/A/P", "contains the instancer itself")


def test_arrays_of_wrong_length_are_named_and_ignored(tmp_path):
    """Scales and orientations that do not match are ignored, not read from beyond their end."""
    scene = load(
        tmp_path,
        instancer("""int[] protoIndices = [0, 0]
    point3f[] positions = [(0, 0, 0), (1, 0, 0)]
    float3[] scales = [(7, 7, 7)]
    quatf[] orientationsf = [(0, 0, 0, 1), (0, 0, 0, 1), (0, 0, 0, 1)]
    int64[] ids = [3]"""),
    )
    assert corners(scene)[:, 1, 0].tolist() == [1, 2]
    assert all(warned(scene, "/P", name, "ignored") for name in ("scales", "orientationsf", "ids"))


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ("int[] protoIndices = [0, 0]\n point3f[] positions = [(0, 0, 0)]", "1 positions"),
        ("int[] protoIndices = [0]", "0 positions"),
        ("int[] protoIndices = [4]\n point3f[] positions = [(0, 0, 0)]", "prototypes that do not exist"),
        ("int[] protoIndices = [0]\n point3f[] positions = [(nan, 0, 0)]", "NaN"),
    ],
)
def test_unusable_instances_are_named(tmp_path, arrays, words):
    """Instances without a position or a prototype are left out, with the reason."""
    scene = load(tmp_path, instancer(arrays))
    assert scene.meshes == () and warned(scene, "/P", words)


def test_colors_per_instance(tmp_path):
    """A vertex displayColor of the instancer colours instances whose prototype has no colour of its own."""
    arrays = """int[] protoIndices = [0, 0]
    point3f[] positions = [(0, 0, 0), (1, 0, 0)]
    color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0)] (interpolation = "vertex")"""
    mesh = load(tmp_path, instancer(arrays)).meshes[0]
    assert mesh.colors.tolist() == [[[1, 0, 0]] * 3, [[0, 1, 0]] * 3]
    own = f'def Mesh "Proto" {{{TRIANGLE} color3f[] primvars:displayColor = [(0, 0, 1)]\n}}'
    scene = load(tmp_path, instancer(arrays, own))
    assert scene.meshes[0].colors is None and scene.materials[0].albedo == (0, 0, 1)


@pytest.mark.parametrize(
    ("above", "of_instancer", "drawn"),
    [("", "", 1), ("", "proxy", 0), ("proxy", "", 0), ("render", "proxy", 1), ("proxy", "render", 0)],
)
def test_prototypes_inherit_purposes_where_they_lie(tmp_path, above, of_instancer, drawn):
    """A purpose above a prototype is its own, without one the instancer's counts; visibility above it does not."""
    above, of_instancer = (f'uniform token purpose = "{name}"' if name else "" for name in (above, of_instancer))
    text = f"""def Scope "Hidden" {{
    token visibility = "invisible"
    {above}
    def Mesh "M" {{{TRIANGLE}}}
}}
def PointInstancer "P" {{
    {of_instancer}
    rel prototypes = </Hidden/M>
    {TWO}
}}"""
    assert len(load(tmp_path, text).meshes) == drawn


def test_opacities_of_instances_are_named(tmp_path):
    """A displayOpacity per instance is not honoured, and said, unless it is 1 throughout."""
    arrays = "int[] protoIndices = [0, 0]\n point3f[] positions = [(0, 0, 0), (1, 0, 0)]\n"
    opacity = 'float[] primvars:displayOpacity = [1, {}] (interpolation = "varying")'
    assert warned(load(tmp_path, instancer(arrays + opacity.format(0.5))), "/P", "displayOpacity per instance")
    assert not warned(load(tmp_path, instancer(arrays + opacity.format(1))), "displayOpacity")


def test_a_scene_that_cannot_fit_is_refused_before_it_is_allocated(tmp_path):
    """Nested instancers that multiply to thousands of millions are an input error."""
    many = f"int[] protoIndices = {[0] * 3000}\n point3f[] positions = {[(0, 0, 0)] * 3000}"
    path, inner = "/P/Proto/Proto/Proto/S", 'def Sphere "S" {\n}'
    for _ in range(3):
        inner = f'def PointInstancer "Proto" {{\n rel prototypes = <{path}>\n {many}\n {inner}\n}}'
        path = path.rpartition("/")[0]
    with pytest.raises(InputError, match="too many"):
        load(tmp_path, instancer(many, inner))


@pytest.fixture
def shared(monkeypatch):
    """All prototypes in more than one place are stored once, however small they are."""
    monkeypatch.setattr("warp_ir.usd.geometry.prototypes.MAX_FLATTENED_TRIANGLES", 0)


MOVED = 'double3 xformOp:translate = ({}, {}, {})\n uniform token[] xformOpOrder = ["xformOp:translate"]\n'
CUBE = 'def Cube "{}" {{\n {}\n }}'
TWO = "int[] protoIndices = [0, 0]\n point3f[] positions = [(0, 0, 0), (10, 0, 0)]"


def reader(name: str, kind: str = "float3", varname: str = "tint") -> str:
    """A material whose albedo is a primvar, (0.5, 0.5, 0.5) where there is none."""
    grey = "(0.5, 0.5, 0.5)" if kind == "float3" else "0.5"
    return f"""def Material "{name}" {{
    token outputs:surface.connect = </{name}/S.outputs:surface>
    def Shader "S" {{
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor.connect = </{name}/R.outputs:result>
        token outputs:surface
    }}
    def Shader "R" {{
        uniform token info:id = "UsdPrimvarReader_{kind}"
        string inputs:varname = "{varname}"
        {kind} inputs:fallback = {grey}
        {kind} outputs:result
    }}
}}
"""


BOUND = 'def Cube "{}" (prepend apiSchemas = ["MaterialBindingAPI"]) {{\n rel material:binding = </{}>\n {}\n }}'
TINTS = 'color3f[] primvars:tint = [(1, 0, 0), (0, 1, 0)] (interpolation = "varying")'
STAGES = {
    "primvar that a material reads": reader("Look")
    + instancer(
        TWO + f"\n {TINTS}",
        f"""def Xform "Proto" {{
            {BOUND.format("A", "Look", "")}
            {BOUND.format("B", "Look", "color3f[] primvars:tint = [(0, 0, 1)]")}
            {CUBE.format("C", "")}
            def PointInstancer "Q" {{ rel prototypes = </P/Proto/Q/D>\n {TWO}
                {BOUND.format("D", "Look", "")}
            }}
        }}""",
    ),
    "point": instancer(
        "int[] protoIndices = [0, 0, 0]\n point3f[] positions = [(0, 0, 0), (5, 0, 0), (0, 7, 0)]\n"
        "quatf[] orientationsf = [(1, 0, 0, 0), (0.6, 0, 0.8, 0), (0.8, 0.6, 0, 0)]\n"
        "float3[] scales = [(1, 1, 1), (2, -3, 1), (0.5, 1, 2)]"
    ),
    "colored": instancer(
        TWO + '\n color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0)] (interpolation = "vertex")',
        f"""def Xform "Proto" {{
            {CUBE.format("A", "")}
            {CUBE.format("B", "color3f[] primvars:displayColor = [(0, 0, 1)]")}
        }}""",
    ),
    "masked": instancer(
        "int[] protoIndices = [0, 0, 0, 0]\n point3f[] positions = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)]\n"
        "int64[] ids = [7, 8, 9, 10]\n int64[] invisibleIds = [8]"
    ),
    "collapsed": instancer(
        "int[] protoIndices = [0, 0, 0]\n point3f[] positions = [(0, 0, 0), (5, 0, 0), (9, 0, 0)]\n"
        "float3[] scales = [(1, 1, 1), (1, 1, 0), (0, 0, 0)]",
        CUBE.format("Proto", ""),
    ),
    "nested": instancer(
        TWO + '\n color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0)] (interpolation = "vertex")',
        f"""def PointInstancer "Proto" {{
            {MOVED.format(0, 0, 5)}
            rel prototypes = </P/Proto/M>
            int[] protoIndices = [0, 0]
            point3f[] positions = [(0, 0, 0), (3, 0, 0)]
            {CUBE.format("M", MOVED.format(0, 1, 0))}
        }}""",
    ),
    "native in point": f'class "N" {{ {CUBE.format("C", "")}\n }}\n'
    + instancer(
        TWO,
        f"""def Xform "Proto" {{
            {MOVED.format(0, 0, 10)}
            def Xform "I" (inherits = </N>
                instanceable = true) {{ {MOVED.format(0, 4, 0)} }}
            def Xform "J" (inherits = </N>
                instanceable = true) {{ {MOVED.format(0, 8, 0)} }}
        }}""",
    ),
    "point in native": f'class "N" {{ def PointInstancer "P" {{ rel prototypes = </N/P/C>\n {TWO}\n'
    f"{CUBE.format('C', '')}\n }}\n }}\n"
    + "".join(
        f'def Xform "I{k}" (inherits = </N>\n instanceable = true) {{ {MOVED.format(0, 5 * k, 0)} }}\n'
        for k in range(3)
    ),
    "native, colored above": f'class "N" {{ {CUBE.format("C", "")}\n }}\n'
    + "".join(
        f'def Xform "X{k}" {{ color3f[] primvars:displayColor = [({k % 2}, 1, 0)]\n'
        f'def Xform "I" (inherits = </N>\n instanceable = true) {{ {MOVED.format(0, 5 * k, 0)} }}\n }}\n'
        for k in range(5)
    ),
    "emissive": instancer(
        TWO,
        'def Cube "Proto" (prepend apiSchemas = ["MeshLightAPI"]) {\n float inputs:intensity = 3\n }',
    ),
}


def surfaces(scene: Scene) -> np.ndarray:
    """Corners, albedo and emission of all triangles, [m, 15], sorted."""
    rows = []
    for mesh in scene.meshes:
        albedo = np.array([m.albedo for m in scene.materials])[mesh.material]
        if mesh.colors is not None:
            albedo = mesh.colors.mean(axis=1)
        emission = np.array([m.emission for m in scene.materials])[mesh.material]
        rows.append(np.concatenate([mesh.points[mesh.triangles].reshape(-1, 9), albedo, emission], axis=1))
    found = np.concatenate(rows)
    return found[np.lexsort(found.round(6).T)]


@pytest.mark.parametrize("name", STAGES)
def test_stored_once_is_the_same_as_written_out(tmp_path, name, monkeypatch):
    """Every triangle of every instance has the place, the colour and the light it has when all is written out."""
    flat = load(tmp_path, STAGES[name])
    monkeypatch.setattr("warp_ir.usd.geometry.prototypes.MAX_FLATTENED_TRIANGLES", 0)
    scene = load(tmp_path, STAGES[name])
    assert flat.instances == () and bool(scene.instances) == (name != "emissive")
    np.testing.assert_allclose(surfaces(scene.flat()), surfaces(flat), atol=1e-12)
    np.testing.assert_allclose(scene.bounds(), flat.bounds(), atol=1e-12)
    assert scene.warnings == flat.warnings and scene.materials == flat.materials
    assert scene.stats["triangles_seen"] == flat.stats["triangles"]
    assert scene.stats["prototype_places"] == sum(len(group.matrices) for group in scene.instances)


@pytest.mark.parametrize(
    ("kind", "primvar", "albedo"),
    [
        ("float3", TINTS, [(1, 0, 0), (0, 1, 0)]),
        ("float3", "float3[] primvars:tint = [(0, 0, 1)]\nint[] primvars:tint:indices = [0, 0]", None),
        ("float3", 'color3f[] primvars:tint = [(0, 0, 2)] (interpolation = "constant")', [(0, 0, 1)] * 2),
        ("float", 'float[] primvars:tint = [0.25, 0.75] (interpolation = "vertex")', [(0.25,) * 3, (0.75,) * 3]),
        ("float3", 'color3f[] primvars:tint = [(1, 0, 0)] (interpolation = "vertex")', None),
    ],
)
def test_materials_read_primvars_of_instances(tmp_path, kind, primvar, albedo):
    """A primvar of the instancer that the prototype lacks is each instance's own; with wrong counts it is named."""
    text = reader("Look", kind) + BOUND.format("C", "Look", "")
    text += f'\ndef PointInstancer "P" {{\n rel prototypes = </C>\n {TWO}\n {primvar}\n}}'
    scene = load(tmp_path, text)
    copies = next(mesh for mesh in scene.meshes if len(mesh.triangles) == 24)
    if albedo is None:
        assert copies.colors is None and warned(scene, "/P", "tint: not one finite")
    else:
        assert copies.colors[::12, 0].tolist() == [list(color) for color in albedo]
        assert not warned(scene, "/P")


def test_emission_by_primvars_of_instances_is_named(tmp_path):
    """Emission that each instance should have of its own is that of the fallback, and said; not where none is given."""
    glow = reader("Look").replace("diffuseColor", "emissiveColor") + BOUND.format("C", "Look", "")
    for primvar, said in ((TINTS, True), ("", False)):
        text = glow + f'\ndef PointInstancer "P" {{\n rel prototypes = </C>\n {TWO}\n {primvar}\n}}'
        scene = load(tmp_path, text)
        assert bool(warned(scene, "/C", "primvar tint takes its fallback")) == said
        assert max(material.emission for material in scene.materials) == (0.5, 0.5, 0.5)


def test_a_color_of_the_whole_instancer_reaches_prototypes_elsewhere(tmp_path):
    """A constant displayColor of an instancer colours prototypes that do not inherit it, but not these themselves."""
    color = "color3f[] primvars:displayColor = [(1, 0, 0)]"
    text = f'def Cube "C" {{\n}}\ndef PointInstancer "P" {{\n rel prototypes = </C>\n {TWO}\n {color}\n}}'
    meshes = {len(mesh.triangles): mesh for mesh in load(tmp_path, text).meshes}
    assert meshes[24].colors.tolist() == [[[1, 0, 0]] * 3] * 24 and meshes[12].colors is None


UVS = ((0.1, 0.2), (0.3, 0.4), (0.5, 0.7))
TEXTURED = """
def Material "Look" {
    token outputs:surface.connect = </Look/S.outputs:surface>
    def Shader "S" {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor.connect = </Look/T.outputs:rgb>
        token outputs:surface
    }
    def Shader "T" {
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @a.png@
        float2 inputs:st.connect = </Look/R.outputs:result>
        float3 outputs:rgb
    }
    def Shader "R" {
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "st"
        float2 outputs:result
    }
}
""" + instancer(
    "int[] protoIndices = [0, 0, 0]\n point3f[] positions = [(0, 0, 0), (5, 0, 0), (0, 7, 0)]\n"
    "float3[] scales = [(1, 1, 1), (2, -3, 1), (1, 2, 0)]",
    f"""def Mesh "Proto" (prepend apiSchemas = ["MaterialBindingAPI"]) {{{TRIANGLE}
        rel material:binding = </Look>
        texCoord2f[] primvars:st = {list(UVS)} (interpolation = "vertex")
    }}""",
)


def test_texture_coordinates_stay_with_their_corners(tmp_path, monkeypatch):
    """In instances, in those written out, mirrored or flattened: what the prim's points have, their copies have."""
    write_image(tmp_path / "a.png", np.full((2, 2, 3), 0.5, np.float32))
    scenes = [load(tmp_path, TEXTURED)]
    monkeypatch.setattr("warp_ir.usd.geometry.prototypes.MAX_FLATTENED_TRIANGLES", 0)
    scenes.append(load(tmp_path, TEXTURED))
    assert len(scenes[1].instances[0].matrices) == 2 and scenes[1].stats["textures"] == 1
    for scene in (scenes[0], scenes[1].flat()):
        points = np.concatenate([mesh.points[mesh.triangles].reshape(-1, 3) for mesh in scene.meshes])
        uvs = np.concatenate([mesh.uvs["st"].reshape(-1, 2) for mesh in scene.meshes])
        assert len(points) == 9
        for x, y, width, height in ((0, 0, 1, 1), (5, 0, 2, -3), (0, 7, 1, 2)):
            for corner, uv in zip(((x, y, 0), (x + width, y, 0), (x, y + height, 0)), UVS, strict=True):
                (found,) = uvs[(points == corner).all(axis=1)]
                np.testing.assert_allclose(found, uv, atol=1e-6)


@pytest.mark.usefixtures("shared")
def test_instances_that_move_join_those_that_do_not(tmp_path):
    """At every moment all is where it is when written out; what stands still is read once."""
    moves = "point3f[] positions.timeSamples = { 1: [(0, 0, 0), (0, 3, 0)], 3: [(4, 0, 0), (0, 9, 0)] }"
    red = "color3f[] primvars:displayColor = [(1, 0, 0)]"
    text = (
        instancer("int[] protoIndices = [0, 0]\n" + moves, CUBE.format("Proto", red), "Q")
        + "\n"
        + STAGES["point"]
        + "\n"
        + CUBE.format("Alone", MOVED.format(0, 0, -9))
    )
    (tmp_path / "stage.usda").write_text("#usda 1.0\n" + text)
    reader = StageReader(tmp_path / "stage.usda")
    first, second = reader.read(1.0), reader.read(2.0)
    assert [len(scene.instances) for scene in (first, second)] == [2, 2]
    assert sum(a is b for a, b in zip(first.instances, second.instances, strict=True)) == 1
    for time, scene in ((1.0, first), (2.0, second)):
        alone = load(tmp_path, text, time=time)
        np.testing.assert_allclose(surfaces(scene.flat()), surfaces(alone.flat()), atol=1e-12)
        (group,) = [g for g in scene.instances if g.name.startswith("/Q/")]
        assert [scene.meshes[k].name for k in group.meshes] == ["/Q/Proto"]
        np.testing.assert_allclose(group.matrices[:, :2, 3], [(2 * time - 2, 0), (0, 3 * time)], atol=1e-12)
        assert scene.stats["prototypes"] == 2 and scene.stats["prototype_places"] == 5


@pytest.mark.usefixtures("shared")
def test_what_is_stored(tmp_path):
    """One mesh for each gprim of a prototype, whoever places it, and the places."""
    scene = load(tmp_path, STAGES["point in native"])
    assert len(scene.meshes) == 1 and len(scene.instances) == 1
    assert scene.instances[0].matrices[:, :3, 3].tolist() == [[0, y, 0] for y in (0, 5, 10)]
    assert len(scene.meshes[0].triangles) == 2 * 12  # two cubes take less than two places for each of three
    # Two colours above, five places: two looks of one geometry.
    scene = load(tmp_path, STAGES["native, colored above"])
    assert [len(group.matrices) for group in scene.instances] == [3, 2]
    assert np.shares_memory(scene.meshes[0].points, scene.meshes[1].points)


def test_large_prototypes_are_stored_once_and_small_ones_written_out(tmp_path):
    """A million triangles are written out, those that come in the smallest numbers first."""
    many = f"int[] protoIndices = {[0] * 500}\n point3f[] positions = {[(3 * k, 0, 0) for k in range(500)]}"
    text = instancer(many, CUBE.format("Proto", ""), "A") + instancer(many, 'def Sphere "Proto" {\n }', "B")
    scene = load(tmp_path, text)
    assert [mesh.name for mesh in scene.meshes] == ["/A/Proto", "/B/Proto"]
    assert len(scene.meshes[0].triangles) == 500 * 12 and scene.instances[0].meshes == (1,)
    assert scene.stats["prototypes"] == 1 and scene.stats["prototype_places"] == 500
    assert scene.stats["triangles"] == 6000 + len(scene.meshes[1].triangles)
    assert scene.stats["triangles_seen"] == 500 * (12 + len(scene.meshes[1].triangles))


def write_many(path: Path, count: int) -> None:
    """A stage with so many turned instances of a sphere, each of its own colour."""
    from pxr import Sdf, Usd, UsdGeom, Vt

    random = np.random.default_rng(0)
    stage = Usd.Stage.CreateNew(str(path))
    instances = UsdGeom.PointInstancer.Define(stage, "/P")
    UsdGeom.Sphere.Define(stage, "/P/Proto")
    instances.GetPrototypesRel().AddTarget("/P/Proto")
    instances.GetProtoIndicesAttr().Set(Vt.IntArray(count))
    positions = random.random((count, 3)) * [count**0.5, 4.0, count**0.5]
    instances.GetPositionsAttr().Set(Vt.Vec3fArray.FromNumpy(positions.astype(np.float32)))
    turns = random.normal(size=(count, 4)).astype(np.float32)
    instances.GetOrientationsfAttr().Set(Vt.QuatfArray.FromNumpy(turns))
    colors = UsdGeom.PrimvarsAPI(instances).CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, "vertex")
    colors.Set(Vt.Vec3fArray.FromNumpy(random.random((count, 3)).astype(np.float32)))
    stage.GetRootLayer().Save()


@pytest.mark.extended
def test_many_instances_take_the_memory_of_their_places(tmp_path):
    """A hundred thousand instances are an array of matrices and one of colours: 140 bytes each."""
    write_many(tmp_path / "many.usdc", 100_000)
    scene = load_usd(tmp_path / "many.usdc")
    (group,) = scene.instances
    assert group.matrices.nbytes + group.colors.nbytes == 140 * 100_000
    assert len(scene.meshes) == 1 and scene.triangles_seen == 100_000 * scene.triangle_count


@pytest.mark.slow
def test_a_million_instances_load_in_seconds(tmp_path):
    """Read, uploaded and ready for rays in less than a minute and 2 GB, slow machines included."""
    write_many(tmp_path / "many.usdc", 1_000_000)
    code = f"""
import resource, time
import warp_ir as ir
start = time.perf_counter()
scene = ir.load_usd({str(tmp_path / "many.usdc")!r})
from warp_ir.device_scene import upload_scene
from warp_ir.device.launcher import Launcher
upload_scene(scene, Launcher("cpu"))
print(time.perf_counter() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
"""
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    seconds, memory = (float(x) for x in out.split()[-2:])
    assert seconds < 60.0 and memory < 2.0e9, out


@pytest.mark.parametrize("time", [1.0, 1.75, 3.0, 4.5])
def test_velocities_carry_instances_between_samples(tmp_path, time):
    """Velocities, accelerations and angular velocities place instances as ComputeInstanceTransformsAtTime does."""
    text = "(\n    timeCodesPerSecond = 2\n    endTimeCode = 6\n)\n" + instancer("""
    int[] protoIndices = [0, 0]
    point3f[] positions.timeSamples = {
        1: [(0, 0, 0), (5, 0, 0)], 3: [(9, 9, 9), (5, 5, 5)], 5: [(0, 0, 0), (1, 1, 1)] }
    vector3f[] velocities.timeSamples = {
        1: [(1, 2, 0), (0, 0, 3)], 3: [(2, 0, 0), (0, 1, 0)], 5: [(0, 0, 0), (0, 0, 0)] }
    vector3f[] accelerations.timeSamples = {
        1: [(0, 0, 4), (1, 0, 0)], 3: [(1, 0, 0), (0, 0, 0)], 5: [(0, 0, 0), (0, 0, 0)] }
    quath[] orientations.timeSamples = {
        1: [(1, 0, 0, 0), (0.5, 0.5, 0.5, 0.5)], 3: [(0, 1, 0, 0), (1, 0, 0, 0)], 5: [(1, 0, 0, 0), (1, 0, 0, 0)] }
    vector3f[] angularVelocities.timeSamples = {
        1: [(0, 0, 90), (30, 0, 10)], 3: [(10, 20, 30), (0, 45, 0)], 5: [(0, 0, 0), (0, 0, 0)] }
    float3[] scales = [(1, 2, 3), (1, 1, 1)]
""")
    scene = load(tmp_path, text, time=time)
    np.testing.assert_allclose(corners(scene), by_usd(tmp_path, time), atol=2e-3)


CHANGING = """
    int[] protoIndices.timeSamples = { 1: [0, 0], 2: [0, 0] }
    point3f[] positions.timeSamples = { 1: [(0, 0, 0), (10, 0, 0)], 2: [(11, 0, 0), (0, 1, 0)] }
    float3[] scales.timeSamples = { 1: [(1, 1, 1), (4, 4, 4)], 2: [(4, 4, 4), (1, 1, 1)] }
    quath[] orientations.timeSamples = { 1: [(1, 0, 0, 0), (0, 0, 0, 1)], 2: [(0, 0, 0, 1), (1, 0, 0, 0)] }
    int64[] ids.timeSamples = { 1: [7, 8], 2: [8, 7] }
    color3f[] primvars:displayColor (
        interpolation = "vertex"
    )
    color3f[] primvars:displayColor.timeSamples = { 1: [(1, 0, 0), (0, 0, 1)], 2: [(0, 0, 1), (1, 0, 0)] }
"""
FLYING = "vector3f[] velocities.timeSamples = { 1: [(0, 24, 0), (24, 0, 0)], 2: [(24, 0, 0), (0, 24, 0)] }\n"
TURNING = "vector3f[] angularVelocities.timeSamples = { 1: [(0, 0, 0), (0, 0, 240)], 2: [(0, 0, 240), (0, 0, 0)] }\n"


@pytest.mark.parametrize("hidden", [7, 8, None])
@pytest.mark.parametrize("time", [1.0, 1.5, 1.75, 2.0, 2.5])
def test_instances_that_change_places_keep_what_is_theirs(tmp_path, time, hidden):
    """With velocities, all that an instance has comes from the sample that its position comes from.

    A red triangle of size 1 flies up, at 24 units per second and 24 time codes per second: one unit per time code; a
    blue one of size 4, turned by 180 degrees, flies to the right. They change places in the arrays at time 2.
    """
    invisible = "" if hidden is None else f"int64[] invisibleIds = [{hidden}]\n"
    text = "(\n    endTimeCode = 3\n)\n" + instancer(CHANGING + FLYING + invisible)
    (found,) = load(tmp_path, text, time=time).meshes
    where = {7: ((0.0, time - 1.0, 0.0), 1.0, (1, 0, 0)), 8: ((9.0 + time, 0.0, 0.0), -4.0, (0, 0, 1))}
    expected = [where[id] for id in where if id != hidden]
    if time >= 2.0:
        expected = expected[::-1]
    for k, (place, size, color) in enumerate(expected):
        points = found.points[found.triangles[k]]
        np.testing.assert_allclose(points, np.add(place, [(0, 0, 0), (size, 0, 0), (0, size, 0)]), atol=1e-6)
        np.testing.assert_allclose(found.colors[k], [color] * 3, atol=1e-6)


@pytest.mark.parametrize("rates", ["", FLYING, TURNING, FLYING + TURNING], ids=["none", "linear", "angular", "both"])
@pytest.mark.parametrize("time", [0.5, 1.0, 1.25, 2.0, 3.0])
def test_instances_move_between_samples_as_usd_says(tmp_path, rates, time):
    """ComputeInstanceTransformsAtTime agrees: nothing is interpolated if velocities of either kind apply."""
    text = "(\n    endTimeCode = 3\n)\n" + instancer(CHANGING + rates)
    # Orientations are interpolated in half precision: 2^-11 of an edge of length 4.
    np.testing.assert_allclose(corners(load(tmp_path, text, time=time)), by_usd(tmp_path, time), atol=2e-3)


def test_scales_with_fewer_samples_are_those_before(tmp_path):
    """At time 2, a sample of the positions but not of the scales, these are the ones of time 1."""
    text = instancer(CHANGING.replace("4, 4)], 2:", "4, 4)], 3:") + FLYING)
    assert "3: [(4, 4, 4)" in text
    np.testing.assert_allclose(corners(load(tmp_path, text, time=2.0)), by_usd(tmp_path, 2.0), atol=1e-5)


def by_usd(folder: Path, time: float) -> np.ndarray:
    """The `corners` of `stage.usda` by ComputeInstanceTransformsAtTime."""
    stage = Usd.Stage.Open(str(folder / "stage.usda"))
    places = UsdGeom.PointInstancer(stage.GetPrimAtPath("/P")).ComputeInstanceTransformsAtTime(time, time)
    triangle = np.array([(0, 0, 0, 1), (1, 0, 0, 1), (0, 1, 0, 1)])
    points = np.stack([triangle @ np.array(place) for place in places])[..., :3]
    return points[np.lexsort(points[:, 0].round(9).T)]


def test_bad_angular_velocities_are_named(tmp_path):
    """An array of another length turns nothing, and is named."""
    text = "(\n    endTimeCode = 6\n)\n" + instancer("""
    int[] protoIndices = [0]
    point3f[] positions = [(0, 0, 0)]
    quath[] orientations.timeSamples = { 1: [(1, 0, 0, 0)], 3: [(0, 1, 0, 0)] }
    vector3f[] angularVelocities.timeSamples = { 1: [(0, 0, 90), (1, 1, 1)], 3: [(10, 20, 30)] }
""")
    assert warned(load(tmp_path, text, time=2.0), "/P", "angularVelocities has 2 values")
