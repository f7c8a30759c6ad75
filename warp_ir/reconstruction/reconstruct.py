"""Reconstruction on one page: samples are observed iteration by iteration; a picture is made of them when asked for."""

import weakref
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device_scene import DeviceScene
from warp_ir.launch import Launcher, carve, floats
from warp_ir.reconstruction.compose import compose, edge_rays
from warp_ir.reconstruction.filter import filter_layer, new_layer
from warp_ir.reconstruction.observations import average, look, observe, sums, without_mixed

_FILTER_PASSES = 6.0
"""Filtering takes as long as so many passes of camera rays: fewer where rays are dear."""
_TYPES = (wp.vec4, wp.vec4, wp.vec4, wp.vec4, wp.vec2)
SCRATCH = floats(*_TYPES)
"""What making a picture takes for a while: float32 a pixel."""


class Reconstruction:
    """Gathers what the filter needs beside the film, and makes the picture of both."""

    def __init__(
        self,
        scene: DeviceScene,
        camera: Any,
        launcher: Launcher,
        gbuffer: Any,
        block: Any,
        exposure: float,
        seed: int,
    ) -> None:
        """Looks through the centre of every pixel; `seed` is that of the film.

        `gbuffer` is scratch for that, and its `block`, as long as it is there, for every picture.
        """
        self._block = weakref.ref(block)
        self._scene, self._camera, self._launcher, self._exposure = scene, camera, launcher, exposure
        with launcher.phase("filter"):
            self._seen, self._on_edges = look(scene, camera, launcher, gbuffer, seed)

    def observe(self, gbuffer: Any, direct: Any, indirect: Any) -> None:
        """Adds one iteration's samples of irradiance over π."""
        observe(self._seen, gbuffer, direct, indirect, self._launcher)

    def arrays(self) -> dict[str, Any]:
        """The samples so far, by name: sums that add up when films are merged, and go on when one is resumed."""
        return sums(self._seen)

    def merge(self, other: "Reconstruction") -> None:
        """Adds another's samples."""
        for mine, theirs in zip(self.arrays().values(), other.arrays().values(), strict=True):
            mine.assign(mine.numpy() + theirs.numpy())

    def passes(self, iterations: int) -> float:
        """How many times as long as camera rays through all pixels `resolve` will take, roughly."""
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
            *layers, noise = carve(block, camera.columns * camera.rows, _TYPES)
            layer, other = new_layer(*layers[:2]), new_layer(*layers[2:])
            seen = average(self._seen, noise, layer, launcher)
            if camera.blurs:
                seen = without_mixed(seen, layer, iterations, launcher)
            filtered = filter_layer(seen.surfaces, layer, other, launcher)
            rows = compose(self._scene, camera, seen, filtered, film, iterations, self._exposure, features, launcher)
            return np.asarray(rows.numpy()).reshape(-1, camera.rows, camera.columns, 3)
