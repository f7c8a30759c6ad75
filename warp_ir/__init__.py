"""warp_ir: instant radiosity for USD scenes in NVIDIA Warp.

Reading order: `renderer` (the algorithm on one page), `estimators.keller` (the method as published),
`vpl` (light paths), `gbuffer` and `gather` (what the camera sees, and how it is lit), `film` (how
iterations add up), `usd` (how a stage becomes a `Scene`).

Every name below is imported on first use, so that ``import warp_ir`` costs nothing.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from warp_ir.scene import Camera as Camera
    from warp_ir.scene import InputError as InputError
    from warp_ir.scene import Instances as Instances
    from warp_ir.scene import Light as Light
    from warp_ir.scene import LightKind as LightKind
    from warp_ir.scene import Material as Material
    from warp_ir.scene import Mesh as Mesh
    from warp_ir.scene import MeshLight as MeshLight
    from warp_ir.scene import Projection as Projection
    from warp_ir.scene import Scene as Scene
    from warp_ir.scene import Shaping as Shaping
    from warp_ir.scene import Texture as Texture
    from warp_ir.scene import Wrap as Wrap
    from warp_ir.settings import RenderSettings as RenderSettings
    from warp_ir.usd import StageReader as StageReader
    from warp_ir.usd import load_usd as load_usd

__version__ = "0.1.0"

_HOME = {
    "Camera": "scene",
    "InputError": "scene",
    "Instances": "scene",
    "Light": "scene",
    "LightKind": "scene",
    "Material": "scene",
    "Mesh": "scene",
    "MeshLight": "scene",
    "Projection": "scene",
    "Scene": "scene",
    "Shaping": "scene",
    "Texture": "scene",
    "Wrap": "scene",
    "RenderSettings": "settings",
    "load_usd": "usd",
    "StageReader": "usd",
    "Film": "film",
    "Renderer": "renderer",
    "render": "renderer",
    "trace_vpls": "vpl.trace",
    "write_image": "image",
    "read_image": "image",
}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'warp_ir' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"warp_ir.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
