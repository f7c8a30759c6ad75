"""The film: a mean, a standard deviation and a count. Iterations add, films merge, the picture is the mean."""

import math
import os
import zipfile
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.film.accumulate import FilmData, add_samples
from warp_ir.film.denoise import denoise
from warp_ir.film.error_estimate import measure
from warp_ir.gbuffer import GBuffer
from warp_ir.scene import InputError
from warp_ir.tiles import TILE, all_tiles, some_tiles, tile_count

AOV_NAMES = ("direct", "indirect", "albedo", "normal", "position", "depth", "alpha", "prim_id")
"""What `Film.aov` can give beside the radiance."""
Image = npt.NDArray[Any]
_RADIANCE = ("emission", "direct", "indirect")
_CLEAN_ITERATIONS = 8
"""From here on albedo and normals are smoother than what a denoiser would make of them."""
_SEEN = "seen_"
"""What the names of the filter's arrays begin with in a file."""


class Film:
    """What a render has gathered so far. `render` makes one; `merge` adds another of the same picture."""

    AOV_NAMES = AOV_NAMES

    def __init__(self, width: int, height: int, launcher: Launcher, frame: Any = None, *, glows: bool = True) -> None:
        """An empty film on the launcher's device.

        `frame` (a `DeviceFrame`) takes positions back to the world; `glows` says whether anything in view may emit.
        """
        self.width, self.height = width, height
        self.iterations = 0
        """Iterations added; some may not have been for all tiles (`tile_iterations`)."""
        self.seconds = 0.0
        """Wall time of rendering them [s], without loading and compiling."""
        self.interrupted = 0
        """Number of the signal that ended the render before its limit; 0: none did."""
        self.settings: Any = None
        """The `RenderSettings` it was rendered with."""
        self.timings: dict[str, float] = {}
        """Seconds by phase; compiling and uploading belong to the first film after them."""
        self.counts: dict[str, int] = {}
        """Rays, VPLs, ... of all iterations."""
        self.reconstruction: Any = None
        """What filters the picture (a `Reconstruction`); None: the picture is the plain mean."""
        self._resolved: tuple[int, Any] = (0, None)
        self._denoised: tuple[int, Any] = (0, None)
        self._frame = frame
        self._launcher = launcher
        data = FilmData()
        pixels = width * height
        for name in (*_RADIANCE, "deviation", "albedo", "normal", "position"):
            setattr(data, name, launcher.zeros(pixels if glows or name != "emission" else 0, wp.vec3))
        data.depth = launcher.zeros(pixels, wp.float32)
        for name in ("count", "hits", "rejected", "mesh"):
            setattr(data, name, launcher.zeros(pixels, wp.int32))
        self._data = data
        self._skipped: npt.NDArray[np.int32] = np.zeros(tile_count(width, height), np.int32)
        self.chosen = np.ones(len(self._skipped), bool)
        """Which tiles of 8 x 8 pixels, row by row, the next iteration is for."""
        self.tiles: Any = all_tiles(width, height, launcher)
        """The same on the device."""

    def choose(self, tiles: npt.NDArray[np.bool_]) -> None:
        """From now on iterations are for these tiles alone, bool [tiles]."""
        self.chosen = tiles
        self.tiles = some_tiles(tiles, self._skipped, self.width, self.height, self._launcher)

    @property
    def tile_iterations(self) -> npt.NDArray[np.int32]:
        """How many iterations every tile of 8 x 8 pixels has had, [tiles], row by row."""
        return self.iterations - self._skipped

    def add(self, gbuffer: GBuffer, exposure: float = 1.0, shutter_sample: int = 0) -> None:
        """Adds one iteration: a G-buffer that an estimator has filled, for one of the shutter samples."""
        add_samples(gbuffer, exposure, self._data, self._launcher)
        if self.reconstruction is not None:
            self.reconstruction.accumulate(gbuffer, shutter_sample)
        self.iterations += 1
        if not self.chosen.all():
            self._skipped += ~self.chosen
            self.tiles.skipped = self._launcher.array(self._skipped, wp.int32)

    def merge(self, other: "Film") -> None:
        """Adds another film of the same picture; that it used other iterations or another seed is up to you.

        Raises:
            InputError: The films differ in size, or one shows what emits and the other does not.
        """
        if (self.width, self.height) != (other.width, other.height):
            raise InputError(f"film: cannot merge {other.width}x{other.height} into {self.width}x{self.height} pixels")
        if self._data.emission.shape != other._data.emission.shape:
            raise InputError("film: cannot merge a film that shows what emits with one that does not")
        if other.iterations == 0:
            return
        n, m = (film._data.count.numpy().astype(np.float64) for film in (self, other))
        share = (m / np.maximum(n + m, 1.0))[:, None]  # the other's
        apart = (self._sum(*_RADIANCE) - other._sum(*_RADIANCE)).astype(np.float64).reshape(-1, 3)
        for name in FilmData.vars:
            mine, theirs = (getattr(film._data, name).numpy() for film in (self, other))
            if name in _RADIANCE:
                mine = mine + (theirs - mine) * share[: len(mine)]  # no rows of emission: there is none
            elif name == "deviation":
                mine, theirs = (x.astype(np.float64) ** 2 for x in (mine, theirs))
                mine = np.sqrt(mine * (1.0 - share) + theirs * share + share * (1.0 - share) * apart**2)
            elif name == "mesh":
                mine = np.where(n > 0, mine, theirs)
            else:
                mine = mine + theirs
            getattr(self._data, name).assign(mine)
        if self.reconstruction is not None and other.reconstruction is not None:
            self.reconstruction.merge(other.reconstruction)
        self.iterations += other.iterations
        self._skipped += other._skipped
        self.choose(self.chosen)
        self.seconds += other.seconds

    def radiance(self) -> npt.NDArray[np.float32]:
        """Radiance [W sr⁻¹ m⁻²], float32 [height, width, 3], linear Rec. 709, row 0 at the top.

        The mean of the iterations, its noise filtered or denoised if the settings say so.
        """
        pictures: list[Image] = []
        if self.reconstruction is not None and self.iterations > 0:
            direct, indirect = self._reconstruct()[:2]
            pictures.append(direct + indirect)
        if self.settings is not None and self.settings.denoise and self.iterations > 0:
            pictures.append(self._denoise().copy())
        if not pictures:
            return self._sum(*_RADIANCE)
        # What two unlike filters do wrong is hardly related: their mean has less error than the better of them.
        return np.asarray(np.mean(pictures, axis=0)) if len(pictures) > 1 else pictures[0]

    def _denoise(self) -> npt.NDArray[np.float32]:
        """The denoised mean, computed once per iteration."""
        if self._denoised[0] != self.iterations:
            with self._launcher.phase("filter"):
                if self.reconstruction is not None:
                    albedo, normal, noisy = self._reconstruct()[2:]
                else:
                    albedo, normal, noisy = self.aov("albedo"), self.aov("normal"), self._sum(*_RADIANCE)
                clean = self.reconstruction is not None or self.iterations >= _CLEAN_ITERATIONS
                limit = None if self.settings is None else self.settings.time_limit
                picture = denoise(noisy, albedo, normal, clean, limit)
            self._denoised = (self.iterations, picture)
        return np.asarray(self._denoised[1])

    def _reconstruct(self) -> npt.NDArray[np.float32]:
        """What `Reconstruction.resolve` makes of the film, computed once per iteration."""
        if self._resolved[0] != self.iterations:
            features = self.settings is not None and self.settings.denoise
            self._resolved = (self.iterations, self.reconstruction.resolve(self._data, self.iterations, features))
        return np.asarray(self._resolved[1])

    def standard_error(self) -> npt.NDArray[np.float32]:
        """Standard error of `radiance` per pixel, float32 [height, width, 3]: √(se² + b²).

        se is that of the plain mean, by the spread of its iterations. Those are independent but for the pixel's
        stratified jitter: on edges the true error is smaller. What no iteration has met it cannot know: on the very
        edge of a lamp, before the first sample that hits it, it is too small.

        b is the filter's bias, 0 without a filter: of the squared difference between its picture and the plain mean,
        the share that is more than se² explains, over a tile of 8 x 8 pixels. The noise that the filter takes away is
        not subtracted, since neighbours share what it leaves: where it works well, the error is about half of this.
        What a denoiser does is not in it.

        Infinite where there are fewer than two iterations.
        """
        n = self._data.count.numpy().reshape(self.height, self.width, 1)
        error = self._sum("deviation") / np.sqrt(np.maximum(n - 1, 1), dtype=np.float32)
        if self.reconstruction is not None and self.iterations > 1:
            apart = self._apart()
            noise, change = measure(self._data, self.tiles, self._floor(), self._launcher, apart)[:, 2:].T
            share = np.sqrt(1.0 - np.divide(noise, change, out=np.ones_like(noise), where=change > noise))
            tiles = share.astype(np.float32).reshape(-(-self.height // TILE), -1)
            pixels = tiles.repeat(TILE, axis=0).repeat(TILE, axis=1)[: self.height, : self.width, None]
            error = np.hypot(error, apart * pixels)
        return np.where(n > 1, error, np.float32(np.inf))

    def error(self) -> float:
        """Estimated relative RMS error of the picture: √ of the mean of se² / (L² + 0.01 m²).

        se is `standard_error`: if there is a filter, the picture has to be made for it, unless it has been. m is the
        mean of the radiance L. Where L is uncertain, its neighbours' stands for it in part, if that is less: what is
        bright by chance is off by more than its own brightness tells.

        NaN with fewer than two iterations.
        """
        if self.iterations < 2:
            return math.nan
        return math.sqrt(self.squared_errors(filtered=True).sum())

    def squared_errors(self, *, filtered: bool = False) -> npt.NDArray[np.float64]:
        """What every tile of 8 x 8 pixels has in the square of `error`, [tiles], row by row.

        `filtered` says whether to make the picture and to add the filter's part.
        """
        wanted = filtered and self.reconstruction is not None and self.iterations > 1
        apart = self._apart() if wanted else None
        _, error, noise, change = measure(self._data, self.tiles, self._floor(), self._launcher, apart).T
        return np.asarray((error + np.maximum(change - noise, 0.0)) / (3 * self.width * self.height))

    def _apart(self) -> npt.NDArray[np.float32]:
        """How far the filtered picture is off the plain mean, [height, width, 3]; 0 beside what emits.

        There the filter has seen more of the pixel than the mean, by more camera rays.
        """
        apart = np.asarray(self._reconstruct()[:2].sum(axis=0) - self._sum(*_RADIANCE))
        glows = np.pad(self._sum("emission").max(axis=-1) > 0.0, 1)
        for axis in (0, 1):
            glows = glows | np.roll(glows, 1, axis) | np.roll(glows, -1, axis)
        return np.where(glows[1:-1, 1:-1, None], np.float32(0.0), apart)

    def _floor(self) -> float:
        """0.01 m² of `error`."""
        mean = measure(self._data, self.tiles, 0.0, self._launcher)[:, 0].sum() / (3 * self.width * self.height)
        return float(0.01 * mean**2)

    def aov(self, name: str) -> Image:
        """One of `AOV_NAMES`.

        "direct" (emitted, or reflected once) and "indirect" [h, w, 3] add up to the radiance, unless it is
        denoised. "albedo", "normal" (shading, unit), "position"
        (world) [h, w, 3] and "depth" (along the view, scene units) [h, w] are means over the surface samples of the
        pixel, 0 where there are none; "alpha" [h, w] is the covered share; "prim_id" int32 [h, w] the
        index into `Scene.meshes` that the first iteration saw, -1 for the background.

        Raises:
            InputError: There is no such AOV.
        """
        shape = (self.height, self.width)
        if name in ("direct", "indirect") and self.reconstruction is not None and self.iterations > 0:
            return self._reconstruct()[("direct", "indirect").index(name)]
        if name == "direct":
            return self._sum("emission", "direct")
        if name == "indirect":
            return self._sum("indirect")
        if name == "prim_id":
            return self._data.mesh.numpy().reshape(shape) if self.iterations else np.full(shape, -1, np.int32)
        hits = self._data.hits.numpy().reshape(shape)
        if name == "alpha":
            count = self._data.count.numpy().reshape(shape)
            return (hits / np.maximum(count, 1)).astype(np.float32)
        if name not in AOV_NAMES:
            raise InputError(f"aov: there is no {name!r}; there are {', '.join(AOV_NAMES)}")
        total = getattr(self._data, name).numpy().astype(np.float64).reshape(*shape, -1)
        seen = hits[..., None] > 0
        mean = np.divide(total, hits[..., None], out=np.zeros_like(total), where=seen)
        if name == "normal":
            length = np.linalg.norm(mean, axis=-1, keepdims=True)
            mean = np.divide(mean, length, out=np.zeros_like(mean), where=length > 0.0)
        if name == "position" and self._frame is not None:
            mean = np.where(seen, self._frame.to_world(mean), 0.0)
        if name == "depth":
            mean = mean[..., 0] / (self._frame.scale if self._frame is not None else 1.0)
        return mean.astype(np.float32)

    @property
    def skipped(self) -> int:
        """Samples of pixels that iterations have left out, their tiles being done."""
        return self.iterations * self.width * self.height - int(self._data.count.numpy().sum(dtype=np.int64))

    @property
    def rejected(self) -> int:
        """Samples that were not finite and count as black; 0 unless something is wrong."""
        return int(self._data.rejected.numpy().sum())

    def save(self, path: str | os.PathLike[str], key: str = "") -> None:
        """Writes the film, sums and all, as .npz: `load` and `resume` give it back bit for bit.

        Args:
            path: The file.
            key: Says what it is a film of; `resume` compares it.
        """
        arrays = {name: getattr(self._data, name).numpy() for name in FilmData.vars}
        if self.reconstruction is not None:
            arrays |= {_SEEN + name: array.numpy() for name, array in self.reconstruction.arrays().items()}
        origin, scale = (self._frame.origin, self._frame.scale) if self._frame is not None else (np.zeros(3), 1.0)
        arrays |= {"origin": origin, "scale": scale, "chosen": self.chosen, "seconds": self.seconds}
        with open(path, "wb") as file:
            np.savez(file, key=key, size=np.array([self.width, self.height, self.iterations]), **arrays)

    def resume(self, path: str | os.PathLike[str], key: str = "") -> None:
        """Goes on where a film was when `save` wrote it: this one, empty and of the same scene, becomes that one.

        Raises:
            InputError: The file is missing, is no film, or is one of something else.
        """
        wanted = {name: getattr(self._data, name) for name in FilmData.vars}
        if self.reconstruction is not None:
            wanted |= {_SEEN + name: array for name, array in self.reconstruction.arrays().items()}
        about = _read(path, ["key", "size", "seconds", "chosen"])
        if str(about["key"]) != key or about["size"][:2].tolist() != [self.width, self.height]:
            raise InputError(f"{os.fspath(path)}: a film of another scene, or with other settings")
        arrays = _read(path, [*wanted])
        if any(arrays[name].shape[0] != array.shape[0] for name, array in wanted.items()):
            raise InputError(f"{os.fspath(path)}: not a film: its arrays differ in size")
        for name, array in wanted.items():
            array.assign(arrays[name])
        self.iterations, self.seconds = int(about["size"][2]), float(about["seconds"])
        self._take_tiles(about["chosen"])

    @staticmethod
    def load(path: str | os.PathLike[str], device: str = "cpu") -> "Film":
        """Reads a film that `save` wrote.

        Raises:
            InputError: The file is missing or is no film.
        """
        from warp_ir.device_scene import DeviceFrame

        arrays = _read(path, [*FilmData.vars, "size", "seconds", "chosen", "origin", "scale"])
        width, height, iterations = (int(x) for x in arrays["size"])
        frame = DeviceFrame(arrays["origin"], float(arrays["scale"]))
        film = Film(width, height, Launcher(device), frame, glows=len(arrays["emission"]) > 0)
        film.iterations, film.seconds = iterations, float(arrays["seconds"])
        for name in FilmData.vars:
            getattr(film._data, name).assign(arrays[name])
        film._take_tiles(arrays["chosen"])
        return film

    def _take_tiles(self, chosen: npt.NDArray[np.bool_]) -> None:
        """Finds out how many iterations have left out each tile; chooses those of the next."""
        count = self._data.count.numpy().reshape(self.height, self.width)
        self._skipped = (self.iterations - count[::TILE, ::TILE]).astype(np.int32).reshape(-1)
        self.choose(chosen)

    def _sum(self, *names: str) -> npt.NDArray[np.float32]:
        """The sum of some tables, float32 [height, width, 3]; never a view of one."""
        total = np.zeros((self.width * self.height, 3), np.float32)
        for name in names:
            if name != "emission" or self._data.emission.shape[0] > 0:
                total += getattr(self._data, name).numpy()
        return total.reshape(self.height, self.width, 3)


def _read(path: str | os.PathLike[str], names: Sequence[str]) -> dict[str, Any]:
    """Arrays of a file that `Film.save` wrote."""
    try:
        with open(path, "rb") as stream, np.load(stream) as file:
            return {name: file[name] for name in names}
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{os.fspath(path)}: not a film: {error}") from error
