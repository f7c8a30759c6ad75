"""The command line: what it writes, what it says, and how it ends."""

import json
import logging
import math
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

import warp_ir
import warp_ir.usd.load
from warp_ir import RenderSettings
from warp_ir.cli import compare, main
from warp_ir.cli.arguments import parse, settings_of
from warp_ir.cli.console import (
    LOGGER,
    Messages,
    ProgressDisplay,
    describe_progress,
    say,
    say_warnings,
    show_result,
)
from warp_ir.cli.frames import outputs_of
from warp_ir.image.cryptomatte import float_id
from warp_ir.image.io import AOV_CHANNELS, read_image
from warp_ir.scene import InputError

ROOM = str(Path(__file__).parent.parent / "scenes_usd" / "cornell_box.usda")
TURNTABLE = str(Path(__file__).parent.parent / "scenes_usd" / "turntable.usda")
SMALL = ["--width", "8", "--iterations", "2", "--light-paths", "16", "--device", "cpu"]

DARK = """#usda 1.0
def Mesh "Quad" {
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
}
def SphereLight "Light" {
    float inputs:intensity = %s
    double3 xformOp:translate = (0, 0, 2)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
"""


def warp_ir_process(*args, **options):
    """A `warp-ir` of its own."""
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-m", "warp_ir", *args],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options,
    )  # fmt: skip


def error_of(capsys, *args, code=2):
    """The one line with which the command fails."""
    assert main(list(args)) == code
    captured = capsys.readouterr()
    assert captured.out == ""
    assert re.fullmatch(r"warp-ir: .*error: .+\n", captured.err), captured.err
    return captured.err


# ---- render ----------------------------------------------------------------------------------------------


def test_clipped_pixels_are_counted(tmp_path, capsys):
    """Pixels that 16-bit EXR files clip are counted, also in the statistics; files of 32 bits clip nothing."""
    stage = tmp_path / "a.usda"
    stage.write_text(DARK % "1e9")
    flags = ["--width", "8", "--iterations", "2", "--light-paths", "16", "--stats", str(tmp_path / "s.json")]
    assert main(["render", str(stage), str(tmp_path / "a.exr"), *flags]) == 0
    picture = read_image(tmp_path / "a.exr")[..., :3]
    clipped = int((picture == 65504.0).any(axis=-1).sum())
    assert f"a.exr: {clipped} of 48 pixels exceed 65504" in capsys.readouterr().err and clipped > 0
    assert any("exceed 65504" in line for line in json.loads((tmp_path / "s.json").read_text())["warnings"])
    assert main(["render", str(stage), str(tmp_path / "a.exr"), *flags, "--float"]) == 0
    assert "65504" not in capsys.readouterr().err and read_image(tmp_path / "a.exr").max() > 65504.0


def test_render_writes_the_picture(tmp_path, capsys):
    """Stage in, picture out, one line of summary, and no word on stderr."""
    assert main(["render", ROOM, str(tmp_path / "a.exr"), *SMALL, "--aov", "depth", "normal"]) == 0
    captured = capsys.readouterr()
    assert read_image(tmp_path / "a.exr").shape == (8, 8, 4)
    assert read_image(tmp_path / "a.exr", layer="normal").shape == (8, 8, 3)
    assert re.fullmatch(r"\S+a\.exr: 8 x 8, 2 iterations in .* s on cpu, estimated error .* %\n", captured.out)
    assert captured.err == "" and os.listdir(tmp_path) == ["a.exr"]


def test_same_command_same_pixels(tmp_path):
    """The command and the Python API give the same bits."""
    assert main(["render", ROOM, str(tmp_path / "a.npy"), *SMALL, "--seed", "5", "-q"]) == 0
    settings = RenderSettings(width=8, iterations=2, light_paths=16, seed=5)
    film = warp_ir.render(warp_ir.load_usd(ROOM), settings, device="cpu")
    np.testing.assert_array_equal(read_image(tmp_path / "a.npy"), film.radiance())


def test_quiet_says_nothing(tmp_path, capsys):
    """--quiet leaves both streams alone."""
    assert main(["render", ROOM, str(tmp_path / "a.png"), *SMALL, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")


def test_frames(tmp_path, capsys):
    """Frames are files of their own, numbered by the placeholder, and they differ."""
    output = str(tmp_path / "new" / "f.###.npy")
    assert main(["render", TURNTABLE, output, *SMALL, "--frames", "1:7x6", "--make-output-path"]) == 0
    assert sorted(os.listdir(tmp_path / "new")) == ["f.001.npy", "f.007.npy"]
    first, second = (read_image(tmp_path / "new" / f"f.{n}.npy") for n in ("001", "007"))
    assert not np.array_equal(first, second)


def test_stats(tmp_path):
    """--stats is strict JSON with timings, counts, memory, versions and settings."""
    stats = tmp_path / "s.json"
    assert main(["render", ROOM, str(tmp_path / "a.png"), *SMALL, "-q", "--stats", str(stats)]) == 0

    def no_constants(name):
        raise AssertionError(f"{name} is no JSON")

    found = json.loads(stats.read_text(), parse_constant=no_constants)
    assert found["iterations"] == 2 and found["device"] == "cpu" and found["settings"]["light_paths"] == 16
    timings = found["timings"]
    assert {"import", "load", "compile", "upload", "render", "write"} <= set(timings)
    # The time since the start of the command holds all that happens before the picture is written, each by its name.
    assert sum(timings[step] for step in ("import", "load", "upload", "render")) <= found["seconds"]
    assert found["loaded"]["triangles"] == 30 and found["counts"]["iterations"] == 2
    assert found["peak_memory_bytes"] > 1 << 20 and found["versions"]["warp_ir"] == warp_ir.__version__
    assert found["output"] == [str(tmp_path / "a.png")] and 0.0 < found["error"] < 10.0


def test_a_limit_that_no_iteration_fits_gives_one(tmp_path, capsys):
    """A time limit of a millisecond gives a picture of one iteration, and a warning with the time that it took."""
    assert main(["render", ROOM, str(tmp_path / "a.png"), *SMALL[:2], *SMALL[4:], "--time-limit", "0.001"]) == 0
    captured = capsys.readouterr()
    assert ", 1 iterations in" in captured.out
    assert re.search(r"--time-limit 0.001: the picture took \S+ s, as one iteration is the least", captured.err)


def test_stats_of_frames(tmp_path):
    """With --frames the numbers of each frame are in a list; an error of one iteration is unknown: null."""
    stats = tmp_path / "s.json"
    command = ["render", TURNTABLE, str(tmp_path / "#.npy"), *SMALL, "--iterations", "1", "--frames", "1,2"]
    assert main([*command, "-q", "--stats", str(stats)]) == 0
    found = json.loads(stats.read_text())
    assert [frame["frame"] for frame in found["frames"]] == [1.0, 2.0]
    assert found["frames"][0]["error"] is None


@pytest.mark.parametrize(("intensity", "what"), [("1e6", "bright"), ("1e-4", "dark")])
def test_hint_of_exposure(tmp_path, capsys, intensity, what):
    """A picture all white or black comes with the exposure that shows it; with that, without a hint."""
    (tmp_path / "a.usda").write_text(DARK % intensity)
    command = ["render", str(tmp_path / "a.usda"), str(tmp_path / "a.png"), *SMALL]
    assert main(command) == 0
    hint = re.search(rf"hint: the picture is very {what}; --exposure (\S+) would", capsys.readouterr().err)
    assert hint
    assert main([*command, "--exposure", hint[1]]) == 0
    assert "hint" not in capsys.readouterr().err
    assert main([*command, "--exposure", "auto"]) == 0
    errors = capsys.readouterr().err
    assert "hint" not in errors
    automatic = re.search(r"--exposure auto: (\S+) stops", errors)
    assert automatic and float(automatic[1]) == pytest.approx(float(hint[1]), abs=0.26)  # the hint is in half stops


# ---- interruption ----------------------------------------------------------------------------------------


TELLING = """
import sys
from warp_ir.cli import main, render

class Display(render.ProgressDisplay):
    def __call__(self, progress):
        print("begun" if progress.iterations == 1 else "", file=sys.stderr, end="", flush=True)

render.ProgressDisplay = Display
sys.exit(main(sys.argv[1:]))
"""
"""A `warp-ir` that says when the first iteration is done."""


@pytest.mark.extended
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interruption_leaves_a_picture(tmp_path, number):
    """Ctrl-C and SIGTERM end in a finished picture of what there is and the shell's exit code for them."""
    picture, stats = tmp_path / "a.exr", tmp_path / "s.json"
    command = ["render", ROOM, picture, *SMALL[:2], *SMALL[4:], "--time-limit", "600", "--stats", stats]
    process = subprocess.Popen(
        [sys.executable, "-c", TELLING, *map(str, command)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stderr.read(5) == "begun"
    process.send_signal(number)
    out, err = process.communicate(timeout=30)
    assert (
        re.fullmatch(r"warp-ir: \S+: --resume continues from this checkpoint\nwarp-ir: interrupted\n", err)
        and "iterations" in out
    )
    assert read_image(picture).shape == (8, 8, 4)
    assert json.loads(stats.read_text())["interrupted"] is True
    assert sorted(os.listdir(tmp_path)) == ["a.exr", "a.exr.film.npz", "s.json"]
    assert process.returncode == 128 + number


class Interrupted:
    """A film on which nothing was exposed."""

    width = height = 4
    iterations, seconds, interrupted, rejected = 0, 0.0, signal.SIGINT, 0

    def __init__(self):
        self.timings, self.counts = {}, {}

    def error(self):
        return math.nan


class Stopped:
    """A renderer that is stopped at once."""

    def __init__(self, scene, settings, **_):
        self.wanted = self.settings = settings
        self.warnings = ()

    def new_film(self):
        return Interrupted()

    def render(self, film, progress, **_):
        return film


def test_interruption_before_the_first_iteration(tmp_path, monkeypatch, capsys):
    """There is no picture yet: the old file stays, and the message says that nothing was written."""
    (tmp_path / "a.png").write_text("old")
    monkeypatch.setattr(warp_ir, "Renderer", Stopped)
    assert main(["render", ROOM, str(tmp_path / "a.png"), "--device", "cpu"]) == 130
    captured = capsys.readouterr()
    assert captured.out == "" and "nothing written" in captured.err
    assert (tmp_path / "a.png").read_text() == "old"


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interruption_while_loading(tmp_path, monkeypatch, capsys, number, code):
    """Outside of the renderer, too, both signals end the command in one line."""
    monkeypatch.setattr(warp_ir.usd.load, "StageReader", lambda *args, **kwargs: signal.raise_signal(number))
    assert main(["info", ROOM]) == code
    assert capsys.readouterr().err in ("warp-ir: interrupted\n", "warp-ir: terminated\n")


IMPORTING = """
import importlib.abc, os, signal, sys

class Interrupting(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name == "pxr.Gf":
            sys.meta_path.remove(self)
            os.kill(os.getpid(), getattr(signal, sys.argv[1]))

sys.meta_path.insert(0, Interrupting())
from warp_ir.cli import main
sys.exit(main(sys.argv[2:]))
"""
"""A `warp-ir` that is interrupted while one of USD's modules imports another."""


@pytest.mark.extended
@pytest.mark.parametrize(("number", "said"), [(signal.SIGINT, "interrupted"), (signal.SIGTERM, "terminated")])
@pytest.mark.parametrize("command", [["info", ROOM], ["render", TURNTABLE, "#.png", "--frames", "1:2"]])
def test_interruption_while_importing(tmp_path, number, said, command):
    """USD swallows what is raised while its modules import each other; the command still ends, in one line."""
    process = [sys.executable, "-c", IMPORTING, number.name, *command]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(process, capture_output=True, text=True, timeout=60, cwd=tmp_path, env=environment)
    assert (done.returncode, done.stdout, done.stderr) == (128 + number, "", f"warp-ir: {said}\n")


@pytest.mark.extended
@pytest.mark.parametrize(("stage", "code"), [(ROOM, 0), ("nowhere.usda", 2)])
def test_the_process_ends_in_order(stage, code):
    """What others want done at the end is done, all output arrives, and the exit code is that of `main`."""
    python = "import atexit; from warp_ir.cli import command; atexit.register(print, 'last'); command()"
    process = [sys.executable, "-c", python, "info", str(stage)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(process, capture_output=True, text=True, timeout=60, env=environment)
    assert done.returncode == code
    assert done.stdout.splitlines()[-1] == "last" and (len(done.stdout.splitlines()) > 5) == (code == 0)


# ---- errors ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "the following arguments are required: COMMAND"),
        (["paint"], "invalid choice: 'paint'"),
        (["render", ROOM], "the following arguments are required: OUTPUT"),
        (["render", ROOM, "a.gif"], "a.gif: unknown extension '.gif'"),
        (["render", ROOM, "/nowhere/a.png"], "there is no folder '/nowhere'"),
        (["render", ROOM, "a.png", "--width", "0"], "--width: must be a whole number of at least 1, is 0"),
        (["render", ROOM, "a.png", "--width", "wide"], "--width/-w: invalid int value: 'wide'"),
        (["render", ROOM, "a.png", "--width", "99999999", "--height", "9999999"], "--width: must be small enough"),
        (["render", ROOM, "a.png", "--width", "1000000000"], "at most"),
        (["render", ROOM, "a.png", "--time-limit", "nan"], "--time-limit: must be a positive number"),
        (["render", ROOM, "a.png", "--estimator", "magic"], "--estimator: invalid choice: 'magic'"),
        (["render", ROOM, "a.png", "--max-bounces", "-1"], "--max-bounces: must be a whole number"),
        (["render", ROOM, "a.png", "--aov", "beauty"], "unknown 'beauty'; known are direct, indirect"),
        (["render", ROOM, "a.png", "--exposure", "nan"], "not a number: 'nan'"),
        (["render", ROOM, "a.png", "--exposure", "-inf"], "not a number: '-inf'"),
        (["render", ROOM, "a.png", "--width", "-1e3"], "--width/-w: invalid int value: '-1e3'"),
        *((["render", ROOM, "a.##.png", "--frames", f], "is not understood") for f in ("-2:", "1:", ":2", "1:2x", "")),
        (["render", ROOM, "a.png", "--device", "cuda:77"], "--device: 'cuda:77' is not available; available: cpu"),
        (["render", ROOM, "a.png", "--device", ""], "--device: '' is not available"),
        (["render", ROOM, "a.png", "--frames", "1:3"], "the output needs one placeholder"),
        (["render", ROOM, "##/a.##.png", "--frames", "1:3"], "the output needs one placeholder"),
        (["render", ROOM, "a.##.png", "--frames", "one"], "'one' is not understood"),
        (["render", ROOM, "a.##.png", "--frames", "1:2x0.5"], "1.5 needs a placeholder with decimals"),
        (["render", ROOM, "a.##.png", "--frames", "1:99999999"], "more than 1000000 frames"),
        (["render", ROOM, "a.png", "--stats", "a.txt"], "a.txt: unknown extension '.txt'; known are .json"),
        (["render", ROOM, "a.png", "--camera", "Nobody"], "Nobody"),
        (["render", "missing.usda", "a.png"], "missing.usda: no such file"),
        (["render", __file__, "a.png"], "cannot be opened as USD"),
        (["info", "missing.usda"], "missing.usda: no such file"),
        (["vpls", ROOM, "a.exr"], "unknown extension '.exr'; known are .png .html .gltf .gif .mp4 .usda .npz"),
        (["vpls", ROOM, "a.npz", "--iteration", "-1"], "--iteration: must be at least 0"),
        (["compare", ROOM, "a.exr"], "a.exr: unknown extension '.exr'; known are .png"),
        (["compare", ROOM, "--json", "a.txt"], "a.txt: unknown extension '.txt'; known are .json"),
        (["compare", ROOM, "--times", "1,0"], "--times: must be more than 0 seconds, is 0"),
        (["compare", ROOM, "--times", "1,,2"], "--times: not a number: ''"),
        (["compare", ROOM, "--seeds", "0"], "--seeds: must be a whole number from 1 to 1000, is '0'"),
        (["compare", ROOM, "--methods", "vpl, magic"], "unknown 'magic'; known are vpl, vpl without filter"),
        (["compare", ROOM, "--methods", ","], "--methods: names no method"),
        (["compare", ROOM, "--iterations", "4"], "--iterations 4 (see warp-ir compare --help)"),
        (["render", ROOM, "a.png", "--threads", "0"], "--threads: must be a whole number from 1 to 1000"),
        (["vpls", ROOM, "a.npz", "--paths"], "--paths: has no effect on .npz"),
        (["vpls", ROOM, "a.png", "--as-lights"], "--as-lights: needs a .usda file"),
        (["vpls", ROOM, "a.usda", "--contribution-to", "3,4"], "--contribution-to: has no effect on .usda"),
        (["render", ROOM, "a.####.png"], "a.####.png: #### is the place of a frame number, which needs --frames"),
        (["compare", ROOM, "--width", "0"], "--width: must be a whole number of at least 1, is 0"),
        (["compare", "missing.usda"], "missing.usda: no such file"),
        (["render", ROOM, "a.png", "--purposes", "final"], "unknown 'final'; known are default, render"),
        (["render", ROOM, "a.png", "--wid", "8"], "unrecognized arguments: --wid 8"),
    ],
)
def test_errors_are_one_line(capsys, tmp_path, monkeypatch, arguments, message):
    """Exit code 2, one line that says what is wrong, nothing on stdout and no file."""
    monkeypatch.chdir(tmp_path)
    assert message in error_of(capsys, *arguments)
    assert os.listdir(tmp_path) == []


def test_strict(tmp_path, capsys):
    """What is a warning is an error with --strict."""
    (tmp_path / "a.usda").write_text('#usda 1.0\ndef Mesh "Empty" {}\n')
    assert main(["info", str(tmp_path / "a.usda")]) == 0
    assert "warning: /" in capsys.readouterr().err
    error_of(capsys, "info", str(tmp_path / "a.usda"), "--strict")


def test_internal_errors_are_one_line(capsys, monkeypatch):
    """A bug is no traceback either, but a line that says how to get one."""

    def broken(*args, **kwargs):
        raise RuntimeError("two\nlines")

    monkeypatch.setattr(warp_ir.usd.load, "StageReader", broken)
    line = error_of(capsys, "info", ROOM, code=1)
    assert line == "warp-ir: internal error: RuntimeError: two lines (--verbose shows where)\n"
    assert main(["info", ROOM, "--verbose"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_out_of_memory_is_one_line(capsys, monkeypatch):
    """So does memory that runs out."""

    def hungry(*args, **kwargs):
        raise MemoryError

    monkeypatch.setattr(warp_ir.usd.load, "StageReader", hungry)
    assert "out of memory" in error_of(capsys, "info", ROOM, code=1)


@pytest.mark.extended
def test_native_libraries_keep_silent(tmp_path):
    """In a process of its own, too, an error is one line: Warp and USD print none of theirs."""
    process = warp_ir_process("render", ROOM, str(tmp_path / "a.png"), "--device", "cuda:77")
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err.count("\n")) == (2, "", 1), err


@pytest.mark.extended
def test_closed_pipe():
    """`warp-ir info … | head -0` is no error worth a traceback."""
    read, write = os.pipe()
    os.close(read)
    process = subprocess.run(
        [sys.executable, "-m", "warp_ir", "info", ROOM], stdout=write, stderr=subprocess.PIPE, text=True, timeout=60
    )
    os.close(write)
    assert process.stderr == "" and process.returncode == 128 + signal.SIGPIPE


# ---- info and vpls ---------------------------------------------------------------------------------------


def test_info_table(capsys):
    """The table names the camera, the geometry, the light and the materials."""
    assert main(["info", ROOM]) == 0
    table = capsys.readouterr().out
    for line in (r"camera +/World/main_cam, perspective", r"triangles +30", r"lights +rect +radiance \(", "up axis +Y"):
        assert re.search(line, table), line


def test_info_json(capsys):
    """--json has the same as plain values."""
    assert main(["info", ROOM, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["triangles"] == 30 and facts["camera"]["name"] == "/World/main_cam"
    assert [light["kind"] for light in facts["lights"]] == ["rect"]
    assert facts["cameras"] == ["/World/main_cam"] and facts["warnings"] == []


def test_vpls_arrays_and_points(tmp_path, capsys):
    """The .npz has the arrays, and the .usda the same points in the stage's axis and unit."""
    from pxr import Usd, UsdGeom

    for suffix in ("npz", "usda"):
        command = ["vpls", ROOM, str(tmp_path / f"v.{suffix}"), "--light-paths", "32", "--device", "cpu"]
        assert main(command) == 0
        assert re.search(r"\d+ VPLs\n", capsys.readouterr().out)
    arrays = np.load(tmp_path / "v.npz")
    stage = Usd.Stage.Open(str(tmp_path / "v.usda"))
    points = UsdGeom.Points(stage.GetDefaultPrim())
    np.testing.assert_allclose(np.array(points.GetPointsAttr().Get()), arrays["positions"], rtol=1e-5, atol=1e-3)
    intensity = UsdGeom.PrimvarsAPI(points).GetPrimvar("intensity").Get()
    np.testing.assert_allclose(np.array(intensity), arrays["intensity"], rtol=1e-5)
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == UsdGeom.GetStageMetersPerUnit(Usd.Stage.Open(ROOM))
    assert len(points.GetWidthsAttr().Get()) == len(arrays["positions"]) >= 32


@pytest.mark.extended
def test_vpls_picture(tmp_path):
    """The .png shows something: more than one colour."""
    assert main(["vpls", ROOM, str(tmp_path / "v.png"), "--light-paths", "32", "-w", "64", "-q"]) == 0
    assert len(np.unique(read_image(tmp_path / "v.png").reshape(-1, 3), axis=0)) > 10


# ---- compare ---------------------------------------------------------------------------------------------

COMPARE = ["--width", "8", "--light-paths", "16", "--device", "cpu", "--times", "0.03,0.06", "--reference-time", "0.4"]
ROW = r"(\S.*?)  +([\d.e-]+)  +(\d+)  +(<?) ?([\d.e-]+)  +([+-][\d.]+) %"


@pytest.mark.extended
def test_compare_prints_a_table(tmp_path, capsys):
    """The table, the recommendation and the JSON say the same; a method is judged against `path` of another seed."""
    command = ["compare", ROOM, "--json", str(tmp_path / "c.json"), *COMPARE, "--methods", "path,vpl", "--seed", "7"]
    assert main(command) == 0
    first, head, *table, last = capsys.readouterr().out.splitlines()
    found = json.loads((tmp_path / "c.json").read_text())
    reference = found["reference"]
    assert re.fullmatch(rf"reference: path, {reference['iterations']} iterations in .* s; its own relMSE, .*", first)
    assert reference["seed"] == 8 and reference["floor"] > 0.0 and reference["iterations"] >= 2
    assert head.split() == ["method", "seconds", "iterations", "relMSE", "mean", "ratio"]
    rows = [re.fullmatch(ROW, line.strip()).groups() for line in table]
    assert [row[0] for row in rows] == [row["method"] for row in found["medians"]] and rows[-1][0] == "path"
    for cells, row in zip(rows, found["medians"], strict=True):
        assert (float(cells[1]), int(cells[2])) == (float(f"{row['seconds']:.3g}"), row["iterations"])
        resolution = 0.05 * reference["floor"]
        assert (cells[3] == "<") == (row["error"] <= resolution)
        assert float(cells[4]) == float(f"{max(row['error'], resolution):.2g}")
    assert {run["seed"] for run in found["runs"]} == {7} and found["interrupted"] is False
    recommended = found["recommended"]
    assert last.startswith(f"use {recommended['method']} (") and "relMSE 0.01 " in last and "relMSE 0.001 " in last


@pytest.mark.extended
def test_compare_medians_over_seeds(tmp_path, capsys):
    """Every seed is a run of its own, and the rows are the medians."""
    command = ["compare", ROOM, "-q", "--json", str(tmp_path / "c.json"), *COMPARE, "--methods", "vpl", "--seeds", "3"]
    # A limit that one iteration exceeds is left out, seed by seed: these are several iterations.
    assert main([*command, "--times", "0.3,0.5"]) == 0
    found = json.loads((tmp_path / "c.json").read_text())
    assert found["reference"]["seed"] == 3 and {run["seed"] for run in found["runs"]} == {0, 1, 2}
    for row in found["medians"]:
        errors = [run["error"] for run in found["runs"] if run["time_limit"] == row["time_limit"]]
        assert row["error"] == np.median(errors) and len(set(errors)) > 1
    assert capsys.readouterr().err == ""


@pytest.mark.extended
def test_compare_plots(tmp_path):
    """OUTPUT.png is a picture with more than one colour in it."""
    pytest.importorskip("matplotlib")
    assert main(["compare", ROOM, str(tmp_path / "c.png"), *COMPARE, "--methods", "path,vpl"]) == 0
    assert len(np.unique(read_image(tmp_path / "c.png").reshape(-1, 3), axis=0)) > 10


@pytest.mark.extended
def test_compare_without_extras(tmp_path, capsys, monkeypatch):
    """A plot without Matplotlib is an error that names the extra; without the denoiser its method is left out."""
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    assert "pip install 'warp-ir[bench]'" in error_of(capsys, "compare", ROOM, str(tmp_path / "c.png"))
    assert "pip install 'warp-ir[denoise]'" in error_of(capsys, "compare", ROOM, "--methods", "vpl denoised")
    assert main(["compare", ROOM, *COMPARE, "--times", "0.02"]) == 0
    captured = capsys.readouterr()
    assert "vpl denoised is left out: Open Image Denoise is not installed" in captured.err
    methods = [re.fullmatch(ROW, line.strip())[1] for line in captured.out.splitlines()[2:-1]]
    assert methods == ["vpl", "vpl without filter", "keller", "path"]


def test_compare_needs_light_and_time(tmp_path, capsys):
    """A black picture, and a reference without a standard error, are errors."""
    (tmp_path / "a.usda").write_text(DARK % "0")
    error = error_of(capsys, "compare", str(tmp_path / "a.usda"), *COMPARE, "-q", "--default-light", "none")
    assert "the picture is black" in error
    assert "--reference-time: one iteration" in error_of(capsys, "compare", ROOM, *COMPARE, "--reference-time", "1e-9")


@pytest.mark.extended
@pytest.mark.parametrize(("after", "rows"), [(0, 0), (4, 0), (6, 2)])
def test_compare_interrupted(tmp_path, capsys, monkeypatch, after, rows):
    """A signal ends in what there is: after the reference, its scale and two warm-ups every render is a row."""
    renders = []
    render = warp_ir.Renderer.render

    def stopped(self, film=None, progress=None):
        renders.append(self)
        film = render(self, film, progress)
        film.interrupted = signal.SIGTERM if len(renders) > after else 0
        return film

    monkeypatch.setattr(warp_ir.Renderer, "render", stopped)
    command = ["compare", ROOM, "--json", str(tmp_path / "c.json"), *COMPARE, "--methods", "path,vpl"]
    assert main(command) == 143 and len(renders) == after + 1
    captured = capsys.readouterr()
    assert "interrupted" in captured.err
    assert sum(re.fullmatch(ROW, line.strip()) is not None for line in captured.out.splitlines()) == rows
    assert (tmp_path / "c.json").exists() == (rows > 0)


@pytest.mark.extended
def test_compare_interrupted_between_renders(capsys, monkeypatch):
    """So does Ctrl-C while no render is there to notice it."""
    measured = []

    def measure(*args, **kwargs):
        measured.append(args)
        if len(measured) == 3:
            raise KeyboardInterrupt
        return 0.5

    monkeypatch.setattr(compare, "mean_ratio", measure)
    assert main(["compare", ROOM, *COMPARE, "--methods", "path,vpl"]) == 130
    captured = capsys.readouterr()
    assert captured.out.count("+50.00 %") == 2 and "interrupted: the table holds" in captured.err


def curve(method, *points):
    return [compare.Run(method, t, None, t, 1, error, 0.0) for t, error in points]


def test_compare_recommends_the_smallest_error():
    """Errors that fall as 1/t and as 1/√t, in closed form; what the reference cannot tell apart is level."""
    fast, slow = curve("path", (1.0, 0.04), (4.0, 0.01)), curve("vpl", (1.0, 0.012), (4.0, 0.006))
    verdict = compare.recommend([*slow, *fast], 1e-6)
    assert (verdict.method, verdict.flags, verdict.ties) == ("vpl", "", [])
    between, beyond = verdict.seconds[0.01], verdict.seconds[0.001]
    assert between[1] and between[0] == pytest.approx(4.0 ** (math.log(1.2) / math.log(2.0)))
    assert not beyond[1] and beyond[0] == pytest.approx(4.0 * 6.0**2)
    assert compare.seconds_to(0.001, [(1.0, 0.04), (4.0, 0.01)]) == pytest.approx((40.0, False))
    assert compare.seconds_to(0.001, [(1.0, 0.02), (4.0, 0.02)]) is None
    assert compare.seconds_to(0.001, [(1.0, 0.06), (4.0, 0.06 / 1.1)]) is None
    assert compare.seconds_to(1e-9, [(1.0, 1e60), (4.0, 0.9e60)]) is None  # no overflow
    level = compare.recommend([*slow, *fast], 0.02)
    assert (level.method, level.ties) == ("vpl", ["path"])
    late = [compare.Run("keller", 1.0, None, 40.0, 1, 0.001, 0.0)]  # 0.01 at 4 s, as iterations are independent
    assert compare.recommend([*slow, *late], 1e-6).method == "vpl"
    assert "relMSE 0.001 in about 2.4 min" in compare.recommendation_text(verdict, 4.0)


# ---- arguments -------------------------------------------------------------------------------------------


def test_help_imports_nothing_heavy():
    """--help is there at once: Warp, USD, pictures and drawing stay unloaded."""
    code = """
import sys
from warp_ir.cli import compare, main
try:
    main(["render", "--help"])
except SystemExit as end:
    heavy = {"warp", "pxr", "pyvista", "vtkmodules", "OpenImageIO", "rich"} & set(sys.modules)
    sys.exit(f"imported {heavy}" if heavy else end.code)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "examples:" in done.stdout and "--estimator" in done.stdout


@pytest.mark.parametrize("command", ["render", "info", "vpls", "compare"])
def test_help_fits_a_terminal(command, capsys, monkeypatch):
    """80 columns suffice."""
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])
    assert end.value.code == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80


def test_version(capsys):
    """--version is the package's."""
    with pytest.raises(SystemExit):
        main(["--version"])
    assert capsys.readouterr().out == f"warp-ir {warp_ir.__version__}\n"


def test_every_setting_is_a_flag():
    """A flag for each field of RenderSettings, and what is not given keeps the field's default."""
    assert settings_of(parse(["render", "a.usda", "b.png"])) == RenderSettings()
    values = {"width": 3, "height": 4, "iterations": 5, "time_limit": 1.5, "target_error": 0.5, "visible_lights": True}
    flags = [f"--{name.replace('_', '-')}" for name in values]
    words = [
        w for flag, v in zip(flags, values.values(), strict=True) for w in ([flag] if v is True else [flag, str(v)])
    ]
    assert settings_of(parse(["render", "a.usda", "b.png", *words])) == RenderSettings(**values)
    assert set(RenderSettings().to_dict()) <= set(vars(parse(["render", "a", "b", *_every_flag()])))


def _every_flag():
    words = []
    for name, value in RenderSettings(height=1, iterations=1, time_limit=1.0, target_error=1.0).to_dict().items():
        if name not in ("visible_lights",) and not isinstance(value, bool):
            given = {None: "1"}.get(value, str(value))
            given = "roulette" if name == "absorption" else given
            many = [str(x) for x in value] if isinstance(value, tuple) else [given]
            words += [f"--{name.replace('_', '-')}", *many]
        elif isinstance(value, bool):
            words.append(f"--{name.replace('_', '-')}")
    return words


def test_habits_of_usdrecord():
    """The flags of usdrecord are understood."""
    args = parse(["render", "-cam", "Door", "-w", "7", "-f", "1:2", "a.usda", "b.##.png"])
    assert (args.camera, args.width, args.frames) == ("Door", 7, "1:2")
    assert parse(["render", "a", "b", "--imageWidth", "9"]).width == 9


@pytest.mark.parametrize(
    "words",
    [
        ["a", "b", "--aov", "depth", "normal"],
        ["--aov", "depth", "normal", "a", "b"],
        ["a", "--aov", "depth,normal", "b"],
        ["a", "b", "--aov", "depth", "--aov", "normal"],
    ],
)
def test_aovs_in_every_order(words):
    """A list of AOVs does not swallow what follows."""
    args = parse(["render", *words])
    assert (args.stage, args.output, args.aovs) == ("a", "b", ["depth", "normal"])


@pytest.mark.parametrize(
    ("words", "name", "value"),
    [
        (["--frames", "-2:0"], "frames", "-2:0"),
        (["-f", "-4:-2x2,-.5"], "frames", "-4:-2x2,-.5"),
        (["--eye", "-1e-7", "-.5E3", "-5."], "eye", [-1e-7, -500.0, -5.0]),
        (["--eye", "0", "0", "1", "--look-at", "-1e1", "0", "-1_0"], "look_at", [-10.0, 0.0, -10.0]),
        (["--exposure", "-1e0"], "exposure", -1.0),
        (["--time", "-1e0"], "time", -1.0),
        (["--data-window", "-1e-1", "0", "1", "1"], "data_window", [-0.1, 0.0, 1.0, 1.0]),
    ],
)
def test_negative_numbers_are_values(words, name, value):
    """A word that begins like a negative number is one, however it is written: no flag begins so."""
    for order in (["a", "b", *words], [*words, "a", "b"]):
        args = parse(["render", *order])
        assert getattr(args, name) == value and (args.stage, args.output) == ("a", "b")


def test_help_names_every_aov(capsys):
    """The AOVs need not be guessed."""
    with pytest.raises(SystemExit):
        main(["render", "--help"])
    text = capsys.readouterr().out
    assert all(name in text for name in AOV_CHANNELS)


# ---- frames, warnings, progress --------------------------------------------------------------------------


def test_placeholders():
    """The number fills the whole placeholder, decimals and sign included."""
    assert outputs_of("a.####.png", "7,9:8", None) == {
        7: Path("a.0007.png"),
        9: Path("a.0009.png"),
        8: Path("a.0008.png"),
    }
    assert list(outputs_of("###.##.png", "1:2x0.5", None).values()) == [
        Path(f"00{x}.png") for x in ("1.00", "1.50", "2.00")
    ]
    assert list(outputs_of("a.###.png", "-2:0", None).values()) == [Path(f"a.{x}.png") for x in ("-02", "-01", "000")]
    assert outputs_of("a.###.png", "-0", None) == {0: Path("a.000.png")}
    assert outputs_of("#/a.png", "1000", None) == {1000: Path("1000/a.png")}
    assert outputs_of("a#.png", None, 3.0) == {3.0: Path("a#.png")}
    with pytest.raises(InputError):
        outputs_of("a.png", "1", None)


def test_many_warnings_are_cut(capsys):
    """The first ten and how many more; the same one once; all if asked for, or if only one would be hidden."""
    with Messages():
        say_warnings([f"/Prim{i}: odd" for i in range(30)] * 2)
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 11 and lines[-1] == "warp-ir: warning: ... and 20 more; --verbose shows all"
        say_warnings([f"/Prim{i}: odd" for i in range(30)], everything=True)
        assert len(capsys.readouterr().err.splitlines()) == 30
        say_warnings([f"/Prim{i}: odd" for i in range(11)])
        assert "/Prim10" in capsys.readouterr().err


def test_log_file_has_everything(tmp_path, capsys):
    """All warnings and results, in the order of their times, after what was there; -q hides them on stderr alone."""
    log = tmp_path / "warp.log"
    log.write_text("before\n")
    with Messages() as messages:
        messages.configure(quiet=True, file=str(log))
        say_warnings([f"/Prim{i}:\nodd" for i in range(30)])
        show_result("a.png: done", quiet=True)
        say("failed", logging.ERROR)
    first, *lines = log.read_text().splitlines()
    stamps = [line[:23] for line in lines]
    assert first == "before" and len(lines) == 32 and stamps == sorted(stamps)
    assert [line.split(",")[1][4:] for line in lines[-3:]] == [
        "WARNING /Prim29: odd", "INFO a.png: done", "ERROR failed"
    ]  # fmt: skip
    assert capsys.readouterr() == ("", "warp-ir: failed\n")
    assert not LOGGER.handlers


def test_log_file_of_a_command(tmp_path, capsys):
    """It begins with the command, and a failure is in it with its traceback; one that cannot be written is an error."""
    stage = tmp_path / "a.usda"
    stage.write_text(DARK % "1")
    assert main(["info", str(stage), "--log-file", str(tmp_path / "log"), "-q", "--camera", "/No"]) == 2
    lines = (tmp_path / "log").read_text().splitlines()
    assert lines[0].endswith("-q --camera /No") and "ERROR error: " in lines[1]
    capsys.readouterr()
    message = error_of(capsys, "info", str(stage), "--log-file", str(tmp_path / "no" / "log"))
    assert "--log-file: " in message and "No such file" in message


def test_compiling_is_told_at_once_and_then_rarely(capsys, monkeypatch):
    """The first line comes at once, further ones every five seconds at most, and the last one in any case."""
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    with Messages():
        for done in range(11):
            now[0] = 2.0 * done
            LOGGER.info("%d of 10", done, extra={"compiling": (done, 10)})
        LOGGER.info("compiled")
    lines = capsys.readouterr().err.splitlines()
    assert lines == [f"warp-ir: {text}" for text in ("0 of 10", "3 of 10", "6 of 10", "9 of 10", "compiled")]


class Step:
    """A `Progress`."""

    def __init__(self, iterations, error=math.nan, left=math.nan, fraction=0.5):
        self.iterations, self.seconds, self.error = iterations, 1.0, error
        self.seconds_left, self.fraction = left, fraction


def test_progress_in_words():
    """What is unknown is left out."""
    assert describe_progress(Step(1)) == "1 iterations"
    assert describe_progress(Step(20, 0.0123, 61.5)) == "20 iterations, error 1.2 %, 1:02 left"
    assert describe_progress(Step(20, 0.5, 3600.0)) == "20 iterations, error 50 %, 1:00:00 left"


def test_progress_lines_become_rare(capsys, monkeypatch):
    """Without a terminal: lines after 10 s, 20 s more, 40 s more, ...: an hour is 8 lines."""
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    with Messages(), ProgressDisplay("a.png") as display:
        for second in range(3600):
            now[0] = float(second)
            display(Step(second))
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 8 and lines[0] == "warp-ir: a.png: 50 %, 10 iterations"


def test_progress_bar_on_a_terminal(capsys, monkeypatch):
    """On a terminal it is a bar, gone in the end."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    with Messages(), ProgressDisplay("a.png") as display:
        LOGGER.info("compiling: 0 of 9", extra={"compiling": (0, 9)})
        LOGGER.info("compiling: 8 of 9", extra={"compiling": (8, 9)})
        display(Step(3, 0.25, 7.0))
    error = capsys.readouterr().err
    assert "a.png" in error and "compiling: 0 of 9" in error and "compiling: 8 of 9" not in error


@pytest.mark.extended
def test_exr_for_compositors(tmp_path):
    """The flags for .exr arrive in the file, and the frame rate of the stage."""
    stage = tmp_path / "a.usda"
    stage.write_text((DARK % "1").replace("1.0", "1.0\n( framesPerSecond = 23.976 )", 1))
    picture = tmp_path / "a.exr"
    flags = ["--cryptomatte", "object,material", "--exr-parts", "many", "--exr-compression", "dwaa", "--owner", "Me"]
    assert main(["render", str(stage), str(picture), *SMALL, *flags, "--aov", "prim_id"]) == 0
    matte = read_image(picture, "crypto_object00")
    assert set(np.unique(matte[..., 0])) == {0.0, np.float32(float_id("/Quad"))}
    alpha = read_image(picture)[..., 3]
    assert ((matte[..., 1] > 0.0) >= (alpha > 0.0)).all()  # the picture's camera rays are among those of the coverage
    assert read_image(picture, "crypto_material02").shape[2] == 4
    spec = oiio.ImageInput.open(str(picture)).spec()
    assert tuple(spec.getattribute("framesPerSecond")) == (24000, 1001)
    assert spec.getattribute("compression") == "dwaa" and json.loads(spec.getattribute("warp_ir:prim_names")) == [
        "/Quad"
    ]


@pytest.mark.parametrize(
    ("name", "flags", "message"),
    [
        ("a.png", ["--cryptomatte", "object"], "--cryptomatte: has no effect on"),
        ("a.png", ["--owner", "Me"], "--owner: has no effect on"),
        ("a.hdr", ["--exr-parts", "many"], "--exr-parts: has no effect on"),
        ("a.tif", ["--exr-compression", "piz"], "--exr-compression: has no effect on"),
        ("a.exr", ["--exr-compression", "lzw"], "argument --exr-compression: invalid choice"),
        ("a.exr", ["--cryptomatte", "prim"], "unknown 'prim'; known are object, material"),
        ("a.exr", ["--cryptomatte", "object", "--exr-compression", "dwab"], "add --exr-parts many"),
    ],
)
def test_exr_flags_that_cannot_work(tmp_path, capsys, name, flags, message):
    """Flags for .exr with another file, unknown values, and lossy numbers are errors."""
    assert message in error_of(capsys, "render", ROOM, str(tmp_path / name), *flags)


@pytest.mark.parametrize(
    ("name", "flags", "message"),
    [
        ("a.png", ["--ocio-display", "CRT"], "no configuration; $OCIO or --ocio-config names one"),
        ("a.png", ["--ocio-config", "ocio://default", "--ocio-display", "CRT"], "must be one of sRGB - Display, "),
        ("a.png", ["--ocio-config", "ocio://default", "--ocio-view", "CRT"], "--ocio-view: must be one of "),
        ("a.exr", ["--ocio-config", "ocio://default", "--ocio-view", "Raw"], "--ocio-view: has no effect on "),
        ("a.png", ["--ocio-view", "Raw", "--tonemap", "filmic"], "takes the place of --tonemap"),
        ("a.png", ["--ocio-config", "no.ocio"], "OpenColorIO: Requested non-existent OCIO config"),
        ("a.exr", ["--color-space", "crayon"], "--color-space: must be one of lin_rec709_scene, "),
        ("a.exr", ["--ocio-config", "ocio://default", "--color-space", "crayon"], "ACEScg, "),
    ],
)
def test_colours_that_there_are_not(tmp_path, capsys, monkeypatch, name, flags, message):
    """Unknown displays, views, spaces and configurations, and flags without effect, are one line; $OCIO stays."""
    monkeypatch.delenv("OCIO", raising=False)
    assert message in error_of(capsys, "render", ROOM, str(tmp_path / name), *flags)
    assert "OCIO" not in os.environ


@pytest.mark.extended
def test_view_of_a_configuration(tmp_path, monkeypatch):
    """The view that only encodes gives the picture of --tonemap srgb, in a settings file as well; steps of 8 bits."""
    monkeypatch.delenv("OCIO", raising=False)
    flags = ["--ocio-config", "ocio://default", "--ocio-view", "Un-tone-mapped"]
    path = preset(tmp_path, 'ocio-config = "ocio://default"\ncolor-space = "Linear P3-D65"\nocio-view = "Raw"')
    for name, more in (("a", []), ("b", flags), ("c", ["--settings", path])):
        assert main(["render", ROOM, str(tmp_path / f"{name}.png"), *SMALL, *more]) == 0
    pictures = [read_image(tmp_path / f"{name}.png") for name in "abc"]
    np.testing.assert_allclose(pictures[1], pictures[0], atol=1.01 / 255.0)
    assert np.abs(pictures[2] - pictures[0]).max() > 0.1


# ---- presets and completion ------------------------------------------------------------------------------


def preset(folder, text):
    """A settings file."""
    (folder / "preset.toml").write_text(text)
    return str(folder / "preset.toml")


def test_settings_file_stands_for_flags(tmp_path):
    """Each key means what its flag means: numbers, switches, lists, texts, repeated flags."""
    path = preset(
        tmp_path,
        """
        res = [320, 200]
        light-paths = 128
        filter = false
        denoise = false
        data-window = [0, 0.25, 1, 1]
        aov = ["depth", "normal"]
        variant = ["/A{x=1}", "/B{y=2}"]
        exposure = -1.5
        float = true
        camera = "/Cam"
        """,
    )
    args = parse(["render", ROOM, "a.exr", "--settings", path])
    settings = settings_of(args)
    assert (settings.width, settings.height, settings.light_paths, settings.filter) == (320, 200, 128, False)
    assert settings.data_window == (0.0, 0.25, 1.0, 1.0)
    assert (args.aovs, args.variants, args.exposure) == (["depth", "normal"], ["/A{x=1}", "/B{y=2}"], -1.5)
    assert args.half is False and args.camera == "/Cam" and args.stage == ROOM


def test_command_line_wins_over_the_settings_file(tmp_path):
    """A flag replaces the file's, and what belongs together: limits, sizes, times, cameras, lists."""
    path = preset(
        tmp_path, 'iterations = 8\nres = [320, 200]\nframes = "1:3"\ncamera = "/Cam"\naov = ["depth"]\nseed = 3\n'
    )
    command = ["render", ROOM, "a.exr", "--settings", path]
    args = parse([*command, "-w64", "--time-limit=2", "--time", "5", "--eye", "0", "0", "-1", "--aov", "normal"])
    settings = settings_of(args)
    assert (settings.width, settings.height, settings.iterations, settings.time_limit) == (64, None, None, 2.0)
    assert (args.frames, args.time, args.camera, args.eye) == (None, 5.0, None, [0.0, 0.0, -1.0])
    assert args.aovs == ["normal"] and settings.seed == 3
    assert settings_of(parse([*command, "--no-filter", "--seed", "4"])).seed == 4


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("light_paths = 3", "'light_paths' is no flag of warp-ir render; did you mean 'light-paths'?"),
        ("nonsense = 3", "'nonsense' is no flag of warp-ir render (see"),
        ("settings = 'a'", "'settings' is no flag of"),
        ("imageWidth = 3", "'imageWidth' is no flag of"),
        ("[render]", "'render' is no flag of"),
        ("width = 'wide'", "argument --width/-w: invalid int value: 'wide'"),
        ("width = -2", "--width: must be a whole number of at least 1, is -2"),
        ("width = true", "width: must be a number, a text or a list of these, is True"),
        ("res = [1]", "argument --res: expected 2 arguments"),
        ("filter = 3", "filter: must be true or false, is 3"),
        ("width 3", "is not TOML: "),
    ],
)
def test_settings_file_errors_name_the_file(tmp_path, capsys, text, message):
    """An error in a settings file is one line, which names the file and the key."""
    path = preset(tmp_path, text)
    assert f"{path}: {message}" in error_of(capsys, "render", ROOM, "a.exr", "--settings", path)


def test_settings_file_is_there(tmp_path, capsys):
    """A missing file, a folder, and a flag of another command are errors."""
    assert "no.toml: no such file" in error_of(capsys, "render", ROOM, "a.exr", "--settings", "no.toml")
    assert "not a TOML file" in error_of(capsys, "render", ROOM, "a.exr", "--settings", str(tmp_path))
    path = preset(tmp_path, "aov = 'depth'")
    assert "'aov' is no flag of warp-ir compare" in error_of(capsys, "compare", ROOM, "--settings", path)


def test_completion_knows_every_flag(capsys):
    """The scripts for shells name the commands and their flags; an unknown shell is an error."""
    pytest.importorskip("shtab")
    for shell in ("bash", "zsh"):
        with pytest.raises(SystemExit) as ended:
            main(["--print-completion", shell])
        script = capsys.readouterr().out
        assert ended.value.code == 0 and "--light-paths" in script and "compare" in script
    assert "must be one of bash" in error_of(capsys, "--print-completion", "cmd")
