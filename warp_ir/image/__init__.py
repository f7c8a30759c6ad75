"""Pictures as arrays and files: writing and reading them, tone mapping, colour spaces, smaller copies."""

from warp_ir.image.io import read_image, write_image

__all__ = ["read_image", "write_image"]
