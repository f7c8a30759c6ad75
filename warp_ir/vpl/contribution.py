"""What each VPL contributes to a pixel, or to the whole picture: every VPL, every shadow ray, as `keller` sums them."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import MAX_REGISTERS, Launcher
from warp_ir.device_scene import DeviceScene, SceneData, camera_data
from warp_ir.gbuffer import GBuffer, camera_vertex, new_gbuffer, reflecting_pixel, trace_primary
from warp_ir.lights import light_visibility
from warp_ir.scene import InputError, Scene
from warp_ir.settings import RenderSettings
from warp_ir.surface import ShadingPoint
from warp_ir.tiles import TILE
from warp_ir.vpl.emission import VplBuffer

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

UNBOUNDED = wp.constant(3.0e38)
"""A bound on G that bounds nothing."""
_POINTS = 1024
"""Approximate number of points that stand for a whole picture."""


@wp.func
def geometry_term(
    position: wp.vec3, normal: wp.vec3, shading_normal: wp.vec3, vpl_position: wp.vec4, vpl_normal: wp.vec4
) -> float:
    """G between a surface point and a VPL; for a directional VPL (w = 0), the cosine at the point."""
    xyz = wp.vec3(vpl_position[0], vpl_position[1], vpl_position[2])
    to_vpl = xyz - position * vpl_position[3]
    squared = wp.dot(to_vpl, to_vpl)
    direction = to_vpl / wp.sqrt(squared)
    if wp.dot(normal, direction) <= 0.0:
        return 0.0  # behind the surface, even where the shading normal faces the VPL
    at_point = wp.max(0.0, wp.dot(shading_normal, direction))
    vpl_facing = wp.vec3(vpl_normal[0], vpl_normal[1], vpl_normal[2])
    at_vpl = wp.max(0.0, vpl_normal[3] - wp.dot(vpl_facing, direction))
    return at_point * at_vpl / squared


@wp.func
def vpl_irradiance(scene: SceneData, vpls: VplBuffer, k: int, x: ShadingPoint, bound: float) -> wp.vec3:
    """The irradiance I min(G, bound) V that VPL k adds to a point, with the light's shaping and links if it has any."""
    g = geometry_term(x.position, x.normal, x.shading_normal, vpls.position[k], vpls.normal[k])
    if g <= 0.0:
        return wp.vec3(0.0)
    modifiers = int(-1)
    if scene.modifier_count > 0 and k < vpls.on_lights:
        modifiers = vpls.modifiers[k]
    visibility = light_visibility(scene, modifiers, x, vpls.position[k])
    return wp.cw_mul(vpls.intensity[k], visibility) * wp.min(g, bound)


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def _sum_contributions(
    first: int,
    scene: SceneData,
    gbuffer: GBuffer,
    vpls: VplBuffer,
    contribution: wp.array[wp.vec3],
) -> None:
    """Sums the radiance ρ/π I G V that VPL k adds to the points of the G-buffer."""
    k = first + wp.tid()
    total = wp.vec3(0.0)
    for i in range(gbuffer.tiles.numbers.shape[0] * TILE * TILE):
        pixel = reflecting_pixel(gbuffer, i)
        if pixel >= 0:
            x = camera_vertex(gbuffer, pixel)
            irradiance = vpl_irradiance(scene, vpls, k, x, UNBOUNDED)
            total += wp.cw_mul(irradiance, gbuffer.albedo[pixel]) / wp.pi
    contribution[k] = total


@dataclass(frozen=True)
class SeenSurface:
    """Points that the camera sees through the centres of pixels."""

    gbuffer: GBuffer
    pixels: int
    position: npt.NDArray[np.float64] | None
    """[3], the point of the first pixel, world space; None: it sees no surface."""

    @classmethod
    def of(
        cls,
        scene: Scene,
        uploaded: DeviceScene,
        launcher: Launcher,
        settings: RenderSettings,
        target: tuple[int, int] | str,
    ) -> "SeenSurface":
        """Traces the camera rays.

        Args:
            scene: The scene.
            uploaded: The same scene on the device.
            launcher: Runs the kernels.
            settings: They describe the image; `height` is set.
            target: A pixel (column, row) of the image, or "picture".

        Raises:
            InputError: There is no such pixel.
        """
        width, height = settings.width, settings.height
        assert height is not None
        if target == "picture":
            smaller = min(1.0, (_POINTS / (width * height)) ** 0.5)
            columns, rows = max(round(width * smaller), 1), max(round(height * smaller), 1)
            settings = replace(settings, width=columns, height=rows, data_window=(0.0, 0.0, 1.0, 1.0))
        elif isinstance(target, str) or len(target) != 2 or not (0 <= target[0] < width and 0 <= target[1] < height):
            raise InputError(f"contribution_to: must be 'picture' or a pixel of the {width} x {height}, is {target!r}")
        camera = camera_data(scene.camera, uploaded.frame, settings)
        if not isinstance(target, str):
            camera.first_column, camera.first_row = target
            camera.columns, camera.rows = 1, 1
        gbuffer, _ = new_gbuffer(
            launcher,
            camera.columns,
            camera.rows,
            has_normals=scene.has_normals,
            has_normal_maps=uploaded.data.normal_map_count > 0,
            has_emission=scene.glows or settings.visible_lights,
            moving=False,
        )
        trace_primary(uploaded, camera, launcher, gbuffer, iteration=-1, seed=settings.seed)
        position = None
        if gbuffer.mesh.numpy()[0] >= 0:
            position = uploaded.frame.to_world(gbuffer.position.numpy()[0])
        return cls(gbuffer, camera.columns * camera.rows, position)


def contributions(
    scene: DeviceScene, launcher: Launcher, vpls: VplBuffer, seen: SeenSurface
) -> npt.NDArray[np.float32]:
    """The radiance that each VPL adds to the mean over the points seen, float32 [n, 3] [W sr⁻¹ m⁻²].

    Args:
        scene: The scene in which the VPLs were traced.
        launcher: Runs the kernels.
        vpls: The VPLs.
        seen: The points.
    """
    count = int(vpls.count.numpy()[0])
    contribution = launcher.empty(max(count, 1), wp.vec3)
    if count:
        launcher.launch(_sum_contributions, count, [scene.data, seen.gbuffer, vpls, contribution])
    mean: npt.NDArray[np.float32] = contribution.numpy()[:count] / seen.pixels
    return mean
