"""Pipes, devices and names that no program can read: one line each, and no waiting."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf

import warp_ir as ir
from tests.stages import TRIANGLE
from warp_ir.cli import main
from warp_ir.files import check_input, whole_file
from warp_ir.usd.stage import crate_validation
from warp_ir.usd.stage.crate_validation import MAX_DEPTH, _depth
from warp_ir.usd.stage.layers_check import check_layers


@pytest.fixture(autouse=True)
def no_waiting():
    """To open a pipe that nobody writes to would wait for ever."""
    signal.signal(signal.SIGALRM, lambda *_: (_ for _ in ()).throw(TimeoutError("it waits")))
    signal.alarm(20)
    yield
    signal.alarm(0)


def error_of(capsys, *words):
    assert main([str(word) for word in words]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said.startswith("warp-ir: error: ")
    return said


@pytest.fixture
def pipe(tmp_path):
    os.mkfifo(tmp_path / "pipe.usda")
    return tmp_path / "pipe.usda"


REFERRING = {
    "sublayer": '(subLayers = [@./middle.usda@])\ndef Xform "X" {}',
    "reference": 'def Xform "X" (references = @./middle.usda@</X>) {}',
    "payload": 'def Xform "X" (payload = @./middle.usda@</X>) {}',
    "variant": 'def Xform "X" (variantSets = "v"\n variants = {string v = "a"}) {\n'
    ' variantSet "v" = {\n "a" (references = @./middle.usda@</X>) {\n}\n }\n}',
}


@pytest.mark.parametrize("suffix", [".usda", ".usdc"])
@pytest.mark.parametrize("way", REFERRING)
def test_a_layer_that_is_a_pipe_is_refused(tmp_path, pipe, way, suffix):
    """Directly or by way of another layer, in text and in crate files, wherever USD would open it."""
    root, middle = tmp_path / f"root{suffix}", tmp_path / f"middle{suffix}"
    for path, target in ((root, middle.name), (middle, pipe.name)):
        layer = Sdf.Layer.CreateAnonymous()
        assert layer.ImportFromString("#usda 1.0\n" + REFERRING[way].replace("middle.usda", target))
        layer.Export(str(path))
    for stage in (root, middle):
        with pytest.raises(ir.InputError, match=r"pipe\.usda: is a pipe, not a USD file; .*middle\.usd. refers to it"):
            ir.load_usd(stage)


def test_what_is_no_file_is_no_input(tmp_path, pipe, capsys):
    """Stage, session layer, settings, OpenColorIO configuration, output, log: pipes, devices, folders, links."""
    stage = tmp_path / "stage.usda"
    stage.write_text("#usda 1.0\n")
    (tmp_path / "link.usda").symlink_to(pipe)
    for path, kind in (
        (pipe, "a pipe"),
        ("/dev/zero", "a device"),
        (tmp_path, "a dir"),
        (tmp_path / "link.usda", "a pipe"),
    ):
        assert f"is {kind}" in error_of(capsys, "info", path)
    for flag in ("--session-layer", "--settings", "--ocio-config", "--log-file"):
        said = error_of(capsys, "render", stage, "a.png", flag, pipe)
        assert "pipe.usda" in said
    png = tmp_path / "a.png"
    os.mkfifo(png)
    assert "is not a regular file" in error_of(capsys, "render", stage, png)


def test_a_log_may_be_a_pipe_that_is_read(tmp_path, pipe, capsys):
    """As of `--log-file >(logger)`."""
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        error_of(capsys, "info", tmp_path / "nowhere.usda", "--log-file", pipe)
        assert b"no such file" in os.read(reader, 10_000)
    finally:
        os.close(reader)


def test_a_texture_that_is_none_is_a_warning(tmp_path, pipe):
    """Pipes, devices and folders as the image of a dome and as a lamp's profile."""
    (tmp_path / "pipe.png").symlink_to(pipe)
    for asset in ("pipe.png", "/dev/zero", "."):
        stage = tmp_path / "stage.usda"
        stage.write_text(
            f"""#usda 1.0
def Mesh "M" {{{TRIANGLE}}}
def DomeLight "D" {{
    asset inputs:texture:file = @{asset}@
}}
def SphereLight "S" (prepend apiSchemas = ["ShapingAPI"]) {{
    asset inputs:shaping:ies:file = @{asset}@
}}
"""
        )
        warnings = ir.load_usd(stage).warnings
        assert any(line.startswith("/D") for line in warnings) and any(line.startswith("/S") for line in warnings)


def test_names_that_are_not_utf8(tmp_path, capsys):
    """Linux has files with any names; USD and OpenImageIO have none for them. A folder of such a name is no matter."""
    name = os.fsdecode(b"a\xff.usda")
    (tmp_path / name).write_text("#usda 1.0\n")
    assert "not UTF-8" in error_of(capsys, "info", tmp_path / name)
    assert "not UTF-8" in error_of(capsys, "info", "a.usda", "--camera", name)
    with pytest.raises(ir.InputError, match="its name is not UTF-8"):
        check_input(tmp_path / name, "a USD file")
    folder = tmp_path / os.fsdecode(b"d\xff")
    folder.mkdir()
    previous = Path.cwd()
    os.chdir(folder)
    try:
        layer = Sdf.Layer.CreateAnonymous()
        layer.ImportFromString("#usda 1.0\n(subLayers = [@./b.usda@])")
        layer.Export("a.usdc")
        Path("b.usda").write_text("#usda 1.0\n")
        assert ir.load_usd("a.usdc").meshes == ()
        ir.write_image("a.png", np.zeros((2, 2, 3), np.float32))
        assert sorted(os.listdir()) == ["a.png", "a.usdc", "b.usda"]
    finally:
        os.chdir(previous)


def test_a_file_replaces_the_target_of_a_link(tmp_path):
    """The link stays a link."""
    (tmp_path / "link.txt").symlink_to(tmp_path / "target.txt")
    with whole_file(tmp_path / "link.txt") as temporary:
        temporary.write_text("text")
    assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "target.txt").read_text() == "text"


def nested(depth):
    """A stage of prims in prims."""
    return "#usda 1.0\n" + 'def Xform "x" {\n' * depth + "}\n" * depth


def test_prims_that_are_too_deep_are_refused(tmp_path):
    """USD's parser ends the process at some tens of thousands; braces in texts and comments do not count."""
    deep, root, flat = (tmp_path / name for name in ("deep.usda", "root.usda", "flat.usda"))
    deep.write_text(nested(MAX_DEPTH + 1))
    root.write_text("#usda 1.0\n(subLayers = [@./deep.usda@])")
    for path in (deep, root):
        with pytest.raises(ir.InputError, match=r"deep\.usda: its prims are nested more than 10000 deep"):
            ir.load_usd(path)
    braces = "{" * 2 * MAX_DEPTH
    texts = (f'"{braces}"', f"'{braces}'", f'"""{braces}\n"""', f"'''{braces}'''", f'"\\"{braces}"')
    flat.write_text("#usda 1.0\n# {\n" + "".join(f'def "p{k}" {{\n string s = {t}\n}}\n' for k, t in enumerate(texts)))
    check_layers(str(flat))
    assert ir.load_usd(flat).meshes == ()


def test_depth_of_the_paths_of_a_crate_file(monkeypatch, tmp_path):
    """The depth is that of a tree written out by hand, and of layers of known depth."""
    monkeypatch.setattr(crate_validation, "MAX_DEPTH", 0)
    # a ( b ( c ) d ( e f ) ) g: children first, -1 a child alone, 0 a sibling alone, j > 0 both, -2 neither
    assert _depth(np.array([6, 2, -2, -1, 0, -2, -2])) == 2
    assert _depth(np.array([-2])) == 0 and _depth(np.array([-1, -1, -1, -2])) == 3
    layer = Sdf.Layer.CreateAnonymous()
    layer.ImportFromString(nested(50))
    layer.Export(str(tmp_path / "deep.usdc"))
    monkeypatch.setattr(crate_validation, "MAX_DEPTH", 51)
    crate_validation.validate_crate(str(tmp_path / "deep.usdc"))
    monkeypatch.setattr(crate_validation, "MAX_DEPTH", 49)
    with pytest.raises(ir.InputError, match="PATHS is damaged"):
        crate_validation.validate_crate(str(tmp_path / "deep.usdc"))


@pytest.mark.extended
@pytest.mark.parametrize("depth", [MAX_DEPTH, 100_000])
def test_a_deep_stage_does_not_end_the_process(tmp_path, depth):
    """A file that the check lets through is read; one that it refuses is one line."""
    stage = tmp_path / "deep.usda"
    stage.write_text(nested(depth))
    done = subprocess.run([sys.executable, "-m", "warp_ir", "info", stage], capture_output=True, text=True)
    assert done.returncode == (0 if depth <= MAX_DEPTH else 2), done.stderr
