"""The picture from few samples: irradiance is filtered on surfaces, edges are sampled apart from it.

A pixel stands for the surface seen through its centre (`surfaces.py`). Samples of irradiance that fall on it are
averaged there (`observations.py`) and filtered (`filter.py`): no pixel mixes surfaces, so edges do not stop the filter.
What a pixel on an edge shows is then found by many cheap camera rays, each taking the irradiance of the neighbouring
pixel whose surface it meets (`edges.py`).

Through a lens or an open shutter a pixel sees surfaces that its centre does not tell of. Samples are then kept for the
pixel that shows their surface (`moments.py`), and pixels put together by camera rays as on edges (`blur.py`).

Where that leaves the plain mean by more than the noise explains, the mean is believed: the bias vanishes with the
noise. On edges a part of the difference is given back, as much of it as is not noise (James and Stein 1961)
(`compose.py`).
"""

from warp_ir.reconstruction import blur, compose, filter, sample_buffer
from warp_ir.reconstruction.reconstruct import SCRATCH, Reconstruction
from warp_ir.reconstruction.reprojection import surfaces_move

FILTER_MODULES = (
    sample_buffer,
    filter,
    compose,
)
"""Modules with the kernels of the filter."""
BLUR_MODULES = (blur,)
"""Modules with the kernels that a lens or an open shutter needs in addition."""

__all__ = ["BLUR_MODULES", "FILTER_MODULES", "SCRATCH", "Reconstruction", "surfaces_move"]
