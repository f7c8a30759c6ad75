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

from warp_ir import sampling
from warp_ir.device_scene import DeviceScene, SceneData
from warp_ir.launch import Launcher
from warp_ir.lights import emit, land, sample_light
from warp_ir.surface import albedo, closest

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

MAX_SURVIVAL = 0.999
"""Roulette lets no more than this survive, so that paths end even where nothing absorbs."""
_MAX_SURVIVAL = wp.constant(MAX_SURVIVAL)
_MAX_REFLECTIVITY = 0.98
"""Likewise the mean reflectivity of fractional absorption."""
# Dimensions 0-1: where on the light (the best pair), 2: which light, 3-4: direction, 5-6: place of a distant photon.
_FIRST_BOUNCE_DIMENSION = wp.constant(7)
_LANDING_DIMENSION = wp.constant(1 << 20)  # far from those of any bounce
_UNLIMITED = 2**31 - 1


@wp.struct
class VplBuffer:
    """VPLs in the scene's device frame, first those on lights, one per path, then those on surfaces, path by path.

    Positions and normals are homogeneous, as in `lights`.
    """

    count: int
    on_lights: int
    position: wp.array[wp.vec4]
    normal: wp.array[wp.vec4]
    intensity: wp.array[wp.vec3]  # [W/sr]; [W/m²] where w = 0
    bounce: wp.array[wp.int32]
    density: wp.array[wp.float32]  # [on_lights], of samples per area of the light; 0 where it has no area
    control: wp.array[wp.int32]  # [on_lights], rows of the lights' `LightControl`s or -1; one row if there are none


@wp.struct
class PathSettings:
    """How light paths are sampled and how they end."""

    scramble: wp.uint32
    paths: int
    max_bounces: int
    fractional: int  # 1: the first survivors[j] paths are reflected j times; 0: roulette by the local albedo
    survivors: wp.array[wp.int32]
    levels: int  # length of survivors


@wp.kernel
def _trace_paths(
    first: int,
    scene: SceneData,
    settings: PathSettings,
    offsets: wp.array[wp.int32],
    store: int,
    vpls: VplBuffer,
    lengths: wp.array[wp.int32],
) -> None:
    """Follows path `i`; counts its reflections, or stores its light in row i and them from paths + offsets[i] on."""
    i = first + wp.tid()
    begin = settings.paths + offsets[i]
    slot = begin

    u_pick = sampling.sample_1d(scene.sobol, i, 2, settings.scramble)
    u = sampling.sample_2d(scene.sobol, i, 0, settings.scramble)
    light = sample_light(scene, u_pick, u)
    share = 1.0 / float(settings.paths)
    if store == 1:
        vpls.position[i] = light.position
        vpls.normal[i] = light.normal
        vpls.intensity[i] = light.intensity * share
        vpls.bounce[i] = 0
        vpls.density[i] = scene.emitter_density[light.emitter]
        if scene.control_count > 0:
            vpls.control[i] = light.control

    photon = emit(
        scene,
        light,
        sampling.sample_2d(scene.sobol, i, 3, settings.scramble),
        sampling.sample_2d(scene.sobol, i, 5, settings.scramble),
    )
    origin = photon.origin
    direction = photon.direction
    flux = photon.flux
    dimension = int(_FIRST_BOUNCE_DIMENSION)
    bounce = int(1)
    while bounce <= settings.max_bounces and wp.max(flux) > 0.0:
        hit = closest(scene, origin, direction, 3.0e38)
        if bounce == 1 and light.control >= 0:
            coin = sampling.sample_1d(scene.sobol, i, _LANDING_DIMENSION, settings.scramble)
            landing = land(scene, light.control, hit, direction, coin)
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
            if sampling.sample_1d(scene.sobol, i, dimension + 2, settings.scramble) >= survival:
                break
            flux = wp.cw_mul(flux, rho) / survival
        if wp.max(flux) <= 0.0:
            break
        if store == 1:
            vpls.position[slot] = wp.vec4(hit.position[0], hit.position[1], hit.position[2], 1.0)
            vpls.normal[slot] = wp.vec4(hit.normal[0], hit.normal[1], hit.normal[2], 0.0)
            vpls.intensity[slot] = flux * (share / wp.pi)
            vpls.bounce[slot] = bounce
        slot += 1
        origin = hit.position
        u = sampling.sample_2d(scene.sobol, i, dimension, settings.scramble)
        direction = sampling.to_cosine_hemisphere(u, hit.normal)
        dimension += 3
        bounce += 1
    lengths[i] = slot - begin


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
    scene: DeviceScene,
    launcher: Launcher,
    *,
    paths: int,
    absorption: str,
    max_bounces: int | None,
    scramble: int,
) -> Any:
    """Traces light paths and returns the `VplBuffer` of all their vertices; none if nothing emits.

    Args:
        scene: The uploaded scene.
        launcher: Where to run.
        paths: Light paths to start.
        absorption: "fractional" or "roulette".
        max_bounces: Longest chain of reflections; None: unlimited.
        scramble: 32-bit scramble of the sequence: another one is an independent estimate.
    """
    if not scene.emits:
        return _buffer(scene, launcher, 0, 0)
    alive = survivors(paths, scene.mean_albedo)
    settings = PathSettings()
    settings.scramble = wp.uint32(scramble)
    settings.paths = paths
    settings.max_bounces = _UNLIMITED if max_bounces is None else max_bounces
    settings.fractional = int(absorption == "fractional")
    settings.survivors = launcher.array(alive, wp.int32)
    settings.levels = len(alive)

    # Two passes, count and store, give every path its rows without an atomic or a limit on its length.
    lengths = launcher.empty(paths, wp.int32)
    offsets = launcher.zeros(paths + 1, wp.int32)
    launcher.launch(_trace_paths, paths, [scene.data, settings, offsets, 0, _buffer(scene, launcher, 0, 0), lengths])
    wp.utils.array_scan(lengths, offsets[1:], inclusive=True)
    vpls = _buffer(scene, launcher, paths, int(offsets[paths:].numpy()[0]))
    launcher.launch(_trace_paths, paths, [scene.data, settings, offsets, 1, vpls, lengths])
    launcher.profile.counts["light_paths"] += paths
    launcher.profile.counts["vpls"] += vpls.count
    return vpls


def _buffer(scene: DeviceScene, launcher: Launcher, on_lights: int, on_surfaces: int) -> Any:
    vpls = VplBuffer()
    vpls.on_lights, vpls.count = on_lights, on_lights + on_surfaces
    rows = max(vpls.count, 1)
    vpls.position = launcher.empty(rows, wp.vec4)
    vpls.normal = launcher.empty(rows, wp.vec4)
    vpls.intensity = launcher.empty(rows, wp.vec3)
    vpls.bounce = launcher.empty(rows, wp.int32)
    vpls.density = launcher.empty(max(on_lights, 1), wp.float32)
    vpls.control = launcher.empty(max(on_lights, 1) if scene.data.control_count > 0 else 1, wp.int32)
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
    n = vpls.count
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
