"""Light paths and the virtual point lights (VPLs) at their vertices (Keller 1997).

A path starts at a random point of a random light and is reflected diffusely until it ends. Each of its
vertices is a VPL: the one on the light itself carries direct light (bounce 0), the one after j
reflections the j-th term of the Neumann series. With Φ the flux of the path on arrival,

    I = Φ ρ/π  [W/sr]        L(x) = ρ(x)/π Σ I G(x, y) V(x, y)        G = cos⁺θ_x cos⁺θ_y / |x - y|²

A VPL lights the side its normal faces and no other. Power is divided by the paths started, not the VPLs kept.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import MAX_REGISTERS, Launcher
from warp_ir.device_scene import DeviceScene, SceneData
from warp_ir.lights import PhotonTarget, emit_photon, first_reflection, sample_light
from warp_ir.sampling import sobol
from warp_ir.sampling.square_to import square_to_cosine_hemisphere
from warp_ir.surface import albedo, closest, scene_at
from warp_ir.vpl.guide import Guide, VplImportance, survival_probability

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

MAX_SURVIVAL = 0.999
"""Roulette lets no more than this survive, so that paths end even where nothing absorbs."""
_MAX_SURVIVAL = wp.constant(MAX_SURVIVAL)
_MAX_REFLECTIVITY = 0.98
"""Likewise the mean reflectivity of fractional absorption."""
# Dimensions 0-1: where on the light (the best pair), 2: which light, 3-4: direction, 5-6: place of a distant photon.
_FIRST_BOUNCE_DIMENSION = wp.constant(7)
_LANDING_DIMENSION = wp.constant(1 << 20)  # far from those of any bounce
_KEEPING = wp.constant(wp.uint32(0x9E6C63D0))  # parts the coins by which VPLs are kept from the paths' sequence
_RETRACED_SHARE = 0.02
"""About the share of the paths that may be longer than what is noted of them."""
_MAX_RECORDED = 2**22
"""Reflections noted at most, 48 bytes each."""
_CAPACITY_PER_PATH = 8
"""VPLs on surfaces for which there is room, per path at least: the mean where 8/9 of the light is reflected."""
_MAX_CAPACITY = 2**26
"""VPLs on surfaces at most, 64 bytes each."""
_THINNING = wp.constant(wp.uint32(0x7FEB352D))  # parts the choice of those that find room from the paths' sequence


@wp.struct
class VplBuffer:
    """VPLs in the scene's device frame, first those on lights, then those on surfaces, path by path.

    Positions and normals are homogeneous, as in `lights`. How many there are, the device alone knows: the host would
    have to wait for it.
    """

    count: wp.array[wp.int32]  # one row
    capacity: int  # at least `count`; the same on the CPU, where reading it costs nothing
    on_lights: int
    position: wp.array[wp.vec4]
    normal: wp.array[wp.vec4]
    intensity: wp.array[wp.vec3]  # [W/sr]; [W/m²] where w = 0
    bounce: wp.array[wp.int32]
    pdf_area: wp.array[wp.float32]  # [on_lights], of samples per area of the light; 0 where it has no area
    modifiers: wp.array[wp.int32]  # [on_lights], rows of the lights' `LightModifiers`s or -1; one row if there are none


@wp.struct
class PathSettings:
    """How light paths are sampled and how they end."""

    scramble: wp.uint32
    paths: int
    on_lights: int  # of them, whose point on the light is a VPL
    max_bounces: int
    fractional: int  # 1: the first survivors[j] paths are reflected j times; 0: roulette by the local albedo
    survivors: wp.array[wp.int32]
    levels: int  # length of survivors
    recorded: int  # VPLs of a path that are noted while it is traced
    capacity: int  # for VPLs on surfaces; if there are more, some are drawn to stand for all
    photon_target: PhotonTarget
    importance: VplImportance


@wp.func
def _survival_sample(scramble: wp.uint32, path: int, bounce: int) -> float:
    """Uniform in [0, 1), for every VPL."""
    bits = sobol.hash_combine(sobol.hash_combine(scramble ^ _KEEPING, wp.uint32(path)), wp.uint32(bounce))
    return sobol.to_unit(bits)


@wp.func
def _row(settings: PathSettings, number: int, total: int) -> int:
    """The row of VPL `number` of `total` on surfaces; -1: it is dropped, where there is no room for all of them.

    Those that are kept lie evenly among the others, and each is kept with the same probability (systematic sampling).
    """
    if total <= settings.capacity:
        return settings.on_lights + number
    offset = sobol.hash_combine(settings.scramble ^ _THINNING, wp.uint32(0)) % wp.uint32(total)
    before = (wp.int64(number) * wp.int64(settings.capacity) + wp.int64(offset)) // wp.int64(total)
    after = (wp.int64(number + 1) * wp.int64(settings.capacity) + wp.int64(offset)) // wp.int64(total)
    return wp.where(after > before, settings.on_lights + int(before), -1)


@wp.func
def _thinning_weight(settings: PathSettings, total: int) -> float:
    """How many of `total` VPLs each of those stands for that are kept."""
    if total <= settings.capacity:
        return 1.0
    return float(total) / float(settings.capacity)


@wp.func(inline=False)
def _follow(
    address: wp.uint64,
    settings: PathSettings,
    i: int,
    vpls: VplBuffer,
    number: int,
    step: int,
    total: int,
    kept: int,
    most: int,
) -> int:
    """Follows path `i` and returns how many VPLs it leaves on surfaces.

    Its point on the light goes to row i of `vpls`; the first of the others is VPL `number` of `total`, the next ones
    follow in steps. VPL j is stored if kept < j <= most.
    """
    scene = scene_at(address)[0]
    u_pick = sobol.sample_1d(scene.sobol, i, 2, settings.scramble)
    u = sobol.sample_2d(scene.sobol, i, 0, settings.scramble)
    light = sample_light(scene, u_pick, u)
    share = 1.0 / float(settings.paths)
    if kept == 0 and i < settings.on_lights:
        vpls.position[i] = light.position
        vpls.normal[i] = light.normal
        vpls.intensity[i] = light.intensity / float(settings.on_lights)
        vpls.bounce[i] = 0
        vpls.pdf_area[i] = scene.emitter_pdf_area[light.emitter]
        if scene.modifier_count > 0:
            vpls.modifiers[i] = light.modifier_row

    photon = emit_photon(
        scene,
        light,
        settings.photon_target,
        sobol.sample_2d(scene.sobol, i, 3, settings.scramble),
        sobol.sample_2d(scene.sobol, i, 5, settings.scramble),
    )
    origin = photon.origin
    direction = photon.direction
    flux = photon.flux
    dimension = int(_FIRST_BOUNCE_DIMENSION)
    bounce = int(1)
    left = int(0)
    while bounce <= settings.max_bounces and wp.max(flux) > 0.0:
        hit = closest(scene, origin, direction, 3.0e38)
        if bounce == 1 and light.modifier_row >= 0:
            coin = sobol.sample_1d(scene.sobol, i, _LANDING_DIMENSION, settings.scramble)
            landing = first_reflection(scene, light.modifier_row, hit, direction, coin)
            hit = landing.hit
            flux = flux * landing.weight
        if hit.triangle < 0:
            break
        rho = albedo(scene, hit, scene.footprint)
        if settings.fractional == 1:
            if bounce >= settings.levels or i >= settings.survivors[wp.min(bounce, settings.levels - 1)]:
                break
            share = 1.0 / float(settings.survivors[bounce])
            flux = wp.cw_mul(flux, rho)
        else:
            survival = wp.min(wp.max(rho), _MAX_SURVIVAL)
            if sobol.sample_1d(scene.sobol, i, dimension + 2, settings.scramble) >= survival:
                break
            flux = wp.cw_mul(flux, rho) / survival
        if wp.max(flux) <= 0.0:
            break
        intensity = flux * (share / wp.pi)
        survives = bool(True)
        if settings.importance.known == 1:
            probability = survival_probability(settings.importance, hit.position, hit.normal, intensity)
            intensity = intensity / probability
            survives = _survival_sample(settings.scramble, i, bounce) < probability
        if survives:
            left += 1
            if left > kept and left <= most:
                row = _row(settings, number + (left - 1) * step, total)
                if row >= 0:
                    vpls.position[row] = wp.vec4(hit.position[0], hit.position[1], hit.position[2], 1.0)
                    vpls.normal[row] = wp.vec4(hit.normal[0], hit.normal[1], hit.normal[2], 0.0)
                    vpls.intensity[row] = intensity * _thinning_weight(settings, total)
                    vpls.bounce[row] = bounce
        origin = hit.position
        u = sobol.sample_2d(scene.sobol, i, dimension, settings.scramble)
        direction = square_to_cosine_hemisphere(u, hit.normal)
        dimension += 3
        bounce += 1
    return left


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _trace_paths(
    first: int, scene: SceneData, settings: PathSettings, traced: VplBuffer, lengths: wp.array[wp.int32]
) -> None:
    """Follows path `i` and notes its light and its first VPLs on surfaces, those of all paths side by side."""
    i = first + wp.tid()
    lengths[i] = _follow(scene.address, settings, i, traced, i, settings.paths, 0, 0, settings.recorded)


@wp.func
def _copy(source: VplBuffer, row: int, target: VplBuffer, to: int, thinning_weight: float) -> None:
    target.position[to] = source.position[row]
    target.normal[to] = source.normal[row]
    target.intensity[to] = source.intensity[row] * thinning_weight
    target.bounce[to] = source.bounce[row]


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _store_paths(
    first: int,
    scene: SceneData,
    settings: PathSettings,
    traced: VplBuffer,
    lengths: wp.array[wp.int32],
    ends: wp.array[wp.int32],
    vpls: VplBuffer,
    counted: wp.array[wp.int64],
) -> None:
    """Puts path `i` where it belongs: its light in row i, its other VPLs behind those of the paths before it."""
    i = first + wp.tid()
    total = ends[settings.paths - 1]
    number = ends[i] - lengths[i]
    for k in range(wp.min(lengths[i], settings.recorded)):
        row = _row(settings, number + k, total)
        if row >= 0:
            _copy(traced, settings.on_lights + settings.paths * k + i, vpls, row, _thinning_weight(settings, total))
    if i < settings.on_lights:
        _copy(traced, i, vpls, i, 1.0)
        vpls.pdf_area[i] = traced.pdf_area[i]
        if scene.modifier_count > 0:
            vpls.modifiers[i] = traced.modifiers[i]
    if lengths[i] > settings.recorded:
        _follow(scene.address, settings, i, vpls, number, 1, total, settings.recorded, lengths[i])
    if i == settings.paths - 1:
        vpls.count[0] = settings.on_lights + wp.min(total, settings.capacity)
        counted[0] += wp.int64(vpls.count[0])


def survivors(paths: int, mean_albedo: float) -> npt.NDArray[np.int32]:
    """Fractional absorption: ⌊ρ̄ʲ N⌋ of N paths are reflected j times; int32 [levels], until none is left."""
    rho = min(mean_albedo, _MAX_REFLECTIVITY)
    if not rho > 0.0:
        return np.array([paths], np.int32)
    levels = int(math.log(paths) / -math.log(rho)) + 2
    # The mean of equal albedos may come out an ulp low: ⌊N/2⌋ must not become ⌊N/2⌋ - 1.
    counts = np.floor(paths * rho ** np.arange(levels, dtype=np.float64) * (1.0 + 1.0e-12)).astype(np.int32)
    return counts[counts > 0]


def emit_vpls(
    guide: Guide,
    launcher: Launcher,
    *,
    paths: int,
    absorption: str,
    max_bounces: int,
    scramble: int,
) -> Any:
    """Traces light paths and returns the `VplBuffer` of all their vertices; none if nothing emits.

    Its arrays are the launcher's, have room to spare, and are overwritten by the next call.

    Args:
        guide: The uploaded scene, and where in it paths go.
        launcher: Where to run.
        paths: VPLs on lights; as many light paths are started, times those of the guide.
        absorption: "fractional" or "roulette".
        max_bounces: Longest chain of reflections.
        scramble: 32-bit scramble of the sequence: another one is an independent estimate.
    """
    scene, on_lights = guide.scene, paths
    if not scene.emits:
        vpls = _buffer(scene, launcher, "vpls", 0, 0)
        vpls.count.zero_()
        return vpls
    settings = PathSettings()
    settings.scramble = wp.uint32(scramble)
    paths *= guide.paths
    settings.paths, settings.on_lights = paths, on_lights
    settings.photon_target, settings.importance = guide.photon_target, guide.importance
    settings.max_bounces = max_bounces
    settings.survivors = launcher.scratch("survivors", 1, wp.int32)
    if absorption == "fractional":
        alive = survivors(paths, scene.mean_albedo)
        settings.fractional, settings.levels = 1, len(alive)
        settings.survivors = launcher.cached_upload("survivors", alive, wp.int32)
    recorded = _recorded_length(paths, scene.mean_albedo)
    settings.recorded = min(recorded, max_bounces)
    settings.capacity = min(paths * min(max(recorded, _CAPACITY_PER_PATH), max_bounces), _MAX_CAPACITY)

    # Traced first, and stored when all lengths are known: so every path has its rows without an atomic, and no limit.
    lengths, ends = launcher.scratch("lengths", paths, wp.int32), launcher.scratch("ends", paths, wp.int32)
    traced = _buffer(scene, launcher, "traced", on_lights, paths * settings.recorded)
    launcher.launch(_trace_paths, paths, [scene.data, settings, traced, lengths])
    wp.utils.array_scan(lengths[:paths], ends[:paths], inclusive=True)
    vpls = _buffer(scene, launcher, "vpls", on_lights, launcher.at_most(ends[paths - 1 : paths], settings.capacity))
    counted = launcher.profile.tally("vpls")
    launcher.launch(_store_paths, paths, [scene.data, settings, traced, lengths, ends, vpls, counted])
    launcher.profile.counts["light_paths"] += paths
    return vpls


def _recorded_length(paths: int, mean_albedo: float) -> int:
    """Reflections to note of every path: few paths go on after them, which then have to be followed again."""
    rho = min(max(mean_albedo, 0.05), 0.95)
    return max(min(math.ceil(math.log(_RETRACED_SHARE) / math.log(rho)), _MAX_RECORDED // paths), 1)


def _buffer(scene: DeviceScene, launcher: Launcher, name: str, on_lights: int, on_surfaces: int) -> Any:
    vpls = VplBuffer()
    vpls.on_lights, vpls.capacity = on_lights, on_lights + on_surfaces
    vpls.count = launcher.scratch(name + ".count", 1, wp.int32)
    rows = max(vpls.capacity, 1)
    vpls.position = launcher.scratch(name + ".position", rows, wp.vec4)
    vpls.normal = launcher.scratch(name + ".normal", rows, wp.vec4)
    vpls.intensity = launcher.scratch(name + ".intensity", rows, wp.vec3)
    vpls.bounce = launcher.scratch(name + ".bounce", rows, wp.int32)
    vpls.pdf_area = launcher.scratch(name + ".density", max(on_lights, 1), wp.float32)
    modifiers = max(on_lights, 1) if scene.data.modifier_count > 0 else 1
    vpls.modifiers = launcher.scratch(name + ".control", modifiers, wp.int32)
    return vpls


@dataclass(frozen=True)
class Vpls:
    """A VPL cloud in world space, as NumPy arrays."""

    positions: npt.NDArray[np.float64]
    """[n, 3], world space; where `directional`, the unit direction towards the light."""
    normals: npt.NDArray[np.float32]
    """[n, 3], unit; zero where the VPL shines the same in all directions."""
    intensity: npt.NDArray[np.float32]
    """[n, 3], along the normal, before shaping [W/sr]; where `directional`, the irradiance [W/m²] on a surface that
    faces it."""
    bounce: npt.NDArray[np.int32]
    """[n], reflections before: 0 is a point on a light."""
    directional: npt.NDArray[np.bool_]
    """[n], whether the VPL is infinitely far away."""


def to_host(vpls: Any, scene: DeviceScene) -> Vpls:
    """Copies a `VplBuffer` back to world space."""
    n = int(vpls.count.numpy()[0])
    position, normal = vpls.position.numpy()[:n], vpls.normal.numpy()[:n]
    directional = position[:, 3] == 0.0
    area = np.where(directional, 1.0, scene.frame.scale**-2.0)[:, None]
    return Vpls(
        positions=np.where(directional[:, None], position[:, :3], scene.frame.to_world(position[:, :3])),
        normals=normal[:, :3].copy(),
        intensity=(vpls.intensity.numpy()[:n] * area).astype(np.float32),
        bounce=vpls.bounce.numpy()[:n].copy(),
        directional=directional,
    )
