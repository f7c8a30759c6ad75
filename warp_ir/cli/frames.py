"""Frame specifications and the names of the frames' files, `101:105` and `shot.####.png`, as in usdrecord."""

import re
from pathlib import Path

from warp_ir.cli.import_guard import importing
from warp_ir.scene import InputError

TimeCode = float | str | None
"""A time code; "default": the default time; None: the stage's start."""
_MAX_FRAMES = 1_000_000
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_SPAN = re.compile(rf"{_NUMBER}(?::{_NUMBER}(?:x{_NUMBER})?)?")
"""One frame or a range. USD's parser ends the process where a number is missing, as in `1:`."""


def outputs_of(output: str, frames: str | None, time: TimeCode) -> dict[TimeCode, Path]:
    """The file to write for each time code; without `frames` there is one, for `time`.

    Args:
        output: Path; with `frames` it has one placeholder (`###`, or `###.##` for fractions).
        frames: `101`, `101:105`, `105:101`, `101:109x2`, `101:104x0.5`, or several with commas.
        time: Time code of a single picture.

    Raises:
        InputError: The frames cannot be parsed, the placeholder is missing or has too few decimals, or there is one and
            no frames are given.
    """
    placeholders = re.findall(r"#+(?:\.#+)?", output)
    if frames is None:
        if any(len(placeholder) > 1 for placeholder in placeholders):  # a single # may be part of a name
            raise InputError(f"{output}: {placeholders[-1]} is the place of a frame number, which needs --frames")
        return {time: Path(output)}
    codes = time_codes(frames)
    if len(placeholders) != 1:
        raise InputError(f"--frames: the output needs one placeholder such as ### for the frame: {output}")
    width, digits = len(placeholders[0]), len(placeholders[0].partition(".")[2])
    outputs: dict[TimeCode, Path] = {}
    for frame in codes:
        if round(frame, digits) != frame:
            raise InputError(f"--frames: {frame:g} needs a placeholder with decimals, ###.##: {output}")
        outputs[frame] = Path(output.replace(placeholders[0], f"{frame:0{width}.{digits}f}"))
    return outputs


def time_codes(spec: str) -> list[float]:
    """The frame numbers of a specification in its order, each once.

    Raises:
        InputError: The specification cannot be parsed, or has more than a million frames.
    """
    with importing():
        from pxr import Tf, UsdUtils

    codes: dict[float, None] = {}
    for part in spec.split(","):
        try:
            known = _SPAN.fullmatch(part.strip())
            span = UsdUtils.TimeCodeRange.CreateFromFrameSpec(part.strip()) if known else None
        except Tf.ErrorException:
            span = None
        if span is None or not span.IsValid():
            raise InputError(f"--frames: {part.strip()!r} is not understood; use 101, 101:105 or 101:109x2")
        for code in span:
            codes[code.GetValue() + 0.0] = None  # -0 becomes 0
            if len(codes) > _MAX_FRAMES:
                raise InputError(f"--frames: more than {_MAX_FRAMES} frames: {spec}")
    return list(codes)
