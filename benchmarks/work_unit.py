"""A unit of time that scales with the machine: how long a fixed work takes there, on all cores or on the GPU.

The work is like that of rays, and uses nothing of the renderer but its threads: each of 2¹⁸ walkers follows 64 links
through a table of 320 KiB, which caches hold in part, and intersects a plane at every step. On two cores of a server
(AMD EPYC, 2023) it takes about 0.1 s; a unit is ten times as long.
"""

import statistics
import time

import numpy as np
import warp as wp

from warp_ir.device.launcher import Launcher

wp.set_module_options({"enable_backward": False})

_WALKERS, _STEPS, _NODES = 1 << 18, wp.constant(64), 1 << 14


@wp.kernel
def _walk(first: int, nodes: wp.array[wp.vec4], links: wp.array[wp.int32], out: wp.array[wp.float32]):
    i = first + wp.tid()
    at, distance = i & 16383, float(0.0)
    direction = wp.normalize(wp.vec3(0.3 + float(i & 7), 0.7, 0.2))
    for _ in range(_STEPS):
        node = nodes[at]
        normal = wp.vec3(node[0], node[1], node[2])
        t = (node[3] - distance * 0.01) / (wp.dot(normal, direction) + 3.0)
        if t < distance:
            at = links[at]
        else:
            at = links[(at + i) & 16383]
        distance = 0.9 * distance + t
    out[i] = distance


def unit_seconds(device: str) -> float:
    """Ten times the median duration [s] of five runs of the work."""
    launcher, random = Launcher(device), np.random.default_rng(1)
    nodes = wp.array(random.random((_NODES, 4), dtype=np.float32), dtype=wp.vec4, device=launcher.device)
    links = wp.array(random.permutation(_NODES).astype(np.int32), dtype=wp.int32, device=launcher.device)
    out = launcher.zeros(_WALKERS, wp.float32)
    durations = []
    for _ in range(6):  # the first compiles
        start = time.perf_counter()
        launcher.launch(_walk, _WALKERS, [nodes, links, out])
        wp.synchronize_device(launcher.device)
        durations.append(time.perf_counter() - start)
    return 10.0 * statistics.median(durations[1:])
