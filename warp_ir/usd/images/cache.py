"""The images of a scene, each read once, and what shading networks get of them."""

import math
from collections.abc import Callable, Hashable
from dataclasses import replace

import numpy as np
from pxr import Sdf, Usd, UsdShade

from warp_ir.image.mipmap import resized
from warp_ir.scene import Floats, Texture
from warp_ir.usd.images.asset import MAX_PIXELS, Image, read_texture
from warp_ir.usd.images.shading_value import Signal, compact
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable
from warp_ir.usd.values.source_color_space import between, color_space, decoder

MAX_TEXTURE_PIXELS = 2**27
"""Of all images of a scene: each takes at most half of what is left."""


class Images:
    """The images of a scene and the textures made of them, each once.

    Args:
        report: Where troubles and counts go.
        default_wrap: The wrap mode where neither the network nor the file gives one.
    """

    def __init__(self, report: Report, default_wrap: str = "black") -> None:
        self.report = report
        self.default_wrap = default_wrap
        self._images: dict[tuple[str, str], Image | str] = {}
        self._textures: dict[Hashable, Texture] = {}
        self._left = MAX_TEXTURE_PIXELS

    def read(self, asset: Sdf.AssetPath, space: str, resolved: str = "") -> Image:
        """An image, from the file the first time.

        Raises:
            Unreadable: There is none.
        """
        key = (resolved or asset.resolvedPath or asset.path, space)
        if key not in self._images:
            limit = max(min(MAX_PIXELS, self._left // 2), 1)
            try:
                image = read_texture(resolved or asset, space, limit)
            except Unreadable as trouble:
                self._images[key] = str(trouble)
            else:
                self._left -= image.pixels.shape[0] * image.pixels.shape[1]
                self._images[key] = replace(image, pixels=compact(image.pixels))
                self.report.stats["images"] += 1
                if image.pixels.shape[:2] != (image.height, image.width):
                    self.report.warn(asset.path, "image averaged down to fit the memory for textures ({n} in all)")
        found = self._images[key]
        if isinstance(found, str):
            raise Unreadable(found)
        return found

    def texture(self, signal: Signal) -> Texture:
        """A signal as a texture; equal ones are the same."""
        assert signal.place is not None
        key = (signal.key, signal.place)
        if key not in self._textures:
            red, green, blue = np.broadcast_to(signal.outside, 3).tolist()
            self._textures[key] = Texture(
                signal.name,
                signal.pixels,
                signal.place.wrap,
                (red, green, blue),
                signal.place.uv,
                np.array(signal.place.transform, np.float64),
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
        """The image that an attribute names: itself, some of its channels, a key, and its UDIM tiles across and up.

        Args:
            attribute: Of an asset.
            time: Of its value.
            space: Its colour space as a node has it; "auto" if it does not say. Then that of a prim above counts, if
                it is linear as the image is, or as little.
            fallback: Where a tile is missing, rgba.
            channels: Numbers of those that are wanted, of r, g, b and a.
            warn: Says something about the material.

        Raises:
            Unreadable: There is none.
        """
        asset = read.raw(attribute, time) if attribute is not None else None
        if isinstance(asset, str):
            asset = Sdf.AssetPath(asset)
        if attribute is None or not isinstance(asset, Sdf.AssetPath) or not asset.path:
            raise Unreadable("no image file is named")
        space = _space(attribute, space, warn)
        if "<UDIM>" in asset.path or "<UDIM>" in asset.resolvedPath:
            return self._udim(attribute, time, asset, space, fallback, channels, warn)
        image = self.read(asset, space)
        inherited = inherited_space(attribute, image) if space == "auto" else ""
        if inherited:
            space = inherited
            image = self.read(asset, space)
        pixels, key = self.pixels(asset, space, channels)
        return image, pixels, key, (1, 1)

    def pixels(self, asset: Sdf.AssetPath, space: str, channels: list[int]) -> tuple[Floats, Hashable]:
        """Some channels of an image, [h, w, c], and a key.

        Raises:
            Unreadable: There is none.
        """
        found = _converted(_channels(self.read(asset, space), channels), space)
        return found, (asset.resolvedPath or asset.path, space)

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
        """The tiles of a UDIM set side by side in one image; those that are missing show the fallback."""
        stack = attribute.GetPropertyStack(time)
        tiles = UsdShade.UdimUtils.ResolveUdimTilePaths(asset.path, stack[0].layer if stack else None)
        places = {int(number) - 1001: str(path) for path, number in tiles if str(number).isdigit()}
        places = {at: path for at, path in places.items() if 0 <= at < 100}
        if not places:
            raise Unreadable(f"image '{asset.path}': no tile of it exists")
        images: dict[int, Image] = {}
        for at, path in sorted(places.items()):
            try:
                images[at] = self.read(asset, space, path)
            except Unreadable as trouble:
                warn(f"{trouble}; the texture's fallback is used")
        if not images:
            raise Unreadable(f"image '{asset.path}': no tile of it can be read")
        columns, rows = max(at % 10 for at in images) + 1, max(at // 10 for at in images) + 1
        height = max(image.pixels.shape[0] for image in images.values())
        width = max(image.pixels.shape[1] for image in images.values())
        shrink = math.sqrt(min(MAX_PIXELS / (height * width * columns * rows), 1.0))
        height, width = max(int(height * shrink), 1), max(int(width * shrink), 1)
        atlas = np.empty((rows * height, columns * width, len(channels)), np.float16)
        atlas[:] = fallback[channels]
        for at, image in images.items():
            tile = _converted(_channels(image, channels), space)
            if tile.shape[:2] != (height, width):
                tile = resized(tile, height, width)
            top, left = (rows - 1 - at // 10) * height, at % 10 * width
            atlas[top : top + height, left : left + width] = tile
        first = next(iter(images.values()))
        return first, atlas, (asset.path, tuple(sorted(places.items())), space), (columns, rows)


def _space(attribute: Usd.Attribute, said: str, warn: Callable[[str], None]) -> str:
    """An image's colour space: what the node says of it, else what stands on the attribute, else "auto"."""
    found = said if said not in ("", "auto") else str(attribute.GetColorSpace() or "auto")
    try:
        color_space(found)
    except Unreadable as trouble:
        warn(f"{attribute.GetName()} has the {trouble}; it is guessed")
        return "auto"
    return found


def inherited_space(attribute: Usd.Attribute, image: Image) -> str:
    """The colour space that a prim gives to an image below it; "" where it gives none that the image can have.

    A linear space says nothing of bytes, nor one for a screen of floats.
    """
    try:
        space = color_space(read.color_space_name(attribute))
    except Unreadable:  # which the colours of the prim have said
        return ""
    return "" if space is None or image.decoded != (decoder(space) is not None) else str(space.GetName())


def _channels(image: Image, channels: list[int]) -> Floats:
    """Channels of an image as if it had r, g, b and a, [h, w, c]; without a copy where possible."""
    pixels, count = image.pixels, image.pixels.shape[2]
    if channels == [0, 1, 2] and count >= 3:
        return pixels[..., :3]
    if channels == [3]:
        return image.alpha[..., None]
    planes = [image.rgb[..., c] if c < 3 else image.alpha for c in channels]
    return planes[0][..., None] if len(planes) == 1 else np.stack(planes, axis=-1)


def _converted(pixels: Floats, space: str) -> Floats:
    """Linear pixels [h, w, 3 or 4] of a colour space as Rec.709; fewer channels are no colour."""
    if pixels.shape[2] < 3:
        return pixels
    primaries = color_space(space)
    if primaries is None or space == "sRGB":
        return pixels
    rgb = np.maximum(np.asarray(pixels[..., :3], np.float32) @ between(primaries, None).T.astype(np.float32), 0.0)
    return np.concatenate([rgb, pixels[..., 3:]], axis=-1)
