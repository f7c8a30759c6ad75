"""Native and point instancing: as if every instance had been written out."""

from pathlib import Path

import numpy as np
import pytest

from warp_ir import InputError, Scene, load_usd

TRIANGLE = """
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
        uniform token subdivisionScheme = "none"
"""


def load(folder: Path, text: str, **options: object) -> Scene:
    file = folder / "stage.usda"
    file.write_text("#usda 1.0\n" + text)
    return load_usd(file, **options)


def warned(scene: Scene, *words: str) -> bool:
    return any(all(word in line for word in words) for line in scene.warnings)


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


def test_a_scene_that_cannot_fit_is_refused_before_it_is_allocated(tmp_path):
    """Nested instancers that multiply to hundreds of millions are an input error."""
    many = f"int[] protoIndices = {[0] * 3000}\n point3f[] positions = {[(0, 0, 0)] * 3000}"
    inner = f"""def PointInstancer "Proto" {{
        rel prototypes = </P/Proto/S>
        {many}
        def Sphere "S" {{
        }}
    }}"""
    with pytest.raises(InputError, match="too many"):
        load(tmp_path, instancer(many, inner))
