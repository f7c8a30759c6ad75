"""Virtual point lights in their scene, drawn by PyVista: a `pyvista.Plotter` to look at, and files to keep or send."""

from warp_ir.preview.export import animate_vpls, picture_vpls, write_html, write_model
from warp_ir.preview.plot import COLORINGS, pick_vpls, plotter

__all__ = ["COLORINGS", "animate_vpls", "pick_vpls", "picture_vpls", "plotter", "write_html", "write_model"]
