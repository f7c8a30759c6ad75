"""Gathering: an unbiased estimate of the light of many VPLs at one point, for the cost of a few shadow rays.

VPL k contributes f_k V_k to a point x, with f_k = I_k min(G(x, y_k), b_k) and the visibility V_k, 0 or 1. Evaluating
f_k is cheap; V_k costs a ray.

* **Evaluate in blocks.** Sixteen VPLs are evaluated at once in vector registers; a CUDA thread evaluates one at a time,
  the same one as the other threads of its warp (`estimators.wavefront`).
* **Resample visibility.** M VPLs are drawn in proportion to f, and only they get a shadow ray. With S = Σ f, each
  contributes V S/M, which is unbiased (resampled importance sampling, Talbot et al. 2005; here the M draws are
  systematic along a curve through space). Where visibility has been learned, they are drawn in proportion to f q
  (`vpl.visibility`), and contribute V S/(M q).
* **Interleave.** The VPLs are divided into sets; a pixel evaluates one set, its neighbours evaluate others (Keller and
  Heidrich 2001). So the cost of a pixel does not grow with the number of VPLs.
* **Bound.** min(G, b) removes the weak singularity of G. `estimators.vpl` compensates for what this takes away.
"""

import warp as wp

from warp_ir.bvh import on_cuda
from warp_ir.device_scene import SceneData
from warp_ir.light_modifiers import approximate_shaping
from warp_ir.lights import light_visibility
from warp_ir.surface import ShadingPoint, scene_at
from warp_ir.vpl.sets import (
    BLOCK_ROWS,
    LANES,
    SHAPING_ROWS,
    SLOT_ROWS,
    SLOT_SHAPING_ROWS,
    VplSets,
    draw_weight,
    vec16,
    vec16i,
)
from warp_ir.vpl.visibility import CELLS, CELLS_OF_LANE, factor_row, section_begin

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_LANES = wp.constant(LANES)
MAX_RAYS = 8
"""Largest number of shadow rays of a call."""
_MAX_RAYS = wp.constant(MAX_RAYS)
_CELLS = wp.constant(CELLS)
_KEPT_BLOCKS = wp.constant(32)
"""Blocks whose weights are kept from the first pass to the second: nearly always all of a set."""


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
        const bool front_facing = (geometric > 0.0f) & (shading > 0.0f) & (facing > 0.0f);
        f[i] = front_facing ? bounded * b[8][i] : 0.0f;
    }
    return f;
""")
def _block_bounded_geometry(rows: wp.array[vec16], first: int, x: ShadingPoint) -> vec16:
    """Mean channel of f for the sixteen VPLs of a block, without branches.

    It is 0 behind the surface, even where the shading normal faces the VPL.
    """
    ...


@wp.func_native("""
    const wp::vec_t<16, float>* b = rows.data + first;
    const wp::vec_t<16, float>* s = shaping.data + first_shaping_row;
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
    rows: wp.array[vec16], first: int, shaping: wp.array[vec16], first_shaping_row: int, x: ShadingPoint
) -> vec16:
    """The approximate shaping factors of the sixteen VPLs of a block, all on lights."""
    ...


@wp.func_native("""
    wp::vec_t<16, float> out;
    for (int i = 0; i < 16; ++i) out[i] = v[i] * factors.data[first + i];
    return out;
""")
def _times_row(v: vec16, factors: wp.array[wp.float32], first: int) -> vec16: ...


@wp.func
def _block_weights(group: VplSets, block: int, x: ShadingPoint, row: int) -> vec16:
    """The weights f q of the sixteen VPLs of a block; f is with the approximate shaping of lights.

    The factors q begin at `row`; they are 1 if that is -1.
    """
    contributions = _block_bounded_geometry(group.rows, BLOCK_ROWS * block, x)
    if group.shaped == 1:
        contributions = wp.cw_mul(
            contributions, _block_shaping(group.rows, BLOCK_ROWS * block, group.shaping, SHAPING_ROWS * block, x)
        )
    if row >= 0:
        contributions = _times_row(contributions, group.visibility, row)
    return contributions


@wp.func_native("""
    wp::vec_t<16, float> out;
    float passed = 0.0f;
    for (int i = 0; i < 16; ++i) {
        out[i] = passed;
        passed += sums[i];
    }
    for (int i = 0; i < 16; ++i) {
        const float target = (ceilf(out[i] / per_ray - u) + u) * per_ray - out[i];
        out[i] = target > 0.0f ? target : 0.0f;
    }
    return out;
""")
def _first_targets(sums: vec16, per_ray: float, u: float) -> vec16:
    """The first target in every lane, relative to the lane's begin.

    Targets lie at (k + u) S/M, k = 0, 1, 2, ..., along the running sum of all lanes, one lane after the other.
    """
    ...


@wp.func_native("""
    wp::vec_t<16, int> out;
    for (int i = 0; i < 16; ++i) out[i] = count[i] + (sum[i] <= target[i] ? 1 : 0);
    return out;
""")
def _count_below(sum: vec16, target: vec16, count: vec16i) -> vec16i:
    """Adds one to the count of every lane whose running sum has not passed its target."""
    ...


@wp.func_native("""
    float total = 0.0f;
    for (int i = 0; i < 16; ++i) total += v[i];
    return total;
""")
def _sum(v: vec16) -> float: ...


@wp.func
def _learned_factor(group: VplSets, slot: int, x: ShadingPoint) -> float:
    """The factor q of the VPL in a slot."""
    lane = slot // group.blocks
    section = (slot - lane * group.blocks) * CELLS_OF_LANE // group.blocks
    return group.visibility[factor_row(x.tile, section) + lane % _LANES]


@wp.func
def _cell_factor(group: VplSets, cell: int, x: ShadingPoint) -> float:
    """The factor q of the VPLs of a section."""
    if x.tile < 0:
        return 1.0
    return group.visibility[factor_row(x.tile, cell % CELLS_OF_LANE) + cell // CELLS_OF_LANE]


@wp.func
def _cell_begin(group: VplSets, begin: int, cell: int) -> int:
    """The first slot of a section of the set that begins at a slot."""
    slot = begin + cell // CELLS_OF_LANE * group.blocks + section_begin(cell % CELLS_OF_LANE, group.blocks)
    return wp.min(slot, group.count)


@wp.func
def _shadowed_contribution(
    scene: SceneData,
    group: VplSets,
    x: ShadingPoint,
    slot: int,
    position: wp.vec4,
    intensity_bounce: wp.vec4,
    per_ray: float,
    max_bounces: int,
) -> wp.vec3:
    """The contribution of a drawn VPL: its colour times V S/M; 0 if it has more than `max_bounces` bounces."""
    if int(intensity_bounce[3]) > max_bounces:
        return wp.vec3(0.0)
    modifiers = int(-1)
    if scene.modifier_count > 0:
        vpl = group.order[slot]
        if vpl < group.vpls.on_lights:
            modifiers = group.vpls.modifiers[vpl]
    visibility = light_visibility(scene, modifiers, x, position)
    if x.tile >= 0:
        visibility = visibility / _learned_factor(group, slot, x)
    if modifiers >= 0:  # the approximate factor is part of f already
        visibility = visibility / approximate_shaping(
            scene.light_tables[0].modifiers.rows[modifiers], x.position, position
        )
    intensity = wp.vec3(intensity_bounce[0], intensity_bounce[1], intensity_bounce[2])
    return wp.cw_mul(intensity, visibility) * (per_ray / draw_weight(group, group.order[slot], intensity))


@wp.func(inline=False)
def gather(
    address: wp.uint64,
    vpl_sets: wp.array[VplSets],
    kind: int,
    u_set: float,
    x: ShadingPoint,
    u: float,
    rays: int,
    max_bounces: int,
) -> wp.vec3:
    """Irradiance [W m⁻²] at a point from the VPLs of all sets, estimated from one set with a few shadow rays.

    `address` is `SceneData.address`; `kind` is `ON_LIGHTS` or `ON_SURFACES`. `u_set` in [0, 1) selects the set, `u` in
    [0, 1) is the offset of the systematic sampling. VPLs of more than `max_bounces` bounces contribute nothing. `rays`
    is the number M of shadow rays, at most 8.
    """
    scene = scene_at(address)[0]
    group = vpl_sets[kind]
    set_index = int(u_set * float(group.sets))
    if on_cuda():
        return _gather_one_by_one(scene, group, set_index, x, u, rays, max_bounces) * float(group.sets)
    return _gather_in_blocks(scene, group, set_index, x, u, rays, max_bounces) * float(group.sets)


@wp.func
def _gather_in_blocks(
    scene: SceneData, group: VplSets, set_index: int, x: ShadingPoint, u: float, rays: int, max_bounces: int
) -> wp.vec3:
    """Two passes over the blocks of a set: the first sums the lanes, the second finds the VPLs at the targets.

    The M targets lie along one lane after the other; a lane is a section of the set's Z-order curve.
    """
    out = wp.vec3(0.0)
    begin = set_index * group.blocks
    kept = wp.zeros(shape=_KEPT_BLOCKS, dtype=vec16)
    sums = vec16()
    for section in range(CELLS_OF_LANE):
        row = factor_row(x.tile, section)
        for k in range(section_begin(section, group.blocks), section_begin(section + 1, group.blocks)):
            weights = _block_weights(group, begin + k, x, row)
            if k < _KEPT_BLOCKS:
                kept[k] = weights
            sums += weights
    total = _sum(sums)
    if total <= 0.0:
        return out
    per_ray = total / float(rays)
    # The first target of every lane is found in all lanes at once. Further targets in a lane are rare, unless few VPLs
    # contribute nearly everything.
    target = _first_targets(sums, per_ray, u)
    running = vec16()
    count = vec16i()
    for section in range(CELLS_OF_LANE):
        row = factor_row(x.tile, section)
        for k in range(section_begin(section, group.blocks), section_begin(section + 1, group.blocks)):
            if k < _KEPT_BLOCKS:
                running += kept[k]
            else:
                running += _block_weights(group, begin + k, x, row)
            count = _count_below(running, target, count)
    passed = float(0.0)
    rays_drawn = int(0)
    for lane in range(_LANES):
        k = count[lane]
        next_target = target[lane]
        while rays_drawn < rays and (float(rays_drawn) + u) * per_ray < passed + sums[lane]:
            if next_target > target[lane]:
                k = _count_in_lane(group, begin, lane, x, next_target)
            slot = _LANES * begin + group.blocks * lane + k
            if k < group.blocks and slot < group.count:
                row = BLOCK_ROWS * (begin + k)
                p = wp.vec4(
                    group.rows[row][lane],
                    group.rows[row + 1][lane],
                    group.rows[row + 2][lane],
                    group.rows[row + 3][lane],
                )
                out += _shadowed_contribution(
                    scene, group, x, slot, p, group.intensity_bounce[slot], per_ray, max_bounces
                )
            next_target += per_ray
            rays_drawn += 1
        passed += sums[lane]
    return out


@wp.func
def slot_weight(group: VplSets, slot: int, x: ShadingPoint) -> float:
    """The contribution f of the VPL in a slot."""
    if on_cuda():
        return _slot_weight(group, slot, x)
    lane = slot // group.blocks
    block = lane // _LANES * group.blocks + slot - lane * group.blocks
    return _block_weights(group, block, x, -1)[lane % _LANES]


@wp.func
def _count_in_lane(group: VplSets, begin: int, lane: int, x: ShadingPoint, target: float) -> int:
    """Number of VPLs in a lane before its running sum passes a target."""
    running = float(0.0)
    k = int(0)
    for section in range(CELLS_OF_LANE):
        row = factor_row(x.tile, section)
        end = section_begin(section + 1, group.blocks)
        while k < end:
            running += _block_weights(group, begin + k, x, row)[lane]
            if running > target:
                return k
            k += 1
    return k


@wp.func
def _gather_one_by_one(
    scene: SceneData, group: VplSets, set_index: int, x: ShadingPoint, u: float, rays: int, max_bounces: int
) -> wp.vec3:
    """The scalar form, for CUDA.

    Rays are traced after the loop, since what the sums need would occupy registers during traversal.
    """
    out = wp.vec3(0.0)
    slots = wp.zeros(shape=_MAX_RAYS, dtype=wp.int32)
    per_ray = draw_slots(group, set_index, x, u, rays, slots, 0, 1)
    for k in range(rays):
        if per_ray > 0.0 and slots[k] >= 0:
            out += slot_contribution(scene, group, x, slots[k], per_ray, max_bounces)
    return out


@wp.func
def draw_slots(
    group: VplSets,
    set_index: int,
    x: ShadingPoint,
    u: float,
    rays: int,
    slots: wp.array[wp.int32],
    first: int,
    stride: int,
) -> float:
    """Draws M VPLs of a set in proportion to f q, and returns S/M: one running sum over the set, M targets along it.

    The k-th is written to `slots[first + k stride]`: its slot, or -1 if none is at the target. Nothing is written where
    S = 0. The threads of a warp should have the same set: then they load the same rows at the same time.
    """
    begin = set_index * group.blocks * _LANES
    total = float(0.0)
    for cell in range(_CELLS):
        factor = _cell_factor(group, cell, x)
        for slot in range(_cell_begin(group, begin, cell), _cell_begin(group, begin, cell + 1)):
            total += factor * _slot_weight(group, slot, x)
    if total <= 0.0:
        return 0.0
    per_ray = total / float(rays)
    running = float(0.0)
    drawn = int(0)
    target = u * per_ray
    for cell in range(_CELLS):
        factor = _cell_factor(group, cell, x)
        for slot in range(_cell_begin(group, begin, cell), _cell_begin(group, begin, cell + 1)):
            running += factor * _slot_weight(group, slot, x)
            while drawn < rays and target < running:
                slots[first + drawn * stride] = slot
                drawn += 1
                target = (float(drawn) + u) * per_ray
    while drawn < rays:
        slots[first + drawn * stride] = -1
        drawn += 1
    return per_ray


@wp.func
def slot_contribution(
    scene: SceneData, group: VplSets, x: ShadingPoint, slot: int, per_ray: float, max_bounces: int
) -> wp.vec3:
    """The contribution of a VPL that `draw_slots` has drawn; it sends the shadow ray."""
    return _shadowed_contribution(
        scene,
        group,
        x,
        slot,
        _load4(group.slots, SLOT_ROWS * slot),
        _load4(group.intensity_bounce, slot),
        per_ray,
        max_bounces,
    )


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 v = __ldg(reinterpret_cast<const float4*>(rows.data) + row);
    return wp::vec4(v.x, v.y, v.z, v.w);
#else
    return rows.data[row];
#endif
""")
def _load4(rows: wp.array[wp.vec4], row: int) -> wp.vec4:
    """A row in one load of 16 bytes, where Warp would load four floats."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return rsqrtf(x);
#else
    return 1.0f / sqrtf(x);
#endif
""")
def _reciprocal_root(x: float) -> float:
    """1/√x; one instruction on CUDA, whose error is 2 ulp."""
    ...


@wp.func
def _slot_weight(group: VplSets, slot: int, x: ShadingPoint) -> float:
    """The contribution f of one VPL: `_block_weights` for one lane."""
    p = _load4(group.slots, SLOT_ROWS * slot)
    n = _load4(group.slots, SLOT_ROWS * slot + 1)
    weight_bound = _load4(group.slots, SLOT_ROWS * slot + 2)
    to_vpl = wp.vec3(p[0], p[1], p[2]) - x.position * p[3]
    inverse = _reciprocal_root(wp.dot(to_vpl, to_vpl) + 1.0e-30)
    shading = wp.dot(x.shading_normal, to_vpl)
    facing = n[3] - wp.dot(wp.vec3(n[0], n[1], n[2]), to_vpl) * inverse
    g = shading * inverse * facing * inverse * inverse
    weight = wp.min(g, weight_bound[1]) * weight_bound[0]
    if group.shaped == 1:
        axis_end = _load4(group.slot_shaping, SLOT_SHAPING_ROWS * slot)
        ramp = _load4(group.slot_shaping, SLOT_SHAPING_ROWS * slot + 1)
        cosine = -wp.dot(wp.vec3(axis_end[0], axis_end[1], axis_end[2]), to_vpl) * inverse
        factor = wp.min(wp.max(ramp[0] * cosine + ramp[1], ramp[2]), 1.0)
        weight *= wp.where(cosine < axis_end[3], 0.0, factor)
    if wp.dot(x.normal, to_vpl) > 0.0 and shading > 0.0 and facing > 0.0:
        return weight
    return 0.0
