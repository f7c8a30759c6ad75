"""USD stages to `Scene` records: the only package that imports pxr.

Reading order: `load` (the whole on one page), `walk` (what is drawn, and where), `mesh` and `implicit` (triangles),
`material` and `surface` (what they look like), `light`, `camera`. Whatever cannot be honoured goes to `report`.
"""

from warp_ir.usd.load import StageReader, load_usd

__all__ = ["StageReader", "load_usd"]
