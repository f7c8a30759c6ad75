"""What tests of stages share: text that becomes a scene, its warnings, images, small prims, and real files."""

import os
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from warp_ir import Material, Mesh, Scene, load_usd

SCENES = Path(__file__).parents[1] / "scenes_usd"
"""The stages of the repository."""
TRIANGLE = """
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
        uniform token subdivisionScheme = "none"
"""
QUADS = """
    point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0), (2, 1, 0)]
    int[] faceVertexCounts = [4, 4]
    int[] faceVertexIndices = [0, 1, 2, 3, 1, 4, 5, 2]
    uniform token subdivisionScheme = "none"
"""
ST = "texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1), (2, 0), (2, 1)] (interpolation = 'vertex')"
"""Texture coordinates of `QUADS`."""
RGBA = np.arange(2 * 3 * 4).reshape(2, 3, 4).astype(np.uint8) * 10
SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
RAW = 'token inputs:sourceColorSpace = "raw"'
UNPACK = "float4 inputs:scale = (2, 2, 2, 1)\n float4 inputs:bias = (-1, -1, -1, 0)"
"""What a normal map needs: bytes as they are, from [0, 1] to [-1, 1]."""
READER = """def Shader "R" {
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "st"
        float2 outputs:result
    }"""


# ---- from text to a scene ----------------------------------------------------------------------------------------


def load(folder: Path, text: str, **options: object) -> Scene:
    """The scene of a stage of this text; `options` are those of `load_usd`."""
    file = folder / "stage.usda"
    file.write_text("#usda 1.0\n" + text)
    return load_usd(file, **options)


def warned(scene: Scene, *words: str) -> bool:
    """Whether a single warning of the scene holds all of the words."""
    return any(all(word in line for word in words) for line in scene.warnings)


def only_material(scene: Scene) -> Material:
    """The material of a scene that has one."""
    (material,) = scene.materials
    return material


def area_vectors(mesh: Mesh) -> np.ndarray:
    """Area of each triangle along its geometric normal, [m, 3]."""
    a, b, c = (mesh.points[mesh.triangles[:, k]] for k in range(3))
    return 0.5 * np.cross(b - a, c - a)


def area(mesh: Mesh) -> float:
    """The area of a mesh."""
    return float(np.linalg.norm(area_vectors(mesh), axis=1).sum())


def volume(mesh: Mesh) -> float:
    """The volume of a closed mesh, positive if it is wound outward."""
    a, b, c = (mesh.points[mesh.triangles[:, k]] for k in range(3))
    return float(np.einsum("mi,mi->", a, np.cross(b, c)) / 6.0)


# ---- prims -------------------------------------------------------------------------------------------------------


def material_text(inputs: str = "", name: str = "A", shader: str = "UsdPreviewSurface", output: str = "surface") -> str:
    """A material of one shader."""
    return f"""
def Material "{name}" {{
    token outputs:{output}.connect = </{name}/S.outputs:surface>
    def Shader "S" {{
        uniform token info:id = "{shader}"
        {inputs}
        token outputs:surface
    }}
}}
"""


def diffuse(color: str, name: str = "A") -> str:
    """A material of one colour."""
    return material_text(f"color3f inputs:diffuseColor = {color}", name)


def mesh(more: str = ST, name: str = "M", material: str = "/A") -> str:
    """Two quads with a material, A unless another is named, and texture coordinates."""
    binding = f"rel material:binding = <{material}>"
    return f'def Mesh "{name}" (prepend apiSchemas = ["MaterialBindingAPI"]) {{{QUADS} {more}\n {binding}\n}}\n'


def textured(
    inputs: str = "",
    output: str = "rgb",
    target: str = "color3f inputs:diffuseColor",
    file: str = "a.png",
    place: str = "R.outputs:result",
    nodes: str = READER,
) -> str:
    """A UsdPreviewSurface with a UsdUVTexture on one input."""
    text = material_text(f"{target}.connect = </A/T.outputs:{output}>")
    shader = f"""
    def Shader "T" {{
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @{file}@
        float2 inputs:st.connect = </A/{place}>
        {inputs}
        float3 outputs:{output}
    }}
    {nodes}
"""
    return text.rstrip()[:-1] + shader + "}\n"


def mesh_text(points: object, counts: object, indices: object, more: str = "", name: str = "M") -> str:
    """A polygonal mesh."""
    return f"""
def Mesh "{name}" {{
    point3f[] points = {[tuple(map(float, p)) for p in points]}
    int[] faceVertexCounts = {list(counts)}
    int[] faceVertexIndices = {list(indices)}
    uniform token subdivisionScheme = "none"
    {more}
}}"""


# ---- files -------------------------------------------------------------------------------------------------------


def write_image(path: Path, pixels: object, kind: object = None, **attributes: object) -> str:
    """Stores values [h, w] or [h, w, channels] as they are, row 0 at the top, by OpenImageIO.

    `kind` is the type of the file's numbers, uint8 for uint8 pixels and float for others unless given. Colours are not
    multiplied by alpha.
    """
    pixels = np.atleast_3d(pixels)
    kind = kind or ("uint8" if pixels.dtype == np.uint8 else "float")
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    spec.attribute("oiio:UnassociatedAlpha", 1)
    for name, value in attributes.items():
        spec.attribute(name, value)
    if spec.nchannels == 2:
        spec.channelnames = ("Y", "A")
    writer = oiio.ImageOutput.create(str(path))
    assert writer and writer.open(str(path), spec), oiio.geterror()
    assert writer.write_image(np.ascontiguousarray(pixels)), writer.geterror()
    writer.close()
    return str(path)


def photometry(vertical, horizontal, rows, *, head="TILT=NONE", kind=1, factor=1.0):
    """The text of an .ies file: its angles and its candela [horizontal, vertical]; kind 1 is type C, 2 B, 3 A."""
    numbers = "\n".join(" ".join(map(str, r)) for r in (vertical, horizontal, *rows))
    counts = f"1 1000 {factor} {len(vertical)} {len(horizontal)} {kind} 2 0 0 0\n1.0 1.0 100"
    return f"IESNA:LM-63-2002\n[TEST] x\n{head}\n{counts}\n{numbers}\n"


def sky_directions(layout, n):
    """The directions [h, w, 3] that the pixels of a dome's image show, from the layouts' definitions; NaN where none.

    An image by longitude and latitude has n rows, a cube's face n x n pixels, and an image in a circle n x n.
    """
    if layout == "latlong":
        theta, phi = np.meshgrid((np.arange(n) + 0.5) / n * np.pi, (np.arange(2 * n) + 0.5) / n * np.pi, indexing="ij")
        # The middle column is +Z; to its right x grows less: the longitude falls from +π on the left edge.
        phi = np.pi - phi
        return np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], -1)
    if layout == "cubeMapVerticalCross":
        out = np.full((4 * n, 3 * n, 3), np.nan)
        a = (np.arange(n) + 0.5) / n * 2.0 - 1.0
        x, y = np.meshgrid(a, -a)
        one = np.ones_like(x)
        faces = {(0, 1): (x, one, -y), (1, 0): (-one, y, x), (1, 1): (x, y, one), (1, 2): (one, y, -x),
                 (2, 1): (x, -one, y), (3, 1): (x, -y, -one)}  # fmt: skip
        for (row, column), face in faces.items():
            out[row * n : (row + 1) * n, column * n : (column + 1) * n] = np.stack(face, axis=-1)
        return out / np.linalg.norm(out, axis=-1, keepdims=True)
    a = (np.arange(n) + 0.5) / n * 2.0 - 1.0
    x, y = np.meshgrid(a, -a)
    r = np.hypot(x, y)
    theta = np.pi * r if layout == "angular" else 2.0 * np.arcsin(np.minimum(r, 1.0))
    out = np.stack([x / r * np.sin(theta), y / r * np.sin(theta), np.cos(theta)], axis=-1)
    return np.where(r[..., None] <= 1.0, out, np.nan)


# ---- files of other makers ---------------------------------------------------------------------------------------

_ASSETS = os.environ.get("WARP_IR_USD_ASSETS")
_NO_ASSETS = "WARP_IR_USD_ASSETS names no folder of stages of other makers"


def real_files() -> list[Path]:
    """The stages below the folder that WARP_IR_USD_ASSETS names; none where it names none."""
    kinds = (".usd", ".usda", ".usdc", ".usdz")
    return sorted(path for path in Path(_ASSETS).rglob("*") if path.suffix in kinds) if _ASSETS else []


def real_file_parameters() -> list[object]:
    """Parameters of a test for each of `real_files`, or a single one that is skipped with the reason."""
    files = [pytest.param(path, id=str(path.relative_to(_ASSETS))) for path in real_files()]
    return files or [pytest.param(None, id="none", marks=pytest.mark.skip(reason=_NO_ASSETS))]


def need_real_files() -> list[Path]:
    """`real_files`; where there are none, the test is skipped with the reason."""
    return real_files() or pytest.skip(_NO_ASSETS)


def real_file(name: str) -> Path:
    """A file or folder of the folder that WARP_IR_USD_ASSETS names; a test that asks for one not there is skipped."""
    if not _ASSETS:
        pytest.skip(_NO_ASSETS)
    path = Path(_ASSETS) / name
    return path if path.exists() else pytest.skip(f"{name} is not in the folder that WARP_IR_USD_ASSETS names")
