"""Standard streams that are closed, full or broken cost no picture, and Ctrl-C is one line from the first import on."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from warp_ir.cli import console
from warp_ir.image.io import read_image

pytestmark = pytest.mark.extended

ROOM = str(Path(__file__).parent.parent / "scenes_usd" / "cornell_box.usda")
FULL = "standard output cannot be written: no space left on device"


def shell(redirections, *words):
    """Runs `warp-ir` in a shell that redirects streams as told."""
    command = ["sh", "-c", f'exec "$@" {redirections}', "sh", sys.executable, "-m", "warp_ir", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize(
    ("redirections", "said"),
    [
        ("<&- >&- 2>&-", ""), ("2>&-", ""), (">&-", ""), ("2>/dev/full", ""),
        (">/dev/full", f"warp-ir: warning: the {FULL}\n"),
    ],
)  # fmt: skip
def test_a_picture_needs_no_streams(tmp_path, redirections, said):
    """The picture is there and is one, whatever happens to what is said of it; nothing is written elsewhere."""
    picture = tmp_path / "a.npy"
    done = shell(
        redirections, "render", ROOM, picture, "--width", 8, "--light-paths", 16, "--iterations", 2, "--no-filter"
    )
    assert (done.returncode, done.stderr) == (0, said)
    assert read_image(picture).shape == (8, 8, 3) and os.listdir(tmp_path) == ["a.npy"]


def test_a_lost_result_is_an_error():
    """Text is all that `info` makes: where it cannot be printed, that is one line and exit code 1."""
    done = shell(">/dev/full", "info", ROOM)
    assert (done.returncode, done.stderr) == (
        1,
        "warp-ir: error: the output cannot be written: no space left on device\n",
    )
    assert shell(">&-", "info", ROOM).returncode == 0
    assert shell("2>/dev/full", "render", ROOM, "a.unknown").returncode == 2


def test_a_full_log_is_said_once(capsys):
    """A log file that cannot grow is left alone, and the command goes on."""
    with console.Messages() as messages:
        messages.configure(file="/dev/full")
        for _ in range(3):
            console.say("something")
    text = capsys.readouterr().err
    assert text.count("/dev/full cannot be written: no space left on device") == 1 and text.count("something") == 3


IMPORTING = """
import os, signal, sys

class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == sys.argv[3]:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupting())
from warp_ir.__main__ import command
command()
"""
"""A `warp-ir` that is interrupted while it begins to import a module."""


@pytest.mark.parametrize("module", ["warp_ir.cli", "argparse", "numpy", "warp_ir.cli.arguments", "pxr"])
def test_ctrl_c_during_imports(module):
    """One line and 130, wherever the imports are."""
    python = IMPORTING.replace("sys.argv[3]", repr(module))
    process = [sys.executable, "-c", python, "info", ROOM]
    done = subprocess.run(process, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (128 + signal.SIGINT, "", "warp-ir: interrupted\n")
