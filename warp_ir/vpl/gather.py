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

import warp as wp

from warp_ir.bvh import on_cuda
from warp_ir.device_scene import SceneData
from warp_ir.light_modifiers import approximate_shaping
from warp_ir.lights import light_visibility
from warp_ir.surface import scene_at
from warp_ir.vpl.sets import BLOCK_ROWS, LANES, SHAPING_ROWS, VplSets, bound_of, color_of, luminance, vec16, vec16i

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_LANES = wp.constant(LANES)
_MOST_RAYS = wp.constant(8)


@wp.struct
class ShadingPoint:
    """A surface point that gathers."""

    position: wp.vec3
    normal: wp.vec3  # geometric
    shading_normal: wp.vec3
    mesh: int
    from_camera: bool  # by the camera


@wp.func
def bounded_geometry_term(x: ShadingPoint, position: wp.vec4, normal: wp.vec4, bound: float) -> float:
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
def _weigh(rows: wp.array[vec16], first: int, x: ShadingPoint) -> vec16:
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
def _block_shaping(
    rows: wp.array[vec16], first: int, shapes: wp.array[vec16], first_shape: int, x: ShadingPoint
) -> vec16:
    """What shaping makes of the weights of a block."""
    ...


@wp.func
def _block_weights(lit: VplSets, block: int, x: ShadingPoint) -> vec16:
    f = _weigh(lit.rows, BLOCK_ROWS * block, x)
    if lit.shaped == 1:
        f = wp.cw_mul(f, _block_shaping(lit.rows, BLOCK_ROWS * block, lit.shapes, SHAPING_ROWS * block, x))
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
def _shadowed_contribution(
    scene: SceneData,
    lit: VplSets,
    x: ShadingPoint,
    slot: int,
    position: wp.vec4,
    color: wp.vec4,
    share: float,
    most: int,
) -> wp.vec3:
    """What the chosen VPL gives: `share` (= S/M) in its `color`, if it is visible and of at most `most` bounces."""
    if int(color[3]) > most:
        return wp.vec3(0.0)
    modifiers = int(-1)
    if scene.modifier_count > 0:
        vpl = lit.order[slot]
        if vpl < lit.vpls.on_lights:
            modifiers = lit.vpls.modifiers[vpl]
    arrives = light_visibility(scene, modifiers, x.position, x.mesh, x.from_camera, position)
    if modifiers >= 0:  # it was weighed with this factor
        arrives = arrives / approximate_shaping(scene.light_tables[0].modifiers.rows[modifiers], x.position, position)
    intensity = wp.vec3(color[0], color[1], color[2])
    return wp.cw_mul(intensity, arrives) * (share / luminance(intensity))


@wp.func(inline=False)
def gather(
    address: wp.uint64,
    parts: wp.array[VplSets],
    part: int,
    which: float,
    x: ShadingPoint,
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
    scene: SceneData, lit: VplSets, chosen: int, x: ShadingPoint, u: float, rays: int, max_bounce: int
) -> wp.vec3:
    """Every lane is a part of the set's curve; the M targets lie along one lane after the other."""
    out = wp.vec3(0.0)
    begin = chosen * lit.blocks
    sums = vec16()
    for block in range(begin, begin + lit.blocks):
        sums += _block_weights(lit, block, x)
    total = _sum(sums)
    if total <= 0.0:
        return out
    share = total / float(rays)
    # The first target in every lane is looked for in all at once. More in a lane are rare, or few VPLs give much.
    target = _first_targets(sums, share, u)
    running = vec16()
    count = vec16i()
    for block in range(begin, begin + lit.blocks):
        running += _block_weights(lit, block, x)
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
                row = BLOCK_ROWS * (begin + k)
                p = wp.vec4(
                    lit.rows[row][lane], lit.rows[row + 1][lane], lit.rows[row + 2][lane], lit.rows[row + 3][lane]
                )
                out += _shadowed_contribution(scene, lit, x, slot, p, lit.colors[slot], share, max_bounce)
            goal += share
            drawn += 1
        passed += sums[lane]
    return out


@wp.func
def _count_in_lane(lit: VplSets, begin: int, lane: int, x: ShadingPoint, target: float) -> int:
    """VPLs of a lane before its running sum passes a target."""
    running = float(0.0)
    k = int(0)
    while k < lit.blocks:
        running += _block_weights(lit, begin + k, x)[lane]
        if running > target:
            break
        k += 1
    return k


@wp.func
def _gather_one_by_one(
    scene: SceneData, lit: VplSets, chosen: int, x: ShadingPoint, u: float, rays: int, max_bounce: int
) -> wp.vec3:
    """The same for a thread without lanes: one running sum, M targets along it.

    Rays are sent afterwards: what the sums need would have to be kept in registers meanwhile.
    """
    out = wp.vec3(0.0)
    begin = chosen * lit.blocks * _LANES
    end = wp.min(begin + lit.blocks * _LANES, lit.count)
    total = float(0.0)
    for slot in range(begin, end):
        total += _vpl_weight(scene, lit, x, slot)
    if total <= 0.0:
        return out
    share = total / float(rays)
    running = float(0.0)
    drawn = int(0)
    slots = wp.zeros(shape=_MOST_RAYS, dtype=wp.int32)
    for slot in range(begin, end):
        running += _vpl_weight(scene, lit, x, slot)
        while drawn < rays and (float(drawn) + u) * share < running:
            slots[drawn] = slot
            drawn += 1
    for k in range(drawn):
        slot = slots[k]
        position = lit.vpls.position[lit.order[slot]]
        out += _shadowed_contribution(scene, lit, x, slot, position, color_of(lit, slot), share, max_bounce)
    return out


@wp.func
def _vpl_weight(scene: SceneData, lit: VplSets, x: ShadingPoint, slot: int) -> float:
    vpl = lit.order[slot]
    normal = lit.vpls.normal[vpl]
    bound = bound_of(lit, vpl, normal)
    weight = luminance(lit.vpls.intensity[vpl]) * bounded_geometry_term(x, lit.vpls.position[vpl], normal, bound)
    if lit.shaped == 1 and weight > 0.0:
        weight *= _vpl_shaping(scene, lit, vpl, x.position)
    return weight


@wp.func
def _vpl_shaping(scene: SceneData, lit: VplSets, vpl: int, position: wp.vec3) -> float:
    """The same for one VPL on a light."""
    row = lit.vpls.modifiers[vpl]
    if row < 0:
        return 1.0
    modifiers = scene.light_tables[0].modifiers.rows[row]
    target = lit.vpls.position[vpl]
    to_light = wp.vec3(target[0], target[1], target[2]) - position * target[3]
    cosine = -wp.dot(
        wp.vec3(modifiers.frame[2, 0], modifiers.frame[2, 1], modifiers.frame[2, 2]), wp.normalize(to_light)
    )
    if cosine < modifiers.cutoff_cosine:
        return 0.0
    return approximate_shaping(modifiers, position, target)
