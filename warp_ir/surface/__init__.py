"""Surfaces as rays meet them: ray queries, ray origins, and the material and normals at a hit."""

from warp_ir.surface.hit import Hit, scene_at
from warp_ir.surface.material import (
    albedo,
    alpha_at,
    bsdf_at,
    camera_emission,
    emission,
    emission_at,
    has_camera_emission,
)
from warp_ir.surface.normals import mapped_normal, shading_normal, smooth_height
from warp_ir.surface.offset import offset_ray_origin, spawn_ray_origin
from warp_ir.surface.ray_query import SHADOW_RAY_END, closest, visible
from warp_ir.surface.shading_point import (
    ShadingPoint,
    geometry_term_of_hit,
    is_below,
    shading_point,
    shadow_ray_origin,
)

__all__ = [
    "SHADOW_RAY_END",
    "Hit",
    "ShadingPoint",
    "albedo",
    "alpha_at",
    "bsdf_at",
    "camera_emission",
    "closest",
    "emission",
    "emission_at",
    "geometry_term_of_hit",
    "has_camera_emission",
    "is_below",
    "mapped_normal",
    "offset_ray_origin",
    "scene_at",
    "shading_normal",
    "shading_point",
    "shadow_ray_origin",
    "smooth_height",
    "spawn_ray_origin",
    "visible",
]
