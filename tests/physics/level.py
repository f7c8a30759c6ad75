"""Light levels of whole stages: text in, a picture's mean out; and quadrature that knows nothing of the renderer."""

import math

import numpy as np

import warp_ir as ir

EYE = """
def Camera "Eye" {
    uniform token projection = "orthographic"
    float horizontalAperture = 1e-4
    float verticalAperture = 1e-4
    float2 clippingRange = (1e-4, 1)
    matrix4d xformOp:transform = ((1,0,0,0), (0,0,-1,0), (0,1,0,0), (0,0.01,0,1))
    uniform token[] xformOpOrder = ["xformOp:transform"]
}
"""
"""Sees the origin from just above: every pixel shows the same point."""
IDENTITY = np.eye(4)


def usd(value):
    """A matrix [4, 4] on column vectors as USD writes it, whose matrices are on rows; other arrays as tuples."""
    array = np.asarray(value, dtype=float)
    if array.shape == (4, 4):
        return f"({', '.join(str(tuple(row)) for row in array.T.tolist())})"
    return str([tuple(row) for row in array.tolist()]) if array.ndim > 1 else str(tuple(array.tolist()))


def at(matrix):
    """The lines that place a prim."""
    order = 'uniform token[] xformOpOrder = ["xformOp:transform"]'
    return f"matrix4d xformOp:transform = {usd(matrix)}\n    {order}\n"


def mesh(name, points, faces=((0, 1, 2, 3),), more="", api=""):
    """A polygonal mesh."""
    schemas = f"(prepend apiSchemas = [{api}])" if api else ""
    return f"""
def Mesh "{name}" {schemas} {{
    point3f[] points = {usd(points)}
    int[] faceVertexCounts = {[len(face) for face in faces]}
    int[] faceVertexIndices = {[int(i) for face in faces for i in face]}
    uniform token subdivisionScheme = "none"
    {more}
}}
"""


def floor(color=(1.0, 1.0, 1.0), name="Floor", size=5.0):
    """The plane y = 0."""
    s = size
    points = [(-s, 0, s), (s, 0, s), (s, 0, -s), (-s, 0, -s)]
    return mesh(name, points, more=f"color3f[] primvars:displayColor = [{usd(color)}]")


def panel(more="", matrix=IDENTITY, api='"MeshLightAPI"', name="L"):
    """A unit square that faces along -Z, with `st` as an image lies on a RectLight."""
    points = [(0.5, -0.5, 0), (-0.5, -0.5, 0), (-0.5, 0.5, 0), (0.5, 0.5, 0)]
    st = 'texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = "vertex")'
    return mesh(name, points, more=f"{at(matrix)}    {st}\n    {more}", api=api)


def light(kind, more="", matrix=IDENTITY, api="", name="L"):
    """A prim of UsdLux."""
    schemas = f"(prepend apiSchemas = [{api}])" if api else ""
    return f'\ndef {kind} "{name}" {schemas} {{\n    {at(matrix)}    {more}\n}}\n'


def material(inputs, name="Look", nodes=""):
    """A UsdPreviewSurface, and the nodes that feed it."""
    return f"""
def Material "{name}" {{
    token outputs:surface.connect = </{name}/S.outputs:surface>
    def Shader "S" {{
        uniform token info:id = "UsdPreviewSurface"
        {inputs}
        token outputs:surface
    }}
    {nodes}
}}
"""


def image_nodes(file, more="", output="rgb", name="Look", place="R"):
    """The nodes of a material's image: T, which is placed by the result of a node, R being primvars:st."""
    return f"""def Shader "T" {{
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @{file}@
        float2 inputs:st.connect = </{name}/{place}.outputs:result>
        {more}
        float3 outputs:{output}
    }}
    def Shader "R" {{
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "st"
        float2 outputs:result
    }}"""


def load(folder, text, *, warnings=(), **options):
    """A stage without a default light; `warnings` are parts of all that it warns of."""
    path = folder / "stage.usda"
    path.write_text(text if text.startswith("#usda") else "#usda 1.0\n" + text)
    scene = ir.load_usd(path, **({"default_light": "none"} | options))
    assert len(scene.warnings) == len(warnings), scene.warnings
    for line, part in zip(scene.warnings, warnings, strict=True):
        assert part in line
    return scene


def level(scene, estimator="path", *, device="cpu", **settings):
    """Mean radiance of a small picture, float64 [3]."""
    given = dict(width=16, height=16, iterations=256, light_paths=1024, max_bounces=0, filter=False) | settings
    film = ir.render(scene, ir.RenderSettings(estimator=estimator, **given), device=device)
    return film.radiance().astype(np.float64).mean(axis=(0, 1))


def assert_level(found, expected, within=0.01):
    """The levels agree in all channels, relative to the brightest."""
    found, expected = np.broadcast_arrays(np.asarray(found, float), np.asarray(expected, float))
    deviation = np.abs(found - expected).max() / np.abs(expected).max()
    assert deviation <= within, f"{found} is not {expected}: {deviation:.2%}"


def check(folder, text, expected, *, warnings=(), within=0.005, path=True, **settings):
    """The floor's radiance under the lights of a stage is `expected` / π, by VPLs and by paths.

    Paths of different pixels are independent, so that the mean has a standard error of its own: 4 of them count.
    """
    scene = load(folder, floor() + EYE + text, warnings=warnings)
    expected = np.asarray(expected, float) / math.pi
    assert_level(level(scene, "vpl", **(dict(iterations=32) | settings)), expected, within)
    if path:
        given = dict(width=16, height=16, iterations=64, max_bounces=0, filter=False) | settings
        film = ir.render(scene, ir.RenderSettings(estimator="path", **given))
        error = np.sqrt((film.standard_error().astype(float) ** 2).mean(axis=(0, 1)).max() / 256.0)
        assert_level(film.radiance().mean(axis=(0, 1)), expected, within + 4.0 * error / expected.max())


def irradiance(place, radiance, *, normal=(0.0, 1.0, 0.0), point=(0.0, 0.0, 0.0), n=200):
    """∫ L cosθ cosθ' / d² dA by the midpoint rule, [3] or a number, from a surface p(u, v).

    It emits from the side from which u runs to the right and v down, as images do.

    Args:
        place: From parameters u, v in [0, 1] to points [..., 3] in the world.
        radiance: Of (u, v, unit vector from the surface), a number or [..., 3].
        normal: Of the receiver.
        point: Where it is.
        n: Steps along u and v.
    """
    u, v = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(n) + 0.5) / n, indexing="ij")
    h = 1e-5
    du, dv = (place(u + h, v) - place(u - h, v)) / (2 * h), (place(u, v + h) - place(u, v - h)) / (2 * h)
    area = np.cross(dv, du) / n**2
    away = np.asarray(point) - place(u, v)
    d = np.linalg.norm(away, axis=-1)
    away /= d[..., None]
    form = np.maximum((away * area).sum(-1), 0.0) * np.maximum(-(away @ np.asarray(normal)), 0.0) / d**2
    light = np.asarray(radiance(u, v, away), dtype=float)
    return (np.broadcast_to(light, form.shape) * form).sum() if light.ndim < 3 else np.tensordot(form, light, 2)


def rectangle(matrix, width=1.0, height=1.0):
    """The parametrisation of a RectLight: u runs from +X to -X and v from +Y down, as its texture does; it faces -Z."""
    matrix = np.asarray(matrix, dtype=float)

    def place(u, v):
        local = np.stack([(0.5 - u) * width, (0.5 - v) * height, 0.0 * u], axis=-1)
        return local @ matrix[:3, :3].T + matrix[:3, 3]

    return place


def srgb(byte):
    """IEC 61966-2-1: the light of a byte."""
    x = np.asarray(byte) / 255.0
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
