"""Mutated stages, and a process of its own that loads them: `python -m tests.fuzz FOLDER`.

A mutation is a function of a seed, so that what fails can be made again by its number alone.
"""

import resource
import sys
import time
import traceback
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdRender, UsdShade, UsdSkel, UsdUtils, Vt

SCENES = Path(__file__).resolve().parents[1] / "scenes_usd"
MEMORY = 8 << 30
"""Address space of the process that loads, in bytes: what needs more is out of bounds."""


def seeds(folder: Path) -> list[Path]:
    """The project's own scenes and a stage with one of everything, each as .usda, .usdc and .usdz; images beside."""
    folder.mkdir(exist_ok=True)
    images(folder)
    found = []
    stages = [*sorted(SCENES.glob("*.usda")), rich_stage(folder / "rich.usda")]
    for source in stages:
        if source.stat().st_size > 200_000:
            continue  # bigger, not more varied
        binary, package = folder / f"{source.stem}.usdc", folder / f"{source.stem}.usdz"
        Sdf.Layer.FindOrOpen(str(source)).Export(str(binary))
        UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(binary)), str(package))
        found += [source, binary, package]
    return found


def _paint(stage: Usd.Stage) -> UsdShade.Material:
    """A MaterialX surface: nodes that compute with a primvar, a normal map, scattering, a wide gamut."""
    material = UsdShade.Material.Define(stage, "/Looks/Paint")

    def node(name: str, kind: str, **inputs: object) -> UsdShade.ConnectableAPI:
        shader = UsdShade.Shader.Define(stage, f"/Looks/Paint/{name}")
        shader.CreateIdAttr(kind)
        for key, given in inputs.items():
            number = isinstance(given, float)
            made = shader.CreateInput(key, Sdf.ValueTypeNames.Float if number else Sdf.ValueTypeNames.Color3f)
            if isinstance(given, UsdShade.ConnectableAPI):
                made.ConnectToSource(given, "out")
            else:
                made.Set(given)
        return shader.ConnectableAPI()

    color = node("Read", "ND_geompropvalue_color3", default=Gf.Vec3f(0.5))
    color.GetPrim().CreateAttribute("inputs:geomprop", Sdf.ValueTypeNames.String).Set("displayColor")
    color.GetInput("default").GetAttr().SetColorSpace("lin_ap1_scene")
    mixed = node("Mix", "ND_mix_color3", fg=color, bg=Gf.Vec3f(0.25), mix=0.5)
    normal = {"in": Gf.Vec3f(0.75, 0.5, 1.0), "scale": 0.5}
    surface = node(
        "Surface",
        "ND_standard_surface_surfaceshader",
        base=0.75,
        base_color=mixed,
        subsurface=0.25,
        normal=node("Bumps", "ND_normalmap_float", **normal),
    )
    material.CreateSurfaceOutput("mtlx").ConnectToSource(surface, "surface")
    return material


def _rig(stage: Usd.Stage) -> None:
    """Two skinned meshes: joints and blend shapes in other orders, in-betweens, both methods, rigid and per point."""
    root = UsdSkel.Root.Define(stage, "/World/Rig")
    UsdSkel.BindingAPI.Apply(root.GetPrim())
    skeleton = UsdSkel.Skeleton.Define(stage, "/World/Rig/Bones")
    skeleton.CreateJointsAttr(["a", "a/b", "a/b/c"])
    skeleton.CreateBindTransformsAttr([Gf.Matrix4d(1.0)] * 3)
    skeleton.CreateRestTransformsAttr([Gf.Matrix4d(1.0)] * 3)
    animation = UsdSkel.Animation.Define(stage, "/World/Rig/Move")
    animation.CreateJointsAttr(["a/b", "a"])
    animation.CreateTranslationsAttr([(0, 0, 0), (1, 0, 0)])
    animation.CreateRotationsAttr([Gf.Quatf(1.0)] * 2)
    animation.CreateScalesAttr([Gf.Vec3h(1.0)] * 2)
    for code in (1.0, 2.0):
        animation.GetTranslationsAttr().Set([(code, 0, 0), (1, code, 0)], code)
    animation.CreateBlendShapesAttr(["up", "away"])
    animation.CreateBlendShapeWeightsAttr([0.5, 0.25])
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    for name, method, joints in (("Skin", "classicLinear", []), ("Hide", "dualQuaternion", ["a/b", "a/x", "a"])):
        skin = UsdGeom.Mesh.Define(stage, f"/World/Rig/{name}")
        skin.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)])
        skin.CreateFaceVertexCountsAttr([4])
        skin.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
        skin.CreateNormalsAttr([(0, 0, 1)] * 4)
        skin.CreateSubdivisionSchemeAttr("none")
        binding = UsdSkel.BindingAPI.Apply(skin.GetPrim())
        binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
        binding.CreateSkinningMethodAttr(method)
        binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1.0))
        if joints:
            binding.CreateJointsAttr(joints)
        rigid = name == "Hide"
        binding.CreateJointIndicesPrimvar(rigid, 2).Set([0, 1] * (1 if rigid else 4))
        binding.CreateJointWeightsPrimvar(rigid, 2).Set([0.5] * (2 if rigid else 8))
        binding.CreateBlendShapesAttr(["away", "up"])
        targets = []
        for shape_name in ("Away", "Up"):
            shape = UsdSkel.BlendShape.Define(stage, f"/World/Rig/{name}/{shape_name}")
            shape.CreateOffsetsAttr([(0, 0, 1)] * 2)
            shape.CreateNormalOffsetsAttr([(0, 1, 0)] * 2)
            shape.CreatePointIndicesAttr([0, 1])
            between = shape.CreateInbetween("half")
            between.SetWeight(0.5)
            between.SetOffsets([(0, 0, 0.25)] * 2)
            targets.append(shape.GetPath())
        binding.CreateBlendShapeTargetsRel().SetTargets(targets)


def rich_stage(path: Path) -> Path:
    """A stage with one of everything that is read: what a mutation of it breaks, some reader has to notice."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, "Y")
    stage.SetStartTimeCode(1.0)
    stage.SetEndTimeCode(4.0)
    material = UsdShade.Material.Define(stage, "/Looks/Glow")
    shader = UsdShade.Shader.Define(stage, "/Looks/Glow/Surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(0.5))
    shader.CreateInput("emissiveColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(1.0))
    shader.CreateInput("opacity", Sdf.ValueTypeNames.Float).Set(1.0)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    paint = _paint(stage)
    settings = UsdRender.Settings.Define(stage, "/Render")
    settings.CreateMaterialBindingPurposesAttr(["preview", "full", ""])
    settings.CreateRenderingColorSpaceAttr("lin_ap1_scene")
    for k, scheme in enumerate(("none", "catmullClark", "loop", "bilinear")):
        mesh = UsdGeom.Mesh.Define(stage, f"/World/Mesh{k}")
        mesh.CreatePointsAttr([(x, y, 0.1 * x * y) for x in range(4) for y in range(4)])
        mesh.CreateFaceVertexCountsAttr([4] * 9)
        mesh.CreateFaceVertexIndicesAttr([4 * x + y + o for x in range(3) for y in range(3) for o in (0, 4, 5, 1)])
        mesh.CreateSubdivisionSchemeAttr(scheme)
        mesh.CreateHoleIndicesAttr([8])
        mesh.CreateCreaseIndicesAttr([0, 4, 8])
        mesh.CreateCreaseLengthsAttr([3])
        mesh.CreateCreaseSharpnessesAttr([2.5])
        mesh.CreateCornerIndicesAttr([5])
        mesh.CreateCornerSharpnessesAttr([1.5])
        mesh.CreateNormalsAttr([(0, 0.1, 1)] * 16)
        mesh.CreateVelocitiesAttr([(0, 0, 1)] * 16)
        api = UsdGeom.PrimvarsAPI(mesh)
        color = api.CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, "faceVarying")
        color.Set([(0.1 * i, 0.5, 0.5) for i in range(4)])
        color.SetIndices([i % 4 for i in range(36)])
        uv = api.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "vertex")
        uv.Set([(x / 3, y / 3) for x in range(4) for y in range(4)])
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(paint, materialPurpose="preview")
        subset = UsdGeom.Subset.CreateGeomSubset(mesh, "Part", "face", [0, 1], "materialBind")
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material)
    tets = UsdGeom.TetMesh.Define(stage, "/World/Tets")
    tets.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)])
    tets.CreateTetVertexIndicesAttr([(0, 1, 2, 3)])
    for kind in ("Sphere", "Cube", "Cylinder", "Cone", "Capsule", "Plane"):
        getattr(UsdGeom, kind).Define(stage, f"/World/{kind}").AddTranslateOp().Set((3, 0, 0))
    prototype = UsdGeom.Xform.Define(stage, "/Prototype")
    UsdGeom.Cube.Define(stage, "/Prototype/Box")
    instance = stage.DefinePrim("/World/Instance", "Xform")
    instance.GetReferences().AddInternalReference(prototype.GetPath())
    instance.SetInstanceable(True)
    instancer = UsdGeom.PointInstancer.Define(stage, "/World/Many")
    instancer.CreatePrototypesRel().AddTarget(prototype.GetPath())
    instancer.CreateProtoIndicesAttr([0, 0, 0])
    instancer.CreatePositionsAttr([(0, 0, 0), (1, 0, 0), (2, 0, 0)])
    instancer.CreateOrientationsAttr([Gf.Quath(1, 0, 0, 0)] * 3)
    instancer.CreateScalesAttr([(1, 1, 1)] * 3)
    instancer.CreateIdsAttr([5, 6, 7])
    instancer.CreateInvisibleIdsAttr([6])
    for kind in ("RectLight", "DiskLight", "SphereLight", "CylinderLight", "DistantLight", "DomeLight"):
        light = getattr(UsdLux, kind).Define(stage, f"/World/{kind}")
        light.CreateIntensityAttr(2.0)
        light.CreateColorAttr(Gf.Vec3f(1, 0.5, 0.2))
    camera = UsdGeom.Camera.Define(stage, "/World/main_cam")
    camera.AddTranslateOp().Set((0, 0, 9))
    _rig(stage)
    stage.GetRootLayer().Save()
    return path


PICTURES = {
    "grey.png": ("uint8", 1),
    "color.jpg": ("uint8", 3),
    "alpha.tif": ("uint16", 4),
    "tiles.tif": ("float", 4),
    "crop.exr": ("half", 4),
    "tiles.exr": ("half", 4),
    "parts.exr": ("half", 4),
    "sky.hdr": ("float", 3),
}
"""Type and number of the channels."""
IMAGES = (*PICTURES, "lamp.ies")


def images(folder: Path) -> list[Path]:
    """Small pictures of the formats and layouts that are read, and a photometric profile."""
    for name, (kind, channels) in PICTURES.items():
        spec = oiio.ImageSpec(16, 8, channels, kind)
        if name.startswith("crop"):
            spec.x, spec.y, spec.full_width, spec.full_height = 4, -2, 20, 12
        if name.startswith("tiles"):
            spec.tile_width = spec.tile_height = 16
        parts = (spec,) * (2 if name.startswith("parts") else 1)
        writer = oiio.ImageOutput.create(str(folder / name))
        assert writer.open(str(folder / name), parts if len(parts) > 1 else spec), writer.geterror()
        for k, part in enumerate(parts):
            assert not k or writer.open(str(folder / name), part, "AppendSubimage"), writer.geterror()
            assert writer.write_image(np.linspace(0.0, 1.0, 16 * 8 * channels, dtype=np.float32)), writer.geterror()
        writer.close()
    rows = "0 45 90\n0 180\n100 50 0\n100 60 0\n"
    (folder / "lamp.ies").write_text(f"IESNA:LM-63-2002\nTILT=NONE\n1 1000 1 3 2 1 2 0 0 0\n1 1 100\n{rows}")
    return [folder / name for name in IMAGES]


_PICTURED = """#usda 1.0
def Mesh "Card" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
    point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    uniform token subdivisionScheme = "none"
    texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = "vertex")
    rel material:binding = </Look>
}}
def Material "Look" {{
    token outputs:surface.connect = </Look/S.outputs:surface>
    def Shader "S" {{
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor.connect = </Look/T.outputs:rgb>
        float inputs:opacity.connect = </Look/T.outputs:a>
        normal3f inputs:normal.connect = </Look/T.outputs:rgb>
        token outputs:surface
    }}
    def Shader "T" {{
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @{file}@
        float3 outputs:rgb
        float outputs:a
    }}
}}
def DomeLight "Sky" {{
    asset inputs:texture:file = @{file}@
}}
def RectLight "Panel" (prepend apiSchemas = ["ShapingAPI"]) {{
    asset inputs:texture:file = @{file}@
    asset inputs:shaping:ies:file = @{file}@
}}
"""


def damage(data: bytes, rng: np.random.Generator) -> bytes:
    """A file with some bytes flipped, replaced, moved, repeated or missing, or with its end cut off."""
    bytes_ = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        if not bytes_:
            break
        at, length = int(rng.integers(len(bytes_))), int(rng.integers(1, 17))
        match int(rng.integers(6)):
            case 0:
                bytes_[at] ^= 1 << int(rng.integers(8))
            case 1:
                bytes_[at] = int(rng.integers(256))
            case 2:
                del bytes_[at : at + length]
            case 3:
                bytes_[at:at] = bytes_[at : at + length]
            case 4:
                bytes_[at : at + length] = rng.choice([b"\xff", b"\x00", b"\x7f"]) * length
            case 5 if rng.random() < 0.3:
                del bytes_[at:]
    return bytes(bytes_)


_NASTY = (
    "nan",
    "inf",
    "-inf",
    "1e38",
    "-1e38",
    "1e-45",
    "0",
    "-1",
    "2147483647",
    "-2147483648",
    "[]",
    '""',
    "</>",
    "None",
)


def rewrite(text: str, rng: np.random.Generator) -> str:
    """A .usda with numbers, words and lines replaced by what no reader expects."""
    lines = text.split("\n")
    for _ in range(int(rng.integers(1, 5))):
        at = int(rng.integers(1, len(lines)))
        words = lines[at].split(" ")
        match int(rng.integers(5)):
            case 0:
                words[int(rng.integers(len(words)))] = str(rng.choice(_NASTY))
                lines[at] = " ".join(words)
            case 1:
                lines[at] = lines[int(rng.integers(1, len(lines)))]
            case 2:
                del lines[at]
            case 3:
                head, equals, _ = lines[at].partition("=")
                lines[at] = f"{head}{equals} {rng.choice(_NASTY)}" if equals else lines[at]
            case 4:
                digits = [i for i, c in enumerate(lines[at]) if c.isdigit()]
                if digits:
                    i = int(rng.choice(digits))
                    lines[at] = lines[at][:i] + str(rng.choice(_NASTY[:10])) + lines[at][i + 1 :]
    return "\n".join(lines)


def _wrong(value: object, rng: np.random.Generator) -> object:
    """An array of another length, or with elements that make no sense."""
    if isinstance(value, Vt.TokenArray):
        names = [*value, "nowhere"]
        return Vt.TokenArray([str(name) for name in rng.choice(names, int(rng.integers(len(names) + 1)))])
    array = np.array(value)
    if array.size == 0:
        return value
    match int(rng.integers(6)):
        case 0:
            array = array[: int(rng.integers(len(array)))]
        case 1:
            array = np.concatenate([array, array[:1]])
        case 2 if array.dtype.kind == "f":
            with np.errstate(over="ignore"):  # 1e38 is infinite in half precision
                array.reshape(-1)[int(rng.integers(array.size))] = rng.choice(
                    [np.nan, np.inf, -np.inf, 1e38, -1e38, 1e-45]
                )
        case 3 if array.dtype.kind == "f":
            with np.errstate(over="ignore", invalid="ignore"):
                array = array * array.dtype.type(rng.choice([0.0, -1.0, 1e30, 1e-30]))
        case _ if array.dtype.kind in "iu":
            array.reshape(-1)[int(rng.integers(array.size))] = rng.choice([-1, 10**6, 2**31 - 1, -(2**31), 0, 3])
    return type(value).FromNumpy(array) if hasattr(type(value), "FromNumpy") else value


_TYPES = (
    "IntArray",
    "Float",
    "Token",
    "Point3fArray",
    "String",
    "Matrix4d",
    "Asset",
    "Half3Array",
    "Bool",
    "QuatfArray",
)
_VALUES = {
    "IntArray": [1, 2, -3],
    "Float": np.nan,
    "Token": "x",
    "Point3fArray": [(0, 0, 0), (1, np.nan, 1e38)],
    "String": "",
    "Matrix4d": Gf.Matrix4d(0.0),
    "Asset": Sdf.AssetPath("missing.png"),
    "Half3Array": [],
    "Bool": True,
    "QuatfArray": [Gf.Quatf(0.0)],
}


def misuse(layer: Sdf.Layer, rng: np.random.Generator, below: str = "/") -> None:
    """A few opinions of a layer's prims replaced: wrong lengths, types, indices; cycles; targets that are missing."""
    paths: list[Sdf.Path] = []
    layer.Traverse(Sdf.Path(below), lambda path: paths.append(path) if path.IsPrimPath() else None)
    for _ in range(int(rng.integers(1, 5))):
        prim = layer.GetPrimAtPath(paths[int(rng.integers(len(paths)))])
        if not prim:
            continue
        attributes, relationships = list(prim.attributes), list(prim.relationships)
        match int(rng.integers(8)):
            case 0 | 1 | 2 | 3 if attributes:
                attribute = attributes[int(rng.integers(len(attributes)))]
                value = attribute.default
                if isinstance(value, float):
                    attribute.default = float(rng.choice([np.nan, np.inf, -np.inf, 1e38, -1.0, 0.0, 1e-45]))
                elif hasattr(type(value), "FromNumpy"):
                    attribute.default = _wrong(value, rng)
                    if rng.random() < 0.3:
                        layer.SetTimeSample(attribute.path, 1.0, _wrong(value, rng))
                else:
                    attribute.default = Sdf.ValueBlock()
            case 4 if attributes:
                name = attributes[int(rng.integers(len(attributes)))].name
                del prim.properties[name]
                kind = str(rng.choice(list(_VALUES)))
                Sdf.AttributeSpec(prim, name, getattr(Sdf.ValueTypeNames, kind)).default = _VALUES[kind]
            case 5 if relationships:
                targets = relationships[int(rng.integers(len(relationships)))].targetPathList
                targets.explicitItems = [
                    str(rng.choice(["/Nowhere", "/World", str(prim.path), "/World/Many", "/Looks/Glow"]))
                ]
            case 6:
                where = paths[int(rng.integers(len(paths)))]
                far = Sdf.Reference(f"./missing{int(rng.integers(9))}.usd")
                prim.referenceList.Prepend(far if rng.random() < 0.5 else Sdf.Reference("", where))
            case 7:
                kinds = ("Mesh", "PointInstancer", "SkelRoot", "Skeleton", "RectLight", "Camera", "TetMesh", "Nonsense")
                prim.typeName = str(rng.choice(kinds))


def mutate(sources: list[Path], folder: Path, seed: int) -> Path:
    """The stage that a seed makes of one of the sources: of four, one is damaged, one has a damaged image."""
    rng = np.random.default_rng(seed)
    rich = next(source for source in sources if source.name == "rich.usda")
    if seed % 4 == 2:
        image = rich.parent / IMAGES[seed // 4 % len(IMAGES)]
        damaged, path = folder / f"{seed}{image.suffix}", folder / f"{seed}.usda"
        damaged.write_bytes(damage(image.read_bytes(), rng))
        path.write_text(_PICTURED.format(file=damaged.name))
        return path
    if seed % 2:  # well-formed, and senseless; one of two by its skinned meshes
        path = folder / f"{seed}{'.usda' if seed % 8 < 4 else '.usdc'}"
        layer = Sdf.Layer.CreateAnonymous(".usda")
        layer.TransferContent(Sdf.Layer.FindOrOpen(str(rich)))
        misuse(layer, rng, "/World/Rig" if seed % 4 == 3 else "/")
        layer.Export(str(path))
        return path
    source = sources[seed // 4 % len(sources)]
    path = folder / f"{seed}{source.suffix}"
    if source.suffix == ".usda" and rng.random() < 0.7:
        path.write_text(rewrite(source.read_text(), rng))
    else:
        path.write_bytes(damage(source.read_bytes(), rng))
    return path


def main(folder: Path) -> None:
    """Loads the files that standard input names, one after the other, and says how each went: time, MiB, outcome."""
    import warp_ir as ir

    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    for line in sys.stdin:
        path, complexity = line.split()
        start = time.perf_counter()
        try:
            scene = ir.load_usd(folder / path, complexity=complexity)
            outcome = f"scene {scene.triangle_count}"
        except ir.InputError as error:
            outcome = "refused" if "\n" not in str(error) else "many lines"
        except BaseException:
            outcome = "traceback " + traceback.format_exc().replace("\n", " | ")
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
        print(path, f"{time.perf_counter() - start:.2f}", peak, outcome, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
