"""VPLs arranged for evaluation: divided into sets, sorted along a Z-order curve, packed for those who evaluate them.

Where a thread has vector lanes, as on a CPU, VPLs are packed in blocks of sixteen. Where threads run in warps, as on a
GPU, the rows of a VPL lie together: threads that evaluate the same set load them at the same time, 16 bytes at once.

Every set is a contiguous run of VPLs in the order of their paths. A run of a low-discrepancy sequence is itself well
distributed, so every set alone is an unbiased estimate of the light (interleaved sampling, Keller and Heidrich 2001).
"""

import math

import warp as wp

from warp_ir.device.scratch import Scratch
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
"""A pixel evaluates about 16 x 16 VPLs, which costs a fraction of the shadow rays that follow."""
MAX_SETS_OF_BLOCKS = 64
"""Largest number of sets where a thread has lanes: larger scenes of VPLs have larger sets."""
MAX_SETS = 2048
"""Largest number of sets elsewhere. The sequence of pixels has 4096 points (`index_of_pixel`)."""
SLOT_ROWS = wp.constant(3)
SLOT_SHAPING_ROWS = wp.constant(2)
_PI = wp.constant(wp.float64(math.pi))
UNBOUNDED = wp.constant(3.0e38)
_CODE_CELLS = wp.constant(64)
_LAST = wp.constant(2**31 - 1)
"""Sort key of an empty row."""
_BOUND_AREAS = wp.constant(wp.float64(20.0))
"""The bound takes effect within a disk of this many times the area that a VPL stands for. A smaller value leaves noise
from VPLs close by; a larger one leaves noise, and costs time, from the compensation rays. The optimum is flat."""

ON_LIGHTS, ON_SURFACES = wp.constant(0), wp.constant(1)
"""Rows of the array that `build_sets` returns."""

vec16 = wp.types.vector(length=LANES, dtype=wp.float32)
vec16i = wp.types.vector(length=LANES, dtype=wp.int32)


@wp.struct
class VplSets:
    """VPLs packed for vector lanes: `sets` sets of `blocks` blocks of 16, padded with VPLs of intensity 0.

    A block has ten rows: x, y, z, w of the position, x, y, z, a of the normal, mean intensity, bound on G. If the VPLs
    lie on lights and any light has shaping, a block has seven rows more in a table of their own: x, y, z of the axis,
    and slope, offset, minimum and end of the ramp that approximates the shaping (`approximate_shaping`).
    """

    sets: int  # this, and whatever follows from the number of VPLs, is known on the device alone
    blocks: int  # per set
    count: int  # VPLs in all sets
    bound: Bound  # on G
    rows: wp.array[vec16]
    shaped: int  # 1: `shaping` has rows
    shaping: wp.array[vec16]
    slots: wp.array[wp.vec4]  # three rows for each VPL, in the same order: position, normal, (mean intensity, bound)
    slot_shaping: wp.array[wp.vec4]  # two: the axis and the end of the ramp; its slope, offset and minimum
    order: wp.array[wp.int32]  # rows in `vpls`: set by set, and within a set along a Z-order curve through space
    intensity_bounce: wp.array[wp.vec4]  # in that order: random lookups stay close together
    vpls: VplBuffer
    visibility: wp.array[wp.float32]  # the factors of `TileVisibility` for VPLs of this kind


@wp.func
def draw_weight(group: VplSets, vpl: int, intensity: wp.vec3) -> float:
    """The weight with which a VPL is drawn, per bounded geometry term: its mean intensity, lifted in uneven scenes.

    The mean of the channels need not be a luminance, but no channel may be left out.
    """
    weight = (intensity[0] + intensity[1] + intensity[2]) * (1.0 / 3.0)
    if group.vpls.lifted == 1:
        weight *= group.vpls.lift[vpl]
    return weight


@wp.func
def bound_of(group: VplSets, vpl: int, normal: wp.vec4) -> float:
    """The bound on G for one VPL: higher on lights whose VPLs lie densely; none for VPLs without a normal."""
    if normal[3] == 1.0:
        return UNBOUNDED
    if vpl < group.vpls.on_lights:
        return bound_for_pdf(group.bound, group.vpls.pdf_area[vpl])
    return group.bound.minimum


@wp.func
def intensity_and_bounce(group: VplSets, slot: int) -> wp.vec4:
    """The intensity [W/sr] and, as the fourth component, the bounce of the VPL in a slot of the order."""
    vpl = group.order[slot]
    intensity = group.vpls.intensity[vpl]
    return wp.vec4(intensity[0], intensity[1], intensity[2], float(group.vpls.bounce[vpl]))


@wp.func
def _spread_bits(x: int) -> int:
    """The lowest ten bits of x, with two zeros after each: one coordinate of a Morton code."""
    y = (x | (x << 16)) & 0x30000FF
    y = (y | (y << 8)) & 0x300F00F
    y = (y | (y << 4)) & 0x30C30C3
    return (y | (y << 2)) & 0x9249249


@wp.func
def morton_code(place: wp.vec3, cells: int) -> int:
    """The place on a Z-order curve through [-1/2, 1/2]³, of `cells`³ cells (a power of two, at most 1024).

    What lies outside is moved to the nearest cell.
    """
    code = int(0)
    for k in range(3):
        code = code | (_spread_bits(wp.clamp(int((place[k] + 0.5) * float(cells)), 0, cells - 1)) << k)
    return code


@wp.func
def sort_key(place: wp.vec3, i: int, on_lights: int, of_lights: wp.vec2i, of_surfaces: wp.vec2i) -> int:
    """The sort key of VPL `i`: light or surface, then the set, then the Morton code.

    `place` is in [-1/2, 1/2]³ where VPLs are told apart; `of_lights` and `of_surfaces` are those of `divide_blocks`.
    """
    code = morton_code(place, _CODE_CELLS)
    if i < on_lights:
        return code | ((i // (of_lights[1] * _LANES)) << 18)
    return code | (((i - on_lights) // (of_surfaces[1] * _LANES)) << 18) | (1 << 30)


@wp.func
def divide_blocks(count: int, most: int) -> wp.vec2i:
    """The number of sets (a power of two, at most `most`), and the number of blocks in each."""
    blocks = (count + _LANES - 1) // _LANES
    sets = int(1)
    while sets < most and blocks >= 2 * sets * _BLOCKS_PER_SET:
        sets *= 2
    return wp.vec2i(sets, (blocks + sets - 1) // sets)


@wp.func
def _with_counts(group: VplSets, divided: wp.vec2i, count: int, bound: Bound) -> VplSets:
    out = group
    out.sets = divided[0]
    out.blocks = divided[1]
    out.count = count
    out.bound = bound
    return out


@wp.func
def bound_on_geometry(of_lights: wp.vec2i, of_surfaces: wp.vec2i, density: wp.float64, area: wp.float64) -> Bound:
    """The bound on G where a pixel evaluates one set of either kind, divided by `divide_blocks`.

    A VPL stands for the area of the surfaces over the number that is evaluated. G can exceed the bound within a disk of
    `_BOUND_AREAS` times that area. `density` says how much denser guided VPLs lie where they matter.
    """
    evaluated = _LANES * wp.max(of_lights[1] + of_surfaces[1], 1)
    out = Bound()
    out.minimum = UNBOUNDED
    if area > wp.float64(0.0):
        out.minimum = float(_PI * wp.float64(evaluated) * density / (_BOUND_AREAS * area))
    out.per_pdf_area = float(_PI * wp.float64(_LANES * of_lights[1]) / _BOUND_AREAS)
    return out


@wp.struct
class SetSettings:
    """What the division into sets depends on, apart from the VPLs."""

    max_sets: int
    extent: float  # edge length of the cube of the Morton codes
    area: wp.float64  # of all surfaces
    density: wp.float64  # how much denser guided VPLs lie where they matter


@wp.kernel
def _divide_into_sets(
    first: int,
    lights: VplSets,
    surfaces: VplSets,
    settings: SetSettings,
    keys: wp.array[wp.int32],
    vpl_sets: wp.array[VplSets],
) -> None:
    """Divides the VPLs into sets, and writes their sort keys; empty rows come last."""
    i = first + wp.tid()
    vpls = lights.vpls
    of_lights = divide_blocks(vpls.on_lights, settings.max_sets)
    of_surfaces = divide_blocks(vpls.count[0] - vpls.on_lights, settings.max_sets)
    if i == 0:
        bound = bound_on_geometry(of_lights, of_surfaces, settings.density, settings.area)
        vpl_sets[0] = _with_counts(lights, of_lights, vpls.on_lights, bound)
        vpl_sets[1] = _with_counts(surfaces, of_surfaces, vpls.count[0] - vpls.on_lights, bound)
    lights.order[i] = i
    keys[i] = _LAST
    if i < vpls.count[0]:
        p = vpls.position[i]
        place = wp.vec3(p[0], p[1], p[2]) / settings.extent
        keys[i] = sort_key(place, i, vpls.on_lights, of_lights, of_surfaces)


@wp.func
def pack_block(vpl_sets: wp.array[VplSets], block: int) -> None:
    """Packs a block; blocks of lights come first. Every lane follows its own section of the set's Z-order curve."""
    i = block
    kind = int(ON_LIGHTS)
    if i >= vpl_sets[kind].sets * vpl_sets[kind].blocks:
        i -= vpl_sets[kind].sets * vpl_sets[kind].blocks
        kind = int(ON_SURFACES)
    group = vpl_sets[kind]
    if i >= group.sets * group.blocks:
        return
    begin = (i // group.blocks) * group.blocks * _LANES
    for lane in range(_LANES):
        slot = begin + group.blocks * lane + i % group.blocks
        position = wp.vec4(0.0)
        normal = wp.vec4(0.0)
        mean_intensity = float(0.0)
        bound = float(UNBOUNDED)
        if slot < group.count:
            vpl = group.order[slot]
            position = group.vpls.position[vpl]
            normal = group.vpls.normal[vpl]
            mean_intensity = draw_weight(group, vpl, group.vpls.intensity[vpl])
            bound = bound_of(group, vpl, normal)
            group.intensity_bounce[slot] = intensity_and_bounce(group, slot)
        for k in range(4):
            group.rows[BLOCK_ROWS * i + k][lane] = position[k]
            group.rows[BLOCK_ROWS * i + 4 + k][lane] = normal[k]
        group.rows[BLOCK_ROWS * i + 8][lane] = mean_intensity
        group.rows[BLOCK_ROWS * i + 9][lane] = bound


@wp.func
def pack_slot(scene: SceneData, vpl_sets: wp.array[VplSets], first_slot: int) -> None:
    """Packs the rows of one VPL; those on lights come first."""
    slot = first_slot
    kind = int(ON_LIGHTS)
    if slot >= vpl_sets[kind].count:
        slot -= vpl_sets[kind].count
        kind = int(ON_SURFACES)
    group = vpl_sets[kind]
    if slot >= group.count:
        return
    vpl = group.order[slot]
    normal = group.vpls.normal[vpl]
    mean_intensity = draw_weight(group, vpl, group.vpls.intensity[vpl])
    group.slots[SLOT_ROWS * slot] = group.vpls.position[vpl]
    group.slots[SLOT_ROWS * slot + 1] = normal
    group.slots[SLOT_ROWS * slot + 2] = wp.vec4(mean_intensity, bound_of(group, vpl, normal), 0.0, 0.0)
    group.intensity_bounce[slot] = intensity_and_bounce(group, slot)
    if group.shaped == 1:
        row = group.vpls.modifiers[vpl]
        axis_end = wp.vec4(0.0, 0.0, 0.0, -2.0)
        ramp = wp.vec4(0.0, 1.0, 1.0, 0.0)
        if row >= 0:
            modifiers = scene.light_tables[0].modifiers.rows[row]
            axis_end = wp.vec4(
                modifiers.frame[2, 0], modifiers.frame[2, 1], modifiers.frame[2, 2], modifiers.cutoff_cosine
            )
            ramp = wp.vec4(modifiers.ramp_slope, modifiers.ramp_offset, modifiers.ramp_min, 0.0)
        group.slot_shaping[SLOT_SHAPING_ROWS * slot] = axis_end
        group.slot_shaping[SLOT_SHAPING_ROWS * slot + 1] = ramp


@wp.func
def pack_shaping(scene: SceneData, vpl_sets: wp.array[VplSets], i: int) -> None:
    """Packs the rows of shaping of block `i`."""
    group = vpl_sets[ON_LIGHTS]
    if i >= group.sets * group.blocks:
        return
    begin = (i // group.blocks) * group.blocks * _LANES
    for lane in range(_LANES):
        slot = begin + group.blocks * lane + i % group.blocks
        axis = wp.vec3(0.0)
        ramp = wp.vec4(0.0, 1.0, 1.0, -2.0)  # level: not shaped
        if slot < group.count:
            row = group.vpls.modifiers[group.order[slot]]
            if row >= 0:
                modifiers = scene.light_tables[0].modifiers.rows[row]
                axis = wp.vec3(modifiers.frame[2, 0], modifiers.frame[2, 1], modifiers.frame[2, 2])
                ramp = wp.vec4(modifiers.ramp_slope, modifiers.ramp_offset, modifiers.ramp_min, modifiers.cutoff_cosine)
        for k in range(3):
            group.shaping[SHAPING_ROWS * i + k][lane] = axis[k]
        for k in range(4):
            group.shaping[SHAPING_ROWS * i + 3 + k][lane] = ramp[k]


@wp.kernel
def _pack(first: int, vpl_sets: wp.array[VplSets]) -> None:
    """Packs one block."""
    pack_block(vpl_sets, first + wp.tid())


@wp.kernel
def _pack_slots(first: int, scene: SceneData, vpl_sets: wp.array[VplSets]) -> None:
    """Packs the rows of one VPL."""
    pack_slot(scene, vpl_sets, first + wp.tid())


@wp.kernel
def _pack_shaping(first: int, scene: SceneData, vpl_sets: wp.array[VplSets]) -> None:
    """Packs the rows of shaping of one block."""
    pack_shaping(scene, vpl_sets, first + wp.tid())


def build_sets(vpls: VplBuffer, guide: Guide, scratch: Scratch) -> wp.array[VplSets]:
    """Arranges VPLs: one `VplSets` of those on lights, one of those on surfaces (`ON_LIGHTS`, `ON_SURFACES`).

    The host does not know the number of VPLs. It allocates and launches for the capacity, and threads without a VPL end
    at once.
    """
    scene, launcher = guide.scene, scratch.launcher
    # The radix sort needs twice the memory of its data.
    keys = scratch.array("sets.keys", max(2 * vpls.capacity, 1), wp.int32)
    order = scratch.array("sets.order", max(2 * vpls.capacity, 1), wp.int32)
    vpl_sets = scratch.array("sets", 2, VplSets)
    slotted = launcher.wavefront or not launcher.lanes
    settings = SetSettings()
    settings.max_sets = MAX_SETS_OF_BLOCKS if launcher.lanes else MAX_SETS
    settings.extent, settings.area, settings.density = scene.detail_extent, scene.area, guide.density_ratio
    lights, surfaces = VplSets(), VplSets()
    blocks = []
    for group, name, begin, end in (
        (lights, "lights", 0, vpls.on_lights),
        (surfaces, "surfaces", vpls.on_lights, vpls.capacity),
    ):
        most = -(-(end - begin) // LANES) + MAX_SETS_OF_BLOCKS - 1 if launcher.lanes and end > begin else 0
        slots = end - begin if slotted else 0
        blocks.append(most)
        group.vpls, group.order = vpls, order[begin:] if end > begin else order
        group.visibility = guide.visibility.to_lights if begin == 0 else guide.visibility.to_surfaces
        group.shaped = int(begin == 0 and scene.data.shaped_count > 0)
        group.rows = scratch.array(f"sets.{name}.rows", max(BLOCK_ROWS * most, 1), vec16)
        group.shaping = scratch.array(f"sets.{name}.shaping", max(SHAPING_ROWS * most * group.shaped, 1), vec16)
        group.slots = scratch.array(f"sets.{name}.slots", max(SLOT_ROWS * slots, 1), wp.vec4)
        shaping_rows = max(SLOT_SHAPING_ROWS * slots * group.shaped, 1)
        group.slot_shaping = scratch.array(f"sets.{name}.slot_shaping", shaping_rows, wp.vec4)
        group.intensity_bounce = scratch.array(f"sets.{name}.intensity_bounce", max(LANES * most, slots, 1), wp.vec4)
    inputs = [lights, surfaces, settings, keys, vpl_sets]
    launcher.launch(_divide_into_sets, max(vpls.capacity, 1), inputs)  # also without VPLs: counts must become 0
    wp.utils.radix_sort_pairs(keys, order, vpls.capacity)
    launcher.launch(_pack, sum(blocks), [vpl_sets])
    if lights.shaped:
        launcher.launch(_pack_shaping, blocks[0], [scene.data, vpl_sets])
    if slotted:
        launcher.launch(_pack_slots, vpls.capacity, [scene.data, vpl_sets])
    return vpl_sets
