"""Where iterations run: on several devices of this process, or on the machines of a Ray cluster.

A render is a plan of parts that are fixed before it begins (`plan`). An `Executor` renders them wherever it likes, in
any order, again where a machine was lost; `render_parts` adds them to the film in the order of the plan.
"""

import warp_ir

_ = warp_ir.Renderer  # before the modules below: so kernels are read only where they have to be compiled

from warp_ir.engine.devices import Devices  # noqa: E402
from warp_ir.engine.executor import Executor  # noqa: E402
from warp_ir.engine.plan import Part, Round  # noqa: E402
from warp_ir.engine.render import render_parts  # noqa: E402

__all__ = ["Devices", "Executor", "Part", "Round", "render_parts"]
