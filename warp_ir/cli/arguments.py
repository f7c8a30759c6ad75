"""The command line: what can be said, in the habits of `usdrecord`, and how `--help` explains it.

The flags for `RenderSettings` are made from its fields: a new field is a new flag.
"""

import argparse
import dataclasses
import math
import types
import typing
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NoReturn

from warp_ir import __version__
from warp_ir.image.io import AOV_CHANNELS
from warp_ir.image.tonemap import TONEMAPS
from warp_ir.scene import InputError
from warp_ir.settings import RenderSettings

_FIELDS = {field.name: field for field in dataclasses.fields(RenderSettings)}
_ONLY_PICTURES = {
    *("iterations", "time_limit", "target_error", "visible_lights", "bound_radius"),
    *("pixel_aspect", "conform", "data_window", "depth_of_field", "motion_blur", "color_space"),
}
"""Settings that the light paths alone do not depend on."""
_SHORT = {"width": ("-w",)}
_OUTPUT = (
    "picture to write; ### stands for the frame. Or a folder, for all the pictures that the stage's RenderProducts name"
)
_LONG_CHOICE = 40
"""Characters beyond which the choices of a setting do not stand in for its value, but in the text beside it."""
LISTS = ("cameras", "lights", "materials", "settings")
"""What `warp-ir info --list` can list."""
METHODS: Mapping[str, Mapping[str, Any]] = {
    "vpl": {},
    "vpl without filter": {"filter": False},
    "vpl denoised": {"denoise": True},
    "keller": {"estimator": "keller"},
    "path": {"estimator": "path"},
}
"""What `warp-ir compare` compares: names, and the settings that are not the default."""
_COMPARED = ("iterations", "time_limit", "target_error", "estimator", "filter", "denoise")
"""Settings that are for `warp-ir compare` to choose."""
_PURPOSES = ("default", "render", "proxy", "guide")

_RENDER_NOTES = """\
The output's extension chooses the format: .exr (colour, alpha, AOV layers,
metadata), .hdr, .pfm and .npy hold linear radiance; .png and .jpg are
tone-mapped. Ctrl-C writes the picture so far.

examples:
  # 64 iterations, 512 pixels wide
  warp-ir render room.usda room.png
  # until the estimated error is 1 %, with more layers
  warp-ir render room.usda room.exr --target-error 0.01 --aov depth normal
  # another camera, half a minute, three times as bright as the file says
  warp-ir render room.usda room.png --camera Door --time-limit 30 --exposure 1.5
  # an animation; the same again after a crash, with --resume
  warp-ir render shot.usd shots/####.png --frames 1001:1024 --make-output-path
  # all pictures that the stage's RenderSettings ask for
  warp-ir render shot.usd renders/ --make-output-path
  # in red paint, with a lamp switched off in a layer
  warp-ir render car.usd car.png --variant '/Car{paint=red}' \\
      --session-layer no_lamp.usda
  # a second opinion: the same picture by path tracing
  warp-ir render room.usda path.png --estimator path --iterations 256
"""
_VPLS_NOTES = """\
examples:
  # a picture of the cloud in the room
  warp-ir vpls room.usda cloud.png
  # points to look at in usdview
  warp-ir vpls room.usda cloud.usda --light-paths 256
  # NumPy arrays: positions, normals, intensity, bounce, directional
  warp-ir vpls room.usda cloud.npz --iteration 3
"""
_COMPARE_NOTES = """\
relMSE is the mean of (x - r)^2 / (r^2 + 0.01 m^2), with r the reference and m
its mean: a scene twice as bright has the same. Ctrl-C tells what there is.

examples:
  # a table, and which settings to use
  warp-ir compare room.usda
  # also as a plot, for a small picture and longer renders
  warp-ir compare room.usda error.png --width 256 --times 2,8,32
  # only these, thrice, against a better reference
  warp-ir compare room.usda --methods 'vpl, path' --seeds 3 \\
      --reference-time 600
"""


class _Parser(argparse.ArgumentParser):
    """Errors become `InputError`: one line, and how to get help."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see {self.prog} --help)")


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """The arguments; `command` names the module of this package that carries it out.

    Raises:
        InputError: They make no sense.
    """
    parser = _Parser(
        prog="warp-ir",
        description="Instant radiosity for USD scenes: diffuse global illumination on CPU and GPU.",
        epilog="Try: warp-ir render STAGE picture.png; 'warp-ir COMMAND --help' tells all about a command.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"warp-ir {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, summary, notes, fill in (
        ("render", "render a stage to a picture", _RENDER_NOTES, _add_render),
        ("info", "show what is in a stage, what will be skipped, and why", "", _add_info),
        ("vpls", "write the virtual point lights: as picture, USD points or arrays", _VPLS_NOTES, _add_vpls),
        ("compare", "error against time of each method, and which one to use", _COMPARE_NOTES, _add_compare),
    ):
        command = commands.add_parser(
            name,
            help=summary,
            description=f"{summary[0].upper()}{summary[1:]}.",
            epilog=notes,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        command.add_argument("stage", metavar="STAGE", help="USD file (.usd .usda .usdc .usdz)")
        fill(command)
        messages = command.add_argument_group("messages")
        messages.add_argument("--quiet", "-q", action="store_true", help="say nothing but errors")
        messages.add_argument("--verbose", action="store_true", help="show all warnings, and tracebacks")
    return parser.parse_args(_joined_names(argv))


def _joined_names(argv: Sequence[str]) -> list[str]:
    """Makes ``--aov depth normal room.usda`` ``--aov depth,normal room.usda``: a list that knows its end."""
    joined: list[str] = []
    for word in argv:
        listing = len(joined) > 1 and joined[-2] == "--aov"
        if listing and word in AOV_CHANNELS:
            joined[-1] += "," + word
        else:
            joined.append(word)
    return joined


def given_settings(args: argparse.Namespace) -> dict[str, Any]:
    """The fields of `RenderSettings` that were given."""
    given: dict[str, Any] = {name: value for name, value in vars(args).items() if name in _FIELDS}
    given = {name: tuple(value) if isinstance(value, list) else value for name, value in given.items()}
    if getattr(args, "res", None):
        given["width"], given["height"] = args.res
    return given


def settings_of(args: argparse.Namespace, stage: Mapping[str, Any] | None = None) -> RenderSettings:
    """The render settings: as given, else as the stage asks, else the defaults.

    Args:
        args: The command line.
        stage: Fields of `RenderSettings` that the stage asks for.

    Raises:
        InputError: A value is out of range; the message names the flag.
    """
    given, wanted = given_settings(args), dict(stage or {})
    if ("width" in given) != ("height" in given) and "width" in wanted:
        # One side alone: the other follows the shape of the stage's resolution.
        side, other = ("width", "height") if "width" in given else ("height", "width")
        if isinstance(given[side], int) and given[side] > 0:
            wanted[other] = max(1, round(given[side] * wanted[other] / wanted[side]))
    if {"iterations", "time_limit", "target_error"} & set(given):
        wanted = {k: v for k, v in wanted.items() if k not in ("iterations", "time_limit", "target_error")}
    try:
        return RenderSettings(**{**wanted, **given})
    except InputError as error:
        name, colon, rest = str(error).partition(":")
        raise InputError(f"{_flag(name)}{colon}{rest}" if name in _FIELDS else str(error)) from error


def _add_render(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("output", metavar="OUTPUT", help=_OUTPUT)
    picture = parser.add_argument_group("picture")
    _add_settings(picture, _FIELDS)
    picture.add_argument("--res", nargs=2, type=int, metavar=("W", "H"), help="width and height in one")
    # usdrecord's names, understood and not advertised.
    hidden = argparse.SUPPRESS
    unsaid: dict[str, Any] = {"default": hidden, "help": hidden}
    picture.add_argument("--imageWidth", dest="width", type=int, default=hidden, help=hidden)
    picture.add_argument("--enableDomeLightVisibility", dest="visible_lights", action="store_true", **unsaid)
    picture.add_argument("--disableCameraLight", dest="default_light", action="store_const", const="none", **unsaid)
    picture.add_argument("--disableGpu", dest="device", action="store_const", const="cpu", **unsaid)
    _add_stage(parser)
    output = parser.add_argument_group("output")
    output.add_argument(
        "--aov",
        dest="aovs",
        action="extend",
        type=_names(AOV_CHANNELS),
        default=[],
        metavar="NAME ...",
        help=f"also write {', '.join(AOV_CHANNELS)}: as layers of an EXR file, otherwise as files beside it",
    )
    stops = "of .png and .jpg: each stop doubles the radiance (default: 0)"
    output.add_argument("--exposure", type=_stops, default=0.0, metavar="STOPS", help=stops)
    output.add_argument(
        "--tonemap",
        choices=TONEMAPS,
        default=TONEMAPS[0],
        help="of .png and .jpg: srgb clips highlights, filmic rolls them off (default: srgb)",
    )
    output.add_argument("--float", dest="half", action="store_false", help="store .exr with 32 bits, not 16")
    output.add_argument("--make-output-path", action="store_true", help="create the folder of the output")
    resume = "keep the pictures that are there, and go on with the one that an earlier command has begun"
    output.add_argument("--resume", action="store_true", help=resume)
    checkpoint = "how often OUTPUT.film.npz is written for --resume, until OUTPUT is done (default: 60; 0: never)"
    output.add_argument("--checkpoint", type=_seconds, default=60.0, metavar="SECONDS", help=checkpoint)
    output.add_argument("--stats", metavar="FILE.json", help="write timings, counts, memory and versions")
    _add_device(output)


def _add_info(parser: argparse.ArgumentParser) -> None:
    _add_stage(parser, frames=False)
    parser.add_argument("--json", action="store_true", help="for programs")
    parser.add_argument("--list", choices=LISTS, metavar="WHAT", help=f"only this, a line each: {', '.join(LISTS)}")


def _add_vpls(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("output", metavar="OUTPUT", help=".png picture, .usda points, or .npz arrays")
    cloud = parser.add_argument_group("light paths")
    _add_settings(cloud, [name for name in _FIELDS if name not in _ONLY_PICTURES])
    cloud.add_argument("--iteration", type=int, default=0, metavar="N", help="whose paths (default: 0)")
    cloud.add_argument(
        "--view", choices=("camera", "outside"), default="outside", help="of the picture (default: outside)"
    )
    cloud.add_argument("--make-output-path", action="store_true", help="create the folder of the output")
    _add_device(cloud)
    _add_stage(parser, frames=False)


def _add_compare(parser: argparse.ArgumentParser) -> None:
    plot = ".png to plot error against time in (needs the extra 'bench')"
    parser.add_argument("output", metavar="OUTPUT", nargs="?", help=plot)
    what = parser.add_argument_group("comparison")
    times = "how long each method renders, in seconds (default: 0.5,1,2,4)"
    what.add_argument("--times", type=_times, default=[0.5, 1.0, 2.0, 4.0], metavar="S[,S]", help=times)
    long = "how long path renders the reference (default: ten times the longest of --times)"
    what.add_argument("--reference-time", type=_duration, metavar="SECONDS", help=long)
    names = f"what to compare: {', '.join(METHODS)} (default: all that are installed)"
    what.add_argument("--methods", type=_names(METHODS), metavar="NAME[,NAME]", help=names)
    what.add_argument("--seeds", type=_count, default=1, metavar="N", help="pictures of each, for medians (default: 1)")
    what.add_argument("--json", metavar="FILE.json", help="write all numbers")
    what.add_argument("--make-output-path", action="store_true", help="create the folder of the output")
    _add_device(what)
    _add_settings(parser.add_argument_group("picture"), [name for name in _FIELDS if name not in _COMPARED])
    _add_stage(parser, frames=False)


def _add_settings(group: Any, names: Collection[str]) -> None:
    """A flag for each of the settings; those that are not given stay out of the namespace."""
    hints = typing.get_type_hints(RenderSettings)
    for name in names:
        field = _FIELDS[name]
        doc = str(field.metadata["doc"]).replace("%", "%%")
        # The one type of `int`, `int | None`, ...
        kind = next(k for k in typing.get_args(hints[name]) or (hints[name],) if k is not types.NoneType)
        options: dict[str, Any] = {"dest": name, "default": argparse.SUPPRESS}
        if kind is bool:
            options["action"] = argparse.BooleanOptionalAction if field.default else "store_true"
        elif field.metadata.get("choices"):
            options["choices"] = field.metadata["choices"]
            if len(",".join(options["choices"])) > _LONG_CHOICE:
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
    hidden = argparse.SUPPRESS  # usdrecord's names, understood and not advertised
    group = parser.add_argument_group("stage")
    group.add_argument("--camera", "-cam", metavar="NAME", help="path or name (default: the main camera)")
    point: dict[str, Any] = {"nargs": 3, "type": _finite, "metavar": ("X", "Y", "Z")}
    group.add_argument("--eye", **point, help="stand here, in place of a camera of the stage")
    group.add_argument("--look-at", **point, help="with --eye: look there (default: the middle of the scene)")
    when = group.add_mutually_exclusive_group()
    if frames:
        spec = "101, 101:105, 101:109x2, or several with commas; OUTPUT needs ###"
        when.add_argument("--frames", "-f", metavar="SPEC", help=spec)
    when.add_argument("--time", type=_finite, metavar="CODE", help="time code (default: the stage's start)")
    when.add_argument("--default-time", "-d", action="store_true", help="the default time, at which nothing moves")
    when.add_argument("--defaultTime", dest="default_time", action="store_true", help=hidden)
    wanted = "RenderSettings to honour (default: those the stage names, or its first)"
    group.add_argument("--render-settings", "-rs", metavar="PRIM", help=wanted)
    group.add_argument("--renderSettingsPrimPath", dest="render_settings", help=hidden)
    taking = "RenderPass whose settings are used, and of which only what takes part is drawn"
    group.add_argument("--render-pass", "-rp", metavar="PRIM", help=taking)
    group.add_argument("--renderPassPrimPath", dest="render_pass", help=hidden)
    group.add_argument(
        "--purposes",
        type=_names(_PURPOSES),
        metavar="NAME[,NAME]",
        help="what to draw beside purpose 'default': render, proxy, guide (default: what the RenderSettings"
        " say, or render)",
    )
    group.add_argument(
        "--complexity",
        "-c",
        choices=("low", "medium", "high", "veryhigh"),
        default="low",
        help="of subdivision surfaces: their cages, or one, two, three levels of refinement (default: low)",
    )
    group.add_argument(
        "--mask",
        type=_paths,
        default=[],
        metavar="PRIM[,PRIM]",
        help="load only these prims, and what is above, below and related to them; lights are not by themselves",
    )
    group.add_argument(
        "--variant",
        dest="variants",
        action="append",
        default=[],
        metavar="/PRIM{SET=NAME}",
        help="select a variant; may be given several times",
    )
    group.add_argument("--session-layer", metavar="FILE", help="USD file that is stronger than the stage")
    group.add_argument("--sessionLayer", dest="session_layer", help=hidden)
    group.add_argument(
        "--default-light",
        choices=("none", "dome"),
        default="dome",
        help="what lights a stage in which nothing emits (default: dome)",
    )
    group.add_argument(
        "--metals",
        choices=("diffuse", "black"),
        default="diffuse",
        help="metals as diffuse surfaces of their base colour, or without it (default: diffuse)",
    )
    group.add_argument(
        "--texture-wrap",
        choices=("black", "clamp", "repeat", "mirror"),
        default="black",
        help="textures beyond their edges, where the stage does not say it (default: black)",
    )
    group.add_argument("--strict", action="store_true", help="what is skipped or guessed is an error")


def _add_device(group: Any) -> None:
    devices = "cpu, cuda:0, ... (default: auto, the first GPU or else the CPU)"
    group.add_argument("--device", default="auto", metavar="NAME", help=devices)


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


def _names(known: Collection[str]) -> Any:
    """A type that takes names separated by commas."""

    def names(text: str) -> list[str]:
        found = [name.strip() for name in text.split(",") if name.strip()]
        for name in found:
            if name not in known:
                raise argparse.ArgumentTypeError(f"unknown {name!r}; known are {', '.join(known)}")
        return found

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


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text[:9]) <= 1000:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1 to 1000, is {text!r}")
    return int(text)


def _stops(text: str) -> float:
    value = _finite(text)
    if abs(value) > 1000.0:
        raise argparse.ArgumentTypeError("must be within ±1000 stops")
    return value
