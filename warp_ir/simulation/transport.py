"""The light of many worlds, and what many cameras see of them, by one launch a step for all of them.

A world is the record `SceneData` of it. So every device function of the renderer works in any world, and the kernels
here do no more than find the world of a path or of a pixel. What a world's light paths leave lies in a part of the
buffers of its own, a slot, which all cameras of the world share. Random numbers depend on the world, and not on the
slot or on other worlds: so neither does any bit of a picture.
"""

import warp as wp

from warp_ir.device.launcher import MAX_REGISTERS
from warp_ir.device_scene import SceneData
from warp_ir.estimators.vpl import Irradiance, gather_path
from warp_ir.estimators.wavefront import GatherSettings, gather_scramble
from warp_ir.gbuffer import GBuffer, camera_vertex
from warp_ir.lights import emission_to_camera
from warp_ir.sampling import sobol
from warp_ir.simulation.placement import WorldTargets
from warp_ir.surface import Hit, albedo, closest, mapped_normal, shading_normal, smooth_height, spawn_ray_origin
from warp_ir.vpl.emission import (
    LightPathSettings,
    VplBuffer,
    copy_vpl,
    recorded_vpls,
    remaining_vpls,
    surface_row,
    thinning_weight,
    trace_light_path,
)
from warp_ir.vpl.sets import (
    LANES,
    ON_LIGHTS,
    ON_SURFACES,
    VplSets,
    bound_on_geometry,
    divide_blocks,
    pack_block,
    pack_shaping,
    pack_slot,
    sort_key,
)

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

DISABLE_PRESERVE = wp.constant(-101)
"""World of a view whose pixels keep their values."""
DISABLE_CLEAR = wp.constant(-102)
"""World of a view that is cleared; so is any other that there is not."""
KEY_BITS = 31
"""Bits of the sort key of a VPL within its slot."""
_INFINITY = wp.constant(3.0e38)
_LAST = wp.constant((1 << KEY_BITS) - 1)
_LANES = wp.constant(LANES)
_MAX_LAYERS = wp.constant(64)
"""Most back faces that a camera ray passes."""


@wp.struct
class ViewRays:
    """The cameras: where they are, what rays they send, and which world each shows."""

    transforms: wp.array[wp.transformf]  # [views], world from camera
    rays: wp.array4d[wp.vec3]  # [rows, columns, samples, 2], origin and direction in the camera's space
    world: wp.array[wp.int32]  # [views]; negative: DISABLE_PRESERVE or DISABLE_CLEAR
    slot: wp.array[wp.int32]  # [views], slot of the world; -1: none
    rows: int
    columns: int
    samples: int
    sample: int  # of each pixel that is traced now
    cull: int  # 1: camera rays pass back faces
    max_distance: float  # in lengths of the direction
    origin: wp.vec3  # of the device frame
    scale: float


@wp.struct
class Outputs:
    """Images, one row for each pixel of each view; empty where they are not wanted."""

    color: wp.array[wp.uint32]
    albedo: wp.array[wp.uint32]
    hdr_color: wp.array[wp.vec3]
    depth: wp.array[wp.float32]
    forward_depth: wp.array[wp.float32]
    normal: wp.array[wp.vec3]
    shape_index: wp.array[wp.uint32]
    error: wp.array[wp.float32]


@wp.struct
class Clear:
    """What pixels show where a ray hits nothing."""

    color: wp.uint32
    albedo: wp.uint32
    depth: float
    normal: wp.vec3
    shape_index: wp.uint32
    linear: int  # 1: packed colours are linear, else sRGB


@wp.struct
class NearestSurfaces:
    """The surface that a pixel's nearest sample hits; empty unless the next step looks for it (`history`)."""

    instance: wp.array[wp.int32]
    triangle: wp.array[wp.int32]
    barycentric: wp.array[wp.vec2]  # weights of the triangle's first and second corner
    position: wp.array[wp.vec3]  # device frame
    normal: wp.array[wp.vec3]  # smooth
    footprint: wp.array[wp.float32]  # width of the pixel
    sample: wp.array[wp.int32]


@wp.struct
class ViewSums:
    """Sums over iterations, one row for each pixel of each view."""

    count: wp.array[wp.int32]  # [views], iterations before this step
    nearest: wp.array[wp.float32]  # depth of the nearest sample
    albedo: wp.array[wp.vec4]  # over the samples of this step: albedo, and how many hit anything
    emission: wp.array[wp.vec3]  # over the samples of this step; empty: nothing emits
    radiance: wp.array[wp.vec3]
    square: wp.array[wp.float32]  # of the mean channel of the radiance; empty: no error is wanted
    direct: wp.array[wp.vec3]  # irradiance over π; empty: nothing is filtered
    indirect: wp.array[wp.vec3]
    squares: wp.array[wp.vec2]  # of the mean channels of both
    reused: wp.array[wp.vec2]  # iterations of earlier steps in direct and indirect; empty: nothing is reprojected
    surfaces: NearestSurfaces


@wp.struct
class WorldPaths:
    """Light paths of the worlds in slots."""

    paths: int  # of a world
    slots: int
    first_slot: int  # of this launch
    world_of_slot: wp.array[wp.int32]
    slot_count: wp.array[wp.int32]  # [1], how many slots hold a world
    step: wp.array[wp.int32]  # [1]
    seed: wp.uint32
    iteration: int
    settings: LightPathSettings  # without scramble and target
    scramble: wp.array2d[wp.uint32]  # [slots, 1]
    targets: WorldTargets
    areas: wp.array[wp.float32]  # [worlds], of the surfaces


@wp.func
def world_in(paths: WorldPaths, slot: int) -> int:
    """The world in a slot of this launch; -1: none."""
    number = paths.first_slot + slot
    if number >= paths.slot_count[0]:
        return -1
    return paths.world_of_slot[number]


@wp.func
def _settings_of(paths: WorldPaths, slot: int, world: int) -> LightPathSettings:
    out = paths.settings
    out.scramble = paths.scramble[slot]
    out.photon_target.annulus_count = paths.targets.annuli
    out.photon_target.focus = paths.targets.focus[world]
    out.photon_target.cdf = paths.targets.cdf[world]
    return out


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _list_worlds(first: int, used: wp.array[wp.int32], ends: wp.array[wp.int32], paths: WorldPaths) -> None:
    """Gives a world that any view shows the next slot, and counts the slots."""
    w = first + wp.tid()
    if used[w] == 1:
        paths.world_of_slot[ends[w] - 1] = w
    if w == used.shape[0] - 1:
        paths.slot_count[0] = ends[w]


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _scramble_slots(first: int, paths: WorldPaths) -> None:
    """Writes the scramble of a slot: of the world, the step, the iteration and the seed."""
    slot = first + wp.tid()
    world = world_in(paths, slot)
    bits = sobol.hash_combine(paths.seed, wp.uint32(paths.step[0]))
    bits = sobol.hash_combine(bits, wp.uint32(paths.iteration))
    paths.scramble[slot, 0] = sobol.hash_combine(bits, wp.uint32(world))


@wp.func
def _vpls_of_slot(paths: WorldPaths, ends: wp.array[wp.int32], slot: int) -> wp.vec2i:
    """How many VPLs on surfaces the paths of earlier slots leave, and those of a slot."""
    before = wp.where(slot == 0, 0, ends[wp.max(slot * paths.paths - 1, 0)])
    return wp.vec2i(before, ends[(slot + 1) * paths.paths - 1] - before)


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _trace_world_paths(
    first: int,
    worlds: wp.array[SceneData],
    paths: WorldPaths,
    lengths: wp.array[wp.int32],
    ends: wp.array[wp.int32],
    buffers: wp.array[VplBuffer],
) -> None:
    """Traces a light path of a world, as `vpl.emission` does; those that are longer than recorded are traced again."""
    i = first + wp.tid()
    slot = i // paths.paths
    path = i - slot * paths.paths
    world = world_in(paths, slot)
    settings = _settings_of(paths, slot, world)
    length = int(0)
    written = recorded_vpls(settings, path)
    if settings.again == 1:
        if lengths[i] <= settings.recorded:
            return
        counts = _vpls_of_slot(paths, ends, slot)
        written = remaining_vpls(settings, lengths[i], ends[i] - lengths[i] - counts[0], counts[1])
    if world >= 0:
        if worlds[world].emitter_count > 0:
            length = trace_light_path(worlds[world].address, settings, path, buffers[slot], written)
        elif path < settings.on_lights:
            buffer = buffers[slot]
            buffer.position[path] = wp.vec4(0.0)
            buffer.normal[path] = wp.vec4(0.0)
            buffer.intensity[path] = wp.vec3(0.0)
            buffer.bounce[path] = 0
            buffer.pdf_area[path] = 0.0
            if worlds[world].modifier_count > 0:
                buffer.modifiers[path] = -1
    if settings.again == 0:
        lengths[i] = length


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _store_world_paths(
    first: int,
    worlds: wp.array[SceneData],
    paths: WorldPaths,
    traced: wp.array[VplBuffer],
    lengths: wp.array[wp.int32],
    ends: wp.array[wp.int32],
    buffers: wp.array[VplBuffer],
) -> None:
    """Stores what is recorded of a light path after that of the paths of its world before it."""
    i = first + wp.tid()
    slot = i // paths.paths
    path = i - slot * paths.paths
    world = world_in(paths, slot)
    settings = paths.settings
    settings.scramble = paths.scramble[slot]
    counts = _vpls_of_slot(paths, ends, slot)
    total = counts[1]
    if path == 0:
        buffers[slot].count[0] = wp.where(world < 0, 0, settings.on_lights + wp.min(total, settings.capacity))
    if world < 0:
        return
    source = traced[slot]
    buffer = buffers[slot]
    number = ends[i] - lengths[i] - counts[0]
    for k in range(wp.min(lengths[i], settings.recorded)):
        row = surface_row(settings, number + k, total)
        if row >= 0:
            copy_vpl(
                source, settings.on_lights + settings.paths * k + path, buffer, row, thinning_weight(settings, total)
            )
    if path < settings.on_lights:
        copy_vpl(source, path, buffer, path, 1.0)
        buffer.pdf_area[path] = source.pdf_area[path]
        if worlds[world].modifier_count > 0:
            buffer.modifiers[path] = source.modifiers[path]


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _divide_worlds(
    first: int,
    worlds: wp.array[SceneData],
    paths: WorldPaths,
    max_sets: int,
    keys: wp.array[wp.int64],
    order: wp.array[wp.int32],
    vpl_sets: wp.array2d[VplSets],
) -> None:
    """Divides the VPLs of a slot into sets, and writes their sort keys, as `vpl.sets` does; the slot comes first."""
    k = first + wp.tid()
    rows = vpl_sets[0, ON_LIGHTS].vpls.capacity
    slot = k // rows
    i = k - slot * rows
    world = world_in(paths, slot)
    vpls = vpl_sets[slot, ON_LIGHTS].vpls
    count = vpls.count[0]
    on_lights = wp.min(vpls.on_lights, count)
    of_lights = divide_blocks(on_lights, max_sets)
    of_surfaces = divide_blocks(count - on_lights, max_sets)
    if i == 0:
        area = wp.float64(paths.areas[wp.max(world, 0)])
        bound = bound_on_geometry(of_lights, of_surfaces, wp.float64(1.0), area)
        vpl_sets[slot, ON_LIGHTS].sets = of_lights[0]
        vpl_sets[slot, ON_LIGHTS].blocks = of_lights[1]
        vpl_sets[slot, ON_LIGHTS].count = on_lights
        vpl_sets[slot, ON_LIGHTS].bound = bound
        vpl_sets[slot, ON_SURFACES].sets = of_surfaces[0]
        vpl_sets[slot, ON_SURFACES].blocks = of_surfaces[1]
        vpl_sets[slot, ON_SURFACES].count = count - on_lights
        vpl_sets[slot, ON_SURFACES].bound = bound
    key = int(_LAST)
    if i < count:
        p = vpls.position[i]
        place = wp.vec3(p[0], p[1], p[2]) - worlds[world].focus * p[3]
        key = sort_key(place / (2.0 * worlds[world].focus_radius), i, on_lights, of_lights, of_surfaces)
    order[k] = i
    keys[k] = (wp.int64(slot) << wp.int64(KEY_BITS)) | wp.int64(key)


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _pack_worlds(
    first: int,
    worlds: wp.array[SceneData],
    paths: WorldPaths,
    blocks: int,
    slots: int,
    vpl_sets: wp.array2d[VplSets],
) -> None:
    """Packs a block of VPLs, or a single one, of a slot; of each slot there are as many as fit, `blocks` or `slots`."""
    k = first + wp.tid()
    each = wp.max(blocks, slots)
    slot = k // each
    i = k - slot * each
    world = world_in(paths, slot)
    if world < 0:
        return
    if i < blocks:
        pack_block(vpl_sets[slot], i)
        if vpl_sets[slot, ON_LIGHTS].shaped == 1:
            pack_shaping(worlds[world], vpl_sets[slot], i)
    if i < slots:
        pack_slot(worlds[world], vpl_sets[slot], i)


@wp.struct
class ViewHit:
    """What a camera ray sees; `hit.triangle` is -1 for a miss."""

    hit: Hit
    origin: wp.vec3
    direction: wp.vec3
    footprint: float  # width of the pixel at the hit


@wp.func
def _ray_width(views: ViewRays, row: int, column: int, sample: int) -> float:
    """The width of a pixel at distance 1, from the direction of a neighbour; 0: the neighbour has no ray."""
    step = wp.where(column + 1 < views.columns, 1, -1)
    if views.columns == 1:
        return 0.0
    one = views.rays[row, column, sample, 1]
    other = views.rays[row, column + step, sample, 1]
    if wp.length_sq(other) <= 0.0:
        return 0.0
    return wp.length(other - one)


@wp.func
def view_hit(scene: SceneData, views: ViewRays, view: int, row: int, column: int, sample: int) -> ViewHit:
    """Traces a camera ray of a view."""
    out = ViewHit()
    out.hit.triangle = -1
    pose = views.transforms[view]
    place = wp.transform_get_translation(pose) - views.origin  # first, so that far away little is rounded
    out.origin = (place + wp.transform_vector(pose, views.rays[row, column, sample, 0])) * views.scale
    out.direction = wp.transform_vector(pose, views.rays[row, column, sample, 1])
    squared = wp.dot(out.direction, out.direction)
    # A direction of length 0 is no ray; comparisons with NaN are false.
    if not (squared > 1.0e-12 and wp.isfinite(squared) and wp.isfinite(wp.dot(out.origin, out.origin))):
        return out
    farthest = views.max_distance * views.scale
    start = out.origin
    passed = float(0.0)
    hit = closest(scene, start, out.direction, farthest)
    if views.cull == 1:
        layer = int(0)
        while hit.triangle >= 0 and hit.front == 0 and layer < _MAX_LAYERS:
            start = spawn_ray_origin(scene, hit, wp.normalize(out.direction) - hit.normal)
            passed = wp.dot(start - out.origin, out.direction) / squared
            hit = closest(scene, start, out.direction, farthest - passed)
            layer += 1
    hit.t += passed
    out.hit = hit
    out.footprint = _ray_width(views, row, column, sample) * hit.t
    return out


@wp.func
def _pixel_world(views: ViewRays, paths: WorldPaths, pixel: int) -> int:
    """The world of a pixel, if it is in a slot of this launch; else -1."""
    view = pixel // (views.rows * views.columns)
    slot = views.slot[view] - paths.first_slot
    if views.slot[view] < 0 or slot < 0 or slot >= paths.slots:
        return -1
    return views.world[view]


@wp.func
def _write_nearest(
    views: ViewRays, view: int, pixel: int, ids: wp.array[wp.uint32], seen: ViewHit, n: wp.vec3, out: Outputs
) -> None:
    """Writes the outputs that are those of the nearest sample of a pixel."""
    if out.depth.shape[0] > 0:
        out.depth[pixel] = seen.hit.t / views.scale
    if out.forward_depth.shape[0] > 0:
        pose = views.transforms[view]
        forward = wp.transform_vector(pose, wp.vec3(0.0, 0.0, -1.0))
        to_origin = seen.origin / views.scale - (wp.transform_get_translation(pose) - views.origin)
        along = wp.dot(seen.direction, forward) * seen.hit.t / views.scale
        out.forward_depth[pixel] = wp.dot(to_origin, forward) + along
    if out.normal.shape[0] > 0:
        out.normal[pixel] = n
    if out.shape_index.shape[0] > 0:
        out.shape_index[pixel] = ids[wp.max(seen.hit.instance, 0)]


@wp.func
def _clear_nearest(pixel: int, clear: Clear, out: Outputs) -> None:
    """Clears the outputs that `_write_nearest` writes."""
    if out.depth.shape[0] > 0:
        out.depth[pixel] = clear.depth
    if out.forward_depth.shape[0] > 0:
        out.forward_depth[pixel] = clear.depth
    if out.normal.shape[0] > 0:
        out.normal[pixel] = clear.normal
    if out.shape_index.shape[0] > 0:
        out.shape_index[pixel] = clear.shape_index


@wp.func
def _keep_surface(views: ViewRays, pixel: int, seen: ViewHit, normal: wp.vec3, out: NearestSurfaces) -> None:
    """Writes what `NearestSurfaces` has of a pixel."""
    out.instance[pixel] = seen.hit.instance
    out.triangle[pixel] = seen.hit.triangle
    out.barycentric[pixel] = wp.vec2(seen.hit.u, seen.hit.v)
    out.position[pixel] = seen.hit.position
    out.normal[pixel] = normal
    out.footprint[pixel] = seen.footprint
    out.sample[pixel] = views.sample


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _trace_views(
    first: int,
    worlds: wp.array[SceneData],
    views: ViewRays,
    ids: wp.array[wp.uint32],
    clear: Clear,
    gbuffer: GBuffer,
    sums: ViewSums,
    out: Outputs,
) -> None:
    """Traces a camera ray into the G-buffer, where the mesh is -1 for a miss, and writes what the nearest one sees."""
    pixel = first + wp.tid()
    view = pixel // (views.rows * views.columns)
    place = pixel - view * (views.rows * views.columns)
    world = views.world[view]
    gbuffer.mesh[pixel] = -1
    gbuffer.depth[pixel] = 0.0
    if views.sample == 0:
        sums.nearest[pixel] = _INFINITY
        sums.albedo[pixel] = wp.vec4(0.0)
        if sums.emission.shape[0] > 0:
            sums.emission[pixel] = wp.vec3(0.0)
        if world != DISABLE_PRESERVE:
            _clear_nearest(pixel, clear, out)
    if world < 0:
        return
    scene = worlds[world]
    seen = view_hit(scene, views, view, place // views.columns, place % views.columns, views.sample)
    hit = seen.hit
    if hit.triangle < 0:
        return
    normal = shading_normal(scene, hit)
    rho = albedo(scene, hit, seen.footprint)
    gbuffer.mesh[pixel] = scene.triangle_mesh[hit.triangle]
    gbuffer.position[pixel] = hit.position
    gbuffer.normal_or_direct[pixel] = hit.normal
    gbuffer.smooth_normal[pixel] = normal
    mapped = mapped_normal(scene, hit, normal, seen.footprint)
    gbuffer.shading_normal[pixel] = mapped
    gbuffer.albedo[pixel] = rho
    gbuffer.depth[pixel] = seen.footprint  # all that is asked of it here
    sums.albedo[pixel] += wp.vec4(rho[0], rho[1], rho[2], 1.0)
    if gbuffer.smooth_height.shape[0] > 0:
        gbuffer.smooth_height[pixel] = smooth_height(scene, hit, normal)
    if gbuffer.emission.shape[0] > 0:
        emitted = emission_to_camera(scene, hit, wp.normalize(seen.direction), seen.footprint)
        gbuffer.emission[pixel] = emitted
        sums.emission[pixel] += emitted
    if hit.t < sums.nearest[pixel]:
        sums.nearest[pixel] = hit.t
        _write_nearest(views, view, pixel, ids, seen, mapped, out)
        if sums.surfaces.instance.shape[0] > 0:
            _keep_surface(views, pixel, seen, normal, sums.surfaces)


@wp.func
def _add_light(
    sums: ViewSums, gbuffer: GBuffer, pixel: int, is_first: bool, direct: wp.vec3, indirect: wp.vec3
) -> None:
    """Adds the light of an iteration to the sums of a pixel; the first of a picture replaces them."""
    new_direct = direct
    new_indirect = indirect
    radiance = wp.vec3(0.0)
    if gbuffer.mesh[pixel] >= 0:
        radiance = wp.cw_mul(gbuffer.albedo[pixel], direct + indirect)
        if gbuffer.emission.shape[0] > 0:
            radiance += gbuffer.emission[pixel]
    mean = (radiance[0] + radiance[1] + radiance[2]) / 3.0
    square = mean * mean
    if not is_first:
        radiance += sums.radiance[pixel]
    sums.radiance[pixel] = radiance
    if sums.square.shape[0] > 0:
        if not is_first:
            square += sums.square[pixel]
        sums.square[pixel] = square
    if sums.direct.shape[0] > 0:
        means = wp.vec2(direct[0] + direct[1] + direct[2], indirect[0] + indirect[1] + indirect[2]) / 3.0
        squares = wp.cw_mul(means, means)
        if not is_first:
            new_direct += sums.direct[pixel]
            new_indirect += sums.indirect[pixel]
            squares += sums.squares[pixel]
        sums.direct[pixel] = new_direct
        sums.indirect[pixel] = new_indirect
        sums.squares[pixel] = squares


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _gather_views(
    first: int,
    worlds: wp.array[SceneData],
    views: ViewRays,
    paths: WorldPaths,
    gbuffer: GBuffer,
    vpl_sets: wp.array2d[VplSets],
    settings: GatherSettings,
    sums: ViewSums,
) -> None:
    """Adds the light that a pixel receives from the VPLs of its world to its sums."""
    pixel = first + wp.tid()
    world = _pixel_world(views, paths, pixel)
    if world < 0:
        return
    irradiance = Irradiance()
    view = pixel // (views.rows * views.columns)
    if gbuffer.mesh[pixel] >= 0:
        if wp.max(gbuffer.albedo[pixel]) > 0.0:
            place = pixel - view * (views.rows * views.columns)
            slot = views.slot[view] - paths.first_slot
            own = settings
            own.scramble = paths.scramble[slot]
            index = sobol.index_of_pixel(place % views.columns, place // views.columns, gather_scramble(own))
            x = camera_vertex(gbuffer, pixel)
            irradiance = gather_path(worlds[world], vpl_sets[slot], own, x, index, False, Irradiance())
    is_first = sums.count[view] + paths.iteration == 0
    _add_light(sums, gbuffer, pixel, is_first, irradiance.direct / wp.pi, irradiance.indirect / wp.pi)
