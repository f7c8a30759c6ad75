"""The scene as the host sees it: frozen records of NumPy arrays, no Warp, no USD."""

from warp_ir.scene.camera import CONFORM_POLICIES, MAX_CLIPPING_PLANES, Camera, Projection
from warp_ir.scene.measure import materials_of
from warp_ir.scene.scene import Scene
from warp_ir.scene.types import (
    Color,
    Floats,
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
    "Camera",
    "Color",
    "Floats",
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
]
