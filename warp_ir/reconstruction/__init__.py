"""Reconstruction of the picture from few samples: irradiance is filtered on surfaces, edges are supersampled.

A pixel stands for the surface that is visible through its centre (`pixel_surfaces.py`). Samples of irradiance on that
surface are accumulated there (`sample_buffer.py`) and denoised by a variance-guided à-trous filter (`filter.py`). No
pixel mixes surfaces, so geometric edges do not stop the filter. Pixels on edges are supersampled: many cheap camera
rays, each of which takes the filtered irradiance of the neighbouring pixel whose surface it hits (`edges.py`).

With defocus or motion blur, samples are reprojected through the centre of the lens, at one reference time
(`reprojection.py`). They are filtered there, without blur, and blurred again by supersampling lens and shutter
(`blur.py`).

Where the picture differs from the unfiltered mean by more than noise explains, the mean wins: the bias of the filter
vanishes with the noise (`compose.py`). On edges, the difference is shrunk by its noise (James and Stein 1961) and
added; a local gain gives the picture the level of the mean from the first iteration on (`correct.py`).
"""

from warp_ir.reconstruction import blur, correct, filter, sample_buffer
from warp_ir.reconstruction.reconstruct import SCRATCH, Reconstruction
from warp_ir.reconstruction.reprojection import surfaces_move

FILTER_MODULES = (
    sample_buffer,
    filter,
    correct,
)
"""Modules with the kernels of the filter."""
BLUR_MODULES = (blur,)
"""Modules with the kernels that defocus or motion blur needs in addition."""

__all__ = ["BLUR_MODULES", "FILTER_MODULES", "SCRATCH", "Reconstruction", "surfaces_move"]
