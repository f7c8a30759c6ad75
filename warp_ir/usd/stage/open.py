"""Opens a stage: errors become one line, and USD's diagnostics are collected."""

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from pxr import Sdf, Tf, Usd, UsdGeom, UsdUtils

from warp_ir.files import check_input
from warp_ir.scene import InputError
from warp_ir.usd.stage.crate_validation import validate_crate
from warp_ir.usd.stage.layers_check import check_layers
from warp_ir.usd.stage.mtlx_layers import layers_with_mtlx
from warp_ir.usd.values.report import Report

_MAX_LISTED = 5
"""Maximum number of composition errors that are listed; the rest is counted."""


@contextmanager
def quiet_diagnostics() -> Iterator[None]:
    """Keep USD's diagnostics off stderr; the readers report those that matter."""
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
        path: The root layer.
        report: Receives composition errors.
        mask: Paths of prims; if not empty, the stage contains only them, their ancestors, descendants and relations.
        needed: Paths of further prims that a masked stage contains, if they exist.
        variants: Selections `/prim{set=selection}`, stronger than those of the file.
        session_layer: A layer with opinions stronger than the file's.

    Raises:
        InputError: A file is missing, is a directory, or is not readable as USD; a path, variant set or selection
            does not exist.
    """
    for text in mask:
        path_of_mask = Sdf.Path(text) if Sdf.Path.IsValidPathString(text) else Sdf.Path()
        # IsAbsoluteRootOrPrimPath is true for relative prim paths as well.
        if not (path_of_mask.IsAbsolutePath() and path_of_mask.IsAbsoluteRootOrPrimPath()):
            raise InputError(f"mask: {text!r} is not the absolute path of a prim")
    root = _open_layer(path, follow=not mask)
    # An own session layer: variant selections must not change layers that another stage shares.
    session = Sdf.Layer.CreateAnonymous("session")
    if session_layer is not None:
        stronger = _open_layer(session_layer)
        session.subLayerPaths.append(stronger.identifier)
    wanted = [text for text in needed if Sdf.Path.IsValidPathString(text) and Sdf.Path(text).IsPrimPath()]
    paths = [*mask, *wanted] if mask else []
    try:
        stage = _compose(root, session, paths)
        for text in mask:
            if not stage.GetPrimAtPath(text):
                raise InputError(f"mask: there is no prim {text}")
        for text in variants:
            _select_variant(stage, text)
        layers = layers_with_mtlx(stage, report)
        if layers:
            stage = _compose(layers[0], session, paths)
    except (Tf.ErrorException, RuntimeError) as error:
        raise _open_error(path, error) from None
    _report_composition_errors(stage, report)
    return stage


def layer_files(stage: Usd.Stage, *further: str) -> tuple[str, ...]:
    """The files of a stage's layers, and further ones, as absolute paths in order; a package is one file."""
    paths = [*further, *(layer.realPath for layer in stage.GetUsedLayers() if layer)]
    return tuple(sorted({os.path.realpath(path.partition("[")[0]) for path in paths if path}))


def reload_layers(paths: Sequence[str]) -> None:
    """Reads files again whose layers are open: USD keeps the content of a layer as long as a stage uses it.

    Raises:
        InputError: A file is missing or is not readable as USD; its layer keeps the content that it had.
    """
    with quiet_diagnostics():
        for layer in Sdf.Layer.GetLoadedLayers():
            path = os.path.realpath(layer.realPath.partition("[")[0]) if layer.realPath else ""
            if path not in paths:
                continue
            check_input(path, "a USD file")
            try:
                validate_crate(path)
                if not layer.Reload():
                    raise InputError(f"{path}: cannot be opened as USD: it contains no layer")
            except (Tf.ErrorException, RuntimeError, OSError) as error:
                raise _open_error(path, error) from None


def _report_composition_errors(stage: Usd.Stage, report: Report) -> None:
    """Warns once for each missing file and each other error, with the prims that it affects."""
    # USD composes on all cores, so the order of errors is arbitrary.
    by_text = {" ".join(str(error).split()): error for error in stage.GetCompositionErrors()}
    errors = {text: by_text[text] for text in sorted(by_text)}
    causes: dict[str, list[str]] = {}
    for text, error in errors.items():
        causes.setdefault(_one_line(_cause(text, stage.GetRootLayer())), []).append(_path_of(error))
    for text, paths in list(causes.items())[:_MAX_LISTED]:
        for path in paths:
            report.warn(path, f"composition: {text}")
    if len(causes) > _MAX_LISTED:
        report.warn("/", f"composition: {len(causes) - _MAX_LISTED} more errors")
    report.stats["composition_errors"] = len(errors)


def _cause(text: str, root: Sdf.Layer) -> str:
    """The cause of an error: its text without the prim, and without the introducing layer if that is the root."""
    introduced = re.search(r" introduced by @([^@]*)@<[^>]*>", text)
    if introduced is None:
        return text
    rest = text[: introduced.start()] + text[introduced.end() :].removesuffix(".")
    return rest if introduced[1] in (root.identifier, root.realPath) else f"{rest}, which @{introduced[1]}@ asks for"


def _path_of(error: object) -> str:
    """Path of the prim that an error affects."""
    try:
        path = str(error.rootSite.path)  # type: ignore[attr-defined]  # untyped binding; AttributeError is caught
    except AttributeError:
        return "/"
    return path or "/"


def _compose(root: Sdf.Layer, session: Sdf.Layer, mask: Sequence[str]) -> Usd.Stage:
    """Composes a stage, with a population mask if one is given."""
    if not mask:
        return Usd.Stage.Open(root, session)
    stage = Usd.Stage.OpenMasked(root, session, Usd.StagePopulationMask(list(mask)))
    stage.ExpandPopulationMask()
    return stage


def _open_layer(path: str, *, follow: bool = True) -> Sdf.Layer:
    """Opens a layer, after a look at it and, with `follow`, at all that it refers to.

    Raises:
        InputError: There is no such file, or it or one of the others is not readable as USD.
    """
    check_input(path, "a USD file")
    try:
        validate_crate(path)
        check_layers(path, follow=follow)
        layer = Sdf.Layer.FindOrOpen(path)
    except (Tf.ErrorException, RuntimeError, OSError) as error:
        raise _open_error(path, error) from None
    if layer is None:
        raise InputError(f"{path}: cannot be opened as USD: it contains no layer")
    return layer


def _open_error(path: str, error: Exception) -> InputError:
    """The error for a file that USD refuses, in one line."""
    return InputError(f"{path}: cannot be opened as USD: {first_message(error).removeprefix(f'{path}:')}")


def _select_variant(stage: Usd.Stage, text: str) -> None:
    """Makes the selections `/prim{set=selection}...` in the session layer."""
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
        names = sets.GetVariantSet(group).GetVariantNames()
        if selection and selection not in names:
            raise InputError(f"variant: {match[1]}{{{group}}} has no {selection!r}; it has {', '.join(names)}")
        try:
            with Usd.EditContext(stage, stage.GetSessionLayer()):
                chosen = sets.GetVariantSet(group)
                _ = chosen.SetVariantSelection(selection) if selection else chosen.BlockVariantSelection()
        except Tf.ErrorException:
            raise InputError(f"variant: {match[1]} is part of an instance; select on the instance itself") from None


def time_code(stage: Usd.Stage, time: float | str | None) -> Usd.TimeCode:
    """The time to load: as given, else the stage's start, as in usdrecord; "default" is the default time."""
    if time == "default":
        return Usd.TimeCode.Default()
    if time is not None:
        return Usd.TimeCode(float(time))
    try:
        return Usd.TimeCode(stage.GetStartTimeCode())
    except (Tf.ErrorException, TypeError):  # metadata of another type
        return Usd.TimeCode(0.0)


def up_axis(stage: Usd.Stage, report: Report) -> str:
    """Up axis, Y or Z; any other value is reported and read as Y."""
    axis = stage.GetRootLayer().pseudoRoot.GetInfo(UsdGeom.Tokens.upAxis) or UsdGeom.Tokens.y
    if axis not in (UsdGeom.Tokens.y, UsdGeom.Tokens.z):
        report.warn("/", f"upAxis is '{axis}', neither Y nor Z; Y is used")
        return "Y"
    return str(axis)


def first_message(error: Exception) -> str:
    """The first message of a USD exception, in one line and without its source location."""
    try:
        text = str(error)
    except UnicodeDecodeError:  # the message quotes binary content of the file
        return "the file is damaged or not a USD file"
    messages = re.findall(r": '(.*?)'\s*(?=\n\s*Error in|$)", text, flags=re.DOTALL)
    return _one_line(messages[0] if messages else text)


def _one_line(message: str) -> str:
    """A message in one line of at most 300 characters."""
    # Identifiers of anonymous layers contain an address, which differs between runs.
    words = re.sub(r"anon:0x[0-9a-fA-F]+:", "", " ".join(message.split()))
    return words if len(words) <= 300 else words[:299] + "…"
