"""The scene on the host: frozen records of NumPy arrays, independent of Warp and USD."""

from warp_ir.scene.camera import CONFORM_POLICIES, MAX_CLIPPING_PLANES, Camera, Projection
from warp_ir.scene.content import scene_hash
from warp_ir.scene.measure import materials_of, triangle_areas
from warp_ir.scene.scene import Scene
from warp_ir.scene.types import (
    MAX_RADIANCE,
    TEXTURED_GLOSS,
    Bools,
    Color,
    Floats,
    Gloss,
    InputError,
    Instances,
    Ints,
    Light,
    LightKind,
    Material,
    Mesh,
    MeshLight,
    Shaping,
    Texture,
    Wrap,
)

__all__ = [
    "CONFORM_POLICIES",
    "MAX_CLIPPING_PLANES",
    "MAX_RADIANCE",
    "TEXTURED_GLOSS",
    "Bools",
    "Camera",
    "Color",
    "Floats",
    "Gloss",
    "InputError",
    "Instances",
    "Ints",
    "Light",
    "LightKind",
    "Material",
    "Mesh",
    "MeshLight",
    "Projection",
    "Scene",
    "Shaping",
    "Texture",
    "Wrap",
    "materials_of",
    "scene_hash",
    "triangle_areas",
]
