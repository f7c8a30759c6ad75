"""VPLs arranged for weighing: sorted along a space-filling curve, divided into sets, packed in blocks of sixteen.

Every set is a contiguous run of VPLs in the order of their paths. A run of a low-discrepancy sequence is itself well
distributed, so every set alone is an unbiased estimate of the light (interleaved sampling, Keller and Heidrich 2001).
"""

import math
from typing import Any

import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.device_scene import SceneData
from warp_ir.lights import Bound, bound_for_pdf
from warp_ir.vpl.emission import VplBuffer
from warp_ir.vpl.guide import Guide

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

LANES = 16
_LANES = wp.constant(LANES)
BLOCK_ROWS = wp.constant(10)
SHAPING_ROWS = wp.constant(7)
_BLOCKS_PER_SET = wp.constant(16)
"""A pixel weighs about 16 x 16 VPLs: a fraction of the cost of the shadow rays that follow."""
_MAX_SETS = wp.constant(64)
_PI = wp.constant(wp.float64(math.pi))
UNBOUNDED = wp.constant(3.0e38)
_LAST = wp.constant(2**31 - 1)
_AREAS = wp.constant(wp.float64(20.0))
"""The bound takes hold within a disk of as many times the area that a VPL stands for. Small: noise from VPLs close
by; large: noise from the rays that make up for the bound, and their cost. Flat around this value."""

ON_LIGHTS, ON_SURFACES = wp.constant(0), wp.constant(1)
"""The rows of what `build_sets` returns."""

vec16 = wp.types.vector(length=LANES, dtype=wp.float32)
vec16i = wp.types.vector(length=LANES, dtype=wp.int32)


@wp.struct
class VplSets:
    """VPLs arranged for weighing: `sets` sets of `blocks` blocks of 16, the last padded with VPLs of no intensity.

    Ten rows per block: x, y, z, w of the position, x, y, z, a of the normal, luminance, bound on G. If the VPLs lie on
    lights and any is shaped, seven more in a table of their own: x, y, z of its axis, and slope, offset, least value
    and end of the ramp by which its VPLs are weighed (`light_modifiers.approximate_shaping`).
    """

    sets: int  # this and what follows from the number of VPLs is known on the device alone
    blocks: int  # per set
    count: int  # VPLs in all sets
    bound: Bound
    rows: wp.array[vec16]
    shaped: int  # 1: there are rows of shaping
    shapes: wp.array[vec16]
    order: wp.array[wp.int32]  # their rows in `vpls`, set by set and in each along a space-filling curve
    colors: wp.array[wp.vec4]  # intensity and bounce in that order: what is looked up at random lies close together
    vpls: VplBuffer


@wp.func
def luminance(color: wp.vec3) -> float:
    """Mean of the channels: all that matters here is that no channel is forgotten."""
    return (color[0] + color[1] + color[2]) * (1.0 / 3.0)


@wp.func
def bound_of(lit: VplSets, vpl: int, normal: wp.vec4) -> float:
    """The bound on G for one VPL."""
    if normal[3] == 1.0:
        return UNBOUNDED
    if vpl < lit.vpls.on_lights:
        return bound_for_pdf(lit.bound, lit.vpls.pdf_area[vpl])
    return lit.bound.minimum


@wp.func
def color_of(lit: VplSets, slot: int) -> wp.vec4:
    """Intensity and bounce."""
    vpl = lit.order[slot]
    intensity = lit.vpls.intensity[vpl]
    return wp.vec4(intensity[0], intensity[1], intensity[2], float(lit.vpls.bounce[vpl]))


@wp.func
def _spread_bits(x: int) -> int:
    """Six bits, with two zeros between any two."""
    y = (x | (x << 8)) & 0x0F00F
    y = (y | (y << 4)) & 0x0C30C3
    return (y | (y << 2)) & 0x249249


@wp.func
def _divided(count: int) -> wp.vec2i:
    """Sets, as many as a pixel is spared, and the blocks of each."""
    blocks = (count + _LANES - 1) // _LANES
    sets = int(1)
    while sets < _MAX_SETS and blocks >= 2 * sets * _BLOCKS_PER_SET:
        sets *= 2
    return wp.vec2i(sets, (blocks + sets - 1) // sets)


@wp.func
def _with(lit: VplSets, divided: wp.vec2i, count: int, bound: Bound) -> VplSets:
    out = lit
    out.sets = divided[0]
    out.blocks = divided[1]
    out.count = count
    out.bound = bound
    return out


@wp.func
def _bound(weighed: int, on_lights: int, density: wp.float64, area: wp.float64) -> Bound:
    """The bound where a pixel weighs so many VPLs, so many of them on lights; `build_sets` knows the rest."""
    out = Bound()
    out.minimum = UNBOUNDED
    if area > wp.float64(0.0):
        out.minimum = float(_PI * wp.float64(weighed) * density / (_AREAS * area))
    out.per_pdf_area = float(_PI * wp.float64(on_lights) / _AREAS)
    return out


@wp.kernel
def _divide(
    first: int,
    lights: VplSets,
    surfaces: VplSets,
    extent: float,
    density: wp.float64,
    area: wp.float64,
    keys: wp.array[wp.int32],
    parts: wp.array[VplSets],
) -> None:
    """Divides the VPLs into sets, and gives them keys to be sorted by.

    Lights come before surfaces, then counts the set, then the place on the Z-order curve; rows without a VPL come last.
    """
    i = first + wp.tid()
    vpls = lights.vpls
    of_lights = _divided(vpls.on_lights)
    of_surfaces = _divided(vpls.count[0] - vpls.on_lights)
    if i == 0:
        weighed = _LANES * wp.max(of_lights[1] + of_surfaces[1], 1)
        bound = _bound(weighed, _LANES * of_lights[1], density, area)
        parts[0] = _with(lights, of_lights, vpls.on_lights, bound)
        parts[1] = _with(surfaces, of_surfaces, vpls.count[0] - vpls.on_lights, bound)
    lights.order[i] = i
    keys[i] = _LAST
    if i < vpls.count[0]:
        p = vpls.position[i]
        code = int(0)
        for k in range(3):
            cell = wp.clamp(int((p[k] / extent + 0.5) * 64.0), 0, 63)
            code = code | (_spread_bits(cell) << k)
        if i < vpls.on_lights:
            keys[i] = code | ((i // (of_lights[1] * _LANES)) << 18)
        else:
            keys[i] = code | (((i - vpls.on_lights) // (of_surfaces[1] * _LANES)) << 18) | (1 << 24)


@wp.kernel
def _pack(first: int, parts: wp.array[VplSets]) -> None:
    """Writes block `i`, those of the lights first: every lane runs along a part of the set's curve of its own."""
    i = first + wp.tid()
    part = int(ON_LIGHTS)
    if i >= parts[part].sets * parts[part].blocks:
        i -= parts[part].sets * parts[part].blocks
        part = int(ON_SURFACES)
    lit = parts[part]
    if i >= lit.sets * lit.blocks:
        return
    begin = (i // lit.blocks) * lit.blocks * _LANES
    for lane in range(_LANES):
        slot = begin + lit.blocks * lane + i % lit.blocks
        position = wp.vec4(0.0)
        normal = wp.vec4(0.0)
        strength = float(0.0)
        bound = float(UNBOUNDED)
        if slot < lit.count:
            vpl = lit.order[slot]
            position = lit.vpls.position[vpl]
            normal = lit.vpls.normal[vpl]
            strength = luminance(lit.vpls.intensity[vpl])
            bound = bound_of(lit, vpl, normal)
            lit.colors[slot] = color_of(lit, slot)
        for k in range(4):
            lit.rows[BLOCK_ROWS * i + k][lane] = position[k]
            lit.rows[BLOCK_ROWS * i + 4 + k][lane] = normal[k]
        lit.rows[BLOCK_ROWS * i + 8][lane] = strength
        lit.rows[BLOCK_ROWS * i + 9][lane] = bound


@wp.kernel
def _pack_shaping(first: int, scene: SceneData, parts: wp.array[VplSets]) -> None:
    """Writes the rows of shaping of block `i`."""
    i = first + wp.tid()
    lit = parts[ON_LIGHTS]
    if i >= lit.sets * lit.blocks:
        return
    begin = (i // lit.blocks) * lit.blocks * _LANES
    for lane in range(_LANES):
        slot = begin + lit.blocks * lane + i % lit.blocks
        axis = wp.vec3(0.0)
        ramp = wp.vec4(0.0, 1.0, 1.0, -2.0)  # level: not shaped
        if slot < lit.count:
            row = lit.vpls.modifiers[lit.order[slot]]
            if row >= 0:
                modifiers = scene.light_tables[0].modifiers.rows[row]
                axis = wp.vec3(modifiers.frame[2, 0], modifiers.frame[2, 1], modifiers.frame[2, 2])
                ramp = wp.vec4(modifiers.ramp_slope, modifiers.ramp_offset, modifiers.ramp_min, modifiers.cutoff_cosine)
        for k in range(3):
            lit.shapes[SHAPING_ROWS * i + k][lane] = axis[k]
        for k in range(4):
            lit.shapes[SHAPING_ROWS * i + 3 + k][lane] = ramp[k]


def build_sets(vpls: Any, guide: Guide, launcher: Launcher) -> Any:
    """The `VplSets` of the VPLs on lights and of those on surfaces: two rows.

    The area of the scene's surfaces, the number of VPLs that a pixel weighs and how densely the guide puts them give
    the bound on G. All that depends on the number of VPLs is left to the device; here there is room for as many as
    there may be, and what is launched beyond ends at once.
    """
    scene = guide.scene
    packed = not launcher.device.is_cuda  # a thread without lanes weighs the VPLs as they are
    # The sort wants room for a second copy.
    keys = launcher.scratch("gather.keys", max(2 * vpls.capacity, 1), wp.int32)
    order = launcher.scratch("gather.order", max(2 * vpls.capacity, 1), wp.int32)
    parts = launcher.scratch("gather.parts", 2, VplSets)
    lights, surfaces = VplSets(), VplSets()
    blocks = []
    for lit, name, begin, end in (
        (lights, "lights", 0, vpls.on_lights),
        (surfaces, "surfaces", vpls.on_lights, vpls.capacity),
    ):
        most = -(-(end - begin) // LANES) + _MAX_SETS - 1 if packed and end > begin else 0
        blocks.append(most)
        lit.vpls, lit.order = vpls, order[begin:] if end > begin else order
        lit.rows = launcher.scratch(f"gather.{name}.rows", max(BLOCK_ROWS * most, 1), vec16)
        lit.colors = launcher.scratch(f"gather.{name}.colors", max(LANES * most, 1), wp.vec4)
        lit.shaped = int(begin == 0 and scene.data.shaped_count > 0)
        lit.shapes = launcher.scratch(f"gather.{name}.shapes", max(SHAPING_ROWS * most * lit.shaped, 1), vec16)
    inputs = [lights, surfaces, scene.extent, guide.density, scene.area, keys, parts]
    launcher.launch(_divide, max(vpls.capacity, 1), inputs)  # where nothing emits, that has to be said, too
    wp.utils.radix_sort_pairs(keys, order, vpls.capacity)
    launcher.launch(_pack, sum(blocks), [parts])
    if lights.shaped:
        launcher.launch(_pack_shaping, blocks[0], [scene.data, parts])
    return parts
