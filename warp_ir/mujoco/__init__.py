"""MuJoCo Warp's batch renderer with global illumination (extra `mujoco`)."""

from warp_ir.mujoco.render_context import RenderContext, create_render_context, refit_bvh, render

__all__ = ["RenderContext", "create_render_context", "refit_bvh", "render"]
