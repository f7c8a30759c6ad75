"""Photometry of lamps: the .ies files of IES LM-63, as a table of intensities over directions."""

import math
import os

import numpy as np
from pxr import Ar, Sdf

from warp_ir.scene import Floats
from warp_ir.usd.values.report import Unreadable

_LARGEST = 2**24
"""Bytes; real files have a few thousand."""
_TYPES = {1: "C", 2: "B", 3: "A"}
_ROWS = 720
_COLUMNS = 360


def read_profile(asset: Sdf.AssetPath, angle_scale: float, normalize: bool) -> Floats:
    """The factors that a lamp's profile puts on the radiance of a light, as `Shaping.profile` wants them.

    Args:
        asset: Of an .ies file. In type C the light's axis is where polar angles begin; in types A and B (of headlamps
            and floodlights) it is where the lamp is aimed, +Y is up and +X is on the right of one who stands behind it.
        angle_scale: ShapingAPI's ies:angleScale: θ_ies = θ / scale, or (θ - π) / -scale + π if it is negative,
            clamped to [0, π] as the reference renderer of OpenUSD does.
        normalize: Whether to divide by the profile's mean over the sphere (over the hemisphere, if it ends there), as
            the reference renderer of OpenUSD does.

    Returns:
        [rows, columns] in the file's candela; one column if the lamp is the same all around.

    Raises:
        Unreadable: There is no such file, or it is not such a profile; the message names it.
    """
    try:
        kind, vertical, horizontal, candela = _parse(_bytes(asset))
    except Unreadable as trouble:
        raise Unreadable(f"profile '{asset.path[-120:]}' {trouble}") from None
    rows = (np.arange(_ROWS) + 0.5) * (180.0 / _ROWS)
    around = len(horizontal) > 1 or kind != "C"
    columns = (np.arange(_COLUMNS) + 0.5) * (360.0 / _COLUMNS) if around else np.zeros(1)

    def table(theta: Floats) -> Floats:
        if kind == "C":
            return _table(vertical, horizontal, candela, theta, columns)
        return _aimed_table(kind, vertical, horizontal, candela, theta, columns)

    mean = 1.0
    if normalize:
        sines = np.sin(np.radians(rows))
        mean = float((table(rows).mean(axis=1) @ sines) / sines.sum())
        mean *= 1.0 if kind == "C" and vertical[-1] - vertical[0] > 90.0 + 0.1 * 180.0 / math.pi else 2.0
        if not mean > 0.0:
            raise Unreadable(f"profile '{asset.path[-120:]}' is dark and cannot be normalized")
    scaled = rows
    if angle_scale != 0.0:
        scaled = rows / angle_scale if angle_scale > 0.0 else (rows - 180.0) / -angle_scale + 180.0
    return table(scaled.clip(0.0, 180.0)) / mean


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


def _parse(content: bytes) -> tuple[str, Floats, Floats, Floats]:
    """The type, vertical angles [v], horizontal angles [h], both in degrees and ascending, and candela [h, v]."""
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
    if kind not in _TYPES:
        raise Unreadable(f"has photometry of type {kind}, which is none of C, B and A (1, 2 and 3)")
    if len(numbers) < at + verticals + horizontals + verticals * horizontals:
        raise Unreadable("ends too early")
    vertical = numbers[at : at + verticals]
    horizontal = numbers[at + verticals : at + verticals + horizontals]
    at += verticals + horizontals
    candela = numbers[at : at + verticals * horizontals].reshape(horizontals, verticals)
    if (np.diff(vertical) <= 0.0).any() or (np.diff(horizontal) <= 0.0).any():
        raise Unreadable("has angles that do not ascend")
    least, most = (0.0, (180.0, 360.0)) if _TYPES[kind] == "C" else (-90.0, (90.0, 90.0))
    if min(vertical[0], horizontal[0]) < least or vertical[-1] > most[0] or horizontal[-1] > most[1]:
        raise Unreadable("has angles beyond those of its type")
    # Multiplier of the candela, ballast factor, and what was once the ballast-lamp factor.
    return _TYPES[kind], vertical, horizontal, np.maximum(candela * head[2] * head[10] * head[11], 0.0)


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


def _aimed_table(
    kind: str, vertical: Floats, horizontal: Floats, candela: Floats, theta: Floats, phi: Floats
) -> Floats:
    """Candela at polar angles [rows] and azimuths [columns] around the aim, bilinear; 0 beyond the angles of the file.

    In type A the horizontal angle is that around the vertical axis, and the vertical angle the elevation; in type B the
    vertical angle is that around the horizontal axis, and the horizontal angle is from it. Angles from 0° alone are the
    same on both sides.
    """
    polar, around = np.radians(theta)[:, None], np.radians(phi)
    right, up = np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around)
    ahead = np.broadcast_to(np.cos(polar), right.shape)
    if kind == "A":
        aside, above = np.arctan2(right, ahead), np.arcsin(np.clip(up, -1.0, 1.0))
    else:
        aside, above = np.arcsin(np.clip(right, -1.0, 1.0)), np.arctan2(up, ahead)
    aside, above = np.degrees(aside), np.degrees(above)
    aside = np.abs(aside) if horizontal[0] >= 0.0 else aside
    above = np.abs(above) if vertical[0] >= 0.0 else above
    column, row = (np.interp(x, axis, np.arange(len(axis))) for x, axis in ((aside, horizontal), (above, vertical)))
    i, j = (np.minimum(x.astype(int), len(axis) - 1) for x, axis in ((column, horizontal), (row, vertical)))
    k, m = np.minimum(i + 1, len(horizontal) - 1), np.minimum(j + 1, len(vertical) - 1)
    x, y = column - i, row - j
    table = (candela[i, j] * (1 - y) + candela[i, m] * y) * (1 - x) + (candela[k, j] * (1 - y) + candela[k, m] * y) * x
    inside = (ahead > 0.0) & (above >= vertical[0]) & (above <= vertical[-1])
    # A single horizontal angle stands for all of them, as it does in type C.
    return np.where(
        inside & ((len(horizontal) == 1) | (aside >= horizontal[0]) & (aside <= horizontal[-1])), table, 0.0
    )
