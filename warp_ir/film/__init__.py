"""The film: the running mean of the iterations, its standard error, and the picture made of it."""

from warp_ir.film.film import Film

__all__ = ["Film"]
