"""Photometry of lamps: the .ies files of IES LM-63, as a table of intensities over directions."""

import math
import os

import numpy as np
from pxr import Ar, Sdf

from warp_ir.scene import Floats
from warp_ir.usd.report import Unreadable

_LARGEST = 2**24
"""Bytes; real files have a few thousand."""
_ROWS = 720
_COLUMNS = 360


def read_profile(asset: Sdf.AssetPath, angle_scale: float, normalize: bool) -> Floats:
    """The factors that a lamp's profile puts on the radiance of a light, as `Shaping.profile` wants them.

    Args:
        asset: Of an .ies file with type C photometry.
        angle_scale: ShapingAPI's ies:angleScale: θ_ies = θ / scale, or (θ - π) / -scale + π if it is negative.
        normalize: Whether to divide by the profile's mean over the sphere (over the hemisphere, if it ends there), as
            the reference renderer of OpenUSD does.

    Returns:
        [rows, columns] in the file's candela; one column if the lamp is the same all around.

    Raises:
        Unreadable: There is no such file, or it is not such a profile; the message names it.
    """
    try:
        vertical, horizontal, candela = _parse(_bytes(asset))
    except Unreadable as trouble:
        raise Unreadable(f"profile '{asset.path[-120:]}' {trouble}") from None
    rows = (np.arange(_ROWS) + 0.5) * (180.0 / _ROWS)
    columns = (np.arange(_COLUMNS) + 0.5) * (360.0 / _COLUMNS) if len(horizontal) > 1 else np.zeros(1)
    mean = 1.0
    if normalize:
        sines = np.sin(np.radians(rows))
        mean = float((_table(vertical, horizontal, candela, rows, columns).mean(axis=1) @ sines) / sines.sum())
        mean *= 1.0 if vertical[-1] - vertical[0] > 90.0 + 0.1 * 180.0 / math.pi else 2.0
        if not mean > 0.0:
            raise Unreadable(f"profile '{asset.path[-120:]}' is dark and cannot be normalized")
    scaled = rows
    if angle_scale != 0.0:
        scaled = rows / angle_scale if angle_scale > 0.0 else (rows - 180.0) / -angle_scale + 180.0
    return _table(vertical, horizontal, candela, scaled, columns) / mean


def _bytes(asset: Sdf.AssetPath) -> bytes:
    path = asset.resolvedPath
    if not path or (os.path.exists(path) and not os.path.isfile(path)):
        raise Unreadable("not found")
    opened = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(path))
    if not opened:
        raise Unreadable("not found")
    if opened.GetSize() > _LARGEST:
        raise Unreadable(f"has more than {_LARGEST} bytes")
    return bytes(opened.GetBuffer() or b"")


def _parse(content: bytes) -> tuple[Floats, Floats, Floats]:
    """Vertical angles [v], horizontal angles [h], both in degrees and ascending, and candela [h, v]."""
    text = content.decode("latin-1")
    lines = text.splitlines()
    tilt = next((k for k, line in enumerate(lines) if line.strip().upper().startswith("TILT=")), None)
    if tilt is None:
        raise Unreadable("is no IES photometry: it has no line TILT=")
    words = " ".join(lines[tilt + 1 :]).replace(",", " ").split()
    try:
        numbers = np.array(words, dtype=np.float64)
    except ValueError:
        raise Unreadable("holds something that is no number") from None
    if not np.isfinite(numbers).all():
        raise Unreadable("holds a number that is not finite")
    at = 0
    if lines[tilt].strip().upper() == "TILT=INCLUDE":
        # How the lamp's tilt changes its light: geometry, number of pairs, angles, factors. It hangs straight here.
        at = 2 + 2 * _count(numbers, 1)
    if len(numbers) < at + 13:
        raise Unreadable("ends too early")
    head, at = numbers[at : at + 13], at + 13
    verticals, horizontals, kind = _count(head, 3), _count(head, 4), int(head[5])
    if kind != 1:
        raise Unreadable(f"has photometry of type {'?BA'[kind - 1] if kind in (2, 3) else kind}, not C")
    if len(numbers) < at + verticals + horizontals + verticals * horizontals:
        raise Unreadable("ends too early")
    vertical = numbers[at : at + verticals]
    horizontal = numbers[at + verticals : at + verticals + horizontals]
    at += verticals + horizontals
    candela = numbers[at : at + verticals * horizontals].reshape(horizontals, verticals)
    if (np.diff(vertical) <= 0.0).any() or (np.diff(horizontal) <= 0.0).any() or vertical[0] < 0.0:
        raise Unreadable("has angles that do not ascend")
    if vertical[-1] > 180.0 or not 0.0 <= horizontal[0] or horizontal[-1] > 360.0:
        raise Unreadable("has angles beyond a circle")
    # Multiplier of the candela, ballast factor, and what was once the ballast-lamp factor.
    return vertical, horizontal, np.maximum(candela * head[2] * head[10] * head[11], 0.0)


def _count(numbers: Floats, index: int) -> int:
    count = float(numbers[index]) if index < len(numbers) else 0.0
    if not (1.0 <= count <= 100_000.0 and count == int(count)):
        raise Unreadable(f"has {count:g} angles")
    return int(count)


def _table(vertical: Floats, horizontal: Floats, candela: Floats, theta: Floats, phi: Floats) -> Floats:
    """Candela at polar angles [rows] and azimuths [columns], bilinear; 0 beyond the vertical angles of the file."""
    by_theta = np.array([np.interp(theta, vertical, row, left=0.0, right=0.0) for row in candela])  # [h, rows]
    if len(vertical) == 1:
        by_theta = np.tile(candela, (1, len(theta)))
    if len(horizontal) == 1:
        return by_theta.T
    # What is left out is given by symmetry: a quadrant, half a turn, or the half from 90° to 270°.
    first, last = float(horizontal[0]), float(horizontal[-1])
    turned = phi % 360.0
    if last <= 90.0:
        turned = np.minimum(turned % 180.0, 180.0 - turned % 180.0)
    elif first >= 90.0 and last <= 270.0:
        turned = np.where(turned < 90.0, 180.0 - turned, np.where(turned > 270.0, 540.0 - turned, turned))
    elif last <= 180.0:
        turned = np.minimum(turned, 360.0 - turned)
    period = 360.0 if last > 180.0 and last - first < 360.0 and first < 90.0 else None
    return np.array([np.interp(turned, horizontal, column, period=period) for column in by_theta.T])
