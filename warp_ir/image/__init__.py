"""Pictures as arrays and files: reading and writing, tone mapping, colour spaces, and mip chains."""

from warp_ir.image.exr import ExrOptions
from warp_ir.image.io import read_image, write_image

__all__ = ["ExrOptions", "read_image", "write_image"]
