"""Gathering in waves of pixels, a kernel for each step, as a GPU is best used (Laine, Karras and Aila 2013).

In one kernel a thread keeps the registers of its most demanding step for all others, and the 32 threads of a warp wait
for the longest path. In a wave, up to 2²⁰ pixels pass through one step after the other:

    order the pixels by the set of VPLs that they evaluate     _write_keys, and a radix sort
    draw VPLs in proportion to their contribution              _draw_vpls      no rays, few registers
    send a shadow ray to each of them                          _send_shadow_rays
    send the compensation ray                                  _compensate
    follow the paths that it continues                         `_gather_pixels` of `estimators.vpl`

The threads of a warp have pixels of one set: they load the same VPL at the same time. Neighbouring pixels have
different sets, so without an order a warp would load up to 32 of them. Pixels that reflect nothing are sorted to the
end. A pixel gets the same samples in any order, and its result is the same.

Each step's number of threads is known to the host: it reads nothing back.
"""

from collections.abc import Sequence
from typing import Any

import warp as wp

from warp_ir.device.launcher import MAX_REGISTERS
from warp_ir.device.scratch import Scratch
from warp_ir.device_scene import SceneData
from warp_ir.gbuffer import GBuffer, camera_vertex, reflecting_pixel
from warp_ir.lights import Bound, clamped_fraction, clamped_light_radiance, clamped_surface_radiance
from warp_ir.sampling import sobol
from warp_ir.sampling.square_to import square_to_cosine_hemisphere
from warp_ir.surface import Hit, ShadingPoint, closest, geometry_term_of_hit, shadow_ray_origin
from warp_ir.tiles import indices, pixel_at
from warp_ir.vpl.gather import MAX_RAYS, draw_slots, slot_contribution
from warp_ir.vpl.sets import MAX_SETS, ON_LIGHTS, ON_SURFACES, VplSets
from warp_ir.vpl.visibility import TileVisibility, tile_of

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

MAX_WAVE = 2**20
"""Largest number of pixels of a wave: several times what a GPU runs at once. A wave takes some 120 bytes a pixel."""
_GATHER_STREAM = wp.constant(wp.uint32(0x5BD1E995))  # decorrelates gathering from the light paths
_KEY_BITS = MAX_SETS.bit_length()
_REFLECTS_NOTHING = wp.constant(MAX_SETS)
"""Sort key of a pixel that evaluates no set; those of others are smaller."""


@wp.struct
class GatherSettings:
    """Parameters of the gathering kernels."""

    first_column: int  # of the film in the image, as in `CameraData`
    first_row: int
    scramble: wp.array[wp.uint32]  # [1], that of the light paths
    rays: wp.vec2i  # shadow rays to VPLs on lights and on surfaces
    compensation_rays: wp.vec2i  # shadow rays at the end of a compensation ray
    max_bounces: int
    visibility: TileVisibility  # its `rays` take the place of `rays` at what the camera sees


@wp.struct
class Wave:
    """The pixels of a wave, and what is known of each. Of two halves, one is about VPLs on lights, one on surfaces."""

    size: int  # pixels, background included; 0: there is no wave
    begin: int  # index of the first in a launch over the tiles
    keys: wp.array[wp.int32]  # [2 size], the sets of the pixels in order; the sort needs twice the memory
    order: wp.array[wp.int32]  # [2 size], sorted by the keys: what to add to `begin`
    slots: wp.array[wp.int32]  # [rays, 2 size], drawn VPLs
    per_ray: wp.array[wp.float32]  # [2 size], S/M of `draw_slots` times the number of sets
    irradiance: wp.array[wp.vec3]  # [2 size], at the camera vertex
    continues: wp.array[wp.int32]  # [size], 1: the path goes on
    ends: wp.array[wp.int32]  # [size], number of paths that go on up to this one
    paths: wp.array[wp.int32]  # those that go on, as places in the order


@wp.func
def gather_scramble(settings: GatherSettings) -> wp.uint32:
    """The scramble of the pixels' sequence."""
    return settings.scramble[0] ^ _GATHER_STREAM


@wp.func
def sample_index(settings: GatherSettings, gbuffer: GBuffer, pixel: int) -> int:
    """The index of a pixel's point of the sequence, by its place in the image: a crop has the same pixels."""
    column = settings.first_column + pixel % gbuffer.tiles.columns
    row = settings.first_row + pixel // gbuffer.tiles.columns
    return sobol.index_of_pixel(column, row, gather_scramble(settings))


@wp.func
def lit_vertex(settings: GatherSettings, gbuffer: GBuffer, pixel: int) -> ShadingPoint:
    """The `camera_vertex` of a pixel, with what is known of the visibility of VPLs there."""
    x = camera_vertex(gbuffer, pixel)
    column = settings.first_column + pixel % gbuffer.tiles.columns
    row = settings.first_row + pixel // gbuffer.tiles.columns
    x.tile = tile_of(settings.visibility, column, row)
    return x


@wp.func
def shadow_rays(settings: GatherSettings, x: ShadingPoint) -> wp.vec2i:
    """Numbers of shadow rays to VPLs on lights and on surfaces, from a point that the camera sees."""
    if x.tile >= 0:
        return settings.visibility.rays[x.tile]
    return settings.rays


@wp.struct
class Compensation:
    """What a compensation ray finds."""

    emitted: wp.vec3  # radiance that the bound took away
    clamped: float  # weight of the light that is reflected at the hit; 0: none
    hit: Hit


@wp.func
def compensate(scene: SceneData, x: ShadingPoint, v: wp.vec2, bound: Bound) -> Compensation:
    """Sends the compensation ray of a point, whose direction is given by two random numbers `v`."""
    out = Compensation()
    direction = square_to_cosine_hemisphere(v, x.shading_normal)
    if wp.dot(direction, x.normal) <= 0.0:
        return out
    radius = 1.0 / wp.sqrt(bound.minimum)  # length of compensation rays: farther away G cannot exceed the bound
    cosine = wp.dot(direction, x.shading_normal)
    origin = shadow_ray_origin(x, wp.vec4(direction[0], direction[1], direction[2], 0.0))
    out.hit = closest(scene, origin, direction, radius)
    t_max = wp.where(out.hit.triangle < 0, radius, out.hit.t)
    out.emitted = clamped_light_radiance(scene, x, direction, t_max, cosine, bound, radius)
    if out.hit.triangle >= 0:
        g = geometry_term_of_hit(x, direction, out.hit)
        out.clamped = clamped_fraction(bound.minimum, g[0]) * g[1]
        if out.clamped > 0.0:
            out.emitted += clamped_surface_radiance(scene, out.hit, direction, g[0], bound, x.mesh) * g[1]
    return out


@wp.func
def wave_pixel(gbuffer: GBuffer, wave: Wave, i: int) -> int:
    """The pixel at place `i` of the order; -1 if it reflects nothing."""
    if wave.keys[i] >= _REFLECTS_NOTHING:
        return -1
    return pixel_at(gbuffer.tiles, wave.begin + wave.order[i])


@wp.func
def continuing_paths(wave: Wave) -> int:
    """Number of paths that go on."""
    return wave.ends[wave.size - 1]


@wp.kernel
def _write_keys(
    first: int, scene: SceneData, gbuffer: GBuffer, vpl_sets: wp.array[VplSets], settings: GatherSettings, wave: Wave
) -> None:
    """Writes the set of a pixel, of the kind that has more sets; those of the other kind are unions of these."""
    i = first + wp.tid()
    wave.order[i] = i
    wave.keys[i] = _REFLECTS_NOTHING
    pixel = reflecting_pixel(gbuffer, wave.begin + i)
    if pixel >= 0:
        index = sample_index(settings, gbuffer, pixel)
        sets = wp.max(vpl_sets[ON_LIGHTS].sets, vpl_sets[ON_SURFACES].sets)
        wave.keys[i] = int(sobol.sample_1d(scene.sobol, index, 0, gather_scramble(settings)) * float(sets))


@wp.kernel
def _draw_vpls(
    first: int, scene: SceneData, gbuffer: GBuffer, vpl_sets: wp.array[VplSets], settings: GatherSettings, wave: Wave
) -> None:
    """Draws the VPLs of one pixel and kind that get a shadow ray."""
    thread = first + wp.tid()
    kind = thread // wave.size
    i = thread - kind * wave.size
    pixel = wave_pixel(gbuffer, wave, i)
    if pixel < 0:
        return
    index = sample_index(settings, gbuffer, pixel)
    u_set = sobol.sample_1d(scene.sobol, index, 0, gather_scramble(settings))
    u = sobol.sample_1d(scene.sobol, index, 1 + kind, gather_scramble(settings))
    x = lit_vertex(settings, gbuffer, pixel)
    group = vpl_sets[kind]
    set_index = int(u_set * float(group.sets))
    per_ray = draw_slots(group, set_index, x, u, shadow_rays(settings, x)[kind], wave.slots, thread, 2 * wave.size)
    wave.per_ray[thread] = per_ray * float(group.sets)


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _send_shadow_rays(
    first: int, scene: SceneData, gbuffer: GBuffer, vpl_sets: wp.array[VplSets], settings: GatherSettings, wave: Wave
) -> None:
    """Sums the contributions of the visible ones of the VPLs that were drawn for one pixel and kind."""
    thread = first + wp.tid()
    kind = thread // wave.size
    i = thread - kind * wave.size
    pixel = wave_pixel(gbuffer, wave, i)
    if pixel < 0:
        return
    x = lit_vertex(settings, gbuffer, pixel)
    per_ray = wave.per_ray[thread]
    out = wp.vec3(0.0)
    if per_ray > 0.0:
        for k in range(shadow_rays(settings, x)[kind]):
            slot = wave.slots[thread + 2 * wave.size * k]
            if slot >= 0:
                out += slot_contribution(scene, vpl_sets[kind], x, slot, per_ray, settings.max_bounces)
    wave.irradiance[thread] = out


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _compensate(
    first: int, scene: SceneData, gbuffer: GBuffer, vpl_sets: wp.array[VplSets], settings: GatherSettings, wave: Wave
) -> None:
    """Sends the compensation ray from the camera vertex of one pixel, and completes the pixel if its path ends there.

    A path that goes on is begun again by who follows it: to send the ray twice takes less than to store what it found.
    """
    i = first + wp.tid()
    wave.continues[i] = 0
    pixel = wave_pixel(gbuffer, wave, i)
    if pixel < 0:
        return
    index = sample_index(settings, gbuffer, pixel)
    v = sobol.sample_2d(scene.sobol, index, 3, gather_scramble(settings))
    compensation = compensate(scene, camera_vertex(gbuffer, pixel), v, vpl_sets[ON_LIGHTS].bound)
    if compensation.clamped > 0.0:
        wave.continues[i] = 1
        return
    gbuffer.normal_or_direct[pixel] = (wave.irradiance[i] + compensation.emitted * wp.pi) / wp.pi
    gbuffer.indirect[pixel] = wave.irradiance[wave.size + i] / wp.pi


@wp.kernel
def _list_continuing(first: int, wave: Wave) -> None:
    """Lists a path that goes on, after those before it."""
    i = first + wp.tid()
    if wave.continues[i] == 1:
        wave.paths[wave.ends[i] - 1] = i


def gather_in_waves(continue_paths: Any, inputs: Sequence[Any], scratch: Scratch) -> None:
    """Fills in the irradiance over π of all pixels.

    Args:
        continue_paths: The kernel that follows the paths that go on after the first compensation ray.
        inputs: The kernels' arguments: the scene's data, the G-buffer, the VPLs and the `GatherSettings`.
        scratch: Owner of the arrays of the wave.
    """
    launcher, gbuffer = scratch.launcher, inputs[1]
    count = indices(gbuffer.tiles)
    for begin in range(0, count, MAX_WAVE):
        wave = _new_wave(begin, min(MAX_WAVE, count - begin), MAX_RAYS, scratch)
        launcher.launch(_write_keys, wave.size, [*inputs, wave])
        wp.utils.radix_sort_pairs(wave.keys, wave.order, wave.size, end_bit=_KEY_BITS)
        launcher.launch(_draw_vpls, 2 * wave.size, [*inputs, wave])
        launcher.launch(_send_shadow_rays, 2 * wave.size, [*inputs, wave])
        launcher.launch(_compensate, wave.size, [*inputs, wave])
        wp.utils.array_scan(wave.continues[: wave.size], wave.ends[: wave.size], inclusive=True)
        launcher.launch(_list_continuing, wave.size, [wave])
        launcher.launch(continue_paths, wave.size, [*inputs, wave])


def _new_wave(begin: int, size: int, rays: int, scratch: Scratch) -> Wave:
    wave = Wave()
    wave.begin, wave.size = begin, size
    for name, rows, dtype in (
        ("keys", 2, wp.int32),
        ("order", 2, wp.int32),
        ("slots", 2 * rays, wp.int32),
        ("per_ray", 2, wp.float32),
        ("irradiance", 2, wp.vec3),
        ("continues", 1, wp.int32),
        ("ends", 1, wp.int32),
        ("paths", 1, wp.int32),
    ):
        setattr(wave, name, scratch.array(f"wave.{name}", rows * size, dtype))
    return wave
