"""Reading and writing pictures.

`.exr`, `.hdr`, `.pfm` and `.npy` hold linear radiance, `.png`, `.jpg` and `.tif` tone-mapped display values.
"""

import json
import os
import warnings
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from warp_ir.files import check_output, check_room, first_line, reason, whole_file
from warp_ir.image.color_space import COLOR_SPACES, REC709
from warp_ir.image.exr import ExrOptions, camera_matrices
from warp_ir.image.ocio import active_config, check_color_space, display_values, to_color_space
from warp_ir.image.tonemap import srgb_from_linear, tone_map
from warp_ir.scene import InputError, Scene

if TYPE_CHECKING:
    import OpenImageIO as oiio

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
"""Channels of an EXR file that hold the AOVs of a film; its radiance is in R, G and B."""

DISPLAYED = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
"""Extensions of pictures for a display: they are tone-mapped, or made by an OpenColorIO view."""
SUFFIXES = (".exr", ".hdr", ".pfm", ".npy", *DISPLAYED)
"""Extensions of the pictures that can be written."""

_HALF_MAX = 65504.0
_FULL_FLOAT_AOVS = frozenset({"position", "depth", "prim_id"})
"""AOVs that a half-float file stores with 32 bits: 11 bits of precision are too few for distances and indices."""
_KEY = "warp_ir:key"
_LIGHT = frozenset({None, "direct", "indirect"})
"""AOVs that are radiance; None stands for the whole."""
_COLORS = _LIGHT | {"albedo"}
"""AOVs that are colours."""


_EXR = ExrOptions()


class _Shown(NamedTuple):
    """How linear radiance becomes display values, and the picture's key; the arguments of `write_image`."""

    exposure: float
    tonemap: str
    view: tuple[str, str] | None
    key: str


class _Layer(NamedTuple):
    """A picture, an AOV or a Cryptomatte in an EXR file."""

    name: str
    channels: dict[str, tuple[Array, bool]]
    """Name -> values, float32 [h, w], and whether they need 32 bits."""
    is_color: bool
    """Whether a compression may lose digits."""


class _Settings(Protocol):
    """What this module requires of `RenderSettings`."""

    @property
    def color_space(self) -> str: ...
    @property
    def conform(self) -> str: ...
    @property
    def pixel_aspect(self) -> float: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int | None: ...
    def pixels(self) -> tuple[int, int, int, int]: ...
    def to_dict(self) -> dict[str, Any]: ...


class _Film(Protocol):
    """What this module requires of a `Film`."""

    @property
    def settings(self) -> _Settings | None: ...
    @property
    def origin(self) -> object: ...
    @property
    def iterations(self) -> int: ...
    @property
    def seconds(self) -> float: ...
    def radiance(self) -> npt.NDArray[np.float32]: ...
    def error(self) -> float: ...
    def aov(self, name: str) -> npt.NDArray[Any]: ...


def write_image(
    path: str | os.PathLike[str],
    source: "_Film | Array",
    *,
    exposure: float = 0.0,
    tonemap: str = "srgb",
    view: tuple[str, str] | None = None,
    aov: str | None = None,
    aovs: Sequence[str] = (),
    half: bool = True,
    metadata: Mapping[str, object] | None = None,
    color_space: str | None = None,
    exr: ExrOptions = _EXR,
) -> list[Path]:
    """Writes a picture in the format of the file's extension.

    Args:
        path: `.exr` (colour, alpha, AOVs, metadata), `.hdr`, `.pfm`, `.npy` (linear), `.png`, `.jpg` or `.tif`
            (tone-mapped). An existing file is replaced.
        source: A film, or an array [h, w], [h, w, 1], [h, w, 3] or [h, w, 4] (colour premultiplied by alpha) in
            linear Rec. 709, row 0 at the top.
        exposure: Exposure [stops]; for `.png`, `.jpg` and `.tif` only.
        tonemap: "srgb" or "filmic"; for `.png`, `.jpg` and `.tif` only.
        view: A display and its view in the OpenColorIO configuration that $OCIO names, in place of the tone curve.
        aov: Name of the film's AOV to write in place of its radiance.
        aovs: Names of further AOVs of the film. An EXR file holds them as layers; for other formats, each is written
            to a file of its own: picture.NAME.png for picture.png.
        half: Whether an EXR file stores colours with 16 bits; values beyond ±65504 are clamped,
            with a warning that counts their pixels.
        metadata: Attributes for an EXR file, in addition to the film's settings and statistics. Of these, "key" is
            also stored in `.png`, `.jpg` and `.tif`, for `read_key`.
        color_space: One of `COLOR_SPACES`, or a linear one of that configuration, for colours in the linear formats;
            None: that of the film's settings, or linear Rec. 709 for an array.
        exr: How an EXR file is stored, and its Cryptomattes. Those of a film that a `Renderer` made have the camera's
            matrices; with the AOV prim_id, the attribute `warp_ir:prim_names` lists the names by their numbers.

    Returns:
        The paths of the written files.

    Raises:
        InputError: The path cannot be written, or the extension, AOV, tone curve or colour space is unknown.
    """
    path = check_output(path, SUFFIXES)
    if color_space is None:
        settings = None if isinstance(source, np.ndarray) else source.settings
        color_space = REC709 if settings is None else settings.color_space
    try:
        check_color_space(color_space)
    except InputError as error:
        raise InputError(f"{path}: color_space: {error}") from None
    suffix = path.suffix.lower()
    if isinstance(source, np.ndarray) and (aov or aovs):
        raise InputError(f"{path}: an array has no AOVs; write a film")
    if suffix == ".exr":
        layers = _exr_layers(source, aov, aovs, color_space, exr)
        attributes = {**_attributes(source, metadata or {}), **exr.attributes(), **_view_attributes(source, aovs)}
        attributes |= _color_attributes(color_space)
        _write_exr(path, layers, half, attributes, exr, _data_window(source))
        return [path]
    shown = _Shown(exposure, tonemap, view, str((metadata or {}).get("key") or ""))
    _write_single_layer(path, source, shown, aov, color_space)
    aov_paths = [aov_path(path, name) for name in aovs]
    for name, other in zip(aovs, aov_paths, strict=True):
        _write_single_layer(other, source, shown, name, color_space)
    return [path, *aov_paths]


def read_image(path: str | os.PathLike[str], layer: str | None = None) -> npt.NDArray[np.float32]:
    """Reads the stored values of a picture, float32 [h, w, c]; 8-bit values become 0 to 1, and are not linearised.

    Args:
        path: A file of any of `SUFFIXES`, or of another format that OpenImageIO reads.
        layer: Name of an AOV in an EXR file, or of four channels R, G, B, A such as "crypto_object00", in whichever
            part it is; None: the colour, with alpha if there is one.

    Raises:
        InputError: The file cannot be read, or lacks the layer.
    """
    path = Path(path)
    if path.suffix.lower() == ".npy":
        try:
            values = np.asarray(np.load(path, allow_pickle=False), dtype=np.float32)
        except (OSError, ValueError, EOFError) as error:
            raise InputError(f"{path}: {reason(error)}") from error
        if values.ndim not in (2, 3):
            raise InputError(f"{path}: an array of {values.ndim} dimensions is no picture")
        return values[..., None] if values.ndim == 2 else values
    import OpenImageIO as oiio

    # Stored values are wanted: no reader may multiply colour by alpha.
    hints = oiio.ImageSpec()
    hints.attribute("oiio:UnassociatedAlpha", 1)
    reader = oiio.ImageInput.open(str(path), hints)
    wanted = ("R", "G", "B") if layer is None else AOV_CHANNELS.get(layer, [f"{layer}.{c}" for c in "RGBA"])
    try:
        if reader is None:
            raise InputError(f"{path}: {oiio_error()}")
        parts = [list(reader.spec().channelnames)]
        while path.suffix.lower() == ".exr" and reader.seek_subimage(len(parts), 0):
            parts.append(list(reader.spec().channelnames))
        oiio_error(reader)  # clears the error of seeking past the last part
        part = next((number for number, names in enumerate(parts) if set(wanted) <= set(names)), None)
        if layer is not None and part is None:
            channels = ", ".join(name for names in parts for name in names)
            raise InputError(f"{path}: has no layer {layer!r}; its channels are {channels}")
        names = parts[part or 0]
        pixels = reader.read_image(part or 0, 0, 0, len(names), oiio.FLOAT)
        if pixels is None:
            raise InputError(f"{path}: {oiio_error(reader)}")
        reader.close()
    except UnicodeDecodeError as error:  # names in a damaged file
        raise InputError(f"{path}: {first_line(str(error))}") from None
    pixels = np.asarray(pixels, dtype=np.float32).reshape(*pixels.shape[:2], -1)
    if layer is None:
        wanted = [name for name in ("R", "G", "B", "A") if name in names] or names
    return np.ascontiguousarray(pixels[..., [names.index(name) for name in wanted]])


def can_hold_key(path: Path) -> bool:
    """Whether the format of a file has a place for the key of a picture."""
    return path.suffix.lower() in (".exr", *DISPLAYED)


def read_key(path: Path) -> str | None:
    """The key that `write_image` has stored with a picture, "" if there is none; None: the format has no place for it.

    Raises:
        InputError: The file cannot be read.
    """
    if not can_hold_key(path):
        return None
    import OpenImageIO as oiio

    reader = oiio.ImageInput.open(str(path))
    if reader is None:
        raise InputError(f"{path}: {oiio_error()}")
    try:
        if path.suffix.lower() == ".exr":
            return str(reader.spec().get_string_attribute(_KEY))
        name, _, key = str(reader.spec().get_string_attribute("ImageDescription")).partition(" ")
        return key if name == _KEY else ""
    except UnicodeDecodeError:
        return ""
    finally:
        reader.close()


def aov_path(path: Path, aov: str) -> Path:
    """Path of an AOV of `path` in a format without layers: a.png -> a.depth.png."""
    return path.with_name(f"{path.stem}.{aov}{path.suffix}")


def _pixels(source: "_Film | Array", aov: str | None) -> tuple[Array, Array | None]:
    """Values, float32 [h, w, c], and alpha, float32 [h, w, 1]; None without alpha."""
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
    """Values as linear formats store them: colours in the given colour space, others unchanged."""
    return to_color_space(values, color_space) if aov in _COLORS and values.shape[2] == 3 else values


def _exr_layers(
    source: "_Film | Array", aov: str | None, aovs: Sequence[str], color_space: str, exr: ExrOptions
) -> list[_Layer]:
    """Layers of an EXR file: the picture with alpha, AOVs, and Cryptomattes."""
    values, alpha = _pixels(source, aov)
    values = _linear(values, aov, color_space)
    names: Sequence[str] = ("R", "G", "B")
    if values.shape[2] == 1:
        names = AOV_CHANNELS[aov] if aov else ("Y",)
    channels = {name: (values[..., k], aov in _FULL_FLOAT_AOVS) for k, name in enumerate(names)}
    if alpha is not None:
        channels["A"] = (alpha[..., 0], False)
    layers = [_Layer(aov or "rgba", channels, aov in _COLORS)]
    for name in aovs:
        values = _linear(_pixels(source, name)[0], name, color_space)
        full_float = name in _FULL_FLOAT_AOVS
        channels = {channel: (values[..., k], full_float) for k, channel in enumerate(AOV_CHANNELS[name])}
        layers.append(_Layer(name, channels, name in _COLORS))
    for matte in exr.cryptomattes:
        channels = {name: (plane, True) for name, plane in matte.channels().items()}
        layers.append(_Layer(f"crypto_{matte.kind}", channels, False))
    return layers


def _color_attributes(color_space: str) -> dict[str, Any]:
    """What an EXR file says of its colour space."""
    if color_space in COLOR_SPACES:
        return {"colorInteropID": color_space, "chromaticities": COLOR_SPACES[color_space]}
    config = active_config()
    name = config.interop_id(color_space) if config is not None else ""
    return {"colorInteropID": name} if name else {}


def _view_attributes(source: "_Film | Array", aovs: Sequence[str]) -> dict[str, Any]:
    """Matrices of the camera and names of meshes, if the source is a film of a known scene."""
    scene = None if isinstance(source, np.ndarray) else source.origin
    settings = None if isinstance(source, np.ndarray) else source.settings
    out: dict[str, Any] = {}
    if not isinstance(scene, Scene):
        return out
    if settings is not None and settings.height is not None:
        fitted = scene.camera.fit(settings.width, settings.height, settings.conform, settings.pixel_aspect)
        out |= camera_matrices(fitted)
    if "prim_id" in aovs:
        out["warp_ir:prim_names"] = json.dumps([mesh.name for mesh in scene.meshes])
    return out


def _data_window(source: "_Film | Array") -> tuple[int, int, int, int] | None:
    """Left column and top row of a film in the whole image, and the columns and rows of that; None: it is the whole."""
    settings = None if isinstance(source, np.ndarray) else source.settings
    if settings is None or settings.height is None:
        return None
    left, top, _, _ = settings.pixels()
    return left, top, settings.width, settings.height


def _write_exr(
    path: Path,
    layers: Sequence[_Layer],
    half: bool,
    attributes: Mapping[str, Any],
    exr: ExrOptions,
    window: tuple[int, int, int, int] | None,
) -> None:
    """Writes an EXR file; `window` is a `_data_window`."""
    if not exr.multipart:
        together = {name: plane for layer in layers for name, plane in layer.channels.items()}
        layers = [_Layer("", together, True)]
    _warn_of_clipping(path, layers, half)
    parts = [_exr_part(layer, half, attributes, exr, window) for layer in layers]
    _save(path, [spec for spec, _ in parts], [pixels for _, pixels in parts])


def _warn_of_clipping(path: Path, layers: Sequence[_Layer], half: bool) -> None:
    """Warns of values that 16 bits cannot hold."""
    planes = [plane for layer in layers for plane, full_float in layer.channels.values() if half and not full_float]
    clipped = int(np.any([np.abs(plane) > _HALF_MAX for plane in planes], axis=0).sum()) if planes else 0
    if clipped:
        what = f"{clipped} of {planes[0].size} pixels exceed {_HALF_MAX:g}, the largest half-float, and are clipped"
        warnings.warn(f"{path}: {what}; 32 bits hold them (half=False, --float)", stacklevel=4)


def _exr_part(
    layer: _Layer,
    half: bool,
    attributes: Mapping[str, Any],
    exr: ExrOptions,
    window: tuple[int, int, int, int] | None,
) -> tuple["oiio.ImageSpec", Array]:
    """The header and the pixels of a part of an EXR file."""
    import OpenImageIO as oiio

    formats = [oiio.HALF if half and not full_float else oiio.FLOAT for _, full_float in layer.channels.values()]
    planes = [
        np.clip(plane, -_HALF_MAX, _HALF_MAX) if stored == oiio.HALF else plane
        for (plane, _), stored in zip(layer.channels.values(), formats, strict=True)
    ]
    pixels = np.stack(planes, axis=-1)
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], formats[0])
    spec.channelformats = tuple(formats)
    spec.channelnames = tuple(layer.channels)
    if window is not None:
        spec.x, spec.y, spec.full_width, spec.full_height = window
    for name, value in attributes.items():
        if isinstance(value, Fraction):
            spec.attribute(name, oiio.TypeDesc("rational2i"), (value.numerator, value.denominator))
        elif isinstance(value, tuple):
            spec.attribute(name, oiio.TypeDesc("matrix" if len(value) == 16 else f"float[{len(value)}]"), value)
        else:
            spec.attribute(name, value)
    spec.attribute("compression", exr.compression_of(layer.is_color))
    if layer.name:
        spec.attribute("oiio:subimagename", layer.name)
    return spec, pixels


def _write_single_layer(path: Path, source: "_Film | Array", how: _Shown, aov: str | None, color_space: str) -> None:
    """Writes a file of a format without layers."""
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
        if suffix == ".hdr":  # stores three channels, which are not negative
            values = np.maximum(np.broadcast_to(values, (*values.shape[:2], 3)), 0.0)
        spec = oiio.ImageSpec(values.shape[1], values.shape[0], values.shape[2], oiio.FLOAT)
        _save(path, [spec], [values])
        return
    keeps_alpha = alpha is not None and suffix in (".png", ".tif", ".tiff")
    if keeps_alpha and alpha is not None:
        # Stored unassociated. JPEG has no alpha: premultiplied colour is the picture over black.
        values = np.divide(values, alpha, out=np.zeros_like(values), where=alpha > 0.0)
    shown = _display(values, aov, how)
    if keeps_alpha and alpha is not None:
        shown = np.concatenate([shown, np.clip(alpha, 0.0, 1.0)], axis=-1)
    steps, stored = (65535.0, np.uint16) if suffix in (".tif", ".tiff") else (255.0, np.uint8)
    pixels = np.floor(shown * steps + 0.5).astype(stored)
    kind = oiio.UINT16 if stored == np.uint16 else oiio.UINT8
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    config = active_config() if how.view is not None and aov in _LIGHT else None
    spec.set_colorspace("sRGB" if config is None or how.view is None else config.display_space(how.view))
    if how.key:
        spec.attribute("ImageDescription", f"{_KEY} {how.key}")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    spec.attribute("Compression", "jpeg:95" if suffix in (".jpg", ".jpeg") else "zip")
    _save(path, [spec], [pixels])


def _display(values: Array, aov: str | None, how: _Shown) -> Array:
    """Display values in [0, 1] of the radiance or an AOV."""
    if aov in _LIGHT:
        if how.view is None:
            return tone_map(values, how.exposure, how.tonemap)
        return display_values(np.broadcast_to(values, (*values.shape[:2], 3)), how.exposure, how.view)
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


def _save(path: Path, specs: "Sequence[oiio.ImageSpec]", parts: "Sequence[Array | npt.NDArray[np.integer]]") -> None:
    """Writes the parts of a file, mostly one, with OpenImageIO; raises `InputError` if that fails in any way."""
    import OpenImageIO as oiio

    with whole_file(path) as temporary:
        if path.suffix.lower() in (".jpg", ".jpeg"):
            check_room(temporary.parent, 2 * parts[0].nbytes)  # libjpeg exits the process when it cannot write
        writer = oiio.ImageOutput.create(str(temporary))
        if writer is None:
            raise OSError(oiio_error())
        # close() flushes, and geterror() tells of failures that the other calls do not report.
        good = writer.open(str(temporary), tuple(specs)) if len(specs) > 1 else writer.open(str(temporary), specs[0])
        for number, (spec, pixels) in enumerate(zip(specs, parts, strict=True)):
            good = good and (number == 0 or writer.open(str(temporary), spec, "AppendSubimage"))
            good = good and writer.write_image(np.ascontiguousarray(pixels))
        good = writer.close() and good
        message = oiio_error(writer)
        if message or not good:
            raise OSError(message or "unknown error")


def _attributes(source: "_Film | Array", metadata: Mapping[str, object]) -> dict[str, str | float]:
    """EXR attributes with the prefix `warp_ir:`, converted to types that OpenImageIO stores."""
    from warp_ir import __version__

    known: dict[str, object] = {}
    if not isinstance(source, np.ndarray):
        known = {} if source.settings is None else source.settings.to_dict()  # None: a loaded film
        known |= {"iterations": source.iterations, "seconds": source.seconds}
        known["estimated_error"] = source.error()
    attributes: dict[str, str | float] = {"Software": f"warp_ir {__version__}"}
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


def oiio_error(source: "oiio.ImageInput | oiio.ImageOutput | None" = None) -> str:
    """The first line of OpenImageIO's last error message, which this clears; "" if there was none.

    Args:
        source: The reader or writer that failed; None: opening one failed.
    """
    import OpenImageIO as oiio

    try:
        text = str(oiio.geterror() if source is None else source.geterror())
    except UnicodeDecodeError as error:  # the message quotes bytes of the file
        text = bytes(error.object).decode("utf-8", "replace")
    return first_line(text)
