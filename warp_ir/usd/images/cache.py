"""The cache of a scene's images and textures, and lookups of images for shading networks."""

import math
from collections.abc import Callable, Hashable
from dataclasses import replace

import numpy as np
from pxr import Sdf, Usd, UsdShade

from warp_ir.image.mipmap import resized
from warp_ir.scene import Floats, Texture
from warp_ir.usd.images.asset import MAX_PIXELS, Image, read_texture
from warp_ir.usd.images.shading_value import ShadingValue, compact
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable
from warp_ir.usd.values.source_color_space import color_space, decoder, rgb_conversion_matrix, space_name

MAX_TEXTURE_PIXELS = 2**27
"""Pixel budget for all images of a scene; each image is averaged down to at most half of what remains."""


class ImageCache:
    """Reads every image of a scene, and makes every texture from them, only once.

    Args:
        report: Receives warnings and counts.
        default_wrap: Wrap mode if neither the network nor the file gives one.
    """

    def __init__(self, report: Report, default_wrap: str = "black") -> None:
        self.report = report
        self.default_wrap = default_wrap
        self._images: dict[tuple[str, str], Image | str] = {}
        self._values: dict[Hashable, ShadingValue] = {}
        self._textures: dict[Hashable, Texture] = {}
        self._pixels_left = MAX_TEXTURE_PIXELS

    def read(self, asset: Sdf.AssetPath, space: str, resolved: str = "") -> Image:
        """An image, read from its file on the first call.

        Args:
            asset: The asset, as an attribute gives it.
            space: Name of the source colour space, as for `read_texture`.
            resolved: Resolved path, in place of the asset's own (for tiles).

        Raises:
            Unreadable: It cannot be read.
        """
        key = (resolved or asset.resolvedPath or asset.path, space)
        if key not in self._images:
            limit = max(min(MAX_PIXELS, self._pixels_left // 2), 1)
            try:
                image = read_texture(resolved or asset, space, limit, half=True)
            except Unreadable as error:
                self._images[key] = str(error)
            else:
                self._pixels_left -= image.pixels.shape[0] * image.pixels.shape[1]
                self._images[key] = replace(image, pixels=compact(image.pixels))
                self.report.stats["images"] += 1
                if image.pixels.shape[:2] != (image.height, image.width):
                    self.report.warn(asset.path, "image averaged down to fit the memory for textures ({n} in all)")
        cached = self._images[key]
        if isinstance(cached, str):
            raise Unreadable(cached)
        return cached

    def shared(self, value: ShadingValue) -> ShadingValue:
        """The first mapped value that is equal to this one, so that its mean and its range are computed once."""
        return self._values.setdefault((value.key, value.mapping), value)

    def texture(self, value: ShadingValue) -> Texture:
        """A mapped value as a texture; equal values give the same object."""
        assert value.mapping is not None
        key = (value.key, value.mapping)
        if key not in self._textures:
            red, green, blue = np.broadcast_to(value.outside, 3).tolist()
            self._textures[key] = Texture(
                value.name,
                value.pixels,
                value.mapping.wrap,
                (red, green, blue),
                value.mapping.uv,
                np.array(value.mapping.transform, np.float64),
            )
        return self._textures[key]

    def look_up(
        self,
        attribute: Usd.Attribute | None,
        time: Usd.TimeCode,
        space: str,
        fallback: Floats,
        channels: list[int],
        warn: Callable[[str], None],
    ) -> tuple[Image, Floats, Hashable, tuple[int, int]]:
        """The image that an asset attribute names.

        Args:
            attribute: The asset attribute.
            time: Time at which it is read.
            space: Colour space that the node authors; "auto" if none. Then the colour space of the nearest ancestor
                prim is used if both it and the image are linear, or neither is (`inherited_color_space`).
            fallback: RGBA value of missing UDIM tiles.
            channels: Indices of the wanted channels, in the order r, g, b, a.
            warn: Warns about the material.

        Returns:
            The image, its wanted channels [h, w, c], a key that is equal for equal pixels, and the number of UDIM
            tiles across and up, (1, 1) without UDIM.

        Raises:
            Unreadable: No image is named, or it cannot be read.
        """
        asset = read.raw(attribute, time) if attribute is not None else None
        if isinstance(asset, str):
            asset = Sdf.AssetPath(asset)
        if attribute is None or not isinstance(asset, Sdf.AssetPath) or not asset.path:
            raise Unreadable("no image file is named")
        space = _source_color_space(attribute, space, warn)
        if "<UDIM>" in asset.path or "<UDIM>" in asset.resolvedPath:
            return self._udim(attribute, time, asset, space, fallback, channels, warn)
        image = self.read(asset, space)
        inherited = inherited_color_space(attribute, image) if space == "auto" else ""
        if inherited:
            space = inherited
            image = self.read(asset, space)
        pixels, key = self.pixels(asset, space, channels)
        return image, pixels, key, (1, 1)

    def pixels(self, asset: Sdf.AssetPath, space: str, channels: list[int]) -> tuple[Floats, Hashable]:
        """Channels of an image in linear Rec. 709, [h, w, c], and a key that is equal for equal images.

        Raises:
            Unreadable: The image cannot be read.
        """
        selected = _convert_primaries(_channels(self.read(asset, space), channels), space)
        return selected, (asset.resolvedPath or asset.path, space)

    def _udim(
        self,
        attribute: Usd.Attribute,
        time: Usd.TimeCode,
        asset: Sdf.AssetPath,
        space: str,
        fallback: Floats,
        channels: list[int],
        warn: Callable[[str], None],
    ) -> tuple[Image, Floats, Hashable, tuple[int, int]]:
        """The tiles of a UDIM set, assembled in one image; missing tiles have the fallback value."""
        stack = attribute.GetPropertyStack(time)
        tiles = UsdShade.UdimUtils.ResolveUdimTilePaths(asset.path, stack[0].layer if stack else None)
        paths = {int(number) - 1001: str(path) for path, number in tiles if str(number).isdigit()}
        paths = {tile: path for tile, path in paths.items() if 0 <= tile < 100}
        if not paths:
            raise Unreadable(f"image '{asset.path}': none of its tiles exists")
        images: dict[int, Image] = {}
        for tile, path in sorted(paths.items()):
            try:
                images[tile] = self.read(asset, space, path)
            except Unreadable as error:
                warn(f"{error}; the texture's fallback is used")
        if not images:
            raise Unreadable(f"image '{asset.path}': none of its tiles can be read")
        columns, rows = max(tile % 10 for tile in images) + 1, max(tile // 10 for tile in images) + 1
        height = max(image.pixels.shape[0] for image in images.values())
        width = max(image.pixels.shape[1] for image in images.values())
        shrink = math.sqrt(min(MAX_PIXELS / (height * width * columns * rows), 1.0))
        height, width = max(int(height * shrink), 1), max(int(width * shrink), 1)
        atlas = np.empty((rows * height, columns * width, len(channels)), np.float16)
        atlas[:] = fallback[channels]
        for tile, image in images.items():
            pixels = _convert_primaries(_channels(image, channels), space)
            if pixels.shape[:2] != (height, width):
                pixels = resized(pixels, height, width)
            top, left = (rows - 1 - tile // 10) * height, tile % 10 * width
            atlas[top : top + height, left : left + width] = pixels
        first = next(iter(images.values()))
        return first, atlas, (asset.path, tuple(sorted(paths.items())), space), (columns, rows)


def _source_color_space(attribute: Usd.Attribute, authored: str, warn: Callable[[str], None]) -> str:
    """Name of an image's colour space: the node's, else the asset attribute's, else "auto"."""
    name = authored if authored not in ("", "auto") else str(attribute.GetColorSpace() or "auto")
    try:
        color_space(name)
    except Unreadable as error:
        warn(f"{attribute.GetName()} has the {error}; 'auto' is used")
        return "auto"
    return name


def inherited_color_space(attribute: Usd.Attribute, image: Image) -> str:
    """Name of the colour space (ColorSpaceAPI) that an image inherits from a prim; "" if none applies to it.

    A linear colour space applies only to linear images, an encoded one only to images that were decoded.
    """
    try:
        space = color_space(read.color_space_name(attribute))
    except Unreadable:  # colour attributes of the prim have been warned about
        return ""
    return "" if space is None or image.decoded != (decoder(space) is not None) else space_name(space)


def _channels(image: Image, channels: list[int]) -> Floats:
    """Channels [h, w, c] of an image taken as RGBA; a view where possible."""
    pixels, count = image.pixels, image.pixels.shape[2]
    if channels == [0, 1, 2] and count >= 3:
        return pixels[..., :3]
    if channels == [3]:
        return image.alpha[..., None]
    planes = [image.rgb[..., c] if c < 3 else image.alpha for c in channels]
    return planes[0][..., None] if len(planes) == 1 else np.stack(planes, axis=-1)


def _convert_primaries(pixels: Floats, space: str) -> Floats:
    """Linear pixels [h, w, 3 or 4] with the primaries of a colour space in Rec. 709; fewer channels are no colour."""
    if pixels.shape[2] < 3:
        return pixels
    primaries = color_space(space)
    if primaries is None or space == "sRGB":
        return pixels
    matrix = rgb_conversion_matrix(primaries, None).T.astype(np.float32)
    rgb = np.maximum(np.asarray(pixels[..., :3], np.float32) @ matrix, 0.0)
    return np.concatenate([rgb, pixels[..., 3:]], axis=-1)
