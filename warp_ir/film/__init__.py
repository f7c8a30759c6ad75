"""The film: the running mean of the iterations, its standard error, and the picture made from them."""

from warp_ir.film import accumulate
from warp_ir.film.film import Film
from warp_ir.film.samples import FilmSamples
from warp_ir.film.storage import read_state

ACCUMULATE_MODULES = (accumulate,)
"""Modules with the kernels that every film needs."""

__all__ = ["ACCUMULATE_MODULES", "Film", "FilmSamples", "read_state"]
