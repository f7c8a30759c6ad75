"""warp_ir: instant radiosity for USD scenes in NVIDIA Warp.

Reading order: `renderer` (the algorithm on one page), `estimators.keller` (instant radiosity as published),
`vpl.emission` (light paths and their VPLs), `gbuffer` and `vpl.gather` (what the camera sees, and how it is lit),
`film` (how iterations add up), `reconstruction` (the filter), `usd.load` (how a stage becomes a `Scene`).

Every name below is imported when it is first used, so that ``import warp_ir`` takes no time.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from warp_ir.film import Film as Film
    from warp_ir.image import read_image as read_image
    from warp_ir.image import write_image as write_image
    from warp_ir.renderer import Renderer as Renderer
    from warp_ir.renderer import render as render
    from warp_ir.scene import Camera as Camera
    from warp_ir.scene import Gloss as Gloss
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
    from warp_ir.simulation import ClearValues as ClearValues
    from warp_ir.simulation import LiveScene as LiveScene
    from warp_ir.simulation import LiveStage as LiveStage
    from warp_ir.simulation import Views as Views
    from warp_ir.simulation import ViewSettings as ViewSettings
    from warp_ir.usd import StageReader as StageReader
    from warp_ir.usd import load_usd as load_usd
    from warp_ir.vpl.trace import trace_vpls as trace_vpls

__version__ = "0.1.0"

_HOME = {
    "Camera": "scene",
    "Gloss": "scene",
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
    "ClearValues": "simulation",
    "LiveScene": "simulation",
    "LiveStage": "simulation",
    "ViewSettings": "simulation",
    "Views": "simulation",
    "trace_vpls": "vpl.trace",
    "write_image": "image",
    "read_image": "image",
}
_WITH_KERNELS = ("film", "renderer", "vpl.trace")
__all__ = sorted(_HOME)


if not TYPE_CHECKING:  # a type checker must not take every name for one that exists

    def __getattr__(name: str) -> Any:
        if name not in _HOME:
            raise AttributeError(f"module 'warp_ir' has no attribute {name!r}")
        if _HOME[name] in _WITH_KERNELS:
            with importlib.import_module("warp_ir.device.definitions").put_off():
                home = importlib.import_module(f"warp_ir.{_HOME[name]}")
        else:
            home = importlib.import_module(f"warp_ir.{_HOME[name]}")
        value = getattr(home, name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
