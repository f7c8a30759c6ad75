"""Path guiding for light paths: what a few probe paths tell about where light paths matter to the picture."""

from warp_ir.guiding.learn import learn
from warp_ir.guiding.visibility import learn_visibility

__all__ = ["learn", "learn_visibility"]
