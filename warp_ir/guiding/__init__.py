"""Path guiding for light paths: what a few probe paths tell about where light paths matter to the picture."""

from warp_ir.guiding.learn import learn

__all__ = ["learn"]
