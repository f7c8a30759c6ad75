"""USD stages as `Scene` records: the only package that imports pxr.

Reading order: `load` (the whole on one page), `traverse` (which prims are drawn, with which transforms), `assemble`
(gprims to meshes), then the families: `geometry`, `shading`, `lights`, `settings`, `stage`, and below them `values` and
`images`. What cannot be honoured goes to `values.report`.
"""

from warp_ir.usd.load import StageReader, load_usd

__all__ = ["StageReader", "load_usd"]
