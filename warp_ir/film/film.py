"""The film: a mean, a standard deviation and a count per pixel. Iterations are added, films are merged."""

import base64
import functools
import math
import os
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, Protocol, TypeVar, overload

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.device_scene import DeviceFrame
from warp_ir.film.accumulate import FIELDS, FilmData, add_samples, film_arrays, new_film_data, write_radiance
from warp_ir.film.denoise import denoise
from warp_ir.film.error_estimate import tile_errors
from warp_ir.film.picture_noise import PictureNoise, tile_sums
from warp_ir.film.samples import RADIANCE, FilmSamples, merge_rows
from warp_ir.film.storage import (
    RECONSTRUCTION,
    FilmFile,
    FilmState,
    check_counts,
    layout_of,
    open_film,
    reconstruction_names,
    write_film,
)
from warp_ir.gbuffer import GBuffer
from warp_ir.image.io import write_image
from warp_ir.scene import InputError
from warp_ir.settings import RenderSettings
from warp_ir.tiles import TILE, Tiles, all_tiles, some_tiles, tile_count

if TYPE_CHECKING:
    from typing import Self  # Python 3.11

AOV_NAMES = ("direct", "indirect", "albedo", "normal", "position", "depth", "alpha", "prim_id")
"""Names that `Film.aov` accepts."""
Image = npt.NDArray[np.float32]
"""[height, width, 3]."""
_CLEAN_ITERATIONS = 8
"""Iterations from which the mean albedo and normals have less noise than a denoiser would leave in them."""


_P = ParamSpec("_P")
_R = TypeVar("_R")
_Out = TypeVar("_Out")


def _exclusive(method: "Callable[Concatenate[Film, _P], _R]") -> "Callable[Concatenate[Film, _P], _R]":
    """A method of `Film` that no other thread disturbs: the film does not change meanwhile, nor do shared buffers."""

    @functools.wraps(method)
    def alone(film: "Film", /, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        with film._launcher.exclusive:
            return method(film, *args, **kwargs)

    return alone


class PictureFilter(Protocol):
    """What a film requires of the `Reconstruction` that filters its picture."""

    def accumulate(self, gbuffer: GBuffer, shutter_sample: int = 0) -> None:
        """Adds one iteration's samples."""

    def arrays(self) -> dict[str, "wp.array[Any]"]:
        """The sums over the samples by name; they are saved with the film."""

    def merge(self, other: "Self") -> None:
        """Adds the samples of another film's filter."""

    def cost(self, iterations: int) -> tuple[float, float]:
        """Cost of `resolve` for each pixel, in camera rays and in samples added to the film."""

    def resolve(self, film: FilmData, iterations: int, features: bool = False) -> npt.NDArray[np.float32]:
        """Direct and indirect radiance, [2, height, width, 3]; with `features` [5, ...], see `Reconstruction`."""


class Film:
    """The result of a render, to which further iterations can be added.

    `render` returns one, `merge` adds another film of the same picture.
    """

    AOV_NAMES = AOV_NAMES

    def __init__(
        self,
        width: int,
        height: int,
        launcher: Launcher,
        frame: DeviceFrame | None = None,
        *,
        has_emission: bool = True,
        sees_lights: bool = False,
        sees_dome: bool = False,
    ) -> None:
        """Makes an empty film on the launcher's device.

        Args:
            width: Pixels across.
            height: Pixels down.
            launcher: Runs the film's kernels.
            frame: Device frame of the scene, which takes positions and depths back to world space; None: they stay
                as they are.
            has_emission: Whether the camera may see emission.
            sees_lights: Whether it may see lights that are no surfaces; then it may see emission.
            sees_dome: Whether a dome is among them.
        """
        self.width, self.height = width, height
        self.iterations = 0
        """Iterations added; tiles that were not chosen have fewer (`tile_iterations`)."""
        self.seconds = 0.0
        """Wall time since the call that rendered it, up to the picture [s]: `render` uploads within this time."""
        self.interrupted = 0
        """Number of the signal that ended the render before its limit; 0: none."""
        self.settings: RenderSettings | None = None
        """The settings it was rendered with; None if it was loaded from a file."""
        self.timings: dict[str, float] = {}
        """Seconds by phase; the first film of a renderer includes compiling and uploading."""
        self.counts: dict[str, int] = {}
        """Numbers of rays, VPLs and others over all iterations."""
        self.reconstruction: PictureFilter | None = None
        """The filter of the picture; None: the picture is the unfiltered mean."""
        self.origin: object = None
        """The `Scene` to which its iterations belong; None: it was made without a renderer."""
        self.emits = False
        """Whether anything in the scene emits: then no surface need be black."""
        self._resolved: tuple[int, npt.NDArray[np.float32]] | None = None  # iterations, and the picture made of them
        self._denoised: tuple[int, Image] | None = None
        self._noise: PictureNoise | None = None
        self._frame = frame or DeviceFrame(np.zeros(3), 1.0)
        self._launcher = launcher
        self._data = new_film_data(width * height, has_emission, sees_lights, launcher)
        self._sees_dome = sees_dome
        self._skipped: npt.NDArray[np.int32] = np.zeros(tile_count(width, height), np.int32)
        self._skipped_before = np.zeros_like(self._skipped)  # by what came before a film that is a part of another
        self.chosen: npt.NDArray[np.bool_] = np.ones(len(self._skipped), bool)
        """[tiles], whether the next iteration is for a tile of 8 x 8 pixels; row by row."""
        self.tiles: Tiles = all_tiles(width, height, launcher)
        """The chosen tiles on the device."""

    def choose(self, tiles: npt.NDArray[np.bool_]) -> None:
        """Restricts the following iterations to the tiles for which `tiles` [tiles] is true."""
        self.chosen = tiles
        skipped = self._skipped + self._skipped_before
        self.tiles = some_tiles(tiles, skipped, self.width, self.height, self._launcher)

    @property
    def tile_iterations(self) -> npt.NDArray[np.int32]:
        """Number of iterations of every tile of 8 x 8 pixels, [tiles], row by row."""
        return self.iterations - self._skipped

    def accumulate(self, gbuffer: GBuffer, exposure: float = 1.0, shutter_sample: int = 0) -> None:
        """Adds one iteration on the device: a G-buffer that an estimator has filled, multiplied by `exposure`.

        With motion blur, `shutter_sample` is the number of the shutter sample that it was made at.
        """
        add_samples(gbuffer, exposure, self._sees_dome, self._data, self._launcher)
        if self.reconstruction is not None:
            self.reconstruction.accumulate(gbuffer, shutter_sample)

    def count_iteration(self) -> None:
        """Counts, on the host, an iteration that `accumulate` has added: a CUDA graph repeats that alone."""
        self.iterations += 1
        if not self.chosen.all():
            self._skipped += ~self.chosen
            self.tiles.skipped.assign(self._skipped + self._skipped_before)

    @_exclusive
    def merge(self, other: "Film") -> None:
        """Adds another film of the same picture, which must come from other iterations or another seed.

        Raises:
            InputError: The films differ in size, or only one of them stores emission, or sees lights.
        """
        if (self.width, self.height) != (other.width, other.height):
            raise InputError(f"film: cannot merge {other.width}x{other.height} into {self.width}x{self.height} pixels")
        for name, what in (("emission", "emission"), ("lights", "visible lights")):
            if getattr(self._data, name).shape != getattr(other._data, name).shape:
                raise InputError(f"film: cannot merge a film with {what} and one without")
        if other.iterations == 0:
            return
        others = {name: array.numpy() for name, array in film_arrays(other._data).items()}
        self._add(film_arrays(self._data), None, others)
        if self.reconstruction is not None and other.reconstruction is not None:
            self.reconstruction.merge(other.reconstruction)
        self._noise = None  # it is of one sequence of iterations
        self.iterations += other.iterations
        self._skipped += other._skipped
        self.choose(self.chosen)
        self.seconds += other.seconds

    @_exclusive
    def clear(self, tiles: npt.NDArray[np.bool_], skipped: npt.NDArray[np.int32]) -> None:
        """Empties the film, so that it takes the samples of a part of a render.

        Args:
            tiles: The tiles that the following iterations sample, [tiles].
            skipped: Iterations before them that left out each tile, [tiles].
        """
        for array in self._saved_arrays().values():
            array.zero_()
        self.iterations, self.timings, self.counts = 0, {}, {}
        self._skipped, self._skipped_before = np.zeros_like(self._skipped), skipped
        self._resolved = self._denoised = self._noise = None
        if np.array_equal(tiles, self.chosen):
            self.tiles.skipped.assign(skipped)  # the same record, so that launches are repeated
        else:
            self.choose(tiles)

    @_exclusive
    def samples(self) -> FilmSamples:
        """What its iterations have found, on the host."""
        arrays = {name: array.numpy() for name, array in self._saved_arrays().items()}
        seen = arrays["count"] > 0
        for name in ("count", "unassigned_count"):  # the filter's samples may lie on other pixels
            seen |= arrays.get(f"{RECONSTRUCTION}{name}", seen) > 0
        rows = None if seen.all() else np.flatnonzero(seen)
        values = {
            name: np.copy(array if rows is None or not len(array) else array[rows]) for name, array in arrays.items()
        }
        return FilmSamples(self.iterations, rows, values, dict(self.timings), dict(self.counts))

    @_exclusive
    def add(self, samples: FilmSamples, iterations: int) -> None:
        """Adds samples of further iterations of the same picture, which films of other renderers have collected.

        Args:
            samples: What `samples` has returned there.
            iterations: Iterations of this film with these samples, and with those that other tiles get from the same.
        """
        if samples.iterations:
            self._add(self._saved_arrays(), samples.rows, samples.arrays)
        for mine, theirs in ((self.timings, samples.timings), (self.counts, samples.counts)):
            for key, value in theirs.items():
                mine[key] = mine.get(key, 0) + value  # type: ignore[assignment]  # seconds, or numbers
        self.iterations = iterations
        self._resolved = self._denoised = None
        self._count_skipped()
        self.choose(self.chosen)

    def _add(
        self,
        arrays: "dict[str, wp.array[Any]]",
        rows: npt.NDArray[np.intp] | None,
        others: Mapping[str, npt.NDArray[Any]],
    ) -> None:
        """Merges arrays of other iterations, of some pixels or of all, into those of the film."""
        mine = {name: array.numpy() for name, array in arrays.items()}  # on a CPU these are the arrays themselves
        merge_rows(mine, rows, others, self._launcher.threads)
        if not self._launcher.device.is_cpu:
            for name, array in arrays.items():
                array.assign(mine[name])

    @overload
    def radiance(self) -> npt.NDArray[np.float32]: ...
    @overload
    def radiance(self, out: _Out) -> _Out: ...
    def radiance(self, out: Any = None) -> Any:
        """Radiance [W sr⁻¹ m⁻²], float32 [height, width, 3], linear Rec. 709, row 0 at the top.

        The mean of the iterations, filtered or denoised if the settings say so.

        Args:
            out: Where to write it: a C-contiguous float32 array [height, width, 3] on the film's device, of NumPy, Warp
                or any package that speaks DLPack, such as PyTorch. It has been written when the call returns. The mean
                is written there by a kernel, without a copy; a filtered or denoised picture lies on the host, and is
                copied. None: a new NumPy array.

        Returns:
            `out`, or the new array.

        Raises:
            InputError: `out` is no such array.
        """
        if out is None:
            return self._radiance()
        self._write_radiance(self._writable(out))
        return out

    @_exclusive
    def _write_radiance(self, array: "wp.array[Any]") -> None:
        """Writes the radiance to an array that `_writable` has checked."""
        if self.iterations > 0 and (self.reconstruction is not None or (self.settings and self.settings.denoise)):
            array.assign(self._radiance())
        else:
            # A launch could be cancelled by a signal that ends a render.
            with self._launcher.uninterruptible():
                write_radiance(self._data, array.view(wp.vec3).reshape(self.width * self.height), self._launcher)
        wp.synchronize_device(self._launcher.device)

    def to_warp(self) -> "wp.array[wp.float32]":
        """The radiance as a new Warp array, float32 [height, width, 3], on the film's device.

        It is what `radiance` writes: later iterations do not change it.
        """
        return self.radiance(out=self._launcher.empty((self.height, self.width, 3), wp.float32))

    def __dlpack__(
        self,
        *,
        stream: int | None = None,
        max_version: tuple[int, int] | None = None,  # Warp's capsules are of version 0, which everyone takes
        dl_device: tuple[int, int] | None = None,
        copy: bool | None = None,
    ) -> Any:
        """The array of `to_warp` by DLPack, as `numpy.from_dlpack(film)` and `torch.from_dlpack(film)` ask for it.

        The picture is made for the call, and handed over without a further copy.

        Raises:
            BufferError: Another device is asked for, or memory that is not the caller's own.
        """
        if dl_device not in (None, self.__dlpack_device__()):
            raise BufferError(f"the film is on {self._launcher.device}")
        if copy is False:
            raise BufferError("the picture of a film is made anew by each call")
        return self.to_warp().__dlpack__(stream)

    def __dlpack_device__(self) -> tuple[int, int]:
        """Type and number of the film's device, in DLPack's terms."""
        kind, number = self._launcher.empty(1, wp.float32).__dlpack_device__()
        return int(kind), int(number)

    def _writable(self, out: Any) -> "wp.array[Any]":
        """`out` as a Warp array on the same memory.

        Raises:
            InputError: It is no array that the radiance can be written to.
        """
        wanted = f"a C-contiguous float32 array [{self.height}, {self.width}, 3] on {self._launcher.device}"
        array: wp.array[Any] | None = None
        try:
            if isinstance(out, np.ndarray):
                good = out.dtype == np.float32 and out.flags.c_contiguous and out.flags.writeable
                array = wp.array(out, dtype=wp.float32, copy=False, device="cpu") if good else None
            else:
                array = out if isinstance(out, wp.array) else wp.from_dlpack(out)  # type: ignore[assignment]  # stubs
        except (TypeError, ValueError, RuntimeError, AttributeError, BufferError) as error:
            raise InputError(f"out: must be {wanted}: {error}") from error
        good = array is not None and array.dtype is wp.float32 and array.shape == (self.height, self.width, 3)
        if array is None or not (good and array.is_contiguous and array.device == self._launcher.device):
            raise InputError(f"out: must be {wanted}")
        return array

    @_exclusive
    def _radiance(self) -> Image:
        """The radiance on the host."""
        pictures: list[Image] = []
        if self.reconstruction is not None and self.iterations > 0:
            direct, indirect = self._reconstruct(self.reconstruction)[:2]
            pictures.append(direct + indirect)
        if self.settings is not None and self.settings.denoise and self.iterations > 0:
            pictures.append(self._denoise().copy())
        if not pictures:
            return self._radiance_of(*RADIANCE)
        # The errors of the two filters are hardly correlated: the mean has less error than the better of them.
        return np.asarray(np.mean(pictures, axis=0)) if len(pictures) > 1 else pictures[0]

    def _denoise(self) -> Image:
        """The denoised mean, made once for a number of iterations."""
        if self._denoised is None or self._denoised[0] != self.iterations:
            with self._launcher.phase("filter"):
                if self.reconstruction is not None:
                    albedo, normal, noisy = self._reconstruct(self.reconstruction)[2:]
                else:
                    albedo, normal, noisy = self.aov("albedo"), self.aov("normal"), self._radiance_of(*RADIANCE)
                clean = self.reconstruction is not None or self.iterations >= _CLEAN_ITERATIONS
                limit = None if self.settings is None else self.settings.time_limit
                picture = denoise(noisy, albedo, normal, clean, limit)
            self._denoised = (self.iterations, picture)
        return self._denoised[1]

    def _reconstruct(self, reconstruction: PictureFilter) -> npt.NDArray[np.float32]:
        """The result of `Reconstruction.resolve`, made once for a number of iterations."""
        if self._resolved is None or self._resolved[0] != self.iterations:
            features = self.settings is not None and self.settings.denoise
            self._resolved = (self.iterations, reconstruction.resolve(self._data, self.iterations, features))
        return self._resolved[1]

    @_exclusive
    def standard_error(self) -> npt.NDArray[np.float32]:
        """Standard error of `radiance` per pixel, float32 [height, width, 3]: √(se² + b²).

        se is the standard error of the unfiltered mean, from the spread of its iterations. They are independent except
        for the stratified pixel jitter: on edges the true error is smaller. What no iteration has hit is not in it: at
        the edge of a lamp se is too small before the first sample hits the lamp.

        b is the bias of the filter, 0 without a filter: b² is the part of the squared difference between filtered and
        unfiltered picture that exceeds se², over a tile of 8 x 8 pixels. The noise that the filter removes is not
        subtracted, since the remaining noise is correlated between neighbours: where the filter works well, the true
        error is about half of this. The error of a denoiser is not in it.

        Infinite where a pixel has fewer than two iterations.
        """
        n = self._data.count.numpy().reshape(self.height, self.width, 1)
        error = self._radiance_of("standard_deviation") / np.sqrt(np.maximum(n - 1, 1), dtype=np.float32)
        if self.reconstruction is not None and self.iterations > 1:
            difference = self._filter_difference(self.reconstruction)
            noise, change = self._tile_errors(difference)[:, 2:].T
            bias_fraction = np.sqrt(1.0 - np.divide(noise, change, out=np.ones_like(noise), where=change > noise))
            tiles = bias_fraction.astype(np.float32).reshape(-(-self.height // TILE), -1)
            pixels = tiles.repeat(TILE, axis=0).repeat(TILE, axis=1)[: self.height, : self.width, None]
            error = np.hypot(error, difference * pixels)
        return np.where(n > 1, error, np.float32(np.inf))

    @_exclusive
    def error(self) -> float:
        """Estimated relative RMS error of the picture: √ of the mean of (se² + b²) / (L² + 0.01 m²).

        se and b are those of `standard_error`, m is the mean of the radiance L. With a filter the picture is made for
        it, unless it has been made. Where `measure_noise` has seen three pictures, se is the noise that the filter
        leaves, with an allowance for its bias. Where L is uncertain, the denominator moves towards the smaller median
        of its neighbours: a pixel that is bright by chance has an error larger than its brightness suggests.

        1 if the scene emits and none of that light has reached a surface in view: what the samples have missed is
        unknown. NaN with fewer than two iterations.
        """
        if self.iterations < 2:
            return math.nan
        if self.is_unlit():
            return 1.0
        return math.sqrt(self.squared_errors(filtered=True).sum())

    @_exclusive
    def is_unlit(self) -> bool:
        """Whether the camera sees surfaces that reflect, and no iteration has found any light on them."""
        if not self.emits or not (self._data.albedo.numpy() > 0.0).any():
            return False
        return not (self._data.direct.numpy().any() or self._data.indirect.numpy().any())

    @_exclusive
    def squared_errors(self, *, filtered: bool = False) -> npt.NDArray[np.float64]:
        """Contribution of every tile of 8 x 8 pixels to the square of `error`, [tiles], row by row.

        `filtered` says whether to make the picture and to include the bias of the filter.
        """
        difference = None
        if filtered and self.reconstruction is not None and self.iterations > 1:
            difference = self._filter_difference(self.reconstruction)
        _, error, noise, change = self._tile_errors(difference).T
        error, bias = (x / (3 * self.width * self.height) for x in (error, np.maximum(change - noise, 0.0)))
        return np.asarray(self.filtered_errors(error) + bias if filtered else error)

    def measure_noise(self) -> None:
        """Makes the filtered picture, and compares it with the last one for which this was called.

        To be called at powers of two of the iterations. From the third picture on, `error` tells what the filter gains.
        """
        if self.reconstruction is None:
            return
        picture = np.asarray(self._reconstruct(self.reconstruction)[:2].sum(axis=0))
        iterations = self.tile_iterations
        self._noise = (
            PictureNoise.first(picture, iterations) if self._noise is None else self._noise.updated(picture, iterations)
        )

    def filtered_errors(self, plain: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """`squared_errors` of the filtered picture as far as it is known without making it, from those of the mean.

        The mean's are taken if they are smaller, and where emission is in view: the first camera rays on an edge are
        those of the last picture, so that its error changes little.
        """
        if self._noise is None:
            return plain
        errors = self._noise.squared_errors(self.tile_iterations) / (3 * self.width * self.height)
        emissive = tile_sums(self._near_emission()[..., None].astype(np.float64)) > 0.0
        errors = np.where(emissive, plain, errors)
        return errors if errors.sum() < plain.sum() else plain  # NaN: not known yet

    def _near_emission(self) -> npt.NDArray[np.bool_]:
        """Pixels [height, width] that see emission, and their neighbours."""
        emissive = np.pad(self._radiance_of("emission").max(axis=-1) > 0.0, 1)
        for axis in (0, 1):
            emissive = emissive | np.roll(emissive, 1, axis) | np.roll(emissive, -1, axis)
        return np.asarray(emissive[1:-1, 1:-1])

    def _tile_errors(self, filter_difference: Image | None) -> npt.NDArray[np.float64]:
        """Sums of `tile_errors` over every tile, relative to L² + 0.01 m²."""
        sums = tile_errors(self._data, self.tiles, 0.0, self._launcher)
        mean = sums[:, 0].sum() / (3 * self.width * self.height)
        return tile_errors(self._data, self.tiles, float(0.01 * mean**2), self._launcher, filter_difference)

    def _filter_difference(self, reconstruction: PictureFilter) -> Image:
        """Filtered picture minus unfiltered mean, [height, width, 3]; 0 at and next to pixels that see emission.

        There the picture is made of more camera rays than the mean, so that the difference is no bias.
        """
        difference = np.asarray(self._reconstruct(reconstruction)[:2].sum(axis=0) - self._radiance_of(*RADIANCE))
        return np.where(self._near_emission()[..., None], np.float32(0.0), difference)

    @_exclusive
    def aov(self, name: str) -> npt.NDArray[Any]:
        """One of `AOV_NAMES`, row 0 at the top.

        "direct" (emitted, or reflected once) and "indirect" [h, w, 3] add up to the radiance, unless it is denoised.
        "albedo", "normal" (shading normal, unit), "position" (world space) [h, w, 3] and "depth" (along the camera's
        axis, scene units) [h, w] are means over the surface samples of the pixel, 0 where there are none. "alpha"
        [h, w] is the fraction of the samples that hit a surface, or a light that the camera sees. "prim_id" int32
        [h, w] is the index into `Scene.meshes` that the first iteration hit, -1 for the background.

        Raises:
            InputError: There is no such AOV.
        """
        shape = (self.height, self.width)
        if name in ("direct", "indirect") and self.reconstruction is not None and self.iterations > 0:
            return np.asarray(self._reconstruct(self.reconstruction)[("direct", "indirect").index(name)])
        if name == "direct":
            return self._radiance_of("emission", "direct")
        if name == "indirect":
            return self._radiance_of("indirect")
        if name == "prim_id":
            mesh = np.asarray(self._data.mesh.numpy())
            return mesh.reshape(shape) if self.iterations else np.full(shape, -1, np.int32)
        hits = self._data.hits.numpy().reshape(shape)
        if name == "alpha":
            count = self._data.count.numpy().reshape(shape)
            if self._data.lights.shape[0] > 0:
                hits = hits + self._data.lights.numpy().reshape(shape)
            return np.asarray((hits / np.maximum(count, 1)).astype(np.float32))
        if name not in AOV_NAMES:
            raise InputError(f"aov: there is no {name!r}; there are {', '.join(AOV_NAMES)}")
        total = film_arrays(self._data)[name].numpy().astype(np.float64).reshape(*shape, -1)
        covered = hits[..., None] > 0
        mean = np.divide(total, hits[..., None], out=np.zeros_like(total), where=covered)
        if name == "normal":
            length = np.linalg.norm(mean, axis=-1, keepdims=True)
            mean = np.divide(mean, length, out=np.zeros_like(mean), where=length > 0.0)
        if name == "position":
            mean = np.where(covered, self._frame.to_world(mean), 0.0)
        if name == "depth":
            mean = mean[..., 0] / self._frame.scale
        return np.asarray(mean.astype(np.float32))

    @property
    def skipped(self) -> int:
        """Number of pixel samples that iterations have skipped, because their tiles were not chosen."""
        return self.iterations * self.width * self.height - int(self._data.count.numpy().sum(dtype=np.int64))

    @property
    def rejected(self) -> int:
        """Number of samples that were not finite and count as black; 0 unless something is wrong."""
        return int(self._data.rejected.numpy().sum())

    def _repr_html_(self) -> str:
        """How notebooks show a film: the picture, what it took, and its error."""
        caption = f"{self.width} x {self.height}, {self.iterations} iterations in {self.seconds:.1f} s"
        if self.iterations > 1:
            caption += f", estimated error {100.0 * self.error():.2g} %"
        with tempfile.TemporaryDirectory() as folder:
            (picture,) = write_image(Path(folder) / "film.png", self)
            data = base64.b64encode(picture.read_bytes()).decode("ascii")
        return f'<img src="data:image/png;base64,{data}" alt="{caption}"><br>{caption}'

    @_exclusive
    def save(self, path: str | os.PathLike[str], key: str = "", note: str = "") -> None:
        """Writes the film and the samples of its filter as .npz; `load` and `resume` restore it bit for bit.

        Args:
            path: The file.
            key: Identifies the scene and the settings; `resume` compares it.
            note: A text of the caller's, which is stored with it.
        """
        state = FilmState(key, self.width, self.height, self.iterations, self.seconds, self.chosen, self._frame, note)
        write_film(path, state, self._saved_arrays(), self._noise)

    def resume(self, path: str | os.PathLike[str], key: str = "") -> None:
        """Restores a film that `save` wrote into this one, which must be empty and of the same scene.

        Raises:
            InputError: The file is missing, is no film, or is one of another scene or size.
        """
        with open_film(path) as file:
            state = file.state
            if state.key != key or (state.width, state.height) != (self.width, self.height):
                raise InputError(f"{os.fspath(path)}: a film of another scene, or with other settings")
            noise = file.read_noise()
            self._restore(file, self._saved_arrays())
            self._noise = noise

    @staticmethod
    def load(path: str | os.PathLike[str], device: str = "cpu") -> "Film":
        """Reads a film that `save` wrote, without its filter: its picture is the unfiltered mean.

        Raises:
            InputError: The file is missing or is no film.
        """
        with open_film(path) as file:
            state, pixels = file.state, file.state.width * file.state.height
            rows = {name: pixels if file.rows(name) else 0 for name in ("emission", "lights")}
            for name, dtype in FIELDS.items():  # before memory is taken
                file.check_layout(name, layout_of(dtype, rows.get(name, pixels)))
            film = Film(
                state.width,
                state.height,
                Launcher(device),
                state.frame,
                has_emission=rows["emission"] > 0,
                sees_lights=rows["lights"] > 0,
            )
            film._restore(file, film_arrays(film._data))
        return film

    def _saved_arrays(self) -> "dict[str, wp.array[Any]]":
        """The arrays of the film and of its filter, by their names in a file."""
        arrays = film_arrays(self._data)
        if self.reconstruction is not None:
            arrays |= reconstruction_names(self.reconstruction.arrays())
        return arrays

    def _restore(self, file: FilmFile, arrays: "dict[str, wp.array[Any]]") -> None:
        """Copies stored arrays into those of the same name, and takes over the rest of the state."""
        stored = file.read({name: layout_of(array.dtype, len(array)) for name, array in arrays.items()})
        meshes = getattr(self.origin, "meshes", None)
        check_counts(file, stored, None if meshes is None else len(meshes))
        for name, array in arrays.items():
            array.assign(stored[name])
        self.iterations, self.seconds = file.state.iterations, file.state.seconds
        self._count_skipped()
        self.choose(file.state.chosen)

    def _count_skipped(self) -> None:
        """Counts the iterations that have left out each tile, by those that its first pixel has."""
        count = self._data.count.numpy().reshape(self.height, self.width)
        self._skipped = (self.iterations - count[::TILE, ::TILE]).astype(np.int32).reshape(-1)

    def _radiance_of(self, *names: str) -> npt.NDArray[np.float32]:
        """Sum of some fields of `FilmData`, float32 [height, width, 3]; always a copy."""
        total = np.zeros((self.width * self.height, 3), np.float32)
        arrays = film_arrays(self._data)
        for name in names:
            if name != "emission" or self._data.emission.shape[0] > 0:
                total += arrays[name].numpy()
        return total.reshape(self.height, self.width, 3)
