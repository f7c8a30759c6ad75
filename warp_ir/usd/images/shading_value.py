"""Values of shading networks: constants, images in place on a surface, or primvars.

An image that is scaled, tinted or mixed with constants is again an image, so all of that is done once, here, and
renders for nothing. Two images that lie in the same place are combined pixel by pixel; if they do not, the second
counts as its mean.
"""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from warp_ir.image.mipmap import resized
from warp_ir.scene import Floats, Wrap


@dataclass(frozen=True)
class Place:
    """How an image lies on a surface."""

    uv: str = "st"
    transform: tuple[tuple[float, float, float], tuple[float, float, float]] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    wrap: tuple[Wrap, Wrap] = (Wrap.REPEAT, Wrap.REPEAT)


@dataclass(frozen=True)
class Primvar:
    """Values that a surface may have at its corners."""

    name: str
    channels: int


PrimvarValues = Mapping[Primvar, Floats]
"""Those that a surface has, float [c] where they are the same everywhere, or [m, 3, c]."""


@dataclass(frozen=True, eq=False)
class Signal:
    """What comes out of a network."""

    pixels: Floats
    """float [h, w, c], [1, 1, c] for a constant; row 0 at the top."""
    outside: Floats
    """float [c], the value beyond the image's edges."""
    place: Place | None
    """None: it is a constant."""
    key: Hashable
    """Equal where the content is."""
    name: str = ""
    """Of the image."""
    primvars: tuple[Primvar, ...] = ()
    """What it depends on besides; `pixels` is the value where surfaces have none of them."""
    of: Callable[[PrimvarValues], Floats] | None = None
    """Its value, given those primvars that a surface has; images count as their means."""

    @property
    def mean(self) -> Floats:
        """Over the pixels, float64 [c]."""
        return np.asarray(self.pixels.mean(axis=(0, 1), dtype=np.float64))

    def at(self, values: PrimvarValues) -> Floats:
        """Its value on a surface, [c] or [m, 3, c]."""
        return self.mean if self.of is None else self.of(values)


def from_primvar(primvar: Primvar, fallback: Signal) -> Signal:
    """A surface's primvar, or a constant where it has none."""
    without = np.resize(fallback.mean, primvar.channels)
    return replace(
        constant(*without.tolist()), primvars=(primvar,), of=lambda values: values.get(primvar, without), key=primvar
    )


def constant(*channels: float) -> Signal:
    """The same everywhere."""
    at = np.array(channels, np.float64)
    return Signal(at.reshape(1, 1, -1), at, None, tuple(channels))


def combine(label: Hashable, function: Callable[..., Any], *signals: Signal) -> Signal:
    """A function of signals, pixel by pixel; it takes and gives arrays [..., c].

    Args:
        label: Tells functions apart.
        function: Of as many arrays.
        signals: Their arguments.
    """
    images = [s for s in signals if s.place is not None]
    key = (label, *(s.key for s in signals))
    primvars = tuple(dict.fromkeys(p for s in signals for p in s.primvars))
    of = (lambda values: _finite(function(*(s.at(values) for s in signals)))) if primvars else None
    if not images:
        made = _finite(function(*(s.pixels for s in signals)))
        return Signal(made, made[0, 0], None, key, "", primvars, of)
    first = images[0]
    together = [s for s in images if s.place == first.place]
    height, width = (max(s.pixels.shape[axis] for s in together) for axis in (0, 1))
    pixels, outside = [], []
    for s in signals:
        if s.place is not None and s.place != first.place:
            pixels.append(s.mean.reshape(1, 1, -1))
            outside.append(s.mean)
        else:
            fits = s.place is None or s.pixels.shape[:2] == (height, width)
            pixels.append(s.pixels if fits else resized(s.pixels, height, width))
            outside.append(s.outside)
    made = _finite(function(*(np.asarray(p, np.float32) for p in pixels)))
    made = np.broadcast_to(made, (height, width, made.shape[-1]))
    return Signal(compact(made), _finite(function(*outside)), first.place, key, first.name, primvars, of)


def _finite(values: Floats) -> Floats:
    """Arithmetic in a file may overflow."""
    return np.nan_to_num(np.asarray(values), nan=0.0, posinf=3.0e38, neginf=-3.0e38)


def select(signal: Signal, channels: list[int]) -> Signal:
    """Some channels, in any order."""
    pixels, outside = signal.pixels[..., channels], np.asarray(signal.outside)[channels]
    of = None if signal.of is None else lambda values: signal.at(values)[..., channels]
    return replace(signal, pixels=pixels, outside=outside, key=("select", tuple(channels), signal.key), of=of)


def as_color(signal: Signal) -> Signal:
    """Three channels: the first three, or one thrice."""
    count = signal.pixels.shape[2]
    if count == 3:
        return signal
    return select(signal, [0, 1, 2] if count > 3 else [0, 0, 0])


def compact(pixels: Floats) -> Floats:
    """In halves where they are enough: 11 bits from 6e-5 to 65504."""
    if pixels.dtype == np.float16 or np.abs(pixels).max() > 6.0e4:
        return pixels
    return pixels.astype(np.float16)
