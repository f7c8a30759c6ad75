"""Reconstruction on one page: samples are observed iteration by iteration; a picture is made of them when asked for."""

import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher, float_count, partition
from warp_ir.device.scratch import Scratch
from warp_ir.gbuffer import GBuffer
from warp_ir.reconstruction.blur import blur_rays, compose_blurred
from warp_ir.reconstruction.compose import compose, correct_edges, edge_rays, new_resolved_picture
from warp_ir.reconstruction.filter import filter_layer, new_layer
from warp_ir.reconstruction.reprojection import ShutterSample, accumulate_blurred, estimate_missing_noise, new_blur
from warp_ir.reconstruction.sample_buffer import accumulate, estimate_means, new_sample_buffer, sample_sums

_FILTER_PASSES = 6.0
"""Filtering takes as long as so many passes of camera rays: fewer where rays are dear."""
_TYPES = (wp.vec4, wp.vec4, wp.vec4, wp.vec4, wp.vec2)
SCRATCH = float_count(*_TYPES)
"""What making a picture takes for a while: float32 a pixel."""


class Reconstruction:
    """Gathers what the filter needs beside the film, and makes the picture of both."""

    def __init__(
        self, moments: Sequence[ShutterSample], launcher: Launcher, gbuffer: Any, block: Any, seed: int
    ) -> None:
        """Looks through the centre of every pixel.

        Args:
            moments: While the shutter is open, a power of two; the one in the middle is looked at.
            launcher: Where.
            gbuffer: Scratch for that.
            block: Its memory: as long as that is there, scratch for every picture.
            seed: That of the film.
        """
        middle = moments[len(moments) // 2]
        self._scene, self._camera = middle.scene, middle.camera
        self._exposure = sum(m.exposure for m in moments) / len(moments)
        self._launcher, self._block = launcher, weakref.ref(block)
        self._scratch = Scratch(launcher)
        with launcher.phase("filter"):
            self._seen, self._on_edges = new_sample_buffer(self._scene, self._camera, launcher, gbuffer, seed)
            self._blur = new_blur(moments, launcher) if self._camera.blurs else None

    def accumulate(self, gbuffer: GBuffer, shutter_sample: int = 0) -> None:
        """Adds one iteration's samples of irradiance over π, made at one of the moments."""
        if self._blur is not None:
            accumulate_blurred(self._blur, self._seen, shutter_sample, gbuffer, self._scratch)
        else:
            accumulate(self._seen, gbuffer, self._launcher)

    def arrays(self) -> dict[str, Any]:
        """The samples so far, by name: sums that add up when films are merged, and go on when one is resumed."""
        return sample_sums(self._seen)

    def merge(self, other: "Reconstruction") -> None:
        """Adds another's samples."""
        for mine, theirs in zip(self.arrays().values(), other.arrays().values(), strict=True):
            mine.assign(mine.numpy() + theirs.numpy())

    def passes(self, iterations: int) -> float:
        """How many times as long as camera rays through all pixels `resolve` will take, roughly."""
        if self._blur is not None:
            return _FILTER_PASSES + blur_rays(iterations)
        # Of two pixels next to an edge one is of one surface, and soon done.
        return _FILTER_PASSES + 0.5 * self._on_edges * edge_rays(iterations)

    def resolve(self, film: Any, iterations: int, features: bool = False) -> npt.NDArray[np.float32]:
        """Radiance by way of lights and of surfaces, from a `FilmData`: float32 [2, rows, columns, 3].

        With `features` [5, ...]: after it come albedo, normals, and the plain mean, all with edges as smooth as the
        picture's.
        """
        launcher, camera = self._launcher, self._camera
        with launcher.phase("filter"):
            block = self._block()
            if block is None:
                block = launcher.empty(SCRATCH * camera.columns * camera.rows, wp.float32)
            *layers, noise = partition(block, camera.columns * camera.rows, _TYPES)
            layer, other = new_layer(*layers[:2]), new_layer(*layers[2:])
            seen = estimate_means(self._seen, noise, layer, launcher)
            layer, rest = filter_layer(seen.surfaces, layer, other, launcher)
            rays = edge_rays(iterations) if self._blur is None else blur_rays(iterations)
            out = new_resolved_picture(seen.count.shape[0], rest, rays, features, launcher)
            if self._blur is not None:
                estimate_missing_noise(seen, launcher)
                compose_blurred(self._blur, seen, layer, film, self._exposure, out, launcher)
            else:
                compose(self._scene, camera, seen, layer, film, self._exposure, out, launcher)
            correct_edges(seen.surfaces, out, launcher)
            return np.asarray(out.rows.numpy()).reshape(-1, camera.rows, camera.columns, 3)
