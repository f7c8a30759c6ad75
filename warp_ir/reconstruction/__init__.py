"""The picture from few samples: irradiance is filtered on surfaces, edges are sampled apart from it.

A pixel stands for the surface seen through its centre (`surfaces.py`). Samples of irradiance that fall on it are
averaged there (`observations.py`) and filtered (`filter.py`): no pixel mixes surfaces, so edges do not stop the filter.
What a pixel on an edge shows is then found by many cheap camera rays, each taking the irradiance of the neighbouring
pixel whose surface it meets (`edges.py`).

Through a lens or an open shutter a pixel sees surfaces that its centre does not tell of. Then only the pixels that have
met nothing but the surface in their centre are filtered; the others keep their plain mean.

Where that leaves the plain mean by more than the noise explains, the mean is believed: the bias vanishes with the
noise. On edges a part of the difference is given back, as much of it as is not noise (James and Stein 1961)
(`compose.py`).
"""

from warp_ir.reconstruction.reconstruct import SCRATCH, Reconstruction

__all__ = ["SCRATCH", "Reconstruction"]
