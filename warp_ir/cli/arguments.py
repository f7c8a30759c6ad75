"""The command line: its flags, named as in `usdrecord` where that has them, and the texts of `--help`.

The flags for `RenderSettings` are generated from its fields: a new field is a new flag.
"""

import argparse
import dataclasses
import math
import os
import re
import types
import typing
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any, NoReturn

from warp_ir import __version__
from warp_ir.cli.engine_flags import DESTINATIONS, add_engine
from warp_ir.cli.toml_file import read_toml
from warp_ir.image.cryptomatte import KINDS
from warp_ir.image.exr import COMPRESSIONS
from warp_ir.image.io import AOV_CHANNELS
from warp_ir.image.ocio import use_config
from warp_ir.image.tonemap import TONEMAPS
from warp_ir.scene import InputError
from warp_ir.settings import RenderSettings

_FIELDS = {field.name: field for field in dataclasses.fields(RenderSettings)}
_PICTURE_ONLY = {
    *("iterations", "time_limit", "target_error", "visible_lights", "bound_radius"),
    *("pixel_aspect", "conform", "data_window", "depth_of_field", "motion_blur", "color_space", "filter", "denoise"),
}
"""Settings that affect the picture but not the light paths: `warp-ir vpls` has no flags for them."""
_NOT_IN_VIEW = {"time_limit", "data_window", "pixel_aspect", "motion_blur", "color_space", "denoise"}
"""Settings that a live view does not have."""
VPL_DRAWING = ("view", "color_by", "bounces", "min_contribution", "paths", "order")
"""Flags of `warp-ir vpls` that only a drawing has; None if they are not given."""
_SHORT = {"width": ("-w",)}
_OUTPUT = (
    "picture to write; ### is replaced by the frame number. Or a folder: every picture that the stage's RenderProducts"
    " name is written there"
)
_MAX_CHOICES_LENGTH = 40
"""Characters. Longer lists of choices are part of the help text; shorter ones replace the name of the value."""
LISTS = ("cameras", "lights", "materials", "settings")
"""What `warp-ir info --list` can list."""
METHODS: Mapping[str, Mapping[str, str | bool]] = {
    "vpl": {},
    "vpl without filter": {"filter": False},
    "vpl denoised": {"denoise": True},
    "keller": {"estimator": "keller"},
    "path": {"estimator": "path"},
}
"""Methods of `warp-ir compare`: their names, and the settings that differ from the defaults."""
_SET_BY_COMPARE = ("iterations", "time_limit", "target_error", "estimator", "filter", "denoise")
"""Settings that `warp-ir compare` chooses itself: it has no flags for them."""
_TOGETHER: tuple[frozenset[str], ...] = (
    frozenset({"iterations", "time_limit", "target_error"}),
    frozenset({"width", "height", "res"}),
    frozenset({"frames", "time", "default_time"}),
    frozenset({"camera", "eye", "look_at"}),
)
"""Destinations of flags: one of them on the command line replaces all of a group in a settings file."""
_NOT_IN_FILES = frozenset({"help", "settings"})
_NOT_OF_PICTURE = DESTINATIONS | {
    *("part", "preview", "make_output_path", "resume", "checkpoint", "stats", "device", "threads")
}
"""Destinations of flags of `warp-ir render` that its picture does not depend on."""
_REPEATED = frozenset({"variants"})
"""Destinations of flags that may be repeated."""
_FILES = ("stage", "films", "output", "ocio_config", "session_layer", "stats", "settings", "log_file")
"""Destinations of arguments that are names of files."""
_PURPOSES = ("default", "render", "proxy", "guide")

_RENDER_NOTES = """\
The extension of OUTPUT chooses the format. .exr (colour, alpha, AOV layers,
metadata), .hdr, .pfm and .npy hold linear radiance; .png, .jpg and .tif are
tone-mapped. Ctrl-C stops the render and writes the picture so far.

examples:
  # 64 iterations, 512 pixels wide
  warp-ir render room.usda room.png
  # until the estimated error is 1 %; also write depth and normals
  warp-ir render room.usda room.exr --target-error 0.01 --aov depth normal
  # another camera, 30 seconds, 1.5 stops (2.8 times) brighter
  warp-ir render room.usda room.png --camera Door --time-limit 30 --exposure 1.5
  # an animation; after a crash, run the same command with --resume
  warp-ir render shot.usd shots/####.png --frames 1001:1024 --make-output-path
  # all pictures that the stage's RenderProducts ask for
  warp-ir render shot.usd renders/ --make-output-path
  # select a variant, and change the stage by a session layer
  warp-ir render car.usd car.png --variant '/Car{paint=red}' \\
      --session-layer no_lamp.usda
  # the same picture by path tracing, as a check
  warp-ir render room.usda path.png --estimator path --iterations 256
"""
_MERGE_NOTES = """\
The films are all the parts of one picture, in any order. The stage is loaded
again, and has to be as it was. Flags that are not given here are those that the
parts were rendered with.

examples:
  # four machines, or one after the other
  warp-ir render room.usda 1.exr --part 1/4 --iterations 256
  warp-ir render room.usda 2.exr --part 2/4 --iterations 256
  warp-ir render room.usda 3.exr --part 3/4 --iterations 256
  warp-ir render room.usda 4.exr --part 4/4 --iterations 256
  # the picture, but for rounding that of 256 iterations in one go
  warp-ir merge 1.exr.film.npz 2.exr.film.npz 3.exr.film.npz 4.exr.film.npz \\
      room.exr
"""
_VPLS_NOTES = """\
examples:
  # a picture of the virtual point lights in the room
  warp-ir vpls room.usda cloud.png
  # points to view in usdview
  warp-ir vpls room.usda cloud.usda --light-paths 256
  # NumPy arrays: positions, normals, intensity, bounce, path, parent, ...
  warp-ir vpls room.usda cloud.npz --iteration 3
  # a page for a browser: which VPLs light the pixel in column 100, row 80
  warp-ir vpls room.usda pixel.html --contribution-to 100,80 --paths \\
      --color-by contribution
  # lights with which any renderer can light the scene
  warp-ir vpls room.usda lights.usda --as-lights
"""
_VIEW_NOTES = """\
Dragging orbits, or looks around inside of a room; the wheel moves closer, the
keys w a s d walk, and F1 lists the others. The picture is coarse while it moves
and refines while it rests. Files of the stage that change are read again.

examples:
  # look around in a room
  warp-ir view room.usda
  # a larger window, direct light only
  warp-ir view room.usda --res 1280 720 --max-bounces 0
  # in a browser on this machine; HOST:PORT also lets others in, by a token
  warp-ir view room.usda --web 8080
  # render what F3 has saved of camera, lights and colours
  warp-ir render room.usda room.png --session-layer view_edits.usda
"""
_COMPARE_NOTES = """\
relMSE is the mean of (x - r)^2 / (r^2 + 0.01 m^2), where x is the picture, r
the reference and m the mean of r: it does not depend on the brightness of the
scene. Ctrl-C stops and reports what has been measured.

examples:
  # print a table and a recommendation
  warp-ir compare room.usda
  # also plot it, for a small picture and longer renders
  warp-ir compare room.usda error.png --width 256 --times 2,8,32
  # only two methods, three seeds, a better reference
  warp-ir compare room.usda --methods 'vpl, path' --seeds 3 \\
      --reference-time 600
"""


class _Parser(argparse.ArgumentParser):
    """Raises errors as `InputError`: one line that names the help option."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # argparse takes -1 for a number, but -1e-7, -2:0 and -inf for flags; no flag begins so.
        self._negative_number_matcher = re.compile(r"-(\.?\d|inf|nan)", re.IGNORECASE)

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see {self.prog} --help)")


class _PrintCompletion(argparse.Action):
    """Prints a shell's script for completion. shtab writes it from the parser: later starts cost nothing."""

    def __call__(self, parser: argparse.ArgumentParser, _: object, shell: Any, __: str | None = None) -> None:
        try:
            import shtab
        except ImportError as error:
            raise InputError("--print-completion: needs shtab: pip install shtab") from error
        if shell not in shtab.SUPPORTED_SHELLS:
            raise InputError(f"--print-completion: must be one of {', '.join(shtab.SUPPORTED_SHELLS)}, is {shell!r}")
        whole, commands = _parsers()
        for action in (action for command in commands.values() for action in command._actions):
            if action.dest in _FILES:
                action.complete = shtab.FILE  # type: ignore[attr-defined]  # which shtab looks for
        print(shtab.complete(whole, shell))
        parser.exit()


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """Parses the arguments; `command` names the module of this package that executes the command.

    Flags that a settings file gives count as if they stood on the command line, where that does not give them itself.

    Raises:
        InputError: The arguments or the settings file are wrong.
    """
    for word in argv:
        try:
            word.encode("utf-8")
        except UnicodeEncodeError:
            raise InputError(f"{os.fsencode(word)!r}: is not UTF-8, as names of files and prims must be") from None
    parser, commands = _parsers()
    words = _join_aov_names(argv)
    args, unknown = parser.parse_known_args(words)
    if unknown:  # argparse itself would name the help of all commands
        raise InputError(f"unrecognized arguments: {' '.join(unknown)} (see warp-ir {args.command} --help)")
    if not getattr(args, "settings", None):
        return args
    start = words.index(args.command) + 1
    from_file = _words_of_file(args.settings, commands[args.command], words[start:])
    return parser.parse_args([*words[:start], *from_file, *words[start:]])


def _words_of_file(path: str, parser: argparse.ArgumentParser, given: Sequence[str]) -> list[str]:
    """The words of a command line that stand for a settings file.

    Args:
        path: A TOML file whose keys are names of long flags, without the dashes.
        parser: That of the command.
        given: Words of the command line: what they give is left out.

    Raises:
        InputError: The file cannot be read, or a key or a value is wrong.
    """
    values = read_toml(path)
    flags = {word: action for action in parser._actions for word in action.option_strings}
    replaced = {flags[word].dest for word in _flags_in(given, flags)}
    replaced |= {dest for together in _TOGETHER if replaced & together for dest in together}
    words, kept = [], []
    for key, value in values.items():
        action = flags.get(f"--{key}")
        if action is None or action.help == argparse.SUPPRESS or action.dest in _NOT_IN_FILES:
            known = [w[2:] for w, a in flags.items() if w.startswith("--") and a.help != argparse.SUPPRESS]
            import difflib

            near = difflib.get_close_matches(key, sorted(set(known) - _NOT_IN_FILES), 1)
            hint = f"; did you mean {near[0]!r}?" if near else f" (see {parser.prog} --help)"
            raise InputError(f"{path}: {key!r} is no flag of {parser.prog}{hint}")
        try:
            found = _words_of_value(key, value, action, flags)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        words += found
        kept += found if action.dest not in replaced else []
    positional = ["-" for action in parser._actions if not action.option_strings]
    try:  # here, so that the message names the file
        parsed = parser.parse_args([*positional, *words])
        with use_config(parsed.ocio_config):
            settings_of(parsed)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return kept


def _flags_in(words: Sequence[str], flags: Collection[str]) -> Iterator[str]:
    """The flags among words, also from --flag=value and -fvalue."""
    for word in words:
        for flag in (word, word.partition("=")[0], word[:2]):
            if flag in flags:
                yield flag
                break


def _words_of_value(key: str, value: object, action: argparse.Action, flags: Collection[str]) -> list[str]:
    """The words that give the value of a settings file to a flag; raises `InputError` if it can have no such value."""
    if action.nargs == 0:
        if not isinstance(value, bool):
            raise InputError(f"{key}: must be true or false, is {value!r}")
        word = f"--{key}" if value else f"--no-{key}"
        return [word] if word in flags else []
    values = value if isinstance(value, list) else [value]
    if any(isinstance(item, bool) or not isinstance(item, str | int | float) for item in values):
        raise InputError(f"{key}: must be a number, a text or a list of these, is {value!r}")
    texts = [str(item) for item in values]
    if action.nargs is not None:
        return [f"--{key}", *texts]
    # Flags that collect values take one each, others a list with commas.
    return [f"--{key}={text}" for text in (texts if action.dest in _REPEATED else [",".join(texts)])]


def preset_of(args: argparse.Namespace) -> dict[str, Any]:
    """The flags of `warp-ir render` that its picture depends on, where they are not the defaults: name -> value.

    They are those of a settings file, by which the same picture can be made again.
    """
    preset: dict[str, Any] = {}
    for flag, action in _picture_flags().items():
        value = getattr(args, action.dest, action.default)
        if value != action.default and value != argparse.SUPPRESS:
            value = list(value) if isinstance(value, list | tuple) else value
            preset[flag] = value == action.const if isinstance(action, argparse._StoreConstAction) else value
    return preset


def words_of_preset(preset: Mapping[str, Any]) -> list[str]:
    """The words of a command line of `warp-ir render` that stand for what `preset_of` has returned.

    Raises:
        InputError: A key is no such flag, or a value is wrong.
    """
    flags, words = _picture_flags(), []
    known = [word for action in flags.values() for word in action.option_strings]
    for key, value in preset.items():
        if key not in flags:
            raise InputError(f"{key!r} is no flag that a picture depends on")
        words += _words_of_value(key, value, flags[key], known)
    return words


def _picture_flags() -> dict[str, argparse.Action]:
    """The flags of `warp-ir render` that its picture depends on, without dashes."""
    _, commands = _parsers()
    flags: dict[str, argparse.Action] = {}
    for group in commands["render"]._action_groups:
        if group.title in ("picture", "stage", "output"):
            for action in group._group_actions:
                names = [word[2:] for word in action.option_strings if word.startswith("--")]
                if names and action.help != argparse.SUPPRESS and action.dest not in _NOT_OF_PICTURE:
                    flags[names[0]] = action
    return flags


def _parsers() -> tuple[argparse.ArgumentParser, Mapping[str, argparse.ArgumentParser]]:
    """The parser of the command line, and those of the commands by name."""
    parser = _Parser(
        prog="warp-ir",
        description="Instant radiosity for USD scenes: diffuse global illumination on CPU and GPU.",
        epilog="Try: warp-ir render STAGE picture.png; 'warp-ir COMMAND --help' explains a command.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"warp-ir {__version__}")
    completion = "print a script by which the shell completes commands and flags"
    parser.add_argument("--print-completion", action=_PrintCompletion, metavar="SHELL", help=completion)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, summary, notes, fill in (
        ("render", "render a stage to a picture", _RENDER_NOTES, _add_render),
        ("merge", "make one picture of films that render --part has written", _MERGE_NOTES, _add_merge),
        ("view", "show a stage in a window in which one moves around, and edit its lights", _VIEW_NOTES, _add_view),
        ("info", "show what a stage contains, what will be skipped, and why", "", _add_info),
        ("vpls", "write the virtual point lights as a picture, page, model, USD or arrays", _VPLS_NOTES, _add_vpls),
        ("compare", "measure error against time of each method and recommend one", _COMPARE_NOTES, _add_compare),
    ):
        command = commands.add_parser(
            name,
            help=summary,
            description=f"{summary[0].upper()}{summary[1:]}.",
            epilog=notes,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        if name != "merge":
            command.add_argument("stage", metavar="STAGE", help="USD file (.usd .usda .usdc .usdz)")
        fill(command)
        messages = command.add_argument_group("messages")
        messages.add_argument("--quiet", "-q", action="store_true", help="print nothing but errors")
        more = "print all warnings, and tracebacks of errors"
        messages.add_argument("--verbose", "-v", action="store_true", help=more)
        log = "file to which all messages are appended, with their times, even with --quiet"
        messages.add_argument("--log-file", metavar="FILE", help=log)
        if name != "info":
            preset = "TOML file of flags, such as light-paths = 512; those of the command line win"
            command.add_argument("--settings", metavar="FILE.toml", help=preset)
    return parser, commands.choices


def _join_aov_names(argv: Sequence[str]) -> list[str]:
    """Joins the names after --aov: ``--aov depth normal room.usda`` becomes ``--aov depth,normal room.usda``.

    argparse would otherwise take the positional arguments that follow for further names.
    """
    joined: list[str] = []
    for word in argv:
        after_aov_name = len(joined) > 1 and joined[-2] == "--aov"
        if after_aov_name and word in AOV_CHANNELS:
            joined[-1] += "," + word
        else:
            joined.append(word)
    return joined


def given_settings(args: argparse.Namespace) -> dict[str, Any]:
    """The fields of `RenderSettings` that are given on the command line."""
    given: dict[str, Any] = {name: value for name, value in vars(args).items() if name in _FIELDS}
    given = {name: tuple(value) if isinstance(value, list) else value for name, value in given.items()}
    if getattr(args, "res", None):
        given["width"], given["height"] = args.res
    return given


def settings_of(args: argparse.Namespace, stage: Mapping[str, Any] | None = None) -> RenderSettings:
    """The render settings: each as given on the command line, else as the stage asks, else its default.

    Args:
        args: The parsed command line.
        stage: Fields of `RenderSettings` that the stage asks for.

    Raises:
        InputError: A value is out of range; the message names the flag.
    """
    given, from_stage = given_settings(args), dict(stage or {})
    if ("width" in given) != ("height" in given) and "width" in from_stage:
        # Only one side is given: the other follows from the aspect of the stage's resolution.
        side, other = ("width", "height") if "width" in given else ("height", "width")
        if isinstance(given[side], int) and given[side] > 0:
            from_stage[other] = max(1, round(given[side] * from_stage[other] / from_stage[side]))
    limits = {"iterations", "time_limit", "target_error"}
    if limits & set(given):  # a limit on the command line replaces all limits of the stage
        from_stage = {name: value for name, value in from_stage.items() if name not in limits}
    try:
        return RenderSettings(**{**from_stage, **given})
    except InputError as error:
        name, colon, rest = str(error).partition(":")
        raise InputError(f"{_flag(name)}{colon}{rest}" if name in _FIELDS else str(error)) from error


def _add_render(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("output", metavar="OUTPUT", help=_OUTPUT)
    picture = _add_picture(parser, _FIELDS)
    # The names of usdrecord are accepted, but not listed in the help.
    hidden = argparse.SUPPRESS
    suppressed: dict[str, Any] = {"default": hidden, "help": hidden}
    picture.add_argument("--imageWidth", dest="width", type=int, default=hidden, help=hidden)
    picture.add_argument("--enableDomeLightVisibility", dest="visible_lights", action="store_true", **suppressed)
    picture.add_argument("--disableCameraLight", dest="default_light", action="store_const", const="none", **suppressed)
    picture.add_argument("--disableGpu", dest="device", action="store_const", const="cpu", **suppressed)
    _add_stage(parser)
    output = parser.add_argument_group("output")
    _add_looks(output)
    part = "render part K of N of the iterations, and write its film alone, OUTPUT.film.npz, for warp-ir merge"
    output.add_argument("--part", type=_part, metavar="K/N", help=part)
    preview = "show the picture while it is rendered, in a window, or in a terminal that can"
    output.add_argument("--preview", action="store_true", help=preview)
    output.add_argument("--make-output-path", action="store_true", help="create the folder of OUTPUT")
    resume = "skip pictures that are there, and continue the one that an earlier command did not finish"
    output.add_argument("--resume", action="store_true", help=resume)
    checkpoint = "interval between writes of OUTPUT.film.npz, from which --resume continues (default: 60; 0: never)"
    output.add_argument("--checkpoint", type=_seconds, default=60.0, metavar="SECONDS", help=checkpoint)
    output.add_argument("--stats", metavar="FILE.json", help="write timings, counts, memory use and versions")
    several = "; several GPUs with commas share the iterations out"
    _add_device(output, several)
    _add_threads(output)
    add_engine(parser, _count)


def _add_looks(output: argparse._ArgumentGroup) -> None:
    """Flags for how a picture that has been rendered is written."""
    output.add_argument(
        "--aov",
        dest="aovs",
        action="extend",
        type=_names(AOV_CHANNELS),
        default=[],
        metavar="NAME ...",
        help=f"also write {', '.join(AOV_CHANNELS)}: as layers of an EXR file, otherwise as files next to it",
    )
    stops = (
        "brightness of .png, .jpg and .tif: each stop doubles the radiance (default: 0); auto: the first picture's "
        "log-average luminance becomes middle grey, and all frames are as bright"
    )
    output.add_argument("--exposure", type=_stops_or_auto, default=0.0, metavar="STOPS|auto", help=stops)
    output.add_argument(
        "--tonemap",
        choices=TONEMAPS,
        help="tone curve of these files: srgb clips highlights, filmic compresses them smoothly (default: srgb)",
    )
    display = (
        "OpenColorIO display for which these files are made, in place of the tone curve (default: --tonemap, sRGB)"
    )
    output.add_argument("--ocio-display", metavar="NAME", help=display)
    view = "OpenColorIO view of that display (default: the display's first)"
    output.add_argument("--ocio-view", metavar="NAME", help=view)
    output.add_argument(
        "--float", dest="half", action="store_false", help="store .exr with 32 bits per channel instead of 16"
    )
    output.add_argument(
        "--exr-compression",
        choices=COMPRESSIONS,
        default=COMPRESSIONS[0],
        metavar="NAME",
        help=f"of .exr: {', '.join(COMPRESSIONS)}; dwaa and dwab lose digits of colours (default: {COMPRESSIONS[0]})",
    )
    parts = "store the layers of .exr as one part, or as a part for each (default: one)"
    output.add_argument("--exr-parts", choices=("one", "many"), default="one", help=parts)
    mattes = f"Cryptomattes in .exr, by {' or '.join(KINDS)}: coverage counted by 64 more camera rays per pixel"
    output.add_argument("--cryptomatte", type=_names(KINDS), default=[], metavar="NAME[,NAME]", help=mattes)
    output.add_argument("--owner", metavar="TEXT", help="whose picture it is, written to .exr")


def _add_merge(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("films", nargs="+", metavar="FILM", help="film of a part, OUTPUT.film.npz")
    parser.add_argument("output", metavar="OUTPUT", help="picture to write")
    parser.add_argument("--stage", metavar="FILE", help="where the stage is (default: where it was when rendered)")
    output = parser.add_argument_group("output")
    _add_looks(output)
    output.add_argument("--make-output-path", action="store_true", help="create the folder of OUTPUT")
    output.add_argument("--stats", metavar="FILE.json", help="write timings, counts, memory use and versions")
    _add_device(output)
    _add_threads(output)
    config = "OpenColorIO configuration: a file, or ocio://default (default: as rendered, or $OCIO)"
    output.add_argument("--ocio-config", metavar="FILE", help=config)
    for action in parser._actions:  # what is not given is as the films say
        if action.option_strings and action.dest not in ("stage", "ocio_config"):
            action.default = argparse.SUPPRESS
    parser.set_defaults(quiet=False, verbose=False, log_file=None, ocio_config=None)


def _add_picture(parser: argparse.ArgumentParser, names: Collection[str]) -> argparse._ArgumentGroup:
    """The group of flags for the picture: those of the settings that are named, and its size."""
    picture = parser.add_argument_group("picture")
    _add_settings(picture, names)
    picture.add_argument("--res", nargs=2, type=int, metavar=("W", "H"), help="width and height together")
    return picture


def _add_view(parser: argparse.ArgumentParser) -> None:
    picture = _add_picture(parser, [name for name in _FIELDS if name not in _NOT_IN_VIEW])
    stops = "exposure: each stop doubles the radiance (default: 0, or more or less where that would show nothing)"
    picture.add_argument("--exposure", type=_stops, metavar="STOPS", help=stops)
    curve = "tone curve: srgb clips highlights, filmic compresses them smoothly (default: srgb)"
    picture.add_argument("--tonemap", choices=TONEMAPS, default=TONEMAPS[0], help=curve)
    _add_stage(parser, frames=False)
    output = parser.add_argument_group("output")
    web = "serve the view to a browser at this port, of 127.0.0.1 or of another address, which then needs a token"
    output.add_argument("--web", type=_address, metavar="[HOST:]PORT", help=web)
    saved = "file that F2 saves the picture to; a number is added where it exists (default: view.png)"
    output.add_argument("--picture", default="view.png", metavar="FILE", help=saved)
    layer = "file that F3 saves camera, lights and colours to (default: view_edits.usda)"
    output.add_argument("--edits", default="view_edits.usda", metavar="FILE", help=layer)
    _add_device(output)
    _add_threads(output)


def _add_info(parser: argparse.ArgumentParser) -> None:
    _add_stage(parser, frames=False)
    parser.add_argument("--json", action="store_true", help="print JSON, for programs")
    parser.add_argument(
        "--list", choices=LISTS, metavar="WHAT", help=f"print only these, one per line: {', '.join(LISTS)}"
    )


def _add_vpls(parser: argparse.ArgumentParser) -> None:
    output = ".png picture, .html page, .gltf model, .usda points or lights, .npz arrays, .gif or .mp4 animation"
    parser.add_argument("output", metavar="OUTPUT", help=output)
    paths = parser.add_argument_group("light paths")
    _add_settings(paths, [name for name in _FIELDS if name not in _PICTURE_ONLY])
    number = "number of the iteration whose light paths are traced (default: 0)"
    paths.add_argument("--iteration", type=int, default=0, metavar="N", help=number)
    target = "also compute what each VPL contributes: to a pixel, column and row of the image, or to the whole picture"
    paths.add_argument("--contribution-to", type=_pixel_or_picture, metavar="X,Y|picture", help=target)
    paths.add_argument("--as-lights", action="store_true", help="write UsdLux lights to .usda, not points")
    paths.add_argument("--make-output-path", action="store_true", help="create the folder of OUTPUT")
    _add_device(paths)
    drawing = parser.add_argument_group("drawing (not for .usda and .npz)")
    view = "where the scene is seen from: the stage's camera, or outside (default: outside)"
    drawing.add_argument("--view", choices=("camera", "outside"), help=view)
    coloring = "what the colour of a VPL shows (default: hue, the colour of its light)"
    drawing.add_argument("--color-by", choices=("hue", "flux", "bounce", "contribution"), help=coloring)
    chosen = "only VPLs after these numbers of reflections; 0 is on the lights (default: all)"
    drawing.add_argument("--bounces", type=_whole_numbers, metavar="N[,N]", help=chosen)
    least = "only VPLs with at least this fraction of the greatest contribution (default: 0)"
    drawing.add_argument("--min-contribution", type=_fraction, metavar="FRACTION", help=least)
    drawing.add_argument("--paths", action="store_true", default=None, help="also draw the light paths")
    order = "how an animation adds the VPLs (default: path)"
    drawing.add_argument("--order", choices=("path", "bounce"), help=order)
    _add_stage(parser, frames=False)


def _add_compare(parser: argparse.ArgumentParser) -> None:
    plot = ".png file for a plot of error against time (needs the extra 'bench')"
    parser.add_argument("output", metavar="OUTPUT", nargs="?", help=plot)
    comparison = parser.add_argument_group("comparison")
    times = "time limits of each method, in seconds (default: 0.5,1,2,4)"
    comparison.add_argument("--times", type=_times, default=[0.5, 1.0, 2.0, 4.0], metavar="S[,S]", help=times)
    reference_time = "time for the reference, rendered by path (default: ten times the longest of --times)"
    comparison.add_argument("--reference-time", type=_duration, metavar="SECONDS", help=reference_time)
    methods = f"methods to compare: {', '.join(METHODS)} (default: all that are installed)"
    comparison.add_argument("--methods", type=_names(METHODS), metavar="NAME[,NAME]", help=methods)
    seeds = "seeds per method and time; the table shows medians (default: 1)"
    comparison.add_argument("--seeds", type=_count, default=1, metavar="N", help=seeds)
    comparison.add_argument("--json", metavar="FILE.json", help="write all numbers")
    comparison.add_argument("--make-output-path", action="store_true", help="create the folder of OUTPUT")
    _add_device(comparison)
    _add_settings(parser.add_argument_group("picture"), [name for name in _FIELDS if name not in _SET_BY_COMPARE])
    _add_stage(parser, frames=False)


def _add_settings(group: argparse._ArgumentGroup, names: Collection[str]) -> None:
    """Adds a flag for each of the settings; the namespace only has those that are given."""
    hints = typing.get_type_hints(RenderSettings)
    for name in names:
        field = _FIELDS[name]
        doc = str(field.metadata["doc"]).replace("%", "%%")
        # The type other than None in `int`, `int | None`, ...
        kind = next(k for k in typing.get_args(hints[name]) or (hints[name],) if k is not types.NoneType)
        options: dict[str, Any] = {"dest": name, "default": argparse.SUPPRESS}
        if kind is bool:
            options["action"] = argparse.BooleanOptionalAction if field.default else "store_true"
        elif field.metadata.get("choices"):
            options["choices"] = field.metadata["choices"]
            if len(",".join(options["choices"])) > _MAX_CHOICES_LENGTH:
                doc += f": {', '.join(options['choices'])}"
                options["metavar"] = "NAME"
        elif isinstance(field.default, tuple):
            options |= {"type": float, "nargs": len(field.default), "metavar": "X"}
        else:
            options |= {"type": kind, "metavar": {int: "N", float: "X"}.get(kind, "TEXT")}
        if isinstance(field.default, tuple):
            doc += f" (default: {' '.join(f'{x:g}' for x in field.default)})"
        elif field.default is not None and kind is not bool:
            doc += f" (default: {field.default:g})" if kind is float else f" (default: {field.default})"
        group.add_argument(_flag(name), *_SHORT.get(name, ()), help=doc, **options)


def _add_stage(parser: argparse.ArgumentParser, *, frames: bool = True) -> None:
    hidden = argparse.SUPPRESS  # for the names of usdrecord, which are accepted but not listed
    group = parser.add_argument_group("stage")
    group.add_argument("--camera", "-cam", metavar="NAME", help="path or name of the camera (default: the main camera)")
    point: dict[str, Any] = {"nargs": 3, "type": _finite, "metavar": ("X", "Y", "Z")}
    group.add_argument("--eye", **point, help="position of the viewer, in place of a camera of the stage")
    group.add_argument("--look-at", **point, help="with --eye: the point to look at (default: the middle of the scene)")
    when = group.add_mutually_exclusive_group()
    if frames:
        spec = "frames to render: 101, 101:105, 101:109x2, or several with commas; OUTPUT needs ###"
        when.add_argument("--frames", "-f", metavar="SPEC", help=spec)
    when.add_argument("--time", type=_finite, metavar="CODE", help="time code (default: the stage's start)")
    when.add_argument(
        "--default-time", "-d", action="store_true", help="use the default values of attributes: nothing is animated"
    )
    when.add_argument("--defaultTime", dest="default_time", action="store_true", help=hidden)
    render_settings = "RenderSettings prim to use (default: the one that the stage names, or its first)"
    group.add_argument("--render-settings", "-rs", metavar="PRIM", help=render_settings)
    group.add_argument("--renderSettingsPrimPath", dest="render_settings", help=hidden)
    render_pass = "RenderPass prim: its settings are used, and prims that it excludes are not drawn"
    group.add_argument("--render-pass", "-rp", metavar="PRIM", help=render_pass)
    group.add_argument("--renderPassPrimPath", dest="render_pass", help=hidden)
    group.add_argument(
        "--purposes",
        type=_names(_PURPOSES, spaces=True),
        metavar="NAME[,NAME]",
        help="purposes to draw in addition to 'default': render, proxy, guide (default: those of the RenderSettings,"
        " or render)",
    )
    group.add_argument(
        "--complexity",
        "-c",
        choices=("low", "medium", "high", "veryhigh"),
        default="low",
        help="refinement of subdivision surfaces: none (the cage), or one, two or three levels (default: low)",
    )
    group.add_argument(
        "--mask",
        type=_paths,
        default=[],
        metavar="PRIM[,PRIM]",
        help="load only these prims, their ancestors and descendants, and what they refer to; lights must be named too",
    )
    group.add_argument(
        "--variant",
        dest="variants",
        action="append",
        default=[],
        metavar="/PRIM{SET=NAME}",
        help="select a variant; the flag may be repeated",
    )
    group.add_argument("--session-layer", metavar="FILE", help="USD file whose opinions are stronger than the stage's")
    group.add_argument("--sessionLayer", dest="session_layer", help=hidden)
    group.add_argument(
        "--default-light",
        choices=("none", "dome", "sky"),
        default="dome",
        help="light for a stage in which nothing emits: none, a white dome, or an overcast sky over grey ground "
        "(default: dome)",
    )
    config = "OpenColorIO configuration, for textures and pictures: a file, or ocio://default (default: $OCIO)"
    group.add_argument("--ocio-config", metavar="FILE", help=config)
    group.add_argument(
        "--metals",
        choices=("diffuse", "black"),
        default="diffuse",
        help="render metals as diffuse surfaces of their base colour, or as black (default: diffuse)",
    )
    group.add_argument(
        "--materials",
        choices=("diffuse", "all"),
        default="diffuse",
        help="what surfaces reflect: alike in all directions, or all of it, gloss and mirrors too, which only"
        " --estimator path renders (default: diffuse)",
    )
    group.add_argument(
        "--texture-wrap",
        choices=("black", "clamp", "repeat", "mirror"),
        default="black",
        help="wrap mode of textures for which the stage gives none (default: black)",
    )
    group.add_argument("--strict", action="store_true", help="stop with an error at the first warning about the stage")


def _add_device(group: argparse._ArgumentGroup, more: str = "") -> None:
    devices = f"cpu, cuda:0, ... (default: auto, the first GPU, or the CPU if there is none){more}"
    group.add_argument("--device", default="auto", metavar="NAME", help=devices)


def _add_threads(group: argparse._ArgumentGroup) -> None:
    threads = "CPU threads (default: one for each core); the picture does not depend on it"
    group.add_argument("--threads", type=_count, metavar="N", help=threads)


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


def _names(known: Collection[str], *, spaces: bool = False) -> Callable[[str], list[str]]:
    """A parser of argument values that are names separated by commas, or with `spaces` also by blanks."""

    def names(text: str) -> list[str]:
        given = text.replace(",", " ").split() if spaces else [part.strip() for part in text.split(",") if part.strip()]
        for name in given:
            if name not in known:
                raise argparse.ArgumentTypeError(f"unknown {name!r}; known are {', '.join(known)}")
        return given

    return names


def _paths(text: str) -> list[str]:
    return text.replace(",", " ").split()


def _finite(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"not a number: {text!r}")
    return value


def _seconds(text: str) -> float:
    value = _finite(text)
    if value < 0.0:
        raise argparse.ArgumentTypeError("must be at least 0")
    return value


def _duration(text: str) -> float:
    value = _finite(text)
    if value <= 0.0:
        raise argparse.ArgumentTypeError(f"must be more than 0 seconds, is {text.strip()}")
    return value


def _times(text: str) -> list[float]:
    return sorted({_duration(word) for word in text.split(",")})


def _part(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise argparse.ArgumentTypeError(f"must be K/N with K from 1 to N, is {text!r}")
    return int(match[1]), int(match[2])


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text[:9]) <= 1000:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1 to 1000, is {text!r}")
    return int(text)


def _address(text: str) -> tuple[str, int]:
    host, colon, port = text.rpartition(":")
    if not port.isdecimal() or int(port[:6]) > 65535 or (colon and not host):
        raise argparse.ArgumentTypeError(f"must be a port such as 8080, or HOST:PORT, is {text!r}")
    return host.strip("[]") or "127.0.0.1", int(port)


def _whole_numbers(text: str) -> list[int]:
    if not re.fullmatch(r"\d{1,6}(,\d{1,6})*", text):
        raise argparse.ArgumentTypeError(f"must be whole numbers separated by commas, is {text!r}")
    return [int(number) for number in text.split(",")]


def _pixel_or_picture(text: str) -> "tuple[int, int] | str":
    if text == "picture":
        return text
    numbers = _whole_numbers(text) if re.fullmatch(r"\d+,\d+", text) else []
    if len(numbers) != 2:
        raise argparse.ArgumentTypeError(f"must be 'picture', or column and row such as 100,80, is {text!r}")
    return numbers[0], numbers[1]


def _fraction(text: str) -> float:
    value = _finite(text)
    if not 0.0 <= value <= 1.0:
        raise argparse.ArgumentTypeError(f"must be from 0 to 1, is {text.strip()}")
    return value


def _stops_or_auto(text: str) -> float | str:
    return text if text == "auto" else _stops(text)


def _stops(text: str) -> float:
    value = _finite(text)
    if abs(value) > 1000.0:
        raise argparse.ArgumentTypeError("must be within ±1000 stops")
    return value
