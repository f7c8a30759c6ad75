"""Emitters: points on them, photons from them, rays that find them. Emissive triangles and UsdLux lights are one list.

`shape.py` is one light, `arriving.py` what of it gets to a point.
"""

from warp_ir.lights.bias_compensation import Bound, bound_on, cut_share, lights_beyond, surface_beyond
from warp_ir.lights.emit_photon import Aim, emit, land
from warp_ir.lights.intersect import lights_found, surface_found, surface_seen
from warp_ir.lights.sample_area import LightPoint, choose_emitter, sample_light
from warp_ir.lights.sample_direct import Arrival, power_heuristic, sample_arrival
from warp_ir.lights.visibility import arriving

__all__ = [
    "Aim",
    "Arrival",
    "Bound",
    "LightPoint",
    "arriving",
    "bound_on",
    "choose_emitter",
    "cut_share",
    "emit",
    "land",
    "lights_beyond",
    "lights_found",
    "power_heuristic",
    "sample_arrival",
    "sample_light",
    "surface_beyond",
    "surface_found",
    "surface_seen",
]
