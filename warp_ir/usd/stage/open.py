"""Opening a stage: errors in one line, USD's own diagnostics collected instead of spilled."""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from pxr import Sdf, Tf, Usd, UsdGeom, UsdUtils

from warp_ir.scene import InputError
from warp_ir.usd.stage.crate_validation import check_sizes
from warp_ir.usd.stage.mtlx_layers import with_documents
from warp_ir.usd.values.report import Report

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


def open_stage(
    path: str,
    report: Report,
    *,
    mask: Sequence[str] = (),
    needed: Sequence[str] = (),
    variants: Sequence[str] = (),
    session_layer: str | None = None,
) -> Usd.Stage:
    """Open a stage with all its payloads.

    Args:
        path: Of the root layer.
        report: Where composition errors go.
        mask: Paths of prims; if there are any, the stage holds only them, what is above, below and related to them.
        needed: Paths of prims that it holds beside those of a mask, if there are such.
        variants: Selections `/prim{set=selection}`, stronger than those of the file.
        session_layer: A layer that is stronger than the file.

    Raises:
        InputError: A file is missing, is a directory, or is not readable as USD; a path, variant set or selection
            does not exist.
    """
    for text in mask:
        path_of_mask = Sdf.Path(text) if Sdf.Path.IsValidPathString(text) else Sdf.Path()
        # A relative path of a prim is an IsAbsoluteRootOrPrimPath as well.
        if not (path_of_mask.IsAbsolutePath() and path_of_mask.IsAbsoluteRootOrPrimPath()):
            raise InputError(f"mask: {text!r} is not the absolute path of a prim")
    root = _layer(path)
    # One of our own, so that selecting variants changes nothing that another stage shares.
    session = Sdf.Layer.CreateAnonymous("session")
    if session_layer is not None:
        stronger = _layer(session_layer)
        session.subLayerPaths.append(stronger.identifier)
    wanted = [text for text in needed if Sdf.Path.IsValidPathString(text) and Sdf.Path(text).IsPrimPath()]
    paths = [*mask, *wanted] if mask else []
    try:
        stage = _composed(root, session, paths)
        for text in mask:
            if not stage.GetPrimAtPath(text):
                raise InputError(f"mask: there is no prim {text}")
        for text in variants:
            _select_variant(stage, text)
        instead = with_documents(stage, report)
        if instead:
            stage = _composed(instead[0], session, paths)
    except (Tf.ErrorException, RuntimeError) as error:
        raise _unopened(path, error) from None
    _name_composition_errors(stage, report)
    return stage


def _name_composition_errors(stage: Usd.Stage, report: Report) -> None:
    """One line for each file that is missing and each other error, with the prims that lack something for it."""
    # USD composes on all cores: the order is any.
    found = {" ".join(str(error).split()): error for error in stage.GetCompositionErrors()}
    errors = {text: found[text] for text in sorted(found)}
    causes: dict[str, list[str]] = {}
    for text, error in errors.items():
        causes.setdefault(_tidy(_cause(text, stage.GetRootLayer())), []).append(_path_of(error))
    for text, paths in list(causes.items())[:_SHOWN]:
        for path in paths:
            report.warn(path, f"composition: {text}")
    if len(causes) > _SHOWN:
        report.warn("/", f"composition: {len(causes) - _SHOWN} more errors")
    report.stats["composition_errors"] = len(errors)


def _cause(text: str, root: Sdf.Layer) -> str:
    """What is wrong, without the prim, and without the layer that says so if it is the root."""
    found = re.search(r" introduced by @([^@]*)@<[^>]*>", text)
    if found is None:
        return text
    rest = text[: found.start()] + text[found.end() :].removesuffix(".")
    return rest if found[1] in (root.identifier, root.realPath) else f"{rest}, which @{found[1]}@ asks for"


def _path_of(error: object) -> str:
    """The prim of the stage where something is missing."""
    try:
        path = str(error.rootSite.path)  # type: ignore[attr-defined]
    except AttributeError:
        return "/"
    return path or "/"


def _composed(root: Sdf.Layer, session: Sdf.Layer, mask: Sequence[str]) -> Usd.Stage:
    if not mask:
        return Usd.Stage.Open(root, session)
    stage = Usd.Stage.OpenMasked(root, session, Usd.StagePopulationMask(list(mask)))
    stage.ExpandPopulationMask()
    return stage


def _layer(path: str) -> Sdf.Layer:
    """A layer.

    Raises:
        InputError: There is no such file, or it is not readable as USD.
    """
    if not Path(path).exists():
        raise InputError(f"{path}: no such file")
    if Path(path).is_dir():
        raise InputError(f"{path}: is a directory, not a USD file")
    try:
        check_sizes(path)
        layer = Sdf.Layer.FindOrOpen(path)
    except (Tf.ErrorException, RuntimeError, OSError) as error:
        raise _unopened(path, error) from None
    if layer is None:
        raise InputError(f"{path}: cannot be opened as USD: there is no layer in it")
    return layer


def _unopened(path: str, error: Exception) -> InputError:
    return InputError(f"{path}: cannot be opened as USD: {first_message(error).removeprefix(f'{path}:')}")


def _select_variant(stage: Usd.Stage, text: str) -> None:
    """Makes the selection `/prim{set=selection}`, one or several, in the session layer."""
    match = re.fullmatch(r"(/[^{}]*)((?:\{[^{}=]+=[^{}=]*\})+)", text.strip())
    if match is None:
        raise InputError(f"variant: {text!r} is not of the form /prim{{set=selection}}")
    prim = stage.GetPrimAtPath(match[1]) if Sdf.Path.IsValidPathString(match[1]) else None
    if not prim:
        raise InputError(f"variant: there is no prim {match[1]}")
    for group, selection in re.findall(r"\{([^{}=]+)=([^{}=]*)\}", match[2]):
        sets = prim.GetVariantSets()
        if not sets.HasVariantSet(group):
            raise InputError(f"variant: {match[1]} has no set {group!r}; it has {', '.join(sets.GetNames()) or 'none'}")
        there = sets.GetVariantSet(group).GetVariantNames()
        if selection and selection not in there:
            raise InputError(f"variant: {match[1]}{{{group}}} has no {selection!r}; it has {', '.join(there)}")
        try:
            with Usd.EditContext(stage, stage.GetSessionLayer()):
                chosen = sets.GetVariantSet(group)
                _ = chosen.SetVariantSelection(selection) if selection else chosen.BlockVariantSelection()
        except Tf.ErrorException:
            raise InputError(f"variant: {match[1]} is part of an instance; select on the instance itself") from None


def time_code(stage: Usd.Stage, time: float | str | None) -> Usd.TimeCode:
    """The moment to load: as given, else the stage's start, as usdrecord does; "default" is the default time."""
    if time == "default":
        return Usd.TimeCode.Default()
    if time is not None:
        return Usd.TimeCode(float(time))
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
    # Layers in memory are called by where they lie there, and by their name.
    words = re.sub(r"anon:0x[0-9a-fA-F]+:", "", " ".join(message.split()))
    return words if len(words) <= 300 else words[:299] + "…"
