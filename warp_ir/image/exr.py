"""What compositors expect of an OpenEXR file beside its pixels: standard attributes, compression, one part or many."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from warp_ir.image.cryptomatte import Cryptomatte
from warp_ir.scene import Camera, Floats, InputError, Projection

COMPRESSIONS = ("zip", "zips", "piz", "rle", "none", "dwaa", "dwab")
"""Compressions of OpenEXR; the first is the default. dwaa and dwab lose digits of colours, the others lose nothing."""
LOSSY = frozenset({"dwaa", "dwab"})
_LOSSLESS = "zip"
_NTSC = 1.001
"""24000/1001, 30000/1001, ... are written as 23.976, 29.97, ..."""

Matrix = tuple[float, ...]
"""16 numbers, row by row, of a matrix that rows of coordinates are multiplied by from the left, as Imath's are."""


@dataclass(frozen=True, kw_only=True)
class ExrOptions:
    """How an OpenEXR file is stored, and what it holds beside the picture and AOVs."""

    compression: str = COMPRESSIONS[0]
    """One of `COMPRESSIONS`; in a file of many parts, colours alone are stored with loss."""
    multipart: bool = False
    """Whether the picture, each AOV and each Cryptomatte is a part of its own."""
    cryptomattes: Sequence[Cryptomatte] = ()
    """Coverage by name, from `Renderer.cryptomattes`; always 32 bits, without loss."""
    owner: str | None = None
    """Whose picture it is."""
    frames_per_second: float | None = None
    """Rate at which the sequence is played, which this is a frame of."""

    def __post_init__(self) -> None:
        """Checks the values.

        Raises:
            InputError: The compression is unknown, or would change the numbers that stand for names; or the rate is
                no positive number.
        """
        if self.compression not in COMPRESSIONS:
            known = ", ".join(COMPRESSIONS)
            raise InputError(f"compression: must be one of {known}, is {self.compression!r}")
        if self.compression in LOSSY and self.cryptomattes and not self.multipart:
            raise InputError(f"compression: {self.compression} would change Cryptomattes; store them in many parts")
        if self.frames_per_second is not None and not 0.0 < self.frames_per_second < 1.0e6:
            raise InputError(f"frames_per_second: must be a positive number, is {self.frames_per_second!r}")

    def compression_of(self, colors: bool) -> str:
        """The compression of a part of a file, which holds colours or other values."""
        return _LOSSLESS if self.compression in LOSSY and not colors else self.compression

    def attributes(self) -> Mapping[str, object]:
        """OpenEXR's standard attributes, and those of the Cryptomattes."""
        out: dict[str, object] = {}
        if self.owner:
            out["owner"] = self.owner
        if self.frames_per_second is not None:
            out["framesPerSecond"] = frame_rate(self.frames_per_second)
        for matte in self.cryptomattes:
            out |= matte.metadata()
        return out


def frame_rate(frames_per_second: float) -> Fraction:
    """A frame rate as a fraction: whole, or a whole number of thousands over 1001, or the nearest simple one."""
    for denominator, rate in ((1, frames_per_second), (1001, frames_per_second * _NTSC)):
        if abs(rate - round(rate)) < 1.0e-3 * (denominator > 1) + 1.0e-9:
            return Fraction(round(rate) * (1000 if denominator > 1 else 1), denominator)
    return Fraction(frames_per_second).limit_denominator(1000)


def camera_matrices(camera: Camera) -> Mapping[str, Matrix]:
    """OpenEXR's worldToCamera and worldToNDC of a camera that is fitted to the image.

    OpenEXR's camera space is left-handed: x to the right, y up, z in the viewing direction. Its NDC are (0, 0) in the
    upper left corner of the display window and (1, 1) in the lower right one, after division by the fourth coordinate.
    The third is 1 - n/z, where n is the distance of the near plane, or 1 if that is 0; orthographic: z - n.
    """
    to_camera = np.diag([1.0, 1.0, -1.0, 1.0]) @ np.linalg.inv(camera.world_from_camera)
    left, right, bottom, top = camera.window
    near = camera.clipping[0] or 1.0
    x, y = 1.0 / (right - left), 1.0 / (top - bottom)
    if camera.projection == Projection.PERSPECTIVE:
        to_ndc = np.array([[x, 0, -left * x, 0], [0, -y, top * y, 0], [0, 0, 1, -near], [0, 0, 1, 0]])
    else:
        to_ndc = np.array([[x, 0, 0, -left * x], [0, -y, 0, top * y], [0, 0, 1, -near], [0, 0, 0, 1]])
    return {"worldToCamera": _rows(to_camera), "worldToNDC": _rows(to_ndc @ to_camera)}


def _rows(matrix: Floats) -> Matrix:
    """A matrix for column vectors as one for row vectors."""
    return tuple(float(x) for x in matrix.T.ravel())
