"""Pictures as arrays and files: reading and writing, tone mapping, colour spaces, and mip chains."""

from warp_ir.image.io import read_image, write_image

__all__ = ["read_image", "write_image"]
