"""IES profiles: .ies files (IES LM-63) as tables of intensity over directions."""

import math
import os

import numpy as np
from pxr import Ar, Sdf

from warp_ir.scene import Floats
from warp_ir.usd.values.report import Unreadable

_MAX_BYTES = 2**24
"""Maximum size in bytes; real files have a few thousand."""
_TYPES = {1: "C", 2: "B", 3: "A"}
_ROWS = 720
_COLUMNS = 360


def read_profile(asset: Sdf.AssetPath, angle_scale: float, normalize: bool) -> Floats:
    """The factors by which a profile scales a light's radiance, as `Shaping.profile` takes them.

    Args:
        asset: An .ies file. In type C polar angles are measured from the light's axis. In types A and B (headlamps and
            floodlights) the axis is the aim of the lamp, +Y is up and +X is to the right as seen from behind the lamp.
        angle_scale: ShapingAPI's ies:angleScale: θ_ies = θ / scale, or (θ - π) / -scale + π if it is negative,
            clamped to [0, π] as in OpenUSD's reference renderer.
        normalize: Whether to divide by the profile's mean over the sphere (over the hemisphere, if it ends there), as
            OpenUSD's reference renderer does.

    Returns:
        [rows, columns] in the file's candela; one column if the profile is rotationally symmetric.

    Raises:
        Unreadable: There is no such file, or it is not an IES profile; the message names it.
    """
    try:
        kind, vertical, horizontal, candela = _parse(_read_bytes(asset))
    except Unreadable as trouble:
        raise Unreadable(f"profile '{asset.path[-120:]}' {trouble}") from None
    rows = (np.arange(_ROWS) + 0.5) * (180.0 / _ROWS)
    azimuthal = len(horizontal) > 1 or kind != "C"
    columns = (np.arange(_COLUMNS) + 0.5) * (360.0 / _COLUMNS) if azimuthal else np.zeros(1)

    def candela_at(theta: Floats) -> Floats:
        if kind == "C":
            return _candela_type_c(vertical, horizontal, candela, theta, columns)
        return _candela_aimed(kind, vertical, horizontal, candela, theta, columns)

    mean = 1.0
    if normalize:
        sines = np.sin(np.radians(rows))
        mean = float((candela_at(rows).mean(axis=1) @ sines) / sines.sum())
        mean *= 1.0 if kind == "C" and vertical[-1] - vertical[0] > 90.0 + 0.1 * 180.0 / math.pi else 2.0
        if not mean > 0.0:
            raise Unreadable(f"profile '{asset.path[-120:]}' emits nothing and cannot be normalized")
    scaled = rows
    if angle_scale != 0.0:
        scaled = rows / angle_scale if angle_scale > 0.0 else (rows - 180.0) / -angle_scale + 180.0
    return candela_at(scaled.clip(0.0, 180.0)) / mean


def _read_bytes(asset: Sdf.AssetPath) -> bytes:
    """The content of an asset."""
    path = asset.resolvedPath
    if not path or (os.path.exists(path) and not os.path.isfile(path)):
        raise Unreadable("not found")
    opened = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(path))
    if not opened:
        raise Unreadable("not found")
    if opened.GetSize() > _MAX_BYTES:
        raise Unreadable(f"has more than {_MAX_BYTES} bytes")
    return bytes(opened.GetBuffer() or b"")


def _parse(content: bytes) -> tuple[str, Floats, Floats, Floats]:
    """The type, vertical angles [v], horizontal angles [h], both in degrees and ascending, and candela [h, v]."""
    text = content.decode("latin-1")
    lines = text.splitlines()
    tilt = next((k for k, line in enumerate(lines) if line.strip().upper().startswith("TILT=")), None)
    if tilt is None:
        raise Unreadable("is not an IES profile: it has no line TILT=")
    words = " ".join(lines[tilt + 1 :]).replace(",", " ").split()
    try:
        numbers = np.array(words, dtype=np.float64)
    except ValueError:
        raise Unreadable("contains a word that is not a number") from None
    if not np.isfinite(numbers).all():
        raise Unreadable("contains a number that is not finite")
    cursor = 0
    if lines[tilt].strip().upper() == "TILT=INCLUDE":
        # TILT data: geometry, number of pairs, angles, factors. They are skipped: the lamp is not tilted.
        cursor = 2 + 2 * _count(numbers, 1)
    if len(numbers) < cursor + 13:
        raise Unreadable("ends too early")
    head, cursor = numbers[cursor : cursor + 13], cursor + 13
    vertical_count, horizontal_count, kind = _count(head, 3), _count(head, 4), int(head[5])
    if kind not in _TYPES:
        raise Unreadable(f"has photometry of type {kind}, which is not C, B or A (1, 2 or 3)")
    if len(numbers) < cursor + vertical_count + horizontal_count + vertical_count * horizontal_count:
        raise Unreadable("ends too early")
    vertical = numbers[cursor : cursor + vertical_count]
    horizontal = numbers[cursor + vertical_count : cursor + vertical_count + horizontal_count]
    cursor += vertical_count + horizontal_count
    candela = numbers[cursor : cursor + vertical_count * horizontal_count].reshape(horizontal_count, vertical_count)
    if (np.diff(vertical) <= 0.0).any() or (np.diff(horizontal) <= 0.0).any():
        raise Unreadable("has angles that do not ascend")
    least, most = (0.0, (180.0, 360.0)) if _TYPES[kind] == "C" else (-90.0, (90.0, 90.0))
    if min(vertical[0], horizontal[0]) < least or vertical[-1] > most[0] or horizontal[-1] > most[1]:
        raise Unreadable("has angles outside the range of its type")
    # Candela multiplier, ballast factor, and the factor that early versions call ballast-lamp.
    return _TYPES[kind], vertical, horizontal, np.maximum(candela * head[2] * head[10] * head[11], 0.0)


def _count(numbers: Floats, index: int) -> int:
    """A number of angles, checked."""
    count = float(numbers[index]) if index < len(numbers) else 0.0
    if not (1.0 <= count <= 100_000.0 and count == int(count)):
        raise Unreadable(f"has {count:g} angles")
    return int(count)


def _candela_type_c(vertical: Floats, horizontal: Floats, candela: Floats, theta: Floats, phi: Floats) -> Floats:
    """Type C: candela at polar angles [rows] and azimuths [columns], bilinear; 0 outside the file's vertical angles."""
    by_polar_angle = np.array([np.interp(theta, vertical, row, left=0.0, right=0.0) for row in candela])  # [h, rows]
    if len(vertical) == 1:
        by_polar_angle = np.tile(candela, (1, len(theta)))
    if len(horizontal) == 1:
        return by_polar_angle.T
    # Symmetry completes the azimuths: from a quadrant, from half a turn, or from the half between 90° and 270°.
    first, last = float(horizontal[0]), float(horizontal[-1])
    folded = phi % 360.0
    if last <= 90.0:
        folded = np.minimum(folded % 180.0, 180.0 - folded % 180.0)
    elif first >= 90.0 and last <= 270.0:
        folded = np.where(folded < 90.0, 180.0 - folded, np.where(folded > 270.0, 540.0 - folded, folded))
    elif last <= 180.0:
        folded = np.minimum(folded, 360.0 - folded)
    period = 360.0 if last > 180.0 and last - first < 360.0 and first < 90.0 else None
    return np.array([np.interp(folded, horizontal, column, period=period) for column in by_polar_angle.T])


def _candela_aimed(
    kind: str, vertical: Floats, horizontal: Floats, candela: Floats, theta: Floats, phi: Floats
) -> Floats:
    """Types A and B: candela at polar angles [rows] and azimuths [columns] around the aim; 0 outside the file's angles.

    In type A the horizontal angle is measured around the vertical axis, and the vertical angle is the elevation. In
    type B the vertical angle is measured around the horizontal axis, and the horizontal angle is the angle out of that
    plane. Angles that begin at 0° are mirrored. The interpolation is bilinear.
    """
    polar, azimuthal = np.radians(theta)[:, None], np.radians(phi)
    right, up = np.sin(polar) * np.cos(azimuthal), np.sin(polar) * np.sin(azimuthal)
    ahead = np.broadcast_to(np.cos(polar), right.shape)
    if kind == "A":
        horizontal_angle, vertical_angle = np.arctan2(right, ahead), np.arcsin(np.clip(up, -1.0, 1.0))
    else:
        horizontal_angle, vertical_angle = np.arcsin(np.clip(right, -1.0, 1.0)), np.arctan2(up, ahead)
    horizontal_angle, vertical_angle = np.degrees(horizontal_angle), np.degrees(vertical_angle)
    horizontal_angle = np.abs(horizontal_angle) if horizontal[0] >= 0.0 else horizontal_angle
    vertical_angle = np.abs(vertical_angle) if vertical[0] >= 0.0 else vertical_angle
    column, row = (
        np.interp(x, axis, np.arange(len(axis)))
        for x, axis in ((horizontal_angle, horizontal), (vertical_angle, vertical))
    )
    i, j = (np.minimum(x.astype(int), len(axis) - 1) for x, axis in ((column, horizontal), (row, vertical)))
    k, m = np.minimum(i + 1, len(horizontal) - 1), np.minimum(j + 1, len(vertical) - 1)
    x, y = column - i, row - j
    table = (candela[i, j] * (1 - y) + candela[i, m] * y) * (1 - x) + (candela[k, j] * (1 - y) + candela[k, m] * y) * x
    inside = (ahead > 0.0) & (vertical_angle >= vertical[0]) & (vertical_angle <= vertical[-1])
    # A single horizontal angle applies to all of them, as in type C.
    return np.where(
        inside & ((len(horizontal) == 1) | (horizontal_angle >= horizontal[0]) & (horizontal_angle <= horizontal[-1])),
        table,
        0.0,
    )
