"""Surfaces as rays meet them: ray queries, ray origins, and the material and normals at a hit."""

from warp_ir.surface.hit import Hit, scene_at
from warp_ir.surface.material import albedo, alpha_at, camera_emission, emission, emission_at, has_camera_emission
from warp_ir.surface.normals import mapped_normal, shading_normal, terminator_offset
from warp_ir.surface.offset import offset_ray_origin, spawn_ray_origin
from warp_ir.surface.ray_query import closest, visible

__all__ = [
    "Hit",
    "albedo",
    "alpha_at",
    "camera_emission",
    "closest",
    "emission",
    "emission_at",
    "has_camera_emission",
    "mapped_normal",
    "offset_ray_origin",
    "scene_at",
    "shading_normal",
    "spawn_ray_origin",
    "terminator_offset",
    "visible",
]
