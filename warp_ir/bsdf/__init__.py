"""Reflection that depends on directions: microfacets over a diffuse base, below a clearcoat.

`reflection.py` is the model on one page: the value, sampling and density of what a surface point reflects.
"""

from warp_ir.bsdf.albedo_table import AlbedoTable, upload_albedo_table
from warp_ir.bsdf.reflection import Bsdf, BsdfSample, bsdf_pdf, directional_albedo, evaluate, sample_bsdf

__all__ = [
    "AlbedoTable",
    "Bsdf",
    "BsdfSample",
    "bsdf_pdf",
    "directional_albedo",
    "evaluate",
    "sample_bsdf",
    "upload_albedo_table",
]
