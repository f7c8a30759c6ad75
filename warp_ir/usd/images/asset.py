"""Image assets, decoded by OpenImageIO to linear light; bytes come from USD's resolver, so that .usdz works.

The size that a file claims is checked before memory is allocated. An image with too many pixels is averaged down
while it is read, a band of rows at a time.
"""

import math
import os
import tempfile
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from pxr import Ar, Sdf

from warp_ir.files import first_line
from warp_ir.image.io import oiio_error
from warp_ir.image.tonemap import srgb_to_linear
from warp_ir.scene import Floats
from warp_ir.usd.values import source_color_space
from warp_ir.usd.values.report import Unreadable
from warp_ir.usd.values.source_color_space import decoder

if TYPE_CHECKING:
    from collections.abc import Iterator

    import OpenImageIO as oiio

MAX_PIXELS = 4096 * 4096
"""Maximum number of pixels; an image with more is averaged down."""
_MAX_VALUES = 2**31
"""Maximum of pixels times channels in a file; one that claims more is taken for damaged or malicious."""
_VALUES_PER_BAND = 2**22
"""Values (pixels times channels) decoded at once."""
_WINDOWED_FORMATS = {"openexr", "tiff"}
"""OpenImageIO's names of formats whose files state a display window; offsets in others place no texture."""
_LINEAR_NAMES = {"linear", "lin_rec709", "lin_rec709_scene", "scene_linear", "raw", "data"}


@dataclass(frozen=True, eq=False)
class Image:
    """A decoded image."""

    pixels: npt.NDArray[np.floating]
    """The display window, float [h, w, c], linear, row 0 at the top. c is 1 (grey), 2 (grey, alpha), 3 (rgb) or 4
    (rgb, alpha). It is 0 where the file holds no data."""
    width: int
    """Width of the display window; `pixels` may be averaged down."""
    height: int
    """Height of the display window."""
    decoded: bool = False
    """Whether a transfer function was decoded, that is, colour was not linear in the file."""
    wrap: tuple[str, str] = ("", "")
    """Wrap modes in s and t from the file's metadata: "black", "clamp", "repeat", "mirror", or "" for none."""

    @property
    def rgb(self) -> npt.NDArray[np.float32]:
        """The colour, float32 [h, w, 3]; grey is repeated in all channels."""
        count = self.pixels.shape[2]
        if count >= 3:
            return self.pixels[..., :3]
        return np.broadcast_to(self.pixels[..., :1], (*self.pixels.shape[:2], 3))

    @property
    def alpha(self) -> npt.NDArray[np.float32]:
        """Alpha, float32 [h, w]; 1 if the file has none."""
        count = self.pixels.shape[2]
        return self.pixels[..., count - 1] if count in (2, 4) else np.ones(self.pixels.shape[:2], np.float32)


def read_texture(
    asset: Sdf.AssetPath | str, color_space: str = "auto", max_pixels: int = MAX_PIXELS, *, half: bool = False
) -> Image:
    """Reads an image asset.

    Args:
        asset: The value of an attribute, resolved by USD; or a resolved path, which may be in a package
            (`a.usdz[b.png]`).
        color_space: UsdUVTexture's sourceColorSpace: "raw", "sRGB", or "auto" (sRGB for 8 bits and three or four
            channels unless the file's metadata names a linear space); or another colour space, whose transfer function
            is decoded and whose primaries are left. Alpha is never decoded.
        max_pixels: An image with more pixels is averaged down by an integer factor.
        half: Whether images of 8 bits may be half floats, whose 11 bits hold them.

    Raises:
        Unreadable: There is no such file, it is no image, or it claims too many pixels; the message names the asset.
    """
    authored = asset if isinstance(asset, str) else asset.path
    resolved = asset if isinstance(asset, str) else asset.resolvedPath
    if not resolved:
        raise Unreadable(f"image '{_short(authored)}' not found")
    import OpenImageIO as oiio

    with _file(resolved) as path:
        # Colour must not be multiplied by alpha on reading.
        hints = oiio.ImageSpec()
        hints.attribute("oiio:UnassociatedAlpha", 1)
        reader = None if path is None else oiio.ImageInput.open(path, hints)
        try:
            if path is None:
                raise Unreadable("not found")
            if reader is None:
                raise Unreadable(f"cannot be read: {_without_path(oiio_error(), path)}")
            return _decode(reader, path, color_space, max_pixels, half=half)
        except Unreadable as error:
            raise Unreadable(f"image '{_short(authored)}' {error}") from None
        except Exception as error:  # names and metadata of damaged files raise errors of many kinds
            raise Unreadable(f"image '{_short(authored)}' cannot be read: {first_line(str(error))}") from None
        finally:
            if reader is not None:
                reader.close()


@contextmanager
def _file(resolved: str) -> "Iterator[str | None]":
    """A path that OpenImageIO can open: the file itself, or a temporary copy if it is in a package; None if absent."""
    if os.path.exists(resolved):  # pipes, devices and folders are no images
        yield resolved if os.path.isfile(resolved) else None
        return
    opened = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(resolved))
    content = opened.GetBuffer() if opened else None
    if content is None:
        yield None
        return
    inner = Ar.SplitPackageRelativePathInner(resolved)[1] or resolved
    # OpenImageIO's Python interface reads only files, not memory.
    with tempfile.TemporaryDirectory(prefix="warp-ir-") as folder:
        path = Path(folder) / f"image{Path(inner).suffix}"
        path.write_bytes(content)
        yield str(path)


@np.errstate(over="ignore", invalid="ignore")  # damaged files hold any bits
def _decode(reader: "oiio.ImageInput", path: str, color_space: str, max_pixels: int, *, half: bool) -> Image:
    """Decodes the display window, which texture coordinates span; outside the data window it is 0."""
    import OpenImageIO as oiio

    part = _select_part(reader)
    spec = reader.spec()
    if min(spec.width, spec.height, spec.nchannels) < 1 or spec.depth > 1 or spec.deep:
        raise Unreadable("is not a flat two-dimensional image of at least one pixel")
    left, top, width, height = _display_window(reader)
    for w, h in ((width, height), (spec.width, spec.height)):
        if w * h * spec.nchannels > _MAX_VALUES:
            raise Unreadable(f"claims {w} x {h} pixels of {spec.nchannels} channels: too many")
    first, count = _channels(list(spec.channelnames))
    factor = max(1, math.isqrt(width * height // max_pixels))
    while -(-width // factor) * -(-height // factor) > max_pixels:
        factor += 1
    is_uint8 = spec.format.basetype == oiio.UINT8
    decode = _decoder(spec, color_space, is_uint8)
    colors = 0 if decode is None else count if count in (1, 3) else count - 1
    # 8-bit values are decoded by a table of 256 entries.
    table = None if decode is None else decode(np.arange(256) / 255.0).astype(np.float32)
    by_table = is_uint8 and factor == 1  # 8-bit values become pixels at once
    linear = (np.arange(256) / 255.0).astype(np.float32)
    stored_type = np.float16 if half and by_table else np.float32
    pixels = np.zeros((-(-height // factor), -(-width // factor), count), stored_type)
    step = math.lcm(factor, int(spec.tile_height) or 1)  # a band holds whole tiles, and mostly whole rows of the result
    rows = step * max(1, _VALUES_PER_BAND // (spec.width * count * step))
    x0, x1 = max(left, spec.x), min(left + width, spec.x + spec.width)
    for above in range(spec.y, spec.y + spec.height, rows):
        below = min(above + rows, spec.y + spec.height)
        y0, y1 = max(top, above), min(top + height, below)
        if x0 >= x1 or y0 >= y1:
            continue  # the band is outside the display window
        kind = oiio.UINT8 if is_uint8 else oiio.FLOAT
        if spec.tile_width:
            band = reader.read_tiles(
                part, 0, spec.x, spec.x + spec.width, above, below, 0, 1, first, first + count, kind
            )
        else:
            band = reader.read_scanlines(part, 0, above, below, 0, first, first + count, kind)
        if band is None:
            raise Unreadable(f"cannot be read: {_without_path(oiio_error(reader), path)}")
        stored = np.asarray(band).reshape(below - above, spec.width, count)
        stored = stored[y0 - above : y1 - above, x0 - spec.x : x1 - spec.x]
        if by_table:
            target = pixels[y0 - top : y1 - top, x0 - left : x1 - left]
            if colors:
                assert table is not None
                target[..., :colors] = table.astype(stored_type)[stored[..., :colors]]
            if colors < count:
                target[..., colors:] = linear.astype(stored_type)[stored[..., colors:]]
            continue
        values = stored.astype(np.float32) / np.float32(255.0) if is_uint8 else stored.astype(np.float32)
        if decode is not None and table is not None:
            values[..., :colors] = table[stored[..., :colors]] if is_uint8 else decode(values[..., :colors])
        _add_means(pixels, values, (y0 - top, x0 - left), (height, width), factor)
    if not by_table and not np.isfinite(pixels).all():
        pixels = np.nan_to_num(pixels, nan=0.0, posinf=65504.0, neginf=0.0)
    return Image(pixels, width, height, decode is not None, _wrap_modes(spec))


def _select_part(reader: "oiio.ImageInput") -> int:
    """Selects the part of a multi-part EXR that holds colour, else grey, else the first; returns its number."""
    if reader.format_name() != "openexr":
        return 0
    parts: list[set[str]] = []
    while reader.seek_subimage(len(parts), 0):
        spec = reader.spec()
        parts.append(set() if spec.deep else set(spec.channelnames))
    oiio_error(reader)  # clears the error of seeking past the last part
    colors: tuple[set[str], ...] = ({"R", "G", "B"}, {"Y"})
    part = next((k for wanted in colors for k, names in enumerate(parts) if wanted <= names), 0)
    reader.seek_subimage(part, 0)
    return part


def _display_window(reader: "oiio.ImageInput") -> tuple[int, int, int, int]:
    """Left column, top row, width and height of the display window; that of the data in formats without one."""
    spec = reader.spec()
    if reader.format_name() in _WINDOWED_FORMATS and min(spec.full_width, spec.full_height) > 0:
        return spec.full_x, spec.full_y, spec.full_width, spec.full_height
    return spec.x, spec.y, spec.width, spec.height


def _add_means(
    pixels: npt.NDArray[np.float32],
    values: npt.NDArray[np.float32],
    start: tuple[int, int],
    size: tuple[int, int],
    factor: int,
) -> None:
    """Adds values to the means over blocks of factor x factor pixels; blocks at the right and bottom may be smaller.

    Args:
        pixels: The means, [h, w, c].
        values: A part of the image.
        start: Row and column of the part in the image.
        size: Height and width of the image.
        factor: Height and width of a block.
    """
    blocks, starts, counts = [], [], []
    for axis in (0, 1):
        block = np.arange(start[axis] // factor, -(-(start[axis] + values.shape[axis]) // factor))
        blocks.append(slice(block[0], block[-1] + 1))
        starts.append(np.maximum(block * factor - start[axis], 0))
        counts.append(np.minimum((block + 1) * factor, size[axis]) - block * factor)
    if factor == 1:
        pixels[blocks[0], blocks[1]] = values
        return
    sums = np.add.reduceat(np.add.reduceat(values, starts[0], axis=0, dtype=np.float64), starts[1], axis=1)
    pixels[blocks[0], blocks[1]] += (sums / (counts[0][:, None] * counts[1])[..., None]).astype(np.float32)


def _channels(names: list[str]) -> tuple[int, int]:
    """First channel and number of channels of grey, RGB and alpha; other layers of an EXR are ignored."""
    if {"R", "G", "B"} <= set(names):
        first = names.index("R")
        if names[first : first + 3] == ["R", "G", "B"]:
            return first, 4 if names[first + 3 : first + 4] == ["A"] else 3
    return 0, min(len(names), 4)


def _decoder(spec: "oiio.ImageSpec", color_space: str, is_uint8: bool) -> Callable[[Floats], Floats] | None:
    """The decoding transfer function of an image; None if it is linear or holds no colour."""
    if color_space != "auto":
        space = source_color_space.color_space(color_space)
        return None if space is None else decoder(space)
    metadata = str(spec.get_string_attribute("oiio:ColorSpace")).lower()
    # OpenImageIO reports sRGB for every PNG, so that only the pixel format can tell colour from data.
    return srgb_to_linear if metadata not in _LINEAR_NAMES and is_uint8 and spec.nchannels in (3, 4) else None


def _wrap_modes(spec: "oiio.ImageSpec") -> tuple[str, str]:
    known = {"black": "black", "clamp": "clamp", "periodic": "repeat", "mirror": "mirror"}
    modes = str(spec.get_string_attribute("wrapmodes")).lower().split(",")
    s = known.get(modes[0].strip(), "")
    return s, known.get(modes[-1].strip(), s)


def _short(path: str) -> str:
    return path if len(path) <= 120 else f"…{path[-119:]}"


def _without_path(text: str, path: str) -> str:
    return text.replace(path, "it") or "unknown error"
