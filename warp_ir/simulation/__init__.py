"""Scenes that a simulation moves, and many views of many worlds of them."""

from warp_ir.simulation.live_scene import LiveScene
from warp_ir.simulation.live_stage import LiveStage
from warp_ir.simulation.views import ACCUMULATE_NAMES, ClearValues, Views, ViewSettings

__all__ = ["ACCUMULATE_NAMES", "ClearValues", "LiveScene", "LiveStage", "ViewSettings", "Views"]
