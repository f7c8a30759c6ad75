"""Emitters: sampling them by area, by solid angle and by photons, and intersecting them with rays.

Emissive triangles and UsdLux lights are one list. `shape.py` is the geometry of one light, `visibility.py` the fraction
of its emission that reaches a point, `bias_compensation.py` the energy that a bound on the geometry term removes.
"""

from warp_ir.lights.bias_compensation import (
    Bound,
    bound_for_pdf,
    clamped_fraction,
    clamped_light_radiance,
    clamped_surface_radiance,
)
from warp_ir.lights.emit_photon import PhotonTarget, emit_photon, first_reflection
from warp_ir.lights.intersect import emission_to_camera, intersect_lights, surface_emission_mis
from warp_ir.lights.sample_area import EmitterSample, sample_light, select_emitter
from warp_ir.lights.sample_direct import DirectSample, power_heuristic, sample_direct
from warp_ir.lights.visibility import light_visibility

__all__ = [
    "Bound",
    "DirectSample",
    "EmitterSample",
    "PhotonTarget",
    "bound_for_pdf",
    "clamped_fraction",
    "clamped_light_radiance",
    "clamped_surface_radiance",
    "emission_to_camera",
    "emit_photon",
    "first_reflection",
    "intersect_lights",
    "light_visibility",
    "power_heuristic",
    "sample_direct",
    "sample_light",
    "select_emitter",
    "surface_emission_mis",
]
