"""Progressive instant radiosity: Keller's VPLs, gathered with few rays, bounded and compensated.

The sum over VPLs is estimated by `gather`. Its bound b on G takes energy away where surfaces come close to each
other; that energy is put back by following one cosine-distributed ray (Kollig and Keller 2004):

    E(x) = Σ I min(G, b) V + ∫ L(y) (1 - b/G)⁺ cosθ dω,        y what the ray meets

The ray is as short as 1/√b, since G ≤ 1/d² cannot exceed b farther away, and most rays are short misses. What
it meets has gathered in turn, and so on. Emission met on the way is the part that the bound took from the VPLs on
that light, no more: nothing counts twice.

The bound follows the density of the VPLs (`gather.build_sets`): no length in scene units is chosen anywhere.
"""

from typing import Any

import warp as wp

import warp_ir.guiding.probes
from warp_ir.device.launcher import MAX_REGISTERS, Launcher
from warp_ir.device_scene import DeviceScene, SceneData
from warp_ir.gbuffer import GBuffer, trace_primary
from warp_ir.guiding import guiding_applies, learn
from warp_ir.lights import clamped_fraction, clamped_light_radiance, clamped_surface_radiance
from warp_ir.sampling import sobol
from warp_ir.sampling.square_to import square_to_cosine_hemisphere
from warp_ir.settings import RenderSettings
from warp_ir.surface import albedo, closest
from warp_ir.tiles import indices, pixel_at
from warp_ir.vpl.emission import emit_vpls
from warp_ir.vpl.gather import ShadingPoint, gather
from warp_ir.vpl.guide import Guide, unguided
from warp_ir.vpl.sets import ON_LIGHTS, ON_SURFACES, VplSets, build_sets

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_SHADOW_RAYS = (4, 4)
"""Per pixel and iteration, to VPLs on lights and on surfaces: where the lights are hidden, surfaces still count."""
_SHADOW_RAYS_AFTER = (2, 2)
"""Where a compensation ray ends: such light has lost most of its weight."""
_UNGUIDED_ITERATIONS = 4
"""Iterations before those whose light paths are guided: for a picture of fewer, a pilot would take too long."""
_ROULETTE_DEPTH = wp.constant(2)
_INDEPENDENT = 0x5BD1E995  # parts the gathering's scramble from that of the light paths


@wp.struct
class GatherSettings:
    """What the gathering kernel needs to know beside the scene."""

    first_column: int  # of the film in the image, as for `CameraData`
    first_row: int
    scramble: wp.uint32
    rays: wp.vec2i  # to lights and to surfaces
    rays_after: wp.vec2i  # where a compensation ray ends
    max_bounces: int


@wp.func
def _spread(x: int) -> int:
    """Sixteen bits, with a zero between any two."""
    y = (x | (x << 8)) & 0x00FF00FF
    y = (y | (y << 4)) & 0x0F0F0F0F
    y = (y | (y << 2)) & 0x33333333
    return (y | (y << 1)) & 0x55555555


@wp.func
def _sequence_index(settings: GatherSettings, columns: int, pixel: int) -> int:
    """Along the Z-order curve a low-discrepancy sequence is stratified in every square of 2^k pixels."""
    column = (settings.first_column + pixel % columns) & 0xFFFF
    row = (settings.first_row + pixel // columns) & 0xFFFF
    return _spread(column) | (_spread(row) << 1)


@wp.func
def _first_receiver(gbuffer: GBuffer, pixel: int) -> ShadingPoint:
    x = ShadingPoint()
    x.position = gbuffer.position[pixel]
    x.normal = gbuffer.normal[pixel]
    x.shading_normal = gbuffer.shading_normal[pixel]
    x.mesh = gbuffer.mesh[pixel]
    x.from_camera = True
    return x


@wp.kernel(module="warp_ir.vpl.emission", cuda_max_registers=MAX_REGISTERS)  # so that rays and lights are compiled once
def _gather_pixels(
    first: int,
    scene: SceneData,
    gbuffer: GBuffer,
    parts: wp.array[VplSets],
    settings: GatherSettings,
    direct: wp.array[wp.vec3],
    indirect: wp.array[wp.vec3],
) -> None:
    """Irradiance over π of what one pixel sees."""
    pixel = pixel_at(gbuffer.tiles, first + wp.tid())
    if pixel < 0:
        return
    once = wp.vec3(0.0)
    more = wp.vec3(0.0)
    if gbuffer.mesh[pixel] >= 0 and wp.max(gbuffer.albedo[pixel]) > 0.0:
        index = _sequence_index(settings, gbuffer.tiles.columns, pixel)
        # Neighbours weigh different sets, as any coordinate of a point: nothing else that is sampled hangs on which.
        which = sobol.sample_1d(scene.sobol, index, 0, settings.scramble)
        x = _first_receiver(gbuffer, pixel)
        throughput = wp.vec3(1.0)
        bound = parts[ON_LIGHTS].bound  # the same for both
        reach = 1.0 / wp.sqrt(bound.minimum)
        depth = int(0)
        rays = settings.rays
        while depth <= settings.max_bounces:
            u = sobol.sample_2d(scene.sobol, index, 4 * depth + 1, settings.scramble)
            bounces = settings.max_bounces - depth
            by_lights = gather(scene.address, parts, ON_LIGHTS, which, x, u[0], rays[0], bounces)
            by_surfaces = gather(scene.address, parts, ON_SURFACES, which, x, u[1], rays[1], bounces)
            if depth == 0:
                once = by_lights
                more = by_surfaces
            else:
                more += wp.cw_mul(throughput, by_lights + by_surfaces)

            v = sobol.sample_2d(scene.sobol, index, 4 * depth + 3, settings.scramble)
            direction = square_to_cosine_hemisphere(v, x.shading_normal)
            if wp.dot(direction, x.normal) <= 0.0:
                break
            cosine = wp.dot(direction, x.shading_normal)
            hit = closest(scene, x.position, direction, reach)
            near = wp.where(hit.triangle < 0, reach, hit.t)
            found = clamped_light_radiance(
                scene, x.position, direction, near, cosine, bound, reach, x.mesh, x.from_camera
            )
            cut = float(0.0)
            if hit.triangle >= 0:
                g = -wp.dot(hit.normal, direction) * cosine / (hit.t * hit.t)
                cut = clamped_fraction(bound.minimum, g)
                if cut > 0.0:
                    found += clamped_surface_radiance(scene, hit, direction, g, bound, x.mesh)
            found = wp.cw_mul(throughput, found) * wp.pi
            if depth == 0:
                once += found
            else:
                more += found
            if cut <= 0.0:
                break
            throughput = wp.cw_mul(throughput, albedo(scene, hit, scene.footprint)) * cut
            if depth > _ROULETTE_DEPTH:
                survival = wp.min(wp.max(throughput), 0.99)
                if wp.frac(v[0] * 1024.0) >= survival:
                    break
                throughput = throughput / survival
            x.position = hit.position
            x.normal = hit.normal
            x.shading_normal = hit.normal
            x.mesh = scene.triangle_mesh[hit.triangle]
            x.from_camera = False
            rays = settings.rays_after
            depth += 1
    direct[pixel] = once / wp.pi
    indirect[pixel] = more / wp.pi


class VplEstimator:
    """Few shadow rays, resampled; bounded and compensated."""

    def __init__(self, scene: DeviceScene, camera: Any, settings: RenderSettings, launcher: Launcher) -> None:
        """Prepares for a scene, a `CameraData` and settings with a definite width and height."""
        self._scene, self._camera, self._settings, self._launcher = scene, camera, settings, launcher
        self._unguided = unguided(scene, launcher)
        self._guide: Guide | None = self._unguided
        if guiding_applies(scene):
            self._guide = None  # to be learned
            if settings.iteration_limit > _UNGUIDED_ITERATIONS:
                launcher.load([warp_ir.guiding.probes])

    def estimate(self, iteration: int, gbuffer: Any, direct: Any, indirect: Any) -> None:
        """Fills the G-buffer and the two irradiances over π, one row per pixel, for one iteration."""
        settings, launcher = self._settings, self._launcher
        scramble = sobol.iteration_scramble(settings.seed, iteration)

        def look() -> None:
            trace_primary(self._scene, self._camera, launcher, gbuffer, iteration=iteration, seed=settings.seed)

        guide = self._guide_of(iteration)
        with launcher.overlap("primary", look), launcher.phase("emission"):
            vpls = emit_vpls(
                guide,
                launcher,
                paths=settings.path_count,
                absorption=settings.path_end,
                max_bounces=settings.bounce_limit,
                scramble=scramble,
            )
            parts = build_sets(vpls, guide, launcher)
        how = GatherSettings()
        how.first_column, how.first_row = self._camera.first_column, self._camera.first_row
        how.scramble = wp.uint32(scramble ^ _INDEPENDENT)
        how.rays, how.rays_after = wp.vec2i(*_SHADOW_RAYS), wp.vec2i(*_SHADOW_RAYS_AFTER)
        how.max_bounces = settings.bounce_limit
        with launcher.phase("gather"):
            launcher.launch(
                _gather_pixels,
                indices(gbuffer.tiles),
                [guide.scene.data, gbuffer, parts, how, direct, indirect],
            )

    def _guide_of(self, iteration: int) -> Guide:
        """Where the light paths of an iteration go."""
        if iteration < _UNGUIDED_ITERATIONS:
            return self._unguided
        if self._guide is None:
            with self._launcher.phase("pilot"):
                self._guide = learn(self._scene, self._camera, self._launcher, self._settings)
        return self._guide
