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
from warp_ir.device_scene import SceneData
from warp_ir.guide import Guide
from warp_ir.launch import Launcher
from warp_ir.light_control import emphasis
from warp_ir.lights import Bound, arriving, bound_on
from warp_ir.surface import scene_at
from warp_ir.vpl import VplBuffer

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

LANES = 16
_LANES = wp.constant(LANES)
_ROWS = wp.constant(10)
_SHAPE_ROWS = wp.constant(7)
BLOCKS_PER_SET = 16
"""A pixel weighs about 16 x 16 VPLs: a fraction of the cost of the shadow rays that follow."""
MAX_SETS = 64
_INFINITE = 3.0e38
_UNBOUNDED = wp.constant(_INFINITE)
_AREAS = 20.0
"""The bound takes hold within a disk of as many times the area that a VPL stands for. Small: noise from VPLs close
by; large: noise from the rays that make up for the bound, and their cost. Flat around this value."""

vec16 = wp.types.vector(length=LANES, dtype=wp.float32)
vec16i = wp.types.vector(length=LANES, dtype=wp.int32)


@wp.struct
class VplSets:
    """VPLs arranged for weighing: `sets` sets of `blocks` blocks of 16, the last padded with VPLs of no intensity.

    Ten rows per block: x, y, z, w of the position, x, y, z, a of the normal, luminance, bound on G. If the VPLs lie on
    lights and any is shaped, seven more in a table of their own: x, y, z of its axis, and slope, offset, least value
    and end of the ramp by which its VPLs are weighed (`light_control.emphasis`).
    """

    sets: int
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


@wp.func
def gather(scene: SceneData, lit: VplSets, which: float, x: Receiver, u: float, rays: int, max_bounce: int) -> wp.vec3:
    """Irradiance [W m⁻²] at a receiver by the VPLs of all sets, estimated from one of them with some shadow rays.

    `which` in [0, 1) chooses the set, `u` in [0, 1) is the offset of the systematic choice of VPLs. Those of more than
    `max_bounce` reflections are dark.
    """
    return _gather(scene.address, lit, which, x, u, rays, max_bounce)


@wp.func(inline=False)
def _gather(
    address: wp.uint64, lit: VplSets, which: float, x: Receiver, u: float, rays: int, max_bounce: int
) -> wp.vec3:
    scene = scene_at(address)[0]
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
    """The same for a thread without lanes: one running sum, M targets along it."""
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
    for slot in range(begin, end):
        running += _weigh_one(scene, lit, x, slot)
        while drawn < rays and (float(drawn) + u) * share < running:
            position = lit.vpls.position[lit.order[slot]]
            out += _shadowed(scene, lit, x, slot, position, _color_of(lit, slot), share, max_bounce)
            drawn += 1
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


@wp.kernel
def _sort_key(
    first: int, lights: VplSets, surfaces: VplSets, extent: float, keys: wp.array[wp.int32], order: wp.array[wp.int32]
) -> None:
    """Lights before surfaces, then the set, then the place on the Z-order curve."""
    i = first + wp.tid()
    order[i] = i
    p = lights.vpls.position[i]
    code = int(0)
    for k in range(3):
        cell = wp.clamp(int((p[k] / extent + 0.5) * 64.0), 0, 63)
        code = code | (_spread_bits(cell) << k)
    if i < lights.count:
        keys[i] = code | ((i // (lights.blocks * _LANES)) << 18)
    else:
        keys[i] = code | (((i - lights.count) // (surfaces.blocks * _LANES)) << 18) | (1 << 24)


@wp.kernel
def _pack(first: int, lights: VplSets, surfaces: VplSets) -> None:
    """Writes block `i`, those of the lights first: every lane runs along a part of the set's curve of its own."""
    i = first + wp.tid()
    lit = lights
    if i >= lights.sets * lights.blocks:
        i -= lights.sets * lights.blocks
        lit = surfaces
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
def _pack_shaping(first: int, scene: SceneData, lit: VplSets) -> None:
    """Writes the rows of shaping of block `i`."""
    i = first + wp.tid()
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


def _divide(vpls: Any, count: int) -> Any:
    """`VplSets` for some of the VPLs, still empty: as many sets as a pixel is spared."""
    lit = VplSets()
    blocks = -(-count // LANES)
    lit.sets = 1
    while lit.sets < MAX_SETS and blocks >= 2 * lit.sets * BLOCKS_PER_SET:
        lit.sets *= 2
    lit.blocks = -(-blocks // lit.sets)
    lit.vpls, lit.count = vpls, count
    return lit


def arrange(vpls: Any, guide: Guide, launcher: Launcher) -> tuple[Any, Any]:
    """The `VplSets` of the VPLs on lights and of those on surfaces.

    The area of the scene's surfaces, the number of VPLs that a pixel weighs and how densely the guide puts them give
    the bound on G.
    """
    scene = guide.scene
    lights, surfaces = _divide(vpls, vpls.on_lights), _divide(vpls, vpls.count - vpls.on_lights)
    weighed = LANES * max(lights.blocks + surfaces.blocks, 1)
    packed = not launcher.device.is_cuda  # a thread without lanes weighs the VPLs as they are
    # The sort wants room for a second copy.
    keys = launcher.kept("gather.keys", max(2 * vpls.count, 1), wp.int32)
    order = launcher.kept("gather.order", max(2 * vpls.count, 1), wp.int32)
    for lit, name, begin in ((lights, "lights", 0), (surfaces, "surfaces", vpls.on_lights)):
        lit.bound.least = _INFINITE
        if scene.area > 0.0:
            lit.bound.least = math.pi * weighed * guide.density / (_AREAS * scene.area)
        lit.bound.per_density = math.pi * LANES * lights.blocks / _AREAS
        lit.order = order[begin:] if lit.count else order
        blocks = lit.sets * lit.blocks if packed else 0
        lit.rows = launcher.kept(f"gather.{name}.rows", max(_ROWS * blocks, 1), vec16)
        lit.colors = launcher.kept(f"gather.{name}.colors", max(LANES * blocks, 1), wp.vec4)
        lit.shaped = int(begin == 0 and scene.data.shaped_count > 0)
        lit.shapes = launcher.kept(f"gather.{name}.shapes", max(_SHAPE_ROWS * blocks * lit.shaped, 1), vec16)
    if vpls.count:
        launcher.launch(_sort_key, vpls.count, [lights, surfaces, scene.extent, keys, order])
        wp.utils.radix_sort_pairs(keys, order, vpls.count)
    if packed:
        launcher.launch(_pack, lights.sets * lights.blocks + surfaces.sets * surfaces.blocks, [lights, surfaces])
        if lights.shaped:
            launcher.launch(_pack_shaping, lights.sets * lights.blocks, [scene.data, lights])
    return lights, surfaces
