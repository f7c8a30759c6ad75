"""Opening a stage: errors in one line, USD's own diagnostics collected instead of spilled."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pxr import Tf, Usd, UsdGeom, UsdUtils

from warp_ir.scene import InputError
from warp_ir.usd.crate import check_sizes
from warp_ir.usd.report import Report

_SHOWN = 5
"""How many composition errors, and other diagnostics, are listed; the rest is counted."""


@contextmanager
def quiet() -> Iterator[None]:
    """Keep USD's diagnostics off stderr; what matters among them the loader finds and says itself."""
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    finally:
        delegate.TakeUncoalescedDiagnostics()


def open_stage(path: str, report: Report) -> Usd.Stage:
    """Open a stage with all its payloads.

    Raises:
        InputError: The file is missing, is a directory, or is not readable as USD.
    """
    if not Path(path).exists():
        raise InputError(f"{path}: no such file")
    if Path(path).is_dir():
        raise InputError(f"{path}: is a directory, not a USD file")
    try:
        check_sizes(path)
        stage = Usd.Stage.Open(path)
    except (Tf.ErrorException, RuntimeError, OSError) as error:
        raise InputError(f"{path}: cannot be opened as USD: {first_message(error).removeprefix(f'{path}:')}") from None
    errors = dict.fromkeys(_tidy(str(error)) for error in stage.GetCompositionErrors())
    for text in list(errors)[:_SHOWN]:
        report.warn("/", f"composition: {text}")
    if len(errors) > _SHOWN:
        report.warn("/", f"composition: {len(errors) - _SHOWN} more errors")
    report.stats["composition_errors"] = len(errors)
    return stage


def time_code(stage: Usd.Stage, time: float | None) -> Usd.TimeCode:
    """The moment to load: as given, else the stage's start, as usdrecord does."""
    if time is not None:
        return Usd.TimeCode(time)
    try:
        return Usd.TimeCode(stage.GetStartTimeCode())
    except (Tf.ErrorException, TypeError):  # metadata of another type
        return Usd.TimeCode(0.0)


def up_axis(stage: Usd.Stage, report: Report) -> str:
    """Up axis, Y or Z; anything else in the file is reported and read as Y."""
    axis = stage.GetRootLayer().pseudoRoot.GetInfo(UsdGeom.Tokens.upAxis) or UsdGeom.Tokens.y
    if axis not in (UsdGeom.Tokens.y, UsdGeom.Tokens.z):
        report.warn("/", f"upAxis is '{axis}', neither Y nor Z; Y is used")
        return "Y"
    return str(axis)


def first_message(error: Exception) -> str:
    """The first message of an exception of USD, in one line and without its source location."""
    try:
        text = str(error)
    except UnicodeDecodeError:  # it quotes the file, which is no text
        return "the file is damaged, or no USD file"
    messages = re.findall(r": '(.*?)'\s*(?=\n\s*Error in|$)", text, flags=re.DOTALL)
    return _tidy(messages[0] if messages else text)


def _tidy(message: str) -> str:
    words = " ".join(message.split())
    return words if len(words) <= 300 else words[:299] + "…"
