"""Learning which VPLs are visible from where in the picture: a shadow ray for each section of a set, from each tile.

Sixteen points of a tile of 8 x 8 pixels, as the camera sees them, send 64 shadow rays to VPLs on lights and 64 to VPLs
on surfaces, one to each section of a set (`vpl.visibility`): two rays per pixel, once for a view. A section's visible
share is that of its rays from the tile and from those around it, weighted by nearness, and of the tile's mean.

The same rays divide a pixel's shadow rays between lights and surfaces, in proportion to the standard deviation that
visibility causes in the light of either kind.
"""

import warp as wp

from warp_ir.device.launcher import MAX_REGISTERS, Launcher, copy_record
from warp_ir.device_scene import CameraData, SceneData
from warp_ir.gbuffer import camera_ray, first_hit, vertex_of_hit
from warp_ir.lights import light_visibility
from warp_ir.sampling import sobol
from warp_ir.surface import ShadingPoint
from warp_ir.tiles import TILE
from warp_ir.vpl.gather import slot_weight
from warp_ir.vpl.guide import Guide
from warp_ir.vpl.sets import VplSets
from warp_ir.vpl.visibility import CELLS, CELLS_OF_LANE, TileVisibility, nothing_learned, section_begin

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_CELLS = wp.constant(CELLS)
_LANES = wp.constant(CELLS // CELLS_OF_LANE)
_POINTS = wp.constant(16)
"""Points of a tile: every other column and row."""
RADIUS = 2
"""How far away tiles count, in tiles."""
_RADIUS = wp.constant(RADIUS)
_NEARNESS = wp.constant(0.6)
"""Weight of a neighbouring tile; that of one further away is a power of it."""
_PRIOR = wp.constant(0.3)
"""Number of rays for which the tile's mean counts."""
_RAYS = wp.constant(8)
"""Shadow rays of a pixel, at least one to either kind."""
_OTHER_VARIANCE = wp.constant(0.05)
"""Squared relative deviation of light whose visibility is certain, by rounding to few rays and by colours."""
_PROBE_RAYS = (1 << 32) + 3
"""Iteration number for the scramble, larger than those of any render."""


vec64 = wp.types.vector(length=CELLS, dtype=wp.float32)


@wp.struct
class TileRange:
    """Tiles of the image, row by row."""

    first_column: int
    first_row: int
    columns: int
    rows: int


@wp.struct
class ProbedTiles:
    """What the rays from each tile of a range found; one row for VPLs on lights, one for those on surfaces."""

    tiles: TileRange
    sent: wp.array[wp.uint64]  # [tiles, 2], a bit for each section to which a ray was sent
    arrived: wp.array[wp.uint64]  # and where it arrived
    light: wp.array[wp.vec2]  # [tiles, 2], sum of the light of all sections, and of those where the ray arrived


@wp.struct
class DrawnVpl:
    """A VPL of a section."""

    slot: int  # -1: none of the section contributes
    light: float  # contribution of the section


@wp.func
def _draw_vpl(group: VplSets, cell: int, x: ShadingPoint, seed: wp.uint32) -> DrawnVpl:
    """Draws a VPL of a section of a random set by its contribution."""
    begin = int(sobol.hash_combine(seed, wp.uint32(0)) % wp.uint32(group.sets)) * group.blocks * _LANES
    begin += cell // CELLS_OF_LANE * group.blocks
    section = cell % CELLS_OF_LANE
    u = sobol.to_unit(sobol.hash_combine(seed, wp.uint32(1)))
    total = float(0.0)
    slot = int(-1)
    for k in range(section_begin(section, group.blocks), section_begin(section + 1, group.blocks)):
        if begin + k < group.count:
            weight = slot_weight(group, begin + k, x)
            if weight > 0.0:
                total += weight
                # One pass: each takes the place of those before it with the probability that its weight asks for.
                u = u * total
                if u < weight:
                    slot = begin + k
                    u = u / weight
                else:
                    u = (u - weight) / (total - weight)
    out = DrawnVpl()
    out.slot = slot
    out.light = total
    return out


@wp.func
def _is_visible(scene: SceneData, group: VplSets, x: ShadingPoint, slot: int) -> bool:
    vpl = group.order[slot]
    modifiers = int(-1)
    if scene.modifier_count > 0 and vpl < group.vpls.on_lights:
        modifiers = group.vpls.modifiers[vpl]
    return wp.max(light_visibility(scene, modifiers, x, group.vpls.position[vpl])) > 0.0


@wp.func
def _probe_section(
    scene: SceneData, group: VplSets, cell: int, x: ShadingPoint, seed: wp.uint32, probed: ProbedTiles, row: int
) -> None:
    """Sends a ray to a VPL of a section, and notes in a row what it finds; nothing if none of them contributes."""
    drawn = _draw_vpl(group, cell, x, seed)
    if drawn.slot < 0:
        return
    bit = wp.uint64(1) << wp.uint64(cell)
    light = drawn.light * float(group.sets)
    seen = float(0.0)
    probed.sent[row] = probed.sent[row] | bit
    if _is_visible(scene, group, x, drawn.slot):
        probed.arrived[row] = probed.arrived[row] | bit
        seen = light
    probed.light[row] = probed.light[row] + wp.vec2(light, seen)


@wp.kernel(module="warp_ir.vpl.emission", cuda_max_registers=MAX_REGISTERS)  # reuses functions compiled there
def _probe_tiles(
    first: int,
    scene: SceneData,
    camera: CameraData,
    vpl_sets: wp.array[VplSets],
    seed: wp.uint32,
    probed: ProbedTiles,
) -> None:
    """Sends the rays of one tile. `camera` has the whole image as its film."""
    i = first + wp.tid()
    tile_column = probed.tiles.first_column + i % probed.tiles.columns
    tile_row = probed.tiles.first_row + i // probed.tiles.columns
    seed = sobol.hash_combine(sobol.hash_combine(seed, wp.uint32(tile_column)), wp.uint32(tile_row))
    for kind in range(2):
        probed.sent[2 * i + kind] = wp.uint64(0)
        probed.arrived[2 * i + kind] = wp.uint64(0)
        probed.light[2 * i + kind] = wp.vec2(0.0)
    for point in range(_POINTS):
        column = wp.min(TILE * tile_column + 2 * (point % 4), camera.columns - 1)
        row = wp.min(TILE * tile_row + 2 * (point // 4), camera.rows - 1)
        ray = camera_ray(camera, row * camera.columns + column, wp.vec2(0.5, 0.5), wp.vec2(0.0, 0.0))
        hit = first_hit(scene, camera, ray)
        if hit.triangle >= 0:
            x = vertex_of_hit(scene, hit)
            for ray_of_point in range(2 * _CELLS // _POINTS):
                kind = ray_of_point % 2
                # In another tile the same point probes other sections.
                lane = (point + int(seed % wp.uint32(_LANES))) % _LANES
                cell = CELLS_OF_LANE * lane + ray_of_point // 2
                if vpl_sets[kind].count > 0:
                    ray_seed = sobol.hash_combine(seed, wp.uint32(2 * cell + kind))
                    _probe_section(scene, vpl_sets[kind], cell, x, ray_seed, probed, 2 * i + kind)


@wp.func_native("""
    for (int k = 0; k < 64; ++k) counts[k] += (bits >> k) & 1u ? weight : 0.0f;
    return counts;
""")
def _add_bits(counts: vec64, bits: wp.uint64, weight: float) -> vec64:
    """The counts of the sections, with a weight added to those whose bits are set."""
    ...


@wp.func
def _learn_kind(probed: ProbedTiles, kind: int, column: int, row: int, factors: wp.array[wp.float32], to: int) -> float:
    """Writes the factors of VPLs of one kind for a tile, and returns the deviation that visibility causes."""
    sent = vec64()
    arrived = vec64()
    light = wp.vec2(0.0)
    tiles = probed.tiles
    for y in range(wp.max(row - _RADIUS, 0), wp.min(row + _RADIUS + 1, tiles.rows)):
        for x in range(wp.max(column - _RADIUS, 0), wp.min(column + _RADIUS + 1, tiles.columns)):
            weight = float(1.0)
            for _ in range(wp.abs(x - column) + wp.abs(y - row)):
                weight *= _NEARNESS
            at = 2 * (y * tiles.columns + x) + kind
            sent = _add_bits(sent, probed.sent[at], weight)
            arrived = _add_bits(arrived, probed.arrived[at], weight)
            light += weight * probed.light[at]
    total_sent = float(0.0)
    total_arrived = float(0.0)
    for cell in range(_CELLS):
        total_sent += sent[cell]
        total_arrived += arrived[cell]
    mean = (total_arrived + 1.0) / (total_sent + 2.0)
    for cell in range(_CELLS):
        share = (arrived[cell] + _PRIOR * mean) / (sent[cell] + _PRIOR)
        factors[to + cell % CELLS_OF_LANE * _LANES + cell // CELLS_OF_LANE] = wp.sqrt(share)
    visible = float(0.0)
    if light[0] > 0.0:
        visible = light[1] / light[0]
    return light[0] * wp.sqrt(visible * (1.0 - visible) + _OTHER_VARIANCE * visible)


@wp.kernel(module="warp_ir.vpl.emission", cuda_max_registers=128)  # counts of sections may lie in local memory
def _learn_tiles(first: int, probed: ProbedTiles, learned: TileVisibility) -> None:
    """Learns from the rays of a tile and of those around it."""
    i = first + wp.tid()
    column = learned.first_column - probed.tiles.first_column + i % learned.columns
    row = learned.first_row - probed.tiles.first_row + i // learned.columns
    to_lights = _learn_kind(probed, 0, column, row, learned.to_lights, _CELLS * i)
    to_surfaces = _learn_kind(probed, 1, column, row, learned.to_surfaces, _CELLS * i)
    share = float(0.5)
    if to_lights + to_surfaces > 0.0:
        share = to_lights / (to_lights + to_surfaces)
    rays = wp.clamp(int(wp.round(share * float(_RAYS))), 1, _RAYS - 1)
    learned.rays[i] = wp.vec2i(rays, _RAYS - rays)


def new_visibility(camera: CameraData, launcher: Launcher) -> TileVisibility:
    """The record of the tiles that a film shows, whose arrays are uninitialised."""
    out = nothing_learned(launcher)
    columns = _tile_interval(camera.first_column, camera.columns, camera.image_columns)
    rows = _tile_interval(camera.first_row, camera.rows, camera.image_rows)
    out.first_column, out.first_row = columns[0], rows[0]
    out.columns, out.rows = columns[1] - columns[0], rows[1] - rows[0]
    count = out.columns * out.rows
    out.to_lights = launcher.empty(CELLS * count, wp.float32)
    out.to_surfaces = launcher.empty(CELLS * count, wp.float32)
    out.rays = launcher.empty(count, wp.vec2i)
    return out


def learn_visibility(
    guide: Guide, camera: CameraData, launcher: Launcher, vpl_sets: wp.array[VplSets], seed: int
) -> None:
    """Fills in what the tiles of `guide.visibility` see of VPLs that the guide has made.

    What a tile learns depends on its place in the image alone: a data window learns what the whole picture does.
    """
    whole, learned, probed = copy_record(camera), guide.visibility, ProbedTiles()
    whole.columns, whole.rows, whole.first_column, whole.first_row = camera.image_columns, camera.image_rows, 0, 0
    tiles = TileRange()
    tiles.first_column, tiles.columns = _widened(learned.first_column, learned.columns, camera.image_columns)
    tiles.first_row, tiles.rows = _widened(learned.first_row, learned.rows, camera.image_rows)
    count = tiles.columns * tiles.rows
    probed.tiles = tiles
    probed.sent, probed.arrived = launcher.empty(2 * count, wp.uint64), launcher.empty(2 * count, wp.uint64)
    probed.light = launcher.empty(2 * count, wp.vec2)
    scramble = sobol.iteration_scramble(seed, _PROBE_RAYS)
    launcher.launch(_probe_tiles, count, [guide.scene.data, whole, vpl_sets, wp.uint32(scramble), probed])
    launcher.launch(_learn_tiles, learned.columns * learned.rows, [probed, learned])


def _tile_interval(first: int, count: int, size: int) -> tuple[int, int]:
    """The tiles, from the first to behind the last, that show some pixels of an image; those nearest if none does."""
    begin, last = (min(max(pixel, 0), size - 1) // TILE for pixel in (first, first + count - 1))
    return begin, last + 1


def _widened(first: int, count: int, size: int) -> tuple[int, int]:
    """The first of the tiles of the image that count for some of them, and their number."""
    begin, end = max(first - RADIUS, 0), min(first + count + RADIUS, -(-size // TILE))
    return begin, end - begin
