"""Emission: light paths, and the virtual point lights (VPLs) at their vertices (Keller 1997).

A light path starts at a random point of a random emitter and is reflected diffusely until it ends. Each of its vertices
is a VPL: the one on the emitter carries direct light (bounce 0), the one after j reflections the j-th term of the
Neumann series. With Φ the flux [W] that arrives at a vertex y of albedo ρ,

    I = Φ ρ/π  [W/sr]        L(x) = ρ(x)/π Σ I G(x, y) V(x, y)        G = cos⁺θ_x cos⁺θ_y / |x - y|²

A VPL lights only the side that its normal faces. The flux is divided by the number of light paths started, not by the
number of VPLs stored.
"""

import math

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import MAX_REGISTERS
from warp_ir.device.scratch import Scratch
from warp_ir.device_scene import DeviceScene, SceneData
from warp_ir.lights import EmitterSample, PhotonTarget, emit_photon, first_reflection, sample_light
from warp_ir.sampling import sobol
from warp_ir.sampling.square_to import square_to_cosine_hemisphere
from warp_ir.surface import Hit, albedo, closest, scene_at
from warp_ir.vpl.guide import (
    Guide,
    ViewImportance,
    floor_at_emission,
    floor_from,
    importance_at,
    path_survival,
    survival_probability,
)

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

MAX_SURVIVAL = 0.999
"""Largest survival probability of Russian roulette, so that paths end even where nothing absorbs."""
_MAX_SURVIVAL = wp.constant(MAX_SURVIVAL)
_MAX_REFLECTIVITY = 0.98
"""Largest mean reflectivity of fractional absorption, for the same reason."""
# Sample dimensions: 0-1 point on the emitter (the best pair), 2 which emitter, 3-4 direction, 5-6 where a photon of a
# light at infinity enters the scene, then three for every bounce: direction and roulette.
_FIRST_BOUNCE_DIMENSION = wp.constant(7)
_FIRST_REFLECTION_DIMENSION = wp.constant(1 << 20)  # far from the dimensions of any bounce
_SURVIVAL_STREAM = wp.constant(wp.uint32(0x9E6C63D0))  # decorrelates the survival of VPLs from the light paths
_THINNING_STREAM = wp.constant(wp.uint32(0x7FEB352D))  # decorrelates the thinning of VPLs from the light paths
_CHOICE_STREAM = wp.constant(wp.uint32(0x1B873593))  # decorrelates the choice of a direction from the directions
# Candidates are the path's own sample, shifted along a lattice that fills the square evenly however many there are
# (the additive recurrence of the plastic number, Roberts 2018).
_LATTICE = wp.constant(wp.vec2(0.7548776662466927, 0.5698402909980532))
_RETRACED_SHARE = 0.02
"""Approximate share of the light paths that are longer than what is recorded of them."""
_MAX_RECORDED = 2**22
"""Largest number of recorded reflections, 48 bytes each."""
CAPACITY_PER_PATH = 8
"""Least capacity for VPLs on surfaces, per light path: their mean number where 8/9 of the light is reflected."""
_MAX_CAPACITY = 2**26
"""Largest capacity for VPLs on surfaces, 64 bytes each."""


@wp.struct
class VplBuffer:
    """VPLs in the scene's device frame: first those on lights, then those on surfaces, path by path.

    Positions and normals are homogeneous, as `lights` defines them. Only the device knows how many VPLs there are: the
    host would have to wait for the number.
    """

    count: wp.array[wp.int32]  # [1], number of VPLs
    capacity: int  # rows available, at least `count`; equal on the CPU, where reading `count` is free
    on_lights: int  # number of VPLs on lights
    position: wp.array[wp.vec4]
    normal: wp.array[wp.vec4]
    intensity: wp.array[wp.vec3]  # [W/sr]; [W/m²] where w = 0
    bounce: wp.array[wp.int32]  # reflections before the VPL; 0 on lights
    pdf_area: wp.array[wp.float32]  # [on_lights], area pdf of the point on the light; 0 where the light has no area
    lifted: int  # 1: in an uneven scene, where `lift` is defined
    lift: wp.array[wp.float32]  # factor of the weight with which a VPL is drawn
    modifiers: wp.array[wp.int32]  # [on_lights], row of the light's `LightModifiers`, or -1; one row if none has any


@wp.struct
class LightPathSettings:
    """How light paths are sampled, how they end, and how many of their VPLs can be stored."""

    scramble: wp.array[wp.uint32]  # [1], on the device, so that iterations differ in it alone
    paths: int  # light paths started
    on_lights: int  # number of light paths, the first ones, whose point on the light is stored as a VPL
    max_bounces: int
    fractional: int  # 1: fractional absorption by `survivors`; 0: Russian roulette by the local albedo
    survivors: wp.array[wp.int32]  # [levels], number of paths that are reflected j times
    levels: int
    recorded: int  # VPLs of a path that are recorded while it is traced
    again: int  # 1: this launch follows the paths again that have more
    capacity: int  # for VPLs on surfaces; if there are more, an even selection of them stands for all
    photon_target: PhotonTarget
    importance: ViewImportance


@wp.func
def _survival_sample(scramble: wp.uint32, path: int, bounce: int) -> float:
    """A uniform number in [0, 1) for each VPL, independent of the light path's own samples."""
    bits = sobol.hash_combine(sobol.hash_combine(scramble ^ _SURVIVAL_STREAM, wp.uint32(path)), wp.uint32(bounce))
    return sobol.to_unit(bits)


@wp.func
def surface_row(settings: LightPathSettings, number: int, total: int) -> int:
    """The row of VPL `number` of `total` on surfaces; -1: it is dropped, because not all of them can be stored.

    Systematic sampling: the stored VPLs are spread evenly, and each is stored with the same probability.
    """
    if total <= settings.capacity:
        return settings.on_lights + number
    offset = sobol.hash_combine(settings.scramble[0] ^ _THINNING_STREAM, wp.uint32(0)) % wp.uint32(total)
    before = (wp.int64(number) * wp.int64(settings.capacity) + wp.int64(offset)) // wp.int64(total)
    after = (wp.int64(number + 1) * wp.int64(settings.capacity) + wp.int64(offset)) // wp.int64(total)
    return wp.where(after > before, settings.on_lights + int(before), -1)


@wp.func
def thinning_weight(settings: LightPathSettings, total: int) -> float:
    """Factor of a stored VPL's intensity that makes up for the VPLs that could not be stored."""
    if total <= settings.capacity:
        return 1.0
    return float(total) / float(settings.capacity)


@wp.struct
class _Segment:
    """A segment of a light path."""

    hit: Hit  # where it ends
    direction: wp.vec3
    flux: wp.vec3  # [W], that arrives


@wp.func
def _shifted(u: wp.vec2, candidate: int) -> wp.vec2:
    shift = float(candidate) * _LATTICE
    return wp.vec2(wp.frac(u[0] + shift[0]), wp.frac(u[1] + shift[1]))


@wp.func
def _trace_segment(
    scene: SceneData,
    settings: LightPathSettings,
    i: int,
    bounce: int,
    light: EmitterSample,
    position: wp.vec3,
    normal: wp.vec3,
    flux: wp.vec3,
) -> _Segment:
    """Traces the segment of light path `i` before its reflection `bounce`: from the light, or from a surface.

    Where paths are guided, several candidates are traced, and one is taken in proportion to the flux times what the
    picture gains from it where it arrives (resampled importance sampling, Talbot et al. 2005).
    """
    importance = settings.importance
    dimension = wp.where(bounce == 1, 3, _FIRST_BOUNCE_DIMENSION + 3 * (bounce - 2))
    u = sobol.sample_2d(scene.sobol, i, dimension, settings.scramble[0])
    v = wp.vec2(0.0)
    floor = float(0.0)
    if bounce == 1:
        v = sobol.sample_2d(scene.sobol, i, 5, settings.scramble[0])
        floor = floor_at_emission(importance)
    elif importance.candidates > 1:
        floor = floor_from(importance, position, normal)
    choice = float(0.0)
    if importance.candidates > 1:
        choice = _survival_sample(settings.scramble[0] ^ _CHOICE_STREAM, i, bounce)
    out = _Segment()
    out.hit.triangle = -1
    sum_of_weights = float(0.0)
    weight_of_chosen = float(1.0)
    for k in range(importance.candidates):
        origin = position
        flux_of_candidate = flux
        if bounce == 1:
            photon = emit_photon(scene, light, settings.photon_target, _shifted(u, k), _shifted(v, k))
            origin = photon.origin
            direction = photon.direction
            flux_of_candidate = photon.flux
        else:
            direction = square_to_cosine_hemisphere(_shifted(u, k), normal)
        if wp.max(flux_of_candidate) > 0.0:
            hit = closest(scene, origin, direction, 3.0e38)
            if hit.triangle >= 0:
                weight = float(1.0)
                if importance.candidates > 1:
                    value = importance_at(importance, hit.position, hit.normal)
                    mean_flux = flux_of_candidate[0] + flux_of_candidate[1] + flux_of_candidate[2]
                    weight = wp.max(mean_flux * (value[0] + value[1] + floor), 1.0e-30)
                sum_of_weights += weight
                probability = weight / sum_of_weights
                if choice < probability:
                    choice = choice / probability
                    weight_of_chosen = weight
                    out.hit = hit
                    out.direction = direction
                    out.flux = flux_of_candidate
                else:
                    choice = (choice - probability) / (1.0 - probability)
    out.flux = out.flux * (sum_of_weights / (weight_of_chosen * float(importance.candidates)))
    return out


@wp.struct
class WrittenVpls:
    """Which of the n VPLs that a light path leaves on surfaces are written: skip + 1 ... min(end, n).

    The j-th is number first + (j - 1) stride of `total`, from which `surface_row` gives its row.
    """

    skip: int
    end: int
    first: int
    stride: int
    total: int


@wp.func
def recorded_vpls(settings: LightPathSettings, path: int) -> WrittenVpls:
    """The first VPLs of a path, which are recorded before the lengths of all paths are known."""
    out = WrittenVpls()
    out.end = settings.recorded
    out.first = path
    out.stride = settings.paths
    return out


@wp.func
def remaining_vpls(settings: LightPathSettings, length: int, first: int, total: int) -> WrittenVpls:
    """The other VPLs of a path that leaves `length`, the first of which is number `first` of `total`."""
    out = WrittenVpls()
    out.skip = settings.recorded
    out.end = length
    out.first = first
    out.stride = 1
    out.total = total
    return out


@wp.func(inline=False)
def trace_light_path(
    address: wp.uint64, settings: LightPathSettings, i: int, vpls: VplBuffer, written: WrittenVpls
) -> int:
    """Traces light path `i`, and returns the number of VPLs that it leaves on surfaces; some are written to `vpls`.

    Where none is skipped, the point on the light is written to row i.
    """
    scene = scene_at(address)[0]
    u_pick = sobol.sample_1d(scene.sobol, i, 2, settings.scramble[0])
    u = sobol.sample_2d(scene.sobol, i, 0, settings.scramble[0])
    light = sample_light(scene, u_pick, u)
    path_weight = 1.0 / float(settings.paths)
    if written.skip == 0 and i < settings.on_lights:
        vpls.position[i] = light.position
        vpls.normal[i] = light.normal
        vpls.intensity[i] = light.intensity / float(settings.on_lights)
        vpls.bounce[i] = 0
        vpls.pdf_area[i] = scene.emitter_pdf_area[light.emitter]
        if light.large_pdf > 0.0:
            vpls.pdf_area[i] = light.large_pdf
        if scene.uneven == 1:
            vpls.lift[i] = scene.emitter_lift[light.emitter]
        if scene.modifier_count > 0:
            vpls.modifiers[i] = light.modifier_row

    origin = wp.vec3(0.0)
    normal = wp.vec3(0.0)
    flux = wp.vec3(1.0)
    bounce = int(1)
    vpl_count = int(0)
    while bounce <= settings.max_bounces and wp.max(flux) > 0.0:
        segment = _trace_segment(scene, settings, i, bounce, light, origin, normal, flux)
        hit = segment.hit
        flux = segment.flux
        if bounce == 1 and light.modifier_row >= 0:
            u_mesh = sobol.sample_1d(scene.sobol, i, _FIRST_REFLECTION_DIMENSION, settings.scramble[0])
            landing = first_reflection(scene, light.modifier_row, hit, segment.direction, u_mesh)
            hit = landing.hit
            flux = flux * landing.weight
        if hit.triangle < 0:
            break
        rho = albedo(scene, hit, scene.footprint)
        if settings.fractional == 1:
            if bounce >= settings.levels or i >= settings.survivors[wp.min(bounce, settings.levels - 1)]:
                break
            path_weight = 1.0 / float(settings.survivors[bounce])
            flux = wp.cw_mul(flux, rho)
        else:
            survival = wp.min(wp.max(rho), _MAX_SURVIVAL)
            if settings.importance.candidates > 1:
                reflected = wp.cw_mul(flux, rho) * (path_weight / wp.pi)
                survival = path_survival(settings.importance, hit.position, hit.normal, reflected, survival)
            dimension = _FIRST_BOUNCE_DIMENSION + 3 * bounce - 1
            if sobol.sample_1d(scene.sobol, i, dimension, settings.scramble[0]) >= survival:
                break
            flux = wp.cw_mul(flux, rho) / survival
        if wp.max(flux) <= 0.0:
            break
        intensity = flux * (path_weight / wp.pi)
        survives = bool(True)
        if settings.importance.survival_threshold > 0.0:
            probability = survival_probability(settings.importance, hit.position, hit.normal, intensity)
            intensity = intensity / probability
            survives = _survival_sample(settings.scramble[0], i, bounce) < probability
        if survives:
            vpl_count += 1
            if vpl_count > written.skip and vpl_count <= written.end:
                row = surface_row(settings, written.first + (vpl_count - 1) * written.stride, written.total)
                if row >= 0:
                    vpls.position[row] = wp.vec4(hit.position[0], hit.position[1], hit.position[2], 1.0)
                    vpls.normal[row] = wp.vec4(hit.normal[0], hit.normal[1], hit.normal[2], 0.0)
                    vpls.intensity[row] = intensity * thinning_weight(settings, written.total)
                    vpls.bounce[row] = bounce
                    if scene.uneven == 1:
                        vpls.lift[row] = scene.emitter_lift[light.emitter]
        origin = hit.position
        normal = hit.normal
        bounce += 1
    return vpl_count


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _trace_light_paths(
    first: int,
    scene: SceneData,
    settings: LightPathSettings,
    lengths: wp.array[wp.int32],
    ends: wp.array[wp.int32],
    vpls: VplBuffer,
) -> None:
    """Traces light path `i`, and records its point on the light and its first VPLs on surfaces.

    Row `on_lights + k paths + i` of `vpls` is then the path's k-th VPL on a surface. When paths are followed again,
    those that have more VPLs store them after those of the paths before them, which `ends` counts.
    """
    i = first + wp.tid()
    written = recorded_vpls(settings, i)
    if settings.again == 1:
        if lengths[i] <= settings.recorded:
            return
        written = remaining_vpls(settings, lengths[i], ends[i] - lengths[i], ends[settings.paths - 1])
    length = trace_light_path(scene.address, settings, i, vpls, written)
    if settings.again == 0:
        lengths[i] = length


@wp.func
def copy_vpl(source: VplBuffer, row: int, target: VplBuffer, to: int, weight: float) -> None:
    """Copies a VPL from a row of one buffer to a row of another; its intensity is multiplied by a weight."""
    target.position[to] = source.position[row]
    target.normal[to] = source.normal[row]
    target.intensity[to] = source.intensity[row] * weight
    target.bounce[to] = source.bounce[row]
    if source.lifted == 1:
        target.lift[to] = source.lift[row]


@wp.kernel
def _store_light_paths(
    first: int,
    scene: SceneData,
    settings: LightPathSettings,
    traced: VplBuffer,
    lengths: wp.array[wp.int32],
    ends: wp.array[wp.int32],
    vpls: VplBuffer,
    counted: wp.array[wp.int64],
) -> None:
    """Stores what is recorded of light path `i`: its point on the light in row i, VPLs after those of earlier paths."""
    i = first + wp.tid()
    total = ends[settings.paths - 1]
    number = ends[i] - lengths[i]
    for k in range(wp.min(lengths[i], settings.recorded)):
        row = surface_row(settings, number + k, total)
        if row >= 0:
            copy_vpl(traced, settings.on_lights + settings.paths * k + i, vpls, row, thinning_weight(settings, total))
    if i < settings.on_lights:
        copy_vpl(traced, i, vpls, i, 1.0)
        vpls.pdf_area[i] = traced.pdf_area[i]
        if scene.modifier_count > 0:
            vpls.modifiers[i] = traced.modifiers[i]
    if i == settings.paths - 1:
        vpls.count[0] = settings.on_lights + wp.min(total, settings.capacity)
        counted[0] += wp.int64(vpls.count[0])


def survivors(paths: int, mean_albedo: float) -> npt.NDArray[np.int32]:
    """Fractional absorption (Keller 1997): ⌊ρ̄ʲ N⌋ of N paths are reflected j times.

    Returns int32 [levels], which ends before the first 0.
    """
    rho = min(mean_albedo, _MAX_REFLECTIVITY)
    if not rho > 0.0:
        return np.array([paths], np.int32)
    levels = int(math.log(paths) / -math.log(rho)) + 2
    # The mean of equal albedos may come out an ulp low: ⌊N/2⌋ must not become ⌊N/2⌋ - 1.
    counts = np.floor(paths * rho ** np.arange(levels, dtype=np.float64) * (1.0 + 1.0e-12)).astype(np.int32)
    return counts[counts > 0]


def emit_vpls(
    guide: Guide,
    scratch: Scratch,
    *,
    light_paths: int,
    absorption: str,
    max_bounces: int,
    scramble: int,
) -> VplBuffer:
    """Traces light paths and returns the VPLs at all their vertices; none if nothing emits.

    The arrays belong to `scratch`, may be longer than needed, and are overwritten by the next call with it.

    Args:
        guide: The uploaded scene, and the probabilities by which light paths are guided.
        scratch: Owner of the buffer's arrays; its launcher runs the kernels.
        light_paths: Number of light paths, and of VPLs on lights; `guide.path_multiplier` times as many are traced.
        absorption: "fractional" or "roulette".
        max_bounces: Largest number of reflections of a light path.
        scramble: 32-bit scramble of the low-discrepancy sequence; two scrambles give independent estimates.
    """
    scene, launcher, on_lights = guide.scene, scratch.launcher, light_paths
    if not scene.emits:
        vpls = _buffer(scene, scratch, "vpls", 0, 0)
        vpls.count.zero_()
        return vpls
    paths = light_paths * guide.path_multiplier
    settings = _path_settings(guide, scratch, paths, on_lights, max_bounces, scramble)
    if absorption == "fractional":
        alive = survivors(paths, scene.mean_albedo)
        settings.fractional, settings.levels = 1, len(alive)
        settings.survivors = scratch.upload("survivors", alive, wp.int32)
    recorded = _recorded_length(paths, scene.mean_albedo)
    settings.recorded = min(recorded, max_bounces)
    settings.capacity = min(paths * min(max(recorded, CAPACITY_PER_PATH), max_bounces), _MAX_CAPACITY)

    # Two passes: paths are stored when the lengths of all are known. So every path has its rows without atomics, and no
    # path has a maximal length; the few that are longer than what was recorded of them are followed again.
    lengths, ends = scratch.array("lengths", paths, wp.int32), scratch.array("ends", paths, wp.int32)
    traced = _buffer(scene, scratch, "traced", on_lights, paths * settings.recorded)
    launcher.launch(_trace_light_paths, paths, [scene.data, settings, lengths, ends, traced])
    wp.utils.array_scan(lengths[:paths], ends[:paths], inclusive=True)
    vpls = _buffer(scene, scratch, "vpls", on_lights, launcher.row_count(ends[paths - 1 : paths], settings.capacity))
    counted = launcher.profile.tally("vpls")
    launcher.launch(_store_light_paths, paths, [scene.data, settings, traced, lengths, ends, vpls, counted])
    if settings.recorded < max_bounces:
        settings.again = 1
        launcher.launch(_trace_light_paths, paths, [scene.data, settings, lengths, ends, vpls])
    launcher.profile.counts["light_paths"] += paths
    return vpls


def _path_settings(
    guide: Guide, scratch: Scratch, paths: int, on_lights: int, max_bounces: int, scramble: int
) -> LightPathSettings:
    """Settings of light paths that end by Russian roulette; what is recorded or stored is left to the caller."""
    settings = LightPathSettings()
    settings.scramble = scratch.number("scramble", scramble, wp.uint32)
    settings.paths, settings.on_lights = paths, on_lights
    settings.photon_target, settings.importance = guide.photon_target, guide.importance
    settings.max_bounces = max_bounces
    settings.survivors = scratch.array("survivors", 1, wp.int32)
    return settings


def trace_light_vertices(
    guide: Guide, scratch: Scratch, *, paths: int, max_vertices: int, scramble: int
) -> tuple[VplBuffer, wp.array[wp.int32]]:
    """Traces light paths, and returns their first vertices on surfaces and how many each path has.

    Row `paths` (1 + k) + i of the buffer is the k-th vertex of path i on a surface. The scene must emit.

    Args:
        guide: The uploaded scene, and how light paths are guided.
        scratch: Owner of the arrays.
        paths: Number of light paths.
        max_vertices: Largest number of vertices of a path; it ends there.
        scramble: 32-bit scramble of the low-discrepancy sequence.
    """
    settings = _path_settings(guide, scratch, paths, paths, max_vertices, scramble)
    settings.recorded, settings.capacity = max_vertices, paths * max_vertices
    vertices = _buffer(guide.scene, scratch, "vertices", paths, settings.capacity)
    lengths = scratch.array("vertices.lengths", paths, wp.int32)
    inputs = [guide.scene.data, settings, lengths, lengths, vertices]
    scratch.launcher.launch(_trace_light_paths, paths, inputs)
    return vertices, lengths


def _recorded_length(paths: int, mean_albedo: float) -> int:
    """Number of reflections to record of every path, so that only `_RETRACED_SHARE` of the paths are longer."""
    rho = min(max(mean_albedo, 0.05), 0.95)
    return max(min(math.ceil(math.log(_RETRACED_SHARE) / math.log(rho)), _MAX_RECORDED // paths), 1)


def _buffer(scene: DeviceScene, scratch: Scratch, name: str, on_lights: int, on_surfaces: int) -> VplBuffer:
    vpls = VplBuffer()
    vpls.on_lights, vpls.capacity = on_lights, on_lights + on_surfaces
    vpls.count = scratch.array(name + ".count", 1, wp.int32)
    rows = max(vpls.capacity, 1)
    vpls.position = scratch.array(name + ".position", rows, wp.vec4)
    vpls.normal = scratch.array(name + ".normal", rows, wp.vec4)
    vpls.intensity = scratch.array(name + ".intensity", rows, wp.vec3)
    vpls.bounce = scratch.array(name + ".bounce", rows, wp.int32)
    vpls.pdf_area = scratch.array(name + ".pdf_area", max(on_lights, 1), wp.float32)
    vpls.lifted = scene.data.uneven
    vpls.lift = scratch.array(name + ".lift", rows if scene.data.uneven else 1, wp.float32)
    modifiers = max(on_lights, 1) if scene.data.modifier_count > 0 else 1
    vpls.modifiers = scratch.array(name + ".modifiers", modifiers, wp.int32)
    return vpls
