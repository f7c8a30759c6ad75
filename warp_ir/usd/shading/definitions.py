"""Definitions of MaterialX's standard library: what identifiers of nodes stand for, and graphs."""

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

from warp_ir.usd.shading.operations import OPERATIONS
from warp_ir.usd.stage.materialx import available, standard_library

if TYPE_CHECKING:
    import MaterialX

CHANNELS = {
    **dict.fromkeys(("float", "integer", "int", "boolean"), 1),
    **dict.fromkeys(("vector2", "float2", "texCoord2f"), 2),
    **dict.fromkeys(("color3", "color3f", "vector3", "float3", "normal", "point", "vector"), 3),
    **dict.fromkeys(("color4", "vector4", "float4"), 4),
    "matrix33": 9,
    "matrix44": 16,
}
"""Number of channels by type."""
SPECIAL = (
    "image",
    "RealityKitTexture2D",
    "hextiledimage",
    "tiledimage",
    "texcoord",
    "position",
    "normal",
    "geomcolor",
    "geompropvalueuniform",
    "geompropvalue",
    "UsdPrimvarReader",
    "UsdUVTexture",
    "UsdTransform2d",
    "extract",
    "swizzle",
    "separate2",
    "separate3",
    "separate4",
    "separate",
    "transformpoint",
    "transformvector",
    "transformnormal",
    "frame",
    "time",
)
"""Nodes that `network.py` evaluates besides `OPERATIONS`."""
_LEGACY = {"logical_and": "and", "logical_or": "or", "logical_not": "not", "minimum": "min", "maximum": "max"}
_KNOWN = sorted({*OPERATIONS, *SPECIAL, *_LEGACY}, key=len, reverse=True)
_TYPES = re.compile("|".join(sorted(CHANNELS, key=len, reverse=True)))


@dataclass(frozen=True)
class NodeKind:
    """What kind of node an identifier stands for."""

    node: str
    """The node's name, as in `OPERATIONS`; the identifier itself if it is unknown."""
    type: str
    """The type of its output."""
    definition: "MaterialX.NodeDef | None" = None
    """Its definition in the library."""

    @property
    def channels(self) -> int:
        """The number of channels of its output."""
        return CHANNELS.get(self.type, 3)


@lru_cache(maxsize=4096)
def node_kind(identifier: str) -> NodeKind:
    """The kind of a node by its identifier in USD.

    The library, which takes a second to read, is asked only for nodes whose names do not say what they are.
    """
    name = identifier.removeprefix("ND_")
    node = next((n for n in _KNOWN if name == n or name.startswith(f"{n}_")), "")
    if node:
        types = _TYPES.findall(name[len(node) :])
        return NodeKind(_LEGACY.get(node, node), types[-1] if types else "color3")
    if identifier.startswith("ND_") and available():
        definition = standard_library().getNodeDef(identifier)
        if definition is not None:
            return NodeKind(definition.getNodeString(), definition.getType(), definition)
    return NodeKind(identifier, "")


def graph_of(definition: "MaterialX.NodeDef") -> "MaterialX.NodeGraph | None":
    """The graph of simpler nodes that a definition stands for; None: it has none."""
    import MaterialX as mx

    implementation = definition.getImplementation("") or definition.getImplementation("genosl")
    return implementation if implementation is not None and implementation.isA(mx.NodeGraph) else None
