"""RenderSettings, RenderProducts, RenderVars and RenderPass prims."""
