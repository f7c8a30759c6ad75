"""Pictures on disk: a film or an array in, a file out, whole or not at all.

`.exr` `.hdr` `.pfm` and `.npy` hold linear radiance; `.png` and `.jpg` what a screen shows of it.
"""

import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from warp_ir.image.color_space import COLOR_SPACES, REC709, from_rec709
from warp_ir.image.tonemap import srgb_from_linear, tone_map
from warp_ir.scene import InputError

Array = npt.NDArray[np.floating]

AOV_CHANNELS = {
    "direct": ("direct.R", "direct.G", "direct.B"),
    "indirect": ("indirect.R", "indirect.G", "indirect.B"),
    "albedo": ("albedo.R", "albedo.G", "albedo.B"),
    "normal": ("normal.X", "normal.Y", "normal.Z"),
    "position": ("position.X", "position.Y", "position.Z"),
    "depth": ("Z",),
    "alpha": ("A",),
    "prim_id": ("prim_id",),
}
"""The channels of an EXR file that hold a film's AOVs; the colour itself is R, G, B and A."""

SUFFIXES = (".exr", ".hdr", ".pfm", ".npy", ".png", ".jpg", ".jpeg")
"""The kinds of picture that can be written."""

_HALF_MAX = 65504.0
_EXACT = frozenset({"position", "depth", "prim_id"})
"""AOVs that keep 32 bits in a half-float file: 11 bits are no distance and no name."""
_COLORS = frozenset({None, "direct", "indirect", "albedo"})
"""AOVs that are colours; None is the picture itself."""


_Layers = dict[str, tuple[Array, bool]]
"""Channels of an EXR file: name -> values, float32 [h, w], and whether they need 32 bits."""


class _Film(Protocol):
    """What is needed of a `Film` here."""

    @property
    def settings(self) -> Any: ...
    @property
    def iterations(self) -> int: ...
    @property
    def seconds(self) -> float: ...
    def radiance(self) -> Any: ...
    def error(self) -> float: ...
    def aov(self, name: str) -> Any: ...


def write_image(
    path: str | os.PathLike[str],
    source: "_Film | Array",
    *,
    exposure: float = 0.0,
    tonemap: str = "srgb",
    aov: str | None = None,
    aovs: Sequence[str] = (),
    half: bool = True,
    metadata: Mapping[str, object] | None = None,
    color_space: str | None = None,
) -> list[Path]:
    """Writes a picture; the extension says how.

    Args:
        path: `.exr` (colour, alpha, AOVs, metadata), `.hdr`, `.pfm`, `.npy` (linear), `.png`, `.jpg`
            (tone-mapped). An existing file is replaced.
        source: A film, or an array [h, w], [h, w, 1], [h, w, 3] or [h, w, 4] (with alpha, and the
            colour premultiplied by it), row 0 at the top.
        exposure: Stops; for `.png` and `.jpg` only.
        tonemap: "srgb" or "filmic"; for `.png` and `.jpg` only.
        aov: Name of the film's AOV to write in place of its radiance.
        aovs: Further AOVs of the film. In an EXR file they are layers of the same file; beside any
            other picture.png there will be a picture.NAME.png of each.
        half: Whether an EXR file stores colours with 16 bits; values beyond ±65504 are clamped.
        metadata: More attributes for an EXR file, beside the film's settings and statistics.
        color_space: One of `COLOR_SPACES`, in which colours are written where they stay linear; None: that of the
            film's settings, else linear Rec. 709, which arrays and films are in.

    Returns:
        The files written.

    Raises:
        InputError: The path cannot be written, or the extension, AOV, tone curve or colour space is unknown.
    """
    path = check_output(path)
    if color_space is None:
        color_space = getattr(getattr(source, "settings", None), "color_space", REC709)
    if color_space not in COLOR_SPACES:
        raise InputError(f"{path}: no colour space {color_space!r}; known are {', '.join(COLOR_SPACES)}")
    suffix = path.suffix.lower()
    if isinstance(source, np.ndarray) and (aov or aovs):
        raise InputError(f"{path}: an array has no AOVs; write a film")
    if suffix == ".exr":
        layers = _exr_layers(source, aov, aovs, color_space)
        attributes = {**_attributes(source, metadata or {}), "colorInteropID": color_space}
        _write_exr(path, layers, half, attributes, COLOR_SPACES[color_space], _windows(source))
        return [path]
    _write_flat(path, source, exposure, tonemap, aov, color_space)
    beside = [aov_path(path, name) for name in aovs]
    for name, other in zip(aovs, beside, strict=True):
        _write_flat(other, source, exposure, tonemap, name, color_space)
    return [path, *beside]


def read_image(path: str | os.PathLike[str], layer: str | None = None) -> npt.NDArray[np.float32]:
    """Reads a picture as it was stored (8-bit values as 0 to 1, not linearised), float32 [h, w, c].

    Args:
        path: Any of `SUFFIXES`, or whatever else OpenImageIO reads.
        layer: Name of an AOV in an EXR file; by default the colour, with alpha if there is one.

    Raises:
        InputError: The file cannot be read, or lacks the layer.
    """
    path = Path(path)
    if path.suffix.lower() == ".npy":
        try:
            values = np.asarray(np.load(path, allow_pickle=False), dtype=np.float32)
        except (OSError, ValueError, EOFError) as error:
            raise InputError(f"{path}: {_reason(error)}") from error
        if values.ndim not in (2, 3):
            raise InputError(f"{path}: an array of {values.ndim} dimensions is no picture")
        return values[..., None] if values.ndim == 2 else values
    import OpenImageIO as oiio

    # Values are given back as stored: no reader may multiply colour by alpha.
    hints = oiio.ImageSpec()
    hints.attribute("oiio:UnassociatedAlpha", 1)
    reader = oiio.ImageInput.open(str(path), hints)
    pixels = reader.read_image(oiio.FLOAT) if reader else None
    if reader is None or pixels is None:
        raise InputError(f"{path}: {_first_line(reader.geterror() if reader else oiio.geterror())}")
    names = list(reader.spec().channelnames)
    reader.close()
    pixels = np.asarray(pixels, dtype=np.float32).reshape(*pixels.shape[:2], -1)
    if layer is None:
        wanted = [name for name in ("R", "G", "B", "A") if name in names] or names
    else:
        wanted = list(AOV_CHANNELS.get(layer, ()))
        if not wanted or not set(wanted) <= set(names):
            raise InputError(f"{path}: has no layer {layer!r}; its channels are {', '.join(names)}")
    return np.ascontiguousarray(pixels[..., [names.index(name) for name in wanted]])


def aov_path(path: Path, aov: str) -> Path:
    """The file beside `path` that holds an AOV, where the format has no layers: a.png -> a.depth.png."""
    return path.with_name(f"{path.stem}.{aov}{path.suffix}")


def check_output(
    path: str | os.PathLike[str], suffixes: Sequence[str] = SUFFIXES, *, make_folder: bool = False
) -> Path:
    """Makes sure, before any work is done, that a file can be written.

    Args:
        path: The file to be written.
        suffixes: The extensions that are known, in lower case.
        make_folder: Whether to create the folder it is in.

    Raises:
        InputError: It cannot.
    """
    path = Path(path)
    try:
        if "\0" in str(path):
            raise InputError(f"{str(path)!r}: a path cannot hold a null character")
        if path.is_dir():
            raise InputError(f"{path}: is a folder; name the file to write")
        if path.suffix.lower() not in suffixes:
            raise InputError(f"{path}: unknown extension {path.suffix!r}; known are {' '.join(suffixes)}")
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: is not a regular file")
        if path.exists() and not os.access(path, os.W_OK):
            raise InputError(f"{path}: is write-protected")
        if make_folder:
            path.parent.mkdir(parents=True, exist_ok=True)
        elif not path.parent.exists():
            raise InputError(f"{path}: there is no folder {str(path.parent)!r}")
        # Permissions, read-only and full file systems: the one way to know is to try.
        temporary = _temporary(path)
        temporary.open("xb").close()
        temporary.unlink()
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: cannot be written: {_reason(error)}") from error
    return path


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Gives a temporary path in the same folder; on success it becomes `path`, otherwise it vanishes.

    Raises:
        InputError: Writing failed.
    """
    # A link is followed, so that what it points to is replaced and not the link.
    target = Path(os.path.realpath(path))
    temporary = _temporary(target)
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {_reason(error)}") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _temporary(path: Path) -> Path:
    """A hidden name in the same folder, of the same extension, that no other process uses."""
    return path.with_name(f".warp-ir-{os.getpid()}-{os.urandom(4).hex()}{path.suffix}")


def _pixels(source: "_Film | Array", aov: str | None) -> tuple[Array, Array | None]:
    """Values, float32 [h, w, c], and alpha, float32 [h, w, 1], or None if everything is opaque."""
    alpha: Array | None = None
    if isinstance(source, np.ndarray):
        values = source
    elif aov is None:
        values, alpha = source.radiance(), source.aov("alpha")
    else:
        if aov not in AOV_CHANNELS:
            raise InputError(f"there is no AOV {aov!r}; known are {', '.join(AOV_CHANNELS)}")
        values = source.aov(aov)
    values = np.asarray(values, dtype=np.float32)
    values = values[..., None] if values.ndim == 2 else values
    if values.ndim != 3 or values.shape[2] not in (1, 3, 4) or values.size == 0:
        raise InputError(f"an array of shape {values.shape} is no picture; [h, w, 3] would be")
    if values.shape[2] == 4:
        values, alpha = values[..., :3], values[..., 3]
    return values, None if alpha is None else np.asarray(alpha, dtype=np.float32)[..., None]


def _linear(values: Array, aov: str | None, color_space: str) -> Array:
    """Values as they are stored where they stay linear: colours in a colour space, others as they are."""
    return from_rec709(values, color_space) if aov in _COLORS and values.shape[2] == 3 else values


def _exr_layers(source: "_Film | Array", aov: str | None, aovs: Sequence[str], color_space: str) -> _Layers:
    values, alpha = _pixels(source, aov)
    values = _linear(values, aov, color_space)
    names: Sequence[str] = ("R", "G", "B")
    if values.shape[2] == 1:
        names = AOV_CHANNELS[aov] if aov else ("Y",)
    layers = {name: (values[..., k], aov in _EXACT) for k, name in enumerate(names)}
    if alpha is not None:
        layers["A"] = (alpha[..., 0], False)
    for name in aovs:
        values = _linear(_pixels(source, name)[0], name, color_space)
        layers |= {channel: (values[..., k], name in _EXACT) for k, channel in enumerate(AOV_CHANNELS[name])}
    return layers


def _windows(source: "_Film | Array") -> tuple[int, int, int, int] | None:
    """Where a film's pixels belong: left column and top row in an image of so many columns and rows."""
    settings = None if isinstance(source, np.ndarray) else source.settings
    if settings is None or settings.height is None:
        return None
    left, top, _, _ = settings.pixels()
    return left, top, settings.width, settings.height


def _write_exr(
    path: Path,
    layers: _Layers,
    half: bool,
    attributes: dict[str, Any],
    chromaticities: Sequence[float],
    windows: tuple[int, int, int, int] | None,
) -> None:
    import OpenImageIO as oiio

    formats = [oiio.HALF if half and not exact else oiio.FLOAT for _, exact in layers.values()]
    planes = [
        np.clip(plane, -_HALF_MAX, _HALF_MAX) if stored == oiio.HALF else plane
        for (plane, _), stored in zip(layers.values(), formats, strict=True)
    ]
    pixels = np.stack(planes, axis=-1)
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], formats[0])
    spec.channelformats = tuple(formats)
    spec.channelnames = tuple(layers)
    if windows is not None:
        spec.x, spec.y, spec.full_width, spec.full_height = windows
    for name, value in attributes.items():
        spec.attribute(name, value)
    spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), tuple(chromaticities))
    _save(path, spec, pixels)


def _write_flat(
    path: Path, source: "_Film | Array", exposure: float, tonemap: str, aov: str | None, color_space: str
) -> None:
    """A file without layers: the linear formats, and those for a screen."""
    values, alpha = _pixels(source, aov)
    suffix = path.suffix.lower()
    if suffix in (".npy", ".hdr", ".pfm"):
        values = _linear(values, aov, color_space)
    if suffix == ".npy":
        with whole_file(path) as temporary:
            np.save(temporary, values, allow_pickle=False)
        return
    import OpenImageIO as oiio

    if suffix in (".hdr", ".pfm"):
        if suffix == ".hdr":  # three channels, none of them negative
            values = np.maximum(np.broadcast_to(values, (*values.shape[:2], 3)), 0.0)
        _save(path, oiio.ImageSpec(values.shape[1], values.shape[0], values.shape[2], oiio.FLOAT), values)
        return
    if suffix == ".png" and alpha is not None:
        # PNG wants colour that is not multiplied by alpha. JPEG has no alpha: the picture is over black.
        values = np.divide(values, alpha, out=np.zeros_like(values), where=alpha > 0.0)
    shown = _display(values, aov, exposure, tonemap)
    if suffix == ".png" and alpha is not None:
        shown = np.concatenate([shown, np.clip(alpha, 0.0, 1.0)], axis=-1)
    pixels = np.floor(shown * 255.0 + 0.5).astype(np.uint8)
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], oiio.UINT8)
    spec.set_colorspace("sRGB")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    spec.attribute("Compression", "zip" if suffix == ".png" else "jpeg:95")
    _save(path, spec, pixels)


def _display(values: Array, aov: str | None, exposure: float, tonemap: str) -> Array:
    """What a screen shows of a colour or an AOV: values in [0, 1]."""
    if aov in (None, "direct", "indirect"):
        return tone_map(values, exposure, tonemap)
    if aov == "albedo":
        return srgb_from_linear(values)
    low, high = 0.0, 1.0
    if aov == "normal":
        low = -1.0
    elif aov != "alpha":
        finite = values[np.isfinite(values)]
        low, high = (float(finite.min()), float(finite.max())) if finite.size else (low, high)
    shown: Array = np.clip((np.nan_to_num(values) - low) / max(high - low, 1e-30), 0.0, 1.0)
    return shown


def _save(path: Path, spec: Any, pixels: npt.NDArray[Any]) -> None:
    """Lets OpenImageIO write the pixels; every way to fail is an `InputError`."""
    import OpenImageIO as oiio

    if path.suffix.lower() in (".jpg", ".jpeg") and shutil.disk_usage(path.parent).free < 2 * pixels.nbytes:
        # libjpeg ends the process when it cannot write.
        raise InputError(f"{path}: cannot be written: no space left on the device")
    with whole_file(path) as temporary:
        writer: Any = oiio.ImageOutput.create(str(temporary))
        # All three are called: close() flushes, and geterror() knows of failures that they do not report.
        good = writer.open(str(temporary), spec) and writer.write_image(np.ascontiguousarray(pixels))
        good = writer.close() and good
        message = writer.geterror()
        if message or not good:
            raise OSError(_first_line(message) or "unknown error")


def _attributes(source: "_Film | Array", metadata: Mapping[str, object]) -> dict[str, Any]:
    """EXR attributes; names get the prefix `warp_ir:`, values become whatever OpenImageIO stores."""
    from warp_ir import __version__

    known: dict[str, object] = {}
    if not isinstance(source, np.ndarray):
        known = {} if source.settings is None else source.settings.to_dict()  # a loaded film has none
        known |= {"iterations": source.iterations, "seconds": source.seconds}
        known["estimated_error"] = source.error()
    attributes: dict[str, Any] = {"Software": f"warp_ir {__version__}"}
    for name, value in {**known, **metadata}.items():
        if name == "pixel_aspect":
            attributes["PixelAspectRatio"] = float(str(value))
        elif isinstance(value, bool | int) and abs(value) < 2**31:
            attributes[f"warp_ir:{name}"] = int(value)
        elif isinstance(value, int | float):
            attributes[f"warp_ir:{name}"] = float(value)
        elif value is not None:
            attributes[f"warp_ir:{name}"] = str(value)
    return attributes


def _reason(error: Exception) -> str:
    """An error in a few words, without the path that the message names already."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return _first_line(str(error))


def _first_line(text: str) -> str:
    lines = text.strip().splitlines()
    return lines[0].strip() if lines else ""
