"""Draw modes of models (UsdGeomModelAPI): a model is drawn as cards, as the edges of its bounds, or as its axes.

The quads of cards are those of usdview: in the middle of the bounds ("cross") or on their faces ("box"), with Z up.
Lines are prisms with square sections.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from pxr import Kind, Sdf, Usd, UsdGeom

from warp_ir.scene import Color, Floats
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Unreadable
from warp_ir.usd.values.triangles import TriangleMesh

_LINE = 1.0 / 250.0
"""Thickness of lines, in terms of the diagonal of the bounds."""
_GAP = 1e-4
"""Distance of two cards back to back, likewise."""
_FACES = tuple(f"{axis}{side}" for axis in "XYZ" for side in ("Pos", "Neg"))
"""The faces of a box, as in `model:cardTextureXPos`."""


@dataclass(frozen=True, eq=False)
class DrawMode:
    """How a model is drawn instead of its geometry."""

    shape: TriangleMesh
    """Its triangles; `face` is the index of the colour or texture."""
    uvs: Floats
    """float32 [m, 3, 2], texture coordinates of cards."""
    textures: tuple[Usd.Attribute | None, ...]
    """The texture of each face; None: it is of one colour."""
    colors: tuple[Color, ...]
    """The colour of each face."""


def draw_mode(prim: Usd.Prim) -> str:
    """The draw mode by which a model is drawn itself; "" if its geometry is."""
    if not prim.IsModel():
        return ""
    applies = prim.GetAttribute("model:applyDrawMode")
    by_kind = Kind.Registry.IsA(Usd.ModelAPI(prim).GetKind(), Kind.Tokens.component)
    if not (applies.Get() if applies and applies.HasAuthoredValue() else by_kind):
        return ""
    mode = str(UsdGeom.ModelAPI(prim).ComputeModelDrawMode())
    return mode if mode in ("cards", "bounds", "origin") else ""


def read_draw_mode(prim: Usd.Prim, mode: str, time: Usd.TimeCode) -> DrawMode:
    """The triangles of a model that is drawn as `mode`.

    Raises:
        Unreadable: The model has no extent, or its cards are of an unsupported kind.
    """
    cache = UsdGeom.BBoxCache(time, [UsdGeom.Tokens.default_, UsdGeom.Tokens.render], useExtentsHint=True)
    box = cache.ComputeUntransformedBound(prim).ComputeAlignedRange()
    if box.IsEmpty():
        raise Unreadable("the model has no extent")
    low, high = np.array(box.GetMin()), np.array(box.GetMax())
    if not np.isfinite([low, high]).all():
        raise Unreadable("the extent of the model is not finite")
    size = float(np.linalg.norm(high - low)) or 1.0
    color = read.color(prim.GetAttribute("model:drawModeColor"), time, (0.18, 0.18, 0.18))
    if mode == "cards":
        return _cards(prim, low, high, size, color, time)
    if mode == "origin":
        ends: list[tuple[Floats, Floats]] = [(np.zeros(3), size / 4.0 * axis) for axis in np.eye(3)]
        return _lines(ends, size, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    corners = {code: np.where(code, high, low) for code in product((0, 1), repeat=3)}
    edges = [
        (corners[code], corners[(*code[:k], 1, *code[k + 1 :])]) for code in corners for k in range(3) if code[k] == 0
    ]
    return _lines(edges, size, (color,) * len(edges))


def _lines(edges: list[tuple[Floats, Floats]], size: float, colors: tuple[Color, ...]) -> DrawMode:
    """Axis-parallel lines as boxes around them."""
    quads, faces = [], []
    for k, (start, end) in enumerate(edges):
        low, high = np.minimum(start, end) - 0.5 * _LINE * size, np.maximum(start, end) + 0.5 * _LINE * size
        for name in _FACES:
            quads.append(_face(name, low, high, np.where(name.endswith("Pos"), high, low)))
            faces.append(k)
    return _quads(quads, faces, (None,) * len(edges), colors)


def _cards(prim: Usd.Prim, low: Floats, high: Floats, size: float, color: Color, time: Usd.TimeCode) -> DrawMode:
    """Cards with textures; a face without one has that of the opposite face, and all have the colour if none has."""
    geometry = read.text(prim.GetAttribute("model:cardGeometry"), time, "cross")
    if geometry not in ("cross", "box"):
        raise Unreadable(f"card geometry '{geometry}' is not supported")
    textures = {name: prim.GetAttribute(f"model:cardTexture{name}") for name in _FACES}
    authored = {name: a for name, a in textures.items() if isinstance(read.raw(a, time), Sdf.AssetPath)}
    quads: list[Floats] = []
    faces: list[int] = []
    used: list[Usd.Attribute | None] = []
    for name in _FACES:
        opposite = name[0] + ("Neg" if name.endswith("Pos") else "Pos")
        texture = authored.get(name) or authored.get(opposite)
        if authored and texture is None:
            continue
        axis, sign = "XYZ".index(name[0]), 1.0 if name.endswith("Pos") else -1.0
        place: Floats = 0.5 * (low + high) + 0.5 * sign * _GAP * size
        if geometry == "box":
            place = high if sign > 0.0 else low
        if high[axis - 1] == low[axis - 1] or high[axis - 2] == low[axis - 2]:
            continue
        quads.append(_face(name, low, high, place))
        faces.append(len(used))
        used.append(texture)
    return _quads(quads, faces, tuple(used), (color,) * len(used))


def _face(name: str, low: Floats, high: Floats, place: Floats) -> Floats:
    """A quad across an axis, [4, 3]: its corners at texture coordinates (0, 0), (1, 0), (1, 1) and (0, 1)."""
    axis, positive = "XYZ".index(name[0]), name.endswith("Pos")
    across, up = {0: (1, 2), 1: (0, 2), 2: (0, 1)}[axis]
    left, right = (low, high) if positive == (axis != 1) else (high, low)
    quad = np.tile(place, (4, 1))
    quad[:, across] = np.array([left, right, right, left])[:, across]
    quad[:, up] = np.array([low, low, high, high])[:, up]
    return quad


def _quads(
    quads: list[Floats], faces: list[int], textures: tuple[Usd.Attribute | None, ...], colors: tuple[Color, ...]
) -> DrawMode:
    if not quads:
        raise Unreadable("the model has no cards")
    count = len(quads)
    triangles = (np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(count)[:, None, None]).reshape(-1, 3).astype(np.int32)
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], np.float32)
    shape = TriangleMesh(np.concatenate(quads), triangles, np.repeat(faces, 2).astype(np.int32), triangles)
    return DrawMode(shape, np.tile(uv, (count, 1))[triangles], textures, colors)
