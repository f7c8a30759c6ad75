"""Reconstruction on one page: samples are accumulated in every iteration, pictures are made of them on request."""

import math
import weakref
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher, float_count, partition
from warp_ir.device.scratch import Scratch
from warp_ir.film.accumulate import FilmData
from warp_ir.gbuffer import GBuffer
from warp_ir.reconstruction.blur import blur_rays, compose_blurred
from warp_ir.reconstruction.compose import compose, edge_rays, new_resolved_picture, rows_to_host
from warp_ir.reconstruction.correct import correct
from warp_ir.reconstruction.filter import filter_layer, new_layer
from warp_ir.reconstruction.reprojection import (
    ShutterSample,
    accumulate_reprojected,
    estimate_missing_variance,
    new_shutter_data,
)
from warp_ir.reconstruction.sample_buffer import accumulate, estimate_means, new_sample_buffer, sample_sums

if TYPE_CHECKING:
    from typing import Self  # Python 3.11

_FILTER_ADDITIONS = 10.0
"""Approximate cost of the filter, in samples added to the film for each pixel: both stream through memory."""
_LAYER_TYPES = (wp.vec4, wp.vec4, wp.vec4, wp.vec4, wp.vec2)
"""Two `IrradianceLayer`, and the variance of the samples."""
SCRATCH = float_count(*_LAYER_TYPES)
"""Scratch memory for making a picture [float32 per pixel]."""


def _power_of_two(value: float) -> float:
    """The power of two just above a number, within the range of float32; 1 for 0."""
    return 2.0 ** min(max(math.frexp(value)[1], -120), 120) if value > 0.0 else 1.0


class Reconstruction:
    """Accumulates samples of irradiance on the pixels' surfaces, and makes the picture from them and the film."""

    def __init__(
        self,
        shutter: Sequence[ShutterSample],
        launcher: Launcher,
        gbuffer: GBuffer,
        block: "wp.array[wp.float32]",
        seed: int,
    ) -> None:
        """Traces a camera ray through the centre of every pixel.

        Args:
            shutter: The shutter samples, a power of two; the middle one is the reference time.
            launcher: Runs the kernels.
            gbuffer: Scratch for those camera rays.
            block: The memory of the G-buffer, which every picture uses as scratch while it exists.
            seed: Seed of the film.
        """
        reference = shutter[len(shutter) // 2]
        self._scene, self._camera = reference.scene, reference.camera
        exposure = sum(sample.exposure for sample in shutter) / len(shutter)
        exposure_unit = _power_of_two(exposure)
        self._exposure = exposure / exposure_unit
        # Scaling by powers of two changes no bit of the picture.
        scale = 1.0 / _power_of_two(max(sample.scene.power / (sample.scene.area or 1.0) for sample in shutter))
        self._film_scale = scale / exposure_unit
        self._launcher, self._block = launcher, weakref.ref(block)
        self._scratch = Scratch(launcher)
        with launcher.phase("filter"):
            self._samples, self._edge_share = new_sample_buffer(
                self._scene, self._camera, launcher, gbuffer, seed, scale
            )
            self._shutter = new_shutter_data(shutter, exposure_unit, launcher) if self._camera.blurs else None

    def accumulate(self, gbuffer: GBuffer, shutter_sample: int = 0) -> None:
        """Adds one iteration's samples of irradiance over π, made at one of the shutter samples."""
        if self._shutter is not None:
            accumulate_reprojected(self._shutter, self._samples, shutter_sample, gbuffer, self._scratch)
        else:
            accumulate(self._samples, gbuffer, self._launcher)

    def arrays(self) -> dict[str, "wp.array[Any]"]:
        """Sums over the samples, by name: they are added when films merge, and restored when a film is resumed."""
        return sample_sums(self._samples)

    def merge(self, other: "Self") -> None:
        """Adds the samples of another film's reconstruction."""
        for mine, theirs in zip(self.arrays().values(), other.arrays().values(), strict=True):
            mine.assign(mine.numpy() + theirs.numpy())

    def cost(self, iterations: int) -> tuple[float, float]:
        """Approximate cost of `resolve` for each pixel, in camera rays and in samples added to the film."""
        if self._shutter is not None:
            return blur_rays(iterations), _FILTER_ADDITIONS
        # About half of the pixels next to an edge show one surface, and need few rays, which are less coherent.
        return 0.6 * self._edge_share * edge_rays(iterations), _FILTER_ADDITIONS

    def resolve(self, film: FilmData, iterations: int, features: bool = False) -> npt.NDArray[np.float32]:
        """Makes the picture.

        Args:
            film: The means over the iterations.
            iterations: Number of iterations, which determines the number of camera rays.
            features: Whether to add features for a denoiser.

        Returns:
            Direct (with emission) and indirect radiance, float32 [2, rows, columns, 3]. With `features` [5, ...]:
            followed by albedo, normal and unfiltered mean, whose edges are as smooth as the picture's.
        """
        launcher, camera = self._launcher, self._camera
        with launcher.phase("filter"):
            block = self._block()
            if block is None:
                block = launcher.empty(SCRATCH * camera.columns * camera.rows, wp.float32)
            *layers, variance = partition(block, camera.columns * camera.rows, _LAYER_TYPES)
            layer, other_layer = new_layer(*layers[:2]), new_layer(*layers[2:])
            samples = estimate_means(self._samples, variance, layer, launcher)
            layer, other_layer = filter_layer(samples.surfaces, layer, other_layer, launcher)
            rays = edge_rays(iterations) if self._shutter is None else blur_rays(iterations)
            pixels = samples.count.shape[0]
            out = new_resolved_picture(pixels, other_layer, rays, self._film_scale, features, launcher)
            if self._shutter is not None:
                estimate_missing_variance(samples, launcher)
                compose_blurred(self._shutter, samples, layer, film, self._exposure, out, launcher)
            else:
                compose(self._scene, camera, samples, layer, film, self._exposure, out, launcher)
            correct(samples.surfaces, film, out, layer, launcher)
            return rows_to_host(out).reshape(-1, camera.rows, camera.columns, 3)
