"""Gathering: the unbiased light of many VPLs at one point for the price of a few shadow rays.

At a point x, f_k = I_k min(G(x, y_k), b_k) is what VPL k gives if it is visible; the f are cheap, visibility is dear.

* **Weigh in blocks.** Sixteen VPLs side by side are weighed in vector registers; on CUDA a thread weighs one at a time.
* **Resample visibility.** M of the VPLs are chosen in proportion to f and only they get a shadow ray, each
  standing for S/M, S being the sum of all f: unbiased (systematic resampling along a curve through space; Talbot
  et al. 2005 for the idea).
* **Interleave.** The VPLs come in sets, and a pixel weighs one of them, its neighbours another (Keller and Heidrich
  2001): the cost of a pixel does not grow with the number of VPLs.
* **Bound.** min(G, b) takes away the weak singularity; what it takes is given back by `estimators.vpl`.
"""

import math
from typing import Any

import warp as wp

from warp_ir.bvh import on_cuda
from warp_ir.device.launcher import Launcher
from warp_ir.device_scene import SceneData
from warp_ir.guide import Guide
from warp_ir.light_control import emphasis
from warp_ir.lights import Bound, arriving, bound_on
from warp_ir.surface import scene_at
from warp_ir.vpl import VplBuffer

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

LANES = 16
_LANES = wp.constant(LANES)
_ROWS = wp.constant(10)
_SHAPE_ROWS = wp.constant(7)
_BLOCKS_PER_SET = wp.constant(16)
"""A pixel weighs about 16 x 16 VPLs: a fraction of the cost of the shadow rays that follow."""
_MAX_SETS = wp.constant(64)
_PI = wp.constant(wp.float64(math.pi))
_MOST_RAYS = wp.constant(8)
_UNBOUNDED = wp.constant(3.0e38)
_LAST = wp.constant(2**31 - 1)
_AREAS = wp.constant(wp.float64(20.0))
"""The bound takes hold within a disk of as many times the area that a VPL stands for. Small: noise from VPLs close
by; large: noise from the rays that make up for the bound, and their cost. Flat around this value."""

ON_LIGHTS, ON_SURFACES = wp.constant(0), wp.constant(1)
"""The rows of what `arrange` returns."""

vec16 = wp.types.vector(length=LANES, dtype=wp.float32)
vec16i = wp.types.vector(length=LANES, dtype=wp.int32)


@wp.struct
class VplSets:
    """VPLs arranged for weighing: `sets` sets of `blocks` blocks of 16, the last padded with VPLs of no intensity.

    Ten rows per block: x, y, z, w of the position, x, y, z, a of the normal, luminance, bound on G. If the VPLs lie on
    lights and any is shaped, seven more in a table of their own: x, y, z of its axis, and slope, offset, least value
    and end of the ramp by which its VPLs are weighed (`light_control.emphasis`).
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


@wp.struct
class Receiver:
    """A surface point that gathers."""

    position: wp.vec3
    normal: wp.vec3  # geometric
    shading_normal: wp.vec3
    mesh: int
    seen: bool  # by the camera


@wp.func
def luminance(color: wp.vec3) -> float:
    """Mean of the channels: all that matters here is that no channel is forgotten."""
    return (color[0] + color[1] + color[2]) * (1.0 / 3.0)


@wp.func
def bounded_geometry_term(x: Receiver, position: wp.vec4, normal: wp.vec4, bound: float) -> float:
    """min(G, bound) between a receiver and a VPL; 0 behind the surface, whatever its interpolated normal says."""
    to_vpl = wp.vec3(position[0], position[1], position[2]) - x.position * position[3]
    squared = wp.dot(to_vpl, to_vpl) + 1.0e-30
    inverse = 1.0 / wp.sqrt(squared)
    direction = to_vpl * inverse
    at_x = wp.dot(x.shading_normal, direction)
    at_vpl = normal[3] - wp.dot(wp.vec3(normal[0], normal[1], normal[2]), direction)
    if at_x <= 0.0 or at_vpl <= 0.0 or wp.dot(x.normal, direction) <= 0.0:
        return 0.0
    return wp.min(at_x * at_vpl / squared, bound)


@wp.func_native("""
    const wp::vec_t<16, float>* b = rows.data + first;
    wp::vec_t<16, float> f;
    for (int i = 0; i < 16; ++i) {
        const float w = b[3][i];
        const float dx = b[0][i] - x.position[0] * w, dy = b[1][i] - x.position[1] * w;
        const float dz = b[2][i] - x.position[2] * w;
        const float squared = dx * dx + dy * dy + dz * dz + 1.0e-30f;
        const float inverse = 1.0f / sqrtf(squared);
        const float geometric = x.normal[0] * dx + x.normal[1] * dy + x.normal[2] * dz;
        const float shading = x.shading_normal[0] * dx + x.shading_normal[1] * dy + x.shading_normal[2] * dz;
        const float facing = b[7][i] - (b[4][i] * dx + b[5][i] * dy + b[6][i] * dz) * inverse;
        const float g = shading * inverse * facing * inverse * inverse;
        const float bounded = g < b[9][i] ? g : b[9][i];
        const bool seen = (geometric > 0.0f) & (shading > 0.0f) & (facing > 0.0f);
        f[i] = seen ? bounded * b[8][i] : 0.0f;
    }
    return f;
""")
def _weigh(rows: wp.array[vec16], first: int, x: Receiver) -> vec16:
    """Luminance of f for the sixteen VPLs of a block: `bounded_geometry_term` in lanes, without a branch."""
    ...


@wp.func_native("""
    const wp::vec_t<16, float>* b = rows.data + first;
    const wp::vec_t<16, float>* s = shapes.data + first_shape;
    wp::vec_t<16, float> out;
    for (int i = 0; i < 16; ++i) {
        const float w = b[3][i];
        const float dx = b[0][i] - x.position[0] * w, dy = b[1][i] - x.position[1] * w;
        const float dz = b[2][i] - x.position[2] * w;
        const float inverse = 1.0f / sqrtf(dx * dx + dy * dy + dz * dz + 1.0e-30f);
        const float cosine = -(s[0][i] * dx + s[1][i] * dy + s[2][i] * dz) * inverse;
        const float ramp = s[3][i] * cosine + s[4][i];
        const float above = ramp > s[5][i] ? ramp : s[5][i];
        out[i] = cosine < s[6][i] ? 0.0f : (above < 1.0f ? above : 1.0f);
    }
    return out;
""")
def _emphasize(rows: wp.array[vec16], first: int, shapes: wp.array[vec16], first_shape: int, x: Receiver) -> vec16:
    """What shaping makes of the weights of a block."""
    ...


@wp.func
def _weigh_block(lit: VplSets, block: int, x: Receiver) -> vec16:
    f = _weigh(lit.rows, _ROWS * block, x)
    if lit.shaped == 1:
        f = wp.cw_mul(f, _emphasize(lit.rows, _ROWS * block, lit.shapes, _SHAPE_ROWS * block, x))
    return f


@wp.func_native("""
    wp::vec_t<16, float> out;
    float passed = 0.0f;
    for (int i = 0; i < 16; ++i) {
        out[i] = passed;
        passed += sums[i];
    }
    for (int i = 0; i < 16; ++i) {
        const float target = (ceilf(out[i] / share - u) + u) * share - out[i];
        out[i] = target > 0.0f ? target : 0.0f;
    }
    return out;
""")
def _first_targets(sums: vec16, share: float, u: float) -> vec16:
    """Of the targets (0, 1, 2, ... + u) share along all lanes the first in every lane, from where the lane begins."""
    ...


@wp.func_native("""
    wp::vec_t<16, int> out;
    for (int i = 0; i < 16; ++i) out[i] = count[i] + (sum[i] <= target[i] ? 1 : 0);
    return out;
""")
def _count_below(sum: vec16, target: vec16, count: vec16i) -> vec16i:
    """One more in every lane whose running sum has not passed its target."""
    ...


@wp.func_native("""
    float total = 0.0f;
    for (int i = 0; i < 16; ++i) total += v[i];
    return total;
""")
def _sum(v: vec16) -> float: ...


@wp.func
def _color_of(lit: VplSets, slot: int) -> wp.vec4:
    """Intensity and bounce."""
    vpl = lit.order[slot]
    intensity = lit.vpls.intensity[vpl]
    return wp.vec4(intensity[0], intensity[1], intensity[2], float(lit.vpls.bounce[vpl]))


@wp.func
def _shadowed(
    scene: SceneData, lit: VplSets, x: Receiver, slot: int, position: wp.vec4, color: wp.vec4, share: float, most: int
) -> wp.vec3:
    """What the chosen VPL gives: `share` (= S/M) in its `color`, if it is visible and of at most `most` bounces."""
    if int(color[3]) > most:
        return wp.vec3(0.0)
    control = int(-1)
    if scene.control_count > 0:
        vpl = lit.order[slot]
        if vpl < lit.vpls.on_lights:
            control = lit.vpls.control[vpl]
    arrives = arriving(scene, control, x.position, x.mesh, x.seen, position)
    if control >= 0:  # it was weighed with this factor
        arrives = arrives / emphasis(scene.light_tables[0].controls.rows[control], x.position, position)
    intensity = wp.vec3(color[0], color[1], color[2])
    return wp.cw_mul(intensity, arrives) * (share / luminance(intensity))


@wp.func(inline=False)
def gather(
    address: wp.uint64,
    parts: wp.array[VplSets],
    part: int,
    which: float,
    x: Receiver,
    u: float,
    rays: int,
    max_bounce: int,
) -> wp.vec3:
    """Irradiance [W m⁻²] at a receiver by the VPLs of all sets, estimated from one of them with some shadow rays.

    `address` is that of the scene, `part` is `ON_LIGHTS` or `ON_SURFACES`. `which` in [0, 1) chooses the set, `u` in
    [0, 1) is the offset of the systematic choice of VPLs. Those of more than `max_bounce` reflections are dark. `rays`
    is 8 at most.
    """
    scene = scene_at(address)[0]
    lit = parts[part]
    chosen = int(which * float(lit.sets))
    if on_cuda():
        return _gather_one_by_one(scene, lit, chosen, x, u, rays, max_bounce) * float(lit.sets)
    return _gather_in_blocks(scene, lit, chosen, x, u, rays, max_bounce) * float(lit.sets)


@wp.func
def _gather_in_blocks(
    scene: SceneData, lit: VplSets, chosen: int, x: Receiver, u: float, rays: int, max_bounce: int
) -> wp.vec3:
    """Every lane is a part of the set's curve; the M targets lie along one lane after the other."""
    out = wp.vec3(0.0)
    begin = chosen * lit.blocks
    sums = vec16()
    for block in range(begin, begin + lit.blocks):
        sums += _weigh_block(lit, block, x)
    total = _sum(sums)
    if total <= 0.0:
        return out
    share = total / float(rays)
    # The first target in every lane is looked for in all at once. More in a lane are rare, or few VPLs give much.
    target = _first_targets(sums, share, u)
    running = vec16()
    count = vec16i()
    for block in range(begin, begin + lit.blocks):
        running += _weigh_block(lit, block, x)
        count = _count_below(running, target, count)
    passed = float(0.0)
    drawn = int(0)
    for lane in range(_LANES):
        k = count[lane]
        goal = target[lane]
        while drawn < rays and (float(drawn) + u) * share < passed + sums[lane]:
            if goal > target[lane]:
                k = _count_in_lane(lit, begin, lane, x, goal)
            slot = _LANES * begin + lit.blocks * lane + k
            if k < lit.blocks and slot < lit.count:
                row = _ROWS * (begin + k)
                p = wp.vec4(
                    lit.rows[row][lane], lit.rows[row + 1][lane], lit.rows[row + 2][lane], lit.rows[row + 3][lane]
                )
                out += _shadowed(scene, lit, x, slot, p, lit.colors[slot], share, max_bounce)
            goal += share
            drawn += 1
        passed += sums[lane]
    return out


@wp.func
def _count_in_lane(lit: VplSets, begin: int, lane: int, x: Receiver, target: float) -> int:
    """VPLs of a lane before its running sum passes a target."""
    running = float(0.0)
    k = int(0)
    while k < lit.blocks:
        running += _weigh_block(lit, begin + k, x)[lane]
        if running > target:
            break
        k += 1
    return k


@wp.func
def _gather_one_by_one(
    scene: SceneData, lit: VplSets, chosen: int, x: Receiver, u: float, rays: int, max_bounce: int
) -> wp.vec3:
    """The same for a thread without lanes: one running sum, M targets along it.

    Rays are sent afterwards: what the sums need would have to be kept in registers meanwhile.
    """
    out = wp.vec3(0.0)
    begin = chosen * lit.blocks * _LANES
    end = wp.min(begin + lit.blocks * _LANES, lit.count)
    total = float(0.0)
    for slot in range(begin, end):
        total += _weigh_one(scene, lit, x, slot)
    if total <= 0.0:
        return out
    share = total / float(rays)
    running = float(0.0)
    drawn = int(0)
    slots = wp.zeros(shape=_MOST_RAYS, dtype=wp.int32)
    for slot in range(begin, end):
        running += _weigh_one(scene, lit, x, slot)
        while drawn < rays and (float(drawn) + u) * share < running:
            slots[drawn] = slot
            drawn += 1
    for k in range(drawn):
        slot = slots[k]
        position = lit.vpls.position[lit.order[slot]]
        out += _shadowed(scene, lit, x, slot, position, _color_of(lit, slot), share, max_bounce)
    return out


@wp.func
def _bound_of(lit: VplSets, vpl: int, normal: wp.vec4) -> float:
    """The bound on G for one VPL."""
    if normal[3] == 1.0:
        return _UNBOUNDED
    if vpl < lit.vpls.on_lights:
        return bound_on(lit.bound, lit.vpls.density[vpl])
    return lit.bound.least


@wp.func
def _weigh_one(scene: SceneData, lit: VplSets, x: Receiver, slot: int) -> float:
    vpl = lit.order[slot]
    normal = lit.vpls.normal[vpl]
    bound = _bound_of(lit, vpl, normal)
    weight = luminance(lit.vpls.intensity[vpl]) * bounded_geometry_term(x, lit.vpls.position[vpl], normal, bound)
    if lit.shaped == 1 and weight > 0.0:
        weight *= _emphasis_of(scene, lit, vpl, x.position)
    return weight


@wp.func
def _emphasis_of(scene: SceneData, lit: VplSets, vpl: int, position: wp.vec3) -> float:
    """The same for one VPL on a light."""
    row = lit.vpls.control[vpl]
    if row < 0:
        return 1.0
    control = scene.light_tables[0].controls.rows[row]
    target = lit.vpls.position[vpl]
    to_light = wp.vec3(target[0], target[1], target[2]) - position * target[3]
    cosine = -wp.dot(wp.vec3(control.frame[2, 0], control.frame[2, 1], control.frame[2, 2]), wp.normalize(to_light))
    if cosine < control.cutoff:
        return 0.0
    return emphasis(control, position, target)


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
    """The bound where a pixel weighs so many VPLs, so many of them on lights; `arrange` knows the rest."""
    out = Bound()
    out.least = _UNBOUNDED
    if area > wp.float64(0.0):
        out.least = float(_PI * wp.float64(weighed) * density / (_AREAS * area))
    out.per_density = float(_PI * wp.float64(on_lights) / _AREAS)
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
        bound = float(_UNBOUNDED)
        if slot < lit.count:
            vpl = lit.order[slot]
            position = lit.vpls.position[vpl]
            normal = lit.vpls.normal[vpl]
            strength = luminance(lit.vpls.intensity[vpl])
            bound = _bound_of(lit, vpl, normal)
            lit.colors[slot] = _color_of(lit, slot)
        for k in range(4):
            lit.rows[_ROWS * i + k][lane] = position[k]
            lit.rows[_ROWS * i + 4 + k][lane] = normal[k]
        lit.rows[_ROWS * i + 8][lane] = strength
        lit.rows[_ROWS * i + 9][lane] = bound


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
            row = lit.vpls.control[lit.order[slot]]
            if row >= 0:
                control = scene.light_tables[0].controls.rows[row]
                axis = wp.vec3(control.frame[2, 0], control.frame[2, 1], control.frame[2, 2])
                ramp = wp.vec4(control.slope, control.offset, control.least, control.cutoff)
        for k in range(3):
            lit.shapes[_SHAPE_ROWS * i + k][lane] = axis[k]
        for k in range(4):
            lit.shapes[_SHAPE_ROWS * i + 3 + k][lane] = ramp[k]


def arrange(vpls: Any, guide: Guide, launcher: Launcher) -> Any:
    """The `VplSets` of the VPLs on lights and of those on surfaces: two rows.

    The area of the scene's surfaces, the number of VPLs that a pixel weighs and how densely the guide puts them give
    the bound on G. All that depends on the number of VPLs is left to the device; here there is room for as many as
    there may be, and what is launched beyond ends at once.
    """
    scene = guide.scene
    packed = not launcher.device.is_cuda  # a thread without lanes weighs the VPLs as they are
    # The sort wants room for a second copy.
    keys = launcher.kept("gather.keys", max(2 * vpls.room, 1), wp.int32)
    order = launcher.kept("gather.order", max(2 * vpls.room, 1), wp.int32)
    parts = launcher.kept("gather.parts", 2, VplSets)
    lights, surfaces = VplSets(), VplSets()
    blocks = []
    for lit, name, begin, end in (
        (lights, "lights", 0, vpls.on_lights),
        (surfaces, "surfaces", vpls.on_lights, vpls.room),
    ):
        most = -(-(end - begin) // LANES) + _MAX_SETS - 1 if packed and end > begin else 0
        blocks.append(most)
        lit.vpls, lit.order = vpls, order[begin:] if end > begin else order
        lit.rows = launcher.kept(f"gather.{name}.rows", max(_ROWS * most, 1), vec16)
        lit.colors = launcher.kept(f"gather.{name}.colors", max(LANES * most, 1), wp.vec4)
        lit.shaped = int(begin == 0 and scene.data.shaped_count > 0)
        lit.shapes = launcher.kept(f"gather.{name}.shapes", max(_SHAPE_ROWS * most * lit.shaped, 1), vec16)
    inputs = [lights, surfaces, scene.extent, guide.density, scene.area, keys, parts]
    launcher.launch(_divide, max(vpls.room, 1), inputs)  # where nothing emits, that has to be said, too
    wp.utils.radix_sort_pairs(keys, order, vpls.room)
    launcher.launch(_pack, sum(blocks), [parts])
    if lights.shaped:
        launcher.launch(_pack_shaping, blocks[0], [scene.data, parts])
    return parts
